"""A test case: its number, what it expects, and the function that finds out; and what can come of it."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rig.conformance.target import Target

CHAPTERS = {
    1: "Electronic data sheet",
    2: "Object dictionary",
    3: "SDO",
    4: "PDO",
    5: "SYNC, EMCY and error control",
    6: "NMT",
    7: "Timing",
}


class Verdict(Enum):
    """What a case says about the node."""

    PASS = "pass"
    FAIL = "fail"
    NOT_APPLICABLE = "not applicable"  # the node has no such service, and need not have it
    SKIPPED = "skipped"  # it could not be found out here


class CaseEnd(Exception):
    """Ends a case with a verdict other than PASS; the text says what was measured, or why nothing was."""

    verdict = Verdict.FAIL


class CaseFailed(CaseEnd):
    """The node does not do what is expected."""


class CaseNotApplicable(CaseEnd):
    """The node does not have what the case tests, and need not have it."""

    verdict = Verdict.NOT_APPLICABLE


class CaseSkipped(CaseEnd):
    """The case cannot be run here."""

    verdict = Verdict.SKIPPED


Check = Callable[["Target"], str]


class Case(NamedTuple):
    """One test. `check` returns what it measured, or raises CaseEnd."""

    number: str  # "chapter.case"
    name: str
    section: str  # of CiA 301 version 4.2, or of another paper that is then named
    expected: str
    check: Check
    is_timed: bool = False  # its verdict depends on times that the tester measures

    @property
    def chapter(self) -> int:
        """Number of the chapter."""
        return int(self.number.partition(".")[0])

    @property
    def order(self) -> tuple[int, int]:
        """Key that sorts 3.2 before 3.10."""
        chapter, _, position = self.number.partition(".")
        return int(chapter), int(position)


class Result(NamedTuple):
    """What became of one case."""

    number: str
    name: str
    section: str
    expected: str
    measured: str
    verdict: Verdict
    seconds: float  # on the clock of the bus

    @property
    def chapter(self) -> int:
        """Number of the chapter."""
        return int(self.number.partition(".")[0])


def case(number: str, name: str, section: str, expected: str, is_timed: bool = False) -> Callable[[Check], Case]:
    """Decorator that makes a test case of a function that measures."""

    def make(check: Check) -> Case:
        return Case(number, name, section, expected, check, is_timed)

    return make


def require(condition: bool, measured: str) -> None:
    """Fail the case unless the condition holds. Raises CaseFailed."""
    if not condition:
        raise CaseFailed(measured)


def require_applicable(condition: object, reason: str) -> None:
    """End the case as not applicable unless the condition holds. Raises CaseNotApplicable."""
    if not condition:
        raise CaseNotApplicable(reason)


def require_none(problems: Sequence[str]) -> None:
    """Fail the case with the problems that were found, unless there are none. Raises CaseFailed."""
    require(not problems, join_labels(problems))


def join_labels(labels: Sequence[str], most: int = 4) -> str:
    """A few of the labels, and how many more there are.

    >>> join_labels(["a", "b", "c"], 2)
    'a, b and 1 more'
    """
    shown = ", ".join(labels[:most])
    return f"{shown} and {len(labels) - most} more" if len(labels) > most else shown
