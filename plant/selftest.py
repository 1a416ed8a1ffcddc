"""Tests that every effect must pass, also a user's own, on a command: `rig effects NAME --test` shows the result."""
from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.effects import CATALOGUE, Effect
from plant.model import Model
from plant.run import simulate
from plant.starts import compute_changes, compute_levels, compute_rms, find_starts

Array = NDArray[np.float64]
SHORT = np.concatenate([np.zeros(5), np.full(25, 2e-3), np.linspace(2e-3, -1e-3, 20)])  # m, what it runs


class Shown(NamedTuple):
    """How much an effect of one size changes a signal: RMS over a command, and that over the noise of the sensor."""

    start: Mapping[str, float]
    xj: float  # m
    p12: float  # Pa
    xs: float  # m
    level: float  # largest of the three over its sensor's noise; 1 is as large as the noise


class Report(NamedTuple):
    """The result of the tests of an effect; `faults` in words, empty if it passed."""

    effect: str
    faults: tuple[str, ...]
    shown: tuple[Shown, ...]

    @property
    def visible(self) -> bool:
        """Whether its largest size shows above the noise on the command of the test."""
        return any(shown.level >= 1.0 for shown in self.shown)


def check_effect(name: str, command: Array, load: Array | None = None) -> Report:
    """Test an effect of the catalogue on `command` (n,) m and `load` (n,) N.

    Raises:
        InputError: a law that cannot be compiled and run.
    """
    effect = CATALOGUE[name]
    if effect.base or effect.disturbance:
        return Report(name, (), ())
    starts = find_starts(effect, command, load)
    change = compute_changes(effect, starts, command, load) if starts else np.zeros((0, len(command), 3))
    shown = tuple(Shown(dict(start), xj, p12, xs, most) for start, (xj, p12, xs), most in zip(
        starts, compute_rms(change).tolist(), compute_levels(change).max(axis=1, initial=0.0).tolist(), strict=True))
    return Report(name, tuple(_find_faults(effect, starts, command, load)), shown)


def _find_faults(effect: Effect, starts: tuple[Mapping[str, float], ...], command: Array,
                 load: Array | None) -> list[str]:
    bare, off = Model(), Model().with_effects([effect.name])
    faults = []
    if not _are_equal(simulate(bare, command, load), simulate(off, command, load)):
        faults.append("at its off value it changes the plant")
    if not starts:
        faults.append("no size of it changes anything on this command")
    for start in (*starts, *list_extremes(effect)):
        if not np.isfinite(np.array(simulate(off.replace(start), command, load))).all():
            faults.append(f"with {_format_values(start)} the plant has no number any more")
    if starts and not faults:
        model, said = off.replace(starts[-1]), _format_values(starts[-1])
        if not _are_equal(*(simulate(model, command, load) for _ in range(2))):
            faults.append(f"with {said} two runs of one seed differ")
        steps = 20  # a cycle: plain Python runs too
        if not _are_equal(*(simulate(model, SHORT, steps=steps, fast=fast) for fast in (True, False))):
            faults.append(f"with {said} compiled code and plain Python differ")
    return faults


def list_extremes(effect: Effect) -> list[dict[str, float]]:
    """The ends of the range of each fitted parameter, where the simulation must still be finite."""
    ranges = {name: effect.parameters[name] for name in effect.fitted}
    return [{name: end} for name, q in ranges.items() for end in (q.low, q.high) if not q.refuses(end)]


def _format_values(start: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in start.items())


def _are_equal(one: tuple[Array, ...], other: tuple[Array, ...]) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))
