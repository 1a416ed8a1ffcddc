"""Pump-driven actuators: effects and the flow under measured pressures against closed forms, shipped models."""

from math import factorial

import numpy as np
import pytest
from effects_cases import WHOLE
from physics_cases import PREFLIGHT, SILENT
from rig_command import refuse

from plant import load_model, simulate
from plant.effects import CATALOGUE
from plant.effects.current import Cascade, flow_delay
from plant.effects.servovalve import ATMOSPHERE
from plant.ehs import (
    RAW_PER_TURN,
    State,
    compute_centred_mean,
    compute_pressure_force,
    derive_logger_columns,
    estimate_load_in_motion,
)
from plant.forced import compute_flow_balance, compute_force_balance
from plant.lanes import Lanes
from plant.model import Model, list_offered_effects, list_searched_effects
from plant.run import compute_answers
from plant.state import Input

CYCLE = 1e-3
SPEED = 800.0  # raw
GENERAL = ("undissolved_air", "flow_delay", "valve_switching", "asymmetric_gain")


def build_model(**changed: float) -> Model:
    """The bare integrator without the steps of its position sensor, with some parameters changed.

    It has the general effects, so that one kernel serves all.
    """
    return load_model("ehs").with_effects(GENERAL).replace({"quantisation.lsb": 0.0}
                                     | {name.replace("__", "."): value for name, value in changed.items()})


def replay(model: Model, drive: np.ndarray, load: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """XJ, m, and P12, Pa, (n,) each, of a run from the middle."""
    out = Lanes(model, (), 100).replay(np.empty((1, 0)), drive, np.zeros_like(drive) if load is None else load)[0]
    return out[:, 0], out[:, 1]


def compute_speed(model: Model) -> float:
    """Speed of the ram out at SPEED, m/s, if nothing gives way."""
    return model["pump.displacement"] * SPEED / model["jack.area"]


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_the_pressure_of_a_blocked_ram_rises_as_the_air_gives_way(exponent: float) -> None:
    """dp/dt = q/C(p): linear for exponent 0, exponential for 1, Boyle's hyperbola for 2."""
    volume = 2e-5
    model = build_model(undissolved_air__volume=volume, undissolved_air__exponent=exponent,
                        jack__static_friction=1e7, jack__dynamic_friction=1e7)
    drive = np.full(400, 200.0)
    xj, p12 = replay(model, drive)
    moved = model["pump.displacement"] * 200.0 * CYCLE * (np.arange(400.0) - 1.0).clip(0.0) / volume
    expected = ATMOSPHERE * {0.0: moved, 1.0: np.exp(moved) - 1.0, 2.0: 1.0 / (1.0 - moved) - 1.0}[exponent]
    assert expected[-1] > 0.09 * ATMOSPHERE and np.abs(xj).max() == 0.0
    np.testing.assert_allclose(p12, expected, rtol=2e-3, atol=5.0)


def test_a_delayed_flow_follows_erlangs_distribution() -> None:
    """Four lags of tau/4: 1 - exp(-k) (1 + k + k^2/2 + k^3/6), k = 4 t/tau; without delay exactly the step."""
    h, tau = 1e-5, 0.02
    (p,), (none,) = (build_model(flow_delay__time=time).build_record() for time in (tau, 0.0))
    shown = [(0.0, Cascade())]
    for _ in range(6000):
        shown.append(flow_delay(1.0, shown[-1][1], State(), Input(h=h), p))
    k = 4.0 * h * np.arange(1, 6001) / tau
    expected = 1.0 - np.exp(-k) * sum(k**n / factorial(n) for n in range(4))
    np.testing.assert_allclose([y for y, _ in shown[1:]], expected, atol=1e-3)
    assert flow_delay(0.7, Cascade(0.1, 0.2, 0.3, 0.4), State(), Input(h=h), none)[0] == 0.7


def test_a_switching_valve_stops_the_flow_at_each_reversal_and_not_at_the_start() -> None:
    late, prompt = (replay(build_model(valve_switching__time=time), np.repeat([SPEED, -SPEED], 200))[0]
                    for time in (0.05, 0.0))
    assert late[200] == prompt[200]
    assert late[-1] - prompt[-1] == pytest.approx(0.05 * compute_speed(build_model()), rel=2e-3)


def test_an_asymmetric_gain_answers_a_negative_error_less() -> None:
    model = build_model(asymmetric_gain__retraction=-0.3)
    found = compute_answers(model, np.array([1e-3, -1e-3, 0.0]), np.zeros(3))
    np.testing.assert_allclose(found / model["controller.proportional_gain"], [1e-3, -0.7e-3, 0.0], rtol=1e-12)


def test_a_check_valve_locks_the_ram_while_the_motor_is_slow() -> None:
    model = build_model(pump__least_speed=100.0)
    xj, _ = replay(model, np.r_[np.full(100, 99.0), np.full(100, SPEED), np.full(100, 50.0)])
    assert (xj[:101] == 0.0).all() and xj[200] > 0.0 and (xj[202:] == xj[202]).all()
    assert xj[201] == pytest.approx(100 * CYCLE * compute_speed(model), rel=1e-3)


def test_a_locked_line_goes_to_the_pressure_at_rest_at_its_rate() -> None:
    """From nothing to (1 - ratio) pR, in a straight line, and no further."""
    model = build_model(pump__least_speed=10.0, pump__area_ratio=0.7, pump__return_pressure=5e5, pump__settling=1e6,
                        undissolved_air__volume=1e-6)
    _, p12 = replay(model, np.zeros(300))
    t = CYCLE * np.arange(300)
    np.testing.assert_allclose(p12, np.minimum(1e6 * t, 0.3 * 5e5), atol=200.0)


@pytest.mark.parametrize("out", [1.0, -1.0])
def test_the_flow_under_measured_pressures(out: float) -> None:
    """XJ' = (q - V/p0 dp/dt - CLK p)/A, both ways, with the area and the pressures of the chamber that is fed."""
    volume, leakage, area = 4e-7, 2e-13, 1.0 if out > 0.0 else 0.7
    model = build_model(undissolved_air__volume=volume, undissolved_air__exponent=0.0, jack__leakage=leakage,
                        pump__area_ratio=0.7, pump__pressure_given=1.0)
    pressure = 1e6 + 2e3 * np.arange(300.0)  # of P12
    xj, p12 = replay(model, np.full(300, out * SPEED), out * pressure * model["jack.area"])
    flow = model["pump.displacement"] * SPEED / area - volume / ATMOSPHERE * 2e3 / CYCLE
    expected = out * (flow - leakage / area**2 * pressure) / model["jack.area"]
    np.testing.assert_allclose(np.diff(xj[100:]) / CYCLE, expected[100:-1], rtol=1e-3)
    np.testing.assert_allclose(p12[1:], out * pressure[:-1], rtol=1e-9)


def test_the_force_is_that_of_the_chamber_that_is_fed() -> None:
    values = dict(build_model().values) | {"pressure_sensors.delay_a": 2e-3, "pressure_sensors.delay_b": -1e-3,
                                           "pump.area_ratio": 0.7}
    chambers = np.column_stack([np.arange(10.0), 100.0 + np.arange(10.0)])
    cor = np.array([0.0, 1.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, 0.0, -1.0])
    force = compute_pressure_force(values, chambers, cor, CYCLE) / values["jack.area"]
    np.testing.assert_allclose(force, [2, 3, 4, 5, 6, 7, -0.7 * 105, -0.7 * 106, -0.7 * 107, -0.7 * 108])


def test_measured_pressures_move_the_ram_and_are_not_predicted_from_themselves() -> None:
    """XJ is that of the flow against their force, P12 that of the replay without them."""
    names = ["pressure_sensors.delay_a", "undissolved_air.preload"]
    values = np.array([[0.0, 2e5], [5e-3, 3e5]])
    model = build_model(undissolved_air__volume=4e-7, undissolved_air__exponent=1.0, jack__static_friction=500.0)
    rows = np.arange(300.0)
    drive, chambers = np.full(300, SPEED), np.column_stack([1e6 + 2e3 * rows, 0.0 * rows])
    lanes = Lanes(model, names, 20)
    driven = lanes.replay(values, drive, 0.0 * rows, chambers=chambers)
    assert (driven[..., 1:] == lanes.replay(values, drive, 0.0 * rows)[..., 1:]).all()
    given = model.replace({"pump.pressure_given": 1.0, "undissolved_air.preload": 0.0})
    for (delay, _), run in zip(values, driven, strict=True):
        force = compute_pressure_force(dict(model.values) | {names[0]: delay}, chambers, drive, CYCLE)
        own = Lanes(given, names, 20).replay(np.array([[delay, 0.0]]), drive, force)[0]
        assert (run[:, 0] == own[:, 0]).all()


def test_the_loggers_columns() -> None:
    """An encoder that turns one way over its zero, the valve's sign, and both pressure scales."""
    k = np.arange(60.0)
    angle = 20.0 - 10.0 * k + 3.0 * (k == 30)  # a count of noise
    columns = derive_logger_columns({
        "time": k, "ADC1_Channel_6": angle % 4096, "ADC1_Channel_2": np.full(60, 90.0),
        "ADC1_Channel_3": np.full(60, 308.0), "ADC1_Channel_16": np.where(k < 40, 1000.0, -1000.0)})
    turning = columns["cor"] / (10.0 / 4096 / CYCLE * RAW_PER_TURN)
    np.testing.assert_allclose(turning[[10, 29, 30, 39, 45]], [1.0, 1.0, 0.7, 1.0, -1.0], rtol=1e-9)
    np.testing.assert_allclose([columns["pa"] / 5e5, columns["pb"] / (0.07576 * 308 - 18.333) / 1e5], 1.0, rtol=1e-9)
    assert turning[:40].min() >= 0.0
    np.testing.assert_allclose(compute_centred_mean(k, 9)[4:-4], k[4:-4], rtol=1e-12)


def test_the_load_of_a_press_is_the_sum_of_both_directions() -> None:
    """10 bar of load out and none back, friction of 8 bar both ways; the pressure at rest does not count."""
    way = np.r_[np.zeros(500), np.full(1000, 1.0), np.zeros(500), np.full(1000, -1.0), np.zeros(500)]
    p12 = np.where(way > 0, 18e5, np.where(way < 0, -8e5, 40e5))
    load = estimate_load_in_motion({"xj": np.cumsum(way) * 1e-5, "p12": p12})
    assert load == pytest.approx(np.full(len(way), 10e5 * load_model("ehs")["jack.area"]))


@pytest.mark.parametrize("name", GENERAL)
@pytest.mark.parametrize("plant", ["eha", "ehs"])
def test_general_effects_suit_every_plant_and_act_and_are_searched_in_this_one(name: str, plant: str) -> None:
    """In plain Python: compiled code gives the same bits (test_effects.py). `rig explain` does not test them on the
    reference plant unasked.
    """
    e, model = CATALOGUE[name], load_model(plant).replace({"quantisation.lsb": 0.0})
    assert e.law and e.symptoms and e.source and e.function.__doc__
    assert e in list_offered_effects(plant) and (e in list_searched_effects(plant)) == (plant == "ehs")
    command = np.r_[np.full(15, 1e-3), np.full(15, -1e-3)]
    strong = {parameter: 2.0 * value for parameter, value in e.starts[-1].items()}
    off, on, without = (np.array(simulate(m, command, steps=4, fast=False))
                        for m in (model.with_effects([name]), model.replace(strong), model))
    assert (off == without).all() and np.isfinite(on).all() and (on != without).any()


def speeds(**changed: float) -> tuple[float, float]:
    """The ram's speed forwards at 1000 units of motor speed, and backwards, m/s."""
    xj, _ = replay(build_model(**changed), np.r_[np.full(300, 1000.0), np.full(400, -1000.0)])
    return (xj[290] - xj[190]) / 0.1, (xj[690] - xj[590]) / 0.1


def test_nominal_is_an_integrator_and_unequal_areas_make_it_faster_backwards() -> None:
    """XJ' = D w / AJ."""
    model = load_model("ehs")
    speed = model["pump.displacement"] * 1000.0 / model["jack.area"]
    assert speeds(pump__area_ratio=1.0) == pytest.approx((speed, -speed), rel=1e-6)
    forwards, backwards = speeds(pump__area_ratio=0.68)
    assert -forwards / backwards == pytest.approx(0.68, rel=1e-6)


def test_the_bench_refuses_it() -> None:
    """It declares no nominal test, with its own controller or another."""
    assert "a sequence of your own" in refuse("run", "--model", "ehs")
    assert "a sequence of your own" in refuse("run", "--model", "ehs", "--bench", "eha")


P = Model().values
GQ, GP, AJ = P["valve.flow_gain"], P["valve.pressure_gain"], P["jack.area"]


@pytest.mark.parametrize("changes", [{}, {"spool.static_friction": 45.0}, {"filter.clogging": 0.3},
                                     {"jack.leakage": 2e-11, "jack.mass": 200.0}])
def test_both_close_on_a_simulation(changes: dict[str, float]) -> None:
    """Faults before the spool change nothing in them; faults of the jack are in the model here."""
    model = SILENT.replace(changes)
    run = simulate(model, PREFLIGHT, np.full(len(PREFLIGHT), 300.0))
    x, v = compute_flow_balance(model, run.xs, run.p12, 0.0)
    assert np.abs(run.xj - x).max() < 20e-6  # m, over 13.5 s: straight lines between the samples
    takes, _, dynamic = compute_force_balance(model, run.xj, v, run.p12, run.load)
    moving = (np.abs(np.gradient(v, 1e-3)) < 1.0) & (np.abs(v) > 2e-3)
    left = run.p12 - (takes + np.sign(v) * dynamic) / AJ
    assert np.sqrt(np.mean(left[moving] ** 2)) < 1e4  # Pa: half the transducer's noise


def test_the_laws_of_effects_take_part() -> None:
    """Effects that make P12 a curve of the speed, behind a dead zone: without them the ram is elsewhere."""
    changes = {"orifice_root.share": 1.0, "spool_overlap.overlap": 2e-5, "compressibility.coefficient": 1e-9}
    run = simulate(WHOLE.replace(changes), PREFLIGHT, np.full(len(PREFLIGHT), 2000.0))
    x, _ = compute_flow_balance(SILENT.replace(changes), run.xs, run.p12, 0.0)
    plain, _ = compute_flow_balance(SILENT, run.xs, run.p12, 0.0)
    assert np.sqrt(np.mean((run.xj - x) ** 2)) < 0.05 * np.sqrt(np.mean((run.xj - plain) ** 2))
