"""The plant gives the same bits on every x86-64 CPU; fits agree within a small fraction of their own interval.

The fits: on all CPUs with AVX2 and FMA. Linear algebra has the same kernels there (plant/blas.py); NumPy's elementary
functions have not. docs/statistics.md says what was measured, on older CPUs too.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import other_cpus
import pytest
from noisy_traces import SHORT, record_plant
from places import ROOT

from plant import blas

COMPILE = """
from plant.compile import compile_function
def double(x):
    return x + x
compile_function(double)(1.5)
"""


def test_every_case_has_the_same_bits_on_every_cpu(tmp_path: Path) -> None:
    """One hash a case, whatever vector code, fused multiply-add and library functions there are."""
    hashes = other_cpus.run_on_each_cpu("cpu_plant_cases.py", folder=tmp_path)
    here = hashes[other_cpus.THIS]
    assert len(here) >= 8 and len(set(here.values())) == len(here) and hashes[other_cpus.OLDEST] == here


def test_the_settings_reach_the_libraries(tmp_path: Path) -> None:
    """Without them nothing above would be tested: the machine code, and NumPy's and the C library's own exp, change."""
    program = tmp_path / "seen.py"
    program.write_text(SEEN)
    answers = other_cpus.run_on_each_cpu(str(program), folder=tmp_path)
    here, oldest = answers[other_cpus.THIS], answers[other_cpus.OLDEST]
    assert oldest["cpu"] == "generic" and oldest["features"] == "" and oldest["numpy"] == []
    if here["numpy"]:
        assert here["cpu"] != "generic" and "fma" in here["features"]
        assert here["exp"] != oldest["exp"], "the C library's exp does not depend on the CPU any more"


SEEN = """
import hashlib, json, math
import numpy as np
from numba.core.registry import cpu_target
codegen = cpu_target.target_context.codegen()
core = np._core._multiarray_umath
print(json.dumps({
    "cpu": codegen._get_host_cpu_name(), "features": codegen._get_host_cpu_features(),
    "numpy": [name for name in core.__cpu_dispatch__ if core.__cpu_features__[name]],
    "exp": hashlib.sha256(np.array([math.exp(-5.0 * x) for x in np.linspace(0.0, 1.0, 100000)])).hexdigest()}))
"""


def test_machine_code_of_another_cpu_is_not_taken_from_the_cache(tmp_path: Path) -> None:
    """One folder serves all: a setting that is new compiles, one that was there loads."""
    def compiled_functions(changes: dict[str, str]) -> int:
        environment = {**other_cpus.list_environment(), "EHA_RIG_CACHE": str(tmp_path / "cache"),
                       "PYTHONPATH": str(ROOT), **changes}
        subprocess.run([sys.executable, tmp_path / "program.py"], env=environment, check=True)
        return len(list((tmp_path / "cache").rglob("*.nbc")))

    (tmp_path / "program.py").write_text(COMPILE)
    generic = {"NUMBA_CPU_NAME": "generic"}
    assert [compiled_functions(changes) for changes in ({}, generic, {})] == [1, 2, 2]


BLAS = """
import ctypes, json, sys
__import__(sys.argv[1])
import numpy, scipy.linalg
names, threads = set(), set()
for path in {line.split()[-1] for line in open("/proc/self/maps") if "openblas" in line}:
    library = ctypes.CDLL(path)
    for suffix in ("", "64_"):
        name = getattr(library, "scipy_openblas_get_corename" + suffix, None)
        if name is not None:
            name.restype = ctypes.c_char_p
            names.add(name().decode())
            threads.add(getattr(library, "scipy_openblas_get_num_threads" + suffix)())
print(json.dumps([sorted(names), sorted(threads)]))
"""


@pytest.mark.parametrize("package", ["plant", "fdi", "rig"])
def test_linear_algebra_has_one_thread_and_the_kernels_of_2013(tmp_path: Path, package: str) -> None:
    """On every CPU that has AVX2 and FMA, whichever package is imported first."""
    if not {"avx2", "fma"} <= blas.read_cpu_flags():
        pytest.skip("a CPU without AVX2 and FMA")
    program = tmp_path / "kernels.py"
    program.write_text(BLAS)
    answer = other_cpus.run_on_each_cpu(str(program), package, folder=tmp_path, cpus=[other_cpus.THIS])[other_cpus.THIS]
    if answer == [[], []]:
        pytest.skip("NumPy and SciPy with another BLAS")
    assert answer == [["Haswell"], [1]]


def test_flags_of_a_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An old CPU keeps the kernels of its own, and what the user has set stays."""
    info = tmp_path / "cpuinfo"
    info.write_text("processor\t: 0\nflags\t\t: fpu sse2 avx\n\nprocessor\t: 1\nflags\t\t: fpu avx2 fma\n")
    assert {"fpu", "avx"} <= blas.read_cpu_flags(info) and "avx2" not in blas.read_cpu_flags(info)
    assert blas.read_cpu_flags(tmp_path / "missing") == set()
    for flags, user_core_type, core_type in ((set(), None, None), ({"avx2", "fma"}, None, "Haswell"),
                                             ({"avx2", "fma"}, "Zen", "Zen")):
        monkeypatch.setattr(blas, "read_cpu_flags", lambda flags=flags: flags)
        monkeypatch.delenv("OPENBLAS_CORETYPE", raising=False)
        if user_core_type:
            monkeypatch.setenv("OPENBLAS_CORETYPE", user_core_type)
        blas.fix_blas_kernels()
        assert os.environ.get("OPENBLAS_CORETYPE") == core_type


FRACTION = 0.01  # of the width of the interval
RELATIVE = 1e-3  # of an error, a noise floor or a ratio, which have no interval


def flatten(answer: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of an answer with its path."""
    if isinstance(answer, dict | list):
        for key, below in answer.items() if isinstance(answer, dict) else enumerate(answer):
            yield from flatten(below, f"{path}/{key}")
    else:
        yield path, answer


def test_answers_agree(tmp_path: Path) -> None:
    """Each estimate, value and both ends, within a hundredth of its interval; RMS errors and floors; words."""
    if other_cpus.AVX2 not in other_cpus.list_cpu_settings():
        pytest.skip("a CPU without AVX2 and FMA: OpenBLAS has the kernels of its own there, and nothing is promised")
    for seed, name in enumerate(("biased", "repeat"), 1):
        record_plant({"null_bias.current": 2e-4}, SHORT, seed=seed).write_csv(tmp_path / f"{name}.csv")
    cpus = other_cpus.THIS, other_cpus.AVX2
    answers = other_cpus.run_on_each_cpu("cpu_fit_cases.py", tmp_path, folder=tmp_path, cpus=cpus)
    here, there = (dict(flatten(answers[cpu])) for cpu in cpus)
    widths = {path: here[f"{path}/high"] - here[f"{path}/low"] for path in
              (path.removesuffix("/low") for path in here if path.endswith("/low")) if f"{path}/high" in here}
    assert here["/helps"] and any(width > 0.0 for width in widths.values())
    for path, value in here.items():
        parent, _, key = path.rpartition("/")
        if key in ("value", "low", "high") and widths.get(parent, 0.0) > 0.0:
            assert abs(there[path] - value) <= FRACTION * widths[parent], (path, value, there[path])
        elif key in ("error", "floor") or parent.endswith("/error"):
            assert there[path] == pytest.approx(value, rel=RELATIVE), path
        elif isinstance(value, bool) or (isinstance(value, str) and not any(map(str.isdigit, value))):
            assert there[path] == value, path
