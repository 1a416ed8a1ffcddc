"""Bands around a healthy response, the verdict on a trace that is judged by them, and their file.

Bands know a list of faults. Friction makes the plant stick and slip, in a phase of its own, so it is judged where the
command ramps slowly, by how far the response goes. Any other fault is judged where the command steps, by the course of
the response; and on the ramps as well, where no fault of the list is a friction. A limit is the mean response of faulty
units moved towards the healthy one until nearly every unit with a fault of that size is beyond it. Friction delays a
step as clogging does, so the friction that the ramps show is allowed for before a step is judged.

`fdi.diagnosis.make_bands` makes bands by simulation or from a fleet's own healthy traces.
"""
from __future__ import annotations

import json
import math
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.diagnosis.faults import Fault, Level
from fdi.diagnosis.precursors import (
    STEP_JUDGED_FROM,
    compute_half_range,
    find_lasting_peak,
    find_stays,
    measure_ramp,
    select_ramp_rows,
)
from fdi.estimation import is_friction
from fdi.thresholds import (
    BAND_FAULT_CLEARANCE_SD,
    BAND_LARGEST_LOAD,
    BAND_NEAREST_LIMIT_SD,
    SAME_COMMAND_POSITION,
    SAME_COMMAND_RATE,
    SAME_COMMAND_TIME,
    SECTION_MEASURED_SHARE,
)
from fdi.trace import Flags, Floats, Section, Trace, describe_section, find_sections, hold_last
from plant import (
    InputError,
    Model,
    Plant,
    count_nouns,
    decode_text,
    escape_control_characters,
    find_plant,
    parse_toml,
    quote_text,
    read_file,
    require,
)

LEVELS = {"middle": Level.MAINTENANCE, "most": Level.NON_NOMINAL}  # of a signal that has left this band


# ---------------------------------------------------------------------------------------------------------------------
# Bands of one command
# ---------------------------------------------------------------------------------------------------------------------

@dataclass(frozen=True, eq=False)
class BandFault(Fault):
    """A fault that bands judge. Their file leaves out which sizes are possible."""

    middle_share: float = 1.0  # of what MidBand adds to a step, where its limit is
    most_share: float = 1.0  # of what MaxBand adds
    amounts: Floats = field(default_factory=lambda: np.empty(0))  # (F,) of a friction, rising from sound

    @property
    def dynamic(self) -> float:
        """Of a friction: dynamic over static friction, 1 where it is one and the same."""
        return min(self.follow.values(), default=1.0)

    def is_of(self, fault: Fault) -> bool:
        """Whether it is that fault, with the same limits."""
        return all(getattr(self, key) == getattr(fault, key) for key in (
            "name", "parameter", "acceptable", "maintenance"))


class Friction(NamedTuple):
    """What the amounts of one friction, `BandFault.amounts`, make of a step; (F, K)."""

    shift: Floats  # what it adds
    spread: Floats  # standard deviation of otherwise healthy units


class StepBand(NamedTuple):
    """A step's response from STEP_JUDGED_FROM to STEP_JUDGED_UNTIL, over `t` (K,) s since the step."""

    section: int  # number among the command's sections
    t: Floats
    healthy: Floats  # (K,) mean
    spread: Floats  # (K,) standard deviation of healthy units
    frictions: Mapping[str, Friction]  # by fault
    middle: Mapping[str, Floats]  # (K,) what MidBand of a fault adds
    most: Mapping[str, Floats]  # (K,) what MaxBand adds

    def compute_centre(self, fault: BandFault, amount: float) -> tuple[Floats, Floats]:
        """Mean and standard deviation, (K,) each, with this `amount` of a friction."""
        weights = np.array([np.interp(amount, fault.amounts, row) for row in np.eye(len(fault.amounts))])
        friction = self.frictions[fault.name]
        return self.healthy + weights @ friction.shift, weights @ friction.spread

    def compute_centres(self, amounts: Mapping[str, Sequence[float]], bands: Bands) -> list[tuple[Floats, Floats]]:
        """Mean and standard deviation with each of these `amounts` of frictions; of healthy units without any."""
        return [self.compute_centre(bands.find(name), amount) for name, pair in amounts.items()
                for amount in pair] or [(self.healthy, self.spread)]

    def compute_margins(self, fault: BandFault, spread: Floats) -> tuple[Floats, Floats, Flags]:
        """Distances of the limits MidBand and MaxBand from the centre, and where the step is judged; (K,) each."""
        lesser, greater = np.abs(self.middle[fault.name]), np.abs(self.most[fault.name])
        is_judged = lesser > BAND_FAULT_CLEARANCE_SD * spread
        middle = np.maximum(fault.middle_share * lesser, BAND_NEAREST_LIMIT_SD * spread)
        return middle, np.maximum(fault.most_share * greater, middle), is_judged


class Width(NamedTuple):
    """How far a signal may be from `centre`, either way."""

    centre: float
    healthy: float
    middle: float  # inf: the fault cannot be told from healthy units
    most: float


class RampBand(NamedTuple):
    """A ramp's following error and speed beyond the demand's, both positive in the ramp's direction, for one fault."""

    section: int
    fault: str
    position: Width
    speed: Width
    half_range: Floats  # (F,) half the range of the error with each of the fault's amounts; of no friction (0,)
    slip: float = 0.0  # 1/s, fastest slip over that half range where dynamic friction is as usual
    ease: float = 0.0  # s, how much range is lost where the plant slips faster: range ~ static friction (1 - ease slip)

    def compute_scale(self, half: float, fastest: float) -> float:
        """Factor on the error that makes it the error with dynamic friction as usual.

        Args:
            half: half the range of the error.
            fastest: fastest lasting slip, a second.
        """
        slip = fastest / half if half > 0.0 else self.slip
        factor = (1 - self.ease * self.slip) / max(1 - self.ease * slip, 0.1)
        return float(np.clip(factor, 0.9, 1.3))  # what low and high dynamic friction account for

    def estimate_friction_ratio(self, half: float, fastest: float, dynamic: float) -> float:
        """Dynamic over static friction, in parts of the usual ratio `dynamic`.

        The speed of a slip goes with the difference of both frictions, which is 1 - `dynamic` of the static one at
        `slip`.
        """
        if self.slip <= 0.0 or dynamic >= 1.0:
            return 1.0
        slip = fastest / (self.compute_scale(half, fastest) * half) if half > 0.0 else self.slip
        return float(np.clip((1 - (1 - dynamic) * slip / self.slip) / dynamic, 0.0, 1 / dynamic))


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands of one command of a plant."""

    kind: Plant
    sections: tuple[Section, ...]  # of the command, rows of `period`
    period: float  # s
    scale: float  # that of `Trace.scale`
    faults: tuple[BandFault, ...]
    steps: tuple[StepBand, ...]
    ramps: tuple[RampBand, ...]
    provenance: Mapping[str, str] = field(default_factory=dict)
    precursors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # healthy scatter; what faults add

    @property
    def unit(self) -> str:
        """Of the controlled signal."""
        return self.kind.signals.controlled.unit

    def find(self, name: str) -> BandFault:
        """The fault of that name. Raises KeyError."""
        return {fault.name: fault for fault in self.faults}[name]

    def shows(self, fault: BandFault) -> bool:
        """Whether this command shows a fault."""
        return (any(s.compute_margins(fault, s.spread)[2].any() for s in self.steps if fault.name in s.middle)
                or any(np.isfinite(r.position.middle) for r in self.ramps if r.fault == fault.name))


def is_friction_fault(fault: Fault) -> bool:
    """Whether a fault is a dry friction, which makes the plant stick and slip."""
    return is_friction(fault.parameter) and fault.healthy > 0.0 and not (fault.falls or fault.both_ways)


# ---------------------------------------------------------------------------------------------------------------------
# Which bands a trace is judged by
# ---------------------------------------------------------------------------------------------------------------------

def require_same_command(bands: Bands, parts: Sequence[Section], period: float, where: object) -> None:
    """Refuse bands of another command.

    Raises:
        InputError: the first difference.
    """
    if difference := find_difference(bands, parts, period):
        kinds = [s.kind for s in bands.sections]
        name = " ".join([bands.provenance.get("command", ""), f"({kinds.count('step')} steps,"]).strip()
        raise InputError(where, bands.kind.signals.command.name,
                         f"the command of the bands, {name} {kinds.count('ramp')} ramps); {difference} "
                         "(rig fdi --learn-bands makes bands of it)")


def find_difference(bands: Bands, parts: Sequence[Section], period: float) -> str:
    """The first difference between a command's sections and those of the bands, in words; "" if it is the same command.

    How long a test rests before and after its steps and ramps does not matter.
    """
    band_sections, sections = ([s for s in every if s.kind in ("step", "ramp")] for every in (bands.sections, parts))
    if len(band_sections) != len(sections):
        return f"this one has {count_nouns(len(sections), 'section')}"
    same = SAME_COMMAND_POSITION * bands.scale
    for a, b in zip(band_sections, sections, strict=True):
        start = (b.start - sections[0].start) * period
        near = (abs((a.start - band_sections[0].start) * bands.period - start) < SAME_COMMAND_TIME
                and abs(a.first - b.first) < same and abs(a.last - b.last) < same
                and abs(a.rate - b.rate) <= SAME_COMMAND_RATE * abs(a.rate) + 1e-6 * bands.scale)
        if a.kind != b.kind or not near:
            return f"at {start:.3g} s it differs"
    return ""


def matches_command(bands: Bands, com: Floats, period: float) -> bool:
    """Whether the bands are of this command, (n,)."""
    return not find_difference(bands, find_sections(com, period, bands.scale), period)


def is_loaded(load: Floats, kind: Plant) -> bool:
    """Whether a known load, (n,), moves the plant by more than can be seen."""
    signal = kind.signals.load
    most = BAND_LARGEST_LOAD * signal.largest if signal is not None and math.isfinite(signal.largest) else 0.0
    return bool((np.abs(np.nan_to_num(load)) > most).any())


def list_design(model: Model, faults: Iterable[Fault]) -> dict[str, float]:
    """The parameters in which a healthy unit of the model differs from a nominal one, SI: not those of faults or noise.
    """
    fault_parameters = {name for fault in faults for name in fault.parameters}
    noise = {signal.noise for signal in model.kind.signals}
    return {name: value for name, value in sorted(model.list_changes().items())
            if name not in fault_parameters and name not in noise and not name.startswith("sensors.")}


def format_design(model: Model, faults: Iterable[Fault]) -> str:
    """`list_design` as the text that bands remember their model by."""
    return json.dumps(list_design(model, faults))


def describe_other_model(bands: Bands, model: Model) -> str:
    """Which model bands were made for, if it is another than `model`; else ""."""
    name, plant = bands.provenance.get("model", "eha"), bands.provenance.get("plant", "eha")
    parameters = bands.provenance.get("parameters", "{}")
    if (plant, parameters) == (model.kind.name, format_design(model, bands.faults)):
        return ""
    design = parameters.strip("{}").replace('"', "").replace(":", " =") or "all parameters nominal"
    return f"the model {name} with {design}"


# ---------------------------------------------------------------------------------------------------------------------
# The verdict
# ---------------------------------------------------------------------------------------------------------------------

class Event(NamedTuple):
    """A stay outside a band."""

    band: str  # "middle" | "most"
    fault: str
    signal: str  # "position" | "speed"
    section: str  # of the command, as fdi.trace.sections names it
    t_in: float  # s
    t_out: float  # s
    excess: float  # furthest beyond the band, in the unit of the controlled signal, or that a second


class BandVerdict(NamedTuple):
    """What the bands say. A fault whose sections the command lacks, or the trace lost, has no level."""

    levels: Mapping[str, Level]  # by the fault's name
    ruling: str | None  # the most severe fault; None if all are acceptable
    events: tuple[Event, ...]  # in order of time
    severity: Mapping[str, float]  # furthest lasting excursion, in MidBand limits; above 1 is an event
    shown: Mapping[str, Sequence[float]]  # of each friction: what the ramps show, static and dynamic by the usual ratio
    notes: tuple[str, ...]


def judge_trace(source: Trace, bands: Bands, where: object = "trace") -> BandVerdict:
    """Judge a trace; rows that its preparation found unusable are left out.

    Raises:
        InputError: no position, or bands of another command or load.
    """
    xj = source.mask_unusable(source.declared.controlled.name)
    return judge_position(hold_last(source.command), xj, source.period, bands, source.load, float(source.t[0]), where)


def judge_position(com: Floats, xj: Floats, period: float, bands: Bands, load: Floats | None = None, t0: float = 0.0,
                   where: object = "trace", parts: list[Section] | None = None) -> BandVerdict:
    """Judge a command and a sensed position, (n,) each, NaN where missing, one row per `period` s from `t0` s.

    `parts` are the command's sections, for callers that judge many runs of one command.

    Raises:
        InputError: no position, bands of another command, or a load that the bands do not know.
    """
    require(not np.isnan(xj).all(), where, bands.kind.signals.controlled.name,
            "a measured position: bands judge nothing else")
    parts = parts or find_sections(com, period, bands.scale)
    require_same_command(bands, parts, period, where)
    if load is not None and is_loaded(load, bands.kind) and "load" not in bands.provenance:
        most, signal = float(np.nanmax(np.abs(load))), bands.kind.signals.load
        unit = signal.unit if signal is not None else ""
        raise InputError(where, "load", f"none, as these bands are of an unloaded plant, not {most:.3g} {unit}")
    excursions, amounts, notes = find_excursions(com, xj, period, bands, parts)
    levels, severity, events = {}, {}, {i: [*_find_events(e, t0, period, bands.unit)] for i, e in enumerate(excursions)}
    for fault in bands.faults:
        indices = [i for i, e in enumerate(excursions)
                   if e.fault == fault.name and e.signal == "position" and e.is_judged]
        if indices:
            severity[fault.name] = max(0.0, *(excursions[i].measure_peak() for i in indices))
            levels[fault.name] = max((LEVELS[event.band] for i in indices for event in events[i]),
                                     default=Level.ACCEPTABLE)
        else:
            units = "units with the friction that the ramps show" if amounts else "healthy units"
            notes.append(f"{fault.name} is not judged by bands: " + (
                f"a fault at MidBand is within the scatter of {units}"
                if any(e.fault == fault.name for e in excursions) else "no section of the trace shows it"))
    ranks = {f: (levels[f], severity[f]) for f in levels if levels[f] > Level.ACCEPTABLE}
    ruling = max(ranks, key=lambda f: ranks[f]) if ranks else None
    all_events = sorted(chain.from_iterable(events.values()), key=lambda event: event.t_in)
    return BandVerdict(levels, ruling, tuple(all_events), severity, amounts, tuple(notes))


# ---------------------------------------------------------------------------------------------------------------------
# Excursions: how far each judged signal is from its centre
# ---------------------------------------------------------------------------------------------------------------------

class Excursion(NamedTuple):
    """Departure of one signal of one section from its centre, with its limits; (n,) each, rows from `start`."""

    signal: str  # "position" | "speed"
    section: Section
    start: int
    departure: Floats  # from the centre, positive towards the fault; NaN where it is not judged
    middle: Floats
    most: Floats
    fault: str

    @property
    def is_judged(self) -> bool:
        """Whether a limit applies to known samples for as long as an event lasts."""
        has_limit = np.isfinite(self.departure) & np.isfinite(self.middle)
        return bool(find_lasting_peak(has_limit.astype(float)) > 0.0)

    def measure_peak(self) -> float:
        """The furthest lasting departure, in limits of MidBand."""
        return float(find_lasting_peak(self.departure / self.middle))


def find_excursions(com: Floats, xj: Floats, period: float, bands: Bands, parts: list[Section]
                    ) -> tuple[list[Excursion], dict[str, Sequence[float]], list[str]]:
    """Every judged signal of every judged section, the frictions that the ramps show, and notes on omissions."""
    place = place_sections(bands, parts)
    notes: list[str] = []
    out: list[Excursion] = []
    ramp_pairs: dict[str, list[tuple[float, float]]] = {fault.name: [] for fault in bands.faults if len(fault.amounts)}
    is_lost: dict[int, bool] = {}
    for ramp in bands.ramps:
        s = place[ramp.section]
        error, beyond = measure_ramp(xj, com, s, period)
        if ramp.section not in is_lost:
            is_lost[ramp.section] = _is_lost(error, s, bands, notes)
        if is_lost[ramp.section]:
            continue
        half = float(compute_half_range(error))
        fastest = float(find_lasting_peak(beyond))
        scale, fault = ramp.compute_scale(half, fastest), bands.find(ramp.fault)
        if len(fault.amounts):
            amount = float(np.interp(scale * half, ramp.half_range, fault.amounts))
            ramp_pairs[fault.name].append((amount, amount * ramp.estimate_friction_ratio(half, fastest, fault.dynamic)))
        for signal, x, width in (("position", scale * (error - ramp.position.centre), ramp.position),
                                 ("speed", beyond - ramp.speed.centre, ramp.speed)):
            middle, most = (np.full(len(x), limit) for limit in (width.middle, width.most))
            out.append(Excursion(signal, s, select_ramp_rows(s, period).start, np.abs(x), middle, most, fault.name))
    amounts: dict[str, Sequence[float]] = {
        name: np.mean(pairs, axis=0).tolist() if pairs else [float(bands.find(name).amounts[0])] * 2
        for name, pairs in ramp_pairs.items()}
    if bands.ramps and ramp_pairs and not any(ramp_pairs.values()):
        notes.append("steps are judged as if friction were healthy: no ramp shows how much there is")
    for step in bands.steps:
        excursions = [_make_step_excursion(xj, period, bands, step, place[step.section], amounts, bands.find(name))
                      for name in step.middle]
        rows = (slice(excursions[0].start, excursions[0].start + len(excursions[0].departure)) if excursions
                else slice(0))
        if excursions and not _is_lost(xj[rows], excursions[0].section, bands, notes):
            out += excursions
    return out, amounts, notes


def place_sections(bands: Bands, parts: Iterable[Section]) -> dict[int, Section]:
    """A trace's sections, which are those of the same command, by their number in the bands."""
    numbers = [i for i, s in enumerate(bands.sections) if s.kind in ("step", "ramp")]
    return dict(zip(numbers, [s for s in parts if s.kind in ("step", "ramp")], strict=True))


def _is_lost(x: Floats, s: Section, bands: Bands, notes: list[str]) -> bool:
    """Whether too much of a section is missing to judge it; if so, with a note."""
    missing_share = float(np.isnan(x).mean()) if len(x) else 1.0
    too_much = missing_share > 1.0 - SECTION_MEASURED_SHARE
    if too_much:
        notes.append(f"{describe_section(s, unit=bands.unit)} is not judged: {100 * missing_share:.0f} % of its "
                     "position is missing")
    return too_much


def _make_step_excursion(xj: Floats, period: float, bands: Bands, step: StepBand, s: Section,
                         amounts: Mapping[str, Sequence[float]], fault: BandFault) -> Excursion:
    """Departure towards a fault; NaN on rows without a limit.

    A step is delayed by the sliding friction and scatters with the static one. So both amounts of each friction are
    allowed for, and the smallest departure counts.
    """
    first, stop = round(step.t[0] / period), round(step.t[-1] / period) + 1
    rows = np.arange(first, min(stop, s.stop - s.start))
    at = rows * period
    towards = np.sign(np.interp(at, step.t, step.middle[fault.name]))
    centres, spreads = zip(*step.compute_centres(amounts, bands), strict=True)
    middle, most, is_judged = step.compute_margins(fault, np.max(spreads, axis=0))
    departures = [towards * (xj[s.start + rows] - np.interp(at, step.t, centre)) for centre in centres]
    x = np.min(np.abs(departures) if fault.both_ways else departures, axis=0)
    x = np.where(np.interp(at, step.t, is_judged.astype(float)) > 0.99, x, np.nan)
    return Excursion("position", s, s.start + first, x, np.interp(at, step.t, middle), np.interp(at, step.t, most),
                     fault.name)


def _find_events(e: Excursion, t0: float, period: float, unit: str) -> Iterator[Event]:
    for band, limit in (("middle", e.middle), ("most", e.most)):
        with np.errstate(invalid="ignore"):
            beyond = e.departure > limit
        for first, last in find_stays(beyond):
            excess = float(np.nanmax((e.departure - limit)[first:last + 1]))
            begin, end = (t0 + (e.start + row) * period for row in (first, last + 1))
            yield Event(band, e.fault, e.signal, describe_section(e.section, unit=unit), begin, end, excess)


# ---------------------------------------------------------------------------------------------------------------------
# The file
# ---------------------------------------------------------------------------------------------------------------------

DEFAULT = "preflight_bands.toml"
MS_PER_S = 1e3
SPEED_COUNT = 1e3  # counts of a position, a second, that make one of a speed
KNOT_CYCLES = 2  # between the times at which shifts and spreads of a step are known
BARE = re.compile(r"[A-Za-z0-9_-]+")  # a key that TOML takes without quotes
HEADER = """\
# Bands of a command, as `rig fdi --learn-bands` writes them; `rig fdi TRACE --bands FILE` judges by them.
# Positions are in counts of so many m or rad. [[step]]: the mean response of healthy units, a number a cycle from
# {first:g} ms on; every {coarse} cycles their standard deviation (spread), what each amount of a friction adds
# (shift) with the standard deviation then (scatter), and what a fault adds at MidBand (middle) and at MaxBand (most):
# the limits stand at middle_share and most_share of that. [[ramp]]: how far following error and speed (in 1000 counts
# a second) may be from their centre for a fault; of a friction half the range of the error by amount, slip over it,
# 1/s, how much range faster slips cost, s. [precursors]: mean and scatter of healthy units; what MidBand adds.
"""


@cache
def load_default_bands() -> Bands:
    """The bands of the preflight command and the nominal plant that come with the software."""
    return parse_bands((files("fdi.diagnosis") / DEFAULT).read_text(encoding="utf-8"), DEFAULT)


def load_bands(path: str | Path, kind: Plant | None = None) -> Bands:
    """Bands from a file, of the plant `kind` (default: the EHA).

    Raises:
        InputError: a file that cannot be read, that holds no bands, or those of another plant.
    """
    return parse_bands(decode_text(read_file(Path(path)), path), path, kind)


def format_bands(bands: Bands) -> str:
    """Bands as TOML."""
    count = float(f"1e{math.floor(math.log10(bands.scale)) - 6}")  # about a millionth of the largest command
    head = {"period_ms": bands.period * MS_PER_S, "scale": bands.scale, "count": count}
    lines = [HEADER.format(first=MS_PER_S * STEP_JUDGED_FROM, coarse=KNOT_CYCLES), "[bands]",
             *(f"{key} = {value:g}" for key, value in head.items()), "", "[provenance]",
             *(f"{key} = {quote_text(escape_control_characters(value))}" for key, value in bands.provenance.items()),
             "",
             "# kind, rows from and to, demand before and at the end in counts, rate in counts/s", "sections = [",
             *(f"  {json.dumps([*s[:3], *_round_values(np.array(s[3:]) / count, 2)])},"
               for s in bands.sections), "]"]
    for fault in bands.faults:
        lines += ["", f"[faults.{fault.name}]",
                  *(f"{key} = {quote_text(getattr(fault, key))}" for key in ("parameter", "symbol", "unit")),
                  *(f"{key} = {json.dumps(getattr(fault, key))}" for key in ("acceptable", "maintenance")),
                  *(f"follow.{json.dumps(name)} = {by!r}" for name, by in fault.follow.items()),
                  *(["both_ways = true"] if fault.both_ways else [])]
        if len(fault.amounts):
            lines.append(f"amounts = {json.dumps(fault.amounts.tolist())}")
        else:
            lines += [f"{key} = {getattr(fault, key):.4f}" for key in ("middle_share", "most_share")]
    for step in bands.steps:
        lines += ["", "[[step]]", f"section = {step.section}",
                  f"healthy = {_format_list(step.healthy / count, 1)}",
                  f"spread = {_format_list(step.spread[::KNOT_CYCLES] / count, 2)}"]
        for key in ("middle", "most"):
            lines += [f"{key}.{name} = {_format_list(x[::KNOT_CYCLES] / count, 1)}"
                      for name, x in getattr(step, key).items()]
        for name, friction in step.frictions.items():
            for key, values, places in (("shift", friction.shift, 1), ("scatter", friction.spread, 2)):
                rows = [f"  {_format_list(row[::KNOT_CYCLES] / count, places)}," for row in values[1:]]
                lines += [f"{key}.{name} = [", *rows, "]"]
    for ramp in bands.ramps:
        lines += ["", "[[ramp]]", f"section = {ramp.section}", f"fault = {json.dumps(ramp.fault)}",
                  f"position = {_format_numbers(ramp.position._asdict(), count)}",
                  f"speed = {_format_numbers(ramp.speed._asdict(), SPEED_COUNT * count)}",
                  *([f"half_range = {_format_list(ramp.half_range / count, 2)}", f"slip = {ramp.slip:.4g}",
                     f"ease = {ramp.ease:.4g}"] if len(ramp.half_range) else [])]
    lines += ["", "[precursors]", *(f"{name if BARE.fullmatch(name) else json.dumps(name)} = {_format_numbers(numbers)}"
                                    for name, numbers in bands.precursors.items())]
    return "\n".join(lines) + "\n"


def parse_bands(content: str, where: object, kind: Plant | None = None) -> Bands:
    """Bands from TOML, of the plant `kind` (default: the EHA).

    Raises:
        InputError: text that is not TOML, or lacks a key, or bands of another plant.
    """
    table, kind = parse_toml(content, where), kind or find_plant("eha")
    try:
        bands = _read_bands(table, kind)
    except KeyError as error:
        raise InputError(where, str(error.args[0]), "a file of bands, which has this key") from error
    except (TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        raise InputError(where, "", f"a file of bands as rig fdi --learn-bands writes it ({error})") from error
    require((plant := bands.provenance.get("plant", "eha")) == kind.name, where, "plant",
            f"bands of the plant {kind.name}, not of {plant}")
    return bands


def _read_bands(table: Mapping[str, Any], kind: Plant) -> Bands:
    head = table["bands"]
    period, scale, count = float(head["period_ms"]) / MS_PER_S, float(head["scale"]), float(head["count"])
    per_unit = round(1.0 / count)  # numbers are divided by it, as counts are decimal fractions
    provenance = dict(table["provenance"])
    parts = tuple(Section(part, int(a), int(b), first / per_unit, last / per_unit, rate / per_unit)
                  for part, a, b, first, last, rate in provenance.pop("sections"))
    faults = []
    for name, values in table["faults"].items():
        amounts = np.array(values.pop("amounts", ()), float)
        if not (np.diff(amounts) > 0.0).all():
            raise ValueError("amounts: rising values")
        faults.append(BandFault(name, name.replace("_", " "), range=(-math.inf, math.inf), amounts=amounts, **values))
    places = {part: [i for i, s in enumerate(parts) if s.kind == part] for part in ("step", "ramp")}
    by_name = {fault.name: fault for fault in faults}
    steps = tuple(_read_step(step, period, by_name, places["step"], per_unit) for step in table.get("step", ()))
    ramps = tuple(_read_ramp(ramp, by_name, places["ramp"], per_unit) for ramp in table.get("ramp", ()))
    return Bands(kind, parts, period, scale, tuple(faults), steps, ramps,
                 {key: str(value) for key, value in provenance.items()},
                 {name: {key: float(value) for key, value in numbers.items()}
                  for name, numbers in table.get("precursors", {}).items()})


def _read_step(step: Mapping[str, Any], period: float, faults: Mapping[str, BandFault], parts: Container[int],
               per_unit: float) -> StepBand:
    healthy = np.array(step["healthy"], float) / per_unit
    rows = np.arange(len(healthy))
    coarse = rows[::KNOT_CYCLES]

    def read_knots(values: Any, count: int = 0) -> Floats:
        knots = np.array(values, float) / per_unit
        if knots.shape != ((count, len(coarse)) if count else coarse.shape) or step["section"] not in parts:
            raise ValueError(f"step of section {step['section']}: not a step of the command, or lists of other lengths")
        return np.apply_along_axis(lambda each: np.interp(rows, coarse, each), -1, knots)

    spread = read_knots(step["spread"])
    frictions = {}
    for name in step.get("shift", {}):
        shift, scatter = (read_knots(step[key][name], len(faults[name].amounts) - 1) for key in ("shift", "scatter"))
        frictions[name] = Friction(np.vstack([np.zeros(len(rows)), shift]), np.vstack([spread, scatter]))
    middle, most = ({faults[name].name: read_knots(values) for name, values in step.get(key, {}).items()}
                    for key in ("middle", "most"))
    if middle.keys() != most.keys():
        raise ValueError(f"step of section {step['section']}: middle and most of the same faults")
    t = (rows + round(STEP_JUDGED_FROM / period)).astype(float)
    return StepBand(int(step["section"]), t * period, healthy, spread, frictions, middle, most)


def _read_ramp(ramp: Mapping[str, Any], faults: Mapping[str, BandFault], parts: Container[int], per_unit: float
               ) -> RampBand:
    fault = faults[ramp["fault"]]
    half_range = np.array(ramp.get("half_range", ()), float) / per_unit
    if half_range.shape != fault.amounts.shape or ramp["section"] not in parts:
        raise ValueError(f"ramp of section {ramp['section']}: not a ramp of the command, or lists of other lengths")
    position, speed = (Width(*(float(ramp[key][word]) / scale for word in Width._fields))
                       for key, scale in (("position", per_unit), ("speed", per_unit / SPEED_COUNT)))
    return RampBand(int(ramp["section"]), fault.name, position, speed, half_range, float(ramp.get("slip", 0.0)),
                    float(ramp.get("ease", 0.0)))


def _round_values(values: Iterable[float], places: int) -> list[float]:
    return [round(float(value), places) + 0.0 for value in values]  # no -0.0


def _format_list(values: Iterable[float], places: int) -> str:
    return json.dumps(_round_values(values, places))


def _format_numbers(numbers: Mapping[str, float], count: float = 1.0) -> str:
    """A table in one line, in counts of so much; as TOML writes numbers, NaN and infinity included."""
    parts = {key: value / count for key, value in numbers.items()}
    pairs = (f"{key} = {f'{x:.5g}' if math.isfinite(x) else x}" for key, x in parts.items())
    return f"{{ {', '.join(pairs)} }}"
