"""The comparison: a perfect model is at the floor, a fault is in its block; filters of sensors; real drives."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from noisy_traces import LEVELS, SHORT, make_backlash, make_lag, record_healthy, record_plant, sample_noise
from places import SHARED
from refusals import catch_refusal
from rig_command import answer, rig
from short_runs import STEPS, build_command, simulate_trace

from fdi.comparison.compare import Comparison, compare, compare_controller, find_lags, find_rows_off_alone
from fdi.comparison.residuals import (
    WHITE,
    Motion,
    bin_residual,
    correlate_with_input,
    describe_motion,
    examine_residuals,
    find_condition,
    locate_error,
    map_deviation,
    name_shape,
)
from fdi.estimation import Floor, compute_residuals, prepare_trace, read_cycles, replay_command, replay_current
from fdi.report.compare_report import describe_findings, describe_verdict
from fdi.thresholds import CONTROLLER_ERROR_RATIO
from fdi.trace import SensorDynamics, Trace, measure_resolution, rms, shift_rows, write_sensors
from fdi.trace.sensor_dynamics import read_sensors
from plant import Model, build_profile, load_model
from plant.declare import Chirp, Hold, Ramp
from rig.recorder.convert import write_mcap

MODEL = Model()
LIMIT = 8e-3  # of the current


@cache
def faulty(name: str) -> Trace:
    changes, sensor = FAULTS[name]
    return record_plant(changes, sensor=sensor() if sensor else None)


Fault = tuple[dict[str, float], Callable[[], Callable[[float], float]] | None]
FAULTS: dict[str, Fault] = {
    "servovalve: spool friction": ({"spool.static_friction": 30.0, "spool.dynamic_friction": 20.0}, None),
    "servovalve: clogged filter": ({"filter.clogging": 0.2}, None),
    "jack: leakage": ({"jack.leakage": 2e-11}, None),
    "jack: friction": ({"jack.static_friction": 1200.0, "jack.dynamic_friction": 750.0}, None),
    "sensor: play": ({}, lambda: make_backlash(60e-6)),
    "sensor: lag": ({}, lambda: make_lag(1e-3)),
}


def at_floor(comparison: Comparison) -> bool:
    return comparison.verdict == "WITHIN_FLOOR" and not comparison.named and comparison.scatter is None


@pytest.mark.parametrize("colour", ["white", "hum"])
def test_a_perfect_model_is_at_the_floor(colour: str) -> None:
    """With a repeat and, where the noise is as the model says, without; also if nobody measured the spool."""
    comparison = compare(record_healthy(2, colour), MODEL, [record_healthy(3, colour)])
    assert at_floor(comparison), describe_verdict(comparison)
    for name, limit in {"xj": 0.05, "p12": 0.02, "xs": 0.02}.items():
        signal = comparison.signals[name]
        assert (signal.ratio, signal.floor.source) == (pytest.approx(1.0, abs=limit), "repeats")
        assert signal.solver_error < 0.1 * signal.floor.value
    assert all(ratio is not None and ratio < 1.1 for ratio in comparison.blocks.values())
    assert abs(comparison.drift) < 1e-6 and (
        comparison.signals["xj"].closed_loop_error > 2 * comparison.signals["xj"].error)
    assert all(at_floor(compare(record_healthy(3, colour), MODEL, signals=signals))
               for signals in (None, ("xj", "p12")))


OTHER_UNITS: dict[str, dict[str, float]] = {
    "far from it at all times": {"filter.clogging": 0.2},
    "far from it where the ram stops": {"torque_motor.gain": 2.2, "jack.static_friction": 1200.0},
}


@pytest.mark.parametrize("kind", OTHER_UNITS)
def test_a_repeat_from_another_unit_is_no_measure_of_noise(kind: str) -> None:
    comparison, true = (compare(record_plant(com=SHORT, seed=2), MODEL, [record_plant(unit, com=SHORT, seed=3)])
                        for unit in (OTHER_UNITS[kind], {}))
    assert (comparison.verdict, true.verdict) == ("CANNOT_TELL", "WITHIN_FLOOR"), describe_verdict(comparison)
    assert "repeats of the same unit" in comparison.reason and "by more than" in comparison.reason


ROWS = np.arange(4000)


@pytest.mark.parametrize(("repeat_rows", "is_left_out"), [
    ({"xj": ROWS >= 0}, True), ({"xj": ROWS % 5 == 0}, True), ({"xj": (ROWS < 900) | (ROWS >= 1600)}, False),
    ({"p12": ROWS >= 0}, False)])
def test_rows_are_left_out_where_a_repeat_is_known_to_be_at_the_floor(
        repeat_rows: dict[str, np.ndarray], is_left_out: bool) -> None:
    residual = {"xj": np.where((ROWS >= 1000) & (ROWS < 1500), 10.0, 0.5)}  # floors
    assert is_left_out == find_rows_off_alone(residual, [
        {name: np.where(rows, 0.5, np.nan) for name, rows in repeat_rows.items()}], {"xj": Floor(1.0, "repeats")}).any()


@pytest.mark.parametrize("fault", FAULTS)
def test_the_block_with_the_fault_is_named(fault: str) -> None:
    block = fault.partition(":")[0]
    comparison = compare(faulty(fault), MODEL)
    assert comparison.verdict == "MODEL_INCOMPLETE" and comparison.named == (block,), describe_verdict(comparison)
    assert all(ratio is not None and (ratio > 1.5 if name == block else ratio < 1.3)
               for name, ratio in comparison.blocks.items())
    assert f"the {block} disagrees" in describe_verdict(comparison)


def test_another_firmware_is_the_controllers_fault_alone() -> None:
    comparison = compare(record_plant({"controller.proportional_gain": 4.2}), MODEL)
    assert comparison.verdict == "MODEL_INCOMPLETE" and comparison.named == ("controller",)
    assert comparison.scatter is None and "the output of the controller differs" in describe_verdict(comparison)
    assert comparison.answer.gain == pytest.approx(4.2, rel=1e-6)


def test_a_sensors_gain_and_a_valves_cannot_be_told_apart() -> None:
    comparison = compare(record_plant(sensor=lambda x: 1.02 * x), MODEL)
    assert set(comparison.named) == {"jack", "sensor"} and (
        "the jack or the sensor disagree" in describe_verdict(comparison))
    assert comparison.parts["gain"] == pytest.approx(0.02, abs=0.002)


def test_scatter_from_unit_to_unit_is_offered_as_a_reason() -> None:
    """1.5 % in a few parameters is no missing physics; an effect is not explained that way."""
    unit = {"valve.flow_gain": 0.3 * 1.02, "torque_motor.gain": 2.27 * 0.99, "jack.damping": 2000.0 * 1.02}
    comparison = compare(record_plant(unit), MODEL)
    assert comparison.verdict == "MODEL_INCOMPLETE" and comparison.scatter is not None and comparison.scatter.enough
    assert comparison.scatter.moved["valve.flow_gain"] == pytest.approx(0.02 / 0.015, abs=0.4)
    other = compare(faulty("servovalve: spool friction"), MODEL)
    assert other.scatter is not None and not other.scatter.enough


@pytest.mark.parametrize(("unit", "is_other"), [({"jack.area": 2e-3}, True), ({"filter.clogging": 0.3}, False)])
def test_another_actuator_is_to_be_identified(unit: dict[str, float], is_other: bool) -> None:
    """A third more area than the model has: the answer says which command fits the model. An effect is not that."""
    assert is_other == any(
        "rig identify" in line.text for line in describe_findings(compare(record_plant(unit), MODEL)))


@pytest.mark.parametrize(("signals", "judged_blocks"), [
    (("xj",), {"controller"}), (("xj", "p12"), {"controller", "servovalve", "jack"}),
    (("xs",), {"controller", "servovalve", "jack", "sensor"})])
def test_fewer_signals_give_fewer_blocks(signals: tuple[str, ...], judged_blocks: set[str]) -> None:
    comparison = compare(faulty("servovalve: clogged filter"), MODEL, signals=signals)
    assert tuple(comparison.signals) == signals and comparison.verdict == "MODEL_INCOMPLETE"
    assert {name for name, ratio in comparison.blocks.items() if ratio is not None} == judged_blocks
    assert set(comparison.named) == ({"servovalve"} if signals != ("xj",) else set())


def test_noise_that_nobody_stated_gives_a_lower_bound() -> None:
    silent = MODEL.replace({"sensors.position_noise": 0.0})
    comparison = compare(record_healthy(2, "hum"), silent)
    assert comparison.signals["xj"].floor.lower_bound and comparison.signals["xj"].floor.source == "data"
    assert comparison.verdict == "CANNOT_TELL" and "only a lower bound" in describe_verdict(comparison)
    assert compare(record_healthy(2, "hum"), silent, [record_healthy(3, "hum")]).verdict == "WITHIN_FLOOR"
    assert compare(faulty("servovalve: clogged filter"), silent).verdict == "MODEL_INCOMPLETE"


def test_a_simulation_without_noise_is_its_own_floor() -> None:
    quiet = MODEL.replace({f"sensors.{name}_noise": 0.0 for name in ("position", "pressure", "spool")})
    assert compare(simulate_trace(quiet, SHORT), quiet).verdict == "WITHIN_FLOOR"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("names", "repeats", "keep", "step"), [
    (("com", "xj", "cor", "p12", "xs"), [], np.random.default_rng(0).random(13_500) > 0.05, 0.0),
    (("com", "xj", "cor", "xs"), [3], np.random.default_rng(0).random(13_500) > 0.05, 0.0),
    (("com", "xj", "cor", "p12", "xs"), [3], True, 1.5e-5)], ids=["every signal", "no pressure", "rounded alike"])
def test_rows_lost_at_random_and_rounding_are_no_error(names: tuple[str, ...], repeats: list[int], keep: np.ndarray,
                                                       step: float) -> None:
    """With every signal, and without the pressure, whose balance no repeat can show then; repeats with equal steps."""
    run, *others = [{name: step * np.round(x / step) if step and name == "xj" else x for name in names
                     for x in [record_healthy(seed).column(name)]} for seed in (2, *repeats)]
    comparison = compare(Trace.from_columns({name: np.where(keep, x, np.nan) for name, x in run.items()}, 1e-3, {}),
                         MODEL.replace({"quantisation.lsb": step} if step else {}),
                         [Trace.from_columns(other, 1e-3, {}) for other in others])
    assert comparison.verdict == "WITHIN_FLOOR", describe_verdict(comparison)


STICK_SLIP = {"stribeck.rise": 0.5, "stribeck.speed": 0.004}


@pytest.mark.parametrize(("unit", "model", "seeds", "rows", "verdict"), [
    (STICK_SLIP, STICK_SLIP, (4, 14), 1, "WITHIN_FLOOR"), (STICK_SLIP, STICK_SLIP, (1,), 1, "WITHIN_FLOOR"),
    ({"screw.backlash": 1e-5}, {}, (1,), 2, "CANNOT_TELL"),
    ({"screw.backlash": 3e-5}, {}, (1, 2), 2, "MODEL_INCOMPLETE")],
    ids=["slips that differ", "no repeat", "every second row", "every second row, with a repeat"])
def test_the_floor_of_a_motor_is_its_sensors_noise(unit: dict[str, float], model: dict[str, float],
                                                   seeds: tuple[int, ...], rows: int, verdict: str) -> None:
    """Its current follows the noise that its controller reads; what a lost current leaves open is no noise either."""
    command = build_profile([Hold(time=0.3), Ramp(to=6e-3, time=0.3), Ramp(to=4.5e-3, time=1.0), Hold(time=0.2),
                             Chirp(amplitude=1e-3, f0=1.0, f1=8.0, fade=8.0, time=1.5)], rate=1000.0).command
    run, *repeats = [simulate_trace(load_model("ema").replace(unit), command, seed=seed).take_rows(
        slice(None, None, rows), period=1e-3 * rows) for seed in seeds]
    comparison = compare(run, load_model("ema").replace(model), repeats)
    assert comparison.verdict == verdict and (
        rows > 1 or comparison.signals["current"].floor.value == pytest.approx(0.02, rel=0.03))


def test_columns_out_of_step_are_moved() -> None:
    columns = {n: getattr(record_healthy(2), n) for n in ("com", "xj", "cor", "p12", "xs")}
    columns["cor"] = np.roll(columns["cor"], -3)
    comparison = compare(Trace.from_columns(columns, 1e-3, {}), MODEL)
    assert comparison.verdict == "WITHIN_FLOOR"
    assert any("Cor stands 3 cycles earlier" in note for note in comparison.notes)


def test_findings_are_told_in_words() -> None:
    comparison = compare(faulty("sensor: play"), MODEL, [record_plant(seed=9, sensor=make_backlash(60e-6))])
    lines = {line.label: line.text for line in describe_findings(comparison)}
    assert {"floor", "solver", "where", "when", "residual", "scatter"} <= set(lines)
    assert "after a reversal" in lines["when"]


@pytest.fixture(scope="module")
def c() -> Trace:
    return read_cycles(record_healthy(), MODEL)[0]


@pytest.mark.parametrize("digits", [6, 9])
def test_rounding_in_a_file_is_no_disagreement(c: Trace, digits: int) -> None:
    columns = {name: np.array([float(f"{v:.{digits - 1}e}") for v in c.column(name).tolist()])
               for name in ("cor", "xj")}
    assert compare_controller(c.with_columns(columns), MODEL).ratio < CONTROLLER_ERROR_RATIO


def test_rounding_on_the_bus_is_no_disagreement(c: Trace) -> None:
    """The firmware sees what the bus carries, and its answer is rounded to 1e-8 A."""
    xj = np.round(c.xj / 1e-7) * 1e-7
    cor = np.round(np.clip(3.8 * (c.com - xj), -8e-3, 8e-3) / 1e-8) * 1e-8
    assert compare_controller(c.with_columns({"xj": xj, "cor": cor}), MODEL).ratio < 1.2


@pytest.mark.parametrize(("com", "xj"), [(3, 0), (-2, 0), (0, 2), (2, 2)])
def test_columns_that_are_late(c: Trace, com: int, xj: int) -> None:
    """`com` cycles before row k is what Cor_k answers, the file having it earlier than it should."""
    block = compare_controller(c.with_columns({"com": shift_rows(c.com, -com), "xj": shift_rows(c.xj, -xj)}), MODEL)
    assert (block.com_lag, block.xj_lag) == (com, xj) and block.ratio <= 1.0
    assert find_lags(c, LIMIT)[:2] == find_lags(c.with_columns({"cor": c.cor * 0.0 + LIMIT}), LIMIT)[:2] == (0, 0)


def test_a_recorder_that_rounds_positions_is_no_error_of_the_controller(c: Trace) -> None:
    rounded_trace = c.with_columns({"xj": 7.3e-6 * np.round(c.xj / 7.3e-6)})
    other = MODEL.replace({"controller.proportional_gain": 1.1 * MODEL["controller.proportional_gain"]})
    assert 0.5 < compare_controller(rounded_trace, MODEL).ratio < CONTROLLER_ERROR_RATIO
    assert compare_controller(rounded_trace, other).ratio > CONTROLLER_ERROR_RATIO


def test_the_gains_of_another_firmware_are_found(c: Trace) -> None:
    """Integral and derivative as well, which bend what a proportional gain alone would be."""
    error = 0.1 * (c.com - c.xj)
    cor = 4.2 * error + 2.0 * c.period * np.cumsum(error) + 1e-3 * np.diff(error, prepend=error[0]) / c.period
    block = compare_controller(c.with_columns({"com": 0.1 * c.com, "xj": 0.1 * c.xj, "cor": cor}), MODEL)
    assert block.ratio > CONTROLLER_ERROR_RATIO and block.gains == pytest.approx({
        "controller.proportional_gain": 4.2, "controller.integral_gain": 2.0,
        "controller.derivative_gain": 1e-3}, rel=1e-6)


@pytest.fixture(scope="module")
def m(c: Trace) -> Motion:
    return describe_motion(c, {"xj": c.xj, "p12": c.p12, "xs": c.xs})


def squares(seed: int, rows: int, extra: np.ndarray) -> np.ndarray:
    return sample_noise(seed, rows)[:, 0] ** 2 / LEVELS[0] ** 2 + extra


@pytest.mark.parametrize(("find_rows", "words"), [
    (lambda c, m: np.abs(m.v) > 0.05, "ram faster than 50 mm/s"),
    (lambda c, m: m.reversed_for < 0.02, "within 20 ms after a reversal"),
    (lambda c, m: np.abs(m.others["p12"]) > 1e6, r"\|P12\| above 10 bar"),
    (lambda c, m: np.abs(m.x) > 2e-3, "ram further than 2 mm from the middle"),
    (lambda c, m: np.abs(c.cor) > 0.99 * LIMIT, "current at its limit"),
    (lambda c, m: m.v > 5e-4, "ram extends"),
])
def test_the_condition_is_named(c: Trace, m: Motion, find_rows: object, words: str) -> None:
    z2 = squares(1, len(c), np.where(find_rows(c, m), 30.0, 0.0))  # type: ignore[operator]
    message = find_condition(z2, m, LIMIT)
    assert message.startswith(("100 %", "99 %")) and re.search(words, message), message


def test_noise_and_what_is_everywhere_have_no_condition(c: Trace, m: Motion) -> None:
    nothing = np.zeros(len(c))
    for z2 in (squares(2, len(c), nothing), squares(2, len(c), nothing + 9.0), nothing + np.nan):
        assert find_condition(z2, m, LIMIT) == ""


def test_sections_with_their_shares(c: Trace, m: Motion) -> None:
    z2 = squares(3, len(c), np.where((c.t >= 4.0) & (c.t < 6.0), 50.0, 0.0))
    places = locate_error(c, z2, m, LIMIT)
    worst = places[0]
    assert sum(p.share for p in places) == pytest.approx(1.0, abs=0.01)
    assert worst.section == "ramp at 0.5 mm/s" and (worst.t0, worst.t1) == pytest.approx((4.0, 6.0), abs=2e-3)
    assert worst.share > 0.85 and worst.ratio == pytest.approx(7.1, abs=0.3)
    assert {"motion within 3 mm", "step to 5 mm"} <= {p.section for p in places}


def test_white_noise_stays_within_its_bands(c: Trace, m: Motion) -> None:
    diagnoses = [examine_residuals(c, {"xj": sample_noise(seed, len(c))[:, 0]}, {}, m)["xj"]
                 for seed in range(100, 120)]  # not that of the trace, whose noise is in its own XJ
    assert sum(d.departs > d.allowed for d in diagnoses) <= 4  # 5 %
    assert sum(any(abs(f.correlation) > f.bound for f in d.follows) for d in diagnoses) <= 3  # 1 % of two
    assert not any(d.depends and d.depends[0].share > 0.02 for d in diagnoses)


def test_coloured_noise_is_white_when_a_repeat_shows_its_colour(c: Trace, m: Motion) -> None:
    r, repeat = (sample_noise(seed, len(c), "hum")[:, 0] for seed in (1, 2))
    alone = examine_residuals(c, {"xj": r}, {}, m)["xj"]
    d = examine_residuals(c, {"xj": r}, {"xj": (r - repeat) / np.sqrt(2)}, m)["xj"]
    assert alone.departs > 5 * alone.allowed and d.departs < 3 * d.allowed
    assert d.memory == pytest.approx(d.noise_memory, abs=1.5e-3)


@pytest.mark.parametrize("lag", [1, 7, 30])
def test_what_follows_an_input_is_found_with_its_lag(c: Trace, lag: int) -> None:
    u = np.random.default_rng(0).standard_normal(len(c)).cumsum()
    residual = 0.5 * np.roll(u, lag) + np.random.default_rng(1).standard_normal(len(c))
    peak = correlate_with_input("Cor", u, WHITE, residual, 1e-3)
    assert peak.lag == pytest.approx(lag * 1e-3) and peak.correlation > 4 * peak.bound
    alone = correlate_with_input("Cor", u, WHITE, residual - 0.5 * np.roll(u, lag), 1e-3)
    assert abs(alone.correlation) < 1.5 * alone.bound


@pytest.mark.parametrize(("law", "word"), [
    (lambda v: 0.3 * v / 0.05, "proportional to"), (np.sign, "steps with the sign of"),
    (lambda v: np.abs(v) / 0.05, "even in")])
def test_dependence_on_speed_and_its_shape(m: Motion, law: object, word: str) -> None:
    rng = np.random.default_rng(0)
    v = rng.uniform(-0.1, 0.1, 13_500)
    residual = law(v) + 0.1 * rng.standard_normal(len(v))  # type: ignore[operator]
    dependence = bin_residual("speed", v, residual)
    assert dependence is not None and dependence.shape == word and dependence.share > 0.8
    inside = np.abs(dependence.means - law(dependence.centres)) < 4 * dependence.half + 0.05  # type: ignore[operator]
    assert inside.mean() > 0.8
    assert bin_residual("speed", np.zeros(100), residual[:100]) is None
    assert name_shape(np.array([-1.0, 0.0, 1.0]), np.array([1.0, -2.0, 1.5]), np.ones(3)) != "proportional to"


def make_trace(amplitude: float, frequency: float, rows: int = 4000) -> Trace:
    t = np.arange(rows) / 1000
    xj = amplitude * np.sin(2 * np.pi * frequency * t)
    return Trace.from_columns({"com": xj, "xj": xj, "cor": 0 * t}, 1e-3, {})


def test_the_error_of_a_fast_motion_stands_in_its_cell() -> None:
    slow, fast = make_trace(0.2e-3, 2.0), make_trace(2e-3, 4.0)
    trace = Trace.from_columns({name: np.concatenate([slow.column(name), fast.column(name)])
                                for name in ("com", "xj", "cor")}, 1e-3, {})
    residual = np.where(np.arange(8000) < 4000, 1e-6, 7e-6)
    deviations = map_deviation(trace, {"xj": residual}, {"xj": 1e-6})
    assert deviations is not None
    rows = deviations.amplitudes.searchsorted([0.2e-3, 2e-3]) - 1
    assert np.nanmax(deviations.ratio["xj"][rows[0], :1]) == pytest.approx(1.0, abs=0.01)
    column = int(deviations.speeds.searchsorted(45e-3)) - 1
    assert deviations.ratio["xj"][rows[1], column] == pytest.approx(7.0)
    assert deviations.ratio["xj"].shape == (len(deviations.amplitudes) - 1, len(deviations.speeds) - 1)


MEAN = SensorDynamics(moving_mean=20.0)


@cache
def run_nominal() -> Trace:
    """The nominal plant with its sensors' noise, 2.5 s."""
    return simulate_trace(Model(), build_command()[:2500], seed=1, steps=STEPS)


def filter_by_loop(x: np.ndarray, sensor: SensorDynamics) -> np.ndarray:
    """Lag and moving mean sample by sample at 1 kHz: nothing of the tested code."""
    fine = np.interp((np.arange(50 * len(x)) + 0.5) / 50 - 1.0, np.arange(len(x)), x)  # between the samples
    out, state = [], x[0]
    for now in fine:  # Euler steps along the straight line to each sample
        state = state + (now - state) * 1e-3 / 50 / sensor.lag if sensor.lag else now
        out.append(state)
    lagged, n = np.array(out[49::50]) if sensor.lag else x, round(sensor.moving_mean)
    return np.array([np.mean(lagged[np.clip(range(k - n + 1, k + 1), 0, None)]) for k in range(len(x))])


def measure(sensors: Mapping[str, SensorDynamics], is_declared: bool) -> Comparison:
    """The nominal plant behind filters, compared with or without them."""
    trace = run_nominal()
    columns = {name: filter_by_loop(trace.column(name), sensor) for name, sensor in sensors.items()}
    return compare(trace.with_columns(columns, sensors=sensors if is_declared else {}), Model())


@pytest.mark.parametrize("sensors", [{"p12": SensorDynamics(moving_mean=8.0)}, {"xj": SensorDynamics(lag=5e-3)},
                                     {"p12": SensorDynamics(lag=4e-3), "xs": SensorDynamics(moving_mean=5.0)}],
                         ids=["moving mean", "lag", "both"])
def test_filters_of_sensors_are_no_error_of_the_model(sensors: Mapping[str, SensorDynamics]) -> None:
    """Where the filter is declared, compare leaves noise; where not, a multiple of it."""
    comparison, bare = measure(sensors, True), measure(sensors, False)
    for name in sensors:
        error, floor = comparison.signals[name].error, comparison.signals[name].floor.value
        assert 0.25 * bare.signals[name].error > error < 1.6 * floor
    assert any("passes the sensor" in note for note in comparison.notes)
    assert (comparison.blocks["jack"], comparison.blocks["sensor"]) == (None, None)


def test_rounding_is_noise() -> None:
    """A step of 1 bar is 0.29 bar of noise, beside the 0.2 bar of the sensor."""
    trace = run_nominal()
    rounded_trace = trace.with_columns({"p12": 1e5 * np.round(trace.p12 / 1e5)},
                                       sensors={"p12": SensorDynamics(quantum=1e5)})
    signal = compare(rounded_trace, Model()).signals["p12"]
    assert signal.floor.value == pytest.approx(np.hypot(2e4, 1e5 / np.sqrt(12.0)), rel=1e-6)
    assert 0.8 < signal.ratio < 1.2


def test_mean_of_the_loggers_samples() -> None:
    """Of 40 samples at 2 kHz: 20 ms, and 9.75 ms late; a centred one is not late."""
    ramp, whole = np.arange(100.0), replace(MEAN, lag=3e-3, delay=1e-3)
    late = SensorDynamics(moving_mean=40.0, sample_period=5e-4)
    for sensor, rows in ((late, 9.75), (replace(late, centred=True), 0.0), (SensorDynamics(delay=3.5e-3), 3.5),
                         (SensorDynamics(lag=2e-3), 2.0)):
        assert (ramp - sensor.apply(ramp, 1e-3))[50:70] == pytest.approx(rows, abs=1e-9)
    assert whole.undo(whole.apply(ramp, 1e-3), 1e-3)[45:80] == pytest.approx(ramp[45:80], abs=1e-3)


def test_averaged_noise_has_fewer_independent_samples() -> None:
    """The spread of the mean square of averaged white noise is that of so many independent samples."""
    noise = np.random.default_rng(0).standard_normal((400, 2000))
    squares = (MEAN.apply(noise, 1e-3)[:, 20:] ** 2).mean(axis=1)
    independent = 2.0 / (squares.std() / squares.mean()) ** 2 / 1980
    assert MEAN.count_independent(1e-3) == pytest.approx(independent, rel=0.2)


def test_a_log_keeps_the_sensors(tmp_path: Path) -> None:
    sensors = {"p12": replace(MEAN, sample_period=5e-4, lag=1e-3), "xj": SensorDynamics(quantum=2.5e-5)}
    write_mcap(replace(run_nominal(), sensors=sensors), tmp_path / "x.mcap")
    assert Trace.read(tmp_path / "x.mcap").sensors == sensors
    assert read_sensors("x", write_sensors(sensors)) == sensors


@pytest.mark.parametrize("text", ["no json", "[]", '{"lag": -1}', '{"lag": "x"}', '{"speed": 1}',
                                  '{"moving_mean": 1e9}', '{"delay": NaN}'])
def test_damaged_dynamics_are_refused(text: str) -> None:
    assert "x.mcap: metadata run.sensor.p12" in catch_refusal(
        read_sensors, "x.mcap", {"sensor.p12": text})


def test_resolution_of_a_column() -> None:
    x = np.random.default_rng(0).standard_normal(1000)
    six = np.array([float(f"{value:.5e}") for value in 5.0 + np.clip(x, -4.0, 4.0)])
    for column, resolution in ((np.round(x, 3), 1e-3), (np.round(x * 1e5) * 1e-8, 1e-8), (six, 1e-5),
                               (0.0254 * np.round(x, 7), 2.54e-9)):
        assert measure_resolution(column, "m") == pytest.approx(resolution, rel=0.01)
    assert measure_resolution(x, "m") < 1e-10 and measure_resolution(np.tile([5e-3, -5e-3], 500), "m") == 0.0


FOLDER = SHARED / "practice"
RIG = FOLDER.parent / "data/electrohydrostatic_rig"
needs_traces = pytest.mark.skipif(not FOLDER.exists(), reason="no ../shared: no traces of an independent simulator")

TRUE: dict[str, dict[str, float]] = {  # without plant scatter: a friction, two faults together
    "00": {"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0},
    "10": {"spool.static_friction": 33.0, "spool.dynamic_friction": 22.0, "filter.clogging": 0.21},
}
SENSOR_NOISE = {"xj": 2e-6, "p12": 2e4, "xs": 1e-6}
BLOCK = {"01": "servovalve", "04": "jack", "05": "sensor", "06": "jack", "07": "servovalve"}


@cache
def trace(case: str, name: str) -> Trace:
    return Trace.read(FOLDER / case / f"{name}.csv.gz")


@cache
def nominal(case: str) -> Comparison:
    return compare(trace(case, "est"), Model(), [trace(case, "repeat")])


@needs_traces
@pytest.mark.parametrize("case", TRUE)
@pytest.mark.parametrize(("name", "repeats"), [("est", ["repeat"]), ("holdout", [])])
def test_the_truth_is_at_the_floor(case: str, name: str, repeats: list[str]) -> None:
    comparison = compare(trace(case, name), Model().replace(TRUE[case]), [trace(case, each) for each in repeats])
    assert comparison.verdict == "WITHIN_FLOOR", describe_verdict(comparison)
    for signal in comparison.signals.values():
        assert (signal.ratio, signal.floor.value / SENSOR_NOISE[signal.signal.name]) == pytest.approx(
            (1.0, 1.0), abs=0.03)


@needs_traces
@pytest.mark.parametrize("case", BLOCK)
def test_the_nominal_model_lacks_something_in_the_right_block(case: str) -> None:
    comparison = nominal(case)
    assert comparison.verdict == "MODEL_INCOMPLETE" and comparison.named[0] == BLOCK[case], describe_verdict(comparison)
    assert comparison.scatter is not None and not comparison.scatter.enough and comparison.answer.ratio < 1.0


@needs_traces
@pytest.mark.parametrize("case", sorted([*BLOCK, "08"]))
def test_the_floor_is_the_sensors_noise_however_wrong_the_model(case: str) -> None:
    """Also where it is coloured with hum of one phase, and stick-slip differs between the repeats by 30 floors."""
    for signal in nominal(case).signals.values():
        assert signal.floor.value == pytest.approx(SENSOR_NOISE[signal.signal.name], rel=0.15)


@needs_traces
@pytest.mark.skipif(not RIG.exists(), reason="no ../shared/data: no measurements of another actuator")
def test_measurements_of_another_plant() -> None:
    """No balances and no known firmware there: the plant is one block."""
    comparison = compare(Trace.read(RIG / "exp_data_1_1.csv.gz"), load_model("ehs"))
    assert comparison.verdict == "MODEL_INCOMPLETE" and comparison.named == ("plant",)
    assert comparison.blocks == {"controller": None, "sensors": None,
                                 "plant": max(signal.ratio for signal in comparison.signals.values())}
    assert comparison.signals["xj"].floor.value == pytest.approx(2.5e-5 / 12**0.5, rel=0.05)  # rounding to a count
    assert "the model does not explain" in describe_verdict(comparison).lower() and len(comparison.where) > 3


DATA = SHARED / "data" / "electrohydrostatic_rig_raw"
real = pytest.mark.skipif(not DATA.is_dir(), reason=f"no measurements at {DATA.name}: they belong to others")
REPLAY_STEPS = 10  # a cycle


@cache
def read_run(run: str) -> Trace:
    """The prepared recording."""
    return prepare_trace(Trace.read(DATA / f"exp_data_{run}.csv.gz"), load_model("ehs"))


def measure_errors(model: str, run: str) -> dict[str, float]:
    """RMS residual of XJ and P12, SI."""
    residuals = compute_residuals(read_run(run), replay_current(read_run(run), load_model(model), REPLAY_STEPS))
    return {name: rms(values) for name, values in residuals.items()}


@needs_traces
@real
@pytest.mark.parametrize(("run", "position", "pressure"), [
    ("3_4", 0.40, 0.2), ("1_1", 0.50, 0.4), ("2_2", 0.42, 0.3)])
def test_the_error_beside_that_of_the_bare_integrator(run: str, position: float, pressure: float) -> None:
    """Fitted to 3_4 alone; the other runs were never fitted."""
    bare, servo = measure_errors("ehs", run), measure_errors("servo", run)
    assert servo["xj"] < position * bare["xj"] and servo["p12"] < pressure * bare["p12"]


@needs_traces
@real
def test_compare_finds_the_shipped_model_by_its_name() -> None:
    """Its error does not depend on the steps of a cycle; that from the command alone falls as well."""
    signals = rig("compare", DATA / "exp_data_1_1.csv.gz", "--model", "servo", "--json").json["signals"]
    assert signals["xj"]["error"] == pytest.approx(measure_errors("servo", "1_1")["xj"], rel=0.03)
    assert signals["xj"]["closed_loop_error"] < 0.8 * rms(
        replay_command(read_run("1_1"), load_model("ehs"), REPLAY_STEPS)["xj"])


EMPS = SHARED / "data" / "emps" / "DATA_EMPS.mat"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording as a trace."""
    if not EMPS.exists():
        pytest.skip(f"{EMPS} is not there")
    file = tmp_path_factory.mktemp("emps") / "emps.mcap"
    answer("import", EMPS, "--out", file)
    return file


@needs_traces
@pytest.mark.parametrize(("friction", "low", "high"), [(0.0, 0.30, 0.45), (20.39, 0.038, 0.043)])
def test_dry_friction_brings_the_error_of_the_force_to_the_published_one(
    recording: Path, friction: float, low: float, high: float
) -> None:
    """Published with dry friction: 4.08 %, 4.04 % where it was computed again. The model without it is not fitted."""
    comparison = answer("compare", recording, "--model", "emps", "--set", f"surface.friction={friction}", status=1)
    assert low < comparison["drive_error"] < high
