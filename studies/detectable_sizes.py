"""Are the claims of `rig explain --sensitivity` true? Sizes are claimed for one unit and hidden in others.

The units are those of the trial's simulator, with scatter, coloured noise and hum. An effect hidden in another unit at
1.5 times the claimed size should be named in nine cases of ten, at half the size in few:

    python -m studies.detectable_sizes --out sizes --effects null_bias,coil_lag

The folder holds claims.jsonl, one row for each run that the claims rest on (hours for all effects), and sizes.jsonl,
one for each case; an interrupted study resumes there.
"""

import argparse
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fdi.discovery.explain_runs import explain_runs
from fdi.discovery.runs import read_runs
from fdi.discovery.sensitivity import describe_unit
from fdi.progress import Progress, ignore_progress
from fdi.sources import hash_sources
from plant import Model
from plant.effects import CATALOGUE
from rig.campaign.batch import BatchProgress, Row, Workers
from rig.campaign.sensitivity import measure_sensitivity
from studies.command import report_progress as report_claims, run_cases
from studies.hidden_effects import cases, hidden
from studies.hidden_effects.hidden import Hidden
from studies.hidden_effects.rig_answer import run_rig_explain
from studies.hidden_effects.truth import nominal_symbols

EFFECTS = tuple(name for name in hidden.CATALOGUE
                if name not in ("orifice_root", "supply_ripple", "quantisation", "command_rate_limit", "presliding"))
"""Effects with a size that both simulators give in the same unit, and that a replay passes.

Presliding over less than 0.1 um is too stiff for the trial's simulator."""
FACTORS = (1.5, 0.5)
"""Times the claimed size."""
COLUMNS = ["xj", "p12", "xs"]

SIZES: Mapping[str, Callable[[float, Mapping[str, float]], float]] = {
    "jack_friction": lambda value, p: value / p["FSJ"] - 1.0,
    "viscous_drag": lambda value, p: value / p["CJ"] - 1.0,
    "moving_mass": lambda value, p: math.log(value / p["MJ"]),
    "viscosity_drift": lambda value, p: math.log(value),
    "compressibility": lambda value, p: 1.0 / value,
    "mount_compliance": lambda value, p: 1.0 / value,
}
"""From the value of an effect's first parameter to the trial's size, where they differ."""


CLAIMED_SEED, HIDDEN_SEED = 7700, 7800  # of the unit that the claims are made for, and of the first other one


def claim_sizes(folder: Path, effects: Sequence[str] = EFFECTS, workers: Workers = Workers(1),  # noqa: B008
                report_progress: Progress = ignore_progress) -> dict[str, float]:
    """The smallest size of each effect that `rig explain --sensitivity` claims for a healthy unit; infinite for none.

    Raises:
        InputError: no C compiler, or the folder cannot be made.
    """
    case = cases.sample_case(CLAIMED_SEED, kind="nothing", level="bench")._replace(signals="xj,p12,xs")
    cases.write_case(case, folder / "healthy")
    names = [str(folder / "healthy" / f"{name}.csv.gz") for name in ("est", "repeat", "holdout")]
    runs = read_runs(Model(), names[0], names[1:2], names[2], COLUMNS)
    answer, _ = explain_runs(runs)
    unit = describe_unit(runs, answer, effects)
    claims = measure_sensitivity(unit, answer, folder / "claims.jsonl", workers, report_progress)
    return {claim.effect: math.inf if claim.smallest is None else claim.smallest for claim in claims}


def run_study(count: int, folder: Path, report_progress: Callable[[BatchProgress], None] = lambda _: None,
              effects: Sequence[str] = EFFECTS, claimed: Mapping[str, float] | None = None) -> list[Row]:
    """The rows of so many cases: every effect at each of `FACTORS` times its claimed size, then again on other units.

    `claimed`: sizes by effect; default: those of `claim_sizes`. Raises InputError as that does.
    """
    sizes = claim_sizes(folder, effects) if claimed is None else claimed
    plan = [(effect, factor) for factor in FACTORS for effect in effects]
    jobs = {number: (number, *plan[number % len(plan)]) for number in range(count)}
    sources = hash_sources("plant", "fdi", "studies/hidden_effects", "studies/detectable_sizes.py")
    return run_cases(jobs, partial(judge_size, folder=folder, sources=sources, claimed=sizes),
                     lambda job: {"case": job[0], "effect": job[1], "factor": job[2], "found": False}, sources,
                     folder / "sizes.jsonl", report_progress)


def judge_size(job: tuple[int, str, float], folder: Path, sources: str, claimed: Mapping[str, float]) -> Row:
    """Hide an effect at a multiple of its claimed size in a unit of its own, and explain the runs."""
    number, effect, factor = job
    target, size = folder / f"{number:04d}", claimed[effect]
    row: Row = {"case": number, "effect": effect, "factor": factor, "sources": sources,
                "claimed": size if math.isfinite(size) else None, "verdict": "NOT_CLAIMED", "found": None}
    if not math.isfinite(size):
        return row
    cases.write_case(hide_effect(sample_healthy_case(HIDDEN_SEED + number, effect), effect, factor * size), target)
    files = [target / f"{name}.csv.gz" for name in ("est", "holdout", "repeat")]
    answer = run_rig_explain(files[0], files[1], files[2:], COLUMNS)
    return row | {"verdict": answer["verdict"], "effects": answer["effects"],
                  "found": answer["verdict"] == "EXPLAINED" and answer["effects"] == [effect]}


def sample_healthy_case(seed: int, effect: str) -> cases.Case:
    """A healthy unit of a seed, with the known load that an effect needs."""
    load = hidden.CATALOGUE[effect].known_load
    return cases.sample_case(seed, kind="nothing", level="bench")._replace(signals="xj,p12,xs", load=load)


def hide_effect(case: cases.Case, effect: str, size: float) -> cases.Case:
    """The case with an effect whose first parameter is `size` off its off value."""
    plant, entry = nominal_symbols() | case.plant, CATALOGUE[effect]
    first = entry.fitted[0]
    value = entry.off.get(first, Model().kind.nominal.get(first, 0.0)) + size
    law = hidden.CATALOGUE[effect]
    simulator_size = SIZES[effect](value, plant) if effect in SIZES else value
    changes = law.apply(simulator_size, plant)
    changes |= {symbol: math.sqrt(low * high) for symbol, (low, high) in law.extra.items()}
    changes |= {symbol: values[-1] for symbol, values in law.choices.items()}
    return case._replace(kind="one", effects=(Hidden(effect, simulator_size, changes, value, law.known_load),))


def format_table(rows: Iterable[Row]) -> str:
    """A table in Markdown: claims and counts of each effect."""
    rows = list(rows)
    lines = ["| effect | claimed sizes | " + " | ".join(f"found at {factor:g} times" for factor in FACTORS) + " |",
             "|---|---|" + "---|" * len(FACTORS)]
    for effect in dict.fromkeys(row["effect"] for row in rows):
        effect_rows = [row for row in rows if row["effect"] == effect]
        sizes = sorted(row["claimed"] for row in effect_rows if row.get("claimed") is not None)
        unit = CATALOGUE[effect].parameters[CATALOGUE[effect].fitted[0]].unit
        claim = f"{sizes[0]:.3g} to {sizes[-1]:.3g} {unit}" if sizes else "none"
        counts = [_count_found(row for row in effect_rows if row["factor"] == factor) for factor in FACTORS]
        lines.append(f"| `{effect}` | {claim} | {' | '.join(counts)} |")
    return "\n".join(lines)


def _count_found(rows: Iterable[Mapping[str, Any]]) -> str:
    outcomes = [row["found"] for row in rows if row["found"] is not None]
    return f"{sum(outcomes)} of {len(outcomes)}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and print its table; see --help."""
    parser = argparse.ArgumentParser(prog="python -m studies.detectable_sizes",
                                     description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows and the runs")
    parser.add_argument("--cases", type=int, help="how many; default: each effect and size")
    parser.add_argument("--jobs", type=int, default=1, help="processes that make the claims (default 1)")
    parser.add_argument("--effects", default=",".join(EFFECTS), help="names, separated by commas; default: all")
    options = parser.parse_args(arguments)

    def show(progress: BatchProgress) -> None:
        row = progress.row
        print(f"{progress.done} of {progress.total}: {row['effect']} {row['factor']:g} {row['verdict']}", flush=True)

    effects = options.effects.split(",")
    claimed = claim_sizes(options.out, effects, Workers(options.jobs), report_claims)
    print(format_table(run_study(options.cases or 2 * len(effects), options.out, show, effects, claimed)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
