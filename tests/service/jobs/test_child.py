"""A child process: what it says, how it ended, and signals that reach it and nobody else."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from frit.service.jobs.child import UNHEARD, Child


@contextmanager
def child(script: str) -> Iterator[Child]:
    """A shell with a script; it has ended when the block ends."""
    with closing(Child(["sh", "-c", script], os.environ)) as started:
        yield started
        started.send(signal.SIGKILL)
        started.wait()


def test_every_line_and_the_status() -> None:
    """From both outputs, the last one without a newline, in any encoding; the status comes with the end."""
    ended = []
    with child("echo one; echo two >&2; printf '\\377 three'; exit 7") as process:
        assert list(process.lines(lambda: ended.append(process.returncode))) == ["one", "two", "\ufffd three"]
        assert process.wait() == 7
    assert ended == [7]


def test_what_its_children_say_after_it_has_ended_is_heard() -> None:
    """The pipe is open as long as anybody holds it; `ended` is called before that."""
    order = []
    with child("(sleep 0.3; echo later) & echo first; exit 0") as process:
        for line in process.lines(lambda: order.append("ended")):
            order.append(line)
    assert order == ["first", "ended", "later"]


def test_a_command_that_is_not_there() -> None:
    with closing(Child(["/no/such/program"], os.environ)) as process:
        assert list(process.lines(lambda: None)) == ["/no/such/program: No such file or directory"]
        assert process.wait() == UNHEARD


def test_a_session_of_its_own_without_our_input() -> None:
    """Its session is not ours, nobody's words are its input, and a closed pipe ends it as it ends other programs."""
    with child("ps -o sid= -p $$ 2>/dev/null || cut -d' ' -f6 /proc/$$/stat; cat; trap") as process:
        lines = list(process.lines(lambda: None))
        assert [int(line) for line in lines] == [process.pid] != [os.getsid(0)]


def test_signals() -> None:
    """The status tells the signal; signals to the dead and to the closed go nowhere."""
    with child("sleep 60") as process:
        process.send(signal.SIGTERM)
        assert list(process.lines(lambda: None)) == []
        assert process.returncode == -signal.SIGTERM
        process.send(signal.SIGKILL)
    read, write = os.pipe()  # a handle that may have the number of the closed one
    process.send(signal.SIGKILL)
    os.close(read)
    os.close(write)


def test_what_is_called_first_and_fails_ends_the_child() -> None:
    """Nothing of the parent's program runs on in the child."""

    def fail() -> None:
        raise OSError(5, "no")

    with closing(Child(["sh", "-c", "echo here"], os.environ, fail)) as process:
        list(process.lines(lambda: None))
        assert process.wait() == UNHEARD


@pytest.mark.parametrize("count", [3])
def test_no_handle_stays_open(count: int) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(count):
        with child("exit 0") as process:
            list(process.lines(lambda: None))
    time.sleep(0.01)
    assert len(os.listdir("/proc/self/fd")) == before
