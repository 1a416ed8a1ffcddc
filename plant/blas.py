"""Linear algebra that adds up in the same order on every machine.

OpenBLAS, which NumPy and SciPy use, chooses its code by the CPU and splits its sums among as many threads as there are
cores. Both change the last bits. A fit over stick-slip amplifies them: measured, up to 0.6 of the width of an interval
(docs/statistics.md). OpenBLAS reads its settings when it is loaded, so this comes before the first import of NumPy.
"""

import os
from pathlib import Path


def fix_blas_kernels() -> None:
    """Select one thread, and the kernels for AVX2 and FMA where the CPU has both; what the user has set stays."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if {"avx2", "fma"} <= read_cpu_flags():
        os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")


def read_cpu_flags(file: Path = Path("/proc/cpuinfo")) -> set[str]:
    """Names of the instruction sets of the first CPU; empty where the kernel does not list them."""
    try:
        with file.open(encoding="ascii", errors="replace") as lines:
            return next((set(line.split()) for line in lines if line.startswith("flags")), set())
    except OSError:
        return set()
