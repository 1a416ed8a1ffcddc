"""`rig conformance`: test a CANopen node against CiA 301 and its EDS."""
from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.network.link import Wire

OWN_NODES = {"controller": 2, "plant": 3, "c": 2}  # c: the controller in C, rig/firmware


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig conformance`."""
    add = parser.add_argument
    add("node", metavar="NODE",
        help="node-ID of a node on the bus, 1 to 127; or plant, controller or c (the controller in C): our own, "
             "started by this command")
    add("--bus", default="auto", metavar="INTERFACE:CHANNEL",
        help="for example socketcan:can0 or udp_multicast; our own nodes also run on the embedded bus (default)")
    add("--eds", type=Path, metavar="FILE", help="electronic data sheet of the node (our own nodes have theirs)")
    add("--chapter", action="append", default=[], metavar="N[.M]", help="only this chapter or test (repeatable)")
    add("--write", action="store_true",
        help="also change values of manufacturer and profile objects, and set them back (always for our own nodes)")
    add("--tolerance", type=float, default=20.0, metavar="MS",
        help="added to each time limit, for the delay of this machine (default 20)")
    add("--timeout", type=float, default=1.0, metavar="S", help="longest wait for an SDO response (default 1)")
    add("--junit", metavar="FILE.xml", help="also write the results as JUnit XML")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a test failed, 3 if none failed and some times could not be measured."""
    from fdi.output import require_writable, write_text
    from plant.errors import InputError
    from rig.cli.answer import choose_file, show_answer
    from rig.cli.progress_bar import show_progress
    from rig.conformance.data_sheet import DataSheet
    from rig.conformance.run_cases import Subject, build_conformance_report, choose_cases, run_cases, write_junit
    from rig.conformance.target import Options, Target
    from rig.network.bus import choose_bus

    node = parse_node(args.node)
    is_own = args.node in OWN_NODES
    sheet = DataSheet(choose_data_sheet(args), node)
    cases = choose_cases(args.chapter)
    for word in args.chapter:
        if not choose_cases([word]):
            raise InputError("--chapter", word, "the number of a chapter, such as 3, or of a test, such as 3.6")
    for option, value, least in (("--tolerance", args.tolerance, 0.0), ("--timeout", args.timeout, 0.01)):
        if not least <= value <= 60_000:
            raise InputError(option, f"{value:g}", f"a number from {least:g}")
    folder = _make_folder(args.out)
    junit = choose_file(args.junit, (".xml",), sheet.path, "--junit")  # may be a file in that folder
    bus, _ = choose_bus(args.bus)
    options = Options(may_write=args.write or is_own, timeout=args.timeout, tolerance=1e-3 * args.tolerance)
    with open_wire(args.node, bus) as wire, show_progress(is_silent=args.json or args.quiet) as progress:
        outcome = run_cases(Target(wire, sheet, options), cases, progress)
    subject = Subject(sheet, bus, options.may_write)
    files = [] if folder is None else [("page", str(folder / "conformance.html")),
                                       ("answer", str(folder / "conformance.json"))]
    files += [("JUnit", str(junit))] if junit else []
    report = build_conformance_report(outcome, subject, files)
    if folder is not None:
        from fdi.report.html import write_html
        from fdi.report.json import to_json

        write_html(report, require_writable(folder / "conformance.html", "--out"))
        write_text(folder / "conformance.json", to_json(report.data) + "\n")
    if junit is not None:
        write_text(junit, write_junit(outcome, subject), "--junit")
    show_answer(report, args)
    return {"PASS": 0, "FAIL": 1, "INVALID_TIMING": 3}[outcome.verdict]


def parse_node(text: str) -> int:
    """The node-ID that the command line names.

    Raises:
        InputError: neither a node-ID nor one of our nodes.
    """
    from plant.errors import InputError

    if text in OWN_NODES:
        return OWN_NODES[text]
    if text.isdigit() and 1 <= int(text) <= 127:
        return int(text)
    raise InputError("NODE", text, "a node-ID from 1 to 127, controller, plant or c")


def choose_data_sheet(args: argparse.Namespace) -> Path:
    """The EDS of --eds, or that of our own node.

    Raises:
        InputError: a foreign node without --eds.
    """
    from dbc import EDS
    from plant.errors import InputError

    if args.eds is not None:
        return Path(args.eds)
    if args.node not in OWN_NODES:
        raise InputError("--eds", "", f"the electronic data sheet of node {args.node}: --eds FILE")
    return EDS[OWN_NODES[args.node]]


@contextlib.contextmanager
def open_wire(node: str, bus: str) -> Iterator[Wire]:
    """Open the bus; start our own node inside this process or as one of its own, unless it is there already.

    Raises:
        InputError: a foreign node on a bus that no other program can reach.
        RigError: the bus cannot be opened, or our own node does not start.
    """
    from plant.errors import InputError
    from rig.network.bus import open_can
    from rig.network.clock import VirtualClock, WallClock
    from rig.network.link import EmbeddedWire, Link, LinkWire
    from rig.run.participants import EMBEDDED_NAMES

    if bus.partition(":")[0] in EMBEDDED_NAMES:
        if node not in ("plant", "controller"):
            raise InputError("--bus", bus, "a bus that the node is on, such as socketcan:can0")
        from rig.nodes.emulator import Emulator
        from rig.nodes.firmware import Firmware

        yield EmbeddedWire(VirtualClock(), [Emulator if node == "plant" else Firmware])
        return
    clock = WallClock()
    wire = LinkWire(Link(open_can(bus), clock.now), clock)
    try:
        with _start_node(node, bus, wire):
            yield wire
    finally:
        wire.close()


@contextlib.contextmanager
def _start_node(name: str, bus: str, wire: Wire) -> Iterator[None]:
    """Start our own node in a process that ends with this one. A node that is there already is tested as it is.

    Raises:
        InputError: the controller in C on a bus that it has no port for, or without a C compiler.
        RigError: it does not boot.
    """
    import os
    import sys

    from plant.errors import RigError
    from rig.firmware.build import build_controller
    from rig.run.participants import NodeProcesses, require_firmware_bus

    if name not in OWN_NODES:
        yield
        return
    booted: list[int] = []
    wire.receive = lambda frame: booted.append(frame.cob_id) if frame.data == b"\0" else None
    boot_up = 0x700 + OWN_NODES[name]
    wire.send(0x000, bytes((130, OWN_NODES[name])))
    if wire.wait(lambda: boot_up in booted, 0.7):
        yield
        return
    if name == "c":
        require_firmware_bus(bus)
        command = [str(build_controller()), bus, "--parent", str(os.getpid())]
    else:
        command = [sys.executable, "-m", "rig.cli.main", "node", name, "--bus", bus, "--quiet", "--parent",
                   str(os.getpid())]
    processes = NodeProcesses()
    processes.start(OWN_NODES[name], command)
    try:
        for _ in range(120):  # s: it may have to compile the plant first
            if wire.wait(lambda: boot_up in booted, 1.0) or processes.find_ended():
                break
        if boot_up not in booted:
            raise RigError(f"our own node {OWN_NODES[name]} ({name}) did not start")
        yield
    finally:
        processes.stop()


def _make_folder(out: str | None) -> Path | None:
    """The folder of --out, made if need be.

    Raises:
        InputError: it cannot be made.
    """
    from plant.errors import InputError

    if out is None:
        return None
    folder = Path(out)
    if folder.suffix in (".html", ".json", ".xml"):
        raise InputError("--out", out, "a folder; the page and the JSON answer go there, JUnit to --junit FILE.xml")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--out", out, f"a folder that can be made ({error.strerror})") from error
    return folder
