"""`rig campaign`: a matrix of faults, sizes, tolerances and seeds, or a folder of traces, judged on many cores."""
from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.cli import options

if TYPE_CHECKING:
    from rig.campaign.batch import BatchProgress
    from rig.campaign.matrix import Matrix



def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig campaign`."""
    add = parser.add_argument
    add("what", nargs="?", metavar="MATRIX.toml|FOLDER",
        help="a matrix file, a shipped matrix by name (statistics), a folder of traces, or the folder of a campaign "
             "to resume")
    add("--summary", action="store_true", help="run nothing; summarise the finished cases")
    add("--scheduler", metavar="ADDRESS", help="use the workers of the Dask cluster at tcp://HOST:PORT")
    add("--jobs", type=options.parse_whole_number, metavar="N",
        help="processes on this machine (default: one per core)")
    add("--most", type=options.parse_count, metavar="N", help="stop after the first N cases (a fair sample of all)")
    add("--again", action="store_true", help="judge failed cases once more")
    add = parser.add_argument_group("the matrix").add_argument
    add("--fault", action="append", default=[], metavar="EFFECT=SIZE,..",
        help="cases: healthy; EFFECT=SIZE,SIZE,..; or two faults in one plant, EFFECT=SIZE/EFFECT=SIZE "
             "(repeatable)")
    add("--seeds", type=options.parse_whole_number, metavar="N", help="runs of each size (default 20)")
    add("--seed", type=options.parse_whole_number, metavar="N", help="seed of the first run (default 0)")
    add("--tolerance", metavar="X,..", help="standard deviation of the base parameters, relative (default 0.015)")
    add("--simulator", metavar="MODULE:FUNCTION",
        help="function that simulates a unit (rig.campaign.units.Unit) instead of the plant model")
    add("--signals", metavar="xj,p12,xs", help="what is measured (default: all three)")
    add("--model", metavar="FILE|NAME", help="the healthy plant (default eha)")
    add("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE",
        help="change a parameter of this plant (repeatable)")
    add("--work", default="fdi", metavar="MODULE:FUNCTION", help="function that judges a case instead of rig fdi")


def run_command(args: argparse.Namespace) -> int:
    """results.parquet, summary.json and detection.svg go to the folder --out (default: campaigns/NAME)."""
    from rig.campaign.batch import Workers
    from rig.campaign.folder import read_campaign_rows
    from rig.campaign.judge import run_campaign

    if args.summary:
        folder = Path(args.out or args.what or "")
        rows = read_campaign_rows(folder)
    else:
        matrix, folder = _choose_matrix(args)
        workers = Workers(_count_processes(args.jobs), args.scheduler or "", single_threaded=True)
        with _show_batch_progress(args.json or args.quiet) as report_progress:
            rows = run_campaign(matrix, folder, workers, report_progress, args.most, args.again)
    return _report(rows, folder, args)


def _report(rows: Sequence[dict[str, Any]], folder: Path, args: argparse.Namespace) -> int:
    """Write and show the statistics; exit status 1 if a case failed or a required rate is not reached."""
    from rig.campaign.folder import read_matrix_of_folder
    from rig.campaign.report import build_campaign_report
    from rig.campaign.summary import summarise_campaign
    from rig.cli.answer import show_answer

    figures = summarise_campaign(rows)
    report = build_campaign_report(figures, str(folder))
    if folder.is_dir():
        _write_statistics(figures, folder)
        names = sorted(file.name for file in folder.iterdir() if file.suffix in (".parquet", ".json", ".svg"))
        report = replace(report, files=[("results", f"{folder}/ {', '.join(names)}")])
        left = len(read_matrix_of_folder(folder).cases) - len(rows)
        if left:
            report = replace(report, sentence=f"{report.sentence} {left} cases are left.",
                             next_command=f"rig campaign {shlex.quote(str(folder))}")
    show_answer(report, args)
    missed = [rate for part in figures["tolerances"] for rate in part["rates"] if rate["met"] is False]
    return 1 if missed or figures["status"].get("failed") else 0


def _write_statistics(figures: dict[str, Any], folder: Path) -> None:
    from rig.campaign.folder import replace_file
    from rig.campaign.report import draw_detection_curves

    replace_file(folder / "summary.json", (json.dumps(figures, indent=1) + "\n").encode())
    for part in figures["tolerances"]:
        if any(len(points) > 1 for points in part["curves"].values()):
            alone = len(figures["tolerances"]) == 1
            name = "detection.svg" if alone else f"detection-{100 * part['tolerance']:g}.svg"
            replace_file(folder / name, draw_detection_curves(part).encode())


def _choose_matrix(args: argparse.Namespace) -> tuple[Matrix, Path]:
    """The matrix that the options describe, and the folder of its results. Raises InputError."""
    from plant import InputError, load_model
    from rig.campaign import matrix
    from rig.campaign.folder import is_campaign_folder, read_matrix_of_folder
    from rig.campaign.judge import WORKS

    wanted = {"seeds": args.seeds, "first": args.seed, "simulator": args.simulator, "signals": args.signals,
              "tolerance": None if args.tolerance is None else _parse_numbers(args.tolerance)}
    changed = {key: value for key, value in wanted.items() if value is not None}
    if args.what and is_campaign_folder(args.what):
        if changed or args.fault or args.model or args.set or args.out:
            raise InputError(args.what, "", "no other option about the matrix: this folder has its own")
        found = read_matrix_of_folder(args.what)
        work = found.spec["work"]
        if work not in (*WORKS.values(), WORKS.get(args.work, args.work)):  # a folder is data
            raise InputError(args.what, "work", f"--work {work} on the command line, to call that function")
        return found, Path(args.what)
    model = load_model(args.model or "eha").replace(options.parse_changes(args.set))
    work = WORKS.get(args.work, args.work)
    if args.what and Path(args.what).is_dir():
        if changed or args.fault:
            raise InputError(args.what, "", "no faults or seeds: these are recorded traces")
        folder = _choose_folder(args.out, Path(args.what).absolute().name)
        return matrix.build_trace_matrix(args.what, model, work), folder
    tables = matrix.read_matrix(args.what) if args.what else {}
    listed, more = tables.get("case", []), matrix.parse_faults(args.fault)
    tables = {**tables, **changed, "case": [*listed, *more] if isinstance(listed, list) else listed}
    if not tables["case"]:
        shipped = " or ".join(matrix.list_shipped_matrices())
        raise InputError("MATRIX.toml|FOLDER", "", f"a matrix file, the shipped matrix {shipped}, a folder of "
                                                   "traces, or --fault EFFECT=SIZE,..")
    return (matrix.build_matrix(tables, model, work, args.what or "--fault"),
            _choose_folder(args.out, Path(args.what).stem if args.what else "options"))


def _choose_folder(out: str | None, name: str) -> Path:
    return Path(out) if out else Path("campaigns") / name


def _parse_numbers(text: str) -> list[float]:
    from plant import InputError

    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError("--tolerance", text, "numbers with commas between, such as 0,0.015") from None


def _count_processes(asked: int | None) -> int:
    from plant import InputError

    if asked == 0:
        raise InputError("--jobs", "0", "1 or more")
    return asked or len(os.sched_getaffinity(0))


@contextmanager
def _show_batch_progress(silent: bool, interval: float = 30.0) -> Iterator[Callable[[BatchProgress], None]]:
    """Show progress as a bar on a terminal; elsewhere, for logs, as a line on standard error every `interval` s."""
    from rig.campaign.report import describe_progress
    from rig.cli.progress_bar import show_progress
    from rig.network.clock import WallClock

    clock, printed = WallClock(), 0.0
    with show_progress(is_silent=silent) as update:
        update("starting the workers", 0.0)

        def report_progress(progress: BatchProgress) -> None:
            nonlocal printed
            update(describe_progress(progress), progress.done / max(progress.total, 1))
            now = clock.now() * 1e-9
            if not silent and not sys.stderr.isatty() and now - printed >= interval:
                printed = now
                print(describe_progress(progress), file=sys.stderr, flush=True)

        yield report_progress
