"""Peers make the same runs as this software, and a peer that is missing is named with its reason."""

import shutil
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from physics_cases import PREFLIGHT

from rig.bench import benchmarks
from studies.peers import grid_runs, many_runs, rivals

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason=f"no gcc; {benchmarks.GET_GCC}")


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
