"""`rig bench`: the project's own benchmarks."""
from __future__ import annotations

import argparse
import json
from dataclasses import replace
from typing import TYPE_CHECKING

from rig.cli.options import parse_whole_number

if TYPE_CHECKING:
    from rig.studies.resumable.batch import BatchProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig bench`."""
    parser.add_argument("what", nargs="?", default="plant",
                        choices=("plant", "realtime", "live", "explain", "robustness", "faults", "recordings"),
                        help="plant: speed of the plant (default); realtime: lateness and response of the cycle, "
                             "compared with cyclictest and C; live: the same with and without rig run --live; "
                             "explain: how often rig explain is right; "
                             "robustness: fuzz frames, killed processes, full disks, long operation; "
                             "faults: every fault on the bus in every phase of a motion, a matrix; "
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
    add = parser.add_argument_group("rig bench explain", "a blind trial, hours long (docs/trial.md)").add_argument
    add("--cases", type=int, default=200, metavar="N", help="number of cases (default: 200)")
    add("--seed", type=parse_whole_number, default=0, metavar="N",
        help="seed of the first case; each case uses the next seed (default: 0)")
    add("--signals", metavar="NAMES",
        help="measure these in every case: xj or xj,p12 or xj,p12,xs; a seed stays the same case otherwise "
             "(default: random)")
    add("--jobs", type=int, default=2, metavar="N", help="cases at a time; use 1 for reliable timings (default: 2)")
    add("--folder", metavar="DIR", help="keep cases and answers there; an interrupted trial resumes there")
    add = parser.add_argument_group("rig bench recordings").add_argument
    add("--lengths", default="13.5,60,300,1800", metavar="S,S,..",
        help="lengths of the recordings, s (default: 13.5,60,300,1800)")
    add = parser.add_argument_group("rig bench robustness", "hours with the numbers of docs/robustness.md").add_argument
    add("--frames", type=parse_whole_number, default=100_000, metavar="N",
        help="fuzz frames for each node (default: 100000; 0: none)")
    add("--trials", type=parse_whole_number, default=5, metavar="N",
        help="effective disturbances of each kind, one in each run (default: 5; 0: none)")
    add("--minutes", type=float, default=5.0, metavar="N", help="minutes of long operation (default: 5; 0: none)")
    add("--controller", choices=("builtin", "c"), default="builtin", help="firmware of these runs (default: builtin)")


def run_command(args: argparse.Namespace) -> int:
    """Without an argument: the speed of the plant, compared with C and other libraries."""
    if args.what == "explain":
        return _run_trial(args)
    if args.what == "robustness":
        return _study_robustness(args)
    if args.what == "realtime":
        return _run_realtime(args)
    if args.what == "live":
        return _run_live(args)
    if args.what == "faults":
        return _study_bus_faults(args)
    if args.what == "recordings":
        return _measure_recordings(args)
    from fdi.output import write_text
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.sequences import load_sequence
    from rig.studies.benchmarks.plant_report import build_plant_report
    from rig.studies.benchmarks.plant_step import measure_accuracy
    from rig.studies.benchmarks.run_benchmarks import run_benchmarks

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
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.studies.benchmarks.realtime import measure_realtime
    from rig.studies.benchmarks.realtime_report import build_realtime_report

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
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.studies.benchmarks.live_runs import measure_live_runs
    from rig.studies.benchmarks.live_runs_report import build_live_runs_report

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
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.studies.benchmarks.long_recordings import measure_long_recordings
    from rig.studies.benchmarks.long_recordings_report import build_long_recordings_report

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


def _run_trial(args: argparse.Namespace) -> int:
    """The blind trial; exit status 0 if every requested rate that was counted is reached, 1 otherwise.

    Raises:
        InputError: no cases, unknown signals, no C compiler, or a place that cannot be written.
    """
    import tempfile
    from pathlib import Path

    from fdi.output import require_writable, write_text
    from plant.errors import InputError
    from rig.cli.answer import show_answer
    from rig.cli.terminal import open_console
    from rig.studies.trial.blackbox import RIG_EXPLAIN
    from rig.studies.trial.run_trial import run_trial
    from rig.studies.trial.trial_report import build_trial_report, describe_progress
    from rig.studies.trial.trial_score import summarise_trial

    for option, count in (("--cases", args.cases), ("--jobs", args.jobs)):
        if count < 1:
            raise InputError(option, str(count), "1 or more")
    if args.out is not None:
        require_writable(args.out, "--out")
    out = open_console()

    def report_progress(progress: BatchProgress) -> None:
        if not (args.json or args.quiet):
            out.print(describe_progress(progress), markup=False)

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(args.folder or temporary)
        seeds = range(args.seed, args.seed + args.cases)
        rows = run_trial(RIG_EXPLAIN, seeds, folder, args.jobs, report_progress, args.signals)
        figures = summarise_trial(rows)
    if args.out is not None:
        write_text(args.out, json.dumps(figures, indent=1) + "\n")
    show_answer(build_trial_report(figures), args)
    return 0 if all(rate["met"] or not rate["of"] for rate in figures["rates"]) else 1


def _study_bus_faults(args: argparse.Namespace) -> int:
    """The matrix of faults on the bus and phases of a motion; exit status 1 if a cell failed."""
    from rig.cli.answer import choose_places, show_answer, write_answer
    from rig.cli.progress_bar import show_progress
    from rig.studies.bus_faults import study_bus_faults
    from rig.studies.bus_faults_report import build_bus_faults_report

    places = choose_places(args, "", "")
    with show_progress(is_silent=args.json or args.quiet) as progress:
        cells = study_bus_faults(args.seed, progress=progress)
    report = replace(build_bus_faults_report(cells, args.seed), files=places.files)
    write_answer(report, places)
    show_answer(report, args)
    return 0 if all(cell.passed for cell in cells) else 1


def _study_robustness(args: argparse.Namespace) -> int:
    """Fuzz frames, disturbed runs and long operation; exit status 1 if anything hung, crashed, grew or was left."""
    from fdi.output import write_text
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.studies.robustness.report import build_robustness_report
    from rig.studies.robustness.run_study import run_study

    with show_progress(is_silent=args.json or args.quiet) as progress:
        figures = run_study(args.frames, args.trials, args.minutes, args.seed, args.controller, progress)
    if args.out is not None:
        write_text(args.out, json.dumps(figures, indent=1) + "\n")
    show_answer(build_robustness_report(figures), args)
    return 1 if figures["problems"] else 0
