"""The rig on the bus: NMT master, SYNC producer, SDO client; services by the `canopen` library, cyclic frames by hand.

On plain CAN a bench has no nodes: only cyclic frames pass, and all that is about nodes does nothing. The library gets
its frames through `Network.notify` and blocks nowhere: its SDO client waits by letting the wire bring frames in, so one
thread does all and the embedded bus needs no other.
"""
from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import canopen
from canopen.emcy import EmcyError
from canopen.sdo.base import SdoVariable
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from plant import InputError, RigError
from rig.benches import (
    INVALID,
    MAPPING,
    Bench,
    Role,
    find_variable,
    list_pdos,
    name_object,
    read_dictionary,
    read_number,
)
from rig.network.bus import Wire
from rig.network.frame import Frame
from rig.network.heartbeat import HeartbeatConsumer, HeartbeatProducer
from rig.network.node_objects import (
    CYCLE_RECORD,
    SCENARIO,
    CycleRecord,
    Identity,
    NmtCommand,
    NmtState,
    decode_cycle_record,
    read_identity,
)
from rig.network.sdo_client import CheckedSdoClient, ConfirmationError, repeat_transfer

HEARTBEAT, HEARTBEAT_LIMIT = 100, 300  # ms
PATIENT = 10_000  # ms: the limit where the wall clock says nothing about the run, in lockstep between processes
BOOT_TIMEOUT = 2.0  # s
NMT, SDO_ANSWER, HEARTBEAT_ID = 0x000, 0x580, 0x700  # predefined connection set (CiA 301, 7.3.5)
# objects; the modes are those of CiA 402
DEVICE_TYPE, MODE, MODE_DISPLAY, SUPPORTED_MODES = 0x1000, 0x6060, 0x6061, 0x6502


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


class _Network(canopen.Network):
    """The library's network on our wire."""

    def __init__(self, wire: Wire, send: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self.wire, self._send = wire, send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(can_id, bytes(data))


class Hooks:
    """Who is told: `on_frame` of every frame, sent or received, the others of what the master detects."""

    def __init__(self) -> None:
        self.on_frame: Callable[[Frame], None] = lambda frame: None
        self.on_emcy: Callable[[Role, EmcyError], None] = lambda node, error: None
        self.on_state: Callable[[Role, int], None] = lambda node, state: None
        self.on_lost: Callable[[Role], None] = lambda node: None
        self.on_back: Callable[[Role], None] = lambda node: None
        self.on_heartbeat: Callable[[Role, int], None] = lambda node, t_ns: None  # with the time of the wire's clock
        self.on_rival: Callable[[int], None] = lambda cob_id: None
        self.on_cyclic: dict[int, Callable[[Frame], None]] = {}  # identifier to what reads that frame


class Master:
    """The rig on the bus of a bench; `hooks` are told what it sees. Nodes are named by their roles.

    `stamped`: frames carry their time of reception, and it is kept; otherwise they get the time of `now()`.
    """

    def __init__(self, wire: Wire, now: Callable[[], int], stamped: bool, bench: Bench) -> None:
        self.wire, self._now, self._stamped, self._bench = wire, now, stamped, bench
        self.hooks = Hooks()
        self.silent = False  # a fault: no heartbeat of ours
        self.is_deaf = False  # a fault: the rig receives nothing
        self.played_until = 0  # ns: a loop in lockstep counts the time, and the next one begins after it
        self.states = dict.fromkeys(sorted(bench.nodes), -1)
        self.heard_ns: dict[Role, int] = {}  # when the last heartbeat of a node came, by the wire's clock
        self._booted: set[Role] = set()
        self._started_ns: dict[Role, int] = {}  # when a node was told to become OPERATIONAL
        self._operational: dict[Role, StartTime] = {}
        self._settings: dict[tuple[Role, int, int], Any] = {}  # what the run has written: node, index, sub
        self._before: dict[tuple[Role, int, int], bytes] = {}  # objects that the run changes: node, index, sub
        self._rivals: set[int] = set()  # our own identifiers that another node sends
        self.network = _Network(wire, self.send)
        self._nodes = {role: self._join(role) for role in sorted(bench.nodes, reverse=True)}
        self._roles = {node.node: role for role, node in bench.nodes.items()}
        self._beat = HeartbeatProducer(bench.rig_node, self._send_heartbeat)
        self._beat_ns = self._last_pause_ns = 0  # when the rig's own heartbeat was sent; the time between the last two
        self._limit_ns = 0  # after which the nodes miss it
        self._watch = HeartbeatConsumer(lambda node: self.hooks.on_lost(self._roles[node]),
                                        lambda node: self.hooks.on_back(self._roles[node]))
        self._state = NmtState.PRE_OPERATIONAL
        identifiers = {spec.identifier for spec in bench.frames.list_from(Role.RIG)} | {bench.frames.sync}
        # only the rig sends them
        self._ours = identifiers | ({NMT, HEARTBEAT_ID + bench.rig_node} if bench.nodes else set())
        # What the library may see, and the only length at which that is what it seems: it unpacks without looking.
        self._services = {identifier: length for node in bench.nodes.values() for identifier, length in (
            (node.emcy_id, 8), (SDO_ANSWER + node.node, 8), (HEARTBEAT_ID + node.node, 1))}
        wire.receive = self.receive

    def close(self) -> None:
        """Report to nobody any more. Whoever the master reported to is then free, together with what it holds."""
        self._now, self.hooks = self.wire.clock.now, Hooks()

    @property
    def watched(self) -> list[Role]:
        """The nodes that send a heartbeat, or can be told to."""
        return [role for role in sorted(self._nodes) if self.find_heartbeat(role)]

    def _join(self, role: Role) -> Any:  # the library's node; its types are too loose to help
        name, text = self._bench.read_data_sheet(role)
        number, emcy_id = self._bench.nodes[role].node, self._bench.nodes[role].emcy_id
        remote = _Node(number, read_dictionary(name, text, number))
        self.network.add_node(remote)
        self.network.unsubscribe(0x80 + number, remote.emcy.on_emcy)  # the library does not read 0x1014
        if emcy_id is not None:
            self.network.subscribe(emcy_id, remote.emcy.on_emcy)
        remote.emcy.add_callback(lambda error: self.hooks.on_emcy(role, error))
        remote.nmt.add_heartbeat_callback(lambda state: self._take_heartbeat(role, state))
        return remote

    def _take_heartbeat(self, role: Role, state: int) -> None:
        if state == NmtState.INITIALISING:
            self._booted.add(role)
            self._nodes[role].emcy.reset()  # its errors ended with the reset, and no EMCY says so
        if state == NmtState.OPERATIONAL:
            seconds = (self.wire.clock.now() - self._started_ns.get(role, 0)) * 1e-9
            self._operational.setdefault(role, StartTime(seconds, min(seconds, self.wire.blind_ns * 1e-9)))
        self._note_state(role, state)

    def _note_state(self, role: Role, state: int) -> None:
        if self.states[role] != state:
            self.states[role] = state
            self.hooks.on_state(role, state)

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
        return 1e-9 * max(self._last_pause_ns, self.wire.clock.now() - self._beat_ns if self._beat_ns else 0)

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
        if (cyclic := self.hooks.on_cyclic.get(frame.cob_id)) is not None:
            cyclic(frame)
            return
        if frame.cob_id in self._ours and frame.cob_id not in self._rivals:
            self._rivals.add(frame.cob_id)
            self.hooks.on_rival(frame.cob_id)
        if self._services.get(frame.cob_id) != len(frame.data):
            return
        if frame.cob_id in self._watch.cob_ids:
            role = self._roles[frame.cob_id - HEARTBEAT_ID]
            self.heard_ns[role] = now = self.wire.clock.now()
            self._watch.receive(Frame(now, frame.cob_id, frame.data))
            if frame.data[0] == NmtState.OPERATIONAL:  # only then it has the period that the rig has set
                self.hooks.on_heartbeat(role, frame.t_ns if self._stamped else now)
        self.network.notify(frame.cob_id, bytearray(frame.data), frame.t_ns * 1e-9)

    def tick(self) -> None:
        """Send the heartbeat when it is due, and detect nodes whose heartbeat stopped."""
        now = self.wire.clock.now()
        self._beat.tick(now, self._state)
        self._watch.tick(now)

    def count_emergencies(self, role: Role) -> int:
        """How many EMCYs of a node have come."""
        return len(self._nodes[role].emcy.log)

    def find_due(self) -> int:
        """When `tick` has something to do, ns."""
        return min(self._beat.due, self._watch.find_due())

    def boot(self) -> None:
        """Send the boot-up message of the rig (CiA 301, 7.2.8.3.3)."""
        if self._nodes:
            self._beat.send_boot_up()

    def reset(self) -> None:
        """Reset communication of the nodes of the bench and wait for their boot-up.

        Raises:
            BusError: a node did not boot.
        """
        self._reset(self._nodes, BOOT_TIMEOUT)
        if silent := [self._bench.describe_node(role) for role in sorted(self._nodes) if role not in self._booted]:
            raise BusError(f"no boot-up from {' and '.join(silent)} within {BOOT_TIMEOUT:g} s of an NMT reset")

    def _reset(self, roles: Collection[Role], seconds: float) -> bool:
        """Reset communication of these nodes; whether all have booted within `seconds`."""
        self.wire.run_until(self.wire.clock.now())  # a full buffer would have no room for the answers to come
        self._booted.difference_update(roles)
        for role in roles:
            self._command_node(role, NmtCommand.RESET_COMMUNICATION)
        return self.wire.wait(lambda: self._booted.issuperset(roles), seconds)

    def is_present(self, role: Role, seconds: float) -> bool:
        """Whether a node answers an NMT reset of its communication."""
        return self._reset([role], seconds)

    def hears_rival(self, seconds: float) -> bool:
        """Whether another rig is active on the bus; only listens, at most `seconds`."""
        return self.wire.wait(lambda: bool(self._rivals), seconds)

    def read_identity(self, role: Role) -> Identity:
        """What a node says about itself; objects that it does not have are None."""
        return read_identity(lambda index, sub: self._upload(role, index, sub))

    def read_plant_record(self) -> CycleRecord | None:
        """The plant's own record of its cycles (object 0x2212); None if it has none."""
        data = self._upload(Role.PLANT, CYCLE_RECORD, 0) if Role.PLANT in self._nodes else None
        try:
            return decode_cycle_record(data) if data else None
        except InputError:  # of a foreign plant
            return None

    def require_identity(self, role: Role) -> None:
        """Refuse a device other than that of the data sheet: device type, vendor and product.

        Raises:
            InputError: the object in which it differs.
        """
        self._require_objects(role, list_identity(self._nodes[role].object_dictionary))

    def require_pdos(self, role: Role) -> None:
        """Refuse a device whose PDOs are not those of the data sheet. Raises InputError."""
        self._require_objects(role, list_pdo_objects(self._nodes[role].object_dictionary, self._bench.nodes[role].node))

    def _require_objects(self, role: Role, objects: Iterable[ExpectedObject]) -> None:
        """Compare objects with the data sheet; those that the device lacks are left out. Raises InputError."""
        if self._upload(role, DEVICE_TYPE, 0) is None:  # every CANopen node has it: this one answers no SDO
            return
        for index, sub, value, mask in objects:
            data = self._upload(role, index, sub)
            device_value = value if data is None else int.from_bytes(data[:8], "little")
            if (device_value ^ value) & mask:
                raise InputError(self._bench.read_data_sheet(role)[0], name_object(index, sub),
                                 f"0x{value:X}, but {self._bench.describe_node(role)} has 0x{device_value:X}")

    def configure(self, scenario: bytes, parameters: Mapping[str, float] | None, sync_period_us: int,
                  limit_ms: int = HEARTBEAT_LIMIT) -> None:
        """Load the scenario into the plant, and write values of DCFs, parameters, heartbeats and cycle period.

        `sync_period_us` goes to 0x1006; 0 switches the supervision of SYNC off: in lockstep SYNC has no fixed period.
        `limit_ms` is the heartbeat timeout. `parameters` of the model are for our own firmware; None: a foreign
        controller, which has its own, and may refuse 0x1006, 0x1016 and 0x1017.

        Raises:
            BusError: a node refused or did not answer.
            InputError: a value of a DCF, or the mode of operation, that a device refuses.
        """
        if Role.PLANT in self._nodes:
            self._download(Role.PLANT, SCENARIO, 0, scenario, seconds=120.0)  # it compiles its model in between
        self._settings.clear()
        for role in sorted(self._nodes):
            self._write_values(role)
        if parameters is not None:
            for index, sub, name in self._bench.nodes[Role.CONTROLLER].settings:
                self._set(Role.CONTROLLER, index, sub, parameters[name])
        quick_heartbeat = 10  # ms: until the nodes are OPERATIONAL, so that the time this takes is measured that finely
        for role in sorted(self._nodes):
            settings = ((0x1006, 0, sync_period_us), (0x1016, 1, self._bench.rig_node << 16 | limit_ms),
                        (0x1017, 0, quick_heartbeat))
            for index, sub, value in (each for each in settings if self._is_writable(role, *each[:2])):
                self._keep(role, index, sub)
                try:
                    self._set(role, index, sub, value)
                except BusError:
                    if role is not Role.CONTROLLER or parameters is not None:
                        raise
        self._set_mode()
        self._watch.configure([self._bench.nodes[role].node << 16 | max(limit_ms, 3 * self.find_heartbeat(role))
                               for role in self.watched])
        self._beat.configure(HEARTBEAT if self._nodes else 0, self.wire.clock.now())
        self._beat_ns, self._last_pause_ns, self._limit_ns = 0, 0, limit_ms * 1_000_000

    def _is_writable(self, role: Role, index: int, sub: int) -> bool:
        variable = find_variable(self._nodes[role].object_dictionary, index, sub)
        return variable is not None and variable.writable

    def find_heartbeat(self, role: Role) -> int:
        """Period of a node's heartbeat, ms: ours if it can be set, else that of the data sheet; 0: it has none."""
        period = read_number(self._nodes[role].object_dictionary, 0x1017, 0) or 0
        return HEARTBEAT if self._is_writable(role, 0x1017, 0) else period

    def _write_values(self, role: Role) -> None:
        """Write the values of a DCF. Raises InputError for one that the device refuses."""
        for index, sub, data in self._bench.nodes[role].values:
            try:
                repeat_transfer(lambda index=index, sub=sub, data=data:  # type: ignore[misc]
                                self._nodes[role].sdo.download(index, sub, data))
            except (SdoAbortedError, SdoCommunicationError) as error:
                raise InputError(self._bench.read_data_sheet(role)[0], name_object(index, sub),
                                 f"a value that {self._bench.describe_node(role)} takes: {error}") from error

    def _set_mode(self) -> None:
        """Set the mode of operation of a CiA 402 drive, unless a PDO carries it, and wait until it is in force.

        Raises:
            BusError: the drive refuses it.
            InputError: it shows another one after a second, and does not say in 0x6502 that it has this one.
        """
        node = self._bench.nodes.get(Role.CONTROLLER)
        if node is None or node.mode is None or any(spec.has("mode") for spec in self._bench.frames.frames):
            return
        self._set(Role.CONTROLLER, MODE, 0, node.mode)
        mode = None
        for _ in range(20):
            data = self._upload(Role.CONTROLLER, MODE_DISPLAY, 0)
            mode = node.mode if data is None else int.from_bytes(data[:1], "little", signed=True)
            if mode == node.mode:
                return
            self.wire.wait(lambda: False, 0.05)
        supported_modes = int.from_bytes(self._upload(Role.CONTROLLER, SUPPORTED_MODES, 0) or b"", "little")
        if node.mode > 0 and supported_modes >> (node.mode - 1) & 1:  # what is shown may follow in OPERATIONAL, at SYNC
            return
        raise InputError(next(iter(self._bench.files), self._bench.name), "controller.mode",
                         f"a mode of {self._bench.describe_node(Role.CONTROLLER)}, not {node.mode}: "
                         f"{name_object(MODE_DISPLAY, 0)} shows {mode}")

    def configure_again(self) -> list[str]:
        """Write what `configure` wrote once more to the nodes that have booted since they were started.

        A reset sets 0x1006, 0x1016 and 0x1017 to their defaults, and a reset of the node the other objects as well.
        Returns the failures in words.
        """
        failures = []
        for role in sorted(self._booted):
            settings = [(index, sub, value) for (owner, index, sub), value in self._settings.items() if owner == role]
            try:
                self._write_values(role)
                for index, sub, value in settings:
                    self._write(role, index, sub, value)
            except (RigError, ConfirmationError) as error:  # it would not answer the others either
                failures.append(f"after its reset {error}")
        return failures

    def restore(self, gone_nodes: Container[int] = ()) -> list[str]:
        """Set 0x1006 and 0x1016 back to what they were before `configure`, except in nodes that are gone.

        Otherwise a node that stays on the bus would go on watching a rig that has left. Returns the failures in words.
        """
        failures = []
        for role, index, sub in (key for key in self._before if key[0] not in gone_nodes):
            try:
                self._nodes[role].sdo.download(index, sub, self._before[role, index, sub])
            except (SdoAbortedError, SdoCommunicationError, ConfirmationError) as error:
                failures.append(f"{self._bench.describe_node(role)}: {name_object(index, sub)} was not set back "
                                f"({error})")
        self._before.clear()
        return failures

    def _keep(self, role: Role, index: int, sub: int) -> None:
        """Remember what an object was, for `restore`; 0x1017 may stay, for a heartbeat does no harm."""
        if index != 0x1017 and (data := self._upload(role, index, sub)) is not None:
            self._before.setdefault((role, index, sub), data)

    def start(self) -> None:
        """Tell the nodes to become OPERATIONAL; the rig is from now on."""
        self._operational.clear()
        self._booted.clear()
        self._command(NmtCommand.START, NmtState.OPERATIONAL)

    def wait_for_operational(self, seconds: float) -> dict[Role, StartTime]:
        """Wait until the heartbeat of each node says OPERATIONAL, at most `seconds`, and slow the heartbeats down.

        Returns the time since `start` by node; a node that did not become OPERATIONAL is missing, and one without a
        heartbeat.
        """
        watched = set(self.watched)

        def are_operational() -> bool:
            self.tick()  # the nodes watch the rig's heartbeat meanwhile
            return self._operational.keys() >= watched

        self.wire.wait(are_operational, seconds)
        for role in self._operational:
            if self._is_writable(role, 0x1017, 0):
                with contextlib.suppress(BusError):  # of a foreign node whose heartbeat time is fixed
                    self._set(role, 0x1017, 0, HEARTBEAT)
        return dict(self._operational)

    def find_silent(self, seconds: float) -> list[Role]:
        """Wait for a heartbeat of each node, at most `seconds`; returns the nodes that sent none."""
        begin = self.wire.clock.now()

        def find_unheard() -> list[Role]:
            self.tick()
            return [role for role in self.watched if self.heard_ns.get(role, -1) < begin]

        self.wire.wait(lambda: not find_unheard(), seconds)
        return find_unheard()

    def stop(self) -> None:
        """Tell the nodes to become PRE-OPERATIONAL; the rig is from now on."""
        self._command(NmtCommand.ENTER_PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL)

    def _command(self, command: NmtCommand, state: NmtState) -> None:
        """Send an NMT command to each node of the bench. Node 0, all nodes, would reach others on the bus as well."""
        self._state = state
        for role in self._nodes:
            self._command_node(role, command)
            self._started_ns[role] = self.wire.clock.now()
            if not self.find_heartbeat(role):  # it will not say so
                self._note_state(role, state)

    def _command_node(self, role: Role, command: NmtCommand) -> None:
        """Send it without the library, which fails after a heartbeat with a state that does not exist."""
        self.send(NMT, bytes((command, self._bench.nodes[role].node)))

    def reset_controller(self, reset: str) -> None:
        """Send the controller an NMT reset, "node" or "communication", and do not wait."""
        self._command_node(Role.CONTROLLER, NmtCommand[f"RESET_{reset.upper()}"])

    def read_parameters(self) -> dict[str, float]:
        """The parameters of the model that objects of the controller hold; those that it does not have are missing."""
        node = self._bench.nodes.get(Role.CONTROLLER)
        parameters = {}
        for index, sub, name in () if node is None else node.settings:
            try:
                parameters[name] = float(self._find_entry(Role.CONTROLLER, index, sub).raw)
            except (SdoAbortedError, SdoCommunicationError):
                break  # of a firmware without them
        return parameters

    def list_errors(self) -> list[Role]:
        """Nodes whose last EMCY has an error register."""
        return [role for role, node in self._nodes.items() if node.emcy.log and node.emcy.log[-1].register]

    def _upload(self, role: Role, index: int, sub: int) -> bytes | None:
        """An object's bytes; None if the node does not have it or does not answer."""
        try:
            return bytes(repeat_transfer(lambda: self._nodes[role].sdo.upload(index, sub)))
        except (SdoAbortedError, SdoCommunicationError):
            return None

    def _set(self, role: Role, index: int, sub: int, value: Any) -> None:
        """Write an object and remember the value for `configure_again`."""
        self._write(role, index, sub, value)
        self._settings[role, index, sub] = value

    def _write(self, role: Role, index: int, sub: int, value: Any) -> None:
        with self._name_failure(role, index, sub):
            variable = self._find_entry(role, index, sub)
            repeat_transfer(lambda: setattr(variable, "raw", value))

    def _find_entry(self, role: Role, index: int, sub: int) -> Any:
        entry = self._nodes[role].sdo[index]
        return entry if isinstance(entry, SdoVariable) else entry[sub]

    def _download(self, role: Role, index: int, sub: int, data: bytes, seconds: float) -> None:
        sdo = self._nodes[role].sdo
        timeout, sdo.RESPONSE_TIMEOUT = sdo.RESPONSE_TIMEOUT, seconds
        try:
            with self._name_failure(role, index, sub):
                repeat_transfer(lambda: sdo.download(index, sub, data))
        finally:
            sdo.RESPONSE_TIMEOUT = timeout

    @contextlib.contextmanager
    def _name_failure(self, role: Role, index: int, sub: int) -> Iterator[None]:
        """Turn a transfer that fails within into a BusError that names node and object."""
        try:
            yield
        except (SdoAbortedError, SdoCommunicationError, KeyError) as error:
            raise BusError(f"{self._bench.describe_node(role)}, object {name_object(index, sub)}: {error}") from error


# what a device must hold: index, sub, value, the bits of it that matter
ExpectedObject = tuple[int, int, int, int]
_ALL_BITS = -1


def list_identity(dictionary: Any) -> Iterator[ExpectedObject]:
    """Device type, vendor-ID and product code of a data sheet; 0 for the last two says nothing."""
    for index, sub in ((DEVICE_TYPE, 0), (0x1018, 1), (0x1018, 2)):
        value = read_number(dictionary, index, sub)
        if value or (value == 0 and not sub):
            yield index, sub, value, _ALL_BITS


def list_pdo_objects(dictionary: Any, node: int) -> Iterator[ExpectedObject]:
    """COB-ID, transmission type, inhibit time, event timer and mapping of the PDOs that a data sheet switches on."""
    not_remote = 0xFFFF_FFFF ^ 1 << 30  # whether a PDO may be requested does not matter
    for pdo in (pdo for pdo in list_pdos(dictionary, node) if not pdo.cob_id & INVALID):
        yield pdo.parameter, 1, pdo.cob_id, not_remote
        for index, subs in ((pdo.parameter, (2, 3, 5)), (pdo.parameter + MAPPING, range(len(pdo.entries) + 1))):
            for sub in subs:
                if (value := read_number(dictionary, index, sub)) is not None:
                    yield index, sub, value, _ALL_BITS
