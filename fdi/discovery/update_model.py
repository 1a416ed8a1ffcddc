"""A model file kept up to date: an effect added or removed, everything fitted again, the ledger continued."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.discovery.explain import find_marks, measure_gain
from fdi.discovery.explain_runs import Suspicious, lean_model, list_fitted_parameters, list_suspicious, prepare_effects
from fdi.discovery.runs import Runs, Source, read_runs, read_source
from fdi.discovery.search import Hypothesis, Prospect, Search, choose_search_excerpt, scan_effects
from fdi.estimation import (
    UNREPLAYED,
    Fit,
    Value,
    can_be_cut,
    continue_fit,
    cut_excerpt,
    finish_fit,
    limit_friction_values,
    linearise,
    list_active_effects,
    list_all_unknowns,
    list_effect_unknowns,
    place_in_healthy_unit,
)
from fdi.output import replace_text
from fdi.progress import Progress, Stage, ignore_progress
from fdi.sources import name_software
from fdi.thresholds import EFFECT_INTERVAL_FACTOR, GAIN_SEEN, INTERVAL_95_SD, WHITE_SQUARE_POOR
from fdi.trace import Trace
from plant import (
    InputError,
    Model,
    find_effect,
    find_plant,
    find_quantity,
    list_plants,
    parse_model,
    quote_text,
    read_model_tables,
    require,
)
from plant.effects import CATALOGUE

FIRST, THEN = 4, 6  # rounds of a first fit, along the parameters and along principal directions
LAST_FIT_ROUNDS, EARLIER_FIT_ROUNDS = 8, 2  # of the last fit, and of those before it in the ledger
LAST_FIT_STEPS = 50  # a cycle, of the last fits' residuals; their slopes make do with those of the first


@dataclass(frozen=True, eq=False)
class Step:
    """The model after one more effect, with its RMS error on the held-out run, by signal, SI."""

    effect: str | None
    hypothesis: Hypothesis
    holdout: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Refit:
    """A model with all its effects fitted together, and how it came about."""

    original: Model  # before any effect, tolerances at their centres
    steps: tuple[Step, ...]  # the original's own, then one for each effect
    marks: Mapping[str, tuple[float, float, float]]  # parameters read off without noise: value, low, high
    floor: Mapping[str, float]
    search: Search
    excerpt: str = ""  # which part of a long recording was fitted

    @property
    def last(self) -> Step:
        """With all effects."""
        return self.steps[-1]

    @property
    def helps(self) -> bool:
        """Whether the effect that came last takes away more than noise."""
        if len(self.steps) < 2:
            return True
        before, after = self.steps[-2:]
        if self.original.find_effect(str(after.effect)).port in UNREPLAYED:
            return True  # it was found without noise, or it would not be here
        is_worse = any(x > 1.02 * before.holdout[s] for s, x in after.holdout.items() if x > 1.15 * self.floor[s])
        is_lower = any(x < before.hypothesis.errors[s] for s, x in after.hypothesis.errors.items())
        return measure_gain(before.hypothesis, after.hypothesis) > GAIN_SEEN and is_lower and not is_worse


def refit_effects(original: Model, effects: Sequence[str], est: Trace, repeats: Sequence[Trace] = (),
                  holdout: Trace | None = None, progress: Progress = ignore_progress,
                  begin: Mapping[str, float] | None = None, done: int = 0) -> Refit:
    """Add effects to a model in this order.

    Args:
        original: the model without them.
        effects: names of the catalogue.
        est: the run to fit.
        repeats: further runs of its command, which tell noise from physics and are fitted as well.
        holdout: a run that no fit sees.
        progress: called with each stage and the share done, 0 to 1.
        begin: parameters of an earlier fit with the first `done` effects: these come in together, from there.
        done: how many.

    Raises:
        InputError: an effect that cannot be added to this model or be fitted to these runs.
    """
    check_addable(original, effects)
    marks = _read_marks(original, effects, [est, *repeats])
    replay_effects = [e for e in effects if original.find_effect(e).port not in UNREPLAYED]
    first = [e for e in effects[:done] if e in replay_effects]
    whole, description = list[Trace](), ""
    if can_be_cut(est, original):
        whole = [est, *repeats]
        excerpt = choose_search_excerpt(original, est, replay_effects, progress)
        description = excerpt.describe(est)
        est, *repeats = (cut_excerpt(run, excerpt) for run in whole)
    search = Search(original.replace({name: value for name, (value, *_) in marks.items()}), est, repeats,
                    replay_effects, holdout=holdout, whole=whole)
    model = lean_model(search.model, replay_effects)
    search.problem = replace(search.problem, model=model, workers=search.workers)
    search.repeats = [replace(p, model=model) for p in search.repeats]
    progress("fitting the model as it is", 0.05)
    chain = [search.judge_fit(tuple(first), _start_fit(search, first, begin or {}))]
    for number, name in enumerate(replay_effects[len(first):]):
        progress(f"adding {name}", 0.15 + 0.35 * number / (len(replay_effects) - len(first)))
        chain.append(_add_effect(search, chain[-1], name))
    rounds = LAST_FIT_ROUNDS + EARLIER_FIT_ROUNDS * (len(chain) - 1)
    search.stage = Stage(progress, "last fits, with finer steps", 0.5, 0.95, rounds)
    chain = search.judge_on_all(_finish_chain(search, chain), LAST_FIT_STEPS)
    steps = _list_steps(search, effects, done, chain)
    return Refit(original, steps, marks, search.estimate_floor(chain[-1]), search, description)


def _finish_chain(search: Search, chain: Sequence[Hypothesis]) -> list[Hypothesis]:
    """All of them with the noise that the last one leaves, with the repeats and with finer steps."""
    search.learn_noise(chain[-1])
    search.match_noise(chain[-1])
    coarse = search.problem.steps
    search.refine_steps(LAST_FIT_STEPS, LAST_FIT_STEPS)
    search.leave_out_undecided(chain[-1])
    slopes = replace(search.problem, steps=coarse, _lanes={})
    last = finish_fit(search.problem, chain[-1].fit, LAST_FIT_ROUNDS, slopes, search.stage)
    if last.misfit > WHITE_SQUARE_POOR * np.count_nonzero(last.white):
        again = replace(last, x=place_in_healthy_unit(last.free, last.x))
        last = min(last, finish_fit(search.problem, again, LAST_FIT_ROUNDS, slopes, search.stage),
                   key=lambda fit: fit.cost)
    hypotheses = [search.judge_fit(chain[-1].effects, last)]
    if search.leave_out_missed_stop(hypotheses[0]):
        slopes = replace(search.problem, steps=coarse, _lanes={})
        last = finish_fit(search.problem, last, LAST_FIT_ROUNDS, slopes, search.stage)
        hypotheses = [search.judge_fit(chain[-1].effects, last)]
    for h in reversed(chain[:-1]):
        start = _choose_nearer_start(search, h.fit, hypotheses[0].fit)
        fit = finish_fit(search.problem, start, EARLIER_FIT_ROUNDS, slopes, search.stage)
        hypotheses.insert(0, search.judge_fit(h.effects, fit))
    return hypotheses


def _choose_nearer_start(search: Search, fit: Fit, other: Fit) -> Fit:
    """The fit, or where a fit with a further effect has left its tolerances, whichever is better.

    What the effect gains is then not what the fit without it had left lying about.
    """
    tolerances = dict(zip([f.name for f in other.free], other.x, strict=True))
    pairs = zip(fit.free, fit.x, strict=True)
    start = [tolerances.get(f.name, x) if np.isfinite(f.prior) else x for f, x in pairs]
    trials = np.array([fit.x, start])
    return replace(fit, x=trials[int(np.argmin(search.problem.compute_costs(fit.free, trials)))])


def _start_fit(search: Search, effects: Sequence[str], begin: Mapping[str, float]) -> Fit:
    """The model's own unknowns and those of `effects` fitted, from where they were left."""
    effect_free = [u for name in effects for u in list_effect_unknowns(search.model.find_effect(name), search.model)]
    names = {u.name for u in effect_free}
    free = (*(f for f in list_all_unknowns(search.model) if f.name not in names), *effect_free)
    x = np.array([(begin.get(f.name, f.centre) - f.centre) / f.scale for f in free])
    return continue_fit(search.problem, linearise(search.problem, free, x), FIRST)


def check_addable(model: Model, effects: Sequence[str]) -> None:
    """Refuse effects that cannot all join a model.

    Raises:
        InputError: one is in it already, excludes another, or nobody can fit it.
    """
    present = list(list_active_effects(model))
    for name in effects:
        require(name in [e.name for e in model.kind.list_effects()], "effect", name,
                f"an effect that the plant {model.plant} can have")
        entry = model.find_effect(name)
        require(name not in present, "effect", name,
                f"one that is not in the model already (rig remove {name} takes it out)")
        require(entry.fitted, "effect", name, "an effect with parameters to fit; this is noise of the bench")
        for other in present:
            require(name not in model.find_effect(other).excludes and other not in entry.excludes, "effect", name,
                    f"{name} or {other} in a model, not both")
        present.append(name)


def _add_effect(search: Search, before: Hypothesis, name: str) -> Hypothesis:
    """The best fit with one more effect, from the starts that a scan finds; all else is free as well.

    If these do not reach the floor, from the effect's own sizes too: a scan believes what a bad fit tells it.
    """
    fit = before.fit
    healthy = linearise(search.problem, fit.free, place_in_healthy_unit(fit.free, fit.x))
    prospects = [each for start in (fit, healthy) for each in scan_effects(search.problem, [start], [name])]
    best = search.judge_fit((*before.effects, name), _fit_best(search, _begin_fits(search, prospects)))
    if best.is_at_floor:
        return best
    free, sizes = best.fit.free, search.model.find_effect(name).starts
    x = np.array([[(size[f.name] - f.centre) / f.scale if f.name in size else float(v)
                   for f, v in zip(free, place_in_healthy_unit(free, best.fit.x), strict=True)]
                  for size in sizes])
    other = _fit_best(search, [linearise(search.problem, free, row) for row in x])
    return search.judge_fit(best.effects, other) if other.cost < best.cost else best


def _fit_best(search: Search, starts: Sequence[Fit]) -> Fit:
    """The best of some fits, taken on side by side."""
    alone = replace(search.problem, workers=1, _lanes={})
    fits = search.map_parallel(lambda fit: finish_fit(alone, continue_fit(alone, fit, FIRST), THEN), starts)
    return min(fits, key=lambda fit: fit.cost)


def _begin_fits(search: Search, prospects: Sequence[Prospect]) -> list[Fit]:
    """Where a scan points to, and the effects of these sizes in a healthy unit.

    A fit that had to do without a large effect has put it into the tolerances: that may be a wrong basin.
    """
    starts = [x for p in prospects for x in (p.x, place_in_healthy_unit(p.free, p.x))]
    fits = [linearise(search.problem, prospects[0].free, x) for x in starts]
    return sorted(fits, key=lambda f: f.cost)[:2]


def _read_marks(model: Model, effects: Sequence[str], traces: Sequence[Trace]) -> dict[str, tuple[float, float, float]]:
    """Parameters of effects that a replay does not show: they are read off the firmware's answers and the positions."""
    parameters: dict[str, tuple[float, float, float]] = {}
    for name in effects:
        port = model.find_effect(name).port
        if port not in UNREPLAYED:
            continue
        marks, drive = find_marks(model, traces), model.kind.signals.drive.symbol
        prints = [p for p in (*marks.prints, *marks.rivals) if p.effect == name]
        if not prints:
            where = "steps in the measured positions" if port == "reading" else \
                f"a difference between {drive} and the model's firmware that it explains"
            raise InputError("effect", name, f"{where}; this trace has none")
        parameters |= prints[0].parameters
    return parameters


def _list_steps(search: Search, effects: Sequence[str], done: int, chain: Sequence[Hypothesis]) -> tuple[Step, ...]:
    """One for the start and one for each effect; one that a replay does not show leaves its errors as they are."""
    holdout = search.measure_holdout(chain)
    steps, at = [Step(effects[done - 1] if done else None, chain[0], holdout[0])], 0
    for name in effects[done:]:
        at += search.model.find_effect(name).port not in UNREPLAYED
        steps.append(Step(name, chain[at], holdout[at]))
    return tuple(steps)


def list_fitted_values(r: Refit) -> dict[str, float]:
    """What was fitted, "group.field" to SI value, to six digits."""
    values = {name: float(f"{v:.6g}") for name, v in r.last.hypothesis.fit.values.items()}
    return limit_friction_values(values | {name: float(f"{v[0]:.6g}") for name, v in r.marks.items()})


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
        return self.provenance.floor or {}

    def compute_intervals(self) -> dict[str, Value]:
        """95 % intervals of everything that was fitted, SI."""
        if self.refit is None:
            return {}
        fit = self.refit.last.hypothesis.fit
        halves = {f.name: INTERVAL_95_SD * EFFECT_INTERVAL_FACTOR * fit.spread(f.name) for f in fit.free}
        values = limit_friction_values(fit.values)
        intervals = {name: Value(v, v - halves[name], v + halves[name], "") for name, v in values.items()}
        return intervals | dict(self.parameters)


def find_runs(model: Model, provenance: Provenance, trace: str | None = None, repeats: Sequence[str] = (),
              holdout: str | None = None, signals: Sequence[str] | None = None) -> Runs:
    """The runs to fit: those named, or the ones that the model file was fitted to.

    A trace with the same content as that of the model file brings the file's repeats and held-out run along.

    Args:
        model: the model with its effects; the runs get the model before any effect was added.
        provenance: where the model comes from.
        trace: the measured run; None for that of the model file.
        repeats: runs of the same command.
        holdout: a run of another command, which no fit sees.
        signals: what to fit; None for what the trace has.

    Raises:
        InputError: runs that cannot be used, or none at all.
    """
    original = remove_all_effects(model, provenance)
    if provenance.trace is None or (trace is not None and read_source(trace).sha256 != provenance.trace.sha256):
        if trace is None:
            raise InputError("TRACE", "", "the measured run to fit (rig add EFFECT TRACE)")
        return read_runs(original, trace, repeats, holdout, signals)
    holdout_file = provenance.holdout.file if provenance.holdout else None
    return read_runs(original, trace or provenance.trace.file, repeats or [r.file for r in provenance.repeats],
                     holdout or holdout_file, signals or provenance.signals or None)


def add_effects(effects: Sequence[str], runs: Runs, model: Model, provenance: Provenance, command: str = "",
                progress: Progress = ignore_progress) -> ModelUpdate:
    """Add effects to a model, in this order, and fit everything again.

    Args:
        effects: names of the catalogue.
        runs: from `find_runs`.
        model: the model with the effects that it has already.
        provenance: where it comes from.
        command: what the user typed, for the history of the model file.
        progress: called with the stage and the share done.

    Raises:
        InputError: an effect that cannot be added to this model or be fitted to these runs.
    """
    for name in effects:
        find_effect(name, runs.model.plant)
    all_effects = [*provenance.effects, *effects]
    check_addable(runs.model, all_effects)
    prepare_effects(runs, all_effects, progress)
    continues = _continues_ledger(provenance, runs)
    done = len(provenance.effects) if continues else 0
    r = refit_effects(runs.model, all_effects, runs.est, runs.repeats, runs.holdout, progress, model.values, done)
    rows = [Row(s.effect, s.hypothesis.errors, s.holdout) for s in r.steps]
    old_rows = list(provenance.ledger) if continues else []
    notes = (*dict.fromkeys([*runs.notes, *r.search.problem.trace.notes]), *([r.excerpt] if r.excerpt else []))
    if provenance.ledger and not continues:
        notes = (*notes, "these are other runs than those of the ledger: it begins again")
    return _make_update(r, runs, provenance, all_effects, [*old_rows, *rows[bool(old_rows):]], notes, command,
                        added=tuple(effects))


def remove_effect_and_refit(name: str, runs: Runs | None, model: Model, provenance: Provenance, command: str = "",
                  progress: Progress = ignore_progress) -> ModelUpdate:
    """Remove an effect from a model; fit the rest again if runs are given, else keep all other values.

    Raises:
        InputError: the model has no such effect.
    """
    model_without, provenance_without = remove_effect(model, provenance, name)
    if runs is None:
        note = f"the other parameters keep the values fitted with {name}; give a TRACE to fit them again"
        return ModelUpdate(model_without, provenance_without, (), name, None, {}, (), (note,))
    prepare_effects(runs, provenance.effects, progress)
    rows = list(provenance.ledger) if _continues_ledger(provenance, runs) else []
    if not rows:
        before = refit_effects(runs.model, provenance.effects, runs.est, runs.repeats, runs.holdout, progress,
                               model.values, len(provenance.effects)).last
        rows = [Row(before.effect, before.hypothesis.errors, before.holdout)]
    start = runs.model if name in provenance.effects else remove_effect(runs.model, provenance, name)[0]
    effects = provenance_without.effects
    r = refit_effects(start, effects, runs.est, runs.repeats, runs.holdout, progress, model.values, len(effects))
    rows.append(Row(name, r.last.hypothesis.errors, r.last.holdout, True))
    return _make_update(r, runs, provenance_without, effects, rows, runs.notes, command, removed=name)


def _continues_ledger(provenance: Provenance, runs: Runs) -> bool:
    """Whether the ledger goes on: the same runs, told by their content, and the same signals."""
    hashes = [s.sha256 for s in (provenance.trace, *provenance.repeats, provenance.holdout) if s]
    return (bool(provenance.ledger) and hashes == [s.sha256 for s in runs.sources]
            and len(provenance.repeats) == len(runs.repeats) and provenance.signals == tuple(runs.est.outputs))


def _make_update(r: Refit, runs: Runs, provenance: Provenance, effects: Sequence[str], rows: Sequence[Row],
                 notes: tuple[str, ...], command: str, added: tuple[str, ...] = (), removed: str = "") -> ModelUpdate:
    model, fit = r.original.replace(list_fitted_values(r), "fit"), r.last.hypothesis.fit
    parameters = {name: v for e in effects for name, v in list_fitted_parameters(e, fit, runs.model).items()}
    parameters |= {name: Value(*of, find_quantity(name, plant=model.plant).unit) for name, of in r.marks.items()}
    before = {name: runs.model[name] for name in fit.values if name in runs.model.values}
    old_floor = provenance.floor or {}
    floor = dict(r.floor)
    if len(rows) > len(r.steps):  # a model that lacks an effect overestimates the noise: the lowest floor is the noise
        floor = {s: min(x, old_floor.get(s, x)) for s, x in r.floor.items()}
    new_provenance = replace(
        provenance, software=name_software(), history=(*provenance.history, *([command] if command else [])),
        effects=tuple(effects), signals=runs.est.outputs, trace=runs.sources[0],
        repeats=runs.sources[1:1 + len(runs.repeats)],
        holdout=runs.sources[-1] if runs.holdout is not None else None, floor=floor,
        before={**(provenance.before or {}), **before}, ledger=tuple(rows))
    return ModelUpdate(model, new_provenance, added, removed, r, parameters, list_suspicious(fit, model.plant), notes)


def write_model_file(update: ModelUpdate, path: str | Path) -> Path | None:
    """Write the model file of an update; return where the file that was there before is now, None if there was none.

    Raises:
        InputError: a file that cannot be written.
    """
    return replace_text(path, format_model_file(update.model, update.compute_intervals(), update.provenance))


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


def read_provenance(path: Path) -> Provenance:
    """The table [provenance] of a model file; an empty one of a file without.

    Raises:
        InputError: a table that this software did not write.
    """
    table = read_model_tables(path).get("provenance", {})
    try:
        runs = [Source(*pair) for pair in zip(table.get("repeats", []), table.get("repeats_sha256", []), strict=True)]
        rows = [Row(r.get("effect"), r["error"], r.get("holdout", {}), r.get("removed", False))
                for r in table.get("ledger", [])]
        history, effects, files, signals = (tuple(table.get(name, ())) for name in
                                            ("history", "effects", "effect_files", "signals"))
        trace, holdout = _read_source(table, "trace"), _read_source(table, "holdout")
        return Provenance(table.get("software", ""), history, effects, files, signals, trace, tuple(runs), holdout,
                          table.get("floor"), table.get("before"), tuple(rows), table.get("identification"))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(path, "provenance", f"what rig add writes there ({error})") from error


def _read_source(table: Mapping[str, Any], name: str) -> Source | None:
    return Source(table[name], table[f"{name}_sha256"]) if name in table else None


def load_model_file(path: Path) -> tuple[Model, Provenance]:
    """A model file with its provenance.

    Raises:
        InputError: a file that cannot be used, or a user's effect in it that nothing has loaded.
    """
    provenance = read_provenance(path)
    tables = read_model_tables(path)
    names = tables.get("effects", [])
    plant = tables.get("plant", "eha")
    plant_effects = find_plant(plant).effects if plant in list_plants() else CATALOGUE.of_plants
    unknown_names = ([e for e in names if e not in CATALOGUE.list_all() and e not in plant_effects]
                     if isinstance(names, list) else [])
    if unknown_names and provenance.effect_files:
        files = " ".join(f"--effects {file}" for file in provenance.effect_files)
        raise InputError(path, "effects", f"{files} with it, where {unknown_names[0]} is defined")
    return parse_model(tables, path, path.stem), provenance


def remove_all_effects(model: Model, p: Provenance) -> Model:
    """The model as it was before any effect was added, tolerances included."""
    parameters = {name for e in map(model.find_effect, p.effects) if not e.base for name in e.off}
    values = {name: value for name, value in {**model.values, **(p.before or {})}.items() if name not in parameters}
    return replace(model, values=values, effects=tuple(e for e in model.effects if e not in p.effects))


def remove_effect(model: Model, p: Provenance, name: str) -> tuple[Model, Provenance]:
    """The model and its provenance with an effect taken out; all else keeps its value.

    Raises:
        InputError: it has no such effect.
    """
    entry = model.find_effect(name)
    if not entry.base and name in model.effects:
        values = {n: v for n, v in model.values.items() if n not in entry.off}
        model_without = replace(model, values=values, effects=tuple(e for e in model.effects if e != name))
    elif entry.base and (name in p.effects or any(model[n] != model.nominal[n] for n in entry.fitted)):
        usual = {n: (p.before or {}).get(n, model.nominal[n]) for n in entry.fitted}
        model_without = replace(model, values=limit_friction_values({**model.values, **usual}))
    else:
        names = ", ".join(dict.fromkeys([*p.effects, *model.effects])) or "it has none"
        raise InputError("effect", name, f"one that the model has ({names})")
    return model_without, replace(p, effects=tuple(e for e in p.effects if e != name))


def format_model_file(model: Model, intervals: Mapping[str, Value], p: Provenance,
                      remarks: Mapping[str, str] | None = None) -> str:
    """The model file's text, 95 % intervals beside what was fitted, and further remarks beside other parameters."""
    interval_remarks = {name: f"{v.low:.6g} .. {v.high:.6g} (95 %)" for name, v in intervals.items()}
    return "\n".join([model.to_toml({**interval_remarks, **(remarks or {})}), *_format_provenance(p)]) + "\n"


def _format_provenance(p: Provenance) -> list[str]:
    """The lines of [provenance]."""
    runs = {"trace": p.trace, "holdout": p.holdout}
    entries = {"software": p.software, "history": p.history, "effects": p.effects}
    more = {"effect_files": p.effect_files, "signals": p.signals,
            **{name + end: value for name, run in runs.items() if run
               for end, value in (("", run.file), ("_sha256", run.sha256))},
            "repeats": [r.file for r in p.repeats], "repeats_sha256": [r.sha256 for r in p.repeats], "floor": p.floor}
    lines = ["[provenance]", *_format_values(entries | {name: value for name, value in more.items() if value})]
    if p.before:
        lines += ["", "[provenance.before]", *(f"{quote_text(name)} = {value!r}" for name, value in p.before.items())]
    if p.identification:
        lines += ["", "[provenance.identification]", *_format_values(p.identification)]
    for row in p.ledger:
        fields = {"effect": row.effect, "removed": row.removed, "error": row.error, "holdout": row.holdout}
        lines += ["", "[[provenance.ledger]]",
                  *_format_values({name: value for name, value in fields.items() if value or name == "error"})]
    return lines


def _format_values(values: Mapping[str, Any]) -> list[str]:
    """Lines of TOML of a truth, texts, lists of texts, and tables of numbers."""
    return [f"{name} = {_format_value(value)}" for name, value in values.items()]


def _format_value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{name} = {float(f'{x:.6g}')!r}" for name, x in value.items()) + " }"
    if isinstance(value, str):
        return quote_text(value)
    return "true" if value is True else "[" + ", ".join(map(quote_text, value)) + "]"
