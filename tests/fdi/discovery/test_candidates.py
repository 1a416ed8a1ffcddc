"""What is told of an explanation: each set of effects once, sizes within what is possible."""
from __future__ import annotations

from typing import Any, cast

import numpy as np

from fdi.discovery.explain_runs import Answer, Candidate, list_fitted_parameters
from fdi.estimation.fit import Fit, Value
from fdi.estimation.likelihood import Free
from plant import Model


def candidate(effect: str, *beside: str) -> Candidate:
    return Candidate(effect, beside, {f"{effect}.size": Value(1.0, 0.9, 1.1, "N")}, {}, {}, {}, 0.0, 0.0, "explains")


def test_a_pair_is_shown_once_with_the_sizes_of_both() -> None:
    both = (candidate("a", "b"), candidate("b", "a"), candidate("c", "a"), candidate("d"))
    shown = Answer(cast(Any, None), both, {}, (), (), (), ()).explanations
    assert [(c.effect, c.beside) for c in shown] == [("a", ("b",)), ("c", ("a",)), ("d", ())]
    assert set(shown[0].parameters) == {"a.size", "b.size"} and set(both[0].parameters) == {"a.size"}


def test_dynamic_friction_is_not_thought_possible_above_static_friction() -> None:
    """A fit that cannot tell it, 500 N give or take 8000, says so up to the static friction's own bound."""
    free = tuple(Free(f"jack.{kind}_friction", 500.0, 100.0, np.inf, 0.0, 1e5, 0.05) for kind in ("static", "dynamic"))
    none = np.empty((0, 0))
    fit = Fit(free, np.array([0.0, -0.1]), 0.0, 0.0, np.diag([0.01, 1600.0]), none, none, none)
    found = list_fitted_parameters("jack_friction", fit, Model())
    static, dynamic = found["jack.static_friction"], found["jack.dynamic_friction"]
    assert 500.0 < static.high < 600.0 and dynamic.value == 490.0
    assert dynamic.low == 0.0 and dynamic.high == static.high
