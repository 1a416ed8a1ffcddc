"""The protocol checks as pure functions: what the rig itself received late proves nothing about a node."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from rig.sequences.checks import CheckResult
from rig.sequences.protocol import (
    Heartbeat,
    ProtocolLimits,
    ProtocolRecord,
    Rows,
    judge_protocol,
    measure_frozen,
)

ON_TIME = [Heartbeat(0.1 * k) for k in range(10)]
SLOW = [Heartbeat(0.2 * k) for k in range(5)]
LATE = [Heartbeat(0.15 * k, 0.06) for k in range(6)]  # the rig stood still before it took them in


def judge_heartbeats(beats: Sequence[Heartbeat], seconds: float = 1.0, deaf: float = 0.0) -> CheckResult | None:
    """The check of the heartbeats of a controller; None if they say nothing."""
    nothing = np.zeros(5)
    rows = Rows(*[nothing] * 7, on_time=np.ones(5, bool))
    record = ProtocolRecord(run=rows, heartbeats={"controller": beats}, heard=(0.0, seconds), deaf=deaf,
                            current_limit=8e-3)
    found = [check for check in judge_protocol(record, ProtocolLimits()) if check.signal == "heartbeat"]
    return found[0] if found else None


@pytest.mark.parametrize(("beats", "passed"), [
    (ON_TIME, True), (SLOW, False), ([], False), (ON_TIME[:1], False), (LATE, None),
    ([*ON_TIME[:5], Heartbeat(0.62, 0.12), *ON_TIME[7:]], True),  # one stall
    ([*SLOW, Heartbeat(0.95, 0.3)], False),  # a stall is no excuse for the other heartbeats
])
def test_heartbeats_that_waited_for_the_rig_are_not_judged(beats: list[Heartbeat], passed: bool | None) -> None:
    check = judge_heartbeats(beats)
    assert (None if check is None else check.passed) == passed


def test_a_rig_that_received_nothing_for_most_of_the_run_does_not_miss_heartbeats() -> None:
    assert judge_heartbeats([], 1.0, deaf=0.8) is None
    check = judge_heartbeats([], 1.0, deaf=0.5)
    assert check is not None and not check.passed


@pytest.mark.parametrize(("frozen", "limit", "is_found"), [
    (2e-4, 8e-3, True),  # it is also the largest current of the run
    (8e-3, 8e-3, False),  # at the limit it says it has
    (2e-4, None, False),  # a controller that does not say its limit may have this one
])
def test_a_current_that_stands_still_below_the_limit_is_found(
    frozen: float, limit: float | None, is_found: bool
) -> None:
    cycles = 100
    error = np.linspace(0.0, 1e-3, cycles)
    current = np.where(np.arange(cycles) < 50, 1e-5 * np.sin(np.arange(cycles)), frozen)
    zero, words = np.zeros(cycles), np.full(cycles, 15.0)
    rows = Rows(com=error, xj=zero, cor=current, control=words, status=words, flags=zero, response=zero,
                on_time=np.ones(cycles, bool))
    assert (measure_frozen(rows, limit) > 4e-4) == is_found
