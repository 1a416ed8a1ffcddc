"""The simulator of the blind trial: truth.c, compiled with gcc, on numpy columns.

It shares the nominal numbers with `plant`, and no physics. Its parameters have the symbols of the paper.
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

from plant import RATE, InputError, load_nominal_values

Array = NDArray[np.float64]

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
"""Symbols of the paper and their names in nominal.toml."""


class Run(NamedTuple):
    """The columns of a run, (n,) each, one row per cycle, SI."""

    com: Array
    xj: Array  # measured, with the given noise
    cor: Array
    p12: Array  # without noise
    xs: Array
    load: Array


def nominal_symbols() -> dict[str, float]:
    """The nominal numbers by symbol, SI."""
    values = load_nominal_values()
    return {symbol: values[name] for symbol, name in SYMBOLS.items()}


def has_compiler() -> bool:
    """Whether the C compiler that builds the simulator is installed."""
    return shutil.which("gcc") is not None


@cache
def _load_library() -> ctypes.CDLL:
    """The compiled simulator, cached under a hash of its source.

    Raises:
        InputError: gcc is not installed.
    """
    gcc = shutil.which("gcc")
    if gcc is None:
        raise InputError("the blind trial", "", "a C compiler (apt-get install gcc)")
    source = (files("studies.hidden_effects") / "truth.c").read_bytes()
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eha-rig"
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"truth-{hashlib.sha256(source + ' '.join(FLAGS).encode()).hexdigest()[:16]}.so"
    if not target.exists():
        part = target.with_suffix(f".{os.getpid()}")  # several processes may build it at once; the last one replaces it
        subprocess.run([gcc, *FLAGS, "-x", "c", "-", "-o", str(part), "-lm"], input=source, check=True)
        part.replace(target)
    library = ctypes.CDLL(str(target))
    library.trial_fields.restype = ctypes.c_char_p
    return library


@cache
def parameter_names() -> tuple[str, ...]:
    """The names of the simulator's parameters, in the order of its C structure."""
    return tuple(_load_library().trial_fields().decode().split())


def simulate_truth(com: Array, changes: Mapping[str, float], noise: Array | None = None, load: Array | None = None,
                   cor: Array | None = None, steps: int = 1000) -> Run:
    """A run of the plant over `com` (n,) m, from rest.

    Args:
        com: command, (n,) m.
        changes: symbols to the values that differ from nominal.
        noise: noise of the position transducer, (n,) m; default: none.
        load: known force, (n,) N; default: none.
        cor: current, (n,) A, that drives the plant in place of the controller; default: the controller's.
        steps: integration steps per cycle; 1000 are steps of 1 us.

    Raises:
        InputError: an unknown parameter, or gcc is not installed.
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
        *map(_point_to, columns), ctypes.c_double(1 / RATE), _point_to(answer), _point_to(out))
    xj, p12, xs = np.ascontiguousarray(out.T)
    return Run(columns[0], xj, answer, p12, xs, columns[1])


def _make_column(column: Array | None, n: int) -> Array:
    """The column as C reads it, zeros if there is none. Raises ValueError for another shape than (n,)."""
    values = np.zeros(n) if column is None else np.ascontiguousarray(column, dtype=float)
    if values.shape != (n,):
        raise ValueError(f"a column of shape {values.shape} for {n} cycles")
    return values


def _point_to(array: Array) -> ctypes._Pointer[ctypes.c_double]:
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
