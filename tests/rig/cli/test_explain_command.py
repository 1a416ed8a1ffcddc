"""`rig explain`: what it says of runs made with a tenth of its step, as JSON (docs/json.md), in words, as a page."""
from __future__ import annotations

import doctest
from pathlib import Path

import numpy as np
import pytest
from effect_files import HEAD, restored_catalogue
from rig_command import Said, answer, refuse, rig
from short_runs import HIDDEN, build_command, list_trace_arguments, write_measured_runs

from fdi.estimation.fit import list_active_effects, list_active_unknowns, list_all_unknowns
from fdi.report import numbers as spoken
from plant import Model
from plant.effects import CATALOGUE

SIGNALS = {"xj", "p12", "xs"}


@pytest.fixture(scope="module")
def biased(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("biased"), HIDDEN)


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_measured_runs(tmp_path_factory.mktemp("healthy"), {})


@pytest.fixture(scope="module")
def found(biased: dict[str, Path]) -> Said:
    """One search; its page is page.html beside the run."""
    return rig("explain", *list_trace_arguments(biased), "--json", "--out", biased["est"].with_name("page.html"))


def test_the_effect_is_named_with_its_evidence(found: Said) -> None:
    said, hidden = found.json, HIDDEN["null_bias.current"]
    best, *others = said["candidates"]
    assert (found.status, said["verdict"], said["effects"]) == (1, "EXPLAINED", ["null_bias"])
    assert (best["effect"], best["word"]) == ("null_bias", "explains")
    assert best["ratio"] < 1.1 and best["evidence"] > 1000.0 and best["p_value"] < 1e-6
    current = best["parameters"]["null_bias.current"]
    assert current["unit"] == "A" and current["low"] < hidden < current["high"] < current["low"] + 0.1 * hidden
    assert all(other["ratio"] > best["ratio"] for other in others)


def test_baseline_and_floor(found: Said) -> None:
    base, best = found.json["baseline"], found.json["candidates"][0]
    for told in (base, best):
        assert set(told["error"]) == set(told["holdout"]) == set(base["floor"]) == SIGNALS
    assert base["floor"]["xj"] == pytest.approx(2e-6, rel=0.1) and base["error"]["xj"] > 10.0 * base["floor"]["xj"]
    assert all(best["error"][signal] < 1.1 * floor and best["holdout"][signal] < 1.15 * floor
               for signal, floor in base["floor"].items())


def test_effects_that_hide_in_the_tolerances_are_listed_with_what_would_reveal_them(found: Said) -> None:
    blind = {b["effect"]: b for b in found.json["blind_to"]}
    offset = blind["sensor_offset"]  # no size of it shows in a closed loop
    assert (offset["smallest_visible"], offset["usual"], offset["unit"]) == (None, 2e-4, "m")
    assert "end stop" in offset["revealed_by"]
    assert "null_bias" not in blind and "constant_load" not in blind
    assert "command_rate_limit" in found.json["seen_without_noise"]


def test_the_page_needs_no_network(found: Said, biased: dict[str, Path]) -> None:
    page = biased["est"].with_name("page.html").read_text()
    assert "null_bias explains the residual" in page and page.count("<svg") == 2
    assert "http" not in page.replace("http://www.w3.org", "")
    assert ">1</text>" in page and "math" not in page, "the noise floor on a logarithmic axis, as a plain number"


def test_nothing_missing_passes(healthy: dict[str, Path]) -> None:
    said = rig("explain", *list_trace_arguments(healthy))
    assert said.status == 0 and said.out.startswith("NOTHING_MISSING")
    assert "the residual is noise" in said.out and "not detectable" in said.out and "next" not in said.out


FEW = ("null_bias", "constant_load", "friction_asymmetry", "spool_friction")
SPRING = HEAD + '''
class Spring(NamedTuple):
    stiffness: Annotated[float, Quantity("N/m", low=0)] = 0.0

@effect("load", Spring, law="FR = FR + K XJ")
def own_spring(x, s, u, p):
    return x + p.own_spring.stiffness * s.jack_position
'''


def test_a_users_effect_is_ranked_with_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a small catalogue, whose code compiles in a few seconds."""
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(SPRING)
    rows = "\n".join(f"{k / 1000:.3f},{x!r}" for k, x in enumerate(build_command().tolist()))
    Path("command.csv").write_text(f"t,com\n{rows}\n")
    with restored_catalogue():
        for name in set(CATALOGUE) - set(FEW):
            del CATALOGUE[name]
        for seed in (1, 2):
            assert rig("simulate", "--set=own_spring.stiffness=4e5", "--effects", "own.py", "--seed", seed,
                       "--steps=200", "--quiet", "--command", "command.csv", "--out", f"{seed}.csv").status == 0
        found = answer("explain", "1.csv", "--repeat", "2.csv", "--effects", "own.py", status=1)
    assert (found["effects"], found["verdict"]) == (["own_spring"], "EXPLAINED")
    stiffness = found["candidates"][0]["parameters"]["own_spring.stiffness"]
    assert stiffness["low"] < 4e5 < stiffness["high"]


@pytest.mark.parametrize(("words", "complaint"), [
    (["est", "--holdout", "est"], "a run that no fit has seen"),
    (["est", "--repeat", "est"], "the same command run again"),
    (["est", "--repeat", "holdout"], "another command is no repeat"),
    (["est", "--signals", "xj,q"], "--signals: q: expected some of xj,p12,xs"),
    (["est", "--out", "x.txt"], "FILE.html for a page, or FILE.json"),
    (["est", "--write-effect", "x.txt"], "FILE.py"),
    (["est", "--holdout", "nowhere.csv"], "a trace that can be read"),
    (["bare"], "cor"),
])
def test_bad_input_is_told_in_one_line(words: list[str], complaint: str, biased: dict[str, Path],
                                       tmp_path: Path) -> None:
    columns = np.loadtxt(biased["est"], delimiter=",", skiprows=1)[:, :3]
    np.savetxt(tmp_path / "bare.csv", columns, delimiter=",", header="t,com,xj", comments="")
    files = {**biased, "bare": tmp_path / "bare.csv"}
    assert complaint in refuse("explain", *(files.get(word, word) for word in words))


def test_effects_of_a_model_are_free_from_where_they_are() -> None:
    model = Model().replace({"null_bias.current": 1e-4, "spool.static_friction": 45.0, "spool.dynamic_friction": 30.0,
                             "jack.mass": 101.0, "command_rate_limit.rate": 0.1})
    assert set(list_active_effects(model)) == {"spool_friction", "null_bias", "command_rate_limit"}
    own = {f.name: f for f in list_active_unknowns(model)}
    assert set(own) == {"null_bias.current", "spool.static_friction", "spool.dynamic_friction"}
    assert own["null_bias.current"].centre == 1e-4 and np.isinf(own["null_bias.current"].prior)
    names = [f.name for f in list_all_unknowns(model)]
    assert len(names) == len(set(names)) and {"jack.mass", "null_bias.current"} <= set(names)
    assert not list_active_effects(Model()) and not list_active_unknowns(Model().with_effects(["null_bias"]))


def test_numbers_in_words() -> None:
    assert doctest.testmod(spoken).failed == 0
