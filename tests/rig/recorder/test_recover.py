"""A log whose writer was killed comes back, up to the last half second."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader
from places import ROOT, SUPPORT
from synthetic_run import ATTACHMENTS, METADATA, record_run

from fdi.trace.trace import Trace
from plant.errors import InputError
from rig.recorder.recover import recover_log

WRITER = """
import sys, time
from pathlib import Path
from synthetic_run import ATTACHMENTS, METADATA, build_cycles
from rig.recorder import Recorder
run = list(build_cycles())
recorder = Recorder(Path(sys.argv[1]), ATTACHMENTS, METADATA)
start = time.monotonic_ns()
for t_ns, frames, signals, timing in run:
    time.sleep(max(0.0, (start + t_ns - time.monotonic_ns()) * 1e-9))
    for frame in frames:
        recorder.frame(frame)
    recorder.cycle(t_ns, signals, timing)
    print(t_ns, flush=True)
"""


def test_kill_9_in_mid_run_loses_at_most_half_a_second(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A writer that itself stood still just then loses more: the best of five counts."""
    for attempt in range(5):
        (tmp_path / str(attempt)).mkdir()
        lost = lose_end(tmp_path / str(attempt), capsys)
        if lost <= 0.5:
            return
    pytest.fail(f"{lost:.3f} s lost")


def lose_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> float:
    """Kill a writer in mid run and recover its log; how much was lost, s."""
    broken, out = tmp_path / "trace.mcap", tmp_path / "recovered.mcap"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SUPPORT), *sys.path])}
    with (tmp_path / "times").open("w") as times:
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(broken)], stdout=times, env=env)
        deadline = time.monotonic() + 120
        while (tmp_path / "times").stat().st_size < 25_000 and time.monotonic() < deadline:
            time.sleep(0.05)  # some 2.3 s into the run
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    reached = int((tmp_path / "times").read_text().rsplit("\n", 2)[-2])
    with pytest.raises(InputError, match="rig recover"):
        Trace.read(broken)
    salvage = recover_log(broken, out)
    trace = Trace.read(out, all=True)
    lost = reached * 1e-9 - (trace.t[-1] - trace.t[0])
    with capsys.disabled():
        print(f"\nkill -9 after {reached * 1e-9:.2f} s: {lost:.3f} s lost")
    assert reached > 2_000_000_000 and lost > -0.002
    assert not salvage.complete and salvage.cycles == len(trace) and not trace.gaps
    assert trace.attachments == {name: data for name, (_, data) in ATTACHMENTS.items()}
    assert METADATA.items() <= dict(trace.provenance).items()
    assert re.search(r"kept \d+ messages, .* lost \d+ bytes", str(salvage))
    return float(lost)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("log") / "trace.mcap", stop=1000)


def test_every_cut_gives_a_readable_log_or_a_clear_refusal(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    kept = []
    for cut in range(0, len(data), 3001):
        path, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
        path.write_bytes(data[:cut])
        try:
            kept.append(recover_log(path, out).messages)
        except InputError as error:
            assert cut < 200 and "MCAP log" in str(error)
            continue
        with out.open("rb") as stream:
            assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == kept[-1]
    assert kept == sorted(kept) and kept[-1] > 0


def test_damage_in_the_middle_costs_one_chunk(whole: Path, tmp_path: Path) -> None:
    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)[2]
    data = bytearray(whole.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 100] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    salvage = recover_log(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert not salvage.complete and "damaged chunk" in salvage.reason
    assert salvage.lost_bytes >= chunk.chunk_length
    trace = Trace.read(tmp_path / "out.mcap", all=True)
    assert len(trace.gaps) == 1 and len(trace) == 1000
    with pytest.raises(InputError, match="chunk at byte"):
        Trace.read(tmp_path / "bad.mcap")


def test_a_whole_log_stays_the_same(whole: Path, tmp_path: Path) -> None:
    salvage = recover_log(whole, tmp_path / "out.mcap")
    assert salvage.complete and salvage.lost_bytes == 0
    before, after = Trace.read(whole, all=True), Trace.read(tmp_path / "out.mcap", all=True)
    assert (before.xj == after.xj).all() and before.events == after.events and before.attachments == after.attachments


def test_refusals(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("t,com,xj,cor\n")
    with pytest.raises(InputError, match="MCAP log"):
        recover_log(tmp_path / "text.mcap", tmp_path / "out.mcap")
    with pytest.raises(InputError, match="a file that can be read"):
        recover_log(tmp_path / "none.mcap", tmp_path / "out.mcap")
    with pytest.raises(InputError, match="another file"):
        recover_log(whole, whole)


def test_a_message_record_is_taken_apart_in_one_place() -> None:
    root = ROOT
    readers = [path for folder in ("fdi", "rig/recorder") for path in (root / folder).rglob("*.py")
               if "unpack_from" in path.read_text()]
    assert [path.relative_to(root).as_posix() for path in readers] == ["fdi/trace/mcap_log.py"]
