"""How large an effect must be for a test to show it: the decision of `explain`, applied to simulated runs.

An effect of some size is simulated at the fitted values, and the tolerances are fitted to that run as `explain` would
fit them. What they cannot make up for is what the effect gains. The run is simulated with other solver steps than the
fit: the spool makes about a hundred small stops, each of which moves with any change, and so do the fits to a real
run. Without this a size of which the tolerances make up for all but the stops looks visible.

Where two explanations fit equally well: which sensor or which command would tell them apart, found by simulation too.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from fdi.discovery.search import Hypothesis, Search
from fdi.estimation import (
    VISCOSITY,
    Fit,
    Problem,
    compute_misfit,
    compute_weights,
    fit_unknowns,
    list_powers,
    scale_together,
    scaled_bounds,
    simulate_trace,
    weigh_priors,
)
from fdi.thresholds import GAIN_DETECTED, MISFIT_DISCRIMINATES
from fdi.trace import Floats, Trace
from plant import Lanes, Model, map_in_threads

FITTED_STEPS, SIMULATED_STEPS = 10, 13  # a cycle: of the fit, and of the run that stands for the measurement
REFIT_ROUNDS = 4
MORE_MOTION = "a run with more motion"  # shows what a run at rest does not
WITHOUT_SIZE = ("Hz", "rad")  # units of parameters that say where an effect is and not how large


class Direction(NamedTuple):
    """An effect with one sign: `start` is one of its starting sizes, `reach` the distance of that from the off value.

    Sizes are distances of the first parameter from the off value: `least` and `most` of its starts.
    """

    effect: str
    start: Mapping[str, float]
    reach: float
    least: float
    most: float


class Blind(NamedTuple):
    """An effect that the tolerances make up for, so that a test does not show it at any usual size."""

    effect: str
    parameter: str
    usual: float  # distance from the off value, the largest that is usual
    unit: str
    revealed_by: str  # what would show it


def find_hidden_effects(problem: Problem, fit: Fit, effects: Iterable[str]) -> list[Blind]:
    """The effects that do not gain `GAIN_DETECTED` even at their largest usual size, with one sign at least.

    Args:
        problem: of which the first run counts.
        fit: where nothing but noise is left.
        effects: names of the catalogue.
    """
    ways = [way for name in effects for way in list_directions(name, problem.model)]
    gains = VirtualTest(problem, fit).measure_gains(ways, [way.most for way in ways]) if ways else []
    usual = {way.effect: way.most for way, gain in zip(ways, gains, strict=True) if gain < GAIN_DETECTED}
    return [Blind(e.name, e.fitted[0], usual[e.name], e.parameters[e.fitted[0]].unit, e.revealed_by or MORE_MOTION)
            for e in map(problem.model.find_effect, usual)]


def list_directions(effect: str, model: Model) -> list[Direction]:
    """One for each sign of the first parameter."""
    entry = model.find_effect(effect)
    first = entry.fitted[0]
    off = entry.off.get(first, model.nominal.get(first, 0.0))
    directions: dict[bool, Direction] = {}
    for start in entry.starts:
        reach = start[first] - off
        if reach == 0.0:
            continue
        size = abs(reach)
        before = directions.get(reach > 0.0, Direction(effect, start, size, size, size))
        directions[reach > 0.0] = before._replace(least=min(before.least, size), most=max(before.most, size))
    return list(directions.values())


def move_effect(model: Model, values: Mapping[str, float], way: Direction, size: float) -> dict[str, float]:
    """The parameters of an effect, by name, whose first one has moved by `size` from its value in a model's `values`.

    The others move along in proportion; those that say where an effect is have their starting values.
    """
    entry, parameters = model.find_effect(way.effect), {}
    for name, start in way.start.items():
        off = entry.off.get(name, model.nominal.get(name, 0.0))
        new_value = values[name] + (start - off) * size / way.reach
        parameters[name] = start if entry.parameters[name].unit in WITHOUT_SIZE else new_value
    return parameters


@dataclass
class SimulatedRun(Problem):
    """A problem whose `run`, (s, n) SI, stands for the measurement, where something was measured."""

    run: Floats = field(default_factory=lambda: np.empty(0))

    def subtract_measurements(self, predictions: Floats) -> Floats:
        """What predictions (m, s, n) leave of the simulated run: (m, s, n)."""
        return super().subtract_measurements(predictions - self.run + self.trace.measurements)


class VirtualTest:
    """Simulated runs of a plant at the values of a fit, and what a fit of the tolerances leaves of them."""

    def __init__(self, problem: Problem, fit: Fit) -> None:
        self.problem = replace(problem, also=(), steps=FITTED_STEPS, _lanes={})
        self.simulated = replace(self.problem, steps=SIMULATED_STEPS, _lanes={})
        self.fit, self.names = fit, [f.name for f in fit.free]
        self.slope = fit.jacobian[:, :, :len(problem.trace)]
        self.prior = weigh_priors(fit.free)
        self.bounds = scaled_bounds(fit.free)

    def measure_gains(self, ways: Sequence[Direction], sizes: Sequence[float]) -> list[float]:
        """What each effect gains in -2 log likelihood over a fit of the tolerances.

        A fit takes six rounds, fewer where the gain falls below `GAIN_DETECTED` or no longer falls.
        """
        names, rows = self._list_values(ways, sizes)
        run = self._predict_values(self.simulated, names, rows)
        with_effect = compute_misfit(self._whiten(self._predict_values(self.problem, names, rows) - run))
        with_effect = np.minimum(with_effect, self.moved_stops)
        model = self.problem.model
        is_own = np.array([[name in model.find_effect(way.effect).fitted for name in self.names] for way in ways])
        prior_costs = np.where(is_own, 0.0, self.prior) @ self.fit.x**2  # the effect has no prior on its own parameters
        starts = np.array([self._list_beginnings(dict(zip(names, row, strict=True))) for row in rows])
        costs, residuals = self._measure_costs(starts, run)
        best = np.argmin(costs, axis=1)
        indices = np.arange(len(ways))
        x, white, cost = starts[indices, best], residuals[indices, best], costs[indices, best]
        for _ in range(6):
            indices = indices[cost[indices] - prior_costs[indices] - with_effect[indices] > GAIN_DETECTED]
            if not len(indices):
                break
            steps = np.array([self._list_steps(white[k], x[k]) for k in indices])
            trials = np.clip(x[indices, None] + steps, *self.bounds)
            costs, residuals = self._measure_costs(trials, run[indices])
            best = np.argmin(costs, axis=1)
            least = np.take_along_axis(costs, best[:, None], 1)[:, 0]
            gains = cost[indices] - least
            for n in np.flatnonzero(gains > 0.0):
                k = indices[n]
                cost[k], x[k], white[k] = least[n], trials[n, best[n]], residuals[n, best[n]]
            indices = indices[gains > np.maximum(3.0, 0.02 * cost[indices])]

        def refit(k: int) -> float:
            """With slopes of its own, as a fit to a measured run has them."""
            beyond_doubt = 1000.0 * GAIN_DETECTED  # no refit takes as much
            if not GAIN_DETECTED < cost[k] - prior_costs[k] - with_effect[k] < beyond_doubt:
                return float(cost[k])
            own_run = SimulatedRun(**vars(self.problem), run=run[k])
            return min(float(cost[k]), fit_unknowns(own_run, self.fit.free, x[k], REFIT_ROUNDS).cost)

        last_costs = map_in_threads(refit, range(len(ways)), self.problem.workers)
        return [float(c) for c in np.array(last_costs) - prior_costs - with_effect]

    @cached_property
    def moved_stops(self) -> float:
        """What a fit leaves of a simulated run without any effect, above the prior: stops that it does not reproduce.

        In some runs a stop that moves with the solver's step changes all that follows. A fit mends that with small
        changes of the base parameters. So it would with the effect, which counts with its true values otherwise.
        """
        row = self.problem.convert_unknowns(self.fit.free, self.fit.x[None])
        run = self._predict_values(self.simulated, self.names, row)[0]
        healthy = SimulatedRun(**vars(self.problem), run=run)
        return fit_unknowns(healthy, self.fit.free, self.fit.x, REFIT_ROUNDS).cost - float(self.prior @ self.fit.x**2)

    def _measure_costs(self, trials: Floats, runs: Floats) -> tuple[Floats, Floats]:
        """Costs (m, k) and whitened residuals (m, k, s, n) of scaled unknowns (m, k, p) for each of the runs (m, s, n).
        """
        m, k, p = trials.shape
        flat = trials.reshape(-1, p)
        predictions = self._predict_values(self.problem, self.names, self.problem.convert_unknowns(self.fit.free, flat))
        white = self._whiten(predictions - np.repeat(runs, k, 0))
        costs = compute_misfit(white) + flat**2 @ self.prior
        return costs.reshape(m, k), white.reshape(m, k, *white.shape[1:])

    def _list_beginnings(self, values: Mapping[str, float]) -> Floats:
        """Unknowns, (2, p), where a fit without the effect may begin: as they are, and where its `values` are alike.

        Parameters of the effect that have a tolerance take its values. Where a direction that no signal shows leads
        through a parameter that has none, the others go the other way; so they do for a changed viscosity.
        """
        base_values = {**self.problem.model.values, **self.fit.values}
        x = np.array([(values[f.name] - f.centre) / f.scale for f in self.fit.free])
        for way in (*list_powers(self.problem), VISCOSITY):
            first = next(iter(way))
            if first in self.names or values.get(first, base_values.get(first)) == base_values.get(first):
                continue
            ratio = (1.0 - values[first]) / (1.0 - base_values[first]) if first == "filter.clogging" else \
                values[first] / base_values[first]
            x = scale_together(self.fit.free, x, way, -float(np.log(max(ratio, 0.01))))
        return np.asarray(np.clip([self.fit.x, x], *self.bounds))

    def _list_steps(self, white: Floats, x: Floats) -> Floats:
        """Gauss-Newton steps of the tolerances, (k, p), from whitened residuals (s, n): whole, damped and short."""
        heavy = (self.slope * compute_weights(white)).reshape(len(x), -1)
        hessian = heavy @ self.slope.reshape(len(x), -1).T + np.diag(self.prior + 1e-9)
        gradient = heavy @ white.reshape(-1) + self.prior * x
        whole, damped = (-cho_solve(cho_factor(hessian + d * np.diag(np.diag(hessian))), gradient) for d in (0.0, 0.1))
        return np.array([whole, damped, 0.3 * whole])

    def _list_values(self, ways: Sequence[Direction], sizes: Sequence[float]) -> tuple[list[str], Floats]:
        """Names and values, (m, p), of the fit's parameters with each effect at its size."""
        model = self.problem.model
        names = list(dict.fromkeys([*self.names, *(name for way in ways for name in way.start)]))
        values = {**model.values, **self.fit.values}
        parameter_sets = [move_effect(model, values, way, size) for way, size in zip(ways, sizes, strict=True)]
        return names, np.array([[each.get(name, values[name]) for name in names] for each in parameter_sets])

    def _predict_values(self, problem: Problem, names: Sequence[str], rows: Floats, together: int = 64) -> Floats:
        parts = np.array_split(rows, -(-len(rows) // together))
        return np.concatenate([problem.predict_outputs(names, part) for part in parts])

    def _whiten(self, difference: Floats) -> Floats:
        """A difference of runs, (m, s, n) SI, as the fit counts it: without the mains, where it was measured."""
        measurements = self.problem.trace.measurements
        return self.problem.whiten_residuals(self.problem.subtract_measurements(difference + measurements))


SECONDS = 3.0
# A command in words, as segments of a sequence, and as a function of time giving demand and load.
Command = tuple[str, dict[str, Any], Callable[[Floats], tuple[Floats, Floats]]]


class Separation(NamedTuple):
    """What would split a set: `misfit` is what the wrong explanations would leave at least."""

    between: tuple[str, ...]
    by: str
    command: dict[str, Any]
    misfit: float


def find_separation(search: Search, equal: Sequence[Hypothesis]) -> Separation | None:
    """The first sensor, or else the best command, that splits a set of hypotheses; None if none that was tried does.

    One explanation's prediction stands for the measurement; the other is fitted to it, its tolerances and all.
    """
    most_pairs = 3  # of a larger set only the first are compared
    pairs = list(combinations(equal, 2))[:most_pairs]
    if not pairs:
        return None
    names = tuple(dict.fromkeys(e for h in equal for e in h.effects))
    trace = search.problem.trace
    missing = tuple(s for s in trace.output_names if s not in trace.outputs)
    for more in dict.fromkeys([*((s,) for s in missing), missing] if missing else []):
        misfit = min(_measure_misfit(search, a, b, _same_command(search, a, (*trace.outputs, *more))) for a, b in pairs)
        if misfit > MISFIT_DISCRIMINATES:
            return Separation(names, f"measure {' and '.join(more)} too, on the same command", {}, misfit)
    best = None
    for words, command, play in list_commands(trace):
        misfit = min(_measure_misfit(search, a, b, _simulate_command(search, a, play, trace.outputs)) for a, b in pairs)
        if misfit > MISFIT_DISCRIMINATES and (best is None or misfit > best.misfit):
            best = Separation(names, words, command, misfit)
    return best


def list_commands(trace: Trace) -> list[Command]:
    """Commands to try: those of a ram, in m and N, as large as the trace's plant has its motions and loads."""
    signal, load_signal = trace.declared.command, trace.declared.load
    push = 5e-3 * (load_signal.largest if load_signal and math.isfinite(load_signal.largest) else 0.0)

    def name(amplitude: float) -> str:
        return f"{1e3 * amplitude:g} mm" if signal.unit == "m" else f"{amplitude:.3g} {signal.unit}"

    def sine(amplitude: float, hertz: float, load: float = 0.0, against: str = "") -> Command:
        segments = {"main": [{"kind": "sine", "amplitude": amplitude, "frequency": hertz, "time": SECONDS}],
                    "load": [{"kind": "hold", "time": SECONDS, "value": load}] if load else []}
        return (f"a sine of {name(amplitude)} at {hertz:g} Hz{against}", segments,
                lambda t: (amplitude * np.sin(2.0 * np.pi * hertz * t), np.full_like(t, load)))

    def step(words: str, to: float) -> Command:
        segments = {"main": [{"kind": "hold", "time": 0.3}, {"kind": "step", "to": to, "time": 1.5},
                             {"kind": "step", "to": 0.0, "time": 1.2}], "load": []}
        return (f"a step {words} and back", segments,
                lambda t: (np.where((t > 0.3) & (t < 1.8), to, 0.0), np.zeros_like(t)))

    small, middle, wide, far, beyond = (size * trace.scale for size in (2e-4, 2e-3, 3e-3, 20e-3, 45e-3))
    load_text = f"{1e-3 * push:g} kN" if load_signal and load_signal.unit == "N" else f"{push:g}"
    return [*([sine(wide, 1.0, push, f" against a load of {load_text}")] if push else []),
            sine(middle, 10.0), sine(small, 20.0), sine(far, 1.0), step(f"of {name(far)}", far),
            *([step(f"into the end stop, {name(beyond)},", beyond)] if signal.limit else [])]


def _same_command(search: Search, h: Hypothesis, signals: tuple[str, ...]) -> Trace:
    """The run as a hypothesis predicts it, with more sensors."""
    problem, free = search.problem, h.fit.free
    columns = problem.predict_signals([f.name for f in free], problem.convert_unknowns(free, h.fit.x[None]))[0]
    trace = problem.trace
    return trace.with_columns(dict(zip(trace.output_names, columns, strict=True)), usable=np.ones(len(trace), bool),
                              outputs=tuple(s for s in trace.output_names if s in signals))


def _simulate_command(search: Search, h: Hypothesis, play: Callable[[Floats], tuple[Floats, Floats]],
                      signals: tuple[str, ...]) -> Trace:
    """Another command as a hypothesis predicts it, with the model's own controller."""
    problem = search.problem
    com, load = play(np.arange(0.0, SECONDS, problem.model["controller.period"]))
    lanes = Lanes(problem.model, [f.name for f in h.fit.free], problem.steps, 1)
    return simulate_trace(lanes, problem.convert_unknowns(h.fit.free, h.fit.x[None])[0], com, load, signals)


def _measure_misfit(search: Search, truth: Hypothesis, wrong: Hypothesis, trace: Trace) -> float:
    """What `wrong` leaves of what `truth` predicts, noise aside, -2 log likelihood."""
    noise = search.sensors | dict(zip(search.problem.trace.outputs, search.noise, strict=True))
    problem = replace(search.problem, trace=trace, noise=tuple(noise[s] for s in trace.outputs), also=())
    return fit_unknowns(problem, wrong.fit.free, wrong.fit.x, rounds=3).misfit
