"""Cases of the blind trial, by their seed.

A case is a folder with the traces est.csv.gz (the preflight command), repeat.csv.gz (the same command, other noise) and
holdout.csv.gz (another command), and with truth.json (the hidden effects).
"""

import gzip
import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace import Section, find_sections
from plant import RATE, find_plant
from plant.effects import CATALOGUE, Effect
from rig.campaign import judge
from rig.campaign.judge import FLOORS
from studies.hidden_effects import command, hidden
from studies.hidden_effects.hidden import Hidden
from studies.hidden_effects.truth import SYMBOLS, Run, nominal_symbols, simulate_truth

Array = NDArray[np.float64]

KINDS = {"nothing": 0.20, "one": 0.50, "two": 0.12, "outside": 0.18}
"""What is hidden, with its probability: nothing, effects of the catalogue, or one outside the catalogue."""
SIGNALS = {"xj": 0.25, "xj,p12": 0.25, "xj,p12,xs": 0.5}
"""The measured signals, with their probability."""
OUTPUTS = ("xj", "p12", "xs")
LOOK_ALIKE = ("coil_lag", "transport_delay", "filter_clogging", "spool_friction", "viscous_drag", "supply_droop")
"""Effects that are taken for each other, or for a tolerance, while they are small."""
NO_STOP = 1.0  # m, travel of a ram that no replay reaches


class BenchLevel(NamedTuple):
    """How far plant and bench are from ideal."""

    scatter: float  # standard deviation of the plant's parameters, relative
    colour: float  # correlation of the position sensor's noise from one cycle to the next
    hum: float  # m, amplitude of the mains hum on the position sensor


LEVELS = {"exact": BenchLevel(0.0, 0.0, 0.0), "bench": BenchLevel(0.015, 0.8, 0.7e-6)}


class Case(NamedTuple):
    """The hidden effects of a case, and everything else that its traces depend on."""

    seed: int
    kind: str
    effects: tuple[Hidden, ...]
    signals: str
    level: BenchLevel
    plant: dict[str, float]  # symbols of the healthy plant that differ from nominal
    load: float  # N, known load


def sample_case(seed: int, kind: str | None = None, effects: Sequence[str] = (), level: str | None = None,
                sizes: tuple[float, float] = (0.0, 1.0), signals: str | None = None) -> Case:
    """The case of a seed.

    Args:
        seed: what the random numbers follow from.
        kind: one of KINDS; default: random.
        effects: names of the hidden effects; default: random.
        level: one of LEVELS; default: random.
        sizes: the fractions of an effect's logarithmic range that its size is drawn from. Of two effects both are in
            the upper half of their range.
        signals: the measured signals, one of SIGNALS; default: random. They are drawn all the same, so that nothing
            else about the case depends on this choice.
    """
    rng = np.random.default_rng([seed, 3])
    kind = kind or ("one" if effects else str(rng.choice(list(KINDS), p=list(KINDS.values()))))
    random_level = _sample_level(rng)
    bench = LEVELS[level] if level else random_level
    random_signals = str(rng.choice(list(SIGNALS), p=list(SIGNALS.values())))
    plant = sample_healthy_plant(bench.scatter, rng)
    low = max(sizes[0], 0.5) if kind == "two" else sizes[0]
    hidden_effects = tuple(hidden.sample_hidden_effect(name, nominal_symbols() | plant, rng, low, sizes[1])
                           for name in effects or _sample_effect_names(kind, rng))
    load = max((effect.known_load for effect in hidden_effects), default=0.0)
    is_loaded = rng.random() < 0.1 and bench.scatter > 0  # one in ten of the cases that do not need a known load
    random_load = float(rng.uniform(2000, 8000)) if is_loaded else 0.0
    return Case(seed, kind, hidden_effects, signals or random_signals, bench, plant, load or random_load)


def sample_small_case(seed: int, signals: str | None = None) -> Case:
    """A case of one of the effects that others look like, of a size that 1 to 2 noise floors show at best."""
    rng = np.random.default_rng([seed, 7])
    while True:
        name, target = str(rng.choice(LOOK_ALIKE)), float(rng.uniform(1.1, 1.9))
        low, high = -2.0, 1.0  # of the logarithmic range of sizes, which begins at about 2 floors
        for _ in range(10):  # friction that just holds a spool shows by more than 2 floors at once: another effect then
            middle = 0.5 * (low + high)
            case = sample_case(seed, effects=[name], sizes=(middle, middle), signals=signals)
            changes = measure_changes(case, measure_case(case, "est"), [name])
            level = max(measure_rms(changes[signal]) for signal in case.signals.split(","))
            if abs(level - target) < 0.1:
                return case
            low, high = (middle, high) if level < target else (low, middle)


def sample_healthy_plant(spread: float, rng: np.random.Generator) -> dict[str, float]:
    """The parameters of a healthy plant, by symbol; `spread` is their relative standard deviation about nominal."""
    symbol_of = {name: symbol for symbol, name in SYMBOLS.items()}
    healthy = judge.sample_healthy_plant(spread, rng, find_plant("eha"))
    return {symbol_of[name]: value for name, value in healthy.items()}


def _sample_level(rng: np.random.Generator) -> BenchLevel:
    """A scatter of 0 to 2 %; white noise in one case of three, otherwise coloured noise with hum."""
    scatter, white = float(rng.uniform(0, 0.02)), rng.random() < 1 / 3
    colour, hum = float(rng.uniform(0.6, 0.85)), float(rng.uniform(0.3e-6, 1.1e-6))
    return BenchLevel(scatter, 0.0, 0.0) if white else BenchLevel(scatter, colour, hum)


def _sample_effect_names(kind: str, rng: np.random.Generator) -> list[str]:
    """The names of a kind's hidden effects, without pairs that cannot be hidden together."""
    if kind == "nothing":
        return []
    if kind == "outside":
        return [str(rng.choice(list(hidden.OUTSIDE)))]
    while True:
        names = [str(name) for name in rng.choice(list(hidden.CATALOGUE), 2 if kind == "two" else 1, replace=False)]
        if not any(pair <= set(names) for pair in hidden.EXCLUDES):
            return names


def list_changed_symbols(case: Case, without: Iterable[str] = ()) -> dict[str, float]:
    """The plant's symbols that differ from nominal; the effects `without` are left out."""
    changes = dict(case.plant)
    for effect in case.effects:
        if effect.name not in without:
            changes |= {key: value for key, value in effect.changes.items() if key not in hidden.NOT_SIMULATED}
    return changes


class Measured(NamedTuple):
    """A trace and the noise in it, one row per cycle."""

    trace: Run
    noise: dict[str, Array]


def measure_case(case: Case, name: str) -> Measured:
    """The trace `name` ("est", "repeat" or "holdout") of a case as its bench records it."""
    turn = ("est", "repeat", "holdout").index(name)
    rng = np.random.default_rng([case.seed, 5, turn])
    com = np.round(command.sample_holdout_command(rng) if name == "holdout" else command.preflight_command(), 12)
    n = len(com)
    noise = {"xj": judge.sample_coloured_noise(n, FLOORS["xj"], case.level.colour, case.level.hum, 1 / RATE, rng)}
    noise |= {signal: FLOORS[signal] * rng.standard_normal(n) for signal in ("p12", "xs")}
    run = simulate_truth(com, list_changed_symbols(case), noise["xj"], command.known_load_profile(n, case.load))
    return Measured(run._replace(p12=run.p12 + noise["p12"], xs=run.xs + noise["xs"]), noise)


def measure_changes(case: Case, measurement: Measured, without: Iterable[str]) -> dict[str, Array]:
    """What effects change in a trace, (n,) each, in noise floors: the trace less noise, less a replay `without` them.

    The replay is driven by the measured current, and has no end stops: without a bias it would drift to one.
    """
    run, noise = measurement.trace, measurement.noise
    symbols = list_changed_symbols(case, without) | {"XJM": NO_STOP}
    bare = simulate_truth(run.com, symbols, None, run.load, run.cor)
    change = measure_floors({name: getattr(run, name) - noise[name] - getattr(bare, name) for name in OUTPUTS})
    return change | {"cor": measure_law_error(run.com, run.xj, run.cor)}


def measure_floors(differences: Mapping[str, Array], lag: int = 20) -> dict[str, Array]:
    """Differences of two runs, SI, (.., n) each, in noise floors.

    That of the position is its change over `lag` cycles, because the position of a replay drifts with any difference.
    """
    floors = {name: x / FLOORS[name] for name, x in differences.items()}
    change = np.zeros_like(floors["xj"])
    change[..., lag:] = (floors["xj"][..., lag:] - floors["xj"][..., :-lag]) / 2**0.5
    return floors | {"xj": change}


def measure_law_error(com: Array, xj: Array, cor: Array) -> Array:
    """The controller's answer less the control law, (n,), in units of what the position's noise floor does to it."""
    p = nominal_symbols()
    return (cor - np.clip(p["GAP"] * (com - xj), -p["Imax"], p["Imax"])) / (p["GAP"] * FLOORS["xj"])


def describe_change(changes: Mapping[str, Array], command: Array) -> dict[str, Any]:
    """The RMS of `changes` in noise floors, and the cells "signal/section" of the `command` where it is above 1.

    The sections are those of `name_sections`.
    """
    sections = name_sections(command)
    return {"floors": {signal: measure_rms(x) for signal, x in changes.items()},
            "where": [f"{signal}/{name}" for signal, x in changes.items() for name, rows in sections.items()
                      if measure_rms(x[rows.start:rows.stop]) > 1.0]}


def name_sections(command: Array) -> dict[str, Section]:
    """The sections of a command by name: s01, s02, .."""
    return {f"s{number:02d}": section for number, section in enumerate(find_sections(command, 1 / RATE), start=1)}


def measure_rms(x: Array) -> float:
    """The RMS of all elements."""
    return float(np.sqrt((x**2).mean()))


def write_case(case: Case, folder: Path) -> None:
    """Write the traces and truth.json of a case into `folder`, which is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("est", "repeat", "holdout"):
        measurement = measure_case(case, name)
        columns = {"t": np.arange(len(measurement.trace.com)) / RATE, **measurement.trace._asdict()}
        write_columns(folder / f"{name}.csv.gz", columns, case.signals)
        if name == "est":
            truth = describe_case(case, measurement)
        noise = {signal: measure_rms(x) for signal, x in measurement.noise.items()}
    write_truth(folder, truth | {"holdout_noise": noise}, OUTPUTS)


def write_columns(path: Path, columns: Mapping[str, Array], signals: str, outputs: Collection[str] = OUTPUTS) -> None:
    """Write the columns of a trace, (n,) each, without those of the `outputs` that are not among the `signals`.

    The file has no time stamp: the same case gives the same bytes.
    """
    names = [name for name in columns if name in signals.split(",") or name not in outputs]
    rows = np.column_stack([columns[name] for name in names]).tolist()
    lines = [",".join(names), *(",".join(f"{x:.9g}" for x in row) for row in rows), ""]
    path.write_bytes(gzip.compress("\n".join(lines).encode(), compresslevel=4, mtime=0))


def read_columns(path: Path) -> dict[str, Array]:
    """The columns of a trace that `write_columns` wrote, (n,) each, SI."""
    names = gzip.decompress(path.read_bytes()).partition(b"\n")[0].decode().split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))


def describe_case(case: Case, est: Measured) -> dict[str, Any]:
    """What is hidden in a case, and its unit, as JSON values."""
    effects = []
    for effect in case.effects:
        change = describe_change(measure_changes(case, est, [effect.name]), est.trace.com)
        parameter, unit = name_parameter(CATALOGUE.get(effect.name))
        effects.append({"name": effect.name, "parameter": parameter, "value": effect.value, "unit": unit,
                        "size": effect.size, "symbols": effect.changes} | change)
    together = measure_changes(case, est, [effect.name for effect in case.effects])
    return {"case": f"{case.seed:05d}", "plant": "eha", "kind": case.kind, "signals": case.signals, "effects": effects,
            **describe_change(together, est.trace.com), "known_load": case.load, "noise": case.level._asdict(),
            "parameters": case.plant}


def name_parameter(effect: Effect | None) -> tuple[str, str]:
    """The parameter that gives the size of an effect, and its unit; empty without an effect."""
    return (effect.fitted[0], effect.parameters[effect.fitted[0]].unit) if effect else ("", "")


def write_truth(folder: Path, truth: Mapping[str, Any], outputs: Collection[str]) -> None:
    """Write truth.json: of the `outputs` only those that are measured, and eight digits of each number.

    Every processor then writes the same bytes.
    """
    hidden_from_all = set(outputs) - set(truth["signals"].split(","))

    def shorten(x: Any) -> Any:
        if isinstance(x, Mapping):
            return {key: shorten(value) for key, value in x.items() if key not in hidden_from_all}
        if isinstance(x, list | tuple):
            return [shorten(value) for value in x if str(value).partition("/")[0] not in hidden_from_all]
        if isinstance(x, float):
            return float(f"{x:.8g}") if math.isfinite(x) else None
        return x

    (folder / "truth.json").write_text(json.dumps(shorten(truth), indent=1) + "\n", encoding="utf-8")
