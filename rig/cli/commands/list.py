"""`rig list`: the names that other commands take, with unit, range and default."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, fields
from math import isfinite
from typing import Any

from fdi.report import Cell, Column, Report, Section, Table
from plant import (
    SHIPPED_MODELS,
    Model,
    Quantity,
    count_nouns,
    find_plant,
    find_quantity,
    list_plants,
    load_model,
    require,
)
from rig.cli import give_answer, load_chosen_model

Rows = list[dict[str, Any]]


def run_command(args: argparse.Namespace) -> int:
    """Names come with unit, range and default."""
    find, use = KINDS[args.kind]
    require(args.faults is None or args.kind == "faults", "--faults", args.faults, f"rig list faults, not {args.kind}")
    model = load_chosen_model(args)
    rows = list_faults(model, args.faults) if args.kind == "faults" else find(model)
    rows = [row for row in rows if args.word.lower() in row["name"].lower()]
    return give_answer(build_list_report(args.kind, use, rows), args)


def build_list_report(kind: str, use: str, rows: Rows) -> Report:
    """Report on the names of one kind."""
    keys = [*rows[0]] if rows else ["name"]
    cells = [[Cell(_format(row[key]), is_strong=key == "name") for key in keys] for row in rows]
    sentence = (count_nouns(len(rows), "bench" if kind == "benches" else kind.removesuffix("s"), kind) if rows
                else f"no {kind} of that name")
    return Report("list", kind, sentence=f"{sentence}. {use}", data={"kind": kind, kind: rows},
                  sections=[Section("", [Table([Column(key) for key in keys], cells)] if rows else [])])


def _format(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)


def list_parameters(model: Model) -> Iterator[dict[str, Any]]:
    """Every parameter that --set takes: of the model, and of the effects that it does not have yet."""
    off = {name: value for e in model.kind.list_effects() for name, value in e.off.items()}
    for group, fields_ in model.kind.list_groups().items():
        for name in (f"{group}.{field}" for field in fields_._fields):
            quantity = find_quantity(name, plant=model.plant)
            default = model.values.get(name, off.get(name))
            word = next((word for word, value in quantity.words.items() if value == default), None)
            yield {"name": name, "unit": quantity.unit, "default": word or default,
                   "range": _describe_range(quantity)}


def _describe_range(q: Quantity) -> str:
    """The allowed values, in the unit of the quantity: ">= 0, < 1"."""
    if q.words:
        return ", ".join(q.words)
    limits = (("> ", q.above), (">= ", q.low), ("< ", q.below), ("<= ", q.high))
    return ", ".join(f"{sign}{limit:g}" for sign, limit in limits if isfinite(limit)) or "any"


def list_signals(model: Model) -> Rows:
    """The columns of a trace."""
    signals = model.kind.signals
    return [{"name": s.name, "symbol": s.symbol, "unit": s.unit, "content": s.quantity,
             "in a trace": "required" if s.name in ("t", *signals.required) else "optional",
             "noise of the model": model.values.get(s.noise) if s.role == "output" else None}
            for s in signals]


def list_sequences(model: Model) -> Rows:
    """The shipped sequences."""
    from rig.sequences import load_sequence, sequence  # here: only this list and that of the checks need the bench

    sequences = [(name, load_sequence(name)) for name in sequence.list_shipped()]
    return [{"name": name, "title": s.title, "main, s": s.duration, "checks": len(s.checks), "faults": len(s.faults)}
            for name, s in sequences]


def list_effects(model: Model) -> Rows:
    """The catalogue, the user's own effects included."""
    return [{"name": e.name, "acts on": e.port or "reference model",
             "in model": "yes" if e.base or e.name in model.effects else "no",
             "parameters [unit], range, default": "\n".join(f"{name} [{q.unit}], {_describe_range(q)}, " + (
                 f"off at {e.off[name]:g}" if name in e.off else f"nominal {model.kind.nominal.get(name, 0.0):g}")
                 for name, q in e.parameters.items())} for e in model.kind.list_effects()]


def list_checks(model: Model) -> Rows:
    """The kinds of checks of a sequence, with their own keys and defaults."""
    from rig.sequences import checks

    return [{"name": name, "measures": kind.text.rstrip("."),
             "unit": "any" if name == "python" else kind.unit or "the signal's",
             "keys": "\n".join(_describe_keys(kind.keys, checks.Check))}
            for name, kind in checks.KINDS.items()]


def _describe_keys(kind: type[Any], base: type[Any]) -> Iterator[str]:
    """The keys of a kind of check beside those that every check has, whose class is `base`."""
    common = {f.name for f in fields(base)} - {"window"}
    for f in fields(kind):
        if f.name not in common and f.metadata.get("key", True):
            default = f.default if f.default_factory is MISSING else f.default_factory()
            yield f.name if default is MISSING else f"{f.name} = {default!r}"


def list_models(model: Model) -> Rows:
    """The shipped models: what --model takes beside a file."""
    models = [(name, load_model(name)) for name in (*list_plants(), *SHIPPED_MODELS)]
    return [{"name": name, "plant": m.plant, "cycle, s": m["controller.period"],
             "effects": "\n".join(m.effects) or "-", "default": "yes" if name == "eha" else "no"} for name, m in models]


def list_benches(model: Model) -> Rows:
    """The shipped benches: what --bench takes beside a file."""
    from rig.benches import bench_file  # here: only this list needs the frames

    benches = [(name, bench_file.load_bench(name)) for name in bench_file.list_benches()]
    return [{"name": name, "title": b.name, "protocol": "canopen" if b.nodes else "can", "plant": b.plant,
             "cycle, s": b.cycle_ns / 1e9, "frames": len(b.frames.frames)} for name, b in benches]


def list_shipped_plants(model: Model) -> Rows:
    """The shipped plants: what `plant` in a model or bench file names beside a file."""
    return [{"name": plant.name, "title": plant.title, "controlled": plant.signals.controlled.name,
             "cycle, s": plant.nominal["controller.period"], "effects": len(plant.list_effects()),
             "own faults": len(plant.faults)} for plant in map(find_plant, list_plants())]


def list_faults(model: Model, source: str | None = None) -> Rows:
    """The faults of a file, of the plant, or of all shipped lists that the plant can have."""
    from fdi.diagnosis.faults import choose_faults, list_fault_files, load_faults  # here: only this list needs them

    if source is not None or model.kind.faults:
        lists = {source or model.plant: choose_faults(source, model.kind)}
    else:
        lists = {name: load_faults(name, model.kind) for name in list_fault_files()} if model.plant == "eha" else {}
    return [{"name": f.name, "list": name, "title": f.title, "parameter": f.parameter, "unit": f.unit,
             "healthy": f.healthy, "acceptable": f.acceptable, "maintenance": f.maintenance,
             "range": f"{f.range[0]:g} .. {f.range[1]:g}"} for name, faults in lists.items() for f in faults]


KINDS: Mapping[str, tuple[Callable[[Model], Iterable[dict[str, Any]]], str]] = {  # what lists them, and how to use one
    "parameters": (list_parameters, "Change one with --set NAME=VALUE."),
    "signals": (list_signals, "Choose outputs with --signals NAME,NAME."),
    "sequences": (list_sequences, "Run one with rig run NAME."),
    "effects": (list_effects, "Add one with --set EFFECT.PARAMETER=VALUE; rig effects NAME shows its law."),
    "checks": (list_checks, "Use one in a sequence by its kind; every check also takes name, low, high, unit, window, "
                            "skip and requirement."),
    "models": (list_models, "Choose one with --model NAME, or a file."),
    "benches": (list_benches, "Choose one with --bench NAME, or a file."),
    "plants": (list_shipped_plants, "Name one with plant = in a model or bench file, or a file (rig new plant)."),
    "faults": (list_faults, "Measure those of a list with rig fdi TRACE --faults LIST, or a file; SI units."),
}
