"""Writes the page of a run in a process of its own, which loads matplotlib while the run is under way.

Loading takes as long as drawing. In lockstep the second process uses the time and a CPU that the run leaves idle. In
real time it would compete with the loop: there the run begins when the process has loaded everything and waits
(`wait_until_loaded`). On one CPU there is nothing to gain: then the page is written here. It is written here as well if
the second process cannot start or fails: a run that was measured never lacks its page, and an error is raised here.
"""
import contextlib
import gc
import json
import os
import select
import subprocess
import sys
from pathlib import Path


class PageWriter(contextlib.AbstractContextManager["PageWriter"]):
    """A context for one page, `start_page` and `finish_page`; whatever happens, no process is left behind."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        if len(os.sched_getaffinity(0)) > 1:
            with contextlib.suppress(OSError):  # the system refuses a process
                self._process = _start_process()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the second process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def wait_until_loaded(self, seconds: float = 60.0) -> None:
        """Wait until the second process has loaded everything, or has ended; at most that long."""
        if self._process is not None and self._process.stdout is not None:
            select.select([self._process.stdout], [], [], seconds)

    def start_page(self, source: Path, out: Path) -> None:
        """Start to write the page of the trace `source` as the HTML file `out`; `finish_page` waits for it."""
        self._source, self._out = source, out
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):  # it died: `finish_page` writes the page
                self._process.stdin.write(json.dumps([str(source), str(out)]) + "\n")
                self._process.stdin.flush()

    def finish_page(self) -> None:
        """Wait until the page is written.

        Raises:
            InputError: a trace that cannot be read, or a file that cannot be written.
        """
        if self._process is not None:
            self._process.communicate()
            if self._process.returncode == 0:
                return
        from fdi.report.run_report import write_run_page

        write_run_page(self._source, self._out)


def _start_process() -> subprocess.Popen[str]:
    """Start `main` in a process of its own.

    It imports from the same folders as this process (-P: not from the working directory, where a file of the user's may
    have a module's name). In a session of its own: Ctrl-C is for the run, which has clean-up to do.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen([sys.executable, "-P", "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                            stderr=subprocess.DEVNULL, text=True, start_new_session=True, env=environment)


def main() -> None:
    """Load what a page needs and say so, then write the page that a line of standard input names; without one, none."""
    gc.disable()  # this process ends with its page; looking through matplotlib's objects takes a tenth of its time
    from fdi.report.drawing import start_figure, to_svg
    from fdi.report.report import load_templates
    from fdi.report.run_report import write_run_page

    with start_figure(1.0) as figure:  # loads matplotlib, the fonts and the SVG writer
        figure.text(0.5, 0.5, "0")
        to_svg(figure, "none")
    load_templates().get_template("page.html")
    with contextlib.suppress(BrokenPipeError):  # the run was killed: the next line ends this process
        print("loaded", flush=True)
    if line := sys.stdin.readline():
        write_run_page(*json.loads(line))


if __name__ == "__main__":
    main()
