"""The cost of the plant beside C, of whole processes, and of the analyses on recordings of up to half an hour.

Costs are medians over rounds that alternate between the rivals, in one process.
"""
from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi.diagnosis.bands import sample_sensor_noise
from fdi.estimation.fit import list_tolerance_sizes
from fdi.progress import Progress, ignore_progress
from fdi.report.numbers import format_digits
from fdi.report.report import Cell, Column, Item, Line, Report, Section, Table, tabulate
from fdi.trace.trace import Floats, Trace
from plant import Actuator, simulate
from plant.lanes import Lanes
from plant.model import Model, build_kernel
from plant.run import sample_noise
from plant.signals import EHA
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
from rig.network.clock import WallClock
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


COMMANDS = ("compare", "explain", "fdi")
LENGTHS = (13.5, 60.0, 300.0, 1800.0)  # s
HIDDEN = {"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0}  # N, not in the model


def measure_long_recordings(lengths: Sequence[float] = LENGTHS, seed: int = 0, progress: Progress = ignore_progress
                            ) -> dict[str, Any]:
    """The costs of each command on a recording of each length, s; the longest is interrupted as well."""
    costs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, length in enumerate(lengths):
            progress(f"recording of {length:g} s", number / len(lengths))
            file = Path(folder) / f"{length:g}s.csv"
            record_unit(make_command(length, seed), seed).write_csv(file)
            for command in COMMANDS:
                progress(f"{command}, {length:g} s", number / len(lengths))
                costs.append(_measure_cost(command, length, file, length == max(lengths)))
    return {"seed": seed, "cpus": os.cpu_count(), "costs": costs}


def make_command(length: float, seed: int) -> Floats:
    """Command, (n,) m, of `length` s: the preflight's main phase first, then steps, sines, ramps and rest at random."""
    rng, first = np.random.default_rng(seed), load_sequence("preflight").main_profile().command
    parts, rows = [first], len(first)
    while rows < 1000 * length:
        n = int(rng.integers(3000, 12000))
        t, size = np.arange(n) * 1e-3, rng.uniform(1e-3, 7e-3)
        shapes = (np.zeros(n), size * np.sin(2 * np.pi * rng.uniform(0.1, 1.0) * t),
                  size * np.repeat(np.r_[0.0, rng.choice([-1.0, 1.0], n // 1000)], 1000)[:n],
                  size * np.interp(t, t[-1] * np.array([0.0, 0.25, 0.75, 1.0]), [0.0, 1.0, -1.0, 0.0]),
                  first * rng.uniform(0.3, 1.0))
        parts += [shapes[int(rng.integers(len(shapes)))], np.zeros(500)]
        rows += len(parts[-2]) + len(parts[-1])
    return np.round(np.concatenate(parts)[:round(1000 * length)], 7)


def record_unit(com: Floats, seed: int) -> Trace:
    """A unit with tolerances, coloured noise and too much spool friction over a command (n,) m."""
    rng, model = np.random.default_rng([seed, 1]), Model().replace(HIDDEN)
    sizes = {name: size for name, size in list_tolerance_sizes(model).items() if name not in HIDDEN}
    values = np.array([[model[name] + size * rng.standard_normal() for name, size in sizes.items()]])
    noise = [sample_sensor_noise(rng, model, len(com)) for _ in range(3)]
    noise = [x * model[f"sensors.{name}_noise"] / model["sensors.position_noise"]
             for x, name in zip(noise, ("position", "pressure", "spool"), strict=True)]
    run = Lanes(model, list(sizes), 100).closed_loop(values, com - noise[0], np.zeros(len(com)))[0].T
    columns = {EHA.command.name: com, "load": np.zeros(len(com))}
    for column, x, shown, digits in zip(EHA.columns, run, (noise[0], 0.0, *noise[1:]), (7, 8, 0, 8), strict=True):
        columns[column.name] = np.round(x + shown, digits)
    return Trace.from_columns(columns, 1e-3, {})


def _measure_cost(command: str, length: float, file: Path, is_interrupted: bool) -> dict[str, Any]:
    """One command on a recording of `length` s: CPU time of the whole process, s, and largest memory, bytes.

    interrupted: s from SIGINT in the middle of the work to the end of the process; None: not tried.
    """
    process = _start_rig(command, file)
    answer = process.stdout.read() if process.stdout else b""
    _, _, used = os.wait4(process.pid, 0)
    duration = used.ru_utime + used.ru_stime
    after = _measure_interruption(command, file, 0.5 * duration) if is_interrupted else None
    return {"command": command, "length": length, "cpu": duration, "memory": 1024 * used.ru_maxrss,
            "verdict": str(json.loads(answer)["verdict"]), "interrupted": after}


def _measure_interruption(command: str, file: Path, delay: float) -> float | None:
    """The time from Ctrl-C, `delay` s of CPU time after the start, to the end, s; None if the work was over."""
    process = _start_rig(command, file)
    clock, stat = WallClock(), Path(f"/proc/{process.pid}/stat")
    while process.poll() is None and _read_cpu_time(stat) < delay:
        clock.sleep_until(clock.now() + 50_000_000)
    start = clock.now()
    process.send_signal(signal.SIGINT)
    process.communicate()
    return 1e-9 * (clock.now() - start) if process.returncode == 130 else None


def _read_cpu_time(stat: Path) -> float:
    fields = stat.read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # proc(5): utime and stime


def _start_rig(command: str, file: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "rig.cli.main", command, str(file), "--json"],
                            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def build_long_recordings_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.bench.plant.measure_long_recordings`."""
    costs = figures["costs"]
    table = [tabulate(
        costs,
        (Column("command"), lambda cost: cost["command"]),
        (Column("recording", align="right"), lambda cost: f"{cost['length']:g} s"),
        (Column("CPU time", align="right"), lambda cost: f"{cost['cpu']:.1f} s"),
        (Column("memory", align="right"), lambda cost: f"{1e-9 * cost['memory']:.2f} GB"),
        (Column("verdict"), lambda cost: cost["verdict"]),
        (Column("ends after Ctrl-C", align="right"),
         lambda cost: "" if cost["interrupted"] is None else f"{cost['interrupted']:.1f} s"),
        caption="CPU time: user and system time of the whole process. Memory: largest resident set.")]
    largest, longest = (max(cost[key] for cost in costs) for key in ("memory", "length"))
    return Report("bench", "recordings",
                  sentence=f"{longest:g} s of recording at 1 kHz take {1e-9 * largest:.2f} GB at most.",
                  sections=[Section("Cost by length of the recording", table)], data=dict(figures))
