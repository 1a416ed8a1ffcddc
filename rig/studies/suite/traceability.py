"""Which checks verify which requirement, and the verdict of each requirement."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rig.studies.suite.case import NO_VERDICT, CaseResult

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
