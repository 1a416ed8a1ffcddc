"""Flat directions: which trial replays confirm them."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from noisy_traces import record_plant

from fdi.discovery.search import Search
from fdi.estimation.replay import hold_inputs
from fdi.estimation.unidentifiable import (
    FLAPPER,
    JACK_PRESSURE,
    POSITION_SCALE,
    SPOOL_WAY,
    TRIED,
    TRIED_SHARES,
    VISCOSITY,
    confirm_flat,
    find_tangents,
)
from fdi.estimation.unknowns import list_all_unknowns
from fdi.trace.trace import Flags, Floats
from plant import load_model


class SteppedResiduals:
    """Residuals (m, 1, 2) that a second unknown moves, and that jump once the first one passes 0.005."""

    def compute_white_residuals(self, free: object, x: Floats) -> Floats:
        """Whitened residuals of scaled unknowns (m, 2)."""
        return np.stack([10.0 * (x[:, 0] > 0.005), 1e5 * x[:, 1]], axis=-1)[:, None, :]


def confirm(is_tried: Flags) -> list[bool]:
    """`confirm_flat` along both unknowns, with a misfit of one allowed."""
    trials = np.array([TRIED * share * np.eye(2) for share in TRIED_SHARES])
    problem = cast(Any, SteppedResiduals())
    return [bool(flat) for flat in confirm_flat(problem, (), np.zeros(2), trials, is_tried, 1.0)]


def test_a_jump_in_one_trial_does_not_hide_a_flat_direction() -> None:
    assert confirm(np.ones((4, 2), bool)) == [True, False]


def test_a_direction_whose_only_trials_jump_or_are_stopped_by_a_bound_is_not_confirmed() -> None:
    is_tried = np.zeros((4, 2), bool)
    assert confirm(is_tried) == [False, False]
    is_tried[0] = True  # the full length forwards, where the jump is
    assert confirm(is_tried) == [False, False]


def test_each_direction_may_have_its_own_limit() -> None:
    problem, trials = cast(Any, SteppedResiduals()), np.array([TRIED * share * np.eye(2) for share in TRIED_SHARES])
    limits = np.array([1.0, 2.1e6])
    assert confirm_flat(problem, (), np.zeros(2), trials, np.ones((4, 2), bool), limits).tolist() == [True, True]
    assert confirm_flat(problem, (), np.zeros(2), trials, np.ones((4, 2), bool), limits[::-1]).tolist() == [True, False]


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
    for changes in ({}, EFFECTS):
        assert direction in find_flat(changes, others)
    assert direction not in find_flat({}, "xj,p12,xs")


def test_a_known_load_does_not_show_the_pressure_but_the_area() -> None:
    flat = find_flat({}, "xj,xs", load=5e3)
    assert JACK_PRESSURE in flat and not any("jack.mass" in powers for powers in flat)


def test_a_stop_shows_how_far_flapper_and_spool_move() -> None:
    gentle, fast = find_flat({}, "xj"), find_flat({"torque_motor.gain": 2.5}, "xj", FAST)
    assert FLAPPER in gentle and SPOOL_WAY in gentle
    assert FLAPPER not in fast and SPOOL_WAY not in fast


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
