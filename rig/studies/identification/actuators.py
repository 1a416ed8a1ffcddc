"""Actuators of another size, drawn at random, and their runs by the simulator of the blind trial in steps of 1 us."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace.trace import Trace
from rig.sequences.timing import PERIOD
from rig.studies.trial import command
from rig.studies.trial.cases import FLOORS, sample_healthy_plant
from rig.studies.trial.truth import SYMBOLS, nominal_symbols, simulate_truth

Array = NDArray[np.float64]

FACTORS = {"AJ": (1.7, 2.4), "XJM": (0.5, 0.8), "GQ": (1.3, 2.5), "GQF": (0.7, 1.5), "GM": (0.8, 1.3),
           "KSF": (0.8, 1.3), "PSR": (0.8, 1.6), "MJ": (1.0, 3.0), "CJ": (0.7, 2.5), "CLK": (0.7, 3.0),
           "GAP": (0.7, 1.3), "FDJ": (1.0, 2.5), "FDS": (0.7, 2.0)}
"""Ranges from which the factor on a nominal parameter is drawn, its logarithm uniform, by symbol."""
FRICTION_RATIO = {"FSJ": ("FDJ", (1.44, 1.92)), "FSS": ("FDS", (1.25, 1.87))}
"""Static friction: the dynamic one by symbol, and the range of the ratio."""


class Unit(NamedTuple):
    """An actuator and its runs: two to fit, one held out."""

    plant: dict[str, float]  # by symbol
    fitted: tuple[Trace, Trace]
    held_out: Trace

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name, SI."""
        return {SYMBOLS[symbol]: value for symbol, value in self.plant.items()}


def sample_actuator(seed: int, scatter: float = 0.015) -> dict[str, float]:
    """The parameters of an actuator about twice as large as the nominal one, by symbol, with the usual scatter."""
    rng = np.random.default_rng([seed, 11])
    plant = nominal_symbols() | sample_healthy_plant(scatter, rng)
    for symbol, (low, high) in FACTORS.items():
        plant[symbol] *= float(np.exp(rng.uniform(np.log(low), np.log(high))))
    for symbol, (other, (low, high)) in FRICTION_RATIO.items():
        plant[symbol] = plant[other] * float(rng.uniform(low, high))
    return plant


def simulate_unit(seed: int) -> Unit:
    """A random actuator with its runs: the preflight's command; both end stops and a random command with known loads;
    and another random command with known loads, held out.
    """
    plant = sample_actuator(seed)
    rng = np.random.default_rng([seed, 13])
    stop, force = 1.05 * plant["XJM"], 0.25 * plant["AJ"] * plant["PSR"]
    seconds = 1.0 + 2.0 * stop / 0.025
    stops = np.concatenate([np.zeros(500), np.full(round(500 * seconds), stop), np.full(round(1000 * seconds), -stop),
                            np.zeros(1000)])
    commands = [command.preflight_command(), np.concatenate([stops, command.sample_holdout_command(rng)]),
                command.sample_holdout_command(rng)]
    forces = (0.0, force, 0.5 * force)
    first, second, third = (_measure(plant, np.round(com, 12), f, [seed, 17, i])
                            for i, (com, f) in enumerate(zip(commands, forces, strict=True)))
    return Unit(plant, (first, second), third)


def _measure(plant: dict[str, float], com: Array, force: float, seed: list[int]) -> Trace:
    rng, n = np.random.default_rng(seed), len(com)
    noise = {signal: level * rng.standard_normal(n) for signal, level in FLOORS.items()}
    run = simulate_truth(com, plant, noise["xj"], command.known_load_profile(n, force))
    columns = run._asdict() | {"p12": run.p12 + noise["p12"], "xs": run.xs + noise["xs"]}
    return Trace.from_columns(columns, PERIOD, {"source": "-".join(map(str, seed))})
