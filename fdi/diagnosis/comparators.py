"""What the paper cites in place of models: a neural network and a logistic regression, taught by simulated faults.

Both see the precursors of a response and nothing else. The network is taught the two sizes, the regression the two
levels. Training units have the tolerances and the noise of a fleet, on the trace's own command and load.
"""
from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Fault, Level
from fdi.diagnosis.features import features
from fdi.diagnosis.levels import of_value
from fdi.diagnosis.simulated_units import Kind, runs
from fdi.progress import Progress, ignore_progress
from fdi.trace.columns import hold_last
from fdi.trace.sections import sections
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model

Floats = NDArray[np.float64]

CLOGGINGS = (0.0, 0.08, 0.17, 0.22, 0.28, 0.33, 0.4, 0.5)  # none of them at a limit, which has no level of its own
FRICTIONS = (5.0, 12.0, 22.0, 31.0, 40.0, 55.0, 65.0, 78.0, 95.0)  # N
EACH = 16  # units of a pair
HELD_OUT = 4  # of these, that no training sees
NEURONS = (24, 12)


class Learnt(NamedTuple):
    """What one learner says of a trace, and how wrong it is on units that it was not trained on."""

    method: str
    kintas: float  # NaN: it tells levels alone
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


def available() -> bool:
    """Whether scikit-learn is installed (pip install 'eha-rig[learn]')."""
    from importlib.util import find_spec

    return find_spec("sklearn") is not None


def lesson(trace: Trace, model: Model, seed: int = 0, progress: Progress = ignore_progress) -> Lesson:
    """Units with every pair of fault sizes on the trace's command, and the trace.

    Raises:
        InputError: a command or a trace that shows no precursors.
    """
    com, parts = hold_last(trace.com), sections(trace.com, trace.period)
    xj, rows = trace.measured("xj"), np.arange(len(trace))
    there = ~np.isnan(xj)
    own = features(com, np.interp(rows, rows[there], xj[there])[None], trace.period, parts)
    if not own:
        raise InputError("--comparators", "com", "steps or slow ramps: learners see precursors alone")
    pairs = [(k, f) for k in CLOGGINGS for f in FRICTIONS]
    tables = []
    for number, (k, f) in enumerate(pairs):
        progress("simulating faults to learn from", number / len(pairs))
        made = runs(model, com, trace.load, Kind(f"{k:g}, {f:g} N", k, f), EACH, seed + number)
        shown = features(com, made, trace.period, parts)
        tables.append(np.column_stack([shown[name] for name in own]))
    x = np.vstack([*tables, np.array([[own[name][0] for name in own]])])
    x = np.where(np.isfinite(x), x, np.nanmedian(np.where(np.isfinite(x), x, np.nan), axis=0))
    sizes = np.repeat(np.array(pairs), EACH, axis=0)
    unseen = np.tile(np.arange(EACH) >= EACH - HELD_OUT, len(pairs))
    return Lesson(x[:-1], sizes[:, 0], sizes[:, 1], unseen, x[-1:])


def neural_network(data: Lesson, seed: int = 0) -> Learnt:
    """A small multilayer perceptron on standardised precursors, taught Kintas and ln FSS."""
    from sklearn.neural_network import MLPRegressor

    target = np.column_stack([data.kintas / 0.1, np.log(data.fss)])
    net = _scaled(MLPRegressor(hidden_layer_sizes=NEURONS, alpha=1e-2, solver="lbfgs", max_iter=400, random_state=seed))
    with warnings.catch_warnings(action="ignore"):  # it stops before it has learnt the training units by heart
        net.fit(data.x[~data.unseen], target[~data.unseen])

    def told(x: Floats) -> tuple[Floats, Floats]:
        out = net.predict(x)
        return np.maximum(0.1 * out[:, 0], 0.0), np.exp(out[:, 1])

    k, f = told(data.x[data.unseen])
    own_k, own_f = (float(v[0]) for v in told(data.own))
    right = {CLOGGING.name: _share(CLOGGING, k, data.kintas[data.unseen]),
             FRICTION.name: _share(FRICTION, f, data.fss[data.unseen])}
    return Learnt("neural network", own_k, own_f, {CLOGGING.name: of_value(CLOGGING, own_k),
                                                   FRICTION.name: of_value(FRICTION, own_f)},
                  _rms(k - data.kintas[data.unseen]), _rms(f - data.fss[data.unseen]), right, len(data.x))


def logistic_regression(data: Lesson, seed: int = 0) -> Learnt:
    """Multinomial logistic regression on standardised precursors and their products, one for each fault's levels."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    levels, right = {}, {}
    for fault, sizes in zip(FAULTS, (data.kintas, data.fss), strict=True):
        true = np.array([int(of_value(fault, s)) for s in sizes])
        told = _scaled(PolynomialFeatures(2, include_bias=False), StandardScaler(),
                       LogisticRegression(C=1.0, max_iter=300, random_state=seed))
        told.fit(data.x[~data.unseen], true[~data.unseen])
        right[fault.name] = float(np.mean(told.predict(data.x[data.unseen]) == true[data.unseen]))
        levels[fault.name] = Level(int(told.predict(data.own)[0]))
    nothing = float("nan")
    return Learnt("logistic regression", nothing, nothing, levels, nothing, nothing, right, len(data.x))


LEARNERS = (neural_network, logistic_regression)


def _scaled(*steps: Any) -> Any:
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), *steps)


def _share(fault: Fault, told: Floats, true: Floats) -> float:
    return float(np.mean([of_value(fault, a) == of_value(fault, b) for a, b in zip(told, true, strict=True)]))


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))
