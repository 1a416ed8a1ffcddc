"""The RMS grid: a plant without other deviations, run for every pair of sizes of two faults, compared with the measured
position (Figs. 13-15).

There is one map of the step sections, one of the ramp sections and one of both. The plant is driven by the measured
drive, and its position is pulled to the measured one at ANCHOR_RATE; a constant offset does not count. In closed loop,
as in the paper, the maps of this plant are useless: with spool friction the loop limit-cycles, two runs differ in
phase, and a monitor that does not oscillate at all is nearer to the trace than the right one (`drive="command"` shows
it). Clogging and spool friction have the paper's monitor, which is much faster; all other pairs take the plant itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi.diagnosis.faults import FAULTS, Fault
from fdi.estimation import read_cycles, replay_lanes, silence_readings
from fdi.thresholds import ANCHOR_RATE
from fdi.trace import Flags, Floats, Trace
from plant import FAULTS as MONITORED, Lanes, Model, Monitor, require

CELLS = 21  # along each axis
SLIDING_RATIOS = (2.0 / 3.0, 1.0, 1.0 / 3.0, 1.0 / 15.0)  # FDS/FSS of the monitor, the nominal plant's first
DRIVES = ("current", "command")
MOST_RUNS = 64  # of a plant at a time, which bounds the memory


class Point(NamedTuple):
    """A pair of fault sizes, and the RMS of its residual."""

    sizes: tuple[float, float]
    rms: float  # in the unit of the controlled signal


class Map(NamedTuple):
    """RMS of the position, measured less model, about its mean, over the sections of one kind, at each cell."""

    rms: Floats  # (first size, second size)
    minimum: Point


class Merged(NamedTuple):
    """The centre of gravity of the minima A (steps) and B (ramps)."""

    sizes: tuple[float, float]
    weight: float  # of A; B has the rest
    distance: float  # from the first bisector, -1 at the left edge, 1 at the right


@dataclass(frozen=True, eq=False)
class Grid:
    """The maps of a pair of faults and their minima; a map is None where the command has no such section."""

    faults: tuple[Fault, Fault]
    axes: tuple[Floats, Floats]
    step: Map | None
    ramp: Map | None
    joint: Map
    merged: Merged
    best: Point  # between the cells: the joint map is a valley narrower than they are
    simulations: int
    unit: str  # of the RMS

    @property
    def starts(self) -> list[tuple[float, float]]:
        """Pairs of sizes from which a fit may begin."""
        return [self.merged.sizes, *(m.minimum.sizes for m in (self.joint, self.step, self.ramp) if m is not None)]

    def find_size(self, fault: Fault, point: Point | Merged) -> float:
        """The size of one of both faults at a point."""
        return point.sizes[self.faults.index(fault)]


def search_grid(trace: Trace, model: Model | None = None, faults: Sequence[Fault] = FAULTS, drive: str = "current",
                sliding: Sequence[float] = SLIDING_RATIOS) -> Grid:
    """The RMS maps of a trace over all pairs of sizes of two faults.

    Args:
        trace: prepared for replay or not; the command must have steps or ramps.
        model: the plant without the faults; nominal by default.
        faults: two of them; `Fault.axis` has the ends of their axes.
        drive: what drives the plant, the measured "current", or the "command" in closed loop.
        sliding: FDS/FSS of the spool for the monitor to try; the grid is that of the best one.

    Raises:
        InputError: a trace that cannot be replayed, a command with neither steps nor ramps, or an unknown drive.
    """
    model = Model() if model is None else model
    if not trace.outputs:
        trace = read_cycles(trace, model)[0]
    require(drive in DRIVES, "grid", "drive", f"one of {', '.join(DRIVES)}")
    first, second = faults
    parts = trace.sections()
    kinds = np.repeat([s.kind for s in parts], [s.stop - s.start for s in parts])
    is_measured = ~np.isnan(trace.mask_unusable(trace.declared.controlled.name))
    rows = {kind: mask for kind in ("step", "ramp") if (mask := (kinds == kind) & is_measured).any()}
    require(rows, "trace", trace.declared.command.name, "steps or ramps, for the RMS grid")
    axes = np.linspace(*first.axis, CELLS), np.linspace(*second.axis, CELLS)
    values = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    has_monitor = model.kind.name == "eha" and (first.parameter, second.parameter) == MONITORED
    runs = _Runs(trace, model, (first, second), drive, rows, has_monitor)
    maps_by_ratio = {ratio: runs.compute_maps(values, ratio) for ratio in (sliding if has_monitor else (1.0,))}
    joint = {ratio: runs.join_maps(maps) for ratio, maps in maps_by_ratio.items()}
    ratio = min(joint, key=lambda ratio: float(joint[ratio].min()))
    step, ramp = (_make_map(maps_by_ratio[ratio][kind], axes) if kind in rows else None for kind in ("step", "ramp"))
    both = _make_map(joint[ratio], axes)
    pairs = _follow_valley(both, axes, second)
    finer = runs.join_maps(runs.compute_maps(pairs, ratio))
    deepest = int(finer.argmin())
    best = Point((float(pairs[deepest, 0]), float(pairs[deepest, 1])), float(finer[deepest]))
    return Grid((first, second), axes, step, ramp, both, merge_minima(step, ramp, (first, second)), best,
                len(values) * len(maps_by_ratio) + len(pairs), trace.declared.controlled.unit)


def _follow_valley(joint: Map, axes: tuple[Floats, Floats], second: Fault, points: int = 13) -> Floats:
    """Pairs (m, 2) along the floor of a map's valley: `points` within a cell either way of the best size of the second
    fault for each of the first.

    Faults that change the response alike make a valley across the grid, and the deepest of its cells is mostly the one
    that happens to lie on the floor.
    """
    spacing = float(axes[1][1] - axes[1][0])
    floor = axes[1][joint.rms.argmin(axis=1)]
    across = np.clip(floor[:, None] + spacing * np.linspace(-1.0, 1.0, points), *second.range)
    return np.column_stack([np.repeat(axes[0], points), across.reshape(-1)])


class _Runs(NamedTuple):
    """What the runs of a grid have in common."""

    trace: Trace
    model: Model
    faults: tuple[Fault, Fault]
    drive: str
    rows: dict[str, Flags]  # by kind of section
    has_monitor: bool

    def compute_maps(self, values: Floats, sliding: float) -> dict[str, Floats]:
        """RMS of the position, measured less model, about its mean, by kind of section; (m,) each."""
        if not self.has_monitor:
            out = np.concatenate([self.run_plant(values[k:k + MOST_RUNS]) for k in range(0, len(values), MOST_RUNS)])
        else:
            trace, model = self.trace, Monitor(self.model, sliding=sliding)
            if self.drive == "command":
                out = model.closed_loop(values, trace.command, float(trace.anchor[0]), reduced=self.reduce_runs)
            else:
                out = model.replay(values, trace.drive, trace.anchor, ANCHOR_RATE, reduced=self.reduce_runs)
        return dict(zip(self.rows, out.T, strict=True))

    def run_plant(self, values: Floats) -> Floats:
        """What `reduce_runs` makes of runs (m, 2) of the plant itself."""
        model = silence_readings(self.model).with_effects(
            name.partition(".")[0] for fault in self.faults for name in fault.parameters)
        names = [name for fault in self.faults for name in fault.parameters]
        rows = [[x for fault, size in zip(self.faults, pair, strict=True) for x in fault.list_changes(size).values()]
                for pair in values.tolist()]
        lanes = Lanes(model, names)
        out = (lanes.closed_loop(np.array(rows), self.trace.command, self.trace.load) if self.drive == "command" else
               replay_lanes(lanes, np.array(rows), self.trace))
        return self.reduce_runs(out.transpose(0, 2, 1))

    def reduce_runs(self, runs: Floats) -> Floats:
        """RMS by kind of section, (m, kinds), of runs (m, columns, n), the controlled signal first."""
        rms = []
        for rows in self.rows.values():
            residual = runs[:, 0].T[rows] - self.trace.controlled[rows, None]
            residual -= residual.mean(axis=0)  # a load or a null bias is but an offset, as the plant is pulled
            rms.append(np.sqrt(np.einsum("ij,ij->j", residual, residual) / len(residual)))
        return np.stack(rms, -1)

    def join_maps(self, maps: dict[str, Floats]) -> Floats:
        """RMS over the rows of both kinds, (m,)."""
        counts = {kind: float(self.rows[kind].sum()) for kind in maps}
        return np.sqrt(sum(counts[kind] * maps[kind] ** 2 for kind in maps) / sum(counts.values()))


def _make_map(rms: Floats, axes: tuple[Floats, Floats]) -> Map:
    table = rms.reshape(len(axes[0]), len(axes[1]))
    i, j = np.unravel_index(int(table.argmin()), table.shape)
    return Map(table, Point((float(axes[0][i]), float(axes[1][j])), float(table[i, j])))


def merge_minima(step: Map | None, ramp: Map | None, faults: tuple[Fault, Fault]) -> Merged:
    """A and B by the rule of the paper: the distance of their middle from the first bisector sets the weight of A.

    The distance is measured along the first fault, from the bisector to the edge of the unit square: at the right edge
    the steps count fully, at the left edge the ramps, on the bisector both alike. Without one, the other counts.
    """
    points = [m.minimum for m in (step, ramp) if m is not None]
    if len(points) < 2:
        only, weight = points[0], float(step is not None)
        return Merged(only.sizes, weight, 2.0 * weight - 1.0)
    a, b = (point.sizes for point in points)
    distance = measure_bisector_distance((0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])), faults)
    weight = 0.5 * (1.0 + distance)
    return Merged((weight * a[0] + (1.0 - weight) * b[0], weight * a[1] + (1.0 - weight) * b[1]), weight, distance)


def find_corners(faults: tuple[Fault, Fault]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The lower and upper corner of the unit square as departures: MidBand is its middle, MaxBand its right and upper
    edge.
    """
    return (tuple(2.0 * f.limits[1] - f.limits[2] for f in faults), tuple(f.limits[2] for f in faults))


def measure_bisector_distance(sizes: tuple[float, float], faults: tuple[Fault, Fault]) -> float:
    """Signed distance along the first fault from the first bisector of the unit square, as a share of the edge's.

    It is -1 at the left edge, 1 at the right.
    """
    x, y = (min(max((fault.measure_departure(size) - low) / (high - low), 0.0), 1.0)
            for fault, size, low, high in zip(faults, sizes, *find_corners(faults), strict=True))
    room = 1.0 - y if x > y else y
    return (x - y) / room if x != y else 0.0
