"""The report of `rig bench plant`: what the plant costs, beside C."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fdi.report.numbers import format_digits
from fdi.report.report import Cell, Column, Item, Line, Report, Section, Table
from rig.bench.stopwatch import GET_GCC


def build_plant_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.bench.plant.run_benchmarks`, which are its `data`.

    They may hold "accuracy": rows of `rig.bench.plant.Accuracy` as dicts.
    """
    accuracy = [_tabulate_accuracy(figures["accuracy"])] if figures.get("accuracy") else []
    return Report(
        command="bench", title="plant",
        sentence=f"The preflight is simulated at {figures['times_real_time']:.0f} times real time.",
        sections=[Section("The plant", _list_costs(figures)),
                  Section("Accuracy", accuracy)],
        data=figures)


def _list_costs(figures: Mapping[str, Any]) -> list[Item]:
    step = figures["step"]
    rows: list[list[Cell | str]] = [
        ["preflight, simulated", f"{figures['times_real_time']:.0f} x real time", "", ""],
        ["preflight on the embedded bus", f"{figures['lockstep']:.1f} x real time", "", ""],
        ["rig run preflight, the whole process", f"{figures['run_process']:.1f} x real time", "", ""],
        ["rig --help, the whole process", f"{figures['help_process']:.2f} s", "", ""],
        ["one cycle of Actuator from Python", f"{figures['cycle'] * 1e6:.1f} us", "", ""]]
    if step is not None:
        is_same = step["identical"]
        same = Cell("equal bit for bit", "good") if is_same else Cell("NOT equal", "bad")
        rows += [
            ["one step, compiled Python", f"{step['python']:.1f} ns", "", ""],
            [f"one step, {step['compiler']} -O3 -march=native", f"{step['c']:.1f} ns", format_digits(step["ratio"]),
             f"within {step['difference'] * 1e6:.0e} um"],
            ["one step, gcc with -ffp-contract=off", f"{step['c_same_rounding']:.1f} ns",
             format_digits(step["ratio_same_rounding"]), same]]
    columns = [Column("work"), Column("cost", align="right"), Column("Python / C", align="right"), Column("result")]
    items: list[Item] = [Table(columns, rows, "Python / C: time of the compiled Python step over that of C. Result: "
                                              "difference between both steps.")]
    if step is None:
        items.append(Line("C", f"skipped: gcc is not installed; to get it: {GET_GCC}"))
    return items


def _tabulate_accuracy(accuracy: Sequence[Mapping[str, Any]]) -> Table:
    columns = [Column("step", "us", "right"), Column("friction off: RMS", "um", "right"), Column("max", "um", "right"),
               Column("friction on: RMS", "um", "right"), Column("max", "um", "right")]
    rows = [[f"{1000 / row['steps']:g}", f"{row['rms']:.4f}", f"{row['largest']:.4f}", f"{row['rms_friction']:.2f}",
             f"{row['largest_friction']:.2f}"] for row in accuracy]
    return Table(columns, rows, "Error of XJ over the closed-loop preflight, against steps of 0.2 us.")
