"""The scores of many simulated units, law by law."""
from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi.progress import Progress
from fdi.report.json import to_plain
from plant.errors import RigError
from rig.studies.prognosis import degrading_units
from rig.studies.prognosis.prognosis_score import LAMBDAS, Score, find_false_trends, score_unit
from rig.studies.resumable.batch import Workers, run_jobs


class LawScores(NamedTuple):
    """The scores of all units of a law; tuples are over LAMBDAS."""

    law: str
    units: int
    alpha_lambda: tuple[float, ...]  # share of units within alpha
    horizon: float  # median
    relative: tuple[float, ...]  # median relative accuracy
    held: tuple[int, int]  # 95 % intervals to MaxBand that contain the truth, and their number
    held_middle: tuple[int, int]  # the same to MidBand
    early: tuple[int, int]  # MaxBand came before the interval
    width: tuple[float, ...]  # median width of the interval over the true time left
    latency: float  # median


class Scores(NamedTuple):
    """The scores by law, and the trends reported for healthy units."""

    lines: tuple[LawScores, ...]
    healthy: int  # healthy units
    false_trends: int  # of these with a trend


def score_laws(units: int, seed: int, progress: Progress, healthy_ratio: int = 5) -> Scores:
    """Score `units` units of each law, and `healthy_ratio` times as many healthy units, on all cores."""
    jobs = [(law, seed + 1000 * i + k) for i, law in enumerate(degrading_units.LAWS) for k in range(units)]
    healthy = list(range(seed, seed + healthy_ratio * units))
    total = len(jobs) + len(healthy)
    scores = _run_in_order(_score_simulated_unit, jobs, lambda done: progress("units", done / total))
    false_trends = _run_in_order(_count_false_trends, healthy,
                                 lambda done: progress("healthy units", (len(jobs) + done) / total))
    groups = {law: [s for s in scores if s.law == law] for law in degrading_units.LAWS}
    groups["laws fitted"] = [s for s in scores if s.law in degrading_units.FITTED]
    groups["other laws"] = [s for s in scores if s.law in degrading_units.OTHERS]
    groups["all"] = scores
    return Scores(tuple(summarise_law(law, group) for law, group in groups.items()), len(healthy), sum(false_trends))


def _run_in_order(work: Callable[[Any], Any], jobs: Sequence[Any], progress: Callable[[int], None]) -> list[Any]:
    """The results of all jobs in the order of the jobs."""
    results = {}
    for job, result in run_jobs(work, jobs, Workers(os.cpu_count() or 1), _raise_failure):
        results[job] = result
        progress(len(results))
    return [results[job] for job in jobs]


def _raise_failure(job: object, reason: str) -> Any:
    raise RigError(f"unit {job}: {reason}")


def _score_simulated_unit(job: tuple[str, int]) -> Score:
    return score_unit(degrading_units.simulate_unit(*job))


def _count_false_trends(seed: int) -> int:
    return len(find_false_trends([degrading_units.simulate_healthy_unit(seed)]))


def summarise_law(law: str, group: Sequence[Score]) -> LawScores:
    """The scores of one law; `group` has at least one unit."""
    def reduce_each(name: str, reduce: Callable[..., Any]) -> tuple[float, ...]:
        return tuple(float(x) for x in reduce([getattr(score, name) for score in group], axis=0))

    def count_true(name: str) -> tuple[int, int]:
        values = np.array([getattr(score, name) for score in group])
        return int(np.nansum(values)), int(np.isfinite(values).sum())

    return LawScores(
        law, len(group), reduce_each("alpha_lambda", np.mean), float(np.median([score.horizon for score in group])),
        reduce_each("relative", np.nanmedian), count_true("held_most"), count_true("held_middle"), count_true("below"),
        reduce_each("width", np.nanmedian), float(np.nanmedian([score.latency for score in group])))


def to_json(scores: Scores) -> dict[str, Any]:
    """The scores as JSON values; null for NaN and infinity."""
    content: dict[str, Any] = to_plain({
        "lambda": LAMBDAS, "lines": [line._asdict() for line in scores.lines],
        "healthy": {"units": scores.healthy, "told": scores.false_trends}})
    return content
