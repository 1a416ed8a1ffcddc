"""The suite file: cases with lists of sequences, models, parameters and seeds, and the requirements to be covered."""
from __future__ import annotations

import itertools
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from plant.errors import InputError
from rig.run.job_choice import JobChoice, build_job
from rig.sequences.sequence import load_sequence
from rig.sequences.tables import Place, build_dataclass, parse_table
from rig.studies.suite.case import Case, PlannedCheck

Value = float | str
MOST_CASES = 10_000


@dataclass(frozen=True, kw_only=True)
class CaseEntry:
    """An entry [[case]]: where a list stands, a case is made for each element, in every combination."""

    sequence: str | tuple[str, ...]
    name: str = ""
    model: str | tuple[str, ...] = ()
    set: Mapping[str, float | str | tuple[float | str, ...]] = field(default_factory=dict)
    seed: int | tuple[int, ...] = 0
    effects: tuple[str, ...] = ()
    requirement: str | tuple[str, ...] = ()
    timeout: Annotated[float, "s"] | None = None
    fdi: bool = False

    def __post_init__(self) -> None:
        for key in ("sequence", "seed"):
            if getattr(self, key) == ():
                raise InputError("case", key, "at least one")
        if any(seed < 0 for seed in _as_tuple(self.seed)):
            raise InputError("case", "seed", "whole numbers from 0")
        if self.timeout is not None and not 0 < self.timeout <= 1e6:
            raise InputError("case", "timeout", f"above 0 s and at most 1e6, not {self.timeout:g}")
        for name, values in self.set.items():
            if values == ():
                raise InputError("case", "set", f"at least one value of {name}")


@dataclass(frozen=True, kw_only=True)
class SuiteFile:
    """The keys of a suite file. `requirements`: a list of ids, or a table of ids and texts."""

    title: str
    case: tuple[CaseEntry, ...]
    requirements: tuple[str, ...] | Mapping[str, str] = ()


class Suite(NamedTuple):
    """Cases, and the requirements that they shall cover: id to text."""

    title: str
    cases: list[Case]
    requirements: Mapping[str, str]
    source: str = ""  # the suite file

    def put_into(self, folder: Path) -> Suite:
        """The same suite with the folders of its cases in this one."""
        return self._replace(cases=[case._replace(folder=folder / case.folder) for case in self.cases])


class Variant(NamedTuple):
    """A run before it has its place in the suite."""

    name: str
    choice: JobChoice
    timeout: float | None = None
    requirement: tuple[str, ...] = ()


def is_suite_file(name: str) -> bool:
    """Whether a file is a suite and no sequence: it has the key `case`. False for what cannot be read."""
    path = Path(name)
    if path.suffix != ".toml" or not path.is_file():
        return False
    try:
        return "case" in tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):  # whoever reads it as a sequence says what is wrong
        return False


def read_suite_file(path: Path, base: JobChoice) -> tuple[SuiteFile, list[Variant]]:
    """The content of a suite file and its variants; `base` has what the command line chooses for all of them.

    Raises:
        InputError: the file, line and key that cannot be used.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(path, "", f"a file that can be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(path, "", "text in UTF-8") from error
    table, place = parse_table(text, str(path))
    suite = build_dataclass(SuiteFile, table, place)
    if not suite.case:
        raise place.at("case").refuse("at least one case")
    variants: list[Variant] = []
    for i, entry in enumerate(suite.case):
        for variant in _vary(entry, path.parent, base):
            _try_variant(variant, place.at("case", i))
            variants.append(variant)
            if len(variants) > MOST_CASES:
                raise place.at("case", i).refuse(f"at most {MOST_CASES} cases in all")
    return suite, variants


def _try_variant(variant: Variant, place: Place) -> None:
    """Refuse a sequence that is not there with the line of the suite file that names it."""
    try:
        load_sequence(variant.choice.sequence)
    except InputError as error:
        if error.where == variant.choice.sequence:
            raise place.at("sequence").refuse(f"a sequence; {error}") from error
        raise


def _vary(entry: CaseEntry, folder: Path, base: JobChoice) -> Iterator[Variant]:
    """Every combination of the lists of an entry."""
    sequences, models, seeds = _as_tuple(entry.sequence), _as_tuple(entry.model) or (None,), _as_tuple(entry.seed)
    values = {name: _as_tuple(value) for name, value in entry.set.items()}
    effects = (*base.effects, *(folder / name for name in entry.effects))
    for sequence, model, seed, *chosen in itertools.product(sequences, models, seeds, *values.values()):
        changes: dict[str, Value] = dict(zip(values, chosen, strict=True))
        words = [entry.name or Path(sequence).stem]
        words += [Path(sequence).stem] if entry.name and len(sequences) > 1 else []
        words += [Path(model).stem] if model is not None and len(models) > 1 else []
        words += [f"{name}={_show(value)}" for name, value in changes.items() if len(values[name]) > 1]
        words += [f"seed {seed}"] if len(seeds) > 1 else []
        choice = base._replace(sequence=_find_beside(folder, sequence), changes=changes, seed=seed, effects=effects,
                               model=None if model is None else _find_beside(folder, model),
                               is_diagnosed=base.is_diagnosed or entry.fdi)
        yield Variant(", ".join(words), choice, entry.timeout, _as_tuple(entry.requirement))


def build_suite(title: str, variants: Sequence[Variant], requirements: Mapping[str, str], source: str = "", *,
                is_trusted: bool = False) -> Suite:
    """The suite of these variants; each is tried first: sequence, model, parameters, effects.

    The folders of its cases are names without a place, see `Suite.put_into`.

    Raises:
        InputError: a variant that cannot run, or code that a model brings along and that is not trusted.
    """
    cases: list[Case] = []
    names: set[str] = set()
    folders: set[str] = {"suite.html", "suite.json"}
    for variant in variants:
        name = _find_free(variant.name, names, " ({})")
        slug = _find_free(re.sub(r"[^\w.=+-]+", "-", variant.name).strip("-.")[:80] or "case", folders, "-{}")
        job = build_job(variant.choice, is_trusted=is_trusted)
        checks = tuple(PlannedCheck(check.name, check.requirements) for check in job.sequence.checks)
        seconds = 300.0 + 10.0 * job.sequence.duration if variant.timeout is None else variant.timeout
        cases.append(Case(name, Path(slug), variant.choice, seconds, checks, variant.requirement))
    return Suite(title, cases, requirements, source)


def _find_free(name: str, taken: set[str], pattern: str) -> str:
    """The name, with a number from 2 if it is taken; whether letters are capitals makes no difference."""
    free = next(each for number in itertools.count(1)
                if (each := name if number == 1 else name + pattern.format(number)).lower() not in taken)
    taken.add(free.lower())
    return free


def _find_beside(folder: Path, name: str) -> str:
    """A file beside the suite file; a name without suffix is that of a shipped sequence or model."""
    return str(folder / name) if Path(name).suffix == ".toml" else name


def _as_tuple(value: object) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def _show(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else value
