"""Score of the hidden-effects benchmark: `python score.py FOLDER ANSWERS [--json] [--signals xj,p12,xs]`.

FOLDER holds truth/CASE.json; ANSWERS is a JSON or CSV file as README.md of the benchmark describes. Needs Python 3.10
or newer and nothing else. Exit status 2 and one line on standard error for bad input.
"""
from __future__ import annotations

import argparse
import csv
import json
import math
import random
import signal as processes
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

VERDICTS = ("nothing", "explained", "partly", "ambiguous", "unexplained", "failed")
VISIBLE = 2.0  # noise floors; every hidden effect of this size or more has to be found
NAMES = 3  # so many names of an answer count, the first ones
LARGEST_HOLDOUT = 1.15  # noise floors, error of the worst signal on the held-out run
LONGEST = 20.0  # s, for an answer
RESAMPLES = 1000  # of the cases, for the intervals of precision, recall and F1
KINDS = ("nothing", "one", "two", "outside")

Truth = Mapping[str, Any]
Answer = Mapping[str, Any]
Pair = tuple[Truth, Answer]


class ScoreError(ValueError):
    """Bad input, in one line: file, field, what was expected."""


class Rate(NamedTuple):
    """How many cases of a kind have a property."""

    name: str
    good: int
    of: int
    low: float  # exact 95 % interval of the share
    high: float
    without: list[str]  # cases that have it not

    @property
    def share(self) -> float | None:
        """The share of good cases; None without a case."""
        return self.good / self.of if self.of else None


def read_truths(folder: Path) -> dict[str, Truth]:
    """The truths of a benchmark by case. Raises ScoreError."""
    files = sorted((folder / "truth").glob("*.json"))
    if not files:
        raise ScoreError(f"{folder}: expected a folder with truth/CASE.json")
    return {file.stem: _read_json(file) for file in files}


def _read_json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ScoreError(f"{file}: expected a JSON file ({' '.join(str(error).split())})") from None


def read_answers(file: Path, cases: Iterable[str]) -> dict[str, Answer]:
    """The answers by case, checked; only some of the `cases` need an answer. Raises ScoreError."""
    answers = _read_table(file) if file.suffix == ".csv" else _read_json(file)
    answers = answers.get("answers", answers) if isinstance(answers, dict) else answers
    if not isinstance(answers, dict) or not answers:
        raise ScoreError(f"{file}: expected an object with one entry per case")
    case_names = set(cases)
    for case, answer in answers.items():
        fault = _find_fault(answer) if case in case_names else "case: expected one of the benchmark"
        if fault:
            raise ScoreError(f"{file}: case {case}: {fault}")
    return answers


def _find_fault(answer: Any) -> str:
    """What is wrong with an answer, field and expectation; empty if nothing is."""
    if not isinstance(answer, dict) or answer.get("verdict") not in VERDICTS:
        return "verdict: expected " + ", ".join(VERDICTS)
    for field, words in (("effects", "a list of names, the likeliest first"), ("where", "a list of signal/section")):
        entry = answer.get(field) or []
        if not isinstance(entry, list) or not all(isinstance(word, str) for word in entry):
            return f"{field}: expected {words}"
    sizes, holdout = answer.get("sizes") or {}, answer.get("holdout") or {}
    if not isinstance(sizes, dict) or not all(isinstance(size, dict) for size in sizes.values()):
        return "sizes: expected value, low and high by effect"
    numbers = [answer.get("seconds"), *(x for size in sizes.values() for x in size.values())]
    numbers += list(holdout.values()) if isinstance(holdout, dict) else ["no object"]
    if not all(x is None or (isinstance(x, (int, float)) and math.isfinite(x)) for x in numbers):
        return "sizes, holdout, seconds: expected finite numbers, or null"
    return ""


def _read_table(file: Path) -> dict[str, Answer]:
    """Answers of a CSV file: case,verdict,effects,sizes,where; several names, sizes or places with ; between them."""
    answers: dict[str, Answer] = {}
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            for row in csv.DictReader(lines):
                names, places = ([word for word in (row.get(key) or "").split(";") if word]
                                 for key in ("effects", "where"))
                sizes = [list(map(float, text.split())) for text in (row.get("sizes") or "").split(";") if text.strip()]
                answers[row["case"]] = {
                    "verdict": row["verdict"], "effects": names, "where": places,
                    "sizes": {name: dict(zip(("value", "low", "high"), size, strict=True))
                              for name, size in zip(names, sizes, strict=False)}}
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ScoreError(f"{file}: expected the columns case,verdict,effects,sizes,where, sizes as `value low high;..` "
                         f"({' '.join(str(error).split())})") from None
    return answers


def list_names(truth: Truth) -> set[str]:
    """The names of the hidden effects."""
    return {effect["name"] for effect in truth["effects"]}


def is_visible(truth: Truth) -> bool:
    """Whether each hidden effect, and all together, show in some signal by `VISIBLE` noise floors."""
    return all(max(each["floors"].values()) >= VISIBLE for each in (truth, *truth["effects"]))


def is_named(truth: Truth, answer: Answer) -> bool:
    """Whether the first names of the answer have all hidden effects among them."""
    return list_names(truth) <= set((answer.get("effects") or [])[:NAMES])


def is_named_alone(truth: Truth, answer: Answer) -> bool:
    """Whether the answer is that the hidden effects, and no others, explain the traces."""
    return answer["verdict"] == "explained" and set(answer.get("effects") or []) == list_names(truth)


def is_wrong_alone(truth: Truth, answer: Answer) -> bool:
    """Whether the answer names effects, and no hidden one is among them."""
    return bool(answer.get("effects")) and not list_names(truth) & set(answer["effects"])


def is_size_covered(truth: Truth, answer: Answer) -> bool | None:
    """Whether all intervals given for hidden effects hold the true size; None without one, or where one is not named.
    """
    sizes = answer.get("sizes") or {}
    within = [size["low"] <= effect["value"] <= size["high"] for effect in truth["effects"]
              if (size := sizes.get(effect["name"])) and effect["value"] is not None
              and size.get("low") is not None and size.get("high") is not None]
    return all(within) if within and is_named(truth, answer) else None


def is_holdout_predicted(truth: Truth, answer: Answer) -> bool | None:
    """Whether the error on the held-out run is at most `LARGEST_HOLDOUT` floors; None where it is not given."""
    errors, noise = answer.get("holdout") or {}, truth["holdout_noise"]
    ratios = [errors[signal] / noise[signal] for signal in errors if noise.get(signal) and errors[signal] is not None]
    return max(ratios) <= LARGEST_HOLDOUT if ratios else None


def _has_verdict(*verdicts: str) -> Callable[[Truth, Answer], bool]:
    return lambda truth, answer: answer["verdict"] in verdicts


def count_rates(pairs: Mapping[str, Pair]) -> list[Rate]:
    """The rates by kind."""
    kinds = {kind: {case: pair for case, pair in pairs.items() if pair[0]["kind"] == kind} for kind in KINDS}
    visible = {kind: {case: pair for case, pair in group.items() if is_visible(pair[0])}
               for kind, group in kinds.items()}
    right = {case: pair for case, pair in visible["one"].items() if is_named(*pair)}
    small = {case: pair for case, pair in kinds["one"].items() if case not in visible["one"]}
    table: list[tuple[str, Mapping[str, Pair], Callable[[Truth, Answer], bool | None]]] = [
        ("nothing: answered nothing", kinds["nothing"], _has_verdict("nothing")),
        ("nothing: an effect is named", kinds["nothing"], is_wrong_alone),
        ("one: named", visible["one"], is_named),
        ("one: named alone, explained", visible["one"], is_named_alone),
        ("one: wrong alone", visible["one"], is_wrong_alone),
        ("one, below 2 floors: named", small, is_named),
        ("one, below 2 floors: wrong alone", small, is_wrong_alone),
        ("one, named: true size in interval", right, is_size_covered),
        ("one, named: held-out run at most 1.15 floors", right, is_holdout_predicted),
        ("two: both named", visible["two"], is_named),
        ("two: wrong alone", visible["two"], is_wrong_alone),
        ("two, named: true sizes in intervals", visible["two"], is_size_covered),
        ("outside: unexplained or partly", visible["outside"], _has_verdict("unexplained", "partly")),
        ("outside, any size: not explained", kinds["outside"], lambda _, answer: answer["verdict"] != "explained"),
        ("all: answered within 20 s", pairs,
         lambda _, answer: answer["seconds"] <= LONGEST if answer.get("seconds") is not None else None),
    ]
    return [count_rate(*row) for row in table]


def count_rate(name: str, pairs: Mapping[str, Pair], is_good: Callable[[Truth, Answer], bool | None]) -> Rate:
    """How many cases are good; those for which `is_good` gives None do not count."""
    outcomes = {case: good for case, pair in pairs.items() if (good := is_good(*pair)) is not None}
    count = sum(outcomes.values())
    return Rate(name, count, len(outcomes), *compute_interval(count, len(outcomes)),
                [case for case, good in outcomes.items() if not good])


def compute_interval(good: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """The interval of Clopper and Pearson of a probability after `good` of `of` successes; 0 to 1 without trials.

    C. J. Clopper, E. S. Pearson, Biometrika 26 (1934) 404-413.
    """
    tail = (1.0 - confidence) / 2

    def solve(count: int, target: float) -> float:
        """p at which `count` or more successes of `of` have the probability `target`."""
        low, high = 0.0, 1.0
        for _ in range(60):
            p = (low + high) / 2
            logs = (math.lgamma(of + 1) - math.lgamma(k + 1) - math.lgamma(of - k + 1) + k * math.log(p)
                    + (of - k) * math.log1p(-p) for k in range(count, of + 1))
            low, high = (p, high) if math.fsum(map(math.exp, logs)) < target else (low, p)
        return (low + high) / 2

    return (solve(good, tail) if good > 0 else 0.0), (solve(good + 1, 1.0 - tail) if good < of else 1.0)


def score_places(pairs: Mapping[str, Pair]) -> dict[str, Any]:
    """Precision, recall and F1 of the cells "signal/section" blamed, with 95 % intervals by bootstrap over the cases.

    They are counted over the cases with nothing hidden and the visible ones; an answer without `where` blames no cell.
    """
    cases = [(set(truth["where"]), set(answer.get("where") or [])) for truth, answer in pairs.values()
             if truth["where"] is not None and (is_visible(truth) or not truth["effects"])]
    if not any(blamed for _, blamed in cases):
        return {"cases": len(cases)}

    def measure(sample: Sequence[tuple[set[str], set[str]]]) -> dict[str, float]:
        hits = sum(len(acts & blamed) for acts, blamed in sample)
        blamed, acts = sum(len(b) for _, b in sample), sum(len(a) for a, _ in sample)
        return {"precision": hits / max(blamed, 1), "recall": hits / max(acts, 1),
                "F1": 2 * hits / max(blamed + acts, 1)}

    draw = random.Random(0)
    samples = [measure(draw.choices(cases, k=len(cases))) for _ in range(RESAMPLES)]
    scores: dict[str, Any] = {"cases": len(cases)}
    for name, value in measure(cases).items():
        sample_values = sorted(sample[name] for sample in samples)
        scores[name] = {"value": value, "low": sample_values[round(0.025 * RESAMPLES)],
                        "high": sample_values[round(0.975 * RESAMPLES) - 1]}
    return scores


def score_answers(truths: Mapping[str, Truth], answers: Mapping[str, Answer]) -> dict[str, Any]:
    """All figures of merit as JSON values; cases without an answer count as failed."""
    pairs = {case: (truth, answers.get(case, {"verdict": "failed"})) for case, truth in truths.items()}
    seconds = sorted(answer["seconds"] for answer in answers.values() if answer.get("seconds") is not None)
    names = [len(answer.get("effects") or []) for truth, answer in pairs.values()
             if truth["kind"] == "one" and is_visible(truth) and is_named(truth, answer)]
    groups = {"all": pairs} | {kind: {case: pair for case, pair in pairs.items() if pair[0]["kind"] == kind}
                               for kind in KINDS[1:]}
    for signal in sorted({cell.partition("/")[0] for truth in truths.values() for cell in truth["where"] or ()}):
        groups[signal] = {case: ({**truth, "where": _take_signal(truth["where"], signal)},
                                 {**answer, "where": _take_signal(answer.get("where"), signal)})
                          for case, (truth, answer) in pairs.items()}
    return {"cases": len(truths), "answered": len(answers),
            "rates": [{**rate._asdict(), "share": rate.share} for rate in count_rates(pairs)],
            "where": {name: score_places(group) for name, group in groups.items()},
            "names_on_average": sum(names) / len(names) if names else None,
            "seconds": {"median": seconds[len(seconds) // 2], "longest": seconds[-1]} if seconds else {}}


def _take_signal(cells: Iterable[str] | None, signal: str) -> list[str]:
    return [cell for cell in cells or () if cell.partition("/")[0] == signal]


def describe_miss(case: str, truth: Truth, answer: Answer) -> str:
    """A case in one line: what is hidden and how large, and what was answered."""
    effects = ", ".join(f"{effect['name']} {effect['size']:.3g}" for effect in truth["effects"]) or "nothing"
    floors = max(truth["floors"].values())
    return f"{case}  {effects} ({floors:.1f} floors) -> {answer['verdict']} {', '.join(answer.get('effects') or [])}"


def format_scores(scores: Mapping[str, Any], truths: Mapping[str, Truth], answers: Mapping[str, Answer]) -> str:
    """The figures of merit as text."""
    lines = [f"{scores['answered']} of {scores['cases']} cases answered", "",
             f"{'rate':46}{'counted':>11}{'share':>8}   95 % interval"]
    for rate in scores["rates"]:
        if rate["of"]:
            lines.append(f"{rate['name']:46}{rate['good']:5d} of {rate['of']:3d}{100 * rate['share']:6.1f} %   "
                         f"{100 * rate['low']:.1f} .. {100 * rate['high']:.1f} %")
    for words, places in scores["where"].items():
        parts = [f"{name} {places[name]['value']:.2f} ({places[name]['low']:.2f} .. {places[name]['high']:.2f})"
                 for name in ("precision", "recall", "F1") if name in places]
        lines.append(f"where, {words}: " + (", ".join(parts) or "not given"))
    if scores["names_on_average"]:
        lines.append(f"names in a right answer to one effect: {scores['names_on_average']:.2f} on average")
    if scores["seconds"]:
        lines.append(f"time: {scores['seconds']['median']:.1f} s median, {scores['seconds']['longest']:.1f} s longest")
    misses = {case for rate in scores["rates"] for case in rate["without"]
              if rate["name"] in ("nothing: answered nothing", "one: named", "two: both named",
                                  "outside: unexplained or partly", "outside, any size: not explained")}
    return "\n".join([*lines, "", "missed:", *(
        describe_miss(case, truths[case], answers.get(case, {"verdict": "failed"})) for case in sorted(misses))])


def main(arguments: Sequence[str] | None = None) -> int:
    """Score answers; see --help."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of the benchmark")
    parser.add_argument("answers", type=Path, help="answers, JSON or CSV")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--signals", help="count only cases in which these are measured, such as xj,p12,xs")
    args = parser.parse_args(arguments)
    try:
        truths = read_truths(args.folder)
        answers = read_answers(args.answers, truths)
    except ScoreError as error:
        print(f"score.py: {error}", file=sys.stderr)
        return 2
    truths = {case: truth for case, truth in truths.items() if args.signals in (None, truth["signals"])}
    answers = {case: answer for case, answer in answers.items() if case in truths}
    scores = score_answers(truths, answers)
    print(json.dumps(scores, indent=1) if args.json else format_scores(scores, truths, answers))
    return 0


if __name__ == "__main__":
    processes.signal(processes.SIGPIPE, processes.SIG_DFL)  # whoever reads the output may stop, as `head` does
    raise SystemExit(main())
