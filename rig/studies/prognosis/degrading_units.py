"""Simulated units whose fault grows by a known law, for scoring the prognosis.

Three of the laws are among those that the prognosis fits, four are not. Sizes have the errors of `rig fdi`: most of an
error comes from the tolerances of the unit, and is the same in all its traces.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate, Fault
from fdi.thresholds import INTERVAL_95_SD

Floats = NDArray[np.float64]
Law = Callable[[Floats, np.random.Generator], Floats]

INTERVAL = 7.0  # days between traces, on average


class Error(NamedTuple):
    """Error of a refined size: standard deviation `base + share * size`."""

    base: float
    share: float
    common: float  # part of the variance that is the same in all traces of a unit


# as measured with rig fdi on XJ, P12 and XS: twelve traces of each of two units, tolerances of 1.5 %, coloured noise
ERRORS = {CLOGGING.name: Error(0.03, -0.03, 0.995), FRICTION.name: Error(0.0, 0.032, 0.95)}


class Unit(NamedTuple):
    """One unit: the true course of its fault, and the sizes that its traces give."""

    law: str
    fault: Fault
    onset: float  # days
    course_t: Floats  # days
    course: Floats
    t: Floats  # days, times of the traces
    sizes: tuple[Estimate, ...]

    def time_of_size(self, limit: float) -> float:
        """The time at which the size first reaches `limit`, days."""
        return float(self.course_t[int((self.course >= limit * (1.0 - 1e-9)).argmax())])


def grow_linearly(x: Floats, rng: np.random.Generator) -> Floats:
    """In proportion to time; x runs from 0 at the onset to 1 at MaxBand, and so does the result."""
    return x


def grow_exponentially(x: Floats, rng: np.random.Generator) -> Floats:
    """Exponentially, by 1.5 to 4.5 e-foldings."""
    bend = rng.uniform(1.5, 4.5)
    return np.asarray(np.expm1(bend * x) / np.expm1(bend))


def grow_by_power(x: Floats, rng: np.random.Generator) -> Floats:
    """A power of time with an exponent from 0.6 to 2.8."""
    return np.asarray(x ** rng.uniform(0.6, 2.8))


def grow_like_crack(x: Floats, rng: np.random.Generator) -> Floats:
    """At a rate in proportion to the size to the power 1.5, as a crack by the law of Paris with an exponent of 3."""
    start = rng.uniform(0.08, 0.25)
    root = 1.0 - (1.0 - np.sqrt(start)) * x
    return np.asarray((start / root ** 2 - start) / (1.0 - start))


def grow_logistically(x: Floats, rng: np.random.Generator) -> Floats:
    """An S-shaped curve that would flatten at 1.15 to 1.6 times MaxBand."""
    steep, middle = rng.uniform(4.0, 8.0), rng.uniform(0.4, 0.7)
    s = 1.0 / (1.0 + np.exp(-steep * (np.linspace(0.0, 1.5, 3000) - middle)))
    s = s - s[0]
    end = float(np.interp(s[-1] / rng.uniform(1.15, 1.6), s, np.linspace(0.0, 1.5, 3000)))
    grown = np.interp(x * end, np.linspace(0.0, 1.5, 3000), s)
    return np.asarray(grown / grown[-1])


def grow_at_two_rates(x: Floats, rng: np.random.Generator) -> Floats:
    """At two rates: the second one, 1.5 to 4 times the first, begins between 25 % and 60 % of the life."""
    change, ratio = rng.uniform(0.25, 0.6), rng.uniform(1.5, 4.0)
    s = x + (ratio - 1.0) * np.maximum(x - change, 0.0)
    return np.asarray(s / s[-1])


def grow_by_jumps(x: Floats, rng: np.random.Generator) -> Floats:
    """By a gamma process: many small jumps, of which 60 of the mean size reach MaxBand."""
    s = np.cumsum(rng.gamma(60.0 / len(x), size=len(x)))
    return np.asarray(s / s[-1])


FITTED: dict[str, Law] = {"linear": grow_linearly, "exponential": grow_exponentially, "power": grow_by_power}
OTHERS: dict[str, Law] = {"crack": grow_like_crack, "logistic": grow_logistically, "two rates": grow_at_two_rates,
                           "gamma process": grow_by_jumps}
LAWS = FITTED | OTHERS


def simulate_unit(law: str, seed: int) -> Unit:
    """A unit whose fault grows from its onset to MaxBand within 15 to 40 traces.

    The healthy time before the onset is up to 40 % of the time of growth.
    """
    rng = np.random.default_rng([seed, 17])
    fault = (CLOGGING, FRICTION)[seed % 2]
    traces = int(rng.integers(15, 41))
    onset = INTERVAL * traces * rng.uniform(0.0, 0.4)
    life = INTERVAL * traces
    x = np.linspace(0.0, 1.0, 4000)
    course_t = np.concatenate([[0.0], onset + life * x])
    shape = np.concatenate([[0.0], LAWS[law](x, rng)])
    course = fault.healthy + (fault.most - fault.healthy) * shape
    t = np.arange(0.0, onset + life, INTERVAL)
    t = np.sort(np.maximum(t + rng.uniform(-2.0, 2.0, len(t)), 0.0))
    return Unit(law, fault, onset, course_t, course, t, measure_sizes(fault, np.interp(t, course_t, course), rng))


def simulate_healthy_unit(seed: int, traces: int = 25) -> Unit:
    """A unit in which nothing grows."""
    rng = np.random.default_rng([seed, 11])
    fault = (CLOGGING, FRICTION)[seed % 2]
    t = INTERVAL * np.arange(traces) + rng.uniform(-2.0, 2.0, traces)
    true = np.full(traces, fault.healthy)
    return Unit("none", fault, np.inf, t, true, t, measure_sizes(fault, true, rng))


def measure_sizes(fault: Fault, true: Floats, rng: np.random.Generator) -> tuple[Estimate, ...]:
    """The sizes that `rig fdi` would give for true sizes, (n,), in traces of one unit."""
    error = ERRORS[fault.name]
    sigma = error.base + error.share * true
    own = rng.standard_normal()
    noise = np.sqrt(error.common) * own + np.sqrt(1.0 - error.common) * rng.standard_normal(len(true))
    found = np.maximum(true + sigma * noise, 0.0)  # neither size can be less
    half = INTERVAL_95_SD * (error.base + error.share * found)
    return tuple(Estimate(float(x), max(float(x - h), 0.0), float(x + h)) for x, h in zip(found, half, strict=True))
