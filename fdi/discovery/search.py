"""Which effects are missing: scan, fit, look at what is left, and once more for the next effect."""
from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from fdi.estimation import (
    BLOCK,
    Excerpt,
    Fit,
    Free,
    Judgement,
    Noise,
    Problem,
    choose_excerpt,
    complete_model,
    compute_misfit,
    continue_fit,
    cut_blocks,
    cut_runs,
    find_fewest_steps,
    find_undecided_rows,
    find_unpredictable_rows,
    finish_fit,
    fit_unknowns,
    follow_population,
    is_long,
    judge_on_all,
    leave_out_rest,
    leave_out_rows,
    linearise,
    list_active_effects,
    list_all_unknowns,
    list_directions,
    list_effect_unknowns,
    list_powers,
    measure_decided_errors,
    name_sine,
    noise as noises,
    place_in_healthy_unit,
    replay_fit,
    scale_noise,
    scale_to,
    scale_together,
    scaled_bounds,
    silence_readings,
    span_all_rows,
    start_fit,
    sum_blocks,
    take_curved_step,
    take_steps,
    turn_amplitudes_positive,
    weigh_blocks,
    weigh_priors,
)
from fdi.progress import NO_STAGE, Progress, ignore_progress
from fdi.thresholds import (
    BLOCK_FITTED_SQUARE,
    GAIN_DOUBTFUL,
    GAIN_SEEN,
    GAIN_WORTH_A_FIT,
    LOOKS_ALIKE,
    NULL_DRAWS,
    QUIETEST_NOISE,
    RESIDUAL_IS_NEAR_NOISE,
    RESIDUAL_IS_NOISE,
    SOLVER_ERROR_SHARE,
    WHITE_SQUARE_POOR,
)
from fdi.trace import Flags, Floats, Trace, rms
from plant import Model, Part, count_threads, map_together
from plant.threads import R, T

FITTED = 8  # effects of a scan that get a full fit
RACE = ((3, 8), (4, 4), (8, 2))  # rounds for the so many best, stage by stage
FINE = 20  # steps a cycle of the last fits
TRUEST = 100  # at least, for what the last fits are led by, and of runs that they never saw; slopes do with less
UNUSUAL_SD = 2.0  # standard deviations of a tolerance, from which on an effect may have moved it
TAKEN_BACK = (0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0)  # shares of far tolerances that are left
EASED = (30.0, 6.0)  # times the noise, stage by stage
VALLEY_STAGES = ((30.0, 20), (6.0, 20), (2.0, 20), (1.0, 30))  # times the noise, and generations


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Effects that may be missing, fitted; `ratio` says how far above the floor what is left of each signal is."""

    effects: tuple[str, ...]
    fit: Fit
    errors: dict[str, float]  # RMS residual, SI
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
        """True when few healthy units have such tolerances: it ended far off in a valley, or lacks an effect."""
        return self.fit.is_far

    @property
    def cost(self) -> float:
        """Robust sum of squares on the fit's run, with priors."""
        return self.fit.cost

    @property
    def tolerance_cost(self) -> float:
        """The part of the cost that says how far the tolerances are from a healthy unit: their squares over priors."""
        return self.fit.cost - self.fit.misfit


def choose_search_excerpt(model: Model, trace: Trace, effects: Iterable[str], progress: Progress = ignore_progress
                          ) -> Excerpt:
    """The part of a long recording that says most about the tolerances and these effects at a usual size."""
    starts = [model.find_effect(name).starts for name in effects]
    changes = [each[len(each) // 2] for each in starts if each]
    floor = {name: f.value for name, f in noises.sensor_floors(trace, model).items()}
    return choose_excerpt(trace, complete_model(model), floor, changes, progress)


class Search:
    """The state of one search: the problem, its noise, every hypothesis tried."""

    def __init__(self, model: Model, trace: Trace, repeats: Sequence[Trace], effects: Iterable[str],
                 workers: int | None = None, holdout: Trace | None = None, whole: Sequence[Trace] = (),
                 rounding: float = 0.0) -> None:
        self.workers = workers or count_threads()
        self.sensors = {signal.name: noises.white_noise(noises.find_sensor_level(trace, signal, model))
                        for signal in trace.declared.outputs}
        trace, *repeats = (leave_out_rest(run, model) for run in (trace, *repeats))
        self.run = trace  # with the rows that the search may leave out
        self.holdout = None if holdout is None else leave_out_rest(holdout, model)
        self.whole = [leave_out_rest(run, model) for run in whole]  # what the runs were cut from, if they were
        lsb = model.values["quantisation.lsb"] if "quantisation" in model.effects else 0.0
        rounding = max(rounding, float(lsb / np.sqrt(12.0)))
        # RMS of rounding, where a signal comes in steps
        self.coarse = {trace.declared.controlled.name: rounding} if rounding else {}
        self.noise = tuple(self.sensors[s] for s in trace.outputs)
        if lsb or model.kind.correct is not None:
            self.noise = self._add_rounding(trace, self.noise)
        self.model, ready = model, complete_model(model)
        bare = silence_readings(model)
        self.problem = Problem(ready, trace, self.noise, workers=self.workers, bare=bare)
        self.repeats = [Problem(ready, r, self.noise, bare=bare) for r in repeats]
        self.finest = max(TRUEST, model.steps)  # steps a cycle of last residuals; a slow cycle has many of the plant's
        self.fine: Problem | None = None  # with these steps
        self._left_unseen: dict[Hypothesis, Floats] = {}
        self.effects = [e for e in effects if e not in model.effects or model.find_effect(e).base]
        self.stage = NO_STAGE  # of the work: each fit, and each round of a last fit, is a step

    def fit_base(self) -> Hypothesis:
        """The model without a further effect, its tolerances fitted."""
        free = list_all_unknowns(self.model)

        fits = self.map_parallel(
            lambda ease: fit_unknowns(self.problem, free, self.find_eased_start(free) if ease else None), (False, True))
        first = self.judge_fit((), min(fits, key=lambda f: f.cost))
        if first.is_at_floor:
            return first
        return self.retry_from(first, [np.where(np.abs(first.fit.x) > 1.0, 0.0, first.fit.x)])

    def resize_own_effects(self, base: Hypothesis) -> list[Hypothesis]:
        """The base with the model's sizes of its own effects, then the effects of which another size explains the run.

        A fit moves these sizes, so a base that leaves only noise may owe that to them. The effects that alone leave
        only noise at another size come best first; all of them together where none does. [] where the model leaves only
        noise as it is, or has no effects to fit.
        """
        own = {effect: self.model.find_effect(effect).fitted for effect in list_active_effects(self.model)}
        fitted = {name for names in own.values() for name in names} & {f.name for f in base.fit.free}
        if not base.is_at_floor or not fitted:
            return []

        def fit_alone(effects: tuple[str, ...]) -> Hypothesis:
            held = fitted.difference(*(own[effect] for effect in effects))
            unknowns = [(f, v) for f, v in zip(base.fit.free, base.fit.x, strict=True) if f.name not in held]
            fit = fit_unknowns(self.problem, [f for f, _ in unknowns], np.array([v for _, v in unknowns]))
            return self.finish_hypothesis(self.judge_fit(effects, fit), 2)

        given = fit_alone(())
        if given.is_at_floor or given.cost <= base.cost + GAIN_SEEN:
            return []
        single = self.map_parallel(fit_alone, [(effect,) for effect in own if fitted & {*own[effect]}])
        enough = sorted((h for h in single if h.is_at_floor), key=lambda h: h.cost)
        return [given, *(enough or [replace(base, effects=tuple(own))])]

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
        free = h.fit.free
        for other in self.map_parallel(lambda start: fit_unknowns(self.problem, free, start), starts):
            if other.cost < h.cost - 1.0:
                h = self.judge_fit(h.effects, other)
        return h

    def refit_base(self, base: Hypothesis, h: Hypothesis) -> Hypothesis:
        """The base fitted again from where a fit with an effect has left its parameters.

        What an effect gains is then not what the base's own fit had left lying about.
        """
        return self.retry_from(base, [_place_base(base, h)])

    def leave_out_effects(self, base: Hypothesis, h: Hypothesis) -> Hypothesis:
        """The base with its unknowns where another hypothesis has them, or as it is if that leaves more.

        Near its end a fit steps over ridges by luck: what is left there without the effect is not the effect's gain.
        """
        fit = replay_fit(self.fine or self.problem, base.fit, _place_base(base, h))
        return min(base, self.judge_fit((), fit), key=lambda each: each.cost)

    def list_further_effects(self, present: Sequence[str]) -> list[str]:
        """The effects of the search that may stand beside these."""
        return list_compatible_effects(self.model, self.effects, present)

    def add_each_effect(self, start: Hypothesis, fit_count: int = FITTED) -> list[Hypothesis]:
        """`start` with one more effect: the promising ones fitted, best first."""
        effects = self.list_further_effects(start.effects)
        start_fits = [start.fit]
        if not start.effects:  # a fit that had to do without a large effect may sit in a wrong basin
            start_fits.append(linearise(self.problem, start.fit.free, np.zeros(len(start.fit.free))))
        prospects = scan_effects(self.problem, start_fits, effects, self.workers)
        prospects = [p for p in prospects if p.cost < start.cost - GAIN_WORTH_A_FIT][:fit_count]
        fits = list(zip([p.effect for p in prospects], self.map_parallel(self._begin_fit, prospects), strict=True))
        for rounds, count in RACE:
            fits.sort(key=lambda each: each[1].cost)
            fits[:count] = self.map_parallel(partial(self._continue_begun_fit, rounds), fits[:count])
        hypotheses = sorted(self.map_parallel(lambda each: self.judge_fit((*start.effects, each[0]), each[1]), fits),
                            key=lambda h: h.cost)
        if hypotheses and not hypotheses[0].is_at_floor:
            x = hypotheses[0].fit.x
            has_prior = np.array([np.isfinite(f.prior) for f in hypotheses[0].fit.free])
            hypotheses[0] = self.retry_from(hypotheses[0], [np.where(has_prior & (np.abs(x) > 1.0), 0.0, x)])
        return hypotheses

    def add_each_in_place(self, start: Hypothesis, rounds: int, fit_count: int = 4) -> list[Hypothesis]:
        """`start` with one more effect each, in place of the tolerances that are far off; best first.

        An effect that does what a tolerance does gains only the square of that, which no forecast from afar sees: the
        valley is narrow and bends. So the tolerances are taken back to a healthy unit in eighths, and the effect and
        the rest are fitted at each. Only what that leads to is fitted with the finest steps.
        """
        problem, unknowns = self.problem, {f.name: f for f in start.fit.free}
        far = {f.name: start.fit.values[f.name] for f, x in zip(start.fit.free, start.fit.x, strict=True)
               if abs(x) > UNUSUAL_SD * f.prior}

        def hold(free: Sequence[Free], share: float) -> list[Free]:
            return [f._replace(centre=unknowns[f.name].centre + share * (far[f.name] - unknowns[f.name].centre),
                               prior=1e-6) if f.name in far and np.isfinite(f.prior) else f for f in free]

        free, x = hold(start.fit.free, TAKEN_BACK[0]), np.where([name in far for name in unknowns], 0.0, start.fit.x)
        first_fit = linearise(problem, free, x)
        cost = problem.compute_costs(start.fit.free, start.fit.x[None])[0]  # of `start`, with these steps
        prospects = scan_effects(problem, [first_fit], self.list_further_effects(start.effects), self.workers)

        def linearise_here(fit: Fit) -> Fit:
            return linearise(problem, fit.free, fit.x)

        def fit_in_place(p: Prospect) -> Hypothesis:
            before = np.array([(first_fit.values.get(f.name, f.centre) - f.centre) / f.scale for f in p.free])
            at = p.x
            for share in TAKEN_BACK:
                ahead = np.clip(2.0 * at - before, *scaled_bounds(p.free))
                fit = start_fit(hold(p.free, share), ahead)
                before, at = at, take_steps(problem, fit, linearise_here, 2, NO_STAGE, take_curved_step).x
            free = [unknowns.get(f.name, f) if np.isfinite(f.prior) else f for f in p.free]
            last_fit = linearise(problem, free, at)
            if last_fit.cost < cost + GAIN_DOUBTFUL:
                last_fit = finish_fit(self.fine or problem, last_fit, rounds, problem, take_step=take_curved_step)
            return self.judge_fit((*start.effects, p.effect), last_fit)

        prospects = [p for p in prospects if p.cost < first_fit.cost - GAIN_WORTH_A_FIT][:fit_count]
        return sorted(self.map_parallel(fit_in_place, prospects), key=lambda h: h.cost)

    def add_each_with_more_noise(self, start: Hypothesis, hypotheses: Sequence[Hypothesis], fit_count: int = 6
                                 ) -> list[Hypothesis]:
        """`start` with one more effect each, chosen and fitted with the noise first taken for larger; best first.

        Where the fit of `start` has ended in a local minimum, a scan believes what that fit tells it, and fits begin
        there. With more noise the tolerances stay near a healthy unit, and an effect is judged by the course of the
        signals. The effects of the best two `hypotheses`, tried before, are fitted in any case.
        """
        loud = scale_noise(self.problem, EASED[0])
        loud_fit = fit_unknowns(loud, start.fit.free, place_in_healthy_unit(start.fit.free, start.fit.x), 4)
        prospects = scan_effects(loud, [loud_fit], self.list_further_effects(start.effects), self.workers)
        best_effects = {h.effects[-1] for h in hypotheses[:2]}
        least = GAIN_WORTH_A_FIT / EASED[0] ** 2  # gains shrink with the square of the noise
        starts = [p for rank, p in enumerate(p for p in prospects if p.cost < loud_fit.cost - least)
                  if rank < fit_count or p.effect in best_effects]

        def begin_eased(p: Prospect) -> tuple[str, Fit]:
            x = self.find_eased_start(p.free, place_in_healthy_unit(p.free, p.x))
            return p.effect, fit_unknowns(self.problem, p.free, x, 3)

        fits = sorted(self.map_parallel(begin_eased, starts), key=lambda each: each[1].cost)
        fits = self.map_parallel(partial(self._continue_begun_fit, 9), fits[:3])
        return sorted((self.judge_fit((*start.effects, effect), fit) for effect, fit in fits), key=lambda h: h.cost)

    def search_widely(self, h: Hypothesis) -> Hypothesis:
        """A hypothesis, or where a population ends that begins at a unit with its effects and no other deviation.

        Stick-slip makes the cost rough, and two effects share many local minima (`fdi.estimation.fit`).
        """
        free = h.fit.free
        has_prior = np.isfinite([f.prior for f in free])
        home = np.where(has_prior, 0.0, h.fit.x)
        coarse = self.make_problem(self.problem.trace, Problem.steps)  # enough for what leads to a valley
        start = fit_unknowns(scale_noise(coarse, 100.0), free, home, 4)
        width = np.where(has_prior, 0.5, 0.1 * np.maximum(np.abs(start.x), 0.1))
        end = follow_population(
            coarse, start, np.diag(width**2), VALLEY_STAGES, 0,
            lambda fit, factor: fit_unknowns(scale_noise(coarse, factor), free, fit.x, 2))
        other = self.judge_fit(h.effects, fit_unknowns(self.problem, free, end.x))
        return min(h, other, key=lambda each: each.cost + each.repeat_cost)

    def drop_each_effect(self, h: Hypothesis) -> list[Hypothesis]:
        """The hypothesis with one of its effects taken out, each of them, fitted from where it is; best first."""
        def fit_without(effect: str) -> Hypothesis:
            free, start = self._place_without(h.fit, effect)
            x = np.array([start, *(self._place_without(fit, effect)[1] for fit in self._list_ways_off(h.fit, effect))])
            best = x[int(np.argmin(self.problem.compute_costs(free, x)))] if len(x) > 1 else x[0]
            return self.judge_fit(tuple(e for e in h.effects if e != effect), fit_unknowns(self.problem, free, best))

        return sorted(self.map_parallel(fit_without, h.effects), key=lambda each: each.cost)

    def _place_without(self, fit: Fit, effect: str) -> tuple[list[Free], Floats]:
        """The unknowns of a fit without those of an effect, and where they are, (p,): at 0 its own ones at a bound."""
        usual = {f.name: f for f in list_all_unknowns(self.model)}
        names, values = set(self.model.find_effect(effect).fitted), fit.values
        unknowns = [usual.get(f.name) if f.name in names else f for f in fit.free]
        free = [f for f in unknowns if f is not None]
        x = [(values[f.name] - f.centre) / f.scale if f.name not in names or f.low < values[f.name] < f.high else 0.0
             for f in free]
        return free, np.clip(x, *scaled_bounds(free))

    def _list_ways_off(self, fit: Fit, effect: str) -> list[Fit]:
        """The fit where an effect is off and other parameters have taken its place, along directions no signal shows.
        """
        entry = self.model.find_effect(effect)
        x = [scale_to(fit.free, fit.x, direction.powers, name, entry.off[name])
             for direction in list_directions(self.problem, fit.values) for name in entry.fitted if name in entry.off]
        return [replace(fit, x=row) for row in x if row is not None]

    def map_parallel(self, do: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """In threads whose replays are made together: side by side in the lanes of a kernel."""
        def do_step(item: T) -> R:
            answer = do(item)
            self.stage.finish_step()
            return answer

        return map_together(do_step, items, self.workers)

    def _continue_begun_fit(self, rounds: int, each: tuple[str, Fit]) -> tuple[str, Fit]:
        return each[0], each[1] if each[1].converged else continue_fit(self.problem, each[1], rounds)

    def _begin_fit(self, p: Prospect) -> Fit:
        """Begin at the scan's linear forecast, or with all but the effect left where it was, if that is better."""
        is_own = np.isin([f.name for f in p.free], self.model.find_effect(p.effect).fitted)
        starts = np.array([p.x, np.where(is_own, p.x, 0.0)])
        return linearise(self.problem, p.free, starts[int(np.argmin(self.problem.compute_costs(p.free, starts)))])

    def judge_fit(self, effects: tuple[str, ...], fit: Fit, others: Sequence[Floats] = ()) -> Hypothesis:
        """What a fit leaves, on its own run and on the repeats: `others`, (s, n) SI each, where that is known."""
        signals = self.problem.trace.outputs
        residuals = fit.residuals[:, :len(self.problem.trace)]  # the first run of a fit to several
        errors = dict(zip(signals, map(rms, residuals), strict=True))
        coarse = [self.coarse.get(s, 0.0) for s in signals]
        others = others or [p.compute_residuals(fit.free, fit.x[None])[0] for p in self.repeats]
        floor = {s: float(np.hypot(n.level, c)) for s, n, c in zip(signals, self.noise, coarse, strict=True)}
        if not others:
            errors = measure_decided_errors(self.problem, fit, floor)
            return Hypothesis(effects, fit, errors, {s: errors[s] / floor[s] for s in signals})
        pairs = zip(self.repeats, others, strict=True)
        cost = float(np.mean([compute_misfit(p.whiten_residuals(r[None]))[0] for p, r in pairs]))
        ratio = dict(zip(signals, measure_repeating(residuals, others, coarse), strict=True))
        if self.model.kind.correct is not None and max(ratio.values()) > RESIDUAL_IS_NOISE:
            is_undecided = find_undecided_rows(replace(self.problem, also=(), _lanes={}), fit, floor)
            typical = _leave_out_worst(np.where(is_undecided, np.nan, residuals))
            if not np.isnan(typical).all(axis=1).any():
                ratio = dict(zip(signals, measure_repeating(typical, others, coarse), strict=True))
        return Hypothesis(effects, fit, errors, ratio, cost, tuple(others))

    def make_problem(self, trace: Trace, steps: int) -> Problem:
        """One run, with so many steps a cycle, in place of all that the search fits; it may lack signals of theirs."""
        noise = dict(zip(self.problem.trace.outputs, self.problem.noise, strict=True))
        return replace(self.problem, trace=trace, noise=tuple(noise[s] for s in trace.outputs), steps=steps, also=(),
                       _lanes={})

    def replay_holdout(self, hypotheses: Sequence[Hypothesis]) -> tuple[Problem, list[Floats]]:
        """The held-out run, and what each hypothesis leaves of it, (s, n) SI; none is replayed twice."""
        assert self.holdout is not None
        problem = self.make_problem(self.holdout, FINE if is_long(self.holdout) else self.finest)
        new = [h for h in dict.fromkeys(hypotheses) if h not in self._left_unseen]
        residuals = map_together(lambda h: problem.compute_residuals(h.fit.free, h.fit.x[None])[0], new, self.workers)
        self._left_unseen.update(zip(new, residuals, strict=True))
        return problem, [self._left_unseen[h] for h in hypotheses]

    def measure_holdout(self, hypotheses: Sequence[Hypothesis]) -> list[dict[str, float]]:
        """RMS residuals on the run that no fit saw, SI units; {} without one."""
        if self.holdout is None:
            return [{} for _ in hypotheses]
        return [dict(zip(self.holdout.outputs, map(rms, residuals), strict=True))
                for residuals in self.replay_holdout(hypotheses)[1]]

    def measure_unseen_costs(self, hypotheses: Sequence[Hypothesis]) -> list[float]:
        """Robust sums of squares of what is left of the run that no fit saw; [] without one."""
        if self.holdout is None:
            return []
        problem, residuals = self.replay_holdout(hypotheses)
        return [float(compute_misfit(problem.whiten_residuals(each[None]))[0]) for each in residuals]

    def judge_on_all(self, hypotheses: Sequence[Hypothesis], steps: int) -> list[Hypothesis]:
        """The hypotheses with their errors on all of the recordings that the runs were cut from.

        Its ratio is that of all of the recording, or that of the part where it holds on all of the recording.
        """
        if not self.whole:
            return list(hypotheses)
        floor = self.estimate_floor(hypotheses[-1])
        fits = [h.fit for h in hypotheses]
        runs = [judge_on_all(self.problem, fits, run, steps) for run in self.whole]
        out = []
        for h, judgement, *others in zip(hypotheses, *runs, strict=True):
            errors = judgement.errors
            ratio = {s: min(x, errors[s] / floor[s]) for s, x in h.ratio.items()}
            if not all(j.holds(floor) for j in (judgement, *others)):
                ratios = [j.typical_ratio(floor) for j in (judgement, *others)]
                ratio = {s: max(x, *(each[s] for each in ratios)) for s, x in h.ratio.items()}
            out.append(replace(h, errors=errors, ratio=ratio, judgement=judgement))
        return out

    def learn_noise(self, best: Hypothesis) -> None:
        """Take the noise from what differs between the runs under the best hypothesis."""
        self.noise = self._measure_noise(best)
        levels = zip(self.noise, map(self.sensors.__getitem__, self.problem.trace.outputs), strict=True)
        if any(noise.level < 0.5 * sensor.level for noise, sensor in levels):  # of a simulation: the steps err by more
            steps = find_fewest_steps(self.model.kind, QUIETEST_NOISE)
            self.problem = replace(self.problem, steps=max(self.problem.steps, steps), _lanes={})
        if self.model.kind.correct is not None:
            self.noise = self._add_rounding(self.problem.trace, self.noise)
        self.problem = replace(self.problem, noise=self.noise)
        self.fine = None if self.fine is None else replace(self.fine, noise=self.noise)
        self.repeats = [replace(p, noise=self.noise) for p in self.repeats]

    def _add_rounding(self, trace: Trace, noise: Iterable[Noise]) -> tuple[Noise, ...]:
        """The noise of each output with that of rounding, which repeats do not show, as they round alike."""
        return tuple(n._replace(innovation=float(np.hypot(n.innovation, self.coarse.get(s, 0.0))))
                     for s, n in zip(trace.outputs, noise, strict=True))

    def match_noise(self, best: Hypothesis) -> None:
        """Take the noise for so large that 99 of 100 blocks of the best hypothesis count by their squares.

        For a model that is not complete, where no repeat tells the noise and an observer keeps the residual short:
        without one a single missed stop would outweigh the run. With the noise of the sensors its blocks
        would count by the logarithms of their squares, and those that it happens to fit would decide. What it leaves
        keeps its sign for long, so it says as little as fewer samples do; the intervals are then as wide as they are.
        """
        if best.others or best.is_at_floor or self.model.kind.correct is None:
            return
        white = best.fit.white[:, :len(self.problem.trace)]
        size = np.sqrt(np.quantile(sum_blocks(white) / BLOCK, 0.99, axis=1) / BLOCK_FITTED_SQUARE)
        size /= np.sqrt([noises.measure_freedom(row) for row in white])
        self.noise = tuple(n._replace(innovation=max(1.0, float(s)) * n.innovation)
                           for n, s in zip(self.noise, size, strict=True))
        self.problem = replace(self.problem, noise=self.noise)

    def estimate_floor(self, best: Hypothesis) -> dict[str, float]:
        """What the sensors' noise alone leaves of each signal, RMS SI, under the best hypothesis."""
        return {s: float(np.hypot(n.level, self.coarse.get(s, 0.0)))
                for s, n in zip(self.problem.trace.outputs, self._measure_noise(best), strict=True)}

    def _measure_noise(self, best: Hypothesis) -> tuple[Noise, ...]:
        """What `learn_noise` finds, and no less than a small part of what the sensors are said to have."""
        trace = self.problem.trace
        least = [QUIETEST_NOISE * self.sensors[name].level for name in trace.outputs]
        return tuple(noises.white_noise(low) if noise.level < low else noise
                     for noise, low in zip(learn_noise(best, trace, self.noise), least, strict=True))

    def refit_hypothesis(self, h: Hypothesis, rounds: int = 4) -> Hypothesis:
        """A hypothesis refitted with the noise, the steps and the runs as they are now."""
        return self.judge_fit(h.effects, fit_unknowns(self.problem, h.fit.free, h.fit.x, rounds))

    def replay_hypothesis(self, h: Hypothesis) -> Hypothesis:
        """A hypothesis without a last fit, with what it leaves of the runs and with the steps of those."""
        return self._judge_all_runs(h, replay_fit(self.fine or self.problem, h.fit, h.fit.x))

    def finish_hypothesis(self, h: Hypothesis, rounds: int = 5) -> Hypothesis:
        """A hypothesis taken to the end, with a covariance that its intervals can rest on."""
        start = turn_amplitudes_positive(h.fit.free, h.fit.x, self.model.kind.list_effects())
        near = fit_unknowns(self.problem, h.fit.free, start, 2)
        fit = finish_fit(self.fine or self.problem, near, rounds, self.problem, self.stage)
        return self._judge_all_runs(h, fit)

    def _judge_all_runs(self, h: Hypothesis, fit: Fit) -> Hypothesis:
        """What a fit to all runs leaves, of which no repeat is replayed again."""
        ends = np.cumsum([len(run) for run in (self.problem.trace, *self.problem.also)])
        return self.judge_fit(h.effects, fit, np.split(fit.residuals, ends[:-1], axis=1)[1:])

    def reaches_floor(self, h: Hypothesis) -> bool:
        """Whether a hypothesis leaves only noise, if need be with finer steps: a little more may be the solver's error.
        """
        if h.is_at_floor or not h.is_near_floor:
            return h.is_at_floor
        finer = copy(self)
        finer.stage = NO_STAGE
        finer.refine_steps(FINE)
        return finer.finish_hypothesis(h, 1).is_at_floor

    def begin_again(self, h: Hypothesis, rounds: int = 6) -> Hypothesis:
        """A last fit that may be in a local minimum, or the same effects from a healthy unit if that ends lower.

        Such a fit leaves more than noise, or only noise but far from a healthy unit. The other one is taken to the end
        only if it is not clearly higher after so many rounds.
        """
        if not h.is_poor and not h.is_far:
            return h
        other = fit_unknowns(self.problem, h.fit.free, place_in_healthy_unit(h.fit.free, h.fit.x), rounds)
        if other.cost > self.problem.compute_costs(h.fit.free, h.fit.x[None])[0] + GAIN_DOUBTFUL:
            return h
        again = self.finish_hypothesis(self.judge_fit(h.effects, other))
        return min(h, again, key=lambda each: each.cost)

    def leave_out_undecided(self, best: Hypothesis) -> bool:
        """Leave out of all runs the rows that hang on a stop or an impact under the best hypothesis; whether any did.

        Where a plant has an observer. Behind a backlash a motor bounces, and a thousandth of a friction decides the
        next impact: there a replay at the true values is off by up to 80 noise floors, and a fit is drawn to a size at
        which it happens to bounce like the measured motor. If few of the rows would remain, they stay as they are.
        """
        if self.model.kind.correct is None:
            return False
        alone = replace(self.fine or self.problem, also=(), _lanes={})
        return self._leave_out(find_undecided_rows(alone, best.fit, self.estimate_floor(best)))

    def leave_out_missed_stop(self, best: Hypothesis) -> bool:
        """The same where a plant has no observer, if the best fit leaves more than it was made with.

        It has missed a stop in one of the runs, and moved all its parameters by a little to meet it in another: it is
        off by that in a run that it never saw.
        """
        if self.model.kind.correct is not None or not best.is_poor:
            return False
        alone = replace(self.fine or self.problem, also=(), _lanes={})
        rows = find_unpredictable_rows(alone, best.fit, self.estimate_floor(best))
        is_cut = self._leave_out(rows)
        if is_cut:
            left_out = f"{rows.sum() * self.run.period:.1f} s hang on a stop that no fit meets in every run"
            run = self.problem.trace.with_notes(f"{left_out}: they are not compared in the last fits")
            self.problem = replace(self.problem, trace=run)
        return is_cut

    def leave_out_bounces(self, base: Hypothesis) -> bool:
        """The same for the rows that would hang on an impact if one of the effects were there at its largest start.

        Such rows cost an effect that makes the plant bounce as much as any other, and they draw the tolerances of the
        base from where the scan would find it.
        """
        if self.model.kind.correct is None:
            return False
        floor, rows = self.estimate_floor(base), np.zeros(len(self.problem.trace), bool)
        for entry in map(self.model.find_effect, self.effects):
            start = max(entry.starts, key=lambda values: abs(values[entry.fitted[0]]))
            model = self.problem.model.replace(dict(start))
            rows |= find_undecided_rows(replace(self.problem, model=model, bare=None, _lanes={}), base.fit, floor)
        return self._leave_out(rows)

    def _leave_out(self, is_undecided: Flags) -> bool:
        if leave_out_rows(self.problem.trace, is_undecided) is self.problem.trace:
            return False

        def cut(problem: Problem) -> Problem:
            runs = [leave_out_rows(run, is_undecided[:len(run)]) for run in (problem.trace, *problem.also)]
            return replace(problem, trace=runs[0], also=tuple(runs[1:]), _lanes={})

        self.problem, self.fine = cut(self.problem), None if self.fine is None else cut(self.fine)
        self.repeats = [cut(problem) for problem in self.repeats]
        return True

    def leave_valley(self, h: Hypothesis) -> Hypothesis:
        """A last fit, or where a population ends, for one that is in a valley of its own and if that ends lower.

        Such a fit leaves only noise, but more than was learned or far from a healthy unit: a stop that the base has
        missed would be the gain of any effect. Beside an observer, which keeps residuals short, it may leave more than
        noise: one that began with rows that hang on a stop may be far off in size.
        """
        is_misled = h.is_poor or (h.is_far and h.is_at_floor)
        if not is_misled or not (h.is_at_floor or self.model.kind.correct is not None):
            return h
        if self.measure_solver_error(h, self.estimate_floor(h)) > SOLVER_ERROR_SHARE:  # the steps mislead it
            return h
        return min(h, self.finish_hypothesis(self.search_widely(h)), key=lambda each: each.cost)

    def begin_beside(self, best: Hypothesis, rival: Hypothesis, rounds: int = 4) -> Hypothesis:
        """A rival of the best hypothesis, or the same effects from the tolerances of the best if that ends lower.

        Last fits differ by hundreds through single stops that they make or miss. From the same tolerances the two
        differ by what their effects do.
        """
        free, values = rival.fit.free, best.fit.values
        names = {name for effect in rival.effects for name in self.model.find_effect(effect).fitted}
        x = np.array([(values[f.name] - f.centre) / f.scale if f.name in values and f.name not in names else v
                      for f, v in zip(free, rival.fit.x, strict=True)])
        fit = fit_unknowns(self.problem, free, np.clip(x, *scaled_bounds(free)), rounds)
        again = self.finish_hypothesis(self.judge_fit(rival.effects, fit))
        return min(rival, again, key=lambda each: each.cost)

    def begin_look_alikes(self, best: Hypothesis, effect_sets: Container[frozenset[str]]) -> list[Hypothesis]:
        """The best hypothesis with a look-alike in place of one effect, from its tolerances, if noise is left then.

        The search fits what promises most from the tolerances of the base. There a look-alike may miss a stop, and
        fall far behind or not be fitted at all; of two effects the second is sought beside the better look-alike of
        the first alone.

        Args:
            best: with one or several effects.
            effect_sets: sets of effects that need not be tried.
        """
        look_alikes: list[Hypothesis] = []
        for effect in best.effects:
            rest = tuple(name for name in best.effects if name != effect)
            without = linearise(self.problem, *self._place_without(best.fit, effect))
            sensitivity = self.compare_signatures(without)
            is_own = [name == effect for name in sensitivity.names]
            alike = {name for name, cosines in zip(sensitivity.names, np.abs(sensitivity.gram), strict=True)
                     if max(cosines[is_own], default=0.0) > LOOKS_ALIKE and frozenset((*rest, name)) not in effect_sets}
            alike &= set(self.list_further_effects(rest)) - {effect}
            if alike:
                look_alikes += self.begin_effects(without, sorted(alike), rest)
        return look_alikes

    def compare_signatures(self, fit: Fit) -> Sensitivity:
        """What the effects would change at a fit; repeats of the same command would show the same once more."""
        coarse = self.make_problem(self.problem.trace, Problem.steps)  # enough for cosines
        run_fit = replace(fit, jacobian=fit.jacobian[:, :, :len(self.problem.trace)])
        sensitivity = compute_sensitivity(coarse, run_fit, self.effects)
        return sensitivity._replace(gains=(1 + len(self.problem.also)) * sensitivity.gains)

    def begin_effects(self, base: Fit, effects: Sequence[str], present: tuple[str, ...] = ()) -> list[Hypothesis]:
        """Those of the effects, each on top of a fit, that gain over it and leave only noise, taken to the end.

        Args:
            base: the fit.
            effects: to try.
            present: effects that the fit has already.
        """
        def begin(p: Prospect) -> Hypothesis:
            return self.judge_fit((*present, p.effect), fit_unknowns(self.problem, p.free, p.x, 4))

        prospects = scan_effects(self.problem, [base], effects, self.workers)
        hypotheses = self.map_parallel(begin, [p for p in prospects if p.cost < base.cost - GAIN_WORTH_A_FIT])
        candidates = [h for h in hypotheses if h.is_near_floor and h.cost < base.cost - GAIN_SEEN]
        last_fits = self.map_parallel(self.finish_hypothesis, candidates)
        return self.map_parallel(self.begin_again, [h for h in last_fits if h.is_at_floor])

    def measure_solver_error(self, h: Hypothesis, floor: Mapping[str, float]) -> float:
        """What half the step changes in a replay, over the floor, in the worst signal."""
        coarse, halved = (self.make_problem(self.problem.trace, n * self.problem.steps) for n in (1, 2))
        x = h.fit.x[None]
        change = (halved.compute_residuals(h.fit.free, x) - coarse.compute_residuals(h.fit.free, x))[0]
        typical = np.sqrt([np.nanmean(np.minimum(c**2, np.nanpercentile(c**2, 98.0))) for c in change])
        return max(float(t) / floor[s] for s, t in zip(self.problem.trace.outputs, typical, strict=True))

    def refine_steps(self, steps: int, finest: int | None = None) -> None:
        """Finer steps from here on, `finest` where not only slopes ask for them; fits to the repeats as well."""
        steps, finest = max(steps, self.problem.steps), finest or self.finest
        self.problem = replace(self.problem, steps=steps, _lanes={}, also=tuple(p.trace for p in self.repeats))
        self.fine = replace(self.problem, steps=finest, _lanes={})
        self.repeats = [replace(p, steps=finest, _lanes={}) for p in self.repeats]


def list_compatible_effects(model: Model, effects: Iterable[str], present: Sequence[str]) -> list[str]:
    """The effects that may stand beside those that are `present`."""
    excluded_names = {name for e in present for name in model.find_effect(e).excludes}
    return [e for e in effects if e not in present and e not in excluded_names
            and not set(model.find_effect(e).excludes) & set(present)]


def learn_noise(h: Hypothesis, trace: Trace, before: Sequence[Noise]) -> list[Noise]:
    """Noise of each signal: of the difference between repeats, else of the residual where only noise is left."""
    noise = []
    for i, old in enumerate(before):
        if h.others:
            n = min(len(trace), *(o.shape[1] for o in h.others))
            difference = np.concatenate([(h.fit.residuals[i, :n] - o[i, :n]) for o in h.others]) / np.sqrt(2.0)
            noise.append(noises.fit_noise(difference))
        else:
            noise.append(noises.fit_noise(h.fit.residuals[i]) if h.is_at_floor else old)
    return noise


def measure_repeating(residual: Floats, others: Sequence[Floats], coarse: Sequence[float]) -> list[float]:
    """What repeats in residuals (s, n) of runs of one command, as total over noise: 1 where only noise is left.

    Independent noise of any colour averages out of the product of two runs; physics that is missing does not.
    Rounding, `coarse` (s,) RMS, repeats where the ram rests: it is taken for noise.
    """
    ratios = []
    for row, rounding, i in zip(residual, coarse, range(len(residual)), strict=True):
        n = min(len(row), *(o.shape[1] for o in others))
        product = float(np.mean([np.nanmean(row[:n] * o[i, :n]) for o in others]))
        difference = np.concatenate([row[:n] - o[i, :n] for o in others]) / np.sqrt(2.0)
        noise = noises.measure_level(difference) ** 2 + rounding**2 + 1e-300
        ratios.append(float(np.sqrt(max(1.0 + (product - rounding**2) / noise, 0.0))))
    return ratios


def _leave_out_worst(residuals: Floats, share: float = 0.15) -> Floats:
    """Residuals (s, n) without each signal's worst blocks, a share of those that were compared.

    A surface may stop for an instant in a slow motion.
    """
    sums = sum_blocks(np.nan_to_num(residuals))
    most = np.array([np.quantile(each[each > 0.0], 1.0 - share) if each.any() else 0.0 for each in sums])
    is_typical = sums <= most[:, None]
    return np.where(np.repeat(is_typical, BLOCK, axis=1)[:, :residuals.shape[1]], residuals, np.nan)


def _place_base(base: Hypothesis, h: Hypothesis) -> Floats:
    """The base's unknowns, (p,), where a fit with an effect has left them; at 0 those at a bound."""
    values = h.fit.values
    return np.array([(values[f.name] - f.centre) / f.scale if f.low < values[f.name] < f.high else 0.0
                     for f in base.fit.free])


Start = Mapping[str, float]

ZOOM = (  # factors on the size, pass by pass; the first reaches down to sizes that only just show
    (0.015, 0.05, 0.15, 0.4, 0.65, 1.5, 2.5), (0.6, 0.8, 1.25, 1.7), (0.88, 0.94, 1.06, 1.13),
    (0.97, 0.985, 1.015, 1.03))
LINE = tuple(1.02**k for k in range(-120, 181))  # a tenth to 35 times the size, for plants with an observer
LOOKED_AT = (40, 14, 10, 8)  # effects in each of these passes
TOGETHER = 64  # runs at a time
FINER = 16  # times the length of a run: bins of a spectrum fine enough for a fit to begin in
LINES = 4  # tried
SCAN_STRIDE = 5  # every so many samples, for the linear shift alone


# effects that other unknowns can make up for, all but a little: directions of unidentifiable.FLAT by which these then
# go with 1 - value. A clogged filter weakens what pushes the spool, so a fit without it has found too much friction and
# too little flow; friction cannot give way linearly, a hundred stops of the spool would move
GOES_WITH: Mapping[str, tuple[int, ...]] = {"filter_clogging": (0, 1)}


class Trial(NamedTuple):
    """An effect at one start on top of a fit: `cost` after the fit's unknowns, (p,), have moved to `x`."""

    effect: str
    start: Start
    cost: float
    x: Floats
    along: bool  # what goes with the effect has moved first
    fit: Fit


class Prospect(NamedTuple):
    """An effect with the start that promises most: `cost` is what would be left, `x` the start of all unknowns."""

    effect: str
    cost: float
    free: tuple[Free, ...]
    x: Floats  # (p,), those of the fit scanned from first


def scan_effects(problem: Problem, fits: Sequence[Fit], effects: Iterable[str], workers: int = 1) -> list[Prospect]:
    """Expected cost of each effect on top of the fit where it does better, best first, by so many threads.

    Every start of an effect is simulated; the fit's own unknowns then move linearly, within their bounds and priors, to
    take up what they can. Further passes try sizes around the best start, closer each time, and the last one
    frequencies.
    """
    best: list[Trial] = []

    def try_starts(starts: Sequence[tuple[Fit, tuple[str, Start, bool]]]) -> list[Trial]:
        def simulate_own(fit: Fit) -> list[Trial]:
            return simulate_starts(problem, fit, [start for each, start in starts if each is fit], workers)

        trials = map_together(simulate_own, fits, workers)
        return _keep_best([*best, *(trial for several in trials for trial in several)])

    best = try_starts([
        (fit, (name, start, along)) for fit in fits for name in effects
        for along in ((False, True) if name in GOES_WITH else (False,))
        for start in (*problem.model.find_effect(name).starts, *find_tones(problem, fit, name),
                      *_start_at_fit(problem, fit, name))])
    passes = list(zip(ZOOM, LOOKED_AT, strict=True))
    if problem.model.kind.correct is not None:  # a backlash that is 2 % off bounces otherwise than the motor
        passes.append((LINE, 4))
    for factors, count in passes:
        best = try_starts([(t.fit, (t.effect, start, t.along)) for t in best[:count]
                           for start in _list_starts_around(problem, t, factors)])
    best = try_starts([(t.fit, (t.effect, start, t.along)) for t in best[:LOOKED_AT[-1]]
                       for start in _list_lines_beside(problem, t)])
    return [_make_prospect(problem, t) for t in best]


def _start_at_fit(problem: Problem, fit: Fit, effect: str) -> list[Start]:
    """A start of an effect of the reference model where the fit has its parameters: other starts may all be far off."""
    entry = problem.model.find_effect(effect)
    if not entry.base or problem.model.kind.shared_starts or not set(entry.fitted) <= set(fit.values):
        return []
    return [{name: fit.values[name] for name in entry.fitted}]


def _make_prospect(problem: Problem, t: Trial) -> Prospect:
    unknowns = {u.name: u for u in list_effect_unknowns(problem.model.find_effect(t.effect), problem.model)}
    base_free = tuple(unknowns.get(f.name, f) for f in t.fit.free)  # a base effect loses its tolerance
    new_free = tuple(u for name, u in unknowns.items() if name not in {f.name for f in t.fit.free})
    fit_values = {f.name: f.centre + f.scale * float(v) for f, v in zip(t.fit.free, t.x, strict=True)}
    values = {**fit_values, **t.start}
    free = (*base_free, *new_free)
    return Prospect(t.effect, t.cost, free, np.array([(values[f.name] - f.centre) / f.scale for f in free]))


def _list_starts_around(problem: Problem, t: Trial, factors: Sequence[float]) -> list[dict[str, float]]:
    """Starts around a trial's: the parameters of one unit, which belong together, times each factor."""
    entry = problem.model.find_effect(t.effect)
    free, meaning = list_effect_unknowns(entry, problem.model), entry.parameters
    units = dict.fromkeys(meaning[u.name].unit for u in free if meaning[u.name].unit not in ("Hz", "rad"))
    return [{**t.start, **{u.name: min(max(u.centre + factor * (t.start[u.name] - u.centre), u.low), u.high)
                           for u in free if meaning[u.name].unit == unit}} for unit in units for factor in factors]


def find_tones(problem: Problem, fit: Fit, effect: str) -> list[dict[str, float]]:
    """Starts for an effect with a frequency: a fit finds none that it does not begin within a period of.

    The effect at next to no frequency and a quarter turn shows how each residual answers a constant; the residual times
    that answer has a line where the effect has its frequency. The lines that stand out most from what is around, in all
    signals together, are tried, at four phases as the answer may lag, and larger as what is fast is weakened.
    """
    entry = problem.model.find_effect(effect)
    sine = name_sine(entry)
    if sine is None:
        return []
    size, tone, phase = sine
    still = {**entry.starts[0], tone: max(1e-6, entry.parameters[tone].low), phase: 0.5 * np.pi}
    names = list(still)
    at = np.array([list(still.values()), [entry.off.get(n, still[n]) for n in names]])
    white = problem.whiten_predictions(problem.predict_outputs(names, at))
    longest = _find_longest_piece(problem)
    rows = slice(longest.first, longest.stop)  # a line has one phase within a piece alone
    answer = (white[1] - white[0])[:, rows]
    product = fit.white[:, rows] * answer
    period = problem.model.values["controller.period"]
    spectra = np.fft.rfft(product - product.mean(axis=1, keepdims=True), FINER * product.shape[1])
    hertz = np.fft.rfftfreq(FINER * product.shape[1], period)
    surroundings = 3.0  # Hz on either side of a line, above which it has to stand out
    height = (_measure_prominence(np.abs(spectra), round(surroundings / hertz[1])) ** 2).sum(axis=0) * (hertz > 0.5)
    line = spectra.sum(axis=0) * 2.0 / max(float((answer**2).sum()), 1e-300)  # in sizes of the start
    starts = []
    before = 2.0 * np.pi * period * (longest.first + longest.later)  # s times 2 pi, from the clock's 0 to the piece
    distance = 1.0  # Hz, between lines
    for _ in range(LINES):
        k = int(np.argmax(height))
        starts += [{size: still[size] * larger * float(np.abs(line[k])), tone: float(hertz[k]),
                    phase: float(np.angle(line[k])) + turn * np.pi - before * float(hertz[k])}
                   for turn in (0.5, 1.0, 1.5, 2.0) for larger in (1.0, 4.0, 16.0)]
        height[np.abs(hertz - hertz[k]) < distance] = 0.0
    return starts


def _list_lines_beside(problem: Problem, t: Trial) -> list[dict[str, float]]:
    """Starts around the frequency of a trial, if its effect has one: every half turn over the run, at eight phases.

    A line in what a wrong fit leaves stands a little beside the effect's own frequency. A fit gets there only from
    less than half a turn away: it does not leave the line that it begins in.
    """
    entry = problem.model.find_effect(t.effect)
    sine = name_sine(entry)
    if sine is None:
        return []
    _, tone, phase = sine
    longest = _find_longest_piece(problem)
    period = problem.model.values["controller.period"]
    turn = 1.0 / (period * (longest.stop - longest.first))  # Hz
    middle = 2.0 * np.pi * period * (longest.later + 0.5 * (longest.first + longest.stop))  # where the phase stays
    low = entry.parameters[tone].low
    changes = turn * np.arange(-3.0, 3.5, 0.5)
    return [{**t.start, tone: float(max(t.start[tone] + change, low)),
             phase: float(t.start[phase] - middle * change + eighth * 0.25 * np.pi)}
            for change in changes for eighth in range(8)]


def _find_longest_piece(problem: Problem) -> Part:
    return max(problem.trace.parts or (span_all_rows(problem.trace),), key=lambda part: part.stop - part.first)


def _measure_prominence(spectra: Floats, width: int) -> Floats:
    """Magnitudes (s, n) over the median of those around them, `width` bins on either side."""
    out = np.empty_like(spectra)
    for first in range(0, spectra.shape[1], width):
        around = spectra[:, max(first - width, 0):first + 2 * width]
        middle = np.maximum(np.median(around, axis=1, keepdims=True), 1e-300)  # an effect may change nothing here
        out[:, first:first + width] = spectra[:, first:first + width] / middle
    return out


E = TypeVar("E", Trial, Prospect)


def _keep_best(trials: Iterable[E]) -> list[E]:
    """The best of each effect, best first."""
    best: dict[str, E] = {}
    for each in sorted(trials, key=lambda t: t.cost):
        best.setdefault(each.effect, each)
    return list(best.values())


def simulate_starts(problem: Problem, fit: Fit, starts: Sequence[tuple[str, Start, bool]], workers: int
                     ) -> list[Trial]:
    """The starts simulated at the fit's values, or with what goes with them, side by side."""
    if not starts:
        return []
    names = list(dict.fromkeys([f.name for f in fit.free] + [n for _, start, _ in starts for n in start]))
    ways = list_powers(problem)
    x_start = [_move_along(fit, effect, start, ways) if along else fit.x for effect, start, along in starts]
    at = [problem.list_values(fit.free, x) | dict(start) for x, (_, start, _) in zip(x_start, starts, strict=True)]
    rows = np.array([[values.get(n, problem.model.values[n]) for n in names] for values in at])

    def run_trials(part: NDArray[np.int64]) -> list[Trial]:
        white = problem.whiten_predictions(problem.predict_outputs(names, rows[part]))
        part_starts = [starts[i] for i in part]
        costs, x = absorb_shifts(fit, white, [start for _, start, _ in part_starts],
                                 np.array([x_start[i] for i in part]))
        return [Trial(effect, start, float(cost), at, along, fit)
                for (effect, start, along), cost, at in zip(part_starts, costs, x, strict=True)]

    parts = np.array_split(np.arange(len(rows)), min(len(rows), max(workers, -(-len(rows) // TOGETHER))))
    return [trial for several in map_together(run_trials, parts, workers) for trial in several]


def _move_along(fit: Fit, effect: str, start: Start, ways: Sequence[Mapping[str, float]]) -> Floats:
    """The fit's unknowns, (p,), after what goes with an effect has moved, within their bounds."""
    remainder = max(1.0 - next(iter(start.values())), 0.01)  # a filter that lets nothing through has no power
    low, high = scaled_bounds(fit.free)
    x = fit.x
    for way in GOES_WITH[effect]:
        x = scale_together(fit.free, x, ways[way], float(np.log(remainder)))
    return np.clip(x, low, high)


def absorb_shifts(fit: Fit, white: Floats, fixed_names: Sequence[Iterable[str]], x_start: Floats
                  ) -> tuple[Floats, Floats]:
    """A fit's unknowns take up what they can of whitened residuals: the costs that are left, and where they are then.

    They shift linearly, twice, as what can be fitted is known only after the first time; not at all where to stay is
    better.

    Args:
        fit: with the Jacobian.
        white: (m, s, n), each simulated at its own unknowns.
        fixed_names: of each residual the unknowns that stay where they are.
        x_start: (m, p), the unknowns.
    """
    can_move = np.array([[f.name not in names for f in fit.free] for names in fixed_names])
    if not fit.free:  # a plant without tolerances
        return compute_misfit(white), x_start
    x = _shift_unknowns(fit, white[:, :, ::SCAN_STRIDE], x_start, can_move)
    whole, priors = fit.jacobian.reshape(len(fit.x), -1), weigh_priors(fit.free)
    costs = (x * can_move) ** 2 @ priors
    for few in cut_runs(white.shape):
        residuals = white[few] + ((x[few] - x_start[few]) @ whole).reshape(white[few].shape)
        costs[few] += compute_misfit(residuals)
    start_costs = compute_misfit(white) + (x_start * can_move) ** 2 @ priors
    is_start_better = start_costs < costs
    return np.where(is_start_better, start_costs, costs), np.where(is_start_better[:, None], x_start, x)


def _shift_unknowns(fit: Fit, thin: Floats, x_start: Floats, can_move: Flags) -> Floats:
    """Where unknowns have moved from `x_start`, (m, p), of which `can_move` says which may.

    `thin`, (m, s, k), are the residuals at every `SCAN_STRIDE`-th sample. A weight belongs to a block, so a Hessian is
    a weighted sum of those of the blocks, which all residuals have in common.
    """
    block, unknowns = BLOCK // SCAN_STRIDE, len(fit.x)
    low, high = scaled_bounds(fit.free)
    priors = weigh_priors(fit.free)
    thin = np.ascontiguousarray(thin)
    slopes = np.ascontiguousarray(fit.jacobian[:, :, ::SCAN_STRIDE])
    flat = slopes.reshape(unknowns, -1)
    of_block = cut_blocks(slopes, block).reshape(unknowns, -1, block).transpose(1, 0, 2)
    squares = (of_block @ of_block.transpose(0, 2, 1)).reshape(len(of_block), -1)
    stiffness = np.eye(unknowns) * np.where(can_move, priors + 1e-9, 1e30)[:, None]  # what is fixed does not move
    residuals, x = thin, x_start
    for _ in range(2):
        weights = SCAN_STRIDE * weigh_blocks(residuals, block)
        heavy = thin * np.repeat(weights, block, axis=-1)[..., :thin.shape[-1]]
        hessian = (weights.reshape(len(thin), -1) @ squares).reshape(stiffness.shape) + stiffness
        gradient = heavy.reshape(len(thin), -1) @ flat.T + priors * x_start * can_move
        x = np.where(can_move, np.clip(x_start - np.linalg.solve(hessian, gradient[..., None])[..., 0], low, high),
                     x_start)
        residuals = thin + ((x - x_start) @ flat).reshape(thin.shape)
    return x


NULL_STRIDE = 3


class Sensitivity(NamedTuple):
    """What effects would change, beyond what the fit's own unknowns can make up for."""

    names: tuple[str, ...]  # the effect of each direction
    gram: Floats  # (d, d) cosines between directions
    gains: Floats  # (d,), of each in -2 log likelihood, if it is there at the size it was tried at

    def list_unseen_effects(self, gain: float) -> list[str]:
        """The effects of which no direction would gain so much."""
        visible_names = {name for name, each in zip(self.names, self.gains, strict=True) if each >= gain}
        return [name for name in dict.fromkeys(self.names) if name not in visible_names]


def compute_sensitivity(problem: Problem, fit: Fit, effects: Iterable[str]) -> Sensitivity:
    """Directions of the effects' starts at the fit, in whitened residuals, the fit's unknowns projected out."""
    starts = [(e.name, s) for e in map(problem.model.find_effect, effects) for s in e.starts
              if e.port not in ("command", "reading")]
    if not starts:
        return Sensitivity((), np.empty((0, 0)), np.empty(0))
    names = list(dict.fromkeys([*fit.values, *(n for _, s in starts for n in s)]))
    base_values = [fit.values.get(n, problem.model.values[n]) for n in names]
    rows = np.array([base_values, *([s.get(n, v) for n, v in zip(names, base_values, strict=True)] for _, s in starts)])
    parts = np.array_split(rows, -(-len(rows) // TOGETHER))
    white = np.concatenate([problem.whiten_predictions(problem.predict_outputs(names, part))[:, :, ::NULL_STRIDE]
                            for part in parts])
    thin = (white[1:] - white[0]).reshape(len(starts), -1) * np.sqrt(NULL_STRIDE)
    slopes = fit.jacobian[:, :, ::NULL_STRIDE].reshape(len(fit.x), thin.shape[1]) * np.sqrt(NULL_STRIDE)
    prior = np.diag(weigh_priors(fit.free) + 1e-9)
    directions = thin - (thin @ slopes.T) @ np.linalg.solve(slopes @ slopes.T + prior, slopes)
    length = np.sqrt(np.maximum(np.einsum("ij,ij->i", directions, directions), 1e-300))
    return Sensitivity(tuple(e for e, _ in starts), (directions @ directions.T) / np.outer(length, length), length**2)


def compute_p_value(s: Sensitivity, gain: float, parameters: int = 1, seed: int = 0) -> float:
    """Chance that the best of all effects gains as much where nothing is missing.

    Runs without any effect are simulated in the space of the effects' directions, where their noise is normal with the
    directions' cosines as covariance; an effect with a bound at its off value gains only on its own side. Beyond the
    reach of the draws, the bound of Bonferroni.
    """
    rng = np.random.default_rng(seed)
    weight, vectors = np.linalg.eigh(s.gram)
    draws = rng.standard_normal((NULL_DRAWS, len(weight))) @ (vectors * np.sqrt(np.maximum(weight, 0.0))).T
    best = (np.maximum(draws, 0.0) ** 2).max(axis=1)
    share = float(np.mean(best >= gain))
    bound = len(set(s.names)) * float(chdtrc(parameters, max(gain, 0.0)))
    return share if share > 10.0 / NULL_DRAWS else min(max(bound, 1e-300), max(share, 1.0 / NULL_DRAWS))
