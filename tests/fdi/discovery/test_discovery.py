"""The statistics behind `rig explain`: noise, likelihood, nulls, marks, shapes, last fits, candidates."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from effect_files import SEARCHED, restored_catalogue
from effects_cases import LAWS
from noisy_traces import SHORT, record_plant
from scipy.signal import lfilter
from short_runs import HIDDEN, build_command

from fdi import thresholds
from fdi.discovery.explain import (
    Marks,
    compute_firmware_residual,
    decide_verdict,
    explain,
    find_marks,
    helps_explain,
    shows_effect,
)
from fdi.discovery.explain_runs import Answer, Candidate
from fdi.discovery.residual_pattern import Pattern, fit_curve, fit_wave, write_effect
from fdi.discovery.runs import read_runs
from fdi.discovery.search import (
    Hypothesis,
    Search,
    measure_repeating,
    scan_effects,
)
from fdi.estimation.fit import (
    Value,
    linearise,
    list_all_unknowns,
    silence_sensors,
)
from fdi.estimation.noise import fit_noise, measure_level
from fdi.estimation.replay import hold_inputs
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


def test_independent_noise_of_any_colour_does_not_repeat_and_physics_does() -> None:
    ratios = [measure_repeating(coloured(s)[None], [coloured(s + 500)[None]], [0.0])[0] for s in SEEDS]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.02) and max(ratios) < 1.08  # the gate
    physics = 1e-6 * np.sin(np.arange(13_500) / 200.0)
    found = measure_repeating((coloured(1) + physics)[None], [(coloured(2) + physics)[None]], [0.0])[0]
    assert found == pytest.approx(np.sqrt(1 + 0.5e-12 / 4e-12), abs=0.03)


def _recorded(changes: dict[str, float], seed: int = 0) -> Trace:
    t = np.arange(3000) * 1e-3
    com = 5e-3 * np.sign(np.sin(2 * np.pi * t))
    columns = simulate(Model().with_effects(LAWS).replace(changes), com, seed=seed)
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
    with restored_catalogue(*SEARCHED):
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
    write_effect(found, tmp_path / "found.py")
    assert len((tmp_path / "found.py").read_text().splitlines()) < 40
    assert load_effects(tmp_path / "found.py") == ["discovered"]
    start = CATALOGUE["discovered"].starts[-1]
    com = 3e-3 * np.sin(2 * np.pi * np.arange(300) * 1e-3)
    moved, still = (simulate(model, com, steps=20, fast=False).p12 for model in (Model().replace(start), Model()))
    assert np.abs(moved - still).max() > 2e4  # Pa, the sensor's noise


def test_a_scan_finds_a_frequency_from_a_line_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a supply that ripples, where the line that stands out is two turns over the test beside the ripple's."""
    ripple = {"supply_ripple.amplitude": 0.03, "supply_ripple.frequency": 36.64, "supply_ripple.phase": 0.4}
    search = Search(Model(), hold_inputs(record_plant(ripple)), [], ["supply_ripple"], 1)
    turn = 1.0 / (1e-3 * len(search.problem.trace))  # Hz
    beside = [{**ripple, "supply_ripple.frequency": 36.64 - 2.3 * turn, "supply_ripple.phase": phase}
              for phase in (0.0, 1.57, 3.14, 4.71)]
    monkeypatch.setattr("fdi.discovery.search.find_tones", lambda *_: beside)
    (found,) = scan_effects(search.problem, [search.fit_base().fit], ["supply_ripple"])
    values = {f.name: f.centre + f.scale * x for f, x in zip(found.free, found.x, strict=True)}
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
    assert [n.level for n in search.noise] == pytest.approx([2e-7, 2e3, 1e-7], rel=1e-9)


@pytest.fixture(scope="module")
def search() -> Search:
    """A run with a null bias, whose unknowns are the tolerances and this bias."""
    found = Search(load_model().replace(BIAS), hold_inputs(record_plant(BIAS, COMMAND)), [], [], 1)
    found.problem = replace(found.problem, bare=None)
    return found


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


def record_unit(changes: dict[str, float], seed: int) -> Trace:
    columns = simulate(Model().replace(changes), build_command(), None, seed, 200)
    return Trace.from_columns(columns._asdict(), 1e-3, {})


@pytest.fixture(scope="module")
def run() -> Trace:
    return record_unit(HIDDEN, 1)


def test_a_repeat_from_another_unit_is_a_note(run: Trace) -> None:
    runs = read_runs(Model(), run, [record_unit(HIDDEN | {"filter.clogging": 0.3}, 2)])
    assert len(runs.notes) == 1 and runs.notes[0].startswith("the repeats differ by more than the noise of the sensors")
    assert "XS by" in runs.notes[0] and "same unit" in runs.notes[0]


def test_a_true_repeat_needs_no_note_although_the_model_is_wrong(run: Trace) -> None:
    assert read_runs(Model(), run, [record_unit(HIDDEN, 2)]).notes == ()
    assert read_runs(Model(), run).notes == ()
