"""Laws outside the catalogue: terms that regressions propose, replays choose and a held-out run judges."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from effect_files import HEAD, restored_catalogue
from short_runs import STEPS, build_command, build_other_command

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
from fdi.discovery.residual_pattern import Balance, States, measure_way
from fdi.discovery.runs import read_runs
from fdi.discovery.search import Search
from fdi.trace.trace import Trace
from plant import Model, simulate
from plant.effects import CATALOGUE, combine_laws, load_effects
from plant.eha import State
from plant.state import Drag, Input, Line

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
    there, unseen = ({name: sample_states(seed)[name] for name in ("position", "speed", "pressure", "spool", "current")}
                     for seed in (2, 3))
    product, held = (states["position"] * states["pressure"] / 1e4 for states in (there, unseen))
    noise = np.random.default_rng(5).standard_normal(len(product))
    found = find_dependences(product + 0.3 * product.std() * noise, there, (held, unseen))
    assert found[0].states == ("position", "pressure") and found[0].share > 0.5
    assert found[0].holdout is not None and found[0].holdout > 0.4 and found[0].p_value < 0.02
    coloured = np.convolve(noise, np.ones(200), "same")
    assert find_dependences(coloured, there, None)[0].p_value > 0.05, "slow noise follows nothing"


SIZES = {"cogging": 400.0, "cogging_length": 2e-3, "cogging_phase": 0.3, "drag_square": 3e5, "friction_run_in": 200.0,
         "friction_run_in_length": 1e-3, "flow_square": 200.0, "leakage_outer": 2e-9, "area_slope": 0.02,
         "dead_band": 0.4, "dead_band_width": 2e-4, "feedback_cube": 1e6}
LAWS = {"force": ("cogging", "drag_square", "friction_run_in"), "flow": ("flow_square", "leakage_outer", "area_slope"),
        "current": ("dead_band", "feedback_cube")}


@pytest.mark.parametrize("place", LIBRARY)
def test_a_written_law_is_what_the_library_replayed(place: str, tmp_path: Path) -> None:
    """Bit for bit: what was chosen with the library is what the file adds; at its off values it changes no bit."""
    terms = [BY_NAME[name] for name in LAWS[place]]
    values = {field: SIZES[field] for term in terms for field in term.fields}
    states = sample_states(7, 300)
    with registered_library():
        (tmp_path / "law.py").write_text(write_effects({place: "own_law"}, terms, values, "A law."))
        assert load_effects(tmp_path / "law.py") == ["own_law"]
        library = Model().with_effects([LIBRARY[place]]).replace(
            {name_parameter(t, f): values[f] for t in terms for f in t.fields})
        own = Model().with_effects(["own_law"])
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

        written = run(own.replace({f"own_law.{f}": v for f, v in values.items()}))
        assert run(library) == written != run(own) == [signal] * 300


def test_a_law_reads_as_a_formula() -> None:
    assert format_formula([BY_NAME["drag_square"]]) == "force + drag_square * abs(speed) * speed"
    assert format_formula([BY_NAME["contact"]]) == \
        "force + contact * (max(position - contact_gap, 0.0) - max(-position - contact_gap, 0.0))"
    text = write_law("own", [BY_NAME["cogging"]], {"cogging": 700.0, "cogging_length": 2e-3, "cogging_phase": 0.1})
    assert '@effect("load", Own,' in text and 'Quantity("N", low=0, high=10000)' in text
    assert 'Quantity("m", low=0.0004, high=0.01)] = 0.002' in text


HIDDEN = HEAD + '''
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
    return [Trace.from_columns(simulate(model, com, None, seed, STEPS)._asdict(), 1e-3, {})
            for seed, com in enumerate(commands, 1)]


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
    (tmp_path / "hidden.py").write_text(HIDDEN.format(port=outside.port, law=outside.law))
    with restored_catalogue():
        load_effects(tmp_path / "hidden.py")
        traces = record_runs(Model().replace({"hidden_law.size": outside.size}))
    found = search_law(traces)
    law = found.law
    print(name, describe_search(found))
    assert law is not None and law.holds and [term.name for term in law.terms] == [outside.term], law
    assert all(error < 1.2 * found.floor[signal] for signal, error in law.holdout.items())
    worst = max(found.floor, key=lambda s: found.base.errors[s] / found.floor[s])
    assert law.hypothesis.errors[worst] < 0.5 * found.base.errors[worst]
    assert law.values[outside.term].low < outside.size < law.values[outside.term].high
    names = write_law_file(tmp_path / "law.py", law.terms, law.values, law.reason)
    assert load_effects(tmp_path / "law.py") == list(names.values()) == [f"missing_{law.terms[0].place}"]
    assert CATALOGUE[names[law.terms[0].place]].starts


def describe_search(found: LawSearch) -> str:
    """A row of the table of laws in docs/statistics.md."""
    worst = max(found.floor, key=lambda s: found.base.errors[s] / found.floor[s])
    floor = found.floor[worst]
    if found.law is None:
        return f"{worst}: {found.base.errors[worst] / floor:.2f} floors, no law"
    values = ", ".join(f"{f} {v.value:.4g} ({v.low:.4g} to {v.high:.4g})" for f, v in found.law.values.items())
    return (f"{worst}: {found.base.errors[worst] / floor:.2f} -> {found.law.hypothesis.errors[worst] / floor:.2f}, "
            f"held-out {found.holdout['base'][worst] / floor:.2f} -> {found.law.holdout[worst] / floor:.2f} floors; "
            f"{values}; holds {found.law.holds}: {found.law.reason}")


def test_a_healthy_run_has_no_law() -> None:
    found = search_law(record_runs(Model()))
    assert found.law is None and not any(m.visible for m in found.missing)
