"""The log as others read it and after a kill; its layouts in the viewers; conversion from and to other files."""

import json
import re
import shutil
import struct
import subprocess
import time
from contextlib import closing
from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Any, get_type_hints
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from places import ROOT
from refusals import catch_refusal
from rig_command import refuse, rig, write_file
from synthetic_run import ATTACHMENTS, METADATA, build_cycles, record_run

from fdi.trace import Trace, open_log
from plant import InputError
from rig.benches import EXTENDED, FD, SWITCHED, load_bench, load_bench_from_files
from rig.network import Frame, make_message
from rig.network.frame import FD_LENGTHS
from rig.recorder import U32, CanFrame, Event, NmtState, Recorder, RecorderError
from rig.recorder.convert import (
    RAW_SUFFIXES,
    export_trace,
    import_csv,
    import_frames,
    list_can_messages,
    read_raw_frames,
)
from rig.recorder.recover import recover_log
from rig.recorder.schema import TOPICS, encode_schema, make_packer

VALUES: dict[Any, st.SearchStrategy[Any]] = {
    float: st.floats(), U32: st.integers(0, 2**32 - 1), bool: st.booleans(), str: st.text(max_size=300),
    bytes: st.binary(max_size=64)}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("log") / "trace.mcap", stop=1300)


@pytest.mark.parametrize("kind", TOPICS.values(), ids=lambda kind: kind.__name__)
@given(data=st.data())
def test_packed_record_is_what_protobuf_reads(kind: type, data: st.DataObject) -> None:
    from mcap.records import Schema

    hints = get_type_hints(kind, include_extras=True)
    values = {f.name: data.draw(VALUES[hints[f.name]]) for f in fields(kind)}
    t_ns = data.draw(st.integers(0, 2**63))
    item = Frame(t_ns, values["cob_id"], values["data"]) if kind is CanFrame else kind(**values)
    raw = make_packer(kind)(t_ns, item)
    opcode, length, _, _, log_time, publish_time = struct.unpack_from("<BQHIQQ", raw)
    assert (opcode, length, log_time, publish_time) == (5, len(raw) - 9, t_ns, t_ns)
    schema = Schema(1, encode_schema(kind), "protobuf", f"eha.{kind.__name__}")
    decode = DecoderFactory().decoder_for("protobuf", schema)
    message = decode(raw[31:])
    for name, value in values.items():
        assert getattr(message, name) == value or value != value


def test_library_reads_a_complete_log(log: Path) -> None:
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        rows = [(c.topic, m.log_time, d) for _, c, m, d in reader.iter_decoded_messages()]
        names = {a.name: a.data for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert summary.statistics.message_count == len(rows)
    assert {c.topic: c.metadata for c in summary.channels.values()}["/signals"]["unit.p12"] == "Pa"
    assert names == {name: data for name, (_, data) in ATTACHMENTS.items()}
    assert metadata == {"run": METADATA, "verdict": {"status": "ABORTED"}}
    cycles = [(t, f, s) for t, f, s, _ in build_cycles() if s.cycle < 1300]
    assert [(t, d.cycle, d.xj, d.p12) for topic, t, d in rows if topic == "/signals"] == \
        [(t, s.cycle, s.xj, s.p12) for t, _, s in cycles]
    assert [(t, d.cob_id, d.data) for topic, t, d in rows if topic == "/can"] == \
        [tuple(f) for _, fs, _ in cycles for f in fs]
    assert sum(topic == "/timing" for topic, _, _ in rows) == 1300


def test_chunks_are_closed_in_time_behind_attachments_and_metadata(log: Path) -> None:
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert len(summary.chunk_indexes) >= 4
    for chunk in summary.chunk_indexes:
        assert chunk.message_end_time - chunk.message_start_time <= 250_000_000 and chunk.uncompressed_size < 100_000
    first = min(c.chunk_start_offset for c in summary.chunk_indexes)
    assert all(a.offset < first for a in summary.attachment_indexes)
    assert min(m.offset for m in summary.metadata_indexes) < first


def _until_it_fails(recorder: Recorder) -> RecorderError:
    with pytest.raises(RecorderError) as caught:
        for k in range(500):
            recorder.put(k * 1_000_000, Event("INFO", "test", "x" * 1000))
            time.sleep(0.01)
    recorder.put(0, Event("INFO", "test", "told once: from here on the loop is left alone"))
    recorder.close()
    return caught.value


def test_folder_gone_is_told_once(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run" / "trace.mcap", {}, {})
    shutil.rmtree(tmp_path / "run")
    assert "deleted" in str(_until_it_fails(recorder))


@pytest.mark.parametrize("place", ["/dev/full", "{}/file/trace.mcap"])
def test_a_place_that_cannot_be_written_is_told_at_once(place: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecorderError, match="cannot be written"):
        Recorder(Path(place.format(tmp_path)), {}, {})


def test_full_disk_in_mid_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder(tmp_path / "trace.mcap", {}, {})

    def write(data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder._file, "_write", write)
    error = _until_it_fails(recorder)
    assert str(error) == f"{tmp_path / 'trace.mcap'}: the log cannot be written: No space left on device"


def test_close_tells_what_the_loop_did_not_hear(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "trace.mcap", {}, {})
    recorder.put(0, NmtState(2, "not a number", "x"))  # type: ignore[arg-type]
    with pytest.raises(RecorderError, match="the log stops here"):
        recorder.close()
    recorder.close()


def test_times_are_dates_for_others_and_seconds_of_the_run_for_us(tmp_path: Path) -> None:
    """MCAP's log and publish times count from 1970; our own readers count from the start, as in a log without dates."""
    epoch_ns = 1_790_000_000_123_456_789
    for name, epoch in (("dated", epoch_ns), ("old", 0)):
        with closing(Recorder(tmp_path / f"{name}.mcap", {}, {"period": "0.001"}, epoch)) as recorder:
            for t_ns, frames, signals, timing in islice(build_cycles(), 400):
                for frame in frames:
                    recorder.frame(frame)
                recorder.cycle(t_ns, signals, timing)
            recorder.put(250_000_000, Event("INFO", "phase", "main"))
    with (tmp_path / "dated.mcap").open("rb") as stream:
        times = [(m.log_time, m.publish_time) for _, _, m in make_reader(stream).iter_messages(topics=["/signals"])]
    assert times == [(epoch_ns + k * 1_000_000,) * 2 for k in range(400)]
    dated, old = open_log(tmp_path / "dated.mcap"), open_log(tmp_path / "old.mcap")
    assert dated.metadata["clock"] == {"epoch_ns": str(epoch_ns), "start": "2026-09-21T14:13:20+00:00"}
    assert list(dated.list_raw_messages()) == list(old.list_raw_messages())
    assert {name: column.tolist() for name, column in dated.read_columns("/signals").items()} == \
        {name: column.tolist() for name, column in old.read_columns("/signals").items()}
    assert [t for _, t, _ in dated.read_messages("/events", "/can")] == \
        [t for _, t, _ in old.read_messages("/events", "/can")]


@pytest.mark.parametrize("text", ["-1", "1e9", "99999999999999999999", "²"])
def test_a_start_that_is_no_date_is_refused(tmp_path: Path, text: str) -> None:
    with closing(Recorder(tmp_path / "x.mcap", {}, {})) as recorder:
        recorder.metadata("clock", {"epoch_ns": text})
    assert "clock.epoch_ns" in catch_refusal(open_log, tmp_path / "x.mcap")


def test_every_cut_gives_a_readable_log_or_a_clear_refusal(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    counts = []
    for cut in range(0, len(data), 9001):
        path, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
        path.write_bytes(data[:cut])
        try:
            counts.append(recover_log(path, out).messages)
        except InputError as error:
            assert cut < 200 and "MCAP log" in str(error)
            continue
        with out.open("rb") as stream:
            assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == counts[-1]
    assert counts == sorted(counts) and counts[-1] > 0


def test_damage_in_the_middle_costs_one_chunk(log: Path, tmp_path: Path) -> None:
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    chunk = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)[2]
    data = bytearray(log.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 100] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    salvage = recover_log(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert not salvage.complete and "damaged chunk" in salvage.reason
    assert salvage.lost_bytes >= chunk.chunk_length
    trace = Trace.read(tmp_path / "out.mcap", all=True)
    assert len(trace.gaps) == 1 and len(trace) == 1300
    assert "chunk at byte" in catch_refusal(Trace.read, tmp_path / "bad.mcap")


def test_a_changed_attachment_is_refused_and_left_out_of_a_salvage(log: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(log.read_bytes().replace(b"'synthetic'", b"'Synthetic'"))
    assert ("attachment sequence.toml: expected sound data (its checksum is wrong)" in
            catch_refusal(Trace.read, tmp_path / "bad.mcap") and
            "damaged file sequence.toml" in str(recover_log(tmp_path / "bad.mcap", tmp_path / "out.mcap")))


def test_a_whole_log_stays_the_same(log: Path, tmp_path: Path) -> None:
    salvage = recover_log(log, tmp_path / "out.mcap")
    assert salvage.complete and salvage.lost_bytes == 0
    before, after = Trace.read(log, all=True), Trace.read(tmp_path / "out.mcap", all=True)
    assert (before.xj == after.xj).all() and before.events == after.events and before.attachments == after.attachments


@pytest.mark.parametrize(("name", "message"), [("text.mcap", "MCAP log"), ("none.mcap", "a file that can be read")])
def test_refusals(name: str, message: str, log: Path, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("t,com,xj,cor\n")
    assert message in catch_refusal(recover_log, tmp_path / name, tmp_path / "out.mcap")
    assert "another file" in catch_refusal(recover_log, log, log)


FOLDER = ROOT / "docs" / "viewers"
Fields = dict[str, set[str]]  # topic -> names of its fields
SCALES = {"mm": 1e3, "mA": 1e3, "bar": 1e-5, "um": 1e6, "N": 1.0, "us": 1e6}  # of the units in titles, from SI


@pytest.fixture(scope="module")
def topics(preflight: Path) -> tuple[Fields, Fields]:
    """Topic -> all fields, and those that are numbers, of the messages in the log."""
    with (preflight / "trace.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        last = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
    kinds = {topic: {field.name: type(getattr(message, field.name)) for field in message.DESCRIPTOR.fields}
             for topic, message in last.items()}
    return ({topic: set(fields) for topic, fields in kinds.items()},
            {topic: {name for name, kind in fields.items() if kind in (float, int, bool)}
             for topic, fields in kinds.items()})


def list_panels(layout: Any) -> list[str]:
    """The panels of a Foxglove layout, from its tree of splits."""
    if isinstance(layout, str):
        return [layout]
    assert layout["direction"] in ("row", "column") and 0 < layout["splitPercentage"] < 100
    return list_panels(layout["first"]) + list_panels(layout["second"])


def test_foxglove_paths_are_in_the_log(topics: tuple[Fields, Fields]) -> None:
    layout = json.loads((FOLDER / "eha.foxglove.json").read_text())
    panels = list_panels(layout["layout"])
    assert len(panels) == len(set(panels)) and set(panels) == set(layout["configById"])
    every, numbers = topics
    panel_topics = set()
    for name, panel in layout["configById"].items():
        if "topicPath" in panel:
            assert panel["topicPath"] in every
            panel_topics.add(panel["topicPath"])
        for path in panel.get("paths", []):
            match = re.fullmatch(r"(/\w+)(?:\{(\w+)==\d+\})?\.(\w+)(?:\.@mul\(([\d.]+)\))?", path["value"])
            assert match, path["value"]
            topic, filter_field, field, factor = match.groups()
            assert field in every[topic] and (filter_field is None or filter_field in numbers[topic])
            panel_topics.add(topic)
            if name.startswith("Plot!"):
                unit = re.search(r"\[(.*)\]", panel["foxglovePanelTitle"])
                assert field in numbers[topic] and unit and float(factor or 1.0) == SCALES[unit[1]]
    assert panel_topics == set(every) - {"/can"}


def test_plotjuggler_curves_are_in_the_log(topics: tuple[Fields, Fields]) -> None:
    root = ElementTree.parse(FOLDER / "eha.plotjuggler.xml").getroot()
    curves = [(area.attrib["name"], curve) for area in root.iter("DockArea") for curve in area.iter("curve")]
    assert len(curves) > 10
    for title, curve in curves:
        topic, field = curve.attrib["name"][1:].split("/")
        options, unit = curve.find("transform[@name='Scale/Offset']/options"), re.search(r"\[(.*)\]", title)
        scale = 1.0 if options is None else float(options.attrib["value_scale"])
        assert field in topics[1][f"/{topic}"] and scale == (SCALES[unit[1]] if unit else 1.0), title
    for splitter in root.iter("DockSplitter"):
        assert len(splitter) == int(splitter.attrib["count"]) == len(splitter.attrib["sizes"].split(";"))


def test_the_page_names_the_topics_and_fields(topics: tuple[Fields, Fields]) -> None:
    page = (ROOT / "docs" / "viewers.md").read_text()
    rows = {topic: set(re.findall(r"`(\w+)`", text)) for topic, text in
            re.findall(r"^\| `(/\w+)` \|[^|]*\|(.*)\|$", page, re.MULTILINE)}
    assert rows.pop("/checks") < topics[0]["/checks"]
    assert rows == {topic: fields for topic, fields in topics[0].items() if topic != "/checks"}


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
    original, copy = Trace.read(log, all=True), Trace.read(tmp_path / "back.mcap")
    for name, resolution in {"com": 1e-7, "xj": 1e-7, "cor": 1e-8, "p12": 10.0, "xs": 1e-9}.items():
        np.testing.assert_allclose(copy.column(name), original.column(name), atol=0.51 * resolution)
    assert np.isnan(copy.load).all() and not copy.gaps
    assert {*bench.files} <= copy.attachments.keys()
    assert copy.provenance["imported"] == out.name


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
    with closing(Recorder(tmp_path / "x.mcap", {}, {})) as recorder:
        for frame in frames:
            recorder.frame(frame)
    assert list(read_raw_frames(tmp_path / "x.mcap")) == frames
    out = tmp_path / f"x{suffix}"
    assert export_trace(tmp_path / "x.mcap", out) == len(frames)
    messages = list(list_can_messages(out))
    for frame, (_, message) in zip(frames, messages, strict=True):
        if not message.is_fd or frame.data:
            assert message.equals(make_message(*frame[1:]), timestamp_delta=None, check_channel=False)
    import_frames(out, tmp_path / "back.mcap", load_bench())
    assert [frame[1:] for frame in read_raw_frames(tmp_path / "back.mcap")] == [frame[1:] for frame in frames]


def test_fd_frames_do_not_go_into_a_trc(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path / "x.mcap", {}, {})) as recorder:
        recorder.frame(Frame(0, FD | 0x80, bytes(64)))
    assert "x.trc: --out: expected a name that ends in .log, .blf or .asc" in catch_refusal(
        export_trace, tmp_path / "x.mcap", tmp_path / "x.trc")
    assert not (tmp_path / "x.trc").exists()


def test_wireshark_decodes_the_export(log: Path, tmp_path: Path) -> None:
    if not shutil.which("tshark"):
        pytest.skip("no tshark on this machine (Debian: apt-get install tshark)")
    export_trace(log, tmp_path / "x.blf")
    words = ["tshark", "-r", str(tmp_path / "x.blf"), "-d", "can.subdissector,canopen", "-T", "fields", "-e", "can.id",
             "-e", "_ws.malformed"]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 6500 and {line.strip() for line in lines} == {"128", "386", "387", "514", "643"}


# In cycle 2 no drive frame comes, in cycle 3 the late one of cycle 2; cycles 4 and 5 are missing.
CANDUMP = """\
(1700000000.000000) can0 202#102700000700feff
(1700000000.000100) can0 080#
(1700000000.000200) can0 183#2027000000010000
(1700000000.000300) can0 182#E80300000F00feff
(1700000000.001000) can0 202#102700000700ffff
(1700000000.001100) can0 080#
(1700000000.001200) can0 183#2027000000010000
(1700000000.001300) can0 182#E80300000F00ffff
(1700000000.002000) can0 202#1027000007000000
(1700000000.002100) can0 080#
(1700000000.002200) can0 183#2027000000010000
(1700000000.003000) can0 202#1027000007000100
(1700000000.003100) can0 080#
(1700000000.003200) can0 183#2027000000010000
(1700000000.003300) can0 182#E80300000F000000
(1700000000.006000) can0 202#1027000007000400
(1700000000.006100) can0 080#
(1700000000.006200) can0 183#2027000000010000
(1700000000.006300) can0 182#E80300000F000400
(1700000000.010000) can0 702#7F
(1700000000.011000) can0 083#5082010000000000
(1700000000.012000) can0 202#1027
"""


@pytest.mark.parametrize(("faster", "emcy"), [(1, "083"), (4, "0BA")])
def test_lost_and_late_frames_of_a_candump(faster: int, emcy: str, tmp_path: Path) -> None:
    text = re.sub(r"\.(\d+)", lambda match: f".{int(match[1]) // faster:06}", CANDUMP).replace("083#", f"{emcy}#")
    bench = load_bench_from_files({name: data.replace(b"$NODEID+0x80", f"0x{emcy}".encode()) if name == "node3.eds"
                                   else data for name, data in load_bench().files.items()})
    assert import_frames(write_file(tmp_path / "x.log", text), tmp_path / "x.mcap", bench) == 5
    trace = Trace.read(tmp_path / "x.mcap")
    assert trace.period == 1e-3 / faster and len(trace) == 7 and [g.cycles for g in trace.gaps] == [2]
    np.testing.assert_allclose([trace.cor, trace.com], [[1e-5, 1e-5, 1e-5, np.nan, np.nan, np.nan, 1e-5],
                                                        [1e-3, 1e-3, 1e-3, 1e-3, np.nan, np.nan, 1e-3]])
    assert {(n.node, n.name) for n in trace.nmt} | {(e.kind, e.text[:14]) for e in trace.events} == {
        (2, "pre-operational"), ("emcy", "node 3: 0x8250"), ("frame", "0x202: 2 bytes")}


@pytest.mark.parametrize(("before", "cycles"), [("(1700000000.002000)", 3), ("(1700000000.006000)", 4)])
def test_main_is_the_longest_piece_between_starts_of_the_plant(before: str, cycles: int, tmp_path: Path) -> None:
    """A run resets it after its probes: a replay across the reset would find fault with the model."""
    assert import_frames(
        write_file(tmp_path / "x.log", CANDUMP.replace(before, f"(1700000000.001900) can0 703#00\n{before}", 1)),
        tmp_path / "x.mcap", load_bench()) == cycles


def test_csv_becomes_a_log(log: Path, tmp_path: Path) -> None:
    export_trace(log, tmp_path / "x.csv.gz")
    assert import_csv(tmp_path / "x.csv.gz", tmp_path / "y.mcap") == 1000
    before, after = Trace.read(log), Trace.read(tmp_path / "y.mcap")
    np.testing.assert_array_equal(before.xj, after.xj)
    np.testing.assert_array_equal(before.t, after.t)


def test_commands(log: Path, tmp_path: Path) -> None:
    assert rig("export", log, "--out", tmp_path / "x.csv", "--json").json["count"] == 1000
    assert rig("export", log, "--all", "--force", "--out", tmp_path / "x.csv", "--json").json["count"] == 1300
    assert rig("import", tmp_path / "x.csv", "--json").json == {"trace": str(tmp_path / "x.mcap"), "cycles": 1300}
    assert "at least one raw frame" in refuse("export", tmp_path / "x.mcap", "--out", tmp_path / "x.blf")
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-2000])
    answer = rig("recover", tmp_path / "cut.mcap", "--json").json
    assert answer["path"] == str(tmp_path / "cut.recovered.mcap") and not answer["complete"]
