"""JUnit XML, which build servers read: suites of test cases with failures, errors and skips.

The elements and their order are those of the schema of Jenkins (junit-10.xsd of its xUnit plugin) and of the older one
that most other programs follow: a test case has neither properties nor elements of other names.
"""

import re
from collections.abc import Sequence
from typing import Literal, NamedTuple

from rig.templates import fill_template


class TestCase(NamedTuple):
    """One test. `problem` says why it has not passed; "" if it has."""

    name: str
    classname: str  # build servers group by it
    seconds: float = 0.0
    problem: Literal["", "failure", "error", "skipped"] = ""
    message: str = ""  # of the problem, one line
    detail: str = ""  # of the problem
    output: str = ""  # what a reader may want to know of a test that passed, too


class TestSuite(NamedTuple):
    """Tests that belong together."""

    name: str
    cases: list[TestCase]
    properties: Sequence[tuple[str, str]] = ()
    seconds: float | None = None  # None: the sum of its tests


def write_junit(name: str, suites: Sequence[TestSuite]) -> str:
    """The JUnit XML of these suites. Control characters, which XML does not allow, become question marks."""
    text = fill_template("junit.xml", name=name, suites=suites)
    return re.sub(r"[^\t\n\r\x20-\uD7FF\uE000-\uFFFD\U00010000-\U0010FFFF]", "?", text)
