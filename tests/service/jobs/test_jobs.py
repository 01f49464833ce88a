"""Jobs: which moves each state allows, said a second time in words; sentences; what is final and what has cores."""

import itertools

import pytest

from frit.service.jobs.states import SENTENCES, TRANSITIONS, Job, Move, State, TransitionError, after

# For every state, the moves it allows and where they lead. All else is refused.
ENDS = """
    release -> queued, succeed -> succeeded, fail -> failed, break -> error, time_out -> timed_out,
    stop -> cancelled, lose -> lost
"""
ALLOWED = {
    "queued": "claim -> starting, cancel -> cancelled",
    "starting": "start -> running," + ENDS,
    "running": ENDS,
    "succeeded": "",
    "failed": "retry -> queued",
    "error": "requeue -> queued, retry -> queued, cancel -> cancelled",
    "lost": "requeue -> queued, retry -> queued, cancel -> cancelled",
    "cancelled": "retry -> queued",
    "timed_out": "retry -> queued",
}
EXPECTED = {
    (state, move.strip()): end.strip()
    for state, moves in ALLOWED.items()
    for move, _, end in (one.partition("->") for one in moves.split(",") if one.strip())
}
PAIRS = list(itertools.product(State, Move))


def test_the_states_are_those_of_the_interface() -> None:
    names = "queued, starting, running, succeeded, failed, error, cancelled, timed_out, lost"
    assert sorted(State) == sorted(names.split(", ")) == sorted(ALLOWED)


@pytest.mark.parametrize(("state", "move"), PAIRS, ids=[f"{state}-{move}" for state, move in PAIRS])
def test_each_state_allows_the_moves_of_the_table_and_no_other(state: State, move: Move) -> None:
    if (end := EXPECTED.get((state.value, move.value))) is not None:
        assert after(state, move).value == end
    else:
        with pytest.raises(TransitionError) as refused:
            after(state, move)
        assert f"state = '{state.value}': {move.value} is possible only from " in str(refused.value)
        named = str(refused.value).split("only from ")[1].split(", ")
        assert state.value not in named
        assert {before for before, m in EXPECTED if m == move.value} <= set(named)


def test_a_refused_cancel_names_all_states_in_which_it_is_heeded() -> None:
    with pytest.raises(TransitionError, match=r"only from queued, error, lost, starting, running$"):
        after(State.SUCCEEDED, Move.CANCEL)


def test_no_move_leaves_a_job_where_it_is() -> None:
    assert all(state is not end for (state, _), end in TRANSITIONS.items())


def test_success_is_for_ever_and_every_other_state_is_left_again() -> None:
    left = {state for state, _ in TRANSITIONS}
    assert left == set(State) - {State.SUCCEEDED}


def test_every_state_is_reached_from_the_queue() -> None:
    reached = {State.QUEUED}
    while new := {end for (state, _), end in TRANSITIONS.items() if state in reached} - reached:
        reached |= new
    assert reached == set(State)


@pytest.mark.parametrize("state", State)
def test_every_state_has_one_sentence_of_its_own(state: State) -> None:
    assert state.sentence.endswith(".")
    assert state.sentence.count(".") == 1
    assert list(SENTENCES.values()).count(state.sentence) == 1


@pytest.mark.parametrize(
    ("state", "active", "final"),
    [
        ("queued", False, False),
        ("starting", True, False),
        ("running", True, False),
        ("succeeded", False, True),
        ("failed", False, True),
        ("cancelled", False, True),
        ("timed_out", False, True),
        ("error", False, True),
        ("lost", False, True),
    ],
)
def test_what_has_cores_and_what_is_final(state: str, active: bool, final: bool) -> None:
    assert State(state).active is active
    assert job(State(state)).final is final


@pytest.mark.parametrize("state", [State.ERROR, State.LOST])
def test_a_job_that_is_tried_again_is_not_final(state: State) -> None:
    assert not job(state, retrying=True).final


def job(state: State, retrying: bool = False) -> Job:
    return Job(
        seq=1, id="a", name="a", identity="a", state=state, message=None, priority=0, ranks=1, tags=(),
        time_limit=None, attempt=1, failures=0, retrying=retrying, stopping=False, created=0.0, started=None,
        ended=None, core_seconds=None, result={}, case="{}",
    )  # fmt: skip
