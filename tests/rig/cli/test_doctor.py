"""`rig doctor`: every finding helps, nothing is claimed that is not so, and the lateness figures are right."""
from __future__ import annotations

import json
import os
import socket
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from rig_command import answer, rig

from rig import doctor
from rig.run import priority


@pytest.fixture(scope="module")
def findings() -> list[doctor.Finding]:
    return doctor.examine_machine(seconds=0.05)


def test_each_finding_is_there_once_and_says_what_it_is_for_and_how_to_get_it(findings: list[doctor.Finding]) -> None:
    for finding in findings:
        assert finding.area and finding.name and finding.found and finding.purpose, finding
        assert bool(finding.remedy) == (finding.status != "ok"), finding
    names = {finding.name for finding in findings}
    assert len(names) == len(findings) and names >= {
        "Python", "packages", "CAN in the kernel", "CAN interface", "CAN guest", "rerun", "Vulkan", "C compiler",
        "compiled code", "disk", "kernel", "priority", "memory lock", "clock", "timer at 1 kHz"}


def test_can_finding_is_true(findings: list[doctor.Finding]) -> None:
    status = next(finding.status for finding in findings if finding.name == "CAN in the kernel")
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        assert status == "ok"
    except OSError:
        assert status == "missing"


def test_versions_are_the_installed_ones(findings: list[doctor.Finding]) -> None:
    assert any(finding.name == "packages" and f"numpy {np.__version__}" in finding.found for finding in findings)
    extras = {"view", "dev", "fleet", "learn", "bench", "measure", "plots", "shell", "docs"}
    assert set(doctor.read_requirements()) == {""} | extras
    assert doctor.read_versions(["no-such-distribution"]) == {"no-such-distribution": ""}


def test_a_missing_package_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(doctor, "read_requirements", lambda: {"": ["numpy", "no-such-distribution"]})
    said = rig("doctor", "--seconds", "0")
    assert said.status == 1 and "missing: no-such-distribution" in said.out
    assert said.out.splitlines()[0] == "FAIL  The bench cannot run without: packages."


def test_tools_that_are_not_there_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_SEARCH_PATH", "/nowhere")
    found = {finding.name: finding for finding in [*doctor.examine_tools(), *doctor.examine_buses()]}
    assert found["C compiler"].status == "missing" and "gcc" in found["C compiler"].remedy
    assert found["CAN guest"].remedy == "apt-get install user-mode-linux kmod iproute2"


def test_json_is_one_object_and_nothing_else(tmp_path: Path) -> None:
    told = answer("doctor", "--seconds", "0", "--out", tmp_path / "doctor.json")
    assert told == json.loads((tmp_path / "doctor.json").read_text()) and told["verdict"] == "PASS"
    assert {"area", "name", "status", "found", "purpose", "remedy", "needed"} == set(told["findings"][0])
    assert rig("doctor", "--seconds", "0", "--quiet") == (0, "", "")


def test_percentiles_of_known_wake_ups() -> None:
    late = np.arange(1001) * 2000  # 0 to 2 ms in steps of 2 us
    assert priority.summarise_lateness(late, 1_000_000) == pytest.approx((1000, 1980, 1998, 2000, 1001, 501))


def test_timer_lateness_counts_its_periods() -> None:
    late = priority.measure_timer_lateness(0.05)
    assert late.periods == 50 and 0 <= late.p50 <= late.p99 <= late.p99_9 <= late.max


def test_fifo_ends_with_its_thread_and_is_none_without_the_right(monkeypatch: pytest.MonkeyPatch) -> None:
    assert priority.run_under_fifo(lambda: os.sched_getscheduler(0)) in (None, os.SCHED_FIFO)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    monkeypatch.setattr("os.sched_setscheduler", Mock(side_effect=PermissionError))
    assert priority.run_under_fifo(lambda: True) is None
