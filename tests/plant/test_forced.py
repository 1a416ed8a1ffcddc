"""The jack's two balances: what is put in and what must come out, in closed form and against whole simulations."""
from __future__ import annotations

import numpy as np
import pytest
from physics_cases import PREFLIGHT, SILENT

from plant import Model, simulate
from plant.forced import compute_flow_balance, compute_force_balance

P = Model().values
GQ, GP, AJ = P["valve.flow_gain"], P["valve.pressure_gain"], P["jack.area"]


def test_flow_of_a_constant_opening_and_pressure() -> None:
    """AJ v = GQ (XS - P12/GP) - CLK P12, for as long as it is open."""
    xs, p12 = np.full(500, 1e-4), np.full(500, 3e6)
    model = SILENT.replace({"jack.leakage": 2e-11})
    x, v = compute_flow_balance(model, xs, p12, 1e-3)
    speed = (GQ * (1e-4 - 3e6 / GP) - 2e-11 * 3e6) / AJ
    assert v == pytest.approx(np.full(500, speed), rel=1e-9)
    assert x == pytest.approx(1e-3 + speed * 1e-3 * np.arange(500), rel=1e-9)


def test_force_of_a_given_motion() -> None:
    """MJ a + CJ v + FR, and the friction levels beside it."""
    t = np.arange(400) * 1e-3
    x, v, a = 0.5 * 2.0 * t**2, 2.0 * t, 2.0
    takes, static, dynamic = compute_force_balance(SILENT, x, v, np.zeros(400), np.full(400, 500.0))
    expected = P["jack.mass"] * a + P["jack.damping"] * v + 500.0
    assert takes == pytest.approx(expected, rel=1e-9)
    assert set(static) == {P["jack.static_friction"]} and set(dynamic) == {P["jack.dynamic_friction"]}


@pytest.mark.parametrize("changes", [{}, {"spool.static_friction": 45.0}, {"filter.clogging": 0.3},
                                     {"jack.leakage": 2e-11, "jack.mass": 200.0}])
def test_both_close_on_a_simulation(changes: dict[str, float]) -> None:
    """Faults before the spool change nothing in them; faults of the jack are in the model here."""
    model = SILENT.replace(changes)
    run = simulate(model, PREFLIGHT, np.full(len(PREFLIGHT), 300.0))
    x, v = compute_flow_balance(model, run.xs, run.p12, 0.0)
    assert np.abs(run.xj - x).max() < 20e-6  # m, over 13.5 s: straight lines between the samples
    takes, _, dynamic = compute_force_balance(model, run.xj, v, run.p12, run.load)
    steady = np.abs(np.gradient(v, 1e-3)) < 1.0
    moving = steady & (np.abs(v) > 2e-3)
    left = run.p12 - (takes + np.sign(v) * dynamic) / AJ
    assert np.sqrt(np.mean(left[moving] ** 2)) < 1e4  # Pa: half the transducer's noise


@pytest.mark.parametrize("changes", [{"orifice_root.share": 1.0, "spool_overlap.overlap": 2e-5},
                                     {"compressibility.coefficient": 1e-9}])
def test_the_laws_of_effects_take_part(changes: dict[str, float]) -> None:
    """An effect that makes P12 a curve of the speed, behind a dead zone: without them the ram is elsewhere."""
    model = SILENT.replace(changes)
    run = simulate(model, PREFLIGHT, np.full(len(PREFLIGHT), 2000.0))
    x, _ = compute_flow_balance(model, run.xs, run.p12, 0.0)
    plain, _ = compute_flow_balance(SILENT, run.xs, run.p12, 0.0)
    assert np.sqrt(np.mean((run.xj - x) ** 2)) < 0.05 * np.sqrt(np.mean((run.xj - plain) ** 2))
