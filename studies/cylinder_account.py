"""How far the model of a servovalve and its cylinder holds on each voltage: force, speed and position.

    python -m studies.cylinder_account FOLDER --model FILE.toml

FOLDER holds m_find_b_pA_1V_sample_1.mat and the other files of the trainer (docs/real_cylinder.md), which are imported
with the maps of examples/servovalve_cylinder. Force and speed are means over the middle half of the stroke.
"""

import argparse
import re
from collections.abc import Sequence
from itertools import combinations
from math import pi
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi.estimation import measure_drift, prepare_trace, replay_current
from fdi.foreign_code import load_plant_of_model
from fdi.report import Column, Report, Section, tabulate
from fdi.trace import Trace, rms
from fdi.trace.importing.conversion import import_measurement, read_map
from fdi.trace.importing.formats import open_measurement
from plant import InputError, Model, load_model
from studies.command import run_study_command

MAPS = Path(__file__).parent.parent / "examples" / "servovalve_cylinder"
NAME = re.compile(r"m_find_b_p([AB])_(\d+)V_sample_(\d+)\.mat")
MOST_FORCE_ERROR, MOST_POSITION_ERROR = 5.0, 2e-3  # N, m: what is asked of a voltage that no fit has seen


class Motion(NamedTuple):
    """Means over the middle half of the stroke, one way: measured, and of the model from the voltage alone."""

    voltage: int
    force: float  # N, of the pressures of both chambers
    model_force: float
    speed: float  # m/s
    model_speed: float


class Way(NamedTuple):
    """The position of the runs at one voltage."""

    voltage: int
    runs: int
    error: float  # m RMS, of the model from the voltage alone; mean of the runs
    scatter: float  # m RMS, between two runs


def read_folder(folder: Path, model: Model) -> dict[int, dict[str, list[Trace]]]:
    """The runs by voltage and by the chamber whose pressure was measured.

    Raises:
        InputError: a folder without such files, or a file that cannot be imported.
    """
    runs_by_voltage: dict[int, dict[str, list[Trace]]] = {}
    for file in sorted(folder.glob("*.mat")):
        if name := NAME.fullmatch(file.name):
            signal_map = read_map(MAPS / f"pressure_{name[1].lower()}.toml", model.kind.signals)
            trace = import_measurement(open_measurement(file), signal_map, model["controller.period"]).trace
            runs = runs_by_voltage.setdefault(int(name[2]), {"A": [], "B": []})[name[1]]
            runs.append(prepare_trace(trace, model, source=file.name))
    if not runs_by_voltage:
        raise InputError(folder, "", "a folder with files such as m_find_b_pA_1V_sample_1.mat")
    return {voltage: runs_by_voltage[voltage] for voltage in sorted(runs_by_voltage)}


def measure_motion(runs: dict[str, list[Trace]], voltage: int, model: Model, sign: int) -> Motion:
    """Force and speed one way at one voltage, of runs with the pressure of chamber A and of others with that of B."""
    p = {name: model[f"cylinder.{name}"] for name in ("bore", "rod", "retracted", "stroke")}
    area = 0.25 * pi * p["bore"] ** 2
    areas = {"A": area, "B": area - 0.25 * pi * p["rod"] ** 2}
    forces, speeds = [], []
    for is_model in (False, True):
        force, speed = 0.0, []
        for chamber, traces in runs.items():
            pressures = []
            for trace in traces:
                columns = replay_current(trace, model, anchor=0.0) if is_model else trace.columns
                x, pressure = columns["position"], columns[f"pressure_{chamber.lower()}"]
                smooth = np.convolve(x, np.full(21, 1.0 / 21.0), "same")
                part = (smooth - p["retracted"]) / p["stroke"]
                rows = (np.sign(trace.drive) == sign) & (part > 0.25) & (part < 0.75)
                pressures.append(float(np.mean(pressure[rows])))
                speed.append(float(np.polyfit(trace.t[rows], x[rows], 1)[0]))
            force += (1.0 if chamber == "A" else -1.0) * areas[chamber] * float(np.mean(pressures))
        forces.append(force)
        speeds.append(float(np.mean(speed)))
    return Motion(sign * voltage, *forces, *speeds)


def measure_way(runs: Sequence[Trace], voltage: int, model: Model) -> Way:
    """The error of the position at one voltage, and how far runs are apart."""
    error = float(np.mean([measure_drift(trace, model)[0] for trace in runs]))
    rows = min(map(len, runs))
    apart = [rms(a.controlled[:rows] - b.controlled[:rows]) for a, b in combinations(runs, 2)]
    return Way(voltage, len(runs), error, float(np.mean(apart)) if apart else float("nan"))


def run_account(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report, and whether all force and position errors are within the aims."""
    load_plant_of_model(str(args.model), is_trusted=True)
    model = load_model(str(args.model))
    folder = read_folder(args.folder, model)
    motions = [measure_motion(runs, voltage, model, sign) for voltage, runs in folder.items() for sign in (1, -1)
               if runs["A"] and runs["B"]]
    ways = [measure_way([*runs["A"], *runs["B"]], voltage, model) for voltage, runs in folder.items()]
    force = rms(np.array([m.model_force - m.force for m in motions]))
    forces = tabulate(motions, (Column("voltage", "V", "right"), lambda m: f"{m.voltage:d}"),
                      (Column("force", "N", "right"), lambda m: f"{m.force:.1f}"),
                      (Column("model", "N", "right"), lambda m: f"{m.model_force:.1f}"),
                      (Column("speed", "mm/s", "right"), lambda m: f"{1e3 * m.speed:.1f}"),
                      (Column("model", "mm/s", "right"), lambda m: f"{1e3 * m.model_speed:.1f}"),
                      caption=f"Middle half of the stroke. RMS error of the force over all rows: {force:.1f} N.")
    positions = tabulate(ways, (Column("voltage", "V", "right"), lambda w: f"{w.voltage:d}"),
                         (Column("runs", align="right"), lambda w: f"{w.runs:d}"),
                         (Column("error", "mm", "right"), lambda w: f"{1e3 * w.error:.2f}"),
                         (Column("between runs", "mm", "right"), lambda w: f"{1e3 * w.scatter:.2f}"),
                         caption="RMS of the position: from the voltage alone, and difference of two runs.")
    is_met = force < MOST_FORCE_ERROR and all(w.error < MOST_POSITION_ERROR for w in ways)
    data = {"force_error": force, "motions": [m._asdict() for m in motions], "ways": [w._asdict() for w in ways]}
    sentence = f"force error {force:.1f} N RMS, position error at most {1e3 * max(w.error for w in ways):.2f} mm RMS"
    return Report("cylinder_account", str(args.folder), "MET" if is_met else "NOT_MET", sentence=sentence, data=data,
                  sections=[Section("Force and speed", [forces]), Section("Position", [positions])]), is_met


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    def add_options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("folder", type=Path, help="folder with the files of the trainer")
        parser.add_argument("--model", type=Path, required=True, metavar="FILE", help="model file")

    return run_study_command("studies.cylinder_account", __doc__, arguments, add_options, run_account)


if __name__ == "__main__":
    raise SystemExit(main())
