"""What the log holds: a dataclass per record is the one definition; the protobuf schema and the packer follow from it.

Fields of fixed width come first and are packed in one precompiled `struct` call together with the MCAP message header;
text and bytes follow. That is about 1 us a record against 5 us with protobuf's Python objects, and the log shares the
interpreter lock with the loop. Zeros are written out, which proto3 allows; a test reads it with Google's library.
"""
# ruff: noqa: RUF009 (`describe_field` is a field specifier, as dataclasses.field is)

import math
import os
import platform
import struct
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, make_dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, cast, get_type_hints

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Fd, FileDescriptorSet

from fdi.trace import CheckResult, describe_field
from plant import count_nouns, require, signals as plant_signals

U32 = Annotated[int, "fixed32"]

_WIRE: dict[object, tuple[Fd.Type.ValueType, int, str]] = {  # type -> protobuf type, wire type, struct code
    float: (Fd.TYPE_DOUBLE, 1, "d"),
    U32: (Fd.TYPE_FIXED32, 5, "I"),
    bool: (Fd.TYPE_BOOL, 0, "?"),
    bytes: (Fd.TYPE_BYTES, 2, ""),
    str: (Fd.TYPE_STRING, 2, ""),
}
_HEAD = "<BQHIQQ"  # MCAP message record: opcode, length, channel, sequence, log time, publish time
_MESSAGE = 0x05


@dataclass(slots=True)
class CanFrame:
    """A raw CAN frame; its time is the log time."""

    cob_id: U32 = describe_field("identifier; bit 31: extended, 30: FD, 29: BRS")
    data: bytes = describe_field("0-64 bytes")


@dataclass(slots=True)
class Signals:
    """One cycle, decoded: row k holds Com_k, XJ_k as sensed and Cor_k, the answer to sample k. NaN: no sample."""

    cycle: U32 = describe_field("cycles since the run began, not wrapped as on the bus")
    phase: U32 = describe_field("0 set-up, 1 main, 2 clean-up")
    com: float = describe_field("position demand", "m")
    xj: float = describe_field("ram position as sensed", "m")
    cor: float = describe_field("current demand of the controller", "A")
    p12: float = describe_field("differential pressure as sensed", "Pa")
    xs: float = describe_field("spool position as sensed", "m")
    load: float = describe_field("known external force on the ram, positive against extension", "N")
    control: U32 = describe_field("control word, CiA 408 object 0x6040")
    status: U32 = describe_field("status word, CiA 408 object 0x6041")
    flags: U32 = describe_field("flags of the plant node")


@dataclass(slots=True)
class Timing:
    """When one cycle ran; all times are on the wall clock, also in lockstep."""

    cycle: U32 = describe_field("as in /signals")
    overrun: bool = describe_field("the cycle was skipped or ended after the next one was due")
    lateness: float = describe_field("SYNC sent this long after it was due", "s")
    response: float = describe_field("from SYNC to the controller's drive frame; NaN: none came", "s")
    work: float = describe_field("from SYNC to the last of the cycle's answers; NaN: one is missing", "s")
    feedback_response: float = describe_field("from SYNC to the plant's feedback frame; NaN: none came", "s",
                                               default=math.nan)
    valve_response: float = describe_field("from SYNC to the plant's valve state; NaN: none came", "s",
                                            default=math.nan)
    execution: float = describe_field("time the rig's own code took in the cycle, without waiting", "s",
                                       default=math.nan)


@dataclass(slots=True)
class Event:
    """A single event: phase change, fault on or off, EMCY, safe state, operator."""

    level: str = describe_field("INFO, WARN or ERROR")
    kind: str = describe_field("one word: phase, segment, fault, emcy, safe_state, abort, ...")
    text: str = describe_field("for people")


@dataclass(slots=True)
class NmtState:
    """A node's NMT state changed, as seen by the master (CiA 301 heartbeat codes)."""

    node: U32 = describe_field("node number")
    code: U32 = describe_field("0 boot-up, 4 stopped, 5 operational, 127 pre-operational")
    name: str = describe_field("the same in words")


@cache
def make_row_record(signals: plant_signals.Signals) -> type[Signals]:
    """The record of one cycle of a plant with these signals; `Signals` itself for those of the EHA."""
    if signals.names == plant_signals.EHA.names:
        return Signals
    row_fields = {item.name: item for item in fields(Signals)}
    used_names = {*row_fields, *(item.name for item in fields(Timing))} - {*plant_signals.EHA.names}
    for name in signals.names:
        require(name not in used_names and name.isidentifier(), "plant", f"signal {name}",
                f"the name of a column that no row of a run has already (it has {', '.join(sorted(used_names))})")
    first, last = (("cycle", "phase"), ("control", "status", "flags"))
    hints = get_type_hints(Signals, include_extras=True)

    def keep(names: tuple[str, ...]) -> list[tuple[str, Any, Any]]:
        return [(name, hints[name], field(metadata=dict(row_fields[name].metadata))) for name in names]

    signal_fields = [(s.name, float, describe_field(s.quantity, s.unit)) for s in signals[1:]]
    record: Any = make_dataclass("Signals", [*keep(first), *signal_fields, *keep(last)], slots=True, namespace={
        "__doc__": "One cycle, decoded: row k holds the command, the sensed outputs and the drive, the answer to "
                   "sample k. NaN: no sample."})
    CHANNELS[record] = CHANNELS[Signals]
    return cast("type[Signals]", record)


Record = Signals | Timing | Event | NmtState | CheckResult
TOPICS: dict[str, type] = {"/can": CanFrame, "/signals": Signals, "/timing": Timing, "/events": Event, "/nmt": NmtState,
                           "/checks": CheckResult}
CHANNELS: dict[type, int] = {record: number for number, record in enumerate(TOPICS.values(), 1)}


def encode_schema(record: type) -> bytes:
    """The FileDescriptorSet of one record, package `eha`."""
    files = FileDescriptorSet()
    file = files.file.add(name=f"eha/{record.__name__}.proto", package="eha", syntax="proto3")
    message = file.message_type.add(name=record.__name__)
    hints = get_type_hints(record, include_extras=True)
    for number, item in enumerate(fields(record), 1):
        message.field.add(name=item.name, number=number, type=_WIRE[hints[item.name]][0], label=Fd.LABEL_OPTIONAL)
    return files.SerializeToString(deterministic=True)


def describe_channel(record: type) -> dict[str, str]:
    """Units and meanings of the fields, for the channel's metadata: unit.xj = m, doc.xj = ..."""
    out = {"doc": (record.__doc__ or "").split("\n")[0]}
    for item in fields(record):
        out[f"doc.{item.name}"] = item.metadata["doc"]
        if item.metadata["unit"]:
            out[f"unit.{item.name}"] = item.metadata["unit"]
    return out


def list_row_fields(record: type) -> list[tuple[str, str]]:
    """Name and numpy code of what `make_packer` packs in one go: header, then tag and value of each number."""
    head = [("opcode", "u1"), ("size", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<u8"),
            ("published", "<u8")]
    hints = get_type_hints(record, include_extras=True)
    codes = {"d": "<f8", "I": "<u4", "?": "?"}
    numbers = [(item.name, codes[code]) for item in fields(record) if (code := _WIRE[hints[item.name]][2])]
    return [*head, *(each for name, code in numbers for each in ((f"tag.{name}", "u1"), (name, code)))]


def make_packer(record: type) -> Callable[[int, Any], bytes]:
    """-> pack(t_ns, values or record): a whole MCAP message record, header included.

    `values` of a frame is the Frame itself (t_ns, cob_id, data), which saves an object per frame.
    """
    hints = get_type_hints(record, include_extras=True)
    layout, args = _HEAD, [_MESSAGE, 0, CHANNELS[record], 0, 0, 0]
    blobs: list[tuple[str, bytes]] = []
    for number, item in enumerate(fields(record), 1):
        _, wire, code = _WIRE[hints[item.name]]
        tag = number << 3 | wire
        if code:  # fields of fixed width come first
            layout, args = layout + "B" + code, [*args, tag, 0]
        else:
            blobs.append((item.name, _encode_varint(tag)))
    fixed = struct.Struct(layout)
    size = fixed.size - 9
    names = [item.name for item in fields(record)][: (len(args) - 6) // 2]
    if record is CanFrame:
        return _make_frame_packer(fixed.pack, args, size)
    get: Callable[[Any], Any] = attrgetter(*names) if len(names) > 1 else lambda r: tuple(getattr(r, n) for n in names)

    def pack(t_ns: int, values: Any) -> bytes:
        args[4] = args[5] = t_ns
        args[7::2] = get(values)
        tail = b"".join([tag + _encode_blob(getattr(values, name)) for name, tag in blobs]) if blobs else b""
        args[1] = size + len(tail)
        head: bytes = fixed.pack(*args)
        return head + tail

    return pack


def _make_frame_packer(pack_head: Callable[..., bytes], args: list[int], size: int) -> Callable[[int, Any], bytes]:
    opcode, _, channel, sequence, _, _, tag, _ = args
    tails = [bytes([2 << 3 | 2, n]) for n in range(65)]

    def pack(t_ns: int, frame: Any) -> bytes:
        data: bytes = frame[2]
        n = len(data)
        head: bytes = pack_head(opcode, size + 2 + n, channel, sequence, t_ns, t_ns, tag, frame[1])
        return head + tails[n] + data

    return pack


def _encode_blob(value: str | bytes) -> bytes:
    """Length-delimited field: varint length, then the bytes."""
    raw = value.encode() if isinstance(value, str) else value
    return _encode_varint(len(raw)) + raw


def _encode_varint(n: int) -> bytes:
    """A whole number in groups of 7 bits, the lowest first."""
    out = bytearray()
    while n > 0x7F:
        out.append(n & 0x7F | 0x80)
        n >>= 7
    out.append(n)
    return bytes(out)


RECORDED_PACKAGES = ("eha-rig", "numpy", "numba", "python-can", "canopen", "mcap", "protobuf")


def collect_provenance(**entries: object) -> dict[str, str]:
    """Collect host, time, package versions and state of the checkout; `entries` adds seed, bus, pace, model.

    >>> collect_provenance(seed=1)["seed"]
    '1'
    """
    return {
        **{name: str(value) for name, value in entries.items()},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}, {os.cpu_count()} processors",
        "python": platform.python_version(),
        **{f"version.{name}": _read_version(name) for name in RECORDED_PACKAGES},
        **_read_git_state(Path(__file__).parents[2]),
    }


def read_epoch_ns() -> int:
    """The date now, ns since 1970 (UTC); SOURCE_DATE_EPOCH, whole seconds, replaces it, for logs that are equal."""
    text = os.environ.get("SOURCE_DATE_EPOCH", "")
    is_date = text.isascii() and text.isdecimal() and len(text) < 11
    return int(text) * 10**9 if is_date else time.time_ns()


def _read_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _read_git_state(root: Path) -> dict[str, str]:
    """Commit and whether files differ from it; nothing when this is no checkout or git is missing."""
    if not (root / ".git").exists():
        return {}
    command = ["git", "--no-optional-locks",  # which a killed process would leave behind
               "-C", str(root), "status", "--porcelain=v2", "--branch", "--untracked-files=no"]
    try:
        lines = subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        return {}
    commit = next((line.removeprefix("# branch.oid ") for line in lines if line.startswith("# branch.oid ")), "")
    file_count = sum(not line.startswith("#") for line in lines)
    return {"git.commit": commit, "git.state": f"{count_nouns(file_count, 'file')} changed" if file_count else "clean"}
