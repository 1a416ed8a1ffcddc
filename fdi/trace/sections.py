"""What a command asks for, piece by piece: hold, step, ramp or dynamic (sine, chirp, noise), read from itself."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESOLUTION = 0.6e-7  # m; the bus carries 1e-7 m, so a ramp is a staircase of this half-height


class Section(NamedTuple):
    """Rows start..stop-1 of the command."""

    kind: str  # "hold", "step" (the jump and the rest after it), "ramp", "dynamic"
    start: int
    stop: int
    first: float  # demand before the section, in the command's unit
    last: float  # demand at its end
    rate: float  # a second, of a ramp; 0 otherwise


def describe_section(section: Section, furthest: float = 0.0, unit: str = "m") -> str:
    """A section in words; `furthest`, how far its demand goes, in the `unit` of the command.

    >>> describe_section(Section("step", 500, 1500, 0.0, 5e-3, 0.0))
    'step to 5 mm'
    """
    factor, display_unit = (1e3, "mm") if unit == "m" else (1.0, unit)
    match section.kind:
        case "ramp":
            return f"ramp at {factor * section.rate:.3g} {display_unit}/s"
        case "dynamic":
            return f"motion within {factor * furthest:.4g} {display_unit}"
    return f"{section.kind} {'to' if section.kind == 'step' else 'at'} {factor * section.last:.4g} {display_unit}"


def find_sections(command: Floats, period: float = 1e-3, scale: float = 1.0) -> list[Section]:
    """Cut a command, shape (n,), one row per `period` s, into sections that cover it without overlap.

    Straight lines are found greedily within the resolution of the bus; what is not straight for 0.15 s is dynamic.
    Missing rows (NaN) continue the last demand. `scale` is that of `Trace.scale`: 1 for a ram's command in m.
    """
    com = np.asarray(command, float) / scale
    com = np.nan_to_num(com[np.maximum.accumulate(np.where(np.isnan(com), 0, np.arange(len(com))))])
    shortest_time = 0.15  # s; a sine of 0.05 Hz and 1 mm leaves its tangent by RESOLUTION within this time
    shortest = max(3, round(shortest_time / period))
    out: list[Section] = []
    for start, stop, slope in _find_lines(com):
        before = com[start - 1] if start else com[0]
        if stop - start < shortest or _is_tangent(com, start, stop, slope, 3 * shortest):
            kind, rate = "dynamic", 0.0
        elif abs(slope) * (stop - start) <= 2 * RESOLUTION:
            kind, rate = ("step" if _is_jump(com, start) else "hold"), 0.0
        else:
            kind, rate = "ramp", slope / period
        if out and kind == out[-1].kind == "dynamic":
            out[-1] = out[-1]._replace(stop=stop, last=float(com[stop - 1]))
        else:
            out.append(Section(kind, start, stop, float(before), float(com[stop - 1]), rate))
    sections = _merge_short_parts(out, shortest)
    return [s._replace(first=s.first * scale, last=s.last * scale, rate=s.rate * scale) for s in sections]


def _find_lines(com: Floats) -> list[tuple[int, int, float]]:
    """(start, stop, slope per row): from each start the longest piece that a line through its first value fits."""
    values, out, start = com.tolist(), [], 0
    while start < len(values):
        origin, low, high, stop = values[start], -np.inf, np.inf, start + 1
        while stop < len(values):
            n, rise = stop - start, values[stop] - origin
            narrow_low, narrow_high = max(low, (rise - 2 * RESOLUTION) / n), min(high, (rise + 2 * RESOLUTION) / n)
            if narrow_low > narrow_high:
                break
            low, high, stop = narrow_low, narrow_high, stop + 1
        n = stop - start
        out.append((start, stop, (values[stop - 1] - origin) / (n - 1) if n > 1 else 0.0))
        start = stop
    return out


def _is_tangent(com: Floats, start: int, stop: int, slope: float, longest: int) -> bool:
    """True for a short line that only touches a slow curve: its slope bends on beyond one of its ends."""
    if stop - start > longest or abs(slope) * (stop - start) <= 2 * RESOLUTION:
        return False
    beyond = [com[b] - com[a] for a, b in ((start - 20, start), (stop - 1, stop + 19)) if a >= 0 and b < len(com)]
    return any(0 < abs(rise / (20 * slope) - 1) < 0.2 and abs(rise - 20 * slope) > RESOLUTION / 10 for rise in beyond)


def _is_jump(com: Floats, row: int) -> bool:
    """True when the demand jumps into `row` by much more than it moved in the rows before."""
    if row == 0:
        return False
    before = np.abs(np.diff(com[max(0, row - 4):row]))
    least_step = 2e-6  # m; least step
    return bool(abs(com[row] - com[row - 1]) > least_step + 3 * before.max(initial=0.0))


def _merge_short_parts(parts: list[Section], shortest: int) -> list[Section]:
    """Scraps between lines go to the neighbour before; a ramp that only bends is a slow curve: dynamic."""
    out: list[Section] = []
    for part in parts:
        is_scrap = part.kind == "dynamic" and part.stop - part.start < shortest // 10
        if (out and is_scrap and out[-1].kind != "hold") or (out and out[-1].kind == part.kind == "dynamic"):
            out[-1] = out[-1]._replace(stop=part.stop, last=part.last)
        elif out and part.kind == "ramp" and out[-1].kind == "ramp" and 0.5 < part.rate / out[-1].rate < 2:
            out[-1] = out[-1]._replace(kind="dynamic", stop=part.stop, last=part.last, rate=0.0)
        else:
            out.append(part)
    return out
