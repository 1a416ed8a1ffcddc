"""Other methods for the fault sizes of a trace: what each one finds, its error, its simulations and its time."""

import argparse
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.diagnosis import Diagnosis, diagnose
from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Fault, Level, classify_size
from fdi.diagnosis.make_bands import simulate_units
from fdi.diagnosis.precursors import compute_features
from fdi.diagnosis.refine import (
    CountedProblem,
    list_coarse_starts,
    list_unknowns,
    make_problem,
    make_start,
    refine_sizes,
)
from fdi.estimation import compute_misfit
from fdi.progress import Progress, ignore_progress
from fdi.report import NO_NUMBER, Column, Report, Section, Table, format_digits
from fdi.trace import Trace, find_sections, hold_last
from plant import InputError, Model, load_model
from rig.network import WallClock
from studies.command import report_progress, run_study_command
from studies.hidden_effects.cases import measure_rms


class Row(NamedTuple):
    """The result of one method; None for what the method does not give."""

    method: str
    simulations: int
    kintas: float | None = None
    fss: float | None = None  # N
    left: float | None = None  # RMS of the residual, in noise floors
    error_kintas: float | None = None  # RMS on simulated units that were not used for training
    error_fss: float | None = None  # N
    right: dict[str, float] | None = None  # share of right levels on these units, by fault
    levels: dict[str, str] | None = None
    seconds: float = 0.0


def apply_optimisers(diagnosis: Diagnosis, seed: int, progress: Progress) -> Iterator[Row]:
    """Least squares and the global optimisers, each started from the sizes of the RMS grid."""
    start = diagnosis.grids[0].merged.sizes if diagnosis.grids else (0.1, 15.0)
    for number, (name, method) in enumerate(METHODS.items()):
        progress(name, number / len(METHODS))
        if name != "genetic" or is_installed("pygad"):
            row, seconds = measure_time(
                partial(method, diagnosis.model, diagnosis.trace, start, diagnosis.floor, seed))
            yield row._replace(seconds=seconds)


def apply_learners(diagnosis: Diagnosis, seed: int, progress: Progress) -> Iterator[Row]:
    """The learners; the time of each one includes the simulation of the units that both learn from.

    Raises:
        InputError: scikit-learn is not installed, or the trace shows no precursors.
    """
    if not is_installed("sklearn"):
        raise InputError("--learners", "scikit-learn", "installed: pip install 'eha-rig[learn]'")
    simulate = partial(simulate_lesson, diagnosis.trace, diagnosis.model, seed, progress)
    lesson, simulation_seconds = measure_time(simulate)
    for name, learner in LEARNERS.items():
        progress(name, 1.0)
        row, seconds = measure_time(partial(learner, lesson, seed))
        yield row._replace(seconds=simulation_seconds + seconds)


def is_installed(package: str) -> bool:
    """Whether a package is there; pygad and sklearn come with `pip install 'eha-rig[learn]'`."""
    return find_spec(package) is not None


def measure_time(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result of `work`, and the time it took, s."""
    clock = WallClock()
    start = clock.now()
    return work(), 1e-9 * (clock.now() - start)


def build_methods_section(rows: Sequence[Row]) -> Section:
    """A table of the methods: what each finds, what it leaves, its errors on known units, and what it costs."""
    titles = (("Kintas", ""), ("FSS", "N"), ("residual", "floors"), ("Kintas error", ""), ("FSS error", "N"),
              ("levels right", ""), ("simulations", ""), ("time", "s"))
    columns = [Column("method"), *(Column(title, unit, "right") for title, unit in titles)]
    cells = []
    for row in rows:
        sizes = [_format_known(row.kintas), _format_known(row.fss)]
        if row.kintas is None and row.levels:
            sizes = list(row.levels.values())
        shares = " ".join(f"{100 * share:.0f}%" for share in row.right.values()) if row.right else NO_NUMBER
        cells.append([row.method, *sizes, _format_known(row.left), _format_known(row.error_kintas),
                      _format_known(row.error_fss), shares, str(row.simulations), f"{row.seconds:.1f}"])
    return Section("Other methods", [Table(
        columns, cells, "Residual: RMS in units of the noise floor. Errors (RMS) and share of right levels (clogging, "
                        "friction): on simulated units that no training used.")])


def _format_known(x: float | None) -> str:
    return NO_NUMBER if x is None else format_digits(x)


Floats = NDArray[np.float64]


class Objective:
    """Misfit of a plant with (Kintas, ln FSS, FDS/FSS), nominal otherwise, and the box that is searched.

    The box reaches `around` in Kintas and a factor of `factor` in FSS either way of the grid's answer `start`.
    """

    def __init__(self, problem: CountedProblem, model: Model, start: tuple[float, float], around: float = 0.2,
                 factor: float = 2.0, sliding: tuple[float, float] = (0.05, 1.0)) -> None:
        self.problem, self.free = problem, list_unknowns(model)
        self.start = np.array([start[0], math.log(max(start[1], 1.0)), FRICTION.follow["spool.dynamic_friction"]])
        k, f = self.start[:2]
        self.box = [(max(0.0, k - around), min(0.9, k + around)), (f - math.log(factor), f + math.log(factor)), sliding]
        self.start = np.clip(self.start, *np.transpose(self.box))
        self._sliding = [f.name for f in self.free].index("spool.dynamic_friction")

    def __call__(self, points: Floats) -> Floats:
        """Misfits, (m,), of points (m, 3)."""
        return np.asarray(compute_misfit(self._compute_white_residuals(points)))

    def report(self, method: str, point: Sequence[float]) -> Row:
        """The answer at a point; evaluating it once more does not count as a simulation."""
        simulations = sum(self.problem.counts)
        white = self._compute_white_residuals(np.asarray(point, float)[None])
        residual = float(np.sqrt(np.mean(white**2)))
        return Row(method, simulations, float(point[0]), math.exp(float(point[1])), residual)

    def _compute_white_residuals(self, points: Floats) -> Floats:
        x = np.array([make_start(self.free, FAULTS, (k, math.exp(f))) for k, f, _ in points])
        sliding = self.free[self._sliding]
        x[:, self._sliding] = (points[:, 1] + np.log(points[:, 2]) - sliding.centre) / sliding.scale
        return self.problem.compute_white_residuals(self.free, x)


def search_by_least_squares(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float],
                            seed: int) -> Row:
    """The default: every tolerance and suspect free, Gauss-Newton steps."""
    r = refine_sizes(model, trace, (start, *list_coarse_starts(FAULTS)), floor)
    residual = float(np.sqrt(np.mean(np.square([*r.ratio.values()]))))
    kintas, fss = (r.sizes[fault.name].value for fault in FAULTS)
    return Row("least squares", r.simulations, kintas, fss, residual)


def search_by_differential_evolution(model: Model, trace: Trace, start: tuple[float, float],
                                     floor: Mapping[str, float], seed: int, population: int = 24, generations: int = 15
                                     ) -> Row:
    """scipy's differential evolution, a generation at a time in lanes."""
    from scipy.optimize import differential_evolution

    objective = Objective(make_problem(model, trace, floor), model, start)
    done = differential_evolution(lambda x: objective(x.T), objective.box, maxiter=generations, popsize=population // 3,
                                  tol=1e-3, rng=np.random.default_rng(seed), polish=False, vectorized=True,
                                  updating="deferred", x0=objective.start)
    return objective.report("differential evolution", done.x)


def search_by_simulated_annealing(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float],
                                  seed: int, simulations: int = 250) -> Row:
    """scipy's dual annealing, one simulation after the other."""
    from scipy.optimize import dual_annealing

    objective = Objective(make_problem(model, trace, floor), model, start)
    done = dual_annealing(lambda x: float(objective(x[None])[0]), objective.box, maxfun=simulations, x0=objective.start,
                          rng=np.random.default_rng(seed), no_local_search=True)
    return objective.report("simulated annealing", done.x)


def search_by_genetic_algorithm(model: Model, trace: Trace, start: tuple[float, float], floor: Mapping[str, float],
                                seed: int, population: int = 24, generations: int = 15) -> Row:
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


METHODS: Mapping[str, Callable[..., Row]] = {
    "least squares": search_by_least_squares,
    "differential evolution": search_by_differential_evolution,
    "simulated annealing": search_by_simulated_annealing,
    "genetic": search_by_genetic_algorithm,
}


class Lesson(NamedTuple):
    """Simulated units: precursors (m, k), sizes (m,), which of them are held out, and the trace's own precursors."""

    x: Floats
    kintas: Floats
    fss: Floats
    unseen: NDArray[np.bool_]
    own: Floats  # (1, k)


def simulate_lesson(trace: Trace, model: Model, seed: int = 0, progress: Progress = ignore_progress,
                    cloggings: Sequence[float] = (0.0, 0.08, 0.17, 0.22, 0.28, 0.33, 0.4, 0.5),
                    frictions: Sequence[float] = (5.0, 12.0, 22.0, 31.0, 40.0, 55.0, 65.0, 78.0, 95.0),
                    units: int = 16, held_out: int = 4) -> Lesson:
    """Units with every pair of fault sizes on the trace's command, and the trace.

    Args:
        trace: prepared for replay.
        model: the unit as it left the works.
        seed: of the units.
        progress: called with each stage and the share done, 0 to 1.
        cloggings: Kintas; none is at a limit, which has no level of its own.
        frictions: FSS, N; none is at a limit.
        units: simulated of each pair.
        held_out: of these, that no training sees.

    Raises:
        InputError: a command or a trace that shows no precursors.
    """
    com, parts = hold_last(trace.com), find_sections(trace.com, trace.period)
    xj, rows = trace.mask_unusable("xj"), np.arange(len(trace))
    is_measured = ~np.isnan(xj)
    trace_features = compute_features(com, np.interp(rows, rows[is_measured], xj[is_measured])[None], trace.period,
                                      parts)
    if not trace_features:
        raise InputError("--comparators", "com", "steps or slow ramps: the learners see nothing but precursors")
    pairs = [(k, f) for k in cloggings for f in frictions]
    tables = []
    for number, (k, f) in enumerate(pairs):
        progress("simulating faults to learn from", number / len(pairs))
        positions = simulate_units(model, com, trace.load, CLOGGING.list_changes(k) | FRICTION.list_changes(f), units,
                                   seed + number)
        features = compute_features(com, positions, trace.period, parts)
        tables.append(np.column_stack([features[name] for name in trace_features]))
    x = np.vstack([*tables, np.array([[trace_features[name][0] for name in trace_features]])])
    x = np.where(np.isfinite(x), x, np.nanmedian(np.where(np.isfinite(x), x, np.nan), axis=0))
    sizes = np.repeat(np.array(pairs), units, axis=0)
    unseen = np.tile(np.arange(units) >= units - held_out, len(pairs))
    return Lesson(x[:-1], sizes[:, 0], sizes[:, 1], unseen, x[-1:])


def train_neural_network(data: Lesson, seed: int = 0, neurons: tuple[int, ...] = (24, 12)) -> Row:
    """A small multilayer perceptron on standardised precursors, trained on Kintas and ln FSS."""
    from sklearn.neural_network import MLPRegressor

    target = np.column_stack([data.kintas / 0.1, np.log(data.fss)])
    net = _make_pipeline(MLPRegressor(hidden_layer_sizes=neurons, alpha=1e-2, solver="lbfgs", max_iter=400,
                                      random_state=seed))
    with warnings.catch_warnings(action="ignore"):  # it stops before it has converged: that would be overfitting
        net.fit(data.x[~data.unseen], target[~data.unseen])

    def predict(x: Floats) -> tuple[Floats, Floats]:
        out = net.predict(x)
        return np.maximum(0.1 * out[:, 0], 0.0), np.exp(out[:, 1])

    k, f = predict(data.x[data.unseen])
    own_k, own_f = (float(v[0]) for v in predict(data.own))
    right = {CLOGGING.name: _count_right(CLOGGING, k, data.kintas[data.unseen]),
             FRICTION.name: _count_right(FRICTION, f, data.fss[data.unseen])}
    levels = {CLOGGING.name: classify_size(CLOGGING, own_k).word, FRICTION.name: classify_size(FRICTION, own_f).word}
    return Row("neural network", len(data.x), own_k, own_f, None, measure_rms(k - data.kintas[data.unseen]),
               measure_rms(f - data.fss[data.unseen]), right, levels)


def train_logistic_regression(data: Lesson, seed: int = 0) -> Row:
    """Multinomial logistic regression on standardised precursors and their products, one for each fault's levels."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    levels, right = {}, {}
    for fault, sizes in zip(FAULTS, (data.kintas, data.fss), strict=True):
        true = np.array([int(classify_size(fault, s)) for s in sizes])
        learner = _make_pipeline(PolynomialFeatures(2, include_bias=False), StandardScaler(),
                                 LogisticRegression(C=1.0, max_iter=300, random_state=seed))
        learner.fit(data.x[~data.unseen], true[~data.unseen])
        right[fault.name] = float(np.mean(learner.predict(data.x[data.unseen]) == true[data.unseen]))
        levels[fault.name] = Level(int(learner.predict(data.own)[0])).word
    return Row("logistic regression", len(data.x), right=right, levels=levels)


LEARNERS = {"neural network": train_neural_network, "logistic regression": train_logistic_regression}


def _make_pipeline(*steps: Any) -> Any:
    """The steps of a learner behind standardised precursors."""
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), *steps)


def _count_right(fault: Fault, predictions: Floats, true: Floats) -> float:
    """Share of units whose level is right."""
    right = [classify_size(fault, a) == classify_size(fault, b) for a, b in zip(predictions, true, strict=True)]
    return float(np.mean(right))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the comparison."""
    parser.add_argument("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV")
    parser.add_argument("--optimisers", action="store_true", help="only the global optimisers")
    parser.add_argument("--learners", action="store_true", help="only the network and the regression")


def compare_methods(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report: the sizes of `rig fdi`, then those of the other methods.

    Raises:
        InputError: a trace that cannot be judged, or scikit-learn is not installed.
    """
    diagnosis = diagnose(Trace.read(args.trace), load_model(), progress=report_progress)
    rows: list[Row] = []
    if args.optimisers or not args.learners:
        rows += apply_optimisers(diagnosis, args.seed, report_progress)
    if args.learners or not args.optimisers:
        rows += apply_learners(diagnosis, args.seed, report_progress)
    estimates = {fault: diagnosis.sizes[fault.name].value for fault in FAULTS}
    sizes = ", ".join(f"{fault.symbol} {size:.3g} {fault.unit}".strip() for fault, size in estimates.items())
    return Report(command="fault_size_methods", title=str(args.trace), sentence=f"rig fdi finds {sizes}.",
                  sections=[build_methods_section(rows)], data={"methods": [row._asdict() for row in rows]}), True


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the methods; see --help."""
    return run_study_command("studies.fault_size_methods", __doc__, arguments, add_options, compare_methods)


if __name__ == "__main__":
    raise SystemExit(main())
