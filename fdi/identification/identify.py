"""The nominal model of a user's actuator: its parameters from measured runs, and what these runs cannot tell.

The data sheet says where each parameter is about (`free_parameters`). Regressions on the signals give first values
(`estimate_by_regressions`), a fit that begins far away goes on from there (`global_fit`), and the last rounds have fine
steps and the noise that is left. A parameter whose interval stays wide is not identifiable from these runs: it keeps
the data sheet's value, and `experiments` says which run would show it. Held-out runs judge the result.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.discovery.runs import Source
from fdi.discovery.update_model import Provenance, format_model_file
from fdi.estimation import noise as noises
from fdi.estimation.fit import Fit, Value
from fdi.estimation.likelihood import Problem, compute_misfit, compute_typical_rms, limit_friction_values
from fdi.estimation.long_recordings import can_be_cut, choose_excerpt, cut_excerpt, is_long
from fdi.estimation.noise import sensor_floors
from fdi.estimation.replay import differentiate, find_undecided_rows
from fdi.estimation.unidentifiable import LogFrictionRatio, LogProblem, compute_values, start_fit
from fdi.estimation.unknowns import silence_readings
from fdi.identification.experiments import Advice, advise_experiments
from fdi.identification.free_parameters import Range, get_systematic_sd, list_unknowns
from fdi.identification.global_fit import (
    descend,
    fit_from_afar,
    is_fitted,
    polish_fit,
    sample_starts,
    scale_values,
    search_other_valleys,
)
from fdi.output import replace_text
from fdi.progress import Progress, ignore_progress
from fdi.sources import name_software
from fdi.thresholds import (
    FITTED_RUN_WORST,
    HELD_OUT_UNDECIDED_SHARE,
    IDENTIFIABLE_SHARE,
    IDENTIFIED_INTERVAL_FACTOR,
    INTERVAL_95_SD,
    MOVING_RAM,
    RESIDUAL_HELD_OUT,
    RESIDUAL_WORST,
)
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Trace, rms, shift_rows
from plant.model import Model
from plant.threads import count_threads

Floats = NDArray[np.float64]

LAST_STEPS = 50  # solver steps a cycle, of the last rounds
OPEN_MISFIT = 4.0  # -2 log likelihood by which a parameter may go to the end of its range and still not be seen


class Estimate(NamedTuple):
    """A free parameter, SI: the data sheet's value and range, the value found and its 95 % interval."""

    name: str
    unit: str
    before: float
    least: float
    most: float
    value: float
    low: float
    high: float
    is_identifiable: bool
    share: float  # of the range that the interval takes up; of logarithms where the range is relative

    @property
    def is_at_bound(self) -> bool:
        """Whether the interval reaches an end of the range: the data may want to go further."""
        near = 1e-9 * (self.most - self.least)
        return self.is_identifiable and (self.low <= self.least + near or self.high >= self.most - near)


class RunError(NamedTuple):
    """RMS residual of each signal in one run, SI, with the data sheet's model and with the identified one."""

    source: Source
    is_held_out: bool
    before: Mapping[str, float]
    after: Mapping[str, float]
    typical: Mapping[str, float]  # after, without the worst blocks
    floor: Mapping[str, float]
    decided: Mapping[str, float]  # after, of a held-out run without the rows that no model can predict
    undecided: float = 0.0  # share of these rows; 0 for a fitted run

    @property
    def ratio(self) -> float:
        """Error of the worst signal over its noise floor, after."""
        return max(self.after[s] / self.floor[s] for s in self.after)

    @property
    def decided_ratio(self) -> float:
        """The same without the rows that no model can predict, if enough others are left."""
        if self.undecided > HELD_OUT_UNDECIDED_SHARE:
            return self.ratio
        return max(self.decided[s] / self.floor[s] for s in self.decided)


class Correlation(NamedTuple):
    """Two parameters whose errors go together."""

    first: str
    second: str
    value: float


@dataclass(frozen=True, eq=False)
class Identification:
    """What an identification found."""

    verdict: str  # IDENTIFIED, PARTLY, UNEXPLAINED, CANNOT_TELL
    reason: str  # why, where the verdict is not IDENTIFIED
    before: Model  # of the data sheet
    model: Model  # with what was found as its design
    estimates: tuple[Estimate, ...]
    controller: ControllerGains | None
    correlations: tuple[Correlation, ...]  # of identifiable parameters, the strongest first
    advice: tuple[Advice, ...]
    errors: tuple[RunError, ...]
    floor: Mapping[str, float]
    runs: tuple[Trace, ...]  # prepared; the held-out ones last
    residuals: tuple[tuple[Floats, Floats], ...]  # of each run, (s, n) SI: before and after, model minus measured
    sources: tuple[Source, ...]
    notes: tuple[str, ...]

    @property
    def holdouts(self) -> tuple[RunError, ...]:
        """The errors on held-out runs."""
        return tuple(e for e in self.errors if e.is_held_out)


def identify_model(model: Model, ranges: Sequence[Range], fitted: Sequence[Trace], held_out: Sequence[Trace],
                   sources: Sequence[Source], seed: int = 0, progress: Progress = ignore_progress,
                   workers: int | None = None) -> Identification:
    """Fit the free parameters of a model to runs of one actuator.

    Args:
        model: with the values of the data sheet.
        ranges: of the free parameters.
        fitted: runs, prepared for replay, with the same outputs.
        held_out: runs that no fit sees, prepared.
        sources: of all of them, in this order.
        seed: of the scattered starts.
        progress: called with each stage and the share done, 0 to 1.
        workers: threads; default one a core.
    """
    runs = (*fitted, *held_out)
    notes = [f"{source.file}: {note}" for trace, source in zip(runs, sources, strict=True) for note in trace.notes]
    floor = {s: float(np.median([f[s].value for f in (sensor_floors(t, model) for t in fitted)]))
             for s in fitted[0].outputs}
    if not any(_moves(t) for t in fitted):
        reason = f"no run to fit moves the ram by {1e3 * MOVING_RAM:g} mm: at rest nothing can be identified"
        return _tell_nothing(model, ranges, runs, sources, len(fitted), floor, reason, notes)
    gains = read_controller(fitted) if model.kind.controller else None
    free = list_unknowns(model, tuple(ranges))
    progress("regressions", 0.02)
    names = frozenset(f.name for f in free)
    begun = estimate_by_regressions(fitted, model, frozenset(model.values) - names)
    begun = {name: value for name, value in begun.items() if name in names}
    first = replace(model, values=limit_friction_values({**model.values, **begun}))
    parts, remarks = cut_long_runs(fitted, sources, first, floor)
    problem = make_problem(model, parts, floor, workers or count_threads())
    notes += remarks
    starts = sample_starts(free, scale_values(free, {**model.values, **begun}), frozenset(begun), seed)
    fit = fit_from_afar(problem, free, starts, progress)
    progress("which parameters the runs show", 0.65)
    hidden = find_hidden(problem, fit, {r.name: r for r in ranges})
    problem, fit = hold_parameters(problem, fit, {name: value for name, (value, _, _) in hidden.items()})
    progress("last fits, with finer steps", 0.7)
    problem, fit = finish(problem, fit, scale_values(fit.free, {**model.values, **begun}), seed, progress)
    progress("judging", 0.92)
    found = build_model(model, problem, fit, gains)
    estimates, covariance = estimate_parameters(model, ranges, fit, hidden)
    errors, residuals = measure_errors(model, found, runs, sources, len(fitted), floor)
    verdict, reason = decide_verdict(estimates, errors)
    progress("which runs would show more", 0.95)
    unseen = [e.name for e in estimates if not e.is_identifiable]
    advice = advise_experiments(found, list_unknowns(model, tuple(ranges)), problem, fit, unseen) if unseen else ()
    return Identification(verdict, reason, model, found, estimates, gains, list_correlations(estimates, covariance),
                          tuple(advice), errors, floor, runs, residuals, tuple(sources), tuple(notes))


def cut_long_runs(runs: Sequence[Trace], sources: Sequence[Source], model: Model, floor: Mapping[str, float]
                  ) -> tuple[tuple[Trace, ...], list[str]]:
    """The runs to fit, of long ones the part that says most about the parameters; and which part that is, in words.

    Args:
        runs: prepared for replay.
        sources: of them, in this order.
        model: with first values: at those of a data sheet that is several times off, other parts would say most.
        floor: of each signal, SI.
    """
    parts, remarks = [], []
    for trace, source in zip(runs, sources, strict=False):
        if can_be_cut(trace, model):
            excerpt = choose_excerpt(trace, silence_readings(model), floor)
            remarks.append(f"{source.file}: {excerpt.describe(trace)}")
            trace = cut_excerpt(trace, excerpt)
        parts.append(trace)
    return tuple(parts), remarks


def make_problem(model: Model, fitted: Sequence[Trace], floor: Mapping[str, float], workers: int) -> LogProblem:
    """The runs to fit with white noise of the floor's size."""
    noise = tuple(noises.white_noise(floor[s]) for s in fitted[0].outputs)
    return LogProblem(silence_readings(model), fitted[0], noise, workers=workers, also=tuple(fitted[1:]))


def find_hidden(problem: LogProblem, fit: Fit, ranges: Mapping[str, Range]
                ) -> dict[str, tuple[float, float, float]]:
    """Free parameters that no run shows, with the value nearest to the data sheet's, and the values that fit as well.

    An end stop that the ram never met may be anywhere beyond the furthest position. A fit that stands at an end already
    is tried some way inside: what changes there is seen, and only its range is too narrow.
    """
    places = [(k, r) for k, f in enumerate(fit.free) if (r := ranges.get(f.name)) is not None
              and type(f) is not LogFrictionRatio]
    trials = [fit.x]
    for k, _ in places:
        f = fit.free[k]
        low, high = ((end - f.centre) / f.scale for end in (f.low, f.high))
        near, inside = 1e-3 * (high - low), IDENTIFIABLE_SHARE * 0.5 * (high - low)
        trials.append(_put(fit.x, k, low if fit.x[k] - low > near else low + inside))
        trials.append(_put(fit.x, k, high if high - fit.x[k] > near else high - inside))
    costs = compute_misfit(problem.compute_white_residuals(fit.free, np.array(trials)))
    is_open = (np.abs(costs[1:] - costs[0]) < OPEN_MISFIT).reshape(-1, 2)
    found = {}
    for (k, r), (below, above) in zip(places, is_open.tolist(), strict=True):
        if below or above:
            f = fit.free[k]
            low = r.low if below else _find_edge(problem, fit, k, f.low)
            high = r.high if above else _find_edge(problem, fit, k, f.high)
            found[f.name] = (min(max(r.centre, low), high), low, high)
    for k, f in enumerate(fit.free):
        if isinstance(f, LogFrictionRatio) and f.dynamic_name in found:  # it moved as well, and no signal changed
            ratio = f.value(float(fit.x[k]))
            least, most = (ranges[f.name].low, ranges[f.name].high) if f.name in ranges else (0.0, math.inf)
            value, low, high = (min(max(ratio * each, least), most) for each in found[f.dynamic_name])
            found[f.name] = value, low, high
    return found


def _put(x: Floats, k: int, value: float) -> Floats:
    moved = x.copy()
    moved[k] = value
    return moved


def _find_edge(problem: LogProblem, fit: Fit, k: int, end: float, rounds: int = 3, parts: int = 15) -> float:
    """The value of unknown k, SI, between a fit that is well and the `end` of its range where it is not, that divides
    both."""
    f = fit.free[k]
    good, bad = float(fit.x[k]), (end - f.centre) / f.scale
    for _ in range(rounds):
        line = np.linspace(good, bad, parts + 1)
        costs = compute_misfit(problem.compute_white_residuals(
            fit.free, np.array([fit.x, *(_put(fit.x, k, place) for place in line)])))
        seen = np.flatnonzero(costs[1:] - costs[0] >= OPEN_MISFIT)
        if not len(seen):
            break
        first = max(int(seen[0]), 1)
        good, bad = float(line[first - 1]), float(line[first])
    return f.value(good)


def hold_parameters(problem: LogProblem, fit: Fit, held: Mapping[str, float]) -> tuple[LogProblem, Fit]:
    """The problem and the fit without some unknowns, which keep the values in `held`."""
    if not held:
        return problem, fit
    kept = [k for k, f in enumerate(fit.free) if f.name not in held]
    values = limit_friction_values({**problem.model.values, **held})
    fixed = replace(problem, model=replace(problem.model, values=values), _lanes={})
    return fixed, start_fit([fit.free[k] for k in kept], fit.x[kept])


def finish(problem: LogProblem, fit: Fit, begin: Floats, seed: int = 0, progress: Progress = ignore_progress
           ) -> tuple[LogProblem, Fit]:
    """The last rounds, with finer steps; then with the noise that is left, where only noise is left.

    `begin`: the unknowns (p,) where regressions put them, at which a search begins if the fit ended in a local minimum.
    """
    fine = replace(problem, steps=LAST_STEPS, _lanes={})
    fit = descend(fine, fit, 8)
    if not is_fitted(fit):
        fit = search_other_valleys(fine, fit, begin, seed, progress)
    progress("last rounds", 0.9)
    fit = polish_fit(fine, fit, seed)
    size = np.sqrt(np.nanmean(fit.residuals**2, axis=1))
    level = np.array([n.level for n in fine.noise])
    if (size <= RESIDUAL_HELD_OUT * level).all():
        learnt = tuple(noises.fit_noise(r) for r in fit.residuals)
        fine = replace(fine, noise=learnt, _lanes={})
        fit = descend(fine, fit, 5)
    return fine, fit


def build_model(model: Model, problem: LogProblem, fit: Fit, gains: ControllerGains | None) -> Model:
    """The model whose nominal values are those that were found."""
    values = problem.list_values(fit.free, fit.x)
    held = {n: v for n, v in problem.model.values.items() if v != model.values.get(n) and not n.startswith("sensors.")
            and n not in values}
    noise = {SIGNALS[s].noise: n.level for s, n in zip(problem.trace.outputs, problem.noise, strict=True)}
    read = {} if gains is None else gains.values
    found = {n: float(f"{v:.6g}") for n, v in {**held, **values, **read, **noise}.items() if n in model.values}
    complete = limit_friction_values({**model.values, **found})
    nominal = model.kind.nominal
    own = {n for n in nominal if n in model.values and model.values[n] != nominal[n]}
    own |= {n for n in found if n.partition(".")[0] in model.kind.groups}
    return replace(model, values=complete, design={n: complete[n] for n in model.list_names() if n in own})


def estimate_parameters(model: Model, ranges: Sequence[Range], fit: Fit,
                        hidden: Mapping[str, tuple[float, float, float]]) -> tuple[tuple[Estimate, ...], Floats]:
    """The free parameters with their intervals, and the correlation matrix of them; hidden ones have no correlation."""
    free = fit.free
    names = [f.name for f in free]
    values = dict(zip(names, compute_values(free, fit.x).tolist(), strict=True))
    slopes = np.zeros((len(ranges), len(free)))  # of the logarithm, or of the value, by scaled unknowns
    for i, r in enumerate(ranges):
        if r.name in names:
            k = names.index(r.name)
            slopes[i, k] = free[k].scale
            if isinstance(f := free[k], LogFrictionRatio):
                dynamic = names.index(f.dynamic_name)
                slopes[i, dynamic] = free[dynamic].scale
    covariance = slopes @ fit.covariance @ slopes.T
    spread = np.sqrt(np.diag(covariance))
    found = []
    for i, r in enumerate(ranges):
        if r.name in hidden:
            value, low, high = hidden[r.name]
            found.append(Estimate(r.name, r.unit, model[r.name], r.low, r.high, value, low, high, False, 1.0))
            continue
        value = values[r.name]
        factor, systematic = IDENTIFIED_INTERVAL_FACTOR * float(spread[i]), get_systematic_sd(r.name)
        if not r.is_relative:
            systematic *= abs(value)
        half = INTERVAL_95_SD * float(np.hypot(factor, systematic))
        low, high = (value * np.exp(-half), value * np.exp(half)) if r.is_relative else (value - half, value + half)
        low, high = (min(max(float(end), r.low), r.high) for end in (low, high))
        share = half / r.half_width
        seen = share <= IDENTIFIABLE_SHARE
        found.append(Estimate(r.name, r.unit, model[r.name], r.low, r.high, value, low, high, seen, min(share, 1.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num(covariance / np.outer(spread, spread))
    return tuple(found), correlation


def list_correlations(estimates: Sequence[Estimate], matrix: Floats, least: float = 0.9) -> tuple[Correlation, ...]:
    """The pairs of parameters, but for hidden ones, that go together by at least so much."""
    pairs = [Correlation(a.name, b.name, float(matrix[i, j])) for i, a in enumerate(estimates)
             for j, b in enumerate(estimates[:i]) if abs(matrix[i, j]) >= least]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair.value)))


def measure_errors(before: Model, after: Model, runs: Sequence[Trace], sources: Sequence[Source], fitted: int,
                   floor: Mapping[str, float]) -> tuple[tuple[RunError, ...], tuple[tuple[Floats, Floats], ...]]:
    """The error of each run with both models, the first `fitted` being those of the fit; and the residuals, SI."""
    errors, residuals = [], []
    for number, (trace, source) in enumerate(zip(runs, sources, strict=True)):
        noise = tuple(noises.white_noise(1.0) for _ in trace.outputs)
        first, last = (Problem(silence_readings(model), trace, noise, steps=LAST_STEPS) for model in (before, after))
        left = [problem.compute_residuals((), np.empty((1, 0)))[0] for problem in (first, last)]
        sizes = [{s: rms(r) for s, r in zip(trace.outputs, each, strict=True)} for each in left]
        typical = dict(zip(trace.outputs, compute_typical_rms(left[1]).tolist(), strict=True))
        own = {s: floor[s] for s in trace.outputs}
        decided, share = sizes[1], 0.0
        if number >= fitted and _moves(trace) and not is_long(trace):  # nine replays of a long one take too much memory
            undecided = find_undecided_rows(last, start_fit((), np.empty(0)), own)
            share = float(undecided.mean())
            if 0.0 < share < 1.0:
                decided = {s: rms(r[~undecided]) for s, r in zip(trace.outputs, left[1], strict=True)}
        errors.append(RunError(source, number >= fitted, sizes[0], sizes[1], typical, own, decided, share))
        residuals.append((left[0], left[1]))
    return tuple(errors), tuple(residuals)


def decide_verdict(estimates: Sequence[Estimate], errors: Sequence[RunError]) -> tuple[str, str]:
    """The verdict, and the reason for any but IDENTIFIED."""
    worse = [e for e in errors if any(e.typical[s] > RESIDUAL_HELD_OUT * e.floor[s] for s in e.typical)
             or e.decided_ratio > RESIDUAL_WORST]
    if worse:
        worst = max(worse, key=lambda e: e.decided_ratio)
        kind = "held-out run" if worst.is_held_out else "run"
        left = f"{worst.decided_ratio:.3g} noise floors of the {kind} {worst.source.file}"
        return "UNEXPLAINED", f"the best parameters leave {left}"
    unseen = [e.name for e in estimates if not e.is_identifiable]
    if len(unseen) == len(estimates):
        return "CANNOT_TELL", "these runs show none of the free parameters"
    if unseen:
        return "PARTLY", f"these runs do not show {len(unseen)} of {len(estimates)} free parameters"
    worst = max((e for e in errors if not e.is_held_out), key=lambda e: e.ratio)
    if worst.ratio > FITTED_RUN_WORST:
        return "PARTLY", (f"single stops of the ram in {worst.source.file} come at the wrong moment "
                          f"({worst.ratio:.3g} noise floors over all of the run), so frictions and gains may be off by "
                          "more than their intervals")
    return "IDENTIFIED", ""


def _moves(trace: Trace) -> bool:
    return float(np.nanmax(trace.xj) - np.nanmin(trace.xj)) >= MOVING_RAM


def _tell_nothing(model: Model, ranges: Sequence[Range], runs: Sequence[Trace], sources: Sequence[Source], fitted: int,
                  floor: Mapping[str, float], reason: str, notes: Sequence[str]) -> Identification:
    """The answer where no run to fit moves the ram."""
    estimates = tuple(Estimate(r.name, r.unit, model[r.name], r.low, r.high, r.centre, r.low, r.high, False, 1.0)
                      for r in ranges)
    errors, residuals = measure_errors(model, model, runs, sources, fitted, floor)
    problem = make_problem(model, runs[:1], floor, 1)
    free = list_unknowns(model, tuple(ranges))
    advice = advise_experiments(model, free, problem, None, [r.name for r in ranges])
    return Identification("CANNOT_TELL", reason, model, model, estimates, None, (), tuple(advice), errors, floor,
                          tuple(runs), residuals, tuple(sources), tuple(notes))


def write_identified_model(found: Identification, path: str | Path, command: str = "", date: str = "") -> Path | None:
    """Write the model file; return where the file that was there before is now, None if there was none.

    Args:
        found: the identification.
        path: the file.
        command: what the user typed.
        date: of today, as text.

    Raises:
        InputError: a file that cannot be written.
    """
    return replace_text(path, format_identified_model(found, command, date))


def format_identified_model(found: Identification, command: str = "", date: str = "") -> str:
    """The text of the model file."""
    intervals = {e.name: Value(e.value, e.low, e.high, e.unit) for e in found.estimates if e.is_identifiable}
    errors = found.errors
    origin: dict[str, str | list[str]] = {
        "verdict": found.verdict, "date": date,
        "runs": [e.source.file for e in errors if not e.is_held_out],
        "runs_sha256": [e.source.sha256 for e in errors if not e.is_held_out],
        "holdouts": [e.source.file for e in errors if e.is_held_out],
        "holdouts_sha256": [e.source.sha256 for e in errors if e.is_held_out],
        "not_identifiable": [e.name for e in found.estimates if not e.is_identifiable]}
    known = Provenance(name_software(), (command,) if command else (), floor=found.floor, signals=tuple(found.floor),
                       identification=origin)
    text = format_model_file(found.model, intervals, known)
    return _mark_unseen(text, {e.name: f"{e.low:.3g} .. {e.high:.3g}" for e in found.estimates
                               if not e.is_identifiable})


def _mark_unseen(text: str, unseen: Mapping[str, str]) -> str:
    """The text with a remark beside each parameter that the runs do not show."""
    group, lines = "", []
    for line in text.splitlines():
        if line.startswith("["):
            group = line.strip("[]").removeprefix("design.")
        name = f"{group}.{line.partition(' = ')[0]}"
        if name in unseen:
            line += f"{',' if '#' in line else '  #'} not identifiable from the runs, {unseen[name]}"
        lines.append(line)
    return "\n".join(lines) + "\n"


class ControllerGains(NamedTuple):
    """The proportional law, answer = gain * error up to a limit, and how well it holds."""

    gain: float  # A/m
    limit: float | None  # A; None where the answer never stayed at its largest value
    exact: float  # share of the rows in which it holds

    @property
    def is_proportional(self) -> bool:
        """Whether this is the law: else the gains of the model are left alone."""
        return self.exact > 0.95

    @property
    def values(self) -> Mapping[str, float]:
        """Parameters of the model, SI; none if this is not the law."""
        found = {"controller.proportional_gain": self.gain, "controller.current_limit": self.limit}
        return {name: value for name, value in found.items() if value is not None and self.is_proportional}


def read_controller(runs: Sequence[Trace], tolerance: float = 1e-3, fewest_rows: int = 20) -> ControllerGains | None:
    """The law of the controller that was at work in some runs; None where its error or its answer is always zero.

    Args:
        runs: with Com, XJ and Cor.
        tolerance: of an answer, as a share of the largest one, up to which the law holds.
        fewest_rows: at the largest answer, from which on that is the limit.
    """
    error = np.concatenate([t.com - t.xj for t in runs])
    answer = np.concatenate([t.cor for t in runs])
    known = np.isfinite(error) & np.isfinite(answer)
    error, answer = error[known], answer[known]
    largest = float(np.abs(answer).max(initial=0.0))
    inside = (np.abs(answer) < 0.99 * largest) & (np.abs(error) > 0.0) & (np.abs(answer) > 0.0)
    if not inside.any():
        return None
    ratio, weight = answer[inside] / error[inside], np.abs(error[inside])
    order = np.argsort(ratio)
    gain = float(ratio[order][np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())])  # weighted median
    left = np.abs(answer - np.clip(gain * error, -largest, largest))
    at_limit = int((np.abs(answer) > (1.0 - 1e-9) * largest).sum())
    return ControllerGains(gain, largest if at_limit >= fewest_rows else None,
                           float((left <= tolerance * largest).mean()))


SMOOTHED = 25  # rows of the parabola that gives speed and acceleration
MOVING = 1e-3  # m/s, above which the ram's friction is the dynamic one
STALLED_ROWS = 20  # at a limit, in a row or not, that show it


def estimate_by_regressions(runs: Sequence[Trace], model: Model, known: frozenset[str] = frozenset()
                            ) -> dict[str, float]:
    """Parameters that the runs show without a replay, SI; those that need a signal nobody measured are left out.

    Args:
        runs: prepared for replay; of one actuator.
        model: with the values of the data sheet, for what the regressions cannot tell.
        known: parameters that are not free, so that others make up for them.
    """
    found: dict[str, float] = {}
    stroke = _find_limit(np.concatenate([t.xj for t in runs]))  # half of it, m, as far as the ram went
    if stroke > 0.98 * model["jack.travel"] or _dwells(np.concatenate([t.xj for t in runs]), stroke):
        found["jack.travel"] = stroke
    if all("p12" in t.outputs for t in runs):
        pressure = np.concatenate([t.mask_unusable("p12") for t in runs])
        highest = _find_limit(pressure)
        if highest > model["supply.pressure"] or _dwells(pressure, highest):
            found["supply.pressure"] = highest
    if all("xs" in t.outputs for t in runs):
        found |= _estimate_spool(runs, model)
    p = {**model.values, **found}
    if all({"xs", "p12"} <= set(t.outputs) for t in runs):
        found |= _estimate_jack(runs, p, "jack.area" not in known)
    else:
        has_spool = all("xs" in t.outputs for t in runs)
        drive = [t.mask_unusable("xs") if has_spool else shift_rows(t.cor, 4) for t in runs]
        opening = 1.0 if has_spool else p["torque_motor.gain"] / p["feedback_spring.stiffness"]
        gain = _regress([_smooth_speed(t) for t in runs], [[d] for d in drive], 1.0 if has_spool else 0.5)
        if gain is not None and gain[0] > 0.0:
            found["valve.flow_gain"] = gain[0] * p["jack.area"] / opening
    return {name: value for name, value in found.items() if np.isfinite(value) and value > 0.0}


def _estimate_spool(runs: Sequence[Trace], model: Model) -> dict[str, float]:
    """Stiffness of the feedback spring, pilot flow gain, and both travels, from current and spool.

    XS settles at GM I/KSF; with the flapper at its stop its speed is GQF XFM/ASV.
    """
    found: dict[str, float] = {}
    size = 61
    spool = [t.mask_unusable("xs") for t in runs]
    every = np.concatenate(spool)
    limit = _find_limit(every)
    level = [np.where(_average((np.abs(t.xs) > 0.6 * limit).astype(float), size) > 0.0, np.nan, _average(x, size))
             for t, x in zip(runs, spool, strict=True)]
    gain = _regress(level, [[_average(t.cor, size)] for t in runs])
    if gain is None or gain[0] <= 0.0:
        return found
    ratio = model["feedback_spring.stiffness"] / model["torque_motor.gain"] * gain[0]  # KSF/GM of the model over own
    found["feedback_spring.stiffness"] = model["feedback_spring.stiffness"] / np.sqrt(ratio)
    found["torque_motor.gain"] = model["torque_motor.gain"] * np.sqrt(ratio)
    if float(np.nanmax(np.abs(every))) > 0.98 * model["spool.travel"] or _dwells(every, limit):
        found["spool.travel"] = limit
    speeds = [np.abs(differentiate(_fill(x), 5, 1)) / t.period for t, x in zip(runs, spool, strict=True)]
    highest = _find_limit(np.concatenate(speeds))
    found["pilot.flow_gain"] = highest * model["spool.end_area"] / model["flapper.travel"]
    return found


def _estimate_jack(runs: Sequence[Trace], p: Mapping[str, float], is_area_free: bool) -> dict[str, float]:
    """Flow gain, leakage, area, mass, damping and friction from spool, pressure, position and load."""
    found: dict[str, float] = {}
    speed = [_smooth_speed(t) for t in runs]
    acceleration = [differentiate(_fill(t.mask_unusable("xj")), SMOOTHED, 2) / t.period**2 for t in runs]
    spool = [_average(t.mask_unusable("xs"), 9) for t in runs]
    pressure = [_average(t.mask_unusable("p12"), 9) for t in runs]
    away = [np.where((np.abs(t.xj) < 0.97 * p["jack.travel"]) & (np.abs(q) < 0.8 * p["supply.pressure"]), 1.0, np.nan)
            for t, q in zip(runs, pressure, strict=True)]
    flow = _regress([v * w for v, w in zip(speed, away, strict=True)],
                    [[x, -q] for x, q in zip(spool, pressure, strict=True)])
    moving = [np.where((np.abs(v) > MOVING) & (np.abs(a) < 20.0), w, np.nan)
              for v, a, w in zip(speed, acceleration, away, strict=True)]
    load = [t.load for t in runs]
    is_loaded = float(np.ptp(np.concatenate(load))) > 0.0
    columns = [[a, v, np.sign(v), *([f] if is_loaded else [])]
               for a, v, f in zip(acceleration, speed, load, strict=True)]
    force = _regress([q * w for q, w in zip(pressure, moving, strict=True)], columns)
    area = p["jack.area"]
    if force is not None:
        if is_loaded and is_area_free and force[3] > 0.0:
            found["jack.area"] = area = 1.0 / force[3]
        names = ("jack.mass", "jack.damping", "jack.dynamic_friction")
        found |= {name: area * x for name, x in zip(names, force[:3], strict=True) if x > 0.0}
        if "jack.dynamic_friction" in found:
            ratio = p["jack.static_friction"] / p["jack.dynamic_friction"]
            found["jack.static_friction"] = ratio * found["jack.dynamic_friction"]
    if flow is not None and flow[0] > 0.0:
        found["valve.flow_gain"] = flow[0] * area
        leakage = flow[1] * area - found["valve.flow_gain"] / p["valve.pressure_gain"]
        if leakage > 0.0:
            found["jack.leakage"] = leakage
    return found


def _find_limit(x: Floats) -> float:
    """The largest magnitude that some samples reach, so that noise does not set it."""
    size = np.sort(np.abs(x[~np.isnan(x)]))
    return float(np.median(size[-STALLED_ROWS:])) if len(size) else 0.0


def _dwells(x: Floats, limit: float, share: float = 2e-3, rows: int = 5 * STALLED_ROWS) -> bool:
    """Whether a signal stays at its limit."""
    return int((np.abs(x) > (1.0 - share) * limit).sum()) >= rows


def _smooth_speed(trace: Trace) -> Floats:
    speed: Floats = differentiate(_fill(trace.mask_unusable("xj")), SMOOTHED, 1) / trace.period
    return speed


def _fill(x: Floats) -> Floats:
    rows, there = np.arange(len(x)), ~np.isnan(x)
    return np.interp(rows, rows[there], x[there]) if there.any() else np.zeros(len(x))


def _average(x: Floats, size: int) -> Floats:
    mean: Floats = np.convolve(np.pad(_fill(x), size // 2, "edge"), np.full(size, 1.0 / size), "valid")
    return mean


def _regress(y: Sequence[Floats], columns: Sequence[Sequence[Floats]], largest: float = 1.0, rounds: int = 6
             ) -> Floats | None:
    """Coefficients of y (n,) on columns, all runs together, by least squares in which outliers count little.

    Rows whose first column is beyond `largest` times its maximum are left out, as all that saturates there. None if the
    rows do not tell the columns apart.
    """
    target = np.concatenate(y)
    table = np.column_stack([np.concatenate(c) for c in zip(*columns, strict=True)])
    there = np.isfinite(target) & np.isfinite(table).all(axis=1)
    if largest < 1.0 and there.any():
        there &= np.abs(table[:, 0]) < largest * np.abs(table[there, 0]).max()
    target, table = target[there], table[there]
    scale = np.sqrt((table**2).mean(axis=0)) if len(table) > 100 else np.zeros(table.shape[1])
    if not (scale > 0.0).all():
        return None
    weight = np.ones(len(target))
    found = np.zeros(table.shape[1])
    for _ in range(rounds):
        rows = (table / scale) * weight[:, None]
        found, _, rank, _ = np.linalg.lstsq(rows, target * weight, rcond=1e-6)
        if rank < len(scale):
            return None
        left = np.abs(target - (table / scale) @ found)
        usual = 1.5 * float(np.median(left)) + 1e-300
        weight = np.sqrt(np.minimum(1.0, usual / np.maximum(left, 1e-300)))
    coefficients: Floats = found / scale
    return coefficients
