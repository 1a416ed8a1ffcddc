"""From what a user chooses, such as a sequence, a model and changed parameters, to a job."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from fdi.foreign_code import Announce, load_effects_of_model, print_on_standard_error, require_different_names
from plant import InputError, load_model
from plant.effects import load_effects
from rig.run.job import Job, replace_settings, require_bench_cycle
from rig.sequences import Sequence, load_sequence


class JobChoice(NamedTuple):
    """What a user chooses of a run; None: as the sequence says, or the default."""

    sequence: str = "preflight"  # a file, or the name of a shipped one
    model: str | None = None  # a file, or the name of a shipped one
    changes: Mapping[str, str | float] = {}  # "GROUP.FIELD" to value, SI
    seed: int = 0
    effects: tuple[Path, ...] = ()  # files of the user's own effects
    bus: str = "embedded"
    pace: str | None = None
    controller: str | None = None
    plant: str | None = None
    max_overruns: float | None = None
    is_diagnosed: bool = False  # whether `rig fdi` judges the servovalve after the run


def build_job(choice: JobChoice, built: Sequence | None = None, *, is_trusted: bool = False,
              announce: Announce = print_on_standard_error) -> Job:
    """The job that a user chose; his model and changes override the sequence's own.

    Args:
        choice: what he chose.
        built: the sequence, if it is not to be read from the file that he chose.
        is_trusted: whether effect files that a model file names may run.
        announce: gets a line about each of these before it runs.

    Raises:
        InputError: a sequence, model, effect or value that cannot be used.
    """
    require_different_names(choice.effects)
    for file in choice.effects:
        load_effects(file)
    sequence = load_sequence(choice.sequence) if built is None else built
    name = choice.model or sequence.model.name
    brought = load_effects_of_model(name, choice.effects, is_trusted=is_trusted, announce=announce)
    require_different_names((*choice.effects, *brought))
    model = load_model(name).replace(sequence.model.overrides, sequence.name).replace(choice.changes)
    require_bench_cycle(model, "--set")
    foreign = [name for name in model.list_changes() if name.startswith("controller.")]
    if choice.controller == "external" and foreign:
        raise InputError("--set", foreign[0], "no gains beside --controller external: that firmware has its own")
    job = Job(sequence=sequence, model=model, seed=choice.seed, effects=(*choice.effects, *brought), bus=choice.bus,
              max_overruns=sequence.timing.share)
    return replace_settings(job, pace=choice.pace, controller=choice.controller, plant=choice.plant,
                            max_overruns=choice.max_overruns)
