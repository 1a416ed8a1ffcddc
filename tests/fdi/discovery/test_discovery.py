"""The statistics behind `rig explain`; the laws found in what remains; what `--sensitivity` hides and claims."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
import pytest
from effect_files import HEAD, SEARCHED, restored_catalogue
from noisy_traces import SHORT, record_plant
from refusals import catch_refusal
from rig_command import rig, write_file
from scipy.signal import lfilter
from short_runs import (
    HIDDEN,
    STEPS,
    build_command,
    build_other_command,
    list_trace_arguments,
    simulate_trace,
    write_measured_runs,
)

import rig.campaign.sensitivity as rounds
from fdi import thresholds
from fdi.discovery.explain import (
    Marks,
    compute_firmware_residual,
    decide_verdict,
    explain,
    find_marks,
    helps_explain,
    leave_out_unneeded,
    shows_effect,
)
from fdi.discovery.explain_runs import Answer, Candidate, assess_explanation, explain_runs
from fdi.discovery.laws.find_law import (
    LawSearch,
    evaluate_columns,
    find_dependences,
    find_law,
    propose_terms,
    select_rows,
)
from fdi.discovery.laws.terms import (
    LIBRARY,
    PARTS,
    STATES,
    TERMS,
    find_states,
    format_formula,
    name_parameter,
    registered_library,
    write_effects,
    write_law,
    write_law_file,
)
from fdi.discovery.residual_pattern import Balance, Pattern, States, fit_curve, fit_wave, measure_way, write_effect
from fdi.discovery.runs import Runs, read_runs
from fdi.discovery.search import Hypothesis, Search, measure_repeating, scan_effects
from fdi.discovery.sensitivity import (
    NEEDED,
    RUNGS,
    TRIALS,
    Injection,
    Unit,
    choose_injections,
    describe_unit,
    hide_effect,
    judge_injection,
    measure_size,
    summarise_injections,
)
from fdi.estimation import Value, fit_noise, fit_unknowns, hold_inputs, linearise, list_all_unknowns
from fdi.estimation.fit import silence_sensors
from fdi.estimation.noise import measure_level
from fdi.trace import Trace
from plant import Input, Model, load_model, simulate
from plant.effects import CATALOGUE, combine_laws, load_effects
from plant.eha import State
from plant.state import Drag, Line

SEEDS = range(20)


def coloured(seed: int, n: int = 13_500) -> np.ndarray:
    return lfilter([1.2e-6], [1.0, -0.8], np.random.default_rng(seed).standard_normal(n))


@pytest.mark.parametrize("seed", SEEDS)
def test_coloured_noise_becomes_white(seed: int) -> None:
    noise = fit_noise(coloured(seed))
    white = np.empty((1, 1, 13_500))
    noise.whiten_signal(coloured(seed + 1000)[None, None], 0, white)
    assert noise.level == pytest.approx(2e-6, rel=0.05)  # 1.2e-6 / sqrt(1 - 0.8^2)
    assert white[0, 0, 50:].std() == pytest.approx(1.0, rel=0.05)
    assert abs(np.corrcoef(white[0, 0, 51:], white[0, 0, 50:-1])[0, 1]) < 0.04


def test_what_is_not_measured_counts_as_nothing_and_a_stop_that_came_later_is_no_noise() -> None:
    rows, white = np.arange(13_500), np.random.default_rng(0).normal(0.0, 1.0, 13_500)
    holed = np.where((rows >= 500) & (rows < 520), np.nan, coloured(0))
    white_signal = np.empty((1, 1, 13_500))
    fit_noise(holed).whiten_signal(holed[None, None], 0, white_signal)
    assert np.isfinite(white_signal).all() and (white_signal[..., 500:520] == 0.0).all()
    late = white + 50.0 * ((rows >= 3000) & (rows < 4000))
    assert (measure_level(late), fit_noise(late).level) == pytest.approx((1.0, 1.0), rel=0.05)


def test_independent_noise_of_any_colour_does_not_repeat_and_physics_does() -> None:
    ratios = [measure_repeating(coloured(s)[None], [coloured(s + 500)[None]], [0.0])[0] for s in SEEDS]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.02) and max(ratios) < 1.08  # the gate
    physics = 1e-6 * np.sin(np.arange(13_500) / 200.0)
    ratio = measure_repeating((coloured(1) + physics)[None], [(coloured(2) + physics)[None]], [0.0])[0]
    assert ratio == pytest.approx(np.sqrt(1 + 0.5e-12 / 4e-12), abs=0.03)


def _recorded(changes: dict[str, float], seed: int = 0) -> Trace:
    t = np.arange(3000) * 1e-3
    com = 5e-3 * np.sign(np.sin(2 * np.pi * t))
    return simulate_trace(Model().replace(changes), com, seed=seed)


def test_the_firmware_leaves_its_mark_without_noise() -> None:
    model = Model()
    healthy_trace, limited_trace = hold_inputs(_recorded({})), hold_inputs(_recorded({"command_rate_limit.rate": 0.12}))
    assert np.nanmax(np.abs(compute_firmware_residual(model, healthy_trace))) == 0.0
    plain, marks = find_marks(model, [healthy_trace]), find_marks(model, [limited_trace])
    assert (plain.controller, plain.prints, plain.step) == (0.0, (), 0.0)
    assert marks.controller > 100.0 and marks.is_firmware_different
    (fingerprint,) = marks.prints
    value, low, high = fingerprint.parameters["command_rate_limit.rate"]
    assert low <= 0.12 <= high or value == pytest.approx(0.12, rel=1e-6)
    slower = hold_inputs(_recorded({"asymmetric_gain.retraction": -0.2}))
    (fingerprint,) = [each for each in find_marks(model, [slower]).prints if each.effect == "asymmetric_gain"]
    assert fingerprint.parameters["asymmetric_gain.retraction"][0] == pytest.approx(-0.2, rel=1e-4)


def test_a_converter_with_few_bits_leaves_a_comb() -> None:
    marks = find_marks(Model(), [hold_inputs(_recorded({"quantisation.lsb": 7.3e-6}))])
    (fingerprint,) = marks.prints
    assert fingerprint.parameters["quantisation.lsb"][0] == pytest.approx(7.3e-6, rel=1e-4) and not marks.is_recorder


def test_a_recorder_that_rounds_positions_is_no_effect() -> None:
    def record_rounded(changes: dict[str, float], seed: int) -> Trace:
        trace = record_plant(changes, SHORT, seed)
        return hold_inputs(trace.with_columns({"xj": 2e-6 * np.round(trace.xj / 2e-6)}))

    healthy = find_marks(Model(), [record_rounded({}, 3)])
    assert healthy.is_recorder and healthy.controller < 2.0 and not healthy.prints
    slow, again = (record_rounded({"sensor_lag.time": 1e-3}, seed) for seed in (1, 2))
    with restored_catalogue(*SEARCHED):
        explanation = explain(Model(), slow, [again])
    assert (explanation.verdict, explanation.effects) == (
        "EXPLAINED", ("sensor_lag",)) and explanation.marks.is_recorder


def test_an_effect_that_the_model_has_at_another_size_is_named() -> None:
    """NOTHING_MISSING was the answer: the fit had moved the friction to where the unit has it, and nobody was told."""
    runs = [hold_inputs(record_plant({}, SHORT, seed)) for seed in (1, 2)]
    with restored_catalogue(*SEARCHED):
        e = explain(Model().replace({"jack.static_friction": 600.0, "jack.dynamic_friction": 300.0}), runs[0], runs[1:])
    assert (e.verdict, e.effects, e.base.is_at_floor) == ("EXPLAINED", ("jack_friction",), False)
    assert e.ranked[0].fit.values["jack.dynamic_friction"] == pytest.approx(500.0, rel=0.05)


def test_a_wave_over_the_position_and_a_curve_over_the_speed_are_found() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(13_000) * 1e-3
    x = 5e-3 * np.sin(2 * np.pi * 0.3 * t) + 1e-3 * np.sin(2 * np.pi * 2.1 * t)
    y = 700.0 * np.sin(2 * np.pi * x / 1.7e-3 + 0.4) + rng.normal(0.0, 200.0, x.size)
    (amplitude, length, phase), share = fit_wave(y, x, 200.0)
    assert (amplitude, length) == pytest.approx((700.0, 1.7e-3), rel=0.05)
    assert share > 0.9 and np.cos(phase - 0.4) > 0.9
    v = rng.normal(0.0, 0.02, 13_000)
    share, at, height, doubt = fit_curve(2e6 * v * np.abs(v) + rng.normal(0.0, 100.0, v.size), v, 100.0)
    assert share > 0.95 and (doubt > 0.0).all() and np.abs(height - 2e6 * at * np.abs(at)).max() < 150.0


@pytest.mark.parametrize("shape", ["wave", "curve"])
def test_what_is_discovered_becomes_an_effect_that_runs(shape: str, tmp_path: Path) -> None:
    at = np.linspace(-0.1, 0.1, 9)
    pattern = Pattern("force", "N", 500.0, "position" if shape == "wave" else "speed", 0.9, at, 1e4 * at, at * 0 + 1.0,
                      (700.0, 2.5e-3, 0.3) if shape == "wave" else None, np.zeros(10), ("load", "x + {0}"))
    write_effect(pattern, tmp_path / "found.py")
    assert len((tmp_path / "found.py").read_text().splitlines()) < 40
    assert load_effects(tmp_path / "found.py") == ["discovered"]
    start = CATALOGUE["discovered"].starts[-1]
    com = 3e-3 * np.sin(2 * np.pi * np.arange(300) * 1e-3)
    pressure, nominal_pressure = (
        simulate(model, com, steps=20, fast=False).p12 for model in (Model().replace(start), Model()))
    assert np.abs(pressure - nominal_pressure).max() > 2e4  # Pa, the sensor's noise


def test_a_scan_finds_a_frequency_from_a_line_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a supply that ripples, where the line that stands out is two turns over the test beside the ripple's."""
    ripple = {"supply_ripple.amplitude": 0.03, "supply_ripple.frequency": 36.64, "supply_ripple.phase": 0.4}
    search = Search(Model(), hold_inputs(record_plant(ripple)), [], ["supply_ripple"], 1)
    turn = 1.0 / (1e-3 * len(search.problem.trace))  # Hz
    beside = [{**ripple, "supply_ripple.frequency": 36.64 - 2.3 * turn, "supply_ripple.phase": phase}
              for phase in (0.0, 1.57, 3.14, 4.71)]
    monkeypatch.setattr("fdi.discovery.search.find_tones", lambda *_: beside)
    (prospect,) = scan_effects(search.problem, [search.fit_base().fit], ["supply_ripple"])
    values = {f.name: f.centre + f.scale * x for f, x in zip(prospect.free, prospect.x, strict=True)}
    assert values["supply_ripple.frequency"] == pytest.approx(36.64, abs=0.3 * turn)


T = 1e-3 * np.arange(1000)
COMMAND = 5e-4 * np.sin(2.0 * np.pi * 2.0 * T) * (1.0 - np.exp(-5.0 * T))  # m
BIAS = {"null_bias.current": 1e-4}


def test_a_recording_without_noise_is_taken_to_have_some() -> None:
    """Else what solver and rounding leave would be all that is left to explain: of a simulation, by a second effect."""
    run = simulate(silence_sensors(Model()), SHORT)
    columns = {"com": SHORT, "xj": run.xj, "cor": run.cor, "p12": run.p12, "xs": run.xs}
    search = Search(Model(), hold_inputs(Trace.from_columns(columns, 1e-3, {})), [], ["supply_ripple"], 1)
    search.learn_noise(search.fit_base())
    assert [n.level for n in search.noise] == pytest.approx([5e-7, 5e3, 2.5e-7], rel=1e-9)


@pytest.fixture(scope="module")
def search() -> Search:
    """A run with a null bias, whose unknowns are the tolerances and this bias."""
    bias_search = Search(load_model().replace(BIAS), hold_inputs(record_plant(BIAS, COMMAND)), [], [], 1)
    bias_search.problem = replace(bias_search.problem, bare=None)
    return bias_search


def test_a_held_out_run_may_lack_signals(search: Search) -> None:
    """Each that it has keeps its own noise."""
    assert search.make_problem(hold_inputs(record_plant(BIAS, COMMAND), ["xs"]), 20).noise == search.problem.noise[-1:]


@pytest.mark.parametrize(("effect", "name", "value", "sd", "shown"), [
    ("null_bias", "null_bias.current", 1e-4, 1.0, True), ("null_bias", "null_bias.current", 1e-8, 1.0, False),
    ("moving_mass", "jack.mass", 100.1, 0.0, False)])
def test_an_effect_counts_only_if_its_interval_leaves_out_the_off_value(search: Search, effect: str, name: str,
                                                                        value: float, sd: float, shown: bool) -> None:
    """A null bias of 100 uA does, one of a part of its standard deviation does not, nor a mass of a healthy unit."""
    free = list_all_unknowns(search.model)
    fit = linearise(search.problem, free, np.zeros(len(free)))
    x = np.array([(value - f.centre) / f.scale if f.name == name else 0.0 for f in free])
    h = search.judge_fit((effect,), replace(fit, x=x, covariance=sd * fit.covariance))
    assert shows_effect(load_model(), h, effect) is shown


def test_of_two_effects_the_one_that_may_be_off_is_left_out() -> None:
    """A null bias alone is hidden: a constant load that was added to it has an interval around 0."""
    search = Search(load_model(), hold_inputs(record_plant(BIAS, COMMAND)), [], ["null_bias", "constant_load"], 1)

    def add(h: Hypothesis, effect: str) -> Hypothesis:
        (p,) = scan_effects(search.problem, [h.fit], [effect])
        return search.judge_fit((*h.effects, effect), fit_unknowns(search.problem, p.free, p.x))

    both = add(add(search.fit_base(), "null_bias"), "constant_load")
    assert [h.effects for h in leave_out_unneeded(search, [both])] == [("null_bias",)]


@pytest.mark.parametrize(("at_floor", "is_far", "xj", "verdict"), [
    (True, False, 2e-6, "EXPLAINED"), (True, True, 2e-6, "PARTLY"),
    (False, False, 3e-6, "PARTLY"), (False, False, 10e-6, "UNEXPLAINED")])
def test_an_explanation_that_needs_tolerances_of_no_healthy_unit_or_spoils_a_signal_is_doubted(
        at_floor: bool, is_far: bool, xj: float, verdict: str) -> None:
    """A lag of the pilot pressure, which is not in the catalogue, was called a coil lag with clogging, EXPLAINED."""
    base, best = (make_judged((), 9000.0, errors={"xj": 2e-6, "p12": 4e5}), make_judged(
        ("coil_lag", "filter_clogging"), 1000.0, at_floor, is_far, {"xj": xj, "p12": 4e4}))
    assert decide_verdict(base, [best], [best], True, Marks(1.0, 1e-6, ()), {"xj": 2e-6, "p12": 2e4}) == (
        verdict, best.effects if verdict != "UNEXPLAINED" else ())


def make_judged(effects: tuple[str, ...], cost: float, at_floor: bool | None = None, is_far: bool = False,
                errors: Mapping[str, float] = {}) -> Any:
    """As far as `decide_verdict` looks at it; at the floor if it has effects, unless told."""
    return cast(Any, SimpleNamespace(effects=effects, cost=cost, repeat_cost=cost, tolerance_cost=10.0, others=(),
                                     is_at_floor=bool(effects) if at_floor is None else at_floor, is_far=is_far,
                                     errors=errors))


@pytest.mark.parametrize(("cost", "at_floor", "helps"), [
    (40_200.0, True, True), (40_200.0, False, False), (42_300.0, True, False)])
def test_a_further_effect_may_miss_another_stop_of_the_repeat(cost: float, at_floor: bool, helps: bool) -> None:
    """It helps nevertheless if it alone leaves only noise, and gains much on the run."""
    before, after = make_judged(("null_bias",), 42_450.0, False), make_judged(("null_bias", "stribeck"), cost, at_floor)
    before.repeat_cost, after.repeat_cost, after.others = 44_020.0, 44_240.0, ("a repeat",)
    assert helps_explain(before, after, 30.0) is helps


@pytest.mark.parametrize(("costs", "unseen", "verdict"), [
    ((933.0,), (900.0, 896.0), "NOT_RESOLVABLE"), ((933.0,), (900.0, 860.0), "EXPLAINED"),
    ((933.0,), (), "EXPLAINED"),
    ((800.0, 835.0), (900.0, 700.0, 800.0), "EXPLAINED"), ((800.0, 835.0), (900.0, 700.0, 705.0), "AMBIGUOUS"),
    ((800.0, 805.0), (900.0, 700.0, 800.0), "AMBIGUOUS"), ((800.0, 835.0), (), "AMBIGUOUS"),
    ((800.0, 865.0), (900.0, 750.0, 700.0), "AMBIGUOUS"), ((800.0, 835.0), (900.0, 700.0, 890.0), "EXPLAINED"),
])
def test_a_small_gain_must_show_on_the_held_out_run(costs: tuple[float, ...], unseen: tuple[float, ...], verdict: str
                                                   ) -> None:
    """There a stop that a fit met by chance is missed, and one of two look-alikes may be the better one again."""
    base = make_judged((), 1000.0, at_floor=True)
    close = [make_judged((name,), cost) for name, cost in zip(("coil_lag", "transport_delay"), costs, strict=False)]
    assert decide_verdict(base, close, close, True, Marks(1.0, 1e-6, ()), {"xj": 2e-6}, unseen)[0] == verdict


@pytest.mark.parametrize(("costs", "verdict"), [
    ((), "UNEXPLAINED"), ((980.0,), "EXPLAINED"), ((980.0, 990.0), "AMBIGUOUS"), ((980.0, 995.0), "EXPLAINED")])
def test_an_effect_that_spares_the_unit_far_tolerances_is_named(costs: tuple[float, ...], verdict: str) -> None:
    """A joint that had softened by 45 % was NOTHING_MISSING, with its stiffness at -4.5 standard deviations."""
    base = make_judged((), 1000.0, at_floor=True, is_far=True)
    close = [make_judged((name,), cost) for name, cost in zip(("soft_spline", "backlash"), costs, strict=False)]
    unseen = [900.0] * (1 + len(close))
    decision, effects = decide_verdict(base, close, close, False, Marks(1.0, 1e-6, ()), {"xj": 2e-6}, unseen)
    assert decision == verdict and effects[:1] == (("soft_spline",) if costs else ())


def test_the_page_shows_the_decision_procedure_of_the_code() -> None:
    stages = [line for line in str(import_module("fdi.discovery.explain").__doc__).splitlines() if line[:1] == "|"]
    table = "\n".join(stages).format(**vars(thresholds))
    assert len(stages) > 20 and table in (Path(__file__).parents[3] / "docs/explain.md").read_text()


def candidate(effect: str, *beside: str) -> Candidate:
    return Candidate(effect, beside, {f"{effect}.size": Value(1.0, 0.9, 1.1, "N")}, {}, {}, {}, 0.0, 0.0, "explains")


def test_a_pair_is_shown_once_with_the_sizes_of_both() -> None:
    both = (candidate("a", "b"), candidate("b", "a"), candidate("c", "a"), candidate("d"))
    explanations = Answer(cast(Any, None), both, {}, (), (), (), ()).explanations
    assert [(c.effect, c.beside) for c in explanations] == [("a", ("b",)), ("c", ("a",)), ("d", ())]
    assert set(explanations[0].parameters) == {"a.size", "b.size"} and set(both[0].parameters) == {"a.size"}


def record_unit(changes: dict[str, float], seed: int) -> Trace:
    return simulate_trace(Model().replace(changes), build_command(), seed=seed, steps=STEPS)


@pytest.fixture(scope="module")
def run() -> Trace:
    return record_unit(HIDDEN, 1)


def test_a_repeat_from_another_unit_is_a_note(run: Trace) -> None:
    runs = read_runs(Model(), run, [record_unit(HIDDEN | {"filter.clogging": 0.3}, 2)])
    assert len(runs.notes) == 1 and runs.notes[0].startswith("the repeats differ by more than the noise of the sensors")
    assert "XS by" in runs.notes[0] and "same unit" in runs.notes[0]


def test_a_true_repeat_needs_no_note_although_the_model_is_wrong(run: Trace) -> None:
    assert read_runs(Model(), run, [record_unit(HIDDEN, 2)]).notes == ()
    assert read_runs(Model(), run).notes == () and "less than another command" in str(
        read_runs(Model(), run, holdout=record_unit(HIDDEN, 2)).notes)


BY_NAME = {term.name: term for term in TERMS}


def sample_states(seed: int = 0, n: int = 6000) -> dict[str, np.ndarray]:
    """States as a run might have them: smooth, of usual sizes."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 1e-3

    def wander(size: float) -> np.ndarray:
        waves = [rng.normal() * np.sin(2 * np.pi * rng.uniform(0.1, 3.0) * t + rng.uniform(0, 6)) for _ in range(8)]
        return size * np.sum(waves, axis=0) / 2.0

    position = wander(4e-3)
    speed = np.gradient(position, 1e-3)
    return {"position": position, "speed": speed, "pressure": wander(3e6), "spool": wander(2e-4),
            "current": wander(2e-3), "time": t, "spool_speed": wander(1e-2), "command": wander(4e-3),
            "direction": np.clip(speed / 2e-4, -1.0, 1.0), "way": measure_way(position, speed),
            "acceleration": np.gradient(speed, 1e-3)}


def test_terms_are_well_formed() -> None:
    names = [field for term in TERMS for field in term.fields]
    assert len(names) == len(set(names)), "each field names one parameter"
    assert all(set(find_states(term)) <= set(STATES) and term.part in PARTS
               and (term.shape is None) == ("{" not in term.factor) for term in TERMS)


@pytest.mark.parametrize("name", ["spring_difference", "cogging", "drag_square", "friction_pressure", "contact",
                                  "friction_run_in", "leakage_root", "leakage_slope", "flow_square", "feedback_cube",
                                  "dead_band", "gain_drift", "ripple"])
def test_the_regression_ranks_the_right_term_first(name: str) -> None:
    term, states = BY_NAME[name], sample_states()
    usual = {"position": 2.1e-3, "current": 8e-4, "time": 37.25, "way": 8e-4}
    shape = {f"{name}_{term.shape.name}": usual[term.shape.state]} if term.shape else {}
    values = {name: 1.0, **shape, **({f"{name}_phase": 0.7} if term.is_wave else {})}
    column = evaluate_columns(term, values, states)[:, 0]
    missing = column / column.std() + 0.3 * np.random.default_rng(1).standard_normal(len(column))
    balance = Balance(term.place, "N", missing, 0.3, 3.0, np.ones(len(missing), bool))
    rows = select_rows(balance, States(**states), {**Model().values, "jack.area": 1e-9})
    best = propose_terms(term.place, rows)[0]
    assert best.term.name == name and best.values[name] * column.std() == pytest.approx(1.0, rel=0.15)
    if term.is_wave:
        assert {field: best.values[field] for field in shape} == pytest.approx(shape, rel=0.03)


def test_what_the_residual_follows_is_tested_on_rows_that_the_curve_never_saw() -> None:
    fit_states, holdout_states = (
        {name: sample_states(seed)[name] for name in ("position", "speed", "pressure", "spool", "current")}
        for seed in (2, 3))
    product, holdout_product = (
        states["position"] * states["pressure"] / 1e4 for states in (fit_states, holdout_states))
    noise = np.random.default_rng(5).standard_normal(len(product))
    dependences = find_dependences(product + 0.3 * product.std() * noise, fit_states, (holdout_product, holdout_states))
    assert dependences[0].states == ("position", "pressure") and dependences[0].share > 0.5
    assert dependences[0].holdout is not None and dependences[0].holdout > 0.4 and dependences[0].p_value < 0.02
    coloured = np.convolve(noise, np.ones(200), "same")
    assert find_dependences(coloured, fit_states, None)[0].p_value > 0.05, "slow noise follows nothing"


SIZES = {"cogging": 400.0, "cogging_length": 2e-3, "cogging_phase": 0.3, "drag_square": 3e5, "friction_run_in": 200.0,
         "friction_run_in_length": 1e-3, "flow_square": 200.0, "leakage_outer": 2e-9, "area_slope": 0.02,
         "dead_band": 0.4, "dead_band_width": 2e-4, "feedback_cube": 1e6}
TERMS_OF = {"force": ("cogging", "drag_square", "friction_run_in"),
            "flow": ("flow_square", "leakage_outer", "area_slope"),
            "current": ("dead_band", "feedback_cube")}


@pytest.mark.parametrize("place", LIBRARY)
def test_a_written_law_is_what_the_library_replayed(place: str, tmp_path: Path) -> None:
    """Bit for bit: what was chosen with the library is what the file adds; at its off values it changes no bit."""
    terms = [BY_NAME[name] for name in TERMS_OF[place]]
    values = {field: SIZES[field] for term in terms for field in term.fields}
    states = sample_states(7, 300)
    with registered_library():
        text = write_effects({place: "own_law"}, terms, values, "A law.")
        assert load_effects(write_file(tmp_path / "law.py", text)) == ["own_law"]
        library_model = Model().with_effects([LIBRARY[place]]).replace(
            {name_parameter(t, f): values[f] for t in terms for f in t.fields})
        file_model = Model().with_effects(["own_law"])
        signal = {"force": Drag(0.0, 0.0, 800.0, 500.0), "flow": Line(1e6, 2e9, 2e7, 1e6), "current": 3e-4}[place]

        def run(model: Model) -> list[object]:
            record, out = model.build_record()[0], []
            law, memory = combine_laws(CATALOGUE[model.effects[0]].port, map(model.find_effect, model.effects))
            for k in range(300):
                s = State(spool_position=states["spool"][k], spool_speed=states["spool_speed"][k],
                          jack_position=states["position"][k], jack_speed=states["speed"][k],
                          pressure=states["pressure"][k])
                x, memory = law(signal, memory, s, Input(drive=states["current"][k], t=1e-3 * k, h=1e-3), record)
                out.append(x)
            return out

        outputs = run(file_model.replace({f"own_law.{f}": v for f, v in values.items()}))
        assert run(library_model) == outputs != run(file_model) == [signal] * 300


def test_a_law_reads_as_a_formula() -> None:
    assert format_formula([BY_NAME["drag_square"]]) == "force + drag_square * abs(speed) * speed"
    assert format_formula([BY_NAME["contact"]]) == \
        "force + contact * (max(position - contact_gap, 0.0) - max(-position - contact_gap, 0.0))"
    text = write_law("own", [BY_NAME["cogging"]], {"cogging": 700.0, "cogging_length": 2e-3, "cogging_phase": 0.1})
    assert '@effect("load", Own,' in text and 'Quantity("N", low=0, high=10000)' in text
    assert 'Quantity("m", low=0.0004, high=0.01)] = 0.002' in text


HIDDEN_LAW = HEAD + '''
from plant.state import Drag, Line

class Hidden(NamedTuple):
    size: Annotated[float, Quantity("1")] = 0.0

@effect("{port}", Hidden, law="hidden")
def hidden_law(x, s, u, p):
    size = p.hidden_law.size
    return {law}
'''


class Outside(NamedTuple):
    """A law outside the catalogue: where it acts, what it does, the term that it is, and its size."""

    port: str
    law: str
    term: str
    size: float


OUTSIDE: Mapping[str, Outside] = {
    "cogging": Outside("load", "x + size * sin(2.0 * pi * s.jack_position / 1.1e-3 + 0.5)", "cogging", 900.0),
    "cubic feedback spring": Outside("current", "x - size * s.spool_position ** 3", "feedback_cube", 2e6),
    "quadratic drag": Outside("jack_drag", "Drag(x.force, x.damping + size * abs(s.jack_speed), x.static, x.dynamic)",
                              "drag_square", 6e5),
    "stiffness of one side": Outside("load", "x + size * abs(s.jack_position)", "spring_difference", 6e5),
    "friction that grows with the pressure": Outside(
        "jack_drag", "Drag(x.force, x.damping, x.static + size * abs(s.pressure), x.dynamic + size * abs(s.pressure))",
        "friction_pressure", 3e-4),
    "dead band of the current": Outside("current", "x - size * min(max(u.drive, -3e-4), 3e-4)", "dead_band", 0.3),
    "displacement that grows along the stroke": Outside(
        "valve", "Line(x.offset, x.slope * (1.0 + size / p.jack.area * s.jack_position), x.limit, x.drive)",
        "area_slope", 0.05),
}
QUICK = ("cogging",)


def record_runs(model: Model) -> list[Trace]:
    """Short runs of a plant, the last one with another command; white noise of the sensors."""
    commands = build_command(), build_command(), build_other_command()
    return [simulate_trace(model, com, seed=seed, steps=STEPS) for seed, com in enumerate(commands, 1)]


def search_law(traces: list[Trace]) -> LawSearch:
    """The search for a law that the nominal plant lacks."""
    runs = read_runs(Model(), traces[0], traces[1:2], traces[2])
    search = Search(runs.model, runs.est, runs.repeats, [], holdout=runs.holdout)
    base = search.fit_base()
    search.learn_noise(base)
    search.refine_steps(10, 20)
    base = search.judge_fit((), base.fit)
    return find_law(search, base, None, search.estimate_floor(base))


@pytest.mark.parametrize("name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
                                  for name in OUTSIDE])
def test_a_hidden_law_is_found_named_and_written(name: str, tmp_path: Path) -> None:
    outside = OUTSIDE[name]
    with restored_catalogue():
        load_effects(write_file(tmp_path / "hidden.py", HIDDEN_LAW.format(port=outside.port, law=outside.law)))
        traces = record_runs(Model().replace({"hidden_law.size": outside.size}))
    law_search = search_law(traces)
    law = law_search.law
    assert law is not None and law.holds and [term.name for term in law.terms] == [outside.term], law
    assert all(error < 1.2 * law_search.floor[signal] for signal, error in law.holdout.items())
    worst = max(law_search.floor, key=lambda s: law_search.base.errors[s] / law_search.floor[s])
    assert law.hypothesis.errors[worst] < 0.5 * law_search.base.errors[worst]
    assert law.values[outside.term].low < outside.size < law.values[outside.term].high
    names = write_law_file(tmp_path / "law.py", law.terms, law.values, law.reason)
    assert load_effects(tmp_path / "law.py") == list(names.values()) == [f"missing_{law.terms[0].place}"]
    assert CATALOGUE[names[law.terms[0].place]].starts


def test_a_healthy_run_has_no_law() -> None:
    law_search = search_law(record_runs(Model()))
    assert law_search.law is None and not any(m.visible for m in law_search.missing)


Row = dict[str, Any]


@pytest.fixture(scope="module")
def few_effects() -> Iterator[None]:
    with restored_catalogue(*SEARCHED):
        yield


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("runs"), HIDDEN)


@pytest.fixture(scope="module")
def explained(files: dict[str, Path]) -> tuple[Runs, Answer]:
    words = [str(word) for word in list_trace_arguments(files)]
    runs = read_runs(load_model("eha"), words[0], [words[2]], words[4])
    return runs, explain_runs(runs)[0]


@pytest.fixture
def unit(explained: tuple[Runs, Answer]) -> Unit:
    return describe_unit(*explained)


@pytest.mark.usefixtures("few_effects")
def test_the_unit_is_the_measured_one_and_its_model_has_what_was_found(unit: Unit) -> None:
    assert unit.model.effects == ("null_bias",) and "null_bias" not in unit.effects
    assert unit.model["null_bias.current"] == pytest.approx(HIDDEN["null_bias.current"], rel=0.1)
    assert unit.values["null_bias.current"] == unit.model["null_bias.current"]
    assert set(unit.noise) == {"xj", "p12", "xs"} and unit.repeats == 1 and unit.holdout is not None


@pytest.mark.usefixtures("few_effects")
def test_the_same_injection_makes_the_same_runs_and_a_larger_one_moves_them_more(unit: Unit) -> None:
    once, again, smaller = (hide_effect(unit, Injection(3, "constant_load", rung, 0)).est for rung in (0, 0, 3))
    assert all((once.column(name) == again.column(name)).all() for name in unit.noise)
    plain = hide_effect(unit, Injection(3, "constant_load", RUNGS + 20, 0)).est
    large, small = (np.abs(run.drive - plain.drive).mean() for run in (once, smaller))
    assert large > 3.0 * small > 0.0
    sizes = [measure_size(unit.model, "constant_load", rung) for rung in (0, 3)]
    assert sizes[0] == pytest.approx(8.0 * sizes[1])


@pytest.mark.usefixtures("few_effects")
def test_a_large_effect_is_named_as_in_a_measured_run(unit: Unit) -> None:
    row = judge_injection(Injection(5, "constant_load", 1, 0), unit)
    assert (row["verdict"], row["effects"], row["is_named"]) == ("EXPLAINED", ["constant_load"], True)


def play_rounds(unit: Unit, first: int, is_named: Callable[[Injection], bool]) -> list[Row]:
    rows: list[Row] = []
    while jobs := choose_injections(unit, dict.fromkeys(unit.effects, first), rows):
        assert {job.number for job in jobs}.isdisjoint(row["number"] for row in rows)
        rows += [answer(job, is_named(job)) for job in jobs]
    return rows


def answer(job: Injection, is_named: bool) -> Row:
    return {**job._asdict(), "is_named": is_named, "verdict": "EXPLAINED" if is_named else "AMBIGUOUS",
            "effects": [job.effect] if is_named else [job.effect, "sensor_gain"]}


@pytest.mark.usefixtures("few_effects")
@pytest.mark.parametrize("first", [0, 3, RUNGS - 1])
@pytest.mark.parametrize("last", [-1, 0, 2, 5, RUNGS - 1])
def test_the_smallest_size_that_is_named_is_found_from_anywhere(unit: Unit, first: int, last: int) -> None:
    """`last`: the smallest rung on which an effect is named; -1: on none."""
    one = Unit(**{**vars(unit), "effects": ("constant_load", "coil_lag")})
    rows = play_rounds(one, first, lambda job: job.rung <= last)
    for claim in summarise_injections(one, rows):
        size = None if last < 0 else measure_size(unit.model, claim.effect, last)
        assert claim.smallest == size
        assert claim.named is None if last < 0 else claim.named and (claim.named.good, claim.named.of) == (10, 10)
        misses = sum(row["effect"] == claim.effect and not row["is_named"] for row in rows)
        assert dict(claim.taken_for) == ({f"{claim.effect} and sensor_gain (AMBIGUOUS)": misses} if misses else {})
    assert len(rows) <= len(one.effects) * TRIALS * (abs(first - last) + 2)


@pytest.mark.usefixtures("few_effects")
def test_a_size_counts_with_one_miss_and_not_with_two(unit: Unit) -> None:
    one = Unit(**{**vars(unit), "effects": ("coil_lag",)})
    for misses in (TRIALS - NEEDED, TRIALS - NEEDED + 1):
        rows = play_rounds(one, 0, lambda job: job.rung == 0 and job.trial >= misses)  # noqa: B023 - called at once
        (claim,) = summarise_injections(one, rows)
        assert (claim.smallest is not None) == (misses <= TRIALS - NEEDED)


@pytest.mark.usefixtures("few_effects")
def test_the_command_tells_claims_and_resumes(files: dict[str, Path], monkeypatch: pytest.MonkeyPatch,
                                              tmp_path: Path) -> None:
    jobs: list[Injection] = []

    def judge(job: Injection, unit: Unit) -> Row:
        jobs.append(job)
        return answer(job, job.rung <= 2)

    monkeypatch.setattr(rounds, "judge_injection", judge)
    arguments = ("explain", *list_trace_arguments(files), "--sensitivity", "--hide", "coil_lag,constant_load",
                 "--workers", "1", "--out", tmp_path / "page.html")
    result = rig(*arguments, "--json")
    claims = {claim["effect"]: claim for claim in result.json["sensitivity"]}
    assert set(claims) == {"coil_lag", "constant_load"} and jobs
    lag = claims["coil_lag"]
    assert lag["parameter"] == "coil_lag.time" and lag["unit"] == "s" and lag["named"]["good"] == TRIALS
    assert lag["smallest_named"] == max(c["size"] for c in lag["counts"] if c["of"] == TRIALS and c["named"] == TRIALS
                                        and c["size"] <= lag["smallest_named"])
    page = (tmp_path / "page.html").read_text()
    assert "Sizes that are named" in page and "coil_lag and sensor_gain (AMBIGUOUS)" in page
    jobs.clear()
    assert "Each effect was hidden in this unit" in rig(*arguments).out and jobs == []


@pytest.mark.usefixtures("few_effects")
def test_nothing_is_claimed_of_a_unit_that_no_model_explains(explained: tuple[Runs, Answer]) -> None:
    runs, explain_answer = explained
    e = explain_answer.explanation
    worse = replace(e.base, ratio=dict.fromkeys(e.base.ratio, 5.0))
    unexplained = replace(explain_answer, explanation=replace(e, verdict="UNEXPLAINED", base=worse, ledger=(worse,)))
    assert "more than noise is left" in catch_refusal(describe_unit, runs, unexplained)
    far = replace(e.base.fit, x=e.base.fit.x + 9.0)  # a fit that left more than noise has bent these tolerances
    for ratio, is_listed in ((5.0, False), (1.0, True)):
        base = replace(e.base, fit=far, ratio=dict.fromkeys(e.base.ratio, ratio))
        assert bool(assess_explanation(replace(unexplained.explanation, base=base), 0).suspicious) == is_listed
