"""A model file that knows where it comes from: runs, commands, intervals, and the error after each effect.

All of that stands in the file's table [provenance], which a model does without: anything that reads models reads it.
"""
from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from fdi.discovery.runs import Source
from fdi.estimation.fit import Value
from fdi.estimation.likelihood import limit_friction_values
from plant.effects import CATALOGUE
from plant.errors import InputError
from plant.model import Model, parse_model
from plant.parameters import read_toml

By = Mapping[str, float]  # a number for each signal, SI


class Row(NamedTuple):
    """RMS error once an effect was in the model, or out again; None is the model as it was at first."""

    effect: str | None
    error: By
    holdout: By
    removed: bool = False

    def to_json(self) -> dict[str, Any]:
        """The row as JSON values (docs/json.md)."""
        row: dict[str, Any] = {"effect": self.effect, "error": dict(self.error), "holdout": dict(self.holdout)}
        return row | {"removed": True} if self.removed else row


@dataclass(frozen=True)
class Provenance:
    """Where a model file comes from."""

    software: str = ""
    history: tuple[str, ...] = ()  # commands, the latest last
    effects: tuple[str, ...] = ()  # in the order in which they were added
    effect_files: tuple[str, ...] = ()  # those of the user
    signals: tuple[str, ...] = ()
    trace: Source | None = None
    repeats: tuple[Source, ...] = ()
    holdout: Source | None = None
    floor: Mapping[str, float] | None = None
    before: Mapping[str, float] | None = None  # parameters that the fits changed, as they were
    ledger: tuple[Row, ...] = ()
    identification: Mapping[str, str | list[str]] | None = None  # of the nominal values, by rig identify

    def same_data(self, sources: Sequence[Source], repeats: int, signals: Sequence[str]) -> bool:
        """Whether the ledger goes on: the same runs, told by their content, and the same signals."""
        own = [s.sha256 for s in (self.trace, *self.repeats, self.holdout) if s]
        return own == [s.sha256 for s in sources] and len(self.repeats) == repeats and self.signals == tuple(signals)


def read_provenance(path: Path) -> Provenance:
    """The table [provenance] of a model file; an empty one of a file without.

    Raises:
        InputError: a table that this software did not write.
    """
    said = read_toml(path).get("provenance", {})
    try:
        runs = [Source(*pair) for pair in zip(said.get("repeats", []), said.get("repeats_sha256", []), strict=True)]
        rows = [Row(r.get("effect"), r["error"], r.get("holdout", {}), r.get("removed", False))
                for r in said.get("ledger", [])]
        history, effects, files, signals = (tuple(said.get(name, ())) for name in
                                            ("history", "effects", "effect_files", "signals"))
        trace, holdout = _read_source(said, "trace"), _read_source(said, "holdout")
        return Provenance(said.get("software", ""), history, effects, files, signals, trace, tuple(runs), holdout,
                          said.get("floor"), said.get("before"), tuple(rows), said.get("identification"))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(path, "provenance", f"what rig add writes there ({error})") from error


def _read_source(said: Mapping[str, Any], name: str) -> Source | None:
    return Source(said[name], said[f"{name}_sha256"]) if name in said else None


def load_model_file(path: Path) -> tuple[Model, Provenance]:
    """A model file with its provenance.

    Raises:
        InputError: a file that cannot be used, or a user's effect in it that nothing has loaded.
    """
    found = read_provenance(path)
    tables = read_toml(path)
    named = tables.get("effects", [])
    gone = [e for e in named if e not in CATALOGUE.list_all()] if isinstance(named, list) else []
    if gone and found.effect_files:
        files = " ".join(f"--effects {file}" for file in found.effect_files)
        raise InputError(path, "effects", f"{files} with it, where {gone[0]} is defined")
    return parse_model(tables, path, path.stem), found


def remove_all_effects(model: Model, p: Provenance) -> Model:
    """The model as it was before any effect was added, tolerances included."""
    added = [CATALOGUE[name] for name in p.effects]
    theirs = {name for e in added if not e.base for name in e.off}
    values = {name: value for name, value in {**model.values, **(p.before or {})}.items() if name not in theirs}
    return replace(model, values=values, effects=tuple(e for e in model.effects if e not in p.effects))


def remove_effect(model: Model, p: Provenance, name: str) -> tuple[Model, Provenance]:
    """The model and its provenance with an effect taken out; all else keeps its value.

    Raises:
        InputError: it has no such effect.
    """
    entry = CATALOGUE[name]
    if not entry.base and name in model.effects:
        values = {n: v for n, v in model.values.items() if n not in entry.off}
        found = replace(model, values=values, effects=tuple(e for e in model.effects if e != name))
    elif entry.base and (name in p.effects or any(model[n] != model.nominal[n] for n in entry.fitted)):
        usual = {n: (p.before or {}).get(n, model.nominal[n]) for n in entry.fitted}
        found = replace(model, values=limit_friction_values({**model.values, **usual}))
    else:
        has = [*dict.fromkeys([*p.effects, *model.effects])]
        raise InputError("effect", name, f"one that the model has ({', '.join(has) or 'it has none'})")
    return found, replace(p, effects=tuple(e for e in p.effects if e != name))


def format_model_file(model: Model, intervals: Mapping[str, Value], p: Provenance) -> str:
    """The model file's text, 95 % intervals beside what was fitted."""
    return "\n".join([*_with_intervals(model.to_toml().splitlines(), intervals), "", *_format_provenance(p)]) + "\n"


def _with_intervals(lines: Iterable[str], intervals: Mapping[str, Value]) -> Iterable[str]:
    group = ""
    for line in lines:
        if line.startswith("["):
            group = line.strip("[]").removeprefix("design.")
        found = intervals.get(f"{group}.{line.partition(' = ')[0]}")
        if found:
            mark = "," if "#" in line else "  #"
            line += f"{mark} {found.low:.6g} .. {found.high:.6g} (95 %)"
        yield line


def _format_provenance(p: Provenance) -> list[str]:
    """The lines of [provenance]."""
    lines = ["[provenance]", f"software = {_quote_text(p.software)}", f"history = {_format_list(p.history)}",
             f"effects = {_format_list(p.effects)}"]
    lines += [f"effect_files = {_format_list(p.effect_files)}"] if p.effect_files else []
    lines += [f"signals = {_format_list(p.signals)}"] if p.signals else []
    for name, run in (("trace", p.trace), ("holdout", p.holdout)):
        lines += [f"{name} = {_quote_text(run.file)}", f"{name}_sha256 = {_quote_text(run.sha256)}"] if run else []
    lines += [f"repeats = {_format_list(r.file for r in p.repeats)}",
              f"repeats_sha256 = {_format_list(r.sha256 for r in p.repeats)}"] if p.repeats else []
    lines += [f"floor = {_format_inline_table(p.floor)}"] if p.floor else []
    if p.before:
        lines += ["", "[provenance.before]", *(f"{_quote_text(name)} = {value!r}" for name, value in p.before.items())]
    if p.identification:
        lines += ["", "[provenance.identification]"]
        lines += [f"{name} = {_quote_text(x) if isinstance(x, str) else _format_list(x)}"
                  for name, x in p.identification.items()]
    for row in p.ledger:
        lines += ["", "[[provenance.ledger]]", *([f"effect = {_quote_text(row.effect)}"] if row.effect else []),
                  *(["removed = true"] if row.removed else []), f"error = {_format_inline_table(row.error)}",
                  *([f"holdout = {_format_inline_table(row.holdout)}"] if row.holdout else [])]
    return lines


def _quote_text(word: str) -> str:
    return json.dumps(word, ensure_ascii=False).replace("\x7f", "\\u007f")  # a JSON text is TOML but for this


def _format_list(words: Iterable[str]) -> str:
    return "[" + ", ".join(map(_quote_text, words)) + "]"


def _format_inline_table(numbers: Mapping[str, float]) -> str:
    return "{ " + ", ".join(f"{name} = {float(f'{x:.6g}')!r}" for name, x in numbers.items()) + " }"
