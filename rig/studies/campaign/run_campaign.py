"""A campaign from its matrix to its rows, on the resumable runner: finished cases are not done again."""
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from rig.studies.campaign.campaign_case import FAILED, describe_case, hash_campaign_sources, judge_case, load_judgement
from rig.studies.campaign.folder import CampaignFolder, import_pyarrow
from rig.studies.campaign.matrix import Case, Matrix
from rig.studies.resumable.batch import Batch, BatchProgress, Workers, run_batch
from rig.studies.resumable.row_file import Row


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
    load_judgement(matrix.spec["work"])
    import_pyarrow()
    sources = hash_campaign_sources()
    with CampaignFolder(folder, matrix, sources) as results:
        try:
            run_batch(plan_batch(matrix, sources, count, redo_failed), results.file, workers, report_progress)
        finally:
            results.write_results()
        return results.newest_rows()


def plan_batch(matrix: Matrix, sources: str, count: int | None = None, redo_failed: bool = False) -> Batch:
    """The first `count` cases of a matrix as a batch; `sources` is the hash of the code that may judge them."""
    shared = {key: value for key, value in matrix.spec.items() if key not in ("case", "files")}

    def describe_failure(case: Case, reason: str) -> Row:
        return describe_case(case, shared) | {"reason": reason}

    def is_failed(row: Row) -> bool:
        return bool(row["status"] == FAILED)

    def is_valid(row: Row) -> bool:
        return not (redo_failed and is_failed(row))

    return Batch(jobs={case.number: case for case in matrix.cases[:count]},
                 work=partial(judge_case, spec=shared, expected_sources=sources), key="case",
                 describe_failure=describe_failure, is_valid=is_valid, is_failed=is_failed)
