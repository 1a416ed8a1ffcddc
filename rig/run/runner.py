"""Runs one job (nodes and bus, log, session, checks), and its outcome: verdict, checks, timing, verdict.json."""

import contextlib
import fcntl
import hashlib
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.output import write_text
from fdi.progress import Progress
from fdi.report import to_plain
from fdi.trace import CheckResult, Event, Trace
from plant import (
    Actuator,
    Array,
    InputError,
    Model,
    Signals,
    build_bare_model,
    count_nouns,
    make_columns_type,
    report_system_error,
)
from rig.benches import Bench, Flags, Role
from rig.network import NAMES, PLANT, CycleRecord, Identity, WallClock
from rig.recorder import Observer, Recorder, collect_provenance, read_epoch_ns
from rig.run.attribution import Attribution, Cause, CycleRecords, attribute, count_most_in_a_row, find_injected
from rig.run.bring_up import compile_loop
from rig.run.frame_steps import find_visible_steps
from rig.run.job import Job, find_differences
from rig.run.loop import History, Loop
from rig.run.participants import open_participants
from rig.run.priority import (
    LOOP_PRIORITY,
    PERCENTILES,
    compute_percentiles,
    enter_real_time,
    name_scheduler,
)
from rig.run.session import MAIN, SETUP, Session
from rig.sequences import (
    HEARTBEAT,
    NO_METROLOGY,
    Mask,
    Metrology,
    SkippedCheck,
    StepRun,
    collect_metrology,
    evaluate_checks,
    find_skipped,
    judge_protocol,
)

STATUS_OF_VERDICT = {"PASS": 0, "NOT_JUDGED": 0, "FAIL": 1, "CANNOT_TELL": 1, "ABORTED": 1, "INVALID_TIMING": 3}
INTERRUPTED = 130


class LimitReached(NamedTuple):
    """A limit that a run reached: of the model, on either side of zero, or an end of what a frame can hold."""

    parameter: str  # of the model: the limit; "" of a frame
    signal: str
    limit: float  # SI
    t: float  # s of main, when it was reached first
    seconds: float  # how long the signal was there, in all
    frame: str = ""  # in which the signal may have been cut off

    def describe(self, signals: Signals) -> str:
        """The limit in words, such as "ram at its stop (40 mm) for 120 ms, first at t = 1.250 s"."""
        signal = signals.find(self.signal)
        words = f"{signal.phrase} at " + (f"the end of its range in frame {self.frame}" if self.frame else
                                          "its limit" if signal.role == "drive" else "its stop")
        unit_signal = signals.controlled if signal.unit == signals.controlled.unit else signal
        return (f"{words} ({unit_signal.shown_scale * self.limit:.3g} {unit_signal.shown_unit}) for "
                f"{1e3 * self.seconds:.0f} ms, first at t = {self.t:.3f} s")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A finished run."""

    job: Job
    folder: Path
    checks: Sequence[CheckResult]
    events: Sequence[Event]
    aborted: str  # why main ended early, or ""
    safe: bool  # the safe state was entered
    interrupted: bool
    timing: dict[str, Any]
    counters: dict[str, int]
    speed: float  # multiple of real time, of the cycles alone
    attribution: Attribution
    start_times: Mapping[Role, float]  # s from NMT start to OPERATIONAL
    identities: Mapping[Role, Identity]
    skipped: Sequence[SkippedCheck] = ()  # they do not apply to the bench
    limits: Sequence[LimitReached] = ()  # of travel and current, that the run reached
    fdi: dict[str, Any] = field(default_factory=dict)  # diagnosis of `rig fdi`, if it was requested
    metrology: Metrology = NO_METROLOGY
    started_ns: int = 0  # since 1970

    @property
    def verdict(self) -> str:
        """PASS, FAIL, CANNOT_TELL, INVALID_TIMING, ABORTED or NOT_JUDGED.

        If the bench itself was late, the controller is not judged. Without checks in the sequence nothing says what
        the actuator should have done: then the protocol checks can fail a run, but not pass it.
        """
        if self.timing_problem and not self.interrupted:
            return "INVALID_TIMING"
        if self.aborted:
            return "ABORTED"
        if self.failures:
            return "FAIL"
        if self._list_checks("CANNOT_TELL") or self.cut_off:
            return "CANNOT_TELL"
        # Whether anything says what the actuator should do: a check, the end of the sequence, or `rig fdi`.
        sequence = self.job.sequence
        is_judged = sequence.checks or sequence.ends == "safe_state" or self.fdi.get("verdict") == "ACCEPTABLE"
        return "PASS" if is_judged else "NOT_JUDGED"

    @property
    def failures(self) -> list[str]:
        """The checks that failed, an end other than the one the sequence requires, and the faults found."""
        is_unsafe = self.job.sequence.ends == "safe_state" and not self.safe
        return [*(check.name for check in self._list_checks("FAIL")),
                *(["the run did not end in the safe state"] if is_unsafe else []),
                *([f"rig fdi: {self.fdi['sentence'].rstrip('.')}"] if has_fault(self.fdi) else [])]

    @property
    def cut_off(self) -> list[str]:
        """Signals that their frames cut off, in words, but those that a fault of the sequence changes."""
        return [each.describe(self.job.bench.signals) for each in self.limits if each.frame and each.signal not in {
            getattr(fault, "signal", "") for fault in self.job.sequence.faults}]

    def _list_checks(self, verdict: str) -> list[CheckResult]:
        return [check for check in self.checks if check.verdict == verdict]

    @property
    def timing_problem(self) -> str:
        """Why the bench itself was too late to judge the controller; empty if it was not."""
        cause = self.attribution.cause
        if cause is not None and cause.is_lateness:
            return self.describe_cause()
        if cause is not None and cause.is_gone and self.aborted:
            return ""  # a dead node is no matter of timing
        if self.job.realtime and (problem := self._find_excess()):
            return problem
        if self.aborted or not self.failures:
            return ""
        failed_checks = self._list_checks("FAIL")
        is_fault_found = has_fault(self.fdi)
        is_affected = (len(failed_checks) + is_fault_found == len(self.failures)
                       and all(map(self._is_affected, failed_checks))
                       and (not is_fault_found or bool(self.attribution.affected.any())))
        if self.attribution.by_bench or is_affected:
            return (f"the bench was late, and the checks that failed depend on it: {'; '.join(self.failures)}; "
                    f"{self._describe_first_lateness()}")
        return ""

    def _find_excess(self) -> str:
        """Whether there were more overruns than the sequence accepts, up to the first cause of trouble; in words."""
        policy, overruns = self.job.sequence.timing, self.attribution.overruns.copy()
        overruns[:round(policy.grace * self.job.bench.rate)] = 0
        if self.attribution.cause is not None and self.aborted:
            overruns = overruns[:self.attribution.cause.cycle]
        total, most, cycles = int(overruns.sum()), policy.most_in_a_row, self.timing["cycles"]
        if self.job.max_overruns < 1 and total > self.job.max_overruns * cycles:
            # a run that skipped periods has more overruns than cycles
            excess = (f"{count_nouns(total, 'overrun')} in {count_nouns(cycles, 'cycle')}, "
                      f"more than {100 * self.job.max_overruns:g} %:")
        elif most is not None and (in_a_row := count_most_in_a_row(overruns)) > most:
            excess = f"{count_nouns(in_a_row, 'overrun')} in a row, limit {most}:"
        else:
            return ""
        return (f"the bench itself was late: {excess} the controller cannot be judged; "
                f"{self._describe_first_lateness()}")

    def _is_affected(self, check: CheckResult) -> bool:
        """Whether a check saw rows that lateness of the bench changed, or the heartbeats of a bench that was late."""
        if check.signal == HEARTBEAT:
            return self._is_plant_off
        first, last = (0.0 if np.isnan(t) else t for t in (check.t0, check.t1))
        start, rate = self.job.scenario.plan.start, self.job.bench.rate
        rows = slice(start + round(first * rate), start + round(last * rate) if last > first else None)
        return bool(self.attribution.affected[rows].any())

    @property
    def _is_plant_off(self) -> bool:
        """Whether the heartbeat period of the plant, a part of the bench, is wrong: then others' prove nothing."""
        return any(check.signal == HEARTBEAT and check.name.endswith(NAMES[PLANT]) and not check.passed
                   for check in self.checks)

    def _describe_first_lateness(self) -> str:
        first = min(self.attribution.disturbances, key=lambda each: each.first, default=None)
        if first is None:
            return "the plant's own heartbeat was not on time" if self._is_plant_off else ""
        return f"first t = {self.find_time(first.first):.3f} s: {first.text}"

    def find_time(self, cycle: int) -> float:
        """The time of a cycle, s of main."""
        return (cycle - self.job.scenario.plan.start) / self.job.bench.rate

    def describe_cause(self) -> str:
        """The first cause with its time, and what followed from it; empty if there was no trouble."""
        cause = self.attribution.cause
        if cause is None:
            return ""
        if cause.text == self.aborted and not self.attribution.consequences:
            return self.aborted
        consequences = [f"{trouble.text} at {self.find_time(cycle):.3f} s"
                        for cycle, trouble in self.attribution.consequences[:4]]
        text = f"t = {self.find_time(cause.cycle):.3f} s: {cause.text}"
        return f"{text}; then: {', '.join(consequences)}" if consequences else text

    @property
    def why(self) -> str:
        """The reason of a verdict other than PASS, in words, and the calibrations that do not hold."""
        pass_count = sum(check.passed for check in self.checks)
        words = {"NOT_JUDGED": f"the sequence has no checks; {pass_count} protocol checks passed",
                 "FAIL": "; ".join(self.failures), "INVALID_TIMING": self.timing_problem,
                 "CANNOT_TELL": "too uncertain for a verdict: " + "; ".join(
                     [*(check.name for check in self._list_checks("CANNOT_TELL")), *self.cut_off]),
                 "ABORTED": self.describe_cause() or self.aborted}
        reason, problems = words.get(self.verdict, ""), list(self.metrology.problems.values())
        return "; ".join([reason or "every check passed", *problems] if problems else [reason])

    @property
    def status(self) -> int:
        """Exit status of `rig run`."""
        return INTERRUPTED if self.interrupted else STATUS_OF_VERDICT[self.verdict]

    def to_json(self) -> dict[str, Any]:
        """The content of `rig run --json` and verdict.json; null for NaN and infinity."""
        events, omissions = select_events(self.events)
        return {"verdict": self.verdict, "trace": str(self.folder / "trace.mcap"), "why": self.why,
                "checks": [to_plain(check.collect_data()) for check in self.checks],
                "not_applicable": [check._asdict() for check in self.skipped],
                "timing": self.timing, "counters": self.counters, "speed": round(self.speed, 2),
                **self._attribution_to_json(), "differences": find_differences(self.job),
                "decision": self.metrology.decision, "calibration": {
                    name: each.to_json(self.started_ns) for name, each in self.metrology.calibration.items()},
                "limits": [limit._asdict() for limit in self.limits],
                "nodes": {str(self.job.bench.find_number(role)): {
                    "name": NAMES[role], "identity": vars(self.identities[role]),
                    "operational_ms": round(1e3 * self.start_times[role], 1) if role in self.start_times else None}
                    for role in sorted(self.identities)},
                "events": [to_plain(event._asdict()) for event in events], "events_omitted": omissions,
                "run": self.job.list_settings(), "fdi": self.fdi}

    def _attribution_to_json(self) -> dict[str, Any]:
        attribution, cause = self.attribution, self.attribution.cause
        cause_data = None if cause is None else {
            "source": self._name_source(cause), "kind": cause.kind, "t": self.find_time(cause.cycle),
            "cycle": cause.cycle, "text": cause.text, "evidence": list(cause.evidence)}
        consequences = [{"t": self.find_time(cycle), "source": self._name_node(trouble.node), "kind": trouble.kind,
                         "text": trouble.text} for cycle, trouble in attribution.consequences]
        return {"cause": cause_data, "consequences": consequences[:100], "judged": {
            "cycles": len(attribution.judged), "judged": int(attribution.judged.sum()), "invalid": attribution.invalid,
            "overruns": int(attribution.overruns.sum()),
            "lateness": [{"t": self.find_time(each.first), "cycle": each.first, "last": each.last,
                          "source": self._name_node(each.source), "text": each.text}
                         for each in attribution.disturbances[:100]]}}

    def _name_source(self, cause: Cause) -> str:
        """Who a cause names: a node, "sequence" for a fault of the sequence, "bench", else the kind of the trouble."""
        if cause.kind == "injected":
            return "sequence"
        if cause.is_lateness and cause.source == 0:
            return "bench"
        return self._name_node(cause.source) or cause.kind

    def _name_node(self, number: int) -> str:
        return self.job.bench.describe_node(Role(number)) if number else ""

    def describe_attribution(self) -> dict[str, str]:
        """First cause and consequences as they stand in the log; evidence and consequences are JSON."""
        attribution = self._attribution_to_json()
        cause = attribution["cause"]
        return {"t": f"{cause['t']:.3f}", "source": cause["source"], "text": cause["text"],
                "evidence": json.dumps(cause["evidence"]), "consequences": json.dumps(attribution["consequences"])}

    def format_json(self) -> str:
        """The text of verdict.json, whose SHA-256 stands in the log."""
        return json.dumps(self.to_json(), indent=1) + "\n"


def select_events(events: Sequence[Event], most: int = 200) -> tuple[list[Event], dict[str, int]]:
    """The first `most` events of each kind, in order, and how many of each kind are omitted; the log has them all."""
    counts: Counter[str] = Counter()
    selection = []
    for event in events:
        counts[event.kind] += 1
        if counts[event.kind] <= most:
            selection.append(event)
    return selection, {kind: count - most for kind, count in counts.items() if count > most}


def summarise_timing(history: History, loop: Loop, scheduler: str, kind: str, reason: str = "") -> dict[str, Any]:
    """Percentiles of lateness, response and execution in us, as `rig run --json` gives them.

    `kind`: "lockstep", "hard real time" (the cycle is compiled code) or "soft real time" (the cycle is Python).
    `reason`: which cycles are Python in real time, and why.
    """
    times = {name: compute_percentiles(history.column(name)) for name in ("execution", "lateness", "response")}
    return {"kind": kind, "reason": reason, "cycles": len(history), "overruns": loop.overruns,
            "underruns": loop.underruns, "scheduler": scheduler,
            **{f"{name}_us": {key: round(percentiles[key], 1) if percentiles else None for key in PERCENTILES}
               for name, percentiles in times.items()}}


NEAR_A_STOP = 5.0  # standard deviations of the sensor's noise from a stop within which a reading is at it


def find_limits(column: Callable[[str], Array], model: Model, bench: Bench, zero: int) -> tuple[LimitReached, ...]:
    """The limits that the signals of a run reached.

    Args:
        column: gives a signal of all cycles, SI; NaN for missing samples.
        model: its travels, current limit, cycle and sensor noise.
        bench: its frames, which cut off what they cannot hold.
        zero: the cycle in which main starts.
    """
    signals, period = model.kind.signals, model["controller.period"]
    margins = {s: NEAR_A_STOP * model.values.get(s.noise, 0.0) for s in signals.outputs
               if s.unit == signals.controlled.unit}
    margins[signals.drive] = 2.5e-6 * model.values.get(signals.drive.limit, 0.0)  # two counts of the drive frame
    # parameter, signal, limit, frame, values at and below which and at and above which it is reached
    bounds = [(s.limit, s.name, limit, "", margin - limit, limit - margin) for s, margin in margins.items()
              if (limit := model.values.get(s.limit)) is not None]  # the plant declares one
    bounds += [bound for frame, name, low, high in bench.list_ranges("output", "load")
               for bound in (("", name, low, frame, low, np.inf), ("", name, high, frame, -np.inf, high))]
    return tuple(LimitReached(parameter, name, limit, (int(rows[0]) - zero) * period, len(rows) * period, frame)
                 for parameter, name, limit, frame, low, high in bounds
                 if len(rows := np.flatnonzero((column(name) <= low) | (column(name) >= high)))
                 and limit)  # an unsigned number is also 0 at rest


FDI_FAILS = ("MAINTENANCE", "NON_NOMINAL", "SOMETHING_ELSE")  # verdicts of rig fdi that fail a run


def diagnose_run(trace: Trace, job: Job, progress: Progress, workers: int = 2) -> dict[str, Any]:
    """The answer of `rig fdi --json` on the main phase of a run, against a nominal unit of its plant.

    A phase that cannot be judged, for example a short one, gives CANNOT_TELL with the reason. `workers`: threads.
    """
    from fdi.diagnosis.diagnosis import diagnose  # here: loads the compiler, which other runs do not need
    from fdi.report import collect_diagnosis_data

    kind = job.model.kind
    nominal = build_bare_model(kind.key).with_effects(kind.has)
    steps = find_visible_steps(nominal, job.bench.find_count(kind.signals.controlled.word))
    try:
        diagnosis = diagnose(trace, nominal.replace(steps), progress=progress, source=trace.provenance["source"],
                             workers=workers)
    except InputError as error:
        return {"verdict": "CANNOT_TELL", "sentence": f"not judged: {error}"}
    return dict(to_plain(collect_diagnosis_data(diagnosis)))


def has_fault(answer: Mapping[str, Any]) -> bool:
    """Whether a diagnosis found a fault beyond acceptable, or another deviation."""
    return answer.get("verdict") in FDI_FAILS


def describe_faults(answer: Mapping[str, Any], *levels: str) -> str:
    """Level and size of each fault with its interval, in words; with `levels` only of faults at one of these.

    "" if there is none, or the trace could not be judged.
    """
    if not answer.get("level"):
        return ""
    from fdi.report import list_found_faults

    return "; ".join(f"{fault.name} {fault.level}, {fault.size}" for fault in list_found_faults(answer)
                     if not levels or fault.level in levels)


def describe_finding(answer: Mapping[str, Any]) -> str:
    """What a diagnosis found beyond acceptable, in a few words: the faults with their sizes, else its verdict."""
    return f"rig fdi: {describe_faults(answer, 'maintenance', 'non-nominal') or answer['verdict']}"


Diagnose = Callable[[Trace], dict[str, Any]]


def run_job(job: Job, folder: Path, progress: Progress, stop: Callable[[], bool],
            diagnose: Diagnose | None = None, observer: Observer | None = None) -> Outcome:
    """Run a job; its log and verdict are written to `folder`, before the nodes that it started are stopped.

    Args:
        job: what to run.
        folder: of the results.
        progress: called with each stage and the share done, 0 to 1.
        stop: whether the operator asks to stop.
        diagnose: gives the answer of `rig fdi --json` on the main phase, called when the run has ended; None: not asked
            for.
        observer: who hears of the events, as they are written.

    Raises:
        RigError: bad input, an error in the user's Python code, a missing bus or node, or a log that cannot be
            written. The log is closed first.
    """
    if job.plant != "external":  # here, where an effect that cannot be compiled is still reported as bad input
        Actuator(job.scenario.model).warm()
    compile_loop(job)
    with lock_folder(folder):
        try:
            _play_steps(job, folder, "before", "")
            with open_participants(job) as (wire, processes):
                epoch_ns = read_epoch_ns() - wire.clock.now()
                with (open_recorder(job, folder, epoch_ns, observer) as recorder,
                      contextlib.closing(Session(job, wire, processes, recorder, progress, stop)) as session):
                    outcome = play_job(job, folder, session, recorder, progress, diagnose)
                write_text(folder / "verdict.json", outcome.format_json())
        except BaseException:
            with contextlib.suppress(InputError):  # the exception of the run comes first
                _play_steps(job, folder, "after", "")
            raise
        _play_steps(job, folder, "after", outcome.verdict)
    return outcome


def _play_steps(job: Job, folder: Path, when: str, verdict: str) -> None:
    """Play the user's steps before or after the run, whatever happens in it."""
    run = StepRun(job.sequence.title, folder, job.seed, job.list_settings(), verdict)
    for step in job.sequence.steps:
        if step.when == when:
            step.call(run)


def play_job(job: Job, folder: Path, session: Session, recorder: Recorder, progress: Progress,
             diagnose: Diagnose | None = None) -> Outcome:
    """Play the session of a job and judge it. Raises RigError."""
    progress("bring-up", 0.0)
    session.bring_up()
    loop = session.stage.playing
    stopwatch = WallClock()
    # where the loop is hard, Python only has to keep up: the cycle's thread is above it
    priority = 1 if loop.kind == "hard" else LOOP_PRIORITY
    with enter_real_time(priority) if job.realtime else contextlib.nullcontext():
        session.run_phases()
        scheduler = loop.scheduler or name_scheduler()
    seconds = stopwatch.now() * 1e-9
    kind = f"{loop.kind} real time" if job.realtime else "lockstep"
    reason = (f"the cycles run in Python, because compiled code cannot use the bus {job.bus}"
              if kind == "soft real time" else "")
    recorder.metadata("nodes", {str(number): name for number, name in job.bench.list_participants().items()})
    recorder.metadata("timing", {"kind": kind, "reason": reason})
    history = session.log.history
    attribution = attribute_run(job, session)
    started_ns = read_epoch_ns()
    metrology = collect_metrology(job.bench, job.model.kind.signals, job.sequence.decision, started_ns)
    progress("checks", 0.0)
    checks, skipped_checks = judge_run(job, session, attribution.judged, metrology)
    for check in checks:
        recorder.put(session.stage.now(), check)
    diagnosis = diagnose(make_main_trace(job, folder, history)) if diagnose and not session.safety.interrupted else {}
    safety, starter = session.safety, session.starter
    outcome = Outcome(
        job=job, folder=folder, checks=checks, skipped=skipped_checks, events=tuple(session.journal.events),
        aborted=safety.aborted, safe=safety.is_safe, interrupted=safety.interrupted, fdi=diagnosis,
        attribution=attribution, timing=summarise_timing(history, loop, scheduler, kind, reason),
        counters=_count_lost_frames(history), speed=len(history) * job.period_ns * 1e-9 / seconds,
        start_times=starter.start_times, identities=starter.identities, metrology=metrology, started_ns=started_ns,
        limits=find_limits(history.column, job.model, job.bench, job.scenario.plan.start))
    fdi, cause = outcome.fdi, attribution.cause
    notes: dict[str, dict[str, str]] = {
        "not_applicable": {check.name: check.reason for check in skipped_checks},
        "differences": {"text": find_differences(job)["text"]},
        "metrology": {"decision": metrology.decision, **{
            name: each.describe() for name, each in metrology.calibration.items()}} if metrology.is_used else {},
        "limits": {f"{number:02d}": limit.describe(job.model.kind.signals)
                   for number, limit in enumerate(outcome.limits)},
        "fdi": {"verdict": str(fdi.get("verdict", "")), "sentence": str(fdi.get("sentence", "")),
                "faults": describe_faults(fdi)} if fdi else {},
        "cause": outcome.describe_attribution() if cause is not None else {},
        "verdict": {"verdict": outcome.verdict, "why": outcome.why, "overruns": str(loop.overruns),
                    "timing": outcome.timing_problem,
                    "sha256": hashlib.sha256(outcome.format_json().encode()).hexdigest()}}
    for name, values in notes.items():
        if values:
            recorder.metadata(name, values)
    return outcome


def judge_run(job: Job, session: Session, is_judged: Mask,
              metrology: Metrology = NO_METROLOGY) -> tuple[list[CheckResult], list[SkippedCheck]]:
    """Judge the main phase by the checks of the sequence, and the whole run by the protocol checks.

    Returns the results, and the checks that do not apply to the bench.
    """
    kind = job.model.kind
    main = [session.log.history.column(name, MAIN) for name in kind.signals.names]
    t = np.arange(len(main[0]), dtype=np.float64) * (job.period_ns * 1e-9)
    sequence = job.sequence
    skipped_checks = {check.name: skipped_check for check in sequence.checks
                      if (skipped_check := find_skipped(check, job.bench))}
    results = evaluate_checks([check for check in sequence.checks if check.name not in skipped_checks],
                              make_columns_type(kind.signals)(t, *main),
                              sequence.sections(), session.journal.events, sequence.fault_starts(),
                              session.log.read_drives(), sequence.rate, kind.signals, metrology=metrology)
    protocol, inapplicable = judge_protocol(session.read_protocol_record(is_judged), sequence.protocol)
    return [*results, *protocol], [*skipped_checks.values(), *inapplicable]


def make_main_trace(job: Job, folder: Path, history: History) -> Trace:
    """The main phase of a run as `Trace.read` gives it from the log, with the set-up before it."""
    signals = job.model.kind.signals
    columns = {name: history.column(name, MAIN) for name in signals.names}
    settings = {name: str(value) for name, value in job.list_settings().items()}
    trace = Trace.from_columns(columns, job.period_ns * 1e-9, {"source": str(folder), **settings}, signals)
    return replace(trace, lead={name: history.column(name, SETUP) for name in signals.names})


def attribute_run(job: Job, session: Session) -> Attribution:
    """Find the cycles of a run that may be judged, and the first cause of its troubles."""
    history = session.log.history
    times = [history.column(name) for name in ("lateness", "feedback_response", "valve_response", "response")]
    if not job.realtime:  # nothing is late in lockstep; frames are there or missing
        times = [np.where(np.isnan(values), values, 0.0) for values in times]
    lateness, feedback, valve, response = times
    records = CycleRecords(np.array(session.log.due_ns, dtype=np.int64), lateness, feedback, valve, response,
                           history.column("flags").astype(np.int64),
                           find_injected(job.scenario.plan, session.faults, len(history)),
                           select_plant_delays(session.plant_record, len(history)), job.period_ns / 1e9)
    return attribute(records, session.safety.troubles, job.sequence.timing, job.bench, session.nodes.gone)


def select_plant_delays(record: CycleRecord | None, cycles: int) -> Array:
    """From SYNC to feedback by the plant's own record, s, (cycles,); 0 where it has no entry."""
    delays = np.zeros(cycles)
    if record is not None:
        is_in_run = (record.cycle >= 0) & (record.cycle < cycles)
        delays[record.cycle[is_in_run]] = (record.sent - record.sync)[is_in_run] * 1e-9
    return delays


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Create the folder if needed and lock it against a second run.

    Raises:
        InputError: the folder cannot be created or written, or another run is writing there.
    """
    with report_system_error("--out", str(folder), "a folder that can be written"):
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError("--out", str(folder), "a folder that no other run is writing to") from error
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def open_recorder(job: Job, folder: Path, epoch_ns: int = 0, observer: Observer | None = None) -> Iterator[Recorder]:
    """Replace the results of an earlier run by the log of this one; it is closed whatever happens.

    epoch_ns: the date at which the times of the log begin, ns since 1970. observer: see `Recorder`.
    """
    for name in ("verdict.json", "report.html"):  # of the run before
        (folder / name).unlink(missing_ok=True)
    signals = job.model.kind.signals
    provenance = collect_provenance(**job.list_settings(), resolution=job.bench.find_count(signals.controlled.word))
    recorder = Recorder(folder / "trace.mcap", job.build_attachments(), provenance, epoch_ns, observer, signals)
    with contextlib.closing(recorder):
        yield recorder


def _count_lost_frames(history: History) -> dict[str, int]:
    """Count the cycles with missing answers: those the rig saw and those the plant flagged."""
    flags = history.column("flags").astype(int)
    return {"no_feedback": int(np.isnan(history.column(history.signals.controlled.name)).sum()),
            "no_drive": int(np.isnan(history.column(history.signals.drive.name)).sum()),
            "plant_drive_missing": int((flags & Flags.DRIVE_MISSING != 0).sum()),
            "plant_drive_late": int((flags & Flags.DRIVE_LATE != 0).sum())}
