"""The picture of a real run: no view with an error, every line, lane and text to be seen.

EHA_RIG_REQUIRE_VIEWER=1 forbids skips.
"""
from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recording_rows import read_recording
from rig_command import rig
from synthetic_run import record_run

from fdi.trace.trace import Trace
from rig.view import viewer
from rig.view.recording import TEXTS, Lane, make_lane_path, write_recording
from rig.view.rerun_log import LANES, LIMITS, PLOTS, draw_run
from rig.view.viewer import ViewerError

REQUIRED = os.environ.get("EHA_RIG_REQUIRE_VIEWER") == "1"


def _missing() -> str:
    if importlib.util.find_spec("rerun") is None:
        return "no rerun: pip install 'eha-rig[view]'"
    folders = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]
    if not any(folder.glob("*.json") for folder in folders if folder.is_dir()):
        return "no Vulkan driver (Debian: apt-get install mesa-vulkan-drivers libvulkan1)"
    return ""


@pytest.fixture(scope="module")
def trace(preflight: Path) -> Trace:
    return Trace.read(preflight, all=True)


def _rows(trace: Trace, path: Path) -> dict[str, list[tuple[float, object]]]:
    """What a recording of the trace holds: entity -> time, s (NaN: always), and value of each of its rows."""
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("no rerun: pip install 'eha-rig[view]'")
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
        np.testing.assert_allclose([value for _, value in rows[entity]], values, rtol=1e-9)
        np.testing.assert_allclose([t for t, _ in rows[entity]], trace.t, atol=1e-8)


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
        states = lanes.pop(f"/node/{node}")
        words = [word for _, word in states]  # the probes begin with a reset as well
        assert words[0] == "boot-up" and words[-1] == "operational" and states[-1][0] < 0
        assert words.count("boot-up") == words.count("operational") == 3
    assert len(lanes) == len(trace.sequence_checks) == 17
    for check in trace.sequence_checks:
        states = lanes[make_lane_path(f"/check/pass/{check.name}")]
        (window,) = [k for k, (t, word) in enumerate(states) if t == pytest.approx(check.t0) and word]
        assert states[window + 1][0] == pytest.approx(check.t1)
        (text,) = {str(word) for _, word in states} - {"", "PASS"}  # beside a short window, in a long one
        assert text.startswith(f"PASS {check.value:.4g}") and "≤" in text
        assert (str(states[window][1]) == text) == (check.t1 - check.t0 > 0.5 * (trace.t[-1] - trace.t[0]))


def test_recording_holds_faults_and_load(tmp_path: Path) -> None:
    sequence = tmp_path / "faults.toml"
    sequence.write_text("""title = "Faults"
setup = [{ kind = "hold", time = 0.1 }]
main = [{ kind = "hold", time = 0.5 }]
load = [{ kind = "ramp", to = 500.0, time = 0.2 }]
faults = [{ name = "offset of XS / small", kind = "offset", signal = "xs", value = 1e-6, start = 0.1, end = 0.3 },
          { kind = "parameter", parameter = "filter.clogging", value = 0.4, start = 0.2 }]
""")
    rig("run", sequence, "--out", tmp_path / "run")
    trace = Trace.read(tmp_path / "run", all=True)
    rows = _rows(trace, tmp_path / "x.rrd")
    assert {entity: [(round(t, 6), word) for t, word in states] for entity, states in rows.items()
            if entity.startswith("/fault/")} == {
        "/fault/offset_of_XS_small": [(0.1, "active"), (0.3, "")],
        "/fault/parameter_filter.clogging": [(0.2, "active")]}
    np.testing.assert_allclose([value for _, value in rows["/load/load"]], trace.load, atol=1e-9)
    assert trace.load.max() == 500.0
    assert "Load on the ram [N]" in {view.title for view in draw_run(trace).shown}


def test_recording_holds_every_event_and_check(trace: Trace, rows: dict[str, list[tuple[float, object]]]) -> None:
    events = rows["/log/events"]
    assert len(events) == len(trace.events) > 15
    assert [t for t, _ in events] == pytest.approx([event.t for event in trace.events])
    for event, (_, text) in zip(trace.events, events, strict=True):
        assert f"{event.kind}: {event.text}" in str(text)
    texts = [str(text) for _, text in rows["/log/checks"]]
    assert len(texts) == len(trace.checks) == 29 and all(any(f"PASS {c.name}: {c.value:.4g}" in text for text in texts)
                                    for c in trace.checks)
    assert "- sequence: Preflight" in str(rows["/log/provenance"][0][1])


def test_recording_of_an_aborted_run(aborted: Path, tmp_path: Path) -> None:
    rows = _rows(Trace.read(aborted, all=True), tmp_path / "x.rrd")
    assert rows["/run/verdict"] == [(-0.3, "ABORTED: guard 'ram far out' was passed by xj")]
    failed = {entity.removeprefix("/check/FAIL/"): [(round(t, 3), word) for t, word in values]
              for entity, values in rows.items() if entity.startswith("/check/FAIL/")}
    assert failed == {
        "ramp_error": [(0, "FAIL not measured: the run ended at 2.271 s, the window at 3.5 s"), (2.271, "")],
        "gain_1_Hz": [(0, "FAIL not measured: the run ended at 2.271 s, the window at 5.5 s"), (2.271, "")],
        "lag_1_Hz": [(0, "FAIL not measured: the run ended at 2.271 s, the window at 5.5 s"), (2.271, "")],
        "spool": [(0, "FAIL not measured: 300 of 2271 samples of xs are missing"), (2.271, "")]}
    assert np.isnan([float(str(value)) for _, value in rows["/spool/spool"]]).sum() == 300
    assert not any("nan" in str(text) for _, text in rows["/log/checks"])


def test_headless_screenshot_shows_everything(trace: Trace, tmp_path: Path,
                                              capsys: pytest.CaptureFixture[str]) -> None:
    missing = _missing()
    if missing and not REQUIRED:
        pytest.skip(missing)
    assert not missing
    write_recording(draw_run(trace), tmp_path / "view.rrd")
    pixels = viewer.take_screenshot(draw_run(trace).shown, tmp_path / "view.rrd", tmp_path / "view.png")
    plots = {title for origin, title in PLOTS if origin != "load"}
    assert {*pixels} == {*plots, LANES, TEXTS, LIMITS}
    assert (tmp_path / "view.png").stat().st_size > 50_000
    assert pixels[LANES] > 20_000 and pixels[TEXTS] > 200
    assert pixels[LIMITS] > 600  # at least the two lines of the position
    with capsys.disabled():
        print("\nviewer:", ", ".join(f"{name} {count} px" for name, count in pixels.items()))


def test_screenshot_misses_what_is_not_drawn(trace: Trace, tmp_path: Path) -> None:
    missing = _missing()
    if missing and not REQUIRED:
        pytest.skip(missing)
    drawing = draw_run(trace)
    write_recording(drawing._replace(lanes=[Lane("run/x", [], {})], log=[]), tmp_path / "view.rrd")
    with pytest.raises(ViewerError) as caught:
        viewer.take_screenshot(drawing.shown, tmp_path / "view.rrd", tmp_path / "view.png")
    assert str(caught.value).endswith(f"empty views: {LANES}, {TEXTS}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("run") / "trace.mcap", stop=1000).parent


def test_viewer_that_cannot_draw_says_so(folder: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("no rerun")
    (tmp_path / "x.rrd").write_bytes(b"")
    trace = Trace.read(folder)
    with pytest.raises(ViewerError, match="does not draw"):
        viewer.take_screenshot(draw_run(trace).shown, tmp_path / "x.rrd", tmp_path / "x.png", patience=3)


def test_without_rerun_one_line_says_how_to_get_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ViewerError, match=r"pip install 'eha-rig\[view\]'"):
        write_recording(draw_run(Trace.read(folder)), folder / "none.rrd")


def test_without_a_display_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("rerun") is None or sys.platform != "linux":
        pytest.skip("no rerun, or no Linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match="no display"):
        viewer.open_viewer(Path("x.rrd"))


def test_it_listens_on_this_machine_only() -> None:
    words = viewer.make_viewer_command(9999)
    assert words[words.index("--bind") + 1] == "127.0.0.1"


def test_command(folder: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("no rerun")
    words = [sys.executable, "-m", "rig.cli.main", "view", str(folder), "--save", str(tmp_path / "x.rrd")]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == f"{tmp_path / 'x.rrd'}\n", done.stderr
    done = subprocess.run([*words, "--headless"], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr == "rig view: --headless: expected --screenshot FILE.png with it\n"
