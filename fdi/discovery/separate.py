"""Two explanations fit equally well: which sensor or which command would tell them apart, proven by simulation."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from fdi.discovery.search import Hypothesis, Search
from fdi.estimation.fit import fit_unknowns
from fdi.estimation.replay import hold_inputs
from fdi.thresholds import MISFIT_DISCRIMINATES
from fdi.trace.signals import OUTPUTS
from fdi.trace.trace import Floats, Trace
from plant.lanes import Lanes

SECONDS = 3.0


class Separation(NamedTuple):
    """What would split a set: `misfit` is what the wrong explanations would leave at least."""

    between: tuple[str, ...]
    by: str
    command: dict[str, Any]
    misfit: float


def find_separation(search: Search, equal: Sequence[Hypothesis]) -> Separation | None:
    """The first sensor, or else the best command, that splits a set of hypotheses; None if none that was tried does.

    One explanation's prediction stands for the measurement; the other is fitted to it, its tolerances and all.
    """
    most_pairs = 3  # of a larger set only the first are compared
    pairs = list(combinations(equal, 2))[:most_pairs]
    if not pairs:
        return None
    names = tuple(dict.fromkeys(e for h in equal for e in h.effects))
    own = search.problem.trace
    missing = tuple(s for s in OUTPUTS if s not in own.outputs)
    for more in dict.fromkeys([*((s,) for s in missing), missing] if missing else []):
        left = min(_measure_misfit(search, a, b, _same_command(search, a, (*own.outputs, *more))) for a, b in pairs)
        if left > MISFIT_DISCRIMINATES:
            return Separation(names, f"measure {' and '.join(more)} too, on the same command", {}, left)
    best = None
    for words, command, play in list_commands():
        left = min(_measure_misfit(search, a, b, _simulate_command(search, a, play, own.outputs)) for a, b in pairs)
        if left > MISFIT_DISCRIMINATES and (best is None or left > best.misfit):
            best = Separation(names, words, command, left)
    return best


def list_commands() -> list[tuple[str, dict[str, Any], Callable[[Floats], tuple[Floats, Floats]]]]:
    """Commands to try, in words, as segments of a sequence, and as functions of time giving demand m and load N."""
    def sine(amplitude: float, hertz: float, load: float = 0.0) -> Callable[[Floats], tuple[Floats, Floats]]:
        return lambda t: (amplitude * np.sin(2.0 * np.pi * hertz * t), np.full_like(t, load))

    def step(to: float, load: float = 0.0) -> Callable[[Floats], tuple[Floats, Floats]]:
        return lambda t: (np.where((t > 0.3) & (t < 1.8), to, 0.0), np.full_like(t, load))

    def segments(*parts: dict[str, Any], load: float = 0.0) -> dict[str, Any]:
        return {"main": list(parts), "load": [{"kind": "hold", "time": SECONDS, "value": load}] if load else []}

    def sines(amplitude: float, hertz: float, load: float = 0.0) -> dict[str, Any]:
        return segments({"kind": "sine", "amplitude": amplitude, "frequency": hertz, "time": SECONDS}, load=load)

    def steps(to: float) -> dict[str, Any]:
        return segments({"kind": "hold", "time": 0.3}, {"kind": "step", "to": to, "time": 1.5},
                        {"kind": "step", "to": 0.0, "time": 1.2})

    return [("a sine of 3 mm at 1 Hz against a load of 5 kN", sines(3e-3, 1.0, 5e3), sine(3e-3, 1.0, 5e3)),
            ("a sine of 2 mm at 10 Hz", sines(2e-3, 10.0), sine(2e-3, 10.0)),
            ("a sine of 0.2 mm at 20 Hz", sines(2e-4, 20.0), sine(2e-4, 20.0)),
            ("a sine of 20 mm at 1 Hz", sines(20e-3, 1.0), sine(20e-3, 1.0)),
            ("a step of 20 mm and back", steps(20e-3), step(20e-3)),
            ("a step into the end stop, 45 mm, and back", steps(45e-3), step(45e-3))]


def _same_command(search: Search, h: Hypothesis, signals: tuple[str, ...]) -> Trace:
    """The run as a hypothesis predicts it, with more sensors."""
    names = [f.name for f in h.fit.free]
    predicted = search.problem.predict_signals(names, np.array([[h.fit.values[n] for n in names]]))[0]
    own = search.problem.trace
    return replace(own, outputs=tuple(s for s in OUTPUTS if s in signals), usable=np.ones(len(own), bool),
                   **dict(zip(OUTPUTS, predicted, strict=True)))


def _simulate_command(search: Search, h: Hypothesis, play: Callable[[Floats], tuple[Floats, Floats]],
                      signals: tuple[str, ...]) -> Trace:
    """Another command as a hypothesis predicts it, with the model's own controller."""
    problem = search.problem
    period = problem.model.values["controller.period"]
    com, load = play(np.arange(0.0, SECONDS, period))
    names = [f.name for f in h.fit.free]
    lanes = Lanes(problem.model, names, problem.steps, 1)
    out = lanes.closed_loop(np.array([[h.fit.values[n] for n in names]]), com, load)[0]
    columns = dict(zip(("xj", "cor", "p12", "xs"), out.T, strict=True))
    return hold_inputs(Trace.from_columns({"com": com, "load": load, **columns}, period, {}), signals)


def _measure_misfit(search: Search, truth: Hypothesis, wrong: Hypothesis, seen: Trace) -> float:
    """What `wrong` leaves of what `truth` predicts, noise aside, -2 log likelihood."""
    noise = search.sensors | dict(zip(search.problem.trace.outputs, search.noise, strict=True))
    problem = replace(search.problem, trace=seen, noise=tuple(noise[s] for s in seen.outputs), also=())
    return fit_unknowns(problem, wrong.fit.free, wrong.fit.x, rounds=3).misfit
