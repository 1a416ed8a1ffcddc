"""The search for what else is wrong beside the valve faults: each effect of the catalogue, with both faults free.

Faults, tolerances and suspects are fitted together with the effect, so that neither takes the other's place: a fault
that was found first would otherwise take up what belongs to the effect, and the other way round. Scan, fits and charges
are those of `rig explain`; the fit's last rounds are those of `fdi.diagnosis.refine`, which knows the directions along
which no signal changes.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, zip_longest

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Estimate, Fault, Level, judge_size
from fdi.diagnosis.refine import (
    COARSE_STARTS,
    FAULT_PARAMETERS,
    FINE_STEPS,
    NOISE_SCHEDULE,
    SUSPECTS,
    CountedProblem,
    Refinement,
    choose_start,
    descend,
    estimate_offsets,
    find_flat,
    guess_first_covariance,
    is_noise_left,
    learn_left_noise,
    list_unknowns,
    make_problem,
    make_start,
    measure_ratios,
    report_fit,
)
from fdi.discovery.explain import find_marks
from fdi.discovery.explain_runs import list_fitted_parameters
from fdi.discovery.search import Prospect, scan_effects
from fdi.estimation.fit import Fit, follow_population
from fdi.estimation.likelihood import scale_noise
from fdi.estimation.unidentifiable import linearise_across, start_fit
from fdi.estimation.unknowns import UNREPLAYED, complete_model
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    FITTED_RUN_WORST,
    FURTHER_EFFECT_SHARE,
    GAIN_CONVINCES,
    GAIN_TIE,
    GAIN_WORTH_A_FIT,
    INTERVAL_95_SD,
    WEIGHT_COUNTS,
)
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE
from plant.model import Model, list_searched_effects
from plant.threads import R, T, map_in_threads

Floats = NDArray[np.float64]

def find_effects_beside(model: Model, trace: Trace, alone: Refinement, floor: Mapping[str, float],
                        progress: Progress = ignore_progress, workers: int = 2, whole: Trace | None = None) -> Beside:
    """The valve faults beside the other effects that a recording shows.

    Args:
        model: the unit as delivered.
        trace: the run, prepared for replay.
        alone: the faults fitted without another effect.
        floor: RMS noise by signal, SI.
        progress: called with each stage and the share done, 0 to 1.
        workers: threads.
        whole: the recording that `trace` was cut from: fits are judged on it.
    """
    marks, floor = _read_marks(model, whole or trace, floor)
    problem = make_joint_problem(model, trace, floor, workers)
    search = JointSearch(problem, list_other_effects(model), model, progress)
    fits = search.find_explanations(alone.fit)
    explanations = [_explain(effects, fit, search.problem, whole) for effects, fit in fits]
    return average_explanations(explanations, marks)


def list_other_effects(model: Model) -> list[str]:
    """The effects that are searched: all that a replay shows, but for those that every fit of the faults has."""
    always = {CLOGGING.name, FRICTION.name, *(s.effect for s in SUSPECTS), *model.effects}
    return [e.name for e in list_searched_effects(model.plant)
            if e.name not in always and e.port not in UNREPLAYED and e.starts]


def make_joint_problem(model: Model, trace: Trace, floor: Mapping[str, float], workers: int = 2) -> CountedProblem:
    """The run, and the model with the whole catalogue ready in it."""
    problem = make_problem(model, trace, floor, workers)
    return replace(problem, bare=problem.model, model=complete_model(problem.model), _lanes={})


def _read_marks(model: Model, trace: Trace, floor: Mapping[str, float]
                ) -> tuple[dict[str, dict[str, Estimate]], dict[str, float]]:
    """Effects that are read off without noise, and the floors with the rounding of the position among them."""
    marks, floor = find_marks(model, [trace]), dict(floor)
    if marks.step and "quantisation" not in model.effects:
        floor["xj"] = max(floor["xj"], float(np.hypot(model["sensors.position_noise"], marks.rounding)))
    return {p.effect: {name: Estimate(*of) for name, of in p.parameters.items()} for p in marks.prints}, floor


def _explain(effects: tuple[str, ...], fit: Fit, problem: CountedProblem, whole: Trace | None) -> Explanation:
    values = {name: Estimate(v.value, v.low, v.high) for effect in effects
              for name, v in list_fitted_parameters(effect, fit, problem.model).items()}
    return Explanation(effects, values, replace(report_fit(fit, problem, whole), worst=FITTED_RUN_WORST))


# factor on the noise and generations of a search by a population
POPULATION_STAGES = ((100.0, 30), (30.0, 40), (6.0, 40), (1.0, 40))

Named = tuple[tuple[str, ...], Fit]
"""Effects beside the faults, and the fit with them."""


class JointSearch:
    """The state of one search: the problem with its noise, and the effects to try."""

    def __init__(self, problem: CountedProblem, effects: Sequence[str], model: Model, progress: Progress) -> None:
        self.problem, self.effects, self.model, self.progress = problem, list(effects), model, progress

    def find_explanations(self, alone: Fit, most_effects: int = 2) -> list[Named]:
        """Fits with 0, 1 .. other effects that may be the answer, taken to the end with one noise.

        Fits are compared only when they have gone equally far: one that has just begun has the cost of the stops that
        it still misses, and a rival that has been fitted to the end beats it although it is wrong.
        """
        free = list_unknowns(self.model)
        begun = self.descend(replace(alone, free=free), ((1.0, 2),))
        parents: list[Named] = [((), begun)]
        found = self.deepen(parents)
        for count in range(1, most_effects + 1):
            self.progress(f"looking for effect {count} beside the faults", 0.3 * count - 0.1)
            is_enough = is_noise_left(self.problem, found[0][1])
            tried = [each for parent in parents for each in self.add_effects(parent, count, is_enough)]
            if not tried:
                break
            parents = sorted(tried, key=_get_cost)[:4]
            self.progress(f"fitting {', '.join(_describe(effects) for effects, _ in parents)} further", 0.3 * count)
            deep = sorted(self.deepen(parents), key=_get_cost)
            before = min(found, key=_get_cost)
            if count > 1 and not _takes_fair_share(before[1], deep[0][1]):
                break
            found += deep
            if is_noise_left(self.problem, deep[0][1]):
                break
            parents = self.map_alone(lambda each: (each[0], self.descend(each[1], ((1.0, 2),))), deep[:2])
        return self.finish(found)

    def deepen(self, found: Sequence[Named], rounds: int = 8) -> list[Named]:
        """The fits taken further with finer steps; while the best leaves more than noise, they also begin elsewhere."""
        fine = self._refine_steps()
        deep = self.map_alone(lambda each: (each[0], fine.descend(each[1], ((1.0, rounds),))), found)
        if is_noise_left(self.problem, min(deep, key=_get_cost)[1]):
            return deep

        def begin_again(each: Named) -> Named:
            again = fine.restart(each[1], 1.0) if fine.is_near(each[1]) else each[1]
            return each[0], min(each[1], again, key=lambda f: f.cost)

        return self.map_alone(begin_again, deep)

    def _refine_steps(self) -> JointSearch:
        problem = replace(self.problem, steps=FINE_STEPS, _lanes={})
        return JointSearch(problem, self.effects, self.model, self.progress)

    def add_effects(self, parent: Named, count: int, is_enough: bool) -> list[Named]:
        """The parent with one more effect each: the promising ones fitted; `is_enough`: the faults leave noise only."""
        present, fit = parent
        effects = [e for e in self.effects if e not in present and not _excludes(e, present)]
        prospects = [self.scan(fit, effects, fit.cost)]
        if count == 1:
            # The forecast from a start that nobody has fitted is poor beside a finished fit. Where that fit leaves more
            # than noise, a fault may have made up for the effect in it, so both lists count, each by itself.
            afresh = self.start_afresh()
            prospects.append(self.scan(afresh, effects, fit.cost if is_enough else np.inf))
            if not is_enough:
                prospects.append(self.scan_with_more_noise(afresh, effects))
        mixed = [p for group in zip_longest(*prospects) for p in group if p is not None]  # the best of each in turn
        most = 8 if is_enough else 10
        worth = mixed[:most if count == 1 else 5]
        if not worth:
            return []
        named = ", ".join(dict.fromkeys(p.effect for p in worth))
        self.progress(f"fitting {named}", 0.3 * count - 0.05)
        begun = self.map_alone(self._begin_fit, worth)
        begun = sorted(begun, key=lambda f: f.cost)[:4]
        fits = self.map_alone(lambda f: self.descend(f, ((3.0, 3), (1.0, 6))), begun)
        best: dict[str, Named] = {}
        for each in sorted(fits, key=lambda f: f.cost):
            best.setdefault(self._name_added(each, present), ((*present, self._name_added(each, present)), each))
        return list(best.values())

    def scan(self, fit: Fit, effects: Sequence[str], most: float) -> list[Prospect]:
        """The effects that promise to gain on this fit and to come below the cost `most`, best first."""
        least = min(fit.cost, most) - GAIN_WORTH_A_FIT
        return [p for p in scan_effects(self.problem, fit, effects, self.problem.workers) if p.cost < least]

    def scan_with_more_noise(self, fit: Fit, effects: Sequence[str], factor: float = 30.0, rounds: int = 4
                             ) -> list[Prospect]:
        """The effects that promise to gain on this fit when the noise is taken for so many times as large.

        Priors then hold the tolerances, and stops of the ram that are made or missed hardly count: what is left is the
        course of the signals, in which an effect shows although no fit without it comes near them.
        """
        loud = JointSearch(scale_noise(self.problem, factor), effects, self.model, self.progress)
        return loud.scan(loud.descend(fit, ((1.0, rounds),)), effects, np.inf)

    def start_afresh(self) -> Fit:
        """A unit with the best pair of faults and no other deviation: an effect may lead fits into a local minimum."""
        free = list_unknowns(self.model)
        x = choose_start(self.problem, free, COARSE_STARTS)
        return linearise_across(self.problem, free, x, guess_first_covariance(free), find_flat(self.alone, free, x))

    def finish(self, found: Sequence[Named]) -> list[Named]:
        """The likely ones to the end with finer steps, under the noise that the best one leaves."""
        ranked = sorted(found, key=lambda each: each[1].cost + GAIN_CONVINCES * len(each[0]))
        near = 60.0 * GAIN_TIE  # such fits are not done: beginning again has gained a few hundred
        close = [each for each in ranked if each[1].cost < ranked[0][1].cost + near][:4]
        self.progress(f"last fits, {', '.join(_describe(effects) for effects, _ in close)}", 0.75)
        fine = self._refine_steps()
        self.problem = learn_left_noise(fine.problem, ranked[0][1])
        done = self.map_alone(lambda each: (each[0], self.descend(each[1], ((1.0, 8),))), close)
        best = min(done, key=_get_cost)
        if len(best[0]) > 1:
            self.progress(f"last fits without one of {_describe(best[0])}", 0.85)
            done += self.map_alone(lambda effect: self._leave_out(best, effect), best[0])
        alike: dict[frozenset[str], Named] = {}
        for each in sorted(done, key=_get_cost):
            alike.setdefault(frozenset(each[0]), each)
        return self._search_other_valleys(self._begin_again(list(alike.values())))

    def _search_other_valleys(self, done: Sequence[Named], most: int = 2) -> list[Named]:
        """The fits, the likeliest of them also from searches by populations while none leaves only noise.

        Where static friction of the ram ends far off, no start on the way to a healthy unit leads out of that valley:
        the frictions have to move together (`fdi.estimation.fit`).
        """
        done = list(done)
        ranked = sorted(done, key=lambda each: each[1].cost + GAIN_CONVINCES * len(each[0]))
        worst = 1.5  # times the least cost, above which no valley is looked for
        for each in [one for one in ranked if one[1].cost < worst * ranked[0][1].cost][:most]:
            if any(is_noise_left(self.problem, fit) for _, fit in done):
                break
            effects, fit = each
            self.progress(f"search of other valleys, {_describe(effects)}", 0.95)
            found = self.map_alone(partial(self.search_widely, fit), (0, 1))
            done[done.index(each)] = (effects, min(fit, *found, key=lambda f: f.cost))
        return done

    def search_widely(self, fit: Fit, seed: int, steps: int = 10) -> Fit:
        """The fit at which a population ends that begins at a unit with these faults and effects, otherwise healthy.

        The population takes so many solver steps a cycle; its end is fitted with those of the problem.
        """
        def descend_coarsely(problem: CountedProblem, fit: Fit, rounds: int, factor: float = 1.0) -> Fit:
            return descend(problem, fit, ((factor, rounds),), self.alone)

        coarse = replace(self.alone, steps=steps)
        home = self._place_home(fit)
        begun = descend_coarsely(coarse, replace(fit, x=home), 3, POPULATION_STAGES[0][0])
        width = 0.1  # of a population's first trials along a friction of ram or spool, of its logarithm
        frictions = np.array([width / f.scale if f.name.endswith("_friction") and f.name.startswith(("jack.", "spool."))
                              else 0.0 for f in fit.free])
        spread = 9.0 * begun.covariance + np.diag(frictions**2)
        begun = replace(begun, x=np.where(frictions > 0.0, home, begun.x))
        end = follow_population(coarse, begun, spread, POPULATION_STAGES, seed, descend_coarsely)
        return self.descend(end, ((1.0, 8),))

    def _begin_again(self, done: Sequence[Named], most: int = 2) -> list[Named]:
        """The fits, the best of them also from other places; again as long as that changes which is best."""
        done, tried = list(done), set[tuple[str, ...]]()
        while len(tried) < most:
            best = min(done, key=lambda each: each[1].cost + GAIN_CONVINCES * len(each[0]))
            if best[0] in tried or not self.is_near(best[1]):
                break
            tried.add(best[0])
            self.progress(f"another start, {_describe(best[0])}", 0.85 + 0.05 * len(tried))
            again = self.map_alone(partial(self.restart, best[1]), (1.0, 0.5))
            done[done.index(best)] = (best[0], min([best[1], *again], key=lambda f: f.cost))
        return done

    def _leave_out(self, named: Named, effect: str) -> Named:
        """The fit without one of its effects: the search may have needed it only to leave a local minimum."""
        effects, fit = named
        dropped = set(CATALOGUE[effect].fitted)
        kept = [k for k, f in enumerate(fit.free) if f.name not in dropped]
        begun = start_fit([fit.free[k] for k in kept], fit.x[kept])
        return tuple(e for e in effects if e != effect), self.descend(begun, ((3.0, 4), (1.0, 8)))

    def is_near(self, fit: Fit, far: float = 7.0) -> bool:
        """Whether a fit leaves so little that beginning again elsewhere may help."""
        return max(measure_ratios(self.problem, fit)) < far

    def restart(self, fit: Fit, part: float) -> Fit:
        """The fit from a point on the line to a unit with these faults and effects and no other deviation."""
        begun = start_fit(fit.free, fit.x + part * (self._place_home(fit) - fit.x))
        return self.descend(begun, ((6.0, 4), (1.0, 8)))

    def _place_home(self, fit: Fit) -> Floats:
        """Scaled unknowns, (p,), of a unit with a fit's faults and effects and no other deviation."""
        home = make_start(fit.free, 0.0, FRICTION.healthy, estimate_offsets(self.problem))
        kept = [f.name in FAULT_PARAMETERS or not np.isfinite(f.prior) for f in fit.free]
        home[kept] = fit.x[kept]
        return home

    @property
    def alone(self) -> CountedProblem:
        """The problem for one thread."""
        return replace(self.problem, workers=1, _lanes={})

    def descend(self, fit: Fit, schedule: Sequence[tuple[float, int]]) -> Fit:
        """The fit after rounds with the noise so many times as large: (factor, rounds) each."""
        return descend(self.alone, fit, schedule)

    def map_alone(self, do: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """By all threads; each fit keeps to one of them."""
        return map_in_threads(do, items, self.problem.workers)

    def _begin_fit(self, p: Prospect) -> Fit:
        """Begin at the scan's linear forecast, with the noise first taken for larger."""
        return self.descend(start_fit(p.free, p.x), (NOISE_SCHEDULE[1], (1.0, 3)))

    def _name_added(self, fit: Fit, present: Sequence[str]) -> str:
        names = {f.name for f in fit.free}
        return next(e for e in self.effects if e not in present and set(CATALOGUE[e].fitted) & names)


def _get_cost(each: Named) -> float:
    return each[1].cost


def _describe(effects: Sequence[str]) -> str:
    return " and ".join(effects) or "the faults alone"


def _excludes(effect: str, present: Sequence[str]) -> bool:
    return any(effect in CATALOGUE[e].excludes or e in CATALOGUE[effect].excludes for e in present)


def _takes_fair_share(before: Fit, after: Fit) -> bool:
    """Whether an effect takes away a fair part of what was left: less is what fits win by luck."""
    noise = float(np.count_nonzero(before.white))
    return before.cost - after.cost >= FURTHER_EFFECT_SHARE * (before.cost - noise)


@dataclass(frozen=True, eq=False)
class Explanation:
    """The two faults fitted beside some other effects."""

    effects: tuple[str, ...]  # () for the faults alone
    parameters: Mapping[str, Estimate]  # of these effects, by name, SI
    refinement: Refinement
    weight: float = 1.0  # probability among all explanations

    @property
    def sizes(self) -> dict[str, Estimate]:
        """Both faults, by name."""
        return self.refinement.sizes

    @property
    def levels(self) -> dict[str, Level | None]:
        """Levels that this explanation alone would give, by fault."""
        return {fault.name: judge_size(fault, self.sizes[fault.name]) for fault in FAULTS}


@dataclass(frozen=True, eq=False)
class Beside:
    """Explanations of a recording by the faults and other effects, with sizes averaged over them."""

    explanations: tuple[Explanation, ...]  # best first; those that are not much less likely than the best
    sizes: Mapping[str, Estimate]  # of both faults, by name, averaged
    marks: Mapping[str, Mapping[str, Estimate]]  # effects that leave a mark without noise, with their parameters
    disputed: tuple[str, ...]  # faults whose level depends on which explanation is right

    @property
    def best(self) -> Explanation:
        """The most likely one."""
        return self.explanations[0]

    @property
    def is_explained(self) -> bool:
        """Whether the best one leaves only noise."""
        return self.best.refinement.is_explained

    @property
    def effects(self) -> tuple[str, ...]:
        """Every effect that may be there, most likely first."""
        return tuple(dict.fromkeys([*self.marks, *(e for x in self.explanations for e in x.effects)]))

    @property
    def is_ambiguous(self) -> bool:
        """Whether the recording does not tell which of several effects is there."""
        return len(self.explanations) > 1


def average_explanations(found: Sequence[Explanation], marks: Mapping[str, Mapping[str, Estimate]] | None = None
                         ) -> Beside:
    """The explanations with their probabilities, and the sizes averaged over them.

    One that leaves more than noise does not count beside one that does not.
    """
    explained = [each for each in found if each.refinement.is_explained] or [min(found, key=_compute_charged_cost)]
    weights = weigh_costs([_compute_charged_cost(each) for each in explained])
    counted = sorted((pair for pair in zip(weights, explained, strict=True) if pair[0] >= WEIGHT_COUNTS),
                     key=lambda pair: -pair[0])
    total = sum(weight for weight, _ in counted)
    kept = tuple(Explanation(e.effects, e.parameters, e.refinement, weight / total) for weight, e in counted)
    sizes = {f.name: mix_estimates([e.sizes[f.name] for e in kept], [e.weight for e in kept]) for f in FAULTS}
    return Beside(kept, sizes, marks or {}, tuple(f.name for f in FAULTS if _is_disputed(f, kept)))


def weigh_costs(costs: Sequence[float]) -> list[float]:
    """Probabilities of explanations with these costs, -2 log likelihood with their charges.

    Within `GAIN_TIE` of the best they are equally likely: fits that end in rough valleys do not tell more.
    """
    likely = [math.exp(-0.5 * min(max(cost - min(costs) - GAIN_TIE, 0.0), 700.0)) for cost in costs]
    return [each / sum(likely) for each in likely]


def _compute_charged_cost(e: Explanation) -> float:
    """-2 log likelihood, and for each effect what it has to gain to be named."""
    return e.refinement.fit.cost + GAIN_CONVINCES * len(e.effects)


def mix_estimates(estimates: Sequence[Estimate], weights: Sequence[float]) -> Estimate:
    """The mean of some estimates, and the 95 % interval of the mixture of their distributions.

    >>> mix_estimates([Estimate(0.2, 0.1, 0.3)], [1.0])
    Estimate(value=0.2, low=0.1, high=0.3)
    >>> [round(x, 2) for x in mix_estimates([Estimate(0.1, 0.0, 0.2), Estimate(0.5, 0.4, 0.6)], [0.5, 0.5])]
    [0.3, 0.02, 0.58]
    """
    if len(estimates) == 1:
        return estimates[0]
    from scipy.special import ndtr  # here: half a second to import, and most diagnoses need none of it

    centre = np.array([e.value for e in estimates])
    below, above = (np.array([max(abs(end - e.value), 1e-9 * abs(e.value) + 1e-300) / INTERVAL_95_SD
                              for end, e in zip(ends, estimates, strict=True)])
                    for ends in ([e.low for e in estimates], [e.high for e in estimates]))
    low, high = min(e.low for e in estimates), max(e.high for e in estimates)
    width = high - low
    grid = np.linspace(low - width, high + width, 4001)
    distance = grid[:, None] - centre
    share = ndtr(distance / np.where(distance < 0.0, below, above)) @ np.asarray(weights)
    ends = [float(np.interp(p, share, grid)) for p in (0.025, 0.975)]
    value = float(centre @ np.asarray(weights))
    return Estimate(value, max(min(ends[0], value), low), min(max(ends[1], value), high))


def _is_disputed(fault: Fault, explanations: Sequence[Explanation]) -> bool:
    """Whether explanations that contradict each other in the size give different levels."""
    def contradict(first: Explanation, second: Explanation) -> bool:
        a, b = first.sizes[fault.name], second.sizes[fault.name]
        return not b.low <= a.value <= b.high and not a.low <= b.value <= a.high

    return any(contradict(first, second) and first.levels[fault.name] != second.levels[fault.name]
               for first, second in combinations(explanations, 2))
