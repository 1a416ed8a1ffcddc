"""A repeat from another unit: `rig explain`, `rig add` and the Python interface say so, as `rig compare` does."""
from __future__ import annotations

import pytest
from short_runs import HIDDEN, build_command

from fdi.discovery.runs import collect_runs
from fdi.trace.trace import Trace
from plant import Model, simulate


def record_unit(changes: dict[str, float], seed: int) -> Trace:
    columns = simulate(Model().replace(changes), build_command(), None, seed, 200)
    return Trace.from_columns(columns._asdict(), 1e-3, {})


@pytest.fixture(scope="module")
def run() -> Trace:
    return record_unit(HIDDEN, 1)


def test_a_repeat_from_another_unit_is_a_note(run: Trace) -> None:
    runs = collect_runs(Model(), run, [record_unit(HIDDEN | {"filter.clogging": 0.3}, 2)])
    assert len(runs.notes) == 1 and runs.notes[0].startswith("the repeats differ by more than the noise of the sensors")
    assert "XS by" in runs.notes[0] and "same unit" in runs.notes[0]


def test_a_true_repeat_needs_no_note_although_the_model_is_wrong(run: Trace) -> None:
    assert collect_runs(Model(), run, [record_unit(HIDDEN, 2)]).notes == ()
    assert collect_runs(Model(), run).notes == ()
