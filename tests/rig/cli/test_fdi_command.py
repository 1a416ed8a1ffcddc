"""`rig fdi` as it is typed: verdict, table, JSON, exit statuses, other methods, and what it refuses in one line."""
from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from noisy_traces import SHORT, record_healthy, record_plant
from rig_command import Said, rig

from fdi.diagnosis.diagnosis import Diagnosis, diagnose
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
    said = rig("fdi", folder / "healthy.csv", "--json")
    told = said.json
    assert said.status == 0 and said.err == "" and set(told) >= KEYS
    assert told["level"] == {"filter_clogging": "acceptable", "spool_friction": "acceptable"}
    assert told["ruling"] is None and told["verdict"] == "ACCEPTABLE" and told["events"] == []
    assert set(told["grid"]) >= {"step", "ramp", "merged"} and set(told["grid"]["merged"]) >= {"kintas", "fss"}
    for name in ("kintas", "fss"):
        size = told["refined"][name]
        assert 0.0 <= size["low"] <= size["value"] <= size["high"]
    assert told["refined"]["method"] == "least squares" and told["refined"]["simulations"] > 300
    assert not any(other["unhealthy"] for other in told["others"].values())


def test_words_and_json_of_a_clogged_filter(clogged: Said, folder: Path) -> None:
    assert clogged.status == 1 and clogged.err == ""
    told = json.loads((folder / "clogged.json").read_text())
    printed = re.match(r"MAINTENANCE  Filter clogging requires maintenance: Kintas ([\d.]+)\b", clogged.out)
    kintas = told["refined"]["kintas"]
    width = kintas["high"] - kintas["low"]
    assert printed and abs(float(printed[1]) - kintas["value"]) < 0.1 * width, "the value of the JSON, rounded"
    assert kintas["low"] < CLOGGED["filter.clogging"] < kintas["high"]
    for words in ("spool friction is acceptable", "0.25 and 0.35", "first overshoot", "first begins", "simulations",
                  "* marks the ruling fault"):
        assert words in " ".join(clogged.out.split()), words
    assert told["ruling"] == "filter_clogging" and told["events"]
    assert all(set(event) >= {"band", "signal", "t_in", "t_out"} and event["t_in"] < event["t_out"]
               for event in told["events"])


@pytest.fixture(scope="module")
def other_command(folder: Path) -> Diagnosis:
    return diagnose(Trace.read(folder / "short.csv"))


def test_another_command_is_judged_without_bands(other_command: Diagnosis) -> None:
    assert other_command.levels == {CLOGGING.name: Level.ACCEPTABLE, FRICTION.name: Level.MAINTENANCE}
    assert other_command.band_verdict is None and other_command.events == ()
    assert any(note.startswith("no bands") for note in other_command.notes)
    assert other_command.sizes[FRICTION.name].value == pytest.approx(45.0, rel=0.06)


def test_a_fault_that_only_the_bands_blame_is_explained(folder: Path, tmp_path: Path) -> None:
    """A null bias moves the response out of the bands of clogging; the fit knows better, and that is said."""
    record_plant({"null_bias.current": 2.4e-4}).write_csv(tmp_path / "biased.csv")
    said = rig("fdi", tmp_path / "biased.csv", "--out", tmp_path / "biased.html")
    page = (tmp_path / "biased.html").read_text()
    assert said.status == 0 and said.out.startswith("ACCEPTABLE")
    for text in (" ".join(said.out.split()), page):
        assert "call filter clogging non-nominal" in text
        bias = re.search(r"finds it acceptable, with null bias ([\d.]+) mA", text)
        assert bias and float(bias[1]) == pytest.approx(0.24, rel=0.05)
    assert "step to 0 mm" in page and len(re.findall(r"<td[^>]*>step to 0 mm</td>", page)) > 1  # two steps, two lines
    assert "eha-rig" in page and "mathdefault" not in page


def test_nothing_is_blamed_where_something_else_is_wrong() -> None:
    """Spool and ram see a lag of the transducer that no fault and no tolerance explains."""
    found = diagnose(record_plant({"sensor_lag.time": 3e-3}, SHORT))
    assert found.verdict == "SOMETHING_ELSE" and not found.is_acceptable and found.ruling is None
    assert all(each in (None, Level.ACCEPTABLE) for each in found.levels.values())
    assert "Something else is wrong" in describe_verdict(found)


@pytest.mark.parametrize("missing", ["xj", "cor"])
def test_a_trace_without_position_or_current_is_refused(folder: Path, tmp_path: Path, missing: str) -> None:
    trace = Trace.read(folder / "short.csv")
    columns = {name: trace.column(name) for name in ("t", "com", "xj", "cor", "p12", "xs") if name != missing}
    write_csv(tmp_path / "part.csv", columns)
    said = rig("fdi", tmp_path / "part.csv")
    assert said.status == 2 and said.out == "" and missing in said.err and len(said.err.splitlines()) == 1


def test_a_ram_at_rest_is_refused(tmp_path: Path) -> None:
    record_plant({}, np.zeros(400)).write_csv(tmp_path / "rest.csv")
    said = rig("fdi", tmp_path / "rest.csv")
    assert said.status == 2 and "moves" in said.err and len(said.err.splitlines()) == 1


@pytest.mark.parametrize("words", [(), ("--bands", "nowhere.toml"), ("--out", "x.txt"), ("--model", "ehs")])
def test_what_it_cannot_use_is_said_in_a_line(folder: Path, words: tuple[str, ...]) -> None:
    said = rig("fdi", *([folder / "healthy.csv"] if words else []), *words)
    assert said.status == 2 and said.out == "" and len(said.err.splitlines()) == 1


def test_a_unit_without_leakage_is_judged_and_not_by_the_bands_of_another(folder: Path) -> None:
    """A parameter that is zero in the model has no logarithm; the shipped bands are those of the nominal unit."""
    said = rig("fdi", folder / "healthy.csv", "--set", "jack.leakage=0", "--json")
    assert said.status in (0, 1) and said.json["refined"]["kintas"]["low"] == 0.0, said.err
    said = rig("fdi", folder / "healthy.csv", "--set", "valve.flow_gain=0.24", "--json")
    assert said.status in (0, 1) and said.json["events"] == [], said.err
    assert any("own are of the nominal unit" in note for note in said.json["notes"])


def test_a_gap_is_told(folder: Path, tmp_path: Path) -> None:
    """A quarter of a second is missing while the ram moves on: what is left is judged."""
    trace = load_trace_with_hole(folder / "healthy.csv", slice(9700, 9950))
    trace.write_csv(tmp_path / "gap.csv")
    found = diagnose(Trace.read(tmp_path / "gap.csv"), load_model())
    assert any("missing in 250 of 13500 rows" in note for note in found.notes)
    assert all(each in (None, Level.ACCEPTABLE) for each in found.levels.values()) and found.ruling is None


def load_trace_with_hole(path: Path, rows: slice) -> Trace:
    trace = Trace.read(path)
    columns = {name: trace.column(name).copy() for name in ("com", "xj", "cor", "p12", "xs")}
    for column in columns.values():
        column[rows] = np.nan
    return Trace.from_columns(columns, trace.period, {})
