"""Buses, opened from one line of text, and a node's or the rig's end of one.

The embedded bus needs nothing from the machine. On python-can's a node is served in the caller's own thread, because
python-can's notifier thread is ms late.
"""

import errno
import os
import select
import socket
import struct
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import can
from can.interfaces.socketcan import SocketcanBus

from plant import InputError, RigError, require
from rig.benches import EXTENDED, FD, SWITCHED
from rig.network.frame import (
    IDENTIFIER,
    Clock,
    Frame,
    Node,
    Send,
    WallClock,
    find_cob_id,
    has_valid_length,
    make_message,
)
from rig.network.udp import GROUP, SO_RXQ_OVFL, SO_TIMESTAMPNS, UdpBus, is_group, set_receive_options

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
        self._queue: deque[tuple[Receive, int, bytes]] = deque()  # with the receiver of the node that has sent it

    @property
    def is_empty(self) -> bool:
        """Whether no frame waits."""
        return not self._queue

    def attach(self, receive: Receive) -> Send:
        """Connect a node: `receive` gets every frame of the other nodes; the returned function sends."""
        self._receivers.append(receive)
        enqueue = self._queue.append

        def send(cob_id: int, data: bytes) -> None:
            enqueue((receive, cob_id, data))

        return send

    def add(self, make: Callable[[Send], AnyNode]) -> AnyNode:
        """Create a node with its `send` and attach it: `add(lambda send: Device(2, EDS[2], send))`."""
        nodes: list[AnyNode] = []
        nodes.append(make(self.attach(lambda frame: nodes[0].receive(frame))))
        return nodes[0]

    def deliver(self, t_ns: int) -> None:
        """Deliver the queued frames, with time `t_ns`, to all nodes but their senders until no node sends any more."""
        queue = self._queue
        while queue:
            sender, cob_id, data = queue.popleft()
            frame = Frame(t_ns, cob_id & ~SWITCHED, data)
            for receive in self._receivers:
                if receive is not sender:
                    receive(frame)


def choose_bus(spec: str = "auto") -> tuple[str, str]:
    """Choose the bus for --bus and EHA_RIG_BUS; return it and the reason in one sentence.

    `auto` is the bus that EHA_RIG_BUS names, else the embedded one: nothing sends on hardware unasked. Raises
    InputError for an unknown spec, RigError for a CAN interface that does not exist, also when the variable
    names it: a run on hardware must not fall back to the simulation and pass.
    """
    default_bus = os.environ.get(BUS_VARIABLE, "")
    if spec == "auto" and default_bus in ("", "auto"):
        interfaces = list_can_interfaces()
        hint = f"; {', '.join(interfaces)} up, but not taken unasked" if interfaces else ""
        return "embedded", f"embedded bus (neither --bus nor {BUS_VARIABLE} is set){hint}"
    where, choice = (BUS_VARIABLE, default_bus) if spec == "auto" else ("--bus", spec)
    kind, channel = parse_spec(choice, where)
    if kind == "socketcan":
        require_interface(channel)
    return choice, f"{choice}, as {BUS_VARIABLE} says" if where == BUS_VARIABLE else f"{choice}, as asked"


def open_can(spec: str, bitrate: int = BITRATE, fd: bool = False) -> can.BusABC:
    """Open a python-can bus: `virtual[:NAME]`, `udp_multicast[:GROUP]` (this machine only), `socketcan:INTERFACE`, or
    any other interface python-can knows, at `bitrate` bit/s. A kernel's interface keeps the rates that it was set to.

    `fd`: also for CAN FD frames. The bit timing that some adapters need for it is read from python-can's own
    configuration file.

    Raises InputError for a bad spec, RigError if the bus cannot be opened.
    """
    kind, channel = parse_spec(spec, "--bus")
    require(kind != "embedded", "--bus", spec, "a bus between programs, such as udp_multicast or socketcan:vcan0")
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
    return sorted(path.parent.name for path in _NETWORK.glob("*/type")
                  if not explain_socketcan_problem(path.parent.name))


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
    if problem := explain_socketcan_problem(interface, fd):
        raise RigError(f"socketcan:{interface}: {problem}")


def parse_spec(spec: str, where: str) -> tuple[str, str]:
    """Kind and channel of a bus spec, defaults filled in. Raises InputError, which names `where` the spec stood."""
    kind, _, channel = spec.partition(":")
    if kind == "embedded" and not channel:
        return kind, ""
    if kind == "virtual":
        return kind, channel or "eha-rig"
    if kind == "udp_multicast":
        require(is_group(channel or GROUP), where, spec, "an IPv4 multicast group, such as udp_multicast:239.0.0.1")
        return kind, channel or GROUP
    if kind in can.VALID_INTERFACES and channel:
        return kind, channel
    raise InputError(where, spec, _SPECS)


_CAN_FRAME, _CANFD_FRAME = struct.Struct("=IBxxx8s"), struct.Struct("=IBBxx64s")  # linux/can.h
_SWITCHED = 1  # CANFD_BRS
_TIMESPEC = struct.Struct("@qq")
CONTROLLER_ERROR, RX_OVERFLOW = 0x4, 0x1  # linux/can/error.h: class of the identifier, bit of data[1]
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(4)
_FILTER = struct.Struct("=II")  # struct can_filter: identifier, mask
_INVERTED = 0x20000000
_QUEUE_FULL = (errno.ENOBUFS, errno.EAGAIN)


class Link:
    """Frames of one bus, with the times of `clock` (ns since the run began). The link owns the bus.

    Counted, to be read at any time: `error_frames` of the controller; `overflows`, frames lost on the way in;
    `unsent`, frames the full transmit queue refused. Remote frames are left out. On socketcan CAN FD frames come, and
    can be sent, if the bus was opened with fd=True.
    """

    def __init__(self, bus: can.BusABC, clock: Callable[[], int]) -> None:
        self.error_frames = self.unsent = 0
        self._bus, self._clock = bus, clock
        self._in_controller = self._in_kernel = 0  # where frames overflowed
        self._latest = 0  # ns: a frame came no earlier than the one before, even if somebody has set the clock since
        self._socket: socket.socket | None = None
        self._left_out: frozenset[int] = frozenset()
        self._selection: frozenset[int] | None = None  # the COB-IDs that are received; None: all
        if isinstance(bus, SocketcanBus):
            self._socket = bus.socket
            set_receive_options(self._socket)

    @property
    def overflows(self) -> int:
        return self._in_controller + self._in_kernel + int(getattr(self._bus, "overflows", 0))

    def send(self, cob_id: int, data: bytes) -> None:
        """Put one frame on the bus. Raises RigError when the bus is gone, and for a length that such a frame lacks."""
        if not has_valid_length(cob_id, len(data)):
            raise RigError(f"frame 0x{cob_id & IDENTIFIER:03X}: {len(data)} bytes; a CAN frame has 0 to 8, a CAN FD "
                           "frame also 12, 16, 20, 24, 32, 48 or 64")
        identifier = cob_id & (EXTENDED | IDENTIFIER)
        try:
            if self._socket is None:
                self._bus.send(make_message(cob_id, data))
            elif cob_id & FD:
                flags = _SWITCHED if cob_id & SWITCHED else 0
                self._socket.send(_CANFD_FRAME.pack(identifier, len(data), flags, data), socket.MSG_DONTWAIT)
            else:
                self._socket.send(_CAN_FRAME.pack(identifier, len(data), data), socket.MSG_DONTWAIT)
        except OSError as error:
            if error.errno not in _QUEUE_FULL:
                raise RigError(f"{self._bus.channel_info}: {error.strerror}") from error
            self.unsent += 1
        except can.CanError as error:
            raise RigError(str(error)) from error

    def poll(self, timeout: float = 0.0) -> list[Frame]:
        """All frames waiting; if there are none, wait up to `timeout` seconds for the first.

        On socketcan the kernel's time of reception counts, elsewhere the time of this call. Raises RigError when the
        bus is gone.
        """
        try:
            return [*self._poll_messages(timeout)] if self._socket is None else self._poll_socket(self._socket, timeout)
        except can.CanError as error:
            raise RigError(str(error)) from error
        except OSError as error:
            raise RigError(f"{self._bus.channel_info}: {error.strerror}") from error

    def leave_out(self, cob_ids: Collection[int]) -> None:
        """Frames with these COB-IDs are no longer received (another socket does); an empty collection: all are."""
        self._left_out = frozenset(cob_ids)
        self._set_filters()

    def select_frames(self, cob_ids: Collection[int] | None) -> None:
        """Receive only the frames with these COB-IDs; None: all frames.

        On socketcan the kernel drops the others, so that their number does not matter.
        """
        self._selection = None if cob_ids is None else frozenset(cob_ids)
        self._set_filters()

    def _set_filters(self) -> None:
        if isinstance(self._bus, UdpBus):
            self._bus.leave_out(sorted(self._left_out))
        elif self._socket is not None:
            exact, is_open = IDENTIFIER | EXTENDED | socket.CAN_RTR_FLAG, self._selection is None
            filters = [_FILTER.pack(cob_id & ~FD | _INVERTED * is_open, exact) for cob_id in sorted(
                self._left_out if self._selection is None else self._selection - self._left_out)]
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_JOIN_FILTERS, int(is_open and bool(filters)))
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"".join(filters) or _FILTER.pack(0, 0))

    def close(self) -> None:
        """Give the bus back."""
        self._bus.shutdown()

    def _poll_messages(self, timeout: float) -> Iterator[Frame]:
        message = self._bus.recv(timeout)
        while message is not None:
            cob_id = find_cob_id(message) & ~SWITCHED
            is_remote = message.is_remote_frame
            if message.is_error_frame or (not is_remote and not has_valid_length(cob_id, len(message.data))):
                self.error_frames += 1
            elif (not is_remote and cob_id not in self._left_out
                  and (self._selection is None or cob_id in self._selection)):
                yield Frame(self._clock(), cob_id, bytes(message.data))
            message = self._bus.recv(0)

    def _poll_socket(self, raw: socket.socket, timeout: float) -> list[Frame]:
        frames: list[Frame] = []
        if timeout > 0 and not select.select([raw], [], [], timeout)[0]:
            return frames
        epoch = self._find_epoch()  # the kernel stamps with the wall clock
        while True:
            try:
                data, ancillary, _, _ = raw.recvmsg(_CANFD_FRAME.size, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return frames
            t_ns = self._clock()
            for _, kind, value in ancillary:
                if kind == SO_TIMESTAMPNS:
                    seconds, ns = _TIMESPEC.unpack(value)
                    t_ns = max(self._latest, min(t_ns, seconds * 1_000_000_000 + ns - epoch))
                elif kind == SO_RXQ_OVFL:
                    self._in_kernel = int.from_bytes(value, "little")
            self._latest = t_ns
            identifier, length, payload = int.from_bytes(data[:4], sys.byteorder), data[4], data[8:]
            if identifier & socket.CAN_ERR_FLAG:
                self.error_frames += 1
                self._in_controller += bool(identifier & CONTROLLER_ERROR and payload[1] & RX_OVERFLOW)
            elif not identifier & socket.CAN_RTR_FLAG:
                kind = FD if len(data) == _CANFD_FRAME.size else 0
                frames.append(Frame(t_ns, identifier | kind, payload[:length]))

    def _find_epoch(self) -> int:
        """Wall clock minus the link's clock, ns. A thread that is interrupted between the two reads them again."""
        epoch, shortest = 0, 1 << 62
        for _ in range(3):
            before = self._clock()
            wall = time.time_ns()
            duration = self._clock() - before
            if duration < shortest:
                epoch, shortest = wall - before - duration // 2, duration
            if duration < 50_000:
                break
        return epoch


MS = 1_000_000  # ns
_PATIENCE = 5  # cycles without all answers, after which a wire waits less for them
_STALL = 100 * MS  # twice the longest pause of the cycle in lockstep
Done = Callable[[], bool]


class Wire(ABC):
    """What the master and the loop need of a bus."""

    clock: Clock
    send: Send
    blind_ns = 0  # how long at most the frames that come in now have waited to be taken in
    stalled_ns = 0  # how long in all frames were not taken in, pauses of the cycle left out

    def __init__(self) -> None:
        self.receive: Callable[[Frame], None] = lambda frame: None  # where incoming frames go; set by the master
        self.is_node_gone: Done = lambda: False  # whether a node will not answer any more; set by the session

    @abstractmethod
    def wait(self, done: Done, seconds: float) -> bool:
        """Let frames come in until `done()`; False when it took longer than `seconds`."""

    @abstractmethod
    def wait_for_answers(self, t_ns: int, done: Done) -> None:
        """Lockstep: let the frames of the cycle at `t_ns` come in, until `done()` or nothing more can come."""

    @abstractmethod
    def run_until(self, t_ns: int) -> None:
        """Real time: let frames come in until the clock says `t_ns`."""

    def hear_all(self) -> None:  # noqa: B027 - a bus in memory has no others
        """Let the frames of nodes that are not of the bench in, for the log; during bring-up they stay out."""

    def close(self) -> None:  # noqa: B027 - nothing to give back
        """Give the bus back."""


class EmbeddedWire(Wire):
    """All nodes in this process and thread, on a `bus`. With a virtual clock a run repeats bit for bit."""

    def __init__(self, clock: Clock, makers: Sequence[Callable[[Send], Node]], period_ns: int = MS) -> None:
        super().__init__()
        self.clock, self._period, self.bus = clock, period_ns, EmbeddedBus()
        self.send = self.bus.attach(lambda frame: self.receive(frame))
        self.nodes = [self.bus.add(make) for make in makers]

    def wait(self, done: Done, seconds: float) -> bool:
        """See `Wire`; the time waited is the clock's."""
        end = self.clock.now() + round(seconds * 1e9)
        while True:
            self._deliver(self.clock.now())
            if done():
                return True
            if self.clock.now() >= end:
                return False
            self.clock.sleep_until(self.clock.now() + MS)

    def wait_for_answers(self, t_ns: int, done: Done) -> None:
        """See `Wire`; what is late by less than a cycle comes in too."""
        self.clock.sleep_until(t_ns)
        self._deliver(t_ns)
        self._deliver(t_ns + self._period - 1)

    def run_until(self, t_ns: int) -> None:
        """See `Wire`."""
        self._deliver(self.clock.now())
        while self.clock.now() < t_ns:
            self.clock.sleep_until(min(t_ns, self.clock.now() + MS))
            self._deliver(self.clock.now())

    def _deliver(self, t_ns: int) -> None:
        """Deliver what is there, run the nodes' timers, deliver what came of them."""
        self.bus.deliver(t_ns)
        for node in self.nodes:
            node.tick(t_ns)
        self.bus.deliver(t_ns)


class LinkWire(Wire):
    """A bus between programs or machines. Waiting is in wall time, whatever the pace."""

    def __init__(self, link: Link, clock: WallClock, grace: float = 0.2) -> None:
        """`grace`: how late an answer may be in lockstep, s; a tenth of it after some cycles without all answers.

        A node that is gone must not make clean-up last minutes.
        """
        super().__init__()
        self.clock: WallClock = clock
        self.link, self.grace = link, grace
        self._missed = 0  # cycles in a row without all frames
        self._looked_ns = clock.now()  # when the link was last seen to be empty
        self.send: Send = link.send

    def wait(self, done: Done, seconds: float) -> bool:
        """See `Wire`. What has come when the time is over counts: this program may have stood still meanwhile."""
        end = self.clock.now() + round(seconds * 1e9)
        while not done():
            remaining_ns = end - self.clock.now()
            self.poll(min(max(remaining_ns, 0) * 1e-9, 0.05))
            if remaining_ns <= 0:
                return done()
        return True

    def wait_for_answers(self, t_ns: int, done: Done) -> None:
        """See `Wire`; a frame that does not come within the grace time is missing; after several, it waits less.

        When a node is gone, a cycle takes its 1 ms, in which the other nodes can answer.
        """
        grace = self.grace if self._missed < _PATIENCE else 0.1 * self.grace
        is_answered = not self.is_node_gone() and self.wait(lambda: done() or self.is_node_gone(), grace)
        if self.is_node_gone():
            self.wait(done, 1e-3)
        self._missed = 0 if is_answered else self._missed + 1

    def run_until(self, t_ns: int) -> None:
        """See `Wire`."""
        self.poll(0.0)
        while (remaining_ns := t_ns - self.clock.now()) > 0:
            self.poll(remaining_ns * 1e-9)

    def hear_all(self) -> None:
        """See `Wire`."""
        self.link.select_frames(None)

    def close(self) -> None:
        """See `Wire`."""
        self.link.close()

    def poll(self, timeout: float) -> None:
        """Pass on the frames that are waiting; if there are none, wait up to `timeout` seconds for the first."""
        begin = self.clock.now()
        frames = self.link.poll(timeout)
        end = self.clock.now()
        self.blind_ns = begin - self._looked_ns + max(0, end - begin - round(timeout * 1e9))
        self._looked_ns = end
        if self.blind_ns > _STALL:
            self.stalled_ns += self.blind_ns
        for frame in frames:
            self.receive(frame)


def serve_node(node: Node, link: Link, clock: Clock, stop: Done) -> None:
    """Run one node on a link until `stop()`, which is asked every millisecond: the whole of `rig node`."""
    tick = clock.now() + MS
    while True:
        for frame in link.poll(max(0.0, (tick - clock.now()) * 1e-9)):
            node.receive(frame)
        if (now := clock.now()) >= tick:
            if stop():
                return
            node.tick(now)
            tick = max(tick + MS, now)
