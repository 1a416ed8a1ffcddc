"""The cases of a campaign: a matrix of faults, sizes, tolerances and seeds, or the traces of a folder.

A matrix file is TOML:

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
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from fdi.prognosis.unit_trend import list_traces
from plant.errors import InputError
from plant.model import Model, find_effect
from plant.parameters import parse_toml, parse_value, read_toml
from rig.sequences.timing import PERIOD
from rig.tables import Place, Range, build_dataclass

OWN_SIMULATOR = "plant"
HEALTHY = "healthy"
Tolerance = Annotated[float, Range("1", low=0.0, high=0.2)]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The keys above the first [[case]]; a case may override seeds and tolerance."""

    seeds: Annotated[int, Range("1", low=1)] = 20  # runs of each size
    first: Annotated[int, Range("1", low=0)] = 0  # seed of the first
    tolerance: Tolerance | tuple[Tolerance, ...] = (0.015,)
    simulator: str = OWN_SIMULATOR  # plant.simulate in 10 us steps, or "module:function"
    colour: Annotated[float, Range("1", low=0.0, high=0.99)] = 0.8  # correlation of xj's noise between cycles
    hum: Annotated[float, Range("m", low=0.0, high=1e-3)] = 0.7e-6  # of the mains on the position sensor
    signals: Literal["xj,p12,xs", "xj,p12", "xj"] = "xj,p12,xs"  # measured

    def __post_init__(self) -> None:
        if self.tolerance == ():
            raise InputError("matrix", "tolerance", "at least one")
        if self.simulator != OWN_SIMULATOR and ":" not in self.simulator:
            raise InputError("matrix", "simulator", f"{OWN_SIMULATOR} or MODULE:FUNCTION, not {self.simulator!r}")

    def list_values(self) -> dict[str, Any]:
        """JSON values, with a list of tolerances."""
        given = self.tolerance if isinstance(self.tolerance, tuple) else (self.tolerance,)
        return {**asdict(self), "tolerance": list(given)}


class Case(NamedTuple):
    """One run to judge; everything random in it follows from its label and seed."""

    number: int  # its place in the matrix
    label: str  # "healthy", "filter_clogging=0.17 spool_friction=45", or the trace's name in its folder
    sizes: Mapping[str, float]  # effect to the value of its first parameter, SI
    tolerance: float
    seed: int
    trace: str = ""  # path of a recorded run; if given, nothing is simulated


class Matrix(NamedTuple):
    """The settings and the cases of a campaign, ordered such that the first cases are a fair sample of all."""

    spec: Mapping[str, Any]  # JSON values from which `restore_matrix` makes the same matrix
    cases: tuple[Case, ...]


def list_shipped_matrices() -> list[str]:
    """The names of the matrices that come with this software."""
    names = [file.name for file in files("rig.campaign").iterdir()]
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def read_matrix(source: str) -> dict[str, Any]:
    """The tables of a matrix file, or of a shipped one by name. Raises InputError."""
    if source in list_shipped_matrices():
        return parse_toml((files("rig.campaign") / f"{source}.toml").read_text(encoding="utf-8"), source)
    return read_toml(Path(source))


def build_matrix(tables: Mapping[str, Any], model: Model, work: str, where: object) -> Matrix:
    """The campaign that the tables of a matrix file describe.

    Raises:
        InputError: an unknown key or effect, a value out of range, another plant than `eha`, or no case at all.
    """
    place = Place(str(where))
    given = {key: value for key, value in tables.items() if key != "case"}
    settings = build_dataclass(Settings, given, place)
    if model.plant != "eha":
        raise InputError("--model", model.plant, "eha, whose preflight check this is")
    if model["controller.period"] != PERIOD:
        raise InputError("--set", "controller.period", f"{PERIOD:g} s, the cycle of the preflight check")
    blocks = tables.get("case", [])
    if not isinstance(blocks, list) or not blocks or not all(isinstance(block, Mapping) for block in blocks):
        raise InputError(where, "case", "at least one [[case]] (an empty one is a healthy plant)")
    parsed = [_parse_block(block, given, model, place) for block in blocks]
    spec = {**settings.list_values(), "model": model.to_toml(), "work": work, "case": parsed}
    return Matrix(spec, _expand_cases(spec))


def _parse_block(block: Mapping[str, Any], common: Mapping[str, Any], model: Model, place: Place) -> dict[str, Any]:
    """A [[case]] table with its defaults filled in. Raises InputError."""
    own = {key: value for key, value in block.items() if key in ("seeds", "tolerance")}
    settings = build_dataclass(Settings, {**common, **own}, place).list_values()
    sizes = {}
    for name, values in block.items():
        if name not in own:
            with place.at(name).locate():
                effect = find_effect(name, model.plant)
                if not effect.fitted:
                    raise InputError("", name, "an effect with a size; this one is noise of the bench")
                sizes[name] = [parse_value("", name, effect.parameters[effect.fitted[0]], value)
                               for value in (values if isinstance(values, list) else [values])]
                if not sizes[name]:
                    raise InputError("", name, "at least one size")
    return {"seeds": settings["seeds"], "sizes": sizes, "tolerance": settings["tolerance"]}


def _expand_cases(spec: Mapping[str, Any]) -> tuple[Case, ...]:
    """All cases of all blocks; a case that two blocks have counts once.

    Each block's seeds are spread evenly over the campaign, so that the first cases are of every kind.
    """
    cases: dict[tuple[str, float, int], Case] = {}
    places: dict[tuple[str, float, int], float] = {}  # from 0 to 1
    for block in spec["case"]:
        for values in itertools.product(*block["sizes"].values()):
            sizes = dict(sorted(zip(block["sizes"], values, strict=True)))
            for tolerance, k in itertools.product(block["tolerance"], range(block["seeds"])):
                seed = spec["first"] + k
                key = label_plant(sizes), tolerance, seed
                cases.setdefault(key, Case(0, label_plant(sizes), sizes, tolerance, seed))
                places.setdefault(key, (k + 0.5) / block["seeds"])
    ordered = sorted(cases, key=lambda key: places[key])  # stable: equal places keep the order of the file
    return tuple(cases[key]._replace(number=number) for number, key in enumerate(ordered))


def label_plant(sizes: Mapping[str, float]) -> str:
    """The label of a plant with faults of these sizes: "filter_clogging=0.17 spool_friction=45", or "healthy"."""
    return " ".join(f"{name}={size:.9g}" for name, size in sizes.items()) or HEALTHY


def build_trace_matrix(folder: str | Path, model: Model, work: str) -> Matrix:
    """The recorded runs below a folder as cases: the trace.mcap of each run, and every CSV file.

    Raises:
        InputError: no such folder, or no trace in it.
    """
    root = Path(folder).absolute()
    names = {path.relative_to(root).as_posix(): path for path in list_traces(root)}
    digests = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in names.items()}
    spec = {"traces": str(root), "files": digests, "model": model.to_toml(), "work": work}
    return restore_matrix(spec)


def restore_matrix(spec: Mapping[str, Any]) -> Matrix:
    """The matrix that has these settings: the inverse of `Matrix.spec`."""
    if "traces" not in spec:
        return Matrix(spec, _expand_cases(spec))
    root = Path(spec["traces"])
    return Matrix(spec, tuple(Case(i, name, {}, 0.0, 0, str(root / name)) for i, name in enumerate(spec["files"])))


def parse_faults(words: Sequence[str]) -> list[dict[str, Any]]:
    """The [[case]] tables of the words of --fault.

    A word is "healthy", "filter_clogging=0.1,0.2" or "filter_clogging=0.17/spool_friction=45".

    Raises:
        InputError: another word.
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
