"""The canopen library as master through both kinds of wire, and what it is kept from: malformed frames, strangers."""

import contextlib
import threading
from collections.abc import Iterator

import codec
import pytest
from bus_stations import spec

from plant import Model
from rig.benches.bench_file import load_bench
from rig.network.bus import EmbeddedWire, Link, LinkWire, Wire, open_can, serve_node
from rig.network.frame import VirtualClock, WallClock
from rig.network.master import BusError, Master
from rig.network.node_objects import CONTROLLER, PLANT
from rig.nodes.emulator import Emulator
from rig.nodes.firmware import Firmware
from rig.nodes.scenario import Scenario
from rig.sequences.faults import Plan

SCENARIO = Scenario(Model(), Plan(stop=10)).to_bytes()


@contextlib.contextmanager
def served(where: str, *makers: type[Emulator] | type[Firmware]) -> Iterator[None]:
    """Nodes on a bus between programs, each in a thread of its own."""
    over = threading.Event()
    links, threads = [], []
    for make in makers:
        clock = WallClock()
        links.append(Link(open_can(where), clock.now))
        links[-1].select_nodes(3)
        threads.append(threading.Thread(target=serve_node, args=(make(links[-1].send), links[-1], clock, over.is_set)))
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()
        for link in links:
            link.close()


@pytest.fixture
def wire(bus_kind: str) -> Iterator[Wire]:
    if bus_kind == "embedded":
        yield EmbeddedWire(VirtualClock(), [Emulator, Firmware])
        return
    where, clock = spec(bus_kind), WallClock()
    with served(where, Emulator, Firmware):
        link = LinkWire(Link(open_can(where), clock.now), clock)
        yield link
        link.close()


def alone() -> Master:
    """A master with nobody opposite."""
    return Master(EmbeddedWire(VirtualClock(), []), lambda: 0, False, load_bench())


def test_bring_up_and_some_cycles(wire: Wire) -> None:
    """Boot-up, scenario, gains, heartbeats, start: what a run begins with; then SYNCs that all nodes answer."""
    master = Master(wire, wire.clock.now, False, load_bench())
    seen: list[tuple[int, int]] = []
    frames: list[int] = []
    master.hooks.on_state = lambda node, state: seen.append((node, state))
    master.hooks.on_frame = lambda frame: frames.append(frame.cob_id)
    master.reset()
    master.configure(SCENARIO, Model().values, 0)
    master.start()
    assert wire.wait(lambda: set(master.states.values()) == {5}, 60.0)
    cycle = {codec.FEEDBACK, codec.VALVE_STATE, codec.DRIVE}
    for k in range(20):
        frames.clear()
        master.send(codec.COMMAND, codec.pack_command(1e-3, 7, k))
        master.send(codec.SYNC, b"")
        assert wire.wait(lambda: cycle <= set(frames), 60.0)
    master.stop()
    assert wire.wait(lambda: set(master.states.values()) == {127}, 60.0)
    for node in (CONTROLLER, PLANT):
        states = [state for n, state in seen if n == node]
        assert 0 in states and states[-2:] == [5, 127]  # a heartbeat may come before the boot-up
    assert master.list_errors() == [] and not master.hears_rival(0.0)
    assert master.is_present(PLANT, 60.0) and master.is_present(CONTROLLER, 60.0)


def test_a_rig_that_stood_still_knows_how_long_answers_may_have_waited(wire: Wire) -> None:
    """An answer that has come while the rig stood still counts, and its time is known to be uncertain."""
    if isinstance(wire, EmbeddedWire):
        pytest.skip("there the nodes stand still with the rig")
    master = Master(wire, wire.clock.now, False, load_bench())
    master.reset()
    master.configure(SCENARIO, Model().values, 0, 10_000)
    master.start()
    threading.Event().wait(1.2)
    times = master.wait_for_operational(0.0)  # the time to wait is over at once
    assert set(times) == {CONTROLLER, PLANT}
    for time in times.values():
        assert time.seconds >= time.waited >= 1.1
    assert wire.stalled_ns >= 1_100_000_000


def test_refusals_name_node_and_object(wire: Wire) -> None:
    master = Master(wire, wire.clock.now, False, load_bench())
    master.reset()
    with pytest.raises(BusError, match=r"node 3 plant, object 0x2210: .*0x06090030"):
        master.configure(b"nonsense", None, 0)
    with pytest.raises(BusError, match=r"node 2 controller, object 0x2110:1: .*0x06090030"):
        master.configure(SCENARIO, {**Model().values, "controller.proportional_gain": float("nan")}, 0)


def test_nobody_there() -> None:
    master = alone()
    with pytest.raises(BusError, match=r"no boot-up from node 2 controller and node 3 plant within 2 s"):
        master.reset()
    with pytest.raises(BusError, match=r"node 3 plant, object 0x2210"):
        master.configure(SCENARIO, None, 0)
    assert not master.is_present(PLANT, 0.1)
