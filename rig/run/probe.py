"""The probes: short plays before and after a sequence that show what its own cycles cannot.

In a sequence the controller is disabled only where demand and position agree, so a firmware that ignores it sends next
to no current there either. A probe asks for a position some way off (of the EHA 1 mm) while the controller is disabled,
then steps the demand while it is enabled. It is played before set-up, on the healthy plant in its initial state. On
CANopen it is played twice, each time after a reset, and the two must be answered alike; the reset that follows brings
plant and controller back to the same state, so the rows of the sequence are those of a run without probes. Plain CAN
has no reset: there it is played once, and the ram goes back to where it began. After clean-up the controller is
disabled once more.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.benches.bench import Bench
from rig.benches.profiles import PROFILES, State
from rig.run.cyclic_values import AFTER, BEFORE, BEFORE_MAIN, CycleInput
from rig.run.loop import History
from rig.sequences.faults import Schedule
from rig.sequences.protocol import Mask, ProtocolLimits, Rows

PROBES = 2  # before set-up, of a controller that can be reset
ATTEMPTS = 5  # at each of them, in real time
RETURN_TIME = 0.3  # s: until the ram is back, some time constants of a position loop
_MISSED_LIMIT = 5  # cycles in a row without an answer: then the probe ends, because each costs a timeout


class Step(NamedTuple):
    """Some cycles with the same command; `demand` counts from where the plant is meant to be."""

    control: int
    demand: float
    cycles: int
    phase: int = BEFORE
    begins_enabled: bool = False  # before it the controller is enabled, in cycles that do not count


def list_warm_up(bench: Bench) -> tuple[Step, ...]:
    """Real time: the first cycles may be late."""
    words = PROFILES[bench.profile]
    first = Step(find_disabled(bench), find_distance(bench), 30)
    return (first,) if words.is_confirmed else (first, Step(words.reset, first.demand, 1))


def find_distance(bench: Bench) -> float:
    """From the position to the demand while the controller is disabled; 1 mm of the EHA."""
    return 500.0 * bench.fineness


def find_disabled(bench: Bench) -> int:
    """The control word of a probe with which the controller is disabled."""
    words = PROFILES[bench.profile]
    return words.ladder[State.READY] if bench.profile == "none" and not bench.is_enabled("setup") else words.ladder[0]


def list_last_steps(bench: Bench) -> tuple[Step, ...]:
    """The probe after clean-up."""
    return (Step(0, find_distance(bench), 8 + _count_release(bench), AFTER),)


def list_first_steps(limits: ProtocolLimits, bench: Bench) -> tuple[Step, ...]:
    """The steps of a probe before set-up, whose demand step may be answered as late as the limits say."""
    distance = find_distance(bench)
    step = 0.5 * distance  # the answer to it is far below the limit
    active, off = PROFILES[bench.profile].ladder[State.ACTIVE], find_disabled(bench)
    steps = []
    if bench.profile != "none":
        low, high = PROFILES[bench.profile].ladder[1:3]
        steps = [Step(off, distance, 4), Step(low, distance, 2), Step(high, distance, 2)]
    elif bench.enables:
        steps = [Step(off, distance, 8)]
    steps += [Step(active, 0.0, 3, BEFORE_MAIN, begins_enabled=True),
              Step(active, step, 3 + round(limits.find_step_delay(bench) * bench.rate), BEFORE_MAIN)]
    if not bench.nodes:
        steps.append(Step(active, 0.0, round(RETURN_TIME * bench.rate), BEFORE_MAIN))
    return (*steps, Step(off, distance, 8 + _count_release(bench)))


def _count_release(bench: Bench) -> int:
    """Cycles until a controller without a control word has switched its current off."""
    return round(PROFILES["none"].delay * bench.rate) if bench.profile == "none" else 0


def count_cycles(steps: tuple[Step, ...]) -> int:
    """The length of a probe in cycles."""
    return sum(step.cycles for step in steps)


def list_inputs(step: Step, demand: float = 0.0) -> list[CycleInput]:
    """The cycles of a step at the position `demand`, SI."""
    return [CycleInput(step.phase, demand + step.demand, 0.0, step.control)] * step.cycles


def has_no_answers(probe: History) -> bool:
    """Whether the last cycles were all without a drive frame."""
    last = probe.column(probe.signals.drive.name)[-_MISSED_LIMIT:]
    return len(last) == _MISSED_LIMIT and bool(np.isnan(last).all())


def find_gap(probe: History, on_time: Mask, cycles: int) -> str:
    """Who left one of the last `cycles` of a probe without a frame: "bench", "controller", "" for nobody.

    An answer that is missing where the bench was not `on_time`, (n,), is the bench's gap.
    """
    missing = np.isnan(probe.column(probe.signals.drive.name)[-cycles:])
    if np.isnan(probe.column(probe.signals.controlled.name)[-cycles:]).any() or (missing & ~on_time[-cycles:]).any():
        return "bench"
    return "controller" if missing.any() else ""


def read_rows(history: History, on_time: Mask) -> Rows:
    """The rows of a history as the protocol checks see them."""
    signals = history.signals
    own = {"demand": signals.command.name, "position": signals.controlled.name, "drive": signals.drive.name}
    return Rows(on_time=on_time, **{name: history.column(own.get(name, name)) for name in Rows._fields
                                    if name != "on_time"})


def find_on_time(history: History, faults: Schedule | None, realtime: bool, period: float, reach: int = 1) -> Mask:
    """Cycles that the bench delivered: neither this SYNC nor the next was late, feedback came within half a cycle, and
    no injected fault touched a frame of this cycle or of the `reach` before it."""
    on_time: Mask = ~np.isnan(history.column(history.signals.controlled.name))
    if realtime:
        on_time &= history.column("feedback_response") <= 0.5 * period
        late = history.column("lateness") > 0.1 * period
        on_time &= ~late & ~np.append(late[1:], False)
    if faults is not None:
        on_time &= ~faults.find_disturbed(len(on_time), reach)
    return on_time
