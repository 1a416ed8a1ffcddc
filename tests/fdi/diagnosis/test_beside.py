"""Valve faults beside another effect: sizes averaged over what may be right, and the search that finds the effect."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from noisy_traces import record_plant
from synthetic_run import build_command

from fdi.diagnosis.diagnosis import Diagnosis, diagnose
from fdi.diagnosis.faults import CLOGGING, FRICTION, Estimate, Level
from fdi.diagnosis.joint_search import (
    Beside,
    Explanation,
    average_explanations,
    list_other_effects,
    make_joint_problem,
    mix_estimates,
    weigh_costs,
)
from fdi.diagnosis.refine import EFFECT_POWERS, find_flat, list_unknowns, make_problem, make_start
from fdi.estimation.replay import hold_inputs
from fdi.estimation.unidentifiable import find_flat_directions
from fdi.estimation.unknowns import list_effect_unknowns
from fdi.report.diagnosis_report import build_diagnosis_report
from fdi.thresholds import GAIN_TIE, RESIDUAL_WORST
from plant import load_model
from plant.effects import CATALOGUE
from studies import faults_beside_effects as study

COMMAND = np.concatenate([build_command()[2000:4200], build_command()[9000:11600]])  # steps, a ramp and a sine
MODEL = load_model()
WORN = {"filter.clogging": 0.35, "sensor_lag.time": 1e-3}


@pytest.fixture(scope="module")
def worn() -> Diagnosis:
    return diagnose(record_plant(WORN, COMMAND, seed=3), with_effects=True)


def test_a_fault_is_sized_beside_a_slow_transducer(worn: Diagnosis) -> None:
    assert worn.beside is not None and worn.beside.best.effects == ("sensor_lag",)
    assert worn.levels[CLOGGING.name] == Level.NON_NOMINAL and worn.levels[FRICTION.name] == Level.ACCEPTABLE
    assert worn.verdict == "NON_NOMINAL" and worn.ruling == CLOGGING.name
    assert worn.sizes[CLOGGING.name].low < 0.35 < worn.sizes[CLOGGING.name].high
    lag = worn.beside.best.parameters["sensor_lag.time"]
    assert lag.low < 1e-3 < lag.high and lag.high - lag.low < 2e-4


def test_the_answer_lists_effects_with_sizes_and_probability(worn: Diagnosis) -> None:
    report = build_diagnosis_report(worn)
    data = report.data["with_effects"]
    assert data["effects"][0] == "sensor_lag" and data["explained"]
    assert sum(each["probability"] for each in data["explanations"]) == pytest.approx(1.0)
    assert set(data["explanations"][0]["parameters"]["sensor_lag.time"]) == {"value", "low", "high", "unit"}
    assert "sensor_lag" in report.sentence
    assert next(s for s in report.sections if s.title == "Other effects").items


def test_without_the_search_the_answer_names_the_option(worn: Diagnosis) -> None:
    plain = replace(worn, verdict="SOMETHING_ELSE", beside=None)
    report = build_diagnosis_report(plain)
    assert "--with-effects" in report.sentence and "with_effects" not in report.data


def test_what_is_not_a_logarithm_goes_along_with_a_flat_direction() -> None:
    """A ram on a spring: its area and all forces may be scaled only if the stiffness of the spring goes along."""
    model = MODEL
    problem = make_joint_problem(model, hold_inputs(record_plant({"aero_stiffness.stiffness": 1e6}, COMMAND)),
                                 {"xj": 2e-6, "p12": 2e4, "xs": 1e-6})
    free = (*list_unknowns(model), *list_effect_unknowns(CATALOGUE["aero_stiffness"], problem.model))
    x = np.r_[make_start(list_unknowns(model), 0.2, 20.0), 1e6 / free[-1].scale]
    along = find_flat_directions(problem, free, x, (), EFFECT_POWERS)
    without = find_flat_directions(problem, free, x)
    assert along.shape[1] > without.shape[1]
    assert np.abs(along[-1]).max() > 0.0


def test_how_far_the_flapper_moves_shows_only_where_it_meets_its_stops() -> None:
    free = list_unknowns(MODEL)
    x = make_start(free, 0.2, 20.0)
    for command, more in ((COMMAND, 1), (build_command(), 0)):
        problem = make_problem(MODEL, hold_inputs(record_plant({}, command)))
        flat = find_flat(problem, free, x)
        assert flat.shape[1] == find_flat_directions(problem, free, x).shape[1] + more
        white = problem.compute_white_residuals(free, np.vstack([x, x + 0.03 * flat.T]))
        assert ((white[1:] - white[0]) ** 2).sum(axis=(1, 2)).max() < 100.0


def test_a_searched_fit_that_misses_stops_explains_nothing(worn: Diagnosis) -> None:
    """The typical block alone would accept it: more clogging had made up for a lag, with twice the noise left."""
    assert worn.beside is not None
    found = worn.beside.best.refinement
    missed = replace(found, errors={name: 2.1 * floor for name, floor in found.floor.items()})
    assert found.is_explained and not missed.is_explained and replace(missed, worst=RESIDUAL_WORST).is_explained


def test_the_search_leaves_out_what_every_fit_has() -> None:
    names = list_other_effects(load_model())
    assert "sensor_lag" in names and len(names) > 20
    assert not {"filter_clogging", "spool_friction", "null_bias", "command_rate_limit", "quantisation"} & set(names)


def test_costs_within_a_tie_are_equally_likely() -> None:
    first, second, third = weigh_costs([100.0, 100.0 + 0.9 * GAIN_TIE, 100.0 + GAIN_TIE + 20.0])
    assert first == second and third == pytest.approx(first * np.exp(-10.0))


def test_a_mixture_holds_what_each_part_allows() -> None:
    both = mix_estimates([Estimate(0.1, 0.0, 0.2), Estimate(0.3, 0.2, 0.4)], [0.5, 0.5])
    assert both.value == pytest.approx(0.2) and 0.0 < both.low < 0.05 and 0.35 < both.high < 0.4
    alone = mix_estimates([Estimate(0.1, 0.0, 0.2), Estimate(0.3, 0.2, 0.4)], [1.0, 0.0])
    assert alone.low == pytest.approx(0.0, abs=2e-3) and alone.high == pytest.approx(0.2, abs=2e-3)


def explain(worn: Diagnosis, effect: str, kintas: Estimate, more: float = 0.0) -> Explanation:
    found = worn.refinement
    return Explanation((effect,), {}, replace(found, kintas=kintas, fit=replace(found.fit, cost=100.0 + more)))


def average(worn: Diagnosis, second: Estimate, more: float = 0.0) -> Beside:
    return average_explanations([explain(worn, "sensor_lag", Estimate(0.05, 0.0, 0.1)),
                                 explain(worn, "coil_lag", second, more)])


def test_a_level_that_depends_on_the_effect_is_disputed(worn: Diagnosis) -> None:
    found = average(worn, Estimate(0.3, 0.25, 0.34))
    assert found.disputed == (CLOGGING.name,) and found.is_ambiguous
    assert average(worn, Estimate(0.07, 0.02, 0.12)).disputed == ()
    unlikely = average(worn, Estimate(0.3, 0.25, 0.34), 200.0)
    assert unlikely.disputed == () and not unlikely.is_ambiguous and unlikely.sizes[CLOGGING.name].value == 0.05


def row(valve: dict[str, float], kintas: str, fss: str, **more: Any) -> dict[str, Any]:
    return {"valve": valve, "level_kintas": kintas, "level_fss": fss, "kintas": [0.2, 0.1, 0.26],
            "fss": [5.0, 4.0, 6.0], "verdict": "MAINTENANCE", **more}


def test_the_study_counts_against_the_truth() -> None:
    right = study.score_row(row({"filter_clogging": 0.25}, "maintenance", "acceptable"))
    assert right == study.Score(True, False, (True, True))
    blamed = study.score_row(row({}, "maintenance", "cannot_tell"))
    assert blamed == study.Score(False, True, (False, True))
    table = study.format_table([row({}, "acceptable", "acceptable"), row({}, "cannot_tell", "acceptable")])
    assert "| all | 2 | 1 of 2 | 0 of 2 | 0 of 2 | 0 of 2 | 2 of 2 |" in table


def test_the_study_covers_every_pair_in_any_prefix_order() -> None:
    jobs = study.list_jobs()
    assert len(jobs) == len(study.VALVES) * len(study.OTHERS)
    assert len({(study.name_valve(j.valve), j.other) for j in jobs}) == len(jobs) == len({j.seed for j in jobs})
    assert len({study.name_valve(j.valve) for j in jobs[:25]}) == len(study.VALVES)


@pytest.mark.slow
def test_a_lag_is_found_although_more_clogging_makes_up_for_it() -> None:
    """Without the lag the fit has Kintas 0.44 and 1.9 times the noise; only a start afresh promises the lag."""
    job = study.Job(2, 9002, {CLOGGING.name: 0.35}, "coil_lag")
    found = diagnose(study.record_case(job), with_effects=True)
    assert found.beside is not None and found.beside.best.effects == ("coil_lag",)
    assert found.sizes[CLOGGING.name].low < 0.35 < found.sizes[CLOGGING.name].high
    assert found.levels[CLOGGING.name] == Level.NON_NOMINAL
    lag = found.beside.best.parameters["coil_lag.time"]
    assert lag.low < 4.58e-4 < lag.high


@pytest.mark.slow
@pytest.mark.parametrize(("number", "seed", "valve", "other"), [
    (9, 9609, {CLOGGING.name: 0.25}, "compressibility"),  # the ram's static friction has to move with the dynamic one
    (22, 9622, {FRICTION.name: 70.0}, "nozzle_asymmetry"),  # only a scan with more noise promises it
])
def test_what_no_fit_without_it_comes_near_is_found(number: int, seed: int, valve: dict[str, float], other: str
                                                    ) -> None:
    job = study.Job(number, seed, valve, other)
    found = diagnose(study.record_case(job), with_effects=True)
    assert found.beside is not None and found.beside.best.effects == (other,)
    fault, size = next(iter(valve.items()))
    assert found.sizes[fault].low < size < found.sizes[fault].high
    assert found.levels[fault] == (Level.MAINTENANCE if size == 0.25 else Level.NON_NOMINAL)
