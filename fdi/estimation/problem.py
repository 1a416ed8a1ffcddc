"""A model with parameters to be found, held against measured runs: many trial values at once."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.noise import Noise
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE, Effect
from plant.lanes import Lanes
from plant.model import Model, meaning, offered
from plant.threads import mapped

Floats = NDArray[np.float64]

STEPS = 10  # a cycle, 100 us: against 10 us a replay moves by less than the sensors noise; the last fits use more
ANCHOR = 20.0  # 1/s; a free replay adds up every bias for ever, this one forgets within 50 ms
FURTHEST = 5.0  # tolerances that a healthy unit may be off; beyond, something is wrong with it
TURNING = 2e-3  # Hz, first difference of a frequency: a small part of a turn over a test
HUM = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0, 400.0)  # Hz
QUIET = {f"sensors.{q}_noise": 0.0 for q in ("position", "pressure", "spool")}


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


def ends(free: Sequence[Free]) -> tuple[Floats, Floats]:
    """The least and the most that scaled unknowns, (p,), can be."""
    low, high = (np.array([(getattr(f, end) - f.centre) / f.scale for f in free]) for end in ("low", "high"))
    return low, high


def tolerances(model: Model) -> tuple[Free, ...]:
    """The parameters in which one healthy unit differs from another, each with its tolerance as prior."""
    usual = model.kind.nominal
    free = []
    for name, value in model.values.items():
        q = meaning(name, plant=model.plant)
        if (tolerance := model.kind.tolerance(name, q)) > 0.0:
            scale = tolerance * (abs(usual.get(name, value)) or 1.0)
            low, high = value - FURTHEST * scale, value + FURTHEST * scale
            free.append(Free(name, value, scale, 1.0, max(q.low, q.above, low), min(q.high, q.below, high), 0.3))
    return tuple(free)


def unknowns(effect: Effect, model: Model) -> tuple[Free, ...]:
    """The parameters of an effect that is to be fitted: nothing is known of them but the possible range."""
    usual, free = model.kind.nominal, []
    for name in effect.fitted:
        q, off = effect.parameters[name], effect.off.get(name, usual.get(name, 0.0))
        sizes = sorted(abs(start[name] - off) for start in effect.starts)
        scale = sizes[len(sizes) // 2] or 1.0
        step = TURNING / scale if q.unit == "Hz" else 0.05
        free.append(Free(name, off, scale, np.inf, max(q.low, q.above), min(q.high, q.below), step))
    return tuple(free)


@dataclass
class Problem:
    """A model, the whole catalogue ready in it at off values, and runs to hold it against.

    Predictions and residuals of several runs follow one another along time.
    """

    model: Model  # with every effect that may be tried
    trace: Trace
    noise: tuple[Noise, ...]  # of each signal
    steps: int = STEPS
    anchor: float = ANCHOR
    workers: int = 1
    bare: Model | None = None  # the same without the effects at off values: five times as fast where it will do
    also: tuple[Trace, ...] = ()  # further runs, of the same signals, that a fit takes in
    _lanes: dict[tuple[str, ...], Lanes] = field(default_factory=dict)

    def predict(self, names: Sequence[str], values: Floats) -> Floats:
        """Replays with the named parameters at `values` (m, p): (m, s, n) in SI units."""
        runs = mapped(lambda r: self.all_signals(names, values, r)[:, r.output_columns], (self.trace, *self.also),
                      self.workers)
        return np.concatenate(runs, axis=-1) if self.also else runs[0]

    def all_signals(self, names: Sequence[str], values: Floats, trace: Trace | None = None) -> Floats:
        """XJ, P12 and XS of one run (default: the first), whichever were measured: (m, 3, n)."""
        key = tuple(names)
        if key not in self._lanes:
            bare = self.bare is not None and set(key) <= set(self.bare.values)
            self._lanes[key] = Lanes(self.bare if bare and self.bare else self.model, key, self.steps, self.workers)
        trace = self.trace if trace is None else trace
        out = self._lanes[key].replay(values, trace.cor, trace.load, trace.position, self.anchor)
        signals: Floats = out.transpose(0, 2, 1)
        return signals

    def residuals(self, free: Sequence[Free], x: Floats) -> Floats:
        """Model minus measurement for scaled unknowns `x` (m, p): (m, s, n), SI units, NaN where not measured."""
        values = np.array([[f.value(v) for f, v in zip(free, row, strict=True)] for row in x])
        return self.left(self.predict([f.name for f in free], _sorted_friction(free, values)))

    def left(self, predicted: Floats) -> Floats:
        """What predictions (m, s, n) leave of the measurement, but for steady lines of the mains: (m, s, n)."""
        parts, start = [], 0
        for trace in (self.trace, *self.also):
            residuals = predicted[..., start:start + len(trace)] - trace.measurements
            lines = mains(len(trace), self.model.values["controller.period"])
            parts.append(residuals - (np.nan_to_num(residuals) @ lines) @ lines.T)
            start += len(trace)
        return np.concatenate(parts, axis=-1) if self.also else parts[0]

    def whitened(self, residuals: Floats) -> Floats:
        """Residuals (m, s, n) as white noise of variance 1, if only noise is left; where nothing was measured, 0."""
        return np.stack([n.whiten(residuals[:, i]) for i, n in enumerate(self.noise)], axis=1)


@cache
def mains(n: int, period: float) -> Floats:
    """Orthonormal sines and cosines of the mains' lines over n samples, (n, k): what a steady hum looks like.

    A hum that starts with the test has the same phase in every run, so no repeat tells it from physics.
    """
    t = 2.0 * np.pi * period * np.arange(n)
    lines = [f for f in HUM if f < 0.45 / period]
    waves: Floats = np.linalg.qr(np.column_stack([w(f * t) for f in lines for w in (np.sin, np.cos)]))[0]
    return waves


def _sorted_friction(free: Sequence[Free], values: Floats) -> Floats:
    """Dynamic friction is never above static friction: trial values of a fit are made so."""
    names = [f.name for f in free]
    for body in ("spool", "jack"):
        static, dynamic = f"{body}.static_friction", f"{body}.dynamic_friction"
        if static in names and dynamic in names:
            i, j = names.index(static), names.index(dynamic)
            values[:, j] = np.minimum(values[:, i], values[:, j])
    return values


def whole(model: Model) -> Model:
    """The model without sensor noise and with all effects that its plant may have, at their off values."""
    return quiet(model.having(e.name for e in offered(model.plant) if not e.disturbance))


def quiet(model: Model) -> Model:
    """The model without sensor noise and rounding: these are what fits allow for."""
    readings = [CATALOGUE[name] for name in model.effects if CATALOGUE[name].port == "reading"]
    return model.replace(QUIET | {name: value for e in readings for name, value in e.off.items()})
