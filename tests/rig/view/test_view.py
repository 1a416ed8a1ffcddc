"""The viewer: the picture of a run, and recordings of `rig view --compare` and of several runs."""

import contextlib
import http.client
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
from matplotlib.image import imread
from recording_rows import Rows, read_names, read_recording
from rig_command import answer, finished, refuse, started
from short_runs import build_command

from fdi.comparison.compare import compare
from fdi.comparison.run_differences import compare_runs
from fdi.report.numbers import format_ratio
from fdi.thresholds import NOISE_BAND_RATIO
from fdi.trace.trace import Trace
from plant import Model, simulate
from rig.view import viewer
from rig.view.recording import COMMAND, DRIVE, LIMIT, MEASURED, OUTPUTS, draw_run, make_lane_path, write_recording
from rig.view.viewer import ViewerError

REQUIRED = os.environ.get("EHA_RIG_REQUIRE_VIEWER") == "1"  # forbids skips
pytestmark = pytest.mark.skipif(not REQUIRED and importlib.util.find_spec("rerun") is None,
                                reason="pip install 'eha-rig[view]'")
needs_driver = pytest.mark.skipif(
    not REQUIRED and not any(Path(place).glob("vulkan/icd.d/*.json") for place in ("/usr/share", "/etc")),
    reason="no Vulkan driver (Debian: apt-get install mesa-vulkan-drivers libvulkan1)")


@pytest.fixture(scope="module")
def trace(preflight: Path) -> Trace:
    return Trace.read(preflight, all=True)


def _rows(trace: Trace, path: Path) -> dict[str, list[tuple[float, object]]]:
    """What a recording of the trace holds: entity -> time, s (NaN: always), and value of each of its rows."""
    write_recording(draw_run(trace), path)
    return read_recording(path)


@pytest.fixture(scope="module")
def rows(trace: Trace, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[float, object]]]:
    return _rows(trace, tmp_path_factory.mktemp("rrd") / "x.rrd")


def test_recording_holds_every_line(trace: Trace, rows: dict[str, list[tuple[float, object]]]) -> None:
    drawn = {"/position/command": trace.com * 1e3, "/position/ram": trace.xj * 1e3, "/current/current": trace.cor * 1e3,
             "/error/error": (trace.com - trace.xj) * 1e6, "/pressure/pressure": trace.p12 / 1e5,
             "/spool/spool": trace.xs * 1e6, "/timing/response": trace.timing.response * 1e6,
             "/timing/work": trace.timing.work * 1e6}
    for entity, values in drawn.items():
        np.testing.assert_allclose(rows[entity], np.column_stack([trace.t, values]), rtol=1e-9, atol=1e-8)


def test_recording_holds_every_limit(rows: dict[str, list[tuple[float, object]]]) -> None:
    """Of preflight: error at rest (14th check), position and pressure; low and high, over the window."""
    limits = {entity: values for entity, values in rows.items() if "limit" in entity}
    assert {entity: [(round(t, 6), round(float(str(value)), 6)) for t, value in values]
            for entity, values in limits.items()} == {
        "/error/limit_13_high": [(13.2, 29.0), (13.5, 29.0)], "/error/limit_13_low": [(13.2, -29.0), (13.5, -29.0)],
        "/position/limit_14_high": [(0.0, 6.0), (13.5, 6.0)], "/position/limit_14_low": [(0.0, -6.0), (13.5, -6.0)],
        "/pressure/limit_15_high": [(0.0, 40.0), (13.5, 40.0)], "/pressure/limit_15_low": [(0.0, -40.0), (13.5, -40.0)]}


def test_recording_holds_every_lane(trace: Trace, rows: dict[str, list[tuple[float, object]]]) -> None:
    lanes = {entity: values for entity, values in rows.items() if entity.split("/")[1] in ("run", "node", "check")}
    assert lanes.pop("/run/verdict") == [(-0.5, "PASS")]
    assert lanes.pop("/run/phase") == [(-0.5, "set-up"), (0.0, "main"), (13.5, "clean-up")]
    assert [str(word).split()[0] for _, word in lanes.pop("/run/command")] == [s.kind for s in trace.sections()]
    for node in ("2_controller", "3_plant"):
        times, words = zip(*lanes.pop(f"/node/{node}"), strict=True)
        assert (words[0], words[-1]) == ("boot-up", "operational") and times[-1] < 0
        assert words.count("boot-up") == words.count("operational") == 3  # the probes begin with a reset as well
    assert len(lanes) == len(trace.sequence_checks) == 17
    for check in trace.sequence_checks:
        states = lanes[make_lane_path(f"/check/pass/{check.name}")]
        (window,) = [k for k, (t, word) in enumerate(states) if t == pytest.approx(check.t0) and word]
        assert states[window + 1][0] == pytest.approx(check.t1)
        (text,) = {str(word) for _, word in states} - {"", "PASS"}  # beside a short window, in a long one
        assert text.startswith(f"PASS {check.value:.4g}") and "(limit " in text
        assert (str(states[window][1]) == text) == (check.t1 - check.t0 > 0.5 * (trace.t[-1] - trace.t[0]))


def test_recording_holds_every_event_and_check(trace: Trace, rows: dict[str, list[tuple[float, object]]]) -> None:
    times, texts = zip(*rows["/log/events"], strict=True)
    assert times == pytest.approx([event.t for event in trace.events]) and len(times) > 15
    assert all(f"{event.kind}: {event.text}" in str(text) for event, text in zip(trace.events, texts, strict=True))
    checks = [str(text) for _, text in rows["/log/checks"]]
    assert len(checks) == len(trace.checks) == 29
    assert all(any(f"PASS {c.name}: {c.value:.4g}" in text for text in checks) for c in trace.checks)
    assert "- sequence: Preflight" in str(rows["/log/provenance"][0][1])


@needs_driver
def test_headless_screenshot_shows_lines_limits_and_lanes(trace: Trace, tmp_path: Path) -> None:
    write_recording(draw_run(trace), tmp_path / "view.rrd")
    viewer.take_screenshot(tmp_path / "view.rrd", tmp_path / "view.png")
    shades = (imread(tmp_path / "view.png")[..., :3] * 255).astype(int)
    for colour in (COMMAND, MEASURED, LIMIT, DRIVE, *OUTPUTS[1:3]):
        channels = np.array([colour >> shift & 0xFF for shift in (24, 16, 8)])
        assert (np.abs(shades - channels).max(axis=2) < 24).sum() > 500, f"{colour:08X}"


def test_viewer_that_cannot_draw_says_so(tmp_path: Path) -> None:
    (tmp_path / "x.rrd").write_bytes(b"")
    with pytest.raises(ViewerError, match="does not draw"):
        viewer.take_screenshot(tmp_path / "x.rrd", tmp_path / "x.png", patience=3)


def test_without_a_display_one_line_says_so_and_the_viewer_listens_on_this_machine_only(
        monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ViewerError, match="no display"):
        viewer.open_viewer(Path("x.rrd"))
    words = viewer.make_viewer_command(9999)
    assert words[words.index("--bind") + 1] == "127.0.0.1"


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
    told = answer("view", folder / "run.csv", "--compare", "--set", BIAS, "--out", folder / "compare.rrd")
    return folder / "compare.rrd", told["verdict"]


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
    before, text = compare(Trace.read(folder / "run.csv"), Model()), str(rows["/log/result"][0][1])
    np.testing.assert_allclose(read_values(rows, "/residual_xj/1_before"), before.replay.residual["xj"] * 1e6)
    np.testing.assert_allclose(read_values(rows, "/xs/2_before"), before.replay.model["xs"] * 1e6)
    assert (names["/residual_xj/1_before"], names["/xj/1_measured"]) == ("before the change", "XJ measured")
    assert "/error_over_floor/before" in rows
    assert text.startswith(f"```text\n{compared[1]}") and "Before the change:\n\n```text\nMODEL_INCOMPLETE" in text


def test_runs_are_overlaid_and_subtracted_on_the_time_of_the_first(folder: Path, tmp_path: Path) -> None:
    sources = [str(folder / f"{name}.csv") for name in ("healthy", "run", "late")]
    assert answer("view", *sources, "--out", tmp_path / "x.rrd")["verdict"] == "DIFFERENT"
    rows, names = read_recording(tmp_path / "x.rrd"), read_names(tmp_path / "x.rrd")
    traces = [Trace.read(source) for source in sources]
    found = compare_runs(sources, traces)
    assert names["/xj/00_A"] == "A healthy.csv" and names["/difference_xj/01_B"] == "B - A"
    np.testing.assert_allclose(read_values(rows, "/xj/01_B"), traces[1].xj * 1e3)
    assert {round(t0 - t1, 6) for (t0, _), t1 in zip(rows["/xj/02_C"], traces[2].t, strict=True)} == {-0.25}
    for number, pair in enumerate(found.pairs, 1):
        for name, scale in (("xj", 1e6), ("p12", 1e-5), ("xs", 1e6)):
            drawn = rows[f"/difference_{name}/{number:02}_{pair.run.label}"]
            np.testing.assert_allclose(drawn, np.column_stack([pair.t, pair.differences[name] * scale]), atol=1e-8)
    assert np.abs(read_values(rows, "/difference_xj/02_C")).max() < 1e-6  # um; C is A, later
    text = str(rows["/log/result"][0][1])
    assert "DIFFERENT" in text and "B - A  XJ" in text and "aligned by the command" in text


@pytest.mark.parametrize(("words", "message"), [
    (["--out", "x.mcap"], "--out: x.mcap: expected FILE.rrd or FILE.png"),
    (["other.csv", "--compare"], "--compare: other.csv: expected one trace; rig view A B holds traces against each "
                                 "other"),
    (["--theme", "light", "--out", "x.rrd"], "--theme: light: expected no --out with it: it opens no browser"),
    (["--set", BIAS], "--set: expected --compare with it"),
    (["--repeat", "other.csv"], "--repeat: expected --compare with it"),
    (["--signals", "xj"], "--signals: expected --compare with it"),
    (["--seed", "0"], "--seed: expected --compare with it")])
def test_options_that_do_not_fit_are_one_line(folder: Path, words: list[str], message: str) -> None:
    assert refuse("view", folder / "run.csv", *words) == f"rig view: {message}\n"


def test_a_theme_is_served_for_a_browser_until_ctrl_c(folder: Path) -> None:
    """A script that notes the address stands in for a browser, which would open a window."""
    script, note = folder / "browser", folder / "address.txt"
    script.write_text(f'#!/bin/sh\nprintf %s "$1" > {note}.part\nmv {note}.part {note}\n')
    script.chmod(0o755)
    process = started("view", folder / "run.csv", "--theme", "light", "--json",
                      env={**os.environ, "BROWSER": f"{script} %s"})
    try:
        assert process.stdout is not None
        place = json.loads(process.stdout.readline())["address"]
        address = urlsplit(place)
        assert address.hostname == "127.0.0.1" and parse_qs(address.query)["theme"] == ["light"]
        with urllib.request.urlopen(place) as page:
            assert b"rerun" in page.read().lower()
        while not note.exists():
            time.sleep(0.05)
        assert note.read_text() == place
        data = urlsplit(parse_qs(address.query)["url"][0])
        with socket.create_connection(("127.0.0.1", data.port or 0)):
            pass
    finally:
        process.send_signal(signal.SIGINT)
        said = finished(process)
    assert said.status == 0 and said.err == ""
    # not "nothing listens there": another program may have been given the port at once
    with contextlib.suppress(OSError, http.client.HTTPException), urllib.request.urlopen(place, timeout=5) as page:
        assert b"rerun" not in page.read().lower(), "the server is still there"
