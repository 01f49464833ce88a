"""The verbs beside submitting, as a user types them: a real `frit serve`, real files; each with --json too."""

import json
from pathlib import Path

import pytest
from commands import CASE, SWEEP, frit, serving

from frit.service.cli.jobs import keep_of

MESH = "6.5,6.2,5.0\n15.4,6.8,4.0\n"


def test_change_rerun_rm(folder: Path) -> None:
    with serving(folder):
        job = frit("submit", "case.toml", "--wait").split()[0]
        words = ("--name", "sleep 0.01", "--tag", "a", "--priority", "4")
        assert frit("change", job, *words).split() == [job, "succeeded"]
        changed = json.loads(frit("change", job, "--tag", "b", "--json"))
        assert (changed["name"], changed["tags"], changed["priority"]) == ("sleep 0.01", ["b"], 4)
        again = json.loads(frit("rerun", job, "--json"))
        assert (again["origin"], again["id"]) == (job, f"{job}-2")
        frit("log", again["id"], "-f")
        long = frit("submit", "long.toml").strip()
        gone = frit("rm", job, long, "nobody", "--json", status=2)
        outcome = {row["id"]: row["removed"] for row in json.loads(gone)}
        assert outcome == {job: True, long: False, "nobody": False}
        assert "delete is possible only from" in gone
        frit("cancel", long)
        frit("log", long, "-f")
        assert "True" in frit("rm", long)
        assert [row["id"] for row in json.loads(frit("jobs", "--json"))] == [again["id"]]
        assert [path.name for path in (folder / "data" / "runs").iterdir() if path.is_dir()] == [again["id"]]
    table = [line.split("\t") for line in (folder / "data" / "runs" / "INDEX.tsv").read_text().splitlines()]
    assert table == [["id", "name", "sweep", "state"], [again["id"], "sleep 0.01", "", "succeeded"]]


def test_sweeps_are_listed_shown_cancelled_tried_again_and_removed(folder: Path) -> None:
    (folder / "sweep.toml").write_text(SWEEP % "sleep 60")
    with serving(folder):
        sweep = frit("submit", "sweep.toml").strip()
        assert [row["points"] for row in json.loads(frit("sweep", "list", "--json"))] == [3]
        assert sweep in frit("sweep", "list")
        shown = json.loads(frit("sweep", "show", sweep, "--json"))
        assert len(shown["jobs"]) == 3
        frit("sweep", "cancel", "sleep 60")
        frit("log", shown["jobs"][0]["id"], "-f")
        for job in shown["jobs"]:
            frit("log", job["id"], "-f")
        assert json.loads(frit("sweep", "show", sweep, "--json"))["states"] == {"cancelled": 3}
        again = json.loads(frit("sweep", "retry", sweep, "--json"))["states"]
        assert "cancelled" not in again
        frit("sweep", "cancel", sweep)
        for job in shown["jobs"]:
            frit("log", job["id"], "-f")
        assert "3" in frit("sweep", "show", sweep)
        frit("rm", sweep)
        assert json.loads(frit("jobs", "--json")) == []
        assert json.loads(frit("sweep", "list", "--json")) == []
        assert "no sweeps yet" in frit("sweep", "list")


def test_names_do_where_ids_are_and_tags_reach_reused_jobs(folder: Path) -> None:
    (folder / "sweep.toml").write_text(SWEEP % "sleep 0")
    with serving(folder):
        frit("submit", "sweep.toml", "--wait")
        frit("submit", "sweep.toml", "--tag", "again")
        assert len(json.loads(frit("jobs", "tag=again", "state=succeeded", "state=failed", "--json"))) == 3
        jobs = json.loads(frit("jobs", "--json"))
        assert json.loads(frit("show", jobs[0]["name"], "--json"))["id"] == jobs[0]["id"]
        assert "no job fits state=failed" in frit("jobs", "state=failed")
        wrong = frit("show", "nobody", status=2)
        assert all(words in wrong for words in ("job 'nobody': there is none", jobs[0]["id"]))
        assert json.loads(frit("sweep", "show", "sleep 0", "--json"))["id"] == "s2"


def test_gc_keeps_what_it_is_told(folder: Path) -> None:
    (folder / "no.toml").write_text(CASE.replace("sleep 0", "says-no").replace("15.4", "15.2"))
    with serving(folder):
        first = frit("submit", "case.toml", "--wait").split()[0]
        frit("submit", "no.toml", "--wait", status=1)
        assert frit("submit", "case.toml", "--wait").split()[0] == first, "the same case"
        second = frit("submit", "case.toml", "--again", "--wait").split()[0]
        [failed] = [row["id"] for row in json.loads(frit("jobs", "state=failed", "--json"))]
        assert json.loads(frit("gc", "--keep", "1d", "--json")) == []
        listed = json.loads(frit("gc", "--keep", "succeeded", "--dry-run", "--json"))
        assert [(row["id"], row["removed"]) for row in listed] == [(failed, False)]
        assert "1 jobs" in frit("gc", "--keep", "succeeded")
        sizes = {row["id"]: row["bytes"] for row in json.loads(frit("jobs", "--json"))}
        assert sizes.keys() == {first, second}
        assert all(size > 500 for size in sizes.values())
        [gone] = json.loads(frit("gc", "--keep", f"{sizes[second] + 1}B", "--json"))
        assert (gone["id"], gone["removed"]) == (first, True)  # of both, the newest is kept
        assert "must be an age as 30d" in frit("gc", "--keep", "much", status=2)
        assert "Missing option" in frit("gc", status=2)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["30d"], (30 * 86400.0, frozenset(), None)),
        (["1.5h", "failed", "lost"], (5400.0, frozenset({"failed", "lost"}), None)),
        (["10GB"], (None, frozenset(), 1e10)),
    ],
)
def test_what_to_keep(words: list[str], expected: tuple[object, ...]) -> None:
    assert tuple(keep_of(words)) == expected


def test_plan_limits_events_files(folder: Path) -> None:
    (folder / "particles.csv").write_text(MESH)
    with serving(folder):
        assert json.loads(frit("plan", "case.toml", "--json"))["to_run"] == 1
        assert "core hours" in frit("plan", "case.toml")
        assert json.loads(frit("jobs", "--json")) == []
        assert json.loads(frit("limits", "--json"))["quotas"] == {}
        job = frit("submit", "case.toml", "--wait").split()[0]
        told = [json.loads(line) for line in frit("events", "--since", "0", "--count", "4", "--json").splitlines()]
        assert [(each["job"], each["state"]) for each in told] == [
            (job, state) for state in ("queued", "starting", "running", "succeeded")
        ]
        assert frit("events", "--since", "0", "--count", "1").split()[1:3] == [job, "queued"]
        file = frit("files", "add", "particles.csv").strip()
        assert [row["id"] for row in json.loads(frit("files", "list", "--json"))] == [file]
        assert file in frit("files", "list")
        assert frit("files", "rm", file).strip() == file
        assert "there is none" in frit("files", "rm", file, status=2)
