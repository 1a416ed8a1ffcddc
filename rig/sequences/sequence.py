"""A test sequence as data: the command of the actuator, the faults during the test, and the checks afterwards.

A sequence is a TOML file (rig/sequences/ has examples): set-up, main and clean-up as lists of segments, the load on the
ram, faults, checks and guards. Times of loads, faults and checks count from the start of main.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np

from plant import segments
from plant.errors import InputError
from plant.model import Model, find_quantity
from plant.profile import Profile, build_profile, list_section_names, parse_columns
from plant.segments import FARTHEST, RATE, STRONGEST, Array, Csv, Segment
from rig.sequences import checks, faults, tables
from rig.sequences.checks import Check, Guard, ResponseWithin, ShutOff
from rig.sequences.faults import Fault, Known, Parameter, Plan, check_faults, check_overrides, check_together
from rig.sequences.measures import MAIN
from rig.sequences.protocol import ProtocolLimits
from rig.sequences.python_parts import (
    VALUES_OF_PART,
    PythonCheck,
    PythonPart,
    PythonSegment,
    Step,
    UserModules,
    require_function_name,
)
from rig.sequences.tables import Place
from rig.sequences.timing import TimingPolicy


@dataclass(frozen=True, kw_only=True)
class RequiredFirmware:
    """What the controller must say about itself; a key that is left out is not compared."""

    device_type: int | None = None  # 0x1000
    name: str | None = None  # 0x1008
    hardware: str | None = None  # 0x1009
    software: str | None = None  # 0x100A
    vendor: int | None = None  # 0x1018 sub 1
    product: int | None = None  # 0x1018 sub 2
    revision: int | None = None  # 0x1018 sub 3
    serial: int | None = None  # 0x1018 sub 4

    def __post_init__(self) -> None:
        for key, value in asdict(self).items():
            if isinstance(value, int) and not 0 <= value <= 0xFFFFFFFF:
                raise InputError("firmware", key, f"a number from 0 to 0xFFFFFFFF, not {value}")

    def find_difference(self, identity: Mapping[str, object]) -> tuple[str, str]:
        """The first key in which a controller's identity differs and how, in words; two empty texts if none does."""
        for key, required in asdict(self).items():
            found = identity.get(key)
            if required is not None and found != required:
                return key, f"{_format(required)}, but the controller has {_format(found)}"
        return "", ""


def _format(value: object) -> str:
    if value is None:
        return "no such object"
    return f"0x{value:08X}" if isinstance(value, int) else repr(value)


ReadFile = Callable[[str], bytes]

SEGMENT_KINDS: dict[str, type[Segment]] = {**segments.KINDS, PythonSegment.kind: PythonSegment}
CHECK_KINDS: dict[str, type[Check]] = {**checks.KINDS, PythonCheck.kind: PythonCheck}
_KINDS: tables.Kinds = {Segment: SEGMENT_KINDS, Fault: faults.KINDS, Check: CHECK_KINDS}
_OWN = {"key": False}  # a field that the program fills in


@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """Which plant to run on: a model's name or file, and parameters that differ from it (SI)."""

    name: str = "eha"
    overrides: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Sequence:
    """A test as the file describes it, and the text it was read from.

    `load` is made of segments in N and lies over main from its start; after its end the last value stays. `ends` says
    how the run must end to pass: "completed", or "safe_state" for a test whose point is that it is broken off.
    """

    title: str
    description: str = ""
    setup: tuple[Segment, ...] = ()
    main: tuple[Segment, ...]
    cleanup: tuple[Segment, ...] = ()
    load: tuple[Segment, ...] = ()
    faults: tuple[Fault, ...] = ()
    checks: tuple[Check, ...] = ()
    guards: tuple[Guard, ...] = ()
    steps: tuple[Step, ...] = ()
    ends: Literal["completed", "safe_state"] = "completed"
    model: ModelChoice = ModelChoice()
    protocol: ProtocolLimits = field(default_factory=ProtocolLimits)
    timing: TimingPolicy = field(default_factory=TimingPolicy)
    firmware: RequiredFirmware = field(default_factory=RequiredFirmware)
    name: str = field(default="", metadata=_OWN)  # the file's, without folders
    source: str = field(default="", metadata=_OWN, repr=False)
    files: Mapping[str, bytes] = field(default_factory=dict, metadata=_OWN, repr=False)  # CSV and Python files, by name

    @property
    def duration(self) -> float:
        """Length of main, s."""
        return sum(segment.duration for segment in self.main)

    def setup_profile(self) -> Profile:
        """The command before main, from 0 m."""
        return build_profile(self.setup)

    def main_profile(self) -> Profile:
        """The command that is judged, from where set-up ended."""
        return build_profile(self.main, self.setup_profile().end)

    def cleanup_profile(self, start: float) -> Profile:
        """The command after main, or after it was broken off at the demand `start` (m)."""
        return build_profile(self.cleanup, start)

    def sections(self) -> dict[str, slice]:
        """Rows of main by section name, as checks see them."""
        return {section.name: slice(section.start, section.stop) for section in self.main_profile().sections}

    def load_profile(self) -> Array:
        """Force on the ram in N for every cycle of main."""
        force, _, end = build_profile(self.load)
        cycles = round(self.duration * RATE)
        return np.concatenate((force, np.full(cycles - len(force), end)))

    def plan(self, seed: int) -> Plan:
        """The faults by cycle of the run."""
        start = round(sum(segment.duration for segment in self.setup) * RATE)
        return Plan(faults=self.faults, start=start, stop=start + round(self.duration * RATE), seed=seed)

    @property
    def loses_frames(self) -> bool:
        """Whether a fault keeps frames from arriving."""
        lossy = (faults.Lost, faults.Late, faults.Corrupted, faults.Short, faults.BusOff, faults.Reset)
        return any(isinstance(fault, lossy) for fault in self.faults)

    @property
    def disturbs_bus(self) -> bool:
        """Whether a fault acts on the bus."""
        return any(isinstance(fault, faults.BUS_FAULTS) for fault in self.faults)

    def fault_starts(self) -> dict[str, float]:
        """When each fault begins, s of main, by its label."""
        return {fault.label: fault.start for fault in self.faults}

    def bundle(self) -> dict[str, bytes]:
        """The text and the files it uses, by name: all that `from_bundle` needs to make the same sequence."""
        return {self.name: self.source.encode(), **self.files}

    @classmethod
    def from_bundle(cls, bundle: Mapping[str, bytes], known: Known = find_quantity) -> Sequence:
        """The sequence of a bundle; Python files in it run.

        Raises:
            InputError: a file is not in it or does not make a sequence.
        """
        sources = [name for name in bundle if name.endswith(".toml")]
        if len(sources) != 1:
            raise InputError("bundle", "", f"one .toml file, not {len(sources)}")

        def read_file(name: str) -> bytes:
            if name not in bundle:
                raise InputError("bundle", name, "to be part of the bundle")
            return bundle[name]

        try:
            text = bundle[sources[0]].decode()
        except UnicodeDecodeError as error:
            raise InputError(sources[0], "", "text in UTF-8") from error
        return parse_sequence(text, sources[0], read_file, known)


def load_sequence(name_or_path: str | Path, known: Known = find_quantity) -> Sequence:
    """Read a sequence: a TOML file, or the name of one that comes with the rig.

    Args:
        name_or_path: e.g. "preflight" or "tests/mine.toml"; CSV and Python files in it are sought beside it.
        known: raises InputError for the name of a parameter that does not exist.

    Raises:
        InputError: no such sequence, or the file, line and key that cannot be used and what was expected there.
    """
    entries = {entry.name: entry for entry in files("rig.sequences").iterdir() if entry.name.endswith(".toml")}
    shipped = {Path(name).stem: name for name in entries}
    if str(name_or_path) in shipped:
        name = shipped[str(name_or_path)]
        return parse_sequence(entries[name].read_text(encoding="utf-8"), name, _read_beside(Path()), known)
    path = Path(name_or_path)
    if path.suffix != ".toml":
        raise InputError(name_or_path, "", f"a .toml file, or {tables.list_choices(str(name_or_path), shipped)}")
    read_file = _read_beside(path.parent)
    try:
        text = read_file(path.name).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(path, "", "text in UTF-8") from error
    return parse_sequence(text, str(path), read_file, known)


def _read_beside(folder: Path) -> ReadFile:
    def read_file(name: str) -> bytes:
        try:
            return (folder / name).read_bytes()
        except OSError as error:
            raise InputError(folder / name, "", f"a file that can be read ({error.strerror})") from error

    return read_file


def parse_sequence(text: str, name: str, read_file: ReadFile, known: Known = find_quantity) -> Sequence:
    """The sequence of a TOML text; `read_file` gives the bytes of the CSV and Python files that it names.

    The Python files run.

    Raises:
        InputError: the file, line and key that cannot be used, or the line of a Python file.
    """
    table, place = tables.parse_table(text, name)
    sequence = tables.build_dataclass(Sequence, table, place, _KINDS)
    sequence = replace(sequence, name=Path(name).name, source=text)
    sequence = _with_functions(sequence, place, read_file)
    for phase in ("setup", "main", "cleanup", "load"):
        sequence = _with_csv(sequence, phase, place.at(phase), read_file)
    _check_phases(sequence, place)
    _check_faults(sequence, place.at("faults"))
    _check_parameters(sequence, place, known)
    _check_checks(sequence, place.at("checks"))
    return sequence


def _with_csv(sequence: Sequence, phase: str, place: Place, read_file: ReadFile) -> Sequence:
    """The sequence with the CSV segments of one phase filled in from their files."""
    found: list[Segment] = []
    embedded = dict(sequence.files)
    for i, segment in enumerate(getattr(sequence, phase)):
        if isinstance(segment, Csv):
            here = place.at(i, "file")
            try:
                embedded[segment.file] = embedded.get(segment.file) or read_file(segment.file)
                columns = parse_columns(embedded[segment.file], segment.file)
            except InputError as error:
                raise here.refuse(f"a readable command file; {error}") from error
            values = columns.get("value" if phase == "load" or "com" not in columns else "com")
            if values is None:
                raise here.refuse(f"a file with the columns t and {'value' if phase == 'load' else 'com'}")
            segment = replace(segment, values=tuple(values.tolist()))
        found.append(segment)
    filled: Any = {phase: tuple(found)}
    return replace(sequence, files=embedded, **filled)


def _with_functions(sequence: Sequence, place: Place, read_file: ReadFile) -> Sequence:
    """The sequence with the functions of its parts in Python filled in from their files."""
    modules, embedded = UserModules(Path(place.file).parent), dict(sequence.files)

    def fill_in(part: PythonPart, here: Place) -> PythonPart:
        file, name = require_function_name(part.python)
        try:
            embedded[file] = embedded.get(file) or read_file(file)
        except InputError as error:
            raise here.at("python").refuse(f"a Python file beside the sequence; {error}") from error
        function = modules.find_function(file, embedded[file], name)
        function.require_arguments(VALUES_OF_PART[type(part)], part.arguments)
        return replace(part, function=function)

    filled: dict[str, Any] = {}
    for key in ("setup", "main", "cleanup", "load", "checks", "steps"):
        filled[key] = tuple(fill_in(part, place.at(key, i)) if isinstance(part, PythonPart) else part
                            for i, part in enumerate(getattr(sequence, key)))
    return replace(sequence, files=embedded, **filled)


def _check_phases(sequence: Sequence, place: Place) -> None:
    for phase in ("setup", "main", "cleanup", "load"):
        called = list_section_names(getattr(sequence, phase))
        for i, name in enumerate(called):
            if name in called[:i]:
                raise place.at(phase, i, "name").refuse(f"a name used once, not a second {name!r}")
            if name == MAIN:
                raise place.at(phase, i, "name").refuse(f"another name than {MAIN!r}, which is all of main")
    _check_sizes(sequence, place)
    if not sequence.main:
        raise place.at("main").refuse("at least one segment")
    length = sum(segment.duration for segment in sequence.load)
    if round(length * RATE) > round(sequence.duration * RATE):
        raise place.at("load").refuse(f"at most the {sequence.duration:g} s that main lasts, not {length:g} s")


def _check_sizes(sequence: Sequence, place: Place) -> None:
    """No demand and no load of a size that can only be a slip of units."""
    start = 0.0
    for phase, most, unit in (("setup", FARTHEST, "m"), ("main", FARTHEST, "m"), ("cleanup", FARTHEST, "m"),
                              ("load", STRONGEST, "N")):
        with np.errstate(all="ignore"):  # what overflows is refused below
            try:
                values, sections, end = build_profile(getattr(sequence, phase), 0.0 if phase == "load" else start)
            except InputError as error:  # a function that computes a segment
                raise (place.at(phase).refuse(error.expected) if error.where == "segment" else error) from error
        for i, section in enumerate(sections):
            last = end if i == len(sections) - 1 else 0.0
            largest = np.abs((*values[section.start:section.stop], last)).max()
            if not largest <= most:  # nor NaN
                raise place.at(phase, i).refuse(f"at most {most:g} {unit} either way, not {largest:g}")
        start = end


def _check_faults(sequence: Sequence, place: Place) -> None:
    """Each begins within main and acts for a cycle or more, and no two change one parameter at the same time."""
    plan = sequence.plan(0)
    taken: dict[str, list[tuple[int, int]]] = {}
    for i, fault in enumerate(sequence.faults):
        if fault.start >= sequence.duration:
            raise place.at(i, "start").refuse(f"a time within main's {sequence.duration:g} s, not {fault.start:g}")
        first, last = plan.find_cycles(fault)
        if first == last:
            raise place.at(i, "start" if fault.end is None else "end").refuse(
                f"a fault that acts in a cycle of {1 / RATE:g} s of main or more")
        if isinstance(fault, Parameter):
            others = taken.setdefault(fault.parameter, [])
            if any(first < b and a < last for a, b in others):
                raise place.at(i, "start").refuse(f"a time when no other fault changes {fault.parameter}")
            others.append((first, last))


def _check_parameters(sequence: Sequence, place: Place, known: Known) -> None:
    """Names must exist. If `known` says what a name means (plant.model.find_quantity), values are tried as well."""
    chosen, plan = sequence.model, sequence.plan(0)
    whole = check_overrides(chosen.overrides, place.at("model", "overrides"), known)
    whole &= check_faults(plan, place.at("faults"), known)
    if whole and chosen.name == "eha":  # another model's values are known when it runs
        try:
            model = Model().replace(chosen.overrides)
        except InputError as error:
            raise place.at("model", "overrides").refuse(f"{error.field} {error.expected}") from error
        check_together(plan, model, place.at("faults"))


def _check_checks(sequence: Sequence, place: Place) -> None:
    """Windows and faults that checks point at must be there; names are the lines of a table and must differ."""
    sections, labels = sequence.sections(), Counter(fault.label for fault in sequence.faults)
    used = Counter(check.name for check in sequence.checks)
    for i, check in enumerate(sequence.checks):
        if used[check.name] > 1:
            raise place.at(i, "name").refuse(f"a name used once, not {used[check.name]} times {check.name!r}")
        window = check.window
        if isinstance(window, str) and window != MAIN and window not in sections:
            raise place.at(i, "window").refuse(f"a section: {tables.list_choices(window, [MAIN, *sections])}")
        if isinstance(window, tuple) and window[1] > sequence.duration + 0.5 / RATE:
            raise place.at(i, "window").refuse(f"an end within main's {sequence.duration:g} s, not {window[1]:g}")
        if isinstance(check, ResponseWithin | ShutOff) and isinstance(check.after, str) and labels[check.after] != 1:
            raise place.at(i, "after").refuse(f"a time or one fault: {tables.list_choices(check.after, labels)}")
