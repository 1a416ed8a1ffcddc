"""Why a run in real time is soft: compiled cycles need a bus that they can use themselves."""
from __future__ import annotations

from rig.network.raw_bus import can_open
from rig.run.job import Job


def explain_soft_time(job: Job) -> str:
    """One sentence that says why the cycles of a real-time run are Python; empty if they are compiled."""
    if not job.realtime or can_open(job.bus):
        return ""
    return f"the cycles run in Python, because compiled code cannot use the bus {job.bus}"
