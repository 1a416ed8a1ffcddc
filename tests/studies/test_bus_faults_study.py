"""The matrix of faults on the bus in small: two faults, all phases, and what the report says about them."""

import pytest

from fdi.report.report import render_html
from studies.bus_faults import (
    FAULTS,
    PHASES,
    build_bus_faults_report,
    collect_figures,
    study_bus_faults,
)

LOST, TOLERATED = FAULTS[0], FAULTS[5]


def test_the_figures_of_two_faults() -> None:
    cells = study_bus_faults(1, (LOST, TOLERATED))
    assert [cell.phase for cell in cells] == [*PHASES] * 2 and all(cell.passed for cell in cells)
    for cell in cells[:4]:
        times = (cell.activation_ms, cell.detection_ms, cell.reaction_ms, cell.recovery_ms)
        assert times == pytest.approx((0, 3, 3, 1))
        assert "0x8250" in cell.detected_by
    for cell in cells[4:]:  # the plant flags the missing frame at the next SYNC
        assert cell.activation_ms == pytest.approx(1) and cell.detection_ms is None and cell.reaction_ms is None
    report = build_bus_faults_report(cells, 1)
    assert report.data == collect_figures(cells, 1) and report.data["verdict"] == "PASS"
    page = render_html(report)
    assert LOST.name in page and "tolerated" in page and "Activation" in page
