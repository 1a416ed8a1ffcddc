"""The terminal, as all commands print to it."""
from __future__ import annotations

import contextlib
import os
import sys

from rich.console import Console


class _Pipe(Console):
    """Goes on in silence when the reader of a pipe has gone: a verdict does not depend on who listens."""

    def on_broken_pipe(self) -> None:
        """In place of rich's, which ends the program with status 1."""
        self.quiet = True
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def console() -> Console:
    """Standard output, without guesses at what to colour."""
    return _Pipe(highlight=False)
