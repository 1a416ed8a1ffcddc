"""A trace held against bands: levels of both faults, events with entry and exit times, and which fault rules."""
from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.comparison.localisation import name
from fdi.diagnosis.envelope import (
    Bands,
    StepBand,
    Width,
    check_command,
    judged_rows,
    lasting_most,
    loaded,
    matches,
    speed,
    stays,
    waver,
)
from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Event, Level
from fdi.diagnosis.simulated_units import DYNAMIC
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    BAND_UNITS_QUICK,
    FAST_SLIP_RATIO,
    FRICTION_HIDES_CLOGGING_RATIO,
    SECTION_MEASURED_SHARE,
)
from fdi.trace.columns import hold_last
from fdi.trace.sections import Section, sections
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model, load_model

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Judged(NamedTuple):
    """What the bands say. A fault whose sections the command lacks, or the trace lost, has no level."""

    levels: Mapping[str, Level]  # by the effect's name
    ruling: str | None  # the fault that is further gone; None if both are acceptable
    events: tuple[Event, ...]  # in order of time
    severity: Mapping[str, float]  # furthest lasting excursion, in MidBand limits; above 1 is an event
    friction: float  # N, what the ramps show: FSS / (1 - Kintas)
    notes: tuple[str, ...]


def judge(source: Trace, bands: Bands | None = None, model: Model | None = None,
          progress: Progress = ignore_progress, where: object = "trace") -> Judged:
    """Judge a trace; rows that its preparation found unusable are left out.

    Without `bands` the preflight's own are taken, or, for another command, load or model than they are of, bands are
    made by simulating units of the `model` (default: the nominal one) on this command: some seconds.

    Raises:
        InputError: no position, or bands of another command or load.
    """
    com, xj, load, period, t0 = columns(source)
    chosen = bands or suited(com, load, period, model, progress)
    return judge_columns(com, xj, period, chosen, load, t0, where)


def suited(com: Floats, load: Floats, period: float, model: Model | None = None,
           progress: Progress = ignore_progress) -> Bands:
    """The preflight's own bands if they are of this command, load and model; else bands made for them."""
    from fdi.diagnosis.bands_file import default
    from fdi.diagnosis.learn_bands import build

    plain = model is None or same_plant(model)
    if plain and not loaded(load) and matches(own := default(), com, period):
        return own
    return build(model or load_model(), com, np.nan_to_num(load), period, *BAND_UNITS_QUICK, progress=progress)


def same_plant(model: Model) -> bool:
    """Whether a healthy unit of the model is a nominal one; its two faults and its noise do not count."""
    apart = set(model.differences()) - {CLOGGING.parameter, FRICTION.parameter, DYNAMIC}
    return model.plant == "eha" and not any(not name.startswith("sensors.") for name in apart)


class Excursion(NamedTuple):
    """One signal of one section over its limits; (n,) each, rows from `start`."""

    signal: str  # "position" | "speed"
    section: Section
    start: int
    departure: Floats  # from the centre, m or m/s, positive towards the fault; NaN where it is not judged
    middle: Floats
    most: Floats
    fault: str

    @property
    def judged(self) -> bool:
        """Whether there is a limit over known samples for long enough to be left."""
        limited = np.isfinite(self.departure) & np.isfinite(self.middle)
        return bool(lasting_most(limited.astype(float)) > 0.0)


def judge_columns(com: Floats, xj: Floats, period: float, bands: Bands, load: Floats | None = None, t0: float = 0.0,
                  where: object = "trace", parts: list[Section] | None = None) -> Judged:
    """Judge a command and sensed position, (n,) m, NaN where missing, one row per `period` s from `t0` s.

    `parts` are the command's sections, for who judges many runs of one.

    Raises:
        InputError: no position, bands of another command, or a load that the bands do not know.
    """
    if np.isnan(xj).all():
        raise InputError(where, "xj", "a measured position: bands judge nothing else")
    parts = parts or sections(com, period)
    check_command(bands, parts, period, where)
    if load is not None and loaded(load) and "load" not in bands.provenance:
        most = float(np.nanmax(np.abs(load)))
        raise InputError(where, "load", f"none, as these bands are of an unloaded ram, not {most:.3g} N")
    found, friction, notes = excursions(com, xj, period, bands, parts)
    events = sorted((event for e in found for event in _events(e, t0, period)), key=lambda event: event.t_in)
    levels, severity = {}, {}
    for fault in FAULTS:
        own = [e for e in found if e.fault == fault.name and e.signal == "position" and e.judged]
        if not own:
            notes.append(f"{fault.name} is not judged by bands: {_why(fault.name, found, friction, bands)}")
            continue
        severity[fault.name] = max(0.0, *(float(lasting_most(e.departure / e.middle)) for e in own))
        left = {event.band for e in own for event in _events(e, t0, period)}
        levels[fault.name] = (Level.NON_NOMINAL if "most" in left else Level.MAINTENANCE if "middle" in left else
                              Level.ACCEPTABLE)
    if FRICTION.name in levels and max(slips(found)) > FAST_SLIP_RATIO * max(1.0, severity[FRICTION.name]):
        notes.append("the spool slips faster than its static friction accounts for: less dynamic friction than a third "
                     "below it")
    gone = {f: (levels[f], severity[f]) for f in levels if levels[f] > Level.ACCEPTABLE}
    ruling = max(gone, key=lambda f: gone[f]) if gone else None
    return Judged(levels, ruling, tuple(events), severity, friction, tuple(notes))


def _why(fault: str, found: list[Excursion], friction: float, bands: Bands) -> str:
    if not any(e.fault == fault and e.signal == "position" for e in found):
        return "no section of the trace shows it"
    if fault == CLOGGING.name and friction > FRICTION_HIDES_CLOGGING_RATIO * float(bands.friction[0]):
        return f"{friction:.0f} N of friction hide it"
    return "Table 2's fault is within what healthy units scatter"


def slips(found: list[Excursion]) -> list[float]:
    """Fastest lasting slip on each ramp, in MidBand limits of speed."""
    return [float(lasting_most(e.departure / e.middle)) for e in found if e.signal == "speed"] or [0.0]


def excursions(com: Floats, xj: Floats, period: float, bands: Bands, parts: list[Section]
               ) -> tuple[list[Excursion], float, list[str]]:
    """Every judged signal of every judged section, the friction that the ramps show (N), and what was left out."""
    own = [s for s in parts if s.kind in ("step", "ramp")]
    known = [i for i, s in enumerate(bands.sections) if s.kind in ("step", "ramp")]
    place = dict(zip(known, own, strict=True))
    notes: list[str] = []
    out: list[Excursion] = []
    shown = []
    velocity = speed(xj, period)
    for ramp in bands.ramps:
        s, rows = place[ramp.section], judged_rows(place[ramp.section], period)
        error = np.sign(s.rate) * (com[rows] - xj[rows])
        if _lost(error, s, notes):
            continue
        beyond = np.sign(s.rate) * velocity[rows] - abs(s.rate)
        half = float(waver(error))
        fastest = float(lasting_most(beyond))
        scale = ramp.scale(half, fastest)
        amount = float(np.interp(scale * half, ramp.waver, bands.friction))
        shown.append((amount, amount * ramp.sliding(half, fastest)))
        out.append(_ramp("position", s, rows.start, scale * (error - ramp.position.centre), ramp.position))
        out.append(_ramp("speed", s, rows.start, beyond - ramp.speed.centre, ramp.speed))
    least = float(bands.friction[0])
    friction, sliding = np.mean(shown, axis=0).tolist() if shown else (least, least)
    if bands.ramps and not shown:
        notes.append("steps are judged as if the spool had healthy friction: no ramp shows how much there is")
    for step in bands.steps:
        made = _step(xj, period, bands, step, place[step.section], (friction, sliding))
        if not _lost(xj[made.start:made.start + len(made.departure)], made.section, notes):
            out.append(made)
    return out, friction, notes


def _lost(x: Floats, s: Section, notes: list[str]) -> bool:
    lost = float(np.isnan(x).mean()) if len(x) else 1.0
    if lost > 1.0 - SECTION_MEASURED_SHARE:
        notes.append(f"{name(s)} is not judged: {100 * lost:.0f} % of its position is missing")
    return lost > 1.0 - SECTION_MEASURED_SHARE


def _ramp(signal: str, s: Section, start: int, departure: Floats, width: Width) -> Excursion:
    middle, most = (np.full(len(departure), limit) for limit in (width.middle, width.most))
    return Excursion(signal, s, start, np.abs(departure), middle, most, FRICTION.name)


def _step(xj: Floats, period: float, bands: Bands, step: StepBand, s: Section, amounts: tuple[float, float]
          ) -> Excursion:
    """Departure towards clogging; on rows where no limit stands it is NaN.

    A step is delayed by what slides (FDS) and scatters by what sticks (FSS). So two amounts of friction are allowed,
    and what is left by either counts.
    """
    first, stop = round(step.t[0] / period), round(step.t[-1] / period) + 1
    rows = np.arange(first, min(stop, s.stop - s.start))
    at = rows * period
    towards = np.sign(np.interp(at, step.t, step.middle))
    centres, spreads = zip(*(step.centre(amount, bands.friction) for amount in amounts), strict=True)
    middle, most, judged = bands.margins(step, np.max(spreads, axis=0))
    x = np.min([towards * (xj[s.start + rows] - np.interp(at, step.t, centre)) for centre in centres], axis=0)
    x = np.where(np.interp(at, step.t, judged.astype(float)) > 0.99, x, np.nan)
    return Excursion("position", s, s.start + first, x, np.interp(at, step.t, middle), np.interp(at, step.t, most),
                     CLOGGING.name)


def _events(e: Excursion, t0: float, period: float) -> list[Event]:
    out = []
    for band, limit in (("middle", e.middle), ("most", e.most)):
        with np.errstate(invalid="ignore"):
            beyond = e.departure > limit
        for stay in stays(beyond):
            rows = slice(stay.first, stay.last + 1)
            excess = float(np.nanmax(e.departure[rows] - limit[rows]))
            begin = t0 + (e.start + stay.first) * period
            out.append(Event(band, e.signal, name(e.section), begin, t0 + (e.start + stay.last + 1) * period, excess))
    return out


def columns(source: Trace) -> tuple[Floats, Floats, Floats, float, float]:
    """Command without holes, position with NaN where it cannot be used, load, period and first time of a trace."""
    return hold_last(source.com), source.measured("xj"), source.load, source.period, float(source.t[0])
