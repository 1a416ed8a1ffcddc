"""Runs a model: one cycle at a time (`Actuator`), or over a whole command (`simulate`)."""

import re
import traceback
from collections import namedtuple
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from plant.compile import find_code_folder
from plant.errors import InputError, RigError, require
from plant.foreign import run_foreign_loop
from plant.kernels import list_state_values, make_packers, write_reader
from plant.machine_code import Call, StoredCode
from plant.model import Model, build_kernel
from plant.plants import CONTROL_AT, Plant, find_plant
from plant.segments import Array
from plant.signals import EHA, Signals
from plant.solve import (
    advance_flat_state,
    fill_needed_drive,
    read_flat_sensors,
    run_closed_loop,
    run_controller,
    step_cycle,
    take_demand,
)
from plant.threads import run_beside

NOISES = len(EHA.outputs) + 1  # standard normal numbers a cycle of the EHA: position, pressure, spool, effects


class Columns(NamedTuple):
    """A simulated run of the EHA, a row a cycle: `t` s, `com`, `xj` m, `cor` A, `p12` Pa, `xs` m, `load` N; (n,)."""

    t: Array
    com: Array
    xj: Array
    cor: Array
    p12: Array
    xs: Array
    load: Array


@cache
def make_columns_type(signals: Signals) -> type[Any]:
    """The type of a simulated run of a plant with these signals: a field for each; (n,) each."""
    names = tuple(s.name for s in signals)
    return Columns if names == Columns._fields else namedtuple("Columns", names)


def sample_noise(seed: int, cycles: int, numbers: int = NOISES) -> Array:
    """The random numbers of a run, (cycles, numbers), standard normal; the same for a bench run and a simulation."""
    return np.random.default_rng(seed).standard_normal((cycles, numbers))


def draw_noise(seed: int, numbers: int = NOISES, block: int = 64) -> Iterator[list[float]]:
    """The rows of `sample_noise` without end; drawn in blocks, which costs a tenth of drawing single rows."""
    generator = np.random.default_rng(seed)
    while True:
        yield from generator.standard_normal((block, numbers)).tolist()


@np.errstate(all="ignore")  # of a law in plain Python: who reads the run sees what is not finite
def simulate(model: Model, command: Array, load: Array | None = None, seed: int = 0, steps: int | None = None,
             fast: bool = True, drawn: Array | None = None) -> Columns:
    """Run the model with its own controller over a command.

    Args:
        model: the plant.
        command: (n,) demand, one a cycle; of the EHA m.
        load: (n,) external load; of the EHA N on the ram, positive against extension; none by default.
        seed: of the noise.
        steps: steps a cycle; default: those of the plant, for the EHA one every 10 us.
        fast: compiled; False runs the same source in plain Python.
        drawn: (n, outputs + 1) random numbers in place of those of `seed`: noise that is not white.

    Returns:
        The columns of the plant's signals, with those names; of the EHA `Columns`.

    Raises:
        InputError: an empty command, or a load of another length.
    """
    com = np.ascontiguousarray(command, float)
    force = np.zeros_like(com) if load is None else np.ascontiguousarray(load, float)
    require(com.ndim == 1 and len(com) and force.shape == com.shape, "command", model.kind.signals.command.name,
            f"one demand and one load a cycle, not shapes {com.shape} and {force.shape}")
    signals = model.kind.signals
    out = np.empty((len(com), len(signals.columns)))
    with report_law_errors(model):
        if model.kind.foreign is not None:
            run_foreign_loop(Actuator(model, seed), com, force, out)
        else:
            run = build_kernel(run_closed_loop, model.effects, fast, model.plant)
            noise = sample_noise(seed, len(com), len(signals.outputs) + 1) if drawn is None else drawn
            record = model.build_record()
            work = partial(run, model.build_flat_state(), com, force, noise, record, steps or model.steps, out)
            run_beside(work) if fast else work()
    t = np.arange(len(com), dtype=np.float64) * model["controller.period"]
    outputs = {s.name: out[:, i].copy() for i, s in enumerate(signals.columns)}
    inputs = {"time": t, "command": com, "load": force}
    columns = (outputs[s.name] if s.name in outputs else inputs[s.role] for s in signals)
    return cast(Columns, make_columns_type(signals)(*columns))


def compute_answers(model: Model, com: Array, readings: Array, memory: Array | None = None) -> Array:
    """The drive, (n,), that the model's controller answers to demands `com`, (n,).

    `readings` are those of all outputs, (n, outputs). `memory` is what its law remembers at the start; default: as at
    rest.
    """
    memory = rest_controller(model) if memory is None else memory
    out = np.empty(len(com))
    run = build_kernel(run_controller, model.effects, plant=model.plant)
    control = np.concatenate([np.zeros(CONTROL_AT), memory])
    run(model.build_flat_state(), control, com, np.ascontiguousarray(readings), model.build_record(), out)
    return out


def rest_controller(model: Model) -> Array:
    """The numbers, (k,), that the law of the model's controller remembers at rest."""
    return np.array(list_state_values(model.kind.build_control_memory()))


def compute_needed_drive(model: Model, motion: Array, load: Array) -> Array:
    """The drive that a motion needs, (n,), in its unit.

    Args:
        model: of a plant with `inverse`.
        motion: (n, 3) controlled signal, its rate and the rate of that, SI.
        load: (n,) external load.
    """
    out = np.empty(len(motion))
    build_kernel(fill_needed_drive, model.effects, plant=model.plant)(
        model.build_flat_state(), np.ascontiguousarray(motion), np.ascontiguousarray(load), model.build_record(), out)
    return out


@contextmanager
def report_law_errors(model: Model) -> Iterator[None]:
    """Report an error in a user's own law or plant as bad input, whatever numba or Python raised.

    Raises:
        InputError: the law, with its file and line where they are known. A shipped model without effects raises what it
            raised.
    """
    try:
        yield
    except RigError:
        raise
    except Exception as error:
        if not model.effects and model.kind.file is None:
            raise
        law_error = _find_law_error(model)
        compile_error = None if law_error else find_compile_error(error)
        if compile_error is not None:
            raise compile_error from error
        where, cause = law_error or (model.kind.file or "effects", error)
        # s and c are names of the loops in plant.solve
        mismatch = re.search(r"Cannot unify (.+) and (.+) for '([sc])\b", str(cause).replace("float64", "number"))
        if mismatch:
            raise InputError(where, "step" if mismatch[3] == "s" else "control", "a function that gives back what it "
                             f"gets, all fields written out: {mismatch[1]}, not {mismatch[2]}") from error
        message = next((line.strip() for line in reversed(str(cause).splitlines()) if line.strip()), "")
        raise InputError(where, ", ".join(model.effects),
                         f"laws that can be compiled and run ({type(cause).__name__}: {message})") from error


def find_compile_error(error: Exception) -> InputError | None:
    """The line of a user's file that numba cannot compile, as bad input; None if the error is not of that kind."""
    if type(error).__module__.partition(".")[0] != "numba":
        return None
    text, root = str(error), str(Path(__file__).parents[1])
    frames = [*re.findall(r"at (/.+?) \((\d+)\)", text), *re.findall(r'File "(.+?)", line (\d+)', text)]
    places = [(path, line) for file, line in frames for path in [str(Path(file).resolve())]
              if not path.startswith(root) and "site-packages" not in path]
    if not places:
        return None
    call = re.search(r">>> (.+)", text)  # of a function that it does not know for such arguments
    lines = (line.strip() for line in text.splitlines())
    message = f"not {call[1]}, see docs/effects.md" if call else next(
        (line for line in lines if line and not line.startswith(("Failed in", "During"))), "")
    return InputError(f"{places[0][0]}:{places[0][1]}", "", f"Python that can be compiled ({message})")


@np.errstate(all="ignore")
def _find_law_error(model: Model) -> tuple[str, Exception] | None:
    """The same mistake as Python tells it, with file and line, if it makes it too: numba says neither."""
    files = {law.__code__.co_filename for law in (*model.kind.list_laws(model.effects), model.kind.step)
             if law is not None}
    try:
        step = build_kernel(step_cycle, model.effects, False, model.plant)
        step(*model.build_start(), 0.0, 0.0, 0.0, 0.0, model.build_record(), 1)
    except Exception as error:
        frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename in files]
        return (f"{frames[-1].filename}:{frames[-1].lineno}", error) if frames else None
    return None


class Demand:
    """The demand after the effects at the port `command`, cycle by cycle: what the firmware closes its loop on."""

    def __init__(self, model: Model) -> None:
        self.is_changed = any(model.find_effect(effect).port == "command" for effect in model.effects)
        self._law = build_kernel(take_demand, model.effects, False, model.plant) if self.is_changed else None
        self._first = model.kind.build_start(model.effects)[1]
        self._record = model.build_record()[0]
        self._period = model["controller.period"]
        self.restart()

    def restart(self) -> None:
        """Forget the past; the next cycle is the first."""
        self._memory, self._cycle = self._first, 0

    def __call__(self, demand: float, position: float) -> float:
        """The demand that the loop closes on, m, from the demand and the sensed position, m."""
        if self._law is None:
            return demand
        loop_demand, self._memory = self._law(demand, self._memory, position, self._cycle * self._period, self._record)
        self._cycle += 1
        return float(loop_demand)


def find_direct_readings(model: Model) -> list[tuple[int, int]]:
    """Where each reading is in the flat state, and its noise among the parameters.

    Empty where a reading is more than a field of the state with noise: something computed, or with an effect on it.
    """
    field_numbers, outputs = model.kind.find_shown_fields(), model.kind.signals.outputs
    if field_numbers is None or not all(s.noise for s in outputs) or any(
            model.find_effect(e).port == "reading" for e in model.effects):
        return []
    index = {name: i for i, name in enumerate(model.list_names())}
    return list(zip(field_numbers, (index[s.noise] for s in outputs), strict=True))


class Actuator:
    """One plant that runs cycle by cycle: the core of the emulator. It knows neither clock nor bus."""

    def __init__(self, model: Model, seed: int = 0, steps: int | None = None, fast: bool = True) -> None:
        self.model, self.steps, self._seed = model, steps or model.steps, seed
        self.cycle = 0
        with report_law_errors(model):
            self._flat = model.build_flat_state()
        self._unpack = make_packers(model.kind.build_start(model.effects))[1]
        self._record = model.build_record()
        self._live = self._record.view(np.float64)  # the same numbers, in the order of their names
        self._index = {name: i for i, name in enumerate(model.list_names())}
        outputs = model.kind.signals.outputs
        self.noise = draw_noise(seed, len(outputs) + 1)
        self._noise = [0.0] * (len(outputs) + 1)
        foreign = model.kind.foreign
        self._program = None if foreign is None else foreign(model["controller.period"])
        fast = fast and foreign is None
        self._code = load_stored_advance(model.effects, model.plant) if fast else None
        self._advance = self._bind_advance()
        self._places = find_direct_readings(model)  # faster without a call of compiled code
        self._read_fields: Any = write_reader(self._places) if self._places else None
        self._read = None if self._places else build_kernel(read_flat_sensors, model.effects, fast, model.plant)
        self._period = model["controller.period"]

    @property
    def state(self) -> Any:
        """The present state of the plant."""
        return self._unpack(self._flat.tolist(), 0)[0]

    @property
    def memory(self) -> Any:
        """What the effects remember now, by port."""
        return self._unpack(self._flat.tolist(), 0)[1]

    def warm(self) -> None:
        """Compile now, so that the first cycle is not late.

        Raises:
            InputError: an effect's law that cannot be compiled.
        """
        if self._program is not None:
            self._flat[:] = self._program.begin({**self.model.values, "seed": self._seed})
        with report_law_errors(self.model):
            if self._code is not None:
                self._code.warm(lambda: (self._flat.copy(), 5e-3, 100.0, 0.0, 0.0, self._record, 10))
            if self._read:
                self._read(self._flat.copy(), np.array(self._noise), 0.0, self._record)

    def sample(self) -> tuple[float, ...]:
        """The readings of the sensors in the order of the outputs; of the EHA XJ m, P12 Pa, XS m.

        Call it once per cycle: it draws the cycle's noise.
        """
        n = self._noise = next(self.noise)
        if self._read:
            t = self.cycle * self._period
            return cast("tuple[float, ...]", self._read(self._flat, np.array(n), t, self._record))
        return cast("tuple[float, ...]", self._read_fields(self._flat.item, self._live.item, n))

    def advance(self, drive: float, load: float = 0.0) -> None:
        """Simulate one cycle with a drive and an external load, of the EHA A in the torque motor and N."""
        t = self.cycle * self._period
        self._advance(drive, load, self._noise[-1], t)
        self.cycle += 1

    def _bind_advance(self) -> Call:
        if self._code is not None:
            return self._code.bind((self._flat,), 4, (self._record, self.steps))
        if (program := self._program) is not None:
            return lambda drive, load, noise, t: np.copyto(self._flat, program.step(drive, load))
        run = build_kernel(advance_flat_state, self.model.effects, fast=False, plant=self.model.plant)
        return lambda drive, load, noise, t: run(self._flat, drive, load, noise, t, self._record, self.steps)

    def set(self, name: str, value: float) -> None:
        """Change the parameter "group.field" of the running plant; its effect must be in the model.

        Raises:
            InputError: the running model has no such parameter.
        """
        require(name in self._index, "set", name, f"a parameter of the running model ({self.model.name})")
        self._live[self._index[name]] = value
        if self._program is not None:
            self._program.change(name, value)


def load_stored_advance(effects: tuple[str, ...], plant: str = "eha") -> StoredCode:
    """`advance_flat_state` for a plant with `effects`: machine code from disk if it was stored there."""
    kind = find_plant(plant)
    return _load_stored_advance(effects, kind.list_laws(effects), kind)


@cache
def _load_stored_advance(effects: tuple[str, ...], laws: tuple[Any, ...], kind: Plant) -> StoredCode:
    # `laws` is part of the cache's key only: a user may load a changed file under the same effect names
    compile_code = partial(build_kernel, advance_flat_state, effects, True, kind.key)
    return StoredCode(find_code_folder(advance_flat_state, kind.bind_functions(effects)), compile_code)
