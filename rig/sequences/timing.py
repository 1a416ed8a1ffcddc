"""Time limits of a run, and what happens when the bench itself is late: the table [timing] of a sequence."""
from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Literal

from plant.errors import InputError
from plant.segments import LONGEST, Second

PERIOD = 1e-3  # s, one cycle


@dataclass(frozen=True, kw_only=True)
class TimingPolicy:
    """Limits in s. An overrun is a cycle in which the bench was late: SYNC beyond `sync`, feedback beyond `feedback`.

    A cycle that begins whole periods late counts as that many overruns. `overruns` says what they lead to: "count"
    plays the sequence to its end and judges its timing then, "abort" ends main when more than `tolerate` come in a row.
    """

    overruns: Literal["count", "abort"] = "count"
    tolerate: int | None = None  # overruns in a row; None: any number with "count", none with "abort"
    share: float = 1e-3  # of all cycles; more make the timing of the run invalid
    grace: Second = 0.1  # from the first cycle; overruns in it do not count
    sync: Second = 0.5e-3  # SYNC after it was due
    feedback: Second = 0.5e-3  # from SYNC to the feedback frame
    operational: Second = 1.0  # from NMT start to OPERATIONAL

    def __post_init__(self) -> None:
        _require(self.tolerate is None or 0 <= self.tolerate <= 1_000_000, "tolerate",
                 f"a number of overruns from 0 to 1000000, not {self.tolerate}")
        _require(0 <= self.share <= 1, "share", f"a fraction from 0 to 1, not {self.share:g}")
        _require(0 <= self.grace <= LONGEST, "grace", f"0 s or more, at most {LONGEST:g}, not {self.grace:g}")
        for key in ("sync", "feedback"):
            limit = getattr(self, key)
            _require(0 < limit <= PERIOD, key, f"above 0 s and at most the cycle of {PERIOD:g} s, not {limit:g}")
        _require(0 < self.operational <= 60, "operational", f"above 0 s and at most 60 s, not {self.operational:g}")

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


def _require(holds: bool, key: str, expected: str) -> None:
    if not holds:
        raise InputError("timing", key, expected)
