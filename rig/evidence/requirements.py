"""Requirements: read from CSV or ReqIF, and traced to the checks and runs that verify them."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from fdi.report import Cell, Column, Medium, Mood, Table, tabulate
from plant import InputError, decode_text, read_file, require, suggest_name

RUN = "whole run"  # the name of what verifies a requirement of a case
NO_VERDICT = ("ERROR", "NOT_RUN")  # cases without a run that was judged
MOODS: dict[str, Mood] = {"PASS": "good", "FAIL": "bad", "OPEN": "doubtful", "NOT_COVERED": "doubtful"}
_ID_COLUMNS = ("id", "identifier", "requirement", "requirement id", "key")
_TEXT_COLUMNS = ("text", "description", "title", "name", "summary")
_REQIF = "{http://www.omg.org/spec/ReqIF/20110401/reqif.xsd}"


class JudgedCheck(NamedTuple):
    """A check that verifies requirements; the verdict is "" if it was not judged."""

    name: str
    requirement: tuple[str, ...]
    verdict: str = ""


class JudgedRun(NamedTuple):
    """A run with its verdict, the requirements that it verifies as a whole, and its checks."""

    name: str
    verdict: str
    requirement: tuple[str, ...]
    checks: Sequence[JudgedCheck]


class Evidence(NamedTuple):
    """A check of a case, or its whole run, that verifies a requirement."""

    case: str
    check: str
    verdict: str  # PASS, FAIL, or OPEN: not judged, or too uncertain


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

    def to_json(self) -> dict[str, Any]:
        """Its entry in an answer."""
        return {"id": self.id, "text": self.text, "verdict": self.verdict,
                "checks": [evidence._asdict() for evidence in self.evidence]}


def trace_requirements(runs: Iterable[JudgedRun], requirements: Mapping[str, str]) -> list[Requirement]:
    """All requirements: those that are listed, in their order, then others that a check or run names."""
    evidence_by_id: dict[str, list[Evidence]] = {name: [] for name in requirements}
    for run in runs:
        for name in run.requirement:
            verdict = {"PASS": "PASS", "FAIL": "FAIL", "ABORTED": "FAIL"}.get(run.verdict, "OPEN")
            evidence_by_id.setdefault(name, []).append(Evidence(run.name, RUN, verdict))
        proves_nothing = run.verdict in ("INVALID_TIMING", *NO_VERDICT)  # the bench was late, or there was no run
        for check in run.checks:
            verdict = "OPEN" if proves_nothing or check.verdict not in ("PASS", "FAIL") else check.verdict
            for name in check.requirement:
                evidence_by_id.setdefault(name, []).append(Evidence(run.name, check.name, verdict))
    return [Requirement(name, requirements.get(name, ""), tuple(evidence)) for name, evidence in evidence_by_id.items()]


def require_listed(runs: Iterable[JudgedRun], requirements: Mapping[str, str], file: object) -> None:
    """Refuse a requirement that a check or run names and the file does not list. Raises InputError."""
    for run in runs:
        for check in (JudgedCheck(RUN, run.requirement), *run.checks):
            for name in check.requirement:
                require(name in requirements, run.name, f"requirement of {check.name!r}",
                        f"an id of {file}, not {name!r}{suggest_name(name, requirements)}")


def tabulate_requirements(requirements: Sequence[Requirement]) -> list[Table]:
    """The table of coverage: requirement, checks, runs, verdict."""
    return [tabulate(
        requirements,
        (Column("requirement"), lambda each: each.id),
        (Column("text", medium=Medium.PAGE), lambda each: each.text),
        (Column("verdict"), lambda each: Cell(each.verdict, MOODS[each.verdict])),
        (Column("checks", align="right"), lambda each: f"{sum(proof.verdict == 'PASS' for proof in each.evidence)}/"
                                                       f"{len(each.evidence)}"),
        (Column("runs", align="right"), lambda each: str(len({proof.case for proof in each.evidence}))),
        (Column("verified by", medium=Medium.PAGE), lambda each: describe_evidence(each.evidence)),
        caption="Checks: passed of all, each counted in each run. OPEN: one was not judged, or is too uncertain. "
                "NOT_COVERED: no check verifies it.")]


def describe_evidence(evidence: Sequence[Evidence], most: int = 3) -> str:
    """What verifies a requirement: each check with the cases that it passed in, and the names of the others."""
    parts = []
    for check in dict.fromkeys(each.check for each in evidence):
        own = [each for each in evidence if each.check == check]
        bad = [f"{each.verdict} in {each.case}" for each in own if each.verdict != "PASS"]
        more = [f"{len(bad) - most} more"] if len(bad) > most else []
        parts.append(", ".join([f"{check}: PASS in {len(own) - len(bad)} of {len(own)}", *bad[:most], *more]))
    return "; ".join(parts)


def read_requirements(path: Path) -> dict[str, str]:
    """Ids and texts of the requirements in a file: CSV with a column `id` and mostly one `text`, or ReqIF.

    Raises:
        InputError: the file, and the line or object that cannot be used.
    """
    readers = {".csv": _read_csv, ".reqif": _read_reqif, ".xml": _read_reqif}
    require(path.suffix.lower() in readers, path, "", "a .csv or .reqif file with requirements")
    requirements: dict[str, str] = {}
    for place, name, text in readers[path.suffix.lower()](decode_text(read_file(path), path), path):
        require(name and name.isprintable() and name not in requirements, place, "id",
                f"an id in one line, used once, not {name[:80]!r}")
        requirements[name] = " ".join(text.split())
    require(requirements, path, "", "at least one requirement")
    return requirements


def _read_csv(text: str, path: Path) -> Iterator[tuple[str, str, str]]:
    """Place, id and text of each row; the columns are separated by commas, semicolons or tabs."""
    text = text.removeprefix("\ufeff")
    first = text.partition("\n")[0]
    rows = csv.DictReader(io.StringIO(text, newline=""), delimiter=max(",;\t", key=first.count), strict=True)
    try:
        columns = {name.strip().lower(): name for name in rows.fieldnames or ()}
        id_column = next((columns[name] for name in _ID_COLUMNS if name in columns), None)
        if id_column is None:
            raise InputError(f"{path}:1", "", f"a column with ids, one of {', '.join(_ID_COLUMNS)}")
        text_column = next((columns[name] for name in _TEXT_COLUMNS if name in columns), None)
        for row in rows:
            yield f"{path}:{rows.line_num}", (row[id_column] or "").strip(), row.get(text_column or "") or ""
    except csv.Error as error:
        raise InputError(f"{path}:{rows.line_num}", "", f"CSV ({error})") from error


def _read_reqif(text: str, path: Path) -> Iterator[tuple[str, str, str]]:
    """Place, id and text of each object that is no heading: ReqIF.ForeignID or LONG-NAME, ReqIF.Text or DESC."""
    require("<!DOCTYPE" not in text, path, "", "ReqIF without a document type, whose entities could fill the memory")
    try:
        root = ElementTree.fromstring(text.encode())
    except ElementTree.ParseError as error:
        raise InputError(f"{path}:{error.position[0]}", "", f"ReqIF, which is XML ({error})") from error
    require(root.tag == f"{_REQIF}REQ-IF", path, "", f"ReqIF 1.x: REQ-IF as outermost element, not {root.tag}")
    names = {each.get("IDENTIFIER", ""): each.get("LONG-NAME", "") for each in root.iter()
             if each.tag.startswith(f"{_REQIF}ATTRIBUTE-DEFINITION-") and "IDENTIFIER" in each.attrib}
    for thing in root.iter(f"{_REQIF}SPEC-OBJECT"):
        values = {}
        for value in thing.iterfind(f"{_REQIF}VALUES/*"):
            reference = value.find(f"{_REQIF}DEFINITION/*")
            content = value.find(f"{_REQIF}THE-VALUE")
            attribute = value.get("THE-VALUE", "") if content is None else "".join(content.itertext())
            values[names.get((reference.text or "").strip() if reference is not None else "", "")] = attribute.strip()
        if not values.get("ReqIF.ChapterName"):
            name = (values.get("ReqIF.ForeignID") or values.get("ID") or thing.get("LONG-NAME")
                    or thing.get("IDENTIFIER"))
            yield (f"{path}: SPEC-OBJECT {thing.get('IDENTIFIER')}", name or "", values.get("ReqIF.Text")
                   or values.get("ReqIF.Name") or thing.get("DESC") or "")
