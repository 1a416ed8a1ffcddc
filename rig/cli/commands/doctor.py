"""`rig doctor`: what this machine can do, and how to get the rest."""

import argparse
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from fdi.report.report import Cell, Column, Mood, Report, Section, Table
from plant.errors import require
from rig import doctor
from rig.benches.bench import Bench
from rig.benches.bench_file import load_bench
from rig.cli.answer import Places, give_answer
from rig.network.bus import choose_bus

MOODS: dict[doctor.Status, Mood] = {"ok": "good", "limited": "doubtful", "missing": "bad"}


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if the embedded bench cannot run here."""
    require(0 <= args.seconds <= 3600, "--seconds", "", f"between 0 and 3600 s, not {args.seconds:g}")
    places = Places(answer=None if args.out is None else Path(args.out))
    if args.bench is not None:
        bench = load_bench(args.bench, is_trusted=args.trust)
        report = build_listening_report(bench, choose_bus(args.bus)[0], args.seconds)
    else:
        report = build_doctor_report(doctor.examine_machine(args.seconds))
    return give_answer(report, args, int(report.verdict != "PASS"), places)


def build_listening_report(bench: Bench, spec: str, seconds: float) -> Report:
    """Report on the frames of a bench that are heard on a bus."""
    heard, others = doctor.count_frames(bench, doctor.listen(bench, spec, seconds))
    findings = list(doctor.judge_frames(bench, heard, others, seconds))
    theirs = [each for each in findings if each.purpose.startswith("controller")]
    is_there = any(each.status == "ok" for each in theirs)
    sentence = (f"The controller is on {spec}." if is_there else
                f"Nothing of the controller is heard on {spec}.")
    verdict = "PASS" if is_there else "FAIL"
    return Report("doctor", bench.name, verdict, "good" if is_there else "bad", sentence,
                  sections=[Section("", [tabulate_findings(findings)])],
                  data={"verdict": verdict, "findings": [finding._asdict() for finding in findings]})


def build_doctor_report(findings: Sequence[doctor.Finding]) -> Report:
    """Report on the findings: a table with one row each, below the name of its area."""
    blocking = [finding.name for finding in findings if finding.needed and finding.status == "missing"]
    data = {"verdict": "FAIL" if blocking else "PASS", "findings": [finding._asdict() for finding in findings]}
    section = Section("", [tabulate_findings(findings)])
    if blocking:
        return Report("doctor", "this machine", "FAIL", "bad", f"The bench cannot run without: {', '.join(blocking)}.",
                      sections=[section], conclusion="the bench cannot run on this machine", data=data)
    counts = Counter(finding.status for finding in findings)
    return Report("doctor", "this machine", "PASS", "good", "The embedded bench runs on this machine.",
                  sections=[section], data=data, conclusion=(
                      f"the embedded bench runs on this machine; {counts['ok']} capabilities ok, {counts['limited']} "
                      f"limited, {counts['missing']} missing (optional)"))


def tabulate_findings(findings: Sequence[doctor.Finding]) -> Table:
    """A row for each finding, below the name of its area."""
    rows: list[list[Cell | str]] = []
    for area, found in groupby(findings, lambda finding: finding.area):
        rows.append([Cell(area, is_strong=True), "", "", "", ""])
        rows += [[f"  {each.name}", Cell(each.status, MOODS[each.status]), each.found, each.purpose, each.remedy]
                 for each in found]
    return Table([Column(title) for title in ("capability", "", "found", "used for", "how to get it")], rows)
