"""A run as data: everything that determines its result, from the command line or from an earlier run's log."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from fdi.foreign_code import (
    Announce,
    ForeignCode,
    load_effects_of_model,
    load_plant_of_model,
    print_on_standard_error,
    require_different_names,
    require_trust,
)
from fdi.output import write_whole
from fdi.trace import Trace, locate_log, open_log
from plant import (
    EHA,
    Choice,
    InputError,
    Model,
    Place,
    Quantity,
    Signals,
    build_dataclass,
    find_plant,
    find_plant_of_model,
    find_quantity,
    load_model,
    load_plant,
    parse_model,
    parse_toml,
    read_named_plant,
    report_system_error,
    require,
)
from plant.effects import load_effects
from rig.benches import Bench, is_plant_bench, load_bench, load_bench_from_files, make_plant_bench
from rig.nodes import Scenario
from rig.run.choices import CONTROLLERS, PACES, PLANTS
from rig.sequences import Sequence, load_sequence, require_possible

# folders of the attachments
_EFFECT_FOLDER, _SEQUENCE_FOLDER, _BENCH_FOLDER, _PLANT_FOLDER = "effects/", "sequence/", "bench/", "plant/"


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """How a run is to be played; a log has the same as metadata, as texts."""

    seed: Annotated[int, Quantity("1", low=0)] = 0
    bus: str = "embedded"
    pace: Annotated[str, Choice(lambda: PACES)] = "lockstep"
    controller: Annotated[str, Choice(lambda: CONTROLLERS)] = "builtin"
    plant: Annotated[str, Choice(lambda: PLANTS)] = "auto"
    max_overruns: Annotated[float, Quantity("1", low=0.0, high=1.0)] = 1e-3  # of all cycles, in real time


@dataclass(frozen=True, kw_only=True)
class Job(RunSettings):
    """One run.

    The sequence is sampled at the rate of the bench, whose cycle is the period of the model's controller.

    Raises InputError for a controller of ours on the bench of another device, for a sequence that cannot be sampled at
    this rate, and for demands and faults that the bench cannot have.
    """

    sequence: Sequence
    model: Model
    bench: Bench = field(default_factory=load_bench)
    effects: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        kind = self.model.kind
        noise = kind.nominal.get(kind.signals.controlled.noise, 0.0)
        object.__setattr__(self, "bench", self.bench.replace_signals(kind.signals, noise, self.model.name))
        require_possible(self.sequence.faults, self.bench, self.sequence.name)
        require(self.plant != "external" or self.bench.has_plant_node, "--plant", self.plant,
                f"auto: the rig moves the plant of {self.bench.name!r}, which has no plant node")
        require(self.plant == "external" or not self.bench.has_plant_node or speaks_as_shipped(self.bench),
                "--plant", self.plant,
                f"external: our own plant emulator does not speak as that of {self.bench.name!r}")
        require(self.controller == "external" or speaks_as_shipped(self.bench)
                or (self.controller == "builtin" and is_plant_bench(self.bench)), "--controller", self.controller,
                f"external: our own firmware does not speak as the device of {self.bench.name!r}")
        object.__setattr__(self, "sequence", self.sequence.at_rate(self.bench.rate))
        object.__setattr__(self, "model", self.model.replace({"controller.period": self.period_ns / 1e9}))
        self._require_range()
        self.model.require_acting_load(self.sequence.build_load_profile(), self.sequence.name)

    def _require_range(self) -> None:
        """Refuse a demand that its frame cannot hold: the frame would carry another one than the checks judge."""
        signal = self.bench.signals.command
        margin = 0.5 * self.bench.find_count(signal.word)  # a demand is rounded
        for frame, _, low, high in self.bench.list_ranges("command"):
            for phase in ("setup", "main", "cleanup"):
                for i, demands in enumerate(self.sequence.split_phase(phase)):
                    require(low - margin <= demands.min() and demands.max() <= high + margin, self.sequence.name,
                            f"{phase}[{i}]", f"demands from {low:g} to {high:g} {signal.unit}, which frame {frame} of "
                            f"{self.bench.name!r} can hold, not from {demands.min():g} to {demands.max():g}")

    @property
    def realtime(self) -> bool:
        """Whether the wall clock sets the pace."""
        return self.pace == "realtime"

    @property
    def period_ns(self) -> int:
        """Length of a cycle, ns."""
        return self.bench.cycle_ns

    @cached_property
    def scenario(self) -> Scenario:
        """The plant's scenario; computed once, because a long test has many cycles."""
        sequence = self.sequence
        return Scenario.build(self.model, sequence.plan(self.seed), sequence.build_load_profile(), self.seed)

    def build_attachments(self) -> dict[str, tuple[str, bytes]]:
        """What a log carries so that the run can be repeated: name to (media type, bytes)."""
        kind = self.model.kind
        return {
            "model.toml": ("application/toml", self.model.to_toml().encode()),
            **{_SEQUENCE_FOLDER + name: ("text/plain", data) for name, data in self.sequence.bundle().items()},
            **{_EFFECT_FOLDER + path.name: ("text/x-python", path.read_bytes()) for path in self.effects},
            **{_PLANT_FOLDER + path.name: ("text/plain", kind.source or path.read_bytes())
               for path in ((kind.file, Path(kind.key)) if kind.foreign else (kind.file,)) if path is not None},
            **{_BENCH_FOLDER + name: ("text/plain", data) for name, data in self.bench.files.items()}}

    def list_settings(self) -> dict[str, object]:
        """The settings of the run, for the log's metadata."""
        return {**{each.name: getattr(self, each.name) for each in fields(RunSettings)},
                "bench": next(iter(self.bench.files), self.bench.name), "model": self.model.name,
                "sequence": self.sequence.title, "period": self.period_ns / 1e9}


def replace_settings(job: Job, **settings: Any) -> Job:
    """The job with the settings that are not None."""
    return replace(job, **{key: value for key, value in settings.items() if value is not None})


def require_bench_cycle(model: Model, bench: Bench, where: object) -> None:
    """Refuse a model that asks for another period of the controller than the cycle of the bench.

    The nominal period asks for none.

    Raises:
        InputError: it names `where` the model comes from.
    """
    cycle = bench.cycle_ns / 1e9
    require(model["controller.period"] in (cycle, model.nominal["controller.period"]), where, "controller.period",
            f"{cycle:g} s, the cycle of {bench.name!r}: a bench file gives another, and rig simulate takes any")


def read_job(path: Path, *, is_trusted: bool = False, announce: Announce = print_on_standard_error) -> Job:
    """Read the job that produced a log.

    `is_trusted`: whether effect files in the log may run; `announce` gets a line about each before it runs.

    Raises:
        InputError: the file is no log of a run, a setting in it is impossible, or it brings code along that is not
            trusted.
    """
    trace = Trace.read(path, all=True)
    attachments, provenance = trace.attachments, trace.provenance
    bundle = {name.removeprefix(_SEQUENCE_FOLDER): data for name, data in attachments.items()
              if name.startswith(_SEQUENCE_FOLDER)}
    texts = {each.name: provenance[each.name] for each in fields(RunSettings) if each.name in provenance}
    require("model.toml" in attachments and bundle and len(texts) == len(fields(RunSettings)), path, "attachments",
            "the sequence and the model of a run; only logs of `rig run` have them")
    effect_codes = [ForeignCode(name, content) for name, content in attachments.items()
                    if name.startswith(_EFFECT_FOLDER)]
    plant_codes = [ForeignCode(name, content) for name, content in attachments.items()
                   if name.startswith(_PLANT_FOLDER)]
    codes = [*effect_codes, *plant_codes, *(ForeignCode(_SEQUENCE_FOLDER + name, content)
                                            for name, content in bundle.items() if name.endswith(".py"))]
    for name in (*(code.name for code in codes), *(_SEQUENCE_FOLDER + name for name in bundle if name[-5:] == ".toml")):
        _require_file_name(path, name)
    settings = build_dataclass(RunSettings, {name: _read_number(text) for name, text in texts.items()},
                               Place(f"{path}: metadata run"))
    require_trust(path, codes, is_trusted=is_trusted, announce=announce)
    where = f"{path}: model.toml"
    try:
        tables = parse_toml(attachments["model.toml"].decode(), where)
    except UnicodeDecodeError as error:
        raise InputError(path, "attachment model.toml", "text in UTF-8") from error
    if plant_codes:
        tables["plant"] = _load_stored_plant(plant_codes, str(tables.get("plant")), keeps_name=True)
    effects = tuple(_store_code(effect_codes))
    for code, file in zip(effect_codes, effects, strict=True):
        load_effects(file, code.content)
    model = parse_model(tables, where)
    bench = _read_bench(attachments, provenance.get("bench", ""), model.kind.signals, is_trusted=is_trusted)
    require_bench_cycle(model, bench, where)
    sequence = Sequence.from_bundle(bundle, bench.rate, model.plant)
    return Job(sequence=sequence, model=model, bench=bench, effects=effects, **asdict(settings))


def load_plant_of_log(path: Path, *, is_trusted: bool = False, announce: Announce = print_on_standard_error) -> str:
    """The plant that a log was recorded on, as models call it; a user's, which the log holds, runs if it is trusted.

    "" for the plant `eha`, and for what is no log of a run.

    Raises:
        InputError: it is not trusted, or cannot be used.
    """
    try:
        log = open_log(locate_log(path))
        tables = parse_toml(log.attachments.get("model.toml", b"").decode(), f"{path}: model.toml")
    except (InputError, UnicodeDecodeError):  # whoever reads it as a trace says what is wrong
        return ""
    plant_name = str(tables.get("plant", ""))
    codes = [ForeignCode(name, content) for name, content in log.attachments.items() if name.startswith(_PLANT_FOLDER)]
    if not codes:
        return plant_name
    for code in codes:
        _require_file_name(path, code.name)
    require_trust(path, codes, is_trusted=is_trusted, announce=announce)
    return _load_stored_plant(codes, plant_name)


def _load_stored_plant(codes: list[ForeignCode], plant_name: str, *, keeps_name: bool = False) -> str:
    """Load the plant that a log calls so, from the files in it; what models call it from now on.

    That is the path of a file which other processes can read, or, with `keeps_name`, its name in the log.
    """
    files = dict(zip(codes, _store_code(codes), strict=True))
    code = next((code for code in codes if Path(code.name).name == Path(plant_name).name), codes[0])
    file = files[code]
    if file.suffix != ".py":
        return str(read_named_plant(str(file), file))
    is_same = Path(plant_name).is_file() and Path(plant_name).read_bytes() == code.content
    return load_plant(Path(plant_name) if is_same else file, code.content,
                      plant_name if keeps_name or is_same else "").key


def _read_bench(attachments: Mapping[str, bytes], name: str, signals: Signals, *, is_trusted: bool) -> Bench:
    """The bench of a log, whose file has this name; a log without one was made on the shipped bench.

    `signals`: of the plant that ran.
    """
    files = {key.removeprefix(_BENCH_FOLDER): data for key, data in attachments.items()
             if key.startswith(_BENCH_FOLDER)}
    if not files:
        return load_bench()
    return load_bench_from_files({name: files.get(name, b""), **files}, signals, is_trusted=is_trusted)


def speaks_as_shipped(bench: Bench) -> bool:
    """Whether our own firmware is a controller of this bench: frames and nodes are those of the shipped one."""
    layout, shipped_layout = (
        ([asdict(frame) for frame in each.frames.frames], each.frames.sync,
         {role: node.node for role, node in each.nodes.items()}) for each in (bench, load_bench()))
    return layout == shipped_layout


def _require_file_name(log: Path, name: str) -> None:
    """Refuse an attachment whose name, below its folder, cannot be that of a plain file on every machine."""
    plain = name.partition("/")[2]
    if not plain.isprintable() or "/" in plain or "\\" in plain or plain.startswith(".") or not 0 < len(plain) <= 100:
        short_name = name if len(name) <= 100 else f"{name[:100]}.. ({len(name)} characters)"
        raise InputError(log, f"attachment {short_name!r}",
                         "the name of a file, without folders, of at most 100 characters")


def _read_number(text: str) -> object:
    """The number that a text of the metadata is; the text itself if it is none."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _store_code(codes: list[ForeignCode]) -> Iterator[Path]:
    """Write a user's code to files, which outlive this process: nodes in other processes read them."""
    from plant import find_cache_folder, make_private_folder

    digest = hashlib.sha256(repr([(code.name, code.content) for code in codes]).encode()).hexdigest()
    for code in codes:
        with report_system_error(code.name, "", "room for its code in the cache folder"):
            folder = make_private_folder(find_cache_folder() / f"effects-{digest}")
            file = folder / code.name.partition("/")[2]
            if not file.is_file() or file.read_bytes() != code.content:
                with write_whole(file) as part:
                    part.write_bytes(code.content)
        yield file


class JobChoice(NamedTuple):
    """What a user chooses of a run; None: as the sequence says, or the default."""

    sequence: str = "preflight"  # a file, or the name of a shipped one
    model: str | None = None  # a file, or the name of a shipped one
    changes: Mapping[str, str | float] = {}  # "GROUP.FIELD" to value, SI
    seed: int = 0
    effects: tuple[Path, ...] = ()  # files of the user's own effects
    bench: str | None = None  # a file, or the name of a shipped one
    bus: str = "embedded"
    pace: str | None = None
    controller: str | None = None
    plant: str | None = None
    max_overruns: float | None = None
    is_diagnosed: bool = False  # whether `rig fdi` judges the actuator after the run


def load_tested_plant(choice: JobChoice, *, is_trusted: bool = False, announce: Announce = print_on_standard_error,
                      ) -> tuple[Bench, str]:
    """The bench, and what models call the plant on it, which is loaded. Raises InputError."""
    if choice.model:  # first: a plant that the user names himself is trusted in the bench file as well
        load_plant_of_model(choice.model, is_trusted=is_trusted, announce=announce)
    if choice.model and choice.bench is None:
        kind = find_plant(find_plant_of_model(choice.model))
        if kind.signals != EHA:
            return make_plant_bench(kind, choice.model), kind.key
    bench = load_bench(choice.bench or "eha", is_trusted=is_trusted)
    return bench, find_plant_of_model(choice.model) if choice.model else bench.kind


def load_tested_sequence(choice: JobChoice, *, is_trusted: bool = False) -> Sequence:
    """The sequence for the plant and the rate of its bench. Raises InputError."""
    bench, plant = load_tested_plant(choice, is_trusted=is_trusted)
    return load_sequence(choice.sequence, bench.rate, plant)


def load_tested_model(choice: JobChoice, *, is_trusted: bool = False, announce: Announce = print_on_standard_error,
                      ) -> tuple[Bench, Model, tuple[Path, ...]]:
    """The bench, the model that runs on it, with its plant and effects loaded, and the effect files that this brought.

    Raises:
        InputError: a file that cannot be used, or code that is not trusted.
    """
    bench, _ = load_tested_plant(choice, is_trusted=is_trusted, announce=announce)
    name = choice.model or bench.plant
    for file in choice.effects:
        load_effects(file)
    effect_files = load_effects_of_model(name, choice.effects, is_trusted=is_trusted, announce=announce)
    return bench, load_model(name), effect_files


def build_job(choice: JobChoice, sequence: Sequence | None = None, *, is_trusted: bool = False,
              announce: Announce = print_on_standard_error) -> Job:
    """The job that a user chose; the model and the changes chosen override the sequence's own.

    Args:
        choice: of the user.
        sequence: given where it is not to be read from the chosen file.
        is_trusted: whether effect files that a model file names may run.
        announce: gets a line about each of these before it runs.

    Raises:
        InputError: a sequence, model, effect or value that cannot be used.
    """
    require(isinstance(choice.seed, int) and 0 <= choice.seed < 1 << 63, "--seed", str(choice.seed),
            "a whole number from 0 and below 2^63")
    require_different_names(choice.effects)
    bench, model, effect_files = load_tested_model(choice, is_trusted=is_trusted, announce=announce)
    sequence = load_sequence(choice.sequence, bench.rate, model.plant) if sequence is None else sequence
    is_own_plant = sequence.plant in (model.plant, "eha") or choice.model is not None or sequence.model.name != "eha"
    require(is_own_plant, sequence.name, "plant", f"a bench or model of {sequence.plant}, not of {model.plant}")
    if choice.model is None and sequence.model.name != "eha":
        plant_choice = choice._replace(model=sequence.model.name)
        bench, model, more_files = load_tested_model(plant_choice, is_trusted=is_trusted, announce=announce)
        effect_files = (*effect_files, *more_files)
    require_different_names((*choice.effects, *effect_files))
    model = model.replace(sequence.model.overrides, sequence.name).replace(choice.changes)
    require_bench_cycle(model, bench, "--set")
    foreign = [name for name in model.list_changes() if name.startswith("controller.") and name != "controller.period"]
    is_ours = speaks_as_shipped(bench) or is_plant_bench(bench)
    controller = choice.controller or ("builtin" if is_ours else "external")
    plant = choice.plant or ("auto" if is_ours or not bench.has_plant_node else "external")
    require(controller != "external" or not foreign, "--set", "".join(foreign[:1]),
            "no gains beside --controller external: that firmware has its own")
    job = Job(sequence=sequence, model=model, bench=bench, seed=choice.seed, effects=(*choice.effects, *effect_files),
              bus=choice.bus, controller=controller, plant=plant, max_overruns=sequence.timing.share)
    return replace_settings(job, pace=choice.pace, max_overruns=choice.max_overruns)


def find_differences(job: Job) -> dict[str, Any]:
    """What of a job differs from the nominal test: the entry `differences` of verdict.json.

    `parameters`, SI, are those that are not nominal, and all of the model's effects. `text` has all in one line; it is
    "nothing" if there are none.
    """
    model = job.model
    is_usual = model.name == "eha" or Path(model.name).name == Path(job.bench.plant).name
    name = "" if is_usual else model.name
    parameters = model.list_changes()
    files = [path.name for path in job.effects]
    faults = [f"{fault.label!r} from {fault.start:g} s" + ("" if fault.end is None else f" to {fault.end:g} s")
              for fault in job.sequence.faults]
    groups = {parameter.partition(".")[0] for parameter in parameters}
    words = [*([f"model {name}"] if name else []),
             *(f"{parameter} = {find_quantity(parameter, plant=model.plant).describe(value)}"
               for parameter, value in parameters.items()),
             *(f"effect {effect}" for effect in model.effects if effect not in groups),
             *(f"effects of {file}" for file in files), *(f"fault {text}" for text in faults)]
    return {"model": name, "parameters": parameters, "effects": [*model.effects], "effect_files": files,
            "faults": faults, "text": "; ".join(words) or "nothing"}
