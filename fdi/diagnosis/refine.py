"""The sizes of the two faults from a replay of the measured current, with all that differs between healthy units.

Free are the faults (Kintas, FSS and, as a nuisance, FDS), the base parameters with their tolerances as priors, and
suspects: what else ages or is set up wrongly, such as jack friction, leakage, a null bias, or a load that nobody
measured. The effect of a suspect is then not blamed on the servovalve. A loss of pilot flow gain within its tolerance
looks like a clogged filter, so the tolerances decide how wide the intervals are.

All unknowns but the suspects that may be negative are logarithms: the plant's gains, forces and frictions scale, and
what may be scaled together without changing a signal is a straight line in logarithms.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, DYNAMIC, FAULTS, FRICTION, STATIC_OVER_DYNAMIC, Estimate
from fdi.estimation import noise as noises
from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Free, Problem, compute_misfit, compute_typical_rms, scale_noise, span_all_rows
from fdi.estimation.long_recordings import Excerpt, choose_excerpt, judge_on_all
from fdi.estimation.unidentifiable import (
    FLAPPER,
    LogFree,
    LogFrictionRatio,
    LogOpenFilter,
    LogProblem,
    descend_valley,
    find_flat_directions,
    guess_covariance,
    start_fit,
    take_logarithm,
)
from fdi.estimation.unknowns import list_all_unknowns, list_effect_unknowns, silence_readings
from fdi.progress import NO_STAGE, Progress, Stage, ignore_progress
from fdi.thresholds import (
    FAULT_BLAMED_SHARE,
    FSS_INTERVAL_FACTOR,
    INTERVAL_95_SD,
    PRIORS_KNOW_MORE_MISFIT,
    RESIDUAL_HELD_OUT,
    RESIDUAL_HOPELESS,
    RESIDUAL_IS_NOISE,
    RESIDUAL_WORST,
    UNIT_TOLERANCE,
)
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE
from plant.model import Model
from plant.threads import map_in_threads

Floats = NDArray[np.float64]

SMALLEST_FSS = 0.05  # N, bound of a fit
FAULT_PARAMETERS = (CLOGGING.parameter, FRICTION.parameter, DYNAMIC)
# (Kintas, FSS in N) from which fits begin, beside the grid's answers
COARSE_STARTS = tuple(product((0.0, 0.12, 0.24, 0.36, 0.48), 5.0 * 1.4 ** np.arange(-1.0, 10.0)))
# (factor on the noise, rounds): small stops of the ram count only once the fit is near
NOISE_SCHEDULE = ((30.0, 4), (6.0, 4), (1.0, 8))
FINE_STEPS = 20  # solver steps a cycle of the last fit
# powers of effects' parameters in the directions of `fdi.estimation.unidentifiable.FLAT`: pressures, spool
# forces, torques, and all that goes with the jack's area
EFFECT_POWERS: tuple[Mapping[str, float], ...] = (
    {"supply_droop.slope": -1.0},
    {"supply_droop.slope": 1.0, "flow_force.coefficient": 1.0},
    {},
    {"supply_droop.slope": -1.0, "compressibility.coefficient": 1.0, "aero_stiffness.stiffness": 1.0,
     "mount_compliance.compliance": -1.0, "mount_compliance.mass": 1.0},
)


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
    """A parameter of the model, bounded below by 0.1 % of its nominal value, as a logarithm needs it."""
    return max(model[name], 1e-3 * model.nominal[name])


def list_unknowns(model: Model, fault_spread: float = 150.0) -> tuple[Free, ...]:
    """What a fit may change: the faults first, then the suspects, then the tolerances.

    `fault_spread` is the prior standard deviation of the faults in tolerances: they may be of any size, and where no
    signal shows them, this is what is known.
    """
    clogging = LogOpenFilter(CLOGGING.parameter, 0.0, UNIT_TOLERANCE, fault_spread, math.log(1.0 - CLOGGING.largest),
                             0.0, 1.0)
    friction = [LogFree(name, math.log(get_positive(model, name)), UNIT_TOLERANCE, fault_spread,
                        math.log(SMALLEST_FSS), math.log(FRICTION.largest), 1.0)
                for name in ("spool.static_friction", DYNAMIC)]
    suspects = [_make_suspect(s, model) for s in SUSPECTS]
    usual = math.log(get_positive(model, "jack.static_friction") / get_positive(model, "jack.dynamic_friction"))
    ratio = LogFrictionRatio("jack.static_friction", usual, 0.03, 1.0, 0.0, usual + 1.0, 0.3)
    taken = {f.name for f in (clogging, *friction, *suspects, ratio)}
    tolerances = (take_logarithm(f) for f in list_all_unknowns(model) if f.name not in taken)
    return (clogging, *friction, *suspects, ratio, *tolerances)


def _make_suspect(s: Suspect, model: Model) -> Free:
    own = next(u for u in list_effect_unknowns(CATALOGUE[s.effect], model) if u.name == s.parameter)
    if s.is_ratio:
        usual = get_positive(model, s.parameter)
        return LogFree(s.parameter, math.log(usual), s.spread, 1.0, math.log(0.05 * usual), math.log(100.0 * usual),
                       0.02)
    usual = model.values.get(s.parameter, own.centre)
    return own._replace(centre=usual, scale=s.spread, prior=1.0, step=0.02)


def make_start(free: Sequence[Free], kintas: float, fss: float, offsets: Mapping[str, float] | None = None,
               sliding: float = math.inf) -> Floats:
    """Scaled unknowns, (p,), of a plant that has the two faults and `offsets`, and is nominal otherwise.

    FDS goes with FSS, but not beyond `sliding` N.
    """
    logs = {CLOGGING.parameter: math.log(1.0 - min(max(kintas, 0.0), CLOGGING.largest)),
            FRICTION.parameter: math.log(max(fss, SMALLEST_FSS)),
            DYNAMIC: math.log(min(max(fss, SMALLEST_FSS) / STATIC_OVER_DYNAMIC, sliding)),
            **(offsets or {})}
    return np.array([(logs.get(f.name, f.centre) - f.centre) / f.scale for f in free])


# ---------------------------------------------------------------------------------------------------------------------
# The fit
# ---------------------------------------------------------------------------------------------------------------------

@dataclass(frozen=True, eq=False)
class Refinement:
    """What the refinement found."""

    kintas: Estimate
    fss: Estimate  # N
    correlation: float  # of the two
    others: Mapping[str, Estimate]  # the suspects by parameter, SI
    fit: Fit
    errors: Mapping[str, float]  # RMS residual by signal, SI
    floor: Mapping[str, float]  # RMS noise by signal, SI
    simulations: int
    method: str = "least squares"
    everywhere: Mapping[str, float] = field(default_factory=dict)  # of a long recording: typical error over noise
    worst: float = RESIDUAL_WORST  # error over noise that a few stops of the ram may leave

    @property
    def sizes(self) -> dict[str, Estimate]:
        """Both faults, by name."""
        return {fault.name: getattr(self, fault.symbol) for fault in FAULTS}

    @property
    def ratio(self) -> dict[str, float]:
        """Error over noise by signal; 1 where nothing but noise is left."""
        return {name: self.errors[name] / self.floor[name] for name in self.errors}

    @property
    def is_explained(self) -> bool:
        """Whether only noise is left, except for a few stops of the ram that the model makes or misses."""
        usual = compute_typical_rms(self.fit.residuals)
        near = all(float(t) <= RESIDUAL_IS_NOISE * floor for t, floor in zip(usual, self.floor.values(), strict=True))
        near &= all(ratio <= RESIDUAL_HELD_OUT for ratio in self.everywhere.values())
        return near and max(self.ratio.values()) <= self.worst


@dataclass
class CountedProblem(LogProblem):
    """A problem that counts the runs it makes, and knows static friction by its ratio."""

    counts: list[int] = field(default_factory=list)  # shared by the problem's copies and threads
    stage: Stage = NO_STAGE  # takes a step with each round of a fit

    def predict_signals(self, names: Sequence[str], values: Floats, trace: Trace | None = None) -> Floats:
        self.counts.append(len(values))
        return super().predict_signals(names, values, trace)


def make_problem(model: Model, trace: Trace, floor: Mapping[str, float] | None = None, workers: int = 2
                 ) -> CountedProblem:
    """The model with the suspects ready in it, and the run to compare it with; `floor` RMS noise by signal, SI."""
    level = {name: floor[name] if floor else model[SIGNALS[name].noise] for name in trace.outputs}
    ready = silence_readings(model).with_effects(s.effect for s in SUSPECTS if not CATALOGUE[s.effect].base)
    noise = tuple(noises.white_noise(level[name]) for name in trace.outputs)
    return CountedProblem(ready, trace, noise, workers=workers)


def choose_size_excerpt(model: Model, trace: Trace, floor: Mapping[str, float], progress: Progress = ignore_progress
                        ) -> Excerpt:
    """The part of a long recording that says most about the faults, the suspects and the tolerances."""
    problem = make_problem(model, trace, floor)
    sliding = FRICTION.middle / STATIC_OVER_DYNAMIC
    changes = [{CLOGGING.parameter: CLOGGING.middle},
               {FRICTION.parameter: FRICTION.middle, DYNAMIC: sliding},
               *({f.name: f.value(1.0)} for f in (_make_suspect(s, model) for s in SUSPECTS))]
    return choose_excerpt(trace, problem.model, floor, changes, progress)


def refine_sizes(model: Model, trace: Trace, starts: Sequence[tuple[float, float]] = COARSE_STARTS,
                 floor: Mapping[str, float] | None = None, workers: int = 2, whole: Trace | None = None,
                 progress: Progress = ignore_progress) -> Refinement:
    """Fault sizes by least squares from the best of some starts.

    Args:
        model: the plant as it left the works.
        trace: the run, prepared for replay.
        starts: (Kintas, FSS in N) each.
        floor: RMS noise by signal, SI; default the model's sensors.
        workers: threads.
        whole: the recording that `trace` was cut from: the fit is judged on it.
        progress: called with the stage and the share of a diagnosis that is done.
    """
    usual_rounds = 44  # from two starts; a fit that is restarted takes twice as many
    stage = Stage(progress, "refinement", 0.3, 0.97, usual_rounds)
    problem = replace(make_problem(model, trace, floor, workers), stage=stage)
    free = list_unknowns(model)
    first = _fit_coarsely(problem, free, starts)
    problem = learn_left_noise(problem, first)
    return report_fit(_fit_finely(problem, first), problem, whole)


def _fit_coarsely(problem: CountedProblem, free: Sequence[Free], starts: Sequence[tuple[float, float]]) -> Fit:
    """A fit from the best start and, if that blames a fault, one from a healthy unit: whichever leaves less."""
    alone = replace(problem, workers=1, _lanes={})
    begin = [choose_start(problem, free, starts)]
    healthy = make_start(free, CLOGGING.healthy, FRICTION.healthy, estimate_offsets(problem))
    if _blames_a_fault(free, begin[0]):
        begin.append(healthy)
    fits = map_in_threads(lambda x: descend(alone, start_fit(free, x), NOISE_SCHEDULE), begin, problem.workers)
    if len(fits) == 1 and (not is_noise_left(problem, fits[0]) or _blames_a_fault(free, fits[0].x)):
        fits.append(descend(problem, start_fit(free, healthy), NOISE_SCHEDULE))
    best = min(fits, key=lambda f: f.cost)
    return best if is_noise_left(problem, best) else descend(problem, best, ((3.0, 4), (1.0, 8)))


def _fit_finely(problem: CountedProblem, first: Fit) -> Fit:
    """The fit with finer steps, until only noise is left or no start on the way to a healthy unit would help."""
    fine = replace(problem, steps=FINE_STEPS, _lanes={})
    last = first
    for rounds in (4, 8):
        last = descend_valley(fine, last, rounds, find_flat(problem, first.free, last.x), problem.stage)
        if is_noise_left(problem, last):
            return last
    signals = problem.trace.outputs
    for parts in ((1.0, 0.5), (0.75, -0.25), (0.25, 1.25)):
        ratios = dict(zip(signals, measure_ratios(problem, last), strict=True))
        if is_noise_left(problem, last) or any(x > RESIDUAL_HOPELESS[s] for s, x in ratios.items()):
            break
        last = _restart_fit(problem, last, parts)
    return last


def _restart_fit(problem: CountedProblem, found: Fit, parts: Sequence[float], rounds: int = 8) -> Fit:
    """The best of a fit and some that begin elsewhere on the line to a unit with these faults and no other deviation.

    `parts` of that line lie between the fit, 0, and the other unit, 1. Stops of the ram make ridges: tolerances that
    lie behind one of them are found from the other side, or never.
    """
    free = found.free
    home = make_start(free, 0.0, FRICTION.healthy, estimate_offsets(problem))
    faults = [f.name in FAULT_PARAMETERS for f in free]
    home[faults] = found.x[faults]
    alone = replace(problem, workers=1, _lanes={})

    def fit_from(part: float) -> Fit:
        begun = descend(alone, start_fit(free, found.x + part * (home - found.x)), NOISE_SCHEDULE)
        flat = find_flat(alone, free, begun.x)
        return descend_valley(replace(alone, steps=FINE_STEPS, _lanes={}), begun, rounds, flat, problem.stage)

    return min(found, *map_in_threads(fit_from, parts, problem.workers), key=lambda f: f.cost)


def descend(problem: CountedProblem, found: Fit, schedule: Sequence[tuple[float, int]],
            shown_by: CountedProblem | None = None) -> Fit:
    """The fit after (factor, rounds) each: the noise so many times as large, so that small stops of the ram count late.

    Its covariance begins anew each time. `shown_by` tells which directions no signal shows, by default the problem.
    """
    for factor, rounds in schedule:
        begun = replace(found, covariance=guess_first_covariance(found.free))
        flat = find_flat(shown_by or problem, found.free, found.x)
        found = descend_valley(scale_noise(problem, factor), begun, rounds, flat, problem.stage)
    return found


def guess_first_covariance(free: Sequence[Free]) -> Floats:
    """A first covariance, (p, p): an effect's parameter, which has no prior, by the width of its first difference."""
    guess = guess_covariance(free)
    for k, f in enumerate(free):
        if not np.isfinite(f.prior):
            guess[k, k] = (f.step / 3.0) ** 2
    return guess


def find_flat(problem: CountedProblem, free: Sequence[Free], x: Floats) -> Floats:
    """Directions (p, k) at `x` (p,) that no signal shows, with what of the effects goes along."""
    return find_flat_directions(problem, free, x, (FLAPPER,), EFFECT_POWERS, PRIORS_KNOW_MORE_MISFIT)


def _blames_a_fault(free: Sequence[Free], x: Floats) -> bool:
    """Whether scaled unknowns, (p,), hold one of the faults for far gone."""
    known = {f.name: f.value(float(v)) for f, v in zip(free, x, strict=True)}
    kintas, fss = known[CLOGGING.parameter], known[FRICTION.parameter]
    return kintas > FAULT_BLAMED_SHARE * CLOGGING.middle or fss > FAULT_BLAMED_SHARE * FRICTION.middle


def is_noise_left(problem: Problem, found: Fit) -> bool:
    """Whether the fit leaves only noise."""
    return max(measure_ratios(problem, found)) <= RESIDUAL_IS_NOISE


def measure_ratios(problem: Problem, found: Fit) -> list[float]:
    """RMS residual over noise, signal by signal."""
    return [float(np.sqrt(np.nanmean(r**2))) / n.level for r, n in zip(found.residuals, problem.noise, strict=True)]


def choose_start(problem: CountedProblem, free: Sequence[Free], starts: Sequence[tuple[float, float]]) -> Floats:
    """The start, (p,) scaled, with the smallest misfit, searched on ever finer grids around the best one."""
    loud = scale_noise(replace(problem, workers=1, _lanes={}), NOISE_SCHEDULE[0][0])
    offsets = estimate_offsets(problem)
    usual = problem.model[DYNAMIC]

    def try_starts(tried: Sequence[tuple[float, float]], sliding: float) -> tuple[float, tuple[float, float], Floats]:
        x = np.array([make_start(free, *s, offsets, sliding) for s in tried])
        costs = compute_misfit(loud.compute_white_residuals(free, x))
        k = int(np.argmin(costs))
        return float(costs[k]), tried[k], x[k]

    def search(sliding: float) -> tuple[float, Floats]:
        cost, best, x = try_starts(starts, sliding)
        for step, factor in ((0.05, 1.2), (0.02, 1.08), (0.01, 1.03)):  # of Kintas, of FSS
            around = [(min(max(best[0] + i * step, 0.0), CLOGGING.largest), best[1] * factor**j)
                      for i, j in product(range(-2, 3), repeat=2)]
            cost, best, x = try_starts(around, sliding)
        return cost, x

    # dynamic friction goes with the static one, or has stayed what it was
    return min(map_in_threads(search, (math.inf, usual), problem.workers), key=lambda each: each[0])[1]


def estimate_offsets(problem: Problem) -> dict[str, float]:
    """Null bias, A, and load, N, from the means of current and pressure, as starts of a fit.

    The mean opening is the one that moves the ram as far as it moved; the rest of the mean current makes up for a bias.
    The mean pressure carries the load.
    """
    trace, p = problem.trace, problem.model.values
    way = 0.0
    for part in trace.parts or (span_all_rows(trace),):
        x = trace.xj[part.first:part.stop]
        x = x[~np.isnan(x)]
        way += float(x[-1] - x[0])
    speed = way / (len(trace) * p["controller.period"])
    per_speed = p["jack.area"] / p["valve.flow_gain"] * p["feedback_spring.stiffness"] / p["torque_motor.gain"]
    found = {"null_bias.current": per_speed * speed - float(trace.cor.mean())}
    if "p12" in trace.outputs:
        pressure = trace.mask_unusable("p12")
        found["constant_load.force"] = p["jack.area"] * float(np.nanmean(pressure)) - float(trace.load.mean())
    return found


def learn_left_noise(problem: CountedProblem, found: Fit) -> CountedProblem:
    """The problem with the noise that a fit leaves, signal by signal, where only noise is left."""
    learnt = []
    for old, r in zip(problem.noise, found.residuals, strict=True):
        is_noise = float(np.sqrt(np.nanmean(r**2))) <= RESIDUAL_IS_NOISE * old.level
        learnt.append(noises.fit_noise(r) if is_noise else old)
    return replace(problem, noise=tuple(learnt), _lanes={})


def report_fit(last: Fit, problem: CountedProblem, whole: Trace | None = None) -> Refinement:
    """What a fit found, with the noise of its problem as the floor; judged on the `whole` recording if it is cut."""
    outputs = problem.trace.outputs
    errors = {s: float(np.sqrt(np.nanmean(r**2))) for s, r in zip(outputs, last.residuals, strict=True)}
    floor = {s: n.level for s, n in zip(outputs, problem.noise, strict=True)}
    names = [f.name for f in last.free]
    i, j = names.index(CLOGGING.parameter), names.index(FRICTION.parameter)
    spread = np.sqrt(np.diag(last.covariance))
    correlation = float(last.covariance[i, j] / (spread[i] * spread[j]))
    found = Refinement(estimate_parameter(last, CLOGGING.parameter),
                       estimate_parameter(last, FRICTION.parameter, FSS_INTERVAL_FACTOR), correlation,
                       {s.parameter: estimate_parameter(last, s.parameter) for s in SUSPECTS}, last, errors, floor,
                       sum(problem.counts))
    if whole is None or whole is problem.trace:
        return found
    judged = judge_on_all(problem, [last], whole, FINE_STEPS)[0]
    return replace(found, errors=judged.errors, everywhere=judged.typical_ratio(found.floor))


def estimate_parameter(found: Fit, name: str, factor: float = 1.0) -> Estimate:
    """A parameter with its 95 % interval, `factor` times as wide as the fit's covariance says, within its bounds."""
    i = [f.name for f in found.free].index(name)
    half = factor * INTERVAL_95_SD * float(np.sqrt(found.covariance[i, i]))
    low, high = sorted(found.free[i].value(float(found.x[i]) + way * half) for way in (-1.0, 1.0))
    return Estimate(found.free[i].value(float(found.x[i])), low, high)
