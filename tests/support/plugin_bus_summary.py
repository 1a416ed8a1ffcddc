"""Pytest plugin: says how many tests ran on which bus; leaves the socketcan ones to the guest where there is one.

A test belongs to a bus when its parameters name one (the `bus_kind` fixture). On a kernel without vcan0, but with the
User-Mode-Linux guest at hand, the socketcan tests are taken out here and run once, all together, inside the guest by
vcan/test_vcan_guest.py; it records their number as the property `GUEST_TESTS`. A property travels from the worker that
ran the test to the session that prints the summary.
"""

import os
from collections import Counter

import pytest
from vcan_host import APT_LINE, guest_missing, kernel_has_vcan0

from rig.network.bus import explain_socketcan_problem

BUSES = ("embedded", "virtual", "udp_multicast", "socketcan")
GUEST_TESTS = "socketcan tests passed in the guest"  # property of a test: their number
LEFT_TO_GUEST = pytest.StashKey[int]()  # socketcan tests taken out of this session
RUNNER = "tests/vcan/test_vcan_guest.py"


def require_bus_kind(kind: str) -> str:
    """That back end; skips or fails the test that needs one which is not here."""
    problem = explain_socketcan_problem("vcan0") if kind == "socketcan" else ""
    if problem and os.environ.get("EHA_RIG_REQUIRE_VCAN") == "1":
        pytest.fail(problem)
    if problem:
        pytest.skip(problem)
    return kind


def bus_of(nodeid: str) -> str | None:
    """The bus that is one of a test's parameters, e.g. 'virtual' for 'test_bus.py::test_order[virtual]'.

    A command line as a parameter ('[rig run --bus socketcan:can0]') names a bus, too, but runs on none.
    """
    parameters = nodeid.partition("[")[2].removesuffix("]").split("-")
    return next((bus for bus in BUSES if bus in parameters), None)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Take the socketcan tests out if the guest is going to run them, which takes minutes and so comes first."""
    runner_there = any(item.nodeid.startswith(RUNNER) for item in items)
    items.sort(key=lambda item: not item.nodeid.startswith(RUNNER))
    if not runner_there or kernel_has_vcan0() or guest_missing():
        return
    left = [item for item in items if bus_of(item.nodeid) == "socketcan"]
    config.stash[LEFT_TO_GUEST] = len(left)
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if bus_of(item.nodeid) != "socketcan"]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """The tests passed per bus, and what it takes where none ran on a real CAN interface."""
    passed = terminalreporter.stats.get("passed", [])
    properties = [(name, value) for report in passed for name, value in report.user_properties]
    counts = Counter(bus for report in passed if (bus := bus_of(report.nodeid)))
    in_guest = sum(value for name, value in properties if name == GUEST_TESTS)
    if not counts and not in_guest:
        return
    words = [f"{bus} {counts[bus]}" for bus in BUSES[:-1]]
    words.append(f"socketcan {in_guest} (in the guest)" if in_guest else f"socketcan {counts['socketcan']}")
    terminalreporter.write_line("tests per bus: " + ", ".join(words))
    if not in_guest and not counts["socketcan"] and guest_missing():
        terminalreporter.write_line(f"no test ran on a real CAN interface; to get one on this machine: {APT_LINE}")
