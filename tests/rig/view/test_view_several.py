"""`rig view --compare` and `rig view A B`: the recordings hold what `rig compare` and `rig diff` compute."""
from __future__ import annotations

import importlib.util
import json
import os
import signal
import socket
import time
import urllib.request
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from recording_rows import Rows, read_names, read_recording
from rig_command import finished, rig, started
from short_runs import build_command

from fdi.comparison.compare import compare
from fdi.comparison.run_differences import compare_runs
from fdi.report.numbers import format_ratio
from fdi.thresholds import NOISE_BAND_RATIO
from fdi.trace.trace import Trace
from plant import Model, simulate

pytestmark = pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="pip install 'eha-rig[view]'")
BIAS = "null_bias.current=1.5e-4"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """run.csv of a plant with a null bias, healthy.csv, and late.csv: the healthy one 0.25 s later."""
    folder = tmp_path_factory.mktemp("runs")
    for name, changes in (("run", {"null_bias.current": 1.5e-4}), ("healthy", {})):
        columns = simulate(Model().replace(changes), build_command()[:1200], None, 1, 100)
        Trace.from_columns(columns._asdict(), 1e-3, {}).write_csv(folder / f"{name}.csv")
    rows = np.loadtxt(folder / "healthy.csv", delimiter=",", comments="#", skiprows=1)
    head = (folder / "healthy.csv").read_text().splitlines()[0]
    late = np.vstack([np.tile(rows[:1], (250, 1)), rows])
    late[:, 0] = np.arange(len(late)) * 1e-3
    np.savetxt(folder / "late.csv", late, delimiter=",", header=head, comments="", fmt="%.12g")
    return folder


def read_values(rows: Rows, entity: str) -> np.ndarray:
    return np.array([value for _, value in rows[entity]], float)


@pytest.fixture(scope="module")
def compared(folder: Path) -> tuple[Path, str]:
    """The recording of `rig view --compare` with an added effect, and the verdict."""
    said = rig("view", folder / "run.csv", "--compare", "--set", BIAS, "--save", folder / "compare.rrd", "--json")
    assert said.status == 0 and said.err == ""
    return folder / "compare.rrd", said.json["verdict"]


def test_the_comparison_holds_measured_model_residual_and_floor(folder: Path, compared: tuple[Path, str]) -> None:
    rows = read_recording(compared[0])
    found = compare(Trace.read(folder / "run.csv"), Model().replace({"null_bias.current": 1.5e-4}))
    assert compared[1] == found.verdict and found.verdict != "MODEL_INCOMPLETE"
    for name, scale, shown in (("xj", 1e3, 1e6), ("p12", 1e-5, 1e-5), ("xs", 1e6, 1e6)):
        np.testing.assert_allclose(read_values(rows, f"/{name}/1_measured"), found.trace.column(name) * scale)
        np.testing.assert_allclose(read_values(rows, f"/{name}/3_model"), found.replay.model[name] * scale)
        residual = read_values(rows, f"/residual_{name}/2_model")
        np.testing.assert_allclose(residual, found.replay.residual[name] * shown)
        np.testing.assert_allclose(residual * scale / shown, read_values(rows, f"/{name}/1_measured")
                                   - read_values(rows, f"/{name}/3_model"), atol=1e-6)  # measured minus model
        floor = NOISE_BAND_RATIO * found.signals[name].floor.value * shown
        assert read_values(rows, f"/residual_{name}/3_floor_high") == pytest.approx([floor, floor])
        assert read_values(rows, f"/residual_{name}/3_floor_low") == pytest.approx([-floor, -floor])
    lane = [word for _, word in rows["/error_over_floor/model"] if word]
    assert lane == [format_ratio(place.ratio) for place in sorted(found.where, key=lambda place: place.t0)]


def test_before_the_change_is_the_model_without_the_added_effect(folder: Path, compared: tuple[Path, str]) -> None:
    rows, names = read_recording(compared[0]), read_names(compared[0])
    before = compare(Trace.read(folder / "run.csv"), Model())
    assert before.verdict == "MODEL_INCOMPLETE"
    np.testing.assert_allclose(read_values(rows, "/residual_xj/1_before"), before.replay.residual["xj"] * 1e6)
    np.testing.assert_allclose(read_values(rows, "/xs/2_before"), before.replay.model["xs"] * 1e6)
    assert names["/residual_xj/1_before"] == "before the change" and names["/xj/1_measured"] == "XJ measured"
    assert "/error_over_floor/before" in rows
    text = str(rows["/log/result"][0][1])
    assert f"### {compared[1]}" in text and "Before the change: MODEL_INCOMPLETE." in text


def test_before_a_model_file_is_the_file_without_its_effects(folder: Path, tmp_path: Path) -> None:
    said = rig("add", "null_bias", folder / "run.csv", "--out", tmp_path / "better.toml")
    assert said.status == 0
    said = rig("view", folder / "run.csv", "--compare", "--model", tmp_path / "better.toml", "--signals", "xs,p12",
               "--save", tmp_path / "x.rrd")
    assert said.status == 0 and said.err == ""
    rows = read_recording(tmp_path / "x.rrd")
    before = compare(Trace.read(folder / "run.csv"), Model(), signals=["xs", "p12"])
    np.testing.assert_allclose(read_values(rows, "/xs/2_before"), before.replay.model["xs"] * 1e6, atol=0.02)
    assert np.abs(read_values(rows, "/residual_xs/2_model")).mean() < 0.5 * np.abs(
        read_values(rows, "/residual_xs/1_before")).mean()
    assert not any(entity.startswith("/xj/") for entity in rows)


def test_without_a_change_there_is_no_before(folder: Path, tmp_path: Path) -> None:
    assert rig("view", folder / "healthy.csv", "--compare", "--save", tmp_path / "x.rrd").status == 0
    rows = read_recording(tmp_path / "x.rrd")
    assert not any("before" in entity for entity in rows) and "/residual_xj/1_model" in rows


def test_runs_are_overlaid_and_subtracted_on_the_time_of_the_first(folder: Path, tmp_path: Path) -> None:
    sources = [str(folder / f"{name}.csv") for name in ("healthy", "run", "late")]
    said = rig("view", *sources, "--save", tmp_path / "x.rrd", "--json")
    assert said.status == 0 and said.json["verdict"] == "DIFFERENT"
    rows, names = read_recording(tmp_path / "x.rrd"), read_names(tmp_path / "x.rrd")
    traces = [Trace.read(source) for source in sources]
    found = compare_runs(sources, traces)
    assert names["/xj/00_A"] == "A healthy.csv" and names["/difference_xj/01_B"] == "B - A"
    np.testing.assert_allclose(read_values(rows, "/xj/01_B"), traces[1].xj * 1e3)
    assert {round(t0 - t1, 6) for (t0, _), t1 in zip(rows["/xj/02_C"], traces[2].t, strict=True)} == {-0.25}
    for number, pair in enumerate(found.pairs, 1):
        for name, scale in (("xj", 1e6), ("p12", 1e-5), ("xs", 1e6)):
            entity = f"/difference_{name}/{number:02}_{pair.run.label}"
            np.testing.assert_allclose(read_values(rows, entity), pair.differences[name] * scale)
            np.testing.assert_allclose([t for t, _ in rows[entity]], pair.t, atol=1e-8)
    assert np.abs(read_values(rows, "/difference_xj/02_C")).max() < 1e-6  # um; C is A, later
    text = str(rows["/log/result"][0][1])
    assert "### DIFFERENT" in text and "B - A | XJ" in text and "aligned by the command" in text


@pytest.mark.parametrize(("words", "message"), [
    (["--compare", "--headless"], "--headless: expected --screenshot FILE.png with it"),
    (["other.csv", "--compare"], "--compare: other.csv: expected one trace; rig view A B holds traces against each "
                                 "other"),
    (["--model", "eha"], "--model: expected --compare with it"),
    (["--set", BIAS], "--set: expected --compare with it"),
    (["--repeat", "other.csv"], "--repeat: expected --compare with it"),
    (["--signals", "xj"], "--signals: expected --compare with it"),
    (["--seed", "0"], "--seed: expected --compare with it")])
def test_options_that_do_not_fit_are_one_line(folder: Path, words: list[str], message: str) -> None:
    said = rig("view", folder / "run.csv", *words)
    assert said.status == 2 and said.err == f"rig view: {message}\n"


def test_a_theme_is_served_for_a_browser_until_ctrl_c(folder: Path) -> None:
    """A script that notes the address stands in for a browser, which would open a window."""
    script, note = folder / "browser", folder / "address.txt"
    script.write_text(f'#!/bin/sh\nprintf %s "$1" > {note}.part\nmv {note}.part {note}\n')
    script.chmod(0o755)
    process = started("view", folder / "run.csv", "--theme", "light", "--json",
                      env={**os.environ, "BROWSER": f"{script} %s"})
    try:
        assert process.stdout is not None
        answer = json.loads(process.stdout.readline())
        address = urlsplit(answer["address"])
        assert address.hostname == "127.0.0.1" and parse_qs(address.query)["theme"] == ["light"]
        with urllib.request.urlopen(answer["address"]) as page:
            assert b"rerun" in page.read().lower()
        while not note.exists():
            time.sleep(0.05)
        assert note.read_text() == answer["address"]
        data = urlsplit(parse_qs(address.query)["url"][0])
        with socket.create_connection(("127.0.0.1", data.port or 0)):
            pass
    finally:
        process.send_signal(signal.SIGINT)
        said = finished(process)
    assert said.status == 0 and said.err == ""
    with socket.socket() as probe:  # the server is gone
        assert probe.connect_ex(("127.0.0.1", address.port or 0)) != 0


def test_a_theme_needs_a_browser(folder: Path) -> None:
    said = rig("view", folder / "run.csv", "--theme", "light", "--save", folder / "x.rrd")
    assert said.status == 2
    assert said.err == ("rig view: --theme: light: expected no --screenshot, --save or --out with it: they open no "
                        "browser\n")
