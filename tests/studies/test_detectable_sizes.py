"""Sizes are hidden as they were claimed, and the study finds what it should."""

from pathlib import Path

import numpy as np
import pytest

from fdi.discovery.detectable import find_hidden_effects
from fdi.estimation.fit import Problem, complete_model, fit_unknowns, list_all_unknowns, silence_readings
from fdi.estimation.noise import white_noise
from fdi.estimation.replay import hold_inputs
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.effects import CATALOGUE
from studies import detectable_sizes
from studies.hidden_effects.hidden import NOT_SIMULATED
from studies.hidden_effects.truth import parameter_names


@pytest.mark.parametrize("effect", detectable_sizes.EFFECTS)
def test_the_hidden_size_is_the_claimed_one_in_the_unit_of_the_fit(effect: str) -> None:
    first = CATALOGUE[effect].fitted[0]
    off = CATALOGUE[effect].off.get(first, Model().kind.nominal.get(first, 0.0))
    size = 0.3 * min(abs(start[first] - off) for start in CATALOGUE[effect].starts)
    healthy = detectable_sizes.sample_healthy_case(1, effect)
    (hidden,) = detectable_sizes.hide_effect(healthy, effect, size).effects
    assert hidden.value == pytest.approx(off + size)
    shown = {"jack_friction": "FSJ", "viscous_drag": "CJ", "moving_mass": "MJ", "spool_friction": "FSS",
             "constant_load": "force", "filter_clogging": "Kintas"}
    if effect in shown:
        assert hidden.changes[shown[effect]] == pytest.approx(off + size)
    assert set(hidden.changes) - set(NOT_SIMULATED) <= set(parameter_names())


def test_the_table_counts_by_effect_and_size() -> None:
    rows = [{"effect": "null_bias", "factor": 1.5, "claimed": 1e-6, "found": True},
            {"effect": "null_bias", "factor": 1.5, "claimed": 2e-6, "found": False},
            {"effect": "null_bias", "factor": 0.5, "claimed": 1e-6, "found": False},
            {"effect": "sensor_gain", "factor": 1.5, "claimed": None, "found": None}]
    table = detectable_sizes.format_table(rows).splitlines()
    assert table[2] == "| `null_bias` | 1e-06 to 2e-06 A | 1 of 2 | 0 of 1 |"
    assert table[3] == "| `sensor_gain` | none | 0 of 0 | 0 of 0 |"


def test_tolerances_make_up_for_an_offset_of_any_usual_size_and_not_for_a_load() -> None:
    """A load shows by its pressure; the loop moves the ram by what its transducer is off."""
    t = np.arange(4000) * 1e-3
    com = np.where(t < 2.0, 4e-3 * np.sign(np.sin(2 * np.pi * t)), 2e-3 * np.sin(2 * np.pi * 1.5 * t))
    model, effects = Model(), ("constant_load", "filter_clogging", "sensor_offset")
    trace = hold_inputs(Trace.from_columns(simulate(model, com, seed=3)._asdict(), 1e-3, {}))
    noise = tuple(white_noise(x) for x in (2e-6, 2e4, 1e-6))
    problem = Problem(complete_model(model), trace, noise, bare=silence_readings(model), workers=2)
    fit = fit_unknowns(problem, list_all_unknowns(model), rounds=3)
    assert [(h.effect, h.usual) for h in find_hidden_effects(problem, fit, effects)] == [("sensor_offset", 2e-4)]


@pytest.mark.slow
def test_claims_hold(tmp_path: Path) -> None:
    """About an hour for each effect."""
    effects = ("null_bias", "constant_load")
    rows = detectable_sizes.run_study(4 * len(effects), tmp_path, effects=effects)
    large = [row["found"] for row in rows if row["factor"] > 1.0 and row["found"] is not None]
    small = [row["found"] for row in rows if row["factor"] < 1.0 and row["found"] is not None]
    assert sum(large) >= 0.9 * len(large) and sum(small) <= 0.5 * len(small)
