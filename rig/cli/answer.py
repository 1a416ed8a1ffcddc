"""What a command tells: the answer on standard output as text or JSON, a page, a JSON file; progress meanwhile."""
from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, NamedTuple

from fdi.output import require_writable, write_text
from fdi.progress import Progress, ignore_progress
from plant import report_system_error, require

if TYPE_CHECKING:
    from rich.console import Console

    from fdi.report import Report


class Places(NamedTuple):
    """The files that a command writes, None for none."""

    page: Path | None = None
    answer: Path | None = None  # JSON
    junit: Path | None = None

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
    require(path.suffix in suffixes, option, out, expected or " or ".join(f"FILE{suffix}" for suffix in suffixes))
    return require_writable(path, option, source=source)


def choose_places(args: argparse.Namespace, page_name: str, source: str) -> Places:
    """The page or the JSON file of --out, and the page that --report puts beside the trace as `page_name`.

    Without a `page_name` the command has no --report.

    Raises:
        InputError: a place that cannot be written, or a kind of file that the command does not make.
    """
    out = choose_file(args.out or None, (".html", ".json"), source, expected="FILE.html for a page, or FILE.json")
    page = None
    if out is not None and out.suffix == ".html":
        page, out = out, None
    elif page_name and args.report:
        folder = Path(source) if Path(source).is_dir() else Path(source).parent
        page = choose_file(str(folder / page_name), (".html",), source, "--report")
    return Places(page, out)


def name_after(source: Path, suffix: str) -> str:
    """The name of a file made from a recording: that of the recording, with another suffix for its format.

    >>> name_after(Path("log.2024-01.csv.gz"), ".mcap"), name_after(Path("/usr/lib/."), ".rrd")
    ('log.2024-01.mcap', 'lib.rrd')
    """
    name = source.resolve().name
    if not source.is_dir():
        name = Path(name.removesuffix(".gz")).stem
    return name + suffix


def make_folder(path: Path) -> Path:
    """Make the folder of --out if need be.

    Raises:
        InputError: it cannot be made.
    """
    with report_system_error("--out", str(path), "a folder that can be written"):
        path.mkdir(parents=True, exist_ok=True)
    return path


def give_answer(report: Report, args: argparse.Namespace, status: int = 0, places: Places = NOWHERE,
                format_junit: Callable[[], str] = str) -> int:
    """Write the files of a report, print it as --json and --quiet ask, and return the exit status.

    --json comes before --quiet. `format_junit` makes the text of --junit. The answer is printed also if the disk
    is full: it may have taken minutes.

    Raises:
        InputError: a file that cannot be written.
    """
    from fdi.report import report as reports  # here: `rig --help` needs no reports

    for label, path in places.files:
        require_writable(path, "--junit" if label == "junit" else "--out")
    try:
        if places.answer is not None:
            write_text(places.answer, reports.to_json(report.data) + "\n")
        if places.junit is not None:
            write_text(places.junit, format_junit(), "--junit")
        if places.page is not None:
            with show_progress(args, "writing"):
                reports.write_html(report, places.page)
    finally:
        if args.json:
            print(reports.to_json(report.data))
        elif not args.quiet:
            from fdi.report import print_report

            print_report(report, open_console())
    return status


def open_console() -> Console:
    """A rich console on standard output that colours only what it is told to.

    It prints nothing more once the reader of its pipe has gone: a verdict does not depend on it.
    """
    from rich.console import Console

    class Pipe(Console):
        def on_broken_pipe(self) -> None:  # rich's own method ends the program with status 1
            self.quiet = True
            discard_output()

    return Pipe(highlight=False)


def discard_output() -> None:
    """Redirect standard output to /dev/null: what is still in its buffer must not end the program in an error."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def show_progress(args: argparse.Namespace, stage: str = "", *, is_silent: bool = False, is_realtime: bool = False
                  ) -> Iterator[Progress]:
    """Give a `Progress` whose calls move a bar on standard error; the bar disappears at the end.

    Args:
        args: of the command; with --json and --quiet nothing is shown.
        stage: what begins now.
        is_silent: show nothing.
        is_realtime: show a plain line without a refreshing thread, which would delay a real-time loop.

    Nothing is shown where standard error is no terminal.
    """
    if is_silent or args.json or args.quiet or not sys.stderr.isatty():
        yield ignore_progress
        return
    with _show_line() if is_realtime else _show_bar(stage or "starting") as update:
        yield update


@contextlib.contextmanager
def _show_bar(stage: str, delay: float = 2.0) -> Iterator[Progress]:
    """A bar that appears after `delay` s: shorter work needs none."""
    from rich.console import Console  # here: 0.1 s that a command without a bar does not spend
    from rich.progress import BarColumn, Progress as Bar, SpinnerColumn, TextColumn, TimeElapsedColumn

    bar = Bar(SpinnerColumn("line"), TextColumn("{task.description:<14}", markup=False), BarColumn(20),
              TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(),
              console=Console(stderr=True), transient=True)
    task = bar.add_task(stage, total=None)

    def update(stage: str, share: float) -> None:
        bar.update(task, description=stage, completed=share, total=1.0 if share > 0.0 else None)

    starter = Timer(delay, bar.start)
    starter.daemon = True
    starter.start()
    try:
        yield update
    finally:
        starter.cancel()
        starter.join()
        bar.stop()


@contextlib.contextmanager
def _show_line() -> Iterator[Progress]:
    last_state = ("", -1)

    def update(stage: str, share: float) -> None:
        nonlocal last_state
        state = (stage, int(20 * share))  # each write may cost the loop some microseconds: only every 5 %
        if state != last_state:
            last_state = state
            print(f"\r\033[K{stage:<14} {100 * share:3.0f} %", end="", file=sys.stderr, flush=True)

    try:
        yield update
    finally:  # the headline begins a line, also in a capture
        print("\r\033[K", end="\n" if last_state[0] else "", file=sys.stderr, flush=True)
