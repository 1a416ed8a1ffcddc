"""Overruns of the bench while a run is under way, for the policy that ends main when there are too many in a row."""
from __future__ import annotations

from rig.recorder import Timing
from rig.sequences.timing import TimingPolicy


class OverrunWatch:
    """Counts overruns in a row, cycle by cycle. `problem` says when there were too many; empty before that."""

    def __init__(self, policy: TimingPolicy, period: float) -> None:
        """`period` is the length of a cycle in s."""
        self._most = policy.most_in_a_row if policy.overruns == "abort" else None
        self._policy, self._period = policy, period
        self._in_a_row = 0
        self.problem = ""

    def add(self, timing: Timing) -> None:
        """Take in a complete cycle."""
        if self._most is None or self.problem or timing.cycle * self._period < self._policy.grace:
            return
        late = timing.lateness > self._policy.sync
        self._in_a_row = self._in_a_row + max(1, int(timing.lateness / self._period)) if late else 0
        if self._in_a_row > self._most:
            self.problem = (f"the bench was late: {self._in_a_row} overruns in a row up to cycle {timing.cycle}, "
                            f"{self._most} are accepted")
