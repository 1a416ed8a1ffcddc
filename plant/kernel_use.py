"""When a kernel for few effects is worth compiling: what has been computed without it so far says.

The kernel with all effects of a catalogue makes 50 million steps per second, one with a single costly effect and the
cheap ones 140 to 230 million. To compile one takes 2 to 3 s, to load it from the disk 0.1 s. So it is compiled once the
larger kernel has spent about 0.8 s on runs that it could have made, as it also serves the commands that follow, and
loaded after an eighth of that. Which of them makes a run changes no bit of it.
"""

import threading
from collections.abc import Callable, Hashable

WORTH_COMPILING = 40e6  # steps of all lanes that another kernel has made in its place
WORTH_LOADING = 5e6


class KernelUse:
    """Counts the steps that kernels could have made, and prepares those for which it is time, one at a time."""

    def __init__(self) -> None:
        self._left: dict[Hashable, float] = {}  # steps until it is worth its while
        self._ready: set[Hashable] = set()
        self._counting, self._preparing = threading.Lock(), threading.Lock()

    def is_ready(self, kernel: Hashable, steps: float, is_stored: Callable[[], bool], prepare: Callable[[], None]
                 ) -> bool:
        """Whether a kernel can make `steps` now; where that has become worth its while, it is prepared first.

        Args:
            kernel: what tells it from others.
            steps: of all lanes.
            is_stored: whether its machine code is on the disk.
            prepare: loads or compiles it. While one thread does that, others do without it.
        """
        if kernel in self._ready:
            return True
        if kernel not in self._left:
            # another thread may have begun to count meanwhile
            self._left.setdefault(kernel, WORTH_LOADING if is_stored() else WORTH_COMPILING)
        with self._counting:
            self._left[kernel] -= steps
            is_due = self._left[kernel] <= 0.0
        if not is_due or not self._preparing.acquire(blocking=False):
            return False
        try:
            prepare()
            self._ready.add(kernel)
        finally:
            self._preparing.release()
        return True
