"""Which physical effect is missing from a model: the verdict, with its evidence and its doubt.

The decision procedure, stage by stage in the order of their action; each acts only where its gate lets it. Costs and
gains are in -2 log likelihood; floors are those of the worst signal. docs/explain.md has the table with the values of
the thresholds.

| stage | acts if | what it does |
|---|---|---|
| marks | Cor differs by more than {FIRMWARE_DIFFERS:g} roundings, or all positions are multiples of one step | names the effect of the firmware or the converter |
| base | always | fits the tolerances; learns the noise if at most {RESIDUAL_IS_NOISE:g} floors are left, and fits with a population if the mean square is above {WHITE_SQUARE_POOR:g} |
| first effect | always | fits the eight effects that promise to gain more than {GAIN_WORTH_A_FIT:g}, in stages, the best two to the end; the base again from there, if the best gains more than {GAIN_SEEN:g} |
| noise | the base leaves more than noise | learns the noise under the best first effect; fits the base and the best four again |
| second effect | the first leaves more than noise and gains more than {GAIN_SEEN:g}, or only noise with far tolerances | fits the four most promising effects beside each of the best two |
| third effect | so does the second, which also removes {FURTHER_EFFECT_SHARE:g} of the excess cost, and leaves at most {ERROR_PARTLY_EXPLAINED:g} of the excess on the held-out run | the same |
| finer steps | the best leaves at most {RESIDUAL_IS_NEAR_NOISE:g} floors | asks whether 20 steps a cycle leave only noise |
| missed stops | that holds for the first effect, and the second gains at most {GAIN_SEEN:g} | fits the first with a population |
| more noise | the best leaves more than noise, or its tolerances are those of {TOLERANCES_FAR_SHARE:.2%} of healthy units | searches again from a nominal unit with 30 and 6 times the noise |
| other valleys | two effects remove {FURTHER_EFFECT_SHARE:g} of the excess cost and still leave more than noise | fits the best two pairs with a population |
| number of effects | always | keeps the effects that gain more than {GAIN_SEEN:g}, of several only those whose removal costs more than {GAIN_CONVINCES:g} or leaves far tolerances; or that gain {GAIN_DOUBTFUL:g} on the run and alone leave only noise |
| last fits | always | finishes the base and the best four, or two that leave more than {RESIDUAL_IS_NEAR_NOISE:g} floors, with finer steps, on the repeats too; if the best leaves a mean square above {WHITE_SQUARE_POOR:g} or has far tolerances, begins again those of the best two that do; with a population these and the base, if they leave only noise and still such a mean square or far tolerances, unless the solver errs |
| stops of the last fits | no observer, and the best still leaves such a mean square | leaves out the rows that hang on a stop, and those after them that are not noise; finishes again |
| intervals | the base leaves only noise | drops effects whose 95 % interval holds the off value |
| small gain | the gain is below {GAIN_DOUBTFUL:g} | fits the base again from there; a single effect that then gains at most {GAIN_SEEN:g} begins again from the base |
| rivals | the best one leaves only noise | begins the others that do so too, and effects whose signature has a cosine of {LOOKS_ALIKE:g} with one of its, from its tolerances |
| small gain, again | the same | drops such an effect |
| solver | half the step changes more than {SOLVER_ERROR_SHARE:g} floors | finishes again with 50 steps a cycle |
| tolerances | the best leaves only noise, with far tolerances | takes these back in eighths, with each of four effects in their place; keeps those that end near |
| intervals, again | the squares of the sizes of one of several effects are below {GAIN_CONVINCES:g} variances | leaves it out, if the others leave only noise; one without such an interval not where they then have far tolerances |
| own effects | nothing is missing, but only with other sizes of effects that the model has | names those |
| whole recording | only an excerpt was fitted | judges on all rows |
| left-out rows | the replay has an observer | judges on all rows that hang on no stop, as on a held-out run |
| held-out run | there is one | rejects an effect that leaves more than {RESIDUAL_HELD_OUT:g} floors in the typical block; up to {HELD_OUT_UNDECIDED_SHARE:g} of the run may be undecided |
| verdict | always | see below |
| wave | the verdict is PARTLY, and a wave along the stroke explains more | names no effect |
| hidden effects | only noise is left | names those that would gain less than {GAIN_DETECTED:g} at any usual size; nothing is missing only if they are at most half of all |
| law | the verdict is PARTLY or UNEXPLAINED | looks for a law, and describes the residual; one that alone leaves only noise takes the place of effects that do not |
"""  # noqa: E501
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from fdi.discovery.detectable import WITHOUT_SIZE, Blind, find_hidden_effects
from fdi.discovery.residual_pattern import is_periodic_in_position
from fdi.discovery.search import FINE, Hypothesis, Search, Sensitivity
from fdi.estimation import (
    Problem,
    answer_readings,
    compute_typical_rms,
    find_controller_gain,
    find_undecided_rows,
    find_unpredictable_rows,
    fit_unknowns,
    has_controller_memory,
    list_tolerance_sizes,
    replay_fit,
)
from fdi.progress import Progress, Stage, ignore_progress
from fdi.thresholds import (
    COMB_HIDDEN,
    ERROR_PARTLY_EXPLAINED,
    FINEST_COMB,
    FIRMWARE_DIFFERS,
    FIRMWARE_EXPLAINED,
    FURTHER_EFFECT_SHARE,
    GAIN_CONVINCES,
    GAIN_DETECTED,
    GAIN_DOUBTFUL,
    GAIN_SEEN,
    GAIN_TIE,
    HELD_OUT_UNDECIDED_SHARE,
    INTERVAL_95_SD,
    OFF_ALONE_RATIO,
    RESIDUAL_HELD_OUT,
    SIGNAL_SPOILED,
    SOLVER_ERROR_SHARE,
)
from fdi.trace import Floats, Trace, find_comb, hold_last, is_rounding_left, measure_resolution, rms
from plant import Model, list_searched_effects

NOISE_LEFT = ("NOTHING_MISSING", "NOT_RESOLVABLE", "EXPLAINED", "AMBIGUOUS")
LONG = 10  # rounds of a last fit on which a verdict hangs alone


class HeldOut(NamedTuple):
    """How a hypothesis does on the held-out run."""

    holds: bool
    undecided: float = 0.0  # share of the run that no model can predict, and that was therefore not judged
    decided: Mapping[str, float] = {}  # RMS residual of the rest, SI; empty where all of the run was judged


@dataclass(frozen=True, eq=False)
class Explanation:
    """What `explain` found."""

    verdict: str
    effects: tuple[str, ...]
    base: Hypothesis
    ranked: tuple[Hypothesis, ...]  # best first
    ledger: tuple[Hypothesis, ...]  # base, then one more effect each
    floor: Mapping[str, float]
    holdout: Mapping[tuple[str, ...], Mapping[str, float]]
    marks: Marks
    blind: Sensitivity
    search: Search = field(repr=False)
    unseen: Mapping[tuple[str, ...], HeldOut] = field(default_factory=dict)  # of the best hypotheses
    hidden: tuple[Blind, ...] = ()  # effects that tolerances make up for; none where more than noise is left
    excerpt: str = ""  # which part of a long recording was fitted


def explain(model: Model, est: Trace, repeats: Sequence[Trace] = (), holdout: Trace | None = None,
            progress: Progress = ignore_progress, whole: Sequence[Trace] = ()) -> Explanation:
    """The verdict on a model and a measured run.

    Args:
        model: what the user believes.
        est: the run to explain.
        repeats: further runs of the same command: they tell noise from physics.
        holdout: a run of another command: it tells physics from luck.
        progress: called with each stage and the share done, 0 to 1.
        whole: the recordings that `est` and `repeats` were cut from, where they were: what is found is judged on them.
    """
    marks = find_marks(model, whole or [est, *repeats])
    candidates = [e.name for e in list_searched_effects(model.plant)
                  if e.port not in ("command", "reading") and e.starts]
    search = Search(model, est, repeats, candidates, holdout=holdout, whole=whole, rounding=marks.rounding)
    progress("fitting the tolerances", 0.03)
    base = search.fit_base()
    if base.is_at_floor:
        search.learn_noise(base)
        base = search.refit_hypothesis(base)
        if base.is_poor:  # by a missed stop, beside which nothing else would be looked for
            base = search.search_widely(base)
    levels = _search_levels(search, base, progress)
    if not any(level[0].is_near_floor for level in levels) and search.leave_out_bounces(levels[0][0]):
        levels = _search_levels(search, search.fit_base(), progress)
    return _conclude(search, levels, marks, progress)


def _search_levels(search: Search, base: Hypothesis, progress: Progress) -> list[list[Hypothesis]]:
    """Hypotheses with 0, 1, 2 .. effects, best first in each level."""
    levels, beam = [[base]], [base]
    shares = (0.07, 0.3, 0.4, 0.5)  # of the whole work, before each of three effects and after them
    for count in (1, 2, 3):
        fits = 40 if count == 1 else 20 * len(beam)
        search.stage = Stage(progress, f"looking for effect {count}", shares[count - 1], shares[count], fits)
        ranking: list[Hypothesis] = []
        for parent in beam:
            ranking = drop_duplicates([*ranking, *search.add_each_effect(parent, 8 if count == 1 else 4)])
            if ranking and ranking[0].is_at_floor:
                break  # the other ways would have to get there as well, from further off
        if not ranking and count == 1 and not base.is_at_floor:  # the fit of the base hides the way to any effect
            ranking = search.add_each_with_more_noise(base, [])
        if not ranking:
            break
        if count == 1 and not base.is_at_floor:
            search.learn_noise(ranking[0])
            base, *best = search.map_parallel(search.refit_hypothesis, [base, *ranking[:4]])
            ranking = sorted(best, key=lambda h: h.cost) + ranking[4:]
        if count == 1 and measure_gain(base, ranking[0]) > GAIN_SEEN:  # more than what tolerances alone gain
            levels[0] = [search.refit_base(base, ranking[0])]
        is_done = search.reaches_floor(ranking[0])
        if (not is_done and count == 2 and levels[1][0].is_near_floor
                and measure_gain(levels[1][0], ranking[0]) <= GAIN_SEEN):
            # either no second effect is missing but stops that the first fit missed, or one whose gain such stops hide
            levels[1] = drop_duplicates([search.search_widely(levels[1][0]), *levels[1]])
            levels.append(ranking)
            break
        if not is_done or ranking[0].is_far or (levels[0][0].is_at_floor and levels[0][0].is_far):
            # a fit in a local minimum leads the scan astray, and far tolerances may stand in for an effect
            ranking = drop_duplicates([*ranking, *search.add_each_with_more_noise(beam[0], ranking)])
        if count == 2 and not is_done and takes_fair_share(search.problem, levels[1][0], ranking[0]) and not \
                search.reaches_floor(ranking[0]):
            ranking = _search_other_valleys(search, levels, ranking)
        levels.append(ranking)
        before = levels[-2][0]
        if (((is_done or ranking[0].is_at_floor) and not ranking[0].is_far)
                or measure_gain(before, ranking[0]) <= GAIN_SEEN):
            break
        # the first effect is no such way: two large effects each help little alone
        if count > 1 and not (takes_fair_share(search.problem, before, ranking[0])
                              and _improves(search, before, ranking[0])):
            break
        beam = [h for h in ranking[:2] if h.cost < ranking[0].cost + 0.5 * (levels[0][0].cost - ranking[0].cost)]
    return levels


def _search_other_valleys(search: Search, levels: list[list[Hypothesis]], pairs: Sequence[Hypothesis]
                          ) -> list[Hypothesis]:
    """Pairs of effects, best first, two of which a population has sought anew: two effects share many local minima.

    So is the best single effect where it leaves little: a stop that it missed is no second effect.
    """
    singles = [h for h in levels[1][:1] if h.is_near_floor]
    hypotheses = search.map_parallel(search.search_widely, [*singles, *pairs[:2]])
    levels[1] = drop_duplicates([*hypotheses[:len(singles)], *levels[1]])
    return drop_duplicates([*hypotheses[len(singles):], *pairs])


def takes_fair_share(problem: Problem, before: Hypothesis, after: Hypothesis) -> bool:
    """Whether an effect takes away a fair part of what was left: less is what fits win by luck."""
    noise = float(np.isfinite(problem.trace.measurements).sum())
    return before.cost - after.cost >= FURTHER_EFFECT_SHARE * (before.cost - noise)


def _improves(search: Search, before: Hypothesis, after: Hypothesis) -> bool:
    """Whether a hypothesis leaves less of the held-out run than another, in the typical block, all signals together."""
    if search.holdout is None:
        return True
    floor = search.estimate_floor(after)
    noise = np.array([floor[s] for s in search.holdout.outputs])
    ratios = [compute_typical_rms(each) / noise for each in search.replay_holdout([before, after])[1]]
    excess = [float(np.sum(np.maximum(x**2 - 1.0, 0.0))) for x in ratios]
    return excess[1] < ERROR_PARTLY_EXPLAINED * excess[0]


def drop_duplicates(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best hypothesis of each set of effects, best first."""
    best: dict[frozenset[str], Hypothesis] = {}
    for h in sort_by_cost(hypotheses):
        best.setdefault(frozenset(h.effects), h)
    return list(best.values())


def measure_gain(parent: Hypothesis, h: Hypothesis) -> float:
    """What a hypothesis gains in -2 log likelihood: on its own run, and no more than about that on the repeats.

    Tolerances nearer to a healthy unit are a gain that no repeat can show.
    """
    gain = parent.cost - h.cost
    tolerance_gain = parent.tolerance_cost - h.tolerance_cost
    return min(gain, tolerance_gain + 2.0 * (parent.repeat_cost - h.repeat_cost)) if h.others else gain


def helps_explain(before: Hypothesis, after: Hypothesis, least: float) -> bool:
    """Whether an effect gains more than `least`, or leaves only noise where more was left or tolerances were far.

    Of a repeat even the right effect may miss another stop, which costs hundreds.
    """
    is_first_at_floor = not before.is_at_floor and after.is_at_floor and before.cost - after.cost > GAIN_DOUBTFUL
    return measure_gain(before, after) > least or is_first_at_floor or spares_far_tolerances(before, after)


def spares_far_tolerances(before: Hypothesis, after: Hypothesis) -> bool:
    """Whether both leave only noise, and only the first needs tolerances that few healthy units have."""
    return before.is_at_floor and before.is_far and after.is_at_floor and not after.is_far


def _conclude(search: Search, levels: list[list[Hypothesis]], marks: Marks, progress: Progress) -> Explanation:
    depth = _choose_depth(search, levels)
    search.refine_steps(FINE)
    base, close = _finish_fits(search, levels, depth, progress)
    floor = search.estimate_floor(close[0] if close else base)
    if search.measure_solver_error(close[0] if close else base, floor) > SOLVER_ERROR_SHARE:
        finest_fit_steps = 50  # a cycle: FINE is not enough, for example for a resonance of trapped oil
        search.refine_steps(finest_fit_steps)
        base = search.finish_hypothesis(base, 2)
        close = [search.finish_hypothesis(h, n) for h, n in zip(close, (6, 2), strict=False)]
        base, close = _doubt_small_gain(search, base, close, depth)
    close = leave_out_unneeded(search, _spare_far_tolerances(search, base, close))
    depth = len(close[0].effects) if close else 0
    level = levels[depth or -1] if max(depth, 1) < len(levels) else []
    others = search.map_parallel(lambda h: judge_left_out_rows(search, search.replay_hypothesis(h), floor),
                                 (h for h in level if h.effects not in [c.effects for c in close]))
    parents = [next((p for p in levels[i] if p.effects == close[0].effects[:i]), levels[i][0]) for i in range(1, depth)]
    if not close and (own := search.resize_own_effects(base)):
        base, *close = own
    base, *close = (judge_left_out_rows(search, h, floor) for h in search.judge_on_all([base, *close], FINE))
    ledger = [base, *parents, *close[:1]]
    hypotheses = [*ledger, *close[1:], *others[:3]]
    holdout = dict(zip((h.effects for h in hypotheses), search.measure_holdout(hypotheses), strict=True))
    unseen = {h.effects: _judge_unseen_run(search, h, floor) for h in close}
    holding = [h for h in close if unseen[h.effects].holds]
    part = bool(close) and _improves(search, base, close[0])
    costs = search.measure_unseen_costs([base, *close])
    verdict, effects = decide_verdict(base, close, holding, part, marks, floor, costs)
    if ((verdict in NOISE_LEFT and is_off_alone((close or [base])[0], floor))
            or (verdict == "PARTLY" and close and is_periodic_in_position(search, base, close[0]))):
        effects = tuple(f.effect for f in marks.prints)
        verdict = "PARTLY" if effects else "UNEXPLAINED"
    best = close[0] if close and verdict == "EXPLAINED" else base
    blind = search.compare_signatures(best.fit)
    progress("what this test cannot see", 0.94)
    doubtful = [*blind.list_unseen_effects(GAIN_DETECTED),
                *(e for e in search.effects if search.model.find_effect(e).revealed_by)]
    hard_to_see = [e for e in dict.fromkeys(doubtful) if e not in effects]
    hidden_effects = find_hidden_effects(search.problem, best.fit, hard_to_see if verdict in NOISE_LEFT else ())
    if verdict == "NOTHING_MISSING" and 2 * len(hidden_effects) > len(search.effects):
        verdict = "NOT_RESOLVABLE"
    return Explanation(verdict, effects, base, (*close, *others), tuple(ledger), floor, holdout, marks, blind, search,
                       unseen, tuple(hidden_effects))


def _choose_depth(search: Search, levels: list[list[Hypothesis]]) -> int:
    """How many effects the last fits have; `_prune_level` may put a better hypothesis first in that level."""
    firsts = [level[0] for level in levels]
    depth = max((i for i in range(1, len(levels)) if helps_explain(firsts[i - 1], firsts[i], GAIN_SEEN)
                 and (i == 1 or firsts[i - 1].is_at_floor
                      or takes_fair_share(search.problem, firsts[i - 1], firsts[i]))), default=0)
    if depth > 1 and firsts[1].is_at_floor and not helps_explain(firsts[1], firsts[depth], GAIN_CONVINCES):
        depth = 1
    if depth == 0 and len(levels) > 1 and (levels[0][0].is_far or not levels[0][0].is_at_floor):
        depth = 1  # a unit that is hardly healthy, or more than noise left: only fits taken to the end tell what helps
    return _prune_level(search, levels, depth)


def _finish_fits(search: Search, levels: Sequence[Sequence[Hypothesis]], depth: int, progress: Progress
                 ) -> tuple[Hypothesis, list[Hypothesis]]:
    """The base and the best hypotheses with `depth` effects, best first, with finer steps and to the end.

    There are none of the latter where the base does as well when it is taken as far.
    """
    rivals = [h for h in levels[depth] if h.cost < levels[depth][0].cost + 60.0 * GAIN_TIE] if depth else []
    close = rivals[:4 if levels[depth][0].is_near_floor else 2]  # where more than noise is left, none decides
    if close and not levels[0][0].is_at_floor:  # one that leaves little of what repeats may only have missed a stop
        clearest = min(levels[depth], key=lambda h: max(h.ratio.values()))
        close = close if clearest in close else [*close, clearest]
    # where no effect helps, the base is fitted until that is beyond doubt
    rounds = 2 if depth or levels[0][0].is_at_floor else LONG
    search.stage = Stage(progress, "last fits, with finer steps", 0.5, 0.93, rounds + 6 * len(close))
    is_cut = search.leave_out_undecided(levels[depth][0])
    base, *close = search.map_parallel(lambda work: search.finish_hypothesis(*work),
                                       [(levels[0][0], rounds), *((h, 5) for h in close)])
    close = sort_by_cost(close)
    best = (close or [base])[0]
    if search.leave_out_undecided(best) or is_cut:  # of the size that it has without these rows, further ones
        search.learn_noise(best)
        base, *close = search.map_parallel(partial(search.finish_hypothesis, rounds=2), [base, *close])
        close = sort_by_cost(close)
    # rivals of a fit that is not in doubt begin from its tolerances below
    doubtful_fits = close[:2] if close and (close[0].is_poor or close[0].is_far) else []
    base, *restarts = search.map_parallel(search.leave_valley,
                                          [base, *search.map_parallel(search.begin_again, doubtful_fits)])
    close = sort_by_cost([*restarts, *close[len(doubtful_fits):]])
    if close and ((is_cut and search.leave_out_undecided(close[0])) or search.leave_out_missed_stop(close[0])):
        base, *close = search.map_parallel(partial(search.finish_hypothesis, rounds=2), [base, *close])
    effects = [h.effects[0] for h in close]
    base, close = _doubt_small_gain(search, base, close, depth)
    if effects and not close:  # an effect may yet do more from where the base is now than by its own fit
        near = fit_unknowns(search.problem, base.fit.free, base.fit.x, 4)
        close = sort_by_cost(search.begin_effects(near, effects))
    return _doubt_small_gain(search, base, _compare_rivals(search, close), depth)


def _compare_rivals(search: Search, close: list[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, best first, after those that leave only noise have begun from the tolerances of the best.

    So do look-alikes of its effects. Where another one is best then, the others get the same chance from there.
    """
    def begin(h: Hypothesis, best: Hypothesis) -> Hypothesis:
        return search.begin_beside(best, h) if h.is_at_floor and h is not best else h

    for _ in range(2):
        if not close or not close[0].is_at_floor:
            break
        best, effect_sets = close[0], {frozenset(h.effects) for h in close if h.is_at_floor}
        more = search.begin_look_alikes(best, effect_sets)
        close = drop_duplicates([*search.map_parallel(partial(begin, best=best), close), *more])
        if close[0] is best:
            break
    return close


def _doubt_small_gain(search: Search, base: Hypothesis, close: list[Hypothesis], depth: int
                      ) -> tuple[Hypothesis, list[Hypothesis]]:
    """The base fitted again where effects gain little, and the hypotheses that still gain then."""
    if not close:
        return base, close
    if base.is_at_floor:
        base = search.leave_out_effects(base, close[0])
        close = [h for h in close if shows_effect(search.model, h, h.effects[-1])]
    if not close or measure_gain(base, close[0]) >= GAIN_DOUBTFUL:
        return base, close
    if measure_gain(base, close[0]) > GAIN_SEEN:
        base = search.finish_hypothesis(search.refit_base(base, close[0]), LONG)
        base = search.leave_out_effects(base, close[0])
    return base, close if depth > 1 or helps_explain(base, close[0], GAIN_SEEN) else []


def _spare_far_tolerances(search: Search, base: Hypothesis, close: list[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, best first, after those in which one more effect stands in for a tolerance that was far off."""
    best = base if base.is_at_floor or not close else close[0]
    if not (best.is_at_floor and best.is_far) or any(spares_far_tolerances(best, h) for h in close):
        return close
    hypotheses = search.add_each_in_place(best, LONG)
    return [*(h for h in hypotheses if spares_far_tolerances(best, h)), *close]


def leave_out_unneeded(search: Search, close: list[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, best first; the best of several effects without one that is not needed, if noise is left then.

    A further effect can help a fit out of a local minimum, past an impact or over steps of the solver that the last
    fits refine, and then have next to no size itself. One that spares the unit far tolerances is needed.
    """
    def are_shown(h: Hypothesis, least_sd: float = INTERVAL_95_SD) -> bool:
        return all(shows_effect(search.model, h, e, least_sd) for e in h.effects)

    if not close or len(close[0].effects) < 2 or are_shown(close[0], GAIN_CONVINCES**0.5):
        return close
    fewer = search.finish_hypothesis(search.drop_each_effect(close[0])[0])
    more = [h for h in close if set(fewer.effects) <= set(h.effects)]
    healthy_fits = [h for h in more if fewer.is_far and not h.is_far and are_shown(h)]
    if not fewer.is_at_floor or close[0] in healthy_fits:
        return close
    return [*healthy_fits, fewer, *(h for h in close if h not in more)]


def shows_effect(model: Model, h: Hypothesis, effect: str, least_sd: float = INTERVAL_95_SD) -> bool:
    """Whether a size of an effect is so many standard deviations from its off value, by default those of 95 %.

    If none is, the fit is better only by a stop that it met by chance. A frequency or a speed at which an effect of
    next to no size happens to help is no size, and a mass that a healthy unit may have is not missing.
    """
    entry = model.find_effect(effect)
    values, tolerances = h.fit.values, list_tolerance_sizes(model)
    sizes = [name for name in entry.fitted
             if entry.off.get(name, 0.0) == 0.0 and entry.parameters[name].unit not in WITHOUT_SIZE]
    return any(abs(values[name] - entry.off.get(name, model.nominal.get(name, 0.0)))
               > max(least_sd * h.fit.spread(name), tolerances.get(name, 0.0)) for name in sizes or entry.fitted)


def sort_by_cost(hypotheses: Iterable[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, best first: by what they leave of their own runs and of the repeats."""
    return sorted(hypotheses, key=lambda h: h.cost + h.repeat_cost)


def _prune_level(search: Search, levels: list[list[Hypothesis]], depth: int) -> int:
    """The depth, after what was added first and is no longer wanted has gone: a later effect may do alone."""
    while depth > 1:
        best = search.drop_each_effect(levels[depth][0])[0]
        if helps_explain(best, levels[depth][0], GAIN_CONVINCES):
            break
        depth -= 1
        levels[depth] = drop_duplicates([best, *levels[depth]])
    return depth


def decide_verdict(base: Hypothesis, close: Sequence[Hypothesis], holding: Sequence[Hypothesis], part: bool,
                   marks: Marks, floor: Mapping[str, float], unseen: Sequence[float] = ()
                   ) -> tuple[str, tuple[str, ...]]:
    """The verdict and the effects it names.

    Args:
        base: the model without any further effect.
        close: the best hypotheses, best first.
        holding: those of them that hold on the held-out run.
        part: whether the best one leaves less of that run than the base does.
        marks: what the controller's output and the position show exactly.
        floor: of each signal, SI.
        unseen: costs of the base and of the best ones on the held-out run, where there is one.

    >>> from types import SimpleNamespace
    >>> base = SimpleNamespace(effects=(), is_at_floor=True, is_far=False)
    >>> marks = [Marks(9e3, 1e-7, (Fingerprint("asymmetric_gain", {}, 9e3, left, True),)) for left in (1.0, 900.0)]
    >>> [decide_verdict(base, [], [], False, each, {})[0] for each in marks]
    ['EXPLAINED', 'PARTLY']
    """
    costs = dict(zip([h.effects for h in (base, *close)], unseen or [0.0] * (1 + len(close)), strict=True))
    prints = tuple(f.effect for f in marks.prints)
    firmware_left = marks.is_firmware_different and not any(p.after <= FIRMWARE_DIFFERS for p in marks.prints
                                                            if p.is_firmware)
    if not close:
        if not base.is_at_floor or base.is_far or firmware_left:
            return ("PARTLY" if prints else "UNEXPLAINED"), prints
        return ("EXPLAINED" if prints else "NOTHING_MISSING"), prints
    best = close[0]
    explanations = [h for h in holding if h.is_at_floor]
    healthy_fits = [h for h in explanations if spares_far_tolerances(base, h)]
    # where the base leaves only noise: single stops that a fit has met by chance are missed elsewhere
    sure = healthy_fits or [h for h in explanations
                            if not (unseen and base.is_at_floor) or costs[()] - costs[h.effects] > GAIN_SEEN]
    if (base.is_at_floor and not healthy_fits
            and (measure_gain(base, best) < GAIN_CONVINCES or (explanations and not sure))):
        alike = [h for h in close if not h.is_far and measure_gain(base, h) > GAIN_SEEN
                 and not _is_better(best, h, costs)]
        if firmware_left:
            return ("PARTLY" if prints else "UNEXPLAINED"), prints
        return ("NOT_RESOLVABLE", _list_effects([best, *alike])) if not prints else ("EXPLAINED", prints)
    explanations = sure
    if explanations and all(h.is_far for h in explanations):
        return "PARTLY", (*prints, *explanations[0].effects)
    if best.is_at_floor and explanations and not firmware_left:
        if healthy_fits:
            equal = [h for h in explanations if measure_gain(h, explanations[0]) < GAIN_TIE]
        else:  # named alone only with the gain with which an effect is named where only noise is left without it
            equal = [h for h in explanations if h is explanations[0] or (
                not h.is_far and not _is_better(explanations[0], h, costs)
                and not (base.is_at_floor and measure_gain(base, h) < GAIN_CONVINCES))]
        if len(equal) > 1:
            return "AMBIGUOUS", (*prints, *_list_effects(equal))
        return "EXPLAINED", (*prints, *explanations[0].effects)
    if part and explains_part(base, best, floor):
        return "PARTLY", (*prints, *best.effects)
    return ("PARTLY" if prints else "UNEXPLAINED"), prints


def _list_effects(hypotheses: Iterable[Hypothesis]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(effect for h in hypotheses for effect in h.effects))


def _is_better(h: Hypothesis, other: Hypothesis, unseen: Mapping[tuple[str, ...], float]) -> bool:
    """Whether one hypothesis explains more than another: its own runs, and these and the held-out run together."""
    gain = measure_gain(other, h)
    return gain >= GAIN_TIE and gain + unseen[other.effects] - unseen[h.effects] >= GAIN_CONVINCES


def is_off_alone(h: Hypothesis, floor: Mapping[str, float]) -> bool:
    """Whether a run is off where none of its repeats is: what happened once is no effect, and no noise either.

    >>> from types import SimpleNamespace
    >>> fit = SimpleNamespace(residuals=np.full((1, 5), 9.0))
    >>> runs = [SimpleNamespace(fit=fit, errors={"xj": 9.0}, others=(np.full((1, 5), x),)) for x in (1.0, 6.0)]
    >>> [is_off_alone(run, {"xj": 1.0}) for run in runs]
    [True, False]
    """
    # not the errors of a long recording: the repeats were cut as the run was
    return any(rms(h.fit.residuals[i, :h.others[0].shape[1]]) > OFF_ALONE_RATIO * max(
        floor[name], *(rms(other[i]) for other in h.others)) for i, name in enumerate(h.errors) if h.others)


def explains_part(base: Hypothesis, h: Hypothesis, floor: Mapping[str, float]) -> bool:
    """Whether a hypothesis takes away a share of the base's excess, and makes no signal much worse."""
    excess, base_excess = (measure_excess(each.errors, floor) for each in (h, base))
    is_spoiled = any(h.errors[s] > SIGNAL_SPOILED * max(before, floor[s]) for s, before in base.errors.items())
    return min(excess, 1e18) < ERROR_PARTLY_EXPLAINED**2 * base_excess and not is_spoiled


def measure_excess(errors: Mapping[str, float], floor: Mapping[str, float]) -> float:
    """Squared error above the squared floor, summed over the signals, in squared floors."""
    return float(sum(max((e / floor[s]) ** 2 - 1.0, 0.0) for s, e in errors.items()))


def _judge_unseen_run(search: Search, h: Hypothesis, floor: Mapping[str, float]) -> HeldOut:
    """Whether noise alone is left of the held-out run; if not of all of it, of what does not hang on a small stop."""
    if search.holdout is None:
        return HeldOut(True)
    problem, (residuals,) = search.replay_holdout([h])
    return _judge_run(problem, residuals, h, floor)


def judge_left_out_rows(search: Search, h: Hypothesis, floor: Mapping[str, float]) -> Hypothesis:
    """The hypothesis; where it fails in rows that the search left out for others, with what it leaves there.

    Behind a backlash rows hang on an impact; where there is none, the same rows may show that something is missing.
    """
    if search.model.kind.correct is None:
        return h
    problem = search.make_problem(search.run, search.finest)
    outcome = _judge_run(problem, problem.compute_residuals(h.fit.free, h.fit.x[None])[0], h, floor)
    return h if outcome.holds else replace(h, ratio={s: max(x, outcome.decided.get(s, 0.0) / floor[s])
                                                     for s, x in h.ratio.items()})


def _judge_run(problem: Problem, residuals: Floats, h: Hypothesis, floor: Mapping[str, float]) -> HeldOut:
    """Whether `residuals`, (s, n), of a run under a hypothesis are noise, or those of the rows that hang on no stop."""
    if _is_noise(residuals, problem.trace, floor):
        return HeldOut(True)
    is_undecided = find_undecided_rows(problem, h.fit, floor)
    if problem.model.kind.correct is not None:  # a bounce that was missed has consequences
        is_undecided |= (find_unpredictable_rows(problem, replay_fit(problem, h.fit, h.fit.x), floor)
                         & problem.trace.usable)
    elif not is_undecided.any():
        return HeldOut(False)
    share, rest = float(is_undecided.mean()), residuals[:, ~is_undecided]
    if share > HELD_OUT_UNDECIDED_SHARE:
        return HeldOut(False)
    errors = dict(zip(problem.trace.outputs, map(rms, rest), strict=True))
    return HeldOut(_is_noise(rest, problem.trace, floor), share, errors)


def _is_noise(residuals: Floats, trace: Trace, floor: Mapping[str, float]) -> bool:
    return all(e <= RESIDUAL_HELD_OUT * floor[s]
               for s, e in zip(trace.outputs, compute_typical_rms(residuals), strict=True))


BUS_CURRENT, BUS_POSITION = 1e-8, 1e-7  # A, m: what one count on the bus is worth (docs/bus.md)
SIZES = 41  # trial values of a parameter, logarithmic, one decade beyond its starts on either side


class Fingerprint(NamedTuple):
    """An effect found without a doubt; `parameters` are (value, low, high) in SI units."""

    effect: str
    parameters: dict[str, tuple[float, float, float]]
    before: float  # residual without it, in units of its own resolution
    after: float  # with it
    is_firmware: bool = False


class Marks(NamedTuple):
    """What runs show without noise: effects of firmware and transducer, and how exactly Cor follows from XJ."""

    controller: float  # RMS of Cor against the model's firmware, over `resolution`; 0 where no firmware is known
    resolution: float  # A, RMS that rounding leaves of that difference
    prints: tuple[Fingerprint, ...]
    step: float = 0.0  # m, of the positions, where all are multiples of one; 0: they are not
    is_recorder: bool = False  # whether only the recording is rounded to that step, and the controller reads finer
    rivals: tuple[Fingerprint, ...] = ()  # effects of the firmware that explain its answer less well than the best one
    unseen: tuple[str, ...] = ()  # effects of the firmware, where its answer cannot be computed from these runs

    @property
    def rounding(self) -> float:
        """RMS of the positions' rounding, m."""
        return float(self.step / np.sqrt(12.0))

    @property
    def is_firmware_different(self) -> bool:
        """Whether Cor is another firmware's than the model's."""
        return self.controller > FIRMWARE_DIFFERS


def find_marks(model: Model, traces: Sequence[Trace]) -> Marks:
    """The marks in runs of one bench; the first tells how positions were rounded.

    A transducer with few bits is read by the controller as well, so Cor follows from the steps. Where Cor differs by
    what rounding leaves, the recorder has rounded what the controller knows better, and that is no effect of the bench.
    """
    comb = find_comb(traces[0].anchor, FINEST_COMB)
    step, prints = comb.step if comb else 0.0, list[Fingerprint]()
    resolution, is_recorder = measure_firmware_resolution(model, traces[0]), False
    if comb and model.kind.controller:
        drive_step = find_controller_gain(model, traces[0].period)[0] * step
        is_recorder = is_rounding_left(compute_firmware_residual(model, traces[0]), drive_step, resolution)
        resolution = float(np.hypot(resolution, drive_step / np.sqrt(12.0))) if is_recorder else resolution
    least_step = COMB_HIDDEN * model.nominal.get(model.kind.signals.controlled.noise, 0.0)
    is_offered = "quantisation" in {e.name for e in model.kind.list_effects()} - {*model.effects}
    if comb and comb.step > least_step and not is_recorder and is_offered:
        sizes = {"quantisation.lsb": (step, step - comb.doubt, step + comb.doubt)}
        prints.append(Fingerprint("quantisation", sizes, step / FINEST_COMB, 0.0))
    error, firmware, unseen = 0.0, list[Fingerprint](), tuple[str, ...]()
    if model.kind.controller:
        rms = _measure_rms(model, traces)
        error = float(np.nan_to_num(rms / resolution))
        names = [e.name for e in model.kind.list_effects()
                 if e.firmware and e.name not in model.effects and len(e.fitted) == 1
                 and any(s[e.fitted[0]] != 0.0 for s in e.starts)]
        fingerprints = [_fit_size(model, traces, e, error, resolution) for e in names if error > FIRMWARE_DIFFERS]
        firmware = sorted((f for f in fingerprints if f.after < FIRMWARE_EXPLAINED * error), key=lambda f: f.after)
        unseen = tuple(names) if np.isnan(rms) else ()
    return Marks(error, resolution, (*prints, *firmware[:1]), step, is_recorder, tuple(firmware[1:]), unseen)


def measure_firmware_resolution(model: Model, trace: Trace) -> float:
    """How exactly the firmware's answer follows from what a trace holds, A rms: counts of com, XJ, Cor on the bus.

    Where the file holds Com or Cor with fewer digits, these.
    """
    gain, signals = find_controller_gain(model, trace.period)[0], trace.declared
    steps = np.array([
        max(BUS_CURRENT, measure_resolution(trace.drive, signals.drive.unit)), gain * BUS_POSITION * trace.scale,
        gain * max(BUS_POSITION * trace.scale, measure_resolution(trace.command, signals.command.unit))])
    return float(np.sqrt((steps**2).sum() / 12.0))


def compute_firmware_residual(model: Model, trace: Trace) -> Floats:
    """Cor of the model's controller on the measured com and XJ, minus the measured Cor: (n,) A, NaN where missing.

    It is missing as well where the controller remembers what came before the recording, or what was lost of it.
    """
    own = replace(model, effects=tuple(e for e in model.effects if model.find_effect(e).firmware))
    answers = answer_readings(own, trace, trace.command, hold_last(trace.anchor))
    if has_controller_memory(model) and not trace.usable.all():
        answers[int(np.argmin(trace.usable)):] = np.nan
    return answers - np.where(trace.incomplete, np.nan, trace.drive)


def _measure_rms(model: Model, traces: Sequence[Trace]) -> float:
    """RMS of the firmware's residuals, A; NaN where it can be computed in none of the runs."""
    residuals = [compute_firmware_residual(model, r) for r in traces]
    return float(np.sqrt(np.mean([float(np.nanmean(x**2)) for x in residuals if not np.isnan(x).all()] or [np.nan])))


def _fit_size(model: Model, traces: Sequence[Trace], name: str, before: float, unit: float) -> Fingerprint:
    """The size of a firmware effect, of each sign that it starts with: logarithmic over all sizes, then ever closer."""
    entry = model.find_effect(name)
    parameter = entry.fitted[0]
    ready, quantity = model.with_effects([name]), entry.parameters[parameter]
    starts = [s[parameter] for s in entry.starts if s[parameter] != 0.0]
    span = np.log(min(map(abs, starts)) / 10.0), np.log(max(map(abs, starts)) * 10.0)

    def measure_error(size: float) -> float:
        return np.inf if quantity.refuses(size) else _measure_rms(ready.replace({parameter: size}), traces) / unit

    fingerprints = []
    for sign in sorted(set(np.sign(starts).tolist())):
        low, high = span
        for _ in range(6):  # each time closer around the best size
            sizes = np.linspace(low, high, SIZES)
            errors = [measure_error(sign * float(np.exp(s))) for s in sizes]
            k = int(np.argmin(errors))
            low, high = sizes[max(k - 1, 0)], sizes[min(k + 1, SIZES - 1)]
        ends = sorted(sign * float(np.exp(s)) for s in (low, high))
        interval = sign * float(np.exp(sizes[k])), ends[0], ends[1]
        fingerprints.append(Fingerprint(name, {parameter: interval}, before, errors[k], entry.firmware))
    return min(fingerprints, key=lambda f: f.after)
