"""A model file brought up to date: an effect put in or taken out, all of it fitted anew, the ledger continued."""
from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from fdi.discovery import model_file
from fdi.discovery.candidates import NORMAL, ROUGH, Suspicious, Value, fitted_parameters, list_suspicious
from fdi.discovery.model_file import Provenance, Row
from fdi.discovery.refit import Refit, fitted_model, refit_effects
from fdi.discovery.runs import Runs
from fdi.estimation.unknowns import limit_friction_values
from fdi.output import write_text
from fdi.progress import Progress
from fdi.sources import software
from plant import InputError, Model
from plant.model import meaning, offered
from rig.cli import discovery_options

SUFFIXES = (".csv", ".csv.gz", ".mcap")


class Done(NamedTuple):
    """What came of it."""

    model: Model
    provenance: Provenance
    refit: Refit | None  # None: nothing was fitted
    effects: Mapping[str, Value]  # parameters of the effects, with their intervals
    doubts: Sequence[Suspicious]
    notes: tuple[str, ...]

    def using(self, effect_files: tuple[str, ...]) -> Done:
        """The same, with the user's files that its effects are from."""
        return self._replace(provenance=replace(self.provenance, effect_files=effect_files))


def split(words: Sequence[str], trace: str | None, plant: str) -> tuple[list[str], str | None]:
    """Effects of a plant, and the trace, among the words of a command.

    Raises:
        InputError: neither an effect nor a trace; the nearest effect is offered.
    """
    effects, known = [], [e.name for e in offered(plant)]
    for word in words:
        if word in known:
            effects.append(word)
        elif trace is None and (word.endswith(SUFFIXES) or Path(word).exists()):
            trace = word
        else:
            near = get_close_matches(word, known, 1, 0.5)
            hint = f"; did you mean {near[0]}?" if near else " (rig effects lists them)"
            raise InputError("effect", word, f"an effect of the catalogue{hint}")
    if not effects:
        raise InputError("effect", "", "at least one effect (rig effects lists them)")
    return effects, trace


def target(args: argparse.Namespace, trace: str) -> Path:
    """The model file to write: --out, else the one that was read, else model.toml."""
    own = args.model if args.model and Path(args.model).is_file() else "model.toml"
    path = discovery_options.place(args.out or own, (".toml",), trace)
    assert path is not None
    return path


def runs_of(args: argparse.Namespace, trace: str | None, model: Model, known: Provenance) -> Runs:
    """The runs that were named; beside the model file's own trace, or where none was named, that file's runs.

    Raises:
        InputError: runs that cannot be used, or none at all.
    """
    from fdi.discovery.runs import read_runs, read_source

    signals = discovery_options.signals_of(args)
    if known.trace is None or (trace is not None and read_source(trace).sha256 != known.trace.sha256):
        if trace is None:
            raise InputError("TRACE", "", "the measured run to fit (rig add EFFECT TRACE)")
        return read_runs(model, trace, args.repeat, args.holdout, signals)
    held = args.holdout or (known.holdout.file if known.holdout else None)
    return read_runs(model, trace or known.trace.file, args.repeat or [r.file for r in known.repeats], held,
                signals or known.signals or None)


def added(new: Sequence[str], runs: Runs, model: Model, known: Provenance,
          progress: Progress) -> Done:
    """The model with `new` effects as well. `runs.model` is the model before any effect was added."""
    goes_on = bool(known.ledger) and known.same_data(runs.sources, len(runs.repeats), runs.est.outputs)
    done = len(known.effects) if goes_on else 0
    r = refit_effects(runs.model, [*known.effects, *new], runs.est, runs.repeats, runs.holdout, progress, model.values,
                      done)
    rows = [Row(s.effect, s.error, s.holdout) for s in r.steps]
    kept = list(known.ledger) if goes_on else []
    note = ("other runs than those of the ledger: it begins anew",) if known.ledger and not goes_on else ()
    return _finished(r, runs, known, [*known.effects, *new], [*kept, *rows[bool(kept):]], (*runs.notes, *note))


def removed(name: str, runs: Runs | None, model: Model, known: Provenance,
            progress: Progress) -> Done:
    """The model without an effect: refitted where runs are given, else all other values as they are."""
    left, less = model_file.remove_effect(model, known, name)
    if runs is None:
        note = f"the other parameters are as they were fitted with {name}; give a TRACE to fit them anew"
        return Done(left, less, None, {}, (), (note,))
    kept = list(known.ledger)
    if not (kept and known.same_data(runs.sources, len(runs.repeats), runs.est.outputs)):
        whole = refit_effects(runs.model, known.effects, runs.est, runs.repeats, runs.holdout, progress, model.values,
                      len(known.effects)).last
        kept = [Row(whole.effect, whole.error, whole.holdout)]
    start = model_file.remove_effect(runs.model, known, name)[0] if name not in known.effects else runs.model
    r = refit_effects(start, less.effects, runs.est, runs.repeats, runs.holdout, progress, model.values,
                      len(less.effects))
    rows = [*kept, Row(name, r.last.error, r.last.holdout, True)]
    return _finished(r, runs, less, less.effects, rows, runs.notes)


def _finished(r: Refit, runs: Runs, known: Provenance, effects: Sequence[str], rows: Sequence[Row],
              notes: tuple[str, ...]) -> Done:
    model, fit = fitted_model(r), r.last.hypothesis.fit
    values = {name: v for e in effects for name, v in fitted_parameters(e, fit, runs.model).items()}
    values |= {name: Value(*of, meaning(name, plant=model.plant).unit) for name, of in r.marks.items()}
    before = {name: runs.model[name] for name in fit.values if name in runs.model.values}
    held = runs.sources[-1] if runs.holdout is not None else None
    before_it = known.floor or {}  # a model that lacks something makes noise look larger: the least is the noise
    floor = {s: min(x, before_it.get(s, x)) if len(rows) > len(r.steps) else x for s, x in r.floor.items()}
    provenance = replace(
        known, software=software(), history=(*known.history, discovery_options.typed()), effects=tuple(effects),
        signals=runs.est.outputs, trace=runs.sources[0], repeats=runs.sources[1:1 + len(runs.repeats)], holdout=held,
        floor=floor, before={**(known.before or {}), **before}, ledger=tuple(rows))
    return Done(model, provenance, r, values, list_suspicious(fit, model.plant), notes)


def write(path: Path, done: Done, page: Path | None, title: str, why: str) -> Path | None:
    """Write the model file, and the page; -> where the file that was there before is now, None if there was none."""
    text = model_file.format_model_file(done.model, _intervals(done), done.provenance)
    kept = None
    if path.exists() and path.read_bytes():
        kept = path.with_name(path.name + ".bak")
        write_text(kept, path.read_text(encoding="utf-8"))
    write_text(path, text)
    if page is not None and done.refit is not None:
        from fdi.report import explain_page

        write_text(page, explain_page.ledger(done.refit, done.provenance, done.effects, title, why, done.doubts,
                                            done.notes))
    return kept


def _intervals(done: Done) -> dict[str, Value]:
    """95 % intervals of all that was fitted."""
    if done.refit is None:
        return {}
    fit = done.refit.last.hypothesis.fit
    values = limit_friction_values(fit.values)
    halves = {f.name: NORMAL * ROUGH * fit.spread(f.name) for f in fit.free}
    return {name: Value(v, v - halves[name], v + halves[name], "") for name, v in values.items()} | dict(done.effects)


def to_json(path: Path, done: Done, page: Path | None) -> dict[str, object]:
    """`rig add --json`, `rig remove --json` (docs/json.md)."""
    r = done.refit
    return {"model": str(path), "ledger": [row.plain() for row in done.provenance.ledger],
            "floor": dict(done.provenance.floor or {}),
            "parameters": {name: v._asdict() for name, v in done.effects.items()},
            "effects": list(done.provenance.effects), "helps": r.helps if r else None,
            "suspicious": [s._asdict() for s in done.doubts], "report": str(page) if page and r else None}
