"""What a job has computed tells the revision of the solver that did."""

from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """All that was tried before revisions were recorded is of the first."""
    op.execute("UPDATE jobs SET result = json_set(result, '$.revision', 1) WHERE attempt > 0")
