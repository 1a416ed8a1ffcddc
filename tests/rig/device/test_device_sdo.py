"""SDO server: the frames of CiA 301, 7.2.4.3, byte by byte, and every abort it knows."""

import random

import pytest
from device_bench import Rack

from rig.device import Abort, SdoAbort

TOGGLE, COMMAND, STATE = "00000305", "01000405", "22000008"  # abort codes, as an abort carries them
TOO_LONG, TOO_SHORT, MEMORY = "12000706", "13000706", "05000405"


def abort(node: int, multiplexer: str, code: int) -> str:
    """The frame of an abort."""
    return f"58{node} 80{multiplexer}{code.to_bytes(4, 'little').hex()}"


# Requests and answers, each script for a node. 2110:1 is a REAL64, 2210 a DOMAIN.
SCRIPTS = {
    "expedited upload of each size": (2, """
        602 40 001000 00000000 -> 582 4300100098010000
        602 40 171000 00000000 -> 582 4b17100064000000
        602 40 011000 00000000 -> 582 4f01100000000000"""),
    "segmented upload: the device name in 7 and 7 bytes": (2, f"""
        602 40 081000 00000000 -> 582 410810000e000000
        602 60 00000000000000 -> 582 00{b"EHA con".hex()}
        602 70 00000000000000 -> 582 11{b"troller".hex()}
        602 60 00000000000000 -> 582 80081000{COMMAND}"""),
    "segmented download of a REAL64": (2, """
        602 21 102101 08000000 -> 582 6010210100000000
        602 00 00000000000004 -> 582 2000000000000000
        602 1d 40000000000000 -> 582 3000000000000000
        2110:1 = 2.5"""),
    "segment without a transfer": (3, f"""
        603 00 00000000000000 -> 583 80000000{COMMAND}
        603 60 00000000000000 -> 583 80000000{COMMAND}"""),
    "the toggle bit must alternate": (3, f"""
        603 21 102200 10000000 -> 583 60*
        603 10 01020304050607 -> 583 80102200{TOGGLE}
        603 00 01020304050607 -> 583 80102200{COMMAND}
        603 40 081000 00000000 -> 583 41*
        603 70 00000000000000 -> 583 80081000{TOGGLE}"""),
    "more bytes than announced": (3, f"""
        603 21 102200 03000000 -> 583 60*
        603 01 01020304050607 -> 583 80102200{TOO_LONG}
        2210:0 = b''"""),
    "fewer bytes than announced": (3, f"""
        603 21 102200 09000000 -> 583 60*
        603 01 01020304050607 -> 583 80102200{TOO_SHORT}
        2210:0 = b''"""),
    "an unannounced download is bounded by the object": (2, f"""
        602 20 102101 00000000 -> 582 60*
        602 00 01020304050607 -> 582 20*
        602 1a 08090000000000 -> 582 80102101{TOO_LONG}
        602 1d 08000000000000 -> 582 80102101{COMMAND}"""),
    "a client abort ends a transfer silently": (3, f"""
        603 21 102200 10000000 -> 583 60*
        603 80 102200 00000008 ->
        603 00 01020304050607 -> 583 80102200{COMMAND}"""),
    "a new request ends a transfer silently": (3, f"""
        603 21 102200 10000000 -> 583 60*
        603 40 011000 00000000 -> 583 4f01100000000000
        603 00 01020304050607 -> 583 80011000{COMMAND}"""),
    "STOPPED ends a transfer": (3, f"""
        603 21 102200 10000000 -> 583 60*
        000 02 03 ->
        603 00 01020304050607 ->
        000 80 03 ->
        603 00 01020304050607 -> 583 80102200{COMMAND}"""),
    "a silent client times out after 5 s": (3, """
        write 1017:0 0000 -> ok
        603 21 102200 10000000 -> 583 60*
        wait 4900 ->
        wait 101 -> 583 8010220000000405
        wait 3000 ->"""),
    "what is not 8 bytes is no SDO": (3, "603 ->\n603 40 ->\n603 40081000000000 ->"),
}


@pytest.mark.parametrize(("node", "script"), SCRIPTS.values(), ids=SCRIPTS)
def test_script(node: int, script: str) -> None:
    Rack(node).play(script)


def download(rack: Rack, data: bytes, announce: bool = True) -> str:
    """Segmented download to 0x2210; the last answer in hexadecimal."""
    def ask(request: bytes) -> str:
        return rack.send(0x603, request)[0][1].hex()

    answer = ask(b"\x21\x10\x22\0" + len(data).to_bytes(4, "little") if announce else b"\x20\x10\x22" + bytes(5))
    for number, at in enumerate(range(0, len(data), 7)):
        if answer.startswith("80"):
            break
        part = data[at : at + 7]
        command = number % 2 << 4 | (7 - len(part)) << 1 | (at + 7 >= len(data))
        answer = ask(bytes((command,)) + part.ljust(7, b"\0"))
    return answer


def test_expedited_download() -> None:
    rack, seen = Rack(3), []
    rack.device.on_write = lambda index, sub, data: seen.append((index, sub, data))
    rack.play("""
        603 2b 171000 0a000000 -> 583 6017100000000000
        1017:0 = 10
        603 22 171000 0b00ffff -> 583 6017100000000000
        1017:0 = 11""")  # size not said: the object's own
    assert seen == [(0x1017, 0, b"\x0a\0"), (0x1017, 0, b"\x0b\0")]


@pytest.mark.parametrize("size", [1, 4, 6, 7, 8, 13, 14, 15, 6000])
@pytest.mark.parametrize("announce", [True, False])
def test_domain_of_any_size(size: int, announce: bool) -> None:
    rack, seen = Rack(3), []
    rack.device.on_write = lambda index, sub, data: seen.append(data)
    data = random.Random(size).randbytes(size)
    assert download(rack, data, announce)[:2] in ("20", "30")
    assert seen == [data] and rack.device.read(0x2210) == data


@pytest.mark.parametrize(("request_", "code"), [
    ("40 342100 00000000", Abort.NO_OBJECT), ("2f 342100 01000000", Abort.NO_OBJECT),
    ("40 181009 00000000", Abort.NO_SUBINDEX), ("40 171001 00000000", Abort.NO_SUBINDEX),  # of a variable
    ("40 102200 00000000", Abort.WRITE_ONLY),
    ("23 001000 00000000", Abort.READ_ONLY), ("23 002200 00000000", Abort.READ_ONLY),  # const, ro
    ("21 002200 08000000", Abort.READ_ONLY),  # before any segment
    ("2f 001a00 00000000", Abort.READ_ONLY),  # the mapping is fixed
    ("23 171000 00000000", Abort.TOO_LONG), ("2f 171000 00000000", Abort.TOO_SHORT),
    ("21 171000 08000000", Abort.TOO_LONG), ("21 171000 01000000", Abort.TOO_SHORT),  # announced
    ("21 102200 00000010", Abort.MEMORY),
    ("2f 291001 03000000", Abort.TOO_HIGH),
    ("40 031001 00000000", Abort.NO_DATA),  # no error recorded
    ("c2 102200 08000000", Abort.COMMAND), ("a0 081000 04000000", Abort.COMMAND),  # block transfer
    ("e0 081000 00000000", Abort.COMMAND),
])  # fmt: skip
def test_aborts(request_: str, code: Abort) -> None:
    Rack(3).play(f"603 {request_} -> {abort(3, request_[3:9], code)}")


def test_unannounced_download_is_bounded() -> None:
    assert download(Rack(3), bytes((1 << 20) + 7), announce=False) == f"80102200{MEMORY}"


def test_application_may_refuse() -> None:
    rack = Rack(3)

    def refuse(index: int, sub: int, data: bytes) -> None:
        raise SdoAbort(Abort.STATE)

    rack.device.on_write = refuse
    assert download(rack, bytes(20)) == f"80102200{STATE}"
    rack.play("2210:0 = b''\nwrite 1017:0 0a00 -> 08000022\n1017:0 = 100")
