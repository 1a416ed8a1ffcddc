"""The command lines of README and tutorial, played in order in a fresh clone, and those of the other pages.

A part of another page has the files that its reader has; lines that are not played have a reason.
"""

import re
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from places import ROOT

DONE_BY_CI = {  # lines of README and tutorial that are read, but not run here
    "make preflight": "done in a fresh clone by .ci/run, with the installation",
    "make test": "done in a fresh clone by .ci/run",
}
NEEDS_HARDWARE = "socketcan:can0"  # such a line ends in one line and exit status 2
VERDICT = re.compile(r"^([A-Z][A-Z_]{3,})\b", re.MULTILINE)


class Step(NamedTuple):
    """A line to type, a file to write, or a verdict that the page shows as the answer."""

    kind: str  # "line", "file", "answer"
    text: str
    file: str = ""


class Played(NamedTuple):
    """What became of a line."""

    line: str
    status: int | None  # None: not run
    seconds: float
    faults: tuple[str, ...]


def list_steps(page: str) -> list[Step]:
    """The steps of a page in order: its indented blocks are lines to type, Python files, or answers.

    A remark behind a line that begins with a verdict is an answer, too.
    """
    steps: list[Step] = []
    for block in re.findall(r"(?:^    .*\n(?:\s*\n(?=    ))*)+", page, re.MULTILINE):
        code: list[str] = []  # of a file, from the line with its name to the next command
        for line in [line[4:] for line in block.splitlines()]:
            if re.match(r"# \w+\.py$", line) or (code and not line.startswith("rig ")):
                code.append(line)
                continue
            if code:
                steps.append(_make_file(code))
                code = []
            if re.match(r"(rig|make|mkdir|cp|cd) ", line):
                command, *remarks = re.split(r"\s{2,}#", line, maxsplit=1)
                steps.append(Step("line", command.strip()))
                for match in filter(None, (VERDICT.match(remark.strip()) for remark in remarks)):
                    steps.append(Step("answer", match[1]))
            elif verdict := VERDICT.match(line):
                steps.append(Step("answer", verdict[1]))
        if code:
            steps.append(_make_file(code))
    return steps


def _make_file(lines: Sequence[str]) -> Step:
    return Step("file", "\n".join(lines).rstrip() + "\n", lines[0][2:])


def play_page(page: str, folder: Path, environment: Mapping[str, str], not_played: Mapping[str, str] = DONE_BY_CI
              ) -> Iterator[Played]:
    """Type the lines of a page in a folder, in order. A verdict that the page shows must have been printed before."""
    printed: set[str] = set()
    is_played = True  # the last line
    for step in list_steps(page):
        if step.kind == "file":
            (folder / step.file).write_text(step.text)
        elif step.kind == "answer":
            if is_played and step.text not in printed:
                yield Played(f"shown answer {step.text}", None, 0.0, ("no line before it printed this verdict",))
            printed.discard(step.text)
        elif step.text in not_played:
            is_played = False
            yield Played(step.text, None, 0.0, ())
        else:
            outcome, folder, output = play_line(step.text, folder, environment)
            printed |= {*VERDICT.findall(output)}
            is_played = True
            yield outcome


def play_line(line: str, folder: Path, environment: Mapping[str, str], timeout: float = 900.0
              ) -> tuple[Played, Path, str]:
    """Type one line in a folder; what became of it, the folder afterwards, and what it printed."""
    start = time.monotonic()
    script = f"{line}\nstatus=$?; pwd > '{folder}/.where'; exit $status"
    done = subprocess.run(["bash", "-c", script], cwd=folder, env=dict(environment), capture_output=True, text=True,
                          timeout=timeout)
    seconds = time.monotonic() - start
    where = (folder / ".where").read_text().strip()
    (folder / ".where").unlink()
    faults = judge_line(line, done.returncode, done.stderr)
    return Played(line, done.returncode, seconds, tuple(faults)), Path(where), done.stdout


def judge_line(line: str, status: int, err: str) -> list[str]:
    """What is wrong with the end of a line; empty if nothing is."""
    good_statuses = (2,) if NEEDS_HARDWARE in line else (0, 1)
    faults = [] if status in good_statuses else [f"status {status}: {err.strip()[-200:]}"]
    if "Traceback" in err:
        faults.append("a traceback")
    if status == 2 and len(err.strip().splitlines()) != 1:
        faults.append(f"{len(err.strip().splitlines())} lines of error")
    return faults


class Part(NamedTuple):
    """A section of a page, or all of it, with the shell lines that make the files which a reader has."""

    page: str
    section: str = ""  # beginning of its title; "": the whole page
    prepare: str = ""


SEQUENCE = f"cp '{ROOT}/rig/sequences/preflight.toml' my_test.toml"
SAMPLES = "rig simulate --samples --quiet"
DATED = """mkdir unit7
for month in 1 2 3 4; do
  rig simulate --set filter.clogging=0.0$((2 * month)) --seed $month --out unit7/2026-0$month-01.csv --quiet
done"""
EXAMPLES = f"cp '{ROOT}/examples/cia402_drive/drive.eds' drive_x.eds; cp '{ROOT}/examples/can_ecu/ecu.dbc' ecu.dbc"
PARTS = (
    Part("docs/bench.md", "From a data sheet", EXAMPLES),
    Part("docs/commands.md", "Run a test", f"{SEQUENCE}\nrig run --out sent --quiet && cp sent/trace.mcap sent.mcap"),
    Part("docs/commands.md", "Look at a run",
         f"{SAMPLES}\nmv run.csv before.csv; mv run2.csv after.csv; cp before.csv bench.csv\n"
         "rig run --quiet && rig run --quiet"),
    Part("docs/commands.md", "Use your own controller", EXAMPLES),
    Part("docs/commands.md", "Test any CANopen node"),
    Part("docs/commands.md", "Simulate"),
    Part("docs/commands.md", "Find missing physics", f"{SAMPLES}\ncp held.csv other.csv"),
    Part("docs/commands.md", "Find faults",
         f"{SAMPLES}\nrig run --quiet; mkdir healthy\n"
         "for seed in 1 2 3 4 5; do rig simulate --seed $seed --out healthy/$seed.csv --quiet; done"),
    Part("docs/commands.md", "Judge many cases",
         f"{SAMPLES}\nmkdir traces && mv run.csv traces/\nrig campaign --fault healthy --seeds 1 --out mine --quiet"),
    Part("docs/commands.md", "Follow a unit", DATED),
    Part("docs/conformance.md"),
    Part("docs/diff.md"),
    Part("docs/effects.md"),
    Part("docs/evidence.md", "",
         "printf 'id,text\\nREQ-1,A reaction\\n' > requirements.csv\n"
         "printf 'title = \"a\"\\n[[case]]\\nsequence = \"lost_sync\"\\nrequirement = \"REQ-1\"\\n' > acceptance.toml"),
    Part("docs/firmware.md"),
    Part("docs/fmu.md", "A model as a unit",
         f"cp '{ROOT}/examples/cogging.py' my_effects.py\n"
         "printf 'effects = [\"cogging\"]\\n[cogging]\\nforce = 500.0\\n' > worn.toml"),
    Part("docs/import.md", "", SAMPLES),
    Part("docs/plants.md"),
    Part("docs/trend.md", "", f"{DATED}\nrig trend unit7/ --out unit7.json --quiet"),
    Part("docs/worked_cases.md"),
)

_HOURS = "takes an hour or more"
_MINUTES = "takes minutes; tests run the same command on short recordings"
_IN_TUTORIAL = "played by the tutorial, with a trace that needs it"
_WINDOW = "opens a window"
_OWN_GROUP = "on the default group, where other programs may be; tests run it on a group of their own"
_VCAN = "needs vcan0; tests run it in a guest that has one"
NOT_PLAYED = {
    "rig view runs/preflight": _WINDOW,
    "rig view run.csv --compare --repeat run2.csv": _WINDOW,
    "rig view run.csv --compare --model better.toml": _WINDOW,
    "rig view runs/preflight runs/preflight-2": _WINDOW,
    "rig run --live rerun": _WINDOW,
    "rig conformance plant --bus udp_multicast": _OWN_GROUP,
    "rig conformance c --bus udp_multicast": _OWN_GROUP,
    "rig run --controller c --bus socketcan:vcan0 --pace realtime": _VCAN,
    "rig run --controller external --bus socketcan:vcan0": _VCAN,
    "rig explain run.csv --repeat run2.csv --write-effect found.py": _IN_TUTORIAL,
    "rig explain run.csv --repeat run2.csv --effects found.py": _IN_TUTORIAL,
    "rig campaign --fault healthy --fault filter_clogging=0.1,0.25,0.35 --seeds 50 --out mine": _HOURS,
}
NOT_PLAYED_SECTIONS = {("docs/commands.md", "Find the parameters"): _MINUTES,
                       ("docs/explain.md", "Sizes that are named"): _MINUTES,
                       ("docs/commands.md", "Measure the software"): "measures for minutes to hours",
                       ("docs/bench.md", "Signals of the bench"): "needs a device on the bus; tests/rig/run plays it"}
NOT_PLAYED_PAGES = {
    "docs/bus.md": "two programs at once; tests/rig/network runs them",
    "docs/campaign.md": "docs/commands.md shows and plays the same lines",
    "docs/fdi.md": "TRACE stands for a file; tests/fdi/diagnosis runs these options",
    "docs/hardware.md": "needs CAN hardware and changes the machine",
    "docs/identify.md": _MINUTES,
    "docs/laws.md": _MINUTES,
    "docs/pytest.md": "tests/rig/testing runs the example of the page",
    "docs/real_cylinder.md": "needs recordings of others",
    "docs/real_data.md": "needs recordings of others",
    "docs/statistics.md": _HOURS,
    "docs/suite.md": "tests/rig/suite runs the suite of the page",
    "docs/tutorial_emps.md": "needs recordings of others",
}


def find_section(page: str, title: str) -> str:
    """The text of a section whose title begins so; all of the page for ""."""
    text = (ROOT / page).read_text()
    if not title:
        return text
    return next(part for part in text.split("\n## ") if part.startswith(title))


def list_command_lines(text: str) -> list[str]:
    """The lines of a text that a reader types, without the remark behind them."""
    return [re.split(r"\s{2,}#", line)[0].strip()
            for line in re.findall(r"^    ((?:rig|python|pytest) (?!=).*)", text, re.MULTILINE)]


def play_part(part: Part, folder: Path, environment: Mapping[str, str]) -> Iterator[Played]:
    """Make the files of a part in a new folder, and type its lines there.

    Raises:
        CalledProcessError: the files could not be made.
    """
    here = folder / (re.sub(r"\W+", "_", f"{part.page} {part.section}").strip("_"))
    here.mkdir()
    subprocess.run(["bash", "-ec", part.prepare], cwd=here, env=dict(environment), check=True, capture_output=True)
    yield from play_page(find_section(part.page, part.section), here, environment, NOT_PLAYED)
