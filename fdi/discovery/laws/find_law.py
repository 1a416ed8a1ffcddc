"""A sparse law for what no effect of the catalogue explains: proposed by regression, chosen and judged by replay.

Terms join the law one by one. Regressions on the balances propose them; replays of the whole plant rank them; a term
stays if it lowers the error of pieces of the run that its fit did not see. The held-out run then judges the law, and
takes no part in its choice.
"""
from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.discovery.explain import Explanation, measure_excess
from fdi.discovery.laws.terms import LIBRARY, PARTS, TERMS, Term, find_states, name_parameter, registered_library
from fdi.discovery.residual_pattern import ACCELERATION_WINDOW, CREEP, EDGE, Balance, States, compute_balances
from fdi.discovery.search import Hypothesis, Search, simulate_starts
from fdi.estimation import (
    Fit,
    Free,
    Problem,
    Value,
    compute_misfit,
    compute_typical_rms,
    continue_fit,
    form_normal_equations,
    linearise,
    place_in_healthy_unit,
    silence_readings,
    step_within_bounds,
)
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    EFFECT_INTERVAL_FACTOR,
    EFFECT_SYSTEMATIC_SD,
    ERROR_PARTLY_EXPLAINED,
    FURTHER_EFFECT_SHARE,
    GAIN_CONVINCES,
    GAIN_TIE,
    INTERVAL_95_SD,
    PATTERN_VISIBLE_RATIO,
    UNIT_TOLERANCE,
    WHITE_SQUARE_POOR,
)
from fdi.trace import Floats
from plant import Signals

MOST_TERMS = 3
PROPOSED = 14  # terms of each balance that a replay looks at
MOST_FITTED = 5  # that get a fit
# Times the regression's coefficient: the tolerances of the base fit hide a part of it.
TRIED_SIZES = (0.3, 0.6, 1.0, 1.5)
FOLD_SECONDS = 0.7  # pieces of a run that go to the two halves in turn
SCREENED = ("position", "speed", "pressure", "spool", "current", "command", "direction", "way", "time")


@dataclass(frozen=True, eq=False)
class Trial:
    """Terms fitted by replay; `unseen` is -2 log likelihood on pieces left out of the fit."""

    terms: tuple[Term, ...]
    fit: Fit
    unseen: float = np.inf


@dataclass(frozen=True, eq=False)
class Law:
    """A law and how it does: RMS errors in SI units, by signal."""

    terms: tuple[Term, ...]
    values: Mapping[str, Value]  # by field
    holds: bool
    reason: str  # why it holds, or why not
    hypothesis: Hypothesis
    holdout: Mapping[str, float]
    floor: Mapping[str, float]  # noise floor of each signal under the law, SI
    equals: tuple[str, ...] = ()  # terms that would do as well as the first one


@dataclass(frozen=True, eq=False)
class Missing:
    """One balance: how much is missing there, and what it follows."""

    balance: Balance
    visible: bool
    dependences: tuple[Dependence, ...] = ()


@dataclass(frozen=True, eq=False)
class LawCurve:
    """What is missing over a state, in bins, and what the law says there: (k,) each."""

    place: str
    unit: str
    state: str
    along: str  # "" or the state whose sign both curves are multiplied by
    period: float  # of a wave, on which the state is folded; 0 for none
    at: Floats
    height: Floats
    doubt: Floats  # standard error of the height
    law: Floats


@dataclass(frozen=True, eq=False)
class LawSearch:
    """What a search for a law found."""

    missing: tuple[Missing, ...]
    hidden: Mapping[str, str]  # balances that the measured signals do not show, with the reason
    law: Law | None
    base: Hypothesis  # without the law
    catalogue: Hypothesis | None  # the catalogue's best
    holdout: Mapping[str, Mapping[str, float]]  # errors of "base" and "catalogue" on the held-out run
    floor: Mapping[str, float]  # under the law where it holds, else under the model without it
    signals: Signals  # of the plant
    curve: LawCurve | None = None


# Balances that need a signal, and why.
HIDDEN = {"force": ("p12", "a missing force and a missing flow look alike without P12"),
          "current": ("xs", "the current balance needs XS")}


def find_law(search: Search, base: Hypothesis, catalogue: Hypothesis | None, floor: Mapping[str, float],
             progress: Progress = ignore_progress) -> LawSearch:
    """The sparse law that explains the residual of `base`, if there is one that holds.

    Args:
        search: the runs, with the steps of its last fits. Its held-out run judges the law and takes no part in its
            choice.
        base: the model without the law.
        catalogue: the best that the catalogue can do; the law must do better.
        floor: noise floor of each signal, SI.
        progress: called with each stage and the share done.
    """
    progress("which states the residual follows", 0.85)
    unseen = None if search.holdout is None else search.make_problem(search.holdout, search.problem.steps)
    balances, states = compute_balances(search.problem, base, floor)
    holdout = compute_balances(unseen, base, floor) if unseen is not None else None
    missing = tuple(describe_balance(b, states, holdout) for b in balances)
    hidden_places = {place: why for place, (signal, why) in HIDDEN.items()
                     if signal not in search.problem.trace.outputs and any(b.place == place for b in balances)}
    places = [m.balance.place for m in missing if m.balance.place not in hidden_places]
    with registered_library():
        worker = _Worker(search, base, places, floor)
        trial, equals = worker.choose_terms(progress)
        law = None
        if trial is not None:
            progress("last fit of the law", 0.93)
            law = worker.judge_law(trial, equals, catalogue)
    hypotheses = [("base", base), ("catalogue", catalogue)] if unseen is not None else []
    errors = {name: _measure_holdout(search, h) for name, h in hypotheses if h}
    curve = None if law is None else compute_law_curve(law, search, base.effects)
    last_floor = law.floor if law is not None and law.holds else floor
    return LawSearch(missing, hidden_places, law, base, catalogue, errors, last_floor,
                     search.problem.trace.declared, curve)


def find_law_beside(e: Explanation, progress: Progress = ignore_progress) -> LawSearch:
    """The law behind what an explanation leaves.

    Of a part that the catalogue explains, the law is tried alone first, then beside the named effects.
    """
    best = e.ranked[0] if e.ranked else None
    first = find_law(e.search, e.base, best, e.floor, progress)
    if e.verdict != "PARTLY" or len(e.ledger) < 2 or (first.law is not None and first.law.hypothesis.is_at_floor):
        return first
    second = find_law(e.search, e.ledger[-1], best, e.floor, progress)
    if second.law is None or not second.law.holds:
        return first
    is_better = (first.law is None or not first.law.holds
                 or _measure_left(second.law, e.floor) < _measure_left(first.law, e.floor))
    return second if is_better else first


def _measure_left(law: Law, floor: Mapping[str, float]) -> float:
    return measure_excess(law.holdout or law.hypothesis.errors, floor)


def describe_balance(b: Balance, states: States, holdout: tuple[list[Balance], States] | None) -> Missing:
    """What is missing in a balance, and on which states it depends; `holdout`: the same on the held-out run."""
    if b.ratio < PATTERN_VISIBLE_RATIO:
        return Missing(b, False)
    unseen = None
    if holdout is not None:
        same = next(other for other in holdout[0] if other.place == b.place)
        unseen = _screen_rows(same, holdout[1])
    rows = _screen_rows(b, states)
    return Missing(b, True, () if rows is None else tuple(find_dependences(*rows, unseen)))


def _screen_rows(b: Balance, states: States) -> tuple[Floats, dict[str, Floats]] | None:
    """What is missing and the quantities that it may depend on, in a part of the rows; None without smooth ones."""
    inner = np.arange(EDGE, len(b.missing) - EDGE, THINNED)
    inner = inner[b.smooth[inner]]
    if not len(inner):
        return None
    y = b.missing[inner]
    return (np.clip(y, *np.percentile(y, [0.5, 99.5])), {name: getattr(states, name)[inner] for name in SCREENED})


def _measure_holdout(search: Search, h: Hypothesis) -> dict[str, float]:
    """RMS residual of the typical block of the held-out run, SI; {} without one."""
    if search.holdout is None:
        return {}
    residual = search.make_problem(search.holdout, search.problem.steps).compute_residuals(h.fit.free, h.fit.x[None])[0]
    return dict(zip(search.holdout.outputs, compute_typical_rms(residual).tolist(), strict=True))


class _Ranked(NamedTuple):
    """A proposal at a size on top of a fit: `cost` after the fit's unknowns, (p,), have moved to `x`."""

    cost: float
    proposal: Proposal
    factor: float
    fit: Fit
    x: Floats


class _Worker:
    """The replays of one search: a problem with quick steps for each set of balances that the law has terms of."""

    def __init__(self, search: Search, base: Hypothesis, places: Sequence[str], floor: Mapping[str, float]) -> None:
        self.search, self.base, self.places, self.floor = search, base, places, floor
        self._problems: dict[tuple[str, ...], Problem] = {}

    def problem(self, terms: Sequence[Term], more: str = "") -> Problem:
        """The run with quick steps, and a plant that has the terms' balances in its library."""
        places = tuple(sorted({t.place for t in terms} | ({more} if more else set())))
        if places not in self._problems:
            own = self.search.problem
            effects = [*self.base.effects, *(LIBRARY[p] for p in places)]
            model = silence_readings(self.search.model.with_effects(effects))
            self._problems[places] = replace(own, model=model, bare=None, steps=10, also=(), workers=1, _lanes={})
        return self._problems[places]

    def choose_terms(self, progress: Progress) -> tuple[Trial | None, tuple[str, ...]]:
        """Terms added one by one as long as left-out pieces of the run want them, and what would do as well."""
        if self.base.is_at_floor:
            return None, ()  # what a healthy unit's tolerances have not quite reached is not a law
        start = continue_fit(self.problem(()), linearise(self.problem(()), self.base.fit.free, self.base.fit.x), 2)
        (trial,) = self.measure_unseen([Trial((), start)])
        equals: tuple[str, ...] = ()
        samples = float(np.isfinite(self.search.problem.trace.measurements).sum())
        for count in range(MOST_TERMS):
            if trial.fit.misfit < WHITE_SQUARE_POOR * samples:
                break  # only noise is left
            progress(f"looking for term {count + 1} of a law", 0.86 + 0.02 * count)
            extensions = self.add_each_term(trial)
            if not extensions or extensions[0].fit.cost > trial.fit.cost - GAIN_CONVINCES:
                break
            limit = extensions[0].fit.cost + 0.1 * (trial.fit.cost - extensions[0].fit.cost)
            close_trials = self.measure_unseen([t for t in extensions if t.fit.cost < limit][:3])
            best = min(close_trials, key=lambda t: t.unseen + GAIN_TIE * sum(len(term.fields) for term in t.terms))
            if trial.unseen - best.unseen < max(GAIN_CONVINCES, FURTHER_EFFECT_SHARE * (trial.unseen - samples)):
                break
            if count == 0:
                equals = tuple(t.terms[-1].name for t in close_trials if t is not best
                               and t.unseen < best.unseen + GAIN_TIE)
            trial = best
        trial = self.drop_terms(trial)
        return (trial, equals) if trial.terms else (None, ())

    def add_each_term(self, trial: Trial) -> list[Trial]:
        """The law with one more term, the promising ones fitted, best first.

        Tolerances that have moved to make up for what is missing hide it: proposals come from the healthy unit too.
        """
        x = place_in_healthy_unit(trial.fit.free, trial.fit.x)
        healthy = linearise(self.problem(trial.terms), trial.fit.free, x)
        ranking = [each for fit in (trial.fit, healthy) for each in self.rank_terms(trial.terms, fit)]
        best: dict[str, _Ranked] = {}
        for each in sorted(ranking, key=lambda r: r.cost):
            best.setdefault(each.proposal.term.name, each)
        best_proposals = [each for each in best.values() if each.cost < trial.fit.cost - GAIN_CONVINCES][:MOST_FITTED]
        fits = self.search.map_parallel(lambda each: self.fit_term(trial.terms, each), best_proposals)
        return sorted(fits, key=lambda t: t.fit.cost)

    def rank_terms(self, terms: tuple[Term, ...], fit: Fit) -> list[_Ranked]:
        """Every proposal at each of `TRIED_SIZES` on top of a fit, with what a replay says that it would leave."""
        problem = replace(self.problem(terms), workers=self.search.workers)
        balances, states = compute_balances(problem, Hypothesis(self.base.effects, fit, {}), self.floor)
        ranking: list[_Ranked] = []
        for b in balances:
            if b.place not in self.places:
                continue
            rows = select_rows(b, states, {**problem.model.values, **fit.values})
            proposals = propose_terms(b.place, rows, terms)[:PROPOSED]
            pairs = [(p, factor) for p in proposals for factor in TRIED_SIZES]
            starts = [(p.term.name, {name_parameter(p.term, f): v * (factor if f == p.term.name else 1.0)
                                     for f, v in p.values.items()}, False) for p, factor in pairs]
            trials = simulate_starts(self.problem(terms, b.place), fit, starts, self.search.workers)
            ranking += [_Ranked(t.cost, *each, fit, t.x) for each, t in zip(pairs, trials, strict=True)]
        return [each for each in ranking if np.isfinite(each.cost)]

    def fit_term(self, terms: tuple[Term, ...], r: _Ranked) -> Trial:
        """The law with one more term, fitted with all tolerances from where the ranking has left them, or before it."""
        terms = (*terms, r.proposal.term)
        problem = self.problem(terms)
        free = (*r.fit.free, *_make_unknowns(r.proposal, r.factor))
        new_x = np.zeros(len(free) - len(r.fit.free))
        start_fits = [linearise(problem, free, np.concatenate([x, new_x])) for x in (r.x, r.fit.x)]
        fits = [continue_fit(problem, fit, 2) for fit in start_fits]
        return Trial(terms, continue_fit(problem, min(fits, key=lambda fit: fit.cost), 4))

    def drop_terms(self, trial: Trial) -> Trial:
        """The law without the terms that left-out pieces of the run do not want."""
        while len(trial.terms) > 1:
            shorter = self.measure_unseen(self.search.map_parallel(partial(self.fit_without, trial), trial.terms))
            best = min(shorter, key=lambda t: t.unseen)
            if best.unseen > trial.unseen + GAIN_CONVINCES:
                break
            trial = best
        return trial

    def fit_without(self, trial: Trial, term: Term) -> Trial:
        """The law without a term."""
        terms, (free, x) = tuple(t for t in trial.terms if t is not term), leave_out_terms(trial.fit, [term])
        return Trial(terms, continue_fit(self.problem(terms), linearise(self.problem(terms), free, x), 5))

    def measure_unseen(self, trials: Sequence[Trial]) -> list[Trial]:
        """Trials with -2 log likelihood of each half of the run's pieces under a fit to the other half.

        That fit is one step from the fit to the whole.
        """
        def measure(t: Trial) -> Trial:
            problem, white = self.problem(t.terms), t.fit.white
            piece = np.arange(white.shape[1]) // max(round(FOLD_SECONDS / problem.trace.period), 1)
            total = 0.0
            for half in (0, 1):
                mask = (piece % 2 == half).astype(float)
                half_fit = replace(t.fit, white=white * mask, jacobian=t.fit.jacobian * mask)
                gradient, hessian = form_normal_equations(half_fit)
                x = step_within_bounds(half_fit, hessian, gradient, (1e-3,))
                residuals = problem.compute_white_residuals(t.fit.free, x) * (1.0 - mask)
                total += float(compute_misfit(residuals)[0])
            return replace(t, unseen=total)

        return self.search.map_parallel(measure, trials)

    def judge_law(self, t: Trial, equals: tuple[str, ...], catalogue: Hypothesis | None) -> Law:
        """The law with last fits, fine steps and repeats, judged on the held-out run."""
        last = copy.copy(self.search)
        model = self.problem(t.terms).model
        last.problem = replace(self.search.problem, model=model, bare=None, _lanes={})
        last.fine = replace(last.problem, steps=(self.search.fine or last.problem).steps, _lanes={})
        last.repeats = [replace(p, model=model, bare=None, _lanes={}) for p in self.search.repeats]
        h = last.finish_hypothesis(last.judge_fit(self.base.effects, t.fit), 2)
        h = last.judge_on_all([h], last.problem.steps)[0]
        values = {f: _read_value(h.fit, name_parameter(term, f), unit)
                  for term in t.terms for f, unit in zip(term.fields, term.units, strict=True)}
        holdout = _measure_holdout(last, h)
        holds, reason = self.decide(h, holdout, catalogue)
        return Law(t.terms, values, holds, reason, h, holdout, last.estimate_floor(h), equals)

    def decide(self, h: Hypothesis, holdout: Mapping[str, float], catalogue: Hypothesis | None) -> tuple[bool, str]:
        """Whether the law holds, and why; `holdout` has its errors on the held-out run."""
        floor = self.floor
        before, after = (measure_excess(each.errors, floor) for each in (self.base, h))
        if after > ERROR_PARTLY_EXPLAINED**2 * before:
            return False, "the law lowers the error of its own run too little"
        if not holdout:
            return True, "no held-out run: judged on pieces of the run that its fit did not see"
        unseen = measure_excess(holdout, floor)
        bare = measure_excess(_measure_holdout(self.search, self.base), floor)
        if unseen > ERROR_PARTLY_EXPLAINED**2 * bare:
            return False, "the law does not lower the error of the held-out run"
        if catalogue is not None and unseen > measure_excess(_measure_holdout(self.search, catalogue), floor):
            return False, "an effect of the catalogue does better on the held-out run"
        return True, "the held-out run, which took no part in the choice, confirms the law"


def _make_unknowns(p: Proposal, factor: float) -> list[Free]:
    """The parameters of a term as unknowns, centred where they begin."""
    free = []
    for name, value in p.values.items():
        full = name_parameter(p.term, name)
        if name == p.term.name:
            free.append(Free(full, factor * value, abs(value), np.inf, -np.inf, np.inf, 0.05))
        elif name.endswith("_phase"):
            free.append(Free(full, value, 0.3, np.inf, -100.0, 100.0, 0.1))
        else:
            step = 0.01 if p.term.is_wave else 0.1
            free.append(Free(full, value, value, np.inf, value / 4.0, 4.0 * value, step))
    return free


def _read_value(fit: Fit, name: str, unit: str) -> Value:
    value = fit.values[name]
    half = INTERVAL_95_SD * float(np.hypot(EFFECT_INTERVAL_FACTOR * fit.spread(name), EFFECT_SYSTEMATIC_SD * value))
    return Value(value, value - half, value + half, unit)


def leave_out_terms(fit: Fit, terms: Iterable[Term]) -> tuple[tuple[Free, ...], Floats]:
    """The unknowns of a fit, and their values (p,), without those of some terms."""
    names = {name_parameter(term, f) for term in terms for f in term.fields}
    indices = [k for k, f in enumerate(fit.free) if f.name not in names]
    return tuple(fit.free[k] for k in indices), fit.x[indices]


def compute_law_curve(law: Law, search: Search, effects: tuple[str, ...]) -> LawCurve:
    """Bin means of what is missing without the law, and of the law, over the first term's state.

    `effects` are those that the law stands beside. The tolerances are those that were fitted together with the law:
    fitted without it they have moved to make up for a part of what is missing.
    """
    fit = law.hypothesis.fit
    free, x = leave_out_terms(fit, law.terms)
    bare = Hypothesis(effects, replace(fit, free=free, x=x), {})
    balances, states = compute_balances(search.problem, bare, law.floor)
    term = law.terms[0]
    balance = next(b for b in balances if b.place == term.place)
    rows = select_rows(balance, states, {**search.problem.model.values, **bare.fit.values})
    along = {"damping": "speed", "dry": "direction", "conductance": "pressure", "area": "speed"}.get(term.part, "")
    state = next(iter(find_states(term)), along or "time")
    state = "speed" if state == "direction" else state
    is_odd = bool(along) and state != along and not (along == "direction" and state == "speed")
    side = np.sign(rows.states[along]) if is_odd else 1.0
    values = {f: v.value for f, v in law.values.items()}
    prediction = np.sum([values[t.name] * evaluate_columns(t, {f: values[f] for f in t.fields}, rows.states)[:, 0]
                         for t in law.terms if t.place == term.place], axis=0)
    over, period = rows.states[state], 0.0
    if term.is_wave and term.shape is not None:
        shape = values[f"{term.name}_{term.shape.name}"]
        period = shape if term.shape.kind == "period" else 1.0 / shape
        over = np.mod(over, period)
    bins = 24
    edges = np.unique(np.quantile(over, np.linspace(0.0, 1.0, bins + 1)))
    place = np.clip(np.searchsorted(edges, over, side="right") - 1, 0, len(edges) - 2)
    (at, _), (height, doubt), (law_height, _) = (average_bins(place, len(edges) - 1, column)
                                                 for column in (over, side * rows.missing, side * prediction))
    return LawCurve(term.place, balance.unit, state, along if is_odd else "", period, at, height, doubt, law_height)


def average_bins(place: NDArray[np.int64], bins: int, y: Floats, neighbours: int = 20) -> tuple[Floats, Floats]:
    """Means of `y` (n,) in bins, and their standard errors where so many neighbouring rows are alike: (bins,) each."""
    count = np.maximum(np.bincount(place, minlength=bins), 1)
    mean = np.bincount(place, y, bins) / count
    group = (np.arange(len(y)) // neighbours) * bins + place
    sums = np.bincount(group, y - mean[place], (len(y) // neighbours + 1) * bins).reshape(-1, bins)
    return mean, np.sqrt((sums**2).sum(axis=0)) / count


Places = NDArray[np.int64]

FOLDS = 10  # contiguous blocks of a run; each is predicted from the others
SHIFTS = 199  # of the residual against the states, for the null
SINGLE_BINS, PAIR_BINS = 12, 6
OWN_BINS = {"position": 40}  # alone: a wave along the stroke is short


class Dependence(NamedTuple):
    """A state, or a pair of them, with the share of the missing quantity's variance that it predicts."""

    states: tuple[str, ...]
    share: float  # in blocks of the run that its curve was not made from
    holdout: float | None  # on the held-out run, by the curve of the run; None without one
    p_value: float  # probability that any of all states and pairs does as well by chance


def find_dependences(y: Floats, states: Mapping[str, Floats], holdout: tuple[Floats, Mapping[str, Floats]] | None,
                     seed: int = 0, most: int = 6) -> list[Dependence]:
    """The states and pairs that predict `y` (n,) best, best first.

    The null shifts `y` along the run by random times, which keeps its own correlation in time and breaks that with the
    states. The best share of all states and pairs under each shift makes the p-values: they hold for all at once.

    Args:
        y: what is missing, over time.
        states: (n,) each.
        holdout: the same of the held-out run.
        seed: of the random shifts.
        most: how many to return.
    """
    names = [name for name, x in states.items() if np.ptp(x) > 0.0]
    n = len(y)
    shifts = np.random.default_rng(seed).integers(n // 20, n - n // 20, SHIFTS)
    columns = np.column_stack([y, *(np.roll(y, int(k)) for k in shifts)])
    fold = np.minimum(np.arange(n) * FOLDS // n, FOLDS - 1)
    edges = {name: {bins: np.unique(np.quantile(states[name], np.linspace(0.0, 1.0, bins + 1)[1:-1]))
                    for bins in (SINGLE_BINS, PAIR_BINS, *OWN_BINS.values())} for name in names}
    choices = [(name,) for name in names] + list(combinations(names, 2))
    shares = np.array([_predict_folds(_find_bins(c, states, edges), fold, columns) for c in choices])
    best_by_chance = shares[:, 1:].max(axis=0)
    share_of = dict(zip(choices, shares[:, 0].tolist(), strict=True))
    least_gain = 0.03  # share that a pair must add to the better one of its states
    useful_choices = [c for c in choices
                      if len(c) == 1 or share_of[c] > max(share_of[c[:1]], share_of[c[1:]]) + least_gain]
    best_choices = sorted(useful_choices, key=lambda c: -share_of[c])[:most]
    return [Dependence(c, share_of[c], _predict_holdout(c, y, states, holdout, edges),
                       float((1 + np.sum(best_by_chance >= share_of[c])) / (1 + SHIFTS))) for c in best_choices]


def _find_bins(choice: Sequence[str], states: Mapping[str, Floats], edges: Mapping[str, Mapping[int, Floats]]
               ) -> Places:
    bins = PAIR_BINS if len(choice) > 1 else OWN_BINS.get(choice[0], SINGLE_BINS)
    place = np.zeros(len(states[choice[0]]), np.int64)
    for name in choice:
        place = place * bins + np.searchsorted(edges[name][bins], states[name], side="right")
    return place


def _predict_folds(place: Places, fold: Places, y: Floats) -> Floats:
    """Share of the variance of each column of `y` (n, k) that bin means of the other folds predict."""
    from scipy.sparse import csr_array

    bins = int(place.max()) + 1
    group = place * FOLDS + fold
    pick = csr_array((np.ones(len(place)), (group, np.arange(len(place)))), shape=(bins * FOLDS, len(place)))
    sums = (pick @ y).reshape(bins, FOLDS, -1)
    count = np.bincount(group, minlength=bins * FOLDS).reshape(bins, FOLDS, 1)
    mean = (sums.sum(axis=1, keepdims=True) - sums) / (count.sum(axis=1, keepdims=True) - count + 5.0)  # shrunk to zero
    error = (y**2).sum(axis=0) - (2.0 * mean * sums - mean**2 * count).sum(axis=(0, 1))
    return np.asarray(1.0 - error / np.maximum((y**2).sum(axis=0), 1e-300))


def _predict_holdout(choice: Sequence[str], y: Floats, states: Mapping[str, Floats],
                     holdout: tuple[Floats, Mapping[str, Floats]] | None,
                     edges: Mapping[str, Mapping[int, Floats]]) -> float | None:
    if holdout is None:
        return None
    unseen, at = holdout
    place, unseen_place = _find_bins(choice, states, edges), _find_bins(choice, at, edges)
    bins = max(int(place.max()), int(unseen_place.max())) + 1
    mean = np.bincount(place, y, bins) / (np.bincount(place, minlength=bins) + 5.0)
    return 1.0 - float(np.sum((unseen - mean[unseen_place]) ** 2)) / max(float(np.sum(unseen**2)), 1e-300)


THINNED = 3  # every so many rows: smoothing has made neighbours alike
SCALES = (0.02, 0.05, 0.1, 0.2, 0.4)  # of a scale, times the largest state
TURNS = np.geomspace(1.0, 60.0, 240)  # of a wave over the range of the position
FUNCTIONS: Mapping[str, Any] = {
    "sin": np.sin, "exp": np.exp, "tanh": np.tanh, "sqrt": np.sqrt, "abs": np.abs, "pi": np.pi, "max": np.maximum,
    "min": np.minimum, "__builtins__": {}}


class Proposal(NamedTuple):
    """A term with parameters that the regression gives it, and the share of what is missing that it predicts."""

    term: Term
    values: Mapping[str, float]  # by field
    share: float  # in blocks that its coefficient was not made from


class Rows(NamedTuple):
    """The rows of a balance that a regression uses."""

    missing: Floats  # (n,)
    states: Mapping[str, Floats]  # (n,) each
    nuisance: Floats  # (n, k): what tolerances of one unit make of them, each for one tolerance
    noise: float


def select_rows(balance: Balance, states: States, values: Mapping[str, float]) -> Rows:
    """Rows in which the balance says something: not the ends, and for a force only those in which the ram slides."""
    inner = np.arange(EDGE, len(balance.missing) - EDGE, THINNED)
    inner = inner[balance.smooth[inner]]
    if balance.place == "force":
        inner = inner[np.abs(states.speed[inner]) > 2.0 * CREEP]
    missing = balance.missing[inner]
    if len(missing):
        missing = np.clip(missing, *np.percentile(missing, [0.5, 99.5]))
    at = {name: getattr(states, name)[inner] for name in states._fields}
    return Rows(missing, at, _list_nuisance(balance.place, at, values), balance.noise)


def _list_nuisance(place: str, at: Mapping[str, Floats], p: Mapping[str, float]) -> Floats:
    """What one tolerance of each parameter adds to a balance, (n, k)."""
    if place == "force":
        parts = [p["jack.area"] * at["pressure"], p["jack.damping"] * at["speed"],
                 p["jack.dynamic_friction"] * at["direction"], p["jack.mass"] * at["acceleration"]]
    elif "pump.displacement" in p:
        parts = [p["pump.displacement"] * at["current"], p["jack.area"] * at["speed"]]
    elif place == "flow":
        conductance = p["valve.flow_gain"] / p["valve.pressure_gain"] + p["jack.leakage"]
        parts = [p["valve.flow_gain"] * at["spool"], conductance * at["pressure"], p["jack.area"] * at["speed"]]
    else:
        parts = [at["current"], p["feedback_spring.stiffness"] / p["torque_motor.gain"] * at["spool"]]
    return UNIT_TOLERANCE * np.column_stack(parts)


def propose_terms(place: str, rows: Rows, present: Sequence[Term] = ()) -> list[Proposal]:
    """Every term of a balance on its own, beside the tolerances, best first; without those that are `present`."""
    if len(rows.missing) < 20 * FOLDS:
        return []
    remove = _make_remover(rows)
    y = remove(rows.missing[:, None])[:, 0]
    proposals = (_fit_term(t, rows, remove, y) for t in TERMS if t.place == place and t not in present)
    return sorted(filter(None, proposals), key=lambda p: -p.share)


def _make_remover(rows: Rows) -> Callable[[Floats], Floats]:
    """A function that takes out of columns, (n, k), what tolerances of a usual size can make up for."""
    wide = rows.nuisance
    # neighbours are alike, so noise averages out over fewer rows than there are
    variance = rows.noise**2 * ACCELERATION_WINDOW / THINNED + 1e-300
    inverse = np.linalg.inv(wide.T @ wide + variance * np.eye(wide.shape[1]))
    return lambda columns: columns - wide @ (inverse @ (wide.T @ columns))


def _fit_term(term: Term, rows: Rows, remove: Callable[[Floats], Floats], y: Floats) -> Proposal | None:
    """The term with the shape that predicts `y` (n,) best: what is missing, without what tolerances make up for."""
    best: Proposal | None = None
    for shape in list_shapes(term, rows.states, y):
        columns = remove(evaluate_columns(term, shape, rows.states))
        if not np.isfinite(columns).all() or np.ptp(columns, axis=0).max() == 0.0:
            continue
        size = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
        share, c = _predict_blocks(columns / size, y)
        c = c / size
        if best is None or share > best.share:
            values = {term.name: float(c[0]), **shape}
            if term.is_wave:
                values[term.name] = float(np.hypot(*c))
                values[f"{term.name}_phase"] = float(np.arctan2(c[1], c[0]))
            best = Proposal(term, values, share)
    return best if best is not None and best.values[term.name] != 0.0 else None


def _predict_blocks(columns: Floats, y: Floats) -> tuple[float, Floats]:
    """Share of `y` (n,) that the columns (n, k) predict in blocks left out of their fit, and the fit to all, (k,)."""
    blocks = list(zip(np.array_split(columns, FOLDS), np.array_split(y, FOLDS), strict=True))
    grams = np.array([block.T @ block for block, _ in blocks])
    sides = np.array([block.T @ part for block, part in blocks])
    gram, side, small = grams.sum(axis=0), sides.sum(axis=0), 1e-6 * len(y) * np.eye(columns.shape[1])
    error = float(y @ y)
    for g, s in zip(grams, sides, strict=True):
        c = np.linalg.solve(gram - g + small, side - s)
        error += float(c @ g @ c - 2.0 * c @ s)
    return 1.0 - error / max(float(y @ y), 1e-300), np.linalg.solve(gram + small, side)


def list_shapes(term: Term, states: Mapping[str, Floats], y: Floats) -> list[dict[str, float]]:
    """Trial values of a term's shape, by field; one empty trial for a term without. Frequencies are lines of `y`."""
    if term.shape is None:
        return [{}]
    x = states[term.shape.state]
    field = f"{term.name}_{term.shape.name}"
    if term.shape.kind == "scale":
        largest = float(np.percentile(np.abs(x), 99.0))
        return [{field: share * largest} for share in SCALES if share * largest > 0.0]
    span = float(np.ptp(x))
    if span <= 0.0:
        return []
    if term.shape.kind == "period":
        return [{field: span / turns} for turns in TURNS.tolist()]
    return [{field: hertz} for hertz in find_lines(y, x, span)]


def find_lines(y: Floats, t: Floats, span: float, highest: float = 120.0, most: int = 4) -> list[float]:
    """The strongest frequencies of `y` (n,) at the times `t` (n,), Hz: a regular grid, from which some may be missing.

    A periodogram with zeros where a time is missing: its lines are where those of Lomb and Scargle are, 1000 times as
    fast.
    """
    step = float(np.median(np.diff(t)))
    places = np.rint((t - t[0]) / step).astype(int)
    regular = np.zeros(2 * (int(places.max()) + 1))  # twice as long: two frequencies a line
    np.add.at(regular, places, y - y.mean())
    hertz, power, lines = np.fft.rfftfreq(len(regular), step), np.abs(np.fft.rfft(regular)) ** 2, []
    power[(hertz < 1.0 / span) | (hertz > highest)] = 0.0
    for _ in range(most):
        line = hertz[int(np.argmax(power))]
        lines.append(float(line))
        power[np.abs(hertz - line) < 2.0 / span] = 0.0
    return lines


def evaluate_columns(term: Term, values: Mapping[str, float], states: Mapping[str, Floats]) -> Floats:
    """The term without its coefficient, (n, 1), in the unit of its balance over that of the coefficient.

    A wave without a phase in `values` gives two columns, its sine and its cosine.
    """
    phases = [0.0, 0.5 * np.pi] if term.is_wave and f"{term.name}_phase" not in values else [None]
    times = {"1": 1.0, "speed": states["speed"], "pressure": states["pressure"], "direction": states["direction"]}
    columns = []
    for phase in phases:
        all_values = dict(values) if phase is None else {**values, f"{term.name}_phase": phase}
        text = term.format_factor({field: repr(value) for field, value in all_values.items()})
        factor = eval(text, dict(FUNCTIONS), dict(states))  # a formula of `terms.TERMS`
        columns.append(np.broadcast_to(factor * times[PARTS[term.part][1]], states["time"].shape))
    return np.column_stack(columns)
