"""What a measuring chain does to a signal: first-order lag, moving mean, delay, rounding; applied to a model's output.

A filtered measurement is compared with a filtered model. The filters are those of the recording's logger; a moving mean
of n samples is kept as its length in seconds, because the rows of a trace need not be the logger's.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, NamedTuple

import numpy as np

from fdi.thresholds import ROUNDED_SHARE
from fdi.trace.sections import Floats
from plant import Place, Quantity, build_dataclass, list_fitting_units, require_unit


@dataclass(frozen=True)
class SensorDynamics:
    """The measuring chain of one signal, in the order in which it acts."""

    lag: Annotated[float, Quantity("s", low=0)] = 0.0  # time constant
    moving_mean: Annotated[float, Quantity("1", low=1, high=1e6)] = 1.0  # samples of the logger
    sample_period: Annotated[float, Quantity("s", low=0)] = 0.0  # of the logger; 0: the trace's own period
    centred: bool = False  # the mean is over samples before and after, as made afterwards; else over the last ones
    delay: Annotated[float, Quantity("s", low=-1e3, high=1e3)] = 0.0  # what is left of a delay after whole rows
    quantum: Annotated[float, Quantity("1", low=0)] = 0.0  # step of the reading, SI

    @property
    def filters(self) -> bool:
        """Whether it changes more than the last digit."""
        return self.lag > 0.0 or self.moving_mean > 1.0 or self.delay != 0.0

    @property
    def is_ideal(self) -> bool:
        """Whether it changes nothing."""
        return not self.filters and self.quantum == 0.0

    def describe(self, period: float, unit: str = "") -> str:
        """In a few words, for a trace of this period and a signal in this SI unit."""
        kind = "centred mean" if self.centred else "moving mean"
        span = 1e3 * self.moving_mean * (self.sample_period or period)
        step = f"steps of {self.quantum:.4g} {unit}".rstrip()
        parts = ((self.lag > 0.0, f"lag {1e3 * self.lag:g} ms"),
                 (self.moving_mean > 1.0, f"{kind} of {self.moving_mean:g} samples ({span:g} ms)"),
                 (self.delay != 0.0, f"delay {1e3 * self.delay:.3g} ms"),
                 (self.quantum > 0.0, f"{step} (in its noise floor alone)"))
        return ", ".join(text for is_there, text in parts if is_there)

    def apply(self, x: Floats, period: float) -> Floats:
        """The sensor's output for the true signal `x`, (.., n), one sample a `period`; it rests before the first.

        It is not rounded: a model that is rounded like the measurement would differ from it by more. What rounding
        leaves belongs to the noise.
        """
        if self.lag > 0.0:
            x = filter_lag(x, self.lag, period)
        if self.moving_mean > 1.0 or self.delay != 0.0:
            x = _convolve(x, *self._make_kernel(period))
        return x

    def undo(self, y: Floats, period: float) -> Floats:
        """The true signal from the output `y`, (n,), as far as its slow part goes: lag inverted, mean moved back.

        The inverted lag raises the noise, so it serves where only the slow part counts.
        """
        if self.lag > 0.0:
            y = y + self.lag * np.gradient(y, period)
        late = 0.0 if self.centred else 0.5 * (self.moving_mean - 1.0) * (self.sample_period or period)
        return advance_signal(y, (late + self.delay) / period)

    def measure_noise(self, level: float) -> float:
        """RMS of the output's noise for white noise of `level` in the logger's samples, with that of rounding."""
        return math.hypot(level / math.sqrt(max(1.0, self.moving_mean)), self.quantum / math.sqrt(12.0))

    def count_independent(self, period: float) -> float:
        """Independent samples of the output's noise in one row: a mean over r rows leaves 1.5/r, at most 1."""
        return min(1.0, 1.5 * period / (self.moving_mean * (self.sample_period or period)))

    def _make_kernel(self, period: float) -> tuple[Floats, int]:
        """Weights of mean and delay on the rows, and the rows of the first one back from now (negative: ahead).

        The mean is over the logger's samples, which lie on straight lines between the rows.
        """
        step = (self.sample_period or period) / period
        back = step * np.arange(round(self.moving_mean)) + self.delay / period
        back = np.round(back - 0.5 * step * (len(back) - 1) if self.centred else back, 9)
        first = math.floor(back[0])
        place = np.floor(back).astype(int)
        part = back - place
        weights = np.zeros(int(place[-1]) - first + 2)
        np.add.at(weights, place - first, 1.0 - part)
        np.add.at(weights, place - first + 1, part)
        return weights / len(back), first


def filter_lag(x: Floats, time: float, period: float) -> Floats:
    """First-order lag of `x`, (.., n), exact for straight lines between samples; it rests before the first.

    >>> filter_lag(np.array([0.0, 1.0, 1.0]), 1e-3, 1e-3).round(3).tolist()
    [0.0, 0.368, 0.767]
    """
    from scipy.signal import lfilter

    a, r = math.exp(-period / time), time / period
    start = x[..., :1]
    y, _ = lfilter([1.0 - r * (1.0 - a), r * (1.0 - a) - a], [1.0, -a], x - start, zi=np.zeros_like(start))
    return np.asarray(y + start)


def advance_signal(x: Floats, rows: float) -> Floats:
    """`x`, (n,), so many rows earlier, on straight lines; the end values go on, and NaN stays beside a NaN.

    >>> advance_signal(np.arange(4.0), 1.5).tolist(), advance_signal(np.arange(1.0, 5.0), -0.5).tolist()
    ([1.5, 2.5, 3.0, 3.0], [1.0, 1.5, 2.5, 3.5])
    """
    k = np.arange(len(x))
    return np.asarray(np.interp(k + rows, k, x))


def _convolve(x: Floats, weights: Floats, first: int) -> Floats:
    """Sum of weights[i] x[k - first - i]; the end values go on before and after."""
    n = x.shape[-1]
    out = np.zeros_like(x)
    rows = np.arange(n)
    for i, weight in enumerate(weights.tolist()):
        if weight:
            out += weight * x[..., np.clip(rows - first - i, 0, n - 1)]
    return out


PREFIX = "sensor."  # of the names in a log's metadata


def write_sensors(sensors: Mapping[str, SensorDynamics]) -> dict[str, str]:
    """The dynamics as metadata of a log, as JSON."""
    return {PREFIX + name: json.dumps(asdict(sensor)) for name, sensor in sensors.items()}


def read_sensors(where: object, metadata: Mapping[str, str]) -> dict[str, SensorDynamics]:
    """The dynamics in the metadata of a log.

    Raises:
        InputError: text that is no dynamics.
    """
    sensors = {}
    for key, text in metadata.items():
        if key.startswith(PREFIX):
            place = Place(str(where), keys=f"metadata run.{key}")
            try:
                sensors[key.removeprefix(PREFIX)] = build_dataclass(SensorDynamics, json.loads(text), place)
            except (ValueError, RecursionError) as error:
                raise place.refuse(f"a sensor's dynamics as JSON, not {text!r}") from error
    return sensors


FEWEST_VALUES = 20  # distinct ones that show how finely a column was recorded


class Comb(NamedTuple):
    """All values of a column are multiples of one step."""

    step: float
    doubt: float  # of the step


def find_comb(x: Floats, finest: float = 0.0) -> Comb | None:
    """The comb of a column (n,), if it has one that is coarser than `finest`; NaN are left out."""
    levels = np.unique(x[~np.isnan(x)])
    if len(levels) < 8:
        return None
    gaps = np.diff(levels)
    rounding = 1e-12 * float(np.abs(levels).max())
    step = float(np.min(gaps[gaps > rounding], initial=np.inf))
    if not finest < step < np.inf:
        return None
    for _ in range(3):  # the smallest gap tells the step roughly, the whole range tells it exactly
        counts = np.rint((levels - levels[0]) / step)
        step = float((counts @ (levels - levels[0])) / max(counts @ counts, 1.0))
    off = np.abs(levels - levels[0] - step * np.rint((levels - levels[0]) / step))
    if off.max() > 0.02 * step:
        return None
    return Comb(step, 2.0 * float(off.max()) / max(float(np.ptp(counts)), 1.0) + 1e-6 * step)


def is_rounding_left(residual: Floats, step: float, resolution: float) -> bool:
    """Whether a residual (n,) is what rounding of an input to steps leaves: no more than half a step, and not less.

    Args:
        residual: of an answer that was computed from the rounded input; NaN are left out.
        step: of the input, in the unit of the answer.
        resolution: RMS of what else is rounded, in the same unit.
    """
    magnitudes = np.abs(residual[~np.isnan(residual)])
    if not magnitudes.size:
        return False
    is_inside = magnitudes <= 0.5 * step + 3.0 * resolution
    least = 0.3 * step / np.sqrt(12.0)  # an input that rests on one step leaves less than the usual 1
    return bool(is_inside.mean() >= ROUNDED_SHARE
                and np.sqrt(np.mean(magnitudes[is_inside] ** 2)) > max(least, 3.0 * resolution))


def measure_resolution(x: Floats, unit: str) -> float:
    """The RMS step between the values that a column can hold, from the digits they are written with, in `unit`.

    They may have been written in another unit of its quantity: 0.1968504 inch has seven digits, in m it has more.
    A few values show none, 0.0: a demand of 5 mm has one digit and may be exact.
    """
    values = np.unique(x[~np.isnan(x)])
    if len(values) < FEWEST_VALUES:
        return 0.0
    values = values[:: max(1, len(values) // 400)]  # a few hundred show as many digits as all
    factors = [float(require_unit(name, unit, "", "").factor) for name in list_fitting_units(unit)]
    return max(factor * _measure_digit(values / factor) for factor in factors)


def _measure_digit(values: Floats) -> float:
    """What the last digit of values (n,) is worth, RMS."""
    digits, places = 1, -30
    for value in values[values != 0.0].tolist():
        mantissa, _, exponent = f"{value:.11e}".partition("e")  # 12 digits: more is rounding of a float
        figures = mantissa.lstrip("-").replace(".", "").rstrip("0")
        digits, places = max(digits, len(figures)), max(places, len(figures) - 1 - int(exponent))
    size = np.floor(np.log10(np.maximum(np.abs(values), 1e-300)))
    steps = np.where(values == 0.0, 0.0, 10.0 ** (size - digits + 1))
    return float(np.sqrt(np.mean(np.maximum(steps, 10.0**-places) ** 2)))
