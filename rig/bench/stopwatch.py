"""Durations in rounds that alternate between rivals, so that a disturbance of the machine hits all of them; C code."""
from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rig.network.clock import WallClock

Array = NDArray[np.float64]
Work = Callable[[], object]

FLAGS = ("-O3", "-march=native")
SAME_ROUNDING = (*FLAGS, "-ffp-contract=off")  # no fused multiply-add: the rounding of Python
GET_GCC = "apt-get install gcc"


def measure_durations(works: Mapping[str, Work], rounds: int) -> dict[str, Array]:
    """Durations of each work, (rounds,) s, after one warm-up; the rounds alternate between them."""
    clock = WallClock()
    taken: dict[str, list[int]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            start = clock.now()
            work()
            if turn > 0:
                taken[name].append(clock.now() - start)
    return {name: np.array(times) * 1e-9 for name, times in taken.items()}


def measure_median_duration(work: Work, rounds: int) -> float:
    """The median duration of one work, s."""
    return float(np.median(measure_durations({"": work}, rounds)[""]))


def find_gcc() -> str:
    """The path of the C compiler; "" without one."""
    return shutil.which("gcc") or ""


def build_library(source: str, flags: tuple[str, ...], target: Path, package: str = "rig.bench") -> ctypes.CDLL:
    """A C file of a package as a library; gcc must be installed."""
    # without -std=c..., which would silently forbid the fused multiply-add
    compiled = target.with_suffix(".o")
    places = [f"-I{files('rig.bench')}", "-c", str(files(package) / source), "-o", str(compiled)]
    subprocess.run([find_gcc(), *flags, "-fPIC", *places], check=True)
    # a library that is linked with -ffast-math switches the small numbers next to zero off for the whole process
    harmless = [flag for flag in flags if flag != "-ffast-math"]
    subprocess.run([find_gcc(), *harmless, "-shared", str(compiled), "-o", str(target), "-lm"], check=True)
    return ctypes.CDLL(str(target))
