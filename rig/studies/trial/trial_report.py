"""The report of a blind trial: how often `rig explain` was right, and every case that counts against a rate."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fdi.report.numbers import NO_NUMBER, format_duration
from fdi.report.report import Cell, Column, Item, Line, Report, Section, Table
from rig.studies.resumable.batch import BatchProgress


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
    """Report on the figures of `rig.studies.trial.trial_score.summarise_trial`, which are its `data`."""
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
