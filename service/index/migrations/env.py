"""Run by alembic: the steps of an upgrade over one connection, all in one transaction."""

import sqlalchemy as sa
from alembic import context

engine = sa.create_engine(f"sqlite:///{context.config.attributes['path']}", poolclass=sa.NullPool)


@sa.event.listens_for(engine, "connect")
def _own_transactions(connection, _):  # type: ignore[no-untyped-def]
    connection.isolation_level = None


@sa.event.listens_for(engine, "begin")
def _begin(connection):  # type: ignore[no-untyped-def]
    connection.exec_driver_sql("BEGIN IMMEDIATE")


with engine.connect() as connection:
    context.configure(connection=connection, transactional_ddl=True, render_as_batch=True)
    with context.begin_transaction():
        context.run_migrations()
