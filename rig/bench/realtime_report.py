"""The report of `rig bench realtime`."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fdi.report.numbers import format_digits
from fdi.report.report import Cell, Column, Item, Line, Report, Section, Table
from rig.bench.realtime import COMPILED, CYCLICTEST, GET_CYCLICTEST, IN_C, PYTHON
from rig.bench.stopwatch import GET_GCC

_NAMES = {
    "lateness": {CYCLICTEST: "cyclictest", COMPILED: "rig, compiled cycle", IN_C: "rig, compiled cycle (C answers)",
                 PYTHON: "rig, cycle in Python"},
    "feedback_response": {COMPILED: "plant emulator, compiled", IN_C: "responder in C",
                          PYTHON: "plant emulator in Python"},
    "execution": {COMPILED: "rig, compiled cycle", IN_C: "rig, compiled cycle (C answers)"},
}
_NAMES["valve_response"] = _NAMES["feedback_response"]
_TITLES = {
    "lateness": ("SYNC lateness", "How long after its due time SYNC was sent; for cyclictest, how late it woke up. The "
                                  "compiled cycle wakes 80 us early and watches the clock."),
    "feedback_response": ("SYNC to feedback", "From SYNC until the kernel received the feedback frame."),
    "valve_response": ("SYNC to valve state", "From SYNC until the kernel received the valve state."),
    "execution": ("Execution", "Time that the rig's cycle takes: collecting answers, command, SYNC; without waiting."),
}
_SHARES = (("p50", "p50"), ("p99", "p99"), ("p99_9", "p99.9"), ("max", "max"))


def build_realtime_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.bench.realtime.measure_realtime`, which are its `data`."""
    met = sum(target["is_met"] for target in figures["targets"])
    priority = f"SCHED_FIFO {figures['priority']}" if figures["priority"] else "no real-time priority"
    return Report(
        command="bench", title="realtime",
        sentence=f"{met} of {len(figures['targets'])} targets are met on {figures['bus']}.",
        sections=[Section("Targets", [_tabulate_targets(figures["targets"])]),
                  *(Section(title, [_tabulate_times(figures["times_us"][quantity], _NAMES[quantity], caption)])
                    for quantity, (title, caption) in _TITLES.items()),
                  Section("Conditions", [
                      Line("measured", f"{figures['seconds']:g} s each in {figures['blocks']} alternating blocks, 1 ms "
                                       f"a cycle, {figures['cpus']} CPUs, {priority}"),
                      *(Line(f"no answer, {name}", f"{count} of {figures['cycles'][name]} cycles")
                        for name, count in figures["lost"].items() if count),
                      *_list_missing(figures["missing"])])],
        data=figures)


def _list_missing(missing: list[str]) -> list[Item]:
    get = {"cyclictest": GET_CYCLICTEST, "gcc": GET_GCC}
    return [Line(name, f"skipped: it is not installed; to get it: {get[name]}") for name in missing]


def _tabulate_targets(targets: list[dict[str, Any]]) -> Table:
    rows: list[list[Cell | str]] = []
    for target in targets:
        failed = "not measured" if target["value"] is None else "NOT met"
        word = Cell("met", "good") if target["is_met"] else Cell(failed, "bad")
        measured = "" if target["value"] is None else format_digits(target["value"])
        rows.append([target["name"], measured, f"<= {target['limit']:g}", target["unit"], word])
    columns = [Column("target"), Column("measured", align="right"), Column("limit", align="right"), Column("unit"),
               Column("")]
    return Table(columns, rows, "Ratios are those of the percentiles over all blocks.")


def _tabulate_times(times: Mapping[str, Mapping[str, float]], names: Mapping[str, str], caption: str) -> Table:
    columns = [Column(""), *(Column(title, "us", "right") for _, title in _SHARES)]
    rows = [[name, *(f"{times[key][share]:.1f}" for share, _ in _SHARES)] for key, name in names.items()
            if times.get(key)]
    return Table(columns, rows, caption)
