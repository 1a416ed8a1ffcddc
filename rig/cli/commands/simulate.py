"""`rig simulate`: run a model on a command, without a bus, and write a trace."""
from __future__ import annotations

import argparse
from typing import Any

from rig.cli import options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig simulate`."""
    options.add_model_options(parser)
    parser.add_argument("--command", dest="command_file", metavar="FILE",
                        help="CSV with t,com and optionally load (default: the main phase of preflight); of rows up to "
                             "1 ms apart a cycle takes the latest, rows further apart are joined by straight lines")
    parser.add_argument("--steps", type=options.parse_whole_number, default=None, metavar="N",
                        help="steps of the plant per cycle (default 100)")


def run_command(args: argparse.Namespace) -> int:
    """Plant and controller in closed loop; t,com,xj,cor,p12,xs,load go to --out (default: simulation.csv)."""
    from pathlib import Path

    from fdi.output import require_writable
    from fdi.report.numbers import format_amount
    from fdi.report.report import Report
    from fdi.trace.trace import Trace
    from plant import InputError, simulate
    from plant.model import STEPS
    from rig.cli.answer import show_answer

    model = options.load_chosen_model(args)
    com, load, name = load_command(args.command_file, model["controller.period"])
    if args.steps == 0:
        raise InputError("--steps", "0", "at least 1 step a cycle")
    out = Path(args.out or "simulation.csv")
    if not out.name.endswith((".csv", ".csv.gz", ".mcap")):
        raise InputError("--out", str(out), "a file .csv, .csv.gz or .mcap")
    require_writable(out, "--out", source=args.command_file)
    columns = simulate(model, com, load, args.seed, args.steps or STEPS)
    trace = Trace.from_columns(columns._asdict(), model["controller.period"], {
        "model": model.name, "seed": str(args.seed), "command": name})
    if out.suffix == ".mcap":
        from rig.recorder.convert import write_mcap

        write_mcap(trace, out)
    else:
        trace.write_csv(out)
    error = columns.com - columns.xj
    summary: dict[str, Any] = {"trace": str(out), "cycles": len(com), "seconds": len(com) * model["controller.period"],
               "rms_error": float((error**2).mean() ** 0.5), "max_error": float(abs(error).max())}
    sentence = (f"{out}: {summary['cycles']} cycles, {summary['seconds']:g} s; following error "
                f"{format_amount(summary['rms_error'], 'm')} RMS, {format_amount(summary['max_error'], 'm')} at most")
    show_answer(Report("simulate", str(out), sentence=sentence, data=summary), args)
    return 0


def load_command(file: str | None, period: float) -> tuple[Any, Any, str]:
    """Demand, m, and load, N, of every cycle of `period` s, and their name; by default those of preflight.

    Raises:
        InputError: a file that cannot be read.
    """
    import numpy as np

    from plant.profile import read_command, resample_on_cycles
    from plant.segments import RATE

    if file is not None:
        com, load = read_command(file, period)
        return com, load, file
    from rig.sequences import load_sequence

    sequence = load_sequence("preflight")
    command, force = sequence.main_profile().command, sequence.load_profile()
    t = np.arange(len(command)) / RATE  # the bench's cycles
    return resample_on_cycles(t, command, period), resample_on_cycles(t, force, period), "preflight"
