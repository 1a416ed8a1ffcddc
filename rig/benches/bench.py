"""A bench as a value: the device under test, its frames, and what the rig sends in which phase of a run."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntFlag
from pathlib import Path
from typing import Literal, NamedTuple

from plant.errors import InputError
from plant.signals import EHA, Signals
from rig.benches.calibration import Decision, SensorCalibration
from rig.benches.frame_map import Field, FrameMap, Role

Profile = Literal["cia402", "cia408", "none"]
SERVICES = {0x080: "EMCY", 0x580: "SDO", 0x600: "SDO", 0x700: "heartbeat"}  # of a node: CiA 301, table of 7.3.5

RIG_INPUTS = ("control_word", "mode", "cycle", "flags")  # of a controller: what the rig gives beside the plant
RIG_OUTPUTS = ("status_word", "mode_display", "cycle")


def list_inputs(signals: Signals) -> dict[str, str]:
    """What a controller may receive on a bench with a plant that has these signals: word and unit.

    "" is a number without a unit.
    """
    given = (signals.command, *signals.outputs, *([signals.load] if signals.load else []))
    return {s.word: _show_unit(s.unit) for s in given} | dict.fromkeys(RIG_INPUTS, "")


def list_outputs(signals: Signals) -> dict[str, str]:
    """What a controller may send: word and unit."""
    return {signals.drive.word: _show_unit(signals.drive.unit)} | dict.fromkeys(RIG_OUTPUTS, "")


def list_measured(signals: Signals) -> tuple[str, ...]:
    """The words of what transducers of the plant read, the load among them."""
    return tuple(s.word for s in signals if s.role in ("output", "load"))


def find_word(signals: Signals, said: str) -> str:
    """The word of a signal that is called by it, by its name, or as on every bench: position_demand, load."""
    load = {} if signals.load is None else {"load": signals.load.word}
    words = {s.word: s.word for s in signals[1:]}
    return {"position_demand": signals.command.word, **load, **{s.name: s.word for s in signals[1:]}, **words}.get(
        said, said)


def _show_unit(unit: str) -> str:
    return "" if unit == "1" else unit


class Flags(IntFlag):
    """State of the input of the plant in a cycle: how the controller answered the cycle before."""

    DRIVE_MISSING = 0x1  # no drive frame came
    DRIVE_LATE = 0x2  # the frame that came answers an earlier cycle
    CURRENT_ZEROED = 0x4  # too many in a row: the plant gets no current


class SignalObject(NamedTuple):
    """The object of a device that holds a signal, and how."""

    key: tuple[int, int]  # index, sub-index
    field: Field


@dataclass(frozen=True, kw_only=True)
class CanopenNode:
    """A CANopen node of a bench."""

    node: int  # node-ID
    eds: Path  # or DCF
    profile: Profile = "none"  # meaning of control word and status word
    mode: int | None = None  # CiA 402: written to 0x6060
    settings: tuple[tuple[int, int, str], ...] = ()  # objects (index, sub) that hold a parameter of the model
    values: tuple[tuple[int, int, bytes], ...] = ()  # of a DCF: written at bring-up
    emcy: tuple[int, ...] = ()  # error codes that its manual lists
    inputs: Mapping[str, SignalObject] = field(default_factory=dict)  # signals that it receives
    outputs: Mapping[str, SignalObject] = field(default_factory=dict)  # signals that it sends

    def find_cob_id(self, service: int) -> int:
        """The COB-ID of a service in the predefined connection set (CiA 301, 7.3.3), such as 0x580."""
        return service + self.node


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Everything that depends on the device under test."""

    name: str
    frames: FrameMap
    nodes: Mapping[Role, CanopenNode]  # empty on plain CAN; without PLANT the rig itself moves the plant
    plant: str = "eha"  # model that runs unless another is chosen
    kind: str = "eha"  # what models call its plant
    signals: Signals = EHA  # of the plant that runs; their words are names of fields in the frames
    noise: float = 2e-6  # SI, nominal, of the sensor of the controlled signal; 0: not known
    cycle_ns: int = 1_000_000
    bitrate: int = 1_000_000  # bit/s
    data_bitrate: int | None = None  # bit/s, of the data of CAN FD frames with BRS; None: not known
    timeout_ns: int | None = None  # without a drive frame for so long the controller is gone; None: three cycles
    phases: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # field: phase -> counts
    ready: Mapping[str, float] = field(default_factory=dict)  # field of a frame of the controller: counts in main
    files: Mapping[str, bytes] = field(default_factory=dict)  # bench file, EDS, DBC: name -> content, for the log
    decision: Decision = "simple"  # rule by which a value with an uncertainty passes a limit
    calibration: Mapping[str, SensorCalibration] = field(default_factory=dict)  # by signal of the plant

    @property
    def fineness(self) -> float:
        """What differences of the controlled signal are measured by: noise of its sensor, or a part of a demand count.
        """
        word = self.signals.command.word
        counts = [float(abs(each.count)) for spec in self.frames.frames for each in spec.fields if each.name == word]
        return max(self.noise or 2e-6, 0.2 * max(counts, default=0.0))

    def replace_signals(self, signals: Signals, noise: float, model: str) -> Bench:
        """The bench with the plant of another model: its signals, and the noise of the controlled one's sensor.

        Raises:
            InputError: it lacks a signal that the bench uses, or has it in another unit.
        """
        if signals == self.signals:
            return replace(self, noise=noise)
        used = {each.name for spec in self.frames.frames for each in spec.fields}
        own = {s.word: s for s in signals[1:]}
        for s in self.signals[1:]:
            if s.word in used or s.role in ("command", "drive"):
                found = own.get(s.word)
                if found is None or (found.unit, found.role) != (s.unit, s.role):
                    has = ", ".join(f"{each.word} ({each.unit})" for each in own.values())
                    raise InputError(self.name, s.word, f"a plant that has this signal, as {s.role} in {s.unit}; "
                                                        f"{model} has {has}; another bench by --bench FILE")
        return replace(self, signals=signals, noise=noise)

    @property
    def rate(self) -> float:
        """Cycles a second."""
        return 1e9 / self.cycle_ns

    @property
    def has_plant_node(self) -> bool:
        """Whether the plant is a node of its own on the bus."""
        return Role.PLANT in self.nodes

    @property
    def most_missed(self) -> int:
        """Cycles in a row without a drive frame after which the plant gets no current."""
        return 3 if self.timeout_ns is None else max(1, -(-self.timeout_ns // self.cycle_ns))

    @property
    def profile(self) -> Profile:
        """Meaning of the controller's control word and status word."""
        controller = self.nodes.get(Role.CONTROLLER)
        return "none" if controller is None else controller.profile

    @property
    def rig_node(self) -> int:
        """Node-ID of the rig: 1, or the largest that is free if a device has that."""
        taken = {node.node for node in self.nodes.values()}
        return 1 if 1 not in taken else next(number for number in range(127, 0, -1) if number not in taken)

    def find_number(self, role: Role) -> int:
        """The node-ID of a participant; on plain CAN, where nobody has one, the number of its role."""
        if role in self.nodes:
            return self.nodes[role].node
        return self.rig_node if role is Role.RIG and self.nodes else int(role)

    @property
    def enables(self) -> tuple[str, ...]:
        """Fields of `phases` that enable the controller: 0 in set-up or clean-up, and not in main."""
        return tuple(name for name, values in self.phases.items()
                     if values.get("main") and 0 in (values.get("setup"), values.get("cleanup"), values.get("safe")))

    def is_enabled(self, phase: str) -> bool:
        """Whether the fields that enable the controller do so in a phase: "setup", "main" or "cleanup"."""
        return all(self.phases[name].get(phase, 0) != 0 for name in self.enables)

    def describe_node(self, role: Role) -> str:
        """A participant as messages name it: "node 2 controller" on CANopen, else "controller"."""
        has_number = role in self.nodes or (role is Role.RIG and self.nodes)
        return f"node {self.find_number(role)} {role.name.lower()}" if has_number else role.name.lower()

    def list_participants(self) -> dict[int, str]:
        """Who takes part in a run: number, and name with it."""
        roles = [role for role in Role if role is not Role.PLANT or self.has_plant_node]
        return {self.find_number(role): self.describe_node(role) for role in roles}

    def read_data_sheet(self, role: Role) -> tuple[str, str]:
        """Name and text of a node's EDS or DCF."""
        path = self.nodes[role].eds
        name = next((name for name in self.files if path.as_posix().endswith(name)), path.name)
        return name, decode_device_text(self.files[name] if name in self.files else path.read_bytes())

    def list_services(self) -> dict[int, str]:
        """Identifiers that carry no values of the bench, and what they are: NMT, SYNC, and the services of the nodes.
        """
        found = {} if self.frames.sync is None else {self.frames.sync: "SYNC"}
        if self.nodes:
            found[0x000] = "NMT"
            for number in (self.rig_node, *(node.node for node in self.nodes.values())):
                found |= {base + number: f"{service} of node {number}" for base, service in SERVICES.items()}
        return found


def decode_device_text(data: bytes) -> str:
    """The text of an EDS, DCF or DBC; those of old tools are not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")
