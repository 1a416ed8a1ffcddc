"""Bands made: from a fleet's own traces, from simulated units, by the command."""
from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fdi.diagnosis.bands import format_bands, judge_trace, load_bands, load_default_bands
from fdi.diagnosis.learn_bands import UnitKind, learn_bands, sample_sensor_noise, simulate_units
from fdi.trace.trace import Trace
from plant import InputError, load_model
from plant.profile import build_profile as profile
from plant.segments import Hold, Ramp, Step
from rig.cli.main import main
from rig.sequences import load_sequence

CLOGGING, FRICTION = "filter_clogging", "spool_friction"


@cache
def command() -> np.ndarray:
    return load_sequence("preflight").main_profile().command


@cache
def made(kind: UnitKind) -> np.ndarray:
    com = command()
    return simulate_units(load_model(), com, np.zeros_like(com), kind, 16, seed=4321)


def healthy() -> np.ndarray:
    return made(UnitKind(""))


def trace(x: np.ndarray, com: np.ndarray | None = None) -> Trace:
    com = command() if com is None else com
    return Trace.from_columns({"com": com, "xj": x, "cor": np.full(len(x), 1e-3)}, 1e-3, {})


def test_a_fleet_of_its_own() -> None:
    """Another design's response, learned from healthy traces, is healthy then; its faults are still found."""
    model = load_model().replace({"pilot.flow_gain": 0.069 * 0.88})
    com = command()

    def fleet(kind: UnitKind, count: int, seed: int) -> list[Trace]:
        return [trace(x) for x in simulate_units(model, com, np.zeros_like(com), kind, count, seed)]

    sound = fleet(UnitKind(""), 32, 7)
    strange = [judge_trace(t, load_default_bands()) for t in sound]
    assert np.mean([j.severity[CLOGGING] for j in strange]) > 0.3
    own = learn_bands(sound)
    assert own.provenance["made"].startswith("from 32 healthy traces")
    fresh = [judge_trace(t, own) for t in fleet(UnitKind(""), 16, 8)]
    assert [j.events for j in fresh] == [()] * 16
    assert np.mean([j.severity[CLOGGING] for j in fresh]) < 0.2
    faulty = [judge_trace(t, own) for t in fleet(UnitKind("", 0.4), 8, 9)]
    assert {j.ruling for j in faulty} == {CLOGGING}
    assert own.precursors["overshoot_5mm"]["healthy"] != load_default_bands().precursors["overshoot_5mm"]["healthy"]


def test_a_fleet_that_cannot_be_learned_from() -> None:
    """Too few, another command in one of them, holes."""
    own = [trace(x) for x in healthy()[:6]]
    with pytest.raises(InputError, match="at least 5"):
        learn_bands(own[:3])
    other = command().copy()
    other[500:1500] = 4e-3
    with pytest.raises(InputError, match=r"odd\.csv: com"):
        learn_bands([*own, trace(healthy()[7], other)], names=[*"abcdef", "odd.csv"])
    holed = healthy()[7].copy()
    holed[3000:4000] = np.nan
    with pytest.raises(InputError, match="missing"):
        learn_bands([*own, trace(holed)])
    doubtful = learn_bands([*own, trace(made(UnitKind("", 0.5))[0])], names=[*"abcdef", "clogged.csv"])
    assert doubtful.provenance["doubtful"].endswith(": clogged.csv")


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`rig fdi --learn-bands` writes a file, from a command or from traces; without a place for it, one line."""
    com = profile((Hold(time=0.1), Step(to=2e-3, time=0.15), Ramp(to=2.5e-3, time=0.9))).command
    rows = "\n".join(f"{k / 1000:.3f},{value:.9g}" for k, value in enumerate(com))
    (tmp_path / "c.csv").write_text("t,com\n" + rows + "\n")
    out = str(tmp_path / "b.toml")
    assert main(["fdi", "--learn-bands", "--command", str(tmp_path / "c.csv"), "--out", out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["judges"] == [CLOGGING, FRICTION]
    assert load_bands(out).provenance["command"].endswith("c.csv")
    assert main(["fdi", "--learn-bands"]) == 2
    assert main(["fdi"]) == 2
    assert capsys.readouterr().err.count("\n") == 2


def test_noise_of_the_healthy() -> None:
    """As large as the sensor's, of different colours, with hum: what false alarms are counted with."""
    drawn = [sample_sensor_noise(np.random.default_rng(k), load_model(), 4000) for k in range(40)]
    sizes = np.array([x.std() for x in drawn])
    colours = np.array([np.corrcoef(x[:-1], x[1:])[0, 1] for x in drawn])
    assert sizes.min() > 1.6e-6 and sizes.max() < 3e-6
    assert colours.min() < 0.2 and colours.max() > 0.7


@pytest.mark.slow
def test_the_shipped_bands_are_what_the_command_makes(tmp_path: Path) -> None:
    """Byte for byte, on this kind of machine."""
    out = tmp_path / "b.toml"
    assert main(["fdi", "--learn-bands", "--out", str(out), "--quiet"]) == 0
    assert out.read_text() == format_bands(load_default_bands())
