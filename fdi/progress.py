"""How long work reports its progress: one kind of callable for every command, study and estimate."""
from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the name of the stage that begins and the share of the whole work done so far, 0 to 1.

0 also stands for "unknown": a bar then shows the stage and the time alone.
"""


def ignore_progress(stage: str, share: float) -> None:
    """Report nothing: the default of every function that takes a `Progress`."""
