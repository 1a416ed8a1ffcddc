"""The laws a fault may grow by as columns of a regression: linear, exponential, power, each from an onset on.

Time u runs from 0 at the first trace to 1 at the last. A shape is 0 up to its onset and 1 at u = 1, so that its factor
is the rise seen so far, whatever the unit of time. A fourth law, the runaway, ends at a time of its own: growth in
proportion to the square of the size. It covers faults that end sooner than an exponential would.
"""
from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LAWS = ("none", "linear", "exponential", "power", "runaway")


class Shape(NamedTuple):
    """One law with its onset, its e-foldings, exponent or end, and the prior width of its rise."""

    law: str
    onset: float = 0.0
    bend: float = 1.0
    rise: float = 1.0  # deviation of the half-normal prior, in units of (MaxBand - healthy)


@cache
def list_shapes() -> tuple[tuple[Shape, ...], Floats]:
    """Every shape and its prior, shape (k,): equal for the laws, half of it for growth before the first trace."""
    within = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # onsets since the first trace
    before = (-2.0, -0.5)  # a power law shows how long ago it began; the other two do not
    foldings = (0.5, 1.0, 2.0, 3.5, 5.5)  # e-foldings from the first trace to the last
    exponents = (0.5, 0.7, 1.5, 2.0, 3.0)
    ends = (1.1, 1.25, 1.5, 2.0, 3.0)  # when a runaway becomes infinite; 1 is the last trace
    rises = (0.15, 1.0)  # the smaller one is for growth that has only begun
    table = {"none": [Shape("none")], "linear": [Shape("linear", onset) for onset in within],
             "exponential": [Shape("exponential", onset, fold) for onset in within for fold in foldings],
             "power": [Shape("power", onset, p) for onset in (*before, *within) for p in exponents],
             "runaway": [Shape("runaway", onset, end) for onset in within for end in ends]}
    flat = tuple(shape for law in LAWS for shape in table[law])
    weights = []
    for law in LAWS:
        early = sum(shape.onset <= 0.0 for shape in table[law])
        late = len(table[law]) - early
        for shape in table[law]:
            if late == 0:
                weights.append(1.0 / early)
            elif shape.onset <= 0.0:
                weights.append(0.5 / early)
            else:
                weights.append(0.5 / late)
    every = tuple(shape._replace(rise=rise) for rise in rises for shape in flat)
    return every, np.tile(weights, len(rises)) / len(LAWS) / len(rises)


def evaluate_shapes(every: tuple[Shape, ...], u: Floats, largest: float = 1e6) -> Floats:
    """The shapes at times u, shape (m,): a matrix (m, k); steep ones stop at `largest`."""
    return np.column_stack([_evaluate_shape(shape, u, largest) for shape in every])


def _evaluate_shape(shape: Shape, u: Floats, largest: float) -> Floats:
    since = np.maximum(u - shape.onset, 0.0) / (1.0 - shape.onset)
    if shape.law == "none":
        return np.zeros_like(u)
    if shape.law == "exponential":
        top = np.log(largest) + shape.bend
        grown = np.expm1(np.minimum(shape.bend * since, top)) / np.expm1(shape.bend)
    elif shape.law == "runaway":
        left = np.maximum(shape.bend - since, 1e-9)
        grown = (1.0 / left - 1.0 / shape.bend) / (1.0 / (shape.bend - 1.0) - 1.0 / shape.bend)
    else:
        grown = since ** shape.bend
    return np.asarray(np.minimum(grown, largest))
