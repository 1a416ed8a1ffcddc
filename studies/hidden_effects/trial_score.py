"""How often an explanation was right: the trial's rows counted against the required rates."""
from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from fdi.estimation.binomial import clopper_pearson_interval
from fdi.report.numbers import NO_NUMBER, format_duration
from fdi.report.report import Cell, Column, Item, Line, Report, Section, Table
from plant.effects import Effect
from plant.plants import Plant, find_plant
from rig.campaign.batch import BatchProgress

Record = Mapping[str, Any]
"""A row of results.jsonl."""

VISIBLE = 2.0  # noise floors; a hidden effect of this size or more has to be found
TIME = 20.0  # s, for an answer


class Rate(NamedTuple):
    """A required share of right answers, and the share that was counted."""

    name: str
    good: int
    of: int
    asked: float
    low: float  # exact binomial interval, 95 %
    high: float
    bad: tuple[int, ...]  # seeds

    @property
    def share(self) -> float:
        """The share of right answers; NaN if there was no case."""
        return self.good / self.of if self.of else math.nan

    @property
    def met(self) -> bool:
        """Whether the share reaches what is required; False if there was no case."""
        return self.of > 0 and self.share >= self.asked


def measure_visibility(record: Record, ratio: Mapping[str, float] | None = None) -> float:
    """The largest size of the hidden effects in noise floors, over the signals of the case and the controller's answer.

    `ratio` is that of one effect; default: of all together. The position counts by its differences over 20 cycles,
    because the position of a replay drifts with any difference.
    """
    ratios = record["truth"]["base_ratio"] if ratio is None else ratio
    return max(ratios[name] for name in [*record["truth"]["signals"].split(","), "controller"])


def is_truth_named(record: Record) -> bool:
    """Whether the answer names all hidden effects."""
    return set(record["truth"]["effects"]) <= set(record["answer"]["effects"])


def is_truth_admitted(record: Record) -> bool:
    """Whether the answer names the hidden effect, or says that at its size it is not detectable in this test."""
    hidden = record["truth"]["hidden"][0]
    entry = _find_hidden_effect(record)
    size = abs(hidden["value"] - entry.off.get(entry.fitted[0], 0.0))
    blind_to = record["answer"].get("blind_to") or ()
    return is_truth_named(record) or any(each["effect"] == entry.name and size <= each["usual"] for each in blind_to)


def is_truth_covered(record: Record) -> bool | None:
    """Whether the interval of the hidden effect's first parameter contains the truth; None without an interval."""
    hidden = record["truth"]["hidden"][0]
    parameter = _find_hidden_effect(record).fitted[0]
    estimate = _find_candidate(record, hidden["effect"]).get("parameters", {}).get(parameter)
    if estimate is None or estimate.get("low") is None or math.isnan(hidden["value"]):
        return None
    return bool(estimate["low"] <= hidden["value"] <= estimate["high"])


def _find_hidden_effect(record: Record) -> Effect:
    return _find_plant(record).find_effect(record["truth"]["hidden"][0]["effect"])


def _find_plant(record: Record) -> Plant:
    """The plant of a case: `model` of its truth; the cases of the EHA, whose table `plant` has its symbols, name none.
    """
    return find_plant(record["truth"].get("model", "eha"))


def measure_holdout_error(record: Record) -> float | None:
    """The error on the held-out run with the right effect added, in noise floors: worst signal; None if unknown."""
    floors = (record["answer"].get("baseline") or {}).get("floor") or {}
    errors = _find_candidate(record, record["truth"]["effects"][0]).get("holdout") or {}
    ratios = [errors[name] / floors[name] for name in errors if floors.get(name)]
    return max(ratios) if ratios else None


def _find_candidate(record: Record, effect: str) -> Mapping[str, Any]:
    """The answer's candidate with this effect; empty if it has none."""
    for candidate in record["answer"].get("candidates", []):
        if candidate["effect"] == effect:
            return candidate  # type: ignore[no-any-return]
    return {}


def _select_kind(records: Iterable[Record], kind: str) -> list[Record]:
    return [record for record in records if record["truth"]["kind"] == kind]


def is_visible(record: Record) -> bool:
    """Whether every hidden effect is large enough that it has to be found."""
    each = [hidden["ratio"] for hidden in record["truth"]["hidden"] if "ratio" in hidden]
    return all(measure_visibility(record, ratio) >= VISIBLE for ratio in (None, *each))


def select_visible(records: Iterable[Record], kind: str) -> list[Record]:
    """The cases of a kind whose hidden effects have to be found."""
    return [record for record in _select_kind(records, kind) if is_visible(record)]


def count_rates(records: Sequence[Record]) -> list[Rate]:
    """The required rates, each with its count."""
    one, outside = select_visible(records, "one"), select_visible(records, "outside")
    right = [record for record in one if is_truth_named(record)]

    def has_verdict(*verdicts: str) -> Callable[[Record], bool]:
        return lambda record: record["answer"]["verdict"] in verdicts

    def is_holdout_explained(record: Record) -> bool | None:
        error = measure_holdout_error(record)
        largest_ratio = 1.15  # noise floors; largest error on the held-out run with the right effect added
        return None if error is None else error <= largest_ratio

    def is_not_explained(record: Record) -> bool:
        return bool(record["answer"]["verdict"] != "EXPLAINED")

    def is_in_time(record: Record) -> bool:
        return bool(record["seconds"] <= TIME)

    return [
        count_rate("nothing missing: NOTHING_MISSING", _select_kind(records, "nothing"), 0.99,
                   has_verdict("NOTHING_MISSING")),
        count_rate("one effect: the truth is named", one, 0.97, is_truth_named),
        count_rate("  or listed as not detectable at its size", one, 0.97, is_truth_admitted),
        count_rate("  its 95 % interval holds the truth", right, 0.93, is_truth_covered),
        count_rate("  hold-out at most 1.15 floors with it", right, 0.90, is_holdout_explained),
        count_rate("outside the catalogue: UNEXPLAINED or PARTLY", outside, 0.95,
                   has_verdict("UNEXPLAINED", "PARTLY")),
        count_rate("outside the catalogue: never EXPLAINED", _select_kind(records, "outside"), 1.0, is_not_explained),
        count_rate("two effects: both named", select_visible(records, "two"), 0.90, is_truth_named),
        count_rate("answer within 20 s", records, 1.0, is_in_time),
    ]


def count_rate(name: str, records: Iterable[Record], asked: float, is_good: Callable[[Record], bool | None]) -> Rate:
    """How many cases are good; those for which `is_good` gives None do not count."""
    judged = {int(record["seed"]): is_good(record) for record in records}
    counted = {seed: good for seed, good in judged.items() if good is not None}
    low, high = clopper_pearson_interval(sum(counted.values()), len(counted))
    bad = tuple(seed for seed, good in counted.items() if not good)
    return Rate(name, sum(counted.values()), len(counted), asked, low, high, bad)


def average_named_effects(records: Sequence[Record]) -> float:
    """The mean number of named effects over the cases whose single hidden effect is among them; NaN without cases."""
    sizes = [len(record["answer"]["effects"]) for record in select_visible(records, "one") if is_truth_named(record)]
    return sum(sizes) / len(sizes) if sizes else math.nan


def count_confusion(records: Iterable[Record]) -> dict[str, Counter[str]]:
    """Truth to answer to number of cases."""
    table: dict[str, Counter[str]] = {}
    for record in records:
        table.setdefault(_classify_truth(record), Counter())[_classify_answer(record)] += 1
    return {row: table[row] for row in sorted(table)}


def _classify_truth(record: Record) -> str:
    """The kind of a case; of one effect its name as well, and whether the effect is too small to be required."""
    kind, effects = str(record["truth"]["kind"]), record["truth"]["effects"]
    if kind == "nothing":
        return kind
    size = "" if is_visible(record) else " (small)"
    return f"two{size}" if kind == "two" else f"{kind}: {effects[0]}{size}"


def _classify_answer(record: Record) -> str:
    """The verdict; where an effect of the catalogue is hidden and one is named, whether the naming is right."""
    verdict, effects = str(record["answer"]["verdict"]), record["answer"]["effects"]
    if not effects or record["truth"]["kind"] in ("nothing", "outside"):
        return verdict
    return f"{verdict} right" if is_truth_named(record) else f"{verdict} wrong"


def list_failures(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Every case that counts against a rate: what is hidden, and what the answer was."""
    missed: dict[int, list[str]] = {}
    for rate in count_rates(records):
        for seed in rate.bad:
            missed.setdefault(seed, []).append(rate.name.strip())
    by_seed = {record["seed"]: record for record in records}
    return [_describe_failure(by_seed[seed], against) for seed, against in sorted(missed.items())]


def _describe_failure(record: Record, against: Sequence[str]) -> dict[str, Any]:
    truth, answer = record["truth"], record["answer"]
    return {"seed": record["seed"], "against": against, "signals": truth["signals"],
            "hidden": {hidden["effect"]: hidden["size"] for hidden in truth.get("hidden", [])},
            "floors": measure_visibility(record), "verdict": answer["verdict"], "named": answer["effects"],
            "error": answer.get("error")}


def summarise_trial(records: Sequence[Record]) -> dict[str, Any]:
    """All figures as JSON values: the rates over cases with all signals, and their counts by the measured signals."""
    outputs = [s.name for s in _find_plant(records[0]).signals.outputs]
    groups = [",".join(outputs[:count]) for count in range(len(outputs), 0, -1)]  # the rates are required of the first
    by_signals = {signals: [record for record in records if record["truth"]["signals"] == signals]
                  for signals in groups}
    names = average_named_effects(by_signals[groups[0]])
    seconds = sorted(record["seconds"] for record in records)
    return {"cases": len(records),
            "rates": [rate._asdict() | {"share": rate.share if rate.of else None, "met": rate.met}
                      for rate in count_rates(by_signals[groups[0]])],
            "by_signals": {signals: {rate.name: [rate.good, rate.of] for rate in count_rates(group)}
                           for signals, group in by_signals.items()},
            "names_on_average": None if math.isnan(names) else names,
            "confusion": {row: dict(counts) for row, counts in count_confusion(records).items()},
            "seconds": {"median": seconds[len(seconds) // 2], "most": seconds[-1]} if seconds else {},
            "failures": list_failures(records)}


def describe_progress(progress: BatchProgress) -> str:
    """One finished case in one line: what was hidden, what was answered, and the time left."""
    row = progress.row
    answer = row["answer"]
    named = ", ".join(answer["effects"] or []) or NO_NUMBER
    hidden = {effect["effect"]: effect["size"] for effect in row["truth"].get("hidden", [])}
    return (f"{progress.done}/{progress.total}, {format_duration(progress.left)} left: seed {row['seed']}, "
            f"{_describe_hidden(hidden)} -> {answer['verdict']} {named}, {row['seconds']:.1f} s")


def _describe_hidden(sizes: Mapping[str, float]) -> str:
    return ", ".join(f"{effect} {size:.3g}" for effect, size in sizes.items()) or "nothing"


def build_trial_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `studies.hidden_effects.trial_score.summarise_trial`, which are its `data`."""
    missed = [rate["name"].strip() for rate in figures["rates"] if rate["of"] and not rate["met"]]
    if missed:
        sentence = f"{len(missed)} rates are not met: {'; '.join(missed)}."
    elif any(rate["of"] for rate in figures["rates"]):
        sentence = "Every counted rate is met."
    else:
        sentence = "No rate is required of them: in none are all three signals measured."
    return Report(
        command="bench", title="blind trial of rig explain", sentence=f"{figures['cases']} cases. {sentence}",
        sections=[Section("Rates", [_tabulate_rates(figures["rates"]), _tabulate_by_signals(figures["by_signals"])]),
                  Section("Averages", _list_averages(figures)),
                  Section("Answers", [_tabulate_answers(figures["confusion"])]),
                  Section("Cases against a rate", _tabulate_failures(figures["failures"]))],
        data=figures)


def _tabulate_rates(rates: Sequence[Mapping[str, Any]]) -> Table:
    columns = [Column("all signals measured"),
               *(Column(title, align="right") for title in ("count", "share", "95 % interval", "required", "verdict"))]
    rows = []
    for rate in rates:
        share = NO_NUMBER if rate["share"] is None else f"{100 * rate['share']:.1f} %"
        interval = f"{100 * rate['low']:.1f} .. {100 * rate['high']:.1f}" if rate["of"] else ""
        rows.append([rate["name"], f"{rate['good']}/{rate['of']}", share, interval, f"{100 * rate['asked']:.0f} %",
                     _judge_rate(rate)])
    return Table(columns, rows, "Rates with their exact 95 % intervals, beside what is required of them.")


def _judge_rate(rate: Mapping[str, Any]) -> Cell:
    if not rate["of"]:
        return Cell("")
    return Cell("met", "good") if rate["met"] else Cell("NOT met", "bad")


def _tabulate_by_signals(counts: Mapping[str, Mapping[str, Sequence[int]]]) -> Table:
    columns = [Column("measured signals"), *(Column(signals, align="right") for signals in counts)]
    rows = [[name, *(f"{of[name][0]}/{of[name][1]}" for of in counts.values())] for name in next(iter(counts.values()))]
    return Table(columns, rows, "The same rates by the signals that are measured: fewer signals make more effects "
                                "indistinguishable.")


def _list_averages(figures: Mapping[str, Any]) -> list[Item]:
    items: list[Item] = []
    if figures["names_on_average"] is not None:
        items.append(Line("named effects", f"{figures['names_on_average']:.2f} on average, where the hidden effect is "
                                           "among them (required: at most 3)"))
    if figures["seconds"]:
        took = figures["seconds"]
        items.append(Line("time a case", f"{took['median']:.1f} s (median), {took['most']:.1f} s (longest)"))
    return items


def _tabulate_answers(confusion: Mapping[str, Mapping[str, int]]) -> Table:
    """By truth, because verdicts times right and wrong are too many columns for a terminal."""
    rows = []
    for truth, counts in confusion.items():
        ranked = sorted(counts.items(), key=lambda item: -item[1])
        rows.append([truth, ", ".join(f"{count} {answer}" for answer, count in ranked)])
    return Table([Column("truth"), Column("answers")], rows, "What was answered, by what was hidden.")


def _tabulate_failures(failures: Sequence[Mapping[str, Any]]) -> list[Item]:
    if not failures:
        return []
    columns = [Column("seed", align="right"), Column("signals"), Column("hidden"), Column("floors", align="right"),
               Column("answer"), Column("against")]
    rows = []
    for failure in failures:
        answer = " ".join([failure["verdict"], ", ".join(failure["named"] or []), failure["error"] or ""]).strip()
        rows.append([str(failure["seed"]), failure["signals"], _describe_hidden(failure["hidden"]),
                     f"{failure['floors']:.1f}", answer, "; ".join(failure["against"])])
    return [Table(columns, rows, "Cases that count against a rate; floors: size of the hidden effect in its most "
                                 "sensitive signal, in units of the noise floor.")]
