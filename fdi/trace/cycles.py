"""A trace made ready for replay: one row a controller cycle, inputs without holes, and what had to be done for that.

What a replay cannot use is refused here in one line: no current, a dead sensor, millimetres for metres.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model
from plant.plants import MODULES

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

SIGNALS = ("xj", "p12", "xs")  # what a replay can be held against
FEWEST = 200  # rows; less cannot tell anything
BRIDGED = 5  # cycles of missing current that are filled with a straight line
RECOVERY = 0.3  # s after a longer gap, until the anchored replay is back on the trace
ABRUPT = 0.1  # of the current's largest value; across a gap with such a change nothing can be filled in
STEP = 2e-4  # m between recorded rows: a step of the demand
STILL = 5e-5  # m; a ram that goes further than that moves every sensor
FIRST = 16  # rows, whose parabola tells the speed in the first
FAST = 2e-3  # m/s in the first row: a test that does not start at rest
GONE, JUMP = 1e-3, 5.0  # m that the ram is to go under a sensor that stays dead; usual steps that a live one is off by
FROZEN = 200  # equal samples in a row, while the ram moves
RANGES = (("xj", "m", 3.0, "jack.travel"), ("com", "m", 5.0, "jack.travel"), ("xs", "m", 3.0, "spool.travel"),
          ("p12", "Pa", 3.0, "supply.pressure"), ("cor", "A", 20.0, "controller.current_limit"))
FAINT = {"p12": 1e3, "xs": 1e-9}  # a signal of no larger size is in another unit


@dataclass(frozen=True, eq=False)
class Cycles:
    """A trace on the controller's cycles; columns of shape (n,), SI units, row k = Com_k, XJ_k, Cor_k."""

    t: Floats
    com: Floats  # held where missing
    cor: Floats  # bridged where missing
    load: Floats  # 0 where unknown
    xj: Floats  # as measured, NaN where missing
    p12: Floats
    xs: Floats
    usable: Flags  # rows that a replay can be held against
    filled: Flags  # rows whose current is a guess
    period: float
    signals: tuple[str, ...]  # measured and chosen, of SIGNALS
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.t)

    def measured(self, name: str) -> Floats:
        """A measured signal, NaN where it is missing or cannot be used."""
        column: Floats = getattr(self, name)
        return np.where(self.usable, column, np.nan)

    def noted(self, *notes: str) -> Cycles:
        """The same with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def shifted(self, com: int = 0, cor: int = 0) -> Cycles:
        """With Com and Cor of so many cycles before."""
        return replace(self, com=shift(self.com, com), cor=shift(self.cor, cor))


def shift(x: Floats, cycles: int) -> Floats:
    """x of so many cycles before (negative: after), the ends held."""
    return x[np.clip(np.arange(len(x)) - cycles, 0, len(x) - 1)]


def readings(trace: Trace, model: Model, signals: Sequence[str] | None = None, where: object = "trace") -> list[Cycles]:
    """A trace as cycles; more than one way to read it where rows and cycles of the model are not as long.

    A row every 2 ms can be a controller that is that slow, or every other cycle of one at 1 ms: the replay shows which.

    Raises:
        InputError: what cannot be replayed, in a line.
    """
    chosen = _chosen(trace, signals, where)
    _believable(trace, model, chosen, where)
    rows = _plain(trace, chosen)
    ratio = trace.period / model["controller.period"]
    whole, parts = round(ratio), round(1 / ratio)
    ms = 1e3 * trace.period
    if abs(ratio - 1) < 0.01:
        ways = [rows]
    elif parts > 1 and abs(1 / ratio / parts - 1) < 0.01 and (phase := _held(rows.cor, parts)) is not None:
        note = f"rows every {ms:g} ms, current new every {parts}: one row a cycle is used"
        ways = [_every(rows, parts, phase).noted(note)]
    else:
        ways = [rows.noted(f"the model's cycle of {1e3 * model['controller.period']:g} ms is taken as the trace's, "
                           f"{ms:g} ms")]
        if 1 < whole <= 20 and abs(ratio / whole - 1) < 0.01:
            ways.append(_spread(rows, whole).noted(f"rows every {ms:g} ms are taken as one cycle in {whole}; "
                                                   "the current between is interpolated"))
    return [_ready(way, trace, where) for way in ways]


def _chosen(trace: Trace, signals: Sequence[str] | None, where: object) -> tuple[str, ...]:
    for name in ("cor", "com", "xj"):
        if name not in trace.signals:
            raise InputError(where, name, "a measured column: a replay starts from the current, Com and XJ")
    if len(trace) < FEWEST:
        raise InputError(where, "t", f"at least {FEWEST} rows, not {len(trace)}")
    there = [name for name in SIGNALS if name in trace.signals]
    for name in signals or ():
        if name not in SIGNALS:
            raise InputError("--signals", name, f"some of {','.join(SIGNALS)}")
        if name not in there:
            raise InputError(where, name, f"a measured signal; this trace has {', '.join(there)}")
    return tuple(name for name in there if not signals or name in signals)


def _believable(trace: Trace, model: Model, chosen: Sequence[str], where: object) -> None:
    """Refuse another plant's recordings, other units and dead sensors."""
    recorded = trace.provenance.get("plant", "")
    if recorded in MODULES and recorded != model.plant:
        raise InputError(where, "--model", f"{recorded}, whose rig recorded this, not {model.plant}")
    if trace.period > 50 * model["controller.period"]:
        raise InputError(where, "t", f"times in s, one row a cycle; the rows are {trace.period:g} s apart")
    for name, unit, factor, limit in RANGES:
        largest = float(np.nanmax(np.abs(trace.column(name)))) if name in trace.signals else 0.0
        if largest > factor * model.values.get(limit, math.inf):
            times = largest / model[limit]
            raise InputError(where, name, f"values in {unit}; the largest, {largest:g}, is {times:.0f} times {limit}")
    moves = float(np.nanmax(trace.com) - np.nanmin(trace.com)) > STILL
    for name in chosen:
        values = trace.column(name)
        lowest, highest = float(np.nanmin(values)), float(np.nanmax(values))
        if lowest == highest and (moves or name == "xj"):
            without = ",".join(other for other in chosen if other != name) or "xj"
            hint = "" if name == "xj" else f" (--signals {without} leaves it out)"
            raise InputError(where, name, f"a signal that lives; it is {lowest:g} throughout{hint}")
        if moves and highest - lowest < FAINT.get(name, 0.0):
            raise InputError(where, name, f"values in {'Pa' if name == 'p12' else 'm'}; the largest is {highest:g}")


def _plain(trace: Trace, chosen: Sequence[str]) -> Cycles:
    """The trace row by row, nothing filled yet."""
    notes = list(trace.notes)
    grid = trace.t[0] + trace.period * np.arange(len(trace))
    jitter = float(np.abs(trace.t - grid).max())
    if jitter > 0.1 * trace.period:
        notes.append(f"times are up to {1e3 * jitter:.2g} ms off an even grid; each row is taken as one cycle")
    nothing = np.full(len(trace), np.nan)
    columns = {name: trace.column(name) if name in chosen else nothing for name in SIGNALS}
    xj = trace.xj  # the controller's block and the anchor need it, chosen or not
    return Cycles(trace.t, trace.com, trace.cor, trace.load, xj, columns["p12"], columns["xs"],
                  np.ones(len(trace), bool), np.zeros(len(trace), bool), trace.period, tuple(chosen), tuple(notes))


def _held(cor: Floats, parts: int) -> int | None:
    """The row, of each `parts`, that brings a new current; None if every row does."""
    new = np.flatnonzero(np.diff(cor) != 0.0) + 1
    counts = np.bincount(new % parts, minlength=parts)
    return int(counts.argmax()) if len(new) and counts.max() > 0.95 * len(new) else None


def _every(c: Cycles, parts: int, phase: int) -> Cycles:
    names = ("t", "com", "cor", "load", *SIGNALS, "usable", "filled")
    columns = {name: getattr(c, name)[phase::parts] for name in names}
    return replace(c, **columns, period=c.period * parts)


def _spread(c: Cycles, whole: int) -> Cycles:
    n = (len(c) - 1) * whole + 1
    period = c.period / whole
    columns: dict[str, Any] = {}  # Any, as `replace` cannot tell them from other fields
    for name in ("com", "cor", "load", *SIGNALS):
        columns[name] = np.full(n, np.nan)
        columns[name][::whole] = getattr(c, name)
    return replace(c, **columns, t=np.round(c.t[0] + period * np.arange(n), 9), period=period,
                   usable=np.ones(n, bool), filled=np.zeros(n, bool))


def _ready(c: Cycles, trace: Trace, where: object) -> Cycles:
    """Inputs filled, rows marked that cannot be used."""
    cor, unknown = bridged(c.cor, max(BRIDGED, round(trace.period / c.period)))
    missing = np.isnan(c.cor)
    before, behind = held(c.cor), held(c.cor[::-1])[::-1]
    unknown |= missing & (np.abs(behind - before) > ABRUPT * np.nanmax(np.abs(c.cor)))
    usable = c.usable & ~_after(unknown, round(RECOVERY / c.period))
    notes = list(c.notes)
    lost = int(np.isnan(trace.cor).sum())
    if lost:
        notes.append(f"the current is missing in {lost} of {len(trace)} rows; "
                     f"{(~usable).sum() * c.period:.2g} s of the trace could not be replayed")
    for name in c.signals:
        frozen = _frozen(getattr(c, name), c.com if name == "xj" else c.xj)
        if frozen.any():
            first = float(c.t[int(np.argmax(frozen))])
            seconds = float(frozen.sum()) * c.period
            notes.append(f"{name} is frozen for {seconds:.2f} s, first at {first:.2f} s: left out there")
            usable &= ~frozen
    start = _start(c)
    if start:
        notes.append(f"the ram already moves in the first row: the first {start * c.period:g} s are not judged")
        usable[:start] = False
    if usable.sum() < FEWEST:
        raise InputError(where, "cor", f"at least {FEWEST} rows that can be replayed, not {int(usable.sum())}")
    return replace(c, cor=cor, com=_demand(c.com), load=held(c.load), usable=usable, filled=missing,
                   notes=tuple(notes))


def bridged(x: Floats, longest: int) -> tuple[Floats, Flags]:
    """Cubics through the two samples on either side of up to `longest` missing ones; longer gaps are held, and marked.

    At the ends, and where the samples beside a gap are rare, straight lines.
    """
    missing = np.isnan(x)
    rows = np.arange(len(x))
    there = rows[~missing]
    filled = np.interp(rows, there, x[there])
    edges = np.flatnonzero(np.diff(missing, prepend=False, append=False)).reshape(-1, 2)
    marked = np.zeros(len(x), bool)
    for a, b in edges:
        if b - a > longest or a == 0:
            marked[a:b] = True
    gaps = rows[missing & ~marked]
    after = np.searchsorted(there, gaps)
    inner = (after >= 2) & (after < len(there) - 1)
    gaps, near = gaps[inner], there[after[inner][:, None] + np.arange(-2, 2)]
    narrow = near[:, 3] - near[:, 0] <= longest + 5
    filled[gaps[narrow]] = _cubic(near[narrow], x[near[narrow]], gaps[narrow])
    return np.where(marked, held(x), filled), marked


def _demand(com: Floats) -> Floats:
    """Com where it is missing: straight lines where it moves on, held before a step."""
    rows, missing = np.arange(len(com)), np.isnan(com)
    before, behind = held(com), held(com[::-1])[::-1]
    line = np.interp(rows, rows[~missing], com[~missing])
    return np.where(missing & (np.abs(behind - before) > STEP), before, line)


def _cubic(at: NDArray[np.int64], values: Floats, wanted: NDArray[np.int64]) -> Floats:
    """Lagrange's cubics through `values` (m, 4) at rows `at` (m, 4), at rows `wanted` (m,)."""
    out = np.zeros(len(wanted))
    for i in range(4):
        others = [j for j in range(4) if j != i]
        parts = (wanted[:, None] - at[:, others]) / (at[:, [i]] - at[:, others])
        out += values[:, i] * parts.prod(axis=1)
    return out


def held(x: Floats) -> Floats:
    """Where a sample is missing, the last one before it; 0 before the first."""
    last = np.maximum.accumulate(np.where(np.isnan(x), 0, np.arange(len(x))))
    filled: Floats = np.nan_to_num(x[last])
    return filled


def _after(marked: Flags, rows: int) -> Flags:
    """The marked rows, and so many after each."""
    edges = np.cumsum(marked)
    before = np.concatenate([np.zeros(min(rows, len(edges)), int), edges[:-rows]]) if rows else edges
    out: Flags = (edges - before) > 0
    return out | marked


def _frozen(x: Floats, mover: Floats) -> Flags:
    """Rows in which x repeats one value for long while `mover` goes on, and then jumps, or never comes back.

    A ram that stands still behind a coarse converter goes on from its value by the converter's steps.
    """
    out = np.zeros(len(x), bool)
    steps = np.abs(np.diff(x))
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    starts = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0.0]))
    for a, b in zip(starts, [*starts[1:], len(x)], strict=True):
        if b - a < FROZEN or np.isnan(mover[a:b]).all():
            continue
        way = float(np.nanmax(mover[a:b]) - np.nanmin(mover[a:b]))
        out[a:b] = way > GONE if b == len(x) else way > STILL and steps[b - 1] > JUMP * usual
    return out


def _start(c: Cycles) -> int:
    """Rows to leave out at the start, for a replay that starts at rest."""
    first = c.xj[:FIRST]
    if np.isnan(first).any():
        return 0
    k = np.arange(FIRST)
    speed = float(np.linalg.pinv(np.vander(k.astype(float), 3, increasing=True))[1] @ first) / c.period  # at row 0
    return round(RECOVERY / c.period) if abs(speed) > FAST else 0
