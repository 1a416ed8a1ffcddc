"""Controllers under test that are written with other libraries: canopen for the services, cantools for a DBC."""

import struct
import threading
from collections.abc import Callable, Mapping
from typing import Any

import can
import canopen
import cantools

from plant import Model
from rig.network import open_can

GAIN, LIMIT = (Model()[f"controller.{name}"] for name in ("proportional_gain", "current_limit"))  # A/m, A


def compute_current(demand: float, position: float) -> float:
    """The proportional law of a position loop, A, from two positions in m."""
    return max(-LIMIT, min(LIMIT, GAIN * (demand - position)))


class PythonDevice(threading.Thread):
    """A device on a bus until `close`; `take` gets each message and returns those to send."""

    def __init__(self, where: str, fd: bool = False) -> None:
        super().__init__(daemon=True)
        self.bus = open_can(where, fd=fd)
        self._end = threading.Event()

    def take(self, message: can.Message) -> list[can.Message]:
        raise AssertionError("of a device")

    def run(self) -> None:
        while not self._end.is_set():
            message = self.bus.recv(0.02)
            if message is not None:
                for answer in self.take(message):
                    self.bus.send(answer)

    def close(self) -> None:
        self._end.set()
        self.join()
        self.bus.shutdown()


class CanopenDevice(PythonDevice):
    """A CANopen device without a profile: SDO server by canopen, its PDOs by struct.

    Args:
        where: bus.
        node: node-ID.
        eds: path of its data sheet.
        inputs: COB-ID -> format of the payload and names of its values, each with what a count is worth.
        output: COB-ID, format and count of the current; `on`: the COB-ID that it answers, SYNC or an RPDO.
    """

    def __init__(self, where: str, node: int, eds: str, inputs: Mapping[int, tuple[str, dict[str, float]]],
                 output: tuple[int, str, float], on: int = 0x080, every: int = 1) -> None:
        super().__init__(where)
        self._node, self._inputs, self._output, self._on, self._every = node, inputs, output, on, every
        self.values = {"position_demand": 0.0, "ram_position": 0.0}
        self.is_operational = False
        self._count = 0
        self._answers: list[can.Message] = []
        network = canopen.Network()
        network.send_message = self._send  # type: ignore[method-assign]
        self._local = network.create_node(node, eds)
        self._notify: Callable[..., Any] = network.notify

    def _send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._answers.append(can.Message(arbitration_id=can_id, data=bytes(data), is_extended_id=False))

    def take(self, message: can.Message) -> list[can.Message]:
        self._answers = []
        identifier = message.arbitration_id
        if identifier == 0x600 + self._node:
            self._notify(identifier, bytearray(message.data), 0.0)
        elif identifier == 0 and message.data[1] in (0, self._node):
            self.is_operational, self._count = message.data[0] == 1, 0
            if message.data[0] in (129, 130):
                self._send(0x700 + self._node, b"\0")
        elif identifier in self._inputs:
            code, counts = self._inputs[identifier]
            raw = struct.unpack(code, message.data)
            self.values |= {name: number * count for number, (name, count) in zip(raw, counts.items(), strict=True)}
        if identifier == self._on and self.is_operational:
            self._count += 1
            if self._count % self._every == 0:
                cob_id, code, count = self._output
                current = compute_current(self.values["position_demand"], self.values["ram_position"])
                number = current / count
                self._send(cob_id, struct.pack(code, number if code[-1] in "fd" else round(number)))
        return self._answers


class CanDevice(PythonDevice):
    """A controller whose frames a DBC describes, encoded and decoded by cantools; it answers the message `on`.

    `scale`: m a unit of the positions, A a unit of the current. The signals are named Position (in Demand or on its
    page), Measured and Current. With Start it is ready, State 5, once that has been 1 or 3, and sends a current while
    it is 2 or 3; 0 ends both.
    """

    def __init__(self, where: str, dbc: str, on: str, position: float, current: float, fd: bool = False) -> None:
        super().__init__(where, fd)
        self._database = cantools.database.load_string(dbc, "dbc")
        self._on, self._position, self._current = on, position, current
        self._values = {"Position": 0.0, "Measured": 0.0, "Start": 2}
        self._state = 5

    def take(self, message: can.Message) -> list[can.Message]:
        try:
            definition = self._database.get_message_by_frame_id(message.arbitration_id)
        except KeyError:
            return []
        values = definition.decode(message.data)
        self._values |= values
        if definition.name != self._on or "Measured" not in values:  # once a cycle, not for each page
            return []
        start = self._values["Start"]
        self._state = {0: 0, 1: 5, 3: 5}.get(start, self._state)
        amperes = (self._state and start >= 2) * compute_current(
            *(self._values[name] * self._position for name in ("Position", "Measured")))
        answer = self._database.get_message_by_name("Drive")
        signals = {each.name: 0 for each in answer.signals} | {
            "State": self._state, "Current": amperes / self._current}
        return [can.Message(arbitration_id=answer.frame_id, data=answer.encode(signals, strict=False),
                            is_extended_id=answer.is_extended_frame, is_fd=answer.length > 8)]
