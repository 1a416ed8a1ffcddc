"""The data that checks use: columns of a run by window and signal, its events, and when its faults began."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from plant.segments import RATE, Array
from rig.sequences import measures
from rig.sequences.measures import NotMeasurable

MAIN = "main"  # the window that is all of the main phase


class TraceLike(Protocol):
    """The columns of a run, each (n,) and SI; row k is cycle k of main. Also cor, p12, xs, load. NaN, None: absent."""

    @property
    def t(self) -> Array: ...
    @property
    def com(self) -> Array: ...
    @property
    def xj(self) -> Array: ...


class EventLike(Protocol):
    """An event at `t` seconds of the main phase."""

    @property
    def t(self) -> float: ...
    @property
    def kind(self) -> str: ...
    @property
    def text(self) -> str: ...


class DriveFrames(NamedTuple):
    """All drive frames of a run, whatever their cycle number, as columns; only recorded if faults act on the bus."""

    t: Array  # s of main
    current: Array  # A
    status: NDArray[np.int64]  # status word

    def select_between(self, t0: float, t1: float) -> DriveFrames:
        """Those with t0 <= t < t1."""
        chosen = (self.t >= t0 - 1e-9) & (self.t < t1 - 1e-9)  # times come from ns
        return DriveFrames(self.t[chosen], self.current[chosen], self.status[chosen])


NO_DRIVES = DriveFrames(np.zeros(0), np.zeros(0), np.zeros(0, np.int64))


@dataclass(frozen=True)
class RunData:
    """The data of a run that checks use: trace, sections, events, and when each fault started (s of main, by label)."""

    trace: TraceLike
    sections: Mapping[str, slice] = field(default_factory=dict)
    events: Sequence[EventLike] = ()
    starts: Mapping[str, float] = field(default_factory=dict)
    drives: DriveFrames = NO_DRIVES

    def find_start(self, after: str | float) -> float:
        """A time, s of main, given as such or as the label of the fault that begins then.

        Raises:
            NotMeasurable: there is no such fault.
        """
        t = after if isinstance(after, float) else self.starts.get(after)
        if t is None:
            raise NotMeasurable(f"there was no fault {after!r}")
        return t

    def find_rows(self, window: str | tuple[float, float], skip: float = 0.0) -> slice:
        """Rows of a window without its first `skip` seconds; NotMeasurable if the run ended before the window did."""
        rows = len(self.trace.t)
        if isinstance(window, tuple):
            first, last = round(window[0] * RATE), round(window[1] * RATE)
        elif window == MAIN:
            first, last = 0, rows
        elif window in self.sections:
            first, last = self.sections[window].start, self.sections[window].stop
        else:
            raise NotMeasurable(f"there is no section {window!r}")
        if last > rows:
            raise NotMeasurable(f"the run ended at {rows / RATE:g} s, the window at {last / RATE:g} s")
        first += round(skip * RATE)
        if first >= last:
            raise NotMeasurable("the window is empty")
        return slice(first, last)

    def read_signal(self, name: str, span: slice, largest_missing_share: float = 0.01) -> Array:
        """A signal's samples in a span, few missing ones bridged by straight lines; NotMeasurable without it."""
        if name == "error":
            return self.read_signal("com", span) - self.read_signal("xj", span)
        if name == "speed":
            return measures.compute_speed(self.read_signal("xj", span))
        column = getattr(self.trace, name, None)
        if column is None:
            raise NotMeasurable(f"{name} was not measured")
        return measures.bridge_gaps(np.asarray(column, float)[span], name, largest_missing_share)

    def count_missing(self, name: str, span: slice) -> int:
        """How many samples of a signal were bridged."""
        column = getattr(self.trace, {"error": "xj", "speed": "xj"}.get(name, name), None)
        return 0 if column is None else int(np.isnan(np.asarray(column, float)[span]).sum())

    def read_step(self, span: slice) -> tuple[Array, Array, float]:
        """Position and demand in a span, and the demand before it (at the very start: where the ram is)."""
        position = self.read_signal("xj", span)
        before = float(self.trace.com[span.start - 1] if span.start else position[0])
        return position, self.read_signal("com", span), before

    def find_events(self, event: str, t0: float, t1: float = float("inf")) -> list[EventLike]:
        """Events in t0 <= t < t1 whose kind and text have all words of `event`, whatever their case, by time."""
        words = set(event.lower().split())
        found = (e for e in self.events if t0 <= e.t < t1 and words <= set(f"{e.kind} {e.text}".lower().split()))
        return sorted(found, key=lambda e: e.t)
