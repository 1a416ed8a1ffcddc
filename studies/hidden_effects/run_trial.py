"""The blind trial's cases through an explanation, on the resumable runner.

The folder holds results.jsonl, one row per finished case, and the cases' traces. A row counts only for the sources and
the choice of signals it was made with; the folder of the traces is named after that choice and a hash of the code that
makes them.
"""
from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fdi.sources import hash_sources, import_function
from plant.errors import InputError
from plant.plants import Plant, find_plant, load_plant
from rig.campaign.batch import Batch, BatchProgress, Row, RowFile, Workers, run_batch
from rig.network.clock import WallClock
from studies.hidden_effects import any_plant, cases, truth

Explain = Callable[..., dict[str, Any]]
"""From est, holdout, repeats and signals to the JSON of `rig explain`; of another plant than the EHA with `model`."""

RESULTS = "results.jsonl"
CASE_SOURCES = tuple(f"studies/hidden_effects/{name}" for name in ("truth.c", "truth.py", "command.py", "hidden.py",
                                                              "cases.py", "any_plant.py", "outside_ema.py"))


def run_trial(explain: str, seeds: Sequence[int], folder: Path, processes: int = 2,
              report_progress: Callable[[BatchProgress], None] = lambda _: None, signals: str | None = None,
              plant: str = "eha") -> list[Row]:
    """The rows of the cases of `seeds`, in their order; cases with a row in `folder` are not done again.

    Args:
        explain: names the explanation as "module:function", because other processes have to import it.
        seeds: of the cases.
        folder: for rows and traces.
        processes: cases at a time.
        report_progress: called after each finished case.
        signals: what is measured in every case, the first outputs of the plant; default: random, from the seed.
        plant: shipped, or a plant file; the cases of the EHA are made by the simulator in C.

    Raises:
        InputError: there is no such function, there are no such signals, no C compiler, or the folder cannot be made.
    """
    load_explain(explain)
    outputs = [s.name for s in name_plant(plant).signals.outputs]
    known = [",".join(outputs[:count]) for count in range(1, len(outputs) + 1)]
    if signals is not None and signals not in known:
        raise InputError("--signals", signals, " or ".join(known))
    if plant == "eha":
        truth.parameter_names()  # compile the simulator before several processes need it
    with RowFile(folder / RESULTS) as file:
        rows = run_batch(plan_batch(explain, seeds, folder, signals, plant), file, Workers(processes), report_progress)
    return list(rows.values())


def name_plant(name: str) -> Plant:
    """A shipped plant, or that of a file, which is loaded. Raises InputError."""
    return load_plant(Path(name)) if name.endswith(".py") else find_plant(name)


def plan_batch(explain: str, seeds: Sequence[int], folder: Path, signals: str | None, plant: str = "eha") -> Batch:
    """The cases of `seeds` as a batch; `signals` are those of every case, None if they are random."""
    sources = hash_trial_sources()

    def describe_failure(seed: int, reason: str) -> Row:
        hidden = read_truth(prepare_case(seed, folder, signals, plant))
        return make_row(explain, seed, signals, hidden, describe_crash(reason), 0.0)

    def is_valid(row: Row) -> bool:
        return bool(row["sources"] == sources and row["by"] == explain and row["signals"] == signals
                    and row["truth"].get("model", "eha") == plant)

    def is_failed(row: Row) -> bool:
        return bool(row["answer"]["verdict"] == "CRASHED")

    work = partial(explain_case, explain=explain, folder=folder, signals=signals, plant=plant)
    return Batch(jobs={seed: seed for seed in seeds}, work=work, key="seed", describe_failure=describe_failure,
                 is_valid=is_valid, is_failed=is_failed)


def explain_case(seed: int, explain: str, folder: Path, signals: str | None, plant: str = "eha") -> Row:
    """Explain one case: its truth, the shortened answer and the time it took. A crash is an answer as well."""
    case = prepare_case(seed, folder, signals, plant)
    hidden = read_truth(case)
    clock = WallClock()
    start = clock.now()
    more = {} if plant == "eha" else {"model": plant}
    try:
        answer = shorten_answer(load_explain(explain)(case / "est.csv.gz", case / "holdout.csv.gz",
                                                      [case / "repeat.csv.gz"], hidden["signals"].split(","), **more))
    except Exception as error:
        answer = describe_crash(f"{type(error).__name__}: {error}")
    return make_row(explain, seed, signals, hidden, answer, (clock.now() - start) * 1e-9)


def make_row(explain: str, seed: int, signals: str | None, hidden: Mapping[str, Any], answer: Mapping[str, Any],
             seconds: float) -> Row:
    """One line of results.jsonl; `signals` are those asked for in every case, `hidden` has those of this case."""
    return {"seed": seed, "by": explain, "sources": hash_trial_sources(), "signals": signals, "truth": hidden,
            "answer": answer, "seconds": seconds}


def describe_crash(reason: str) -> dict[str, Any]:
    """The answer of a case that gave none."""
    return {"verdict": "CRASHED", "effects": [], "error": reason}


def prepare_case(seed: int, folder: Path, signals: str | None, plant: str = "eha") -> Path:
    """The folder with the traces of a seed; they are made if they are missing. `signals`: None if they are random."""
    chosen = f"-{signals.replace(',', '-')}" if signals else ""
    chosen += "" if plant == "eha" else f"-{Path(plant).stem}-{hash_sources('plant')[:8]}"
    target = folder / f"cases-{hash_sources(*CASE_SOURCES)[:8]}{chosen}" / f"{seed:05d}"
    if not target.exists():
        part = target.with_name(target.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        if plant == "eha":
            cases.write_case(cases.sample_case(seed, signals=signals), part)
        else:
            name_plant(plant)
            case = any_plant.sample_case(plant, seed)
            any_plant.write_case(plant, case._replace(signals=signals or case.signals), part)
        part.rename(target)
    return target


def read_truth(case: Path) -> dict[str, Any]:
    """What is hidden in a case."""
    return tomllib.loads((case / "truth.toml").read_text(encoding="utf-8"))


def shorten_answer(answer: Mapping[str, Any], candidates: int = 5) -> dict[str, Any]:
    """The part of an answer that scoring needs: of the candidates the first ones and those it names."""
    short = {key: answer.get(key) for key in ("verdict", "effects", "baseline", "pattern", "blind_to")}
    named_effects = set(answer["effects"])
    short["candidates"] = [candidate for rank, candidate in enumerate(answer.get("candidates", []))
                           if rank < candidates or candidate["effect"] in named_effects]
    return short


def load_explain(name: str) -> Explain:
    """The explanation "module:function".

    Raises:
        InputError: there is no such function.
    """
    return import_function(name, "the blind trial", "an explanation")


def hash_trial_sources() -> str:
    """A hash of all code and data that an answer depends on."""
    return hash_sources("plant", "fdi", *CASE_SOURCES)


RIG_EXPLAIN = "studies.hidden_effects.run_trial:run_rig_explain"
"""The name of `run_rig_explain` for `studies.hidden_effects.run_trial`."""


def run_rig_explain(est: Path, holdout: Path, repeats: Sequence[Path], signals: Sequence[str], timeout: float = 600.0,
                    model: str = "eha") -> dict[str, Any]:
    """The JSON of `rig explain` for a case of a `model`; `timeout` in s.

    Raises:
        RuntimeError: the command ended with an error; the text is the last line of its standard error.
        subprocess.TimeoutExpired: the command took longer.
    """
    arguments = ["explain", est, "--holdout", holdout, "--signals", ",".join(signals), "--json",
                 "--model", model]
    for repeat in repeats:
        arguments += ["--repeat", repeat]
    command = [sys.executable, "-m", "rig.cli.main", *map(str, arguments)]
    wide = os.environ | {"COLUMNS": "500"}  # so that an error message stays on one line
    process = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, env=wide)
    if process.returncode not in (0, 1):
        raise RuntimeError((process.stderr.strip().splitlines() or ["no message"])[-1])
    answer: dict[str, Any] = json.loads(process.stdout)
    return answer
