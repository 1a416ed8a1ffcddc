"""The job of a run, and its sequencer: phases in order, clean-up always, no current in the safe state, what is told."""

import json
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from refusals import catch_refusal
from rig_command import SHORT, act_at, job, kinds, play, read_signals, rig, stop_after

from fdi.progress import ignore_progress
from fdi.report import Line, Table, build_run_report, write_run_page
from fdi.trace import MAIN, Trace, open_log
from fdi.trace.trace import CLEANUP, SETUP
from plant import RigError
from plant.effects import CATALOGUE
from rig.network import EmbeddedWire, Frame, Send, VirtualClock
from rig.nodes import Emulator, Firmware
from rig.recorder import Recorder, RecorderError, Signals, Timing
from rig.run import NodeProcesses, Session, participants, read_job, runner
from rig.sequences import parse_sequence

SAFE = SHORT + 'ends = "safe_state"\n'


def with_faults(text: str, *faults: str) -> str:
    return f"faults = [{', '.join('{ ' + fault + ' }' for fault in faults)}]\n" + text


THREE_LOST = 'name = "cut", kind = "lost", frame = "drive", start = 0.2, count = 3'


def phases(folder: Path) -> list[int]:
    """Number of cycles of set-up, main and clean-up in the log."""
    trace = Trace.read(folder, all=True)
    return [int((trace.phase == phase).sum()) for phase in (SETUP, MAIN, CLEANUP)]


def test_three_phases_in_order(tmp_path: Path) -> None:
    outcome = play(job(), tmp_path)
    assert outcome.verdict == "PASS" and not outcome.safe and phases(tmp_path) == [50, 350, 50]
    assert [text for kind, text in kinds(outcome) if kind in ("phase", "section")] == [
        "bring-up", "setup", "setup: hold_1", "main", "main: rest", "main: step", "main: back", "cleanup",
        "cleanup: ramp_1", "end"]
    times = {text: event.t for event in outcome.events for text in [event.text]}
    assert (times["main"], times["main: step"], times["cleanup"]) == pytest.approx((0.0, 0.05, 0.35))
    assert outcome.counters == dict.fromkeys(outcome.counters, 0) and outcome.timing["cycles"] == 450
    words = control_words(tmp_path)  # the drive is enabled step by step
    assert words[:4] == [1, 3, 7, 7] and set(words[2:]) == {7}


def control_words(folder: Path) -> list[int]:
    return [message.control for _, _, message in open_log(folder / "trace.mcap").read_messages("/signals")]


def test_a_guard_ends_main_and_clean_up_runs(tmp_path: Path) -> None:
    text = SHORT + 'guards = [{ name = "too far", signal = "xj", high = 0.5, unit = "mm" }]'
    outcome = play(job(text), tmp_path)
    assert (outcome.verdict, outcome.status) == ("ABORTED", 1) and outcome.aborted == "guard 'too far' was passed by xj"
    setup, main, cleanup = phases(tmp_path)
    assert (setup, cleanup) == (50, 50) and 50 < main < 100
    trace = Trace.read(tmp_path, all=True)
    assert trace.com[trace.phase == CLEANUP][0] == trace.com[trace.phase == MAIN][-1]  # from where it was


@pytest.mark.parametrize("questions", [0, 2, 8])
def test_the_operator_ends_it(tmp_path: Path, questions: int) -> None:
    """Cycles that are played together are too few for the operator to wait: they end at the next heartbeat."""
    outcome = play(job(), tmp_path, stop_after(questions))
    assert (outcome.verdict, outcome.status, outcome.interrupted) == ("ABORTED", 130, True)
    setup, main, cleanup = phases(tmp_path)
    assert questions < setup + main <= 100 * questions + 1 and cleanup == 50
    assert ("operator", "stopped by the operator") in kinds(outcome)


def test_trouble_is_the_safe_state_and_ends_main(tmp_path: Path) -> None:
    """Three drive frames lost: EMCY of the plant, no current, clean-up with current again once all is well."""
    outcome = play(job(with_faults(SHORT, THREE_LOST)), tmp_path)
    assert outcome.verdict == "ABORTED" and outcome.safe and "node 3 plant 0x8250" in outcome.aborted
    setup, main, cleanup = phases(tmp_path)
    assert (setup, cleanup) == (50, 50) and 200 < main < 210
    assert not {check.name: check.passed for check in outcome.checks}["no emergency"]
    assert outcome.counters["plant_drive_missing"] == 3


def test_the_page_has_a_section_for_the_first_cause(tmp_path: Path) -> None:
    """With time and evidence, and what followed; a run without trouble has no such section."""
    title = "First cause and consequences"
    outcome = play(job(with_faults(SHORT, 'kind = "lost", frame = "feedback", start = 0.2')), tmp_path)
    sections = {section.title: section for section in build_run_report(Trace.read(tmp_path, all=True)).sections}
    texts = [item.text for item in sections[title].items if isinstance(item, Line)]
    cause = outcome.to_json()["cause"]
    assert any(cause["text"] in text and f"{cause['t']:.3f} s" in text for text in texts)
    rows = [row for item in sections[title].items if isinstance(item, Table) for row in item.rows]
    assert [row[2] for row in rows] == [each["text"] for each in outcome.to_json()["consequences"]] and len(rows) > 0
    write_run_page(tmp_path, tmp_path / "p.html")
    assert title in (tmp_path / "p.html").read_text()
    play(job(), tmp_path / "sound")
    write_run_page(tmp_path / "sound", tmp_path / "q.html")
    assert title not in (tmp_path / "q.html").read_text()


def test_a_sequence_may_be_about_trouble(tmp_path: Path) -> None:
    outcome = play(job(with_faults(SAFE.replace('{ name = "no emergency", kind = "event_never", event = "EMCY" }',
                                                '{ name = "told", kind = "response_within", after = "cut", '
                                                'event = "EMCY 0x8250", high = 5.0, unit = "ms" }'), THREE_LOST)),
                   tmp_path)
    assert outcome.verdict == "PASS" and outcome.safe and phases(tmp_path) == [50, 350, 50]
    words = control_words(tmp_path)
    zero = words.index(0)
    assert set(words[zero:400]) == {0} and words[400] == 8 and set(words[401:]) == {7}  # reset, then current again
    assert np.all(Trace.read(tmp_path).cor[zero - 50 + 1:] == 0)


def test_a_meant_end_that_does_not_come_is_a_failure(tmp_path: Path) -> None:
    outcome = play(job(SAFE), tmp_path)
    assert (outcome.verdict, outcome.status) == ("FAIL", 1)
    assert outcome.failures == ["the run did not end in the safe state"]


@pytest.mark.parametrize(("node", "says"), [("rig", "0x8130"), ("plant", ", although its other frames come")])
def test_a_heartbeat_that_stops(tmp_path: Path, node: str, says: str) -> None:
    text = SHORT.replace("time = 0.2 }", "time = 1.2 }")
    outcome = play(job(with_faults(text, f'kind = "heartbeat", node = "{node}", start = 0.1')), tmp_path)
    assert outcome.verdict == "ABORTED" and says in outcome.aborted and phases(tmp_path)[2] == 50
    assert ("fault", f"heartbeat {node} begins") in kinds(outcome)


class Intruder:
    """A stranger on the bus who at 0.25 s sends something."""

    def __init__(self, send: Send, frames: list[tuple[int, bytes]]) -> None:
        self.send, self.frames = send, list(frames)

    def receive(self, frame: Frame) -> None: ...

    def tick(self, t_ns: int) -> None:
        while t_ns >= 250_000_000 and self.frames:
            self.send(*self.frames.pop(0))


def play_with_intruder(folder: Path, frames: list[tuple[int, bytes]]) -> Session:
    one, wire = job(), EmbeddedWire(VirtualClock(), [Emulator, Firmware, partial(Intruder, frames=frames)])
    with runner.open_recorder(one, folder) as recorder:
        session = Session(one, wire, NodeProcesses(), recorder, ignore_progress, lambda: False)
        session.bring_up()
        session.run_phases()
    return session


@pytest.mark.parametrize(("frames", "why"), [
    ([(0x080, b"")], "another node sends 0x080"),
    ([(0x202, bytes(8))], "another node sends 0x202"),
    ([(0x000, b"\x80\x02")], "another node sends 0x000"),
    ([(0x702, b"\0")], "node 2 controller left OPERATIONAL: boot-up"),
    ([(0x703, b"\x7f")], "node 3 plant left OPERATIONAL: pre-operational"),
    ([(0x082, bytes.fromhex("3023010000000000"))], "node 2 controller 0x2330 (EMCY)"),
])
def test_strangers_and_nodes_that_restart_end_main(tmp_path: Path, frames: list[tuple[int, bytes]], why: str) -> None:
    assert play_with_intruder(tmp_path, frames).safety.aborted.startswith(why) and phases(tmp_path)[2] == 50


def test_noise_of_strangers_is_nothing(tmp_path: Path) -> None:
    """Foreign nodes, short frames, unknown identifiers: logged as frames, else ignored."""
    noise = [(cob_id, bytes(length)) for cob_id in (0x084, 0x184, 0x284, 0x584, 0x604, 0x704, 0x7E5, 0x082, 0x083,
                                                    0x583, 0x603) for length in (0, 3)]
    assert play_with_intruder(tmp_path, noise).safety.aborted == "" and phases(tmp_path) == [50, 350, 50]


@pytest.mark.parametrize("error", [RigError("the bus is gone"), RuntimeError("a bug"), KeyboardInterrupt()])
def test_whatever_is_raised_clean_up_runs_and_the_log_is_whole(tmp_path: Path, error: BaseException) -> None:
    threads = threading.active_count()
    with pytest.raises(type(error)):
        play(job(), tmp_path, act_at(5, Mock(side_effect=error)))
    setup, main, cleanup = phases(tmp_path)
    assert (setup, cleanup) == (50, 50) and 1 < main < 250
    assert Trace.read(tmp_path, all=True).events[-1].text == "end"
    assert threading.active_count() == threads and not (tmp_path / "verdict.json").exists()


def test_a_log_that_cannot_be_written_is_told_after_clean_up(tmp_path: Path) -> None:
    """The disk goes away in mid run."""
    text = SHORT.replace("time = 0.2 }", "time = 2.0 }")
    with pytest.raises(RecorderError, match="deleted"):
        play(job(text), tmp_path, act_at(5, (tmp_path / "trace.mcap").unlink))


def test_a_load_that_no_node_takes_is_bad_input(tmp_path: Path) -> None:
    """White noise does not compress: said before a word is sent, and not as "out of memory"."""
    rows = "\n".join(f"{k / 1000:.3f},{value:.3f}" for k, value in enumerate(np.random.default_rng(0).uniform(
        -1e6, 1e6, 250_000)))
    text = 'title = "x"\nmain = [{ kind = "hold", time = 250 }]\nload = [{ kind = "csv", file = "x.csv" }]'
    sequence = parse_sequence(text, "x.toml", lambda name: f"t,value\n{rows}\n".encode())
    assert "KiB compressed" in catch_refusal(play, replace(job(), sequence=sequence), tmp_path)


def test_a_node_that_sends_nothing_but_emergencies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """20,000 of them: the verdict stays small and counts them, the log has them all."""
    class BusyFirmware(Firmware):
        def __init__(self, send: Send, **more: Any) -> None:
            super().__init__(send, **more)
            drive = self.device.on_sync

            def on_sync() -> None:
                drive()
                for code in range(0x5000, 0x5032):
                    send(0x082, code.to_bytes(2, "little") + bytes(6))

            self.device.on_sync = on_sync

    monkeypatch.setattr(participants, "Firmware", BusyFirmware)
    outcome = play(job(SAFE), tmp_path)
    assert (tmp_path / "verdict.json").stat().st_size < 100_000
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    emergency_count = sum(event.kind == "emcy" for event in outcome.events)
    assert emergency_count >= 20_000 and verdict["events_omitted"]["emcy"] == emergency_count - 200
    trace = Trace.read(tmp_path, all=True)
    assert sum(event.kind == "emcy" for event in trace.events) == emergency_count
    write_run_page(tmp_path / "trace.mcap", tmp_path / "p.html")
    assert (tmp_path / "p.html").stat().st_size < 2_000_000


def make_reluctant(make: Callable[..., Any], node: int, delay_ns: int) -> Callable[..., Any]:
    """A node that becomes OPERATIONAL only some time after it was told to."""
    def build(send: Send, **more: Any) -> Any:
        one, waiting = make(send, **more), list[tuple[int, Frame]]()
        receive, tick = one.receive, one.tick

        def delay(frame: Frame) -> None:
            if (frame.cob_id, frame.data) == (0, bytes((1, node))):
                waiting.append((frame.t_ns + delay_ns, frame))
            else:
                receive(frame)

        def wait(t_ns: int) -> None:
            while waiting and waiting[0][0] <= t_ns:
                receive(waiting.pop(0)[1])
            tick(t_ns)

        one.receive, one.tick = delay, wait
        return one

    return build


@pytest.mark.parametrize(("delay", "verdict"), [(0.03, "PASS"), (0.3, "PASS"), (1.5, "ABORTED"), (9.0, "ABORTED")])
def test_bring_up_waits_until_the_nodes_are_operational(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, delay: float,
                                                        verdict: str) -> None:
    monkeypatch.setattr(participants, "Firmware", make_reluctant(Firmware, 2, round(delay * 1e9)))
    outcome = play(job(), tmp_path)
    assert outcome.verdict == verdict, outcome.why
    if delay < 3:  # three times the limit
        assert outcome.start_times[2] == pytest.approx(delay, abs=0.012)  # a heartbeat every 10 ms
    if verdict == "ABORTED":
        assert "node 2 controller must be OPERATIONAL within 1 s of NMT start" in outcome.why
        assert outcome.to_json()["cause"]["source"] == "node 2 controller" and set(control_words(tmp_path)) == {0}


def test_a_bench_that_is_late_in_bring_up_is_not_the_controllers_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both nodes come late: the machine stood still, or the bus did."""
    monkeypatch.setattr(participants, "Firmware", make_reluctant(Firmware, 2, 1_500_000_000))
    monkeypatch.setattr(participants, "Emulator", make_reluctant(Emulator, 3, 1_400_000_000))
    outcome = play(job(), tmp_path)
    assert (outcome.verdict, outcome.status) == ("INVALID_TIMING", 3)
    assert "the bench was late in bring-up: both nodes must be OPERATIONAL" in outcome.why
    assert outcome.to_json()["cause"]["source"] == "bench" and set(control_words(tmp_path)) == {0}


def test_who_the_nodes_are(tmp_path: Path) -> None:
    outcome = play(job(SHORT + '[firmware]\nname = "EHA controller"\nproduct = 2\n'), tmp_path)
    nodes = outcome.to_json()["nodes"]
    assert outcome.verdict == "PASS" and nodes["2"]["identity"]["product"] == 2
    assert nodes["3"]["identity"]["name"] == "EHA plant emulator" and nodes["2"]["operational_ms"] > 0
    assert Trace.read(tmp_path).provenance["node2.name"] == "EHA controller"
    assert any(kind == "identity" and "node 2 controller: device type" in text for kind, text in kinds(outcome))


def test_another_firmware_than_the_sequence_asks_for_is_refused(tmp_path: Path) -> None:
    message = catch_refusal(play, job(SHORT + "[firmware]\nproduct = 7\n"), tmp_path)
    assert "firmware.product: expected 0x00000007, but the controller has 0x00000002" in message


def test_too_many_overruns_in_a_row_end_main(tmp_path: Path) -> None:
    """The policy "abort", with limits that no machine keeps: the controller is not judged, the status is 3."""
    text = SHORT + '[timing]\noverruns = "abort"\ntolerate = 5\nsync = 1e-9\ngrace = 0.0\n'
    outcome = play(job(text, pace="realtime", max_overruns=1.0), tmp_path)
    assert (outcome.verdict, outcome.status) == ("INVALID_TIMING", 3)
    assert "overruns in a row, limit 5" in outcome.why
    assert phases(tmp_path)[1] == 0 and outcome.to_json()["judged"]["judged"] == 0


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


def same(a: Path, b: Path) -> bool:
    return np.array_equal(read_signals(a), read_signals(b), equal_nan=True)


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
    result = rig("run", origin / "faulty.toml", "--effects", origin / "creep.py", "--seed", 3, "--quiet", "--out",
                 tmp_path / "a", "--set", "creep.rate=1e-4")
    assert result.status == 0, result
    for path in origin.iterdir():
        path.unlink()
    del CATALOGUE["creep"]
    result = rig("run", "--from", tmp_path / "a" / "trace.mcap", "--trust", "--quiet", "--out", tmp_path / "b")
    assert result.status == 0, result
    # and the effect did something
    assert same(tmp_path / "a", tmp_path / "b") and abs(Trace.read(tmp_path / "a").cor[-20:].mean()) > 1e-5


def test_two_effect_files_of_one_name_are_refused(tmp_path: Path) -> None:
    """The log keeps them by name; one would be lost."""
    for folder, name in (("a", "creep"), ("b", "crawl")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(EFFECT.replace("creep", name))
    result = rig("run", "--effects", tmp_path / "a" / "mine.py", "--effects", tmp_path / "b" / "mine.py", "--out",
                 tmp_path / "out")
    assert result.status == 2 and "mine.py" in result.err and len(result.err.splitlines()) == 1


@pytest.mark.parametrize("missing", ["seed", "model.toml"])
def test_a_log_without_what_decides_is_refused(tmp_path: Path, missing: str) -> None:
    attachments = {} if missing == "model.toml" else {"model.toml": ("", b""), "sequence/x.toml": ("", b"")}
    with closing(Recorder(tmp_path / "trace.mcap", attachments, {"period": "0.001"})) as recorder:
        recorder.cycle(0, Signals(0, 1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0), Timing(0, False, 0.0, 0.0, 0.0))
    assert "only logs of `rig run`" in catch_refusal(read_job, tmp_path / "trace.mcap")


def test_bus_and_pace_may_be_asked_for_anew(tmp_path: Path) -> None:
    play(job(seed=4), tmp_path / "a")
    result = rig("run", "--from", tmp_path / "a" / "trace.mcap", "--pace", "realtime", "--max-overruns", 1, "--json",
                 "--out", tmp_path / "b")
    assert result.json["run"]["pace"] == "realtime" and result.json["run"]["seed"] == 4
    assert same(tmp_path / "a", tmp_path / "b")
