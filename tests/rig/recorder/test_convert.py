"""Other formats, there and back."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from rig_command import rig
from synthetic_run import record_run

from fdi.trace.trace import Trace
from plant.errors import InputError
from rig.benches.bench import EXTENDED, FD, SWITCHED
from rig.benches.bench_file import load_bench
from rig.network.frame import FD_LENGTHS, Frame, make_message
from rig.recorder import Recorder
from rig.recorder.convert import (
    RAW_SUFFIXES,
    export_trace,
    import_csv,
    import_frames,
    list_can_messages,
    read_raw_frames,
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("log") / "trace.mcap", stop=1300)


@pytest.mark.parametrize("suffix", RAW_SUFFIXES)
def test_raw_frames_there_and_back(log: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"x{suffix}"
    assert export_trace(log, out) == 6500
    bench = load_bench()
    assert import_frames(out, tmp_path / "back.mcap", bench) == 1300
    before, after = list(read_raw_frames(log)), list(read_raw_frames(tmp_path / "back.mcap"))
    assert [f[1:] for f in before] == [f[1:] for f in after]
    worst = max(abs(a.t_ns - b.t_ns) for a, b in zip(before, after, strict=True))
    assert worst <= 100_000  # .trc counts 0.1 ms
    want, got = Trace.read(log, all=True), Trace.read(tmp_path / "back.mcap")
    for name, resolution in {"com": 1e-7, "xj": 1e-7, "cor": 1e-8, "p12": 10.0, "xs": 1e-9}.items():
        np.testing.assert_allclose(got.column(name), want.column(name), atol=0.51 * resolution)
    assert np.isnan(got.load).all() and not got.gaps
    assert {*bench.files} <= got.attachments.keys()
    assert got.provenance["imported"] == out.name


@pytest.mark.parametrize("suffix", RAW_SUFFIXES)
def test_every_kind_of_frame_there_and_back(tmp_path: Path, suffix: str) -> None:
    """Classical and CAN FD, of 11 and of 29 bits, also with the same number: as python-can reads and writes them."""
    kinds = [0, EXTENDED] if suffix == ".trc" else [0, EXTENDED, FD, EXTENDED | FD]
    kinds += [kind | SWITCHED for kind in kinds if kind & FD]
    frames = [Frame(0, 0x080, b"")]
    for kind in kinds:
        for number in (0, 0x080, 0x7FF, 0x1FFFFFFF if kind & EXTENDED else 0x123):
            for length in (0, 3, 8, *(FD_LENGTHS if kind & FD else ())):
                frames.append(Frame(len(frames) * 1_000_000, kind | number, bytes(range(0xF0 - length, 0xF0))))
    recorder = Recorder(tmp_path / "x.mcap", {}, {})
    for frame in frames:
        recorder.frame(frame)
    recorder.close()
    assert list(read_raw_frames(tmp_path / "x.mcap")) == frames
    out = tmp_path / f"x{suffix}"
    assert export_trace(tmp_path / "x.mcap", out) == len(frames)
    heard = list(list_can_messages(out))
    for frame, (_, message) in zip(frames, heard, strict=True):
        if not message.is_fd or frame.data:
            assert message.equals(make_message(*frame[1:]), timestamp_delta=None, check_channel=False)
    import_frames(out, tmp_path / "back.mcap", load_bench())
    assert [frame[1:] for frame in read_raw_frames(tmp_path / "back.mcap")] == [frame[1:] for frame in frames]


def test_fd_frames_do_not_go_into_a_trc(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "x.mcap", {}, {})
    recorder.frame(Frame(0, FD | 0x80, bytes(64)))
    recorder.close()
    with pytest.raises(InputError, match=r"x\.trc: --out: expected a name that ends in \.log, \.blf or \.asc"):
        export_trace(tmp_path / "x.mcap", tmp_path / "x.trc")
    assert not (tmp_path / "x.trc").exists()


def test_wireshark_decodes_the_export(log: Path, tmp_path: Path) -> None:
    if not shutil.which("tshark"):
        pytest.skip("no tshark on this machine (Debian: apt-get install tshark)")
    export_trace(log, tmp_path / "x.blf")
    words = ["tshark", "-r", str(tmp_path / "x.blf"), "-d", "can.subdissector,canopen", "-T", "fields", "-e", "can.id",
             "-e", "_ws.malformed"]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 6500 and {line.strip() for line in lines} == {"128", "386", "387", "514", "643"}


def test_lost_and_late_frames_of_a_candump(tmp_path: Path) -> None:
    def at(cycle: int, drive: int | None, command: bool = True) -> list[str]:
        t, out = 1_700_000_000 + cycle / 1000, []
        number = (65534 + cycle).to_bytes(2, "little", signed=False).hex() if 65534 + cycle < 65536 else \
            (cycle - 2).to_bytes(2, "little").hex()
        if command:
            out.append(f"({t:.6f}) can0 202#10270000" + "0700" + number)
        out += [f"({t + 1e-4:.6f}) can0 080#", f"({t + 2e-4:.6f}) can0 183#2027000000010000"]
        if drive is not None:
            echo = ((65534 + drive) & 0xFFFF).to_bytes(2, "little").hex()
            out.append(f"({t + 3e-4:.6f}) can0 182#E8030000" + "0F00" + echo)
        return out

    lines = [*at(0, 0), *at(1, 1), *at(2, None), *at(3, 2), *at(6, 6), "(1700000000.010000) can0 702#7F",
             "(1700000000.011000) can0 083#5082010000000000", "(1700000000.012000) can0 202#1027"]
    (tmp_path / "x.log").write_text("\n".join(lines) + "\n")
    assert import_frames(tmp_path / "x.log", tmp_path / "x.mcap", load_bench()) == 5
    trace = Trace.read(tmp_path / "x.mcap")
    assert len(trace) == 7 and [g.cycles for g in trace.gaps] == [2]
    np.testing.assert_allclose(trace.cor, [1e-5, 1e-5, 1e-5, np.nan, np.nan, np.nan, 1e-5])
    np.testing.assert_allclose(trace.com, [1e-3, 1e-3, 1e-3, 1e-3, np.nan, np.nan, 1e-3])
    assert [(n.node, n.name) for n in trace.nmt] == [(2, "pre-operational")]
    assert [(e.kind, e.text[:14]) for e in trace.events] == [("emcy", "node 3: 0x8250"), ("frame", "0x202: 2 bytes")]


def test_csv_becomes_a_log(log: Path, tmp_path: Path) -> None:
    export_trace(log, tmp_path / "x.csv.gz")
    assert import_csv(tmp_path / "x.csv.gz", tmp_path / "y.mcap") == 1000
    before, after = Trace.read(log), Trace.read(tmp_path / "y.mcap")
    np.testing.assert_array_equal(before.xj, after.xj)
    np.testing.assert_array_equal(before.t, after.t)


FILES = {"x.csv": b"t,com,xj,cor\n0,0,0,0\n0.001,0,0,0\n", "bad.log": b"hello\n", "bad.blf": bytes(range(256)),
         "silent.log": b"(0.000000) can0 702#05\n", "bad.dbc": b"BO_ nonsense", "other.dbc": b'VERSION ""\n'}


@pytest.mark.parametrize(("words", "reason"), [
    ("export {log} --out x.xlsx", "ends in .csv"), ("export x.csv --out x.blf", "raw frames"),
    ("export x.mcap --out x.blf", "at least one raw frame"), ("import bad.log", "CAN frames as .log"),
    ("import bad.blf", "CAN frames as .blf"), ("import silent.log", "SYNC"),
    ("import silent.log --guess --dbc bad.dbc", "expected a DBC ("),
    ("import silent.log --dbc other.dbc", "--map or --guess with it")])
def test_refusals(log: Path, words: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        Path(name).write_bytes(content)
    import_csv(Path("x.csv"), Path("x.mcap"))
    said = rig(*words.format(log=log).split())
    assert said.status == 2 and said.err.count("\n") == 1 and reason in said.err
    assert not {"x.blf", "bad.mcap", "silent.mcap"} & {path.name for path in tmp_path.iterdir()}


def test_commands(log: Path, tmp_path: Path) -> None:
    assert rig("export", log, "--out", tmp_path / "x.csv", "--json").json["count"] == 1000
    assert rig("export", log, "--all", "--force", "--out", tmp_path / "x.csv", "--json").json["count"] == 1300
    assert rig("import", tmp_path / "x.csv", "--json").json == {"trace": str(tmp_path / "x.mcap"), "cycles": 1300}
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-2000])
    answer = rig("recover", tmp_path / "cut.mcap", "--json").json
    assert answer["path"] == str(tmp_path / "cut.recovered.mcap") and not answer["complete"]
