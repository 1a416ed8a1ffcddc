"""Which effects hide in the tolerances: the decision applied to simulated runs."""
from __future__ import annotations

import numpy as np
import pytest

from fdi.discovery.detectable import Detectable, find_detectable_sizes, find_hidden_effects, find_least_gains
from fdi.estimation.fit import fit_unknowns
from fdi.estimation.likelihood import Problem
from fdi.estimation.noise import white_noise
from fdi.estimation.replay import hold_inputs
from fdi.estimation.unknowns import complete_model, list_all_unknowns, silence_readings
from fdi.trace.trace import Trace
from plant import Model, simulate

EFFECTS = ("constant_load", "filter_clogging", "sensor_offset")


@pytest.fixture(scope="module")
def sizes() -> dict[str, Detectable]:
    """Of a healthy unit."""
    t = np.arange(4000) * 1e-3
    com = np.where(t < 2.0, 4e-3 * np.sign(np.sin(2 * np.pi * t)), 2e-3 * np.sin(2 * np.pi * 1.5 * t))
    model = Model()
    trace = hold_inputs(Trace.from_columns(simulate(model, com, seed=3)._asdict(), 1e-3, {}))
    noise = tuple(white_noise(x) for x in (2e-6, 2e4, 1e-6))
    problem = Problem(complete_model(model), trace, noise, bare=silence_readings(model), workers=2)
    fit = fit_unknowns(problem, list_all_unknowns(model), rounds=3)
    assert [d.effect for d in find_hidden_effects(problem, fit, EFFECTS)] == ["sensor_offset"]
    return {d.effect: d for d in find_detectable_sizes(problem, fit, EFFECTS)}


def test_tolerances_make_up_for_a_clogged_filter_and_the_loop_for_an_offset(sizes: dict[str, Detectable]) -> None:
    """Were the tolerances held, a clogging of 0.001 would show."""
    assert sizes["filter_clogging"].size > 0.03, sizes
    assert sizes["sensor_offset"].size == np.inf and sizes["sensor_offset"].usual == 2e-4


def test_a_load_shows_where_its_pressure_stands_out_of_the_noise(sizes: dict[str, Detectable]) -> None:
    alone = 10.0 * 2e4 / np.sqrt(4000.0) * Model()["jack.area"]  # N: gain 100 if nothing else could move
    assert alone < sizes["constant_load"].size < 20.0 * alone


def test_a_failed_fit_to_a_small_size_makes_no_small_size_visible() -> None:
    """What tolerances make up for at a size of 3 they make up for at 2."""
    assert find_least_gains([(1.0, 2.0), (3.0, 40.0), (2.0, 500.0), (4.0, 900.0)]) == [
        (1.0, 2.0), (2.0, 40.0), (3.0, 40.0), (4.0, 900.0)]
