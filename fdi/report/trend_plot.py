"""The plot of a trend in characters, for a terminal."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fdi.prognosis.trend import Curve, Trend

WIDTH, HEIGHT = 72, 11  # characters


@dataclass
class _Canvas:
    """A grid of characters over time (from the left) and fault size (from the bottom)."""

    start: float
    until: float
    top: float
    cells: list[list[str]] = field(default_factory=lambda: [[" "] * WIDTH for _ in range(HEIGHT)])

    def column(self, t: float) -> int:
        """Column of a time."""
        return round((t - self.start) / (self.until - self.start) * (WIDTH - 1))

    def row(self, size: float) -> int:
        """Row of a size, within the canvas."""
        return HEIGHT - 1 - min(max(round(size / self.top * (HEIGHT - 1)), 0), HEIGHT - 1)

    def draw_column(self, x: int, low: float, high: float, character: str) -> None:
        """Fill one column between two sizes."""
        for y in range(self.row(high), self.row(low) + 1):
            self.cells[y][x] = character


def plot_trend(trend: Trend, format_date: Callable[[float], str], future_share: float = 0.35) -> list[str]:
    """Lines of text with the sizes (● and their intervals │), the course (·) and the forecast (░); [] for one date.

    Args:
        trend: of one fault.
        format_date: the text of a time that counts from the last trace.
        future_share: smallest share of the width that shows the future.
    """
    start, end = float(trend.t[0]), float(trend.t[-1])
    if end == start:
        return []
    canvas = _Canvas(start, _choose_end(trend, start, end, future_share),
                     1.15 * max(trend.fault.most, max(size.value for size in trend.sizes)))
    for limit in (trend.fault.middle, trend.fault.most):
        canvas.cells[canvas.row(limit)] = ["-"] * WIDTH
    if trend.past is not None:
        _draw_curve(canvas, trend.past)
    if trend.future is not None:
        _draw_curve(canvas, trend.future, shaded_from=canvas.column(end) + 1)
    for t, size, is_used in zip(trend.t, trend.sizes, trend.used, strict=True):
        x = canvas.column(float(t))
        canvas.draw_column(x, size.low, size.high, "│")
        canvas.cells[canvas.row(size.value)][x] = "●" if is_used else "○"
    return [*_label_rows(canvas, trend), _label_columns(canvas, end, format_date)]


def _choose_end(trend: Trend, start: float, end: float, future_share: float) -> float:
    until = end + future_share / (1.0 - future_share) * (end - start)
    if trend.future is None:
        return until
    return min(max(until, float(trend.future.t[-1])), end + 1.5 * (end - start))


def _draw_curve(canvas: _Canvas, curve: Curve, shaded_from: int = WIDTH) -> None:
    """The middle of a curve, and from one column on its interval."""
    columns = [canvas.column(float(t)) for t in curve.t]
    for x in range(max(columns[0], 0), min(columns[-1], WIDTH - 1) + 1):
        low, middle, high = (float(np.interp(x, columns, line)) for line in (curve.low, curve.middle, curve.high))
        if x >= shaded_from:
            canvas.draw_column(x, low, high, "░")
        canvas.cells[canvas.row(middle)][x] = "·"


def _label_rows(canvas: _Canvas, trend: Trend) -> list[str]:
    names = {canvas.row(trend.fault.middle): "MidBand", canvas.row(trend.fault.most): "MaxBand"}
    lines = []
    for y, cells in enumerate(canvas.cells):
        size = canvas.top * (HEIGHT - 1 - y) / (HEIGHT - 1)
        lines.append(f"{size:>6.3g} {''.join(cells)} {names.get(y, '')}".rstrip())
    return lines


def _label_columns(canvas: _Canvas, end: float, format_date: Callable[[float], str]) -> str:
    """Dates of the first trace, of the last one and of the end of the plot, each below its column."""
    first, last, final = (format_date(t - end) for t in (canvas.start, end, canvas.until))
    margin = 7  # characters of a row's label
    line = list(" " * margin + first.ljust(WIDTH - len(final)) + final)
    at = margin + min(max(canvas.column(end) - len(last) // 2, len(first) + 1), WIDTH - len(final) - len(last) - 1)
    line[at:at + len(last)] = last
    return "".join(line)
