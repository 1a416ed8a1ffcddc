"""The effects that the trial hides: those of the catalogue as docs/physics.md lists them, and some outside it.

They are written from that table alone, in the symbols of truth.c. Sizes are drawn log-uniformly, from about the noise
floor of the sensors to the large end of the typical range.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

Symbols = Mapping[str, float]
CHAMBERS = 1.5e-4  # m3, volume V of compressibility
KNOWN_LOAD = 6000.0  # N; without a load, leakage across the piston is not detectable


class HiddenLaw(NamedTuple):
    """An effect to hide: its sizes from `low` to `high`, and how a size changes the plant's symbols.

    `shown` is the changed symbol that means the same as the effect's first fitted parameter.
    """

    low: float
    high: float
    apply: Callable[[float, Symbols], dict[str, float]]
    shown: str = ""
    signed: bool = False
    extra: Mapping[str, tuple[float, float]] = {}  # further symbols, log-uniform from low to high
    choices: Mapping[str, tuple[float, ...]] = {}  # further symbols, one of the values (open in the table)
    known_load: float = 0.0  # N, needed to detect the effect


class Hidden(NamedTuple):
    """An effect with a size."""

    name: str
    size: float
    changes: dict[str, float]  # symbols of truth.c
    value: float  # in the unit of the effect's first parameter; NaN if there is none
    known_load: float


def sample_hidden_effect(name: str, plant: Symbols, rng: np.random.Generator, low: float = 0.0, high: float = 1.0
                         ) -> Hidden:
    """Effect `name` on the plant; its random size is between the fractions `low` and `high` of a logarithmic range."""
    law = (CATALOGUE | OUTSIDE)[name]
    size = law.low * (law.high / law.low) ** float(rng.uniform(low, high))
    if law.signed and rng.random() < 0.5:
        size = -size
    changes = law.apply(size, plant)
    for symbol, (first, last) in law.extra.items():
        changes[symbol] = first * (last / first) ** float(rng.random())
    for symbol, values in law.choices.items():
        changes[symbol] = float(rng.choice(values))
    value = changes[law.shown] if law.shown else float("nan")
    return Hidden(name, size, changes, value, law.known_load)


def _set_symbol(symbol: str) -> Callable[[float, Symbols], dict[str, float]]:
    """The symbol set to x."""
    return lambda x, p: {symbol: x}


def _grow_symbols(*symbols: str) -> Callable[[float, Symbols], dict[str, float]]:
    """Each symbol times 1 + x."""
    return lambda x, p: {symbol: p[symbol] * (1.0 + x) for symbol in symbols}


def _scale_symbols(*symbols: str) -> Callable[[float, Symbols], dict[str, float]]:
    """Each symbol times exp(x), which is symmetric in the sign of x."""
    return lambda x, p: {symbol: p[symbol] * float(np.exp(x)) for symbol in symbols}


IMAX = 8e-3  # A

CATALOGUE: dict[str, HiddenLaw] = {
    "filter_clogging": HiddenLaw(0.02, 0.5, _set_symbol("Kintas"), "Kintas"),
    "spool_friction": HiddenLaw(5.2, 100, lambda x, p: {"FSS": x, "FDS": x / 1.5}, "FSS"),
    "jack_friction": HiddenLaw(0.08, 2, _grow_symbols("FSJ", "FDJ"), "FSJ"),
    "viscous_drag": HiddenLaw(0.2, 9, _grow_symbols("CJ"), "CJ"),
    "moving_mass": HiddenLaw(0.05, 0.7, _scale_symbols("MJ"), "MJ", signed=True),
    "internal_leakage": HiddenLaw(1.3e-12, 5e-11, _set_symbol("CLK"), "CLK", known_load=KNOWN_LOAD),
    "null_bias": HiddenLaw(0.0001 * IMAX, 0.04 * IMAX, _set_symbol("bias"), "bias", signed=True),
    "torque_motor_hysteresis": HiddenLaw(0.001 * IMAX, 0.05 * IMAX, _set_symbol("motor_play"), "motor_play"),
    "coil_lag": HiddenLaw(0.07e-3, 3e-3, _set_symbol("coil_tau"), "coil_tau"),
    "current_limit": HiddenLaw(0.02, 0.4, _set_symbol("driver_cut"), "driver_cut"),
    "nozzle_asymmetry": HiddenLaw(0.01, 0.3, _set_symbol("nozzle"), "nozzle", signed=True),
    "feedback_gap": HiddenLaw(0.5e-6, 50e-6, _set_symbol("gap"), "gap"),
    "spool_overlap": HiddenLaw(0.4e-6, 60e-6, _set_symbol("overlap"), "overlap"),
    "spool_underlap": HiddenLaw(0.3e-6, 30e-6, _set_symbol("underlap"), "underlap"),
    "orifice_root": HiddenLaw(1, 1, _set_symbol("orifice"), "orifice"),
    "flow_force": HiddenLaw(1e-4, 5e-3, _set_symbol("flow_force"), "flow_force"),
    "supply_droop": HiddenLaw(2e9, 2.5e10, _set_symbol("droop"), "droop"),
    "supply_ripple": HiddenLaw(0.01, 0.15, _set_symbol("ripple"), "ripple", extra={"ripple_hz": (10, 150)}),
    "compressibility": HiddenLaw(0.5e9, 1.5e9, lambda x, p: {"volume": CHAMBERS / (4 * x), "soft": 1 / x}, "soft"),
    "viscosity_drift": HiddenLaw(
        0.15, 1.0, lambda x, p: {"CJ": p["CJ"] * float(np.exp(x)), "BF": p["BF"] * float(np.exp(x)),
                                 "CLK": p["CLK"] * float(np.exp(-x)), "mu": float(np.exp(x))}, "mu", signed=True),
    "stribeck": HiddenLaw(0.08, 1, _set_symbol("stribeck"), "stribeck", extra={"stribeck_v": (1e-3, 50e-3)}),
    "presliding": HiddenLaw(5e-6, 100e-6, lambda x, p: {"bristle": p["FSJ"] / x, "deflection": x}, "deflection",
                            choices={"bristle_v": (0.0, 1e-3)}),
    "friction_asymmetry": HiddenLaw(0.03, 0.5, _set_symbol("asymmetry"), "asymmetry", signed=True),
    "mount_compliance": HiddenLaw(1e7, 3e8, lambda x, p: {"recoil": 1 / x}, "recoil"),
    "rod_backlash": HiddenLaw(4e-6, 200e-6, _set_symbol("backlash"), "backlash"),
    "aero_stiffness": HiddenLaw(1e4, 1e6, _set_symbol("aero"), "aero"),
    "constant_load": HiddenLaw(30, 5000, _set_symbol("force"), "force", signed=True),
    "sensor_lag": HiddenLaw(0.07e-3, 3e-3, _set_symbol("sensor_tau"), "sensor_tau"),
    "sensor_gain": HiddenLaw(0.0005, 0.02, _set_symbol("sensor_gain"), "sensor_gain", signed=True),
    "sensor_offset": HiddenLaw(2e-6, 200e-6, _set_symbol("sensor_offset"), "sensor_offset", signed=True),
    "quantisation": HiddenLaw(1e-6, 20e-6, _set_symbol("lsb"), "lsb"),
    "transport_delay": HiddenLaw(0.07, 3, _set_symbol("delay"), "delay"),
    "command_rate_limit": HiddenLaw(0.05, 0.3, _set_symbol("rate"), "rate"),
    "structural_resonance": HiddenLaw(  # of 35 Hz, damping ratio 0.02
        15, 60, lambda x, p: {"mass2": x, "spring2": x * (2 * np.pi * 35) ** 2, "damp2": 0.04 * x * 2 * np.pi * 35},
        "mass2"),
}
"""The effects of the catalogue (docs/physics.md)."""

OUTSIDE: dict[str, HiddenLaw] = {
    "force periodic in position": HiddenLaw(300, 3000, _set_symbol("cog"), extra={"cog_l": (0.8e-3, 4e-3)}),
    "Coulomb friction that depends on position": HiddenLaw(0.3, 0.9, _set_symbol("rough"),
                                                           extra={"rough_l": (1e-3, 6e-3)}),
    "pilot pressure lag": HiddenLaw(0.3e-3, 3e-3, _set_symbol("pilot_tau")),
    "square-law leakage": HiddenLaw(2e-9, 5e-8, _set_symbol("leak_root"), known_load=KNOWN_LOAD),
    "torque-motor gain that drifts": HiddenLaw(0.002, 0.02, _set_symbol("motor_drift"), signed=True),
    "cubic feedback spring": HiddenLaw(2e4, 1e6, _set_symbol("spring_cubic")),
    "jack area that depends on position": HiddenLaw(5, 30, _set_symbol("area_slope"), signed=True),
    "dead time that depends on the answer": HiddenLaw(0.5, 4, _set_symbol("jitter")),
    "periodic torque": HiddenLaw(4e-5, 1e-3, _set_symbol("torque"), extra={"torque_hz": (5, 90)}),
    "leakage one way": HiddenLaw(3e-12, 5e-11, _set_symbol("leak_sign"), known_load=KNOWN_LOAD),
    "drag quadratic in speed": HiddenLaw(1e5, 2e6, _set_symbol("drag2")),
    "transducer quadratic in position": HiddenLaw(3, 20, _set_symbol("sensor_square"), signed=True),
}
"""Effects outside the catalogue, of sizes at which no effect of the catalogue can replace them."""
NOT_SIMULATED = ("soft", "mu", "deflection")
"""Entries of `changes` that the simulator does not have: they give the size in the unit of the fit."""
EXCLUDES = (
    {"stribeck", "presliding"}, {"jack_friction", "presliding"}, {"compressibility", "orifice_root"},
    {"spool_overlap", "spool_underlap"}, {"viscous_drag", "viscosity_drift"}, {"friction_asymmetry", "presliding"},
    {"internal_leakage", "viscosity_drift"},
)
"""Pairs that cannot be hidden together, because they change the same quantity."""
