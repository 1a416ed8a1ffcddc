"""The sizes of the two faults from a replay of the measured current, with all that differs between healthy units.

Free are the faults (Kintas, FSS and, as a nuisance, FDS), the base parameters with their tolerances as priors, and
what else ages or is set up wrongly: jack friction, leakage, null bias, a load that nobody measured. What these do is
then not blamed on the servovalve. A loss of pilot flow gain within its tolerance looks as a clogging filter does, so it
is the tolerances that decide how wide the intervals are.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.fault_unknowns import MOST, SUSPECTS, free_parameters, start_of, values
from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate
from fdi.estimation import noise as noises
from fdi.estimation.fit import Fit, misfit, typical
from fdi.estimation.problem import Free, Problem, quiet
from fdi.estimation.valley import descended, first_widths, flats
from fdi.thresholds import (
    FAULT_BLAMED_SHARE,
    FSS_INTERVAL_FACTOR,
    INTERVAL_95_SD,
    RESIDUAL_HOPELESS,
    RESIDUAL_IS_NOISE,
    RESIDUAL_WORST,
)
from fdi.trace.signals import SIGNALS
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE
from plant.model import Model
from plant.threads import mapped

Floats = NDArray[np.float64]

FINE = 20  # steps a cycle of the last fit
EASED = ((30.0, 4), (6.0, 4), (1.0, 8))  # times the noise, rounds
AGAIN = ((3.0, 4), (1.0, 8))  # the same once more where that was not enough
SETTLING = 4  # rounds of the last fit
LONG = 8  # further ones, where these were not enough
# where a fit begins again that has not come down to noise: parts of the way back to a unit without deviations, by turns
BACK = ((1.0, 0.5), (0.75, -0.25), (0.25, 1.25))
FAULTY = (CLOGGING.parameter, FRICTION.parameter, "spool.dynamic_friction")
COARSE = tuple(product((0.0, 0.12, 0.24, 0.36, 0.48), 5.0 * 1.4 ** np.arange(-1.0, 10.0)))  # starts beside the grid's
CLOSER = ((0.05, 1.2), (0.02, 1.08), (0.01, 1.03))  # steps of Kintas and factors of FSS around the best start


@dataclass(frozen=True, eq=False)
class Refined:
    """What the refinement found."""

    kintas: Estimate
    fss: Estimate  # N
    correlation: float  # of the two
    others: Mapping[str, Estimate]  # the suspects by parameter, SI
    fit: Fit
    errors: Mapping[str, float]  # RMS residual by signal, SI
    floor: Mapping[str, float]  # what the sensors' noise leaves of it
    simulations: int
    method: str = "least squares"

    @property
    def ratio(self) -> dict[str, float]:
        """Error over floor by signal; 1 where nothing but noise is left."""
        return {name: self.errors[name] / self.floor[name] for name in self.errors}

    @property
    def reached(self) -> bool:
        """True when nothing but noise is left, but for a few stops of the ram that were made or missed by a hair."""
        usual = typical(self.fit.residuals)
        near = all(float(t) <= RESIDUAL_IS_NOISE * floor for t, floor in zip(usual, self.floor.values(), strict=True))
        return near and max(self.ratio.values()) <= RESIDUAL_WORST


@dataclass
class Counted(Problem):
    """A problem that counts the runs it makes, and knows static friction by its ratio."""

    counts: list[int] = field(default_factory=list)  # shared by the problem's copies and threads

    def residuals(self, free: Sequence[Free], x: Floats) -> Floats:
        return self.left(self.predict([f.name for f in free], np.array([values(free, row) for row in x])))

    def all_signals(self, names: Sequence[str], values: Floats, trace: Trace | None = None) -> Floats:
        self.counts.append(len(values))
        return super().all_signals(names, values, trace)


def problem_of(model: Model, trace: Trace, floor: Mapping[str, float] | None = None, workers: int = 2) -> Counted:
    """The model with the suspects ready in it, and the run to hold it against; `floor` RMS noise by signal, SI."""
    level = {name: floor[name] if floor else model[SIGNALS[name].noise] for name in trace.outputs}
    ready = quiet(model).having(s.effect for s in SUSPECTS if not CATALOGUE[s.effect].base)
    return Counted(ready, trace, tuple(noises.white(level[name]) for name in trace.outputs), workers=workers)


def refine(model: Model, trace: Trace, starts: Sequence[tuple[float, float]] = COARSE,
           floor: Mapping[str, float] | None = None, workers: int = 2) -> Refined:
    """Fault sizes by least squares from the best of some starts.

    Args:
        model: the plant as it left the works.
        trace: the run, prepared for replay.
        starts: (Kintas, FSS in N) each.
        floor: RMS noise by signal, SI; default the model's sensors.
        workers: threads.
    """
    problem = problem_of(model, trace, floor, workers)
    free = free_parameters(model)
    first = _first(problem, free, starts)
    problem = _with_noise(problem, first)
    return _refined(_last(problem, first), problem)


def _first(problem: Counted, free: Sequence[Free], starts: Sequence[tuple[float, float]]) -> Fit:
    """A fit from the best start and, before a fault is blamed, from a healthy unit: whichever leaves less."""
    alone = replace(problem, workers=1, _lanes={})
    found = [_best_start(problem, free, starts)]
    healthy = start_of(free, CLOGGING.healthy, FRICTION.healthy, offsets_of(problem))
    if _blamed(free, found[0]):
        found.append(healthy)
    fits = mapped(lambda x: _eased(alone, free, x), found, problem.workers)
    if len(fits) == 1 and (not _reached(problem, fits[0]) or _blamed(free, fits[0].x)):
        fits.append(_eased(problem, free, healthy))
    first = min(fits, key=lambda f: f.cost)
    for factor, rounds in AGAIN if not _reached(problem, first) else ():
        first = _further(problem, first, factor, rounds)
    return first


def _last(problem: Counted, first: Fit) -> Fit:
    """The fit with finer steps, as long as it takes to leave nothing but noise, or as there is hope."""
    fine = replace(problem, steps=FINE, _lanes={})
    last = first
    for rounds in (SETTLING, LONG):
        last = descended(fine, last, rounds, flats(problem, first.free, last.x))
        if _reached(problem, last):
            return last
    signals = problem.trace.outputs
    for parts in BACK:
        ratios = dict(zip(signals, _over(problem, last), strict=True))
        if _reached(problem, last) or any(x > RESIDUAL_HOPELESS[s] for s, x in ratios.items()):
            break
        last = _restarted(problem, last, parts)
    return last


def _restarted(problem: Counted, found: Fit, parts: Sequence[float]) -> Fit:
    """The best of a fit and some that begin on the way from it to a unit with these faults and no other deviation.

    Stops of the ram make ridges: tolerances that lie behind one of them are found from the other side, or never.
    """
    free = found.free
    home = start_of(free, 0.0, FRICTION.healthy, offsets_of(problem))
    faults = [f.name in FAULTY for f in free]
    home[faults] = found.x[faults]
    alone = replace(problem, workers=1, _lanes={})

    def fitted(part: float) -> Fit:
        begun = _eased(alone, free, found.x + part * (home - found.x))
        return descended(replace(alone, steps=FINE, _lanes={}), begun, LONG, flats(alone, free, begun.x))

    return min(found, *mapped(fitted, parts, problem.workers), key=lambda f: f.cost)


def _eased(problem: Counted, free: Sequence[Free], x: Floats) -> Fit:
    """A fit from `x` (p,) that takes the noise for larger at first: small stops count late."""
    found = begun(free, x)
    for factor, rounds in EASED:
        found = _further(problem, found, factor, rounds)
    return found


def _further(problem: Counted, found: Fit, factor: float, rounds: int) -> Fit:
    start = replace(found, covariance=first_widths(found.free))
    return descended(_louder(problem, factor), start, rounds, flats(problem, found.free, found.x))


def _blamed(free: Sequence[Free], x: Floats) -> bool:
    """Whether scaled unknowns, (p,), hold one of the faults for far gone."""
    known = {f.name: f.value(float(v)) for f, v in zip(free, x, strict=True)}
    kintas, fss = known[CLOGGING.parameter], known[FRICTION.parameter]
    return kintas > FAULT_BLAMED_SHARE * CLOGGING.middle or fss > FAULT_BLAMED_SHARE * FRICTION.middle


def _reached(problem: Problem, found: Fit) -> bool:
    return max(_over(problem, found)) <= RESIDUAL_IS_NOISE


def _over(problem: Problem, found: Fit) -> list[float]:
    """RMS residual over the noise, signal by signal."""
    return [float(np.sqrt(np.nanmean(r**2))) / n.level for r, n in zip(found.residuals, problem.noise, strict=True)]


def _louder(problem: Counted, factor: float) -> Counted:
    return replace(problem, noise=tuple(n._replace(innovation=factor * n.innovation) for n in problem.noise))


def begun(free: Sequence[Free], x: Floats) -> Fit:
    """A fit that has not looked at anything yet."""
    none = np.empty((0, 0))
    return Fit(tuple(free), x, np.inf, np.inf, first_widths(free), none, none, none)


def _best_start(problem: Counted, free: Sequence[Free], starts: Sequence[tuple[float, float]]) -> Floats:
    """The start, (p,) scaled, that leaves least, looked at ever closer."""
    loud, offsets = _louder(replace(problem, workers=1, _lanes={}), EASED[0][0]), offsets_of(problem)
    usual = problem.model["spool.dynamic_friction"]

    def least(tried: Sequence[tuple[float, float]], sliding: float) -> tuple[float, tuple[float, float], Floats]:
        x = np.array([start_of(free, *s, offsets, sliding) for s in tried])
        costs = misfit(loud.whitened(loud.residuals(free, x)))
        k = int(np.argmin(costs))
        return float(costs[k]), tried[k], x[k]

    def closest(sliding: float) -> tuple[float, Floats]:
        best = least(starts, sliding)
        for k, f in CLOSER:
            best = least([(min(max(best[1][0] + i * k, 0.0), MOST), best[1][1] * f**j)
                          for i, j in product(range(-2, 3), repeat=2)], sliding)
        return best[0], best[2]

    # dynamic friction goes with the static one, or has stayed what it was
    return min(mapped(closest, (math.inf, usual), problem.workers), key=lambda each: each[0])[1]


def offsets_of(problem: Problem) -> dict[str, float]:
    """What the means of current and pressure say of null bias, A, and load, N, as starts.

    The mean opening is what the ram's way takes; what current is left makes up for a bias. The mean pressure carries
    the load.
    """
    trace, p = problem.trace, problem.model.values
    x = trace.xj[~np.isnan(trace.xj)]
    speed = (x[-1] - x[0]) / (len(trace) * p["controller.period"])
    per_speed = p["jack.area"] / p["valve.flow_gain"] * p["feedback_spring.stiffness"] / p["torque_motor.gain"]
    found = {"null_bias.current": per_speed * speed - float(trace.cor.mean())}
    if "p12" in trace.outputs:
        pressure = trace.measured("p12")
        found["constant_load.force"] = p["jack.area"] * float(np.nanmean(pressure)) - float(trace.load.mean())
    return found


def _with_noise(problem: Counted, found: Fit) -> Counted:
    """The problem with the noise of what a fit leaves, signal by signal, where that is noise."""
    learnt = []
    for old, r in zip(problem.noise, found.residuals, strict=True):
        calm = float(np.sqrt(np.nanmean(r**2))) <= RESIDUAL_IS_NOISE * old.level
        learnt.append(noises.fitted(r) if calm else old)
    return replace(problem, noise=tuple(learnt), _lanes={})


def _refined(last: Fit, problem: Counted) -> Refined:
    outputs = problem.trace.outputs
    errors = {s: float(np.sqrt(np.nanmean(r**2))) for s, r in zip(outputs, last.residuals, strict=True)}
    floor = {s: n.level for s, n in zip(outputs, problem.noise, strict=True)}
    names = [f.name for f in last.free]
    i, j = names.index(CLOGGING.parameter), names.index(FRICTION.parameter)
    spread = np.sqrt(np.diag(last.covariance))
    correlation = float(last.covariance[i, j] / (spread[i] * spread[j]))
    return Refined(estimate(last, CLOGGING.parameter), estimate(last, FRICTION.parameter, FSS_INTERVAL_FACTOR),
                   correlation, {s.parameter: estimate(last, s.parameter) for s in SUSPECTS}, last, errors, floor,
                   sum(problem.counts))


def estimate(found: Fit, name: str, wider: float = 1.0) -> Estimate:
    """A parameter with its 95 % interval, within what is possible; `wider` times what the fit's covariance says."""
    i = [f.name for f in found.free].index(name)
    half = wider * INTERVAL_95_SD * float(np.sqrt(found.covariance[i, i]))
    low, high = sorted(found.free[i].value(float(found.x[i]) + way * half) for way in (-1.0, 1.0))
    return Estimate(found.free[i].value(float(found.x[i])), low, high)
