"""Play a newcomer: the lines of README and tutorial in a fresh clone, and those of other pages.

`make newcomer` runs all of it and prints a table; `make newcomer ARGS=shown` a part: shown or pages.
Exit status 1 if something is wrong. Bad inputs are tests (test_newcomer.py).
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import shown_commands
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
                is_bad |= result not in ("ok", "not run")
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
        for outcome in shown_commands.play_page((ROOT / page).read_text(), clone, make_environment()):
            status = "-" if outcome.status is None else str(outcome.status)
            result = "; ".join(outcome.faults) or ("not run" if outcome.line in shown_commands.DONE_BY_CI else "ok")
            yield f"{page}: `{outcome.line}`", status, f"{outcome.seconds:.1f} s", result


def play_pages(folder: Path) -> Iterator[Row]:
    """The lines of the other pages, each section in a folder with the files that it needs."""
    for part in shown_commands.PARTS:
        for outcome in shown_commands.play_part(part, folder, make_environment()):
            status = "-" if outcome.status is None else str(outcome.status)
            result = "; ".join(outcome.faults) or ("ok" if outcome.status is not None else "not run")
            yield f"{part.page}: `{outcome.line}`", status, f"{outcome.seconds:.1f} s", result


PARTS: dict[str, Callable[[Path], Iterator[Row]]] = {"shown": play_shown, "pages": play_pages}

if __name__ == "__main__":
    sys.exit(main())
