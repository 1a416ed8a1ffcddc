"""Diagnosis of the servovalve from the main phase of a run, as `rig run --fdi` asks for it."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi.progress import Progress
from fdi.trace.trace import Trace
from plant.errors import InputError

FDI_FAILS = ("MAINTENANCE", "NON_NOMINAL", "SOMETHING_ELSE")  # verdicts of rig fdi that fail a run


def diagnose_servovalve(trace: Trace, progress: Progress, workers: int = 2) -> dict[str, Any]:
    """The answer of `rig fdi --json` on the main phase of a run, against the nominal unit.

    A phase that cannot be judged, for example a short one, gives CANNOT_TELL with the reason. `workers`: threads.
    """
    from fdi.diagnosis.diagnosis import diagnose  # here: loads the compiler, which other runs do not need
    from fdi.report.diagnosis_report import collect_data
    from fdi.report.json import to_plain

    try:
        diagnosis = diagnose(trace, progress=progress, source=trace.provenance["source"], workers=workers)
    except InputError as error:
        return {"verdict": "CANNOT_TELL", "sentence": f"not judged: {error}"}
    return dict(to_plain(collect_data(diagnosis)))


def has_fault(answer: Mapping[str, Any]) -> bool:
    """Whether a diagnosis found a fault of the servovalve beyond acceptable, or another deviation."""
    return answer.get("verdict") in FDI_FAILS


def describe_faults(answer: Mapping[str, Any], *levels: str) -> str:
    """Level and size of both faults with its interval, in words; with `levels` only of faults at one of these.

    "" if there is none, or the trace could not be judged.
    """
    if not answer.get("level"):
        return ""
    from fdi.report.diagnosis_report import list_found_faults

    return "; ".join(f"{found.name} {found.level}, {found.size}" for found in list_found_faults(answer)
                     if not levels or found.level in levels)


def describe_finding(answer: Mapping[str, Any]) -> str:
    """What a diagnosis found beyond acceptable, in a few words: the faults with their sizes, else its verdict."""
    return f"rig fdi: {describe_faults(answer, 'maintenance', 'non-nominal') or answer['verdict']}"
