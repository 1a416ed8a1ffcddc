"""Bands made: by simulating units of a model on a command, or from a fleet's own healthy traces."""
from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.bands import excursions
from fdi.diagnosis.envelope import (
    FIRST,
    HORIZON,
    Bands,
    RampBand,
    StepBand,
    Width,
    judged_rows,
    lasting_most,
    speed,
    waver,
)
from fdi.diagnosis.faults import CLOGGING, FRICTION
from fdi.diagnosis.features import features, slow
from fdi.diagnosis.simulated_units import STEPS, Kind, runs
from fdi.output import writable
from fdi.progress import Progress, ignore_progress
from fdi.sources import software
from fdi.thresholds import (
    BAND_FAULT_CLEARANCE_SD,
    BAND_UNITS,
    RAMP_FAULT_MISSED_SHARE,
    RAMP_HEALTHY_SHARE,
    STEP_FAULT_LEAVES_SD,
)
from fdi.trace.sections import Section, sections
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model, load_model

Floats = NDArray[np.float64]

SEED = 0
BETWEEN = (20.0, 50.0, 100.0, 140.0)  # N of friction, beside Table 2's, at which its effect on steps is known
EASY = 0.2  # FDS over FSS of units that slip easily
COARSE = 2  # cycles between the times at which shifts and spreads are known


def build(model: Model, com: Floats, load: Floats, period: float, count: int = BAND_UNITS, faulty: int = BAND_UNITS,
          seed: int = SEED, steps: int = STEPS, progress: Progress = ignore_progress, name: str = "") -> Bands:
    """Bands of a command (n,) m with a known load (n,) N, one row per `period` s, by simulating units of a model.

    Raises:
        InputError: a command without steps and ramps, a period that is not the model's, or no convergence of both.
    """
    parts = sections(com, period)
    if not any(s.kind in ("step", "ramp") for s in parts):
        raise InputError("trace", "com", "a command with steps or slow ramps: bands are drawn around those")
    if abs(period / model["controller.period"] - 1) > 0.01:
        raise InputError("trace", "t", f"one row per {1e3 * model['controller.period']:g} ms, the model's cycle, for "
                                       f"bands by simulation, not per {1e3 * period:g} ms")
    sound = float(model[FRICTION.parameter])
    amounts = [sound, *(size for size in sorted({*BETWEEN, FRICTION.middle, FRICTION.most}) if size > 1.2 * sound)]

    def units(kind: Kind, number: int = faulty) -> Floats:
        return runs(model, com, load, kind, number, seed, steps, progress)

    frictions = [units(Kind("healthy"), count), *(units(Kind(f"{size:g} N", friction=size)) for size in amounts[1:])]
    clogged = [units(Kind(f"Kintas {size:g}", clogging=size)) for size in (CLOGGING.middle, CLOGGING.most)]
    stepped = tuple(_step(i, s, period, frictions, clogged) for i, s in enumerate(parts) if s.kind == "step")
    easy = units(Kind("low dynamic friction", friction=FRICTION.middle, sliding=EASY))
    rubbing = [*frictions, easy]
    ramped = tuple(_ramp(i, s, com, period, rubbing, amounts) for i, s in enumerate(parts) if slow(s, period))
    tables = {"healthy": frictions[0][:faulty], CLOGGING.name: clogged[0],
              FRICTION.name: frictions[amounts.index(FRICTION.middle)]}
    facts = {"made": "by simulation", "command": name, "model": model.name, "runs": str(count), "faulty": str(faulty),
             "seed": str(seed), **_facts(parts, period)}
    bands = Bands(tuple(parts), period, np.array(amounts), stepped, ramped, 1.0, 1.0, facts,
                  _sensitivities(tables, frictions[0], com, period, parts))
    if np.abs(load).max() > 0.0:
        bands = replace(bands, provenance=facts | {"load": f"up to {np.abs(load).max():.4g} N"})
    shares = [_share(bands, com, x, most) for x, most in zip(clogged, (False, True), strict=True)]
    return replace(bands, middle_share=shares[0], most_share=shares[1])


def run(sources: Sequence[str | Path], out: str | Path, model: Model | None = None, com: Floats | None = None,
        name: str = "", seed: int = SEED, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Bands from the traces `sources`, or without any by simulation over the command `com` (n,) m; written to `out`.

    Returns what was made, for --json.

    Raises:
        InputError: traces that cannot be learned from, or a place that cannot be written.
    """
    from fdi.diagnosis.bands_file import save
    from fdi.diagnosis.fleet_bands import learn

    place = writable(out, "--out")
    if sources:
        traces = []
        for done, source in enumerate(sources):
            progress("reading", done / len(sources))
            traces.append(Trace.read(source))
        bands = learn(traces, model, [str(source) for source in sources], progress)
    elif com is None:
        raise InputError("--learn-bands", "", "traces, or a command to simulate")
    else:
        model = model or load_model()
        bands = build(model, com, np.zeros_like(com), model["controller.period"], seed=seed, progress=progress,
                      name=name)
    save(bands, place)
    clogging, friction = bands.judges
    return {"bands": str(out), "judges": [fault.name for fault, seen in ((CLOGGING, clogging), (FRICTION, friction))
                                          if seen], "provenance": dict(bands.provenance)}


def _step(number: int, s: Section, period: float, frictions: Sequence[Floats], clogged: Sequence[Floats]) -> StepBand:
    first, stop = round(FIRST / period), min(round(HORIZON / period) + 1, s.stop - s.start)
    fine = np.arange(first, stop)
    coarse = np.unique(np.r_[fine[::COARSE], fine[-1:]])

    def between(values: Floats) -> Floats:
        line: Floats = np.interp(fine, coarse, values[coarse - first])
        return line

    parts = [x[:, s.start + first:s.start + stop] for x in (*frictions, *clogged)]
    few = len(parts[-1])
    healthy, alike = parts[0].mean(axis=0), parts[0][:few].mean(axis=0)  # a fault's units are the first healthy ones
    shifts = [between(x.mean(axis=0) - alike) for x in parts[1:]]
    known = len(frictions)
    spread = np.array([between(x.std(axis=0, ddof=1)) for x in parts[:known]])
    shift = np.array([np.zeros(len(fine)), *shifts[:known - 1]])
    return StepBand(number, fine.astype(float) * period, healthy, shift, spread, shifts[-2], shifts[-1])


def _ramp(number: int, s: Section, com: Floats, period: float, frictions: Sequence[Floats], amounts: Sequence[float]
          ) -> RampBand:
    rows, way = judged_rows(s, period), np.sign(s.rate)
    errors = [way * (com[rows] - x[:, rows]) for x in frictions]
    speeds = [way * speed(x, period)[:, rows] - abs(s.rate) for x in frictions]
    lesser, greater = (list(amounts).index(size) for size in (FRICTION.middle, FRICTION.most))
    position, velocity = (_width(x[0], x[lesser], x[greater]) for x in (errors, speeds))
    half = np.array([np.median(waver(e)) for e in errors])
    slip, easier = (float(np.median(lasting_most(speeds[i]) / waver(errors[i]))) for i in (lesser, -1))
    lost = 1 - half[-1] / half[lesser]  # range ~ FSS (1 - ease slip), through both
    ease = lost / (easier - (1 - lost) * slip) if easier > slip and lost > 0.0 else 0.0
    return RampBand(number, position, velocity, np.maximum.accumulate(half[:-1]), slip, float(ease))


def _width(healthy: Floats, middle: Floats, most: Floats) -> Width:
    """Limits that all but RAMP_FAULT_MISSED_SHARE of the faulty units leave, from runs (units, rows).

    A limit that is not clear of the healthy units is infinite.
    """
    centre = float(np.nanmean(healthy))
    usual, lesser, greater = (lasting_most(np.abs(x - centre)) for x in (healthy, middle, most))
    clear = float(usual.mean() + BAND_FAULT_CLEARANCE_SD * usual.std(ddof=1))
    limits = [float(np.quantile(x, RAMP_FAULT_MISSED_SHARE)) for x in (lesser, greater)]
    wide = [limit if limit > clear else np.inf for limit in limits]
    return Width(centre, float(np.quantile(usual, RAMP_HEALTHY_SHARE)), wide[0], max(wide))


def _share(bands: Bands, com: Floats, units: Floats, most: bool) -> float:
    """How much of the faulty shift nearly every faulty unit (m, n) shows, for three samples in a row.

    By the mean and scatter of its logarithm: the lowest few of some hundred units are a rough guide to the lowest one.
    """
    reached = []
    for x in units:
        found, _, _ = excursions(com, x, bands.period, bands, list(bands.sections))
        own = [e for e in found if e.fault == CLOGGING.name and np.isfinite(e.departure).any()]
        furthest = [float(lasting_most(e.departure / (e.most if most else e.middle))) for e in own]
        reached.append(max(furthest, default=1.0))
    logs = np.log(reached)
    return float(np.exp(logs.mean() - STEP_FAULT_LEAVES_SD[most] * logs.std(ddof=1)))


def _sensitivities(tables: Mapping[str, Floats], healthy: Floats, com: Floats, period: float, parts: Sequence[Section]
                   ) -> dict[str, dict[str, float]]:
    """Mean and scatter of healthy units, and what a fault of Table 2's lesser size adds, by precursor."""
    found = {word: features(com, x, period, parts) for word, x in tables.items()}
    whole = features(com, healthy, period, parts)
    return {name: {"healthy": _mean(whole[name]), "noise": float(np.nanstd(whole[name], ddof=1)),
                   **{word: _mean(found[word][name]) - _mean(found["healthy"][name])
                      for word in (CLOGGING.name, FRICTION.name)}} for name in whole}


def _mean(values: Floats) -> float:
    """Of what was shown; NaN where most units do not show it."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if 2 * len(known) > len(values) else float("nan")


def _facts(parts: Sequence[Section], period: float) -> dict[str, str]:
    text = ";".join(f"{s.kind},{(s.stop - s.start) * period:.2f},{1e6 * s.first:.0f},{1e6 * s.last:.0f}" for s in parts)
    return {"command_hash": hashlib.sha256(text.encode()).hexdigest()[:16], "software": software()}
