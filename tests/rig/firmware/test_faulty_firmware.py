"""Each fault of a firmware is caught by the check that is meant for it, and a sound firmware by none."""
from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
from bus_stations import spec
from c_device import skip_without_compiler
from c_program import build_faulty, run_program
from short_sequences import SHORT, job, play

from rig.firmware.build import build_controller
from rig.network.bus import open_can
from rig.network.link import Link
from rig.run import participants
from rig.run.outcome import Outcome

CAUGHT_BY = {
    "late_frame": "drive frames of another cycle",
    "late_current": "delay of the answer to a step",
    "stale_cycle": "drive frames of another cycle",
    "frozen_output": "current follows the error",
    "sign_error": "delay of the answer to a step",
    "gain_high": "gain against 0x2110",
    "gain_low": "gain against 0x2110",
    "missed_cycles": "drive frames missing or late",
    "ignores_control": "no current unless ACTIVE",
    "wrong_status": "status word follows the control word",
    "missing_ready": "status word follows the control word",
    "no_heartbeat": "heartbeat period, controller",
    "nan_current": "current within its limit",
    "saturated_current": "current within its limit",
    "leaks_state": "same answers after a reset",
}

LOSES_FRAMES = ("late_frame", "stale_cycle", "missed_cycles")
# A heartbeat takes 100 ms of wall time, in which lockstep runs through hundreds of cycles.
LONG = SHORT.replace('"rest", kind = "hold", time = 0.05', '"rest", kind = "hold", time = 3.0')


@pytest.fixture(autouse=True)
def compiler() -> None:
    """These tests compile the firmware."""
    skip_without_compiler()


def play_against(folder: Path, fault: str) -> Outcome:
    """A short run in lockstep against the firmware with that fault."""
    where = spec("udp_multicast")
    with run_program(build_faulty(), fault, where):
        return play(job(LONG if fault == "no_heartbeat" else SHORT, seed=1, controller="external", bus=where), folder)


def wait_for_nodes(where: str, seconds: float = 60.0) -> None:
    """Until both nodes have sent a heartbeat: the plant may compile its model before."""
    link, heard, end = Link(open_can(where), time.monotonic_ns), set[int](), time.monotonic() + seconds
    while not {0x702, 0x703} <= heard and time.monotonic() < end:
        heard |= {frame.cob_id for frame in link.poll(0.1)}
    link.close()
    assert {0x702, 0x703} <= heard


def list_failed(outcome: Outcome) -> list[str]:
    """Names of the checks that did not pass."""
    return [check.name for check in outcome.checks if not check.passed]


@pytest.mark.parametrize("fault", CAUGHT_BY)
def test_each_fault_is_caught_by_its_check(tmp_path: Path, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if fault in LOSES_FRAMES:
        monkeypatch.setattr(participants, "FRAME_TIMEOUT", 0.2)  # s: it is spent in each cycle without an answer
    outcome = play_against(tmp_path, fault)
    assert outcome.status == 1
    assert CAUGHT_BY[fault] in list_failed(outcome)


def test_a_sound_firmware_with_an_integral_part_passes(tmp_path: Path) -> None:
    """It is the firmware of "leaks_state" without the leak."""
    outcome = play_against(tmp_path, "integral")
    assert (outcome.verdict, list_failed(outcome)) == ("PASS", [])


def test_twenty_runs_against_one_sound_firmware_pass(tmp_path: Path) -> None:
    """Without one false alarm. Firmware and plant stay on the bus between the runs, as on a real bench."""
    where = spec("udp_multicast")
    plant = (sys.executable, "-m", "rig.cli.main", "node", "plant", "--bus", where, "--quiet")
    with run_program(build_controller(), where), run_program(*plant):
        wait_for_nodes(where)
        for seed in range(20):
            outcome = play(job(seed=seed, controller="external", plant="external", bus=where), tmp_path)
            assert (seed, outcome.verdict, list_failed(outcome)) == (seed, "PASS", [])
            assert set(outcome.counters.values()) == {0}
