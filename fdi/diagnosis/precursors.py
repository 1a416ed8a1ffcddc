"""What a trace's response says in single numbers, each beside its healthy scatter and what either fault does to it.

The mean error on a slow ramp is the classic sign of friction, and does not depend on it while the ram slides
(docs/physics.md, "Closed forms"): the signal-to-noise in the table shows which precursors really tell.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.envelope import Bands
from fdi.diagnosis.faults import CLOGGING, FRICTION
from fdi.diagnosis.features import MEANINGS, OF_STEPS, features, kind_of
from fdi.thresholds import POSITION_MISSING_SHARE
from fdi.trace.sections import sections
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]

class Precursor(NamedTuple):
    """One number, SI or %, NaN where the trace does not show it; the rest is NaN without bands."""

    value: float
    unit: str  # "m", "s", "m/s", "Hz", "%" or "1"
    words: str
    shown: str  # the value in the unit that people use
    healthy: float  # mean of healthy units
    noise: float  # standard deviation of healthy units
    clogging: float  # what Table 2's lesser clogging adds
    friction: float  # what its lesser friction adds

    @property
    def departure(self) -> float:
        """From the healthy mean, in healthy standard deviations."""
        return (self.value - self.healthy) / self.noise if self.noise > 0.0 else math.nan

    @property
    def clogging_ratio(self) -> float:
        """Signal to noise: what Kintas 0.25 does, in healthy standard deviations."""
        return self.clogging / self.noise if self.noise > 0.0 else math.nan

    @property
    def friction_ratio(self) -> float:
        """Signal to noise: what FSS 35 N does, in healthy standard deviations."""
        return self.friction / self.noise if self.noise > 0.0 else math.nan


def measure(source: Trace, bands: Bands | None = None) -> dict[str, Precursor]:
    """The precursors of a trace by name; empty where too much of the position is missing."""
    from fdi.diagnosis.bands import columns

    com, xj, _, period, _ = columns(source)
    missing = np.isnan(xj)
    if missing.mean() > POSITION_MISSING_SHARE:
        return {}
    rows = np.arange(len(xj))
    whole = np.interp(rows, rows[~missing], xj[~missing])
    found = features(com, whole[None], period, sections(com, period))
    known = bands.precursors if bands is not None else {}
    return {name: _precursor(name, float(values[0]), known.get(name, {})) for name, values in found.items()}


def _precursor(name: str, value: float, known: Mapping[str, float]) -> Precursor:
    kind = MEANINGS[kind_of(name)]
    size = f", {name.rpartition('_')[2].replace('mm', ' mm')}" if kind_of(name) in OF_STEPS else ""
    numbers = (known.get(key, math.nan) for key in ("healthy", "noise", CLOGGING.name, FRICTION.name))
    return Precursor(value, SI.get(kind.unit, kind.unit), kind.words + size, shown(value, name), *numbers)


SI = {"ms": "s", "um": "m", "mm/s": "m/s"}


def shown(value: float, name: str) -> str:
    """A value of a precursor in the unit that people use.

    >>> shown(1.905e-05, "break_away"), shown(7.41, "overshoot_5mm")
    ('19.1 um', '7.41 %')
    """
    kind = MEANINGS[kind_of(name)]
    return f"{value * kind.scale:.3g} {kind.unit}" if math.isfinite(value) else "-"
