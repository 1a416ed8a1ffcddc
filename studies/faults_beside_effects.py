"""How right is `rig fdi --with-effects`? Valve faults are hidden beside each other effect of the catalogue.

The units are those of the trial's simulator, with scatter, coloured noise and hum. Each has one of the states of
`VALVES` and one other effect at a typical size, the middle of its logarithmic range:

    python -m studies.faults_beside_effects --out beside --most 40

The folder holds beside.jsonl, one row for each finished case; an interrupted study resumes there. Cases come in a
random order, so that the first ones are a fair sample of all.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.diagnosis.diagnosis import diagnose
from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Level, classify_size
from fdi.estimation import measure_share
from fdi.sources import hash_sources
from fdi.trace import Trace
from plant import count_threads, load_model
from rig.campaign.batch import BatchProgress, Row
from studies.command import run_cases
from studies.hidden_effects import cases, hidden
from studies.hidden_effects.hidden import Hidden
from studies.hidden_effects.truth import nominal_symbols

VALVES: tuple[Mapping[str, float], ...] = (
    {}, {CLOGGING.name: 0.25}, {CLOGGING.name: 0.35}, {FRICTION.name: 35.0}, {FRICTION.name: 70.0})
"""Faults of the valve, by effect: none, and each at MidBand and MaxBand."""
LATER = ("structural_resonance",)
"""Effects that are newer than the first count: their cases come last, so that the others keep their seeds."""
OTHERS = ("none", *(name for name in hidden.CATALOGUE if name not in (CLOGGING.name, FRICTION.name, *LATER)))
"""What is wrong beside them."""
FIRST_SEED = 8600
SIGNALS = ("xj", "p12", "xs")


class Job(NamedTuple):
    """One case of the study."""

    number: int
    seed: int
    valve: Mapping[str, float]
    other: str


def list_jobs(repeats: int = 1, first_seed: int = FIRST_SEED) -> list[Job]:
    """Every state of the valve beside every other effect, in a random order; each case uses the next seed."""
    first = [(valve, other) for _ in range(repeats) for valve in VALVES for other in OTHERS]
    later = [(valve, other) for _ in range(repeats) for valve in VALVES for other in LATER]
    order = np.random.default_rng(first_seed).permutation(len(first)).tolist()
    plan = [*(first[place] for place in order), *later]
    return [Job(number, first_seed + number, valve, other) for number, (valve, other) in enumerate(plan)]


def run_study(jobs: Sequence[Job], folder: Path, report_progress: Callable[[BatchProgress], None] = lambda _: None,
              signals: Sequence[str] = SIGNALS) -> list[Row]:
    """The rows of the jobs.

    Raises:
        InputError: no C compiler, or the folder cannot be made.
    """
    sources = hash_sources("plant", "fdi", "studies/hidden_effects", "studies/faults_beside_effects.py")
    return run_cases({job.number: job for job in jobs}, partial(judge_job, signals=signals, sources=sources),
                     lambda job: {"case": job.number}, sources, folder / "beside.jsonl", report_progress)


def make_case(job: Job) -> cases.Case:
    """The unit of a job: bench-level scatter and noise, the faults, the other effect at a typical size."""
    healthy = cases.sample_case(job.seed, kind="nothing", level="bench")
    symbols, effects = nominal_symbols() | healthy.plant, []
    for name, size in job.valve.items():
        changes = hidden.CATALOGUE[name].apply(size, symbols)
        effects.append(Hidden(name, size, changes, size, 0.0))
        symbols |= changes
    if job.other != "none":
        effects.append(hidden.sample_hidden_effect(job.other, symbols, np.random.default_rng([job.seed, 17]), 0.5, 0.5))
    load = max((effect.known_load for effect in effects), default=0.0)
    return healthy._replace(kind="two", effects=tuple(effects), load=load)


def record_case(job: Job, signals: Sequence[str] = SIGNALS) -> Trace:
    """The recording of a job's unit."""
    run = cases.measure_case(make_case(job), "est").trace
    columns = {name: getattr(run, name) for name in ("com", "cor", "load", "xj", *signals)}
    return Trace.from_columns(columns, 1e-3, {"source": f"case {job.number}"})


def judge_job(job: Job, signals: Sequence[str], sources: str) -> Row:
    """Record the unit and diagnose it with the search for other effects."""
    diagnosis = diagnose(record_case(job, signals), load_model(), workers=count_threads(), with_effects=True)
    assert diagnosis.beside is not None
    row: Row = {"case": job.number, "seed": job.seed, "valve": dict(job.valve), "other": job.other, "sources": sources,
                "verdict": diagnosis.verdict, "effects": list(diagnosis.beside.effects),
                "others": sorted(diagnosis.others),
                "explanations": [[list(e.effects), e.weight] for e in diagnosis.beside.explanations],
                "ratio": max(diagnosis.refinement.ratio.values())}
    for fault in FAULTS:
        size, level = diagnosis.sizes[fault.name], diagnosis.levels[fault.name]
        row[fault.key] = [size.value, size.low, size.high]
        row[f"level_{fault.key}"] = "cannot_tell" if level is None else level.word
    return row


class Score(NamedTuple):
    """What counts in one case."""

    is_right: bool  # the level of the fault that is there; without one, both levels
    is_healthy_blamed: bool  # a fault that is not there has a level beyond acceptable
    inside: tuple[bool, bool]  # whether the intervals of Kintas and FSS hold the true size


def score_row(row: Mapping[str, Any]) -> Score:
    """A row against the truth."""
    true_sizes = {f.name: row["valve"].get(f.name, f.healthy) for f in FAULTS}
    levels = {f.name: row[f"level_{f.key}"] for f in FAULTS}
    true_levels = {f.name: classify_size(f, true_sizes[f.name]).word for f in FAULTS}
    fault_names = list(row["valve"]) or [f.name for f in FAULTS]
    healthy = [f.name for f in FAULTS if f.name not in row["valve"]]
    blamed = any(levels[name] not in (Level.ACCEPTABLE.word, "cannot_tell") for name in healthy)
    inside = tuple(row[f.key][1] <= true_sizes[f.name] <= row[f.key][2] for f in FAULTS)
    return Score(all(levels[name] == true_levels[name] for name in fault_names), blamed, (inside[0], inside[1]))


def name_valve(valve: Mapping[str, float]) -> str:
    """The state of a valve, in words.

    >>> name_valve({}), name_valve({"spool_friction": 35.0})
    ('no fault', 'FSS 35 N')
    """
    words = {CLOGGING.name: "Kintas {:g}", FRICTION.name: "FSS {:g} N"}
    return ", ".join(words[name].format(size) for name, size in valve.items()) or "no fault"


def format_table(rows: Iterable[Row]) -> str:
    """Counts in Markdown: a line for each state of the valve, and one for all."""
    rows = [row for row in rows if row["verdict"] != "CRASHED"]
    lines = ["| valve | cases | level right | absent fault reported | SOMETHING_ELSE | Kintas inside | FSS inside |",
             "|---|---|---|---|---|---|---|"]
    groups = [(name_valve(valve), [row for row in rows if row["valve"] == dict(valve)]) for valve in VALVES]
    for name, own in [*groups, ("all", rows)]:
        scores = [score_row(row) for row in own]
        counts = [sum(s.is_right for s in scores), sum(s.is_healthy_blamed for s in scores),
                  sum(row["verdict"] == "SOMETHING_ELSE" for row in own), *(sum(s.inside[k] for s in scores)
                                                                           for k in (0, 1))]
        lines.append(f"| {name} | {len(own)} | " + " | ".join(f"{n} of {len(own)}" for n in counts) + " |")
    if rows:
        right = measure_share(sum(score_row(row).is_right for row in rows), len(rows))
        lines += ["", f"Level right: {100 * right.value:.0f} % ({100 * right.low:.0f} .. {100 * right.high:.0f})."]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and print its table; see --help."""
    parser = argparse.ArgumentParser(prog="python -m studies.faults_beside_effects",
                                     description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the rows")
    parser.add_argument("--most", type=int, default=None, help="only the first so many cases")
    parser.add_argument("--repeats", type=int, default=1, help="units of each kind")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first case")
    parser.add_argument("--signals", default=",".join(SIGNALS), help="what is measured (default: xj,p12,xs)")
    options = parser.parse_args(arguments)

    def show(progress: BatchProgress) -> None:
        row = progress.row
        print(f"{progress.done} of {progress.total}: {name_valve(row.get('valve', {}))}, {row.get('other')}: "
              f"{row['verdict']} {' '.join(row.get('effects', ()))}", flush=True)

    jobs = list_jobs(options.repeats, options.seed)[:options.most]
    print(format_table(run_study(jobs, options.out, show, options.signals.split(","))))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
