"""Bands remember their model, and a grid that contradicts the fit says why."""
from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from noisy_traces import SHORT, record_plant

from fdi.diagnosis.bands import describe_other_model, format_bands, list_design, load_default_bands, parse_bands
from fdi.diagnosis.diagnosis import diagnose
from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate
from fdi.diagnosis.learn_bands import make_bands_by_simulation
from fdi.report.diagnosis_report import explain_grid
from plant import InputError, Model

OTHER = {"jack.mass": 150.0}


def test_faults_and_noise_are_no_other_design() -> None:
    same = {CLOGGING.parameter: 0.2, FRICTION.parameter: 20.0, "spool.dynamic_friction": 10.0,
            "sensors.position_noise": 5e-6}
    assert list_design(Model().replace(same)) == {} and list_design(Model().replace(same | OTHER)) == OTHER


def test_bands_remember_their_model_through_a_file() -> None:
    com = SHORT[:1400]
    model = Model().replace(OTHER)
    made = parse_bands(format_bands(make_bands_by_simulation(model, com, np.zeros_like(com), 1e-3, 8, 8)), "file")
    assert describe_other_model(made, model) == ""
    assert describe_other_model(made, model.replace({CLOGGING.parameter: 0.3})) == ""
    assert describe_other_model(made, Model()) == "the model eha with jack.mass = 150.0"
    assert describe_other_model(made, model.replace({"jack.mass": 151.0})) == "the model eha with jack.mass = 150.0"


def test_bands_of_another_model_are_refused() -> None:
    with pytest.raises(InputError) as refusal:
        diagnose(record_plant(com=SHORT, seed=1), Model().replace(OTHER), load_default_bands())
    words = str(refusal.value)
    assert "--bands" in words and "the model eha with all parameters nominal" in words and "jack.mass = 150;" in words


def diagnosis(kintas: float, explained: bool = True, others: dict[str, Estimate] | None = None) -> Any:
    def point(value: float) -> Any:
        return SimpleNamespace(minimum=SimpleNamespace(kintas=value, fss=5.0, rms=54e-6))

    grid = SimpleNamespace(kintas=np.linspace(0.0, 0.5, 21), fss=np.linspace(0.0, 90.0, 21), step=point(2 * kintas),
                           ramp=point(0.0), joint=point(kintas), merged=SimpleNamespace(kintas=kintas, fss=5.0))
    sizes = {CLOGGING.name: Estimate(0.001, 0.0, 0.02), FRICTION.name: Estimate(5.0, 4.0, 6.0)}
    refinement = SimpleNamespace(errors={"xj": 2e-6}, is_explained=explained)
    return cast(Any, SimpleNamespace(grid=grid, sizes=sizes, others=others or {}, refinement=refinement))


def test_a_grid_that_contradicts_the_fit_says_why() -> None:
    (text,) = explain_grid(diagnosis(0.175, others={"null_bias.current": Estimate(2.4e-4, 2.3e-4, 2.5e-4)}))
    assert text.startswith("The grid gives Kintas 0.175 (minima: steps 0.350, ramps 0), the fit 0.001 (0 .. 0.020)")
    assert "null bias 0.24 mA" in text and "leaves 54 um of the position, the fit 2 um. Trust the fit." in text
    (text,) = explain_grid(diagnosis(0.175, explained=False))
    assert text.endswith("The fit does not explain the trace either.")


def test_a_grid_that_agrees_says_nothing() -> None:
    assert explain_grid(diagnosis(0.05)) == []
