"""Trials of `rig identify`: `python -m rig.studies.identification.run_trials --count 20 --out FILE.jsonl`.

Each trial draws an actuator about twice as large as the nominal one, fits two of its runs from the nominal model, and
counts the parameters whose 95 % interval holds the true value, and the error on the held-out run. A finished trial is a
line of the file; an interrupted study resumes there.
"""
from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi.estimation.binomial import measure_share
from fdi.identification.free_parameters import read_free_parameters
from fdi.identification.identify import identify_model
from fdi.identification.runs import collect_identification_runs
from plant.model import load_model
from rig.studies.identification.actuators import simulate_unit


def judge_unit(seed: int, workers: int | None = None) -> dict[str, Any]:
    """The result of one trial as JSON values."""
    unit, model = simulate_unit(seed), load_model()
    ranges = read_free_parameters(model, None)
    runs = collect_identification_runs(model, ranges, unit.fitted, [unit.held_out])
    found = identify_model(runs.model, ranges, runs.fitted, runs.held_out, runs.sources, workers=workers)
    truth = unit.values
    rows = {e.name: {"true": truth[e.name], "value": e.value, "low": e.low, "high": e.high,
                     "identifiable": e.is_identifiable, "inside": e.low <= truth[e.name] <= e.high}
            for e in found.estimates}
    return {"seed": seed, "verdict": found.verdict, "parameters": rows, "gain_error": _compare_gain(found, truth),
            "fitted": max(e.ratio for e in found.errors if not e.is_held_out),
            "held_out": max(e.ratio for e in found.holdouts),
            "decided": max(e.decided_ratio for e in found.holdouts),
            "undecided": max(e.undecided for e in found.holdouts)}


def _compare_gain(found: Any, truth: Mapping[str, float]) -> float:
    name = "controller.proportional_gain"
    return float(found.model[name] / truth[name] - 1.0)


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The results as a table in Markdown: one line a parameter, then the held-out error."""
    names = list(rows[0]["parameters"])
    lines = ["| parameter | identifiable | true value in the 95 % interval | median half width | median error |",
             "|---|---|---|---|---|"]
    total, good = 0, 0
    for name in names:
        seen = [p for row in rows if (p := row["parameters"][name])["identifiable"]]
        inside = sum(p["inside"] for p in seen)
        total, good = total + len(seen), good + inside
        half = _find_median([(p["high"] - p["low"]) / 2 / p["value"] for p in seen])
        error = _find_median([abs(p["value"] / p["true"] - 1) for p in seen])
        lines.append(f"| {name} | {len(seen)} of {len(rows)} | {inside} of {len(seen)} | {100 * half:.2g} % | "
                     f"{100 * error:.2g} % |")
    share = measure_share(good, total)
    whole = sum(all(p["inside"] for p in row["parameters"].values() if p["identifiable"]) for row in rows)
    held, decided = (sorted(row[key] for row in rows) for key in ("held_out", "decided"))
    words = sorted({row["verdict"] for row in rows})
    verdicts = ", ".join(f"{word} {sum(row['verdict'] == word for row in rows)}" for word in words)
    lines += ["", f"All parameters: {good} of {total} intervals hold the true value ({100 * share.value:.1f} %, "
              f"{100 * share.low:.1f} .. {100 * share.high:.1f}); in {whole} of {len(rows)} trials all of them do. "
              f"Held-out error: median {held[len(held) // 2]:.3f}, largest {held[-1]:.3f} noise floors; "
              f"{sum(x <= 1.1 for x in held)} of {len(held)} at most 1.1; without the rows that no model can predict "
              f"{sum(x <= 1.1 for x in decided)}, largest {decided[-1]:.3f}. Verdicts: {verdicts}."]
    return "\n".join(lines)


def _find_median(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2] if values else float("nan")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run trials; see --help."""
    parser = argparse.ArgumentParser(prog="python -m rig.studies.identification.run_trials",
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
