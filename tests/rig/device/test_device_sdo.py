"""SDO server: the frames of CiA 301, 7.2.4.3, byte by byte, and every abort it knows."""
from __future__ import annotations

import random

import pytest
from device_bench import Rack

from rig.device import Abort, NmtCommand, SdoAbort


def ask(rack: Rack, request: str) -> str:
    """One request in hex, spaces allowed; the answer in hex, empty if there is none."""
    answers = rack.send(0x600 + rack.node, bytes.fromhex(request))
    assert all(cob_id == 0x580 + rack.node for cob_id, _ in answers)
    assert len(answers) <= 1
    return answers[0][1].hex() if answers else ""


def abort(multiplexer: str, code: Abort) -> str:
    return "80" + multiplexer + code.to_bytes(4, "little").hex()


def download(rack: Rack, multiplexer: str, data: bytes, announce: bool = True) -> str:
    """Segmented download; the last answer."""
    size = len(data).to_bytes(4, "little").hex() if announce else "00000000"
    answer = ask(rack, ("21" if announce else "20") + multiplexer + size)
    toggle = 0
    for at in range(0, len(data), 7):
        if not answer.startswith(("60", "20", "30")):
            break
        part = data[at : at + 7]
        command = toggle | (7 - len(part)) << 1 | (at + 7 >= len(data))
        answer = ask(rack, f"{command:02x}" + part.ljust(7, b"\0").hex())
        toggle ^= 0x10
    return answer


def test_expedited_upload_of_each_size() -> None:
    rack = Rack(2)
    assert ask(rack, "40 001000 00000000") == "4300100098010000"  # UNSIGNED32: device type, CiA 408
    assert ask(rack, "40 171000 00000000") == "4b17100064000000"  # UNSIGNED16
    assert ask(rack, "40 011000 00000000") == "4f01100000000000"  # UNSIGNED8
    rack.device.write(0x2102, 0, -2)
    assert ask(rack, "40 022100 00000000") == "43022100feffffff"  # INTEGER32


def test_segmented_upload() -> None:
    """The device name: 14 bytes, announced, then seven and seven."""
    rack = Rack(2)
    assert ask(rack, "40 081000 00000000") == "410810000e000000"
    assert ask(rack, "60 00000000000000") == "00" + b"EHA con".hex()
    assert ask(rack, "70 00000000000000") == "11" + b"troller".hex()
    assert ask(rack, "60 00000000000000") == abort("081000", Abort.COMMAND)  # nothing left


def test_expedited_download() -> None:
    rack, seen = Rack(3), []
    rack.device.on_write = lambda index, sub, data: seen.append((index, sub, data))
    assert ask(rack, "2b 171000 0a000000") == "6017100000000000"
    assert rack.device.read(0x1017) == 10
    assert ask(rack, "22 171000 0b00ffff") == "6017100000000000"  # size not said: the object's own
    assert rack.device.read(0x1017) == 11
    assert seen == [(0x1017, 0, b"\x0a\0"), (0x1017, 0, b"\x0b\0")]


def test_segmented_download_of_a_real64() -> None:
    rack = Rack(2)
    assert download(rack, "102101", bytes.fromhex("0000000000000440")).startswith("30")
    assert rack.device.read(0x2110, 1) == 2.5


@pytest.mark.parametrize("size", [1, 4, 6, 7, 8, 13, 14, 15, 6000])
@pytest.mark.parametrize("announce", [True, False])
def test_domain_of_any_size(size: int, announce: bool) -> None:
    rack, seen = Rack(3), []
    rack.device.on_write = lambda index, sub, data: seen.append(data)
    data = random.Random(size).randbytes(size)
    assert download(rack, "102200", data, announce)[:2] in ("20", "30")
    assert seen == [data]
    assert rack.device.read(0x2210) == data


ABORTS = {
    "no object": ("40 342100 00000000", Abort.NO_OBJECT),
    "no object to write": ("2f 342100 01000000", Abort.NO_OBJECT),
    "no sub-index": ("40 181009 00000000", Abort.NO_SUBINDEX),
    "sub-index of a variable": ("40 171001 00000000", Abort.NO_SUBINDEX),
    "write-only": ("40 102200 00000000", Abort.WRITE_ONLY),
    "const": ("23 001000 00000000", Abort.READ_ONLY),
    "read-only": ("23 002200 00000000", Abort.READ_ONLY),
    "read-only, before any segment": ("21 002200 08000000", Abort.READ_ONLY),
    "mapping is fixed": ("2f 001a00 00000000", Abort.READ_ONLY),
    "too long": ("23 171000 00000000", Abort.TOO_LONG),
    "too short": ("2f 171000 00000000", Abort.TOO_SHORT),
    "announced too long": ("21 171000 08000000", Abort.TOO_LONG),
    "announced too short": ("21 171000 01000000", Abort.TOO_SHORT),
    "announced beyond memory": ("21 102200 00000010", Abort.MEMORY),
    "too high": ("2f 291001 03000000", Abort.TOO_HIGH),
    "no error recorded": ("40 031001 00000000", Abort.NO_DATA),
    "block download": ("c2 102200 08000000", Abort.COMMAND),
    "block upload": ("a0 081000 04000000", Abort.COMMAND),
    "unknown specifier": ("e0 081000 00000000", Abort.COMMAND),
}


@pytest.mark.parametrize(("request_", "code"), ABORTS.values(), ids=ABORTS)
def test_aborts(request_: str, code: Abort) -> None:
    assert ask(Rack(3), request_) == abort(request_[3:9], code)


def test_segment_without_a_transfer() -> None:
    for command in ("00", "60"):
        assert ask(Rack(3), command + " 00000000000000") == abort("000000", Abort.COMMAND)


def test_toggle_bit_must_alternate() -> None:
    rack = Rack(3)
    ask(rack, "21 102200 10000000")
    assert ask(rack, "10 01020304050607") == abort("102200", Abort.TOGGLE)
    assert ask(rack, "00 01020304050607") == abort("102200", Abort.COMMAND)  # the transfer is over
    ask(rack, "40 081000 00000000")
    assert ask(rack, "70 00000000000000") == abort("081000", Abort.TOGGLE)


@pytest.mark.parametrize(("announced", "code"), [(3, Abort.TOO_LONG), (9, Abort.TOO_SHORT)])
def test_bytes_sent_must_be_bytes_announced(announced: int, code: Abort) -> None:
    rack = Rack(3)
    ask(rack, f"21 102200 {announced:02x}000000")
    assert ask(rack, "01 01020304050607") == abort("102200", code)
    assert rack.device.read(0x2210) == b""


def test_unannounced_download_is_bounded() -> None:
    rack = Rack(3)
    assert download(rack, "102200", bytes((1 << 20) + 7), announce=False) == abort("102200", Abort.MEMORY)


def test_unannounced_download_is_bounded_by_the_object() -> None:
    """The byte after the last one of a REAL64 ends the transfer, not the last segment."""
    rack = Rack(2)
    ask(rack, "20 102101 00000000")
    assert ask(rack, "00 01020304050607").startswith("20")
    assert ask(rack, "1a 08090000000000") == abort("102101", Abort.TOO_LONG)
    assert ask(rack, "1d 08000000000000") == abort("102101", Abort.COMMAND)


def test_application_may_refuse() -> None:
    rack = Rack(3)

    def refuse(index: int, sub: int, data: bytes) -> None:
        raise SdoAbort(Abort.STATE)

    rack.device.on_write = refuse
    assert download(rack, "102200", bytes(20)) == abort("102200", Abort.STATE)
    assert rack.device.read(0x2210) == b""
    assert ask(rack, "2b 171000 0a000000") == abort("171000", Abort.STATE)
    assert rack.device.read(0x1017) == 100


def test_silent_client_times_out() -> None:
    rack = Rack(3)
    ask(rack, "21 102200 10000000")
    assert all(cob_id == 0x703 for cob_id, _ in rack.wait(4900))  # a client that stood still may go on
    answers = rack.wait(101)
    assert (0x583, bytes.fromhex(abort("102200", Abort.TIMEOUT))) in answers
    assert all(cob_id == 0x703 for cob_id, _ in rack.wait(3000))


def test_client_abort_and_new_request_end_a_transfer_silently() -> None:
    rack = Rack(3)
    ask(rack, "21 102200 10000000")
    assert ask(rack, "80 102200 00000008") == ""
    assert ask(rack, "00 01020304050607") == abort("102200", Abort.COMMAND)
    ask(rack, "21 102200 10000000")
    assert ask(rack, "40 011000 00000000") == "4f01100000000000"
    assert ask(rack, "00 01020304050607") == abort("011000", Abort.COMMAND)


def test_stop_ends_a_transfer() -> None:
    rack = Rack(3)
    ask(rack, "21 102200 10000000")
    rack.nmt(NmtCommand.STOP)
    assert ask(rack, "00 01020304050607") == ""
    rack.nmt(NmtCommand.ENTER_PRE_OPERATIONAL)
    assert ask(rack, "00 01020304050607") == abort("102200", Abort.COMMAND)


@pytest.mark.parametrize("request_", ["", "40", "40081000000000"])
def test_what_is_not_8_bytes_is_no_sdo(request_: str) -> None:
    assert ask(Rack(3), request_) == ""
