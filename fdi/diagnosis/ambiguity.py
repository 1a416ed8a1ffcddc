"""Faults that a recording does not tell apart: what their common posterior still says of each, and of all together.

Sizes are estimated together, with a common Gaussian posterior (the covariance of the fit, all other unknowns left
free). Two faults that change the signals alike have wide intervals each, although their sum is well known. Then the
bounds of the one cut what the other may be: no size is below that of a new unit. So an interval that cannot be judged
is replaced by that of the profile likelihood within the bounds of all faults. What still cannot be judged is tested
together as one fault alone is: if no unit that is healthy in all of them is within the 95 % region, at least one of
them has reached MidBand as far as the recording tells, and they form a group.

The posterior is one at a point, so unknowns are what laws go with (gains by logarithms, clearance by its cube).
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import chdtrc, chdtri

from fdi.diagnosis.faults import Estimate, Level, widen_for_many
from fdi.diagnosis.refine import Refinement, place_value
from fdi.estimation import scaled_bounds
from fdi.thresholds import GROUP_CORRELATION, INTERVAL_95_SD, SUSPECT_HEALTHY_TOLERANCES
from fdi.trace import Floats

Group = tuple[str, ...]  # names of faults of which at least one has grown, and may have reached MidBand


class _Region:
    """The posterior of the scaled sizes of the faults, (f,), and their bounds."""

    def __init__(self, refinement: Refinement) -> None:
        names = [f.name for f in refinement.fit.free]
        self.faults = refinement.faults
        self.places = [names.index(fault.parameter) for fault in refinement.faults]
        self.free = [refinement.fit.free[k] for k in self.places]
        self.x = refinement.fit.x[self.places]
        covariance = refinement.fit.covariance[np.ix_(self.places, self.places)]
        values, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
        self.root = (axes / np.sqrt(np.maximum(values, 1e-12 * values.max()))).T  # |root (x - x0)|: distance, s.d.
        self.spread = np.sqrt(np.diag(covariance))
        self.alike = np.abs(covariance / np.outer(self.spread, self.spread)) > GROUP_CORRELATION
        self.low, self.high = scaled_bounds(self.free)

    def measure_distance(self, low: Floats, high: Floats) -> float:
        """Distance, standard deviations, of the nearest point between the limits, (f,) each."""
        wide = np.maximum(high, low + 1e-9 * self.spread)
        return float(np.linalg.norm(self.root @ (lsq_linear(self.root, self.root @ self.x, (low, wide)).x - self.x)))

    def find_ends(self, i: int, factor: float) -> Estimate:
        """The profile's interval of fault `i`, SI, `factor` times 1.96 standard deviations."""
        ends = []
        for bound in (self.low[i], self.high[i]):
            inside, outside = float(self.x[i]), float(bound)
            far = float(self.x[i]) + np.sign(outside - inside) * 3.0 * factor * INTERVAL_95_SD * self.spread[i]
            outside = min(outside, far) if outside > inside else max(outside, far)
            if self._reach(i, outside) > factor * INTERVAL_95_SD:
                for _ in range(30):
                    middle = 0.5 * (inside + outside)
                    is_in = self._reach(i, middle) <= factor * INTERVAL_95_SD
                    inside, outside = (middle, outside) if is_in else (inside, middle)
            else:
                inside = outside
            ends.append(self.free[i].value(inside))
        return Estimate(self.free[i].value(float(self.x[i])), *sorted(ends))

    def _reach(self, i: int, value: float) -> float:
        low, high = self.low.copy(), self.high.copy()
        low[i] = high[i] = value
        return self.measure_distance(low, high)

    def limit_to_healthy(self, low: Floats, high: Floats, i: int, tolerance: float) -> None:
        """Narrow the limits, (f,), to sizes of fault `i` that are no worse than a healthy unit's, which may be off its
        nominal size by some of these relative tolerances.
        """
        fault = self.faults[i]
        sizes = [fault.healthy * (1.0 + way * SUSPECT_HEALTHY_TOLERANCES * tolerance) for way in (-1.0, 1.0)]
        if not fault.both_ways:
            sizes[fault.falls] = fault.range[fault.falls]
        low[i], high[i] = sorted(min(max(place_value(self.free[i], x), self.low[i]), self.high[i]) for x in sizes)

    def group_alike(self, members: Sequence[int]) -> list[list[int]]:
        """The members in groups of those whose sizes correlate."""
        groups: list[list[int]] = []
        for i in members:
            near = [g for g in groups if any(self.alike[i, j] for j in g)]
            groups = [g for g in groups if g not in near] + [[*(j for g in near for j in g), i]]
        return groups


def cut_intervals(refinement: Refinement, names: Sequence[str], sizes: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """The intervals of these faults within the bounds of all faults; those that this makes no narrower stay."""
    region = _Region(refinement)
    intervals = {}
    for i, fault in enumerate(refinement.faults):
        if fault.name in names and len(refinement.faults) > 1:
            ends, size = region.find_ends(i, fault.interval_factor), sizes[fault.name]
            intervals[fault.name] = Estimate(size.value, max(size.low, ends.low), min(size.high, ends.high))
    return intervals


def find_groups(refinement: Refinement, levels: Mapping[str, Level | None],
                tolerances: Mapping[str, float] | None = None) -> tuple[Group, ...]:
    """Groups of faults that change the signals alike, of which no unit that is healthy in all of them fits.

    Args:
        refinement: the fit.
        levels: of all faults by name. Each group has one that cannot be judged, None; one that is acceptable by itself
            may stand for it.
        tolerances: relative ones of parameters that differ from one healthy unit to the next.
    """
    region = _Region(refinement)
    groups = []
    undecided, others = ([i for i, f in enumerate(refinement.faults) if levels[f.name] == level]
                         for level in (None, Level.ACCEPTABLE))
    for members in region.group_alike(undecided):
        group = sorted([*members, *(j for j in others if region.alike[j, members].any())])
        low, high = region.low.copy(), region.high.copy()
        for i in group:
            region.limit_to_healthy(low, high, i, (tolerances or {}).get(refinement.faults[i].parameter, 0.0))
        if len(group) > 1 and region.measure_distance(low, high) > _exclude_all(len(group), len(refinement.faults)):
            groups.append(tuple(refinement.faults[i].name for i in group))
    return tuple(groups)


def _exclude_all(group_size: int, tested: int) -> float:
    """Distance, standard deviations, from which on so many sizes together are not healthy: chi-squared of as many
    degrees of freedom, at the level at which one of more than two faults is judged.
    """
    limit = INTERVAL_95_SD * widen_for_many(tested)
    return math.sqrt(chdtri(group_size, chdtrc(1, limit**2))) if tested > 2 else limit
