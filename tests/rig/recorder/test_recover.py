"""A log whose writer was killed comes back, up to the last half second."""

from pathlib import Path

import pytest
from mcap.reader import make_reader
from synthetic_run import record_run

from fdi.trace.trace import Trace
from plant.errors import InputError
from rig.recorder.recover import recover_log


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("log") / "trace.mcap", stop=1000)


def test_every_cut_gives_a_readable_log_or_a_clear_refusal(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    kept = []
    for cut in range(0, len(data), 9001):
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
