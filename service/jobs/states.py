"""Jobs: their states, one sentence each, the moves between them, and the records that travel through the service."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from frit.solver.revision import revision_of

LONGEST_MESSAGE = 500  # characters
PATH = re.compile(r"(?<![^\s'\"`(=:,])/(?:[^\s'\"`(),:;/]+/)+(?=[^\s'\"`(),:;/])")  # all but its last name


class State(StrEnum):
    """What a job is doing. A job in ERROR or LOST goes back to QUEUED while it has attempts left."""

    QUEUED = "queued"
    STARTING = "starting"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    ERROR = "error"
    CANCELLED = "cancelled"
    TIMED_OUT = "timed_out"
    LOST = "lost"

    @property
    def sentence(self) -> str:
        """What it means, for people."""
        return SENTENCES[self]

    @property
    def active(self) -> bool:
        """Whether it has cores."""
        return self in (State.STARTING, State.RUNNING)


SENTENCES: Mapping[State, str] = {
    State.QUEUED: "Accepted and durable; waits for cores.",
    State.STARTING: "Has been given cores; its runner is on the way up.",
    State.RUNNING: "Its runner lives and has recorded itself in the run directory.",
    State.SUCCEEDED: "The solver reached the end of the case.",
    State.FAILED: "It would end so again: a refused case, fields that lost their meaning, too much memory.",
    State.ERROR: "The machinery broke; it is tried again from the last checkpoint while attempts are left.",
    State.CANCELLED: "Somebody asked for its end; what it had computed is kept in a checkpoint.",
    State.TIMED_OUT: "It used up its time limit; what it had computed is kept in a checkpoint.",
    State.LOST: "Its runner vanished without an exit record, and is tried again while attempts are left; "
    "or its run folder was deleted under it.",
}


class Move(StrEnum):
    """What can happen to a job. The second half is what an exit record, or its absence, says."""

    CLAIM = "claim"  # the scheduler gives it cores
    START = "start"  # the runner has recorded itself
    CANCEL = "cancel"  # somebody asks for the end of a job that has no cores
    RETRY = "retry"  # somebody asks for another attempt
    DELETE = "delete"  # somebody wants it gone; there is no state after that
    REQUEUE = "requeue"  # the pause after ERROR or LOST is over
    RELEASE = "release"  # the runner was asked to stop for now
    SUCCEED = "succeed"
    FAIL = "fail"
    BREAK = "break"
    TIME_OUT = "time_out"
    STOP = "stop"  # the runner obeyed a cancel
    LOSE = "lose"


def _ends(state: State) -> dict[tuple[State, Move], State]:
    ends = {
        Move.RELEASE: State.QUEUED,
        Move.SUCCEED: State.SUCCEEDED,
        Move.FAIL: State.FAILED,
        Move.BREAK: State.ERROR,
        Move.TIME_OUT: State.TIMED_OUT,
        Move.STOP: State.CANCELLED,
        Move.LOSE: State.LOST,
    }
    return {(state, move): end for move, end in ends.items()}


TRANSITIONS: Mapping[tuple[State, Move], State] = {
    (State.QUEUED, Move.CLAIM): State.STARTING,
    (State.QUEUED, Move.CANCEL): State.CANCELLED,
    (State.STARTING, Move.START): State.RUNNING,
    **_ends(State.STARTING),
    **_ends(State.RUNNING),
    **{(state, Move.REQUEUE): State.QUEUED for state in (State.ERROR, State.LOST)},
    **{(state, Move.CANCEL): State.CANCELLED for state in (State.ERROR, State.LOST)},
    **{
        (state, Move.RETRY): State.QUEUED
        for state in (State.FAILED, State.ERROR, State.CANCELLED, State.TIMED_OUT, State.LOST)
    },
}


class TransitionError(ValueError):
    """A move that the job's state does not allow."""

    def __init__(self, state: State, move: Move) -> None:
        self.state, self.move = state, move
        allowed = [before for before, m in TRANSITIONS if m == move]
        if move is Move.CANCEL:  # the end of a job that has cores is a wish first, and a move once it is obeyed
            allowed += [before for before in State if before.active]
        if move is Move.DELETE:
            allowed = [before for before in State if before is not State.QUEUED and not before.active]
        words = ", ".join(before for before in allowed if before is not state)
        super().__init__(f"state = '{state}': {move} is possible only from {words}")


def after(state: State, move: Move) -> State:
    """The state a move leads to. Raises `TransitionError`."""
    try:
        return TRANSITIONS[state, move]
    except KeyError:
        raise TransitionError(state, move) from None


@dataclass(frozen=True, slots=True)
class NewJob:
    """What a submission asks for; `case` is the resolved case as compact JSON, `identity` its hash."""

    case: str
    identity: str
    name: str
    ranks: int = 1
    priority: int = 0
    tags: tuple[str, ...] = ()
    time_limit: float | None = None  # wall-clock seconds of one attempt
    owner: str | None = None  # the label of the token that made it
    origin: str | None = None  # the id of the job that this one is a rerun of


@dataclass(frozen=True, slots=True)
class Job:
    """A row of the index. Times are seconds since 1970; `seq` is the order of submission."""

    seq: int
    id: str
    name: str
    identity: str
    state: State
    message: str | None
    priority: int
    ranks: int
    tags: tuple[str, ...]
    time_limit: float | None
    attempt: int  # number of the present or last attempt; 0 before the first
    failures: int  # attempts in a row that broke or were lost and got no further than they began
    retrying: bool  # in ERROR or LOST: another attempt follows by itself
    stopping: bool  # somebody asked for the end of a job that has cores
    created: float
    started: float | None
    ended: float | None
    core_seconds: float | None  # of all attempts
    result: dict[str, Any]  # scalars of the last history row; `packing`: what was realised; `revision` of the results
    case: str
    owner: str | None = None
    origin: str | None = None
    bytes: int | None = None  # of its run directory, at the end of its last attempt

    @property
    def older(self) -> int | None:
        """The revision that computed what there is, where this solver has another for such a case."""
        return older_revision(self.result.get("revision"), self.case)

    @property
    def final(self) -> bool:
        """Whether nothing more happens by itself."""
        return self.state not in (State.QUEUED, State.STARTING, State.RUNNING) and not self.retrying


def older_revision(revision: int | None, case: str | None) -> int | None:
    """The revision that computed a case, where this solver has another for it; None as well: not computed yet.

    case: None where it is known that it does not matter.
    """
    return None if revision is None or case is None or revision == revision_of(json.loads(case)) else revision


class Waiting(NamedTuple):
    """A job in the queue."""

    seq: int
    ranks: int
    owner: str | None = None


@dataclass(frozen=True, slots=True)
class Exit:
    """How an attempt ended: the runner's exit record (`move` is one of the ends)."""

    attempt: int
    move: Move
    message: str | None
    ended: float
    core_seconds: float = 0.0
    advanced: bool = False  # it got further than the checkpoint it began from
    again: bool = True  # whether the job may be tried again by itself


def one_sentence(text: str) -> str:
    """A message that may be shown to anybody: one line without control characters or folders, not too long."""
    line = "".join(letter if letter.isprintable() else " " for letter in text.replace("\n", "; "))
    line = PATH.sub("", " ".join(line.split()))
    return line if len(line) <= LONGEST_MESSAGE else line[: LONGEST_MESSAGE - 3] + "..."
