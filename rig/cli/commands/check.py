"""`rig check`: a dry run of a sequence; the frames of a bench; a plant file over its nominal test; a fault file."""

import argparse
from dataclasses import replace
from pathlib import Path

from fdi.report import Column, Line, Report, Section, Table
from plant import check_behaviour, count_nouns, is_fault_file, load_model, require
from rig.benches import build_bench_report, collect_bench_data, list_loads, load_bench, tabulate_frames
from rig.cli import choose_places, give_answer, load_chosen_model, parse_changes, show_progress
from rig.cli.commands.list import build_list_report, list_faults
from rig.run import JobChoice, build_job
from rig.suite.dry_run import build_dry_run_report, make_dry_run


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a limit is violated."""
    if args.sequence is None:
        return check_bench(args)
    if args.sequence.endswith(".py"):
        return check_plant(args)
    if is_fault_file(Path(args.sequence)):
        faults = list_faults(load_chosen_model(args), args.sequence)
        return give_answer(build_list_report("faults", "Measure them with rig fdi TRACE --faults FILE.", faults), args)
    places = choose_places(args, "", args.sequence if Path(args.sequence).is_file() else "")
    choice = JobChoice(args.sequence, args.model, parse_changes(args.set), args.seed, tuple(args.effects),
                       args.bench)
    with show_progress(args, "simulating"):
        dry = make_dry_run(build_job(choice, is_trusted=args.trust))
    report = build_dry_run_report(dry, places.files)
    if args.bench is not None:
        bench = load_bench(args.bench, is_trusted=args.trust)
        loads = list_loads(bench)
        report = replace(report, sections=[*report.sections, Section("Frames", [tabulate_frames(loads)])],
                         data={**report.data, "bench": collect_bench_data(bench, loads)})
    return give_answer(report, args, int(bool(dry.problems)), places)


def check_plant(args: argparse.Namespace) -> int:
    """Exit status 1 if a plant file fails a check over its nominal test."""
    model = load_model(args.sequence).replace(parse_changes(args.set))
    kind = model.kind
    require(kind.profile, args.sequence, "profile", "segments of a nominal test, over which the plant is checked")
    places, findings = choose_places(args, "", args.sequence), []
    with show_progress(args, "compiling and simulating") as progress:
        for finding in check_behaviour(model):
            findings.append(finding)
            progress(finding.check, len(findings) / (len(kind.effects) + 6))
    failures = [f.check for f in findings if not f.passed]
    verdict = "UNSOUND" if failures else "SOUND"
    sentence = (f"{kind.title or kind.name}: {count_nouns(len(kind.state._fields), 'state')}, "
                f"{count_nouns(len(kind.nominal), 'parameter')}, {count_nouns(len(kind.effects), 'own effect')}, "
                f"{count_nouns(len(kind.faults), 'fault')}")
    lines = [Line(f.check, f.text, "good" if f.passed else "bad") for f in findings]
    signals = Table([Column("signal"), Column("role"), Column("unit"), Column("content")],
                    [[s.name, s.role, s.unit, s.quantity] for s in kind.signals])
    report = Report("check", args.sequence, verdict, "bad" if failures else "good", sentence, sections=[
        Section("Checks", lines), Section("Signals", [signals])], files=places.files,
        next_command=f"rig simulate --model {args.sequence}",
        data={"verdict": verdict, "file": args.sequence, "plant": kind.name,
              "checks": [f._asdict() for f in findings]})
    return give_answer(report, args, int(bool(failures)), places)


def check_bench(args: argparse.Namespace) -> int:
    """Exit status 1 if the frames need more than the whole bus."""
    require(args.bench is not None, "rig check", "", "a SEQUENCE, --bench FILE, or both")
    bench = load_bench(args.bench, is_trusted=args.trust)
    places = choose_places(args, "", args.bench if Path(args.bench).is_file() else "")
    report = build_bench_report(bench, places.files)
    return give_answer(report, args, int(report.verdict == "BEYOND_LIMITS"), places)
