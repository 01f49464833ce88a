"""Jobs know who made them, what they are a rerun of and how large they are; what is gone is known to be gone.

How a runner is found again is the backend's own. Indices that were made of what was asked for go.
"""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"

TAGS = "INSERT OR IGNORE INTO job_tags SELECT value, new.seq FROM json_each(new.tags);"


def upgrade() -> None:
    """Jobs stored before belong to nobody, which is to say: to whoever may submit."""
    op.add_column("jobs", sa.Column("owner", sa.Text))
    op.add_column("jobs", sa.Column("origin", sa.String))
    op.add_column("jobs", sa.Column("bytes", sa.Integer))
    op.add_column("sweeps", sa.Column("owner", sa.Text))
    op.create_index("ix_jobs_owner_state", "jobs", ["owner", "state"])
    op.create_table(
        "removed",
        sa.Column("event", sa.Integer, primary_key=True),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("seq", sa.Integer, nullable=False),
        sa.Column("id", sa.String, nullable=False),
        sa.Column("identity", sa.String),
        sa.Column("owner", sa.Text),
        sa.Column("at", sa.Float, nullable=False),
        sa.Column("core_seconds", sa.Float),
        sa.Column("done", sa.Boolean, nullable=False),
    )
    op.create_index("ix_removed_identity", "removed", ["identity"])
    op.add_column("attempts", sa.Column("handle", sa.JSON))
    op.execute(
        "UPDATE attempts SET handle = json_object('pid', pid, 'start', pid_start, 'boot', boot) "
        "WHERE pid IS NOT NULL AND pid_start IS NOT NULL AND boot IS NOT NULL"
    )
    for column in ("pid", "pid_start", "boot"):
        op.execute(f"ALTER TABLE attempts DROP COLUMN {column}")
    op.execute(
        "CREATE TRIGGER tags_that_change AFTER UPDATE OF tags ON jobs BEGIN "
        f"DELETE FROM job_tags WHERE job = new.seq; {TAGS} END"
    )
    made = op.get_bind().exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'index' AND name GLOB 'asked_*'")
    for (name,) in made.fetchall():
        op.execute(f'DROP INDEX "{name}"')
