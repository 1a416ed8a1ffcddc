"""Short sequences as text, and what it takes to play one in a test."""

from collections.abc import Callable
from pathlib import Path

import pytest

from fdi.progress import ignore_progress
from plant import load_model
from rig.network import master
from rig.run.job import Job
from rig.run.runner import Outcome, run_job
from rig.sequences.sequence import parse_sequence

SHORT = """
title = "A short one"
setup = [{ kind = "hold", time = 0.05 }]
main = [
  { name = "rest", kind = "hold", time = 0.05 },
  { name = "step", kind = "step", to = 1e-3, time = 0.2 },
  { name = "back", kind = "ramp", to = 0.0, time = 0.1 },
]
cleanup = [{ kind = "ramp", to = 0.0, time = 0.05 }]
checks = [
  { name = "overshoot", kind = "overshoot", window = "step", high = 30.0 },
  { name = "no emergency", kind = "event_never", event = "EMCY" },
]
"""

SLOW_START = "\n[timing]\noperational = 20\n"  # s


def never() -> bool:
    """Nobody stops the run."""
    return False


def job(text: str = SHORT, seed: int = 0, set_: dict[str, float] | None = None, **settings: object) -> Job:
    """A job of a sequence's text. On a bus between programs the nodes have 20 s to start: the machine may be busy."""
    if "bus" in settings and "[timing]" not in text:
        text += SLOW_START
    sequence = parse_sequence(text, "short.toml", lambda name: b"")
    model = load_model(sequence.model.name).replace(dict(sequence.model.overrides)).replace(set_ or {})
    return Job(sequence=sequence, model=model, seed=seed, **settings)  # type: ignore[arg-type]


def play(one: Job, folder: Path, stop: Callable[[], bool] = never) -> Outcome:
    """Run a job; its results lie in `folder`. On a bus between programs a boot-up may take 20 s."""
    with pytest.MonkeyPatch.context() as patch:
        if one.bus != "embedded":
            patch.setattr(master, "BOOT_TIMEOUT", 20.0)
        return run_job(one, folder, ignore_progress, stop)


def stop_after(questions: int) -> Callable[[], bool]:
    """An operator who presses Ctrl-C after the run has asked for it so often, each time cycles are over."""
    asked = iter(range(10**9))
    return lambda: next(asked) >= questions


def kinds(outcome: Outcome) -> list[tuple[str, str]]:
    """Kind and text of the events, in order."""
    return [(event.kind, event.text) for event in outcome.events]
