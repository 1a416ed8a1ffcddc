"""The protocol checks of every run: each faulty controller fails the check that is meant for it, a sound one none.

The sequence has no checks of its own.
"""

from math import nan
from pathlib import Path

import firmware_variants as variants
import numpy as np
import pytest
from firmware_variants import Variant
from rig_command import job, play

from fdi.report import build_run_report
from fdi.trace import Trace
from rig.network import Frame
from rig.recorder import Signals, Timing
from rig.run import History, Outcome, participants
from rig.run.bring_up import find_gap

HOLD = 'title = "Holds"\nmain = [{ kind = "hold", time = 0.4 }]\n'
MOVE = """
title = "Moves"
setup = [{ kind = "hold", time = 0.05 }]
main = [
  { kind = "hold", time = 0.05 }, { kind = "step", to = 4e-3, time = 0.15 }, { kind = "ramp", to = 0.0, time = 0.15 },
]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.05 }]
"""
IDLE, LIMIT, STATUS = "no current unless ACTIVE", "current within its limit", "status word follows the control word"
NUMBER, MISSING = "drive frames of another cycle", "drive frames missing or late"
DELAY, GAIN, RESET = "delay of the answer to a step", "gain against 0x2110", "same answers after a reset"
FROZEN, HEARTBEAT, EMCY = "current follows the error", "heartbeat period, controller", "undocumented EMCY codes"


def play_with(make: type[Variant], folder: Path, monkeypatch: pytest.MonkeyPatch, text: str = HOLD,
              seed: int = 0) -> Outcome:
    """A run with that controller in place of the reference firmware."""
    monkeypatch.setattr(participants, "Firmware", make)
    return play(job(text, seed=seed), folder)


def failures(outcome: Outcome) -> set[str]:
    """The protocol checks that failed."""
    return {check.name for check in outcome.checks if check.kind == "protocol" and not check.passed}


@pytest.mark.parametrize(("make", "name", "text"), [
    *((make, name, HOLD) for make, name in (
        (variants.CycleLate, NUMBER), (variants.StaleNumber, NUMBER),
        (variants.OldCurrent, DELAY), (variants.NoOutput, DELAY),
        (variants.WrongSign, GAIN), (variants.GainLow, GAIN), (variants.GainHigh, GAIN),
        (variants.OneOfFifty, MISSING),
        (variants.IgnoresControl, IDLE),
        (variants.AlwaysActive, STATUS), (variants.NeverReady, STATUS), (variants.SlowStatus, STATUS),
        (variants.NoHeartbeat, HEARTBEAT), (variants.HalfTheHeartbeats, HEARTBEAT),
        (variants.NotANumber, LIMIT), (variants.Leaks, RESET), (variants.StrangeEmcy, EMCY))),
    # what shows only in motion
    (variants.Frozen, FROZEN, MOVE), (variants.BeyondLimit, LIMIT, MOVE),
])
def test_a_faulty_controller_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: type[Variant], name: str,
                                   text: str) -> None:
    outcome = play_with(make, tmp_path, monkeypatch, text)
    assert name in failures(outcome) and outcome.status == 1


@pytest.mark.parametrize("seed", range(4))
def test_a_sound_controller_never_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    outcome = play_with(Variant, tmp_path, monkeypatch, MOVE if seed % 2 else HOLD, seed)
    assert outcome.verdict == "NOT_JUDGED" and failures(outcome) == set()  # no check of the sequence's own
    assert [check.name for check in outcome.checks] == [
        IDLE, LIMIT, STATUS, NUMBER, MISSING, FROZEN, DELAY, GAIN, RESET, HEARTBEAT, "heartbeat period, plant", EMCY]


def test_they_stand_in_a_section_of_their_own(tmp_path: Path) -> None:
    play(job(), tmp_path)
    trace = Trace.read(tmp_path, all=True)
    assert [check.name for check in trace.sequence_checks] == ["overshoot", "no emergency"]
    sections = {section.title: section for section in build_run_report(trace).sections}
    assert len(sections["Checks"].items[0].rows) == 2  # type: ignore[union-attr]
    assert len(sections["Protocol"].items[0].rows) == len(trace.protocol_checks) == 12  # type: ignore[union-attr]


def test_limits_of_the_sequence_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lenient = HOLD + ("[protocol]\nstep_delay = 1e-3\nmissing = 0.03\ngain = 0.4\nemcy = [0x6000]\nstatus = 6e-3\n"
                      "heartbeat = 0.2\n")
    for make in (variants.OneOfFifty, variants.GainLow, variants.SlowStatus, variants.HalfTheHeartbeats):
        assert failures(play_with(make, tmp_path, monkeypatch, lenient)) == set(), make
    assert DELAY not in failures(play_with(variants.OldCurrent, tmp_path, monkeypatch, lenient))
    assert EMCY not in failures(play_with(variants.StrangeEmcy, tmp_path, monkeypatch, lenient))


def test_a_longer_probe_changes_no_row(tmp_path: Path) -> None:
    rows = []
    for step_delay in (0.0, 20e-3):
        play(job(MOVE + f"[protocol]\nstep_delay = {step_delay}\n"), tmp_path)
        trace = Trace.read(tmp_path, all=True)
        rows.append([trace.com, trace.xj, trace.cor, trace.xs])
    assert np.array_equal(*rows)


class ReportsLostSync(Variant):
    """Reports SYNC lost just before it obeys a reset or stops, as on a busy machine: SYNC pauses after each probe."""

    def hear(self, frame: Frame) -> Frame:
        if frame.cob_id == 0x000 and frame.data[0] >= 0x80:
            self.bus(0x082, (0x8100).to_bytes(2, "little") + bytes((0x11, 0, 0, 0, 0, 0)))
        return frame


def test_a_report_before_or_after_the_cycles_of_the_run_ends_nothing(tmp_path: Path,
                                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = play_with(ReportsLostSync, tmp_path, monkeypatch)
    texts = [event.text for event in outcome.events if event.kind == "emcy"]
    assert (outcome.verdict, outcome.safe) == ("NOT_JUDGED", False)
    assert texts[0].endswith("0x8100 (EMCY) Monitoring (before the run)") and texts[-1].endswith("(after the run)")


def test_a_gap_where_the_bench_was_late_is_not_the_controllers() -> None:
    probe = History()
    for k in range(10):
        probe.cycle(k, Signals(k, 3, 0.0, 0.0, nan if k == 5 else 0.0, 0.0, 0.0, 0.0, 7, 7, 0),
                  Timing(k, False, 0.0, 1e-4, 2e-4, 1e-4, 1e-4, 0.0))
    on_time = np.ones(10, bool)
    assert find_gap(probe, on_time, 10) == "controller" and find_gap(probe, on_time, 4) == ""
    on_time[5] = False
    assert find_gap(probe, on_time, 10) == "bench"


def test_without_probes(tmp_path: Path) -> None:
    outcome = play(job(HOLD + "[protocol]\nprobe = false\n"), tmp_path)
    names = [check.name for check in outcome.checks]
    assert outcome.verdict == "NOT_JUDGED" and IDLE in names and not {DELAY, GAIN, RESET} & set(names)
