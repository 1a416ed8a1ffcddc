"""Long recordings: the part that fits are made with, and what a fit leaves of all of it."""
from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from physics_cases import QUIET

from fdi.comparison.compare import compare
from fdi.discovery.runs import collect_runs
from fdi.estimation.fit import Fit, linearise
from fdi.estimation.likelihood import Problem
from fdi.estimation.long_recordings import PIECE, choose_excerpt, cut_excerpt, is_long, judge_on_all, make_excerpt
from fdi.estimation.noise import white_noise
from fdi.estimation.unknowns import list_tolerance_unknowns
from fdi.trace.trace import Trace
from plant import Model
from plant.lanes import Lanes

LEVELS = {"xj": 2e-6, "p12": 2e4, "xs": 1e-6}
ACTIVE = slice(20_000, 27_000)  # rows of the recording in which the command moves
FRICTION = {"spool.static_friction": 12.0, "spool.dynamic_friction": 8.0}


@cache
def record_mostly_at_rest() -> Trace:
    """40 s, of which 7 s move: steps and a sine."""
    com, t = np.zeros(40_000), np.arange(7000) * 1e-3
    com[ACTIVE] = 3e-3 * np.sin(2 * np.pi * 0.7 * t) + 2e-3 * (np.arange(7000) // 900 % 2)
    rng = np.random.default_rng(0)
    noise = {name: size * rng.standard_normal(len(com)) for name, size in LEVELS.items()}
    model = Model().replace(QUIET | FRICTION)
    xj, cor, p12, xs = Lanes(model, (), 50).closed_loop(np.empty((1, 0)), com - noise["xj"], 0.0 * com)[0].T
    columns = {"com": com, "cor": cor, "xj": xj + noise["xj"], "p12": p12 + noise["p12"], "xs": xs + noise["xs"]}
    return Trace.from_columns(columns | {"load": 0.0 * com}, 1e-3, {"source": "long"})


@cache
def prepare_long() -> Trace:
    return collect_runs(Model(), record_mostly_at_rest()).est


def make_problem(trace: Trace) -> Problem:
    return Problem(Model().replace(QUIET | FRICTION), trace, tuple(white_noise(LEVELS[s]) for s in trace.outputs))


def fit_nothing(problem: Problem, trace: Trace) -> Fit:
    """The model as it is, as a fit."""
    free = list_tolerance_unknowns(problem.model)[:1]
    return linearise(replace(problem, trace=trace, _lanes={}), free, np.zeros(1))


def test_the_part_that_moves_is_chosen() -> None:
    """A ram at rest says nothing of masses, areas and gains."""
    trace = prepare_long()
    assert is_long(trace)
    excerpt = choose_excerpt(trace, Model().replace(QUIET), LEVELS)
    best = [(first, stop) for first, stop in excerpt.pieces if first < ACTIVE.stop and stop > ACTIVE.start]
    covered = sum(min(stop, ACTIVE.stop) - max(first, ACTIVE.start) for first, stop in best)
    assert covered > 0.8 * (ACTIVE.stop - ACTIVE.start)
    assert "of 40 s" in excerpt.describe(trace)


def test_a_piece_is_what_the_whole_replay_has_there() -> None:
    """The lead-in makes a replay forget that it began in the middle; its rows are not compared."""
    trace = prepare_long()
    excerpt = make_excerpt([(24_000, 26_000), (22_000, 23_000)])
    part = cut_excerpt(trace, excerpt)
    whole = make_problem(trace).predict_outputs((), np.empty((1, 0)))[0]
    cut = make_problem(part).predict_outputs((), np.empty((1, 0)))[0]
    rows = np.flatnonzero(part.usable)
    originals = np.round(part.t[rows] * 1e3).astype(int)
    assert originals.tolist() == [*range(22_000, 23_000), *range(24_000, 26_000)]
    floors = np.array(list(LEVELS.values()))[:, None]
    assert np.abs((cut[:, rows] - whole[:, originals]) / floors).max() < 0.05


def test_a_fit_is_judged_on_all_of_the_recording() -> None:
    """What goes wrong outside the part is found, and where."""
    trace = prepare_long()
    part = cut_excerpt(trace, make_excerpt([(20_000, 26_000)]))
    problem = make_problem(part)
    fit = fit_nothing(problem, part)
    good = judge_on_all(problem, [fit], trace, 20)[0]
    assert good.holds(LEVELS)
    assert good.errors["xj"] == pytest.approx(LEVELS["xj"], rel=0.05)
    rows = round(PIECE / trace.period)
    assert good.find_worst_piece(LEVELS, rows, ()) is None
    wrong = trace.xs.copy()
    wrong[30_000:39_000] += 4e-6  # the sensor slips after the part
    bad = judge_on_all(problem, [fit], replace(trace, xs=wrong), 20)[0]
    assert not bad.holds(LEVELS)
    first, stop = bad.find_worst_piece(LEVELS, rows, ()) or (0, 0)
    assert 30_000 <= first < stop <= 39_000


def test_compare_of_a_long_recording() -> None:
    """The solver is checked on a part, the residual on all rows."""
    right = compare(record_mostly_at_rest(), Model().replace(FRICTION))
    assert right.verdict == "WITHIN_FLOOR"
    assert len(right.replay.residual["xj"]) == 40_000
    wrong = compare(record_mostly_at_rest(), Model().replace({"jack.area": 1.2 * Model()["jack.area"]}))
    assert wrong.verdict == "MODEL_INCOMPLETE"
    assert wrong.scatter is not None
    assert wrong.scatter.ratio["xj"] > 1.15
