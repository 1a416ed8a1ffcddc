"""Time limits of a run, and what happens when the bench itself is late: the table [timing] of a sequence."""

from dataclasses import dataclass
from math import ceil
from typing import Annotated, Literal

from plant.quantity import Quantity
from plant.segments import LONGEST

InCycle = Annotated[float, Quantity("s", above=0.0, high=0.1)]


@dataclass(frozen=True, kw_only=True)
class TimingPolicy:
    """Limits in s. An overrun is a cycle in which the bench was late: SYNC beyond `sync`, feedback beyond `feedback`.

    A cycle that begins whole periods late counts as that many overruns. `overruns` says what they lead to: "count"
    plays the sequence to its end and judges its timing then, "abort" ends main when more than `tolerate` come in a row.
    """

    overruns: Literal["count", "abort"] = "count"
    # overruns in a row; None: any number with "count", none with "abort"
    tolerate: Annotated[int, Quantity("1", low=0, high=1_000_000)] | None = None
    share: Annotated[float, Quantity("1", low=0.0, high=1.0)] = 1e-3  # of all cycles; more make the timing invalid
    grace: Annotated[float, Quantity("s", low=0.0, high=LONGEST)] = 0.1  # overruns in it do not count
    sync: InCycle | None = None  # SYNC after it was due; None: half a cycle
    feedback: InCycle | None = None  # from SYNC to the feedback frame; None: half a cycle
    operational: Annotated[float, Quantity("s", above=0.0, high=60.0)] = 1.0  # from NMT start to OPERATIONAL

    @property
    def most_in_a_row(self) -> int | None:
        """Overruns in a row that are accepted; None: any number."""
        return 0 if self.tolerate is None and self.overruns == "abort" else self.tolerate

    def find_limits(self, period: float) -> tuple[float, float]:
        """The limits of SYNC and of feedback, s, where a cycle is `period` s long."""
        sync, feedback = (0.5 * period if limit is None else limit for limit in (self.sync, self.feedback))
        return sync, feedback

    def choose_sync_period(self, period: float, in_a_row: int = 10) -> int:
        """The communication cycle period to write to the nodes in real time (0x1006), us; a cycle is `period` s long.

        CiA 301 does not say when SYNC counts as lost. CANopenNode says so 1.5 periods after the last one. With the true
        period it would report every SYNC that is half a cycle late, which is an error of the bench and not of the bus.
        So 1.5 times the value is at least the longest pause that the sequence accepts: its overruns in a row (or
        `in_a_row`, if more) and one more SYNC that is late by its limit.
        """
        periods_tolerated = 1.5  # after so many times 0x1006 without a SYNC some CANopen stacks call SYNC lost
        pause = (max(self.most_in_a_row or 0, in_a_row) + 1) * period + self.find_limits(period)[0]
        return round(1e6 * period) * ceil(pause / periods_tolerated / period)
