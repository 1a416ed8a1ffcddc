"""Fits the model of the real servo to one run, step by step, and prints the error on all runs after each step.

    python -m studies.servo_ledger FOLDER [--out servo.toml] [--pictures FOLDER]

FOLDER holds exp_data_3_4.csv.gz and the other runs as the rig's logger wrote them (docs/real_data.md). Only 3_4 is
fitted: the steps of the flow to its position, those of the forces to its pressure.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fdi.discovery.runs import read_source
from fdi.discovery.update_model import Provenance, Row, format_model_file
from fdi.estimation import compute_residuals, prepare_trace, replay_current, replay_lanes
from fdi.estimation.fit import silence_sensors
from fdi.report import COMMAND, GREEN, choose_drawn_unit
from fdi.report.drawing import shorten_svg, start_figure, to_svg
from fdi.sources import name_software
from fdi.trace import Trace, rms
from plant import Lanes, Model, load_model

Floats = NDArray[np.float64]

FITTED, HELD_OUT = "3_4", ("1_1", "1_4", "2_2", "4_3")
CYCLE_STEPS = 10  # of the simulation; compare uses more, which changes nothing above 0.1 um


UNITS = {"xj": 1e-6, "p12": 1e5}  # in which a fit counts, SI
START_UP = 60  # rows that are left out
BLOCK = 100  # rows of a point in a picture
DIFFERENCE = 0.02  # of a parameter's first value, for slopes
# what follows another value: the runs do not tell static from dynamic friction; a chamber at rest has the pressure of
# the return line
TIED = {"jack.static_friction": "jack.dynamic_friction", "undissolved_air.preload": "pump.return_pressure"}
HEAD = """# A real electro-hydrostatic position servo, fitted to one run by studies/servo_ledger.py: docs/real_data.md.
# Nominal values and their units: plant/models/ehs.toml and plant/ehs.py.

"""


class Bounds(NamedTuple):
    """Where a fit begins, and between which values, SI."""

    first: float
    low: float
    high: float


class Step(NamedTuple):
    """What one step adds to the model."""

    title: str
    effect: str
    signal: str  # that the fit is made to
    free: Mapping[str, Bounds]
    fixed: Mapping[str, float] = {}
    grid: Mapping[str, Sequence[float]] = {}  # values to choose from, of a parameter that acts as a threshold


STEPS = (
    Step("unequal areas", "unequal_areas", "xj",
         {"pump.displacement": Bounds(2.3e-8, 1e-8, 5e-8), "pump.area_ratio": Bounds(0.7, 0.4, 1.0)}),
    Step("delayed flow", "flow_delay", "xj", {"flow_delay.time": Bounds(0.02, 0.0, 0.2)}),
    Step("compressible oil", "undissolved_air", "xj", {"undissolved_air.volume": Bounds(2e-7, 0.0, 1e-4)},
         {"undissolved_air.exponent": 0.0}),
    Step("check valve", "check_valve", "xj", {},
         grid={"pump.least_speed": (20.0, 35.0, 50.0)}),
    Step("softer at low pressure", "undissolved_air", "xj",
         {"undissolved_air.exponent": Bounds(1.0, 0.0, 3.0)},
         {"undissolved_air.volume": 3e-6, "flow_delay.time": 0.01}),  # another valley than that of stiff oil
    Step("late pressure readings", "pressure_sensors", "xj",
         {"pressure_sensors.delay_a": Bounds(0.02, -0.1, 0.1), "pressure_sensors.delay_b": Bounds(-0.01, -0.1, 0.1)}),
    Step("leakage", "internal_leakage", "xj", {"jack.leakage": Bounds(5e-14, 0.0, 1e-11)}),
    Step("friction", "jack_friction", "p12", {"jack.dynamic_friction": Bounds(1500.0, 0.0, 1e4)}),
    Step("one-way load after a gap", "one_way_load", "p12",
         {"one_way_load.slack": Bounds(2.5e-3, 0.0, 0.01), "one_way_load.travel": Bounds(1.5e-3, 1e-4, 0.01)},
         {"one_way_load.share": 1.0}),
    Step("pressure at rest", "return_pressure", "p12",
         {"pump.return_pressure": Bounds(7e5, 0.0, 2e6), "pump.settling": Bounds(4e5, 0.0, 5e6),
          "pump.drain": Bounds(0.1, 0.01, 2.0)}),
)


class LedgerRow(NamedTuple):
    """The model after a step, and its error on each run."""

    step: Step | None
    model: Model
    errors: Mapping[str, Mapping[str, float]]  # run to "xj", "p12" and "alone", SI


def make_ledger(traces: Mapping[str, Trace]) -> list[LedgerRow]:
    """Fit one step after the other to the run FITTED and print each; the first row is the bare integrator."""
    model = load_model("ehs")
    rows = [LedgerRow(None, model, measure_errors(model, traces))]
    print_row(rows[0])
    free: dict[str, Bounds] = {}
    signal = "xj"
    for step in STEPS:
        free = {**free, **step.free} if step.signal == signal else dict(step.free)  # the flow stays as it was fitted
        signal = step.signal
        model = model.replace(tie_values({**step.fixed, **{name: bounds.first for name, bounds in step.free.items()}}))
        starts = [model.replace({name: value}) for name, values in step.grid.items() for value in values]
        models = [fit_values(start, traces[FITTED], free, signal) for start in starts or [model]]
        model = min(models, key=lambda m: measure_errors(m, {FITTED: traces[FITTED]})[FITTED][signal])
        rows.append(LedgerRow(step, model, measure_errors(model, traces)))
        print_row(rows[-1])
    return rows


def tie_values(values: Mapping[str, float]) -> dict[str, float]:
    """The values with those that follow others: `TIED`."""
    return {**values, **{name: values[other] for name, other in TIED.items() if other in values}}


def fit_values(model: Model, trace: Trace, free: Mapping[str, Bounds], signal: str) -> Model:
    """The model with the parameters `free` fitted to a signal of a prepared run, by least squares.

    The Jacobian is made of runs side by side.
    """
    names = list(tie_values(dict.fromkeys(free, 0.0)))
    scale = np.array([abs(bounds.first) for bounds in free.values()])
    low, high = (np.array([bounds[i] for bounds in free.values()]) / scale for i in (1, 2))
    lanes = Lanes(silence_sensors(model), names, CYCLE_STEPS)
    measurement, column = trace.mask_unusable(signal), trace.output_names.index(signal)

    def compute_rows(x: Floats) -> Floats:
        parameters = [tie_values(dict(zip(free, row * scale, strict=True))) for row in x]
        values = np.array([[row[name] for name in names] for row in parameters])
        residual = replay_lanes(lanes, values, trace)[..., column] - measurement
        return np.nan_to_num(residual) / UNITS[signal]

    def compute_jacobian(x: Floats) -> Floats:
        size = np.where(x + DIFFERENCE > high, -DIFFERENCE, DIFFERENCE)
        rows = compute_rows(np.vstack([x, x + np.diag(size)]))
        return np.asarray(((rows[1:] - rows[0]) / size[:, None]).T)

    start = np.clip(np.array([model[name] for name in free]) / scale, low + 1e-6, high - 1e-6)
    fit = least_squares(lambda x: compute_rows(x[None])[0], start, compute_jacobian, (low, high), max_nfev=20,
                        ftol=3e-5, xtol=3e-5)
    values = {name: float(f"{v:.4g}") for name, v in zip(free, fit.x * scale, strict=True)}
    return model.replace(tie_values(values))


def measure_errors(model: Model, traces: Mapping[str, Trace]) -> dict[str, dict[str, float]]:
    """RMS residual of each run: xj m, p12 Pa, and "alone": xj from the motor's speed without measured pressures, m."""
    out = {}
    for name, trace in traces.items():
        residuals = compute_residuals(trace, replay_current(trace, model, CYCLE_STEPS))
        alone = replace(trace, chambers=None)
        free = compute_residuals(alone, replay_current(alone, model, CYCLE_STEPS))
        out[name] = {signal: rms(values) for signal, values in residuals.items()} | {"alone": rms(free["xj"])}
    return out


def print_row(row: LedgerRow) -> None:
    """Print the errors after a step: XJ um, P12 bar, XJ from the motor alone um, for each run."""
    cells = [f"{1e6 * e['xj']:.1f} {1e-5 * e['p12']:.2f} ({1e6 * e['alone']:.0f})" for e in row.errors.values()]
    title = f"+ {row.step.title}" if row.step else "bare integrator"
    values = [f"{name} = {row.model[name]:.4g}" for name in ({**row.step.free, **row.step.grid} if row.step else ())]
    print(f"| {title} | {' | '.join(cells)} | {', '.join(values)} |", flush=True)


def write_model(rows: Sequence[LedgerRow], trace: Path, out: Path) -> None:
    """Write the model of the last row, with the run it was fitted to and the ledger."""
    model = replace(rows[-1].model, name="servo")
    ledger = tuple(Row(row.step.effect if row.step else None, {name: row.errors[FITTED][name] for name in UNITS}, {})
                   for row in rows)
    source = read_source(str(trace))._replace(file=trace.name)
    provenance = Provenance(name_software(), ("python -m studies.servo_ledger FOLDER",), (), signals=tuple(UNITS),
                            trace=source, ledger=ledger)
    out.write_text(HEAD + format_model_file(model, {}, provenance), encoding="utf-8")


def identify_controller(files: Mapping[str, Path]) -> float:
    """Print the law of the rig's firmware from each run; by what fraction it is stronger back than out in FITTED."""
    print("\n| run | gain out | gain back | delay, rows | left, RMS | answer, RMS | exact |")
    print("|---" * 7 + "|")
    asymmetries = {}
    for run, file in files.items():
        columns = np.loadtxt(file, delimiter=";", skiprows=1 + START_UP, usecols=(9, 13, 14, 16))
        answer, demand, position, valve = columns.T
        law = fit_directional_gains(demand - position, answer, valve)
        print(f"| {run} | {law.out:.3f} | {law.back:.3f} | {law.delay} | {law.residual:.1f} | {law.answer:.0f} "
              f"| {100 * law.exact:.0f} % |")
        asymmetries[run] = law.asymmetry
    return asymmetries[FITTED]


class DirectionalGains(NamedTuple):
    """A proportional law, answer = gain * error, with a gain for each direction of the actuator."""

    out: float  # answer over error
    back: float
    delay: int  # rows from the error to its answer
    residual: float  # RMS of what the law leaves of the answer
    answer: float  # RMS of the answer
    exact: float  # share of the rows whose answer is the rounded gain times the error, to half a unit

    @property
    def asymmetry(self) -> float:
        """By what fraction the gain back is higher than the gain out: `asymmetric_gain.retraction`."""
        return self.back / self.out - 1.0


def fit_directional_gains(error: Floats, answer: Floats, side: Floats, longest_delay: int = 10) -> DirectionalGains:
    """Fit a proportional gain for each side by least squares; the delay with the smallest residual is taken.

    Args:
        error: (n,) demand less position.
        answer: (n,) what the controller asks for, in its own unit.
        side: (n,) positive where the actuator is driven out, negative where it is driven back; others are left out.
        longest_delay: rows that are tried.

    Raises:
        ValueError: a side without rows.
    """
    return min((_fit_at_delay(error, answer, side, delay) for delay in range(longest_delay + 1)),
               key=lambda law: law.residual)


def _fit_at_delay(error: Floats, answer: Floats, side: Floats, delay: int) -> DirectionalGains:
    e, y, s = error[:len(error) - delay], answer[delay:], side[delay:]
    ways = {"out": s > 0.0, "back": s < 0.0}
    for name, rows in ways.items():
        if not np.any(e[rows]):
            raise ValueError(f"rows with an error while the actuator is driven {name}")
    gain = {name: float(e[rows] @ y[rows] / (e[rows] @ e[rows])) for name, rows in ways.items()}
    residual = np.concatenate([y[rows] - gain[name] * e[rows] for name, rows in ways.items()])
    whole = np.concatenate([y[rows] - round(gain[name]) * e[rows] for name, rows in ways.items()])
    driven = y[ways["out"] | ways["back"]]
    return DirectionalGains(gain["out"], gain["back"], delay, rms(residual), rms(driven),
                            float(np.mean(np.abs(whole) <= 0.5)))


def draw_steps(rows: Sequence[LedgerRow], trace: Trace, folder: Path) -> None:
    """Write a picture of each step: the residual of its signal on a run before and after, RMS over 0.1 s."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (before, after) in enumerate(pairwise(rows), 1):
        assert after.step is not None
        signal = after.step.signal
        unit, factor = choose_drawn_unit(trace.declared.find(signal), 0.0)
        with start_figure(2.2, 8.0) as figure:
            axes = figure.subplots()
            for row, colour, label in ((before, COMMAND, "before"), (after, GREEN, "after")):
                residual = compute_residuals(trace, replay_current(trace, row.model, CYCLE_STEPS))[signal]
                whole = len(residual) // BLOCK * BLOCK
                blocks = np.sqrt(np.mean(residual[:whole].reshape(-1, BLOCK) ** 2, axis=1))
                axes.plot(trace.t[:whole:BLOCK], factor * blocks, color=colour, lw=1.2, label=label)
            axes.set(title=f"{number}. {after.step.title}", xlabel="t [s]",
                     ylabel=f"{trace.declared.find(signal).symbol} [{unit}]")
            axes.legend(frameon=False)
            svg = shorten_svg(to_svg(figure, after.step.effect))
        (folder / f"{number}_{after.step.effect}.svg").write_text(svg, encoding="utf-8")


def main() -> None:
    """Fit, print the ledger, and write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder with exp_data_3_4.csv.gz and the other runs, as recorded")
    parser.add_argument("--out", type=Path, help="write the model file here")
    parser.add_argument("--pictures", type=Path, help="draw a picture of each step into this folder")
    args = parser.parse_args()
    files = {run: args.folder / f"exp_data_{run}.csv.gz" for run in (FITTED, *HELD_OUT)}
    traces = {run: prepare_trace(Trace.read(file), load_model("ehs"), source=file) for run, file in files.items()}
    print("| model | " + " | ".join(f"{run}: XJ um, P12 bar (XJ alone)" for run in traces) + " | fitted |")
    print("|---" * (len(traces) + 2) + "|")
    rows = make_ledger(traces)
    rows.append(rows[-1]._replace(model=rows[-1].model.replace(
        {"asymmetric_gain.retraction": round(identify_controller(files), 3)})))
    if args.out:
        write_model(rows, files[FITTED], args.out)
    if args.pictures:
        draw_steps(rows[:-1], traces[FITTED], args.pictures)


if __name__ == "__main__":
    main()
