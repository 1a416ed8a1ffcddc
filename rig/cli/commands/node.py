"""`rig node`: one node of the bench on a bus, to face real hardware."""

import argparse
import contextlib
import time

from fdi.output import require_writable
from fdi.report import Report
from plant import RigError, require
from rig.benches import Bench, load_bench
from rig.cli import Places, give_answer, load_chosen_model
from rig.interrupts import catch_signals
from rig.network import (
    CONTROLLER,
    PLANT,
    Link,
    Node,
    RawBus,
    WallClock,
    can_open,
    choose_bus,
    heartbeat,
    open_can,
    read_gains,
    serve_node,
)
from rig.nodes import Emulator, EmulatorService, Firmware, Scenario, find_plant_node, list_unheard
from rig.run import EMBEDDED_NAMES, LOOP_PRIORITY, enter_loop_thread, lock_memory, raise_priority, speaks_as_shipped
from rig.sequences import Plan

LISTENING_TIME = 0.25  # s; two heartbeats of a node of ours


def run_command(args: argparse.Namespace) -> int:
    """It runs with --model, --set and --seed until a rig loads another scenario.

    Raises:
        InputError: no bus between programs, a model that the bench cannot drive, or a place that cannot be written.
        RigError: the bus cannot be opened, or a node with this number is on it.
    """
    bus, _ = choose_bus(args.bus)
    bench = load_bench(args.bench or "eha", is_trusted=args.trust)
    if args.node == "plant":
        find_plant_node(bench)  # refuses a bench without one
        args.model = args.model or bench.plant
    else:
        require(speaks_as_shipped(bench), "--bench", args.bench,
                "a bench with the frames of the shipped one, as our firmware has")
    require(bus.partition(":")[0] not in EMBEDDED_NAMES, "--bus", "" if args.bus == "auto" else args.bus,
            "a bus between programs, such as udp_multicast or socketcan:vcan0")
    places = Places(answer=None if args.out is None else require_writable(args.out, "--out"))
    is_compiled = args.node == "plant" and can_open(bus) and load_chosen_model(args).kind.foreign is None
    clock = WallClock()
    with contextlib.ExitStack() as stack:
        link = Link(open_can(bus, bench.bitrate), clock.now)
        opened_ns = clock.now()
        stack.callback(link.close)
        node = make_node(args, bench, link, stack, is_compiled)
        is_to_stop = stack.enter_context(catch_signals())
        is_to_stop()  # from here on a signal ends the node in order
        role = PLANT if args.node == "plant" else CONTROLLER
        require_free_number(bench.find_number(role), args.node, link, bus,
                            LISTENING_TIME - (clock.now() - opened_ns) * 1e-9)
        if args.announce or not (args.quiet or args.json):
            kind = "compiled loop" if is_compiled else "Python loop, soft real time"
            print(f"{args.node} on {bus}, {kind}; Ctrl-C ends it", flush=True)
        stack.enter_context(raise_priority(1 if is_compiled else LOOP_PRIORITY))
        serve_node(node, link, clock, is_to_stop)
    counts = {"node": args.node, "bus": bus, "lost": link.overflows, "unsent": link.unsent,
              "error_frames": link.error_frames}
    sentence = f"incoming frames lost {link.overflows}, not sent {link.unsent}, error frames {link.error_frames}"
    return give_answer(Report("node", args.node, sentence=sentence, data=counts), args, places=places)


def require_free_number(number: int, name: str, link: Link, bus: str, seconds: float) -> None:
    """Refuse to join a bus on which a node with our number has been heard since `link` was opened.

    Two nodes with one number would both answer, and the bench would see a node that leaves OPERATIONAL at random.

    Args:
        number, name: of our node, which is plant or controller.
        link, bus: what it is about to join.
        seconds: how long to listen still; most nodes need more time than enough to load.

    Raises:
        RigError: such a node.
    """
    time.sleep(max(0.0, seconds))
    if any(frame.cob_id == heartbeat.COB_ID + number for frame in link.poll()):
        raise RigError(f"{bus}: a node {number} ({name}) is on this bus already; stop it before you start another one")


def make_node(args: argparse.Namespace, bench: Bench, link: Link, stack: contextlib.ExitStack,
              is_compiled: bool) -> Node:
    """The node that the options describe. The compiled loop has a socket of its own; `link` is for its services.

    Raises:
        InputError: a model that the bench cannot drive.
    """
    scenario = Scenario(load_chosen_model(args), Plan(stop=0), (), args.seed)
    if is_compiled:
        is_locked = stack.enter_context(lock_memory())
        raw = stack.enter_context(RawBus(choose_bus(args.bus)[0]))
        link.leave_out(list_unheard(bench))
        service = EmulatorService(link.send, raw, enter_loop_thread, scenario, is_locked, bench)
        stack.callback(service.close)
        return service
    return (Emulator(link.send, scenario, bench) if args.node == "plant" else
            Firmware(link.send, read_gains(scenario.model.values), scenario.model))
