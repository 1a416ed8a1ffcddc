"""A sequence before its run: command, load, and the run that a healthy actuator is predicted to make, as a report."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fdi.report import (
    Cell,
    Column,
    Line,
    Medium,
    Report,
    Section,
    Table,
    build_run_report,
    format_amount,
    tabulate,
    to_plain,
)
from fdi.trace import MAIN, CheckResult, Event, Trace
from plant import (
    Array,
    Model,
    Plant,
    Profile,
    count_nouns,
    find_divergence,
    find_quantity,
    make_columns_type,
    require,
    simulate,
)
from rig.run import Job, LimitReached, find_differences, find_limits
from rig.sequences import (
    Corrupted,
    Fault,
    Foreign,
    Frames,
    Guard,
    GuardWatch,
    Jitter,
    Late,
    Noise,
    Offset,
    Parameter,
    Reset,
    RunData,
    Short,
    Stuck,
)

OF_EVENTS = ("response_within", "shut_off", "recovers", "event_occurs", "event_never")  # without a bus no events


class Demand(NamedTuple):
    """A figure of the command or load beside the limit of the actuator. SI; `limit` is None where there is none."""

    name: str
    value: float
    unit: str
    shown: tuple[str, float]  # unit of tables, and how many of it an SI unit is
    t: float  # s of main, where it is reached
    section: str
    limit: float | None
    parameter: str  # what the limit comes from

    def describe(self, value: float) -> str:
        """A value of this figure in the unit of tables: "5 mm"."""
        return f"{self.show(value)} {self.shown[0]}"

    def show(self, value: float) -> str:
        """The number alone."""
        return f"{self.shown[1] * value:.4g}"

    @property
    def is_violated(self) -> bool:
        """Whether the sequence asks for more than the actuator can do."""
        return self.limit is not None and self.value > self.limit * (1.0 + 1e-9)


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


class DryRun(NamedTuple):
    """What a sequence asks for, and what it is predicted to do on a healthy actuator."""

    job: Job
    durations: dict[str, float]  # s, of setup, main and cleanup
    demands: list[Demand]
    faults: list[PlannedFault]  # that the run will inject
    predicted: Trace  # of setup, main and cleanup, without the faults; its events say when they act
    limits: tuple[LimitReached, ...]  # that the predicted run reaches
    checks: list[CheckResult]  # on the predicted run, those that need neither events nor faults
    not_predicted: list[str]  # the other checks
    trips: list[tuple[str, float]]  # guards that the predicted run violates, and when, s of main

    @property
    def problems(self) -> list[str]:
        """What violates a limit, in words; empty if the sequence can run."""
        signals = self.job.model.kind.signals
        return [*(f"{each.name} {each.describe(each.value)} beyond {each.describe(each.limit)} ({each.parameter}) in "
                  f"{each.section!r}, t = {each.t:.3f} s"
                  for each in self.demands if each.limit is not None and each.is_violated),
                *(each.describe(signals) for each in self.limits
                  if each.frame or each.signal == signals.controlled.name),
                *(f"guard {name!r} violated at t = {t:.3f} s" for name, t in self.trips),
                *(f"check {check.name!r}: {check.detail}" for check in self.checks if check.value != check.value)]


def make_dry_run(job: Job) -> DryRun:
    """Hold the command and load of a job against the model's limits, and simulate it without bus and faults.

    Raises:
        InputError: a fault that contradicts the model's parameters, or a plant that diverges.
    """
    faults = plan_faults(job)
    sequence, model = job.sequence, job.model
    setup, main = sequence.build_setup_profile(), sequence.build_main_profile()
    phases = {"setup": setup, "main": main, "cleanup": sequence.build_cleanup_profile(main.end)}
    command = np.concatenate([profile.command for profile in phases.values()])
    first, last = len(setup.command), len(setup.command) + len(main.command)
    load = np.zeros(len(command))
    load[first:last] = sequence.build_load_profile()
    rate = sequence.rate
    t = (np.arange(len(command)) - first) / rate
    prediction = simulate(model, command, load, job.seed)
    diverged = find_divergence(model, prediction._asdict())
    require(not diverged, model.name, "", f"a plant that stays finite; {diverged}, counted from the start of set-up")
    signals = model.kind.signals
    columns = make_columns_type(signals)(np.arange(last - first) / rate,
                                         *(column[first:last] for column in prediction[1:]))
    run = RunData(columns, sequence.sections(), starts=sequence.fault_starts(), rate=rate, signals=signals)
    not_predicted = [check.name for check in sequence.checks if check.kind in OF_EVENTS
                     and (sequence.faults or not getattr(check, "signal", None))]
    checks = [check.judge(run) for check in sequence.checks if check.name not in not_predicted]
    trace = replace(Trace.from_columns(prediction._asdict(), 1 / rate, {}, signals), t=t, checks=tuple(checks),
                    phase=np.searchsorted((first, last), np.arange(len(t)), side="right"), events=tuple(
                        Event(at, "INFO", "fault", f"{fault.name} {word}") for fault in faults
                        for at, word in ((fault.t0, "begins"), (fault.t1, "ends"))))
    return DryRun(
        job=job, durations={phase: len(profile.command) / rate for phase, profile in phases.items()},
        demands=measure_demands(command, load, t, name_rows(phases), model, rate), faults=faults, predicted=trace,
        limits=find_limits(lambda name: getattr(prediction, name), model, job.bench, first), checks=checks,
        not_predicted=not_predicted,
        trips=[] if sequence.faults else [*find_trips(sequence.guards, run)])


def name_rows(phases: Mapping[str, Profile]) -> list[tuple[int, str]]:
    """First row of each section of setup, main and cleanup, and its name."""
    sections, start = [], 0
    for phase, profile in phases.items():
        sections += [(start + section.start, section.name if phase == "main" else f"{phase}: {section.name}")
                     for section in profile.sections]
        start += len(profile.command)
    return sections


def measure_demands(command: Array, load: Array, t: Array, sections: Sequence[tuple[int, str]],
                    model: Model, rate: float) -> list[Demand]:
    """The largest position, step, speed and acceleration of a command, and the largest load.

    A jump at the first row of a section is a step and counts neither as speed nor as acceleration.
    """
    starts = [row for row, _ in sections]
    speed, jumps = split_jumps(command, starts, rate)
    is_start = np.isin(np.arange(len(command)), starts)
    is_known = ~is_start & ~np.roll(is_start, 1)  # rows whose speed and the one before are of the same section
    acceleration = np.where(is_known, np.diff(speed, prepend=0.0) * rate, 0.0)
    limits, signals = find_capabilities(model), model.kind.signals
    unit, shown = signals.command.unit, (signals.command.shown_unit, signals.command.shown_scale)
    motion_name = "position" if unit == "m" else signals.controlled.phrase

    def find(name: str, values: Array, unit: str, shown: tuple[str, float], parameter: str, back: int = 0) -> Demand:
        row = int(np.argmax(np.abs(values)))
        section = sections[int(np.searchsorted(starts, max(row - back, 0), side="right")) - 1][1]
        return Demand(name, float(np.abs(values[row])), unit, shown, float(t[row]), section, limits.get(parameter),
                      parameter)

    return [find(motion_name, command, unit, shown, signals.controlled.limit), find("step", jumps, unit, shown, ""),
            # from the row before, which may be another section's
            find("speed", speed, f"{unit}/s", (f"{shown[0]}/s", shown[1]), "no-load speed", back=1),
            find("acceleration", acceleration, f"{unit}/s2", (f"{unit}/s2", 1.0), ""),
            *([] if signals.load is None else [
                find("load", load, signals.load.unit, (signals.load.shown_unit, signals.load.shown_scale),
                     "stall force")])]


def split_jumps(command: Array, starts: Sequence[int], rate: float) -> tuple[Array, Array]:
    """Speed of a command in m/s, 0 at its jumps; and its jumps in m, 0 elsewhere. Shape (n,) both.

    A jump is a change at the first row of a section, `starts`, that is larger than the changes beside it: else the line
    goes on from the section before.
    """
    steps = np.diff(command, prepend=command[:1])
    beside = np.maximum(np.abs(np.roll(steps, 1)), np.abs(np.roll(steps, -1)))
    is_jump = np.isin(np.arange(len(command)), starts) & (np.abs(steps) > 2.0 * beside + 1e-9)
    return np.where(is_jump, 0.0, steps * rate), np.where(is_jump, steps, 0.0)


def find_capabilities(model: Model) -> dict[str, float]:
    """What the actuator can do, SI, as far as its plant has the parameters.

    The no-load speed is the flow of the open valve over the area of the piston, GQ XSM / AJ; the stall force is the
    supply pressure on that area, PSR AJ (physics.md).
    """
    values, limit = model.values, model.kind.signals.controlled.limit
    capabilities = {limit: values[limit]} if limit else {}
    if {"valve.flow_gain", "spool.travel"} <= values.keys():
        capabilities |= {"no-load speed": model["valve.flow_gain"] * model["spool.travel"] / model["jack.area"],
                         "stall force": model["supply.pressure"] * model["jack.area"]}
    return capabilities


def find_trips(guards: Sequence[Guard], run: RunData) -> Iterator[tuple[str, float]]:
    """The guards that the predicted main phase violates, and when, s."""
    for guard in guards:
        watch, values = GuardWatch([guard]), run.read_signal(guard.signal, slice(0, len(run.trace.t))).tolist()
        is_violated = [watch.find_passed({guard.signal: value}) is not None for value in values]
        if any(is_violated):
            yield guard.name, float(run.trace.t[is_violated.index(True)])


def plan_faults(job: Job) -> list[PlannedFault]:
    """The faults of a run with the seed of the job, in the order of the sequence.

    Raises:
        InputError: values that contradict other parameters of the job's model.
    """
    model, plan = job.scenario.model, job.scenario.plan
    edges = job.scenario.make_schedule().edges
    return [PlannedFault(fault.label, fault.kind, name_target(fault), (begin.cycle - plan.start) / plan.rate,
                         (end.cycle - plan.start) / plan.rate, describe_size(fault, model.values, model.kind))
            for fault, begin, end in zip(plan.faults, edges[::2], edges[1::2], strict=True)]


def name_target(fault: Fault) -> str:
    """What a fault acts on: a parameter, a sensor, a frame, a node, or a COB-ID."""
    for key, words in (("parameter", "{}"), ("signal", "sensor {}"), ("frame", "frame {}"), ("node", "node {}"),
                       ("cob_id", "COB-ID 0x{:X}")):
        if hasattr(fault, key):
            return words.format(getattr(fault, key))
    return "frame sync" if isinstance(fault, Jitter) else "node controller"


def describe_size(fault: Fault, base: Mapping[str, float], kind: Plant) -> str:
    """How large a fault of a plant is, in words; `base` has the model's own parameters."""
    parts: list[str] = []
    match fault:
        case Parameter():
            quantity = find_quantity(fault.parameter, plant=kind.key)
            words = {number: word for word, number in quantity.words.items()}
            values = base[fault.parameter], fault.find_target(quantity)
            parts = [" to ".join(words.get(value) or format_amount(value, quantity.unit) for value in values)]
        case Offset() | Stuck():
            of_noise = " RMS" if isinstance(fault, Noise) else ""
            unit = kind.signals.find(fault.signal).unit
            parts = ["its last reading" if fault.value is None else format_amount(fault.value, unit) + of_noise]
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
        parts += ["every frame" if fault.every == 1 else f"one of {fault.every} frames",
                  *([f"with probability {fault.probability:g}"] if fault.probability < 1.0 else []),
                  *([f"at most {fault.count}"] if fault.count is not None else [])]
    ramp = getattr(fault, "ramp", 0.0)
    return ", ".join(parts) + (f" within {format_amount(ramp, 's')}" if ramp else "")


def build_dry_run_report(dry: DryRun, files: Sequence[tuple[str, str]] = ()) -> Report:
    """Report on a dry run; `files` are (label, path) of the files written."""
    sequence = dry.job.sequence
    problems, data = dry.problems, collect_data(dry)
    sentence = "The actuator can follow this sequence."
    if problems:
        sentence = "; ".join(problems)
    elif all(demand.limit is None for demand in dry.demands):
        sentence = "The plant declares no limit of its motion: the predicted error tells whether it can follow."
    parts = [f"{name} {seconds:g} s" for name, seconds in dry.durations.items() if seconds]
    duration = f"{sum(dry.durations.values()):g} s: {', '.join(parts)}"
    facts = [("model", dry.job.model.name), ("differs from nominal", data["differences"]),
             ("checks", str(len(sequence.checks))), ("guards", str(len(sequence.guards))),
             *([("steps in Python", ", ".join(f"{step.python} {step.when}" for step in sequence.steps))]
               if sequence.steps else [])]
    run_sections = {section.title: section for section in build_run_report(dry.predicted).sections}
    return Report(
        command="check", title=f"Dry run: {sequence.title}", verdict=data["verdict"],
        mood="bad" if problems else "good", sentence=sentence, facts=facts, notes=_list_notes(dry),
        sections=[Section("Command and load", [Line("duration", duration), *_tabulate_demands(dry.demands)]),
                  Section("Faults", _tabulate_faults(dry.faults)),
                  Section("Predicted run", describe_prediction(dry)),
                  *(run_sections[title] for title in ("Checks", "Failed checks", "Signals"))],
        files=files, data=data)


def _list_notes(dry: DryRun) -> list[str]:
    length, half_a_cycle = dry.durations["main"], 0.5 / dry.job.sequence.rate
    lists = {"not predicted, because they judge events or what a fault causes": dry.not_predicted,
             "these checks would fail on the predicted run": [
                 check.name for check in dry.checks if not check.passed and check.value == check.value]}
    return [*(["the prediction is without the faults of the sequence"] if dry.job.sequence.faults else []),
            *(f"fault {fault.label!r} ends with main at {length:g} s, not at {fault.end:g} s"
              for fault in dry.job.sequence.faults if fault.end is not None and fault.end > length + half_a_cycle),
            *(f"{words}: {', '.join(names)}" for words, names in lists.items() if names)]


def _tabulate_demands(demands: Sequence[Demand]) -> list[Table]:
    return [tabulate(
        [each for each in demands if each.value >= 1e-9],
        (Column("largest"), lambda each: each.name),
        (Column("value", align="right"),
         lambda each: Cell(each.show(each.value), "bad" if each.is_violated else "", True)),
        (Column("limit", align="right"), lambda each: "" if each.limit is None else each.show(each.limit)),
        (Column("unit"), lambda each: each.shown[0]),
        (Column("limit from"), lambda each: "" if each.limit is None else each.parameter),
        (Column("section"), lambda each: each.section), (Column("t", "s", "right"), lambda each: f"{each.t:.3f}"),
        caption="A jump between two sections is a step and counts neither as speed nor as acceleration.")]


def _tabulate_faults(faults: Sequence[PlannedFault]) -> list[Table]:
    return [tabulate(
        faults,
        (Column("fault"), lambda each: each.name), (Column("kind", medium=Medium.PAGE), lambda each: each.kind),
        (Column("target"), lambda each: each.target),
        (Column("from", "s", "right"), lambda each: f"{each.t0:.3f}"),
        (Column("to", "s", "right"), lambda each: f"{each.t1:.3f}"),
        (Column("duration", "s", "right", Medium.PAGE), lambda each: f"{each.duration:.3f}"),
        (Column("size"), lambda each: each.size),
        caption="Times count from the start of main; all faults end with it.")]


def describe_prediction(dry: DryRun) -> list[Line]:
    """The figures of the predicted run: drive, following error, limits that it reaches."""
    run, signals = dry.predicted, dry.job.model.kind.signals
    error, drive = (run.command - run.controlled)[run.phase == MAIN], signals.drive
    limit = dry.job.model.values.get(drive.limit)
    scale, unit = drive.shown_scale, drive.shown_unit
    most = f" of {scale * limit:.3g} {unit}" if limit else ""
    drive_line = Line(drive.phrase, f"largest {scale * np.abs(run.drive).max():.3g} {unit}{most}")
    scale, unit = signals.controlled.shown_scale, signals.controlled.shown_unit
    return [drive_line,
            Line("error", f"largest {scale * np.abs(error).max():.4g} {unit}, RMS "
                          f"{scale * np.sqrt(np.mean(error ** 2)):.4g} {unit} in main"),
            *([Line("reaches", "; ".join(each.describe(signals) for each in dry.limits))] if dry.limits else [])]


def collect_data(dry: DryRun) -> dict[str, Any]:
    """The JSON answer of a dry run."""
    run = dry.predicted
    return {
        "verdict": "BEYOND_LIMITS" if dry.problems else "WITHIN_LIMITS", "problems": dry.problems,
        "sequence": dry.job.sequence.title, "model": dry.job.model.name,
        "differences": find_differences(dry.job)["text"], "durations": dry.durations,
        "faults": [{**each._asdict(), "duration": each.duration} for each in dry.faults],
        "demands": [{key: value for key, value in each._asdict().items() if key != "shown"}
                    | {"violated": each.is_violated} for each in dry.demands],
        "predicted": {"current": float(np.abs(run.drive).max()),
                      "error": float(np.abs(run.command - run.controlled).max()),
                      "limits": [each._asdict() for each in dry.limits],
                      "guards": [{"name": name, "t": t} for name, t in dry.trips]},
        "checks": [to_plain(check.collect_data()) for check in dry.checks], "not_predicted": dry.not_predicted}
