"""The tester itself: late, lied to, and leaving the node as it was."""
from __future__ import annotations

import random
from typing import Any

import pytest
from broken_devices import examine, keep_values_over_reset, list_cases

from dbc import EDS
from plant.errors import RigError
from rig.conformance.conformance_case import Verdict
from rig.conformance.data_sheet import DataSheet
from rig.conformance.run_cases import choose_cases, run_cases
from rig.conformance.target import Options, Target
from rig.network.clock import VirtualClock
from rig.network.frame import Send
from rig.network.link import Done, EmbeddedWire
from rig.nodes.firmware import Firmware


class StallingWire(EmbeddedWire):
    """Every hundredth wait comes back 70 ms late, as on a busy machine."""

    waits = 0

    def wait(self, done: Done, seconds: float) -> bool:
        self.waits += 1
        is_done = super().wait(done, seconds)
        if self.waits % 100 == 0:
            self.clock.sleep_until(self.clock.now() + 70_000_000)
        return is_done


def test_a_late_tester_does_not_blame_the_node() -> None:
    target = Target(StallingWire(VirtualClock(), [Firmware]), DataSheet(EDS[2], 2), Options(may_write=True))
    outcome = run_cases(target, choose_cases(["7"]))
    jitter = next(result for result in outcome.results if result.case.number == "7.4")
    assert jitter.verdict is Verdict.SKIPPED and jitter.measured.startswith("this machine was 70 ms late itself")
    assert (list_cases(outcome), outcome.verdict) == ([], "INVALID_TIMING")


@pytest.mark.parametrize("seed", range(6))
def test_a_node_that_answers_nonsense_does_not_stop_the_tester(seed: int) -> None:
    """One frame in ten is cut, changed, doubled or lost: cases fail, the test comes to its end."""
    chance = random.Random(seed)

    def garble(device: Any) -> None:
        def out(cob_id: int, data: bytes) -> list[tuple[int, bytes, int]]:
            kind = chance.randrange(40)
            if kind == 0:
                return [(cob_id, data[:chance.randrange(len(data) + 1)], 0)]
            if kind == 1:
                return [(cob_id, chance.randbytes(len(data)), 0)]
            if kind == 2:
                return [(cob_id, data, 0), (cob_id, data, 0)]
            return [] if kind == 3 else [(cob_id, data, 0)]
        device.broken.out = out

    outcome = examine(garble, options=Options(may_write=True, timeout=0.2, boot_timeout=0.5))
    assert len(outcome.results) == len(choose_cases([]))
    assert outcome.verdict == "FAIL"


def test_what_a_reset_does_not_restore_is_set_back_and_reported() -> None:
    nodes: list[Any] = []

    def remember(device: Any) -> None:
        keep_values_over_reset(device)
        nodes.append(device)

    outcome = examine(remember, chapters=("5",))
    assert any(note.startswith("0x1016:1 held 0x100FA before and ") and note.endswith("it was set back.")
               for note in outcome.notes)
    assert nodes[0].read(0x1016, 1) == 0x000100FA and nodes[0].read(0x1017) == 100


class Talker:
    """Another node: it sends one frame every 20 ms."""

    def __init__(self, send: Send, cob_id: int) -> None:
        self._send, self._cob_id, self._due = send, cob_id, 0

    def receive(self, frame: object) -> None:
        """Nothing concerns it."""

    def tick(self, t_ns: int) -> None:
        if t_ns >= self._due:
            self._due = t_ns + 20_000_000
            self._send(self._cob_id, b"" if self._cob_id == 0x080 else b"\x05")


def make_target(cob_id: int) -> Target:
    wire = EmbeddedWire(VirtualClock(), [Firmware, lambda send: Talker(send, cob_id)])
    return Target(wire, DataSheet(EDS[2], 2), Options(may_write=True))


def test_another_master_on_the_bus_is_left_alone() -> None:
    with pytest.raises(RigError, match=r"another node sends SYNC \(0x080\)"):
        run_cases(make_target(0x080))


def test_other_nodes_are_not_commanded() -> None:
    """A command to all nodes would start them too; the node-ID used as a stranger's is nobody's."""
    outcome = run_cases(make_target(0x700 + 126))
    skipped = [result.case.number for result in outcome.results if result.verdict is Verdict.SKIPPED]
    assert (outcome.verdict, skipped, outcome.notes) == ("PASS", ["6.5"], ["Other nodes on the bus: 126."])
