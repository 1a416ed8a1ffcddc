"""Learners for comparison: a neural network and a logistic regression, trained on simulated faults.

Both see the precursors of a response and nothing else. The network learns the two sizes, the regression the two
levels. Training units have the tolerances and the noise of a fleet, on the trace's own command and load.
"""
from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Fault, Level, classify_size
from fdi.diagnosis.precursors import compute_features
from fdi.diagnosis.simulated_units import UnitKind, simulate_units
from fdi.progress import Progress, ignore_progress
from fdi.trace.sections import find_sections
from fdi.trace.trace import Trace, hold_last
from plant.errors import InputError
from plant.model import Model

Floats = NDArray[np.float64]


class LearnerAnswer(NamedTuple):
    """A learner's answer on a trace, and its errors on units that it was not trained on."""

    method: str
    kintas: float  # NaN if the learner gives levels only
    fss: float  # N
    levels: dict[str, Level]
    error_kintas: float  # RMS on held-out units
    error_fss: float  # N
    right: dict[str, float]  # share of the levels that are right, by fault
    simulations: int


class Lesson(NamedTuple):
    """Simulated units: precursors (m, k), sizes (m,), which of them are held out, and the trace's own precursors."""

    x: Floats
    kintas: Floats
    fss: Floats
    unseen: NDArray[np.bool_]
    own: Floats  # (1, k)


def is_available() -> bool:
    """Whether scikit-learn is installed (pip install 'eha-rig[learn]')."""
    from importlib.util import find_spec

    return find_spec("sklearn") is not None


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
    there = ~np.isnan(xj)
    own = compute_features(com, np.interp(rows, rows[there], xj[there])[None], trace.period, parts)
    if not own:
        raise InputError("--comparators", "com", "steps or slow ramps: the learners see nothing but precursors")
    pairs = [(k, f) for k in cloggings for f in frictions]
    tables = []
    for number, (k, f) in enumerate(pairs):
        progress("simulating faults to learn from", number / len(pairs))
        made = simulate_units(model, com, trace.load, UnitKind(f"{k:g}, {f:g} N", k, f), units, seed + number)
        shown = compute_features(com, made, trace.period, parts)
        tables.append(np.column_stack([shown[name] for name in own]))
    x = np.vstack([*tables, np.array([[own[name][0] for name in own]])])
    x = np.where(np.isfinite(x), x, np.nanmedian(np.where(np.isfinite(x), x, np.nan), axis=0))
    sizes = np.repeat(np.array(pairs), units, axis=0)
    unseen = np.tile(np.arange(units) >= units - held_out, len(pairs))
    return Lesson(x[:-1], sizes[:, 0], sizes[:, 1], unseen, x[-1:])


def train_neural_network(data: Lesson, seed: int = 0, neurons: tuple[int, ...] = (24, 12)) -> LearnerAnswer:
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
    levels = {CLOGGING.name: classify_size(CLOGGING, own_k), FRICTION.name: classify_size(FRICTION, own_f)}
    return LearnerAnswer("neural network", own_k, own_f, levels, _compute_rms(k - data.kintas[data.unseen]),
                  _compute_rms(f - data.fss[data.unseen]), right, len(data.x))


def train_logistic_regression(data: Lesson, seed: int = 0) -> LearnerAnswer:
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
        levels[fault.name] = Level(int(learner.predict(data.own)[0]))
    unknown = float("nan")
    return LearnerAnswer("logistic regression", unknown, unknown, levels, unknown, unknown, right, len(data.x))


LEARNERS = {"neural network": train_neural_network, "logistic regression": train_logistic_regression}


def _make_pipeline(*steps: Any) -> Any:
    """The steps of a learner behind standardised precursors."""
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), *steps)


def _count_right(fault: Fault, predicted: Floats, true: Floats) -> float:
    """Share of units whose level is right."""
    right = [classify_size(fault, a) == classify_size(fault, b) for a, b in zip(predicted, true, strict=True)]
    return float(np.mean(right))


def _compute_rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))
