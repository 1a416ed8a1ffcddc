"""The units of a campaign: a healthy plant with scatter, faults of known size, and measured with the bench's noise."""
from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.sources import import_function
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.model import find_effect
from plant.parameters import load_nominal_values
from plant.solve import NOISES
from rig.campaign.matrix import OWN_SIMULATOR, Case
from rig.sequences import load_sequence
from rig.sequences.timing import PERIOD

Array = NDArray[np.float64]

FLOORS = {"xj": 2e-6, "p12": 2e4, "xs": 1e-6}
"""RMS noise of the sensors: m, Pa, m."""
SCATTERED_PARAMETERS = (
    "torque_motor.gain", "flapper.inertia", "flapper.damping", "flapper.stiffness", "feedback_spring.stiffness",
    "pilot.flow_gain", "pilot.pressure_gain", "valve.flow_gain", "valve.pressure_gain", "supply.pressure", "jack.area",
    "jack.mass", "jack.damping", "jack.static_friction", "jack.dynamic_friction", "jack.leakage")
"""The parameters with a tolerance, in the order in which they are drawn."""


class Unit(NamedTuple):
    """A unit to simulate, for `plant.simulate` or another simulator."""

    model: Model  # healthy, without scatter
    scatter: Mapping[str, float]  # parameter "group.field" to the factor on its value
    sizes: Mapping[str, float]  # effect to the value of its first parameter, SI
    command: Array  # (n,) m
    noise: Array  # (n, NOISES), in units of the sensors' noise


Simulator = Callable[[Unit], Mapping[str, Array]]
"""From a unit to its columns com, cor, load, xj, p12, xs, (n,) each, SI."""


def simulate_case(case: Case, spec: Mapping[str, Any], model: Model) -> Trace:
    """The preflight check of a plant with the faults, scatter and noise of a case.

    Raises:
        InputError: values that contradict each other, or a fault or change that the chosen simulator does not have.
    """
    command = np.round(load_sequence("preflight").main_profile().command, 12)
    scatter, noise = sample_random_parts(case, len(command), spec["colour"], spec["hum"])
    columns = load_simulator(spec["simulator"])(Unit(model, scatter, case.sizes, command, noise))
    measured = {"com", "cor", "load", *spec["signals"].split(",")}
    return Trace.from_columns({name: columns[name] for name in columns if name in measured}, model["controller.period"],
                              {"source": case.label, "seed": str(case.seed)})


def load_simulator(name: str) -> Simulator:
    """`simulate_unit`, or the function "module:function".

    Raises:
        InputError: there is no such function.
    """
    return simulate_unit if name == OWN_SIMULATOR else import_function(name, "--simulator", "a simulator of units")


def simulate_unit(unit: Unit) -> dict[str, Array]:
    """The columns of a unit by `plant.simulate`."""
    model = unit.model.replace({name: factor * unit.model[name] for name, factor in unit.scatter.items()})
    return simulate(add_faults(model, unit.sizes), unit.command, drawn=unit.noise)._asdict()


def sample_random_parts(case: Case, cycles: int, colour: float, hum: float) -> tuple[dict[str, float], Array]:
    """Scatter and noise of a case, as `Unit` holds them.

    Another label gives other random numbers. Another tolerance gives the same, so that a unit is comparable with
    itself at another tolerance.
    """
    rng = np.random.default_rng([case.seed, 11, zlib.crc32(case.label.encode())])
    nominal = load_nominal_values()
    scatter = {name: value / nominal[name] for name, value in sample_healthy_plant(case.tolerance, rng).items()}
    position = sample_position_noise(cycles, colour, hum, rng)
    return scatter, np.column_stack([position / FLOORS["xj"], rng.standard_normal((cycles, NOISES - 1))])


def sample_healthy_plant(spread: float, rng: np.random.Generator) -> dict[str, float]:
    """The parameters of a healthy plant; `spread` is their relative standard deviation about nominal."""
    nominal = load_nominal_values()
    return {name: nominal[name] * (1 + spread * rng.standard_normal()) for name in SCATTERED_PARAMETERS}


def sample_position_noise(n: int, colour: float, hum: float, rng: np.random.Generator) -> Array:
    """Noise of the position sensor, (n,) m: first-order noise with the RMS of the noise floor, and hum of 50 Hz.

    Args:
        n: number of cycles.
        colour: correlation from one cycle to the next.
        hum: amplitude of the mains hum, m.
        rng: source of the random numbers.
    """
    white = FLOORS["xj"] * rng.standard_normal(n)
    noise, last = np.empty(n), float(white[0])
    noise[0] = last
    for k, innovation in enumerate((np.sqrt(1 - colour**2) * white).tolist()[1:], start=1):
        noise[k] = last = colour * last + innovation
    noise += hum * np.sin(2 * np.pi * 50.0 * PERIOD * np.arange(n) + 1.0)
    return noise


def add_faults(model: Model, sizes: Mapping[str, float]) -> Model:
    """The model with effects of these sizes: values of each effect's first parameter.

    The effect's further parameters follow: of a parameter of the base model in proportion to the first one (dynamic
    friction to static friction), of an added effect as in the start whose first parameter is nearest to the size.
    """
    for name, size in sizes.items():
        effect = find_effect(name, model.plant)
        first, *others = effect.fitted
        if effect.base:
            changes = {other: model[other] * size / model[first] for other in others}
        else:
            starts = sorted(effect.starts, key=lambda start: abs(start[first] - size))
            changes = {other: starts[0][other] for other in others if starts}
        model = model.replace(changes | {first: size}, name)
    return model
