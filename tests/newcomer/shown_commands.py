"""The command lines of README and tutorial, played in order in a fresh clone."""

import re
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

NOT_PLAYED = {  # what a line needs that is not here: it is read, but not run
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
                typed, *remarks = re.split(r"\s{2,}#", line, maxsplit=1)
                steps.append(Step("line", typed.strip()))
                for promised in filter(None, (VERDICT.match(remark.strip()) for remark in remarks)):
                    steps.append(Step("answer", promised[1]))
            elif found := VERDICT.match(line):
                steps.append(Step("answer", found[1]))
        if code:
            steps.append(_make_file(code))
    return steps


def _make_file(lines: Sequence[str]) -> Step:
    return Step("file", "\n".join(lines).rstrip() + "\n", lines[0][2:])


def play_page(page: str, folder: Path, environment: Mapping[str, str], not_played: Mapping[str, str] = NOT_PLAYED
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
            played, folder, said = play_line(step.text, folder, environment)
            printed |= {*VERDICT.findall(said)}
            is_played = True
            yield played


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
    expected = (2,) if NEEDS_HARDWARE in line else (0, 1)
    faults = [] if status in expected else [f"status {status}: {err.strip()[-200:]}"]
    if "Traceback" in err:
        faults.append("a traceback")
    if status == 2 and len(err.strip().splitlines()) != 1:
        faults.append(f"{len(err.strip().splitlines())} lines of error")
    return faults
