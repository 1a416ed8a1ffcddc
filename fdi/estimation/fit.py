"""Fits of a model's unknowns to measured runs: what is unknown, how likely runs are, and the search for the best.

Blocks of residuals may hold more noise than is known: a block that is fitted counts by its squares, one that is not by
the logarithm of its mean square. So no single stop of the ram, made or missed, outweighs a whole run, and physics that
is missing is not made up for by parameters that no healthy unit has. The search is that of Levenberg and Marquardt with
priors; its trials are replayed side by side in lanes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import chdtrc

from fdi.estimation.mains import remove_mains
from fdi.estimation.noise import Noise
from fdi.thresholds import (
    ANCHOR_RATE,
    BLOCK_FITTED_SQUARE,
    CONVERGED_GAIN,
    CONVERGED_SHARE,
    HEALTHY_TOLERANCES,
    TOLERANCES_FAR_SHARE,
)
from fdi.trace import Floats, Trace
from plant import (
    Lanes,
    Model,
    Part,
    Plant,
    build_bare_model,
    find_quantity,
    list_searched_effects,
    map_in_threads,
    simulate,
)
from plant.effects import Effect

HUM_MOST_SD = 8.0  # noise levels, of hum and noise together
BLOCK = 100  # cycles
FURTHEST = 1e15  # SI, of any signal


class Free(NamedTuple):
    """A parameter that a fit may change. Fits work on x = (value - centre) / scale."""

    name: str
    centre: float
    scale: float
    prior: float  # standard deviation of x that is known beforehand; inf: nothing is
    low: float
    high: float
    step: float  # of x, for differences

    def value(self, x: float) -> float:
        """The parameter in SI units, within what is possible."""
        return min(max(self.centre + self.scale * x, self.low), self.high)


def scaled_bounds(free: Sequence[Free]) -> tuple[Floats, Floats]:
    """The least and the most that scaled unknowns, (p,), can be."""
    low, high = (np.array([(getattr(f, end) - f.centre) / f.scale for f in free]) for end in ("low", "high"))
    return low, high


def weigh_priors(free: Sequence[Free]) -> Floats:
    """Weights, (p,), of the squares of scaled unknowns: 0 where nothing is known of one beforehand."""
    return np.array([f.prior**-2 for f in free])


def place_in_healthy_unit(free: Sequence[Free], x: Floats) -> Floats:
    """Scaled unknowns, (p,), with those at their centres of which it is known where a healthy unit has them."""
    return np.where([np.isfinite(f.prior) for f in free], 0.0, x)


def limit_dynamic_friction(names: Sequence[str], values: Floats) -> Floats:
    """Values (.., p) of named parameters, changed in place: dynamic friction is at most the static friction."""
    for body in ("jack", "spool"):
        static, dynamic = f"{body}.static_friction", f"{body}.dynamic_friction"
        if static in names and dynamic in names:
            i, j = names.index(static), names.index(dynamic)
            values[..., j] = np.minimum(values[..., i], values[..., j])
    return values


def limit_friction_values(values: Mapping[str, float]) -> dict[str, float]:
    """Parameters by name, in which dynamic friction is at most the static friction."""
    names = [name for name in values if name.endswith("_friction")]
    frictions = limit_dynamic_friction(names, np.array([values[name] for name in names]))
    return {**values, **dict(zip(names, frictions.tolist(), strict=True))}


@cache
def find_fewest_steps(kind: Plant, noise_share: float = 1.0) -> int:
    """Steps a cycle with which fits may begin: the fewest that change a replay of the plant's nominal test by less than
    a share of the noise of each sensor, of 10, 20 and 50 against 200. Of a plant without such a test they are 10.
    """
    if not kind.profile or kind.foreign is not None:
        return 10
    model = silence_sensors(build_bare_model(kind.key))
    run = simulate(model, kind.build_nominal_command())
    noise = np.array([kind.nominal.get(s.noise, 0.0) for s in kind.signals.outputs])
    drive, read = (getattr(run, s.name) for s in (kind.signals.drive, kind.signals.controlled))
    finest, *others = (Lanes(model, (), n).replay(np.empty((1, 0)), drive, np.zeros(len(drive)), read, ANCHOR_RATE)[0]
                       for n in (200, 10, 20, 50))
    with np.errstate(all="ignore"):  # too few steps may let it diverge
        changes = [np.sqrt(((out - finest) ** 2).mean(axis=0))[noise > 0.0] / noise[noise > 0.0] for out in others]
    return next((n for n, change in zip((10, 20, 50), changes, strict=True) if (change < noise_share).all()), 100)


@dataclass
class Problem:
    """A model, the whole catalogue ready in it at off values, and runs to hold it against.

    Predictions and residuals of several runs follow one another along time.
    """

    model: Model  # with every effect that may be tried
    trace: Trace
    noise: tuple[Noise, ...]  # of each signal
    steps: int = 10  # a cycle, at least `find_fewest_steps`; last fits use more
    workers: int = 1
    bare: Model | None = None  # the same without the effects at off values: five times as fast where it will do
    also: tuple[Trace, ...] = ()  # further runs, of the same signals, that a fit takes in
    _lanes: dict[tuple[str, ...], Lanes] = field(default_factory=dict)

    def predict_outputs(self, names: Sequence[str], values: Floats) -> Floats:
        """Replays with the named parameters at `values` (m, p): (m, s, n) in SI units."""
        def predict_run(run: Trace) -> Floats:
            outputs, columns = self.predict_signals(names, values, run), run.output_columns
            return outputs if columns == list(range(outputs.shape[1])) else outputs[:, columns]

        runs = map_in_threads(predict_run, (self.trace, *self.also), self.workers)
        return np.concatenate(runs, axis=-1) if self.also else runs[0]

    def predict_signals(self, names: Sequence[str], values: Floats, trace: Trace | None = None) -> Floats:
        """All outputs of one run (default: the first), as its sensors show them, measured or not: (m, outputs, n)."""
        key = tuple(names)
        if key not in self._lanes:
            is_bare = self.bare is not None and set(key) <= set(self.bare.values)
            self._lanes[key] = Lanes(self.bare if is_bare and self.bare else self.model, key,
                                     max(self.steps, find_fewest_steps(self.model.kind)), self.workers)
        trace = self.trace if trace is None else trace
        out = self._lanes[key].replay(values, trace.drive, trace.load, trace.anchor, ANCHOR_RATE, trace.parts,
                                      trace.chambers, trace.slack)
        flat = out.transpose(0, 2, 1).reshape(-1)
        if not float(flat @ flat) < FURTHEST**2:  # a trial at which the simulation diverges
            out = np.clip(np.nan_to_num(out, nan=FURTHEST), -FURTHEST, FURTHEST)
        return trace.pass_sensors(out).transpose(0, 2, 1)

    def predict_unknowns(self, free: Sequence[Free], x: Floats) -> Floats:
        """Replays for scaled unknowns `x` (m, p): (m, s, n) in SI units."""
        return self.predict_outputs([f.name for f in free], self.convert_unknowns(free, x))

    def compute_residuals(self, free: Sequence[Free], x: Floats) -> Floats:
        """Model minus measurement for scaled unknowns `x` (m, p): (m, s, n), SI units, NaN where not measured."""
        return self.subtract_measurements(self.predict_unknowns(free, x))

    def compute_white_residuals(self, free: Sequence[Free], x: Floats) -> Floats:
        """The same, whitened: (m, s, n), 0 where not measured."""
        return self.whiten_predictions(self.predict_unknowns(free, x))

    def whiten_predictions(self, predictions: Floats) -> Floats:
        """Whitened residuals of predictions, (m, s, n), 0 where not measured."""
        white = np.empty(predictions.shape)
        for runs in cut_runs(predictions.shape):
            self._whiten(self.subtract_measurements(predictions[runs]), white[runs])
        return white

    def compute_costs(self, free: Sequence[Free], x: Floats) -> Floats:
        """-2 log likelihood with priors, (m,), of scaled unknowns `x` (m, p)."""
        return compute_misfit(self.compute_white_residuals(free, x)) + x**2 @ weigh_priors(free)

    def list_values(self, free: Sequence[Free], x: Floats) -> dict[str, float]:
        """Parameters by name, SI units, of scaled unknowns `x` (p,), as the model takes them."""
        return {f.name: f.value(float(v)) for f, v in zip(free, x, strict=True)}

    def convert_unknowns(self, free: Sequence[Free], x: Floats) -> Floats:
        """Parameters in SI units, (m, p), of scaled unknowns `x` (m, p)."""
        values = np.array([[f.value(v) for f, v in zip(free, row, strict=True)] for row in x])
        return limit_dynamic_friction([f.name for f in free], values)

    def subtract_measurements(self, predictions: Floats) -> Floats:
        """Predicted minus measured, without steady lines of the mains, (m, s, n) as `predictions`: the misfit of a fit.

        Its slope is that of the prediction. What a report shows is the residual, measured minus model.
        """
        # an observer's replay that bounces otherwise than the measured motor is off by far more than any hum
        most = HUM_MOST_SD if self.model.kind.correct is not None else np.inf
        limits = most * np.array([n.level for n in self.noise])
        residuals, start, period = np.empty(predictions.shape), 0, self.model.values["controller.period"]
        for trace in (self.trace, *self.also):
            np.subtract(predictions[..., start:start + len(trace)], trace.measurements,
                        out=residuals[..., start:start + len(trace)])
            for part in trace.parts or _cut_rows(len(trace)):
                remove_mains(residuals, start + part.first, start + part.stop, period, limits)
            start += len(trace)
        return residuals

    def whiten_residuals(self, residuals: Floats) -> Floats:
        """Residuals (m, s, n) as white noise of variance 1, if only noise is left; where nothing was measured, 0."""
        residuals = np.ascontiguousarray(residuals, float)
        white = np.empty_like(residuals)
        self._whiten(residuals, white)
        return white

    def _whiten(self, residuals: Floats, white: Floats) -> None:
        for i, noise in enumerate(self.noise):
            noise.whiten_signal(residuals, i, white)


P = TypeVar("P", bound=Problem)


def scale_noise(problem: P, factor: float) -> P:
    """The problem with its noise taken for `factor` times as large: small events then count less, priors more."""
    return replace(problem, noise=tuple(n._replace(innovation=factor * n.innovation) for n in problem.noise))


def span_all_rows(trace: Trace) -> Part:
    """All rows of a trace as its only part."""
    return Part(0, len(trace), 0)


def cut_runs(shape: Sequence[int], most: int = 120_000) -> list[slice]:
    """The runs of an array (m, s, n) a few at a time, so that the processor's cache holds all that is made of them."""
    count = max(1, most // (shape[1] * shape[2]))
    return [slice(first, first + count) for first in range(0, shape[0], count)]


def _cut_rows(rows: int, most: int = 60_000) -> list[Part]:
    """All rows in pieces of at most so many: the lines of the mains keep their phase no longer."""
    return [Part(first, min(first + most, rows), 0) for first in range(0, rows, most)]


def cut_blocks(white: Floats, block: int = BLOCK) -> Floats:
    """Whitened residuals (.., n) in blocks of so many, (.., b, block), zeros at the end of the last."""
    n = white.shape[-1]
    if n % block:
        white = np.concatenate([white, np.zeros((*white.shape[:-1], -n % block))], axis=-1)
    return white.reshape(*white.shape[:-1], -1, block)


def sum_blocks(white: Floats, block: int = BLOCK) -> Floats:
    """Sums of squares of whitened residuals (.., n) over blocks of so many: (.., b)."""
    blocks = cut_blocks(white, block)
    return np.asarray(np.einsum("...i,...i->...", blocks, blocks))


def compute_misfit(white: Floats) -> Floats:
    """-2 log likelihood of whitened residuals (m, s, n), up to a constant: (m,)."""
    sums = sum_blocks(white)
    limit = BLOCK_FITTED_SQUARE * BLOCK
    beyond = limit * (1.0 + np.log(np.maximum(sums, limit) / limit))
    return np.asarray(np.where(sums <= limit, sums, beyond).sum(axis=(1, 2)))


def weigh_blocks(white: Floats, block: int = BLOCK) -> Floats:
    """Weights of the squares in each block, (.., b), that give `compute_misfit` its slope at residuals (.., n).

    Of residuals at fewer samples, `block` is the number of them in a block.
    """
    sums = sum_blocks(white, block)
    return np.asarray(np.minimum(1.0, BLOCK_FITTED_SQUARE * block / np.maximum(sums, 1e-300)))


def compute_weights(white: Floats) -> Floats:
    """The weights of `weigh_blocks` for each sample, (s, n), of whitened residuals (s, n)."""
    return np.repeat(weigh_blocks(white), BLOCK, axis=-1)[:, :white.shape[-1]]


def compute_typical_rms(residuals: Floats, share: float = 0.85) -> Floats:
    """RMS of residuals (s, n) without the worst blocks: a stop of the ram that is made or missed by a hair is luck.

    Samples that are missing are left out, and do not fill blocks; 0 where all are.
    """
    squares = [np.sort(sum_blocks(row[~np.isnan(row)])) for row in residuals]
    means = [each[:max(1, round(share * len(each)))].mean() if len(each) else 0.0 for each in squares]
    return np.asarray(np.sqrt(np.array(means) / BLOCK))


UNREPLAYED = ("command", "reading")  # ports that a replay from the measured current does not pass


def list_relative_tolerances(model: Model, names: Iterable[str]) -> dict[str, float]:
    """Of the named parameters those that differ from one healthy unit to the next, with one tolerance as a fraction."""
    tolerances = {name: model.kind.find_tolerance(name, find_quantity(name, plant=model.plant)) for name in names}
    return {name: tolerance for name, tolerance in tolerances.items() if tolerance > 0.0}


def list_tolerance_sizes(model: Model) -> dict[str, float]:
    """The parameters that differ from one healthy unit to the next, with one tolerance in SI units."""
    sizes = {name: tolerance * abs(model[name])
             for name, tolerance in list_relative_tolerances(model, model.list_names()).items()}
    return {name: size for name, size in sizes.items() if size > 0.0}


def list_tolerance_unknowns(model: Model) -> tuple[Free, ...]:
    """The parameters with a tolerance as unknowns of a fit, each with its tolerance as prior.

    The tolerance is a fraction of the nominal value, so that it does not depend on the model's own.
    """
    nominal = model.nominal
    free = []
    for name, tolerance in list_relative_tolerances(model, model.values).items():
        value, q = model.values[name], find_quantity(name, plant=model.plant)
        scale = tolerance * (abs(nominal.get(name, value)) or 1.0)
        low, high = value - HEALTHY_TOLERANCES * scale, value + HEALTHY_TOLERANCES * scale
        free.append(Free(name, value, scale, 1.0, max(q.low, q.above, low), min(q.high, q.below, high), 0.3))
    return tuple(free)


def list_effect_unknowns(effect: Effect, model: Model, turning: float = 2e-3) -> tuple[Free, ...]:
    """The parameters of an effect as unknowns of a fit, without prior: only their possible range is known.

    `turning`, Hz, is the first difference of a frequency: a small part of a turn over a test.
    """
    nominal, free = model.nominal, []
    for name in effect.fitted:
        q, off = effect.parameters[name], effect.off.get(name, nominal.get(name, 0.0))
        sizes = sorted(abs(start[name] - off) for start in effect.starts)
        scale = (sizes[len(sizes) // 2] if sizes else abs(model[name] - off)) or 1.0
        step = turning / scale if q.unit == "Hz" else 0.05
        free.append(Free(name, off, scale, np.inf, max(q.low, q.above), min(q.high, q.below), step))
    return tuple(free)


def name_sine(entry: Effect) -> tuple[str, str, str] | None:
    """Names of the amplitude, the frequency and the phase of an effect that has them."""
    names = {entry.parameters[n].unit: n for n in entry.fitted}
    amplitude = next((n for n in entry.fitted if entry.parameters[n].unit not in ("Hz", "rad")), None)
    if amplitude is None or not {"Hz", "rad"} <= set(names) or not entry.starts:
        return None
    return amplitude, names["Hz"], names["rad"]


def turn_amplitudes_positive(free: Sequence[Free], x: Floats, effects: Iterable[Effect]) -> Floats:
    """Scaled unknowns, (p,), of the same sines with amplitudes that are not negative and phases within half a turn."""
    x, place = x.copy(), {f.name: k for k, f in enumerate(free)}
    for sine in map(name_sine, effects):
        if sine is None or sine[0] not in place:
            continue
        size, angle = place[sine[0]], place[sine[2]]
        amplitude, phase = (free[k].centre + free[k].scale * x[k] for k in (size, angle))
        phase += np.pi * (amplitude < 0.0)
        x[size] = (abs(amplitude) - free[size].centre) / free[size].scale
        x[angle] = ((phase + np.pi) % (2.0 * np.pi) - np.pi - free[angle].centre) / free[angle].scale
    return x


def list_active_effects(model: Model) -> tuple[str, ...]:
    """Effects at work in a model; those of the reference model if no healthy unit could be so far off nominal."""
    return tuple(e.name for e in model.kind.list_effects()
                 if (_is_off_nominal(e, model) if e.base else e.name in model.effects and e.is_active(model.values)))


def list_active_unknowns(model: Model) -> tuple[Free, ...]:
    """The parameters of the active effects as unknowns of a fit, from their present values and without prior."""
    effects = [e for e in map(model.find_effect, list_active_effects(model)) if e.port not in UNREPLAYED]
    return tuple(u._replace(centre=model[u.name]) for e in effects for u in list_effect_unknowns(e, model))


def list_all_unknowns(model: Model) -> tuple[Free, ...]:
    """All that is free in a model: tolerances, and the parameters of the effects that it has."""
    active_unknowns = list_active_unknowns(model)
    names = {u.name for u in active_unknowns}
    return (*(f for f in list_tolerance_unknowns(model) if f.name not in names), *active_unknowns)


def _is_off_nominal(e: Effect, model: Model) -> bool:
    nominal = model.nominal
    tolerance = model.kind.find_tolerance
    return any(abs(model[name] - nominal[name]) > (HEALTHY_TOLERANCES * tolerance(name, q) + 1e-12) * abs(nominal[name])
               for name, q in e.parameters.items())


def silence_sensors(model: Model) -> Model:
    """The model without the noise of its sensors."""
    return model.replace({signal.noise: 0.0 for signal in model.kind.signals if signal.noise})


def complete_model(model: Model) -> Model:
    """The model without sensor noise and with all effects that are searched in its plant, at their off values."""
    return silence_readings(model.with_effects(e.name for e in list_searched_effects(model.plant) if not e.disturbance))


def silence_readings(model: Model) -> Model:
    """The model without sensor noise and rounding: these are what fits allow for."""
    readings = [e for e in map(model.find_effect, model.effects) if e.port == "reading"]
    return silence_sensors(model).replace({name: value for e in readings for name, value in e.off.items()})


LEAST_SLOPE_SQUARE = 1e-6  # of an unknown over one of its scales, all residuals together: less is not seen
DAMPINGS = (0.0, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
FIT_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters found: `x` (p,) scaled, `cost` = -2 log likelihood with priors, `covariance` (p, p) of x."""

    free: tuple[Free, ...]
    x: Floats
    cost: float
    misfit: float  # the cost without the priors
    covariance: Floats
    residuals: Floats  # (s, n), SI units
    white: Floats  # (s, n), whitened
    jacobian: Floats  # (p, s, n), whitened, at x or one step before it
    converged: bool = False

    @property
    def values(self) -> dict[str, float]:
        """Parameters in SI units; a ratio of two frictions stays one, which `Problem.list_values` makes a friction."""
        return {f.name: f.value(float(v)) for f, v in zip(self.free, self.x, strict=True)}

    def spread(self, name: str) -> float:
        """Standard deviation of a parameter, SI units."""
        i = [f.name for f in self.free].index(name)
        return float(np.sqrt(self.covariance[i, i])) * self.free[i].scale

    @property
    def is_far(self) -> bool:
        """True when few healthy units have such tolerances, all together or the furthest of them."""
        squares = weigh_priors(self.free) * self.x**2
        count = np.count_nonzero(np.isfinite([f.prior for f in self.free]))
        share = min(chdtrc(count, squares.sum()), count * chdtrc(1, squares.max(initial=0.0)))
        return bool(share < TOLERANCES_FAR_SHARE)


class Value(NamedTuple):
    """A parameter with its 95 % interval, SI."""

    value: float
    low: float
    high: float
    unit: str


def fit_unknowns(problem: Problem, free: Sequence[Free], start: Floats | None = None, rounds: int = FIT_ROUNDS) -> Fit:
    """The most likely parameters near `start` (p,), scaled (default: the centres)."""
    x = np.zeros(len(free)) if start is None else np.array(start, float)
    return continue_fit(problem, _begin_fit(problem, free, x), rounds)


def continue_fit(problem: Problem, fit: Fit, rounds: int = FIT_ROUNDS) -> Fit:
    """A fit after so many further rounds, or fewer if it converges."""
    for _ in range(rounds):
        gradient, hessian = form_normal_equations(fit)
        best = find_best_trial(problem, fit, step_within_bounds(fit, hessian, gradient))
        gain = fit.cost - best.cost
        if gain < max(CONVERGED_GAIN, CONVERGED_SHARE * fit.cost):
            return replace(best if gain > 0.0 else fit, converged=True, covariance=_invert(hessian))
        fit = _differentiate(problem, best, _choose_widths(fit.free, hessian))
    return _add_covariance(fit)


def find_best_trial(problem: Problem, fit: Fit, trials: Floats) -> Fit:
    """The fit at the best of the trials (m, p); its Jacobian and covariance stay as they are."""
    predictions = problem.predict_unknowns(fit.free, trials)
    white = problem.whiten_predictions(predictions)
    misfits = compute_misfit(white)
    costs = misfits + trials**2 @ weigh_priors(fit.free)
    k = int(np.argmin(costs))
    return replace(fit, x=trials[k], cost=float(costs[k]), misfit=float(misfits[k]),
                   residuals=problem.subtract_measurements(predictions[k:k + 1])[0], white=white[k].copy())


def linearise(problem: Problem, free: Sequence[Free], x: Floats) -> Fit:
    """The model at `x` (p,) with its Jacobian by differences, away from a bound, and the covariance of that."""
    return _add_covariance(_begin_fit(problem, free, x))


def _begin_fit(problem: Problem, free: Sequence[Free], x: Floats) -> Fit:
    moves = _choose_moves(free, x, np.array([f.step for f in free]))
    predictions = problem.predict_unknowns(free, np.vstack([x, x + np.diag(moves)]))
    white = problem.whiten_predictions(predictions)
    misfit = float(compute_misfit(white[:1])[0])
    none = np.empty(0)  # Jacobian and covariance follow
    fit = Fit(tuple(free), x, misfit + float(x**2 @ weigh_priors(free)), misfit, none,
              problem.subtract_measurements(predictions[:1])[0], white[0].copy(), none)
    return _take_differences(fit, white[1:], moves)


def _differentiate(problem: Problem, fit: Fit, step: Floats) -> Fit:
    """The fit with its Jacobian where it is, by differences of `step` (p,) from what it leaves there."""
    moves = _choose_moves(fit.free, fit.x, step)
    return _take_differences(fit, problem.compute_white_residuals(fit.free, fit.x + np.diag(moves)), moves)


def _choose_moves(free: Sequence[Free], x: Floats, step: Floats) -> Floats:
    """Differences of the unknowns, (p,), each away from its upper bound."""
    is_high = np.array([f.centre + f.scale * (v + h) > f.high for f, v, h in zip(free, x, step, strict=True)])
    return np.where(is_high, -step, step)


def _take_differences(fit: Fit, white: Floats, moves: Floats) -> Fit:
    """The fit with its Jacobian from the whitened residuals (p, s, n), used up, after each move (p,)."""
    white -= fit.white
    white /= moves[:, None, None]
    return replace(fit, jacobian=white)


def replay_fit(problem: Problem, fit: Fit, x: Floats) -> Fit:
    """The fit at `x` (p,) with what `problem` leaves there; its Jacobian and covariance stay as they are."""
    return find_best_trial(problem, fit, x[None])


def form_normal_equations(fit: Fit) -> tuple[Floats, Floats]:
    """Gradient (p,) and Gauss-Newton Hessian (p, p) of half the cost."""
    prior = weigh_priors(fit.free)
    flat = fit.jacobian.reshape(len(fit.x), fit.white.size)
    heavy = flat * compute_weights(fit.white).reshape(-1)
    return heavy @ fit.white.reshape(-1) + prior * fit.x, heavy @ flat.T + np.diag(prior)


def _add_covariance(fit: Fit) -> Fit:
    return replace(fit, covariance=_invert(form_normal_equations(fit)[1]))


def _invert(hessian: Floats) -> Floats:
    covariance = np.asarray(np.linalg.pinv(hessian), np.float64)
    return invert_hessian(hessian) if (np.diag(covariance) < 0.0).any() else covariance


def invert_hessian(hessian: Floats) -> Floats:
    """The covariance (p, p) of a Hessian (p, p), with every unknown first scaled to a diagonal of one.

    Stick-slip makes some slopes enormous. Beside an eigenvalue of 1e15 a pseudo-inverse takes the 1 of a prior for
    zero and the direction that only this prior holds for known: sizes along it got intervals forty times too narrow.
    """
    diagonal = np.diag(hessian)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    return scale[:, None] * np.linalg.pinv(scale[:, None] * hessian * scale) * scale


def _choose_widths(free: Sequence[Free], hessian: Floats) -> Floats:
    widest = np.array([f.step for f in free])
    difference_width_sd = 3.0  # of a parameter: differences wide enough for stick-slip, narrow at the end
    widths = difference_width_sd / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    return np.clip(widths, 0.01 * widest, widest)  # times the first width


def step_within_bounds(fit: Fit, hessian: Floats, gradient: Floats, dampings: Sequence[float] = DAMPINGS) -> Floats:
    """Damped Gauss-Newton steps within the bounds, (m, p): what runs into one stays there, the rest is solved again."""
    low, high = scaled_bounds(fit.free)
    diagonal = np.outer(dampings, np.diag(hessian)) + 1e-12 * np.trace(hessian) + 1e-12
    damped_hessian = hessian + diagonal[:, None, :] * np.eye(len(gradient))
    x = np.tile(fit.x, (len(dampings), 1))
    # what changes nothing has a slope of rounding errors, which would carry it anywhere
    is_open = np.tile(np.diag(hessian) > LEAST_SLOPE_SQUARE, (len(dampings), 1))
    for _ in fit.x:
        bound_steps = np.where(is_open, 0.0, x - fit.x)
        matrix = np.where(is_open[:, :, None] & is_open[:, None, :], damped_hessian,
                          ~is_open[:, :, None] * np.eye(len(gradient)))
        right_side = np.where(is_open, -gradient - (damped_hessian @ bound_steps[:, :, None])[..., 0], bound_steps)
        x = fit.x + np.linalg.solve(matrix, right_side[..., None])[..., 0]
        is_out = is_open & ((x < low) | (x > high))
        x = np.clip(x, low, high)
        is_open &= ~is_out
        if not is_out.any():
            break
    return x


def cut_at_bounds(free: Sequence[Free], x: Floats, move: Floats) -> Floats:
    """The move, or its opposite, cut off at the bounds: whichever is longer then."""
    low, high = scaled_bounds(free)
    ways = [np.clip(x + way, low, high) - x for way in (move, -move)]
    return max(ways, key=lambda way: float(way @ way))


def evolve_fit(problem: Problem, fit: Fit, spread: Floats, generations: int, seed: int, patience: int = 15) -> Fit:
    """The fit at the best trial of a population that begins at it; its covariance is that of the last trials.

    Args:
        problem: the run.
        fit: centre of the first trials.
        spread: their covariance, (p, p).
        generations: at most.
        seed: of the trials.
        patience: generations without a gain after which the search ends.
    """
    if not fit.free:  # a plant without tolerances
        return fit
    size = min(64, 16 * -(-len(fit.x) // 4))  # trials of a generation, whole blocks of lanes; few unknowns need few
    low, high = scaled_bounds(fit.free)
    rng, n = np.random.default_rng(seed), len(fit.x)
    parents = size // 2
    weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = 1.0 / float((weights**2).sum())
    path_rate = (4.0 + effective / n) / (n + 4.0 + 2.0 * effective / n)
    step_rate = (effective + 2.0) / (n + effective + 5.0)
    rank_one = 2.0 / ((n + 1.3) ** 2 + effective)
    rank_many = min(1.0 - rank_one, 2.0 * (effective - 2.0 + 1.0 / effective) / ((n + 2.0) ** 2 + effective))
    damping = 1.0 + 2.0 * max(0.0, float(np.sqrt((effective - 1.0) / (n + 1.0))) - 1.0) + step_rate
    usual_length = np.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))
    centre, step = fit.x, 1.0
    path, step_path = np.zeros(n), np.zeros(n)
    best, best_cost, idle = fit.x, np.inf, 0
    for generation in range(1, generations + 1):
        variances, axes = np.linalg.eigh(0.5 * (spread + spread.T))
        lengths = np.sqrt(np.maximum(variances, 1e-24))
        trials = np.clip(centre + step * (rng.standard_normal((size, n)) * lengths) @ axes.T, low, high)
        costs = problem.compute_costs(fit.free, trials)
        order = np.argsort(costs)
        gain = best_cost - float(costs[order[0]])
        idle = 0 if gain > max(CONVERGED_GAIN, CONVERGED_SHARE * float(costs[order[0]])) else idle + 1
        if gain > 0.0:
            best, best_cost = trials[order[0]], float(costs[order[0]])
        moves = (trials[order[:parents]] - centre) / step
        move = weights @ moves
        centre = centre + step * move
        white_move = axes @ ((axes.T @ move) / lengths)
        step_path = (1.0 - step_rate) * step_path + np.sqrt(step_rate * (2.0 - step_rate) * effective) * white_move
        length = float(np.linalg.norm(step_path))
        start_factor = np.sqrt(1.0 - (1.0 - step_rate) ** (2 * generation))
        is_short = length / start_factor < (1.4 + 2.0 / (n + 1.0)) * usual_length
        path = (1.0 - path_rate) * path
        if is_short:
            path += np.sqrt(path_rate * (2.0 - path_rate) * effective) * move
        missing_variance = 0.0 if is_short else path_rate * (2.0 - path_rate)
        spread = ((1.0 - rank_one - rank_many + rank_one * missing_variance) * spread + rank_one * np.outer(path, path)
                  + rank_many * (moves.T * weights) @ moves)
        step *= float(np.exp(min(1.0, step_rate / damping * (length / usual_length - 1.0))))
        if idle >= patience:
            break
    return replace(fit, x=best, cost=best_cost, covariance=step**2 * spread)


def follow_population(problem: Problem, fit: Fit, spread: Floats, stages: Sequence[tuple[float, int]], seed: int,
                      descend: Callable[[Fit, float], Fit]) -> Fit:
    """The fit at which a population ends whose noise counts for less from stage to stage.

    Args:
        problem: the run, with its own noise.
        fit: where the first trials are centred.
        spread: their covariance, (p, p).
        stages: factor on the noise and generations, each.
        seed: of the trials.
        descend: takes a fit some rounds further, with the noise so many times as large.
    """
    for number, (factor, generations) in enumerate(stages):
        best = evolve_fit(scale_noise(problem, factor), fit, spread, generations, 10 * seed + number)
        spread = 4.0 * best.covariance
        end = descend(best, factor)
        fit = end if end.cost < best.cost else best
    return fit
