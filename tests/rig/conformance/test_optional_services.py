"""Cases that our own nodes do not need: event timer, writable mapping, COB-IDs of SYNC and EMCY, short mappings."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from broken_devices import Break, examine, list_cases, nothing, send_instead, skip_checks, wrap
from changed_sheets import change_sheet, describe_variable

from dbc import EDS
from rig.conformance.conformance_case import Verdict
from rig.conformance.run_cases import Outcome
from rig.device import NmtState, SdoAbort
from rig.device.dictionary import INVALID

MS = 1_000_000  # ns


def measured(outcome: Outcome, number: str) -> tuple[Verdict, str]:
    """Verdict and measured text of one case."""
    return next((each.verdict, each.measured) for each in outcome.results if each.case.number == number)


def send_by_timer(factor: float) -> Break:
    """TPDO1 follows its event timer, by this factor too slowly."""
    last = [0]

    def tick(device: Any, old: Any, t_ns: int) -> None:
        old(t_ns)
        period = device.od.read_number(0x1800, 5) * MS * factor
        if period and device.state is NmtState.OPERATIONAL and t_ns - last[0] >= period:
            last[0] = t_ns
            device.pdo.tpdos[1].send()
    return wrap("tick", tick)


def test_event_timer(tmp_path: Path) -> None:
    sheet = change_sheet(tmp_path, ("1800", "SubNumber=0x3", "SubNumber=0x4"),
                         ("1800sub0", "DefaultValue=0x2", "DefaultValue=0x5"),
                         more=describe_variable("1800sub5", "0x0006"))
    sound = examine(send_by_timer(1.0), chapters=("1", "4.5"), eds=sheet)
    assert (list_cases(sound), measured(sound, "4.5")) == ([], (Verdict.PASS, "TPDO1 every 50.0 ms"))
    for patch, text in ((send_by_timer(2.0), "TPDO1: every 100.0 ms"), (nothing, "TPDO1: 0 frames in 1 s")):
        assert measured(examine(patch, chapters=("4.5",), eds=sheet), "4.5") == (Verdict.FAIL, text)


def test_short_mapping(tmp_path: Path) -> None:
    """A received PDO of 4 bytes that comes with 5."""
    sheet = change_sheet(tmp_path, ("1600sub0", "DefaultValue=0x3", "DefaultValue=0x1"))
    outcome = examine(nothing, chapters=("4",), eds=sheet)
    assert (list_cases(outcome), measured(outcome, "4.13")) == ([], (Verdict.PASS, "RPDO1 EMCY 0x8220"))
    wrong_code = send_instead(0x083, lambda data: b"\x00\x50" + data[2:] if data[:2] == b"\x20\x82" else data)
    assert list_cases(examine(wrong_code, chapters=("4",), eds=sheet)) == ["4.13"]


@pytest.mark.parametrize(("index", "number"), [(0x1005, "5.1"), (0x1014, "5.2")])
def test_writable_identifiers(tmp_path: Path, index: int, number: str) -> None:
    sheet = change_sheet(tmp_path, (f"{index:04X}", "AccessType=const", "AccessType=rw"))
    sound = examine(nothing, chapters=("1", "2", number), eds=sheet)
    assert list_cases(sound) == [] and "15 identifiers refused" in measured(sound, number)[1]
    assert list_cases(examine(skip_checks(index), chapters=("5",), eds=sheet)) == [number]


def test_two_consumer_entries(tmp_path: Path) -> None:
    sheet = change_sheet(tmp_path, ("1016", "SubNumber=0x2", "SubNumber=0x3"),
                         ("1016sub0", "DefaultValue=0x1", "DefaultValue=0x2"),
                         more=describe_variable("1016sub2", "0x0007"))
    sound = examine(nothing, chapters=("1", "5.14"), eds=sheet)
    assert (list_cases(sound), measured(sound, "5.14")[1]) == ([], "0x06040043 parameter incompatibility")
    assert list_cases(examine(skip_checks(0x1016), chapters=("5",), eds=sheet)) == ["5.13", "5.14"]


def map_freely(*rules: str) -> Break:
    """The mapping can be written, under these rules of CiA 301: "off", "object", "mappable", "length"."""
    parameters = {0x1600: 0x1400, 0x1A00: 0x1800, 0x1A01: 0x1801}

    def check(device: Any, old: Any, index: int, sub: int, value: int) -> None:
        od = device.od
        if index not in parameters:
            old(index, sub, value)
            return
        entry = od.entries.get((value >> 16, value >> 8 & 0xFF))
        bits = sum(od.read_number(index, n) & 0xFF for n in range(1, value + 1)) if sub == 0 else 0
        is_fixed = not od.read_number(parameters[index], 1) & INVALID or (sub and od.read_number(index, 0))
        for rule, is_broken, code in (
                ("off", is_fixed, 0x08000022), ("object", sub and entry is None, 0x06020000),
                ("mappable", sub and entry is not None and not entry.mappable, 0x06040041),
                ("length", bits > 64, 0x06040042)):
            if rule in rules and is_broken:
                raise SdoAbort(code)

    def patch(device: Any) -> None:
        device.od.entries = {key: entry._replace(writable=True) if key[0] in parameters else entry
                             for key, entry in device.od.entries.items()}
        wrap("_check", check)(device)
    return patch


@pytest.mark.parametrize(("rules", "said"), [
    (("off", "object", "mappable", "length"), "RPDO1, TPDO1, TPDO2"),
    (("object", "mappable", "length"), "was changed while the PDO is valid"),
    (("off", "mappable", "length"), "RPDO1, an unknown object: accepted"),
    (("off", "object", "length"), "RPDO1, the vendor-ID: accepted"),
    (("off", "object", "mappable"), "more than 64 bits: accepted"),
])
def test_mapping_rules(tmp_path: Path, rules: tuple[str, ...], said: str) -> None:
    outcome = examine(map_freely(*rules), chapters=("4.17",), sheet=open_mappings(tmp_path))
    assert said in measured(outcome, "4.17")[1]
    assert outcome.verdict == ("PASS" if len(rules) == 4 else "FAIL")
    assert outcome.notes == []


def open_mappings(folder: Path) -> Path:
    """An EDS whose mappings can be written."""
    sections = [f"{index}sub{sub}" for index in ("1600", "1A00", "1A01") for sub in range(4)]
    return change_sheet(folder, *((section, "AccessType=const", "AccessType=rw") for section in sections
                                  if f"[{section}]" in EDS[3].read_text()))


def test_a_mapping_that_the_sheet_lacks_or_of_no_length_is_restored(tmp_path: Path) -> None:
    sheet = open_mappings(tmp_path)
    sheet.write_text(sheet.read_text().replace("[1600sub3]", "[1600sub7]"))
    free = map_freely("off", "object", "mappable", "length")
    no_length = wrap("sdo._upload", lambda device, old, index, sub: bytes(4) if (index, sub) == (0x1600, 1) else
                     old(index, sub))
    def both(device: Any) -> None:
        free(device)
        no_length(device)

    for patch in (free, both):
        outcome = examine(patch, chapters=("4.17",), sheet=sheet)
        assert measured(outcome, "4.17") == (Verdict.PASS, "RPDO1, TPDO1, TPDO2")


@pytest.mark.parametrize(("period", "cases"), [
    ("100", {"5.7": (Verdict.NOT_APPLICABLE, "0x1017:0 is const in the EDS"), "6.4": (Verdict.PASS, "9 transitions")}),
    ("0", {"6.4": (Verdict.NOT_APPLICABLE, "the node sends no heartbeat"),
           "4.3": (Verdict.PASS, "TPDO1 types 1, 2, 3; TPDO2 types 1, 2, 3")}),
])
def test_a_heartbeat_that_a_master_cannot_change(
    tmp_path: Path, period: str, cases: dict[str, tuple[Verdict, str]]
) -> None:
    """Its period is awaited; what would change it is not applicable. With period 0 there is none."""
    sheet = change_sheet(tmp_path, ("1017", "AccessType=rw", "AccessType=const"),
                         ("1017", "DefaultValue=100", f"DefaultValue={period}"))
    outcome = examine(nothing, eds=sheet)
    assert list_cases(outcome) == []
    assert {number: measured(outcome, number) for number in cases} == cases
