"""Sweeps remember how many of their points were the same case; jobs are found by the axes of sweeps."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

AXES = ("mean_radius", "std_radius", "packing_density")


def upgrade() -> None:
    """Sweeps stored before count no duplicates: they were not counted."""
    op.add_column("sweeps", sa.Column("duplicates", sa.Integer, nullable=False, server_default="0"))
    for key in AXES:
        op.create_index(f"ix_jobs_{key}", "jobs", [sa.text(f"""json_extract("case", '$.particles.{key}')""")])
