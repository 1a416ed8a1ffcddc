"""What the trial hides: the catalogue's effects as docs/physics.md lists them, and some that no catalogue has.

Written from the table alone, in the symbols of truth.c. A size is drawn log-uniformly from about the sensors' floor to
the large end of what is typical.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

Symbols = Mapping[str, float]
CHAMBERS = 1.5e-4  # m3, V of compressibility
KNOWN_LOAD = 6000.0  # N, without which a leak across the piston cannot be seen


class Law(NamedTuple):
    """An effect to hide: sizes from `low` to `high`, and what a size does to the plant's symbols.

    `shown` is the symbol, among what `apply` gives, that has the meaning of the first parameter that a fit frees.
    """

    low: float
    high: float
    apply: Callable[[float, Symbols], dict[str, float]]
    shown: str = ""
    signed: bool = False
    extra: Mapping[str, tuple[float, float]] = {}  # further symbols, drawn log-uniformly from low to high
    choices: Mapping[str, tuple[float, ...]] = {}  # further symbols, one of the values: what the table leaves open
    known_load: float = 0.0  # N, what such a case needs to show


class Hidden(NamedTuple):
    """One effect of one size."""

    name: str
    size: float
    changes: dict[str, float]  # symbols of truth.c
    value: float  # in the unit of the effect's first parameter; NaN if there is none
    known_load: float


def draw(name: str, plant: Symbols, rng: np.random.Generator, low: float = 0.0, high: float = 1.0) -> Hidden:
    """Effect `name` on the plant, its size between the fractions `low` and `high` of the (logarithmic) range."""
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


def _set(symbol: str, factor: float = 1.0) -> Callable[[float, Symbols], dict[str, float]]:
    return lambda x, p: {symbol: factor * x}


def _more(*symbols: str) -> Callable[[float, Symbols], dict[str, float]]:
    """The symbols grown by the fraction x."""
    return lambda x, p: {symbol: p[symbol] * (1.0 + x) for symbol in symbols}


def _times(*symbols: str) -> Callable[[float, Symbols], dict[str, float]]:
    """The symbols times exp(x): as far down as up."""
    return lambda x, p: {symbol: p[symbol] * float(np.exp(x)) for symbol in symbols}


IMAX = 8e-3  # A

CATALOGUE: dict[str, Law] = {
    "filter_clogging": Law(0.02, 0.5, _set("Kintas"), "Kintas"),
    "spool_friction": Law(5.2, 100, lambda x, p: {"FSS": x, "FDS": x / 1.5}, "FSS"),
    "jack_friction": Law(0.08, 2, _more("FSJ", "FDJ"), "FSJ"),
    "viscous_drag": Law(0.2, 9, _more("CJ"), "CJ"),
    "moving_mass": Law(0.05, 0.7, _times("MJ"), "MJ", signed=True),
    "internal_leakage": Law(1.3e-12, 5e-11, _set("CLK"), "CLK", known_load=KNOWN_LOAD),
    "null_bias": Law(0.0001 * IMAX, 0.04 * IMAX, _set("bias"), "bias", signed=True),
    "torque_motor_hysteresis": Law(0.001 * IMAX, 0.05 * IMAX, _set("motor_play"), "motor_play"),
    "coil_lag": Law(0.07e-3, 3e-3, _set("coil_tau"), "coil_tau"),
    "current_limit": Law(0.02, 0.4, _set("driver_cut"), "driver_cut"),
    "nozzle_asymmetry": Law(0.01, 0.3, _set("nozzle"), "nozzle", signed=True),
    "feedback_gap": Law(0.5e-6, 50e-6, _set("gap"), "gap"),
    "spool_overlap": Law(0.4e-6, 60e-6, _set("overlap"), "overlap"),
    "spool_underlap": Law(0.3e-6, 30e-6, _set("underlap"), "underlap"),
    "orifice_root": Law(1, 1, _set("orifice"), "orifice"),
    "flow_force": Law(1e-4, 5e-3, _set("flow_force"), "flow_force"),
    "supply_droop": Law(2e9, 2.5e10, _set("droop"), "droop"),
    "supply_ripple": Law(0.01, 0.15, _set("ripple"), "ripple", extra={"ripple_hz": (10, 150)}),
    "compressibility": Law(0.5e9, 1.5e9, lambda x, p: {"volume": CHAMBERS / (4 * x), "soft": 1 / x}, "soft"),
    "viscosity_drift": Law(0.15, 1.0, lambda x, p: {"CJ": p["CJ"] * float(np.exp(x)), "BF": p["BF"] * float(np.exp(x)),
                                                   "CLK": p["CLK"] * float(np.exp(-x)), "mu": float(np.exp(x))},
                           "mu", signed=True),
    "stribeck": Law(0.08, 1, _set("stribeck"), "stribeck", extra={"stribeck_v": (1e-3, 50e-3)}),
    "presliding": Law(5e-6, 100e-6, lambda x, p: {"bristle": p["FSJ"] / x, "deflection": x}, "deflection",
                      choices={"bristle_v": (0.0, 1e-3)}),
    "friction_asymmetry": Law(0.03, 0.5, _set("asymmetry"), "asymmetry", signed=True),
    "mount_compliance": Law(1e7, 3e8, lambda x, p: {"recoil": 1 / x}, "recoil"),
    "rod_backlash": Law(4e-6, 200e-6, _set("backlash"), "backlash"),
    "aero_stiffness": Law(1e4, 1e6, _set("aero"), "aero"),
    "constant_load": Law(30, 5000, _set("force"), "force", signed=True),
    "sensor_lag": Law(0.07e-3, 3e-3, _set("sensor_tau"), "sensor_tau"),
    "sensor_gain": Law(0.0005, 0.02, _set("sensor_gain"), "sensor_gain", signed=True),
    "sensor_offset": Law(2e-6, 200e-6, _set("sensor_offset"), "sensor_offset", signed=True),
    "quantisation": Law(1e-6, 20e-6, _set("lsb"), "lsb"),
    "transport_delay": Law(0.07, 3, _set("delay"), "delay"),
    "command_rate_limit": Law(0.05, 0.3, _set("rate"), "rate"),
}
"""The 33 effects of the catalogue (docs/physics.md)."""

OUTSIDE: dict[str, Law] = {
    "force periodic in position": Law(300, 3000, _set("cog"), extra={"cog_l": (0.8e-3, 4e-3)}),
    "Coulomb friction that depends on position": Law(0.3, 0.9, _set("rough"), extra={"rough_l": (1e-3, 6e-3)}),
    "pilot pressure lag": Law(0.3e-3, 3e-3, _set("pilot_tau")),
    "second mass on a spring": Law(15, 60, lambda x, p: {"mass2": x, "spring2": x * (2 * np.pi * 35) ** 2,
                                                         "damp2": 0.04 * x * 2 * np.pi * 35}),
    "square-law leakage": Law(2e-9, 5e-8, _set("leak_root"), known_load=KNOWN_LOAD),
    "torque-motor gain that drifts": Law(0.002, 0.02, _set("motor_drift"), signed=True),
    "cubic feedback spring": Law(2e4, 1e6, _set("spring_cubic")),
    "jack area that depends on position": Law(5, 30, _set("area_slope"), signed=True),
    "dead time that depends on the answer": Law(0.5, 4, _set("jitter")),
    "periodic torque": Law(4e-5, 1e-3, _set("torque"), extra={"torque_hz": (5, 90)}),
    "leakage one way": Law(3e-12, 5e-11, _set("leak_sign"), known_load=KNOWN_LOAD),
    "drag quadratic in speed": Law(1e5, 2e6, _set("drag2")),
    "transducer quadratic in position": Law(3, 20, _set("sensor_square"), signed=True),
}
"""Effects that the catalogue does not have. Some need a size at which no catalogue effect can take their place."""
NOT_SIMULATED = ("soft", "mu", "deflection")
"""Entries of `changes` that only say a size in the unit a fit reports."""
EXCLUDES = (
    {"stribeck", "presliding"}, {"jack_friction", "presliding"}, {"compressibility", "orifice_root"},
    {"spool_overlap", "spool_underlap"}, {"viscous_drag", "viscosity_drift"}, {"friction_asymmetry", "presliding"},
    {"internal_leakage", "viscosity_drift"},
)
"""Pairs that cannot be hidden together: they set the same thing."""
