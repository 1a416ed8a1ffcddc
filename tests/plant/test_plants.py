"""Every plant, shipped or a user's: one suite over what it declares; pump-driven ones in closed form; bad files."""

import re
from math import factorial
from pathlib import Path

import numpy as np
import pytest
from effects_cases import WHOLE
from physics_cases import PREFLIGHT, SILENT
from places import ROOT
from refusals import catch_refusal
from rig_command import refuse, rig, write_file

from plant import (
    Input,
    Lanes,
    Model,
    build_profile,
    check_behaviour,
    compute_answers,
    compute_flow_balance,
    compute_force_balance,
    find_key,
    find_plant,
    list_plants,
    list_searched_effects,
    load_model,
    load_plant,
    simulate,
)
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
from rig.sequences import load_sequence

EXAMPLE = ROOT / "plant" / "models" / "new_plant.py"  # copies with its name share its compiled code
TEXT = EXAMPLE.read_text()
ROWS = 300
# the controller remembers something from the start: a number, and two that mean "not yet known"
REMEMBERING = TEXT.replace("class State(", """class Memory(NamedTuple):
    bias: float = 1
    last: float = float("nan")
    least: float = float("inf")


class State(""").replace("control=control", "control=control, control_memory=Memory").replace(
    "p.controller.limit), c", "p.controller.limit) + (c.bias if c.last != c.last else 0.5), "
    "Memory(c.bias, demand, min(c.least, y[0]))")


@pytest.fixture(params=[*list_plants(), str(EXAMPLE), "remembering.py"], ids=lambda name: Path(name).stem)
def model(request: pytest.FixtureRequest, here: Path) -> Model:
    (here / "remembering.py").write_text(REMEMBERING)
    return load_model(request.param)


def find_command(model: Model) -> np.ndarray:
    """The most lively rows of its nominal test, of a plant without one those of preflight."""
    profile = model.kind.profile
    whole = build_profile(profile).command if profile else PREFLIGHT
    middle = int(np.abs(np.diff(whole)).argmax())
    return np.ascontiguousarray(whole[max(middle - 5, 0):][:ROWS])


def test_runs_are_finite_and_repeatable_and_those_of_plain_python(model: Model) -> None:
    com = find_command(model)
    once, again, plain = (simulate(model, com, seed=2, steps=20, fast=fast) for fast in (True, True, False))
    assert once._fields == tuple(s.name for s in model.kind.signals)
    assert np.isfinite(once).all() and np.ptp(getattr(once, model.kind.signals.controlled.name)) > 0.0
    assert np.array_equal(once, again) and np.array_equal(once, plain)


def test_lanes_are_single_runs(model: Model) -> None:
    com = find_command(model)
    quiet = model.replace({s.noise: 0.0 for s in model.kind.signals.outputs if s.noise})
    run = simulate(quiet, com, steps=20)
    whole = np.column_stack([getattr(run, s.name) for s in quiet.kind.signals.columns])
    out = Lanes(quiet, ()).closed_loop(np.empty((3, 0)), com, np.zeros(len(com)))
    assert all(np.array_equal(lane, whole) for lane in out)
    drive = getattr(run, quiet.kind.signals.drive.name)
    replay_outputs = Lanes(quiet, ()).replay(np.empty((1, 0)), drive, np.zeros(len(com)))[0]
    outputs = np.column_stack([getattr(run, s.name) for s in quiet.kind.signals.outputs])
    assert np.array_equal(replay_outputs, outputs) or model.effects  # an effect on a reading acts on the controller too


def test_effects_at_their_off_values_change_nothing(model: Model) -> None:
    every = model.with_effects(e.name for e in model.kind.list_effects())
    com = find_command(model)[:40]
    assert np.array_equal(*(simulate(m, com, seed=1, steps=20, fast=False) for m in (model, every)))


def test_a_model_file_of_a_users_plant_is_the_same_model_again(here: Path) -> None:
    (here / "mine.py").write_text(TEXT)
    model = load_model("mine.py").replace({"dry_friction.torque": 0.3, "motor.resistance": 2.5})
    (here / "unit.toml").write_text(model.to_toml())
    again = load_model(here / "unit.toml")
    assert (again.values, again.effects, again.kind) == (model.values, model.effects, model.kind)
    assert find_key(load_plant(Path("other/mine.py"), TEXT.encode()).key) == "other/mine.py"  # a second "mine.py"
    (here / "mine.py").write_text(TEXT.replace("= 2.0\n", "= 4.0\n", 1))
    assert load_model("mine.py")["motor.resistance"] == 4.0  # another file under the same name is another plant


def test_a_model_file_runs_its_plant_only_with_trust(tmp_path: Path) -> None:
    (tmp_path / "new_plant.py").write_text(TEXT)
    (tmp_path / "unit.toml").write_text('plant = "new_plant.py"\n[motor]\nresistance = 3.0\n')
    words = ("simulate", "--model", tmp_path / "unit.toml", "--out", tmp_path / "s.csv")
    refusal = rig(*words)
    assert refusal.status == 2 and "--trust" in refusal.err and not (tmp_path / "s.csv").exists()
    assert rig(*words, "--trust").status == 0
    assert (tmp_path / "s.csv").read_text().startswith("t,demand,voltage,angle,current,torque\n")


def test_the_written_example_passes_its_checks(tmp_path: Path) -> None:
    file = tmp_path / "new_plant.py"
    assert rig("new", "plant", "new_plant", "--out", file).status == 0
    result = rig("check", file, "--json")
    assert result.status == 0 and result.json["verdict"] == "SOUND" and len(result.json["checks"]) == 7
    assert rig("new", "plant", "new_plant", "--out", file).status == 2  # it replaces nothing
    assert "new_plant.py: segment, time: expected whole cycles of 0.00105 s" in refuse(
        "simulate", "--model", file, "--set", "controller.period=0.00105")


def test_its_own_effect_may_have_the_name_of_a_shared_one(tmp_path: Path) -> None:
    own = load_model(write_file(tmp_path / "own.py", TEXT.replace("dry_friction", "stribeck")))
    assert own.find_effect("stribeck").parameters.keys() == {"stribeck.torque"}
    assert own.replace({"stribeck.torque": 0.4}).effects == ("stribeck",)
    assert load_model("eha").find_effect("stribeck").parameters.keys() == {"stribeck.rise", "stribeck.speed"}


@pytest.mark.parametrize(("old", "new", "message"), [
    ('Quantity("ohm", "R", low=0.01, high=100, tolerance=0.05)', 'Quantity("")', "motor.resistance.*unit"),
    ("resistance: Annotated[float, Quantity(\"ohm\", \"R\", low=0.01, high=100, tolerance=0.05)] = 2.0",
     "resistance: float = 2.0", "motor.resistance.*Annotated"),
    ("low=0.01, high=100", "low=100, high=0.01", "motor.resistance: expected a low end below the high one, .*0.01"),
    ("tolerance=0.05)] = 2.0", "tolerance=-0.05)] = 2.0", "motor.resistance: expected a tolerance from 0 to 1,.*-0.05"),
    ("tolerance=0.05)] = 2.0", "tolerance=5.0)] = 2.0", "motor.resistance: expected a tolerance from 0 to 1, .*not 5"),
    ("profile=(", "solver_step=-1e-5, profile=(", "solver_step: expected above 0 s .*, not -1e-05"),
    ("profile=(", "solver_step=0.5, profile=(", "solver_step: expected .* at most controller.period, not 0.5"),
    ("largest=100.0", "largest=-100.0", "signal demand, largest: expected a number above 0 rad, not -100"),
    ("Step(to=0.5", 'Step(to=float("nan")', "profile: expected segments .* of finite numbers"),
    ("tolerance=0.05)] = 2.0", "tolerance=0.05)]", "motor.resistance.*nominal value"),
    ("tolerance=0.05)] = 2.0", "tolerance=0.05)] = 2000.0", "motor.resistance.*to 100 ohm"),
    ("tolerance=0.05)] = 2.0", 'tolerance=0.05)] = "2"', "motor.resistance.*nominal value"),
    ('Signal("angle", "theta", "rad"', 'Signal("angle", "theta", ""', "signal angle.*unit"),
    ("return s.angle, s.current", "return (s.angle,)", "measure.*2 numbers, angle, current"),
    ("return s.angle, s.current", "return s.angle, s.amps", r"\.py:\d+: measure.*amps"),
    ('@effect("friction"', '@effect("fricton"', "effect dry_friction.*voltage, load, friction"),
    ('"motor.resistance", (2.0', '"motor.resistence", (2.0', "fault winding.*motor.resistance"),
    ("(2.0, 4.0), 2.3, 3.0", "(2.0, 4.0), 2.3, 30.0", "faults.winding.maintenance.*2 .. 4 ohm, not 30"),
    ("Step(to=0.5, time=0.9)", "Step(to=500.0, time=0.9)", "profile: expected demands of at most 100 rad .*, not 500"),
    ("moves=(\"angle\",)", "moves=(\"angel\",)", "moves.*angle"),
    ("moves=(\"angle\",)", "moves=lambda s, d, p: State(s.current, s.speed, s.angle - d)",
     "moves.*angle.* rad, not by -1"),
    ("x + p.dry_friction.torque", "x + p.friction.torque", "effect dry_friction.*p.dry_friction.FIELD.*not p.friction"),
    ('"drive"),', '"output"),', "signals: expected one signal of role drive, not none"),
    ('"drive"),', '"driv"),', r"\.py:\d+: signal voltage, role: expected one of command, .*, not 'driv'"),
    ('Signal("current"', 'Signal("angle"', r"\.py:\d+: signal angle, name: expected a name that no other signal has"),
    ('Quantity("ohm", "R", low', "Quantity(low", "motor.resistance.*unit"),
    ("Step(to=0.5, time=0.9)", "Step(to=0.5, time=-0.9)", r"\.py:\d+: segment, time: expected above 0"),
    ("class State(", 'import plant.declare as d\nd.base_effect("stiff", Wheel, "stiff", law="")\nclass State(',
     r"\.py:\d+: effect stiff, wheel.stiff: expected a field of wheel"),
    ("period: Annotated", "cycle: Annotated", "controller.*period|period"),
    ("return State(current, speed", "return Stat(current, speed", r"\.py:\d+.*Stat"),
    ("def control(", "def control(x, ", "control.*4 arguments"),
    ("def step(", "def step((", r"\.py:\d+.*Python"),
    ("step=step", "step=__import__('functools').partial(step)", "step: expected code .* not AttributeError.*partial"),
    ("    h, ratio, kt =", "    step(s, m, u, p)\n    h, ratio, kt =", "step: expected code .* not RecursionError"),
    ("PLANT = Plant(", "PLAN = Plant(", "PLANT"),
    ("Step(to=0.5, time=0.9)", "0.5", "profile.*segments"),
])
def test_a_wrong_plant_file_is_refused_in_one_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in TEXT
    file = write_file(tmp_path / "wrong.py", TEXT.replace(old, new, 1))
    line = catch_refusal(lambda path: [*check_behaviour(load_model(path))], file)
    assert re.search(message, line) and str(file) in line


TIMES = "Hold(time=0.1), Step(to=0.5, time=0.9), Sine(amplitude=0.2, frequency=2.0, time=1.0)),"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("old", "new"), [
    pytest.param("    h, ratio,", "    late = min(1.0, 1.0 / u.t)\n    h, ratio,", id="division by zero"),
    pytest.param(TIMES, 'Step(to=0.5, time=0.1002),), values={"controller.period": 2e-4},', id="cycles of 0.2 ms"),
    pytest.param(TIMES, 'Step(to=0.5, time=0.3),), values={"controller.period": 3e-3},', id="333.3 cycles a second"),
    pytest.param("Controller),\n", """Controller,
    NamedTuple("Jack", [("static_friction", Annotated[float, Quantity("N")])])),
    values={"jack.static_friction": 1.0},""", id="static friction alone"),
    pytest.param("class DryFriction(", """import plant.declare
plant.declare.base_effect("wheel", Wheel, "damping", law="B", starts=(0.3,))


class DryFriction(""", id="effect named like a group")])
def test_an_unusual_plant_file_is_taken(old: str, new: str, tmp_path: Path) -> None:
    model = load_model(write_file(tmp_path / "unusual.py", TEXT.replace(old, new))).replace({"wheel.inertia": 0.06})
    com = load_sequence("preflight", 1.0 / model["controller.period"], model.plant).build_main_profile().command
    assert old in TEXT and np.isfinite(simulate(model, com[:50], steps=4, fast=False)).all()


def test_the_signal_may_be_in_another_unit_than_the_state_that_moves(tmp_path: Path) -> None:
    text = TEXT.replace("return s.angle, s", "return 50.0 * s.angle, s")
    kind = load_plant(write_file(tmp_path / "degrees.py", text))
    assert kind.find_share_moved(kind.move) == pytest.approx(1.0)


RIGHT = "lambda s, d, p: State(s.current, s.speed, s.angle + d, s.motor + d * p.wheel.ratio)"


@pytest.mark.parametrize(("moves", "check", "passes"), [
    ('("angle", "motor")', "moves", False), ('("angle",)', "moves", False), (RIGHT, "moves", True),
    (RIGHT, "step", False)])
def test_a_plant_file_that_runs_and_is_wrong_fails_its_check(moves: str, check: str, passes: bool, tmp_path: Path
                                                             ) -> None:
    """A motor's angle and the angle of the wheel behind a stiff shaft, at rest elsewhere than at 0: moved by the same
    angle in spite of the gear, the wheel alone, or both as they have to be. A rule for one angle and another for the
    other let them drift apart: by less than 1 % of the range, but by more than the noise."""
    text = TEXT.replace("    angle: float = 0.0", "    angle: float = 0.2\n    motor: float = 10.0").replace(
        "- load)", "- load - 2e3 * (s.angle - s.motor / ratio))").replace(
        "(s.speed + speed))", "(s.speed + speed), s.motor + h * ratio * speed)").replace(
        '("angle",)', moves)
    model = load_model(write_file(tmp_path / "shaft.py", text))
    finding = next(finding for finding in check_behaviour(model) if finding.check == check)
    assert finding.passed == passes


def test_a_stiff_plant_without_tolerances_is_explained(tmp_path: Path) -> None:
    """An explicit current diverges in ten steps a cycle, with which the search begins; and no unit is off nominal."""
    text = re.sub(r", tolerance=[\d.]+", "", TEXT).replace("] = 2e-3", "] = 6e-5").replace(
        "* s.speed)) / (inductance + h * p.motor.resistance)",
        "* s.speed - p.motor.resistance * s.current)) / inductance")
    file, run = write_file(tmp_path / "stiff.py", text), tmp_path / "run.csv"
    rig("simulate", "--model", file, "--set", "dry_friction.torque=0.4", "--out", run)
    answer = rig("explain", run, "--model", file, "--json").json
    assert (answer["verdict"], answer["effects"]) == ("EXPLAINED", ["dry_friction"])


def test_a_plant_that_diverges_is_refused_with_signal_and_time(tmp_path: Path) -> None:
    file = write_file(tmp_path / "unstable.py", TEXT.replace("current - load",
                                                             "current - load + 1e5 * s.speed * abs(s.speed)"))
    result = rig("simulate", "--model", file, "--out", tmp_path / "s.csv")
    assert result.status == 2 and re.search(r"angle|current|voltage", result.err) and "t = 0.0" in result.err
    assert not (tmp_path / "s.csv").exists()
    first, = check_behaviour(load_model(file))
    assert "a plant that stays finite; " in refuse("check", "preflight", "--model", file)
    ran = rig("run", "--model", file, "--out", tmp_path / "run")
    assert not first.passed and "t = 0.1" in first.text and "no finite number in angle" in ran.out


CHECK = ("check", "my_new.toml")
TRIAL = ("effects", "--effects", "my_new.py", "my_new")  # on a shipped plant its own kernels take five seconds


@pytest.mark.parametrize(("kind", "check", "plant"), [
    ("sequence", CHECK, "eha"), ("fault", CHECK, "eha"), pytest.param("effect", TRIAL, "eha", marks=pytest.mark.slow),
    ("sequence", CHECK, "slow_plant.py"),
    *((kind, check, "new_plant.py") for kind, check in (("sequence", CHECK), ("fault", CHECK), ("effect", TRIAL)))])
def test_a_new_file_passes_its_own_check(kind: str, check: tuple[str, ...], plant: str, here: Path) -> None:
    (here / "new_plant.py").write_text(TEXT)
    slow = TEXT.replace("period: Annotated[float, Quantity(\"s\", low=1e-4, high=0.1)] = 1e-3",
                        "period: Annotated[float, Quantity(\"s\", low=1e-4, high=0.1)] = 3e-3")
    (here / "slow_plant.py").write_text(slow.replace("time=0.1)", "time=0.3)").replace("time=1.0)", "time=0.9)"))
    assert rig("new", kind, "my_new", "--model", plant, "--json").json["verdict"] == "COMPLETE"
    result = rig(*check, "--model", plant, "--json")
    assert result.status == 0 and "are of a bench" in rig("new", kind, "other", "--node", "3").err
    if kind == "effect":
        trial = result.json["effects"][0]["self_test"]
        assert trial["faults"] == [] and trial["visible"]
        assert {"start", "level", *(s.name for s in load_model(plant).kind.signals.outputs)} == set(trial["shown"][0])


CYCLE = 1e-3
SPEED = 800.0  # raw
GENERAL = ("undissolved_air", "flow_delay", "valve_switching", "asymmetric_gain")


def build_model(**changes: float) -> Model:
    """The bare integrator without the steps of its position sensor, with some parameters changed.

    It has the general effects, so that one kernel serves all.
    """
    return load_model("ehs").with_effects(GENERAL).replace({"quantisation.lsb": 0.0}
                                     | {name.replace("__", "."): value for name, value in changes.items()})


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
    share = model["pump.displacement"] * 200.0 * CYCLE * (np.arange(400.0) - 1.0).clip(0.0) / volume
    pressure = ATMOSPHERE * {0.0: share, 1.0: np.exp(share) - 1.0, 2.0: 1.0 / (1.0 - share) - 1.0}[exponent]
    assert pressure[-1] > 0.09 * ATMOSPHERE and np.abs(xj).max() == 0.0
    np.testing.assert_allclose(p12, pressure, rtol=2e-3, atol=5.0)


def test_a_delayed_flow_follows_erlangs_distribution() -> None:
    """Four lags of tau/4: 1 - exp(-k) (1 + k + k^2/2 + k^3/6), k = 4 t/tau; without delay exactly the step."""
    h, tau = 1e-5, 0.02
    (p,), (none,) = (build_model(flow_delay__time=time).build_record() for time in (tau, 0.0))
    flows = [(0.0, Cascade())]
    for _ in range(6000):
        flows.append(flow_delay(1.0, flows[-1][1], State(), Input(h=h), p))
    k = 4.0 * h * np.arange(1, 6001) / tau
    response = 1.0 - np.exp(-k) * sum(k**n / factorial(n) for n in range(4))
    np.testing.assert_allclose([y for y, _ in flows[1:]], response, atol=1e-3)
    assert flow_delay(0.7, Cascade(0.1, 0.2, 0.3, 0.4), State(), Input(h=h), none)[0] == 0.7


def test_a_switching_valve_stops_the_flow_at_each_reversal_and_not_at_the_start() -> None:
    """Half a step of the solver (10 us) counts as half: a fit sees a slope."""
    later, late, prompt = (replay(build_model(valve_switching__time=time), np.repeat([SPEED, -SPEED], 200))[0]
                           for time in (0.050005, 0.05, 0.0))
    assert late[200] == prompt[200]
    np.testing.assert_allclose([late[-1] - prompt[-1], later[-1] - late[-1]],
                               np.array([0.05, 5e-6]) * compute_speed(build_model()), rtol=2e-3)


def test_an_asymmetric_gain_answers_a_negative_error_less() -> None:
    model = build_model(asymmetric_gain__retraction=-0.3)
    answers = compute_answers(model, np.array([1e-3, -1e-3, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(answers / model["controller.proportional_gain"], [1e-3, -0.7e-3, 0.0], rtol=1e-12)


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
    ram_speed = out * (flow - leakage / area**2 * pressure) / model["jack.area"]
    np.testing.assert_allclose(np.diff(xj[100:]) / CYCLE, ram_speed[100:-1], rtol=1e-3)
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
    flow_model = model.replace({"pump.pressure_given": 1.0, "undissolved_air.preload": 0.0})
    for (delay, _), run in zip(values, driven, strict=True):
        force = compute_pressure_force(dict(model.values) | {names[0]: delay}, chambers, drive, CYCLE)
        flow_run = Lanes(flow_model, names, 20).replay(np.array([[delay, 0.0]]), drive, force)[0]
        assert (run[:, 0] == flow_run[:, 0]).all()


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


def test_the_load_of_a_press_is_the_sum_of_both_directions_and_acts_both_ways_by_its_share() -> None:
    """10 bar of load out and none back, friction of 8 bar both ways; the pressure at rest does not count."""
    way = np.r_[np.zeros(500), np.full(1000, 1.0), np.zeros(500), np.full(1000, -1.0), np.zeros(500)]
    load = estimate_load_in_motion({"xj": np.cumsum(way) * 1e-5,
                                    "p12": np.where(way > 0, 18e5, np.where(way < 0, -8e5, 40e5))})
    p12 = simulate(load_model("ehs").replace({"external_load.share": 0.5, "sensors.pressure_noise": 0.0}),
                   np.zeros(20), load[:20], steps=4, fast=False).p12[-1]
    assert [*load / load_model("ehs")["jack.area"], 2.0 * p12] == pytest.approx([10e5] * (len(way) + 1))


@pytest.mark.parametrize("name", GENERAL)
@pytest.mark.parametrize("plant", ["eha", "ehs"])
def test_general_effects_suit_every_plant_and_act_and_are_searched_in_this_one(name: str, plant: str) -> None:
    """In plain Python: compiled code gives the same bits (test_effects.py). `rig explain` does not test them on the
    reference plant unasked.
    """
    e, model = CATALOGUE[name], load_model(plant).replace({"quantisation.lsb": 0.0})
    assert e.law and e.symptoms and e.source and e.function.__doc__
    assert e in find_plant(plant).list_effects() and (e in list_searched_effects(plant)) == (plant == "ehs")
    command = np.r_[np.full(15, 1e-3), np.full(15, -1e-3)]
    strong = {parameter: 2.0 * value for parameter, value in e.starts[-1].items()}
    off, on, without = (np.array(simulate(m, command, steps=4, fast=False))
                        for m in (model.with_effects([name]), model.replace(strong), model))
    assert (off == without).all() and np.isfinite(on).all() and (on != without).any()


def speeds(**changes: float) -> tuple[float, float]:
    """The ram's speed forwards at 1000 units of motor speed, and backwards, m/s."""
    xj, _ = replay(build_model(**changes), np.r_[np.full(300, 1000.0), np.full(400, -1000.0)])
    return (xj[290] - xj[190]) / 0.1, (xj[690] - xj[590]) / 0.1


def test_nominal_is_an_integrator_and_unequal_areas_make_it_faster_backwards() -> None:
    """XJ' = D w / AJ."""
    model = load_model("ehs")
    speed = model["pump.displacement"] * 1000.0 / model["jack.area"]
    assert speeds(pump__area_ratio=1.0) == pytest.approx((speed, -speed), rel=1e-6)
    forwards, backwards = speeds(pump__area_ratio=0.68)
    assert -forwards / backwards == pytest.approx(0.68, rel=1e-6)


@pytest.mark.parametrize(("words", "file", "text", "message"), [
    ("run", "none", "", "a sequence of your own"), ("run --bench eha", "none", "", "a sequence of your own"),
    ("simulate --command push.csv", "push.csv", "t,com,load\n0,0,100\n0.001,0,100\n",
     "push.csv: load: expected 0, or a model in which it acts: --set external_load"),
    ("run push.toml", "push.toml", 'title = "Push"\nmain = [{ kind = "hold", time = 0.5 }]\n'
     'load = [{ kind = "step", to = 1000.0, time = 0.2 }]\n',
     "push.toml: load: expected 0, or a model in which it acts: --set external_load")])
def test_a_test_that_it_does_not_declare_and_a_load_that_acts_nowhere_are_refused(
        here: Path, words: str, file: str, text: str, message: str) -> None:
    write_file(here / file, text)
    assert message in refuse(*words.split(), "--model", "ehs")


AJ = Model()["jack.area"]


@pytest.mark.parametrize("changes", [{}, {"spool.static_friction": 45.0}, {"filter.clogging": 0.3},
                                     {"jack.leakage": 2e-11, "jack.mass": 200.0}])
def test_both_close_on_a_simulation(changes: dict[str, float]) -> None:
    """Faults before the spool change nothing in them; faults of the jack are in the model here."""
    model = SILENT.replace(changes)
    run = simulate(model, PREFLIGHT, np.full(len(PREFLIGHT), 300.0))
    x, v = compute_flow_balance(model, run.xs, run.p12, 0.0)
    assert np.abs(run.xj - x).max() < 20e-6  # m, over 13.5 s: straight lines between the samples
    takes, _, dynamic = compute_force_balance(model, run.xj, v, run.p12, run.load)
    is_moving = (np.abs(np.gradient(v, 1e-3)) < 1.0) & (np.abs(v) > 2e-3)
    residual = run.p12 - (takes + np.sign(v) * dynamic) / AJ
    assert np.sqrt(np.mean(residual[is_moving] ** 2)) < 1e4  # Pa: half the transducer's noise


def test_the_laws_of_effects_take_part() -> None:
    """Effects that make P12 a curve of the speed, behind a dead zone: without them the ram is elsewhere."""
    changes = {"orifice_root.share": 1.0, "spool_overlap.overlap": 2e-5, "compressibility.coefficient": 1e-9}
    run = simulate(WHOLE.replace(changes), PREFLIGHT, np.full(len(PREFLIGHT), 2000.0))
    x, _ = compute_flow_balance(SILENT.replace(changes), run.xs, run.p12, 0.0)
    plain, _ = compute_flow_balance(SILENT, run.xs, run.p12, 0.0)
    assert np.sqrt(np.mean((run.xj - x) ** 2)) < 0.05 * np.sqrt(np.mean((run.xj - plain) ** 2))
