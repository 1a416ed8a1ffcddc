"""`rig bench`: the project's own benchmarks."""
from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from rig.studies.benchmarks.plant_step import Accuracy
    from rig.studies.resumable.batch import BatchProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("what", nargs="?", choices=("plant", "explain"), default="plant",
                        help="what to measure: the speed of the plant (default), or how often rig explain is right")
    parser.add_argument("--accuracy", action="store_true",
                        help="also the error of the default step and of others, against 0.2 us (half a minute)")
    add = parser.add_argument_group("rig bench explain", "a blind trial, hours long (docs/trial.md)").add_argument
    add("--cases", type=int, default=200, metavar="N", help="number of cases (default: 200)")
    add("--seed", type=int, default=0, help="seed of the first case; each case uses the next seed (default: 0)")
    add("--jobs", type=int, default=2, metavar="N", help="cases at a time; use 1 for reliable timings (default: 2)")
    add("--folder", metavar="DIR", help="keep cases and answers there; an interrupted trial resumes there")


def run_command(args: argparse.Namespace) -> int:
    """Measure the plant: a step, a run, a cycle from Python, and many runs at once, beside C and other libraries."""
    if args.what == "explain":
        return _run_trial(args)
    from fdi.output import write_text
    from rig.cli.progress_bar import show_progress
    from rig.sequences import load_sequence
    from rig.studies.benchmarks.plant_step import measure_accuracy
    from rig.studies.benchmarks.run_benchmarks import run_benchmarks

    command = load_sequence("preflight").main_profile().command
    with show_progress(is_silent=args.json or args.quiet) as progress:
        answer = run_benchmarks(command, progress)
    rows = measure_accuracy(command) if args.accuracy else []
    if rows:
        answer["accuracy"] = [row._asdict() for row in rows]
    if args.out is not None:
        write_text(args.out, json.dumps(answer, indent=1) + "\n")
    if args.json:
        print(json.dumps(answer))
    elif not args.quiet:
        _show(answer, rows)
    return 0


def _run_trial(args: argparse.Namespace) -> int:
    """The blind trial; exit status 0 if every requested rate that was counted is reached, 1 otherwise.

    Raises:
        InputError: no cases, no C compiler, or a place that cannot be written.
    """
    import tempfile
    from pathlib import Path

    from fdi.output import writable, write_text
    from plant.errors import InputError
    from rig.cli.terminal import console
    from rig.studies.trial import show_trial
    from rig.studies.trial.blackbox import RIG_EXPLAIN
    from rig.studies.trial.run_trial import run_trial
    from rig.studies.trial.score import summarise_trial

    for option, count in (("--cases", args.cases), ("--jobs", args.jobs)):
        if count < 1:
            raise InputError(option, str(count), "1 or more")
    if args.out is not None:
        writable(args.out, "--out")
    out = console()

    def report_progress(progress: BatchProgress) -> None:
        if not (args.json or args.quiet):
            out.print(show_trial.line(progress), markup=False)

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(args.folder or temporary)
        seeds = range(args.seed, args.seed + args.cases)
        figures = summarise_trial(run_trial(RIG_EXPLAIN, seeds, folder, args.jobs, report_progress))
    if args.out is not None:
        write_text(args.out, json.dumps(figures, indent=1) + "\n")
    if args.json:
        print(json.dumps(figures))
    elif not args.quiet:
        show_trial.summary(figures, out)
    return 0 if all(rate["met"] or not rate["of"] for rate in figures["rates"]) else 1


def _show(answer: dict[str, Any], rows: Sequence[Accuracy]) -> None:
    from rich.table import Table

    from rig.cli.terminal import console
    from rig.studies.benchmarks.rivals import GET_GCC

    out = console()
    table = Table("The plant", "", "Python / C", "against Python", box=None, pad_edge=False)
    for row in _costs(answer):
        table.add_row(*row)
    out.print(table)
    if answer["step"] is None:
        out.print(f"step beside C: skipped, there is no gcc; to get it: {GET_GCC}")
    _show_many(out, answer["many"], "Many runs at once", "steps/s", "XJ apart by")
    _show_many(out, answer["grid"], "The RMS grid, 21x21 cells", "cycles/s", "RMS apart by")
    if rows:
        out.print()
        out.print("Error of XJ over the preflight, closed loop, against steps of 0.2 us, um")
        table = Table("step, us", "friction off: RMS", "max", "friction on: RMS", "max", box=None, pad_edge=False)
        for r in rows:
            table.add_row(f"{1000 / r.steps:g}", f"{r.rms:.4f}", f"{r.largest:.4f}", f"{r.rms_friction:.2f}",
                          f"{r.largest_friction:.2f}")
        out.print(table)


def _show_many(out: Console, rivals: Sequence[dict[str, Any]], title: str, speed: str, apart: str) -> None:
    from rich.table import Table

    table = Table(title, speed, "ours / its", apart, box=None, pad_edge=False)
    for rival in rivals:
        if rival["speed"] is not None:
            by = f"{rival['difference'] * 1e6:.0e} um" if rival["difference"] else "no bit"
            table.add_row(rival["name"], f"{rival['speed'] / 1e6:.3g} M", f"{rival['ratio']:.3g}", by)
    out.print()
    out.print(table)
    for rival in rivals:
        if rival["note"]:
            out.print(f"{rival['name']}: {rival['note']}", markup=False, soft_wrap=True)


def _costs(answer: dict[str, Any]) -> list[tuple[str, ...]]:
    """Rows of the table: what, cost, ratio, how far the results are apart."""
    step = answer["step"]
    rows: list[tuple[str, ...]] = [("preflight, simulated", f"{answer['times_real_time']:.0f} x real time"),
                                   ("cycle of Actuator from Python", f"{answer['cycle'] * 1e6:.1f} us"),
                                   ("preflight on the embedded bus", f"{answer['lockstep']:.1f} x real time")]
    if step is None:
        return rows
    same = "equal bit for bit" if step["identical"] else "NOT equal"
    return [*rows,
            ("step, compiled Python", f"{step['python']:.1f} ns"),
            (f"step, {step['compiler']} -O3 -march=native", f"{step['c']:.1f} ns", f"{step['ratio']:.2f}",
             f"within {step['difference'] * 1e6:.0e} um"),
            ("step, gcc, and -ffp-contract=off", f"{step['c_same_rounding']:.1f} ns",
             f"{step['ratio_same_rounding']:.2f}", same)]
