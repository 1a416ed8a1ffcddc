"""The score of `rig trend`: `python -m studies.prognosis` follows simulated units of each growth law to their end."""

import argparse
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate, Fault
from fdi.prognosis.trend import fit_trend
from fdi.progress import Progress
from fdi.report import Column, Line, Report, Section, Table, to_plain
from fdi.thresholds import INTERVAL_95_SD, TREND_FEWEST_TRACES
from plant import RigError
from rig.campaign.batch import Workers, run_jobs
from rig.cli import parse_count
from studies.command import report_progress, run_study_command

Floats = NDArray[np.float64]
Law = Callable[[Floats, np.random.Generator], Floats]

INTERVAL = 7.0  # days between traces, on average


class Error(NamedTuple):
    """Error of a refined size: standard deviation `base + share * size`."""

    base: float
    share: float
    common: float  # part of the variance that is the same in all traces of a unit


# as measured with rig fdi on XJ, P12 and XS: twelve traces of each of two units, tolerances of 1.5 %, coloured noise
ERRORS = {CLOGGING.name: Error(0.03, -0.03, 0.995), FRICTION.name: Error(0.0, 0.032, 0.95)}


class Unit(NamedTuple):
    """One unit: the true course of its fault, and the sizes that its traces give."""

    law: str
    fault: Fault
    onset: float  # days
    course_t: Floats  # days
    course: Floats
    t: Floats  # days, times of the traces
    sizes: tuple[Estimate, ...]

    def time_of_size(self, limit: float) -> float:
        """The time at which the size first reaches `limit`, days."""
        return float(self.course_t[int((self.course >= limit * (1.0 - 1e-9)).argmax())])


def grow_linearly(x: Floats, rng: np.random.Generator) -> Floats:
    """In proportion to time; x runs from 0 at the onset to 1 at MaxBand, and so does the result."""
    return x


def grow_exponentially(x: Floats, rng: np.random.Generator) -> Floats:
    """Exponentially, by 1.5 to 4.5 e-foldings."""
    bend = rng.uniform(1.5, 4.5)
    return np.asarray(np.expm1(bend * x) / np.expm1(bend))


def grow_by_power(x: Floats, rng: np.random.Generator) -> Floats:
    """A power of time with an exponent from 0.6 to 2.8."""
    return np.asarray(x ** rng.uniform(0.6, 2.8))


def grow_like_crack(x: Floats, rng: np.random.Generator) -> Floats:
    """At a rate in proportion to the size to the power 1.5, as a crack by the law of Paris with an exponent of 3."""
    start = rng.uniform(0.08, 0.25)
    root = 1.0 - (1.0 - np.sqrt(start)) * x
    return np.asarray((start / root ** 2 - start) / (1.0 - start))


def grow_logistically(x: Floats, rng: np.random.Generator) -> Floats:
    """An S-shaped curve that would flatten at 1.15 to 1.6 times MaxBand."""
    steep, middle = rng.uniform(4.0, 8.0), rng.uniform(0.4, 0.7)
    s = 1.0 / (1.0 + np.exp(-steep * (np.linspace(0.0, 1.5, 3000) - middle)))
    s = s - s[0]
    end = float(np.interp(s[-1] / rng.uniform(1.15, 1.6), s, np.linspace(0.0, 1.5, 3000)))
    grown = np.interp(x * end, np.linspace(0.0, 1.5, 3000), s)
    return np.asarray(grown / grown[-1])


def grow_at_two_rates(x: Floats, rng: np.random.Generator) -> Floats:
    """At two rates: the second one, 1.5 to 4 times the first, begins between 25 % and 60 % of the life."""
    change, ratio = rng.uniform(0.25, 0.6), rng.uniform(1.5, 4.0)
    s = x + (ratio - 1.0) * np.maximum(x - change, 0.0)
    return np.asarray(s / s[-1])


def grow_by_jumps(x: Floats, rng: np.random.Generator) -> Floats:
    """By a gamma process: many small jumps, of which 60 of the mean size reach MaxBand."""
    s = np.cumsum(rng.gamma(60.0 / len(x), size=len(x)))
    return np.asarray(s / s[-1])


FITTED: dict[str, Law] = {"linear": grow_linearly, "exponential": grow_exponentially, "power": grow_by_power}
OTHERS: dict[str, Law] = {"crack": grow_like_crack, "logistic": grow_logistically, "two rates": grow_at_two_rates,
                           "gamma process": grow_by_jumps}
LAWS = FITTED | OTHERS


def simulate_unit(law: str, seed: int) -> Unit:
    """A unit whose fault grows from its onset to MaxBand within 15 to 40 traces.

    The healthy time before the onset is up to 40 % of the time of growth.
    """
    rng = np.random.default_rng([seed, 17])
    fault = (CLOGGING, FRICTION)[seed % 2]
    traces = int(rng.integers(15, 41))
    onset = INTERVAL * traces * rng.uniform(0.0, 0.4)
    life = INTERVAL * traces
    x = np.linspace(0.0, 1.0, 4000)
    course_t = np.concatenate([[0.0], onset + life * x])
    shape = np.concatenate([[0.0], LAWS[law](x, rng)])
    course = fault.healthy + (fault.maintenance - fault.healthy) * shape
    t = np.arange(0.0, onset + life, INTERVAL)
    t = np.sort(np.maximum(t + rng.uniform(-2.0, 2.0, len(t)), 0.0))
    return Unit(law, fault, onset, course_t, course, t, measure_sizes(fault, np.interp(t, course_t, course), rng))


def simulate_healthy_unit(seed: int, traces: int = 25) -> Unit:
    """A unit in which nothing grows."""
    rng = np.random.default_rng([seed, 11])
    fault = (CLOGGING, FRICTION)[seed % 2]
    t = INTERVAL * np.arange(traces) + rng.uniform(-2.0, 2.0, traces)
    true = np.full(traces, fault.healthy)
    return Unit("none", fault, np.inf, t, true, t, measure_sizes(fault, true, rng))


def measure_sizes(fault: Fault, true: Floats, rng: np.random.Generator) -> tuple[Estimate, ...]:
    """The sizes that `rig fdi` would give for true sizes, (n,), in traces of one unit."""
    error = ERRORS[fault.name]
    sigma = error.base + error.share * true
    unit_noise = rng.standard_normal()
    noise = np.sqrt(error.common) * unit_noise + np.sqrt(1.0 - error.common) * rng.standard_normal(len(true))
    sizes = np.maximum(true + sigma * noise, 0.0)  # neither size can be less
    half = INTERVAL_95_SD * (error.base + error.share * sizes)
    return tuple(Estimate(float(x), max(float(x - h), 0.0), float(x + h)) for x, h in zip(sizes, half, strict=True))


Predict = Callable[[Unit, int], "Prediction"]

ALPHA, BETA = 0.2, 0.5
LAMBDAS = (0.25, 0.5, 0.75, 0.9)


class Prediction(NamedTuple):
    """Prediction for a unit after some of its traces: equally probable times left to MidBand and MaxBand, days."""

    has_trend: bool
    middle: Floats
    most: Floats


class Score(NamedTuple):
    """Scores of one unit. NaN where there was no prediction or the limit had passed."""

    law: str
    alpha_lambda: tuple[float, ...]  # 1.0 or 0.0, at each of LAMBDAS
    horizon: float  # time before end of life from which a prediction is good, as a share of the fault's life
    relative: tuple[float, ...]  # 1 - abs(error) / true, at each of LAMBDAS
    held_middle: tuple[float, ...]  # whether the 95 % interval contains the truth, at each of LAMBDAS
    held_most: tuple[float, ...]
    width: tuple[float, ...]  # of the interval to MaxBand over the true time left; infinite ones too
    below: tuple[float, ...]  # 1.0 where MaxBand comes before the interval
    latency: float  # from onset to the first reported trend, as a share of the fault's life


def predict_unit(unit: Unit, traces: int) -> Prediction:
    """The prediction of `follow` from the first `traces` traces."""
    trend = fit_trend(unit.fault, list(unit.t[:traces]), unit.sizes[:traces])
    if not trend.remaining:
        return Prediction(False, np.full(2, np.inf), np.full(2, np.inf))
    return Prediction(trend.verdict == "TREND", trend.remaining["maintenance"].draws,
                      trend.remaining["non_nominal"].draws)


def score_unit(unit: Unit, predict: Predict = predict_unit, every: int = 2) -> Score:
    """Follow a unit from trace to trace, as in service, with a prediction after every `every`-th trace.

    End of life is the time at which the fault reaches MaxBand.
    """
    end, middle = unit.time_of_size(unit.fault.maintenance), unit.time_of_size(unit.fault.acceptable)
    counts = [n for n in range(TREND_FEWEST_TRACES, len(unit.t) + 1, every) if unit.t[n - 1] < end]
    predictions = {n: predict(unit, n) for n in counts}
    with_trend = [n for n in counts if predictions[n].has_trend]
    life = end - unit.onset
    unknown = (np.nan,) * len(LAMBDAS)
    if not with_trend:
        return Score(unit.law, (0.0,) * len(LAMBDAS), 0.0, unknown, unknown, unknown, unknown, unknown, np.nan)

    def time_left(n: int) -> float:
        """The true time to end of life after n traces."""
        return float(end - unit.t[n - 1])

    start = unit.t[with_trend[0] - 1]
    good = [n for n in with_trend if _probability_within(predictions[n].most, time_left(n), ALPHA * end) >= BETA]
    evaluated = [max(n for n in counts if unit.t[n - 1] <= start + x * (end - start) + 1e-9) for x in LAMBDAS]
    forecasts = [(n, predictions[n].most, time_left(n)) for n in evaluated]
    return Score(
        unit.law,
        alpha_lambda=tuple(float(_probability_within(most, truth, ALPHA * truth) >= BETA)
                           for _, most, truth in forecasts),
        horizon=time_left(good[0]) / life if good else 0.0,
        relative=tuple(1.0 - abs(float(np.median(most)) - truth) / truth for _, most, truth in forecasts),
        held_middle=tuple(_is_covered(predictions[n].middle, middle - unit.t[n - 1]) for n in evaluated),
        held_most=tuple(_is_covered(most, truth) for _, most, truth in forecasts),
        width=tuple((high - low) / truth
                    for truth, (low, high) in ((truth, _interval(most)) for _, most, truth in forecasts)),
        below=tuple(float(_interval(most)[0] > truth) for _, most, truth in forecasts),
        latency=(start - unit.onset) / life)


def has_false_trend(seed: int) -> bool:
    """Whether a healthy unit has a trend after all its traces."""
    unit = simulate_healthy_unit(seed)
    return fit_trend(unit.fault, list(unit.t), unit.sizes).verdict == "TREND"


def _probability_within(times: Floats, truth: float, bound: float) -> float:
    """The share of the drawn times within the truth +- bound."""
    return float((np.abs(times - truth) <= bound).mean())


def _interval(times: Floats) -> tuple[float, float]:
    """The 95 % interval of the drawn times."""
    low, high = np.quantile(times, [0.025, 0.975], method="nearest")
    return float(low), float(high)


def _is_covered(times: Floats, truth: float) -> float:
    """1.0 if the 95 % interval contains the truth, else 0.0; NaN for a time that has passed."""
    low, high = _interval(times)
    return np.nan if truth <= 0.0 else float(low <= truth <= high)


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
    jobs = [(law, seed + 1000 * i + k) for i, law in enumerate(LAWS) for k in range(units)]
    healthy = list(range(seed, seed + healthy_ratio * units))
    total = len(jobs) + len(healthy)
    scores = _run_in_order(_score_simulated_unit, jobs, lambda done: progress("units", done / total))
    false_trends = _run_in_order(has_false_trend, healthy,
                                 lambda done: progress("healthy units", (len(jobs) + done) / total))
    groups = {law: [s for s in scores if s.law == law] for law in LAWS}
    groups["laws fitted"] = [s for s in scores if s.law in FITTED]
    groups["other laws"] = [s for s in scores if s.law in OTHERS]
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
    return score_unit(simulate_unit(*job))


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


def build_score_report(scores: Scores) -> Report:
    """Report on the scores; its `data` is the answer of `rig trend --score --json`."""
    marks = " ".join(f"{x:g}".lstrip("0") for x in LAMBDAS)
    titles = ("units", f"alpha-lambda {marks}", "horizon", f"relative accuracy {marks}", "covered, MaxBand",
              "covered, MidBand", "too late", "first trend")
    columns = [Column("true law"), *(Column(title, align="right") for title in titles)]
    caption = (f"At {marks} of the time from onset to MaxBand: share of units whose prediction is within alpha of the "
               "truth, and median relative accuracy. Covered: 95 % intervals that contain the truth; too late: "
               "intervals that begin after it.")
    return Report(
        command="trend", title="score",
        sections=[Section("Scores", [
            Table(columns, [_list_cells(line) for line in scores.lines], caption),
            Line("healthy", f"a trend was reported for {scores.false_trends} of {scores.healthy} healthy units")])],
        data=to_json(scores))


def _list_cells(line: LawScores) -> list[str]:
    return [line.law, str(line.units), _format_values(line.alpha_lambda), f"{line.horizon:.2f}",
            _format_values(line.relative), _format_share(line.held), _format_share(line.held_middle),
            _format_share(line.early), f"{line.latency:.2f}"]


def _format_share(pair: tuple[int, int]) -> str:
    good, of = pair
    return f"{good}/{of} {100 * good / max(of, 1):.0f} %"


def _format_values(values: tuple[float, ...]) -> str:
    return " ".join(f"{x:.2f}" for x in values)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the study."""
    parser.add_argument("--units", type=parse_count, default=20, metavar="N",
                        help="simulated units of each growth law (default 20)")


def score_units(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report of the scores."""
    return build_score_report(score_laws(args.units, args.seed, report_progress)), True


def main(arguments: Sequence[str] | None = None) -> int:
    """Score the method; see --help."""
    return run_study_command("studies.prognosis", __doc__, arguments, add_options, score_units)


if __name__ == "__main__":
    raise SystemExit(main())
