"""A case of a suite: what is run, and what came out."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rig.run.job_choice import JobChoice
from rig.run.servovalve import describe_finding, has_fault
from rig.sequences.checks import CheckResult

NO_VERDICT = ("ERROR", "NOT_RUN")  # cases without a run that was judged


class PlannedCheck(NamedTuple):
    """A check of the sequence of a case, as it is known before the run."""

    name: str
    requirement: tuple[str, ...]


class Case(NamedTuple):
    """One run of a suite."""

    name: str  # unique in the suite
    folder: Path  # of its results
    choice: JobChoice
    timeout: float  # s of wall-clock time
    checks: tuple[PlannedCheck, ...] = ()
    requirement: tuple[str, ...] = ()  # that the run as a whole verifies


class CaseResult(NamedTuple):
    """What came out of a case. `verdict` is that of the run, or ERROR (crash, timeout, bad input), or NOT_RUN."""

    case: Case
    verdict: str
    why: str = ""
    seconds: float = 0.0  # wall-clock time
    checks: tuple[CheckResult, ...] = ()
    differences: str = "nothing"  # from the nominal test
    fdi: Mapping[str, Any] = {}  # answer of `rig fdi`, if the case asked for it

    @property
    def failed(self) -> list[CheckResult]:
        """The checks that did not pass."""
        return [check for check in self.checks if not check.passed]

    @property
    def reason(self) -> str:
        """Why the case did not pass, in a few words: the first check that failed and the number of the others.

        A fault of the servovalve is named beside them. So is a diagnosis that leaves the level of a fault open.
        """
        if self.verdict == "PASS" and self.fdi.get("verdict") == "CANNOT_TELL":
            return "rig fdi cannot tell"
        failed = self.failed
        if self.verdict != "FAIL" or (len(failed) < 2 and not self.has_fault):
            return self.why
        more = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
        checks = [f"{failed[0].name}{more}"] if failed else []
        return "; ".join([*checks, describe_finding(self.fdi)] if self.has_fault else checks)

    @property
    def has_fault(self) -> bool:
        """Whether the diagnosis found a fault of the servovalve beyond acceptable, or another deviation."""
        return has_fault(self.fdi)


def find_status(results: Sequence[CaseResult], *, is_interrupted: bool) -> int:
    """The exit status of a suite: 130 interrupted, 1 if a case did not pass, 3 if the timing of one is invalid, 0."""
    verdicts = {result.verdict for result in results}
    if is_interrupted:
        return 130
    if verdicts & {"FAIL", "ABORTED", *NO_VERDICT}:
        return 1
    return 3 if "INVALID_TIMING" in verdicts else 0


def find_verdict(results: Sequence[CaseResult]) -> str:
    """The worst verdict of the cases: that of the suite."""
    order = ("ERROR", "FAIL", "ABORTED", "NOT_RUN", "INVALID_TIMING", "NOT_JUDGED")
    verdicts = {result.verdict for result in results}
    return next((word for word in order if word in verdicts), "PASS")
