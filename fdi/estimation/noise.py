"""The noise of measured signals: how large, of what colour, and the filter that makes it white.

Two runs of one command have the model's error in common and the noise not: what differs between their residuals is
noise. Its level is taken block by block, as a stick-slip event that came a little later also differs.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz

Floats = NDArray[np.float64]

BLOCK = 100  # cycles; shorter than most stick-slip events are apart, longer than a period of hum
ORDER = 40  # of the autoregressive model: two periods of 50 Hz hum at 1 kHz
PARSIMONY = 4.0  # gain in -2 log likelihood that a further coefficient has to bring (Akaike asks for 2)
CALM = 1.8  # times the median block's variance, up to which a block holds noise alone
CONSISTENT = 1.0 / 0.993  # mean over median of the variance of BLOCK normal samples


class Noise(NamedTuple):
    """Noise of one signal: standard deviation, and the autoregressive model of its colour."""

    level: float  # SI unit of the signal
    filter: Floats  # (p + 1,) coefficients, first 1: e_k = sum_i filter_i r_{k-i} is white
    innovation: float  # standard deviation of e

    def whiten(self, residual: Floats) -> Floats:
        """Residuals, (.., n), time last, as white noise of variance 1; NaN (nothing measured) gives 0."""
        missing = np.isnan(residual)
        x = np.where(missing, 0.0, residual)
        white: Floats = x / self.innovation if len(self.filter) == 1 else _through(self.filter / self.innovation, x)
        if missing.any():
            missing = _through(np.ones(len(self.filter)), missing.astype(float)) > 0.5
            white = np.where(missing, 0.0, white)
        return white


def _through(weights: Floats, x: Floats) -> Floats:
    """Weighted sums of each value, (.., n), and those before it, as scipy.signal.lfilter has them.

    Without it, as that takes longer to import than all else here together.
    """
    return np.apply_along_axis(lambda row: np.convolve(weights, row)[:len(row)], -1, x)


def white(level: float) -> Noise:
    """White noise of a known standard deviation."""
    return Noise(level, np.ones(1), level)


def rounded(noise: Noise, step: float) -> Noise:
    """White noise and rounding, `step` RMS: for weights; the level stays that of the noise."""
    return noise._replace(innovation=float(np.hypot(noise.innovation, step)))


def level(difference: Floats, block: int = BLOCK) -> float:
    """Standard deviation of noise, (n,), in which now and then something else happens: the median block's."""
    n = len(difference) // block * block
    if n == 0:
        return float(np.nanstd(difference))
    blocks = difference[:n].reshape(-1, block)
    with np.errstate(invalid="ignore"):
        variance = np.nanmean(blocks**2, axis=1)
    return float(np.sqrt(np.nanmedian(variance) * CONSISTENT))


def fitted(residual: Floats, order: int = ORDER) -> Noise:
    """The autoregressive model of noise, (n,), that its length supports (Yule-Walker; Akaike's choice of order)."""
    x = residual[~np.isnan(residual)]
    sigma = level(x)
    if sigma == 0.0:
        return white(float(np.finfo(float).tiny))
    size = BLOCK * (len(x) // BLOCK) or len(x)
    blocks = x[:size].reshape(-1, min(BLOCK, size))
    calm = blocks[(blocks**2).mean(axis=1) <= CALM * sigma**2]  # the others hold a stop that came a little later
    n = calm.size
    pairs = [np.einsum("ij,ij->", calm[:, k:], calm[:, :calm.shape[1] - k]) for k in range(order + 1)]
    covariance = np.array(pairs) / n
    covariance *= sigma**2 / covariance[0]
    best, cost = white(float(np.sqrt(covariance[0]))), 0.0
    for p in range(1, order + 1):
        a = solve_toeplitz(covariance[:p], covariance[1:p + 1])
        variance = covariance[0] - a @ covariance[1:p + 1]
        gain = n * np.log(covariance[0] / variance) - PARSIMONY * p
        if gain > cost:
            whitener = np.concatenate([[1.0], -a])
            best, cost = Noise(float(np.sqrt(covariance[0])), whitener, float(np.sqrt(variance))), gain
    return best
