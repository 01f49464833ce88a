"""Results have a revision, and old cases keep their identity: what counts as computed already, and what does not."""

import json
from pathlib import Path
from typing import Any

import pytest
from cases import tables
from indexing import attempted, done, new, opened
from places import DATA

from frit.service.index.records import NewPoint
from frit.service.index.store import Store
from frit.service.jobs.states import Job, Move, State
from frit.solver import __main__ as main
from frit.solver import revision
from frit.solver.case import Case, Model, fingerprint, parse_case
from frit.solver.revision import FIRST, REVISION, revision_of
from frit.solver.variations import Variations, identity

STORED = json.loads((DATA / "identities.json").read_text())
OTHER = FIRST - 1  # stands for the number of a revision that computed something and is not the present one

# --- identity ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", STORED)
def test_old_cases_keep_their_identity(name: str) -> None:
    """The cases of sweeps/ and some of each kind, with the identity that they had when revisions began."""
    case = parse_case(STORED[name]["case"])
    assert case.identity() == STORED[name]["identity"] == identity(Variations().texts(case))


def test_a_new_key_counts_only_where_it_is_not_at_its_default(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Model().tree()
    assert Model().essence(whole) is whole
    monkeypatch.setattr(Model, "added", {"D_gb": 0.4, "advection": "huang"})
    old = {key: value for key, value in whole.items() if key not in ("D_gb", "advection")}
    assert Model().essence(Model().tree()) == old
    other = Model(advection="wang")
    assert other.essence(other.tree()) == old | {"advection": "wang"}


def test_a_new_table_counts_only_where_it_says_something() -> None:
    texts = {name: text.essence for name, text in Variations().texts(discs()).items()}
    assert fingerprint({**texts, "thumbnails": "{}"}) == fingerprint(texts)
    assert fingerprint({**texts, "thumbnails": '{"size": 1}'}) != fingerprint(texts)


def test_no_new_key_is_written_by_a_pattern_that_has_it_always() -> None:
    """`variations` puts values of fields that stand alone into a fixed text."""
    for table in tables():
        assert not table.added.keys() & set(table.alone), table
        assert table.added.keys() <= table.model_fields.keys(), table


# --- revisions --------------------------------------------------------------------------------------------


def discs(**changes: Any) -> Case:
    return parse_case(STORED["two equal discs"]["case"] | changes)


def test_a_revision_concerns_only_the_cases_that_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    changes = {1: lambda case: True, 7: lambda case: case["nodes"]["source"] == "gmsh"}
    monkeypatch.setattr(revision, "CHANGES", changes)
    assert revision_of(discs().tree()) == 1
    assert revision_of(discs(nodes={"source": "gmsh", "spacing": 1.0}).tree()) == 7


def test_every_case_has_a_revision() -> None:
    numbers = {revision_of(parse_case(entry["case"]).tree()) for entry in STORED.values()}
    assert numbers <= set(range(FIRST, REVISION + 1))


def record(directory: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((directory / "run.json").read_text())
    return found


def test_a_run_records_its_revision_and_keeps_the_oldest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = discs()
    main.record_start(tmp_path, case, 1, fresh=True)
    assert (record(tmp_path)["revision"], record(tmp_path)["notes"]) == (revision_of(case.tree()), [])
    main.record_start(tmp_path, case, 1, fresh=False)
    assert record(tmp_path)["notes"] == []
    before = revision_of(case.tree())
    monkeypatch.setattr(revision, "CHANGES", {**revision.CHANGES, 1000: lambda case: True})
    main.record_start(tmp_path, case, 1, fresh=False)
    assert record(tmp_path)["revision"] == before
    assert record(tmp_path)["notes"] == [main.MIXED.format(before=before, now=1000)]
    main.record_start(tmp_path, case, 1, fresh=True)
    assert (record(tmp_path)["revision"], record(tmp_path)["notes"]) == (1000, [])


def test_a_run_of_before_revisions_is_of_the_first() -> None:
    assert revision.recorded({"state": "done"}) == FIRST
    assert revision.recorded({}) is None


# --- the index --------------------------------------------------------------------------------------------


def computed(store: Store, move: Move, by: int | None) -> Job:
    """A job of the two discs that ended so."""
    case = discs()
    queued = done(store.submit(new(1, case=json.dumps(case.tree()))))
    ended = attempted(store, queued, move)
    if by is not None:
        done(store.set_result(ended.seq, {"time": 1.0, "revision": by}))
    return store.job(ended.id)


def shared(store: Store, recompute: bool = False) -> Job:
    """The job that a sweep over this case alone gets."""
    point = NewPoint(new(1, case=json.dumps(discs().tree())), {})
    sweep = done(store.submit_sweep("a", "{}", [point], recompute=recompute))
    (got,) = store.sweep_points(sweep.id)
    return got.job


NOW = revision_of(discs().tree())


@pytest.mark.parametrize("recompute", [False, True])
def test_what_this_revision_computed_is_never_computed_again(tmp_path: Path, recompute: bool) -> None:
    with opened(tmp_path) as store:
        first = computed(store, Move.SUCCEED, NOW)
        assert first.older is None
        assert shared(store, recompute).id == first.id


def test_what_another_revision_computed_stands_in_until_it_is_asked_for_anew(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        first = computed(store, Move.SUCCEED, OTHER)
        assert first.older == OTHER
        assert shared(store).id == first.id
        again = shared(store, recompute=True)
        assert (again.id, again.state, again.older) == (f"{first.id}-2", State.QUEUED, None)
        assert shared(store, recompute=True).id == again.id  # asked for twice it is computed once
        assert shared(store).id == again.id  # what is on its way is better than what is old
        assert store.job(first.id).state is State.SUCCEEDED
        assert store.identities([first.identity])[first.identity].id == again.id
        assert store.counts()["queued"] == 1


@pytest.mark.parametrize("move", [Move.FAIL, Move.STOP, Move.TIME_OUT])
def test_what_another_revision_could_not_compute_is_tried_from_the_start(tmp_path: Path, move: Move) -> None:
    """A checkpoint of another revision would make results of two."""
    with opened(tmp_path) as store:
        first = computed(store, move, OTHER)
        again = shared(store)
        assert (again.id, again.state, again.attempt) == (f"{first.id}-2", State.QUEUED, 0)
        assert store.job(first.id).state is first.state


def test_a_failure_of_this_revision_comes_again_and_is_not_tried(tmp_path: Path) -> None:
    with opened(tmp_path) as store:
        first = computed(store, Move.FAIL, NOW)
        assert shared(store, recompute=True).id == first.id
        assert store.job(first.id).state is State.FAILED
