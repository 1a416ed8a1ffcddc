"""The controllers of examples/ as programs on a bus, and masters for them by independent libraries."""

import contextlib
import queue
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import can
import canopen
import cantools
import pytest
from c_device import run_program, skip_without_compiler
from canopen.profiles.p402 import BaseNode402, State402
from places import ROOT

from rig.firmware.build import build_device
from rig.network.bus import open_can

DRIVE, ECU = ROOT / "examples" / "cia402_drive", ROOT / "examples" / "can_ecu"
# frames, identifiers, times; how a device answers them is the same code on every bus
on_each_bus = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)
LIMIT = 60.0  # s: a frame that does not come within this does not come
PATIENT = {DRIVE: (), ECU: ("--timeout", "60000")}  # in lockstep the rig may stop for as long as the machine likes


@contextlib.contextmanager
def run_device(folder: Path, where: str, *options: str) -> Iterator[None]:
    """An example on a bus."""
    skip_without_compiler()
    with run_program(build_device(folder), where, *options):
        yield


class Answer(NamedTuple):
    """What a drive said at a SYNC."""

    state: str  # as canopen names it
    current: int  # per mille
    status: int


class DriveMaster:
    """Master of one drive: cycle by cycle, so that no test depends on the time between two of them."""

    def __init__(self, where: str, node: int) -> None:
        self.network = canopen.Network(open_can(where))
        self.network.NOTIFIER_CYCLE = 0.05  # s: how long closing takes
        self.network.connect()
        self.node = BaseNode402(node, str(DRIVE / "drive.eds"))
        for name in ("RESET_FAULT", "SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
            setattr(self.node, f"TIMEOUT_{name}", LIMIT)
        self.node.sdo.RESPONSE_TIMEOUT = LIMIT
        self.network.add_node(self.node)
        self._answers: queue.Queue[bytes] = queue.Queue()
        self._emergencies = 0  # of the log that were read
        self.network.subscribe(0x180 + node, lambda _, data, time: self._answers.put(bytes(data)))

    def wait_until_ready(self) -> None:
        """Until a heartbeat says PRE-OPERATIONAL."""
        while self.node.nmt.wait_for_heartbeat(LIMIT) != "PRE-OPERATIONAL":
            pass

    def start(self, sync_us: int = 0) -> None:
        """Make it OPERATIONAL. `sync_us`: period of SYNC to watch, 0: do not watch."""
        self.node.setup_402_state_machine()
        self.node.sdo[0x1006].raw = sync_us
        self.node.sdo[0x6060].raw = 8  # cyclic synchronous position
        self.node.nmt.state = "OPERATIONAL"
        self.node.sdo.upload(0x1006, 0)  # the answer comes after the command took effect

    def cycle(self, control: int | None = None, target: int | None = None, position: float | None = None,
              silent: tuple[int, ...] = ()) -> Answer:
        """One SYNC: values that are None stay; `silent`: numbers of RPDOs that are not sent."""
        for number, index, value in ((1, 0x6040, control), (1, 0x607A, target), (2, 0x2001, position)):
            if value is not None:
                self.node.rpdo[number][index].raw = value
        for number in {1, 2} - set(silent):
            self.node.rpdo[number].transmit()
        self.network.sync.transmit()
        return self._read_answer()

    def _read_answer(self) -> Answer:
        data = self._answers.get(timeout=LIMIT)
        status, current = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:], "little", signed=True)
        state = next(name for name, (mask, bits) in State402.SW_MASK.items() if status & mask == bits)
        return Answer(state, current, status)

    def enable(self, target: int = 0, position: float = 0.0) -> Answer:
        """Shutdown, switch on, enable operation."""
        for control in (0x06, 0x07, 0x0F):
            answer = self.cycle(control, target, position)
        return answer

    def wait_for_emergency(self, code: int) -> bytes:
        """The five bytes of information of the next EMCY with this code."""
        end = time.monotonic() + LIMIT
        while time.monotonic() < end:
            for error in self.node.emcy.log[self._emergencies:]:
                self._emergencies += 1
                if error.code == code:
                    return bytes(error.data)
            time.sleep(0.002)
        raise AssertionError(f"no EMCY 0x{code:04X}")


@contextlib.contextmanager
def run_drive(where: str, *options: str, node: int = 5) -> Iterator[DriveMaster]:
    """A drive and its master on a bus."""
    master = DriveMaster(where, node)
    try:
        with run_device(DRIVE, where, "--node", str(node), *options):
            master.wait_until_ready()
            yield master
    finally:
        master.network.disconnect()


def compute_crc(data: bytes) -> int:
    """CRC-8 SAE J1850, by its table of remainders.

    >>> hex(compute_crc(b"123456789"))
    '0x4b'
    """
    value = 0xFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1) ^ (0x11D if value & 0x80 else 0)
    return value ^ 0xFF


class EcuMaster:
    """The other end of the ECU's bus."""

    def __init__(self, where: str) -> None:
        self.bus = open_can(where)
        self.database: Any = cantools.database.load_file(ECU / "ecu.dbc")
        self.counters = {"Demand": 0, "Feedback": 0}

    def encode(self, name: str, **values: float) -> bytes:
        """A sound frame, with the counter after the last one."""
        self.counters[name] = (self.counters[name] + 1) % 16
        data = self.database.encode_message(name, {"Crc": 0, "Counter": self.counters[name], **values})
        return bytes((compute_crc(data[1:]), *data[1:]))

    def send(self, name: str, data: bytes, is_extended: bool = True) -> None:
        """Put a frame on the bus."""
        identifier = self.database.get_message_by_name(name).frame_id
        self.bus.send(can.Message(arbitration_id=identifier, is_extended_id=is_extended, data=data))

    def read_drive(self) -> dict[str, float]:
        """The next Drive, with its checksum checked."""
        while message := self.bus.recv(LIMIT):
            if message.is_extended_id and message.arbitration_id == 0x18FF0320:
                assert message.data[0] == compute_crc(message.data[1:])
                return dict(self.database.decode_message("Drive", message.data, decode_choices=False))
        raise AssertionError("no Drive")

    def cycle(self, target: float = 0.0, position: float = 0.0, enable: int = 1) -> dict[str, float]:
        """Demand and Feedback, mm, and the Drive that answers."""
        self.send("Demand", self.encode("Demand", Position=target, Enable=enable))
        self.send("Feedback", self.encode("Feedback", Position=position, Pressure=0.0))
        return self.read_drive()

    def start(self) -> None:
        """Bring it to state 3, which the fifth answer has first; before it come Drives that it sends by itself."""
        self.read_drive()
        for _ in range(5):
            self.send("Demand", self.encode("Demand", Position=0.0, Enable=0))
            self.send("Feedback", self.encode("Feedback", Position=0.0, Pressure=0.0))
        while self.read_drive()["State"] != 3:
            pass


@contextlib.contextmanager
def run_ecu(where: str, *options: str, timeout: int = 60_000) -> Iterator[EcuMaster]:
    """An ECU and its master on a bus; `timeout`: ms, as long as a busy machine may take between two frames."""
    with run_device(ECU, where, "--timeout", str(timeout), *options):
        master = EcuMaster(where)
        try:
            yield master
        finally:
            master.bus.shutdown()
