"""The comparison as a whole: a perfect model is at the floor, and a fault is found in the block that has it."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from noisy_traces import SHORT, make_backlash, make_lag, record_healthy, record_plant

from fdi.comparison.compare import Comparison, compare, compare_controller, find_lags
from fdi.estimation.replay import read_cycles
from fdi.report.compare_report import describe_findings, describe_verdict
from fdi.thresholds import CONTROLLER_ERROR_RATIO
from fdi.trace.trace import Trace, shift_rows
from plant import Model, simulate

MODEL = Model()


@cache
def faulty(name: str) -> Trace:
    changes, sensor = FAULTS[name]
    return record_plant(changes, sensor=sensor() if sensor else None)


Fault = tuple[dict[str, float], Callable[[], Callable[[float], float]] | None]
FAULTS: dict[str, Fault] = {
    "servovalve: spool friction": ({"spool.static_friction": 30.0, "spool.dynamic_friction": 20.0}, None),
    "servovalve: clogged filter": ({"filter.clogging": 0.2}, None),
    "jack: leakage": ({"jack.leakage": 2e-11}, None),
    "jack: friction": ({"jack.static_friction": 1200.0, "jack.dynamic_friction": 750.0}, None),
    "sensor: play": ({}, lambda: make_backlash(60e-6)),
    "sensor: lag": ({}, lambda: make_lag(1e-3)),
}


def at_floor(found: Comparison) -> bool:
    return found.verdict == "WITHIN_FLOOR" and not found.named and found.scatter is None


@pytest.mark.parametrize("colour", ["white", "hum"])
def test_a_perfect_model_is_at_the_floor(colour: str) -> None:
    """With a repeat and, where the noise is as the model says, without."""
    found = compare(record_healthy(2, colour), MODEL, [record_healthy(3, colour)])
    assert at_floor(found), describe_verdict(found)
    for name, limit in {"xj": 0.05, "p12": 0.02, "xs": 0.02}.items():
        signal = found.signals[name]
        assert (signal.ratio, signal.floor.source) == (pytest.approx(1.0, abs=limit), "repeats")
        assert signal.solver_error < 0.1 * signal.floor.value
    assert all(ratio is not None and ratio < 1.1 for ratio in found.blocks.values())
    assert abs(found.drift) < 1e-6 and found.signals["xj"].closed_loop_error > 2 * found.signals["xj"].error
    assert at_floor(compare(record_healthy(2, colour), MODEL))


@pytest.mark.parametrize("colour", ["white", "hum"])
def test_seeds_do_not_matter(colour: str) -> None:
    """Short traces, whose estimates scatter the most."""
    traces = [record_plant(com=SHORT, seed=seed, colour=colour) for seed in range(6)]
    found = [compare(trace, MODEL, repeats) for trace, other in zip(traces[::2], traces[1::2], strict=True)
             for repeats in ([other], [])]
    assert [describe_verdict(f) for f in found if not at_floor(f)] == []
    ratios = np.array([[s.ratio for s in f.signals.values()] for f in found])
    assert ratios.mean(axis=0) == pytest.approx([1.0, 1.0, 1.0], abs=0.04)
    assert ratios.std(axis=0).max() < 0.06


OTHER_UNITS: dict[str, dict[str, float]] = {
    "far from it at all times": {"filter.clogging": 0.2},
    "far from it where the ram stops": {"torque_motor.gain": 2.2, "jack.static_friction": 1200.0},
}


@pytest.mark.parametrize("kind", OTHER_UNITS)
def test_a_repeat_from_another_unit_is_no_measure_of_noise(kind: str) -> None:
    found, true = (compare(record_plant(com=SHORT, seed=2), MODEL, [record_plant(unit, com=SHORT, seed=3)])
                   for unit in (OTHER_UNITS[kind], {}))
    assert (found.verdict, true.verdict) == ("CANNOT_TELL", "WITHIN_FLOOR"), describe_verdict(found)
    assert "repeats of the same unit" in found.reason and "by more than" in found.reason


@pytest.mark.parametrize("fault", FAULTS)
def test_the_block_with_the_fault_is_named(fault: str) -> None:
    block = fault.partition(":")[0]
    found = compare(faulty(fault), MODEL)
    assert found.verdict == "MODEL_INCOMPLETE" and found.named == (block,), describe_verdict(found)
    assert all(ratio is not None and (ratio > 1.5 if name == block else ratio < 1.3)
               for name, ratio in found.blocks.items())
    assert f"the {block} disagrees" in describe_verdict(found)


def test_another_firmware_is_the_controllers_fault_alone() -> None:
    found = compare(record_plant({"controller.proportional_gain": 4.2}), MODEL)
    assert found.verdict == "MODEL_INCOMPLETE" and found.named == ("controller",)
    assert found.scatter is None and "the output of the controller differs" in describe_verdict(found)
    assert found.answer.gain == pytest.approx(4.2, rel=1e-6)


def test_a_sensors_gain_and_a_valves_cannot_be_told_apart() -> None:
    found = compare(record_plant(sensor=lambda x: 1.02 * x), MODEL)
    assert set(found.named) == {"jack", "sensor"} and "the jack or the sensor disagree" in describe_verdict(found)
    assert found.parts["gain"] == pytest.approx(0.02, abs=0.002)


def test_scatter_from_unit_to_unit_is_offered_as_a_reason() -> None:
    """1.5 % in a few parameters is no missing physics; an effect is not explained that way."""
    unit = {"valve.flow_gain": 0.3 * 1.02, "torque_motor.gain": 2.27 * 0.99, "jack.damping": 2000.0 * 1.02}
    found = compare(record_plant(unit), MODEL)
    assert found.verdict == "MODEL_INCOMPLETE" and found.scatter is not None and found.scatter.enough
    assert found.scatter.moved["valve.flow_gain"] == pytest.approx(0.02 / 0.015, abs=0.4)
    other = compare(faulty("servovalve: spool friction"), MODEL)
    assert other.scatter is not None and not other.scatter.enough


@pytest.mark.parametrize(("unit", "is_other"), [({"jack.area": 2e-3}, True), ({"filter.clogging": 0.3}, False)])
def test_another_actuator_is_to_be_identified(unit: dict[str, float], is_other: bool) -> None:
    """A third more area than the model has: the answer says which command fits the model. An effect is not that."""
    lines = describe_findings(compare(record_plant(unit), MODEL))
    assert any("rig identify" in line.text for line in lines) == is_other


@pytest.mark.parametrize(("kept", "known"), [
    (("xj",), {"controller"}), (("xj", "p12"), {"controller", "servovalve", "jack"}),
    (("xs",), {"controller", "servovalve", "jack", "sensor"})])
def test_fewer_signals_give_fewer_blocks(kept: tuple[str, ...], known: set[str]) -> None:
    found = compare(faulty("servovalve: clogged filter"), MODEL, signals=kept)
    assert tuple(found.signals) == kept and found.verdict == "MODEL_INCOMPLETE"
    assert {name for name, ratio in found.blocks.items() if ratio is not None} == known
    assert set(found.named) == ({"servovalve"} if kept != ("xj",) else set())


def test_noise_that_nobody_stated_gives_a_lower_bound() -> None:
    silent = MODEL.replace({"sensors.position_noise": 0.0})
    found = compare(record_healthy(2, "hum"), silent)
    assert found.signals["xj"].floor.lower_bound and found.signals["xj"].floor.source == "data"
    assert found.verdict == "CANNOT_TELL" and "only a lower bound" in describe_verdict(found)
    assert compare(record_healthy(2, "hum"), silent, [record_healthy(3, "hum")]).verdict == "WITHIN_FLOOR"
    assert compare(faulty("servovalve: clogged filter"), silent).verdict == "MODEL_INCOMPLETE"


def test_a_simulation_without_noise_is_its_own_floor() -> None:
    quiet = MODEL.replace({f"sensors.{name}_noise": 0.0 for name in ("position", "pressure", "spool")})
    run = simulate(quiet, SHORT)
    assert compare(Trace.from_columns(run._asdict(), 1e-3, {}), quiet).verdict == "WITHIN_FLOOR"


def test_rows_lost_at_random_are_no_error() -> None:
    keep = np.random.default_rng(0).random(13_500) > 0.05
    columns = {name: np.where(keep, record_healthy(2).column(name), np.nan)
               for name in ("com", "xj", "cor", "p12", "xs")}
    found = compare(Trace.from_columns(columns, 1e-3, {}), MODEL)
    assert found.verdict == "WITHIN_FLOOR", describe_verdict(found)


def test_columns_out_of_step_are_moved() -> None:
    columns = {n: getattr(record_healthy(2), n) for n in ("com", "xj", "cor", "p12", "xs")}
    columns["cor"] = np.roll(columns["cor"], -3)
    found = compare(Trace.from_columns(columns, 1e-3, {}), MODEL)
    assert found.verdict == "WITHIN_FLOOR"
    assert any("Cor stands 3 cycles earlier" in note for note in found.notes)


def test_findings_are_told_in_words() -> None:
    found = compare(faulty("sensor: play"), MODEL, [record_plant(seed=9, sensor=make_backlash(60e-6))])
    lines = {line.label: line.text for line in describe_findings(found)}
    assert {"floor", "solver", "where", "when", "residual", "scatter"} <= set(lines)
    assert "after a reversal" in lines["when"]


@pytest.fixture(scope="module")
def c() -> Trace:
    return read_cycles(record_healthy(), MODEL)[0]


@pytest.mark.parametrize("digits", [6, 9])
def test_rounding_in_a_file_is_no_disagreement(c: Trace, digits: int) -> None:
    rounded = {name: np.array([float(f"{v:.{digits - 1}e}") for v in c.column(name).tolist()])
               for name in ("cor", "xj")}
    assert compare_controller(c.with_columns(rounded), MODEL).ratio < CONTROLLER_ERROR_RATIO


def test_rounding_on_the_bus_is_no_disagreement(c: Trace) -> None:
    """The firmware sees what the bus carries, and its answer is rounded to 1e-8 A."""
    xj = np.round(c.xj / 1e-7) * 1e-7
    cor = np.round(np.clip(3.8 * (c.com - xj), -8e-3, 8e-3) / 1e-8) * 1e-8
    assert compare_controller(c.with_columns({"xj": xj, "cor": cor}), MODEL).ratio < 1.2


@pytest.mark.parametrize(("com", "xj"), [(3, 0), (-2, 0), (0, 2), (2, 2)])
def test_columns_that_are_late(c: Trace, com: int, xj: int) -> None:
    """`com` cycles before row k is what Cor_k answers, the file having it earlier than it should."""
    found = compare_controller(c.with_columns({"com": shift_rows(c.com, -com), "xj": shift_rows(c.xj, -xj)}), MODEL)
    assert (found.com_lag, found.xj_lag) == (com, xj) and found.ratio <= 1.0
    assert find_lags(c, 8e-3)[:2] == (0, 0)


def test_a_recorder_that_rounds_positions_is_no_error_of_the_controller(c: Trace) -> None:
    rounded = c.with_columns({"xj": 7.3e-6 * np.round(c.xj / 7.3e-6)})
    other = MODEL.replace({"controller.proportional_gain": 1.1 * MODEL["controller.proportional_gain"]})
    assert 0.5 < compare_controller(rounded, MODEL).ratio < CONTROLLER_ERROR_RATIO
    assert compare_controller(rounded, other).ratio > CONTROLLER_ERROR_RATIO
