"""`rig new`: a first file of your own, commented, to be completed."""

import argparse
import os
import re
from collections.abc import Callable, Mapping
from importlib.resources import files
from keyword import iskeyword
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.diagnosis.faults import load_faults
from fdi.output import require_new, require_writable, write_text
from fdi.report import Line, Report, Section
from plant import InputError, Plant, load_model, load_plant, read_file, require
from plant.effects import is_taken, load_effects
from plant.faults import WORD
from rig.benches import UNSURE, Wanted, decode_device_text, guess_can, guess_canopen, load_bench
from rig.cli import give_answer
from rig.sequences import load_sequence


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 also where the file is to be completed."""
    kind = KINDS[args.kind]
    path = Path(args.out or f"{args.name.removesuffix(kind.suffix)}{kind.suffix}")
    require(path.suffix == kind.suffix, "--out", str(path), f"FILE{kind.suffix}")
    require(kind.name.fullmatch(path.stem) and not iskeyword(path.stem), "NAME", path.stem,
            f"{'small ' if kind.name is WORD else ''}letters, digits and _, and no keyword of Python")
    require_new(require_writable(path, "--out"), is_forced=args.force)
    plant = load_model(args.model or "eha").kind
    more = f" --model {args.model}" if args.kind != "bench" else " --trust" if plant.file else ""
    check = kind.check.format(path=path) + (more if args.model else "")
    text = kind.write(path, args, plant, check)
    write_text(path, text)
    try:
        kind.read(path, plant)
        problem = ""
    except InputError as error:
        problem = str(error)
    return give_answer(build_new_report(args.kind, path, text, problem, check), args)


def write_example(path: Path, args: argparse.Namespace, plant: Plant, check: str) -> str:
    """The text of a file of the kinds that need no device: a shipped example, with names and sizes of the plant."""
    kind = args.kind
    require(not (args.eds or args.dbc or args.node or (args.model and kind == "plant")), f"rig new {kind}", "",
            "no device: --eds, --dbc and --node are of a bench, --model is of all but a plant")
    if kind == "effect":
        plant.require_equations()
        require(path.stem not in {*plant.parameters, *plant.effects} and not is_taken(path.stem, path.absolute()),
                "NAME", path.stem, "a name that no effect or group of parameters has")
    package, *place = EXAMPLES[kind]
    text = files(package).joinpath(*place).read_text(encoding="utf-8")
    if kind == "plant":
        return text
    return text.format(file=path, name=path.stem, check=check, **list_plant_words(plant))


def list_plant_words(kind: Plant) -> dict[str, Any]:
    """What the examples say of a plant: a port, fields of its state, a parameter, and sizes of a demand."""
    port = "load" if "load" in kind.ports else [*kind.ports][1]  # behind "command"
    moving = kind.moves if isinstance(kind.moves, tuple) else kind.state._fields
    parameter, healthy = next((name, value) for name, value in kind.nominal.items()
                              if value > 0.0 and name.partition(".")[0] != "controller")
    largest = float(np.abs(kind.build_nominal_command()).max(initial=0.0)) or 5e-3
    step = float(f"{0.4 * largest:.1g}")
    period = kind.nominal["controller.period"]
    times = {"brief": 0.2, "hold": 0.3, "out": 0.6, "long": 1.0}  # s, of segments: whole cycles
    return {"port": port, "unit": kind.ports[port].unit,
            "ports": "\n".join(f"#   {name} [{p.unit}]: {p.meaning}" for name, p in kind.ports.items()),
            "field": next(iter(moving), ""), "fields": ", ".join(kind.state._fields),
            "parameter": parameter, "healthy": healthy, "acceptable": 1.2 * healthy, "maintenance": 1.4 * healthy,
            "range": 2.0 * healthy, "controlled": kind.signals.controlled.unit,
            "signal": kind.signals.controlled.name, "step": step, "sine": 0.5 * step, "limit": 0.25 * step,
            **{name: round(time / period) * period for name, time in times.items()}}


def write_bench(path: Path, args: argparse.Namespace, plant: Plant, check: str) -> str:
    """The text of a bench file at `path`, from the EDS, DCF or DBC that the options name."""
    require((args.eds is None) != (args.dbc is None), "rig new bench", "",
            "--eds FILE (EDS or DCF of a CANopen device), or --dbc FILE")
    require(args.node is None or (args.eds and args.node < 128), "--node", str(args.node),
            "1 to 127, together with --eds")
    source = args.eds or args.dbc
    text, name = decode_device_text(read_file(source)), _name_from(path, source)
    wanted = Wanted()
    if args.model:
        wanted = Wanted(_name_from(path, args.model) if Path(args.model).is_file() else plant.key, plant.signals)
    if args.dbc:
        return guess_can(path.stem, name, text, wanted)
    return guess_canopen(path.stem, name, text, args.node, wanted)


def _name_from(path: Path, file: str | Path) -> str:
    """A file as one beside `path` names it."""
    return Path(os.path.relpath(file, path.parent)).as_posix()


def build_new_report(kind: str, path: Path, text: str, problem: str, check: str) -> Report:
    """Report on a file that was written: what is unsure in it, what is missing, and the command that checks it."""
    unsure_lines = [line.strip() for line in text.splitlines() if UNSURE in line]
    unsure = "; check what it marks as unsure" if unsure_lines else ""
    sentence = f"{path} is to be completed: {problem}" if problem else f"{path} can be used{unsure}."
    return Report("new", str(path), "INCOMPLETE" if problem else "COMPLETE", "doubtful" if problem else "good",
                  sentence, sections=[Section("Unsure", [Line("unsure", line) for line in unsure_lines])],
                  data={"verdict": "INCOMPLETE" if problem else "COMPLETE", "file": str(path), "problem": problem,
                        "unsure": unsure_lines}, next_command=check, files=[(kind, str(path))])


EXAMPLES = {"plant": ("plant", "models", "new_plant.py"), "effect": ("rig.cli", "new_effect.txt"),
            "sequence": ("rig.cli", "new_sequence.toml"), "fault": ("rig.cli", "new_fault.txt")}
FILE_NAME = re.compile(r"\w[\w.+-]*")  # needs no quotes in TOML or in a shell


class Kind(NamedTuple):
    """A kind of file."""

    name: re.Pattern[str]  # its own, or that of the effect or fault in it
    suffix: str
    write: Callable[[Path, argparse.Namespace, Plant, str], str]  # the last argument is the command that checks it
    read: Callable[[Path, Plant], Any]  # refuses what cannot be used
    check: str  # the command that checks it


KINDS: Mapping[str, Kind] = {
    "bench": Kind(FILE_NAME, ".toml", write_bench, lambda path, _: load_bench(str(path)), "rig check --bench {path}"),
    "plant": Kind(FILE_NAME, ".py", write_example, lambda path, _: load_plant(path), "rig check {path}"),
    "sequence": Kind(FILE_NAME, ".toml", write_example, lambda path, plant: load_sequence(
        path, 1.0 / plant.nominal["controller.period"], plant.key), "rig check {path}"),
    "effect": Kind(WORD, ".py", write_example, lambda path, _: load_effects(path),
                   "rig effects --effects {path} {path.stem}"),
    "fault": Kind(WORD, ".toml", write_example, load_faults, "rig check {path}"),
}
