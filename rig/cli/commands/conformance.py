"""`rig conformance`: test a CANopen node against CiA 301 and its EDS."""

import argparse
import contextlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from plant import InputError, require
from rig.benches import Role, load_bench
from rig.cli import Places, choose_file, give_answer, make_folder, show_progress
from rig.conformance.run_cases import build_conformance_report, choose_cases, run_cases, write_junit
from rig.conformance.target import DataSheet, Options, Target
from rig.network import EmbeddedWire, Link, LinkWire, Master, VirtualClock, WallClock, Wire, choose_bus, open_can
from rig.nodes import Emulator, Firmware
from rig.run import EMBEDDED_NAMES, NodeProcesses, is_replaced, make_node_command, require_firmware_bus

OWN_NODES = {"controller": Role.CONTROLLER, "plant": Role.PLANT, "c": Role.CONTROLLER}  # c: in C


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a test failed, 3 if none failed and some times could not be measured."""
    name, eds = find_node_of_bench(args) if args.bench else (args.node, args.eds)
    if name is None:
        raise InputError("NODE", "", "a node-ID, plant, controller or c; or --bench FILE")
    node, is_own = parse_node(name), name in OWN_NODES
    require(eds is not None or is_own, "--eds", "",
            f"the electronic data sheet of node {name}: --eds FILE, or --bench FILE")
    sheet = DataSheet(eds or load_bench().nodes[OWN_NODES[name]].eds, node)
    cases = choose_cases(args.chapter)
    for word in args.chapter:
        require(choose_cases([word]), "--chapter", word,
                "the number of a chapter, such as 3, or of a test, such as 3.6")
    for option, value, least in (("--tolerance", args.tolerance, 0.0), ("--timeout", args.timeout, 0.01)):
        require(least <= value <= 60_000, option, f"{value:g}", f"a number from {least:g}")
    places = choose_places(args.out)  # first: the file of --junit may lie in the folder
    places = places._replace(junit=choose_file(args.junit, (".xml",), sheet.path, "--junit"))
    bus, _ = choose_bus(args.bus)
    options = Options(may_write=args.write or is_own, timeout=args.timeout, tolerance=1e-3 * args.tolerance)
    with open_wire(name, bus) as wire, show_progress(args) as progress:
        target = Target(wire, sheet, options)
        outcome = run_cases(target, cases, progress)
    status = {"PASS": 0, "FAIL": 1, "INVALID_TIMING": 3}[outcome.verdict]
    return give_answer(build_conformance_report(outcome, target, bus, places.files), args, status, places,
                       partial(write_junit, outcome, node))


def find_node_of_bench(args: argparse.Namespace) -> tuple[str, Path]:
    """Node-ID and data sheet of the controller, or plant, of a bench.

    Raises:
        InputError: a bench without it.
    """
    bench = load_bench(args.bench, is_trusted=args.trust)
    nodes = {role.name.lower(): node for role, node in bench.nodes.items()}
    node = nodes.get(args.node or "controller")
    if node is None or args.eds is not None:
        raise InputError("--bench", args.bench,
                         f"one of its CANopen nodes ({', '.join(nodes) or 'it has none'}), and no --eds")
    return str(node.node), node.eds


def parse_node(text: str) -> int:
    """The node-ID that the command line names.

    Raises:
        InputError: neither a node-ID nor one of our nodes.
    """
    if text in OWN_NODES:
        return load_bench().nodes[OWN_NODES[text]].node
    if text.isdigit() and 1 <= int(text) <= 127:
        return int(text)
    raise InputError("NODE", text, "a node-ID from 1 to 127, controller, plant or c")


def choose_places(out: str | None) -> Places:
    """The page and the JSON answer in the folder of --out, which is made if need be.

    Raises:
        InputError: it cannot be made.
    """
    if out is None:
        return Places()
    require(not out.endswith((".html", ".json", ".xml")), "--out", out,
            "a folder; the page and the JSON answer go there, JUnit to --junit FILE.xml")
    folder = make_folder(Path(out))
    return Places(folder / "conformance.html", folder / "conformance.json")


@contextlib.contextmanager
def open_wire(node: str, bus: str) -> Iterator[Wire]:
    """Open the bus; start our own node inside this process or as one of its own, unless it is there already.

    Raises:
        InputError: a foreign node on a bus that no other program can reach.
        RigError: the bus cannot be opened, or our own node does not start.
    """
    if bus.partition(":")[0] in EMBEDDED_NAMES:
        require(node in ("plant", "controller"), "--bus", bus, "a bus that the node is on, such as socketcan:can0")
        yield EmbeddedWire(VirtualClock(), [Emulator if node == "plant" else Firmware])
        return
    clock = WallClock()
    wire = LinkWire(Link(open_can(bus), clock.now), clock)
    processes = NodeProcesses()
    try:
        if node in OWN_NODES:
            start_node(node, bus, wire, processes)
        yield wire
    finally:
        processes.stop()
        wire.close()


def start_node(name: str, bus: str, wire: Wire, processes: NodeProcesses) -> None:
    """Start our own node in a process that ends with this one. A node that is there already is tested as it is.

    Raises:
        InputError: the controller in C on a bus that it has no port for, or without a C compiler.
        BusError: it does not boot.
    """
    role, master = OWN_NODES[name], Master(wire, wire.clock.now, False, load_bench())
    if master.is_present(role, 0.7):
        return
    if name == "c":
        require_firmware_bus(bus)
    processes.start(role, make_node_command(role, bus, is_in_c=name == "c"))
    is_replaced(master, role, processes)
