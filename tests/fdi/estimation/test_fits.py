"""Recordings as fits need them, and fits: flat directions, backlash, rows that hang on a level of friction."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from noisy_traces import record_healthy, record_plant
from refusals import catch_refusal
from short_runs import simulate_trace

from fdi.comparison.compare import compare
from fdi.discovery.runs import read_runs
from fdi.discovery.search import Search, scan_effects
from fdi.discovery.update_model import refit_effects
from fdi.estimation import (
    FLAPPER,
    PIECE,
    VISCOSITY,
    Fit,
    Free,
    Problem,
    answer_readings,
    choose_excerpt,
    complete_model,
    compute_residuals,
    cut_excerpt,
    find_repeat,
    find_undecided_rows,
    finish_fit,
    follow_profile,
    hold_inputs,
    is_friction,
    is_long,
    judge_on_all,
    linearise,
    list_all_unknowns,
    list_tolerance_unknowns,
    make_excerpt,
    match_period,
    read_cycles,
    replay_current,
    scale_to,
    start_fit,
    white_noise,
)
from fdi.estimation.replay import FEWEST_ROWS, PERIODS, find_rest_rows
from fdi.estimation.unidentifiable import (
    JACK_PRESSURE,
    POSITION_SCALE,
    POSITION_SCALE_AT_FORCES,
    SPOOL_WAY,
    find_tangents,
)
from fdi.trace import Floats, Trace, rms
from plant import Lanes, Model, build_profile, find_quantity, load_model, simulate
from plant.declare import Chirp, Hold, Ramp, Step
from rig.bench.benchmarks import QUIET

MODEL = Model()
NAMES = ("t", "com", "xj", "cor", "p12", "xs", "load")


def columns(**changes: np.ndarray) -> dict[str, np.ndarray]:
    trace = record_healthy()
    return {name: trace.column(name).copy() for name in NAMES} | changes


def made(period: float = 1e-3, **changes: np.ndarray) -> Trace:
    return Trace.from_columns(columns(**changes), period, {})


@pytest.mark.parametrize(("changes", "field", "words"), [
    ({"xj": 1e3 * record_healthy().xj}, "xj", "values in m; the largest, 5.* is 1.. times jack.travel"),
    ({"xj": np.where(np.arange(13_500) == 4999, 9990.0, record_healthy().xj)}, "xj",
     "the largest, 9990 at t = 4.999 s, is 249750 times jack.travel, which 1 of 13500 rows exceed"),
    ({"com": 1e3 * record_healthy().com}, "com", "values in m"),
    ({"cor": 1e3 * record_healthy().cor}, "cor", "values in A"),
    ({"p12": 1e-5 * record_healthy().p12}, "p12", "values in Pa"),
    ({"p12": 100 * record_healthy().p12}, "p12", "values in Pa"),
    ({"xs": 1e6 * record_healthy().xs}, "xs", "values in m"),
    ({"xs": np.zeros(13_500)}, "xs", r"changes; it is 0 throughout \(--signals xj,p12 leaves it out\)"),
    ({"xj": np.full(13_500, 1e-3)}, "xj", "changes; it is 0.001 throughout$"),
    ({"cor": np.full(13_500, 1e-3)}, "cor", "changes; it is 0.001 throughout$"),
    ({"load": np.full(13_500, 3e6)}, "load", r"values in N, of which the plant declares 1e\+06 as the largest; .* 3e"),
    ({"xj": 1e-3 * record_healthy().xj}, "xj", "values in m; it moves 0.00.* times as far as com"),
    ({"cor": np.full(13_500, np.nan)}, "cor", "a measured column"),
    ({"period": 1.0, "t": np.arange(13_500.0)}, "t", "times in s, one row a cycle; the rows are 1 s apart"),
    ({"signals": ["speed"]}, "--signals", "some of xj,p12,xs"),
    ({"p12": np.full(13_500, np.nan), "signals": ["p12"]}, "p12", "a measured signal; this trace has xj, xs"),
])
def test_what_cannot_be_is_refused_in_a_line(changes: dict[str, Any], field: str, words: str) -> None:
    signals = changes.get("signals")
    line = catch_refusal(read_cycles, made(**{k: v for k, v in changes.items() if k != "signals"}), MODEL, signals)
    assert re.search(f"{field}: .*expected .*{words}", line), line


def test_an_offset_beyond_the_end_stops_is_a_note() -> None:
    assert re.search(r"XJ reaches 0.05.* m where jack.travel is 0.04 m: .*offset", " ".join(read_cycles(
        made(com=record_healthy().com + 0.0508, xj=record_healthy().xj + 0.0508), MODEL)[0].notes))


@pytest.mark.parametrize("prepare", [partial(read_cycles, model=MODEL), hold_inputs])
def test_too_few_rows_are_refused(prepare: Callable[[Trace], object]) -> None:
    assert f"at least {FEWEST_ROWS} rows, not 100" in catch_refusal(prepare, cut(slice(100)))


def cut(rows: slice, period: float = 1e-3, **changes: np.ndarray) -> Trace:
    """Some rows of the healthy trace."""
    return Trace.from_columns({name: x[rows] for name, x in columns(**changes).items()}, period, {})


def spoil(name: str, *rows: int | slice, value: float = np.nan) -> dict[str, np.ndarray]:
    """That column of the healthy trace with another value in some rows."""
    x = columns()[name]
    for each in rows:
        x[each] = value
    return {name: x}


def test_rows_at_2_khz_are_taken_once_a_cycle() -> None:
    twice = {name: np.repeat(x, 2) for name, x in columns().items() if name != "t"}
    (c,) = read_cycles(Trace.from_columns(twice | {"t": np.arange(27_000) * 5e-4}, 5e-4, {}), MODEL)
    assert c.period == 1e-3 and (c.cor == record_healthy().cor).all() and "one row a cycle" in c.notes[0]
    few = Trace.from_columns({name: x[:300] for name, x in twice.items()} | {"t": np.arange(300) * 5e-4}, 5e-4, {})
    assert f"at least {FEWEST_ROWS} cycles, not 150" in catch_refusal(read_cycles, few, MODEL)
    twice["xj"][::2] = np.nan  # read between two currents
    late = Trace.from_columns(twice | {"t": np.arange(27_000) * 5e-4}, 5e-4, {})
    assert "xj: expected readings in the rows in which Cor is new" in catch_refusal(read_cycles, late, MODEL)


def test_rows_at_500_hz_can_be_read_in_two_ways() -> None:
    half = cut(slice(None, None, 2), 2e-3)
    slow, sparse = read_cycles(half, MODEL)
    assert (slow.period, len(slow), sparse.period, len(sparse)) == (2e-3, 6750, 1e-3, 13_499)
    assert "taken as the trace's, 2 ms" in slow.notes[0] and "one cycle in 2" in sparse.notes[0]
    assert sparse.filled.sum() == 6749 and np.isnan(sparse.xs[1::2]).all() and (sparse.cor[::2] == half.cor).all()
    assert not np.isnan(sparse.cor).any() and (sparse.com[1::2] >= sparse.com.min()).all()


def test_single_lost_rows_are_filled_and_long_gaps_are_left_out() -> None:
    (c,) = read_cycles(made(**spoil("cor", 100, 5000, 5002, slice(9000, 9100))), MODEL)
    assert c.filled.sum() == 103 and c.usable[[100, 5000, 8999, 9400]].all() and not c.usable[9000:9399].any()
    assert "missing in 103 of 13500 rows; 0.4 s" in c.notes[-1]
    assert abs(c.cor[5000] - record_healthy().cor[5000]) < 5e-5
    jump = 500  # the row in which the demand jumps by 5 mm
    assert not read_cycles(made(**spoil("cor", jump)), MODEL)[0].usable[jump]


def test_a_sensor_that_hangs_is_left_out_while_it_does() -> None:
    (c,) = read_cycles(made(**spoil("p12", slice(9000, 10_000), value=record_healthy().p12[9000])), MODEL)
    assert not c.usable[9000:10_000].any() and c.usable.sum() == 12_500
    assert "p12 is frozen for 1.00 s, first at 9.00 s" in c.notes[0]
    # a converter of a few bits rests for long, and is alive
    assert read_cycles(made(xj=np.round(record_healthy().xj / 2e-3) * 2e-3), MODEL)[0].usable.all()
    dead = spoil("xs", slice(11_000, None), value=record_healthy().xs[11_000])
    assert not read_cycles(made(**dead), MODEL)[0].usable[11_000:].any()


def test_a_trace_that_starts_in_motion() -> None:
    (c,) = read_cycles(cut(slice(9700, None)), MODEL)
    assert not c.usable[:300].any() and c.usable[300] and "already moves" in c.notes[0]


def test_a_replay_starts_at_the_first_position_that_was_measured() -> None:
    """The ram is 5 mm out there."""
    rows = slice(700, 3000)
    whole, lacking = (read_cycles(cut(rows, **spoiled), MODEL)[0] for spoiled in ({}, spoil("xj", 700)))
    assert np.abs(replay_current(whole, MODEL)["xj"] - replay_current(lacking, MODEL)["xj"]).max() < 1e-5


def test_a_repeat_is_found_by_its_command() -> None:
    (c,), (spool,) = read_cycles(record_healthy(), MODEL), read_cycles(record_healthy(), MODEL, ["xs"])
    repeat, same = find_repeat(c, cut(slice(100, None)), MODEL, 1), find_repeat(c, record_healthy(1), MODEL, 1)
    assert len(repeat) == len(same) == len(c) and (same.xj == record_healthy(1).xj).all()
    other = cut(slice(None), 1.000_01e-3, xj=record_healthy(1).xj)  # its clock is 10 ppm off
    assert len(find_repeat(c, other, MODEL, 1)) == len(c)
    rows = repeat.mask_unusable("xj")
    assert np.isnan(rows[:100]).all() and (rows[100:] == c.xj[100:]).all()
    for first, other, words in (
            (c, made(com=-c.com), "com: expected the command of the trace it repeats"),
            (spool, made(xs=np.full(13_500, np.nan)), "a signal that the trace has too"),
            (c, cut(slice(None, None, 3), 2.5e-3), "rows as in the trace")):
        line = catch_refusal(find_repeat, first, other, MODEL, 1)
        assert line.startswith("--repeat") and words in line


@pytest.mark.parametrize(("period", "text"), [(5e-5, "0.05 ms"), (0.2, "200 ms")])
def test_a_period_that_no_controller_has_is_refused_in_one_line(period: float, text: str) -> None:
    quantity = find_quantity("controller.period")
    assert (quantity.low, quantity.high) == PERIODS
    assert match_period(Model(), made(50e-3))["controller.period"] == 50e-3
    assert f"0.1 to 100 ms apart; these rows are {text} apart" in catch_refusal(match_period, Model(), made(period))


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
    return read_runs(Model(), record_mostly_at_rest()).est


def make_problem(trace: Trace) -> Problem:
    return Problem(Model().replace(QUIET | FRICTION), trace, tuple(white_noise(LEVELS[s]) for s in trace.outputs))


def fit_nothing(problem: Problem, trace: Trace) -> Fit:
    """The model as it is, as a fit."""
    return linearise(replace(problem, trace=trace, _lanes={}), list_tolerance_unknowns(problem.model)[:1], np.zeros(1))


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
    part = cut_excerpt(trace, make_excerpt([(24_000, 26_000), (22_000, 23_000)]))
    whole = make_problem(trace).predict_outputs((), np.empty((1, 0)))[0]
    cut = make_problem(part).predict_outputs((), np.empty((1, 0)))[0]
    rows = np.flatnonzero(part.usable)
    originals = np.round(part.t[rows] * 1e3).astype(int)
    assert originals.tolist() == [*range(22_000, 23_000), *range(24_000, 26_000)]
    assert np.abs((cut[:, rows] - whole[:, originals]) / np.array(list(LEVELS.values()))[:, None]).max() < 0.05


def test_a_fit_is_judged_on_all_of_the_recording() -> None:
    """What goes wrong outside the part is found, and where."""
    trace = prepare_long()
    part = cut_excerpt(trace, make_excerpt([(20_000, 26_000)]))
    problem = make_problem(part)
    fit = fit_nothing(problem, part)
    rows, k = round(PIECE / trace.period), np.arange(len(trace))
    slipped = trace.with_columns({"xs": trace.xs + 4e-6 * ((k >= 30_000) & (k < 39_000))})  # after the part
    good, bad = (judge_on_all(problem, [fit], each, 20)[0] for each in (trace, slipped))
    assert good.holds(LEVELS) and not bad.holds(LEVELS) and good.find_worst_piece(LEVELS, rows, ()) is None
    assert good.errors["xj"] == pytest.approx(LEVELS["xj"], rel=0.05)
    first, stop = bad.find_worst_piece(LEVELS, rows, ()) or (0, 0)
    assert 30_000 <= first < stop <= 39_000
    sparse = slipped.with_columns({name: np.where(k % 3, np.nan, slipped.column(name)) for name in LEVELS})
    assert not judge_on_all(problem, [fit], sparse, 20)[0].holds(LEVELS)
    assert choose_excerpt(sparse, problem.model, LEVELS).pieces


def test_compare_of_a_long_recording() -> None:
    """The solver is checked on a part, the residual on all rows."""
    right, wrong = (compare(record_mostly_at_rest(), Model().replace(changes))
                    for changes in (FRICTION, {"jack.area": 1.2 * Model()["jack.area"]}))
    assert (right.verdict, wrong.verdict) == ("WITHIN_FLOOR", "MODEL_INCOMPLETE")
    assert len(right.replay.residual["xj"]) == 40_000
    assert wrong.scatter is not None and wrong.scatter.ratio["xj"] > 1.15


def test_what_a_law_remembers_is_found_where_a_recording_begins_in_the_middle() -> None:
    """From rest the integral of the motor's controller would be wrong for good; another law stays another one."""
    model = load_model("ema")
    command = build_profile([Hold(time=0.2), Step(to=5e-3, time=0.4), Step(to=-3e-3, time=0.5)], rate=1000.0).command
    columns = {name: column[700:] for name, column in simulate(model, command, seed=2)._asdict().items()}
    run = Trace.from_columns(columns, 1e-3, {}, model.kind.signals)

    def miss(model: Model) -> float:
        return float(np.abs(answer_readings(model, run, run.command, run.controlled) - run.drive).max())

    assert miss(model) < 1e-6 * np.abs(run.drive).max()
    assert miss(model.replace({"controller.speed_gain": 610.0})) > 1e-3 * np.abs(run.drive).max()


T = 1e-3 * np.arange(1500)
GENTLE = 5e-4 * np.sin(2.0 * np.pi * 1.5 * T) * (1.0 - np.exp(-5.0 * T))  # m, neither flapper nor spool stops


def find_flat(changes: dict[str, float], signals: str, com: Floats = GENTLE, load: float = 0.0
              ) -> list[Mapping[str, float]]:
    """Directions that a replay of these effects leaves flat; what was measured does not matter, only the current."""
    model = load_model().replace(changes)
    trace = hold_inputs(record_plant({}, com, load=load), signals.split(","))
    problem, free = replace(Search(model, trace, [], [], 1).problem, bare=None), list_all_unknowns(model)
    directions, tangents = find_tangents(problem, free, np.zeros(len(free)))
    assert np.linalg.matrix_rank(tangents) == len(directions)
    return [each.powers for each in directions]


EFFECTS = {"spool_overlap.overlap": 2e-5, "compressibility.coefficient": 1e-9, "flow_force.coefficient": 1e-3}


@pytest.mark.parametrize(("direction", "signal"), [(SPOOL_WAY, "xs"), (JACK_PRESSURE, "p12")])
def test_a_scale_that_is_not_measured_is_flat(direction: Mapping[str, float], signal: str) -> None:
    """Also with effects beside it, which move along."""
    others = ",".join(s for s in ("xj", "p12", "xs") if s != signal)
    assert all(direction in find_flat(changes, others) for changes in ({}, EFFECTS))
    assert direction not in find_flat({}, "xj,p12,xs")


def test_a_known_load_does_not_show_the_pressure_but_the_area() -> None:
    flat = find_flat({}, "xj,xs", load=5e3)
    assert JACK_PRESSURE in flat and not any("jack.mass" in powers for powers in flat)


def test_a_stop_shows_how_far_flapper_and_spool_move() -> None:
    command = np.where(T > 0.2, 5e-3, 0.0)  # m, brings both to their stops
    gentle, fast = find_flat({}, "xj"), find_flat({"torque_motor.gain": 2.5}, "xj", command)
    assert [way in flat for flat in (gentle, fast) for way in (FLAPPER, SPOOL_WAY)] == [True, True, False, False]


def test_leakage_makes_up_for_pressure_gain() -> None:
    """Whatever is measured."""
    flat = find_flat({"jack.leakage": 1e-11}, "xj,p12,xs")
    loss = next(powers for powers in flat if set(powers) == {"valve.pressure_gain", "jack.leakage"})
    assert loss["jack.leakage"] == pytest.approx(0.05 * loss["valve.pressure_gain"], rel=0.01)


@pytest.mark.parametrize(("changes", "direction"), [
    ({"viscosity_drift.factor": 1.5}, VISCOSITY),
    ({"sensor_gain.error": 0.02, "aero_stiffness.stiffness": 3e5, "mount_compliance.compliance": 3e-8},
     POSITION_SCALE)])
def test_tolerances_make_up_for_viscosity_and_for_the_scale_of_the_position(
        changes: dict[str, float], direction: Mapping[str, float]) -> None:
    assert direction in find_flat(changes, "xj,p12,xs")


def test_under_a_known_load_the_scale_of_the_position_leaves_forces_and_the_area_as_they_are() -> None:
    changes = {"sensor_gain.error": 0.02, "aero_stiffness.stiffness": 3e5, "compressibility.coefficient": 1e-9}
    flat = find_flat(changes, "xj,p12,xs", load=5e3)
    assert POSITION_SCALE_AT_FORCES in flat and POSITION_SCALE not in flat
    assert [POSITION_SCALE_AT_FORCES[f"jack.{field}"] for field in ("area", "mass", "leakage")] == [0.0, 1.0, -1.0]


class RoughSum(Problem):
    """100 samples of a sum of two unknowns, with jumps wherever the first one moves, as behind a backlash."""

    def predict_unknowns(self, free: Sequence[Free], x: Floats) -> Floats:
        return 10.0 * x.sum(axis=1)[:, None, None] + 0.15 * np.sign(np.sin(300.0 * x[:, :1, None] + np.arange(100.0)))

    def subtract_measurements(self, predictions: Floats) -> Floats:
        return predictions


def test_only_the_tolerance_limits_a_size_that_no_signal_tells_from_it() -> None:
    """Of a plant of which no such directions are declared; the differences of the first fit see jumps alone."""
    free = [Free("tolerance", 0.0, 1.0, 1.0, -5.0, 5.0, 0.3), Free("size", 0.0, 1.0, np.inf, -50.0, 50.0, 0.05)]
    problem = RoughSum(load_model("ema"), record_healthy(), (white_noise(1.0),))
    first_fit = linearise(problem, free, np.array([2.0, -2.0]))
    fit = finish_fit(problem, first_fit, 5)
    assert first_fit.spread("size") < 0.2 and fit.spread("size") > 0.6 and abs(fit.x).max() < 0.5


class BentValley(RoughSum):
    """A product of two unknowns, and what the first one adds beyond 2, as a valve does that opens there."""

    def predict_unknowns(self, free: Sequence[Free], x: Floats) -> Floats:
        shown = np.stack([x[:, 0] * x[:, 1] - 4.0, np.maximum(x[:, 0] - 2.0, 0.0)], axis=1)
        return 30.0 * np.repeat(shown, 50, axis=1)[:, None]


@pytest.mark.parametrize(("start", "end", "reached"), [(1.9, 0.5, 0.5), (1.9, 9.0, 2.0), (0.6, 9.0, 2.0)])
def test_a_profile_follows_a_bent_valley_and_ends_where_the_data_exclude(start: float, end: float, reached: float
                                                                         ) -> None:
    """The slope at the start would be that of a straight valley, and knows nothing of what begins at 2."""
    free = [Free("first", 0.0, 1.0, np.inf, 0.5, 9.0, 0.02), Free("second", 0.0, 1.0, np.inf, 0.1, 50.0, 0.02)]
    problem = BentValley(load_model("ema"), record_healthy(), (white_noise(1.0),))
    fits = follow_profile(problem, linearise(problem, free, np.array([start, 4.0 / start])), 0, end, 3.84)
    assert fits[-1].x[0] == pytest.approx(reached, abs=0.02) and max(each.cost for each in fits) < 3.85


FLOOR = {"xj": 2e-6, "p12": 2e4, "xs": 1e-6}


def _find(changes: dict[str, float], com: np.ndarray) -> np.ndarray:
    model = complete_model(Model()).replace(changes)
    trace = hold_inputs(record_plant(changes, com, seed=1))
    problem = Problem(model, trace, tuple(white_noise(FLOOR[s]) for s in trace.outputs), steps=20)
    free = list_tolerance_unknowns(model)
    return find_undecided_rows(problem, start_fit(free, np.zeros(len(free))), FLOOR)


@pytest.mark.parametrize("is_told", [True, False])
def test_slips_on_soft_oil_are_undecided_and_a_step_is_not(is_told: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether or not the plant calls its levels of friction so."""
    monkeypatch.setattr("fdi.estimation.replay.is_friction", lambda name: is_told and is_friction(name))
    ramp = np.concatenate([np.zeros(200), np.linspace(0.0, 1.5e-3, 2500)])  # 0.6 mm/s
    soft = _find({"compressibility.coefficient": 1.0 / 4e8, "jack.static_friction": 1600.0}, ramp)
    assert soft.mean() > 0.1 and not soft[:200].any()
    assert not _find({}, np.repeat([0.0, 3e-3], [200, 800])).any()


def _record_motor(changes: Mapping[str, float], step: float = 0.0) -> Trace:
    """A ramp and a chirp of an `ema`, the position in steps; the motor's speed has its noise."""
    unit = load_model("ema").replace({**changes, **({"sensors.position_noise": 0.0} if step else {})})
    command = build_profile([Hold(time=0.3), Ramp(to=0.01, time=1.0), Hold(time=0.3),
                             Chirp(amplitude=1e-3, f0=1.0, f1=20.0, fade=20.0, time=2.0)], rate=1000.0).command
    run = simulate_trace(unit, command, seed=3, steps=100)
    return hold_inputs(run.with_columns({"position": step * np.round(run.position / step)}) if step else run)


def test_an_observer_does_not_take_the_steps_of_a_position_for_motion() -> None:
    trace = _record_motor({}, 2e-5)
    assert trace.slack == pytest.approx(1e-5) and _record_motor({}).slack == 0.0
    coarse, plain = (rms(compute_residuals(each, replay_current(each, load_model("ema")))["motor_speed"])
                     for each in (trace, replace(trace, slack=0.0)))
    assert coarse < 0.06 < plain  # rad/s; the sensor has 0.05


def test_scan_of_a_step_test_finds_the_size_at_which_a_backlash_bounces_like_the_motor() -> None:
    """Two percent beside it a replay bounces otherwise; most of the run is at rest and is not compared."""
    model = load_model("ema")
    steps = [Step(to=to, time=2.0) for to in (0.01, -0.01, 0.005, 0.0)]
    command = build_profile([Hold(time=0.3), *steps], rate=1000.0).command
    trace = hold_inputs(simulate_trace(model.replace({"screw.backlash": 1e-4}), command, seed=3))
    search = Search(model, trace, [], ["backlash"], 1)
    assert 200 <= search.problem.trace.usable.sum() < 0.3 * len(trace)
    healthy = linearise(search.problem, list_all_unknowns(search.model), np.zeros(4))
    prospect = scan_effects(search.problem, [healthy], ["backlash"])[0]
    u = [f.name for f in prospect.free].index("screw.backlash")
    size = prospect.free[u].centre + prospect.free[u].scale * prospect.x[u]
    assert size == pytest.approx(1e-4, rel=0.3)  # else a tenth of it


def test_error_that_is_watched_while_a_backlash_is_added_falls_to_the_noise() -> None:
    refit = refit_effects(load_model("ema"), ["backlash"], _record_motor({"screw.backlash": 1e-4}))
    assert max(refit.last.hypothesis.errors[s] / refit.floor[s] for s in refit.floor) < 1.3
    assert refit.last.hypothesis.fit.values["screw.backlash"] == pytest.approx(1e-4, rel=0.05)


def test_a_rest_hangs_on_stops_and_a_reversal_does_not() -> None:
    t = np.arange(0.0, 3.0, 1e-3)
    x = np.where(t < 1.0, 0.0, 3e-3 * np.sin(2.0 * np.pi * np.clip(t - 1.0, 0.0, 1.5)))  # rests, two reversals, rests
    x = x + 1e-6 * np.random.default_rng(0).standard_normal(len(t))
    x[[*range(500, 520), *range(1500, 2100)]] = np.nan  # of the longer gap nothing is known
    rest = find_rest_rows(x, 1e-3, 1e-6)
    assert rest[:1150].all() and not rest[1300:2490].any() and rest[2550:].all()  # and until a replay has forgotten it


@pytest.mark.parametrize(("x", "new_x"), [(2.0, 4.0), (0.0, None), (-2.0, None)])
def test_no_factor_leads_from_zero_or_past_it(x: float, new_x: float | None) -> None:
    """`rig explain` ended with a division by zero where a size that trades with others was fitted to 0."""
    free = [Free("jack.leakage", 0.0, 1.0, np.inf, -10.0, 10.0, 0.1)]
    point = scale_to(free, np.array([x]), {"jack.leakage": 1.0}, "jack.leakage", 4.0)
    assert (point is None) is (new_x is None) and (point is None or point[0] == pytest.approx(new_x))
