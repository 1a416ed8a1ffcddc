"""The cost of the plant beside C, and of whole processes.

Costs are medians over rounds that alternate between the rivals, in one process.
"""
from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi.progress import Progress, ignore_progress
from fdi.report.numbers import format_digits
from fdi.report.report import Cell, Column, Item, Line, Report, Section, Table, tabulate
from fdi.trace.trace import Floats
from plant import Actuator, simulate
from plant.model import Model, build_kernel
from plant.run import sample_noise
from plant.solve import run_closed_loop
from rig.bench.realtime import (
    FLAGS,
    GET_GCC,
    SAME_ROUNDING,
    Work,
    build_library,
    find_gcc,
    measure_durations,
    measure_median_duration,
)
from rig.run.outcome import INTERRUPTED
from rig.sequences import load_sequence

FRICTIONLESS = {f"{body}.{kind}_friction": 0.0 for body in ("spool", "jack") for kind in ("static", "dynamic")}
QUIET = {f"sensors.{quantity}_noise": 0.0 for quantity in ("position", "pressure", "spool")}


def compare_step_with_c(command: Floats, rounds: int = 15, steps: int = 100) -> dict[str, Any] | None:
    """A step of the nominal plant over `command` (n,) m in Python and in C (step.c), ns; None without gcc.

    c: gcc -O3 -march=native, free to fuse multiply and add; c_same_rounding: without fusing. ratio: Python's time over
    C's. difference: largest between the positions of Python and C, m. identical: all columns, with the same rounding.
    """
    if not find_gcc():
        return None
    model, draws = Model(), sample_noise(0, len(command))
    with tempfile.TemporaryDirectory() as folder:
        runs, outs = {}, {}
        runs["python"], outs["python"] = _make_python_run(model, command, draws, steps)
        for name, flags in (("c", FLAGS), ("c_same_rounding", SAME_ROUNDING)):
            library = build_library("step.c", flags, Path(folder) / f"{name}.so")
            runs[name], outs[name] = _make_c_run(library, model, command, draws, steps)
        seconds = measure_durations(runs, rounds)
    each = {name: float(np.median(t)) / (len(command) * steps) * 1e9 for name, t in seconds.items()}
    ratios = {name: float(np.median(seconds["python"] / t)) for name, t in seconds.items()}  # round by round
    version = subprocess.run([find_gcc(), "-dumpfullversion"], capture_output=True, text=True, check=True)
    return {**each, "ratio": ratios["c"], "ratio_same_rounding": ratios["c_same_rounding"],
            "difference": float(np.abs(outs["python"] - outs["c"])[:, 0].max()),
            "identical": bool((outs["python"] == outs["c_same_rounding"]).all()),
            "compiler": f"gcc {version.stdout.strip()}"}


def _make_python_run(model: Model, command: Floats, draws: Floats, steps: int) -> tuple[Work, Floats]:
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    run, state, record = build_kernel(run_closed_loop, model.effects), model.build_flat_state(), model.build_record()
    return lambda: run(state.copy(), command, load, draws, record, steps, out), out


def _make_c_run(library: ctypes.CDLL, model: Model, command: Floats, draws: Floats, steps: int) -> tuple[Work, Floats]:
    record = model.build_record()
    assert library.model_bytes() == record.nbytes, "step.c knows other parameters than plant.parameters"
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    # the arrays themselves, not their addresses: the closure keeps them alive
    pointers = [np.ctypeslib.as_ctypes(a.view(np.float64).reshape(-1)) for a in (record, command, load, draws)]
    result = np.ctypeslib.as_ctypes(out.reshape(-1))
    return lambda: library.closed_loop(*pointers, len(command), steps, result), out


def measure_accuracy(command: Floats, steps: tuple[int, ...] = (20, 50, 100, 200, 500)) -> list[dict[str, float]]:
    """Error in XJ of some step sizes over `command` (n,) m, closed loop, without noise; friction off and on.

    RMS and largest error, um, against the same run with 5000 steps a cycle, of 0.2 us.
    """
    rows: list[dict[str, float]] = [{"steps": n} for n in steps]
    for name, changes in (("", QUIET | FRICTIONLESS), ("_friction", QUIET)):
        model = Model().replace(changes)
        truth = simulate(model, command, steps=5000).xj
        for row, n in zip(rows, steps, strict=True):
            error = 1e6 * (simulate(model, command, steps=n).xj - truth)
            row |= {f"rms{name}": float(np.sqrt((error**2).mean())), f"largest{name}": float(np.abs(error).max())}
    return rows


def measure_cycle_cost(cycles: int = 5000, rounds: int = 9) -> float:
    """The cost of `Actuator.sample` and `advance` called from Python, s a cycle."""
    plant = Actuator(Model())
    plant.warm()

    def run_cycles() -> None:
        for _ in range(cycles):
            plant.advance(1e-3 * plant.sample()[0])

    return measure_median_duration(run_cycles, rounds) / cycles


def measure_simulation_speed(command: Floats, rounds: int = 9) -> float:
    """The speed of a simulated run over `command` (n,) m, with noise and columns, as a multiple of real time."""
    model = Model()
    seconds = measure_median_duration(lambda: simulate(model, command), rounds)
    return len(command) * model["controller.period"] / seconds


def measure_bus_run_speed(runs: int = 3) -> float:
    """The speed of a preflight run on the embedded bus, with its log, as a multiple of real time; best of `runs`."""
    from rig.run.job import Job
    from rig.run.runner import run_job

    job = Job(sequence=load_sequence("preflight"), model=Model())
    speeds = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            speeds.append(run_job(job, Path(folder), ignore_progress, lambda: False).speed)
    return max(speeds)


def measure_run_process_speed(rounds: int = 3) -> float:
    """The speed of a whole `rig run preflight` process with its log and report, as a multiple of real time."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = measure_median_duration(lambda: run_rig("run", "preflight", "--quiet", "--out", folder), rounds)
    return load_sequence("preflight").duration / seconds


def measure_help_time(rounds: int = 5) -> float:
    """The time that `rig --help` takes as a process, s."""
    return measure_median_duration(lambda: run_rig("--help"), rounds)


def run_rig(*words: str) -> None:
    """Run `rig` with these words in a process of its own.

    Raises:
        subprocess.CalledProcessError: it ended with a status other than 0.
        KeyboardInterrupt: Ctrl-C in the terminal ended it, before this process heard of it.
    """
    done = subprocess.run([sys.executable, "-m", "rig.cli.main", *words], check=False, stdout=subprocess.DEVNULL)
    if done.returncode == INTERRUPTED:
        raise KeyboardInterrupt
    done.check_returncode()


def run_benchmarks(command: Floats, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Measure everything over `command` (n,) m; `step` is None without gcc."""
    progress("one run, and a run on the embedded bus", 0.0)
    return {"step": compare_step_with_c(command),
            "times_real_time": measure_simulation_speed(command),
            "cycle": measure_cycle_cost(),
            "lockstep": measure_bus_run_speed(),
            "run_process": measure_run_process_speed(),
            "help_process": measure_help_time()}


def build_plant_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.bench.plant.run_benchmarks`, which are its `data`.

    They may hold "accuracy": the rows of `measure_accuracy`.
    """
    return Report(
        command="bench", title="plant",
        sentence=f"The preflight is simulated at {figures['times_real_time']:.0f} times real time.",
        sections=[Section("The plant", _list_costs(figures)),
                  Section("Accuracy", _tabulate_accuracy(figures.get("accuracy", ())))],
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


def _tabulate_accuracy(accuracy: Sequence[Mapping[str, float]]) -> list[Table]:
    return [tabulate(
        accuracy,
        (Column("step", "us", "right"), lambda row: f"{1000 / row['steps']:g}"),
        (Column("friction off: RMS", "um", "right"), lambda row: f"{row['rms']:.4f}"),
        (Column("max", "um", "right"), lambda row: f"{row['largest']:.4f}"),
        (Column("friction on: RMS", "um", "right"), lambda row: f"{row['rms_friction']:.2f}"),
        (Column("max", "um", "right"), lambda row: f"{row['largest_friction']:.2f}"),
        caption="Error of XJ over the closed-loop preflight, against steps of 0.2 us.")]
