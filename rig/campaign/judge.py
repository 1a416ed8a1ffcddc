"""A campaign: a matrix of cases, each simulated or read, then judged; and the folder of the answers, as flat rows.

A simulated unit is a healthy plant with scatter and faults of known size, measured with the bench's noise. The folder:

    campaign.json      the matrix, and a hash of the code; a folder belongs to one campaign
    finished.jsonl     one row per finished case (see `rig.campaign.batch`)
    results.parquet    all rows in the matrix's order; replaced as a whole
"""

import hashlib
import itertools
import json
import platform
import tomllib
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from fdi.diagnosis.faults import FAULTS, Fault, Level
from fdi.estimation import list_relative_tolerances
from fdi.output import write_text, write_whole
from fdi.prognosis.unit_trend import list_traces
from fdi.sources import hash_sources, import_function
from fdi.thresholds import UNIT_TOLERANCE
from fdi.trace import Floats, Trace
from plant import (
    EHA,
    InputError,
    Model,
    Place,
    Plant,
    Quantity,
    RigError,
    build_bare_model,
    build_dataclass,
    count_threads,
    find_effect,
    find_quantity,
    load_nominal_values,
    load_plant,
    parse_model,
    parse_toml,
    parse_value,
    read_toml,
    report_system_error,
    require,
    simulate,
    suggest_name,
)
from rig.campaign.batch import Batch, BatchProgress, Row, RowFile, Workers, import_extra, read_rows, run_batch
from rig.network import WallClock
from rig.sequences import load_nominal_test

OWN_SIMULATOR = "plant"
HEALTHY = "healthy"
Tolerance = Annotated[float, Quantity("1", low=0.0, high=0.2)]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The keys above the first [[case]]; a case may override seeds and tolerance."""

    seeds: Annotated[int, Quantity("1", low=1)] = 20  # runs of each size
    first: Annotated[int, Quantity("1", low=0)] = 0  # seed of the first
    tolerance: Tolerance | tuple[Tolerance, ...] = (0.015,)
    simulator: str = OWN_SIMULATOR  # plant.simulate in 10 us steps, or "module:function"
    # of the controlled signal's noise: correlation from one cycle to the next, and the mains, in the signal's unit
    colour: Annotated[float, Quantity("1", low=0.0, high=0.99)] = 0.8
    hum: Annotated[float, Quantity("1", low=0.0)] = 0.0
    signals: str = ""  # outputs that are measured

    def __post_init__(self) -> None:
        require(self.tolerance != (), "matrix", "tolerance", "at least one")
        require(self.simulator == OWN_SIMULATOR or ":" in self.simulator, "matrix", "simulator",
                f"{OWN_SIMULATOR} or MODULE:FUNCTION, not {self.simulator!r}")

    def list_values(self) -> dict[str, Any]:
        """JSON values, with a list of tolerances."""
        tolerances = self.tolerance if isinstance(self.tolerance, tuple) else (self.tolerance,)
        return {**asdict(self), "tolerance": list(tolerances)}


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
    return sorted(file.name.removesuffix(".toml") for file in files("rig.campaign").iterdir()
                  if file.name.endswith(".toml"))


def read_matrix(source: str) -> dict[str, Any]:
    """The tables of a matrix file, or of a shipped one by name. Raises InputError."""
    if source in list_shipped_matrices():
        return parse_toml((files("rig.campaign") / f"{source}.toml").read_text(encoding="utf-8"), source)
    return read_toml(Path(source))


def build_matrix(tables: Mapping[str, Any], model: Model, work: str, where: object,
                 faults: Sequence[Fault] = FAULTS) -> Matrix:
    """The campaign that the tables of a matrix file describe.

    Raises:
        InputError: an unknown key or effect, a value out of range, a plant without a nominal test, or no case at all.
    """
    place, outputs = Place(str(where)), [s.name for s in model.kind.signals.outputs]
    choices = [",".join(outputs[:count]) for count in range(len(outputs), 0, -1)]
    usual_hum = 0.35  # of the controlled signal's noise
    values = {"hum": usual_hum * _find_noise(model), "signals": choices[0],
              **{key: value for key, value in tables.items() if key != "case"}}
    settings = build_dataclass(Settings, values, place)
    require(settings.signals in choices, where, "signals", f"one of {' or '.join(choices)}, not {settings.signals!r}")
    load_nominal_test(model.kind, model["controller.period"])
    blocks = tables.get("case", [])
    is_list = isinstance(blocks, list) and all(isinstance(block, Mapping) for block in blocks)
    require(blocks and is_list, where, "case", "at least one [[case]] (an empty one is a healthy plant)")
    cases = [_parse_block(block, values, model, place, faults) for block in blocks]
    spec = {**settings.list_values(), **list_shared(model, work, faults), "case": cases}
    return Matrix(spec, _expand_cases(spec))


def list_shared(model: Model, work: str, faults: Sequence[Fault]) -> dict[str, Any]:
    """What every worker needs, as JSON values: the model, with the path of a user's plant, judgement and faults.

    The paper's faults are left out, as in all folders that have no others.
    """
    plant = {} if model.kind.file is None else {"plant_file": str(model.kind.file)}
    faulty = {} if tuple(faults) == FAULTS else {"faults": [asdict(fault) for fault in faults]}
    return {"model": model.to_toml(), **plant, "work": work, **faulty}


def _find_noise(model: Model) -> float:
    """RMS noise of the controlled signal, SI."""
    return model.values.get(model.kind.signals.controlled.noise, 0.0)


def _parse_block(block: Mapping[str, Any], common: Mapping[str, Any], model: Model, place: Place,
                 faults: Sequence[Fault]) -> dict[str, Any]:
    """A [[case]] table with its defaults filled in. Raises InputError."""
    own = {key: value for key, value in block.items() if key in ("seeds", "tolerance")}
    settings = build_dataclass(Settings, {**common, **own}, place).list_values()
    sizes = {}
    for key, values in block.items():
        if key not in own:
            with place.at(key).locate():
                name, quantity = _find_size(key, model, faults)
                require(name not in sizes, "", key, f"one size for {name}, not two")
                sizes[name] = [parse_value("", key, quantity, value)
                               for value in (values if isinstance(values, list) else [values])]
                require(sizes[name], "", key, "at least one size")
    return {"seeds": settings["seeds"], "sizes": sizes, "tolerance": settings["tolerance"]}


def _find_size(key: str, model: Model, faults: Sequence[Fault]) -> tuple[str, Quantity]:
    """The name of the fault or effect of that name, and what its size is: its parameter, of an effect the first one.

    The parameter of a fault, and an effect that has it, name the fault, so that the size is a true size of the fault.

    Raises:
        InputError: neither a fault nor an effect, or an effect without a size.
    """
    own = {fault.parameter: fault.name for fault in faults}
    effects = {e.name: (*e.fitted, "")[0] for e in model.kind.list_effects()}
    parameters = {**dict(zip(own, own, strict=True)), **effects, **{name: first for first, name in own.items()}}
    require(key in parameters, "", key, f"a fault ({', '.join(own.values())}) or an effect of the catalogue"
            f"{suggest_name(key, parameters, 0.5) or ' (rig effects lists them)'}")
    parameter = parameters[key]
    require(parameter, "", key, "an effect with a size; this one is noise of the bench")
    return own.get(parameter, key), find_quantity(parameter, plant=model.plant)


def restore_faults(spec: Mapping[str, Any]) -> tuple[Fault, ...]:
    """The faults of a campaign."""
    return tuple(Fault(**table) for table in spec.get("faults", ())) or FAULTS


def _expand_cases(spec: Mapping[str, Any]) -> tuple[Case, ...]:
    """All cases of all blocks; a case that two blocks have counts once.

    Each block's seeds are spread evenly over the campaign, so that the first cases are of every kind.
    """
    cases: dict[tuple[str, float, int], tuple[float, Case]] = {}  # places from 0 to 1, and cases
    for block in spec["case"]:
        for values in itertools.product(*block["sizes"].values()):
            sizes = dict(sorted(zip(block["sizes"], values, strict=True)))
            for tolerance, k in itertools.product(block["tolerance"], range(block["seeds"])):
                seed = spec["first"] + k
                case = Case(0, label_plant(sizes), sizes, tolerance, seed)
                cases.setdefault((case.label, tolerance, seed), ((k + 0.5) / block["seeds"], case))
    ordered = sorted(cases.values(), key=lambda pair: pair[0])  # stable: equal places keep the order of the file
    return tuple(case._replace(number=number) for number, (_, case) in enumerate(ordered))


def label_plant(sizes: Mapping[str, float]) -> str:
    """The label of a plant with faults of these sizes: "filter_clogging=0.17 spool_friction=45", or "healthy"."""
    return " ".join(f"{name}={size:.9g}" for name, size in sizes.items()) or HEALTHY


def build_trace_matrix(folder: str | Path, model: Model, work: str, faults: Sequence[Fault] = FAULTS) -> Matrix:
    """The recorded runs below a folder as cases: the trace.mcap of each run, and every CSV file.

    Raises:
        InputError: no such folder, or no trace in it.
    """
    root = Path(folder).absolute()
    digests = {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
               for path in list_traces(root)}
    return restore_matrix({"traces": str(root), "files": digests, **list_shared(model, work, faults)})


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
            name, _, values = part.partition("=")
            require(name.strip() not in block, "--fault", word, f"one size for {name.strip()}, not two")
            try:
                block[name.strip()] = [float(value) for value in values.split(",")]
            except ValueError:
                raise InputError("--fault", word, "healthy, EFFECT=SIZE,SIZE.., or several of these with / between"
                                 ) from None
        blocks.append(block)
    return blocks


FLOORS = {s.name: load_nominal_values()[s.noise] for s in EHA.outputs}
"""RMS noise of the sensors: m, Pa, m."""


class Unit(NamedTuple):
    """A unit to simulate, for `plant.simulate` or another simulator."""

    model: Model  # healthy, without scatter
    scatter: Mapping[str, float]  # parameter "group.field" to the factor on its value
    sizes: Mapping[str, float]  # fault, or effect by its first parameter, to its size, SI
    command: Floats  # (n,) m
    noise: Floats  # (n, outputs + 1), in units of the sensors' noise
    faults: tuple[Fault, ...] = FAULTS


Simulator = Callable[[Unit], Mapping[str, Floats]]
"""From a unit to the columns of its signals, of the EHA com, cor, load, xj, p12, xs; (n,) each, SI."""


def simulate_case(case: Case, spec: Mapping[str, Any], model: Model) -> Trace:
    """The nominal test of a plant with the faults, scatter and noise of a case.

    Raises:
        InputError: values that contradict each other, no such simulator, or a fault or change that it does not have.
    """
    signals, period = model.kind.signals, model["controller.period"]
    command = np.round(load_nominal_test(model.kind, period)[0], 12)
    scatter, noise = sample_random_parts(case, len(command), spec["colour"], spec["hum"], model)
    simulator: Simulator = simulate_unit if spec["simulator"] == OWN_SIMULATOR else import_function(
        spec["simulator"], "--simulator", "a simulator of units")
    columns = simulator(Unit(model, scatter, case.sizes, command, noise, restore_faults(spec)))
    names = {signals.command.name, signals.drive.name, "load", *spec["signals"].split(",")}
    return Trace.from_columns({name: columns[name] for name in columns if name in names}, period,
                              {"source": case.label, "seed": str(case.seed)}, signals)


def simulate_unit(unit: Unit) -> dict[str, Floats]:
    """The columns of a unit by `plant.simulate`."""
    model = unit.model.replace({name: factor * unit.model[name] for name, factor in unit.scatter.items()})
    return simulate(add_faults(model, unit.sizes, unit.faults), unit.command, drawn=unit.noise)._asdict()


def sample_random_parts(case: Case, cycles: int, colour: float, hum: float, model: Model
                        ) -> tuple[dict[str, float], Floats]:
    """Scatter and noise of a case, as `Unit` holds them.

    Another label gives other random numbers. Another tolerance gives the same, so that a unit is comparable with
    itself at another tolerance.
    """
    scatter, rng = sample_scatter(case, model.kind)
    level, period = _find_noise(model) or 1.0, model["controller.period"]
    position = sample_coloured_noise(cycles, level, colour, hum, period, rng)
    return scatter, np.column_stack([position / level, rng.standard_normal((cycles, len(model.kind.signals.outputs)))])


def sample_scatter(case: Case, kind: Plant) -> tuple[dict[str, float], np.random.Generator]:
    """Factors on the parameters of the unit of a case, and the source of its other random numbers."""
    rng = np.random.default_rng([case.seed, 11, zlib.crc32(case.label.encode())])
    healthy = sample_healthy_plant(case.tolerance, rng, kind)
    return {name: value / kind.nominal[name] for name, value in healthy.items()}, rng


def sample_healthy_plant(spread: float, rng: np.random.Generator, kind: Plant) -> dict[str, float]:
    """The parameters of a healthy plant that differ from unit to unit, SI.

    `spread` is the standard deviation of most of them, relative; one with another tolerance differs by as much more.
    """
    tolerances = list_relative_tolerances(build_bare_model(kind.key), kind.nominal)
    return {name: kind.nominal[name] * (1 + spread * (tolerance / UNIT_TOLERANCE) * rng.standard_normal())
            for name, tolerance in tolerances.items()}


def sample_coloured_noise(n: int, level: float, colour: float, hum: float, period: float, rng: np.random.Generator
                          ) -> Floats:
    """Noise of the sensor of the controlled signal, (n,), in its unit: first-order noise, and hum of 50 Hz.

    Args:
        n: number of cycles.
        level: RMS of the first-order noise.
        colour: correlation from one cycle to the next.
        hum: amplitude of the mains hum.
        period: of a cycle, s.
        rng: source of the random numbers.
    """
    from fdi.diagnosis.make_bands import colour_noise  # here: it takes long to import

    mains: Floats = hum * np.sin(2 * np.pi * 50.0 * period * np.arange(n) + 1.0)
    return colour_noise(level * rng.standard_normal(n), colour) + mains


def add_faults(model: Model, sizes: Mapping[str, float], faults: Sequence[Fault] = ()) -> Model:
    """The model with faults of the list, or effects, of these sizes: values of each effect's first parameter.

    The effect's further parameters follow: of a parameter of the base model in proportion to the first one (dynamic
    friction to static friction), of an added effect as in the start whose first parameter is nearest to the size.
    """
    for name, size in sizes.items():
        model = model.replace(_list_changes(name, size, model.values, model.plant, faults), name)
    return model


def _list_changes(name: str, size: float, values: Mapping[str, float], plant: str, faults: Sequence[Fault]
                  ) -> dict[str, float]:
    """The parameters that a fault or effect of that size changes in a unit with these values, SI."""
    faults_by_name = {fault.name: fault for fault in faults if tuple(faults) != FAULTS}
    if name in faults_by_name:
        return faults_by_name[name].list_changes(size)
    effect = find_effect(name, plant)
    first, *others = effect.fitted
    if effect.base:
        return {first: size, **{other: values[other] * size / values[first] for other in others}}
    starts = sorted(effect.starts, key=lambda start: abs(start[first] - size))
    return {first: size, **{other: starts[0][other] for other in others if starts}}


OK, REFUSED, FAILED = "ok", "refused", "failed"


def judge_case(case: Case, spec: Mapping[str, Any], expected_sources: str) -> Row:
    """The row of a case. A refused trace or an exception of the judgement is a row as well.

    Raises:
        RigError: the code of this machine is not that of `expected_sources`, the hash made where the campaign runs.
    """
    if hash_campaign_sources() != expected_sources:
        raise RigError(f"the code on {platform.node()} differs from the code of the campaign: install the same version")
    clock, row, model = WallClock(), describe_case(case, spec), _parse_healthy_model(spec)
    try:
        trace = Trace.read(case.trace, signals=model.kind.signals) if case.trace else simulate_case(case, spec, model)
        start = clock.now()
        judge = _load_judgement(spec)
        judgement = judge(trace, model, restore_faults(spec)) if judge is judge_by_fdi else judge(trace, model)
        row |= {"status": OK, **judgement, "seconds": (clock.now() - start) * 1e-9}
    except RigError as error:
        row |= {"status": REFUSED, "reason": " ".join(str(error).split())}
    except Exception as error:
        row |= {"status": FAILED, "reason": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return row


def describe_case(case: Case, spec: Mapping[str, Any]) -> Row:
    """What is known of a case before it is judged; of a simulated case also the true fault sizes."""
    row = {"case": case.number, "label": case.label, "faults": len(case.sizes), "tolerance": case.tolerance,
           "seed": case.seed, "status": FAILED, "reason": ""}
    if case.trace:
        return row
    model = _parse_healthy_model(spec)
    scatter, _ = sample_scatter(case, model.kind)
    faults, values = restore_faults(spec), {**model.values, **{name: f * model[name] for name, f in scatter.items()}}
    for name, size in case.sizes.items():
        values |= _list_changes(name, size, values, model.plant, faults)
    return row | {f"true_{fault.key}": values.get(fault.parameter, fault.healthy) for fault in faults}


def _load_judgement(spec: Mapping[str, Any]) -> Callable[..., Row]:
    """The function that judges a run: from the trace and the healthy model to a flat row of JSON values."""
    return import_function(spec["work"], "--work", "a judgement")


def _parse_healthy_model(spec: Mapping[str, Any]) -> Model:
    """The model; in a worker process the file of a user's plant is read first, and must be that of the campaign."""
    tables = tomllib.loads(spec["model"])
    if "plant_file" in spec:
        path = Path(spec["plant_file"])
        code = path.read_bytes() if path.is_file() else b""
        if hashlib.sha256(code).hexdigest() != tables["plant_sha256"]:
            raise RigError(f"{path} on {platform.node()} is not the plant file with which the campaign was started")
        load_plant(path, code, tables["plant"])
    return parse_model(tables, "campaign")


def hash_campaign_sources() -> str:
    """A hash of all code and data that a row depends on."""
    return hash_sources("plant", "fdi", "rig/campaign", "rig/sequences")


WORKS: Mapping[str, str] = {"fdi": "rig.campaign.judge:judge_by_fdi"}
"""Judgements by the short name that --work accepts."""
CANNOT_TELL = "cannot_tell"


def judge_by_fdi(trace: Trace, model: Model, faults: Sequence[Fault] = FAULTS) -> dict[str, Any]:
    """The diagnosis of `rig fdi`: levels, ruling fault, sizes with intervals, events, precursors, other effects.

    Raises:
        InputError: a trace that cannot be judged.
    """
    from fdi.diagnosis.diagnosis import diagnose

    diagnosis = diagnose(trace, model, workers=count_threads(), faults=faults)
    row: dict[str, Any] = {"verdict": diagnosis.verdict, "ruling": diagnosis.ruling or ""}
    for fault in faults:
        size = diagnosis.sizes[fault.name]
        row |= {f"level_{fault.name}": _format_level(diagnosis.levels[fault.name]), fault.key: size.value,
                f"{fault.key}_low": size.low, f"{fault.key}_high": size.high}
    if diagnosis.band_verdict is not None:
        levels, by = diagnosis.band_verdict.levels, diagnosis.band_verdict.severity
        row |= {**{f"band_{fault.name}": _format_level(levels.get(fault.name)) for fault in faults},
                **{f"severity_{fault.name}": by[fault.name] for fault in faults if fault.name in by}}
    for grid in diagnosis.grids[:1]:
        row |= {f"grid_{fault.key}": grid.find_size(fault, grid.merged) for fault in grid.faults}
    if diagnosis.groups:
        row["groups"] = [list(group) for group in diagnosis.groups]
    return row | {
        "events": [event._asdict() for event in diagnosis.events], "event_count": len(diagnosis.events),
        "correlation": diagnosis.refinement.correlation, "left_over": max(diagnosis.refinement.ratio.values()),
        "simulations": diagnosis.refinement.simulations, "others": sorted(diagnosis.others),
        "precursors": {name: precursor.value for name, precursor in diagnosis.precursors.items()},
        "notes": list(diagnosis.notes)}


def _format_level(level: Level | None) -> str:
    return CANNOT_TELL if level is None else level.word


def run_campaign(matrix: Matrix, folder: str | Path, workers: Workers,
                 report_progress: Callable[[BatchProgress], None] = lambda _: None, count: int | None = None,
                 redo_failed: bool = False) -> list[Row]:
    """Judge the cases that are not finished, and write results.parquet, also after an interruption.

    Args:
        matrix: the cases.
        folder: where the results go: a new folder, or one of this matrix.
        workers: where the cases are judged.
        report_progress: called after each case.
        count: stop after the first `count` cases of the matrix, finished ones included; default: all.
        redo_failed: judge failed cases once more.

    Returns:
        The rows of all finished cases, in the matrix's order.

    Raises:
        InputError: the folder holds something else, there is no such judgement, no cluster at the address, or an
            extra is not installed.
        RigError: the cluster is gone.
    """
    _load_judgement(matrix.spec)
    import_extra("pyarrow")
    sources = hash_campaign_sources()
    with open_campaign(folder, matrix, sources) as file:
        try:
            run_batch(plan_batch(matrix, sources, count, redo_failed), file, workers, report_progress)
        finally:
            write_results(folder, file.rows)
        return select_newest(file.rows)


def plan_batch(matrix: Matrix, sources: str, count: int | None = None, redo_failed: bool = False) -> Batch:
    """The first `count` cases of a matrix as a batch; `sources` is the hash of the code that may judge them."""
    case_spec = {key: value for key, value in matrix.spec.items() if key not in ("case", "files")}
    return Batch(jobs={case.number: case for case in matrix.cases[:count]},
                 work=partial(judge_case, spec=case_spec, expected_sources=sources), key="case",
                 describe_failure=lambda case, reason: describe_case(case, case_spec) | {"reason": reason},
                 is_failed=_has_failed,
                 is_valid=lambda row: not (redo_failed and _has_failed(row)))


def _has_failed(row: Row) -> bool:
    return bool(row["status"] == FAILED)


MATRIX, ROWS, RESULTS = "campaign.json", "finished.jsonl", "results.parquet"


def open_campaign(path: str | Path, matrix: Matrix, sources: str) -> RowFile:
    """Open the rows of a campaign's folder for writing by one process at a time; an empty folder becomes its own.

    Raises:
        InputError: the folder belongs to another matrix or to something else, the code has changed since the campaign
            was started, another process is at work in it, or it cannot be written.
    """
    folder = Path(path)
    campaign = json.loads(json.dumps({"matrix": matrix.spec, "code": sources}))
    with report_system_error(path, "", "a folder that can be written"):
        folder.mkdir(parents=True, exist_ok=True)
        if is_campaign_folder(folder):
            present = _read_campaign(folder)
            if differences := [key for key in {**present["matrix"], **campaign["matrix"]}
                               if present["matrix"].get(key) != campaign["matrix"].get(key)]:
                raise InputError(path, "--out", "a folder of this matrix, or a new one; it differs in "
                                                f"{', '.join(differences)}")
            require(present["code"] == sources, path, "--out",
                    "a new folder: the code has changed since this campaign was started")
        elif any(not file.name.startswith(".part-") for file in folder.iterdir()):
            raise InputError(path, "--out", "an empty folder, or one of this campaign")
        else:
            write_text(folder / MATRIX, json.dumps(campaign, indent=1) + "\n")
    return RowFile(folder / ROWS)


def is_campaign_folder(folder: str | Path) -> bool:
    """Whether the folder is one of a campaign."""
    return (Path(folder) / MATRIX).is_file()


def read_matrix_of_folder(folder: str | Path) -> Matrix:
    """The matrix of a campaign's folder. Raises InputError."""
    return restore_matrix(_read_campaign(Path(folder))["matrix"])


def read_campaign_rows(source: str | Path) -> list[Row]:
    """The rows of a campaign's folder, finished or not, or of a results.parquet, in the matrix's order.

    Raises:
        InputError: there is no such campaign.
    """
    path = Path(source)
    if path.is_dir() and is_campaign_folder(path):
        return select_newest(read_rows(path / ROWS))
    require(path.suffix == ".parquet" and path.is_file(), source, "", f"the folder of a campaign, or its {RESULTS}")
    parquet = import_extra("pyarrow.parquet")
    try:
        rows: list[Row] = parquet.read_table(path).to_pylist()
    except (OSError, ValueError) as error:
        raise InputError(source, "", f"a Parquet file ({error})") from None
    return [{key: value for key, value in row.items() if value is not None} for row in rows]


def write_results(folder: str | Path, rows: Iterable[Row]) -> None:
    """Replace results.parquet by one with the newest row of each case; the matrix goes into its schema."""
    pa, parquet = import_extra("pyarrow"), import_extra("pyarrow.parquet")
    path, newest = Path(folder) / RESULTS, select_newest(rows)
    names = list(dict.fromkeys(name for row in newest for name in row))
    # Parquet has no table without fields: where nobody has precursors, the column is empty
    table = pa.table({name: pa.array([None if row.get(name) == {} else row.get(name) for row in newest])
                      for name in names})
    table = table.replace_schema_metadata({"campaign": json.dumps(_read_campaign(Path(folder)))})
    with write_whole(path) as part:
        parquet.write_table(table, part)


def _read_campaign(folder: Path) -> dict[str, Any]:
    """The content of campaign.json. Raises InputError."""
    try:
        content = json.loads((folder / MATRIX).read_text(encoding="utf-8"))
        return {"matrix": content["matrix"], "code": content["code"]}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(folder / MATRIX, "", f"the matrix of a campaign ({type(error).__name__})") from None


def select_newest(rows: Iterable[Row]) -> list[Row]:
    """The last row of each case, ordered by its number."""
    newest = {row["case"]: row for row in rows if "case" in row}
    return [newest[number] for number in sorted(newest)]
