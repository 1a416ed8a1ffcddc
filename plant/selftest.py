"""Tests that every effect must pass, also a user's own, on a command: `rig effects NAME --test` shows the result."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from plant.effects import Effect
from plant.model import build_bare_model
from plant.plants import find_plant
from plant.run import simulate
from plant.segments import Array
from plant.starts import compute_changes, compute_levels, compute_rms, find_starts

# what plain Python runs, over the largest demand of the command
SHORT = np.concatenate([np.zeros(5), np.full(25, 1.0), np.linspace(1.0, -0.5, 20)])


class Shown(NamedTuple):
    """How much an effect of one size changes a signal: RMS over a command, and that over the noise of the sensor."""

    start: Mapping[str, float]
    changes: Mapping[str, float]  # by output, SI
    level: float  # largest of them over its sensor's noise; 1 is as large as the noise


class Report(NamedTuple):
    """The result of the tests of an effect; `faults` in words, empty if it passed."""

    effect: str
    faults: tuple[str, ...]
    shown: tuple[Shown, ...]

    @property
    def visible(self) -> bool:
        """Whether its largest size shows above the noise on the command of the test."""
        return any(size.level >= 1.0 for size in self.shown)


def check_effect(name: str, command: Array, load: Array | None = None, plant: str = "eha") -> Report:
    """Test an effect of a plant on `command` (n,) and `load` (n,).

    Raises:
        InputError: a law that cannot be compiled and run.
    """
    kind = find_plant(plant)
    effect, outputs = kind.find_effect(name), kind.signals.outputs
    if effect.base or effect.disturbance:
        return Report(name, (), ())
    starts = find_starts(effect, command, load, plant)
    change = (compute_changes(effect, starts, command, load, plant) if starts else
              np.zeros((0, len(command), len(outputs))))
    rows = tuple(Shown(dict(start), dict(zip((s.name for s in outputs), sizes, strict=True)), most)
                 for start, sizes, most in zip(starts, compute_rms(change).tolist(), compute_levels(
                      change, plant).max(axis=1, initial=0.0).tolist(), strict=True))
    return Report(name, tuple(_find_faults(effect, starts, command, load, plant)), rows)


def _find_faults(effect: Effect, starts: tuple[Mapping[str, float], ...], command: Array, load: Array | None,
                 plant: str) -> list[str]:
    bare = build_bare_model(plant)
    off, faults = bare.with_effects([effect.name]), []
    if not _are_equal(simulate(bare, command, load), simulate(off, command, load)):
        faults.append("at its off value it changes the plant; rounding counts: m + (x - m) is not x")
    if not starts:
        faults.append("no size of it changes anything on this command")
    faults += [f"with {_format_values(start)} the plant has no number any more"
               for start in (*starts, *list_extremes(effect))
               if not np.isfinite(np.array(simulate(off.replace(start), command, load))).all()]
    if starts and not faults:
        model, start_text = off.replace(starts[-1]), _format_values(starts[-1])
        if not _are_equal(*(simulate(model, command, load) for _ in range(2))):
            faults.append(f"with {start_text} two runs of one seed differ")
        steps, short = 20, SHORT * np.abs(command).max()  # plain Python runs too
        if not _are_equal(*(simulate(model, short, steps=steps, fast=fast) for fast in (True, False))):
            faults.append(f"with {start_text} compiled code and plain Python differ")
    return faults


def list_extremes(effect: Effect) -> list[dict[str, float]]:
    """The ends of the range of each fitted parameter, where the simulation must still be finite."""
    ranges = {name: effect.parameters[name] for name in effect.fitted}
    return [{name: end} for name, q in ranges.items() for end in (q.low, q.high) if not q.refuses(end)]


def _format_values(start: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in start.items())


def _are_equal(one: tuple[Array, ...], other: tuple[Array, ...]) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))
