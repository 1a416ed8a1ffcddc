"""Fits agree on all CPUs with AVX2 and FMA within a small fraction of their own 95 % interval; verdicts are the same.

Linear algebra has the same kernels there (plant/blas.py); NumPy's elementary functions have not. docs/statistics.md
says what was measured, on older CPUs too.
"""

from collections.abc import Iterator
from typing import Any

import other_cpus
import pytest
from noisy_traces import SHORT, record_plant

FRACTION = 0.01  # of the width of the interval
RELATIVE = 1e-3  # of an error, a noise floor or a ratio, which have no interval


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """CPU to command to its JSON answer."""
    folder = tmp_path_factory.mktemp("traces")
    record_plant({"null_bias.current": 2e-4}, SHORT, seed=1).write_csv(folder / "biased.csv")
    record_plant({"null_bias.current": 2e-4}, SHORT, seed=2).write_csv(folder / "repeat.csv")
    record_plant({"filter.clogging": 0.28}, SHORT, seed=3).write_csv(folder / "clogged.csv")
    if other_cpus.AVX2 not in other_cpus.list_cpu_settings():
        pytest.skip("a CPU without AVX2 and FMA: OpenBLAS has the kernels of its own there, and nothing is promised")
    cpus = other_cpus.THIS, other_cpus.AVX2
    return other_cpus.run_on_each_cpu("cpu_fit_cases.py", folder, folder=tmp_path_factory.mktemp("cpus"), cpus=cpus)


def flatten(answer: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of an answer with its path."""
    if isinstance(answer, dict | list):
        for key, below in answer.items() if isinstance(answer, dict) else enumerate(answer):
            yield from flatten(below, f"{path}/{key}")
    else:
        yield path, answer


def test_answers_agree(answers: dict[str, dict[str, Any]]) -> None:
    """Each estimate, value and both ends, within a hundredth of its interval; RMS errors and floors; words."""
    here = dict(flatten(answers[other_cpus.THIS]))
    widths = {path: here[f"{path}/high"] - here[f"{path}/low"] for path in
              (path.removesuffix("/low") for path in here if path.endswith("/low")) if f"{path}/high" in here}
    assert sum(width > 0.0 for width in widths.values()) >= 3
    assert (here["/add/helps"], here["/fdi/verdict"]) == (True, "MAINTENANCE")
    for cpu, answer in answers.items():
        there = dict(flatten(answer))
        for path, value in here.items():
            parent, _, key = path.rpartition("/")
            if key in ("value", "low", "high") and widths.get(parent, 0.0) > 0.0:
                assert abs(there[path] - value) <= FRACTION * widths[parent], (cpu, path, value, there[path])
            elif key in ("error", "floor") or parent.endswith("/error"):
                assert there[path] == pytest.approx(value, rel=RELATIVE), (cpu, path)
            elif isinstance(value, bool) or (isinstance(value, str) and not any(map(str.isdigit, value))):
                assert there[path] == value, (cpu, path)
