"""`rig export`: signals as CSV, raw frames as CAN logs, a model as a functional mock-up unit."""

import argparse
from pathlib import Path

from fdi.output import require_new, require_writable
from fdi.report import Report
from plant import require
from rig.cli import give_answer, load_chosen_model, show_progress
from rig.recorder.convert import export_trace


def run_command(args: argparse.Namespace) -> int:
    """The suffix of --out chooses the format of a trace; --fmu writes a model."""
    if args.fmu is not None:
        return write_fmu(args)
    require(args.trace is not None, "TRACE", "", "a trace to export, or --fmu OUT.fmu for a model")
    require(not (args.model or args.set or args.effects), "--fmu", "",
            "OUT.fmu beside --model, --set and --effects: they do not change a trace")
    require(args.out is not None, "--out", "", "the file to write, such as run.csv or frames.blf")
    out = require_new(require_writable(args.out, "--out", source=args.trace), is_forced=args.force)
    count = export_trace(Path(args.trace), out, args.all)
    sentence = f"{out}: {count} {'rows' if '.csv' in out.suffixes else 'frames'}"
    return give_answer(Report("export", args.trace, sentence=sentence, data={"path": str(out), "count": count}), args)


def write_fmu(args: argparse.Namespace) -> int:
    """Write the model of --model, --set and --effects as a functional mock-up unit; exit status 0."""
    require(not (args.trace or args.out or args.all), "--fmu", str(args.fmu),
            "no TRACE, --out and --all beside it: it exports a model")
    require(args.fmu.suffix == ".fmu", "--fmu", str(args.fmu), "a file .fmu")
    out = require_new(require_writable(args.fmu, "--fmu", source=args.model), "--fmu", is_forced=args.force)
    from rig.fmi.export import export_fmu  # here: it loads numba

    model = load_chosen_model(args)
    with show_progress(args, "compiling"):
        platforms = export_fmu(model, out, args.fmi, args.seed)
    sentence = f"{out}: {model.name} as FMI {args.fmi}.0 co-simulation for {', '.join(platforms)}"
    data = {"path": str(out), "count": 1, "fmi": args.fmi, "platforms": platforms}
    return give_answer(Report("export", str(out), sentence=sentence, data=data), args)
