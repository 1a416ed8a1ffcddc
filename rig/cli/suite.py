"""`rig run` with several sequences or a suite file: all runs, one report."""

import argparse
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rich.text import Text

from fdi.report import Cell, style_of
from plant import count_nouns, require
from rig.cli import Places, choose_file, give_answer, is_suite_file, make_folder, open_console
from rig.cli.commands.run import build_choice, choose_bus_of_run, make_new_folder
from rig.evidence.requirements import read_requirements, require_listed
from rig.interrupts import catch_signals
from rig.network import WallClock
from rig.run import EMBEDDED_NAMES, JobChoice
from rig.suite.suite import (
    MOODS,
    Case,
    CaseResult,
    Suite,
    build_suite,
    build_suite_report,
    find_status,
    read_suite_file,
    run_cases,
    write_junit,
)


def run_suite(args: argparse.Namespace) -> int:
    """Run all sequences and suite files of the command line; write page, JSON and JUnit; return the exit status.

    Raises:
        RigError: a sequence, model or parameter that cannot be used; nothing has run then.
    """
    args.sequence = args.sequence or ["preflight"]
    base = build_choice(args)._replace(bus=choose_bus_of_run(args, args.bus, args.controller)[0])
    suite = read_suite(args, base)
    processes = choose_processes(args, base, len(suite.cases))
    name = Path(args.sequence[0]).stem if len(args.sequence) == 1 else "suite"
    folder = Path(args.out) if args.out else make_new_folder(Path("runs"), name)  # not before all has been tried
    suite = suite._replace(cases=[case._replace(folder=folder / case.folder) for case in suite.cases])
    for path in (folder, *(case.folder for case in suite.cases)):
        make_folder(path)
    junit = choose_file(args.junit, (".xml",), None, "--junit")
    show = announce_suite(suite, processes, is_silent=args.json or args.quiet)
    clock = WallClock()
    with catch_signals():  # Ctrl-C and SIGTERM both break it off
        results, is_interrupted = run_cases(suite.cases, processes, show, 5.0 if base.bus == "embedded" else 30.0)
    files = [("results", f"{folder}/ suite.html, suite.json, a folder for each case"), *Places(junit=junit).files]
    report = build_suite_report(suite, results, 1e-9 * clock.now(), processes, folder, files)
    return give_answer(report, args, find_status(results, is_interrupted=is_interrupted),
                       Places(folder / "suite.html", folder / "suite.json", junit),
                       partial(write_junit, suite.title, results))


def read_suite(args: argparse.Namespace, base: JobChoice) -> Suite:
    """The suite that the command line names; every case has been tried.

    Raises:
        InputError: what cannot be used, or an option that a suite file has to say.
    """
    cases: list[Case] = []
    titles: dict[str, str] = {}  # of each suite file
    requirements: dict[str, str] = {}
    files = [Path(args.requirements)] if args.requirements else []
    for name in args.sequence:
        if not is_suite_file(name):
            cases.append(Case(Path(name).stem, base._replace(sequence=name)))
            continue
        require(not (args.model or args.set or args.seed is not None), "--model, --set, --seed", "",
                f"in the suite file {name}, as keys of its cases")
        content, suite_cases = read_suite_file(Path(name), base, is_trusted=args.trust)
        cases += suite_cases
        titles[name] = content.title
        entry = content.requirements  # a file, ids, or texts by id
        files += [Path(name).parent / entry] if isinstance(entry, str) else []
        if not isinstance(entry, str):
            requirements |= dict.fromkeys(entry, "") if isinstance(entry, tuple) else dict(entry)
    for file in files:
        requirements |= read_requirements(file)
    title = next(iter(titles.values())) if len(titles) == 1 else count_nouns(len(args.sequence), "sequence")
    suite = build_suite(title, cases, requirements, ", ".join(titles), is_trusted=args.trust)
    if files:
        require_listed((case.planned for case in suite.cases), requirements, " or ".join(map(str, files)))
    return suite


def choose_processes(args: argparse.Namespace, base: JobChoice, cases: int) -> int:
    """How many cases run at a time: all cores in lockstep on the embedded bus, one on a bus or in real time.

    Raises:
        InputError: --jobs above 1 where only one run at a time is possible.
    """
    is_alone = base.bus.partition(":")[0] not in EMBEDDED_NAMES or base.pace == "realtime"
    require(not is_alone or (args.jobs or 1) == 1, "--jobs", str(args.jobs),
            "1 in real time and on a bus between programs, which the runs share")
    return min(1 if is_alone else args.jobs or len(os.sched_getaffinity(0)), cases)


def announce_suite(suite: Suite, processes: int, *, is_silent: bool) -> Callable[[CaseResult], None]:
    """Say what is about to run; the function returned prints a line for each case that has ended."""
    if is_silent:
        return lambda _: None
    console, number, cases = open_console(), 0, len(suite.cases)

    def show(result: CaseResult) -> None:
        nonlocal number
        number += 1
        line = Text(describe_result(result, number, cases))
        line.stylize(style_of(Cell("", MOODS[result.verdict])), 0, len(result.verdict))
        console.print(line, soft_wrap=True)

    console.print(Text(f"{suite.title}: {count_nouns(cases, 'case')}, {processes} at a time"), soft_wrap=True)
    return show


def describe_result(result: CaseResult, number: int, cases: int) -> str:
    """A line about a case that has ended: verdict, time, its number of all, name, reason."""
    time = f"{result.seconds:7.1f} s" if result.seconds else " " * 9
    reason = f": {result.reason}" if result.reason else ""
    return f"{result.verdict:<14} {time}  {number:>{len(str(cases))}}/{cases}  {result.case.name}{reason}"
