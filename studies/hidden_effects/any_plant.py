"""Cases of the blind trial for any declared plant: its own file says what to hide, how large, and what is measured.

The truth is the plant's own equations in steps of 2 us, with parameters that scatter by their tolerances and with
coloured noise; the trial's simulator in C has the EHA alone. Effects outside the catalogue are laws of a file beside
this one, which `rig explain` never loads.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation import compute_typical_rms, list_relative_tolerances
from fdi.estimation.replay import find_rest_rows
from fdi.thresholds import ANCHOR_RATE, HEALTHY_TOLERANCES
from plant import (
    Hold,
    Model,
    Segment,
    build_bare_model,
    build_profile,
    ensure_starts,
    find_plant,
    list_searched_effects,
    simulate,
)
from plant.effects import Effect, load_effects
from plant.segments import Ramp
from plant.starts import compute_changes
from rig.campaign import judge
from studies.hidden_effects.cases import KINDS, name_parameter, write_columns, write_truth

Array = NDArray[np.float64]

STEPS = 500  # a cycle
LEVELS = {"one": (3.0, 100.0), "two": (17.0, 100.0), "outside": (20.0, 200.0)}
"""Noise floors, in the signal that shows an effect best: what is hidden is as large. One outside must not be so small
that an effect of the catalogue is as good."""
LAG = 20  # cycles over which a change of the controlled signal counts: a replay's drifts with any difference
NAMES = ("est", "repeat", "holdout")


class Case(NamedTuple):
    """The hidden effects of a case with all their parameters, and everything else that its traces depend on."""

    seed: int
    kind: str
    hidden: tuple[tuple[str, Mapping[str, float]], ...]
    signals: str
    scatter: Mapping[str, float]  # parameter to the factor on its value
    colour: float  # correlation of the controlled signal's noise from one cycle to the next
    hum: float  # m, as for the position of the EHA


def list_outside_effects(plant: str) -> list[Effect]:
    """The effects outside the catalogue of a shipped plant; none of another."""
    file = Path(__file__).with_name(f"outside_{plant}.py")
    kind = find_plant(plant)
    if not file.exists():
        return []
    return [kind.find_effect(name) for name in load_effects(file)]


def sample_case(plant: str, seed: int) -> Case:
    """The case of a seed; of two effects none excludes the other."""
    rng = np.random.default_rng([seed, 3])
    kind_of = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    kind, command = find_plant(plant), make_command(plant)
    tolerances = list_relative_tolerances(build_bare_model(plant), kind.nominal)
    level = float(rng.uniform(0.0, 1.0))
    scatter = {name: 1.0 + level * t * float(rng.standard_normal()) for name, t in tolerances.items() if t > 0.0}
    is_white = rng.random() < 1 / 3
    colour, hum = float(rng.uniform(0.6, 0.85)), float(rng.uniform(0.3e-6, 1.1e-6))
    outside = list_outside_effects(plant)
    candidates = [e for e in list_searched_effects(plant)
                  if not e.disturbance and ensure_starts(e.name, command, None, plant)]
    candidates = [e for e in candidates if e not in outside]
    pool, count = (outside, 1) if kind_of == "outside" else (candidates, {"nothing": 0, "one": 1, "two": 2}[kind_of])
    while True:
        effects = [pool[int(i)] for i in rng.choice(len(pool), count, replace=False)] if count else []
        if not any(a.name in b.excludes for a in effects for b in effects):
            break
    low, high = LEVELS.get(kind_of, (1.0, 1.0))
    hidden_effects = tuple((e.name, sample_size(plant, e, command, low * (high / low) ** float(rng.random()), rng))
                           for e in effects)
    outputs = [s.name for s in kind.signals.outputs]
    output_count = len(outputs) if rng.random() < 0.5 else int(rng.integers(1, len(outputs) + 1))
    return Case(seed, kind_of, hidden_effects, ",".join(outputs[:output_count]), scatter, 0.0 if is_white else colour,
                0.0 if is_white else hum)


def sample_size(plant: str, effect: Effect, command: Array, level: float, rng: np.random.Generator
                ) -> dict[str, float]:
    """One of the effect's starts, its first parameter so far from its off value that `level` noise floors show it.

    It is at most as far off as the start that is furthest on that side, and further than in any healthy unit.
    """
    kind = find_plant(plant)
    starts = ensure_starts(effect.name, command, None, plant).starts
    start, first = dict(starts[int(rng.integers(len(starts)))]), effect.fitted[0]
    off, q = effect.off.get(first, kind.nominal.get(first, 0.0)), effect.parameters[first]
    side = np.sign(start[first] - off)
    sizes = side * max(side * (each[first] - off) for each in starts) * np.geomspace(1e-3, 1.0, 37)
    healthy = HEALTHY_TOLERANCES * kind.find_tolerance(first, q) * abs(off)
    candidates = [start | {first: off + float(x)} for x in sizes if abs(x) > healthy and not q.refuses(off + x)]
    peak_levels = np.array([max(levels.values()) for levels in measure_levels(plant, effect, candidates, command)])
    return candidates[int(np.abs(np.log(np.clip(np.nan_to_num(peak_levels, nan=np.inf), 1e-9, 1e12) / level)).argmin())]


def measure_levels(plant: str, effect: Effect, values: Sequence[Mapping[str, float]], command: Array
                   ) -> list[dict[str, float]]:
    """By signal, for each of `values`: the change that no healthy unit has, RMS of the typical blocks over the noise,
    in a replay as fits have it; "controller": that of an effect in the firmware.

    What tolerances change is a part of the residual that does not tell an effect, so it is left out. Nor do the rows
    in which an observer's replay stops by chance; where an effect shows in these alone, it counts as not visible.
    """
    kind, names = find_plant(plant), [s.name for s in find_plant(plant).signals.outputs]
    tolerances = list_relative_tolerances(build_bare_model(plant), kind.nominal)
    units = [] if effect.firmware else [{n: (1.0 + t) * kind.nominal[n]} for n, t in tolerances.items() if t > 0.0]
    change = compute_changes(effect, [*values, *units], command, None, plant, ANCHOR_RATE)
    noise = np.array([kind.nominal[s.noise] for s in kind.signals.outputs])
    noise[0] *= 2.0**0.5
    change[:, LAG:, 0] -= change[:, :-LAG, 0].copy()  # the first rows are not judged
    with np.errstate(over="ignore", invalid="ignore"):  # sizes at which the simulation diverges are tried too
        change = change[:, find_judged_rows(plant, command)] / noise
        unit_changes = change[len(values):].reshape(len(units), change[0].size)
        level_rows = []
        for row in change[:len(values)]:
            share = np.linalg.solve(unit_changes @ unit_changes.T + np.eye(len(units)), unit_changes @ row.ravel())
            residual = row - (np.clip(share, -HEALTHY_TOLERANCES, HEALTHY_TOLERANCES) @ unit_changes).reshape(row.shape)
            levels = dict(zip(names, compute_typical_rms(residual.T).tolist(), strict=True))
            none = dict.fromkeys(names, 0.0) | {"controller": levels[names[0]]}
            level_rows.append(none if effect.firmware else levels | {"controller": 0.0})
    return level_rows


def find_judged_rows(plant: str, command: Array) -> NDArray[np.bool_]:
    """The rows of a command, (n,), in which a hidden effect has to show."""
    kind, model = find_plant(plant), build_bare_model(plant)
    rows = np.arange(len(command)) >= LAG
    if kind.correct is None:
        return rows
    controlled = kind.signals.controlled
    reading = getattr(simulate(model.replace({controlled.noise: 0.0}), command), controlled.name)
    return rows & ~find_rest_rows(reading, kind.nominal["controller.period"], kind.nominal[controlled.noise])


def make_command(plant: str) -> Array:
    """The command of the plant's nominal test, (n,)."""
    return np.round(build_profile(find_plant(plant).profile, rate=_get_rate(plant)).command, 12)


def sample_holdout_command(plant: str, rng: np.random.Generator) -> Array:
    """Six segments of the nominal test in another order, of other sizes and signs, with rests between them, (n,)."""
    moving = [s for s in find_plant(plant).profile if not isinstance(s, Hold)]
    parts: list[Segment] = [Hold(time=0.3)]
    for i in rng.choice(len(moving), 6):
        factor = float(rng.uniform(0.4, 1.2)) * (-1.0 if rng.random() < 0.5 else 1.0)
        segment = moving[int(i)]
        size = {key: factor * getattr(segment, key) for key in ("to", "amplitude") if hasattr(segment, key)}
        parts += [replace(segment, name="", **size), Hold(time=0.3)]
    return np.round(build_profile([*parts, Ramp(to=0.0, time=1.0), Hold(time=0.3)], rate=_get_rate(plant)).command, 12)


def _get_rate(plant: str) -> float:
    return 1.0 / find_plant(plant).nominal["controller.period"]


def build_truth(plant: str, case: Case) -> Model:
    """The unit of a case."""
    model = build_bare_model(plant)
    model = model.replace({name: factor * model[name] for name, factor in case.scatter.items()})
    for name, values in case.hidden:
        effect = find_plant(plant).find_effect(name)
        model = (model if effect.base else model.with_effects([*model.effects, name])).replace(dict(values), name)
    return model


def write_case(plant: str, case: Case, folder: Path) -> None:
    """Write the traces and truth.json of a case into `folder`, which is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    kind, truth = find_plant(plant), build_truth(plant, case)
    outputs = [s.name for s in kind.signals.outputs]
    for turn, name in enumerate(NAMES):
        rng = np.random.default_rng([case.seed, 5, turn])
        command = sample_holdout_command(plant, rng) if name == "holdout" else make_command(plant)
        noise = rng.standard_normal((len(command), len(outputs) + 1))
        level, period = judge.FLOORS["xj"], 1.0 / _get_rate("eha")
        noise[:, 0] = judge.sample_coloured_noise(len(command), level, case.colour, case.hum, period, rng) / level
        run = simulate(truth, command, steps=STEPS, drawn=noise)
        columns = {name: getattr(run, name) for name in ("t", *kind.signals.names)}
        write_columns(folder / f"{name}.csv.gz", columns, case.signals, outputs)
    write_truth(folder, _describe_case(plant, case), outputs)


def _describe_case(plant: str, case: Case) -> dict[str, Any]:
    """As `studies.hidden_effects.cases.describe_case`; where the effects act is not measured."""
    kind, command = find_plant(plant), make_command(plant)
    effects: list[dict[str, Any]] = []
    for name, values in case.hidden:
        effect = kind.find_effect(name)
        parameter, unit = name_parameter(effect)
        effects.append({"name": name, "parameter": parameter, "value": values[parameter], "unit": unit,
                        "size": values[parameter], "symbols": values,
                        "floors": measure_levels(plant, effect, [values], command)[0], "where": None})
        if case.signals != ",".join(s.name for s in kind.signals.outputs):  # the law may need them all
            effects[-1]["floors"]["controller"] = 0.0
    signals = [*(s.name for s in kind.signals.outputs), "controller"]
    together = {signal: max((e["floors"][signal] for e in effects), default=0.0) for signal in signals}
    return {"case": f"{case.seed:05d}", "plant": plant, "kind": case.kind, "signals": case.signals, "effects": effects,
            "floors": together, "where": None,
            "holdout_noise": {s.name: kind.nominal[s.noise] for s in kind.signals.outputs},
            "noise": {"colour": case.colour, "hum": case.hum},
            "parameters": case.scatter}
