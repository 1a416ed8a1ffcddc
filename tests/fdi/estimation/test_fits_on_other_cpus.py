"""Fits agree on all CPUs with AVX2 and FMA within a small fraction of their own 95 % interval; verdicts are the same.

Linear algebra has the same kernels there (plant/blas.py); NumPy's elementary functions have not. docs/statistics.md
says what was measured, on older CPUs too.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import other_cpus
import pytest
from noisy_traces import SHORT, record_plant

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
