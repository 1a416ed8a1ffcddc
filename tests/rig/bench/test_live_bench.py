"""`rig bench live`: its runs are shown in a terminal, and its ratios are what they say."""
from __future__ import annotations

import json
import os

import numpy as np
import pytest
from answer_schemas import check_answer
from rig_command import rig

from fdi.report.json import to_json
from fdi.report.terminal import format_report
from plant.errors import RigError
from rig.bench.live import (
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
    check_answer(["bench", "live"], json.loads(to_json(figures)))


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


@pytest.mark.parametrize("words", [("--bus", "virtual:x"), ("--blocks", 0), ("--seconds", 1)])
def test_bad_input_is_one_line(words: tuple[object, ...]) -> None:
    said = rig("bench", "live", *words)
    assert said.status == 2 and words[0] in said.err and said.err.count("\n") == 1
