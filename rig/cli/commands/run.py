"""`rig run`: play a test sequence on the bench, log and judge it; several sequences are those of rig/cli/suite.py."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from itertools import count
from pathlib import Path

from fdi.progress import Progress
from fdi.report import Line, Medium, Report, Section, build_run_report, write_html
from fdi.trace import Trace, locate_log
from plant import count_nouns, report_system_error, require
from rig.cli import (
    LIVE_ON_TERMINAL,
    Places,
    choose_file,
    give_answer,
    is_suite_file,
    open_console,
    parse_changes,
    show_progress,
)
from rig.interrupts import catch_signals
from rig.network import WallClock, choose_bus
from rig.recorder import Event, Observer
from rig.run import (
    EMBEDDED_NAMES,
    Job,
    JobChoice,
    Outcome,
    build_job,
    diagnose_run,
    find_differences,
    read_job,
    replace_settings,
    run_job,
)
from rig.view.live_process import ViewerPlace, find_viewer_place, show_live
from rig.view.live_run import find_named_node, make_live_plan


def run_command(args: argparse.Namespace) -> int:
    """Results go to the folder --out (default: a new one in runs/). Exit status 0 if no check failed."""
    if args.live not in (None, LIVE_ON_TERMINAL) and args.live.partition(":")[0] != "rerun":
        args.live, args.sequence = LIVE_ON_TERMINAL, [args.live, *args.sequence]  # the word behind --live is a sequence
    require(args.max_overruns is None or 0 <= args.max_overruns <= 1, "--max-overruns", "",
            f"a fraction from 0 to 1, not {args.max_overruns}")
    require(not (args.requirements and args.source), "--requirements", "", "sequences or a suite file, not --from")
    if not args.source and (len(args.sequence) > 1 or args.requirements or any(map(is_suite_file, args.sequence))):
        require(not args.live, "--live", "", "one sequence; runs of a suite run side by side")
        from rig.cli.suite import run_suite  # here: it loads rich, which a run with --json does not need

        return run_suite(args)
    is_silent, is_on_screen = args.json or args.quiet, args.live == LIVE_ON_TERMINAL
    place = find_viewer_place(args.live) if args.live and not is_on_screen else None
    job = repeat_job(args.source, args) if args.source else build_job(build_choice(args), is_trusted=args.trust)
    bus, why = choose_bus_of_run(args, job.bus if args.source else args.bus, job.controller)
    job = replace_settings(job, bus=bus)
    folder = Path(args.out) if args.out else make_new_folder(Path("runs"), Path(job.sequence.name).stem)
    junit = choose_file(args.junit, (".xml",), None, "--junit")
    clock = WallClock()
    with catch_signals() as is_to_stop:
        with (announce_run(args, job, why, is_silent=is_silent or is_on_screen) as progress,
              choose_observer(job, folder / "trace.mcap", place, is_live=args.live is not None) as observer):
            diagnose = partial(diagnose_run, job=job, progress=progress) if args.fdi else None
            outcome = run_job(job, folder, progress, is_to_stop, diagnose, observer)
            progress("report", 0.0)
            report = build_run_report(Trace.read(folder / "trace.mcap", all=True))
        if is_on_screen and not is_silent:
            print_settings(job, why)
        with contextlib.suppress(BrokenPipeError):  # whether somebody reads the output does not change the verdict
            give_answer(add_outcome(report, outcome), args, places=Places(junit=junit),
                        format_junit=partial(format_junit, outcome, clock))
        write_html(report, folder / "report.html")  # last: nobody waits for the drawing with the verdict
    return outcome.status


def format_junit(outcome: Outcome, clock: WallClock) -> str:
    """The JUnit XML of a run that began with the clock."""
    from rig.suite.suite import write_junit_of_run  # here: a run needs no suites

    return write_junit_of_run(outcome, 1e-9 * clock.now())


def choose_bus_of_run(args: argparse.Namespace, spec: str, controller: str | None) -> tuple[str, str]:
    """The bus of a run and why it is that one.

    Raises:
        RigError: a bus that is not there.
    """
    bus, why = choose_bus(spec)
    return (bus, why) if controller != "c" or bus != "embedded" or args.bus != "auto" else (
        "udp_multicast", "udp_multicast: --controller c is a program and needs a bus between programs")


@contextlib.contextmanager
def choose_observer(job: Job, log: Path, place: ViewerPlace | None, *, is_live: bool) -> Iterator[Observer]:
    """What hears of the events of a run: the screen or the viewer of --live, and the lines about dead nodes."""
    announce = partial(announce_dead_node, job.bench.list_participants())
    if not is_live:
        yield announce
        return
    events: list[Event] = []  # while a screen covers the terminal
    with show_live(make_live_plan(job.sequence, job.pace, job.bench), log, job.realtime, place) as begin:
        def observe(event: Event) -> None:
            begin()  # now the log is there
            (events.append if place is None else announce)(event)

        yield observe
    for event in events:
        announce(event)


def announce_dead_node(nodes: Mapping[int, str], event: Event) -> None:
    """Print a line on standard error, at once, when one of the nodes has died."""
    if event.level == "ERROR" and find_named_node(event.kind, event.text, nodes):
        clear = "\r\033[K" if sys.stderr.isatty() else ""
        print(f"{clear}rig run: {event.text}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def announce_run(args: argparse.Namespace, job: Job, why: str, *, is_silent: bool) -> Iterator[Progress]:
    """Show the progress bar of a run, and say on standard output what runs on which bus and `why` on that."""
    say = cache(partial(print_settings, job, why))  # only once
    with show_progress(args, is_silent=is_silent, is_realtime=job.realtime) as update:
        def announce(stage: str, share: float) -> None:
            if not is_silent:  # and not before there is a bus and a place for the results: an error is one line
                say()
            update(stage, share)

        yield announce


def print_settings(job: Job, why: str) -> None:
    """Say on standard output what runs on which bus and `why` on that."""
    text = f"{job.sequence.title}, {job.sequence.duration:g} s, {job.pace}, seed {job.seed}, {why}"
    open_console().print(text, markup=False, soft_wrap=True)


def add_outcome(report: Report, outcome: Outcome) -> Report:
    """The report of a run's trace with what only the run knows: its speed, lost frames, where the results are.

    Its last line repeats a verdict other than a plain PASS: the headline may have scrolled out of sight.
    """
    timing, is_judged, fdi = outcome.timing, outcome.attribution.judged, outcome.fdi
    late = timing["lateness_us"]
    cycles = count_nouns(timing["cycles"], "cycle")
    pace = (f"{cycles}, {count_nouns(timing['overruns'], 'overrun')}; lateness p50 {late['p50']:g}, "
            f"p99 {late['p99']:g}, max {late['max']:g} us ({timing['kind']}, {timing['scheduler']})"
            if outcome.job.realtime else f"{cycles} in lockstep, {outcome.speed:.1f} times real time")
    differences = find_differences(outcome.job)["text"]
    texts = {
        "timing": pace,
        "real time": timing["reason"],
        "judged": "" if is_judged.all() else (f"{int(is_judged.sum())} of {len(is_judged)} cycles; the bench was late: "
                                              f"{_list_counts(outcome.attribution.invalid)}"),
        "first cause": outcome.describe_cause() if outcome.attribution.cause is not None else "",
        "missing": _list_counts(outcome.counters),
        "not nominal": differences if differences != "nothing" else "",
        "rig fdi": f"{fdi['verdict']}: {fdi['sentence']}" if fdi else ""}
    reason = (outcome.why or "every check passed") + (
        "; rig fdi cannot tell" if fdi.get("verdict") == "CANNOT_TELL" else "")
    lines = [Line(label, text) for label, text in texts.items() if text]
    return replace(report, sections=[*report.sections, Section("Run", lines, medium=Medium.TERMINAL)],
                   files=[("results", f"{outcome.folder}/ trace.mcap, verdict.json, report.html")],
                   conclusion="" if outcome.verdict == "PASS" and not fdi else f"{outcome.verdict}: {reason}",
                   data=outcome.to_json())


def _list_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts.items() if count)


def build_choice(args: argparse.Namespace) -> JobChoice:
    """What the command line chooses for the run of its first sequence; the bus is chosen later.

    Raises:
        InputError: a --set that is not GROUP.FIELD=VALUE.
    """
    return JobChoice(sequence=[*args.sequence, "preflight"][0], model=args.model, changes=parse_changes(args.set),
                     seed=args.seed or 0, effects=tuple(args.effects), bench=args.bench, pace=args.pace,
                     controller=args.controller, plant=args.plant, max_overruns=args.max_overruns,
                     is_diagnosed=args.fdi)


def repeat_job(source: Path, args: argparse.Namespace) -> Job:
    """The job recorded in a log, to repeat it; bus, pace, controller and plant may be given anew.

    A bus other than the embedded one must be named on the command line: a log does not decide what hardware moves.

    Raises:
        InputError: no log of a run, options that would change the job, code in the log that --trust does not allow, or
            a bus in the log that --bus does not name.
    """
    require(not (args.sequence or args.set or args.model or args.effects or args.bench or args.seed is not None),
            "--from", str(source), "no SEQUENCE, --model, --set, --seed, --effects or --bench: the log has them")
    log = locate_log(source)
    require(not (args.out and (Path(args.out) / "trace.mcap").resolve() == log.resolve()), "--out", args.out,
            "another folder than that of the log to repeat, which would be overwritten")
    job = read_job(source, is_trusted=args.trust)
    other = "" if "external" in (job.controller, job.plant) else ", or --bus embedded"  # which no other program reaches
    require(args.bus != "auto" or job.bus.partition(":")[0] in EMBEDDED_NAMES, log, f"bus {job.bus}",
            f"--bus {job.bus} to use it again{other}: the bus of a log is opened only if the command line names it")
    return replace_settings(job, bus=None if args.bus == "auto" else args.bus, pace=args.pace,
                            controller=args.controller, plant=args.plant, max_overruns=args.max_overruns)


def make_new_folder(parent: Path, name: str) -> Path:
    """Make a new folder: parent/name, else name-2, name-3, ... Made at once, so that no two runs take it.

    Raises:
        InputError: the place cannot be written.
    """
    for number in count(1):
        folder = parent / (name if number == 1 else f"{name}-{number}")
        with (report_system_error("--out", str(folder), "a place that can be written"),
              contextlib.suppress(FileExistsError)):
            folder.mkdir(parents=True)
            return folder
    raise AssertionError
