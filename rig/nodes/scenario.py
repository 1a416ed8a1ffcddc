"""The plant of a run with its faults: the scenario, sent before a run by one SDO download."""

import json
import zlib
from math import isfinite
from typing import Any, NamedTuple, Self

import numpy as np

from plant import Array, InputError, Model, build_bare_model, find_key, require
from rig.sequences import Parameter, Plan, Schedule, require_sensible

LARGEST_DOWNLOAD = 1 << 20  # bytes in one SDO download, as the node's server has it
LONGEST_PLAN = 20_000_000  # cycles; noise is drawn for all of them beforehand
WHERE = "scenario (object 0x2210)"


class Scenario(NamedTuple):
    """A plant with its faults and load; `load_counts`: cycle by cycle, see `find_load_count`."""

    model: Model
    plan: Plan
    load_counts: tuple[int, ...] = ()
    seed: int = 0

    @classmethod
    def build(cls, model: Model, plan: Plan, load: Array, seed: int) -> Self:
        """With `load` in SI over main, shape (cycles of main,); set-up and clean-up are without load.

        Raises:
            InputError: a fault that contradicts this model's parameters.
        """
        require_sensible(plan, model)
        counts = [0] * plan.start + np.rint(load / find_load_count(model)).astype(int).tolist()
        # the plant must have the effects whose parameters faults change from the start
        effects = {fault.parameter.partition(".")[0] for fault in plan.faults if isinstance(fault, Parameter)}
        return cls(model.with_effects(effects), plan, tuple(counts), seed)

    def list_loads(self) -> list[float]:
        """The load, SI, one a cycle; none after the last."""
        loads: list[float] = (find_load_count(self.model) * np.array(self.load_counts)).tolist()
        return loads

    def make_schedule(self) -> Schedule:
        """The faults by cycle."""
        return Schedule(self.plan, self.model.values)

    def to_bytes(self) -> bytes:
        """JSON, compressed. Loads are second differences: constant and ramp are zeros.

        Raises:
            InputError: it is longer than the SDO server accepts.
        """
        changes = np.diff(np.array(self.load_counts, np.int64), n=2, prepend=[0, 0]).tolist()
        data = zlib.compress(json.dumps({
            "model": {"name": self.model.name, "effects": self.model.effects, "values": self.model.list_changes(),
                      "plant": self.model.plant},
            "plan": self.plan.to_json(), "load": changes, "seed": self.seed}).encode(), 9)
        require(len(data) <= LARGEST_DOWNLOAD, "load", "",
                f"a load (and faults) of at most {LARGEST_DOWNLOAD >> 10} KiB compressed, not "
                f"{len(data) >> 10} KiB: fewer recorded cycles, or fewer digits")
        return data

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The scenario that was sent.

        Raises:
            InputError: the bytes are not a scenario, or name something this node does not know.
        """
        try:
            largest = 1 << 26  # bytes of JSON: six hours of random load
            table: dict[str, Any] = json.loads(zlib.decompressobj().decompress(data, largest))
            model_table = table["model"]
            bare_model = build_bare_model(find_key(str(model_table.get("plant", "eha"))), str(model_table["name"]))
            model = bare_model.with_effects(model_table["effects"]).replace(model_table["values"], WHERE)
            load_counts = np.cumsum(np.cumsum(np.array(table["load"], np.int64))).tolist()
            plan, seed = Plan.from_json(table["plan"], bare_model.plant), int(table["seed"])
            require(min(seed, plan.seed) >= 0 and 0 <= plan.start <= plan.stop <= LONGEST_PLAN, WHERE, "plan",
                    f"seeds from 0, and at most {LONGEST_PLAN} cycles")
            require_sensible(plan, model)
            return cls(model, plan, tuple(load_counts), seed)
        except InputError:
            raise
        except Exception as error:  # anybody may send anything
            raise InputError(WHERE, "", f"compressed JSON of a scenario ({type(error).__name__}: {error})") from error


def find_load_count(model: Model) -> float:
    """What a count of the load is worth: loads travel as whole numbers, because those compress to next to nothing.

    1 mN for the EHA, the 1e-9th part of the largest load; 1e-6 where the plant has no largest one.
    """
    load = model.kind.signals.load
    return load.largest * 1e-9 if load is not None and isfinite(load.largest) else 1e-6
