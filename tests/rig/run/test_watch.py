"""The parts of a session without a bus: time and stage, journal, safe state, silent nodes, overruns."""

from collections.abc import Collection, Iterable
from math import nan
from typing import Any

import pytest

from rig.recorder import Timing
from rig.run.watch import OverrunWatch, SilenceWatch
from rig.sequences import TimingPolicy

MS = 1_000_000  # ns


class Watch:
    """Looks every 20 ms; nodes are silent for 2 s."""

    def __init__(self) -> None:
        self._watch = SilenceWatch(2000 * MS)

    def look(self, since_ms: int, until_ms: int, heard_ms: dict[int, int], answering: Collection[int] = ()) -> set[int]:
        """The nodes found at the end; `heard_ms`: when the last heartbeat of each node came, ms."""
        silent_nodes = {}
        for t in range(since_ms, until_ms, 20):
            silent_nodes = self._watch.find_silent(t * MS, {node: at * MS for node, at in heard_ms.items()}, answering)
        assert all(seconds >= 2.0 for seconds in silent_nodes.values())
        return set(silent_nodes)


def test_a_node_without_heartbeat_and_answer_is_found_until_it_is_heard_again() -> None:
    watch = Watch()
    assert watch.look(0, 2000, {2: 0, 3: 0}) == set()
    assert watch.look(2000, 2060, {2: 0, 3: 1950}) == {2}
    assert watch.look(2060, 2080, {2: 0, 3: 1950}, answering=[2]) == set()
    assert watch.look(2080, 3000, {2: 2070, 3: 1950}) == set()


def test_time_in_which_the_rig_stood_still_does_not_count() -> None:
    watch = Watch()
    watch.look(0, 1000, {2: 0})
    assert watch.look(60_000, 60_500, {2: 0}) == set()
    assert watch.look(60_500, 61_500, {2: 0}) == {2}


def test_a_node_that_is_left_out_is_not_watched_and_begins_anew() -> None:
    """One that was never heard, or that has been reset."""
    watch = Watch()
    assert watch.look(0, 5000, {3: 0}) == {3}
    assert watch.look(5000, 5020, {}) == set()
    assert watch.look(5020, 6000, {3: 0}) == set()


ON_TIME = Timing(0, False, 1e-5, 2e-4, 2e-4, 1e-4, 1e-4, 0.0)


def make_timing(cycle: int, **changes: float) -> Timing:
    """The timing of a cycle in which the bench was on time but for the changes."""
    names = ("lateness", "response", "work", "feedback_response", "valve_response", "execution")
    return Timing(cycle, False, **({name: getattr(ON_TIME, name) for name in names} | changes))


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
    result = watch(make_timing(cycle, **changes) for cycle in range(200, 203))
    assert result == is_late * "the bench was late: 3 overruns in a row up to cycle 202, limit 2"


def test_a_cycle_on_time_ends_the_row_and_one_that_a_fault_disturbs_does_not() -> None:
    late = [make_timing(cycle, feedback_response=nan) for cycle in (200, 201, 203, 204)]
    assert not watch(late, injected={203, 204})
    assert "3 overruns" in watch([*late, make_timing(205, lateness=0.7e-3)], injected={203, 204})
    assert not watch(make_timing(cycle, feedback_response=nan if cycle % 3 else 1e-4) for cycle in range(200, 220))


@pytest.mark.parametrize("policy", [{"grace": 1.0, "tolerate": None}, {"overruns": "count", "tolerate": 0}])
def test_overruns_are_not_watched_within_the_grace_or_when_they_are_only_counted(policy: dict[str, Any]) -> None:
    assert not watch([make_timing(200, lateness=5e-3)], **policy)
