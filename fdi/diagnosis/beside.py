"""What else is wrong with a unit beside the two valve faults, and what that makes of their sizes.

Several effects may fit a recording equally well. The sizes of the faults are then averaged over all of them, so that
an interval holds what each of them allows.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdi.diagnosis.faults import FAULTS, Estimate, Fault, Level, judge_size
from fdi.diagnosis.refine import Refinement
from fdi.thresholds import GAIN_CONVINCES, GAIN_TIE, INTERVAL_95_SD, WEIGHT_COUNTS


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
        return {fault.name: getattr(self.refinement, fault.symbol) for fault in FAULTS}

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
    for first in explanations:
        for second in explanations:
            a, b = first.sizes[fault.name], second.sizes[fault.name]
            apart = not b.low <= a.value <= b.high and not a.low <= b.value <= a.high
            if apart and first.levels[fault.name] != second.levels[fault.name]:
                return True
    return False
