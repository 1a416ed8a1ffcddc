"""The controllers of examples/: as programs on a bus, and on an embedded bus opposite masters by other libraries."""

import contextlib
import ctypes
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import canopen
import cantools
from c_device import CNode, run_program, skip_without_compiler
from canopen.profiles.p402 import BaseNode402, State402
from node_bench import MS, NodeHarness
from places import ROOT

from rig.benches import EXTENDED
from rig.firmware.build import build_device
from rig.network import Send

DRIVE, ECU = ROOT / "examples" / "cia402_drive", ROOT / "examples" / "can_ecu"
PATIENT = {DRIVE: (), ECU: ("--timeout", "60000")}  # in lockstep the rig may stop for as long as the machine likes


@contextlib.contextmanager
def run_device(folder: Path, where: str, *options: str) -> Iterator[None]:
    """An example on a bus."""
    skip_without_compiler()
    with run_program(build_device(folder), where, *options):
        yield


def make_drive(send: Send, node: int = 5) -> CNode:
    """The drive as a node."""
    return CNode(send, DRIVE, "drive", lambda output: (node, output))


class Answer(NamedTuple):
    """What a drive said at a SYNC."""

    state: str  # as canopen names it
    current: int  # per mille
    status: int


class DriveHarness(NodeHarness):
    """A drive opposite the canopen library, cycle by cycle."""

    def __init__(self) -> None:
        super().__init__(make_drive)
        self.network: Any = canopen.Network()
        send = self._bus.attach(
            lambda frame: self.network.notify(frame.cob_id, bytearray(frame.data), frame.t_ns / 1e9))

        def send_message(can_id: int, data: bytes, remote: bool = False) -> None:
            send(can_id, bytes(data))
            self._bus.deliver(self.t_ns)

        self.network.send_message = send_message
        self.remote = BaseNode402(5, str(DRIVE / "drive.eds"))
        self.network.add_node(self.remote)
        self.sdo = self.remote.sdo

    def start(self) -> None:
        """Make it OPERATIONAL in mode 8, cyclic synchronous position. It watches no SYNC."""
        self.wait(200 * MS)  # a heartbeat says its NMT state
        self.remote.setup_402_state_machine()
        self.sdo[0x6060].raw = 8
        self.remote.nmt.state = "OPERATIONAL"

    def cycle(self, control: int | None = None, target: int | None = None, position: float | None = None,
              silent: tuple[int, ...] = ()) -> Answer:
        """One SYNC: values that are None stay; `silent`: numbers of RPDOs that are not sent."""
        for number, index, value in ((1, 0x6040, control), (1, 0x607A, target), (2, 0x2001, position)):
            if value is not None:
                self.remote.rpdo[number][index].raw = value
        for number in {1, 2} - set(silent):
            self.remote.rpdo[number].transmit()
        self.network.sync.transmit()
        data = self.frames(0x185)[-1]
        status, current = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:], "little", signed=True)
        state = next(name for name, (mask, bits) in State402.SW_MASK.items() if status & mask == bits)
        return Answer(state, current, status)

    def enable(self, target: int = 0, position: float = 0.0) -> Answer:
        """Shutdown, switch on, enable operation."""
        for control in (0x06, 0x07, 0x0F):
            answer = self.cycle(control, target, position)
        return answer

    def last_emergency(self) -> tuple[int, int]:
        """Code and first byte of information of the last EMCY."""
        data = self.frames(0x085)[-1]
        return int.from_bytes(data[:2], "little"), data[3]


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


class EcuHarness(NodeHarness):
    """An ECU opposite the cantools library."""

    def __init__(self, timeout: int = 100) -> None:
        """`timeout`: ms without a frame that are a fault."""
        super().__init__(lambda send: CNode(send, ECU, "ecu", lambda output: (output, ctypes.c_int64(timeout * MS))))
        self.database: Any = cantools.database.load_file(ECU / "ecu.dbc")
        self.counters = {"Demand": 0, "Feedback": 0}

    def encode(self, name: str, **values: float) -> bytes:
        """A sound frame, with the counter after the last one."""
        self.counters[name] = (self.counters[name] + 1) % 16
        data = self.database.encode_message(name, {"Crc": 0, "Counter": self.counters[name], **values})
        return bytes((compute_crc(data[1:]), *data[1:]))

    def transmit(self, name: str, data: bytes, flags: int = EXTENDED) -> list[dict[str, float]]:
        """Put a frame on the bus; the Drives that answer it."""
        return self.decode(self.send(self.database.get_message_by_name(name).frame_id | flags, data))

    def decode(self, frames: list[bytes]) -> list[dict[str, float]]:
        """Drives, whose checksums are checked."""
        assert all(data[0] == compute_crc(data[1:]) for data in frames)
        return [dict(self.database.decode_message("Drive", data, decode_choices=False)) for data in frames]

    def cycle(self, target: float = 0.0, position: float = 0.0, enable: int = 1) -> dict[str, float]:
        """Demand and Feedback, mm, and the Drive that answers."""
        self.transmit("Demand", self.encode("Demand", Position=target, Enable=enable))
        (drive,) = self.transmit("Feedback", self.encode("Feedback", Position=position, Pressure=0.0))
        return drive

    def start(self) -> None:
        """Bring it to state 3, which the fifth answer has first."""
        for _ in range(5):
            self.cycle(enable=0)
