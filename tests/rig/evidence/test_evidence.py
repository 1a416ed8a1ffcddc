"""Packages of runs: everything is in them, every changed byte is found; requirements from CSV and ReqIF are covered."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from refusals import catch_refusal
from rig_command import SHORT, answer, refuse, rig, write_file

from fdi.progress import ignore_progress
from rig.evidence.package import verify_package, write_package
from rig.evidence.requirements import read_requirements

CSV = "\ufeffID;Title\nREQ-1;A step overshoots by at most 30 %\nREQ-2;\"No; emergency\"\nREQ-3;Nobody checks this\n"
REQIF = """<?xml version="1.0"?>
<REQ-IF xmlns="http://www.omg.org/spec/ReqIF/20110401/reqif.xsd" xmlns:h="http://www.w3.org/1999/xhtml"><CORE-CONTENT>
<REQ-IF-CONTENT><SPEC-TYPES><SPEC-OBJECT-TYPE IDENTIFIER="t"><SPEC-ATTRIBUTES>
<ATTRIBUTE-DEFINITION-STRING IDENTIFIER="a1" LONG-NAME="ReqIF.ForeignID"/>
<ATTRIBUTE-DEFINITION-XHTML IDENTIFIER="a2" LONG-NAME="ReqIF.Text"/>
<ATTRIBUTE-DEFINITION-STRING IDENTIFIER="a3" LONG-NAME="ReqIF.ChapterName"/></SPEC-ATTRIBUTES></SPEC-OBJECT-TYPE>
</SPEC-TYPES><SPEC-OBJECTS>
<SPEC-OBJECT IDENTIFIER="o0"><VALUES><ATTRIBUTE-VALUE-STRING THE-VALUE="Steps"><DEFINITION>
<ATTRIBUTE-DEFINITION-STRING-REF>a3</ATTRIBUTE-DEFINITION-STRING-REF></DEFINITION></ATTRIBUTE-VALUE-STRING></VALUES>
</SPEC-OBJECT>
<SPEC-OBJECT IDENTIFIER="o1"><VALUES><ATTRIBUTE-VALUE-STRING THE-VALUE="REQ-1"><DEFINITION>
<ATTRIBUTE-DEFINITION-STRING-REF>a1</ATTRIBUTE-DEFINITION-STRING-REF></DEFINITION></ATTRIBUTE-VALUE-STRING>
<ATTRIBUTE-VALUE-XHTML><DEFINITION><ATTRIBUTE-DEFINITION-XHTML-REF>a2</ATTRIBUTE-DEFINITION-XHTML-REF></DEFINITION>
<THE-VALUE><h:div>A step <h:b>overshoots</h:b> little</h:div></THE-VALUE></ATTRIBUTE-VALUE-XHTML></VALUES></SPEC-OBJECT>
<SPEC-OBJECT IDENTIFIER="o2" LONG-NAME="REQ-2" DESC="No emergency"/>
</SPEC-OBJECTS></REQ-IF-CONTENT></CORE-CONTENT></REQ-IF>
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with requirements, a run and a suite whose checks name them, and the package of both as folder and zip.
    """
    folder = tmp_path_factory.mktemp("evidence")
    (folder / "req.csv").write_text(CSV)
    (folder / "short.toml").write_text(SHORT.replace("high = 30.0", 'high = 30.0, requirement = "REQ-1"').replace(
        'event = "EMCY"', 'event = "EMCY", requirement = ["REQ-2"]'))
    (folder / "suite.toml").write_text('title = "s"\nrequirements = "req.csv"\n[[case]]\nsequence = "short.toml"\n'
                                       'seed = [1, 2]\nrequirement = "REQ-2"\n')
    assert rig("run", folder / "short.toml", "--out", folder / "run", "--quiet").status == 0
    assert rig("run", folder / "suite.toml", "--out", folder / "suite", "--quiet").status == 0
    for out in ("pack", "pack.zip"):
        assert rig("evidence", folder / "run", folder / "run", folder / "suite", folder / "suite/short-seed-1",
                   "--quiet", "--requirements", folder / "req.csv", "--out", folder / out).status == 0
    return folder


@pytest.fixture
def package(runs: Path, tmp_path: Path) -> Path:
    """A copy of the package to spoil."""
    return Path(shutil.copytree(runs / "pack", tmp_path / "pack"))


def test_the_package_has_everything(runs: Path) -> None:
    index = json.loads((runs / "pack/evidence.json").read_text())
    assert [run["name"] for run in index["runs"]] == ["run", "suite/short-seed-1", "suite/short-seed-2"]
    assert all(run["verdict"] == "PASS" and run["machine"]["system"] and not run["other_versions"]
               for run in index["runs"])
    requirements = {each["id"]: (each["verdict"], len(each["checks"])) for each in index["requirements"]}
    assert requirements == {"REQ-1": ("PASS", 3), "REQ-2": ("PASS", 5), "REQ-3": ("NOT_COVERED", 0)}
    assert (runs / "pack/inputs/run/bench/eha.toml").is_file() and (runs / "pack/inputs/run/model.toml").is_file()
    assert (runs / "pack/runs/suite/suite.json").is_file()
    bill = json.loads((runs / "pack/sbom.cdx.json").read_text())
    assert (bill["bomFormat"], bill["metadata"]["component"]["name"]) == ("CycloneDX", "eha-rig")
    assert {"numpy", "can", "protobuf"} - {each["name"] for each in bill["components"]} == {"can"}  # python-can
    refs = {each["bom-ref"] for each in (*bill["components"], bill["metadata"]["component"])}
    assert all({each["ref"], *each["dependsOn"]} <= refs for each in bill["dependencies"])
    if shutil.which("sha256sum"):  # another program comes to the same result
        command = ["sha256sum", "--check", "--strict", "--quiet", "MANIFEST.sha256"]
        subprocess.run(command, cwd=runs / "pack", check=True)


def test_what_was_not_touched_is_intact_and_the_same_files_give_the_same_bytes(runs: Path, tmp_path: Path) -> None:
    assert all(answer("evidence", "--verify", runs / name)["seal"] for name in ("pack", "pack.zip"))
    contents = {"b/c": b"1" * 100_000, "a": b""}
    for name in ("1.zip", "2.zip", "d"):
        assert write_package(contents, tmp_path / name, "", ignore_progress)
        assert verify_package(tmp_path / name).is_intact
    assert (tmp_path / "1.zip").read_bytes() == (tmp_path / "2.zip").read_bytes()
    assert zipfile.ZipFile(tmp_path / "1.zip").testzip() is None


def spoil(package: Path, what: str) -> None:
    verdict = package / "runs/run/verdict.json"
    if what == "bit":
        data = bytearray((package / "runs/run/trace.mcap").read_bytes())
        data[len(data) // 2] ^= 1
        (package / "runs/run/trace.mcap").write_bytes(data)
    elif what == "link":
        verdict.rename(package.parent / "elsewhere")
        verdict.symlink_to(package.parent / "elsewhere")
    elif what == "renamed":
        verdict.rename(verdict.with_name("verdict.txt"))
    elif what == "manifest":
        (package / "MANIFEST.sha256").write_text((package / "MANIFEST.sha256").read_text() + "\n")
    elif what == "unreadable":
        shutil.rmtree(package / "inputs/run/bench")
        (package / "inputs/run/bench").write_text("a file in place of a folder")


@pytest.mark.parametrize(("what", "lines"), [
    ("bit", ["changed   runs/run/trace.mcap"]), ("link", ["changed   runs/run/verdict.json"]),
    ("renamed", ["missing   runs/run/verdict.json", "added     runs/run/verdict.txt"]),
    ("manifest", ["changed   MANIFEST.sha256"]), ("unreadable", ["missing   inputs/run/bench/eha.toml",
                                                                "added     inputs/run/bench"])])
def test_a_spoiled_folder_is_told_by_file(what: str, lines: list[str], package: Path) -> None:
    spoil(package, what)
    result = rig("evidence", "--verify", package)
    assert result.status == 1 and "CHANGED" in result.out
    assert [line for line in lines if line not in result.out] == [], result.out
    assert set(answer("evidence", "--verify", package, status=1)) > {"changed", "missing", "added"}


def test_every_byte_of_a_zip_counts(tmp_path: Path) -> None:
    """A bit of every byte, one after the other, and a byte at the end; never a traceback, never "no zip"."""
    write_package({"evidence.json": b"one", "b/c": b"two"}, tmp_path / "p.zip", "", ignore_progress)
    good = (tmp_path / "p.zip").read_bytes()
    for at in range(len(good) + 1):
        data = bytearray(good + b"\0" * (at == len(good)))
        data[at] ^= 0x10
        (tmp_path / "p.zip").write_bytes(data)
        assert not verify_package(tmp_path / "p.zip").is_intact, at


def write_evil(path: Path, name: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, "x")
        archive.writestr("MANIFEST.sha256", "")
    return path


def test_bad_packages_are_refused_in_one_line(runs: Path, package: Path, tmp_path: Path) -> None:
    (package / "MANIFEST.sha256").write_text("0" * 64 + "  ../../etc/passwd\n")
    for path, words in ((write_file(tmp_path / "no.zip", "no zip"), "a folder or zip that rig evidence made"),
                        (tmp_path / "nothing", "a folder or zip that rig evidence made"),
                        (runs / "run", "a package of rig evidence, which has this file"),
                        (package, "MANIFEST.sha256:1: expected a file of the package, not '../../etc/passwd'"),
                        (write_evil(tmp_path / "1.zip", "../x"), "names that stay in the package, not '../x'"),
                        (write_evil(tmp_path / "2.zip", "/x"), "names that stay in the package")):
        assert words in refuse("evidence", "--verify", path)
    hostile = {"inputs/../../x": b""}  # an attachment of a log
    assert "whose names stay in the folder" in catch_refusal(
        write_package, hostile, tmp_path / "out.zip", "", ignore_progress)


def test_bad_input_of_packing_is_refused(runs: Path, tmp_path: Path) -> None:
    forgery = Path(shutil.copytree(runs / "run", tmp_path / "run"))
    verdict = json.loads((forgery / "verdict.json").read_text())
    verdict["checks"][0]["high"] += 1.0
    (forgery / "verdict.json").write_text(json.dumps(verdict))
    (tmp_path / "other.csv").write_text("id\nREQ-1\n")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/verdict.json").write_text("[]")
    shutil.copy(runs / "run/trace.mcap", tmp_path / "broken")
    out = ("--out", tmp_path / "x.zip")
    for words, line in (
            ((), "at least one folder of a run"), ((tmp_path / "none", *out), "the folder of a run or suite"),
            ((forgery, *out), "verdict: expected what its log says, PASS, check by check and byte"),
            ((tmp_path / "broken", *out), "the verdict of a run by this version"),
            ((runs / "run", "--out", runs / "run/x.zip"), "a place outside the runs"),
            ((runs / "run", "--out", runs / "pack"), "a FILE.zip, or a folder that is new or empty"),
            ((runs / "run", "--out", runs / "pack.zip"), "--force replaces this one"),
            ((runs / "run", "--requirements", tmp_path / "other.csv", *out), "an id of"),
            ((runs / "run", "--verify", runs / "pack"), "it only reads")):
        assert line in refuse("evidence", *words)
    message = refuse("run", runs / "short.toml", "--requirements", tmp_path / "other.csv", *out)
    assert "requirement of 'no emergency': expected an id of" in message and "not 'REQ-2'" in message


def test_a_run_with_requirements_shows_their_coverage(runs: Path, tmp_path: Path) -> None:
    result = rig("run", runs / "short.toml", "--requirements", runs / "req.csv", "--out", tmp_path)
    assert result.status == 0 and "REQ-3        NOT_COVERED     0/0     0" in result.out
    assert "REQ-1" in (tmp_path / "suite.html").read_text()


@pytest.mark.parametrize(("name", "text", "outcome"), [
    ("r.csv", CSV, {"REQ-1": "A step overshoots by at most 30 %", "REQ-2": "No; emergency",
                    "REQ-3": "Nobody checks this"}),
    ("r.csv", "Requirement\tText\nA\tx\n", {"A": "x"}), ("r.csv", "id\nA\nB\n", {"A": "", "B": ""}),
    ("r.reqif", REQIF, {"REQ-1": "A step overshoots little", "REQ-2": "No emergency"}),
    ("r.csv", "name\nA\n", "r.csv:1: expected a column with ids"),
    ("r.csv", "id\nA\nA\n", "r.csv:3: id: expected an id"), ("r.csv", "id,text\n,x\n", "used once, not ''"),
    ("r.csv", 'id\n"A\n', "expected CSV"), ("r.csv", "id\n", "at least one"),
    ("r.xlsx", "", "a .csv or .reqif file"), ("r.reqif", "<a>", "r.reqif:1: expected ReqIF, which is XML"),
    ("r.reqif", "<a/>", "REQ-IF as outermost element, not a"),
    ("r.reqif", '<!DOCTYPE a [<!ENTITY b "c">]><a/>', "without a document type")])
def test_requirements(name: str, text: str, outcome: Any, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    if isinstance(outcome, dict):
        assert read_requirements(tmp_path / name) == outcome
    else:
        assert outcome in catch_refusal(read_requirements, tmp_path / name)


@pytest.mark.skipif(not shutil.which("gpg"), reason="no gpg")
def test_a_package_signed_by_gpg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = tmp_path / "g"
    home.mkdir(mode=0o700)
    monkeypatch.setenv("GNUPGHOME", str(home))
    for who in ("lab@example.org", "other@example.org"):
        subprocess.run(["gpg", "--batch", "--quiet", "--passphrase", "", "--quick-generate-key", who, "ed25519"],
                       check=True, capture_output=True)
    keys = subprocess.run(["gpg", "--list-keys", "--with-colons"], capture_output=True, text=True, check=True).stdout
    own_key, other_key = (line.split(":")[9] for line in keys.splitlines() if line.startswith("fpr:"))
    package = tmp_path / "p"
    write_package({"a": b"one"}, package, "lab@example.org", ignore_progress)
    assert "valid, by" in verify_package(package).signature and verify_package(package, own_key).is_intact
    assert not verify_package(package, other_key).is_intact
    (package / "a").write_text("two")  # and a manifest made anew
    again = tmp_path / "q"
    write_package({"a": b"two"}, again, "", ignore_progress)
    shutil.copy(again / "MANIFEST.sha256", package)
    assert verify_package(package).changed == ["MANIFEST.sha256.asc (not a valid signature by a key)"]
    assert verify_package(again, own_key).missing == [f"a signature by {own_key}"]
    subprocess.run(["gpgconf", "--kill", "gpg-agent"], check=False)
    assert "a key with which gpg signs" in catch_refusal(
        write_package, {}, tmp_path / "r", "nobody@example.org", ignore_progress)


def test_minisign_is_called_with_the_key_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program in its place that signs with the text of the secret key, and knows it by the public one."""
    fake = write_file(tmp_path / "minisign", f"#!{sys.executable}\n" + """
import sys
given = dict(zip(sys.argv[2::2], sys.argv[3::2]))
content = open(given["-m"]).read() + open(given.get("-s") or given["-p"]).read()
if sys.argv[1] == "-S":
    open(given["-x"], "w").write(content)
sys.exit(open(given["-x"]).read() != content)
""")
    fake.chmod(0o755)
    (tmp_path / "key").write_text("secret")
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    write_package({"a": b"one"}, tmp_path / "p.zip", str(tmp_path / "key"), ignore_progress)
    assert "not checked" in verify_package(tmp_path / "p.zip").signature
    assert verify_package(tmp_path / "p.zip", str(tmp_path / "key")).is_intact
    (tmp_path / "wrong").write_text("other")
    assert not verify_package(tmp_path / "p.zip", str(tmp_path / "wrong")).is_intact
