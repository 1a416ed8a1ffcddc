"""The simulator behind the trial's cases: truth.c, built with gcc, on numpy columns.

It shares no physics with `plant`: only the nominal numbers. Symbols are those of the paper, given as keyword changes.
"""
from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError
from plant.parameters import nominal

Array = NDArray[np.float64]

PERIOD = 1e-3  # s, one cycle
STEPS = 1000  # steps a cycle: 1 us
FLAGS = ("-O2", "-shared", "-fPIC")
SYMBOLS = {
    "GAP": "controller.proportional_gain", "Imax": "controller.current_limit", "GM": "torque_motor.gain",
    "JF": "flapper.inertia", "BF": "flapper.damping", "KF": "flapper.stiffness", "XFM": "flapper.travel",
    "KSF": "feedback_spring.stiffness", "Kintas": "filter.clogging", "GQF": "pilot.flow_gain",
    "GPF": "pilot.pressure_gain", "ASV": "spool.end_area", "MS": "spool.mass", "CS": "spool.damping",
    "FSS": "spool.static_friction", "FDS": "spool.dynamic_friction", "XSM": "spool.travel", "GQ": "valve.flow_gain",
    "GP": "valve.pressure_gain", "PSR": "supply.pressure", "AJ": "jack.area", "MJ": "jack.mass", "CJ": "jack.damping",
    "FSJ": "jack.static_friction", "FDJ": "jack.dynamic_friction", "CLK": "jack.leakage", "XJM": "jack.travel",
}
"""Where nominal.toml keeps what the paper calls so."""


class Run(NamedTuple):
    """What a run leaves, one row a cycle: (n,) columns, SI."""

    com: Array
    xj: Array  # as sensed, with the noise that was given
    cor: Array
    p12: Array  # without noise
    xs: Array
    load: Array


def nominal_symbols() -> dict[str, float]:
    """The nominal numbers by symbol, SI."""
    values = nominal()
    return {symbol: values[name] for symbol, name in SYMBOLS.items()}


def has_compiler() -> bool:
    """Whether there is a compiler to build the simulator with."""
    return shutil.which("gcc") is not None


@cache
def _load_library() -> ctypes.CDLL:
    """The compiled simulator, kept under a hash of its source.

    Raises:
        InputError: no gcc.
    """
    gcc = shutil.which("gcc")
    if gcc is None:
        raise InputError("the blind trial", "", "a C compiler (apt-get install gcc)")
    source = (files("rig.studies.trial") / "truth.c").read_bytes()
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eha-rig"
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"truth-{hashlib.sha256(source + ' '.join(FLAGS).encode()).hexdigest()[:16]}.so"
    if not target.exists():
        part = target.with_suffix(f".{os.getpid()}")  # several processes may build at once: the last rename wins
        subprocess.run([gcc, *FLAGS, "-x", "c", "-", "-o", str(part), "-lm"], input=source, check=True)
        part.replace(target)
    library = ctypes.CDLL(str(target))
    library.trial_fields.restype = ctypes.c_char_p
    return library


@cache
def parameter_names() -> tuple[str, ...]:
    """Names of the simulator's parameters, in its order."""
    return tuple(_load_library().trial_fields().decode().split())


def simulate_truth(com: Array, changes: Mapping[str, float], noise: Array | None = None, load: Array | None = None,
             cor: Array | None = None, steps: int = STEPS) -> Run:
    """The plant over `com` (n,) m, at rest at first.

    `changes` are symbols that differ from nominal; `noise` (n,) m is what the position transducer adds; `load` (n,) N
    is the known force; `cor` (n,) A, if given, drives the plant in place of the controller.

    Raises:
        InputError: a parameter it does not have; no gcc.
        ValueError: columns of different lengths.
    """
    n = len(com)
    values = dict.fromkeys(parameter_names(), 0.0) | nominal_symbols()
    unknown = changes.keys() - values.keys()
    if unknown:
        raise InputError("the trial's simulator", min(unknown), "one of its parameters: " + ", ".join(values))
    columns = [_make_column(column, n) for column in (com, load, noise)]
    record = np.array([(values | dict(changes))[name] for name in parameter_names()])
    answer = np.zeros(n) if cor is None else _make_column(cor, n).copy()
    out = np.empty((n, 3))
    _load_library().trial_run(
        _point_to(record), ctypes.c_long(n), ctypes.c_long(steps), ctypes.c_int(cor is not None),
        *map(_point_to, columns), ctypes.c_double(PERIOD), _point_to(answer), _point_to(out))
    xj, p12, xs = np.ascontiguousarray(out.T)
    return Run(columns[0], xj, answer, p12, xs, columns[1])


def _make_column(column: Array | None, n: int) -> Array:
    wide = np.zeros(n) if column is None else np.ascontiguousarray(column, dtype=float)
    if wide.shape != (n,):
        raise ValueError(f"a column of {wide.shape} beside {n} cycles")
    return wide


def _point_to(array: Array) -> ctypes._Pointer[ctypes.c_double]:
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
