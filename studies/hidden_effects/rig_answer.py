"""The answer of `rig explain` to a case of the blind trial."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from plant import Lanes, build_bare_model, find_plant
from studies.hidden_effects.cases import (
    NO_STOP,
    OUTPUTS,
    Array,
    describe_change,
    measure_floors,
    measure_law_error,
    read_columns,
)

VERDICTS = {"NOTHING_MISSING": "nothing", "NOT_RESOLVABLE": "ambiguous"}
"""Verdicts of `rig explain` that have another name in the benchmark than their own in small letters."""


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


def answer_case(case: Path, plant: str, signals: str) -> dict[str, Any]:
    """The answer, in the form of the benchmark. Raises as `run_rig_explain` does."""
    answer = run_rig_explain(case / "est.csv.gz", case / "holdout.csv.gz", [case / "repeat.csv.gz"], signals.split(","),
                             model=plant)
    candidates = {candidate["effect"]: candidate for candidate in reversed(answer["candidates"])
                  if candidate["effect"] in answer["effects"]}
    best: Mapping[str, Any] = next((candidates[name] for name in answer["effects"] if name in candidates), {})
    values = {key: x["value"] for name in (best.get("effect"), *best.get("with", ())) if name in candidates
              for key, x in candidates[name]["parameters"].items() if x["value"] is not None}
    sizes = {name: candidate["parameters"].get(find_plant(plant).find_effect(name).fitted[0], {})
             for name, candidate in candidates.items()}
    return {"verdict": VERDICTS.get(answer["verdict"], answer["verdict"].lower()), "effects": answer["effects"],
            "sizes": {name: {key: size.get(key) for key in ("value", "low", "high")} for name, size in sizes.items()},
            "where": locate_parameters(read_columns(case / "est.csv.gz"), values) if plant == "eha" else None,
            "holdout": best.get("holdout") or answer["baseline"]["holdout"]}


def locate_parameters(trace: Mapping[str, Array], values: Mapping[str, float]) -> list[str]:
    """The cells "signal/section" of a trace of the EHA in which parameters act, as `describe_change` finds them.

    The nominal model is replayed with the measured current, with and without these `values`, "group.field" to SI.
    """
    groups = {name.partition(".")[0] for name in values}
    model = build_bare_model("eha").with_effects(groups).replace({"jack.travel": NO_STOP})
    rows = np.array([[model[name] for name in values], list(values.values())])
    without, present = Lanes(model, list(values)).replay(rows, trace["cor"], trace["load"])
    changes = measure_floors(dict(zip(OUTPUTS, (present - without).T, strict=True)))
    changes = {signal: x for signal, x in changes.items() if signal in trace}
    if any(model.find_effect(group).firmware for group in groups & set(model.effects)):
        changes["cor"] = measure_law_error(trace["com"], trace["xj"], trace["cor"])
    return list(describe_change(changes, trace["com"])["where"])
