"""Fits: last rounds, flat directions, a search by a population, and rows that hang on a level of friction."""

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from noisy_traces import record_plant

from fdi.discovery.search import Search, scan_effects
from fdi.discovery.update_model import refit_effects
from fdi.estimation.fit import (
    Fit,
    Problem,
    complete_model,
    linearise,
    list_all_unknowns,
)
from fdi.estimation.noise import white_noise
from fdi.estimation.replay import (
    compute_residuals,
    find_rest_rows,
    find_undecided_rows,
    hold_inputs,
    replay_current,
)
from fdi.estimation.unidentifiable import (
    FLAPPER,
    JACK_PRESSURE,
    POSITION_SCALE,
    SPOOL_WAY,
    VISCOSITY,
    find_tangents,
)
from fdi.trace.trace import Floats, Trace, rms
from plant import Model, load_model, simulate
from plant.declare import Chirp, Hold, Ramp, Step
from plant.segments import build_profile

T = 1e-3 * np.arange(1500)
GENTLE = 5e-4 * np.sin(2.0 * np.pi * 1.5 * T) * (1.0 - np.exp(-5.0 * T))  # m, neither flapper nor spool stops
FAST = np.where(T > 0.2, 5e-3, 0.0)  # m, both do


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
    gentle, fast = find_flat({}, "xj"), find_flat({"torque_motor.gain": 2.5}, "xj", FAST)
    assert [way in found for found in (gentle, fast) for way in (FLAPPER, SPOOL_WAY)] == [True, True, False, False]


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


FLOOR = {"xj": 2e-6, "p12": 2e4, "xs": 1e-6}


def _find(changes: dict[str, float], com: np.ndarray) -> np.ndarray:
    model = complete_model(Model()).replace(changes)
    trace = hold_inputs(record_plant(changes, com, seed=1))
    problem = Problem(model, trace, tuple(white_noise(FLOOR[s]) for s in trace.outputs), steps=20)
    return find_undecided_rows(problem, cast(Fit, cast(Any, SimpleNamespace(free=(), values={}))), FLOOR)


def test_slips_on_soft_oil_are_undecided_and_a_step_is_not() -> None:
    ramp = np.concatenate([np.zeros(200), np.linspace(0.0, 1.5e-3, 2500)])  # 0.6 mm/s
    soft = _find({"compressibility.coefficient": 1.0 / 4e8, "jack.static_friction": 1600.0}, ramp)
    assert soft.mean() > 0.2 and not soft[:200].any()
    assert not _find({}, np.repeat([0.0, 3e-3], [200, 800])).any()


def _record_motor(changes: Mapping[str, float], step: float = 0.0) -> Trace:
    """A ramp and a chirp of an `ema`, the position in steps; the motor's speed has its noise."""
    unit = load_model("ema").replace(dict(changes))
    command = build_profile([Hold(time=0.3), Ramp(to=0.01, time=1.0), Hold(time=0.3),
                             Chirp(amplitude=1e-3, f0=1.0, f1=20.0, fade=20.0, time=2.0)], rate=1000.0).command
    unit = unit.replace({"sensors.position_noise": 0.0} if step else {})
    columns = simulate(unit, command, seed=3, steps=100)._asdict()
    columns["position"] = step * np.round(columns["position"] / step) if step else columns["position"]
    return hold_inputs(Trace.from_columns(columns, 1e-3, {}, unit.kind.signals))


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
    columns = simulate(model.replace({"screw.backlash": 1e-4}), command, seed=3)._asdict()
    trace = hold_inputs(Trace.from_columns(columns, 1e-3, {}, model.kind.signals))
    search = Search(model, trace, [], ["backlash"], 1)
    assert 200 <= search.problem.trace.usable.sum() < 0.3 * len(trace)
    healthy = linearise(search.problem, list_all_unknowns(search.model), np.zeros(4))
    found = scan_effects(search.problem, [healthy], ["backlash"])[0]
    u = [f.name for f in found.free].index("screw.backlash")
    assert found.free[u].centre + found.free[u].scale * found.x[u] == pytest.approx(1e-4, rel=0.3)  # else a tenth of it


def test_error_that_is_watched_while_a_backlash_is_added_falls_to_the_noise() -> None:
    found = refit_effects(load_model("ema"), ["backlash"], _record_motor({"screw.backlash": 1e-4}))
    assert max(found.last.error[s] / found.floor[s] for s in found.floor) < 1.3
    assert found.last.hypothesis.fit.values["screw.backlash"] == pytest.approx(1e-4, rel=0.05)


def test_a_rest_hangs_on_stops_and_a_reversal_does_not() -> None:
    t = np.arange(0.0, 3.0, 1e-3)
    x = np.where(t < 1.0, 0.0, 3e-3 * np.sin(2.0 * np.pi * np.clip(t - 1.0, 0.0, 1.5)))  # rests, two reversals, rests
    noise = 1e-6 * np.random.default_rng(0).standard_normal(len(t))
    x = x + noise
    x[500:520] = np.nan
    rest = find_rest_rows(x, 1e-3, 1e-6)
    assert rest[:1150].all() and not rest[1300:2490].any() and rest[2550:].all()  # and until a replay has forgotten it
