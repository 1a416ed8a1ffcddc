"""Nodes with one defect each: what a conformance test must find. A defect is a patch of our device or controller."""

import heapq
from collections.abc import Callable
from copy import copy
from functools import partial, reduce
from pathlib import Path
from typing import Any

from dbc import EDS
from rig.benches import Role, load_bench
from rig.conformance.run_cases import Outcome, choose_cases, run_cases
from rig.conformance.target import DataSheet, Options, Target, Verdict
from rig.device import Device
from rig.network import EmbeddedWire, Frame, Send, VirtualClock
from rig.nodes import Firmware

MS = 1_000_000  # ns
CYCLE = load_bench().nodes[Role.PLANT].outputs["cycle"].key
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
        self.into: Callable[[Frame], Frame | None] = lambda frame: frame
        self.node: Any = Firmware(self._transmit) if node == 2 else Device(node, eds or EDS[node], self._transmit)
        self.device: Any = getattr(self.node, "device", self.node)
        if node == 3:
            self.device.on_sync = partial(self.device.od.values.update, {CYCLE: 7})
        self.device.broken = self
        patch(self.device)

    def receive(self, frame: Frame) -> None:
        self.t_ns = frame.t_ns
        incoming_frame = self.into(frame)
        if incoming_frame is not None:
            self.node.receive(incoming_frame)

    def tick(self, t_ns: int) -> None:
        self.t_ns = t_ns
        self.node.tick(t_ns)
        while self._held and self._held[0][0] <= t_ns:
            _, _, cob_id, data = heapq.heappop(self._held)
            self._send(cob_id, data)

    def _transmit(self, cob_id: int, data: bytes) -> None:
        for sent_id, payload, delay in self.out(cob_id, data):
            if delay:
                heapq.heappush(self._held, (self.t_ns + delay, len(self._held), sent_id, payload))
            else:
                self._send(sent_id, payload)


def examine(patch: Break, node: int = 3, chapters: tuple[str, ...] = (), eds: Path | None = None,
            sheet: Path | None = None, options: Options | None = None) -> Outcome:
    """A conformance test of our node with this defect, in simulated time; `eds` is the node's, `sheet` the tester's."""
    wire = EmbeddedWire(VirtualClock(), [lambda send: Broken(send, node, patch, eds)])
    target = Target(wire, DataSheet(sheet or eds or EDS[node], node), options or Options(may_write=True))
    return run_cases(target, choose_cases(chapters))


def list_cases(outcome: Outcome, verdict: Verdict = Verdict.FAIL) -> list[str]:
    """Numbers of the cases with a verdict."""
    return [result.case.number for result in outcome.results if result.verdict is verdict]


def nothing(device: Any) -> None:
    """No defect."""


def wrap(path: str, around: Callable[..., Any]) -> Break:
    """Put a function around a method, such as "sdo._abort": it gets the device, the method and the arguments."""
    *owners, name = path.split(".")

    def patch(device: Any) -> None:
        owner = reduce(getattr, owners, device)
        setattr(owner, name, partial(around, device, getattr(owner, name)))
    return patch


def wrap_all(path: str, name: str, around: Callable[..., Any]) -> Break:
    """The same for a method of each PDO, such as "pdo.tpdos": it gets the device, the PDO and so on."""
    def patch(device: Any) -> None:
        for pdo in reduce(getattr, path.split("."), device).values():
            setattr(pdo, name, partial(around, device, pdo, getattr(pdo, name)))
        device.pdo.configure()
    return patch


def change_entries(is_meant: Callable[[Any], bool], **values: Any) -> Break:
    """Objects of the dictionary are described otherwise."""
    def patch(device: Any) -> None:
        device.od.entries = {key: copy(entry) for key, entry in device.od.entries.items()}
        for entry in filter(is_meant, device.od.entries.values()):
            vars(entry).update(values)
    return patch


def send_instead(cob_id: int, data: Callable[[bytes], bytes | None],
                 ms: Callable[[bytes], int] = lambda data: 0) -> Break:
    """Frames of this COB-ID carry other data, are left out (None), or come late."""
    def out(cob: int, payload: bytes) -> list[tuple[int, bytes, int]]:
        replacement = data(payload) if cob == cob_id else payload
        return [] if replacement is None else [(cob, replacement, ms(payload) * MS if cob == cob_id else 0)]

    def patch(device: Any) -> None:
        device.broken.out = out
    return patch


def hear_instead(change: Callable[[Frame], Frame | None]) -> Break:
    """The node hears other frames than those on the bus."""
    def patch(device: Any) -> None:
        device.broken.into = change
    return patch


def skip_checks(*indices: int) -> Break:
    """Values of these objects are not checked."""
    return wrap("_check", lambda device, old, index, sub, value: None if index in indices else old(index, sub, value))


keep_values_over_reset = wrap("od.restore", lambda device, old, first, last: None)
