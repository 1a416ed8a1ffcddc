"""A progress bar that only those see who have to wait."""
from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

PATIENCE = 2.0  # s; what is over by then needs no bar

Update = Callable[[str, int, int], None]


class _Late(Progress):
    """Shows nothing at first."""

    def get_renderables(self) -> Iterable[RenderableType]:
        if self.tasks and (self.tasks[0].elapsed or 0.0) > PATIENCE:
            yield self.make_tasks_table(self.tasks)


@contextlib.contextmanager
def waiting(silent: bool) -> Iterator[Update]:
    """Call it with what is being done, how much is done and of how much; a bar on standard error if it takes long.

    Nothing is shown if `silent`, or where standard error is no terminal.
    """
    errors = Console(stderr=True)
    bar = _Late(TextColumn("{task.description:<14}", markup=False), BarColumn(40), TimeElapsedColumn(),
                console=errors, transient=True, disable=silent or not errors.is_terminal)
    with bar:
        task = bar.add_task("", total=None)
        yield lambda what, done, total: bar.update(task, description=what, completed=done, total=total or None)
