"""The elements and attributes of JUnit XML that both schemas of Jenkins allow, and their order."""

import re
from pathlib import Path
from xml.etree import ElementTree

# element: (attributes it must have, others it may have, children in this order)
ELEMENTS: dict[str, tuple[set[str], set[str], list[str]]] = {
    "testsuites": (set(), {"name", "time", "tests", "failures", "errors"}, ["testsuite"]),
    "testsuite": ({"name", "tests", "failures", "errors"},
                  {"time", "skipped", "timestamp", "hostname", "id", "package"},
                  ["properties", "testcase", "system-out", "system-err"]),
    "properties": (set(), set(), ["property"]),
    "property": ({"name", "value"}, set(), []),
    "testcase": ({"name"}, {"time", "classname"}, ["skipped", "error", "failure", "system-out", "system-err"]),
    "skipped": (set(), {"message"}, []),
    "error": (set(), {"message", "type"}, []),
    "failure": (set(), {"message", "type"}, []),
    "system-out": (set(), set(), []),
    "system-err": (set(), set(), []),
}


def read_valid_junit(path: Path) -> ElementTree.Element:
    """The root of a file after it was held against the schema, and its counts against its test cases."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == "testsuites"
    for element in root.iter():
        required, optional, children = ELEMENTS[element.tag]
        assert required <= set(element.keys()) <= required | optional, element.attrib
        places = [children.index(child.tag) for child in element]
        assert places == sorted(places), [child.tag for child in element]
        if "time" in element.keys():  # noqa: SIM118 - an element, no dict
            assert re.fullmatch(r"\d+\.\d+", str(element.get("time")))
    for suite in root:
        for name, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            assert int(suite.get(name, 0)) == len(suite.findall(f"testcase/{tag}"))
        assert int(str(suite.get("tests"))) == len(suite.findall("testcase"))
    for name in ("tests", "failures", "errors"):
        assert int(str(root.get(name))) == sum(int(str(suite.get(name))) for suite in root)
    return root
