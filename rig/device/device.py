"""An emulated CANopen device: the protocol services around one object dictionary, driven by frames and ticks alone."""

from collections.abc import Callable
from pathlib import Path

from rig.benches import PARAMETERS
from rig.device.dictionary import Dictionary, Value, check_consumer_entry, check_switchable, check_sync
from rig.device.emcy import HISTORY, Emcy, EmcyCode, ErrorRegister
from rig.device.nmt import Nmt
from rig.device.pdo import Pdos
from rig.device.sdo import Abort, SdoAbort, SdoServer, abort_unless
from rig.device.sync import SyncConsumer
from rig.network import Frame, HeartbeatConsumer, HeartbeatProducer, NmtState, Send

Handler = Callable[[Frame], None]
_COMMUNICATING = (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)  # states in which SDO, SYNC and EMCY exist


def _nothing(*_: object) -> None:
    """Default of a hook: do nothing."""


class Device:
    """A CANopen slave. It boots (boot-up frame, PRE-OPERATIONAL) at its first tick.

    What a frame may do depends on the NMT state (CiA 301, table 39), so the state's table of COB-ID -> service is the
    gate: a foreign or forbidden frame costs one look-up. Hooks are attributes; set those you need:

    on_sync()                    OPERATIONAL, after synchronous RPDOs are in `od`, before synchronous TPDOs are packed
    on_rpdo(n)                   an asynchronous RPDO arrived and is in `od`
    on_write(index, sub, data)   SDO download about to be stored; may raise SdoAbort
    on_nmt(old, new)             the state has changed
    on_sync_lost()               SYNC has stopped (0x1006; EMCY 0x8100 is already sent)
    on_heartbeat_lost(node)      the heartbeat of a monitored node stopped (EMCY and 0x1029 are already handled)

    Raises InputError for an EDS that cannot be read or maps what it does not hold.
    """

    def __init__(self, node_id: int, eds_path: Path, send: Send) -> None:
        self.node_id = node_id
        self.t_ns = 0  # of the last frame or tick
        self.on_sync: Callable[[], None] = _nothing
        self.on_rpdo: Callable[[int], None] = _nothing
        self.on_write: Callable[[int, int, bytes], None] = _nothing
        self.on_nmt: Callable[[NmtState, NmtState], None] = _nothing
        self.on_sync_lost: Callable[[], None] = _nothing
        self.on_heartbeat_lost: Callable[[int], None] = _nothing

        self.od = Dictionary(eds_path, node_id)
        self.nmt = Nmt(node_id, self._enter, self._restart)
        self.emcy = Emcy(self.od, send, lambda: self.nmt.state in _COMMUNICATING)
        self.heartbeat = HeartbeatProducer(node_id, send)
        self.consumer = HeartbeatConsumer(
            self._heartbeat_lost, lambda node: self.emcy.clear(EmcyCode.HEARTBEAT_LOST, bytes((node,))))
        self.sync = SyncConsumer(self.emcy, self._cycle, lambda: self.on_sync_lost())
        self.sdo = SdoServer(0x580 + node_id, send, self._upload, self.od.find_size, self._download)
        self.pdo = Pdos(self.od, self.emcy, send, lambda n: self.on_rpdo(n))
        self._handlers: dict[int, Handler] = {}

    @property
    def state(self) -> NmtState:
        return self.nmt.state

    def receive(self, frame: Frame) -> None:
        """A frame of another node arrived."""
        if (handler := self._handlers.get(frame.cob_id)) is not None:
            self.t_ns = frame.t_ns
            handler(frame)

    def tick(self, t_ns: int) -> None:
        """It is now `t_ns`."""
        self.t_ns = t_ns
        if self.nmt.state is NmtState.INITIALISING:
            self._boot()
        self.heartbeat.tick(t_ns, self.nmt.state)
        self.consumer.tick(t_ns)
        self.sync.tick(t_ns)
        self.sdo.tick(t_ns)

    def find_due(self) -> int:
        """When the next timer runs out, ns; `tick` has nothing to do before, as long as SYNC comes."""
        return 0 if self.sdo.is_busy else min(self.heartbeat.due, self.consumer.find_due())

    def transmit(self, n: int) -> None:
        """Send TPDO `n`, because the application has new values; nothing is sent unless OPERATIONAL."""
        if self.nmt.state is NmtState.OPERATIONAL:
            self.pdo.tpdos[n].transmit()

    def _boot(self) -> None:
        for index in (0x1006, 0x1016):
            self._configure(index)
        self.pdo.configure()
        self.heartbeat.send_boot_up()
        self._enter(NmtState.PRE_OPERATIONAL)
        self.heartbeat.configure(self.od.read_number(0x1017, 0), self.t_ns)

    def _restart(self, node: bool) -> None:
        """Reset node (all objects) or reset communication (0x1000..0x1FFF): defaults, then boot-up."""
        self._enter(NmtState.INITIALISING)
        self.od.restore(0x1000, 0xFFFF if node else 0x1FFF)
        self.emcy.reset()
        self.consumer.configure([])
        self._boot()

    def _enter(self, new: NmtState) -> None:
        old = self.nmt.state
        if new is old:
            return
        self.nmt.state = new
        if new is not NmtState.OPERATIONAL:
            self.pdo.forget()
            self.sync.stop()
        if new not in _COMMUNICATING:
            self.sdo.reset()
        self._gate()
        self.on_nmt(old, new)

    def _gate(self) -> None:
        """Fill the table of frames that the present state lets in."""
        state = self.nmt.state
        self._handlers = {} if state is NmtState.INITIALISING else {
            0x000: self.nmt.receive, **dict.fromkeys(self.consumer.cob_ids, self.consumer.receive)}
        if state in _COMMUNICATING:
            self._handlers[0x600 + self.node_id] = self.sdo.receive
        if state is NmtState.OPERATIONAL:
            self._handlers |= {self.od.read_number(0x1005, 0, 0x80) & 0x7FF: self.sync.receive, **{
                pdo.cob_id: pdo.receive for pdo in self.pdo.rpdos.values() if pdo.cob_id is not None}}

    def _cycle(self) -> None:
        for rpdo in self.pdo.latched:
            rpdo.latch()
        self.on_sync()
        if self.nmt.state is NmtState.OPERATIONAL:  # the application may have given up just now
            for tpdo in self.pdo.cyclic:
                tpdo.on_sync()

    def _upload(self, index: int, sub: int) -> bytes:
        if index == HISTORY and sub > self.od.read_number(HISTORY, 0):
            self.od.find(index, sub)
            raise SdoAbort(Abort.NO_DATA)
        return self.od.encode(index, sub)

    def _download(self, index: int, sub: int, data: bytes) -> None:
        value = self.od.decode(index, sub, data)
        self._check(index, sub, value)
        if index == HISTORY:
            abort_unless(value == 0, Abort.VALUE)
            self.emcy.erase_history()
            return
        self.on_write(index, sub, data)
        self.od.values[index, sub] = value
        self._configure(index)

    def _check(self, index: int, sub: int, value: Value) -> None:
        """Refuse a value of a communication object that CiA 301 forbids. Raises SdoAbort."""
        if not isinstance(value, int):
            return
        if index in PARAMETERS:
            self.pdo.check(index, sub, value)
        elif index == 0x1005:
            check_sync(value)
        elif index == 0x1014:
            check_switchable(self.od.read_number(0x1014, 0), value)
        elif index == 0x1016:
            check_consumer_entry(value, [self.od.read_number(0x1016, other) for other in self.od.list_subs(0x1016)
                                         if other != sub])

    def _configure(self, index: int) -> None:
        """Pass a changed communication object to the service that uses it."""
        if index == 0x1005:
            self._gate()
        elif index == 0x1006:
            self.sync.configure(self.od.read_number(0x1006, 0))
        elif index == 0x1016:
            self.consumer.configure([self.od.read_number(0x1016, sub) for sub in self.od.list_subs(0x1016)])
            self._gate()
        elif index == 0x1017:
            self.heartbeat.configure(self.od.read_number(0x1017, 0), self.t_ns)
        elif index in PARAMETERS:
            self.pdo.configure()
            self._gate()

    def _heartbeat_lost(self, node: int) -> None:
        self.emcy.raise_error(EmcyCode.HEARTBEAT_LOST, ErrorRegister.COMMUNICATION, bytes((node,)))
        self.nmt.communication_error(self.od.read_number(0x1029, 1))
        self.on_heartbeat_lost(node)
