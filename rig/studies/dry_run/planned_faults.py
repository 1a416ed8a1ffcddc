"""The faults that a sequence will inject: when each acts, on what, and how large it is."""
from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from fdi.report.numbers import count_nouns, format_amount, format_signal
from plant.model import find_quantity
from plant.quantity import Quantity
from plant.segments import RATE
from rig.run.job import Job
from rig.sequences.fault_parameters import require_sensible
from rig.sequences.faults import (
    BusOff,
    Corrupted,
    Duplicated,
    Fault,
    Foreign,
    Jitter,
    Late,
    Lost,
    Noise,
    Offset,
    Parameter,
    Reset,
    Schedule,
    Short,
    Silent,
    Stuck,
)


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
    match fault:
        case Parameter():
            return fault.parameter
        case Offset() | Stuck():
            return f"sensor {fault.signal}"
        case Lost() | Late() | Duplicated() | Corrupted() | Short():
            return f"frame {fault.frame}"
        case Jitter():
            return "frame sync"
        case Foreign():
            return f"COB-ID 0x{fault.cob_id:X}"
        case BusOff() | Silent():
            return f"node {fault.node}"
        case Reset():
            return "node controller"
    raise AssertionError(fault)


def describe_size(fault: Fault, base: Mapping[str, float]) -> str:
    """How large a fault is, in words; `base` has the model's own parameters."""
    match fault:
        case Parameter():
            quantity = find_quantity(fault.parameter)
            change = " to ".join(_format_parameter(value, quantity) for value in (
                base[fault.parameter], fault.find_target(quantity)))
            return change + _describe_ramp(fault.ramp)
        case Noise():
            return f"{format_signal(fault.value, fault.signal)} RMS{_describe_ramp(fault.ramp)}"
        case Offset():
            return format_signal(fault.value, fault.signal) + _describe_ramp(fault.ramp)
        case Stuck():
            return "its last reading" if fault.value is None else format_signal(fault.value, fault.signal)
        case Lost() | Duplicated():
            return _describe_frames(fault)
        case Late():
            return f"{format_amount(fault.delay, 's')}, {_describe_frames(fault)}"
        case Corrupted():
            return f"{count_nouns(fault.bits, 'bit')}, {_describe_frames(fault)}"
        case Short():
            return f"{count_nouns(fault.length, 'byte')} left, {_describe_frames(fault)}"
        case Jitter():
            return f"up to {format_amount(fault.size, 's')}"
        case Foreign():
            return f"{count_nouns(fault.frames, 'frame')} of {count_nouns(fault.length, 'byte')} in " + (
                "every cycle" if fault.every == 1 else f"one of {fault.every} cycles")
        case Reset():
            return fault.reset
    return ""


def _describe_frames(fault: Lost | Late | Duplicated | Corrupted | Short) -> str:
    """Which frames a fault hits: "one of 10, each with probability 0.2, at most 3"."""
    parts = ["every frame" if fault.every == 1 else f"one of {fault.every} frames"]
    parts += [f"with probability {fault.probability:g}"] if fault.probability < 1.0 else []
    parts += [f"at most {fault.count}"] if fault.count is not None else []
    return ", ".join(parts)


def _describe_ramp(seconds: float) -> str:
    return f" within {format_amount(seconds, 's')}" if seconds else ""


def _format_parameter(value: float, quantity: Quantity) -> str:
    word = next((word for word, number in quantity.words.items() if number == value), "")
    return word or format_amount(value, quantity.unit)
