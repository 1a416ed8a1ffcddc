"""What `rig compare`, `rig explain` and `rig fdi` cost on recordings of growing length: CPU time and memory."""
from __future__ import annotations

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
from numpy.typing import NDArray

from fdi.diagnosis.learn_bands import sample_sensor_noise
from fdi.estimation.unknowns import list_tolerance_sizes
from fdi.progress import Progress, ignore_progress
from fdi.report.report import Column, Report, Section, tabulate
from fdi.trace.trace import Trace
from plant.lanes import Lanes
from plant.model import Model
from rig.network.clock import WallClock
from rig.sequences import load_sequence

Array = NDArray[np.float64]

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


def make_command(length: float, seed: int) -> Array:
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


def record_unit(com: Array, seed: int) -> Trace:
    """A unit with tolerances, coloured noise and too much spool friction over a command (n,) m."""
    rng, model = np.random.default_rng([seed, 1]), Model().replace(HIDDEN)
    sizes = {name: size for name, size in list_tolerance_sizes(model).items() if name not in HIDDEN}
    values = np.array([[model[name] + size * rng.standard_normal() for name, size in sizes.items()]])
    noise = [sample_sensor_noise(rng, model, len(com)) for _ in range(3)]
    noise = [x * model[f"sensors.{name}_noise"] / model["sensors.position_noise"]
             for x, name in zip(noise, ("position", "pressure", "spool"), strict=True)]
    run = Lanes(model, list(sizes), 100).closed_loop(values, com - noise[0], np.zeros(len(com)))[0].T
    columns = {"com": com, "xj": run[0] + noise[0], "cor": run[1], "p12": run[2] + noise[1], "xs": run[3] + noise[2],
               "load": np.zeros(len(com))}
    digits = {"xj": 7, "cor": 8, "p12": 0, "xs": 8}
    return Trace.from_columns(columns | {name: np.round(columns[name], n) for name, n in digits.items()}, 1e-3, {})


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
    """Report on the figures of `rig.bench.recordings.measure_long_recordings`."""
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
