"""Runs the cases of a suite in processes of their own, so that a crash or a timeout of one costs only that one."""
from __future__ import annotations

import contextlib
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import FrameType

from fdi.progress import Progress, ignore_progress
from fdi.report.run_report import write_run_page
from plant.errors import RigError
from rig.network.clock import WallClock
from rig.run.differences import find_differences
from rig.run.job_choice import build_job
from rig.run.outcome import Outcome
from rig.run.participants import EMBEDDED_NAMES
from rig.run.runner import run_job
from rig.run.servovalve import diagnose_servovalve
from rig.studies.resumable.worker_processes import run_in_processes
from rig.studies.suite.case import Case, CaseResult


def run_cases(cases: Sequence[Case], processes: int, show: Callable[[CaseResult], None],
              patience: float = 5.0) -> tuple[list[CaseResult], bool]:
    """Run all cases.

    Args:
        cases: what to run; each has been tried (`suite_file.build_suite`).
        processes: how many run at a time.
        show: called with each result as it comes.
        patience: s that a run that is broken off has to come to rest and close its log.

    Returns:
        The results in the order of the cases, and whether Ctrl-C has interrupted them: then some are NOT_RUN.

    Raises:
        RigError: a worker process cannot start.
    """
    found: dict[str, CaseResult] = {}
    is_interrupted = False
    finished = run_in_processes(play_case, cases, processes, _describe_failure, attempts=1, choose_limit=_choose_limit,
                                patience=patience)
    with contextlib.closing(finished):  # type: ignore[type-var]  # a generator
        try:
            for case, result in finished:
                found[case.name] = result
                show(result)
        except KeyboardInterrupt:
            is_interrupted = True
    missing = "the suite was interrupted before it had finished"
    return [found.get(case.name) or CaseResult(case, "NOT_RUN", missing) for case in cases], is_interrupted


def _choose_limit(case: Case) -> float:
    return case.timeout


def _describe_failure(case: Case, reason: str) -> CaseResult:
    return CaseResult(case, "ERROR", reason)


def play_case(case: Case) -> CaseResult:
    """Run a case and write its page. Errors are part of the result; an internal one is written to error.txt."""
    clock = WallClock()
    try:
        with catch_termination(case.choice.bus) as is_to_stop:
            job = build_job(case.choice, is_trusted=True, announce=_ignore)  # the code was announced when it was tried
            diagnose = partial(diagnose_servovalve, progress=_make_progress(is_to_stop), workers=1)
            outcome = run_job(job, case.folder, ignore_progress, is_to_stop,
                              diagnose=diagnose if case.choice.is_diagnosed else None)
            write_run_page(case.folder / "trace.mcap", case.folder / "report.html")
    except RigError as error:
        return CaseResult(case, "ERROR", str(error), 1e-9 * clock.now())
    except Exception as error:
        case.folder.mkdir(parents=True, exist_ok=True)
        (case.folder / "error.txt").write_text(traceback.format_exc())
        text = f"internal error, {type(error).__name__}: {error} ({case.folder}/error.txt)"
        return CaseResult(case, "ERROR", text, 1e-9 * clock.now())
    return make_result(case, outcome, 1e-9 * clock.now())


def _make_progress(is_to_stop: Callable[[], bool]) -> Progress:
    """The progress of a diagnosis, which follows the run: it ends the process if the case is to stop."""
    def end_if_asked(stage: str, share: float) -> None:
        if is_to_stop():
            raise SystemExit(128 + signal.SIGTERM)

    return end_if_asked


def make_result(case: Case, outcome: Outcome, seconds: float) -> CaseResult:
    """The result of a case from the outcome of its run, which took `seconds`."""
    return CaseResult(case, outcome.verdict, outcome.why, seconds, tuple(outcome.checks),
                      find_differences(outcome.job).describe(), outcome.fdi)


@contextlib.contextmanager
def catch_termination(bus: str, patience: float = 1.0) -> Iterator[Callable[[], bool]]:
    """Give a function that says whether the run is to stop: whether this process was sent SIGTERM.

    On the embedded bus there is nothing to bring to rest. There the process ends `patience` s after the signal if the
    run has not stopped by then, for it may be in a user's function that does not return; the log is closed.
    """
    is_asked = False
    is_embedded = bus.partition(":")[0] in EMBEDDED_NAMES

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal is_asked
        is_asked = True
        if is_embedded:
            signal.setitimer(signal.ITIMER_REAL, patience, 0.5)  # repeated: an exception may be lost in a callback

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + signal.SIGTERM)

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, ask), signal.SIGALRM: signal.signal(signal.SIGALRM, end)}
    try:
        yield lambda: is_asked
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _ignore(text: str) -> None:
    """Announce nothing."""
