"""The slave core of our nodes in Python: scripts of frames.

The one in C sends the same (tests/rig/firmware/test_c_run.py), and both pass `rig conformance`.
"""

from pathlib import Path

import pytest
from device_bench import DeviceHarness, change_sheet, describe_variable
from refusals import catch_refusal

from dbc import EDS
from rig.device import Abort, Device

TOGGLE, COMMAND = "00000305", "01000405"  # abort codes, as an abort carries them
TOO_LONG, TOO_SHORT = "12000706", "13000706"
START, STOP, RESET = "000 0103 ->", "000 0203 ->", "000 8203 -> 703 00"
# Requests and answers, each script for a node. 2110:1 is a REAL64, 2210 a DOMAIN.
SDO = {
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
# Scripts that begin in OPERATIONAL. 182: drive frame, with the current (2205) in its first word; 083: EMCY.
PDO = {
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
    "SYNC is lost after twelve periods and not before the first, and back; with a period of 0 nobody watches": """
        write 1017:0 0000 -> ok
        wait 500 ->
        080 -> 183 *, 283 *
        wait 12 ->
        wait 1 -> 083 0081110000000000
        wait 200 ->
        080 -> 083 0000000000000000, 183 *, 283 *
        write 1006:0 00000000 -> ok
        080 -> 183 *, 283 *
        wait 500 ->""",
    "acyclic: with the next SYNC after the application asks, so never here": """
        write 1800:2 00 -> ok
        080 -> 283 *
        080 -> 283 *""",
}
NMT = {
    "the frame of the last cycle before a stop is forgotten": f"""
        {START}
        182 0100000002000300 ->
        {STOP}
        {START}
        080 -> 183 *, 283 *
        2205:0 = 0""",
    "a heartbeat that is lost and back: EMCY 0x8130 names the node; watching begins with the first one": """
        000 0103 ->
        write 1017:0 0000 -> ok
        wait 1000 ->
        701 05 ->
        wait 250 ->
        wait 1 -> 083 3081110100000000
        080 ->
        701 05 -> 083 0000000000000000
        1001:0 = 0
        080 ->""",
    "watching begins anew after a reset": f"""
        701 05 ->
        {RESET}
        write 1017:0 0000 -> ok
        wait 1000 ->""",
    "a node that is watched with another time": """
        write 1016:1 32000200 -> ok
        write 1017:0 0000 -> ok
        702 7f ->
        wait 51 -> 083 3081110200000000
        wait 500 ->
        write 1017:0 0a00 -> ok
        wait 20 -> 703 7f, 703 7f""",
    **{f"consumer entry {entry} is accepted": f"write 1016:1 {entry} -> ok"
       for entry in ("fa007f00", "00000100", "00000000", "fa000000", "00008000")},
}
SCRIPTS = {**SDO, **{name: (3, f"{START}{script}") for name, script in PDO.items()},
           **{name: (3, script) for name, script in NMT.items()}}


@pytest.mark.parametrize(("node", "script"), SCRIPTS.values(), ids=SCRIPTS)
def test_script(node: int, script: str) -> None:
    DeviceHarness(node).play(script)


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
    DeviceHarness(3).play(f"603 {request_} -> 583 80{request_[3:9]}{code.to_bytes(4, 'little').hex()}")


CHANGED = {  # what is changed in the data sheet of node 3, and a script
    "the identifier of SYNC may not be restricted nor make a producer": (
        ("1005", "AccessType=const", "AccessType=rw"), "", START + """
        write 1005:0 80000040 -> 06090030
        write 1005:0 80000020 -> 06090030
        write 1005:0 01070000 -> 06090030
        write 1005:0 00000000 -> 06090030
        write 1005:0 90000000 -> ok
        080 ->
        090 -> 183 *, 283 *"""),
    # a frame has 8 bytes at most, so it takes a mapping of one object instead of three to see it
    "a PDO that is too long is processed with its first bytes": (
        ("1600sub0", "DefaultValue=0x3", "DefaultValue=0x1"), "", START + """
        182 0100000002000300 -> 083 2082110100000000
        080 -> 183 *, 283 *
        2205:0 = 1
        2206:0 = 0
        182 01000000 -> 083 0000000000000000
        182 010000 -> 083 1082110100000000
        182 0100000002000300 -> 083 0000000000000000, 083 2082110100000000"""),
    "two consumer entries for one node are refused (CiA 301, 7.5.2.19)": (
        ("1016", "SubNumber=0x2", "SubNumber=0x3"), describe_variable("1016sub2", "0x0007"), """
        write 1016:2 64000100 -> 06040043
        write 1016:2 00000100 -> ok
        write 1016:2 64000200 -> ok
        write 1016:1 64000100 -> ok
        write 1016:1 64000200 -> 06040043"""),
}


@pytest.mark.parametrize(("change", "more", "script"), CHANGED.values(), ids=CHANGED)
def test_script_on_a_changed_data_sheet(tmp_path: Path, change: tuple[str, str, str], more: str, script: str) -> None:
    DeviceHarness(eds=change_sheet(tmp_path, change, more=more)).play(script)


@pytest.mark.parametrize(("old", "new", "complaint"), [
    ("DefaultValue=0x22050020", "DefaultValue=0x22050010", "1600sub1: expected a mappable object"),
    ("DefaultValue=0x22050020", "DefaultValue=0x29990020", "1600sub1: expected a mappable object"),
    ("DefaultValue=0x22060010", "DefaultValue=0x22050020", "1600: expected at most 8 bytes in a PDO, not 10"),
    ("DataType=0x0011", "DataType=0x0010", "not 0x0010"),
    ("[2200]", "[2200", "electronic data sheet"),
    # the core reads mappings once: it must not confirm a change that has no effect
    ("Type=0x0007\nAccessType=const\nDefaultValue=0x22020020", "Type=0x0007\nAccessType=rw\nDefaultValue=0x22020020",
     "1A01sub1.AccessType: expected const"),
])  # fmt: skip
def test_impossible_dictionary_is_refused_in_one_line(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    node = 2 if "Data" in old else 3
    path = tmp_path / "bad.eds"
    path.write_text(EDS[node].read_text().replace(old, new))
    message = catch_refusal(Device, node, path, lambda cob_id, data: None)
    assert complaint in message and str(path) in message
