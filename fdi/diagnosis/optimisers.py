"""Other ways to the sizes of the two faults, from the grid's answer: what each finds, and the simulations it takes.

Least squares (the default) frees every tolerance and every suspect beside the faults, and knows their priors. The
global optimisers solve the paper's problem: Kintas and FSS, and the spool's FDS/FSS, in a box around the grid's answer,
with the rest of the unit as the model has it. All minimise the same misfit, the block-wise one of the whitened replay.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import STATIC_OVER_DYNAMIC
from fdi.diagnosis.refine import (
    COARSE_STARTS,
    CountedProblem,
    list_unknowns,
    make_problem,
    make_start,
    refine_sizes,
)
from fdi.estimation.likelihood import compute_misfit
from fdi.trace.trace import Trace
from plant.model import Model

Floats = NDArray[np.float64]


class Attempt(NamedTuple):
    """What one method found."""

    method: str
    kintas: float
    fss: float  # N
    left: float  # RMS residual over noise
    simulations: int
    intervals: bool  # whether the method gives intervals


class Objective:
    """Misfit of a plant with (Kintas, ln FSS, FDS/FSS), nominal otherwise, and the box that is searched.

    The box reaches `around` in Kintas and a factor of `factor` in FSS either way of the grid's answer `start`.
    """

    def __init__(self, problem: CountedProblem, model: Model, start: tuple[float, float], around: float = 0.2,
                 factor: float = 2.0, sliding: tuple[float, float] = (0.05, 1.0)) -> None:
        self.problem, self.free = problem, list_unknowns(model)
        self.start = np.array([start[0], math.log(max(start[1], 1.0)), 1.0 / STATIC_OVER_DYNAMIC])
        k, f = self.start[:2]
        self.box = [(max(0.0, k - around), min(0.9, k + around)), (f - math.log(factor), f + math.log(factor)), sliding]
        self.start = np.clip(self.start, *np.transpose(self.box))
        self._sliding = [f.name for f in self.free].index("spool.dynamic_friction")

    def __call__(self, points: Floats) -> Floats:
        """Misfits, (m,), of points (m, 3)."""
        cost: Floats = compute_misfit(self._compute_white_residuals(points))
        return cost

    def report(self, method: str, point: Sequence[float]) -> Attempt:
        """The answer at a point; evaluating it once more does not count as a simulation."""
        spent = sum(self.problem.counts)
        white = self._compute_white_residuals(np.asarray(point, float)[None])
        left = float(np.sqrt(np.mean(white**2)))
        return Attempt(method, float(point[0]), math.exp(float(point[1])), left, spent, False)

    def _compute_white_residuals(self, points: Floats) -> Floats:
        x = np.array([make_start(self.free, k, math.exp(f)) for k, f, _ in points])
        sliding = self.free[self._sliding]
        x[:, self._sliding] = (points[:, 1] + np.log(points[:, 2]) - sliding.centre) / sliding.scale
        return self.problem.compute_white_residuals(self.free, x)


def search_by_least_squares(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float],
                            seed: int) -> Attempt:
    """The default: every tolerance and suspect free, Gauss-Newton steps."""
    r = refine_sizes(model, trace, (start, *COARSE_STARTS), floor)
    left = float(np.sqrt(np.mean(np.square([*r.ratio.values()]))))
    return Attempt("least squares", r.kintas.value, r.fss.value, left, r.simulations, True)


def search_by_differential_evolution(model: Model, trace: Trace, start: tuple[float, float],
                                     floor: Mapping[str, float], seed: int, population: int = 24, generations: int = 15
                                     ) -> Attempt:
    """scipy's differential evolution, a generation at a time in lanes."""
    from scipy.optimize import differential_evolution

    objective = Objective(make_problem(model, trace, floor), model, start)
    done = differential_evolution(lambda x: objective(x.T), objective.box, maxiter=generations, popsize=population // 3,
                                  tol=1e-3, rng=np.random.default_rng(seed), polish=False, vectorized=True,
                                  updating="deferred", x0=objective.start)
    return objective.report("differential evolution", done.x)


def search_by_simulated_annealing(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float],
                                  seed: int, simulations: int = 250) -> Attempt:
    """scipy's dual annealing, one simulation after the other."""
    from scipy.optimize import dual_annealing

    objective = Objective(make_problem(model, trace, floor), model, start)
    done = dual_annealing(lambda x: float(objective(x[None])[0]), objective.box, maxfun=simulations, x0=objective.start,
                          rng=np.random.default_rng(seed), no_local_search=True)
    return objective.report("simulated annealing", done.x)


def search_by_genetic_algorithm(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float],
                                seed: int, population: int = 24, generations: int = 15) -> Attempt:
    """A genetic algorithm (pygad), a generation at a time in lanes."""
    import pygad

    objective = Objective(make_problem(model, trace, floor), model, start)
    low, high = np.transpose(objective.box)
    rng = np.random.default_rng(seed)
    first = np.vstack([objective.start, rng.uniform(low, high, (population - 1, 3))])
    search = pygad.GA(num_generations=generations, num_parents_mating=population // 3, initial_population=first,
                      fitness_func=lambda ga, x, places: (-objective(np.asarray(x, float))).tolist(),
                      fitness_batch_size=population, gene_space=[{"low": a, "high": b} for a, b in objective.box],
                      keep_elitism=2, crossover_type="uniform", random_mutation_min_val=-0.1, mutation_probability=0.4,
                      random_mutation_max_val=0.1, random_seed=seed, suppress_warnings=True)
    search.run()
    return objective.report("genetic", search.best_solution(search.last_generation_fitness)[0])


METHODS: Mapping[str, Callable[..., Attempt]] = {
    "least squares": search_by_least_squares,
    "differential evolution": search_by_differential_evolution,
    "simulated annealing": search_by_simulated_annealing,
    "genetic": search_by_genetic_algorithm,
}


def is_available(method: str) -> bool:
    """Whether the packages of a method are installed: pygad comes with `pip install 'eha-rig[learn]'`."""
    from importlib.util import find_spec

    return method != "genetic" or find_spec("pygad") is not None
