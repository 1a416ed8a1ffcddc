"""A run as data: everything that determines its result, from the command line or from an earlier run's log."""
from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import dbc
from fdi.trace.trace import Trace
from plant import InputError, Model
from plant.effects import load_effects
from plant.model import parse_model
from plant.parameters import parse_toml
from rig.nodes.scenario import Scenario
from rig.sequences import Sequence

_REQUIRED_SETTINGS = {"seed", "bus", "pace", "controller", "plant", "max_overruns"}
_EFFECT_FOLDER, _SEQUENCE_FOLDER = "effects/", "sequence/"  # folders of the attachments


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run. `plant` and `controller`: "builtin", "external", for the plant "auto", for the controller "c"."""

    sequence: Sequence
    model: Model
    seed: int = 0
    bus: str = "embedded"
    pace: str = "lockstep"
    controller: str = "builtin"
    plant: str = "auto"
    effects: tuple[Path, ...] = ()
    max_overruns: float = 1e-3  # of all cycles, in real time

    @property
    def realtime(self) -> bool:
        """Whether the wall clock sets the pace."""
        return self.pace == "realtime"

    @property
    def period_ns(self) -> int:
        """Length of a cycle, ns."""
        return round(self.model["controller.period"] * 1e9)

    @cached_property
    def scenario(self) -> Scenario:
        """The plant's scenario; computed once, because a long test has many cycles."""
        sequence = self.sequence
        return Scenario.of(self.model, sequence.plan(self.seed), sequence.load_profile(), self.seed)

    def attachments(self) -> dict[str, tuple[str, bytes]]:
        """What a log carries so that the run can be repeated: name to (media type, bytes)."""
        found = {"model.toml": ("application/toml", self.model.to_toml().encode())}
        found |= {_SEQUENCE_FOLDER + name: ("text/plain", data) for name, data in self.sequence.bundle().items()}
        found |= {_EFFECT_FOLDER + path.name: ("text/x-python", path.read_bytes()) for path in self.effects}
        return found | {path.name: ("text/plain", path.read_bytes()) for path in (dbc.DBC, *dbc.EDS.values())}

    def settings(self) -> dict[str, object]:
        """The settings of the run, for the log's metadata."""
        return {"seed": self.seed, "bus": self.bus, "pace": self.pace, "controller": self.controller,
                "plant": self.plant, "model": self.model.name, "sequence": self.sequence.title,
                "period": self.period_ns / 1e9, "max_overruns": self.max_overruns}


def read_job(path: Path) -> Job:
    """Read the job that produced a log.

    Raises:
        InputError: the file is no log of a run.
    """
    trace = Trace.read(path, all=True)
    said = trace.provenance
    bundle = _select_attachments(trace.attachments, _SEQUENCE_FOLDER)
    if "model.toml" not in trace.attachments or not bundle or not said.keys() >= _REQUIRED_SETTINGS:
        raise InputError(path, "attachments", "the sequence and the model of a run; only logs of `rig run` have them")
    effects = _write_effect_files(_select_attachments(trace.attachments, _EFFECT_FOLDER))
    for effect in effects:
        load_effects(effect)
    model = parse_model(parse_toml(trace.attachments["model.toml"].decode(), "model.toml"), f"{path}:model.toml")
    return Job(sequence=Sequence.from_bundle(bundle), model=model, seed=int(said["seed"]), bus=said["bus"],
               pace=said["pace"], controller=said["controller"], plant=said["plant"], effects=effects,
               max_overruns=float(said["max_overruns"]))


def _select_attachments(attachments: Mapping[str, bytes], prefix: str) -> dict[str, bytes]:
    return {name.removeprefix(prefix): data for name, data in attachments.items() if name.startswith(prefix)}


def _write_effect_files(files: Mapping[str, bytes]) -> tuple[Path, ...]:
    """Write user effects to files. They must outlive this call, because code is compiled from them later."""
    if not files:
        return ()
    folder = Path(tempfile.mkdtemp(prefix="eha-rig-effects-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, data in files.items():
        (folder / Path(name).name).write_bytes(data)
    return tuple(folder / Path(name).name for name in files)
