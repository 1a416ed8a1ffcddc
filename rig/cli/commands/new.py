"""`rig new`: a first file of your own, commented, to be completed."""

import argparse
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from fdi.diagnosis.faults import load_faults
from fdi.output import require_new, require_writable, write_text
from fdi.report.report import Line, Report, Section
from plant.effects import load_effects
from plant.errors import InputError, require
from plant.faults import EXAMPLE, WORD
from plant.model import load_model
from plant.plants import load_plant
from plant.tables import read_file
from rig.benches.bench import decode_device_text
from rig.benches.bench_file import load_bench
from rig.benches.guess import UNSURE, Wanted, guess_can, guess_canopen
from rig.cli.answer import give_answer
from rig.sequences import load_sequence


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 also where the file is to be completed."""
    suffix, write, read, check = KINDS[args.kind]
    path = Path(args.out or f"{args.name.removesuffix(suffix)}{suffix}")
    require(path.suffix == suffix, "--out", str(path), f"FILE{suffix}")
    require_new(require_writable(path, "--out"), is_forced=args.force)
    text = write(path, args)
    write_text(path, text)
    try:
        read(path)
        problem = ""
    except InputError as error:
        problem = str(error)
    report = build_new_report(path, text, problem)
    return give_answer(replace(report, next_command=check.format(path=path), files=[(args.kind, str(path))]), args)


def write_example(path: Path, args: argparse.Namespace) -> str:
    """The text of a file of the kinds that need no device: a shipped example, with the name of the file in it."""
    kind = args.kind
    require(not (args.eds or args.dbc or args.node or args.model), f"rig new {kind}", "",
            "no device: --eds, --dbc, --node and --model are of a bench")
    require(kind not in ("fault", "effect") or WORD.fullmatch(path.stem), "NAME", path.stem,
            f"small letters, digits and _ : the name is also that of the {kind}")
    if kind == "fault":
        return EXAMPLE.format(file=path, name=path.stem)
    package, *place = EXAMPLES[kind]
    text = files(package).joinpath(*place).read_text(encoding="utf-8")
    return text if kind == "plant" else text.format(file=path, name=path.stem)


def write_bench(path: Path, args: argparse.Namespace) -> str:
    """The text of a bench file at `path`, from the EDS, DCF or DBC that the options name."""
    require((args.eds is None) != (args.dbc is None), "rig new bench", "",
            "--eds FILE (EDS or DCF of a CANopen device), or --dbc FILE")
    require(args.node is None or (args.eds and args.node < 128), "--node", str(args.node),
            "1 to 127, together with --eds")
    source = args.eds or args.dbc
    text, name = decode_device_text(read_file(source)), _name_from(path, source)
    wanted = Wanted()
    if args.model:
        kind = load_model(args.model).kind
        wanted = Wanted(_name_from(path, args.model) if Path(args.model).is_file() else kind.key, kind.signals)
    if args.dbc:
        return guess_can(path.stem, name, text, wanted)
    return guess_canopen(path.stem, name, text, args.node, wanted)


def _name_from(path: Path, file: str | Path) -> str:
    """A file as one beside `path` names it."""
    return Path(os.path.relpath(file, path.parent)).as_posix()


def build_new_report(path: Path, text: str, problem: str) -> Report:
    """Report on a file that was written: what is unsure in it, and what is missing."""
    marked = [line.strip() for line in text.splitlines() if UNSURE in line]
    unsure = "; check what it marks as unsure" if marked else ""
    sentence = f"{path} is to be completed: {problem}" if problem else f"{path} can be used{unsure}."
    return Report("new", str(path), "INCOMPLETE" if problem else "COMPLETE", "doubtful" if problem else "good",
                  sentence, sections=[Section("Unsure", [Line("unsure", line) for line in marked])],
                  data={"verdict": "INCOMPLETE" if problem else "COMPLETE", "file": str(path), "problem": problem,
                        "unsure": marked})


EXAMPLES = {"plant": ("plant", "models", "new_plant.py"), "effect": ("rig.cli", "new_effect.txt"),
            "sequence": ("rig.cli", "new_sequence.toml")}


class Kind(NamedTuple):
    """A kind of file."""

    suffix: str
    write: Callable[[Path, argparse.Namespace], str]
    read: Callable[[Path], Any]  # refuses what cannot be used
    check: str  # the command that checks it


KINDS: Mapping[str, Kind] = {
    "bench": Kind(".toml", write_bench, lambda path: load_bench(str(path)), "rig check --bench {path}"),
    "plant": Kind(".py", write_example, load_plant, "rig check {path}"),
    "sequence": Kind(".toml", write_example, load_sequence, "rig check {path}"),
    "effect": Kind(".py", write_example, load_effects, "rig effects --effects {path} {path.stem}"),
    "fault": Kind(".toml", write_example, lambda path: load_faults(str(path)), "rig check {path}"),
}
