"""The reference pages of effects, parameters, signals and models."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from markdown_text import MADE, escape_markup, make_table, name_anchor, quote_code

from plant import Model, find_plant, list_plants, load_model
from plant.effects import Effect
from rig.cli.commands import list as list_command


def write_effect_page() -> list[str]:
    """The page of the catalogue."""
    found: dict[str, tuple[Effect, str]] = {}  # of one name, that of the first plant
    for plant in list_plants():
        for e in find_plant(plant).list_effects():
            found.setdefault(e.name, (e, plant))
    effects = [e for e, _ in found.values()]
    rows = [(f"[{e.name}](#{name_anchor('effect', e.name)})", e.port or "reference model", quote_code(e.law))
            for e in effects]
    lines = ["# Catalogue of effects", "", MADE, "",
             "An effect is a physical cause that a model may have or lack. [Effects](../docs/effects.md) shows how to "
             "add your own, [the plant](../docs/physics.md) has the equations.",
             *make_table(("effect", "acts on", "law"), rows)]
    for e, plant in found.values():
        lines += describe_effect(e, plant)
    return lines


def describe_effect(e: Effect, plant: str) -> list[str]:
    """The section of one effect, with the nominal values of a plant that has it."""
    nominal = load_model(plant)
    rows = [(quote_code(name), q.unit, f"{e.off.get(name, nominal.values.get(name, 0.0)):g}", q.expected, q.typical,
             "yes" if name in e.fitted else "no") for name, q in e.parameters.items()]
    facts = [("Acts on", e.port or "the reference model, as one of its own parameters"), ("Law", quote_code(e.law)),
             ("Symptoms", e.symptoms), ("Looks like", ", ".join(map(quote_code, e.confused_with))),
             ("Revealed by", e.revealed_by), ("Excludes", ", ".join(map(quote_code, e.excludes))),
             ("Plant", plant if e.plant else ""), ("Source", e.source)]
    return [f"({name_anchor('effect', e.name)})=", f"## {e.name}", "",
            *(f"- {name}: {escape_markup(text)}" for name, text in facts if text),
            *make_table(("parameter", "unit", "off or nominal", "allowed", "typical", "fitted"), rows)]


def write_parameter_page() -> list[str]:
    """The page of parameters, signals and models."""
    lines = ["# Parameters, signals, models", "", MADE, "", "`rig list` shows the same tables."]
    for plant in list_plants():
        model = load_model(plant)
        lines += [f"## Parameters of the plant {plant}", "", "Change one with `--set NAME=VALUE`.",
                  *make_plain_table(list_command.list_parameters(model))]
    lines += ["## Signals", *make_plain_table(list_command.list_signals(Model()))]
    return [*lines, "## Models", *make_plain_table(list_command.list_models(Model()))]


def make_plain_table(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """A table of `rig list`; the names are code."""
    table = list(rows)
    shown = [[quote_code(value) if key in ("name", "effects") else _format_value(value) for key, value in row.items()]
             for row in table]
    return make_table(list(table[0]), shown)


def _format_value(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else escape_markup(str(value))
