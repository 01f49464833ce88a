"""The tables of the index. A change here needs a migration in migrations/versions; a test compares the two."""

from sqlalchemy import (
    JSON,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    func,
    literal_column,
)

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)

sweeps = Table(
    "sweeps",
    metadata,
    Column("seq", Integer, primary_key=True),
    Column("id", String, nullable=False, unique=True),
    Column("name", Text, nullable=False),
    Column("definition", Text, nullable=False),  # JSON, as `Sweep.resolved_json` gives it
    Column("duplicates", Integer, nullable=False, server_default="0"),
    Column("created", Float, nullable=False),
    Column("owner", Text),  # the label of the token that made it
    sqlite_autoincrement=True,
)

jobs = Table(
    "jobs",
    metadata,
    Column("seq", Integer, primary_key=True),
    Column("id", String, nullable=False, unique=True),
    Column("name", Text, nullable=False),
    Column("identity", String, nullable=False, index=True),
    Column("state", String, nullable=False),
    Column("message", Text),
    Column("priority", Integer, nullable=False),
    Column("ranks", Integer, nullable=False),
    Column("tags", JSON, nullable=False),
    Column("time_limit", Float),
    Column("attempt", Integer, nullable=False),
    Column("failures", Integer, nullable=False),
    Column("retrying", Boolean, nullable=False),
    Column("stopping", Boolean, nullable=False),
    Column("created", Float, nullable=False),
    Column("started", Float),
    Column("ended", Float),
    Column("core_seconds", Float),
    Column("result", JSON, nullable=False),
    Column("case", Text, nullable=False),  # the resolved case, compact JSON
    Column("owner", Text),  # the label of the token that made it
    Column("origin", String),  # the id of the job that this one is a rerun of
    Column("bytes", Integer),  # of its run directory, at the end of its last attempt
    sqlite_autoincrement=True,
)
Index("ix_jobs_name", jobs.c.name)
Index("ix_jobs_queue", jobs.c.state, jobs.c.priority.desc(), jobs.c.seq)
Index("ix_jobs_state_seq", jobs.c.state, jobs.c.seq)
Index("ix_jobs_owner_state", jobs.c.owner, jobs.c.state)
for key in ("mean_radius", "std_radius", "packing_density"):  # what sweeps are made of
    Index(f"ix_jobs_{key}", func.json_extract(jobs.c.case, literal_column(f"'$.particles.{key}'")))
# ... and what they lead to
Index("ix_jobs_vacancy_ratio", func.json_extract(jobs.c.result, literal_column("'$.vacancy_ratio'")))

job_tags = Table(  # filled by triggers on `jobs`
    "job_tags",
    metadata,
    Column("tag", Text, primary_key=True),
    Column("job", ForeignKey(jobs.c.seq), primary_key=True),
    sqlite_with_rowid=False,
)

sweep_jobs = Table(
    "sweep_jobs",
    metadata,
    Column("sweep", ForeignKey(sweeps.c.seq), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("job", ForeignKey(jobs.c.seq), nullable=False, index=True),
    Column("name", Text, nullable=False),
    Column("parameters", JSON, nullable=False),
)

attempts = Table(
    "attempts",
    metadata,
    Column("job", ForeignKey(jobs.c.seq), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("cores", JSON, nullable=False),
    Column("claimed", Float, nullable=False),
    Column("ended", Float),
    Column("state", String),
    Column("message", Text),
    Column("core_seconds", Float),
    Column("handle", JSON(none_as_null=True)),  # how the backend finds the runner again
)

history = Table(
    "history",
    metadata,
    Column("job", ForeignKey(jobs.c.seq), primary_key=True),
    Column("row", Integer, primary_key=True),
    Column("time", Float, nullable=False),
    Column("vacancy_ratio", Float),
    Column("data", Text, nullable=False),  # the row as the solver wrote it
)

snapshots = Table(
    "snapshots",
    metadata,
    Column("job", ForeignKey(jobs.c.seq), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("time", Float, nullable=False),
)

events = Table(
    "events",
    metadata,
    Column("seq", Integer, primary_key=True),
    Column("job", ForeignKey(jobs.c.seq), nullable=False),
    Column("at", Float, nullable=False),
    Column("state", String, nullable=False),
    Column("message", Text),
    Index("ix_events_job_seq", "job", "seq"),
    sqlite_autoincrement=True,
)

removed = Table(  # jobs and sweeps that are gone for good
    "removed",
    metadata,
    Column("event", Integer, primary_key=True),  # a number of the events' own
    Column("kind", String, nullable=False),  # job or sweep
    Column("seq", Integer, nullable=False),
    Column("id", String, nullable=False),
    Column("identity", String, index=True),  # of a job: its id is not given again
    Column("owner", Text),
    Column("at", Float, nullable=False),
    Column("core_seconds", Float),
    Column("done", Boolean, nullable=False),  # whether the journal knows, and the folder is gone
)

tokens = Table(
    "tokens",
    metadata,
    Column("seq", Integer, primary_key=True),
    Column("name", Text, nullable=False, unique=True),
    Column("hash", String, nullable=False, unique=True),  # SHA-256 of 256 random bits
    Column("scope", String, nullable=False),
    Column("created", Float, nullable=False),
    Column("revoked", Float),
)

idempotency = Table(
    "idempotency",
    metadata,
    Column("key", String, primary_key=True),
    Column("fingerprint", String, nullable=False),
    Column("resource", String, nullable=False),
    Column("created", Float, nullable=False),
)
