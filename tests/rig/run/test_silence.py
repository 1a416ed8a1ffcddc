"""Nodes that have stopped sending: known by the time for which the rig listened, not by the time that passed."""

from collections.abc import Collection

from rig.run.watch import SilenceWatch

MS = 1_000_000  # ns


class Watch:
    """Looks every 20 ms; nodes are silent for 2 s."""

    def __init__(self) -> None:
        self._watch = SilenceWatch(2000 * MS)

    def look(self, since_ms: int, until_ms: int, heard: dict[int, int], answering: Collection[int] = ()) -> set[int]:
        """The nodes found at the end; `heard`: when the last heartbeat of each node came, ms."""
        found = {}
        for t in range(since_ms, until_ms, 20):
            found = self._watch.find_silent(t * MS, {node: at * MS for node, at in heard.items()}, answering)
        assert all(seconds >= 2.0 for seconds in found.values())
        return set(found)


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
