"""Checks of a plant: what its file declares, at each loading; and how it behaves over its nominal test, `rig check`."""
from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.compile import find_fields_of
from plant.errors import InputError, count_nouns, require, suggest_name
from plant.faults import Fault, place_faults
from plant.quantity import Quantity, list_quantities
from plant.segments import Segment
from plant.user_code import explain_errors

if TYPE_CHECKING:
    from plant.model import Model
    from plant.plants import Plant

MOST_STEP_ERROR = 0.01  # RMS change of an output with half the step, over its range in the nominal test
MOST_STEP_NOISE = 0.5  # the same over its noise: half the step halves the error, so all of it is at most the noise
PUSHED_ROWS = 200  # cycles; then as many without a drive
MOST_STRAY = 0.5  # of a distance: a spring has taken the plant back, or a field of its state did not move along
MOST_FOLLOWING_ERROR = 0.5  # RMS, over the range of the command
ARGUMENTS = {"step": (4, 5), "measure": (2,), "control": (4,), "coefficients": (2,), "sense": (4,), "moves": (3,)}


def check_declaration(plant: Plant, where: object) -> None:
    """Refuse a user's plant that is not declared completely; `where` is its file.

    Raises:
        InputError: the field of the declaration and what was expected there.
    """
    _check_parameters(plant, where)
    require(isinstance(plant.state, type) and hasattr(plant.state, "_fields"), where, "state",
            "a NamedTuple of floats, class State(NamedTuple)")
    for name in plant.state._fields:
        require(isinstance(plant.state._field_defaults.get(name), float | int), where, f"State.{name}",
                "a number as default, the plant at rest")
    for name, counts in ARGUMENTS.items():
        function = getattr(plant, name)
        if name == "moves" and not callable(function):
            unknown = [f for f in function if f not in plant.state._fields]
            require(not unknown, where, "moves",
                    f"fields of the state ({', '.join(plant.state._fields)}), not {unknown[:1]}")
        elif function is not None or name in ("step", "measure"):
            require(callable(function) and len(inspect.signature(function).parameters) in counts, where, name,
                    f"a function of {' or '.join(map(str, counts))} arguments")
    names = {f"{group}.{name}" for group, cls in plant.parameters.items() for name in cls._fields}
    for signal in plant.signals:
        require(isinstance(signal.unit, str) and bool(signal.unit), where, f"signal {signal.name}",
                'a unit, "1" for none')
        require(signal.largest > 0.0, where, f"signal {signal.name}, largest",
                f"a number above 0 {signal.unit}, not {signal.largest:g}")
        for use, name in (("noise", signal.noise), ("limit", signal.limit)):
            require(not name or name in names, where, f"signal {signal.name}, {use}", f"a parameter, not {name!r}")
    for e in plant.effects.values():
        require(e.base or e.port in plant.ports, where, f"effect {e.name}",
                f"one of the ports that the step has ({', '.join(plant.ports)}), not {e.port!r}")
        require(e.base or e.name not in plant.parameters, where, f"effect {e.name}",
                "a name that no parameter group has")
        require(set(e.fitted) <= (names if e.base else set(e.parameters)), where, f"effect {e.name}",
                f"parameters that exist, not {', '.join(e.fitted)}")
        unknown = sorted(find_fields_of(e.function, "p") - {*plant.parameters, e.name}) if e.function else []
        require(not unknown, where, f"effect {e.name}",
                f"p.{e.name}.FIELD for its own parameters, or a group of the plant ({', '.join(plant.parameters)}), "
                f"not p.{', p.'.join(unknown)}")
    names |= {name for e in plant.list_effects() for name in e.parameters}
    for fault in plant.faults:
        require(isinstance(fault, Fault), where, "faults", "values Fault(...)")
        require(fault.parameter in names, where, f"fault {fault.name}, parameter",
                f"a parameter of the plant or of an effect{suggest_name(fault.parameter, names)}")
    require(all(isinstance(s, Segment) for s in plant.profile) and np.isfinite(plant.build_nominal_command()).all(),
            where, "profile", "segments such as Step(to=1e-3, time=1.0), of finite numbers")
    require(0.0 < plant.solver_step <= plant.nominal["controller.period"], where, "solver_step",
            f"above 0 s and at most controller.period, not {plant.solver_step:g}")
    _check_readings(plant, where)


def _check_parameters(plant: Plant, where: object) -> None:
    for group, cls in plant.parameters.items():
        try:
            quantities: Mapping[str, Any] = list_quantities(cls)
        except (TypeError, AttributeError, NameError) as error:
            raise InputError(where, f"parameters, {group}", "a NamedTuple whose fields are Annotated[float, "
                             f'Quantity("unit")] ({error})') from error
        for name, q in quantities.items():
            field = f"{group}.{name}"
            require(isinstance(q, Quantity) and bool(q.unit), where, field,
                    'Annotated[float, Quantity("unit")], "1" for no unit')
            for holds, expected in (
                    (q.unit == "s" or field != "controller.period", f"a period in s, not in {q.unit}"),
                    (q.low <= q.high and q.above < q.below, f"a low end below the high one, not a range {q.bounds}"),
                    (0.0 <= q.tolerance <= 1.0, f"a tolerance from 0 to 1, a fraction, not {q.tolerance:g}")):
                require(holds, where, field, expected)
            value = plant.values.get(field, cls._field_defaults.get(name))
            require(isinstance(value, float | int), where, field, f"a nominal value as default, not {value!r}")
            require(not q.refuses(float(value or 0.0)), where, field, f"{q.expected}, not {value:g}")
    require("controller.period" in plant.nominal, where, "parameters",
            "a group Controller with the field period, s, the cycle of the controller")


@np.errstate(all="ignore")  # a division by zero shows in the run
def _check_readings(plant: Plant, where: object) -> None:
    """One call of `measure` and of `step`, in plain Python, on the plant at rest."""
    from plant.model import build_bare_model, build_kernel
    from plant.solve import step_cycle

    names = [s.name for s in plant.signals.outputs]
    record = build_bare_model(plant.key).build_record()
    with explain_errors(str(plant.file), "measure"):
        y = plant.measure(plant.state(), record[0])
    with explain_errors(str(plant.file), "step"):
        after = build_kernel(step_cycle, (), False, plant.key)(*plant.build_start(()), 0.0, 0.0, 0.0, 0.0, record, 1)
    require(isinstance(y, tuple) and len(y) == len(names) and all(isinstance(x, float | int) for x in y), where,
            "measure", f"a tuple of {count_nouns(len(names), 'number')}, {', '.join(names)}, not {y!r}")
    require(isinstance(after, tuple) and len(after) == 2 and isinstance(after[0], plant.state), where, "step",
            "the new State and the memories, return State(...), m")
    with explain_errors(str(plant.file), "moves"):
        share = plant.find_share_moved(plant.move)
    require(share == 1.0, where, "moves", f"a move of {names[0]} by the distance in "
            f"{plant.signals.controlled.unit}, not by {share:.3g} times that")


# ---------------------------------------------------------------------------------------------------- behaviour


class Finding(NamedTuple):
    """The result of one check over the nominal test."""

    check: str
    passed: bool
    text: str


def find_divergence(model: Model, columns: Mapping[str, NDArray[np.float64]]) -> str:
    """Which signal is not a finite number first, and when; empty if all are finite."""
    for name, column in columns.items():
        bad = np.flatnonzero(~np.isfinite(column))
        if len(bad):
            return f"{name} is no finite number from t = {bad[0] * model['controller.period']:g} s on"
    return ""


def check_behaviour(model: Model) -> Iterator[Finding]:
    """The checks of a plant over its nominal test, one after the other.

    Raises:
        InputError: faults that contradict their range or each other, or a demand that is larger than the largest.
    """
    from plant.lanes import Lanes
    from plant.run import simulate
    from plant.selftest import check_effect

    kind, period = model.kind, model["controller.period"]
    demanded, where = kind.signals.command, kind.file or kind.name
    place_faults(kind.faults, kind, where)
    command = kind.build_nominal_command(period)
    require(np.abs(command).max() <= demanded.largest, where, "profile", f"demands of at most {demanded.largest:g} "
            f"{demanded.unit} either way, the largest of the signal {demanded.name}, not {np.abs(command).max():g}")
    quiet = model.replace({s.noise: 0.0 for s in kind.signals.outputs if s.noise})

    def run(steps: int | None = None, rows: int = len(command), *, fast: bool = True) -> dict[str, Any]:
        return simulate(quiet, command[:rows], steps=steps, fast=fast)._asdict()

    once = run()
    diverged = find_divergence(model, once)
    yield Finding("finite", not diverged, diverged or f"{len(command) * period:g} s of the nominal test")
    if diverged:
        return
    silent = [s.name for s in kind.signals.outputs if np.ptp(once[s.name]) == 0.0]
    yield Finding("signals", not silent, f"no change of {', '.join(silent)}" if silent else "every output changes")
    compiled_run, plain_run = run(20, 300), run(20, 300, fast=False)
    is_same = all(np.array_equal(compiled_run[name], plain_run[name]) for name in compiled_run)
    yield Finding("compiled code", is_same, "the bits of plain Python" if is_same else "differs from plain Python")
    finer = run(2 * model.steps)
    changes = {s: np.abs(finer[s.name] - once[s.name]) for s in kind.signals.outputs if s.name not in silent}
    limits = {s: min(MOST_STEP_ERROR * np.ptp(once[s.name]), MOST_STEP_NOISE * (model.values.get(s.noise) or np.inf))
              for s in changes}
    if worst := max(changes, key=lambda s: rms(changes[s]) / limits[s], default=None):
        yield Finding("step", rms(changes[worst]) < limits[worst], f"half the step changes {worst.name} by "
                      f"{rms(changes[worst]):.2g} {worst.unit} RMS, {changes[worst].max():.2g} at most (limit "
                      f"{limits[worst]:.2g} RMS: {MOST_STEP_NOISE:g} of its noise or {100 * MOST_STEP_ERROR:g} % of "
                      "its range, whichever is less)")
    wanted = 0.1 * np.ptp(once[kind.signals.controlled.name])
    push = np.repeat([np.abs(once[kind.signals.drive.name]).max(), 0.0], PUSHED_ROWS)
    idle, lanes = 0.0 * push, Lanes(quiet, ())
    idle_path, pushed_path = (lanes.replay(np.empty((1, 0)), drive, idle)[0, :, 0] for drive in (idle, push))
    moved_path = lanes.replay(np.empty((1, 0)), idle, idle, idle_path + wanted)[0, :, 0]
    distance, pushed = (moved_path - idle_path)[-1], np.abs(pushed_path - idle_path)
    is_moved = bool(abs(distance - wanted) <= MOST_STRAY * wanted
                    or pushed[-1] < MOST_STRAY * pushed[PUSHED_ROWS])  # it springs back
    yield Finding("moves", is_moved, "the plant stays where a replay moves it" if is_moved else
                  f"moved by {wanted:.3g} {kind.signals.controlled.unit}, the plant goes by {distance:.3g}: "
                  "every field of the state has to move along, a motor's angle by the gear ratio")
    error = rms(once[kind.signals.command.name] - once[kind.signals.controlled.name]) / max(np.ptp(command), 1e-300)
    yield Finding("control", error < MOST_FOLLOWING_ERROR, f"following error {100 * error:.2g} % of the command's "
                  f"range (limit {100 * MOST_FOLLOWING_ERROR:g} %)")
    for name, e in kind.effects.items():
        report = check_effect(name, command, plant=kind.key)
        yield Finding(f"effect {name}", not report.faults, "; ".join(report.faults) or (
            "a parameter of the plant" if e.base else "exact at its off value, finite, repeatable"))


def rms(x: NDArray[np.float64]) -> float:
    """Root mean square; infinite for what is not finite."""
    return float(np.nan_to_num(np.sqrt(np.mean(x * x)), nan=np.inf, posinf=np.inf))
