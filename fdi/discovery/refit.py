"""Effects put into a model one after the other: everything fitted anew each time, and the error after each step."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdi.discovery.explain import find_marks, measure_gain
from fdi.discovery.search import Hypothesis, Prospect, Search, choose_search_excerpt, scan_effects
from fdi.estimation.fit import Fit, continue_fit, linearise
from fdi.estimation.likelihood import limit_friction_values, place_in_healthy_unit
from fdi.estimation.long_recordings import can_be_cut, cut_excerpt
from fdi.estimation.unidentifiable import finish_fit
from fdi.estimation.unknowns import (
    UNREPLAYED,
    complete_model,
    list_active_effects,
    list_all_unknowns,
    list_effect_unknowns,
    silence_readings,
)
from fdi.progress import Progress, Stage, ignore_progress
from fdi.thresholds import GAIN_SEEN, WHITE_SQUARE_POOR
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE
from plant.errors import InputError
from plant.lanes import list_kernel_variants
from plant.model import Model, list_offered_effects

FIRST, THEN = 4, 6  # rounds of a first fit, along the parameters and along principal directions
LAST_FIT_ROUNDS, EARLIER_FIT_ROUNDS = 8, 2  # of the last fit, and of those before it in the ledger
LAST_FIT_STEPS = 50  # a cycle, of the last fits' residuals; their slopes make do with those of the first


@dataclass(frozen=True, eq=False)
class Step:
    """The model after one more effect: RMS error on the fit's run and on the held-out one, by signal, SI."""

    effect: str | None
    hypothesis: Hypothesis
    error: Mapping[str, float]
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
        name = str(after.effect)
        if CATALOGUE[name].port in UNREPLAYED:
            return True  # it was found without noise, or it would not be here
        worse = any(x > 1.02 * before.holdout[s] for s, x in after.holdout.items() if x > 1.15 * self.floor[s])
        return measure_gain(before.hypothesis, after.hypothesis) > GAIN_SEEN and not worse


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
    replayed = [e for e in effects if CATALOGUE[e].port not in UNREPLAYED]
    first = [e for e in effects[:done] if e in replayed]
    whole, said = list[Trace](), ""
    if can_be_cut(est, original):
        whole = [est, *repeats]
        excerpt = choose_search_excerpt(original, est, replayed, progress)
        said = excerpt.describe(est)
        est, *repeats = (cut_excerpt(run, excerpt) for run in whole)
    search = Search(original.replace({name: value for name, (value, *_) in marks.items()}), est, repeats, replayed,
                    holdout=holdout, whole=whole)
    model = lean_model(search.model, replayed)
    search.problem = replace(search.problem, model=model, workers=search.workers)
    search.repeats = [replace(p, model=model) for p in search.repeats]
    progress("fitting the model as it is", 0.05)
    chain = [search.judge_fit(tuple(first), _start_fit(search, first, begin or {}))]
    for number, name in enumerate(replayed[len(first):]):
        progress(f"adding {name}", 0.15 + 0.35 * number / (len(replayed) - len(first)))
        chain.append(_add_effect(search, chain[-1], name))
    rounds = LAST_FIT_ROUNDS + EARLIER_FIT_ROUNDS * (len(chain) - 1)
    search.stage = Stage(progress, "last fits, with finer steps", 0.5, 0.95, rounds)
    chain = search.judge_on_all(_finish_chain(search, chain), LAST_FIT_STEPS)
    steps = _list_steps(search, effects, done, chain)
    return Refit(original, steps, marks, search.estimate_floor(chain[-1]), search, said)


def _finish_chain(search: Search, chain: Sequence[Hypothesis]) -> list[Hypothesis]:
    """All of them with the noise that the last one leaves, with the repeats and with finer steps."""
    search.learn_noise(chain[-1])
    coarse = search.problem.steps
    search.refine_steps(LAST_FIT_STEPS, LAST_FIT_STEPS)
    slopes = replace(search.problem, steps=coarse, _lanes={})
    last = finish_fit(search.problem, chain[-1].fit, LAST_FIT_ROUNDS, slopes, search.stage)
    if last.misfit > WHITE_SQUARE_POOR * np.count_nonzero(last.white):
        again = replace(last, x=place_in_healthy_unit(last.free, last.x))
        last = min(last, finish_fit(search.problem, again, LAST_FIT_ROUNDS, slopes, search.stage),
                   key=lambda fit: fit.cost)
    done = [search.judge_fit(chain[-1].effects, last)]
    for h in reversed(chain[:-1]):
        begun = _choose_nearer_start(search, h.fit, done[0].fit)
        fit = finish_fit(search.problem, begun, EARLIER_FIT_ROUNDS, slopes, search.stage)
        done.insert(0, search.judge_fit(h.effects, fit))
    return done


def _choose_nearer_start(search: Search, fit: Fit, other: Fit) -> Fit:
    """The fit, or where a fit with a further effect has left its tolerances, whichever is better.

    What the effect gains is then not what the fit without it had left lying about.
    """
    there = dict(zip([f.name for f in other.free], other.x, strict=True))
    own = zip(fit.free, fit.x, strict=True)
    moved = np.array([there.get(f.name, x) if np.isfinite(f.prior) else x for f, x in own])
    trials = np.array([fit.x, moved])
    return replace(fit, x=trials[int(np.argmin(search.problem.compute_costs(fit.free, trials)))])


def lean_model(model: Model, effects: Sequence[str]) -> Model:
    """The whole catalogue where its quick kernels have these effects; else a model of its own, worth its compiling."""
    every, own = complete_model(model), silence_readings(model.with_effects(effects))
    quick = {e for rung in list_kernel_variants(every)[:-1] for e in rung.model.effects}
    return every if set(own.effects) <= quick else own


def _start_fit(search: Search, effects: Sequence[str], begin: Mapping[str, float]) -> Fit:
    """The model's own unknowns and those of `effects` fitted, from where they were left."""
    own = [u for name in effects for u in list_effect_unknowns(CATALOGUE[name], search.model)]
    taken = {u.name for u in own}
    free = (*(f for f in list_all_unknowns(search.model) if f.name not in taken), *own)
    x = np.array([(begin.get(f.name, f.centre) - f.centre) / f.scale for f in free])
    return continue_fit(search.problem, linearise(search.problem, free, x), FIRST)


def check_addable(model: Model, effects: Sequence[str]) -> None:
    """Refuse effects that cannot all join a model.

    Raises:
        InputError: one is in it already, excludes another, or nobody can fit it.
    """
    present = list(list_active_effects(model))
    for name in effects:
        entry = CATALOGUE[name]
        if name not in [e.name for e in list_offered_effects(model.plant)]:
            raise InputError("effect", name, f"an effect that the plant {model.plant} can have")
        if name in present:
            raise InputError("effect", name, f"one that is not in the model already (rig remove {name} takes it out)")
        if not entry.fitted:
            raise InputError("effect", name, "an effect with parameters to fit; this is noise of the bench")
        for other in present:
            if name in CATALOGUE[other].excludes or other in entry.excludes:
                raise InputError("effect", name, f"{name} or {other} in a model, not both")
        present.append(name)


def _add_effect(search: Search, before: Hypothesis, name: str) -> Hypothesis:
    """The best fit with one more effect, from the starts that a scan finds; all else is free as well.

    If these do not reach the floor, from the effect's own sizes too: a scan believes what a bad fit tells it.
    """
    fit = before.fit
    healthy = linearise(search.problem, fit.free, place_in_healthy_unit(fit.free, fit.x))
    found = [*scan_effects(search.problem, fit, [name]), *scan_effects(search.problem, healthy, [name])]
    best = search.judge_fit((*before.effects, name), _fit_best(search, _begin_fits(search, found)))
    if best.is_at_floor:
        return best
    free, sizes = best.fit.free, CATALOGUE[name].starts
    x = np.array([[(size[f.name] - f.centre) / f.scale if f.name in size else float(v)
                   for f, v in zip(free, place_in_healthy_unit(free, best.fit.x), strict=True)]
                  for size in sizes])
    other = _fit_best(search, [linearise(search.problem, free, row) for row in x])
    return search.judge_fit(best.effects, other) if other.cost < best.cost else best


def _fit_best(search: Search, begun: Sequence[Fit]) -> Fit:
    """The best of some fits, taken on side by side."""
    alone = replace(search.problem, workers=1, _lanes={})
    fits = search.map_parallel(lambda fit: finish_fit(alone, continue_fit(alone, fit, FIRST), THEN), begun)
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
    found: dict[str, tuple[float, float, float]] = {}
    for name in effects:
        if CATALOGUE[name].port not in UNREPLAYED:
            continue
        marks = find_marks(model, traces)
        prints = [p for p in (*marks.prints, *marks.rivals) if p.effect == name]
        if not prints:
            where = "steps in the measured positions" if CATALOGUE[name].port == "reading" else \
                "a difference between Cor and the model's firmware that it explains"
            raise InputError("effect", name, f"{where}; this trace has none")
        found |= prints[0].parameters
    return found


def _list_steps(search: Search, effects: Sequence[str], done: int, chain: Sequence[Hypothesis]) -> tuple[Step, ...]:
    """One for the start and one for each effect; one that a replay does not show leaves its errors as they are."""
    held = [search.measure_holdout(h) for h in chain]
    steps, at = [Step(effects[done - 1] if done else None, chain[0], chain[0].errors, held[0])], 0
    for name in effects[done:]:
        at += CATALOGUE[name].port not in UNREPLAYED
        steps.append(Step(name, chain[at], chain[at].errors, held[at]))
    return tuple(steps)


def list_fitted_values(r: Refit) -> dict[str, float]:
    """What was fitted, "group.field" to SI value, to six digits."""
    values = {name: float(f"{v:.6g}") for name, v in r.last.hypothesis.fit.values.items()}
    return limit_friction_values(values | {name: float(f"{v[0]:.6g}") for name, v in r.marks.items()})


def build_fitted_model(r: Refit) -> Model:
    """The model with what was fitted."""
    return r.original.replace(list_fitted_values(r), "fit")
