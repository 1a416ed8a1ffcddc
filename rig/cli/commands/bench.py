"""`rig bench`: the project's own benchmarks."""

import argparse
from pathlib import Path

from fdi.progress import Progress
from fdi.report.report import Report
from rig.cli.answer import Places, give_answer, show_progress


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a target of the cycle in real time that could be measured is not met."""
    is_realtime = args.what == "realtime"
    with show_progress(args, is_realtime=is_realtime) as progress:
        report = measure_cycle(args, progress) if is_realtime else measure_plant(args, progress)
    is_missed = any(not each["is_met"] for each in report.data.get("targets", ()) if each["value"] is not None)
    return give_answer(report, args, int(is_missed), Places(answer=Path(args.out) if args.out else None))


def measure_plant(args: argparse.Namespace, progress: Progress) -> Report:
    """The speed of the plant; with --accuracy also the error of its step."""
    from rig.bench.benchmarks import build_plant_report, measure_accuracy, run_benchmarks
    from rig.sequences import load_sequence

    command = load_sequence("preflight").main_profile().command
    figures = run_benchmarks(command, progress)
    if args.accuracy:
        progress("accuracy of the step", 0.0)
        figures["accuracy"] = measure_accuracy(command)
    return build_plant_report(figures)


def measure_cycle(args: argparse.Namespace, progress: Progress) -> Report:
    """The cycle in real time."""
    from rig.bench.benchmarks import build_realtime_report, choose_bus, measure_realtime

    bus = choose_bus(args.bus, args.seconds, args.blocks)
    return build_realtime_report(measure_realtime(bus, args.seconds, args.blocks, progress))
