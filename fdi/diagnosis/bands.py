"""Bands around a healthy response: the verdict on a trace that is judged by them, precursors, and how bands are made.

Filter clogging is judged where the command steps, spool friction where it ramps slowly. A limit is the mean response of
faulty units moved towards the healthy one until nearly every unit with a fault of that size is beyond it. Friction
delays a step as clogging does, so the friction that the ramps show is allowed for before a step is judged.

Precursors are single numbers of a response that a fault changes, each beside its scatter over healthy units. The mean
error on a slow ramp is the classic sign of friction, but it does not depend on friction while the ram slides
(docs/physics.md); the signal-to-noise ratios show which precursors are worth looking at. Each precursor is a mean over
the sections of its kind. Noise of the position decides none of them: peaks are taken from running medians, ranges are
between percentiles, and a reversal counts when it passes a quarter of the usual range.

Bands are made by simulating units of a model on a command, or from a fleet's own healthy traces.
"""
from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Level
from fdi.estimation.fit import limit_dynamic_friction, list_tolerance_sizes
from fdi.output import require_writable, write_text
from fdi.progress import Progress, ignore_progress
from fdi.sources import name_software
from fdi.thresholds import (
    BAND_EVENT_SAMPLES,
    BAND_FAULT_CLEARANCE_SD,
    BAND_LARGEST_LOAD,
    BAND_NEAREST_LIMIT_SD,
    BAND_UNITS,
    BAND_UNITS_QUICK,
    FAST_SLIP_RATIO,
    FLEET_FEWEST_TRACES,
    FLEET_PRIOR_TRACES,
    FRICTION_HIDES_CLOGGING_RATIO,
    POSITION_MISSING_SHARE,
    RAMP_FAULT_MISSED_SHARE,
    RAMP_HEALTHY_SHARE,
    SAME_COMMAND_POSITION,
    SAME_COMMAND_RATE,
    SAME_COMMAND_TIME,
    SECTION_MEASURED_SHARE,
    STEP_FAULT_LEAVES_SD,
)
from fdi.trace.sections import Section, describe_section, find_sections
from fdi.trace.trace import Flags, Floats, Trace, hold_last
from plant.errors import InputError
from plant.lanes import NARROW, Lanes
from plant.model import Model, load_model
from plant.parameters import parse_toml
from plant.threads import count_threads

DYNAMIC = "spool.dynamic_friction"  # FDS, which follows FSS
STATIC_OVER_DYNAMIC = 1.0 / FRICTION.follow[DYNAMIC]
STEP_JUDGED_FROM = 0.004  # s; the command has to come through a cycle of the bus and the pilot stage
STEP_JUDGED_UNTIL = 0.1  # s after a step; later there is only stick-slip, which the ramps show better
LEVELS = {"middle": Level.MAINTENANCE, "most": Level.NON_NOMINAL}  # of a signal that has left this band


# ---------------------------------------------------------------------------------------------------------------------
# Bands of one command
# ---------------------------------------------------------------------------------------------------------------------

class StepBand(NamedTuple):
    """A step's response from STEP_JUDGED_FROM to STEP_JUDGED_UNTIL: m over `t` (K,) s since the step."""

    section: int  # number among the command's sections
    t: Floats
    healthy: Floats  # (K,) mean
    shift: Floats  # (F, K) what friction adds, by the amounts of Bands.friction
    spread: Floats  # (F, K) standard deviation of healthy filters, by the same amounts
    middle: Floats  # (K,) what Table 2's lesser clogging adds
    most: Floats  # (K,) what the greater clogging adds

    def compute_centre(self, friction: float, known: Floats) -> tuple[Floats, Floats]:
        """Mean and standard deviation, (K,) each, with `friction` N, between the amounts `known` (F,) N."""
        weights = np.array([np.interp(friction, known, row) for row in np.eye(len(known))])
        return self.healthy + weights @ self.shift, weights @ self.spread


class Width(NamedTuple):
    """How far a signal may be from `compute_centre`, either way."""

    centre: float
    healthy: float
    middle: float  # inf: the fault cannot be told from healthy units
    most: float


class RampBand(NamedTuple):
    """A ramp's following error, m, and speed beyond the demand's, m/s, both positive in the ramp's direction."""

    section: int
    position: Width
    speed: Width
    half_range: Floats  # (F,) m, half the range of the error with each amount of Bands.friction
    slip: float  # 1/s, fastest slip over that half range where FDS is FSS/1.5
    ease: float  # s, how much of the range is lost where the spool slips faster: range ~ FSS (1 - ease slip)

    def compute_scale(self, half: float, fastest: float) -> float:
        """Factor on the error that makes it the error with FDS = FSS/1.5.

        Args:
            half: half the range of the error, m.
            fastest: fastest lasting slip, m/s.
        """
        slip = fastest / half if half > 0.0 else self.slip
        factor = (1 - self.ease * self.slip) / max(1 - self.ease * slip, 0.1)
        return float(np.clip(factor, 0.9, 1.3))  # what low and high dynamic friction account for

    def estimate_friction_ratio(self, half: float, fastest: float) -> float:
        """1.5 FDS over FSS: the speed of a slip goes with FSS - FDS, which is FSS/3 where it is `slip`."""
        if self.slip <= 0.0:
            return 1.0
        own = fastest / (self.compute_scale(half, fastest) * half) if half > 0.0 else self.slip
        return float(np.clip(STATIC_OVER_DYNAMIC * (1 - own / (3 * self.slip)), 0.0, STATIC_OVER_DYNAMIC))


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands of one command."""

    sections: tuple[Section, ...]  # of the command, rows of `period`
    period: float  # s
    friction: Floats  # (F,) N, increasing, the healthy amount first
    steps: tuple[StepBand, ...]
    ramps: tuple[RampBand, ...]
    middle_share: float  # of StepBand.middle, where the limit of MidBand is
    most_share: float  # of StepBand.most, where the limit of MaxBand is
    provenance: Mapping[str, str] = field(default_factory=dict)
    precursors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # healthy scatter, sensitivities

    @property
    def judges(self) -> tuple[bool, bool]:
        """Whether this command shows clogging, and whether it shows friction."""
        return (any(self.compute_margins(s, s.spread[0])[2].any() for s in self.steps),
                any(np.isfinite(r.position.middle) for r in self.ramps))

    def compute_margins(self, step: StepBand, spread: Floats) -> tuple[Floats, Floats, Flags]:
        """Distances of the limits MidBand and MaxBand from the centre, m, and where the step is judged; (K,) each."""
        judged = np.abs(step.middle) > BAND_FAULT_CLEARANCE_SD * spread
        middle = np.maximum(self.middle_share * np.abs(step.middle), BAND_NEAREST_LIMIT_SD * spread)
        return middle, np.maximum(self.most_share * np.abs(step.most), middle), judged


# ---------------------------------------------------------------------------------------------------------------------
# What is measured on a response
# ---------------------------------------------------------------------------------------------------------------------

def find_stays(beyond: Flags, lasting: int = BAND_EVENT_SAMPLES) -> list[tuple[int, int]]:
    """Where a flag (n,) is up for `lasting` rows in a row, until it is down for as many: first and last row of each.

    One or two samples are no event; a single sample back inside does not end one.
    """
    edges = np.flatnonzero(np.diff(beyond.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    found: list[tuple[int, int]] = []
    for first, stop in edges.tolist():
        if found and first - found[-1][1] <= lasting:
            found[-1] = (found[-1][0], stop - 1)
        elif stop - first >= lasting:
            found.append((first, stop - 1))
    return found


def find_lasting_peak(x: Floats, lasting: int = BAND_EVENT_SAMPLES) -> Floats:
    """The highest level that x (.., n), time last, keeps for `lasting` rows in a row; NaN is below all levels."""
    known = np.where(np.isnan(x), -np.inf, x)
    windows = np.lib.stride_tricks.sliding_window_view(known, lasting, axis=-1)
    out: Floats = windows.min(axis=-1).max(axis=-1)
    return out


def compute_speed(x: Floats, period: float, span: float = 0.02) -> Floats:
    """Speed, m/s, of a position (.., n) m, time last: difference over `span` s; NaN at the ends and beside gaps.

    Over 20 ms, 2 um of noise become 0.14 mm/s. A spike of one sample becomes two of one sample each, so it does not
    last either.
    """
    half = max(1, round(span / period / 2))
    out = np.full(np.shape(x), np.nan)
    out[..., half:-half] = (x[..., 2 * half:] - x[..., :-2 * half]) / (2 * half * period)
    return out


def compute_half_range(error: Floats) -> Floats:
    """Half the range of a following error (.., n) m, time last, from its 1st to its 99th percentile."""
    low, high = np.nanpercentile(error, (1, 99), axis=-1)
    half: Floats = (high - low) / 2
    return half


def select_ramp_rows(s: Section, period: float, settling: float = 0.2) -> slice:
    """The rows of a ramp that are judged: from `settling` s after its start, when the ram follows."""
    return slice(s.start + round(settling / period), s.stop)


# ---------------------------------------------------------------------------------------------------------------------
# Which bands a trace is judged by
# ---------------------------------------------------------------------------------------------------------------------

def require_same_command(bands: Bands, found: Sequence[Section], period: float, where: object) -> None:
    """Refuse bands of another command.

    Raises:
        InputError: the first difference.
    """
    difference = find_difference(bands, found, period)
    if difference:
        kinds = [s.kind for s in bands.sections]
        name = " ".join([bands.provenance.get("command", ""), f"({kinds.count('step')} steps,"]).strip()
        raise InputError(where, "com", f"the command of the bands, {name} {kinds.count('ramp')} ramps); {difference} "
                                       "(rig fdi --learn-bands makes bands of it)")


def find_difference(bands: Bands, found: Sequence[Section], period: float) -> str:
    """The first difference between a command's sections and those of the bands, in words; "" if it is the same command.

    How long a test rests before and after its steps and ramps does not matter.
    """
    mine, theirs = ([s for s in parts if s.kind in ("step", "ramp")] for parts in (bands.sections, found))
    if len(mine) != len(theirs):
        return f"this one has {len(theirs)} sections"
    for a, b in zip(mine, theirs, strict=True):
        start = (b.start - theirs[0].start) * period
        near = (abs((a.start - mine[0].start) * bands.period - start) < SAME_COMMAND_TIME
                and abs(a.first - b.first) < SAME_COMMAND_POSITION and abs(a.last - b.last) < SAME_COMMAND_POSITION
                and abs(a.rate - b.rate) <= SAME_COMMAND_RATE * abs(a.rate) + 1e-6)
        if a.kind != b.kind or not near:
            return f"at {start:.3g} s it differs"
    return ""


def matches_command(bands: Bands, com: Floats, period: float) -> bool:
    """Whether the bands are of this command, (n,) m."""
    return not find_difference(bands, find_sections(com, period), period)


def is_loaded(load: Floats) -> bool:
    """Whether a known load, (n,) N, moves the ram by more than can be seen."""
    return bool((np.abs(np.nan_to_num(load)) > BAND_LARGEST_LOAD).any())


def is_nominal_plant(model: Model) -> bool:
    """Whether a healthy unit of the model is a nominal one; its two faults and its noise do not count."""
    return model.plant == "eha" and not list_design(model)


def list_design(model: Model) -> dict[str, float]:
    """The parameters in which a healthy unit of the model differs from a nominal one, SI: not the two faults and noise.
    """
    faults = {CLOGGING.parameter, FRICTION.parameter, DYNAMIC}
    return {name: value for name, value in sorted(model.list_changes().items())
            if name not in faults and not name.startswith("sensors.")}


def format_design(model: Model) -> str:
    """`list_design` as the text that bands remember their model by."""
    return json.dumps(list_design(model))


def describe_other_model(bands: Bands, model: Model) -> str:
    """Which model bands were made for, if it is another than `model`; else ""."""
    name = bands.provenance.get("model", "eha")
    known = bands.provenance.get("parameters")
    if known is None:  # bands of an earlier version say the name alone
        return f"the model {name}" if name != model.name else ""
    if known == format_design(model):
        return ""
    design = known.strip("{}").replace('"', "").replace(":", " =") or "all parameters nominal"
    return f"the model {name} with {design}"


# ---------------------------------------------------------------------------------------------------------------------
# The verdict
# ---------------------------------------------------------------------------------------------------------------------

class Event(NamedTuple):
    """A stay outside a band."""

    band: str  # "middle" | "most"
    signal: str  # "position" | "speed"
    section: str  # of the command, as fdi.trace.sections names it
    t_in: float  # s
    t_out: float  # s
    excess: float  # furthest beyond the band, m or m/s


class BandVerdict(NamedTuple):
    """What the bands say. A fault whose sections the command lacks, or the trace lost, has no level."""

    levels: Mapping[str, Level]  # by the effect's name
    ruling: str | None  # the more severe fault; None if both are acceptable
    events: tuple[Event, ...]  # in order of time
    severity: Mapping[str, float]  # furthest lasting excursion, in MidBand limits; above 1 is an event
    friction: float  # N, what the ramps show: FSS / (1 - Kintas)
    notes: tuple[str, ...]


def judge_trace(source: Trace, bands: Bands, where: object = "trace") -> BandVerdict:
    """Judge a trace; rows that its preparation found unusable are left out.

    Raises:
        InputError: no position, or bands of another command or load.
    """
    com, xj, load, period, t0 = read_columns(source)
    return judge_position(com, xj, period, bands, load, t0, where)


def read_columns(source: Trace) -> tuple[Floats, Floats, Floats, float, float]:
    """Command without holes, position with NaN where it cannot be used, load, period and first time of a trace."""
    position = source.mask_unusable(source.declared.controlled.name)
    return hold_last(source.command), position, source.load, source.period, float(source.t[0])


def judge_position(com: Floats, xj: Floats, period: float, bands: Bands, load: Floats | None = None, t0: float = 0.0,
                   where: object = "trace", parts: list[Section] | None = None) -> BandVerdict:
    """Judge a command and sensed position, (n,) m, NaN where missing, one row per `period` s from `t0` s.

    `parts` are the command's sections, for callers that judge many runs of one command.

    Raises:
        InputError: no position, bands of another command, or a load that the bands do not know.
    """
    if np.isnan(xj).all():
        raise InputError(where, "xj", "a measured position: bands judge nothing else")
    parts = parts or find_sections(com, period)
    require_same_command(bands, parts, period, where)
    if load is not None and is_loaded(load) and "load" not in bands.provenance:
        most = float(np.nanmax(np.abs(load)))
        raise InputError(where, "load", f"none, as these bands are of an unloaded ram, not {most:.3g} N")
    found, friction, notes = find_excursions(com, xj, period, bands, parts)
    levels, severity, events = {}, {}, {i: _find_events(e, t0, period) for i, e in enumerate(found)}
    for fault in FAULTS:
        own = [i for i, e in enumerate(found) if e.fault == fault.name and e.signal == "position" and e.is_judged]
        if own:
            severity[fault.name] = max(0.0, *(found[i].measure_peak() for i in own))
            levels[fault.name] = max((LEVELS[event.band] for i in own for event in events[i]), default=Level.ACCEPTABLE)
        else:
            reason = _explain_no_level(fault.name, found, friction, bands)
            notes.append(f"{fault.name} is not judged by bands: {reason}")
    slip = max((e.measure_peak() for e in found if e.signal == "speed"), default=0.0)
    if FRICTION.name in levels and slip > FAST_SLIP_RATIO * max(1.0, severity[FRICTION.name]):
        notes.append("the spool slips faster than its static friction accounts for: its dynamic friction is low")
    gone = {f: (levels[f], severity[f]) for f in levels if levels[f] > Level.ACCEPTABLE}
    ruling = max(gone, key=lambda f: gone[f]) if gone else None
    every = sorted(chain.from_iterable(events.values()), key=lambda event: event.t_in)
    return BandVerdict(levels, ruling, tuple(every), severity, friction, tuple(notes))


def _explain_no_level(fault: str, found: list[Excursion], friction: float, bands: Bands) -> str:
    if not any(e.fault == fault and e.signal == "position" for e in found):
        return "no section of the trace shows it"
    if fault == CLOGGING.name and friction > FRICTION_HIDES_CLOGGING_RATIO * float(bands.friction[0]):
        return f"{friction:.0f} N of friction hide it"
    return "Table 2's fault is within the scatter of healthy units"


# ---------------------------------------------------------------------------------------------------------------------
# Excursions: how far each judged signal is from its centre
# ---------------------------------------------------------------------------------------------------------------------

class Excursion(NamedTuple):
    """Departure of one signal of one section from its centre, with its limits; (n,) each, rows from `start`."""

    signal: str  # "position" | "speed"
    section: Section
    start: int
    departure: Floats  # from the centre, m or m/s, positive towards the fault; NaN where it is not judged
    middle: Floats
    most: Floats
    fault: str

    @property
    def is_judged(self) -> bool:
        """Whether a limit applies to known samples for as long as an event lasts."""
        limited = np.isfinite(self.departure) & np.isfinite(self.middle)
        return bool(find_lasting_peak(limited.astype(float)) > 0.0)

    def measure_peak(self) -> float:
        """The furthest lasting departure, in limits of MidBand."""
        return float(find_lasting_peak(self.departure / self.middle))


def find_excursions(com: Floats, xj: Floats, period: float, bands: Bands, parts: list[Section]
                    ) -> tuple[list[Excursion], float, list[str]]:
    """Every judged signal of every judged section, the friction that the ramps show (N), and notes on omissions."""
    own = [s for s in parts if s.kind in ("step", "ramp")]
    known = [i for i, s in enumerate(bands.sections) if s.kind in ("step", "ramp")]
    place = dict(zip(known, own, strict=True))
    notes: list[str] = []
    out: list[Excursion] = []
    shown = []
    velocity = compute_speed(xj, period)
    for ramp in bands.ramps:
        s, rows = place[ramp.section], select_ramp_rows(place[ramp.section], period)
        error = np.sign(s.rate) * (com[rows] - xj[rows])
        if _is_lost(error, s, notes):
            continue
        beyond = np.sign(s.rate) * velocity[rows] - abs(s.rate)
        half = float(compute_half_range(error))
        fastest = float(find_lasting_peak(beyond))
        scale = ramp.compute_scale(half, fastest)
        amount = float(np.interp(scale * half, ramp.half_range, bands.friction))
        shown.append((amount, amount * ramp.estimate_friction_ratio(half, fastest)))
        for signal, x, width in (("position", scale * (error - ramp.position.centre), ramp.position),
                                 ("speed", beyond - ramp.speed.centre, ramp.speed)):
            middle, most = (np.full(len(x), limit) for limit in (width.middle, width.most))
            out.append(Excursion(signal, s, rows.start, np.abs(x), middle, most, FRICTION.name))
    least = float(bands.friction[0])
    friction, sliding = np.mean(shown, axis=0).tolist() if shown else (least, least)
    if bands.ramps and not shown:
        notes.append("steps are judged as if the spool had healthy friction: no ramp shows how much there is")
    for step in bands.steps:
        made = _make_step_excursion(xj, period, bands, step, place[step.section], (friction, sliding))
        if not _is_lost(xj[made.start:made.start + len(made.departure)], made.section, notes):
            out.append(made)
    return out, friction, notes


def _is_lost(x: Floats, s: Section, notes: list[str]) -> bool:
    """Whether too much of a section is missing to judge it; if so, with a note."""
    lost = float(np.isnan(x).mean()) if len(x) else 1.0
    too_much = lost > 1.0 - SECTION_MEASURED_SHARE
    if too_much:
        notes.append(f"{describe_section(s)} is not judged: {100 * lost:.0f} % of its position is missing")
    return too_much


def _make_step_excursion(xj: Floats, period: float, bands: Bands, step: StepBand, s: Section,
                         amounts: tuple[float, float]) -> Excursion:
    """Departure towards clogging; NaN on rows without a limit.

    A step is delayed by the sliding friction (FDS) and scatters with the static one (FSS). So both amounts of friction
    are allowed for, and the smaller departure counts.
    """
    first, stop = round(step.t[0] / period), round(step.t[-1] / period) + 1
    rows = np.arange(first, min(stop, s.stop - s.start))
    at = rows * period
    towards = np.sign(np.interp(at, step.t, step.middle))
    centres, spreads = zip(*(step.compute_centre(amount, bands.friction) for amount in amounts), strict=True)
    middle, most, judged = bands.compute_margins(step, np.max(spreads, axis=0))
    x = np.min([towards * (xj[s.start + rows] - np.interp(at, step.t, centre)) for centre in centres], axis=0)
    x = np.where(np.interp(at, step.t, judged.astype(float)) > 0.99, x, np.nan)
    return Excursion("position", s, s.start + first, x, np.interp(at, step.t, middle), np.interp(at, step.t, most),
                     CLOGGING.name)


def _find_events(e: Excursion, t0: float, period: float) -> list[Event]:
    out = []
    for band, limit in (("middle", e.middle), ("most", e.most)):
        with np.errstate(invalid="ignore"):
            beyond = e.departure > limit
        for first, last in find_stays(beyond):
            excess = float(np.nanmax((e.departure - limit)[first:last + 1]))
            begin, end = (t0 + (e.start + row) * period for row in (first, last + 1))
            out.append(Event(band, e.signal, describe_section(e.section), begin, end, excess))
    return out


DEFAULT = "preflight_bands.toml"
UM_PER_M, MS_PER_S, MM_PER_M = 1e6, 1e3, 1e3
KNOT_CYCLES = 2  # between the times at which shifts and spreads of a step are known
BARE = re.compile(r"[A-Za-z0-9_-]+")  # a key that TOML takes without quotes
STEP_LISTS = (("healthy", "healthy_um", 1), ("shift", "friction_um", 1), ("spread", "spread_um", 2),
              ("middle", "middle_um", 1), ("most", "most_um", 1))  # field of StepBand, key in the file, decimals
HEADER = """\
# Bands of a command, as `rig fdi --learn-bands` writes them; `rig fdi TRACE --bands FILE` judges by them.
# [[step]]: the mean response of healthy units, a number a cycle from {first:g} ms on; every {coarse} cycles what each
# amount of friction adds, the standard deviation at each, and what Table 2's clogging adds: MidBand stands at
# middle_share of middle_um, MaxBand at most_share of most_um. [[ramp]]: how far following error and speed may be from
# their centre; half the range of the error by friction; slip over it, 1/s, and how much range faster slips cost, s.
# [precursors]: mean and scatter of healthy units; what Kintas 0.25 and FSS 35 N add; SI units and %.
"""


@cache
def load_default_bands() -> Bands:
    """The bands of the preflight command and the nominal plant that come with the software."""
    return parse_bands((files("fdi.diagnosis") / DEFAULT).read_text(encoding="utf-8"), DEFAULT)


def load_bands(path: str | Path) -> Bands:
    """Bands from a file.

    Raises:
        InputError: a file that cannot be read, or that holds no bands.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text in UTF-8"
        raise InputError(path, "--bands", f"a readable file of bands ({reason})") from error
    return parse_bands(text, path)


def format_bands(bands: Bands) -> str:
    """Bands as TOML."""
    lines = [HEADER.format(first=MS_PER_S * STEP_JUDGED_FROM, coarse=KNOT_CYCLES), "[bands]",
             f"period_ms = {bands.period * MS_PER_S:g}", f"friction_N = {_format_list(bands.friction, 2)}",
             f"middle_share = {bands.middle_share:.4f}", f"most_share = {bands.most_share:.4f}", "", "[provenance]",
             *(f"{key} = {json.dumps(value)}" for key, value in bands.provenance.items()), "",
             "# kind, rows from and to, demand before and at the end in um, rate in um/s", "sections = ["]
    for s in bands.sections:
        numbers = _round_values((s.first * UM_PER_M, s.last * UM_PER_M, s.rate * UM_PER_M), 2)
        lines.append(f"  {json.dumps([s.kind, s.start, s.stop, *numbers])},")
    lines.append("]")
    for step in bands.steps:
        lines += ["", "[[step]]", f"section = {step.section}"]
        for field_name, key, places in STEP_LISTS:
            values = getattr(step, field_name)[..., ::1 if field_name == "healthy" else KNOT_CYCLES] * UM_PER_M
            if values.ndim == 1:
                lines.append(f"{key} = {_format_list(values, places)}")
            else:
                lines += [f"{key} = [", *(f"  {_format_list(row, places)}," for row in values), "]"]
    for ramp in bands.ramps:
        lines += ["", "[[ramp]]", f"section = {ramp.section}",
                  f"position_um = {_format_width(ramp.position, UM_PER_M)}",
                  f"speed_mm_s = {_format_width(ramp.speed, MM_PER_M)}",
                  f"waver_um = {_format_list(ramp.half_range * UM_PER_M, 2)}",
                  f"slip = {ramp.slip:.4g}", f"ease = {ramp.ease:.4g}"]
    lines += ["", "[precursors]"]
    for name, numbers_of in bands.precursors.items():
        pairs = ", ".join(f"{key} = {_format_number(value)}" for key, value in numbers_of.items())
        lines.append(f"{name if BARE.fullmatch(name) else json.dumps(name)} = {{ {pairs} }}")
    return "\n".join(lines) + "\n"


def parse_bands(content: str, where: object) -> Bands:
    """Bands from TOML.

    Raises:
        InputError: text that is not TOML, or lacks a key.
    """
    table = parse_toml(content, where)
    try:
        return _read_bands(table)
    except KeyError as error:
        raise InputError(where, str(error.args[0]), "a file of bands, which has this key") from error
    except (TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        raise InputError(where, "", f"a file of bands as rig fdi --learn-bands writes it ({error})") from error


def _read_bands(table: Mapping[str, Any]) -> Bands:
    head = table["bands"]
    period = float(head["period_ms"]) / MS_PER_S
    provenance = dict(table["provenance"])
    parts = tuple(Section(kind, int(a), int(b), first / UM_PER_M, last / UM_PER_M, rate / UM_PER_M)
                  for kind, a, b, first, last, rate in provenance.pop("sections"))
    friction = np.array(head["friction_N"], float)
    if not (np.diff(friction) > 0.0).all():
        raise ValueError("friction_N: rising values")
    kinds = {kind: [i for i, part in enumerate(parts) if part.kind == kind] for kind in ("step", "ramp")}
    steps = tuple(_read_step(step, period, len(friction), kinds["step"]) for step in table.get("step", ()))
    ramps = tuple(_read_ramp(ramp, len(friction), kinds["ramp"]) for ramp in table.get("ramp", ()))
    return Bands(parts, period, friction, steps, ramps, float(head["middle_share"]), float(head["most_share"]),
                 {key: str(value) for key, value in provenance.items()},
                 {name: {key: float(value) for key, value in numbers.items()}
                  for name, numbers in table.get("precursors", {}).items()})


def _read_step(step: Mapping[str, Any], period: float, amounts: int, parts: Container[int]) -> StepBand:
    lists = {name: np.array(step[key], float) / UM_PER_M for name, key, _ in STEP_LISTS}
    healthy = lists.pop("healthy")
    rows = np.arange(len(healthy))
    coarse = rows[::KNOT_CYCLES]
    shapes = {"spread": (amounts, len(coarse)), "shift": (amounts, len(coarse)), "middle": coarse.shape,
              "most": coarse.shape}
    if {name: values.shape for name, values in lists.items()} != shapes or step["section"] not in parts:
        raise ValueError(f"step of section {step['section']}: not a step of the command, or lists of other lengths")
    fine = {name: np.apply_along_axis(lambda knots: np.interp(rows, coarse, knots), -1, values)
            for name, values in lists.items()}
    t = (rows + round(STEP_JUDGED_FROM / period)).astype(float)
    return StepBand(int(step["section"]), t * period, healthy, **fine)


def _read_ramp(ramp: Mapping[str, Any], amounts: int, parts: Container[int]) -> RampBand:
    half_range = np.array(ramp["waver_um"], float) / UM_PER_M
    if half_range.shape != (amounts,) or ramp["section"] not in parts:
        raise ValueError(f"ramp of section {ramp['section']}: not a ramp of the command, or lists of other lengths")
    position, speed = (Width(*(float(ramp[key][word]) / scale for word in Width._fields))
                       for key, scale in (("position_um", UM_PER_M), ("speed_mm_s", MM_PER_M)))
    return RampBand(int(ramp["section"]), position, speed, half_range, float(ramp["slip"]), float(ramp["ease"]))


def _round_values(values: Iterable[float], places: int) -> list[float]:
    return [round(float(value), places) + 0.0 for value in values]  # no -0.0


def _format_list(values: Iterable[float], places: int) -> str:
    return json.dumps(_round_values(values, places))


def _format_width(width: Width, scale: float) -> str:
    pairs = ", ".join(f"{word} = {_format_number(value * scale)}" for word, value in width._asdict().items())
    return f"{{ {pairs} }}"


def _format_number(value: float) -> str:
    """A number as TOML writes it, NaN and infinity included."""
    return f"{value:.5g}" if math.isfinite(value) else str(value)


def make_bands_file(sources: Sequence[str | Path], out: str | Path, model: Model | None = None,
                    com: Floats | None = None, name: str = "", seed: int = 0, progress: Progress = ignore_progress
                    ) -> dict[str, Any]:
    """Bands from the traces `sources`, or without any by simulation over the command `com` (n,) m; written to `out`.

    Returns what was made, for --json.

    Raises:
        InputError: traces that cannot be learned from, or a place that cannot be written.
    """
    place = require_writable(out, "--out")
    if sources:
        traces = []
        for done, source in enumerate(sources):
            progress("reading", done / len(sources))
            traces.append(Trace.read(source, signals=(model or load_model()).kind.signals))
        bands = learn_bands(traces, model, [str(source) for source in sources], progress)
    elif com is None:
        raise InputError("--learn-bands", "", "traces, or a command to simulate")
    else:
        model = model or load_model()
        bands = make_bands_by_simulation(model, com, np.zeros_like(com), model["controller.period"], seed=seed,
                               progress=progress, name=name)
    write_text(place, format_bands(bands))
    judged = [fault.name for fault, is_shown in zip((CLOGGING, FRICTION), bands.judges, strict=True) if is_shown]
    return {"bands": str(out), "judges": judged, "provenance": dict(bands.provenance)}


# ---------------------------------------------------------------------------------------------------------------------
# By simulation
# ---------------------------------------------------------------------------------------------------------------------

def choose_bands(com: Floats, load: Floats, period: float, model: Model | None = None,
                 progress: Progress = ignore_progress) -> Bands:
    """The preflight's own bands if they are of this command, load and model; else bands made for them.

    That takes some seconds: units of the `model` (default: the nominal one) are simulated on this command.

    Args:
        com: demand, (n,) m, without holes.
        load: known load, (n,) N.
        period: of a row, s.
        model: of the healthy unit.
        progress: called with each stage and the share done, 0 to 1.
    """
    if (model is None or is_nominal_plant(model)) and not is_loaded(load):
        own = load_default_bands()
        if matches_command(own, com, period):
            return own
    return make_bands_by_simulation(model or load_model(), com, np.nan_to_num(load), period, *BAND_UNITS_QUICK,
                                    progress=progress)


def make_bands_by_simulation(model: Model, com: Floats, load: Floats, period: float, count: int = BAND_UNITS,
                             faulty: int = BAND_UNITS, seed: int = 0, steps: int = 20,
                             progress: Progress = ignore_progress, name: str = "",
                             frictions: Sequence[float] = (20.0, 50.0, 100.0, 140.0), low_sliding: float = 0.2
                             ) -> Bands:
    """Bands of a command (n,) m with a known load (n,) N, one row per `period` s, by simulating units of a model.

    Args:
        model: the design; its tolerances and sensor noise set the healthy scatter.
        com: command.
        load: known load.
        period: s.
        count: healthy units.
        faulty: units of each fault.
        seed: of the units.
        steps: of the solver in a cycle.
        progress: called with each stage and the share done, 0 to 1.
        name: of the command, for the file.
        frictions: FSS, N, beside Table 2's, at which the effect of friction on steps is found.
        low_sliding: FDS over FSS of units that slip easily.

    Raises:
        InputError: a command without steps and ramps, or a period that is not the model's.
    """
    parts = find_sections(com, period)
    if not any(s.kind in ("step", "ramp") for s in parts):
        raise InputError("trace", "com", "a command with steps or slow ramps: bands are drawn around those")
    if abs(period / model["controller.period"] - 1) > 0.01:
        raise InputError("trace", "t", f"one row per {1e3 * model['controller.period']:g} ms, the model's cycle, for "
                                       f"bands by simulation, not per {1e3 * period:g} ms")
    sound = float(model[FRICTION.parameter])
    known = sorted({*frictions, FRICTION.acceptable, FRICTION.maintenance})
    amounts = [sound, *(size for size in known if size > 1.2 * sound)]

    def draw(kind: UnitKind, number: int = faulty) -> Floats:
        return simulate_units(model, com, load, kind, number, seed, steps, progress)

    healthy = draw(UnitKind("healthy"), count)
    rubbing = [healthy, *(draw(UnitKind(f"{size:g} N", friction=size)) for size in amounts[1:])]
    clogged = [draw(UnitKind(f"Kintas {size:g}", clogging=size))
               for size in (CLOGGING.acceptable, CLOGGING.maintenance)]
    easy = draw(UnitKind("low dynamic friction", friction=FRICTION.acceptable, sliding=low_sliding))
    stepped = tuple(_make_step_band(i, s, period, rubbing, clogged) for i, s in enumerate(parts) if s.kind == "step")
    ramped = tuple(_make_ramp_band(i, s, com, period, [*rubbing, easy], amounts)
                   for i, s in enumerate(parts) if is_slow_ramp(s, period))
    text = ";".join(f"{s.kind},{(s.stop - s.start) * period:.2f},{1e6 * s.first:.0f},{1e6 * s.last:.0f}" for s in parts)
    tables = {"healthy": healthy[:faulty], CLOGGING.name: clogged[0],
              FRICTION.name: rubbing[amounts.index(FRICTION.acceptable)]}
    facts = {"made": "by simulation", "command": name, "model": model.name, "parameters": format_design(model),
             "runs": str(count), "faulty": str(faulty), "seed": str(seed),
             "command_hash": hashlib.sha256(text.encode()).hexdigest()[:16], "software": name_software()}
    if np.abs(load).max() > 0.0:
        facts["load"] = f"up to {np.abs(load).max():.4g} N"
    bands = Bands(tuple(parts), period, np.array(amounts), stepped, ramped, 1.0, 1.0, facts,
                  _measure_sensitivities(tables, healthy, com, period, parts))
    middle_share, most_share = (_find_limit_share(bands, com, x, is_most)
                                for x, is_most in zip(clogged, (False, True), strict=True))
    return replace(bands, middle_share=middle_share, most_share=most_share)


def _make_step_band(number: int, s: Section, period: float, rubbing: Sequence[Floats], clogged: Sequence[Floats]
                    ) -> StepBand:
    """The band of a step from units with rising friction, the healthy ones first, and units with rising clogging.

    Shifts and spreads are taken at knots that are KNOT_CYCLES apart, with straight lines between them.
    """
    first, stop = round(STEP_JUDGED_FROM / period), min(round(STEP_JUDGED_UNTIL / period) + 1, s.stop - s.start)
    fine = np.arange(first, stop)
    knots = np.unique(np.r_[fine[::KNOT_CYCLES], fine[-1:]])

    def interpolate(values: Floats) -> Floats:
        line: Floats = np.interp(fine, knots, values[knots - first])
        return line

    parts = [x[:, s.start + first:s.start + stop] for x in (*rubbing, *clogged)]
    few = len(parts[-1])
    healthy, alike = parts[0].mean(axis=0), parts[0][:few].mean(axis=0)  # a fault's units are the first healthy ones
    shifts = [interpolate(x.mean(axis=0) - alike) for x in parts[1:]]
    known = len(rubbing)
    spread = np.array([interpolate(x.std(axis=0, ddof=1)) for x in parts[:known]])
    shift = np.array([np.zeros(len(fine)), *shifts[:known - 1]])
    return StepBand(number, fine.astype(float) * period, healthy, shift, spread, shifts[-2], shifts[-1])


def _measure_ramp(x: Floats, com: Floats, s: Section, period: float) -> tuple[Floats, Floats]:
    """Following error, m, and speed beyond the demand's, m/s, of runs `x` (m, n) on a ramp, in its direction."""
    rows, way = select_ramp_rows(s, period), np.sign(s.rate)
    return way * (com[rows] - x[:, rows]), way * compute_speed(x, period)[:, rows] - abs(s.rate)


def _make_ramp_band(number: int, s: Section, com: Floats, period: float, rubbing: Sequence[Floats],
                    amounts: Sequence[float]) -> RampBand:
    """The band of a ramp from units with rising friction; the last ones have Table 2's lesser FSS and a low FDS."""
    errors, speeds = zip(*(_measure_ramp(x, com, s, period) for x in rubbing), strict=True)
    lesser, greater = (list(amounts).index(size) for size in (FRICTION.acceptable, FRICTION.maintenance))
    position, velocity = (_make_width(x[0], x[lesser], x[greater]) for x in (errors, speeds))
    half = np.array([np.median(compute_half_range(e)) for e in errors])
    slip, easier = (float(np.median(find_lasting_peak(speeds[i]) / compute_half_range(errors[i])))
                    for i in (lesser, -1))
    lost = 1 - half[-1] / half[lesser]  # range ~ FSS (1 - ease slip), through both
    ease = lost / (easier - (1 - lost) * slip) if easier > slip and lost > 0.0 else 0.0
    return RampBand(number, position, velocity, np.maximum.accumulate(half[:-1]), slip, float(ease))


def _make_width(healthy: Floats, middle: Floats, most: Floats) -> Width:
    """Limits that all but RAMP_FAULT_MISSED_SHARE of the faulty units leave, from runs (units, rows) each.

    A limit that is not clear of the healthy units is infinite.
    """
    centre = float(np.nanmean(healthy))
    usual, lesser, greater = (find_lasting_peak(np.abs(x - centre)) for x in (healthy, middle, most))
    clear = float(usual.mean() + BAND_FAULT_CLEARANCE_SD * usual.std(ddof=1))
    limits = [float(np.quantile(x, RAMP_FAULT_MISSED_SHARE)) for x in (lesser, greater)]
    wide = [limit if limit > clear else np.inf for limit in limits]
    return Width(centre, float(np.quantile(usual, RAMP_HEALTHY_SHARE)), wide[0], max(wide))


def _find_limit_share(bands: Bands, com: Floats, units: Floats, is_most: bool) -> float:
    """The share of the faulty shift that nearly every faulty unit (m, n) shows, for three samples in a row.

    From the mean and scatter of its logarithm: the lowest of some hundred units estimates the lowest of all poorly.
    """
    def find_furthest(x: Floats) -> float:
        found, _, _ = find_excursions(com, x, bands.period, bands, list(bands.sections))
        return max((float(find_lasting_peak(e.departure / (e.most if is_most else e.middle))) for e in found
                    if e.fault == CLOGGING.name and np.isfinite(e.departure).any()), default=1.0)

    logs = np.log([find_furthest(x) for x in units])
    return float(np.exp(logs.mean() - STEP_FAULT_LEAVES_SD[is_most] * logs.std(ddof=1)))


def _measure_sensitivities(tables: Mapping[str, Floats], healthy: Floats, com: Floats, period: float,
                           parts: Sequence[Section]) -> dict[str, dict[str, float]]:
    """Mean and scatter of healthy units, and what a fault of Table 2's lesser size adds, by precursor."""
    found = {word: compute_features(com, x, period, parts) for word, x in tables.items()}
    whole = compute_features(com, healthy, period, parts)
    return {name: {"healthy": _average_known(whole[name]), "noise": float(np.nanstd(whole[name], ddof=1)),
                   **{word: _average_known(found[word][name]) - _average_known(found["healthy"][name])
                      for word in (CLOGGING.name, FRICTION.name)}} for name in whole}


def _average_known(values: Floats) -> float:
    """Mean over the units that show a precursor; NaN where most units do not show it."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if 2 * len(known) > len(values) else float("nan")


# ---------------------------------------------------------------------------------------------------------------------
# From a fleet's own traces
# ---------------------------------------------------------------------------------------------------------------------

def learn_bands(traces: Sequence[Trace], model: Model | None = None, names: Sequence[str] = (),
                progress: Progress = ignore_progress) -> Bands:
    """Bands from healthy traces of one command.

    The mean is the fleet's own. The scatter is the fleet's, too, joined with the simulated one as if that were of
    FLEET_PRIOR_TRACES traces more, and widened for the small number of traces (Student's t). What the faults add is
    simulated with `model`.

    Args:
        traces: at least FLEET_FEWEST_TRACES, without load.
        model: default the nominal one.
        names: of the traces, for refusals.
        progress: called with each stage and the share done, 0 to 1.

    Raises:
        InputError: too few traces, another command or period in one, a load, or a position with holes.
    """
    names = names or [f"trace {i + 1}" for i in range(len(traces))]
    if len(traces) < FLEET_FEWEST_TRACES:
        raise InputError("--learn-bands", f"{len(traces)} traces",
                         f"at least {FLEET_FEWEST_TRACES} healthy traces of one command")
    com, _, _, period, _ = read_columns(traces[0])
    base = choose_bands(com, np.zeros_like(com), period, model, progress)
    rows = [_align_trace(base, trace, name) for trace, name in zip(traces, names, strict=True)]
    fleet = _Fleet(np.array([x for _, x in rows]), np.mean([c for c, _ in rows], axis=0), base)
    found = replace(base, steps=tuple(fleet.correct_step(s) for s in base.steps),
                    ramps=tuple(fleet.correct_ramp(r) for r in base.ramps), precursors=fleet.correct_precursors(),
                    provenance={**base.provenance, "made": f"from {len(traces)} healthy traces, faults simulated",
                                "traces": ", ".join(names)})
    doubtful = [name for (c, x), name in zip(rows, names, strict=True)
                if any(level > Level.ACCEPTABLE for level in judge_position(c, x, period, base).levels.values())]
    if doubtful:
        words = "beyond MidBand of simulated healthy units: " + ", ".join(doubtful)
        return replace(found, provenance={**found.provenance, "doubtful": words})
    return found


def _align_trace(base: Bands, trace: Trace, name: str) -> tuple[Floats, Floats]:
    """Command and position of a trace on the rows of the base's command, gaps interpolated."""
    com, xj, load, period, _ = read_columns(trace)
    if is_loaded(load):
        raise InputError(name, "load", "none: bands are learned from an unloaded ram")
    missing = np.isnan(xj)
    if missing.mean() > POSITION_MISSING_SHARE:
        raise InputError(name, "xj", f"a whole position, not one with {100 * missing.mean():.0f} % missing")
    if abs(period / base.period - 1) > 0.01:
        raise InputError(name, "t", f"one row per {1e3 * base.period:g} ms as the others, not {1e3 * period:g} ms")
    parts = find_sections(com, period)
    require_same_command(base, parts, period, name)
    own, usual = (next(s.start for s in p if s.kind in ("step", "ramp")) for p in (parts, base.sections))
    n = base.sections[-1].stop
    at = np.clip(np.arange(n) + own - usual, 0, len(xj) - 1)
    rows = np.arange(len(xj))
    return com[at], np.interp(rows, rows[~missing], xj[~missing])[at]


class _Fleet:
    """Positions of a fleet, (m, n) m, and the simulated bands that they correct."""

    def __init__(self, x: Floats, com: Floats, base: Bands) -> None:
        self.x, self.com, self.base, self.freedom = x, com, base, len(x) - 1
        from scipy.stats import norm, t

        unsure = float(t.isf(norm.sf(BAND_NEAREST_LIMIT_SD), self.freedom + FLEET_PRIOR_TRACES)) / BAND_NEAREST_LIMIT_SD
        self.wider = unsure * float(np.sqrt(1 + 1 / len(x)))

    def join_scatter(self, values: Floats, simulated: Floats) -> Floats:
        """Standard deviation over the fleet, of (m, ..), shrunk to the simulated one and widened."""
        squares = FLEET_PRIOR_TRACES * simulated**2 + self.freedom * values.var(axis=0, ddof=1)
        out: Floats = self.wider * np.sqrt(squares / (FLEET_PRIOR_TRACES + self.freedom))
        return out

    def correct_step(self, s: StepBand) -> StepBand:
        """The fleet's mean and scatter; friction and clogging add to them what they add to a simulated unit's."""
        x = self.x[:, self.base.sections[s.section].start + np.rint(s.t / self.base.period).astype(int)]
        more = np.maximum(s.spread**2 - s.spread[0]**2, 0.0)
        return s._replace(healthy=x.mean(axis=0), spread=np.sqrt(self.join_scatter(x, s.spread[0])**2 + more))

    def correct_ramp(self, r: RampBand) -> RampBand:
        """The fleet's centres and healthy widths; a limit too near to them is dropped."""
        error, fast = _measure_ramp(self.x, self.com, self.base.sections[r.section], self.base.period)
        half = np.maximum.accumulate(np.r_[np.median(compute_half_range(error)), r.half_range[1:]])
        return r._replace(position=self.correct_width(error, r.position), speed=self.correct_width(fast, r.speed),
                          half_range=half)

    def correct_width(self, values: Floats, simulated: Width) -> Width:
        """Width of a signal (m, rows); `healthy` is three standard deviations above the fleet's mean."""
        centre = float(np.nanmean(values))
        usual = find_lasting_peak(np.abs(values - centre))
        spread = self.join_scatter(usual, np.array((simulated.healthy - float(usual.mean())) / 3).clip(0.0))
        clear = float(usual.mean() + BAND_FAULT_CLEARANCE_SD * spread)
        middle = simulated.middle if simulated.middle > clear else np.inf
        return Width(centre, float(usual.mean() + 3 * spread), middle, max(middle, simulated.most))

    def correct_precursors(self) -> dict[str, dict[str, float]]:
        """Mean and scatter of the fleet beside simulated sensitivities."""
        found = compute_features(self.com, self.x, self.base.period, list(self.base.sections))
        out = {}
        for name, known in self.base.precursors.items():
            values = found[name][~np.isnan(found[name])]
            noise = self.join_scatter(values, np.array(known["noise"])) if len(values) > 1 else known["noise"]
            out[name] = {**known, "healthy": float(values.mean()) if len(values) else known["healthy"],
                         "noise": float(noise)}
        return out


class UnitKind(NamedTuple):
    """Which units to draw; NaN leaves a size as the model has it."""

    name: str
    clogging: float = float("nan")  # Kintas
    friction: float = float("nan")  # FSS, N
    sliding: float = 1 / STATIC_OVER_DYNAMIC  # FDS over FSS


def simulate_units(model: Model, com: Floats, load: Floats, kind: UnitKind, count: int, seed: int, steps: int = 20,
                   progress: Progress = ignore_progress) -> Floats:
    """Sensed position, (count, n) m, of units over a command (n,) m with a known load (n,) N.

    The same seed gives the same units, whatever their faults. The solver takes `steps` a cycle; docs/statistics.md says
    what that leaves out. Every other block of units moved before its test and came to rest wherever friction left it;
    the others start at rest at null, as a model does.
    """
    tolerance = list_tolerance_sizes(model)
    names = list(dict.fromkeys([*tolerance, CLOGGING.parameter, FRICTION.parameter, DYNAMIC]))
    lanes = Lanes(model, names, steps, workers=1)
    moving, resting = (round(seconds / model["controller.period"]) for seconds in (0.5, 0.3))
    t = np.arange(moving) / moving
    lead_in = np.r_[1e-3 * np.sin(2 * np.pi * t) * t, np.zeros(resting)]  # m: what a unit did before its test
    out = np.empty((count, len(com)))

    def simulate_block(first: int) -> None:
        members = slice(first, min(first + NARROW, count))
        rng = np.random.default_rng([seed, first])
        before = com[0] + lead_in if com[0] != 0.0 or first // NARROW % 2 else com[:0]
        noise = sample_sensor_noise(rng, model, len(before) + len(com))
        units = _sample_parameters(rng, model, tolerance, names, kind)[:members.stop - first]
        asked, force = np.r_[before, com] - noise, np.r_[np.full(len(before), load[0]), load]
        out[members] = (lanes.closed_loop(units, asked, force)[..., 0] + noise)[:, len(before):]

    starts = range(0, count, NARROW)
    with ThreadPoolExecutor(count_threads()) as pool:
        for done, _ in enumerate(pool.map(simulate_block, starts)):
            progress(f"simulating units, {kind.name}", (done + 1) / len(starts))
    return out


def sample_sensor_noise(rng: np.random.Generator, model: Model, cycles: int, most_colour: float = 0.85,
                        most_hum: float = 0.55, hum_frequency: float = 50.0) -> Floats:
    """Noise of the position sensor, (cycles,) m: first order of a random colour, and mains hum of a random size.

    Args:
        rng: random numbers.
        model: its sensors.position_noise is the standard deviation without hum.
        cycles: of the controller.
        most_colour: largest correlation of the noise from one cycle to the next.
        most_hum: largest amplitude of the hum, in standard deviations of the noise.
        hum_frequency: Hz.
    """
    from scipy.signal import lfilter

    level, colour = model["sensors.position_noise"], rng.uniform(0.0, most_colour)
    white = rng.standard_normal(cycles)
    white[1:] *= np.sqrt(1.0 - colour**2)
    hum = rng.uniform(0.0, most_hum) * np.sin(2 * np.pi * (hum_frequency * model["controller.period"] *
                                                           np.arange(cycles) + rng.uniform()))
    coloured: Floats = level * (lfilter([1.0], [1.0, -colour], white) + hum)
    return coloured


def _sample_parameters(rng: np.random.Generator, model: Model, tolerance: Mapping[str, float], names: list[str],
                       kind: UnitKind) -> Floats:
    """Parameters of a block of units, (NARROW, len(names))."""
    table = np.tile([model[name] for name in names], (NARROW, 1))
    for name, size in tolerance.items():
        table[:, names.index(name)] += size * rng.standard_normal(NARROW)
    for name, value in ((CLOGGING.parameter, kind.clogging), (FRICTION.parameter, kind.friction),
                        (DYNAMIC, kind.friction * kind.sliding)):
        if np.isfinite(value):
            table[:, names.index(name)] = value
    return limit_dynamic_friction(names, table)


class Meaning(NamedTuple):
    """What a precursor is called, its unit, and how many of them make one SI unit."""

    words: str
    unit: str
    scale: float


MEANINGS = {
    "overshoot": Meaning("first overshoot", "%", 1.0),
    "undershoot": Meaning("undershoot after the overshoot", "%", 1.0),
    "rise_time": Meaning("rise from 10 to 90 %", "ms", 1e3),
    "peak_time": Meaning("time of the first peak", "ms", 1e3),
    "settling_time": Meaning("settling within 5 %", "ms", 1e3),
    "rest_error": Meaning("error at rest, RMS", "um", 1e6),
    "mean_ramp_error": Meaning("mean error on the ramp", "um", 1e6),
    "ramp_asymmetry": Meaning("ramp error out less in, half", "um", 1e6),
    "break_away": Meaning("error at break-away", "um", 1e6),
    "stick_slip_amplitude": Meaning("stick-slip amplitude", "um", 1e6),
    "stick_slip_frequency": Meaning("stick-slip frequency", "Hz", 1.0),
    "speed_ripple": Meaning("speed ripple, s.d.", "mm/s", 1e3),
    "slip_speed": Meaning("fastest slip", "mm/s", 1e3),
    "stuck_share": Meaning("share of the ramp at rest", "%", 100.0),
    "tracking_error": Meaning("RMS error in motion", "um", 1e6),
}
OF_STEPS = ("overshoot", "undershoot", "rise_time", "peak_time", "settling_time")


class Precursor(NamedTuple):
    """One number, SI or %, NaN where the trace does not show it; the rest is NaN without bands."""

    value: float
    unit: str  # "m", "s", "m/s", "Hz", "%" or "1"
    words: str
    shown: str  # the value in the unit that people use
    healthy: float  # mean of healthy units
    noise: float  # standard deviation of healthy units
    clogging: float  # what Table 2's lesser clogging adds
    friction: float  # what its lesser friction adds

    @property
    def departure(self) -> float:
        """Distance from the healthy mean, in healthy standard deviations."""
        return (self.value - self.healthy) / self._scatter

    @property
    def clogging_ratio(self) -> float:
        """Signal to noise: what Kintas 0.25 adds, in healthy standard deviations."""
        return self.clogging / self._scatter

    @property
    def friction_ratio(self) -> float:
        """Signal to noise: what FSS 35 N adds, in healthy standard deviations."""
        return self.friction / self._scatter

    @property
    def _scatter(self) -> float:
        return self.noise if self.noise > 0.0 else math.nan


def measure_precursors(source: Trace, bands: Bands | None = None) -> dict[str, Precursor]:
    """The precursors of a trace by name; empty where too much of the position is missing."""
    com, xj, _, period, _ = read_columns(source)
    missing = np.isnan(xj)
    if missing.mean() > POSITION_MISSING_SHARE:
        return {}
    rows = np.arange(len(xj))
    whole = np.interp(rows, rows[~missing], xj[~missing])
    unit = source.declared.controlled.unit
    found = compute_features(com, whole[None], period, find_sections(com, period), unit)
    known = bands.precursors if bands is not None else {}
    return {name: _make_precursor(name, float(values[0]), unit, known.get(name, {})) for name, values in found.items()}


def _make_precursor(name: str, value: float, unit: str, known: Mapping[str, float]) -> Precursor:
    kind, of_size = MEANINGS[find_kind(name)], _choose_size_unit(unit)[0]
    size = f", {name.rpartition('_')[2].removesuffix(of_size)} {of_size}" if find_kind(name) in OF_STEPS else ""
    si_unit = {"ms": "s", "um": unit, "mm/s": f"{unit}/s"}.get(kind.unit, kind.unit)
    numbers = (known.get(key, math.nan) for key in ("healthy", "noise", CLOGGING.name, FRICTION.name))
    return Precursor(value, si_unit, kind.words + size, format_precursor(value, name, si_unit), *numbers)


def format_precursor(value: float, name: str, si_unit: str = "m") -> str:
    """A value of a precursor in the unit that people use; `si_unit` is its own, of a signal other than a position.

    >>> format_precursor(1.912e-05, "break_away"), format_precursor(7.41, "overshoot_5mm")
    ('19.1 um', '7.41 %')
    >>> format_precursor(1.8e-4, "rest_error", "rad")
    '0.00018 rad'
    """
    _, unit, scale = MEANINGS[find_kind(name)]
    if unit in ("um", "mm/s") and si_unit not in ("m", "m/s"):
        unit, scale = si_unit, 1.0
    return f"{value * scale:.3g} {unit}" if math.isfinite(value) else "-"


def _choose_size_unit(unit: str) -> tuple[str, float]:
    """The unit of the size of a step, and how many of them make one `unit`."""
    return ("mm", 1e3) if unit == "m" else (unit, 1.0)


def find_kind(name: str) -> str:
    """The key into MEANINGS: a precursor's name without the step's size."""
    return name if name in MEANINGS else name.rpartition("_")[0]


def compute_features(com: Floats, x: Floats, period: float, parts: Sequence[Section], unit: str = "m",
                     least_step: float = 2e-4) -> dict[str, Floats]:
    """Values of all precursors for runs `x` (m, n) of a command (n,) in `unit`, by name as in MEANINGS, (m,) each.

    Precursors of steps carry the step's size in their name, such as overshoot_5mm; a step below `least_step` shows
    little but noise and friction and is left out. Precursors that the command cannot show are missing; those that a run
    does not show (an oscillation that never settles) are NaN.
    """
    out: dict[str, list[Floats]] = {}
    ramps: dict[float, list[Floats]] = {1.0: [], -1.0: []}
    for s in parts:
        rows = slice(s.start, s.stop)
        if s.kind == "step" and abs(s.last - s.first) >= least_step:
            of_size, scale = _choose_size_unit(unit)
            size = f"{scale * abs(s.last - s.first):.3g}{of_size}"
            for word, values in _measure_step(x[:, rows], s, period):
                out.setdefault(word if word == "rest_error" else f"{word}_{size}", []).append(values)
        elif is_slow_ramp(s, period):
            for word, values in _measure_ramp_response(com, x, period, s):
                out.setdefault(word, []).append(values)
            ramps[float(np.sign(s.rate))].append(out["mean_ramp_error"][-1])
        elif s.kind == "dynamic":
            error = com[rows] - x[:, rows]
            out.setdefault("tracking_error", []).append(np.sqrt(np.nanmean(error**2, axis=1)))
    if ramps[1.0] and ramps[-1.0]:
        out["ramp_asymmetry"] = [(np.mean(ramps[1.0], axis=0) - np.mean(ramps[-1.0], axis=0)) / 2]
    order = {word: i for i, word in enumerate(MEANINGS)}
    return {word: np.mean(out[word], axis=0) for word in sorted(out, key=lambda w: (order[find_kind(w)], w))}


def is_slow_ramp(s: Section, period: float, fastest: float = 5e-3, lasting: float = 0.5) -> bool:
    """Whether a section is a ramp that shows friction: below `fastest` m/s, and several slips (`lasting` s) long."""
    if s.kind != "ramp" or abs(s.rate) >= fastest:
        return False
    return bool(s.stop - select_ramp_rows(s, period).start > lasting / period)


def _measure_step(x: Floats, s: Section, period: float, settling_band: float = 0.05, settled_for: float = 0.05,
                  at_rest_after: float = 0.25) -> Iterator[tuple[str, Floats]]:
    """Response of (m, rows) to one step.

    A run has settled once it stays within `settling_band` of the step for `settled_for` s, as an oscillation passes
    through the band now and then. `at_rest_after` s after the step the ram should be at rest.
    """
    y = (smooth_spikes(x) - s.first) / (s.last - s.first)  # as a fraction of the step
    rows, horizon = y.shape[1], min(y.shape[1], round(STEP_JUDGED_UNTIL / period))
    peak = np.argmax(y[:, :horizon], axis=1)
    yield "overshoot", 100 * (y[np.arange(len(y)), peak] - 1)
    later = np.arange(horizon) > peak[:, None]
    yield "undershoot", 100 * (1 - np.where(later, y[:, :horizon], np.inf).min(axis=1))
    yield "rise_time", period * (_find_crossing(y, 0.9) - _find_crossing(y, 0.1))
    yield "peak_time", period * _find_vertex(y, peak)
    outside = np.abs(y - 1) > settling_band
    last = rows - 1 - np.argmax(outside[:, ::-1], axis=1)
    needed = settled_for / period if rows > 2 * settled_for / period else 1
    is_settled = rows - 1 - last >= needed
    yield "settling_time", np.where(is_settled, (last + 1) * period, np.nan)
    resting = round(at_rest_after / period)
    if resting < rows:
        yield "rest_error", np.sqrt(np.nanmean((x[:, resting:] - s.last)**2, axis=1))


def _measure_ramp_response(com: Floats, x: Floats, period: float, s: Section, stuck_below: float = 0.3
                  ) -> Iterator[tuple[str, Floats]]:
    """Response to a slow ramp; the ram sticks while it is slower than `stuck_below` of the ramp's rate."""
    rows = select_ramp_rows(s, period)
    error = np.sign(s.rate) * (com[rows] - x[:, rows])
    velocity = np.sign(s.rate) * compute_speed(x[:, s.start:s.stop], period)[:, rows.start - s.start:]
    yield "mean_ramp_error", np.nanmean(error, axis=1)
    half = compute_half_range(error)
    yield "break_away", half
    amplitude, frequency = _measure_oscillation(smooth_spikes(error), half, period)
    yield "stick_slip_amplitude", amplitude
    yield "stick_slip_frequency", frequency
    yield "speed_ripple", np.nanstd(velocity, axis=1)
    yield "slip_speed", np.nanpercentile(velocity, 99.5, axis=1)
    yield "stuck_share", np.nanmean(velocity < stuck_below * abs(s.rate), axis=1)


def _measure_oscillation(error: Floats, half: Floats, period: float) -> tuple[Floats, Floats]:
    """Amplitude, m (RMS about the mean times sqrt 2), and frequency, Hz (turns with a hysteresis of `half`/2)."""
    centred = error - np.nanmean(error, axis=1, keepdims=True)
    side = np.where(np.abs(centred) > half[:, None] / 2, np.sign(centred), 0.0)
    last = np.maximum.accumulate(np.where(side != 0.0, np.arange(side.shape[1]), 0), axis=1)
    latest_side = np.take_along_axis(side, last, axis=1)
    turns = ((latest_side[:, 1:] * latest_side[:, :-1]) < 0).sum(axis=1) / 2
    return np.sqrt(2 * np.nanmean(centred**2, axis=1)), turns / (side.shape[1] * period)


def smooth_spikes(x: Floats, samples: int = 5) -> Floats:
    """Running median over `samples`, the ends repeated: (m, n) in and out; a single spike leaves no trace."""
    half = samples // 2
    padded = np.pad(x, ((0, 0), (half, half)), mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, samples, axis=1), axis=2)


def _find_crossing(y: Floats, level: float) -> Floats:
    """Row, between samples, at which each run first passes a level; NaN if it never does."""
    beyond = y >= level
    k = np.argmax(beyond, axis=1)
    before = np.maximum(k - 1, 0)
    lines = np.arange(len(y))
    low, high = y[lines, before], y[lines, k]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(high > low, (level - low) / (high - low), 0.0)
    return np.where(beyond.any(axis=1), before + part, np.nan)


def _find_vertex(y: Floats, peak: NDArray[np.int64]) -> Floats:
    """Row of each run's peak between samples: of the parabola through the five samples around it, by least squares."""
    k = np.clip(peak, 2, y.shape[1] - 3)
    near = y[np.arange(len(y))[:, None], k[:, None] + np.arange(-2, 3)]
    slope = near @ np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) / 10
    bend = near @ np.array([2.0, -1.0, -2.0, -1.0, 2.0]) / 7
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0, -slope / bend, 0.0)
    row: Floats = k + np.clip(shift, -2.0, 2.0)
    return row
