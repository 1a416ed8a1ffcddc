"""The nominal model of a user's actuator: its parameters from measured runs, and what these runs cannot tell.

The data sheet says where each parameter is about. A fit that may begin far away goes on from there (`global_fit`), and
the last rounds have fine steps and the noise that is left. A parameter whose interval stays wide is not identifiable
from these runs: it keeps the data sheet's value, and simulated candidate runs say which one would show it. Held-out
runs judge the result.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi.discovery.runs import Source, read_traces, require_distinct
from fdi.discovery.update_model import Provenance, format_model_file
from fdi.estimation import (
    BALANCED,
    FIT_ROUNDS,
    SAME_PERIOD,
    Fit,
    Free,
    LogFree,
    LogFrictionRatio,
    LogProblem,
    Problem,
    Value,
    can_be_cut,
    choose_excerpt,
    compute_misfit,
    compute_residuals,
    compute_typical_rms,
    compute_values,
    cut_excerpt,
    descend,
    estimate_smooth_covariance,
    find_flat_directions,
    find_undecided_rows,
    fit_noise,
    hold_inputs,
    is_long,
    leave_out_rest,
    leave_out_rows,
    limit_friction_values,
    list_relative_tolerances,
    list_tolerance_unknowns,
    match_period,
    prepare_trace,
    remove_slope,
    replay_current,
    require_finite_replay,
    scale_noise,
    scaled_bounds,
    sensor_floors,
    silence_readings,
    simulate_trace,
    start_fit,
    take_logarithm,
    weigh_priors,
    white_noise,
)
from fdi.identification.global_fit import (
    fit_from_afar,
    is_fitted,
    polish_fit,
    profile_ranges,
    profile_unknowns,
    put_unknown,
    scale_values,
    search_other_valleys,
)
from fdi.output import replace_text
from fdi.progress import Progress, ignore_progress
from fdi.sources import name_software
from fdi.thresholds import (
    FITTED_RUN_WORST,
    HELD_OUT_UNDECIDED_SHARE,
    IDENTIFIABLE_SHARE,
    IDENTIFIED_INTERVAL_FACTOR,
    IDENTIFIED_SYSTEMATIC_SD,
    INTERVAL_95_SD,
    MOVING_RAM,
    PILOT_FLOW_SYSTEMATIC_SD,
    PRIORS_KNOW_MORE_MISFIT,
    RESIDUAL_HELD_OUT,
    RESIDUAL_WORST,
    STATIC_FRICTION_SYSTEMATIC_SD,
)
from fdi.trace import Floats, Trace, rms
from plant import (
    InputError,
    Lanes,
    Model,
    Place,
    build_dataclass,
    count_threads,
    find_quantity,
    find_shipped_model,
    read_toml,
    require,
)

FRICTIONS = (("jack.static_friction", "jack.dynamic_friction"), ("spool.static_friction", "spool.dynamic_friction"))
SYSTEMATIC_SD = {"jack.static_friction": STATIC_FRICTION_SYSTEMATIC_SD, "pilot.flow_gain": PILOT_FLOW_SYSTEMATIC_SD}


class Range(NamedTuple):
    """How widely a parameter is free: the data sheet's value and the bounds of the fit, SI."""

    name: str
    centre: float
    low: float
    high: float
    unit: str

    @property
    def is_relative(self) -> bool:
        """Whether the fit works on the logarithm: the parameter cannot be zero or negative."""
        return self.low > 0.0

    @property
    def half_width(self) -> float:
        """Half the range: of the logarithm if the range is relative, else SI."""
        return 0.5 * (math.log(self.high / self.low) if self.is_relative else self.high - self.low)


USUAL_FACTOR = 4.0  # within which a parameter may be wrong where nothing says so
Width = float | tuple[float, float]  # how widely a parameter is free: a factor either way, or a range, SI


@dataclass(frozen=True)
class FreeParameters:
    """What is free, as a model file has it."""

    identify: Mapping[str, Width]


def read_free_parameters(model: Model, source: str | Path | None) -> tuple[Range, ...]:
    """The free parameters of a model: those of its file, or those of the nominal model where that lists none.

    Args:
        model: with the values of the data sheet.
        source: the model's file; None for the nominal model. Without a list, the parameters that differ from unit to
            unit are free.

    Raises:
        InputError: a table [identify] with an unknown parameter, or with a factor or range that cannot be; or no such
            table, and no parameter with a tolerance.
    """
    path = find_shipped_model(str(source)) or Path(str(source))
    is_model_file = source is not None and path.suffix == ".toml" and path.is_file()
    own_tables = read_toml(path).get("identify") if is_model_file else None
    if own_tables is not None:
        return parse_free_parameters(own_tables, model, source)
    usual = Path(str(files("plant").joinpath("models", "nominal.toml")))
    tables = read_toml(usual)["identify"]
    if {f"{group}.{field}" for group, fields in tables.items() for field in fields} <= model.values.keys():
        return parse_free_parameters(tables, model, usual.name)
    widths: dict[str, Width] = dict.fromkeys(list_relative_tolerances(model, model.list_names()), USUAL_FACTOR)
    if model.kind.foreign is not None:  # the map of an FMU gives ranges
        quantities = {name: find_quantity(name, plant=model.plant) for name in model.list_names()}
        widths |= {name: (q.low, q.high) for name, q in quantities.items()
                   if math.isfinite(q.high - q.low) and not q.is_whole
                   and name.partition(".")[0] not in ("controller", "sensors")}
    ranges = {name: _parse_range(name, width, model, model.name) for name, width in widths.items()
              if model[name] > 0.0 or isinstance(width, tuple)}
    require(ranges, source, "identify", "tables [identify.GROUP] that say what is free (docs/identify.md)")
    return tuple(ranges.values())


def parse_free_parameters(tables: object, model: Model, where: object) -> tuple[Range, ...]:
    """The ranges that the tables of [identify] describe, in the model's order.

    Raises:
        InputError: an unknown parameter, or a factor or range that cannot be.
    """
    ranges = {}
    for name, width in build_dataclass(FreeParameters, {"identify": tables}, Place(str(where))).identify.items():
        find_quantity(name, where, model.plant)
        require(name in model.values, where, f"identify.{name}",
                f"a parameter that the model has; add {name.partition('.')[0]} to its effects")
        ranges[name] = _parse_range(name, width, model, where)
    require(ranges, where, "identify", "at least one free parameter")
    return tuple(ranges[name] for name in model.list_names() if name in ranges)


def _parse_range(name: str, width: Width, model: Model, where: object) -> Range:
    q, value = find_quantity(name, where, model.plant), model[name]
    require(not (q.words or q.is_whole), where, f"identify.{name}",
            f"a parameter that takes values between its steps, not {q.expected}")
    possible_low, possible_high = max(q.low, q.above), min(q.high, q.below)
    if isinstance(width, tuple):
        low, high = width
        require(possible_low <= low < high <= possible_high, where, f"identify.{name}",
                f"a range [low, high] within {possible_low:g} .. {possible_high:g} {q.unit}, not {list(width)}")
    else:
        require(width > 1.0, where, f"identify.{name}", f"a factor above 1, not {width:g}")
        require(value > 0.0, where, f"identify.{name}",
                f"a range [low, high] in {q.unit}: a factor says nothing of {value:g}")
        low, high = max(value / width, possible_low), min(value * width, possible_high)
    middle = math.sqrt(low * high) if low > 0.0 else 0.5 * (low + high)
    return Range(name, value if low <= value <= high else middle, low, high, q.unit)


def get_systematic_sd(name: str) -> float:
    """The relative standard deviation that solver and stick-slip add to a parameter beside that of the fit."""
    return SYSTEMATIC_SD.get(name, IDENTIFIED_SYSTEMATIC_SD)


def list_unknowns(model: Model, ranges: tuple[Range, ...]) -> tuple[Free, ...]:
    """What the fit may change: the free parameters, and the tolerances of the others."""
    free = {r.name: _make_free(r) for r in ranges}
    free |= {f.name: take_logarithm(f) for f in list_tolerance_unknowns(model) if f.name not in free}
    for static, dynamic in FRICTIONS:
        if static in free and isinstance(free.get(dynamic), LogFree):
            del free[static]  # to come after the dynamic one
            free[static] = _make_friction_ratio(model, static, dynamic, static in {r.name for r in ranges})
    return tuple(free.values())


def _make_friction_ratio(model: Model, static: str, dynamic: str, is_free: bool) -> LogFrictionRatio:
    """Static over dynamic friction, at least 1.

    As two separate unknowns the dynamic friction could go above the static one, where no signal depends on it any more:
    a fit that got there would stay.
    """
    usual = math.log(max(model[static] / model[dynamic], 1.0))
    spread, highest = (0.5, math.log(20.0)) if is_free else (0.03, usual + 1.0)
    return LogFrictionRatio(static, usual, spread, 1.0, 0.0, max(highest, usual), 0.3)


def _make_free(r: Range) -> Free:
    """The parameter, known beforehand to lie within half its range of the data sheet's value."""
    if r.is_relative:
        return LogFree(r.name, math.log(r.centre), r.half_width, 1.0, math.log(r.low), math.log(r.high), 0.02)
    return Free(r.name, r.centre, r.half_width, 1.0, r.low, r.high, 0.02)


class IdentificationRuns(NamedTuple):
    """What an identification works on."""

    model: Model  # at the cycle of the runs
    fitted: tuple[Trace, ...]  # prepared
    held_out: tuple[Trace, ...]
    sources: tuple[Source, ...]  # of all of them, the held-out ones last


def read_identification_runs(model: Model, ranges: Sequence[Range], fitted_runs: Sequence[str | Trace],
                             held_out_runs: Sequence[str | Trace], signals: Sequence[str] | None = None
                             ) -> IdentificationRuns:
    """The runs of an identification, from files or traces, made ready for replay.

    Raises:
        InputError: a file or trace that cannot be used, or a run given twice.
    """
    require(fitted_runs, "RUN", "", "at least one run to fit")
    traces, sources = read_traces([*fitted_runs, *held_out_runs], model)
    count = len(fitted_runs)
    require_distinct(sources, "RUN", "other runs", count)
    outputs = tuple(s.name for s in model.kind.signals.outputs)
    for name in signals or ():
        require(name in outputs, "--signals", name, f"some of {','.join(outputs)}")
    used_outputs = [s for s in outputs if any(s in t.signals for t in traces[:count])
                    and (signals is None or s in signals)]
    require(used_outputs, sources[0].file, ", ".join(signals or outputs), "a signal that a run to fit has")
    limits = {s.limit for s in model.kind.signals if s.limit}
    widest = replace(model, values={**model.values, **{r.name: r.high for r in ranges if r.name in limits}})
    runs = [_prepare(t, widest, [s for s in used_outputs if s in t.signals] or used_outputs, source)
            for t, source in zip(traces, sources, strict=True)]
    model = match_period(model, runs[0], SAME_PERIOD)
    period = model["controller.period"]
    for trace, source in zip(runs, sources, strict=True):
        require(abs(trace.period / period - 1.0) <= SAME_PERIOD, source.file, "t",
                f"rows {period:g} s apart, as in {sources[0].file}")
    require_finite_replay(runs[0], model)
    return IdentificationRuns(model, tuple(runs[:count]), tuple(runs[count:]), tuple(sources))


def _prepare(trace: Trace, model: Model, outputs: Sequence[str], source: Source) -> Trace:
    if not model.kind.controller and model.kind.foreign is None:
        return hold_inputs(trace, outputs, source.file)
    try:
        return prepare_trace(trace, model, outputs, source.file)
    except InputError as error:
        if "a signal that changes" in error.expected and np.ptp(trace.command) == 0.0:  # at rest: says little
            return hold_inputs(trace, outputs, source.file)
        raise


DIFFERENCE = 0.01  # of a logarithm, or of half a range, for slopes
STEPS = 20  # solver steps a cycle


class Experiment(NamedTuple):
    """A run that could be made: its name, what to do, its command, (n,) SI, by the model, and whether under a load."""

    name: str
    what: str
    build: Callable[[Model], Floats]
    is_loaded: bool = False


class Advice(NamedTuple):
    """How to learn a parameter: the run that narrows its interval most, None where no candidate would do."""

    parameter: str
    experiment: str | None
    what: str
    share: float  # of half the range that the interval would take up with that run beside the present ones


def _move(model: Model, levels: Sequence[tuple[float, float]], scale: float, speed: float = math.inf) -> Floats:
    """A command that goes to each of some (level, seconds), times `scale`, at `speed` a second, and holds it."""
    period, at, parts = model["controller.period"], 0.0, []
    for level, seconds in levels:
        to = level * scale
        if to != at and speed < math.inf:
            parts.append(np.linspace(at, to, max(2, round(abs(to - at) / speed / period)), endpoint=False))
        parts.append(np.full(max(1, round(seconds / period)), to))
        at = to
    return np.concatenate(parts)


def _measure_stroke(model: Model) -> float:
    """How far the plant goes either way: its declared limit, else what the largest command has to a ram's stroke."""
    command = model.kind.signals.command
    return model.values.get(command.limit, 0.04 * (command.largest if math.isfinite(command.largest) else 1.0))


def _build_steps(model: Model) -> Floats:
    levels = (0.0, 0.1, 0.0, 0.6, -0.6, 0.0, -0.1, 0.0)
    return _move(model, [(level, 0.8 if abs(level) < 0.5 else 1.5) for level in levels], _measure_stroke(model))


def _build_ramps(model: Model) -> Floats:
    x = 0.03 * _measure_stroke(model)
    return _move(model, ((0.0, 0.3), (1.0, 0.5), (-1.0, 0.5), (0.0, 0.3)), x, x / 2.0)


def _build_sweep(model: Model) -> Floats:
    t = np.arange(0.0, 5.0, model["controller.period"])
    com = 0.03 * _measure_stroke(model) * np.sin(2.0 * np.pi * (0.5 * t + 1.9 * t**2))  # 0.5 to 19.5 Hz
    return np.concatenate([_move(model, ((0.0, 0.3),), 0.0), com])


def _build_stops(model: Model) -> Floats:
    stroke = _measure_stroke(model)
    has_spool = {"valve.flow_gain", "spool.travel", "jack.area"} <= model.values.keys()  # then a fifth open
    speed = 0.2 * model["valve.flow_gain"] * model["spool.travel"] / model["jack.area"] if has_spool else 5.0 * stroke
    return _move(model, ((0.0, 0.3), (1.0, 0.8), (-1.0, 0.8), (0.0, 0.3)), 1.1 * stroke, speed)


def _measure_push(model: Model) -> float:
    """A third of the largest load that the plant can bear; 0 where it has none."""
    load = model.kind.signals.load
    if load is None or {"jack.area", "supply.pressure"} <= model.values.keys():
        return 0.3 * model["jack.area"] * model["supply.pressure"] if load else 0.0
    return 5e-3 * load.largest if math.isfinite(load.largest) else 0.0


def list_experiments(model: Model) -> tuple[Experiment, ...]:
    """Those that the plant can make: it may have no end stop, and no load."""
    return tuple(e for e in EXPERIMENTS if (not e.is_loaded or _measure_push(model))
                 and (e.build is not _build_stops or model.kind.signals.command.limit))


EXPERIMENTS = (
    Experiment("steps", "steps of a tenth and of six tenths of the stroke", _build_steps),
    Experiment("ramps", "ramps as slow as 1.5 % of the stroke a second", _build_ramps),
    Experiment("sweep", "a sine sweep from 0.5 to 20 Hz of 3 % of the stroke", _build_sweep),
    Experiment("stops", "a command 10 % beyond both end stops, held there for 0.8 s", _build_stops),
    Experiment("load", "steps under a known force, a third of the largest, pushing and pulling (column load)",
               _build_steps, is_loaded=True),
)


def advise_experiments(model: Model, free: Sequence[Free], problem: ScaledProblem, fit: Fit | None,
                       unseen: Sequence[str]) -> Iterator[Advice]:
    """For each parameter that is not identifiable the candidate run that would show it best.

    Args:
        model: the fitted one.
        free: all unknowns, those that the present runs do not show as well.
        problem: the present runs.
        fit: what they gave; None where they gave nothing.
        unseen: the parameters to learn.
    """
    x = scale_values(free, model.values)
    present = replace(problem, model=silence_readings(model), steps=STEPS, bare=None, _lanes={})
    present_information = np.diag(weigh_priors(free))
    if fit is not None:
        present_information = present_information + _measure_information(present, free, x)
    information = {}
    for experiment in list_experiments(model):
        com = experiment.build(model)
        part = np.arange(len(com)) / len(com)
        force = _measure_push(model) * experiment.is_loaded
        load = force * (((part > 0.2) & (part < 0.45)).astype(float) - ((part >= 0.45) & (part < 0.7)))
        run = replace(present, trace=_simulate(model, com, load, problem.trace.outputs), also=(), _lanes={})
        information[experiment.name] = present_information + _measure_information(run, free, x)
    what = {e.name: e.what for e in EXPERIMENTS}
    outputs = model.kind.signals.outputs
    missing = [s for s in outputs if s.name not in problem.trace.outputs]
    if missing and fit is not None and all(s.noise for s in outputs):
        runs = [_simulate(model, t.command, t.load, problem.trace.output_names) for t in (problem.trace, *problem.also)]
        noise = tuple(white_noise(model[s.noise]) for s in outputs)
        sensor_problem = replace(present, trace=runs[0], also=tuple(runs[1:]), noise=noise, _lanes={})
        information["sensors"] = np.diag(weigh_priors(free)) + _measure_information(sensor_problem, free, x)
        what["sensors"] = f"the same runs with {' and '.join(s.symbol for s in missing)} measured"
    shares = {name: _compute_shares(free, matrix) for name, matrix in information.items()}
    for name in unseen:
        share, best = min((shares[experiment][name], experiment) for experiment in shares)
        choice, words = (best, what[best]) if share <= IDENTIFIABLE_SHARE else (None, "")
        yield Advice(name, choice, words, share)


def _simulate(model: Model, com: Floats, load: Floats, outputs: Sequence[str]) -> Trace:
    return simulate_trace(Lanes(silence_readings(model), (), STEPS), np.empty(0), com, load, tuple(outputs))


def _measure_information(problem: ScaledProblem, free: Sequence[Free], x: Floats) -> Floats:
    """What runs tell of scaled unknowns at `x` (p,): the matrix (p, p) of their slopes' products."""
    low, high = scaled_bounds(free)
    steps = np.array([DIFFERENCE / f.scale if isinstance(f, LogFree) else DIFFERENCE for f in free])
    steps = np.where(x + steps > high, -steps, steps)
    white = problem.compute_white_residuals(free, np.vstack([x, np.clip(x + np.diag(steps), low, high)]))
    jacobian = remove_slope((white[1:] - white[0]) / steps[:, None, None], problem.find_flat(free, x))
    rows = jacobian.reshape(len(free), -1)
    return rows @ rows.T


def _compute_shares(free: Sequence[Free], information: Floats) -> dict[str, float]:
    """Of half its range, the half width of each parameter's interval."""
    covariance = np.linalg.pinv(information)
    shares = {}
    for k, f in enumerate(free):
        slope = _find_slope(free, k)
        spread = IDENTIFIED_INTERVAL_FACTOR * float(np.sqrt(slope @ covariance @ slope))
        shares[f.name] = INTERVAL_95_SD * float(np.hypot(spread, get_systematic_sd(f.name))) / (f.scale * f.prior)
    return shares


def _find_slope(free: Sequence[Free], k: int) -> Floats:
    """Of the logarithm of parameter k, or of its value, by the scaled unknowns, (p,)."""
    slope = np.zeros(len(free))
    slope[k] = free[k].scale
    if isinstance(f := free[k], LogFrictionRatio):
        dynamic = [each.name for each in free].index(f.leader)
        slope[dynamic] = free[dynamic].scale
    return slope


BEGINNING_NOISE = (30.0, 6.0)  # factors on the noise
LAST_STEPS = 50  # solver steps a cycle, of the last rounds; of a plant without balances at least its own: a lag looks
# shorter by half a step, and no tolerance allows for it
OPEN_MISFIT = 4.0  # -2 log likelihood by which a parameter may go to the end of its range and still not be seen


class Estimate(NamedTuple):
    """A free parameter, SI: the data sheet's value and range, the value found and its 95 % interval."""

    name: str
    unit: str
    before: float
    least: float
    most: float
    value: float
    low: float
    high: float
    is_identifiable: bool
    share: float  # of the range that the interval takes up; of logarithms where the range is relative

    @property
    def is_at_bound(self) -> bool:
        """Whether the interval reaches an end of the range: the data may want to go further."""
        near = 1e-9 * (self.most - self.least)
        return self.is_identifiable and (self.low <= self.least + near or self.high >= self.most - near)


class RunError(NamedTuple):
    """RMS residual of each signal in one run, SI, with the data sheet's model and with the identified one."""

    source: Source
    is_held_out: bool
    before: Mapping[str, float]
    after: Mapping[str, float]
    typical: Mapping[str, float]  # after, without the worst blocks
    floor: Mapping[str, float]
    decided: Mapping[str, float]  # after, without the rows that no model can predict
    undecided: float = 0.0  # share of these rows; 0 for a fitted run without an observer

    @property
    def ratio(self) -> float:
        """Error of the worst signal over its noise floor, after."""
        return max(self.after[s] / self.floor[s] for s in self.after)

    @property
    def decided_ratio(self) -> float:
        """The same without the rows that no model can predict, if enough others are left."""
        is_left = self.undecided <= HELD_OUT_UNDECIDED_SHARE
        return max(self.decided[s] / self.floor[s] for s in self.decided) if is_left else self.ratio


class Correlation(NamedTuple):
    """Two parameters whose errors go together."""

    first: str
    second: str
    value: float


@dataclass(frozen=True, eq=False)
class Identification:
    """What an identification found."""

    verdict: str  # IDENTIFIED, PARTLY, UNEXPLAINED, CANNOT_TELL
    reason: str  # why, where the verdict is not IDENTIFIED
    before: Model  # of the data sheet
    model: Model  # with what was found as its design
    estimates: tuple[Estimate, ...]
    controller: ControllerGains | None
    correlations: tuple[Correlation, ...]  # of identifiable parameters, the strongest first
    advice: tuple[Advice, ...]
    errors: tuple[RunError, ...]
    floor: Mapping[str, float]
    runs: tuple[Trace, ...]  # prepared; the held-out ones last
    residuals: tuple[tuple[Floats, Floats], ...]  # of each run, (s, n) SI: before and after, model minus measured
    sources: tuple[Source, ...]
    notes: tuple[str, ...]

    @property
    def holdouts(self) -> tuple[RunError, ...]:
        """The errors on held-out runs."""
        return tuple(e for e in self.errors if e.is_held_out)


class Settled(NamedTuple):
    """A fit taken to its end, and what it leaves of the runs."""

    problem: ScaledProblem
    fit: Fit
    hidden: Mapping[str, tuple[float, float, float]]  # of `find_hidden`
    model: Model  # with what was found as its design
    errors: tuple[RunError, ...]
    residuals: tuple[tuple[Floats, Floats], ...]

    @property
    def worst_fitted(self) -> float:
        """Error over the noise floor, in the worst signal of the worst run of the fit."""
        return max(e.decided_ratio for e in self.errors if not e.is_held_out)


def identify_model(model: Model, ranges: Sequence[Range], fitted_runs: Sequence[Trace], held_out_runs: Sequence[Trace],
                   sources: Sequence[Source], seed: int = 0, progress: Progress = ignore_progress,
                   workers: int | None = None) -> Identification:
    """Fit the free parameters of a model to runs of one actuator.

    Args:
        model: with the values of the data sheet.
        ranges: of the free parameters.
        fitted_runs: prepared for replay, each with the outputs that were measured in it.
        held_out_runs: those that no fit sees, prepared.
        sources: of all of them, in this order.
        seed: of the scattered starts.
        progress: called with each stage and the share done, 0 to 1.
        workers: threads; default one a core.
    """
    runs = (*fitted_runs, *held_out_runs)
    fitted_runs = [leave_out_rest(t, model) for t in fitted_runs]
    notes = [f"{source.file}: {note}" for trace, source in zip((*fitted_runs, *held_out_runs), sources, strict=True)
             for note in trace.notes]
    floors = [sensor_floors(t, model, compute_residuals(t, replay_current(t, model))) for t in fitted_runs]
    floor = {s: float(np.median([f[s].value for f in floors if s in f])) for s in fitted_runs[0].output_names
             if any(s in f for f in floors)}
    if not any(_moves(t) for t in fitted_runs):
        controlled, least = model.kind.signals.controlled, MOVING_RAM * fitted_runs[0].scale
        reason = (f"no run to fit moves the {controlled.phrase} by {least * controlled.shown_scale:g} "
                  f"{controlled.shown_unit}: at rest nothing can be identified")
        return _tell_nothing(model, ranges, runs, sources, len(fitted_runs), floor, reason, notes)
    gains = read_controller(fitted_runs) if model.kind.controller else None
    free = list_unknowns(model, tuple(ranges))
    parts, remarks = cut_long_runs(fitted_runs, sources, model, floor)
    problem = make_problem(model, parts, floor, workers or count_threads())
    notes += remarks

    def settle(problem: ScaledProblem, fit: Fit) -> Settled:
        progress("which parameters the runs show", 0.65)
        hidden_values = find_hidden(problem, fit, {r.name: r for r in ranges})
        problem, fit = hold_parameters(problem, fit, {name: value for name, (value, _, _) in hidden_values.items()})
        progress("last fits, with finer steps", 0.7)
        problem, fit = finish(problem, fit, seed, progress)
        progress("judging", 0.92)
        fitted_model = build_model(model, problem, fit, gains)
        return Settled(problem, fit, hidden_values, fitted_model,
                       *measure_errors(model, fitted_model, runs, sources, len(fitted_runs), floor))

    best = settle(problem, fit_from_afar(problem, free, seed, progress))
    if model.kind.correct is not None and best.worst_fitted > FITTED_RUN_WORST:
        progress("fitting the beginnings of motions", 0.6)
        parts, _ = cut_long_runs([leave_out_rest(t, model, memory=0.0) for t in runs[:len(fitted_runs)]], sources,
                                 model, floor)
        begin = fit_beginnings(make_problem(best.model, parts, floor, problem.workers), free, floor)
        best = min(best, settle(*begin), key=lambda each: each.worst_fitted)
    problem, fit, hidden_values, fitted_model, errors, residuals = best
    estimates, covariance = estimate_parameters(model, ranges, fit, hidden_values)
    if model.kind.correct is None and not model.values.keys() >= BALANCED and any(
            e.share > 0.25 * IDENTIFIABLE_SHARE for e in estimates if e.name not in hidden_values):
        # a valley along which parameters make up for each other may bend, which slopes do not see
        ends = profile_ranges(problem, fit, (IDENTIFIED_INTERVAL_FACTOR * INTERVAL_95_SD) ** 2)
        estimates = tuple(take_profile(e, *ends[e.name]) if e.name in ends else e for e in estimates)
    verdict, reason = decide_verdict(estimates, errors)
    progress("which runs would show more", 0.95)
    unseen = [e.name for e in estimates if not e.is_identifiable]
    advice = (advise_experiments(fitted_model, list_unknowns(model, tuple(ranges)), problem, fit, unseen) if unseen
              else ())
    return Identification(verdict, reason, model, fitted_model, estimates, gains,
                          list_correlations(estimates, covariance), tuple(advice), errors, floor, runs,
                          residuals, tuple(sources), tuple(notes))


def cut_long_runs(runs: Sequence[Trace], sources: Sequence[Source], model: Model, floor: Mapping[str, float]
                  ) -> tuple[tuple[Trace, ...], list[str]]:
    """The runs to fit, of long ones the part that says most about the parameters; and which part that is, in words.

    Args:
        runs: prepared for replay.
        sources: of them, in this order.
        model: with the values of the data sheet.
        floor: of each signal, SI.
    """
    parts, remarks = [], []
    for trace, source in zip(runs, sources, strict=False):
        if can_be_cut(trace, model):
            excerpt = choose_excerpt(trace, silence_readings(model), floor)
            remarks.append(f"{source.file}: {excerpt.describe(trace)}")
            trace = cut_excerpt(trace, excerpt)
        parts.append(trace)
    return tuple(parts), remarks


class ScaledProblem(LogProblem):
    """The runs of an actuator of any size, which show less of it than those of a healthy unit of a known one."""

    def find_flat(self, free: Sequence[Free], x: Floats) -> Floats:
        if not self.model.values.keys() >= BALANCED:
            return np.empty((len(free), 0))
        return find_flat_directions(self, free, x, self._list_ways(free, x))

    def widen_covariance(self, fit: Fit) -> Floats:
        """The covariance of a fit, (p, p), also along what no signal shows near it.

        A larger piston moves alike at a lower pressure, as long as that is not at the supply's: without P12 the slopes
        know area, flow gain and leakage only by the roughness of the misfit. A fit must not move along this direction.
        """
        leaking, *_ = self._list_ways(fit.free, fit.x)
        pressing = {"jack.area": 1.0, "valve.flow_gain": 1.0, "jack.leakage": 2.0 + leaking.get("jack.leakage", 0.0)}
        every = find_flat_directions(self, fit.free, fit.x, (pressing,), PRIORS_KNOW_MORE_MISFIT)
        more = every[:, find_flat_directions(self, fit.free, fit.x).shape[1]:]
        prior_information = np.sum((more.T / [f.prior for f in fit.free]) ** 2, axis=1)  # by what is known beforehand
        return np.asarray(fit.covariance + (more / prior_information) @ more.T)

    def _list_ways(self, free: Sequence[Free], x: Floats) -> tuple[Mapping[str, float], ...]:
        """Directions in which an actuator of another size may change beside those of a healthy unit: powers by name."""
        v = {**self.model.values, **self.list_values(free, x)}
        leaking = {"valve.pressure_gain": 1.0}
        if v["jack.leakage"] > 0.0:  # only 1/GP + CLK/GQ counts
            leaking["jack.leakage"] = v["valve.flow_gain"] / (v["valve.pressure_gain"] * v["jack.leakage"])
        flapper = {"flapper.travel": -1.0, "flapper.stiffness": 1.0, "flapper.damping": 1.0,
                   "flapper.inertia": 1.0, "pilot.flow_gain": 1.0, "pilot.pressure_gain": 1.0}
        sticking = {"pilot.pressure_gain": 1.0, "spool.static_friction": 1.0, "spool.dynamic_friction": 1.0}
        turning = {"flapper.inertia": 1.0}  # its time constant, JF/BF, is 25 us: slopes by it are the solver's
        return leaking, flapper, sticking, turning


def make_problem(model: Model, runs: Sequence[Trace], floor: Mapping[str, float], workers: int) -> ScaledProblem:
    """The runs to fit with white noise of the floor's size; a signal that a run lacks counts nothing in it."""
    noise = tuple(white_noise(level) for level in floor.values())
    first, *others = (replace(t, outputs=tuple(floor)) for t in runs)
    return ScaledProblem(silence_readings(model), first, noise, workers=workers, also=tuple(others))


def find_hidden(problem: ScaledProblem, fit: Fit, ranges: Mapping[str, Range]
                ) -> dict[str, tuple[float, float, float]]:
    """Free parameters that no run shows, with the value nearest to the data sheet's, and the values that fit as well.

    An end stop that the ram never met may be anywhere beyond the furthest position. A fit that stands at an end already
    is tried some way inside: what changes there is seen, and only its range is too narrow.
    """
    places = [(k, r) for k, f in enumerate(fit.free) if (r := ranges.get(f.name)) is not None
              and type(f) is not LogFrictionRatio]
    trials = [fit.x]
    for k, _ in places:
        f = fit.free[k]
        low, high = ((end - f.centre) / f.scale for end in (f.low, f.high))
        near, inside = 1e-3 * (high - low), IDENTIFIABLE_SHARE * 0.5 * (high - low)
        trials.append(put_unknown(fit.x, k, low if fit.x[k] - low > near else low + inside))
        trials.append(put_unknown(fit.x, k, high if high - fit.x[k] > near else high - inside))
    costs = compute_misfit(problem.compute_white_residuals(fit.free, np.array(trials)))
    is_open = (np.abs(costs[1:] - costs[0]) < OPEN_MISFIT).reshape(-1, 2)
    hidden_values = {}
    for (k, r), (below, above) in zip(places, is_open.tolist(), strict=True):
        if below or above:
            f = fit.free[k]
            low = r.low if below else _find_edge(problem, fit, k, f.low)
            high = r.high if above else _find_edge(problem, fit, k, f.high)
            hidden_values[f.name] = (min(max(r.centre, low), high), low, high)
    for k, f in enumerate(fit.free):
        if isinstance(f, LogFrictionRatio) and f.leader in hidden_values:  # it moved as well, and no signal changed
            ratio = f.value(float(fit.x[k]))
            least, most = (ranges[f.name].low, ranges[f.name].high) if f.name in ranges else (0.0, math.inf)
            value, low, high = (min(max(ratio * each, least), most) for each in hidden_values[f.leader])
            hidden_values[f.name] = value, low, high
    return hidden_values


def _find_edge(problem: ScaledProblem, fit: Fit, k: int, end: float, rounds: int = 3, parts: int = 15) -> float:
    """The value of unknown k, SI, between a fit that is well and the `end` of its range where it is not, that divides
    both."""
    f = fit.free[k]
    good, bad = float(fit.x[k]), (end - f.centre) / f.scale
    for _ in range(rounds):
        line = np.linspace(good, bad, parts + 1)
        costs = compute_misfit(problem.compute_white_residuals(
            fit.free, np.array([fit.x, *(put_unknown(fit.x, k, place) for place in line)])))
        indices = np.flatnonzero(costs[1:] - costs[0] >= OPEN_MISFIT)
        if not len(indices):
            break
        first = max(int(indices[0]), 1)
        good, bad = float(line[first - 1]), float(line[first])
    return f.value(good)


def hold_parameters(problem: ScaledProblem, fit: Fit, fixed_values: Mapping[str, float]) -> tuple[ScaledProblem, Fit]:
    """The problem and the fit without some unknowns, which keep the values in `fixed_values`."""
    if not fixed_values:
        return problem, fit
    places = [k for k, f in enumerate(fit.free) if f.name not in fixed_values]
    values = limit_friction_values({**problem.model.values, **fixed_values})
    return (replace(problem, model=replace(problem.model, values=values), _lanes={}),
            start_fit([fit.free[k] for k in places], fit.x[places]))


def count_last_steps(model: Model) -> int:
    """Solver steps a cycle of the last rounds."""
    return LAST_STEPS if model.values.keys() >= BALANCED else max(LAST_STEPS, model.steps)


def finish(problem: ScaledProblem, fit: Fit, seed: int = 0, progress: Progress = ignore_progress
           ) -> tuple[ScaledProblem, Fit]:
    """The last rounds, with finer steps; then with the noise that is left, where only noise is left."""
    fine = replace(problem, steps=count_last_steps(problem.model), _lanes={})
    fit = descend(fine, fit, ((1.0, 8),))
    if not is_fitted(fit):
        fit = search_other_valleys(fine, fit, seed, progress)
    progress("last rounds", 0.9)
    fit = polish_fit(fine, fit, seed)
    size = np.sqrt(np.nanmean(fit.residuals**2, axis=1))
    if (size <= RESIDUAL_HELD_OUT * np.array([n.level for n in fine.noise])).all():
        learnt = tuple(fit_noise(r) if s > 0.0 else old  # a signal that the model gives exactly tells none
                       for r, s, old in zip(fit.residuals, size, fine.noise, strict=True))
        fine = replace(fine, noise=learnt, _lanes={})
        fit = descend(fine, fit, ((1.0, 5),))
    if not fit.free:
        return fine, fit
    if problem.model.values.keys() >= BALANCED:  # its directions that no run shows are known
        return fine, replace(fit, covariance=fine.widen_covariance(fit))
    # of an actuator whose laws of similarity nobody has declared it seems known by a jump at a stop
    coarse, flat = replace(fine, steps=problem.steps, _lanes={}), np.empty((len(fit.free), 0))
    return fine, replace(fit, covariance=estimate_smooth_covariance(coarse, fit, flat))


def fit_beginnings(problem: ScaledProblem, free: Sequence[Free], floor: Mapping[str, float]
                   ) -> tuple[ScaledProblem, Fit]:
    """A fit from the model's own values that takes in the beginnings of motions, as far as they are decided.

    With an observer a fit first leaves them out: how a motion begins hangs on dry friction, and is soon forgotten. But
    only there it shows what rings, and of a test in short steps little else is left.

    Args:
        problem: all rows of motion.
        free: the unknowns.
        floor: of each signal, SI.
    """
    fit = start_fit(free, scale_values(free, problem.model.values))
    for factor in BEGINNING_NOISE:
        schedule = ((factor, FIT_ROUNDS),)
        fit = descend(problem, fit, schedule)
        fit = descend(problem, profile_unknowns(scale_noise(problem, factor), fit), schedule)
    at = problem.model.replace(problem.list_values(free, fit.x))
    runs = [leave_out_rows(t, find_undecided_rows(Problem(at, t, problem.noise, steps=count_last_steps(at)),
                                                  start_fit((), np.empty(0)), floor))
            for t in (problem.trace, *problem.also)]
    decided = replace(problem, trace=runs[0], also=tuple(runs[1:]), _lanes={})
    return decided, descend(decided, fit, ((1.0, FIT_ROUNDS),))


def build_model(model: Model, problem: ScaledProblem, fit: Fit, gains: ControllerGains | None) -> Model:
    """The model whose nominal values are those that were found."""
    values = problem.list_values(fit.free, fit.x)
    fixed_values = {n: v for n, v in problem.model.values.items() if v != model.values.get(n)
                    and not n.startswith("sensors.") and n not in values}
    noise = {problem.trace.declared.find(s).noise: n.level
             for s, n in zip(problem.trace.outputs, problem.noise, strict=True)}
    gain_values = {} if gains is None else gains.values
    new_values = {n: float(f"{v:.6g}") for n, v in {**fixed_values, **values, **gain_values, **noise}.items()
                  if n in model.values}
    complete = limit_friction_values({**model.values, **new_values})
    nominal = model.kind.nominal
    names = {n for n in nominal if n in model.values and model.values[n] != nominal[n]}
    names |= {n for n in new_values if n.partition(".")[0] in model.kind.parameters}
    return replace(model, values=complete, design={n: complete[n] for n in model.list_names() if n in names})


def estimate_parameters(model: Model, ranges: Sequence[Range], fit: Fit,
                        hidden_values: Mapping[str, tuple[float, float, float]]) -> tuple[tuple[Estimate, ...], Floats]:
    """The free parameters with their intervals, and the correlation matrix of them; hidden ones have no correlation."""
    free = fit.free
    names = [f.name for f in free]
    values = dict(zip(names, compute_values(free, fit.x).tolist(), strict=True))
    slopes = np.array([_find_slope(free, names.index(r.name)) if r.name in names else np.zeros(len(free))
                       for r in ranges])
    covariance = slopes @ fit.covariance @ slopes.T
    spread = np.sqrt(np.diag(covariance))
    estimates = []
    for i, r in enumerate(ranges):
        if r.name in hidden_values:
            value, low, high = hidden_values[r.name]
            estimates.append(Estimate(r.name, r.unit, model[r.name], r.low, r.high, value, low, high, False, 1.0))
            continue
        value = values[r.name]
        factor, systematic = IDENTIFIED_INTERVAL_FACTOR * float(spread[i]), get_systematic_sd(r.name)
        if not r.is_relative:
            systematic *= abs(value)
        half = INTERVAL_95_SD * float(np.hypot(factor, systematic))
        low, high = (value * np.exp(-half), value * np.exp(half)) if r.is_relative else (value - half, value + half)
        least, most = min(r.low, value), max(r.high, value)  # a static friction goes with the dynamic one, also beyond
        low, high = (min(max(float(end), least), most) for end in (low, high))
        share = half / r.half_width
        estimates.append(Estimate(r.name, r.unit, model[r.name], r.low, r.high, value, low, high,
                                  share <= IDENTIFIABLE_SHARE, min(share, 1.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num(covariance / np.outer(spread, spread))
    return tuple(estimates), correlation


def take_profile(e: Estimate, low: float, high: float) -> Estimate:
    """The estimate with the range of its profile, SI; an interval that slopes call narrow keeps what it holds."""
    low, high = (min(low, e.low), max(high, e.high)) if e.is_identifiable else (low, high)
    share = math.log(high / low) / math.log(e.most / e.least) if e.least > 0.0 else (high - low) / (e.most - e.least)
    return e._replace(low=low, high=high, share=min(share, 1.0), is_identifiable=share <= IDENTIFIABLE_SHARE)


def list_correlations(estimates: Sequence[Estimate], matrix: Floats, least: float = 0.9) -> tuple[Correlation, ...]:
    """The pairs of parameters, but for hidden ones, that go together by at least so much."""
    pairs = [Correlation(a.name, b.name, float(matrix[i, j])) for i, a in enumerate(estimates)
             for j, b in enumerate(estimates[:i]) if abs(matrix[i, j]) >= least]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair.value)))


def measure_errors(before: Model, after: Model, runs: Sequence[Trace], sources: Sequence[Source], fitted_count: int,
                   floor: Mapping[str, float]) -> tuple[tuple[RunError, ...], tuple[tuple[Floats, Floats], ...]]:
    """The error of each run with both models, the first `fitted_count` being those of the fit; and the residuals, SI.

    Where a replay has an observer, no fit saw the beginning of a motion: here it counts as far as it is decided.
    """
    errors, residuals = [], []
    for number, (trace, source) in enumerate(zip(runs, sources, strict=True)):
        trace = leave_out_rest(trace, after, memory=0.0)
        noise = tuple(white_noise(1.0) for _ in trace.outputs)
        first, last = (Problem(silence_readings(model), trace, noise, steps=count_last_steps(model))
                       for model in (before, after))
        residual_pair = [problem.compute_residuals((), np.empty((1, 0)))[0] for problem in (first, last)]
        sizes = [{s: rms(r) for s, r in zip(trace.outputs, each, strict=True)} for each in residual_pair]
        floors = {s: floor[s] for s in trace.outputs}
        decided, share, judged_residual = sizes[1], 0.0, residual_pair[1]
        is_seen = number < fitted_count and after.kind.correct is None
        if not is_seen and _moves(trace) and not is_long(trace):  # nine replays of a long one take too much memory
            undecided = find_undecided_rows(last, start_fit((), np.empty(0)), floors)
            share = float(undecided.mean())
            if 0.0 < share < 1.0:
                decided = {s: rms(r[~undecided]) for s, r in zip(trace.outputs, residual_pair[1], strict=True)}
            if after.kind.correct is not None:
                judged_residual = residual_pair[1][:, ~undecided]
        typical = dict(zip(trace.outputs, compute_typical_rms(judged_residual).tolist(), strict=True))
        errors.append(RunError(source, number >= fitted_count, sizes[0], sizes[1], typical, floors, decided, share))
        residuals.append((residual_pair[0], residual_pair[1]))
    return tuple(errors), tuple(residuals)


def decide_verdict(estimates: Sequence[Estimate], errors: Sequence[RunError]) -> tuple[str, str]:
    """The verdict, and the reason for any but IDENTIFIED."""
    worse = [e for e in errors if any(e.typical[s] > RESIDUAL_HELD_OUT * e.floor[s] for s in e.typical)
             or e.decided_ratio > RESIDUAL_WORST]
    if worse:
        worst = max(worse, key=lambda e: e.decided_ratio)
        kind = "held-out run" if worst.is_held_out else "run"
        residual = f"{worst.decided_ratio:.3g} noise floors of the {kind} {worst.source.file}"
        return "UNEXPLAINED", f"the best parameters leave {residual}"
    unseen = [e.name for e in estimates if not e.is_identifiable]
    if len(unseen) == len(estimates):
        return "CANNOT_TELL", "these runs show none of the free parameters by itself"
    if unseen:
        return "PARTLY", f"these runs do not show {len(unseen)} of {len(estimates)} free parameters"
    worst = max((e for e in errors if not e.is_held_out), key=lambda e: e.decided_ratio)
    if worst.decided_ratio > FITTED_RUN_WORST:
        return "PARTLY", (f"single stops in {worst.source.file} come at the wrong moment "
                          f"({worst.decided_ratio:.3g} noise floors over all of the run), so frictions and gains may "
                          "be off by more than their intervals")
    return "IDENTIFIED", ""


def _moves(trace: Trace) -> bool:
    return float(np.nanmax(trace.controlled) - np.nanmin(trace.controlled)) >= MOVING_RAM * trace.scale


def _tell_nothing(model: Model, ranges: Sequence[Range], runs: Sequence[Trace], sources: Sequence[Source],
                  fitted_count: int, floor: Mapping[str, float], reason: str, notes: Sequence[str]) -> Identification:
    """The answer where no run to fit moves the ram."""
    estimates = tuple(Estimate(r.name, r.unit, model[r.name], r.low, r.high, r.centre, r.low, r.high, False, 1.0)
                      for r in ranges)
    errors, residuals = measure_errors(model, model, runs, sources, fitted_count, floor)
    advice = advise_experiments(model, list_unknowns(model, tuple(ranges)), make_problem(model, runs[:1], floor, 1),
                                None, [r.name for r in ranges])
    return Identification("CANNOT_TELL", reason, model, model, estimates, None, (), tuple(advice), errors, floor,
                          tuple(runs), residuals, tuple(sources), tuple(notes))


def write_identified_model(identification: Identification, path: str | Path, command: str = "", date: str = ""
                           ) -> Path | None:
    """Write the model file; return where the file that was there before is now, None if there was none.

    Args:
        identification: of the actuator.
        path: the file.
        command: what the user typed.
        date: of today, as text.

    Raises:
        InputError: a file that cannot be written.
    """
    intervals = {e.name: Value(e.value, e.low, e.high, e.unit) for e in identification.estimates if e.is_identifiable}
    errors = identification.errors
    origin: dict[str, str | list[str]] = {
        "verdict": identification.verdict, "date": date,
        "runs": [e.source.file for e in errors if not e.is_held_out],
        "runs_sha256": [e.source.sha256 for e in errors if not e.is_held_out],
        "holdouts": [e.source.file for e in errors if e.is_held_out],
        "holdouts_sha256": [e.source.sha256 for e in errors if e.is_held_out],
        "not_identifiable": [e.name for e in identification.estimates if not e.is_identifiable]}
    provenance = Provenance(name_software(), (command,) if command else (), floor=identification.floor,
                            signals=tuple(identification.floor), identification=origin)
    unseen = {e.name: f"not identifiable from the runs, {e.low:.3g} .. {e.high:.3g}" for e in identification.estimates
              if not e.is_identifiable}
    return replace_text(path, format_model_file(identification.model, intervals, provenance, unseen))


class ControllerGains(NamedTuple):
    """The proportional law, answer = gain * error up to a limit, and how well it holds."""

    gain: float  # drive for each unit of the error
    limit: float | None  # of the drive; None where the answer never stayed at its largest value
    exact: float  # share of the rows in which it holds

    @property
    def is_proportional(self) -> bool:
        """Whether this is the law: else the gains of the model are left alone."""
        return self.exact > 0.95

    @property
    def values(self) -> Mapping[str, float]:
        """Parameters of the model, SI; none if this is not the law."""
        parameters = {"controller.proportional_gain": self.gain, "controller.current_limit": self.limit}
        return {name: value for name, value in parameters.items() if value is not None and self.is_proportional}


def read_controller(runs: Sequence[Trace], tolerance: float = 1e-3, fewest_rows: int = 20) -> ControllerGains | None:
    """The law of the controller that was at work in some runs; None where its error or its answer is always zero.

    Args:
        runs: with command, controlled signal and drive.
        tolerance: of an answer, as a share of the largest one, up to which the law holds.
        fewest_rows: at the largest answer, from which on that is the limit.
    """
    error = np.concatenate([t.command - t.controlled for t in runs])
    answer = np.concatenate([t.drive for t in runs])
    is_known = np.isfinite(error) & np.isfinite(answer)
    error, answer = error[is_known], answer[is_known]
    largest = float(np.abs(answer).max(initial=0.0))
    is_inside = (np.abs(answer) < 0.99 * largest) & (np.abs(error) > 0.0) & (np.abs(answer) > 0.0)
    if not is_inside.any():
        return None
    ratio, weight = answer[is_inside] / error[is_inside], np.abs(error[is_inside])
    order = np.argsort(ratio)
    gain = float(ratio[order][np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())])  # weighted median
    residual = np.abs(answer - np.clip(gain * error, -largest, largest))
    at_limit = int((np.abs(answer) > (1.0 - 1e-9) * largest).sum())
    return ControllerGains(gain, largest if at_limit >= fewest_rows else None,
                           float((residual <= tolerance * largest).mean()))
