"""Trace: the same columns whatever the file was; a clear line for what cannot be one, or would take gigabytes."""

import gzip
import json
import resource
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from changed_logs import write_bomb
from mcap.writer import CompressionType, IndexType, Writer
from physics_cases import PREFLIGHT
from places import SUPPORT
from refusals import catch_refusal
from rig_command import CommandResult, write_file
from synthetic_run import ATTACHMENTS, record_run

from fdi.trace import Trace, find_sections, open_log
from fdi.trace.declaration import read_declaration
from fdi.trace.mcap_log import Log
from fdi.trace.trace import Gap
from rig.recorder import U32, Event, NmtState, Recorder, Signals, Timing, schema

KINDS = ["hold", "step", "step", "step", "step", "ramp", "hold", "ramp", "hold", "dynamic", "hold"]  # of preflight


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("run") / "trace.mcap").parent


def test_main_phase_of_a_log(run: Path) -> None:
    trace = Trace.read(run / "trace.mcap")
    np.testing.assert_allclose(trace.t, 1e-3 * np.arange(13_500), atol=1e-12)
    assert (trace.period, trace.gaps, trace.units["p12"]) == (1e-3, (), "Pa") and (trace.phase == 1).all()
    assert trace.com[499:501].tolist() == [0.0, 5e-3]
    assert trace.signals == ("com", "xj", "cor", "p12", "xs", "load")
    assert (trace.provenance["seed"], trace.provenance["verdict.status"]) == ("1", "FAIL")
    assert trace.attachments["sequence.toml"] == ATTACHMENTS["sequence.toml"][1]
    assert [(e.t, e.kind) for e in trace.events] == [(-0.3, "phase"), (0, "phase"), (6, "fault"), (13.5, "phase")]
    assert (trace.nmt[-1].node, trace.nmt[-1].name) == (3, "operational")
    ramp = trace.checks[2]
    assert (ramp.name, ramp.kind, ramp.signal) == ("ramp error", "ramp_error", "error")
    assert (ramp.value, ramp.unit, ramp.passed) == (9.1e-6, "m", False)
    assert np.isnan(trace.checks[0].low) and len(trace.timing.t) == 13_500 and trace.timing.t[0] == 0
    assert [s.kind for s in trace.sections()] == KINDS


def test_whole_log_keeps_the_time_axis(run: Path) -> None:
    trace, main = Trace.read(run, all=True), Trace.read(run)
    assert np.bincount(trace.phase).tolist() == [300, 13_500, 200] and trace.t[0] == pytest.approx(-0.3)
    np.testing.assert_array_equal(trace.xj[trace.phase == 1], main.xj)
    np.testing.assert_allclose(trace.t[trace.phase == 1], main.t, atol=1e-12)


@pytest.mark.parametrize("everything", [False, True])
def test_events_keep_to_the_rows_after_a_stall(tmp_path: Path, everything: bool) -> None:
    """A real-time run that stood still for 2 s in its set-up and again in main: rows go on, log times jump."""
    records = {0: [(-500_000_000, Event("INFO", "phase", "bring-up"))], 150: [(0, NmtState(3, 5, "operational"))],
               100: [(-100_000, Event("INFO", "phase", "main"))],  # before cycle: by how many ns
               200: [(-1_000_000_000, Event("WARN", "stall", "half way")), (500_000, Event("WARN", "fault", "after"))],
               299: [(3_000_000_000, Event("INFO", "phase", "end"))]}
    with closing(Recorder(tmp_path / "trace.mcap", {}, {"period": "0.001"})) as recorder:
        for k in range(300):
            t_ns = 500_000_000 + k * 1_000_000 + 2_000_000_000 * ((k >= 50) + (k >= 200))
            for after, record in records.get(k, []):
                recorder.put(t_ns + after, record)
            recorder.cycle(t_ns, Signals(k, int(k >= 100), 0, 0, 0, 0, 0, 0, 0, 0, 0), Timing(k, False, 0, 0, 0))
    trace = Trace.read(tmp_path / "trace.mcap", all=everything)
    assert [event.t for event in trace.events] == pytest.approx([-0.6, -1e-4, 0.0995, 0.1005, 3.199], abs=1e-6)
    assert trace.nmt[0].t == 0.05
    np.testing.assert_array_equal(trace.timing.t, trace.t)


@pytest.mark.parametrize("name", ["x.csv", "x.csv.gz"])
def test_csv_there_and_back(run: Path, tmp_path: Path, name: str) -> None:
    trace = Trace.read(run)
    trace.write_csv(tmp_path / name)
    again = Trace.read(tmp_path / name)
    for column in ("t", "com", "xj", "cor", "p12", "xs", "load"):
        np.testing.assert_array_equal(again.column(column), trace.column(column))
    assert again.period == trace.period


def test_missing_samples_and_gaps(tmp_path: Path) -> None:
    path = write_file(tmp_path / "x.csv", "t,com,xj,cor,note\n0.000,0,1e-6,2e-6,7\n0.001,0,,3e-6,7\n"
                                           "0.004,0,3e-6,4e-6,7\n0.005,0,1e-6,1e-6,7\n")
    trace = Trace.read(path)
    np.testing.assert_array_equal(np.isnan(trace.xj), [False, True, True, True, False, False])
    np.testing.assert_allclose(trace.t, np.arange(6) * 1e-3)
    assert (trace.period, trace.gaps, trace.signals) == (1e-3, (Gap(0.001, 0.004, 2),), ("com", "xj", "cor"))
    assert np.isnan(trace.p12).all() and trace.notes == ("column note is not known and was left out",)
    several = Trace.read(write_file(
        tmp_path / "x.csv", "t,com,xj,cor,a,b,c,d,e\n0,0,0,0,1,2,3,4,5\n0.001,0,0,0,1,2,3,4,5\n"))
    assert several.notes == ("5 columns are not known and were left out: a, b, c and 2 more",)
    trace.write_csv(tmp_path / "y.csv")
    assert Trace.read(tmp_path / "y.csv").gaps == trace.gaps


def test_fields_that_say_nan_are_missing(tmp_path: Path) -> None:
    rows = "0.000,0,1e-6,2e-6,nan\n0.001,0,,3e-6,NaN\n0.002,0,1e-6,0,1e5\n"
    trace = Trace.read(write_file(tmp_path / "x.csv", "t,com,xj,cor,p12\n" + rows))
    np.testing.assert_array_equal(np.isnan(trace.p12), [True, True, False])


def test_jitter_of_the_recorded_time_is_not_a_gap(tmp_path: Path) -> None:
    t = np.arange(5000) * 1e-3 + np.random.default_rng(1).uniform(-2e-4, 2e-4, 5000)
    trace = Trace.read(write_file(tmp_path / "x.csv", "t,com,xj,cor\n" + "".join(f"{v:.6f},0,0,0\n" for v in t)))
    assert len(trace) == 5000 and not trace.gaps and trace.period == pytest.approx(1e-3, rel=1e-3)


HEAD = "t,com,xj,cor\n"


@pytest.mark.parametrize(("text", "says"), [
    ("", "line 1: t: expected a column of this name; the header is '' (commas separate"),
    ("t;com;xj", "line 1: t: expected a column of this name; the header is 't;com;xj' (commas separate columns; rig"),
    ("t,com,cor", "line 1: xj: expected a column of this name; the header is 't,com,cor'"),
    ("com,xj,cor\n0,0,0\n", "line 1: t: expected a column"),
    ("time;com;xj;cor\n0;0;0;0\n", "line 1: t: expected a column"),
    (HEAD, "expected at least one row of numbers"),
    (HEAD + "0,0,0,0\n", "t: expected at least two rows"),
    (HEAD + "0,0,0,0\n0.001,0,abc,0\n", "line 3: xj: expected a finite number or an empty field, not 'abc'"),
    (HEAD + "0,0,0,0\n0.001,0,inf,0\n", "line 3: xj: expected a finite number"),
    (HEAD + "0,0,0,0\n0.001,0,0,0\n0.001,0,0,0\n", "t: expected times that grow; row 3 has 0.001 s after 0.001 s"),
    (HEAD + "0,0,0,0\n,0,0,0\n", "t: expected times that grow; row 2 has nan s after 0 s"),
    (HEAD + "0,0,0,0\n0.001,0,0\n", "line 3: expected 4 fields, not 3"),
    (HEAD + "0,0,0,0\n0.001,0,0,0\n0.0011,0,0,0\n0.002,0,0,0\n0.003,0,0,0\n", "line 4: t: expected one row per cycle"),
    (HEAD + "0,0,0,0\n0.001,0,0,0\n0.002,0,0,0\n9e9,0,0,0\n", "t: expected gaps that leave"),
    ("t,com,xj,cor,xj\n0,0,0,0,0\n", "line 1: header: expected each column once"),
])
def test_refusals(tmp_path: Path, text: str, says: str) -> None:
    line = catch_refusal(Trace.read, write_file(tmp_path / "x.csv", text))
    assert says in line and "x.csv" in line


@pytest.mark.parametrize(("name", "data"), [
    ("a.csv", b"\xff\xfe\x00"), ("b.csv.gz", b"not gzip"), ("c.csv.gz", gzip.compress(HEAD.encode(), mtime=0)[:-9]),
    ("d.mcap", b"nothing"), ("e.mcap", b""), ("f.xlsx", b"")])
def test_refusals_of_files(name: str, data: bytes, tmp_path: Path) -> None:
    assert name in catch_refusal(Trace.read, tmp_path / name)  # there is none yet
    (tmp_path / name).write_bytes(data)
    assert name in catch_refusal(Trace.read, tmp_path / name)


def test_run_that_ended_in_its_set_up(tmp_path: Path) -> None:
    path = record_run(tmp_path / "trace.mcap", stop=100)
    assert "ended in its set-up" in catch_refusal(Trace.read, path) and len(Trace.read(path, all=True)) == 100


TWO = np.arange(2000) / 1000  # s
STEPS = np.repeat([0.0, 1e-3, -2e-3, -2.05e-3], 500)
RAMP = np.concatenate([np.zeros(500), 0.33e-3 * TWO, np.full(500, 0.33e-3 * 2)])


@pytest.mark.parametrize(("command", "kinds"), [
    (STEPS, ["hold", "step", "step", "step"]), (np.rint(RAMP * 1e7) / 1e7, ["hold", "ramp", "hold"]),
    (np.where((np.arange(2000) >= 700) & (np.arange(2000) < 720), np.nan, STEPS), ["hold", "step", "step", "step"]),
    (np.concatenate([np.zeros(500), np.random.default_rng(0).normal(0, 1e-4, 1000)]), ["hold", "dynamic"]),
    *((1e-3 * np.sin(2 * np.pi * hz * TWO), ["dynamic"]) for hz in (0.1, 1.0, 30.0)), (PREFLIGHT, KINDS)])
def test_sections_of_any_command(command: np.ndarray, kinds: list[str]) -> None:
    sections = find_sections(command)
    assert [s.kind for s in sections] == kinds or {s.kind for s in sections} == {"dynamic"} == set(kinds)
    assert [s.start for s in sections] == [0, *[s.stop for s in sections][:-1]] and sections[-1].stop == len(command)


def test_sections_of_a_command_that_was_cut_off_anywhere() -> None:
    """As an abort leaves it: main breaks off, clean-up goes back from there."""
    for last in [*range(1, 60), *range(3900, 4100, 7), *range(5950, 6050, 3), *range(9000, 11000, 97)]:
        cut = PREFLIGHT[:last]
        for com in (cut, np.concatenate([cut, np.linspace(cut[-1], 0, 300)]), cut[-15:]):
            cover = find_sections(com)
            assert [s.start for s in cover] == [0, *[s.stop for s in cover][:-1]] and cover[-1].stop == len(com)


def rewrite(log: Log, path: Path, index_types: IndexType) -> Log:
    """The rows of a log, written by the libraries: fields that are 0 are left out, as proto3 does."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=10_000, compression=CompressionType.ZSTD, index_types=index_types)
        writer.start()
        for channel in log.channels.values():
            schema = log.schemas[channel.schema_id]
            number = writer.register_channel(channel.topic, channel.message_encoding,
                                             writer.register_schema(schema.name, schema.encoding, schema.data))
            for _, time_ns, message in log.read_messages(channel.topic):
                writer.add_message(number, time_ns, message.SerializeToString(), time_ns)
        writer.finish()
    return open_log(path)


@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.ALL & ~IndexType.MESSAGE], ids=["index", "no index"])
def test_columns_equal_the_parsed_messages_whoever_wrote_them(tmp_path: Path, index_types: IndexType) -> None:
    """Columns read through the chunk index equal those that protobuf's own parser reads."""
    log = open_log(record_run(tmp_path / "trace.mcap", stop=3000))
    other = rewrite(log, tmp_path / "other.mcap", index_types)
    for topic in ("/signals", "/timing", "/events"):
        columns, same = log.read_columns(topic), other.read_columns(topic)
        messages = [(time_ns, message) for _, time_ns, message in log.read_messages(topic)]
        assert len(messages) > 1 and columns.keys() == same.keys()
        assert columns["time_ns"].tolist() == same["time_ns"].tolist() == [time_ns for time_ns, _ in messages]
        for name in columns.keys() - {"time_ns"}:
            np.testing.assert_array_equal(columns[name], [getattr(message, name) for _, message in messages])
            np.testing.assert_array_equal(same[name], columns[name])
    assert len(log.read_columns("/nothing")["time_ns"]) == 0


@dataclass(slots=True)
class OldTiming:
    """A cycle's timing as logs of version 0.1 have it."""

    cycle: U32 = field(metadata={"unit": "", "doc": ""})
    overrun: bool = field(metadata={"unit": "", "doc": ""})
    lateness: float = field(metadata={"unit": "s", "doc": ""})
    response: float = field(metadata={"unit": "s", "doc": ""})
    work: float = field(metadata={"unit": "s", "doc": ""})


def test_a_log_of_an_earlier_version_has_no_feedback_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(schema.TOPICS, "/timing", OldTiming)
    monkeypatch.setitem(schema.CHANNELS, OldTiming, schema.CHANNELS[Timing])
    with closing(Recorder(tmp_path / "trace.mcap", {}, {"period": "0.001"})) as recorder:
        for k in range(10):
            old = OldTiming(k, False, 1e-5, 2e-4, 3e-4)
            recorder.cycle(k * 1_000_000, Signals(k, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0), old)  # type: ignore[arg-type]
    timing = Trace.read(tmp_path / "trace.mcap").timing
    assert set(timing.response) == {2e-4} and len(timing.execution) == 10
    assert np.isnan([timing.feedback_response, timing.valve_response, timing.execution]).all()


MEMORY = 1 << 30  # bytes of address space: the program itself takes a third of it


PLAYED = """
import json, sys
from rig_command import rig
print(json.dumps([vars(rig(*words)) for words in json.load(sys.stdin)]))
"""


def rig_with_little_memory(*commands: tuple[object, ...]) -> list[CommandResult]:
    """Commands, one after the other, in a process that may not have more than MEMORY."""
    done = subprocess.run([sys.executable, "-c", PLAYED], text=True, capture_output=True, timeout=120,
                          preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
                          input=json.dumps(commands, default=str),
                          env={"OPENBLAS_NUM_THREADS": "1", "PATH": "/usr/bin:/bin", "PYTHONPATH": str(SUPPORT)})
    assert done.returncode == 0, (commands, done)
    return [CommandResult(**result) for result in json.loads(done.stdout)]


def assert_refused(*commands: tuple[object, ...]) -> None:
    """Each of the commands reports bad input in one line."""
    for result in rig_with_little_memory(*commands):
        assert (result.status, result.err.count("\n"), result.out) == (2, 1, ""), result.words
        assert "Memory" not in result.err


def test_a_small_log_does_not_take_gigabytes(tmp_path: Path) -> None:
    kinds = ("attachment", "record", "one chunk", "lying chunk", "many chunks", "one chunk indexed often")
    logs = [write_bomb(tmp_path / f"{kind}.mcap", kind) for kind in kinds]
    assert_refused(*(("report", log) for log in logs))  # messages by topic, and one by one
    assert_refused(*(("export", log, "--out", tmp_path / "x.log") for log in logs))
    for result in rig_with_little_memory(*(("recover", log) for log in logs)):  # keeps what is sound, if there is any
        assert result.status in (0, 2), result


def test_a_packed_table_does_not_take_gigabytes(tmp_path: Path) -> None:
    long_line, long_table = tmp_path / "line.csv.gz", tmp_path / "table.csv.gz"
    long_line.write_bytes(gzip.compress(b"t,com,xj,cor" + b" " * (1 << 27)))
    row = b"".join(b"%d.0,%s,0,0\n" % (k, b"0" * 2000) for k in range(100_000))
    long_table.write_bytes(gzip.compress(b"t,com,xj,cor\n" + row))
    assert max(long_line.stat().st_size, long_table.stat().st_size) < 1_000_000
    assert_refused(("report", long_line), ("simulate", "--command", long_line), ("report", long_table))


def test_brackets_do_not_end_the_program(tmp_path: Path) -> None:
    deep = "[" * 20_000 + "]" * 20_000
    (tmp_path / "m.toml").write_text(f"name = {deep}")
    (tmp_path / "s.toml").write_text(f"title = {deep}")
    (tmp_path / "keys.toml").write_text("title" + ".a" * 5_000 + " = 1")
    (tmp_path / "a.json").write_text(json.dumps({"points": 0}).replace("0", "[" * 200_000 + "]" * 200_000))
    assert_refused(*(tuple(tmp_path / word if "." in word else word for word in words) for words in (
        ("simulate", "--model", "m.toml"), ("run", "s.toml"), ("run", "keys.toml"), ("trend", "a.json"),
        ("fdi", "t.csv", "--bands", "m.toml"), ("campaign", "m.toml"))))
    assert "metadata signals" in catch_refusal(read_declaration, "x.mcap", {"signals": deep})
