"""The command profile and the measure of growing_sine.toml."""
from typing import Any

import numpy as np


def grow(t: np.ndarray, start: float, amplitude: float, frequency: float) -> np.ndarray:
    """A sine whose amplitude grows to `amplitude`, m, and which ends where it started."""
    return start + amplitude * (t / t[-1]) * np.sin(2.0 * np.pi * frequency * t)


def measure_rms(window: Any) -> float:
    """RMS of the following error, um."""
    return float(np.sqrt(np.nanmean((1e6 * window.error) ** 2)))
