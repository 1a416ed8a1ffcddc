"""Writes the page of a run in a process of its own, which loads matplotlib while the run is under way.

Loading takes as long as drawing. In lockstep the second process uses the time and a CPU that the run leaves idle; in
real time it would compete with the loop, and on one CPU there is nothing to gain: then the page is written here.
"""
from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType

from plant.errors import InputError


class PageWriter:
    """A context for one page, `start_page` and `finish_page`; whatever happens, no process is left behind."""

    def __init__(self, *, in_background: bool) -> None:
        self._in_background = in_background and len(os.sched_getaffinity(0)) > 1
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> PageWriter:
        if self._in_background:  # in a session of its own: Ctrl-C is for the run, which has clean-up to do
            self._process = subprocess.Popen([sys.executable, "-m", __name__], stdin=subprocess.PIPE,
                                             stdout=subprocess.PIPE, text=True, start_new_session=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def start_page(self, source: Path, out: Path) -> None:
        """Start to write the page of the trace `source` as the HTML file `out`; `finish_page` waits for it."""
        self._source, self._out = source, out
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):  # it died: its status is reported by `finish_page`
                self._process.stdin.write(json.dumps([str(source), str(out)]) + "\n")
                self._process.stdin.flush()

    def finish_page(self) -> None:
        """Wait until the page is written.

        Raises:
            InputError: a trace that cannot be read, or a file that cannot be written.
            RuntimeError: the second process failed; its traceback is on standard error.
        """
        if self._process is None:
            from fdi.report.run_report import write_run_page

            write_run_page(self._source, self._out)
            return
        answer, _ = self._process.communicate()
        if self._process.returncode != 0:
            raise RuntimeError(f"the process that writes {self._out} ended with status {self._process.returncode}")
        if answer:
            raise InputError(*json.loads(answer))


def main() -> None:
    """Load what a page needs, then write the page that a line of standard input names; without a line, write none.

    A trace or file that cannot be used is answered by the fields of the InputError, as one line of JSON.
    """
    import fdi.report.figures  # noqa: F401 - loads matplotlib
    from fdi.report.drawing import start_figure, to_svg
    from fdi.report.html import load_templates
    from fdi.report.run_report import write_run_page

    with start_figure(1.0) as figure:  # loads the fonts and the SVG writer
        figure.text(0.5, 0.5, "0")
        to_svg(figure, "none")
    load_templates().get_template("page.html")
    line = sys.stdin.readline()
    if not line:
        return
    source, out = json.loads(line)
    try:
        write_run_page(source, out)
    except InputError as error:
        print(json.dumps([error.where, error.field, error.expected]))


if __name__ == "__main__":
    main()
