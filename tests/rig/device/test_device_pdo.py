"""SYNC, PDOs and EMCY: latch order, transmission types, wrong lengths, error register and history."""

import struct
from pathlib import Path

import pytest
from device_bench import Rack, change_sheet

from dbc import EDS
from plant.errors import InputError
from rig.device import Device, NmtCommand

DRIVE = bytes.fromhex("0100000002000300")  # current 1, status 2, cycle 3
# Scripts that begin in OPERATIONAL. 182: drive frame, with the current (2205) in its first word; 083: EMCY.
SCRIPTS = {
    "the last frame before SYNC counts": """
        182 0100000002000300 ->
        182 0500000000000400 ->
        2205:0 = 0
        080 -> 183 *, 283 *
        2205:0 = 5
        2207:0 = 4""",
    "type 1: a TPDO at every SYNC": """
        write 1800:2 01 -> ok
        080 -> 183 0000000000000000, 283 0000000000000000
        080 -> 183 *, 283 *""",
    "type 2: at every second": """
        write 1800:2 02 -> ok
        080 -> 283 *
        080 -> 183 *, 283 *
        080 -> 283 *
        080 -> 183 *, 283 *""",
    "type 3: at every third": """
        write 1800:2 03 -> ok
        080 -> 283 *
        080 -> 283 *
        080 -> 183 *, 283 *
        080 -> 283 *""",
    "an RPDO becomes asynchronous, is moved and switched off; a reset brings everything back": """
        write 1400:2 ff -> ok
        182 0100000002000300 ->
        2205:0 = 1
        write 1400:1 82010080 -> ok
        write 1400:1 45030000 -> ok
        182 0200000000000000 ->
        345 0300000000000000 ->
        2205:0 = 3
        write 1400:1 45030080 -> ok
        345 0400000000000000 ->
        2205:0 = 3
        write 1800:1 83010080 -> ok
        080 -> 283 *
        000 8203 -> 703 00
        000 0103 ->
        182 0500000000000000 ->
        080 -> 183 *, 283 *
        2205:0 = 5""",
    "meaningless communication parameters are refused": """
        write 1800:2 f1 -> 06090030
        write 1800:2 fc -> 06090030
        write 1800:1 83010020 -> 06090030
        write 1800:1 000800a0 -> 06090030
        write 1800:1 83010080 -> ok
        write 1800:1 80000000 -> 06090030
        write 1800:1 83010000 -> ok
        080 -> 183 *, 283 *""",
    "a frame that waits for SYNC is dropped when its PDO is switched off": """
        182 0100000002000300 ->
        write 1400:1 82010080 -> ok
        write 1400:1 82010000 -> ok
        080 -> 183 *, 283 *
        2205:0 = 0""",
    "a short PDO is not processed and says so once": """
        182 01000000020003 -> 083 1082110100000000
        182 ->
        080 -> 183 *, 283 *
        2205:0 = 0
        182 0100000002000300 -> 083 0000000000000000
        080 -> 183 *, 283 *
        2205:0 = 1
        182 01000000 -> 083 1082110100000000""",
    "SYNC with data is refused and said once": """
        080 01 -> 083 4082110000000000
        080 02 ->
        080 -> 083 0000000000000000, 183 *, 283 *""",
    "SYNC is not missed outside OPERATIONAL": """
        080 -> 183 *, 283 *
        000 8003 ->
        wait 50 -> """,
    "errors are forgotten at a reset": """
        182 -> 083 1082110100000000
        000 8203 -> 703 00
        1001:0 = 0
        1003:0 = 0
        000 0103 ->
        182 -> 083 1082110100000000""",
}


def running(node: int = 3, eds: Path | None = None) -> Rack:
    rack = Rack(node, eds=eds)
    rack.nmt(NmtCommand.START)
    return rack


@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_script(script: str) -> None:
    running().play(script)


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


def test_fresh_says_whether_a_frame_came_since_the_last_sync() -> None:
    rack = running()
    rack.send(0x182, DRIVE)
    for is_fresh in (True, False):
        rack.sync()
        assert rack.device.pdo.rpdos[1].fresh is is_fresh


def test_acyclic_transmission_waits_for_the_next_sync() -> None:
    rack = running()
    rack.play("write 1800:2 00 -> ok\n080 -> 283 *")
    rack.device.transmit(1)
    rack.play("wait 0 ->\n080 -> 183 *, 283 *\n080 -> 283 *")


def test_identifier_of_sync_may_not_be_restricted_nor_make_a_producer(tmp_path: Path) -> None:
    running(eds=change_sheet(tmp_path, ("1005", "AccessType=const", "AccessType=rw"))).play("""
        write 1005:0 80000040 -> 06090030
        write 1005:0 80000020 -> 06090030
        write 1005:0 01070000 -> 06090030
        write 1005:0 00000000 -> 06090030
        write 1005:0 90000000 -> ok
        080 ->
        090 -> 183 *, 283 *""")


def test_a_mapping_that_a_master_could_change_is_refused(tmp_path: Path) -> None:
    """The core reads mappings once: it must not confirm a change that has no effect."""
    with pytest.raises(InputError, match=r"1A00sub1\.AccessType: expected const"):
        running(eds=change_sheet(tmp_path, ("1A00sub1", "AccessType=const", "AccessType=rw")))


def test_too_long_pdo_is_processed_with_its_first_bytes(tmp_path: Path) -> None:
    """A frame has 8 bytes at most, so it takes a mapping of one object instead of three to see it."""
    running(eds=change_sheet(tmp_path, ("1600sub0", "DefaultValue=0x3", "DefaultValue=0x1"))).play("""
        182 0100000002000300 -> 083 2082110100000000
        080 -> 183 *, 283 *
        2205:0 = 1
        2206:0 = 0
        182 01000000 -> 083 0000000000000000
        182 010000 -> 083 1082110100000000
        182 0100000002000300 -> 083 0000000000000000, 083 2082110100000000""")


def test_sync_lost_after_twelve_periods_and_back() -> None:
    rack = running()
    lost: list[int] = []
    rack.device.on_sync_lost = lambda: lost.append(1)
    rack.play("write 1017:0 0000 -> ok\nwait 500 ->\n080 -> 183 *, 283 *\nwait 12 -> ")  # none missed before the first
    assert lost == []
    rack.play("wait 1 -> 083 0081110000000000\nwait 200 ->")
    assert lost == [1]
    rack.play("080 -> 083 0000000000000000, 183 *, 283 *\nwrite 1006:0 00000000 -> ok")
    rack.play("080 -> 183 *, 283 *\nwait 500 ->")  # not watched any more


def test_error_register_and_history() -> None:
    """Errors stand side by side; the history is newest first, eight deep, and erased by writing 0."""
    rack = running()
    emcy = rack.device.emcy
    emcy.raise_error(0x8250, 0x10, b"\1")
    emcy.raise_error(0x5000, 0x80, b"\xaa\xbb\xcc\xdd\xee")
    rack.play(f"""
        wait 0 -> 083 5082110100000000, 083 005091aabbccddee
        1003:0 = 2
        1003:1 = {0xBBAA5000}
        1003:2 = {0x00018250}""")
    emcy.clear(0x8250)
    rack.play("wait 0 -> 083 0000810000000000")
    emcy.clear()
    emcy.clear()
    rack.play("wait 0 -> 083 0000000000000000")
    for code in range(0x6101, 0x610C):
        emcy.raise_error(code)
    assert len(rack.wait(0)) == 11
    rack.play(f"""
        1003:0 = 8
        1003:1 = {0x610B}
        1003:8 = {0x6104}
        write 1003:0 01 -> 06090030
        write 1003:0 00 -> ok
        1003:0 = 0""")


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
