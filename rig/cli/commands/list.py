"""`rig list`: the names that other commands take, with unit, range and default."""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from math import isfinite
from typing import TYPE_CHECKING, Any

from rig.cli import options

if TYPE_CHECKING:
    from fdi.report.report import Report
    from plant.model import Model
    from plant.quantity import Quantity

Rows = list[dict[str, Any]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig list`."""
    parser.add_argument("kind", choices=list(KINDS), metavar="KIND", help="one of: " + ", ".join(KINDS))
    parser.add_argument("word", nargs="?", default="", metavar="WORD", help="only names that contain this word")
    options.add_model_options(parser)


def run_command(args: argparse.Namespace) -> int:
    """Names come with unit, range and default."""
    from rig.cli.answer import show_answer

    found = KINDS[args.kind](options.load_chosen_model(args))
    rows = [row for row in found if args.word.lower() in row["name"].lower()]
    show_answer(build_list_report(args.kind, rows), args)
    return 0


def build_list_report(kind: str, rows: Rows) -> Report:
    """Report on the names of one kind."""
    from fdi.report.report import Cell, Column, Report, Section, Table

    keys = list(rows[0]) if rows else ["name"]
    shown = [[Cell(_format(row[key]), is_strong=key == "name") for key in keys] for row in rows]
    sentence = f"{len(rows)} {kind}" if rows else f"no {kind} of that name"
    return Report("list", kind, sentence=f"{sentence}. {USES[kind]}",
                  sections=[Section("", [Table([Column(key) for key in keys], shown)] if rows else [])],
                  data={"kind": kind, kind: rows})


def _format(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)


def list_parameters(model: Model) -> Rows:
    """Every parameter that --set takes: of the model, and of the effects that it does not have yet."""
    from plant.model import find_parameter_groups, find_quantity, list_offered_effects

    off = {name: value for e in list_offered_effects(model.plant) for name, value in e.off.items()}
    groups = find_parameter_groups(plant=model.plant)
    names = [f"{group}.{field}" for group, fields in groups.items() for field in fields._fields]
    rows = []
    for name in names:
        quantity = find_quantity(name, plant=model.plant)
        default = model.values.get(name, off.get(name))
        word = next((word for word, value in quantity.words.items() if value == default), None)
        rows.append({"name": name, "unit": quantity.unit, "default": word or default,
                     "range": _describe_range(quantity)})
    return rows


def _describe_range(q: Quantity) -> str:
    """The allowed values, in the unit of the quantity: ">= 0, < 1"."""
    if q.words:
        return ", ".join(q.words)
    limits = (("> ", q.above), (">= ", q.low), ("< ", q.below), ("<= ", q.high))
    return ", ".join(f"{sign}{limit:g}" for sign, limit in limits if isfinite(limit)) or "any"


def list_signals(model: Model) -> Rows:
    """The columns of a trace."""
    from fdi.trace.signals import OUTPUTS, SIGNALS

    required = ("t", "com", "xj", "cor")
    return [{"name": s.name, "symbol": s.symbol, "unit": s.unit, "content": s.quantity,
             "in a trace": "required" if s.name in required else "optional",
             "noise of the model": model.values.get(s.noise) if s.name in OUTPUTS else None}
            for s in SIGNALS.values()]


def list_sequences(model: Model) -> Rows:
    """The shipped sequences."""
    from importlib.resources import files
    from pathlib import Path

    from rig.sequences import load_sequence

    names = sorted(Path(entry.name).stem for entry in files("rig.sequences").iterdir() if entry.name.endswith(".toml"))
    found = [(name, load_sequence(name)) for name in names]
    return [{"name": name, "title": s.title, "main, s": s.duration, "checks": len(s.checks), "faults": len(s.faults)}
            for name, s in found]


def list_effects(model: Model) -> Rows:
    """The catalogue, the user's own effects included."""
    from plant.model import list_offered_effects

    rows = []
    for e in list_offered_effects(model.plant):
        parameters = [f"{name} [{q.unit}], {_describe_range(q)}, {_describe_off(e.off.get(name), name, model)}"
                      for name, q in e.parameters.items()]
        rows.append({"name": e.name, "acts on": e.port or "reference model",
                     "in model": "yes" if e.base or e.name in model.effects else "no",
                     "parameters [unit], range, default": "\n".join(parameters)})
    return rows


def _describe_off(off: float | None, name: str, model: Model) -> str:
    return f"nominal {model.kind.nominal.get(name, 0.0):g}" if off is None else f"off at {off:g}"


def list_checks(model: Model) -> Rows:
    """The kinds of checks of a sequence, with their own keys and defaults."""
    from rig.sequences import checks

    return [{"name": name, "measures": kind.text.rstrip("."),
             "unit": "any" if name == "python" else kind.unit or "the signal's",
             "keys": "\n".join(_describe_keys(kind.keys))}
            for name, kind in checks.KINDS.items()]


def _describe_keys(kind: type[Any]) -> Iterator[str]:
    """The keys of a kind of check beside those that every check has."""
    from dataclasses import MISSING, fields

    from rig.sequences.checks import Check

    common = {f.name for f in fields(Check)} - {"window"}
    for f in fields(kind):
        if f.name not in common and f.metadata.get("key", True):
            yield f.name if f.default is MISSING else f"{f.name} = {f.default!r}"


def list_models(model: Model) -> Rows:
    """The shipped models: what --model takes beside a file."""
    from plant.model import SHIPPED_MODELS, load_model
    from plant.plants import list_plants

    rows = []
    for name in (*list_plants(), *SHIPPED_MODELS):
        shipped = load_model(name)
        rows.append({"name": name, "plant": shipped.plant, "cycle, s": shipped["controller.period"],
                     "effects": "\n".join(shipped.effects) or "-", "default": "yes" if name == "eha" else "no"})
    return rows


KINDS: Mapping[str, Callable[[Any], Rows]] = {
    "parameters": list_parameters, "signals": list_signals, "sequences": list_sequences, "effects": list_effects,
    "checks": list_checks, "models": list_models}
USES: Mapping[str, str] = {
    "parameters": "Change one with --set NAME=VALUE.",
    "signals": "Choose outputs with --signals xj,p12,xs.",
    "sequences": "Run one with rig run NAME.",
    "effects": "Add one with --set EFFECT.PARAMETER=VALUE; rig effects NAME shows its law.",
    "checks": ("Use one in a sequence by its kind; every check also takes name, low, high, unit, window, skip and "
               "requirement."),
    "models": "Choose one with --model NAME, or a file.",
}
