"""What each effect does, from the current to the transducer and the firmware, and wear: closed forms."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest
from effects_cases import EASY, QUIET_SPOOL, WHOLE, H, drive_plant, measure_speed, measure_spool
from node_bench import FirmwareHarness
from physics_cases import SMOOTH

from plant import (
    Actuator,
    Input,
    Model,
    compute_answers,
    find_plant,
    interpret_function,
    simulate,
    unpack_state,
)
from plant.effects import CATALOGUE
from plant.effects.current import coil_lag, current_noise
from plant.effects.sensors import Recoil, mount_compliance, sensor_lag
from plant.effects.supply import Drawn, supply_droop
from plant.effects.wear import Flux, coil_short, edge_rounding, land_clearance, nozzle_block
from plant.eha import State, compute_coefficients, compute_metering_line, step_jack as ram
from plant.state import Lag, Line
from rig.benches import CIA408

ADVANCED = np.random.default_rng(1).uniform(-4e-3, 4e-3, 60)  # A, a new one each cycle


@pytest.mark.parametrize("period", [400, 1600])  # cycles
def test_hysteresis_is_a_loop_of_its_width_at_any_rate(period: int) -> None:
    """Up against down at no current: the spool is apart by what the width of the loop in current moves it."""
    current = 2e-3 * np.interp(np.arange(1.75 * period) / period, [0, 0.25, 0.75, 1.25, 1.75], [0, 1, -1, 1, -1])
    xs, plain = (drive_plant(EASY.replace({"torque_motor_hysteresis.width": width}), current)[1][2]
                 for width in (2e-4, 0.0))
    down, up = (xs - plain)[[period // 2, period]]
    assert (2.0 * down, down - up) == pytest.approx((measure_spool(EASY, 2e-4),) * 2, rel=0.01)


REST = State()


def follow(law: Callable[..., Any], x: Iterable[float], memory: Any, p: Any, s: State = REST, h: float = H
           ) -> np.ndarray:
    """What a law with memory makes of a signal, a value a step."""
    out = []
    for k, value in enumerate(x):
        y, memory = law(value, memory, s, Input(h=h, t=k * h), p)
        out.append(y)
    return np.array(out)


@pytest.mark.parametrize("tau", [0.3e-3, 3e-3])
def test_coil_lag_is_3_dB_down_where_it_should(tau: float) -> None:
    p = EASY.replace({"coil_lag.time": tau}).build_record()[0]
    t = (np.arange(round(40 * tau / H)) + 0.5) * H  # the current is constant over a step: taken at its middle
    out = follow(coil_lag, np.sin(t / tau), Lag(), p)
    is_settled = t > 10 * tau
    np.testing.assert_allclose(out[is_settled], np.sin(t / tau - np.pi / 4)[is_settled] / np.sqrt(2), atol=2e-3)


def test_current_noise_is_hum_and_the_random_number_of_the_cycle() -> None:
    p = WHOLE.replace({"current_noise.white": 1e-4, "current_noise.hum": 3e-4}).build_record()[0]  # 400 Hz
    currents = [current_noise(1e-3, REST, Input(noise=noise, t=t), p)
                for noise, t in ((2.0, 0.0), (-1.0, 0.25 / 400.0))]
    assert currents == pytest.approx([1e-3 + 2e-4, 1e-3 - 1e-4 + 3e-4], rel=1e-9)


@pytest.mark.parametrize("cycles", [1, 2, 5])
def test_a_delay_of_whole_cycles_is_exactly_that(cycles: int) -> None:
    late = drive_plant(WHOLE.replace({"transport_delay.cycles": float(cycles)}), ADVANCED)[1]
    assert (late[:, cycles:] == drive_plant(WHOLE, ADVANCED)[1][:, :-cycles]).all()


def test_a_delay_of_a_fraction_changes_within_the_cycle() -> None:
    """Half a cycle late: the plant of a bus twice as fast that repeats each current, half a cycle ago."""
    late = drive_plant(EASY.replace({"transport_delay.cycles": 0.5}), ADVANCED)[1]
    fast = EASY.replace({"controller.period": 0.5e-3})
    twice = drive_plant(fast, np.r_[0.0, np.repeat(ADVANCED, 2)])[1]  # its steps are half as long
    np.testing.assert_allclose(late[2], twice[2, :-1:2], atol=2e-8)


def test_current_limit_caps_the_speed_and_does_nothing_below() -> None:
    model = EASY.replace({"current_limit.loss": 0.2})
    full, below, plain = (drive_plant(m, np.full(60, current))[1]
                          for m, current in ((model, 8e-3), (model, 6.3e-3), (EASY, 6.3e-3)))
    assert full[4, -1] == pytest.approx(measure_speed(model, measure_spool(model, 0.8 * 8e-3)), rel=2e-3)
    assert (below == plain).all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_nozzles_gain_differs_by_direction(sign: float) -> None:
    """The spool settles with the slowest root of flapper and pilot loop, whose gain is Kv (1 + a) or Kv (1 - a)."""
    model = EASY.replace({"nozzle_asymmetry.asymmetry": 0.2, "flapper.damping": 0.2})
    v = model.values
    kv = v["pilot.flow_gain"] * v["feedback_spring.stiffness"] / v["spool.end_area"]
    xs = drive_plant(model, np.full(25, sign * 1e-3))[1][2]
    rate = np.polyfit(np.arange(6, 14), np.log(1.0 - xs[6:14] / measure_spool(model, sign * 1e-3)), 1)[0] / 1e-3
    roots = np.roots([v["flapper.inertia"], v["flapper.damping"], v["flapper.stiffness"], kv * (1 + 0.2 * sign)])
    assert rate == pytest.approx(max(roots.real), rel=0.03)


def test_the_worn_ball_lets_the_spool_go_half_a_gap_further_and_hunt_at_null() -> None:
    model = EASY.replace({"feedback_gap.width": 20e-6})
    xs = drive_plant(model, np.full(100, 1e-3))[1][2]
    hunting, quiet = (np.std(simulate(m, np.r_[np.full(20, 1e-4), np.zeros(1500)]).xs[-500:]) for m in (model, EASY))
    assert xs[-1] == pytest.approx(measure_spool(model, 1e-3) + 10e-6, rel=1e-4) and hunting > 2e-6 > 1e-9 > quiet


@pytest.mark.parametrize("load", [0.0, 15e3])
def test_flow_force_is_a_weaker_torque_motor_that_depends_on_the_pressure(load: float) -> None:
    model = EASY.replace({"flow_force.coefficient": 2e-3})
    lever = 2e-3 * model["flapper.stiffness"] / (model["spool.end_area"] * model["pilot.pressure_gain"])
    _, p12, xs, _, _ = drive_plant(model, np.full(80, 2e-3), load)[1][:, -1]
    spring = model["feedback_spring.stiffness"] + lever * (model["supply.pressure"] - abs(p12))
    assert xs == pytest.approx(model["torque_motor.gain"] * 2e-3 / spring, rel=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("lap", "xs", "opening"), [
    ("overlap", 10e-6, 0.0), ("overlap", 100e-6, 80e-6), ("underlap", 10e-6, 20e-6), ("underlap", 100e-6, 120e-6)])
def test_overlap_is_flat_around_null_and_underlap_is_twice_as_steep(lap: str, xs: float, opening: float, sign: float
                                                                    ) -> None:
    """Speed of the unloaded ram over the opening, both ways and within a lap of 20 um."""
    current = np.full(80, sign * xs / measure_spool(EASY, 1.0))
    v = drive_plant(EASY.replace({f"spool_{lap}.{lap}": 20e-6}), current)[1][4, -1]
    assert v == pytest.approx(sign * measure_speed(EASY, opening), rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("load", [-20e3, 0.0, 20e3])
def test_orifice_root_of_the_pressure_left(load: float) -> None:
    """XS w = P12/GP + QJ/GQ at constant speed, w = sqrt(1 - sign(XS) P12/PSR)."""
    model = EASY.replace({"orifice_root.share": 1.0, "jack.leakage": 0.0})
    _, p12, xs, _, v = (row[-1] for row in drive_plant(model, np.full(60, 3e-3), load)[1])
    w = np.sqrt(1.0 - p12 / model["supply.pressure"])
    assert v == pytest.approx(measure_speed(model, xs * w - p12 / model["valve.pressure_gain"]), rel=1e-3)
    assert p12 == pytest.approx((load + model["jack.damping"] * v) / model["jack.area"], rel=1e-3)


def test_droop_is_as_large_as_the_flow_and_comes_with_the_lines_lag() -> None:
    model = EASY.replace({"supply_droop.slope": 2e10})
    _, _, xs, _, v = (row[-1] for row in drive_plant(model, np.full(80, 6e-3))[1])
    ratio = 1.0 - 2e10 * model["jack.area"] * v / model["supply.pressure"]
    assert ratio < 0.8 and v == pytest.approx(measure_speed(model, xs) * np.sqrt(ratio), rel=3e-3)
    p, m, s = model.build_record()[0], Drawn(), State(jack_speed=0.1)
    for _ in range(200):  # 2 ms
        r, m = supply_droop(1.0, m, s, Input(h=H), p)
    assert 1.0 - r == pytest.approx((1 - np.exp(-1)) * 2e10 * 0.1 * 1.5e-3 / model["supply.pressure"], rel=1e-3)


def test_ripple_is_a_line_in_the_speed() -> None:
    """The flow goes with the root of the supply: a ripple of 4 % is one of 2 % in the speed."""
    model = EASY.replace({"supply_ripple.amplitude": 0.04, "supply_ripple.frequency": 25.0, "supply_ripple.phase": 0.5})
    v = drive_plant(model, np.full(320, 2e-3))[1][4, 120:]
    line = 2.0 * np.fft.rfft(v)[5] / len(v)  # 5 periods in 200 cycles
    assert abs(line) == pytest.approx(0.02 * v.mean(), rel=0.02)
    assert np.angle(line * 1j) == pytest.approx(0.5 + 2 * np.pi * 25 * 0.120 - 6 * np.pi, abs=0.05)


def _moved(flat, spool, load, record, h, out):
    """Metering edges and ram alone, the spool on a given path; rows XJ, P12."""
    p = record[0]
    s, m = unpack_state(flat, 0)
    k = compute_coefficients(p, h)
    for i in range(len(spool)):
        u = Input(0.0, load[i], 0.0, i * h, 0.0, h)
        line, m = compute_metering_line(s, m, u, p, k, spool[i])
        x, v, p12, m = ram(s, m, u, p, k, line, load[i])
        s = State(0.0, 0.0, spool[i], 0.0, x, v, p12, x)
        out[0, i], out[1, i] = x, p12


@pytest.mark.parametrize("h", [1e-5, 5e-5])
def test_compressibility_resonates_where_it_should_and_the_step_damps_nothing(h: float) -> None:
    """w = AJ/sqrt(V/4B MJ), 123 Hz; damping from CJ and the edges, within 3 % at 50 us."""
    model = EASY.replace({"compressibility.coefficient": 1e-9})
    v, capacitance = model.values, 0.25 * 1.5e-4 * 1e-9
    out = np.empty((2, round(0.05 / h)))
    start = model.build_flat_state()
    start[State._fields.index("jack_speed")] = 0.01
    run = interpret_function(_moved, model.kind.bind_functions(model.effects))
    run(start, *np.zeros((2, out.shape[1])), model.build_record(), h, out)
    matrix = np.array([[-v["jack.damping"] / v["jack.mass"], v["jack.area"] / v["jack.mass"]],
                       [-v["jack.area"] / capacitance, -(v["valve.flow_gain"] / v["valve.pressure_gain"]
                                                         + v["jack.leakage"]) / capacitance]])
    root = np.linalg.eigvals(matrix)[0]
    t, (_, p12) = np.arange(1, out.shape[1] + 1) * h, out
    peaks = [i for i in range(1, len(p12) - 1) if abs(p12[i]) >= abs(p12[i - 1]) and abs(p12[i]) > abs(p12[i + 1])]
    duration = t[peaks[-1]] - t[peaks[0]]
    w, decay = np.pi * (len(peaks) - 1) / duration, np.log(abs(p12[peaks[0]] / p12[peaks[-1]])) / duration
    assert (w, w) == pytest.approx((2 * np.pi * 123.3, abs(root.imag)), rel=0.01)
    assert decay == pytest.approx(-root.real, rel=0.03)


COMMAND = np.r_[np.zeros(10), np.full(150, 2e-3), 2e-3 + 1e-3 * np.sin(np.arange(250) * 0.02)]
STEADY = np.full(80, 1e-3)  # A
AREA = WHOLE["jack.area"]


def list_steady_cases() -> Iterator[Any]:
    """Model, current, load and force of dry friction at the speed v of the ram, N."""
    yield pytest.param(EASY.replace({"jack.damping": 20e3}), STEADY, 0.0, lambda v: 0.0, id="viscous drag")
    yield pytest.param(EASY.replace({"jack.leakage": 3e-11}), np.zeros(60), 6e3, lambda v: 0.0, id="leakage")
    dry = {"jack.static_friction": 1600.0, "jack.dynamic_friction": 1000.0}
    for sign in (1.0, -1.0):
        yield pytest.param(QUIET_SPOOL.replace(dry), sign * STEADY, 0.0, lambda v: np.sign(v) * 1000.0,
                           id=f"jack friction {sign:+g}")
        yield pytest.param(QUIET_SPOOL.replace({"friction_asymmetry.asymmetry": 0.3}), sign * STEADY, 0.0,
                           lambda v: np.sign(v) * 500.0 + 0.3 * 500.0, id=f"friction asymmetry {sign:+g}")
    for speed in (0.002, 0.01, 0.05):
        model = QUIET_SPOOL.replace({"stribeck.rise": 0.5, "stribeck.speed": 0.01})
        current = speed * AREA / model["valve.flow_gain"] / measure_spool(model, 1.0)
        yield pytest.param(model, np.full(400, current), 0.0,
                           lambda v: 500.0 + 0.5 * 800.0 * np.exp(-(v / 0.01) ** 2), id=f"stribeck {speed:g}")
        model = QUIET_SPOOL.replace({"presliding.deflection": 2e-5, "presliding.speed": 0.01})
        yield pytest.param(model, np.full(400, current), 0.0,
                           lambda v: 500.0 + 300.0 * np.exp(-(v / 0.01) ** 2), id=f"bristles {speed:g}")
    for deflection in (5e-6, 2e-5, 1e-4):
        yield pytest.param(QUIET_SPOOL.replace({"presliding.deflection": deflection}), STEADY, 0.0, lambda v: 500.0,
                           id=f"presliding {deflection:g}")


@pytest.mark.parametrize(("model", "current", "load", "dry"), list(list_steady_cases()))
def test_pressure_at_constant_speed_is_friction_drag_and_load(model: Model, current: np.ndarray, load: float,
                                                             dry: Callable[[float], float]) -> None:
    _, p12, _, _, v = drive_plant(model, current, load)[1][:, -1]
    assert AREA * p12 == pytest.approx(dry(v) + model["jack.damping"] * v + load, rel=2e-3) and abs(v) > 1e-6


@pytest.mark.parametrize(("load", "moves"), [(559.0, False), (561.0, True), (-1039.0, False), (-1041.0, True)])
def test_a_ram_with_asymmetric_friction_at_rest_holds_more_one_way(load: float, moves: bool) -> None:
    """Loads up to FS (1 - d) against extension and FS (1 + d) with it move nothing, more does."""
    plant, _ = drive_plant(WHOLE.replace({"friction_asymmetry.asymmetry": 0.3}), np.zeros(30), load)
    assert (plant.state.jack_position != 0.0) == moves


@pytest.mark.parametrize("deflection", [5e-6, 2e-5, 1e-4])
def test_presliding_is_a_spring_for_small_loads(deflection: float) -> None:
    plant = drive_plant(QUIET_SPOOL.replace({"presliding.deflection": deflection}), np.zeros(3000), 50.0)[0]
    slipped = -np.log(1.0 - 50.0 / 500.0) * 500.0  # N: the bristles' spring, softening towards the dynamic level
    assert plant.state.jack_position == pytest.approx(-slipped * deflection / 800.0, rel=1e-3)


def test_mount_compliance_shows_the_force_as_position() -> None:
    model = EASY.replace({"mount_compliance.compliance": 5e-8})
    sensed, p12, _, x, _ = drive_plant(model, 3e-3 * np.sin(np.arange(100) * 0.3), 4e3)[1]
    assert sensed - x == pytest.approx(5e-8 * AREA * p12, rel=1e-9, abs=1e-18) and abs(sensed - x).max() > 1e-4


def test_backlash_loses_its_width_at_every_reversal() -> None:
    model = EASY.replace({"rod_backlash.width": 1e-4})
    sensed, _, _, x, _ = drive_plant(model, 3e-3 * np.sin(2 * np.pi * 4 * np.arange(500) * 1e-3))[1]
    assert np.ptp(x[250:]) - np.ptp(sensed[250:]) == pytest.approx(1e-4, rel=5e-3)  # peaks lie between samples
    assert ((sensed - x).min(), (sensed - x).max()) == pytest.approx((-0.5e-4, 0.5e-4))
    standing = np.flatnonzero(np.diff(sensed[130:]) == 0.0) + 130
    assert np.ptp(x[standing[:5]]) < 1e-4 and len(standing) > 5


def test_constant_load_equals_the_load_of_the_command() -> None:
    by_effect = simulate(WHOLE.replace({"constant_load.force": 1500.0}), COMMAND)
    assert (by_effect.xj == simulate(WHOLE, COMMAND, load=np.full(len(COMMAND), 1500.0)).xj).all()


@pytest.mark.parametrize("tau", [0.3e-3, 3e-3])
@pytest.mark.parametrize("signal", ["step", "ramp", "sine"])
def test_sensor_lag_is_a_first_order_lag(tau: float, signal: str) -> None:
    t, w = np.arange(1, 4001) * H, 2 * np.pi * 40
    x, response = {
        "step": (np.full_like(t, 1e-3), 1e-3 * (1 - np.exp(-(t - H / 2) / tau))),  # it rises within the first step
        "ramp": (t, t - tau * (1 - np.exp(-t / tau))),
        "sine": (np.sin(w * t), (np.sin(w * t) - w * tau * (np.cos(w * t) - np.exp(-t / tau))) / (1 + (w * tau) ** 2)),
    }[signal]
    sensed = follow(sensor_lag, x, Lag(), WHOLE.replace({"sensor_lag.time": tau}).build_record()[0])
    np.testing.assert_allclose(sensed, response, atol=2e-4 * np.abs(x).max())


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("more", [{}, {"sensor_lag.time": 2e-3}])
def test_the_first_sample_has_the_sensors_offset(more: dict[str, float], fast: bool) -> None:
    """The transducer shows it before the plant has made a step."""
    model = WHOLE.replace({"sensor_offset.offset": 50e-6} | more)
    plant = Actuator(model, steps=20, fast=fast)
    run = simulate(model, np.zeros(3), steps=20, fast=fast)
    assert plant.sample()[0] == run.xj[0] == 50e-6
    assert run.cor[0] == -50e-6 * model["controller.proportional_gain"]
    plant.advance(0.0)
    assert plant.sample()[0] == run.xj[1] == 50e-6  # nor is there a jump in the second


def test_readings_are_whole_steps_and_their_error_is_evenly_spread() -> None:
    """The noise is quantised too; where it is as large as the step, the error's variance is LSB^2/12."""
    model = WHOLE.replace({"sensors.position_noise": 5e-6})
    plants = [Actuator(model.replace({"quantisation.lsb": lsb}), seed=4) for lsb in (5e-6, 0.0)]
    reads, was = (np.array([plant.sample()[0] for _ in range(4000)]) for plant in plants)
    np.testing.assert_allclose(reads / 5e-6, np.round(reads / 5e-6), atol=1e-9)
    assert abs(reads - was).max() <= 2.5e-6 * (1 + 1e-9)
    assert np.var(reads - was) == pytest.approx(5e-6**2 / 12, rel=0.06)


def test_the_rigs_own_firmware_limits_the_rate_too() -> None:
    """Frame by frame, from the first active cycle; and anew after each activation."""
    harness = FirmwareHarness(Model().replace({"command_rate_limit.rate": 0.1}))
    ramp = [0.0, *(0.1e-3 * k for k in range(1, 6))]
    for _ in range(2):
        drives = [harness.cycle(CIA408.ladder[-1], demand) for demand in (0.0, *[5e-3] * 5)]
        assert [drive and drive.current for drive in drives] == pytest.approx([3.8 * x for x in ramp], abs=1e-8)
        harness.cycle(0)


@pytest.mark.parametrize("changes", [{}, {"command_rate_limit.rate": 0.1}])
def test_the_firmware_alone_answers_as_in_the_loop(changes: dict[str, float]) -> None:
    model = Model().replace(changes)
    run = simulate(model, COMMAND, seed=2)
    assert (compute_answers(model, COMMAND, np.column_stack([run.xj, run.p12, run.xs])) == run.cor).all()


def test_a_heavy_body_on_its_mount_rings_as_its_equation_says() -> None:
    mass, compliance, ratio = 20.0, 1.0 / 27e6, 0.05
    p = EASY.replace({"mount_compliance.compliance": compliance, "mount_compliance.mass": mass,
                      "mount_compliance.damping_ratio": ratio}).build_record()[0]
    sensed = follow(mount_compliance, np.zeros(4000), Recoil(), p, State(pressure=1e6))  # 40 ms, a step of pressure
    t, w = H * np.arange(1, 4001), 1.0 / np.sqrt(mass * compliance)
    damped, decay = w * np.sqrt(1.0 - ratio**2), np.exp(-ratio * w * t)
    exact = compliance * AREA * 1e6 * (1.0 - decay * (np.cos(damped * t) + ratio * w / damped * np.sin(damped * t)))
    np.testing.assert_allclose(sensed, exact, atol=0.01 * exact.max())
    assert exact.max() > 1.8 * compliance * AREA * 1e6, "it overshoots"


def test_a_mass_on_the_ram_has_the_antiresonance_and_the_resonance_of_two_masses() -> None:
    """A ram without pressure, pushed by a cosine: X/F in amplitude and phase; it hardly moves at f, most above it."""
    mass, f, ratio, push, h = 60.0, 60.0, 0.03, 500.0, 4e-5
    model = SMOOTH.replace({"structural_resonance.mass": mass, "structural_resonance.frequency": f,
                            "structural_resonance.damping_ratio": ratio})
    p, move_ram = model.build_record()[0], interpret_function(ram, model.kind.bind_functions(model.effects))
    k, resonance = compute_coefficients(p, h), f * np.sqrt(1.0 + mass / p.jack.mass)
    k = k._replace(jack_coupled=k.jack_free)  # as the oil has no part in it
    sizes = []
    for hertz in (20.0, f, resonance, 120.0):
        (s, m), w, t = model.build_start(), 2.0 * np.pi * hertz, h * np.arange(1, round(0.45 / h) + 1)
        x = np.empty(len(t))
        for i, force in enumerate(push * np.cos(w * (t - 0.5 * h))):  # at mid step; a cosine gives the ram no drift
            x[i], v, _, m = move_ram(s, m, Input(h=h), p, k, Line(0.0, 0.0, 0.0, 0.0), force)
            s = s._replace(jack_position=x[i], jack_speed=v)
        last = slice(-round(0.1 / h), None)  # the start has died away
        waves = np.exp(1j * w * t[last])
        (real, imaginary, _), *_ = np.linalg.lstsq(np.c_[waves.real, -waves.imag, np.ones(len(waves))], x[last])
        spring, damper = mass * (2.0 * np.pi * f) ** 2, 2.0 * ratio * mass * 2.0 * np.pi * f
        link = spring + 1j * w * damper
        stiffness = -w**2 * mass * link / (link - w**2 * mass)  # force on the ram for each metre that it moves
        exact = -push / (-w**2 * p.jack.mass + 1j * w * p.jack.damping + stiffness)
        assert abs(real + 1j * imaginary - exact) < 0.03 * abs(exact), hertz
        sizes.append(abs(exact) * w**2)  # of the acceleration: what the mass alone does not change
    assert sizes[1] < 0.2 * sizes[0] and sizes[2] > 3.0 * max(sizes[0], sizes[3])


WEAR = ("magnet_loss", "coil_short", "nozzle_block", "land_clearance", "edge_rounding")


def build(name: str, value: float) -> tuple[Model, object, Line]:
    """A model with that value, its parameters, and the metering line of a spool that is 20 um open."""
    model = Model().replace({name: value})
    p = model.build_record()[0]
    k = compute_coefficients(p, 1e-5)
    drive = k.valve_gain * 2e-5
    return model, p, Line(drive, k.valve_slope, k.valve_limit, drive)


def test_explain_does_not_search_them_and_each_has_a_source() -> None:
    assert not set(WEAR) & {*CATALOGUE, *(e.name for e in find_plant("ema").list_effects())}
    assert all(CATALOGUE[name].source and CATALOGUE[name].revealed_by for name in WEAR)


def test_a_weaker_magnet_moves_the_spool_by_less() -> None:
    xs = drive_plant(SMOOTH.replace({"magnet_loss.share": 0.3}), np.full(100, 1e-3), fast=False, steps=20)[1][2]
    assert xs[-1] == pytest.approx(measure_spool(SMOOTH, 0.7e-3), rel=1e-3)


def test_shorted_turns_lose_gain_and_lag_by_their_share_of_the_time_constant() -> None:
    _, p, _ = build("coil_short.share", 0.2)
    out, t = follow(coil_short, np.full(4000, 1e-3), Flux(), p, h=1e-6), 1e-6 * np.arange(1, 4001)
    assert np.allclose(out, 0.8e-3 * (1.0 - np.exp(-t / 0.6e-3)), atol=2e-6)


@pytest.mark.parametrize("b", [0.3, -0.3, 1.0])
@pytest.mark.parametrize("x", [-1e-5, 0.0, 2e-5])
def test_a_blocked_nozzle_is_half_the_difference_of_the_openings(b: float, x: float) -> None:
    model, p, _ = build("nozzle_block.share", b)
    most = model["flapper.travel"]
    left, right = (most + x) * (1.0 + min(b, 0.0)), (most - x) * (1.0 - max(b, 0.0))
    assert nozzle_block(x, State(), Input(), p) == pytest.approx(0.5 * (left - right), abs=1e-18)


@pytest.mark.parametrize("speed", [0.0, 0.05])
def test_worn_lands_leak_in_proportion_to_the_pressure(speed: float) -> None:
    """GQ XS - GQ/GP P12 = AJ v + (CLK + K) P12 with K = w (c^3 - c0^3)/(12 mu L)."""
    model, p, line = build("land_clearance.clearance", 3e-5)
    worn_line = land_clearance(line, State(), Input(), p)
    pressure = worn_line.offset - worn_line.slope * speed
    leak = 0.013 * (3e-5**3 - 6e-6**3) / (12.0 * 0.015 * 1e-3)
    gq, gp = model["valve.flow_gain"], model["valve.pressure_gain"]
    flow = model["jack.area"] * speed + (model["jack.leakage"] + leak + gq / gp) * pressure
    assert flow == pytest.approx(gq * 2e-5, rel=1e-9)


def test_rounded_edges_are_a_bridge_of_two_openings() -> None:
    """At rest GQ ((a - b) - (a + b)/2 P/PSR), less the same of new edges, is added to the nominal flow."""
    model, p, line = build("edge_rounding.radius", 1.5e-5)
    pressure = edge_rounding(line, State(), Input(), p).offset
    gq, gp, psr, x = model["valve.flow_gain"], model["valve.pressure_gain"], model["supply.pressure"], 2e-5

    def flow(r: float) -> float:
        a, b = np.hypot(x, r), r
        return float(gq * ((a - b) - 0.5 * (a + b) * pressure / psr))

    total = gq * x - gq / gp * pressure + flow(1.5e-5) - flow(1e-6)
    # the nominal leakage is in the gain that turns opening into pressure
    assert total == pytest.approx(model["jack.leakage"] * pressure, rel=1e-6)
    assert pressure < line.offset
