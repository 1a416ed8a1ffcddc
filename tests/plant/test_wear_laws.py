"""Wear of the servovalve: each law against the closed form of its source."""

import numpy as np
import pytest
from effects_cases import drive_plant, measure_spool
from physics_cases import SMOOTH

from plant import Model
from plant.effects import CATALOGUE
from plant.effects.wear import Flux, coil_short, edge_rounding, land_clearance, nozzle_block
from plant.eha import State, compute_coefficients
from plant.state import Input, Line

WEAR = ("magnet_loss", "coil_short", "nozzle_block", "land_clearance", "edge_rounding")


def build(name: str, value: float) -> tuple[Model, object, Line]:
    """A model with that value, its parameters, and the metering line of a spool that is 20 um open."""
    model = Model().replace({name: value})
    p = model.build_record()[0]
    k = compute_coefficients(p, 1e-5)
    drive = k.valve_gain * 2e-5
    return model, p, Line(drive, k.valve_slope, k.valve_limit, drive)


def test_explain_does_not_search_them_and_each_has_a_source() -> None:
    assert not set(WEAR) & set(CATALOGUE)
    assert all(CATALOGUE[name].source and CATALOGUE[name].revealed_by for name in WEAR)


def test_a_weaker_magnet_moves_the_spool_by_less() -> None:
    xs = drive_plant(SMOOTH.replace({"magnet_loss.share": 0.3}), np.full(100, 1e-3), fast=False, steps=20)[1][2]
    assert xs[-1] == pytest.approx(measure_spool(SMOOTH, 0.7e-3), rel=1e-3)


def test_shorted_turns_lose_gain_and_lag_by_their_share_of_the_time_constant() -> None:
    _, p, _ = build("coil_short.share", 0.2)
    h, memory, out = 1e-6, Flux(), []
    for _ in range(4000):
        y, memory = coil_short(1e-3, memory, State(), Input(h=h), p)
        out.append(y)
    t = h * np.arange(1, 4001)
    assert np.allclose(out, 0.8e-3 * (1.0 - np.exp(-t / 0.6e-3)), atol=2e-6)


@pytest.mark.parametrize("b", [0.3, -0.3, 1.0])
def test_a_blocked_nozzle_is_half_the_difference_of_the_openings(b: float) -> None:
    model, p, _ = build("nozzle_block.share", b)
    most = model["flapper.travel"]
    for x in (-1e-5, 0.0, 2e-5):
        left, right = (most + x) * (1.0 + min(b, 0.0)), (most - x) * (1.0 - max(b, 0.0))
        assert nozzle_block(x, State(), Input(), p) == pytest.approx(0.5 * (left - right), abs=1e-18)


@pytest.mark.parametrize("speed", [0.0, 0.05])
def test_worn_lands_leak_in_proportion_to_the_pressure(speed: float) -> None:
    """GQ XS - GQ/GP P12 = AJ v + (CLK + K) P12 with K = w (c^3 - c0^3)/(12 mu L)."""
    model, p, line = build("land_clearance.clearance", 3e-5)
    worn = land_clearance(line, State(), Input(), p)
    pressure = worn.offset - worn.slope * speed
    leak = 0.013 * (3e-5**3 - 6e-6**3) / (12.0 * 0.015 * 1e-3)
    gq, gp = model["valve.flow_gain"], model["valve.pressure_gain"]
    needed = model["jack.area"] * speed + (model["jack.leakage"] + leak + gq / gp) * pressure
    assert needed == pytest.approx(gq * 2e-5, rel=1e-9)


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
