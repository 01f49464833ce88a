"""Jobs are ordered by their names and found by their tags."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """A tag is a row; the rows are filled from the lists there are, and by the trigger from those to come."""
    op.create_index("ix_jobs_name", "jobs", ["name"])
    op.create_table(
        "job_tags",
        sa.Column("tag", sa.Text, primary_key=True),
        sa.Column("job", sa.Integer, sa.ForeignKey("jobs.seq"), primary_key=True),
        sqlite_with_rowid=False,
    )
    op.execute("INSERT OR IGNORE INTO job_tags SELECT each.value, jobs.seq FROM jobs, json_each(jobs.tags) AS each")
    op.execute(
        "CREATE TRIGGER tags_of_a_job AFTER INSERT ON jobs WHEN new.tags <> '[]' BEGIN "
        "INSERT OR IGNORE INTO job_tags SELECT value, new.seq FROM json_each(new.tags); END"
    )
