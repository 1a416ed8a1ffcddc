"""One sign of residuals everywhere: measured minus model, on the pages and in the JSON answers."""
from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from noisy_traces import SHORT, record_plant

from fdi.comparison.compare import Comparison, compare
from fdi.estimation.likelihood import Problem
from fdi.estimation.noise import white_noise
from fdi.estimation.replay import prepare_trace
from fdi.report import compare_report, explain_report
from fdi.report.compare_report import build_comparison_report
from fdi.report.report import Figure, Table
from fdi.trace.trace import Trace
from plant import Model

OFFSETS = {"xj": 0.0, "p12": 3e5, "xs": 8e-6}  # of the sensors; XJ is drawn to the measurement, so it has none


@cache
def record_offset() -> Trace:
    """A trace whose sensors of P12 and XS show too much, so that measured minus model is positive."""
    trace = record_plant(com=SHORT, seed=2)
    return replace(trace, p12=trace.p12 + OFFSETS["p12"], xs=trace.xs + OFFSETS["xs"])


@cache
def compare_offset() -> Comparison:
    return compare(record_offset(), Model())


def read_lines(drawing: str) -> list[list[np.ndarray]]:
    """The values of the lines over time of each panel of a figure."""
    return [[np.asarray(line.get_ydata()) for line in ax.lines if len(line.get_ydata()) > 2]
            for ax in vars(drawing)["figure"].axes]


def test_a_comparison_shows_measured_minus_model() -> None:
    found = compare_offset()
    panels = read_lines(compare_report.draw_overview(found))
    scales = {"xj": 1e6, "p12": 1e-5, "xs": 1e6}
    for number, (name, scale) in enumerate(scales.items()):
        (measured, model), (residual,) = panels[1 + 2 * number:3 + 2 * number]  # after Com and XJ
        if name != "xj":  # drawn in mm, its residual in um
            np.testing.assert_allclose(residual, measured - model, atol=1e-9)
            assert np.nanmean(residual) == pytest.approx(OFFSETS[name] * scale, rel=0.1)
    captions = [item.caption for section in build_comparison_report(found).sections for item in section.items
                if isinstance(item, Figure | Table) and "esidual" in item.caption]
    assert captions and all("measured minus model" in text for text in captions[:2])


def test_a_dependence_has_the_sign_of_measured_minus_model() -> None:
    on = next(d for d in compare_offset().diagnoses["xs"].depends)
    assert np.nanmean(on.means) == pytest.approx(OFFSETS["xs"], rel=0.2)


def test_explain_and_add_show_measured_minus_model() -> None:
    trace = prepare_trace(record_offset(), Model())
    problem = Problem(Model(), trace, tuple(white_noise(1e-6) for _ in trace.outputs))
    predicted = problem.predict_outputs([], np.empty((1, 0)))
    misfit = problem.subtract_measurements(predicted)[0]
    fitted = cast(Any, SimpleNamespace(fit=SimpleNamespace(residuals=misfit)))
    drawing = explain_report.draw_change(trace, fitted, fitted, dict.fromkeys(trace.outputs, 1e-6))
    p12 = trace.outputs.index("p12")
    before, after = read_lines(drawing)[1 + p12]
    expected = 1e-5 * (trace.mask_unusable("p12") - predicted[0, p12])
    np.testing.assert_array_equal(before, after)
    assert np.nanmean(before) == pytest.approx(np.nanmean(expected), rel=1e-6)
    assert np.corrcoef(before[1:], expected[1:])[0, 1] > 0.99
