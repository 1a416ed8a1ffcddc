"""The shape of what is missing: a curve over the state it follows, in words, and as an effect file to go on from."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from fdi.discovery.search import Hypothesis, Search
from fdi.estimation import Problem
from fdi.output import write_text
from fdi.thresholds import PATTERN_EXPLAINED_SHARE, PATTERN_VISIBLE_RATIO
from fdi.trace import Flags, Floats, Trace
from plant import Model

KNOTS = 15  # of a curve
SPATIAL_TURNS = 3.0  # over the range of the position: a slower wave is a trend, for example a spring
PERIODS = np.geomspace(2.0, 60.0, 600)  # over the range of the position

WORDS = {"force": "a force on the ram, against extension", "flow": "a flow that leaves the jack",
         "current": "a current that does not reach the torque motor"}
# what a cause may depend on; the pressure answers a force, the speed a flow: they follow whatever is missing
CAUSES = {"force": ("position", "speed", "spool", "time"), "flow": ("pressure", "spool", "position", "time"),
          "current": ("current", "spool", "pressure", "position", "time")}
STATES = {"position": ("m", "s.jack_position"), "speed": ("m/s", "s.jack_speed"), "pressure": ("Pa", "s.pressure"),
          "spool": ("m", "s.spool_position"), "current": ("A", "u.drive"), "time": ("s", "u.t")}
PORTS = {"force": ("load", "x + {0}"), "flow": ("metering", "x - ({0}) / p.valve.flow_gain"),
         "current": ("current", "x - ({0})")}
PUMPED = ("current", "x - ({0}) / p.pump.displacement")  # a flow, where a pump delivers it


# Parameters of the equations that are balanced: of the ram, and of the valve or the pump that feeds it.
RAM = frozenset({"jack.area", "jack.damping", "jack.mass", "jack.dynamic_friction", "jack.leakage"})
FEEDS = (frozenset({"pump.displacement", "pump.area_ratio"}), frozenset({"valve.flow_gain", "pilot.flow_gain"}))
UNBALANCED = "the equations of this plant are not known as balances: what is left is not traced to a force or a flow"


def can_balance(model: Model) -> bool:
    """Whether the plant has the equations that are balanced here."""
    return any(RAM | feed <= model.values.keys() for feed in FEEDS)


class Pattern(NamedTuple):
    """What is missing, as a curve: `height` (k,) in `unit` at `at` (k,) of `state`, of a wave within one period."""

    place: str
    unit: str
    size: float  # RMS, noise taken out
    state: str  # "" where it follows none
    share: float  # of what is missing that the curve explains, 0..1
    at: Floats
    height: Floats
    doubt: Floats  # (k,) standard error of the height
    wave: tuple[float, float, float] | None  # amplitude, length in m or s, phase rad
    trace: Floats  # (n,) what is missing, over time
    port: tuple[str, str]  # where an effect puts it in, and how

    def __str__(self) -> str:
        """In words."""
        if not self.place:
            return "what is left is too small to be seen as a force, a flow or a current"
        text = f"{WORDS[self.place]}, {self.size:.4g} {self.unit} RMS"
        if self.wave:
            amplitude, length = self.wave[:2]
            return (f"{text}; {100.0 * self.share:.0f} % of it is periodic in {self.state}: "
                    f"{amplitude:.4g} {self.unit} every {1e3 * length:.4g} m{STATES[self.state][0]}")
        if not self.state:
            return f"{text}; it follows none of position, speed, pressure, spool, current or time alone"
        unit, first, last, height = STATES[self.state][0], self.at[0], self.at[-1], self.height
        middle = float(np.interp(0.5 * (first + last), self.at, height))
        return (f"{text}; {100.0 * self.share:.0f} % of it follows the {self.state}: "
                f"{height[0]:.4g} {self.unit} at {first:.3g} {unit}, {middle:.4g} in the middle, "
                f"{height[-1]:.4g} at {last:.3g} {unit}")


def find_pattern(search: Search, h: Hypothesis) -> Pattern:
    """The shape of what a hypothesis leaves unexplained."""
    (best, *_), states = compute_balances(search.problem, h, search.estimate_floor(h))
    is_pump_flow = best.place == "flow" and "pump.displacement" in search.problem.model.values
    port = PUMPED if is_pump_flow else PORTS[best.place]
    if best.ratio < PATTERN_VISIBLE_RATIO:
        none = np.empty(0)
        return Pattern("", "", 0.0, "", 0.0, none, none, none, None, best.missing, port)
    missing = best.missing[EDGE:-EDGE]
    causes = {name: x for name in CAUSES[best.place] if np.ptp(x := getattr(states, name)[EDGE:-EDGE]) > 0.0}
    curves = {name: fit_curve(missing, x, best.noise) for name, x in causes.items()}
    state, wave = max(curves, key=lambda n: curves[n][0]), None
    share, at, height, doubt = curves[state]
    waves = {name: fit_wave(missing, causes[name], best.noise) for name in ("position", "time")}
    wave_state = max(waves, key=lambda n: waves[n][1])
    if waves[wave_state][1] > max(share + 0.05, PATTERN_EXPLAINED_SHARE):
        state, (wave, share) = wave_state, waves[wave_state]
        _, at, height, doubt = fit_curve(missing, np.mod(causes[wave_state], wave[1]), best.noise)
    elif share < PATTERN_EXPLAINED_SHARE:
        state = ""
    return Pattern(best.place, best.unit, best.size, state, share, at, height, doubt, wave, best.missing, port)


def is_periodic_in_position(search: Search, base: Hypothesis, best: Hypothesis) -> bool:
    """Whether a force that repeats along the stroke explains more of what the base leaves than the effects of `best`.

    Teeth, magnets and a bent rod make such a force. A friction law that fits its mean at each speed helps a little, on
    every run, and is then named for it.
    """
    if not can_balance(search.problem.model):
        return False
    balances, states = compute_balances(search.problem, base, search.estimate_floor(base))
    force = next((b for b in balances if b.place == "force"), None)
    if force is None or force.ratio < PATTERN_VISIBLE_RATIO:
        return False
    best_balances, _ = compute_balances(search.problem, best, search.estimate_floor(best))
    residual_force = next(b for b in best_balances if b.place == "force")
    effect_share = 1.0 - (residual_force.size / force.size) ** 2 if force.size else 1.0
    inner = slice(EDGE, -EDGE)
    (_, length, _), share = fit_wave(force.missing[inner], states.position[inner], force.noise)
    turns = float(np.ptp(states.position[inner])) / length
    return turns >= SPATIAL_TURNS and share >= PATTERN_EXPLAINED_SHARE and share > effect_share


def fit_curve(y: Floats, x: Floats, noise: float) -> tuple[float, Floats, Floats, Floats]:
    """Means of y over bins of x: share explained, bin centres, means, their errors.

    Half of the edges share out the samples, half the range: most of a run is spent near rest.
    """
    even = np.linspace(float(x.min()), float(x.max()), KNOTS // 2 + 1)
    edges = np.unique(np.concatenate([np.quantile(x, np.linspace(0.0, 1.0, KNOTS // 2 + 2)), even]))
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(place, minlength=len(edges) - 1)
    fewest_in_bin = 20  # samples in a bin
    has_enough = count >= fewest_in_bin
    total = np.bincount(place, y, len(count))
    at = np.bincount(place, x, len(count))[has_enough] / count[has_enough]
    height = total[has_enough] / count[has_enough]
    spread = np.sqrt(np.maximum(np.bincount(place, y * y, len(count))[has_enough] / count[has_enough] - height**2, 0.0))
    is_binned = has_enough[place]
    residual = y[is_binned] - np.interp(x[is_binned], at, height)
    whole = float(np.mean(y[is_binned] ** 2)) - noise**2
    share = 1.0 - max(float(np.mean(residual**2)) - noise**2, 0.0) / max(whole, 1e-300)
    return max(share, 0.0), at, height, spread / np.sqrt(count[has_enough])


def fit_wave(y: Floats, x: Floats, noise: float) -> tuple[tuple[float, float, float], float]:
    """The best wave over x: (amplitude, length, phase), and the share of y it explains."""
    from scipy.signal import lombscargle  # here, as it takes a second to import

    y = np.clip(y, *np.percentile(y, [0.5, 99.5]))
    span = float(np.ptp(x)) or 1.0
    if (np.diff(x) > 0.0).all():  # time: evenly spaced, and many more periods than a stroke has
        power = np.abs(np.fft.rfft(y - y.mean(), 4 * len(y)))
        best = max(int(np.argmax(power)), 1) * span / (4 * float(np.median(np.diff(x))) * len(y))
    else:
        x, y = x[::2], y[::2]
        best = PERIODS[int(np.argmax(lombscargle(x, y - y.mean(), 2.0 * np.pi * PERIODS / span)))]
    for width in (0.02, 0.004, 0.001):
        near = best * (1.0 + np.linspace(-width, width, 21))
        best = near[int(np.argmax(lombscargle(x, y - y.mean(), 2.0 * np.pi * near / span)))]
    turn = 2.0 * np.pi * best / span
    basis = np.column_stack([np.sin(turn * x), np.cos(turn * x), np.ones_like(x)])
    wave = np.linalg.lstsq(basis, y, rcond=None)[0]
    excess = float(np.mean((y - basis @ wave) ** 2)) - noise**2
    share = 1.0 - max(excess, 0.0) / max(float(np.mean(y**2)) - noise**2, 1e-300)
    return (float(np.hypot(wave[0], wave[1])), span / best, float(np.arctan2(wave[1], wave[0]))), share


def write_effect(p: Pattern, path: str | Path, name: str = "discovered") -> None:
    """The pattern as an effect file to edit, fit and add: `rig explain --effects FILE` then ranks it with the others.

    Raises:
        InputError: a place that cannot be written.
    """
    port, law = p.port
    unit = p.unit or "N"
    if p.wave:
        over, variable = STATES[p.state]
        fields = [("amplitude", unit, "0.0", ""), ("length", over, f"{p.wave[1]:.6g}", ", above=0"),
                  ("phase", "rad", f"{p.wave[2]:.4g}", "")]
        what = f"p.{name}.amplitude * sin(2.0 * pi * {variable} / p.{name}.length + p.{name}.phase)"
        starts = f"({p.wave[0]:.6g}, {p.wave[1]:.6g}, {p.wave[2]:.4g}),"
        body: list[str] = []
    else:
        fields, starts = [("gain", "1", "0.0", "")], "0.5, 1.0,"
        q = STATES[p.state or "position"][1]
        body = [f"    q = {q}", f"    curve = {_format_interpolation(p)}"]
        what = f"p.{name}.gain * curve"
    lines = [f'"""Found in a measurement: {p}."""', "from math import pi, sin",
             "from typing import Annotated, NamedTuple", "from plant.effects import effect",
             "from plant.quantity import Quantity", "", "",
             f"class {name.title()}(NamedTuple):",
             *(f'    {f}: Annotated[float, Quantity("{u}"{more})] = {value}' for f, u, value, more in fields), "", "",
             f'@effect("{port}", {name.title()}, law="{WORDS[p.place or "force"]}", starts=({starts}))',
             f"def {name}(x, s, u, p):", *body, f"    return {law.format(what)}", ""]
    write_text(path, "\n".join(lines), "--write-effect")


def _format_interpolation(p: Pattern) -> str:
    """Straight lines between the knots, flat beyond, as sums of clipped ramps: a law without branches."""
    if len(p.at) < 2:
        return "0.0"
    slopes = np.diff(p.height) / np.diff(p.at)
    ramps = [f"{slope:+.6g} * (min(max(q, {a:.6g}), {b:.6g}) - {a:.6g})"
             for slope, a, b in zip(slopes, p.at[:-1], p.at[1:], strict=True)]
    return f"({p.height[0]:.6g}\n             " + "\n             ".join(ramps) + ")"


SPEED_WINDOW, ACCELERATION_WINDOW = 15, 31  # samples of the smoothing polynomials; a millisecond apart at 1 kHz
EDGE = 50  # samples at both ends that smoothing knows one side of only
CREEP = 2e-4  # m/s, below which a ram counts as at rest
UNITS = {"force": "N", "flow": "m3/s", "current": "A"}


class Balance(NamedTuple):
    """What is missing at one place: `missing` (n,) in `unit`, and how it compares with sensor noise alone."""

    place: str  # "force", "flow", "current"
    unit: str
    missing: Floats
    noise: float  # RMS that sensor noise alone gives
    ratio: float  # RMS of what is missing over that
    smooth: Flags  # (n,) rows in which no signal moves faster than smoothing can follow

    @property
    def size(self) -> float:
        """RMS of what is missing, the noise taken out."""
        return float(np.sqrt(max(float(np.nanmean(self.missing**2)) - self.noise**2, 0.0)))


class States(NamedTuple):
    """The signals a law may depend on, (n,) each, SI units."""

    position: Floats
    speed: Floats
    pressure: Floats
    spool: Floats
    current: Floats
    time: Floats
    spool_speed: Floats
    command: Floats
    direction: Floats  # of the ram: -1, 0 or 1, smooth across a stop
    way: Floats  # m that the ram has gone since its last reversal
    acceleration: Floats


def compute_balances(problem: Problem, h: Hypothesis, floor: Mapping[str, float]) -> tuple[list[Balance], States]:
    """The balances of ram, valve and torque motor under a hypothesis, the most unbalanced first.

    Each is taken on the measurement and on the model's own replay, smoothed alike; the difference is what is missing.
    Signals that were not measured are the replay's: then a place behind them cannot show anything. `floor`: noise of
    each signal, SI.
    """
    trace = problem.trace
    free, x = h.fit.free, h.fit.x
    values = {**problem.model.values, **h.fit.values}
    replay = problem.predict_signals([f.name for f in free], problem.convert_unknowns(free, x[None]))[0]
    measurement = replay.copy()
    columns = trace.output_columns
    measurement[columns] = np.where(np.isnan(trace.measurements), replay[columns], trace.measurements)
    before = np.concatenate([[0.0], trace.drive[:-1]])
    period = problem.model.values["controller.period"]
    compute = partial(_compute_terms, current=before, load=trace.load, p=values, period=period)
    replay_terms, measured_terms = compute(replay), compute(measurement)
    level = [floor.get(s, 0.0) for s in trace.output_names]
    rng = np.random.default_rng(0)
    draws = 4  # simulated runs without anything missing
    is_usable = find_smooth_rows(trace)
    noisy = [compute(replay + rng.standard_normal(replay.shape) * np.array(level)[:, None]) for _ in range(draws)]
    smooth = np.logical_and.reduce([find_followed_rows(x, noise) for x, noise in zip(measurement, level, strict=True)])
    balances = []
    for place in replay_terms:
        missing = (measured_terms[place] - replay_terms[place])[is_usable]
        noise = float(np.sqrt(np.mean([_mean_square((n[place] - replay_terms[place])[is_usable]) for n in noisy])))
        rms = float(np.sqrt(_mean_square(missing)))
        balances.append(Balance(place, UNITS[place], missing, noise, rms / noise if noise else 0.0, smooth[is_usable]))
    position, speed = _smooth(measurement[0], SPEED_WINDOW), _measure_speed(measurement[0], period)
    states = (position, speed, measurement[1], measurement[2], before, trace.t, _measure_speed(measurement[2], period),
              trace.command, np.clip(speed / CREEP, -1.0, 1.0), measure_way(position, speed),
              _smooth(measurement[0], ACCELERATION_WINDOW, deriv=2, delta=period))
    return sorted(balances, key=lambda b: -b.ratio), States(*(x[is_usable] for x in states))


def find_followed_rows(x: Floats, noise: float, share: float = 0.03) -> Flags:
    """Rows of a signal (n,) that the smoothing polynomials follow: to its noise, or to a share of its local swing."""
    window = ACCELERATION_WINDOW
    swing = maximum_filter1d(x, 3 * window) - minimum_filter1d(x, 3 * window)
    off = np.abs(x - _smooth(x, window)) > 6.0 * noise + share * swing
    return np.asarray(maximum_filter1d(off.astype(np.int8), window) == 0)


def measure_way(position: Floats, speed: Floats, least: float = 3e-4) -> Floats:
    """The distance since the last reversal, (n,) m; below the `least` speed, m/s, a ram keeps its direction."""
    moving = np.where(np.abs(speed) > least, np.sign(speed), 0.0)
    last = np.maximum.accumulate(np.where(moving != 0.0, np.arange(len(speed)), 0))
    side = moving[last]
    begin = np.maximum.accumulate(np.where(np.diff(side, prepend=side[:1]) != 0.0, np.arange(len(speed)), 0))
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position)))])
    return np.asarray(path - path[begin])


def find_smooth_rows(trace: Trace) -> Flags:
    """All rows; of an excerpt those that smoothing does not carry across a joint, and that are compared at all."""
    if not trace.parts:
        return np.ones(len(trace), bool)
    is_usable = trace.usable.copy()
    for part in trace.parts:
        is_usable[part.first:part.first + EDGE] = False
        is_usable[part.stop - EDGE:part.stop] = False
    return is_usable


def _mean_square(x: Floats) -> float:
    """Mean square of what counts: neither the ends nor the few samples in which something stops or breaks away."""
    inner = x[EDGE:-EDGE] ** 2
    return float(np.nanmean(np.minimum(inner, np.nanpercentile(inner, 99.5))))


def _measure_speed(x: Floats, period: float) -> Floats:
    return _smooth(x, SPEED_WINDOW, deriv=1, delta=period)


def _smooth(x: Floats, window: int, **derivative: float) -> Floats:
    """Cubics through the samples of a window, or their derivative (Savitzky and Golay)."""
    from scipy.signal import savgol_filter  # here, as it takes a second to import

    return np.asarray(savgol_filter(x, window, 3, **derivative))


def _compute_terms(signals: Floats, current: Floats, load: Floats, p: Mapping[str, float], period: float
                   ) -> dict[str, Floats]:
    """Left side minus right side of the equations of motion (of the reference model, or of a pump), from (3, n)."""
    x, p12, xs = signals
    v = _measure_speed(x, period)
    a = _smooth(x, ACCELERATION_WINDOW, deriv=2, delta=period)
    smooth = _smooth(p12, ACCELERATION_WINDOW)
    sliding = np.clip(v / CREEP, -1.0, 1.0) * p["jack.dynamic_friction"]
    force = p["jack.area"] * smooth - p["jack.damping"] * v - load - sliding - p["jack.mass"] * a
    if "pump.displacement" in p:
        area = p["jack.area"] * np.where(current < 0.0, p["pump.area_ratio"], 1.0)  # the current is the motor's speed
        return {"force": force,
                "flow": p["pump.displacement"] * current - area * v - p["jack.leakage"] * _smooth(p12, SPEED_WINDOW)}
    spool = _smooth(xs, SPEED_WINDOW)
    conductance = p["valve.flow_gain"] / p["valve.pressure_gain"] + p["jack.leakage"]
    flow = p["valve.flow_gain"] * spool - conductance * _smooth(p12, SPEED_WINDOW) - p["jack.area"] * v
    flapper = p["spool.end_area"] * _measure_speed(xs, period) / p["pilot.flow_gain"]
    torque = p["flapper.stiffness"] * flapper + p["feedback_spring.stiffness"] * spool
    return {"force": force, "flow": flow, "current": current - torque / p["torque_motor.gain"]}
