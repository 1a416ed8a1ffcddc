"""Which states, alone or in pairs, a missing force, flow or current follows, tested on rows that no curve saw."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Places = NDArray[np.int64]

FOLDS = 10  # contiguous blocks of a run; each is predicted from the others
SHIFTS = 199  # of the residual against the states, for the null
SINGLE_BINS, PAIR_BINS = 12, 6
FINE_BINS = 40  # of the position alone: a wave along the stroke is short


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
    rng = np.random.default_rng(seed)
    shifts = rng.integers(n // 20, n - n // 20, SHIFTS)
    moved = np.column_stack([y, *(np.roll(y, int(k)) for k in shifts)])
    fold = np.minimum(np.arange(n) * FOLDS // n, FOLDS - 1)
    kinds = (SINGLE_BINS, PAIR_BINS, FINE_BINS)
    edges = {name: {bins: _cut_range(states[name], bins) for bins in kinds} for name in names}
    choices = [(name,) for name in names] + list(combinations(names, 2))
    shares = np.array([_predict_folds(_find_bins(c, states, edges), fold, moved) for c in choices])
    best_by_chance = shares[:, 1:].max(axis=0)
    own = dict(zip(choices, shares[:, 0].tolist(), strict=True))
    least_gain = 0.03  # share that a pair must add to the better one of its states
    found = [c for c in choices if len(c) == 1 or own[c] > max(own[c[:1]], own[c[1:]]) + least_gain]
    ranked = sorted(found, key=lambda c: -own[c])[:most]
    return [Dependence(c, own[c], _predict_holdout(c, y, states, holdout, edges),
                       float((1 + np.sum(best_by_chance >= own[c])) / (1 + SHIFTS))) for c in ranked]


def _cut_range(x: Floats, bins: int) -> Floats:
    """Inner edges of bins that hold about equally many samples."""
    return np.unique(np.quantile(x, np.linspace(0.0, 1.0, bins + 1)[1:-1]))


def _find_bins(choice: Sequence[str], states: Mapping[str, Floats], edges: Mapping[str, Mapping[int, Floats]]
               ) -> Places:
    if len(choice) > 1:
        bins = PAIR_BINS
    else:
        bins = FINE_BINS if choice[0] == "position" else SINGLE_BINS
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
    own = (pick @ y).reshape(bins, FOLDS, -1)
    count = np.bincount(group, minlength=bins * FOLDS).reshape(bins, FOLDS, 1)
    mean = (own.sum(axis=1, keepdims=True) - own) / (count.sum(axis=1, keepdims=True) - count + 5.0)  # shrunk to zero
    error = (y**2).sum(axis=0) - (2.0 * mean * own - mean**2 * count).sum(axis=(0, 1))
    share: Floats = 1.0 - error / np.maximum((y**2).sum(axis=0), 1e-300)
    return share


def _predict_holdout(choice: Sequence[str], y: Floats, states: Mapping[str, Floats],
                     holdout: tuple[Floats, Mapping[str, Floats]] | None,
                     edges: Mapping[str, Mapping[int, Floats]]) -> float | None:
    if holdout is None:
        return None
    unseen, at = holdout
    place, there = _find_bins(choice, states, edges), _find_bins(choice, at, edges)
    bins = max(int(place.max()), int(there.max())) + 1
    mean = np.bincount(place, y, bins) / (np.bincount(place, minlength=bins) + 5.0)
    return 1.0 - float(np.sum((unseen - mean[there]) ** 2)) / max(float(np.sum(unseen**2)), 1e-300)
