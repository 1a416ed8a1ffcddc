"""Where the answer of a command goes: standard output as text or JSON, a page, a JSON file."""
from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from fdi.output import require_writable, write_text
from plant.errors import InputError
from rig.cli.progress_bar import show_progress

if TYPE_CHECKING:
    from fdi.report.report import Report


class Places(NamedTuple):
    """The files that a command writes, None for none."""

    page: Path | None = None
    answer: Path | None = None  # JSON

    @property
    def files(self) -> list[tuple[str, str]]:
        """(label, path) of each file, as a report lists them."""
        return [(label, str(path)) for label, path in zip(self._fields, self, strict=True) if path]


NOWHERE = Places()


def choose_file(out: str | None, suffixes: Sequence[str], source: str | Path | None, option: str = "--out",
                expected: str = "") -> Path | None:
    """The file that `option` names, once it is known that it can be written; None if the option was not given.

    Raises:
        InputError: a place that cannot be written, the `source` itself, or a suffix that is not one of `suffixes`.
    """
    if out is None:
        return None
    path = Path(out)
    if path.suffix not in suffixes:
        raise InputError(option, out, expected or " or ".join(f"FILE{suffix}" for suffix in suffixes))
    return require_writable(path, option, source=source)


def choose_places(args: argparse.Namespace, page_name: str, source: str) -> Places:
    """The page or the JSON file of --out, and the page that --report puts beside the trace as `page_name`.

    Without a `page_name` the command has no --report.

    Raises:
        InputError: a place that cannot be written, or a kind of file that the command does not make.
    """
    out = choose_file(args.out or None, (".html", ".json"), source, expected="FILE.html for a page, or FILE.json")
    if out is not None and out.suffix == ".html":
        return Places(page=out)
    page = None
    if page_name and args.report:
        folder = Path(source) if Path(source).is_dir() else Path(source).parent
        page = choose_file(str(folder / page_name), (".html",), source, "--report")
    return Places(page, out)


def make_folder(path: Path) -> Path:
    """Make the folder of --out if need be.

    Raises:
        InputError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--out", str(path), f"a folder that can be written ({error.strerror})") from error
    return path


def give_answer(report: Report, args: argparse.Namespace, status: int = 0, places: Places = NOWHERE) -> int:
    """Write the files of a report, print it, and return the exit status.

    Raises:
        InputError: a file that cannot be written.
    """
    if places.answer is not None:
        from fdi.report.report import to_json

        write_text(places.answer, to_json(report.data) + "\n")
    if places.page is not None:
        from fdi.report.report import write_html

        with show_progress(is_silent=args.json or args.quiet) as progress:
            progress("writing", 0.0)
            write_html(report, places.page)
    show_answer(report, args)
    return status


def show_answer(report: Report, args: argparse.Namespace) -> None:
    """Print a report on standard output as --json and --quiet ask; --json comes before --quiet."""
    if args.json:
        from fdi.report.report import to_json

        print(to_json(report.data))
    elif not args.quiet:
        from fdi.report.terminal import print_report
        from rig.cli.terminal import open_console

        print_report(report, open_console())


def discard_output() -> None:
    """Redirect standard output to /dev/null: what is still in its buffer must not end the program in an error."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
