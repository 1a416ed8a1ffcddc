"""Simulated units of one design under test: tolerances, coloured sensor noise, mains hum, any phase of stick-slip.

Noise enters the loop as on a bench: the controller sees Com - (XJ + noise) and answers as it would to Com - noise
without any. So runs that share their noise share a command, and go through lanes together; their tolerances differ.
"""
from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, DYNAMIC, FRICTION, STATIC_OVER_DYNAMIC
from fdi.estimation.likelihood import limit_dynamic_friction
from fdi.estimation.unknowns import list_tolerance_sizes
from fdi.progress import Progress, ignore_progress
from plant.lanes import NARROW, Lanes
from plant.model import Model
from plant.threads import count_threads

Floats = NDArray[np.float64]



class UnitKind(NamedTuple):
    """Which units to draw; NaN leaves a size as the model has it."""

    name: str
    clogging: float = float("nan")  # Kintas
    friction: float = float("nan")  # FSS, N
    sliding: float = 1 / STATIC_OVER_DYNAMIC  # FDS over FSS


def simulate_units(model: Model, com: Floats, load: Floats, kind: UnitKind, count: int, seed: int, steps: int = 20,
                   progress: Progress = ignore_progress) -> Floats:
    """Sensed position, (count, n) m, of units over a command (n,) m with a known load (n,) N.

    The same seed gives the same units, whatever their faults. The solver takes `steps` a cycle; docs/statistics.md says
    what that leaves out. Every other block of units moved before its test and came to rest wherever friction left it;
    the others start at rest at null, as a model does.
    """
    tolerance = list_tolerance_sizes(model)
    names = list(dict.fromkeys([*tolerance, CLOGGING.parameter, FRICTION.parameter, DYNAMIC]))
    lanes = Lanes(model, names, steps, workers=1)
    out = np.empty((count, len(com)))

    def simulate_block(first: int) -> None:
        members = slice(first, min(first + NARROW, count))
        rng = np.random.default_rng([seed, first])
        before = make_lead_in(com, model["controller.period"]) if com[0] != 0.0 or first // NARROW % 2 else com[:0]
        noise = sample_sensor_noise(rng, model, len(before) + len(com))
        units = _sample_parameters(rng, model, tolerance, names, kind)[:members.stop - first]
        asked, force = np.r_[before, com] - noise, np.r_[np.full(len(before), load[0]), load]
        out[members] = (lanes.closed_loop(units, asked, force)[..., 0] + noise)[:, len(before):]

    starts = range(0, count, NARROW)
    with ThreadPoolExecutor(count_threads()) as pool:
        for done, _ in enumerate(pool.map(simulate_block, starts)):
            progress(f"simulating units, {kind.name}", (done + 1) / len(starts))
    return out


def make_lead_in(com: Floats, period: float, moving: float = 0.5, resting: float = 0.3, stroke: float = 1e-3) -> Floats:
    """Command, m, of what a unit did before its test: a growing sine of `stroke` m for `moving` s, then rest.

    It rests for `resting` s at the first demand of the test's command `com` (n,) m.
    """
    rows = round(moving / period)
    t = np.arange(rows) / rows
    asked: Floats = np.r_[com[0] + stroke * np.sin(2 * np.pi * t) * t, np.full(round(resting / period), com[0])]
    return asked


def sample_sensor_noise(rng: np.random.Generator, model: Model, cycles: int, most_colour: float = 0.85,
                        most_hum: float = 0.55, hum_frequency: float = 50.0) -> Floats:
    """Noise of the position sensor, (cycles,) m: first order of a random colour, and mains hum of a random size.

    Args:
        rng: random numbers.
        model: its sensors.position_noise is the standard deviation without hum.
        cycles: of the controller.
        most_colour: largest correlation of the noise from one cycle to the next.
        most_hum: largest amplitude of the hum, in standard deviations of the noise.
        hum_frequency: Hz.
    """
    from scipy.signal import lfilter

    level, colour = model["sensors.position_noise"], rng.uniform(0.0, most_colour)
    white = rng.standard_normal(cycles)
    white[1:] *= np.sqrt(1.0 - colour**2)
    hum = rng.uniform(0.0, most_hum) * np.sin(2 * np.pi * (hum_frequency * model["controller.period"] *
                                                           np.arange(cycles) + rng.uniform()))
    coloured: Floats = level * (lfilter([1.0], [1.0, -colour], white) + hum)
    return coloured


def _sample_parameters(rng: np.random.Generator, model: Model, tolerance: Mapping[str, float], names: list[str],
                       kind: UnitKind) -> Floats:
    """Parameters of a block of units, (NARROW, len(names))."""
    table = np.tile([model[name] for name in names], (NARROW, 1))
    for name, size in tolerance.items():
        table[:, names.index(name)] += size * rng.standard_normal(NARROW)
    if np.isfinite(kind.clogging):
        table[:, names.index(CLOGGING.parameter)] = kind.clogging
    if np.isfinite(kind.friction):
        table[:, names.index(FRICTION.parameter)] = kind.friction
        table[:, names.index(DYNAMIC)] = kind.friction * kind.sliding
    return limit_dynamic_friction(names, table)
