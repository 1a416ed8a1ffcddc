"""A real SocketCAN interface: the bus tests, and a run by three processes, read again from candump's log.

Runs on this kernel's vcan0 or else in a User-Mode-Linux guest, booted once for the whole file. Without either it is
skipped, saying how to get it; with EHA_RIG_REQUIRE_VCAN=1 (as in CI) it fails instead.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import pytest
from log_rows import describe_first_difference
from plugin_bus import LEFT_TO_GUEST
from rig_command import job, play
from vcan_host import FOLDER, GUEST, guest_missing, in_guest, kernel_has_vcan0, skip_or_fail

from rig.recorder.convert import read_raw_frames

CYCLIC = (0x080, 0x182, 0x183, 0x202, 0x283)


def candump_frames(log: Path) -> list[tuple[int, bytes]]:
    """(COB-ID, data) of each line '(time) vcan0 183#0011..' of `candump -L`; ValueError on any other line."""
    frames = []
    for number, line in enumerate(log.read_text().splitlines(), 1):
        match = re.fullmatch(r"\(\d+\.\d+\) \w+ ([0-9A-F]{3})#((?:[0-9A-F]{2}){0,8})(?: [RT])?", line)
        if match is None:
            raise ValueError(f"{log}, line {number}: not a classical data frame with an 11-bit identifier: {line}")
        frames.append((int(match[1], 16), bytes.fromhex(match[2])))
    return frames


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the bus tests and the runs left what they found."""
    if not kernel_has_vcan0() and guest_missing():
        skip_or_fail(guest_missing())
    for tool in ("candump", "gcc"):
        if shutil.which(tool) is None:
            skip_or_fail(f"{tool} is missing")
    folder = tmp_path_factory.mktemp("vcan")
    subprocess.run([sys.executable, FOLDER / "inside.py", folder, "compile"], check=True)
    parts = ["three", "ecu"]
    parts = parts if kernel_has_vcan0() else ["bus", *parts]  # with a vcan0 here the bus tests ran here
    (folder / "output.txt").write_text(in_guest(sys.executable, FOLDER / "inside.py", folder, *parts).stdout)
    return folder


def test_bus_tests_pass_on_a_real_can_interface(out: Path, pytestconfig: pytest.Config) -> None:
    """All of them, none skipped, and no fewer than were left to the guest."""
    if kernel_has_vcan0():
        return  # they are part of this very session
    report = out / "bus.xml"
    assert report.exists(), (out / "output.txt").read_text()
    cases = ElementTree.parse(report).iter("testcase")
    outcomes = [{child.tag for child in case} & {"failure", "error", "skipped"} for case in cases]
    assert outcomes and not any(outcomes), (out / "output.txt").read_text()
    assert len(outcomes) >= pytestconfig.stash.get(LEFT_TO_GUEST, 0)


@pytest.fixture(scope="module")
def frames(out: Path) -> list[tuple[int, bytes]]:
    """What candump heard of the run by three processes: (COB-ID, data)."""
    assert (out / "facts.json").exists(), (out / "output.txt").read_text()
    return candump_frames(out / "candump.log")


def test_a_run_by_three_processes_passes(out: Path, frames: list[tuple[int, bytes]]) -> None:
    """Plant, firmware in C and sequencer are processes that share nothing but vcan0."""
    facts = json.loads((out / "facts.json").read_text())
    logs = "\n".join(f"{name}: {(out / f'{name}.log').read_text()}" for name in ("plant", "controller", "run"))
    text = (out / "run.json").read_text()
    assert text, f"rig run answered nothing: {facts}\n{logs}"
    answer = json.loads(text)
    failures = [check["name"] for check in answer["checks"] if not check["passed"]]
    assert (answer["verdict"], facts["status"]) == ("PASS", 0), f"{answer['why']}; failed: {failures}; {facts}\n{logs}"
    assert all(status in (0, 130) for status in facts["after_interrupt"].values()), logs
    assert Counter(cob_id for cob_id, _ in frames)[0x080] >= answer["timing"]["cycles"] == 450


def test_a_run_of_an_example_passes(out: Path) -> None:
    """In lockstep: the guest is too slow for real time."""
    text = (out / "ecu.json").read_text()
    assert text, (out / "output.txt").read_text()
    answer = json.loads(text)
    failures = [check["name"] for check in answer["checks"] if not check["passed"]]
    assert (answer["verdict"], failures, answer["timing"]["cycles"]) == ("PASS", [], 450), answer["why"]


def test_rows_are_byte_for_byte_those_of_the_builtin_controller(
    out: Path, frames: list[tuple[int, bytes]], tmp_path: Path
) -> None:
    """The firmware in C and the compiled plant on vcan0, beside all that is in Python on the embedded bus."""
    play(job(), tmp_path)
    assert describe_first_difference(out / "run", tmp_path) == "none in 450 rows"


def test_log_holds_what_was_on_the_bus(out: Path, frames: list[tuple[int, bytes]]) -> None:
    """The run's own log and candump count the same cyclic frames; boot-ups may come before the log is open."""
    bus_counts = Counter(cob_id for cob_id, _ in frames)
    log_counts = Counter(frame.cob_id for frame in read_raw_frames(out / "run" / "trace.mcap"))
    assert {cob_id: log_counts[cob_id] for cob_id in CYCLIC} == {cob_id: bus_counts[cob_id] for cob_id in CYCLIC}
    assert all(log_counts[cob_id] <= bus_counts[cob_id] for cob_id in log_counts)


def test_the_check_of_a_guest_names_the_missing_package(tmp_path: Path) -> None:
    """A kernel that is not there."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "GUEST_KERNEL": "linux.missing"}
    done = subprocess.run(["bash", GUEST, "--check"], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (125, "", 1)
    assert "apt-get install user-mode-linux" in done.stderr
