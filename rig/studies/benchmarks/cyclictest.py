"""Wake-up lateness as cyclictest (Debian's rt-tests) measures it: the yardstick for the rig's own cycle."""
from __future__ import annotations

import shutil
import subprocess

import numpy as np
from numpy.typing import NDArray

from plant.errors import RigError

GET_CYCLICTEST = "apt-get install rt-tests"


def find_cyclictest() -> str:
    """The path of cyclictest; "" without it."""
    return shutil.which("cyclictest", path="/usr/bin:/usr/local/bin:/bin:/usr/sbin") or ""


def run_cyclictest(seconds: float, priority: int, cpu: int, period_us: int = 1000) -> NDArray[np.float64]:
    """Latencies of cyclictest, s, to the microsecond: one thread, absolute due times, memory locked.

    `priority` 0 runs it without real-time priority.

    Raises:
        RigError: it ended with an error.
    """
    words = [find_cyclictest(), "-q", "-m", f"--priority={priority}", f"--policy={'fifo' if priority else 'other'}",
             f"--interval={period_us}", f"--loops={round(seconds * 1e6 / period_us)}", "--histogram=100000",
             f"--affinity={cpu}"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RigError(f"cyclictest: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
    return parse_histogram(done.stdout)


def parse_histogram(text: str) -> NDArray[np.float64]:
    """The latencies, s, in the histogram that cyclictest prints; those beyond its end count as its maximum."""
    bins, most, overflows = [], 0, 0
    for line in text.splitlines():
        words = line.split()
        if line.startswith("# Max Latencies:"):
            most = int(words[-1])
        elif line.startswith("# Histogram Overflows:"):
            overflows = int(words[-1])
        elif len(words) == 2 and words[0].isdigit():
            bins.append((int(words[0]), int(words[1])))
    latencies, counts = np.array([*bins, (most, overflows)]).T
    return np.repeat(latencies, counts) * 1e-6
