"""Cases that our own nodes do not need: event timer, writable mapping, COB-IDs of SYNC and EMCY, short mappings."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from broken_devices import examine, failures, nothing, skip_checks

from dbc import EDS
from rig.conformance.conformance_case import Verdict
from rig.conformance.run_cases import Outcome
from rig.device import NmtState, SdoAbort
from rig.device.dictionary import INVALID

MS = 1_000_000  # ns
TIMER = """[1800sub5]
ParameterName=Event timer
ObjectType=0x7
DataType=0x0006
AccessType=rw
DefaultValue=0
PDOMapping=0

"""


def write_sheet(folder: Path, *changes: tuple[str, str, str]) -> Path:
    """The EDS of node 3 with words replaced behind a marker each."""
    text = EDS[3].read_text()
    for marker, old, new in changes:
        head, found, tail = text.partition(marker)
        assert found and old in tail, (marker, old)
        text = head + found + tail.replace(old, new, 1)
    path = folder / "node.eds"
    path.write_text(text)
    return path


def measured(outcome: Outcome, number: str) -> tuple[Verdict, str]:
    """Verdict and measured text of one case."""
    return next((each.verdict, each.measured) for each in outcome.results if each.case.number == number)


def with_timer(folder: Path) -> Path:
    path = write_sheet(folder, ("[1800]\n", "SubNumber=0x3", "SubNumber=0x4"),
                       ("[1800sub0]\n", "DefaultValue=0x2", "DefaultValue=0x5"))
    path.write_text(path.read_text().replace("[1801]\n", TIMER + "[1801]\n"))
    return path


def send_by_timer(factor: float) -> Any:
    """TPDO1 follows its event timer, by this factor too slowly."""
    def patch(device: Any) -> None:
        last = [0]
        old = device.tick

        def tick(t_ns: int) -> None:
            old(t_ns)
            period = device.od.read_number(0x1800, 5) * MS * factor
            if period and device.state is NmtState.OPERATIONAL and t_ns - last[0] >= period:
                last[0] = t_ns
                device.pdo.tpdos[1].send()
        device.tick = tick
    return patch


def test_event_timer(tmp_path: Path) -> None:
    sheet = with_timer(tmp_path)
    sound = examine(send_by_timer(1.0), chapters=("1", "4.5"), eds=sheet)
    assert (failures(sound), measured(sound, "4.5")) == ([], (Verdict.PASS, "TPDO1 every 50.0 ms"))
    slow = examine(send_by_timer(2.0), chapters=("4.5",), eds=sheet)
    assert measured(slow, "4.5") == (Verdict.FAIL, "TPDO1: every 100.0 ms")
    assert measured(examine(nothing, chapters=("4.5",), eds=sheet), "4.5") == (Verdict.FAIL, "TPDO1: 0 frames in 1 s")


def test_short_mapping(tmp_path: Path) -> None:
    """A received PDO of 4 bytes that comes with 5."""
    sheet = write_sheet(tmp_path, ("[1600sub0]\n", "DefaultValue=0x3", "DefaultValue=0x1"))
    outcome = examine(nothing, chapters=("4",), eds=sheet)
    assert (failures(outcome), measured(outcome, "4.13")) == ([], (Verdict.PASS, "RPDO1 EMCY 0x8220"))

    def report_otherwise(device: Any) -> None:
        device.broken.out = lambda cob, data: [(cob, b"\x00\x50" + data[2:] if data[:2] == b"\x20\x82" else data, 0)]

    assert failures(examine(report_otherwise, chapters=("4",), eds=sheet)) == ["4.13"]


@pytest.mark.parametrize(("index", "number"), [(0x1005, "5.1"), (0x1014, "5.2")])
def test_writable_identifiers(tmp_path: Path, index: int, number: str) -> None:
    sheet = write_sheet(tmp_path, (f"[{index:04X}]\n", "AccessType=const", "AccessType=rw"))
    sound = examine(nothing, chapters=("1", "2", number), eds=sheet)
    assert failures(sound) == [] and "15 identifiers refused" in measured(sound, number)[1]
    assert failures(examine(skip_checks(index), chapters=("5",), eds=sheet)) == [number]


def map_freely(*rules: str) -> Any:
    """The mapping can be written, under these rules of CiA 301: "off", "object", "mappable", "length"."""
    def patch(device: Any) -> None:
        old = device._check
        bases = {base + n: 0x1400 + n if base == 0x1600 else 0x1800 + n for base in (0x1600, 0x1A00) for n in range(2)}
        device.od.entries = {key: entry._replace(writable=True) if key[0] in bases else entry
                             for key, entry in device.od.entries.items()}

        def check(index: int, sub: int, value: int) -> None:
            if index not in bases:
                old(index, sub, value)
                return
            is_valid = not device.od.read_number(bases[index], 1) & INVALID
            if "off" in rules and (is_valid or (sub and device.od.read_number(index, 0))):
                raise SdoAbort(0x08000022)
            if sub:
                entry = device.od.entries.get((value >> 16, value >> 8 & 0xFF))
                if entry is None and "object" in rules:
                    raise SdoAbort(0x06020000)
                if entry is not None and not entry.mappable and "mappable" in rules:
                    raise SdoAbort(0x06040041)
            elif "length" in rules and sum(device.od.read_number(index, n) & 0xFF for n in range(1, value + 1)) > 64:
                raise SdoAbort(0x06040042)
        device._check = check
    return patch


@pytest.mark.parametrize(("rules", "said"), [
    (("off", "object", "mappable", "length"), "RPDO1, TPDO1, TPDO2"),
    (("object", "mappable", "length"), "was changed while the PDO is valid"),
    (("off", "mappable", "length"), "RPDO1, an unknown object: accepted"),
    (("off", "object", "length"), "RPDO1, the vendor-ID: accepted"),
    (("off", "object", "mappable"), "more than 64 bits: accepted"),
])
def test_mapping_rules(tmp_path: Path, rules: tuple[str, ...], said: str) -> None:
    text = EDS[3].read_text()
    for index in ("1600", "1A00", "1A01"):
        for sub in range(4):
            head, found, tail = text.partition(f"[{index}sub{sub}]\n")
            text = head + found + tail.replace("AccessType=const", "AccessType=rw", 1) if found else text
    path = tmp_path / "free.eds"
    path.write_text(text)
    outcome = examine(map_freely(*rules), chapters=("4.17",), sheet=path)
    assert said in measured(outcome, "4.17")[1]
    assert outcome.verdict == ("PASS" if len(rules) == 4 else "FAIL")
    assert outcome.notes == []


def test_a_heartbeat_that_a_master_cannot_change(tmp_path: Path) -> None:
    """Its period is awaited; what would change it is not applicable."""
    sheet = write_sheet(tmp_path, ("[1017]\n", "AccessType=rw", "AccessType=const"))
    outcome = examine(nothing, eds=sheet)
    assert failures(outcome) == []
    assert measured(outcome, "5.7") == (Verdict.NOT_APPLICABLE, "0x1017:0 is const in the EDS")
    assert measured(outcome, "6.4") == (Verdict.PASS, "9 transitions")


def test_a_node_without_heartbeat(tmp_path: Path) -> None:
    sheet = write_sheet(tmp_path, ("[1017]\n", "AccessType=rw", "AccessType=const"),
                        ("[1017]\n", "DefaultValue=100", "DefaultValue=0"))
    outcome = examine(nothing, eds=sheet)
    assert failures(outcome) == []
    assert measured(outcome, "6.4") == (Verdict.NOT_APPLICABLE, "the node sends no heartbeat")
    assert measured(outcome, "4.3")[0] is Verdict.PASS
