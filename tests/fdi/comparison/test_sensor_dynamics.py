"""Filters of sensors are compared with a filtered model; how finely a column was recorded."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from short_runs import STEPS, build_command

from fdi.comparison.compare import Comparison, compare
from fdi.trace.sensor_dynamics import (
    SensorDynamics,
    measure_resolution,
    read_sensors,
    write_sensors,
)
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.errors import InputError
from rig.recorder.convert import write_mcap

MEAN = SensorDynamics(moving_mean=20.0)


@cache
def run_nominal() -> Trace:
    """The nominal plant with its sensors' noise, 2.5 s."""
    return Trace.from_columns(simulate(Model(), build_command()[:2500], None, 1, STEPS)._asdict(), 1e-3, {})


def filter_by_loop(x: np.ndarray, sensor: SensorDynamics) -> np.ndarray:
    """Lag and moving mean sample by sample at 1 kHz: nothing of the tested code."""
    fine = np.interp((np.arange(50 * len(x)) + 0.5) / 50 - 1.0, np.arange(len(x)), x)  # between the samples
    out, state = [], x[0]
    for now in fine:  # Euler steps along the straight line to each sample
        state = state + (now - state) * 1e-3 / 50 / sensor.lag if sensor.lag else now
        out.append(state)
    lagged, n = np.array(out[49::50]) if sensor.lag else x, round(sensor.moving_mean)
    return np.array([np.mean(lagged[np.clip(range(k - n + 1, k + 1), 0, None)]) for k in range(len(x))])


def measure(sensors: Mapping[str, SensorDynamics], is_told: bool) -> Comparison:
    """The nominal plant behind filters, compared with or without them."""
    trace = run_nominal()
    shown = {name: filter_by_loop(trace.column(name), sensor) for name, sensor in sensors.items()}
    return compare(trace.with_columns(shown, sensors=sensors if is_told else {}), Model())


@pytest.mark.parametrize("sensors", [{"p12": SensorDynamics(moving_mean=8.0)}, {"xj": SensorDynamics(lag=5e-3)},
                                     {"p12": SensorDynamics(lag=4e-3), "xs": SensorDynamics(moving_mean=5.0)}],
                         ids=["moving mean", "lag", "both"])
def test_filters_of_sensors_are_no_error_of_the_model(sensors: Mapping[str, SensorDynamics]) -> None:
    """Told of the filter, compare leaves noise; not told, a multiple of it."""
    told, untold = measure(sensors, True), measure(sensors, False)
    for name in sensors:
        assert 0.25 * untold.signals[name].error > told.signals[name].error < 1.6 * told.signals[name].floor.value
    assert any("passes the sensor" in note for note in told.notes)
    assert (told.blocks["jack"], told.blocks["sensor"]) == (None, None)


def test_rounding_is_noise() -> None:
    """A step of 1 bar is 0.29 bar of noise, beside the 0.2 bar of the sensor."""
    trace = run_nominal()
    rounded = trace.with_columns({"p12": 1e5 * np.round(trace.p12 / 1e5)}, sensors={"p12": SensorDynamics(quantum=1e5)})
    found = compare(rounded, Model()).signals["p12"]
    assert found.floor.value == pytest.approx(np.hypot(2e4, 1e5 / np.sqrt(12.0)), rel=1e-6)
    assert 0.8 < found.ratio < 1.2


def test_mean_of_the_loggers_samples() -> None:
    """Of 40 samples at 2 kHz: 20 ms, and 9.75 ms late; a centred one is not late."""
    ramp, whole = np.arange(100.0), replace(MEAN, lag=3e-3, delay=1e-3)
    late = SensorDynamics(moving_mean=40.0, sample_period=5e-4)
    for sensor, rows in ((late, 9.75), (replace(late, centred=True), 0.0), (SensorDynamics(delay=3.5e-3), 3.5),
                         (SensorDynamics(lag=2e-3), 2.0)):
        assert (ramp - sensor.apply(ramp, 1e-3))[50:70] == pytest.approx(rows, abs=1e-9)
    assert whole.undo(whole.apply(ramp, 1e-3), 1e-3)[45:80] == pytest.approx(ramp[45:80], abs=1e-3)


def test_averaged_noise_has_fewer_independent_samples() -> None:
    """The spread of the mean square of averaged white noise is that of so many independent samples."""
    noise = np.random.default_rng(0).standard_normal((400, 2000))
    squares = (MEAN.apply(noise, 1e-3)[:, 20:] ** 2).mean(axis=1)
    independent = 2.0 / (squares.std() / squares.mean()) ** 2 / 1980
    assert MEAN.count_independent(1e-3) == pytest.approx(independent, rel=0.2)


def test_a_log_keeps_the_sensors(tmp_path: Path) -> None:
    sensors = {"p12": replace(MEAN, sample_period=5e-4, lag=1e-3), "xj": SensorDynamics(quantum=2.5e-5)}
    write_mcap(replace(run_nominal(), sensors=sensors), tmp_path / "x.mcap")
    assert Trace.read(tmp_path / "x.mcap").sensors == sensors
    assert read_sensors("x", write_sensors(sensors)) == sensors


@pytest.mark.parametrize("text", ["no json", "[]", '{"lag": -1}', '{"lag": "x"}', '{"speed": 1}',
                                  '{"moving_mean": 1e9}', '{"delay": NaN}'])
def test_damaged_dynamics_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"x\.mcap: metadata run\.sensor\.p12: expected a sensor's dynamics"):
        read_sensors("x.mcap", {"sensor.p12": text})


def test_resolution_of_a_column() -> None:
    x = np.random.default_rng(0).standard_normal(1000)
    six = np.array([float(f"{value:.5e}") for value in 5.0 + np.clip(x, -4.0, 4.0)])
    for column, resolution in ((np.round(x, 3), 1e-3), (np.round(x * 1e5) * 1e-8, 1e-8), (six, 1e-5)):
        assert measure_resolution(column) == pytest.approx(resolution, rel=0.01)
    assert measure_resolution(x) < 1e-10 and measure_resolution(np.tile([5e-3, -5e-3], 500)) == 0.0
