"""Reads bench files: with the EDS, DCF or DBC that they name they become a `Bench`. docs/bench.md has the keys.

A plant without a device has a bench of its own: a frame of plain CAN for each signal, and the plant's own controller on
it. `rig run --model my_plant.py` takes it where no bench file is given and the shipped one has other signals.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from dbc import EDS
from fdi.foreign_code import ForeignCode, load_plant_of_model, require_trust
from plant import (
    InputError,
    Place,
    Plant,
    Quantity,
    Signals,
    build_dataclass,
    decode_text,
    find_plant,
    find_plant_of_model,
    find_quantity,
    is_known,
    is_loaded,
    list_choices,
    load_plant,
    parse_quantity,
    parse_table,
    read_file,
    require,
)
from rig.benches import can_map, canopen_map
from rig.benches.bench import (
    FD,
    MOST_FRAMES,
    Bench,
    CanopenNode,
    FrameMap,
    FrameSpec,
    Profile,
    Protection,
    Role,
    SignalObject,
    decode_device_text,
    describe_identifier,
    find_word,
    list_inputs,
    list_measured,
    list_outputs,
)
from rig.benches.calibration import read_calibration
from rig.benches.checksums import CHECKSUMS, load_checksum
from rig.benches.layout import PHASES, DeviceFrame, Use, build_fields, compute_counts, list_phases
from rig.templates import fill_template

ReadFile = Callable[[str], bytes]
Byte = Annotated[int, Quantity("1", low=0, high=255)]
EmcyCode = Annotated[int, Quantity("1", low=0, high=0xFFFF)]
NodeId = Annotated[int, Quantity("1", low=1, high=127)]
CYCLE_POSITION = 8  # mode of operation of CiA 402: cyclic synchronous position
_CYCLES = Fraction(1, 10_000), Fraction(1, 10)  # s
_PROFILE_OBJECTS: dict[str, dict[str, tuple[str, bool]]] = {  # signal -> object and whether the device receives it
    "cia402": {"control_word": ("0x6040", True), "status_word": ("0x6041", False), "mode": ("0x6060", True),
               "mode_display": ("0x6061", False)},
    "cia408": {"control_word": ("0x6040", True), "status_word": ("0x6041", False)},
    "none": {},
}


@dataclass(frozen=True)
class NodeKeys:
    """The keys of [plant_node], and those that [controller] has too."""

    node: NodeId | None = None
    eds: str | None = None
    emcy: tuple[EmcyCode, ...] = ()
    inputs: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ControllerKeys(NodeKeys):
    """The keys of [controller]."""

    protocol: Literal["canopen", "can"] = "canopen"
    dbc: str | None = None
    profile: Profile = "none"
    mode: Annotated[int, Quantity("1", low=-128, high=127)] | None = None
    timeout: str | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    phases: Mapping[str, float | str] = field(default_factory=dict)
    ready: Mapping[str, float | str] = field(default_factory=dict)
    protection: Mapping[str, str | int | tuple[int, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class BenchKeys:
    """The keys of a bench file."""

    name: str
    controller: ControllerKeys
    plant: str = "eha"
    plant_node: NodeKeys | None = None
    cycle: str = "1 ms"
    bitrate: Annotated[int, Quantity("bit/s", low=10_000, high=1_000_000)] = 1_000_000
    data_bitrate: Annotated[int, Quantity("bit/s", low=10_000, high=20_000_000)] | None = None
    calibration: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SignalKeys:
    """The keys of an input or output."""

    object: str | None = None
    signal: str | None = None
    count: str | None = None
    offset: str | None = None


@dataclass(frozen=True)
class ProtectionKeys:
    """The keys of a protected signal."""

    kind: str
    data_id: Annotated[int, Quantity("1", low=0, high=0xFFFF)] | tuple[Byte, ...] | None = None


def load_bench(name_or_path: str = "eha", *, is_trusted: bool = False) -> Bench:
    """Read a bench: a TOML file, or the name of one that comes with the rig.

    Args:
        name_or_path: e.g. "eha" or "drive_x.toml"; the files that it names lie beside it.
        is_trusted: whether a Python file that it names, a plant or a checksum, may run.

    Raises:
        InputError: no such bench, or the file, line and key that cannot be used and what was expected there.
    """
    benches = list_benches()
    if name_or_path in benches:
        return _load_shipped(name_or_path)
    path = Path(name_or_path)
    require(path.suffix == ".toml", name_or_path, "", f"a .toml file, or {list_choices(name_or_path, benches)}")
    return _parse_bench(str(path), read_file(path), lambda name: read_file(path.parent / name), path.parent,
                        is_trusted=is_trusted)


def list_benches() -> dict[str, str]:
    """The benches that come with the rig: name and title."""
    names = sorted(Path(entry.name).stem for entry in files("rig.benches").iterdir() if entry.name.endswith(".toml"))
    return {name: _load_shipped(name).name for name in names}


@cache
def _load_shipped(name: str) -> Bench:
    source, folder = files("rig.benches").joinpath(f"{name}.toml"), EDS[1].parent
    return _parse_bench(f"{name}.toml", source.read_bytes(), lambda file: read_file(folder / file), folder,
                        is_trusted=True)


def load_bench_from_files(content: Mapping[str, bytes], signals: Signals | None = None, *,
                          is_trusted: bool = False) -> Bench:
    """The bench of a log, from `Bench.files`: the TOML file, and those that it names; `signals`: of the plant that ran.

    Raises:
        InputError: as of `load_bench`; or a file is missing.
    """
    bench_file = next((name for name in content if name.endswith(".toml")), "")

    def read(name: str) -> bytes:
        require(name in content, bench_file or "log", "", "a file of the log")
        return content[name]

    return _parse_bench(bench_file, read(bench_file), read, Path(), signals, is_trusted=is_trusted)


class _Reader:
    """A bench file while it is read: its keys, where they stand, and the files that it names."""

    def __init__(self, name: str, source: bytes, read: ReadFile, *, is_trusted: bool) -> None:
        table, self.place = parse_table(decode_text(source, name), name)
        self.keys: BenchKeys = build_dataclass(BenchKeys, table, self.place)
        self.plant = self.kind = self.keys.plant  # the model, and what models call its plant
        self.files = {Path(name).name: source}
        self._read, self._is_trusted = read, is_trusted

    def read_file(self, name: str, place: Place) -> bytes:
        """The content of a file that the key at `place` names."""
        place.require(name and "\0" not in name, "the name of a file")
        try:
            self.files[name] = self._read(name)
        except InputError as error:
            raise place.refuse(f"{error.expected}: {name}") from error
        return self.files[name]

    def read_text(self, name: str | None, place: Place, kind: str) -> str:
        """The text of an EDS, DCF or DBC."""
        if name is None:
            raise place.refuse(f"the name of the device's {kind}")
        return decode_device_text(self.read_file(name, place))

    def find_checksum(self, kind: str, place: Place) -> str:
        """The name of a checksum for `Field.checksum`; a file of the user's runs, if the user trusts it."""
        file, _, function = kind.rpartition(":")
        if kind in CHECKSUMS or not file.endswith(".py"):
            place.require(kind in CHECKSUMS,
                          f"counter, FILE.py:FUNCTION or a checksum: {list_choices(kind, CHECKSUMS)}")
            return kind
        is_announced = file in self.files
        source = self.read_file(file, place)
        if not is_announced:
            require_trust(place.file, [ForeignCode(file, source)], is_trusted=self._is_trusted)
        return load_checksum(file, source, function)


def _parse_bench(name: str, source: bytes, read: ReadFile, folder: Path, signals: Signals | None = None, *,
                 is_trusted: bool) -> Bench:
    """The bench of a file; `read` gives the content of the files that it names, `folder` is where they lie.

    `signals`: of its plant; None: the plant is found and loaded.
    """
    reader = _Reader(name, source, read, is_trusted=is_trusted)
    keys, place = reader.keys, reader.place.at("controller")
    if signals is None:
        reader.plant, reader.kind = _find_plant(reader, folder, is_trusted=is_trusted)
        signals = find_plant(reader.kind).signals
    cycle_ns = _read_time(keys.cycle, reader.place.at("cycle"), *_CYCLES)
    timeout_ns = None if keys.controller.timeout is None else _read_time(
        keys.controller.timeout, place.at("timeout"), Fraction(cycle_ns, 10**9), Fraction(10))
    is_canopen = keys.controller.protocol == "canopen"
    uses = _list_uses(keys.controller, place, signals, is_canopen=is_canopen)
    _add_states(reader, uses, keys.controller, place, is_canopen=is_canopen)
    _check_signals(uses, (signals.command.word, signals.controlled.word), (signals.drive.word,), place)
    for use in uses.values():
        use.place.require(not (use.signal in ("control_word", "mode") and keys.controller.profile == "none"),
                          "a profile that gives it a meaning, or values in [controller.phases]")
    nodes: dict[Role, CanopenNode] = {}
    sync = None
    if is_canopen:
        frames, sync, nodes[Role.CONTROLLER] = _map_node(reader, keys.controller, place, uses, folder)
    else:
        _refuse_canopen_keys(keys, reader.place)
        text = reader.read_text(keys.controller.dbc, place.at("dbc"), "DBC")
        dbc = keys.controller.dbc or ""
        frames = can_map.map_messages(dbc, can_map.read_database(dbc, text), uses, cycle_ns)
    specs = [_build_spec(frame, uses, signals) for frame in frames]
    if keys.plant_node is not None:
        specs, nodes[Role.PLANT] = _join_plant_node(reader, specs, sync, nodes, folder, signals)
    reader.place.require(len(specs) <= MOST_FRAMES, f"at most {MOST_FRAMES} frames or pages of multiplexed ones")
    phases, ready = _list_states(frames, uses)
    decision, calibration = read_calibration(_group_keys(keys.calibration, 0), reader.place.at("calibration"), signals)
    nominal = find_plant(reader.kind).nominal if is_known(reader.kind) else {}
    bench = Bench(name=keys.name, frames=FrameMap(frames=tuple(specs), sync=sync), nodes=nodes, plant=reader.plant,
                  kind=reader.kind, signals=signals, noise=nominal.get(signals.controlled.noise, 0.0),
                  cycle_ns=cycle_ns, bitrate=keys.bitrate, data_bitrate=keys.data_bitrate, timeout_ns=timeout_ns,
                  phases=phases, ready=ready, files=reader.files, decision=decision, calibration=calibration)
    _check_identifiers(bench, reader.place)
    return bench


def _read_time(text: str, place: Place, low: Fraction, high: Fraction) -> int:
    """A time with its unit, in ns."""
    time = parse_quantity(text, "s", place)
    place.require(low <= time <= high and not time * 1_000_000 % 1,
                  f"whole microseconds from {float(low * 1000):g} to {float(high * 1000):g} ms, not {text!r}")
    return int(time * 1_000_000_000)


def _refuse_canopen_keys(keys: BenchKeys, place: Place) -> None:
    """Refuse keys of CANopen on plain CAN."""
    for key in ("node", "eds", "mode", "parameters", "values", "profile", "emcy"):
        place.at("controller", key).require(getattr(keys.controller, key) in (None, {}, "none", ()),
                                            'protocol = "canopen" together with this key')
    place.at("plant_node").require(keys.plant_node is None, 'protocol = "canopen" of the controller')


# ---------------------------------------------------------------------------------------------------------------------
# What each value of the device is for
# ---------------------------------------------------------------------------------------------------------------------

def _find_plant(reader: _Reader, folder: Path, *, is_trusted: bool) -> tuple[str, str]:
    """The model of a bench file, and what models call its plant; a Python file runs, if the user trusts it."""
    model, place = reader.keys.plant, reader.place.at("plant")
    path = folder / model if Path(model).suffix and (folder / model).is_file() else Path(model)
    if path.suffix == ".py":
        content = reader.read_file(model, place)
        reader.files.pop(model)  # a log has it as the plant of the run
        if not is_loaded(path, content):  # a user who names it himself trusts it
            require_trust(place.file, [ForeignCode(model, content)], is_trusted=is_trusted)
        load_plant(path, content)
    else:
        load_plant_of_model(path, is_trusted=is_trusted)
    with place.locate():
        return str(path), find_plant_of_model(str(path))


def _list_uses(keys: NodeKeys, place: Place, signals: Signals, *, is_canopen: bool, is_plant: bool = False,
               ) -> dict[str, Use]:
    """The signals of [inputs] and [outputs] by the object or MESSAGE.SIGNAL that carries them.

    `is_plant`: they are those of the plant node, which receives what a controller sends.
    """
    uses: dict[str, Use] = {}
    inputs, outputs = list_inputs(signals), list_outputs(signals)
    needed_signals = {signals.drive.word, *list_measured(signals)}
    for table, units, is_received in (("inputs", outputs if is_plant else inputs, True),
                                      ("outputs", inputs if is_plant else outputs, False)):
        for entry_name, entry in _group_keys(getattr(keys, table), 0).items():
            entry_place, signal = place.at(table, entry_name), find_word(signals, entry_name)
            entry_place.require(signal in units,
                                f"a signal of the bench and its plant: {list_choices(entry_name, units)}")
            word = "object" if is_canopen else "signal"
            signal_keys = build_dataclass(
                SignalKeys, {word if key == "" else key: text for key, text in entry.items()}, entry_place)
            name = signal_keys.object if is_canopen else signal_keys.signal
            if name is None or (signal_keys.signal if is_canopen else signal_keys.object) is not None:
                raise entry_place.refuse(f"a table with {word} = " + ('"0x607A"' if is_canopen else '"MESSAGE.SIGNAL"'))
            count, offset = (None if text is None else parse_quantity(text, units[signal], entry_place.at(key))
                             for key, text in (("count", signal_keys.count), ("offset", signal_keys.offset)))
            entry_place.at("count").require(count != 0, "a number other than 0")
            use = Use(place=entry_place, is_received=is_received, signal=signal, unit=units[signal], count=count,
                      offset=offset, is_needed=signal in needed_signals)
            _add_use(uses, name, use, is_canopen=is_canopen)
    return uses


def _group_keys(flat: Mapping[str, Any], dots: int) -> dict[str, dict[str, Any]]:
    """Dotted keys by their first parts, of which there is one more than `dots`.

    >>> _group_keys({"Demand.Enable.main": 1, "Demand.Crc": "crc8"}, 1)
    {'Demand.Enable': {'main': 1}, 'Demand.Crc': {'': 'crc8'}}
    """
    groups: dict[str, dict[str, Any]] = {}
    for full, value in flat.items():
        parts = full.split(".")
        groups.setdefault(".".join(parts[:dots + 1]), {})[".".join(parts[dots + 1:])] = value
    return groups


def _add_use(uses: dict[str, Use], name: str, use: Use, *, is_canopen: bool) -> None:
    """Add a use, once for each object or signal."""
    key = name
    if is_canopen:
        indices = canopen_map.parse_object(name)
        if indices is None:
            raise use.place.refuse(f"an object such as 0x2110:1, not {name!r}")
        key = canopen_map.name_object(*indices)
    if key in uses:
        raise use.place.refuse(f"each value of the device once; {key} is {uses[key].place.keys} already")
    uses[key] = use


def _add_states(reader: _Reader, uses: dict[str, Use], keys: ControllerKeys, place: Place, *, is_canopen: bool) -> None:
    """Add the values of [phases], [ready] and [protection]."""
    dots = 0 if is_canopen else 1
    for name, values in _group_keys(keys.phases, dots).items():
        entry_place = place.at("phases", name)
        for phase in values:
            entry_place.require(phase in PHASES, f"values by phase: {list_choices(phase or None, PHASES)}")
        _add_use(uses, name, Use(place=entry_place, is_received=True, values=values), is_canopen=is_canopen)
    for name, value in keys.ready.items():
        use = Use(place=place.at("ready", name), is_received=False, values={"main": value})
        _add_use(uses, name, use, is_canopen=is_canopen)
    for name, entry in _group_keys(keys.protection, dots).items():
        entry_place = place.at("protection", name)
        protection = build_dataclass(ProtectionKeys, {key or "kind": list(value) if isinstance(value, tuple) else value
                                                      for key, value in entry.items()}, entry_place)
        entry_place.at("data_id").require(protection.kind != "counter" or protection.data_id is None,
                                          "a checksum with it")
        use = Use(place=entry_place, is_received=None, protection=Protection.COUNTER)
        if protection.kind != "counter":
            checksum = reader.find_checksum(protection.kind, entry_place)
            use = _set_data_id(replace(use, protection=Protection.CHECKSUM, checksum=checksum), protection.data_id)
        _add_use(uses, name, use, is_canopen=is_canopen)


def _set_data_id(use: Use, data_id: int | tuple[int, ...] | None) -> Use:
    """The use of a checksum with its data ID."""
    if use.checksum == "e2e_profile_2" and isinstance(data_id, tuple) and len(data_id) == 16:
        return replace(use, data_ids=data_id)
    if use.checksum == "e2e_profile_1" and isinstance(data_id, int):
        return replace(use, data_id=data_id)
    use.place.require(not use.checksum.startswith("e2e") and data_id is None,
                      "a data_id of 0 to 65535 with e2e_profile_1, data_id = [16 numbers], one for each value "
                      "of the counter, with e2e_profile_2, and none with the others")
    return use


def _check_signals(uses: Mapping[str, Use], inputs: tuple[str, ...], outputs: tuple[str, ...], place: Place) -> None:
    """Refuse a device without the signals that every run needs."""
    for table, signals, is_received in (("inputs", inputs, True), ("outputs", outputs, False)):
        device_signals = {use.signal for use in uses.values() if use.is_received is is_received}
        for signal in signals:
            place.at(table).require(signal in device_signals, f"also the signal {signal}")


def _list_states(frames: list[DeviceFrame], uses: Mapping[str, Use],
                 ) -> tuple[dict[str, Mapping[str, float]], dict[str, float]]:
    """Counts by phase of the values that the rig sends, and of those that it waits for."""
    phases: dict[str, Mapping[str, float]] = {}
    ready: dict[str, float] = {}
    for slot in (slot for frame in frames for slot in frame.slots):
        use = uses.get(slot.name)
        if use is not None and use.values and use.is_received:
            phases[slot.name] = list_phases(slot, use)
        elif use is not None and use.values:
            ready[slot.name] = compute_counts(slot, use.values["main"], use.place)
    return phases, ready


# ---------------------------------------------------------------------------------------------------------------------
# Nodes and frames
# ---------------------------------------------------------------------------------------------------------------------

def _map_node(reader: _Reader, keys: NodeKeys, place: Place, uses: dict[str, Use], folder: Path,
              ) -> tuple[list[DeviceFrame], int, CanopenNode]:
    """The PDOs, the identifier of SYNC, and the node; the objects of its profile are added to the uses."""
    if keys.node is None:
        raise place.refuse("also the key 'node', a node-ID from 1 to 127")
    eds = keys.eds or ""
    dictionary = canopen_map.read_dictionary(eds, reader.read_text(keys.eds, place.at("eds"), "EDS or DCF"), keys.node)
    node = CanopenNode(node=keys.node, eds=folder / eds, values=canopen_map.list_values(dictionary),
                       emcy=keys.emcy, emcy_id=canopen_map.find_emcy(dictionary, keys.node))
    if isinstance(keys, ControllerKeys):
        _add_profile(uses, dictionary, keys, place)
        place.at("mode").require(keys.profile == "cia402" or keys.mode is None, 'profile = "cia402" with it')
        mode = CYCLE_POSITION if keys.profile == "cia402" and keys.mode is None else keys.mode
        node = replace(node, profile=keys.profile, mode=mode, settings=tuple(_list_settings(
            reader.kind, dictionary, keys.parameters, place.at("parameters"))),
            values=(*node.values, *_list_values(dictionary, keys.values, place.at("values"))))
    frames = list(canopen_map.map_pdos(eds, dictionary, keys.node, uses))
    node = replace(node, inputs=_list_objects(frames, uses, is_received=True),
                   outputs=_list_objects(frames, uses, is_received=False))
    return frames, canopen_map.find_sync(dictionary), node


def _list_objects(frames: list[DeviceFrame], uses: Mapping[str, Use], *, is_received: bool) -> dict[str, SignalObject]:
    """The objects of a node by the signal that they hold."""
    objects = {}
    for frame in (each for each in frames if each.is_received is is_received):
        fields = {each.lowest: each for each in build_fields(frame, uses)}
        for slot in frame.slots:
            use, key = uses.get(slot.name), canopen_map.parse_object(slot.name)
            if use is not None and use.signal and key is not None:
                objects[use.signal] = SignalObject(key, fields[slot.bits.lowest])
    return objects


def _add_profile(uses: dict[str, Use], dictionary: Any, keys: ControllerKeys, place: Place) -> None:
    """Add the objects that the profile gives a meaning; its modes only where a PDO maps them."""
    used_signals = {(use.signal, use.is_received) for use in uses.values()}
    for signal, (key, is_received) in _PROFILE_OBJECTS[keys.profile].items():
        is_optional = signal.startswith("mode") and not canopen_map.is_mapped(dictionary, key, is_received=is_received)
        if key not in uses and (signal, is_received) not in used_signals and not is_optional:
            uses[key] = Use(place=place.at("profile"), is_received=is_received, signal=signal)


def _find_writable(dictionary: Any, key: str, place: Place) -> Any:
    """The object of the EDS that a key such as 0x2110:1 names, which can be written."""
    index, sub = canopen_map.parse_object(key) or (0, 0)
    variable = canopen_map.find_variable(dictionary, index, sub)
    if variable is None or not variable.writable:
        raise place.refuse("an object of the EDS that can be written, such as 0x2110:1")
    return variable


def _list_values(dictionary: Any, values: Mapping[str, float], place: Place) -> Iterator[tuple[int, int, bytes]]:
    """Objects that are written at bring-up, after those of a DCF."""
    for key, value in values.items():
        variable = _find_writable(dictionary, key, place.at(key))
        data = canopen_map.encode_value(variable, value)
        if data is None:
            raise place.at(key).refuse(f"a number that {variable.name} can hold, not {value:g}")
        yield variable.index, variable.subindex, data


def _list_settings(plant: str, dictionary: Any, parameters: Mapping[str, str],
                   place: Place) -> Iterator[tuple[int, int, str]]:
    """Objects that hold parameters of the model."""
    for name, parameter in parameters.items():
        entry_place = place.at(name)
        variable = _find_writable(dictionary, name, entry_place)
        if is_known(plant):
            with entry_place.locate():
                find_quantity(parameter, "", plant)
        yield variable.index, variable.subindex, parameter


def _build_spec(frame: DeviceFrame, uses: Mapping[str, Use], signals: Signals) -> FrameSpec:
    """A frame of the controller as one of the bench."""
    spec = replace(frame.spec, fields=build_fields(frame, uses))
    roles = {"drive": not frame.is_received and spec.has(signals.drive.word),
             "command": frame.is_received and spec.has(signals.command.word, "control_word"),
             "feedback": frame.is_received and spec.has(*list_measured(signals))}
    return replace(spec, roles=tuple(role for role, is_own in roles.items() if is_own))


def _join_plant_node(reader: _Reader, specs: list[FrameSpec], sync: int | None, nodes: Mapping[Role, CanopenNode],
                     folder: Path, signals: Signals) -> tuple[list[FrameSpec], CanopenNode]:
    """The frames with those of [plant_node], and the node; a frame that both know is one."""
    keys, place = reader.keys.plant_node, reader.place.at("plant_node")
    assert keys is not None
    uses = _list_uses(keys, place, signals, is_canopen=True, is_plant=True)
    _check_signals(uses, (signals.drive.word,), (signals.controlled.word,), place)
    frames, own_sync, node = _map_node(reader, keys, place, uses, folder)
    place.at("node").require(node.node != nodes[Role.CONTROLLER].node,
                             f"a node-ID other than {node.node}, which the controller has")
    place.at("eds").require(own_sync == sync, "the controller's identifier of SYNC in 0x1005")
    by_identifier = {spec.identifier: spec for spec in specs}
    for frame in frames:
        plant_spec = replace(frame.spec, name=f"plant {frame.spec.name}", sender=Role.PLANT,
                             fields=build_fields(frame, uses), roles=("valve_state",))
        controller_spec = by_identifier.get(plant_spec.identifier)
        place.at("inputs").require(controller_spec is not None or not frame.is_received,
                                   f"a frame of the controller; it has none with the COB-ID of {frame.spec.name}, "
                                   f"{describe_identifier(plant_spec.identifier)}")
        if controller_spec is not None:
            plant_spec = _join_frame(controller_spec, plant_spec, frame, place)
        by_identifier[plant_spec.identifier] = plant_spec
    return list(by_identifier.values()), node


def _join_frame(controller_spec: FrameSpec, plant_spec: FrameSpec, frame: DeviceFrame, place: Place) -> FrameSpec:
    """The frame that the controller has as `controller_spec` and the plant node as `plant_spec`."""
    place.at("outputs").require(frame.is_received or controller_spec.sender is not Role.CONTROLLER,
                                f"COB-IDs that the controller does not send; {frame.spec.name} has "
                                f"{describe_identifier(plant_spec.identifier)} too")
    pairs = list(zip(controller_spec.fields, plant_spec.fields, strict=False))
    is_alike = len(controller_spec.fields) == len(plant_spec.fields) and all(
        (first.lowest, first.length) == (second.lowest, second.length)
        and (first == second or not first.name or not second.name) for first, second in pairs)
    place.at("eds").require(is_alike and controller_spec.length == plant_spec.length,
                            f"the layout and counts of the controller's {controller_spec.name} in {frame.spec.name}, "
                            f"{describe_identifier(plant_spec.identifier)}")
    spec = replace(controller_spec, fields=tuple(first if first.name else second for first, second in pairs))
    if frame.is_received:
        return spec
    return replace(spec, sender=Role.PLANT, every=plant_spec.every, is_answer=plant_spec.is_answer,
                   is_before_sync=False)


def _check_identifiers(bench: Bench, place: Place) -> None:
    """Refuse an identifier that two frames or services of nodes have."""
    owners: dict[int, str] = {}
    for identifier, name in (*bench.list_services(), *(
            (spec.identifier & ~FD, spec.name.partition("[")[0]) for spec in bench.frames.frames)):  # pages share it
        place.at("controller").require(owners.setdefault(identifier, name) == name,
                                       f"each identifier once; {name} and {owners[identifier]} have "
                                       f"{describe_identifier(identifier)}")


_PLANT_BENCH, _PLANT_DBC = "plant_bench.toml", "plant_bench.dbc"


def make_plant_bench(plant: Plant, model: str) -> Bench:
    """The bench for a plant, with the cycle of its law: command and readings out, drive back, as 64-bit numbers.

    Args:
        plant: as declared.
        model: that has it; the folder of its file is left out.

    Raises:
        InputError: its law has a cycle that no bench has.
    """
    name, cycle = Path(model).name, f"{1e6 * plant.nominal['controller.period']:.12g} us"
    _read_time(cycle, Place(name).at("controller", "period"), *_CYCLES)
    context = {"title": plant.title, "model": name, "cycle": cycle, "dbc": _PLANT_DBC, "drive": plant.signals.drive,
               "sent": (plant.signals.command, *plant.signals.outputs)}
    return load_bench_from_files({_PLANT_BENCH: fill_template("benches/plant_bench.jinja", **context).encode(),
                                  _PLANT_DBC: fill_template("benches/plant_dbc.jinja", **context).encode()},
                                 plant.signals)


def is_plant_bench(bench: Bench) -> bool:
    """Whether the plant's own controller can be the controller of this bench."""
    return next(iter(bench.files), "") == _PLANT_BENCH
