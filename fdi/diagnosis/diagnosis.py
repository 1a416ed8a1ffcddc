"""The whole check of one captured test: bands, precursors, grid, refined sizes, levels, and what else is wrong."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fdi.diagnosis import levels as rules
from fdi.diagnosis import rms_grid as grids
from fdi.diagnosis.bands import Judged, judge, same_plant
from fdi.diagnosis.bands_file import default
from fdi.diagnosis.envelope import Bands, loaded, matches
from fdi.diagnosis.fault_unknowns import LARGEST, MOST, positive
from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Estimate, Event, Level
from fdi.diagnosis.precursors import Precursor, measure
from fdi.diagnosis.refine import COARSE, Refined, refine
from fdi.estimation.noise_floor import sensor_floors
from fdi.estimation.preparation import SAME_PERIOD, match_period, prepare_trace
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    MOVING_RAM,
    RESIDUAL_JUDGES_NOTHING,
    SUSPECT_HEALTHY_TOLERANCES,
    SUSPECT_INTERVAL_FACTOR,
    SUSPECT_SMALLEST,
    UNIT_TOLERANCE,
)
from fdi.trace.sections import sections
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model, load_model

STAGES = 4
WORDS = ("ACCEPTABLE", "MAINTENANCE", "NON_NOMINAL", "SOMETHING_ELSE", "CANNOT_TELL")


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What `rig fdi` tells of a trace."""

    source: str
    verdict: str  # one of WORDS
    levels: Mapping[str, Level | None]  # by fault; None: cannot be judged
    ruling: str | None  # the fault that is further gone; None if neither is
    sizes: Mapping[str, Estimate]  # by fault, Kintas and N, as the levels are judged by them
    refined: Refined
    grid: grids.Grid | None  # None: the command has neither steps nor ramps
    precursors: Mapping[str, Precursor]
    judged: Judged | None  # what the bands say; None: there are none of this command
    others: Mapping[str, Estimate]  # suspects that are off what a healthy unit has, by parameter, SI
    trace: Trace  # prepared for replay
    model: Model  # at the cycle of the trace
    floor: Mapping[str, float]  # what the sensors' noise makes of each signal, RMS SI
    bands: Bands | None
    notes: tuple[str, ...]

    @property
    def events(self) -> tuple[Event, ...]:
        """Stays outside the bands."""
        return self.judged.events if self.judged else ()

    @property
    def passed(self) -> bool:
        """Whether both faults are acceptable and nothing else is in the way of saying so."""
        return self.verdict == "ACCEPTABLE"


def diagnose(trace: Trace, model: Model | None = None, bands: Bands | None = None,
             progress: Progress = ignore_progress, source: str = "trace",
             workers: int = 2) -> Diagnosis:
    """Judge the two faults from a trace of any command.

    Args:
        trace: needs Com, XJ and Cor; P12, XS and a known load make it surer.
        model: the unit as it left the works; default the nominal one.
        bands: default: those that come with the software, if they are of this command.
        progress: called with each stage and the share done, 0 to 1.
        source: the trace's name in refusals.
        workers: threads.

    Raises:
        InputError: what cannot be judged at all, in one line.
    """
    model = model or load_model()
    if model.plant != "eha":
        raise InputError("--model", model.plant, "eha: the two faults are the paper's servovalve's")
    progress("reading", 0.0)
    trace = prepare_trace(trace, model, None, source)
    model = match_period(model, trace, SAME_PERIOD)
    if float(np.ptp(trace.com)) < MOVING_RAM and float(np.nanmax(trace.xj) - np.nanmin(trace.xj)) < MOVING_RAM:
        raise InputError(source, "com",
                         f"a ram that moves {1e3 * MOVING_RAM:g} mm or more: at rest it shows neither fault")
    notes = list(trace.notes)
    progress("bands", 1 / STAGES)
    bands, judged, seen = _banded(trace, model, bands, notes)
    progress("grid", 2 / STAGES)
    grid = _grid(trace, model, notes)
    progress("refinement", 3 / STAGES)
    floor = {name: f.value for name, f in sensor_floors(trace, model).items()}
    found = refine(model, trace, (*_starts(grid), *COARSE), floor, workers)
    progress("done", 1.0)
    return _concluded(Diagnosis(source, "", {}, None, {}, found, grid, seen, judged, {}, trace, model, floor, bands,
                                tuple(notes)))


def _banded(trace: Trace, model: Model, bands: Bands | None, notes: list[str]
            ) -> tuple[Bands | None, Judged | None, dict[str, Precursor]]:
    """Bands, what they say, and the precursors."""
    if bands is None:
        bands = _own_bands(trace, model, notes)
    judged = None
    if bands is not None:
        judged = judge(trace, bands, model)
        notes += judged.notes
    return bands, judged, measure(trace, bands)


def _own_bands(trace: Trace, model: Model, notes: list[str]) -> Bands | None:
    """The bands that come with the software if they fit; a note if they do not."""
    own = default()
    if not same_plant(model):
        notes.append("no bands: the software's own are of the nominal unit; rig fdi --learn-bands makes others")
        return None
    if loaded(trace.load):
        notes.append("no bands: the ram is loaded, and the software's own are of a free one")
        return None
    if not matches(own, trace.com, trace.period):
        notes.append("no bands: the software's own are of the preflight command, this is another")
        return None
    return own


def _grid(trace: Trace, model: Model, notes: list[str]) -> grids.Grid | None:
    kinds = {s.kind for s in sections(trace.com, trace.period)}
    if not kinds & {"step", "ramp"}:
        notes.append("no RMS grid: the command has neither steps nor ramps")
        return None
    try:
        return grids.search(trace, model)
    except InputError as error:  # sections that a gap has emptied
        notes.append(f"no RMS grid: {error.expected}")
        return None


def _starts(grid: grids.Grid | None) -> list[tuple[float, float]]:
    """The grid's answers as starts of the refinement."""
    if grid is None:
        return []
    minima = [m.minimum for m in (grid.joint, grid.step, grid.ramp) if m is not None]
    return [(grid.merged.kintas, grid.merged.fss), *((p.kintas, p.fss) for p in minima)]


def _concluded(d: Diagnosis) -> Diagnosis:
    """Levels, verdict, and what else is off."""
    sizes = _sizes(d.refined)
    levels = {f.name: rules.level(f, sizes[f.name]) for f in FAULTS}
    far = max(d.refined.ratio.values()) > RESIDUAL_JUDGES_NOTHING
    if not d.refined.reached:
        levels = {name: found if found == Level.ACCEPTABLE and not far else None for name, found in levels.items()}
    others = {name: e for name, e in d.refined.others.items() if not far and _unhealthy(name, e, d.model)}
    return replace(d, levels=levels, sizes=sizes, ruling=rules.ruling(sizes, levels), others=others,
                   verdict=_verdict(levels, d.refined.reached))


def _sizes(found: Refined) -> dict[str, Estimate]:
    """The sizes of both faults; where more than noise is left, their intervals are wider by as much."""
    wider = 1.0 if found.reached else max(found.ratio.values())

    def widened(e: Estimate, most: float) -> Estimate:
        low, high = e.value - wider * (e.value - e.low), e.value + wider * (e.high - e.value)
        return Estimate(e.value, max(low, 0.0), min(high, most))

    return {CLOGGING.name: widened(found.kintas, MOST), FRICTION.name: widened(found.fss, LARGEST)}


def _verdict(levels: Mapping[str, Level | None], reached: bool) -> str:
    known = [found for found in levels.values() if found is not None]
    if not reached:
        return "SOMETHING_ELSE"
    worst = max(known, default=Level.ACCEPTABLE)
    if worst > Level.ACCEPTABLE:
        return worst.name
    return "ACCEPTABLE" if len(known) == len(levels) else "CANNOT_TELL"


def _unhealthy(name: str, e: Estimate, model: Model) -> bool:
    """Whether a suspect is surely off what a healthy unit has: there are many of them, so by more than 95 %."""
    low = e.value - SUSPECT_INTERVAL_FACTOR * (e.value - e.low)
    high = e.value + SUSPECT_INTERVAL_FACTOR * (e.high - e.value)
    if name in SUSPECT_SMALLEST:
        return (low > 0.0 or high < 0.0) and abs(e.value) > SUSPECT_SMALLEST[name]
    usual, way = positive(model, name), math.exp(SUSPECT_HEALTHY_TOLERANCES * UNIT_TOLERANCE)
    return low > usual * way or high < usual / way
