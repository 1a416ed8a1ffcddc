"""Parts of the stack in C: the object table of an EDS, devices of a user's own, datagrams as python-can has them."""

import ctypes
import shutil
from pathlib import Path
from typing import Any

import can
import pytest
from c_device import CFrame, load_datagrams, needs_compiler, skip_without_compiler
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given, strategies as st
from places import ROOT
from refusals import catch_refusal

from rig.firmware.build import build_device
from rig.firmware.object_table import FOLDER, write_object_table

DRIVE = ROOT / "examples" / "cia402_drive"


@needs_compiler
def test_a_device_is_built_once_and_again_when_its_data_sheet_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EHA_RIG_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "drive"
    shutil.copytree(DRIVE, folder)
    first = build_device(folder)
    assert build_device(folder) == first and first.name.startswith("drive-")
    eds = folder / "drive.eds"
    eds.write_text(eds.read_text().replace("DefaultValue=3.8", "DefaultValue=3.9"))
    assert build_device(folder) != first


def test_a_folder_without_sources_is_refused(tmp_path: Path) -> None:
    assert "a folder with the C files of a device" in catch_refusal(build_device, tmp_path)


def test_values_that_depend_on_the_node_number_are_marked() -> None:
    source = write_object_table(DRIVE / "drive.eds")["object_table.c"]
    assert "{0x1801, 0x01, KIND_UNSIGNED, 4, READABLE | WRITABLE | NODE_RELATIVE, 0x280u, 0, 0, NULL, 0}" in source
    assert "{0x6078, 0x00, KIND_SIGNED, 2, READABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0}" in source
    assert "{0x2002, 0x01, KIND_REAL, 4, READABLE | WRITABLE, 0x40733333u, 0, 0, NULL, 0}" in source


def test_object_table_is_that_of_the_eds() -> None:
    """After a change of dbc/node2.eds: python -m rig.firmware.object_table."""
    table = write_object_table()
    assert {name: (FOLDER / name).read_text() for name in table} == table
    assert "OBJECT_2110_05," in table["object_table.h"]
    assert "{0x2110, 0x01, KIND_REAL, 8, READABLE | WRITABLE, 0x400E666666666666ull, 0, 0, NULL, 0}" in (
        table["object_table.c"])  # 3.8


EXTENDED = 1 << 31  # in an identifier: it has 29 bits

identifiers = st.integers(0, 0x7FF) | st.integers(EXTENDED, EXTENDED | 0x1FFFFFFF)
frames = st.tuples(identifiers, st.binary(max_size=8))


def make_message(frame: tuple[int, bytes], **fields: Any) -> can.Message:
    """The frame as python-can has it."""
    return can.Message(arbitration_id=frame[0] & ~EXTENDED, is_extended_id=bool(frame[0] & EXTENDED), data=frame[1],
                       **fields)  # fmt: skip


@pytest.fixture(autouse=True)
def compiler() -> None:
    """These tests need the firmware compiled."""
    skip_without_compiler()
    load_datagrams()


def unpack(data: bytes) -> tuple[int, bytes] | None:
    """COB-ID and data that the firmware reads from a datagram; None for what it leaves out."""
    frame = CFrame()
    exact = (ctypes.c_uint8 * len(data))(*data)  # reading beyond the end would be another object's memory
    if not load_datagrams().datagram_unpack(exact, ctypes.c_size_t(len(data)), ctypes.byref(frame)):
        return None
    return frame.cob_id, bytes(frame.data[: frame.length])


@given(frames, st.booleans())
def test_it_reads_what_python_can_packs(frame: tuple[int, bytes], is_named: bool) -> None:
    message = make_message(frame, timestamp=1.5e9, channel="239.0.0.1" if is_named else None)
    assert unpack(pack_message(message)) == frame


@given(frames)
def test_python_can_reads_what_it_packs(frame: tuple[int, bytes]) -> None:
    cob_id, data = frame
    datagram = (ctypes.c_uint8 * 256)()
    size = load_datagrams().datagram_pack(
        ctypes.byref(CFrame(0, cob_id, len(data), (ctypes.c_uint8 * 8)(*data))), datagram)
    message = unpack_message(bytes(datagram[:size]), check=True)
    assert message.equals(make_message(frame), timestamp_delta=None, check_direction=False)


@pytest.mark.parametrize("flags", [
    {"is_remote_frame": True}, {"is_error_frame": True}, {"is_fd": True},
])
def test_it_leaves_out_other_frames(flags: dict[str, bool]) -> None:
    message = can.Message(arbitration_id=0x182, **({"is_extended_id": False} | flags))
    assert unpack(pack_message(message)) is None


@given(frames, st.integers(0, 200), st.integers(0, 255))
def test_a_damaged_datagram_gives_at_most_a_frame_of_eight_bytes(frame: tuple[int, bytes], at: int, byte: int) -> None:
    """Undefined behaviour ends the process, because the library is built with its sanitizer."""
    datagram = bytearray(pack_message(make_message(frame)))
    datagram[at % len(datagram)] = byte
    reading = unpack(bytes(datagram))
    assert reading is None or (len(reading[1]) <= 8 and (reading[0] <= 0x7FF or reading[0] & EXTENDED))


def test_a_datagram_that_was_cut_is_no_frame() -> None:
    datagram = pack_message(make_message((EXTENDED | 0x18FF0105, bytes(8))))
    assert [cut for cut in range(len(datagram)) if unpack(datagram[:cut])] == []
