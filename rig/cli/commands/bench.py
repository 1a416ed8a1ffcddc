"""`rig bench`: the project's own benchmarks."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdi.progress import Progress
from fdi.report import Report
from plant import require
from rig.bench.benchmarks import (
    build_plant_report,
    build_realtime_report,
    choose_bus,
    measure_accuracy,
    measure_realtime,
    run_benchmarks,
)
from rig.cli import Places, give_answer, show_progress
from rig.sequences import load_sequence

REALTIME: Mapping[str, Any] = {"bus": "auto", "seconds": 60.0, "blocks": 6}  # options of rig bench realtime alone


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a target of the cycle in real time that could be measured is not met."""
    is_realtime = args.what == "realtime"
    options = {name: value for name, value in vars(args).items() if name in REALTIME and value is not None}
    require(is_realtime or not options, f"--{next(iter(options), '')}", "", "rig bench realtime")
    with show_progress(args, is_realtime=is_realtime) as progress:
        report = measure_cycle({**REALTIME, **options}, progress) if is_realtime else measure_plant(args, progress)
    is_missed = any(not each["is_met"] for each in report.data.get("targets", ()) if each["value"] is not None)
    return give_answer(report, args, int(is_missed), Places(answer=Path(args.out) if args.out else None))


def measure_plant(args: argparse.Namespace, progress: Progress) -> Report:
    """The speed of the plant; with --accuracy also the error of its step."""
    command = load_sequence("preflight").build_main_profile().command
    figures = run_benchmarks(command, progress)
    if args.accuracy:
        progress("accuracy of the step", 0.0)
        figures["accuracy"] = measure_accuracy(command)
    return build_plant_report(figures)


def measure_cycle(options: Mapping[str, Any], progress: Progress) -> Report:
    """The cycle in real time."""
    return build_realtime_report(measure_realtime(choose_bus(**options), options["seconds"], options["blocks"],
                                                  progress))
