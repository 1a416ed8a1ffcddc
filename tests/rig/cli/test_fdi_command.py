"""`rig fdi` as it is typed: verdict, table, JSON, exit statuses, other methods, and what it refuses in one line."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from noisy_traces import SHORT, record_healthy, record_plant
from rig_command import Said, answer, refuse, rig

from fdi.diagnosis.diagnosis import diagnose
from fdi.diagnosis.faults import CLOGGING, FRICTION, Level
from fdi.report.diagnosis_report import describe_verdict
from fdi.trace.csv_table import write_csv
from fdi.trace.trace import Trace
from plant import load_model

CLOGGED = {"filter.clogging": 0.3}
STUCK = {"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0}
KEYS = {"level", "ruling", "events", "precursors", "grid", "refined"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """healthy, clogged and stuck on the preflight command; short on another."""
    folder = tmp_path_factory.mktemp("traces")
    record_healthy(2).write_csv(folder / "healthy.csv")
    record_plant(CLOGGED).write_csv(folder / "clogged.csv")
    record_plant(STUCK, SHORT).write_csv(folder / "short.csv")
    return folder


@pytest.fixture(scope="module")
def clogged(folder: Path) -> Said:
    return rig("fdi", folder / "clogged.csv", "--out", folder / "clogged.json")


def test_json_of_a_healthy_unit(folder: Path) -> None:
    told = answer("fdi", folder / "healthy.csv")
    assert set(told) >= KEYS and set(told["grid"]["merged"]) >= {"kintas", "fss"} <= set(told["refined"])
    assert told["level"] == {"filter_clogging": "acceptable", "spool_friction": "acceptable"}
    assert (told["ruling"], told["verdict"], told["events"]) == (None, "ACCEPTABLE", [])
    for size in (told["refined"]["kintas"], told["refined"]["fss"]):
        assert 0.0 <= size["low"] <= size["value"] <= size["high"]
    assert told["refined"]["method"] == "least squares" and told["refined"]["simulations"] > 300
    assert {"step", "ramp"} <= set(told["grid"]) and not any(other["unhealthy"] for other in told["others"].values())


def test_words_and_json_of_a_clogged_filter(clogged: Said, folder: Path) -> None:
    told = json.loads((folder / "clogged.json").read_text())
    printed = re.match(r"MAINTENANCE  Filter clogging requires maintenance: Kintas ([\d.]+)\b", clogged.out)
    kintas, text = told["refined"]["kintas"], " ".join(clogged.out.split())
    assert printed and float(printed[1]) == pytest.approx(kintas["value"], abs=0.1 * (kintas["high"] - kintas["low"]))
    assert kintas["low"] < CLOGGED["filter.clogging"] < kintas["high"]
    assert [words for words in ("spool friction is acceptable", "0.25 and 0.35", "first overshoot", "first begins",
                                "simulations", "* marks the ruling fault") if words not in text] == []
    assert (clogged.status, clogged.err, told["ruling"]) == (1, "", "filter_clogging") and told["events"]
    assert all(set(event) >= {"band", "signal", "t_in", "t_out"} and event["t_in"] < event["t_out"]
               for event in told["events"])


def test_another_command_is_judged_without_bands(folder: Path) -> None:
    found = diagnose(Trace.read(folder / "short.csv"))
    assert found.levels == {CLOGGING.name: Level.ACCEPTABLE, FRICTION.name: Level.MAINTENANCE}
    assert (found.band_verdict, found.events) == (None, ()) and any(note.startswith("no bands") for note in found.notes)
    assert found.sizes[FRICTION.name].value == pytest.approx(45.0, rel=0.06)


def test_a_fault_that_only_the_bands_blame_is_explained(folder: Path, tmp_path: Path) -> None:
    """A null bias moves the response out of the bands of clogging; the fit knows better, and that is said."""
    record_plant({"null_bias.current": 2.4e-4}).write_csv(tmp_path / "biased.csv")
    said = rig("fdi", tmp_path / "biased.csv", "--out", tmp_path / "biased.html")
    page = (tmp_path / "biased.html").read_text()
    assert said.status == 0 and said.out.startswith("ACCEPTABLE")
    for text in (" ".join(said.out.split()), page):
        bias = re.search(r"filter clogging: the bands call it non-nominal.* beside null bias ([\d.]+) mA", text)
        assert bias and float(bias[1]) == pytest.approx(0.24, rel=0.05)
    assert len(re.findall(r"<td[^>]*>step to 0 mm</td>", page)) > 1  # two steps, two lines
    assert "eha-rig" in page and "mathdefault" not in page


def test_nothing_is_blamed_where_something_else_is_wrong() -> None:
    """Spool and ram see a lag of the transducer that no fault and no tolerance explains."""
    found = diagnose(record_plant({"sensor_lag.time": 3e-3}, SHORT))
    assert found.verdict == "SOMETHING_ELSE" and found.ruling is None
    assert all(each in (None, Level.ACCEPTABLE) for each in found.levels.values())
    assert all(0.0 <= size.low <= size.value <= size.high for size in found.sizes.values())
    assert "Something else is wrong" in describe_verdict(found)


@pytest.mark.parametrize(("words", "says"), [
    ((), "TRACE"), (("no xj.csv",), "xj"), (("no cor.csv",), "cor"), (("rest.csv",), "moves"),
    (("healthy.csv", "--bands", "nowhere.toml"), "nowhere.toml"), (("healthy.csv", "--out", "x.txt"), "x.txt"),
    (("healthy.csv", "--model", "ehs"), "ehs")])
def test_what_it_cannot_use_is_said_in_a_line(folder: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...],
                                              says: str) -> None:
    monkeypatch.chdir(folder)
    record_plant({}, np.zeros(400)).write_csv(folder / "rest.csv")
    columns = {name: Trace.read("short.csv").column(name) for name in ("t", "com", "xj", "cor", "p12", "xs")}
    for missing in ("xj", "cor"):
        write_csv(folder / f"no {missing}.csv", {name: column for name, column in columns.items() if name != missing})
    assert says in refuse("fdi", *words)


def test_a_unit_without_leakage_is_judged_and_not_by_the_bands_of_another(folder: Path) -> None:
    """A parameter that is zero in the model has no logarithm; the shipped bands are those of the nominal unit."""
    tight, slow = (rig("fdi", folder / name, "--set", change, "--json").json
                   for name, change in (("short.csv", "jack.leakage=0"), ("healthy.csv", "valve.flow_gain=0.24")))
    assert tight["refined"]["kintas"]["low"] == 0.0 and slow["events"] == []
    assert any("own are of the nominal unit" in note for note in slow["notes"])


def test_a_gap_is_told(folder: Path, tmp_path: Path) -> None:
    """A quarter of a second is missing while the ram moves on: what is left is judged."""
    trace = Trace.read(folder / "healthy.csv")
    there = np.abs(np.arange(len(trace)) - 9824.5) > 125.0
    holed = {name: np.where(there, trace.column(name), np.nan) for name in ("com", "xj", "cor", "p12", "xs")}
    Trace.from_columns(holed, trace.period, {}).write_csv(tmp_path / "gap.csv")
    found = diagnose(Trace.read(tmp_path / "gap.csv"), load_model())
    assert any("missing in 250 of 13500 rows" in note for note in found.notes)
    assert all(each in (None, Level.ACCEPTABLE) for each in found.levels.values()) and found.ruling is None
