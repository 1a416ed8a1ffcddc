"""A run in real time says which of its cycles are Python, and why."""
from __future__ import annotations

from pathlib import Path

import pytest
from short_sequences import SHORT, job, play

from fdi.report.html import render_html
from fdi.report.run_report import build_run_report
from fdi.trace.trace import Trace
from rig.run.job import Job
from rig.run.runner import explain_soft_time

LATE = '{ kind = "late", frame = "command", delay = 1e-4, start = 0.1, end = 0.2 }'
JITTER = '{ kind = "jitter", name = "uneven", size = 2e-4, start = 0.1, end = 0.2 }'
BUS_OFF = '{ kind = "bus_off", node = "plant", start = 0.1, end = 0.2 }'


def make_job(*faults: str, pace: str = "realtime", bus: str = "udp_multicast") -> Job:
    return job(f"faults = [{', '.join(faults)}]\n{SHORT}", pace=pace, bus=bus)


def test_only_real_time_is_soft() -> None:
    assert explain_soft_time(make_job(JITTER, pace="lockstep")) == "" == explain_soft_time(make_job())


def test_the_bus_may_be_the_reason() -> None:
    said = explain_soft_time(make_job(bus="virtual"))
    assert said == "the cycles run in Python, because compiled code cannot use the bus virtual"


def test_no_fault_needs_python() -> None:
    assert explain_soft_time(make_job(LATE, JITTER, BUS_OFF)) == ""


@pytest.mark.parametrize("pace", ["realtime", "lockstep"])
def test_a_run_says_so_in_all_its_results(tmp_path: Path, pace: str) -> None:
    outcome = play(job(pace=pace, max_overruns=1.0), tmp_path)
    said = outcome.to_json()["timing"]
    page = render_html(build_run_report(Trace.read(tmp_path, all=True)))
    reason = "the cycles run in Python, because compiled code cannot use the bus embedded"
    if pace == "realtime":
        assert (said["kind"], said["reason"]) == ("soft real time", reason) and reason in page
    else:
        assert (said["kind"], said["reason"]) == ("lockstep", "") and reason not in page
