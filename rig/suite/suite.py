"""Several runs as one suite: the suite file, its cases, running them side by side, and one report of all."""

import contextlib
import itertools
import os
import re
import signal
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote

from fdi.progress import ignore_progress
from fdi.report import (
    MOODS as RUN_MOODS,
    Cell,
    Column,
    Medium,
    Mood,
    Report,
    Section,
    Table,
    list_first,
    tabulate,
    to_plain,
    write_run_page,
)
from fdi.trace import CheckResult
from plant import (
    InputError,
    Quantity,
    RigError,
    build_dataclass,
    count_nouns,
    decode_text,
    parse_table,
    read_file,
    require,
)
from rig import junit
from rig.campaign.batch import UNLIMITED, run_in_processes
from rig.evidence.requirements import (
    NO_VERDICT,
    JudgedCheck,
    JudgedRun,
    Requirement,
    tabulate_requirements,
    trace_requirements,
)
from rig.interrupts import exit_on_signal, handle_signals
from rig.network import WallClock
from rig.run import (
    EMBEDDED_NAMES,
    INTERRUPTED,
    JobChoice,
    Outcome,
    build_job,
    describe_faults,
    describe_finding,
    diagnose_run,
    find_differences,
    has_fault,
    load_tested_sequence,
    run_job,
)
from rig.sequences import SkippedCheck

Value = float | str
Seed = Annotated[int, Quantity("1", low=0)]
MOST_CASES = 10_000


@dataclass(frozen=True, kw_only=True)
class CaseEntry:
    """An entry [[case]]: where a list stands, a case is made for each element, in every combination."""

    sequence: str | tuple[str, ...]
    name: str = ""
    model: str | tuple[str, ...] = ()
    bench: str | tuple[str, ...] = ()
    set: Mapping[str, float | str | tuple[float | str, ...]] = field(default_factory=dict)
    seed: Seed | tuple[Seed, ...] = 0
    effects: tuple[str, ...] = ()
    requirement: str | tuple[str, ...] = ()
    timeout: Annotated[float, Quantity("s", above=0.0, high=1e6)] | None = None
    fdi: bool = False

    def __post_init__(self) -> None:
        for key, values in (("sequence", self.sequence), ("seed", self.seed), *(("set", x) for x in self.set.values())):
            require(values != (), "case", key, "at least one")


@dataclass(frozen=True, kw_only=True)
class SuiteFile:
    """The keys of a suite file. `requirements`: a file beside it, a list of ids, or a table of ids and texts."""

    title: str
    case: tuple[CaseEntry, ...]
    requirements: str | tuple[str, ...] | Mapping[str, str] = ()


class Case(NamedTuple):
    """One run of a suite; folder and checks are known when it has been tried (`build_suite`)."""

    name: str  # then unique in the suite
    choice: JobChoice
    timeout: float | None = None  # s of wall-clock time; None: by the length of its sequence
    requirement: tuple[str, ...] = ()  # that the run as a whole verifies
    folder: Path = Path()  # of its results
    checks: tuple[JudgedCheck, ...] = ()  # without verdicts

    @property
    def planned(self) -> JudgedRun:
        """What it will say about requirements."""
        return JudgedRun(self.name, "NOT_RUN", self.requirement, self.checks)


class Suite(NamedTuple):
    """Cases, and the requirements that they shall cover: id to text."""

    title: str
    cases: list[Case]
    requirements: Mapping[str, str]
    source: str = ""  # the suite file


def read_suite_file(path: Path, base: JobChoice, *, is_trusted: bool = False) -> tuple[SuiteFile, list[Case]]:
    """The content of a suite file and its cases; `base` has what the command line chooses for all of them.

    `is_trusted`: whether Python files that benches and models name may run.

    Raises:
        InputError: the file, line and key that cannot be used.
    """
    table, place = parse_table(decode_text(read_file(path), path), str(path))
    suite = build_dataclass(SuiteFile, table, place)
    place.at("case").require(suite.case, "at least one case")
    cases: list[Case] = []
    for i, entry in enumerate(suite.case):
        for case in _vary(entry, path.parent, base):
            try:
                load_tested_sequence(case.choice, is_trusted=is_trusted)
            except InputError as error:  # refused with the line of the suite file, if it is not there
                if error.where == case.choice.sequence:
                    raise place.at("case", i, "sequence").refuse(f"a sequence; {error}") from error
                raise
            cases.append(case)
            place.at("case", i).require(len(cases) <= MOST_CASES, f"at most {MOST_CASES} cases in all")
    return suite, cases


def _vary(entry: CaseEntry, folder: Path, base: JobChoice) -> Iterator[Case]:
    """Every combination of the lists of an entry."""
    sequences, seeds = _as_tuple(entry.sequence), _as_tuple(entry.seed)
    models, benches = (_as_tuple(names) or (None,) for names in (entry.model, entry.bench))
    values = {name: _as_tuple(value) for name, value in entry.set.items()}
    effects = (*base.effects, *(folder / name for name in entry.effects))
    for sequence, model, bench, seed, *settings in itertools.product(sequences, models, benches, seeds,
                                                                     *values.values()):
        changes: dict[str, Value] = dict(zip(values, settings, strict=True))
        words = [entry.name or Path(sequence).stem,
                 *([Path(sequence).stem] if entry.name and len(sequences) > 1 else []),
                 *(Path(file).stem for file, files in ((model, models), (bench, benches))
                   if file is not None and len(files) > 1),
                 *(f"{name}={_show(value)}" for name, value in changes.items() if len(values[name]) > 1),
                 *([f"seed {seed}"] if len(seeds) > 1 else [])]
        choice = base._replace(sequence=_find_beside(folder, sequence), changes=changes, seed=seed, effects=effects,
                               model=None if model is None else _find_beside(folder, model),
                               bench=base.bench if bench is None else _find_beside(folder, bench),
                               is_diagnosed=base.is_diagnosed or entry.fdi)
        yield Case(", ".join(words), choice, entry.timeout, _as_tuple(entry.requirement))


def build_suite(title: str, cases: Sequence[Case], requirements: Mapping[str, str], source: str = "", *,
                is_trusted: bool = False) -> Suite:
    """The suite of these cases; each is tried first: sequence, model, parameters, effects.

    The folders of its cases are names without a place.

    Raises:
        InputError: a case that cannot run, or code that a model brings along and that is not trusted.
    """
    complete_cases: list[Case] = []
    names: set[str] = set()
    folders: set[str] = {"suite.html", "suite.json"}
    for case in cases:
        slug = re.sub(r"[^\w.=+-]+", "-", case.name).strip("-.")[:80] or "case"
        job = build_job(case.choice, is_trusted=is_trusted)
        complete_cases.append(case._replace(
            name=_find_free(case.name, names, " ({})"), folder=Path(_find_free(slug, folders, "-{}")),
            timeout=300.0 + 10.0 * job.sequence.duration if case.timeout is None else case.timeout,
            checks=tuple(JudgedCheck(check.name, check.requirements) for check in job.sequence.checks)))
    return Suite(title, complete_cases, requirements, source)


def _find_free(name: str, names: set[str], pattern: str) -> str:
    """The name, with a number from 2 if it is taken; whether letters are capitals makes no difference."""
    free = next(each for number in itertools.count(1)
                if (each := name if number == 1 else name + pattern.format(number)).lower() not in names)
    names.add(free.lower())
    return free


def _find_beside(folder: Path, name: str) -> str:
    """A file beside the suite file; a name without suffix is that of a shipped sequence or model."""
    return str(folder / name) if Path(name).suffix else name


def _as_tuple(value: object) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def _show(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else value


class CaseResult(NamedTuple):
    """What came out of a case. `verdict` is that of the run, or ERROR (crash, timeout, bad input), or NOT_RUN."""

    case: Case
    verdict: str
    why: str = ""
    seconds: float = 0.0  # wall-clock time
    checks: tuple[CheckResult, ...] = ()
    differences: str = "nothing"  # from the nominal test
    fdi: Mapping[str, Any] = {}  # answer of `rig fdi`, if the case asked for it
    skipped: tuple[SkippedCheck, ...] = ()  # checks that do not apply to the bench

    @property
    def failed(self) -> list[CheckResult]:
        """The checks that did not pass."""
        return [check for check in self.checks if not check.passed]

    @property
    def judged(self) -> JudgedRun:
        """What it says about requirements."""
        verdicts = {check.name: check.verdict for check in self.checks}
        return self.case.planned._replace(verdict=self.verdict, checks=[
            check._replace(verdict=verdicts.get(check.name, "")) for check in self.case.checks])

    @property
    def reason(self) -> str:
        """Why the case did not pass, in a few words: the first check that failed and the number of the others.

        A fault that `rig fdi` found is named beside them. So is a diagnosis that leaves the level of a fault open.
        """
        if self.verdict == "PASS" and self.fdi.get("verdict") == "CANNOT_TELL":
            return "rig fdi cannot tell"
        names = [check.name for check in self.failed]
        if self.verdict != "FAIL" or (len(names) < 2 and not has_fault(self.fdi)):
            return self.why
        reasons = (list_first(names, 1), describe_finding(self.fdi) if has_fault(self.fdi) else "")
        return "; ".join(filter(None, reasons))


_STATUS = {"ERROR": 1, "FAIL": 1, "ABORTED": 1, "NOT_RUN": 1, "INVALID_TIMING": 3, "CANNOT_TELL": 1,
           "NOT_JUDGED": 0}  # worst first


def find_verdict(results: Sequence[CaseResult]) -> str:
    """The worst verdict of the cases: that of the suite."""
    verdicts = {result.verdict for result in results}
    return next((word for word in _STATUS if word in verdicts), "PASS")


def find_status(results: Sequence[CaseResult], *, is_interrupted: bool) -> int:
    """The exit status of a suite: 130 interrupted, 1 if a case did not pass, 3 if the timing of one is invalid, 0."""
    return INTERRUPTED if is_interrupted else _STATUS.get(find_verdict(results), 0)


def run_cases(cases: Sequence[Case], processes: int, show: Callable[[CaseResult], None],
              patience: float = 5.0) -> tuple[list[CaseResult], bool]:
    """Run all cases.

    Args:
        cases: what to run; each has been tried (`build_suite`).
        processes: how many run at a time.
        show: called with each result as it comes.
        patience: s that a run that is broken off has to come to rest and close its log.

    Returns:
        The results in the order of the cases, and whether Ctrl-C has interrupted them: then some are NOT_RUN.

    Raises:
        RigError: a worker process cannot start.
    """
    results: dict[str, CaseResult] = {}
    is_interrupted = False
    pairs = run_in_processes(play_case, cases, processes, lambda case, reason: CaseResult(case, "ERROR", reason),
                             attempts=1, choose_limit=lambda case: case.timeout or UNLIMITED, patience=patience)
    with contextlib.closing(pairs):  # type: ignore[type-var]  # a generator
        try:
            for case, result in pairs:
                results[case.name] = result
                show(result)
        except KeyboardInterrupt:
            is_interrupted = True
    missing = "the suite was interrupted before it had finished"
    return [results.get(case.name) or CaseResult(case, "NOT_RUN", missing) for case in cases], is_interrupted


def play_case(case: Case) -> CaseResult:
    """Run a case and write its page. Errors are part of the result; an internal one is written to error.txt."""
    clock = WallClock()
    try:
        with catch_termination(case.choice.bus) as is_to_stop:
            def end_if_asked(stage: str, share: float) -> None:  # during a diagnosis, which follows the run
                if is_to_stop():
                    raise SystemExit(128 + signal.SIGTERM)

            # the code was announced when it was tried
            job = build_job(case.choice, is_trusted=True, announce=lambda text: None)
            diagnose = partial(diagnose_run, job=job, progress=end_if_asked, workers=1)
            outcome = run_job(job, case.folder, ignore_progress, is_to_stop,
                              diagnose=diagnose if case.choice.is_diagnosed else None)
            write_run_page(case.folder / "trace.mcap", case.folder / "report.html")
    except RigError as error:
        return CaseResult(case, "ERROR", str(error), 1e-9 * clock.now())
    except Exception as error:
        case.folder.mkdir(parents=True, exist_ok=True)
        (case.folder / "error.txt").write_text(traceback.format_exc())
        text = f"internal error, {type(error).__name__}: {error} ({case.folder}/error.txt)"
        return CaseResult(case, "ERROR", text, 1e-9 * clock.now())
    return make_result(case, outcome, 1e-9 * clock.now())


def make_result(case: Case, outcome: Outcome, seconds: float) -> CaseResult:
    """The result of a case from the outcome of its run, which took `seconds`."""
    return CaseResult(case, outcome.verdict, outcome.why, seconds, tuple(outcome.checks),
                      find_differences(outcome.job)["text"], outcome.fdi, tuple(outcome.skipped))


@contextlib.contextmanager
def catch_termination(bus: str, patience: float = 1.0) -> Iterator[Callable[[], bool]]:
    """Give a function that says whether the run is to stop: whether this process was sent SIGTERM.

    On the embedded bus there is nothing to bring to rest. There the process ends `patience` s after the signal if the
    run has not stopped by then, for it may be in a user's function that does not return; the log is closed.
    """
    is_asked = False
    is_embedded = bus.partition(":")[0] in EMBEDDED_NAMES

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal is_asked
        is_asked = True
        if is_embedded:
            signal.setitimer(signal.ITIMER_REAL, patience)

    with handle_signals({signal.SIGTERM: ask, signal.SIGALRM: exit_on_signal}):
        try:
            yield lambda: is_asked
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)


MOODS: dict[str, Mood] = {**RUN_MOODS, "ERROR": "bad", "NOT_RUN": "doubtful"}


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
    requirements = trace_requirements((result.judged for result in results), suite.requirements)
    verdict = find_verdict(results)
    facts = [("cases", count_verdicts([result.verdict for result in results])),
             ("wall-clock time", f"{seconds:.1f} s, {processes} at a time"),
             *([("suite file", suite.source)] if suite.source else []),
             *([("requirements", count_verdicts([each.verdict for each in requirements]))] if requirements else [])]
    missing = [each.id for each in requirements if each.verdict == "NOT_COVERED"]
    return Report(
        command="run", title=suite.title, verdict=verdict, mood=MOODS[verdict], sentence=_describe(results),
        facts=facts, notes=[f"no check verifies {', '.join(missing)}"] if missing else [],
        sections=[Section("Cases", _tabulate_cases(results, folder)),
                  Section("Checks that did not pass", _tabulate_failures(results, folder), title_medium=Medium.BOTH),
                  Section("Faults found by rig fdi", _tabulate_faults(results, folder), title_medium=Medium.BOTH),
                  Section("Requirements", tabulate_requirements(requirements), title_medium=Medium.BOTH)],
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
    names = list_first([result.case.name for result in bad], most)
    return f"{len(bad)} of {count_nouns(len(results), 'case')} did not pass: {names}."


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
        (Column("verdict"), lambda row: Cell(row[1].verdict, "bad" if row[0].verdict == "FAIL" else "doubtful")),
        (Column("measured", align="right"), lambda row: row[1].shown_value),
        (Column("U", align="right"), lambda row: row[1].shown_uncertainty),
        (Column("limits", align="right"), lambda row: row[1].shown_limits),
        (Column("unit"), lambda row: row[1].unit_behind.strip()),
        (Column("requirement"), lambda row: row[1].requirement), terminal_rows=30)]


def _tabulate_faults(results: Sequence[CaseResult], folder: Path) -> list[Table]:
    """Level and size of both faults in each case that asked for a diagnosis; what both share stands once."""
    from fdi.report import LEVEL_MOODS, LEVEL_NAMES, VERDICT_MOODS, FoundFault, list_found_faults

    moods = {name: LEVEL_MOODS[level] for level, name in LEVEL_NAMES.items()}
    rows = [(result if number == 0 else None, fault) for result in results if result.fdi
            for number, fault in enumerate(list_found_faults(result.fdi) or [FoundFault("", "", "")])]

    def show_verdict(result: CaseResult | None) -> Cell:
        word = result.fdi["verdict"] if result else ""
        return Cell(word, VERDICT_MOODS.get(word, "bad" if result and has_fault(result.fdi) else "doubtful"))

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


def collect_data(suite: Suite, results: Sequence[CaseResult], requirements: Sequence[Requirement], seconds: float,
                 processes: int) -> dict[str, Any]:
    """The JSON answer of a suite."""
    cases = [{
        "name": result.case.name, "verdict": result.verdict, "why": result.why, "seconds": round(result.seconds, 3),
        "folder": str(result.case.folder), "sequence": result.case.choice.sequence, "model": result.case.choice.model,
        "bench": result.case.choice.bench, "set": dict(result.case.choice.changes), "seed": result.case.choice.seed,
        "requirement": list(result.case.requirement),
        "differences": result.differences, "checks": [to_plain(check.collect_data()) for check in result.checks],
        "not_applicable": [check._asdict() for check in result.skipped], "fdi": dict(result.fdi)}
        for result in results]
    return {"verdict": find_verdict(results), "title": suite.title, "cases": cases,
            "counts": dict(Counter(result.verdict for result in results)), "seconds": round(seconds, 3),
            "jobs": processes,
            "requirements": [each.to_json() for each in requirements]}


def write_junit(title: str, results: Sequence[CaseResult]) -> str:
    """The JUnit XML of these results."""
    return junit.write_junit(title, [_make_suite(title, result) for result in results])


def write_junit_of_run(outcome: Outcome, seconds: float) -> str:
    """The JUnit XML of one run, which took `seconds` of wall-clock time."""
    job = outcome.job
    checks = tuple(JudgedCheck(check.name, check.requirements) for check in job.sequence.checks)
    choice = JobChoice(job.sequence.name, job.model.name, {}, job.seed)
    case = Case(Path(job.sequence.name).stem, choice, folder=outcome.folder, checks=checks)
    return write_junit("rig run", [make_result(case, outcome, seconds)])


def _make_suite(title: str, result: CaseResult) -> junit.TestSuite:
    case = result.case
    classname = ".".join(text.replace(".", "_") for text in (title, case.name))
    properties = [("folder", str(case.folder)), ("sequence", case.choice.sequence), ("seed", str(case.choice.seed)),
                  ("verdict", result.verdict), ("differs from nominal", result.differences),
                  *([("model", case.choice.model)] if case.choice.model else []),
                  *(("requirement", f"{name}: whole run") for name in case.requirement),
                  *(("requirement", f"{name}: {check.name}") for check in case.checks for name in check.requirement)]
    tests = [_make_run_test(result, classname),
             *(_make_check_test(check, result, classname) for check in result.checks),
             *(junit.TestCase(check.name, classname, problem="skipped", message=f"not applicable: {check.reason}")
               for check in result.skipped),
             *([_make_diagnosis_test(result, classname)] if result.fdi else [])]
    return junit.TestSuite(case.name, tests, properties, result.seconds)


def _make_run_test(result: CaseResult, classname: str) -> junit.TestCase:
    """The run as a whole: it came to its end and could be judged. Its checks are tests of their own."""
    test = junit.TestCase("run", classname, result.seconds, message=result.why,
                          output=_name_requirements(result.case.requirement))
    if result.verdict == "ABORTED" or (result.verdict == "FAIL" and not result.failed and not has_fault(result.fdi)):
        return test._replace(problem="failure", detail=result.verdict)
    if result.verdict in ("INVALID_TIMING", "ERROR"):
        return test._replace(problem="error", detail=result.verdict)
    is_cut_off = result.verdict == "CANNOT_TELL" and not any(check.cannot_tell for check in result.checks)
    if is_cut_off or result.verdict in ("NOT_JUDGED", "NOT_RUN"):
        return test._replace(problem="skipped", message=f"{result.verdict}: {result.why}")
    return test


def _make_check_test(check: CheckResult, result: CaseResult, classname: str) -> junit.TestCase:
    description = check.describe() + (f" ({check.detail})" if check.detail else "")
    window = "" if check.t0 != check.t0 else f"; window {check.t0:.3f} to {check.t1:.3f} s"
    test = junit.TestCase(check.name, classname, output="\n".join(
        filter(None, (description + window, _name_requirements(check.requirements)))))
    if check.passed:
        return test
    if check.cannot_tell or result.verdict in ("INVALID_TIMING", *NO_VERDICT):
        word = check.verdict if check.cannot_tell else result.verdict
        return test._replace(problem="skipped", message=f"{word}: {description}")
    return test._replace(problem="failure", message=description, detail=f"{check.kind} {check.signal}".strip() + window)


def _make_diagnosis_test(result: CaseResult, classname: str) -> junit.TestCase:
    """The diagnosis of `rig fdi`: a failure with a fault, skipped where it leaves the level of one open."""
    word, sentence = result.fdi["verdict"], result.fdi["sentence"]
    faults = describe_faults(result.fdi).replace("; ", "\n")
    test = junit.TestCase("rig fdi", classname, message=sentence, output=f"{word}: {sentence}\n{faults}".strip())
    if word == "CANNOT_TELL" or (has_fault(result.fdi) and result.verdict == "INVALID_TIMING"):
        return test._replace(problem="skipped", message=f"{word}: {sentence}")
    return test._replace(problem="failure", detail=faults or word) if has_fault(result.fdi) else test


def _name_requirements(names: Sequence[str]) -> str:
    return f"requirement {', '.join(names)}" if names else ""
