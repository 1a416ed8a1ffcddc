"""How long work reports its progress: one kind of callable for every command, study and estimate."""

from collections.abc import Callable
from itertools import count

# Called with the name of the stage that begins and the share of the whole work done so far, 0 to 1.
#
# 0 also stands for "unknown": a bar then shows the stage and the time alone.
Progress = Callable[[str, float], None]


def ignore_progress(stage: str, share: float) -> None:
    """Report nothing: the default of every function that takes a `Progress`."""


class Stage:
    """A stage of many steps, such as rounds of fits, which may end in any thread.

    Its share of the whole work goes from `begin` to `end` with `steps` steps. Fits may end early or take a few more
    steps than expected: then the share jumps at the next stage, or waits at `end`.
    """

    def __init__(self, progress: Progress, name: str, begin: float, end: float, steps: int) -> None:
        self._progress, self._name, self._begin, self._end, self._steps = progress, name, begin, end, max(steps, 1)
        self._numbers = count(1)  # of one step after the other, whichever thread takes it
        progress(name, begin)

    def finish_step(self) -> None:
        """Report that a step is done."""
        share = min(next(self._numbers) / self._steps, 1.0)
        self._progress(self._name, self._begin + (self._end - self._begin) * share)


NO_STAGE = Stage(ignore_progress, "", 0.0, 0.0, 1)
