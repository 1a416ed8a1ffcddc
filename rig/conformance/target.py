"""The node under test, seen from the bus: raw frames, SDO requests made by hand, NMT commands, and what comes back."""
from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from rig.conformance.conformance_case import CaseFailed, CaseNotApplicable, CaseSkipped
from rig.conformance.data_sheet import DataSheet, Number, Variable
from rig.network.frame import Frame
from rig.network.link import Wire

MS = 1_000_000  # ns
START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
STOPPED, OPERATIONAL, PRE_OPERATIONAL = 4, 5, 127
STATES = {0: "boot-up", STOPPED: "STOPPED", OPERATIONAL: "OPERATIONAL", PRE_OPERATIONAL: "PRE-OPERATIONAL"}
COMMANDS = {OPERATIONAL: START, STOPPED: STOP, PRE_OPERATIONAL: ENTER_PRE_OPERATIONAL}
ABORT_TEXTS = {  # CiA 301, table 22
    0x05030000: "toggle bit not alternated", 0x05040000: "SDO protocol timed out",
    0x05040001: "command specifier not valid", 0x05040005: "out of memory", 0x06010000: "unsupported access",
    0x06010001: "write only", 0x06010002: "read only", 0x06020000: "no such object",
    0x06040041: "cannot be mapped", 0x06040042: "PDO too long", 0x06040043: "parameter incompatibility",
    0x06040047: "internal incompatibility", 0x06060000: "hardware error", 0x06070010: "length does not match",
    0x06070012: "length too high", 0x06070013: "length too low", 0x06090011: "no such sub-index",
    0x06090030: "invalid value", 0x06090031: "value too high", 0x06090032: "value too low",
    0x06090036: "maximum below minimum", 0x08000000: "general error", 0x08000020: "cannot be stored",
    0x08000021: "local control", 0x08000022: "device state", 0x08000023: "no object dictionary",
    0x08000024: "no data",
}  # fmt: skip
TOGGLE, TIMED_OUT, COMMAND = 0x05030000, 0x05040000, 0x05040001
WRITE_ONLY, READ_ONLY, NO_OBJECT, NO_SUB = 0x06010001, 0x06010002, 0x06020000, 0x06090011
TOO_LONG, TOO_SHORT, WRONG_LENGTH = 0x06070012, 0x06070013, 0x06070010
VALUE, TOO_HIGH, TOO_LOW, STATE, NO_DATA = 0x06090030, 0x06090031, 0x06090032, 0x08000022, 0x08000024
HEAD = struct.Struct("<BHB")


class Options(NamedTuple):
    """How the tester goes about it."""

    may_write: bool = False  # change values of the manufacturer and the profile, not only write back what is there
    timeout: float = 1.0  # s: the longest wait for an SDO response
    boot_timeout: float = 5.0  # s: the longest wait for a boot-up
    tolerance: float = 0.02  # s: added to every time that a node is to keep; covers the tester's own delay


class Refusal(Exception):
    """The node answered an SDO request with an abort."""

    def __init__(self, code: int, index: int, sub: int) -> None:
        self.code = code
        super().__init__(f"0x{index:04X}:{sub:X}: abort {format_abort(code)}")


def format_abort(code: int) -> str:
    """An abort code and what it means; "accepted" for 0.

    >>> format_abort(0x06020000), format_abort(0)
    ('0x06020000 no such object', 'accepted')
    """
    return f"0x{code:08X} {ABORT_TEXTS.get(code, '')}".rstrip() if code else "accepted"


class Target:
    """The node under test. All times are those of the bus: s since the run began, ns in frames.

    `frames` holds everything heard since the case began. `stall` is the longest time, s, by which a wait of the tester
    itself came back too late since then; a time measured across such a stall means nothing.
    """

    def __init__(self, wire: Wire, sheet: DataSheet, options: Options | None = None) -> None:
        self.sheet, self.options = sheet, options or Options()
        self.node = sheet.node
        self.frames: list[Frame] = []
        self.stall = 0.0
        self.others: set[int] = set()  # other nodes heard
        self._wire = wire
        wire.receive = self._hear

    def _hear(self, frame: Frame) -> None:
        self.frames.append(frame)
        if 0x700 < frame.cob_id < 0x780 and frame.cob_id != 0x700 + self.node:
            self.others.add(frame.cob_id - 0x700)

    # Time and frames

    def now(self) -> int:
        """The time on the clock of the bus, ns."""
        return self._wire.clock.now()

    def begin(self) -> None:
        """Forget what was heard: a case begins."""
        self.wait(0.0)
        self.frames.clear()
        self.stall = 0.0

    def send(self, cob_id: int, data: bytes = b"") -> None:
        """Put one frame on the bus."""
        self._wire.send(cob_id, data)

    def wait(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Let frames come in until `done()`; False when it took longer than `seconds`."""
        end = self.now() + round(seconds * 1e9)
        while True:
            before = self.now()
            slice_ns = min(end - before, 5 * MS)
            if self._wire.wait(done, max(slice_ns, 0) * 1e-9):
                return True
            after = self.now()
            self.stall = max(self.stall, (after - before - max(slice_ns, 0)) * 1e-9)
            if after >= end:
                return done()

    def listen(self, seconds: float, *cob_ids: int) -> list[Frame]:
        """The frames of these COB-IDs (all, if none is named) that come within the time."""
        mark = len(self.frames)
        self.wait(seconds)
        return [frame for frame in self.frames[mark:] if not cob_ids or frame.cob_id in cob_ids]

    def wait_for(self, cob_id: int, seconds: float, accept: Callable[[Frame], bool] = lambda frame: True,
                 count: int = 1) -> Frame | None:
        """The `count`-th acceptable frame of that COB-ID from now on, None if it does not come in time."""
        mark = len(self.frames)

        def find() -> list[Frame]:
            return [frame for frame in self.frames[mark:] if frame.cob_id == cob_id and accept(frame)]

        self.wait(seconds, lambda: len(find()) >= count)
        found = find()
        return found[count - 1] if len(found) >= count else None

    # SDO, by hand

    @property
    def request_id(self) -> int:
        """COB-ID client to server of the default SDO."""
        return 0x600 + self.node

    @property
    def response_id(self) -> int:
        """COB-ID server to client."""
        return 0x580 + self.node

    def ask(self, request: bytes, seconds: float | None = None) -> bytes | None:
        """Send an SDO frame; the next frame of the server, None if none comes in time."""
        self.send(self.request_id, request)
        frame = self.wait_for(self.response_id, self.options.timeout if seconds is None else seconds)
        return None if frame is None else frame.data

    def demand(self, request: bytes) -> bytes:
        """Send an SDO frame; the response. Raises CaseFailed without one of 8 bytes, Refusal for an abort."""
        data = self.ask(request)
        if data is None:
            raise CaseFailed(f"no response to {request.hex(' ')} within {self.options.timeout:g} s")
        if len(data) != 8:
            raise CaseFailed(f"a response of {len(data)} bytes to {request.hex(' ')}: {data.hex(' ')}")
        if data[0] == 0x80:
            raise Refusal(int.from_bytes(data[4:], "little"), int.from_bytes(data[1:3], "little"), data[3])
        return data

    def find_abort(self, request: bytes) -> int:
        """Send an SDO frame; the abort code of the response, 0 if it is none. Raises CaseFailed without a response."""
        try:
            self.demand(request)
        except Refusal as refusal:
            return refusal.code
        return 0

    def upload(self, index: int, sub: int = 0) -> bytes:
        """Read an object. Raises Refusal; CaseFailed for a malformed transfer."""
        response = self.demand(HEAD.pack(0x40, index, sub) + bytes(4))
        if response[0] >> 5 != 2 or HEAD.unpack_from(response)[1:] != (index, sub):
            raise CaseFailed(f"upload of 0x{index:04X}:{sub:X} was answered with {response.hex(' ')}")
        if response[0] & 2:
            return response[4:8 - (response[0] >> 2 & 3 if response[0] & 1 else 0)]
        announced = int.from_bytes(response[4:], "little") if response[0] & 1 else None
        data, toggle, last = b"", 0, False
        while not last:
            response = self.demand(bytes((0x60 | toggle,)) + bytes(7))
            if response[0] >> 5 or response[0] & 0x10 != toggle:
                raise CaseFailed(f"upload of 0x{index:04X}:{sub:X}: segment {response.hex(' ')}")
            data += response[1:8 - (response[0] >> 1 & 7)]
            toggle ^= 0x10
            last = bool(response[0] & 1)
            if len(data) > (1 << 24 if announced is None else announced):
                raise CaseFailed(f"0x{index:04X}:{sub:X}: more bytes than announced")
        if announced is not None and len(data) != announced:
            raise CaseFailed(f"0x{index:04X}:{sub:X}: {len(data)} bytes came, {announced} were announced")
        return data

    def download(self, index: int, sub: int, data: bytes, segmented: bool = False) -> None:
        """Write an object. Raises Refusal; CaseFailed for a malformed transfer."""
        size = len(data)
        if 0 < size <= 4 and not segmented:
            response = self.demand(HEAD.pack(0x23 | (4 - size) << 2, index, sub) + data.ljust(4, b"\0"))
            if response[:4] != HEAD.pack(0x60, index, sub):
                raise CaseFailed(f"download to 0x{index:04X}:{sub:X} was answered with {response.hex(' ')}")
            return
        response = self.demand(HEAD.pack(0x21, index, sub) + size.to_bytes(4, "little"))
        if response[:4] != HEAD.pack(0x60, index, sub):
            raise CaseFailed(f"download to 0x{index:04X}:{sub:X} was answered with {response.hex(' ')}")
        toggle = 0
        for start in range(0, max(len(data), 1), 7):
            part = data[start:start + 7]
            command = toggle | (7 - len(part)) << 1 | (start + 7 >= len(data))
            response = self.demand(bytes((command,)) + part.ljust(7, b"\0"))
            if response[0] != 0x20 | toggle:
                raise CaseFailed(f"segment to 0x{index:04X}:{sub:X} was answered with {response.hex(' ')}")
            toggle ^= 0x10

    def try_download(self, index: int, sub: int, data: bytes) -> int:
        """Write an object; the abort code, 0 if it was accepted. Raises CaseFailed."""
        try:
            self.download(index, sub, data)
        except Refusal as refusal:
            return refusal.code
        return 0

    def try_upload(self, index: int, sub: int) -> int:
        """Read an object; the abort code, 0 if it was sent. Raises CaseFailed."""
        try:
            self.upload(index, sub)
        except Refusal as refusal:
            return refusal.code
        return 0

    def read(self, index: int, sub: int = 0) -> int:
        """An unsigned integer object. Raises Refusal, CaseFailed."""
        return int.from_bytes(self.upload(index, sub), "little")

    def write(self, index: int, sub: int, value: Number) -> None:
        """Write a number into an object of the EDS. Raises Refusal, CaseFailed."""
        self.download(index, sub, self.variable(index, sub).encode(value))

    def variable(self, index: int, sub: int = 0) -> Variable:
        """The object in the EDS. Raises CaseNotApplicable if the node has none."""
        variable = self.sheet.find(index, sub)
        if variable is None:
            raise CaseNotApplicable(f"the EDS has no object 0x{index:04X}:{sub:X}")
        return variable

    def require_writable(self, index: int, sub: int = 0) -> Variable:
        """The object in the EDS, if a master may write it. Raises CaseNotApplicable."""
        variable = self.variable(index, sub)
        if not variable.is_writable:
            raise CaseNotApplicable(f"0x{index:04X}:{sub:X} is {variable.access} in the EDS")
        return variable

    @contextmanager
    def restore_afterwards(self, *variables: Variable) -> Iterator[None]:
        """Whatever happens within, write back what these objects held before. Raises Refusal, CaseFailed."""
        before = [(variable, self.upload(variable.index, variable.sub)) for variable in variables]
        try:
            yield
        finally:
            for variable, data in before:
                if self.upload(variable.index, variable.sub) != data:
                    self.download(variable.index, variable.sub, data)

    # NMT and error control

    @property
    def heartbeat_id(self) -> int:
        """COB-ID of boot-up and heartbeat."""
        return 0x700 + self.node

    def command(self, specifier: int, node: int | None = None) -> None:
        """Send an NMT command to the node under test, or to another."""
        self.send(0x000, bytes((specifier, self.node if node is None else node)))

    def reset(self, specifier: int = RESET_COMMUNICATION) -> Frame:
        """Reset the node; its boot-up. Raises CaseFailed if none comes."""
        self.command(specifier)
        boot = self.wait_for(self.heartbeat_id, self.options.boot_timeout, lambda frame: frame.data == b"\0")
        if boot is None:
            raise CaseFailed(f"no boot-up within {self.options.boot_timeout:g} s of an NMT reset")
        return boot

    @property
    def fixed_heartbeat(self) -> float | None:
        """Its period in s where a master cannot change it, 0 for none; None where a master can."""
        variable = self.sheet.find(0x1017)
        if variable is not None and variable.is_writable:
            return None
        return float(variable.default) * 1e-3 if variable and isinstance(variable.default, int) else 0.0

    def beat(self, milliseconds: int = 20) -> None:
        """Let the node send heartbeats often, so that its state is seen soon. Raises CaseNotApplicable, Refusal."""
        if self.fixed_heartbeat is None:
            self.write(0x1017, 0, milliseconds)
        elif not self.fixed_heartbeat:
            raise CaseNotApplicable("the node sends no heartbeat")

    def read_state(self) -> int:
        """The state in its heartbeat, after the present frames have had their effect.

        Raises CaseFailed, or CaseNotApplicable for a node without heartbeat.
        """
        if self.fixed_heartbeat == 0.0:
            raise CaseNotApplicable("the node sends no heartbeat")
        seconds = self.options.timeout + 1.0 + 3 * (self.fixed_heartbeat or 0.0)
        frame = self.wait_for(self.heartbeat_id, seconds, lambda frame: frame.data != b"\0", 2)
        if frame is None:
            raise CaseFailed("no heartbeat came")
        return frame.data[0] & 0x7F if len(frame.data) == 1 else -1

    def enter(self, state: int) -> None:
        """Command a state, and see that the node takes it on, if it says so. Raises CaseFailed."""
        self.command(COMMANDS[state])
        if self.fixed_heartbeat == 0.0:
            self.wait(0.1)
            return
        found = self.read_state()
        if found != state:
            raise CaseFailed(f"commanded {STATES[state]}, the heartbeat says {STATES.get(found, found)}")

    # SYNC, PDO, EMCY

    def identifier(self, index: int, sub: int, absent: int) -> int:
        """The 11-bit identifier in a COB-ID object; `absent` if the node has none, or it cannot be read."""
        if self.sheet.find(index, sub) is None:
            return absent
        try:
            return self.read(index, sub) & 0x7FF
        except Refusal:
            return absent

    @property
    def emcy_id(self) -> int:
        """COB-ID of its emergencies by the EDS (0x1014)."""
        return self.sheet.default_identifier(0x1014, 0x080 + self.node)

    def sync(self) -> None:
        """Send a SYNC, under the COB-ID of the EDS (0x1005)."""
        self.send(self.sheet.default_identifier(0x1005, 0x080))

    def wait_for_error(self, seconds: float, *codes: int) -> Frame | None:
        """The next emergency with one of these codes, None if none comes in time."""
        return self.wait_for(self.emcy_id, seconds, lambda frame: read_error_code(frame) in codes)

    def find_free_node(self) -> int:
        """A node-ID that nobody on the bus has, as far as was heard. Raises CaseSkipped."""
        for node in range(126, 0, -1):
            if node != self.node and node not in self.others:
                return node
        raise CaseSkipped("every node-ID is taken")

    def find_free_identifiers(self, count: int) -> list[int]:
        """Identifiers that a PDO may use and nobody does, as far as was heard. Raises Refusal, CaseFailed."""
        used = {frame.cob_id for frame in self.frames}
        used |= {self.identifier(pdo.parameter, 1, 0) for pdo in self.sheet.pdos}
        return [each for each in range(0x57E, 0x480, -1) if each not in used][:count]


def read_error_code(frame: Frame) -> int:
    """The error code of an emergency; -1 for a frame of another kind."""
    return int.from_bytes(frame.data[:2], "little") if len(frame.data) == 8 else -1
