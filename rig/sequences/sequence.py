"""A test sequence as data: the command of the actuator, the faults during the test, and the checks afterwards.

A sequence is a TOML file (rig/sequences/ has examples): set-up, main and clean-up as lists of segments, the load on the
ram, faults, checks and guards. Times of loads, faults and checks count from the start of main. All times are in s; the
bench of a run says how many cycles a second has. The table [timing] says how late the bench itself may be. The nominal
test of a plant is the profile that it declares, or the main phase of preflight.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.resources import files
from importlib.resources.abc import Traversable
from math import ceil
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

import numpy as np

from fdi.trace import parse_columns
from plant import (
    EHA,
    LONGEST,
    MOST_FOLLOWING_ERROR,
    RATE,
    Array,
    Csv,
    Hold,
    InputError,
    Place,
    Plant,
    Profile,
    Quantity,
    Segment,
    build_bare_model,
    build_profile,
    find_plant,
    find_quantity,
    list_section_names,
    load_model,
    parse_value,
    require,
    resample_on_cycles,
    run_file,
    segments,
    tables,
)
from rig.benches import Decision
from rig.network import Identity
from rig.sequences import checks, faults
from rig.sequences.checks import MAIN, Check, Guard
from rig.sequences.faults import Fault, Parameter, Plan, find_contradiction
from rig.sequences.protocol import ProtocolLimits
from rig.sequences.python_parts import OWN, PythonPart, PythonSegment, Step, load_function, require_function_name
from rig.sequences.signals import find_tested, name_signals_of
from rig.templates import fill_template

InCycle = Annotated[float, Quantity("s", above=0.0, high=0.1)]


@dataclass(frozen=True, kw_only=True)
class TimingPolicy:
    """Limits in s. An overrun is a cycle in which the bench was late: SYNC beyond `sync`, feedback beyond `feedback`.

    A cycle that begins whole periods late counts as that many overruns. `overruns` says what they lead to: "count"
    plays the sequence to its end and judges its timing then, "abort" ends main when more than `tolerate` come in a row.
    """

    overruns: Literal["count", "abort"] = "count"
    # overruns in a row; None: any number with "count", none with "abort"
    tolerate: Annotated[int, Quantity("1", low=0, high=1_000_000)] | None = None
    share: Annotated[float, Quantity("1", low=0.0, high=1.0)] = 1e-3  # of all cycles; more make the timing invalid
    grace: Annotated[float, Quantity("s", low=0.0, high=LONGEST)] = 0.1  # overruns in it do not count
    sync: InCycle | None = None  # SYNC after it was due; None: half a cycle
    feedback: InCycle | None = None  # from SYNC to the feedback frame; None: half a cycle
    operational: Annotated[float, Quantity("s", above=0.0, high=60.0)] = 1.0  # from NMT start to OPERATIONAL

    @property
    def most_in_a_row(self) -> int | None:
        """Overruns in a row that are accepted; None: any number."""
        return 0 if self.tolerate is None and self.overruns == "abort" else self.tolerate

    def find_limits(self, period: float) -> tuple[float, float]:
        """The limits of SYNC and of feedback, s, where a cycle is `period` s long."""
        sync, feedback = (0.5 * period if limit is None else limit for limit in (self.sync, self.feedback))
        return sync, feedback

    def choose_sync_period(self, period: float, in_a_row: int = 10) -> int:
        """The communication cycle period to write to the nodes in real time (0x1006), us; a cycle is `period` s long.

        CiA 301 does not say when SYNC counts as lost. CANopenNode says so 1.5 periods after the last one. With the true
        period it would report every SYNC that is half a cycle late, which is an error of the bench and not of the bus.
        So 1.5 times the value is at least the longest pause that the sequence accepts: its overruns in a row (or
        `in_a_row`, if more) and one more SYNC that is late by its limit.
        """
        periods_tolerated = 1.5  # after so many times 0x1006 without a SYNC some CANopen stacks call SYNC lost
        pause = (max(self.most_in_a_row or 0, in_a_row) + 1) * period + self.find_limits(period)[0]
        return round(1e6 * period) * ceil(pause / periods_tolerated / period)


PHASES = ("setup", "main", "cleanup", "load")
PREFLIGHT = "preflight.toml"

ReadFile = Callable[[str], bytes]

SEGMENT_KINDS: dict[str, type[Segment]] = {**segments.KINDS, PythonSegment.kind: PythonSegment}
_KINDS: tables.Kinds = {Segment: SEGMENT_KINDS, Fault: faults.KINDS, Check: checks.KEYS}


@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """Which plant to run on: a model's name or file, and parameters that differ from it (SI)."""

    name: str = "eha"
    overrides: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Sequence:
    """A test as the file describes it, and the text it was read from.

    `load` is made of segments in N, or in the unit of the plant's load, and lies over main from its start; after its
    end the last value stays. Without `main` it is the nominal test that the plant declares. `ends` says how the run
    must end to pass: "completed", or "safe_state" for a test whose point is that it is broken off.
    """

    title: str
    description: str = ""
    setup: tuple[Segment, ...] = ()
    main: tuple[Segment, ...] = ()
    cleanup: tuple[Segment, ...] = ()
    load: tuple[Segment, ...] = ()
    faults: tuple[Fault, ...] = ()
    checks: tuple[Check, ...] = ()
    guards: tuple[Guard, ...] = ()
    steps: tuple[Step, ...] = ()
    ends: Literal["completed", "safe_state"] = "completed"
    decision: Decision | None = None  # rule by which checks pass; None: that of the bench
    model: ModelChoice = ModelChoice()
    protocol: ProtocolLimits = field(default_factory=ProtocolLimits)
    timing: TimingPolicy = field(default_factory=TimingPolicy)
    firmware: Identity = field(default_factory=Identity)  # what the controller must say about itself
    name: str = field(default="", metadata=OWN)  # the file's, without folders
    source: str = field(default="", metadata=OWN, repr=False)
    files: Mapping[str, bytes] = field(default_factory=dict, metadata=OWN, repr=False)  # CSV and Python files, by name
    rate: float = field(default=RATE, metadata=OWN)  # cycles a second
    plant: str = "eha"  # whose signals and parameters it names; default: that of the bench or model

    @property
    def duration(self) -> float:
        """Length of main, s."""
        return sum(segment.duration for segment in self.main)

    def build_setup_profile(self) -> Profile:
        """The command before main, from 0."""
        return build_profile(self.setup, rate=self.rate)

    def build_main_profile(self) -> Profile:
        """The command that is judged, from where set-up ended."""
        return build_profile(self.main, self.build_setup_profile().end, self.rate)

    def build_cleanup_profile(self, start: float) -> Profile:
        """The command after main, or after it was broken off at the demand `start`, SI."""
        return build_profile(self.cleanup, start, self.rate)

    def split_phase(self, phase: str) -> list[Array]:
        """The values of each segment of a phase, SI; of the last one also the value that it ends at."""
        profiles: dict[str, Callable[[], Profile]] = {
            "setup": self.build_setup_profile, "main": self.build_main_profile,
            "cleanup": lambda: self.build_cleanup_profile(self.build_main_profile().end),
            "load": lambda: build_profile(self.load, rate=self.rate)}
        values, sections, end = profiles[phase]()
        return [np.append(values, end)[each.start:each.stop + (each is sections[-1])] for each in sections]

    def sections(self) -> dict[str, slice]:
        """Rows of main by section name, as checks see them."""
        return {section.name: slice(section.start, section.stop) for section in self.build_main_profile().sections}

    def build_load_profile(self) -> Array:
        """The load, SI, for every cycle of main."""
        force, _, end = build_profile(self.load, rate=self.rate)
        cycles = round(self.duration * self.rate)
        return np.concatenate((force, np.full(cycles - len(force), end)))

    def plan(self, seed: int) -> Plan:
        """The faults by cycle of the run."""
        start = round(sum(segment.duration for segment in self.setup) * self.rate)
        return Plan(faults=self.faults, start=start, stop=start + round(self.duration * self.rate), seed=seed,
                    rate=self.rate, plant=self.plant)

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
        """When the cycle starts in which each fault begins, s of main, by its label."""
        plan = self.plan(0)
        return {fault.label: (plan.find_cycles(fault)[0] - plan.start) / self.rate for fault in self.faults}

    def bundle(self) -> dict[str, bytes]:
        """The text and the files it uses, by name: all that `from_bundle` needs to make the same sequence."""
        return {self.name: self.source.encode(), **self.files}

    def at_rate(self, rate: float) -> Sequence:
        """The sequence for a run of so many cycles a second.

        Raises:
            InputError: the line of what such cycles cannot show.
        """
        return self if rate == self.rate else Sequence.from_bundle(self.bundle(), rate, self.plant)

    @classmethod
    def from_bundle(cls, bundle: Mapping[str, bytes], rate: float = RATE, plant: str = "eha") -> Sequence:
        """The sequence of a bundle, for `rate` cycles a second and this plant; Python files in it run.

        Raises:
            InputError: a file is not in it or does not make a sequence.
        """
        sources = [name for name in bundle if name.endswith(".toml")]
        require(len(sources) == 1, "bundle", "", f"one .toml file, not {len(sources)}")

        def read_file(name: str) -> bytes:
            require(name in bundle, "bundle", name, "to be part of the bundle")
            return bundle[name]

        return parse_sequence(tables.decode_text(bundle[sources[0]], sources[0]), sources[0], read_file, rate, plant)


def list_shipped() -> dict[str, Traversable]:
    """The sequences that come with the rig, by name."""
    entries = sorted(files("rig.sequences").iterdir(), key=lambda entry: entry.name)
    return {Path(entry.name).stem: entry for entry in entries if entry.name.endswith(".toml")}


def load_sequence(name_or_path: str | Path, rate: float = RATE, plant: str = "eha") -> Sequence:
    """Read a sequence: a TOML file, or the name of one that comes with the rig.

    Args:
        name_or_path: e.g. "preflight" or "tests/mine.toml"; CSV and Python files in it are sought beside it. The
            preflight is that of the plant.
        rate: cycles a second of the bench that is to play it.
        plant: that it is to test, unless it names a model.

    Raises:
        InputError: no such sequence, or the file, line and key that cannot be used and what was expected there.
    """
    shipped = list_shipped()
    if str(name_or_path) in shipped:
        entry, kind = shipped[str(name_or_path)], find_plant(plant)
        is_eha = kind.key == "eha" or (kind.foreign and kind.signals.controlled.name == EHA.controlled.name)
        require(entry.name != PREFLIGHT or kind.profile or is_eha, name_or_path, "",
                f"a sequence of your own: {kind.title} ({kind.key}) declares no nominal test")
        if entry.name == PREFLIGHT and kind.profile:  # the shipped one is that of the EHA
            entry = shipped.get(f"preflight_{kind.key}", entry)
            if entry.name == PREFLIGHT:
                return parse_sequence(write_preflight(kind), PREFLIGHT, lambda _: b"", rate, plant)
        return parse_sequence(entry.read_text(encoding="utf-8"), entry.name, lambda name: tables.read_file(Path(name)),
                              rate, plant)
    path = Path(name_or_path)
    require(path.suffix == ".toml", name_or_path, "",
            f"a .toml file, or {tables.list_choices(str(name_or_path), shipped)}")
    return parse_sequence(tables.decode_text(tables.read_file(path), path), str(path),
                          lambda name: tables.read_file(path.parent / name), rate, plant)


def parse_sequence(text: str, name: str, read_file: ReadFile, rate: float = RATE, plant: str = "eha") -> Sequence:
    """The sequence of a TOML text; `read_file` gives the bytes of the CSV and Python files that it names.

    The Python files run. `rate`: cycles a second. `plant`: that of the test, unless the text names a model.

    Raises:
        InputError: the file, line and key that cannot be used, or the line of a Python file.
    """
    table, place = tables.parse_table(text, name)
    plant = _find_plant(table, place) or plant
    kind = find_plant(plant)
    with name_signals_of(kind.signals):
        sequence: Sequence = tables.build_dataclass(Sequence, table, place, _KINDS)
        sequence = replace(sequence, name=Path(name).name, source=text, rate=rate, plant=plant,
                           main=sequence.main or kind.profile)
        sequence = _fill_in_files(sequence, place, read_file)
    _check_phases(sequence, place)
    _check_faults(sequence, place.at("faults"))
    _check_parameters(sequence, place)
    _check_checks(sequence, place.at("checks"))
    for key in ("sync", "feedback"):
        limit = getattr(sequence.timing, key) or 0.0
        place.at("timing", key).require(limit * rate <= 1.0 + 1e-9, f"at most a cycle, {1 / rate:g} s, not {limit:g}")
    return sequence


def _find_plant(table: Mapping[str, Any], place: Place) -> str:
    """The plant that a sequence names, or that of its model, or ""; a model that cannot be read is refused later."""
    model, plant = table.get("model"), table.get("plant", "")
    if plant:
        place.at("plant").require(isinstance(plant, str),
                                  "the name of a plant: a table belongs into a model file, for --model")
        with place.at("plant").locate():
            return find_plant(plant).key
    name = model.get("name") if isinstance(model, dict) else None
    with suppress(InputError):
        return load_model(name).plant if isinstance(name, str) else ""
    return ""


def write_preflight(kind: Plant) -> str:
    """A preflight for any plant, as TOML: its nominal test, and whether the loop follows at all. The limits are wide.
    """
    command = kind.build_nominal_command()
    span = float(f"{np.ptp(np.append(command, 0.0)):.3g}")
    rest = list_section_names(kind.profile)[-1] if isinstance(kind.profile[-1], Hold) else ""
    return fill_template("sequences/preflight.jinja", kind=kind, span=span, rest=rest, most_error=MOST_FOLLOWING_ERROR)


def _fill_in_files(sequence: Sequence, place: Place, read_file: ReadFile) -> Sequence:
    """The sequence with the columns and functions of its parts filled in from their files."""
    embedded: dict[str, bytes] = {}
    modules: dict[str, ModuleType] = {}

    def read(file: str, here: Place, expected: str) -> bytes:
        try:
            embedded[file] = embedded.get(file) or read_file(file)
        except InputError as error:
            raise here.refuse(f"{expected}; {error}") from error
        return embedded[file]

    def fill_in(part: Any, key: str, here: Place) -> Any:
        if isinstance(part, Csv):
            return replace(part, values=_read_column(part.file, read, key, here.at("file"), 1 / sequence.rate),
                           rate=sequence.rate)
        if isinstance(part, PythonPart):
            file, name = require_function_name(part.python)
            if file not in modules:
                source = read(file, here.at("python"), "a Python file beside the sequence")
                modules[file] = run_file(Path(place.file).parent / file, source)
            return replace(part, function=load_function(modules[file], name, part.given, part.arguments))
        return part

    parts: dict[str, Any] = {
        key: tuple(fill_in(part, key, place.at(key, i)) for i, part in enumerate(getattr(sequence, key)))
        for key in (*PHASES, "checks", "steps")}
    return replace(sequence, files=embedded, **parts)


def _read_column(file: str, read: Callable[[str, Place, str], bytes], phase: str, here: Place, period: float,
                 ) -> tuple[float, ...]:
    """The values of a CSV segment, one a cycle of `period` s."""
    expected = "a readable command file"
    data = read(file, here, expected)
    try:
        columns = parse_columns(data, file, period, find_tested())
    except InputError as error:
        raise here.refuse(f"{expected}; {error}") from error
    values = columns.get("value" if phase == "load" or "com" not in columns else "com")
    if values is None:
        command = find_tested().command.name
        raise here.refuse(f"a file with the columns t and {'value' if phase == 'load' else command}")
    return tuple(values.tolist())


def _check_phases(sequence: Sequence, place: Place) -> None:
    for phase in PHASES:
        for i, segment in enumerate(getattr(sequence, phase)):
            with place.at(phase, i).locate(has_field=True):
                segment.require_rate(sequence.rate)
        names = list_section_names(getattr(sequence, phase))
        for i, name in enumerate(names):
            place.at(phase, i, "name").require(name not in names[:i], f"a name used once, not a second {name!r}")
            place.at(phase, i, "name").require(name != MAIN, f"another name than {MAIN!r}, which is all of main")
    _check_sizes(sequence, place)
    place.at("main").require(sequence.main, "at least one segment")
    length = sum(segment.duration for segment in sequence.load)
    place.at("load").require(round(length * sequence.rate) <= round(sequence.duration * sequence.rate),
                             f"at most the {sequence.duration:g} s that main lasts, not {length:g} s")


def _check_sizes(sequence: Sequence, place: Place) -> None:
    """No demand and no load of a size that can only be a slip of units."""
    signals = find_plant(sequence.plant).signals
    place.at("load").require(not sequence.load or signals.load, "no load: the plant has none")
    for phase in PHASES:
        signal = signals.load or signals.command if phase == "load" else signals.command
        with np.errstate(all="ignore"):  # what overflows is refused below
            try:
                parts = sequence.split_phase(phase)
            except InputError as error:  # a function that computes a segment
                raise (place.at(phase).refuse(error.expected) if error.where == "segment" else error) from error
        for i, values in enumerate(parts):
            largest = np.abs(values).max()
            place.at(phase, i).require(largest <= signal.largest,  # nor NaN
                                       f"at most {signal.largest:g} {signal.unit} either way, not {largest:g}")


def _check_faults(sequence: Sequence, place: Place) -> None:
    """Each begins within main and acts for a cycle or more, and no two change one parameter at the same time."""
    plan = sequence.plan(0)
    spans: dict[str, list[tuple[int, int]]] = {}
    for i, fault in enumerate(sequence.faults):
        place.at(i, "start").require(fault.start < sequence.duration,
                                     f"a time within main's {sequence.duration:g} s, not {fault.start:g}")
        first, last = plan.find_cycles(fault)
        place.at(i, "start" if fault.end is None else "end").require(
            first != last, f"a fault that acts in a cycle of {1 / sequence.rate:g} s of main or more")
        if isinstance(fault, faults.Jitter) and fault.size * sequence.rate >= 1.0:
            raise place.at(i, "size").refuse(f"a time below a cycle, {1 / sequence.rate:g} s, not {fault.size:g}")
        if isinstance(fault, Parameter):
            others = spans.setdefault(fault.parameter, [])
            place.at(i, "start").require(not any(first < b and a < last for a, b in others),
                                         f"a time when no other fault changes {fault.parameter}")
            others.append((first, last))


def _check_parameters(sequence: Sequence, place: Place) -> None:
    """Parameters must exist, values must be in their range, and on the nominal model they must go together."""
    choice, plan = sequence.model, sequence.plan(0)
    overrides, injected = place.at("model", "overrides"), place.at("faults")
    for name, value in choice.overrides.items():
        quantity = _find_meaning(name, overrides.at(name), sequence.plant)
        with overrides.at(name).locate():
            parse_value("", "", quantity, value)
    for i, fault in enumerate(plan.faults):
        if isinstance(fault, Parameter):
            quantity = _find_meaning(fault.parameter, injected.at(i, "parameter"), sequence.plant)
            with injected.at(i).locate(has_field=True):
                fault.find_target(quantity)
    if choice.name == "eha":  # another model's values are known when it runs
        try:
            model = build_bare_model(sequence.plant).replace(choice.overrides)
        except InputError as error:
            raise overrides.refuse(f"{error.field} {error.expected}") from error
        if (contradiction := find_contradiction(plan, model)) is not None:
            raise injected.at(contradiction[0]).refuse(contradiction[1])


def _find_meaning(name: str, place: Place, plant: str) -> Quantity:
    try:
        return find_quantity(name, plant=plant)
    except InputError as error:
        raise place.refuse(f"{error.expected}, not {name!r}") from error


def _check_checks(sequence: Sequence, place: Place) -> None:
    """Windows and faults that checks point at must be there; names are the lines of a table and must differ."""
    sections, labels = sequence.sections(), Counter(fault.label for fault in sequence.faults)
    name_counts = Counter(check.name for check in sequence.checks)
    for i, check in enumerate(sequence.checks):
        window, after = check.window, getattr(check, "after", 0.0)
        place.at(i, "name").require(check.name and name_counts[check.name] == 1, "a name used once, not "
                                    f"{name_counts[check.name]} times {check.name!r}" if check.name else "a name")
        is_known = not isinstance(window, str) or window == MAIN or window in sections
        place.at(i, "window").require(is_known, f"a section: {tables.list_choices(window, [MAIN, *sections])}")
        if isinstance(window, tuple) and window[1] > sequence.duration + 0.5 / sequence.rate:
            raise place.at(i, "window").refuse(f"an end within main's {sequence.duration:g} s, not {window[1]:g}")
        frequency = getattr(check, "frequency", 0.0)
        place.at(i, "frequency").require(frequency < sequence.rate / 2,
                                         f"below half the rate of {sequence.rate:g} Hz, not {frequency:g}")
        begin, end = window if isinstance(window, tuple) else (0.0, sequence.duration)
        bands = [band for segment, (name, rows) in zip(sequence.main, sections.items(), strict=True)
                 if (name == window or window == MAIN or isinstance(window, tuple))
                 and rows.start < end * sequence.rate and begin * sequence.rate < rows.stop
                 for band in _list_bands(segment, sequence.rate / (2 * (rows.stop - rows.start)))]
        place.at(i, "frequency").require(not frequency or any(low <= frequency <= high for low, high in bands),
                                         f"one that the command has in this window, not {frequency:g}")
        place.at(i).require(check.kind != "recovers" or sequence.cleanup, "a clean-up, in which to recover")
        place.at(i, "after").require(labels[after] == 1 if isinstance(after, str) else after < sequence.duration,
                                     f"a time within main's {sequence.duration:g} s" + (
                                         f" or one fault: {tables.list_choices(str(after), labels)}" if labels else
                                         f", not {after!r}"))


def _list_bands(segment: Segment, half_line: float) -> list[tuple[float, float]]:
    """The bands of the frequencies in a segment, Hz, wider by `half_line`; all where no key names them."""
    values = np.ravel([getattr(segment, key) for key in segment.frequencies_in]).tolist()
    pairs = [(min(values), max(values))] if segment.kind == "chirp" else [(each, each) for each in values]
    return [(low - half_line, high + half_line) for low, high in pairs] or [(0.0, np.inf)] * (segment.kind != "hold")


def load_nominal_test(kind: Plant, period: float) -> tuple[Array, Array | None, str]:
    """Demand and load of every cycle of `period` s, (n,) each, and the name of the test; a load of None is none.

    Raises:
        InputError: the plant declares no test.
    """
    if kind.profile:
        return kind.build_nominal_command(period), None, f"profile of {kind.name}"
    require(kind.signals.names == EHA.names, "--command", "",
            f"FILE with the columns t and {kind.signals.command.name}: {kind.name} declares no profile")
    try:
        return (*_sample_preflight(1.0 / period), "preflight")
    except InputError:  # its segments are not whole cycles of this period
        columns = _sample_preflight(RATE)
    t = np.arange(len(columns[0])) / RATE
    command, force = (resample_on_cycles(t, column, period) for column in columns)
    return command, force, "preflight"


def _sample_preflight(rate: float) -> tuple[Array, Array]:
    """Demand, m, and load, N, `rate` values a second. Raises InputError if its segments are not whole cycles."""
    sequence = load_sequence("preflight", rate)
    return sequence.build_main_profile().command, sequence.build_load_profile()
