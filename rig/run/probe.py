"""The probes: short plays before and after a sequence that show what its own cycles cannot.

In a sequence the control word leaves ACTIVE only where demand and position agree, so a firmware that ignores it sends
next to no current there either. A probe asks for a position 1 mm away while the control word is not ACTIVE, then steps
the demand while it is. It is played twice before set-up, each time after a reset, on the healthy plant in its initial
state: the two must be answered alike. The reset that follows brings plant and controller back to the same state, so
the rows of the sequence are those of a run without probes. After clean-up the control word leaves ACTIVE once more.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.benches.profiles import Control
from rig.run.cyclic_values import CycleInput
from rig.run.loop import History
from rig.sequences.faults import Schedule
from rig.sequences.protocol import Mask, Rows

BEFORE, AFTER = 3, 4  # phase numbers, beside those of set-up, main and clean-up; the log has their frames only
PROBES = 2  # before set-up
ATTEMPTS = 5  # at each of them, in real time
DISTANCE = 1e-3  # m: from the position to the demand while the control word is not ACTIVE
_MISSED_LIMIT = 5  # cycles in a row without an answer: then the probe ends, because each costs a timeout


class Step(NamedTuple):
    """Some cycles with the same command; `demand` in m from where the ram is meant to be."""

    control: int
    demand: float
    cycles: int


WARM_UP = (Step(0, DISTANCE, 30), Step(Control.RESET, DISTANCE, 1))  # real time: the first cycles may be late
LAST_STEPS = (Step(0, DISTANCE, 8),)


def list_first_steps(step_delay: float, rate: float) -> tuple[Step, ...]:
    """The steps of a probe before set-up, whose demand step may be answered `step_delay` s late.

    `rate`: cycles a second.
    """
    step = 0.5e-3  # m; its current is far below the limit
    return (Step(0, DISTANCE, 4), Step(Control.DISABLE, DISTANCE, 2), Step(Control.DISABLE | Control.HOLD, DISTANCE, 2),
            Step(Control.ACTIVE, 0.0, 3), Step(Control.ACTIVE, step, 3 + round(step_delay * rate)),
            Step(0, DISTANCE, 8))


def count_cycles(steps: tuple[Step, ...]) -> int:
    """The length of a probe in cycles."""
    return sum(step.cycles for step in steps)


def list_inputs(steps: tuple[Step, ...], phase: int, demand: float) -> list[CycleInput]:
    """The cycles of a probe at the position `demand`, m."""
    return [CycleInput(phase, demand + step.demand, 0.0, int(step.control)) for step in steps
            for _ in range(step.cycles)]


def has_no_answers(probe: History) -> bool:
    """Whether the last cycles were all without a drive frame."""
    last = probe.column("cor")[-_MISSED_LIMIT:]
    return len(last) == _MISSED_LIMIT and bool(np.isnan(last).all())


def find_gap(probe: History, on_time: Mask, cycles: int) -> str:
    """Who left one of the last `cycles` of a probe without a frame: "bench", "controller", "" for nobody.

    An answer that is missing where the bench was not `on_time`, (n,), is the bench's gap.
    """
    missing = np.isnan(probe.column("cor")[-cycles:])
    if np.isnan(probe.column("xj")[-cycles:]).any() or (missing & ~on_time[-cycles:]).any():
        return "bench"
    return "controller" if missing.any() else ""


def read_rows(history: History, on_time: Mask) -> Rows:
    """The rows of a history as the protocol checks see them."""
    return Rows(on_time=on_time, **{name: history.column(name) for name in Rows._fields if name != "on_time"})


def find_on_time(history: History, faults: Schedule | None, realtime: bool, period: float, reach: int = 1) -> Mask:
    """Cycles that the bench delivered: neither this SYNC nor the next was late, feedback came within half a cycle, and
    no injected fault touched a frame of this cycle or of the `reach` before it."""
    on_time: Mask = ~np.isnan(history.column("xj"))
    if realtime:
        on_time &= history.column("feedback_response") <= 0.5 * period
        late = history.column("lateness") > 0.1 * period
        on_time &= ~late & ~np.append(late[1:], False)
    if faults is not None:
        on_time &= ~faults.find_disturbed(len(on_time), reach)
    return on_time
