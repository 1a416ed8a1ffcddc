"""Protocol checks on benches of other devices: CiA 402, plain CAN, and what does not apply to them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdi.trace.check_result import CheckResult
from rig.benches.bench import Bench
from rig.benches.bench_file import load_bench
from rig.sequences.protocol import ProtocolLimits, ProtocolRecord, Rows, judge_protocol

EXAMPLES = Path(__file__).parents[3] / "examples"
DRIVE = load_bench(str(EXAMPLES / "cia402_drive" / "bench.toml"))
ECU = load_bench(str(EXAMPLES / "can_ecu" / "bench.toml"))
# What a run sends, and what a sound drive answers: a control word, a status word and a current, for some cycles.
ENABLED = [(0x06, 0x0231, 0.0, 3), (0x07, 0x0233, 0.0, 3), (0x0F, 0x1237, 1e-3, 50)]
SOUND = [*ENABLED, (0x00, 0x0250, 0.0, 20)]


def make_rows(parts: list[tuple[int, int, float, int]]) -> Rows:
    columns = [np.repeat([part[i] for part in parts], [part[3] for part in parts]).astype(float) for i in range(3)]
    zero = np.zeros(len(columns[0]))
    return Rows(demand=zero, position=zero, drive=columns[2], control=columns[0], status=columns[1], flags=zero,
                response=zero, on_time=np.ones(len(zero), bool))


def judge(rows: Rows, bench: Bench, limits: ProtocolLimits | None = None,
          ) -> tuple[dict[str, CheckResult], dict[str, str]]:
    record = ProtocolRecord(run=rows, bench=bench, drive_limit=8e-3)
    checks, skipped = judge_protocol(record, limits or ProtocolLimits())
    return {check.name: check for check in checks}, {check.name: check.reason for check in skipped}


STATES, FOLLOWS, IDLE = ("status word follows the states of CiA 402", "status word follows the control word",
                         "no current unless Operation enabled")


@pytest.mark.parametrize(("parts", "failed"), [
    (SOUND, set()),
    ([(0x06, 0x0250, 0.0, 100), *SOUND[1:]], set()),  # READY was between two frames
    ([(0x06, 0x0250, 0.0, 100), *SOUND], set()),  # a slow drive
    ([(0x06, 0x0250, 0.0, 600), *SOUND], {FOLLOWS}),  # too slow
    ([(0x0F, 0x1237, 1e-3, 50)], {STATES, IDLE}),  # enabled by itself, never without current
    ([*ENABLED, (0x00, 0x1237, 1e-3, 600)], {FOLLOWS, IDLE}),  # ignores Disable voltage
    ([*ENABLED, (0x00, 0x0250, 1e-3, 600)], {IDLE}),  # says so, and lets the current flow
    ([*ENABLED, (0x00, 0x0250, 1e-5, 600)], {IDLE}),
    ([*ENABLED, (0x0F, 0x0218, 0.0, 10), (0x00, 0x0218, 0.0, 5), (0x80, 0x0250, 0.0, 5), *SOUND], set()),  # a fault
    ([*ENABLED, (0x0F, 0x0218, 0.0, 10), (0x0F, 0x0250, 0.0, 5)], {STATES}),  # which ends without a reset
    ([*ENABLED, (0x02, 0x0217, 1e-3, 30), (0x02, 0x0250, 0.0, 5)], set()),  # quick stop, with an automatic end
    ([(0x00, 0x0210, 0.0, 5), (0x06, 0x0250, 0.0, 5), *SOUND], set()),  # it initialises itself first
    ([*ENABLED, (0x0F, 0x0220, 0.0, 5)], {STATES}),  # a word that the profile does not have
])
def test_a_drive_is_held_against_the_state_machine(parts: list[tuple[int, int, float, int]], failed: set[str]) -> None:
    found, _ = judge(make_rows(parts), DRIVE)
    assert {name for name in (STATES, FOLLOWS, IDLE) if not found[name].passed} == failed


def test_the_cycles_in_which_a_drive_is_enabled_are_judged_with_the_run() -> None:
    """They come before the run, whose first row finds the drive enabled."""
    enabled = make_rows([(0x0F, 0x1237, 1e-3, 50)])
    for before, passed in ((make_rows(ENABLED), True), (make_rows([(0x0F, 0x1237, 0.0, 5)]), False)):
        record = ProtocolRecord(run=enabled, enabling=[(0, before)], bench=DRIVE, drive_limit=8e-3)
        found = {check.name: check.passed for check in judge_protocol(record, ProtocolLimits())[0]}
        assert found[STATES] is passed


def test_a_small_current_may_be_allowed_when_idle() -> None:
    noisy = [*ENABLED, (0x00, 0x0250, 1e-5, 600)]
    found, _ = judge(make_rows(noisy), DRIVE, ProtocolLimits(idle_current=2e-5))
    assert found[IDLE].passed


def test_a_controller_that_is_switched_off_by_phase_sends_no_current() -> None:
    def largest(currents: list[float]) -> CheckResult:
        parts = [(word, 0, current, 100) for word, current in zip((2, 3, 2), currents, strict=True)]
        return judge(make_rows(parts), ECU)[0]["no current unless enabled"]

    assert largest([0.0, 1e-3, 0.0]).passed
    assert not largest([1e-3, 1e-3, 0.0]).passed and not largest([0.0, 1e-3, 1e-3]).passed
    always = judge(make_rows([(0, 0, 1e-3, 100)]), replace(ECU, phases={}))
    assert "no current unless enabled" in always[1]


def test_what_does_not_apply_is_named_with_its_reason_and_is_no_check() -> None:
    for bench, expected in (
            (DRIVE, {"drive frames of another cycle", "heartbeat period, controller", "undocumented EMCY codes"}),
            (ECU, {"drive frames of another cycle", "same answers after a reset", "heartbeat period, controller",
                   "undocumented EMCY codes", "status word follows the control word"})):
        found, skipped = judge(make_rows(SOUND), bench)
        assert set(skipped) == expected and all(skipped.values()) and not set(found) & set(skipped)
