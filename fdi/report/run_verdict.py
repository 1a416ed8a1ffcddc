"""The verdict of a run in a word, and the reason in a line."""
from __future__ import annotations

import contextlib
from typing import NamedTuple

from fdi.trace.trace import Trace


class Verdict(NamedTuple):
    """The result of a run."""

    word: str  # PASS, FAIL, INVALID_TIMING, ABORTED; NOT_JUDGED without checks
    why: str  # the reason; empty if the run passed

    def __str__(self) -> str:
        return f"{self.word}: {self.why}" if self.why else self.word


def read_verdict(trace: Trace) -> Verdict:
    """The verdict in the log of the run; of a trace without one (recovered, CSV) that of its checks."""
    notes = trace.provenance
    failed = [check.name for check in trace.checks if not check.passed]
    word, why = notes.get("verdict.verdict") or _judge_checks(trace), notes.get("verdict.why", "")
    if word == "INVALID_TIMING" and notes.get("verdict.timing"):
        return Verdict(word, notes["verdict.timing"])
    if word == "INVALID_TIMING":  # logs of earlier versions
        late = notes.get("verdict.overruns") or str(int(trace.timing.overrun.sum()))
        limit = ""
        with contextlib.suppress(KeyError, ValueError):  # a log of another program may lack it
            limit = f", more than {100 * float(notes['max_overruns']):g} %"
        lateness = f"the bench itself was late: {late} overruns in {len(trace)} cycles{limit}"
        return Verdict(word, f"{lateness}; {why}" if why else lateness)
    if word == "FAIL" and not why and failed:
        return Verdict(word, f"{len(failed)} of {len(trace.checks)} checks failed: {_list_names(failed)}")
    if word == "FAIL" and not why:
        return Verdict(word, "the checks passed, but the run did not end as the sequence says")
    return Verdict(word, why)


def _judge_checks(trace: Trace) -> str:
    if not trace.checks:
        return "NOT_JUDGED"
    return "PASS" if all(check.passed for check in trace.checks) else "FAIL"


def _list_names(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
