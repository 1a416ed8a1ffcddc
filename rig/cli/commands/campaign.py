"""`rig campaign`: a matrix of faults, sizes, tolerances and seeds, or a folder of traces, judged on many cores."""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from fdi.diagnosis.faults import choose_faults, load_faults
from fdi.foreign_code import ForeignCode, load_plant_of_model, require_trust
from fdi.output import write_text
from plant import InputError, count_nouns, load_model, require
from rig.campaign.batch import BatchProgress, Row, Workers
from rig.campaign.judge import (
    WORKS,
    Matrix,
    build_matrix,
    build_trace_matrix,
    is_campaign_folder,
    list_shipped_matrices,
    parse_faults,
    read_campaign_rows,
    read_matrix,
    read_matrix_of_folder,
    restore_faults,
    run_campaign,
)
from rig.campaign.summary import build_campaign_report, describe_progress, draw_detection_curves, summarise_campaign
from rig.cli import give_answer, parse_changes, show_progress
from rig.network import WallClock


def run_command(args: argparse.Namespace) -> int:
    """Exit status 1 if a case failed or a required rate is not reached."""
    if args.summary:
        folder = Path(args.out or args.what or "")
        return give_summary(read_campaign_rows(folder), folder, args)
    matrix, folder = choose_matrix(args)
    workers = Workers(args.jobs or len(os.sched_getaffinity(0)), args.scheduler or "")
    try:
        with show_batch_progress(args) as report_progress:
            rows = run_campaign(matrix, folder, workers, report_progress, args.most, args.again)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; rig campaign {shlex.quote(str(folder))} resumes it") from None
    return give_summary(rows, folder, args)


def give_summary(rows: Sequence[Row], folder: Path, args: argparse.Namespace) -> int:
    """Write and show the statistics of finished cases; return the exit status."""
    faults = (restore_faults(read_matrix_of_folder(folder).spec) if is_campaign_folder(folder)
              else load_faults(args.faults or "paper"))
    figures = summarise_campaign(rows, faults)
    report = build_campaign_report(figures, str(folder))
    if folder.is_dir():
        write_statistics(figures, folder)
        names = sorted(file.name for file in folder.iterdir() if file.suffix in (".parquet", ".json", ".svg"))
        report = replace(report, files=[("results", f"{folder}/ {', '.join(names)}")])
        if open_cases := len(read_matrix_of_folder(folder).cases) - len(rows):
            report = replace(report, sentence=f"{report.sentence} {count_nouns(open_cases, 'case')} left.",
                             next_command=f"rig campaign {shlex.quote(str(folder))}")
    is_missed = any(rate["met"] is False for part in figures["tolerances"] for rate in part["rates"])
    return give_answer(report, args, int(is_missed or bool(figures["status"].get("failed"))))


def write_statistics(figures: dict[str, Any], folder: Path) -> None:
    """Write summary.json, and a figure of the detection rates for each tolerance that has several sizes."""
    write_text(folder / "summary.json", json.dumps(figures, indent=1) + "\n")
    for part in figures["tolerances"]:
        if any(len(points) > 1 for points in part["curves"].values()):
            alone = len(figures["tolerances"]) == 1
            name = "detection.svg" if alone else f"detection-{100 * part['tolerance']:g}.svg"
            write_text(folder / name, draw_detection_curves(part, restore_faults(figures)))


def choose_matrix(args: argparse.Namespace) -> tuple[Matrix, Path]:
    """The matrix that the options describe, and the folder of its results.

    Raises:
        InputError: options that do not belong together, or a matrix that cannot be used.
    """
    options = {"seeds": args.seeds, "first": args.seed, "simulator": args.simulator, "signals": args.signals,
               "tolerance": None if args.tolerance is None else _parse_numbers(args.tolerance)}
    changes = {key: value for key, value in options.items() if value is not None}
    work = WORKS.get(args.work, args.work)
    if args.what and is_campaign_folder(args.what):
        require(not (changes or args.fault or args.faults or args.model or args.set or args.out), args.what, "",
                "no other option about the matrix: this folder has its own")
        matrix = read_matrix_of_folder(args.what)
        require(matrix.spec["work"] in (*WORKS.values(), work), args.what, "work",  # a folder is data
                f"--work {matrix.spec['work']} on the command line, to call that function")
        if "plant_file" in matrix.spec:
            path = Path(matrix.spec["plant_file"])
            code = [ForeignCode(str(path), path.read_bytes())] if path.is_file() else []
            require_trust(args.what, code, is_trusted=args.trust)
        return matrix, Path(args.what)
    load_plant_of_model(args.model, is_trusted=args.trust)
    model = load_model(args.model or "eha").replace(parse_changes(args.set))
    faults = choose_faults(args.faults, model.kind)
    campaigns = Path("campaigns")
    if args.what and Path(args.what).is_dir():
        require(not (changes or args.fault), args.what, "", "no faults or seeds: these are recorded traces")
        return (build_trace_matrix(args.what, model, work, faults),
                Path(args.out or campaigns / Path(args.what).absolute().name))
    tables = read_matrix(args.what) if args.what else {}
    cases, more = tables.get("case", []), parse_faults(args.fault)
    tables = {**tables, **changes, "case": [*cases, *more] if isinstance(cases, list) else cases}
    require(args.what or tables["case"], "MATRIX.toml|FOLDER", "",
            f"a matrix file, the shipped matrix {' or '.join(list_shipped_matrices())}, a folder of traces, or --fault "
            "EFFECT=SIZE,..")
    return (build_matrix(tables, model, work, args.what or "--fault", faults),
            Path(args.out or campaigns / Path(args.what or "options").stem))


def _parse_numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError("--tolerance", text, "numbers with commas between, such as 0,0.015") from None


@contextmanager
def show_batch_progress(args: argparse.Namespace, interval: float = 30.0) -> Iterator[Callable[[BatchProgress], None]]:
    """Show progress as a bar on a terminal; elsewhere, for logs, as a line on standard error every `interval` s."""
    clock, printed = WallClock(), 0.0
    with show_progress(args, "starting the workers") as update:
        def report_progress(progress: BatchProgress) -> None:
            nonlocal printed
            update(describe_progress(progress), progress.done / max(progress.total, 1))
            now = clock.now() * 1e-9
            if not (args.json or args.quiet or sys.stderr.isatty()) and now - printed >= interval:
                printed = now
                print(describe_progress(progress), file=sys.stderr, flush=True)

        yield report_progress
