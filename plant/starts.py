"""Finds start values for fits and scans, for effects that name none, from how much an effect changes the signals."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from plant.effects import Effect
from plant.lanes import Lanes
from plant.model import Model, build_bare_model
from plant.plants import Plant, find_plant
from plant.quantity import Quantity
from plant.run import compute_answers, report_law_errors, simulate
from plant.segments import Array

VISIBLE = (3.0, 30.0, 300.0)  # noise levels that starts are to show
SHAPES = (1.0, 0.4, 2.5)  # times the usual value, for a parameter that does nothing alone
QUARTERS = [0.5 * np.pi * turns for turns in range(-1, 4)]  # starts of a phase, rad, of -pi .. pi or of 0 .. 2 pi
DECADES = (-15, 13)  # where the size of a parameter without a hint is looked for
ANCHOR = 2.0  # 1/s
WITHOUT_SIZE = ("1", "s", "Hz", "rad")  # units of parameters that are alike in plants of any size
PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3, "M": 1e6, "G": 1e9}
_NUMBER = r"\d+(?:\.\d+)?(?:e[+-]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})\s*-\s*({_NUMBER})\s*([^,;:]*)")


def find_starts(effect: Effect, command: Array, load: Array | None = None, plant: str = "eha",
                beside: Sequence[str] = ()) -> tuple[Mapping[str, float], ...]:
    """Values of all fitted parameters to start from: the effect's own, or found from its ranges and its visibility.

    A parameter that says in what range it is typical ("0.2-5 kN") starts at both ends and between. Of one that says
    nothing, sizes are looked for that change what the sensors see over `command` by 3, 30 and 300 times their noise.

    Args:
        effect: any that the plant can have.
        command: (n,) demand, one a cycle.
        load: (n,) external load; none by default.
        plant: that has the effect.
        beside: effects that the model has too, at their off values: the kernel for all of them makes the runs.

    Returns:
        Starts, "group.field" to SI value; none when nothing can be seen over this command.

    Raises:
        InputError: a law that cannot be compiled and run.
    """
    if effect.starts or not effect.fitted:
        return effect.starts
    usual = {name: effect.off.get(name, find_plant(plant).nominal.get(name, 0.0)) for name in effect.fitted}
    sized = {name: sizes for name, off in usual.items()
             if (sizes := _find_sizes(effect, name, off, command, load, plant, beside))}
    starts = [usual | {name: size} for name, sizes in sized.items() for size in sizes]
    for name, value in usual.items():
        if name not in sized:
            quantity = effect.parameters[name]
            usually = [factor * value for factor in SHAPES] if value or quantity.unit != "rad" else QUARTERS
            shapes = parse_hint(quantity) or [_clip_to_range(quantity, x) for x in usually]
            starts = [start | {name: shape} for start in starts for shape in dict.fromkeys(shapes)]
    return tuple(starts)


def lacks_starts(effect: Effect, kind: Plant) -> bool:
    """Whether start values of an effect have to be found: it has none, or it has those of an actuator of another size.

    The starts of shared effects are the EHA's: its null bias is some microamperes, that of a motor may be an ampere.
    Fractions and times are alike in plants of any size.
    """
    if not effect.starts:
        return bool(effect.fitted)
    is_of_eha = effect.function is not None and effect.function.__module__.startswith("plant.effects.")
    has_size = any(effect.parameters[name].unit not in WITHOUT_SIZE for name in effect.fitted)
    return (is_of_eha and has_size and effect.port not in ("command", "reading")
            and not kind.shared_starts and effect.name not in kind.effects)


def ensure_starts(name: str, command: Array, load: Array | None = None, plant: str = "eha",
                  beside: Sequence[str] = ()) -> Effect:
    """The effect of that name; its plant has the start values from now on (see `find_starts`).

    `command` and `load`, (n,) each, are those of the run that is to show the effect.
    """
    kind = find_plant(plant)
    effect = kind.find_effect(name)
    if lacks_starts(effect, kind):
        find = _resize_starts if effect.starts else find_starts
        effect = replace(effect, starts=find(effect, command, load, plant, beside) or effect.starts)
        kind.replace_effect(effect)
    return effect


def _resize_starts(effect: Effect, command: Array, load: Array | None, plant: str, beside: Sequence[str]
                   ) -> tuple[Mapping[str, float], ...]:
    """Starts of an effect that has those of another plant: sizes that this one shows, and what it shows of the others.

    A deviation of the controlled signal, or of its demand, is at most a tenth of the largest demand.
    """
    unhinted = {name: q._replace(typical="") for name, q in effect.parameters.items()}  # typical of the other plant
    starts = find_starts(replace(effect, starts=(), parameters=unhinted), command, load, plant, beside)
    changes = compute_changes(effect, effect.starts, command, load, plant, beside=beside)
    levels = compute_levels(changes, plant).max(axis=1)
    starts += tuple(start for start, level in zip(effect.starts, levels, strict=True) if VISIBLE[0] <= level < np.inf)
    unit, most = find_plant(plant).signals.controlled.unit, 0.1 * np.abs(command).max()
    return tuple(start for start in starts
                 if all(abs(x) <= most for name, x in start.items() if effect.parameters[name].unit == unit))


def compute_changes(effect: Effect, values: Sequence[Mapping[str, float]], command: Array, load: Array | None = None,
                    plant: str = "eha", anchor: float = ANCHOR, beside: Sequence[str] = ()) -> Array:
    """How an effect changes the signals of the nominal plant, driven by the same drive, without noise.

    An effect in the firmware changes no plant: then the first column is its drive over the loop's gain when it sees the
    same readings, and the others are zero.

    Args:
        effect: any that the plant can have.
        values: m sets of parameters, SI.
        command: (n,) demand that the nominal closed loop makes the drive from.
        load: (n,) external load.
        plant: whose signals they are.
        anchor: 1/s, at which the plant is drawn to the position of the nominal one.
        beside: as for `find_starts`.

    Returns:
        (m, n, outputs): change of each output; of the EHA XJ m, P12 Pa, XS m.
    """
    signals, force = find_plant(plant).signals, np.zeros_like(command) if load is None else load
    bare = build_bare_model(plant).replace({s.noise: 0.0 for s in signals.outputs if s.noise})
    run = simulate(bare, command, force)
    model = bare.with_effects([effect.name, *beside])  # one of the plant's own parameters adds nothing
    outputs = np.column_stack([getattr(run, s.name) for s in signals.outputs])
    if effect.firmware:
        return _compute_firmware_changes(model, values, command, outputs)
    names = list(dict.fromkeys(name for row in values for name in row))
    rows = [[model[name] for name in names], *([row.get(name, model[name]) for name in names] for row in values)]
    with report_law_errors(model), np.errstate(over="ignore", invalid="ignore"):  # at some sizes it diverges
        out = Lanes(model, names).replay(np.array(rows), getattr(run, signals.drive.name), force, outputs[:, 0], anchor)
        return out[1:] - out[:1]


@np.errstate(over="ignore", invalid="ignore")
def compute_rms(change: Array) -> Array:
    """RMS of each column of a `change` (m, n, outputs), SI, (m, outputs); infinite where the simulation diverged."""
    square: Array = (change**2).mean(axis=1)
    return np.sqrt(np.nan_to_num(square, nan=np.inf, posinf=np.inf))


@np.errstate(divide="ignore", invalid="ignore")
def compute_levels(change: Array, plant: str = "eha") -> Array:
    """RMS of a `change` (m, n, outputs) over the noise of each column's sensor, (m, outputs)."""
    kind = find_plant(plant)
    noise = np.array([kind.nominal.get(s.noise, 0.0) for s in kind.signals.outputs])
    levels: Array = compute_rms(change) / noise
    return np.nan_to_num(levels, nan=0.0, posinf=np.inf)


def _compute_firmware_changes(model: Model, values: Sequence[Mapping[str, float]], com: Array, readings: Array
                              ) -> Array:
    out = np.zeros((len(values) + 1, *readings.shape))
    for row, changes in zip(out, ({}, *values), strict=True):
        with report_law_errors(model):
            row[:, 0] = compute_answers(model.replace(changes), com, readings)
    return (out[1:] - out[:1]) / model.values.get("controller.proportional_gain", 1.0)


def _find_sizes(effect: Effect, name: str, off: float, command: Array, load: Array | None, plant: str,
                beside: Sequence[str]) -> list[float]:
    """Values of one parameter, on either side of its off value, that can be seen with the others as usual."""
    quantity = effect.parameters[name]

    def find_highest_level(values: Array) -> Array:
        change = compute_changes(effect, [{name: float(x)} for x in values], command, load, plant, beside=beside)
        return np.asarray(compute_levels(change, plant).max(axis=1))

    if hints := parse_hint(quantity):
        return hints if find_highest_level(np.array(hints)).max() > 0.0 else []
    sizes: list[float] = []
    for sign in (1.0, -1.0):
        decades = off + sign * np.logspace(*DECADES, DECADES[1] - DECADES[0] + 1)
        if effect.base and off:  # a stiffness that is lost is a fraction that nears 0
            decades = off * (1.0 + np.logspace(-4.0, 3.0, 15)) ** sign
        decades = decades[[not quantity.refuses(x) for x in decades]]
        levels = find_highest_level(decades) if len(decades) else decades
        for level in VISIBLE:
            above = np.flatnonzero(levels >= level)
            if not len(above):
                break
            i = above[0]
            finer = off + sign * np.geomspace(abs(decades[max(i - 1, 0)] - off), abs(decades[i] - off), 9)
            distance = np.abs(np.log(np.clip(find_highest_level(finer), 1e-9, 1e9) / level))
            if distance.min() < np.log(10.0):  # further off the simulation diverges
                sizes.append(float(finer[distance.argmin()]))
    return list(dict.fromkeys(sizes))


def parse_hint(quantity: Quantity) -> list[float]:
    """Both ends of the typical range, if there is one ("0.2-5 kN"), and values between them, SI.

    >>> parse_hint(Quantity("N", low=0, typical="1-4 kN"))
    [1000.0, 2000.0, 4000.0]
    >>> parse_hint(Quantity("N m", low=0, typical="1-4 kN m at rest"))
    [1000.0, 2000.0, 4000.0]
    """
    match = _RANGE.match(quantity.typical)
    if not match:
        return []
    low, high = float(match[1]), float(match[2])
    unit = " ".join(match[3].split()[:len(quantity.unit.split())])  # more words may follow: 1-5 % of Imax
    if quantity.unit == "1":
        factor = 0.01 if unit == "%" else 1.0
    elif unit.endswith(quantity.unit) and unit.removesuffix(quantity.unit) in PREFIXES:
        factor = PREFIXES[unit.removesuffix(quantity.unit)]
    else:
        return []
    sizes = [_clip_to_range(quantity, x * factor) for x in (low, (low * high) ** 0.5, high)]
    return [x for size in sizes for x in ((size, -size) if not quantity.refuses(-size) else (size,))]


def _clip_to_range(quantity: Quantity, x: float) -> float:
    return min(max(x, quantity.low), quantity.high)
