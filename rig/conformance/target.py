"""The node under test, seen from the bus: raw frames, SDO requests made by hand, NMT commands, and what comes back."""
from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from rig.conformance.conformance_case import CaseFailed, CaseNotApplicable, Problem, require
from rig.conformance.data_sheet import DataSheet, Number, Variable
from rig.network.frame import Frame
from rig.network.link import Wire
from rig.network.node_objects import NmtCommand, NmtState

MS = 1_000_000  # ns
STOPPED, OPERATIONAL, PRE_OPERATIONAL = NmtState.STOPPED, NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL
COMMANDS = {PRE_OPERATIONAL: NmtCommand.ENTER_PRE_OPERATIONAL, OPERATIONAL: NmtCommand.START, STOPPED: NmtCommand.STOP}
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
CANNOT_MAP, PDO_TOO_LONG, INCOMPATIBLE = 0x06040041, 0x06040042, 0x06040043
INVALID = 1 << 31  # in a COB-ID: the PDO or EMCY is off
HEAD = struct.Struct("<BHB")


class Options(NamedTuple):
    """How the tester goes about it."""

    may_write: bool = False  # change values of the manufacturer and the profile, not only write back what is there
    timeout: float = 1.0  # s: the longest wait for an SDO response
    boot_timeout: float = 5.0  # s: the longest wait for a boot-up
    tolerance: float = 0.02  # s: added to every time that a node is to keep; covers the tester's own delay


class Refusal(Problem):
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


def name_state(state: int) -> str:
    """An NMT state as the standard writes it.

    >>> name_state(127), name_state(9)
    ('PRE-OPERATIONAL', '9')
    """
    return NmtState(state).name.replace("_", "-") if state in list(NmtState) else str(state)


class Target:
    """The node under test. All times are those of the bus: s since the run began, ns in frames.

    `frames` holds everything heard since the case began. `stall` is the longest time, s, by which a wait of the tester
    itself came back too late since then; a time measured across such a stall means nothing.
    """

    def __init__(self, wire: Wire, sheet: DataSheet, options: Options | None = None) -> None:
        self.sheet, self.options, self.node = sheet, options or Options(), sheet.node
        self.frames: list[Frame] = []
        self.stall = 0.0
        self.others: set[int] = set()  # other nodes heard
        # COB-IDs: SDO client to server and back, boot-up and heartbeat; SYNC and EMCY as the EDS has them
        self.request_id, self.response_id, self.heartbeat_id = (base + sheet.node for base in (0x600, 0x580, 0x700))
        self.sync_id = sheet.default_identifier(0x1005, 0x080)
        self.emcy_id = sheet.default_identifier(0x1014, 0x080 + sheet.node)
        self._wire = wire
        wire.receive = self._hear

    def _hear(self, frame: Frame) -> None:
        self.frames.append(frame)
        if 0x700 < frame.cob_id < 0x780 and frame.cob_id != self.heartbeat_id:
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
            planned = max(min(end - before, 5 * MS), 0)
            if self._wire.wait(done, planned * 1e-9):
                return True
            after = self.now()
            self.stall = max(self.stall, (after - before - planned) * 1e-9)
            if after >= end:
                return done()

    def heard(self, mark: int, *cob_ids: int) -> list[Frame]:
        """The frames of these COB-IDs (all, if none is named) since there were `mark` frames."""
        return [frame for frame in self.frames[mark:] if not cob_ids or frame.cob_id in cob_ids]

    def listen(self, seconds: float, *cob_ids: int) -> list[Frame]:
        """The frames of these COB-IDs (all, if none is named) that come within the time."""
        mark = len(self.frames)
        self.wait(seconds)
        return self.heard(mark, *cob_ids)

    def wait_for(self, cob_id: int, seconds: float, accept: Callable[[Frame], bool] = lambda frame: True,
                 count: int = 1) -> list[Frame]:
        """The first `count` acceptable frames of that COB-ID from now on; none if they do not come in time."""
        mark = len(self.frames)

        def find() -> list[Frame]:
            return [frame for frame in self.heard(mark, cob_id) if accept(frame)]

        return find()[:count] if self.wait(seconds, lambda: len(find()) >= count) else []

    # SDO, by hand

    def ask(self, request: bytes, seconds: float | None = None) -> bytes | None:
        """Send an SDO frame; the next frame of the server, None if none comes in time."""
        self.send(self.request_id, request)
        frames = self.wait_for(self.response_id, self.options.timeout if seconds is None else seconds)
        return frames[0].data if frames else None

    def demand(self, request: bytes) -> bytes:
        """Send an SDO frame; the response. Raises CaseFailed without one of 8 bytes, Refusal for an abort."""
        data = self.ask(request.ljust(8, b"\0"))
        if data is None:
            raise CaseFailed(f"no response to {request.hex(' ')} within {self.options.timeout:g} s")
        if len(data) != 8:
            raise CaseFailed(f"a response of {len(data)} bytes to {request.hex(' ')}: {data.hex(' ')}")
        if data[0] == 0x80:
            raise Refusal(int.from_bytes(data[4:], "little"), int.from_bytes(data[1:3], "little"), data[3])
        return data

    def upload(self, index: int, sub: int = 0) -> bytes:
        """Read an object. Raises Refusal; Problem for a malformed transfer."""
        name = f"upload of 0x{index:04X}:{sub:X}"
        response = self.demand(HEAD.pack(0x40, index, sub))
        command = response[0]
        require(command >> 5 == 2 and response[1:4] == HEAD.pack(command, index, sub)[1:],
                f"{name} was answered with {response.hex(' ')}")
        if command & 2:
            return response[4:8 - (command >> 2 & 3 if command & 1 else 0)]
        announced = int.from_bytes(response[4:], "little") if command & 1 else None
        data, toggle, is_last = b"", 0, False
        while not is_last:
            response = self.demand(bytes((0x60 | toggle,)))
            require(response[0] & 0xF0 == toggle, f"{name}: segment {response.hex(' ')}, expected toggle {toggle >> 4}")
            data += response[1:8 - (response[0] >> 1 & 7)]
            toggle ^= 0x10
            is_last = bool(response[0] & 1)
            require(len(data) <= (1 << 24 if announced is None else announced), f"{name}: more bytes than announced")
        require(announced in (None, len(data)), f"{name}: {len(data)} bytes came, {announced} were announced")
        return data

    def download(self, index: int, sub: int, data: bytes, segmented: bool = False) -> None:
        """Write an object. Raises Refusal; Problem for a malformed transfer."""
        name, size = f"download to 0x{index:04X}:{sub:X}", len(data)
        is_expedited = 0 < size <= 4 and not segmented
        response = self.demand(HEAD.pack(0x23 | (4 - size) << 2, index, sub) + data if is_expedited else
                               HEAD.pack(0x21, index, sub) + size.to_bytes(4, "little"))
        require(response[:4] == HEAD.pack(0x60, index, sub), f"{name} was answered with {response.hex(' ')}")
        toggle = 0
        for start in range(0, 0 if is_expedited else max(size, 1), 7):
            response = self.demand(pack_segment(data[start:start + 7], start + 7 >= size, toggle))
            require(response[0] == 0x20 | toggle, f"{name}: a segment was answered with {response.hex(' ')}")
            toggle ^= 0x10

    def read(self, index: int, sub: int = 0) -> int:
        """An unsigned integer object. Raises Refusal, Problem."""
        return int.from_bytes(self.upload(index, sub), "little")

    def write(self, index: int, sub: int, value: Number) -> None:
        """Write a number into an object of the EDS. Raises Refusal, Problem."""
        self.download(index, sub, self.variable(index, sub).encode(value))

    def try_upload(self, index: int, sub: int) -> int:
        """Read an object; the abort code, 0 if it was sent."""
        return find_abort(lambda: self.upload(index, sub))

    def try_download(self, index: int, sub: int, value: bytes | int) -> int:
        """Write bytes, or a number into an object of the EDS; the abort code, 0 if it was accepted."""
        data = value if isinstance(value, bytes) else self.variable(index, sub).encode(value)
        return find_abort(lambda: self.download(index, sub, data))

    def try_demand(self, request: bytes) -> int:
        """Send an SDO frame; the abort code of the response, 0 if it is none."""
        return find_abort(lambda: self.demand(request))

    def require_value(self, variable: Variable, data: bytes, problem: str) -> None:
        """Raises Problem unless the object holds these bytes."""
        require(self.upload(*variable.key) == data, f"{variable.label} {problem}")

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
    def restore_afterwards(self, *keys: tuple[int, int]) -> Iterator[None]:
        """Whatever happens within, write back what these objects held before. Raises Refusal, Problem.

        A COB-ID is switched off first: it cannot be changed otherwise.
        """
        before = {key: self.upload(*key) for key in keys}
        try:
            yield
        finally:
            for key, data in before.items():
                if self.upload(*key) == data:
                    continue
                if self.variable(*key).has_valid_bit:
                    self.try_download(*key, int.from_bytes(data, "little") | INVALID)
                self.download(*key, data)

    # NMT and error control

    def command(self, specifier: int, node: int | None = None) -> None:
        """Send an NMT command to the node under test, or to another."""
        self.send(0x000, bytes((specifier, self.node if node is None else node)))

    def reset(self, specifier: int = NmtCommand.RESET_COMMUNICATION, node: int | None = None) -> Frame:
        """Reset the node, or all; its boot-up. Raises CaseFailed if none comes."""
        self.command(specifier, node)
        boot = self.wait_for(self.heartbeat_id, self.options.boot_timeout, lambda frame: frame.data[:1] == b"\0")
        if not boot:
            raise CaseFailed(f"no boot-up within {self.options.boot_timeout:g} s of an NMT reset")
        return boot[0]

    @property
    def fixed_heartbeat(self) -> float | None:
        """Its period in s where a master cannot change it, 0 for none; None where a master can."""
        return None if self.sheet.is_writable(0x1017) else (self.sheet.default(0x1017) or 0) * 1e-3

    def beat(self, milliseconds: int = 20) -> None:
        """Let the node send heartbeats often, so that its state is seen soon. Raises CaseNotApplicable, Refusal."""
        if self.fixed_heartbeat is None:
            self.write(0x1017, 0, milliseconds)
        elif not self.fixed_heartbeat:
            raise CaseNotApplicable("the node sends no heartbeat")

    def require_state(self, state: int, after: str) -> None:
        """Raises Problem unless the heartbeat says so, after the present frames have had their effect.

        Raises CaseNotApplicable for a node without heartbeat, CaseFailed where none comes.
        """
        if self.fixed_heartbeat == 0.0:
            raise CaseNotApplicable("the node sends no heartbeat")
        seconds = self.options.timeout + 1.0 + 3 * (self.fixed_heartbeat or 0.0)
        frames = self.wait_for(self.heartbeat_id, seconds, lambda frame: frame.data != b"\0", 2)
        if not frames:
            raise CaseFailed("no heartbeat came")
        found = frames[1].data[0] & 0x7F if len(frames[1].data) == 1 else -1
        require(found == state, f"{after}: {name_state(found)}, expected {name_state(state)}")

    def enter(self, state: NmtState) -> None:
        """Command a state, and see that the node takes it on, if it says so. Raises Problem."""
        self.command(COMMANDS[state])
        if self.fixed_heartbeat == 0.0:
            self.wait(0.1)
        else:
            self.require_state(state, "heartbeat after the command")

    # SYNC, PDO, EMCY

    def sync(self, count: int = 1, seconds: float = 0.0) -> None:
        """Send SYNCs; wait so long after each."""
        for _ in range(count):
            self.send(self.sync_id)
            if seconds:
                self.wait(seconds)

    def wait_for_error(self, seconds: float, *codes: int) -> list[Frame]:
        """The next emergency with one of these codes, none if it does not come in time."""
        return self.wait_for(self.emcy_id, seconds, lambda frame: read_error_code(frame) in codes)

    def find_free_node(self) -> int:
        """A node-ID that nobody on the bus has, as far as was heard."""
        return next(node for node in range(126, 0, -1) if node not in (self.node, *self.others))

    def find_free_identifier(self) -> int:
        """An identifier that a PDO may use and nobody does, as far as was heard. Raises Refusal, Problem."""
        used = {frame.cob_id for frame in self.frames}
        used |= {self.read(pdo.parameter, 1) & 0x7FF for pdo in self.sheet.pdos}
        return next(each for each in range(0x57E, 0x480, -1) if each not in used)


def find_abort(action: Callable[[], object]) -> int:
    """The abort code with which the node refuses, 0 if it does not. Raises CaseFailed without a response."""
    try:
        action()
    except Refusal as refusal:
        return refusal.code
    return 0


def require_abort(code: int, accepted: Sequence[int], what: str = "") -> str:
    """The abort code in words. Raises Problem unless it is one of the accepted ones."""
    text = format_abort(code)
    require(code in accepted, f"{what}: {text}" if what else text)
    return text


def pack_segment(part: bytes, is_last: bool, toggle: int = 0) -> bytes:
    """A segment of a download with up to 7 bytes."""
    return bytes((toggle | (7 - len(part)) << 1 | is_last,)) + part.ljust(7, b"\0")


def read_error_code(frame: Frame) -> int:
    """The error code of an emergency; -1 for a frame of another kind."""
    return int.from_bytes(frame.data[:2], "little") if len(frame.data) == 8 else -1
