"""Steady lines of the mains, which are taken out of residuals: a hum that starts with the test has the same phase in
every run, so no repeat tells it from physics.

All residuals of a fit pass this. What is done once a value is compiled: it takes an eighth of the time of array
expressions, and holds no other thread.
"""

import math
from functools import cache

import numpy as np

from fdi.trace import Floats
from plant import Function, compile_function

HUM = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0, 400.0)  # Hz


def remove_mains(residuals: Floats, first: int, stop: int, period: float, most: Floats) -> None:
    """Take the lines out of the columns first .. stop - 1 of residuals (m, s, n), contiguous and changed in place.

    What is larger than `most`, (s,), of a signal counts as that: a piece with large residuals would put lines into
    all others. What is missing counts as 0.
    """
    waves = find_mains_waves(stop - first, period)
    add_turns, subtract_turns = _compile_turns()
    sums = np.zeros((*residuals.shape[:2], len(waves)))
    add_turns(residuals, first, stop, most, sums)
    steady = ((sums.reshape(-1, len(waves)) @ waves) @ waves.T).reshape(sums.shape)
    subtract_turns(residuals, first, stop, steady)


@cache
def find_mains_waves(n: int, period: float) -> Floats:
    """Sines and cosines of the mains' lines that are orthonormal over n samples: what a steady hum looks like.

    Only one turn of them, (turn, k), after which they all repeat, or all n samples where no such turn is whole.
    """
    t = 2.0 * np.pi * period * np.arange(n)
    raw = np.array([w(f * t) for f in HUM if f < 0.45 / period for w in (np.sin, np.cos)]).reshape(-1, n).T
    turn = 1.0 / (math.gcd(*map(int, HUM)) * period)
    waves, triangle = np.linalg.qr(raw)
    if turn < n and math.isclose(turn, round(turn), rel_tol=1e-9):
        waves = np.linalg.solve(triangle.T, raw[:round(turn)].T).T
    return np.asarray(waves, np.float64)


@cache
def _compile_turns() -> tuple[Function, Function]:
    return compile_function(add_turns), compile_function(subtract_turns)


def add_turns(x: Floats, first: int, stop: int, most: Floats, sums: Floats) -> None:
    """Add all turns of x (m, s, n) to the sums (m, s, turn), in the columns first .. stop - 1, within +-`most` (s,)."""
    turn = sums.shape[2]
    for run in range(x.shape[0]):
        for signal in range(x.shape[1]):
            limit, total = most[signal], sums[run, signal]
            for begin in range(first, stop, turn):
                row = x[run, signal, begin:min(begin + turn, stop)]
                for t in range(len(row)):
                    value = min(max(row[t], -limit), limit)
                    total[t] += value if row[t] == row[t] else 0.0


def subtract_turns(x: Floats, first: int, stop: int, steady: Floats) -> None:
    """Subtract what is `steady` (m, s, turn) from every turn of x (m, s, n), in the columns first .. stop - 1."""
    turn = steady.shape[2]
    for run in range(x.shape[0]):
        for signal in range(x.shape[1]):
            line = steady[run, signal]
            for begin in range(first, stop, turn):
                row = x[run, signal, begin:min(begin + turn, stop)]
                for t in range(len(row)):
                    row[t] -= line[t]
