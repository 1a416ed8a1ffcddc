"""Units of one design under test, simulated: tolerances, coloured sensor noise, mains hum, any phase of stick-slip.

Noise enters the loop as it does on a bench: the controller sees Com - (XJ + noise), which is what it answers to
Com - noise without any. So runs that share their noise share a command, and go through lanes together; their
tolerances set them apart.
"""
from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FRICTION
from fdi.estimation.tolerances import tolerances
from fdi.progress import Progress, ignore_progress
from plant.block import NARROW
from plant.lanes import Lanes
from plant.model import Model
from plant.threads import threads

Floats = NDArray[np.float64]

DYNAMIC = "spool.dynamic_friction"
SLIDING = 1 / 1.5  # FDS over FSS (nominal.toml)
COLOUR = 0.85  # largest correlation of the position sensor's noise from one cycle to the next
HUM, HUM_HZ = 0.55, 50.0  # largest amplitude of mains hum, in standard deviations of the noise; Hz
MOVED, RESTED, STROKE = 0.5, 0.3, 1e-3  # s, s, m: before a test
STEPS = 20  # a cycle; the docs say what that leaves out


class Kind(NamedTuple):
    """Which units to draw; NaN leaves a size as the model has it."""

    name: str
    clogging: float = float("nan")  # Kintas
    friction: float = float("nan")  # FSS, N
    sliding: float = SLIDING  # FDS over FSS


def runs(model: Model, com: Floats, load: Floats, kind: Kind, count: int, seed: int, steps: int = STEPS,
         progress: Progress = ignore_progress) -> Floats:
    """Sensed position, (count, n) m, of so many units over a command (n,) m with a known load (n,) N.

    The same seed gives the same units, whatever their faults.
    """
    tolerance = tolerances(model)
    names = list(dict.fromkeys([*tolerance, CLOGGING.parameter, FRICTION.parameter, DYNAMIC]))
    lanes = Lanes(model, names, steps, workers=1)
    out = np.empty((count, len(com)))

    def block(first: int) -> None:
        members = slice(first, min(first + NARROW, count))
        rng = np.random.default_rng([seed, first])
        before = lead(com, model["controller.period"]) if com[0] != 0.0 or first // NARROW % 2 else com[:0]
        noise = sensor_noise(rng, model, len(before) + len(com))
        units = _units(rng, model, tolerance, names, kind)[:members.stop - first]
        asked, force = np.r_[before, com] - noise, np.r_[np.full(len(before), load[0]), load]
        out[members] = (lanes.closed_loop(units, asked, force)[..., 0] + noise)[:, len(before):]

    starts = range(0, count, NARROW)
    with ThreadPoolExecutor(threads()) as pool:
        for done, _ in enumerate(pool.map(block, starts)):
            progress(f"simulating units, {kind.name}", (done + 1) / len(starts))
    return out


def lead(com: Floats, period: float) -> Floats:
    """What a unit did before its test: it moved, and came to rest at the test's first demand wherever friction left it.

    Every other block of units has this behind it; the others rest at null, where a model starts.
    """
    moving, resting = round(MOVED / period), round(RESTED / period)
    t = np.arange(moving) / moving
    asked: Floats = np.r_[com[0] + STROKE * np.sin(2 * np.pi * t) * t, np.full(resting, com[0])]
    return asked


def sensor_noise(rng: np.random.Generator, model: Model, cycles: int) -> Floats:
    """Noise of the position sensor, (cycles,) m: first order of any colour up to COLOUR, and hum."""
    from scipy.signal import lfilter

    level, colour = model["sensors.position_noise"], rng.uniform(0.0, COLOUR)
    white = rng.standard_normal(cycles)
    white[1:] *= np.sqrt(1.0 - colour**2)
    hum = rng.uniform(0.0, HUM) * np.sin(2 * np.pi * (HUM_HZ * model["controller.period"] * np.arange(cycles) +
                                                       rng.uniform()))
    coloured: Floats = level * (lfilter([1.0], [1.0, -colour], white) + hum)
    return coloured


def _units(rng: np.random.Generator, model: Model, tolerance: Mapping[str, float], names: list[str], kind: Kind
           ) -> Floats:
    """Parameters of a block of units, (NARROW, len(names))."""
    table = np.tile([model[name] for name in names], (NARROW, 1))
    for name, size in tolerance.items():
        table[:, names.index(name)] += size * rng.standard_normal(NARROW)
    if np.isfinite(kind.clogging):
        table[:, names.index(CLOGGING.parameter)] = kind.clogging
    if np.isfinite(kind.friction):
        table[:, names.index(FRICTION.parameter)] = kind.friction
        table[:, names.index(DYNAMIC)] = kind.friction * kind.sliding
    for body in ("jack", "spool"):
        slides, sticks = (f"{body}.{word}_friction" for word in ("dynamic", "static"))
        if slides in names and sticks in names:  # dynamic friction stays below static friction
            table[:, names.index(slides)] = np.minimum(table[:, names.index(slides)], table[:, names.index(sticks)])
    return table
