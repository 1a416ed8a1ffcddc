"""The results of runs as JUnit XML: a suite for each run, a test for each check and one for the run as a whole."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fdi.report.run_report import format_limits
from rig import junit
from rig.run.job_choice import JobChoice
from rig.run.outcome import Outcome
from rig.run.servovalve import describe_faults
from rig.sequences.checks import CheckResult
from rig.studies.suite.case import NO_VERDICT, Case, CaseResult, PlannedCheck
from rig.studies.suite.run_suite import make_result


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
    value = "not measurable" if check.value != check.value else f"{check.value:.4g}"
    unit = "" if check.unit == "1" else f" {check.unit}"
    measured = f"measured {value}{unit}, limits {format_limits(check.low, check.high)}{unit}"
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
