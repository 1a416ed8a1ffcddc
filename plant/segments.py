"""A command from segments (hold, step, ramp, sine, chirp, multisine, points, csv): a value per cycle, named sections.

A segment starts from the demand that the one before it reached at its end (the value it would take in the cycle after
its last), so a list of them is continuous except where a step, a CSV file or a wave with given phases says otherwise.
The same segments describe a load on the ram: read N for m. The waves are those of docs/physics.md.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from plant.errors import require
from plant.functions import exp_of, sin_of_turns

Array = npt.NDArray[np.float64]
Level = Annotated[float, "m (N for a load)"]
Second = Annotated[float, "s"]
Hertz = Annotated[float, "Hz"]
Radian = Annotated[float, "rad"]
PerSecond = Annotated[float, "1/s"]

RATE = 1000.0  # cycles a second where nothing else is said; times are k / rate because k * 1e-3 is not exact
LONGEST = 3600.0  # s, of one segment or file: beyond it, somebody wrote milliseconds


@dataclass(frozen=True, kw_only=True)
class Segment(ABC):
    """One piece of a command. Checks refer to its section by `name`."""

    kind: ClassVar[str]
    frequencies_in: ClassVar[tuple[str, ...]] = ()  # keys, Hz
    name: str = ""

    @property
    @abstractmethod
    def duration(self) -> float:
        """Length, s."""

    @abstractmethod
    def demand(self, t: Array, last: float) -> Array:
        """The demand at times `t` (s, from the segment's start), after one that ended at `last`."""

    def __post_init__(self) -> None:
        require(0.0 < self.duration <= LONGEST, "segment", "time",
                f"above 0 and at most {LONGEST:g} s, not {self.duration:g}")
        for key in self.frequencies_in:
            lowest = float(np.min(getattr(self, key)))
            require(lowest > 0.0, "segment", key, f"a frequency above 0 Hz, not {lowest:g}")

    def require_rate(self, rate: float) -> None:
        """Refuse a segment that `rate` samples a second cannot show: not whole cycles, or half the rate and above.

        Raises:
            InputError: the key, and what it must be; whoever read the segment knows its file and line and adds them.
        """
        cycles = self.duration * rate
        require(cycles > 0.5 and abs(cycles - round(cycles)) < 1e-6, "segment", "time",
                f"whole cycles of {1 / rate:g} s, not {self.duration:g}")
        for key in self.frequencies_in:
            highest = float(np.max(getattr(self, key)))
            require(highest < rate / 2, "segment", key, f"a frequency below {rate / 2:g} Hz, not {highest:g}")


@dataclass(frozen=True, kw_only=True)
class Timed(Segment):
    """A segment with a given duration."""

    time: Second

    @property
    def duration(self) -> float:
        return self.time


@dataclass(frozen=True, kw_only=True)
class Hold(Timed):
    """Stay at the last demand."""

    kind = "hold"

    def demand(self, t: Array, last: float) -> Array:
        return np.full_like(t, last)


@dataclass(frozen=True, kw_only=True)
class Step(Timed):
    """Jump to a demand and hold it."""

    kind = "step"
    to: Level

    def demand(self, t: Array, last: float) -> Array:
        return np.full_like(t, self.to)


@dataclass(frozen=True, kw_only=True)
class Ramp(Timed):
    """A straight line from the last demand; `to` is reached at the segment's end."""

    kind = "ramp"
    to: Level

    def demand(self, t: Array, last: float) -> Array:
        return last + (self.to - last) * (t / self.time)


@dataclass(frozen=True, kw_only=True)
class Sine(Timed):
    """A sine about the last demand."""

    kind, frequencies_in = "sine", ("frequency",)
    amplitude: Level
    frequency: Hertz

    def demand(self, t: Array, last: float) -> Array:
        return last + self.amplitude * sin_of_turns(self.frequency * t)


@dataclass(frozen=True, kw_only=True)
class Chirp(Timed):
    """A sine about the last demand whose frequency grows linearly from f0 to f1, faded in by 1 - exp(-fade t)."""

    kind, frequencies_in = "chirp", ("f0", "f1")
    amplitude: Level
    f0: Hertz
    f1: Hertz
    fade: PerSecond = 0.0  # 0: full amplitude from the start

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.fade >= 0, "segment", "fade", f"0 or more 1/s, not {self.fade:g}")

    def demand(self, t: Array, last: float) -> Array:
        cycles = self.f0 * t + (self.f1 - self.f0) / (2 * self.time) * t**2
        return last + self.amplitude * sin_of_turns(cycles) * _fade_in(t, self.fade)


@dataclass(frozen=True, kw_only=True)
class Multisine(Timed):
    """Sines of one amplitude each about the last demand; Schroeder phases (low crest factor) unless given.

    Schroeder, "Synthesis of low-peak-factor signals", IEEE Trans. Inf. Theory 16 (1970): phase_n = -pi n (n - 1) / N.
    A sum of phases does not start at zero, so it is faded in; fade = 0 lets it jump.
    """

    kind, frequencies_in = "multisine", ("frequencies",)
    amplitude: Level
    frequencies: tuple[Hertz, ...]
    phases: tuple[Radian, ...] = ()
    fade: PerSecond = 20.0

    def __post_init__(self) -> None:
        require(bool(self.frequencies), "segment", "frequencies", "at least one frequency in Hz")
        super().__post_init__()
        require(len(self.phases) in (0, len(self.frequencies)), "segment", "phases",
                 f"{len(self.frequencies)} phases in rad, one a frequency, not {len(self.phases)}")
        require(self.fade >= 0, "segment", "fade", f"0 or more 1/s, not {self.fade:g}")

    def demand(self, t: Array, last: float) -> Array:
        lines = len(self.frequencies)
        phases = self.phases or [-np.pi * n * (n - 1) / lines for n in range(1, lines + 1)]
        wave = np.zeros_like(t)
        for frequency, phase in zip(self.frequencies, phases, strict=True):
            wave += sin_of_turns(frequency * t + phase / (2 * np.pi))
        return last + self.amplitude * wave * _fade_in(t, self.fade)


@dataclass(frozen=True, kw_only=True)
class Points(Segment):
    """Straight lines through breakpoints [t, demand], t in s from the segment's start.

    The first line starts from the last demand, unless a breakpoint at t = 0 says where.
    """

    kind = "points"
    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        times = [t for t, _ in self.points]
        require(bool(times) and times[0] >= 0 and all(a < b for a, b in pairwise(times)), "segment", "points",
                 "[t, demand] pairs with t from 0 s and increasing")
        super().__post_init__()

    @property
    def duration(self) -> float:
        return self.points[-1][0]

    def demand(self, t: Array, last: float) -> Array:
        points = self.points if self.points[0][0] == 0 else ((0.0, last), *self.points)
        return np.interp(t, [p[0] for p in points], [p[1] for p in points])


@dataclass(frozen=True, kw_only=True)
class Csv(Segment):
    """A recorded demand, columns t and com (or value). Whoever reads the file fills in `values`, `rate` a second."""

    kind = "csv"
    file: str
    values: tuple[float, ...] = field(default=(0.0,), repr=False, metadata={"key": False})
    rate: float = field(default=RATE, repr=False, metadata={"key": False})

    @property
    def duration(self) -> float:
        return len(self.values) / self.rate

    def demand(self, t: Array, last: float) -> Array:
        return np.take((*self.values, self.values[-1]), np.rint(t * self.rate).astype(int))


KINDS: dict[str, type[Segment]] = {
    kind.kind: kind for kind in (Hold, Step, Ramp, Sine, Chirp, Multisine, Points, Csv)
}


def _fade_in(t: Array, fade: float) -> Array:
    return 1 - exp_of(-fade * t) if fade else np.ones_like(t)


SLACK = 0.01  # of a cycle: a time within it of a row is that row's


class Section(NamedTuple):
    """The cycles of a segment in the command: start <= k < stop."""

    name: str
    kind: str
    start: int
    stop: int


class Profile(NamedTuple):
    """A command, its sections in order, and the demand reached when it ends (where the next phase starts)."""

    command: Array  # shape (cycles,), m
    sections: tuple[Section, ...]
    end: float


def list_section_names(segments: Sequence[Segment]) -> list[str]:
    """Names of the sections of a command: the segment's own, or kind_number with its number from 1."""
    return [segment.name or f"{segment.kind}_{number}" for number, segment in enumerate(segments, 1)]


def build_profile(segments: Sequence[Segment], start: float = 0.0, rate: float = RATE) -> Profile:
    """Lay segments end to end from the demand `start` (m), `rate` values a second.

    No segments: an empty command that ends where it starts.

    Raises:
        InputError: two sections have the same name, or a segment cannot be sampled at this rate.
    """
    pieces: list[Array] = [np.empty(0)]
    sections: list[Section] = []
    last, begin = start, 0
    for segment, name in zip(segments, list_section_names(segments), strict=True):
        segment.require_rate(rate)
        cycles = round(segment.duration * rate)
        demand = segment.demand(np.arange(cycles + 1) / rate, last)
        pieces.append(demand[:-1])
        last = float(demand[-1])
        require(all(name != s.name for s in sections), "segment", "name", f"a name used once, not a second {name!r}")
        sections.append(Section(name, segment.kind, begin, begin + cycles))
        begin += cycles
    return Profile(np.concatenate(pieces), tuple(sections), last)


def resample_on_cycles(t: Array, values: Array, period: float) -> Array:
    """The demand at the start of each cycle, from `values` at the times `t` (s, increasing).

    Rows at that period are taken as they are. Otherwise rows up to 1 ms apart, the usual cycle, are samples that hold
    until the next: a step stays a step. Rows further apart are breakpoints, joined by straight lines. The last row
    lasts as long as the one before it, if these are samples, or one cycle.
    """
    gaps = np.diff(t)
    is_sample = gaps <= (1 + SLACK) / RATE
    tail = gaps[-1] if len(gaps) and is_sample[-1] else period
    cycles = max(1, ceil((t[-1] - t[0] + tail) / period - SLACK))
    grid = t[0] + np.arange(cycles) * period
    row = np.searchsorted(t, grid + SLACK * min(period, 1 / RATE), side="right") - 1
    is_held = np.append(is_sample, True)[row] | (np.abs(grid - t[row]) < SLACK * period)
    return np.asarray(np.where(is_held, values[row], np.interp(grid, t, values)))
