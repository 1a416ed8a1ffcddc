"""The laws a fault may grow by as columns of a regression: linear, exponential, power, each from an onset on.

Time u runs from 0 at the first trace to 1 at the last. A shape is 0 up to its onset and 1 at u = 1, so that its factor
is the rise seen so far, whatever the unit of time. A fourth law, the runaway, ends at a time of its own: growth in
proportion to the square of the size. It is there for the sake of faults that end sooner than an exponential would.
"""
from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LAWS = ("none", "linear", "exponential", "power", "runaway")
FOLDS = (0.5, 1.0, 2.0, 3.5, 5.5)  # e-foldings from the first trace to the last
EXPONENTS = (0.5, 0.7, 1.5, 2.0, 3.0)
BLOW_UPS = (1.1, 1.25, 1.5, 2.0, 3.0)  # when a runaway has no end any more; 1 is the last trace
WITHIN = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # onsets since the first trace
BEFORE = (-2.0, -0.5)  # a power law shows how long ago it began; the other two do not
RISES = (0.15, 1.0)  # one for what has only begun
LARGEST = 1e6


class Shape(NamedTuple):
    """One law with its onset, its e-foldings, exponent or end, and how large its rise is thought to be."""

    law: str
    onset: float = 0.0
    bend: float = 1.0
    rise: float = 1.0  # deviation of the half-normal prior, in units of (MaxBand - healthy)


@cache
def shapes() -> tuple[tuple[Shape, ...], Floats]:
    """Every shape and its prior, shape (k,): equal for the laws, half of it for growth before the first trace."""
    table = {"none": [Shape("none")], "linear": [Shape("linear", onset) for onset in WITHIN],
             "exponential": [Shape("exponential", onset, fold) for onset in WITHIN for fold in FOLDS],
             "power": [Shape("power", onset, p) for onset in (*BEFORE, *WITHIN) for p in EXPONENTS],
             "runaway": [Shape("runaway", onset, end) for onset in WITHIN for end in BLOW_UPS]}
    flat = tuple(shape for law in LAWS for shape in table[law])
    weights = []
    for law in LAWS:
        early = sum(shape.onset <= 0.0 for shape in table[law])
        late = len(table[law]) - early
        weights += [(0.5 / early if s.onset <= 0.0 else 0.5 / late) if late else 1.0 / early for s in table[law]]
    every = tuple(shape._replace(rise=rise) for rise in RISES for shape in flat)
    return every, np.tile(weights, len(RISES)) / len(LAWS) / len(RISES)


def basis(every: tuple[Shape, ...], u: Floats) -> Floats:
    """The shapes at times u, shape (m,): a matrix (m, k); steep ones stop at a million."""
    return np.column_stack([_column(shape, u) for shape in every])


def _column(shape: Shape, u: Floats) -> Floats:
    since = np.maximum(u - shape.onset, 0.0) / (1.0 - shape.onset)
    if shape.law == "none":
        return np.zeros_like(u)
    if shape.law == "exponential":
        top = np.log(LARGEST) + shape.bend
        grown = np.expm1(np.minimum(shape.bend * since, top)) / np.expm1(shape.bend)
    elif shape.law == "runaway":
        left = np.maximum(shape.bend - since, 1e-9)
        grown = (1.0 / left - 1.0 / shape.bend) / (1.0 / (shape.bend - 1.0) - 1.0 / shape.bend)
    else:
        grown = since ** shape.bend
    return np.asarray(np.minimum(grown, LARGEST))
