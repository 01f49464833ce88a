"""Jobs are found and ordered by the vacancy ratio that they ended with."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """The index is filled from the results there are."""
    op.create_index("ix_jobs_vacancy_ratio", "jobs", [sa.text("json_extract(result, '$.vacancy_ratio')")])
