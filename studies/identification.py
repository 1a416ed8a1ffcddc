"""Trials of `rig identify`: `python -m studies.identification --count 20 --out FILE.jsonl`.

Each trial draws an actuator about twice as large as the nominal one, fits two of its runs from the nominal model, and
counts the parameters whose 95 % interval holds the true value, and the error on the held-out run. A finished trial is a
line of the file; an interrupted study resumes there.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation import measure_share
from fdi.identification.identify import identify_model, read_free_parameters, read_identification_runs
from fdi.trace import Trace
from plant import RATE, load_model
from rig.campaign.judge import FLOORS
from studies.hidden_effects import command
from studies.hidden_effects.cases import sample_healthy_plant
from studies.hidden_effects.truth import SYMBOLS, nominal_symbols, simulate_truth

Array = NDArray[np.float64]
GAIN = "controller.proportional_gain"

FACTORS = {"AJ": (1.7, 2.4), "XJM": (0.5, 0.8), "GQ": (1.3, 2.5), "GQF": (0.7, 1.5), "GM": (0.8, 1.3),
           "KSF": (0.8, 1.3), "PSR": (0.8, 1.6), "MJ": (1.0, 3.0), "CJ": (0.7, 2.5), "CLK": (0.7, 3.0),
           "GAP": (0.7, 1.3), "FDJ": (1.0, 2.5), "FDS": (0.7, 2.0)}
"""Ranges from which the factor on a nominal parameter is drawn, its logarithm uniform, by symbol."""
FRICTION_RATIO = {"FSJ": ("FDJ", (1.44, 1.92)), "FSS": ("FDS", (1.25, 1.87))}
"""Static friction: the dynamic one by symbol, and the range of the ratio."""


class Unit(NamedTuple):
    """An actuator and its runs: two to fit, one held out."""

    plant: dict[str, float]  # by symbol
    fitted: tuple[Trace, Trace]
    held_out: Trace

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name, SI."""
        return {SYMBOLS[symbol]: value for symbol, value in self.plant.items()}


def sample_actuator(seed: int, scatter: float = 0.015) -> dict[str, float]:
    """The parameters of an actuator about twice as large as the nominal one, by symbol, with the usual scatter."""
    rng = np.random.default_rng([seed, 11])
    plant = nominal_symbols() | sample_healthy_plant(scatter, rng)
    for symbol, (low, high) in FACTORS.items():
        plant[symbol] *= float(np.exp(rng.uniform(np.log(low), np.log(high))))
    for symbol, (other, (low, high)) in FRICTION_RATIO.items():
        plant[symbol] = plant[other] * float(rng.uniform(low, high))
    return plant


def simulate_unit(seed: int) -> Unit:
    """A random actuator with its runs: the preflight's command; both end stops and a random command with known loads;
    and another random command with known loads, held out.
    """
    plant = sample_actuator(seed)
    rng = np.random.default_rng([seed, 13])
    stop, force = 1.05 * plant["XJM"], 0.25 * plant["AJ"] * plant["PSR"]
    seconds = 1.0 + 2.0 * stop / 0.025
    stops = np.concatenate([np.zeros(500), np.full(round(500 * seconds), stop), np.full(round(1000 * seconds), -stop),
                            np.zeros(1000)])
    commands = [command.preflight_command(), np.concatenate([stops, command.sample_holdout_command(rng)]),
                command.sample_holdout_command(rng)]
    forces = (0.0, force, 0.5 * force)
    first, second, third = (_measure(plant, np.round(com, 12), f, [seed, 17, i])
                            for i, (com, f) in enumerate(zip(commands, forces, strict=True)))
    return Unit(plant, (first, second), third)


def _measure(plant: dict[str, float], com: Array, force: float, seed: list[int]) -> Trace:
    rng, n = np.random.default_rng(seed), len(com)
    noise = {signal: level * rng.standard_normal(n) for signal, level in FLOORS.items()}
    run = simulate_truth(com, plant, noise["xj"], command.known_load_profile(n, force))
    columns = run._asdict() | {"p12": run.p12 + noise["p12"], "xs": run.xs + noise["xs"]}
    return Trace.from_columns(columns, 1 / RATE, {"source": "-".join(map(str, seed))})


def judge_unit(seed: int, workers: int | None = None) -> dict[str, Any]:
    """The result of one trial as JSON values."""
    unit, model = simulate_unit(seed), load_model()
    ranges = read_free_parameters(model, None)
    runs = read_identification_runs(model, ranges, unit.fitted, [unit.held_out])
    identification = identify_model(runs.model, ranges, runs.fitted, runs.held_out, runs.sources, workers=workers)
    truth = unit.values
    rows = {e.name: {"true": truth[e.name], "value": e.value, "low": e.low, "high": e.high,
                     "identifiable": e.is_identifiable, "inside": e.low <= truth[e.name] <= e.high}
            for e in identification.estimates}
    return {"seed": seed, "verdict": identification.verdict, "parameters": rows,
            "gain_error": identification.model[GAIN] / truth[GAIN] - 1.0,
            "fitted": max(e.ratio for e in identification.errors if not e.is_held_out),
            "held_out": max(e.ratio for e in identification.holdouts),
            "decided": max(e.decided_ratio for e in identification.holdouts),
            "undecided": max(e.undecided for e in identification.holdouts)}


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The results as a table in Markdown: one line a parameter, then the held-out error."""
    names = list(rows[0]["parameters"])
    lines = ["| parameter | identifiable | true value in the 95 % interval | median half width | median error |",
             "|---|---|---|---|---|"]
    total, good = 0, 0
    for name in names:
        estimates = [p for row in rows if (p := row["parameters"][name])["identifiable"]]
        inside = sum(p["inside"] for p in estimates)
        total, good = total + len(estimates), good + inside
        half = _find_median([(p["high"] - p["low"]) / 2 / p["value"] for p in estimates])
        error = _find_median([abs(p["value"] / p["true"] - 1) for p in estimates])
        lines.append(f"| {name} | {len(estimates)} of {len(rows)} | {inside} of {len(estimates)} | "
                     f"{100 * half:.2g} % | {100 * error:.2g} % |")
    share = measure_share(good, total)
    whole = sum(all(p["inside"] for p in row["parameters"].values() if p["identifiable"]) for row in rows)
    ratios, decided_ratios = (sorted(row[key] for row in rows) for key in ("held_out", "decided"))
    words = sorted({row["verdict"] for row in rows})
    verdicts = ", ".join(f"{word} {sum(row['verdict'] == word for row in rows)}" for word in words)
    lines += ["", f"All parameters: {good} of {total} intervals hold the true value ({100 * share.value:.1f} %, "
              f"{100 * share.low:.1f} .. {100 * share.high:.1f}); in {whole} of {len(rows)} trials all of them do. "
              f"Held-out error: median {ratios[len(ratios) // 2]:.3f}, largest {ratios[-1]:.3f} noise floors; "
              f"{sum(x <= 1.1 for x in ratios)} of {len(ratios)} at most 1.1; without the rows that no model can "
              f"predict {sum(x <= 1.1 for x in decided_ratios)}, largest {decided_ratios[-1]:.3f}. "
              f"Verdicts: {verdicts}."]
    return "\n".join(lines)


def _find_median(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2] if values else float("nan")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run trials; see --help."""
    parser = argparse.ArgumentParser(prog="python -m studies.identification",
                                     description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial; each trial uses the next seed")
    parser.add_argument("--out", type=Path, required=True, help="a line of JSON for each trial; finished ones are kept")
    parser.add_argument("--workers", type=int, default=None, help="threads (default: one a core)")
    args = parser.parse_args(arguments)
    text = args.out.read_text(encoding="utf-8") if args.out.exists() else ""
    rows = {row["seed"]: row for row in map(json.loads, text.splitlines())}
    for seed in range(args.seed, args.seed + args.count):
        if seed not in rows:
            rows[seed] = judge_unit(seed, args.workers)
            with args.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[seed]) + "\n")
    print(format_table([rows[seed] for seed in range(args.seed, args.seed + args.count)]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
