"""Whole runs: the same bytes for the same seed, whatever the pace and the bus; and what a killed one leaves behind."""
from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from bus_stations import spec
from mcap.reader import make_reader
from rig_command import finished, gone, grown, nodes_on, rig, started
from short_sequences import SHORT, job, play

from fdi.trace.trace import CLEANUP, Trace
from plant import simulate
from rig.network import codec
from rig.network.bus import open_can
from rig.network.link import Link

SIGNALS = ("com", "xj", "cor", "p12", "xs")
LONG = SHORT.replace('"rest", kind = "hold", time = 0.05', '"rest", kind = "hold", time = 60') + 'ends = "safe_state"\n'
SMOOTH = {f"{part}.{kind}_friction": 0.0 for part in ("spool", "jack") for kind in ("static", "dynamic")}
QUIET = {f"sensors.{what}_noise": 0.0 for what in ("position", "pressure", "spool")}


def messages(folder: Path) -> list[tuple[int, bytes]]:
    """Time and bytes of each /signals message."""
    with (folder / "trace.mcap").open("rb") as stream:
        return [(m.log_time, m.data) for _, _, m in make_reader(stream).iter_messages(topics=["/signals"])]


def columns(folder: Path) -> np.ndarray:
    """All cycles, shape (5, n)."""
    trace = Trace.read(folder, all=True)
    return np.array([trace.column(name) for name in SIGNALS])


@pytest.fixture
def reference(tmp_path: Path) -> np.ndarray:
    """The short sequence in lockstep on the embedded bus, seed 1."""
    play(job(seed=1), tmp_path / "reference")
    return columns(tmp_path / "reference")


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = [rig("run", "--seed", 1, "--json", "--out", tmp_path / name).json for name in "ab"]
    assert [one["verdict"] for one in said] == ["PASS", "PASS"]
    assert len(messages(tmp_path / "a")) == said[0]["timing"]["cycles"] == 14_500
    assert messages(tmp_path / "a") == messages(tmp_path / "b")
    with capsys.disabled():
        print(f"\npreflight in lockstep on the embedded bus: {max(one['speed'] for one in said):.1f} times real time")


def test_the_bench_is_the_simulation(tmp_path: Path) -> None:
    """Without friction and noise both are smooth, and what is left between them is the bus's resolution."""
    one = job(set_=SMOOTH | QUIET, seed=1)
    play(one, tmp_path)
    row, trace = simulate(one.model, one.sequence.main_profile().command), Trace.read(tmp_path)
    for name, counts in (("xj", 2 * codec.POSITION), ("xs", 400 * codec.SPOOL), ("p12", 1e4)):
        assert np.abs(trace.column(name) - getattr(row, name)).max() < counts, name


def test_real_time_gives_the_same_signals(tmp_path: Path, reference: np.ndarray) -> None:
    """However late the machine is: the plant moves one period a SYNC."""
    outcome = play(job(seed=1, pace="realtime", max_overruns=1.0), tmp_path / "b")
    assert outcome.verdict == "PASS" and np.array_equal(columns(tmp_path / "b"), reference)
    assert 0.3 < outcome.speed < 1.05 and outcome.timing["lateness_us"]["max"] > 0


def test_processes_on_a_bus_give_the_same_signals(tmp_path: Path, reference: np.ndarray) -> None:
    """Plant and controller as processes of their own: same signals, and nobody is left behind."""
    where = spec("udp_multicast")
    outcome = play(job(seed=1, bus=where), tmp_path / "b")
    assert (outcome.verdict, outcome.aborted, set(outcome.counters.values())) == ("PASS", "", {0})
    assert np.array_equal(columns(tmp_path / "b"), reference), outcome.counters
    assert nodes_on(where) == []


def test_a_rig_does_not_disturb_another(tmp_path: Path) -> None:
    """On a bus where a SYNC is heard not a word is said."""
    where = spec("udp_multicast")
    other, listener = (Link(open_can(where), time.monotonic_ns) for _ in range(2))
    process = started("run", "--bus", where, "--out", tmp_path)
    while process.poll() is None:
        other.send(codec.SYNC, b"")
        time.sleep(0.01)
    said = finished(process)
    heard = {frame.cob_id for frame in listener.poll(0.0)}
    other.close()
    listener.close()
    assert said.status == 2 and "another rig is active" in said.err and heard == {codec.SYNC}


def killed(where: str, folder: Path, cycles: int) -> int:
    """Start a run in real time, kill it when that many cycles have passed on the bus; the last cycle that was heard."""
    (folder / "long.toml").write_text(LONG)
    link, last, end = Link(open_can(where), time.monotonic_ns), -1, time.monotonic() + 40.0
    process = started("run", folder / "long.toml", "--bus", where, "--pace", "realtime", "--out", folder, "--quiet")
    while last < cycles and time.monotonic() < end and process.poll() is None:
        for frame in link.poll(0.05):
            last = codec.unpack_command(frame.data).cycle if frame.cob_id == codec.COMMAND else last
    process.send_signal(signal.SIGKILL)
    finished(process)
    for frame in link.poll(0.0):
        last = codec.unpack_command(frame.data).cycle if frame.cob_id == codec.COMMAND else last
    link.close()
    return last


def test_a_killed_run_loses_half_a_second_at_most(tmp_path: Path) -> None:
    """And its nodes end by themselves."""
    where = spec("udp_multicast")
    last = killed(where, tmp_path, 1000)
    assert last >= 1000 and gone(where)
    said = rig("report", tmp_path / "trace.mcap")
    assert said.status == 2 and "rig recover" in said.err
    assert rig("recover", tmp_path / "trace.mcap", "--out", tmp_path / "saved.mcap", "--quiet").status == 0
    trace = Trace.read(tmp_path / "saved.mcap", all=True)
    kept = round((trace.t[-1] - trace.t[0]) * 1000) + 1
    assert last - 500 <= kept <= last + 1
    assert {"model.toml", "sequence/long.toml"} <= trace.attachments.keys()


def test_ctrl_c_at_a_terminal_reaches_the_rig_alone(tmp_path: Path) -> None:
    """A terminal interrupts all its processes; clean-up needs the plant."""
    where = spec("udp_multicast")
    (tmp_path / "long.toml").write_text(LONG)
    process = started("run", tmp_path / "long.toml", "--bus", where, "--out", tmp_path, "--quiet",
                      start_new_session=True)
    grown(tmp_path / "trace.mcap", 60_000)
    os.killpg(process.pid, signal.SIGINT)
    assert finished(process).status == 130 and gone(where)
    trace = Trace.read(tmp_path, all=True)
    assert (trace.phase == CLEANUP).sum() == 50 and not np.isnan(trace.xj).any()


def test_an_external_node_that_does_not_answer(tmp_path: Path) -> None:
    said = rig("run", "--bus", spec("udp_multicast"), "--controller", "external", "--plant", "external", "--out",
               tmp_path)
    assert said.status == 2 and "node 3 (plant) does not answer" in said.err


def test_nodes_that_were_there_before_are_taken_and_left_alone(tmp_path: Path, reference: np.ndarray) -> None:
    """`rig node` twice, and a run that finds them."""
    where = spec("udp_multicast")
    nodes = [started("node", name, "--bus", where) for name in ("plant", "controller")]
    try:
        for node in nodes:
            assert node.stdout is not None and where in node.stdout.readline()
        outcome = play(job(seed=1, bus=where, controller="external", plant="external"), tmp_path / "b")
        assert all(node.poll() is None for node in nodes)
    finally:
        for node in nodes:
            node.send_signal(signal.SIGTERM)
        said = [finished(node) for node in nodes]
    assert outcome.verdict == "PASS" and [one.status for one in said] == [0, 0]
    assert np.array_equal(columns(tmp_path / "b"), reference), outcome.counters
