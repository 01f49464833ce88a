"""A child process with a session of its own, whose words come through a pipe: forked by hand.

`subprocess` does the same at three times the processor time where something is to be called before the exec, and a
runner does nothing else.
"""

import ctypes
import os
import select
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NoReturn

PR_SET_PDEATHSIG = 1
prctl = ctypes.CDLL(None).prctl
UNHEARD = 127  # exit status where the program cannot be executed


class Child:
    """A program from its start on, and what it and its own children say until none of them holds the pipe."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], first: Callable[[], None] | None = None
    ) -> None:
        """first: called in the new process before it is the program. Raises `OSError` where nothing can be forked."""
        read, write = os.pipe()
        self.returncode: int | None = None  # negative: the signal that ended it
        self.pid = os.fork()
        if self.pid == 0:
            become(command, environment, write, first)
        os.close(write)
        self._process, self._words, self._rest = os.pidfd_open(self.pid), read, b""
        self._handles = threading.Lock()  # a signal comes from any thread, and never after `close`
        self._open = True  # whether anybody holds the pipe
        self._said: deque[str] = deque()  # and not yet passed on

    def lines(self, ended: Callable[[], None]) -> Iterator[str]:
        """What is said, until it has ended and nobody holds the pipe; `ended` is called once it has ended."""
        happened = select.poll()
        if self.returncode is None:
            happened.register(self._process, select.POLLIN)
        if self._open:
            happened.register(self._words, select.POLLIN)
        while self._said or self.returncode is None or self._open:
            if self._said:
                yield self._said.popleft()
                continue
            ready = [handle for handle, _ in happened.poll()]
            if self._words in ready:
                if not (data := os.read(self._words, 65_536)):
                    self._open = False
                    happened.unregister(self._words)
                *whole, self._rest = (self._rest + data).split(b"\n")
                if not data and self._rest:  # the last words had no end
                    whole = [self._rest]
                self._said.extend(line.decode(errors="replace") for line in whole)
            elif self._process in ready:
                happened.unregister(self._process)
                self.wait()
                ended()

    def wait(self) -> int:
        """Its exit status once it has ended; by one thread only."""
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.returncode

    def send(self, number: signal.Signals) -> None:
        """A signal, if it lives: a reused pid is never hit, nor a handle that has become another's."""
        with self._handles, suppress(ProcessLookupError):
            if self._process >= 0:
                signal.pidfd_send_signal(self._process, number)

    def close(self) -> None:
        """Once it has ended."""
        with self._handles:
            os.close(self._words)
            os.close(self._process)
            self._process = -1


def become(
    command: Sequence[str], environment: Mapping[str, str], output: int, first: Callable[[], None] | None
) -> NoReturn:
    """Turn the process that was just forked into the program."""
    try:
        if first is not None:
            first()
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDONLY)
        for source, target in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(source, target)
        for ignored in (signal.SIGPIPE, signal.SIGXFSZ):  # by Python, not by who starts it
            signal.signal(ignored, signal.SIG_DFL)
        os.execvpe(command[0], list(command), dict(environment))
    except OSError as error:
        os.write(2, f"{command[0]}: {error.strerror}\n".encode())
    finally:
        os._exit(UNHEARD)


def die_with(parent: int, number: signal.Signals) -> Callable[[], None]:
    """For the child after the fork: get this signal when the parent is killed."""

    def tie() -> None:
        prctl(PR_SET_PDEATHSIG, number, 0, 0, 0)
        if os.getppid() != parent:  # it died before the line above
            os._exit(1)

    return tie
