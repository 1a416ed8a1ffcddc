"""`rig node`: one node of the bench on a bus, to face real hardware."""
from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from rig.network.frame import Node, Send


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig node`."""
    parser.add_argument("node", choices=("plant", "controller"),
                        help="plant: the plant emulator, node 3; controller: the reference firmware, node 2")
    parser.add_argument("--bus", default="auto", metavar="INTERFACE:CHANNEL",
                        help="for example socketcan:vcan0 or udp_multicast (default: the value of EHA_RIG_BUS)")
    parser.add_argument("--parent", type=int, default=0, help=argparse.SUPPRESS)  # the node ends when this process ends
    options.add_model_options(parser)


def run_command(args: argparse.Namespace) -> int:
    """Run the plant emulator (node 3) or the reference firmware (node 2) until Ctrl-C or SIGTERM ends it.

    It runs with --model, --set and --seed until a rig loads another scenario.
    """
    import signal

    from plant import InputError
    from rig.network.bus import choose_bus, open_can
    from rig.network.clock import WallClock
    from rig.network.link import Link
    from rig.network.wire import serve_node
    from rig.run.participants import EMBEDDED_NAMES
    from rig.run.priority import raise_priority

    bus, _ = choose_bus(args.bus)
    if bus.partition(":")[0] in EMBEDDED_NAMES:
        raise InputError("--bus", args.bus, "a bus between programs, such as udp_multicast or socketcan:vcan0")
    make = choose_node(args)
    clock = WallClock()
    link = Link(open_can(bus), clock.now)
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, frame: ended.append(got))
    node = make(link.send)
    if not args.quiet:
        print(f"{args.node} on {bus}; Ctrl-C ends it", flush=True)
    try:
        with raise_priority():
            serve_node(node, link, clock, lambda: bool(ended) or args.parent not in (0, os.getppid()))
    finally:
        link.close()
    if not args.quiet:
        print(f"{args.node}: incoming frames lost {link.overflows}, not sent {link.unsent}, "
              f"error frames {link.error_frames}")
    return 0


def choose_node(args: argparse.Namespace) -> Callable[[Send], Node]:
    """A function that builds the node which the options describe."""
    from rig.nodes.emulator import Emulator
    from rig.nodes.firmware import Firmware, read_gains
    from rig.nodes.scenario import Scenario, require_servovalve
    from rig.sequences.faults import Plan

    model = options.load_chosen_model(args)
    require_servovalve(model)
    if args.node == "plant":
        return lambda send: Emulator(send, Scenario(model, Plan(stop=0), (), args.seed))
    return lambda send: Firmware(send, read_gains(model), model)
