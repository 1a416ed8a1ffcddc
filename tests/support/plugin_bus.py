"""Pytest plugin: leaves the tests on socketcan to the guest where there is one.

A test belongs to a bus when its parameters name one (the `bus_kind` fixture). On a kernel without vcan0, but with the
User-Mode-Linux guest at hand, the socketcan tests are taken out here and run once, all together, inside the guest by
vcan/test_vcan_guest.py.
"""

import os

import pytest
from vcan_host import guest_missing, kernel_has_vcan0

from rig.network.bus import explain_socketcan_problem

BUSES = ("embedded", "virtual", "udp_multicast", "socketcan")
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
    has_runner = any(item.nodeid.startswith(RUNNER) for item in items)
    items.sort(key=lambda item: not item.nodeid.startswith(RUNNER))
    if not has_runner or kernel_has_vcan0() or guest_missing():
        return
    guest_items = [item for item in items if bus_of(item.nodeid) == "socketcan"]
    config.stash[LEFT_TO_GUEST] = len(guest_items)
    if guest_items:
        config.hook.pytest_deselected(items=guest_items)
        items[:] = [item for item in items if bus_of(item.nodeid) != "socketcan"]
