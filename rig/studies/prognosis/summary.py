"""The scores of many simulated units, law by law."""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from os import cpu_count
from typing import Any, NamedTuple

import numpy as np

from fdi.progress import Progress
from rig.studies.prognosis import degrading_units
from rig.studies.prognosis.score import LAMBDAS, Score, score, told_without_reason

HEALTHY = 5  # times as many healthy units as of each law


class Line(NamedTuple):
    """Of all units of a law; tuples are over LAMBDAS."""

    law: str
    units: int
    alpha_lambda: tuple[float, ...]  # share of units within alpha
    horizon: float  # median
    relative: tuple[float, ...]  # median relative accuracy
    held: tuple[int, int]  # 95 % intervals to MaxBand that hold the truth, of how many
    held_middle: tuple[int, int]  # the same to MidBand
    early: tuple[int, int]  # MaxBand came before the interval
    width: tuple[float, ...]  # median width of the interval over the true time left
    latency: float  # median


class Scores(NamedTuple):
    """The table, and trends told of healthy units."""

    lines: tuple[Line, ...]
    healthy: int
    told: int


def table(units: int, seed: int, progress: Progress) -> Scores:
    """Score so many units of each law, on all cores."""
    jobs = [(law, seed + 1000 * i + k) for i, law in enumerate(degrading_units.LAWS) for k in range(units)]
    found, told, healthy = [], 0, HEALTHY * units
    with ProcessPoolExecutor(cpu_count(), get_context("spawn")) as pool:
        for i, one in enumerate(pool.map(_unit, jobs)):
            found.append(one)
            progress("units", (i + 1) / (len(jobs) + healthy))
        for i, wrong in enumerate(pool.map(_healthy, range(seed, seed + healthy))):
            told += wrong
            progress("healthy units", (len(jobs) + i + 1) / (len(jobs) + healthy))
    groups = {law: [s for s in found if s.law == law] for law in degrading_units.LAWS}
    groups["laws fitted"] = [s for s in found if s.law in degrading_units.FITTED]
    groups["other laws"] = [s for s in found if s.law in degrading_units.OTHERS]
    groups["all"] = found
    return Scores(tuple(line(law, group) for law, group in groups.items()), healthy, told)


def _unit(job: tuple[str, int]) -> Score:
    return score(degrading_units.unit(*job))


def _healthy(seed: int) -> int:
    return len(told_without_reason([degrading_units.healthy(seed)]))


def line(law: str, group: list[Score]) -> Line:
    """One line of the table, at least one unit."""
    def over(name: str, how: Callable[..., Any]) -> tuple[float, ...]:
        return tuple(float(x) for x in how([getattr(s, name) for s in group], axis=0))

    def count(name: str) -> tuple[int, int]:
        values = np.array([getattr(s, name) for s in group])
        return int(np.nansum(values)), int(np.isfinite(values).sum())

    return Line(law, len(group), over("alpha_lambda", np.mean), float(np.median([s.horizon for s in group])),
                over("relative", np.nanmedian), count("held_most"), count("held_middle"), count("below"),
                over("width", np.nanmedian), float(np.nanmedian([s.latency for s in group])))


def to_json(found: Scores) -> dict[str, Any]:
    """The table as JSON values."""
    rows = [{name: _finite(value) for name, value in one._asdict().items()} for one in found.lines]
    return {"lambda": list(LAMBDAS), "lines": rows, "healthy": {"units": found.healthy, "told": found.told}}


def _finite(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
