"""The whole way from measured runs to an answer: starting sizes, compiled kernels, search, pattern, discrimination."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.discovery.detectable import Blind, find_separation
from fdi.discovery.explain import Explanation, Fingerprint, explain, explains_part, measure_gain
from fdi.discovery.laws.find_law import LawSearch, find_law_beside
from fdi.discovery.laws.terms import write_law_file
from fdi.discovery.residual_pattern import UNBALANCED, Pattern, can_balance, find_pattern, write_effect
from fdi.discovery.runs import Runs
from fdi.discovery.search import Hypothesis, choose_search_excerpt, compute_p_value
from fdi.estimation import (
    PIECE,
    UNREPLAYED,
    Fit,
    Value,
    can_be_cut,
    complete_model,
    cut_excerpt,
    limit_friction_values,
    list_active_effects,
    make_excerpt,
    silence_readings,
)
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    EFFECT_INTERVAL_FACTOR,
    EFFECT_SYSTEMATIC_SD,
    INTERVAL_95_SD,
    RESIDUAL_HELD_OUT,
    SUSPICIOUS_TOLERANCES,
)
from plant import (
    Lanes,
    Model,
    compile_kernels,
    ensure_starts,
    find_quantity,
    lacks_starts,
    list_kernel_variants,
    list_searched_effects,
    report_law_errors,
    require,
)
from plant.effects import CATALOGUE

PATTERN_VERDICTS = ("UNEXPLAINED", "PARTLY")  # after these the shape of the residual is reported


def explain_runs(runs: Runs, seed: int = 0, effect_file: str | Path | None = None,
                 progress: Progress = ignore_progress, law_file: str | Path | None = None
                 ) -> tuple[Answer, Pattern | None]:
    """Find the physical effect that a model lacks.

    Args:
        runs: the model and the measured runs, from `runs.read_runs`.
        seed: of the simulated runs behind the p-values.
        effect_file: where to write the law of the residual as an effect to add, or the residual's curve where no law
            holds; None for nowhere.
        progress: called with the stage and the share done.
        law_file: where to write the law if one holds and there is no `effect_file`; None for nowhere.

    Returns the answer, and the shape of the residual where it was looked for.

    Raises:
        InputError: a user's effect that cannot be compiled and run, or a file that cannot be written.
    """
    require(not effect_file or can_balance(runs.model), "--write-effect", str(effect_file),
            f"a plant with known balances; {UNBALANCED}")
    prepare_effects(runs, progress=progress)
    e = explain_recording(runs, progress)
    is_left, law_search = e.verdict in PATTERN_VERDICTS, None
    # the terms of laws are those of the reference model's balances
    if is_left and not e.base.is_at_floor and runs.model.kind.balances:
        law_search = find_law_beside(e, progress)
    progress("writing the answer", 0.97)
    law = law_search.law if law_search is not None and law_search.law is not None and law_search.law.holds else None
    if (law_search is not None and law is not None and e.verdict == "PARTLY" and law_search.base is e.base
            and law.hypothesis.is_at_floor and not e.ledger[-1].is_at_floor):  # the named effects stood in for it
        prints = tuple(f.effect for f in e.marks.prints)
        e = replace(e, verdict="PARTLY" if prints else "UNEXPLAINED", effects=prints)
    file = effect_file or law_file
    names = write_law_file(file, law.terms, law.values, law.reason) if law is not None and file else {}
    shape = None
    if can_balance(runs.model) and (is_left or (effect_file and law is None)):
        shape = find_pattern(e.search, e.ledger[-1])
        if effect_file and law is None:
            write_effect(shape, effect_file)
    separation = find_separation(e.search, list_equal(e)) if e.verdict == "AMBIGUOUS" else None
    answer = assess_explanation(e, seed)
    answer = replace(answer, pattern=str(shape or UNBALANCED) if is_left else "",
                     separate=separation._asdict() if separation else {}, law=law_search,
                     law_effects=tuple(names.values()))
    return answer, shape


def list_equal(e: Explanation) -> list[Hypothesis]:
    """The hypotheses between which an AMBIGUOUS explanation leaves the choice, best first."""
    return [h for h in e.ranked if h.is_at_floor and set(h.effects) <= set(e.effects)]


def list_shared_effects(e: Explanation) -> list[str]:
    """The named effects about which equal hypotheses agree, and those that were told without one."""
    equal = list_equal(e)
    return [name for name in e.effects if len({name in h.effects for h in equal}) == 1]


def explain_recording(runs: Runs, progress: Progress = ignore_progress, rounds: int = 2) -> Explanation:
    """The verdict on the runs; of a long recording the part is fitted that says most, and the result is judged on all.

    Where what holds on the part does not hold on all, the pieces that it leaves most of join the part, and the search
    is made once more, `rounds` times in all at most.
    """
    if not can_be_cut(runs.est, runs.model):
        return explain(runs.model, runs.est, runs.repeats, runs.holdout, progress)
    effects = [e.name for e in list_searched_effects(runs.model.plant) if e.port not in UNREPLAYED]
    excerpt = choose_search_excerpt(runs.model, runs.est, effects, progress)
    whole = (runs.est, *runs.repeats)
    for _ in range(rounds):
        est, *repeats = (cut_excerpt(run, excerpt) for run in whole)
        explanation = explain(runs.model, est, repeats, runs.holdout, progress, whole=whole)
        best = explanation.ledger[-1]
        more = None
        if best.judgement is not None and not best.judgement.holds(explanation.floor):
            more = best.judgement.find_worst_piece(explanation.floor, round(PIECE / runs.est.period), excerpt.pieces)
        if more is None:
            break
        fitted_excerpt, excerpt = excerpt, make_excerpt([*excerpt.pieces, more])
    else:
        excerpt = fitted_excerpt
    return replace(explanation, excerpt=excerpt.describe(runs.est))


def prepare_effects(runs: Runs, effects: Sequence[str] | None = None, progress: Progress = ignore_progress) -> None:
    """Find starting sizes for effects that have none, and compile what these effects need; by default all there are.

    Raises:
        InputError: a user's effect that cannot be compiled and run, or a plant whose equations cannot be read.
    """
    runs.model.kind.require_equations()
    names = [e.name for e in list_searched_effects(runs.model.plant)] if effects is None else effects
    replay_effects = [name for name in names if runs.model.find_effect(name).port not in UNREPLAYED]
    model = complete_model(runs.model) if effects is None else lean_model(runs.model, replay_effects)
    with report_law_errors(model):
        if effects is None:
            compile_kernels(model, lambda stage, share: progress(stage, 0.0))
        for name in names:
            if lacks_starts(runs.model.find_effect(name), runs.model.kind):
                progress(f"looking for sizes of {name}", 0.0)
                ensure_starts(name, runs.est.command, runs.est.load, runs.model.plant, model.effects)
        if effects is not None:
            progress("compiling the plant with it, once", 0.0)
            _compile_kernels(model, replay_effects)


def lean_model(model: Model, effects: Sequence[str]) -> Model:
    """The whole catalogue where its quick kernels have these effects; else a model of its own, worth its compiling."""
    whole_model, own_model = complete_model(model), silence_readings(model.with_effects(effects))
    quick = {e for variant in list_kernel_variants(whole_model)[:-1] for e in variant.model.effects}
    return whole_model if set(own_model.effects) <= quick else own_model


def _compile_kernels(model: Model, effects: Sequence[str]) -> None:
    """A replay of a few samples without and with each effect: compiles the kernels that these take, and no others."""
    sizes = {e.fitted[0]: e.starts[-1][e.fitted[0]] for e in map(model.find_effect, effects) if e.starts}
    names = list(sizes) or [next(iter(model.values))]
    usual = np.array([model[name] for name in names])
    rows = usual + np.vstack([0.0 * usual, np.diag([sizes.get(n, x) - x for n, x in zip(names, usual, strict=True)])])
    Lanes(model, names, 1, 1).replay(rows, np.zeros(2), np.zeros(2))


class Candidate(NamedTuple):
    """An effect as part of an explanation, the one it does best in."""

    effect: str
    beside: tuple[str, ...]  # what else is in that explanation
    parameters: dict[str, Value]
    error: dict[str, float]  # RMS that the explanation leaves of each signal
    holdout: dict[str, float]
    ratios: dict[str, float]  # what is left and repeats over the floor, 1 = noise alone
    evidence: float  # gain in log likelihood, less the charge
    p_value: float
    word: str

    @property
    def ratio(self) -> float:
        """That of the signal that is explained worst."""
        return max(self.ratios.values(), default=math.inf)


class Suspicious(NamedTuple):
    """A parameter of the reference model further off than a healthy unit has it."""

    parameter: str
    value: float
    unit: str
    tolerances: float


@dataclass(frozen=True, eq=False)
class Answer:
    """All that is told of an explanation. `baseline` holds error, holdout and floor of each signal, SI."""

    explanation: Explanation
    candidates: tuple[Candidate, ...]
    baseline: Mapping[str, Mapping[str, float]]
    blind: tuple[Blind, ...]
    noiseless: tuple[str, ...]  # effects that leave their mark without noise, of whatever size
    suspicious: tuple[Suspicious, ...]
    ledger: tuple[tuple[str | None, Mapping[str, float], Mapping[str, float]], ...]  # effect, error, holdout
    pattern: str = ""
    separate: Mapping[str, Any] = field(default_factory=dict)
    law: LawSearch | None = None  # where more than noise is left
    law_effects: tuple[str, ...] = ()  # of the effect file that was written

    @property
    def verdict(self) -> str:
        """One of the six words of docs/json.md."""
        return self.explanation.verdict

    @property
    def best(self) -> Hypothesis:
        """The explanation that is told: the best one, or none at all."""
        e = self.explanation
        return e.ledger[-1] if len(e.ledger) > 1 else e.base

    @property
    def explanations(self) -> tuple[Candidate, ...]:
        """The candidates, each set of effects once, with the parameters of all its effects that are candidates."""
        explanations: dict[frozenset[str], Candidate] = {}
        for c in self.candidates:
            effects = frozenset((*c.beside, c.effect))
            first = explanations.get(effects, c)
            explanations[effects] = first._replace(parameters={**first.parameters, **c.parameters})
        return tuple(explanations.values())


def assess_explanation(e: Explanation, seed: int) -> Answer:
    """An explanation worked out; `seed` is that of the simulated runs behind the p-values."""
    firmware_prints = [p for p in e.marks.prints if p.is_firmware]
    baseline = {"error": dict(e.base.errors), "holdout": dict(e.holdout.get((), {})), "floor": dict(e.floor)}
    if firmware_prints:
        unit = e.marks.resolution
        drive = e.search.problem.trace.declared.drive.name
        baseline["error"][drive], baseline["floor"][drive] = e.marks.controller * unit, unit
    best = e.ledger[-1] if e.verdict in ("EXPLAINED", "AMBIGUOUS", "PARTLY") else e.base
    model = e.search.problem.model
    noiseless = tuple(c.name for c in list_searched_effects(model.plant) if c.port in UNREPLAYED and c.fitted)
    # A fit that leaves more than noise, or another controller alone, has bent tolerances: they say nothing of the unit.
    is_telling = best.is_at_floor and (best.effects or best.is_far or not e.marks.is_firmware_different)
    suspicious = tuple(list_suspicious(best.fit, model.plant)) if is_telling else ()
    return Answer(e, tuple(_list_candidates(e, seed)), baseline, e.hidden, noiseless, suspicious,
                  tuple(_list_ledger(e, firmware_prints)))


def list_own_candidates(a: Answer) -> list[Candidate]:
    """The named effects that the model has already, at another size."""
    return [c for c in a.candidates if c.effect in a.explanation.effects
            and c.effect in list_active_effects(a.explanation.search.model)]


def list_fitted_parameters(effect: str, fit: Fit, model: Model) -> dict[str, Value]:
    """The parameters of an effect as fitted, with 95 % intervals within what is possible."""
    parameters = {}
    values, entry = limit_friction_values(fit.values), model.find_effect(effect)
    for f in fit.free:
        if f.name in entry.fitted:
            value = values[f.name]
            size = abs(value - entry.off.get(f.name, model.nominal.get(f.name, 0.0)))
            half = INTERVAL_95_SD * math.hypot(EFFECT_INTERVAL_FACTOR * fit.spread(f.name), EFFECT_SYSTEMATIC_SD * size)
            parameters[f.name] = Value(value, min(max(f.low, value - half), value),
                                       max(min(f.high, value + half), value), entry.parameters[f.name].unit)
    for name, v in parameters.items():  # dynamic friction is not above static friction, nor is its interval
        static = parameters.get(name.replace("dynamic", "static"), v)
        parameters[name] = v._replace(high=max(min(v.high, static.high), v.value))
    return parameters


def list_suspicious(fit: Fit, plant: str = "eha") -> list[Suspicious]:
    """Parameters that are more than `SUSPICIOUS_TOLERANCES` tolerances from where a healthy unit has them."""
    return [Suspicious(f.name, f.value(float(x)), find_quantity(f.name, plant=plant).unit, float(x))
            for f, x in zip(fit.free, fit.x, strict=True)
            if np.isfinite(f.prior) and abs(x) > SUSPICIOUS_TOLERANCES * f.prior]


def _list_candidates(e: Explanation, seed: int) -> list[Candidate]:
    """Each effect once, in the order of the explanations it is part of."""
    candidates = {p.effect: _describe_mark(e, p) for p in e.marks.prints}
    for rank, h in enumerate(e.ranked):
        for effect in h.effects if rank == 0 else h.effects[-1:]:
            if effect not in candidates:
                candidates[effect] = _describe_candidate(e, h, effect, seed)
    return list(candidates.values())


def _describe_candidate(e: Explanation, h: Hypothesis, effect: str, seed: int) -> Candidate:
    gain, extra = measure_gain(e.base, h), _count_unknown(h.fit) - _count_unknown(e.base.fit)
    samples = sum(int(np.isfinite(run.measurements).sum()) for run in (e.search.problem.trace, *e.search.problem.also))
    evidence = 0.5 * (gain - extra * math.log(samples)) - len(h.effects) * math.log(max(len(e.search.effects), 1))
    values = list_fitted_parameters(effect, h.fit, e.search.problem.model)
    return Candidate(effect, tuple(x for x in h.effects if x != effect), values, dict(h.errors),
                     dict(e.holdout.get(h.effects, {})), dict(h.ratio), evidence,
                     compute_p_value(e.blind, gain, max(extra, 1), seed), _choose_word(e, h, effect, evidence))


def _count_unknown(fit: Fit) -> int:
    """How many parameters of which nothing was known."""
    return sum(not np.isfinite(f.prior) for f in fit.free)


def _choose_word(e: Explanation, h: Hypothesis, effect: str, evidence: float) -> str:
    """What to think of an effect, in a word or two; a part only where the evidence is for it."""
    words = {"EXPLAINED": "explains", "AMBIGUOUS": "equal", "PARTLY": "part", "NOT_RESOLVABLE": "too small to be sure"}
    if effect in e.effects and e.verdict in words:
        return words[e.verdict]
    if h.is_at_floor and not e.base.is_at_floor:
        holdout = e.holdout.get(h.effects, {})
        fails = any(error > RESIDUAL_HELD_OUT * e.floor[s] for s, error in holdout.items())
        return "fails on the held-out run" if fails else "less likely"
    is_part = evidence > 0.0 and not e.base.is_at_floor and explains_part(e.base, h, e.floor)
    return "part" if is_part else "no"


def _describe_mark(e: Explanation, p: Fingerprint) -> Candidate:
    """An effect that was found by a mark without noise."""
    meaning = e.search.model.find_effect(p.effect).parameters
    values = {name: Value(*of, meaning[name].unit) for name, of in p.parameters.items()}
    error, ratios = dict(e.base.errors), dict(e.base.ratio)
    if p.is_firmware:
        drive = e.search.problem.trace.declared.drive.name
        error[drive] = p.after * e.marks.resolution
        ratios = {drive: p.after}
    n = len(e.search.problem.trace)
    gain = n * math.log(max(p.before, 1.0) / max(p.after, 1.0))
    evidence = gain - 0.5 * len(values) * math.log(n) - math.log(len(CATALOGUE))
    return Candidate(p.effect, (), values, error, dict(e.holdout.get((), {})), ratios, evidence,
                     max(min(1.0, len(CATALOGUE) * math.exp(-min(gain, 600.0))), 1e-300),
                     "explains" if p.effect in e.effects else "no")


def _list_ledger(e: Explanation, firmware_prints: Sequence[Fingerprint]
            ) -> list[tuple[str | None, Mapping[str, float], Mapping[str, float]]]:
    unit, name = e.marks.resolution, e.search.problem.trace.declared.drive.name
    drive = {name: e.marks.controller * unit} if firmware_prints else {}
    rows: list[tuple[str | None, Mapping[str, float], Mapping[str, float]]] = [
        (None, e.base.errors | drive, e.holdout.get((), {}))]
    for p in e.marks.prints:
        if p.effect in e.effects:
            drive = {name: p.after * unit} if p in firmware_prints else drive
            rows.append((p.effect, e.base.errors | drive, e.holdout.get((), {})))
    return rows + [(h.effects[-1], h.errors | drive, e.holdout.get(h.effects, {})) for h in e.ledger[1:]]
