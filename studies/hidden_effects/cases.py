"""Cases of the blind trial: `python -m studies.hidden_effects.cases --out DIR --count N --seed S` writes traces.

A case is a folder with the traces est.csv.gz (the preflight command), repeat.csv.gz (the same command, other noise) and
holdout.csv.gz (another command), and with truth.toml (the hidden effects). Everything follows from the seed.
"""
from __future__ import annotations

import argparse
import gzip
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.plants import find_plant
from plant.segments import RATE
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
    drawn = tuple(hidden.sample_hidden_effect(name, nominal_symbols() | plant, rng, low, sizes[1])
                  for name in effects or _sample_effect_names(kind, rng))
    load = max((effect.known_load for effect in drawn), default=0.0)
    is_loaded = rng.random() < 0.1 and bench.scatter > 0  # one in ten of the cases that do not need a known load
    random_load = float(rng.uniform(2000, 8000)) if is_loaded else 0.0
    return Case(seed, kind, drawn, signals or random_signals, bench, plant, load or random_load)


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


def measure_effect_ratios(case: Case, measured: Measured, without: Iterable[str]) -> dict[str, float]:
    """The RMS effect on each signal in noise floors: the trace against a replay of the plant `without` the effects.

    The replay is driven by the measured current. `xj_drift` is the whole difference in position, which drifts; `xj` is
    its change over 20 cycles. `controller` is the difference between the controller's answer and the control law, in
    units of what the position's noise floor does to the answer.
    """
    run, noise = measured.trace, measured.noise
    bare = simulate_truth(run.com, list_changed_symbols(case, without), None, run.load, run.cor)
    xj, lag = run.xj - noise["xj"] - bare.xj, 20
    p = nominal_symbols()
    law = np.clip(p["GAP"] * (run.com - run.xj), -p["Imax"], p["Imax"])
    return {"xj": _measure_rms(xj[lag:] - xj[:-lag]) / (FLOORS["xj"] * 2**0.5),
            "xj_drift": _measure_rms(xj) / FLOORS["xj"],
            "p12": _measure_rms(run.p12 - noise["p12"] - bare.p12) / FLOORS["p12"],
            "xs": _measure_rms(run.xs - noise["xs"] - bare.xs) / FLOORS["xs"],
            "controller": _measure_rms(run.cor - law) / (p["GAP"] * FLOORS["xj"])}


def _measure_rms(x: Array) -> float:
    return float(np.sqrt((x**2).mean()))


def write_case(case: Case, folder: Path) -> None:
    """Write the traces and truth.toml of a case into `folder`, which is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("est", "repeat", "holdout"):
        measured = measure_case(case, name)
        _write_trace(measured.trace, folder / f"{name}.csv.gz")
        if name == "est":
            (folder / "truth.toml").write_text(_format_truth(case, measured), encoding="utf-8")


def _write_trace(run: Run, path: Path) -> None:
    rows = np.column_stack([run.com, run.xj, run.cor, run.p12, run.xs, run.load]).tolist()
    lines = [f"{k / 1000:.3f},%.9g,%.9g,%.9g,%.9g,%.9g,%.9g" % tuple(row) for k, row in enumerate(rows)]
    text = "\n".join(["t,com,xj,cor,p12,xs,load", *lines, ""])
    # without a time stamp: the same case gives the same bytes
    path.write_bytes(gzip.compress(text.encode(), compresslevel=4, mtime=0))


def _format_truth(case: Case, est: Measured) -> str:
    """The hidden effects and the plant of a case, as TOML."""
    names = [effect.name for effect in case.effects]
    lines = [f"seed = {case.seed}", f"kind = {json.dumps(case.kind)}", f"effects = {json.dumps(names)}",
             f"signals = {json.dumps(case.signals)}", f"known_load = {case.load:.6g}", "", "[level]",
             *(f"{key} = {value:.6g}" for key, value in case.level._asdict().items()), "", "[base_ratio]",
             *_format_table(measure_effect_ratios(case, est, names))]
    for effect in case.effects:
        lines += ["", "[[hidden]]", f"effect = {json.dumps(effect.name)}", f"size = {effect.size:.6g}",
                  f"value = {effect.value:.8g}", "[hidden.changes]", *_format_table(effect.changes)]
        if len(case.effects) > 1:
            lines += ["[hidden.ratio]", *_format_table(measure_effect_ratios(case, est, [effect.name]))]
    return "\n".join([*lines, "", "[plant]", *_format_table(case.plant), ""])


def _format_table(values: dict[str, float]) -> list[str]:
    return [f"{key} = {value:.8g}" for key, value in values.items()]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write cases to a folder; see --help."""
    parser = argparse.ArgumentParser(prog="python -m studies.hidden_effects.cases",
                                     description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the folders of the cases")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first case; each case uses the next seed")
    parser.add_argument("--kind", choices=list(KINDS))
    parser.add_argument("--effect", action="append", default=[], choices=[*hidden.CATALOGUE, *hidden.OUTSIDE],
                        help="the hidden effect; give it twice to hide two")
    parser.add_argument("--level", choices=list(LEVELS), help="scatter and noise of the bench (default: random)")
    parser.add_argument("--signals", choices=list(SIGNALS), help="the measured signals (default: random)")
    parser.add_argument("--sizes", type=float, nargs=2, default=(0.0, 1.0), metavar=("LOW", "HIGH"),
                        help="fractions of the logarithmic range of sizes (default: 0 1)")
    args = parser.parse_args(arguments)
    for seed in range(args.seed, args.seed + args.count):
        kind = args.kind or ("two" if len(args.effect) > 1 else None)
        case = sample_case(seed, kind, args.effect, args.level, tuple(args.sizes), args.signals)
        write_case(case, args.out / f"{seed:04d}")
        print(f"{seed:04d} {case.kind}: {', '.join(f'{e.name} {e.size:.4g}' for e in case.effects)}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
