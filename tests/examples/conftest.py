"""Shared by the tests of the controllers in examples/."""

import pytest
from bus_stations import spec
from plugin_bus_summary import require_bus_kind


@pytest.fixture(params=["udp_multicast"])
def bus_kind(request: pytest.FixtureRequest) -> str:
    """A back end for programs of their own; what a bus can change is tested on both of them (`on_each_bus`)."""
    return require_bus_kind(request.param)


@pytest.fixture
def where(bus_kind: str) -> str:
    """A bus that nobody else uses."""
    return spec(bus_kind)
