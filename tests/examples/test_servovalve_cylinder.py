"""The servovalve and cylinder of examples/: closed forms, another cylinder, and the recordings of a real one."""

from math import pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig_command import answer, rig
from scipy.integrate import solve_ivp
from scipy.io import savemat

from fdi.estimation import prepare_trace
from fdi.identification.identify import make_problem, read_identification_runs
from fdi.trace import Trace
from fdi.trace.importing.conversion import parse_map
from plant import Model, load_model, load_plant, simulate

FOLDER = Path(__file__).parent.parent.parent / "examples" / "servovalve_cylinder"
PLANT = FOLDER / "cylinder.py"
# another cylinder with another valve; friction is viscous
OTHER = """
name = "press"
plant = "cylinder.py"
[design.valve]
gain = 2e-8
lag = 0.01
[design.supply]
pressure = 1e7
[design.cylinder]
bore = 0.04
rod = 0.025
stroke = 0.3
mass = 40.0
damping = 500.0
hose_a = 5e-14
hose_b = 5e-14
rest_a = 3e6
rest_b = 4.9e6
"""


def load_cylinder(**changes: float) -> Model:
    load_plant(PLANT)
    values = {name.replace("__", "."): value for name, value in changes.items()}
    model = load_model(str(PLANT)).replace(values)
    return model.replace({s.noise: 0.0 for s in model.kind.signals.outputs})


def test_an_open_loop_has_no_following_error(tmp_path: Path) -> None:
    """Volts minus metres would be a number without meaning."""
    summary = answer("simulate", "--model", PLANT, "--trust", "--out", tmp_path / "run.csv")
    assert "rms_error" not in summary and summary["cycles"] > 0


def test_steady_speed_and_pressures_are_those_of_four_orifices() -> None:
    """v = K w/AA root((pS - r pT - F/AA)/(1 + r^3)) out, r the ratio of the areas; from v both pressures follow."""
    model = load_cylinder(cylinder__friction=60.0, cylinder__damping=0.0, cylinder__stroke=2.0, valve__overlap=0.2)
    run = simulate(model, np.full(3000, 3.0))
    v = float(np.diff(run.position[-500:]).mean()) / 1e-3
    area, width = 0.25 * pi * 0.016**2, 5.5e-9 * 2.8
    r = 1.0 - (0.010 / 0.016) ** 2
    assert v == pytest.approx(width / area * sqrt((4.4e6 - r * 1e5 - 60.0 / area) / (1.0 + r**3)), rel=2e-3)
    assert run.pressure_a[-1] == pytest.approx(4.4e6 - (area * v / width) ** 2, rel=5e-3)
    assert run.pressure_b[-1] == pytest.approx(1e5 + (r * area * v / width) ** 2, rel=1e-2)


def test_motion_is_that_of_an_independent_solver() -> None:
    """The equations of the file's head, as they stand there, by scipy: start of a stroke with oil, hose and air."""
    changes = {"cylinder.air_a": 2e-7, "cylinder.air_b": 1e-7, "cylinder.leakage": 1e-13, "valve.supply_to_b": 0.8}
    model = load_cylinder(**{name.replace(".", "__"): value for name, value in changes.items()})
    p: Any = model.build_record()[0]
    area = 0.25 * pi * p.cylinder.bore**2
    rod_side = area - 0.25 * pi * p.cylinder.rod**2

    def differentiate(t: float, y: np.ndarray) -> list[float]:
        w, pa, pb, x, v = y
        flow = [p.valve.gain * abs(w) * edge * np.sign(drop) * sqrt(abs(drop)) for edge, drop in (
            (1.0, p.supply.pressure - pa if w > 0 else p.supply.tank - pa),
            (p.valve.b_to_tank if w > 0 else p.valve.supply_to_b, p.supply.tank - pb if w > 0 else
             p.supply.pressure - pb))]
        leak = p.cylinder.leakage * (pa - pb)
        soft = [p.cylinder.hose_a + area * x / p.cylinder.modulus + p.cylinder.air_a / (1.013e5 + pa),
                p.cylinder.hose_b + rod_side * (p.cylinder.stroke - x) / p.cylinder.modulus
                + p.cylinder.air_b / (1.013e5 + pb)]
        force = area * pa - rod_side * pb - p.cylinder.damping * v
        drive = 3.0 if t >= 1e-3 else 0.0  # a drive acts from the next row on
        return [(drive - w) / p.valve.lag, (flow[0] - leak - area * v) / soft[0],
                (flow[1] + leak + rod_side * v) / soft[1], v, force / p.cylinder.mass]

    start = {"cylinder.rest_a": 2e6, "cylinder.rest_b": 2e6 * area / rod_side}
    run = simulate(model.replace(start), np.full(200, 3.0))
    first = [0.0, 2e6, 2e6 * area / rod_side, 0.0, 0.0]
    exact = solve_ivp(differentiate, (0.0, 0.199), first, "LSODA", np.arange(200) * 1e-3, rtol=1e-8, atol=1e-9,
                      max_step=1e-4)
    assert np.abs(run.position - exact.y[3]).max() < 0.01 * float(np.ptp(run.position))
    for name, pressure in (("pressure_a", exact.y[1]), ("pressure_b", exact.y[2])):
        assert np.abs(getattr(run, name) - pressure).max() < 0.02 * float(np.ptp(pressure))


@pytest.fixture(scope="module")
def press(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the model of another cylinder, and a short run of it with dry friction: both ways, three speeds."""
    place = tmp_path_factory.mktemp("press")
    (place / "cylinder.py").write_bytes(PLANT.read_bytes())
    (place / "press.toml").write_text(OTHER)
    volts = np.repeat([0.0, 3.0, 0.0, -3.0, 1.0, -2.0, 0.0], [50, 300, 100, 250, 150, 300, 50])
    np.savetxt(place / "command.csv", np.column_stack([np.arange(len(volts)) * 1e-3, volts]), delimiter=",",
               header="t,demand", comments="")
    rig("simulate", "--model", place / "press.toml", "--trust", "--set", "cylinder.friction=400",
        "--command", place / "command.csv", "--out", place / "run.csv", "--quiet")
    return place


def test_runs_with_different_sensors_are_fitted_together(press: Path) -> None:
    """One has the pressure of chamber A alone, the other that of B: each counts with what was measured in it."""
    load_plant(press / "cylinder.py")
    model = load_model(str(press / "press.toml"))
    run = Trace.read(press / "run.csv", signals=model.kind.signals)
    nothing = np.full(len(run), np.nan)
    runs = read_identification_runs(model, (), [run.with_columns({"pressure_b": nothing}),
                                                   run.with_columns({"pressure_a": nothing})], ())
    assert [t.outputs for t in runs.fitted] == [("position", "pressure_a"), ("position", "pressure_b")]
    floor = {"position": 2e-4, "pressure_a": 2.5e4, "pressure_b": 2.5e4}
    white = make_problem(runs.model, runs.fitted, floor, 1).compute_white_residuals((), np.empty((1, 0)))[0]
    a, b = np.split(white, 2, axis=1)
    assert a[:2].any(axis=1).all() and not a[2].any()
    assert b[[0, 2]].any(axis=1).all() and not b[1].any()


@pytest.mark.parametrize("chamber", ["a", "b"])
def test_the_maps_of_the_recordings_are_valid(chamber: str) -> None:
    file = FOLDER / f"pressure_{chamber}.toml"
    assert f"pressure_{chamber}" in parse_map(file.read_text(), file, load_cylinder().kind.signals).signals


def test_recording_of_an_open_loop_needs_no_command(tmp_path: Path) -> None:
    """A map without the demand, which is the voltage; the guess finds the drive by the speed that it makes."""
    t = np.arange(4000) * 1e-3
    drive = np.where(t < 2.0, 2.0, -3.0)
    way = np.clip(0.05 + np.cumsum(drive) * 1e-5, 0.0, 0.2)
    savemat(tmp_path / "run.mat", {"t": t, "u1": drive, "u2": 50.0 * way, "pressure_a": 20.0 + drive})
    guess = answer("import", "--guess", tmp_path / "run.mat", "--model", PLANT)["signals"]
    assert {name: entry["source"] for name, entry in guess.items()} == {
        "time": "t", "position": "u2", "voltage": "u1", "pressure_a": "pressure_a"}
    answer("import", tmp_path / "run.mat", "--model", PLANT, "--map", tmp_path / "run.map.toml")
    model = load_cylinder()
    trace = prepare_trace(Trace.read(tmp_path / "run.mcap", signals=model.kind.signals), model)
    assert np.array_equal(trace.command, trace.drive) and trace.scale == 1.0
