"""`rig view` and its recordings of one run and several; `rig run --live`: the log while it grows, screen, viewer."""

import fcntl
import importlib.util
import json
import math
import os
import pty
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import termios
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from matplotlib.image import imread
from recording_rows import Rows, read_names, read_recording
from refusals import catch_refusal
from rig_command import answer, finished, gone, grown, interrupted, nodes_on, refuse, rig, started, write_file
from short_runs import build_command, simulate_trace
from synthetic_run import build_cycles, record_run

from fdi.comparison.compare import compare
from fdi.comparison.run_differences import compare_runs
from fdi.report import format_ratio
from fdi.thresholds import NOISE_BAND_RATIO
from fdi.trace import CheckResult, Trace
from plant import Model, find_plant
from rig.benches import load_bench
from rig.recorder import Event, NmtState, Record, Signals, Timing, make_row_record
from rig.sequences import load_sequence
from rig.view import viewer
from rig.view.live_process import find_viewer_place
from rig.view.live_run import LiveRun, make_live_plan
from rig.view.live_show import describe_line, draw_screen, follow_log
from rig.view.recording import COMMAND, DRIVE, LIMIT, MEASURED, OUTPUTS, draw_run, make_lane_path, write_recording
from rig.view.viewer import ViewerError, find_free_port, is_listening


def test_every_record_arrives_once_and_in_order_while_the_log_grows(tmp_path: Path) -> None:
    """From before the log is there, in any pieces, and although it is moved; nothing more when it is whole."""
    whole = record_run(tmp_path / "whole.mcap", stop=1000).read_bytes()
    log, moved_log = tmp_path / "trace.mcap", tmp_path / "moved.mcap"
    batches = follow_log(log)
    records = next(batches)
    with log.open("wb", buffering=0) as file:
        for start in range(0, len(whole), 30_000):
            file.write(whole[start:start + 30_000])
            records += next(batches)
            if start == 60_000:
                log.rename(moved_log)
    assert next(batches) == []
    cycle_records = [record for _, _, *rows in build_cycles() if rows[0].cycle < 1000 for record in rows]
    assert list(map(repr, cycle_records)) == [
        repr(record) for _, record in records if isinstance(record, Signals | Timing)]
    trace = Trace.read(moved_log, all=True)
    assert [record.text for _, record in records if isinstance(record, Event)] == [event.text for event in trace.events]
    assert {type(record) for _, record in records} == {Signals, Timing, Event, NmtState, CheckResult}


Records = list[tuple[int, Record]]


def make_run(preflight: Path) -> tuple[LiveRun, Records, Trace]:
    """A live run of preflight and all its cycles, from the log of a run that has ended."""
    records = [(t_ns, record) for t_ns, record in next(follow_log(preflight / "trace.mcap"))
               if isinstance(record, Signals | Timing)]
    plan = make_live_plan(load_sequence("preflight"), "lockstep", load_bench())
    return LiveRun(plan), records, Trace.read(preflight, all=True)


def add(run: LiveRun, records: Records) -> None:
    for t_ns, record in records:
        run.add(t_ns, record)
    run.judge_checks()


def test_checks_turn_when_their_window_is_over(preflight: Path) -> None:
    run, records, trace = make_run(preflight)
    final = {check.name: check for check in trace.checks}
    words: dict[str, list[str]] = {name: [] for name in run.checks}
    main = int(np.argmax(trace.phase == 1))
    for first in range(0, len(records) // 2, 250):
        add(run, records[2 * first:2 * first + 500])
        for name, state in run.checks.items():
            if words[name][-1:] != [state.word]:
                words[name].append(state.word)
            check = final[name]
            if state.word == "PASS" and not np.isnan(check.t1):
                assert first + 250 >= main + round(1000 * check.t1) - 250, name
    assert words["overshoot, 5 mm"] == words["position"] == ["waits", "measures", "PASS"]
    for name, state in run.checks.items():
        assert state.word == ("PASS" if final[name].passed else "FAIL"), name
        np.testing.assert_allclose(state.result.value, final[name].value, rtol=1e-9, err_msg=name)


def test_a_limit_that_is_passed_fails_at_once(preflight: Path) -> None:
    run, records, _ = make_run(preflight)
    t_ns, signals = records[4000]
    records[4000] = t_ns, replace(signals, xj=7e-3)  # type: ignore[call-arg]  # the limit is 6 mm for all of main
    add(run, records[:8000])
    assert (run.checks["position"].word, run.checks["position"].measured) == ("FAIL", " 7 mm")
    assert run.checks["pressure, unloaded"].word == "measures"
    assert run.read_rows_from(0).shape == (4000, len(run.plan.columns)) and run.read_last("xj", 2000)[0] == 7e-3


def test_rows_of_another_plant_are_shown() -> None:
    """Their records are of a type of its own."""
    signals = find_plant("ema").signals
    run = LiveRun(make_live_plan(load_sequence("preflight"), "lockstep", load_bench())._replace(signals=signals))
    run.add(0, make_row_record(signals)(0, 1, *[0.5] * (len(signals.names)), 0, 0, 0))
    run.add(0, Timing(0, False, 0.0, 0.0, 0.0))
    assert run.cycles == 1 and run.read_last(signals.controlled.name, 1)[0] == 0.5


EVENTS = """title = "Events"
setup = [{ kind = "hold", time = 0.02 }]
main = [{ name = "rest", kind = "hold", time = 0.1 }, { name = "more", kind = "hold", time = 0.1 }]
checks = [{ name = "begins", kind = "event_occurs", event = "phase main", window = "rest" },
          { name = "no fault", kind = "event_never", event = "fault early", window = "rest" },
          { name = "answer", kind = "response_within", event = "fault early", after = 0.0, high = 1, window = "rest" },
          { name = "first cycle", kind = "event_occurs", event = "guard first", window = "more" }]
"""


@pytest.mark.parametrize("begin_ns", [0, *range(1_800_000_000_000_000_000, 1_800_000_000_000_000_256, 51)])
def test_events_stand_at_their_cycle(begin_ns: int, tmp_path: Path) -> None:
    """Those written before the first row of main too, and whatever the log times: a float64 rounds ns since 1970."""
    sequence = load_sequence(write_file(tmp_path / "events.toml", EVENTS))
    run = LiveRun(make_live_plan(sequence, "lockstep", load_bench()))
    events = {0: [Event("INFO", "phase", "set-up")], 120: [Event("INFO", "guard", "first")],
              20: [Event("INFO", "phase", "main"), Event("WARN", "fault", "early")]}
    for cycle in range(220):
        t_ns = begin_ns + cycle * 1_000_000
        for event in events.get(cycle, []):
            run.add(t_ns, event)
        run.add(t_ns, Signals(cycle, int(cycle >= 20), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 7, 15, 0))
        run.add(t_ns, Timing(cycle, False, 0.0, 0.0, 0.0))
    run.judge_checks()
    assert [event.t for event in run.events] == [-0.02, 0.0, 0.0, 0.1] and run.t == 0.199
    assert [(state.word, state.measured) for state in run.checks.values()] == [
        ("PASS", " 1"), ("FAIL", " 1"), ("PASS", " 0 s"), ("PASS", " 1")]


@pytest.mark.parametrize("size", [(80, 24), (60, 20), (200, 60)])
def test_screen_fits(preflight: Path, size: tuple[int, int]) -> None:
    run, records, _ = make_run(preflight)
    run.add(0, NmtState(2, 5, "operational"))
    before = draw_screen(run, *size, silence=0.0).plain
    add(run, records[:6000])
    run.add(0, Event("ERROR", "process", "node 3 plant: its process was ended by SIGKILL"))
    run.add(0, CheckResult(name="no emergency", passed=False, value=2.0, unit="1", signal=""))
    text = draw_screen(run, *size, silence=1.2).plain
    lines = text.split("\n")
    assert len(lines) <= size[1] and max(map(len, lines)) <= size[0]
    for words in ("node 2 controller operational", "node 3 plant      DEAD: its process was ended by SIGKILL",
                  "no new cycle in the log", "FAIL     no emergency 2", "measures", "lockstep: no cycle is late",
                  "response p50", "overruns 0"):
        assert words in text, words
    dots = sum(0x2800 < ord(letter) < 0x2900 for letter in text)
    assert dots > size[0] // 2 > sum(0x2800 < ord(letter) < 0x2900 for letter in before)
    assert "3 plant its process" not in describe_line(run) and "3 its process was ended" in describe_line(run)


RUN = [sys.executable, "-m", "rig.cli.main", "run"]
WATCHED = """
title = "Watched"
main = [
  { name = "step", kind = "step", to = 1e-3, time = 0.2 },
  { name = "sine", kind = "sine", amplitude = 1e-3, frequency = 1.0, time = 600 },
]
checks = [
  { name = "overshoot", kind = "overshoot", window = "step", high = 100.0 },
  { name = "position", kind = "never_exceeds", signal = "xj", high = 20, unit = "mm" },
]
"""
LONG = 'title = "Long"\nmain = [{ name = "rest", kind = "hold", time = 600 }]\n'


def run_in_terminal(words: list[str], watch: Callable[[str, int], None] = lambda *_: None) -> tuple[str, int]:
    """Everything that `rig run` writes to a terminal of 80 x 24, and its exit status."""
    number, fd = pty.fork()
    if number == 0:  # pragma: no cover
        os.environ["TERM"] = "xterm-256color"
        os.execv(sys.executable, [*RUN, *words])
    fcntl.ioctl(fd, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    text = b""
    while True:
        if select.select([fd], [], [], 1.0)[0]:
            try:
                data = os.read(fd, 65536)
            except OSError:
                break
            text += data
        watch(text[-200_000:].decode(errors="replace"), number)
    return text.decode(errors="replace"), os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])


def split_frames(text: str) -> list[str]:
    """The screens that were drawn, without colours."""
    return [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", frame).replace("\r", "") for frame in text.split("\x1b[H")]


SHOWN = {"nodes": r"node 2 controller operational|node 3 plant      operational", "measures": r"measures +([a-z]+)",
         "passed": r"PASS {2,}([a-z]+)", "response": r"response p50 \d+ p99 \d+ max \d+ us"}


def test_screen_follows_the_run_and_ctrl_c_restores_the_terminal(tmp_path: Path) -> None:
    """A run that lasts until all of it was seen, however slowly the screen is drawn."""
    sequence = write_file(tmp_path / "watched.toml", WATCHED)
    sightings: dict[str, set[str]] = {name: set() for name in ("plot", *SHOWN)}
    interrupts: list[int] = []

    def look(text: str, number: int) -> None:
        for frame in split_frames(text)[1:]:
            if "Position [mm]" not in frame:
                continue
            sightings["plot"].add("".join(letter for letter in frame if 0x2800 < ord(letter) < 0x2900))
            for name, pattern in SHOWN.items():
                sightings[name] |= set(re.findall(pattern, frame))
        is_complete = len(sightings["plot"]) >= 3 and len(sightings["nodes"]) == 2 and all(sightings.values())
        if is_complete and not interrupts:
            interrupts.append(number)
            os.kill(number, signal.SIGINT)

    text, status = run_in_terminal([str(sequence), "--live", "--out", str(tmp_path / "run")], look)
    for begin, end in (("\x1b[?1049h", "\x1b[?1049l"), ("\x1b[?25l", "\x1b[?25h")):  # another screen, no cursor
        assert text.rindex(end) > text.rindex(begin)
    assert text.index("\x1b[?1049l") < text.index("ABORTED") and (tmp_path / "run" / "verdict.json").exists()
    assert interrupts and status == 130, {name: sorted(each)[:2] for name, each in sightings.items()}
    assert ("overshoot" in sightings["passed"] and "position" in sightings["measures"]
            and "position" not in sightings["passed"])


def test_lines_without_a_terminal(tmp_path: Path) -> None:
    sequence = write_file(tmp_path / "events.toml", EVENTS)
    result = finished(started("run", sequence, "--live", "--json", "--out", tmp_path / "run"))
    lines = result.err.splitlines()
    assert result.status == 1 and result.out.startswith("{") and "live" not in result.out
    assert lines[0] == "live: standard error is no terminal: a line every 2 s instead of the screen"
    assert re.search(r"checks \d+ pass, [1-9] fail of \d+; lockstep: no cycle is late; nodes: 2 operational", lines[-1])


def test_dead_node_is_announced_before_the_run_ends(tmp_path: Path) -> None:
    """The plant's process is killed; the line comes while the rig is still at work on its clean-up of 4000 cycles."""
    sequence = write_file(tmp_path / "long.toml", LONG + 'cleanup = [{ kind = "hold", time = 4 }]\n')
    group = f"udp_multicast:239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        run = started("run", sequence, "--bus", group, "--out", folder)
        if grown(folder / "trace.mcap", 300_000, run):  # well into main
            break
    else:
        pytest.skip(f"not measured: on this machine each of three runs ended by itself, the last one: {finished(run)}")
    plant = next(number for number in nodes_on(group) if b"plant" in Path(f"/proc/{number}/cmdline").read_bytes())
    os.kill(plant, signal.SIGKILL)
    assert run.stderr.readline() == "rig run: node 3 plant: its process was ended by SIGKILL\n"
    assert run.poll() is None  # its report is still to come
    result = finished(run)
    cause = json.loads((folder / "verdict.json").read_text())["cause"]
    assert "ABORTED" in result.out and result.status == 1 and "SIGKILL" in cause["text"]
    assert (cause["source"], cause["kind"]) == ("node 3 plant", "stopped") and gone(group)


@pytest.mark.parametrize(("words", "line"), [
    (("preflight", "lost_sync", "--live"), "--live: expected one sequence; runs of a suite run side by side"),
    (("--live", "absent.toml"), "absent.toml")])  # a word after --live may be a sequence
def test_what_is_not_shown(words: tuple[str, ...], line: str, tmp_path: Path) -> None:
    assert line in refuse("run", *words, "--out", tmp_path / "runs")


REQUIRED = os.environ.get("EHA_RIG_REQUIRE_VIEWER") == "1"  # forbids skips
needs_viewer = pytest.mark.skipif(not REQUIRED and importlib.util.find_spec("rerun") is None,
                                  reason="pip install 'eha-rig[view]'")
SHORT = """title = "Short"
setup = [{ kind = "hold", time = 0.2 }]
main = [{ name = "rest", kind = "hold", time = 0.3 }, { name = "out", kind = "step", to = 1e-3, time = 0.5 }]
load = [{ kind = "ramp", to = 100.0, time = 0.5 }]
faults = [{ kind = "parameter", parameter = "filter.clogging", value = 0.4, start = 0.2 }]
checks = [{ name = "position", kind = "never_exceeds", signal = "xj", high = 6, unit = "mm" },
          { name = "too small", kind = "never_exceeds", signal = "xj", high = 0.1, unit = "mm" }]
"""


@needs_viewer
def test_what_arrives_is_what_the_log_holds(tmp_path: Path) -> None:
    short = write_file(tmp_path / "short.toml", SHORT)
    result = rig("run", short, "--live", f"rerun:{tmp_path}/live.rrd", "--out", tmp_path / "run")
    assert result.status == 1 and result.err == "" and "too small" in result.out
    rows, trace = read_recording(tmp_path / "live.rrd"), Trace.read(tmp_path / "run", all=True)
    for entity, values in (("/position/ram", trace.xj * 1e3), ("/spool/spool", trace.xs * 1e6),
                           ("/load/load", 1e-3 * trace.load)):
        np.testing.assert_allclose(rows[entity], np.column_stack([trace.t, values]), atol=1e-6, rtol=1e-9)
    assert [state for _, state in rows["/run/phase"]] == ["set-up", "main"] and trace.load.max() == 100.0
    assert rows["/run/phase"][1][0] == pytest.approx(0.0, abs=1e-6)
    assert {entity: str(states[-1][1])[:4] for entity, states in rows.items() if entity.startswith("/check/")} == {
        "/check/position": "PASS", "/check/too_small": "FAIL"}
    assert [(round(t, 6), state) for t, state in rows["/fault/parameter_filter.clogging"]] == [(0.2, "active")]
    assert "operational" in {state for _, state in rows["/node/2_controller"]}
    assert len(rows["/log/checks"]) == len(trace.checks) and len(rows["/log/events"]) == len(trace.events)
    assert not any(math.isnan(t) for t, _ in rows["/log/events"])


@needs_viewer
def test_the_run_goes_on_when_the_viewer_is_closed(tmp_path: Path) -> None:
    long, port = write_file(tmp_path / "long.toml", LONG), find_free_port()
    server = subprocess.Popen([sys.executable, "-m", "rerun", "--serve-grpc", "--bind", "127.0.0.1", "--port",
                               str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    log = tmp_path / "run" / "trace.mcap"
    try:
        while not is_listening(port):
            assert server.poll() is None
        run = started("run", long, "--live", f"rerun:{port}", "--quiet", "--out", tmp_path / "run")
        assert grown(log, 100_000, run)  # well into main
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()
    assert run.stderr.readline() == "rig run: the viewer was closed; the run goes on\n"
    assert grown(log, log.stat().st_size + 100_000, run)
    assert interrupted(run).status == 130 and (tmp_path / "run" / "verdict.json").exists()


@pytest.mark.parametrize(("status", "words"), [(2, ["run", "--live", "rerun", "--out", "run"]),
                                               (1, ["view", "trace.mcap", "--out", "x.rrd"])])
def test_without_the_viewer_one_line_says_how_to_get_it(status: int, words: list[str], here: Path,
                                                        monkeypatch: pytest.MonkeyPatch) -> None:
    record_run(here / "trace.mcap", stop=400)
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = rig(*words)
    assert (result.status, result.err.count("\n")) == (status, 1) and "pip install 'eha-rig[view]'" in result.err
    assert [path.name for path in here.iterdir()] == ["trace.mcap"]


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@needs_viewer
@pytest.mark.usefixtures("no_display")
@pytest.mark.parametrize("word", ["rerun", "rerun:x", "rerun:0", "rerun:/absent/live.rrd", "rerun:{port}"])
def test_places_that_cannot_be_used(word: str) -> None:
    assert "--live" in catch_refusal(find_viewer_place, word.format(port=find_free_port()))


needs_driver = pytest.mark.skipif(
    not REQUIRED and not any(Path(place).glob("vulkan/icd.d/*.json") for place in ("/usr/share", "/etc")),
    reason="no Vulkan driver (Debian: apt-get install mesa-vulkan-drivers libvulkan1)")


@pytest.fixture(scope="module")
def trace(preflight: Path) -> Trace:
    return Trace.read(preflight, all=True)


@pytest.fixture(scope="module")
def rows(trace: Trace, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """What a recording of the trace holds."""
    path = tmp_path_factory.mktemp("rrd") / "x.rrd"
    write_recording(draw_run(trace), path)
    return read_recording(path)


@needs_viewer
def test_recording_holds_every_line(trace: Trace, rows: Rows) -> None:
    lines = {"/position/command": trace.com * 1e3, "/position/ram": trace.xj * 1e3, "/current/current": trace.cor * 1e3,
             "/error/error": (trace.com - trace.xj) * 1e6, "/pressure/pressure": trace.p12 / 1e5,
             "/spool/spool": trace.xs * 1e6, "/timing/response": trace.timing.response * 1e6,
             "/timing/work": trace.timing.work * 1e6}
    for entity, values in lines.items():
        np.testing.assert_allclose(rows[entity], np.column_stack([trace.t, values]), rtol=1e-9, atol=1e-8)


@needs_viewer
def test_recording_holds_every_limit(rows: Rows) -> None:
    """Of preflight: error at rest (14th check), position and pressure; low and high, over the window."""
    limits = {entity: values for entity, values in rows.items() if "limit" in entity}
    assert {entity: [(round(t, 6), round(float(str(value)), 6)) for t, value in values]
            for entity, values in limits.items()} == {
        "/error/limit_13_high": [(13.2, 29.0), (13.5, 29.0)], "/error/limit_13_low": [(13.2, -29.0), (13.5, -29.0)],
        "/position/limit_14_high": [(0.0, 6.0), (13.5, 6.0)], "/position/limit_14_low": [(0.0, -6.0), (13.5, -6.0)],
        "/pressure/limit_15_high": [(0.0, 40.0), (13.5, 40.0)], "/pressure/limit_15_low": [(0.0, -40.0), (13.5, -40.0)]}


@needs_viewer
def test_recording_holds_every_lane(trace: Trace, rows: Rows) -> None:
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


@needs_viewer
def test_recording_holds_every_event_and_check(trace: Trace, rows: Rows) -> None:
    times, texts = zip(*rows["/log/events"], strict=True)
    assert times == pytest.approx([event.t for event in trace.events]) and len(times) > 15
    assert all(f"{event.kind}: {event.text}" in str(text) for event, text in zip(trace.events, texts, strict=True))
    checks = [str(text) for _, text in rows["/log/checks"]]
    assert len(checks) == len(trace.checks) == 29
    assert all(any(f"PASS {c.name}: {c.value:.4g}" in text for text in checks) for c in trace.checks)
    assert "- sequence: Preflight" in str(rows["/log/provenance"][0][1])


@needs_viewer
@needs_driver
def test_headless_screenshot_shows_lines_limits_and_lanes(trace: Trace, tmp_path: Path) -> None:
    write_recording(draw_run(trace), tmp_path / "view.rrd")
    viewer.take_screenshot(tmp_path / "view.rrd", tmp_path / "view.png")
    shades = (imread(tmp_path / "view.png")[..., :3] * 255).astype(int)
    for colour in (COMMAND, MEASURED, LIMIT, DRIVE, *OUTPUTS[1:3]):
        channels = np.array([colour >> shift & 0xFF for shift in (24, 16, 8)])
        assert (np.abs(shades - channels).max(axis=2) < 24).sum() > 500, f"{colour:08X}"


@needs_viewer
def test_viewer_that_cannot_draw_says_so(tmp_path: Path) -> None:
    (tmp_path / "x.rrd").write_bytes(b"")
    with pytest.raises(ViewerError, match="does not draw"):
        viewer.take_screenshot(tmp_path / "x.rrd", tmp_path / "x.png", patience=3)


@needs_viewer
@pytest.mark.usefixtures("no_display")
def test_without_a_display_one_line_says_so_and_the_viewer_listens_on_this_machine_only() -> None:
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
        run = simulate_trace(Model().replace(changes), build_command()[:1200], seed=1, steps=100)
        run.write_csv(folder / f"{name}.csv")
    rows = np.loadtxt(folder / "healthy.csv", delimiter=",", comments="#", skiprows=1)
    head = (folder / "healthy.csv").read_text().splitlines()[0]
    late = np.vstack([np.tile(rows[:1], (250, 1)), rows])
    late[:, 0] = np.arange(len(late)) * 1e-3
    np.savetxt(folder / "late.csv", late, delimiter=",", header=head, comments="", fmt="%.12g")
    return folder


def read_values(rows: Rows, entity: str) -> np.ndarray:
    return np.array([value for _, value in rows[entity]], float)


@pytest.fixture(scope="module")
def recording(folder: Path) -> tuple[Path, str]:
    """The recording of `rig view --compare` with an added effect, and the verdict."""
    report = answer("view", folder / "run.csv", "--compare", "--set", BIAS, "--out", folder / "compare.rrd")
    return folder / "compare.rrd", report["verdict"]


@needs_viewer
def test_the_comparison_holds_measured_model_residual_and_floor(folder: Path, recording: tuple[Path, str]) -> None:
    rows = read_recording(recording[0])
    comparison = compare(Trace.read(folder / "run.csv"), Model().replace({"null_bias.current": 1.5e-4}))
    assert recording[1] == comparison.verdict and comparison.verdict != "MODEL_INCOMPLETE"
    for name, scale, residual_scale in (("xj", 1e3, 1e6), ("p12", 1e-5, 1e-5), ("xs", 1e6, 1e6)):
        np.testing.assert_allclose(read_values(rows, f"/{name}/1_measured"), comparison.trace.column(name) * scale)
        np.testing.assert_allclose(read_values(rows, f"/{name}/3_model"), comparison.replay.model[name] * scale)
        residual = read_values(rows, f"/residual_{name}/2_model")
        np.testing.assert_allclose(residual, comparison.replay.residual[name] * residual_scale)
        floor = NOISE_BAND_RATIO * comparison.signals[name].floor.value * residual_scale
        assert read_values(rows, f"/residual_{name}/3_floor_high") == pytest.approx([floor, floor])
        assert read_values(rows, f"/residual_{name}/3_floor_low") == pytest.approx([-floor, -floor])
    lane = [word for _, word in rows["/error_over_floor/model"] if word]
    assert lane == [format_ratio(place.ratio) for place in sorted(comparison.where, key=lambda place: place.t0)]


@needs_viewer
def test_before_the_change_is_the_model_without_the_added_effect(folder: Path, recording: tuple[Path, str]) -> None:
    rows, names = read_recording(recording[0]), read_names(recording[0])
    before, text = compare(Trace.read(folder / "run.csv"), Model()), str(rows["/log/result"][0][1])
    np.testing.assert_allclose(read_values(rows, "/residual_xj/1_before"), before.replay.residual["xj"] * 1e6)
    np.testing.assert_allclose(read_values(rows, "/xs/2_before"), before.replay.model["xs"] * 1e6)
    assert (names["/residual_xj/1_before"], names["/xj/1_measured"]) == ("before the change", "XJ measured")
    assert "/error_over_floor/before" in rows
    assert text.startswith(f"```text\n{recording[1]}") and "Before the change:\n\n```text\nMODEL_INCOMPLETE" in text


@needs_viewer
def test_runs_are_overlaid_and_subtracted_on_the_time_of_the_first(folder: Path, tmp_path: Path) -> None:
    sources = [str(folder / f"{name}.csv") for name in ("healthy", "run", "late")]
    assert answer("view", *sources, "--out", tmp_path / "x.rrd")["verdict"] == "DIFFERENT"
    rows, names = read_recording(tmp_path / "x.rrd"), read_names(tmp_path / "x.rrd")
    traces = [Trace.read(source) for source in sources]
    differences = compare_runs(sources, traces)
    assert names["/xj/00_A"] == "A healthy.csv" and names["/difference_xj/01_B"] == "B - A"
    np.testing.assert_allclose(read_values(rows, "/xj/01_B"), traces[1].xj * 1e3)
    assert {round(t0 - t1, 6) for (t0, _), t1 in zip(rows["/xj/02_C"], traces[2].t, strict=True)} == {-0.25}
    for number, pair in enumerate(differences.pairs, 1):
        for name, scale in (("xj", 1e6), ("p12", 1e-5), ("xs", 1e6)):
            difference = rows[f"/difference_{name}/{number:02}_{pair.run.label}"]
            np.testing.assert_allclose(difference, np.column_stack([pair.t, pair.differences[name] * scale]), atol=1e-8)
    assert np.abs(read_values(rows, "/difference_xj/02_C")).max() < 1e-6  # um; C is A, later
    text = str(rows["/log/result"][0][1])
    assert "DIFFERENT" in text and "B - A  XJ" in text and "aligned by the command" in text


@needs_viewer
def test_a_theme_is_served_for_a_browser_until_ctrl_c(folder: Path) -> None:
    """A script that notes the address stands in for a browser, which would open a window."""
    note = folder / "address.txt"
    script = write_file(folder / "browser", f'#!/bin/sh\nprintf %s "$1" > {note}.part\nmv {note}.part {note}\n')
    script.chmod(0o755)
    process = started("view", folder / "run.csv", "--theme", "light", "--json",
                      env={**os.environ, "BROWSER": f"{script} %s"})
    try:
        place = json.loads(process.stdout.readline())["address"]
        address = urlsplit(place)
        assert address.hostname == "127.0.0.1" and parse_qs(address.query)["theme"] == ["light"]
        with urllib.request.urlopen(place) as page:
            assert b"rerun" in page.read().lower()
        assert grown(note, 1, process)
        assert note.read_text() == place
        data = urlsplit(parse_qs(address.query)["url"][0])
        with socket.create_connection(("127.0.0.1", data.port or 0)):
            pass
    finally:
        result = interrupted(process)
    assert result.status == 0 and result.err == ""
