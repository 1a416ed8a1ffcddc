"""The reference firmware: a position loop in a CANopen device. With it the bench needs no external controller.

It answers each feedback frame with a drive frame. The control word (CiA 408) lets current flow only in device mode
ACTIVE without a fault; any fault is latched until it has gone and the control word's reset bit rises."""

import struct
from math import isfinite, nan
from typing import cast

from plant import Demand, Loop, Model, compute_current, interpret_function, report_law_errors
from rig.benches import CIA408, Bench, Role, SignalObject, State, load_bench, pack, unpack
from rig.device import Abort, Device, EmcyCode, ErrorRegister, NmtState, SdoAbort
from rig.network import CONTROLLER, GAINS, Frame, Gains, Send

_RESET, _ACTIVE = CIA408.reset, CIA408.ladder[State.ACTIVE]
_LOOP_CLOSED, _READY = CIA408.powered, 0x8  # bits of the status word; the second: no fault
_CURRENT_LIMIT, _PERIOD = 4, 5  # sub-indices of GAINS
LOST_AFTER = 3  # SYNCs in a row without feedback, or without a command
_COMMAND, _FEEDBACK = 1, 2  # RPDO numbers, first information byte of EMCY 0x8250


class Firmware:
    """The controller node. Its interface is `receive` and `tick`; `gains` are used until the rig writes others.

    `model`: whose effects in the firmware this one has (port `command`); none by default.
    """

    def __init__(self, send: Send, gains: Gains | None = None, model: Model | None = None) -> None:
        self._taken = Demand(model or Model())
        node = load_bench().nodes[CONTROLLER]
        self.device = Device(node.node, node.eds, send)
        self.device.on_sync = self._on_sync
        self.device.on_rpdo = self._on_rpdo
        self.device.on_nmt = self._on_nmt
        self.device.on_heartbeat_lost = self._trip
        self.device.on_sync_lost = self._on_sync_lost
        self.device.on_write = self._on_write
        self._od = self.device.od.values
        self._demand, self._position = node.inputs["position_demand"], node.inputs["ram_position"]
        self._current = node.outputs["current"]
        self._control, self._status_word = node.inputs["control_word"].key, node.outputs["status_word"].key
        self._cycle, self._answered = node.inputs["cycle"].key, node.outputs["cycle"].key
        self._od.update({(GAINS, sub): value for sub, value in enumerate(gains or (), 1)})
        self._lost: set[int] = set()  # RPDOs whose loss was announced by EMCY; a restart does not take that back
        self._restart()
        self.receive, self.tick = self.device.receive, self.device.tick

    def is_quiet(self, control: int) -> bool:
        """Whether the loop is closed under this control word, and nothing else is under way: no fault, no effect."""
        is_heard = self.device.pdo.rpdos[_COMMAND].fresh and not any(self._missed.values())
        return (is_heard and self._od[self._control] == control and not self._fault and not self._taken.is_changed
                and bool(cast(int, self._od[self._status_word]) & _LOOP_CLOSED)
                and self.device.state is NmtState.OPERATIONAL)

    def _restart(self) -> None:
        self.loop = Loop()
        self._taken.restart()
        self.gains = Gains(*(cast(float, self._od[GAINS, sub]) for sub in range(1, len(Gains._fields) + 1)))
        self._missed = {_COMMAND: 0, _FEEDBACK: 0}  # SYNCs since the last frame
        self._fault = False
        self._acknowledged = True

    def _on_nmt(self, old: NmtState, new: NmtState) -> None:
        if new is NmtState.OPERATIONAL:
            self._restart()
        elif new is NmtState.INITIALISING:
            self._lost.clear()

    def _on_write(self, index: int, sub: int, data: bytes) -> None:
        """Reject NaN and infinite gains (they would produce a NaN current), a negative limit and a period of 0."""
        if index == GAINS:
            value = struct.unpack("<d", data)[0]
            is_possible = {_CURRENT_LIMIT: value >= 0.0, _PERIOD: value > 0.0}.get(sub, True)
            if not (isfinite(value) and is_possible):
                raise SdoAbort(Abort.VALUE)

    def _trip(self, node: int = 0) -> None:
        self._fault = True

    def _on_sync(self) -> None:
        """The command of this cycle is latched and feedback follows.

        After LOST_AFTER cycles without feedback, or without a command, trip: the current is zero from the next on.
        """
        if self.device.pdo.rpdos[_COMMAND].fresh:
            self._hear(_COMMAND)
        else:
            self._miss(_COMMAND)
        if self._miss(_FEEDBACK):
            self._drive(0.0, self._status())

    def _miss(self, rpdo: int) -> bool:
        """A SYNC came without this frame before it; whether it was one too many."""
        self._missed[rpdo] += 1
        is_lost = self._missed[rpdo] > LOST_AFTER
        if is_lost:
            self._lost.add(rpdo)
            self._trip()
            self.device.emcy.raise_error(EmcyCode.RPDO_TIMEOUT, ErrorRegister.COMMUNICATION, bytes((rpdo,)))
        return is_lost

    def _hear(self, rpdo: int) -> None:
        self._missed[rpdo] = 0
        if rpdo in self._lost:
            self._lost.discard(rpdo)
            self.device.emcy.clear(EmcyCode.RPDO_TIMEOUT, bytes((rpdo,)))

    def _on_sync_lost(self) -> None:
        """No SYNC, so no feedback will ask for an answer: say at once that there is no current any more."""
        self._trip()
        self._drive(0.0, self._status())

    def _on_rpdo(self, n: int) -> None:
        """Feedback arrived: close the loop."""
        self._hear(_FEEDBACK)
        status = self._status()
        if status & _LOOP_CLOSED:
            demand, position = self._read(self._demand), self._read(self._position)
            current, self.loop = compute_current(self.loop, self._taken(demand, position), position, self.gains)
        else:
            current, self.loop = 0.0, Loop()
            self._taken.restart()
        self._drive(current, status)

    def _read(self, place: SignalObject) -> float:
        return place.field.compute_value(cast(float, self._od[place.key]))

    def _status(self) -> int:
        """Status word: the level bits of the control word, unless a fault is latched."""
        control = cast(int, self._od[self._control])
        is_reset = bool(control & _RESET)
        if self._fault and is_reset and not self._acknowledged and not self.device.emcy.active:
            self._fault = False
        self._acknowledged = is_reset
        if self._fault:
            return 0
        levels = control & _ACTIVE  # the levels build on each other: 1, 3, 7
        return (levels if levels & (levels + 1) == 0 else 0) | _READY

    def _drive(self, current: float, status: int) -> None:
        od = self._od
        od[self._current.key] = self._current.field.compute_counts(current)
        od[self._status_word] = status
        od[self._answered] = od[self._cycle]
        self.device.transmit(1)


class StandIn:
    """It answers the last frame of each cycle of the rig with the drive of the plant's law."""

    def __init__(self, send: Send, bench: Bench, model: Model) -> None:
        self._send, self._model, self._record = send, model, model.build_record()[0]
        parts = model.kind.bind_functions(model.effects)
        self._law = interpret_function(parts["control_plant"], parts)
        self._memory = model.kind.build_control_memory()
        self._heard = {spec.identifier: spec for spec in bench.frames.list_from(Role.RIG)}
        self._last = tuple(self._heard)[-1]
        self._answer, = bench.frames.list_from(Role.CONTROLLER)
        self._command, self._drive = bench.signals.command.word, bench.signals.drive.word
        self._outputs = [s.word for s in bench.signals.outputs]
        self._values = dict.fromkeys((self._command, *self._outputs), nan)

    def receive(self, frame: Frame) -> None:
        """See `rig.network.frame.Node`."""
        if frame.cob_id not in self._heard:
            return
        self._values |= unpack(self._heard[frame.cob_id], frame.data)
        if frame.cob_id == self._last:
            readings = tuple(self._values[word] for word in self._outputs)
            with report_law_errors(self._model):
                drive, self._memory = self._law(self._memory, self._values[self._command], readings, self._record)
            self._send(self._answer.identifier, pack(self._answer, {self._drive: drive}))

    def tick(self, t_ns: int) -> None:
        """See `rig.network.frame.Node`; it has no clock of its own."""
