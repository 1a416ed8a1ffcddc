"""Long recordings: CPU time and memory of `rig compare`, `explain` and `fdi` by length of the recording."""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi.diagnosis.make_bands import sample_sensor_noise
from fdi.estimation import list_tolerance_sizes
from fdi.progress import Progress, ignore_progress
from fdi.report import Column, Report, Section, tabulate
from fdi.trace import Floats, Trace
from plant import EHA, InputError, Lanes, Model
from rig.sequences import load_sequence
from studies.command import report_progress, run_study_command

COMMANDS = ("compare", "explain", "fdi")
HIDDEN = {"spool.static_friction": 45.0, "spool.dynamic_friction": 30.0}  # N, not in the model


def measure_long_recordings(lengths: Sequence[float], seed: int = 0, progress: Progress = ignore_progress
                            ) -> dict[str, Any]:
    """The costs of each command on a recording of each length, s."""
    costs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, length in enumerate(lengths):
            progress(f"recording of {length:g} s", number / len(lengths))
            file = Path(folder) / f"{length:g}s.csv"
            record_unit(make_command(length, seed), seed).write_csv(file)
            for command in COMMANDS:
                progress(f"{command}, {length:g} s", number / len(lengths))
                costs.append(_measure_cost(command, length, file))
    return {"seed": seed, "cpus": os.cpu_count(), "costs": costs}


def make_command(length: float, seed: int) -> Floats:
    """Command, (n,) m, of `length` s: the preflight's main phase first, then steps, sines, ramps and rest at random."""
    rng, first = np.random.default_rng(seed), load_sequence("preflight").build_main_profile().command
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
    for column, x, offset, digits in zip(EHA.columns, run, (noise[0], 0.0, *noise[1:]), (7, 8, 0, 8), strict=True):
        columns[column.name] = np.round(x + offset, digits)
    return Trace.from_columns(columns, 1e-3, {})


def _measure_cost(command: str, length: float, file: Path) -> dict[str, Any]:
    """One command on a recording of `length` s: CPU time of the whole process, s, and largest memory, bytes."""
    process = subprocess.Popen([sys.executable, "-m", "rig.cli.main", command, str(file), "--json"],
                               stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    answer = process.stdout.read() if process.stdout else b""
    _, _, usage = os.wait4(process.pid, 0)
    return {"command": command, "length": length, "cpu": usage.ru_utime + usage.ru_stime,
            "memory": 1024 * usage.ru_maxrss, "verdict": str(json.loads(answer)["verdict"])}


def build_long_recordings_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `measure_long_recordings`."""
    costs = figures["costs"]
    table = [tabulate(
        costs,
        (Column("command"), lambda cost: cost["command"]),
        (Column("recording", align="right"), lambda cost: f"{cost['length']:g} s"),
        (Column("CPU time", align="right"), lambda cost: f"{cost['cpu']:.1f} s"),
        (Column("memory", align="right"), lambda cost: f"{1e-9 * cost['memory']:.2f} GB"),
        (Column("verdict"), lambda cost: cost["verdict"]),
        caption="CPU time: user and system time of the whole process. Memory: largest resident set.")]
    largest, longest = (max(cost[key] for cost in costs) for key in ("memory", "length"))
    return Report("long_recordings", "long recordings",
                  sentence=f"{longest:g} s of recording at 1 kHz take {1e-9 * largest:.2f} GB at most.",
                  sections=[Section("Cost by length of the recording", table)], data=dict(figures))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and show; see --help."""
    return run_study_command("studies.long_recordings", __doc__, arguments, add_options, run_study)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The lengths."""
    parser.add_argument("--lengths", default="13.5,60,300,1800", metavar="S,S,..",
                        help="lengths of the recordings, s (default: 13.5,60,300,1800)")


def run_study(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report; it has no aims. Raises InputError for lengths that are no numbers, or too small."""
    try:
        lengths = [float(word) for word in args.lengths.split(",")]
    except ValueError:
        lengths = []
    if not lengths or not all(5.0 <= length <= 7200.0 for length in lengths):
        raise InputError("--lengths", args.lengths, "seconds from 5 to 7200, separated by commas")
    return build_long_recordings_report(measure_long_recordings(lengths, args.seed, report_progress)), True


if __name__ == "__main__":
    raise SystemExit(main())
