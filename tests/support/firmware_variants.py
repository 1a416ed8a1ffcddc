"""Faulty controllers: the reference firmware behind a layer that spoils what it hears or says, one fault each.

The layer works on frames alone, so a variant is a fault as seen on the bus and not one of a particular implementation.
"""

from collections.abc import Callable

import codec
from codec import Command, Drive, Feedback

from plant import Model
from rig.network import Frame, Send
from rig.nodes import Firmware

CURRENT_LIMIT = 8e-3  # A
_HEARTBEAT = 0x702


class Variant:
    """A sound controller; variants override what differs. `command` and `feedback` are the last ones on the bus."""

    def __init__(self, send: Send, model: Model | None = None) -> None:
        self.bus = send
        self.command, self.feedback = Command(0.0, 0, 0), Feedback(0.0, 0.0)
        self.answers = 0  # drive frames so far
        self.last: Drive | None = None  # the sound answer before
        self.firmware = Firmware(self._transmit, model=model)

    def receive(self, frame: Frame) -> None:
        if frame.cob_id == codec.COMMAND:
            self.command = codec.unpack_command(frame.data)
        elif frame.cob_id == codec.FEEDBACK:
            self.feedback = codec.unpack_feedback(frame.data)
        self.firmware.receive(self.hear(frame))

    def tick(self, t_ns: int) -> None:
        self.firmware.tick(t_ns)

    def hear(self, frame: Frame) -> Frame:
        """What the controller hears of a frame."""
        return frame

    def answer(self, drive: Drive) -> Drive | None:
        """What it says in place of a sound answer; None: nothing."""
        return drive

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if cob_id == codec.DRIVE:
            self.answers += 1
            drive = codec.unpack_drive(data)
            payload = self.answer(drive)
            self.last = drive
            if payload is not None:
                self.bus(cob_id, codec.pack_drive(*payload))
        elif not self.swallows(cob_id, data):
            self.bus(cob_id, data)

    def swallows(self, cob_id: int, data: bytes) -> bool:
        """Whether another frame than the drive frame is not sent."""
        return False


def vary(answer: Callable[[Variant, Drive], Drive | None]) -> type[Variant]:
    """A controller that says this in place of a sound answer."""
    return type("Varied", (Variant,), {"answer": answer})


def is_active(drive: Drive) -> bool:
    """Whether the status word says that the loop is closed."""
    return drive.status & 7 == 7


def limit(current: float) -> float:
    """A current within its limit."""
    return max(-CURRENT_LIMIT, min(CURRENT_LIMIT, current))


# The answer to a cycle comes in the next one, with its own cycle number.
CycleLate = vary(lambda self, drive: self.last)
# The current is that of the cycle before; status word and cycle number are right.
OldCurrent = vary(lambda self, drive: drive._replace(current=self.last.current if self.last and drive.current else 0.0))
# The cycle number is that of the cycle before, all else is right.
StaleNumber = vary(lambda self, drive: drive._replace(cycle=(drive.cycle - 1) & 0xFFFF))
NoOutput = vary(lambda self, drive: drive._replace(current=0.0))
WrongSign = vary(lambda self, drive: drive._replace(current=-drive.current))
GainLow = vary(lambda self, drive: drive._replace(current=limit(0.7 * drive.current)))
GainHigh = vary(lambda self, drive: drive._replace(current=limit(1.3 * drive.current)))
# One drive frame in fifty is not sent.
OneOfFifty = vary(lambda self, drive: drive if self.answers % 50 else None)
# The status word says ACTIVE in any case, or never READY.
AlwaysActive = vary(lambda self, drive: drive._replace(status=0xF))
NeverReady = vary(lambda self, drive: drive._replace(status=drive.status & 7))
# NaN becomes the smallest INT32 when a C program casts it; here from cycle 120 on.
NotANumber = vary(lambda self, drive: drive._replace(current=-2.0**31 * codec.CURRENT) if drive.cycle >= 120 else drive)
BeyondLimit = vary(lambda self, drive: drive._replace(current=3.8 * (self.command.position - self.feedback.position))
                   if is_active(drive) else drive)


class Frozen(Variant):
    """The whole answer but its cycle number stands still from cycle 120 on."""

    _kept: Drive | None = None

    def answer(self, drive: Drive) -> Drive:
        if drive.cycle < 120 or self._kept is None:
            self._kept = drive
        return self._kept._replace(cycle=drive.cycle)


class IgnoresControl(Variant):
    """The loop is always closed; the status word follows the control word all the same."""

    def hear(self, frame: Frame) -> Frame:
        if frame.cob_id != codec.COMMAND:
            return frame
        return frame._replace(data=codec.pack_command(self.command.position, 7, self.command.cycle))

    def answer(self, drive: Drive) -> Drive:
        return drive._replace(status=self.command.control & 7 | 8)


class SlowStatus(Variant):
    """The status word follows five cycles later."""

    def __init__(self, send: Send, model: Model | None = None) -> None:
        self._queue = [8] * 5
        super().__init__(send, model)

    def answer(self, drive: Drive) -> Drive:
        self._queue.append(drive.status)
        return drive._replace(status=self._queue.pop(0))


class NoHeartbeat(Variant):
    """Boot-up, and then no heartbeat."""

    def swallows(self, cob_id: int, data: bytes) -> bool:
        return cob_id == _HEARTBEAT and data != b"\0"


class HalfTheHeartbeats(Variant):
    """Every second heartbeat is not sent."""

    _count = 0

    def swallows(self, cob_id: int, data: bytes) -> bool:
        self._count += cob_id == _HEARTBEAT
        return cob_id == _HEARTBEAT and data != b"\0" and self._count % 2 == 0


class Leaks(Variant):
    """An integral part that neither a reset nor the control word clears."""

    _integral = 0.0

    def answer(self, drive: Drive) -> Drive:
        if not is_active(drive):
            return drive
        self._integral += 1e-3 * drive.current
        return drive._replace(current=drive.current + self._integral)


class StrangeEmcy(Variant):
    """An EMCY of a code that is not documented, taken back at once."""

    def answer(self, drive: Drive) -> Drive:
        if drive.cycle == 120:
            self.bus(0x082, bytes.fromhex("0060010000000000"))
            self.bus(0x082, bytes.fromhex("0000000000000000"))
        return drive
