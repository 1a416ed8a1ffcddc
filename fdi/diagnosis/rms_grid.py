"""The RMS grid: the monitor run for every pair of fault sizes, compared with the measured ram (Figs. 13-15).

There is one map of the step sections, one of the ramp sections and one of both. The monitor is driven by the measured
current, and its ram is pulled to the measured one at ANCHOR_RATE; a constant offset does not count. In closed loop, as
in the paper, the maps of this plant are useless: with spool friction the loop limit-cycles, two runs differ in phase,
and a monitor that does not oscillate at all is nearer to the trace than the right one (`drive="command"` shows it).
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi.diagnosis.faults import CLOGGING, FRICTION
from fdi.estimation.replay import has_known_start, read_cycles
from fdi.thresholds import ANCHOR_RATE
from fdi.trace.trace import Flags, Floats, Trace
from plant.errors import InputError
from plant.model import Model
from plant.monitor import Monitor

KINTAS_AXIS = np.linspace(0.0, 0.5, 21)
FSS_AXIS = np.linspace(0.0, 90.0, 21)  # N
SLIDING_RATIOS = (*FRICTION.follow.values(), 1.0, 1.0 / 3.0, 1.0 / 15.0)  # FDS/FSS, the nominal plant's first
DRIVES = ("current", "command")
# corners of the unit square (Kintas, FSS N): MidBand in its middle, MaxBand at its right and upper edge
LOWER_CORNER = tuple(2.0 * fault.acceptable - fault.maintenance for fault in (CLOGGING, FRICTION))
UPPER_CORNER = CLOGGING.maintenance, FRICTION.maintenance


class Point(NamedTuple):
    """A pair of fault sizes, and the RMS of its residual."""

    kintas: float
    fss: float  # N
    rms: float  # m


class Map(NamedTuple):
    """RMS of XJ, measured less monitor, about its mean, over the sections of one kind, at each cell."""

    rms: Floats  # (kintas, fss), m
    minimum: Point


class Merged(NamedTuple):
    """The centre of gravity of the minima A (steps) and B (ramps)."""

    kintas: float
    fss: float  # N
    weight: float  # of A; B has the rest
    distance: float  # from the first bisector, -1 at the left edge, 1 at the right


@dataclass(frozen=True, eq=False)
class Grid:
    """The maps and their minima; a map is None where the command has no such section."""

    kintas: Floats  # the axes
    fss: Floats  # N
    step: Map | None
    ramp: Map | None
    joint: Map
    merged: Merged
    best: Point  # between the cells: the joint map is a valley narrower than they are
    sliding: float  # FDS/FSS of the spool for which the grid fits best
    drive: str
    simulations: int


def search_grid(trace: Trace, model: Model | None = None, kintas: Floats = KINTAS_AXIS,
                fss: Floats = FSS_AXIS, drive: str = "current", sliding: tuple[float, ...] = SLIDING_RATIOS) -> Grid:
    """The RMS maps of a trace over all pairs of `kintas` (k,) and `fss` (f,) N.

    Args:
        trace: prepared for replay or not; the command must have steps or ramps.
        model: the plant without the faults; nominal by default.
        kintas: axis of the maps.
        fss: axis of the maps.
        drive: what drives the monitor, the measured "current", or the "command" in closed loop.
        sliding: FDS/FSS of the spool to try; the grid is that of the best one.

    Raises:
        InputError: a trace that cannot be replayed, a command with neither steps nor ramps, or an unknown drive.
    """
    model = Model() if model is None else model
    if not trace.outputs:
        trace = read_cycles(trace, model)[0]
    if drive not in DRIVES:
        raise InputError("grid", "drive", f"one of {', '.join(DRIVES)}")
    parts = trace.sections()
    kinds = np.repeat([s.kind for s in parts], [s.stop - s.start for s in parts])
    measured = ~np.isnan(trace.mask_unusable(trace.declared.controlled.name))
    rows = {kind: chosen for kind in ("step", "ramp") if (chosen := (kinds == kind) & measured).any()}
    if not rows:
        raise InputError("trace", "com", "steps or ramps, for the RMS grid")
    values = np.stack(np.meshgrid(kintas, fss, indexing="ij"), -1).reshape(-1, 2)
    tried = {ratio: _compute_maps(trace, model, values, drive, ratio, rows) for ratio in sliding}
    joint = {ratio: _join_maps(maps, rows) for ratio, maps in tried.items()}
    ratio = min(joint, key=lambda ratio: float(joint[ratio].min()))
    step, ramp = (_make_map(tried[ratio][kind], kintas, fss) if kind in rows else None for kind in ("step", "ramp"))
    both = _make_map(joint[ratio], kintas, fss)
    near = _follow_valley(both, kintas, fss)
    finer = _join_maps(_compute_maps(trace, model, near, drive, ratio, rows), rows)
    deepest = int(finer.argmin())
    best = Point(float(near[deepest, 0]), float(near[deepest, 1]), float(finer[deepest]))
    return Grid(kintas, fss, step, ramp, both, merge_minima(step, ramp), best, ratio, drive,
                len(values) * len(sliding) + len(near))


def _follow_valley(joint: Map, kintas: Floats, fss: Floats, points: int = 13) -> Floats:
    """Pairs (m, 2) along the floor of a map's valley: `points` within a cell either way of the best FSS of each Kintas.

    The response depends on friction over pilot pressure, so the valley runs across the grid, and the deepest of its
    cells is mostly the one that happens to lie on the floor.
    """
    apart = float(fss[1] - fss[0]) if len(fss) > 1 else 0.0
    floor = fss[joint.rms.argmin(axis=1)]
    across = np.maximum(floor[:, None] + apart * np.linspace(-1.0, 1.0, points), 0.0)
    return np.column_stack([np.repeat(kintas, points), across.reshape(-1)])


def _compute_maps(trace: Trace, model: Model, values: Floats, drive: str, sliding: float, rows: dict[str, Flags]
         ) -> dict[str, Floats]:
    """RMS of XJ, measured less monitor, about its mean, by kind of section; (m,) m each."""
    def reduce_runs(runs: Floats) -> Floats:
        found = []
        for chosen in rows.values():
            left = runs[:, 0].T[chosen] - trace.controlled[chosen, None]
            left -= left.mean(axis=0)  # a load or a null bias is but an offset, as the ram is pulled
            found.append(np.sqrt(np.einsum("ij,ij->j", left, left) / len(left)))
        return np.stack(found, -1)

    monitor = Monitor(model, sliding=sliding)
    if drive == "command":
        start = float(trace.controlled[0]) if has_known_start(trace) else 0.0
        out = monitor.closed_loop(values, trace.command, start, reduced=reduce_runs)
    else:
        position = trace.controlled if has_known_start(trace) else None
        out = monitor.replay(values, trace.drive, position, ANCHOR_RATE, reduced=reduce_runs)
    return dict(zip(rows, out.T, strict=True))


def _join_maps(maps: dict[str, Floats], rows: dict[str, Flags]) -> Floats:
    """RMS over the rows of both kinds, (m,) m."""
    counts = {kind: float(rows[kind].sum()) for kind in maps}
    return np.sqrt(sum(counts[kind] * maps[kind] ** 2 for kind in maps) / sum(counts.values()))


def _make_map(rms: Floats, kintas: Floats, fss: Floats) -> Map:
    table = rms.reshape(len(kintas), len(fss))
    i, j = np.unravel_index(int(table.argmin()), table.shape)
    return Map(table, Point(float(kintas[i]), float(fss[j]), float(table[i, j])))


def merge_minima(step: Map | None, ramp: Map | None) -> Merged:
    """A and B by the rule of the paper: the distance of their middle from the first bisector sets the weight of A.

    In the unit square, Kintas from 0.15 to 0.35 and FSS over the same share of its own limits: MidBand is the middle,
    MaxBand the right and upper edge. The distance is measured along Kintas, from the bisector to the edge: at the right
    edge the steps count fully, at the left edge the ramps, on the bisector both alike. Without one, the other counts.
    """
    points = [m.minimum for m in (step, ramp) if m is not None]
    if len(points) < 2:
        only, weight = points[0], float(step is not None)
        return Merged(only.kintas, only.fss, weight, 2.0 * weight - 1.0)
    a, b = points
    distance = measure_bisector_distance(0.5 * (a.kintas + b.kintas), 0.5 * (a.fss + b.fss))
    weight = 0.5 * (1.0 + distance)
    return Merged(weight * a.kintas + (1.0 - weight) * b.kintas, weight * a.fss + (1.0 - weight) * b.fss, weight,
                  distance)


def measure_bisector_distance(kintas: float, fss: float) -> float:
    """Signed distance along Kintas from the first bisector of the unit square, as a share of the edge's: -1 .. 1."""
    x, y = (min(max((size - low) / (high - low), 0.0), 1.0)
            for size, low, high in zip((kintas, fss), LOWER_CORNER, UPPER_CORNER, strict=True))
    room = 1.0 - y if x > y else y
    return (x - y) / room if x != y else 0.0
