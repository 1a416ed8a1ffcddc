"""The policy "abort": which cycles are overruns while a run is under way."""

from collections.abc import Collection, Iterable
from math import nan
from typing import Any

import pytest

from rig.recorder import Timing
from rig.run.watch import OverrunWatch
from rig.sequences.timing import TimingPolicy

ON_TIME = Timing(0, False, 1e-5, 2e-4, 2e-4, 1e-4, 1e-4, 0.0)


def make_timing(cycle: int, **changes: float) -> Timing:
    """The timing of a cycle in which the bench was on time but for the changes."""
    names = ("lateness", "response", "work", "feedback_response", "valve_response", "execution")
    values = {name: getattr(ON_TIME, name) for name in names} | changes
    return Timing(cycle, False, **values)


def watch(timings: Iterable[Timing], injected: Collection[int] = (), **policy: Any) -> str:
    """What is said after these cycles, if two overruns in a row are accepted."""
    one = OverrunWatch(TimingPolicy(**{"overruns": "abort", "tolerate": 2} | policy), 1e-3, injected)
    for timing in timings:
        one.add(timing)
    return one.problem


@pytest.mark.parametrize(("changes", "is_late"), [
    ({}, False), ({"lateness": 0.6e-3}, True), ({"feedback_response": 0.6e-3}, True),
    ({"feedback_response": nan}, True), ({"valve_response": nan}, True),
    ({"response": nan}, False),  # that is the controller's
])
def test_late_and_missing_frames_of_the_plant_count_as_late_syncs_do(changes: dict[str, float], is_late: bool) -> None:
    said = watch(make_timing(cycle, **changes) for cycle in range(200, 203))
    assert said == is_late * "the bench was late: 3 overruns in a row up to cycle 202, 2 are accepted"


def test_a_cycle_on_time_ends_the_row_and_one_that_a_fault_disturbs_does_not() -> None:
    late = [make_timing(cycle, feedback_response=nan) for cycle in (200, 201, 203, 204)]
    assert not watch(late, injected={203, 204})
    assert "3 overruns" in watch([*late, make_timing(205, lateness=0.7e-3)], injected={203, 204})
    assert not watch(make_timing(cycle, feedback_response=nan if cycle % 3 else 1e-4) for cycle in range(200, 220))


@pytest.mark.parametrize("policy", [{"grace": 1.0, "tolerate": None}, {"overruns": "count", "tolerate": 0}])
def test_overruns_are_not_watched_within_the_grace_or_when_they_are_only_counted(policy: dict[str, Any]) -> None:
    assert not watch([make_timing(200, lateness=5e-3)], **policy)
