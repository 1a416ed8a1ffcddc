"""Sizes of both faults from a replay of the measured current: right, as sure as they say, and not misled by others.

Beside another effect: sizes averaged over what may be right, and the search that finds the effect.
"""

from dataclasses import replace

import numpy as np
import pytest
from effect_files import SEARCHED, restored_catalogue
from noisy_traces import record_plant
from physics_cases import PREFLIGHT

from fdi.diagnosis.diagnosis import Diagnosis, diagnose
from fdi.diagnosis.faults import (
    CLOGGING,
    FAULTS,
    FRICTION,
    Estimate,
    Level,
    compute_severity,
    find_ruling_fault,
    judge_size,
)
from fdi.diagnosis.refine import (
    Beside,
    Explanation,
    Refinement,
    average_explanations,
    list_other_effects,
    list_unknowns,
    mix_estimates,
    refine_sizes,
)
from fdi.estimation.replay import hold_inputs
from fdi.report.diagnosis_report import build_diagnosis_report
from fdi.thresholds import RESIDUAL_WORST
from plant import load_model

MODEL = load_model()


def faulty(kintas: float, fss: float, **more: float) -> dict[str, float]:
    return {"filter.clogging": kintas, "spool.static_friction": fss, "spool.dynamic_friction": fss / 1.5, **more}


@pytest.fixture(scope="module")
def off_grid() -> Refinement:
    return refine_sizes(MODEL, hold_inputs(record_plant(faulty(0.17, 45.0))))


def test_a_pair_between_the_cells_of_a_grid(off_grid: Refinement) -> None:
    """(0.17, 9 FSS_NC), no scatter: Kintas within 5 %, FSS within 2 %."""
    kintas, fss = off_grid.sizes.values()
    assert off_grid.is_explained and off_grid.simulations > 300
    assert kintas.value == pytest.approx(0.17, rel=0.05) and kintas.low < 0.17 < kintas.high
    assert fss.value == pytest.approx(45.0, rel=0.02) and fss.low < 45.0 < fss.high


def test_tolerances_decide_how_wide_an_interval_is(off_grid: Refinement) -> None:
    """A gain of 1.5 % is 3 % of what the filter lets through, as flow goes with its square root."""
    kintas = off_grid.sizes[CLOGGING.name]
    spread = (kintas.high - kintas.low) / 2 / 1.96 / (1 - kintas.value)
    assert spread == pytest.approx(2 * 0.015, rel=0.1) and off_grid.correlation > 0.8


@pytest.mark.parametrize(("settings", "name", "value"), [
    ({"null_bias.current": 1e-4}, "null_bias.current", 1e-4),
    ({"jack.static_friction": 1600.0, "jack.dynamic_friction": 1000.0}, "jack.dynamic_friction", 1000.0)])
def test_what_is_not_the_valve_is_not_blamed_on_it(settings: dict[str, float], name: str, value: float) -> None:
    found = refine_sizes(MODEL, hold_inputs(record_plant(settings)))
    other = found.others[name]
    assert found.is_explained
    assert all(judge_size(fault, found.sizes[fault.name]) == Level.ACCEPTABLE for fault in FAULTS)
    assert other.value == pytest.approx(value, rel=0.05) and abs(other.high - other.low) < 0.5 * abs(value)


@pytest.mark.parametrize(("size", "expected"), [
    ((0.05, 0.0, 0.1), Level.ACCEPTABLE), ((0.21, 0.16, 0.26), Level.MAINTENANCE),
    ((0.25, 0.2, 0.3), Level.MAINTENANCE), ((0.31, 0.27, 0.36), Level.NON_NOMINAL),
    ((0.2, 0.155, 0.243), Level.ACCEPTABLE), ((0.2, 0.155, 0.247), Level.MAINTENANCE),  # by the margin
    ((0.31, 0.24, 0.38), Level.MAINTENANCE), ((0.5, 0.4, 0.6), Level.NON_NOMINAL), ((0.2, 0.0, 0.4), None)])
def test_levels(size: tuple[float, float, float], expected: Level | None) -> None:
    assert judge_size(CLOGGING, Estimate(*size)) == expected


def test_the_ruling_fault_is_further_along_its_own_limits() -> None:
    sizes = {CLOGGING.name: Estimate(0.3, 0.26, 0.34), FRICTION.name: Estimate(69.0, 66.0, 72.0)}
    both = dict.fromkeys(sizes, Level.MAINTENANCE)
    assert compute_severity(CLOGGING, 0.3) == pytest.approx(1.5) and compute_severity(FRICTION, 69.0) > 1.9
    for levels, ruling in ((both, FRICTION.name), ({**both, FRICTION.name: Level.ACCEPTABLE}, CLOGGING.name),
                           (dict.fromkeys(sizes, Level.ACCEPTABLE), None)):
        assert find_ruling_fault(FAULTS, sizes, levels) == ruling


def test_a_model_with_a_known_effect_keeps_it() -> None:
    unknowns = list_unknowns(MODEL.replace({"null_bias.current": 5e-5}))
    assert {f.name: f.centre for f in unknowns}["null_bias.current"] == 5e-5


COMMAND = np.concatenate([PREFLIGHT[2000:4200], PREFLIGHT[9000:11600]])  # steps, a ramp and a sine
WORN = {"filter.clogging": 0.35, "sensor_lag.time": 1e-3}


@pytest.fixture(scope="module")
def worn() -> Diagnosis:
    trace = record_plant(WORN, COMMAND, seed=3)
    with restored_catalogue(*SEARCHED):
        return diagnose(trace, with_effects=True)


def test_a_fault_is_sized_beside_a_slow_transducer(worn: Diagnosis) -> None:
    assert (worn.verdict, worn.ruling) == ("NON_NOMINAL", CLOGGING.name)
    assert worn.sizes[CLOGGING.name].low < 0.35 < worn.sizes[CLOGGING.name].high
    assert worn.levels == {CLOGGING.name: Level.NON_NOMINAL, FRICTION.name: Level.ACCEPTABLE}
    assert worn.beside is not None and worn.beside.best.effects == ("sensor_lag",)
    lag = worn.beside.best.parameters["sensor_lag.time"]
    assert lag.low < 1e-3 < lag.high < lag.low + 2e-4


def test_the_answer_lists_effects_with_sizes_and_probability(worn: Diagnosis) -> None:
    report = build_diagnosis_report(worn)
    data = report.data["with_effects"]
    assert data["effects"][0] == "sensor_lag" and data["explained"] and "sensor_lag" in report.sentence
    assert sum(each["probability"] for each in data["explanations"]) == pytest.approx(1.0)
    assert set(data["explanations"][0]["parameters"]["sensor_lag.time"]) == {"value", "low", "high", "unit"}
    assert next(s for s in report.sections if s.title == "Other effects").items
    plain = build_diagnosis_report(replace(worn, verdict="SOMETHING_ELSE", beside=None))
    assert "--with-effects" in plain.sentence and "with_effects" not in plain.data


def test_a_searched_fit_that_misses_stops_explains_nothing(worn: Diagnosis) -> None:
    """The typical block alone would accept it: more clogging had made up for a lag, with twice the noise left."""
    assert worn.beside is not None
    found = worn.beside.best.refinement
    missed = replace(found, errors={name: 2.1 * floor for name, floor in found.floor.items()})
    assert found.is_explained and not missed.is_explained and replace(missed, worst=RESIDUAL_WORST).is_explained


def test_the_search_leaves_out_what_every_fit_has() -> None:
    names = list_other_effects(MODEL)
    assert "sensor_lag" in names and len(names) > 20
    assert not {"filter_clogging", "spool_friction", "null_bias", "command_rate_limit", "quantisation"} & set(names)


def test_a_mixture_holds_what_each_part_allows() -> None:
    both, alone = (mix_estimates([Estimate(0.1, 0.0, 0.2), Estimate(0.3, 0.2, 0.4)], weights)
                   for weights in ([0.5, 0.5], [1.0, 0.0]))
    assert both.value == pytest.approx(0.2) and 0.0 < both.low < 0.05 and 0.35 < both.high < 0.4
    assert (alone.low, alone.high) == pytest.approx((0.0, 0.2), abs=2e-3)


def average(worn: Diagnosis, second: Estimate, more: float = 0.0) -> Beside:
    """Over a lag without a fault, and another one whose fit costs so much more, with this size of clogging."""
    found = worn.refinement
    return average_explanations([
        Explanation((effect,), {}, replace(
            found, sizes={**found.sizes, CLOGGING.name: kintas}, fit=replace(found.fit, cost=cost)))
        for effect, kintas, cost in (("sensor_lag", Estimate(0.05, 0.0, 0.1), 100.0),
                                     ("coil_lag", second, 100.0 + more))])


def test_a_level_that_depends_on_the_effect_is_disputed(worn: Diagnosis) -> None:
    found = average(worn, Estimate(0.3, 0.25, 0.34))
    assert found.disputed == (CLOGGING.name,) and found.is_ambiguous
    assert average(worn, Estimate(0.07, 0.02, 0.12)).disputed == ()
    unlikely = average(worn, Estimate(0.3, 0.25, 0.34), 200.0)
    assert unlikely.disputed == () and not unlikely.is_ambiguous and unlikely.sizes[CLOGGING.name].value == 0.05
