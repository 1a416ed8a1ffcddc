"""Node 1, the rig: NMT master, SYNC producer, SDO client; services by the `canopen` library, cyclic frames by hand.

The library gets its frames through `Network.notify` and blocks nowhere: its SDO client waits by letting the wire bring
frames in, so one thread does all and the embedded bus needs no other.
"""
from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Container
from functools import cache
from typing import Any, NamedTuple, NoReturn, TypeVar

import canopen
from canopen.emcy import EmcyError
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from dbc import EDS
from plant.errors import InputError, RigError
from rig.network import codec
from rig.network.frame import Frame
from rig.network.heartbeat import HeartbeatConsumer, HeartbeatProducer
from rig.network.link import Wire
from rig.network.node_objects import (
    CONTROLLER,
    CYCLE_RECORD,
    GAINS,
    NAMES,
    PLANT,
    RIG,
    SCENARIO,
    CycleRecord,
    Gains,
    Identity,
    NmtCommand,
    NmtState,
    decode_cycle_record,
    read_identity,
)

HEARTBEAT, HEARTBEAT_LIMIT = 100, 300  # ms
PATIENT = 10_000  # ms: the limit where the wall clock says nothing about the run, in lockstep between processes
BOOT_TIMEOUT = 2.0  # s
_OURS = (0x000, codec.SYNC, codec.COMMAND, 0x700 + RIG)  # frames that only the rig may send
R = TypeVar("R")
_BROKEN_OFF = (0x05030000, 0x05040000, 0x05040001)  # aborts of a server that has lost a transfer, or given it up


class BusError(RigError):
    """A node does not answer, or refuses a request."""


class StartTime(NamedTuple):
    """Time from NMT start to OPERATIONAL, s. The heartbeat that says so may have waited `waited` s for the rig."""

    seconds: float
    waited: float = 0.0


class _Node(canopen.RemoteNode):
    """The library's remote node with an SDO client that lets the wire deliver frames while it waits."""

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> CheckedSdoClient:
        client = CheckedSdoClient(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        return client


@cache
def _read_dictionary(node: int) -> canopen.ObjectDictionary:
    """The library's object dictionary of a node. The library does not change it; to read it takes 20 ms."""
    return canopen.import_od(str(EDS[node]), node)


class _Network(canopen.Network):
    """The library's network on our wire."""

    def __init__(self, wire: Wire, sent: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self.wire, self._sent = wire, sent

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._sent(can_id, bytes(data))


class Hooks:
    """Who is told: `on_frame` of every frame, sent or received, the others of what the master detects."""

    def __init__(self) -> None:
        self.on_frame: Callable[[Frame], None] = lambda frame: None
        self.on_emcy: Callable[[int, EmcyError], None] = lambda node, error: None
        self.on_state: Callable[[int, int], None] = lambda node, state: None
        self.on_lost: Callable[[int], None] = lambda node: None
        self.on_back: Callable[[int], None] = lambda node: None
        self.on_heartbeat: Callable[[int, int], None] = lambda node, t_ns: None  # with the time of the wire's clock
        self.on_rival: Callable[[int], None] = lambda cob_id: None
        self.on_cyclic: dict[int, Callable[[Frame], None]] = {}  # COB-ID to what reads that PDO


class Master:
    """Node 1 on the bus; `hooks` are told what it sees.

    `stamped`: frames carry their time of reception, and it is kept; otherwise they get the time of `now()`.
    """

    def __init__(self, wire: Wire, now: Callable[[], int], stamped: bool = False) -> None:
        self.wire, self._now, self._stamped = wire, now, stamped
        self.hooks = Hooks()
        self.silent = False  # a fault: no heartbeat of ours
        self.is_deaf = False  # a fault: the rig receives nothing
        self.states = {CONTROLLER: -1, PLANT: -1}
        self.heard_ns: dict[int, int] = {}  # node: when its last heartbeat came, by the wire's clock
        self._booted: set[int] = set()
        self._started_ns: dict[int, int] = {}  # node: when it was told to become OPERATIONAL
        self._operational: dict[int, StartTime] = {}
        self._settings: dict[tuple[int, int, int], Any] = {}  # what the run has written: node, index, sub
        self._before: dict[tuple[int, int, int], bytes] = {}  # objects that the run changes: node, index, sub
        self._rivals: set[int] = set()  # our own COB-IDs that another node sends
        self.network = _Network(wire, self.send)
        self._nodes = {node: self._join(node) for node in (PLANT, CONTROLLER)}
        self._beat = HeartbeatProducer(RIG, self._send_heartbeat)
        self._beat_ns = self._last_pause_ns = 0  # when the rig's own heartbeat was sent; the time between the last two
        self._limit_ns = 0  # after which the nodes miss it
        self._watch = HeartbeatConsumer(lambda node: self.hooks.on_lost(node), lambda node: self.hooks.on_back(node))
        self._state = NmtState.PRE_OPERATIONAL
        # What the library may see, and the only length at which that is what it seems: it unpacks without looking.
        self._services = {base + node: length for base, length in ((0x080, 8), (0x580, 8), (0x700, 1))
                          for node in self._nodes}
        wire.receive = self.receive

    def close(self) -> None:
        """Report to nobody any more. Whoever the master reported to is then free, together with what it holds."""
        self._now, self.hooks = self.wire.clock.now, Hooks()

    def _join(self, node: int) -> Any:  # the library's node; its types are too loose to help
        remote = _Node(node, _read_dictionary(node))
        self.network.add_node(remote)
        remote.emcy.add_callback(lambda error: self.hooks.on_emcy(node, error))
        remote.nmt.add_heartbeat_callback(lambda state: self._take_heartbeat(node, state))
        return remote

    def _take_heartbeat(self, node: int, state: int) -> None:
        if state == NmtState.INITIALISING:
            self._booted.add(node)
            self._nodes[node].emcy.reset()  # its errors ended with the reset, and no EMCY says so
        if state == NmtState.OPERATIONAL:
            seconds = (self.wire.clock.now() - self._started_ns.get(node, 0)) * 1e-9
            self._operational.setdefault(node, StartTime(seconds, min(seconds, self.wire.blind_ns * 1e-9)))
        if self.states[node] != state:
            self.states[node] = state
            self.hooks.on_state(node, state)

    def _send_heartbeat(self, cob_id: int, data: bytes) -> None:
        if self.silent:
            self._beat_ns = 0
            return
        now = self.wire.clock.now()
        self._last_pause_ns = now - self._beat_ns if self._beat_ns else 0
        self._beat_ns = now
        self.send(cob_id, data)

    @property
    def pause(self) -> float:
        """The longer of the times between the rig's last two heartbeats and since the last one, s."""
        now = self.wire.clock.now()
        return 1e-9 * max(self._last_pause_ns, now - self._beat_ns if self._beat_ns else 0)

    def is_behind(self) -> bool:
        """Whether the rig's heartbeat paused so long that the nodes may have missed it: then the rig stood still."""
        return 0 < self._limit_ns - HEARTBEAT * 1_000_000 < self.pause * 1e9

    def send(self, cob_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        self.hooks.on_frame(Frame(self._now(), cob_id, data))
        self.wire.send(cob_id, data)

    def receive(self, frame: Frame) -> None:
        """A frame came in."""
        if self.is_deaf:
            return
        if not self._stamped and frame.t_ns != (now := self._now()):
            frame = Frame(now, frame.cob_id, frame.data)
        self.hooks.on_frame(frame)
        cyclic = self.hooks.on_cyclic.get(frame.cob_id)
        if cyclic is not None:
            cyclic(frame)
            return
        if frame.cob_id in _OURS and frame.cob_id not in self._rivals:
            self._rivals.add(frame.cob_id)
            self.hooks.on_rival(frame.cob_id)
        if self._services.get(frame.cob_id) != len(frame.data):
            return
        if frame.cob_id in self._watch.cob_ids:
            self.heard_ns[frame.cob_id - 0x700] = now = self.wire.clock.now()
            self._watch.receive(Frame(now, frame.cob_id, frame.data))
            if frame.data[0] != NmtState.INITIALISING:  # not a boot-up
                self.hooks.on_heartbeat(frame.cob_id - 0x700, frame.t_ns if self._stamped else now)
        self.network.notify(frame.cob_id, bytearray(frame.data), frame.t_ns * 1e-9)

    def tick(self) -> None:
        """Send the heartbeat when it is due, and detect nodes whose heartbeat stopped."""
        now = self.wire.clock.now()
        self._beat.tick(now, self._state)
        self._watch.tick(now)

    def boot(self) -> None:
        """Send the boot-up message of the rig (CiA 301, 7.2.8.3.3)."""
        self._beat.send_boot_up()

    def reset(self) -> None:
        """Reset communication of the nodes of the bench and wait for their boot-up.

        Raises:
            BusError: a node did not boot.
        """
        self._empty_receive_buffer()
        self._booted.clear()
        for node in self._nodes:
            self._command_node(node, NmtCommand.RESET_COMMUNICATION)
        self.wire.wait(lambda: self._booted >= {CONTROLLER, PLANT}, BOOT_TIMEOUT)
        silent = [f"node {node} ({NAMES[node]})" for node in (CONTROLLER, PLANT) if node not in self._booted]
        if silent:
            raise BusError(f"no boot-up from {' and '.join(silent)} within {BOOT_TIMEOUT:g} s of an NMT reset")

    def _empty_receive_buffer(self) -> None:
        """Take in the frames that wait: a full buffer would have no room for the answers to come."""
        self.wire.run_until(self.wire.clock.now())

    def is_present(self, node: int, seconds: float) -> bool:
        """Whether a node answers an NMT reset of its communication."""
        self._empty_receive_buffer()
        self._booted.discard(node)
        self._command_node(node, NmtCommand.RESET_COMMUNICATION)
        return self.wire.wait(lambda: node in self._booted, seconds)

    def hears_rival(self, seconds: float) -> bool:
        """Whether another rig is active on the bus; only listens, at most `seconds`."""
        return self.wire.wait(lambda: bool(self._rivals), seconds)

    def read_identity(self, node: int) -> Identity:
        """What a node says about itself; objects that it does not have are None."""
        return read_identity(lambda index, sub: self._upload(node, index, sub))

    def read_plant_record(self) -> CycleRecord | None:
        """The plant's own record of its cycles (object 0x2212); None if it has none."""
        data = self._upload(PLANT, CYCLE_RECORD, 0)
        try:
            record = decode_cycle_record(data or b"")
        except InputError:  # of a foreign plant
            return None
        return record if len(record.cycle) else None

    def configure(self, scenario: bytes, gains: Gains | None, sync_period_us: int,
                  limit_ms: int = HEARTBEAT_LIMIT) -> None:
        """Load the scenario into the plant and, for our own firmware, its gains; set heartbeats and cycle period.

        `sync_period_us` goes to 0x1006; 0 switches the supervision of SYNC off: in lockstep SYNC has no fixed period.
        `limit_ms` is the heartbeat timeout. A foreign controller (no `gains`) may refuse objects that it does not have.

        Raises:
            BusError: a node refused or did not answer.
        """
        self._download(PLANT, SCENARIO, 0, scenario, seconds=120.0)  # the plant compiles its model in between
        self._settings.clear()
        for sub, value in enumerate(gains or (), 1):
            self._set(CONTROLLER, GAINS, sub, value)
        quick_heartbeat = 10  # ms: until the nodes are OPERATIONAL, so that the time this takes is measured that finely
        for node in (CONTROLLER, PLANT):
            foreign = node == CONTROLLER and gains is None
            settings = ((0x1006, 0, sync_period_us), (0x1016, 1, RIG << 16 | limit_ms), (0x1017, 0, quick_heartbeat))
            for index, sub, value in settings:
                self._keep(node, index, sub)
                try:
                    self._set(node, index, sub, value)
                except BusError:
                    if not foreign:
                        raise
        self._watch.configure([node << 16 | limit_ms for node in (CONTROLLER, PLANT)])
        self._beat.configure(HEARTBEAT, self.wire.clock.now())
        self._beat_ns, self._last_pause_ns, self._limit_ns = 0, 0, limit_ms * 1_000_000

    def configure_again(self) -> list[str]:
        """Write what `configure` wrote once more to the nodes that have booted since they were started.

        A reset sets 0x1006, 0x1016 and 0x1017 to their defaults, and a reset of the node the gains as well. Returns the
        failures in words.
        """
        failures = []
        for node in sorted(self._booted):
            written = [(index, sub, value) for (at, index, sub), value in self._settings.items() if at == node]
            try:
                for index, sub, value in written:
                    self._write(node, index, sub, value)
            except (BusError, ConfirmationError) as error:  # it would not answer the others either
                failures.append(f"after its reset {error}")
        return failures

    def restore(self, gone: Container[int] = ()) -> list[str]:
        """Set 0x1006 and 0x1016 back to what they were before `configure`, except in nodes that are gone.

        Otherwise a node that stays on the bus would go on watching a rig that has left. Returns the failures in words.
        """
        failures = []
        for (node, index, sub), data in self._before.items():
            if node in gone:
                continue
            try:
                self._nodes[node].sdo.download(index, sub, data)
            except (SdoAbortedError, SdoCommunicationError, ConfirmationError) as error:
                failures.append(f"node {node} {NAMES[node]}: 0x{index:04X} sub {sub} was not set back ({error})")
        self._before.clear()
        return failures

    def _keep(self, node: int, index: int, sub: int) -> None:
        """Remember what an object was, for `restore`; 0x1017 may stay, for a heartbeat does no harm."""
        if index != 0x1017 and (data := self._upload(node, index, sub)) is not None:
            self._before.setdefault((node, index, sub), data)

    def start(self) -> None:
        """Tell the nodes to become OPERATIONAL; the rig is from now on."""
        self._operational.clear()
        self._booted.clear()
        self._command(NmtCommand.START, NmtState.OPERATIONAL)

    def wait_for_operational(self, seconds: float) -> dict[int, StartTime]:
        """Wait until the heartbeat of each node says OPERATIONAL, at most `seconds`, and slow the heartbeats down.

        Returns the time since `start` by node; a node that did not become OPERATIONAL is missing.
        """
        def are_operational() -> bool:
            self.tick()  # the nodes watch the rig's heartbeat meanwhile
            return self._operational.keys() >= self._nodes.keys()

        self.wire.wait(are_operational, seconds)
        for node in self._operational:
            with contextlib.suppress(BusError):  # of a foreign node whose heartbeat time is fixed
                self._set(node, 0x1017, 0, HEARTBEAT)
        return dict(self._operational)

    def find_silent(self, seconds: float) -> list[int]:
        """Wait for a heartbeat of each node, at most `seconds`; returns the nodes that sent none."""
        begin = self.wire.clock.now()

        def are_heard() -> bool:
            self.tick()
            return not find_unheard()

        def find_unheard() -> list[int]:
            return [node for node in self._nodes if self.heard_ns.get(node, -1) < begin]

        self.wire.wait(are_heard, seconds)
        return find_unheard()

    def stop(self) -> None:
        """Tell the nodes to become PRE-OPERATIONAL; the rig is from now on."""
        self._command(NmtCommand.ENTER_PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL)

    def _command(self, command: NmtCommand, state: NmtState) -> None:
        """Send an NMT command to each node of the bench. Node 0, all nodes, would reach others on the bus as well."""
        self._state = state
        for node in self._nodes:
            self._command_node(node, command)
            self._started_ns[node] = self.wire.clock.now()

    def _command_node(self, node: int, command: NmtCommand) -> None:
        """Send it without the library, which fails after a heartbeat with a state that does not exist."""
        self.send(0x000, bytes((command, node)))

    def reset_controller(self, reset: str) -> None:
        """Send the controller an NMT reset, "node" or "communication", and do not wait."""
        commands = {"node": NmtCommand.RESET_NODE, "communication": NmtCommand.RESET_COMMUNICATION}
        self._command_node(CONTROLLER, commands[reset])

    def read_gains(self) -> Gains | None:
        """The gains of the controller (object 0x2110); None if it does not have them."""
        sdo = self._nodes[CONTROLLER].sdo
        try:
            return Gains(*(float(sdo[GAINS][sub].raw) for sub in range(1, len(Gains._fields) + 1)))
        except (SdoAbortedError, SdoCommunicationError, KeyError):
            return None

    def list_errors(self) -> list[int]:
        """Nodes whose last EMCY has an error register."""
        return [number for number, node in self._nodes.items() if node.emcy.log and node.emcy.log[-1].register]

    def _upload(self, node: int, index: int, sub: int) -> bytes | None:
        """An object's bytes; None if the node does not have it or does not answer."""
        sdo = self._nodes[node].sdo
        try:
            data: bytes = repeat_transfer(lambda: sdo.upload(index, sub))
        except (SdoAbortedError, SdoCommunicationError):
            return None
        return data

    def _set(self, node: int, index: int, sub: int, value: Any) -> None:
        """Write an object and remember the value for `configure_again`."""
        self._write(node, index, sub, value)
        self._settings[node, index, sub] = value

    def _write(self, node: int, index: int, sub: int, value: Any) -> None:
        try:
            entry = self._nodes[node].sdo[index]
            variable = entry[sub] if sub else entry
            repeat_transfer(lambda: setattr(variable, "raw", value))
        except (SdoAbortedError, SdoCommunicationError, KeyError) as error:
            raise BusError(f"node {node} ({NAMES[node]}), object 0x{index:04X} sub {sub}: {error}") from error

    def _download(self, node: int, index: int, sub: int, data: bytes, seconds: float) -> None:
        sdo = self._nodes[node].sdo
        usual, sdo.RESPONSE_TIMEOUT = sdo.RESPONSE_TIMEOUT, seconds
        try:
            repeat_transfer(lambda: sdo.download(index, sub, data))
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise BusError(f"node {node} ({NAMES[node]}), object 0x{index:04X}: {error}") from error
        finally:
            sdo.RESPONSE_TIMEOUT = usual


def repeat_transfer(transfer: Callable[[], R], attempts: int = 3) -> R:
    """Make an SDO transfer, and repeat it when the server has lost it: one of the two may have stood still meanwhile.

    Raises:
        SdoAbortedError: the server refuses, or has lost the last attempt too.
        SdoCommunicationError: no answer.
    """
    for _ in range(attempts - 1):
        try:
            return transfer()
        except SdoAbortedError as error:
            if error.code not in _BROKEN_OFF:
                raise
    return transfer()


_HEAD = struct.Struct("<BHB")
_SEGMENT_DOWNLOAD, _DOWNLOAD, _UPLOAD, _SEGMENT_UPLOAD = range(4)  # client command specifiers
_CONFIRMATION = {_SEGMENT_DOWNLOAD: 1, _DOWNLOAD: 3, _UPLOAD: 2, _SEGMENT_UPLOAD: 0}  # the server's answer to each
_ABORT = 0x80
_TOGGLE = 0x10
_TIMED_OUT, _TOGGLE_WRONG, _COMMAND_INVALID, _LENGTH_WRONG = 0x05040000, 0x05030000, 0x05040001, 0x06070010


class ConfirmationError(RigError):
    """A node confirms something other than the SDO request. One line: node, what came, what was expected.

    It is neither a refusal nor silence, which a master may take for "not implemented": such a node cannot be used.
    """


class CheckedSdoClient(SdoClient):
    """An SDO client on a wire; while it waits, the wire delivers frames.

    A confirmation with a wrong command specifier, index, sub-index, toggle bit or length ends the transfer: the client
    sends an abort and raises ConfirmationError. No response within RESPONSE_TIMEOUT raises SdoCommunicationError, an
    abort by the server SdoAbortedError.
    """

    RESPONSE_TIMEOUT = 1.0  # s: the node may run on the same, busy machine
    _object = bytes(3)  # index and sub-index of the transfer, as the frames carry them
    largest_upload = 1 << 24  # bytes; a server that never ends an upload must not fill the memory

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request and return its confirmation, 8 bytes. Raises as the class says."""
        while not self.responses.empty():  # left over from a transfer that was given up
            self.responses.get_nowait()
        if sdo_request[0] >> 5 in (_DOWNLOAD, _UPLOAD):
            self._object = bytes(sdo_request[1:4])
        self.send_request(sdo_request)
        network: Any = self.network
        wire: Wire = network.wire
        if not wire.wait(lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT):
            self._send_abort(_TIMED_OUT)
            raise SdoCommunicationError("No SDO response received")
        response: bytes = self.responses.get_nowait()
        code, problem = find_problem(sdo_request, response)
        if problem:
            self._refuse(problem, code)
        if response[0] == _ABORT:
            raise SdoAbortedError(int.from_bytes(response[4:], "little"))
        return response

    def upload(self, index: int, subindex: int) -> bytes:
        """Read an object's bytes. Raises as the class says."""
        response = self.request_response(_HEAD.pack(_UPLOAD << 5, index, subindex) + bytes(4))
        size = int.from_bytes(response[4:], "little")
        if response[0] & 2:  # expedited
            data = response[4:8 - (response[0] >> 2 & 3)] if response[0] & 1 else response[4:]
        else:
            data = self._upload_segments(size if response[0] & 1 else None)
        variable = self.od.get_variable(index, subindex)
        if variable is not None and variable.fixed_size:
            expected = len(variable) // 8
            if response[0] & 3 == 2:  # expedited without a length: the object's own length counts
                data = data[:expected]
            if len(data) != expected:
                self._refuse(f"{len(data)} bytes, expected {expected}")
        return data

    def _upload_segments(self, announced: int | None) -> bytes:
        data = bytearray()
        toggle = last = 0
        while not last:
            response = self.request_response(bytes((_SEGMENT_UPLOAD << 5 | toggle,)) + bytes(7))
            data += response[1:8 - (response[0] >> 1 & 7)]
            toggle ^= _TOGGLE
            last = response[0] & 1
            if len(data) > (self.largest_upload if announced is None else announced):
                most = f"{self.largest_upload} bytes" if announced is None else f"the {announced} bytes announced"
                self._refuse(f"more than {most}", _LENGTH_WRONG)
        if announced is not None and len(data) != announced:
            self._refuse(f"{len(data)} bytes, {announced} were announced")
        return bytes(data)

    def download(self, index: int, subindex: int, data: bytes, force_segment: bool = False) -> None:
        """Write an object's bytes. Raises as the class says."""
        size = len(data)
        if 0 < size <= 4 and not force_segment:
            head = _HEAD.pack(_DOWNLOAD << 5 | (4 - size) << 2 | 3, index, subindex)
            self.request_response(head + data.ljust(4, b"\0"))
            return
        self.request_response(_HEAD.pack(_DOWNLOAD << 5 | 1, index, subindex) + size.to_bytes(4, "little"))
        toggle = 0
        for start in range(0, max(size, 1), 7):
            part = data[start:start + 7]
            command = toggle | (7 - len(part)) << 1 | (start + 7 >= size)
            self.request_response(bytes((command,)) + part.ljust(7, b"\0"))
            toggle ^= _TOGGLE

    def _send_abort(self, code: int) -> None:
        self.send_request(bytes((_ABORT,)) + self._object + code.to_bytes(4, "little"))

    def _refuse(self, problem: str, code: int = 0) -> NoReturn:
        """Give the transfer up, with an abort unless it is over."""
        if code:
            self._send_abort(code)
        index, sub = struct.unpack("<HB", self._object)
        raise ConfirmationError(f"node {self.rx_cobid - 0x600}, SDO of object 0x{index:04X} sub {sub}: {problem}")


def find_problem(request: bytes, response: bytes) -> tuple[int, str]:
    """Why a response does not confirm a request: the abort code to send and one line; (0, "") if it does.

    >>> find_problem(bytes.fromhex("4000100000000000"), bytes.fromhex("4300100092010000"))
    (0, '')
    >>> find_problem(bytes.fromhex("4000100000000000"), bytes.fromhex("4301100092010000"))[1]
    'confirmation of object 0x1001 sub 0'
    """
    asked = request[0] >> 5
    is_initiate = asked in (_DOWNLOAD, _UPLOAD)
    expected = _CONFIRMATION[asked]
    if response[0] != _ABORT and response[0] >> 5 != expected:
        return _COMMAND_INVALID, f"command specifier {response[0] >> 5} (0x{response[0]:02X}), expected {expected}"
    if is_initiate and response[1:4] != request[1:4]:
        _, index, sub = _HEAD.unpack_from(response)
        what = "abort" if response[0] == _ABORT else "confirmation"
        return _COMMAND_INVALID, f"{what} of object 0x{index:04X} sub {sub}"
    if response[0] != _ABORT and not is_initiate and (response[0] ^ request[0]) & _TOGGLE:
        return _TOGGLE_WRONG, "wrong toggle bit"
    return 0, ""
