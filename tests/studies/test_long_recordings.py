"""Recordings of any length are made, measured and reported."""
import pytest

from studies.long_recordings import build_long_recordings_report, main, make_command, record_unit


def test_cost_of_recordings() -> None:
    """The table names length, CPU time and memory of each command."""
    costs = [{"command": "compare", "length": 1800.0, "cpu": 46.7, "memory": 1_350_000_000, "verdict": "WITHIN_FLOOR"}]
    report = build_long_recordings_report({"seed": 0, "cpus": 2, "costs": costs})
    assert report.sentence == "1800 s of recording at 1 kHz take 1.35 GB at most."


def test_recordings_repeat_by_their_seed() -> None:
    """A recording is as long as asked for, holds what a bench measures, and is the same for the same seed."""
    com = make_command(15.0, 3)
    assert len(com) == 15_000
    once, again = (record_unit(com[:2000], 3) for _ in range(2))
    assert once.signals == ("com", "xj", "cor", "p12", "xs", "load")
    assert (once.xs == again.xs).all()
    assert (record_unit(com[:2000], 4).xs != once.xs).any()


def test_bad_input_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--lengths", "60,x"]) == 2
    assert "--lengths" in capsys.readouterr().err
