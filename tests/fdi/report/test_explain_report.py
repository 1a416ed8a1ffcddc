"""Reports of analyses: each verdict in a sentence, each error beside its floor, residuals as measured minus model."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from noisy_traces import SHORT, record_plant

from fdi.comparison.compare import Comparison, compare
from fdi.discovery.detectable import Blind
from fdi.discovery.explain import Marks
from fdi.discovery.explain_runs import Answer, Candidate
from fdi.discovery.runs import Source
from fdi.discovery.update_model import ModelUpdate, Provenance, Row
from fdi.estimation.fit import Value
from fdi.report import compare_report
from fdi.report.compare_report import build_comparison_report
from fdi.report.explain_report import (
    MOODS,
    build_explanation_report,
    build_model_report,
    describe_findings,
    describe_verdict,
)
from fdi.report.report import Figure, Report, Table, render_html, to_plain
from fdi.report.terminal import format_report
from fdi.trace.trace import Trace
from plant import Model
from plant.signals import EHA

FLOOR = {"xj": 2e-6, "p12": 2e4}
ERROR = {"xj": 45e-6, "p12": 3e5}


def candidate(effect: str, *beside: str, word: str = "explains") -> Candidate:
    value = Value(1.5e-4, 1.4e-4, 1.6e-4, "A")
    return Candidate(effect, beside, {f"{effect}.current": value}, dict(FLOOR), {"xj": 2.1e-6, "p12": 2e4},
                     {"xj": 1.0, "p12": 1.0}, 1200.0, 1e-30, word)


def answer(verdict: str, effects: tuple[str, ...], *candidates: Candidate, is_at_floor: bool = False,
           **fields: Any) -> Answer:
    base = SimpleNamespace(is_at_floor=is_at_floor, is_far=False, effects=(), ratio={"xj": 22.5, "p12": 15.0})
    trace = SimpleNamespace(declared=EHA, notes=())
    explanation = SimpleNamespace(verdict=verdict, effects=effects, base=base, floor=FLOOR, marks=Marks(1.0, 1e-6, ()),
                                  ledger=[base], unseen={}, excerpt="",
                                  search=SimpleNamespace(problem=SimpleNamespace(trace=trace)))
    baseline = {"error": ERROR, "floor": FLOOR, "holdout": {"xj": 44e-6, "p12": 3e5}}
    blind = (Blind("sensor_gain", "sensor_gain.error", 0.02, "1", "a stop"),
             Blind("sensor_offset", "sensor_offset.offset", 1e-4, "m", "a stop"))
    return Answer(cast(Any, explanation), candidates, baseline, blind, ("quantisation",), (), (), **fields)


CASES = {
    "NOTHING_MISSING": (answer("NOTHING_MISSING", ()), "the residual is noise"),
    "EXPLAINED": (answer("EXPLAINED", ("a",), candidate("a")), "a explains the residual"),
    "EXPLAINED by two": (answer("EXPLAINED", ("a", "b"), candidate("a", "b"), candidate("b", "a")),
                         "a and b together explain the residual"),
    "AMBIGUOUS": (answer("AMBIGUOUS", ("a", "b"), candidate("a"), candidate("b")), "a or b: each explains the"),
    "PARTLY": (answer("PARTLY", ("a",), candidate("a", word="part")), "a explains part of the residual"),
    "PARTLY by none": (answer("PARTLY", (), candidate("a", word="part")), "No effect of the catalogue"),
    "UNEXPLAINED": (answer("UNEXPLAINED", (), candidate("a", word="no")), "the best, a, leaves"),
    "UNEXPLAINED without candidates": (answer("UNEXPLAINED", ()), "No effect of the catalogue"),
    "NOT_RESOLVABLE": (answer("NOT_RESOLVABLE", ("a",), candidate("a")), "a may be present"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_sentence_has_error_and_noise_floor(case: str) -> None:
    sentence, words = describe_verdict(CASES[case][0]), CASES[case][1]
    assert sentence.endswith(".") and {case.split(" ")[0] for case in CASES} == set(MOODS)
    assert [each for each in (words, "XJ error 45.0 um", "noise floor 2.00 um") if each not in sentence] == []


@pytest.mark.parametrize(("case", "words"), [
    ("EXPLAINED", "current 150 uA (140 .. 160)"), ("PARTLY", "current 150 uA (140 .. 160)"),
    ("NOT_RESOLVABLE", "current 150 uA (140 .. 160)"),
    ("EXPLAINED by two", "a: current 150 uA (140 .. 160); b: current 150 uA (140 .. 160)")])
def test_a_size_has_its_interval(case: str, words: str) -> None:
    assert words in describe_verdict(CASES[case][0])


def test_findings() -> None:
    by = {"by": "measure XS too", "between": ("a", "b")}
    told = answer("AMBIGUOUS", ("a", "b"), candidate("a"), candidate("b"), separate=by, pattern="a force")
    plain, lines = ({line.label: line.text for line in describe_findings(given)}
                    for given in (CASES["AMBIGUOUS"][0], told))
    assert plain["to discriminate"].startswith("no sensor and no command")
    assert plain["not detectable"] == "sensor_gain (up to 0.0200) and sensor_offset (up to 100 um); " \
        "a stop would reveal sensor_gain and sensor_offset"
    assert (lines["to discriminate"], lines["residual"]) == (
        "measure XS too: in simulation this discriminates between a and b", "a force")


@pytest.mark.parametrize("verdict", ["UNEXPLAINED", "EXPLAINED"])
def test_an_actuator_far_from_the_model_is_to_be_identified(verdict: str) -> None:
    """Only where no explanation is found: an explained one has its parameters listed as suspicious."""
    far = answer(verdict, (), candidate("a", word="no"))
    cast(Any, far.explanation.base).is_far = True
    assert any("rig identify" in line.text for line in describe_findings(far)) == (verdict == "UNEXPLAINED")
    cast(Any, far.explanation.base).ratio["xj"] = 400.0
    assert any("400 noise floors" in line.text for line in describe_findings(far)) == (verdict == "UNEXPLAINED")


def render_without_figures(report: Report) -> str:
    """Drawing a figure needs whole traces; the commands' own tests draw them."""
    sections = [replace(s, items=[i for i in s.items if not isinstance(i, Figure)]) for s in report.sections]
    return render_html(replace(report, sections=sections))


def test_the_report_of_an_explanation_in_all_forms() -> None:
    sources = [Source("est.csv", "1"), Source("repeat.csv", "2"), Source("holdout.csv", "3")]
    report = build_explanation_report(CASES["EXPLAINED"][0], "est.csv", "eha", sources, "rig explain est.csv",
                                      "rig add a est.csv", notes=["3 rows left out"])
    text, page, data = format_report(report, 80), render_without_figures(report), to_plain(report.data)
    assert "no effect" in text and "explains" in text and "<1e-99" not in text and "1e-30" in text
    assert "note            3 rows left out" in text and "next            rig add a est.csv" in text
    assert not [words for words in ("held-out run", "holdout.csv", "150 uA (140 .. 160)", "not detectable up to",
                                    "rig explain est.csv") if words not in page]
    assert data["verdict"] == "EXPLAINED" and data["candidates"][0]["with"] == [] and "ledger" not in data
    assert data["blind_to"][1]["smallest_visible"] is None
    assert "ledger" in build_explanation_report(CASES["EXPLAINED by two"][0], "est.csv", "eha", sources).data


def update(helps: bool) -> ModelUpdate:
    steps = [SimpleNamespace(holdout=by, hypothesis=SimpleNamespace(errors=by)) for by in (ERROR, FLOOR)]
    refit = SimpleNamespace(helps=helps, steps=steps, last=steps[-1], floor=FLOOR,
                            search=SimpleNamespace(problem=SimpleNamespace(trace=SimpleNamespace(declared=EHA))))
    known = Provenance(trace=Source("est.csv", "1"), holdout=Source("holdout.csv", "2"), floor=FLOOR,
                       ledger=(Row(None, ERROR, ERROR), Row("a", FLOOR, FLOOR)), history=("rig add a",), effects=("a",))
    return ModelUpdate(Model(), known, ("a",), "", cast(Any, refit),
                       {"a.current": Value(1.5e-4, 1.4e-4, 1.6e-4, "A")}, (), ())


def test_the_report_of_a_model_update_in_all_forms(tmp_path: Any) -> None:
    report, useless = (build_model_report(update(helps), tmp_path / "m.toml", tmp_path / "m.toml.bak",
                                          tmp_path / "m.html") for helps in (True, False))
    assert useless.mood == "doubtful" and useless.sentence.endswith("a explains nothing but noise.")
    text, page = format_report(report, 80), render_without_figures(report)
    assert report.sentence == ("a added: XJ error 45.0 um -> 2.00 um, noise floor 2.00 um; held-out run 45.0 um -> "
                               "2.00 um.")
    assert not [words for words in ("model as it was", "+ a", "noise floor", "150 uA (140 .. 160)", "m.toml.bak",
                                    "m.html") if words not in text.replace("\n", "")]
    assert "held-out" in page and "22.5" in page and to_plain(report.data)["helps"] is True


OFFSETS = {"xj": 0.0, "p12": 3e5, "xs": 8e-6}  # of the sensors; XJ is drawn to the measurement, so it has none


@cache
def record_offset() -> Trace:
    """A trace whose sensors of P12 and XS show too much, so that measured minus model is positive."""
    trace = record_plant(com=SHORT, seed=2)
    return trace.with_columns({name: trace.column(name) + size for name, size in OFFSETS.items()})


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
