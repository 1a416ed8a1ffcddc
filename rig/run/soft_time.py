"""Why a run in real time is soft: what a compiled cycle cannot do, and Python does in its place."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from rig.network.raw_bus import can_open
from rig.run.hard_loop import needs_soft_loop
from rig.run.job import Job
from rig.sequences.faults import Schedule


def explain_soft_time(job: Job) -> str:
    """One sentence that says which cycles of a real-time run are Python and why; empty if all are compiled."""
    from rig.nodes.emulator_cycle import can_inject

    if not job.realtime:
        return ""
    if not can_open(job.bus):
        return f"the cycles run in Python, because compiled code cannot use the bus {job.bus}"
    reasons = []
    for who, needs_python in (("the rig's cycle", needs_soft_loop),
                              ("the plant emulator's cycle", lambda schedule: not can_inject(schedule))):
        faults = list_faults(job, needs_python)
        if faults and (who.startswith("the rig") or job.plant != "external"):
            word = "faults" if len(faults) > 1 else "fault"
            reasons.append(f"{who} runs in Python, because its compiled one cannot inject the {word} "
                           f"{', '.join(map(repr, faults))}")
    return "; ".join(reasons)


def list_faults(job: Job, needs_python: Callable[[Schedule], bool]) -> list[str]:
    """The faults of a job's sequence that a compiled cycle cannot inject, as events name them."""
    plan, values = job.scenario.plan, job.model.values
    return [fault.label for fault in plan.faults if needs_python(Schedule(replace(plan, faults=(fault,)), values))]
