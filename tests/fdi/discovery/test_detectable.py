"""Which effects hide in the tolerances: the decision applied to simulated runs."""
from __future__ import annotations

import numpy as np
import pytest

from fdi.discovery.detectable import Detectable, find_detectable_sizes, find_hidden_effects
from fdi.discovery.significance import compute_sensitivity, find_smallest_visible
from fdi.estimation.fit import fit_unknowns
from fdi.estimation.likelihood import Problem
from fdi.estimation.noise import white_noise
from fdi.estimation.preparation import hold_inputs
from fdi.estimation.unknowns import complete_model, list_all_unknowns, silence_readings
from fdi.trace.trace import Trace
from plant import Model, simulate

EFFECTS = ("constant_load", "filter_clogging", "sensor_offset")


@pytest.fixture(scope="module")
def sizes() -> tuple[dict[str, Detectable], dict[str, float]]:
    """Of a healthy unit, with the sizes of the linear forecast."""
    t = np.arange(4000) * 1e-3
    com = np.where(t < 2.0, 4e-3 * np.sign(np.sin(2 * np.pi * t)), 2e-3 * np.sin(2 * np.pi * 1.5 * t))
    model = Model()
    trace = hold_inputs(Trace.from_columns(simulate(model, com, seed=3)._asdict(), 1e-3, {}))
    noise = tuple(white_noise(x) for x in (2e-6, 2e4, 1e-6))
    problem = Problem(complete_model(model), trace, noise, bare=silence_readings(model), workers=2)
    fit = fit_unknowns(problem, list_all_unknowns(model), rounds=3)
    linear = dict(find_smallest_visible(compute_sensitivity(problem, fit, EFFECTS)))
    assert [d.effect for d in find_hidden_effects(problem, fit, EFFECTS)] == ["sensor_offset"]
    return {d.effect: d for d in find_detectable_sizes(problem, fit, EFFECTS, linear)}, linear


def test_tolerances_make_up_for_a_clogged_filter_and_the_loop_for_an_offset(
        sizes: tuple[dict[str, Detectable], dict[str, float]]) -> None:
    found, linear = sizes
    assert found["filter_clogging"].size > 0.03 > 3.0 * linear["filter_clogging"], found
    assert found["sensor_offset"].size == np.inf and found["sensor_offset"].usual == 2e-4


def test_a_load_shows_where_its_pressure_stands_out_of_the_noise(
        sizes: tuple[dict[str, Detectable], dict[str, float]]) -> None:
    alone = 10.0 * 2e4 / np.sqrt(4000.0) * Model()["jack.area"]  # N: gain 100 if nothing else could move
    assert alone < sizes[0]["constant_load"].size < 20.0 * alone
