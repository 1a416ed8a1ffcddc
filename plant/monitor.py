"""The monitoring model (Fig. 6 of the paper): the actuator reduced to what two faults need.

    XF = clip((GM Cor - KSF XS)/KF, +-XFM)     XS' = GQF1/ASV deadzone(XF, FSS/(GPF1 ASV)), |XS| <= XSM
    P12 = clip(GP XS - GP/GQ AJ XJ', +-PSR)    MJ XJ'' = AJ P12 - CJ XJ', |XJ| <= XJM

A static flapper, a spool without mass, a jack without dry friction, leakage, load or noise. The current is held over a
cycle, so XS has a closed form: a straight line while the flapper is at its stop, then an exponential with the pilot
loop's Kv = KSF GQF1/(KF ASV). The ram lags behind it by MJ/(AJ^2 GP/GQ + CJ), 22 us. One step makes a cycle, where the
reference model takes 20 to 100. Many runs are simulated side by side, as in `plant.lanes`.
"""

from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from math import ceil
from typing import Any, NamedTuple

import numpy as np

from plant.compile import Function, compile_function, raise_unbound
from plant.errors import require
from plant.friction import clip, soften
from plant.kernels import make_packers
from plant.lanes import Drive
from plant.model import Model
from plant.parameters import Controller
from plant.pid import Loop, compute_current
from plant.segments import Array
from plant.threads import count_threads, map_in_threads

Reduction = Callable[[Array], Array]

FAULTS = ("filter.clogging", "spool.static_friction")
WIDTH = 64  # runs side by side
LEAST_SPEED = 1e-300  # stands for no speed at all, where something is divided by it


# the coefficients of one step of one run
Cell = namedtuple("Cell", (
    "tilt",  # GM/KF, flapper displacement by current, m/A
    "back",  # KSF/KF, by the spool's
    "unback",  # 1 over it
    "dead",  # FSS/(GPF1 ASV), flapper displacement at which the spool breaks away, m
    "slide",  # the same of a spool that slides, m
    "most",  # XFM less the latter, m
    "speed",  # GQF1/ASV, spool speed by flapper displacement, 1/s
    "rate",  # Kv, 1/s
    "unrate",  # 1/Kv, s
    "wait",  # 1 over the speed at which the spool takes back flapper displacement at the stop, s/m
    "spool_travel",  # XSM, m
    "follow",  # ram speed by spool displacement in a steady state, 1/s
    "lag",  # of the ram behind it, s
    "fade",  # exp(-h/lag)
    "push",  # h AJ PSR/(MJ + h CJ), the most that the ram's speed can gain, m/s
    "coast",  # MJ/(MJ + h CJ)
    "jack_travel",  # XJM, m
    "pressure_gain",  # GP, Pa/m
    "pressure_slope",  # GP AJ/GQ, Pa s/m
    "pressure_limit",  # PSR, Pa
))


class Motion(NamedTuple):
    """The monitor at one instant."""

    spool: float = 0.0  # XS, m
    position: float = 0.0  # XJ, m
    speed: float = 0.0  # XJ', m/s
    sliding: float = 0.0  # which way the spool slides: -1, 1, or 0 for stuck


def compute_decay(x: float) -> float:
    """e^x for -1 <= x <= 0, to 4e-11, and at the usual -0.25 to 1e-15: Taylor's series for a quarter, squared twice."""
    x = 0.25 * x
    y = 1.0 + x * (1.0 + x * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x * (1 / 720 + x * (
        1 / 5040 + x * (1 / 40320))))))))
    y = y * y
    return y * y


def step_monitor(s: Motion, current: float, h: float, c: Cell) -> Motion:
    """The monitor `h` seconds later, the current held.

    Exact, but for the step in which the spool meets its stop or P12 its limit, and for the bend of XS within the lag.
    """
    tilt = c.tilt * current - c.back * s.spool
    net_tilt = soften(tilt, c.slide)  # through the dead zone; from here on it only falls
    net_tilt = net_tilt if net_tilt * s.sliding > 0.0 or abs(tilt) > c.dead else 0.0
    begin = clip(net_tilt, c.most)
    wait = abs(net_tilt - begin) * c.wait  # s, the flapper at its stop
    wait = wait if wait < h else h
    end = begin * compute_decay(c.rate * (wait - h))
    line, curve, time_left = c.speed * begin * wait, (begin - end) * c.unback, h - wait
    spool = clip(s.spool + line + curve, c.spool_travel)
    area = line * (0.5 * wait + time_left) + (begin * time_left - (begin - end) * c.unrate) * c.unback
    total = clip(h * s.spool + area, h * c.spool_travel)  # integral of XS
    before = s.spool - c.lag * c.speed * begin
    free = c.follow * (spool - c.lag * c.speed * end) + (s.speed - c.follow * before) * c.fade
    low, high = c.coast * s.speed - c.push, c.coast * s.speed + c.push  # P12 is no more than PSR
    v = free if free > low else low
    v = v if v < high else high
    way = c.follow * total - c.lag * (v - s.speed) if v == free else 0.5 * h * (s.speed + v)
    x = s.position + way
    sliding = 1.0 if net_tilt > 0.0 else 0.0
    sliding = sliding if net_tilt >= 0.0 else -1.0
    return Motion(spool, clip(x, c.jack_travel), v if abs(x) <= c.jack_travel else 0.0, sliding)


def compute_cells(model: Model, names: Sequence[str], values: Array, h: float, sliding: float) -> Array:
    """Cells of many runs, (fields, m): `values` (m, len(names)) in place of those of the model, steps of `h` s.

    A spool that slides has `sliding` times the friction of one that is stuck.
    """
    def of(name: str) -> Array:
        return values[:, names.index(name)] if name in names else np.full(len(values), model[name])

    opening = 1.0 - of("filter.clogging")  # 1 - Kintas
    kf, ksf, asv = of("flapper.stiffness"), of("feedback_spring.stiffness"), of("spool.end_area")
    gpf1, speed = of("pilot.pressure_gain") * opening, of("pilot.flow_gain") * opening**of("filter.law") / asv
    dead = of("spool.static_friction") / (gpf1 * asv)
    most = np.maximum(of("flapper.travel") - sliding * dead, 0.0)
    gp, aj, cj, mj, psr = (of(name) for name in (
        "valve.pressure_gain", "jack.area", "jack.damping", "jack.mass", "supply.pressure"))
    slope = gp * aj / of("valve.flow_gain")
    lag, back, inertia = mj / (aj * slope + cj), ksf / kf, 1.0 / (mj + h * cj)
    return np.array([  # as the fields of Cell
        of("torque_motor.gain") / kf, back, 1.0 / back, dead, sliding * dead, most, speed, speed * back,
        1.0 / (speed * back), 1.0 / np.maximum(speed * back * most, LEAST_SPEED), of("spool.travel"),
        gp * aj / (aj * slope + cj), lag, np.exp(-h / lag), h * aj * psr * inertia, mj * inertia, of("jack.travel"),
        gp, slope, psr])


# each of these is replaced by `compile_monitor_kernel`: x_at(buffer, lane), keep_x(x, buffer, lane)
motion_at = loop_at = drive_at = cell_at = controller_at = keep_motion = keep_loop = keep_drive = raise_unbound


def sample_lane(a: Any, lane: int, pull: float, target: float) -> float:
    """Position of one lane's ram, m; and pull the ram to the position `target` by the share `pull`."""
    s = motion_at(a, lane)
    keep_motion(Motion(s.spool, s.position + pull * (target - s.position), s.speed, s.sliding), a, lane)
    position: float = s.position
    return position


def control_lane(a: Any, lane: int, demand: float, position: float) -> None:
    """The controller of one lane answers to a demand; that acts in the next cycle."""
    cor, loop = compute_current(loop_at(a, lane), demand, position, controller_at(a, lane))
    keep_loop(loop, a, lane)
    keep_drive(Drive(drive_at(a, lane).next, cor), a, lane)


def run_monitor_block(a: Any, driven: Any, position: Any, anchor: float, is_closed: bool, period: float, steps: int,
                      out: Any) -> None:
    """A block of runs; fills out[:, k, lane] = XJ, or XJ, Cor, P12 and XS, at sample k.

    Args:
        a: the block's buffer: cells and controllers in place, the rest zero. Used up.
        driven: (n,) demand m in closed loop, else the measured current A: driven[k - 1] acts from k to k + 1.
        position: (n,) m, measured, to which the ram is pulled; or (1,), where it starts; or (0,), in the middle.
        anchor: 1/s, how fast it is pulled.
        is_closed: with the controller.
        period: of a cycle, s.
        steps: a cycle.
        out: (1 or 4, n, WIDTH), written.
    """
    h, n = period / steps, len(driven)
    for lane in range(WIDTH):
        keep_motion(Motion(0.0, position[0] if len(position) else 0.0, 0.0, 0.0), a, lane)
    for k in range(n):
        current = driven[k - 1] if k else 0.0
        is_measured = len(position) == n and position[k] == position[k]
        pull, target = (anchor * period, position[k]) if is_measured else (0.0, 0.0)
        for lane in range(WIDTH):
            out[0, k, lane] = sample_lane(a, lane, pull, target)
        if is_closed:
            for lane in range(WIDTH):
                control_lane(a, lane, driven[k], out[0, k, lane])
        if len(out) > 1:
            for lane in range(WIDTH):
                s, c = motion_at(a, lane), cell_at(a, lane)
                out[1, k, lane] = drive_at(a, lane).next if is_closed else driven[k]
                out[2, k, lane] = clip(c.pressure_gain * s.spool - c.pressure_slope * s.speed, c.pressure_limit)
                out[3, k, lane] = s.spool
        for _ in range(steps):
            if is_closed:
                for lane in range(WIDTH):  # the loop that everything is for
                    keep_motion(step_monitor(motion_at(a, lane), drive_at(a, lane).now, h, cell_at(a, lane)), a, lane)
            else:
                for lane in range(WIDTH):
                    keep_motion(step_monitor(motion_at(a, lane), current, h, cell_at(a, lane)), a, lane)


PARTS = {"motion": Motion(), "loop": Loop(), "drive": Drive(), "cell": Cell(*[0.0] * len(Cell._fields)),
         "controller": Controller(*[0.0] * len(Controller._fields))}
STATES = 9  # numbers of the first three


@cache
def compile_monitor_kernel() -> Function:
    """`run_monitor_block` as machine code; the first call on a machine takes some seconds."""
    packers: dict[str, Function] = {}
    place = 0
    for name, shape in PARTS.items():
        packers[f"keep_{name}"], packers[f"{name}_at"], place = make_packers(shape, WIDTH, place)
    return compile_function(run_monitor_block, packers)


class Monitor:
    """Runs of the monitor of `model` that differ in the parameters `names` ("group.field"); no effects.

    The paper's dead zone resists a spool that slides as one that is stuck (`sliding` 1). The plant's friction is less
    then, FDS; with `sliding` FDS/FSS the spool sticks and slides as the plant's does.
    """

    def __init__(self, model: Model, names: Sequence[str] = FAULTS, steps: int = 1, workers: int | None = None,
                 sliding: float = 1.0) -> None:
        self.model, self.names, self.steps, self.sliding = model, tuple(names), steps, sliding
        self.workers = workers or count_threads()
        for name in self.names:
            require(name in model.values and name != "controller.period" and model.plant == "eha", "monitor", name,
                    "a parameter of the reference model other than the period")

    def replay(self, values: Array, current: Array, position: Array | None = None, anchor: float = 0.0,
               whole: bool = False, reduced: Reduction = lambda rows: rows) -> Array:
        """The monitor without its controller, driven by a measured current.

        Args:
            values: (m, len(names)) parameters of each run, SI.
            current: (n,) A; current[k - 1] acts from sample k to k + 1, none before.
            position: (n,) m, measured, NaN where missing: runs start at rest at position[0].
            anchor: 1/s, how fast the ram is pulled to the measured position; 0 is a free run.
            whole: all columns, not XJ alone.
            reduced: what to keep of some runs, (w, columns, n), as (w, ..): it saves the memory of all.

        Returns:
            (m, columns, n): XJ m; or XJ, Cor A, P12 Pa, XS m at each sample. Or what `reduced` makes of it.

        Raises:
            InputError: shapes that do not fit, or no position to start from.
        """
        return self._run(values, current, np.empty(0) if position is None else position, anchor, False, whole, reduced)

    def closed_loop(self, values: Array, com: Array, start: float = 0.0, whole: bool = False,
                    reduced: Reduction = lambda rows: rows) -> Array:
        """The monitor with the model's controller over a command `com` (n,) m, at rest at `start` m; as `replay`."""
        return self._run(values, com, np.array([start]), 0.0, True, whole, reduced)

    def _run(self, values: Array, driven: Array, position: Array, anchor: float, is_closed: bool, whole: bool,
             reduced: Reduction) -> Array:
        values, driven, position = (np.ascontiguousarray(x, float) for x in (values, driven, position))
        require(values.ndim == 2 and values.shape[1] == len(self.names), "monitor", "values",
                f"one row a run of {len(self.names)}, not shape {values.shape}")
        require(driven.ndim == 1 and position.shape in (driven.shape, (0,), (1,)) and not np.isnan(position[:1]).any(),
                "monitor", "position",
                f"one a cycle, the first of them known, not {position.shape} beside {driven.shape}")
        period = float(self.model["controller.period"])
        kv = compute_cells(self.model, self.names, values, period, self.sliding)[Cell._fields.index("rate")]
        steps = max(self.steps, ceil(period * kv.max(initial=0.0)))  # `compute_decay` reaches no further
        inputs = driven, position, float(anchor), is_closed, period, steps
        run = compile_monitor_kernel()

        def do(block: tuple[int, Array]) -> Array:
            out = np.empty((4 if whole else 1, len(driven), WIDTH))
            run(block[1], *inputs, out)
            return reduced(out[:, :, :block[0]].transpose(2, 0, 1))

        return np.concatenate(map_in_threads(do, self._build_blocks(values, period / steps), self.workers))

    def _build_blocks(self, values: Array, h: float) -> Iterator[tuple[int, Array]]:
        """The runs WIDTH at a time: how many they are, and the buffer at the start; idle lanes repeat the last run."""
        fixed = [values[:, self.names.index(name)] if name in self.names else np.full(len(values), self.model[name])
                 for name in (f"controller.{field}" for field in Controller._fields)]
        numbers = np.array([*compute_cells(self.model, self.names, values, h, self.sliding), *fixed])  # (numbers, m)
        for first in range(0, len(values), WIDTH):
            lanes = np.minimum(np.arange(first, first + WIDTH), len(values) - 1)
            buffer = np.concatenate([np.zeros((STATES, WIDTH)), numbers[:, lanes]])
            yield min(WIDTH, len(values) - first), buffer.reshape(-1)
