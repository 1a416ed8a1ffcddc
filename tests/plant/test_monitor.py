"""The monitoring model: its exact step, the closed forms it has to meet, and how far it is from the reference model."""
from __future__ import annotations

from math import copysign, exp, pi, sqrt

import numpy as np
import pytest

from plant import InputError, Model, simulate
from plant.lanes import Lanes
from plant.monitor import FAULTS, Cell, Monitor, Motion, compute_cells, compute_decay, step_monitor
from rig.sequences import load_sequence

QUIET = Model().replace({f"sensors.{quantity}_noise": 0.0 for quantity in ("position", "pressure", "spool")})
PREFLIGHT = load_sequence("preflight").main_profile().command
STEP = np.r_[np.zeros(20), np.full(300, 1e-3)]
H = QUIET["controller.period"]
KV = 0.069 * 14.5 / (301.6 * 1.35e-5)  # 1/s


def cell(clogging: float = 0.0, friction: float = 5.0, sliding: float = 1.0, h: float = H, **more: float) -> Cell:
    changed = QUIET.replace({name.replace("__", "."): value for name, value in more.items()})
    return Cell(*compute_cells(changed, FAULTS, np.array([[clogging, friction]]), h, sliding)[:, 0].tolist())


def one(com: np.ndarray, clogging: float, friction: float, model: Model = QUIET) -> np.ndarray:
    """XJ, Cor, P12, XS of a closed-loop run, (4, n)."""
    return Monitor(model).closed_loop(np.array([[clogging, friction]]), com, whole=True)[0]


def explicit(s: Motion, current: float, h: float, c: Cell, model: Model, parts: int = 4000) -> Motion:
    """The equations of Fig. 6 in small explicit steps."""
    v = model.values
    xs, xj, vj, dt = s.spool, s.position, s.speed, h / parts
    stuck = True
    for _ in range(parts):
        xf = min(max(c.tilt * current - c.back * xs, -v["flapper.travel"]), v["flapper.travel"])
        stuck = stuck and abs(xf) <= c.dead and xf * s.sliding <= c.slide
        free = 0.0 if stuck else copysign(max(abs(xf) - c.slide, 0.0), xf)
        before, at = vj, xs
        xs = min(max(xs + dt * c.speed * free, -v["spool.travel"]), v["spool.travel"])
        p12 = c.pressure_gain * 0.5 * (at + xs) - c.pressure_slope * vj
        p12 = min(max(p12, -v["supply.pressure"]), v["supply.pressure"])
        vj += dt * (v["jack.area"] * p12 - v["jack.damping"] * vj) / v["jack.mass"]
        xj += dt * 0.5 * (before + vj)
    return Motion(xs, xj, vj, 0.0)


@pytest.mark.parametrize("sliding", [1.0, 2.0 / 3.0, 0.1])
def test_step_is_exact(sliding: float) -> None:
    """Spool stuck, sliding, flapper at its stop and leaving it within the step: all as in small steps."""
    rng = np.random.default_rng(1)
    for _ in range(12):
        clogging, friction = rng.uniform(0.0, 0.5), rng.uniform(0.0, 90.0)
        c = cell(clogging, friction, sliding)
        at = rng.uniform(-3e-4, 3e-4)
        s = Motion(at, 1e-3, c.follow * at, float(rng.integers(-1, 2)))
        current = (c.back * at + rng.uniform(-1.5, 1.5) * c.dead + rng.choice([0.0, 4e-5]) * rng.normal()) / c.tilt
        exact, small = step_monitor(s, current, H, c), explicit(s, current, H, c, QUIET)
        assert exact.spool == pytest.approx(small.spool, abs=2e-9 + 1e-3 * abs(small.spool - s.spool))
        assert exact.position == pytest.approx(small.position, abs=1e-9 + 2e-3 * abs(small.position - s.position))
        assert exact.speed == pytest.approx(small.speed, abs=1e-5 + 2e-3 * abs(small.speed))


def test_pressure_is_limited() -> None:
    """A heavy ram gains no more speed than PSR gives it."""
    c = cell(jack__mass=5e4)
    s = step_monitor(Motion(1e-3, 0.0, 0.0, 0.0), 8e-3, H, c)
    assert s.speed == pytest.approx(QUIET["supply.pressure"] * QUIET["jack.area"] / 5e4 * H, rel=1e-3)
    assert s.position == pytest.approx(0.5 * s.speed * H, rel=1e-3)


def test_one_step_a_cycle_is_enough() -> None:
    values = np.array([[0.0, 5.0], [0.25, 30.0], [0.5, 90.0], [0.17, 45.0]])
    once, often = (Monitor(QUIET, steps=n).closed_loop(values, PREFLIGHT, whole=True) for n in (1, 50))
    worst = np.abs(once - often).max((0, 2))
    assert (worst < [1e-10, 1e-9, 1.0, 1e-10]).all()  # m, A, Pa, m: to rounding


@pytest.mark.parametrize("clogging", [0.0, 0.25, 0.35])
def test_kv_and_the_largest_speed(clogging: float) -> None:
    kv = KV * sqrt(1 - clogging)
    xs = Monitor(QUIET).replay(np.array([[clogging, 0.0]]), np.full(60, 1e-4), whole=True)[0, 3]
    steady = 2.27 * 1e-4 / 14.5
    assert xs[11] == pytest.approx(steady * (1 - exp(-kv * 10e-3)), rel=1e-3)
    xj = Monitor(QUIET).replay(np.array([[clogging, 0.0]]), np.full(200, 8e-3))[0, 0]
    assert (xj[110] - xj[100]) / 10e-3 == pytest.approx(0.25, rel=2e-2)


@pytest.mark.parametrize("clogging", [0.0, 0.35])
def test_ramp_error_does_not_depend_on_clogging(clogging: float) -> None:
    """rate/Kpos; the reference model has FDJ * 5.56e-9 m/N more."""
    kpos = 3.8 * 2.27 * 0.30 / (14.5 * 1.5e-3)
    com = np.arange(3000) * 5e-7
    xj = one(com, clogging, 0.0)[0]
    assert np.mean((com - xj)[2000:]) == pytest.approx(5e-4 / kpos, rel=1e-3)


def test_breakaway_and_hysteresis() -> None:
    friction, clogging = 40.0, 0.2
    force = 6.59e11 * (1 - clogging) * 1.35e-5
    asked = friction * 301.6 / (force * 2.27 * 3.8)
    assert asked == pytest.approx(3.9e-6 * friction / (1 - clogging), rel=0.02)
    com = np.arange(3000) * 1e-7
    xs = one(com, clogging, friction)[3]
    assert com[np.flatnonzero(xs)[0]] == pytest.approx(asked, abs=3e-7)
    current = 4e-3 * np.abs((np.arange(40000) / 20000.0) % 2 - 1.0)  # slowly down and up
    xs = Monitor(QUIET).replay(np.array([[clogging, friction]]), np.r_[np.full(500, 4e-3), current], whole=True)[0, 3]
    down, up = xs[500 + 10000], xs[500 + 30000]  # the same current on both ways
    assert down - up == pytest.approx(2 * friction * 301.6 / (force * 14.5), rel=5e-3)


@pytest.mark.parametrize("clogging", [0.0, 0.1, 0.25, 0.35])
def test_overshoot_of_the_continuous_loop(clogging: float) -> None:
    """s^2/Kv + s + Kpos: a second-order loop, as the flapper is static; sampled fast enough to be continuous."""
    fast = QUIET.replace({"controller.period": 1e-4, "controller.proportional_gain": 3.8 * 100 / 118.97})
    xj = one(np.full(3000, 1e-4), clogging, 0.0, fast)[0]
    damping = 0.5 * sqrt(KV * sqrt(1 - clogging) / 100.0)
    delayed = 0.5 * sqrt(KV * sqrt(1 - clogging) / 100.0) * (1 - 1.5e-4 * 100.0)  # by 1.5 cycles
    low, high = (exp(-pi * z / sqrt(1 - z * z)) for z in (damping, delayed))
    assert low - 1e-3 < xj.max() / 1e-4 - 1 < high + 4e-3


@pytest.mark.parametrize(("clogging", "friction"), [(0.0, 5.0), (0.25, 30.0), (0.17, 45.0)])
def test_is_the_reference_model_without_what_it_leaves_out(clogging: float, friction: float) -> None:
    """The reference with a light, undamped flapper and spool and a jack without friction and leakage is the monitor."""
    current = simulate(QUIET.replace({FAULTS[0]: clogging, FAULTS[1]: friction}), PREFLIGHT[:4000]).cor
    light = QUIET.replace({
        "flapper.inertia": 1e-8, "flapper.damping": 1e-3, "spool.mass": 1e-6, "spool.damping": 0.0,
        "jack.static_friction": 0.0, "jack.dynamic_friction": 0.0, "jack.leakage": 0.0, FAULTS[0]: clogging,
        FAULTS[1]: friction, "spool.dynamic_friction": 2.0 / 3.0 * friction})
    reference = Lanes(light, (), 400).replay(np.empty((1, 0)), current, np.zeros(4000))[0]
    ours = Monitor(QUIET, sliding=2.0 / 3.0).replay(np.array([[clogging, friction]]), current, whole=True)[0]
    apart = np.abs(ours[3] - reference[:, 2])
    assert apart[:600].max() < 2e-6  # the spool moves 122 um in a cycle; the light flapper takes 5 us to its stop
    assert np.median(apart) < 0.1e-6  # after that a break-away may fall on a knife's edge
    assert np.abs(ours[0] - reference[:, 0])[:600].max() < 2e-6


def test_decay_is_the_exponential() -> None:
    for x in np.linspace(-1.0, 0.0, 41):
        assert compute_decay(x) == pytest.approx(exp(x), rel=1e-10 if x < -0.25 else 1e-15)


def test_a_fast_pilot_takes_more_steps() -> None:
    fast = QUIET.replace({"pilot.flow_gain": 40 * 0.069})  # Kv 10 a cycle
    values = np.array([[0.0, 5.0], [0.3, 60.0]])
    once, often = (Monitor(fast, steps=n).replay(values, 1e-3 * np.sin(np.arange(300)), whole=True) for n in (1, 200))
    assert np.abs(once - often)[:, 3].max() < 1e-11


def test_side_by_side_is_alone() -> None:
    values = np.random.default_rng(0).uniform([0.0, 0.0], [0.5, 90.0], (71, 2))  # not a whole block
    runs = Monitor(QUIET).closed_loop(values, STEP, whole=True)
    for row in (0, 7, 64, 70):
        assert (runs[row] == one(STEP, *values[row])).all()
    assert (Monitor(QUIET).closed_loop(values, STEP)[:, 0] == runs[:, 0]).all()


def test_compiled_is_interpreted() -> None:
    c, s, current = cell(0.25, 30.0), Motion(0.0, 0.0, 0.0, 0.0), 4e-4
    runs = Monitor(QUIET).replay(np.array([[0.25, 30.0]]), np.full(30, current), whole=True)[0]
    s = step_monitor(s, 0.0, H, c)
    for k in range(1, 30):
        assert runs[0, k] == pytest.approx(s.position, abs=1e-18) and runs[3, k] == pytest.approx(s.spool, rel=1e-13)
        s = step_monitor(s, current, H, c)


def test_replay_follows_the_measured_ram() -> None:
    """Anchored, the ram stays near the measured one, over missing samples too; free, it drifts away."""
    run = simulate(Model().replace({FAULTS[1]: 30.0}), PREFLIGHT[:6000])
    seen = run.xj + 1e-3
    seen[100:200] = np.nan
    monitor, values = Monitor(QUIET), np.array([[0.4, 5.0]])
    free, held = (monitor.replay(values, run.cor, seen, anchor)[0, 0] - seen for anchor in (0.0, 20.0))
    assert abs(held[0]) < 1e-9
    assert np.abs(held[-1000:]).max() < 0.5 * np.abs(free[-1000:]).max() and not np.isnan(free).all()


@pytest.mark.parametrize(("names", "values", "word"), [
    (("filter.clogging", "no.such"), np.zeros((1, 2)), "no.such"), (("controller.period",), np.ones((1, 1)), "period"),
    (FAULTS, np.zeros((1, 3)), "values"), (FAULTS, np.zeros(2), "values")])
def test_refusals(names: tuple[str, ...], values: np.ndarray, word: str) -> None:
    with pytest.raises(InputError, match=word):
        Monitor(QUIET, names).closed_loop(values, STEP)
    with pytest.raises(InputError, match="position"):
        Monitor(QUIET).replay(np.zeros((1, 2)), STEP, STEP[:7])
