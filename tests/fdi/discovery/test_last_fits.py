"""Last fits of a search: which are begun again, from where."""
from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from noisy_traces import record_plant

from fdi import thresholds
from fdi.discovery.explain import Marks, decide_verdict, shows_effect
from fdi.discovery.search import Hypothesis, Search
from fdi.estimation.fit import linearise
from fdi.estimation.likelihood import Free
from fdi.estimation.replay import hold_inputs
from fdi.estimation.unknowns import list_all_unknowns
from plant import load_model

T = 1e-3 * np.arange(1000)
COMMAND = 5e-4 * np.sin(2.0 * np.pi * 2.0 * T) * (1.0 - np.exp(-5.0 * T))  # m
BIAS = {"null_bias.current": 1e-4}


@pytest.fixture(scope="module")
def search() -> Search:
    """A run with a null bias, whose unknowns are the tolerances and this bias."""
    found = Search(load_model().replace(BIAS), hold_inputs(record_plant(BIAS, COMMAND)), [], [], 1)
    found.problem = replace(found.problem, bare=None)
    return found


def start_off(free: tuple[Free, ...], tolerances: float) -> np.ndarray:
    """The true bias, with the jack's mass and damping so many tolerances from nominal, (p,)."""
    return np.array([tolerances if f.name in ("jack.mass", "jack.damping") else 0.0 for f in free])


def test_a_fit_far_from_a_healthy_unit_is_begun_again(search: Search) -> None:
    free = list_all_unknowns(search.model)
    far = search.judge_fit(("null_bias",), linearise(search.problem, free, start_off(free, 4.9)))
    assert far.is_far
    again = search.begin_again(far)
    assert again.cost < far.cost and not again.is_far
    assert again.fit.values["null_bias.current"] == pytest.approx(1e-4, rel=0.05)


def test_a_fit_that_leaves_noise_near_a_healthy_unit_stays(search: Search) -> None:
    free = list_all_unknowns(search.model)
    near = search.judge_fit(("null_bias",), linearise(search.problem, free, start_off(free, 0.0)))
    assert not near.is_far and not near.is_poor
    assert search.begin_again(near) is near


def test_an_effect_counts_only_if_its_interval_leaves_out_the_off_value(search: Search) -> None:
    """Of a null bias of 100 uA: its own size does, a hundredth of its standard deviation does not."""
    free = list_all_unknowns(search.model)
    place = [f.name for f in free].index("null_bias.current")
    found = linearise(search.problem, free, np.zeros(len(free)))

    def move_bias(current: float) -> Hypothesis:
        x = np.where(np.arange(len(free)) == place, (current - free[place].centre) / free[place].scale, found.x)
        return search.judge_fit(("null_bias",), replace(found, x=x))

    small = 0.01 * found.spread("null_bias.current")
    assert [shows_effect(load_model(), move_bias(current)) for current in (1e-4, small)] == [True, False]


@pytest.mark.parametrize(("is_far", "verdict"), [(False, "EXPLAINED"), (True, "PARTLY")])
def test_an_explanation_that_needs_tolerances_of_no_healthy_unit_is_doubted(is_far: bool, verdict: str) -> None:
    """A lag of the pilot pressure, which is not in the catalogue, was called a coil lag with clogging, EXPLAINED."""
    def make(effects: tuple[str, ...], cost: float, is_far: bool) -> Hypothesis:
        return cast(Any, SimpleNamespace(effects=effects, cost=cost, repeat_cost=cost, tolerance_cost=10.0, others=(),
                                         is_at_floor=bool(effects), is_far=is_far))

    base, best = make((), 9000.0, False), make(("coil_lag", "filter_clogging"), 1000.0, is_far)
    found = decide_verdict(base, [best], [best], True, Marks(1.0, 1e-6, ()), {"xj": 2e-6})
    assert found == (verdict, ("coil_lag", "filter_clogging"))


def test_the_page_shows_the_decision_procedure_of_the_code() -> None:
    stages = [line for line in str(import_module("fdi.discovery.explain").__doc__).splitlines() if line[:1] == "|"]
    table = "\n".join(stages).format(**vars(thresholds))
    assert len(stages) > 20 and table in (Path(__file__).parents[3] / "docs/explain.md").read_text()
