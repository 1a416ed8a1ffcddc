"""`rig identify`: an actuator of twice the size, what its runs do not show, and inputs that cannot be used."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import catch_refusal
from rig_command import answer, refuse, rig, write_file
from short_runs import simulate_trace

from fdi.discovery.update_model import read_provenance
from fdi.estimation import long_recordings, sensor_floors, start_fit
from fdi.identification import global_fit
from fdi.identification.global_fit import scale_values
from fdi.identification.identify import (
    Identification,
    decide_verdict,
    identify_model,
    list_unknowns,
    make_problem,
    parse_free_parameters,
    read_free_parameters,
    read_identification_runs,
    write_identified_model,
)
from fdi.report.identify_report import describe_identification
from fdi.trace import Trace
from plant import Segment, build_profile, load_model
from plant.declare import Chirp, Hold, Ramp, Step
from studies.hidden_effects.truth import SYMBOLS, has_compiler, simulate_truth
from studies.identification import sample_actuator

pytestmark = pytest.mark.skipif(not has_compiler(), reason="no gcc for the independent simulator")

FREE = {"valve": {"flow_gain": 6.0}, "supply": {"pressure": 3.0}, "jack": {"area": 5.0, "mass": 8.0, "travel": 6.0}}
SIZED = ("AJ", "XJM", "GQ", "PSR", "MJ", "GAP")  # what differs from nominal in these tests, beside no scatter
MM = 1e-3


def sample_plant() -> dict[str, float]:
    actuator = sample_actuator(5, scatter=0.0)
    return {symbol: actuator[symbol] for symbol in SIZED}


def measure(com: np.ndarray, load: np.ndarray, seed: int, name: str) -> Trace:
    rng, n = np.random.default_rng(seed), len(com)
    run = simulate_truth(com, sample_plant(), 2e-6 * rng.standard_normal(n), load)
    noise = {"p12": 2e4 * rng.standard_normal(n), "xs": 1e-6 * rng.standard_normal(n)}
    columns = run._asdict() | {"p12": run.p12 + noise["p12"], "xs": run.xs + noise["xs"]}
    return Trace.from_columns(columns, 1e-3, {"source": name})


@pytest.fixture(scope="module")
def runs() -> tuple[Trace, Trace, Trace]:
    """Without load; against both end stops with a known load; held out."""
    t = np.arange(2500) * 1e-3
    wave = np.where(t < 0.3, 0.0, 4 * MM * np.sin(2 * np.pi * (t + t**2)))
    stop = 1.05 * sample_plant()["XJM"]
    stops = np.repeat([0.0, stop, -stop, 0.0], [200, 1400, 2000, 400])
    load = np.where((np.arange(4000) > 600) & (np.arange(4000) < 2600), 6e3, 0.0)
    last = np.repeat([0.0, 3 * MM, -5 * MM, 1 * MM], [200, 600, 600, 600])
    return (measure(wave, np.zeros(2500), 1, "wave"), measure(stops, load, 2, "stops"),
            measure(last, np.where(np.arange(2000) > 900, -4e3, 0.0), 3, "held"))


def identify(fitted_runs: list[Trace], held_out_runs: list[Trace], free: object = FREE, plant: str = "eha"
             ) -> Identification:
    """Of a plant; `free`: what a data sheet says, None for what the plant declares."""
    model = load_model(plant)
    ranges = parse_free_parameters(free, model, "test") if free else read_free_parameters(model, None)
    runs = read_identification_runs(model, ranges, fitted_runs, held_out_runs)
    return identify_model(runs.model, ranges, runs.fitted, runs.held_out, runs.sources)


@pytest.fixture(scope="module")
def identification(runs: tuple[Trace, Trace, Trace]) -> Identification:
    return identify(list(runs[:2]), [runs[2]])


def test_actuator_of_twice_the_size_is_identified(identification: Identification) -> None:
    truth = {SYMBOLS[symbol]: value for symbol, value in sample_plant().items()}
    assert identification.verdict == "IDENTIFIED", identification.reason
    assert all(e.low <= truth[e.name] <= e.high < e.low + 0.1 * e.value for e in identification.estimates)
    assert max(e.ratio for e in identification.holdouts) <= 1.1
    assert max(e.before["p12"] / e.floor["p12"] for e in identification.holdouts) > 5.0
    assert identification.model["controller.proportional_gain"] == pytest.approx(sample_plant()["GAP"], rel=1e-5)


def test_stops_at_the_wrong_moment_in_a_fitted_run_leave_doubt(identification: Identification) -> None:
    first, *others = identification.errors
    late = first._replace(decided={s: 2.5 * first.floor[s] for s in first.after})
    verdict, reason = decide_verdict(identification.estimates, [late, *others])
    assert verdict == "PARTLY" and "2.5 noise floors" in reason and first.source.file in reason
    assert "wrong moment" in describe_identification(replace(identification, verdict=verdict, reason=reason))
    holdout = others[-1]._replace(after={s: 2.5 * floor for s, floor in others[-1].floor.items()}, undecided=0.03)
    assert holdout.is_held_out and decide_verdict(
        identification.estimates, [first, *others[:-1], holdout])[0] == "IDENTIFIED"
    assert "in the 97.0 % of the run that can be predicted" in describe_identification(
        replace(identification, errors=(holdout,)))


def test_range_that_is_too_narrow_gives_no_model_file(runs: tuple[Trace, Trace, Trace], here: Path,
                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(global_fit, "SEARCHES", 0)  # no other valley is deeper, and looking for one takes ten seconds
    runs[1].write_csv(here / "stops.csv")
    (here / "sheet.toml").write_text("[identify.jack]\narea = 1.3\ntravel = 6\n[identify.valve]\nflow_gain = 6\n"
                                         "[identify.supply]\npressure = 3\n")
    identification = answer("identify", "stops.csv", "--model", "sheet.toml", status=1)
    area = identification["parameters"]["jack.area"]
    assert identification["verdict"] == "UNEXPLAINED" and "noise floors" in identification["reason"]
    assert area["identifiable"] and area["high"] == area["range"][1] == pytest.approx(area["value"], rel=0.02)
    assert [identification["parameters"][name]["at_bound"]
            for name in ("jack.area", "jack.travel", "supply.pressure")] == [True, False, False]
    assert not Path("identified.toml").exists() and Path("identified.html").exists()
    result = rig("identify", "stops.csv", "--model", "sheet.toml", "--out", "mine.toml")
    text = " ".join(result.out.split())
    assert result.status == 1 and "jack.area: the interval reaches the end of the data sheet's range" in text
    assert "mine.toml was written because of --out; its parameters do not explain the runs" in text


def test_model_file_is_read_by_every_command(identification: Identification, runs: tuple[Trace, Trace, Trace],
                                             tmp_path: Path) -> None:
    path, holdout = tmp_path / "mine.toml", tmp_path / "held.csv"
    model = replace(identification.model, name="mine")
    write_identified_model(replace(identification, model=model), path, "rig identify", "2026-01-01")
    assert load_model(path) == model and load_model(path).nominal["jack.area"] == model["jack.area"]
    origin = read_provenance(path).identification
    assert (origin["runs"], origin["holdouts"]) == (["wave", "stops"], ["held"])
    assert "95 %" in path.read_text()
    runs[2].write_csv(holdout)
    assert answer("compare", holdout, "--model", path)["verdict"] == "WITHIN_FLOOR"
    diagnosis = answer("fdi", holdout, "--model", path)
    assert diagnosis["verdict"] == "ACCEPTABLE" and any("no bands" in note for note in diagnosis["notes"])


def test_area_needs_a_known_load(runs: tuple[Trace, Trace, Trace]) -> None:
    identification = identify([runs[0]], [], {"jack": {"area": 5.0, "mass": 8.0, "static_friction": 8.0,
                                                       "dynamic_friction": 8.0, "damping": 8.0, "leakage": 10.0},
                                              "valve": {"flow_gain": 6.0}})
    area = next(e for e in identification.estimates if e.name == "jack.area")
    assert identification.verdict in ("PARTLY", "CANNOT_TELL")
    assert not area.is_identifiable and area.high / area.low > 3.0
    assert {a.parameter: a.experiment for a in identification.advice}["jack.area"] == "load"


@pytest.mark.parametrize(("signals", "is_known"), [(["xj"], False), (["xj", "p12"], True)])
def test_a_larger_piston_at_a_lower_pressure_moves_alike(runs: tuple[Trace, Trace, Trace], signals: list[str],
                                                         is_known: bool) -> None:
    """Without P12 not even a known load shows the area; slopes would know it by the roughness of the misfit alone."""
    model = load_model()
    ranges = parse_free_parameters({"valve": {"flow_gain": 6.0}, "jack": {"area": 5.0, "leakage": 10.0}}, model, "test")
    own = read_identification_runs(model, ranges, [runs[1]], [], signals)
    floor = {name: level.value for name, level in sensor_floors(own.fitted[0], model).items()}
    unit = model.replace({SYMBOLS[symbol]: value for symbol, value in sample_plant().items()})
    problem, free = make_problem(unit, own.fitted, floor, 1), list_unknowns(model, ranges)
    fit = start_fit(free, scale_values(free, unit.values))
    area = [f.name for f in free].index("jack.area")
    assert bool(problem.widen_covariance(fit)[area, area] == fit.covariance[area, area]) == is_known


def test_long_run_is_fitted_by_parts_and_an_end_stop_that_it_never_met_is_not_at_a_bound(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(global_fit, "SEARCHES", 0)  # the other parameters are off: no valley is deeper
    monkeypatch.setattr(long_recordings, "LONGEST_WHOLE", 6.0)
    monkeypatch.setattr(long_recordings, "PIECE", 1.0)
    t = np.arange(8000) * 1e-3
    com = np.where(t < 2.0, 0.0, 4 * MM * np.sin(2 * np.pi * t))
    run = measure(com, np.zeros(len(com)), 6, "long")
    identification = identify([run], [], {"valve": {"flow_gain": 6.0}, "jack": {"travel": [0.012, 0.05]}})
    assert any("long: fitted to" in note and "of 8 s" in note for note in identification.notes)
    assert len(identification.residuals[0][1][0]) == len(run)  # judged on all of it
    flow, travel = identification.estimates
    assert [(e.is_identifiable, e.is_at_bound) for e in (flow, travel)] == [(True, False), (False, False)]
    assert travel.low < 0.013 and travel.high == 0.05


LONG = Chirp(amplitude=2e-3, f0=1.0, f1=15.0, fade=15.0, time=3.0)


def record_motor(unit: dict[str, float], *more: Segment, seed: int = 1) -> Trace:
    """An `ema` that rests, and moves by steps, a ramp and `more`."""
    command = build_profile([Hold(time=0.5), Step(to=0.01, time=1.0), Ramp(to=-0.005, time=1.0), *more,
                             Step(to=0.0, time=1.0)], rate=1000.0).command
    return simulate_trace(load_model("ema").replace(unit), command, seed=seed)


def test_motor_that_rests_is_identified() -> None:
    """Dry friction at rest has any value, so rests are not compared; of short steps the beginnings show the mass."""
    unit = {"surface.mass": 300.0, "surface.damping": 3500.0, "surface.friction": 180.0}
    identification = identify([record_motor(unit, Hold(time=1.0))], [], None, "ema")
    assert identification.verdict in ("IDENTIFIED", "PARTLY") and any(
        "at rest" in note for note in identification.notes)
    assert dict.fromkeys(unit, True) == {
        e.name: e.low <= unit[e.name] <= e.high for e in identification.estimates if e.name in unit}


def test_what_no_known_force_shows_has_a_wide_interval() -> None:
    """All forces of a motor scale together, and no law of similarity is declared: only tolerances tie them."""
    unit = load_model("ema").replace({"surface.friction": 130.0})
    table = {"motor": {"torque_constant": 2.0, "inertia": 2.0}, "screw": {"compliance": 2.0},
             "surface": {"mass": 2.0, "damping": 2.0, "friction": 2.0}}
    identification = identify([record_motor({"surface.friction": 130.0}, LONG, seed=3)], [], table, "ema")
    assert identification.verdict in ("PARTLY", "IDENTIFIED")
    assert all(e.low < unit[e.name] < e.high and e.share > 0.05 for e in identification.estimates)


def test_run_at_rest_identifies_nothing() -> None:
    identification = identify([measure(np.zeros(800), np.zeros(800), 4, "still")], [])
    assert (identification.verdict, identification.model) == (
        "CANNOT_TELL", load_model()) and "at rest" in identification.reason
    assert not any(e.is_identifiable for e in identification.estimates)
    assert {a.parameter for a in identification.advice} == {e.name for e in identification.estimates}


@pytest.mark.parametrize(("table", "field"), [
    ({"jack": {"area": 0.5}}, "identify.jack.area"), ({"jack": {"area": [2.0, 1.0]}}, "identify.jack.area"),
    ({"jack": {"area": "wide"}}, "identify.jack.area"), ({"filter": {"clogging": 3}}, "identify.filter.clogging"),
    ({"jack": 4}, "jack"), ({"jack": {"aera": 4}}, "jack.aera"), ({}, "identify"), (4, "identify"),
    ({"jack": {"area": [0.0, 1.0]}}, "identify.jack.area"), ({"null_bias": {"current": [-1e-4, 1e-4]}}, "null_bias")])
def test_ranges_that_cannot_be_are_refused(table: object, field: str) -> None:
    assert field in catch_refusal(parse_free_parameters, table, load_model(), "m.toml")


def test_ranges_of_a_model_file(tmp_path: Path) -> None:
    path = write_file(tmp_path / "sheet.toml",
                      "[jack]\narea = 3e-3\n[identify.jack]\narea = 1.5\nleakage = [1e-13, 1e-11]\n")
    model = load_model(path)
    area, leakage = read_free_parameters(model, path)
    assert (area.centre, area.low, area.high) == pytest.approx((3e-3, 2e-3, 4.5e-3))
    assert (leakage.low, leakage.high) == (1e-13, 1e-11)
    assert len(read_free_parameters(load_model(), None)) > 10


@pytest.mark.parametrize(("fitted_count", "held_out_count", "signals", "option"), [
    (1, 1, None, "--holdout"), (2, 0, None, "other runs"), (1, 0, ["speed"], "--signals")])  # so many times a run
def test_runs_that_cannot_be_used(runs: tuple[Trace, Trace, Trace], fitted_count: int, held_out_count: int,
                                  signals: list[str] | None, option: str, tmp_path: Path) -> None:
    ranges = parse_free_parameters(FREE, load_model(), "test")
    assert option in catch_refusal(read_identification_runs, load_model(), ranges, [runs[0]] * fitted_count,
                                   [runs[0]] * held_out_count, signals)
    assert "none.csv" in refuse("identify", tmp_path / "none.csv")
