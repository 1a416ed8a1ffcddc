"""`rig node`: one node of the bench on a bus, to face real hardware."""
from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from rig.network.frame import Node, Send
    from rig.network.link import Link
    from rig.nodes.scenario import Scenario

LISTENING_TIME = 0.25  # s; two heartbeats of a node of ours


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig node`."""
    parser.add_argument("node", choices=("plant", "controller"),
                        help="plant: the plant emulator, CANopen node 3; controller: the reference firmware of the "
                             "controller, CANopen node 2")
    parser.add_argument("--bus", default="auto", metavar="INTERFACE:CHANNEL",
                        help="the bus to join: socketcan:can0 is a CAN interface, udp_multicast works between programs "
                             "on this machine (needed, unless EHA_RIG_BUS names a bus)")
    parser.add_argument("--parent", type=int, default=0, help=argparse.SUPPRESS)  # the node ends when this process ends
    options.add_model_options(parser.add_argument_group(
        "model", "The emulator simulates it and the firmware takes its gains from it, until a rig on the bus loads "
                 "another. The bench drives servovalves: ehs and servo are refused."))


def run_command(args: argparse.Namespace) -> int:
    """It runs until Ctrl-C or SIGTERM ends it, then reports the frames that it lost.

    It runs with --model, --set and --seed until a rig loads another scenario.

    Raises:
        InputError: no bus between programs, a model that the bench cannot drive, or a place that cannot be written.
        RigError: the bus cannot be opened, or a node with this number is on it.
    """
    import json
    import signal

    from fdi.output import require_writable, write_text
    from fdi.report.report import Report
    from plant import InputError
    from rig.cli.answer import show_answer
    from rig.network.bus import choose_bus, open_can
    from rig.network.clock import WallClock
    from rig.network.link import Link, serve_node
    from rig.network.raw_bus import can_open
    from rig.run.participants import EMBEDDED_NAMES
    from rig.run.priority import LOOP_PRIORITY, lock_memory, raise_priority

    bus, _ = choose_bus(args.bus)
    if bus.partition(":")[0] in EMBEDDED_NAMES:
        given = "" if args.bus == "auto" else args.bus
        raise InputError("--bus", given, "a bus between programs, such as udp_multicast or socketcan:vcan0")
    if args.out is not None:
        require_writable(args.out, "--out")
    is_compiled = args.node == "plant" and can_open(bus)
    clock = WallClock()
    ended: list[int] = []
    with contextlib.ExitStack() as stack:
        link = Link(open_can(bus), clock.now)
        opened_ns = clock.now()
        stack.callback(link.close)
        if is_compiled:
            node = open_compiled_plant(args, bus, link, stack, stack.enter_context(lock_memory()))
        else:
            node = choose_node(args)(link.send)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda got, frame: ended.append(got))
        require_free_number(args.node, link, bus, LISTENING_TIME - (clock.now() - opened_ns) * 1e-9)
        if args.parent or not (args.quiet or args.json):  # the rig that has started it waits for this line
            kind = "compiled loop" if is_compiled else "Python loop, soft real time"
            print(f"{args.node} on {bus}, {kind}; Ctrl-C ends it", flush=True)
        stack.enter_context(raise_priority(1 if is_compiled else LOOP_PRIORITY))
        serve_node(node, link, clock, lambda: bool(ended) or args.parent not in (0, os.getppid()))
    counts = {"node": args.node, "bus": bus, "lost": link.overflows, "unsent": link.unsent,
              "error_frames": link.error_frames}
    if args.out is not None:
        write_text(args.out, json.dumps(counts, indent=1) + "\n")
    sentence = f"incoming frames lost {link.overflows}, not sent {link.unsent}, error frames {link.error_frames}"
    show_answer(Report("node", args.node, sentence=sentence, data=counts), args)
    return 0


def require_free_number(name: str, link: Link, bus: str, seconds: float) -> None:
    """Refuse to join a bus on which a node with our number has been heard since `link` was opened.

    Two nodes with one number would both answer, and the bench would see a node that leaves OPERATIONAL at random.

    Args:
        name: of our node, plant or controller.
        link, bus: what it is about to join.
        seconds: how long to listen still; most nodes need more time than enough to load.

    Raises:
        RigError: such a node.
    """
    import time

    from plant.errors import RigError
    from rig.network import heartbeat
    from rig.network.node_objects import NAMES

    number = next(node for node, known in NAMES.items() if known == name)
    time.sleep(max(0.0, seconds))
    if any(frame.cob_id == heartbeat.COB_ID + number for frame in link.poll()):
        raise RigError(f"{bus}: a node {number} ({name}) is on this bus already; stop it before you start another one")


def open_compiled_plant(args: argparse.Namespace, bus: str, link: Link, stack: contextlib.ExitStack,
                        is_locked: bool) -> Node:
    """The plant emulator with its loop in compiled code; `link` is for its services. `stack` closes it."""
    from rig.network.raw_bus import open_raw_bus
    from rig.nodes.emulator_service import LEFT_OUT, EmulatorService
    from rig.run.priority import enter_loop_thread

    raw = stack.enter_context(open_raw_bus(bus))
    link.leave_out(LEFT_OUT)
    service = EmulatorService(link.send, raw, enter_loop_thread, choose_scenario(args), is_locked)
    stack.callback(service.close)
    return service


def choose_node(args: argparse.Namespace) -> Callable[[Send], Node]:
    """A function that builds the node which the options describe."""
    from rig.network.node_objects import read_gains
    from rig.nodes.emulator import Emulator
    from rig.nodes.firmware import Firmware
    from rig.nodes.scenario import require_servovalve

    if args.node == "plant":
        return lambda send: Emulator(send, choose_scenario(args))
    model = options.load_chosen_model(args)
    require_servovalve(model)
    return lambda send: Firmware(send, read_gains(model), model)


def choose_scenario(args: argparse.Namespace) -> Scenario:
    """The plant that the options describe, without faults."""
    from rig.nodes.scenario import Scenario, require_servovalve
    from rig.sequences.faults import Plan

    model = options.load_chosen_model(args)
    require_servovalve(model)
    return Scenario(model, Plan(stop=0), (), args.seed)
