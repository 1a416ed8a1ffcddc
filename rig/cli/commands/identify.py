"""`rig identify`: the parameters of an actuator from its runs, with intervals, and what these runs do not show."""

import argparse
import shlex
from dataclasses import replace
from datetime import date

from fdi.identification.identify import (
    identify_model,
    read_free_parameters,
    read_identification_runs,
    write_identified_model,
)
from fdi.report import build_identification_report
from plant import list_plants
from rig.cli import Places, choose_file, format_command_line, give_answer, list_signals, load_known_model, show_progress


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if every free parameter is identified.

    A model that does not explain the runs (UNEXPLAINED) is written only with --out.
    """
    model, _ = load_known_model(args)
    path = choose_file(args.out or "identified.toml", (".toml",), args.runs[0])
    assert path is not None
    page = choose_file(str(path.with_suffix(".html")), (".html",), args.runs[0])
    ranges = read_free_parameters(model, args.model)
    command = format_command_line()
    with show_progress(args, "reading") as progress:
        runs = read_identification_runs(model, ranges, args.runs, args.holdout, list_signals(args))
        identification = identify_model(runs.model, ranges, runs.fitted, runs.held_out, runs.sources, args.seed,
                                        progress)
    files, is_wanted, next_command = [("page", str(page))], identification.verdict != "CANNOT_TELL", ""
    if identification.verdict == "UNEXPLAINED":
        note = (f"{path} was written because of --out; its parameters do not explain the runs" if args.out else
                "no model file: these parameters do not explain the runs; --out FILE.toml writes them all the same")
        identification, is_wanted = replace(identification, notes=(*identification.notes, note)), bool(args.out)
    elif is_wanted:
        trust = [] if model.plant in list_plants() else ["--trust"]  # the model file names code
        next_command = "rig compare " + shlex.join([(args.holdout or args.runs)[0], "--model", str(path), *trust])
    if is_wanted:
        identification = replace(identification, model=replace(identification.model, name=path.stem))
        backup = write_identified_model(identification, path, command, date.today().isoformat())
        files.insert(0, ("model", str(path) + (f" (the one before: {backup})" if backup is not None else "")))
    report = build_identification_report(identification, identification.before.name, command, next_command, files)
    return give_answer(report, args, int(identification.verdict != "IDENTIFIED"), Places(page))
