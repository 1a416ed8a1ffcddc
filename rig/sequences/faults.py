"""Faults as data, and the schedule of the faults that act in each cycle.

The node that injects a fault asks the `Schedule` every millisecond, so everything random or periodic is computed when
it is created; the same seed gives the same faults in the same cycles. Times in a fault are seconds from the start of
the main phase; a fault ends when main ends, so that clean-up runs on a healthy plant.
"""
from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.effects import CATALOGUE
from plant.errors import InputError
from plant.model import find_quantity
from plant.parameters import parse_value
from plant.quantity import Quantity
from plant.segments import RATE, Second
from rig.sequences import tables
from rig.sequences.injection import AddedSignal, StuckSignal, choose_frames

Sensor = Literal["xj", "p12", "xs"]
FrameName = Literal["feedback", "valve_state", "drive", "command"]
HeartbeatNode = Literal["rig", "plant"]
InSI = Annotated[float, "SI units"]
LATEST_START = 1e6  # s, later than any run ends
LARGEST_VALUE = 1e12  # SI; a sensor cannot be further off, and sums of two stay numbers
LARGEST_COUNT = 1_000_000_000  # cycles or frames to count to


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
        what = next((getattr(self, key) for key in ("parameter", "signal", "frame", "node") if hasattr(self, key)), "")
        return self.name or f"{self.kind} {what}"


@dataclass(frozen=True, kw_only=True)
class _Ramped(Fault):
    """A fault of a size, its `value`, that is reached linearly within `ramp` seconds of the start."""

    ramp: Second = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self.ramp >= 0, "ramp", f"0 s or more, not {self.ramp:g}")

    def growth(self, t: float) -> float:
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

    def target(self, quantity: Quantity) -> float:
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

    frame: FrameName
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


@dataclass(frozen=True, kw_only=True)
class Late(_Frames):
    """Frames that arrive `delay` seconds late."""

    kind = "late"
    delay: Second

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(0 < self.delay <= 1, "delay", f"above 0 and at most 1 s, not {self.delay:g}")


@dataclass(frozen=True, kw_only=True)
class Silent(Fault):
    """A node whose heartbeat stops."""

    kind = "heartbeat"
    node: HeartbeatNode


KINDS: dict[str, type[Fault]] = {kind.kind: kind for kind in (Parameter, Offset, Noise, Stuck, Lost, Late, Silent)}


class Drop(NamedTuple):
    """This frame never arrives."""


class Delay(NamedTuple):
    """This frame arrives later."""

    ns: int


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

    def cycles(self, fault: Fault) -> tuple[int, int]:
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


class Schedule:
    """The faults in cycle k. `base` gives the model's own value of every parameter that a fault changes.

    Cycles are counted from the start of set-up. Only a stuck sensor has a memory (what it last read), so ask for them
    in the order of the cycles; everything else may be asked in any order. InputError for a parameter without a base.
    """

    def __init__(self, plan: Plan, base: Mapping[str, float] | None = None) -> None:
        self._base = base or {}
        self._parameters: dict[str, list[tuple[int, int, float, Parameter]]] = {}
        self._signals: dict[str, list[Callable[[int, float], float]]] = {}
        self._frames: dict[str, list[tuple[int, bytes, Drop | Delay]]] = {}
        self._silent: dict[str, list[range]] = {}
        self.edges: tuple[Edge, ...] = ()
        for index, fault in enumerate(plan.faults):
            first, last = plan.cycles(fault)
            last = self._add(fault, first, last, np.random.default_rng((plan.seed, index)))
            self.edges += (Edge(first, fault.label, True), Edge(last, fault.label, False))

    def _add(self, fault: Fault, first: int, last: int, rng: np.random.Generator) -> int:
        """Lay a fault out; returns the cycle in which it is over, which a count of frames may bring forward."""
        match fault:
            case Parameter():
                if fault.parameter not in self._base:
                    raise InputError("faults", fault.parameter, tables.list_choices(fault.parameter, self._base))
                self._parameters.setdefault(fault.parameter, []).append(
                    (first, last, fault.target(find_quantity(fault.parameter, "faults")), fault))
            case Offset():  # or noise
                shape = rng.standard_normal(last - first) if isinstance(fault, Noise) else np.ones(last - first)
                values = [fault.value * fault.growth(k / RATE) * float(unit) for k, unit in enumerate(shape)]
                self._signals.setdefault(fault.signal, []).append(AddedSignal(first, values))
            case Stuck():
                self._signals.setdefault(fault.signal, []).append(StuckSignal(range(first, last), fault.value))
            case _Frames():
                action = Delay(round(fault.delay * 1e9)) if isinstance(fault, Late) else Drop()
                hit = choose_frames(last - first, fault.every, fault.count, fault.probability, rng)
                self._frames.setdefault(fault.frame, []).append((first, hit, action))
                return first + len(hit)
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
                return base + (value - base) * fault.growth((cycle - first) / RATE)
        return base

    def parameters(self, cycle: int) -> dict[str, float]:
        """All parameters of the model, with what faults have made of them in this cycle."""
        return {**self._base, **{name: self._parameter(name, cycle) for name in self._parameters}}

    def signal(self, name: str, value: float, cycle: int) -> float:
        """What the sensor `name` (xj, p12, xs; SI) says in place of `value`; faults act in the order of the plan."""
        for change in self._signals.get(name, ()):
            value = change(cycle, value)
        return value

    def frame(self, name: str, cycle: int) -> Drop | Delay | None:
        """What happens to the frame `name` of this cycle; None: it is sent normally."""
        for first, hit, action in self._frames.get(name, ()):
            if 0 <= cycle - first < len(hit) and hit[cycle - first]:
                return action
        return None

    def find_disturbed(self, cycles: int) -> NDArray[np.bool_]:
        """Of the first `cycles` those in which a fault acts on a cyclic frame, and the one after each."""
        disturbed = np.zeros(cycles + 1, bool)
        for first, hit, _ in (layer for layers in self._frames.values() for layer in layers):
            at = first + np.flatnonzero(np.frombuffer(hit, np.uint8))
            at = at[at < cycles]
            disturbed[at] = disturbed[at + 1] = True
        found: NDArray[np.bool_] = disturbed[:cycles]
        return found

    def is_heartbeat_alive(self, node: str, cycle: int) -> bool:
        """Whether the node (rig or plant) sends its heartbeat."""
        return not any(cycle in cycles for cycles in self._silent.get(node, ()))


def _require_size(value: float) -> None:
    _require(abs(value) <= LARGEST_VALUE, "value", f"at most {LARGEST_VALUE:g} either way, not {value:g}")


def _require(holds: bool, key: str, expected: str) -> None:
    if not holds:
        raise InputError("fault", key, expected)
