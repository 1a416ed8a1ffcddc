"""Which effects are missing: scan, fit, look at what is left, and once more for the next effect."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.discovery.scan import Prospect, scan_effects
from fdi.estimation import noise as noises
from fdi.estimation.final_rounds import finish_fit
from fdi.estimation.fit import Fit, continue_fit, fit_unknowns, linearise
from fdi.estimation.likelihood import Free, Problem, compute_misfit, scale_noise
from fdi.estimation.long_recordings import Excerpt, Judgement, choose_excerpt, judge_on_all
from fdi.estimation.noise import Noise
from fdi.estimation.population import follow_population
from fdi.estimation.unknowns import complete_model, list_all_unknowns, silence_readings, turn_amplitudes_positive
from fdi.progress import NO_STAGE, Progress, ignore_progress
from fdi.thresholds import (
    GAIN_DOUBTFUL,
    GAIN_WORTH_A_FIT,
    RESIDUAL_IS_NEAR_NOISE,
    RESIDUAL_IS_NOISE,
    TOLERANCE_SQUARE_FAR,
    WHITE_SQUARE_POOR,
)
from fdi.trace.signals import OUTPUTS, SIGNALS
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE
from plant.model import Model
from plant.threads import R, T, count_threads, map_in_threads

Floats = NDArray[np.float64]

FITTED = 8  # effects of a scan that get a full fit
RACE = ((3, 8), (4, 4), (8, 2))  # rounds for the so many best, stage by stage
BEAM = 3  # hypotheses from which the next missing effect is looked for
EASED = (30.0, 6.0)  # times the noise, stage by stage
VALLEY_STAGES = ((30.0, 20), (6.0, 20), (2.0, 20), (1.0, 30))  # times the noise, and generations


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Effects that may be missing, fitted; `ratio` says how far above the floor what is left of each signal is."""

    effects: tuple[str, ...]
    fit: Fit
    errors: dict[str, float]  # RMS residual, SI
    repeated: dict[str, float] = field(default_factory=dict)  # RMS residual on the repeats
    ratio: dict[str, float] = field(default_factory=dict)  # error that repeats, over the floor; 1 = only noise
    repeat_cost: float = 0.0
    others: tuple[Floats, ...] = ()  # residuals (s, n) on the repeats
    judgement: Judgement | None = None  # on all of the recording, where the fit's run is cut from a longer one

    @property
    def is_at_floor(self) -> bool:
        """True when nothing but noise is left."""
        return max(self.ratio.values()) <= RESIDUAL_IS_NOISE

    @property
    def is_near_floor(self) -> bool:
        """True when little more than noise is left, or noise alone."""
        return max(self.ratio.values()) <= RESIDUAL_IS_NEAR_NOISE

    @property
    def is_poor(self) -> bool:
        """True when the fit leaves more than the noise that it was made with: it may have ended in a local minimum."""
        return bool(self.fit.misfit > WHITE_SQUARE_POOR * np.count_nonzero(self.fit.white))

    @property
    def is_far(self) -> bool:
        """True when few healthy units have such tolerances: it may have ended far off in a valley."""
        known = np.isfinite([f.prior for f in self.fit.free]).sum()
        return bool(self.tolerance_cost > TOLERANCE_SQUARE_FAR * known)

    @property
    def cost(self) -> float:
        """Robust sum of squares on the fit's run, with priors."""
        return self.fit.cost

    @property
    def tolerance_cost(self) -> float:
        """The part of the cost that says how far the tolerances are from a healthy unit: their squares over priors."""
        return self.fit.cost - self.fit.misfit


class WholeRuns(NamedTuple):
    """The recordings that the runs of a search were cut from."""

    est: Trace
    repeats: tuple[Trace, ...]


def choose_search_excerpt(model: Model, trace: Trace, effects: Iterable[str], progress: Progress = ignore_progress
                          ) -> Excerpt:
    """The part of a long recording that says most about the tolerances and these effects at a usual size."""
    starts = [CATALOGUE[name].starts for name in effects]
    changes = [each[len(each) // 2] for each in starts if each]
    floor = {name: f.value for name, f in noises.sensor_floors(trace, model).items()}
    return choose_excerpt(trace, complete_model(model), floor, changes, progress)


class Search:
    """The state of one search: the problem, its noise, every hypothesis tried."""

    whole: WholeRuns | None = None  # None: the runs of the search are whole recordings

    def __init__(self, model: Model, trace: Trace, repeats: Sequence[Trace], effects: Iterable[str],
                 workers: int | None = None) -> None:
        self.workers = workers or count_threads()
        self.sensors = {name: noises.white_noise(model[SIGNALS[name].noise]) for name in OUTPUTS}
        lsb = model.values["quantisation.lsb"] if "quantisation" in model.effects else 0.0
        self.coarse = {"xj": lsb / np.sqrt(12.0)} if lsb else {}  # RMS of rounding, where a signal comes in steps
        self.noise = tuple(noises.add_rounding(self.sensors[s], self.coarse.get(s, 0.0)) for s in trace.outputs)
        self.model, ready = model, complete_model(model)
        bare = silence_readings(model)
        self.problem = Problem(ready, trace, self.noise, workers=1, bare=bare)
        self.repeats = [Problem(ready, r, self.noise, bare=bare) for r in repeats]
        self.fine: Problem | None = None  # with the steps of last residuals
        self.effects = [e for e in effects if e not in model.effects or CATALOGUE[e].base]
        self.stage = NO_STAGE  # of the work: each fit, and each round of a last fit, is a step

    def fit_base(self) -> Hypothesis:
        """The model without a further effect, its tolerances fitted."""
        free = list_all_unknowns(self.model)

        def fit_tolerances(ease: bool) -> Fit:
            return fit_unknowns(self.problem, free, self.find_eased_start(free) if ease else None)

        fits = self.map_parallel(fit_tolerances, (False, True))
        first = self.judge_fit((), min(fits, key=lambda f: f.cost))
        if first.is_at_floor:
            return first
        return self.retry_from(first, [np.where(np.abs(first.fit.x) > 1.0, 0.0, first.fit.x)])

    def find_eased_start(self, free: Sequence[Free], x: Floats | None = None, rounds: int = 4) -> Floats:
        """Where a fit gets to, (p,), that takes the noise for larger at first: priors hold it, small events vanish.

        It begins at `x` (p,), default the centres.
        """
        x = np.zeros(len(free)) if x is None else x
        for factor in EASED:
            x = fit_unknowns(scale_noise(self.problem, factor), free, x, rounds).x
        return x

    def retry_from(self, h: Hypothesis, starts: Iterable[Floats]) -> Hypothesis:
        """The hypothesis from further starts (p,), if one of them ends lower: stick-slip has many valleys."""
        def fit_from(start: Floats) -> Fit:
            return fit_unknowns(self.problem, h.fit.free, start)

        for other in self.map_parallel(fit_from, starts):
            if other.cost < h.cost - 1.0:
                h = self.judge_fit(h.effects, other)
        return h

    def refit_base(self, base: Hypothesis, tried: Sequence[Hypothesis]) -> Hypothesis:
        """The base fitted again from where fits with an effect have left its parameters.

        What an effect gains is then not what the base's own fit had left lying about.
        """
        return self.retry_from(base, self._place_base(base, tried))

    def leave_out_effects(self, base: Hypothesis, h: Hypothesis) -> Hypothesis:
        """The base with its unknowns where another hypothesis has them, or as it is if that leaves more.

        Near its end a fit steps over ridges by luck: what is left there without the effect is not the effect's gain.
        """
        (start,) = self._place_base(base, [h])
        other = self.judge_fit((), linearise(self.fine or self.problem, base.fit.free, start))
        return min(base, other, key=lambda each: each.cost)

    def _place_base(self, base: Hypothesis, tried: Sequence[Hypothesis]) -> list[Floats]:
        """The base's unknowns, (p,) each, where fits with an effect have left them; at 0 those at a bound."""
        starts = []
        for h in tried:
            values = h.fit.values
            starts.append(np.array([(values[f.name] - f.centre) / f.scale if f.low < values[f.name] < f.high else 0.0
                                    for f in base.fit.free]))
        return starts

    def add_each_effect(self, start: Hypothesis, fitted: int = FITTED) -> list[Hypothesis]:
        """`start` with one more effect: the promising ones fitted, best first."""
        effects = [e for e in self.effects if e not in start.effects and not self._is_excluded(e, start.effects)]
        prospects = scan_effects(self.problem, start.fit, effects, self.workers)
        if not start.effects:  # a fit that had to do without a large effect may sit in a wrong basin
            nominal = linearise(self.problem, start.fit.free, np.zeros(len(start.fit.free)))
            prospects = _merge_prospects(prospects, scan_effects(self.problem, nominal, effects, self.workers))
        worth = [p for p in prospects if p.cost < start.cost - GAIN_WORTH_A_FIT][:fitted]
        fits = list(zip([p.effect for p in worth], self.map_parallel(self._begin_fit, worth), strict=True))
        for rounds, kept in RACE:
            fits.sort(key=lambda each: each[1].cost)
            fits[:kept] = self.map_parallel(partial(self._continue_begun_fit, rounds), fits[:kept])
        done = self.map_parallel(lambda each: self.judge_fit((*start.effects, each[0]), each[1]), fits)
        ranked = sorted(done, key=lambda h: h.cost)
        if ranked and not ranked[0].is_at_floor:
            x = ranked[0].fit.x
            has_prior = np.array([np.isfinite(f.prior) for f in ranked[0].fit.free])
            ranked[0] = self.retry_from(ranked[0], [np.where(has_prior & (np.abs(x) > 1.0), 0.0, x)])
        return ranked

    def add_each_with_more_noise(self, start: Hypothesis, tried: Sequence[Hypothesis], fitted: int = 6
                                 ) -> list[Hypothesis]:
        """`start` with one more effect each, chosen and fitted with the noise first taken for larger; best first.

        Where the fit of `start` has ended in a local minimum, a scan believes what that fit tells it, and fits begin
        there. With more noise the tolerances stay near a healthy unit, and an effect is judged by the course of the
        signals. The best two effects that have been `tried` are fitted in any case.
        """
        effects = [e for e in self.effects if e not in start.effects and not self._is_excluded(e, start.effects)]
        loud = scale_noise(self.problem, EASED[0])
        own = np.where([np.isfinite(f.prior) for f in start.fit.free], 0.0, start.fit.x)
        begun = fit_unknowns(loud, start.fit.free, own, 4)
        prospects = scan_effects(loud, begun, effects, self.workers)
        known = {h.effects[-1] for h in tried[:2]}
        least = GAIN_WORTH_A_FIT / EASED[0] ** 2  # gains shrink with the square of the noise
        starts = [p for rank, p in enumerate(p for p in prospects if p.cost < begun.cost - least)
                  if rank < fitted or p.effect in known]

        def begin_eased(p: Prospect) -> tuple[str, Fit]:
            has_prior = np.array([np.isfinite(f.prior) for f in p.free])
            x = self.find_eased_start(p.free, np.where(has_prior, 0.0, p.x))
            return p.effect, fit_unknowns(self.problem, p.free, x, 3)

        fits = sorted(self.map_parallel(begin_eased, starts), key=lambda each: each[1].cost)
        fits = self.map_parallel(partial(self._continue_begun_fit, 9), fits[:3])
        done = [self.judge_fit((*start.effects, effect), fit) for effect, fit in fits]
        return sorted(done, key=lambda h: h.cost)

    def search_widely(self, h: Hypothesis, seed: int = 0) -> Hypothesis:
        """A hypothesis, or where a population ends that begins at a unit with its effects and no other deviation.

        Stick-slip makes the cost rough, and two effects share many local minima (`fdi.estimation.population`).
        """
        free = h.fit.free
        has_prior = np.isfinite([f.prior for f in free])
        home = np.where(has_prior, 0.0, h.fit.x)

        def descend(problem: Problem, fit: Fit, rounds: int, factor: float) -> Fit:
            return fit_unknowns(scale_noise(problem, factor), free, fit.x, rounds)

        begun = fit_unknowns(scale_noise(self.problem, 100.0), free, home, 4)
        width = np.where(has_prior, 0.5, 0.1 * np.maximum(np.abs(begun.x), 0.1))
        end = follow_population(self.problem, begun, np.diag(width**2), VALLEY_STAGES, seed, descend)
        other = self.judge_fit(h.effects, fit_unknowns(self.problem, free, end.x))
        return min(h, other, key=lambda each: each.cost + each.repeat_cost)

    def drop_each_effect(self, h: Hypothesis) -> list[Hypothesis]:
        """The hypothesis with one of its effects taken out, each of them, fitted from where it is; best first."""
        usual = {f.name: f for f in list_all_unknowns(self.model)}

        def fit_without(gone: str) -> Hypothesis:
            own = set(CATALOGUE[gone].fitted)
            free = [usual.get(f.name) if f.name in own else f for f in h.fit.free]
            kept = [f for f in free if f is not None]
            x = [(h.fit.values[f.name] - f.centre) / f.scale for f in kept]
            inside = np.array([v if f.name not in own or f.low < h.fit.values[f.name] < f.high else 0.0
                               for f, v in zip(kept, x, strict=True)])
            return self.judge_fit(tuple(e for e in h.effects if e != gone), fit_unknowns(self.problem, kept, inside))

        return sorted(self.map_parallel(fit_without, h.effects), key=lambda each: each.cost)

    def map_parallel(self, do: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """By all threads; what runs in one of them keeps to itself, as `problem` has one worker until `refine`."""
        def do_step(item: T) -> R:
            found = do(item)
            self.stage.finish_step()
            return found

        return map_in_threads(do_step, items, self.workers)

    def _continue_begun_fit(self, rounds: int, each: tuple[str, Fit]) -> tuple[str, Fit]:
        return each[0], each[1] if each[1].converged else continue_fit(self.problem, each[1], rounds)

    def _begin_fit(self, p: Prospect) -> Fit:
        """Begin at the scan's linear forecast, or with all but the effect left where it was, if that is better."""
        own = np.isin([f.name for f in p.free], CATALOGUE[p.effect].fitted)
        starts = np.array([p.x, np.where(own, p.x, 0.0)])
        prior = np.array([f.prior**-2 for f in p.free])
        costs = compute_misfit(self.problem.compute_white_residuals(p.free, starts)) + (starts**2) @ prior
        return linearise(self.problem, p.free, starts[int(np.argmin(costs))])

    def _is_excluded(self, effect: str, present: Sequence[str]) -> bool:
        return any(effect in CATALOGUE[e].excludes or e in CATALOGUE[effect].excludes for e in present)

    def judge_fit(self, effects: tuple[str, ...], found: Fit) -> Hypothesis:
        """What a fit leaves, on its own run and on the repeats."""
        signals = self.problem.trace.outputs
        own = found.residuals[:, :len(self.problem.trace)]  # the first run of a fit to several
        errors = _measure_rms(own, signals)
        coarse = [self.coarse.get(s, 0.0) for s in signals]
        x = found.x[None, :]
        others = [p.compute_residuals(found.free, x)[0] for p in self.repeats]
        if not others:
            floor = {s: float(np.hypot(n.level, c)) for s, n, c in zip(signals, self.noise, coarse, strict=True)}
            return Hypothesis(effects, found, errors, {}, {s: errors[s] / floor[s] for s in signals})
        pairs = zip(self.repeats, others, strict=True)
        cost = float(np.mean([compute_misfit(p.whiten_residuals(r[None]))[0] for p, r in pairs]))
        repeated = {s: float(np.sqrt(np.mean([_measure_rms(r, signals)[s] ** 2 for r in others]))) for s in signals}
        ratio = dict(zip(signals, measure_repeating(own, others, coarse), strict=True))
        return Hypothesis(effects, found, errors, repeated, ratio, cost, tuple(others))

    def judge_on_all(self, hypotheses: Sequence[Hypothesis], steps: int) -> list[Hypothesis]:
        """The hypotheses with their errors on all of the recordings that the runs were cut from.

        Its ratio is that of all of the recording, or that of the part where it holds on all of the recording.
        """
        if self.whole is None:
            return list(hypotheses)
        floor = self.estimate_floor(hypotheses[-1])
        fits = [h.fit for h in hypotheses]
        runs = [judge_on_all(self.problem, fits, run, steps) for run in (self.whole.est, *self.whole.repeats)]
        out = []
        for h, own, *others in zip(hypotheses, *runs, strict=True):
            errors = own.errors
            repeated = {s: float(np.sqrt(np.mean([o.errors[s] ** 2 for o in others]))) for s in errors if others}
            ratio = {s: min(x, errors[s] / floor[s]) for s, x in h.ratio.items()}
            if not all(j.holds(floor) for j in (own, *others)):
                left = [j.typical_ratio(floor) for j in (own, *others)]
                ratio = {s: max(x, *(each[s] for each in left)) for s, x in h.ratio.items()}
            out.append(replace(h, errors=errors, repeated=repeated, ratio=ratio, judgement=own))
        return out

    def learn_noise(self, best: Hypothesis) -> None:
        """Take the noise from what differs between the runs under the best hypothesis."""
        self.noise = tuple(learn_noise(best, self.problem.trace, self.noise))
        self.problem = replace(self.problem, noise=self.noise)
        self.repeats = [replace(p, noise=self.noise) for p in self.repeats]

    def estimate_floor(self, best: Hypothesis) -> dict[str, float]:
        """What the sensors' noise alone leaves of each signal, RMS SI, under the best hypothesis."""
        found = learn_noise(best, self.problem.trace, self.noise)
        return {s: float(np.hypot(n.level, self.coarse.get(s, 0.0)))
                for s, n in zip(self.problem.trace.outputs, found, strict=True)}

    def refit_hypothesis(self, h: Hypothesis, rounds: int = 4) -> Hypothesis:
        """A hypothesis refitted with the noise, the steps and the runs as they are now."""
        return self.judge_fit(h.effects, fit_unknowns(self.problem, h.fit.free, h.fit.x, rounds))

    def finish_hypothesis(self, h: Hypothesis, rounds: int = 5) -> Hypothesis:
        """A hypothesis taken to the end, with a covariance that its intervals can rest on."""
        begin = turn_amplitudes_positive(h.fit.free, h.fit.x)
        near = fit_unknowns(self.problem, h.fit.free, begin, 2)
        return self.judge_fit(h.effects, finish_fit(self.fine or self.problem, near, rounds, self.problem, self.stage))

    def reaches_floor(self, h: Hypothesis, steps: int, finest: int) -> bool:
        """Whether a hypothesis leaves only noise, if need be with finer steps: a little more may be the solver's error.

        The arguments are those of `refine_steps`.
        """
        if h.is_at_floor or not h.is_near_floor:
            return h.is_at_floor
        finer = copy(self)
        finer.stage = NO_STAGE
        finer.refine_steps(steps, finest)
        return finer.finish_hypothesis(h, 1).is_at_floor

    def begin_again(self, h: Hypothesis, rounds: int = 6) -> Hypothesis:
        """A last fit that may be in a local minimum, or the same effects from a healthy unit if that ends lower.

        Such a fit leaves more than noise, or only noise but far from a healthy unit. The other one is taken to the end
        only if it is not clearly higher after so many rounds.
        """
        if not h.is_poor and not h.is_far:
            return h
        free, prior = h.fit.free, np.array([f.prior**-2 for f in h.fit.free])
        here = float(compute_misfit(self.problem.compute_white_residuals(free, h.fit.x[None]))[0] + h.fit.x**2 @ prior)
        other = fit_unknowns(self.problem, free, np.where(prior > 0.0, 0.0, h.fit.x), rounds)
        if other.cost > here + GAIN_DOUBTFUL:
            return h
        again = self.finish_hypothesis(self.judge_fit(h.effects, other))
        return min(h, again, key=lambda each: each.cost)

    def measure_solver_error(self, h: Hypothesis, floor: Mapping[str, float]) -> float:
        """What half the step changes in a replay, over the floor, in the worst signal."""
        halved = replace(self.problem, steps=2 * self.problem.steps, also=(), _lanes={})
        coarse = replace(self.problem, also=(), _lanes={})
        x = h.fit.x[None]
        change = (halved.compute_residuals(h.fit.free, x) - coarse.compute_residuals(h.fit.free, x))[0]
        typical = np.sqrt([np.nanmean(np.minimum(c**2, np.nanpercentile(c**2, 98.0))) for c in change])
        return max(float(t) / floor[s] for s, t in zip(self.problem.trace.outputs, typical, strict=True))

    def refine_steps(self, steps: int, finest: int) -> None:
        """Finer steps from here on, `finest` where only slopes do not ask for them; fits to the repeats as well."""
        self.problem = replace(self.problem, steps=steps, _lanes={}, also=tuple(p.trace for p in self.repeats),
                               workers=self.workers)
        self.fine = replace(self.problem, steps=finest, _lanes={})
        self.repeats = [replace(p, steps=finest, _lanes={}) for p in self.repeats]


def learn_noise(h: Hypothesis, trace: Trace, before: Sequence[Noise]) -> list[Noise]:
    """Noise of each signal: of the difference between repeats, else of the residual where only noise is left."""
    found = []
    for i, old in enumerate(before):
        if h.others:
            n = min(len(trace), *(o.shape[1] for o in h.others))
            difference = np.concatenate([(h.fit.residuals[i, :n] - o[i, :n]) for o in h.others]) / np.sqrt(2.0)
            found.append(noises.fit_noise(difference))
        else:
            found.append(noises.fit_noise(h.fit.residuals[i]) if h.is_at_floor else old)
    return found


def measure_repeating(residual: Floats, others: Sequence[Floats], coarse: Sequence[float]) -> list[float]:
    """What repeats in residuals (s, n) of runs of one command, as total over noise: 1 where only noise is left.

    Independent noise of any colour averages out of the product of two runs; physics that is missing does not.
    Rounding, `coarse` (s,) RMS, repeats where the ram rests: it is taken for noise.
    """
    ratios = []
    for own, rounding, i in zip(residual, coarse, range(len(residual)), strict=True):
        n = min(len(own), *(o.shape[1] for o in others))
        shared = float(np.mean([np.nanmean(own[:n] * o[i, :n]) for o in others]))
        different = np.concatenate([own[:n] - o[i, :n] for o in others]) / np.sqrt(2.0)
        noise = noises.measure_level(different) ** 2 + rounding**2 + 1e-300
        ratios.append(float(np.sqrt(max(1.0 + (shared - rounding**2) / noise, 0.0))))
    return ratios


def _measure_rms(residuals: Floats, signals: Sequence[str]) -> dict[str, float]:
    return {s: float(np.sqrt(np.nanmean(r**2))) for s, r in zip(signals, residuals, strict=True)}


def _merge_prospects(a: Sequence[Prospect], b: Sequence[Prospect]) -> list[Prospect]:
    best = {p.effect: p for p in a}
    for p in b:
        if p.effect not in best or p.cost < best[p.effect].cost:
            best[p.effect] = p
    return sorted(best.values(), key=lambda p: p.cost)
