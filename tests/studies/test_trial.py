"""The blind trial: its simulator against an independent one, its cases, its counting; sizes that can be detected."""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest
from places import SHARED

from fdi.discovery.detectable import find_hidden_effects
from fdi.estimation.fit import Problem, complete_model, fit_unknowns, list_all_unknowns, silence_readings
from fdi.estimation.noise import white_noise
from fdi.estimation.replay import hold_inputs
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.effects import CATALOGUE
from plant.lanes import Lanes
from studies.hidden_effects import command, hidden
from studies.hidden_effects.truth import SYMBOLS, has_compiler, nominal_symbols, parameter_names, simulate_truth

PRACTICE = SHARED / "practice"
EXACT: dict[str, dict[str, float]] = {
    "01": {"Kintas": 0.3}, "02": {"bias": 0.03 * 8e-3}, "06": {"aero": 5.4e5},
    "09": {"cog": 2750.0, "cog_l": 2.5e-3}, "10": {"FSS": 33.0, "FDS": 22.0, "Kintas": 0.21},
}
pytestmark = pytest.mark.skipif(not has_compiler(), reason="no gcc: the trial's simulator cannot be built")
shared = pytest.mark.skipif(not PRACTICE.exists(), reason="no ../shared: no traces of an independent simulator")


def rms(x: np.ndarray) -> float:
    return float(np.sqrt((x**2).mean()))


def read(path: Path) -> dict[str, np.ndarray]:
    with gzip.open(path, "rt") as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, dtype=float).T, strict=True))


@shared
@pytest.mark.parametrize(("case", "name"), [*((case, "est") for case in EXACT), ("09", "holdout")])
def test_the_simulator_leaves_sensor_noise_of_an_independent_trace(case: str, name: str) -> None:
    trace = read(PRACTICE / case / f"{name}.csv.gz")
    run = simulate_truth(trace["com"], EXACT[case], load=trace["load"], cor=trace["cor"])
    assert rms(run.xj - trace["xj"]) == pytest.approx(2e-6, rel=0.05)
    assert rms(run.p12 - trace["p12"]) == pytest.approx(2e4, rel=0.03)
    assert rms(run.xs - trace["xs"]) == pytest.approx(1e-6, rel=0.03)


@shared
def test_commands_and_loads_are_those_of_the_practice_traces() -> None:
    trace = read(PRACTICE / "04/est.csv.gz")
    assert np.abs(command.preflight_command() - trace["com"]).max() < 1e-10
    for name in ("est", "holdout"):
        load = read(PRACTICE / f"04/{name}.csv.gz")["load"]
        assert (command.known_load_profile(len(load), 6000.0) == load).all()


def test_every_effect_of_the_catalogue_is_hidden_in_some_case() -> None:
    assert set(hidden.CATALOGUE) == {name for name, effect in CATALOGUE.items() if not effect.disturbance}
    assert len(hidden.OUTSIDE) >= 8 and not set(hidden.OUTSIDE) & set(CATALOGUE)


def plants(effect: hidden.Hidden) -> dict[str, float]:
    """The plant's names for what is hidden."""
    entry, changes = CATALOGUE[effect.name], effect.changes
    if entry.base:
        return {SYMBOLS[symbol]: value for symbol, value in changes.items() if symbol in SYMBOLS}
    more = {"stribeck": {"stribeck.speed": changes.get("stribeck_v", 0.0)},
            "supply_ripple": {"supply_ripple.frequency": changes.get("ripple_hz", 0.0)},
            "structural_resonance": {"structural_resonance.frequency": 35.0,
                                     "structural_resonance.damping_ratio": 0.02}}
    return {entry.fitted[0]: effect.value} | more.get(effect.name, {})


def test_the_plants_effects_are_what_the_table_says_as_written_twice() -> None:
    """Both replay the same current with the same size hidden; what is left is far below the sensors' noise."""
    com = np.concatenate([command.preflight_command()[500:1700], command.preflight_command()[11_000:13_000]])
    load = command.known_load_profile(len(com), 6000.0)
    drive = simulate_truth(com, {}, load=load).cor
    # of a signed effect one seed gives the sign -, one +
    drawn = [hidden.sample_hidden_effect(name, nominal_symbols(), np.random.default_rng(seed), 0.7, 0.7)
             for seed in (1, 2) for name, law in hidden.CATALOGUE.items() if seed == 1 or law.signed]
    drawn = [effect for effect in drawn if effect.name != "command_rate_limit"]  # not in the plant
    model = complete_model(Model())  # the kernels of `rig explain`
    names = sorted({name for effect in drawn for name in plants(effect)})
    rows = [[plants(effect).get(name, model[name]) for name in names] for effect in drawn]
    ours = Lanes(model, names, 100).replay(np.array(rows), drive, load)
    for effect, mine in zip(drawn, ours, strict=True):
        known = set(parameter_names()) - {"bristle_v"}
        changes = {key: value for key, value in effect.changes.items() if key in known}
        truth = simulate_truth(com, changes, load=load, cor=drive)
        columns = zip(mine.T, (truth.xj, truth.p12, truth.xs), (2e-6, 2e4, 1e-6), strict=True)
        left = [rms(x - y) / floor for x, y, floor in columns]
        assert max(left) < (1.0 if effect.name == "compressibility" else 0.5), (effect.name, effect.size, left)


def test_tolerances_make_up_for_an_offset_of_any_usual_size_and_not_for_a_load() -> None:
    """A load shows by its pressure; the loop moves the ram by what its transducer is off."""
    t = np.arange(4000) * 1e-3
    com = np.where(t < 2.0, 4e-3 * np.sign(np.sin(2 * np.pi * t)), 2e-3 * np.sin(2 * np.pi * 1.5 * t))
    model, effects = Model(), ("constant_load", "filter_clogging", "sensor_offset")
    trace = hold_inputs(Trace.from_columns(simulate(model, com, seed=3)._asdict(), 1e-3, {}))
    noise = tuple(white_noise(x) for x in (2e-6, 2e4, 1e-6))
    problem = Problem(complete_model(model), trace, noise, bare=silence_readings(model), workers=2)
    fit = fit_unknowns(problem, list_all_unknowns(model), rounds=3)
    assert [(h.effect, h.usual) for h in find_hidden_effects(problem, fit, effects)] == [("sensor_offset", 2e-4)]
