"""Faults as data, and the schedule of the faults that act in each cycle.

The node that injects a fault asks the `Schedule` in every cycle, so everything random or periodic is computed when
it is created; the same seed gives the same faults in the same cycles. Times in a fault are seconds from the start of
the main phase; a fault ends when main ends, so that clean-up runs on a healthy plant.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import ceil
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from plant import (
    RATE,
    Array,
    InputError,
    Model,
    Quantity,
    Second,
    check_combinations,
    find_plant,
    find_quantity,
    parse_value,
    require,
    tables,
)
from plant.effects import CATALOGUE
from rig.benches import Bench, Role
from rig.sequences.signals import Sensed, name_signals_of

Table = NDArray[np.int64]
FrameName = Literal["feedback", "valve_state", "drive", "command", "sync"]
PdoName = Literal["feedback", "valve_state", "drive", "command"]
BenchNode = Literal["rig", "plant"]
LATEST_TIME = 1e6  # s, later than any run ends
LARGEST_VALUE = 1e12  # SI; a sensor cannot be further off, and sums of two stay numbers
MOST_FOREIGN = 1000  # frames a cycle; a bus of 1 Mbit/s carries 7
Time = Annotated[float, Quantity("s", low=0.0, high=LATEST_TIME)]
Size = Annotated[float, Quantity("SI units", low=-LARGEST_VALUE, high=LARGEST_VALUE)]
Count = Annotated[int, Quantity("1", low=1, high=1_000_000_000)]


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault that acts from `start` until before `end` (default: the end of main). Checks refer to it by `name`."""

    kind: ClassVar[str]
    start: Time
    end: Time | None = None
    name: str = ""

    def __post_init__(self) -> None:
        require(self.end is None or self.end > self.start, "fault", "end", f"after the start at {self.start:g} s")

    @property
    def label(self) -> str:
        """Its name, or what it does to what: `lost drive`, `parameter filter.clogging`."""
        keys = ("parameter", "signal", "frame", "node", "reset")
        what = next((getattr(self, key) for key in keys if hasattr(self, key)), "")
        return self.name or f"{self.kind} {what}".rstrip()


@dataclass(frozen=True, kw_only=True)
class _Ramped(Fault):
    """A fault of a size, its `value`, that is reached linearly within `ramp` seconds of the start."""

    ramp: Time = 0.0


@dataclass(frozen=True, kw_only=True)
class Parameter(_Ramped):
    """A parameter of the plant or of an effect goes from the model's value to `value`, and back when the fault ends."""

    kind = "parameter"
    parameter: str
    value: Annotated[float, "SI units"] | str  # a word for a parameter that is a choice

    def __post_init__(self) -> None:
        super().__post_init__()
        group = self.parameter.partition(".")[0]
        effect = {**CATALOGUE.of_plants, **CATALOGUE.list_all()}.get(group)
        require(group != "controller" and not (effect and effect.firmware), "fault", "parameter",
                f"a parameter of the plant, not {self.parameter!r}: the controller is the thing under test, no fault "
                "reaches into it")

    def find_target(self, quantity: Quantity) -> float:
        """The number that `value` stands for; raises InputError at the key that cannot be for such a parameter."""
        value = parse_value("fault", "value", quantity, self.value)
        require(not (quantity.words and self.ramp), "fault", "ramp",
                f"none: {self.parameter} is {quantity.expected}, with nothing between them")
        return value


@dataclass(frozen=True, kw_only=True)
class Offset(_Ramped):
    """A sensor reads too high by `value`."""

    kind = "offset"
    signal: Sensed
    value: Size


@dataclass(frozen=True, kw_only=True)
class Noise(Offset):
    """A sensor has more white noise: `value` is its standard deviation."""

    kind = "noise"
    value: Annotated[float, Quantity("SI units", low=0.0, high=LARGEST_VALUE)]


@dataclass(frozen=True, kw_only=True)
class Stuck(Fault):
    """A sensor stays at `value` or, without one, at its last reading."""

    kind = "stuck"
    signal: Sensed
    value: Size | None = None


# What happens to a frame; 0: it is sent normally.
SENT_NORMALLY, DROP, DELAY, DOUBLE, CORRUPT, CUT = range(6)


@dataclass(frozen=True, kw_only=True)
class Frames(Fault):
    """Affects every `every`-th frame, each with a probability, until `count` frames were affected."""

    code: ClassVar[int]  # what happens to them
    frame: FrameName
    every: Count = 1
    count: Count | None = None
    probability: Annotated[float, Quantity("1", above=0.0, high=1.0)] = 1.0


@dataclass(frozen=True, kw_only=True)
class Lost(Frames):
    """Frames that never arrive."""

    kind, code = "lost", DROP


@dataclass(frozen=True, kw_only=True)
class Late(Frames):
    """Frames that arrive `delay` seconds late."""

    kind, code = "late", DELAY
    frame: PdoName
    delay: Annotated[float, Quantity("s", above=0.0, high=1.0)]


@dataclass(frozen=True, kw_only=True)
class Duplicated(Frames):
    """Frames that arrive twice, one right after the other."""

    kind, code = "duplicated", DOUBLE


@dataclass(frozen=True, kw_only=True)
class Corrupted(Frames):
    """Frames with `bits` bits of their data inverted, chosen at random; on a real bus the CRC lets one in 2^15 pass."""

    kind, code = "corrupted", CORRUPT
    frame: PdoName
    bits: Annotated[int, Quantity("1", low=1, high=64)] = 1


@dataclass(frozen=True, kw_only=True)
class Short(Frames):
    """Frames cut to their first `length` bytes."""

    kind, code = "short", CUT
    frame: PdoName
    length: Annotated[int, Quantity("1", low=0, high=7)]


@dataclass(frozen=True, kw_only=True)
class Jitter(Fault):
    """SYNC comes late by a random time, uniform between 0 and `size` seconds; due times stay where they are."""

    kind = "jitter"
    size: Annotated[float, Quantity("s", above=0.0, below=0.1)]  # and below a cycle


@dataclass(frozen=True, kw_only=True)
class Foreign(Fault):
    """A node that is not of the bench: in every `every`-th cycle the rig sends `frames` frames that nobody expects.

    A few with an unknown COB-ID are foreign traffic; many with a low one are a babbling node.
    """

    kind = "foreign"
    cob_id: Annotated[int, Quantity("1", low=1, high=0x7FF)] = 0x7E5
    length: Annotated[int, Quantity("1", low=0, high=8)] = 8
    frames: Annotated[int, Quantity("1", low=1, high=MOST_FOREIGN)] = 1  # in each of these cycles
    every: Count = 1


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
BUS_FAULTS = (Frames, Jitter, Foreign, BusOff, Reset, Silent)  # those on the bus


class Action(NamedTuple):
    """What happens to a frame, in the numbers that compiled loops read.

    `argument`: of DELAY in ns, of CORRUPT the bits to invert as a signed 64-bit word, first byte lowest, of CUT the
    length in bytes; else 0.
    """

    code: int
    argument: int = 0


NORMAL = Action(SENT_NORMALLY)


def move_bits(bits: int, size: int) -> int:
    """As many bits, where there is room, among the lowest `size`: each at its place modulo `size` or the next free one.

    The bits to invert are drawn among 64, whatever the length of the frame that comes.

    >>> hex(move_bits(0x1_0000_0000, 32)), hex(move_bits(0x8000_8000, 16)), move_bits(-1, 8), move_bits(1, 0)
    ('0x1', '0x8001', 255, 0)
    """
    mask = 0
    for place in range(64):
        if bits >> place & 1 and mask != (1 << size) - 1:
            free = place % size
            while mask >> free & 1:
                free = (free + 1) % size
            mask |= 1 << free
    return mask


def change_frame(code: int, argument: int, length: int, data: int) -> tuple[int, int]:
    """Length and payload of a frame after a fault that corrupts or cuts it; after any other code they are unchanged.

    `data`: first byte lowest, bytes beyond `length` zero, as in raw_bus.py.
    """
    if code == CORRUPT:
        if length < 8:
            argument = move_bits(argument, 8 * length)
        data ^= argument
    elif code == CUT:
        length = min(length, argument)
    if length < 8:
        data &= (1 << 8 * length) - 1
    return length, data


class Edge(NamedTuple):
    """A fault begins or ends: a line for the log."""

    cycle: int
    label: str
    begins: bool


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Faults placed in a run: main is the cycles start <= k < stop, counted from the start of set-up.

    `rate`: cycles a second.
    """

    faults: tuple[Fault, ...] = ()
    start: int = 0
    stop: int
    seed: int = 0
    rate: Annotated[float, Quantity("1/s", low=1.0, high=1e6)] = RATE
    plant: str = field(default="eha", metadata={"key": False})  # whose parameters and signals the faults change

    def find_cycles(self, fault: Fault) -> tuple[int, int]:
        """First cycle in which a fault acts and the one in which it no longer does."""
        last = self.stop if fault.end is None else min(self.stop, self.start + round(fault.end * self.rate))
        return min(last, self.start + round(fault.start * self.rate)), last

    def to_json(self) -> dict[str, Any]:
        """What `from_json` makes a plan of: plain dicts, lists, numbers and texts."""
        faults = [{"kind": f.kind, **{k: v for k, v in asdict(f).items() if v is not None}} for f in self.faults]
        return {"faults": faults, "start": self.start, "stop": self.stop, "seed": self.seed,
                "rate": self.rate}

    @classmethod
    def from_json(cls, data: object, plant: str = "eha") -> Self:
        """The plan that was sent, for this plant; InputError if it is none."""
        with name_signals_of(find_plant(plant).signals):
            plan: Self = tables.build_dataclass(cls, data, tables.Place("scenario"), {Fault: KINDS})
        return replace(plan, plant=plant)


@dataclass
class SignalChange:
    """A fault of a sensor in the cycles first <= k < last.

    It adds `added`, one value a cycle, or holds `value` or, without one, the last reading.
    """

    first: int
    last: int
    added: list[float] | None = None
    value: float | None = None


class Schedule:
    """The faults in cycle k. `base` gives the model's own value of every parameter that a fault changes.

    Cycles are counted from the start of set-up. InputError for a parameter without a base.
    """

    def __init__(self, plan: Plan, base: Mapping[str, float] | None = None) -> None:
        self._base, self._stop, self.rate, self._plant = base or {}, plan.stop, plan.rate, plan.plant
        # from which cycle on, and the value in each; of several faults in a cycle the first counts
        self.parameters: dict[str, list[tuple[int, Array]]] = {}
        self.signals: dict[str, list[SignalChange]] = {}  # in the order in which they act
        # from which cycle on, and code and argument in each; under the name of a node: of all its frames
        self._frames: dict[str, list[tuple[int, Table]]] = {}
        self._silent: dict[str, list[range]] = {"rig": [], "plant": []}
        self._foreign: list[tuple[range, Foreign]] = []
        self.resets: list[tuple[int, str]] = []  # cycles before which the controller is reset: "node", "communication"
        self.edges: tuple[Edge, ...] = ()
        for index, fault in enumerate(plan.faults):
            first, last = plan.find_cycles(fault)
            last = self._add(fault, first, last, np.random.default_rng((plan.seed, index)))
            self.edges += (Edge(first, fault.label, True), Edge(last, fault.label, False))
        self.resets.sort()

    def _add(self, fault: Fault, first: int, last: int, rng: np.random.Generator) -> int:
        """Lay a fault out; returns the cycle in which it is over, which a count of frames may bring forward."""
        cycles = last - first
        match fault:
            case Parameter():
                require(fault.parameter in self._base, "faults", fault.parameter,
                        tables.list_choices(fault.parameter, self._base))
                base = self._base[fault.parameter]
                target = fault.find_target(find_quantity(fault.parameter, "faults", self._plant))
                values = base + (target - base) * self._compute_growth(cycles, fault.ramp)
                self.parameters.setdefault(fault.parameter, []).append((first, values))
            case Offset():  # or noise
                shape = rng.standard_normal(cycles) if isinstance(fault, Noise) else np.ones(cycles)
                offsets = fault.value * self._compute_growth(cycles, fault.ramp) * shape
                self.signals.setdefault(fault.signal, []).append(SignalChange(first, last, offsets.tolist()))
            case Stuck():
                self.signals.setdefault(fault.signal, []).append(SignalChange(first, last, value=fault.value))
            case Frames():
                hits = _choose_hits(fault, cycles, rng)
                self._put(fault.frame, first, hits)
                return first + len(hits)
            case Jitter():
                delays = np.rint(rng.uniform(0.0, fault.size, cycles) * 1e9).astype(np.int64)
                self._put("sync", first, np.column_stack((np.full(cycles, DELAY), delays)))
            case Foreign():
                self._foreign.append((range(first, last), fault))
            case Reset():
                self.resets.append((first, fault.reset))
                return first + 1
            case BusOff() | Silent():
                self._silent[fault.node].append(range(first, last))
                for frame in (fault.node, *_FRAMES_OF[fault.node]) if isinstance(fault, BusOff) else ():
                    self._put(frame, first, np.tile(np.array((DROP, 0)), (cycles, 1)))
        return last

    def _compute_growth(self, cycles: int, ramp: Second) -> Array:
        """Share of its full size that a fault has in its cycles, 0..1."""
        t = np.arange(cycles) / self.rate
        return np.divide(t, ramp, out=np.ones_like(t), where=t < ramp)

    def _put(self, name: str, first: int, hits: Table) -> None:
        self._frames.setdefault(name, []).append((first, hits))

    def _parameter(self, name: str, cycle: int) -> float:
        for first, values in self.parameters[name]:
            if 0 <= cycle - first < len(values):
                return float(values[cycle - first])
        return self._base[name]

    def list_parameters(self, cycle: int) -> dict[str, float]:
        """All parameters of the model, with what faults have made of them in this cycle."""
        return {**self._base, **{name: self._parameter(name, cycle) for name in self.parameters}}

    def find_action(self, name: str, cycle: int) -> Action:
        """What happens to the frame `name`, a PDO or `sync`, in this cycle; of a node: DROP while it is bus-off.

        Of several faults the first acts.
        """
        for first, hits in self._frames.get(name, ()):
            if 0 <= cycle - first < len(hits) and hits[cycle - first, 0]:
                return Action(*hits[cycle - first].tolist())
        return NORMAL

    def list_frame_hits(self, name: str) -> Table:
        """The cycles in which something happens to a frame: (n, 3), cycle and the numbers of its `Action`."""
        pieces = self._frames.get(name, [])
        table = np.zeros((max((first + len(hits) for first, hits in pieces), default=0), 2), np.int64)
        for first, hits in reversed(pieces):  # the first fault acts, so it is written last
            is_hit = hits[:, 0] != SENT_NORMALLY
            table[first:first + len(hits)][is_hit] = hits[is_hit]
        cycles = np.flatnonzero(table[:, 0])
        return np.column_stack((cycles, table[cycles]))

    def foreign_frames(self, cycle: int) -> list[tuple[int, bytes]]:
        """COB-ID and data of the frames of no node of the bench that are sent in this cycle."""
        return [(fault.cob_id, (cycle & 0xFFFF).to_bytes(8, "little")[:fault.length])
                for cycles, fault in self._foreign if cycle in cycles and (cycle - cycles.start) % fault.every == 0
                for _ in range(fault.frames)]

    def is_bus_off(self, node: str, cycle: int) -> bool:
        """Whether the node (rig or plant) is bus-off."""
        return self.find_action(node, cycle).code == DROP

    def is_heartbeat_alive(self, node: str, cycle: int) -> bool:
        """Whether the node (rig or plant) sends its heartbeat."""
        return not any(cycle in cycles for cycles in self._silent[node])

    def find_disturbed(self, cycles: int, reach: int = 1) -> NDArray[np.bool_]:
        """Of the first `cycles` those in which a fault acts on a cyclic frame or SYNC, and the `reach` after each.

        After a reset of the controller, all cycles of main.
        """
        disturbed = np.zeros(max(cycles, self._stop) + reach, bool)
        for k, _ in self.resets:  # the rig starts the controller again after main
            disturbed[k:self._stop] = True
        for name in self._frames:
            hits = self.list_frame_hits(name)
            hit = hits[hits[:, 1] == DROP, 0] if name == "sync" else hits[:, 0]
            for after in range(reach + 1):
                disturbed[hit + after] = True
        return disturbed[:cycles]


_FRAMES_OF = {"rig": ("command", "sync"), "plant": ("feedback", "valve_state", "drive")}  # none with a node bus-off


def _choose_hits(fault: Frames, cycles: int, rng: np.random.Generator) -> Table:
    """Code and argument of the action in each cycle, up to the last frame if they are counted."""
    is_hit = (np.arange(cycles) % fault.every == 0) & (rng.random(cycles) < fault.probability)
    if fault.count is not None and is_hit.sum() >= fault.count:
        is_hit = is_hit[:np.flatnonzero(is_hit)[fault.count - 1] + 1]
    hits = np.zeros((len(is_hit), 2), np.int64)
    hits[is_hit, 0] = fault.code
    match fault:
        case Late():
            hits[is_hit, 1] = round(fault.delay * 1e9)
        case Short():
            hits[is_hit, 1] = fault.length
        case Corrupted():
            bits = [rng.choice(64, fault.bits, replace=False) for _ in range(is_hit.sum())]
            hits[is_hit, 1] = [np.bitwise_or.reduce(np.int64(1) << frame_bits) for frame_bits in bits]
    return hits


def require_possible(faults: Sequence[Fault], bench: Bench, where: str) -> None:
    """Refuse faults that a bench cannot have, such as a lost SYNC on plain CAN.

    Raises:
        InputError: it names the key of the fault in the sequence `where`.
    """
    frames = sorted({role for spec in bench.frames.frames for role in spec.roles})
    frames += ["sync"] if bench.frames.sync is not None else []
    identifiers = dict(bench.list_services()) | {spec.identifier: spec.name for spec in bench.frames.frames}
    for i, fault in enumerate(faults):
        match fault:
            case Frames() if fault.frame not in frames:
                key, expected = "frame", f"a frame of {bench.name!r}: {tables.list_choices(fault.frame, frames)}"
            case Jitter() if "sync" not in frames:
                key, expected = "kind", f"a fault without SYNC, which {bench.name!r} does not have, not 'jitter'"
            case Reset() if Role.CONTROLLER not in bench.nodes:
                key, expected = "kind", f"a fault without NMT, which {bench.name!r} does not have, not 'reset'"
            case Silent() if not bench.nodes or (fault.node == "plant" and not bench.has_plant_node):
                key, expected = "node", f"a node of {bench.name!r} with a heartbeat, not {fault.node!r}"
            case Foreign() if fault.cob_id in identifiers:
                key, expected = "cob_id", (f"an identifier from 1 to 0x7FF that {bench.name!r} does not use; "
                                           f"0x{fault.cob_id:X} is {identifiers[fault.cob_id]}")
            case _:
                continue
        raise InputError(where, f"faults[{i}].{key}", expected)


def is_noticed_by_time(fault: Fault) -> bool:
    """Whether nodes notice a fault only because something has not come for some time: SYNC or a heartbeat."""
    return isinstance(fault, Silent | BusOff) or (isinstance(fault, Lost) and fault.frame == "sync")


def find_contradiction(plan: Plan, model: Model) -> tuple[int, str] | None:
    """The first fault whose parameter contradicts another one or the model's own, by its number, and how, in words.

    None if all values go together (plant.parameters.check_combinations) whenever a fault is at an extreme.
    """
    changing = [(i, fault) for i, fault in enumerate(plan.faults) if isinstance(fault, Parameter)]
    if not changing:
        return None
    schedule = Schedule(plan, model.with_effects(fault.parameter.partition(".")[0] for _, fault in changing).values)
    for i, fault in changing:
        first, last = plan.find_cycles(fault)
        end = max(first, last - 1)
        for cycle in (first, min(first + ceil(fault.ramp * plan.rate), end), end, last):
            try:
                check_combinations("faults", schedule.list_parameters(cycle))
            except InputError as error:
                return i, f"{error.field} {error.expected} at {(cycle - plan.start) / plan.rate:g} s of main"
    return None


def require_sensible(plan: Plan, model: Model) -> None:
    """Refuse faults whose parameters contradict each other or the model's own; raises InputError with the fault."""
    if (contradiction := find_contradiction(plan, model)) is not None:
        raise InputError("faults", plan.faults[contradiction[0]].label, contradiction[1])
