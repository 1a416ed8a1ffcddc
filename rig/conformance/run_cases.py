"""Runs the cases on a node one after the other: each begins with a reset of the communication and forgets the last."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from fdi.progress import Progress, ignore_progress
from fdi.report import Cell, Column, Line, Medium, Mood, Report, Section, Table, tabulate
from plant import RigError, count_nouns
from rig import junit
from rig.conformance import eds_cases, error_cases, nmt_cases, object_cases, pdo_cases, sdo_cases
from rig.conformance.object_cases import read_values
from rig.conformance.target import CHAPTERS, HISTORY, Case, CaseEnd, CaseFailed, Target, Variable, Verdict

CASES: list[Case] = [
    *eds_cases.CASES, *object_cases.CASES, *sdo_cases.CASES, *pdo_cases.CASES, *error_cases.CASES, *nmt_cases.CASES,
]


class Result(NamedTuple):
    """What became of one case."""

    case: Case
    measured: str
    verdict: Verdict
    seconds: float  # on the clock of the bus


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


def choose_cases(words: Sequence[str]) -> list[Case]:
    """The cases of these chapters ("3") and numbers ("3.6"); all for none. Unknown words choose nothing."""
    return [each for each in CASES if not words or each.number in words or str(each.chapter) in words]


def run_cases(target: Target, cases: Sequence[Case] = CASES, progress: Progress = ignore_progress) -> Outcome:
    """Run the cases and set back what they changed.

    Raises:
        RigError: the node does not answer, or another master is active on the bus.
    """
    is_live = any(each.chapter > 1 for each in cases)
    if is_live:
        _require_present(target)
    snapshot = _read_all(target) if is_live else {}
    results = []
    for position, each in enumerate(cases):
        progress(CHAPTERS[each.chapter], position / len(cases))
        results.append(_run_case(target, each))
    notes = [*_restore(target, snapshot)] if is_live else []
    if target.others:
        notes.append(f"Other nodes on the bus: {', '.join(map(str, sorted(target.others)))}.")
    return Outcome([result for result, _ in results], notes, any(is_disturbed for _, is_disturbed in results))


def _run_case(target: Target, each: Case, attempts: int = 3) -> tuple[Result, bool]:
    """One case, several times if it fails while the tester is late; and whether that kept it from a verdict."""
    start = target.now()
    for _ in range(attempts):
        verdict, text = _attempt(target, each)
        is_disturbed = target.stall > max(0.5 * target.options.tolerance, 0.002) and verdict is Verdict.FAIL
        if not is_disturbed:
            break
    is_disturbed &= each.is_timed
    if is_disturbed:
        verdict = Verdict.SKIPPED
        text = f"this machine was {1e3 * target.stall:.0f} ms late itself while it measured: {text}"
    return Result(each, text, verdict, (target.now() - start) * 1e-9), is_disturbed


def _attempt(target: Target, each: Case) -> tuple[Verdict, str]:
    try:
        target.begin()
        if each.chapter > 1:
            _reset(target)
        return Verdict.PASS, each.check(target)
    except CaseEnd as end:
        return end.verdict, str(end)
    except (IndexError, ValueError, ArithmeticError) as error:  # an answer, or a type in the EDS, that is too short
        return Verdict.FAIL, f"a value that cannot be used ({error})"


def _reset(target: Target) -> bool:
    """Bring the node into PRE-OPERATIONAL with its defaults; whether it boots. The case goes on if not."""
    try:
        target.reset()
    except CaseFailed:
        return False
    target.begin()
    return True


def _require_present(target: Target) -> None:
    """Raises RigError unless the node answers and nobody else sends SYNC."""
    target.begin()
    if target.listen(0.3, target.sync_id):
        raise RigError(f"another node sends SYNC (0x{target.sync_id:03X}): stop it first, the test needs the bus to "
                       "itself")
    has_booted = _reset(target)
    try:
        target.upload(0x1000)
    except CaseFailed as error:
        if not has_booted:
            raise RigError(f"node {target.node} does not answer: neither a boot-up after an NMT reset nor object "
                           "0x1000") from error


def _read_all(target: Target) -> dict[Variable, bytes]:
    """What every writable object holds, as far as it can be read."""
    return dict(read_values(target, lambda each: each.is_writable and not each.is_active and each.index != HISTORY,
                            CaseFailed))


def _restore(target: Target, snapshot: dict[Variable, bytes]) -> Iterator[str]:
    """Reset the node's communication and write back what differs from the beginning; a line for each that did."""
    _reset(target)
    after = _read_all(target)
    for variable, before in ((each, data) for each, data in snapshot.items() if after.get(each) != data):
        try:
            target.download(*variable.key, before)
            outcome = "it was set back"
        except CaseFailed as error:
            outcome = f"it could not be set back ({error})"
        final_value = variable.show(after[variable]) if variable in after else "nothing"
        yield f"{variable.label} held {variable.show(before)} before and {final_value} after the test; {outcome}."


MOODS: dict[Verdict, Mood] = {Verdict.PASS: "good", Verdict.FAIL: "bad", Verdict.NOT_APPLICABLE: "muted",
                              Verdict.SKIPPED: "doubtful"}


def build_conformance_report(outcome: Outcome, target: Target, bus: str, files: Sequence[tuple[str, str]] = ()
                             ) -> Report:
    """Report on a conformance test: a table for each chapter, and on the terminal only what needs attention."""
    sheet, results = target.sheet, outcome.results
    moods: dict[str, Mood] = {"PASS": "good", "FAIL": "bad", "INVALID_TIMING": "doubtful"}
    counts = _count(results)
    facts = [("node", str(sheet.node)), ("EDS", sheet.path.name), ("bus", bus),
             ("tests", ", ".join(f"{count} {verdict.value}" for verdict, count in counts.items() if count))]
    chapters = _by_chapter(results)
    summary = Table([Column("chapter"), Column(""), *(Column(verdict.value, align="right") for verdict in Verdict)],
                    [_summarise_chapter(title, own) for title, own in chapters])
    open_items = [Line(f"{each.case.number} {each.verdict.value}", f"{each.case.name}: {each.measured}",
                       MOODS[each.verdict]) for each in results if each.verdict in (Verdict.FAIL, Verdict.SKIPPED)]
    return Report(
        command="conformance", title=f"Conformance of node {sheet.node}, {sheet.name}", verdict=outcome.verdict,
        mood=moods[outcome.verdict], sentence=_describe(outcome), facts=facts,
        notes=[*outcome.notes, "A test against CiA 301 as far as it goes (docs/conformance.md); not a certificate."],
        sections=[Section("Chapters", [summary]), Section("Open", open_items, medium=Medium.TERMINAL),
                  *(Section(title, _tabulate(own), title_medium=Medium.BOTH) for title, own in chapters)],
        files=files,
        data={
            "verdict": outcome.verdict, "node": sheet.node, "product": sheet.name, "eds": str(sheet.path),
            "bus": bus, "write": target.options.may_write,
            "counts": {verdict.value: count for verdict, count in counts.items()},
            "tests": [{"number": case.number, "name": case.name, "section": case.section, "expected": case.expected,
                       "measured": text, "verdict": verdict.value, "seconds": seconds, "chapter": case.chapter}
                      for case, text, verdict, seconds in results],
            "notes": outcome.notes,
        })


def write_junit(outcome: Outcome, node: int) -> str:
    """The results as JUnit XML: a suite for each chapter, a test case for each case."""
    suites = [junit.TestSuite(title, [_make_test_case(result, node) for result in results])
              for title, results in _by_chapter(outcome.results)]
    return junit.write_junit(f"conformance of node {node}", suites)


def _make_test_case(result: Result, node: int) -> junit.TestCase:
    each = result.case
    case = junit.TestCase(f"{each.number} {each.name}", f"node{node}.chapter{each.chapter}", result.seconds)
    if result.verdict is Verdict.FAIL:
        return case._replace(problem="failure", message=result.measured,
                             detail=f"CiA 301 {each.section}: expected {each.expected}")
    if result.verdict is Verdict.PASS:
        return case._replace(output=result.measured)
    return case._replace(problem="skipped", message=f"{result.verdict.value}: {result.measured}")


def _describe(outcome: Outcome) -> str:
    if numbers := [result.case.number for result in outcome.results if result.verdict is Verdict.FAIL]:
        return f"{count_nouns(len(numbers), 'test')} failed: {', '.join(numbers)}."
    if outcome.is_disturbed:
        return "No test failed, but this machine was too late to measure some times; repeat it on a quiet machine."
    return f"Every applicable test passed ({_count(outcome.results)[Verdict.PASS]} of {len(outcome.results)})."


def _summarise_chapter(title: str, results: Sequence[Result]) -> list[Cell | str]:
    counts = _count(results)
    state = Cell("fail", "bad") if counts[Verdict.FAIL] else Cell("pass", "good")
    return [title, state, *(str(count or "") for count in counts.values())]


def _tabulate(results: Sequence[Result]) -> list[Table]:
    return [tabulate(
        results,
        (Column("no."), lambda each: each.case.number), (Column("test"), lambda each: each.case.name),
        (Column("CiA 301", medium=Medium.PAGE), lambda each: Cell(each.case.section, "muted")),
        (Column("expected", medium=Medium.PAGE), lambda each: each.case.expected),
        (Column("measured"), lambda each: each.measured),
        (Column("verdict"), lambda each: Cell(each.verdict.value, MOODS[each.verdict])))]


def _by_chapter(results: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    """The chapters that were tested, with number and title, and their results."""
    chapters = [(f"{chapter} {title}", [result for result in results if result.case.chapter == chapter])
                for chapter, title in CHAPTERS.items()]
    return [(title, own) for title, own in chapters if own]


def _count(results: Sequence[Result]) -> dict[Verdict, int]:
    """Number of cases with each verdict."""
    return {verdict: sum(result.verdict is verdict for result in results) for verdict in Verdict}
