"""Buses: the embedded one, that needs nothing from the machine, and python-can's, opened from one line of text."""
from __future__ import annotations

import os
import socket
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import can

from plant.errors import InputError, RigError
from rig.network.can_interface import UdpBus
from rig.network.frame import BIT_RATE_SWITCH, Frame, Node, Send
from rig.network.udp import GROUP, is_group

BUS_VARIABLE = "EHA_RIG_BUS"  # environment: what `auto` takes
BITRATE, _DATA_BITRATE = 1_000_000, 4_000_000  # bit/s; the second of CAN FD, in advice
_FD_MTU = 72  # bytes of struct canfd_frame, linux/can.h
_NETWORK = Path("/sys/class/net")
_ARPHRD_CAN = "280"
_SPECS = "auto, embedded, virtual[:NAME], udp_multicast[:GROUP], socketcan:INTERFACE or a python-can INTERFACE:CHANNEL"

AnyNode = TypeVar("AnyNode", bound=Node)
Receive = Callable[[Frame], None]


class EmbeddedBus:
    """An in-process bus in one thread. Frames wait in one queue and are delivered in the order they were sent.

    There is no arbitration and no bit time. The nodes alone decide the order, so a lockstep run repeats exactly.
    """

    def __init__(self) -> None:
        self._receivers: list[Receive] = []
        self._others: list[list[Receive]] = []  # for each node, everybody else
        self._queue: deque[tuple[list[Receive], int, bytes]] = deque()

    @property
    def is_empty(self) -> bool:
        """Whether no frame waits."""
        return not self._queue

    def attach(self, receive: Receive) -> Send:
        """Connect a node: `receive` gets every frame of the other nodes; the returned function sends."""
        others = list(self._receivers)
        for each in self._others:
            each.append(receive)
        self._receivers.append(receive)
        self._others.append(others)
        enqueue = self._queue.append

        def send(cob_id: int, data: bytes) -> None:
            enqueue((others, cob_id, data))

        return send

    def add(self, make: Callable[[Send], AnyNode]) -> AnyNode:
        """Create a node with its `send` and attach it: `add(lambda send: Device(2, EDS[2], send))`."""
        nodes: list[AnyNode] = []
        send = self.attach(lambda frame: nodes[0].receive(frame))
        nodes.append(make(send))
        return nodes[0]

    def deliver(self, t_ns: int) -> int:
        """Deliver the queued frames, with time `t_ns`, to all nodes but their senders until no node sends any more.

        Returns the number of frames.
        """
        queue, count = self._queue, 0
        while queue:
            others, cob_id, data = queue.popleft()
            frame = Frame(t_ns, cob_id & ~BIT_RATE_SWITCH, data)
            for receive in others:
                receive(frame)
            count += 1
        return count


def choose_bus(spec: str = "auto") -> tuple[str, str]:
    """Choose the bus for --bus and EHA_RIG_BUS; return it and the reason in one sentence.

    `auto` is the bus that EHA_RIG_BUS names, else the embedded one: nothing sends on hardware unasked. Raises
    InputError for an unknown spec, RigError for a CAN interface that does not exist, also when the variable
    names it: a run on hardware must not fall back to the simulation and pass.
    """
    configured = os.environ.get(BUS_VARIABLE, "")
    if spec == "auto" and configured in ("", "auto"):
        live = list_can_interfaces()
        unasked = f"; {', '.join(live)} up, but not taken unasked" if live else ""
        return "embedded", f"embedded bus (neither --bus nor {BUS_VARIABLE} is set){unasked}"
    where, taken = (BUS_VARIABLE, configured) if spec == "auto" else ("--bus", spec)
    kind, channel = parse_spec(taken, where)
    if kind == "socketcan":
        require_interface(channel)
    return taken, f"{taken}, as {BUS_VARIABLE} says" if where == BUS_VARIABLE else f"{taken}, as asked"


def open_can(spec: str, bitrate: int = BITRATE, fd: bool = False) -> can.BusABC:
    """Open a python-can bus: `virtual[:NAME]`, `udp_multicast[:GROUP]` (this machine only), `socketcan:INTERFACE`, or
    any other interface python-can knows, at `bitrate` bit/s. A kernel's interface keeps the rates that it was set to.

    `fd`: also for CAN FD frames. The bit timing that some adapters need for it is read from python-can's own
    configuration file.

    Raises InputError for a bad spec, RigError if the bus cannot be opened.
    """
    kind, channel = parse_spec(spec, "--bus")
    if kind == "embedded":
        raise InputError("--bus", spec, "a bus between programs, such as udp_multicast or socketcan:vcan0")
    if kind == "socketcan":
        require_interface(channel, fd)
    try:
        if kind == "virtual":
            return can.Bus(interface="virtual", channel=channel)
        if kind == "udp_multicast":
            return UdpBus(channel)
        options: dict[str, Any] = {"fd": True} if fd else {}  # not every interface knows the option
        return can.Bus(interface=kind, channel=channel, bitrate=bitrate, **options)
    except (can.CanError, OSError, ImportError, ValueError) as error:
        raise RigError(f"{spec}: {error}".replace("\n", " ")) from error


def can_open(spec: str) -> bool:
    """Whether compiled loops can use this bus (raw_bus.py); the others are for python-can, in soft real time."""
    is_known = spec.partition(":")[0] in ("socketcan", "udp_multicast")
    return is_known and sys.byteorder == "little" and sys.platform == "linux"


def list_can_interfaces() -> list[str]:
    """The kernel's CAN interfaces that are up, real and virtual."""
    found = _NETWORK.glob("*/type") if _NETWORK.exists() else []
    names = sorted(path.parent.name for path in found if path.read_text().strip() == _ARPHRD_CAN)
    return [name for name in names if not explain_socketcan_problem(name)]


def has_socketcan() -> bool:
    """Whether the kernel has SocketCAN."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        return False
    return True


def explain_socketcan_problem(interface: str, fd: bool = False) -> str:
    """Why a kernel CAN interface cannot be used and how to get it, in one line; empty if it can. `fd`: for CAN FD."""
    virtual = interface.startswith("vcan")
    up = f"sudo ip link set {interface} up" + ("" if virtual else f" type can bitrate {BITRATE}")
    if not has_socketcan():
        return "this kernel has no SocketCAN; tests/vcan/guest.sh COMMAND runs a command on a guest kernel with vcan0"
    folder = _NETWORK / interface
    if not folder.exists():
        make = f"sudo modprobe vcan && sudo ip link add {interface} type vcan && " if virtual else ""
        return f"there is no interface {interface} here; {make}{up}"
    if (folder / "type").read_text().strip() != _ARPHRD_CAN:
        return f"{interface} is not a CAN interface"
    if not int((folder / "flags").read_text(), 16) & 1:  # IFF_UP
        return f"{interface} is down; {up}"
    if fd and int((folder / "mtu").read_text()) < _FD_MTU:
        fast = f"sudo ip link set {interface} mtu {_FD_MTU} up" if virtual else f"{up} dbitrate {_DATA_BITRATE} fd on"
        return f"{interface} is set to classical CAN, not to CAN FD; sudo ip link set {interface} down && {fast}"
    return ""


def require_interface(interface: str, fd: bool = False) -> None:
    """Raise RigError unless this kernel CAN interface can be used; `fd`: for CAN FD."""
    problem = explain_socketcan_problem(interface, fd)
    if problem:
        raise RigError(f"socketcan:{interface}: {problem}")


def parse_spec(spec: str, where: str) -> tuple[str, str]:
    """Kind and channel of a bus spec, defaults filled in. Raises InputError, which names `where` the spec stood."""
    kind, _, channel = spec.partition(":")
    if kind == "embedded" and not channel:
        return kind, ""
    if kind == "virtual":
        return kind, channel or "eha-rig"
    if kind == "udp_multicast":
        if not is_group(channel or GROUP):
            raise InputError(where, spec, "an IPv4 multicast group, such as udp_multicast:239.0.0.1")
        return kind, channel or GROUP
    if kind in can.VALID_INTERFACES and channel:
        return kind, channel
    raise InputError(where, spec, _SPECS)
