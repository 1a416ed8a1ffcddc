"""Runs the cases on a node one after the other: each begins with a reset of the communication and forgets the last."""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdi.progress import Progress, ignore_progress
from plant.errors import RigError
from rig.conformance import (
    eds_cases,
    error_cases,
    nmt_cases,
    object_cases,
    pdo_cases,
    sdo_cases,
    timing_cases,
)
from rig.conformance.conformance_case import CHAPTERS, Case, CaseEnd, CaseFailed, Result, Verdict
from rig.conformance.data_sheet import Variable
from rig.conformance.object_cases import list_readable
from rig.conformance.target import RESET_COMMUNICATION, Refusal, Target

CASES: list[Case] = sorted(
    (value for module in (eds_cases, object_cases, sdo_cases, pdo_cases, error_cases, nmt_cases, timing_cases)
     for value in vars(module).values() if isinstance(value, Case)), key=lambda each: each.order)


class Outcome(NamedTuple):
    """What a conformance test found out."""

    results: list[Result]
    notes: list[str]  # what a reader must know
    is_disturbed: bool  # times could not be measured: the tester's own machine was too late

    @property
    def verdict(self) -> str:
        """FAIL, INVALID_TIMING or PASS."""
        if any(result.verdict is Verdict.FAIL for result in self.results):
            return "FAIL"
        return "INVALID_TIMING" if self.is_disturbed else "PASS"

    def count(self, verdict: Verdict) -> int:
        """Number of cases with this verdict."""
        return sum(result.verdict is verdict for result in self.results)


def choose_cases(wanted: Sequence[str]) -> list[Case]:
    """The cases of these chapters ("3") and numbers ("3.6"); all for none. Unknown words choose nothing."""
    return [each for each in CASES if not wanted or each.number in wanted or str(each.chapter) in wanted]


def run_cases(target: Target, cases: Sequence[Case] | None = None, progress: Progress = ignore_progress) -> Outcome:
    """Run the cases and set back what they changed.

    Raises:
        RigError: the node does not answer, or another master is active on the bus.
    """
    chosen = CASES if cases is None else cases
    notes: list[str] = []
    snapshot: dict[Variable, bytes] = {}
    is_live = any(each.chapter > 1 for each in chosen)
    if is_live:
        _require_present(target)
        snapshot = _read_all(target)
    results, is_disturbed = [], False
    for position, each in enumerate(chosen):
        progress(CHAPTERS[each.chapter], position / len(chosen))
        result, disturbed = _run_case(target, each)
        results.append(result)
        is_disturbed |= disturbed
    if is_live:
        notes += _restore(target, snapshot)
    if target.others:
        notes.append(f"Other nodes on the bus: {', '.join(map(str, sorted(target.others)))}.")
    return Outcome(results, notes, is_disturbed)


def _run_case(target: Target, each: Case, attempts: int = 3) -> tuple[Result, bool]:
    """One case, several times if it fails while the tester is late; and whether that kept it from a verdict."""
    start = target.now()
    for _ in range(attempts):
        verdict, measured = _attempt(target, each)
        is_disturbed = target.stall > max(0.5 * target.options.tolerance, 0.002)
        if verdict is not Verdict.FAIL or not is_disturbed:
            break
    disturbed = each.is_timed and verdict is Verdict.FAIL and is_disturbed
    if disturbed:
        verdict = Verdict.SKIPPED
        measured = f"this machine was {1e3 * target.stall:.0f} ms late itself while it measured: {measured}"
    seconds = (target.now() - start) * 1e-9
    return Result(each.number, each.name, each.section, each.expected, measured, verdict, seconds), disturbed


def _attempt(target: Target, each: Case) -> tuple[Verdict, str]:
    try:
        target.begin()
        if each.chapter > 1:
            _reset(target)
        return Verdict.PASS, each.check(target)
    except CaseEnd as end:
        return end.verdict, str(end)
    except (Refusal, ValueError) as error:  # ValueError: a value of another length than its type has
        return Verdict.FAIL, str(error)


def _reset(target: Target) -> None:
    """Bring the node into PRE-OPERATIONAL with its defaults. Without a boot-up the case goes on all the same."""
    target.command(RESET_COMMUNICATION)
    target.wait_for(target.heartbeat_id, target.options.boot_timeout, lambda frame: frame.data == b"\0")
    target.begin()


def _require_present(target: Target) -> None:
    """Raises RigError unless the node answers and nobody else sends SYNC."""
    target.begin()
    target.wait(0.3)
    sync = target.sheet.default_identifier(0x1005, 0x080)
    if any(frame.cob_id == sync for frame in target.frames):
        raise RigError(f"another node sends SYNC (0x{sync:03X}): stop it first, the test needs the bus to itself")
    target.command(RESET_COMMUNICATION)
    boot = target.wait_for(target.heartbeat_id, target.options.boot_timeout, lambda frame: frame.data == b"\0")
    try:
        is_present = bool(target.upload(0x1000))
    except (CaseFailed, Refusal):
        is_present = boot is not None
    if not is_present:
        raise RigError(f"node {target.node} does not answer: neither a boot-up after an NMT reset nor object 0x1000")


def _read_all(target: Target) -> dict[Variable, bytes]:
    """What every writable object holds, as far as it can be read."""
    found = {}
    for variable in list_readable(target):
        if variable.is_writable and not variable.is_active and variable.index != 0x1003:
            try:
                found[variable] = target.upload(variable.index, variable.sub)
            except (Refusal, CaseFailed):
                continue
    return found


def _restore(target: Target, snapshot: dict[Variable, bytes]) -> list[str]:
    """Reset the node's communication and write back what differs from the beginning; a line for each that did."""
    _reset(target)
    after = _read_all(target)
    notes = []
    for variable, before in snapshot.items():
        if after.get(variable) == before:
            continue
        try:
            target.download(variable.index, variable.sub, before)
            done = "it was set back"
        except (Refusal, CaseFailed) as error:
            done = f"it could not be set back ({error})"
        changed = variable.show(after[variable]) if variable in after else "nothing"
        notes.append(f"{variable.label} held {variable.show(before)} before and {changed} after the test; {done}.")
    return notes
