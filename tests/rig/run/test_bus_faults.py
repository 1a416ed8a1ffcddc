"""Faults on the bus from a sequence, in whole runs: what must change nothing changes nothing, the rest is noticed."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from rig_command import SHORT, job, play, read_signals

from fdi.trace import MAIN, Trace, open_log
from fdi.trace.trace import CLEANUP
from rig.run import Outcome

SAFE = SHORT + 'ends = "safe_state"\n'


def play_fault(folder: Path, *faults: str, text: str = SHORT, **settings: object) -> Outcome:
    fault_list = ", ".join("{ " + fault + " }" for fault in faults)
    return play(job(f"faults = [{fault_list}]\n{text}", seed=1, **settings), folder)  # type: ignore[arg-type]


def read_frames(folder: Path) -> list[tuple[int, bytes]]:
    return [(m.cob_id, m.data) for _, _, m in open_log(folder / "trace.mcap").read_messages("/can")]


def emergencies(outcome: Outcome) -> list[str]:
    return [event.text for event in outcome.events if event.kind == "emcy"]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the run without faults."""
    folder = tmp_path_factory.mktemp("sound")
    play(job(seed=1), folder)
    return folder


@pytest.mark.parametrize("fault", [
    *(f'kind = "duplicated", frame = "{frame}", start = 0.05, end = 0.3, every = 3'
      for frame in ("command", "feedback", "valve_state", "drive", "sync")),
    'kind = "jitter", size = 4e-4, start = 0.0',
    'kind = "foreign", start = 0.0, every = 2',
    'kind = "foreign", cob_id = 0x10, frames = 50, start = 0.1, end = 0.2, name = "babbling node"',
])
def test_what_must_not_change_a_run(sound: Path, tmp_path: Path, fault: str) -> None:
    outcome = play_fault(tmp_path, fault)
    assert (outcome.verdict, emergencies(outcome)) == ("PASS", [])
    assert np.array_equal(read_signals(sound), read_signals(tmp_path))
    frames = [Counter(cob_id for cob_id, _ in read_frames(folder)) for folder in (sound, tmp_path)]
    assert frames[0] != frames[1] or "jitter" in fault or "drive" in fault  # drives are doubled inside the plant


@pytest.mark.parametrize(("fault", "node", "code"), [
    ('kind = "lost", frame = "command", start = 0.2, end = 0.22', "node 2 controller", "0x8250"),
    ('kind = "lost", frame = "feedback", start = 0.2, end = 0.22', "node 2 controller", "0x8250"),
    ('kind = "lost", frame = "drive", start = 0.2, end = 0.22', "node 3 plant", "0x8250"),
    ('kind = "lost", frame = "sync", start = 0.1, end = 0.3', "node 2 controller", "0x8100"),
    ('kind = "short", frame = "command", length = 5, start = 0.2, count = 1', "node 2 controller", "0x8210"),
    ('kind = "short", frame = "feedback", length = 0, start = 0.2, count = 1', "node 2 controller", "0x8210"),
    ('kind = "short", frame = "drive", length = 7, start = 0.2, count = 1', "node 3 plant", "0x8210"),
    ('kind = "bus_off", node = "rig", start = 0.1, end = 0.3', "node 2 controller", "0x8100"),
    ('kind = "bus_off", node = "plant", start = 0.1, end = 0.3', "node 2 controller", "0x8250"),
])
def test_what_a_node_must_report(tmp_path: Path, fault: str, node: str, code: str) -> None:
    """Then the rig goes to its safe state; clean-up has current again."""
    outcome = play_fault(tmp_path, fault, text=SAFE)
    reports = emergencies(outcome)
    matches = [text for text in reports if text.startswith(f"{node} {code}")]
    deaf = '"bus_off", node = "rig"' in fault  # the rig did not hear it
    assert outcome.safe and (matches or deaf), reports
    trace = Trace.read(tmp_path, all=True)
    assert np.isfinite(trace.xj[trace.phase == CLEANUP]).all()
    assert trace.com[trace.phase == MAIN].size == 350


def test_a_short_valve_state_is_missing_in_the_log(tmp_path: Path) -> None:
    outcome = play_fault(tmp_path, 'kind = "short", frame = "valve_state", length = 6, start = 0.1, count = 2')
    assert outcome.verdict == "PASS" and np.flatnonzero(np.isnan(Trace.read(tmp_path).xs)).tolist() == [100, 101]


def test_corrupted_feedback_reaches_controller_and_log(sound: Path, tmp_path: Path) -> None:
    outcome = play_fault(tmp_path, 'kind = "corrupted", frame = "feedback", bits = 2, start = 0.1, end = 0.11')
    faulty, right = Trace.read(tmp_path), Trace.read(sound)
    apart = np.flatnonzero((faulty.xj != right.xj) | (faulty.p12 != right.p12))
    assert apart[0] == 100 and outcome.safe is False


@pytest.mark.parametrize(("reset", "command"), [("node", 129), ("communication", 130)])
def test_a_reset_in_mid_run(reset: str, command: int, tmp_path: Path) -> None:
    outcome = play_fault(tmp_path, f'kind = "reset", reset = "{reset}", start = 0.1', text=SAFE)
    assert outcome.safe and read_frames(tmp_path).count((0x000, bytes((command, 2)))) >= 1
    assert any("node 2 controller left OPERATIONAL: boot-up" in event.text for event in outcome.events)
    trace = Trace.read(tmp_path, all=True)
    assert np.any(trace.cor[trace.phase == CLEANUP][30:] != 0.0)
