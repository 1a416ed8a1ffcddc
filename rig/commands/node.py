"""`rig node`: one node of the bench on a bus, to face real hardware."""
from __future__ import annotations

import argparse
import os
from pathlib import Path

from rig import options

HELP = "run one node (plant or controller) on a bus, to face real hardware"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("node", choices=("plant", "controller"), help="which node to be")
    parser.add_argument("--bus", default="auto", metavar="INTERFACE:CHANNEL",
                        help="such as socketcan:vcan0 or udp_multicast (default: what EHA_RIG_BUS names)")
    parser.add_argument("--parent", type=int, default=0, help=argparse.SUPPRESS)  # ends when this process does
    parser.add_argument("--effects", action="append", default=[], type=Path, metavar="FILE.py",
                        help="your own effects, for the plant (repeatable)")


def run(args: argparse.Namespace) -> int:
    """Be the plant emulator (node 3) or the reference firmware (node 2) until a signal ends it."""
    import signal

    from plant import InputError
    from rig.bus import choose, open_can
    from rig.clock import WallClock
    from rig.crew import EMBEDDED
    from rig.emulator import Emulator
    from rig.firmware import Firmware
    from rig.link import Link
    from rig.priority import elevated
    from rig.wire import serve

    bus, _ = choose(args.bus)
    if bus.partition(":")[0] in EMBEDDED:
        raise InputError("--bus", args.bus, "a bus between programs, such as udp_multicast or socketcan:vcan0")
    options.load_user_effects(args.effects)
    clock = WallClock()
    link = Link(open_can(bus), clock.now)
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, frame: ended.append(got))
    node = (Emulator if args.node == "plant" else Firmware)(link.send)
    if not args.quiet:
        print(f"{args.node} on {bus}; Ctrl-C ends it", flush=True)
    try:
        with elevated():
            serve(node, link, clock, lambda: bool(ended) or args.parent not in (0, os.getppid()))
    finally:
        link.close()
    if not args.quiet:
        print(f"{args.node}: frames lost on the way in {link.overflows}, not sent {link.unsent}, "
              f"error frames {link.error_frames}")
    return 0
