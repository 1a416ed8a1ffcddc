"""What an import makes of text tables, time bases, rates, gaps and scales; guesses; one run in several formats."""

import math
import re
import sys
import tomllib
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from foreign_recordings import CAN_MAP, DBC_TEXT, MDF_MAP, simulate_run, write_can_log, write_german_csv, write_mf4
from refusals import catch_refusal
from rig_command import refuse, rig, write_file
from scipy.io import savemat

from fdi.trace import Trace
from fdi.trace.importing.conversion import Imported, Samples, import_measurement, parse_map, place_samples
from fdi.trace.importing.formats import Channel, Measurement, open_measurement, open_text_table, read_singly
from fdi.trace.importing.guess import GuessedMap, guess_map

MAP = """
[signals.com]
source = "com"
[signals.xj]
source = "xj"
[signals.cor]
source = "cor"
"""
T = np.arange(1000) * 1e-3
XJ = 3e-3 * np.sin(2 * math.pi * 2.0 * T)


def convert(tmp_path: Path, text: str, **columns: np.ndarray) -> Imported:
    """The import of columns com, xj, cor (sines unless given) and others."""
    (tmp_path / "x.bin").write_bytes(b"x")
    arrays = {"com": XJ, "xj": XJ, "cor": XJ} | columns
    channels = {name: Channel(np.asarray(values, float)) for name, values in arrays.items()}
    measurement = Measurement(
        tmp_path / "x.bin", "arrays", dict.fromkeys(arrays, ""), read_singly(channels.__getitem__))
    return import_measurement(measurement, parse_map(text + MAP, tmp_path / "map.toml"), 1e-3)


def test_counter_that_wraps_and_a_gap(tmp_path: Path) -> None:
    """16 bits, 4 counts a row, 25 rows lost over a wrap: one gap of 25 rows, every sample in its row."""
    there = np.delete(np.arange(1000), np.arange(480, 505))
    counts = (65536 - 4 * 490 + 4 * there) % 65536
    text = '[time]\nsource = "n"\nbits = 16\nrate = 4000\n'
    imported = convert(tmp_path, text, n=counts, com=XJ[there], xj=XJ[there], cor=XJ[there])
    np.testing.assert_array_equal(imported.trace.xj, np.where(np.isin(np.arange(1000), there), XJ, np.nan))
    assert {s.name: (s.gaps, s.missing) for s in imported.signals}["xj"] == (1, 25) and imported.trace.period == 1e-3


P12 = '[time]\nrate = 1000\n[signals.p12]\nsource = "p"\n'


@pytest.mark.parametrize(("keys", "rows"), [
    ('unit = "bar"\nscale = 0.0625\noffset = -0.625\nsign = -1', {0: 62500.0, 10: 0.0, 26: -100000.0}),
    ("delay = 0.003", {0: 3.0, 4: 7.0, 996: 999.0, 997: math.nan, 999: math.nan}),
    ("sensor = {dead = [[0.2, 0.3]]}", {199: 199.0, 200: math.nan, 300: math.nan, 301: 301.0})])
def test_scale_delay_and_dead_span(keys: str, rows: dict[int, float], tmp_path: Path) -> None:
    """Value = sign * (scale * raw + offset), some rows earlier, NaN where the channel was dead."""
    p12 = convert(tmp_path, f"{P12}{keys}\n", p=np.arange(1000)).trace.p12
    assert p12[list(rows)].tolist() == pytest.approx(list(rows.values()), abs=0.0, nan_ok=True)


@pytest.mark.parametrize(("text", "reason"), [
    ('[time]\nsource = "p"\nbits = 8\nrate = 1000\n', r"whole numbers from 0 to 255 \(8 bits\); row 257 has 256"),
    (f"{P12}offset = 1{'0' * 400}\n", r"offset: expected a number, not 1000"),
    (f"{P12}sensor = {{dead = [[0, 1{'0' * 400}]]}}\n", "dead: expected true or false or a list, each"),
    (f"{P12}sensor = {{dead = true}}\n", "marked dead")])
def test_too_few_bits_and_a_dead_channel_are_refused(text: str, reason: str, tmp_path: Path) -> None:
    assert re.search(reason, catch_refusal(convert, tmp_path, text, p=np.arange(1000)))


def test_slow_signal_lies_on_straight_lines_and_its_gap_stays(tmp_path: Path) -> None:
    """100 Hz beside 1 kHz, empty fields between; a second without values is not bridged."""
    k = np.arange(1000)
    load = np.where((k % 10 == 0) & ((k < 400) | (k >= 500)), 0.5 * k, np.nan)
    imported = convert(tmp_path, '[time]\nrate = 1000\n[signals.load]\nsource = "f"\n', f=load)
    there = (k < 391) | ((k >= 500) & (k < 991))
    np.testing.assert_allclose(imported.trace.load[:991], np.where(there, 0.5 * k, np.nan)[:991])
    assert "straight lines between samples 10 ms apart" in imported.signals[0].how


def test_what_would_fold_is_filtered_first() -> None:
    """A ripple of 4.9 kHz at 10 kHz would read 100 Hz at 1 kHz; with the filter 99.9 % of it is gone."""
    t = np.arange(20_000) * 1e-4
    slow, ripple = np.sin(2 * math.pi * 10.0 * t), 0.3 * np.sin(2 * math.pi * 4900.0 * t)
    rows = np.arange(2000) * 1e-3
    (filtered, how), (raw, _), (quiet, plain) = (
        place_samples(Samples(t, x), rows, 1e-3, "auto", is_filtered, "")
        for x, is_filtered in ((slow + ripple, None), (slow + ripple, False), (slow, None)))
    assert (how, plain) == ("low-pass filtered, every 10th sample", "every 10th sample")
    assert np.abs(filtered - slow[::10])[20:-20].max() < 3e-3 and np.abs(raw - slow[::10]).max() > 0.1
    assert np.array_equal(quiet, slow[::10])


def test_held_answers_of_the_controller_keep_their_cycle() -> None:
    """At 4 kHz the current is new in the third sample of a cycle: row k still holds the answer to row k."""
    answer = np.repeat(np.arange(1001.0), 4)[2:4002]  # the first two samples are of the cycle before
    x, _ = place_samples(Samples(np.arange(4000) * 2.5e-4, answer), T, 1e-3, "auto", None, "answer")
    assert np.array_equal(x[:-1], np.arange(1.0, 1000.0))


@pytest.mark.parametrize(("spacing", "period"), [
    (1.0003e-3, 1.0003e-3), (0.3e-3, 1e-3), (1e-3 / 3, 1e-3), (0.375e-3, 1e-3), (0.9e-3, 1e-3), (0.375e-3, 1.00005e-3)])
def test_logger_of_another_clock_brings_each_cycle_once(spacing: float, period: float, tmp_path: Path) -> None:
    """1.0003 ms for 1 ms slips by three rows in 10 s: the trace takes the recording's own period.

    Where each value is held for a cycle, the logger's samples need not be a whole part of it apart.
    """
    t = np.round(0.05e-3 + np.arange(int(9.9 / spacing)) * spacing, 7)
    x = 1e-6 * np.floor(t / period)
    trace = convert(tmp_path, '[time]\nsource = "t"\n', t=t, com=x, xj=x, cor=x).trace
    assert trace.period == pytest.approx(period, rel=1e-6) and all((
        np.diff(np.rint(1e6 * trace.column(name)[:9000])) == 1.0).all() for name in ("com", "xj", "cor"))


def guess(tmp_path: Path, lines: list[str]) -> GuessedMap:
    return guess_map(open_measurement(write_file(tmp_path / "x.csv", "\n".join(lines))))


def test_guess_of_a_table_without_names(tmp_path: Path) -> None:
    """Only motion tells: the growing column is the time, the two that follow each other are Com and XJ."""
    com = np.where(np.arange(1000) % 400 > 200, 3.0, -3.0)
    xj = np.convolve(com, np.exp(-np.arange(200) / 20.0) / 20.5, "full")[:1000]
    lines = [f"{k},{x:.4f},{c:.1f},{k % 7}" for k, (x, c) in enumerate(zip(xj, com, strict=True))]
    guessed = guess(tmp_path, lines)
    assert guessed.chosen["com"] == ("column 3", "unsure") and guessed.chosen["xj"][0] == "column 2"
    assert guessed.chosen["time"][0] == "column 1" and 'unit = "ms"' in guessed.text
    assert "# [signals.cor]" in guessed.text and "every analysis needs it" in guessed.text


@pytest.mark.parametrize("unit", ["counts", "V"])  # no unit, and that of another quantity
def test_guess_scales_counts_and_writes_their_step(tmp_path: Path, unit: str) -> None:
    """Counts of 5 um, offset 1000, of a ram that lags and meets an end stop: scale from Com and Cor; Cor not reversed.

    A column that does not change is no signal; the map says which one its name means.
    """
    com = np.repeat([0.0, 6.0, -2.0, 12.0, 0.0], 300)
    xj = np.array(list(accumulate(com, lambda x, to: min(x + 0.02 * min(max(to - x, -3.0), 3.0), 7.0))))
    cor = np.clip(3.8 * (com - xj), -8.0, 8.0)
    rows = zip(com, np.rint(xj / 0.005) + 1000, cor, strict=True)
    lines = [f"t [s];Soll [mm];Ist [{unit}];i [mA];Kraft [kN]"]
    lines += [f"{k / 1000};{c:g};{x:.0f};{i:.5f};0" for k, (c, x, i) in enumerate(rows)]
    guessed = guess(tmp_path, lines)
    signals = parse_map(guessed.text, tmp_path / "x.map.toml").signals
    xj = signals["xj"]
    assert (xj.scale, xj.offset, xj.make_dynamics("m").quantum) == pytest.approx((0.005, -5.0, 5e-6), rel=0.02)
    assert signals["cor"].sign == 1.0 and guessed.chosen["xj"] == (f"Ist [{unit}]", "unsure")
    assert guessed.left == {"Kraft [kN]": "always 0; by its name it would be load"}


@pytest.mark.parametrize("suffix", [".mat", ".parquet"])
def test_matlab_and_parquet(suffix: str, tmp_path: Path) -> None:
    columns = {"t": T, "com": XJ, "xj": XJ, "cor": XJ, "p12": 2.0 * XJ}
    path, text = tmp_path / f"x{suffix}", '[time]\nsource = "t"\n' + MAP
    if suffix == ".mat":
        savemat(path, {"run": columns})
        text = text.replace('source = "', 'source = "run.')
    else:
        parquet = pytest.importorskip("pyarrow.parquet", reason="no pyarrow: pip install 'eha-rig[measure]'")
        parquet.write_table(pytest.importorskip("pyarrow").table(columns), path)
    imported = import_measurement(open_measurement(path), parse_map(text, tmp_path / "map.toml"), 1e-3)
    assert np.array_equal(imported.trace.xj, XJ)


@pytest.mark.parametrize(("name", "word"), [("x.mat", "MAT"), ("x.parquet", "Parquet"), ("x.mf4", "MDF")])
def test_damaged_files(name: str, word: str, tmp_path: Path) -> None:
    if name != "x.mat":
        pytest.importorskip({"x.parquet": "pyarrow", "x.mf4": "asammdf"}[name], reason="pip install 'eha-rig[measure]'")
    (tmp_path / name).write_bytes(b"not what its name says" * 20)
    assert re.search(rf"{name}: expected an? {word} file", catch_refusal(open_measurement, tmp_path / name))


def test_the_map_in_the_manual_is_valid() -> None:
    text = (Path(__file__).parents[4] / "docs" / "import.md").read_text()
    block = text.split("shows every key:\n\n")[1].split("\n\n`[time]`")[0]
    import_map = parse_map("\n".join(line[4:] for line in block.splitlines()), Path("import.md"))
    assert import_map.signals["p12"].delay == 0.0035 and import_map.signals["p12"].sensor.moving_mean == 20.0
    assert import_map.signals["xj"].make_dynamics("m").quantum == pytest.approx(2.5e-5)


@pytest.mark.parametrize(("text", "encoding"), [
    pytest.param("t,x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-8", id="comma"),
    pytest.param("t;x\n0;1,5\n1;2,5\n2;-3e-2\n", "utf-8", id="semicolon and decimal comma"),
    pytest.param("t\tx\n0\t1.5\n1\t2.5\n2\t-3e-2\n", "utf-8", id="tabulator"),
    pytest.param("   t     x\n 0   1.5\n 1   2.5\n  2  -3e-2\n", "utf-8", id="white space"),
    pytest.param("t,x\r\n0,1.5\r\n1,2.5\r\n2,-3e-2\r\n", "utf-8-sig", id="mark of UTF-8, CRLF"),
    pytest.param("t,x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-16", id="UTF-16"),
    pytest.param("# a logger\n% 3 rows\n\nt,x\n0,1.5\n# pause\n1,2.5\n2,-3e-2\n", "utf-8", id="with comments"),
    pytest.param('"t","x"\n"0","1.5"\n"1","2.5"\n"2","-3e-2"\n', "utf-8", id="quoted"),
    pytest.param("# t, x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-8", id="names in a comment"),
    pytest.param("Logger,7\nserial number 12\nt,x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-8", id="words above"),
    pytest.param("t;x\n0;1.5;\n1;2.5;\n2;-3e-2;\n", "utf-8", id="last separator"),
])
def test_layouts(text: str, encoding: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes(text.encode(encoding))
    table = open_text_table(tmp_path / "x.csv")
    assert list(table.units)[:2] == ["t", "x"]
    assert [c.values.tolist() for c in table.read(["t", "x"], []).values()] == [[0.0, 1.0, 2.0], [1.5, 2.5, -0.03]]


@pytest.mark.parametrize(("content", "units"), [
    ("Zeit;Weg [mm];p;Weg [mm]\ns;;bar;\n0;1;2;3\n1;2;3;4\n",
     {"Zeit": "s", "Weg [mm]": "mm", "p": "bar", "Weg [mm] #2": "mm"}),
    ("Ram Position\tp\n m\tMPa\n0\t1\n1\t2\n", {"Ram Position": "m", "p": "MPa"})])
def test_units_from_a_line_and_from_brackets(content: str, units: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes(content.encode("latin-1"))
    assert open_text_table(tmp_path / "x.csv").units == units


def test_missing_fields_and_dates(tmp_path: Path) -> None:
    file = write_file(tmp_path / "x.csv", "when,x,y\n2024-05-01T12:00:00.000,1,2\n2024-05-01T12:00:00.001,NaN,2\n"
                                          "2024-05-01T12:00:00.003,,n/a\n")
    columns = open_text_table(file).read(["when", "x"], ["when"])
    assert np.diff(columns["when"].values).round(7).tolist() == [0.001, 0.002]
    assert np.isnan(columns["x"].values).tolist() == [False, True, True]


@pytest.mark.parametrize(("row", "place", "reason"), [
    ("2,abc", "line 4: x", "'abc'"), ("2,inf", "line 4: x", "'inf'"), ("2,1_0", "line 4: x", "'1_0'"),
    ("2", "line 4", "2 fields, not 1"), ("2,3,4", "line 4", "2 fields, not 3"),
])
def test_bad_rows(row: str, place: str, reason: str, tmp_path: Path) -> None:
    table = open_text_table(write_file(tmp_path / "x.csv", f"t,x\n0,1\n1,2\n{row}\n3,4\n"))
    line = catch_refusal(table.read, ["t", "x"], [])
    assert place in line and reason in line


@pytest.mark.parametrize("content", [b"", b"no table\n", b"\0\1\2", b"a,b\nc,d\n",
                                     pytest.param(b'a,b\n1,"' + b"2" * 140000 + b'"\n', id="a long field")])
def test_what_is_no_table(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes(content)
    assert "x.csv" in catch_refusal(open_text_table, tmp_path / "x.csv")


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


def require_same_answer(path: Path, reference: dict, tolerance: float) -> None:
    answer = rig("compare", path, "--json").json
    assert answer["verdict"] == reference["verdict"] == "MODEL_INCOMPLETE"
    for name, signal in reference["signals"].items():
        numbers = {key: signal[key] for key in ("error", "floor", "ratio", "closed_loop_error")}
        assert {key: answer["signals"][name][key] for key in numbers} == pytest.approx(numbers, rel=tolerance)
    assert answer["blocks"].pop("controller") < 2.0  # rounded by the bus
    blocks = {name: ratio for name, ratio in reference["blocks"].items() if name != "controller"}
    assert answer["blocks"] == pytest.approx(blocks, rel=10 * tolerance)


def test_guess_then_import_of_a_german_csv(folder: Path, original: dict) -> None:
    """The guessed map needs no change: names, units, sign and rate are found, the samples are those of the run."""
    guess = rig("import", "--guess", folder / "german.csv", "--json").json
    assert {name: entry["source"] for name, entry in guess["signals"].items()} == {
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
    answer = rig("import", folder / "run.mf4", "--map", folder / "mdf.toml", "--out", folder / "mdf.mcap",
                 "--json").json
    assert answer["format"].startswith("MDF 4") and answer["signals"]["p12"]["source"] == "pressure_a - pressure_b"
    trace, want = Trace.read(folder / "mdf.mcap"), Trace.read(folder / "original.csv")
    for name in SIGNALS:
        np.testing.assert_allclose(trace.column(name), want.column(name), rtol=1e-14,
                                   atol=1e-8 if name == "p12" else 0.0)  # 100 bar and back
    require_same_answer(folder / "mdf.mcap", original, 1e-9)


def test_blf_with_the_users_dbc(folder: Path, original: dict) -> None:
    answer = rig("import", folder / "log.blf", "--map", folder / "can.toml", "--dbc", folder / "user.dbc",
                 "--out", folder / "can.mcap", "--json").json
    assert answer["cycles"] == 1500 and answer["format"] == "CAN log, user.dbc"
    trace, want = Trace.read(folder / "can.mcap"), Trace.read(folder / "original.csv")
    for name, lsb in zip(SIGNALS, (1e-8, 1e-8, 1e-8, 10.0, 1e-9), strict=True):
        assert np.abs(trace.column(name) - want.column(name)).max() <= 0.5001 * lsb
    require_same_answer(folder / "can.mcap", original, 2e-3)


def test_guess_of_a_can_log(folder: Path) -> None:
    answer = rig("import", "--guess", folder / "log.blf", "--dbc", folder / "user.dbc", "--out", folder / "blf.toml",
                 "--json").json
    sources = {name: entry["source"] for name, entry in answer["signals"].items()}
    assert sources == {"time": "its own times", "com": "Demand.Target", "xj": "Ram.Stroke", "cor": "Valve.Current",
                       "p12": "Ram.DeltaP", "xs": "Valve.Spool"}


@pytest.mark.parametrize(("name", "package"), [("x.mf4", "asammdf"), ("x.parquet", "pyarrow")])
def test_a_missing_package_is_named(name: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (package, f"{package}.parquet"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"x")
    line = refuse("import", "--guess", tmp_path / name)
    assert f"the package {package}" in line and "pip install 'eha-rig[measure]'" in line


TIMED = '\n[time]\nsource = "t"' + MAP

BAD = {
    "missing column": (TIMED.replace('"xj"', '"xi"'), "signals.xj.source: expected a column of own.csv", "not 'xi'"),
    "unknown unit": (TIMED + 'unit = "mm"', "signals.cor.unit: expected one of A, mA, uA", "'mm'"),
    "raw unit": (TIMED + 'unit = "V"', "signals.cor.unit", "scale and offset"),
    "two signals of one column": (TIMED.replace('"cor"', '"xj"'), "signals.cor.source", "signals.xj has 'xj' already"),
    "wrong type": (TIMED + 'sign = "minus"', "signals.cor.sign: expected -1 or 1", "'minus'"),
    "unknown key": (TIMED + "sing = -1", "signals.cor.sing", "did you mean 'sign'?"),
    "unknown signal": (TIMED + "[signals.p21]\nsource = 'p12'", "signals.p21", "did you mean 'p12'?"),
    "no current": (TIMED.split("[signals.cor]")[0], "signals.cor: expected a table", "Cor"),
    "no time": (TIMED.replace("[time]\nsource", "[trace]\nperiod"), "trace.period: expected a number above 0 s", "'t'"),
    "not TOML": ("[time", "expected TOML;", ""),
    "column that goes back": (TIMED.replace('source = "t"', 'source = "com"'), "own.csv: com: expected times that grow",
                              "row 2"),
    "counter without rate": (TIMED.replace('source = "t"', 'source = "t"\nbits = 16'), "time: expected source and rate",
                             "counter"),
    "time that goes backwards": (TIMED, "own.csv: t: expected times that grow", "row 101 has 0.099 s after 0.1 s"),
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
