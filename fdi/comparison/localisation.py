"""Where the error is: how much of it in each section of the command, and under which condition, in words."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.estimation.replay import Columns, differentiate
from fdi.thresholds import CONDITION_DENSITY, CONDITION_EXCESS_LEAST, CONDITION_SHARE
from fdi.trace.columns import hold_last
from fdi.trace.sections import describe_section, find_sections
from fdi.trace.trace import Trace

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

SMOOTH = 0.021  # s of measured position that a speed is taken from
REVERSES = 5e-4  # m/s in the other direction make a reversal; a ram at rest trembles by less
SPEEDS = (0.001, 0.003, 0.01, 0.02, 0.05, 0.1)  # m/s
RATES = (0.3, 1.0, 3.0)  # m/s2
PLACES = (0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3)  # m
PRESSURES = (5e5, 1e6, 2e6, 5e6, 1e7)  # Pa
OPENINGS = (5e-6, 20e-6, 50e-6, 2e-4)  # m
DELAYS = (0.005, 0.02, 0.05, 0.1)  # s after a reversal
SETTLES = 0.05  # s; a section's share of samples below which it is not judged by itself


class Place(NamedTuple):
    """One section's part of the error."""

    section: str
    t0: float  # s
    t1: float
    share: float  # of the squared error of all signals, each over its floor
    ratio: float  # RMS over floor within the section
    condition: str  # where in it the error is, "" if it is everywhere


class Motion(NamedTuple):
    """What the ram does, (n,) each."""

    x: Floats  # m
    v: Floats  # m/s
    a: Floats  # m/s2
    p12: Floats  # Pa
    xs: Floats  # m
    cor: Floats  # A
    reversed_for: Floats  # s since the ram last reversed; inf before


def describe_motion(trace: Trace, model: Columns) -> Motion:
    """What the replay of the `model` does, whose noise is not in the residuals, and how long ago it last reversed."""
    x = model["xj"]
    size = max(5, round(SMOOTH / trace.period) | 1)
    v = differentiate(x, size, 1) / trace.period
    a = differentiate(x, 2 * size + 1, 2) / trace.period**2
    sign = np.where(np.abs(v) > REVERSES, np.sign(v), np.nan)
    sign = hold_last(sign)
    turns = np.flatnonzero((np.diff(sign) != 0.0) & (sign[:-1] != 0.0)) + 1
    last = np.full(len(x), -(10**9))
    last[turns] = turns
    rows = np.arange(len(x)) - np.maximum.accumulate(last)
    since = np.where(rows > 10**8, math.inf, rows * trace.period)
    return Motion(x, v, a, model["p12"], model["xs"], trace.cor, since)


def combine_residuals(residual: Columns, floor: Mapping[str, float]) -> Floats:
    """Squared error over squared floor, mean of the signals, (n,); 1 on average where only noise is left."""
    parts = [(residual[name] / floor[name]) ** 2 for name in residual if floor.get(name, 0.0) > 0.0]
    with np.errstate(invalid="ignore"):
        stack = np.array(parts)
        there = ~np.isnan(stack)
        total = np.where(there, stack, 0.0).sum(axis=0)
        out: Floats = np.where(there.any(axis=0), total / np.maximum(there.sum(axis=0), 1), np.nan)
    return out


def locate_error(trace: Trace, z2: Floats, m: Motion, limit: float) -> list[Place]:
    """The sections of the command with their shares of `z2` (n,), the largest first; `limit` A of the current."""
    total = float(np.nansum(z2))
    out = []
    for section in find_sections(trace.com, trace.period):
        rows = slice(section.start, section.stop)
        inside = z2[rows]
        there = ~np.isnan(inside)
        if total <= 0.0 or there.sum() * trace.period < SETTLES:
            continue
        chosen = np.zeros(len(z2), bool)
        chosen[rows] = True
        share = float(np.nansum(inside)) / total
        said = find_condition(np.where(chosen, z2, np.nan), m, limit) if share > 0.03 else ""
        words = describe_section(section, float(np.abs(trace.com[rows]).max()))
        t0, t1 = float(trace.t[section.start]), float(trace.t[section.stop - 1] + trace.period)
        out.append(Place(words, t0, t1, share, math.sqrt(float(np.nanmean(inside))), said))
    return sorted(out, key=lambda place: -place.share)


def find_condition(z2: Floats, m: Motion, limit: float) -> str:
    """The condition under which the excess of `z2` (n,) over 1 is gathered, in words; "" if under none."""
    there = ~np.isnan(z2)
    excess = np.where(there, z2 - 1.0, 0.0)
    total, rows = float(excess.sum()), int(there.sum())
    if rows == 0 or total < CONDITION_EXCESS_LEAST * rows:
        return ""
    best, said = 0.0, ""
    for words, flags in _list_conditions(m, limit):
        time = float((flags & there).sum()) / rows
        part = float(excess[flags].sum()) / total
        # the gain over spreading it evenly; a condition that holds nearly always or hardly ever gains little
        score = part - time
        if part >= CONDITION_SHARE and time > 0.0 and part / time >= CONDITION_DENSITY and score > best + 0.01:
            best, said = score, f"{100 * min(part, 1.0):.0f} % of it in {100 * time:.2g} % of the time: {words}"
    return said


def _list_conditions(m: Motion, limit: float) -> Sequence[tuple[str, Flags]]:
    speed, far, hard = np.abs(m.v), np.abs(m.x), np.abs(m.a)
    out = [(f"ram faster than {_format_speed(s)}", speed > s) for s in SPEEDS]
    out += [(f"ram slower than {_format_speed(s)}", speed < s) for s in SPEEDS[:4]]
    out += [(f"ram further than {1e3 * x:g} mm from the middle", far > x) for x in PLACES]
    out += [(f"within {1e3 * x:g} mm of the middle", far < x) for x in PLACES[:3]]
    out += [(f"ram accelerates by more than {a:g} m/s2", hard > a) for a in RATES]
    out += [(f"within {1e3 * d:g} ms after a reversal", m.reversed_for < d) for d in DELAYS]
    out += [("ram extends", m.v > REVERSES), ("ram retracts", m.v < -REVERSES)]
    out += [("XJ positive", m.x > PLACES[0]), ("XJ negative", m.x < -PLACES[0])]
    out.append(("current at its limit", np.abs(m.cor) > 0.99 * limit))
    out += [(f"|P12| above {1e-5 * p:g} bar", np.abs(m.p12) > p) for p in PRESSURES]
    out += [("P12 positive", m.p12 > PRESSURES[0]), ("P12 negative", m.p12 < -PRESSURES[0])]
    out += [(f"spool within {1e6 * x:g} um of its null", np.abs(m.xs) < x) for x in OPENINGS]
    out += [(f"spool more than {1e6 * x:g} um from its null", np.abs(m.xs) > x) for x in OPENINGS]
    return out


def _format_speed(s: float) -> str:
    return f"{s:g} m/s" if s >= 0.1 else f"{1e3 * s:g} mm/s"
