"""Questions about sweeps."""

import json
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from ..jobs.states import older_revision
from .reading import Reading
from .records import MADE_BY, OLD_CASE, POROSITY, Compared, SweepPoint, SweepRecord, find_sweep, record
from .schema import history, jobs, sweep_jobs, sweeps


class SweepQueries(Reading):
    """Part of the store."""

    def sweep(self, identifier: str) -> SweepRecord:
        """By its id, or by its name: then the newest of that name. Raises `NotFoundError`."""
        with self.reading() as connection:
            return find_sweep(connection, identifier)

    def sweeps(self, before: int | None = None, limit: int = 50, owner: str | None = None) -> list[SweepRecord]:
        """Newest first; before: only those with a smaller seq; owner: only those of this one."""
        query = sa.select(sweeps.c.id).order_by(sweeps.c.seq.desc()).limit(limit)
        if before is not None:
            query = query.where(sweeps.c.seq < before)
        if owner is not None:
            query = query.where(sweeps.c.owner == owner)
        with self.reading() as connection:
            return [find_sweep(connection, row.id) for row in connection.execute(query)]

    def sweep_points(self, identifier: str) -> list[SweepPoint]:
        """The jobs of a sweep in its own order."""
        with self.reading() as connection:
            seq = find_sweep(connection, identifier).seq
            named = sa.select(jobs, sweep_jobs.c.position, sweep_jobs.c.name.label("label"), sweep_jobs.c.parameters)
            query = named.join_from(sweep_jobs, jobs).where(sweep_jobs.c.sweep == seq).order_by(sweep_jobs.c.position)
            return [
                SweepPoint(row.position, row.label, row.parameters, record(row)) for row in connection.execute(query)
            ]

    def listing(self) -> list[tuple[str, str, str, str]]:
        """Of every job: id, name, names of its sweeps, state; the oldest first."""
        query = (
            "SELECT jobs.id, jobs.name, ifnull(group_concat(DISTINCT sweeps.name), ''), jobs.state FROM jobs "
            "LEFT JOIN sweep_jobs ON sweep_jobs.job = jobs.seq LEFT JOIN sweeps ON sweeps.seq = sweep_jobs.sweep "
            "GROUP BY jobs.seq ORDER BY jobs.seq"
        )
        return [(row[0], row[1], row[2], row[3]) for row in self._ask(query, ())]

    def new_in_sweeps(self, which: Sequence[int]) -> dict[int, int]:
        """How many jobs of each sweep (by seq) were made with it."""
        query = (
            sa.select(sweep_jobs.c.sweep, sa.func.count()).join_from(sweep_jobs, jobs).join(sweeps)
            .where(sweep_jobs.c.sweep.in_(which), jobs.c.created >= sweeps.c.created).group_by(sweep_jobs.c.sweep)
        )  # fmt: skip
        with self.reading() as connection:
            found = {seq: n for seq, n in connection.execute(query)}
        return {seq: found.get(seq, 0) for seq in which}

    def observables(self, sweep: int) -> list[str]:
        """Names of the scalars in the history rows of a sweep's jobs, as the first row of each has them."""
        mine = sa.select(sweep_jobs.c.job).where(sweep_jobs.c.sweep == sweep)
        each = sa.func.json_each(history.c.data).table_valued("key", "type")
        query = (
            sa.select(each.c.key).distinct().select_from(history).join(each, sa.true())
            .where(history.c.job.in_(mine), history.c.row == 0, each.c.type.in_(["integer", "real", "null"]))
        )  # fmt: skip
        with self.reading() as connection:
            return [row.key for row in connection.execute(query)]

    def compared(self, sweep: int, after: int, limit: int) -> list[Compared]:
        """The jobs of a sweep (by seq), in its own order, from that point on."""
        query = (
            sa.select(jobs.c.seq, jobs.c.id, sweep_jobs.c.name, jobs.c.state, sweep_jobs.c.parameters)
            .add_columns(MADE_BY, OLD_CASE, jobs.c.message, POROSITY)
            .join_from(sweep_jobs, jobs).where(sweep_jobs.c.sweep == sweep).order_by(sweep_jobs.c.position)
            .offset(after).limit(limit)
        )  # fmt: skip
        with self.reading() as connection:
            rows = connection.execute(query).all()
        return [
            Compared(seq, identifier, name, state, parameters, older_revision(revision, case), message, porosity)
            for seq, identifier, name, state, parameters, revision, case, message, porosity in rows
        ]

    def differing(self, sweep: int) -> list[str]:
        """The parameters that are not the same in all points of a sweep (by seq), in the order of its axes."""
        query = (
            "SELECT each.key FROM sweep_jobs, json_each(parameters) AS each WHERE sweep = ? "
            "GROUP BY each.key HAVING count(DISTINCT each.value) > 1 ORDER BY min(position), min(each.id)"
        )
        return [key for (key,) in self._ask(query, (sweep,))]

    def histories(self, which: Sequence[int], most: int) -> dict[int, list[str]]:
        """History rows (JSON) of jobs (by seq): `most` of them, spread over the rows, as `curves` takes them."""
        found: dict[int, list[str]] = {}
        for job, _, line in self._spread(which, "data", None, most):
            found.setdefault(job, []).append(line)
        return found

    def curves(
        self, which: Sequence[int], observable: str, most: int
    ) -> dict[int, tuple[list[float], list[float | None]]]:
        """Times and values of an observable along the history of jobs (by seq): `most` of them, spread over the rows.

        The last row is among them, and every row where there are not more.
        """
        value = f'"{observable}"' if observable in history.c else "json_extract(data, ?1)"
        found: dict[int, tuple[list[float], list[float | None]]] = {}
        for job, at, number in self._spread(which, value, f"$.{observable}", most):
            times, values = found.setdefault(job, ([], []))
            times.append(at)
            values.append(number)
        return found

    def _spread(self, which: Sequence[int], value: str, path: str | None, most: int) -> list[tuple[int, float, Any]]:
        """(job, time, value) of rows of jobs; value: SQL of a row, where ?1 is the path."""
        query = (
            "WITH RECURSIVE each AS MATERIALIZED ("
            "SELECT value AS job, (SELECT max(row) FROM history WHERE job = value) AS last FROM json_each(?3)), "
            "step(n) AS MATERIALIZED (SELECT 0 UNION ALL SELECT n + 1 FROM step WHERE n < ?2) "
            f"SELECT each.job, time, {value} FROM each CROSS JOIN step CROSS JOIN history "
            "ON history.job = each.job AND row = min(n * (last / ?2 + 1), last) "
            "WHERE n = 0 OR (n - 1) * (last / ?2 + 1) < last"
        )  # row by row of one job after the other: nothing is sorted, and no row between is read
        return self._ask(query, (path, most - 1, json.dumps([*which])))
