"""Which rows of a run hang on a thousandth of a friction level."""
from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Problem
from fdi.estimation.noise import white_noise
from fdi.estimation.replay import find_undecided_rows, hold_inputs
from fdi.trace.trace import Trace
from plant import Model, simulate

FLOOR = {"xj": 2e-6, "p12": 2e4, "xs": 1e-6}


def _find(changes: dict[str, float], com: np.ndarray) -> np.ndarray:
    model = Model().with_effects(["compressibility"]).replace(changes)
    trace = hold_inputs(Trace.from_columns(simulate(model, com, seed=1)._asdict(), 1e-3, {}))
    problem = Problem(model, trace, tuple(white_noise(FLOOR[s]) for s in trace.outputs), steps=20)
    return find_undecided_rows(problem, cast(Fit, cast(Any, SimpleNamespace(free=(), values={}))), FLOOR)


def test_slips_on_soft_oil_are_undecided_and_a_step_is_not() -> None:
    ramp = np.concatenate([np.zeros(200), np.linspace(0.0, 1.5e-3, 2500)])  # 0.6 mm/s
    soft = _find({"compressibility.coefficient": 1.0 / 4e8, "jack.static_friction": 1600.0}, ramp)
    assert soft.mean() > 0.2 and not soft[:200].any()
    step = np.concatenate([np.zeros(200), np.full(800, 3e-3)])
    assert not _find({}, step).any()
