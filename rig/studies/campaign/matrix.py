"""What a campaign does: a matrix of faults, sizes, tolerances and seeds, or the traces of a folder. Data, in and out.

    seeds = 20                       # runs of each size, each with its own scatter and noise
    tolerance = [0.015]              # standard deviation of the base parameters, relative

    [[case]]                         # healthy plants
    seeds = 200
    [[case]]
    filter_clogging = [0.1, 0.25, 0.35]
    [[case]]                         # both at once: every size of one with every size of the other
    filter_clogging = 0.17
    spool_friction = [45.0, 70.0]
"""
from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from fdi.prognosis.gather import traces
from plant.effects import Effect
from plant.errors import InputError
from plant.model import Model, entry
from plant.parameters import accept, parse_toml, read_toml

SIMULATORS = ("plant", "independent")
SIGNALS = ("xj,p12,xs", "xj,p12", "xj")
HEALTHY = "healthy"
PERIOD = 1e-3  # s
DEFAULTS: dict[str, Any] = {
    "seeds": 20,  # runs of each size
    "first": 0,  # seed of the first
    "tolerance": [0.015],
    "simulator": "plant",  # ours in 10 us steps, or the blind trial's in C
    "colour": 0.8,  # correlation of the position sensor's noise from one cycle to the next
    "hum": 0.7e-6,  # m, of the mains on it
    "signals": "xj,p12,xs",  # measured
}


class Case(NamedTuple):
    """One run to judge; all that is random in it follows from label and seed."""

    number: int  # place in the campaign
    label: str  # "healthy", "filter_clogging=0.17 spool_friction=45", or the trace's name in its folder
    sizes: Mapping[str, float]  # effect to the value of its first parameter, SI
    tolerance: float
    seed: int
    trace: str = ""  # path of a recorded run; then nothing is simulated


class Matrix(NamedTuple):
    """A campaign: what all cases share, and the cases, in an order in which any beginning is a fair sample."""

    spec: Mapping[str, Any]  # JSON: what makes this campaign another than others
    cases: tuple[Case, ...]


def shipped() -> list[str]:
    """The names of the matrices that come with the rig."""
    return sorted(f.name.removesuffix(".toml") for f in files("rig.studies.campaign").iterdir()
                  if f.name.endswith(".toml"))


def read_matrix(source: str) -> dict[str, Any]:
    """The tables of a matrix file, or of a shipped one by name. Raises InputError."""
    if source in shipped():
        return parse_toml((files("rig.studies.campaign") / f"{source}.toml").read_text(encoding="utf-8"), source)
    return read_toml(Path(source))


def matrix(tables: Mapping[str, Any], model: Model, work: str, where: object) -> Matrix:
    """The campaign that the tables of a matrix file describe.

    Raises:
        InputError: an unknown key or effect, a value or model that cannot be, or no case at all.
    """
    given = {key: value for key, value in tables.items() if key != "case"}
    for key in given.keys() - DEFAULTS.keys():
        raise InputError(where, key, f"one of {', '.join([*DEFAULTS, '[[case]]'])}")
    common = {**DEFAULTS, **given}
    _check(common, where)
    _checked(model)
    blocks = tables.get("case", [])
    if not isinstance(blocks, list) or not blocks or not all(isinstance(block, Mapping) for block in blocks):
        raise InputError(where, "case", "at least one [[case]]; an empty one is a healthy plant")
    cleaned = [_block(block, common, model, where) for block in blocks]
    spec = {**common, "model": model.to_toml(), "work": work, "case": cleaned}
    return Matrix(spec, _cases(spec))


def _check(common: dict[str, Any], where: object) -> None:
    common["tolerance"] = _tolerances(common["tolerance"], where)
    common["colour"] = _number(where, "colour", common["colour"], 0.0, 0.99)
    common["hum"] = _number(where, "hum", common["hum"], 0.0, 1e-3)
    if common["simulator"] not in SIMULATORS:
        raise InputError(where, "simulator", f"one of {', '.join(SIMULATORS)}, not {common['simulator']!r}")
    if common["signals"] not in SIGNALS:
        raise InputError(where, "signals", f"one of {'; '.join(SIGNALS)}, not {common['signals']!r}")
    _count(where, "seeds", common["seeds"], 1)
    _count(where, "first", common["first"], 0)


def _checked(model: Model) -> None:
    """The preflight check, its scatter and its noise are those of one plant in its own cycle."""
    if model.plant != "eha":
        raise InputError("--model", model.plant, "eha, whose preflight check this is")
    if model["controller.period"] != PERIOD:
        raise InputError("--set", "controller.period", f"{PERIOD:g} s, the cycle of the preflight check")


def _tolerances(value: Any, where: object) -> list[float]:
    if value == []:
        raise InputError(where, "tolerance", "at least one")
    return [_number(where, "tolerance", x, 0.0, 0.2) for x in _listed(value)]


def _block(block: Mapping[str, Any], common: Mapping[str, Any], model: Model, where: object) -> dict[str, Any]:
    sizes = {}
    for name, values in block.items():
        if name not in ("seeds", "tolerance"):
            quantity = _effect(name, model, where).parameters[_effect(name, model, where).fitted[0]]
            sizes[name] = [accept(where, name, quantity, value) for value in _listed(values)]
            if not sizes[name]:
                raise InputError(where, name, "at least one size")
    return {"seeds": _count(where, "seeds", block.get("seeds", common["seeds"]), 1), "sizes": sizes,
            "tolerance": _tolerances(block.get("tolerance", common["tolerance"]), where)}


def _effect(name: str, model: Model, where: object) -> Effect:
    found = entry(name, model.plant)
    if not found.fitted:
        raise InputError(where, name, "an effect with a size; this is noise of the bench")
    return found


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _number(where: object, field: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(where, field, f"a number from {low:g} to {high:g}, not {value!r}")
    return float(value)


def _count(where: object, field: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(where, field, f"a whole number from {least}, not {value!r}")
    return value


def _cases(spec: Mapping[str, Any]) -> tuple[Case, ...]:
    """All cases; those of few seeds are spread among those of many, so that what is done first is of every kind."""
    found: dict[tuple[str, float, int], tuple[float, dict[str, float]]] = {}
    for block in spec["case"]:
        for values in itertools.product(*block["sizes"].values()):
            sizes = dict(sorted(zip(block["sizes"], values, strict=True)))
            for tolerance, k in itertools.product(block["tolerance"], range(block["seeds"])):
                key = label(sizes), tolerance, spec["first"] + k
                found.setdefault(key, ((k + 0.5) / block["seeds"], sizes))
    ordered = sorted(found.items(), key=lambda item: item[1][0])  # stable: within a round as the file has them
    return tuple(Case(i, name, sizes, tolerance, seed) for i, ((name, tolerance, seed), (_, sizes))
                 in enumerate(ordered))


def label(sizes: Mapping[str, float]) -> str:
    """What to call a plant with faults of these sizes."""
    return " ".join(f"{name}={size:.9g}" for name, size in sizes.items()) or HEALTHY


def of_traces(folder: str | Path, model: Model, work: str) -> Matrix:
    """A campaign over the recorded runs below a folder: trace.mcap of runs, and every CSV.

    Raises:
        InputError: no such folder, or no trace in it.
    """
    root = Path(folder).absolute()
    found = traces(root)
    names = {path.relative_to(root).as_posix(): path for path in found}
    digests = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in names.items()}
    spec = {"traces": str(root), "files": digests, "model": model.to_toml(), "work": work}
    return of_spec(spec)


def of_spec(spec: Mapping[str, Any]) -> Matrix:
    """The campaign that `Matrix.spec` of another describes."""
    if "traces" not in spec:
        return Matrix(spec, _cases(spec))
    root = Path(spec["traces"])
    return Matrix(spec, tuple(Case(i, name, {}, 0.0, 0, str(root / name)) for i, name in enumerate(spec["files"])))


def parsed(words: Sequence[str]) -> list[dict[str, Any]]:
    """The cases of --fault: "healthy", "filter_clogging=0.1,0.2" or "filter_clogging=0.17/spool_friction=45".

    Raises:
        InputError: something else.
    """
    blocks: list[dict[str, Any]] = []
    for word in words:
        block = {}
        for part in word.split("/") if word != HEALTHY else []:
            name, equals, values = part.partition("=")
            try:
                block[name.strip()] = [float(value) for value in values.split(",")]
            except ValueError:
                raise InputError("--fault", word, "healthy, EFFECT=SIZE,SIZE.., or several of these with / between"
                                 ) from None
            if not equals:
                raise InputError("--fault", word, "EFFECT=SIZE")
        blocks.append(block)
    return blocks
