"""The judgement of a campaign: from a trace and the healthy model to a flat row."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi.diagnosis.faults import FAULTS, Level
from fdi.trace.trace import Trace
from plant import Model
from plant.threads import count_threads

WORKS: Mapping[str, str] = {"fdi": "rig.studies.campaign.judge:judge_by_fdi"}
"""Judgements by the short name that --work accepts."""
CANNOT_TELL = "cannot_tell"


def judge_by_fdi(trace: Trace, model: Model) -> dict[str, Any]:
    """The diagnosis of `rig fdi`: levels, ruling fault, sizes with intervals, events, precursors, other effects.

    Raises:
        InputError: a trace that cannot be judged.
    """
    from fdi.diagnosis.diagnosis import diagnose

    found = diagnose(trace, model, workers=count_threads())
    row: dict[str, Any] = {"verdict": found.verdict, "ruling": found.ruling or ""}
    for fault in FAULTS:
        size = found.sizes[fault.name]
        row[f"level_{fault.name}"] = _format_level(found.levels[fault.name])
        row |= {fault.symbol: size.value, f"{fault.symbol}_low": size.low, f"{fault.symbol}_high": size.high}
    if found.band_verdict is not None:
        levels, by = found.band_verdict.levels, found.band_verdict.severity
        row |= {f"band_{fault.name}": _format_level(levels.get(fault.name)) for fault in FAULTS}
        row |= {f"severity_{fault.name}": by[fault.name] for fault in FAULTS if fault.name in by}
    if found.grid is not None:
        row |= {"grid_kintas": found.grid.merged.kintas, "grid_fss": found.grid.merged.fss}
    return row | {
        "events": [event._asdict() for event in found.events], "event_count": len(found.events),
        "correlation": found.refinement.correlation, "left_over": max(found.refinement.ratio.values()),
        "simulations": found.refinement.simulations, "others": sorted(found.others),
        "precursors": {name: precursor.value for name, precursor in found.precursors.items()},
        "notes": list(found.notes)}


def _format_level(level: Level | None) -> str:
    return CANNOT_TELL if level is None else level.word
