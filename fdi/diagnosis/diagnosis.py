"""The diagnosis of one captured test: bands, precursors, RMS grid, refined sizes, levels, and what else is wrong."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from fdi.diagnosis.ambiguity import Group, cut_intervals, find_groups
from fdi.diagnosis.bands import (
    Bands,
    BandVerdict,
    Event,
    describe_other_model,
    is_loaded,
    judge_trace,
    list_design,
    load_default_bands,
    matches_command,
)
from fdi.diagnosis.faults import (
    Estimate,
    Fault,
    Level,
    choose_faults,
    compute_severity,
    find_ruling_fault,
    judge_size,
)
from fdi.diagnosis.precursors import Precursor, measure_precursors
from fdi.diagnosis.refine import (
    Beside,
    Refinement,
    choose_size_excerpt,
    find_effects_beside,
    get_positive,
    list_coarse_starts,
    refine_sizes,
)
from fdi.diagnosis.rms_grid import Grid, search_grid
from fdi.estimation import (
    SAME_PERIOD,
    cut_excerpt,
    is_long,
    leave_out_rest,
    list_relative_tolerances,
    match_period,
    prepare_trace,
    require_finite_replay,
    sensor_floors,
)
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    MOVING_RAM,
    RESIDUAL_JUDGES_NOTHING,
    SUSPECT_HEALTHY_TOLERANCES,
    SUSPECT_INTERVAL_FACTOR,
    SUSPECT_SMALLEST,
    UNIT_TOLERANCE,
)
from fdi.trace import Trace
from plant import InputError, Model, load_model, require


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The answer of `rig fdi` on a trace."""

    source: str
    faults: tuple[Fault, ...]
    verdict: str  # ACCEPTABLE, MAINTENANCE, NON_NOMINAL, AMBIGUOUS, SOMETHING_ELSE or CANNOT_TELL
    levels: Mapping[str, Level | None]  # by fault; None: cannot be judged
    ruling: str | None  # the fault that is furthest gone; None if none is
    sizes: Mapping[str, Estimate]  # by fault, SI, as the levels are judged by them
    groups: tuple[Group, ...]  # faults of which at least one has grown, without telling which
    refinement: Refinement
    grids: tuple[Grid, ...]  # of pairs of faults; none where the command has neither steps nor ramps
    precursors: Mapping[str, Precursor]
    band_verdict: BandVerdict | None  # None: there are no bands of this command
    others: Mapping[str, Estimate]  # suspects outside the healthy range, by parameter, SI
    trace: Trace  # prepared for replay
    model: Model  # at the cycle of the trace
    floor: Mapping[str, float]  # RMS noise by signal, SI
    bands: Bands | None
    notes: tuple[str, ...]
    beside: Beside | None = None  # other effects beside the faults; None: they were not searched

    @property
    def events(self) -> tuple[Event, ...]:
        """Stays outside the bands."""
        return self.band_verdict.events if self.band_verdict else ()


def diagnose(trace: Trace, model: Model | None = None, bands: Bands | None = None,
             progress: Progress = ignore_progress, source: str = "trace", workers: int = 2,
             with_effects: bool = False, faults: Sequence[Fault] | None = None) -> Diagnosis:
    """Judge faults from a trace of any command.

    Args:
        trace: needs command, controlled signal and drive; further outputs and a known load narrow the intervals.
        model: the unit as it left the works; default the nominal one.
        bands: default: those that come with the software, if they are of this command.
        progress: called with each stage and the share done, 0 to 1.
        source: the trace's name in refusals.
        workers: threads.
        with_effects: search the catalogue for what else is wrong, and size the faults beside it.
        faults: default those that the plant brings, or else the paper's.

    Raises:
        InputError: a trace that cannot be judged at all, or bands of another model.
    """
    model = model or load_model()
    faults = choose_faults(None, model.kind) if faults is None else tuple(faults)
    progress("reading", 0.0)
    trace = prepare_trace(trace, model, None, source)
    model = match_period(model, trace, SAME_PERIOD)
    require_finite_replay(trace, model)
    way = float(np.nanmax(trace.controlled) - np.nanmin(trace.controlled))
    command, controlled, least = trace.declared.command, trace.declared.controlled, MOVING_RAM * trace.scale
    if max(way, float(np.ptp(trace.command))) < least:
        raise InputError(source, command.name, f"a test in which the {controlled.phrase} moves {least:g} "
                                               f"{controlled.unit} or more: at rest it shows no fault")
    notes = list(trace.notes)
    progress("bands", 0.03)
    bands = _find_own_bands(trace, model, faults, notes) if bands is None else _require_bands_of(bands, model, faults)
    band_verdict = None
    if bands is not None:
        band_verdict = judge_trace(trace, bands)
        notes += band_verdict.notes
    precursors = measure_precursors(trace, bands.precursors if bands is not None else None)
    progress("grid", 0.05)
    floor = {name: f.value for name, f in sensor_floors(trace, model).items()}
    fitted_trace = moving_trace = leave_out_rest(trace, model)
    notes += moving_trace.notes[len(trace.notes):]
    if is_long(trace):
        excerpt = choose_size_excerpt(model, moving_trace, floor, progress, faults)
        fitted_trace = cut_excerpt(moving_trace, excerpt)
        notes.append(excerpt.describe(trace))
    grids = _search_grids(fitted_trace, model, [faults] if len(faults) == 2 else [], notes)
    if with_effects:
        progress("refinement", 0.07)
    starts = [start for grid in grids for start in grid.starts]
    refinement = refine_sizes(model, fitted_trace, (*starts, *list_coarse_starts(faults)), floor, workers, moving_trace,
                              ignore_progress if with_effects else progress, faults)
    sizes = _widen_intervals(refinement)
    beside = None
    if with_effects:
        beside = find_effects_beside(model, fitted_trace, refinement, floor, progress, workers, moving_trace)
        refinement = beside.best.refinement
        sizes = dict(beside.sizes) if refinement.is_explained else _widen_intervals(refinement)
    levels = _judge_sizes(sizes, refinement)
    groups: tuple[Group, ...] = ()
    if refinement.is_explained and None in levels.values():
        sizes |= cut_intervals(refinement, [name for name, level in levels.items() if level is None], sizes)
        levels = _judge_sizes(sizes, refinement)
        groups = find_groups(refinement, levels, list_relative_tolerances(model, [f.parameter for f in faults]))
    if beside is not None:
        levels |= dict.fromkeys(beside.disputed)
    if len(faults) > 2:
        progress("grid", 0.98)
        grids = _search_grids(fitted_trace, model, _choose_pairs(faults, sizes, levels), notes)
    progress("done", 1.0)
    return Diagnosis(source=source, faults=faults, levels=levels, groups=groups,
                     verdict=_decide_verdict(levels, groups, refinement.is_explained),
                     ruling=find_ruling_fault(faults, sizes, levels), sizes=sizes, refinement=refinement, grids=grids,
                     precursors=precursors, band_verdict=band_verdict, others=_find_unhealthy(refinement, model),
                     trace=trace, model=model, floor=floor, bands=bands, notes=tuple(notes), beside=beside)


def _choose_pairs(faults: Sequence[Fault], sizes: Mapping[str, Estimate], levels: Mapping[str, Level | None],
                  most: int = 3) -> list[tuple[Fault, Fault]]:
    """The pairs of faults to draw maps of: of those that are not acceptable, and of the two that are furthest gone."""
    ranking = sorted(faults, key=lambda f: (levels[f.name] == Level.ACCEPTABLE, -compute_severity(
        f, sizes[f.name].value)))
    count = sum(levels[f.name] != Level.ACCEPTABLE for f in faults)
    return list(combinations([f for f in faults if f in ranking[:min(max(count, 2), most)]], 2))


def _require_bands_of(bands: Bands, model: Model, faults: Sequence[Fault]) -> Bands:
    """Bands of another unit, or of none of these faults, are refused."""
    require(any(band_fault.is_of(fault) for band_fault in bands.faults for fault in faults), "--bands",
            f"of {', '.join(band_fault.name for band_fault in bands.faults)}",
            "bands of one of these faults with the same limits; rig fdi --learn-bands --faults FILE makes them")
    if other := describe_other_model(bands, model):
        design = ", ".join(f"{name} = {value:g}" for name, value in list_design(model, bands.faults).items())
        raise InputError("--bands", f"made for {other}", f"bands of the model of this diagnosis, {model.name}"
                         + (f" with {design}" if design else "") + "; rig fdi --learn-bands makes them")
    return bands


def _find_own_bands(trace: Trace, model: Model, faults: Sequence[Fault], notes: list[str]) -> Bands | None:
    """The bands that come with the software if they fit; a note if they do not."""
    bands = load_default_bands()
    for fits, reason in (
            (model.kind.name == bands.kind.name and all(any(b.is_of(f) for f in faults) for b in bands.faults),
             "the software's own are of the paper's faults; rig fdi --learn-bands makes others"),
            (not describe_other_model(bands, model),
             "the software's own are of the nominal unit; rig fdi --learn-bands makes others"),
            (not is_loaded(trace.load, model.kind), "the plant is loaded, and the software's own are of a free one"),
            (matches_command(bands, trace.command, trace.period),
             "the software's own are of the preflight command, this is another")):
        if not fits:
            notes.append(f"no bands: {reason}")
            return None
    return bands


def _search_grids(trace: Trace, model: Model, pairs: Sequence[Sequence[Fault]], notes: list[str]) -> tuple[Grid, ...]:
    if pairs and not {s.kind for s in trace.sections()} & {"step", "ramp"}:
        notes.append("no RMS grid: the command has neither steps nor ramps")
        return ()
    try:
        return tuple(search_grid(trace, model, pair) for pair in pairs)
    except InputError as error:  # sections that a gap has emptied
        notes.append(f"no RMS grid: {error.expected}")
        return ()


def _judge_sizes(sizes: Mapping[str, Estimate], refinement: Refinement) -> dict[str, Level | None]:
    """Level of each fault; where physics is missing in the fit, a fault is acceptable at most, or cannot be judged."""
    levels = {f.name: judge_size(f, sizes[f.name], len(refinement.faults)) for f in refinement.faults}
    if refinement.is_explained:
        return levels
    is_known = max(refinement.ratio.values()) <= RESIDUAL_JUDGES_NOTHING
    return {name: level if is_known and level == Level.ACCEPTABLE else None for name, level in levels.items()}


def _find_unhealthy(refinement: Refinement, model: Model) -> dict[str, Estimate]:
    """The suspects outside the healthy range, by parameter; none if the fit leaves so much that it says nothing."""
    if max(refinement.ratio.values()) > RESIDUAL_JUDGES_NOTHING:
        return {}
    return {name: e for name, e in refinement.others.items() if _is_unhealthy(name, e, model)}


def _widen_intervals(refinement: Refinement) -> dict[str, Estimate]:
    """The sizes of the faults; where more than noise is left, their intervals are wider by as much."""
    wider = 1.0 if refinement.is_explained else max(refinement.ratio.values())
    return {f.name: Estimate(e.value, max(e.value - wider * (e.value - e.low), f.range[0]),
                             min(e.value + wider * (e.high - e.value), f.range[1]))
            for f in refinement.faults for e in (refinement.sizes[f.name],)}


def _decide_verdict(levels: Mapping[str, Level | None], groups: Sequence[Group], is_explained: bool) -> str:
    if not is_explained:
        return "SOMETHING_ELSE"
    worst = max((level for level in levels.values() if level is not None), default=Level.ACCEPTABLE)
    if worst > Level.ACCEPTABLE:
        return worst.name
    if groups:
        return "AMBIGUOUS"
    return "CANNOT_TELL" if None in levels.values() else "ACCEPTABLE"


def _is_unhealthy(name: str, e: Estimate, model: Model) -> bool:
    """Whether a suspect is surely outside the healthy range; there are six of them, so 95 % is not enough."""
    low = e.value - SUSPECT_INTERVAL_FACTOR * (e.value - e.low)
    high = e.value + SUSPECT_INTERVAL_FACTOR * (e.high - e.value)
    if name in SUSPECT_SMALLEST:
        return (low > 0.0 or high < 0.0) and abs(e.value) > SUSPECT_SMALLEST[name]
    usual, factor = get_positive(model, name), math.exp(SUSPECT_HEALTHY_TOLERANCES * UNIT_TOLERANCE)
    return low > usual * factor or high < usual / factor
