"""From run directories into the index: rows as they are written, files that are replaced, damage that stops nobody."""

import asyncio
import json
from pathlib import Path

import pytest
from engines import finished, job, settings, stand_in, submit, until
from launching import PAIR

from frit.service.index.results import Reader
from frit.service.jobs.engine import Engine
from frit.service.jobs.runner import read_exit
from frit.service.jobs.states import Move, State


def row(time: float) -> str:
    return json.dumps({"time": time, "vacancy_ratio": 0.5, "step": int(10 * time), "volumes": [1.0]})


def write(directory: Path, *lines: str) -> None:
    """As a resumed run does: beside, and renamed."""
    beside = directory / "history.jsonl.new"
    beside.write_text("".join(f"{line}\n" for line in lines))
    beside.replace(directory / "history.jsonl")


def test_rows_are_read_once_and_only_when_whole(tmp_path: Path) -> None:
    reader = Reader(tmp_path, "{}")
    assert reader.news() == ([], [])
    write(tmp_path, row(0.0), row(1.0))
    assert reader.news() == ([(0, row(0.0)), (1, row(1.0))], [])
    with open(tmp_path / "history.jsonl", "a") as file:
        file.write(row(2.0))
        file.flush()
        assert reader.news() == ([], [])
        file.write("\n")
    assert reader.news() == ([(2, row(2.0))], [])
    assert reader.result() == {"time": 2.0, "vacancy_ratio": 0.5, "step": 20}


def test_a_history_that_was_replaced_is_read_from_its_start(tmp_path: Path) -> None:
    reader = Reader(tmp_path, "{}")
    write(tmp_path, row(0.0), row(1.0), row(2.0))
    reader.news()
    write(tmp_path, row(0.0), row(1.0), row(2.0), row(3.0))  # longer, and another file
    assert [number for number, _ in reader.news()[0]] == [0, 1, 2, 3]


DAMAGE = ["", "\0\0\0\0", "7", "[]", '{"step": 1}', '{"time": "now"}', '{"time": NaN}', '{"time": null}', '{"time": 1']


@pytest.mark.parametrize("line", DAMAGE)
def test_a_damaged_row_is_named(tmp_path: Path, line: str) -> None:
    write(tmp_path, row(0.0), line)
    with pytest.raises(ValueError, match=r"history\.jsonl: row 1 is damaged"):
        Reader(tmp_path, "{}").news()


UNREADABLE = ['{"attempt": 2}', '{"attempt": 2, "move": "fly"}', '{"attempt": 2, "move": "stop", "x": 1}', "", "[]"]


@pytest.mark.parametrize("text", UNREADABLE)
def test_a_damaged_exit_record_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "exit.json").write_text(text)
    assert read_exit(tmp_path, 2) is None


def test_an_exit_record_is_of_one_attempt(tmp_path: Path) -> None:
    record = {"attempt": 2, "move": "stop", "message": None, "ended": 1.0, "core_seconds": 2.0}
    (tmp_path / "exit.json").write_text(json.dumps(record))
    assert read_exit(tmp_path, 1) is None
    assert (end := read_exit(tmp_path, 2)) is not None
    assert end.move is Move.STOP


@pytest.mark.parametrize("line", ["\0\0\0", '{"step": 1}'])
def test_a_damaged_history_keeps_no_other_job_waiting_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    script = stand_in(tmp_path / "bin")
    hold = script.with_name("hold")
    hold.touch()
    monkeypatch.setenv("FRIT_MPIRUN", str(script))

    async def serve() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            bad = await submit(engine, job(PAIR, "bad"))
            good = await submit(engine, job({**PAIR, "model": {"A": 15.0}}, "good"))
            await until(lambda: engine.store.count(State.RUNNING) == 2)
            write(engine.run_directory(bad.id), row(0.0), line)
            await asyncio.sleep(0.2)  # some looks
            write(engine.run_directory(good.id), row(0.0), row(1.0))
            await until(lambda: len(engine.store.history(good.id)) == 2)
            hold.unlink()
            await until(lambda: finished(engine))
            assert [engine.store.job(each.id).state for each in (bad, good)] == [State.SUCCEEDED] * 2
            assert engine.store.job(good.id).result["time"] == 1.0

    asyncio.run(serve())


def test_a_cancel_before_there_is_a_run_directory_is_obeyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = stand_in(tmp_path / "bin")
    script.with_name("hold").touch()
    monkeypatch.setenv("FRIT_MPIRUN", str(script))

    async def serve() -> None:
        async with Engine(settings(tmp_path / "data")) as engine:
            for number in range(10):
                made = await submit(engine, job({**PAIR, "model": {"A": 15.0 + number}}, "unwanted"))
                while engine.store.job(made.id).state is State.QUEUED:
                    await asyncio.sleep(0)
                await engine.cancel(made.id)
            await until(lambda: finished(engine))
            assert engine.store.counts()["cancelled"] == 10

    asyncio.run(serve())
