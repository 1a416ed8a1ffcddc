"""The parts of a session without a bus: time and stage, journal, safe state."""

import pytest

from rig.network.clock import VirtualClock
from rig.recorder import Event
from rig.run.state import Journal, SafeState, Stage


class Loop:
    """A loop at cycle `k` that was given the inputs up to `queued`."""

    def __init__(self, k: int, queued: int) -> None:
        self.k, self.queued, self.words = k, queued, list[int]()

    def now(self) -> int:
        return self.k * 1_000_000

    def override_control(self, word: int) -> None:
        self.words.append(word)


class Recorder:
    """Keeps what is recorded."""

    def __init__(self) -> None:
        self.records: list[tuple[int, str]] = []

    def put(self, t_ns: int, record: object) -> None:
        assert isinstance(record, Event)
        self.records.append((t_ns, record.text))


class Parts:
    """Stage, journal and safe state of a run whose main begins at cycle 50."""

    def __init__(self, k: int = 60, queued: int = 60, tests_safe_state: bool = False) -> None:
        self.stage, self.recorder, self.loop = Stage(VirtualClock(), 50, 1000.0), Recorder(), Loop(k, queued)
        self.stage.loop = self.loop  # type: ignore[assignment]
        self.journal = Journal(self.stage, self.recorder)  # type: ignore[arg-type]
        self.safety = SafeState(self.stage, self.journal, tests_safe_state)


def test_an_event_of_a_queued_cycle_waits_for_it_and_is_dropped_with_it() -> None:
    parts = Parts(k=60, queued=80)
    parts.journal.announce("INFO", "section", "sine")
    assert parts.journal.events == []
    parts.journal.log_due(79, 79_000_000)
    assert parts.journal.events == []
    parts.journal.log_due(80, 80_000_000)
    assert parts.recorder.records == [(80_000_000, "sine")]
    assert [event.t for event in parts.journal.events] == [pytest.approx(0.030)]
    parts.journal.announce("INFO", "section", "ramp")
    parts.loop.queued = 70
    parts.journal.drop_unplayed()
    parts.journal.log_due(1000, 0)
    assert len(parts.journal.events) == 1


@pytest.mark.parametrize(("kind", "tests_safe_state", "ends"), [
    ("emcy", False, True), ("emcy", True, False), ("process", True, True), ("late", True, True)])
def test_trouble_takes_the_current_away_and_ends_main_unless_that_is_tested(
        kind: str, tests_safe_state: bool, ends: bool) -> None:
    parts = Parts(tests_safe_state=tests_safe_state)
    parts.stage.is_watching = parts.stage.is_playing = True
    parts.stage.begun_ns = 1
    parts.safety.handle(kind, "what", 2, 0x8250)
    assert parts.safety.is_safe and parts.loop.words == [0]
    assert (parts.safety.aborted == "what") is ends
    assert [(trouble.kind, trouble.node) for trouble in parts.safety.troubles] == [(kind, 2)]
    assert parts.safety.is_cut_short is (kind == "late")
    parts.safety.handle(kind, "again", 3)
    assert parts.loop.words == [0] and parts.safety.aborted in ("", "what")
