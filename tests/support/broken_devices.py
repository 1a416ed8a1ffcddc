"""Nodes with one defect each: what a conformance test must find. A defect is a patch of our own plant or controller."""
from __future__ import annotations

import heapq
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from dbc import EDS
from rig.conformance.conformance_case import Verdict
from rig.conformance.data_sheet import DataSheet
from rig.conformance.run_cases import Outcome, choose_cases, run_cases
from rig.conformance.target import Options, Target
from rig.device import Abort, Device, NmtState, SdoAbort
from rig.device.dictionary import INVALID
from rig.network.clock import VirtualClock
from rig.network.frame import Frame, Send
from rig.network.link import EmbeddedWire
from rig.nodes.emulator import Emulator
from rig.nodes.firmware import Firmware

MS = 1_000_000  # ns
Break = Callable[[Any], None]  # of a Device; typed loosely, for it replaces methods


class Broken:
    """A node whose frames pass through here: dropped, changed or delayed on the way out, changed on the way in.

    `out(cob_id, data)` gives the frames that are sent instead, each with its delay in ns; `into(frame)` likewise.
    """

    def __init__(self, send: Send, node: int, patch: Break, eds: Path | None = None) -> None:
        self._send = send
        self._held: list[tuple[int, int, int, bytes]] = []
        self.t_ns = 0
        self.out: Callable[[int, bytes], list[tuple[int, bytes, int]]] = lambda cob_id, data: [(cob_id, data, 0)]
        self.into: Callable[[Frame], list[Frame]] = lambda frame: [frame]
        if eds is not None:
            self.node: Any = Device(node, eds, self._transmit)
            self.device: Any = self.node
        else:
            self.node = Emulator(self._transmit) if node == 3 else Firmware(self._transmit)
            self.device = self.node.device
        self.device.broken = self
        patch(self.device)

    def receive(self, frame: Frame) -> None:
        self.t_ns = frame.t_ns
        for each in self.into(frame):
            self.node.receive(each)

    def tick(self, t_ns: int) -> None:
        self.t_ns = t_ns
        self.node.tick(t_ns)
        while self._held and self._held[0][0] <= t_ns:
            _, _, cob_id, data = heapq.heappop(self._held)
            self._send(cob_id, data)

    def _transmit(self, cob_id: int, data: bytes) -> None:
        for other, changed, delay in self.out(cob_id, data):
            if delay:
                heapq.heappush(self._held, (self.t_ns + delay, len(self._held), other, changed))
            else:
                self._send(other, changed)


def examine(patch: Break, node: int = 3, chapters: tuple[str, ...] = (), eds: Path | None = None,
            sheet: Path | None = None, options: Options | None = None) -> Outcome:
    """A conformance test of our node with this defect, in simulated time; `eds` is the node's, `sheet` the tester's."""
    wire = EmbeddedWire(VirtualClock(), [lambda send: Broken(send, node, patch, eds)])
    target = Target(wire, DataSheet(sheet or eds or EDS[node], node), options or Options(may_write=True))
    return run_cases(target, choose_cases(chapters))


def failures(outcome: Outcome) -> list[str]:
    """Numbers of the cases that failed."""
    return [result.case.number for result in outcome.results if result.verdict is Verdict.FAIL]


def nothing(device: Any) -> None:
    """No defect."""


def _wrap(device: Any, owner: Any, name: str, around: Callable[..., Any]) -> None:
    """Put a function around a method: it gets the method first."""
    setattr(owner, name, partial(around, getattr(owner, name)))


def skip_checks(*indices: int) -> Break:
    """Values of these objects are not checked."""
    def patch(device: Any) -> None:
        _wrap(device, device, "_check", lambda old, index, sub, value: None if index in indices else
              old(index, sub, value))
    return patch


def accept_restricted(device: Any) -> None:
    """Only a restricted identifier is let through; that of a valid PDO is still fixed."""
    def check(old: Any, index: int, sub: int, value: int) -> None:
        if index in (0x1400, 0x1800, 0x1801) and sub == 1 and device.od.read_number(index, 1) & INVALID:
            return
        old(index, sub, value)
    _wrap(device, device, "_check", check)


def change_while_valid(device: Any) -> None:
    """Any permitted identifier is accepted at any time."""
    def check(old: Any, index: int, sub: int, value: int) -> None:
        word = device.od.read_number(index, sub)
        if sub == 1 and index in (0x1400, 0x1800, 0x1801) and not word & INVALID:
            device.od.values[index, sub] = word | INVALID
            try:
                old(index, sub, value)
            finally:
                device.od.values[index, sub] = word
            return
        old(index, sub, value)
    _wrap(device, device, "_check", check)


def change_abort(old_code: int, new_code: int) -> Break:
    """One abort code in the place of another."""
    def patch(device: Any) -> None:
        _wrap(device, device.sdo, "_abort", lambda old, code: old(new_code if code == old_code else code))
    return patch


def ignore_toggle(device: Any) -> None:
    def segment(old: Any, command: int, data: bytes) -> bytes:
        return bytes(old(command & ~0x10 | device.sdo._toggle, data))
    _wrap(device, device.sdo, "_segment", segment)


def swallow_block(device: Any) -> None:
    """Requests for block transfer stay unanswered."""
    def answer(old: Any, data: bytes) -> bytes:
        return b"" if data[0] >> 5 in (5, 6) else bytes(old(data))
    _wrap(device, device.sdo, "_answer", answer)


def write_anything(device: Any) -> None:
    """Read-only objects take what is written to them."""
    device.od.entries = {key: entry._replace(writable=True) for key, entry in device.od.entries.items()}


def accept_any_length(device: Any) -> None:
    """A wrong length is cut or filled up."""
    def decode(old: Any, index: int, sub: int, data: bytes) -> Any:
        size = device.od.find_size(index, sub)
        return old(index, sub, data[:size].ljust(size, b"\0") if size else data)
    _wrap(device, device.od, "decode", decode)
    device.sdo._size = lambda index, sub: device.od.find_size(index, sub) * 0


def ignore_limits(device: Any) -> None:
    device.od.entries = {key: entry._replace(low=None, high=None) for key, entry in device.od.entries.items()}


def drop(cob_id: int, keep: Callable[[bytes], bool] = lambda data: False) -> Break:
    """Frames of this COB-ID are not sent, unless `keep` wants them."""
    def patch(device: Any) -> None:
        device.broken.out = lambda cob, data: [] if cob == cob_id and not keep(data) else [(cob, data, 0)]
    return patch


def change(cob_id: int, to: Callable[[bytes], bytes]) -> Break:
    """Frames of this COB-ID carry other data."""
    def patch(device: Any) -> None:
        device.broken.out = lambda cob, data: [(cob, to(data) if cob == cob_id else data, 0)]
    return patch


def delay(cob_id: int, ms: int, only: Callable[[bytes], bool] = lambda data: True) -> Break:
    """Frames of this COB-ID are late."""
    def patch(device: Any) -> None:
        device.broken.out = lambda cob, data: [(cob, data, ms * MS if cob == cob_id and only(data) else 0)]
    return patch


def answer_when_stopped(device: Any) -> None:
    """The SDO server goes on in STOPPED."""
    def gate(old: Any) -> None:
        old()
        if device.state is NmtState.STOPPED:
            device._handlers[0x600 + device.node_id] = device.sdo.receive
    _wrap(device, device, "_gate", gate)


def send_pdos_before_start(device: Any) -> None:
    """TPDOs answer SYNC in PRE-OPERATIONAL too."""
    def gate(old: Any) -> None:
        old()
        if device.state is NmtState.PRE_OPERATIONAL:
            device._handlers[0x080] = lambda frame: [tpdo.send() for tpdo in device.pdo.cyclic]
    _wrap(device, device, "_gate", gate)


def slow_heartbeat(device: Any) -> None:
    """A tenth slower than asked for."""
    def configure(old: Any, period_ms: int, t_ns: int) -> None:
        old(period_ms * 12 // 10, t_ns)
    _wrap(device, device.heartbeat, "configure", configure)


def forget_reset_of_emcy(device: Any) -> None:
    """The end of an error is not reported."""
    drop(0x080 + device.node_id, lambda data: data[:2] != b"\0\0")(device)


def repeat_emcy(device: Any) -> None:
    """A standing error is reported at each occurrence."""
    def raise_error(old: Any, code: int, register: int = 1, info: bytes = b"") -> None:
        device.emcy._active.pop((code, info[:1]), None)
        old(code, register, info)
    _wrap(device, device.emcy, "raise_error", raise_error)
    for pdo in device.pdo.rpdos.values():
        pdo._emcy = device.emcy


def keep_history(device: Any) -> None:
    """Writing 0 to 0x1003 is confirmed and does nothing."""
    device.emcy.erase_history = lambda: None


def watch_at_once(device: Any) -> None:
    """Supervision begins with the entry, not with the first heartbeat."""
    def configure(old: Any, entries: list[int]) -> None:
        old(entries)
        for node, limit in device.consumer._limits.items():
            device.consumer._deadlines.setdefault(node, device.t_ns + limit)
    _wrap(device, device.consumer, "configure", configure)


def watch_slackly(device: Any) -> None:
    """A heartbeat counts as lost after twice the consumer time."""
    def configure(old: Any, entries: list[int]) -> None:
        old(entries)
        device.consumer._limits = {node: 2 * limit for node, limit in device.consumer._limits.items()}
    _wrap(device, device.consumer, "configure", configure)


def keep_values_over_reset(device: Any) -> None:
    """A reset does not restore the defaults."""
    device.od.restore = lambda first, last: None


def keep_application_over_reset(device: Any) -> None:
    """Reset node restores the communication objects only."""
    _wrap(device, device.od, "restore", lambda old, first, last: old(first, min(last, 0x1FFF)))


def obey_commands_for_others(device: Any) -> None:
    def into(frame: Frame) -> list[Frame]:
        is_foreign = frame.cob_id == 0 and len(frame.data) == 2 and frame.data[1] != 0
        return [frame._replace(data=bytes((frame.data[0], device.node_id)))] if is_foreign else [frame]
    device.broken.into = into


def ignore_broadcasts(device: Any) -> None:
    device.nmt._addressed = (device.node_id,)


def obey_short_commands(device: Any) -> None:
    """An NMT command without a node-ID is taken for all nodes."""
    def into(frame: Frame) -> list[Frame]:
        return [frame._replace(data=frame.data + b"\0")] if frame.cob_id == 0 and len(frame.data) == 1 else [frame]
    device.broken.into = into


def send_at_every_sync(device: Any) -> None:
    """The transmission types 2 to 240 are treated as 1."""
    for tpdo in device.pdo.tpdos.values():
        tpdo.on_sync = tpdo.send
    device.pdo.configure()


def take_over_at_once(device: Any) -> None:
    """A synchronous RPDO does not wait for SYNC."""
    for rpdo in device.pdo.rpdos.values():
        def receive(old: Any, frame: Frame, rpdo: Any = rpdo) -> None:
            old(frame)
            rpdo.latch()
        _wrap(device, rpdo, "receive", receive)


def use_short_pdos(device: Any) -> None:
    """What is missing in a short PDO is taken for zeros."""
    def into(frame: Frame) -> list[Frame]:
        return [frame._replace(data=frame.data.ljust(8, b"\0"))] if 0x180 < frame.cob_id < 0x580 else [frame]
    device.broken.into = into


def lose_disable(device: Any) -> None:
    """Bit 31 of the COB-ID is stored and has no effect."""
    for pdo in (*device.pdo.rpdos.values(), *device.pdo.tpdos.values()):
        def configure(old: Any, pdo: Any = pdo, base: int = 0) -> None:
            old()
            pdo.cob_id = device.od.read_number(base, 1) & 0x7FF
        base = (0x1800 if pdo in device.pdo.tpdos.values() else 0x1400) + pdo.n - 1
        _wrap(device, pdo, "configure", partial(configure, base=base))


def continue_after_abort(device: Any) -> None:
    """An abort by the client is ignored."""
    device.broken.into = lambda frame: [] if frame.cob_id == 0x600 + device.node_id and frame.data[:1] == b"\x80" else [
        frame]


def announce_wrong_length(device: Any) -> None:
    """Segmented uploads announce a byte too many."""
    change(0x580 + device.node_id, lambda data: data[:4] + struct.pack("<I", int.from_bytes(data[4:], "little") + 1)
           if data[0] == 0x41 else data)(device)


def accept_short_requests(device: Any) -> None:
    """A request of fewer than 8 bytes is filled up."""
    def into(frame: Frame) -> list[Frame]:
        is_request = frame.cob_id == 0x600 + device.node_id and frame.data
        return [frame._replace(data=frame.data.ljust(8, b"\0"))] if is_request else [frame]
    device.broken.into = into


def serve_all_nodes(device: Any) -> None:
    """SDO requests to any node are answered."""
    def into(frame: Frame) -> list[Frame]:
        is_request = 0x600 < frame.cob_id < 0x680
        return [frame._replace(cob_id=0x600 + device.node_id)] if is_request else [frame]
    device.broken.into = into


def stay_stopped(device: Any) -> None:
    """STOPPED is left by a reset only."""
    def receive(old: Any, frame: Frame) -> None:
        if device.state is not NmtState.STOPPED or frame.data[:1] > b"\x80":
            old(frame)
    _wrap(device, device.nmt, "receive", receive)


def start_by_itself(device: Any) -> None:
    """OPERATIONAL after boot-up, without a command."""
    def boot(old: Any) -> None:
        old()
        device._enter(NmtState.OPERATIONAL)
    _wrap(device, device, "_boot", boot)


def boot_silently(device: Any) -> None:
    device.heartbeat.send_boot_up = lambda: None


def change_constant(device: Any) -> None:
    """The product code differs from the EDS."""
    device.od.entries[0x1018, 2] = device.od.entries[0x1018, 2]._replace(default=99)
    device.od.values[0x1018, 2] = 99


def refuse_reading(device: Any) -> None:
    """0x1009 is in the EDS and cannot be read."""
    def find(old: Any, index: int, sub: int) -> Any:
        if index == 0x1009:
            raise SdoAbort(Abort.NO_OBJECT)
        return old(index, sub)
    _wrap(device, device.od, "find", find)


def send_wide(device: Any) -> None:
    """0x1017 is sent with four bytes instead of two."""
    _wrap(device, device.sdo, "_upload", lambda old, index, sub: old(index, sub).ljust(4, b"\0") if index == 0x1017
          else old(index, sub))


def write_without_effect(device: Any) -> None:
    """0x1017 confirms what it does not store."""
    _wrap(device, device.sdo, "_download", lambda old, index, sub, data: None if index == 0x1017
          else old(index, sub, data))


def swap_mapped(device: Any) -> None:
    """TPDO2 carries its 16-bit objects in the wrong order."""
    change(0x283, lambda data: data[:4] + data[6:8] + data[4:6])(device)


def omit_generic_bit(device: Any) -> None:
    """The error register in the frame lacks bit 0."""
    change(0x080 + device.node_id, lambda data: data[:2] + bytes((data[2] & ~1,)) + data[3:])(device)


def report_when_stopped(device: Any) -> None:
    device.emcy._permitted = lambda: True


def report_sync_as_pdo(device: Any) -> None:
    """A SYNC with data raises an error of another kind."""
    change(0x080 + device.node_id, lambda data: b"\x00\x50" + data[2:] if data[:2] == b"\x40\x82" else data)(device)


def hang_after_timeout(device: Any) -> None:
    """After a transfer that was not finished the server is dead until a reset."""
    def tick(old: Any, t_ns: int) -> None:
        is_open = device.sdo._open
        old(t_ns)
        if is_open is not None and device.sdo._open is None:
            device._handlers.pop(0x600 + device.node_id, None)
    _wrap(device, device.sdo, "tick", tick)


def never_lose_heartbeat(device: Any) -> None:
    """A heartbeat that stops is not noticed."""
    device.consumer.tick = lambda t_ns: None

