"""One bench node on an embedded bus, opposite a hand-made rest of the bench: a test is a script of frames."""

from collections.abc import Callable

import codec
from codec import Drive, Feedback, ValveState

from plant import Model
from rig.network import SCENARIO, Send
from rig.network.bus import EmbeddedBus
from rig.nodes import Emulator, Firmware, Scenario

MS = 1_000_000  # ns


class NodeHarness:
    """A node, booted. What it sends is collected in `heard` as (t_ns, COB-ID, data)."""

    def __init__(self, make: Callable[[Send], Emulator | Firmware]) -> None:
        self.t_ns = 0
        self.heard: list[tuple[int, int, bytes]] = []
        self._bus = EmbeddedBus()
        self._send = self._bus.attach(lambda frame: self.heard.append((frame.t_ns, frame.cob_id, frame.data)))
        self.node = self._bus.add(make)
        self.wait(0)

    def send(self, cob_id: int, data: bytes = b"") -> list[bytes]:
        """Send one frame; what comes back at once, without the COB-IDs."""
        before = len(self.heard)
        self._send(cob_id, data)
        self._bus.deliver(self.t_ns)
        return [data for _, _, data in self.heard[before:]]

    def nmt(self, command: int) -> None:
        self.send(0x000, bytes((command, 0)))

    def wait(self, ns: int) -> None:
        """Let time pass: one tick, at its end."""
        self.t_ns += ns
        self._bus.deliver(self.t_ns)
        self.node.tick(self.t_ns)
        self._bus.deliver(self.t_ns)

    def frames(self, cob_id: int) -> list[bytes]:
        """All frames of that COB-ID so far."""
        return [data for _, cob, data in self.heard if cob == cob_id]

    def emergencies(self) -> list[int]:
        """Their error codes."""
        return [int.from_bytes(data[:2], "little") for data in self.frames(0x080 + self.node.device.node_id)]


class PlantHarness(NodeHarness):
    """The plant emulator, run cycle by cycle by a rig and a controller that the test plays."""

    node: Emulator

    def __init__(self, scenario: Scenario | None = None, start: bool = True) -> None:
        super().__init__(Emulator)
        if scenario is not None:
            assert self.download(scenario.to_bytes()) is None
        self.k = 0
        if start:
            self.nmt(1)

    def download(self, data: bytes, index: int = SCENARIO) -> int | None:
        """SDO download in segments; the abort code, None when it was accepted."""
        reply = self.send(0x603, b"\x21" + index.to_bytes(2, "little") + b"\0" + len(data).to_bytes(4, "little"))[0]
        toggle = 0
        for at in range(0, len(data), 7):
            if reply[0] == 0x80:
                break
            part, last = data[at:at + 7], at + 7 >= len(data)
            reply = self.send(0x603, bytes((toggle | (7 - len(part)) << 1 | last,)) + part.ljust(7, b"\0"))[0]
            toggle ^= 0x10
        return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else None

    def cycle(self, current: float | None = 0.0, answers: int | None = None) -> tuple[Feedback, ValveState]:
        """SYNC, what the plant says, and the drive that answers it (None: none; `answers`: another cycle's)."""
        self.send(codec.SYNC)
        signals = self.last()
        if current is not None:
            self.drive(current, self.k if answers is None else answers)
        self.k += 1
        self.wait(MS)
        return signals

    def drive(self, current: float, cycle: int) -> None:
        self.send(codec.DRIVE, codec.pack_drive(current, 15, cycle))

    def last(self) -> tuple[Feedback, ValveState]:
        """The latest feedback and valve state."""
        return (codec.unpack_feedback(self.frames(codec.FEEDBACK)[-1]),
                codec.unpack_valve_state(self.frames(codec.VALVE_STATE)[-1]))


class FirmwareHarness(NodeHarness):
    """The reference firmware, fed with commands and feedback."""

    node: Firmware

    def __init__(self, model: Model | None = None) -> None:
        super().__init__(lambda send: Firmware(send, model=model))
        self.k = 0
        self.nmt(1)

    def cycle(self, control: int, demand: float = 0.0, position: float | None = 0.0) -> Drive | None:
        """Command, SYNC, feedback (None: none); the last drive that came, if one did."""
        before = len(self.frames(codec.DRIVE))
        self.send(codec.COMMAND, codec.pack_command(demand, control, self.k))
        self.send(codec.SYNC)
        if position is not None:
            self.send(codec.FEEDBACK, codec.pack_feedback(position, 0.0))
        self.k += 1
        self.wait(MS)
        drives = self.frames(codec.DRIVE)[before:]
        return codec.unpack_drive(drives[-1]) if drives else None

    def status(self, control: int, cycles: int) -> int:
        """The status word after some sound cycles with that control word."""
        drives = [self.cycle(control) for _ in range(cycles)]
        assert drives[-1] is not None
        return drives[-1].status
