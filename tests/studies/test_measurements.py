"""The live screen's cost is told from noise, and recordings of any length are made, measured and reported."""

import os
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from fdi.report.terminal import format_report
from plant.errors import RigError
from studies import live_screen, long_recordings
from studies.live_screen import (
    AGAIN,
    LIVE,
    WITHOUT,
    build_live_runs_report,
    compare_contenders,
    describe_ratios,
    play_run,
    run_in_terminal,
    summarise_live_runs,
)
from studies.long_recordings import build_long_recordings_report, make_command, record_unit


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


GROUP = f"udp_multicast:239.75.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"


def invent_block(rng: np.random.Generator, factor: float) -> dict[str, np.ndarray]:
    """Times of 1000 cycles, whose blocks scatter by 5 %."""
    scale = factor * float(np.exp(0.05 * rng.standard_normal()))
    times = {name: scale * rng.gamma(4.0, 1e-5, 1000) for name in ("lateness", "response", "feedback_response")}
    return {**times, "overrun": np.zeros(1000, bool)}


def test_a_slower_run_is_found_and_noise_is_none() -> None:
    rng = np.random.default_rng(1)
    found = {WITHOUT: [invent_block(rng, 1.0) for _ in range(8)], AGAIN: [invent_block(rng, 1.0) for _ in range(8)],
             LIVE: [invent_block(rng, 1.5) for _ in range(8)]}
    figures = summarise_live_runs(found)
    words = {(ratio["contender"], ratio["word"]) for ratio in figures["ratios"]}
    assert words == {(AGAIN, "no difference found"), (LIVE, "slower")}
    assert all(ratio["low"] < 1.5 < ratio["high"] for ratio in figures["ratios"] if ratio["contender"] == LIVE)
    assert "lateness p99 slower with --live (1." in describe_ratios(figures["ratios"])
    assert figures["cycles"] == {WITHOUT: 8000, AGAIN: 8000, LIVE: 8000}
    figures |= {"bus": GROUP, "seconds": 8.0, "blocks": 8, "cpus": 2, "priority": 0, "missing": {},
                "ended_early": {WITHOUT: 0, AGAIN: 0, LIVE: 1}}
    text = format_report(build_live_runs_report(figures))
    assert "no real-time priority" in text and "--live: 1" in text and "slower" in text


def test_few_blocks_and_missing_answers_are_not_known() -> None:
    block = {"p50": 10.0, "p99": 20.0}
    ratios = compare_contenders({name: {WITHOUT: [block] * 3, AGAIN: [block] * 3, LIVE: [{}] * 3}
                                 for name in ("lateness", "response", "feedback_response")})
    assert {ratio["word"] for ratio in ratios} == {"not known"}
    assert [ratio["ratio"] for ratio in ratios if ratio["contender"] == AGAIN] == [1.0] * 6
    assert "--blocks 4 or more" in describe_ratios(ratios)


def test_a_run_is_shown_and_measured() -> None:
    with pytest.raises(RigError, match=r"ended with status 2: rig run: .*--jobs"):
        play_run(GROUP, 1.0, ("--jobs", "0"))
    for _ in range(3):  # a busy machine may end a run before an answer came
        times = play_run(GROUP, 1.0, ("--live",))
        assert len(times["lateness"]) == len(times["feedback_response"]) == len(times["overrun"])
        answered = np.isfinite(times["feedback_response"])
        if answered.any():
            assert times["feedback_response"][answered].min() > 0.0
            return
    pytest.skip("not measured: this machine ended three runs before an answer came")


def test_the_terminal_is_one() -> None:
    status, text = run_in_terminal(["sh", "-c", "stty size; test -t 2 && exit 5"])
    assert (status, text.split()) == (5, ["40", "120"])


@pytest.mark.parametrize(("main", "words", "says"), [
    (live_screen.main, ("--bus", "virtual:x"), "--bus"), (live_screen.main, ("--blocks", "0"), "--blocks"),
    (live_screen.main, ("--seconds", "1"), "--seconds"), (long_recordings.main, ("--lengths", "60,x"), "--lengths")])
def test_bad_input_is_one_line(main: Callable[[Sequence[str]], int], words: Sequence[str], says: str,
                               capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert says in capsys.readouterr().err
