"""Shared by all tests."""
from __future__ import annotations

import os

import pytest

from rig.bus import socketcan_problem

pytest_plugins = ["plugin_bus_summary"]


@pytest.fixture(params=["embedded", "virtual", "udp_multicast", "socketcan"])
def bus_kind(request: pytest.FixtureRequest) -> str:
    """The back end a bus test runs on. Without vcan0 the socketcan ones skip, or fail with EHA_RIG_REQUIRE_VCAN=1."""
    kind: str = request.param
    problem = socketcan_problem("vcan0") if kind == "socketcan" else ""
    if problem and os.environ.get("EHA_RIG_REQUIRE_VCAN") == "1":
        pytest.fail(problem)
    if problem:
        pytest.skip(problem)
    return kind
