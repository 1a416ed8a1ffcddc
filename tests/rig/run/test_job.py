"""A run repeated from its log alone: the sequence with its files, the model, the user's effects, the seed."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rig_command import rig
from short_sequences import SHORT, job, play

from fdi.trace.trace import Trace
from plant import InputError
from plant.effects import CATALOGUE
from rig.run.job import read_job

EFFECT = '''
from typing import Annotated, NamedTuple
from plant.effects import effect
from plant.quantity import Quantity

class Creep(NamedTuple):
    rate: Annotated[float, Quantity("A/s")] = 0.0

class Crept(NamedTuple):
    current: float = 0.0

@effect("current", Creep, memory=Crept, law="i = i + rate t")
def creep(x, m, s, u, p):
    crept = m.current + p.creep.rate * u.h
    return x + crept, Crept(crept)
'''
FAULTY = SHORT + """
load = [{ kind = "ramp", to = 2e3, time = 0.1 }]
faults = [
  { kind = "parameter", parameter = "creep.rate", value = 2e-3, start = 0.1, ramp = 0.05 },
  { kind = "noise", signal = "xj", value = 1e-5, start = 0.1, end = 0.2 },
  { kind = "lost", frame = "drive", start = 0.0, probability = 0.1 },
]
"""
SIGNALS = ("com", "xj", "cor", "p12", "xs", "load")


@pytest.fixture(autouse=True)
def catalogue() -> Iterator[None]:
    """Each test has the shipped effects only, as a new process does."""
    before = dict(CATALOGUE)
    yield
    CATALOGUE.clear()
    CATALOGUE.update(before)


def same(a: Path, b: Path) -> bool:
    one, two = (Trace.read(path, all=True) for path in (a, b))
    return all(np.array_equal(one.column(name), two.column(name), equal_nan=True) for name in SIGNALS)


def test_all_that_decides_is_in_the_log(tmp_path: Path) -> None:
    first = job(seed=7, set_={"filter.clogging": 0.2, "sensor_lag.time": 1e-3}, max_overruns=0.5, plant="builtin")
    play(first, tmp_path / "a")
    again = read_job(tmp_path / "a" / "trace.mcap")
    assert (again.model, again.sequence, again.list_settings()) == (first.model, first.sequence, first.list_settings())
    play(again, tmp_path / "b")
    assert same(tmp_path / "a", tmp_path / "b")
    third = read_job(tmp_path / "b" / "trace.mcap")
    assert third.bench.files == again.bench.files == first.bench.files
    assert replace(third, bench=again.bench) == again


def test_another_seed_is_another_run(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        play(job(seed=seed), tmp_path / name)
    assert not same(tmp_path / "a", tmp_path / "b")


def test_with_faults_loads_a_recorded_command_and_the_users_effect(tmp_path: Path) -> None:
    """Repeated elsewhere: neither the CSV nor the effect file is there any more."""
    origin = tmp_path / "origin"
    origin.mkdir()
    (origin / "creep.py").write_text(EFFECT)
    t = np.arange(100) / 1000
    rows = [f"{a:.3f},{b:.7f}" for a, b in zip(t, 1e-3 * np.sin(60 * t), strict=True)]
    (origin / "recorded.csv").write_text("t,com\n" + "\n".join(rows) + "\n")
    text = FAULTY.replace('  { name = "back"', '  { name = "recorded", kind = "csv", file = "recorded.csv" },\n'
                                               '  { name = "back"')
    (origin / "faulty.toml").write_text(text)
    said = rig("run", origin / "faulty.toml", "--effects", origin / "creep.py", "--seed", 3, "--quiet", "--out",
               tmp_path / "a", "--set", "creep.rate=1e-4")
    assert said.status == 0, said
    for path in origin.iterdir():
        path.unlink()
    del CATALOGUE["creep"]
    said = rig("run", "--from", tmp_path / "a" / "trace.mcap", "--trust", "--quiet", "--out", tmp_path / "b")
    assert said.status == 0, said
    assert same(tmp_path / "a", tmp_path / "b")
    assert abs(Trace.read(tmp_path / "a").cor[-20:].mean()) > 1e-5  # and the effect did something


def test_two_effect_files_of_one_name_are_refused(tmp_path: Path) -> None:
    """The log keeps them by name; one would be lost."""
    for folder, name in (("a", "creep"), ("b", "crawl")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(EFFECT.replace("creep", name))
    said = rig("run", "--effects", tmp_path / "a" / "mine.py", "--effects", tmp_path / "b" / "mine.py", "--out",
               tmp_path / "out")
    assert said.status == 2 and "mine.py" in said.err and len(said.err.splitlines()) == 1


@pytest.mark.parametrize("missing", ["seed", "model.toml"])
def test_a_log_without_what_decides_is_refused(tmp_path: Path, missing: str) -> None:
    from rig.recorder import Recorder, Signals, Timing

    attachments = {} if missing == "model.toml" else {"model.toml": ("", b""), "sequence/x.toml": ("", b"")}
    recorder = Recorder(tmp_path / "trace.mcap", attachments, {"period": "0.001"})
    recorder.cycle(0, Signals(0, 1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0), Timing(0, False, 0.0, 0.0, 0.0))
    recorder.close()
    with pytest.raises(InputError, match="only logs of `rig run`"):
        read_job(tmp_path / "trace.mcap")


def test_bus_and_pace_may_be_asked_for_anew(tmp_path: Path) -> None:
    play(job(seed=4), tmp_path / "a")
    said = rig("run", "--from", tmp_path / "a" / "trace.mcap", "--pace", "realtime", "--max-overruns", 1, "--json",
               "--out", tmp_path / "b")
    assert said.json["run"]["pace"] == "realtime" and said.json["run"]["seed"] == 4
    assert same(tmp_path / "a", tmp_path / "b")
