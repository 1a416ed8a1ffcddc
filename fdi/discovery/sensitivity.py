"""Which sizes of an effect `explain` names: proved by hiding effects in the user's own unit and explaining the runs.

The unit has the parameters of the fit that explains the measured runs. It is simulated on their commands, with their
noise and its colour, with an effect hidden in it, and the simulated runs go the way that measured ones go. A size
counts if at least `NEEDED` of `TRIALS` runs with other noise name the effect, alone.

Sizes are the largest usual one and halves of it, quarters and so on (the rungs of a ladder). An effect is tried first
where a simulated gain says that it just shows (detectable.py), then at larger or smaller sizes, until one rung is named
and the next smaller one is not. A rung on which that can no longer be reached is left at once.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.discovery.detectable import Direction, VirtualTest, list_directions, move_effect
from fdi.discovery.explain_runs import Answer, explain_recording, prepare_effects
from fdi.discovery.runs import Runs, read_runs
from fdi.estimation import Noise, Share, limit_friction_values, measure_share
from fdi.thresholds import GAIN_DETECTED
from fdi.trace import Floats, Trace
from plant import Lanes, Model, load_plant, require, simulate
from plant.effects import load_effects

TRIALS, NEEDED = 10, 9
TRIALS_AT_ONCE = 4  # of a rung, before it is looked at again: most rungs that miss are decided by the first
RUNGS = 8  # the smallest size is the largest over 2**7
UNIT_STEPS = 2  # times the usual number of solver steps: a unit is no copy of the model that is fitted to it


class Injection(NamedTuple):
    """An effect to hide: at 2**-rung times its largest usual size, with the noise of one trial."""

    number: int
    effect: str
    rung: int
    trial: int


class Play(NamedTuple):
    """What a run plays: columns (n,); the drive counts where the plant has no controller of its own."""

    command: Floats
    load: Floats
    drive: Floats


@dataclass(frozen=True)
class Unit:
    """A unit to hide effects in, and how its runs are explained. It travels to other processes."""

    model: Model  # which explains: the user's, with the effects that were found
    values: Mapping[str, float]  # of the unit, "group.field" to SI value: what was fitted
    noise: Mapping[str, Noise]  # by measured signal
    play: Play
    repeats: int
    holdout: Play | None
    effects: tuple[str, ...]  # to hide
    effect_files: tuple[str, ...] = ()
    plant_file: str = ""


class Claim(NamedTuple):
    """What was counted of an effect. `named` is empty where not even the largest usual size is named often enough."""

    effect: str
    parameter: str
    unit: str
    largest: float  # usual size: distance from the off value, SI
    smallest: float | None  # size that was named NEEDED times of TRIALS
    named: Share | None
    counts: Sequence[tuple[float, int, int]]  # (size, hits, trials) of each size that was tried, smallest first
    taken_for: Mapping[str, int]  # what the others were taken for, with how often


def describe_unit(runs: Runs, answer: Answer, effects: Sequence[str] = (), effect_files: Sequence[str] = ()) -> Unit:
    """The unit behind measured runs that a model explains.

    Args:
        runs: the measured runs.
        answer: the explanation of them.
        effects: to hide; default: each that the search can name and has not named.
        effect_files: with the user's own effects, for other processes.

    Raises:
        InputError: more than noise is left, sensors that filter or delay, or an effect that cannot be hidden.
    """
    e, best = answer.explanation, answer.best
    require(not runs.est.sensors, "--sensitivity", ", ".join(runs.est.sensors), "sensors that neither filter nor delay")
    require(best.is_at_floor, "--sensitivity", answer.verdict, "runs that the model explains; here more than noise is "
            "left, so no simulated run stands for a measured one (rig add first)")
    candidates = [name for name in e.search.effects if name not in best.effects]
    for name in effects:
        require(name in candidates, "--hide", name, f"one of {', '.join(candidates)}")
    values = limit_friction_values(best.fit.values)
    parameters = {p for name in best.effects for p in runs.model.find_effect(name).fitted if p in values}
    problem = e.search.problem
    return Unit(runs.model.replace({name: values[name] for name in sorted(parameters)}, "fit"), values,
                dict(zip(problem.trace.outputs, problem.noise, strict=True)), _read_play(runs.est), len(runs.repeats),
                None if runs.holdout is None else _read_play(runs.holdout), tuple(effects or candidates),
                tuple(effect_files), str(runs.model.kind.file or ""))


def _read_play(trace: Trace) -> Play:
    return Play(trace.command, trace.load, trace.drive)


def find_first_rungs(answer: Answer, effects: Sequence[str]) -> dict[str, int]:
    """The rung of each effect on which a simulated gain says that it shows; the largest size where none does.

    It is one above the smallest that gains `GAIN_DETECTED`: a search wants more than a gain in a known place.
    """
    search = answer.explanation.search
    pairs = [(way, rung) for name in effects for way in list_directions(name, search.model)[:1]
             for rung in range(RUNGS)]
    gains = VirtualTest(search.problem, answer.best.fit).measure_gains(
        [way for way, _ in pairs], [way.most * 0.5**rung for way, rung in pairs]) if pairs else []
    rungs: dict[str, int] = dict.fromkeys(effects, 0)
    for (way, rung), gain in zip(pairs, gains, strict=True):
        if gain > GAIN_DETECTED:
            rungs[way.effect] = max(rungs[way.effect], rung - 1)
    return rungs


def choose_way(model: Model, effect: str, trial: int) -> Direction:
    """The sign of an effect in a trial: both in turn, where both are usual."""
    ways = list_directions(effect, model)
    return ways[trial % len(ways)]


def measure_size(model: Model, effect: str, rung: int) -> float:
    """The size of an effect on a rung, of the larger sign: the distance of its first parameter from the off value."""
    return 0.5**rung * max(way.most for way in list_directions(effect, model))


def hide_effect(unit: Unit, injection: Injection) -> Runs:
    """The simulated runs of the unit with the effect in it, as `read_runs` would read them."""
    way = choose_way(unit.model, injection.effect, injection.trial)
    unit_model = unit.model.replace(unit.values, "fit").with_effects([injection.effect])
    parameters = move_effect(unit_model, unit_model.values, way, way.most * 0.5**injection.rung)
    true_model = unit_model.replace(limit_friction_values({**unit_model.values, **parameters}), "hidden effect")
    seeds = np.random.SeedSequence([injection.number]).spawn(2 + unit.repeats)
    est, unseen, *repeats = (np.random.default_rng(seed) for seed in seeds)
    runs = [_simulate_run(unit, true_model, unit.play, rng) for rng in (est, *repeats)]
    holdout = None if unit.holdout is None else _simulate_run(unit, true_model, unit.holdout, unseen)
    return read_runs(unit.model, runs[0], runs[1:], holdout, list(unit.noise))


def _simulate_run(unit: Unit, model: Model, play: Play, rng: np.random.Generator) -> Trace:
    """One run of a unit: in closed loop, or driven as the measured one was, where the plant has no controller.

    In closed loop the noise of the sensors is part of what the controller reads.
    """
    signals, n = model.kind.signals, len(play.command)
    noise = {s.name: draw_noise(unit.noise[s.name], n, rng) for s in signals.outputs if s.name in unit.noise}
    columns = {signals.command.name: play.command}
    columns |= {} if signals.load is None else {signals.load.name: play.load}
    if model.kind.controller:
        draws = rng.standard_normal((n, len(signals.outputs) + 1))
        readings = [(i, s) for i, s in enumerate(signals.outputs) if s.noise and s.name in noise]
        for i, signal in readings:
            draws[:, i] = noise.pop(signal.name) / unit.noise[signal.name].level
        noisy_model = model.replace({s.noise: unit.noise[s.name].level for _, s in readings}, "noise")
        columns |= simulate(noisy_model, play.command, play.load, steps=UNIT_STEPS * model.steps, drawn=draws)._asdict()
    else:
        out = Lanes(model, (), UNIT_STEPS * model.steps, 1).replay(np.empty((1, 0)), play.drive, play.load)[0]
        columns |= {signals.drive.name: play.drive} | {s.name: out[:, i] for i, s in enumerate(signals.outputs)}
    for signal in signals.outputs:
        is_read = signal.name in unit.noise or signal == signals.controlled
        columns[signal.name] = columns[signal.name] + noise.get(signal.name, 0.0) if is_read else np.full(n, math.nan)
    return Trace.from_columns(columns, model["controller.period"], {"source": f"simulated {rng.integers(2**32)}"},
                              signals)


def draw_noise(noise: Noise, n: int, rng: np.random.Generator) -> Floats:
    """Noise, (n,), that its filter makes white: the autoregressive process with these innovations."""
    from scipy.signal import lfilter  # here: it takes long to import

    settling = 1000  # samples until the process has forgotten its start
    return np.asarray(lfilter([noise.innovation], noise.filter, rng.standard_normal(settling + n))[settling:])


def judge_injection(injection: Injection, unit: Unit) -> dict[str, Any]:
    """Hide the effect, explain the runs, and say what was named."""
    _load_files(unit.plant_file, unit.model.plant, unit.effect_files)
    runs = hide_effect(unit, injection)
    prepare_effects(runs)
    explanation = explain_recording(runs)
    effects = list(explanation.effects)
    return {**injection._asdict(), "size": measure_size(unit.model, injection.effect, injection.rung),
            "verdict": explanation.verdict, "effects": effects,
            "is_named": explanation.verdict == "EXPLAINED" and effects == [injection.effect]}


@cache
def _load_files(plant_file: str, plant: str, effect_files: tuple[str, ...]) -> None:
    """Load the user's plant and effects, once in each process: what runs anew has to be compiled anew."""
    if plant_file:
        load_plant(Path(plant_file), key=plant)
    for file in effect_files:
        load_effects(Path(file))


def choose_injections(unit: Unit, first: Mapping[str, int], rows: Iterable[Mapping[str, Any]]) -> list[Injection]:
    """What to hide next: the trials of the rung under way, of each effect that is not decided; none at the end."""
    rows = list(rows)
    counts, injections, done_numbers = count_rungs(rows), list[Injection](), {row["number"] for row in rows}
    names = [entry.name for entry in unit.model.kind.list_effects()]
    for effect in unit.effects:
        rung = _find_open_rung(counts.get(effect, {}), first[effect])
        if rung is not None:
            place = (names.index(effect) * RUNGS + rung) * TRIALS
            # an interrupted round may have left out any of its trials
            trials = [trial for trial in range(TRIALS) if place + trial not in done_numbers][:TRIALS_AT_ONCE]
            injections += [Injection(place + trial, effect, rung, trial) for trial in trials]
    return injections


def count_rungs(rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[int, tuple[int, int]]]:
    """(hits, trials) of each rung of each effect: how often it was named, and how often hidden."""
    counts: dict[str, dict[int, tuple[int, int]]] = {}
    for row in rows:
        rungs = counts.setdefault(row["effect"], {})
        hits, trials = rungs.get(row["rung"], (0, 0))
        rungs[row["rung"]] = hits + row["is_named"], trials + 1
    return counts


def _find_open_rung(counts: Mapping[int, tuple[int, int]], first: int) -> int | None:
    """The rung of an effect that is under way; None when the smallest size that is named is known, or none is."""
    rung = first
    while 0 <= rung < RUNGS:
        is_named = _judge_rung(counts, rung)
        if is_named is None:
            return rung
        beside = rung + 1 if is_named else rung - 1
        if _judge_rung(counts, beside) == (not is_named):
            return None
        rung = beside
    return None


def _judge_rung(counts: Mapping[int, tuple[int, int]], rung: int) -> bool | None:
    """Whether a rung is named often enough; None while both is possible."""
    hits, trials = counts.get(rung, (0, 0))
    if trials - hits > TRIALS - NEEDED:
        return False
    return True if trials == TRIALS else None


def summarise_injections(unit: Unit, rows: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """The claim of each effect: the smallest size that was named often enough."""
    counts, claims = count_rungs(rows), []
    for effect in unit.effects:
        entry, rungs = unit.model.find_effect(effect), counts.get(effect, {})
        smallest = max((rung for rung in rungs if _judge_rung(rungs, rung)), default=None)
        wrong = Counter(_describe_miss(row) for row in rows if row["effect"] == effect and not row["is_named"])
        sizes = [(measure_size(unit.model, effect, rung), *rungs[rung]) for rung in sorted(rungs, reverse=True)]
        claims.append(Claim(effect, entry.fitted[0], entry.parameters[entry.fitted[0]].unit,
                            measure_size(unit.model, effect, 0),
                            None if smallest is None else measure_size(unit.model, effect, smallest),
                            None if smallest is None else measure_share(*rungs[smallest]), sizes,
                            dict(wrong.most_common())))
    return claims


def _describe_miss(row: Mapping[str, Any]) -> str:
    """What a run was taken for: a verdict, with the effects that it names."""
    names = " and ".join(row["effects"])
    return f"{names} ({row['verdict']})" if names else str(row["verdict"])
