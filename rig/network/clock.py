"""Time for the bench: a clock that is set (lockstep) and one that runs (real time)."""

import time
from typing import Protocol


class Clock(Protocol):
    """Time since the run began, ns."""

    def now(self) -> int:
        """The time now, ns."""

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`; at once if that has passed."""


class VirtualClock:
    """Simulated time: `sleep_until` jumps to its end at once, so a run repeats bit for bit and never waits."""

    def __init__(self) -> None:
        self._t_ns = 0

    def now(self) -> int:
        """The time last jumped to, ns."""
        return self._t_ns

    def sleep_until(self, t_ns: int) -> None:
        """Jump to `t_ns`; never back."""
        self._t_ns = max(self._t_ns, t_ns)


class WallClock:
    """The machine's monotonic clock; 0 when it is created. `origin_ns` is that moment on CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        self.origin_ns = time.monotonic_ns()

    def now(self) -> int:
        """Time since the clock was created, ns."""
        return time.monotonic_ns() - self.origin_ns

    def sleep_until(self, t_ns: int) -> None:
        """Sleep until `t_ns`. CPython sleeps to an absolute deadline, so a long run does not drift."""
        left = t_ns - self.now()
        if left > 0:
            time.sleep(left * 1e-9)
