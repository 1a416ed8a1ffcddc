"""What goes into a package: runs as they were written, inputs from their logs, a bill of materials, coverage."""

import hashlib
import json
import platform
import re
from collections.abc import Iterable, Mapping
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, NamedTuple

from fdi.report import to_plain
from fdi.trace import Trace
from plant import InputError, decode_text, read_file, require
from rig.evidence.package import INDEX
from rig.evidence.requirements import RUN, JudgedCheck, JudgedRun, Requirement

ROOT = "eha-rig"


def build_bill(created: str) -> dict[str, Any]:
    """The bill of this Python environment: the program, what it requires, and those of its extras that are installed.

    `created`: time in UTC, ISO 8601.
    """
    packages: dict[str, Distribution] = {}
    needs: dict[str, list[str]] = {}
    waiting = [ROOT]
    while waiting:
        name = waiting.pop()
        if name in packages:
            continue
        try:
            packages[name] = distribution(name)
        except PackageNotFoundError:  # of an extra that is not installed, or for another system
            continue
        needs[name] = sorted({_normalise(text) for text in packages[name].requires or ()
                              if name == ROOT or "extra ==" not in text})
        waiting += needs[name]
    components = {name: _describe(name, each) for name, each in sorted(packages.items())}
    own = {**components.pop(ROOT, {"name": ROOT, "bom-ref": ROOT}), "type": "application"}
    python = {"type": "platform", "name": platform.python_implementation(), "version": platform.python_version(),
              "bom-ref": "python"}
    return {"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1,
            "metadata": {"timestamp": created, "component": own}, "components": [python, *components.values()],
            "dependencies": [{"ref": found_ref["bom-ref"],
                              "dependsOn": [components[need]["bom-ref"] for need in needs[name] if need in components]}
                             for name, found_ref in {ROOT: own, **components}.items() if name in needs]}


def _normalise(requirement: str) -> str:
    """The normal form of a package's name (PEP 503): "Python_CAN>=4" is python-can."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement, maxsplit=1)[0]).lower()


def _describe(name: str, package: Distribution) -> dict[str, Any]:
    purl = f"pkg:pypi/{name}@{package.version}"
    component = {"type": "library", "name": name, "version": package.version, "bom-ref": purl, "purl": purl}
    metadata = package.metadata.json  # its license as an expression, or in words that may be all of its text
    if "license_expression" in metadata:
        return {**component, "licenses": [{"expression": metadata["license_expression"]}]}
    lines = str(metadata.get("license", "")).splitlines()
    return {**component, "licenses": [{"license": {"name": lines[0]}}]} if len(lines) == 1 else component


BILL = "sbom.cdx.json"
_SETTINGS = ("sequence", "model", "bench", "seed", "bus", "pace", "controller", "plant", "started", "git.commit",
             "git.state")


class PackedRun(NamedTuple):
    """A run that goes into a package."""

    answer: Mapping[str, Any]  # verdict.json
    trace: Trace
    judged: JudgedRun  # what it says about requirements; its name is that of its folder in the package


class Package(NamedTuple):
    """The runs of a package, cases of suites that have no run, the ids and texts that suites list, and all files."""

    runs: list[PackedRun]
    lost: list[JudgedRun]
    listed: dict[str, str]
    files: dict[str, bytes | Path]


def collect_runs(sources: Iterable[str]) -> Package:
    """All runs in these folders, of single runs or of suites, each once, with everything that lies in them.

    Raises:
        InputError: a folder without a run, or a run whose verdict.json is not what its log says.
    """
    package = Package([], [], {}, {})
    bases: set[str] = set()
    roots = {root.resolve(): root for source in map(Path, sources)
             for root in [source.parent if source.name == "trace.mcap" else source]}
    for root in (root for place, root in roots.items() if not roots.keys() & {*place.parents}):
        verdicts = sorted(root.rglob("verdict.json"))
        require(verdicts, root, "", "the folder of a run or suite, with the verdict.json of a run in it")
        stem = root.resolve().name
        base = next(name for number in range(1, len(bases) + 2)
                    if (name := stem if number == 1 else f"{stem}-{number}") not in bases)
        bases.add(base)
        package.files.update({f"runs/{base}/{file.relative_to(root).as_posix()}": file
                              for file in sorted(root.rglob("*")) if file.is_file() and not file.is_symlink()})
        cases = _read_suite(root / "suite.json", base, package) if (root / "suite.json").is_file() else {}
        for file in verdicts:
            name = Path(base, file.parent.relative_to(root)).as_posix()
            run = _read_run(file, name, cases.pop(file.parent.name, JudgedRun(name, "", (), ())).requirement)
            package.runs.append(run)
            package.files.update({f"inputs/{name}/{attachment}": content
                                  for attachment, content in run.trace.attachments.items()})
        package.lost.extend(cases.values())
    return package


def _read_json(file: Path) -> Any:
    try:
        return json.loads(decode_text(read_file(file), file))
    except (ValueError, RecursionError) as error:
        raise InputError(file, "", f"JSON as rig run writes it ({error})") from error


def _read_suite(file: Path, base: str, package: Package) -> dict[str, JudgedRun]:
    """The cases of a suite by their folder; its requirements are added to the package."""
    try:
        answer = _read_json(file)
        cases = {}
        for case in answer["cases"]:
            checks = [JudgedCheck(proof["check"], (each["id"],)) for each in answer["requirements"]
                      for proof in each["checks"] if proof["case"] == case["name"] and proof["check"] != RUN]
            folder = Path(case["folder"]).name
            cases[folder] = JudgedRun(f"{base}/{folder}", case["verdict"], tuple(case["requirement"]), checks)
        package.listed.update({each["id"]: each["text"] for each in answer["requirements"]})
    except (KeyError, TypeError) as error:
        raise InputError(file, "", f"the answer of a suite ({error})") from error
    return cases


def _read_run(file: Path, name: str, requirement: tuple[str, ...]) -> PackedRun:
    """A run, whose verdict.json must be what its log says: by its SHA-256, which logs of earlier versions lack."""
    trace = Trace.read(file.parent / "trace.mcap", all=True)
    try:
        answer, digest = _read_json(file), hashlib.sha256(read_file(file)).hexdigest()
        answer_rows = [(each["name"], each["value"], each["verdict"], ", ".join(each["requirement"]))
                       for each in answer["checks"]]
        checks = [JudgedCheck(each["name"], tuple(each["requirement"]), each["verdict"]) for each in answer["checks"]
                  if each["requirement"]]
        run = JudgedRun(name, answer["verdict"], requirement, checks)
    except (KeyError, TypeError) as error:
        raise InputError(file, "", f"the verdict of a run by this version ({error})") from error
    log_verdict = trace.provenance.get("verdict.verdict", "")
    log_rows = [(check.name, to_plain(check.value), check.verdict, check.requirement) for check in trace.checks]
    is_same = trace.provenance.get("verdict.sha256", digest) == digest
    require(is_same and run.verdict == log_verdict and answer_rows == log_rows, file, "verdict",
            f"what its log says, {log_verdict or 'no verdict'}, check by check and byte by byte")
    return PackedRun(answer, trace, run)


def add_index(package: Package, requirements: Iterable[Requirement], created: str) -> dict[str, Any]:
    """Add the index, which is returned, and the bill of materials to the files of a package.

    `created`: time in UTC, ISO 8601.
    """
    bill = build_bill(created)
    now = {each["name"]: each["version"] for each in (bill["metadata"]["component"], *bill["components"])
           if "version" in each}
    runs = []
    for run in package.runs:
        notes = run.trace.provenance
        versions = {key.removeprefix("version."): text for key, text in notes.items() if key.startswith("version.")}
        runs.append({
            "name": run.judged.name, "verdict": run.judged.verdict, "why": run.answer["why"],
            "decision": run.answer.get("decision"), "calibration": run.answer.get("calibration", {}),
            "settings": {key: notes[key] for key in _SETTINGS if key in notes},
            "machine": {key: notes.get(key, "") for key in ("host", "system", "python")}, "versions": versions,
            "other_versions": {name: now.get(name, "") for name, text in versions.items() if now.get(name) != text}})
    index: dict[str, Any] = {"created": created, "runs": runs,
                             "requirements": [each.to_json() for each in requirements]}
    package.files[INDEX] = json.dumps(index, indent=1).encode() + b"\n"
    package.files[BILL] = json.dumps(bill, indent=1).encode() + b"\n"
    return index
