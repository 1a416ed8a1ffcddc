"""What kernels call of a plant: placeholders here, bound to the functions of a plant with its effects when compiled.

The functions that a plant's signals determine are written out as source text, since compiled code knows the number of
readings, and which parameter is the noise of which. The physics uses nested tuples (the state of a model with effects
nests their memories), stored in a flat array of floats: `make_packers` gives the calls that move them.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

from plant.compile import Function, KeepTuple, LoadTuple, raise_unbound
from plant.signals import Signals

step_plant = measure_plant = sense_plant = move_plant = correct_plant = invert_plant = shift_memories = raise_unbound
compute_plant_coefficients = start_control = control_plant = load_control = store_control = raise_unbound
add_noise = replace_first = get_readings = load_readings = store_readings = raise_unbound
keep_row = keep_sample = keep_answer = raise_unbound


def write_signal_functions(signals: Signals) -> dict[str, Function]:
    """The functions that handle readings, a tuple in the order of the outputs, for a plant with these signals.

    - `add_noise(y, n, p)`: the readings with the noise of their sensors, n standard normal numbers
    - `replace_first(y, x)`: another value of the controlled signal
    - `get_readings(a, k)`: row k of an array (n, outputs)
    - `load_readings(a)`, `store_readings(y, a)`: of an array (outputs, ..)
    - `keep_row(y, drive, out, k)`: into row k of (n, columns), in the order of the columns
    - `keep_sample(y, out, row, k, closed)`, `keep_answer(drive, out, row, k)`: into (m, columns, n); the drive has a
      column in closed loop only
    """
    outputs = signals.outputs
    columns = [s.name for s in signals.columns]
    places = [columns.index(s.name) for s in outputs]
    count = range(len(outputs))
    noisy = [f"y[{i}] + p.{s.noise} * n[{i}]" if s.noise else f"y[{i}]" for i, s in zip(count, outputs, strict=True)]
    driven = columns.index(signals.drive.name)
    sources = {
        "add_noise": ("y, n, p", [f"return {_tuple(noisy)}"]),
        "replace_first": ("y, x", [f"return {_tuple(['x', *(f'y[{i}]' for i in count[1:])])}"]),
        "get_readings": ("a, k", [f"return {_tuple([f'a[k, {i}]' for i in count])}"]),
        "load_readings": ("a", [f"return {_tuple([f'a[{i}]' for i in count])}"]),
        "store_readings": ("y, a", [f"a[{i}] = y[{i}]" for i in count]),
        "keep_row": ("y, drive, out, k", [*(f"out[k, {at}] = y[{i}]" for i, at in enumerate(places)),
                                          f"out[k, {driven}] = drive"]),
        "keep_answer": ("drive, out, row, k", [f"out[row, {driven}, k] = drive"]),
        "keep_sample": ("y, out, row, k, closed", [
            "if closed:", *(f"    out[row, {at}, k] = y[{i}]" for i, at in enumerate(places)),
            "else:", *(f"    out[row, {i}, k] = y[{i}]" for i in count)]),
    }
    return {name: write_function(name, arguments, lines) for name, (arguments, lines) in sources.items()}


def write_reader(places: Sequence[tuple[int, int]]) -> Function:
    """`(state, level, n)`: readings that are fields of the state, with noise; `places` in state and parameters.

    `state` and `level` give a number of a flat state and of the parameters by its place, `n` are the noise's numbers.
    """
    shown = [f"state({field}) + level({noise}) * n[{i}]" for i, (field, noise) in enumerate(places)]
    return write_function("read_fields", "state, level, n", [f"return {_tuple(shown)}"])


def write_constant(name: str, value: Any) -> Function:
    """A function of that name that returns `value`, a number or a NamedTuple of numbers."""
    return write_function(name, "", ["return value"], value=value)


def write_mover(state: type[Any], names: Sequence[str], factor: float = 1.0) -> Function:
    """`(s, distance, p)`: the state with the fields `names` moved by `factor` times the distance.

    Written out, as compiled code knows no _replace.
    """
    moved = "distance" if factor == 1.0 else f"{factor!r} * distance"
    fields = ", ".join(f"s.{f} + {moved}" if f in names else f"s.{f}" for f in state._fields)
    return write_function("move_plant", "s, distance, p", [f"return State({fields})"], State=state)


def _tuple(items: Sequence[str]) -> str:
    return f"({''.join(f'{item}, ' for item in items)})"


def write_function(name: str, arguments: str, lines: Sequence[str], **known: Any) -> Function:
    """The function of these lines, which may use the names that are `known`."""
    exec("\n    ".join([f"def {name}({arguments}):", *lines]), known)
    return known[name]


def make_packers(shape: Any, apart: int = 1, first: int = 0) -> tuple[KeepTuple, LoadTuple, int]:
    """Calls `keep(x, array, place)` and `load(array, place) -> x` for tuples like `shape`, and the next free number.

    Such a tuple is a state with its memories. Its numbers begin with number `first`; number i of the array is at
    i * apart + place, where `apart` is the count of lanes and `place` the lane, 0 in a single run.
    """
    numbers = itertools.count(first)
    places = _number_places(shape, numbers)
    return KeepTuple(places, apart), LoadTuple(places, apart), next(numbers)


def _number_places(x: Any, numbers: Iterator[int]) -> Any:
    """The tuple `x` with the number of its place in an array for each float, -1 for one that is not kept."""
    if not isinstance(x, tuple):
        return next(numbers)
    places: Iterator[Any] = (-1 if _is_bare(x) and not isinstance(part, tuple) else _number_places(part, numbers)
                             for part in x)
    return type(x)(*places) if hasattr(x, "_fields") else tuple(places)


def list_state_values(start: Any) -> list[float]:
    """The numbers of a state with its memories in the order of the array: the state first, then what effects keep."""
    if not isinstance(start, tuple):
        return [float(start)]
    return [x for part in start if isinstance(part, tuple) or not _is_bare(start) for x in list_state_values(part)]


def _is_bare(x: tuple[Any, ...]) -> bool:
    """Whether a bare number in `x`, memories of ports or of effects, says that nothing is remembered there."""
    return hasattr(x, "holds_memories") or not hasattr(x, "_fields")


# each model binds its own: pack_state((state, memories), array, 0), and unpack_state(array, 0) -> (state, memories)
pack_state = unpack_state = raise_unbound
