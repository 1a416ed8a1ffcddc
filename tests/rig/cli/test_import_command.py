"""`rig import --map` and `--guess`: one run in several formats gives the same answer of `rig compare`."""

import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from foreign_recordings import (
    CAN_MAP,
    DBC_TEXT,
    MDF_MAP,
    simulate_run,
    write_can_log,
    write_german_csv,
    write_mf4,
)
from rig_command import refuse, rig

from fdi.trace.trace import Trace

SIGNALS = ("com", "xj", "cor", "p12", "xs")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("import")
    trace = simulate_run()
    trace.write_csv(place / "original.csv")
    write_german_csv(trace, place / "german.csv")
    write_can_log(trace, place / "log.blf")
    (place / "user.dbc").write_text(DBC_TEXT)
    (place / "can.toml").write_text(CAN_MAP)
    (place / "mdf.toml").write_text(MDF_MAP)
    return place


@pytest.fixture(scope="module")
def original(folder: Path) -> dict:
    return rig("compare", folder / "original.csv", "--json").json


def require_same_answer(path: Path, expected: dict, tolerance: float) -> None:
    found = rig("compare", path, "--json").json
    assert found["verdict"] == expected["verdict"] == "MODEL_INCOMPLETE"
    for name, signal in expected["signals"].items():
        numbers = {key: signal[key] for key in ("error", "floor", "ratio", "closed_loop_error")}
        assert {key: found["signals"][name][key] for key in numbers} == pytest.approx(numbers, rel=tolerance)
    assert found["blocks"].pop("controller") < 2.0  # rounded by the bus
    blocks = {name: ratio for name, ratio in expected["blocks"].items() if name != "controller"}
    assert found["blocks"] == pytest.approx(blocks, rel=10 * tolerance)


def test_guess_then_import_of_a_german_csv(folder: Path, original: dict) -> None:
    """The guessed map needs no change: names, units, sign and rate are found, the samples are those of the run."""
    said = rig("import", "--guess", folder / "german.csv", "--json").json
    assert {name: entry["source"] for name, entry in said["signals"].items()} == {
        "time": "Zeit [ms]", "com": "Sollweg [mm]", "xj": "Kolbenweg [mm]", "cor": "Ventilstrom",
        "p12": "Differenzdruck (bar)", "xs": "Schieber"}
    text = (folder / "german.map.toml").read_text()
    assert tomllib.loads(text)["signals"]["xj"] == {"source": "Kolbenweg [mm]", "unit": "mm", "sign": -1}
    assert "its name has 'soll'" in text and "correlation" in text and "Status (no numbers)" in text
    answer = rig("import", folder / "german.csv", "--map", folder / "german.map.toml", "--json").json
    assert answer["cycles"] == 1500 and answer["signals"]["xj"]["how"] == "every 2nd sample"
    trace, want = Trace.read(folder / "german.mcap"), Trace.read(folder / "original.csv")
    for name in SIGNALS:
        np.testing.assert_allclose(trace.column(name), want.column(name), rtol=1e-15)
    assert trace.provenance["imported.map"] == "german.map.toml" and trace.attachments["map.toml"] == text.encode()
    assert len(trace.provenance["imported.sha256"]) == 64
    require_same_answer(folder / "german.mcap", original, 1e-9)


def test_guess_keeps_a_map_that_exists(folder: Path) -> None:
    (folder / "mine.toml").write_text("kept")
    words = ["import", "--guess", folder / "german.csv", "--out", folder / "mine.toml"]
    assert "--force" in refuse(*words) and (folder / "mine.toml").read_text() == "kept"
    assert rig(*words, "--force").status == 0 and "signals.com" in (folder / "mine.toml").read_text()


def test_mf4_with_times_of_its_own_and_two_chamber_pressures(folder: Path, original: dict) -> None:
    pytest.importorskip("asammdf", reason="no asammdf: pip install 'eha-rig[measure]'")
    write_mf4(Trace.read(folder / "original.csv"), folder / "run.mf4")
    said = rig("import", folder / "run.mf4", "--map", folder / "mdf.toml", "--out", folder / "mdf.mcap", "--json").json
    assert said["format"].startswith("MDF 4") and said["signals"]["p12"]["source"] == "pressure_a - pressure_b"
    trace, want = Trace.read(folder / "mdf.mcap"), Trace.read(folder / "original.csv")
    for name in SIGNALS:
        np.testing.assert_allclose(trace.column(name), want.column(name), rtol=1e-14,
                                   atol=1e-8 if name == "p12" else 0.0)  # 100 bar and back
    require_same_answer(folder / "mdf.mcap", original, 1e-9)


def test_blf_with_the_users_dbc(folder: Path, original: dict) -> None:
    said = rig("import", folder / "log.blf", "--map", folder / "can.toml", "--dbc", folder / "user.dbc",
               "--out", folder / "can.mcap", "--json").json
    assert said["cycles"] == 1500 and said["format"] == "CAN log, user.dbc"
    trace, want = Trace.read(folder / "can.mcap"), Trace.read(folder / "original.csv")
    for name, lsb in zip(SIGNALS, (1e-8, 1e-8, 1e-8, 10.0, 1e-9), strict=True):
        assert np.abs(trace.column(name) - want.column(name)).max() <= 0.5001 * lsb
    require_same_answer(folder / "can.mcap", original, 2e-3)


def test_guess_of_a_can_log(folder: Path) -> None:
    said = rig("import", "--guess", folder / "log.blf", "--dbc", folder / "user.dbc", "--out", folder / "blf.toml",
               "--json").json
    found = {name: entry["source"] for name, entry in said["signals"].items()}
    assert found == {"time": "its own times", "com": "Demand.Target", "xj": "Ram.Stroke", "cor": "Valve.Current",
                     "p12": "Ram.DeltaP", "xs": "Valve.Spool"}


@pytest.mark.parametrize("suffix", [".asc", ".log"])
def test_other_can_logs(folder: Path, suffix: str) -> None:
    write_can_log(simulate_run(300), folder / f"short{suffix}")
    out = folder / f"short{suffix}.mcap"
    assert rig("import", folder / f"short{suffix}", "--map", folder / "can.toml", "--dbc", folder / "user.dbc",
               "--out", out).status == 0
    assert np.abs(Trace.read(out).xj - Trace.read(folder / "original.csv").xj[:300]).max() <= 0.5001e-8


def test_a_csv_of_other_columns_says_what_to_do(folder: Path) -> None:
    assert "rig import --guess" in refuse("import", folder / "german.csv", "--out", folder / "x.mcap")


@pytest.mark.parametrize(("name", "package"), [("x.mf4", "asammdf"), ("x.parquet", "pyarrow")])
def test_a_missing_package_is_named(name: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (package, f"{package}.parquet"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"x")
    line = refuse("import", "--guess", tmp_path / name)
    assert f"the package {package}" in line and "pip install 'eha-rig[measure]'" in line


MAP = """
[time]
source = "t"
[signals.com]
source = "com"
[signals.xj]
source = "xj"
[signals.cor]
source = "cor"
"""

BAD = {
    "missing column": (MAP.replace('"xj"', '"xi"'), "signals.xj.source: expected a column of own.csv", "not 'xi'"),
    "unknown unit": (MAP + 'unit = "mm"', "signals.cor.unit: expected one of A, mA, uA", "'mm'"),
    "raw unit": (MAP + 'unit = "V"', "signals.cor.unit", "scale and offset"),
    "two signals of one column": (MAP.replace('"cor"', '"xj"'), "signals.cor.source", "signals.xj has 'xj' already"),
    "wrong type": (MAP + 'sign = "minus"', "signals.cor.sign: expected -1 or 1", "'minus'"),
    "unknown key": (MAP + "sing = -1", "signals.cor.sing", "did you mean 'sign'?"),
    "unknown signal": (MAP + "[signals.p21]\nsource = 'p12'", "signals.p21", "did you mean 'p12'?"),
    "no current": (MAP.split("[signals.cor]")[0], "signals.cor: expected a table", "Cor"),
    "no time": (MAP.replace("[time]\nsource", "[trace]\nperiod"), "trace.period: expected a number above 0 s", "'t'"),
    "not TOML": ("[time", "expected TOML;", ""),
    "column that goes back": (MAP.replace('source = "t"', 'source = "com"'), "own.csv: com: expected times that grow",
                              "row 2"),
    "counter without rate": (MAP.replace('source = "t"', 'source = "t"\nbits = 16'), "time: expected source and rate",
                             "counter"),
    "time that goes backwards": (MAP, "own.csv: t: expected times that grow", "row 101 has 0.099 s after 0.1 s"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_maps_are_reported_in_one_line(case: str, tmp_path: Path) -> None:
    text, where, reason = BAD[case]
    simulate_run(300).write_csv(tmp_path / "own.csv")
    (tmp_path / "map.toml").write_text(text)
    if case == "time that goes backwards":
        lines = (tmp_path / "own.csv").read_text().splitlines()
        (tmp_path / "own.csv").write_text("\n".join([*lines[:100], lines[101], lines[100], *lines[102:]]))
    line = refuse("import", tmp_path / "own.csv", "--map", tmp_path / "map.toml", "--out", tmp_path / "x.mcap")
    assert where in line and reason in line and not (tmp_path / "x.mcap").exists()
