"""A plot of lines in the characters of a terminal: eight dots of a Braille character are eight pixels."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])  # row and column of a dot -> its bit


def draw_plot(lines: dict[str, NDArray[np.float64]], width: int, height: int, smallest_range: float) -> list[Text]:
    """Draw columns of values over their number as text, `height` lines of `width` characters.

    Args:
        lines: colour -> values (n,), the last value at the right edge; a later line covers an earlier one.
        width: characters, with 8 for the axis.
        height: lines.
        smallest_range: of the axis, so that noise does not fill the screen.
    """
    columns = max(width - 8, 1)
    known = [values[~np.isnan(values)] for values in lines.values()]
    known = [values for values in known if len(values)]
    low = min((float(values.min()) for values in known), default=0.0)
    high = max((float(values.max()) for values in known), default=0.0)
    margin = max(smallest_range - (high - low), 0.1 * (high - low)) / 2
    low, high = low - margin, high + margin
    bits = np.zeros((height, columns), int)
    colours = np.full((height, columns), "", dtype=object)
    for colour, values in lines.items():
        for row, column, bit in _list_dots(values, low, high, 2 * columns, 4 * height):
            bits[row, column] |= bit
            colours[row, column] = colour
    labels = {0: high, height // 2: (low + high) / 2, height - 1: low}
    drawn = []
    for row in range(height):
        text = Text(f"{labels[row]:7.2f} " if row in labels else " " * 8, style="dim")
        for column in range(columns):
            text.append(chr(0x2800 + bits[row, column]), style=colours[row, column] or None)
        drawn.append(text)
    return drawn


def _list_dots(values: NDArray[np.float64], low: float, high: float, across: int, down: int
               ) -> list[tuple[int, int, int]]:
    """(row, column, bit) of the dots of a line; each column of dots spans what the line passes there."""
    if not len(values):
        return []
    edges = np.linspace(0, len(values), across + 1).astype(int)
    found = []
    for x in range(across):
        part = values[max(edges[x] - 1, 0):max(edges[x + 1], edges[x] + 1)]  # with the one before: steps are joined
        part = part[~np.isnan(part)]
        if len(part):
            y0, y1 = ((high - edge) / (high - low) * (down - 1) for edge in (float(part.max()), float(part.min())))
            found += [(y // 4, x // 2, int(_DOTS[y % 4, x % 2])) for y in range(round(y0), round(y1) + 1)]
    return found
