"""Trends: dates, laws, breaks, remaining life and its score, and the command."""

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import catch_refusal
from rig_command import rig, write_file

from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate, Fault
from fdi.prognosis import unit_trend
from fdi.prognosis.trend import Trend, fit_trend
from fdi.prognosis.unit_trend import find_date_in_name, find_row, format_day, parse_date, read_dates_table
from fdi.progress import ignore_progress
from fdi.report.trend_report import explain_level
from fdi.trace import Trace
from plant import InputError, load_model, simulate

WEEKS = 7.0 * np.arange(14)
RNG = np.random.default_rng(3)
SIGMA = 0.4  # N


def estimates(sizes: Sequence[float], sigma: float = SIGMA) -> list[Estimate]:
    """Sizes of spool friction as measured, N."""
    noisy_sizes = np.asarray(sizes) + sigma * RNG.standard_normal(len(sizes))
    return [Estimate(float(x), float(x - 1.96 * sigma), float(x + 1.96 * sigma)) for x in noisy_sizes]


def friction(sizes: Sequence[float], times: np.ndarray = WEEKS) -> Trend:
    """The trend of such sizes, a week apart."""
    return fit_trend(FRICTION, list(times[:len(sizes)]), estimates(sizes))


def test_dates_are_found_in_texts_and_names() -> None:
    assert parse_date("2026-01-02") - parse_date("2026-01-01") == 1.0
    assert parse_date("2026-01-01T06:00:00+06:00") == parse_date("2026-01-01") == parse_date("2026-01-01T00:00:00Z")
    assert all(math.isnan(parse_date(text)) for text in ("", "yesterday", "2026-13-01", "12345"))
    noon = find_date_in_name(Path("x_2026-03-04T12-00-00.csv"))
    days = [find_date_in_name(Path(name)) for name in ("u/2026-03-04_check.csv", "20260304T1200/trace.mcap")]
    assert [format_day(day) for day in days] == ["2026-03-04"] * 2 and noon == parse_date("2026-03-04") + 0.5
    assert all(math.isnan(find_date_in_name(Path(name))) for name in ("run_123456789.csv", "serial_99999999.csv"))


def test_a_table_of_dates(tmp_path: Path) -> None:
    table = write_file(tmp_path / "dates.csv", "file,date,hours\na.csv,2026-01-01,10\nrun/,2026-02-01,\n")
    rows = read_dates_table(table)
    row = {"date": parse_date("2026-01-01"), "hours": 10.0, "flights": pytest.approx(math.nan, nan_ok=True)}
    assert find_row(rows, "sub/a.csv") == row
    assert find_row(rows, "b.csv") is None
    for text, field in (("name,date\n", "header"), ("", "header"), ("file,date\na.csv,soon\n", "date"),
                        ("file,hours\na.csv,x\n", "hours"), ("file,flights\na.csv,-1\n", "flights"),
                        ("file,date\na,2026-01-01\na,2026-01-02\n", "file")):
        table.write_text(text)
        assert f": {field}: " in catch_refusal(read_dates_table, table)


@pytest.mark.parametrize("law", ["linear", "exponential", "power"])
def test_the_law_is_recognised_and_the_time_left_found(law: str) -> None:
    x = WEEKS / 140.0  # MaxBand at 140 days
    grown = {"linear": x, "exponential": np.expm1(4.0 * x) / np.expm1(4.0), "power": np.sqrt(x)}[law]
    trend = friction(5.0 + 65.0 * grown)
    remaining_life = trend.remaining["non_nominal"]
    assert trend.verdict == "TREND" and not trend.breaks and trend.used.all()
    alike = {law, "runaway"} if law == "exponential" else {law}  # faster and faster, both
    assert sum(trend.laws[name] for name in alike) > 0.5
    assert remaining_life.low <= 140.0 - WEEKS[-1] <= remaining_life.high and remaining_life.high < 500.0
    assert trend.remaining["maintenance"].value <= remaining_life.value
    assert trend.now.low <= 5.0 + 65.0 * grown[-1] <= trend.now.high
    assert remaining_life.compute_probability_within(remaining_life.value) == pytest.approx(0.5, abs=0.01)


def test_what_does_not_grow_has_no_trend_and_what_is_past_a_limit_no_time_left() -> None:
    still, hump, grown = map(friction, ([5.0] * 14, 5.0 + 20.0 * np.sin(WEEKS / 29.0), np.linspace(20.0, 45.0, 10)))
    assert {still.verdict, hump.verdict} == {"NO_TREND"} and still.remaining["non_nominal"].high == math.inf and (
        hump.laws["none"] < 0.05 < 0.5 < min(still.laws["none"], hump.no_growth))  # it grew, and falls now
    assert grown.level.word == "maintenance"
    assert grown.remaining["maintenance"].high == 0.0 < grown.remaining["non_nominal"].low


def test_few_points() -> None:
    for few in (friction([10.0]), friction([10.0, 15.0]), fit_trend(FRICTION, [1.0] * 4, estimates([10.0] * 4))):
        assert few.verdict == "TOO_FEW" and not few.remaining and few.rate is None
    three, many = friction([10.0, 20.0, 30.0]), friction(np.linspace(10.0, 30.0, 14))
    few, enough = (t.remaining["non_nominal"].high / t.remaining["non_nominal"].low for t in (three, many))
    assert three.verdict == "TREND" and few > 2.0 * enough  # three points know less


@pytest.mark.parametrize(("changes", "words"), [
    ({"now": Estimate(10.0, 8.0, 12.0)}, "Spool friction is acceptable: 10 N (8 .. 12) now, below MidBand (35 N)"),
    ({"now": Estimate(45.0, 42.0, 48.0)},
     "Spool friction requires maintenance: 45 N (42 .. 48) now, above MidBand (35 N), not surely at MaxBand (70 N)"),
    ({"now": Estimate(30.0, 20.0, 40.0)}, "its interval comes too near MidBand (35 N) to be acceptable"),
    ({"now": Estimate(80.0, 70.0, 90.0)}, "above MidBand (35 N) and at MaxBand (70 N) or above"),
    ({"now": Estimate(2e4, 1.9e4, 2.1e4)}, "now, above MidBand (0.035 kN) and at MaxBand (0.07 kN)"),
    ({"now": Estimate(30.0, 0.0, 60.0)},
     "the interval holds both a healthy unit (5 N) and MidBand (35 N), so the value alone"),
    ({"declared": (loss := Fault("magnet", "loss of torque", "servomotor.kt", (0.2, 0.32), 0.29, 0.26, unit="N m/A",
                                 healthy=0.32)), "fault": loss.turn_up(), "now": Estimate(0.04, 0.035, 0.045)},
     "Loss of torque requires maintenance: 0.280 N m/A (0.275 .. 0.285) now, below MidBand (0.29 N m/A), not surely"),
])
def test_a_level_names_its_reason(changes: dict[str, Any], words: str) -> None:
    assert words in explain_level(replace(friction(np.linspace(10.0, 30.0, 14)), **changes))


LINE = 5.0 + 2.0 * np.arange(12)


def find_median(trend: Trend) -> float:
    """Days until MaxBand."""
    return trend.remaining["non_nominal"].value


SHOWS: dict[str, Callable[[Trend, Trend, int], bool]] = {  # of each kind of break, and of the trend without it
    "outlier": lambda f, p, row: not f.used[row] and find_median(f) == pytest.approx(find_median(p), rel=0.2),
    "repair": lambda f, p, row: (f.used.sum(), f.verdict) == (4, "NO_TREND"),
    "step": lambda f, p, row: f.now.value == pytest.approx(47.0, abs=2.0),
    "step within a day": lambda f, p, row: f.now.value == pytest.approx(45.0, abs=2.0),
    "last above": lambda f, p, row: f.remaining["non_nominal"].low < p.remaining["non_nominal"].low,  # the worse case
    "last below": lambda f, p, row: f.verdict == p.verdict,
}
TIMES = {"step within a day": np.insert(WEEKS, 6, WEEKS[5])}  # the trace before the step and that after it


@pytest.mark.parametrize(("kind", "row", "sizes"), [
    ("outlier", 5, LINE + 25.0 * (np.arange(12) == 5)), ("outlier", 7, LINE - 12.0 * (np.arange(12) == 7)),
    ("step", 6, LINE + 20.0 * (np.arange(12) >= 6)),
    ("step within a day", 6, LINE + 18.0 * (np.arange(12) >= 6)), ("repair", 8, np.where(np.arange(12) < 8, LINE, 5.0)),
    ("last above", 11, LINE + 20.0 * (np.arange(12) == 11)), ("last below", 11, LINE - 20.0 * (np.arange(12) == 11))])
def test_breaks(kind: str, row: int, sizes: Sequence[float]) -> None:
    trend = friction(sizes, TIMES.get(kind, WEEKS))
    assert [(b.kind, b.row) for b in trend.breaks] == [(kind.split()[0], row)]
    assert trend.breaks[0].size == pytest.approx(sizes[row] - LINE[row], abs=4.0)
    assert SHOWS[kind](trend, friction(LINE), row)


def test_estimates_at_their_bound_only_say_not_more_than() -> None:
    """Ten zeros that are known to 0.03 each do not exclude that something grows below."""
    weak, strong = (fit_trend(CLOGGING, list(WEEKS[:10]), [Estimate(0.0, low, 0.06)] * 10).laws["none"]
                    for low in (0.0, -0.06))
    assert weak < strong


def points(path: Path, sizes: Sequence[float]) -> Path:
    """An earlier answer with these sizes of spool friction."""
    rows = [{"trace": f"{i}.csv", "t": parse_date("2026-01-05") + 7.0 * i, "fss": e._asdict(),
             "kintas": {"value": 0.0, "low": 0.0, "high": 0.06}} for i, e in enumerate(estimates(sizes))]
    return write_file(path, json.dumps({"axis": "date", "points": rows}))


def test_the_command_on_an_earlier_answer(tmp_path: Path) -> None:
    source = points(tmp_path / "a.json", LINE)
    result = rig("trend", source, "--json", "--out", tmp_path / "b.json")
    fss = result.json["trends"]["spool_friction"]
    days = fss["remaining"]["maintenance"]
    assert (result.status, result.json["verdict"], fss["verdict"], result.json["last"]) == (
        0, "ACCEPTABLE", "TREND", "2026-03-23")
    assert days["low"] <= days["value"] <= days["high"] and days["value_at"] > "2026-03-23"
    assert rig("trend", tmp_path / "b.json", "--json").json["trends"] == result.json["trends"]
    text = rig("trend", source, "--out", tmp_path / "x.html").out
    assert text.startswith("ACCEPTABLE  ") and all(
        word in text for word in ("spool friction", "TREND", "MaxBand", "per month", "x.html"))
    bad = points(tmp_path / "c.json", LINE + 25.0)
    assert rig("trend", bad, "--quiet", "--out", tmp_path / "x.png").status == 1  # past MidBand
    page = (tmp_path / "x.html").read_text()
    assert "<svg" in page and "MaxBand" in page and "http://" not in page.replace("http://www.w3.org", "")
    assert (tmp_path / "x.png").read_bytes()[:4] == b"\x89PNG"


def answered(file: Path, model: Any, again: bool = False, faults: Any = ()) -> dict[str, Any]:
    """In place of the diagnosis, and of a look into the log."""
    if file.name == "broken.csv":
        raise InputError(file, "xj", "a position")
    return {"started": "2026-01-10T00:00:00+00:00" if file.name == "own.mcap" else "", "note": "",
            "sizes": {"filter_clogging": [0.0, 0.0, 0.1], "spool_friction": [5.0, 4.0, 6.0]}}


def test_where_dates_come_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "unit"
    (folder / "2026-02-01").mkdir(parents=True)
    for name in ("own.mcap", "2026-02-01/named.csv", "table.csv", "table_copy.csv", "broken.csv"):
        (folder / name).write_text("")
    monkeypatch.setattr(unit_trend, "diagnose_once", answered)
    monkeypatch.setattr(unit_trend, "read_start_time", lambda *a: answered(*a)["started"])

    def gathered(axis: str | None = None) -> unit_trend.Gathered:
        return unit_trend.gather_sizes(folder, load_model(), ignore_progress, axis)

    assert (re.search(r"table.csv: date: expected .*dates.csv", catch_refusal(gathered))
            and "with a column flights" in catch_refusal(gathered, "flights"))
    (folder / "dates.csv").write_text(
        "file,date,hours,flights\ntable.csv,2026-01-20,20,2\ntable_copy.csv,2026-01-20,20,2\nown.mcap,,10,3\n"
        "named.csv,,30,4\nold.csv,2026-01-20,20,2\nbroken.csv,2026-01-20,20,2\n")
    trace_sizes = gathered()
    assert [p.trace for p in trace_sizes.points] == ["own.mcap", "table.csv", "2026-02-01/named.csv"]
    assert [format_day(p.t) for p in trace_sizes.points] == ["2026-01-10", "2026-01-20", "2026-02-01"]
    assert [note.split(",")[0] for note in trace_sizes.notes] == ["broken.csv left out: xj: expected a position",
                                                                  "old.csv is listed in dates.csv",
                                                                  "table_copy.csv left out: it is a copy of table.csv"]
    assert [p.t for p in gathered("hours").points] == [10.0, 20.0, 30.0]
    assert re.search("table.csv: flights: expected at least the 3 of .*own.mcap", catch_refusal(gathered, "flights"))


def test_a_trace_is_diagnosed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    t = 1e-3 * np.arange(2000)
    command = np.where((t > 0.2) & (t < 1.0), 1e-3, 0.0) + 5e-4 * np.clip(t - 1.0, 0.0, 0.8)
    run = simulate(load_model(), command, seed=4)
    (tmp_path / "unit").mkdir()
    columns = {name: getattr(run, name) for name in ("com", "xj", "cor", "p12", "xs")}
    Trace.from_columns(columns, 1e-3, {}).write_csv(tmp_path / "unit" / "2026-01-05.csv")
    monkeypatch.setattr(unit_trend, "find_cache_folder", lambda: tmp_path / "cache")
    first = rig("trend", tmp_path / "unit", "--json")
    assert first.json["trends"]["filter_clogging"]["verdict"] == "TOO_FEW"
    assert first.json["points"][0]["date"] == "2026-01-05" and first.json["points"][0]["fss"]["low"] < 5.0
    assert sorted(path.name for path in (tmp_path / "unit").iterdir()) == ["2026-01-05.csv"]
    monkeypatch.setattr("fdi.diagnosis.diagnosis.diagnose", lambda *a, **k: pytest.fail("a second time"))
    assert rig("trend", tmp_path / "unit", "--json").json == first.json
