"""A cheap look at every effect: what would it gain, if everything fitted so far gave way linearly?"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Free, Problem, compute_misfit, compute_weights, scaled_bounds, span_all_rows
from fdi.estimation.unidentifiable import list_powers, scale_together
from fdi.estimation.unknowns import list_effect_unknowns
from plant.effects import CATALOGUE
from plant.lanes import Part
from plant.threads import map_in_threads

Floats = NDArray[np.float64]
Start = Mapping[str, float]

ZOOM = (  # factors on the size, pass by pass; the first reaches down to sizes that only just show
    (0.015, 0.05, 0.15, 0.4, 0.65, 1.5, 2.5), (0.6, 0.8, 1.25, 1.7), (0.88, 0.94, 1.06, 1.13),
    (0.97, 0.985, 1.015, 1.03))
LOOKED_AT = (40, 14, 10, 8)  # effects in each of these passes
TOGETHER = 64  # runs at a time
FINER = 16  # times the length of a run: bins of a spectrum fine enough for a fit to begin in
LINES = 4  # tried
SCAN_STRIDE = 5  # every so many samples, for the linear shift alone


# effects that other unknowns can make up for, all but a little: directions of level.FLAT by which these then go with
# 1 - value. A clogged filter weakens what pushes the spool, so a fit without it has found too much friction and too
# little flow; friction cannot give way linearly, a hundred stops of the spool would move
GOES_WITH: Mapping[str, tuple[int, ...]] = {"filter_clogging": (0, 1)}


class Trial(NamedTuple):
    """An effect at one start on top of a fit: `cost` after the fit's unknowns, (p,), have moved to `x`."""

    effect: str
    start: Start
    cost: float
    x: Floats
    along: bool = False  # what goes with the effect has moved first


class Prospect(NamedTuple):
    """An effect with the start that promises most: `cost` is what would be left, `x` the start of all unknowns."""

    effect: str
    cost: float
    free: tuple[Free, ...]
    x: Floats  # (p,), those of the fit scanned from first


def scan_effects(problem: Problem, fit: Fit, effects: Iterable[str], workers: int = 1) -> list[Prospect]:
    """Expected cost of each effect on top of `fit`, best first, by so many threads.

    Every start of an effect is simulated; the fit's own unknowns then move linearly, within their bounds and priors, to
    take up what they can. Further passes try sizes around the best start, closer each time, and the last one
    frequencies.
    """
    effects = list(effects)
    first = [(name, start, along) for name in effects for along in ((False, True) if name in GOES_WITH else (False,))
             for start in (*CATALOGUE[name].starts, *find_tones(problem, fit, name))]
    best = _pick_best(_simulate_starts(problem, fit, first, workers))
    for factors, count in zip(ZOOM, LOOKED_AT, strict=True):
        promising = sorted(best.values(), key=lambda t: t.cost)[:count]
        near = [(t.effect, start, t.along) for t in promising for start in _list_starts_around(problem, t, factors)]
        best = _pick_best([*best.values(), *_simulate_starts(problem, fit, near, workers)])
    promising = sorted(best.values(), key=lambda t: t.cost)[:LOOKED_AT[-1]]
    beside = [(t.effect, start, t.along) for t in promising for start in _list_lines_beside(problem, t)]
    best = _pick_best([*best.values(), *_simulate_starts(problem, fit, beside, workers)])
    return sorted((_make_prospect(problem, fit, t) for t in best.values()), key=lambda p: p.cost)


def _make_prospect(problem: Problem, fit: Fit, t: Trial) -> Prospect:
    mine = {u.name: u for u in list_effect_unknowns(CATALOGUE[t.effect], problem.model)}
    kept = tuple(mine.get(f.name, f) for f in fit.free)  # a suspect of the reference model loses its tolerance
    own = tuple(u for name, u in mine.items() if name not in {f.name for f in fit.free})
    found = {f.name: f.centre + f.scale * float(v) for f, v in zip(fit.free, t.x, strict=True)}
    values = {**found, **t.start}
    free = (*kept, *own)
    return Prospect(t.effect, t.cost, free, np.array([(values[f.name] - f.centre) / f.scale for f in free]))


def _list_starts_around(problem: Problem, t: Trial, factors: Sequence[float]) -> list[dict[str, float]]:
    """Starts around a trial's: the parameters of one unit, which belong together, times each factor."""
    free = list_effect_unknowns(CATALOGUE[t.effect], problem.model)
    units = list(dict.fromkeys(CATALOGUE[t.effect].parameters[u.name].unit for u in free))
    starts = []
    for unit in units:
        if unit in ("Hz", "rad"):
            continue
        for factor in factors:
            new = dict(t.start)
            for u in free:
                if CATALOGUE[t.effect].parameters[u.name].unit == unit:
                    new[u.name] = min(max(u.centre + factor * (t.start[u.name] - u.centre), u.low), u.high)
            starts.append(new)
    return starts


def find_tones(problem: Problem, fit: Fit, effect: str) -> list[dict[str, float]]:
    """Starts for an effect with a frequency: a fit finds none that it does not begin within a period of.

    The effect at next to no frequency and a quarter turn shows how each residual answers a constant; the residual times
    that answer has a line where the effect has its frequency. The lines that stand out most from what is around, in all
    signals together, are tried, at four phases as the answer may lag, and larger as what is fast is weakened.
    """
    entry, named = CATALOGUE[effect], _name_sine(effect)
    if named is None:
        return []
    size, tone, phase = named
    still = {**entry.starts[0], tone: max(1e-6, entry.parameters[tone].low), phase: 0.5 * np.pi}
    names = list(still)
    at = np.array([list(still.values()), [entry.off.get(n, still[n]) for n in names]])
    white = problem.whiten_residuals(problem.subtract_measurements(problem.predict_outputs(names, at)))
    longest = _find_longest_piece(problem)
    rows = slice(longest.first, longest.stop)  # a line has one phase within a piece alone
    answer = (white[1] - white[0])[:, rows]
    product = fit.white[:, rows] * answer
    period = problem.model.values["controller.period"]
    spectra = np.fft.rfft(product - product.mean(axis=1, keepdims=True), FINER * product.shape[1])
    hertz = np.fft.rfftfreq(FINER * product.shape[1], period)
    surroundings = 3.0  # Hz on either side of a line, above which it has to stand out
    height = (_measure_prominence(np.abs(spectra), round(surroundings / hertz[1])) ** 2).sum(axis=0) * (hertz > 0.5)
    line = spectra.sum(axis=0) * 2.0 / max(float((answer**2).sum()), 1e-300)  # in sizes of the start
    found = []
    before = 2.0 * np.pi * period * (longest.first + longest.later)  # s times 2 pi, from the clock's 0 to the piece
    distance = 1.0  # Hz, between lines
    for _ in range(LINES):
        k = int(np.argmax(height))
        found += [{size: still[size] * larger * float(np.abs(line[k])), tone: float(hertz[k]),
                   phase: float(np.angle(line[k])) + turn * np.pi - before * float(hertz[k])}
                  for turn in (0.5, 1.0, 1.5, 2.0) for larger in (1.0, 4.0, 16.0)]
        height[np.abs(hertz - hertz[k]) < distance] = 0.0
    return found


def _list_lines_beside(problem: Problem, t: Trial) -> list[dict[str, float]]:
    """Starts around the frequency of a trial, if its effect has one: every half turn over the run, at eight phases.

    A line in what a wrong fit leaves stands a little beside the effect's own frequency. A fit gets there only from
    less than half a turn away: it does not leave the line that it begins in.
    """
    named = _name_sine(t.effect)
    if named is None:
        return []
    _, tone, phase = named
    longest = _find_longest_piece(problem)
    period = problem.model.values["controller.period"]
    turn = 1.0 / (period * (longest.stop - longest.first))  # Hz
    middle = 2.0 * np.pi * period * (longest.later + 0.5 * (longest.first + longest.stop))  # where the phase stays
    low = CATALOGUE[t.effect].parameters[tone].low
    changes = turn * np.arange(-3.0, 3.5, 0.5)
    return [{**t.start, tone: float(max(t.start[tone] + change, low)),
             phase: float(t.start[phase] - middle * change + eighth * 0.25 * np.pi)}
            for change in changes for eighth in range(8)]


def _name_sine(effect: str) -> tuple[str, str, str] | None:
    """Names of the amplitude, the frequency and the phase of an effect that has them."""
    entry = CATALOGUE[effect]
    named = {entry.parameters[n].unit: n for n in entry.fitted}
    size = next((n for n in entry.fitted if entry.parameters[n].unit not in ("Hz", "rad")), None)
    if size is None or not {"Hz", "rad"} <= set(named) or not entry.starts:
        return None
    return size, named["Hz"], named["rad"]


def _find_longest_piece(problem: Problem) -> Part:
    return max(problem.trace.parts or (span_all_rows(problem.trace),), key=lambda part: part.stop - part.first)


def _measure_prominence(spectra: Floats, width: int) -> Floats:
    """Magnitudes (s, n) over the median of those around them, `width` bins on either side."""
    out = np.empty_like(spectra)
    for first in range(0, spectra.shape[1], width):
        around = spectra[:, max(first - width, 0):first + 2 * width]
        out[:, first:first + width] = spectra[:, first:first + width] / np.median(around, axis=1, keepdims=True)
    return out


def _pick_best(trials: Iterable[Trial]) -> dict[str, Trial]:
    best: dict[str, Trial] = {}
    for t in trials:
        if t.effect not in best or t.cost < best[t.effect].cost:
            best[t.effect] = t
    return best


def _simulate_starts(problem: Problem, fit: Fit, starts: Sequence[tuple[str, Start, bool]], workers: int
                     ) -> list[Trial]:
    """The starts simulated at the fit's values, or with what goes with them, side by side."""
    if not starts:
        return []
    names = list(dict.fromkeys([f.name for f in fit.free] + [n for _, start, _ in starts for n in start]))
    ways = list_powers(problem)
    begun = [_move_along(fit, effect, start, ways) if along else fit.x for effect, start, along in starts]
    at = [problem.list_values(fit.free, x) | dict(start) for x, (_, start, _) in zip(begun, starts, strict=True)]
    rows = np.array([[values.get(n, problem.model.values[n]) for n in names] for values in at])
    steep = prepare_slope(fit)

    def run_trials(part: NDArray[np.int64]) -> list[Trial]:
        white = problem.whiten_residuals(problem.subtract_measurements(problem.predict_outputs(names, rows[part])))
        found = []
        for i, r in zip(part, white, strict=True):
            effect, start, goes_along = starts[i]
            cost, x = absorb_shift(fit, steep, r, set(start), begun[i])
            found.append(Trial(effect, start, cost, x, goes_along))
        return found

    parts = np.array_split(np.arange(len(rows)), min(len(rows), max(workers, -(-len(rows) // TOGETHER))))
    return [trial for several in map_in_threads(run_trials, parts, workers) for trial in several]


def _move_along(fit: Fit, effect: str, start: Start, ways: Sequence[Mapping[str, float]]) -> Floats:
    """The fit's unknowns, (p,), after what goes with an effect has moved, within their bounds."""
    left = max(1.0 - next(iter(start.values())), 0.01)  # a filter that lets nothing through has no power
    low, high = scaled_bounds(fit.free)
    x = fit.x
    for way in GOES_WITH[effect]:
        x = scale_together(fit.free, x, ways[way], float(np.log(left)))
    return np.clip(x, low, high)


class Slope(NamedTuple):
    """A fit's Jacobian as the scan needs it: whole, thinned, and what is known of the unknowns."""

    whole: Floats  # (p, s * n)
    thin: Floats  # (p, s, n / SCAN_STRIDE)
    prior: Floats  # (p,)
    low: Floats  # (p,)
    high: Floats  # (p,)


def prepare_slope(fit: Fit) -> Slope:
    """Prepared once for many residuals."""
    low, high = scaled_bounds(fit.free)
    return Slope(fit.jacobian.reshape(len(fit.x), -1), np.ascontiguousarray(fit.jacobian[:, :, ::SCAN_STRIDE]),
                 np.array([f.prior**-2 for f in fit.free]), low, high)


def absorb_shift(fit: Fit, s: Slope, white: Floats, held: set[str], begun: Floats) -> tuple[float, Floats]:
    """Cost of a whitened residual (s, n) after the fit's unknowns, but for those `held`, have shifted linearly.

    `begun`: the unknowns, (p,), at which the residual was simulated.

    Twice, as what can be fitted is known only after the first time; not at all where that is worse than to stay.
    """
    move = np.array([f.name not in held for f in fit.free])
    prior = np.where(move, s.prior, 1e30)  # what is held does not move
    flat, left, x = s.thin.reshape(len(begun), -1), white, begun
    few = white[:, ::SCAN_STRIDE].reshape(-1)
    for _ in range(2):
        heavy = (SCAN_STRIDE * s.thin * compute_weights(left)[:, ::SCAN_STRIDE]).reshape(flat.shape)
        hessian = heavy @ flat.T + np.diag(prior + 1e-9)
        gradient = heavy @ few + s.prior * begun * move
        x = np.where(move, np.clip(begun - cho_solve(cho_factor(hessian), gradient), s.low, s.high), begun)
        left = white + ((x - begun) @ s.whole).reshape(white.shape)
    costs = compute_misfit(np.array([left, white])) + [(at * move) ** 2 @ s.prior for at in (x, begun)]
    return (float(costs[0]), x) if costs[0] <= costs[1] else (float(costs[1]), begun)
