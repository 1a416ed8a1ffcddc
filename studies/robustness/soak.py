"""Long work: run after run by one rig on nodes that stay, and nothing grows: memory, open files, threads."""

import tempfile
from pathlib import Path
from typing import NamedTuple

from fdi.progress import Progress, ignore_progress
from plant.model import load_model
from rig.network.clock import WallClock
from rig.network.master import BusError
from rig.run.job import Job
from rig.run.runner import run_job
from rig.sequences.sequence import parse_sequence
from studies.robustness.disturb import SEQUENCE, find_processes, has_semaphores, wait_until
from studies.robustness.nodes import Usage, read_usage, start_nodes

NO_ANSWER = "no answer"
SETTLE = 5.0  # s


class Soak(NamedTuple):
    """A soak: usage of each process after the first tenth of the time and at the end."""

    minutes: float
    runs: int
    cycles: int
    verdicts: dict[str, int]
    start: dict[str, Usage]
    end: dict[str, Usage]
    problems: tuple[str, ...]

    def find_growth(self, memory: int = 8 << 20) -> list[str]:
        """What has grown: memory by more than `memory` bytes, or any file or thread."""
        grown = []
        for name, before in self.start.items():
            after = self.end[name]
            for what, most in (("memory", memory), ("files", 0), ("threads", 0)):
                more = getattr(after, what) - getattr(before, what)
                if more > most:
                    grown.append(f"{name}: {what} +{more}")
        return grown


def soak_bench(minutes: float, group: str, pace: str = "lockstep", controller: str = "builtin",
               progress: Progress = ignore_progress) -> Soak:
    """Play a sequence of 3.2 s again and again on a UDP bus, with nodes that stay, for so many minutes.

    Raises:
        RigError: the nodes do not start.
    """
    clock = WallClock()
    sequence = parse_sequence(SEQUENCE, "soak.toml", lambda name: b"")
    bus = f"udp_multicast:{group}"
    job = Job(sequence=sequence, model=load_model(), bus=bus, pace=pace, controller="external", plant="external",
              max_overruns=1.0)
    verdicts: dict[str, int] = {}
    runs = cycles = 0
    start: dict[str, Usage] = {}
    problems = []
    with tempfile.TemporaryDirectory(prefix="eha-rig-soak-") as place, start_nodes(bus, controller) as nodes:
        while clock.now() < minutes * 60e9 or runs < 3:
            try:
                outcome = run_job(job, Path(place) / "run", ignore_progress, lambda: False)
                verdict, cycles = outcome.verdict, cycles + outcome.timing["cycles"]
            except BusError:  # a busy machine: the nodes did not answer in time
                verdict = NO_ANSWER
            runs, verdicts[verdict] = runs + 1, verdicts.get(verdict, 0) + 1
            if not start and runs >= 2 and clock.now() > minutes * 6e9:  # the first runs load what stays loaded
                start = read_usage(nodes)
            progress("soak", min(1.0, clock.now() / (minutes * 60e9)))

        def read_end() -> Soak:
            return Soak(minutes, runs, cycles, verdicts, start, read_usage(nodes), ())

        wait_until(lambda: not read_end().find_growth(), SETTLE)  # a thread of the last run may still be ending
        soak = read_end()
    if verdicts.get(NO_ANSWER, 0) > 0.1 * runs:
        problems.append(f"in {verdicts[NO_ANSWER]} of {runs} runs the nodes did not answer in time")
    if find_processes(group):
        problems.append("processes are left")
    if has_semaphores(group):
        problems.append("semaphores are left")
    return soak._replace(problems=tuple(problems))
