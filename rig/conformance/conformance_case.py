"""A test case: its number, what it expects, and the function that finds out; and what can come of it."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from fdi.report.numbers import count_nouns

if TYPE_CHECKING:
    from rig.conformance.target import Target

Item = TypeVar("Item")
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
    """The node does not do what is expected, and the case cannot go on."""


class Problem(CaseFailed):
    """One thing is not as expected. A case that looks at many things looks at the others all the same."""


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


def for_each(select: Callable[[Target], Iterable[Item]], probe: Callable[[Target, Item], str | None], noun: str = "",
             text: str = "{}") -> Check:
    """A check that probes one thing after the other: objects, PDOs, requests that must be refused.

    The probe raises Problem for a thing that is wrong, and CaseNotApplicable for one that does not count. The check
    measures the number of things, if there is a noun for them, or else what the probe returns for each; `text` is the
    sentence around it. Without anything that counts the case is not applicable.
    """
    def check(t: Target) -> str:
        found: list[str] = []
        problems: list[str] = []
        reason: CaseNotApplicable | None = None
        for item in select(t):
            try:
                found.append(probe(t, item) or "")
            except Problem as problem:
                problems.append(str(problem))
            except CaseNotApplicable as end:
                reason = reason or end
        require(not problems, join_labels(problems))
        if not found:
            raise reason or CaseNotApplicable("the EDS has no such object")
        return text.format(count_nouns(len(found), noun) if noun else join_labels(found, 8))

    return check


def require(condition: object, measured: str) -> None:
    """Raises Problem unless the condition holds."""
    if not condition:
        raise Problem(measured)


def require_applicable(condition: object, reason: str = "") -> None:
    """Raises CaseNotApplicable unless the condition holds."""
    if not condition:
        raise CaseNotApplicable(reason)


def join_labels(labels: Sequence[str], most: int = 4) -> str:
    """A few of the labels, and how many more there are. Semicolons part labels that have commas.

    >>> join_labels(["a", "b", "c"], 2), join_labels(["a, b", "c"])
    ('a, b and 1 more', 'a, b; c')
    """
    mark = "; " if any("," in label for label in labels) else ", "
    shown = mark.join(labels[:most])
    return f"{shown} and {len(labels) - most} more" if len(labels) > most else shown
