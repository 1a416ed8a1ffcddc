"""A test case, the EDS of the node under test (CiA 306), and the node seen from the bus: frames, SDO by hand, NMT."""
from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from configparser import RawConfigParser
from contextlib import contextmanager
from enum import Enum
from itertools import groupby
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar

from canopen.objectdictionary import ODVariable, datatypes

from plant import count_nouns, read_file
from rig.benches import INVALID, MAPPING, PARAMETERS, decode_device_text, list_pdos, list_variables, read_dictionary
from rig.network import (
    ABORT,
    Frame,
    NmtCommand,
    NmtState,
    SdoProblem,
    Wire,
    download_object,
    name_state,
    require_confirmation,
    upload_object,
)

Item = TypeVar("Item")
Request = ParamSpec("Request")
CHAPTERS = {
    1: "Electronic data sheet",
    2: "Object dictionary",
    3: "SDO",
    4: "PDO",
    5: "SYNC, EMCY and error control",
    6: "NMT",
    7: "Timing",
}


class Verdict(Enum):
    """What a case says about the node."""

    PASS = "pass"
    FAIL = "fail"
    NOT_APPLICABLE = "not applicable"  # the node has no such service, and need not have it
    SKIPPED = "skipped"  # it could not be found out here


class CaseEnd(Exception):
    """Ends a case with a verdict other than PASS; the text says what was measured, or why nothing was."""

    verdict = Verdict.FAIL


class CaseFailed(CaseEnd):
    """The node does not do what is expected, and the case cannot go on."""


class Problem(CaseFailed):
    """One thing is not as expected. A case that looks at many things looks at the others all the same."""


class CaseNotApplicable(CaseEnd):
    """The node does not have what the case tests, and need not have it."""

    verdict = Verdict.NOT_APPLICABLE


class CaseSkipped(CaseEnd):
    """The case cannot be run here."""

    verdict = Verdict.SKIPPED


Check = Callable[["Target"], str]


class Case(NamedTuple):
    """One test. `check` returns what it measured, or raises CaseEnd."""

    number: str  # "chapter.case"
    name: str
    section: str  # of CiA 301 version 4.2, or of another paper that is then named
    expected: str
    check: Check
    is_timed: bool = False  # its verdict depends on times that the tester measures

    @property
    def chapter(self) -> int:
        """Number of the chapter."""
        return int(self.number.partition(".")[0])


def for_each(select: Callable[[Target], Iterable[Item]], probe: Callable[[Target, Item], str | None], noun: str = "",
             text: str = "{}") -> Check:
    """A check that probes one thing after the other: objects, PDOs, requests that must be refused.

    The probe raises Problem for a thing that is wrong, and CaseNotApplicable for one that does not count. The check
    measures the number of things, if there is a noun for them, or else what the probe returns for each; `text` is the
    sentence around it. Without anything that counts the case is not applicable.
    """
    def check(t: Target) -> str:
        labels: list[str] = []
        problems: list[str] = []
        reason: CaseNotApplicable | None = None
        for item in select(t):
            try:
                labels.append(probe(t, item) or "")
            except Problem as problem:
                problems.append(str(problem))
            except CaseNotApplicable as end:
                reason = reason or end
        require(not problems, join_labels(problems))
        if not labels:
            raise reason or CaseNotApplicable("the EDS has no such object")
        return text.format(count_nouns(len(labels), noun) if noun else join_labels(labels, 8))

    return check


def require(condition: object, text: str, end: type[CaseEnd] = Problem) -> None:
    """Ends the case, as a rule with Problem, unless the condition holds."""
    if not condition:
        raise end(text)


def require_applicable(condition: object, reason: str = "") -> None:
    """Raises CaseNotApplicable unless the condition holds."""
    require(condition, reason, CaseNotApplicable)


def join_labels(labels: Sequence[str], most: int = 4) -> str:
    """A few of the labels, and how many more there are. Semicolons part labels that have commas.

    >>> join_labels(["a", "b", "c"], 2), join_labels(["a, b", "c"])
    ('a, b and 1 more', 'a, b; c')
    """
    mark = "; " if any("," in label for label in labels) else ", "
    text = mark.join(labels[:most])
    return f"{text} and {len(labels) - most} more" if len(labels) > most else text


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
            pause = max(min(end - before, 5 * MS), 0)
            if self._wire.wait(done, pause * 1e-9):
                return True
            after = self.now()
            self.stall = max(self.stall, (after - before - pause) * 1e-9)
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
            raise CaseFailed(f"a response of {count_nouns(len(data), 'byte')} to {request.hex(' ')}: {data.hex(' ')}")
        if data[0] == ABORT:
            raise Refusal(int.from_bytes(data[4:], "little"), int.from_bytes(data[1:3], "little"), data[3])
        return data

    def upload(self, index: int, sub: int = 0) -> bytes:
        """Read an object. Raises Refusal; Problem for a malformed transfer."""
        with name_problem(f"upload of 0x{index:04X}:{sub:X}"):
            return upload_object(self._exchange, index, sub)[0]

    def download(self, index: int, sub: int, data: bytes, segmented: bool = False) -> None:
        """Write an object. Raises Refusal; Problem for a malformed transfer."""
        with name_problem(f"download to 0x{index:04X}:{sub:X}"):
            download_object(self._exchange, index, sub, data, segmented)

    def _exchange(self, request: bytes) -> bytes:
        response = self.demand(request)
        require_confirmation(request, response)
        return response

    def read(self, index: int, sub: int = 0) -> int:
        """An unsigned integer object. Raises Refusal, Problem."""
        return int.from_bytes(self.upload(index, sub), "little")

    def write(self, index: int, sub: int, value: bytes | Number) -> None:
        """Write bytes, or a number into an object of the EDS. Raises Refusal, Problem."""
        self.download(index, sub, value if isinstance(value, bytes) else self.variable(index, sub).encode(value))

    def try_download(self, index: int, sub: int, value: bytes | int) -> int:
        """Write bytes, or a number into an object of the EDS; the abort code, 0 if it was accepted."""
        return find_abort(self.write, index, sub, value)

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
        require_applicable(variable.is_writable, f"0x{index:04X}:{sub:X} is {variable.access} in the EDS")
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
            for key, data in ((key, data) for key, data in before.items() if self.upload(*key) != data):
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
        require(boot, f"no boot-up within {self.options.boot_timeout:g} s of an NMT reset", CaseFailed)
        return boot[0]

    @property
    def fixed_heartbeat(self) -> float | None:
        """Its period in s where a master cannot change it, 0 for none; None where a master can."""
        return None if self.sheet.is_writable(0x1017) else (self.sheet.default(0x1017) or 0) * 1e-3

    def beat(self, milliseconds: int = 20) -> None:
        """Let the node send heartbeats often, so that its state is seen soon. Raises CaseNotApplicable, Refusal."""
        if self.fixed_heartbeat is None:
            self.write(0x1017, 0, milliseconds)
        else:
            require_applicable(self.fixed_heartbeat, "the node sends no heartbeat")

    def require_state(self, state: int, after: str) -> None:
        """Raises Problem unless the heartbeat says so, after the present frames have had their effect.

        Raises CaseNotApplicable for a node without heartbeat, CaseFailed where none comes.
        """
        require_applicable(self.fixed_heartbeat != 0.0, "the node sends no heartbeat")
        seconds = self.options.timeout + 1.0 + 3 * (self.fixed_heartbeat or 0.0)
        frames = self.wait_for(self.heartbeat_id, seconds, lambda frame: frame.data != b"\0", 2)
        require(frames, "no heartbeat came", CaseFailed)
        actual_state = frames[1].data[0] & 0x7F if len(frames[1].data) == 1 else -1
        require(actual_state == state, f"{after}: {name_state(actual_state)}, expected {name_state(state)}")

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
        used_ids = {*(frame.cob_id for frame in self.frames),
                    *(self.read(pdo.parameter, 1) & 0x7FF for pdo in self.sheet.pdos)}
        return next(each for each in range(0x57E, 0x480, -1) if each not in used_ids)


def find_abort(action: Callable[Request, object], *request: Request.args, **keywords: Request.kwargs) -> int:
    """The abort code with which the node refuses a request, 0 if it does not. Raises CaseFailed without a response."""
    try:
        action(*request, **keywords)
    except Refusal as refusal:
        return refusal.code
    return 0


def require_abort(code: int, codes: Sequence[int], what: str = "") -> str:
    """The abort code in words. Raises Problem unless it is one of `codes`."""
    text = format_abort(code)
    require(code in codes, f"{what}: {text}" if what else text)
    return text


@contextmanager
def name_problem(transfer: str) -> Iterator[None]:
    """Raises Problem, which names the transfer, for one that is malformed."""
    try:
        yield
    except SdoProblem as problem:
        raise Problem(f"{transfer}: {problem}") from None


def read_error_code(frame: Frame) -> int:
    """The error code of an emergency; -1 for a frame of another kind."""
    return int.from_bytes(frame.data[:2], "little") if len(frame.data) == 8 else -1


Number = int | float
SIZES = {data_type: each.size for data_type, each in ODVariable.STRUCT_TYPES.items()} | {
    datatypes.TIME_OF_DAY: 6, datatypes.TIME_DIFFERENCE: 6}  # data type (CiA 301, table 44) -> bytes
FLOATS = {datatypes.REAL32: "<f", datatypes.REAL64: "<d"}
HISTORY = 0x1003
# Objects that start something when they are written: store, restore, verify, commands, programs, network management.
_ACTIVE = (range(0x1010, 0x1012), range(0x1020, 0x1029), range(0x1F00, 0x2000))


class Variable(NamedTuple):
    """One sub-index as the EDS describes it."""

    index: int  # type: ignore[assignment]  # the word of the standard; nobody asks this tuple for the place of a value
    sub: int
    data_type: int
    access: str  # rw, ro, wo, const, rww, rwr
    default: Number | str | bytes | None
    low: Number | None
    high: Number | None
    is_mappable: bool

    @property
    def label(self) -> str:
        """How it is named in a report."""
        return f"0x{self.index:04X}:{self.sub:X}"

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.sub

    @property
    def is_readable(self) -> bool:
        return self.access != "wo"

    @property
    def is_writable(self) -> bool:
        return "w" in self.access

    @property
    def size(self) -> int:
        """Length of a number in bytes, 0 for what has no fixed one."""
        return SIZES.get(self.data_type, 0)

    @property
    def bits(self) -> int:
        """Length in a PDO."""
        return 1 if self.data_type == datatypes.BOOLEAN else 8 * self.size

    @property
    def is_active(self) -> bool:
        """Whether writing it may start something: such an object is left alone."""
        return any(self.index in each for each in _ACTIVE)

    @property
    def is_communication(self) -> bool:
        """Whether it belongs to the communication profile, whose meaning CiA 301 gives."""
        return 0x1000 <= self.index < 0x2000

    @property
    def has_valid_bit(self) -> bool:
        """Whether it is a COB-ID that bit 31 switches off: of a PDO or of EMCY."""
        return self.key == (0x1014, 0) or (self.index in PARAMETERS and self.sub == 1)

    @property
    def is_mapping(self) -> bool:
        """Whether it belongs to the mapping of a PDO."""
        return self.index - MAPPING in PARAMETERS

    def is_inside(self, value: Number) -> bool:
        """Whether a value keeps to its limits."""
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    def decode(self, data: bytes) -> Number:
        """The number in these bytes. Raises Problem for a wrong length."""
        require(len(data) == self.size, f"{self.label} has {count_nouns(len(data), 'byte')}, expected {self.size}")
        if self.data_type in FLOATS:
            return float(struct.unpack(FLOATS[self.data_type], data)[0])
        return int.from_bytes(data, "little", signed=self.data_type in datatypes.SIGNED_TYPES)

    def encode(self, value: Number) -> bytes:
        """The bytes of a number. Raises OverflowError for one that does not fit."""
        if self.data_type in FLOATS:
            return struct.pack(FLOATS[self.data_type], value)
        return int(value).to_bytes(self.size, "little", signed=self.data_type in datatypes.SIGNED_TYPES)

    def can_hold(self, value: Number) -> bool:
        """Whether a number fits its type."""
        try:
            self.encode(value)
        except OverflowError:
            return False
        return True

    def show(self, data: bytes) -> str:
        """The value for a reader: a number, a text or bytes in hexadecimal."""
        if self.size and len(data) == self.size:
            value = self.decode(data)
            return f"{value:g}" if self.data_type in (*FLOATS, *datatypes.SIGNED_TYPES) else f"0x{value:X}"
        return repr(data.decode("latin-1")) if self.data_type == datatypes.VISIBLE_STRING else data.hex(" ")

    def change(self, data: bytes) -> bytes:
        """Other bytes of the same length, within the limits: by the smallest step where that is possible.

        Raises Problem if there are no bytes, CaseNotApplicable if they are the only ones within the limits.

        >>> variable = Variable(0x2000, 0, datatypes.UNSIGNED8, "rw", None, low=7, high=8, is_mappable=False)
        >>> variable.change(bytes([7])), variable.change(bytes([8]))
        (b'\\x08', b'\\x07')
        >>> variable._replace(high=7).change(bytes([7]))
        Traceback (most recent call last):
        rig.conformance.target.CaseNotApplicable: 0x2000:0 has no other value within its limits
        """
        require(data, f"{self.label} has 0 bytes")
        offers = (*(bytes((data[0] ^ bits,)) + data[1:] for bits in (1, 2, 3)),
                  *(self.encode(end) for end in (self.low, self.high) if end is not None and self.can_hold(end)))
        other = next((offer for offer in offers if offer != data
                      and (len(data) != self.size or self.is_inside(self.decode(offer)))), b"")
        require_applicable(other, f"{self.label} has no other value within its limits")
        return other

    @property
    def default_bytes(self) -> bytes | None:
        """Its default as an SDO upload sends it, None if the EDS has none."""
        if self.default is None or self.default == "":
            return None
        if isinstance(self.default, str):
            is_wide = self.data_type == datatypes.UNICODE_STRING
            return self.default.encode("utf-16-le" if is_wide else "latin-1", "replace")
        return self.default if isinstance(self.default, bytes) else self.encode(self.default)


class DataSheet:
    """An EDS for one node-ID. `text` is the file section by section, `variables` what it describes.

    Raises InputError for a file that is not an EDS.
    """

    def __init__(self, path: Path, node: int) -> None:
        self.path, self.node = path, node
        text = decode_device_text(read_file(path))
        od = read_dictionary(str(path), text, node)
        self.text = RawConfigParser(inline_comment_prefixes=(";",))
        self.text.optionxform = str  # type: ignore[assignment, method-assign]
        self.text.read_string(text)
        self.variables = [Variable(each.index, each.subindex, each.data_type or 0, (each.access_type or "").lower(),
                                   each.default, each.min, each.max, bool(each.pdo_mappable))
                          for each in list_variables(od) if each.index >= 0x1000]
        self.objects = {index: list(own) for index, own in groupby(self.variables, lambda each: each.index)}
        self._by_key = {variable.key: variable for variable in self.variables}
        self.pdos = list(list_pdos(od, node))

    def find(self, index: int, sub: int = 0) -> Variable | None:
        """The variable, None if the EDS has none there."""
        return self._by_key.get((index, sub))

    def is_writable(self, index: int, sub: int = 0) -> bool:
        """Whether the EDS lets a master write there."""
        variable = self.find(index, sub)
        return variable is not None and variable.is_writable

    def default(self, index: int, sub: int = 0) -> int | None:
        """The integer that an object holds after a reset, None if the EDS gives none."""
        variable = self.find(index, sub)
        return variable.default if variable is not None and isinstance(variable.default, int) else None

    def default_identifier(self, index: int, absent: int) -> int:
        """The 11-bit identifier that a COB-ID object has after a reset, `absent` if the EDS gives none."""
        word = self.default(index)
        return absent if word is None else word & 0x7FF

    @property
    def name(self) -> str:
        """The product, as the EDS names it."""
        return self.text.get("DeviceInfo", "ProductName", fallback="").strip() or self.path.name


_RESTRICTED = (
    (0x000, 0x000), (0x001, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x77F),
    (0x780, 0x7FF),
)  # fmt: skip
RESTRICTED_ENDS = sorted({end for each in _RESTRICTED for end in each})  # those that a test tries


def is_restricted(can_id: int) -> bool:
    """Whether no PDO, SYNC, EMCY or TIME may use this identifier.

    >>> is_restricted(0x5FF), is_restricted(0x182)
    (True, False)
    """
    return any(low <= can_id <= high for low, high in _RESTRICTED)
