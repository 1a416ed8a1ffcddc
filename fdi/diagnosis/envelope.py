"""The response of a healthy actuator as bands, the limits that Table 2's faults set beyond, and what leaves them.

Filter clogging is judged where the command steps, spool friction where it ramps slowly. A limit is the faulty unit's
own response drawn nearer to the healthy one, by as much as lets nearly every unit with a fault of that size out. What
friction does to a step is allowed for first, by as much friction as the ramps show: both faults delay a step alike.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.thresholds import (
    BAND_EVENT_SAMPLES,
    BAND_FAULT_CLEARANCE_SD,
    BAND_LARGEST_LOAD,
    BAND_NEAREST_LIMIT_SD,
    SAME_COMMAND_POSITION,
    SAME_COMMAND_RATE,
    SAME_COMMAND_TIME,
)
from fdi.trace.sections import Section, sections
from plant.errors import InputError

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

HORIZON = 0.1  # s after a step; later there is only stick-slip, which the ramps show better
FIRST = 0.004  # s; the command has to come through the pilot stage and a cycle of the bus
SETTLED = 0.2  # s from a ramp's start until it is judged
SPAN = 0.02  # s between the two samples of a speed: 2 um of noise become 0.14 mm/s
SCALED = 0.9, 1.3  # a range of friction's error that low or high dynamic friction can account for


class StepBand(NamedTuple):
    """A step's response from FIRST to HORIZON: m over `t` (K,) s since the step."""

    section: int  # number among the command's sections
    t: Floats
    healthy: Floats  # (K,) mean
    shift: Floats  # (F, K) what friction adds, by the amounts of Bands.friction
    spread: Floats  # (F, K) standard deviation of healthy filters, by the same
    middle: Floats  # (K,) what Table 2's lesser clogging adds
    most: Floats  # (K,) and the greater

    def centre(self, friction: float, known: Floats) -> tuple[Floats, Floats]:
        """Mean and standard deviation with so much friction (N) of the amounts `known`, (K,) both."""
        weights = _weights(friction, known)
        return self.healthy + weights @ self.shift, weights @ self.spread


class Width(NamedTuple):
    """How far a signal may be from `centre`, either way."""

    centre: float
    healthy: float
    middle: float  # inf: no limit can be told from healthy
    most: float


class RampBand(NamedTuple):
    """A ramp's following error, m, and speed beyond the demand's, m/s, both positive in the ramp's direction."""

    section: int
    position: Width
    speed: Width
    waver: Floats  # (F,) m, half the range of the error with each amount of Bands.friction
    slip: float  # 1/s, fastest slip over that range where FDS is FSS/1.5
    ease: float  # s, how much of the range is lost where the spool slips faster than that: range ~ FSS (1 - ease slip)

    def scale(self, half: float, fastest: float) -> float:
        """What the error would be times, if dynamic friction were FSS/1.5, from half its range (m) and slips (m/s)."""
        slip = fastest / half if half > 0.0 else self.slip
        return float(np.clip((1 - self.ease * self.slip) / max(1 - self.ease * slip, 0.1), *SCALED))

    def sliding(self, half: float, fastest: float) -> float:
        """What 1.5 FDS is of FSS: a slip is as fast as both differ, which is by FSS/3 where it is `slip`."""
        own = fastest / (self.scale(half, fastest) * half) if half > 0.0 else self.slip
        return float(np.clip(1.5 * (1 - own / (3 * self.slip)), 0.0, 1.5)) if self.slip > 0.0 else 1.0


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands of one command."""

    sections: tuple[Section, ...]  # of the command, rows of `period`
    period: float  # s
    friction: Floats  # (F,) N, increasing, the healthy amount first
    steps: tuple[StepBand, ...]
    ramps: tuple[RampBand, ...]
    middle_share: float  # of StepBand.middle at which MidBand stands
    most_share: float
    provenance: Mapping[str, str] = field(default_factory=dict)
    precursors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # healthy scatter, sensitivities

    @property
    def judges(self) -> tuple[bool, bool]:
        """Whether clogging, and whether friction, can be seen with this command."""
        return (any(self.margins(s, s.spread[0])[2].any() for s in self.steps),
                any(np.isfinite(r.position.middle) for r in self.ramps))

    def margins(self, step: StepBand, spread: Floats) -> tuple[Floats, Floats, Flags]:
        """Distance of the limits MidBand and MaxBand from the centre, m, and where there are any; (K,) each."""
        least = BAND_NEAREST_LIMIT_SD * spread
        judged = np.abs(step.middle) > BAND_FAULT_CLEARANCE_SD * spread
        middle = np.maximum(self.middle_share * np.abs(step.middle), least)
        return middle, np.maximum(self.most_share * np.abs(step.most), middle), judged


class Stay(NamedTuple):
    """Rows first..last (inclusive) beyond a limit."""

    first: int
    last: int


def stays(beyond: Flags, lasting: int = BAND_EVENT_SAMPLES) -> list[Stay]:
    """Where a flag (n,) is up for `lasting` rows in a row, until it is down for as many.

    A single spike, or two, is no event; a single sample back inside does not end one.
    """
    edges = np.flatnonzero(np.diff(beyond.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    runs = [Stay(int(a), int(b) - 1) for a, b in edges]
    joined: list[list[Stay]] = []
    for run in runs:
        if joined and run.first - joined[-1][-1].last <= lasting:
            joined[-1].append(run)
        else:
            joined.append([run])
    found = []
    for group in joined:
        lasting_ones = [run for run in group if run.last - run.first + 1 >= lasting]
        if lasting_ones:
            found.append(Stay(lasting_ones[0].first, group[-1].last))
    return found


def lasting_most(x: Floats, lasting: int = BAND_EVENT_SAMPLES) -> Floats:
    """The highest level that x (.., n), time last, keeps for `lasting` rows in a row; NaN is below all."""
    known = np.where(np.isnan(x), -np.inf, x)
    windows = np.lib.stride_tricks.sliding_window_view(known, lasting, axis=-1)
    out: Floats = windows.min(axis=-1).max(axis=-1)
    return out


def speed(x: Floats, period: float) -> Floats:
    """Speed of a position (.., n) m, time last, m/s: difference over SPAN; NaN at the ends and beside missing samples.

    A spike of one sample becomes two of one sample each, so it does not last either.
    """
    half = max(1, round(SPAN / period / 2))
    out = np.full(np.shape(x), np.nan)
    out[..., half:-half] = (x[..., 2 * half:] - x[..., :-2 * half]) / (2 * half * period)
    return out


def _weights(friction: float, known: Floats) -> Floats:
    """Of linear interpolation at `friction` between the amounts `known`, the ends held; (F,)."""
    return np.array([np.interp(friction, known, row) for row in np.eye(len(known))])


def waver(error: Floats) -> Floats:
    """Half the range of a following error (.., n), time last, from 1st to 99th percentile, m (docs/physics.md)."""
    low, high = np.nanpercentile(error, (1, 99), axis=-1)
    half: Floats = (high - low) / 2
    return half


def judged_rows(s: Section, period: float) -> slice:
    """The rows of a ramp that are judged."""
    return slice(s.start + round(SETTLED / period), s.stop)


def check_command(bands: Bands, found: Sequence[Section], period: float, where: object) -> None:
    """Refuse bands of another command.

    Raises:
        InputError: what differs first.
    """
    mine, theirs = _outline(bands.sections, bands.period), _outline(found, period)
    if len(mine) != len(theirs):
        raise InputError(where, "com", f"the command of the bands, {_told(bands)}; this one has {len(theirs)} "
                                       f"sections (rig fdi --learn-bands makes bands of it)")
    for a, b in zip(mine, theirs, strict=True):
        near = (abs(a.start - b.start) < SAME_COMMAND_TIME and abs(a.first - b.first) < SAME_COMMAND_POSITION
                and abs(a.last - b.last) < SAME_COMMAND_POSITION
                and abs(a.rate - b.rate) <= SAME_COMMAND_RATE * abs(a.rate) + 1e-6)
        if a.kind != b.kind or not near:
            raise InputError(where, "com", f"the command of the bands, {_told(bands)}; at {b.start:.3g} s it differs "
                                           f"(rig fdi --learn-bands makes bands of it)")


def loaded(load: Floats) -> bool:
    """Whether a known load, (n,) N, moves the ram by more than can be seen."""
    return bool((np.abs(np.nan_to_num(load)) > BAND_LARGEST_LOAD).any())


def matches(bands: Bands, com: Floats, period: float) -> bool:
    """Whether the bands are of this command, (n,) m."""
    try:
        check_command(bands, sections(com, period), period, "")
    except InputError:
        return False
    return True


class _Outline(NamedTuple):
    kind: str
    start: float  # s from the first change of the command
    first: float
    last: float
    rate: float


def _outline(parts: Sequence[Section], period: float) -> list[_Outline]:
    """The steps and ramps: how long a test rests before and after does not matter."""
    chosen = [s for s in parts if s.kind in ("step", "ramp")]
    begin = chosen[0].start if chosen else 0
    return [_Outline(s.kind, (s.start - begin) * period, s.first, s.last, s.rate) for s in chosen]


def _told(bands: Bands) -> str:
    kinds = [s.kind for s in bands.sections]
    name = bands.provenance.get("command", "")
    return f"{name} ({kinds.count('step')} steps, {kinds.count('ramp')} ramps)".strip()


