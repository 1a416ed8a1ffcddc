"""How easily noise alone looks like an effect."""
from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from fdi.estimation.fit import Fit
from fdi.estimation.likelihood import Problem
from fdi.thresholds import NULL_DRAWS
from plant.effects import CATALOGUE

Floats = NDArray[np.float64]

NULL_STRIDE = 3


class Sensitivity(NamedTuple):
    """What effects would change, beyond what the fit's own unknowns can make up for."""

    names: tuple[str, ...]  # the effect of each direction
    sizes: tuple[float, ...]  # of its first fitted parameter, as distance from the off value
    gains: Floats  # (d,) squared length of each direction, whitened
    gram: Floats  # (d, d) cosines between directions


def compute_sensitivity(problem: Problem, fit: Fit, effects: Iterable[str]) -> Sensitivity:
    """Directions of the effects' starts at the fit, in whitened residuals, the fit's unknowns projected out."""
    usual = problem.model.nominal
    starts = [(e, s) for e in effects for s in CATALOGUE[e].starts if CATALOGUE[e].port not in ("command", "reading")]
    names = list(dict.fromkeys([*fit.values, *(n for _, s in starts for n in s)]))
    held = [fit.values.get(n, problem.model.values[n]) for n in names]
    rows = np.array([held, *([s.get(n, v) for n, v in zip(names, held, strict=True)] for _, s in starts)])
    parts = np.array_split(rows, -(-len(rows) // 64))
    residuals = (problem.subtract_measurements(problem.predict_outputs(names, part)) for part in parts)
    white = np.concatenate([problem.whiten_residuals(r) for r in residuals])
    thin = (white[1:] - white[0])[:, :, ::NULL_STRIDE].reshape(len(starts), -1) * np.sqrt(NULL_STRIDE)
    own = fit.jacobian[:, :, ::NULL_STRIDE].reshape(len(fit.x), -1) * np.sqrt(NULL_STRIDE)
    prior = np.diag([f.prior**-2 + 1e-9 for f in fit.free])
    left = thin - (thin @ own.T) @ np.linalg.solve(own @ own.T + prior, own)
    gains = np.einsum("ij,ij->i", left, left)
    length = np.sqrt(np.maximum(gains, 1e-300))
    sizes = tuple(abs(s[CATALOGUE[e].fitted[0]] - CATALOGUE[e].off.get(CATALOGUE[e].fitted[0],
                                                                       usual.get(CATALOGUE[e].fitted[0], 0.0)))
                  for e, s in starts)
    return Sensitivity(tuple(e for e, _ in starts), sizes, gains, (left @ left.T) / np.outer(length, length))


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
    simulated = float(np.mean(best >= gain))
    bound = len(set(s.names)) * float(chdtrc(parameters, max(gain, 0.0)))
    return simulated if simulated > 10.0 / NULL_DRAWS else min(max(bound, 1e-300), max(simulated, 1.0 / NULL_DRAWS))
