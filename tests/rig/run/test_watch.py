"""The parts of a session without a bus: silent nodes, overruns."""

from collections.abc import Collection, Iterable
from math import nan
from typing import Any

import pytest

from rig.recorder import Timing
from rig.run.watch import OverrunWatch, SilenceWatch
from rig.sequences.sequence import TimingPolicy

MS = 1_000_000  # ns


def test_time_in_which_the_rig_stood_still_does_not_count() -> None:
    """It looks every 20 ms, and a node is silent after 2 s."""
    watch = SilenceWatch(2000 * MS)
    for times, silent in ((range(0, 1000, 20), []), (range(60_000, 60_500, 20), []), (range(60_500, 61_500, 20), [2])):
        for t in times:
            found = watch.find_silent(t * MS, {2: 0}, ())
        assert list(found) == silent


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
