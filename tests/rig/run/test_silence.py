"""Nodes that have stopped sending: known by the time for which the rig listened, not by the time that passed."""
from __future__ import annotations

from rig.run.watch import SilenceWatch

MS = 1_000_000  # ns


def look(watch: SilenceWatch, since_ms: int, until_ms: int, heard: dict[int, int], every_ms: int = 20) -> None:
    """Look again and again; `heard`: when the last heartbeat of each node came, ms."""
    for t in range(since_ms, until_ms, every_ms):
        watch.look(t * MS, {node: at * MS for node, at in heard.items()})


def test_a_node_without_heartbeat_and_answer_is_found() -> None:
    watch = SilenceWatch(2000 * MS)
    look(watch, 0, 2000, {2: 0, 3: 0})
    assert watch.find_silent() == {}
    look(watch, 2000, 2060, {2: 0, 3: 1950})
    assert watch.find_silent().keys() == {2} and 2.0 <= watch.find_silent()[2] < 2.1
    assert watch.find_silent(answering=[2]) == {}


def test_one_that_is_heard_again_is_back() -> None:
    watch = SilenceWatch(2000 * MS)
    look(watch, 0, 3000, {2: 0})
    assert watch.find_silent().keys() == {2}
    look(watch, 3000, 4000, {2: 2990})
    assert watch.find_silent() == {}


def test_time_in_which_the_rig_stood_still_does_not_count() -> None:
    watch = SilenceWatch(2000 * MS)
    look(watch, 0, 1000, {2: 0})
    look(watch, 60_000, 60_500, {2: 0})
    assert watch.find_silent() == {}
    look(watch, 60_500, 61_500, {2: 0})
    assert watch.find_silent().keys() == {2}


def test_a_node_that_is_left_out_is_not_watched_and_begins_anew() -> None:
    """One that was never heard, or that has been reset."""
    watch = SilenceWatch(2000 * MS)
    look(watch, 0, 5000, {3: 0})
    assert watch.find_silent().keys() == {3}
    look(watch, 5000, 5020, {})
    assert watch.find_silent() == {}
    look(watch, 5020, 6000, {3: 0})
    assert watch.find_silent() == {}
