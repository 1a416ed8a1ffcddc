"""Bands by simulating units of a model on a command, or from a fleet's own healthy traces."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from fdi.diagnosis.bands import (
    KNOT_CYCLES,
    BandFault,
    Bands,
    Friction,
    RampBand,
    StepBand,
    Width,
    describe_other_model,
    find_excursions,
    format_design,
    is_friction_fault,
    is_loaded,
    judge_position,
    load_default_bands,
    matches_command,
    require_same_command,
)
from fdi.diagnosis.faults import FAULTS, Fault, Level
from fdi.diagnosis.precursors import (
    STEP_JUDGED_FROM,
    STEP_JUDGED_UNTIL,
    compute_features,
    compute_half_range,
    find_lasting_peak,
    is_slow_ramp,
    measure_ramp,
    measure_step,
)
from fdi.estimation import limit_dynamic_friction, list_tolerance_sizes
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
from fdi.trace import Floats, Section, Trace, fill_gaps, find_sections, hold_last, measure_scale
from plant import WIDEST, Lanes, Model, count_nouns, count_threads, load_model, require

FRICTION_AMOUNTS = (2, 5, 10, 14)  # sevenths of MaxBand, beside both limits
LOW_DYNAMIC_SHARE = 0.3  # of the usual dynamic friction, of units that slip easily


# ---------------------------------------------------------------------------------------------------------------------
# By simulation
# ---------------------------------------------------------------------------------------------------------------------

def choose_bands(com: Floats, load: Floats, period: float, model: Model | None = None,
                 progress: Progress = ignore_progress, faults: Sequence[Fault] = FAULTS) -> Bands:
    """The preflight's own bands if they are of this command, load, model and faults; else bands made for them.

    That takes some seconds: units of the `model` (default: the nominal one) are simulated on this command.

    Args:
        com: demand, (n,), without holes.
        load: known load, (n,).
        period: of a row, s.
        model: of the healthy unit.
        progress: called with each stage and the share done, 0 to 1.
        faults: what the bands are to judge.
    """
    model, bands = model or load_model(), load_default_bands()
    if (not describe_other_model(bands, model) and not is_loaded(load, model.kind)
            and matches_command(bands, com, period) and len(faults) == len(bands.faults)
            and all(a.is_of(b) for a, b in zip(bands.faults, faults, strict=True))):
        return bands
    return make_bands_by_simulation(model, com, np.nan_to_num(load), period, *BAND_UNITS_QUICK, progress=progress,
                                    faults=faults)


def make_bands_by_simulation(model: Model, com: Floats, load: Floats, period: float, count: int = BAND_UNITS,
                             faulty: int = BAND_UNITS, seed: int = 0, steps: int = 20,
                             progress: Progress = ignore_progress, name: str = "", faults: Sequence[Fault] = FAULTS
                             ) -> Bands:
    """Bands of a command (n,) with a known load (n,), one row per `period` s, by simulating units of a model.

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
        faults: what the bands judge.

    Raises:
        InputError: no controller, a command without steps and ramps, a period that is not the model's, or a model that
            has a fault.
    """
    signals = model.kind.signals
    require(model.kind.control is not None and not signals.is_open_loop, "--learn-bands", model.kind.name,
            "a plant whose healthy and faulty units the rig simulates side by side, in closed loop: no FMU, and none "
            "without a demand")
    scale = measure_scale(signals.command, com)
    parts = find_sections(com, period, scale)
    require(any(s.kind in ("step", "ramp") for s in parts), "trace", signals.command.name,
            "a command with steps or slow ramps: bands are drawn around those")
    require(abs(period / model["controller.period"] - 1) <= 0.01, "trace", "t",
            f"one row per {1e3 * model['controller.period']:g} ms, the model's cycle, for bands by simulation, not per "
            f"{1e3 * period:g} ms")
    ready = model.with_effects(name.partition(".")[0] for fault in faults for name in fault.parameters)
    for f in faults:
        size, limit = ready[f.parameter], f.place_size(f.limits[1])
        require(f.measure_departure(size) < f.limits[1], "--learn-bands", f.parameter,
                f"a healthy size in the model, short of MidBand ({f.symbol} {limit:g}), not {size:g}")

    def draw(words: str, changes: Mapping[str, float], number: int = faulty) -> Floats:
        return simulate_units(ready, com, load, changes, number, seed, steps, progress, words)

    def draw_fault(fault: Fault, size: float, share: float = 1.0) -> Floats:
        changes = {key: value * (1.0 if key == fault.parameter else share)
                   for key, value in fault.list_changes(size).items()}
        return draw(f"{fault.symbol} {size:g}", changes)

    healthy = draw("healthy", {}, count)
    limits = {f.name: tuple(f.place_size(x) for x in f.limits[1:]) for f in faults}
    frictions = [f for f in faults if is_friction_fault(f)]
    other_faults = [f for f in faults if f not in frictions]
    amounts = {f.name: _list_amounts(f, float(model[f.parameter])) for f in frictions}
    friction_runs = {f.name: [healthy, *(draw_fault(f, size) for size in amounts[f.name][1:])] for f in frictions}
    fault_runs = {f.name: tuple(draw_fault(f, size) for size in limits[f.name]) for f in other_faults}
    step_bands = tuple(_make_step_band(i, s, period, healthy, friction_runs, fault_runs)
                       for i, s in enumerate(parts) if s.kind == "step")
    ramps = [(i, s) for i, s in enumerate(parts) if is_slow_ramp(s, period, scale)]
    ramp_bands = []
    for f in frictions:
        runs, at = friction_runs[f.name], [amounts[f.name].index(size) for size in limits[f.name]]
        easy = [draw_fault(f, limits[f.name][0], LOW_DYNAMIC_SHARE)] if f.follow else []
        ramp_bands += [_make_friction_ramp(i, s, com, period, f.name, runs, at, easy) for i, s in ramps]
    if not frictions:
        ramp_bands = [_make_ramp_band(i, s, com, period, f.name, (healthy, *fault_runs[f.name]))
                      for i, s in ramps for f in other_faults]
    tables = {f.name: fault_runs[f.name][0] if f in other_faults else
              friction_runs[f.name][amounts[f.name].index(limits[f.name][0])] for f in faults}
    text = ";".join(f"{s.kind},{(s.stop - s.start) * period:.2f},{1e6 * s.first:.0f},{1e6 * s.last:.0f}" for s in parts)
    facts = {"made": "by simulation", "command": name, "plant": model.kind.name, "model": model.name,
             "parameters": format_design(model, faults), "runs": str(count), "faulty": str(faulty), "seed": str(seed),
             "command_hash": hashlib.sha256(text.encode()).hexdigest()[:16], "software": name_software()}
    if np.abs(load).max() > 0.0:
        facts["load"] = f"up to {np.abs(load).max():.4g} {signals.load.unit if signals.load else ''}"
    band_faults = tuple(BandFault(**vars(f), amounts=np.array(amounts.get(f.name, ()))) for f in faults)
    bands = Bands(model.kind, tuple(parts), period, scale, band_faults, step_bands, tuple(ramp_bands), facts,
                  _measure_sensitivities(tables, healthy, com, period, parts, signals.controlled.unit, scale))
    shares = {f.name: [*_find_limit_shares(bands, com, f, fault_runs[f.name])]
              for f in band_faults if f.name in fault_runs}
    return replace(bands, faults=tuple(replace(f, middle_share=shares[f.name][0], most_share=shares[f.name][1])
                                       if f.name in shares else f for f in band_faults))


def _list_amounts(fault: Fault, sound: float) -> list[float]:
    """The amounts of a friction, the healthy one first."""
    beside = {fault.maintenance * part / 7 for part in FRICTION_AMOUNTS}
    return [sound, *sorted({fault.acceptable, fault.maintenance, *(size for size in beside if size > 1.2 * sound)})]


def _make_step_band(number: int, s: Section, period: float, sound: Floats,
                    friction_runs: Mapping[str, Sequence[Floats]], fault_runs: Mapping[str, Sequence[Floats]]
                    ) -> StepBand:
    """The band of a step from healthy units, by fault units with rising friction, and units at MidBand and MaxBand.

    Shifts and spreads are taken at knots that are KNOT_CYCLES apart, with straight lines between them.
    """
    settling = measure_step(sound[:, s.start:s.stop], s, period)["settling_time"]
    until = max(STEP_JUDGED_UNTIL, 2.0 * float(np.nan_to_num(np.nanmedian(settling))))
    first, stop = round(STEP_JUDGED_FROM / period), min(round(until / period) + 1, s.stop - s.start)
    fine = np.arange(first, stop)
    knots = np.unique(np.r_[fine[::KNOT_CYCLES], fine[-1:]])

    def interpolate(values: Floats) -> Floats:
        return np.asarray(np.interp(fine, knots, values[knots - first]))

    def cut(runs: Floats) -> Floats:
        return runs[:, s.start + first:s.start + stop]

    def shift(runs: Floats) -> Floats:  # a fault's units are the first healthy ones
        return interpolate(cut(runs).mean(axis=0) - cut(sound)[:len(runs)].mean(axis=0))

    def spread(runs: Floats) -> Floats:
        return interpolate(cut(runs).std(axis=0, ddof=1))

    none = np.zeros(len(fine))
    frictions = {name: Friction(np.array([none, *map(shift, runs[1:])]), np.array([spread(x) for x in runs]))
                 for name, runs in friction_runs.items()}
    middle, most = ({name: shift(runs[i]) for name, runs in fault_runs.items()} for i in (0, 1))
    return StepBand(number, fine.astype(float) * period, cut(sound).mean(axis=0), spread(sound), frictions, middle,
                    most)


def _make_ramp_band(number: int, s: Section, com: Floats, period: float, fault: str, runs: Sequence[Floats]
                    ) -> RampBand:
    """The band of a ramp from healthy units, and those with the fault at MidBand and at MaxBand."""
    errors, speeds = zip(*(measure_ramp(x, com, s, period) for x in runs), strict=True)
    return RampBand(number, fault, _make_width(*errors), _make_width(*speeds), np.empty(0))


def _make_friction_ramp(number: int, s: Section, com: Floats, period: float, fault: str, runs: Sequence[Floats],
                        at: Sequence[int], easy: Sequence[Floats]) -> RampBand:
    """The band of a ramp from units with rising friction, those `at` have that of MidBand and MaxBand; `easy` ones have
    the former and a low dynamic friction.
    """
    band = _make_ramp_band(number, s, com, period, fault, [runs[0], *(runs[i] for i in at)])
    errors, speeds = zip(*(measure_ramp(x, com, s, period) for x in (*runs, *easy)), strict=True)
    half = np.array([np.median(compute_half_range(e)) for e in errors])
    band = band._replace(half_range=np.maximum.accumulate(half[:len(runs)]))
    if not easy:
        return band
    slip, easier = (float(np.median(find_lasting_peak(speeds[i]) / compute_half_range(errors[i])))
                    for i in (at[0], -1))
    loss = 1 - half[-1] / half[at[0]]  # range ~ friction (1 - ease slip), through both
    ease = loss / (easier - (1 - loss) * slip) if easier > slip and loss > 0.0 else 0.0
    return band._replace(slip=slip, ease=float(ease))


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


def _find_limit_shares(bands: Bands, com: Floats, fault: BandFault, units: Sequence[Floats]) -> Iterator[float]:
    """The shares of the shifts at MidBand and MaxBand that nearly every unit (m, n) with that fault shows, for three
    samples in a row.

    From the mean and scatter of their logarithms: the lowest of some hundred units estimates the lowest of all poorly.
    """
    def find_furthest(x: Floats, limit: str) -> float:
        excursions, _, _ = find_excursions(com, x, bands.period, bands, list(bands.sections))
        return max((float(find_lasting_peak(e.departure / getattr(e, limit))) for e in excursions
                    if e.fault == fault.name and e.section.kind == "step" and np.isfinite(e.departure).any()),
                   default=1.0)

    for i, limit in enumerate(("middle", "most")):
        logs = np.log([max(find_furthest(x, limit), 1e-3) for x in units[i]])
        yield float(np.exp(logs.mean() - STEP_FAULT_LEAVES_SD[i] * logs.std(ddof=1)))


def _measure_sensitivities(tables: Mapping[str, Floats], healthy: Floats, com: Floats, period: float,
                           parts: Sequence[Section], unit: str, scale: float) -> dict[str, dict[str, float]]:
    """Mean and scatter of healthy units, and what each fault at MidBand adds, by precursor."""
    fault_features = {word: compute_features(com, x, period, parts, unit, scale) for word, x in tables.items()}
    healthy_features = compute_features(com, healthy, period, parts, unit, scale)
    return {name: {"healthy": _average_known(values),
                   "noise": float(np.nanstd(values, ddof=1)) if np.isfinite(values).sum() > 1 else float("nan"),
                   **{word: _average_known(x[name]) - _average_known(values[:len(x[name])])
                      for word, x in fault_features.items()}} for name, values in healthy_features.items()}


def _average_known(values: Floats) -> float:
    """Mean over the units that show a precursor; NaN where most units do not show it."""
    finite_values = values[~np.isnan(values)]
    return float(finite_values.mean()) if 2 * len(finite_values) > len(values) else float("nan")


# ---------------------------------------------------------------------------------------------------------------------
# From a fleet's own traces
# ---------------------------------------------------------------------------------------------------------------------

def learn_bands(traces: Sequence[Trace], model: Model | None = None, names: Sequence[str] = (),
                progress: Progress = ignore_progress, faults: Sequence[Fault] = FAULTS) -> Bands:
    """Bands from healthy traces of one command.

    The mean is the fleet's own. The scatter is the fleet's, too, joined with the simulated one as if that were of
    FLEET_PRIOR_TRACES traces more, and widened for the small number of traces (Student's t). What the faults add is
    simulated with `model`.

    Args:
        traces: at least FLEET_FEWEST_TRACES, without load.
        model: default the nominal one.
        names: of the traces, for refusals.
        progress: called with each stage and the share done, 0 to 1.
        faults: what the bands judge.

    Raises:
        InputError: too few traces, another command or period in one, a load, or a position with holes.
    """
    names = names or [f"trace {i + 1}" for i in range(len(traces))]
    require(len(traces) >= FLEET_FEWEST_TRACES, "--learn-bands", count_nouns(len(traces), "trace"),
            f"at least {FLEET_FEWEST_TRACES} healthy traces of one command")
    com, period = hold_last(traces[0].command), traces[0].period
    base = choose_bands(com, np.zeros_like(com), period, model, progress, faults)
    rows = [_align_trace(base, trace, name) for trace, name in zip(traces, names, strict=True)]
    fleet = _Fleet(np.array([x for _, x in rows]), np.mean([c for c, _ in rows], axis=0), base)
    bands = replace(base, steps=tuple(fleet.correct_step(s) for s in base.steps),
                    ramps=tuple(fleet.correct_ramp(r) for r in base.ramps), precursors=fleet.correct_precursors(),
                    provenance={**base.provenance, "made": f"from {len(traces)} healthy traces, faults simulated",
                                "traces": ", ".join(names)})
    doubtful_names = [name for (c, x), name in zip(rows, names, strict=True)
                      if any(level > Level.ACCEPTABLE for level in judge_position(c, x, period, base).levels.values())]
    if doubtful_names:
        return replace(bands, provenance={
            **bands.provenance, "doubtful": f"beyond MidBand of simulated healthy units: {', '.join(doubtful_names)}"})
    return bands


def _align_trace(base: Bands, trace: Trace, name: str) -> tuple[Floats, Floats]:
    """Command and position of a trace on the rows of the base's command, gaps interpolated."""
    com, xj, period = hold_last(trace.command), trace.mask_unusable(trace.declared.controlled.name), trace.period
    require(not is_loaded(trace.load, base.kind), name, "load", "none: bands are learned from an unloaded plant")
    missing = float(np.isnan(xj).mean())
    require(missing <= POSITION_MISSING_SHARE, name, base.kind.signals.controlled.name,
            f"a whole position, not one with {100 * missing:.0f} % missing")
    require(abs(period / base.period - 1) <= 0.01, name, "t",
            f"one row per {1e3 * base.period:g} ms as the others, not {1e3 * period:g} ms")
    parts = find_sections(com, period, base.scale)
    require_same_command(base, parts, period, name)
    start, base_start = (next(s.start for s in p if s.kind in ("step", "ramp")) for p in (parts, base.sections))
    at = np.clip(np.arange(base.sections[-1].stop) + start - base_start, 0, len(xj) - 1)
    return com[at], fill_gaps(xj)[at]


class _Fleet:
    """Positions of a fleet, (m, n), and the simulated bands that they correct."""

    def __init__(self, x: Floats, com: Floats, base: Bands) -> None:
        self.x, self.com, self.base, self.freedom = x, com, base, len(x) - 1
        from scipy.stats import norm, t

        unsure = float(t.isf(norm.sf(BAND_NEAREST_LIMIT_SD), self.freedom + FLEET_PRIOR_TRACES)) / BAND_NEAREST_LIMIT_SD
        self.wider = unsure * float(np.sqrt(1 + 1 / len(x)))

    def join_scatter(self, values: Floats, simulated_spread: Floats) -> Floats:
        """Standard deviation over the fleet, of (m, ..), shrunk to the simulated one and widened."""
        squares = FLEET_PRIOR_TRACES * simulated_spread**2 + self.freedom * values.var(axis=0, ddof=1)
        return np.asarray(self.wider * np.sqrt(squares / (FLEET_PRIOR_TRACES + self.freedom)))

    def correct_step(self, s: StepBand) -> StepBand:
        """The fleet's mean and scatter; frictions and faults add to them what they add to a simulated unit's."""
        x = self.x[:, self.base.sections[s.section].start + np.rint(s.t / self.base.period).astype(int)]
        spread = self.join_scatter(x, s.spread)
        frictions = {name: own._replace(spread=np.sqrt(spread**2 + np.maximum(own.spread**2 - s.spread**2, 0.0)))
                     for name, own in s.frictions.items()}
        return s._replace(healthy=x.mean(axis=0), spread=spread, frictions=frictions)

    def correct_ramp(self, r: RampBand) -> RampBand:
        """The fleet's centres and healthy widths; a limit too near to them is dropped."""
        error, fast = measure_ramp(self.x, self.com, self.base.sections[r.section], self.base.period)
        half = r.half_range
        if len(half):
            half = np.maximum.accumulate(np.r_[np.median(compute_half_range(error)), half[1:]])
        return r._replace(position=self.correct_width(error, r.position), speed=self.correct_width(fast, r.speed),
                          half_range=half)

    def correct_width(self, values: Floats, width: Width) -> Width:
        """Width of a signal (m, rows); `healthy` is three standard deviations above the fleet's mean."""
        centre = float(np.nanmean(values))
        usual = find_lasting_peak(np.abs(values - centre))
        spread = self.join_scatter(usual, np.array((width.healthy - float(usual.mean())) / 3).clip(0.0))
        clear = float(usual.mean() + BAND_FAULT_CLEARANCE_SD * spread)
        middle = width.middle if width.middle > clear else np.inf
        return Width(centre, float(usual.mean() + 3 * spread), middle, max(middle, width.most))

    def correct_precursors(self) -> dict[str, dict[str, float]]:
        """Mean and scatter of the fleet beside simulated sensitivities."""
        base = self.base
        features = compute_features(self.com, self.x, base.period, list(base.sections),
                                    base.kind.signals.controlled.unit, base.scale)
        out = {}
        for name, numbers in base.precursors.items():
            values = features[name][~np.isnan(features[name])]
            noise = self.join_scatter(values, np.array(numbers["noise"])) if len(values) > 1 else numbers["noise"]
            out[name] = {**numbers, "healthy": float(values.mean()) if len(values) else numbers["healthy"],
                         "noise": float(noise)}
        return out


# ---------------------------------------------------------------------------------------------------------------------
# Simulated units
# ---------------------------------------------------------------------------------------------------------------------

def simulate_units(model: Model, com: Floats, load: Floats, changes: Mapping[str, float], count: int, seed: int,
                   steps: int = 20, progress: Progress = ignore_progress, name: str = "") -> Floats:
    """Sensed position, (count, n), of units over a command (n,) with a known load (n,).

    All of them have the parameters `changes`, SI, in place of those of the model; `name` is what progress calls them.
    The same seed gives the same units, whatever their faults. The solver takes `steps` a cycle; docs/statistics.md says
    what that leaves out. Every other block of units moved before its test and came to rest wherever friction left it;
    the others start at rest at null, as a model does.
    """
    tolerance = list_tolerance_sizes(model)
    names = list(dict.fromkeys([*tolerance, *changes]))
    lanes = Lanes(model, names, steps, workers=1)
    moving, resting = (round(seconds / model["controller.period"]) for seconds in (0.5, 0.3))
    t = np.arange(moving) / moving
    slight = 1e-3 * measure_scale(model.kind.signals.command, com)
    lead_in = np.r_[slight * np.sin(2 * np.pi * t) * t, np.zeros(resting)]  # what a unit did before its test
    out = np.empty((count, len(com)))

    def simulate_block(first: int) -> None:
        members = slice(first, min(first + WIDEST, count))
        rng = np.random.default_rng([seed, first])
        before = com[0] + lead_in if com[0] != 0.0 or first // WIDEST % 2 else com[:0]
        noise = sample_sensor_noise(rng, model, len(before) + len(com))
        units = _sample_parameters(rng, model, tolerance, names, changes)[:members.stop - first]
        demand, force = np.r_[before, com] - noise, np.r_[np.full(len(before), load[0]), load]
        out[members] = (lanes.closed_loop(units, demand, force)[..., 0] + noise)[:, len(before):]

    starts = range(0, count, WIDEST)
    with ThreadPoolExecutor(count_threads()) as pool:
        for done, _ in enumerate(pool.map(simulate_block, starts)):
            progress(f"simulating units, {name}", (done + 1) / len(starts))
    return out


def sample_sensor_noise(rng: np.random.Generator, model: Model, cycles: int, most_colour: float = 0.85,
                        most_hum: float = 0.55, hum_frequency: float = 50.0) -> Floats:
    """Noise of the controlled signal, (cycles,): first order of a random colour, and mains hum of a random size.

    Args:
        rng: random numbers.
        model: its noise is the standard deviation without hum.
        cycles: of the controller.
        most_colour: largest correlation of the noise from one cycle to the next.
        most_hum: largest amplitude of the hum, in standard deviations of the noise.
        hum_frequency: Hz.
    """
    level, colour = model.values.get(model.kind.signals.controlled.noise, 0.0), rng.uniform(0.0, most_colour)
    noise = colour_noise(rng.standard_normal(cycles), colour)
    hum: Floats = rng.uniform(0.0, most_hum) * np.sin(2 * np.pi * (hum_frequency * model["controller.period"] *
                                                           np.arange(cycles) + rng.uniform()))
    return level * (noise + hum)


def colour_noise(white: Floats, colour: float) -> Floats:
    """First-order noise of the standard deviation of the white noise, (n,), that it is made from.

    `colour`: correlation from one sample to the next.
    """
    from scipy.signal import lfilter

    white[1:] *= np.sqrt(1.0 - colour**2)  # of the innovations
    return np.asarray(lfilter([1.0], [1.0, -colour], white))


def _sample_parameters(rng: np.random.Generator, model: Model, tolerance: Mapping[str, float], names: list[str],
                       changes: Mapping[str, float]) -> Floats:
    """Parameters of a block of units, (WIDEST, len(names))."""
    table = np.tile([model[name] for name in names], (WIDEST, 1))
    for name, size in tolerance.items():
        table[:, names.index(name)] += size * rng.standard_normal(WIDEST)
    for name, value in changes.items():
        table[:, names.index(name)] = value
    return limit_dynamic_friction(names, table)
