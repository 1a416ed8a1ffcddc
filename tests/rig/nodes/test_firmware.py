"""The reference firmware by scripts of frames: when current flows, and how a fault is taken back.

The one in C sends the same (test_same_answers.py); that the law is the model's is asked of runs (test_run.py).
"""

import struct

import pytest
from node_bench import FirmwareDesk

from rig.benches.profiles import CIA408
from rig.device import Abort
from rig.network.node_objects import GAINS
from rig.nodes.firmware import LOST_AFTER

ACTIVE, RESET = CIA408.ladder[-1], CIA408.reset


def pause(desk: FirmwareDesk) -> None:
    """PRE-OPERATIONAL and back."""
    desk.nmt(128)
    desk.nmt(1)


def set_gain(desk: FirmwareDesk, sub: int, value: float) -> int:
    """SDO download of a REAL64; the abort code or 0."""
    desk.send(0x602, b"\x21" + GAINS.to_bytes(2, "little") + bytes((sub, 8, 0, 0, 0)))
    data = struct.pack("<d", value)
    desk.send(0x602, b"\x00" + data[:7])
    reply = desk.send(0x602, b"\x1d" + data[7:].ljust(7, b"\0"))[0]
    return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0


@pytest.mark.parametrize(("control", "status"), [
    (0b000, 0b1000), (0b001, 0b1001), (0b011, 0b1011), (0b111, 0b1111),
    (0b010, 0b1000), (0b100, 0b1000), (0b101, 0b1000), (0b110, 0b1000),
])
def test_the_levels_build_on_each_other(control: int, status: int) -> None:
    """Current flows with all three, and none is skipped."""
    drive = FirmwareDesk().cycle(control, demand=1e-3)
    assert drive is not None and drive.status == status
    assert (drive.current != 0) == (control == ACTIVE)


def test_it_answers_each_feedback_with_the_cycle_it_belongs_to() -> None:
    desk = FirmwareDesk()
    assert [drive.cycle for _ in range(5) if (drive := desk.cycle(ACTIVE))] == [0, 1, 2, 3, 4]
    desk.k = 65_535
    assert [drive.cycle for _ in range(2) if (drive := desk.cycle(ACTIVE))] == [65_535, 0]


def test_lost_feedback_is_a_fault_that_is_latched_until_its_cause_is_gone_and_reset_rises() -> None:
    desk = FirmwareDesk()
    desk.cycle(ACTIVE | RESET, 1e-3)  # a bit that is up already acknowledges nothing
    drives = [desk.cycle(ACTIVE | RESET, 1e-3, position=None) for _ in range(LOST_AFTER + 1)]
    assert [d is not None for d in drives] == [False] * LOST_AFTER + [True]
    assert drives[-1] is not None and (drives[-1].current, drives[-1].status) == (0.0, 0)
    desk.cycle(ACTIVE, position=None)
    desk.cycle(ACTIVE | RESET, position=None)  # while the cause stands
    assert desk.emergencies() == [0x8250]
    assert not desk.status(ACTIVE | RESET, 2)
    assert desk.emergencies() == [0x8250, 0]  # feedback is back, the fault is not
    assert not desk.status(ACTIVE, 1)
    assert desk.status(ACTIVE | RESET, 1) == ACTIVE | 8
    assert desk.status(ACTIVE, 1) == ACTIVE | 8


def test_a_restart_takes_the_fault_but_not_the_error_that_stands() -> None:
    """START after a pause: the emergency is taken back with the first feedback, and the next fault can be reset."""
    desk = FirmwareDesk()
    for _ in range(LOST_AFTER + 1):
        desk.cycle(ACTIVE, position=None)
    pause(desk)
    assert desk.status(ACTIVE, 1) == ACTIVE | 8
    assert desk.emergencies() == [0x8250, 0] and desk.node.device.emcy.active == []


@pytest.mark.parametrize(("sub", "value", "is_taken"), [
    (1, float("nan"), False), (1, float("inf"), False), (1, float("-inf"), False),
    (4, -1e-3, False), (4, 0.0, True), (5, 0.0, False), (5, -1e-3, False), (5, 5e-324, True),
])
def test_gains_that_cannot_be_are_refused(sub: int, value: float, is_taken: bool) -> None:
    desk = FirmwareDesk()
    assert set_gain(desk, 3, 1.0) == 0  # with a derivative part the period is divided by
    assert set_gain(desk, sub, value) == (0 if is_taken else Abort.VALUE)
    pause(desk)
    assert [desk.cycle(ACTIVE, 1e-3 * k) is not None for k in range(3)] == [True] * 3
