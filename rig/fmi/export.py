"""Writes a model as a functional mock-up unit: a library of machine code, and the XML that describes its variables.

The equations are the machine code that numba compiled, linked with the interface in C of this folder. The code is
emitted for every CPU of an architecture, not for this one alone; without fused multiply-add its bits are the same.
"""

import hashlib
import math
import platform
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from uuid import UUID

import numpy as np

from fdi.output import write_whole
from plant import (
    InputError,
    Model,
    RigError,
    build_kernel,
    emit_object,
    find_quantity,
    read_normal_tables,
    report_law_errors,
    require,
    rest_controller,
)
from rig.firmware.build import compile_c, find_compiler
from rig.fmi.unit_cycle import INPUTS, advance_unit
from rig.templates import fill_template

FOLDER = Path(__file__).parent
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-shared", "-s", "-w")
_LARGEST = sys.float_info.max


class Platform(NamedTuple):
    """A kind of machine: its names in FMI 3 and FMI 2, in LLVM, and the program that compiles C for it."""

    name: str
    old_name: str
    triple: str
    suffix: str
    compiler: str
    flags: tuple[str, ...] = ("-fPIC",)


PLATFORMS = (
    Platform("x86_64-linux", "linux64", "x86_64-unknown-linux-gnu", ".so", "x86_64-linux-gnu-gcc"),
    Platform("aarch64-linux", "aarch64-linux", "aarch64-unknown-linux-gnu", ".so", "aarch64-linux-gnu-gcc"),
    Platform("x86_64-windows", "win64", "x86_64-w64-windows-gnu", ".dll", "x86_64-w64-mingw32-gcc",
             ("-static-libgcc",)),
)


class Variable(NamedTuple):
    """A real variable of the unit; its value reference is its place in the list."""

    name: str
    role: str  # TIME, INPUT, OUTPUT, FIXED or TUNABLE, as in unit.h
    unit: str
    description: str
    start: float = 0.0
    low: float = -_LARGEST
    high: float = _LARGEST


def export_fmu(model: Model, out: Path, version: str = "2", seed: int = 0) -> list[str]:
    """Write `model` to the file `out`; returns the platforms that it runs on.

    Args:
        model: the plant with its effects; their values are the start values of the unit's parameters.
        out: file to write; the same model gives the same bytes.
        version: of FMI, "2" or "3".
        seed: start value of the unit's parameter `seed`, of the noise.

    Raises:
        InputError: no C compiler, or an effect that cannot be compiled or needs more than arithmetic.
        RigError: the compiler reports an error.
    """
    variables = list_variables(model)
    run = _compile_cycle(model)
    identifier = re.sub(r"[^A-Za-z0-9_]", "_", model.name)
    identifier = identifier if identifier[0].isalpha() else f"m{identifier}"
    tables = write_tables(model, variables, seed)
    sources = [FOLDER / "unit.c", FOLDER / f"fmi{version}.c"]
    digest = hashlib.sha256((version + tables + model.to_toml()).encode())
    for path in (FOLDER / "unit.h", *sources):
        digest.update(path.read_bytes())
    token = f"{{{UUID(bytes=digest.digest()[:16])}}}"
    tables += f'#define TOKEN "{token}"\n#define MODEL_HASH UINT64_C(0x{digest.hexdigest()[:16]})\n'
    files = {f"binaries/{machine.name if version == '3' else machine.old_name}/{identifier}{machine.suffix}": library
             for machine, library in _build_libraries(model, run, tables, sources).items()}
    platforms = [name.split("/")[1] for name in files]
    units = {v.unit: find_exponents(v.unit) for v in variables}
    files |= {"modelDescription.xml": fill_template(f"fmi/fmi{version}.xml", model=model, variables=variables,
                                                    identifier=identifier, token=token, seed=seed, units=units,
                                                    largest=_LARGEST).encode(),
              "resources/model.toml": model.to_toml().encode()}
    with write_whole(out) as unfinished, zipfile.ZipFile(unfinished, "w") as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name)  # without a time: the same model gives the same file
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, files[name], zipfile.ZIP_DEFLATED)
    return platforms


def _build_libraries(model: Model, run: Any, tables: str, sources: Sequence[Path]) -> dict[Platform, bytes]:
    """The library for each platform that can be compiled for here."""
    libraries = {}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "unit_tables.h").write_text(tables)
        code, library = Path(folder, "plant.o"), Path(folder, "library")
        for machine, compiler in find_platforms():
            object_code = emit_object(run, "advance_unit", machine.triple)
            if object_code is None:
                raise InputError("effects", ", ".join(model.effects), "laws that need nothing but arithmetic")
            code.write_bytes(object_code)
            words = [*_FLAGS, *machine.flags, f"-I{folder}", f"-I{FOLDER}", *map(str, sources), str(code)]
            try:
                compile_c(compiler, words, library)
                libraries[machine] = library.read_bytes()
            except RigError:
                if not libraries:  # this machine; a compiler for another one may lack its C library
                    raise
    return libraries


def find_platforms() -> list[tuple[Platform, str]]:
    """The platforms that this machine can compile for, itself first, with the compiler.

    Raises:
        InputError: no C compiler for this machine, or a machine that is not in the table.
    """
    name = f"{platform.machine()}-{platform.system().lower()}"
    matches = [machine for machine in PLATFORMS if machine.name == name]
    require(matches, "--fmu", name, f"a machine that is one of {', '.join(m.name for m in PLATFORMS)}")
    others = ((machine, shutil.which(machine.compiler)) for machine in PLATFORMS if machine.name != name)
    return [(matches[0], find_compiler("--fmu", "to link the FMU with")),
            *((machine, compiler) for machine, compiler in others if compiler)]


def _compile_cycle(model: Model) -> Any:
    """numba's dispatcher of the unit's cycle, compiled."""
    with report_law_errors(model):
        flat = model.build_flat_state()
        run = build_kernel(advance_unit, model.effects, True, model.plant)
        outputs = len(model.kind.signals.outputs)
        run(flat, np.array(_list_loop_start(model)), np.zeros(INPUTS), np.zeros(outputs + 1), model.build_record(),
            model.steps, np.zeros(outputs + 1))
    return run


def _list_loop_start(model: Model) -> list[float]:
    """The state of the sampled loop of a unit that has not started: `rig.fmi.unit_cycle.advance_unit`."""
    return [-1.0, 0.0, *rest_controller(model).tolist()]


def list_variables(model: Model) -> list[Variable]:
    """Time, inputs, outputs and parameters of the unit, by value reference."""
    signals = model.kind.signals
    load = signals.load
    variables = [
        Variable("time", "TIME", "s", "time"),
        Variable(signals.command.name, "INPUT", signals.command.unit,
                 f"{signals.command.quantity}; used where closed_loop is true"),
        Variable(signals.drive.name, "INPUT", signals.drive.unit,
                 f"{signals.drive.quantity}, held for the step; used where closed_loop is false"),
        Variable("load" if load is None else load.name, "INPUT", "N" if load is None else load.unit,
                 "external load" if load is None else f"{load.quantity}, held for the step"),
        *(Variable(s.name, "OUTPUT", s.unit, s.quantity) for s in signals.outputs),
        Variable("answer", "OUTPUT", signals.drive.unit,
                 f"answer of the controller in the last cycle; it drives the plant in the next one if closed_loop is "
                 f"true: {signals.drive.quantity}"),
    ]
    for name in model.list_names():
        q = find_quantity(name, plant=model.plant)
        group, _, field = name.partition(".")
        words = "".join(f"; {value:g}: {word}" for word, value in q.words.items())
        symbol = f" ({q.symbol})" if q.symbol else ""
        text = f"{field.replace('_', ' ')} of {group.replace('_', ' ')}{symbol}{words}"
        low: float = max(q.low, math.nextafter(q.above, math.inf), -_LARGEST)
        high = min(q.high, math.nextafter(q.below, -math.inf), _LARGEST)
        if q.words:
            low, high = min(q.words.values()), max(q.words.values())
        variables.append(Variable(name, "FIXED" if name == "controller.period" else "TUNABLE", q.unit, text,
                                  model[name], low, high))
    return variables


# -------------------------------------------------------------------------------------------- tables for the C code


def write_tables(model: Model, variables: Sequence[Variable], seed: int) -> str:
    """The header with the numbers of the model, and numpy's tables of the normal distribution."""
    normal = read_normal_tables()
    outputs = [i for i, v in enumerate(variables) if v.role == "OUTPUT"]
    parameters = [i for i, v in enumerate(variables) if v.role in ("FIXED", "TUNABLE")]
    period = next(i for i in parameters if variables[i].name == "controller.period")
    flat, loop = model.build_flat_state().tolist(), _list_loop_start(model)
    counts = {"REALS": len(variables), "STATES": len(flat), "LOOP": len(loop), "NOISES": len(outputs),
              "TIME_AT": 0, "INPUTS": 1,
              "OUTPUTS": outputs[0],
              "OUTPUT_COUNT": len(outputs), "PARAMETERS": parameters[0],
              "PARAMETER_COUNT": len(parameters), "PERIOD": period, "SEED_AT": len(variables),
              "CLOSED_AT": len(variables) + 1, "SEED": seed, "SOLVER_STEP": model.kind.solver_step.hex(),
              "ZIGGURAT_R": normal.r.hex(), "ZIGGURAT_INVERSE_R": normal.inverse_r.hex()}
    tables = {
        "VARIABLE_TABLE": [f'{{"{v.name}", {v.role}, '
                           f'{", ".join(float(number).hex() for number in (v.start, v.low, v.high))}}}'
                           for v in variables],
        "FLAT_TABLE": [value.hex() for value in flat],
        "LOOP_TABLE": [value.hex() for value in loop],
        "ZIGGURAT_K": [f"UINT64_C({k})" for k in normal.k],
        "ZIGGURAT_W": [w.hex() for w in normal.w],
        "ZIGGURAT_F": [f.hex() for f in normal.f],
    }
    return "\n".join([*(f"#define {name} {value}" for name, value in counts.items()),
                      *(f"#define {name} {{{', '.join(values)}}}" for name, values in tables.items()), ""])


# -------------------------------------------------------------------------------------------- modelDescription.xml

_BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_DERIVED = {"N": {"kg": 1, "m": 1, "s": -2}, "Pa": {"kg": 1, "m": -1, "s": -2}, "J": {"kg": 1, "m": 2, "s": -2},
            "W": {"kg": 1, "m": 2, "s": -3}, "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
            "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2}, "H": {"kg": 1, "m": 2, "s": -2, "A": -2}, "Hz": {"s": -1}}


def find_exponents(unit: str) -> dict[str, int] | None:
    """Exponents of the SI units in `unit`, such as "N m s2/m"; None where it has a part that is not SI.

    >>> find_exponents("A/(m s)"), find_exponents("raw/m")
    ({'m': -1, 's': -1, 'A': 1}, None)
    """
    total = dict.fromkeys(_BASE_UNITS, 0)
    above, *below = unit.replace("rms", "").replace("(", "").replace(")", "").split("/")
    for sign, words in ((1, above), *((-1, words) for words in below)):
        for word in words.split():
            name = word.rstrip("0123456789")
            parts = {name: 1} if name in _BASE_UNITS else _DERIVED.get(name)
            if parts is None and word != "1":
                return None
            for base, exponent in (parts or {}).items():
                total[base] += sign * exponent * int(word[len(name):] or 1)
    return {base: exponent for base, exponent in total.items() if exponent}
