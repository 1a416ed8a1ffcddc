"""A node number belongs to one node: a second one does not join the bus, and a run never starts one beside another."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_stations import spec
from rig_command import finished, rig, started
from standing_nodes import wait_for_node

from rig.benches.bench_file import load_bench
from rig.network.bus import Link, LinkWire, open_can
from rig.network.clock import WallClock
from rig.network.master import BusError, Master
from rig.network.node_objects import CONTROLLER, PLANT
from rig.run import participants
from rig.run.participants import NodeProcesses


@pytest.fixture
def where() -> str:
    """A bus of this test's own."""
    return spec("udp_multicast")


@pytest.fixture
def plant(where: str) -> Iterator[None]:
    """A plant emulator that somebody has started on it."""
    process = started("node", "plant", "--bus", where)
    try:
        wait_for_node(where, PLANT)
        yield
        assert process.poll() is None
    finally:
        process.kill()
        finished(process)


@pytest.fixture
def master(where: str) -> Iterator[Master]:
    """The rig's end of the bus."""
    clock = WallClock()
    wire = LinkWire(Link(open_can(where), clock.now), clock, 2.0)
    yield Master(wire, clock.now, False, load_bench())
    wire.close()


def start_plant(where: str) -> NodeProcesses:
    """The rig's own plant, about to load."""
    processes = NodeProcesses()
    words = ["node", "plant", "--bus", where, "--quiet", "--parent", str(os.getpid())]
    processes.start(PLANT, [sys.executable, "-m", "rig.cli.main", *words], announces=True)
    return processes


@pytest.mark.usefixtures("plant")
def test_a_second_node_of_a_number_does_not_start(where: str) -> None:
    said = rig("node", "plant", "--bus", where)
    assert (said.status, said.err.count("\n")) == (2, 1)
    assert f"{where}: a node 3 (plant) is on this bus already; stop it before you start another one" in said.err


def test_our_own_plant_is_waited_for_until_it_is_on_the_bus(where: str, master: Master) -> None:
    processes = start_plant(where)
    try:
        assert not participants.is_replaced(master, PLANT, processes)
        assert not processes.find_ended()
    finally:
        processes.stop()


@pytest.mark.usefixtures("plant")
def test_a_plant_that_came_first_is_used_in_place_of_ours(where: str, master: Master) -> None:
    """On a slow machine a plant that the operator starts together with the run answers after the run has looked."""
    processes = start_plant(where)
    try:
        assert participants.is_replaced(master, PLANT, processes)
        assert not processes.find_ended()  # its end is no trouble of the run
        assert master.is_present(PLANT, 5.0)
    finally:
        processes.stop()


@pytest.mark.usefixtures("plant")
def test_a_run_that_asks_for_its_own_plant_refuses_another_one(where: str, tmp_path: Path) -> None:
    said = rig("run", "--bus", where, "--plant", "builtin", "--out", tmp_path)
    assert said.status == 2
    assert f"a node 3 plant is on {where} already: stop it, or say --plant external" in said.err


def test_a_node_of_ours_that_ends_is_no_node(where: str, master: Master) -> None:
    processes = NodeProcesses()
    processes.start(CONTROLLER, [sys.executable, "-c", "raise SystemExit(2)"], announces=True)
    with pytest.raises(BusError, match=r"our own controller did not start"):
        participants.is_replaced(master, CONTROLLER, processes)
