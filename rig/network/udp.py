"""CAN frames between the processes of one machine: UDP multicast that cannot leave it.

The datagrams are those of python-can's `udp_multicast`. Its own bus listens on every interface, sends by the default
route, needs one to exist at all, and hears its own frames; here the group is joined on 127.0.0.1, sent to from there
with a TTL of 0, and a bus does not hear itself, as on a real one. All nodes hear all frames in one order, as on a real
one too: the kernel hands a datagram to one socket after the other, and a node that heard it early could answer before
the others have it. The turn to send (`Turn`) keeps the next frame back until this one is everywhere.

`UdpBus` is the bus as a python-can interface, so that any program with python-can or canopen joins in one line.

    bus = can.Bus(interface="eha_rig_udp", channel="239.74.163.2")
    network.connect(interface="eha_rig_udp", channel="239.74.163.2")        # canopen

pyproject.toml registers it in the group of entry points in which python-can looks for interfaces, "can.interface".
"""
from __future__ import annotations

import contextlib
import ctypes
import fcntl
import glob
import ipaddress
import os
import select
import socket
import struct
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from plant import RigError
from rig.benches import FD

GROUP, PORT = "239.74.163.2", 43113  # python-can's defaults
_LOOPBACK = socket.inet_aton("127.0.0.1")
_IP_MULTICAST_ALL = 49  # linux/in.h; without it a socket hears the groups other programs joined
_SO_ATTACH_FILTER, _SO_RCVBUFFORCE, SO_TIMESTAMPNS, SO_RXQ_OVFL = 26, 33, 35, 40  # asm-generic/socket.h
_RECEIVE_BUFFER = 8 << 20  # bytes asked for
_RECEIVE_TIMEOUT = struct.pack("@qq", 0, 20_000)  # struct timeval, s and us: the longest that `await_frame` waits


def is_group(text: str) -> bool:
    """Whether a text is an IPv4 multicast group."""
    try:
        return ipaddress.IPv4Address(text).is_multicast
    except ValueError:
        return False


def attach_filter(rx: socket.socket, own_port: int, cob_ids: Collection[int], left_out: bool = False) -> None:
    """A socket filter (classic BPF): no datagram from `own_port`, and only these COB-IDs, in python-can's layout.

    `left_out`: all but these COB-IDs. At most 64 COB-IDs are filtered, else all pass; who reads a datagram decodes it.
    Whether a frame is CAN FD makes no difference here. Raises OSError.
    """
    load_half, load_byte, load_word = 0x28, 0x30, 0x20  # at an absolute place, counted from the UDP header
    equal, at_least, always, give = 0x15, 0x35, 0x05, 0x06
    keep_bits, shift_left, copy, add_copy = 0x54, 0x64, 0x07, 0x4C
    accept, drop = 0xFFFFFFFF, 0
    program = [(load_half, 0, 0, 0), (equal, 0, 1, own_port), (give, 0, 0, drop)]
    if len(cob_ids) <= 64:
        list_action, other_action = (drop, accept) if left_out else (accept, drop)
        # The identifier stands here itself, or 0xCC, 0xCD or 0xCE and 1, 2 or 4 bytes; behind it "is_extended_id" and
        # a truth value, whose last bit goes where the COB-ID has it.
        branches = [(give, 0, 0, accept)]
        for first, load, at, flag in ((0xCE, load_word, 1, 20), (0xCD, load_half, 1, 18), (0xCC, load_byte, 1, 17),
                                      (0x80, load_byte, 0, 16)):
            body = [(load_byte, 0, 0, 8 + 35 + flag), (keep_bits, 0, 0, 1), (shift_left, 0, 0, 31), (copy, 0, 0, 0),
                    (load, 0, 0, 8 + 35 + at), (add_copy, 0, 0, 0), (always, 0, 0, len(branches))]
            condition = (equal, 0, len(body), first) if at else (at_least, len(body), 0, first)
            branches = [(load_byte, 0, 0, 8 + 35), condition, *body, *branches]
        program += [*branches, *(step for cob_id in cob_ids for step in (
            (equal, 0, 1, cob_id & ~FD), (give, 0, 0, list_action))), (give, 0, 0, other_action)]
    else:
        program.append((give, 0, 0, accept))
    steps = bytearray(b"".join(struct.pack("=HBBI", *step) for step in program))
    code = (ctypes.c_char * len(steps)).from_buffer(steps)
    rx.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(program), ctypes.addressof(code)))


def open_sockets(group: str, port: int, stack: contextlib.ExitStack) -> tuple[socket.socket, socket.socket, Turn]:
    """A socket that hears the group, on 127.0.0.1 alone, one that sends to it, on this machine only, and the turn.

    Raises OSError.
    """
    tx = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    tx.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _LOOPBACK)
    tx.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
    tx.bind(("127.0.0.1", 0))
    rx = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    set_receive_options(rx)
    rx.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    rx.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    rx.bind((group, port))
    rx.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + _LOOPBACK)
    turn = Turn(group, port)
    stack.callback(turn.close)
    return rx, tx, turn


def set_receive_options(raw: socket.socket) -> None:
    """A large receive buffer (beyond the system's limit where the rights allow), a limit for waiting in the kernel, the
    kernel's time of each frame and the count of its losses. By default the kernel keeps 477 frames.
    """
    try:
        raw.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)
    except OSError:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _RECEIVE_TIMEOUT)
    raw.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)


# A turn takes 20 us, and more than a second where its holder waits for a CPU of a busy machine; one that takes longer
# than this is held by a stopped or foreign program.
TURN_LIMIT_NS = 10_000_000_000
TURN_PAUSE_NS = 20_000  # between two attempts to take it
FLOCK = struct.Struct("@hhqqi4x")  # struct flock, fcntl.h: type, from where, first byte, number of bytes, process


class Turn:
    """The turn of one group and port: a lock on a byte of /dev/null, of which the kernel relieves a program that ends.

    Every user may lock there, and no file is left behind. The byte at `place` belongs to one group and port;
    `descriptor` holds the lock (an open file description lock, fcntl(2)), also for compiled code. The programs in C
    take the same one (rig/firmware/turn.c). Raises OSError where there is no /dev/null.
    """

    def __init__(self, group: str, port: int) -> None:
        self._where = f"udp_multicast {group}:{port}"
        self.place = int(ipaddress.IPv4Address(group)) << 16 | port
        self.descriptor = os.open(os.devnull, os.O_RDWR)

    def take(self) -> None:
        """Wait for the turn. Raises RigError: it did not come within `TURN_LIMIT_NS`."""
        give_up = time.monotonic_ns() + TURN_LIMIT_NS
        while True:
            try:
                self._set_lock(fcntl.F_WRLCK)
                return
            except BlockingIOError:
                if time.monotonic_ns() > give_up:
                    raise self.explain_failure() from None
                time.sleep(TURN_PAUSE_NS * 1e-9)

    def give(self) -> None:
        """Let the next one send."""
        self._set_lock(fcntl.F_UNLCK)

    def _set_lock(self, kind: int) -> None:
        fcntl.fcntl(self.descriptor, fcntl.F_OFD_SETLK, FLOCK.pack(kind, os.SEEK_SET, self.place, 1, 0))

    def find_holders(self) -> set[int]:
        """Processes that hold the turn now, as far as this user may look."""
        holders = set()
        for path in glob.glob("/proc/[0-9]*/fdinfo/*"):  # noqa: PTH207 - Path.glob raises where a process ends
            with contextlib.suppress(OSError):
                info = Path(path)
                if f" {self.place} {self.place}\n" in info.read_text():
                    holders.add(int(info.parts[2]))
        return holders

    def explain_failure(self) -> RigError:
        """The error for a turn that did not come."""
        holders = [f"process {holder}" for holder in sorted(self.find_holders())]
        return RigError(f"{self._where}: the turn to send was held for more than {TURN_LIMIT_NS * 1e-9:g} s by "
                        f"{' and '.join(holders) or 'another program'}; "
                        "stop that program, or take another group")

    def close(self) -> None:
        """Give the file back, and the turn with it."""
        os.close(self.descriptor)


_ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4)  # the kernel's time, and its count of lost datagrams


class UdpBus(can.BusABC):
    """A bus on one IPv4 multicast group of this machine, with the options that python-can expects of an interface.

    `overflows` counts the frames that the kernel dropped.

    Args:
        channel: the multicast group, as in `rig run --bus udp_multicast:GROUP`; default: that of `--bus udp_multicast`.
        port: UDP port.
        can_filters: as in python-can; frames are filtered in this process.
        options: bit rate, fd and others are accepted and mean nothing here: the bus carries classical frames and CAN FD
            frames. receive_own_messages must be off.

    Raises:
        can.CanInitializationError: no multicast group, an option that the bus does not have, or no sockets.
    """

    _can_protocol = can.CanProtocol.CAN_FD

    def __init__(self, channel: str | None = None, port: int = PORT,
                 can_filters: can.typechecking.CanFilters | None = None, **options: Any) -> None:
        group = channel or GROUP
        if options.get("receive_own_messages"):
            raise can.CanInitializationError("eha_rig_udp: receive_own_messages is not possible on this bus")
        if not is_group(group):
            raise can.CanInitializationError(f"eha_rig_udp: channel: {group}: expected an IPv4 multicast group")
        self.channel_info = f"udp_multicast {group}:{port} on the loopback interface"
        self.overflows = 0
        self._is_filtered = False
        self._destination = group, int(port)
        try:
            with contextlib.ExitStack() as stack:
                self._rx, self._tx, self._turn = open_sockets(*self._destination, stack)
                self._opened = stack.pop_all()
        except OSError as error:
            raise can.CanInitializationError(f"{group}: {error.strerror}") from error
        self._own = self._tx.getsockname()
        super().__init__(group, can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while select.select([self._rx], [], [], timeout)[0]:
            with contextlib.suppress(BlockingIOError):  # another thread was quicker
                if (message := self._take_message()) is not None:
                    return message, False
            timeout = 0.0  # what is behind our own frame has come already; recv() waits again if nothing has
        return None, False

    def _take_message(self) -> can.Message | None:
        """The next datagram as a message, None for one of our own; one without a valid frame is an error frame.

        Raises BlockingIOError when none is waiting.
        """
        data, ancillary, _, sender = self._rx.recvmsg(4096, _ANCILLARY, socket.MSG_DONTWAIT)
        for level, kind, value in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, SO_RXQ_OVFL) and not self._is_filtered:
                (self.overflows,) = struct.unpack("=I", value)
        if sender == self._own:
            return None
        try:
            message = unpack_message(data, check=True)
        except Exception:  # msgpack and can.Message raise various exceptions on foreign bytes
            message = can.Message(is_error_frame=True)
        message.timestamp, message.channel = time.time(), self.channel_info  # the datagram has the sender's, if any
        return message

    def leave_out(self, cob_ids: Collection[int]) -> None:
        """Let the kernel drop the frames with these COB-IDs: one that Python decodes costs 30 us.

        `overflows` is not counted any more: to the kernel a frame that was filtered out is one that was lost.
        """
        self._is_filtered = True
        attach_filter(self._rx, self._own[1], cob_ids, left_out=True)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a message on the bus. Raises can.CanOperationError when the bus is gone or its turn does not come."""
        data = pack_message(msg)
        try:
            self._turn.take()
            try:
                self._tx.sendto(data, self._destination)
            finally:
                self._turn.give()
        except RigError as error:
            raise can.CanOperationError(str(error)) from error
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from error

    def fileno(self) -> int:
        """The socket that becomes readable when a message comes."""
        return self._rx.fileno()

    def shutdown(self) -> None:
        """Give the bus back."""
        super().shutdown()
        self._opened.close()
