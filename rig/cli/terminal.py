"""Standard output, as all commands print to it."""
from __future__ import annotations

from rich.console import Console

from rig.cli.answer import discard_output


class _Pipe(Console):
    """A console that prints nothing more once the reader of its pipe has gone: a verdict does not depend on it."""

    def on_broken_pipe(self) -> None:
        """Replace rich's method, which ends the program with status 1."""
        self.quiet = True
        discard_output()


def open_console() -> Console:
    """A rich console on standard output that colours only what it is told to."""
    return _Pipe(highlight=False)
