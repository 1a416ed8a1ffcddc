"""`rig run --live rerun`: what arrives in a recording, a viewer that is closed, and places that cannot be used."""
from __future__ import annotations

import importlib.util
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from recording_rows import read_recording
from rig_command import rig

from fdi.trace.trace import Trace
from plant.errors import InputError
from rig.view.live_process import find_viewer_place
from rig.view.viewer import find_free_port, is_listening

needs_rerun = pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="pip install 'eha-rig[view]'")
SHORT = """title = "Short"
setup = [{ kind = "hold", time = 0.2 }]
main = [{ name = "rest", kind = "hold", time = 0.3 }, { name = "out", kind = "step", to = 1e-3, time = 0.5 }]
load = [{ kind = "ramp", to = 100.0, time = 0.5 }]
faults = [{ kind = "parameter", parameter = "filter.clogging", value = 0.4, start = 0.2 }]
checks = [{ name = "position", kind = "never_exceeds", signal = "xj", high = 6, unit = "mm" },
          { name = "too small", kind = "never_exceeds", signal = "xj", high = 0.1, unit = "mm" }]
"""
LONG = 'title = "Long"\nmain = [{ name = "rest", kind = "hold", time = 600 }]\n'


@needs_rerun
def test_what_arrives_is_what_the_log_holds(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(SHORT)
    said = rig("run", tmp_path / "short.toml", "--live", f"rerun:{tmp_path}/live.rrd", "--out", tmp_path / "run")
    assert said.status == 1 and said.err == "" and "too small" in said.out
    rows, trace = read_recording(tmp_path / "live.rrd"), Trace.read(tmp_path / "run", all=True)
    t, ram = zip(*rows["/position/ram"], strict=True)
    np.testing.assert_allclose(t, trace.t, atol=1e-6)
    np.testing.assert_allclose(np.array(ram, float), trace.xj * 1e3, atol=1e-9)
    np.testing.assert_allclose([value for _, value in rows["/spool/spool"]], trace.xs * 1e6, atol=1e-9)
    assert [state for _, state in rows["/run/phase"]] == ["set-up", "main"]
    assert rows["/run/phase"][1][0] == pytest.approx(0.0, abs=1e-6)
    assert str(rows["/check/position"][-1][1]).startswith("PASS")
    assert str(rows["/check/too_small"][-1][1]).startswith("FAIL")
    assert [(round(t, 6), state) for t, state in rows["/fault/parameter_filter.clogging"]] == [(0.2, "active")]
    np.testing.assert_allclose([value for _, value in rows["/load/load"]], trace.load, atol=1e-9)
    assert trace.load.max() == 100.0
    assert "operational" in {state for _, state in rows["/node/2_controller"]}
    assert {entity for entity in rows if entity.startswith("/check/")} == {"/check/position", "/check/too_small"}
    assert len(rows["/log/checks"]) == len(trace.checks) and len(rows["/log/events"]) == len(trace.events)
    assert not any(math.isnan(t) for t, _ in rows["/log/events"])


@needs_rerun
def test_a_run_that_ends_before_main_is_shown(tmp_path: Path) -> None:
    """Its clock ends with the run."""
    (tmp_path / "long.toml").write_text('setup = [{ kind = "hold", time = 600 }]\n' + LONG)
    command = [sys.executable, "-m", "rig.cli.main", "run", str(tmp_path / "long.toml"), "--live",
               f"rerun:{tmp_path}/live.rrd", "--quiet", "--out", str(tmp_path / "run")]
    run, log = subprocess.Popen(command), tmp_path / "run" / "trace.mcap"
    wait_until(lambda: log.exists() and log.stat().st_size > 100_000)  # well into set-up
    run.send_signal(signal.SIGINT)
    assert run.wait() == 130
    rows, trace = read_recording(tmp_path / "live.rrd"), Trace.read(tmp_path / "run", all=True)
    assert len(rows["/position/ram"]) == len(trace.xj) > 0
    assert len(rows["/log/events"]) == len(trace.events) and len(rows["/log/checks"]) == len(trace.checks) > 0
    assert max(t for entity in rows for t, _ in rows[entity] if not math.isnan(t)) == 0.0


@needs_rerun
def test_the_run_goes_on_when_the_viewer_is_closed(tmp_path: Path) -> None:
    (tmp_path / "long.toml").write_text(LONG)
    port = find_free_port()
    server = subprocess.Popen([sys.executable, "-m", "rerun", "--serve-grpc", "--bind", "127.0.0.1", "--port",
                               str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        wait_until(lambda: is_listening(port))
        command = [sys.executable, "-m", "rig.cli.main", "run", str(tmp_path / "long.toml"), "--live", f"rerun:{port}",
                   "--quiet", "--out", str(tmp_path / "run")]
        run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        log = tmp_path / "run" / "trace.mcap"
        wait_until(lambda: log.exists() and log.stat().st_size > 100_000)  # well into main
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()
    assert run.stderr is not None
    assert run.stderr.readline() == "rig run: the viewer was closed; the run goes on\n"
    size = log.stat().st_size
    wait_until(lambda: log.stat().st_size > size + 100_000)
    run.send_signal(signal.SIGINT)
    assert run.wait() == 130 and (tmp_path / "run" / "verdict.json").exists()


def wait_until(is_true: object) -> None:
    """Wait for something that comes sooner or later."""
    assert callable(is_true)
    end = time.monotonic() + 120.0
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_without_the_viewer_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    said = rig("run", "--live", "rerun", "--out", tmp_path / "run")
    assert said.status == 2 and said.err.count("\n") == 1 and "pip install 'eha-rig[view]'" in said.err
    assert not (tmp_path / "run").exists()


@needs_rerun
@pytest.mark.parametrize("word", ["rerun", "rerun:x", "rerun:0", "rerun:/absent/live.rrd", "rerun:{port}"])
def test_places_that_cannot_be_used(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="--live"):
        find_viewer_place(word.format(port=find_free_port()))


def test_a_word_after_live_may_be_a_sequence() -> None:
    said = rig("run", "--live", "absent.toml")
    assert said.status == 2 and "absent.toml" in said.err
