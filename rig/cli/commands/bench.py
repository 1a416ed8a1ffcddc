"""`rig bench`: the project's own benchmarks."""
from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig bench`."""
    parser.add_argument("what", nargs="?", default="plant",
                        choices=("plant", "realtime", "live", "recordings"),
                        help="plant: speed of the plant, compared with C (default); "
                             "realtime: lateness and response of the cycle, compared with cyclictest and C; "
                             "live: the same with and without rig run --live; "
                             "recordings: CPU time and memory of compare, explain and fdi by length of the recording")
    parser.add_argument("--accuracy", action="store_true",
                        help="also the error of the default step size and of others, against 0.2 us (half a minute)")
    add = parser.add_argument_group("rig bench realtime, rig bench live").add_argument
    add("--bus", default="auto", metavar="INTERFACE:CHANNEL",
        help="socketcan:vcan0 or udp_multicast:GROUP (default: a UDP group of its own)")
    add("--seconds", type=float, default=60.0, metavar="S",
        help="time of measurement for each row of the table (default: 60)")
    add("--blocks", type=int, default=6, metavar="N",
        help="alternating blocks into which this time is divided (default: 6)")
    add = parser.add_argument_group("rig bench recordings").add_argument
    add("--lengths", default="13.5,60,300,1800", metavar="S,S,..",
        help="lengths of the recordings, s (default: 13.5,60,300,1800)")


def run_command(args: argparse.Namespace) -> int:
    """Without an argument: the speed of the plant, compared with C."""
    if args.what == "realtime":
        return _run_realtime(args)
    if args.what == "live":
        return _run_live(args)
    if args.what == "recordings":
        return _measure_recordings(args)
    from fdi.output import write_text
    from rig.bench.plant import build_plant_report, measure_accuracy, run_benchmarks
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.sequences import load_sequence

    command = load_sequence("preflight").main_profile().command
    with show_progress(is_silent=args.json or args.quiet) as progress:
        figures = run_benchmarks(command, progress)
        if args.accuracy:
            progress("accuracy of the step", 0.0)
            figures["accuracy"] = [row._asdict() for row in measure_accuracy(command)]
    if args.out is not None:
        write_text(args.out, json.dumps(figures, indent=1) + "\n")
    show_answer(build_plant_report(figures), args)
    return 0


def choose_bench_bus(args: argparse.Namespace, least_block: float) -> str:
    """The bus of a benchmark in real time: --bus, or a UDP group of this process's own.

    Raises:
        InputError: a time for each block below `least_block` s, or no block.
    """
    import os

    from plant.errors import InputError

    if args.blocks < 1:
        raise InputError("--blocks", str(args.blocks), "1 or more")
    if not args.seconds >= least_block * args.blocks:
        raise InputError("--seconds", f"{args.seconds:g}", f"{least_block:g} s or more for each block")
    number = os.getpid()
    bus: str = args.bus
    return f"udp_multicast:239.74.{number >> 8 & 255}.{number & 255}" if bus == "auto" else bus


def _run_realtime(args: argparse.Namespace) -> int:
    """The cycle in real time; exit status 0 if every target that could be measured is met, 1 otherwise.

    Raises:
        InputError: a bus that compiled code cannot use, or a time or number of blocks that is too small.
    """
    from fdi.output import write_text
    from rig.bench.realtime import build_realtime_report, measure_realtime
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress

    bus = choose_bench_bus(args, 0.5)
    with show_progress(is_silent=args.json or args.quiet, is_realtime=True) as progress:
        figures = measure_realtime(bus, args.seconds, args.blocks, progress)
    if args.out is not None:
        write_text(args.out, json.dumps(figures, indent=1) + "\n")
    show_answer(build_realtime_report(figures), args)
    return 0 if all(target["is_met"] for target in figures["targets"] if target["value"] is not None) else 1


def _run_live(args: argparse.Namespace) -> int:
    """Runs with and without the live screen; exit status 0.

    Raises:
        InputError: a bus that compiled code cannot use, or a time or number of blocks that is too small.
        RigError: a run that came to no verdict.
    """
    from fdi.output import write_text
    from fdi.report.json import to_json
    from rig.bench.live import build_live_runs_report, measure_live_runs
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress

    bus = choose_bench_bus(args, 1.0)
    with show_progress(is_silent=args.json or args.quiet, is_realtime=True) as progress:
        figures = measure_live_runs(bus, args.seconds, args.blocks, progress)
    report = build_live_runs_report(figures)
    if args.out is not None:
        write_text(args.out, to_json(figures) + "\n")
    show_answer(report, args)
    return 0


def _measure_recordings(args: argparse.Namespace) -> int:
    """The cost of an analysis by length of the recording; exit status 0.

    Raises:
        InputError: lengths that are no numbers, or too small.
    """
    from fdi.output import write_text
    from plant.errors import InputError
    from rig.bench.recordings import build_long_recordings_report, measure_long_recordings
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress

    try:
        lengths = [float(word) for word in args.lengths.split(",")]
    except ValueError:
        lengths = []
    if not lengths or not all(5.0 <= length <= 7200.0 for length in lengths):
        raise InputError("--lengths", args.lengths, "seconds from 5 to 7200, separated by commas")
    with show_progress(is_silent=args.json or args.quiet) as progress:
        figures = measure_long_recordings(lengths, args.seed, progress)
    if args.out is not None:
        write_text(args.out, json.dumps(figures, indent=1) + "\n")
    show_answer(build_long_recordings_report(figures), args)
    return 0
