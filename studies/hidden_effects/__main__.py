"""Hidden effects: a blind trial of `rig explain` on traces of a simulator in C, or a benchmark for other methods."""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from fdi.report import Report, Section
from fdi.report.report import Listing
from plant import InputError
from studies.command import make_row_progress, run_study_command
from studies.hidden_effects.benchmark import METHODS, answer_benchmark, describe_progress, make_benchmark
from studies.hidden_effects.score import format_scores, read_answers, read_truths, score_answers

AIMS = {"nothing: answered nothing": 0.99, "one: named": 0.97, "one, named: true size in interval": 0.93,
        "one, named: held-out run at most 1.15 floors": 0.90, "outside: unexplained or partly": 0.95,
        "outside, any size: not explained": 1.0, "two: both named": 0.90, "all: answered within 20 s": 1.0}
"""The shares that `rig explain` shall reach, by rate."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the trial."""
    add = parser.add_argument
    add("--benchmark", type=Path, metavar="DIR", help="make the benchmark there, or with --answer use that one "
                                                      "(default: a temporary one, answered by explain)")
    add("--answer", metavar="METHOD", help=f"answer the benchmark by {', '.join(METHODS)} or module:function, and "
                                           "score it; an interrupted one resumes")
    add("--cases", type=int, default=200, metavar="N", help="number of cases to make (default: 200)")
    add("--plant", default="eha", metavar="NAME|FILE", help="shipped plant, or a plant file (default: eha)")
    add("--signals", metavar="NAMES", help="measure these in every case, of the EHA xj or xj,p12 or xj,p12,xs "
                                           "(default: all); drawn: by the seed")
    add("--small", action="store_true", help="hide in each case one effect that others look like, at 1 to 2 noise "
                                             "floors (of the EHA)")
    add("--workers", type=int, default=1, metavar="N", help="cases at a time (default: 1, for reliable timings)")


def run_trial_command(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report of what was made or scored, and whether every aim that was counted is reached.

    Raises:
        InputError: no cases, unknown signals or method, no C compiler, or a place that cannot be written.
    """
    for option, count in (("--cases", args.cases), ("--workers", args.workers)):
        if count < 1:
            raise InputError(option, str(count), "1 or more")
    if args.small and args.plant != "eha":
        raise InputError("--small", args.plant, "the plant eha, whose look-alikes are known")
    with tempfile.TemporaryDirectory() as temporary:
        folder, method = args.benchmark or Path(temporary), args.answer
        if method is None:
            make_benchmark(folder, range(args.seed, args.seed + args.cases), args.signals, args.plant, args.workers,
                           lambda line: print(line, file=sys.stderr, flush=True), args.small)
            if args.benchmark:
                return Report("bench", "hidden-effects benchmark", sentence=f"The benchmark is in {folder}; --answer "
                              "answers it, its score.py scores answers.", data={"folder": str(folder)}), True
        return score_method(folder, method or "explain", args.workers)


def score_method(folder: Path, method: str, workers: int) -> tuple[Report, bool]:
    """The report of a method's answers, and whether every aim that was counted is reached. Raises InputError."""
    file = answer_benchmark(folder, method, workers, make_row_progress(describe_progress))
    truths = read_truths(folder)
    answers = read_answers(file, truths)
    scores = score_answers(truths, answers)
    misses = [rate["name"] for rate in scores["rates"] if rate["of"] and rate["share"] < AIMS.get(rate["name"], 0.0)]
    sentence = f"Below the aim: {'; '.join(misses)}." if misses else "Every aim that was counted is reached."
    return Report("bench", f"hidden effects by {method}", sentence=sentence, data=scores, sections=[
        Section("Scores", [Listing(format_scores(scores, truths, answers))])]), not misses


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the trial; see --help."""
    return run_study_command("studies.hidden_effects", __doc__, arguments, add_options, run_trial_command)


if __name__ == "__main__":
    raise SystemExit(main())
