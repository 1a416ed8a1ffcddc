"""`rig doctor`: what this machine can do, and how to get the rest."""

import argparse
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from fdi.report import Cell, Column, Mood, Report, Section, Table
from plant import require
from rig import doctor
from rig.benches import Bench, load_bench
from rig.cli import Places, give_answer
from rig.network import choose_bus

MOODS: dict[doctor.Status, Mood] = {"ok": "good", "limited": "doubtful", "missing": "bad"}


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if the embedded bench cannot run here."""
    require(0 <= args.seconds <= 3600, "--seconds", "", f"between 0 and 3600 s, not {args.seconds:g}")
    places = Places(answer=None if args.out is None else Path(args.out))
    if args.bench is not None:
        bench = load_bench(args.bench, is_trusted=args.trust)
        report = build_listening_report(bench, choose_bus(args.bus)[0], args.seconds)
    else:
        report = build_doctor_report(doctor.examine_machine())
    return give_answer(report, args, int(report.verdict != "PASS"), places)


def build_listening_report(bench: Bench, spec: str, seconds: float) -> Report:
    """Report on the frames of a bench that are heard on a bus."""
    counts, others = doctor.count_frames(bench, doctor.listen(bench, spec, seconds))
    findings = list(doctor.judge_frames(bench, counts, others, seconds))
    is_there = any(each.status == "ok" for each in findings if each.purpose.startswith("controller"))
    sentence = f"The controller is on {spec}." if is_there else f"Nothing of the controller is heard on {spec}."
    return build_report(bench.name, findings, sentence, is_good=is_there)


def build_doctor_report(findings: Sequence[doctor.Finding]) -> Report:
    """Report on what a machine can do."""
    blocking = [finding.name for finding in findings if finding.needed and finding.status == "missing"]
    if blocking:
        return build_report("this machine", findings, f"The bench cannot run without: {', '.join(blocking)}.",
                            "the bench cannot run on this machine", is_good=False)
    counts = Counter(finding.status for finding in findings)
    return build_report("this machine", findings, "The embedded bench runs on this machine.",
                        f"the embedded bench runs on this machine; {counts['ok']} capabilities ok, {counts['limited']} "
                        f"limited, {counts['missing']} missing (optional)", is_good=True)


def build_report(title: str, findings: Sequence[doctor.Finding], sentence: str, conclusion: str = "", *,
                 is_good: bool) -> Report:
    """Report on findings: a table with a row each."""
    verdict = "PASS" if is_good else "FAIL"
    return Report("doctor", title, verdict, "good" if is_good else "bad", sentence, conclusion=conclusion,
                  sections=[Section("", [tabulate_findings(findings)])],
                  data={"verdict": verdict, "findings": [finding._asdict() for finding in findings]})


def tabulate_findings(findings: Sequence[doctor.Finding]) -> Table:
    """A row for each finding, below the name of its area."""
    rows: list[list[Cell | str]] = []
    for area, group in groupby(findings, lambda finding: finding.area):
        rows.append([Cell(area, is_strong=True), "", "", "", ""])
        rows += [[f"  {each.name}", Cell(each.status, MOODS[each.status]), each.found, each.purpose, each.remedy]
                 for each in group]
    return Table([Column(title) for title in ("capability", "", "found", "used for", "how to get it")], rows)
