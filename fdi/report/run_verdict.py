"""The verdict of a run in a word, and the reason in a line."""
from __future__ import annotations

from typing import NamedTuple

from fdi.trace.trace import Trace


class Verdict(NamedTuple):
    """What came of a run."""

    word: str  # PASS, FAIL, INVALID_TIMING, ABORTED; NOT JUDGED for a trace without checks
    why: str  # empty where all is well

    def __str__(self) -> str:
        return f"{self.word}: {self.why}" if self.why else self.word


def verdict(trace: Trace) -> Verdict:
    """As the run itself has it in its log; of a trace without that (salvaged, a CSV) as its checks have it."""
    said = trace.provenance
    failed = [check.name for check in trace.checks if not check.passed]
    judged = ("FAIL" if failed else "PASS") if trace.checks else "NOT JUDGED"
    word, why = said.get("verdict.verdict") or judged, said.get("verdict.why", "")
    if word == "INVALID_TIMING":
        late = said.get("verdict.overruns") or str(int(trace.timing.overrun.sum()))
        limit = f", more than {100 * float(said['max_overruns']):g} %" if "max_overruns" in said else ""
        lateness = f"the bench itself was late: {late} overruns in {len(trace)} cycles{limit}"
        why = f"{lateness}; {why}" if why else lateness
    elif word == "FAIL" and not why:
        why = f"{len(failed)} of {len(trace.checks)} checks failed: {_listed(failed)}" if failed else \
            "the checks passed, but the run did not end as the sequence says"
    return Verdict(word, why)


def _listed(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
