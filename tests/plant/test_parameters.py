"""Parameters: what is refused and how it is said, and model files that come back as they went."""
from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED

import plant
from plant import Actuator, InputError, Model, load_model, simulate
from plant.model import find_parameter_groups, find_quantity
from plant.parameters import GROUPS, load_nominal_values
from plant.quantity import Quantity, list_quantities

NAMES = list(load_nominal_values())


def refusal(changes: dict[str, object]) -> str:
    with pytest.raises(InputError) as caught:
        Model().replace(changes)
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(("name", "value", "said"), [
    ("spool.static_friction", -1, "at least 0 N and at most 1e+06 N, not -1"),
    ("jack.mass", 0, "at least 0.01 kg"),
    ("supply.pressure", 1e-300, "at least 100000 Pa and at most 1e+08 Pa, not 1e-300"),
    ("supply.pressure", 201, "at least 100000 Pa"),  # bar
    ("controller.current_limit", 1e300, "at most 20 A"),
    ("constant_load.force", -1e7, "at least -1e+06 N"),
    ("filter.clogging", 1.0, "below 1, not 1"),
    ("filter.clogging", -0.1, "at least 0"),
    ("filter.law", "cubic", "one of sqrt, linear, pressure, not 'cubic'"),
    ("filter.law", 0.7, "one of sqrt, linear, pressure, not 0.7"),
    ("valve.flow_gain", "plenty", "not 'plenty'"),
    ("valve.flow_gain", "nan", "not nan"),
    ("valve.flow_gain", float("nan"), "not nan"),
    ("valve.flow_gain", float("inf"), "not inf"),
    ("null_bias.current", float("-inf"), "at least -20 A and at most 20 A, not -inf"),
    pytest.param("valve.flow_gain", 10**400, "not 1000", id="400 digits"),
    ("valve.flow_gain", [1 << 20000], "not a huge value"),
    ("valve.flow_gain", True, "not True"),
    ("valve.flow_gain", None, "not None"),
    ("valve.flow_gain", [0.3], r"not [0.3]"),
    ("controller.period", 1e-6, "at least 0.0001 s"),
    ("spool.static_fricton", 3, "did you mean static_friction?"),
    ("spol.static_friction", 3, "did you mean spool?"),
    ("nothing.at_all", 3, "a known group"),
    ("spool", 3, "spool"),
    ("", 3, "a known group"),
    ("sensor_lag.time", 1.0, "at most 0.1 s"),
])
def test_refused_by_name(name: str, value: object, said: str) -> None:
    text = refusal({name: value})
    assert said in text
    assert text.startswith(f"--set: {name}: expected" if name else "--set: expected")


@pytest.mark.parametrize("body", ["spool", "jack"])
def test_contradictions_are_refused(body: str) -> None:
    text = refusal({f"{body}.static_friction": 10.0, f"{body}.dynamic_friction": 11.0})
    assert f"{body}.dynamic_friction" in text and "at most" in text
    assert "dynamic_friction" in refusal({f"{body}.static_friction": 0.0})  # the nominal dynamic level stays
    Model().replace({f"{body}.static_friction": 10.0, f"{body}.dynamic_friction": 10.0})


@given(st.sampled_from(NAMES) | st.text(max_size=30), st.one_of(
    st.floats(), st.integers(), st.text(max_size=8), st.none(), st.booleans(), st.lists(st.floats(), max_size=2)))
@settings(max_examples=300, deadline=None)
def test_whatever_is_set_is_taken_or_refused_in_one_line(name: str, value: object) -> None:
    try:
        model = Model().replace({name: value})
    except InputError as error:
        assert name in str(error)
    else:
        assert np.isfinite(model[name])
        assert not find_quantity(name).refuses(model[name])


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


def test_every_parameter_says_what_it_is() -> None:
    for group, cls in find_parameter_groups().items():
        assert cls.__doc__, group
        for name, quantity in list_quantities(cls).items():
            assert isinstance(quantity, Quantity) and quantity.unit, f"{group}.{name}"


def test_the_nominal_file_is_complete_and_is_that_of_the_issue() -> None:
    assert list(load_nominal_values()) == [f"{group}.{field}" for group, cls in GROUPS.items() for field in cls._fields]
    given_ = SHARED / "nominal.toml"
    if not given_.exists():
        pytest.skip("no ../shared to compare with")
    ours = (Path(plant.__file__).parent / "models" / "nominal.toml").read_text()
    ours_ = tomllib.loads(ours)
    assert ours_["filter"].pop("law") == "sqrt"  # the one that is ours alone
    for group, fields in ours_.pop("identify").items():  # what rig identify fits; no value of the plant
        assert set(fields) <= set(ours_[group]), group
    assert ours_ == tomllib.loads(given_.read_text())


def test_the_shipped_servo_file_is_read_as_it_stands() -> None:
    """Every number of the file is the model's; what the file does not list is zero."""
    tables = tomllib.loads((Path(plant.__file__).parent / "models" / "ehs.toml").read_text())
    listed = {f"{group}.{field}": value for group, fields in tables.items() for field, value in fields.items()}
    assert len(listed) == 15
    model = load_model("ehs")
    assert {name: value for name, value in model.values.items() if value} == {
        name: value for name, value in listed.items() if name in model.values}
    assert model.with_effects(["compressibility"])["compressibility.volume"] == listed["compressibility.volume"] == 6e-3


CHANGES = {
    "spool.static_friction": st.floats(3.5, 500.0), "jack.mass": st.floats(1.0, 1e4),
    "filter.clogging": st.floats(0, 0.9), "jack.leakage": st.floats(0, 1e-9),
    "filter.law": st.sampled_from(["sqrt", "linear", "pressure"]), "null_bias.current": st.floats(-1e-3, 1e-3),
    "sensor_lag.time": st.floats(0, 0.05), "spool_overlap.overlap": st.floats(0, 1e-4),
}


@given(st.fixed_dictionaries({}, optional=CHANGES), st.text(st.characters(codec="utf-8"), min_size=1, max_size=12))
@settings(max_examples=100, deadline=None)
def test_model_file_round_trip(tmp_path_factory: pytest.TempPathFactory, changes: dict[str, object], name: str) -> None:
    path = tmp_path_factory.getbasetemp() / "model.toml"
    changed = Model().replace(changes)
    model = Model(name, changed.values, changed.effects)
    path.write_text(model.to_toml(), encoding="utf-8", newline="")
    back = load_model(path)
    assert (back.name, back.effects, dict(back.values)) == (model.name, model.effects, dict(model.values))


@pytest.mark.parametrize(("text", "said"), [
    ("[spool\n", "TOML"),
    pytest.param(f"[spool]\nmass = {'9' * 5000}", "TOML (Exceeds the limit (4300 digits)", id="5000 digits"),
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
def test_a_bad_model_file_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_model(path)
    assert said in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_or_binary_model_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a model file"):
        load_model(tmp_path / "none.toml")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        load_model(tmp_path / "b.toml")


@pytest.mark.parametrize(("command", "load"), [([], None), ([[0.0]], None), ([0.0, 0.0], [1.0])])
def test_a_command_of_the_wrong_shape_is_refused(command: list[float], load: list[float] | None) -> None:
    with pytest.raises(InputError, match="one demand and one load a cycle"):
        simulate(Model(), np.array(command), None if load is None else np.array(load))


def test_a_parameter_changes_live() -> None:
    plant_, other = Actuator(Model()), Actuator(Model())
    plant_.set("jack.mass", 400.0)
    for one in (plant_, other):
        for _ in range(20):
            one.advance(3e-3)
    assert plant_.state.jack_position < other.state.jack_position
    for unknown in ("sensor_lag.time", "jack.moss"):  # the model has no such effect, nor anyone such a parameter
        with pytest.raises(InputError, match=unknown):
            plant_.set(unknown, 1e-3)
