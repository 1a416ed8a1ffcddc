"""Play a newcomer: the lines of README and tutorial in a fresh clone, of other pages, bad inputs, Ctrl-C.

`make newcomer` runs all of it and prints a table; `make newcomer ARGS=inputs` a part: shown, pages, inputs or
interruptions. Exit status 1 if something is wrong. The quick parts are tests as well (test_newcomer.py).
"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import shown_commands
from bad_inputs import BAD_INPUTS, find_faults, write_bad_files
from interruption import LONG_COMMANDS, MOMENTS, interrupt_command
from places import ROOT

Row = tuple[str, str, str, str]  # what, status, time, result


def main() -> int:
    """Play the parts that the command line names."""
    parser = argparse.ArgumentParser(description="Play a newcomer.")
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="default: all")
    parser.add_argument("--out", type=Path, help="write the table to this file, too")
    args = parser.parse_args()
    rows: list[str] = []
    is_bad = False
    for part in args.parts or PARTS:
        rows += ["", f"### {part}", "", "| what | status | time | result |", "|---|---|---|---|"]
        with tempfile.TemporaryDirectory(prefix="newcomer-") as folder:
            for what, status, duration, result in PARTS[part](Path(folder)):
                rows.append(f"| {what} | {status} | {duration} | {result} |")
                is_bad |= result not in ("ok", "not run", "done before Ctrl-C")
                print(rows[-1], flush=True)
    text = "\n".join(rows[1:]) + "\n"
    if args.out:
        args.out.write_text(text)
    print("\n" + ("Something is wrong." if is_bad else "Nothing is wrong."))
    return int(is_bad)


def make_environment() -> dict[str, str]:
    """The environment of a newcomer: `rig` is on the path, and the terminal has 100 columns."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "COLUMNS": "100", "PYTHONPATH": ""}


def play_shown(folder: Path) -> Iterator[Row]:
    """The lines of README and tutorial, in order, in one clone, in which the reader has written a test of his own."""
    clone = folder / "eha-rig"
    if (ROOT / ".git").exists():
        subprocess.run(["git", "clone", "--quiet", "--depth", "1", ROOT.as_uri(), str(clone)], check=True)
    else:
        clone.mkdir()
        shutil.copytree(ROOT / "docs", clone / "docs")
    shutil.copy(ROOT / "rig/sequences/preflight.toml", clone / "my_test.toml")
    for page in ("README.md", "docs/tutorial.md"):
        for played in shown_commands.play_page((ROOT / page).read_text(), clone, make_environment()):
            status = "-" if played.status is None else str(played.status)
            result = "; ".join(played.faults) or ("not run" if played.line in shown_commands.DONE_BY_CI else "ok")
            yield f"{page}: `{played.line}`", status, f"{played.seconds:.1f} s", result


def play_pages(folder: Path) -> Iterator[Row]:
    """The lines of the other pages, each section in a folder with the files that it needs."""
    for part in shown_commands.PARTS:
        for played in shown_commands.play_part(part, folder, make_environment()):
            status = "-" if played.status is None else str(played.status)
            result = "; ".join(played.faults) or ("ok" if played.status is not None else "not run")
            yield f"{part.page}: `{played.line}`", status, f"{played.seconds:.1f} s", result


def play_inputs(folder: Path) -> Iterator[Row]:
    """The bad inputs, each as a process of its own."""
    write_bad_files(folder)
    for case in BAD_INPUTS:
        start = time.monotonic()
        done = subprocess.run([sys.executable, "-m", "rig.cli.main", *case.words.split()], cwd=folder, text=True,
                              env=make_environment(), capture_output=True)
        faults = find_faults(case, done.returncode, done.stdout, done.stderr)
        yield (f"`rig {case.words}`", str(done.returncode), f"{time.monotonic() - start:.1f} s",
               "; ".join(faults) or "ok")


def play_interruptions(folder: Path) -> Iterator[Row]:
    """Ctrl-C in every long command, at several moments."""
    write_recordings(folder)
    group = "239.74." + ".".join(str(random.SystemRandom().randrange(1, 255)) for _ in range(2))
    for name, words in LONG_COMMANDS.items():
        for moment in MOMENTS:
            done = interrupt_command(name, words.format(group=group), moment, folder, make_environment())
            status = "-" if done.status is None else str(done.status)
            result = "; ".join(done.faults) or ("done before Ctrl-C" if done.status is None else "ok")
            yield (f"Ctrl-C in {name} after {moment:g} s", status, f"{done.wall:.2f} s, CPU {done.cpu:.2f} s", result)
            if done.status is None:
                break


def write_recordings(folder: Path, minutes: float = 13.0) -> None:
    """Write the recordings that the long commands take."""
    def rig(*words: str) -> None:
        subprocess.run([sys.executable, "-m", "rig.cli.main", *words, "--quiet"], cwd=folder, check=True,
                       env=make_environment())

    rig("simulate", "--samples")
    steps = "".join(f"{k},{2e-3 * (k % 3 - 1):g}\n{k + 0.5:g},{1e-3 * (k % 5 - 2):g}\n"
                    for k in range(round(60 * minutes)))
    (folder / "long_command.csv").write_text("t,com\n" + steps)
    rig("simulate", "--command", "long_command.csv", "--set", "filter.clogging=0.2", "--out", "long.csv")
    (folder / "unit").mkdir()
    for month in range(1, 7):
        rig("simulate", "--set", f"filter.clogging={0.02 * month:g}", "--seed", str(month), "--out",
            f"unit/2026-{month:02}-01.csv")


PARTS: dict[str, Callable[[Path], Iterator[Row]]] = {
    "shown": play_shown, "pages": play_pages, "inputs": play_inputs, "interruptions": play_interruptions}

if __name__ == "__main__":
    sys.exit(main())
