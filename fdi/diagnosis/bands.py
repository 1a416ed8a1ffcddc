"""Bands around a healthy response: what they are, and the verdict on a trace that is judged by them.

Filter clogging is judged where the command steps, spool friction where it ramps slowly. A limit is the mean response of
faulty units moved towards the healthy one until nearly every unit with a fault of that size is beyond it. Friction
delays a step as clogging does, so the friction that the ramps show is allowed for before a step is judged.
"""
from __future__ import annotations

import json
import math
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, DYNAMIC, FAULTS, FRICTION, STATIC_OVER_DYNAMIC, Level
from fdi.output import write_text
from fdi.thresholds import (
    BAND_EVENT_SAMPLES,
    BAND_FAULT_CLEARANCE_SD,
    BAND_LARGEST_LOAD,
    BAND_NEAREST_LIMIT_SD,
    FAST_SLIP_RATIO,
    FRICTION_HIDES_CLOGGING_RATIO,
    SAME_COMMAND_POSITION,
    SAME_COMMAND_RATE,
    SAME_COMMAND_TIME,
    SECTION_MEASURED_SHARE,
)
from fdi.trace.sections import Section, describe_section, find_sections
from fdi.trace.trace import Trace, hold_last
from plant.errors import InputError
from plant.model import Model
from plant.parameters import parse_toml

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

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
    return hold_last(source.com), source.mask_unusable("xj"), source.load, source.period, float(source.t[0])


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


def save_bands(bands: Bands, path: str | Path) -> None:
    """Write bands to a file.

    Raises:
        InputError: a path that cannot be written.
    """
    write_text(path, format_bands(bands))


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
