"""The log as others read it: the mcap library and Google's protobuf, not this project's own reader."""

import shutil
import struct
import time
from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from hypothesis import given, strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from synthetic_run import ATTACHMENTS, METADATA, build_cycles, record_run

from fdi.trace.mcap_log import open_log
from plant.errors import InputError
from rig.network.frame import Frame
from rig.recorder import U32, CanFrame, Event, NmtState, Recorder, RecorderError
from rig.recorder.schema import TOPICS, encode_schema, make_packer

VALUES: dict[Any, st.SearchStrategy[Any]] = {
    float: st.floats(), U32: st.integers(0, 2**32 - 1), bool: st.booleans(), str: st.text(max_size=300),
    bytes: st.binary(max_size=64)}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("log") / "trace.mcap", stop=1000)


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
    assert decode is not None
    message = decode(raw[31:])
    for name, value in values.items():
        assert getattr(message, name) == value or value != value


def test_library_reads_a_complete_log(log: Path) -> None:
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        rows = [(c.topic, m.log_time, d) for _, c, m, d in reader.iter_decoded_messages()]
        names = {a.name: a.data for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert summary.statistics.message_count == len(rows)
    assert {c.topic: c.metadata for c in summary.channels.values()}["/signals"]["unit.p12"] == "Pa"
    assert names == {name: data for name, (_, data) in ATTACHMENTS.items()}
    assert metadata == {"run": METADATA, "verdict": {"status": "ABORTED"}}
    written = [(t, f, s) for t, f, s, _ in build_cycles() if s.cycle < 1000]
    assert [(t, d.cycle, d.xj, d.p12) for topic, t, d in rows if topic == "/signals"] == \
        [(t, s.cycle, s.xj, s.p12) for t, _, s in written]
    assert [(t, d.cob_id, d.data) for topic, t, d in rows if topic == "/can"] == \
        [tuple(f) for _, fs, _ in written for f in fs]
    assert sum(topic == "/timing" for topic, _, _ in rows) == 1000


def test_chunks_are_closed_in_time_behind_attachments_and_metadata(log: Path) -> None:
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) >= 4
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
        recorder = Recorder(tmp_path / f"{name}.mcap", {}, {"period": "0.001"}, epoch)
        for t_ns, frames, signals, timing in islice(build_cycles(), 400):
            for frame in frames:
                recorder.frame(frame)
            recorder.cycle(t_ns, signals, timing)
        recorder.put(250_000_000, Event("INFO", "phase", "main"))
        recorder.close()
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
    recorder = Recorder(tmp_path / "x.mcap", {}, {})
    recorder.metadata("clock", {"epoch_ns": text})
    recorder.close()
    with pytest.raises(InputError, match=r"clock\.epoch_ns"):
        open_log(tmp_path / "x.mcap")
