"""The tester: defects of data sheets, services our nodes lack, late or lied to, and leaving the node as it was."""

import random
from pathlib import Path
from typing import Any

import pytest
from broken_devices import Break, examine, keep_values_over_reset, list_cases, nothing, send_instead, skip_checks, wrap
from device_bench import change_sheet, describe_variable
from refusals import catch_refusal

from dbc import EDS
from plant.errors import RigError
from rig.conformance.run_cases import Outcome, choose_cases, run_cases
from rig.conformance.target import DataSheet, Options, Target, Verdict
from rig.device import NmtState, SdoAbort
from rig.device.dictionary import INVALID
from rig.network.bus import Done, EmbeddedWire
from rig.network.frame import Send, VirtualClock
from rig.nodes.firmware import Firmware


class StallingWire(EmbeddedWire):
    """Every hundredth wait comes back 70 ms late, as on a busy machine."""

    waits = 0

    def wait(self, done: Done, seconds: float) -> bool:
        self.waits += 1
        is_done = super().wait(done, seconds)
        if self.waits % 100 == 0:
            self.clock.sleep_until(self.clock.now() + 70_000_000)
        return is_done


def test_a_late_tester_does_not_blame_the_node() -> None:
    target = Target(StallingWire(VirtualClock(), [Firmware]), DataSheet(EDS[2], 2), Options(may_write=True))
    outcome = run_cases(target, choose_cases(["7"]))
    jitter = next(result for result in outcome.results if result.case.number == "7.3")
    assert jitter.verdict is Verdict.SKIPPED and jitter.measured.startswith("this machine was 70 ms late itself")
    assert (list_cases(outcome), outcome.verdict) == ([], "INVALID_TIMING")


@pytest.mark.parametrize("seed", range(2))
def test_a_node_that_answers_nonsense_does_not_stop_the_tester(seed: int) -> None:
    """One frame in ten is cut, changed, doubled or lost: cases fail, the test comes to its end."""
    chance = random.Random(seed)

    def garble(device: Any) -> None:
        def out(cob_id: int, data: bytes) -> list[tuple[int, bytes, int]]:
            kind = chance.randrange(40)
            if kind == 0:
                return [(cob_id, data[:chance.randrange(len(data) + 1)], 0)]
            if kind == 1:
                return [(cob_id, chance.randbytes(len(data)), 0)]
            if kind == 2:
                return [(cob_id, data, 0), (cob_id, data, 0)]
            return [] if kind == 3 else [(cob_id, data, 0)]
        device.broken.out = out

    outcome = examine(garble, options=Options(may_write=True, timeout=0.2, boot_timeout=0.5))
    assert (len(outcome.results), outcome.verdict) == (len(choose_cases([])), "FAIL")


def test_what_a_reset_does_not_restore_is_set_back_and_reported() -> None:
    nodes: list[Any] = []

    def remember(device: Any) -> None:
        keep_values_over_reset(device)
        nodes.append(device)

    outcome = examine(remember, chapters=("5",))
    assert any(note.startswith("0x1016:1 held 0x100FA before and ") and note.endswith("it was set back.")
               for note in outcome.notes)
    assert (nodes[0].od.values[0x1016, 1], nodes[0].od.values[0x1017, 0]) == (0x000100FA, 100)


class Talker:
    """Another node: it sends one frame every 20 ms."""

    def __init__(self, send: Send, cob_id: int) -> None:
        self._send, self._cob_id, self._due = send, cob_id, 0

    def receive(self, frame: object) -> None:
        """Nothing concerns it."""

    def tick(self, t_ns: int) -> None:
        if t_ns >= self._due:
            self._due = t_ns + 20_000_000
            self._send(self._cob_id, b"" if self._cob_id == 0x080 else b"\x05")


def make_target(cob_id: int) -> Target:
    wire = EmbeddedWire(VirtualClock(), [Firmware, lambda send: Talker(send, cob_id)])
    return Target(wire, DataSheet(EDS[2], 2), Options(may_write=True))


def test_another_master_on_the_bus_is_left_alone() -> None:
    with pytest.raises(RigError, match=r"another node sends SYNC \(0x080\)"):
        run_cases(make_target(0x080))


def test_other_nodes_are_not_commanded() -> None:
    """A command to all nodes would start them too; the node-ID used as a stranger's is nobody's."""
    outcome = run_cases(make_target(0x700 + 126))
    skipped = [result.case.number for result in outcome.results if result.verdict is Verdict.SKIPPED]
    assert (outcome.verdict, skipped, outcome.notes) == ("PASS", ["6.5"], ["Other nodes on the bus: 126."])


@pytest.mark.parametrize(("section", "old", "new", "found_by", "said"), [
    ("DeviceInfo", "VendorName=eha-rig\n", "", "1.1", "DeviceInfo has no VendorName"),
    ("DeviceInfo", "BaudRate_1000=1", "BaudRate_1000=0", "1.1", "no bit rate"),
    ("DeviceInfo", "NrOfRXPDO=1", "NrOfRXPDO=2", "1.7", "NrOfRXPDO is 2, 1 are described"),
    ("DeviceInfo", "ProductNumber=0x3", "ProductNumber=0x4", "1.9", "0x1018:2 is 0x3, ProductNumber is 0x4"),
    ("1018sub1", "0xFFFFFFFF", "0x0", "1.9", "the vendor-ID is 0, which is invalid"),
    ("MandatoryObjects", "SupportedObjects=3", "SupportedObjects=4", "1.3", "says 4 and lists 3"),
    ("OptionalObjects", "1=0x1003", "1=0x1004", "1.3", "0x1004 is listed and not described"),
    ("1029", "SubNumber=0x2", "SubNumber=0x3", "1.4", "0x1029 says SubNumber 3 and has 2"),
    ("1400sub0", "DefaultValue=0x2", "DefaultValue=0x5", "1.4", "0x1400:0 is 5, the highest sub-index is 2"),
    ("1029sub1", "DefaultValue=0x0", "DefaultValue=0x3", "1.5", "0x1029:1: 3 is outside its limits"),
    ("1017", "AccessType=rw", "AccessType=rx", "1.5 1.6", "0x1017:0 has AccessType 'rx'"),
    ("1017", "DataType=0x0006", "DataType=0x0007", "1.6", "0x1017:0 has DataType 0x0007, expected 0x0006"),
    ("1001", "AccessType=ro", "AccessType=rw", "1.6", "0x1001:0 is rw, expected ro"),
    ("1A01sub2", "0x22030010", "0x22030020", "1.8", "TPDO2 maps 0x2203:0 with 32 bits, it has 16"),
    ("1A01sub2", "0x22030010", "0x22110110", "1.8", "TPDO2 maps 0x2211:1, which is ro with PDOMapping=0"),
    ("1A01sub2", "0x22030010", "0x29990010", "1.8", "which is not there"),
    ("1A01sub2", "0x22030010", "0x22060010", "1.8", "TPDO2 maps 0x2206:0, which is rww with PDOMapping=1"),
    ("1801sub1", "$NODEID+0x280", "0x5FF", "1.10", "TPDO2 uses 0x5FF, which is restricted"),
    ("1801sub1", "$NODEID+0x280", "$NODEID+0x180", "1.10", "TPDO2 and TPDO1 send 0x183"),
])  # fmt: skip
def test_defect_of_the_data_sheet_is_found(
    tmp_path: Path, section: str, old: str, new: str, found_by: str, said: str
) -> None:
    outcome = examine(nothing, chapters=("1",), sheet=change_sheet(tmp_path, (section, old, new)))
    assert list_cases(outcome) == found_by.split()
    assert any(said in result.measured for result in outcome.results)


def test_missing_mandatory_object(tmp_path: Path) -> None:
    (before, _), (_, after) = (EDS[3].read_text().split(f"[{section}]\n") for section in ("1001", "1018"))
    (tmp_path / "without.eds").write_text(f"{before}[1018]\n{after}")
    assert list_cases(examine(nothing, chapters=("1",), sheet=tmp_path / "without.eds")) == ["1.2", "1.3"]


def test_data_sheet_that_promises_more_than_the_node_has(tmp_path: Path) -> None:
    """The tester reads another type, another default and another object than the node has."""
    path = change_sheet(tmp_path, ("2200", "DataType=0x0004", "DataType=0x0003"), ("1017", "DefaultValue=100",
                                                                               "DefaultValue=200"))
    assert {"2.2", "2.4"} <= set(list_cases(examine(nothing, chapters=("2",), sheet=path)))


@pytest.mark.parametrize("text", ["", "not an EDS", "[1000]\n", "[DeviceInfo]\n[1000]\nParameterName=x\nDataType=zz\n"])
def test_no_data_sheet(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.eds").write_text(text)
    assert "electronic data sheet" in catch_refusal(DataSheet, tmp_path / "bad.eds", 3)


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
    assert (outcome.verdict, outcome.notes) == ("PASS" if len(rules) == 4 else "FAIL", [])


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
    for patch in (free, lambda device: (free(device), no_length(device))):
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
    assert (list_cases(outcome), {number: measured(outcome, number) for number in cases}) == ([], cases)
