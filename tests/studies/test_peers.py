"""Peers make the same runs as this software, and a peer that is missing is named with its reason."""

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pytest
from physics_cases import PREFLIGHT

from rig.bench import benchmarks
from studies.peers import __main__ as command, grid_runs, many_runs, rivals

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason=f"no gcc; {benchmarks.GET_GCC}")


def test_without_gcc_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(benchmarks.shutil, "which", lambda name: None)
    monkeypatch.setattr(rivals.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(command, "compare_many_runs", partial(many_runs.compare_many_runs, rounds=1, cycles=300))
    monkeypatch.setattr(command, "compare_grid_runs", partial(grid_runs.compare_grid_runs, rounds=1))
    assert command.main([]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "C, one run after the other skipped, gcc is not installed; to get it: apt-get install gcc" in words
    assert "C, OpenMP skipped, gcc is not installed" in words
    assert "jax, vmap skipped, jax is not installed; to get it: pip install 'eha-rig[bench]'" in words
    assert "ProgPy, vectorised skipped, progpy is not installed" in words


def list_sound_rivals(compare: Callable[..., Sequence[rivals.Rival]], **options: Any) -> dict[str, rivals.Rival]:
    """The rivals by name; those that are not installed say so, the others make the same numbers."""
    stages: list[str] = []
    found = {rival.name: rival for rival in compare(PREFLIGHT[:1500], lambda stage, share: stages.append(stage),
                                                    rounds=2, **options)}
    assert len(found) == 8 and stages
    for name, rival in found.items():
        if rival.speed is None:
            assert name.startswith(("jax", "ProgPy")) and "is not installed" in rival.note
        elif name != grid_runs.REFERENCE:
            assert rival.ratio is not None and rival.difference is not None and rival.difference < 1e-12
    return found


@needs_gcc
def test_every_rival_makes_the_same_runs() -> None:
    """Those of the `bench` extra where it is installed; without fused multiply-add C even to the last bit."""
    found = list_sound_rivals(many_runs.compare_many_runs, cycles=300)
    for name in (many_runs.OURS, "ours, a thread a core", "C, 16 runs, -ffp-contract=off"):
        assert found[name].difference == 0.0


@needs_gcc
def test_every_rival_makes_the_same_map() -> None:
    reference = list_sound_rivals(grid_runs.compare_grid_runs)[grid_runs.REFERENCE]
    assert reference.ratio is not None and reference.ratio > 0.0
    assert reference.difference is not None and 1e-6 < reference.difference < 3e-3
