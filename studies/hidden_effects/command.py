"""Commands and known loads of the trial's traces: the preflight of docs/physics.md, and random held-out commands."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MM = 1e-3
CYCLES_PER_SECOND = 1000


def _hold(level: float, seconds: float) -> Array:
    return np.full(round(seconds * CYCLES_PER_SECOND), level)


def _ramp(start: float, end: float, seconds: float) -> Array:
    n = round(seconds * CYCLES_PER_SECOND)
    return start + (end - start) * np.arange(n) / n


def preflight_command() -> Array:
    """The command of the preflight check, (13500,) m, one value per cycle."""
    t = np.arange(2 * CYCLES_PER_SECOND) / CYCLES_PER_SECOND
    chirp = MM * np.sin(2 * np.pi * (t + 4.75 * t**2)) * (1 - np.exp(-20 * t))
    return np.concatenate([
        _hold(0, 0.5), _hold(5 * MM, 1), _hold(0, 1), _hold(MM, 0.75), _hold(0, 0.75), _ramp(0, MM, 2), _hold(MM, 0.5),
        _ramp(MM, 0, 2), _hold(0, 0.5), 3 * MM * np.sin(2 * np.pi * t), chirp, _hold(0, 0.5)])


def sample_holdout_command(rng: np.random.Generator) -> Array:
    """A random command of six steps, ramps and sines, (n,) m, 7 to 14 s."""
    level, parts = 0.0, [_hold(0, 0.4)]
    for _ in range(6):
        kind = rng.integers(3)
        if kind == 0:
            level = float(rng.uniform(-6 * MM, 6 * MM))
            parts.append(_hold(level, rng.uniform(0.4, 0.9)))
        elif kind == 1:
            target = float(rng.uniform(-4 * MM, 4 * MM))
            seconds = max(abs(target - level) / rng.uniform(0.5 * MM, 5 * MM), 0.3)
            parts += [_ramp(level, target, seconds), _hold(target, 0.2)]
            level = target
        else:
            t = np.arange(round(1.5 * CYCLES_PER_SECOND)) / CYCLES_PER_SECOND
            amplitude, frequency = rng.uniform(0.5 * MM, 3 * MM), 0.5 * 12 ** rng.random()
            parts += [level + amplitude * np.sin(2 * np.pi * frequency * t), _hold(level, 0.2)]
    return np.concatenate([*parts, _ramp(level, 0, 1), _hold(0, 0.4)])


def known_load_profile(n: int, force: float) -> Array:
    """The force of a loaded trace, (n,) N: on at 30 % of the time, reversed at 50 %, off at 70 %."""
    part = np.arange(n) / n
    return force * (((part > 0.3) & (part < 0.5)).astype(float) - ((part >= 0.5) & (part < 0.7)))
