"""The outcome of a run: verdict, checks, timing. Used for the table, verdict.json and the exit status."""
from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fdi.output import write_text
from fdi.report.json import to_plain
from plant.segments import Array
from rig.run.history import History
from rig.run.job import Job
from rig.run.loop import Loop
from rig.run.session import SessionEvent
from rig.sequences.checks import CheckResult

STATUS_OF_VERDICT = {"PASS": 0, "FAIL": 1, "ABORTED": 1, "INVALID_TIMING": 3}
INTERRUPTED = 130


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A finished run."""

    job: Job
    folder: Path
    checks: Sequence[CheckResult]
    events: Sequence[SessionEvent]
    aborted: str  # why, or ""
    safe: bool  # the safe state was entered
    interrupted: bool
    timing: dict[str, Any]
    counters: dict[str, int]
    speed: float  # multiple of real time, of the cycles alone
    fdi: dict[str, Any] = field(default_factory=dict)  # diagnosis of `rig fdi`, if it was requested

    @property
    def verdict(self) -> str:
        """PASS, FAIL, INVALID_TIMING or ABORTED. If the bench itself was late, the controller is not judged."""
        late = self.job.realtime and self.timing["overruns"] > self.job.max_overruns * self.timing["cycles"]
        if late and not self.interrupted:
            return "INVALID_TIMING"
        if self.aborted:
            return "ABORTED"
        return "PASS" if not self.failures else "FAIL"

    @property
    def failures(self) -> list[str]:
        """The checks that did not pass, and an end other than the one the sequence requires."""
        failed = [check.name for check in self.checks if not check.passed]
        meant = self.job.sequence.ends == "safe_state"
        return failed if self.safe or not meant else [*failed, "the run did not end in the safe state"]

    @property
    def why(self) -> str:
        """The reason of a verdict other than PASS, in words."""
        late = (f"the bench itself was late: {self.timing['overruns']} overruns in {self.timing['cycles']} cycles, "
                f"more than {100 * self.job.max_overruns:g} %: the controller cannot be judged")
        words = {"FAIL": "; ".join(self.failures), "ABORTED": self.aborted, "INVALID_TIMING": late}
        return words.get(self.verdict, "")

    @property
    def status(self) -> int:
        """Exit status of `rig run`."""
        return INTERRUPTED if self.interrupted else STATUS_OF_VERDICT[self.verdict]

    def to_json(self) -> dict[str, Any]:
        """The content of `rig run --json` and verdict.json; null for NaN and infinity."""
        events, omitted = select_events(self.events)
        return {"verdict": self.verdict, "trace": str(self.folder / "trace.mcap"), "why": self.why,
                "checks": [to_plain(check._asdict()) for check in self.checks],
                "timing": self.timing, "counters": self.counters, "speed": round(self.speed, 2),
                "events": [to_plain(event._asdict()) for event in events], "events_omitted": omitted,
                "run": self.job.settings(), "fdi": self.fdi}

    def save(self) -> None:
        """Write verdict.json."""
        write_text(self.folder / "verdict.json", json.dumps(self.to_json(), indent=1) + "\n")


def select_events(events: Sequence[SessionEvent], most: int = 200) -> tuple[list[SessionEvent], dict[str, int]]:
    """The first `most` events of each kind, in order, and how many of each kind are omitted; the log has them all."""
    seen: Counter[str] = Counter()
    selected = []
    for event in events:
        seen[event.kind] += 1
        if seen[event.kind] <= most:
            selected.append(event)
    return selected, {kind: count - most for kind, count in seen.items() if count > most}


def summarise_timing(history: History, loop: Loop, scheduler: str, kind: str) -> dict[str, Any]:
    """Percentiles of lateness, response and execution in us, as `rig run --json` gives them.

    `kind`: "lockstep", "hard real time" (the cycle is compiled code) or "soft real time" (the cycle is Python).
    """
    return {"kind": kind, "cycles": len(history), "overruns": loop.overruns, "underruns": loop.underruns,
            "scheduler": scheduler,
            "execution_us": _compute_percentiles(history.column("execution")),
            "lateness_us": _compute_percentiles(history.column("lateness")),
            "response_us": _compute_percentiles(history.column("response"))}


def _compute_percentiles(seconds: Array) -> dict[str, float | None]:
    """Percentiles of the values that are not missing, in us."""
    values = seconds[~np.isnan(seconds)] * 1e6
    if not len(values):
        return dict.fromkeys(("p50", "p99", "p99_9", "max"))
    p50, p99, p99_9 = np.percentile(values, (50, 99, 99.9))
    return {"p50": round(p50, 1), "p99": round(p99, 1), "p99_9": round(p99_9, 1), "max": round(float(values.max()), 1)}
