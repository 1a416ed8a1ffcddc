"""Bring-up of devices that nobody wrote for this rig: what is compared with the data sheet, written, and done without.

The device is canopen's local node, on the embedded bus with a virtual clock.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import canopen
import pytest
from device_files import BENCH, OBJECTS, RPDOS, TPDOS, Entry, Mapped, format_eds, write_bench
from refusals import catch_refusal

from rig.benches import EXTENDED, Role, load_bench
from rig.network import BusError, EmbeddedWire, Frame, Master, NmtState, Send, VirtualClock

IDENTITY = {"1000": Entry(7, "ro", "0x20192"), "1018sub0": Entry(5, "const", "2"), "1018sub1": Entry(7, "ro", "0x77"),
            "1018sub2": Entry(7, "ro", "0x5")}
MODES = {"6060": Entry(2, default="0"), "6061": Entry(2, "ro")}
HEARTBEATS = {"1006": Entry(7, "rw", "0"), "1016sub0": Entry(5, "const", "1"), "1016sub1": Entry(7, "rw", "0"),
              "1017": Entry(6, "rw", "0")}
ALL = {**OBJECTS, **IDENTITY, **MODES, **HEARTBEATS}


class Device:
    """Node 5, or another, with the objects of a data sheet; `held` differs from it, `refused` cannot be written."""

    def __init__(self, send: Send, eds: Path, held: Mapping[tuple[int, int], int], refused: int, node: int) -> None:
        self._send, self._node, self.writes = send, node, []  # type: ignore[var-annotated]
        network: Any = canopen.Network()
        network.send_message = lambda can_id, data, remote=False: send(can_id, bytes(data))
        self._notify = network.notify
        local = network.create_node(node, str(eds))
        for (index, sub), value in held.items():
            item = local.object_dictionary[index]
            (item[sub] if hasattr(item, "subindices") else item).default = value
        local._write_callbacks = [lambda index, subindex, od, data: self._take(index, subindex, data, refused)]
        self._local, self._state, self._due = local, 0, 0

    def _take(self, index: int, sub: int, data: bytes, refused: int) -> None:
        if index == refused:
            raise canopen.SdoAbortedError(0x06090030)
        self.writes.append((index, sub, int.from_bytes(data, "little")))
        if index == 0x6060:
            self._local.object_dictionary[0x6061].default = data[0] if data[0] == 8 else 0

    def receive(self, frame: Frame) -> None:
        if frame.cob_id == 0 and frame.data[1] == self._node:
            self._state = {1: 5, 128: 127}.get(frame.data[0], 127)
            if frame.data[0] in (129, 130):
                self._send(0x700 + self._node, b"\0")
        elif frame.cob_id == 0x600 + self._node:
            self._notify(frame.cob_id, bytearray(frame.data), 0.0)

    def tick(self, t_ns: int) -> None:
        entry = self._local.object_dictionary.get(0x1017)
        period = self._local.sdo[0x1017].raw if entry is not None and self._state else 0
        if period and t_ns >= self._due:
            self._due = t_ns + period * 1_000_000
            self._send(0x700 + self._node, bytes((self._state,)))


class Place:
    """A bench of a device, and the master opposite it."""

    def __init__(self, folder: Path, objects: Mapping[str, Entry] = ALL, text: str = BENCH, refused: int = 0,
                 held: Mapping[tuple[int, int], int] | None = None, node: int = 5, sheet: str = "") -> None:
        path = write_bench(folder, text.replace("node = 5", f"node = {node}"))
        (folder / "x.eds").write_text(sheet or format_eds(objects, RPDOS, TPDOS))
        devices: list[Device] = []

        def make(send: Send) -> Device:
            devices.append(Device(send, folder / "x.eds", held or {}, refused, node))
            return devices[0]

        wire = EmbeddedWire(VirtualClock(), [make])
        self.master = Master(wire, wire.clock.now, False, load_bench(str(path)))
        self.device = devices[0]
        self.master.reset()


@pytest.mark.parametrize(("held", "message"), [
    ({(0x1000, 0): 0x198}, "x.eds: 0x1000: expected 0x20192, but node 5 controller has 0x198"),
    ({(0x1018, 1): 0x78}, "x.eds: 0x1018:1: expected 0x77, but node 5 controller has 0x78"),
    ({(0x1018, 2): 0x6}, "x.eds: 0x1018:2: expected 0x5, but node 5 controller has 0x6"),
])
def test_another_device_is_refused(tmp_path: Path, held: dict[tuple[int, int], int], message: str) -> None:
    assert catch_refusal(Place(tmp_path, held=held).master.require_identity, Role.CONTROLLER) == message


@pytest.mark.parametrize(("held", "message"), [
    ({(0x1800, 1): 0x8000_0185}, "0x1800:1: expected 0x185, but node 5 controller has 0x80000185"),
    ({(0x1401, 2): 1}, "0x1401:2: expected 0xFF, but node 5 controller has 0x1"),
    ({(0x1600, 0): 1}, "0x1600: expected 0x2, but node 5 controller has 0x1"),
    ({(0x1A00, 1): 0x2003_0008}, "0x1A00:1: expected 0x20020010, but node 5 controller has 0x20030008"),
])
def test_other_pdos_are_refused(tmp_path: Path, held: dict[tuple[int, int], int], message: str) -> None:
    assert catch_refusal(Place(tmp_path, held=held).master.require_pdos, Role.CONTROLLER) == f"x.eds: {message}"


def test_a_pdo_that_differs_only_in_whether_it_may_be_requested_is_taken(tmp_path: Path) -> None:
    Place(tmp_path, held={(0x1800, 1): 0x4000_0185}).master.require_pdos(Role.CONTROLLER)


def test_heartbeats_and_cycle_period_are_set_and_set_back(tmp_path: Path) -> None:
    place = Place(tmp_path)
    place.master.configure(b"", None, 8000, 300)
    assert [each for each in place.device.writes if each[0] < 0x2000] == [
        (0x1006, 0, 8000), (0x1016, 1, 1 << 16 | 300), (0x1017, 0, 10)]
    place.master.start()
    assert place.master.wait_for_operational(1.0).keys() == {Role.CONTROLLER}
    assert place.master.watched == [Role.CONTROLLER] and place.device.writes[-1] == (0x1017, 0, 100)
    assert place.master.restore() == [] and place.device.writes[-2:] == [(0x1006, 0, 0), (0x1016, 1, 0)]


def test_a_device_without_heartbeat_is_started_and_not_watched(tmp_path: Path) -> None:
    place = Place(tmp_path, {**OBJECTS, **IDENTITY, **MODES})
    place.master.configure(b"", None, 8000)
    place.master.start()
    assert place.master.wait_for_operational(1.0) == {} and place.master.watched == []
    assert place.master.states == {Role.CONTROLLER: NmtState.OPERATIONAL}
    assert [index for index, _, _ in place.device.writes] == [0x6060]


def test_a_fixed_heartbeat_is_watched_by_its_own_period(tmp_path: Path) -> None:
    place = Place(tmp_path, {**OBJECTS, **IDENTITY, **MODES, "1017": Entry(6, "const", "500")})
    losses: list[Role] = []
    place.master.hooks.on_lost = losses.append
    place.master.configure(b"", None, 8000)
    place.master.start()
    assert place.master.wait_for_operational(2.0).keys() == {Role.CONTROLLER}
    assert place.master.find_silent(2.0) == [] and not losses


@pytest.mark.parametrize(("word", "count"), [
    ("0xBA", 2), ("0x200000BA", 3), ("0x800000BA", 0), ("$NODEID+0x80", 1), ("", 1)])
def test_an_emcy_has_the_identifier_of_0x1014(word: str, count: int, tmp_path: Path) -> None:
    master = Place(tmp_path, {**ALL, "1014": Entry(7, "const", word)}).master
    for cob_id in (0x085, *2 * (0x0BA,), *3 * (EXTENDED | 0x0BA,)):
        master.receive(Frame(0, cob_id, bytes(8)))
    assert master.count_emergencies(Role.CONTROLLER) == count


def test_the_mode_of_a_drive_is_set_and_read_back(tmp_path: Path) -> None:
    place = Place(tmp_path)
    place.master.configure(b"", None, 0)
    assert (0x6060, 0, 8) in place.device.writes
    other = Place(tmp_path, text=BENCH.replace('profile = "cia402"', 'profile = "cia402"\nmode = 7'))
    assert catch_refusal(other.master.configure, b"", None, 0) == (
        "bench.toml: controller.mode: expected a mode of node 5 controller, not 7: 0x6061 shows 0")
    Place(tmp_path, {**ALL, "6502": Entry(7, "ro", "0x40")},  # it has the mode, and shows it later
          BENCH.replace('"cia402"', '"cia402"\nmode = 7')).master.configure(b"", None, 0)
    with pytest.raises(BusError, match="node 5 controller, object 0x6060: Code 0x06090030"):
        Place(tmp_path, refused=0x6060).master.configure(b"", None, 0)
    sheet = format_eds(ALL, (Mapped((0x2000_0020, 0x6040_0010, 0x6060_0008), "$NODEID+0x200"), RPDOS[1]), TPDOS)
    place = Place(tmp_path, sheet=sheet)  # a PDO carries it
    place.master.configure(b"", None, 0)
    assert 0x6060 not in {index for index, _, _ in place.device.writes}


def test_the_values_of_a_dcf_are_written_and_a_refusal_is_one_line(tmp_path: Path) -> None:
    sheet = format_eds({**ALL, "2003": Entry(5, value="3")}, RPDOS, TPDOS)
    text = BENCH.replace("x.eds", "x.dcf")

    def prepare(refused: int = 0) -> Place:
        (tmp_path / "x.dcf").write_text(sheet)
        return Place(tmp_path, text=text, refused=refused)

    place = prepare()
    place.master.configure(b"", None, 0)
    assert place.device.writes[0] == (0x2003, 0, 3)
    place.master.start()
    place.device.writes.clear()
    place.master.reset()  # as after a reset of the node in mid run
    assert place.master.configure_again() == [] and place.device.writes[0] == (0x2003, 0, 3)
    assert catch_refusal(prepare(0x2003).master.configure, b"", None, 0) == (
        "x.dcf: 0x2003: expected a value that node 5 controller takes: Code 0x06090030, Value range of parameter "
        "exceeded")


def test_parameters_are_written_to_our_own_firmware_and_read_from_a_foreign_one(tmp_path: Path) -> None:
    objects = {**ALL, "2110sub0": Entry(5, "const", "1"), "2110sub1": Entry(8, "rw", "2.5")}
    text = f'{BENCH}[controller.parameters]\n"0x2110:1" = "controller.proportional_gain"\n'
    place = Place(tmp_path, objects, text)
    assert place.master.read_parameters() == {"controller.proportional_gain": 2.5}
    place.master.configure(b"", None, 0)
    assert 0x2110 not in {index for index, _, _ in place.device.writes}
    place.master.configure(b"", {"controller.proportional_gain": 1.0}, 0)
    assert (0x2110, 1, 0x3F80_0000) in place.device.writes
    assert place.master.read_parameters() == {"controller.proportional_gain": 1.0}
