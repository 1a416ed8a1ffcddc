"""`rig campaign`: a matrix of faults, sizes, tolerances and seeds, or a folder of traces, judged on many cores."""
from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.cli import options

if TYPE_CHECKING:
    from rig.studies.campaign.matrix import Matrix
    from rig.studies.campaign.run_campaign import Progress

EVERY = 30.0  # s between words on how far it is, where there is no terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("what", nargs="?", metavar="MATRIX.toml|FOLDER",
        help="a matrix file, a shipped matrix by name (statistics), a folder of traces, or the folder of a campaign "
             "to go on with")
    add("--summary", action="store_true", help="do nothing more; the statistics of what is there")
    add("--scheduler", metavar="ADDRESS", help="a Dask cluster, tcp://HOST:PORT, in place of processes of our own")
    add("--jobs", type=options.whole, metavar="N", help="processes on this machine (default: one a core)")
    add("--most", type=options.counted, metavar="N", help="stop after the first N cases, a fair sample of all")
    add("--again", action="store_true", help="do failed cases once more")
    add = parser.add_argument_group("the matrix").add_argument
    add("--fault", action="append", default=[], metavar="EFFECT=SIZE,..",
        help="cases: healthy, EFFECT=SIZE,SIZE.., or both at once EFFECT=SIZE/EFFECT=SIZE (repeatable)")
    add("--seeds", type=options.whole, metavar="N", help="runs of each size (default 20)")
    add("--seed", type=options.whole, metavar="N", help="seed of the first (default 0)")
    add("--tolerance", metavar="X,..", help="standard deviation of the base parameters, relative (default 0.015)")
    add("--simulator", choices=("plant", "independent"), help="ours (default), or the blind trial's in C, which "
                                                               "shares no physics with it")
    add("--signals", metavar="xj,p12,xs", help="what is measured (default: all three)")
    add("--model", metavar="FILE|NAME", help="the healthy plant (default eha)")
    add("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE", help="change a parameter of it (repeatable)")
    add("--work", default="fdi", metavar="MODULE:FUNCTION", help="another judgement than that of rig fdi")


def run_command(args: argparse.Namespace) -> int:
    """Judge every case; results.parquet, summary.json and detection.svg in --out (default: campaigns/NAME)."""
    from rig.studies.campaign.folder import read_rows
    from rig.studies.campaign.run_campaign import Hands
    from rig.studies.campaign.run_campaign import run as campaign

    if args.summary:
        folder = Path(args.out or args.what or "")
        rows = read_rows(folder)
    else:
        matrix, folder = _matrix(args)
        hands = Hands(_jobs(args.jobs), args.scheduler or "")
        with _told(args.json or args.quiet) as tell:
            rows = campaign(matrix, folder, hands, tell, args.most, args.again)
    return _concluded(rows, folder, args)


def _concluded(rows: Sequence[dict[str, Any]], folder: Path, args: argparse.Namespace) -> int:
    """Statistics to files and terminal; 1 if a case failed or a rate that is asked for is not reached."""
    from rig.cli.terminal import console
    from rig.studies.campaign import show_campaign
    from rig.studies.campaign.folder import matrix_of
    from rig.studies.campaign.summary import summary

    figures = summary(rows)
    if folder.is_dir():
        _write(figures, folder)
    if args.json:
        print(json.dumps(figures))
    elif not args.quiet:
        show_campaign.summary(figures, console())
        if folder.is_dir():
            if left := len(matrix_of(folder).cases) - len(rows):
                print(f"left      {left} cases, with which rig campaign {shlex.quote(str(folder))} goes on")
            print(f"results   {folder}/ " + ", ".join(sorted(file.name for file in folder.iterdir()
                                                             if file.suffix in (".parquet", ".json", ".svg"))))
    missed = [rate for part in figures["tolerances"] for rate in part["rates"] if rate["met"] is False]
    return 1 if missed or figures["status"].get("failed") else 0


def _write(figures: dict[str, Any], folder: Path) -> None:
    from rig.studies.campaign.detection_figure import detection
    from rig.studies.campaign.folder import replaced

    replaced(folder / "summary.json", (json.dumps(figures, indent=1) + "\n").encode())
    for part in figures["tolerances"]:
        if any(len(points) > 1 for points in part["curves"].values()):
            alone = len(figures["tolerances"]) == 1
            name = "detection.svg" if alone else f"detection-{100 * part['tolerance']:g}.svg"
            replaced(folder / name, detection(part).encode())


def _matrix(args: argparse.Namespace) -> tuple[Matrix, Path]:
    """The campaign that the options describe, and where it lives."""
    from plant import InputError, load_model
    from rig.studies.campaign import matrix
    from rig.studies.campaign.folder import is_campaign, matrix_of
    from rig.studies.campaign.judge import WORKS

    wanted = {"seeds": args.seeds, "first": args.seed, "simulator": args.simulator, "signals": args.signals,
              "tolerance": None if args.tolerance is None else _numbers(args.tolerance)}
    changed = {key: value for key, value in wanted.items() if value is not None}
    if args.what and is_campaign(args.what):
        if changed or args.fault or args.model or args.set or args.out:
            raise InputError(args.what, "", "no other option about the matrix: this folder has its own")
        return matrix_of(args.what), Path(args.what)
    model = load_model(args.model or "eha").replace(options.changes(args.set))
    work = WORKS.get(args.work, args.work)
    if args.what and Path(args.what).is_dir():
        if changed or args.fault:
            raise InputError(args.what, "", "no faults or seeds: these are recorded traces")
        return matrix.of_traces(args.what, model, work), _folder(args.out, Path(args.what).absolute().name)
    tables = matrix.read_matrix(args.what) if args.what else {}
    listed, more = tables.get("case", []), matrix.parsed(args.fault)
    tables = {**tables, **changed, "case": [*listed, *more] if isinstance(listed, list) else listed}
    if not tables["case"]:
        raise InputError("CAMPAIGN", "", f"a matrix file, {', '.join(matrix.shipped())}, --fault or a folder")
    return (matrix.matrix(tables, model, work, args.what or "--fault"),
            _folder(args.out, Path(args.what).stem if args.what else "options"))


def _folder(out: str | None, name: str) -> Path:
    return Path(out) if out else Path("campaigns") / name


def _numbers(text: str) -> list[float]:
    from plant import InputError

    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError("--tolerance", text, "numbers with commas between, such as 0,0.015") from None


def _jobs(asked: int | None) -> int:
    from plant import InputError

    if asked == 0:
        raise InputError("--jobs", "0", "1 or more")
    return asked or len(os.sched_getaffinity(0))


@contextmanager
def _told(silent: bool) -> Iterator[Callable[[Progress], None]]:
    """A bar on a terminal; elsewhere a line now and then, for logs."""
    from rig.cli.progress_bar import show_progress
    from rig.network.clock import WallClock
    from rig.studies.campaign.show_campaign import line

    clock, said = WallClock(), [0.0]
    with show_progress(is_silent=silent) as update:
        def tell(progress: Progress) -> None:
            update(line(progress), progress.done / max(progress.total, 1))
            now = clock.now() * 1e-9
            if not silent and not sys.stderr.isatty() and now - said[0] >= EVERY:
                said[0] = now
                print(line(progress), file=sys.stderr, flush=True)

        yield tell
