"""Nasty requests against a real `frit serve`, while another process asks `/livez` all the time.

What was slow is sent again, alone: a busy machine makes a request slow once, a bad service each time. The best of
`TRIES` counts, for the request as for `/livez` beside it.
"""

import http.client
import os
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from asking import TIMEOUT, free_port, until
from nasty import Nasty

TRIES = 4
SLOW, BLOCKED = 2.0, 0.25  # seconds: of an answer, of /livez beside it

# Prints "begin end" of each answer of /livez, on the machine's monotonic clock.
PULSE = """
import http.client, sys, time
connection = http.client.HTTPConnection("127.0.0.1", int(sys.argv[1]), timeout=60)
while True:
    begin = time.monotonic()
    connection.request("GET", "/livez")
    answer = connection.getresponse()
    answer.read()
    assert answer.status == 200
    print(begin, time.monotonic(), flush=True)
    time.sleep(0.005)
"""


@dataclass
class Found:
    """What came of a run."""

    statuses: Counter[int] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)
    slowest: dict[str, float] = field(default_factory=lambda: defaultdict(float))  # seconds, by kind
    blocked: dict[str, float] = field(default_factory=lambda: defaultdict(float))  # of /livez, by kind
    first: int = 0  # bytes of memory of the service
    last: int = 0


class Target:
    """The service under fire, and its pulse."""

    def __init__(self, process: psutil.Process, port: int, pulse: Path, secret: str) -> None:
        self.process, self.port, self.secret, self._pulse = process, port, secret, pulse
        self._read = 0  # bytes of the pulse
        self.places = {"{job}": "none", "{sweep}": "none"}

    def send(self, nasty: Nasty) -> tuple[int, bytes, float]:
        """Status, body and seconds; status 0: no answer."""
        path = nasty.path
        for word, place in self.places.items():
            path = path.replace(word, place)
        headers = {**({"Authorization": f"Bearer {self.secret}"} if nasty.known else {}), **nasty.headers}
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT)) as connection:
            began = time.monotonic()
            try:
                connection.putrequest(nasty.method, path, skip_accept_encoding=True)
                for name, value in {**headers, "Content-Length": str(len(nasty.body))}.items():
                    connection.putheader(name, value.encode("latin-1"))
                connection.endheaders()
                with suppress(BrokenPipeError, ConnectionResetError):  # answered before all of it was read
                    connection.send(nasty.body)
                answer = connection.getresponse()
                return answer.status, answer.read(), time.monotonic() - began
            except http.client.InvalidURL:
                return 400, b"", 0.0
            except (OSError, http.client.HTTPException) as error:
                return 0, repr(error).encode(), time.monotonic() - began

    def silence(self, since: float) -> float:
        """The longest that /livez took from then to now, seconds: all that was asked before now is answered."""
        now, longest = time.monotonic(), 0.0
        while True:
            for begin, end in self._beats():
                if end >= since:
                    longest = max(longest, end - begin)
                if begin >= now:
                    return longest
            time.sleep(0.002)

    def _beats(self) -> list[tuple[float, float]]:
        """What has come since the last look: begin and end of answers."""
        with open(self._pulse, "rb") as file:
            file.seek(self._read)
            whole = file.read().rpartition(b"\n")[0]
        self._read += len(whole) + 1 if whole else 0
        return [(float(begin), float(end)) for begin, end in (line.split() for line in whole.splitlines())]

    def memory(self) -> int:
        return int(self.process.memory_info().rss)


@contextmanager
def target(folder: Path, secret: str, log: Path) -> Iterator[Target]:
    """`frit serve` and its pulse, for the length of a block."""
    port, beats = free_port(), log.with_suffix(".pulse")
    frit = str(Path(sys.executable).parent / "frit")
    with open(log, "wb") as said, open(beats, "wb") as told:
        command = [frit, "serve", "--data", str(folder), "--port", str(port), "--cores", "2"]
        server = subprocess.Popen(command, stdout=said, stderr=said, env=os.environ | {"FRIT_FREE_DISK": "0"})
        try:
            until(lambda: answers(port))
            pulse = subprocess.Popen([sys.executable, "-S", "-c", PULSE, str(port)], stdout=told)
            try:
                yield Target(psutil.Process(server.pid), port, beats, secret)
            finally:
                pulse.kill()
                pulse.wait()
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait(TIMEOUT)


def answers(port: int) -> bool:
    with suppress(OSError), closing(http.client.HTTPConnection("127.0.0.1", port, timeout=5)) as connection:
        connection.request("GET", "/readyz")
        return connection.getresponse().status == 200
    return False


def fire(at: Target, nasties: Iterator[Nasty], found: Found) -> None:
    """Send them one after the other; a limit that is passed is tried again."""
    for nasty in nasties:
        began = time.monotonic()
        status, body, seconds = at.send(nasty)
        silence = at.silence(began)
        found.statuses[status] += 1
        if status == 0 or (status >= 500 and nasty.path != "/readyz"):
            found.broken.append(f"{nasty.kind}: {nasty.method} {nasty.path[:200]}: {status} {body[:300]!r}")
        for _ in range(TRIES - 1):
            if seconds <= SLOW and silence <= BLOCKED:
                break
            time.sleep(0.3)
            began = time.monotonic()
            seconds = min(seconds, at.send(nasty)[2])
            silence = min(silence, at.silence(began))
        found.slowest[nasty.kind] = max(found.slowest[nasty.kind], seconds)
        found.blocked[nasty.kind] = max(found.blocked[nasty.kind], silence)
