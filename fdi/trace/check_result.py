"""The result of a check: one type for the judge, the log and the report. And how checks filter a signal."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

PROTOCOL = "protocol"  # kind of the checks that every run makes of the controller's behaviour on the bus
MEDIAN_SPAN = 5e-3  # s
SPEED_SPAN = 20e-3  # s between the two samples of a speed: 2 um rms of position noise become 0.14 mm/s rms


def describe_field(text: str, unit: str = "", **keys: Any) -> Any:
    """A field of a record of the log, with what the log says of it."""
    return field(metadata={"unit": unit, "doc": text}, **keys)


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """One judged measurement."""

    value: float = describe_field("measured, in `unit`")
    low: float = describe_field("lower limit; NaN: none", default=math.nan)
    high: float = describe_field("upper limit; NaN: none", default=math.nan)
    passed: bool = describe_field("verdict")
    t0: float = describe_field("start of the window, from the start of the main phase; NaN: not a window", "s",
                               default=math.nan)
    t1: float = describe_field("end of the window", "s", default=math.nan)
    after: float = describe_field("when the time of a reaction begins, from the start of the main phase; NaN: none",
                                  "s", default=math.nan)
    above: float = describe_field("level that a signal has to pass, SI; NaN: none", default=math.nan)
    below: float = describe_field("level that a signal has to pass downwards, SI; NaN: none", default=math.nan)
    uncertainty: float = describe_field("expanded uncertainty (k = 2) of the value; NaN: not known", default=math.nan)
    cannot_tell: bool = describe_field("the decision rule leaves the verdict open", default=False)
    name: str = describe_field("as in the sequence")
    kind: str = describe_field("what was measured: overshoot, settling, never_exceeds, ...", default="")
    signal: str = describe_field("what was looked at")
    unit: str = describe_field("of value, low and high")
    detail: str = describe_field("why, in words", default="")
    requirement: str = describe_field("ids of the requirements that it verifies, with commas between them", default="")

    @property
    def verdict(self) -> str:
        """PASS, FAIL or CANNOT_TELL; what cannot be told has not passed either."""
        if self.cannot_tell:
            return "CANNOT_TELL"
        return "PASS" if self.passed else "FAIL"

    @property
    def is_protocol(self) -> bool:
        """Whether it is one of the protocol checks, which every run makes."""
        return self.kind == PROTOCOL

    @property
    def requirements(self) -> list[str]:
        """The ids of the requirements that it verifies."""
        return self.requirement.split(", ") if self.requirement else []

    @property
    def unit_behind(self) -> str:
        """The unit as it follows a number: " mm", "" for a number without one."""
        return "" if self.unit in ("", "1") else f" {self.unit}"

    @property
    def shown_value(self) -> str:
        """What was measured, without its unit.

        >>> CheckResult(value=7.44213, passed=True, name="", signal="", unit="%").shown_value
        '7.442'
        """
        return "not measurable" if math.isnan(self.value) else f"{self.value:.4g}"

    @property
    def measured(self) -> str:
        """What was measured, with its unit."""
        return self.shown_value if math.isnan(self.value) else self.shown_value + self.unit_behind

    @property
    def shown_limits(self) -> str:
        """The limits, without their unit.

        >>> [CheckResult(value=1.0, passed=True, name="", signal="", unit="1", low=low, high=high).shown_limits
        ...  for low, high in ((math.nan, 5.0), (1.0, 2.0), (1.0, math.nan))]
        ['<= 5', '1 .. 2', '>= 1']
        """
        if math.isnan(self.low):
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if math.isnan(self.high) else f"{self.low:g} .. {self.high:g}"

    @property
    def shown_uncertainty(self) -> str:
        """U with two digits; nothing for an unknown one."""
        return f"{self.uncertainty:.2g}" if self.uncertainty < math.inf else ""

    def describe(self) -> str:
        """Value, U and limits in words."""
        uncertain = f", U {self.shown_uncertainty}{self.unit_behind}" if self.shown_uncertainty else ""
        return f"measured {self.measured}{uncertain}, limits {self.shown_limits}{self.unit_behind}"

    def collect_data(self) -> dict[str, Any]:
        """All of it by name, for an answer in JSON."""
        return {**vars(self), "requirement": self.requirements, "verdict": self.verdict}


def filter_median(signal: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Centred moving median, (.., n), time last, of the samples in MEDIAN_SPAN, the ends repeated.

    For where one noisy sample could decide, such as a peak. At 1000 samples a second it keeps steps and ramps as they
    are, lowers a peak of angular frequency w by (w * 1 ms)^2 / 2 of its curve (0.7 % at 120 rad/s), and leaves 1.1 of
    2 um RMS of noise. From 200 samples a second down there is no room for a median: one sample decides.
    """
    half = int(MEDIAN_SPAN * rate / 2 + 1e-9)
    padded = np.pad(signal, [(0, 0)] * (signal.ndim - 1) + [(half, half)], mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=-1), axis=-1)


def compute_speed(position: NDArray[np.float64], rate: float, span: float = SPEED_SPAN) -> NDArray[np.float64]:
    """Central difference, (.., n), time last, of two samples or more over `span` s, one-sided at the ends, m/s.

    At least one cycle to each side. A spike of one sample becomes two of one sample each, so it does not last either.
    """
    rows, half = np.arange(position.shape[-1]), max(1, round(span * rate / 2))
    ahead, behind = np.minimum(rows + half, len(rows) - 1), np.maximum(rows - half, 0)
    return (position[..., ahead] - position[..., behind]) * (rate / (ahead - behind))
