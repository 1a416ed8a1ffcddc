"""Controllers that nobody wrote for this rig: other node numbers, types, transmission, byte order, frames.

Each is written with canopen or cantools, and each closes the same position loop, so each must move the ram alike.
"""

from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest
from bus_stations import only_udp
from device_files import Entry, Mapped, format_eds
from python_devices import CanDevice, CanopenDevice, PythonDevice

from fdi.progress import ignore_progress
from fdi.trace import Trace
from plant import simulate
from rig.benches import Bench, Role
from rig.recorder.convert import export_trace, import_frames
from rig.run import Job, JobChoice, Outcome, bring_up, build_job, participants, run_job

SEQUENCE = """
title = "Two steps"
setup = [{ kind = "hold", time = 0.05 }]
main = [
  { name = "rest", kind = "hold", time = 0.05 },
  { name = "step", kind = "step", to = 2e-3, time = 0.25 },
  { name = "back", kind = "step", to = 0.0, time = 0.25 },
]
cleanup = [{ kind = "hold", time = 0.05 }]
checks = [
  { name = "rest error", kind = "steady_error", window = "step", high = 100, unit = "um" },
]
"""
IDENTITY = {"1000": Entry(7, "ro", "0x1234"), "1018sub0": Entry(5, "const", "4"), "1018sub1": Entry(7, "ro", "0x77"),
            "1018sub2": Entry(7, "ro", "0x5"), "1018sub3": Entry(7, "ro"), "1018sub4": Entry(7, "ro")}
CANOPEN = """
name = "foreign"
[controller]
protocol = "canopen"
node = {node}
eds = "device.eds"
profile = "none"
[controller.inputs]
position_demand = {{ object = "0x2000", count = "{position}" }}
ram_position = {{ object = "0x2001", count = "{position}" }}
[controller.outputs]
current = {{ object = "0x2002", count = "{current}" }}
"""
CAN = """
name = "foreign"
[controller]
protocol = "can"
dbc = "device.dbc"
[controller.inputs]
position_demand = "{demand}"
ram_position = "Feedback.Measured"
[controller.outputs]
current = "Drive.Current"
"""
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: Rig Ecu\n'
FD_DBC = HEAD + """
BO_ 1025 Demand: 12 Rig
 SG_ Position : 7|32@0- (0.0001,0) [0|0] "mm" Ecu

BO_ 1026 Feedback: 20 Rig
 SG_ Measured : 96|64@1- (1,0) [0|0] "m" Ecu

BO_ 1027 Drive: 24 Ecu
 SG_ Current : 151|32@0- (1,0) [0|0] "mA" Rig

BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","StandardCAN_FD";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 100;
BA_DEF_DEF_ "VFrameFormat" "StandardCAN_FD";
BA_DEF_DEF_ "GenMsgCycleTime" 1;
SIG_VALTYPE_ 1026 Measured : 2;
SIG_VALTYPE_ 1027 Current : 1;
"""
PAGES_DBC = HEAD + """
BO_ 2565865476 Feedback: 8 Rig
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" Ecu
 SG_ Start : 4|4@1+ (1,0) [0|0] "" Ecu
 SG_ Measured m2 : 15|24@0- (0.5,0) [0|0] "um" Ecu
 SG_ Position m3 : 39|24@0- (0.5,100) [0|0] "um" Ecu

BO_ 2565865477 Drive: 3 Ecu
 SG_ State : 0|3@1+ (1,0) [0|0] "" Rig
 SG_ Current : 5|13@1- (0.002,0) [0|0] "mA" Rig

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 100;
BA_DEF_DEF_ "GenMsgCycleTime" 1;
"""


def start_canopen(folder: Path, where: str, node: int, types: tuple[int, int, int], rpdos: list[Mapped],
                  tpdos: list[Mapped], position: str, current: str, **device: object) -> PythonDevice:
    objects = {**IDENTITY, "2000": Entry(types[0]), "2001": Entry(types[1]), "2002": Entry(types[2], "ro"),
               "2003": Entry(3)}
    (folder / "device.eds").write_text(format_eds(objects, rpdos, tpdos))
    (folder / "bench.toml").write_text(CANOPEN.format(node=node, position=position, current=current))
    return CanopenDevice(where, node, str(folder / "device.eds"), **device)  # type: ignore[arg-type]


def start_event_driven(folder: Path, where: str) -> PythonDevice:
    """REAL32 in mm, both values in one event-driven RPDO; node 100 answers it with a REAL64."""
    return start_canopen(
        folder, where, 100, (8, 8, 17), [Mapped((0x2000_0020, 0x2001_0020), "$NODEID+0x400", 255)],
        [Mapped((0x2002_0040,), "$NODEID+0x380", 255)], "1 mm", "1 mA", on=0x464,
        inputs={0x464: ("<ff", {"position_demand": 1e-3, "ram_position": 1e-3})}, output=(0x3E4, "<d", 1e-3))


def start_synchronous(folder: Path, where: str) -> PythonDevice:
    """INTEGER16 and INTEGER32 in synchronous RPDOs, beside an object that the bench does not use; node 1.

    The COB-ID of its TPDO is in the range of another node.
    """
    return start_canopen(
        folder, where, 1, (3, 4, 3), [Mapped((0x2003_0010, 0x2000_0010), "$NODEID+0x200", 1),
                                      Mapped((0x2001_0020,), "$NODEID+0x300", 0)],
        [Mapped((0x2002_0010,), "0x1F3", 1)], "0.5 um", "1 uA",
        inputs={0x201: ("<hh", {"unused": 1.0, "position_demand": 0.5e-6}), 0x301: ("<i", {"ram_position": 0.5e-6})},
        output=(0x1F3, "<h", 1e-6))


def start_every_second(folder: Path, where: str) -> PythonDevice:
    """The drive comes with every second SYNC (transmission type 2), with COB-IDs outside the predefined set."""
    return start_canopen(
        folder, where, 64, (4, 4, 4), [Mapped((0x2000_0020, 0x2001_0020), "0x123", 1)],
        [Mapped((0x2002_0020,), "0x240", 2)], "0.1 um", "10 nA", every=2,
        inputs={0x123: ("<ii", {"position_demand": 1e-7, "ram_position": 1e-7})}, output=(0x240, "<i", 1e-8))


def start_can_fd(folder: Path, where: str) -> PythonDevice:
    """CAN FD frames of 12 to 24 bytes, a Motorola integer, an Intel double and a Motorola float."""
    (folder / "device.dbc").write_text(FD_DBC)
    (folder / "bench.toml").write_text(CAN.format(demand="Demand.Position"))
    text = FD_DBC.replace("(0.0001,0)", "(0.0000001,0)")  # in m, as the other
    return CanDevice(where, text, "Feedback", 1.0, 1e-3, fd=True)


STARTED = """
[controller.phases]
"Feedback.Start" = { PHASES, cleanup = 0 }
[controller.ready]
"Drive.State" = 5
"""


def start_multiplexed(folder: Path, where: str, phases: str = "setup = 1, main = 2") -> PythonDevice:
    """29-bit identifiers, 24-bit Motorola values on two pages, a 13-bit Intel current; set-up starts it."""
    (folder / "device.dbc").write_text(PAGES_DBC)
    (folder / "bench.toml").write_text(CAN.format(demand="Feedback.Position") + STARTED.replace("PHASES", phases))
    return CanDevice(where, PAGES_DBC, "Feedback", 1e-6, 1e-3)


def start_by_main(folder: Path, where: str) -> PythonDevice:
    """The same; it is ready once main has enabled it."""
    return start_multiplexed(folder, where, "setup = 0, main = 3")


DEVICES = [start_event_driven, start_synchronous, start_every_second, start_can_fd, start_multiplexed]
# on a CAN interface the examples have identifiers of 11 and of 29 bits (tests/vcan)
CASES = [*((start, "udp_multicast", True) for start in DEVICES), (start_can_fd, "socketcan", True),
         *((start, "udp_multicast", False) for start in (start_every_second, start_multiplexed)),
         (start_by_main, "udp_multicast", True)]


def play(folder: Path, where: str, device: PythonDevice, seed: int = 0) -> tuple[Job, Outcome]:
    """Two steps in lockstep with that device as controller, on the bench file of the folder."""
    (folder / "steps.toml").write_text(SEQUENCE)
    job = build_job(JobChoice(str(folder / "steps.toml"), bench=str(folder / "bench.toml"), bus=where, seed=seed))
    device.start()
    try:
        return job, run_job(job, folder / "run", ignore_progress, lambda: False)
    finally:
        device.close()


@pytest.mark.parametrize(("start", "bus_kind", "is_compiled"), CASES, indirect=["bus_kind"],
                         ids=lambda value: getattr(value, "__name__", str(value)).removeprefix("start_"))
def test_a_foreign_controller_closes_the_loop(start: Callable[[Path, str], PythonDevice], is_compiled: bool, where: str,
                                              tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ram moves as a simulation of the same law does, whatever frames carry demand, position and current."""
    if not is_compiled:  # as on a bus that only python-can knows
        monkeypatch.setattr(bring_up, "can_open", lambda spec: False)
    job, outcome = play(tmp_path, where, start(tmp_path, where), seed=3)
    assert outcome.verdict == "PASS", outcome.why
    trace = Trace.read(tmp_path / "run")
    law = simulate(job.model, trace.com, seed=3)
    difference = float(np.sqrt(np.nanmean((trace.xj - law.xj) ** 2)))
    # 60 um of 2 mm: one more cycle of delay, coarser counts
    assert difference < 60e-6 and not np.isnan(trace.cor[5:]).any()
    require_same_columns_from_a_capture(tmp_path, job.bench, trace)


def require_same_columns_from_a_capture(folder: Path, bench: Bench, trace: Trace) -> None:
    """`rig import --bench`: the frames of the run alone, as another tool would have captured them, give its columns."""
    export_trace(folder / "run" / "trace.mcap", folder / "capture.log")
    import_frames(folder / "capture.log", folder / "capture.mcap", bench)
    capture = Trace.read(folder / "capture.mcap", all=True)
    starts = range(len(capture.xj) - len(trace.xj) + 1)  # the capture has the cycles before and after the run too
    begin = [k for k in starts if np.allclose(capture.xj[k:k + len(trace.xj)], trace.xj, rtol=0.0, atol=1e-9)]
    assert len(begin) == 1
    rows = slice(begin[0], begin[0] + len(trace.xj))
    np.testing.assert_allclose(capture.com[rows], trace.com, rtol=0.0, atol=1e-9)
    is_answered = ~np.isnan(capture.cor[rows])  # the run keeps the last current, a capture has what came
    assert is_answered.mean() > 0.49
    np.testing.assert_allclose(capture.cor[rows][is_answered], trace.cor[is_answered], rtol=0.0, atol=1e-9)


class Mute(CanDevice):
    """It answers so many frames; those behind have so many bytes, or do not come."""

    def __init__(self, where: str, answers: int, length: int) -> None:
        super().__init__(where, PAGES_DBC, "Feedback", 1e-6, 1e-3)
        self._left, self._length = answers, length

    def take(self, message: can.Message) -> list[can.Message]:
        answers = super().take(message)
        self._left -= len(answers)
        return answers if self._left >= 0 else [
            can.Message(arbitration_id=each.arbitration_id, data=each.data[:self._length])
            for each in answers if self._length]


@only_udp
@pytest.mark.parametrize(("answers", "length", "message"), [
    (0, 0, "controller: no frame Drive (0x18F00005) for 5 cycles"), (1080, 0, "controller stopped answering"),
    (0, 2, "no valid frame Drive (0x18F00005) for 5 cycles: the last that came had 2 bytes, not 3"),
    (1080, 2, "it sends no valid frames: the last that came had 2 bytes, not 3"),
])
def test_a_controller_that_sends_no_frames_ends_the_run_with_a_line_that_names_them(
    answers: int, length: int, message: str, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(participants, "FRAME_TIMEOUT", 0.2)  # s: it is spent in each cycle without an answer
    (tmp_path / "device.dbc").write_text(PAGES_DBC)
    (tmp_path / "bench.toml").write_text(CAN.format(demand="Feedback.Position"))
    _, outcome = play(tmp_path, where, Mute(where, answers, length))
    assert (outcome.verdict, outcome.status) == ("ABORTED", 1)
    assert message in outcome.why and "frame Drive (0x18F00005)" in outcome.aborted
    assert outcome.attribution.cause is not None and outcome.attribution.cause.source is Role.CONTROLLER


class Forgetful(CanopenDevice):
    """It keeps a part of its current over a reset: what it has answered so far counts on."""

    def take(self, message: can.Message) -> list[can.Message]:
        answers = super().take(message)
        self._kept = getattr(self, "_kept", 0.0) + 1e-4 * bool(answers)
        self._output = (*self._output[:2], 1e-6 / (1.0 + self._kept))
        return answers


@only_udp
@pytest.mark.parametrize(("device", "failures"), [(CanopenDevice, []), (Forgetful, ["same answers after a reset"])])
def test_a_controller_that_remembers_over_a_reset_fails(device: type[CanopenDevice], failures: list[str], where: str,
                                                        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The probes are played by the roles of the frames, on a bench without control word and without phases."""
    monkeypatch.setitem(globals(), "CanopenDevice", device)
    _, outcome = play(tmp_path, where, start_synchronous(tmp_path, where))
    assert [check.name for check in outcome.checks if not check.passed] == failures
    assert "delay of the answer to a step" in [check.name for check in outcome.checks]
