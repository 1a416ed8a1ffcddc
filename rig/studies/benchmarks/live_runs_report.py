"""The report of `rig bench live`."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

from fdi.report.numbers import format_digits
from fdi.report.report import Cell, Column, Item, Line, Mood, Report, Section, Table
from rig.studies.benchmarks.live_runs import AGAIN, SHARES, WITHOUT

_TITLES = {
    "lateness": ("SYNC lateness", "How long after its due time SYNC was sent."),
    "response": ("SYNC to the controller's answer", "From SYNC until the drive frame of the controller arrived."),
    "feedback_response": ("SYNC to feedback", "From SYNC until the kernel received the feedback frame of the plant."),
}
_MOODS: Mapping[str, Mood] = {"slower": "bad", "faster": "", "no difference found": "good", "not known": "doubtful"}


def build_live_runs_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.studies.benchmarks.live_runs.measure_live_runs`, which are its `data`."""
    priority = f"SCHED_FIFO {figures['priority']}" if figures["priority"] else "no real-time priority"
    overruns = ", ".join(f"{name} {count} of {figures['cycles'][name]}" for name, count in figures["overruns"].items())
    lines: list[Item] = [
        Line("measured", f"{figures['seconds']:g} s each in {figures['blocks']} alternating blocks on "
                         f"{figures['bus']}, 1 ms a cycle, {figures['cpus']} CPUs, {priority}"),
        Line("overruns", overruns),
        *(Line("ended early", f"{name}: {count}") for name, count in figures["ended_early"].items() if count),
        *(Line(name, reason) for name, reason in figures["missing"].items())]
    return Report(
        command="bench", title="live", sentence=describe_ratios(figures["ratios"]),
        sections=[Section("With and without", [_tabulate_ratios(figures["ratios"])]),
                  *(Section(title, [_tabulate_times(figures["times_us"][quantity], figures["blocks_us"][quantity],
                                                    caption)]) for quantity, (title, caption) in _TITLES.items()),
                  Section("Conditions", lines)],
        data=dict(figures))


def describe_ratios(ratios: Sequence[Mapping[str, Any]]) -> str:
    """What the ratios say, in one sentence."""
    names = list(dict.fromkeys(ratio["contender"] for ratio in ratios if not ratio["contender"].startswith(WITHOUT)))
    shown = " and ".join(names)
    changed = [f"{ratio['quantity'].replace('_', ' ')} {ratio['share']} {ratio['word']} with {ratio['contender']} "
               f"({format_digits(ratio['ratio'])} times)" for ratio in ratios
               if ratio["word"] in ("slower", "faster") and ratio["contender"] in names]
    if changed:
        return f"{'; '.join(changed)}."
    if any(ratio["word"] == "not known" for ratio in ratios):
        return f"Too few blocks to say whether {shown} changes lateness or response; ask for --blocks 4 or more."
    return f"Lateness and response with {shown} differ from those without by no more than noise."


def _tabulate_ratios(ratios: Sequence[Mapping[str, Any]]) -> Table:
    columns = [Column("percentile"), Column("run"), Column("ratio", align="right"), Column("interval", align="right"),
               Column("")]
    rows: list[list[Cell | str]] = [
        [f"{ratio['quantity'].replace('_', ' ')} {ratio['share']}", ratio["contender"], _format_number(ratio["ratio"]),
         f"{_format_number(ratio['low'])} .. {_format_number(ratio['high'])}" if isfinite(ratio["low"]) else "",
         Cell(ratio["word"], _MOODS[ratio["word"]])] for ratio in ratios]
    return Table(columns, rows, f'To the runs without the screen: geometric means over the blocks. "{AGAIN}": the same '
                                "runs once more, which is the noise. All intervals together hold with 95 %.")


def _format_number(ratio: float) -> str:
    if not ratio < 100.0:
        return "> 100" if ratio >= 100.0 else "-"
    return f"{ratio:.2f}"


def _tabulate_times(times: Mapping[str, Mapping[str, float]], blocks: Mapping[str, Sequence[Mapping[str, float]]],
                    caption: str) -> Table:
    columns = [Column("run"), *(Column(share, "us", "right") for share in SHARES),
               *(Column(f"{share} by block", "us", "right") for share in SHARES)]
    rows = [[name, *(f"{found[share]:.1f}" for share in SHARES),
             *(_describe_spread([block[share] for block in blocks[name] if block]) for share in SHARES)]
            for name, found in times.items() if found]
    return Table(columns, rows, caption)


def _describe_spread(values: Sequence[float]) -> str:
    return f"{min(values):.1f} .. {max(values):.1f}"
