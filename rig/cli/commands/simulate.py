"""`rig simulate`: run a model on a command, without a bus, and write a trace."""

import argparse
from pathlib import Path
from typing import Any

from fdi.output import require_new, require_writable
from fdi.report import Report, format_amount
from fdi.trace import Trace, read_command
from plant import Plant, Points, build_profile, count_nouns, find_divergence, load_model, require, simulate
from rig.cli import give_answer, load_chosen_model, show_progress
from rig.sequences import load_nominal_test

SAMPLE_UNIT = {"jack.static_friction": 900.0, "jack.dynamic_friction": 600.0, "null_bias.current": 5e-5}
SAMPLE_POINTS = ((0.0, 0.0), (0.5, 0.0), (0.501, 2e-3), (1.5, 2e-3), (3.0, -3e-3), (4.0, -3e-3), (4.001, -1e-3),
                 (5.0, -1e-3), (5.5, 4e-3), (6.0, 1e-3), (7.5, 1.3e-3), (8.0, -4e-3), (9.0, -4e-3), (9.001, 0.0),
                 (10.0, 0.0))  # s, m: steps, slow ramps and corners


def run_command(args: argparse.Namespace) -> int:
    """Plant and controller in closed loop; t and the signals of the plant go to --out (default: simulation.csv)."""
    if args.samples:
        return write_samples(args)
    model = load_chosen_model(args)
    period = model["controller.period"]
    signals = model.kind.signals
    com, load, name = load_command(args.command_file, period, model.kind)
    model.require_acting_load(load, name)
    require(not args.steps or model.kind.foreign is None, "--steps", str(args.steps),
            "a plant with equations; an FMU has steps of its own")
    out = Path(args.out or "simulation.csv")
    require(out.name.endswith((".csv", ".csv.gz", ".mcap")), "--out", str(out), "a file .csv, .csv.gz or .mcap")
    require_new(require_writable(out, "--out", source=args.command_file), is_forced=args.force)
    with show_progress(args, "simulating"):
        columns = simulate(model, com, load, args.seed, args.steps)._asdict()
    require(not (diverged := find_divergence(model, columns)), args.model or "--set", "",
            f"a plant that stays finite; {diverged} (rig simulate --steps takes shorter steps)")
    trace = Trace.from_columns(columns, period, {"model": model.name, "seed": str(args.seed), "command": name,
                                                 **({} if model.plant == "eha" else {"plant": model.plant})}, signals)
    if out.suffix == ".mcap":
        from rig.recorder.convert import write_mcap  # here: it loads python-can

        write_mcap(trace, out)
    else:
        trace.write_csv(out)
    summary: dict[str, Any] = {"trace": str(out), "cycles": len(com), "seconds": len(com) * period}
    sentence = f"{out}: {count_nouns(len(com), 'cycle')}, {summary['seconds']:g} s"
    unit = signals.controlled.unit
    if signals.command.unit == unit:  # the command of an open loop may be a voltage
        error = columns[signals.command.name] - columns[signals.controlled.name]
        summary |= {"rms_error": float((error**2).mean() ** 0.5), "max_error": float(abs(error).max())}
        sentence += (f"; following error {format_amount(summary['rms_error'], unit)} RMS, "
                     f"{format_amount(summary['max_error'], unit)} at most")
    return give_answer(Report("simulate", str(out), sentence=sentence, data=summary), args)


def write_samples(args: argparse.Namespace) -> int:
    """Write the recordings of --samples; exit status 0."""
    require(not (args.model or args.set or args.effects or args.command_file), "--samples", "",
            "no --model, --set, --effects and --command beside it: the unit is fixed")
    folder = Path(args.out or ".")
    require(folder.is_dir(), "--out", str(folder), "a folder that exists")
    model = load_model().replace(SAMPLE_UNIT)
    period = model["controller.period"]
    usual, load, _ = load_command(None, period, model.kind)
    other = build_profile((Points(points=SAMPLE_POINTS),)).command
    runs = {"run.csv": usual, "run2.csv": usual, "held.csv": other}
    places = {name: require_new(folder / name, is_forced=args.force) for name in runs}
    steps = args.steps or 400  # a cycle: finer than those of a fit, as a real unit is
    for seed, (name, com) in enumerate(runs.items(), args.seed + 1):
        columns = simulate(model, com, load[:len(com)], seed, steps)
        Trace.from_columns(columns._asdict(), period, {"seed": str(seed)},
                           model.kind.signals).write_csv(places[name])
    sentence = (f"{', '.join(map(str, places.values()))}: a run, its repeat, and a run of another command. Next: "
                f"rig compare {places['run.csv']} --repeat {places['run2.csv']}")
    return give_answer(Report("simulate", "samples", sentence=sentence,
                              data={"traces": [str(place) for place in places.values()]}), args)


def load_command(file: str | None, period: float, kind: Plant) -> tuple[Any, Any, str]:
    """Demand and load of every cycle of `period` s, and their name; by default the nominal test, of the EHA preflight.

    Raises:
        InputError: a file that cannot be read, or none for a plant that declares no test.
    """
    return load_nominal_test(kind, period) if file is None else (*read_command(file, period, kind.signals), file)
