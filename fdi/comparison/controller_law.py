"""The law of a position controller, identified from its recorded demand, position and answer."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class DirectionalGains(NamedTuple):
    """A proportional law, answer = gain * error, with a gain for each direction of the actuator."""

    out: float  # answer over error
    back: float
    delay: int  # rows from the error to its answer
    residual: float  # RMS of what the law leaves of the answer
    answer: float  # RMS of the answer
    exact: float  # share of the rows whose answer is the rounded gain times the error, to half a unit
    limit: float  # largest answer that was recorded; the law's limit is there or above

    @property
    def asymmetry(self) -> float:
        """By what fraction the gain back is higher than the gain out: `asymmetric_gain.retraction`."""
        return self.back / self.out - 1.0


def fit_directional_gains(error: Floats, answer: Floats, side: Floats, longest_delay: int = 10) -> DirectionalGains:
    """Fit a proportional gain for each side by least squares; the delay with the smallest residual is taken.

    Args:
        error: (n,) demand less position.
        answer: (n,) what the controller asks for, in its own unit.
        side: (n,) positive where the actuator is driven out, negative where it is driven back; others are left out.
        longest_delay: rows that are tried.

    Raises:
        ValueError: columns of different lengths, or a side without rows.
    """
    if not error.shape == answer.shape == side.shape:
        raise ValueError(f"columns of one length, not {error.shape}, {answer.shape} and {side.shape}")
    return min((_fit_at_delay(error, answer, side, delay) for delay in range(longest_delay + 1)),
               key=lambda found: found.residual)


def _fit_at_delay(error: Floats, answer: Floats, side: Floats, delay: int) -> DirectionalGains:
    e, y, s = error[:len(error) - delay], answer[delay:], side[delay:]
    ways = {"out": s > 0.0, "back": s < 0.0}
    for name, rows in ways.items():
        if not np.any(e[rows]):
            raise ValueError(f"rows with an error while the actuator is driven {name}")
    gain = {name: float(e[rows] @ y[rows] / (e[rows] @ e[rows])) for name, rows in ways.items()}
    left = np.concatenate([y[rows] - gain[name] * e[rows] for name, rows in ways.items()])
    whole = np.concatenate([y[rows] - round(gain[name]) * e[rows] for name, rows in ways.items()])
    driven = y[ways["out"] | ways["back"]]
    return DirectionalGains(gain["out"], gain["back"], delay, _rms(left), _rms(driven),
                            float(np.mean(np.abs(whole) <= 0.5)), float(np.abs(driven).max()))


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))
