"""Parameters, model files and commands as data: what is refused and how it is said, and what comes back as it went."""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from places import SHARED
from refusals import catch_refusal

import plant
from plant import (
    Csv,
    Hold,
    InputError,
    Model,
    Points,
    Segment,
    build_profile,
    find_quantity,
    load_model,
    load_nominal_values,
    resample_on_cycles,
    simulate,
)
from plant.parameters import GROUPS
from plant.segments import Chirp, Multisine, Ramp, Sine, Step

NAMES = list(load_nominal_values())


@pytest.mark.parametrize(("name", "value", "message"), [
    ("spool.static_friction", -1, "from 0 to 1e+06 N, not -1"),
    ("jack.mass", 0, "from 0.01 to"),
    ("supply.pressure", 1e-300, "from 100000 to 1e+08 Pa, not 1e-300"),
    ("supply.pressure", 201, "from 100000 to 1e+08 Pa"),  # bar
    ("controller.current_limit", 1e300, "to 20 A"),
    ("constant_load.force", -1e7, "from -1e+06 to"),
    ("filter.clogging", 1.0, "below 1, not 1"),
    ("filter.clogging", -0.1, "from 0 "),
    ("filter.law", "cubic", "one of sqrt, linear, pressure, not 'cubic'"),
    ("filter.law", 0.7, "one of sqrt, linear, pressure, not 0.7"),
    ("valve.flow_gain", "plenty", "not 'plenty'"),
    ("valve.flow_gain", "nan", "not nan"),
    ("valve.flow_gain", float("nan"), "not nan"),
    ("valve.flow_gain", float("inf"), "not inf"),
    ("null_bias.current", float("-inf"), "from -20 to 20 A, not -inf"),
    pytest.param("valve.flow_gain", 10**400, "not 1000", id="400 digits"),
    ("valve.flow_gain", [1 << 20000], "not a huge value"),
    ("valve.flow_gain", True, "not True"),
    ("valve.flow_gain", None, "not None"),
    ("valve.flow_gain", [0.3], r"not [0.3]"),
    ("controller.period", 1e-6, "from 0.0001 to"),
    ("spool.static_fricton", 3, "did you mean static_friction?"),
    ("spol.static_friction", 3, "did you mean spool?"),
    ("nothing.at_all", 3, "a known group"),
    ("spool", 3, "spool"),
    ("", 3, "a known group"),
    ("sensor_lag.time", 1.0, "to 0.1 s"),
])
def test_refused_by_name(name: str, value: object, message: str) -> None:
    text = catch_refusal(Model().replace, {name: value})
    assert message in text and text.startswith(f"--set: {name}: expected" if name else "--set: expected")


@pytest.mark.parametrize("body", ["spool", "jack"])
def test_contradictions_are_refused(body: str) -> None:
    text = catch_refusal(Model().replace, {f"{body}.static_friction": 10.0, f"{body}.dynamic_friction": 11.0})
    assert f"{body}.dynamic_friction" in text and "at most" in text
    # the nominal dynamic level stays
    assert "dynamic_friction" in catch_refusal(Model().replace, {f"{body}.static_friction": 0.0})
    Model().replace({f"{body}.static_friction": 10.0, f"{body}.dynamic_friction": 10.0})


@given(st.sampled_from(NAMES) | st.text(max_size=30), st.one_of(
    st.floats(), st.integers(), st.text(max_size=8), st.none(), st.booleans(), st.lists(st.floats(), max_size=2)))
@settings(max_examples=60, deadline=None)
def test_whatever_is_set_is_taken_or_refused_in_one_line(name: str, value: object) -> None:
    try:
        model = Model().replace({name: value})
    except InputError as error:
        assert name in str(error)
    else:
        assert np.isfinite(model[name]) and not find_quantity(name).refuses(model[name])


ENDS = {name: (find_quantity(name).low, find_quantity(name).high) for name in NAMES
        if not name.startswith("filter") and name != "controller.period"}
ALONE = [{name: end} for name, ends in ENDS.items() for end in ends]
TOGETHER = [{name: ends[pick] for (name, ends), pick in zip(ENDS.items(), picks, strict=True)}
            for picks in np.random.default_rng(0).integers(2, size=(40, len(ENDS)))]


@pytest.mark.parametrize("corners", [ALONE, TOGETHER], ids=["one parameter", "all parameters"])
def test_every_corner_of_the_ranges_has_a_number(corners: list[dict[str, float]]) -> None:
    """The plant may behave oddly there, but not lose its numbers."""
    command, load = np.r_[np.zeros(5), np.full(60, 5e-3)], np.full(65, 1e6)
    for values in corners:
        for body in ("spool", "jack"):  # no contradiction
            static, dynamic = f"{body}.static_friction", f"{body}.dynamic_friction"
            both = {name: values.get(name, load_nominal_values()[name]) for name in (static, dynamic)}
            values |= {static: max(both.values()), dynamic: min(both.values())}
        run = simulate(Model().replace(values), command, load)
        assert all(np.isfinite(column).all() for column in run), values


def test_words_numbers_and_texts_are_accepted_and_give_a_new_model() -> None:
    """Naming an effect's parameter gives the model that effect."""
    base = Model()
    model = base.replace({"filter.law": "linear", "spool.static_friction": "35", "sensor_lag.time": 1e-3})
    assert (model["filter.law"], model["spool.static_friction"], model.effects) == (1.0, 35.0, ("sensor_lag",))
    assert set(model.list_changes()) == {"filter.law", "spool.static_friction", "sensor_lag.time"}
    assert base == Model() != model and base.effects == ()


def test_the_nominal_file_is_complete_and_is_that_of_the_issue() -> None:
    assert list(load_nominal_values()) == [f"{group}.{field}" for group, cls in GROUPS.items() for field in cls._fields]
    given_ = SHARED / "nominal.toml"
    if not given_.exists():
        pytest.skip("no ../shared to compare with")
    ours = tomllib.loads((Path(plant.__file__).parent / "models" / "nominal.toml").read_text())
    assert ours["filter"].pop("law") == "sqrt"  # the one that is ours alone
    for group, fields in ours.pop("identify").items():  # what rig identify fits; no value of the plant
        assert set(fields) <= set(ours[group]), group
    assert ours == tomllib.loads(given_.read_text())


CHANGES = {
    "spool.static_friction": st.floats(3.5, 500.0), "jack.mass": st.floats(1.0, 1e4),
    "filter.clogging": st.floats(0, 0.9), "jack.leakage": st.floats(0, 1e-9),
    "filter.law": st.sampled_from(["sqrt", "linear", "pressure"]), "null_bias.current": st.floats(-1e-3, 1e-3),
    "sensor_lag.time": st.floats(0, 0.05), "spool_overlap.overlap": st.floats(0, 1e-4),
}


@given(st.fixed_dictionaries({}, optional=CHANGES), st.text(st.characters(codec="utf-8"), min_size=1, max_size=12))
@settings(max_examples=40, deadline=None)
def test_model_file_round_trip(tmp_path_factory: pytest.TempPathFactory, changes: dict[str, object], name: str) -> None:
    path, model = tmp_path_factory.getbasetemp() / "model.toml", Model().replace(changes)
    path.write_text(Model(name, model.values, model.effects).to_toml(), encoding="utf-8", newline="")
    back = load_model(path)
    assert (back.name, back.effects, dict(back.values)) == (name, model.effects, dict(model.values))


@pytest.mark.parametrize(("text", "message"), [
    ("[spool\n", "TOML"),
    pytest.param(f"[spool]\nmass = {'9' * 5000}", "at most 4300 digits", id="5000 digits"),
    ("[spool]\nstatic_friction = nan", "spool.static_friction"),
    ("[spool]\nstatic_fricton = 3", "did you mean static_friction?"),
    ("[spol]\nstatic_friction = 3", "did you mean spool?"),
    ("spool = 3", "a table [spool]"),
    ("effects = ['sensor_leg']", "effects"),
    ("effects = 'sensor_lag'", "effects"),
    ("effects = [3]", "effects"),
    ("effects = [[1]]", "effects"),
    ("name = 3", "name"),
    ("[jack]\nstatic_friction = 1.0", "jack.dynamic_friction"),
])
def test_a_bad_model_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    line = catch_refusal(load_model, path)
    assert message in line and str(path) in line


@pytest.mark.parametrize(("command", "load"), [([], None), ([[0.0]], None), ([0.0, 0.0], [1.0])])
def test_a_command_of_the_wrong_shape_is_refused(command: list[float], load: list[float] | None) -> None:
    force = None if load is None else np.array(load)
    assert "one demand and one load a cycle" in catch_refusal(simulate, Model(), np.array(command), force)


PREFLIGHT = (
    Hold(time=0.5), Step(to=5e-3, time=1.0), Step(to=0.0, time=1.0), Step(to=1e-3, time=0.75), Step(to=0.0, time=0.75),
    Ramp(to=1e-3, time=2.0), Hold(time=0.5), Ramp(to=0.0, time=2.0), Hold(time=0.5),
    Sine(amplitude=3e-3, frequency=1.0, time=2.0), Chirp(amplitude=1e-3, f0=1.0, f1=20.0, fade=20.0, time=2.0),
    Hold(time=0.5),
)
ONE_OF_EACH: tuple[Segment, ...] = (
    Hold(time=0.1), Step(to=1e-3, time=0.1), Ramp(to=-1e-3, time=0.1), Sine(amplitude=1e-3, frequency=3.0, time=0.1),
    Chirp(amplitude=1e-3, f0=1.0, f1=9.0, time=0.1), Multisine(amplitude=1e-3, frequencies=(1.0, 7.0), time=0.1),
    Points(points=((0.05, 1e-3), (0.1, 0.0))), Csv(file="c.csv", values=(0.0, 1e-3, 2e-3)),
)


def test_preflight_follows_the_formulas_of_physics_section_4() -> None:
    command, sections, end = build_profile(PREFLIGHT)
    t = np.arange(2000) / 1000
    chirp = 1e-3 * np.sin(2 * np.pi * (t + 4.75 * t**2)) * (1 - np.exp(-20 * t))
    np.testing.assert_allclose(command[11_000:13_000], chirp, atol=1e-16)
    np.testing.assert_allclose(command[4000:6000], 0.5e-3 * t, atol=1e-18)
    assert (command[[499, 500, 1499, 1500, 2500, 3250]] == [0, 5e-3, 5e-3, 0, 1e-3, 0]).all()
    assert sections[1] == ("step_2", "step", 500, 1500) and sections[-1].stop == len(command) == 13_500
    assert end == 0.0 and (command[13_000:] == 0).all()  # whole periods end exactly where they began


@given(cycle_us=st.integers(100, 100_000), cycles=st.lists(st.integers(1, 300), min_size=1, max_size=5))
def test_a_profile_is_as_long_as_its_segments_at_any_rate(cycle_us: int, cycles: list[int]) -> None:
    rate = 1e9 / (1000 * cycle_us)
    segments = [Ramp(to=float(k % 7) / 7, time=n * cycle_us / 1e6) for k, n in enumerate(cycles)]
    command, sections, end = build_profile(segments, 0.5, rate)
    assert [section.stop - section.start for section in sections] == cycles
    assert len(command) == sum(cycles) and sections[-1].stop == len(command)
    assert command[0] == 0.5 and abs(end - (len(cycles) - 1) % 7 / 7) < 1e-12


@pytest.mark.parametrize("rate", [2000.0, 500.0, 200.0, 100.0])
@pytest.mark.parametrize("segment", ONE_OF_EACH, ids=lambda s: s.kind)
def test_a_demand_is_the_same_function_of_time_at_any_rate(segment: Segment, rate: float) -> None:
    if isinstance(segment, Csv):
        segment = Csv(file="c.csv", values=tuple(np.arange(100) * 1e-5))
    fine, coarse = (build_profile([segment], 2e-3, most) for most in (max(rate, 1000.0), min(rate, 1000.0)))
    every = round(max(rate, 1000.0) / min(rate, 1000.0))
    np.testing.assert_allclose(coarse.command, fine.command[::every], rtol=1e-12, atol=1e-17)
    assert abs(coarse.end - fine.end) < 1e-15


@pytest.mark.parametrize("kind", ["hold", "ramp", "sine", "chirp", "multisine", "points"])
def test_a_segment_starts_from_the_last_demand(kind: str) -> None:
    segment = next(s for s in ONE_OF_EACH if s.kind == kind)
    assert build_profile([segment], start=7e-3).command[0] == 7e-3
    after_ramp = build_profile([Ramp(to=2e-3, time=0.01), replace(segment, name="it")])
    assert after_ramp.command[10] == 2e-3  # not 1.8e-3, the ramp's last sample


def test_schroeder_phases_keep_the_crest_low() -> None:
    lines = tuple(float(n) for n in range(1, 32))
    waves = (build_profile([Multisine(amplitude=1.0, frequencies=lines, phases=phases, time=1.0, fade=0.0)]).command
             for phases in ((), (np.pi / 2,) * len(lines)))
    schroeder, aligned = (np.abs(wave).max() / np.sqrt(np.mean(wave**2)) for wave in waves)
    assert schroeder < 2.0 < 7.0 < aligned


@pytest.mark.parametrize(("t", "values", "period", "samples"), [
    ([0.0, 0.004, 0.005], [0.0, 4.0, 9.0], 0.002, [0, 2, 4]), ([5.0], [3.0], 0.002, [3.0]),
    ([0.0, 0.004, 0.005], [0.0, 4.0, 9.0], 0.001, [0, 1, 2, 3, 4, 9])])
def test_breakpoints_are_joined_by_lines_and_one_row_is_one_cycle(t: list[float], values: list[float], period: float,
                                                                 samples: list[float]) -> None:
    assert resample_on_cycles(np.array(t), np.array(values), period).tolist() == samples


@pytest.mark.parametrize(("make", "key", "expectation"), [
    (lambda: Hold(time=0.0), "time", "above 0 and at most 3600 s, not 0"),
    (lambda: Hold(time=float("nan")), "time", "at most 3600 s, not nan"),
    (lambda: build_profile([Hold(time=0.0105)]), "time", "whole cycles of 0.001 s, not 0.0105"),
    (lambda: build_profile([Hold(time=1e-3)], rate=500.0), "time", "whole cycles of 0.002 s, not 0.001"),
    (lambda: build_profile([Sine(amplitude=1.0, frequency=500.0, time=1.0)]), "frequency", "below 500 Hz"),
    (lambda: build_profile([Chirp(amplitude=1.0, f0=1.0, f1=60.0, time=1.0)], rate=100.0), "f1", "below 50 Hz, not 60"),
    (lambda: build_profile([Multisine(amplitude=1.0, frequencies=(1.0, 50.0), time=1.0)], rate=100.0), "frequencies",
     "below 50 Hz, not 50"),
    (lambda: Chirp(amplitude=1.0, f0=0.0, f1=1.0, time=1.0), "f0", "above 0"),
    (lambda: Chirp(amplitude=1.0, f0=1.0, f1=2.0, time=1.0, fade=-1.0), "fade", "0 or more"),
    (lambda: Multisine(amplitude=1.0, frequencies=(), time=1.0), "frequencies", "at least one"),
    (lambda: Multisine(amplitude=1.0, frequencies=(1.0, 2.0), phases=(0.0,), time=1.0), "phases", "2 phases"),
    (lambda: Points(points=((1.0, 0.0), (0.5, 0.0))), "points", "increasing"),
    (lambda: Points(points=()), "points", "pairs"),
    (lambda: build_profile([Hold(time=1.0, name="a"), Hold(time=1.0, name="a")]), "name", "used once"),
])
def test_an_impossible_segment_is_refused_by_key(make: Callable[[], object], key: str, expectation: str) -> None:
    line = catch_refusal(make)
    assert f"{key}: expected" in line and expectation in line
