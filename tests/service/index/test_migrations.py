"""Versions of the index: a stored old one is refused by name, upgraded whole or not at all, and kept."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from indexing import done, is_whole, new, opened, rows, use
from places import DATA, SUPPORT
from typer.testing import CliRunner

from frit.service.cli import main as cli
from frit.service.index import migrations
from frit.service.index.migrations import IndexVersionError
from frit.service.index.schema import metadata
from frit.service.jobs.engine import take
from frit.service.jobs.states import State
from frit.solver.revision import FIRST

NEWEST = migrations.versions(Path("there is none"))[1]

OLD = DATA / "index-0001.sql"
PROCESS = {"pid": "pid", "start": "pid_start", "boot": "boot"}
TABLES = ["sweeps", "jobs", "sweep_jobs", "attempts", "history", "snapshots", "events", "tokens", "idempotency"]


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A data folder with an index of version 0001, as that version left it."""
    with closing(sqlite3.connect(tmp_path / "frit.db")) as connection:
        connection.executescript(OLD.read_text())
    return tmp_path


def version(path: Path) -> str:
    (row,) = rows(path, "alembic_version")
    return str(row["version_num"])


def content(path: Path) -> dict[str, list[dict[str, Any]]]:
    return {table: rows(path, table) for table in TABLES}


def frit(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli.app, [*arguments])
    return result.exit_code, result.output


# --- an upgrade -------------------------------------------------------------------------------------------


def test_an_old_index_is_refused_with_the_command_to_run(old: Path) -> None:
    with pytest.raises(IndexVersionError, match=rf"version 0001, .* `frit db upgrade --data {old}`$"), opened(old):
        pass
    assert version(old / "frit.db") == "0001"


def test_the_command_upgrades_it_and_keeps_every_row_and_a_copy(old: Path) -> None:
    path = old / "frit.db"
    before = content(path)
    assert all(before.values())
    status, printed = frit("db", "upgrade", "--data", str(old))
    assert (status, printed) == (0, f"{path}: version {NEWEST}, was 0001, which is kept as {path}.0001\n")
    after = content(path)
    assert before == content(Path(f"{path}.0001"))
    assert [(row.pop("duplicates"), row.pop("owner")) for row in after["sweeps"]] == [(0, None)] * 2
    tried = [row["attempt"] > 0 for row in before["jobs"]]
    assert set(tried) == {True, False}
    results = [json.loads(row["result"]) for row in after["jobs"]]
    assert [result.pop("revision", None) for result in results] == [FIRST if ran else None for ran in tried]
    for row, result in zip(after["jobs"], results, strict=True):
        row["result"] = json.dumps(result)
        assert [row.pop(key) for key in ("owner", "origin", "bytes")] == [None] * 3
    for row in before["jobs"]:
        row["result"] = json.dumps(json.loads(row["result"]))
    for row in (*before["attempts"], *after["attempts"]):
        process = {name: row.pop(key, None) for name, key in PROCESS.items()}
        row["handle"] = json.loads(row.get("handle") or json.dumps(process))
    assert after == before
    assert any(row["handle"]["pid"] for row in after["attempts"])
    assert (version(path), version(Path(f"{path}.0001"))) == (NEWEST, "0001")
    assert is_whole(path)
    assert frit("db", "upgrade", "--data", str(old)) == (0, f"{path}: version {NEWEST} already\n")


def test_an_upgraded_index_is_used(old: Path) -> None:
    migrations.upgrade(old / "frit.db")
    with opened(old) as store:
        assert store.counts() == dict.fromkeys(State, 1)
        assert store.sweep("density by spread").states == {"succeeded": 1, "failed": 1, "queued": 1}
        first = store.jobs(limit=9)[-1]
        assert (first.state, first.result["vacancy_ratio"], first.tags) == (State.SUCCEEDED, 0.25, ("a", "b"))
        tagged = [(job.seq, tag) for job in store.jobs(limit=99) for tag in job.tags]
        assert sorted((row["job"], row["tag"]) for row in rows(old / "frit.db", "job_tags")) == sorted(tagged)
        assert [number for number, _ in store.history(first.id)] == [0, 1, 2, 3]
        assert done(store.submit(new(1))).seq == 10
        assert set(store.active_tokens()) == {"ab" * 32}


def test_what_the_log_of_the_old_index_holds_is_kept(old: Path) -> None:
    script = "import sqlite3, os, sys; c = sqlite3.connect(sys.argv[1]); c.execute('PRAGMA journal_mode = WAL'); \
c.execute('UPDATE jobs SET name = ''late'' WHERE seq = 1'); c.commit(); os._exit(0)".replace("''", '"')
    subprocess.run([sys.executable, "-c", script, str(old / "frit.db")], check=True)
    assert (old / "frit.db-wal").stat().st_size > 0
    migrations.upgrade(old / "frit.db")
    for path in (old / "frit.db", old / "frit.db.0001"):
        assert rows(path, "jobs")[0]["name"] == "late"


# --- the schema -------------------------------------------------------------------------------------------


def expressions(connection: sa.Connection) -> set[tuple[str, str]]:
    """Indices of expressions and directions, which are compared by their text: (name, SQL)."""
    query = "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
    return {(name, " ".join(sql.replace('"', "").split())) for name, sql in connection.exec_driver_sql(query)}


@pytest.mark.filterwarnings("ignore:Skipped unsupported reflection of expression-based index")
@pytest.mark.filterwarnings("ignore:autogenerate skipping metadata-specified expression-based index")
@pytest.mark.parametrize("how", ["new", "upgraded"])
def test_the_schema_is_that_of_the_tables(old: Path, how: str) -> None:
    path = old / "frit.db"
    if how == "new":
        path.unlink()
    migrations.upgrade(path)
    engine, model = (sa.create_engine(url, poolclass=sa.pool.StaticPool) for url in (f"sqlite:///{path}", "sqlite://"))
    with engine.connect() as connection, model.connect() as wanted:
        metadata.create_all(wanted)
        assert expressions(connection) == expressions(wanted)
        assert any("json_extract" in sql for _, sql in expressions(connection))
        context = MigrationContext.configure(
            connection, opts={"compare_type": True, "compare_server_default": True, "include_object": comparable}
        )
        assert compare_metadata(context, metadata) == []
        for name in TABLES:
            assert foreign_keys(connection, name) == foreign_keys(wanted, name)
            made, meant = (
                c.exec_driver_sql("SELECT sql FROM sqlite_master WHERE name = ?", (name,)).scalar_one()
                for c in (connection, wanted)
            )
            assert ("AUTOINCREMENT" in made) == ("AUTOINCREMENT" in meant)
    for each in (engine, model):
        each.dispose()


def foreign_keys(connection: sa.Connection, table: str) -> set[Any]:
    return {tuple(row) for row in connection.exec_driver_sql(f"PRAGMA foreign_key_list({table})")}


def comparable(thing: Any, name: str, kind: str, reflected: bool, other: Any) -> bool:
    """alembic cannot compare indices of expressions; `expressions` does."""
    return kind != "index" or name not in {
        "ix_jobs_queue", "ix_jobs_mean_radius", "ix_jobs_std_radius", "ix_jobs_packing_density",
        "ix_jobs_vacancy_ratio",
    }  # fmt: skip


# --- what goes wrong --------------------------------------------------------------------------------------

BAD = """
import os, signal
import sqlalchemy as sa
from alembic import op
revision, down_revision = "9998", "%s"
def upgrade():
    op.add_column("jobs", sa.Column("colour", sa.Text))
    op.execute("UPDATE jobs SET colour = 'red', name = 'changed'")
    op.execute("DELETE FROM history")
    {end}
"""
RAISES = "op.execute('SELECT no_such_function()')"
KILLED = "os.kill(os.getpid(), signal.SIGKILL)"
CHILD = """
import sys
from pathlib import Path
from indexing import use
from frit.service.index import migrations
use(Path(sys.argv[2]))
migrations.upgrade(Path(sys.argv[1]))
"""


def scripts(folder: Path, end: str) -> Path:
    """The migrations, and one more that ends badly after it has changed tables and rows."""
    shutil.copytree(Path(migrations.__file__).parent, folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "versions" / "9998_bad.py").write_text(BAD.replace("%s", NEWEST).replace("{end}", end))
    return folder


@pytest.fixture
def _configuration_again() -> Iterator[None]:
    before = migrations.configuration
    yield
    migrations.configuration = before


@pytest.mark.usefixtures("_configuration_again")
def test_an_upgrade_that_fails_changes_nothing(old: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = old / "frit.db"
    before = content(path)
    use(scripts(tmp_path_factory.mktemp("scripts") / "m", RAISES))
    status, printed = frit("db", "upgrade", "--data", str(old))
    assert (status, version(path)) == (2, "0001")
    assert "cannot be brought to version 9998: no such function: no_such_function" in printed
    assert content(path) == before == content(Path(f"{path}.0001"))
    assert is_whole(path)


def test_an_upgrade_that_is_killed_changes_nothing(old: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = old / "frit.db"
    before = content(path)
    folder = scripts(tmp_path_factory.mktemp("scripts") / "m", KILLED)
    command = [sys.executable, "-c", CHILD, str(path), str(folder)]
    killed = subprocess.run(command, cwd=SUPPORT, capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert (version(path), content(path)) == ("0001", before)
    migrations.upgrade(path)  # by the real ones
    assert version(path) == NEWEST


def test_the_index_of_a_newer_frit_is_refused(old: Path) -> None:
    path = old / "frit.db"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
        connection.commit()
    for call in (migrations.prepare, migrations.upgrade):
        with pytest.raises(IndexVersionError, match=rf"version 9999, this frit needs {NEWEST}: a newer frit made it"):
            call(path)
    assert frit("db", "upgrade", "--data", str(old))[0] == 2
    assert version(path) == "9999"


def another(path: Path) -> None:
    """Somebody else's database."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE mine (x)")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: path.write_bytes(b"certainly not a database " * 400), "not a database"),
        (lambda path: another(path), "not an index of frit"),
        (lambda path: path.mkdir(), "cannot be opened"),
    ],
)
def test_what_is_no_index_is_refused_and_left_alone(tmp_path: Path, make: Any, words: str) -> None:
    path = tmp_path / "frit.db"
    make(path)
    before = path.read_bytes() if path.is_file() else b""
    with pytest.raises(IndexVersionError, match=words):
        migrations.prepare(path)
    status, printed = frit("db", "upgrade", "--data", str(tmp_path))
    assert status == 2
    assert words in printed
    assert (path.read_bytes() if path.is_file() else b"") == before


def test_the_command_needs_an_index_and_the_folder_for_itself(old: Path) -> None:
    lock = take(old)
    status, printed = frit("db", "upgrade", "--data", str(old))
    assert (status, printed) == (2, f"data = {old}: in use by process {os.getpid()}: one service per data folder\n")
    os.close(lock)
    (old / "frit.db").unlink()
    status, printed = frit("db", "upgrade", "--data", str(old))
    assert status == 2
    assert f"there is no index; `frit reindex --data {old}`" in printed
    assert not (old / "frit.db").exists()


# --- the first opening ------------------------------------------------------------------------------------

OPEN = """
import sys
from pathlib import Path
from indexing import done, new, opened
sys.stdin.readline()
with opened(Path(sys.argv[1])) as store:
    done(store.submit(new(int(sys.argv[2]))))
"""


def test_two_that_open_at_once_make_one_good_index(tmp_path: Path) -> None:
    for round_ in range(3):
        folder = tmp_path / str(round_)
        children = [
            subprocess.Popen(
                [sys.executable, "-c", OPEN, str(folder), str(k)],
                cwd=SUPPORT, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            )
            for k in range(2)
        ]  # fmt: skip
        for child in children:
            assert child.stdin is not None
            child.stdin.write("\n")
            child.stdin.flush()
        errors = [child.communicate(timeout=120)[1] for child in children]
        assert [child.returncode for child in children] == [0, 0], errors
        assert version(folder / "frit.db") == NEWEST
        assert sorted(row["name"] for row in rows(folder / "frit.db", "jobs")) == ["job 0", "job 1"]
        assert is_whole(folder / "frit.db")


def test_an_index_made_between_two_looks_is_not_taken_for_another_program_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "frit.db"
    path.touch()
    other = threading.Thread(target=migrations.upgrade, args=(path,))
    look = MigrationContext.get_current_revision

    def look_and_linger(context: MigrationContext) -> str | None:
        found = look(context)
        if other.ident is None:
            other.start()
            other.join(1.0)
        return found

    monkeypatch.setattr(MigrationContext, "get_current_revision", look_and_linger)
    assert migrations.versions(path) == (None, NEWEST)
    other.join()
    assert migrations.versions(path) == (NEWEST, NEWEST)


def test_the_switch_to_a_log_waits_for_another_that_writes(tmp_path: Path) -> None:
    migrations.prepare(tmp_path / "frit.db")
    with closing(sqlite3.connect(tmp_path / "frit.db", isolation_level=None, check_same_thread=False)) as other:
        other.execute("BEGIN IMMEDIATE")
        later = threading.Timer(0.3, other.execute, ["ROLLBACK"])
        later.start()
        with opened(tmp_path) as store:
            done(store.submit(new(1)))
        later.join()
        assert other.execute("PRAGMA journal_mode").fetchone() == ("wal",)
