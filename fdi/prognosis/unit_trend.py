"""The trends of both faults of one unit."""
from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

from fdi.diagnosis.faults import FAULTS, Estimate, Level
from fdi.prognosis.dates import AXES
from fdi.prognosis.gather import Gathered, Point
from fdi.prognosis.trend import Trend, fit_trend
from plant.errors import InputError

LIMIT_NAMES = {"maintenance": "MidBand", "non_nominal": "MaxBand"}


@dataclass(frozen=True, eq=False)
class UnitTrend:
    """The trends of both faults through the traces of one unit."""

    gathered: Gathered
    trends: tuple[Trend, ...]

    @property
    def level(self) -> Level:
        """The worse of the two levels at the last trace."""
        return max(trend.level for trend in self.trends)

    @property
    def unit(self) -> str:
        """Unit of time on the axis: days, h or flights."""
        return AXES[self.gathered.axis]


def follow_unit(gathered: Gathered) -> UnitTrend:
    """Follow both faults through the traces."""
    t = [point.t for point in gathered.points]
    trends = (fit_trend(fault, t, [point.sizes[fault.name] for point in gathered.points]) for fault in FAULTS)
    return UnitTrend(gathered, tuple(trends))


def read_points(path: Path) -> Gathered:
    """Read the points of an earlier answer of `rig trend` from its JSON file.

    Raises:
        InputError: another kind of file.
    """
    try:
        answer = json.loads(path.read_text(encoding="utf-8"))
        points = tuple(Point(str(p["trace"]), float(p["t"]), {
            f.name: Estimate(*(float(p[f.symbol][name]) for name in Estimate._fields)) for f in FAULTS},
            str(p.get("note", ""))) for p in answer["points"])
        axis = str(answer["axis"])
        if not all(math.isfinite(p.t) and all(e.low <= e.value <= e.high for e in p.sizes.values()) for p in points):
            raise ValueError("finite times, and sizes within their intervals")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(path, "", f"an answer of rig trend ({type(error).__name__}: {error})") from error
    if axis not in AXES or not points:
        raise InputError(path, "axis", f"one of {', '.join(AXES)} and at least one point")
    return Gathered(str(path), axis, tuple(sorted(points, key=lambda p: p.t)), ())
