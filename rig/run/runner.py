"""Runs one job: nodes and bus, log, session, checks, verdict.json."""

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fdi.progress import Progress
from fdi.trace.check_result import CheckResult
from fdi.trace.trace import Trace
from plant import Actuator, InputError
from plant.errors import report_system_error
from plant.run import make_columns_type
from plant.segments import Array
from rig.benches.bench import Flags
from rig.network.clock import WallClock
from rig.network.node_objects import CycleRecord
from rig.recorder import Observer, Recorder
from rig.recorder.schema import collect_provenance, read_epoch_ns
from rig.run.attribution import Attribution, CycleRecords, attribute, find_injected
from rig.run.job import Job, find_differences
from rig.run.loop import History
from rig.run.loops import compile_loop
from rig.run.outcome import Outcome, describe_faults, find_limits, summarise_timing
from rig.run.participants import open_participants
from rig.run.priority import (
    LOOP_PRIORITY,
    lock_memory,
    name_scheduler,
    prevent_deep_sleep,
    raise_priority,
    suspend_garbage_collection,
)
from rig.run.session import MAIN, Session
from rig.sequences.checks import SkippedCheck, evaluate_checks, find_skipped
from rig.sequences.faults import Schedule
from rig.sequences.protocol import Mask, judge_protocol
from rig.sequences.python_parts import StepRun
from rig.sequences.uncertainty import NO_METROLOGY, Metrology, collect_metrology

Diagnose = Callable[[Trace], dict[str, Any]]


def run_job(job: Job, folder: Path, progress: Progress, stop: Callable[[], bool],
            prepare: Callable[[], object] = lambda: None, diagnose: Diagnose | None = None,
            observer: Observer | None = None) -> Outcome:
    """Run a job; its log and verdict are written to `folder`, before the nodes that it started are stopped.

    Args:
        job: what to run.
        folder: of the results.
        progress: called with each stage and the share done, 0 to 1.
        stop: whether the operator asks to stop.
        prepare: called when the nodes are there and nothing has moved: it may compute or wait, the run will not.
        diagnose: gives the answer of `rig fdi --json` on the main phase, called when the run has ended; None: not asked
            for.
        observer: who looks at the records of the log.

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
                prepare()
                epoch_ns = read_epoch_ns() - wire.clock.now()
                with (open_recorder(job, folder, epoch_ns, observer) as recorder,
                      contextlib.closing(Session(job, wire, processes, recorder, progress, stop)) as session):
                    outcome = play_job(job, folder, session, recorder, progress, diagnose)
                outcome.save()
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
            step.play(run)


def play_job(job: Job, folder: Path, session: Session, recorder: Recorder, progress: Progress,
             diagnose: Diagnose | None = None) -> Outcome:
    """Play the session of a job and judge it. Raises RigError."""
    progress("bring-up", 0.0)
    session.bring_up()
    loop = session.stage.loop
    assert loop is not None
    stopwatch = WallClock()
    with contextlib.ExitStack() as rights:
        if job.realtime:
            is_hard = loop.kind == "hard"  # then Python only has to keep up; the cycle's thread is above it
            rights.enter_context(raise_priority(1 if is_hard else LOOP_PRIORITY))
            rights.enter_context(lock_memory())
            rights.enter_context(prevent_deep_sleep())
            rights.enter_context(suspend_garbage_collection())
        session.run_phases()
        scheduled = loop.scheduler or name_scheduler()
    spent = stopwatch.now() * 1e-9
    kind = f"{loop.kind} real time" if job.realtime else "lockstep"
    why = f"the cycles run in Python, because compiled code cannot use the bus {job.bus}"
    reason = why if kind == "soft real time" else ""
    recorder.metadata("nodes", {str(number): name for number, name in job.bench.list_participants().items()})
    recorder.metadata("timing", {"kind": kind, "reason": reason})
    history = session.log.history
    attribution = attribute_run(job, session)
    started_ns = read_epoch_ns()
    metrology = collect_metrology(job.bench, job.model.kind.signals, job.sequence.decision, started_ns)
    progress("checks", 0.0)
    checks, skipped = judge_run(job, session, attribution.judged, metrology)
    for check in checks:
        recorder.put(session.stage.now(), check)
    diagnosis = diagnose(make_main_trace(job, folder, history)) if diagnose and not session.safety.interrupted else {}
    safety, log, starter = session.safety, session.log, session.starter
    outcome = Outcome(
        job=job, folder=folder, checks=checks, skipped=skipped, events=session.journal.events, aborted=safety.aborted,
        safe=safety.is_safe, interrupted=safety.interrupted, fdi=diagnosis, attribution=attribution,
        timing=summarise_timing(history, loop, scheduled, kind, reason), counters=_count_lost_frames(history),
        speed=len(history) * job.period_ns * 1e-9 / spent, due_ns=tuple(log.due_ns), start_times=starter.start_times,
        identities=starter.identities, metrology=metrology, started_ns=started_ns,
        limits=find_limits(history.column, job.model, job.scenario.plan.start))
    if skipped:
        recorder.metadata("not_applicable", {check.name: check.reason for check in skipped})
    recorder.metadata("differences", {"text": find_differences(job).describe()})
    if metrology.is_used:
        recorder.metadata("metrology", {"decision": metrology.decision, **{
            name: each.describe() for name, each in metrology.calibration.items()}})
    if outcome.limits:
        signals = job.model.kind.signals
        recorder.metadata("limits", {f"{number:02d}": limit.describe(signals)
                                     for number, limit in enumerate(outcome.limits)})
    if outcome.fdi:
        found = {key: str(outcome.fdi.get(key, "")) for key in ("verdict", "sentence")}
        recorder.metadata("fdi", {**found, "faults": describe_faults(outcome.fdi)})
    if outcome.attribution.cause is not None:
        recorder.metadata("cause", outcome.describe_attribution())
    recorder.metadata("verdict", {"verdict": outcome.verdict, "why": outcome.why, "overruns": str(loop.overruns),
                                  "timing": outcome.timing_problem})
    return outcome


def judge_run(job: Job, session: Session, judged: Mask,
              metrology: Metrology = NO_METROLOGY) -> tuple[list[CheckResult], list[SkippedCheck]]:
    """Judge the main phase by the checks of the sequence, and the whole run by the protocol checks.

    Returns the results, and the checks that do not apply to the bench.
    """
    kind = job.model.kind
    main = [session.log.history.column(name, MAIN) for name in kind.signals.names]
    t = np.arange(len(main[0]), dtype=np.float64) * (job.period_ns * 1e-9)
    sequence = job.sequence
    unsaid = {check.name: skipped for check in sequence.checks if (skipped := find_skipped(check, job.bench))}
    results = evaluate_checks([check for check in sequence.checks if check.name not in unsaid],
                              make_columns_type(kind.signals)(t, *main),
                              sequence.sections(), session.journal.events, sequence.fault_starts(),
                              session.log.read_drives(), sequence.rate, kind.signals, metrology=metrology)
    protocol, inapplicable = judge_protocol(session.read_protocol_record(judged), sequence.protocol)
    return [*results, *protocol], [*unsaid.values(), *inapplicable]


def make_main_trace(job: Job, folder: Path, history: History) -> Trace:
    """The main phase of a run as `Trace.read` gives it from the log."""
    columns = {name: history.column(name, MAIN) for name in job.model.kind.signals.names}
    settings = {name: str(value) for name, value in job.list_settings().items()}
    return Trace.from_columns(columns, job.period_ns * 1e-9, {"source": str(folder), **settings})


def attribute_run(job: Job, session: Session) -> Attribution:
    """Find the cycles of a run that may be judged, and the first cause of its troubles."""
    history = session.log.history
    times = [history.column(name) for name in ("lateness", "feedback_response", "valve_response", "response")]
    if not job.realtime:  # nothing is late in lockstep; frames are there or missing
        times = [np.where(np.isnan(values), values, 0.0) for values in times]
    lateness, feedback, valve, response = times
    plan = job.scenario.plan
    injected = find_injected(plan, Schedule(plan, job.scenario.model.values), len(history))
    records = CycleRecords(np.array(session.log.due_ns, dtype=np.int64), lateness, feedback, valve, response,
                           history.column("flags").astype(np.int64), injected,
                           select_plant_delays(session.plant_record, len(history)), job.period_ns / 1e9)
    return attribute(records, session.safety.troubles, job.sequence.timing, job.bench, session.nodes.gone)


def select_plant_delays(record: CycleRecord | None, cycles: int) -> Array:
    """From SYNC to feedback by the plant's own record, s, (cycles,); 0 where it has no entry."""
    delays = np.zeros(cycles)
    if record is not None:
        known = (record.cycle >= 0) & (record.cycle < cycles)
        delays[record.cycle[known]] = (record.sent - record.sync)[known] * 1e-9
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
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise InputError("--out", str(folder), "a folder that no other run is writing to") from error
    finally:
        os.close(handle)


@contextlib.contextmanager
def open_recorder(job: Job, folder: Path, epoch_ns: int = 0, observer: Observer | None = None) -> Iterator[Recorder]:
    """Replace the results of an earlier run by the log of this one; it is closed whatever happens.

    epoch_ns: the date at which the times of the log begin, ns since 1970. observer: see `Recorder`.
    """
    for name in ("verdict.json", "report.html"):  # of the run before
        (folder / name).unlink(missing_ok=True)
    recorder = Recorder(folder / "trace.mcap", job.build_attachments(), collect_provenance(**job.list_settings()),
                        epoch_ns, observer, job.model.kind.signals)
    try:
        yield recorder
    finally:
        recorder.close()


def _count_lost_frames(history: History) -> dict[str, int]:
    """Count the cycles with missing answers: those the rig saw and those the plant flagged."""
    flags = history.column("flags").astype(int)
    return {"no_feedback": int(np.isnan(history.column(history.signals.controlled.name)).sum()),
            "no_drive": int(np.isnan(history.column(history.signals.drive.name)).sum()),
            "plant_drive_missing": int((flags & Flags.DRIVE_MISSING != 0).sum()),
            "plant_drive_late": int((flags & Flags.DRIVE_LATE != 0).sum())}


