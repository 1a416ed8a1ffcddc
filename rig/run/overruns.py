"""Overruns of the bench while a run is under way, for the policy that ends main when there are too many in a row."""
from __future__ import annotations

from collections.abc import Container
from math import isnan

from rig.recorder import Timing
from rig.sequences.timing import TimingPolicy


class OverrunWatch:
    """Counts overruns in a row, cycle by cycle. `problem` says when there were too many; empty before that.

    A cycle is an overrun if its SYNC was sent late or the plant's frames came late or not at all. It counts once, or as
    many times as SYNC was whole periods late. Cycles in which the sequence itself disturbs these frames do not count,
    and do not end a row of overruns.
    """

    def __init__(self, policy: TimingPolicy, period: float, injected: Container[int] = ()) -> None:
        """`period` is the length of a cycle in s; `injected`: cycles whose SYNC or plant frames a fault disturbs."""
        self._most = policy.most_in_a_row if policy.overruns == "abort" else None
        self._policy, self._period, self._injected = policy, period, injected
        self._in_a_row = 0
        self.problem = ""

    def add(self, timing: Timing) -> None:
        """Take in a complete cycle."""
        if self._most is None or self.problem or timing.cycle * self._period < self._policy.grace:
            return
        if timing.cycle in self._injected:
            return
        is_fed = timing.feedback_response <= self._policy.feedback and not isnan(timing.valve_response)
        is_late = timing.lateness > self._policy.sync or not is_fed
        self._in_a_row = self._in_a_row + max(1, int(timing.lateness / self._period)) if is_late else 0
        if self._in_a_row > self._most:
            self.problem = (f"the bench was late: {self._in_a_row} overruns in a row up to cycle {timing.cycle}, "
                            f"{self._most} are accepted")
