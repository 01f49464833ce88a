"""The first index."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Make all tables."""
    op.create_table(
        "sweeps",
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("id", sa.String, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("definition", sa.Text, nullable=False),
        sa.Column("created", sa.Float, nullable=False),
        sa.UniqueConstraint("id", name="uq_sweeps_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "jobs",
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("id", sa.String, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("identity", sa.String, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("message", sa.Text),
        sa.Column("priority", sa.Integer, nullable=False),
        sa.Column("ranks", sa.Integer, nullable=False),
        sa.Column("tags", sa.JSON, nullable=False),
        sa.Column("time_limit", sa.Float),
        sa.Column("attempt", sa.Integer, nullable=False),
        sa.Column("failures", sa.Integer, nullable=False),
        sa.Column("retrying", sa.Boolean, nullable=False),
        sa.Column("stopping", sa.Boolean, nullable=False),
        sa.Column("created", sa.Float, nullable=False),
        sa.Column("started", sa.Float),
        sa.Column("ended", sa.Float),
        sa.Column("core_seconds", sa.Float),
        sa.Column("result", sa.JSON, nullable=False),
        sa.Column("case", sa.Text, nullable=False),
        sa.UniqueConstraint("id", name="uq_jobs_id"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_jobs_identity", "jobs", ["identity"])
    op.create_index("ix_jobs_queue", "jobs", ["state", sa.text("priority DESC"), "seq"])
    op.create_index("ix_jobs_state_seq", "jobs", ["state", "seq"])
    op.create_table(
        "sweep_jobs",
        sa.Column("sweep", sa.Integer, sa.ForeignKey("sweeps.seq"), primary_key=True),
        sa.Column("position", sa.Integer, primary_key=True),
        sa.Column("job", sa.Integer, sa.ForeignKey("jobs.seq"), nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("parameters", sa.JSON, nullable=False),
    )
    op.create_index("ix_sweep_jobs_job", "sweep_jobs", ["job"])
    op.create_table(
        "attempts",
        sa.Column("job", sa.Integer, sa.ForeignKey("jobs.seq"), primary_key=True),
        sa.Column("number", sa.Integer, primary_key=True),
        sa.Column("cores", sa.JSON, nullable=False),
        sa.Column("claimed", sa.Float, nullable=False),
        sa.Column("pid", sa.Integer),
        sa.Column("pid_start", sa.Integer),
        sa.Column("boot", sa.String),
        sa.Column("ended", sa.Float),
        sa.Column("state", sa.String),
        sa.Column("message", sa.Text),
        sa.Column("core_seconds", sa.Float),
    )
    op.create_table(
        "history",
        sa.Column("job", sa.Integer, sa.ForeignKey("jobs.seq"), primary_key=True),
        sa.Column("row", sa.Integer, primary_key=True),
        sa.Column("time", sa.Float, nullable=False),
        sa.Column("vacancy_ratio", sa.Float),
        sa.Column("data", sa.Text, nullable=False),
    )
    op.create_table(
        "snapshots",
        sa.Column("job", sa.Integer, sa.ForeignKey("jobs.seq"), primary_key=True),
        sa.Column("number", sa.Integer, primary_key=True),
        sa.Column("time", sa.Float, nullable=False),
    )
    op.create_table(
        "events",
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("job", sa.Integer, sa.ForeignKey("jobs.seq"), nullable=False),
        sa.Column("at", sa.Float, nullable=False),
        sa.Column("state", sa.String, nullable=False),
        sa.Column("message", sa.Text),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_job_seq", "events", ["job", "seq"])
    op.create_table(
        "tokens",
        sa.Column("seq", sa.Integer, primary_key=True),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("hash", sa.String, nullable=False),
        sa.Column("scope", sa.String, nullable=False),
        sa.Column("created", sa.Float, nullable=False),
        sa.Column("revoked", sa.Float),
        sa.UniqueConstraint("name", name="uq_tokens_name"),
        sa.UniqueConstraint("hash", name="uq_tokens_hash"),
    )
    op.create_table(
        "idempotency",
        sa.Column("key", sa.String, primary_key=True),
        sa.Column("fingerprint", sa.String, nullable=False),
        sa.Column("resource", sa.String, nullable=False),
        sa.Column("created", sa.Float, nullable=False),
    )
