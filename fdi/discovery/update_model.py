"""A model file kept up to date: an effect added or removed, everything fitted again, the ledger continued."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fdi.discovery import model_file
from fdi.discovery.candidates import Suspicious, list_fitted_parameters, list_suspicious
from fdi.discovery.explain_runs import prepare_effects
from fdi.discovery.model_file import Provenance, Row
from fdi.discovery.refit import Refit, build_fitted_model, check_addable, refit_effects
from fdi.discovery.runs import Runs, read_runs, read_source
from fdi.estimation.fit import Value
from fdi.estimation.likelihood import limit_friction_values
from fdi.output import replace_text
from fdi.progress import Progress, ignore_progress
from fdi.sources import name_software
from fdi.thresholds import EFFECT_INTERVAL_FACTOR, INTERVAL_95_SD
from plant.errors import InputError
from plant.model import Model, find_effect, find_quantity


@dataclass(frozen=True, eq=False)
class ModelUpdate:
    """A model with an effect added or removed.

    `parameters` are those of its effects, with their 95 % intervals; `refit` is None where nothing was fitted.
    """

    model: Model
    provenance: Provenance
    added: tuple[str, ...]
    removed: str
    refit: Refit | None
    parameters: Mapping[str, Value]
    suspicious: Sequence[Suspicious]
    notes: tuple[str, ...]

    @property
    def helps(self) -> bool | None:
        """Whether the last effect removes more than noise; None where nothing was fitted."""
        return self.refit.helps if self.refit is not None else None

    @property
    def floor(self) -> Mapping[str, float]:
        """Noise floor of each signal, SI; empty where nothing was ever fitted."""
        if self.provenance.floor or self.refit is None:
            return self.provenance.floor or {}
        return self.refit.floor

    def compute_intervals(self) -> dict[str, Value]:
        """95 % intervals of everything that was fitted, SI."""
        if self.refit is None:
            return {}
        fit = self.refit.last.hypothesis.fit
        halves = {f.name: INTERVAL_95_SD * EFFECT_INTERVAL_FACTOR * fit.spread(f.name) for f in fit.free}
        values = limit_friction_values(fit.values)
        own = {name: Value(v, v - halves[name], v + halves[name], "") for name, v in values.items()}
        return own | dict(self.parameters)


def find_runs(model: Model, known: Provenance, trace: str | None = None, repeats: Sequence[str] = (),
              holdout: str | None = None, signals: Sequence[str] | None = None) -> Runs:
    """The runs to fit: those named, or the ones that the model file was fitted to.

    A trace with the same content as that of the model file brings the file's repeats and held-out run along.

    Args:
        model: the model with its effects; the runs get the model before any effect was added.
        known: where the model comes from.
        trace: the measured run; None for that of the model file.
        repeats: runs of the same command.
        holdout: a run of another command, which no fit sees.
        signals: what to fit; None for what the trace has.

    Raises:
        InputError: runs that cannot be used, or none at all.
    """
    original = model_file.remove_all_effects(model, known)
    if known.trace is None or (trace is not None and read_source(trace).sha256 != known.trace.sha256):
        if trace is None:
            raise InputError("TRACE", "", "the measured run to fit (rig add EFFECT TRACE)")
        return read_runs(original, trace, repeats, holdout, signals)
    known_holdout = known.holdout.file if known.holdout else None
    return read_runs(original, trace or known.trace.file, repeats or [r.file for r in known.repeats],
                     holdout or known_holdout, signals or known.signals or None)


def add_effects(effects: Sequence[str], runs: Runs, model: Model, known: Provenance, command: str = "",
                progress: Progress = ignore_progress) -> ModelUpdate:
    """Add effects to a model, in this order, and fit everything again.

    Args:
        effects: names of the catalogue.
        runs: from `find_runs`.
        model: the model with the effects that it has already.
        known: where it comes from.
        command: what the user typed, for the history of the model file.
        progress: called with the stage and the share done.

    Raises:
        InputError: an effect that cannot be added to this model or be fitted to these runs.
    """
    for name in effects:
        find_effect(name, runs.model.plant)
    every = [*known.effects, *effects]
    check_addable(runs.model, every)
    prepare_effects(runs, every, progress)
    continues = _continues_ledger(known, runs)
    done = len(known.effects) if continues else 0
    r = refit_effects(runs.model, every, runs.est, runs.repeats, runs.holdout, progress, model.values, done)
    rows = [Row(s.effect, s.error, s.holdout) for s in r.steps]
    kept = list(known.ledger) if continues else []
    notes = (*runs.notes, *([r.excerpt] if r.excerpt else []))
    if known.ledger and not continues:
        notes = (*notes, "these are other runs than those of the ledger: it begins again")
    return _make_update(r, runs, known, every, [*kept, *rows[bool(kept):]], notes, command, added=tuple(effects))


def remove_effect(name: str, runs: Runs | None, model: Model, known: Provenance, command: str = "",
                  progress: Progress = ignore_progress) -> ModelUpdate:
    """Remove an effect from a model; fit the rest again if runs are given, else keep all other values.

    Raises:
        InputError: the model has no such effect.
    """
    model_without, known_without = model_file.remove_effect(model, known, name)
    if runs is None:
        note = f"the other parameters keep the values fitted with {name}; give a TRACE to fit them again"
        return ModelUpdate(model_without, known_without, (), name, None, {}, (), (note,))
    prepare_effects(runs, known.effects, progress)
    rows = list(known.ledger) if _continues_ledger(known, runs) else []
    if not rows:
        before = refit_effects(runs.model, known.effects, runs.est, runs.repeats, runs.holdout, progress, model.values,
                               len(known.effects)).last
        rows = [Row(before.effect, before.error, before.holdout)]
    start = runs.model if name in known.effects else model_file.remove_effect(runs.model, known, name)[0]
    left = known_without.effects
    r = refit_effects(start, left, runs.est, runs.repeats, runs.holdout, progress, model.values, len(left))
    rows.append(Row(name, r.last.error, r.last.holdout, True))
    return _make_update(r, runs, known_without, left, rows, runs.notes, command, removed=name)


def _continues_ledger(known: Provenance, runs: Runs) -> bool:
    return bool(known.ledger) and known.same_data(runs.sources, len(runs.repeats), runs.est.outputs)


def _make_update(r: Refit, runs: Runs, known: Provenance, effects: Sequence[str], rows: Sequence[Row],
                 notes: tuple[str, ...], command: str, added: tuple[str, ...] = (), removed: str = "") -> ModelUpdate:
    model, fit = build_fitted_model(r), r.last.hypothesis.fit
    parameters = {name: v for e in effects for name, v in list_fitted_parameters(e, fit, runs.model).items()}
    parameters |= {name: Value(*of, find_quantity(name, plant=model.plant).unit) for name, of in r.marks.items()}
    before = {name: runs.model[name] for name in fit.values if name in runs.model.values}
    known_floor = known.floor or {}
    floor = dict(r.floor)
    if len(rows) > len(r.steps):  # a model that lacks an effect overestimates the noise: the lowest floor is the noise
        floor = {s: min(x, known_floor.get(s, x)) for s, x in r.floor.items()}
    provenance = replace(
        known, software=name_software(), history=(*known.history, *([command] if command else [])),
        effects=tuple(effects), signals=runs.est.outputs, trace=runs.sources[0],
        repeats=runs.sources[1:1 + len(runs.repeats)],
        holdout=runs.sources[-1] if runs.holdout is not None else None, floor=floor,
        before={**(known.before or {}), **before}, ledger=tuple(rows))
    return ModelUpdate(model, provenance, added, removed, r, parameters, list_suspicious(fit, model.plant), notes)


def write_model_file(update: ModelUpdate, path: str | Path) -> Path | None:
    """Write the model file of an update; return where the file that was there before is now, None if there was none.

    Raises:
        InputError: a file that cannot be written.
    """
    return replace_text(path, model_file.format_model_file(update.model, update.compute_intervals(), update.provenance))
