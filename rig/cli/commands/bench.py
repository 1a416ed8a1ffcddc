"""`rig bench`: the project's own benchmarks. Each loads what it measures, and nothing else."""
from __future__ import annotations

import argparse
import os
from pathlib import Path

from fdi.progress import Progress
from fdi.report.report import Report
from plant.errors import InputError
from rig.cli.answer import Places, give_answer, show_progress


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a target of the cycle in real time that could be measured is not met."""
    measure = {"plant": measure_plant, "realtime": measure_cycle, "live": measure_live, "recordings": measure_analyses}
    is_realtime = args.what in ("realtime", "live")
    with show_progress(is_silent=args.json or args.quiet, is_realtime=is_realtime) as progress:
        report = measure[args.what](args, progress)
    is_missed = any(not each["is_met"] for each in report.data.get("targets", ()) if each["value"] is not None)
    return give_answer(report, args, int(is_missed), Places(answer=Path(args.out) if args.out else None))


def measure_plant(args: argparse.Namespace, progress: Progress) -> Report:
    """The speed of the plant; with --accuracy also the error of its step."""
    from rig.bench.plant import build_plant_report, measure_accuracy, run_benchmarks
    from rig.sequences import load_sequence

    command = load_sequence("preflight").main_profile().command
    figures = run_benchmarks(command, progress)
    if args.accuracy:
        progress("accuracy of the step", 0.0)
        figures["accuracy"] = measure_accuracy(command)
    return build_plant_report(figures)


def measure_cycle(args: argparse.Namespace, progress: Progress) -> Report:
    """The cycle in real time."""
    from rig.bench.realtime import build_realtime_report, measure_realtime

    return build_realtime_report(measure_realtime(choose_bus(args, 0.5), args.seconds, args.blocks, progress))


def measure_live(args: argparse.Namespace, progress: Progress) -> Report:
    """Runs with and without the live screen."""
    from rig.bench.realtime import build_live_runs_report, measure_live_runs

    return build_live_runs_report(measure_live_runs(choose_bus(args, 1.0), args.seconds, args.blocks, progress))


def measure_analyses(args: argparse.Namespace, progress: Progress) -> Report:
    """The cost of an analysis by length of the recording.

    Raises:
        InputError: lengths that are no numbers, or too small.
    """
    from rig.bench.plant import build_long_recordings_report, measure_long_recordings

    try:
        lengths = [float(word) for word in args.lengths.split(",")]
    except ValueError:
        lengths = []
    if not lengths or not all(5.0 <= length <= 7200.0 for length in lengths):
        raise InputError("--lengths", args.lengths, "seconds from 5 to 7200, separated by commas")
    return build_long_recordings_report(measure_long_recordings(lengths, 0, progress))


def choose_bus(args: argparse.Namespace, least_block: float) -> str:
    """The bus of a benchmark in real time: --bus, or a UDP group of this process's own.

    Raises:
        InputError: a time for each block below `least_block` s, or no block.
    """
    if args.blocks < 1:
        raise InputError("--blocks", str(args.blocks), "1 or more")
    if not args.seconds >= least_block * args.blocks:
        raise InputError("--seconds", f"{args.seconds:g}", f"{least_block:g} s or more for each block")
    bus: str = args.bus
    return f"udp_multicast:239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}" if bus == "auto" else bus
