"""The answer of a conformance test: a report for terminal and page, JSON values, and JUnit XML for build servers."""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdi.report.numbers import count_nouns
from fdi.report.report import Cell, Column, Line, Medium, Mood, Report, Section, Table
from rig import junit
from rig.conformance.conformance_case import CHAPTERS, Result, Verdict
from rig.conformance.data_sheet import DataSheet
from rig.conformance.run_cases import Outcome

MOODS: dict[Verdict, Mood] = {Verdict.PASS: "good", Verdict.FAIL: "bad", Verdict.NOT_APPLICABLE: "muted",
                              Verdict.SKIPPED: "doubtful"}


class Subject(NamedTuple):
    """What was tested, as the report names it."""

    sheet: DataSheet
    bus: str
    may_write: bool


def build_conformance_report(outcome: Outcome, subject: Subject, files: Sequence[tuple[str, str]] = ()) -> Report:
    """Report on a conformance test: a table for each chapter, and on the terminal only what needs attention."""
    sheet = subject.sheet
    moods: dict[str, Mood] = {"PASS": "good", "FAIL": "bad", "INVALID_TIMING": "doubtful"}
    results = outcome.results
    counts = {verdict: outcome.count(verdict) for verdict in Verdict}
    facts = [("node", str(sheet.node)), ("EDS", sheet.path.name), ("bus", subject.bus),
             ("tests", ", ".join(f"{count} {verdict.value}" for verdict, count in counts.items() if count))]
    return Report(
        command="conformance", title=f"Conformance of node {sheet.node}, {sheet.name}", verdict=outcome.verdict,
        mood=moods[outcome.verdict], sentence=_describe(outcome), facts=facts,
        notes=[*outcome.notes, "A test against CiA 301 as far as it goes (docs/conformance.md); not a certificate."],
        sections=[_summarise_chapters(results), _list_open(results), *_list_chapters(results)],
        files=files, data=_to_data(outcome, subject))


def write_junit(outcome: Outcome, subject: Subject) -> str:
    """The results as JUnit XML: a suite for each chapter, a test case for each case."""
    node = subject.sheet.node
    suites = [junit.TestSuite(f"{chapter} {CHAPTERS[chapter]}",
                              [_make_test_case(result, f"node{node}.chapter{chapter}") for result in results])
              for chapter, results in _by_chapter(outcome.results)]
    return junit.write_junit(f"conformance of node {node}", suites)


def _make_test_case(result: Result, classname: str) -> junit.TestCase:
    case = junit.TestCase(f"{result.number} {result.name}", classname, result.seconds)
    if result.verdict is Verdict.FAIL:
        return case._replace(problem="failure", message=result.measured,
                             detail=f"CiA 301 {result.section}: expected {result.expected}")
    if result.verdict is Verdict.PASS:
        return case._replace(output=result.measured)
    return case._replace(problem="skipped", message=f"{result.verdict.value}: {result.measured}")


def _describe(outcome: Outcome) -> str:
    failed = [result.number for result in outcome.results if result.verdict is Verdict.FAIL]
    passed = outcome.count(Verdict.PASS)
    if failed:
        return f"{count_nouns(len(failed), 'test')} failed: {', '.join(failed)}."
    if outcome.is_disturbed:
        return "No test failed, but this machine was too late to measure some times; repeat it on a quiet machine."
    return f"Every applicable test passed ({passed} of {len(outcome.results)})."


def _summarise_chapters(results: Sequence[Result]) -> Section:
    rows: list[list[Cell | str]] = []
    for chapter, own in _by_chapter(results):
        failed = _count(own, Verdict.FAIL)
        rows.append([f"{chapter} {CHAPTERS[chapter]}", Cell("fail" if failed else "pass", "bad" if failed else "good"),
                     *(str(_count(own, verdict) or "") for verdict in Verdict)])
    columns = [Column("chapter"), Column(""), *(Column(verdict.value, align="right") for verdict in Verdict)]
    return Section("Chapters", [Table(columns, rows)])


def _list_open(results: Sequence[Result]) -> Section:
    """On the terminal: what failed or was not found out."""
    items = [Line(f"{result.number} {result.verdict.value}", f"{result.name}: {result.measured}", MOODS[result.verdict])
             for result in results if result.verdict in (Verdict.FAIL, Verdict.SKIPPED)]
    return Section("Open", items, medium=Medium.TERMINAL)


def _list_chapters(results: Sequence[Result]) -> list[Section]:
    columns = [Column(title) for title in ("no.", "test", "CiA 301", "expected", "measured", "verdict")]
    few = [Column(title) for title in ("no.", "test", "measured", "verdict")]
    sections = []
    for chapter, own in _by_chapter(results):
        rows: list[list[Cell | str]] = [
            [result.number, result.name, Cell(result.section, "muted"), result.expected, result.measured,
             Cell(result.verdict.value, MOODS[result.verdict])] for result in own]
        sections.append(Section(f"{chapter} {CHAPTERS[chapter]}", [Table(columns, rows, medium=Medium.PAGE)]))
        short: list[list[Cell | str]] = [
            [result.number, result.name, result.measured, Cell(result.verdict.value, MOODS[result.verdict])]
            for result in own]
        sections.append(Section(f"{chapter} {CHAPTERS[chapter]}", [Table(few, short, medium=Medium.TERMINAL)],
                                title_medium=Medium.TERMINAL))
    return sections


def _to_data(outcome: Outcome, subject: Subject) -> dict[str, object]:
    return {
        "verdict": outcome.verdict, "node": subject.sheet.node, "product": subject.sheet.name,
        "eds": str(subject.sheet.path), "bus": subject.bus, "write": subject.may_write,
        "counts": {verdict.value: outcome.count(verdict) for verdict in Verdict},
        "tests": [{**result._asdict(), "verdict": result.verdict.value, "chapter": result.chapter}
                  for result in outcome.results],
        "notes": outcome.notes,
    }


def _by_chapter(results: Sequence[Result]) -> list[tuple[int, list[Result]]]:
    chapters = [(chapter, [result for result in results if result.chapter == chapter]) for chapter in CHAPTERS]
    return [(chapter, own) for chapter, own in chapters if own]


def _count(results: Sequence[Result], verdict: Verdict) -> int:
    return sum(result.verdict is verdict for result in results)
