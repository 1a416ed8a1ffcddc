"""Which terms a missing force, flow or current is made of, by regression on measured states: proposals for replays."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.discovery.balance import ACCELERATION_WINDOW, CREEP, EDGE, Balance, States
from fdi.discovery.laws.dependence import FOLDS
from fdi.discovery.laws.terms import PARTS, TERMS, Term
from fdi.thresholds import UNIT_TOLERANCE

Floats = NDArray[np.float64]

THINNED = 3  # every so many rows: smoothing has made neighbours alike
SCALES = (0.02, 0.05, 0.1, 0.2, 0.4)  # of a scale, times the largest state
TURNS = np.geomspace(1.0, 60.0, 240)  # of a wave over the range of the position
FUNCTIONS: Mapping[str, Any] = {
    "sin": np.sin, "exp": np.exp, "tanh": np.tanh, "sqrt": np.sqrt, "abs": np.abs, "pi": np.pi, "max": np.maximum,
    "min": np.minimum, "__builtins__": {}}


class Proposal(NamedTuple):
    """A term with parameters that the regression gives it, and the share of what is missing that it predicts."""

    term: Term
    values: Mapping[str, float]  # by field
    share: float  # in blocks that its coefficient was not made from


class Rows(NamedTuple):
    """The rows of a balance that a regression uses."""

    missing: Floats  # (n,)
    states: Mapping[str, Floats]  # (n,) each
    nuisance: Floats  # (n, k): what tolerances of one unit make of them, each for one tolerance
    noise: float


def select_rows(balance: Balance, states: States, values: Mapping[str, float]) -> Rows:
    """Rows in which the balance says something: not the ends, and for a force only those in which the ram slides."""
    inner = np.arange(EDGE, len(balance.missing) - EDGE, THINNED)
    inner = inner[balance.smooth[inner]]
    if balance.place == "force":
        inner = inner[np.abs(states.speed[inner]) > 2.0 * CREEP]
    missing = balance.missing[inner]
    if len(missing):
        missing = np.clip(missing, *np.percentile(missing, [0.5, 99.5]))
    at = {name: getattr(states, name)[inner] for name in states._fields}
    return Rows(missing, at, _list_nuisance(balance.place, at, values), balance.noise)


def _list_nuisance(place: str, at: Mapping[str, Floats], p: Mapping[str, float]) -> Floats:
    """What one tolerance of each parameter adds to a balance, (n, k)."""
    if place == "force":
        parts = [p["jack.area"] * at["pressure"], p["jack.damping"] * at["speed"],
                 p["jack.dynamic_friction"] * at["direction"], p["jack.mass"] * at["acceleration"]]
    elif "pump.displacement" in p:
        parts = [p["pump.displacement"] * at["current"], p["jack.area"] * at["speed"]]
    elif place == "flow":
        conductance = p["valve.flow_gain"] / p["valve.pressure_gain"] + p["jack.leakage"]
        parts = [p["valve.flow_gain"] * at["spool"], conductance * at["pressure"], p["jack.area"] * at["speed"]]
    else:
        parts = [at["current"], p["feedback_spring.stiffness"] / p["torque_motor.gain"] * at["spool"]]
    return UNIT_TOLERANCE * np.column_stack(parts)


def propose_terms(place: str, rows: Rows, present: Sequence[Term] = ()) -> list[Proposal]:
    """Every term of a balance on its own, beside the tolerances, best first; without those that are `present`."""
    if len(rows.missing) < 20 * FOLDS:
        return []
    terms = [t for t in TERMS if t.place == place and t not in present]
    remover = _Remover(rows)
    found = [p for p in (_fit_term(t, rows, remover) for t in terms) if p is not None]
    return sorted(found, key=lambda p: -p.share)


class _Remover:
    """Takes out of columns what tolerances of a usual size can make up for."""

    def __init__(self, rows: Rows) -> None:
        wide = rows.nuisance
        # neighbours are alike, so noise averages out over fewer rows than there are
        variance = rows.noise**2 * ACCELERATION_WINDOW / THINNED + 1e-300
        self._wide = wide
        self._inverse = np.linalg.inv(wide.T @ wide + variance * np.eye(wide.shape[1]))
        self.y = self.remove(rows.missing[:, None])[:, 0]

    def remove(self, columns: Floats) -> Floats:
        left: Floats = columns - self._wide @ (self._inverse @ (self._wide.T @ columns))
        return left


def _fit_term(term: Term, rows: Rows, remover: _Remover) -> Proposal | None:
    trials = list_shapes(term, rows.states, remover.y)
    best: tuple[float, dict[str, float]] | None = None
    for shape in trials:
        columns = remover.remove(evaluate_columns(term, shape, rows.states))
        if not np.isfinite(columns).all() or np.ptp(columns, axis=0).max() == 0.0:
            continue
        size = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
        share, c = _predict_blocks(columns / size, remover.y)
        c = c / size
        if best is None or share > best[0]:
            values = {term.name: float(c[0]), **shape}
            if term.is_wave:
                values[term.name] = float(np.hypot(*c))
                values[f"{term.name}_phase"] = float(np.arctan2(c[1], c[0]))
            best = share, values
    if best is None or best[1][term.name] == 0.0:
        return None
    return Proposal(term, best[1], best[0])


def _predict_blocks(columns: Floats, y: Floats) -> tuple[float, Floats]:
    """Share of `y` (n,) that the columns (n, k) predict in blocks left out of their fit, and the fit to all, (k,)."""
    n = len(y)
    blocks = list(zip(np.array_split(columns, FOLDS), np.array_split(y, FOLDS), strict=True))
    grams = np.array([block.T @ block for block, _ in blocks])
    sides = np.array([block.T @ part for block, part in blocks])
    gram, side, small = grams.sum(axis=0), sides.sum(axis=0), 1e-6 * n * np.eye(columns.shape[1])
    error = float(y @ y)
    for g, s in zip(grams, sides, strict=True):
        c = np.linalg.solve(gram - g + small, side - s)
        error += float(c @ g @ c - 2.0 * c @ s)
    return 1.0 - error / max(float(y @ y), 1e-300), np.linalg.solve(gram + small, side)


def list_shapes(term: Term, states: Mapping[str, Floats], y: Floats) -> list[dict[str, float]]:
    """Trial values of a term's shape, by field; one empty trial for a term without. Frequencies are lines of `y`."""
    if term.shape is None:
        return [{}]
    x = states[term.shape.state]
    field = f"{term.name}_{term.shape.name}"
    if term.shape.kind == "scale":
        largest = float(np.percentile(np.abs(x), 99.0))
        return [{field: share * largest} for share in SCALES if share * largest > 0.0]
    span = float(np.ptp(x))
    if span <= 0.0:
        return []
    if term.shape.kind == "period":
        return [{field: span / turns} for turns in TURNS.tolist()]
    return [{field: hertz} for hertz in find_lines(y, x, span)]


def find_lines(y: Floats, t: Floats, span: float, highest: float = 120.0, most: int = 4) -> list[float]:
    """The strongest frequencies of `y` (n,) at the times `t` (n,), Hz: a regular grid, from which some may be missing.

    A periodogram with zeros where a time is missing: its lines are where those of Lomb and Scargle are, 1000 times as
    fast.
    """
    step = float(np.median(np.diff(t)))
    places = np.rint((t - t[0]) / step).astype(int)
    regular = np.zeros(2 * (int(places.max()) + 1))  # twice as long: two frequencies a line
    np.add.at(regular, places, y - y.mean())
    hertz, power, found = np.fft.rfftfreq(len(regular), step), np.abs(np.fft.rfft(regular)) ** 2, []
    power[(hertz < 1.0 / span) | (hertz > highest)] = 0.0
    for _ in range(most):
        line = hertz[int(np.argmax(power))]
        found.append(float(line))
        power[np.abs(hertz - line) < 2.0 / span] = 0.0
    return found


def evaluate_columns(term: Term, values: Mapping[str, float], states: Mapping[str, Floats]) -> Floats:
    """The term without its coefficient, (n, 1), in the unit of its balance over that of the coefficient.

    A wave without a phase in `values` gives two columns, its sine and its cosine.
    """
    phases = [0.0, 0.5 * np.pi] if term.is_wave and f"{term.name}_phase" not in values else [None]
    times = {"1": 1.0, "speed": states["speed"], "pressure": states["pressure"], "direction": states["direction"]}
    columns = []
    for phase in phases:
        named = dict(values) if phase is None else {**values, f"{term.name}_phase": phase}
        text = term.format_factor({field: repr(value) for field, value in named.items()})
        factor = eval(text, dict(FUNCTIONS), dict(states))  # a formula of `terms.TERMS`
        columns.append(np.broadcast_to(factor * times[PARTS[term.part][1]], states["time"].shape))
    return np.column_stack(columns)
