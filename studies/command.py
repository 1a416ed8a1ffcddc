"""What the commands `python -m studies.NAME` share: options, progress on standard error, the answer."""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from fdi.report import Report
from plant import RigError
from rig.campaign.batch import Batch, BatchProgress, Row, RowFile, Workers, run_batch
from rig.cli import Places, choose_file, give_answer, parse_whole_number

Job = TypeVar("Job")


def run_study_command(name: str, text: str | None, arguments: Sequence[str] | None,
                      add_options: Callable[[argparse.ArgumentParser], None],
                      run: Callable[[argparse.Namespace], tuple[Report, bool]]) -> int:
    """Parse the options, run the study, show its report; exit status 0 if it met its aims, 1 if not, 2 for bad input.

    Args:
        name: the module, "studies.peers".
        text: its docstring; the first line is the description.
        arguments: the words of the command line; None for those of the process.
        add_options: adds the study's own options to --seed, --json, --quiet and --out FILE.json.
        run: from the options to the report and whether the study met its aims.
    """
    parser = start_parser(name, text)
    add_options(parser)
    parser.add_argument("--seed", type=parse_whole_number, default=0, metavar="N", help="seed (default 0)")
    parser.add_argument("--json", action="store_true", help="print one JSON object on standard output, nothing else")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--out", metavar="FILE.json", help="also write the JSON there")
    args = parser.parse_args(arguments)
    try:
        out = choose_file(args.out, (".json",), None)
        report, is_met = run(args)
        return give_answer(report, args, int(not is_met), Places(answer=out))
    except RigError as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return error.status


def start_parser(name: str, text: str | None) -> argparse.ArgumentParser:
    """A parser for the module `name`; the first line of its docstring `text` is the description."""
    return argparse.ArgumentParser(prog=f"python -m {name}", description=(text or "").splitlines()[0])


def report_progress(stage: str, share: float) -> None:
    """A line on standard error for each tenth of a stage."""
    done = (stage, round(10 * share))
    if report_progress.__dict__.get("last") != done:
        report_progress.__dict__["last"] = done
        print(f"{stage}: {100 * share:.0f} %" if share else stage, file=sys.stderr, flush=True)


def run_cases(jobs: Mapping[int, Job], judge: Callable[[Job], Row], describe: Callable[[Job], Row], sources: str,
              file: Path, report_progress: Callable[[BatchProgress], None]) -> list[Row]:
    """The rows of all cases; those that the file has from the same sources stay, but for crashed ones.

    Args:
        jobs: the cases by number.
        judge: from a case to its row, with the `sources`.
        describe: what a row says of a case that crashed.
        sources: hash of the code that the rows depend on.
        file: where the rows go.
        report_progress: called with each row.
    """
    def describe_failure(job: Job, reason: str) -> Row:
        return {**describe(job), "verdict": "CRASHED", "error": reason, "sources": sources}

    batch = Batch(jobs, judge, "case", describe_failure, lambda row: bool(row["sources"] == sources),
                  lambda row: bool(row["verdict"] == "CRASHED"))
    with RowFile(file) as rows:
        return list(run_batch(batch, rows, Workers(1), report_progress).values())


def make_row_progress(describe: Callable[[BatchProgress], str]) -> Callable[[Any], None]:
    """A progress function of a batch that prints a line for each finished row on standard error."""
    return lambda progress: print(describe(progress), file=sys.stderr, flush=True)
