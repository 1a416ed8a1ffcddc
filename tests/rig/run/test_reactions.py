"""The shipped sequences of a reaction: the reference firmware passes, and a controller that does not react fails."""

from dataclasses import replace
from pathlib import Path

import firmware_variants as variants
import pytest
from firmware_variants import Variant
from rig_command import job, play

from rig.network import GAINS, Frame
from rig.nodes import firmware
from rig.run import Outcome, participants
from rig.sequences import load_sequence

LOSSES = ("lost_command", "lost_feedback", "lost_sync", "lost_heartbeat")


class NoSyncWatch(Variant):
    """Does not notice that SYNC has stopped."""

    def tick(self, t_ns: int) -> None:
        self.firmware.device.sync.configure(0)
        super().tick(t_ns)


class NoHeartbeatWatch(Variant):
    """Does not hear the rig's heartbeat, and so does not watch it."""

    def hear(self, frame: Frame) -> Frame:
        return frame if frame.cob_id != 0x701 else frame._replace(cob_id=0x7FF)


def play_sequence(name: str, folder: Path, **settings: object) -> Outcome:
    return play(replace(job(**settings), sequence=load_sequence(name)), folder)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", [*LOSSES, "reset_in_mid_run"])
def test_the_reference_firmware_reacts_and_recovers(tmp_path: Path, name: str) -> None:
    outcome = play_sequence(name, tmp_path)
    assert (outcome.verdict, outcome.why) == ("PASS", "") and outcome.safe


def test_a_node_that_was_reset_is_watched_as_before(tmp_path: Path) -> None:
    """Supervision of SYNC and heartbeat, its own heartbeat, and the gains, which the run has set."""
    from fdi.trace import open_log

    outcome = play_sequence("reset_in_mid_run", tmp_path, set_={"controller.current_limit": 7e-3})
    log = open_log(tmp_path / "trace.mcap")
    frames = [(message.cob_id, message.data) for _, _, message in log.read_messages("/can")]
    boot = max(k for k, frame in enumerate(frames) if frame == (0x702, b"\0"))
    start = next(k for k in range(boot, len(frames)) if frames[k] == (0x000, b"\x01\x02"))
    writes = {data[1:4]: data for cob_id, data in frames[boot:start] if cob_id == 0x602 and data[0] >> 5 == 1}
    first_writes = {data[1:4]: data for cob_id, data in frames[:boot] if cob_id == 0x602 and data[0] >> 5 == 1}
    assert {int.from_bytes(key[:2], "little") for key in writes} == {0x1006, 0x1016, 0x1017, GAINS}
    assert all(first_writes[key] == data for key, data in writes.items() if key[:2] != b"\x17\x10")
    assert writes[b"\x17\x10\0"][4:6] == (100).to_bytes(2, "little")
    assert outcome.verdict == "PASS"


class StaysOn(Variant):
    """Sends the current on, whatever has happened, and says so in the status word."""

    _current = 0.0

    def answer(self, drive: variants.Drive) -> variants.Drive:
        if drive.status & 7 == 7:
            self._current = drive.current
            return drive
        return drive._replace(current=self._current)


@pytest.mark.parametrize(("name", "target", "value", "failures"), [
    ("lost_command", (firmware, "LOST_AFTER"), 10**9, {"reaction", "emergency"}),
    ("lost_feedback", (firmware, "LOST_AFTER"), 10**9, {"reaction", "emergency"}),
    ("lost_sync", (participants, "Firmware"), NoSyncWatch, {"reaction", "emergency"}),
    ("lost_heartbeat", (participants, "Firmware"), NoHeartbeatWatch, {"emergency"}),
    ("lost_command", (participants, "Firmware"), StaysOn, {"reaction"}),  # a status word alone is no reaction
    ("lost_feedback", (participants, "Firmware"), StaysOn, {"reaction"})])
def test_a_controller_that_does_not_react_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str,
                                                target: tuple[object, str], value: object, failures: set[str]) -> None:
    monkeypatch.setattr(*target, value)
    outcome = play_sequence(name, tmp_path)
    assert outcome.verdict == "FAIL" and failures <= {check.name for check in outcome.checks if not check.passed}
