"""The ports of the signal path: places where effects act, and how several effects become one function.

`plant.step` calls `at_<port>` at each place. The functions here pass the signal unchanged; a model's kernels are
compiled with its effects instead (`plant.compile`). A function at a port gets the signal, its memory, the state at the
start of the step, the inputs and the parameters; it returns the signal and its new memory.
"""
from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from plant.compile import Function, rebind_names
from plant.state import Input, Memory, State


def pass_signal(x: Any, m: Memory, s: State, u: Input, p: Any) -> tuple[Any, Memory]:
    """A port without effects: the signal passes."""
    return x, m


def port(unit: str, meaning: str) -> Function:
    """A place in a plant's step where effects act; it is bound to a name at_NAME of the plant's file.

    `signal, m = at_NAME(signal, m, s, u, p)` gives the signal as the effects change it, and their memories.

    Args:
        unit: of the signal.
        meaning: of the signal, for people.
    """
    made = rebind_names(pass_signal)
    made.port = (unit, meaning)
    return made


at_command = at_current = at_nozzle = at_feedback = at_spool_force = at_metering = pass_signal
at_valve = at_load = at_jack_drag = at_position = at_reading = at_supply = at_viscosity = pass_signal


def chain_laws(laws: Iterable[tuple[Function, type[Any] | None]]) -> tuple[Function, Memory]:
    """Laws with the type of their memory (None: they remember nothing) as one function, and its first memory.

    They act in the order given. Memories nest as the functions do: ((first, second), third).
    """
    whole: Function = pass_signal
    remembered: Memory = 0.0
    for function, memory in laws:
        one, own = (rebind_names(_apply_without_memory, law=function), 0.0) if memory is None else (function, memory())
        if whole is not pass_signal:
            one, own = rebind_names(_apply_in_sequence, first=whole, second=one), (remembered, own)
        whole, remembered = one, own
    return whole, remembered


def keep_memory(m: Memory, moved: float) -> Memory:
    """The memory of a port without a position of the ram in it, after the ram was moved by `moved` m: as it was."""
    return m


shift_position_memory = keep_memory


def chain_shifts(shifts: Iterable[Function | None]) -> Function:
    """What moves the memories of several effects along with the ram (None: such a memory stays), as one function."""
    whole: Function | None = None
    for shift in shifts:
        one = shift or keep_memory
        whole = one if whole is None else rebind_names(_shift_in_sequence, first=whole, second=one)
    return whole or keep_memory


law: Function = pass_signal
first: Function = pass_signal
second: Function = pass_signal  # these three are bound in each link of a chain


def _apply_without_memory(x: Any, m: Memory, s: State, u: Input, p: Any) -> tuple[Any, Memory]:
    return law(x, s, u, p), m


def _apply_in_sequence(x: Any, m: Memory, s: State, u: Input, p: Any) -> tuple[Any, Memory]:
    x, a = first(x, m[0], s, u, p)
    x, b = second(x, m[1], s, u, p)
    return x, (a, b)


def _shift_in_sequence(m: Memory, moved: float) -> Memory:
    return first(m[0], moved), second(m[1], moved)
