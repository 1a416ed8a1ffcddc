"""The statistics of a campaign count what was said, with exact intervals."""
from __future__ import annotations

import json
from typing import Any

import pytest
from rich.console import Console
from scipy.stats import binomtest

from fdi.estimation.binomial import measure_share
from fdi.report.terminal import print_report
from rig.campaign import report
from rig.campaign import summary as campaign_summary
from rig.campaign.report import build_campaign_report

CLOGGING, FRICTION = "filter_clogging", "spool_friction"


@pytest.mark.parametrize(("good", "of"), [(0, 20), (1, 7), (137, 500), (3000, 3000)])
def test_a_share_has_its_exact_interval(good: int, of: int) -> None:
    exact = binomtest(good, of).proportion_ci(0.95, "exact")
    assert measure_share(good, of)[2:] == pytest.approx((exact.low, exact.high), abs=1e-9)


def judged(label: str, kintas: float, fss: float, said: tuple[str, str], n: int, **more: Any) -> list[dict[str, Any]]:
    sizes = {"kintas": kintas, "kintas_low": kintas - 0.02, "kintas_high": kintas + 0.02, "fss": fss * 1.01,
             "fss_low": fss * 0.95, "fss_high": fss * 1.005}
    levels = dict(zip(("filter_clogging", "spool_friction"), said, strict=True))
    ruling = next((fault for fault, level in levels.items() if level != "acceptable"), "")
    return [{"label": label, "faults": len(label.split()) if label != "healthy" else 0, "tolerance": 0.015, "seed": i,
             "status": "ok", "reason": "", "true_kintas": kintas, "true_fss": fss, "level_filter_clogging": said[0],
             "level_spool_friction": said[1], "ruling": ruling,
             "band_spool_friction": said[1] if said[1] == "non_nominal" else "acceptable",
             "seconds": 2.0, **sizes, **more} for i in range(n)]


def test_statistics_count_what_was_said() -> None:
    fine, bad, worst = "acceptable", "maintenance", "non_nominal"
    found = [*judged("healthy", 0.0, 5.0, (fine, fine), 399), *judged("healthy", 0.0, 5.0, (fine, bad), 3),
             *judged("filter_clogging=0.25", 0.25, 5.0, (bad, fine), 38),
             *judged("filter_clogging=0.25", 0.25, 5.0, (fine, fine), 2),
             *judged("spool_friction=70", 0.0, 70.0, (fine, worst), 30),
             *judged("spool_friction=70", 0.0, 70.0, (bad, fine), 1),
             *judged("spool_friction=70", 0.0, 70.0, (fine, fine), 1, status="refused"),
             *judged(campaign_summary.OFF_GRID, 0.17, 45.0, (fine, bad), 25)]
    figures = campaign_summary.summarise_campaign(found)
    (part,) = figures["tolerances"]
    rates = {rate["name"]: rate for rate in part["rates"]}

    def count(name: str) -> tuple[int, int, bool | None]:
        return rates[name]["share"]["good"], rates[name]["share"]["of"], rates[name]["met"]

    assert count("healthy: false alarm") == (3, 402, False)
    assert count("Kintas at MidBand detected") == (38, 40, True)
    assert count("FSS at MaxBand detected") == (30, 32, False)
    assert count("Kintas at MaxBand detected") == (0, 0, None)
    assert count("ruling fault, MidBand on") == (68, 72, False)
    assert count("off-grid Kintas covered") == (25, 25, False) and count("off-grid FSS within 2 %") == (25, 25, None)
    points = [(p["size"], *(p[key]["good"] for key in ("detected", "most", "bands"))) for p in part["curves"][FRICTION]]
    assert points == [(5.0, 3, 0, 0), (70.0, 30, 30, 30)]
    assert part["levels"][CLOGGING]["acceptable"] == {
        fine: 402 + 30 + 25, bad: 1, worst: 0, "cannot_tell": 0, "refused": 1, "failed": 0}
    assert part["ruling"]["spool_friction, non_nominal"] == {
        "spool_friction": 30, "filter_clogging": 1, "refused": 1}
    error = next(e for e in part["errors"] if (e["label"], e["fault"]) == (campaign_summary.OFF_GRID, FRICTION))
    assert (error["bias"], error["rms"], error["covered"]["good"]) == (pytest.approx(0.45), pytest.approx(0.45), 25)
    json.dumps(figures, allow_nan=False)
    out = Console(width=100, record=True, quiet=False)
    print_report(build_campaign_report(figures), out)
    assert "3/402" in (text := out.export_text()) and "NOT met" in text and "95.0 %" in text
    drawn = report.draw_detection_curves(part)
    assert drawn.startswith("<svg") and "MaxBand" in drawn and "maintenance or worse" in drawn


@pytest.mark.parametrize(("good", "of", "least", "most", "met"), [
    (0, 23, 0.0, 0.005, None), (0, 200, 0.0, 0.005, True), (2, 200, 0.0, 0.005, False), (10, 100, 0.0, 0.005, False),
    (19, 20, 0.95, 1.0, True), (5, 5, 0.95, 1.0, None), (30, 32, 0.995, 1.0, False), (95, 100, 0.93, 0.97, True),
    (99, 100, 0.93, 0.97, False), (3, 9, 0.0, 1.0, None), (0, 0, 0.95, 1.0, None)])
def test_a_rate_is_judged_when_enough_was_counted(good: int, of: int, least: float, most: float, met: bool | None
                                                  ) -> None:
    assert campaign_summary.judge_rate("", measure_share(good, of), least, most)["met"] is met
