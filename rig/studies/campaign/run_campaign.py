"""A campaign from its matrix to its rows: what is finished already is not done again."""
from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from rig.network.clock import WallClock
from rig.studies.campaign import workers
from rig.studies.campaign.case import FAILED, Row, find_work, sources
from rig.studies.campaign.folder import Folder, arrow
from rig.studies.campaign.matrix import Case, Matrix


class Progress(NamedTuple):
    """How far a campaign is."""

    done: int
    total: int
    failed: int  # of those done now
    left: float  # s, about


class Hands(NamedTuple):
    """Who does the work."""

    jobs: int = 1  # processes of our own; 1 is this one
    scheduler: str = ""  # address of a Dask scheduler, in place of these


Tell = Callable[[Progress], None]


def run(matrix: Matrix, folder: str | Path, hands: Hands, tell: Tell = lambda _: None, most: int | None = None,
        again: bool = False) -> list[Row]:
    """Do what is left of the first `most` cases (default: all), and write results.parquet, finished or interrupted.

    Args:
        matrix: what to do.
        folder: where, new or of this matrix.
        hands: by whom.
        tell: is told after each case.
        most: stop after so many cases of the matrix, those done before included.
        again: do failed cases once more.

    Returns:
        The rows of all finished cases, in the matrix's order.

    Raises:
        InputError: a folder of something else, no such judgement, no cluster there, or a missing extra.
        RigError: the cluster is gone.
    """
    find_work(matrix.spec["work"])
    arrow()
    code = sources()
    with Folder(folder, matrix, code, again) as results:
        wanted = matrix.cases[:most]
        left = [case for case in wanted if case.number not in results.rows]
        try:
            if left:
                _do(left, matrix, code, results, hands, _Timed(len(wanted), len(left), tell))
        finally:
            results.finish()
        return [results.rows[number] for number in sorted(results.rows)]


def _do(left: list[Case], matrix: Matrix, code: str, results: Folder, hands: Hands, told: _Timed) -> None:
    with _rows(left, matrix, code, hands) as rows:
        for row in rows:
            results.add(row)
            told(row)


@contextlib.contextmanager
def _rows(left: list[Case], matrix: Matrix, code: str, hands: Hands) -> Iterator[Iterator[Row]]:
    if hands.scheduler:
        with workers.at(hands.scheduler) as client:
            yield workers.by(client, left, matrix.spec, code)
    elif min(hands.jobs, len(left)) > 1:
        with workers.own(min(hands.jobs, len(left))) as client:
            yield workers.by(client, left, matrix.spec, code)
    else:
        yield workers.here(left, matrix.spec, code)


class _Timed:
    """Counts cases, and says how long the rest takes at the pace so far."""

    def __init__(self, total: int, left: int, tell: Tell) -> None:
        self.total, self.left, self.tell = total, left, tell
        self.clock, self.fresh, self.failed = WallClock(), 0, 0

    def __call__(self, row: Row) -> None:
        self.fresh += 1
        self.failed += row["status"] == FAILED
        remaining = self.left - self.fresh
        pace = self.clock.now() * 1e-9 / self.fresh
        self.tell(Progress(self.total - remaining, self.total, self.failed, pace * remaining))
