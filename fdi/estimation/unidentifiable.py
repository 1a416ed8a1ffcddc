"""What may be scaled in the plant without any signal showing it: directions along which priors alone decide.

Torques, pressures and forces inside the servovalve are not measured. A filter that lets through less and pilot gains
that are larger by as much are the same plant to every sensor; so are stronger springs behind a stronger motor. Where
the spool or the pressure of the jack is not measured, its scale is not seen either. Slopes by differences do not show
this, as each parameter shifts a hundred small stops of the spool; so along these directions slopes are set to zero,
where a trial replay confirms it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.fit import (
    DAMPINGS,
    Fit,
    Free,
    Problem,
    compute_misfit,
    compute_weights,
    cut_at_bounds,
    find_best_trial,
    fit_unknowns,
    follow_population,
    form_normal_equations,
    invert_hessian,
    limit_dynamic_friction,
    replay_fit,
    scale_noise,
    scaled_bounds,
    step_within_bounds,
    weigh_priors,
)
from fdi.progress import NO_STAGE, Stage
from fdi.thresholds import CONVERGED_GAIN, FLAT_DIRECTION_MISFIT, PRIORS_KNOW_MORE_MISFIT
from fdi.trace import Flags, Floats

TRIED = 0.01  # of the logarithms: a way along a direction that is said to be flat
# A stop of the spool that moves by chance can hide a flat direction in one of these trials, hardly in all four.
TRIED_SHARES = (1.0, -1.0, 0.3, -0.3)  # of TRIED
# Some parameters move by their distance from another value than 0: what a filter lets through is 1 - Kintas, what a
# sensor shows of a position 1 + error.
ORIGINS: Mapping[str, float] = {"filter.clogging": 1.0, "magnet_loss.share": 1.0, "coil_short.share": 1.0,
                                "sensor_gain.error": -1.0}
POWERS: Mapping[str, float] = {"land_clearance.clearance": 3.0}  # with which a parameter acts, if not in proportion
# Powers with which parameters move together.
FLAT: tuple[Mapping[str, float], ...] = (
    {"filter.clogging": 1.0, "pilot.flow_gain": -0.5, "pilot.pressure_gain": -1.0, "supply.pressure": -1.0},
    {"spool.static_friction": 1.0, "spool.dynamic_friction": 1.0, "pilot.pressure_gain": 1.0, "supply.pressure": 1.0},
    {"torque_motor.gain": 1.0, "feedback_spring.stiffness": 1.0, "flapper.stiffness": 1.0, "flapper.damping": 1.0,
     "flapper.inertia": 1.0},
    {"jack.area": 1.0, "valve.flow_gain": 1.0, "jack.mass": 1.0, "jack.damping": 1.0, "jack.static_friction": 1.0,
     "jack.dynamic_friction": 1.0, "jack.leakage": 1.0},
)

# In a run in which the flapper meets neither of its stops nothing shows how far it moves, only what its way does.
FLAPPER: Mapping[str, float] = {"pilot.flow_gain": 1.0, "pilot.pressure_gain": 1.0, "flapper.stiffness": 1.0,
                                "flapper.damping": 1.0, "flapper.inertia": 1.0}


class Direction(NamedTuple):
    """Powers with which parameters move together, the signals that would show it, and what a replay may show of it."""

    powers: Mapping[str, float]
    shown_by: frozenset[str] = frozenset()  # where one of them is measured, the direction is not tried
    allowed: float = FLAT_DIRECTION_MISFIT


# Parameters of effects that move with those of each of `FLAT`.
FLAT_WITH_EFFECTS: tuple[Mapping[str, float], ...] = (
    {"supply_droop.slope": -1.0, "flow_force.coefficient": 1.0},
    {"supply_droop.slope": 1.0},
    {},
    {"constant_load.force": 1.0, "aero_stiffness.stiffness": 1.0, "compressibility.coefficient": 1.0,
     "mount_compliance.compliance": -1.0, "mount_compliance.mass": 1.0, "structural_resonance.mass": 1.0,
     "supply_droop.slope": -1.0},
)

# How far the spool moves: all that meets it moves with it. In a run in which it meets its stops the position shows it.
SPOOL_WAY: Mapping[str, float] = {
    "valve.flow_gain": -1.0, "valve.pressure_gain": -1.0, "feedback_spring.stiffness": -1.0, "pilot.flow_gain": 1.0,
    "spool_overlap.overlap": 1.0, "spool_underlap.underlap": 1.0, "feedback_gap.width": 1.0,
    "flow_force.coefficient": -1.0}

# The pressure across the piston, at the same forces on the ram.
JACK_PRESSURE: Mapping[str, float] = {
    "valve.pressure_gain": 1.0, "supply.pressure": 1.0, "jack.area": -1.0, "valve.flow_gain": -1.0,
    "jack.leakage": -2.0, "compressibility.coefficient": -2.0, "supply_droop.slope": 2.0,
    "flow_force.coefficient": -1.0}

# A thicker oil drags more and leaks less.
VISCOSITY: Mapping[str, float] = {"viscosity_drift.factor": -1.0, "jack.damping": 1.0, "flapper.damping": 1.0,
                                  "jack.leakage": -1.0}

# The scale of the position: where the sensor shows more, the ram moves less under larger forces.
POSITION_SCALE: Mapping[str, float] = {
    "sensor_gain.error": 1.0, "jack.area": 1.0, "jack.mass": 2.0, "jack.damping": 2.0, "jack.static_friction": 1.0,
    "jack.dynamic_friction": 1.0, "constant_load.force": 1.0, "aero_stiffness.stiffness": 2.0,
    "mount_compliance.compliance": -2.0, "mount_compliance.mass": 2.0, "structural_resonance.mass": 2.0,
    "rod_backlash.width": -1.0, "stribeck.speed": -1.0, "presliding.deflection": -1.0,
    "presliding.speed": -1.0}

# The same at the same forces: under a known load only this.
POSITION_SCALE_AT_FORCES: Mapping[str, float] = {
    name: POSITION_SCALE.get(name, 0.0) - power
    for name, power in {**dict.fromkeys(POSITION_SCALE, 0.0), **FLAT[-1], **FLAT_WITH_EFFECTS[-1]}.items()}

BALANCED = {"valve.pressure_gain", "valve.flow_gain", "jack.leakage"}  # a plant without them has other directions


def list_directions_of_faults(at: Mapping[str, float]) -> list[Mapping[str, float]]:
    """Directions along which a fault looks like a parameter of the plant or another fault; the fault is named first.

    `at` are parameters by name, SI. The powers of linear unknowns are shifts.
    """
    leak = {name: at.get(name, 0.0) for name in ("land_clearance.clearance", "jack.leakage")}
    clearance = leak["land_clearance.clearance"]
    flow = at.get("land_clearance.circumference", 0.013) * clearance**3 / 0.18e-3  # of the clearance, m3/s/Pa
    most = max(leak["jack.leakage"], 3.0 * flow, 1e-300)
    linear = {"constant_load.force": at.get("constant_load.force", 0.0),
              "sensor_gain.error": 1.0 + at.get("sensor_gain.error", 0.0)}
    return [{"magnet_loss.share": 1.0, "torque_motor.gain": -1.0},
            {"coil_short.share": 1.0, "torque_motor.gain": -1.0},
            {"land_clearance.clearance": 3.0 * clearance**3 * leak["jack.leakage"] / most,
             "jack.leakage": -3.0 * flow / most},
            *({name: power * linear.get(name, 1.0) for name, power in powers.items()}
              for powers in (POSITION_SCALE, POSITION_SCALE_AT_FORCES))]


def list_directions(problem: Problem, at: Mapping[str, float]) -> list[Direction]:
    """What no measured signal may show, for linear unknowns, where the model has these values, SI by name.

    Of pressure gain and leakage only 1/GP + CLK/GQ shows: a smaller gain is a larger leakage.
    """
    at = {**problem.model.values, **at}
    if not at.keys() >= BALANCED:
        return []
    pairs = zip(list_powers(problem), FLAT_WITH_EFFECTS, strict=True)
    share = at["valve.pressure_gain"] * at["jack.leakage"] / at.get("viscosity_drift.factor", 1.0)
    loss = {"valve.pressure_gain": share / max(share, at["valve.flow_gain"]),
            "jack.leakage": at["valve.flow_gain"] / max(share, at["valve.flow_gain"])}
    directions = [*(Direction({**flat, **effects}) for flat, effects in pairs), Direction(loss), Direction(VISCOSITY),
                  Direction(POSITION_SCALE), Direction(POSITION_SCALE_AT_FORCES),
                  Direction(FLAPPER, allowed=PRIORS_KNOW_MORE_MISFIT),
                  Direction(SPOOL_WAY, frozenset({"xs"}), PRIORS_KNOW_MORE_MISFIT),
                  Direction(JACK_PRESSURE, frozenset({"p12"}))]
    return [each for each in directions if not each.shown_by & set(problem.trace.outputs)]


def list_powers(problem: Problem) -> list[Mapping[str, float]]:
    """`FLAT` for the filter's law of this model."""
    law = problem.model.values.get("filter.law", 0.5)
    return [{**flat, "pilot.flow_gain": -law} if "filter.clogging" in flat else flat for flat in FLAT]


def scale_together(free: Sequence[Free], x: Floats, powers: Mapping[str, float], logarithm: float) -> Floats:
    """Scaled unknowns (p,) after those in `powers` have been multiplied by their powers of exp(`logarithm`)."""
    new_x = x.copy()
    for k, f in enumerate(free):
        if f.name in powers:
            value, factor = f.centre + f.scale * float(x[k]), float(np.exp(powers[f.name] * logarithm))
            origin = ORIGINS.get(f.name, 0.0)
            new_x[k] = (origin + (value - origin) * factor - f.centre) / f.scale
    return new_x


def scale_to(free: Sequence[Free], x: Floats, powers: Mapping[str, float], name: str, value: float) -> Floats | None:
    """The same where that brings parameter `name` to a value; None if the powers do not move it there."""
    k = next((k for k, f in enumerate(free) if f.name == name), None)
    origin = ORIGINS.get(name, 0.0)
    if k is None or name not in powers:
        return None
    distance = free[k].centre + free[k].scale * float(x[k]) - origin
    if (value - origin) * distance <= 0.0:  # no factor leads from zero, or past it
        return None
    return scale_together(free, x, powers, math.log((value - origin) / distance) / powers[name])


def find_tangents(problem: Problem, free: Sequence[Free], x: Floats) -> tuple[list[Direction], Floats]:
    """The directions that hold at `x` (p,), and their tangents of scaled unknowns as columns (p, k).

    Left out is a direction that a bound stops, or that a trial replay does not find flat.
    """
    low, high = scaled_bounds(free)
    names = {f.name for f in free}
    directions = [each for each in list_directions(problem, problem.list_values(free, x))
                  if next(iter(each.powers)) in names]
    if not directions:
        return [], np.empty((len(x), 0))
    trials = np.array([[scale_together(free, x, each.powers, TRIED * share) for each in directions]
                       for share in TRIED_SHARES])
    is_tried = ((trials >= low - 1e-9) & (trials <= high + 1e-9)).all(axis=2) & (trials != x).any(axis=2)
    samples = sum(len(trace) for trace in (problem.trace, *problem.also))
    limits = np.array([each.allowed for each in directions]) * samples / 13500.0
    flat_directions = [directions[k] for k in np.flatnonzero(confirm_flat(problem, free, x, trials, is_tried, limits))]
    ways = _list_tangents(free, x, flat_directions)
    places = _find_independent(ways)
    return [flat_directions[k] for k in places], ways[places].T


def _list_tangents(free: Sequence[Free], x: Floats, directions: Sequence[Direction]) -> Floats:
    """Tangents at `x` (p,) as rows (k, p)."""
    ways = [(scale_together(free, x, each.powers, 1e-6) - x) / 1e-6 for each in directions]
    return np.array(ways).reshape(-1, len(x))


def confirm_flat(problem: Problem, free: Sequence[Free], x: Floats, trials: Floats, is_tried: Flags,
                 most: float | Floats = FLAT_DIRECTION_MISFIT) -> Flags:
    """Which directions a trial replay finds flat at `x` (p,), (k,).

    Args:
        problem: the run.
        free: the unknowns.
        x: their scaled values (p,).
        trials: scaled unknowns (4, k, p) at each of `TRIED_SHARES` along each direction.
        is_tried: (4, k), False where a bound stops a trial.
        most: change of the misfit, of a trial of full length, (k,) or one for all directions; a shorter one may
            change its square's share.
    """
    limits = np.array(TRIED_SHARES)[:, None] ** 2 * most * np.ones(is_tried.shape[1])
    is_flat = np.zeros(is_tried.shape[1], bool)
    for shares in ([0], [1, 2, 3]):  # most directions that are flat need no more than the first trial
        is_due = is_tried & ~is_flat & np.isin(np.arange(len(is_tried)), shares)[:, None]
        if is_due.any():
            white = problem.compute_white_residuals(free, np.vstack([x, trials[is_due]]))
            changes = ((white[1:] - white[0]) ** 2).sum(axis=(1, 2))
            is_flat[np.nonzero(is_due)[1][changes < limits[is_due]]] = True
    return is_flat


def remove_slope(jacobian: Floats, flat: Floats) -> Floats:
    """A Jacobian (p, s, n) with its slope along the flat directions (p, k) taken out."""
    if not flat.size:
        return jacobian
    rows = jacobian.reshape(len(jacobian), -1)
    basis = np.linalg.qr(flat)[0]
    return (rows - basis @ (basis.T @ rows)).reshape(jacobian.shape)


def relax_fit(problem: Problem, fit: Fit, directions: Sequence[Direction]) -> Fit:
    """The fit moved along these flat directions to where the priors want it, if that leaves no more than before."""
    free, x = fit.free, fit.x
    if not directions:
        return fit
    prior = weigh_priors(free)
    low, high = scaled_bounds(free)
    for _ in range(6):  # Gauss-Newton on the priors alone, along the curved directions
        ways = _list_tangents(free, x, directions).T
        step = -np.linalg.lstsq(ways.T @ (prior[:, None] * ways), ways.T @ (prior * x), rcond=None)[0]
        for way in (1.0, 0.5, 0.25, 0.1):
            trial = x
            for each, part in zip(directions, step, strict=True):
                trial = scale_together(free, trial, each.powers, way * float(part))
            if ((trial >= low) & (trial <= high)).all() and trial**2 @ prior < x**2 @ prior:
                x = trial
                break
        else:
            break
    if fit.x**2 @ prior - x**2 @ prior < CONVERGED_GAIN:  # not worth a replay
        return fit
    end = replay_fit(problem, fit, x)
    return end if end.cost < fit.cost else fit


def find_flat_directions(problem: Problem, free: Sequence[Free], x: Floats,
                         others: Sequence[Mapping[str, float]] = (),
                         allowed: float = FLAT_DIRECTION_MISFIT) -> Floats:
    """Directions of `FLAT` and `others` that hold at `x` (p,) of scaled logarithms, as columns (p, k).

    A direction holds if one of the trial replays along it, of four lengths, changes no more than its share of
    `FLAT_DIRECTION_MISFIT`, or of `allowed` for one of the `others`. Parameters of effects are no logarithms:
    they move by their power of their value.
    """
    at = problem.list_values(free, x)
    powers = [{**flat, **{name: power * at[name] for name, power in effects.items() if name in at}}
              for flat, effects in zip(list_powers(problem), FLAT_WITH_EFFECTS, strict=True)]
    directions = [flat for flat in (*powers, *others) if next(iter(flat)) in {f.name for f in free}]
    ways = np.array([[get_power(flat, f) / f.scale for f in free] for flat in directions]).reshape(-1, len(free))
    if not len(ways):
        return ways.T
    shares = np.array(TRIED_SHARES)
    steps = np.array([[cut_at_bounds(free, x, TRIED * share * way) for way in ways] for share in shares])
    whole = TRIED * np.abs(shares)[:, None] * np.abs(ways).max(axis=1)
    is_full = np.abs(steps).max(axis=2) >= 0.9 * whole
    limits = np.array([allowed if flat in others else FLAT_DIRECTION_MISFIT for flat in directions])
    flat_ways = ways[confirm_flat(problem, free, x, x + steps, is_full, limits)]
    return flat_ways[_find_independent(flat_ways)].T


def get_power(powers: Mapping[str, float], f: Free) -> float:
    """The power with which an unknown moves; a ratio of frictions only moves where its frictions move apart."""
    power = powers.get(f.name, 0.0)
    return power - powers.get(f.leader, 0.0) if isinstance(f, LogFrictionRatio) else power


def _find_independent(ways: Floats) -> list[int]:
    """Places of the directions (k, p) that are not sums of directions before them; without leakage two are alike."""
    places: list[int] = []
    for k in range(len(ways)):
        rows = ways[[*places, k]]
        if np.linalg.matrix_rank(rows / np.linalg.norm(rows, axis=1, keepdims=True), tol=1e-6) > len(places):
            places.append(k)
    return places


def choose_across(free: Sequence[Free], flat: Floats) -> NDArray[np.int64]:
    """Places of the unknowns that, with the flat directions (p, k), span all: one of each direction is left out.

    It is the first that the direction names in `FLAT`, else the one that moves furthest.
    """
    leading = np.array([f.name in [next(iter(v)) for v in FLAT] for f in free])
    remainder = flat.copy()
    pivots: list[int] = []
    for i in range(flat.shape[1]):  # elimination, so that directions with the same parameters leave out different ones
        size = np.abs(remainder[:, i])
        k = int(np.argmax(size * leading if (size * leading).max() > 1e-6 * size.max() else size))
        pivots.append(k)
        remainder[:, i + 1:] -= np.outer(remainder[:, i], remainder[k, i + 1:] / remainder[k, i])
    return np.array([k for k in range(len(free)) if k not in pivots])


def relax_along(fit: Fit, flat: Floats) -> Fit:
    """The fit moved along the flat directions to where the priors want it, within the bounds: no residual changes."""
    prior = weigh_priors(fit.free)
    low, high = scaled_bounds(fit.free)
    x = fit.x
    for _ in range(len(flat.T) + 1):
        pull = flat.T @ (prior * x)
        way = -flat @ np.linalg.solve(flat.T @ (prior[:, None] * flat), pull) if flat.size else np.zeros(len(x))
        room = np.where(way > 0.0, high - x, x - low) / np.maximum(np.abs(way), 1e-300)
        x = np.clip(x + min(1.0, float(room.min())) * way, low, high)
        if room.min() >= 1.0:
            break
        flat = _keep_still(flat, int(np.argmin(room)))
    cost = fit.misfit + float(x**2 @ prior)
    return replace(fit, x=x, cost=cost) if cost < fit.cost else fit


def _keep_still(flat: Floats, k: int) -> Floats:
    """The directions within the flat ones along which unknown k does not move."""
    row = flat[k:k + 1]
    _, _, rows = np.linalg.svd(row)
    return np.asarray(flat @ rows[1:].T)


class LogFree(Free):
    """A parameter by its logarithm: centre, scale and bounds are those of the logarithm."""

    def value(self, x: float) -> float:
        """The parameter in SI units."""
        return math.exp(super().value(x))


class LogFrictionRatio(LogFree):
    """Static friction by the logarithm of its ratio to the dynamic one of the same body, which comes before it.

    Or the dynamic one by its ratio to the static one, which then comes before it.
    """

    @property
    def leader(self) -> str:
        """The other friction's name."""
        is_static = "static" in self.name
        return self.name.replace("static", "dynamic") if is_static else self.name.replace("dynamic", "static")


class LogOpenFilter(Free):
    """Kintas by the logarithm of what the filter lets through, 1 - Kintas: gains go with powers of it."""

    def value(self, x: float) -> float:
        """Kintas."""
        return 1.0 - math.exp(super().value(x))


class PowerFree(Free):
    """A parameter by its power in `POWERS`, with which its law goes: centre, scale and bounds are those of the power.
    """

    def value(self, x: float) -> float:
        """The parameter in SI units."""
        return float(super().value(x) ** (1.0 / POWERS[self.name]))


def take_logarithm(f: Free) -> Free:
    """A tolerance as one of the logarithm; unchanged if the parameter may be zero."""
    if f.low <= 0.0:
        return f
    return LogFree(f.name, math.log(f.centre), f.scale / f.centre, f.prior, math.log(f.low), math.log(f.high), f.step)


def compute_values(free: Sequence[Free], x: Floats) -> Floats:
    """Parameters in SI units, (p,), of scaled unknowns (p,)."""
    values = np.array([f.value(float(v)) for f, v in zip(free, x, strict=True)])
    names = [f.name for f in free]
    for k, f in enumerate(free):
        if isinstance(f, LogFrictionRatio):
            values[k] *= values[names.index(f.leader)]
    return limit_dynamic_friction(names, values)


@dataclass
class LogProblem(Problem):
    """A problem whose unknowns may be logarithms, a friction by its ratio to the other one of the same body."""

    stage: Stage = NO_STAGE  # takes a step with each round of a fit

    @property
    def alone(self) -> Self:
        """The same for one thread."""
        return replace(self, workers=1, _lanes={})

    def find_flat(self, free: Sequence[Free], x: Floats) -> Floats:
        """Directions (p, k) of scaled unknowns at `x` (p,) that no signal shows."""
        return find_flat_directions(self, free, x)

    def convert_unknowns(self, free: Sequence[Free], x: Floats) -> Floats:
        return np.array([compute_values(free, row) for row in x])

    def list_values(self, free: Sequence[Free], x: Floats) -> dict[str, float]:
        return dict(zip([f.name for f in free], compute_values(free, x).tolist(), strict=True))


PATIENCE = 3  # rounds without a gain, in which the covariance still grows to what it is
DIRECTION_WIDTH_SD = 3.0  # of a difference, standard deviations
SMOOTH_WIDTHS = (-3.0, -1.0, -0.3, 0.3, 1.0, 3.0)  # of differences that are compared, standard deviations
FIRST_WIDTH = 10.0  # of the covariance that a last fit begins with: narrow differences see jumps alone, and stay narrow
SMOOTH_PASSES = 4  # in which the covariance settles
PROFILE_CUT, PROFILE_SHORTEST = 0.25, 1e-3  # factor on a step that fails; the shortest one, of the range
WIDEST_VARIANCE, NARROWEST_VARIANCE = 25.0, 1e-14  # variances of scaled unknowns, within which a direction is taken


def take_best_step(problem: Problem, fit: Fit) -> Fit:
    """The best of some damped Gauss-Newton steps; the fit itself if none gains."""
    gradient, hessian = form_normal_equations(fit)
    best = find_best_trial(problem, fit, step_within_bounds(fit, hessian, gradient))
    return best if best.cost < fit.cost else fit


def take_curved_step(problem: Problem, fit: Fit) -> Fit:
    """The best of some damped steps, each then led back twice to the floor of the valley; the fit if none gains.

    Where an effect does what a tolerance does the valley is narrow and bends: a straight step along it soon climbs a
    wall. What that adds to the residuals further steps with the same Jacobian take away (chord steps).
    """
    prior = weigh_priors(fit.free)
    gradient, hessian = form_normal_equations(fit)
    heavy = (fit.jacobian * compute_weights(fit.white)).reshape(len(fit.x), -1)
    ends, gradients = [fit.x] * len(DAMPINGS), [gradient] * len(DAMPINGS)
    best, least = fit.x, fit.cost
    for _ in range(3):
        x = np.array([step_within_bounds(replace(fit, x=end), hessian, g, (damping,))[0]
                      for end, g, damping in zip(ends, gradients, DAMPINGS, strict=True)])
        white = problem.compute_white_residuals(fit.free, x)
        costs = compute_misfit(white) + x**2 @ prior
        if costs.min() < least:
            best, least = x[int(np.argmin(costs))], float(costs.min())
        ends, gradients = list(x), [heavy @ r.reshape(-1) + prior * end for r, end in zip(white, x, strict=True)]
    return replay_fit(problem, fit, best) if least < fit.cost else fit


def finish_fit(problem: Problem, fit: Fit, rounds: int = 8, slopes: Problem | None = None,
               stage: Stage = NO_STAGE, take_step: Callable[[Problem, Fit], Fit] = take_best_step) -> Fit:
    """A fit taken to the end, with a covariance that holds at the width of its own intervals.

    `slopes`: the same problem with coarser steps, for the differences; default `problem` itself. `stage` takes a step
    with each round, which is made by `take_step`.
    """
    if not fit.free:  # a plant without tolerances
        return replace(replay_fit(problem, fit, fit.x), converged=True)
    slopes = slopes or problem
    now = relax_fit(problem, fit, find_tangents(slopes, fit.free, fit.x)[0])
    if now is fit:  # its residuals may be those of other steps, another noise or another place
        now = replay_fit(problem, fit, fit.x)
    _, flat = find_tangents(slopes, now.free, now.x)
    linearise = linearise_along
    if not problem.model.values.keys() >= BALANCED:  # nobody has declared what no signal shows
        linearise, now = linearise_smoothly, replace(now, covariance=FIRST_WIDTH**2 * now.covariance)
    now = take_steps(problem, now, partial(linearise, slopes, flat=flat), rounds, stage, take_step)
    return replace(relax_fit(problem, now, find_tangents(slopes, now.free, now.x)[0]), converged=True)


def take_steps(problem: Problem, fit: Fit, linearise: Callable[[Fit], Fit], rounds: int, stage: Stage,
               take_step: Callable[[Problem, Fit], Fit] = take_best_step) -> Fit:
    """A fit after so many rounds of damped Gauss-Newton steps, fewer if `PATIENCE` of them gain nothing."""
    idle = 0
    for _ in range(rounds):
        start = linearise(fit)
        fit = take_step(problem, start)
        idle = idle + 1 if start.cost - fit.cost < CONVERGED_GAIN else 0
        stage.finish_step()
        if idle >= PATIENCE:
            break
    return fit


def linearise_along(slopes: Problem, fit: Fit, flat: Floats) -> Fit:
    """A fit with its Jacobian by differences along the principal directions of its covariance, and the next covariance.

    The residuals stay those of `fit`; the differences are those of `slopes`. Along `flat` (p, k) there is no slope.
    """
    x = fit.x
    moves = np.array([cut_at_bounds(fit.free, x, d) for d in _find_principal(fit.covariance).T])
    white = slopes.compute_white_residuals(fit.free, np.vstack([x, x + moves]))
    steep = np.asarray(np.linalg.pinv(moves), np.float64) @ (white[1:] - white[0]).reshape(len(x), -1)
    return _weigh_slopes(fit, remove_slope(steep.reshape(len(x), *fit.white.shape), flat))


def _weigh_slopes(fit: Fit, jacobian: Floats) -> Fit:
    """A fit with this Jacobian (p, s, n), the covariance that follows from it, and its cost with the priors."""
    x, prior = fit.x, np.diag(weigh_priors(fit.free))
    heavy = (jacobian * compute_weights(fit.white)).reshape(len(x), -1)
    covariance = invert_hessian(heavy @ jacobian.reshape(len(x), -1).T + prior)
    return replace(fit, cost=fit.misfit + float(x @ prior @ x), covariance=covariance, jacobian=jacobian)


def _find_principal(covariance: Floats) -> Floats:
    """Principal directions (p, p), one a column, `DIRECTION_WIDTH_SD` standard deviations long."""
    variances, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(DIRECTION_WIDTH_SD * vectors * np.sqrt(np.clip(variances, NARROWEST_VARIANCE, WIDEST_VARIANCE)))


def descend_valley(problem: Problem, fit: Fit, rounds: int, flat: Floats, stage: Stage = NO_STAGE,
                   slopes: Problem | None = None) -> Fit:
    """A fit after so many rounds of steps across the valley, then moved along it to where the priors want it.

    `flat` (p, k) are the directions that the data do not see. `stage` takes a step with each round. `slopes`: the same
    problem with coarser steps, for the differences; default `problem` itself.
    """
    linearise = partial(linearise_across, slopes or problem, flat=flat)
    end = take_steps(problem, replay_fit(problem, fit, fit.x), linearise, rounds, stage)
    return replace(relax_along(end, flat), converged=True)


def list_moves_across(free: Sequence[Free], covariance: Floats, flat: Floats, width: float
                      ) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Places (k,) of the unknowns across the valley, the inverse (k, p) of their coordinates, and moves (k, p) of
    `width` standard deviations along the principal directions there.
    """
    places = choose_across(free, flat)
    basis = np.column_stack([np.eye(len(free))[:, places], flat])
    inverse = np.linalg.inv(basis)[:len(places)]  # of the coordinates across by all unknowns
    variances, vectors = np.linalg.eigh(inverse @ covariance @ inverse.T)
    moves = np.zeros((len(places), len(free)))
    moves[:, places] = (width * vectors * np.sqrt(np.clip(variances, 1e-12, 9.0))).T
    return places, inverse, moves


def estimate_smooth_covariance(problem: Problem, fit: Fit, flat: Floats) -> Floats:
    """The covariance (p, p) of a fit by the slopes that the model has where it is smooth."""
    fit = replace(fit, covariance=FIRST_WIDTH**2 * fit.covariance)
    for _ in range(SMOOTH_PASSES):
        fit = linearise_smoothly(problem, fit, flat)
    return fit.covariance


def linearise_smoothly(slopes: Problem, fit: Fit, flat: Floats) -> Fit:
    """A fit with its Jacobian by the slopes that the model has where it is smooth, and the next covariance.

    A stop that comes or goes within a difference makes it jump, and the jump is no slope: taken for one, it makes
    directions known that are not, and intervals too narrow. So differences are taken at several widths, either
    way, and each principal direction counts with the least of its slopes. The directions follow the covariance.
    """
    free, x = fit.free, fit.x
    low, high = scaled_bounds(free)
    places, inverse, ways = list_moves_across(free, fit.covariance, flat, 1.0)
    moves = np.clip(x + np.multiply.outer(SMOOTH_WIDTHS, ways), low, high) - x
    white = slopes.compute_white_residuals(free, np.vstack([x, x + moves.reshape(-1, len(x))]))
    shifts = (white[1:] - white[0]).reshape(*moves.shape[:2], -1)
    length = np.linalg.norm(moves, axis=2) / np.linalg.norm(ways, axis=1)
    is_long = length > 0.5 * min(map(abs, SMOOTH_WIDTHS))  # others a bound has cut off
    squares = (compute_weights(fit.white).reshape(-1) * shifts**2).sum(axis=2)
    steepness = np.where(is_long, squares / np.maximum(length, 1e-9) ** 2, np.inf)
    least = steepness.argmin(axis=0), np.arange(len(ways))
    steep = np.asarray(np.linalg.pinv(moves[least][:, places]), np.float64) @ shifts[least]
    return _weigh_slopes(fit, (inverse.T @ steep).reshape(len(x), *fit.white.shape))


def linearise_across(slopes: Problem, fit: Fit, flat: Floats) -> Fit:
    """A fit with its Jacobian by differences across the valley, along principal directions there."""
    free, x = fit.free, fit.x
    places, inverse, ways = list_moves_across(free, fit.covariance, flat, DIRECTION_WIDTH_SD)
    moves = np.array([cut_at_bounds(free, x, way) for way in ways])
    white = slopes.compute_white_residuals(free, np.vstack([x, x + moves]))
    steep = np.asarray(np.linalg.pinv(moves[:, places]), np.float64) @ (white[1:] - white[0]).reshape(len(places), -1)
    return _weigh_slopes(fit, (inverse.T @ steep).reshape(len(x), *fit.white.shape))


def start_fit(free: Sequence[Free], x: Floats) -> Fit:
    """A fit at `x` (p,) before its first round."""
    none = np.empty((0, 0))
    return Fit(tuple(free), x, np.inf, np.inf, guess_covariance(free), none, none, none)


def guess_covariance(free: Sequence[Free], across: float = 1e-3) -> Floats:
    """A covariance, (p, p), that gives differences across the valley their first width."""
    def guess_variance(f: Free) -> float:
        if not np.isfinite(f.prior):  # a parameter of an effect
            return (f.step / 3.0) ** 2
        return min(across / f.scale, 0.1) ** 2 if type(f) is not Free else 1e-4

    return np.diag([guess_variance(f) for f in free])


def descend(problem: LogProblem, fit: Fit, schedule: Sequence[tuple[float, int]],
            shown_by: LogProblem | None = None) -> Fit:
    """The fit after (factor, rounds) each: the noise so many times as large, so that small stops of the ram count late.

    Its covariance begins anew each time. `shown_by` tells which directions no signal shows, by default the problem.
    """
    for factor, rounds in schedule:
        start = replace(fit, covariance=guess_covariance(fit.free))
        flat = (shown_by or problem).find_flat(fit.free, fit.x)
        fit = descend_valley(scale_noise(problem, factor), start, rounds, flat, problem.stage)
    return fit


def follow_profile(problem: Problem, fit: Fit, k: int, end: float, more: float) -> list[Fit]:
    """The fits along unknown `k` from a fit to `end`, scaled, that cost at most `more` than it does, the others fitted.

    A valley may bend, so a step goes on along the last one and is cut until the fit follows. What lies behind a ridge
    at which every step fails is tried as well.
    """
    fits, share, f = [fit], 1.0, fit.free[k]
    shortest = PROFILE_SHORTEST * (f.high - f.low) / f.scale

    def fit_at(place: float) -> Fit:
        value, x, last = f.centre + f.scale * place, fits[-1].x, fits[-min(2, len(fits))].x
        ahead = (place - x[k]) / (x[k] - last[k]) if x[k] != last[k] else 0.0
        x = np.clip(x + (x - last) * ahead * (ahead <= 1.0 / PROFILE_CUT), *scaled_bounds(fit.free))
        x[k] = place
        return replace(fit_unknowns(problem, [*fit.free[:k], f._replace(low=value, high=value), *fit.free[k + 1:]], x,
                                    4), free=fit.free)

    while abs(rest := end - fits[-1].x[k]) > shortest:
        shares = min(share / PROFILE_CUT, 1.0) * PROFILE_CUT ** np.arange(8.0)
        trials = (fit_at(end - (1.0 - float(part)) * rest)
                  for part in (*shares[shares * abs(rest) > shortest], 0.25, 0.5, 0.75, 1.0))
        found = next((each for each in trials if each.cost <= fit.cost + more), None)
        if found is None:
            break
        share = (found.x[k] - fits[-1].x[k]) / rest
        fits.append(found)
    return fits


def search_widely(problem: LogProblem, shown_by: LogProblem, home: Fit, widths: Floats,
                  stages: Sequence[tuple[float, int]], seed: int) -> Fit:
    """The fit at which a population ends that begins about `home`.

    Args:
        problem: the run, with steps that suffice for a population.
        shown_by: tells which directions no signal shows.
        home: where the search begins.
        widths: (p,) of the first trials, scaled, of unknowns that slopes lead astray: these begin at home.
        stages: factor on the noise and generations, each.
        seed: of the trials.
    """
    start = descend(problem, home, ((stages[0][0], 3),), shown_by)
    spread = 9.0 * start.covariance + np.diag(widths**2)
    start = replace(start, x=np.where(widths > 0.0, home.x, start.x))
    return follow_population(problem, start, spread, stages, seed,
                             lambda fit, factor: descend(problem, fit, ((factor, 2),), shown_by))
