"""The figures of a sequence before its run: command, load, and the run that a healthy actuator is predicted to make."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fdi.report.numbers import count_nouns, format_amount, format_signal
from plant import Model, simulate
from plant.model import find_quantity
from plant.run import Columns
from plant.segments import RATE, Array
from rig.nodes.scenario import require_servovalve
from rig.run.job import Job
from rig.run.outcome import LimitReached, find_limits
from rig.sequences.checks import CheckResult, Guard, evaluate_checks
from rig.sequences.faults import (
    Corrupted,
    Fault,
    Foreign,
    Frames,
    Jitter,
    Late,
    Noise,
    Offset,
    Parameter,
    Reset,
    Schedule,
    Short,
    Stuck,
    require_sensible,
)
from rig.sequences.sequence import Sequence as TestSequence

OF_EVENTS = ("response_within", "shut_off", "recovers", "event_occurs", "event_never")  # without a bus no events


SHOWN_UNITS = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3), "m/s2": ("m/s2", 1.0), "N": ("kN", 1e-3)}  # and SI value to it


class Demand(NamedTuple):
    """A figure of the command or load beside the limit of the actuator. SI; `limit` is None where there is none."""

    name: str
    value: float
    unit: str
    t: float  # s of main, where it is reached
    section: str
    limit: float | None
    parameter: str  # what the limit comes from

    def describe(self, value: float) -> str:
        """A value of this figure in the unit of tables: "5 mm"."""
        return f"{self.show(value)} {SHOWN_UNITS[self.unit][0]}"

    def show(self, value: float) -> str:
        """The number alone."""
        return f"{SHOWN_UNITS[self.unit][1] * value:.4g}"

    @property
    def is_violated(self) -> bool:
        """Whether the sequence asks for more than the actuator can do."""
        return self.limit is not None and self.value > self.limit * (1.0 + 1e-9)


class GuardTrip(NamedTuple):
    """A guard that the predicted run violates, at `t` s of main."""

    name: str
    t: float


class DryRun(NamedTuple):
    """What a sequence asks for, and what it is predicted to do on a healthy actuator."""

    job: Job
    durations: dict[str, float]  # s, of setup, main and cleanup
    demands: list[Demand]
    t: Array  # s of main
    speed: Array  # m/s, of the command; 0 where it jumps
    load: Array  # N
    faults: list[PlannedFault]  # that the run will inject
    predicted: Columns  # of setup, main and cleanup, without the faults
    limits: tuple[LimitReached, ...]  # that the predicted run reaches
    checks: list[CheckResult]  # on the predicted run, those that need no events
    not_predicted: list[str]  # the other checks
    trips: list[GuardTrip]

    @property
    def problems(self) -> list[str]:
        """What violates a limit, in words; empty if the sequence can run."""
        found = [f"{each.name} {each.describe(each.value)} beyond {each.describe(each.limit)} ({each.parameter}) in "
                 f"{each.section!r}, t = {each.t:.3f} s"
                 for each in self.demands if each.limit is not None and each.is_violated]
        found += [each.describe() for each in self.limits if each.signal == "xj"]
        found += [f"guard {trip.name!r} violated at t = {trip.t:.3f} s" for trip in self.trips]
        return found + [f"check {check.name!r}: {check.detail}" for check in self.checks if check.value != check.value]


def make_dry_run(job: Job) -> DryRun:
    """Hold the command and load of a job against the model's limits, and simulate it without bus and faults.

    Raises:
        InputError: a plant that the bench cannot drive, or a fault that contradicts the model's parameters.
    """
    require_servovalve(job.model)
    faults = plan_faults(job)
    sequence, model = job.sequence, job.model
    setup, main = sequence.setup_profile(), sequence.main_profile()
    cleanup = sequence.cleanup_profile(main.end)
    command = np.concatenate((setup.command, main.command, cleanup.command))
    first, last = len(setup.command), len(setup.command) + len(main.command)
    load = np.zeros(len(command))
    load[first:last] = sequence.load_profile()
    t = (np.arange(len(command)) - first) / RATE
    predicted = simulate(model, command, load, job.seed)
    sections = name_rows(sequence, (setup.command, main.command, cleanup.command))
    columns = Columns(np.arange(last - first) / RATE, *(column[first:last] for column in predicted[1:]))
    chosen = [check for check in sequence.checks if check.kind not in OF_EVENTS]
    return DryRun(
        job=job, durations={"setup": first / RATE, "main": (last - first) / RATE,
                            "cleanup": (len(command) - last) / RATE},
        demands=measure_demands(command, load, t, sections, model), t=t,
        speed=split_jumps(command, [row for row, _ in sections])[0], load=load, faults=faults,
        predicted=predicted,
        limits=find_limits(lambda name: getattr(predicted, name), model, first),
        checks=evaluate_checks(chosen, columns, sequence.sections(), (), sequence.fault_starts()),
        not_predicted=[check.name for check in sequence.checks if check.kind in OF_EVENTS],
        trips=[] if sequence.faults else find_trips(sequence.guards, columns))


def name_rows(sequence: TestSequence, commands: Sequence[Array]) -> list[tuple[int, str]]:
    """First row of each section of setup, main and cleanup, and its name."""
    profiles = (sequence.setup_profile(), sequence.main_profile(), sequence.cleanup_profile(0.0))
    found, start = [], 0
    for phase, profile, command in zip(("setup", "main", "cleanup"), profiles, commands, strict=True):
        found += [(start + section.start, section.name if phase == "main" else f"{phase}: {section.name}")
                  for section in profile.sections]
        start += len(command)
    return found


def measure_demands(command: Array, load: Array, t: Array, sections: Sequence[tuple[int, str]],
                    model: Model) -> list[Demand]:
    """The largest position, step, speed and acceleration of a command, and the largest load.

    A jump at the first row of a section is a step and counts neither as speed nor as acceleration.
    """
    starts = [row for row, _ in sections]
    speed, jumps = split_jumps(command, starts)
    is_start = np.isin(np.arange(len(command)), starts)
    is_known = ~is_start & ~np.roll(is_start, 1)  # rows whose speed and the one before are of the same section
    acceleration = np.where(is_known, np.diff(speed, prepend=0.0) * RATE, 0.0)
    limits = find_capabilities(model)

    def find(name: str, values: Array, unit: str, parameter: str, back: int = 0) -> Demand:
        row = int(np.argmax(np.abs(values)))
        section = sections[int(np.searchsorted(starts, max(row - back, 0), side="right")) - 1][1]
        return Demand(name, float(np.abs(values[row])), unit, float(t[row]), section, limits.get(parameter), parameter)

    return [find("position", command, "m", "jack.travel"),
            find("step", jumps, "m", ""),
            find("speed", speed, "m/s", "no-load speed", back=1),  # from the row before, which may be another section's
            find("acceleration", acceleration, "m/s2", ""),
            find("load", load, "N", "stall force")]


def split_jumps(command: Array, starts: Sequence[int]) -> tuple[Array, Array]:
    """Speed of a command in m/s, 0 at its jumps; and its jumps in m, 0 elsewhere. Shape (n,) both.

    A jump is a change at the first row of a section, `starts`, that is larger than the changes beside it: else the line
    goes on from the section before.
    """
    steps = np.diff(command, prepend=command[:1])
    beside = np.maximum(np.abs(np.roll(steps, 1)), np.abs(np.roll(steps, -1)))
    is_jump = np.isin(np.arange(len(command)), starts) & (np.abs(steps) > 2.0 * beside + 1e-9)
    return np.where(is_jump, 0.0, steps * RATE), np.where(is_jump, steps, 0.0)


def find_capabilities(model: Model) -> dict[str, float]:
    """What the actuator can do, SI, as far as its plant has the parameters.

    The no-load speed is the flow of the open valve over the area of the piston, GQ XSM / AJ; the stall force is the
    supply pressure on that area, PSR AJ (physics.md).
    """
    found = {"jack.travel": model["jack.travel"]}
    values = model.values
    if {"valve.flow_gain", "spool.travel"} <= values.keys():
        found["no-load speed"] = model["valve.flow_gain"] * model["spool.travel"] / model["jack.area"]
        found["stall force"] = model["supply.pressure"] * model["jack.area"]
    return found


def find_trips(guards: Sequence[Guard], columns: Columns) -> list[GuardTrip]:
    """The guards that the predicted main phase violates."""
    trips = []
    for guard in guards:
        low, high = guard.compute_limits()
        values = columns.com - columns.xj if guard.signal == "error" else getattr(columns, guard.signal)
        outside = np.convolve((values < low) | (values > high), np.ones(guard.cycles))[:len(values)] >= guard.cycles
        if outside.any():
            trips.append(GuardTrip(guard.name, float(columns.t[int(np.argmax(outside))])))
    return trips


class PlannedFault(NamedTuple):
    """A fault as the run will inject it; times in s of main."""

    name: str
    kind: str
    target: str  # parameter, sensor, frame or node
    t0: float
    t1: float  # it no longer acts
    size: str  # in words

    @property
    def duration(self) -> float:
        """How long it acts, s."""
        return self.t1 - self.t0


def plan_faults(job: Job) -> list[PlannedFault]:
    """The faults of a run with the seed of the job, in the order of the sequence.

    Raises:
        InputError: values that contradict other parameters of the job's model.
    """
    plan = job.sequence.plan(job.seed)
    if not plan.faults:
        return []
    changed = {fault.parameter.partition(".")[0] for fault in plan.faults if isinstance(fault, Parameter)}
    model = job.model.with_effects(changed)
    schedule = Schedule(plan, model.values)
    require_sensible(plan, model)
    return [PlannedFault(fault.label, fault.kind, name_target(fault), (begin.cycle - plan.start) / RATE,
                         (end.cycle - plan.start) / RATE, describe_size(fault, model.values))
            for fault, begin, end in zip(plan.faults, schedule.edges[::2], schedule.edges[1::2], strict=True)]


def name_target(fault: Fault) -> str:
    """What a fault acts on: a parameter, a sensor, a frame, a node, or a COB-ID."""
    for key, words in (("parameter", "{}"), ("signal", "sensor {}"), ("frame", "frame {}"), ("node", "node {}"),
                       ("cob_id", "COB-ID 0x{:X}")):
        if hasattr(fault, key):
            return words.format(getattr(fault, key))
    return "frame sync" if isinstance(fault, Jitter) else "node controller"


def describe_size(fault: Fault, base: Mapping[str, float]) -> str:
    """How large a fault is, in words; `base` has the model's own parameters."""
    parts: list[str] = []
    match fault:
        case Parameter():
            quantity = find_quantity(fault.parameter)
            words = {number: word for word, number in quantity.words.items()}
            values = base[fault.parameter], fault.find_target(quantity)
            parts = [" to ".join(words.get(value) or format_amount(value, quantity.unit) for value in values)]
        case Offset() | Stuck():
            of_noise = " RMS" if isinstance(fault, Noise) else ""
            parts = ["its last reading" if fault.value is None else format_signal(fault.value, fault.signal) + of_noise]
        case Late():
            parts = [format_amount(fault.delay, "s")]
        case Corrupted():
            parts = [count_nouns(fault.bits, "bit")]
        case Short():
            parts = [f"{count_nouns(fault.length, 'byte')} left"]
        case Jitter():
            parts = [f"up to {format_amount(fault.size, 's')}"]
        case Foreign():
            parts = [f"{count_nouns(fault.frames, 'frame')} of {count_nouns(fault.length, 'byte')} in "
                     + ("every cycle" if fault.every == 1 else f"one of {fault.every} cycles")]
        case Reset():
            parts = [fault.reset]
    if isinstance(fault, Frames):
        parts.append("every frame" if fault.every == 1 else f"one of {fault.every} frames")
        parts += [f"with probability {fault.probability:g}"] if fault.probability < 1.0 else []
        parts += [f"at most {fault.count}"] if fault.count is not None else []
    ramp = getattr(fault, "ramp", 0.0)
    return ", ".join(parts) + (f" within {format_amount(ramp, 's')}" if ramp else "")
