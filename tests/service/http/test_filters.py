"""Which jobs a list has, in which order: against plain Python over the same jobs."""

import json
import random
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frit.service.http import filters
from frit.service.http.problems import HttpError
from frit.service.index.records import NewPoint
from frit.service.index.schema import jobs
from frit.service.index.store import Store
from frit.service.jobs.states import Job, NewJob, State
from frit.solver.case import parse_case
from frit.solver.variations import case_text, identity, written

RADII = (8.0, 9.5, 10.0, 1 / 3 + 9, 12.0)


def packing(radius: float | None, seed: int, enabled: bool) -> tuple[str, str]:
    """A resolved case and its identity; without a radius: a list of discs."""
    particles: dict[str, Any] = {
        "source": "packing", "mean_radius": radius, "packing_density": 0.4, "seed": seed,
        "container": [[5.0, 5.0], [95.0, 55.0]],
    }  # fmt: skip
    if radius is None:
        particles = {"centres": [[30.0, 30.0]], "radii": [20.0 + seed / 100]}
    case = parse_case(
        {"domain": {"size": [100.0, 60.0]}, "nodes": {"spacing": 1.0}, "particles": particles, "time": {"end": 1.0},
         "activation": {"enabled": enabled}}
    )  # fmt: skip
    texts = {name: written(table) for name, table in case.tables().items()}
    return case_text(case.name, texts), identity(texts)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """60 jobs of every kind, some with results, half of them in a sweep."""
    opened = Store(tmp_path_factory.mktemp("index"))
    dice, points = random.Random(1), []
    for number in range(60):
        case, hashed = packing(dice.choice([*RADII, None]), number, dice.random() < 0.5)
        tags = tuple(tag for tag in ('a,"b', "a", "b") if dice.random() < 0.4)
        job = NewJob(case, hashed, f"job {number % 7}", ranks=1 + number % 3, priority=dice.randrange(3), tags=tags)
        made = opened.submit(job).result()
        if number % 2:
            points.append(NewPoint(job, {}))
        if number % 3:
            result = {"vacancy_ratio": dice.random(), "packing": {"packing_density": dice.random()}}
            opened.set_result(made.seq, result).result()
        if number % 5 == 0:
            opened.cancel(made.id).result()
    opened.submit_sweep("half", "{}", points).result()
    yield opened
    opened.close()


def found(store: Store, **query: str) -> list[Job]:
    """All jobs that a query gives, over pages of 7."""
    given, place = [*query.items(), ("limit", "7")], list[tuple[str, str]]()
    rows: list[Job] = []
    while True:
        selection = filters.select([*given, *place], lambda name: store.sweep(name).seq)
        value = None if selection.scalar is None else selection.scalar.sql
        page = store.page(selection.where, selection.order, selection.limit + 1, value, selection.few, selection.near)
        rows += [job for job, _ in page[:7]]
        if len(page) <= 7:
            return rows
        place = [("cursor", filters.cursor(selection, *page[6]))]


def everything(store: Store) -> list[Job]:
    return store.jobs(limit=1000)


def value_of(job: Job, key: str) -> Any:
    """Of a dotted key, as a reader of the JSON sees it."""
    if not key.startswith(("particles.", "result.", "nodes.", "activation.")):
        return getattr(job, key)
    node: Any = {**json.loads(job.case), "result": job.result}
    for part in key.split("."):
        node = node.get(part) if isinstance(node, dict) else None
    return node


def same(store: Store, fits: Callable[[Job], bool], **query: str) -> None:
    """The query gives the jobs that fit, newest first."""
    expected = [job.seq for job in everything(store) if fits(job)]
    assert expected, "the question is empty"
    assert [job.seq for job in found(store, **query)] == expected


def test_without_a_filter_all_jobs_come_newest_first(store: Store) -> None:
    same(store, lambda job: True)


@pytest.mark.parametrize("verb", ["ne", "lt", "le", "gt", "ge"])
@pytest.mark.parametrize("key", ["particles.mean_radius", "result.packing.packing_density", "priority"])
def test_comparisons_of_numbers(store: Store, key: str, verb: str) -> None:
    value = {"priority": 1.0}.get(key, RADII[3] if key.startswith("p") else 0.5)

    def fits(job: Job) -> bool:
        mine = value_of(job, key)
        return mine is not None and bool(filters.COMPARE[verb](mine, value))

    same(store, fits, **{f"{key}.{verb}": repr(value)})


def test_equality_of_every_type(store: Store) -> None:
    radius = "particles.mean_radius"
    same(store, lambda job: value_of(job, radius) == RADII[3], **{radius: repr(RADII[3])})
    same(store, lambda job: value_of(job, radius) == 8.0, **{radius: "8"})
    same(store, lambda job: value_of(job, "particles.seed") == 3, **{"particles.seed": "3.0"})
    same(store, lambda job: value_of(job, "particles.source") == "list", **{"particles.source": "list"})
    same(store, lambda job: value_of(job, "activation.enabled") is True, **{"activation.enabled": "true"})
    same(store, lambda job: value_of(job, "activation.enabled") is False, **{"activation.enabled.ne": "true"})
    same(store, lambda job: job.name == "job 3", name="job 3")


def test_sets_of_values(store: Store) -> None:
    radius = "particles.mean_radius"
    same(store, lambda job: value_of(job, radius) in (8.0, 12.0), **{f"{radius}.in": "8,12.0"})
    same(store, lambda job: job.state in ("queued", "cancelled"), state="queued,cancelled")
    same(store, lambda job: job.state == "cancelled", state="cancelled")


@pytest.mark.parametrize("tag", ["a", "b", 'a,"b'])
def test_a_tag_is_matched_whole(store: Store, tag: str) -> None:
    same(store, lambda job: tag in job.tags, tag=tag)
    assert found(store, tag=",") == []


def test_filters_all_have_to_fit(store: Store) -> None:
    def fits(job: Job) -> bool:
        return 9 <= (value_of(job, "particles.mean_radius") or 0) < 11 and job.state == "queued" and "a" in job.tags

    query = {"particles.mean_radius.ge": "9", "particles.mean_radius.lt": "11", "state": "queued", "tag": "a"}
    same(store, fits, **query)


def test_jobs_of_a_sweep(store: Store) -> None:
    mine = {point.job.seq for point in store.sweep_points("half")}
    same(store, lambda job: job.seq in mine, sweep="half")
    same(store, lambda job: job.seq in mine, sweep="s1")


def test_times_are_told_in_words_or_seconds(store: Store) -> None:
    middle = everything(store)[30]
    same(store, lambda job: job.created >= middle.created, **{"created.ge": repr(middle.created)})
    same(store, lambda job: True, **{"created.ge": "2020-01-01T00:00:00Z"})
    assert found(store, **{"created.lt": "2020-01-01"}) == []


ORDERS = ("priority", "state", "name", "ended", "particles.mean_radius", "result.vacancy_ratio", "created",
          "particles.source")  # fmt: skip


@pytest.mark.parametrize("sign", ["", "-"])
@pytest.mark.parametrize("key", ORDERS)
def test_pages_in_any_order_hold_every_job_once(store: Store, key: str, sign: str) -> None:
    """NULL comes first, as the smallest; ties are in the order of submission."""
    everyone = sorted(everything(store), key=lambda job: job.seq)

    def place(job: Job) -> Any:
        value = value_of(job, key)
        return (value is not None, value, job.seq) if value is not None else (False, 0, job.seq)

    expected = sorted(everyone, key=place, reverse=bool(sign))
    assert [job.seq for job in found(store, order=f"{sign}{key}")] == [job.seq for job in expected]


def test_jobs_that_come_in_between_are_on_no_later_page(tmp_path: Path) -> None:
    opened = Store(tmp_path)
    case, hashed = packing(None, 1, True)
    for _ in range(4):
        opened.submit(NewJob(case, hashed, "")).result()
    selection = filters.select([("limit", "2")], lambda name: 0)
    first = opened.page(selection.where, selection.order, 2, None)
    opened.submit(NewJob(case, hashed, "")).result()
    place = filters.cursor(selection, *first[-1])
    following = filters.select([("limit", "5"), ("cursor", place)], lambda name: 0)
    second = opened.page(following.where, following.order, 5, None)
    assert [job.seq for job, _ in first + second] == [4, 3, 2, 1]
    opened.close()


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("particles.mean_radus", "1", "did you mean particles.mean_radius?"),
        ("mean_radius", "1", "did you mean particles.mean_radius?"),
        ("result.vacancy_ration", "1", "did you mean result.vacancy_ratio?"),
        ("staet", "queued", "did you mean state?"),
        ("particles.centres", "1", "unknown key"),
        ("particles.mean_radius.gte", "1", "unknown key"),
        ("result.packing.x'); DROP TABLE jobs; --", "1", "unknown key"),
        ("particles.mean_radius.ge", "big", "must be a finite number"),
        ("particles.mean_radius.in", "1,,2", "must be a finite number"),
        ("particles.seed", "nan", "must be a finite number"),
        ("created.ge", "yesterday", "must be a time"),
        ("particles.source.gt", "list", "only eq, ne and in"),
        ("activation.enabled", "1", "must be true or false"),
        ("state", "asleep", "must be one of queued"),
        ("order", "-nothing", "unknown key"),
        ("limit", "0", "from 1 to 500"),
        ("limit", "501", "from 1 to 500"),
        ("cursor", "abc", "must come from the page before"),
        ("cursor", "WyJuYW1lIiwxLG51bGxd", "must come from the page before"),
    ],
)
def test_what_is_no_filter_is_refused(name: str, value: str, allowed: str) -> None:
    with pytest.raises(HttpError) as refused:
        filters.select([(name, value)], lambda name: 0)
    (wrong,) = refused.value.details.errors
    assert wrong.parameter == name
    assert allowed in wrong.detail


@given(st.text(max_size=60), st.text(max_size=40))
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_no_parameter_breaks_the_query(store: Store, name: str, value: str) -> None:
    with suppress(HttpError):
        selection = filters.select([(name, value)], lambda name: 0)
        store.page(selection.where, selection.order, selection.limit, None)


@given(st.text(alphabet="ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_=", min_size=1, max_size=60))
@settings(max_examples=100, deadline=None)
def test_no_cursor_breaks_the_query(text: str) -> None:
    with pytest.raises(HttpError):
        filters.select([("cursor", text), ("order", "name")], lambda name: 0)


def plan(store: Store, *parameters: tuple[str, str]) -> str:
    """How SQLite goes about choosing the page."""
    selection = filters.select(parameters, lambda name: 1)
    query = sa.select(jobs.c.seq).where(selection.where).limit(51)
    query = query if selection.few else query.order_by(*selection.order)
    text = str(query.compile(dialect=sa.create_engine("sqlite://").dialect, compile_kwargs={"literal_binds": True}))
    with store.reading() as connection:
        return " / ".join(row.detail for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {text}"))


@pytest.mark.parametrize("key", filters.INDEXED)
def test_what_sweeps_are_made_of_and_lead_to_is_found_by_an_index(store: Store, key: str) -> None:
    index = f"USING INDEX ix_jobs_{key.rpartition('.')[2]}"
    assert f"SEARCH jobs {index}" in plan(store, (f"{key}.ge", "0.9"), ("state", "succeeded"))
    assert f"SEARCH jobs {index}" in plan(store, (key, "0.9"))
    assert index in plan(store, ("order", f"-{key}"))
    assert "TEMP B-TREE" not in plan(store, ("order", f"-{key}"), ("state", "succeeded"))


def test_few_and_many_jobs_that_fit_are_found_alike(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    query = {"particles.mean_radius.ge": "9"}
    few = [job.seq for job in found(store, **query)]
    monkeypatch.setattr("frit.service.index.queries.FEW", 3)
    assert [job.seq for job in found(store, **query)] == few
    monkeypatch.setattr("frit.service.http.filters.NEAR", 2)
    assert [job.seq for job in found(store, **query)] == few


def test_a_state_is_found_by_an_index_in_the_order_of_the_page(store: Store) -> None:
    shown = plan(store, ("state", State.QUEUED))
    assert "INDEX ix_jobs_state_seq" in shown
    assert "TEMP B-TREE" not in shown
    assert "TEMP B-TREE" not in plan(store)
