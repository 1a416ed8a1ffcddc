"""Time limits of a run, and what happens when the bench itself is late: the table [timing] of a sequence."""
from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Annotated, Literal

from plant.segments import LONGEST
from rig.tables import Range

PERIOD = 1e-3  # s, one cycle
InCycle = Annotated[float, Range("s", above=0.0, high=PERIOD)]


@dataclass(frozen=True, kw_only=True)
class TimingPolicy:
    """Limits in s. An overrun is a cycle in which the bench was late: SYNC beyond `sync`, feedback beyond `feedback`.

    A cycle that begins whole periods late counts as that many overruns. `overruns` says what they lead to: "count"
    plays the sequence to its end and judges its timing then, "abort" ends main when more than `tolerate` come in a row.
    """

    overruns: Literal["count", "abort"] = "count"
    # overruns in a row; None: any number with "count", none with "abort"
    tolerate: Annotated[int, Range("1", low=0, high=1_000_000)] | None = None
    share: Annotated[float, Range("1", low=0.0, high=1.0)] = 1e-3  # of all cycles; more make the timing invalid
    grace: Annotated[float, Range("s", low=0.0, high=LONGEST)] = 0.1  # overruns in it do not count
    sync: InCycle = 0.5e-3  # SYNC after it was due
    feedback: InCycle = 0.5e-3  # from SYNC to the feedback frame
    operational: Annotated[float, Range("s", above=0.0, high=60.0)] = 1.0  # from NMT start to OPERATIONAL

    @property
    def most_in_a_row(self) -> int | None:
        """Overruns in a row that are accepted; None: any number."""
        return 0 if self.tolerate is None and self.overruns == "abort" else self.tolerate

    def choose_sync_period(self, in_a_row: int = 10) -> int:
        """The communication cycle period to write to the nodes in real time (0x1006), us.

        CiA 301 does not say when SYNC counts as lost. CANopenNode says so 1.5 periods after the last one. With the true
        period of 1 ms it would report every SYNC that is 0.5 ms late, which is an error of the bench and not of the
        bus. So 1.5 times the value is at least the longest pause that the sequence accepts: its overruns in a row (or
        `in_a_row`, if more) and one more SYNC that is late by its limit.
        """
        periods_tolerated = 1.5  # after so many times 0x1006 without a SYNC some CANopen stacks call SYNC lost
        pause = (max(self.most_in_a_row or 0, in_a_row) + 1) * PERIOD + self.sync
        return 1000 * ceil(pause / periods_tolerated / PERIOD)
