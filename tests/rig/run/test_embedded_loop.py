"""Cycles that are played together as compiled code leave the same log as cycles that the nodes in Python play alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig_command import SHORT, job, play

from fdi.trace import Trace, open_log
from plant import Array
from rig.nodes import emulator_cycle
from rig.run import Outcome, bring_up
from rig.run.embedded_loop import EmbeddedLoop

LOADED = SHORT.replace("main = [", 'load = [{ kind = "ramp", to = 1500, time = 0.3 }]\nmain = [')
GUARDED = SHORT + 'guards = [{ name = "g", signal = "error", low = -0.5, high = 0.1, unit = "mm", cycles = %d }]'


def with_fault(text: str) -> str:
    return f"faults = [{{ {text} }}]\n" + SHORT


def read_log(folder: Path) -> list[tuple[int, int, bytes]]:
    """The messages in the order of the file, without what the wall clock says of a cycle."""
    log = open_log(folder / "trace.mcap")
    topics = {number: channel.topic for number, channel in log.channels.items()}
    return [(number, t_ns, data[:5] if topics[number] == "/timing" else data)
            for number, t_ns, data in log.list_raw_messages()]


@pytest.fixture
def cycle_counts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many cycles were played together, call by call."""
    counts: list[int] = []
    original = EmbeddedLoop.play_many

    def play_many(self: EmbeddedLoop, phase: int, demands: Array, loads: Array, control: int) -> int:
        counts.append(original(self, phase, demands, loads, control))
        return counts[-1]

    monkeypatch.setattr(EmbeddedLoop, "play_many", play_many)
    return counts


def play_both(monkeypatch: pytest.MonkeyPatch, folder: Path, *arguments: Any, **settings: Any) -> Outcome:
    """Play a job as it is and with every cycle in Python; the logs and verdicts must be the same."""
    together = play(job(*arguments, **settings), folder / "together")
    monkeypatch.setattr(bring_up, "can_play_many", lambda master, bench: False)
    alone = play(job(*arguments, **settings), folder / "alone")
    assert read_log(folder / "together") == read_log(folder / "alone")
    assert (together.verdict, together.aborted, together.events) == (alone.verdict, alone.aborted, alone.events)
    assert str(together.checks) == str(alone.checks)  # words: a value that is not there, NaN, is not equal to itself
    return together


@pytest.mark.parametrize(("text", "set_", "least"), [
    (SHORT, {}, 400),
    (LOADED, {"filter.clogging": 0.3, "controller.integral_gain": 0.4}, 400),
    (SHORT, {"controller.current_limit": 1e-3, "controller.derivative_gain": 1e-4}, 400),
    (SHORT, {"command_rate_limit.rate": 0.05}, 0),  # an effect in the firmware, which is Python
    (with_fault('kind = "parameter", parameter = "filter.clogging", value = 0.5, start = 0.1'), {}, 350),
    (with_fault('kind = "parameter", parameter = "filter.clogging", value = 0.5, start = 0.1, end = 0.3, ramp = 0.1'),
     {}, 200),
    (with_fault('kind = "noise", signal = "p12", value = 1e4, start = 0.1, end = 0.2'), {}, 200),
    (with_fault('kind = "stuck", signal = "xj", start = 0.1, end = 0.12'), {}, 300),
    (with_fault('kind = "late", frame = "drive", delay = 2.5e-3, start = 0.1, end = 0.15'), {}, 100),
    *((with_fault(f'kind = "{kind}", frame = "{frame}", start = 0.1, end = 0.3, every = 17, probability = 0.7'), {},
       200)
      for kind, frame in (("lost", "feedback"), ("lost", "sync"), ("duplicated", "sync"), ("duplicated", "drive"),
                          ("corrupted", "feedback"), ("corrupted", "valve_state"))),
    (with_fault('kind = "lost", frame = "feedback", start = 0.2, end = 0.22'), {}, 100),
    (with_fault('kind = "heartbeat", node = "rig", start = 0.05, end = 0.32'), {}, 50),
    (with_fault('kind = "foreign", start = 0.1, end = 0.2, every = 3'), {}, 200),
    (with_fault('kind = "reset", start = 0.15'), {}, 100),
    (with_fault('kind = "lost", frame = "drive", start = 0.2, count = 1'), {}, 100),
    (GUARDED % 3, {}, 20), (GUARDED % 1, {}, 20), (GUARDED % 40, {}, 20)])
def test_the_log_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cycle_counts: list[int], text: str,
                             set_: dict[str, float], least: int) -> None:
    play_both(monkeypatch, tmp_path, text, seed=3, set_=set_)
    assert sum(cycle_counts) >= least and (least or not sum(cycle_counts))


def test_a_plant_that_diverges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cycle_counts: list[int]) -> None:
    """No exception and no number that is made up, in either loop: EMCY, and clean-up without current."""
    original = emulator_cycle.fill_noise

    def fill(m: emulator_cycle.Memory, rng: np.random.Generator) -> None:
        original(m, rng)
        m.reals[emulator_cycle.NOISE_AT + 200 * m.words[emulator_cycle.NOISES] + 1] = np.nan

    monkeypatch.setattr(emulator_cycle, "fill_noise", fill)
    outcome = play_both(monkeypatch, tmp_path)
    assert (outcome.verdict, outcome.safe) == ("ABORTED", True) and "node 3 plant 0x6000" in outcome.aborted
    trace = Trace.read(tmp_path / "alone", all=True)
    assert np.isnan(trace.xj[200:]).all() and not np.nan_to_num(trace.cor[-50:]).any()
    assert sum(cycle_counts) > 150
