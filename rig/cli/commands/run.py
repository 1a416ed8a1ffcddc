"""`rig run`: play a test sequence on the bench, log it, judge it."""
from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from fdi.progress import Progress
    from fdi.report.report import Report
    from rig.recorder import Record
    from rig.run.job import Job, JobChoice
    from rig.run.outcome import Outcome
    from rig.run.runner import Observe
    from rig.view.live_process import ViewerPlace

TERMINAL = "terminal"  # --live without a word


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig run`."""
    from rig.run.choices import CONTROLLERS, PACES, PLANTS

    add = parser.add_argument
    add("sequence", nargs="*", metavar="SEQUENCE",
        help="test sequence: a .toml file, or the name of a shipped one (default: preflight). Several, or a suite "
             "file, run on all cores and end in one report (docs/suite.md)")
    options.add_model_options(parser)
    parser.set_defaults(seed=None)  # None: not given; --from takes the seed of the log
    add("--bus", default="auto", metavar="auto|embedded|INTERFACE:CHANNEL",
        help="auto: that of EHA_RIG_BUS, else the embedded one (default); embedded: in this process; or "
             "socketcan:can0, udp_multicast, ...")
    add("--pace", choices=PACES, default=None,
        help="lockstep: virtual time, bit-reproducible (default); realtime: wall-clock time")
    add("--controller", choices=CONTROLLERS, default=None,
        help="firmware of node 2: the reference firmware in Python (builtin, default) or in C (c: compiled and started "
             "here), or your own on the bus (external)")
    add("--plant", choices=PLANTS, default=None,
        help="plant of node 3: auto uses the emulator that answers on the bus, else starts one (default)")
    add("--max-overruns", type=float, default=None, metavar="FRACTION",
        help="largest share of overruns in a real-time run; more make its timing invalid "
             "(default: that of the sequence, 0.001)")
    add("--fdi", action="store_true", help="also diagnose the servovalve like rig fdi, against a nominal unit")
    add("--junit", metavar="FILE.xml", help="also write the results as JUnit XML, for build servers")
    add("--jobs", type=options.parse_count, default=None, metavar="N",
        help="runs at a time of several sequences or a suite (default: all cores; 1 in real time or on a CAN bus)")
    add("--live", nargs="?", const=TERMINAL, metavar="rerun[:PORT|:FILE.rrd]",
        help="show the run while it runs: nodes, command and position, checks, timing; without a terminal a line "
             "every 2 s. rerun: in the viewer's window, in an open viewer at a port of 127.0.0.1, or into a file")
    add("--from", dest="source", type=Path, metavar="trace.mcap", help="repeat the run recorded in this log")


def run_command(args: argparse.Namespace) -> int:
    """Results go to the folder --out (default: a new one in runs/). Exit status 0 if no check failed."""
    from functools import partial

    from fdi.report.run_report import build_run_report
    from fdi.trace.trace import Trace
    from plant import InputError
    from rig.cli.answer import show_answer
    from rig.cli.interruption import catch_signals
    from rig.network.clock import WallClock
    from rig.run.job import build_job, replace_settings
    from rig.run.outcome import diagnose_servovalve
    from rig.run.page_writer import PageWriter
    from rig.run.runner import run_job
    from rig.view.live_process import find_viewer_place

    args.live, args.sequence = split_live(args.live, args.sequence)
    if args.max_overruns is not None and not 0 <= args.max_overruns <= 1:
        raise InputError("--max-overruns", "", f"a fraction from 0 to 1, not {args.max_overruns:g}")
    if not args.source and is_suite(args.sequence):
        if args.live:
            raise InputError("--live", "", "one sequence; runs of a suite run side by side")
        return start_suite(args)
    place = find_viewer_place(args.live) if args.live and args.live != TERMINAL else None
    job = read_job(args.source, args) if args.source else build_job(build_choice(args), is_trusted=args.trust)
    bus, why = choose_bus_of_run(args, job.bus if args.source else args.bus, job.controller)
    job = replace_settings(job, bus=bus)
    folder = Path(args.out) if args.out else make_folder(Path("runs"), Path(job.sequence.name).stem)
    junit = choose_junit(args)
    clock = WallClock()
    with PageWriter() as pages, catch_signals() as is_to_stop:
        with (announce_run(job, why, is_silent=args.json or args.quiet or args.live == TERMINAL) as progress,
              choose_observer(job, place, is_live=args.live is not None) as observe):
            prepare = pages.wait_until_loaded if job.realtime else do_nothing
            diagnose = partial(diagnose_servovalve, progress=progress) if args.fdi else None
            outcome = run_job(job, folder, progress, is_to_stop, prepare, diagnose, observe)
            progress("report", 0.0)
            pages.start_page(folder / "trace.mcap", folder / "report.html")
            report = build_run_report(Trace.read(folder / "trace.mcap", all=True))  # meanwhile
        if args.live == TERMINAL and not (args.json or args.quiet):
            print_settings(job, why)
        with contextlib.suppress(BrokenPipeError):  # whether somebody reads the output does not change the verdict
            show_answer(add_outcome(report, outcome), args)  # the page may take longer than the operator wants to wait
        pages.finish_page()
    if junit is not None:
        from fdi.output import write_text
        from rig.suite.report import write_junit_of_run

        write_text(junit, write_junit_of_run(outcome, 1e-9 * clock.now()), "--junit")
    return outcome.status


def split_live(live: str | None, sequences: list[str]) -> tuple[str | None, list[str]]:
    """The value of --live and the sequences; the word after --live is a sequence unless it begins with "rerun"."""
    if live is None or live == TERMINAL or live.partition(":")[0] == "rerun":
        return live, sequences
    return TERMINAL, [live, *sequences]


def is_suite(names: list[str]) -> bool:
    """Whether the command line names several sequences or a suite file."""
    from rig.suite.suite import is_suite_file

    return len(names) > 1 or any(map(is_suite_file, names))


def start_suite(args: argparse.Namespace) -> int:
    """Run several sequences or suite files; return the exit status.

    Raises:
        RigError: bad input; nothing has run then.
    """
    from rig.cli.suite import run_suite

    base = build_choice(args)
    bus, _ = choose_bus_of_run(args, args.bus, args.controller)

    def choose_folder() -> Path:  # not before everything has been tried: an error leaves no folder behind
        return Path(args.out) if args.out else make_folder(Path("runs"), find_suite_name(args.sequence))

    return run_suite(args, base._replace(bus=bus), choose_folder)


def find_suite_name(names: list[str]) -> str:
    """The name of the folder of several runs: that of the one suite file, else "suite"."""
    return Path(names[0]).stem if len(names) == 1 else "suite"


def choose_bus_of_run(args: argparse.Namespace, wanted: str, controller: str | None) -> tuple[str, str]:
    """The bus of a run and why it is that one.

    Raises:
        RigError: a bus that is not there.
    """
    from rig.network.bus import choose_bus

    bus, why = choose_bus(wanted)
    if controller == "c" and bus == "embedded" and args.bus == "auto":
        return "udp_multicast", "udp_multicast: --controller c is a program and needs a bus between programs"
    return bus, why


def choose_junit(args: argparse.Namespace) -> Path | None:
    """The file of --junit, once it is known that it can be written.

    Raises:
        InputError: it cannot be written, or is no .xml file.
    """
    from rig.cli.answer import choose_file

    return choose_file(args.junit, (".xml",), None, "--junit")


def do_nothing() -> None:
    """What a run in lockstep waits for before it begins."""


@contextlib.contextmanager
def choose_observer(job: Job, place: ViewerPlace | None, *, is_live: bool) -> Iterator[Observe]:
    """What looks at the records of a run: the screen or the viewer of --live, and the lines about dead nodes."""
    if not is_live:
        yield announce_dead_node
        return
    from rig.recorder import Event
    from rig.view.live_process import show_live
    from rig.view.live_run import find_dead_node, make_live_plan

    deaths: list[Event] = []
    with show_live(make_live_plan(job.sequence, job.pace), last_cpu_is_taken=job.realtime, place=place) as feed:
        def observe(t_ns: int, record: Record) -> None:
            feed.observe(t_ns, record)
            if place is not None:
                announce_dead_node(t_ns, record)
            elif isinstance(record, Event) and find_dead_node(record.level, record.kind, record.text):
                deaths.append(record)

        yield observe
    for event in deaths:  # the screen that showed them is gone
        announce_dead_node(0, event)


def announce_dead_node(t_ns: int, record: Record) -> None:
    """Print a line on standard error, at once, when a node has died."""
    from rig.recorder import Event
    from rig.view.live_run import find_dead_node

    if isinstance(record, Event) and find_dead_node(record.level, record.kind, record.text):
        clear = "\r\033[K" if sys.stderr.isatty() else ""
        print(f"{clear}rig run: {record.text}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def announce_run(job: Job, why: str, *, is_silent: bool) -> Iterator[Progress]:
    """Show the progress bar of a run, and say on standard output what runs on which bus and `why` on that."""
    from rig.cli.progress_bar import show_progress

    is_announced = is_silent
    with show_progress(is_silent=is_silent, is_realtime=job.realtime) as update:
        def announce(stage: str, share: float) -> None:
            nonlocal is_announced
            if not is_announced:  # not before there is a bus and a place for the results: an error is one line
                is_announced = True
                print_settings(job, why)
            update(stage, share)

        yield announce


def print_settings(job: Job, why: str) -> None:
    """Say on standard output what runs on which bus and `why` on that."""
    from rig.cli.terminal import open_console

    text = f"{job.sequence.title}, {job.sequence.duration:g} s, {job.pace}, seed {job.seed}, {why}"
    open_console().print(text, markup=False, soft_wrap=True)


def add_outcome(report: Report, outcome: Outcome) -> Report:
    """The report of a run's trace with what only the run knows: its speed, lost frames, where the results are.

    Its last line repeats a verdict other than a plain PASS: the headline may have scrolled out of sight.
    """
    from fdi.report.report import Line, Medium, Section
    from rig.run.job import find_differences

    timing = outcome.timing
    if outcome.job.realtime:
        late = timing["lateness_us"]
        text = (f"{timing['cycles']} cycles, {timing['overruns']} overruns; lateness p50 {late['p50']:g}, "
                f"p99 {late['p99']:g}, max {late['max']:g} us ({timing['kind']}, {timing['scheduler']})")
    else:
        text = f"{timing['cycles']} cycles in lockstep, {outcome.speed:.1f} times real time"
    lines = [Line("timing", text)]
    if timing["reason"]:
        lines.append(Line("real time", timing["reason"]))
    judged = outcome.attribution.judged
    if not judged.all():
        reasons = ", ".join(f"{name.replace('_', ' ')} {count}"
                            for name, count in outcome.attribution.invalid.items() if count)
        lines.append(Line("judged", f"{int(judged.sum())} of {len(judged)} cycles; the bench was late: {reasons}"))
    if outcome.attribution.cause is not None:
        lines.append(Line("first cause", outcome.describe_cause()))
    missing = [f"{name.replace('_', ' ')} {count}" for name, count in outcome.counters.items() if count]
    if missing:
        lines.append(Line("missing", ", ".join(missing)))
    differences = find_differences(outcome.job).describe()
    if differences != "nothing":
        lines.append(Line("not nominal", differences))
    if outcome.fdi:
        lines.append(Line("servovalve", f"{outcome.fdi['verdict']}: {outcome.fdi['sentence']}"))
    is_plain = outcome.verdict == "PASS" and not outcome.fdi
    reason = outcome.why or "every check passed"
    if outcome.fdi.get("verdict") == "CANNOT_TELL":
        reason += "; rig fdi cannot tell"
    conclusion = "" if is_plain else f"{outcome.verdict}: {reason}"
    return replace(report, sections=[*report.sections, Section("Run", lines, medium=Medium.TERMINAL)],
                   files=[("results", f"{outcome.folder}/ trace.mcap, verdict.json, report.html")],
                   conclusion=conclusion,
                   data=outcome.to_json())


def build_choice(args: argparse.Namespace) -> JobChoice:
    """What the command line chooses for the run of its first sequence; the bus is chosen later.

    Raises:
        InputError: a --set that is not GROUP.FIELD=VALUE.
    """
    from rig.run.job import JobChoice

    return JobChoice(sequence=[*args.sequence, "preflight"][0], model=args.model,
                     changes=options.parse_changes(args.set), seed=args.seed or 0, effects=tuple(args.effects),
                     pace=args.pace, controller=args.controller, plant=args.plant, max_overruns=args.max_overruns,
                     is_diagnosed=args.fdi)


def read_job(source: Path, args: argparse.Namespace) -> Job:
    """The job recorded in a log, to repeat it; bus, pace, controller and plant may be given anew.

    A bus other than the embedded one must be named on the command line: a log does not decide what hardware moves.

    Raises:
        InputError: no log of a run, options that would change the job, code in the log that --trust does not allow, or
            a bus in the log that --bus does not name.
    """
    from plant import InputError
    from rig.run.job import read_job, replace_settings
    from rig.run.participants import EMBEDDED_NAMES

    if args.sequence or args.set or args.model or args.effects or args.seed is not None:
        raise InputError("--from", str(source), "no SEQUENCE, --model, --set, --seed or --effects: the log has them")
    log = source / "trace.mcap" if source.is_dir() else source
    if args.out and (Path(args.out) / "trace.mcap").resolve() == log.resolve():
        raise InputError("--out", args.out, "another folder than that of the log to repeat, which would be overwritten")
    job = read_job(source, is_trusted=args.trust)
    if args.bus != "auto":
        job = replace_settings(job, bus=args.bus)
    elif job.bus.partition(":")[0] not in EMBEDDED_NAMES:
        raise InputError(log, f"bus {job.bus}", f"--bus {job.bus} to use it again, or --bus embedded: the bus of a log "
                                                "is opened only if the command line names it")
    return replace_settings(job, pace=args.pace, controller=args.controller, plant=args.plant,
                            max_overruns=args.max_overruns)


def make_folder(parent: Path, name: str) -> Path:
    """Make a new folder: parent/name, else name-2, name-3, ... Made at once, so that no two runs take it.

    Raises:
        InputError: the place cannot be written.
    """
    from itertools import count

    from plant import InputError

    for number in count(1):
        folder = parent / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError("--out", str(folder), f"a place that can be written ({error.strerror})") from error
        return folder
    raise AssertionError
