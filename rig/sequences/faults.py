"""Faults as data, and the schedule of the faults that act in each cycle.

The node that injects a fault asks the `Schedule` every millisecond, so everything random or periodic is computed when
it is created; the same seed gives the same faults in the same cycles. Times in a fault are seconds from the start of
the main phase; a fault ends when main ends, so that clean-up runs on a healthy plant.
"""
from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from math import ceil
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.effects import CATALOGUE
from plant.errors import InputError
from plant.model import Model, find_quantity
from plant.parameters import check_combinations, parse_value
from plant.quantity import Quantity
from plant.segments import RATE, Second
from rig.sequences import tables
from rig.sequences.tables import Place

Sensor = Literal["xj", "p12", "xs"]
FrameName = Literal["feedback", "valve_state", "drive", "command", "sync"]
PdoName = Literal["feedback", "valve_state", "drive", "command"]
BenchNode = Literal["rig", "plant"]
InSI = Annotated[float, "SI units"]
LATEST_START = 1e6  # s, later than any run ends
LARGEST_VALUE = 1e12  # SI; a sensor cannot be further off, and sums of two stay numbers
LARGEST_COUNT = 1_000_000_000  # cycles or frames to count to
MOST_FOREIGN = 1000  # frames a cycle; a bus of 1 Mbit/s carries 7


@dataclass(frozen=True, kw_only=True)
class Fault(ABC):
    """A fault that acts from `start` until before `end` (default: the end of main). Checks refer to it by `name`."""

    kind: ClassVar[str]
    start: Second
    end: Second | None = None
    name: str = ""

    def __post_init__(self) -> None:
        _require(0 <= self.start <= LATEST_START, "start",
                 f"0 s or later, at most {LATEST_START:g}, not {self.start:g}")
        _require(self.end is None or self.start < self.end <= LATEST_START, "end",
                 f"after the start at {self.start:g} s, and at most {LATEST_START:g} s")

    @property
    def label(self) -> str:
        """Its name, or what it does to what: `lost drive`, `parameter filter.clogging`."""
        keys = ("parameter", "signal", "frame", "node", "reset")
        what = next((getattr(self, key) for key in keys if hasattr(self, key)), "")
        return self.name or f"{self.kind} {what}".rstrip()


@dataclass(frozen=True, kw_only=True)
class _Ramped(Fault):
    """A fault of a size, its `value`, that is reached linearly within `ramp` seconds of the start."""

    ramp: Second = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self.ramp >= 0, "ramp", f"0 s or more, not {self.ramp:g}")

    def compute_growth(self, t: float) -> float:
        """Share of the full size at `t` s after the start, 0..1."""
        return 1.0 if t >= self.ramp else t / self.ramp


@dataclass(frozen=True, kw_only=True)
class Parameter(_Ramped):
    """A parameter of the plant or of an effect goes from the model's value to `value`, and back when the fault ends."""

    kind = "parameter"
    parameter: str
    value: InSI | str  # a word for a parameter that is a choice

    def __post_init__(self) -> None:
        super().__post_init__()
        group = self.parameter.partition(".")[0]
        inside = group == "controller" or (group in CATALOGUE and CATALOGUE[group].firmware)
        _require(not inside, "parameter",
                 f"a parameter of the plant, not {self.parameter!r}: the controller is the thing under test, "
                 "no fault reaches into it")

    def find_target(self, quantity: Quantity) -> float:
        """The number that `value` stands for; raises InputError at the key that cannot be for such a parameter."""
        value = parse_value("fault", "value", quantity, self.value)
        _require(not (quantity.words and self.ramp), "ramp",
                 f"none: {self.parameter} is {quantity.expected}, with nothing between them")
        return value


@dataclass(frozen=True, kw_only=True)
class Offset(_Ramped):
    """A sensor reads too high by `value`."""

    kind = "offset"
    signal: Sensor
    value: InSI

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_size(self.value)


@dataclass(frozen=True, kw_only=True)
class Noise(Offset):
    """A sensor has more white noise: `value` is its standard deviation."""

    kind = "noise"


@dataclass(frozen=True, kw_only=True)
class Stuck(Fault):
    """A sensor stays at `value` or, without one, at its last reading."""

    kind = "stuck"
    signal: Sensor
    value: InSI | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_size(self.value or 0.0)


@dataclass(frozen=True, kw_only=True)
class _Frames(Fault):
    """Affects every `every`-th frame, each with a probability, until `count` frames were affected."""

    frame: FrameName | PdoName
    every: int = 1
    count: int | None = None
    probability: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(1 <= self.every <= LARGEST_COUNT, "every", f"1 or more cycles, not {self.every}")
        _require(self.count is None or 1 <= self.count <= LARGEST_COUNT, "count", f"1 or more frames, not {self.count}")
        _require(0 < self.probability <= 1, "probability", f"above 0 and at most 1, not {self.probability:g}")


@dataclass(frozen=True, kw_only=True)
class Lost(_Frames):
    """Frames that never arrive."""

    kind = "lost"
    frame: FrameName


@dataclass(frozen=True, kw_only=True)
class Late(_Frames):
    """Frames that arrive `delay` seconds late."""

    kind = "late"
    frame: PdoName
    delay: Second

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(0 < self.delay <= 1, "delay", f"above 0 and at most 1 s, not {self.delay:g}")


@dataclass(frozen=True, kw_only=True)
class Duplicated(_Frames):
    """Frames that arrive twice, one right after the other."""

    kind = "duplicated"
    frame: FrameName


@dataclass(frozen=True, kw_only=True)
class Corrupted(_Frames):
    """Frames with `bits` bits of their data inverted, chosen at random; on a real bus the CRC lets one in 2^15 pass."""

    kind = "corrupted"
    frame: PdoName
    bits: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(1 <= self.bits <= 64, "bits", f"1 to 64 bits, not {self.bits}")


@dataclass(frozen=True, kw_only=True)
class Short(_Frames):
    """Frames cut to their first `length` bytes."""

    kind = "short"
    frame: PdoName
    length: int

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(0 <= self.length <= 7, "length", f"0 to 7 bytes, not {self.length}")


@dataclass(frozen=True, kw_only=True)
class Jitter(Fault):
    """SYNC comes late by a random time, uniform between 0 and `size` seconds; due times stay where they are."""

    kind = "jitter"
    size: Second

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(0 < self.size < 1 / RATE, "size", f"above 0 s and below the cycle of {1 / RATE:g} s, "
                                                   f"not {self.size:g}")


@dataclass(frozen=True, kw_only=True)
class Foreign(Fault):
    """A node that is not of the bench: in every `every`-th cycle the rig sends `frames` frames that nobody expects.

    A few with an unknown COB-ID are foreign traffic; many with a low one are a babbling node.
    """

    kind = "foreign"
    cob_id: int = 0x7E5
    length: int = 8
    frames: int = 1  # in each of these cycles
    every: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(1 <= self.cob_id <= 0x7FF and not is_of_bench(self.cob_id), "cob_id",
                 f"an identifier from 1 to 0x7FF that no node of the bench uses, not 0x{self.cob_id:X}")
        _require(0 <= self.length <= 8, "length", f"0 to 8 bytes, not {self.length}")
        _require(1 <= self.frames <= MOST_FOREIGN, "frames", f"1 to {MOST_FOREIGN} frames a cycle, not {self.frames}")
        _require(1 <= self.every <= LARGEST_COUNT, "every", f"1 or more cycles, not {self.every}")


@dataclass(frozen=True, kw_only=True)
class BusOff(Fault):
    """A node of the bench is bus-off: it neither sends nor receives, and recovers at the end."""

    kind = "bus_off"
    node: BenchNode


@dataclass(frozen=True, kw_only=True)
class Reset(Fault):
    """The rig resets the controller by NMT: its communication, or the whole node (CiA 301, 7.2.8.2.1)."""

    kind = "reset"
    reset: Literal["node", "communication"] = "node"


@dataclass(frozen=True, kw_only=True)
class Silent(Fault):
    """A node whose heartbeat stops."""

    kind = "heartbeat"
    node: BenchNode


KINDS: dict[str, type[Fault]] = {kind.kind: kind for kind in (
    Parameter, Offset, Noise, Stuck, Lost, Late, Duplicated, Corrupted, Short, Jitter, Foreign, BusOff, Reset, Silent)}
BUS_FAULTS = (_Frames, Jitter, Foreign, BusOff, Reset, Silent)  # those on the bus


def is_of_bench(cob_id: int) -> bool:
    """Whether a node of the bench, 1 to 3, uses a COB-ID: its function code and node number (CiA 301, 7.3.5), SYNC."""
    return cob_id == 0x080 or cob_id & 0x7F in (1, 2, 3)


class Drop(NamedTuple):
    """This frame never arrives."""


class Delay(NamedTuple):
    """This frame arrives later."""

    ns: int


class Double(NamedTuple):
    """This frame arrives twice."""


class Corrupt(NamedTuple):
    """The data of this frame is inverted where `mask` has a one; first byte lowest."""

    mask: int


class Cut(NamedTuple):
    """Only the first `length` bytes of this frame arrive."""

    length: int


Action = Drop | Delay | Double | Corrupt | Cut
ACTION_CODES: Mapping[type, int] = {Drop: 1, Delay: 2, Double: 3, Corrupt: 4, Cut: 5}  # 0: sent normally


def apply_action(action: Action | None, data: bytes) -> tuple[bytes, ...]:
    """What arrives of a frame, at once; a delayed frame is the caller's business and arrives unchanged."""
    match action:
        case Drop():
            return ()
        case Double():
            return data, data
        case Corrupt(mask):
            word = int.from_bytes(data, "little") ^ mask
            return (word.to_bytes(8, "little")[:len(data)],)
        case Cut(length):
            return (data[:length],)
    return (data,)


class Edge(NamedTuple):
    """A fault begins or ends: a line for the log."""

    cycle: int
    label: str
    begins: bool


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Faults placed in a run: main is the cycles start <= k < stop, counted from the start of set-up."""

    faults: tuple[Fault, ...] = ()
    start: int = 0
    stop: int
    seed: int = 0

    def find_cycles(self, fault: Fault) -> tuple[int, int]:
        """First cycle in which a fault acts and the one in which it no longer does."""
        last = self.stop if fault.end is None else min(self.stop, self.start + round(fault.end * RATE))
        return min(last, self.start + round(fault.start * RATE)), last

    def to_json(self) -> dict[str, Any]:
        """What `from_json` makes a plan of: plain dicts, lists, numbers and texts."""
        faults = [{"kind": f.kind, **{k: v for k, v in asdict(f).items() if v is not None}} for f in self.faults]
        return {"faults": faults, "start": self.start, "stop": self.stop, "seed": self.seed}

    @classmethod
    def from_json(cls, data: object) -> Plan:
        """The plan that was sent; InputError if it is none."""
        plain = {**data, "faults": list(data.get("faults", ()))} if isinstance(data, dict) else data
        return tables.build_dataclass(cls, plain, tables.Place("scenario"), {Fault: KINDS})


class ParameterChange(NamedTuple):
    """A fault of a parameter in numbers: `value` is reached within `ramp` s in the cycles first <= k < last."""

    name: str
    first: int
    last: int
    base: float
    value: float
    ramp: Second


class Schedule:
    """The faults in cycle k. `base` gives the model's own value of every parameter that a fault changes.

    Cycles are counted from the start of set-up. Only a stuck sensor has a memory (what it last read), so ask for them
    in the order of the cycles; everything else may be asked in any order. InputError for a parameter without a base.
    """

    def __init__(self, plan: Plan, base: Mapping[str, float] | None = None) -> None:
        self._base, self._stop = base or {}, plan.stop
        self._parameters: dict[str, list[tuple[int, int, float, Parameter]]] = {}
        self._signals: dict[str, list[AddedSignal | StuckSignal]] = {}
        self._frames: dict[str, list[tuple[int, list[Action | None]]]] = {}
        self._silent: dict[str, list[range]] = {}
        self._bus_off: dict[str, list[range]] = {}
        self._foreign: list[tuple[range, Foreign]] = []
        self._resets: list[tuple[int, str]] = []
        self.edges: tuple[Edge, ...] = ()
        for index, fault in enumerate(plan.faults):
            first, last = plan.find_cycles(fault)
            last = self._add(fault, first, last, np.random.default_rng((plan.seed, index)))
            self.edges += (Edge(first, fault.label, True), Edge(last, fault.label, False))

    def _add(self, fault: Fault, first: int, last: int, rng: np.random.Generator) -> int:
        """Lay a fault out; returns the cycle in which it is over, which a count of frames may bring forward."""
        match fault:
            case Parameter():
                if fault.parameter not in self._base:
                    raise InputError("faults", fault.parameter, tables.list_choices(fault.parameter, self._base))
                self._parameters.setdefault(fault.parameter, []).append(
                    (first, last, fault.find_target(find_quantity(fault.parameter, "faults")), fault))
            case Offset():  # or noise
                shape = rng.standard_normal(last - first) if isinstance(fault, Noise) else np.ones(last - first)
                values = [fault.value * fault.compute_growth(k / RATE) * float(unit) for k, unit in enumerate(shape)]
                self._signals.setdefault(fault.signal, []).append(AddedSignal(first, values))
            case Stuck():
                self._signals.setdefault(fault.signal, []).append(StuckSignal(range(first, last), fault.value))
            case _Frames():
                hit = choose_frames(last - first, fault.every, fault.count, fault.probability, rng)
                self._put(fault.frame, first, _choose_actions(fault, hit, rng))
                return first + len(hit)
            case Jitter():
                delays = np.rint(rng.uniform(0.0, fault.size, last - first) * 1e9).astype(int).tolist()
                self._put("sync", first, [Delay(ns) for ns in delays])
            case Foreign():
                self._foreign.append((range(first, last), fault))
            case BusOff():
                self._bus_off.setdefault(fault.node, []).append(range(first, last))
                self._silent.setdefault(fault.node, []).append(range(first, last))
                for frame in _SENT_BY[fault.node] + _RECEIVED_BY[fault.node]:
                    self._put(frame, first, [Drop()] * (last - first))
            case Reset():
                self._resets.append((first, fault.reset))
                return first + 1
            case Silent():
                self._silent.setdefault(fault.node, []).append(range(first, last))
        return last

    def parameters_at(self, cycle: int, since: int | None = None) -> dict[str, float]:
        """The parameters, SI, that differ from what they were in cycle `since` (default: the cycle before)."""
        if not self._parameters:
            return {}
        before = cycle - 1 if since is None else since
        return {name: value for name in self._parameters
                if (value := self._parameter(name, cycle)) != self._parameter(name, before)}

    def _parameter(self, name: str, cycle: int) -> float:
        base = self._base[name]
        for first, last, value, fault in self._parameters[name]:
            if first <= cycle < last:
                return base + (value - base) * fault.compute_growth((cycle - first) / RATE)
        return base

    def list_parameters(self, cycle: int) -> dict[str, float]:
        """All parameters of the model, with what faults have made of them in this cycle."""
        return {**self._base, **{name: self._parameter(name, cycle) for name in self._parameters}}

    def change_signal(self, name: str, value: float, cycle: int) -> float:
        """What the sensor `name` (xj, p12, xs; SI) says in place of `value`; faults act in the order of the plan."""
        for change in self._signals.get(name, ()):
            value = change(cycle, value)
        return value

    def _put(self, name: str, first: int, actions: list[Action | None] | list[Delay] | list[Drop]) -> None:
        self._frames.setdefault(name, []).append((first, list(actions)))

    def find_action(self, name: str, cycle: int) -> Action | None:
        """What happens to the frame `name` of this cycle; None: it is sent normally. Of several faults the first acts.

        The name is that of a PDO or `sync`.
        """
        for first, actions in self._frames.get(name, ()):
            if 0 <= cycle - first < len(actions) and (action := actions[cycle - first]) is not None:
                return action
        return None

    def frame_actions(self, name: str, cycles: int) -> NDArray[np.int64]:
        """`find_action` of the first `cycles` as a table for compiled loops, (cycles, 2).

        The columns are code (ACTION_CODES) and argument.

        The argument of a delay is in ns, that of a corrupted frame the mask as a signed 64-bit word, that of a short
        one its length in bytes; else 0.
        """
        table = np.zeros((cycles, 2), np.int64)
        for first, actions in reversed(self._frames.get(name, [])):  # the first fault acts, so it is written last
            for k, action in enumerate(actions[:max(0, cycles - first)], first):
                if action is not None:
                    table[k] = encode_action(action)
        return table

    def foreign_frames(self, cycle: int) -> list[tuple[int, bytes]]:
        """COB-ID and data of the frames of no node of the bench that are sent in this cycle."""
        if not self._foreign:
            return []
        return [(fault.cob_id, (cycle & 0xFFFF).to_bytes(8, "little")[:fault.length])
                for cycles, fault in self._foreign if cycle in cycles and (cycle - cycles.start) % fault.every == 0
                for _ in range(fault.frames)]

    def foreign_actions(self, cycles: int) -> NDArray[np.int64]:
        """`foreign_frames` of the first `cycles` as a table, (n, 4): cycle, COB-ID, length, number of frames."""
        rows = [(k, fault.cob_id, fault.length, fault.frames) for when, fault in self._foreign
                for k in range(when.start, min(when.stop, cycles), fault.every)]
        return np.array(sorted(rows), np.int64).reshape(-1, 4)

    @property
    def resets(self) -> list[tuple[int, str]]:
        """The cycles before which the rig resets the controller, and what: "node" or "communication"."""
        return sorted(self._resets)

    def is_bus_off(self, node: str, cycle: int) -> bool:
        """Whether the node (rig or plant) is bus-off."""
        return any(cycle in cycles for cycles in self._bus_off.get(node, ()))

    def count_lost_syncs(self, cycle: int) -> int:
        """How many SYNCs in a row are lost from this cycle on."""
        count = 0
        while isinstance(self.find_action("sync", cycle + count), Drop):
            count += 1
        return count

    def find_disturbed(self, cycles: int) -> NDArray[np.bool_]:
        """Of the first `cycles` those in which a fault acts on a cyclic frame or SYNC, and the one after each.

        After a reset of the controller, all cycles of main.
        """
        disturbed = np.zeros(cycles + 1, bool)
        for k, _ in self._resets:  # the rig starts the controller again after main
            disturbed[k:self._stop] = True
        for name in self._frames:
            codes = self.frame_actions(name, cycles)[:, 0]
            hit = np.flatnonzero(codes == ACTION_CODES[Drop] if name == "sync" else codes)
            disturbed[hit] = disturbed[hit + 1] = True
        found: NDArray[np.bool_] = disturbed[:cycles]
        return found

    def is_heartbeat_alive(self, node: str, cycle: int) -> bool:
        """Whether the node (rig or plant) sends its heartbeat."""
        return not any(cycle in cycles for cycles in self._silent.get(node, ()))

    def list_parameter_changes(self) -> list[list[ParameterChange]]:
        """The faults of each parameter that one acts on; of several in a cycle the first counts."""
        return [[ParameterChange(name, first, last, self._base[name], value, fault.ramp)
                 for first, last, value, fault in changes] for name, changes in self._parameters.items()]

    def list_signal_changes(self, name: str) -> list[AddedSignal | StuckSignal]:
        """The faults of a sensor, in the order in which they act."""
        return self._signals.get(name, [])

    def list_frame_hits(self, name: str) -> NDArray[np.int64]:
        """The cycles in which something happens to a frame, for compiled loops: (n, 3), cycle, code and argument.

        As `frame_actions`, without the cycles in which nothing happens.
        """
        table = self.frame_actions(name, max((first + len(actions) for first, actions in self._frames.get(name, [])),
                                             default=0))
        cycles = np.flatnonzero(table[:, 0])
        return np.column_stack((cycles, table[cycles]))

    def list_bus_off_cycles(self, node: str) -> NDArray[np.int64]:
        """The cycles in which the node (rig or plant) is bus-off, in order."""
        return np.array(sorted({k for cycles in self._bus_off.get(node, ()) for k in cycles}), np.int64)


_SENT_BY: Mapping[str, tuple[str, ...]] = {"rig": ("command", "sync"), "plant": ("feedback", "valve_state")}
_RECEIVED_BY: Mapping[str, tuple[str, ...]] = {"rig": (), "plant": ("drive",)}


def _choose_actions(fault: _Frames, hit: bytes, rng: np.random.Generator) -> list[Action | None]:
    """What happens to the frames that a fault hits, cycle by cycle; drawn from `rng` where it is random."""
    def choose() -> Action:
        match fault:
            case Late():
                return Delay(round(fault.delay * 1e9))
            case Duplicated():
                return Double()
            case Corrupted():
                return Corrupt(sum(1 << int(bit) for bit in rng.choice(64, fault.bits, replace=False)))
            case Short():
                return Cut(fault.length)
        return Drop()

    return [choose() if is_hit else None for is_hit in hit]


def encode_action(action: Action | None) -> tuple[int, int]:
    """Code (ACTION_CODES; 0: sent normally) and argument of an action, see `Schedule.frame_actions`."""
    match action:
        case None:
            return 0, 0
        case Delay(argument) | Cut(argument):
            pass
        case Corrupt(mask):
            argument = mask - (1 << 64) if mask >= 1 << 63 else mask
        case _:
            argument = 0
    return ACTION_CODES[type(action)], argument


def is_noticed_by_time(fault: Fault) -> bool:
    """Whether nodes notice a fault only because something has not come for some time: SYNC or a heartbeat."""
    return isinstance(fault, Silent | BusOff) or (isinstance(fault, Lost) and fault.frame == "sync")


def _require_size(value: float) -> None:
    _require(abs(value) <= LARGEST_VALUE, "value", f"at most {LARGEST_VALUE:g} either way, not {value:g}")


def _require(holds: bool, key: str, expected: str) -> None:
    if not holds:
        raise InputError("fault", key, expected)


SENT_NORMALLY = 0
DROP, DELAY, DOUBLE, CORRUPT, CUT = (ACTION_CODES[kind] for kind in (Drop, Delay, Double, Corrupt, Cut))


def change_frame(code: int, argument: int, length: int, data: int) -> tuple[int, int]:
    """Length and payload of a frame after a fault that corrupts or cuts it; after any other code they are unchanged.

    `data`: first byte lowest, bytes beyond `length` zero, as in raw_bus.py.
    """
    if code == CORRUPT:
        data ^= argument
    elif code == CUT:
        length = min(length, argument)
    if length < 8:
        data &= (1 << 8 * length) - 1
    return length, data


class AddedSignal:
    """An additive sensor fault: `values`, one per cycle, are added from cycle `first` on."""

    def __init__(self, first: int, values: list[float]) -> None:
        self.first, self.values = first, values

    def __call__(self, cycle: int, value: float) -> float:
        k = cycle - self.first
        return value + self.values[k] if 0 <= k < len(self.values) else value


class StuckSignal:
    """A sensor that is stuck during `cycles`, at `value` or, without one, at its last reading."""

    def __init__(self, cycles: range, value: float | None) -> None:
        self.cycles, self.value = cycles, value
        self._last_read = 0.0

    def __call__(self, cycle: int, value: float) -> float:
        if cycle in self.cycles:
            return self._last_read if self.value is None else self.value
        self._last_read = value
        return value


def choose_frames(cycles: int, every: int, count: int | None, probability: float, rng: np.random.Generator) -> bytes:
    """One byte a cycle, 1 where a frame is hit: every `every`-th with a probability; up to the last if counted."""
    hit = (np.arange(cycles) % every == 0) & (rng.random(cycles) < probability)
    if count is not None and hit.sum() >= count:
        hit = hit[:np.flatnonzero(hit)[count - 1] + 1]
    return bytes(hit.tobytes())


Known = Callable[[str], object]  # raises InputError for a name that no parameter has


def check_overrides(overrides: Mapping[str, float | str], place: Place, known: Known) -> bool:
    """Names and, where `known` gives their meaning, values; refusals at their lines. True: all meanings are known."""
    whole = True
    for name, value in overrides.items():
        here = place.at(*name.split("."))  # where `overrides.spool.travel` stands in the file
        here = here if here.keys in place.lines else place.at(name)
        quantity = _find_meaning(name, here, known)
        whole &= quantity is not None
        if quantity is not None:
            try:
                parse_value("", "", quantity, value)
            except InputError as error:
                raise here.refuse(error.expected) from error
    return whole


def check_faults(plan: Plan, place: Place, known: Known) -> bool:
    """The same for the parameters that faults change."""
    whole = True
    for i, fault in enumerate(plan.faults):
        if isinstance(fault, Parameter):
            quantity = _find_meaning(fault.parameter, place.at(i, "parameter"), known)
            whole &= quantity is not None
            if quantity is not None:
                try:
                    fault.find_target(quantity)
                except InputError as error:
                    raise place.at(i, error.field).refuse(error.expected) from error
    return whole


def check_together(plan: Plan, model: Model, place: Place) -> None:
    """No fault may make a parameter contradict another one of `model` at the time; refusals at its line."""
    try:
        require_sensible(plan, model)
    except Contradiction as error:
        raise place.at(error.fault).refuse(error.said) from error


class Contradiction(InputError):
    """Two parameters that no actuator can have together, brought about by the fault of that number."""

    def __init__(self, fault: int, label: str, time: float, error: InputError) -> None:
        self.fault = fault
        self.said = f"{error.field} {error.expected} at {time:g} s of main"
        super().__init__("faults", label, self.said)


def require_sensible(plan: Plan, model: Model) -> None:
    """Refuse faults whose parameters contradict each other or the model's own (plant.parameters.check_combinations).

    Raises:
        Contradiction: it names the fault.
    """
    changing = [(i, fault) for i, fault in enumerate(plan.faults) if isinstance(fault, Parameter)]
    if not changing:
        return
    schedule = Schedule(plan, model.with_effects(fault.parameter.partition(".")[0] for _, fault in changing).values)
    for i, fault in changing:
        for cycle in _list_extreme_cycles(plan, fault):
            try:
                check_combinations("faults", schedule.list_parameters(cycle))
            except InputError as error:
                raise Contradiction(i, fault.label, (cycle - plan.start) / RATE, error) from error


def _list_extreme_cycles(plan: Plan, fault: Parameter) -> tuple[int, ...]:
    """The cycles in which a ramped parameter may be extreme: first, end of the ramp, last, and the one after."""
    first, last = plan.find_cycles(fault)
    end = max(first, last - 1)
    return first, min(first + ceil(min(fault.ramp, LATEST_START) * RATE), end), end, last


def _find_meaning(name: str, place: Place, known: Known) -> Quantity | None:
    try:
        quantity: Any = known(name)
    except InputError as error:
        raise place.refuse(f"{error.expected}, not {name!r}") from error
    return quantity if isinstance(quantity, Quantity) else None
