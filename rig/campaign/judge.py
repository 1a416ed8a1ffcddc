"""A campaign: each case is simulated or read, then judged, on the resumable runner; the answers are flat rows."""
from __future__ import annotations

import platform
import tomllib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import FAULTS, Level
from fdi.sources import hash_sources, import_function
from fdi.trace.trace import Trace
from plant import Model
from plant.errors import RigError
from plant.model import parse_model
from plant.threads import count_threads
from rig.campaign.batch import Batch, BatchProgress, Row, Workers, import_extra, run_batch
from rig.campaign.folder import open_campaign, select_newest, write_results
from rig.campaign.matrix import Case, Matrix
from rig.campaign.units import simulate_case
from rig.network.clock import WallClock

Array = NDArray[np.float64]
Judgement = Callable[[Trace, Model], Row]
"""A function that judges a run: from the trace and the healthy model to a flat row of JSON values."""

OK, REFUSED, FAILED = "ok", "refused", "failed"


def judge_case(case: Case, spec: Mapping[str, Any], expected_sources: str) -> Row:
    """The row of a case. A refused trace or an exception of the judgement is a row as well.

    Raises:
        RigError: the code of this machine is not that of `expected_sources`, the hash made where the campaign runs.
    """
    if hash_campaign_sources() != expected_sources:
        raise RigError(f"the code on {platform.node()} differs from the code of the campaign: install the same version")
    clock, row, model = WallClock(), describe_case(case, spec), _parse_healthy_model(spec)
    try:
        trace = Trace.read(case.trace) if case.trace else simulate_case(case, spec, model)
        start = clock.now()
        row |= {"status": OK, **_load_judgement(spec)(trace, model), "seconds": (clock.now() - start) * 1e-9}
    except RigError as error:
        row |= {"status": REFUSED, "reason": " ".join(str(error).split())}
    except Exception as error:
        row |= {"status": FAILED, "reason": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return row


def describe_case(case: Case, spec: Mapping[str, Any]) -> Row:
    """What is known of a case before it is judged; of a simulated case also the true fault sizes."""
    row = {"case": case.number, "label": case.label, "faults": len(case.sizes), "tolerance": case.tolerance,
           "seed": case.seed, "status": FAILED, "reason": ""}
    if case.trace:
        return row
    model = _parse_healthy_model(spec)
    return row | {"true_kintas": case.sizes.get("filter_clogging", model["filter.clogging"]),
                  "true_fss": case.sizes.get("spool_friction", model["spool.static_friction"])}


def _load_judgement(spec: Mapping[str, Any]) -> Judgement:
    return import_function(spec["work"], "--work", "a judgement")


def _parse_healthy_model(spec: Mapping[str, Any]) -> Model:
    return parse_model(tomllib.loads(spec["model"]), "campaign")


def hash_campaign_sources() -> str:
    """A hash of all code and data that a row depends on."""
    return hash_sources("plant", "fdi", "rig/campaign")


WORKS: Mapping[str, str] = {"fdi": "rig.campaign.judge:judge_by_fdi"}
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


def run_campaign(matrix: Matrix, folder: str | Path, workers: Workers,
                 report_progress: Callable[[BatchProgress], None] = lambda _: None, count: int | None = None,
                 redo_failed: bool = False) -> list[Row]:
    """Judge the cases that are not finished, and write results.parquet, also after an interruption.

    Args:
        matrix: the cases.
        folder: where the results go: a new folder, or one of this matrix.
        workers: where the cases are judged.
        report_progress: called after each case.
        count: stop after the first `count` cases of the matrix, finished ones included; default: all.
        redo_failed: judge failed cases once more.

    Returns:
        The rows of all finished cases, in the matrix's order.

    Raises:
        InputError: the folder holds something else, there is no such judgement, no cluster at the address, or an
            extra is not installed.
        RigError: the cluster is gone.
    """
    _load_judgement(matrix.spec)
    import_extra("pyarrow")
    sources = hash_campaign_sources()
    with open_campaign(folder, matrix, sources) as file:
        try:
            run_batch(plan_batch(matrix, sources, count, redo_failed), file, workers, report_progress)
        finally:
            write_results(folder, file.rows)
        return select_newest(file.rows)


def plan_batch(matrix: Matrix, sources: str, count: int | None = None, redo_failed: bool = False) -> Batch:
    """The first `count` cases of a matrix as a batch; `sources` is the hash of the code that may judge them."""
    shared = {key: value for key, value in matrix.spec.items() if key not in ("case", "files")}

    def describe_failure(case: Case, reason: str) -> Row:
        return describe_case(case, shared) | {"reason": reason}

    return Batch(jobs={case.number: case for case in matrix.cases[:count]},
                 work=partial(judge_case, spec=shared, expected_sources=sources), key="case",
                 describe_failure=describe_failure, is_failed=_has_failed,
                 is_valid=lambda row: not (redo_failed and _has_failed(row)))


def _has_failed(row: Row) -> bool:
    return bool(row["status"] == FAILED)
