"""`rig fdi`: how far faults have gone, from one captured test."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from fdi.diagnosis import make_bands
from fdi.diagnosis.bands import format_bands, load_bands
from fdi.diagnosis.diagnosis import Diagnosis, diagnose
from fdi.diagnosis.faults import choose_faults
from fdi.output import require_writable, write_text
from fdi.report import build_bands_report, build_diagnosis_report
from fdi.trace import Trace
from plant import require
from rig.cli import choose_places, format_arguments, give_answer, load_chosen_model, show_progress
from rig.cli.commands.simulate import load_command


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if all faults are acceptable, 1 otherwise. --learn-bands makes bands instead."""
    if args.learn_bands is not None:
        return learn_bands(args)
    require(args.command_file is None, "--command", str(args.command_file),
            "--learn-bands beside it; a trace has its own command")
    require(args.trace is not None, "TRACE", "", "a trace: trace.mcap, the folder of a run, or a CSV")
    places = choose_places(args, "", args.trace)
    model = load_chosen_model(args)
    with show_progress(args) as progress:
        bands = None if args.bands is None else load_bands(Path(args.bands), model.kind)
        faults = choose_faults(args.faults, model.kind)
        diagnosis = diagnose(Trace.read(args.trace, signals=model.kind.signals), model, bands, progress, args.trace,
                             with_effects=args.with_effects, faults=faults)
    report = replace(build_diagnosis_report(diagnosis), next_command=suggest_next_command(args, diagnosis),
                     files=places.files)
    return give_answer(report, args, int(diagnosis.verdict != "ACCEPTABLE"), places)


def learn_bands(args: argparse.Namespace) -> int:
    """Make bands for a command and write them; exit status 0."""
    require(args.trace is None, "--learn-bands", str(args.trace), "traces after the option, not before it")
    require(args.out and Path(args.out).suffix == ".toml", "--out", str(args.out or ""),
            "FILE.toml, where the bands go")
    model = load_chosen_model(args)
    faults = choose_faults(args.faults, model.kind)
    place = require_writable(args.out, "--out")
    with show_progress(args) as progress:
        if args.learn_bands:
            traces = []
            for done, source in enumerate(args.learn_bands):
                progress("reading", done / len(args.learn_bands))
                traces.append(Trace.read(source, signals=model.kind.signals))
            bands = make_bands.learn_bands(traces, model, args.learn_bands, progress, faults)
        else:
            com, _, name = load_command(args.command_file, model["controller.period"], model.kind)
            bands = make_bands.make_bands_by_simulation(model, com, np.zeros_like(com), model["controller.period"],
                                                        seed=args.seed, progress=progress, name=name, faults=faults)
    write_text(place, format_bands(bands))
    return give_answer(build_bands_report(bands, args.out), args)


def suggest_next_command(args: argparse.Namespace, diagnosis: Diagnosis) -> str:
    """What to type next where no fault explains the trace: the search for other effects, or after it
    `rig explain`; else "".
    """
    if diagnosis.verdict != "SOMETHING_ELSE":
        return ""
    return f"rig {'fdi --with-effects' if diagnosis.beside is None else 'explain'} {format_arguments(args)}"
