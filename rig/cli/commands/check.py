"""`rig check`: a dry run of a sequence, against the limits of the actuator; the frames of a bench; a fault file."""
from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from fdi.report.report import Section
from plant.errors import InputError
from plant.faults import is_fault_file
from rig.benches.bench_file import load_bench
from rig.benches.bench_report import build_bench_report, collect_data, tabulate_frames
from rig.benches.bus_load import list_loads
from rig.cli.answer import choose_places, give_answer
from rig.cli.commands.list import build_list_report, list_faults
from rig.cli.inputs import load_chosen_model, parse_changes
from rig.cli.progress_bar import show_progress
from rig.run.job import JobChoice, build_job
from rig.suite.dry_run import build_dry_run_report, make_dry_run


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a limit is violated."""
    if args.sequence is None:
        return check_bench(args)
    if is_fault_file(Path(args.sequence)):
        found = list_faults(load_chosen_model(args), args.sequence)
        return give_answer(build_list_report("faults", "Measure them with rig fdi TRACE --faults FILE.", found), args)
    places = choose_places(args, "", args.sequence if Path(args.sequence).is_file() else "")
    choice = JobChoice(args.sequence, args.model, parse_changes(args.set), args.seed, tuple(args.effects),
                       args.bench)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("simulating", 0.0)
        dry = make_dry_run(build_job(choice, is_trusted=args.trust))
    report = build_dry_run_report(dry, places.files)
    if args.bench is not None:
        bench = load_bench(args.bench, is_trusted=args.trust)
        loads = list_loads(bench)
        report = replace(report, sections=[*report.sections, Section("Frames", [tabulate_frames(loads)])],
                         data={**report.data, "bench": collect_data(bench, loads)})
    return give_answer(report, args, int(bool(dry.problems)), places)


def check_bench(args: argparse.Namespace) -> int:
    """Exit status 1 if the frames need more than the whole bus."""
    if args.bench is None:
        raise InputError("rig check", "", "a SEQUENCE, --bench FILE, or both")
    bench = load_bench(args.bench, is_trusted=args.trust)
    places = choose_places(args, "", args.bench if Path(args.bench).is_file() else "")
    report = build_bench_report(bench, places.files)
    return give_answer(report, args, int(report.verdict == "BEYOND_LIMITS"), places)
