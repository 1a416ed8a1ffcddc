"""Fits agree on all CPUs with AVX2 and FMA within a small fraction of their own 95 % interval; verdicts are the same.

Linear algebra has the same kernels there (plant/blas.py); NumPy's elementary functions have not. docs/statistics.md
says what was measured, on older CPUs too.
"""
from __future__ import annotations

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


def intervals(answer: Any, path: str = "") -> Iterator[tuple[str, dict[str, float]]]:
    """Each estimate with its interval: objects that have value, low and high."""
    if isinstance(answer, dict) and {"value", "low", "high"} <= set(answer):
        yield path, {key: answer[key] for key in ("value", "low", "high")}
    elif isinstance(answer, dict):
        for key, below in answer.items():
            yield from intervals(below, f"{path}/{key}")
    elif isinstance(answer, list):
        for number, below in enumerate(answer):
            yield from intervals(below, f"{path}/{number}")


def test_estimates_agree_within_a_hundredth_of_their_interval(answers: dict[str, dict[str, Any]]) -> None:
    """Value and both ends of each, of an effect that was added and of the sizes of faults."""
    here = dict(intervals(answers[other_cpus.THIS]))
    wide = {path: size for path, size in here.items() if size["high"] > size["low"]}
    assert len(wide) >= 3
    for cpu, answer in answers.items():
        there = dict(intervals(answer))
        assert there.keys() == here.keys()
        for path, size in wide.items():
            width = size["high"] - size["low"]
            for key, value in size.items():
                assert abs(there[path][key] - value) <= FRACTION * width, (cpu, path, key, value, there[path])


def test_verdicts_are_the_same(answers: dict[str, dict[str, Any]]) -> None:
    """And so is everything else that is not a number."""
    def words(answer: dict[str, Any]) -> list[Any]:
        compared, added, diagnosed = answer["compare"], answer["add"], answer["fdi"]
        return [compared["verdict"], compared["disagree"], [row["section"] for row in compared["where"]],
                added["helps"], [row["effect"] for row in added["ledger"]],
                diagnosed["verdict"], diagnosed["level"], diagnosed["ruling"],
                [(event["band"], event["signal"], event["t_in"]) for event in diagnosed["events"]]]

    here = words(answers[other_cpus.THIS])
    assert here[0] == "MODEL_INCOMPLETE" and here[3] is True and here[5] == "MAINTENANCE"
    assert all(words(answer) == here for answer in answers.values())


def test_errors_and_noise_floors_agree(answers: dict[str, dict[str, Any]]) -> None:
    """RMS values, which come from the bits of the replay and from the fitted parameters."""
    for answer in answers.values():
        for name, signal in answers[other_cpus.THIS]["compare"]["signals"].items():
            there = answer["compare"]["signals"][name]
            assert [there[key] for key in ("error", "floor")] == pytest.approx(
                [signal[key] for key in ("error", "floor")], rel=RELATIVE)
        for row, other in zip(answers[other_cpus.THIS]["add"]["ledger"], answer["add"]["ledger"], strict=True):
            assert other["error"] == pytest.approx(row["error"], rel=RELATIVE)
