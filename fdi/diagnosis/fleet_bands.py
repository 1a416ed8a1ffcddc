"""Bands learned from a fleet's own healthy traces: its mean response and its scatter, with the faults simulated."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.bands import columns, judge_columns, suited
from fdi.diagnosis.envelope import (
    Bands,
    RampBand,
    StepBand,
    Width,
    check_command,
    judged_rows,
    lasting_most,
    loaded,
    speed,
    waver,
)
from fdi.diagnosis.faults import Level
from fdi.diagnosis.features import features
from fdi.progress import Progress, ignore_progress
from fdi.thresholds import (
    BAND_FAULT_CLEARANCE_SD,
    BAND_NEAREST_LIMIT_SD,
    FLEET_FEWEST_TRACES,
    FLEET_PRIOR_TRACES,
    POSITION_MISSING_SHARE,
)
from fdi.trace.sections import sections
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model

Floats = NDArray[np.float64]

def learn(traces: Sequence[Trace], model: Model | None = None, names: Sequence[str] = (),
          progress: Progress = ignore_progress) -> Bands:
    """Bands from healthy traces of one command.

    The mean is the fleet's own. The scatter is the fleet's, too, joined with the simulated one as if that were of
    FLEET_PRIOR_TRACES traces more, and widened for the small number of traces (Student's t). What the faults add is
    simulated with `model`.

    Args:
        traces: at least FLEET_FEWEST_TRACES, without load.
        model: default the nominal one.
        names: of the traces, for refusals.
        progress: called with each stage and the share done, 0 to 1.

    Raises:
        InputError: too few traces, another command or period in one, a load, or a position with holes.
    """
    names = names or [f"trace {i + 1}" for i in range(len(traces))]
    if len(traces) < FLEET_FEWEST_TRACES:
        raise InputError("--learn-bands", f"{len(traces)} traces",
                         f"at least {FLEET_FEWEST_TRACES} healthy traces of one command")
    com, _, _, period, _ = columns(traces[0])
    base = suited(com, np.zeros_like(com), period, model, progress)
    rows = [_aligned(base, trace, name) for trace, name in zip(traces, names, strict=True)]
    fleet = _Fleet(np.array([x for _, x in rows]), np.mean([c for c, _ in rows], axis=0), base)
    found = replace(base, steps=tuple(fleet.step(s) for s in base.steps),
                    ramps=tuple(fleet.ramp(r) for r in base.ramps), precursors=fleet.precursors(),
                    provenance={**base.provenance, "made": f"from {len(traces)} healthy traces, faults simulated",
                                "traces": ", ".join(names)})
    doubtful = [name for (c, x), name in zip(rows, names, strict=True)
                if any(level > Level.ACCEPTABLE for level in judge_columns(c, x, period, base).levels.values())]
    if doubtful:
        words = "beyond MidBand of simulated healthy units: " + ", ".join(doubtful)
        found = replace(found, provenance={**found.provenance, "doubtful": words})
    return found


def _aligned(base: Bands, trace: Trace, name: str) -> tuple[Floats, Floats]:
    """Command and position of a trace on the rows of the base's command, without holes."""
    com, xj, load, period, _ = columns(trace)
    if loaded(load):
        raise InputError(name, "load", "none: bands are learned from an unloaded ram")
    missing = np.isnan(xj)
    if missing.mean() > POSITION_MISSING_SHARE:
        raise InputError(name, "xj", f"a whole position, not one with {100 * missing.mean():.0f} % missing")
    if abs(period / base.period - 1) > 0.01:
        raise InputError(name, "t", f"one row per {1e3 * base.period:g} ms as the others, not {1e3 * period:g} ms")
    parts = sections(com, period)
    check_command(base, parts, period, name)
    own, usual = (next(s.start for s in p if s.kind in ("step", "ramp")) for p in (parts, base.sections))
    n = base.sections[-1].stop
    at = np.clip(np.arange(n) + own - usual, 0, len(xj) - 1)
    rows = np.arange(len(xj))
    return com[at], np.interp(rows, rows[~missing], xj[~missing])[at]


class _Fleet:
    """Positions of a fleet, (m, n) m, and the simulated bands they correct."""

    def __init__(self, x: Floats, com: Floats, base: Bands) -> None:
        self.x, self.com, self.base, self.count = x, com, base, len(x)
        from scipy.stats import norm, t

        freedom = self.count - 1 + FLEET_PRIOR_TRACES
        unsure = float(t.isf(norm.sf(BAND_NEAREST_LIMIT_SD), freedom)) / BAND_NEAREST_LIMIT_SD
        self.wider = unsure * float(np.sqrt(1 + 1 / self.count))

    def scatter(self, values: Floats, simulated: Floats) -> Floats:
        """Standard deviation over the fleet, of (m, ..), shrunk to the simulated one and widened."""
        freedom = self.count - 1
        squares = FLEET_PRIOR_TRACES * simulated**2 + freedom * values.var(axis=0, ddof=1)
        out: Floats = self.wider * np.sqrt(squares / (FLEET_PRIOR_TRACES + freedom))
        return out

    def step(self, s: StepBand) -> StepBand:
        """The fleet's mean and scatter; friction and clogging add to them what they add to a simulated unit's."""
        start = self.base.sections[s.section].start
        rows = start + np.rint(s.t / self.base.period).astype(int)
        own = self.scatter(self.x[:, rows], s.spread[0])
        more = np.maximum(s.spread**2 - s.spread[0]**2, 0.0)
        return s._replace(healthy=self.x[:, rows].mean(axis=0), spread=np.sqrt(own**2 + more))

    def ramp(self, r: RampBand) -> RampBand:
        """The fleet's centres and healthy widths; a limit too near to them falls."""
        s = self.base.sections[r.section]
        rows, way = judged_rows(s, self.base.period), np.sign(s.rate)
        error = way * (self.com[rows] - self.x[:, rows])
        fast = way * speed(self.x, self.base.period)[:, rows] - abs(s.rate)
        half = np.maximum.accumulate(np.r_[np.median(waver(error)), r.waver[1:]])
        return r._replace(position=self.width(error, r.position), speed=self.width(fast, r.speed), waver=half)

    def width(self, values: Floats, simulated: Width) -> Width:
        """Of a signal (m, rows)."""
        centre = float(np.nanmean(values))
        usual = lasting_most(np.abs(values - centre))
        spread = self.scatter(usual, np.array((simulated.healthy - float(usual.mean())) / 3).clip(0.0))
        clear = float(usual.mean() + BAND_FAULT_CLEARANCE_SD * spread)
        middle = simulated.middle if simulated.middle > clear else np.inf
        return Width(centre, float(usual.mean() + 3 * spread), middle, max(middle, simulated.most))

    def precursors(self) -> dict[str, dict[str, float]]:
        """Mean and scatter of the fleet beside simulated sensitivities."""
        found = features(self.com, self.x, self.base.period, list(self.base.sections))
        out = {}
        for name, known in self.base.precursors.items():
            values = found[name][~np.isnan(found[name])]
            noise = self.scatter(values, np.array(known["noise"])) if len(values) > 1 else known["noise"]
            out[name] = {**known, "healthy": float(values.mean()) if len(values) else known["healthy"],
                         "noise": float(noise)}
        return out

