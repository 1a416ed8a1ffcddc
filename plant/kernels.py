"""What kernels call of a plant: placeholders here, bound to the functions of a plant with its effects when compiled.

The functions that a plant's signals determine are written out as source text, since compiled code knows the number of
readings, and which parameter is the noise of which.
"""

from collections.abc import Sequence
from typing import Any

from plant.compile import Function, raise_unbound
from plant.signals import Signals

step_plant = measure_plant = sense_plant = move_plant = correct_plant = control_plant = raise_unbound
shift_memories = raise_unbound
compute_plant_coefficients = start_control = add_noise = replace_first = get_readings = raise_unbound
keep_row = keep_sample = keep_answer = raise_unbound
invert_plant = load_readings = store_readings = load_control = store_control = raise_unbound


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
    return {
        **_write("add_noise", "y, n, p", [f"return {_tuple(noisy)}"]),
        **_write("replace_first", "y, x", [f"return {_tuple(['x', *(f'y[{i}]' for i in count[1:])])}"]),
        **_write("get_readings", "a, k", [f"return {_tuple([f'a[k, {i}]' for i in count])}"]),
        **_write("load_readings", "a", [f"return {_tuple([f'a[{i}]' for i in count])}"]),
        **_write("store_readings", "y, a", [f"a[{i}] = y[{i}]" for i in count]),
        **_write("keep_row", "y, drive, out, k", [*(f"out[k, {at}] = y[{i}]" for i, at in enumerate(places)),
                                                        f"out[k, {driven}] = drive"]),
        **_write("keep_answer", "drive, out, row, k", [f"out[row, {driven}, k] = drive"]),
        **_write("keep_sample", "y, out, row, k, closed", [
            "if closed:", *(f"    out[row, {at}, k] = y[{i}]" for i, at in enumerate(places)),
            "else:", *(f"    out[row, {i}, k] = y[{i}]" for i in count)]),
    }


def write_reader(places: Sequence[tuple[int, int]]) -> Function:
    """`(state, level, n)`: readings that are fields of the state, with noise; `places` in state and parameters.

    `state` and `level` give a number of a flat state and of the parameters by its place, `n` are the noise's numbers.
    """
    shown = [f"state({field}) + level({noise}) * n[{i}]" for i, (field, noise) in enumerate(places)]
    return _write("read_fields", "state, level, n", [f"return {_tuple(shown)}"])["read_fields"]


def write_constant(name: str, value: Any) -> Function:
    """A function of that name that returns `value`, a number or a NamedTuple of numbers."""
    shown = f"Kind({', '.join(map(repr, value))})" if isinstance(value, tuple) else repr(value)
    return _write(name, "", [f"return {shown}"], Kind=type(value))[name]


def write_mover(state: type[Any], names: Sequence[str], factor: float = 1.0) -> Function:
    """`(s, distance, p)`: the state with the fields `names` moved by `factor` times the distance.

    Written out, as compiled code knows no _replace.
    """
    moved = "distance" if factor == 1.0 else f"{factor!r} * distance"
    fields = ", ".join(f"s.{f} + {moved}" if f in names else f"s.{f}" for f in state._fields)
    return _write("move_plant", "s, distance, p", [f"return State({fields})"], State=state)["move_plant"]


def _tuple(items: Sequence[str]) -> str:
    return f"({''.join(f'{item}, ' for item in items)})"


def _write(name: str, arguments: str, lines: Sequence[str], **known: Any) -> dict[str, Function]:
    exec("\n    ".join([f"def {name}({arguments}):", *lines]), known)
    return {name: known[name]}
