"""The unknowns of a fit, and the likelihood of measured runs: replays of many values, whitened, counted by blocks.

Blocks of residuals may hold more noise than is known: a block that is fitted counts by its squares, one that is not by
the logarithm of its mean square. So no single stop of the ram, made or missed, outweighs a whole run, and physics that
is missing is not made up for by parameters that no healthy unit has.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from fdi.estimation.noise import Noise
from fdi.thresholds import ANCHOR_RATE, BLOCK_FITTED_SQUARE
from fdi.trace.trace import Floats, Trace
from plant.lanes import Lanes, Part
from plant.model import Model
from plant.threads import map_in_threads

HUM = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0, 400.0)  # Hz
BLOCK = 100  # cycles


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
    limited = limit_dynamic_friction(names, np.array([values[name] for name in names]))
    return {**values, **dict(zip(names, limited.tolist(), strict=True))}


@dataclass
class Problem:
    """A model, the whole catalogue ready in it at off values, and runs to hold it against.

    Predictions and residuals of several runs follow one another along time.
    """

    model: Model  # with every effect that may be tried
    trace: Trace
    noise: tuple[Noise, ...]  # of each signal
    steps: int = 10  # a cycle, 100 us: differs from 10 us by less than the sensors' noise; last fits use more
    anchor: float = ANCHOR_RATE
    workers: int = 1
    bare: Model | None = None  # the same without the effects at off values: five times as fast where it will do
    also: tuple[Trace, ...] = ()  # further runs, of the same signals, that a fit takes in
    _lanes: dict[tuple[str, ...], Lanes] = field(default_factory=dict)

    def predict_outputs(self, names: Sequence[str], values: Floats) -> Floats:
        """Replays with the named parameters at `values` (m, p): (m, s, n) in SI units."""
        def predict_run(run: Trace) -> Floats:
            return self.predict_signals(names, values, run)[:, run.output_columns]

        runs = map_in_threads(predict_run, (self.trace, *self.also), self.workers)
        return np.concatenate(runs, axis=-1) if self.also else runs[0]

    def predict_signals(self, names: Sequence[str], values: Floats, trace: Trace | None = None) -> Floats:
        """XJ, P12 and XS of one run (default: the first), as its sensors show them, measured or not: (m, 3, n)."""
        key = tuple(names)
        if key not in self._lanes:
            bare = self.bare is not None and set(key) <= set(self.bare.values)
            self._lanes[key] = Lanes(self.bare if bare and self.bare else self.model, key, self.steps, self.workers)
        trace = self.trace if trace is None else trace
        out = self._lanes[key].replay(values, trace.cor, trace.load, trace.position, self.anchor, trace.parts,
                                      trace.chambers)
        return trace.pass_sensors(out).transpose(0, 2, 1)

    def compute_residuals(self, free: Sequence[Free], x: Floats) -> Floats:
        """Model minus measurement for scaled unknowns `x` (m, p): (m, s, n), SI units, NaN where not measured."""
        names = [f.name for f in free]
        return self.subtract_measurements(self.predict_outputs(names, self.convert_unknowns(free, x)))

    def compute_white_residuals(self, free: Sequence[Free], x: Floats) -> Floats:
        """The same, whitened: (m, s, n), 0 where not measured."""
        return self.whiten_residuals(self.compute_residuals(free, x))

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

    def subtract_measurements(self, predicted: Floats) -> Floats:
        """Predicted minus measured, without steady lines of the mains, (m, s, n) as `predicted`: the misfit of a fit.

        Its slope is that of the prediction. What a report shows is the residual, measured minus model.
        """
        parts, start = [], 0
        for trace in (self.trace, *self.also):
            residuals = predicted[..., start:start + len(trace)] - trace.measurements
            period = self.model.values["controller.period"]
            pieces = trace.parts or _cut_rows(len(trace))
            parts += [remove_mains(residuals[..., p.first:p.stop], period) for p in pieces]
            start += len(trace)
        return np.concatenate(parts, axis=-1) if len(parts) > 1 else parts[0]

    def whiten_residuals(self, residuals: Floats) -> Floats:
        """Residuals (m, s, n) as white noise of variance 1, if only noise is left; where nothing was measured, 0."""
        return np.stack([n.whiten(residuals[:, i]) for i, n in enumerate(self.noise)], axis=1)


P = TypeVar("P", bound=Problem)


def scale_noise(problem: P, factor: float) -> P:
    """The problem with its noise taken for `factor` times as large: small events then count less, priors more."""
    return replace(problem, noise=tuple(n._replace(innovation=factor * n.innovation) for n in problem.noise))


def span_all_rows(trace: Trace) -> Part:
    """All rows of a trace as its only part."""
    return Part(0, len(trace), 0)


def _cut_rows(rows: int, most: int = 60_000) -> list[Part]:
    """All rows in pieces of at most so many: the lines of the mains keep their phase no longer."""
    return [Part(first, min(first + most, rows), 0) for first in range(0, rows, most)]


def remove_mains(residuals: Floats, period: float) -> Floats:
    """Residuals (.., n) without the steady lines of the mains."""
    lines = mains_waves(residuals.shape[-1], period)
    complete = residuals if np.isfinite(residuals).all() else np.nan_to_num(residuals)
    return residuals - (complete @ lines) @ lines.T


@cache
def mains_waves(n: int, period: float) -> Floats:
    """Orthonormal sines and cosines of the mains' lines over n samples, (n, k): what a steady hum looks like.

    A hum that starts with the test has the same phase in every run, so no repeat tells it from physics.
    """
    t = 2.0 * np.pi * period * np.arange(n)
    lines = [f for f in HUM if f < 0.45 / period]
    return np.linalg.qr(np.column_stack([w(f * t) for f in lines for w in (np.sin, np.cos)]))[0]


def sum_blocks(white: Floats) -> Floats:
    """Sums of squares of whitened residuals (.., n) over blocks: (.., b)."""
    n = white.shape[-1]
    padded = np.concatenate([white, np.zeros((*white.shape[:-1], -n % BLOCK))], axis=-1)
    cut = padded.reshape(*white.shape[:-1], -1, BLOCK)
    sums: Floats = np.einsum("...i,...i->...", cut, cut)
    return sums


def compute_misfit(white: Floats) -> Floats:
    """-2 log likelihood of whitened residuals (m, s, n), up to a constant: (m,)."""
    sums = sum_blocks(white)
    limit = BLOCK_FITTED_SQUARE * BLOCK
    beyond = limit * (1.0 + np.log(np.maximum(sums, limit) / limit))
    total: Floats = np.where(sums <= limit, sums, beyond).sum(axis=(1, 2))
    return total


def compute_weights(white: Floats) -> Floats:
    """Weights of the squares, (s, n), that give `compute_misfit` its slope at whitened residuals (s, n)."""
    sums = sum_blocks(white)
    each = np.minimum(1.0, BLOCK_FITTED_SQUARE * BLOCK / np.maximum(sums, 1e-300))
    return np.repeat(each, BLOCK, axis=-1)[:, :white.shape[-1]]


def compute_typical_rms(residuals: Floats, share: float = 0.85) -> Floats:
    """RMS of residuals (s, n) without the worst blocks: a stop of the ram that is made or missed by a hair is luck."""
    squares = np.sort(sum_blocks(np.nan_to_num(residuals)), axis=-1)
    kept = squares[:, :max(1, round(share * squares.shape[1]))]
    rms: Floats = np.sqrt(kept.mean(axis=1) / BLOCK)
    return rms
