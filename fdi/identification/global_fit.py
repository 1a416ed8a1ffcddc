"""A fit that begins far from the answer: several starts, noise taken for larger at first, scans along each unknown.

A replay of a model that is far off meets every stop of the ram at another time, so the misfit has many valleys. Three
things find the right one. Starts are scattered about the data sheet's values. The noise counts for a hundred times its
size at first, so that small stops count late. And before each stage every unknown is tried on a grid with the others
held: runs side by side cost little, and a grid steps over ridges at which slopes point the wrong way.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fdi.estimation import (
    Fit,
    Free,
    LogFree,
    LogFrictionRatio,
    LogProblem,
    compute_misfit,
    compute_values,
    descend,
    evolve_fit,
    fit_unknowns,
    follow_population,
    follow_profile,
    scale_noise,
    scaled_bounds,
    search_widely,
    start_fit,
)
from fdi.progress import Progress, ignore_progress
from fdi.trace import Floats
from plant import map_in_threads, map_together

# factor on the noise, fits that go on, rounds of each, solver steps a cycle
FIT_STAGES = ((100.0, 3, 3, 10), (30.0, 2, 4, 10), (6.0, 1, 5, 20), (1.0, 1, 8, 20))
# of a search by a population: factor on the noise, generations
NARROW_STAGES = ((30.0, 40), (6.0, 40), (1.0, 40))
WIDE_STAGES = ((100.0, 30), *NARROW_STAGES)
SEARCH_STEPS = 10  # solver steps a cycle
SEARCHES = 4  # pairs of such searches at most
SEARCH_GAIN = 0.1  # share of the excess misfit that a pair must remove for another one to follow
FITTED_SQUARE = 1.02  # mean square of whitened residuals up to which no other valley is looked for
PROFILE_STEP = 0.05  # of the logarithm, or of the range
SCATTERED = 48  # starts beside the data sheet's values
GRID = (-0.3, -0.15, -0.07, -0.03, -0.01, 0.01, 0.03, 0.07, 0.15, 0.3)  # of the logarithm, or of half a range


def scale_values(free: Sequence[Free], values: Mapping[str, float]) -> Floats:
    """Scaled unknowns, (p,), of parameters by name, SI, within the bounds; the centre for what is not named."""
    x = np.zeros(len(free))
    for k, f in enumerate(free):
        if f.name in values:
            parameter = values[f.name]
            value = max(parameter / values[f.leader], 1.0) if isinstance(f, LogFrictionRatio) else parameter
            place = math.log(value) if isinstance(f, LogFree) else value
            x[k] = (min(max(place, f.low), f.high) - f.centre) / f.scale
    return x


def sample_starts(free: Sequence[Free], seed: int) -> Floats:
    """Starts (m, p): the data sheet, and some scattered about it by 0.4 of what is known of each unknown.

    Tolerances are not scattered.
    """
    spread = 0.4 * np.array([is_wide(f) for f in free])
    offsets = spread * np.random.default_rng(seed).standard_normal((SCATTERED, len(free)))
    low, high = scaled_bounds(free)
    return np.clip(np.vstack([np.zeros(len(free)), offsets]), low, high)


def is_wide(f: Free, tolerance: float = 0.04) -> bool:
    """Whether an unknown is more than a tolerance of healthy units."""
    return f.scale * f.prior > tolerance if isinstance(f, LogFree) else f.prior * f.scale > tolerance * abs(f.centre)


def fit_from_afar(problem: LogProblem, free: Sequence[Free], seed: int, progress: Progress = ignore_progress) -> Fit:
    """The best fit from the data sheet's values and from scattered starts."""
    starts, factor = sample_starts(free, seed), FIT_STAGES[0][0]
    costs = compute_misfit(scale_noise(problem, factor).compute_white_residuals(free, starts))
    first_starts = [starts[0], *starts[[k for k in np.argsort(costs) if k != 0][:FIT_STAGES[0][1] - 1]]]
    fits = [start_fit(free, x) for x in first_starts]
    for number, (factor, count, rounds, steps) in enumerate(FIT_STAGES):
        progress(f"fitting, {len(fits[:count])} at a time", 0.1 + 0.15 * number)

        def advance(fit: Fit, steps: int = steps, rounds: int = rounds, factor: float = factor) -> Fit:
            alone = replace(problem.alone, steps=steps)
            return descend(alone, scan_unknowns(scale_noise(alone, factor), fit), ((factor, rounds),))

        fits = sorted(map_in_threads(advance, fits[:count], problem.workers), key=lambda fit: fit.cost)
    return fits[0]


def search_other_valleys(problem: LogProblem, fit: Fit, seed: int, progress: Progress = ignore_progress) -> Fit:
    """The best of a fit and of searches by populations, two at a time, until one leaves only noise.

    A narrow search begins at the best fit so far. A wide one begins at the data sheet's values, which know nothing of
    the valley that the fit ended in. Each finds what the other misses (docs/identify.md). The searches take coarse
    steps; what they find is fitted to the `problem` with its own steps.
    """
    best = fit
    for attempt in range(SEARCHES):
        if is_fitted(best):
            break
        progress(f"search of other valleys, {attempt + 1} of at most {SEARCHES}", 0.75 + 0.15 * attempt / SEARCHES)

        def search(is_wide_search: bool, best: Fit = best, number: int = attempt) -> Fit:
            coarse = replace(problem.alone, steps=SEARCH_STEPS)
            home, widths = start_fit(best.free, np.zeros(len(best.free))), _widen_frictions(best.free, 0.3, 0.2)
            end = (search_widely(coarse, coarse, home, widths, WIDE_STAGES, seed + number) if is_wide_search
                   else _search_narrowly(coarse, best, seed + number))
            return descend(problem.alone, end, ((1.0, 8),))

        excess = best.misfit - np.count_nonzero(best.white)
        best = min(best, *map_in_threads(search, (False, True), problem.workers), key=lambda fit: fit.cost)
        if best.misfit - np.count_nonzero(best.white) > (1.0 - SEARCH_GAIN) * excess:
            break  # physics is missing, or a range is too narrow: no other valley is deeper
    return best


def _search_narrowly(problem: LogProblem, best: Fit, seed: int) -> Fit:
    start = descend(problem, start_fit(best.free, best.x), ((NARROW_STAGES[0][0], 3),))
    spread = 4.0 * start.covariance + np.diag(_widen_frictions(best.free, 0.15, 0.0) ** 2)
    return follow_population(problem, start, spread, NARROW_STAGES, seed,
                             lambda fit, factor: descend(problem, fit, ((factor, 2),)))


def _widen_frictions(free: Sequence[Free], static: float, dynamic: float) -> Floats:
    """Widths (p,), scaled, of the first trials along static and dynamic frictions, given of the logarithm."""
    return np.array([0.0 if not is_wide(f) else static / f.scale if f.name.endswith("static_friction")
                     else dynamic / f.scale if f.name.endswith("dynamic_friction") else 0.0 for f in free])


def polish_fit(problem: LogProblem, fit: Fit, seed: int, generations: int = 25) -> Fit:
    """The fit at the lowest place near it: slopes stop at the first ridge of a rough valley, a population does not."""
    spread = 4.0 * fit.covariance + np.diag(_widen_frictions(fit.free, 0.02, 0.0) ** 2)
    end = evolve_fit(problem, fit, spread, generations, seed)
    return min(fit, descend(problem, end, ((1.0, 4),)), key=lambda each: each.cost)


def is_fitted(fit: Fit) -> bool:
    """Whether only noise is left, by its known size."""
    return bool(fit.misfit <= FITTED_SQUARE * np.count_nonzero(fit.white))


def scan_unknowns(problem: LogProblem, fit: Fit, rounds: int = 2) -> Fit:
    """The fit at the best place of a grid along each free unknown, one after the other; tolerances are left alone."""
    free, x = fit.free, fit.x
    low, high = scaled_bounds(free)
    steps = [(k, way / f.scale if isinstance(f, LogFree) else way) for k, f in enumerate(free) if is_wide(f)
             for way in GRID]
    for _ in range(rounds):
        trials = np.array([x, *(np.clip(put_unknown(x, k, x[k] + step), low, high) for k, step in steps)])
        costs = problem.compute_costs(free, trials)
        best = int(np.argmin(costs))
        if best == 0 or costs[best] > costs[0] - 1.0:
            break
        x = trials[best]
    return replace(fit, x=x)


def profile_unknowns(problem: LogProblem, fit: Fit) -> Fit:
    """The fit at the best place of all profiles: each wide unknown goes through its range, the others fitted along.

    What rings after a step has a minimum for every number of turns that it may be off, and along a mass these lie in a
    narrow valley: neither slopes nor a grid with the others held step from one to the next.
    """
    low, high = scaled_bounds(fit.free)

    def follow(task: tuple[int, float]) -> Fit:
        k, way = task
        free, f = list(fit.free), fit.free[k]
        step = PROFILE_STEP / f.scale if isinstance(f, LogFree) else PROFILE_STEP * (high[k] - low[k])
        best = now = fit
        for place in np.arange(fit.x[k] + way * step, high[k] if way > 0.0 else low[k], way * step):
            value = f.centre + f.scale * place
            free[k] = f._replace(low=value, high=value)
            now = fit_unknowns(problem, free, put_unknown(now.x, k, place), 2)
            best = min(best, now, key=lambda each: each.cost)
        return replace(best, free=fit.free)

    tasks = [(k, way) for k, f in enumerate(fit.free) if is_wide(f) for way in (-1.0, 1.0)]
    return min([fit, *map_together(follow, tasks, problem.workers)], key=lambda each: each.cost)


def profile_ranges(problem: LogProblem, fit: Fit, more: float) -> dict[str, tuple[float, float]]:
    """The ranges of the wide unknowns, SI by name, within which a fit costs at most `more` than at its best.

    Slopes at one place say nothing of a valley that bends, such as that of parameters of which only products show.
    """
    coarse = replace(problem.alone, steps=SEARCH_STEPS)
    start = fit_unknowns(coarse, fit.free, fit.x)
    ends = [(k, float(end[k])) for k, f in enumerate(fit.free) if is_wide(f) for end in scaled_bounds(fit.free)]
    values = np.array([compute_values(fit.free, each.x) for fits in map_in_threads(
        lambda task: follow_profile(coarse.alone, start, *task, more), ends, problem.workers) for each in fits])
    return {fit.free[k].name: (float(values[:, k].min()), float(values[:, k].max())) for k, _ in ends}


def put_unknown(x: Floats, k: int, value: float) -> Floats:
    """Scaled unknowns, (p,), with another value of unknown k."""
    unknowns = x.copy()
    unknowns[k] = value
    return unknowns
