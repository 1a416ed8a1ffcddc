"""Other ways to the sizes of the two faults, from the grid's answer: what each finds, and the simulations it takes.

Least squares (the default) frees every tolerance and every suspect beside the faults, and knows their priors. The
global optimisers get the paper's problem: Kintas and FSS, and the spool's FDS/FSS, in a box around the grid's answer,
the rest of the unit as the model has it. All minimise the same measure: the whitened replay's misfit in blocks.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.fault_unknowns import free_parameters, start_of
from fdi.diagnosis.refine import COARSE, Counted, problem_of, refine
from fdi.estimation.fit import misfit
from fdi.trace.trace import Trace
from plant.model import Model

Floats = NDArray[np.float64]

AROUND = 0.2  # of Kintas, either way of the grid's answer
FACTOR = 2.0  # of FSS, either way
SLIDING = (0.05, 1.0)  # FDS over FSS
POPULATION, GENERATIONS = 24, 15  # of those that have them
ANNEALED = 250  # simulations, one after the other


class Attempt(NamedTuple):
    """What one method found."""

    method: str
    kintas: float
    fss: float  # N
    left: float  # RMS of what is left of the signals, in floors
    simulations: int
    intervals: bool  # whether it tells how sure it is


class Objective:
    """Misfit of a plant with (Kintas, ln FSS, FDS/FSS), nominal otherwise, and the box that is searched."""

    def __init__(self, problem: Counted, model: Model, start: tuple[float, float]) -> None:
        self.problem, self.free = problem, free_parameters(model)
        self.start = np.array([start[0], math.log(max(start[1], 1.0)), 2.0 / 3.0])
        k, f = self.start[:2]
        self.box = [(max(0.0, k - AROUND), min(0.9, k + AROUND)), (f - math.log(FACTOR), f + math.log(FACTOR)), SLIDING]
        self.start = np.clip(self.start, *np.transpose(self.box))
        self._sliding = [f.name for f in self.free].index("spool.dynamic_friction")

    def __call__(self, points: Floats) -> Floats:
        """Misfits, (m,), of points (m, 3)."""
        cost: Floats = misfit(self._white(points))
        return cost

    def found(self, method: str, point: Sequence[float]) -> Attempt:
        """The answer at a point; looking at it once more counts no simulation."""
        spent = sum(self.problem.counts)
        white = self._white(np.asarray(point, float)[None])
        left = float(np.sqrt(np.mean(white**2)))
        return Attempt(method, float(point[0]), math.exp(float(point[1])), left, spent, False)

    def _white(self, points: Floats) -> Floats:
        x = np.array([start_of(self.free, k, math.exp(f)) for k, f, _ in points])
        sliding = self.free[self._sliding]
        x[:, self._sliding] = (points[:, 1] + np.log(points[:, 2]) - sliding.centre) / sliding.scale
        return self.problem.whitened(self.problem.residuals(self.free, x))


def least_squares(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float], seed: int
                  ) -> Attempt:
    """The default: every tolerance and suspect free, Gauss-Newton steps."""
    r = refine(model, trace, (start, *COARSE), floor)
    return Attempt("least squares", r.kintas.value, r.fss.value, rms([*r.ratio.values()]), r.simulations, True)


def differential_evolution(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float],
                           seed: int) -> Attempt:
    """scipy's differential evolution, a generation at a time in lanes."""
    from scipy.optimize import differential_evolution as search

    objective = Objective(problem_of(model, trace, floor), model, start)
    done = search(lambda x: objective(x.T), objective.box, maxiter=GENERATIONS, popsize=POPULATION // 3, tol=1e-3,
                  rng=np.random.default_rng(seed), polish=False, vectorized=True, updating="deferred",
                  x0=objective.start)
    return objective.found("differential evolution", done.x)


def simulated_annealing(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float], seed: int
                        ) -> Attempt:
    """scipy's dual annealing, one simulation after the other."""
    from scipy.optimize import dual_annealing

    objective = Objective(problem_of(model, trace, floor), model, start)
    done = dual_annealing(lambda x: float(objective(x[None])[0]), objective.box, maxfun=ANNEALED, x0=objective.start,
                          rng=np.random.default_rng(seed), no_local_search=True)
    return objective.found("simulated annealing", done.x)


def genetic(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float], seed: int) -> Attempt:
    """A genetic algorithm (pygad), a generation at a time in lanes."""
    import pygad

    objective = Objective(problem_of(model, trace, floor), model, start)
    low, high = np.transpose(objective.box)
    rng = np.random.default_rng(seed)
    first = np.vstack([objective.start, rng.uniform(low, high, (POPULATION - 1, 3))])
    search = pygad.GA(num_generations=GENERATIONS, num_parents_mating=POPULATION // 3, initial_population=first,
                      fitness_func=lambda ga, x, places: (-objective(np.asarray(x, float))).tolist(),
                      fitness_batch_size=POPULATION, gene_space=[{"low": a, "high": b} for a, b in objective.box],
                      keep_elitism=2, crossover_type="uniform", random_mutation_min_val=-0.1, mutation_probability=0.4,
                      random_mutation_max_val=0.1, random_seed=seed, suppress_warnings=True)
    search.run()
    return objective.found("genetic", search.best_solution(search.last_generation_fitness)[0])


METHODS: tuple[Callable[..., Attempt], ...] = (least_squares, differential_evolution, simulated_annealing, genetic)


def available(method: Callable[..., Attempt]) -> bool:
    """Whether what a method needs is installed: pygad comes with `pip install 'eha-rig[learn]'`."""
    from importlib.util import find_spec

    return method is not genetic or find_spec("pygad") is not None


def rms(x: Sequence[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))
