"""A bench as a value: the device under test, its frames, and what the rig sends in which phase of a run."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rig.benches.frame_map import FrameMap, Role

Profile = Literal["cia402", "cia408", "none"]

# Signals that the rig and its plant give (inputs of the controller) and take (outputs), by the names of bench files,
# with their units. "" is a number without a unit.
INPUTS = {"position_demand": "m", "ram_position": "m", "load_pressure": "Pa", "spool_position": "m", "load_force": "N",
          "control_word": "", "mode": "", "cycle": "", "flags": ""}
OUTPUTS = {"current": "A", "status_word": "", "mode_display": "", "cycle": ""}
RIG_NODE = 1  # node-ID of the rig
MEASURED = ("ram_position", "load_pressure", "spool_position", "load_force")  # by the plant's transducers


@dataclass(frozen=True, kw_only=True)
class CanopenNode:
    """A CANopen node of a bench."""

    node: int  # node-ID
    eds: Path  # or DCF
    profile: Profile = "none"  # meaning of control word and status word
    mode: int | None = None  # CiA 402: written to 0x6060
    settings: tuple[tuple[int, int, str], ...] = ()  # objects (index, sub) that hold a parameter of the model
    values: tuple[tuple[int, int, bytes], ...] = ()  # of a DCF: written at bring-up

    def find_cob_id(self, service: int) -> int:
        """The COB-ID of a service in the predefined connection set (CiA 301, 7.3.3), such as 0x580."""
        return service + self.node


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Everything that depends on the device under test."""

    name: str
    frames: FrameMap
    nodes: Mapping[Role, CanopenNode]  # empty on plain CAN; without PLANT the rig itself moves the plant
    plant: str = "eha"
    cycle_ns: int = 1_000_000
    bitrate: int = 1_000_000  # bit/s
    timeout_ns: int | None = None  # without a drive frame for so long the controller is gone; None: three cycles
    phases: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # field: phase -> counts
    ready: Mapping[str, float] = field(default_factory=dict)  # field of a frame of the controller: counts in main
    files: Mapping[str, bytes] = field(default_factory=dict)  # bench file, EDS, DBC: name -> content, for the log

    @property
    def has_plant_node(self) -> bool:
        """Whether the plant is a node of its own on the bus."""
        return Role.PLANT in self.nodes

    @property
    def profile(self) -> Profile:
        """Meaning of the controller's control word and status word."""
        controller = self.nodes.get(Role.CONTROLLER)
        return "none" if controller is None else controller.profile

    def describe_node(self, role: Role) -> str:
        """A participant as messages name it: "node 2 controller" on CANopen, else "controller"."""
        name = role.name.lower()
        if role is Role.RIG or role not in self.nodes:
            return name
        return f"node {self.nodes[role].node} {name}"
