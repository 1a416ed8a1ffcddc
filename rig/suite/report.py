"""The report of a suite: its table and page, requirements with their evidence, and JUnit XML."""
from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from fdi.report.json import to_plain
from fdi.report.numbers import count_nouns
from fdi.report.report import Cell, Column, Medium, Mood, Report, Section, Table, tabulate
from fdi.report.run_report import MOODS as RUN_MOODS
from fdi.report.run_report import format_limits
from rig import junit
from rig.run.job import JobChoice
from rig.run.outcome import Outcome, describe_faults
from rig.sequences.checks import CheckResult
from rig.suite.suite import NO_VERDICT, Case, CaseResult, PlannedCheck, Suite, find_verdict, make_result

MOODS: dict[str, Mood] = {**RUN_MOODS, "ERROR": "bad", "NOT_RUN": "doubtful", "OPEN": "doubtful",
                          "NOT_COVERED": "doubtful"}


def build_suite_report(suite: Suite, results: Sequence[CaseResult], seconds: float, processes: int, folder: Path,
                       files: Sequence[tuple[str, str]] = ()) -> Report:
    """Report on a suite.

    Args:
        suite: what was to be run.
        results: of its cases, in their order.
        seconds: wall-clock time of all.
        processes: how many ran at a time.
        folder: where the page will be; links are relative to it.
        files: (label, path) of the files written.
    """
    requirements = trace_requirements(results, suite.requirements)
    verdict = find_verdict(results)
    verdicts = [each.verdict for each in requirements]
    facts = [("cases", count_verdicts([result.verdict for result in results])),
             ("wall-clock time", f"{seconds:.1f} s, {processes} at a time")]
    facts += [("suite file", suite.source)] if suite.source else []
    facts += [("requirements", count_verdicts(verdicts))] if requirements else []
    missing = [each.id for each in requirements if each.verdict == "NOT_COVERED"]
    return Report(
        command="run", title=suite.title, verdict=verdict, mood=MOODS[verdict], sentence=_describe(results),
        facts=facts, notes=[f"no check verifies {', '.join(missing)}"] if missing else [],
        sections=[Section("Cases", _tabulate_cases(results, folder)),
                  Section("Checks that failed", _tabulate_failures(results, folder), title_medium=Medium.BOTH),
                  Section("Servovalve", _tabulate_faults(results, folder), title_medium=Medium.BOTH),
                  Section("Requirements", _tabulate_requirements(requirements), title_medium=Medium.BOTH)],
        files=files, conclusion="" if verdict == "PASS" else f"{verdict}: {_describe(results)}",
        data=collect_data(suite, results, requirements, seconds, processes))


def count_verdicts(verdicts: Sequence[str]) -> str:
    """Their number, and that of each: "12: 10 PASS, 2 FAIL"."""
    return f"{len(verdicts)}: " + ", ".join(f"{count} {word}" for word, count in Counter(verdicts).most_common())


def _describe(results: Sequence[CaseResult], most: int = 3) -> str:
    bad = [result for result in results if result.verdict not in ("PASS", "NOT_JUDGED")]
    if not bad:
        unjudged = sum(result.verdict == "NOT_JUDGED" for result in results)
        without = f", {unjudged} of them without checks" if unjudged else ""
        return f"{count_nouns(len(results), 'case')}, none failed{without}."
    named = ", ".join(result.case.name for result in bad[:most])
    more = f" and {len(bad) - most} more" if len(bad) > most else ""
    return f"{len(bad)} of {count_nouns(len(results), 'case')} did not pass: {named}{more}."


def _tabulate_cases(results: Sequence[CaseResult], folder: Path) -> list[Table]:
    return [tabulate(
        results,
        (Column("case"), lambda result: Cell(result.case.name, link=_link(result, folder))),
        (Column("verdict"), lambda result: Cell(result.verdict, MOODS[result.verdict])),
        (Column("checks", align="right"), lambda result: f"{len(result.checks) - len(result.failed)}/"
                                                         f"{len(result.checks)}" if result.checks else "-"),
        (Column("time", "s", "right"), lambda result: f"{result.seconds:.1f}" if result.seconds else "-"),
        (Column("reason"), lambda result: result.reason),
        (Column("differs from nominal", medium=Medium.PAGE),
         lambda result: Cell("" if result.differences == "nothing" else result.differences, "muted")),
        caption="Checks: passed of all, protocol checks included. Time: wall-clock, with the page.")]


def _link(result: CaseResult, folder: Path) -> str:
    """The page of a run as the suite's page links it; "" if there is none."""
    page = result.case.folder / "report.html"
    return quote(os.path.relpath(page, folder)) if page.is_file() and result.checks else ""


def _tabulate_failures(results: Sequence[CaseResult], folder: Path) -> list[Table]:
    return [tabulate(
        [(result, check) for result in results for check in result.failed],
        (Column("case"), lambda row: Cell(row[0].case.name, link=_link(row[0], folder))),
        (Column("check"), lambda row: row[1].name),
        (Column("measured", align="right"),
         lambda row: Cell(_format_value(row[1]), "bad" if row[0].verdict == "FAIL" else "doubtful")),
        (Column("limits", align="right"), lambda row: format_limits(row[1].low, row[1].high)),
        (Column("unit"), lambda row: "" if row[1].unit == "1" else row[1].unit),
        (Column("requirement"), lambda row: ", ".join(row[1].requirement)), terminal_rows=30)]


def _tabulate_faults(results: Sequence[CaseResult], folder: Path) -> list[Table]:
    """Level and size of both faults in each case that asked for a diagnosis; what both share stands once."""
    from fdi.report.diagnosis_report import LEVEL_MOODS, LEVEL_NAMES, VERDICT_MOODS, FoundFault, list_found_faults

    moods = {name: LEVEL_MOODS[level] for level, name in LEVEL_NAMES.items()}
    rows = [(result if number == 0 else None, found) for result in results if result.fdi
            for number, found in enumerate(list_found_faults(result.fdi) or [FoundFault("", "", "")])]

    def show_verdict(result: CaseResult | None) -> Cell:
        word = result.fdi["verdict"] if result else ""
        return Cell(word, VERDICT_MOODS.get(word, "bad" if result and result.has_fault else "doubtful"))

    return [tabulate(
        rows,
        (Column("case"), lambda row: Cell(row[0].case.name, link=_link(row[0], folder)) if row[0] else ""),
        (Column("rig fdi"), lambda row: show_verdict(row[0])),
        (Column("fault", medium=Medium.PAGE), lambda row: row[1].name),
        (Column("level"), lambda row: Cell(row[1].level, moods.get(row[1].level, ""))),
        (Column("size (95 % interval)", align="right"), lambda row: row[1].size),
        (Column("finding", medium=Medium.PAGE), lambda row: row[0].fdi["sentence"] if row[0] else ""),
        terminal_rows=30,
        caption="A fault beyond acceptable, or another deviation, fails the case.")]


def _format_value(check: CheckResult) -> str:
    return "not measurable" if math.isnan(check.value) else f"{check.value:.4g}"


def _tabulate_requirements(requirements: Sequence[Requirement]) -> list[Table]:
    return [tabulate(
        requirements,
        (Column("requirement"), lambda each: each.id),
        (Column("text", medium=Medium.PAGE), lambda each: each.text),
        (Column("verdict"), lambda each: Cell(each.verdict, MOODS[each.verdict])),
        (Column("checks", align="right"), lambda each: f"{sum(proof.verdict == 'PASS' for proof in each.evidence)}/"
                                                       f"{len(each.evidence)}"),
        (Column("verified by", medium=Medium.PAGE), lambda each: describe_evidence(each.evidence)),
        caption="OPEN: a check that verifies it was not judged. NOT_COVERED: no check verifies it.")]


def describe_evidence(evidence: Sequence[Evidence], most: int = 3) -> str:
    """What verifies a requirement: each check with the cases that it passed in, and the names of the others."""
    parts = []
    for check in dict.fromkeys(each.check for each in evidence):
        own = [each for each in evidence if each.check == check]
        bad = [f"{each.verdict} in {each.case}" for each in own if each.verdict != "PASS"]
        more = [f"{len(bad) - most} more"] if len(bad) > most else []
        parts.append(", ".join([f"{check}: PASS in {len(own) - len(bad)} of {len(own)}", *bad[:most], *more]))
    return "; ".join(parts)


def collect_data(suite: Suite, results: Sequence[CaseResult], requirements: Sequence[Requirement], seconds: float,
                 processes: int) -> dict[str, Any]:
    """The JSON answer of a suite."""
    cases = []
    for result in results:
        choice = result.case.choice
        cases.append({
            "name": result.case.name, "verdict": result.verdict, "why": result.why, "seconds": round(result.seconds, 3),
            "folder": str(result.case.folder), "sequence": choice.sequence, "model": choice.model,
            "set": dict(choice.changes), "seed": choice.seed, "requirement": list(result.case.requirement),
            "differences": result.differences, "checks": [to_plain(check._asdict()) for check in result.checks],
            "fdi": dict(result.fdi)})
    return {"verdict": find_verdict(results), "title": suite.title, "cases": cases,
            "counts": dict(Counter(result.verdict for result in results)), "seconds": round(seconds, 3),
            "jobs": processes,
            "requirements": [{"id": each.id, "text": each.text, "verdict": each.verdict,
                              "checks": [evidence._asdict() for evidence in each.evidence]} for each in requirements]}


def write_junit(title: str, results: Sequence[CaseResult]) -> str:
    """The JUnit XML of these results."""
    return junit.write_junit(title, [_make_suite(title, result) for result in results])


def write_junit_of_run(outcome: Outcome, seconds: float) -> str:
    """The JUnit XML of one run, which took `seconds` of wall-clock time."""
    job = outcome.job
    checks = tuple(PlannedCheck(check.name, check.requirements) for check in job.sequence.checks)
    choice = JobChoice(job.sequence.name, job.model.name, {}, job.seed)
    case = Case(Path(job.sequence.name).stem, outcome.folder, choice, 0.0, checks)
    return write_junit("rig run", [make_result(case, outcome, seconds)])


def _make_suite(title: str, result: CaseResult) -> junit.TestSuite:
    case = result.case
    classname = ".".join(text.replace(".", "_") for text in (title, case.name))
    properties = [("folder", str(case.folder)), ("sequence", case.choice.sequence), ("seed", str(case.choice.seed)),
                  ("verdict", result.verdict), ("differs from nominal", result.differences)]
    properties += [("model", case.choice.model)] if case.choice.model else []
    properties += [("requirement", f"{name}: whole run") for name in case.requirement]
    properties += [("requirement", f"{name}: {check.name}") for check in case.checks for name in check.requirement]
    tests = [_make_run_test(result, classname), *(_make_check_test(check, result, classname)
                                                   for check in result.checks)]
    tests += [_make_diagnosis_test(result, classname)] if result.fdi else []
    return junit.TestSuite(case.name, tests, properties, result.seconds)


def _make_run_test(result: CaseResult, classname: str) -> junit.TestCase:
    """The run as a whole: it came to its end and could be judged. Its checks are tests of their own."""
    test = junit.TestCase("run", classname, result.seconds, message=result.why,
                          output=_name_requirements(result.case.requirement))
    if result.verdict == "ABORTED" or (result.verdict == "FAIL" and not result.failed and not result.has_fault):
        return test._replace(problem="failure", detail=result.verdict)
    if result.verdict in ("INVALID_TIMING", "ERROR"):
        return test._replace(problem="error", detail=result.verdict)
    if result.verdict in ("NOT_JUDGED", "NOT_RUN"):
        return test._replace(problem="skipped", message=f"{result.verdict}: {result.why}")
    return test


def _make_check_test(check: CheckResult, result: CaseResult, classname: str) -> junit.TestCase:
    unit = "" if check.unit == "1" else f" {check.unit}"
    measured = f"measured {_format_value(check)}{unit}, limits {format_limits(check.low, check.high)}{unit}"
    measured += f" ({check.detail})" if check.detail else ""
    window = "" if check.t0 != check.t0 else f"; window {check.t0:.3f} to {check.t1:.3f} s"
    test = junit.TestCase(check.name, classname, output="\n".join(
        filter(None, (measured + window, _name_requirements(check.requirement)))))
    if check.passed:
        return test
    if result.verdict in ("INVALID_TIMING", *NO_VERDICT):
        return test._replace(problem="skipped", message=f"{result.verdict}: {measured}")
    return test._replace(problem="failure", message=measured, detail=f"{check.kind} {check.signal}".strip() + window)


def _make_diagnosis_test(result: CaseResult, classname: str) -> junit.TestCase:
    """The diagnosis of the servovalve: a failure with a fault, skipped where it leaves the level of one open."""
    word, sentence = result.fdi["verdict"], result.fdi["sentence"]
    faults = describe_faults(result.fdi).replace("; ", "\n")
    test = junit.TestCase("rig fdi", classname, message=sentence, output=f"{word}: {sentence}\n{faults}".strip())
    if word == "CANNOT_TELL" or (result.has_fault and result.verdict == "INVALID_TIMING"):
        return test._replace(problem="skipped", message=f"{word}: {sentence}")
    return test._replace(problem="failure", detail=faults or word) if result.has_fault else test


def _name_requirements(names: Sequence[str]) -> str:
    return f"requirement {', '.join(names)}" if names else ""


RUN = "whole run"  # the name of what verifies a requirement of a case


class Evidence(NamedTuple):
    """A check of a case, or its whole run, that verifies a requirement."""

    case: str
    check: str
    verdict: str  # PASS, FAIL, or OPEN: not judged


class Requirement(NamedTuple):
    """A requirement with all that verifies it."""

    id: str
    text: str
    evidence: tuple[Evidence, ...]

    @property
    def verdict(self) -> str:
        """FAIL if a check failed, OPEN if one was not judged, PASS, or NOT_COVERED without any check."""
        words = {each.verdict for each in self.evidence}
        return next((word for word in ("FAIL", "OPEN", "PASS") if word in words), "NOT_COVERED")


def trace_requirements(results: Sequence[CaseResult], listed: Mapping[str, str]) -> list[Requirement]:
    """All requirements: those that the suite lists, in its order, then others that a check or case names."""
    found: dict[str, list[Evidence]] = {name: [] for name in listed}
    for result in results:
        for name in result.case.requirement:
            found.setdefault(name, []).append(Evidence(result.case.name, RUN, _judge_run(result)))
        for check in result.case.checks:
            for name in check.requirement:
                evidence = Evidence(result.case.name, check.name, _judge_check(result, check.name))
                found.setdefault(name, []).append(evidence)
    return [Requirement(name, listed.get(name, ""), tuple(evidence)) for name, evidence in found.items()]


def _judge_run(result: CaseResult) -> str:
    if result.verdict in ("PASS", "FAIL"):
        return result.verdict
    return "FAIL" if result.verdict == "ABORTED" else "OPEN"


def _judge_check(result: CaseResult, name: str) -> str:
    """The verdict of a check. If the bench was late, the checks of that run prove nothing."""
    check = next((check for check in result.checks if check.name == name), None)
    if check is None or result.verdict in ("INVALID_TIMING", *NO_VERDICT):
        return "OPEN"
    return "PASS" if check.passed else "FAIL"
