"""JUnit XML, which build servers read: suites of test cases with failures, errors and skips.

The elements and their order are those of the schema of Jenkins (junit-10.xsd of its xUnit plugin) and of the older one
that most other programs follow: a test case has neither properties nor elements of other names.
"""

import re
from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple
from xml.etree import ElementTree


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
    cases: Sequence[TestCase]
    properties: Sequence[tuple[str, str]] = ()
    seconds: float | None = None  # None: the sum of its tests


def write_junit(name: str, suites: Sequence[TestSuite]) -> str:
    """The JUnit XML of these suites. Control characters, which XML does not allow, become question marks."""
    counts = [Counter(case.problem for case in suite.cases) for suite in suites]
    root = ElementTree.Element(
        "testsuites", name=_clean(name), tests=str(sum(len(suite.cases) for suite in suites)),
        failures=str(sum(count["failure"] for count in counts)), errors=str(sum(count["error"] for count in counts)))
    for suite, count in zip(suites, counts, strict=True):
        seconds = sum(case.seconds for case in suite.cases) if suite.seconds is None else suite.seconds
        element = ElementTree.SubElement(
            root, "testsuite", name=_clean(suite.name), tests=str(len(suite.cases)), failures=str(count["failure"]),
            errors=str(count["error"]), skipped=str(count["skipped"]), time=f"{seconds:.3f}")
        if suite.properties:
            properties = ElementTree.SubElement(element, "properties")
            for key, value in suite.properties:
                ElementTree.SubElement(properties, "property", name=_clean(key), value=_clean(value))
        for case in suite.cases:
            _add_case(element, case)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add_case(suite: ElementTree.Element, case: TestCase) -> None:
    element = ElementTree.SubElement(suite, "testcase", name=_clean(case.name), classname=_clean(case.classname),
                                     time=f"{case.seconds:.3f}")
    if case.problem:
        problem = ElementTree.SubElement(element, case.problem, message=_clean(case.message))
        problem.text = _clean(case.detail) or None
    if case.output:
        ElementTree.SubElement(element, "system-out").text = _clean(case.output)


def _clean(text: str) -> str:
    """Without the control characters that XML does not allow."""
    return re.sub(r"[^\t\n\r\x20-\uD7FF\uE000-\uFFFD\U00010000-\U0010FFFF]", "?", text)
