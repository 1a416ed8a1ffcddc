"""Shared by the tests of the controllers in examples/."""
from __future__ import annotations

import pytest
from bus_stations import spec
from plugin_bus_summary import require_bus_kind


@pytest.fixture(params=["udp_multicast", "socketcan"])
def bus_kind(request: pytest.FixtureRequest) -> str:
    """The back ends for programs of their own."""
    return require_bus_kind(request.param)


@pytest.fixture
def where(bus_kind: str) -> str:
    """A bus that nobody else uses."""
    return spec(bus_kind)
