"""Runs the cases on a node one after the other: each begins with a reset of the communication and forgets the last."""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdi.progress import Progress, ignore_progress
from fdi.report.numbers import count_nouns
from fdi.report.report import Cell, Column, Line, Medium, Mood, Report, Section, Table
from plant.errors import RigError
from rig import junit
from rig.conformance import (
    eds_cases,
    error_cases,
    nmt_cases,
    object_cases,
    pdo_cases,
    sdo_cases,
    timing_cases,
)
from rig.conformance.conformance_case import CHAPTERS, Case, CaseEnd, CaseFailed, Result, Verdict
from rig.conformance.data_sheet import DataSheet, Variable
from rig.conformance.object_cases import list_readable
from rig.conformance.target import RESET_COMMUNICATION, Refusal, Target

CASES: list[Case] = sorted(
    (value for module in (eds_cases, object_cases, sdo_cases, pdo_cases, error_cases, nmt_cases, timing_cases)
     for value in vars(module).values() if isinstance(value, Case)), key=lambda each: each.order)


class Outcome(NamedTuple):
    """What a conformance test found out."""

    results: list[Result]
    notes: list[str]  # what a reader must know
    is_disturbed: bool  # times could not be measured: the tester's own machine was too late

    @property
    def verdict(self) -> str:
        """FAIL, INVALID_TIMING or PASS."""
        if any(result.verdict is Verdict.FAIL for result in self.results):
            return "FAIL"
        return "INVALID_TIMING" if self.is_disturbed else "PASS"

    def count(self, verdict: Verdict) -> int:
        """Number of cases with this verdict."""
        return sum(result.verdict is verdict for result in self.results)


def choose_cases(wanted: Sequence[str]) -> list[Case]:
    """The cases of these chapters ("3") and numbers ("3.6"); all for none. Unknown words choose nothing."""
    return [each for each in CASES if not wanted or each.number in wanted or str(each.chapter) in wanted]


def run_cases(target: Target, cases: Sequence[Case] | None = None, progress: Progress = ignore_progress) -> Outcome:
    """Run the cases and set back what they changed.

    Raises:
        RigError: the node does not answer, or another master is active on the bus.
    """
    chosen = CASES if cases is None else cases
    notes: list[str] = []
    snapshot: dict[Variable, bytes] = {}
    is_live = any(each.chapter > 1 for each in chosen)
    if is_live:
        _require_present(target)
        snapshot = _read_all(target)
    results, is_disturbed = [], False
    for position, each in enumerate(chosen):
        progress(CHAPTERS[each.chapter], position / len(chosen))
        result, disturbed = _run_case(target, each)
        results.append(result)
        is_disturbed |= disturbed
    if is_live:
        notes += _restore(target, snapshot)
    if target.others:
        notes.append(f"Other nodes on the bus: {', '.join(map(str, sorted(target.others)))}.")
    return Outcome(results, notes, is_disturbed)


def _run_case(target: Target, each: Case, attempts: int = 3) -> tuple[Result, bool]:
    """One case, several times if it fails while the tester is late; and whether that kept it from a verdict."""
    start = target.now()
    for _ in range(attempts):
        verdict, measured = _attempt(target, each)
        is_disturbed = target.stall > max(0.5 * target.options.tolerance, 0.002)
        if verdict is not Verdict.FAIL or not is_disturbed:
            break
    disturbed = each.is_timed and verdict is Verdict.FAIL and is_disturbed
    if disturbed:
        verdict = Verdict.SKIPPED
        measured = f"this machine was {1e3 * target.stall:.0f} ms late itself while it measured: {measured}"
    seconds = (target.now() - start) * 1e-9
    return Result(each.number, each.name, each.section, each.expected, measured, verdict, seconds), disturbed


def _attempt(target: Target, each: Case) -> tuple[Verdict, str]:
    try:
        target.begin()
        if each.chapter > 1:
            _reset(target)
        return Verdict.PASS, each.check(target)
    except CaseEnd as end:
        return end.verdict, str(end)
    except (Refusal, ValueError) as error:  # ValueError: a value of another length than its type has
        return Verdict.FAIL, str(error)


def _reset(target: Target) -> None:
    """Bring the node into PRE-OPERATIONAL with its defaults. Without a boot-up the case goes on all the same."""
    target.command(RESET_COMMUNICATION)
    target.wait_for(target.heartbeat_id, target.options.boot_timeout, lambda frame: frame.data == b"\0")
    target.begin()


def _require_present(target: Target) -> None:
    """Raises RigError unless the node answers and nobody else sends SYNC."""
    target.begin()
    target.wait(0.3)
    sync = target.sheet.default_identifier(0x1005, 0x080)
    if any(frame.cob_id == sync for frame in target.frames):
        raise RigError(f"another node sends SYNC (0x{sync:03X}): stop it first, the test needs the bus to itself")
    target.command(RESET_COMMUNICATION)
    boot = target.wait_for(target.heartbeat_id, target.options.boot_timeout, lambda frame: frame.data == b"\0")
    try:
        is_present = bool(target.upload(0x1000))
    except (CaseFailed, Refusal):
        is_present = boot is not None
    if not is_present:
        raise RigError(f"node {target.node} does not answer: neither a boot-up after an NMT reset nor object 0x1000")


def _read_all(target: Target) -> dict[Variable, bytes]:
    """What every writable object holds, as far as it can be read."""
    found = {}
    for variable in list_readable(target):
        if variable.is_writable and not variable.is_active and variable.index != 0x1003:
            try:
                found[variable] = target.upload(variable.index, variable.sub)
            except (Refusal, CaseFailed):
                continue
    return found


def _restore(target: Target, snapshot: dict[Variable, bytes]) -> list[str]:
    """Reset the node's communication and write back what differs from the beginning; a line for each that did."""
    _reset(target)
    after = _read_all(target)
    notes = []
    for variable, before in snapshot.items():
        if after.get(variable) == before:
            continue
        try:
            target.download(variable.index, variable.sub, before)
            done = "it was set back"
        except (Refusal, CaseFailed) as error:
            done = f"it could not be set back ({error})"
        changed = variable.show(after[variable]) if variable in after else "nothing"
        notes.append(f"{variable.label} held {variable.show(before)} before and {changed} after the test; {done}.")
    return notes


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
