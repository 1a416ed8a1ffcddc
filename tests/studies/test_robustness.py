"""The robustness study in small: the same code as `python -m studies.robustness`, with fewer frames and runs."""

import pytest

from studies.robustness.disturb import disturb_run, find_processes, judge_verdict
from studies.robustness.fuzz import invent_frames
from studies.robustness.run_study import build_robustness_report, run_study

LIMIT = 600.0  # s: it only ends a test that hangs


def test_a_seed_gives_the_same_frames_again() -> None:
    frames = list(invent_frames(5000, 3))
    assert frames[:500] == list(invent_frames(500, 3)) != list(invent_frames(500, 4))
    assert 400 < sum(frame.cob_id == 0x080 and not frame.data for frame in frames) < 900
    assert {len(frame.data) for frame in frames} == set(range(9))
    assert len({frame.cob_id for frame in frames}) > 300


@pytest.mark.parametrize(("victim", "seed"), [("plant", 13), ("rig", 15)])  # soon after the first cycles
def test_a_killed_process(victim: str, seed: int) -> None:
    trial = disturb_run("kill", victim, seed, limit=LIMIT)
    assert trial.problems == () and trial.cycles > 0, trial


GONE = "ABORTED node 3 plant stopped answering: no feedback frame since cycle 9; "


@pytest.mark.parametrize(("action", "victim", "pause", "status", "said", "is_sound"), [
    ("kill", "plant", 0.0, 1, f"{GONE}its process was ended by SIGKILL", True),
    ("kill", "plant", 0.0, 1, f"{GONE}no heartbeat any more: last heartbeat 0.30 s ago", False),
    ("kill", "controller", 0.0, 1, f"{GONE}its process was ended by SIGKILL", False),  # the wrong node
    ("kill", "plant", 0.0, 0, "PASS", False),
    ("stop", "plant", 0.9, 0, "PASS", True),
    ("stop", "plant", 0.9, 1, f"{GONE}no heartbeat for 2.1 s either", False),
    ("stop", "plant", 3.1, 1, f"{GONE}no heartbeat for 2.1 s either", True),
    ("stop", "plant", 3.1, 0, "PASS", False),
    ("stop", "rig", 3.1, 0, "PASS", True),
    ("stop", "rig", 0.9, 2, "rig run: the turn to send was held for more than 1 s by process 7", True),
])
def test_what_the_verdict_of_a_disturbed_run_must_be(action: str, victim: str, pause: float, status: int, said: str,
                                                     is_sound: bool) -> None:
    assert (judge_verdict(action, victim, pause, status, said) == []) == is_sound


def test_a_log_that_cannot_be_written() -> None:
    trial = disturb_run("fill disk", "rig", 12, limit=LIMIT)
    assert trial.problems == () and trial.status == 2 and "log" in trial.message, trial


def test_the_study_as_a_whole() -> None:
    """Fuzz frames into both nodes and the rig, datagrams on the bus, changed logs, and runs one after the other.

    Some of the changed logs are still good enough to be read; the others are refused, and nothing else happens.
    """
    figures = run_study(2000, 0, 0.01, 1, "builtin", lambda stage, share: None)
    assert figures["problems"] == [] and figures["soak"]["verdicts"] == {"PASS": figures["soak"]["runs"]}
    assert [count["works"] and count["frames"] >= 2000 for count in figures["frames"]] == [True] * 3
    assert min(count["answers"] for count in figures["frames"][:2]) > 40
    assert max(figures["datagrams"]["growth"].values()) < 16 << 20
    accepted, refused = figures["logs"]["accepted"], figures["logs"]["refused"]
    assert accepted["recover"] > 0 and accepted["report"] + refused["report"] == 2
    report = build_robustness_report(figures)
    assert report.verdict == "PASS" and len(report.sections) == 4
    assert not find_processes("239.1.1.1")
    assert build_robustness_report({**figures, "problems": ["it hung"]}).verdict == "FAIL"
