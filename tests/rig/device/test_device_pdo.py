"""SYNC, PDOs and EMCY: latch order, transmission types, wrong lengths, error register and history."""
from __future__ import annotations

import struct
from pathlib import Path

import pytest
from device_bench import Rack

from dbc import EDS
from plant.errors import InputError
from rig.device import Device, NmtCommand
from rig.network import codec

TOO_SHORT, TOO_LONG = bytes.fromhex("1082110100000000"), bytes.fromhex("2082110100000000")
NO_ERROR = bytes(8)
DRIVE = bytes.fromhex("0100000002000300")  # current 1, status 2, cycle 3


def running(node: int = 3) -> Rack:
    rack = Rack(node)
    rack.nmt(NmtCommand.START)
    return rack


def download(rack: Rack, index: int, sub: int, value: int, size: int) -> bytes:
    """Expedited SDO download; the answer."""
    head = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub)
    answers = rack.send(0x600 + rack.node, head + value.to_bytes(4, "little"))
    return answers[0][1]


def test_order_within_a_sync_is_latch_hook_transmit() -> None:
    """The hook sees the drive frame latched at this SYNC, and what it writes leaves in this SYNC's TPDOs."""
    rack = running()
    device = rack.device

    def cycle() -> None:
        device.write(0x2200, 0, int(device.read(0x2205)) * 10)
        device.write(0x2204, 0, device.read(0x2207))

    device.on_sync = cycle
    rack.send(0x182, DRIVE)
    assert device.read(0x2205) == 0  # not before SYNC
    assert rack.sync() == [(0x183, struct.pack("<ii", 10, 0)), (0x283, struct.pack("<iHH", 0, 0, 3))]


def test_last_frame_before_sync_counts_and_fresh_says_if_there_was_one() -> None:
    rack = running()
    rpdo = rack.device.pdo.rpdos[1]
    rack.send(0x182, DRIVE)
    rack.send(0x182, codec.pack_drive(5e-8, 0, 4))
    rack.sync()
    assert (rack.device.read(0x2205), rack.device.read(0x2207), rpdo.fresh) == (5, 4, True)
    rack.sync()
    assert (rack.device.read(0x2205), rpdo.fresh) == (5, False)


def test_asynchronous_rpdo_is_there_when_its_hook_is_called() -> None:
    rack, seen = running(2), []
    rack.device.on_rpdo = lambda n: seen.append((n, rack.device.read(0x2102), rack.device.read(0x2103)))
    rack.send(0x183, struct.pack("<ii", -7, 9))
    assert seen == [(2, -7, 9)]


def test_node_2_answers_feedback_with_drive_and_latches_the_command_at_sync() -> None:
    rack = running(2)
    device = rack.device

    def answer(_: int) -> None:
        device.write(0x2104, 0, int(device.read(0x2100)) - int(device.read(0x2102)))
        device.transmit(1)

    device.on_rpdo = answer
    rack.send(0x202, codec.pack_command(100e-7, 0, 0))
    assert rack.send(0x183, codec.pack_feedback(1e-7, 0)) == [(0x182, codec.pack_drive(-1e-8, 0, 0))]
    rack.sync()
    assert rack.send(0x183, codec.pack_feedback(1e-7, 0)) == [(0x182, codec.pack_drive(99e-8, 0, 0))]


@pytest.mark.parametrize(("kind", "expected"), [(1, [1, 1, 1, 1, 1, 1]), (2, [0, 1, 0, 1, 0, 1]), (3, [0, 0, 1] * 2)])
def test_cyclic_transmission_types(kind: int, expected: list[int]) -> None:
    rack = running()
    assert download(rack, 0x1800, 2, kind, 1)[0] == 0x60
    assert [sum(cob_id == 0x183 for cob_id, _ in rack.sync()) for _ in expected] == expected


def test_acyclic_transmission_waits_for_the_next_sync() -> None:
    rack = running()
    download(rack, 0x1800, 2, 0, 1)
    assert [cob_id for cob_id, _ in rack.sync()] == [0x283]
    rack.device.transmit(1)
    assert rack.wait(0) == []
    assert [cob_id for cob_id, _ in rack.sync()] == [0x183, 0x283]
    assert [cob_id for cob_id, _ in rack.sync()] == [0x283]


def test_rpdo_can_be_made_asynchronous_moved_and_switched_off() -> None:
    rack = running()
    download(rack, 0x1400, 2, 255, 1)
    rack.send(0x182, DRIVE)
    assert rack.device.read(0x2205) == 1
    download(rack, 0x1400, 1, 0x80000182, 4)
    download(rack, 0x1400, 1, 0x345, 4)
    rack.send(0x182, codec.pack_drive(2e-8, 0, 0))
    rack.send(0x345, codec.pack_drive(3e-8, 0, 0))
    assert rack.device.read(0x2205) == 3
    download(rack, 0x1400, 1, 0x80000345, 4)
    rack.send(0x345, codec.pack_drive(4e-8, 0, 0))
    assert rack.device.read(0x2205) == 3
    download(rack, 0x1800, 1, 0x80000183, 4)
    assert [cob_id for cob_id, _ in rack.sync()] == [0x283]
    rack.nmt(NmtCommand.RESET_COMMUNICATION)
    rack.nmt(NmtCommand.START)
    rack.send(0x182, codec.pack_drive(5e-8, 0, 0))
    assert [cob_id for cob_id, _ in rack.sync()] == [0x183, 0x283]
    assert rack.device.read(0x2205) == 5


@pytest.mark.parametrize(("sub", "value", "size"), [(2, 241, 1), (2, 252, 1), (1, 0x20000183, 4), (1, 0xA0000800, 4)])
def test_meaningless_communication_parameters_are_refused(sub: int, value: int, size: int) -> None:
    rack = running()
    assert download(rack, 0x1800, sub, value, size).hex() == f"800018{sub:02x}30000906"
    assert [cob_id for cob_id, _ in rack.sync()] == [0x183, 0x283]


RESTRICTED = (0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x77F, 0x780, 0x7FF)
PERMITTED = (0x081, 0x0FF, 0x100, 0x181, 0x580, 0x600, 0x680, 0x6DF, 0x700)


@pytest.mark.parametrize("base", [0x1400, 0x1800])
def test_restricted_identifiers_are_refused_and_their_neighbours_are_not(base: int) -> None:
    """CiA 301, table 40, at both ends of each range; and the SYNC that this device consumes."""
    rack = running()
    for can_id in (*RESTRICTED, 0x080):
        assert download(rack, base, 1, 0x80000183, 4)[0] == 0x60
        assert download(rack, base, 1, can_id, 4).hex() == f"8000{base >> 8:x}0130000906", hex(can_id)
        assert rack.device.read(base, 1) == 0x80000183
    for can_id in PERMITTED:
        assert download(rack, base, 1, 0x80000183, 4)[0] == 0x60
        assert download(rack, base, 1, can_id, 4)[0] == 0x60, hex(can_id)


@pytest.mark.parametrize("base", [0x1400, 0x1800])
def test_the_identifier_of_a_valid_pdo_is_fixed(base: int) -> None:
    """CiA 301, 7.5.2.35: it is first made invalid. The same value, or only bit 30, may be written at any time."""
    rack = running()
    valid = int(rack.device.read(base, 1))
    assert download(rack, base, 1, 0x345, 4).hex() == f"8000{base >> 8:x}0122000008"
    assert rack.device.read(base, 1) == valid
    assert download(rack, base, 1, valid, 4)[0] == 0x60
    assert download(rack, base, 1, valid | 1 << 30, 4)[0] == 0x60
    assert download(rack, base, 1, 0x80000345, 4)[0] == 0x60  # as the canopen library switches a PDO off
    assert download(rack, base, 1, 0x345, 4)[0] == 0x60
    assert download(rack, base, 1, valid, 4)[0] == 0x80


def test_a_frame_that_waits_for_sync_is_dropped_when_its_pdo_is_switched_off() -> None:
    rack = running()
    rack.send(0x182, DRIVE)
    download(rack, 0x1400, 1, 0x80000182, 4)
    download(rack, 0x1400, 1, 0x182, 4)
    rack.sync()
    assert rack.device.read(0x2205) == 0


def require_writable(tmp_path: Path, *sections: str) -> Rack:
    """Node 3 with a dictionary in which these constants may be written."""
    text = EDS[3].read_text()
    for section in sections:
        head, found, tail = text.partition(f"[{section}]\n")
        assert found
        text = head + found + tail.replace("AccessType=const", "AccessType=rw", 1)
    path = tmp_path / "writable.eds"
    path.write_text(text)
    rack = Rack(eds=path)
    rack.nmt(NmtCommand.START)
    return rack


def test_identifier_of_emcy_follows_the_same_rules(tmp_path: Path) -> None:
    rack = require_writable(tmp_path, "1014")
    assert download(rack, 0x1014, 0, 0x84, 4).hex() == "8014100022000008"
    assert download(rack, 0x1014, 0, 0x80000083, 4)[0] == 0x60
    assert rack.send(0x182, b"") == []
    assert download(rack, 0x1014, 0, 0x701, 4).hex() == "8014100030000906"
    assert download(rack, 0x1014, 0, 0x84, 4)[0] == 0x60
    assert rack.send(0x182, DRIVE) == [(0x084, NO_ERROR)]


@pytest.mark.parametrize("value", [0x40000080, 0x20000080, 0x701, 0x0])
def test_identifier_of_sync_may_not_be_restricted_nor_make_a_producer(tmp_path: Path, value: int) -> None:
    rack = require_writable(tmp_path, "1005")
    assert download(rack, 0x1005, 0, value, 4).hex() == "8005100030000906"
    assert download(rack, 0x1005, 0, 0x90, 4)[0] == 0x60
    assert rack.sync() == []
    assert [cob_id for cob_id, _ in rack.send(0x090)] == [0x183, 0x283]


def test_a_mapping_that_a_master_could_change_is_refused(tmp_path: Path) -> None:
    """The core reads mappings once: it must not confirm a change that has no effect."""
    with pytest.raises(InputError, match=r"1A00sub1\.AccessType: expected const"):
        require_writable(tmp_path, "1A00sub1")


def test_short_pdo_is_not_processed_and_says_so_once() -> None:
    rack = running()
    assert rack.send(0x182, DRIVE[:7]) == [(0x083, TOO_SHORT)]
    assert rack.send(0x182, b"") == []  # still the same error
    rack.sync()
    assert rack.device.read(0x2205) == 0
    assert rack.send(0x182, DRIVE) == [(0x083, NO_ERROR)]
    rack.sync()
    assert rack.device.read(0x2205) == 1
    assert rack.send(0x182, DRIVE[:4]) == [(0x083, TOO_SHORT)]  # a new one


def test_too_long_pdo_is_processed_with_its_first_bytes(tmp_path: Path) -> None:
    """A frame has 8 bytes at most, so it takes a mapping of one object instead of three to see it."""
    head, section, tail = EDS[3].read_text().partition("[1600sub0]")
    path = tmp_path / "short.eds"
    path.write_text(head + section + tail.replace("DefaultValue=0x3", "DefaultValue=0x1", 1))
    rack = Rack(eds=path)
    rack.nmt(NmtCommand.START)
    assert rack.send(0x182, DRIVE) == [(0x083, TOO_LONG)]
    rack.sync()
    assert (rack.device.read(0x2205), rack.device.read(0x2206)) == (1, 0)
    assert rack.send(0x182, DRIVE[:4]) == [(0x083, NO_ERROR)]
    assert rack.send(0x182, DRIVE[:3]) == [(0x083, TOO_SHORT)]
    assert rack.send(0x182, DRIVE) == [(0x083, NO_ERROR), (0x083, TOO_LONG)]


def test_sync_with_data_is_refused_and_said_once() -> None:
    rack = running()
    assert rack.send(0x080, b"\1") == [(0x083, bytes.fromhex("4082110000000000"))]
    assert rack.send(0x080, b"\2") == []
    assert rack.sync() == [(0x083, NO_ERROR), (0x183, bytes(8)), (0x283, bytes(8))]


def test_sync_lost_after_twelve_periods_and_back() -> None:
    rack = running()
    lost: list[int] = []
    rack.device.on_sync_lost = lambda: lost.append(1)

    def wait(ms: int) -> list[tuple[int, bytes]]:
        return [frame for frame in rack.wait(ms) if frame[0] != 0x703]  # heartbeats go on

    assert wait(500) == []  # none came yet: none is missed
    rack.sync()
    assert wait(12) == [] and lost == []
    assert wait(1) == [(0x083, bytes.fromhex("0081110000000000"))] and lost == [1]
    assert wait(200) == [] and lost == [1]
    assert rack.sync()[0] == (0x083, NO_ERROR)
    download(rack, 0x1006, 0, 0, 4)
    rack.sync()
    assert wait(500) == []  # not watched any more


def test_sync_is_not_missed_outside_operational() -> None:
    rack = running()
    rack.sync()
    rack.nmt(NmtCommand.ENTER_PRE_OPERATIONAL)
    assert rack.wait(50) == []


def test_error_register_and_history() -> None:
    """Errors stand side by side; the history is newest first, eight deep, and erased by writing 0."""
    rack = running()
    emcy = rack.device.emcy
    emcy.raise_error(0x8250, 0x10, b"\1")
    emcy.raise_error(0x5000, 0x80, b"\xaa\xbb\xcc\xdd\xee")
    assert [data.hex() for _, data in rack.wait(0)] == ["5082110100000000", "005091aabbccddee"]
    assert (rack.device.read(0x1003, 0), rack.device.read(0x1003, 1)) == (2, 0xBBAA5000)
    assert rack.device.read(0x1003, 2) == 0x00018250
    emcy.clear(0x8250)
    assert [data.hex() for _, data in rack.wait(0)] == ["0000810000000000"]
    emcy.clear()
    emcy.clear()
    assert [data.hex() for _, data in rack.wait(0)] == ["0000000000000000"]
    for code in range(0x6101, 0x610C):
        emcy.raise_error(code)
    assert len(rack.wait(0)) == 11
    assert [rack.device.read(0x1003, sub) for sub in (0, 1, 8)] == [8, 0x610B, 0x6104]
    assert download(rack, 0x1003, 0, 1, 1).hex() == "8003100030000906"
    assert download(rack, 0x1003, 0, 0, 1)[0] == 0x60
    assert rack.device.read(0x1003, 0) == 0


def test_errors_are_forgotten_at_reset() -> None:
    rack = running()
    rack.send(0x182, b"")
    assert rack.nmt(NmtCommand.RESET_COMMUNICATION) == [(0x703, b"\0")]
    assert (rack.device.read(0x1001), rack.device.read(0x1003), rack.device.emcy.active) == (0, 0, [])
    rack.nmt(NmtCommand.START)
    assert rack.send(0x182, b"") == [(0x083, TOO_SHORT)]


@pytest.mark.parametrize(("old", "new", "complaint"), [
    ("DefaultValue=0x22050020", "DefaultValue=0x22050010", "1600sub1: expected a mappable object"),
    ("DefaultValue=0x22050020", "DefaultValue=0x29990020", "1600sub1: expected a mappable object"),
    ("DefaultValue=0x22060010", "DefaultValue=0x22050020", "1600: expected at most 8 bytes in a PDO, not 10"),
    ("DataType=0x0011", "DataType=0x0010", "not 0x0010"),
    ("[2200]", "[2200", "electronic data sheet"),
])  # fmt: skip
def test_impossible_dictionary_is_refused_in_one_line(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    node = 2 if "Type" in old else 3
    path = tmp_path / "bad.eds"
    path.write_text(EDS[node].read_text().replace(old, new))
    with pytest.raises(InputError) as caught:
        Device(node, path, lambda cob_id, data: None)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
