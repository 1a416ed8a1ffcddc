"""`rig bench`: the project's own benchmarks."""
from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rig.bench import Accuracy

HELP = "the project's own benchmarks"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("--accuracy", action="store_true",
                        help="also the error of the default step and of others, against 0.2 us (half a minute)")


def run(args: argparse.Namespace) -> int:
    """Measure the plant: ns a step beside the same step in C, speed of a run, cost of a cycle from Python."""
    from fdi.output import write_text
    from rig import bench
    from rig.sequences import load_sequence

    command = load_sequence("preflight").main_profile().command
    answer = bench.report(command)
    rows = bench.accuracy(command) if args.accuracy else []
    if rows:
        answer["accuracy"] = [row._asdict() for row in rows]
    if args.out is not None:
        write_text(args.out, json.dumps(answer, indent=1) + "\n")
    if args.json:
        print(json.dumps(answer))
    elif not args.quiet:
        _show(answer, rows)
    return 0


def _show(answer: dict[str, Any], rows: Sequence[Accuracy]) -> None:
    from rich.table import Table

    from rig.bench import GET_GCC
    from rig.console import console

    out = console()
    table = Table("The plant", "", "Python / C", "against Python", box=None, pad_edge=False)
    for row in _costs(answer):
        table.add_row(*row)
    out.print(table)
    if answer["step"] is None:
        out.print(f"step beside C: skipped, there is no gcc; to get it: {GET_GCC}")
    if rows:
        out.print()
        out.print("Error of XJ over the preflight, closed loop, against steps of 0.2 us, um")
        table = Table("step, us", "friction off: RMS", "max", "friction on: RMS", "max", box=None, pad_edge=False)
        for r in rows:
            table.add_row(f"{1000 / r.steps:g}", f"{r.rms:.4f}", f"{r.largest:.4f}", f"{r.rms_friction:.2f}",
                          f"{r.largest_friction:.2f}")
        out.print(table)


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
