"""The sizes of the faults from a replay of the measured drive, with all that differs between healthy units.

Free are the faults (of the paper's: Kintas, FSS and, as a nuisance, FDS, which follows FSS), the base parameters with
their tolerances as priors, and suspects: what else ages or is set up wrongly, such as jack friction, leakage, a null
bias, or a load that nobody measured. The effect of a suspect is then not blamed on a fault. A loss of pilot flow gain
within its tolerance looks like a clogged filter, so the tolerances decide how wide the intervals are.

All unknowns but the suspects that may be negative are logarithms: the plant's gains, forces and frictions scale, and
what may be scaled together without changing a signal is a straight line in logarithms.

What else is wrong is searched for with each effect of the catalogue beside the faults: a fault that was found first
would take up what belongs to the effect, and the other way round. Scan, fits and charges are those of `rig explain`.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, product, zip_longest
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from fdi.comparison.jack import P12
from fdi.diagnosis.faults import CLOGGING, FAULTS, Estimate, Fault, Level, compute_severity, judge_size
from fdi.discovery.explain import drop_duplicates, find_marks, sort_by_cost, takes_fair_share
from fdi.discovery.explain_runs import list_fitted_parameters
from fdi.discovery.search import Hypothesis, Prospect, list_compatible_effects, scan_effects
from fdi.estimation import (
    FLAPPER,
    ORIGINS,
    POWERS,
    UNREPLAYED,
    Excerpt,
    Fit,
    Free,
    LogFree,
    LogFrictionRatio,
    LogOpenFilter,
    LogProblem,
    PowerFree,
    Problem,
    Value,
    choose_excerpt,
    complete_model,
    compute_misfit,
    compute_typical_rms,
    compute_weights,
    descend,
    descend_valley,
    estimate_smooth_covariance,
    find_flat_directions,
    find_undecided_rows,
    find_unpredictable_rows,
    follow_profile,
    get_power,
    guess_anchor_noise,
    guess_covariance,
    is_friction,
    judge_on_all,
    leave_out_rows,
    linearise_across,
    list_all_unknowns,
    list_directions_of_faults,
    list_effect_unknowns,
    measure_decided_errors,
    noise as noises,
    replay_fit,
    scale_noise,
    scaled_bounds,
    search_widely,
    silence_readings,
    span_all_rows,
    start_fit,
    take_logarithm,
)
from fdi.progress import Progress, Stage, ignore_progress
from fdi.thresholds import (
    CONVERGED_GAIN,
    FAULT_BLAMED_SHARE,
    FITTED_RUN_WORST,
    FRICTION_UNCERTAINTY,
    GAIN_CONVINCES,
    GAIN_TIE,
    GAIN_WORTH_A_FIT,
    INTERVAL_95_SD,
    LINEAR_FAULT_SPREAD,
    NARROWEST_SHARE,
    PRIORS_KNOW_MORE_MISFIT,
    RESIDUAL_HELD_OUT,
    RESIDUAL_HOPELESS,
    RESIDUAL_HOPELESS_VALVE,
    RESIDUAL_IS_NOISE,
    RESIDUAL_WORST,
    SUSPECT_COSINE,
    UNIT_TOLERANCE,
    WEIGHT_COUNTS,
)
from fdi.trace import Floats, Trace, rms
from plant import Model, ensure_starts, find_quantity, is_offered, list_searched_effects, map_in_threads, require
from plant.effects import CATALOGUE
from plant.threads import R, T

SMALLEST_SHARE = 0.01  # of the healthy size, bound of a fit by logarithms
Sizes = tuple[float, ...]  # one for each fault, SI
# values of starts: shapes of effects, what does not follow a fault, bias and load; parameter to SI value
Way = tuple[Mapping[str, float], Mapping[str, float], Mapping[str, float]]
# (factor on the noise, rounds): small stops of the ram count only once the fit is near
NOISE_SCHEDULE = ((30.0, 4), (6.0, 4), (1.0, 8))
FINE_STEPS = 20  # solver steps a cycle of the last fit
# The valley that many faults share is long, bent and rough: a fit stops in it until its steps begin anew as wide as
# at first. Stopped too early, its sizes are off by several of its standard deviations.
POLISH = ((3.0, 4), (1.0, 12), (1.0, 12), (1.0, 12))
RATIO_SPREAD = 0.03  # prior standard deviation of the logarithm of static over dynamic friction of the ram


# ---------------------------------------------------------------------------------------------------------------------
# What a fit may change
# ---------------------------------------------------------------------------------------------------------------------

class Suspect(NamedTuple):
    """Something else that ages or is set up wrongly: its parameter, and how far off it may be."""

    effect: str
    parameter: str
    spread: float  # prior standard deviation, as wide as what is typical: SI, or of the logarithm
    is_ratio: bool = False  # True: of the logarithm


SUSPECTS = (
    Suspect("jack_friction", "jack.dynamic_friction", 0.5, True),
    Suspect("viscous_drag", "jack.damping", 0.7, True),
    Suspect("moving_mass", "jack.mass", 0.5, True),
    Suspect("internal_leakage", "jack.leakage", 2.0, True),
    Suspect("null_bias", "null_bias.current", 1.6e-4),
    Suspect("constant_load", "constant_load.force", 3e3),
)


def get_positive(model: Model, name: str) -> float:
    """A parameter of the model, bounded below by 0.1 % of its nominal value, as a logarithm needs it.

    Raises:
        InputError: it is 0 in this actuator, so a fault of it is of another one.
    """
    value = max(model[name], 1e-3 * model.nominal.get(name, model[name]))
    require(value > 0.0, "--faults", name, f"faults of the model {model.name}, of which this parameter is 0")
    return value


def list_unknowns(model: Model, faults: Sequence[Fault] = FAULTS, fault_spread: float = 150.0) -> tuple[Free, ...]:
    """What a fit may change: the faults first, then the suspects, then the tolerances.

    `fault_spread` is the prior standard deviation of the faults in tolerances: they may be of any size, and where no
    signal shows them, this is what is known.
    """
    fault_unknowns = [u for fault in faults for u in _make_fault_unknowns(fault, model, fault_spread)]
    suspects = [_make_suspect(s, model) for s in list_suspects(model, faults)]
    names = {f.name for f in (*fault_unknowns, *suspects)}
    ratio: list[Free] = []
    if "jack.dynamic_friction" in names and "jack.static_friction" not in names:
        usual = math.log(get_positive(model, "jack.static_friction") / get_positive(model, "jack.dynamic_friction"))
        ratio = [LogFrictionRatio("jack.static_friction", usual, RATIO_SPREAD, 1.0, 0.0, usual + 1.0, 0.3)]
        names.add("jack.static_friction")
    tolerances = (take_logarithm(f) for f in list_all_unknowns(model) if f.name not in names)
    return (*fault_unknowns, *suspects, *ratio, *tolerances)


def _make_fault_unknowns(fault: Fault, model: Model, spread: float) -> list[Free]:
    """A fault's size and what follows it as unknowns.

    What is lost from a whole goes by the logarithm of what is left, a parameter of the plant of which a healthy unit
    has some by its own logarithm, and any other is linear, in units of MidBand.
    """
    low, high = fault.range
    if ORIGINS.get(fault.parameter) == 1.0:
        return [LogOpenFilter(fault.parameter, math.log(1.0 - fault.healthy), UNIT_TOLERANCE, spread,
                              math.log(1.0 - high), math.log(1.0 - low), 1.0)]
    if fault.parameter in POWERS:
        power = POWERS[fault.parameter]
        healthy, middle = fault.healthy**power, fault.place_size(fault.limits[1]) ** power
        return [PowerFree(fault.parameter, healthy, abs(middle - healthy), LINEAR_FAULT_SPREAD, low**power, high**power,
                          0.02)]
    if not _is_scaled(fault):
        healthy, middle, _ = fault.limits
        factors = {fault.parameter: 1.0, **fault.follow}
        return [Free(name, by * fault.healthy, abs(by) * (middle - healthy), LINEAR_FAULT_SPREAD,
                     min(by * low, by * high), max(by * low, by * high), 0.02) for name, by in factors.items()
                ] + [u._replace(prior=2.0) for u in _list_shapes(fault, model)]
    least = max(low, SMALLEST_SHARE * fault.healthy)
    unit = find_quantity(fault.parameter, plant=model.plant).unit

    def take_bounds(name: str) -> tuple[float, float]:  # of what follows, too, where it is of the same kind
        by = 1.0 if find_quantity(name, plant=model.plant).unit == unit else fault.follow[name]
        return math.log(by * least), math.log(by * high)

    # The ram stops a few times in a test, and its static friction alone makes or misses some of these stops: its ratio
    # to the dynamic one is known. The spool stops in every cycle of stick-slip, and both of its frictions are free.
    if fault.parameter == "jack.static_friction" and list(fault.follow) == ["jack.dynamic_friction"]:
        dynamic, by = next(iter(fault.follow.items()))
        followers: list[Free] = [LogFrictionRatio(dynamic, math.log(by), RATIO_SPREAD, 1.0, -1.0, 0.0, 0.3)]
    else:
        followers = [LogFree(name, math.log(get_positive(model, name)), UNIT_TOLERANCE, spread, *take_bounds(name), 1.0)
                     for name in fault.follow]
    name = fault.parameter
    return [LogFree(name, math.log(get_positive(model, name)), UNIT_TOLERANCE, spread, *take_bounds(name), 1.0),
            *followers]


def _list_shapes(fault: Fault, model: Model) -> list[Free]:
    """What a fit of the fault's effect frees beside its size, such as a phase, known to be of its starts' size."""
    effect = {e.name: e for e in model.kind.list_effects()}.get(fault.parameter.partition(".")[0])
    if effect is None or effect.base or not effect.starts or fault.parameter not in effect.fitted:
        return []  # without starts nothing is known of a phase or the like, which then keeps its value
    return [u for u in list_effect_unknowns(effect, model) if u.name not in fault.parameters]


def list_suspects(model: Model, faults: Sequence[Fault]) -> list[Suspect]:
    """The suspects that this plant can have and that are not among the faults."""
    fault_parameters = {name for fault in faults for name in fault.parameters}
    return [s for s in SUSPECTS if s.parameter not in fault_parameters and (
        model.nominal.get(s.parameter, 0.0) > 0.0 if s.is_ratio else is_offered(CATALOGUE[s.effect], model.kind))]


def _make_suspect(s: Suspect, model: Model) -> Free:
    unknown = next(u for u in list_effect_unknowns(model.find_effect(s.effect), model) if u.name == s.parameter)
    if s.is_ratio:
        usual = get_positive(model, s.parameter)
        return LogFree(s.parameter, math.log(usual), s.spread, 1.0, math.log(0.05 * usual), math.log(100.0 * usual),
                       0.02)
    return unknown._replace(centre=model.values.get(s.parameter, unknown.centre), scale=s.spread, prior=1.0, step=0.02)


def make_start(free: Sequence[Free], faults: Sequence[Fault], sizes: Sequence[float],
               offsets: Mapping[str, float] | None = None, stays: Mapping[str, float] | None = None) -> Floats:
    """Scaled unknowns, (p,), of a plant that has faults of these sizes and `offsets`, and is nominal otherwise.

    What follows a fault goes with it, but not beyond its value in `stays`.
    """
    unknowns = {f.name: f for f in free}
    values: dict[str, float] = dict(offsets or {})
    for fault, size in zip(faults, sizes, strict=True):
        unknown = unknowns[fault.parameter]
        size = fault.range[0] if isinstance(unknown, LogOpenFilter) and size < fault.range[0] else size
        values[unknown.name] = place_value(unknown, size)
        for name, by in fault.follow.items():
            if not isinstance(unknowns[name], LogFrictionRatio):
                value = max(size, math.exp(unknown.low)) / (1.0 / by) if isinstance(unknown, LogFree) else by * size
                values[name] = place_value(unknowns[name], min(value, (stays or {}).get(name, math.inf)))
    return np.array([(values.get(f.name, f.centre) - f.centre) / f.scale for f in free])


def place_value(f: Free, value: float) -> float:
    """The number of which the unknown `f` makes a parameter's value, within its bounds below."""
    if isinstance(f, LogOpenFilter):
        return max(math.log(1.0 - min(value, 1.0 - 1e-12)), f.low)
    if isinstance(f, PowerFree):
        return float(value ** POWERS[f.name])
    return math.log(max(value, math.exp(f.low))) if isinstance(f, LogFree) else value


def list_coarse_starts(faults: Sequence[Fault]) -> list[Sizes]:
    """Sizes from which fits begin: all pairs of faults in coarse steps, the other faults as in a healthy unit.

    Of two faults every size is paired with every one of the other; of more, two of each.
    """
    ladders = [_list_ladder(fault) for fault in faults]
    if len(faults) <= 2:
        return list(product(*ladders))
    healthy = tuple(fault.healthy for fault in faults)
    return [healthy, *((*healthy[:i], size, *healthy[i + 1:]) for i, ladder in enumerate(ladders) for size in ladder),
            *((*healthy[:i], a, *healthy[i + 1:j], b, *healthy[j + 1:])
              for i, j in combinations(range(len(faults)), 2)
              for a, b in product(_pick_two(ladders[i]), _pick_two(ladders[j])))]


def _list_ladder(fault: Fault) -> list[float]:
    """Sizes of a fault in coarse steps: by a factor where a healthy unit has some, else by parts of MidBand."""
    if _is_scaled(fault) and not fault.falls:
        return [x for x in fault.healthy * 1.4 ** np.arange(-1.0, 10.0) if x <= fault.range[1]]
    healthy, middle, most = fault.limits
    ways = (-1.0, 1.0) if fault.both_ways else (1.0,)
    way = -1.0 if fault.falls else 1.0
    parts = [0.0, 0.48, 0.96, 1.44, 1.92]
    while parts[-1] < 1.3 * (most - healthy) / (middle - healthy):  # until well beyond MaxBand
        parts.append(parts[-1] * 4.0 / 3.0)
    sizes = [fault.healthy + way * side * part * (middle - healthy) for side in ways for part in parts]
    return [x for x in dict.fromkeys(sizes) if fault.range[0] <= x <= fault.range[1]]


def _is_scaled(fault: Fault) -> bool:
    """Whether a size grows by factors: one of the plant itself of which a healthy unit has some, and no share."""
    return (fault.healthy > 0.0 and fault.range[0] >= 0.0 and ORIGINS.get(fault.parameter) != 1.0
            and fault.parameter.partition(".")[0] not in {**CATALOGUE.list_all(), **CATALOGUE.of_plants})


def _pick_two(ladder: Sequence[float]) -> list[float]:
    return [ladder[(len(ladder) + 1) // 2], ladder[-1]]


# ---------------------------------------------------------------------------------------------------------------------
# The fit
# ---------------------------------------------------------------------------------------------------------------------

@dataclass(frozen=True, eq=False)
class Refinement:
    """What the refinement found."""

    faults: tuple[Fault, ...]
    sizes: Mapping[str, Estimate]  # by fault
    correlations: Floats  # (f, f) of the faults
    others: Mapping[str, Estimate]  # the suspects by parameter, SI
    fit: Fit
    errors: Mapping[str, float]  # RMS residual by signal, SI
    floor: Mapping[str, float]  # RMS noise by signal, SI
    simulations: int
    everywhere: Mapping[str, float] = field(default_factory=dict)  # of a long recording: typical error over noise
    worst: float = RESIDUAL_WORST  # error over noise that a few stops of the ram may leave

    @property
    def correlation(self) -> float:
        """The strongest correlation of two sizes; 0 for a single fault."""
        pairs = self.correlations[np.triu_indices(len(self.faults), 1)]
        return float(pairs[np.argmax(np.abs(pairs))]) if len(pairs) else 0.0

    @property
    def ratio(self) -> dict[str, float]:
        """Error over noise by signal; 1 where nothing but noise is left."""
        return {name: self.errors[name] / self.floor[name] for name in self.errors}

    @property
    def is_explained(self) -> bool:
        """Whether only noise is left, except for a few stops of the ram that the model makes or misses."""
        usual = compute_typical_rms(self.fit.residuals)
        near = all(min(float(t), self.errors[name]) <= RESIDUAL_IS_NOISE * self.floor[name]
                   for t, name in zip(usual, self.floor, strict=True))
        near &= all(ratio <= RESIDUAL_HELD_OUT for ratio in self.everywhere.values())
        return near and max(self.ratio.values()) <= self.worst


@dataclass
class CountedProblem(LogProblem):
    """A problem that counts the runs it makes, knows static friction by its ratio, and which faults are looked for."""

    faults: tuple[Fault, ...] = FAULTS
    counts: list[int] = field(default_factory=list)  # shared by the problem's copies and threads

    @property
    def fault_parameters(self) -> set[str]:
        """The parameters of the faults, and those that follow."""
        return {name for fault in self.faults for name in fault.parameters}

    def find_flat(self, free: Sequence[Free], x: Floats) -> Floats:
        """Directions (p, k) at `x` (p,) that no signal shows, with what of the effects and of the faults goes along."""
        ways = list_directions_of_faults(self.list_values(free, x))
        fault_ways = [way for way in ways if next(iter(way)) in self.fault_parameters]
        return find_flat_directions(self, free, x, (FLAPPER, *fault_ways), allowed=PRIORS_KNOW_MORE_MISFIT)

    def predict_signals(self, names: Sequence[str], values: Floats, trace: Trace | None = None) -> Floats:
        self.counts.append(len(values))
        return super().predict_signals(names, values, trace)


def make_problem(model: Model, trace: Trace, floor: Mapping[str, float] | None = None, workers: int = 2,
                 faults: Sequence[Fault] = FAULTS) -> CountedProblem:
    """The model with faults and suspects ready in it, and the run to compare it with; `floor` RMS noise by signal, SI.
    """
    level = {name: floor[name] if floor else model[trace.declared.find(name).noise] for name in trace.outputs}
    effects = [*(s.effect for s in list_suspects(model, faults) if not model.find_effect(s.effect).base),
               *(name.partition(".")[0] for fault in faults for name in fault.parameters)]
    ready = silence_readings(model).with_effects(effects)
    noise = tuple(noises.white_noise(level[name]) for name in trace.outputs)
    return CountedProblem(ready, trace, noise, workers=workers, faults=tuple(faults))


def choose_size_excerpt(model: Model, trace: Trace, floor: Mapping[str, float], progress: Progress = ignore_progress,
                        faults: Sequence[Fault] = FAULTS) -> Excerpt:
    """The part of a long recording that says most about the faults, the suspects and the tolerances."""
    problem = make_problem(model, trace, floor, faults=faults)
    changes = [*(fault.list_changes(fault.place_size(fault.limits[1])) for fault in faults),
               *({f.name: f.value(1.0)} for f in (_make_suspect(s, model) for s in list_suspects(model, faults)))]
    return choose_excerpt(trace, problem.model, floor, changes, progress)


def refine_sizes(model: Model, trace: Trace, starts: Sequence[Sizes] | None = None,
                 floor: Mapping[str, float] | None = None, workers: int = 2, whole: Trace | None = None,
                 progress: Progress = ignore_progress, faults: Sequence[Fault] = FAULTS) -> Refinement:
    """Fault sizes by least squares from the best of some starts.

    Args:
        model: the plant as it left the works.
        trace: the run, prepared for replay.
        starts: one size for each fault, SI, in each; default a coarse grid.
        floor: RMS noise by signal, SI; default the model's sensors.
        workers: threads.
        whole: the recording that `trace` was cut from: the fit is judged on it.
        progress: called with the stage and the share of a diagnosis that is done.
        faults: what to estimate.
    """
    stage = Stage(progress, "refinement", 0.3, 0.97, 44)  # rounds from two starts; one begun again takes twice as many
    problem = replace(make_problem(model, trace, floor, workers, faults), stage=stage)
    free = list_unknowns(problem.model, faults)
    if problem.model.kind.correct is not None:
        problem = _allow_observer_noise(problem, free)
    last = _fit_coarsely(problem, free, starts or list_coarse_starts(faults))
    problem = learn_left_noise(problem, last)
    for _ in range(2 if problem.model.kind.correct is not None else 0):  # an observer's stops hang on the noise
        problem = _leave_out_stops(problem, last)
        last = _fit_finely(problem, last)
        if is_noise_left(problem, last):
            break
    else:
        last = _fit_finely(problem, last)
    if len(faults) > 2:  # of fewer, the start from a healthy unit is the only one that lacks a fault
        last = _retry_without(problem, last)
    if problem.faults != FAULTS:
        last = polish_fit(problem, last)
        problem = replace(problem, steps=problem.model.steps, _lanes={})
    return report_fit(last, problem, None if whole is trace else whole)


def _fit_coarsely(problem: CountedProblem, free: Sequence[Free], starts: Sequence[Sizes]) -> Fit:
    """A fit from the best start and, if that blames a fault, one from a healthy unit: whichever leaves less."""
    begin = [choose_start(problem, free, starts)]
    if problem.model.kind.correct is not None:  # what hangs on a stop there draws the fit to the wrong size
        undecided = find_undecided_rows(problem, replay_fit(problem, start_fit(free, begin[0]), begin[0]),
                                        list_floors(problem))
        problem = replace(problem, trace=leave_out_rows(problem.trace, undecided), _lanes={})
    alone = problem.alone
    healthy = make_healthy_start(problem, free)
    if _blames_a_fault(problem, free, begin[0]):
        begin.append(healthy)
    fits = map_in_threads(lambda x: descend(alone, start_fit(free, x), NOISE_SCHEDULE), begin, problem.workers)
    if len(fits) == 1 and (not is_noise_left(problem, fits[0]) or _blames_a_fault(problem, free, fits[0].x)):
        fits.append(descend(problem, start_fit(free, healthy), NOISE_SCHEDULE))
    best = min(fits, key=lambda f: f.cost)
    return best if is_noise_left(problem, best) else descend(problem, best, ((3.0, 4), (1.0, 8)))


def _allow_observer_noise(problem: CountedProblem, free: Sequence[Free]) -> CountedProblem:
    """The problem with what an observer makes of the controlled signal's noise in the other signals, of a healthy unit.

    The observer takes that noise for a speed, and the replayed speed has it, too.
    """
    trace, floor, controlled = problem.trace, list_floors(problem), problem.trace.declared.controlled.name
    names = [f.name for f in free]
    values = problem.convert_unknowns(free, make_healthy_start(problem, free)[None])
    for noise in guess_anchor_noise(trace, problem.model, floor):
        noisy_problem = replace(problem, trace=trace.with_columns({controlled: trace.controlled + noise}), _lanes={})
        changes = compute_typical_rms((noisy_problem.predict_outputs(names, values)
                                       - problem.predict_outputs(names, values))[0])
        floor |= {s: math.hypot(floor[s], float(by)) for s, by in zip(trace.outputs, changes, strict=True)
                  if s != controlled}
    return replace(problem, noise=tuple(noises.white_noise(floor[s]) for s in trace.outputs), _lanes={})


def _leave_out_stops(problem: CountedProblem, fit: Fit) -> CountedProblem:
    """The problem without the rows that hang on a stop of the plant: what they say of its parameters is chance."""
    whole, floor = replay_fit(problem, fit, fit.x), list_floors(problem)
    slight = {name: math.sqrt(RESIDUAL_IS_NOISE**2 - 1.0) * level for name, level in floor.items()}
    rows = find_undecided_rows(problem, whole, slight)  # less than the noise each, they add to the residual as well
    large = find_unpredictable_rows(problem, whole, floor)
    candidates = (rows | large, rows, large if large.any() else find_undecided_rows(problem, whole, floor))
    runs = (leave_out_rows(problem.trace, rows) for rows in candidates)
    return replace(problem, trace=next((run for run in runs if run is not problem.trace), problem.trace), _lanes={})


def list_floors(problem: Problem) -> dict[str, float]:
    """RMS noise by signal, SI."""
    return {s: n.level for s, n in zip(problem.trace.outputs, problem.noise, strict=True)}


def _fit_finely(problem: CountedProblem, first: Fit) -> Fit:
    """The fit with finer steps, until only noise is left or no start on the way to a healthy unit would help."""
    fine = replace(problem, steps=FINE_STEPS, _lanes={})
    last = first
    for rounds in (4, 8):
        last = descend_valley(fine, last, rounds, problem.find_flat(first.free, last.x), problem.stage)
        if is_noise_left(problem, last):
            return last
    for parts in ((1.0, 0.5), (0.75, -0.25), (0.25, 1.25)):
        ratios = zip(problem.trace.outputs, measure_ratios(problem, last), strict=True)
        if is_noise_left(problem, last) or any(x > find_hopeless_ratio(problem.trace, s) for s, x in ratios):
            break
        last = _restart_fit(problem, last, parts)
    return last


def _restart_fit(problem: CountedProblem, fit: Fit, parts: Sequence[float], rounds: int = 8) -> Fit:
    """The best of a fit and some that begin elsewhere on the line to a unit with these faults and no other deviation.

    `parts` of that line lie between the fit, 0, and the other unit, 1. Stops of the ram make ridges: tolerances that
    lie behind one of them are found from the other side, or never.
    """
    free, home, alone = fit.free, place_home(problem, fit), problem.alone

    def fit_from(part: float) -> Fit:
        coarse_fit = descend(alone, start_fit(free, fit.x + part * (home - fit.x)), NOISE_SCHEDULE)
        flat = alone.find_flat(free, coarse_fit.x)
        return descend_valley(replace(alone, steps=FINE_STEPS, _lanes={}), coarse_fit, rounds, flat, problem.stage)

    return min(fit, *map_in_threads(fit_from, parts, problem.workers), key=lambda f: f.cost)


def _retry_without(problem: CountedProblem, fit: Fit, most: int = 2) -> Fit:
    """The best of a fit and some that begin without one of the causes that it blames: one may stand for another.

    Without a fault they begin at the same unit, and where the fault looks like parameters of the plant, with these in
    its place; without a suspect, such as a null bias, at a unit with the same faults and no other deviation, and a
    fault that looks like the suspect in its place.
    """
    alone = problem.alone
    fine = replace(alone, steps=FINE_STEPS, _lanes={})

    def fit_from(starts: Floats) -> Fit:
        best = starts[int(np.argmin(problem.compute_costs(fit.free, starts)))]
        coarse_fit = descend(alone, start_fit(fit.free, best), NOISE_SCHEDULE[1:])
        return descend_valley(fine, coarse_fit, 8, alone.find_flat(fit.free, coarse_fit.x))

    suspects = [s.parameter for s in list_suspects(problem.model, problem.faults)]
    names = [f.name for f in fit.free]
    for _ in range(most):
        alike = find_alike(fit, [fault.parameter for fault in problem.faults], suspects)
        ways = [*list_directions_of_faults(problem.list_values(fit.free, fit.x)), *alike]
        sizes = {fault: fit.values[fault.parameter] for fault in problem.faults if _blames(fault, fit)}
        start_sets = []
        for name, x in ((fault.parameter, set_sizes(fit, fault, fault.healthy)) for fault in sizes):
            fault_ways = [way for way in ways if next(iter(way)) == name and way[name]]
            start_sets.append(np.array([x, *(slide_along(fit, way, name, x[names.index(name)]) for way in fault_ways)]))
        far = 0.2  # of what is typical
        active_suspects = [name for name, x in zip(names, fit.x, strict=True) if name in suspects and abs(x) > far]
        for fault, way in product(problem.faults, alike):
            name, suspect = way
            if name == fault.parameter and suspect in active_suspects:
                k = names.index(name)
                sizes[fault] = fit.free[k].value(float(slide_along(fit, way, suspect, 0.0)[k]))
        if active_suspects:
            start_sets += [_list_alone(problem, fit, fault, size) for fault, size in sizes.items()]
        best = min(map_in_threads(fit_from, start_sets, problem.workers), key=lambda f: f.cost, default=fit)
        if best.cost >= fit.cost:
            break
        fit = best
    return fit


def find_alike(fit: Fit, faults: Sequence[str], suspects: Sequence[str]) -> list[Mapping[str, float]]:
    """Directions along which a suspect looks like a fault, both by parameter; the fault is named first.

    A blocked nozzle shifts the null as a bias does; only where the flapper meets its stops do they differ, and a fit
    may end anywhere between the two.
    """
    names, slopes = [f.name for f in fit.free], fit.jacobian.reshape(len(fit.free), -1)
    products = (slopes * compute_weights(fit.white).reshape(-1)) @ slopes.T
    lengths, scales = np.sqrt(np.diag(products)), [f.scale for f in fit.free]
    pairs = [(names.index(fault), names.index(suspect)) for fault, suspect in product(faults, suspects)]
    return [{names[k]: scales[k], names[j]: -scales[j] * products[k, k] / products[j, k]} for k, j in pairs
            if abs(products[j, k]) > SUSPECT_COSINE * lengths[j] * lengths[k]]


def slide_along(fit: Fit, way: Mapping[str, float], name: str, to: float) -> Floats:
    """Scaled unknowns (p,) of a fit moved along a direction, within the bounds, until the unknown `name` is at `to`."""
    k = [f.name for f in fit.free].index(name)
    part = (to - fit.x[k]) * fit.free[k].scale / way[name]
    shift = np.array([get_power(way, f) * part / f.scale for f in fit.free])
    return np.clip(np.where(np.arange(len(shift)) == k, to, fit.x + shift), *scaled_bounds(fit.free))


def _list_alone(problem: CountedProblem, fit: Fit, fault: Fault, size: float) -> Floats:
    """Starts (m, p) at units without other deviations than this fault, of about that size, SI, or all the faults."""
    is_fault = [f.name in problem.fault_parameters for f in fit.free]
    is_own = [f.name in fault.parameters for f in fit.free]
    healthy = make_start(fit.free, problem.faults, [each.healthy for each in problem.faults])
    homes = [replace(fit, x=np.where(mask, fit.x, healthy)) for mask in (is_fault, is_own)]
    return np.array([set_sizes(home, fault, fault.healthy + part * (size - fault.healthy))
                     for home in homes for part in np.linspace(0.6, 1.6, 16)])


def polish_fit(problem: CountedProblem, fit: Fit) -> Fit:
    """The fit with the plant's own steps: coarser ones bias sizes that they resemble, such as a lag.

    Slopes are those of coarser steps, at a fifth of the time.
    """
    exact, coarse = (replace(problem, steps=steps, _lanes={}) for steps in (problem.model.steps, FINE_STEPS))
    flat = problem.find_flat(fit.free, fit.x)
    for factor, rounds in POLISH:
        start = replace(fit, covariance=guess_covariance(fit.free))
        fit = descend_valley(scale_noise(exact, factor), start, rounds, flat, problem.stage,
                             scale_noise(coarse, factor))
    return replace(fit, covariance=estimate_smooth_covariance(coarse, fit, flat))


def set_sizes(fit: Fit, fault: Fault, size: float) -> Floats:
    """Scaled unknowns (p,) of a fit with another size of one fault, within the bounds."""
    x, changes = fit.x.copy(), fault.list_changes(size)
    for k, f in enumerate(fit.free):
        if f.name in changes and not isinstance(f, LogFrictionRatio):
            x[k] = (min(max(place_value(f, changes[f.name]), f.low), f.high) - f.centre) / f.scale
    return x


def _blames(fault: Fault, fit: Fit) -> bool:
    return fault.measure_departure(fit.values[fault.parameter]) > FAULT_BLAMED_SHARE * fault.limits[1]


def _blames_a_fault(problem: CountedProblem, free: Sequence[Free], x: Floats) -> bool:
    """Whether scaled unknowns, (p,), hold one of the faults for far gone."""
    return any(_blames(fault, start_fit(free, x)) for fault in problem.faults)


def make_healthy_start(problem: CountedProblem, free: Sequence[Free]) -> Floats:
    """Scaled unknowns, (p,), of a unit without faults, with the bias and the load that the means show."""
    return make_start(free, problem.faults, [fault.healthy for fault in problem.faults], estimate_offsets(problem))


def place_home(problem: CountedProblem, fit: Fit) -> Floats:
    """Scaled unknowns, (p,), of a unit with a fit's faults and effects and no other deviation."""
    is_kept = [f.name in problem.fault_parameters or not np.isfinite(f.prior) for f in fit.free]
    return np.where(is_kept, fit.x, make_healthy_start(problem, fit.free))


def is_noise_left(problem: Problem, fit: Fit) -> bool:
    """Whether the fit leaves only noise."""
    return max(measure_ratios(problem, fit)) <= RESIDUAL_IS_NOISE


def measure_ratios(problem: Problem, fit: Fit) -> list[float]:
    """RMS residual over noise, signal by signal."""
    return [rms(r) / n.level for r, n in zip(fit.residuals, problem.noise, strict=True)]


def choose_start(problem: CountedProblem, free: Sequence[Free], starts: Sequence[Sizes]) -> Floats:
    """The start, (p,) scaled, with the smallest misfit, searched on ever finer grids around the best one."""
    loud = scale_noise(problem.alone, NOISE_SCHEDULE[0][0])
    known_offsets, faults = estimate_offsets(problem), problem.faults
    usual = {name: problem.model[name] for fault in faults for name in fault.follow}

    def try_starts(candidates: Sequence[Sizes], way: Way) -> tuple[float, Sizes, Floats]:
        shape, stays, offsets = way
        x = np.array([make_start(free, faults, s, {**offsets, **shape}, stays) for s in candidates])
        costs = compute_misfit(loud.compute_white_residuals(free, x))
        k = int(np.argmin(costs))
        return float(costs[k]), candidates[k], x[k]

    def search(way: Way) -> tuple[float, Floats]:
        cost, best, x = try_starts(starts, way)
        # of the two faults that are furthest gone
        indices = sorted(sorted(range(len(faults)), key=lambda i: -compute_severity(faults[i], best[i]))[:2])
        for part, factor in ((0.2, 1.2), (0.08, 1.08), (0.04, 1.03)):  # of MidBand, and of sizes by their logarithm
            around = []
            for steps in product(range(-2, 3), repeat=len(indices)):
                sizes = list(best)
                for i, step in zip(indices, steps, strict=True):
                    sizes[i] = _step_size(faults[i], best[i], step, part, factor)
                around.append(tuple(sizes))
            cost, best, x = try_starts(around, way)
        return cost, x

    # dynamic friction goes with the static one, or has stayed what it was; phases and the like as in effects' starts
    # of the paper's two faults none shifts the null; another may, and then there is no bias
    offsets: list[Mapping[str, float]] = [known_offsets, *([{}] if known_offsets and faults != FAULTS else [])]
    ways = product(_list_shape_starts(problem), ({}, usual) if usual else ({},), offsets)
    return min(map_in_threads(search, ways, problem.workers), key=lambda each: each[0])[1]


def _list_shape_starts(problem: CountedProblem) -> list[dict[str, float]]:
    """Values to begin at of what faults' effects have beside their size: one that has none is {}."""
    shape_starts: list[dict[str, float]] = [{}]
    for fault in problem.faults:
        names = [u.name for u in _list_shapes(fault, problem.model)]
        starts = problem.model.find_effect(fault.parameter.partition(".")[0]).starts if names else ()
        shapes = {tuple(start[name] for name in names): None for start in starts} or {(): None}
        shape_starts = [{**each, **dict(zip(names, shape, strict=True))} for each in shape_starts for shape in shapes]
    return shape_starts


def _step_size(fault: Fault, size: float, steps: int, part: float, factor: float) -> float:
    if _is_scaled(fault):
        return size * factor**steps
    healthy, middle, _ = fault.limits
    return min(max(size + steps * (part * (middle - healthy)), fault.range[0]), fault.range[1])


def estimate_offsets(problem: Problem) -> dict[str, float]:
    """Null bias, A, and load, N, from the means of current and pressure, as starts of a fit.

    The mean opening is the one that moves the ram as far as it moved; the rest of the mean current makes up for a bias.
    The mean pressure carries the load. Of a plant without metering edges nothing is known beforehand.
    """
    trace, p = problem.trace, problem.model.values
    if "valve.flow_gain" not in p:
        return {}
    way = 0.0
    for part in trace.parts or (span_all_rows(trace),):
        x = trace.controlled[part.first:part.stop]
        x = x[~np.isnan(x)]
        way += float(x[-1] - x[0])
    speed = way / (len(trace) * p["controller.period"])
    per_speed = p["jack.area"] / p["valve.flow_gain"] * p["feedback_spring.stiffness"] / p["torque_motor.gain"]
    offsets = {"null_bias.current": per_speed * speed - float(trace.drive.mean())}
    if P12 in trace.outputs:
        pressure = trace.mask_unusable(P12)
        offsets["constant_load.force"] = p["jack.area"] * float(np.nanmean(pressure)) - float(trace.load.mean())
    return offsets


def find_hopeless_ratio(trace: Trace, name: str) -> float:
    """RMS residual over noise above which a fit does not start again elsewhere; of the way of a valve it is less."""
    signal, controlled = trace.declared.find(name), trace.declared.controlled
    return RESIDUAL_HOPELESS_VALVE if signal.unit == controlled.unit and signal != controlled else RESIDUAL_HOPELESS


def learn_left_noise(problem: CountedProblem, fit: Fit) -> CountedProblem:
    """The problem with the noise that a fit leaves, signal by signal, where only noise is left."""
    return replace(problem, noise=tuple(
        noises.fit_noise(r) if rms(r) <= RESIDUAL_IS_NOISE * old.level else old
        for old, r in zip(problem.noise, fit.residuals, strict=True)), _lanes={})


def report_fit(last: Fit, problem: CountedProblem, whole: Trace | None = None) -> Refinement:
    """What a fit found, with the noise of its problem as the floor; judged on the `whole` recording if it is cut."""
    floor = list_floors(problem)
    errors = measure_decided_errors(problem, last, floor)
    names = [f.name for f in last.free]
    places = [names.index(fault.parameter) for fault in problem.faults]
    spread = np.sqrt(np.diag(last.covariance))[places]
    correlations = last.covariance[np.ix_(places, places)] / np.outer(spread, spread)
    sizes = {fault.name: estimate_parameter(last, fault.parameter, fault.interval_factor,
                                            _find_narrowest(last.free[k], float(last.x[k]), fault))
             for fault, k in zip(problem.faults, places, strict=True)}
    refinement = Refinement(problem.faults, sizes, correlations,
                            {s.parameter: estimate_parameter(last, s.parameter)
                             for s in list_suspects(problem.model, problem.faults)}, last, errors, floor,
                            sum(problem.counts))
    if refinement.is_explained:
        open_sizes = {fault.name: profile_size(problem.alone, last, fault) for fault in problem.faults
                      if np.ptp(sizes[fault.name][1:]) > 0.99 * np.ptp(fault.range)}
        refinement = replace(refinement, sizes={**sizes, **open_sizes}, simulations=sum(problem.counts))
    if whole is None or whole is problem.trace:
        return refinement
    judgement = judge_on_all(problem, [last], whole, FINE_STEPS)[0]
    return replace(refinement, errors=judgement.errors, everywhere=judgement.typical_ratio(refinement.floor))


def profile_size(problem: CountedProblem, fit: Fit, fault: Fault) -> Estimate:
    """The size of a fault by its profile: the healthiest of those that fit as well as the best, and the 95 % interval.

    Beyond some size a fault may change no signal further, and the slope there says nothing of the other sizes.
    """
    k = [f.name for f in fit.free].index(fault.parameter)
    fits = [each for end in scaled_bounds(fit.free) for each in follow_profile(
        problem, fit, k, float(end[k]), (fault.interval_factor * INTERVAL_95_SD) ** 2)]
    best = min(fits, key=lambda each: each.cost)
    alike = [each.values[fault.parameter] for each in fits if each.cost < best.cost + CONVERGED_GAIN]
    ends = [fit.free[k].value(x + way * _find_narrowest(fit.free[k], x, fault)) for x, way in (
        (float(min(each.x[k] for each in fits)), -1.0), (float(max(each.x[k] for each in fits)), 1.0))]
    return Estimate(min(alike, key=fault.measure_departure), *sorted(ends))


def _find_narrowest(f: Free, x: float, fault: Fault) -> float:
    """Half the narrowest interval of a fault's scaled unknown, at `x`."""
    healthy, middle, _ = fault.limits
    if is_friction(f.name):
        return FRICTION_UNCERTAINTY / f.scale
    if fault.parameter == CLOGGING.parameter:
        return 0.0  # the tolerances of the pilot gains make it six times as wide
    slope = 0.5 * abs(f.value(x + 1.0) - f.value(x - 1.0))
    return NARROWEST_SHARE * (middle - healthy) / max(slope, 1e-3 * (middle - healthy))


def estimate_parameter(fit: Fit, name: str, factor: float = 1.0, least: float = 0.0) -> Estimate:
    """A parameter with its 95 % interval, `factor` times as wide as the fit's covariance says, within its bounds.

    `least`: of the scaled unknown, half the narrowest interval.
    """
    i = [f.name for f in fit.free].index(name)
    half = max(factor * INTERVAL_95_SD * float(np.sqrt(fit.covariance[i, i])), least)
    low, high = sorted(fit.free[i].value(float(fit.x[i]) + way * half) for way in (-1.0, 1.0))
    return Estimate(fit.free[i].value(float(fit.x[i])), low, high)


def find_effects_beside(model: Model, trace: Trace, alone: Refinement, floor: Mapping[str, float],
                        progress: Progress = ignore_progress, workers: int = 2, whole: Trace | None = None) -> Beside:
    """The faults beside the other effects that a recording shows.

    Args:
        model: the unit as delivered.
        trace: the run, prepared for replay.
        alone: the faults fitted without another effect.
        floor: RMS noise by signal, SI.
        progress: called with each stage and the share done, 0 to 1.
        workers: threads.
        whole: the recording that `trace` was cut from: fits are judged on it.
    """
    marks, floor = _read_marks(model, whole or trace, floor)
    faults = alone.faults
    problem = make_problem(model, trace, floor, workers, faults)
    problem = replace(problem, bare=problem.model, model=complete_model(problem.model), _lanes={})
    for name in (e.name for e in list_searched_effects(model.plant) if e.fitted and e.port not in UNREPLAYED):
        ensure_starts(name, trace.command, trace.load, model.plant, problem.model.effects)  # where its file gives none
    search = JointSearch(problem, list_other_effects(model, faults), progress)
    hypotheses = search.find_explanations(alone.fit)
    return average_explanations([_explain(h, search.problem, whole) for h in hypotheses], marks)


def list_other_effects(model: Model, faults: Sequence[Fault] = FAULTS) -> list[str]:
    """The effects that are searched: all that a replay shows, but for those that every fit of the faults has."""
    fault_parameters = {name for fault in faults for name in fault.parameters}
    always = {*(s.effect for s in SUSPECTS), *model.effects}
    return [e.name for e in list_searched_effects(model.plant)
            if e.name not in always and e.port not in UNREPLAYED and e.starts and not fault_parameters & set(e.fitted)]


def _read_marks(model: Model, trace: Trace, floor: Mapping[str, float]
                ) -> tuple[dict[str, dict[str, Value]], dict[str, float]]:
    """Effects that are read off without noise, and the floors with the rounding of the position among them."""
    marks, floor = find_marks(model, [trace]), dict(floor)
    if marks.step and "quantisation" not in model.effects:
        controlled = trace.declared.controlled
        rounding_floor = float(np.hypot(model.values.get(controlled.noise, 0.0), marks.rounding))
        floor[controlled.name] = max(floor[controlled.name], rounding_floor)
    return {p.effect: {name: Value(*interval, find_quantity(name, plant=model.plant).unit)
                       for name, interval in p.parameters.items()} for p in marks.prints}, floor


def _explain(h: Hypothesis, problem: CountedProblem, whole: Trace | None) -> Explanation:
    values = {name: value for effect in h.effects
              for name, value in list_fitted_parameters(effect, h.fit, problem.model).items()}
    return Explanation(h.effects, values, replace(report_fit(h.fit, problem, whole), worst=FITTED_RUN_WORST))


# factor on the noise and generations of a search by a population
POPULATION_STAGES = ((100.0, 30), (30.0, 40), (6.0, 40), (1.0, 40))


class JointSearch:
    """The state of one search: the problem with its noise, and the effects to try beside the faults."""

    def __init__(self, problem: CountedProblem, effects: Sequence[str], progress: Progress) -> None:
        self.problem, self.effects, self.progress = problem, list(effects), progress

    def find_explanations(self, alone: Fit, most_effects: int = 2) -> list[Hypothesis]:
        """Fits with 0, 1 .. other effects that may be the answer, taken to the end with one noise.

        Fits are compared only when they have gone equally far: one that has just begun has the cost of the stops that
        it still misses, and a rival that has been fitted to the end beats it although it is wrong.
        """
        faults_alone = Hypothesis((), replace(alone, free=self.list_unknowns()), {})
        parents = self.continue_fits([faults_alone], ((1.0, 2),))
        hypotheses = self.deepen(parents)
        for count in range(1, most_effects + 1):
            self.progress(f"looking for effect {count} beside the faults", 0.3 * count - 0.1)
            is_enough = is_noise_left(self.problem, hypotheses[0].fit)
            children = [each for parent in parents for each in self.add_effects(parent, count, is_enough)]
            if not children:
                break
            parents = sort_by_cost(children)[:4]
            self.progress(f"fitting {', '.join(map(_describe, parents))} further", 0.3 * count)
            deep = sort_by_cost(self.deepen(parents))
            if count > 1 and not takes_fair_share(self.problem, sort_by_cost(hypotheses)[0], deep[0]):
                break
            hypotheses += deep
            if is_noise_left(self.problem, deep[0].fit):
                break
            parents = self.continue_fits(deep[:2], ((1.0, 2),))
        return self.finish(hypotheses)

    def list_unknowns(self) -> tuple[Free, ...]:
        """What the fits of the faults alone change."""
        return list_unknowns((self.problem.bare or self.problem.model), self.problem.faults)

    def continue_fits(self, hypotheses: Sequence[Hypothesis], schedule: Sequence[tuple[float, int]]
                      ) -> list[Hypothesis]:
        """The hypotheses after further rounds of their fits: see `descend`."""
        return self.map_alone(lambda h: replace(h, fit=self.descend(h.fit, schedule)), hypotheses)

    def deepen(self, hypotheses: Sequence[Hypothesis], rounds: int = 8) -> list[Hypothesis]:
        """The fits taken further with finer steps; while the best leaves more than noise, they also begin elsewhere."""
        fine = self._refine_steps()
        deep = fine.continue_fits(hypotheses, ((1.0, rounds),))
        if is_noise_left(self.problem, sort_by_cost(deep)[0].fit):
            return deep
        return self.map_alone(lambda h: fine.restart(h, (1.0,)) if fine.is_near(h) else h, deep)

    def _refine_steps(self) -> JointSearch:
        return JointSearch(replace(self.problem, steps=FINE_STEPS, _lanes={}), self.effects, self.progress)

    def add_effects(self, parent: Hypothesis, count: int, is_enough: bool) -> list[Hypothesis]:
        """The parent with one more effect each: the promising ones fitted; `is_enough`: the faults leave noise only."""
        fit, effects = parent.fit, list_compatible_effects(self.problem.model, self.effects, parent.effects)
        prospects = [self.scan(fit, effects, fit.cost)]
        if count == 1:
            # The forecast from a start that nobody has fitted is poor beside a finished fit. Where that fit leaves more
            # than noise, a fault may have made up for the effect in it, so both lists count, each by itself.
            afresh = self.start_afresh()
            prospects.append(self.scan(afresh, effects, fit.cost if is_enough else np.inf))
            if not is_enough:
                prospects.append(self.scan_with_more_noise(afresh, effects))
        mixed = [p for group in zip_longest(*prospects) for p in group if p is not None]  # the best of each in turn
        most = 8 if is_enough else 10
        worth = mixed[:most if count == 1 else 5]
        if not worth:
            return []
        self.progress(f"fitting {', '.join(dict.fromkeys(p.effect for p in worth))}", 0.3 * count - 0.05)
        # at the scan's linear forecast, with the noise first taken for larger
        starts = [Hypothesis((*parent.effects, p.effect), start_fit(p.free, p.x), {}) for p in worth]
        promising = sort_by_cost(self.continue_fits(starts, (NOISE_SCHEDULE[1], (1.0, 3))))[:4]
        return drop_duplicates(self.continue_fits(promising, ((3.0, 3), (1.0, 6))))

    def scan(self, fit: Fit, effects: Sequence[str], most: float) -> list[Prospect]:
        """The effects that promise to gain on this fit and to come below the cost `most`, best first."""
        least = min(fit.cost, most) - GAIN_WORTH_A_FIT
        return [p for p in scan_effects(self.problem, [fit], effects, self.problem.workers) if p.cost < least]

    def scan_with_more_noise(self, fit: Fit, effects: Sequence[str], factor: float = 30.0, rounds: int = 4
                             ) -> list[Prospect]:
        """The effects that promise to gain on this fit when the noise is taken for so many times as large.

        Priors then hold the tolerances, and stops of the ram that are made or missed hardly count: what is left is the
        course of the signals, in which an effect shows although no fit without it comes near them.
        """
        loud = JointSearch(scale_noise(self.problem, factor), effects, self.progress)
        return loud.scan(loud.descend(fit, ((1.0, rounds),)), effects, np.inf)

    def start_afresh(self) -> Fit:
        """A unit with the best sizes of the faults and no other deviation: an effect may lead fits astray."""
        free = self.list_unknowns()
        x = choose_start(self.problem, free, list_coarse_starts(self.problem.faults))
        return linearise_across(self.problem, replay_fit(self.problem, start_fit(free, x), x),
                                self.problem.alone.find_flat(free, x))

    def finish(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The likely ones to the end with finer steps, under the noise that the best one leaves."""
        ranking = sorted(hypotheses, key=_compute_charged_cost)
        near = 60.0 * GAIN_TIE  # such fits are not done: beginning again has gained a few hundred
        rivals = [h for h in ranking if h.cost < ranking[0].cost + near][:4]
        self.progress(f"last fits, {', '.join(map(_describe, rivals))}", 0.75)
        self.problem = learn_left_noise(self._refine_steps().problem, ranking[0].fit)
        last_fits = self.continue_fits(rivals, ((1.0, 8),))
        best = sort_by_cost(last_fits)[0]
        if len(best.effects) > 1:
            self.progress(f"last fits without one of {_describe(best)}", 0.85)
            last_fits += self.map_alone(partial(self._leave_out, best), best.effects)
        return self._search_other_valleys(self._begin_again(drop_duplicates(last_fits)))

    def _search_other_valleys(self, hypotheses: Sequence[Hypothesis], most: int = 2) -> list[Hypothesis]:
        """The fits, the likeliest of them also from searches by populations while none leaves only noise.

        Where static friction of the ram ends far off, no start on the way to a healthy unit leads out of that valley:
        the frictions have to move together (`fdi.estimation.fit`).
        """
        hypotheses = list(hypotheses)
        ranking = sorted(hypotheses, key=_compute_charged_cost)
        worst = 1.5  # times the least cost, above which no valley is looked for
        for h in [one for one in ranking if one.cost < worst * ranking[0].cost][:most]:
            if any(is_noise_left(self.problem, each.fit) for each in hypotheses):
                break
            self.progress(f"search of other valleys, {_describe(h)}", 0.95)
            hypotheses[hypotheses.index(h)] = _keep_best(h, self.map_alone(partial(self.search_widely, h.fit), (0, 1)))
        return hypotheses

    def search_widely(self, fit: Fit, seed: int, steps: int = 10) -> Fit:
        """The fit at which a population ends that begins at a unit with these faults and effects, otherwise healthy.

        The population takes so many solver steps a cycle; its end is fitted with those of the problem.
        """
        width = 0.1  # of a population's first trials along a friction of ram or spool, of its logarithm
        widths = np.array([width / f.scale if f.name.endswith("_friction") and f.name.startswith(("jack.", "spool."))
                           else 0.0 for f in fit.free])
        alone, home = self.problem.alone, replace(fit, x=place_home(self.problem, fit))
        end = search_widely(replace(alone, steps=steps), alone, home, widths, POPULATION_STAGES, seed)
        return self.descend(end, ((1.0, 8),))

    def _begin_again(self, hypotheses: Sequence[Hypothesis], most: int = 2) -> list[Hypothesis]:
        """The fits, the best of them also from other places; again as long as that changes which is best."""
        hypotheses, restarts = list(hypotheses), set[tuple[str, ...]]()
        while len(restarts) < most:
            best = min(hypotheses, key=_compute_charged_cost)
            if best.effects in restarts or not self.is_near(best):
                break
            restarts.add(best.effects)
            self.progress(f"another start, {_describe(best)}", 0.85 + 0.05 * len(restarts))
            hypotheses[hypotheses.index(best)] = self.restart(best, (1.0, 0.5))
        return hypotheses

    def _leave_out(self, h: Hypothesis, effect: str) -> Hypothesis:
        """The fit without one of its effects: the search may have needed it only to leave a local minimum."""
        names = set(self.problem.model.find_effect(effect).fitted)
        places = [k for k, f in enumerate(h.fit.free) if f.name not in names]
        start = start_fit([h.fit.free[k] for k in places], h.fit.x[places])
        return Hypothesis(tuple(e for e in h.effects if e != effect), self.descend(start, ((3.0, 4), (1.0, 8))), {})

    def is_near(self, h: Hypothesis) -> bool:
        """Whether a fit leaves so little that beginning again elsewhere may help."""
        return max(measure_ratios(self.problem, h.fit)) < RESIDUAL_HOPELESS

    def restart(self, h: Hypothesis, parts: Sequence[float]) -> Hypothesis:
        """The best of a fit and those from points on the line to a unit with its faults and effects, otherwise healthy.

        `parts` of that line lie between the fit, 0, and the other unit, 1.
        """
        way = place_home(self.problem, h.fit) - h.fit.x
        return _keep_best(h, self.map_alone(lambda part: self.descend(
            start_fit(h.fit.free, h.fit.x + part * way), ((6.0, 4), (1.0, 8))), parts))

    def descend(self, fit: Fit, schedule: Sequence[tuple[float, int]]) -> Fit:
        """The fit after rounds with the noise so many times as large: (factor, rounds) each."""
        return descend(self.problem.alone, fit, schedule)

    def map_alone(self, do: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """By all threads; each fit keeps to one of them."""
        return map_in_threads(do, items, self.problem.workers)


def _keep_best(h: Hypothesis, fits: Iterable[Fit]) -> Hypothesis:
    """The hypothesis with the best of its fit and some others."""
    return replace(h, fit=min(h.fit, *fits, key=lambda fit: fit.cost))


def _describe(h: Hypothesis) -> str:
    return " and ".join(h.effects) or "the faults alone"


@dataclass(frozen=True, eq=False)
class Explanation:
    """The faults fitted beside some other effects."""

    effects: tuple[str, ...]  # () for the faults alone
    parameters: Mapping[str, Value]  # of these effects, by name
    refinement: Refinement
    weight: float = 1.0  # probability among all explanations

    @property
    def cost(self) -> float:
        """-2 log likelihood."""
        return self.refinement.fit.cost

    @property
    def levels(self) -> dict[str, Level | None]:
        """Levels that this explanation alone would give, by fault."""
        faults, sizes = self.refinement.faults, self.refinement.sizes
        return {fault.name: judge_size(fault, sizes[fault.name], len(faults)) for fault in faults}


@dataclass(frozen=True, eq=False)
class Beside:
    """Explanations of a recording by the faults and other effects, with sizes averaged over them."""

    explanations: tuple[Explanation, ...]  # best first; those that are not much less likely than the best
    sizes: Mapping[str, Estimate]  # of the faults, by name, averaged
    marks: Mapping[str, Mapping[str, Value]]  # effects that leave a mark without noise, with their parameters
    disputed: tuple[str, ...]  # faults whose level depends on which explanation is right

    @property
    def best(self) -> Explanation:
        """The most likely one."""
        return self.explanations[0]

    @property
    def is_explained(self) -> bool:
        """Whether the best one leaves only noise."""
        return self.best.refinement.is_explained

    @property
    def effects(self) -> tuple[str, ...]:
        """Every effect that may be there, most likely first."""
        return tuple(dict.fromkeys([*self.marks, *(e for x in self.explanations for e in x.effects)]))

    @property
    def is_ambiguous(self) -> bool:
        """Whether the recording does not tell which of several effects is there."""
        return len(self.explanations) > 1


def average_explanations(candidates: Sequence[Explanation], marks: Mapping[str, Mapping[str, Value]] | None = None
                         ) -> Beside:
    """The explanations with their probabilities, and the sizes averaged over them.

    One that leaves more than noise does not count beside one that does not.
    """
    rivals = ([each for each in candidates if each.refinement.is_explained]
              or [min(candidates, key=_compute_charged_cost)])
    weights = weigh_costs([_compute_charged_cost(each) for each in rivals])
    pairs = sorted((pair for pair in zip(weights, rivals, strict=True) if pair[0] >= WEIGHT_COUNTS),
                   key=lambda pair: -pair[0])
    total = sum(weight for weight, _ in pairs)
    explanations = tuple(replace(e, weight=weight / total) for weight, e in pairs)
    faults = explanations[0].refinement.faults
    weights = [e.weight for e in explanations]
    sizes = {f.name: mix_estimates([e.refinement.sizes[f.name] for e in explanations], weights) for f in faults}
    return Beside(explanations, sizes, marks or {}, tuple(f.name for f in faults if _is_disputed(f, explanations)))


def weigh_costs(costs: Sequence[float]) -> list[float]:
    """Probabilities of explanations with these costs, -2 log likelihood with their charges.

    Within `GAIN_TIE` of the best they are equally likely: fits that end in rough valleys do not tell more.
    """
    likelihoods = [math.exp(-0.5 * min(max(cost - min(costs) - GAIN_TIE, 0.0), 700.0)) for cost in costs]
    return [each / sum(likelihoods) for each in likelihoods]


def _compute_charged_cost(e: Explanation | Hypothesis) -> float:
    """-2 log likelihood, and for each effect what it has to gain to be named."""
    return e.cost + GAIN_CONVINCES * len(e.effects)


def mix_estimates(estimates: Sequence[Estimate], weights: Sequence[float]) -> Estimate:
    """The mean of some estimates, and the 95 % interval of the mixture of their distributions.

    >>> mix_estimates([Estimate(0.2, 0.1, 0.3)], [1.0])
    Estimate(value=0.2, low=0.1, high=0.3)
    >>> [round(x, 2) for x in mix_estimates([Estimate(0.1, 0.0, 0.2), Estimate(0.5, 0.4, 0.6)], [0.5, 0.5])]
    [0.3, 0.02, 0.58]
    """
    if len(estimates) == 1:
        return estimates[0]
    centre = np.array([e.value for e in estimates])
    below, above = (np.array([max(abs(end - e.value), 1e-9 * abs(e.value) + 1e-300) / INTERVAL_95_SD
                              for end, e in zip(ends, estimates, strict=True)])
                    for ends in ([e.low for e in estimates], [e.high for e in estimates]))
    low, high = min(e.low for e in estimates), max(e.high for e in estimates)
    width = high - low
    grid = np.linspace(low - width, high + width, 4001)
    distance = grid[:, None] - centre
    share = ndtr(distance / np.where(distance < 0.0, below, above)) @ np.asarray(weights)
    ends = [float(np.interp(p, share, grid)) for p in (0.025, 0.975)]
    value = float(centre @ np.asarray(weights))
    return Estimate(value, max(min(ends[0], value), low), min(max(ends[1], value), high))


def _is_disputed(fault: Fault, explanations: Sequence[Explanation]) -> bool:
    """Whether explanations that contradict each other in the size give different levels."""
    def contradict(first: Explanation, second: Explanation) -> bool:
        a, b = first.refinement.sizes[fault.name], second.refinement.sizes[fault.name]
        return not b.low <= a.value <= b.high and not a.low <= b.value <= a.high

    return any(contradict(first, second) and first.levels[fault.name] != second.levels[fault.name]
               for first, second in combinations(explanations, 2))
