"""Programs under the settings of another x86-64 CPU: what NumPy, Numba, OpenBLAS and the C library choose by the CPU.

Each of the four looks at the CPU when it is loaded, so every setting needs a process of its own.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite.binding import get_host_cpu_features
from places import ROOT, SUPPORT

WITHOUT_FMA = "glibc.cpu.hwcaps=" + ",".join(
    f"-{feature}" for feature in ("AVX512F", "AVX2", "AVX2_Usable", "FMA", "FMA_Usable", "FMA4"))
HASWELL = ("sse3", "ssse3", "sse4.1", "sse4.2", "popcnt", "avx", "avx2", "fma", "bmi", "bmi2", "lzcnt", "f16c", "movbe")


def compiles_for(feature: str) -> bool:
    """Whether numba compiles for a CPU with this feature: this one, or the one that NUMBA_CPU_NAME names."""
    return f"+{feature}" in os.environ.get(
        "NUMBA_CPU_FEATURES", "" if "NUMBA_CPU_NAME" in os.environ else get_host_cpu_features().flatten()).split(",")


def list_disabled_features(*instruction_sets: str) -> str:
    """Switches off the vector code of NumPy that this CPU has, but for that of the `instruction_sets`."""
    core = np._core._multiarray_umath  # type: ignore[attr-defined]
    disabled_features = os.environ.get("NPY_DISABLE_CPU_FEATURES", "").split()  # this process may have such a setting
    features = [name for name in core.__cpu_dispatch__ if core.__cpu_features__[name] or name in disabled_features]
    return " ".join(name for name in features if name not in instruction_sets)


THIS, AVX2, OLDEST = "this CPU", "AVX2 and FMA (2013)", "no vector code beyond SSE2, no FMA"


def list_cpu_settings() -> dict[str, Mapping[str, str]]:
    """Name of a CPU and the environment that stands for it; only CPUs whose instructions this one has too."""
    settings: dict[str, Mapping[str, str]] = {THIS: {}}
    if all(get_host_cpu_features().get(feature) for feature in HASWELL):
        settings[AVX2] = {
            "NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ",".join(f"+{feature}" for feature in HASWELL),
            "NPY_DISABLE_CPU_FEATURES": list_disabled_features("AVX", "F16C", "FMA3", "AVX2", "X86_V3")}
    settings[OLDEST] = {"NUMBA_CPU_NAME": "generic", "OPENBLAS_CORETYPE": "Nehalem", "GLIBC_TUNABLES": WITHOUT_FMA,
                        "NPY_DISABLE_CPU_FEATURES": list_disabled_features()}
    return settings


def list_environment() -> dict[str, str]:
    """The environment without settings of another CPU, under which the tests themselves may run."""
    settings = ("NUMBA_CPU", "OPENBLAS", "NPY_DISABLE", "GLIBC_TUNABLES")
    return {key: value for key, value in os.environ.items() if not key.startswith(settings)}


def run_on_each_cpu(program: str, *words: object, folder: Path, timeout_s: float = 600,
                    cpus: Sequence[str] = (THIS, OLDEST)) -> dict[str, Any]:
    """What the program of this folder prints as JSON, by CPU; all processes at the same time, outputs in `folder`."""
    began = {}
    for name, changes in list_cpu_settings().items():
        if name not in cpus:
            continue
        environment = {**list_environment(), **changes, "PYTHONPATH": f"{ROOT}{os.pathsep}{SUPPORT}"}
        command = [sys.executable, str(SUPPORT / program), *map(str, words)]
        place = folder / str(len(began))
        place.mkdir()
        streams = {"stdout": (place / "out").open("wb"), "stderr": (place / "err").open("wb")}
        began[name] = subprocess.Popen(command, env=environment, cwd=place, stdin=subprocess.DEVNULL, **streams), place
    answers = {}
    for name, (process, place) in began.items():
        status = process.wait(timeout_s)
        assert status == 0, f"{name}: {(place / 'err').read_text()}"
        answers[name] = json.loads((place / "out").read_text())
    return answers
