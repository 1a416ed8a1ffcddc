"""The statistics behind `rig explain`: noise, likelihood, nulls, marks, shapes, last fits, candidates."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from effect_files import restored_catalogue
from noisy_traces import SHORT, record_plant
from scipy.signal import lfilter
from scipy.stats import chi2
from short_runs import HIDDEN, build_command

from fdi import thresholds
from fdi.discovery.explain import (
    Marks,
    compute_firmware_residual,
    decide_verdict,
    explain,
    find_marks,
    measure_gain,
    shows_effect,
)
from fdi.discovery.explain_runs import Answer, Candidate, list_fitted_parameters
from fdi.discovery.residual_pattern import Pattern, fit_curve, fit_wave, write_effect
from fdi.discovery.runs import collect_runs
from fdi.discovery.search import (
    Hypothesis,
    Search,
    Sensitivity,
    compute_p_value,
    find_tones,
    measure_repeating,
    scan_effects,
)
from fdi.estimation.fit import (
    BLOCK,
    Fit,
    Free,
    Value,
    compute_misfit,
    compute_weights,
    linearise,
    list_all_unknowns,
    list_effect_unknowns,
    silence_sensors,
    turn_amplitudes_positive,
)
from fdi.estimation.noise import fit_noise, measure_level
from fdi.estimation.replay import hold_inputs
from fdi.thresholds import BLOCK_FITTED_SQUARE
from fdi.trace.trace import Trace
from plant import Model, load_model, simulate
from plant.effects import CATALOGUE, load_effects

SEEDS = range(20)


def coloured(seed: int, n: int = 13_500) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return lfilter([1.2e-6], [1.0, -0.8], rng.standard_normal(n))


@pytest.mark.parametrize("seed", SEEDS)
def test_coloured_noise_becomes_white(seed: int) -> None:
    noise = fit_noise(coloured(seed))
    white = noise.whiten(coloured(seed + 1000))
    assert noise.level == pytest.approx(2e-6, rel=0.05)  # 1.2e-6 / sqrt(1 - 0.8^2)
    assert white[50:].std() == pytest.approx(1.0, rel=0.05)
    assert abs(np.corrcoef(white[51:], white[50:-1])[0, 1]) < 0.04


def test_what_is_not_measured_counts_as_nothing_and_a_stop_that_came_later_is_no_noise() -> None:
    rows, white = np.arange(13_500), np.random.default_rng(0).normal(0.0, 1.0, 13_500)
    holed = np.where((rows >= 500) & (rows < 520), np.nan, coloured(0))
    whitened = fit_noise(holed).whiten(holed)
    assert np.isfinite(whitened).all() and (whitened[500:520] == 0.0).all()
    late = white + 50.0 * ((rows >= 3000) & (rows < 4000))
    assert (measure_level(late), fit_noise(late).level) == pytest.approx((1.0, 1.0), rel=0.05)


def test_the_likelihood_is_squares_where_fitted_and_logarithms_where_not() -> None:
    noise = np.random.default_rng(1).standard_normal((1, 2, 50 * BLOCK))
    assert compute_misfit(noise)[0] == pytest.approx((noise**2).sum())
    spoilt = noise.copy()
    spoilt[0, 0, :BLOCK] = 1e3
    expected = BLOCK_FITTED_SQUARE * BLOCK * (1 + np.log(1e6 / BLOCK_FITTED_SQUARE)) - (noise[0, 0, :BLOCK] ** 2).sum()
    assert compute_misfit(spoilt)[0] - compute_misfit(noise)[0] == pytest.approx(expected)


def test_the_weights_are_the_slope_of_the_likelihood() -> None:
    rng = np.random.default_rng(2)
    white = rng.standard_normal((2, 10 * BLOCK)) * np.repeat([[1.0, 5.0] * 5], BLOCK, axis=1)
    way, h = rng.standard_normal(white.shape), 1e-6
    slope = (compute_misfit((white + h * way)[None]) - compute_misfit((white - h * way)[None]))[0] / (2 * h)
    assert slope == pytest.approx(2 * (compute_weights(white) * white * way).sum(), rel=1e-5)


def test_independent_noise_of_any_colour_does_not_repeat_and_physics_does() -> None:
    ratios = [measure_repeating(coloured(s)[None], [coloured(s + 500)[None]], [0.0])[0] for s in SEEDS]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.02) and max(ratios) < 1.08  # the gate
    physics = 1e-6 * np.sin(np.arange(13_500) / 200.0)
    found = measure_repeating((coloured(1) + physics)[None], [(coloured(2) + physics)[None]], [0.0])[0]
    assert found == pytest.approx(np.sqrt(1 + 0.5e-12 / 4e-12), abs=0.03)


def test_the_p_value_is_that_of_the_best_of_all_candidates() -> None:
    independent = Sensitivity(tuple("abcdefghij"), np.eye(10), np.ones(10))
    for gain in (4.0, 6.0, 9.0):
        exact = 1.0 - (1.0 - 0.5 * chi2.sf(gain, 1)) ** 10  # each on its own side only
        assert compute_p_value(independent, gain) == pytest.approx(exact, rel=0.3)
    assert compute_p_value(independent, 60.0) < 1e-3


def _recorded(changes: dict[str, float], seed: int = 0) -> Trace:
    t = np.arange(3000) * 1e-3
    com = 5e-3 * np.sign(np.sin(2 * np.pi * t))
    columns = simulate(Model().replace(changes), com, seed=seed)
    return Trace.from_columns(columns._asdict(), 1e-3, {})


def test_the_firmware_leaves_its_mark_without_noise() -> None:
    model = Model()
    healthy, limited = hold_inputs(_recorded({})), hold_inputs(_recorded({"command_rate_limit.rate": 0.12}))
    assert np.nanmax(np.abs(compute_firmware_residual(model, healthy))) == 0.0
    plain, marks = find_marks(model, [healthy]), find_marks(model, [limited])
    assert (plain.controller, plain.prints, plain.step) == (0.0, (), 0.0)
    assert marks.controller > 100.0 and marks.is_firmware_different
    (found,) = marks.prints
    value, low, high = found.parameters["command_rate_limit.rate"]
    assert low <= 0.12 <= high or value == pytest.approx(0.12, rel=1e-6)


def test_a_converter_with_few_bits_leaves_a_comb() -> None:
    marks = find_marks(Model(), [hold_inputs(_recorded({"quantisation.lsb": 7.3e-6}))])
    (found,) = marks.prints
    assert found.parameters["quantisation.lsb"][0] == pytest.approx(7.3e-6, rel=1e-4) and not marks.is_recorder


def test_a_recorder_that_rounds_positions_is_no_effect() -> None:
    def record_rounded(changes: dict[str, float], seed: int) -> Trace:
        trace = record_plant(changes, SHORT, seed)
        return hold_inputs(trace.with_columns({"xj": 2e-6 * np.round(trace.xj / 2e-6)}))

    healthy = find_marks(Model(), [record_rounded({}, 3)])
    assert healthy.is_recorder and healthy.controller < 2.0 and not healthy.prints
    slow, again = (record_rounded({"sensor_lag.time": 1e-3}, seed) for seed in (1, 2))
    with restored_catalogue("sensor_lag", "coil_lag", "null_bias", "spool_friction"):
        found = explain(Model(), slow, [again])
    assert (found.verdict, found.effects) == ("EXPLAINED", ("sensor_lag",)) and found.marks.is_recorder


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
    found = Pattern("force", "N", 500.0, "position" if shape == "wave" else "speed", 0.9, at, 1e4 * at, at * 0 + 1.0,
                    (700.0, 2.5e-3, 0.3) if shape == "wave" else None, np.zeros(10), ("load", "x + {0}"))
    with restored_catalogue():
        write_effect(found, tmp_path / "found.py")
        assert len((tmp_path / "found.py").read_text().splitlines()) < 40
        assert load_effects(tmp_path / "found.py") == ["discovered"]
        start = CATALOGUE["discovered"].starts[-1]
        com = 3e-3 * np.sin(2 * np.pi * np.arange(1000) * 1e-3)
        moved = simulate(Model().replace(start), com).p12 - simulate(Model(), com).p12
        assert np.abs(moved).max() > 2e4  # Pa, the sensor's noise


@pytest.mark.parametrize("hertz", [11.4767, 99.6187])
def test_a_frequency_is_looked_for_where_a_line_stands_out(hertz: float) -> None:
    """Of a supply that ripples: a start is within a quarter turn over the test, though the misfit has other lines."""
    ripple = {"supply_ripple.amplitude": 0.03, "supply_ripple.frequency": hertz, "supply_ripple.phase": 0.4}
    search = Search(Model(), hold_inputs(record_plant(ripple)), [], ["supply_ripple"], 1)
    starts = find_tones(search.problem, search.fit_base().fit, "supply_ripple")
    assert min(abs(start["supply_ripple.frequency"] - hertz) for start in starts) < 0.25 / 13.5
    assert 1 < len({start["supply_ripple.frequency"] for start in starts}) < 10


@pytest.mark.parametrize("turns", [-2.3, 1.6])
def test_a_scan_finds_a_frequency_from_a_line_beside_it(turns: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a supply that ripples, where the line that stands out is some turns over the test beside the ripple's."""
    ripple = {"supply_ripple.amplitude": 0.03, "supply_ripple.frequency": 36.64, "supply_ripple.phase": 0.4}
    search = Search(Model(), hold_inputs(record_plant(ripple)), [], ["supply_ripple"], 1)
    turn = 1.0 / (1e-3 * len(search.problem.trace))  # Hz
    beside = [{**ripple, "supply_ripple.frequency": 36.64 + turns * turn, "supply_ripple.phase": phase}
              for phase in (0.0, 1.57, 3.14, 4.71)]
    monkeypatch.setattr("fdi.discovery.search.find_tones", lambda *_: beside)
    (found,) = scan_effects(search.problem, search.fit_base().fit, ["supply_ripple"])
    values = {f.name: f.centre + f.scale * x for f, x in zip(found.free, found.x, strict=True)}
    assert values["supply_ripple.frequency"] == pytest.approx(36.64, abs=0.3 * turn)


def test_a_sine_has_a_positive_amplitude() -> None:
    """Of the two descriptions of one ripple, and of phases a turn apart, one is reported; the replay is the same."""
    search = Search(Model(), hold_inputs(record_plant({}, SHORT)), [], ["supply_ripple"], 1)
    free = (*list_all_unknowns(Model()), *list_effect_unknowns(CATALOGUE["supply_ripple"], Model()))
    ripple = {"supply_ripple.amplitude": -0.03, "supply_ripple.frequency": 20.0, "supply_ripple.phase": 9.0}
    x = np.array([(ripple.get(f.name, f.centre) - f.centre) / f.scale for f in free])
    turned = turn_amplitudes_positive(free, x, CATALOGUE.values())
    values = {f.name: f.centre + f.scale * v for f, v in zip(free, turned, strict=True)}
    assert values["supply_ripple.amplitude"] == pytest.approx(0.03)
    assert abs(values["supply_ripple.phase"]) <= np.pi
    before, after = search.problem.compute_residuals(free, np.array([x, turned]))
    np.testing.assert_allclose(after, before, rtol=0.0, atol=1e-6 * np.abs(before).max())


def make_hypothesis(misfit: float, tolerance_cost: float, repeat_cost: float) -> Hypothesis:
    """A hypothesis, with a repeat, of which only the costs matter."""
    none = np.zeros((0, 0))
    fit = Fit((), np.zeros(0), misfit + tolerance_cost, misfit, none, none, none, none, True)
    return Hypothesis((), fit, {}, {}, repeat_cost, (none,))


def test_tolerances_nearer_to_a_healthy_unit_are_a_gain_and_luck_is_none() -> None:
    far = make_hypothesis(1000.0, 120.0, 1000.0)
    for costs, gain in (((1000.0, 2.0, 1000.0), 118.0), ((900.0, 120.0, 950.0), 100.0),
                        ((500.0, 120.0, 1000.0), 0.0)):  # the repeat does not show it
        assert measure_gain(far, make_hypothesis(*costs)) == pytest.approx(gain)


def test_with_more_noise_an_effect_is_found_from_a_fit_in_a_wrong_valley() -> None:
    """Where the tolerances of the fit before have ended does not matter: these fits begin at a healthy unit."""
    trace = hold_inputs(record_plant({"sensor_lag.time": 1e-3}, SHORT, seed=4))
    search = Search(Model(), trace, [], ["sensor_lag", "coil_lag"], 1)
    base = search.fit_base()
    wrong = search.judge_fit((), linearise(search.problem, base.fit.free, base.fit.x + 1.0))
    assert wrong.is_poor and not wrong.is_at_floor
    best = search.add_each_with_more_noise(wrong, [])[0]
    assert best.effects == ("sensor_lag",) and best.is_at_floor and not best.is_poor
    assert best.fit.values["sensor_lag.time"] == pytest.approx(1e-3, rel=0.1)


T = 1e-3 * np.arange(1000)
COMMAND = 5e-4 * np.sin(2.0 * np.pi * 2.0 * T) * (1.0 - np.exp(-5.0 * T))  # m
BIAS = {"null_bias.current": 1e-4}


def test_a_recording_without_noise_is_taken_to_have_some() -> None:
    """Else what solver and rounding leave would be all that is left to explain: of a simulation, by a second effect."""
    run = simulate(silence_sensors(Model()), SHORT)
    columns = {"com": SHORT, "xj": run.xj, "cor": run.cor, "p12": run.p12, "xs": run.xs}
    search = Search(Model(), hold_inputs(Trace.from_columns(columns, 1e-3, {})), [], ["supply_ripple"], 1)
    search.learn_noise(search.fit_base())
    assert [n.level for n in search.noise] == pytest.approx([2e-7, 2e3, 1e-7], rel=1e-9)


@pytest.fixture(scope="module")
def search() -> Search:
    """A run with a null bias, whose unknowns are the tolerances and this bias."""
    found = Search(load_model().replace(BIAS), hold_inputs(record_plant(BIAS, COMMAND)), [], [], 1)
    found.problem = replace(found.problem, bare=None)
    return found


def test_a_fit_far_from_a_healthy_unit_is_begun_again_and_one_that_leaves_noise_near_it_stays(search: Search) -> None:
    """The true bias, with the jack's mass and damping so many tolerances from nominal."""
    free = list_all_unknowns(search.model)
    far, near = (search.judge_fit(("null_bias",), linearise(search.problem, free, np.array(
        [tolerances if f.name in ("jack.mass", "jack.damping") else 0.0 for f in free]))) for tolerances in (4.9, 0.0))
    again = search.begin_again(far)
    assert far.is_far and not again.is_far and again.cost < far.cost
    assert again.fit.values["null_bias.current"] == pytest.approx(1e-4, rel=0.05)
    assert not near.is_far and not near.is_poor and search.begin_again(near) is near


def test_an_effect_counts_only_if_its_interval_leaves_out_the_off_value(search: Search) -> None:
    """Of a null bias of 100 uA: its own size does, a hundredth of its standard deviation does not."""
    free = list_all_unknowns(search.model)
    place = [f.name for f in free].index("null_bias.current")
    found = linearise(search.problem, free, np.zeros(len(free)))

    def move_bias(current: float) -> Hypothesis:
        x = np.where(np.arange(len(free)) == place, (current - free[place].centre) / free[place].scale, found.x)
        return search.judge_fit(("null_bias",), replace(found, x=x))

    small = 0.01 * found.spread("null_bias.current")
    assert [shows_effect(load_model(), move_bias(current)) for current in (1e-4, small)] == [True, False]


@pytest.mark.parametrize(("is_far", "verdict"), [(False, "EXPLAINED"), (True, "PARTLY")])
def test_an_explanation_that_needs_tolerances_of_no_healthy_unit_is_doubted(is_far: bool, verdict: str) -> None:
    """A lag of the pilot pressure, which is not in the catalogue, was called a coil lag with clogging, EXPLAINED."""
    base, best = make_judged((), 9000.0), make_judged(("coil_lag", "filter_clogging"), 1000.0, is_far=is_far)
    found = decide_verdict(base, [best], [best], True, Marks(1.0, 1e-6, ()), {"xj": 2e-6})
    assert found == (verdict, ("coil_lag", "filter_clogging"))


def make_judged(effects: tuple[str, ...], cost: float, at_floor: bool | None = None, is_far: bool = False) -> Any:
    """As far as `decide_verdict` looks at it; at the floor if it has effects, unless told."""
    return cast(Any, SimpleNamespace(effects=effects, cost=cost, repeat_cost=cost, tolerance_cost=10.0, others=(),
                                     is_at_floor=bool(effects) if at_floor is None else at_floor, is_far=is_far))


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


def test_the_page_shows_the_decision_procedure_of_the_code() -> None:
    stages = [line for line in str(import_module("fdi.discovery.explain").__doc__).splitlines() if line[:1] == "|"]
    table = "\n".join(stages).format(**vars(thresholds))
    assert len(stages) > 20 and table in (Path(__file__).parents[3] / "docs/explain.md").read_text()


def candidate(effect: str, *beside: str) -> Candidate:
    return Candidate(effect, beside, {f"{effect}.size": Value(1.0, 0.9, 1.1, "N")}, {}, {}, {}, 0.0, 0.0, "explains")


def test_a_pair_is_shown_once_with_the_sizes_of_both() -> None:
    both = (candidate("a", "b"), candidate("b", "a"), candidate("c", "a"), candidate("d"))
    shown = Answer(cast(Any, None), both, {}, (), (), (), ()).explanations
    assert [(c.effect, c.beside) for c in shown] == [("a", ("b",)), ("c", ("a",)), ("d", ())]
    assert set(shown[0].parameters) == {"a.size", "b.size"} and set(both[0].parameters) == {"a.size"}


def test_dynamic_friction_is_not_thought_possible_above_static_friction() -> None:
    """A fit that cannot tell it, 500 N give or take 8000, says so up to the static friction's own bound."""
    free = tuple(Free(f"jack.{kind}_friction", 500.0, 100.0, np.inf, 0.0, 1e5, 0.05) for kind in ("static", "dynamic"))
    none = np.empty((0, 0))
    fit = Fit(free, np.array([0.0, -0.1]), 0.0, 0.0, np.diag([0.01, 1600.0]), none, none, none)
    found = list_fitted_parameters("jack_friction", fit, Model())
    static, dynamic = found["jack.static_friction"], found["jack.dynamic_friction"]
    assert 500.0 < static.high < 600.0 and dynamic.value == 490.0
    assert dynamic.low == 0.0 and dynamic.high == static.high


def record_unit(changes: dict[str, float], seed: int) -> Trace:
    columns = simulate(Model().replace(changes), build_command(), None, seed, 200)
    return Trace.from_columns(columns._asdict(), 1e-3, {})


@pytest.fixture(scope="module")
def run() -> Trace:
    return record_unit(HIDDEN, 1)


def test_a_repeat_from_another_unit_is_a_note(run: Trace) -> None:
    runs = collect_runs(Model(), run, [record_unit(HIDDEN | {"filter.clogging": 0.3}, 2)])
    assert len(runs.notes) == 1 and runs.notes[0].startswith("the repeats differ by more than the noise of the sensors")
    assert "XS by" in runs.notes[0] and "same unit" in runs.notes[0]


def test_a_true_repeat_needs_no_note_although_the_model_is_wrong(run: Trace) -> None:
    assert collect_runs(Model(), run, [record_unit(HIDDEN, 2)]).notes == ()
    assert collect_runs(Model(), run).notes == ()
