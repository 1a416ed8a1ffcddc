"""Unknowns by their logarithms: gains, areas, forces and frictions of a plant scale.

What may be scaled together without changing a signal is a straight line in logarithms.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.likelihood import Free, Problem, limit_dynamic_friction

Floats = NDArray[np.float64]


class LogFree(Free):
    """A parameter by its logarithm: centre, scale and bounds are those of the logarithm."""

    __slots__ = ()

    def value(self, x: float) -> float:
        """The parameter in SI units."""
        return math.exp(super().value(x))


class LogFrictionRatio(LogFree):
    """Static friction by the logarithm of its ratio to the dynamic one of the same body, which comes before it."""

    __slots__ = ()

    @property
    def dynamic_name(self) -> str:
        """The dynamic friction's name."""
        return self.name.replace("static", "dynamic")


class LogOpenFilter(Free):
    """Kintas by the logarithm of what the filter lets through, 1 - Kintas: gains go with powers of it."""

    __slots__ = ()

    def value(self, x: float) -> float:
        """Kintas."""
        return 1.0 - math.exp(super().value(x))


def take_logarithm(f: Free) -> Free:
    """A tolerance as one of the logarithm; unchanged if the parameter may be zero."""
    if f.low <= 0.0:
        return f
    return LogFree(f.name, math.log(f.centre), f.scale / f.centre, f.prior, math.log(f.low), math.log(f.high), f.step)


def compute_values(free: Sequence[Free], x: Floats) -> Floats:
    """Parameters in SI units, (p,), of scaled unknowns (p,)."""
    found = np.array([f.value(float(v)) for f, v in zip(free, x, strict=True)])
    names = [f.name for f in free]
    for k, f in enumerate(free):
        if isinstance(f, LogFrictionRatio):
            found[k] *= found[names.index(f.dynamic_name)]
    return limit_dynamic_friction(names, found)


@dataclass
class LogProblem(Problem):
    """A problem whose unknowns may be logarithms, the jack's static friction by its ratio to the dynamic one."""

    def convert_unknowns(self, free: Sequence[Free], x: Floats) -> Floats:
        return np.array([compute_values(free, row) for row in x])

    def list_values(self, free: Sequence[Free], x: Floats) -> dict[str, float]:
        return dict(zip([f.name for f in free], compute_values(free, x).tolist(), strict=True))
