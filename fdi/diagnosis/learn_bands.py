"""Making bands: by simulating units of a model on a command, or from a fleet's own healthy traces."""
from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.diagnosis.bands import (
    KNOT_CYCLES,
    STEP_JUDGED_FROM,
    STEP_JUDGED_UNTIL,
    Bands,
    RampBand,
    StepBand,
    Width,
    compute_half_range,
    compute_speed,
    find_excursions,
    find_lasting_peak,
    format_design,
    is_loaded,
    is_nominal_plant,
    judge_position,
    load_default_bands,
    matches_command,
    read_columns,
    require_same_command,
    save_bands,
    select_ramp_rows,
)
from fdi.diagnosis.faults import CLOGGING, DYNAMIC, FRICTION, STATIC_OVER_DYNAMIC, Level
from fdi.diagnosis.precursors import compute_features, is_slow_ramp
from fdi.estimation.likelihood import limit_dynamic_friction
from fdi.estimation.unknowns import list_tolerance_sizes
from fdi.output import require_writable
from fdi.progress import Progress, ignore_progress
from fdi.sources import name_software
from fdi.thresholds import (
    BAND_FAULT_CLEARANCE_SD,
    BAND_NEAREST_LIMIT_SD,
    BAND_UNITS,
    BAND_UNITS_QUICK,
    FLEET_FEWEST_TRACES,
    FLEET_PRIOR_TRACES,
    POSITION_MISSING_SHARE,
    RAMP_FAULT_MISSED_SHARE,
    RAMP_HEALTHY_SHARE,
    STEP_FAULT_LEAVES_SD,
)
from fdi.trace.sections import Section, find_sections
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.lanes import NARROW, Lanes
from plant.model import Model, load_model
from plant.threads import count_threads

Floats = NDArray[np.float64]


def make_bands_file(sources: Sequence[str | Path], out: str | Path, model: Model | None = None,
                    com: Floats | None = None, name: str = "", seed: int = 0, progress: Progress = ignore_progress
                    ) -> dict[str, Any]:
    """Bands from the traces `sources`, or without any by simulation over the command `com` (n,) m; written to `out`.

    Returns what was made, for --json.

    Raises:
        InputError: traces that cannot be learned from, or a place that cannot be written.
    """
    place = require_writable(out, "--out")
    if sources:
        traces = []
        for done, source in enumerate(sources):
            progress("reading", done / len(sources))
            traces.append(Trace.read(source))
        bands = learn_bands(traces, model, [str(source) for source in sources], progress)
    elif com is None:
        raise InputError("--learn-bands", "", "traces, or a command to simulate")
    else:
        model = model or load_model()
        bands = make_bands_by_simulation(model, com, np.zeros_like(com), model["controller.period"], seed=seed,
                               progress=progress, name=name)
    save_bands(bands, place)
    judged = [fault.name for fault, is_shown in zip((CLOGGING, FRICTION), bands.judges, strict=True) if is_shown]
    return {"bands": str(out), "judges": judged, "provenance": dict(bands.provenance)}


# ---------------------------------------------------------------------------------------------------------------------
# By simulation
# ---------------------------------------------------------------------------------------------------------------------

def choose_bands(com: Floats, load: Floats, period: float, model: Model | None = None,
                 progress: Progress = ignore_progress) -> Bands:
    """The preflight's own bands if they are of this command, load and model; else bands made for them.

    That takes some seconds: units of the `model` (default: the nominal one) are simulated on this command.

    Args:
        com: demand, (n,) m, without holes.
        load: known load, (n,) N.
        period: of a row, s.
        model: of the healthy unit.
        progress: called with each stage and the share done, 0 to 1.
    """
    if (model is None or is_nominal_plant(model)) and not is_loaded(load):
        own = load_default_bands()
        if matches_command(own, com, period):
            return own
    return make_bands_by_simulation(model or load_model(), com, np.nan_to_num(load), period, *BAND_UNITS_QUICK,
                                    progress=progress)


def make_bands_by_simulation(model: Model, com: Floats, load: Floats, period: float, count: int = BAND_UNITS,
                             faulty: int = BAND_UNITS, seed: int = 0, steps: int = 20,
                             progress: Progress = ignore_progress, name: str = "",
                             frictions: Sequence[float] = (20.0, 50.0, 100.0, 140.0), low_sliding: float = 0.2
                             ) -> Bands:
    """Bands of a command (n,) m with a known load (n,) N, one row per `period` s, by simulating units of a model.

    Args:
        model: the design; its tolerances and sensor noise set the healthy scatter.
        com: command.
        load: known load.
        period: s.
        count: healthy units.
        faulty: units of each fault.
        seed: of the units.
        steps: of the solver in a cycle.
        progress: called with each stage and the share done, 0 to 1.
        name: of the command, for the file.
        frictions: FSS, N, beside Table 2's, at which the effect of friction on steps is found.
        low_sliding: FDS over FSS of units that slip easily.

    Raises:
        InputError: a command without steps and ramps, or a period that is not the model's.
    """
    parts = find_sections(com, period)
    if not any(s.kind in ("step", "ramp") for s in parts):
        raise InputError("trace", "com", "a command with steps or slow ramps: bands are drawn around those")
    if abs(period / model["controller.period"] - 1) > 0.01:
        raise InputError("trace", "t", f"one row per {1e3 * model['controller.period']:g} ms, the model's cycle, for "
                                       f"bands by simulation, not per {1e3 * period:g} ms")
    sound = float(model[FRICTION.parameter])
    amounts = [sound, *(size for size in sorted({*frictions, FRICTION.middle, FRICTION.most}) if size > 1.2 * sound)]

    def draw(kind: UnitKind, number: int = faulty) -> Floats:
        return simulate_units(model, com, load, kind, number, seed, steps, progress)

    healthy = draw(UnitKind("healthy"), count)
    rubbing = [healthy, *(draw(UnitKind(f"{size:g} N", friction=size)) for size in amounts[1:])]
    clogged = [draw(UnitKind(f"Kintas {size:g}", clogging=size)) for size in (CLOGGING.middle, CLOGGING.most)]
    easy = draw(UnitKind("low dynamic friction", friction=FRICTION.middle, sliding=low_sliding))
    stepped = tuple(_make_step_band(i, s, period, rubbing, clogged) for i, s in enumerate(parts) if s.kind == "step")
    ramped = tuple(_make_ramp_band(i, s, com, period, [*rubbing, easy], amounts)
                   for i, s in enumerate(parts) if is_slow_ramp(s, period))
    text = ";".join(f"{s.kind},{(s.stop - s.start) * period:.2f},{1e6 * s.first:.0f},{1e6 * s.last:.0f}" for s in parts)
    tables = {"healthy": healthy[:faulty], CLOGGING.name: clogged[0],
              FRICTION.name: rubbing[amounts.index(FRICTION.middle)]}
    facts = {"made": "by simulation", "command": name, "model": model.name, "parameters": format_design(model),
             "runs": str(count), "faulty": str(faulty), "seed": str(seed),
             "command_hash": hashlib.sha256(text.encode()).hexdigest()[:16], "software": name_software()}
    if np.abs(load).max() > 0.0:
        facts["load"] = f"up to {np.abs(load).max():.4g} N"
    bands = Bands(tuple(parts), period, np.array(amounts), stepped, ramped, 1.0, 1.0, facts,
                  _measure_sensitivities(tables, healthy, com, period, parts))
    middle_share, most_share = (_find_limit_share(bands, com, x, is_most)
                                for x, is_most in zip(clogged, (False, True), strict=True))
    return replace(bands, middle_share=middle_share, most_share=most_share)


def _make_step_band(number: int, s: Section, period: float, rubbing: Sequence[Floats], clogged: Sequence[Floats]
                    ) -> StepBand:
    """The band of a step from units with rising friction, the healthy ones first, and units with rising clogging.

    Shifts and spreads are taken at knots that are KNOT_CYCLES apart, with straight lines between them.
    """
    first, stop = round(STEP_JUDGED_FROM / period), min(round(STEP_JUDGED_UNTIL / period) + 1, s.stop - s.start)
    fine = np.arange(first, stop)
    knots = np.unique(np.r_[fine[::KNOT_CYCLES], fine[-1:]])

    def interpolate(values: Floats) -> Floats:
        line: Floats = np.interp(fine, knots, values[knots - first])
        return line

    parts = [x[:, s.start + first:s.start + stop] for x in (*rubbing, *clogged)]
    few = len(parts[-1])
    healthy, alike = parts[0].mean(axis=0), parts[0][:few].mean(axis=0)  # a fault's units are the first healthy ones
    shifts = [interpolate(x.mean(axis=0) - alike) for x in parts[1:]]
    known = len(rubbing)
    spread = np.array([interpolate(x.std(axis=0, ddof=1)) for x in parts[:known]])
    shift = np.array([np.zeros(len(fine)), *shifts[:known - 1]])
    return StepBand(number, fine.astype(float) * period, healthy, shift, spread, shifts[-2], shifts[-1])


def _measure_ramp(x: Floats, com: Floats, s: Section, period: float) -> tuple[Floats, Floats]:
    """Following error, m, and speed beyond the demand's, m/s, of runs `x` (m, n) on a ramp, in its direction."""
    rows, way = select_ramp_rows(s, period), np.sign(s.rate)
    return way * (com[rows] - x[:, rows]), way * compute_speed(x, period)[:, rows] - abs(s.rate)


def _make_ramp_band(number: int, s: Section, com: Floats, period: float, rubbing: Sequence[Floats],
                    amounts: Sequence[float]) -> RampBand:
    """The band of a ramp from units with rising friction; the last ones have Table 2's lesser FSS and a low FDS."""
    errors, speeds = zip(*(_measure_ramp(x, com, s, period) for x in rubbing), strict=True)
    lesser, greater = (list(amounts).index(size) for size in (FRICTION.middle, FRICTION.most))
    position, velocity = (_make_width(x[0], x[lesser], x[greater]) for x in (errors, speeds))
    half = np.array([np.median(compute_half_range(e)) for e in errors])
    slip, easier = (float(np.median(find_lasting_peak(speeds[i]) / compute_half_range(errors[i])))
                    for i in (lesser, -1))
    lost = 1 - half[-1] / half[lesser]  # range ~ FSS (1 - ease slip), through both
    ease = lost / (easier - (1 - lost) * slip) if easier > slip and lost > 0.0 else 0.0
    return RampBand(number, position, velocity, np.maximum.accumulate(half[:-1]), slip, float(ease))


def _make_width(healthy: Floats, middle: Floats, most: Floats) -> Width:
    """Limits that all but RAMP_FAULT_MISSED_SHARE of the faulty units leave, from runs (units, rows) each.

    A limit that is not clear of the healthy units is infinite.
    """
    centre = float(np.nanmean(healthy))
    usual, lesser, greater = (find_lasting_peak(np.abs(x - centre)) for x in (healthy, middle, most))
    clear = float(usual.mean() + BAND_FAULT_CLEARANCE_SD * usual.std(ddof=1))
    limits = [float(np.quantile(x, RAMP_FAULT_MISSED_SHARE)) for x in (lesser, greater)]
    wide = [limit if limit > clear else np.inf for limit in limits]
    return Width(centre, float(np.quantile(usual, RAMP_HEALTHY_SHARE)), wide[0], max(wide))


def _find_limit_share(bands: Bands, com: Floats, units: Floats, is_most: bool) -> float:
    """The share of the faulty shift that nearly every faulty unit (m, n) shows, for three samples in a row.

    From the mean and scatter of its logarithm: the lowest of some hundred units estimates the lowest of all poorly.
    """
    def find_furthest(x: Floats) -> float:
        found, _, _ = find_excursions(com, x, bands.period, bands, list(bands.sections))
        return max((float(find_lasting_peak(e.departure / (e.most if is_most else e.middle))) for e in found
                    if e.fault == CLOGGING.name and np.isfinite(e.departure).any()), default=1.0)

    logs = np.log([find_furthest(x) for x in units])
    return float(np.exp(logs.mean() - STEP_FAULT_LEAVES_SD[is_most] * logs.std(ddof=1)))


def _measure_sensitivities(tables: Mapping[str, Floats], healthy: Floats, com: Floats, period: float,
                           parts: Sequence[Section]) -> dict[str, dict[str, float]]:
    """Mean and scatter of healthy units, and what a fault of Table 2's lesser size adds, by precursor."""
    found = {word: compute_features(com, x, period, parts) for word, x in tables.items()}
    whole = compute_features(com, healthy, period, parts)
    return {name: {"healthy": _average_known(whole[name]), "noise": float(np.nanstd(whole[name], ddof=1)),
                   **{word: _average_known(found[word][name]) - _average_known(found["healthy"][name])
                      for word in (CLOGGING.name, FRICTION.name)}} for name in whole}


def _average_known(values: Floats) -> float:
    """Mean over the units that show a precursor; NaN where most units do not show it."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if 2 * len(known) > len(values) else float("nan")


# ---------------------------------------------------------------------------------------------------------------------
# From a fleet's own traces
# ---------------------------------------------------------------------------------------------------------------------

def learn_bands(traces: Sequence[Trace], model: Model | None = None, names: Sequence[str] = (),
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
    com, _, _, period, _ = read_columns(traces[0])
    base = choose_bands(com, np.zeros_like(com), period, model, progress)
    rows = [_align_trace(base, trace, name) for trace, name in zip(traces, names, strict=True)]
    fleet = _Fleet(np.array([x for _, x in rows]), np.mean([c for c, _ in rows], axis=0), base)
    found = replace(base, steps=tuple(fleet.correct_step(s) for s in base.steps),
                    ramps=tuple(fleet.correct_ramp(r) for r in base.ramps), precursors=fleet.correct_precursors(),
                    provenance={**base.provenance, "made": f"from {len(traces)} healthy traces, faults simulated",
                                "traces": ", ".join(names)})
    doubtful = [name for (c, x), name in zip(rows, names, strict=True)
                if any(level > Level.ACCEPTABLE for level in judge_position(c, x, period, base).levels.values())]
    if doubtful:
        words = "beyond MidBand of simulated healthy units: " + ", ".join(doubtful)
        return replace(found, provenance={**found.provenance, "doubtful": words})
    return found


def _align_trace(base: Bands, trace: Trace, name: str) -> tuple[Floats, Floats]:
    """Command and position of a trace on the rows of the base's command, gaps interpolated."""
    com, xj, load, period, _ = read_columns(trace)
    if is_loaded(load):
        raise InputError(name, "load", "none: bands are learned from an unloaded ram")
    missing = np.isnan(xj)
    if missing.mean() > POSITION_MISSING_SHARE:
        raise InputError(name, "xj", f"a whole position, not one with {100 * missing.mean():.0f} % missing")
    if abs(period / base.period - 1) > 0.01:
        raise InputError(name, "t", f"one row per {1e3 * base.period:g} ms as the others, not {1e3 * period:g} ms")
    parts = find_sections(com, period)
    require_same_command(base, parts, period, name)
    own, usual = (next(s.start for s in p if s.kind in ("step", "ramp")) for p in (parts, base.sections))
    n = base.sections[-1].stop
    at = np.clip(np.arange(n) + own - usual, 0, len(xj) - 1)
    rows = np.arange(len(xj))
    return com[at], np.interp(rows, rows[~missing], xj[~missing])[at]


class _Fleet:
    """Positions of a fleet, (m, n) m, and the simulated bands that they correct."""

    def __init__(self, x: Floats, com: Floats, base: Bands) -> None:
        self.x, self.com, self.base, self.freedom = x, com, base, len(x) - 1
        from scipy.stats import norm, t

        unsure = float(t.isf(norm.sf(BAND_NEAREST_LIMIT_SD), self.freedom + FLEET_PRIOR_TRACES)) / BAND_NEAREST_LIMIT_SD
        self.wider = unsure * float(np.sqrt(1 + 1 / len(x)))

    def join_scatter(self, values: Floats, simulated: Floats) -> Floats:
        """Standard deviation over the fleet, of (m, ..), shrunk to the simulated one and widened."""
        squares = FLEET_PRIOR_TRACES * simulated**2 + self.freedom * values.var(axis=0, ddof=1)
        out: Floats = self.wider * np.sqrt(squares / (FLEET_PRIOR_TRACES + self.freedom))
        return out

    def correct_step(self, s: StepBand) -> StepBand:
        """The fleet's mean and scatter; friction and clogging add to them what they add to a simulated unit's."""
        x = self.x[:, self.base.sections[s.section].start + np.rint(s.t / self.base.period).astype(int)]
        more = np.maximum(s.spread**2 - s.spread[0]**2, 0.0)
        return s._replace(healthy=x.mean(axis=0), spread=np.sqrt(self.join_scatter(x, s.spread[0])**2 + more))

    def correct_ramp(self, r: RampBand) -> RampBand:
        """The fleet's centres and healthy widths; a limit too near to them is dropped."""
        error, fast = _measure_ramp(self.x, self.com, self.base.sections[r.section], self.base.period)
        half = np.maximum.accumulate(np.r_[np.median(compute_half_range(error)), r.half_range[1:]])
        return r._replace(position=self.correct_width(error, r.position), speed=self.correct_width(fast, r.speed),
                          half_range=half)

    def correct_width(self, values: Floats, simulated: Width) -> Width:
        """Width of a signal (m, rows); `healthy` is three standard deviations above the fleet's mean."""
        centre = float(np.nanmean(values))
        usual = find_lasting_peak(np.abs(values - centre))
        spread = self.join_scatter(usual, np.array((simulated.healthy - float(usual.mean())) / 3).clip(0.0))
        clear = float(usual.mean() + BAND_FAULT_CLEARANCE_SD * spread)
        middle = simulated.middle if simulated.middle > clear else np.inf
        return Width(centre, float(usual.mean() + 3 * spread), middle, max(middle, simulated.most))

    def correct_precursors(self) -> dict[str, dict[str, float]]:
        """Mean and scatter of the fleet beside simulated sensitivities."""
        found = compute_features(self.com, self.x, self.base.period, list(self.base.sections))
        out = {}
        for name, known in self.base.precursors.items():
            values = found[name][~np.isnan(found[name])]
            noise = self.join_scatter(values, np.array(known["noise"])) if len(values) > 1 else known["noise"]
            out[name] = {**known, "healthy": float(values.mean()) if len(values) else known["healthy"],
                         "noise": float(noise)}
        return out


class UnitKind(NamedTuple):
    """Which units to draw; NaN leaves a size as the model has it."""

    name: str
    clogging: float = float("nan")  # Kintas
    friction: float = float("nan")  # FSS, N
    sliding: float = 1 / STATIC_OVER_DYNAMIC  # FDS over FSS


def simulate_units(model: Model, com: Floats, load: Floats, kind: UnitKind, count: int, seed: int, steps: int = 20,
                   progress: Progress = ignore_progress) -> Floats:
    """Sensed position, (count, n) m, of units over a command (n,) m with a known load (n,) N.

    The same seed gives the same units, whatever their faults. The solver takes `steps` a cycle; docs/statistics.md says
    what that leaves out. Every other block of units moved before its test and came to rest wherever friction left it;
    the others start at rest at null, as a model does.
    """
    tolerance = list_tolerance_sizes(model)
    names = list(dict.fromkeys([*tolerance, CLOGGING.parameter, FRICTION.parameter, DYNAMIC]))
    lanes = Lanes(model, names, steps, workers=1)
    moving, resting = (round(seconds / model["controller.period"]) for seconds in (0.5, 0.3))
    t = np.arange(moving) / moving
    lead_in = np.r_[1e-3 * np.sin(2 * np.pi * t) * t, np.zeros(resting)]  # m: what a unit did before its test
    out = np.empty((count, len(com)))

    def simulate_block(first: int) -> None:
        members = slice(first, min(first + NARROW, count))
        rng = np.random.default_rng([seed, first])
        before = com[0] + lead_in if com[0] != 0.0 or first // NARROW % 2 else com[:0]
        noise = sample_sensor_noise(rng, model, len(before) + len(com))
        units = _sample_parameters(rng, model, tolerance, names, kind)[:members.stop - first]
        asked, force = np.r_[before, com] - noise, np.r_[np.full(len(before), load[0]), load]
        out[members] = (lanes.closed_loop(units, asked, force)[..., 0] + noise)[:, len(before):]

    starts = range(0, count, NARROW)
    with ThreadPoolExecutor(count_threads()) as pool:
        for done, _ in enumerate(pool.map(simulate_block, starts)):
            progress(f"simulating units, {kind.name}", (done + 1) / len(starts))
    return out


def sample_sensor_noise(rng: np.random.Generator, model: Model, cycles: int, most_colour: float = 0.85,
                        most_hum: float = 0.55, hum_frequency: float = 50.0) -> Floats:
    """Noise of the position sensor, (cycles,) m: first order of a random colour, and mains hum of a random size.

    Args:
        rng: random numbers.
        model: its sensors.position_noise is the standard deviation without hum.
        cycles: of the controller.
        most_colour: largest correlation of the noise from one cycle to the next.
        most_hum: largest amplitude of the hum, in standard deviations of the noise.
        hum_frequency: Hz.
    """
    from scipy.signal import lfilter

    level, colour = model["sensors.position_noise"], rng.uniform(0.0, most_colour)
    white = rng.standard_normal(cycles)
    white[1:] *= np.sqrt(1.0 - colour**2)
    hum = rng.uniform(0.0, most_hum) * np.sin(2 * np.pi * (hum_frequency * model["controller.period"] *
                                                           np.arange(cycles) + rng.uniform()))
    coloured: Floats = level * (lfilter([1.0], [1.0, -colour], white) + hum)
    return coloured


def _sample_parameters(rng: np.random.Generator, model: Model, tolerance: Mapping[str, float], names: list[str],
                       kind: UnitKind) -> Floats:
    """Parameters of a block of units, (NARROW, len(names))."""
    table = np.tile([model[name] for name in names], (NARROW, 1))
    for name, size in tolerance.items():
        table[:, names.index(name)] += size * rng.standard_normal(NARROW)
    for name, value in ((CLOGGING.parameter, kind.clogging), (FRICTION.parameter, kind.friction),
                        (DYNAMIC, kind.friction * kind.sliding)):
        if np.isfinite(value):
            table[:, names.index(name)] = value
    return limit_dynamic_friction(names, table)
