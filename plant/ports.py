"""The ports: places in a plant's step where effects act, and how several effects become one function.

A step calls `at_<port>` at each place: `x, m = at_load(x, m, s, u, p)` gets the signal, the memories of all effects,
the state at the start of the step, the inputs and the parameters; it returns the signal and the memories. The functions
here pass the signal unchanged; a model's kernels are compiled with its effects instead (`plant.compile`).
"""

from collections import namedtuple
from collections.abc import Iterable, Sequence
from itertools import count
from typing import Any, NamedTuple, cast

from plant.compile import Function, bind_later, raise_unbound, rebind_names
from plant.kernels import write_function
from plant.state import Input, Memory

_NUMBERS = count()


class Port(NamedTuple):
    """What passes a port."""

    unit: str
    meaning: str  # for people
    number: int = 0  # ports act in the order of their declaration


def pass_signal(x: Any, m: Memory, s: Any, u: Input, p: Any) -> tuple[Any, Memory]:
    """A port without effects: the signal passes."""
    return x, m


def port(unit: str, meaning: str) -> Function:
    """A place in a plant's step where effects act; it is bound to a name at_NAME of the plant's file.

    `signal, m = at_NAME(signal, m, s, u, p)` gives the signal as the effects change it, and their memories.

    Args:
        unit: of the signal.
        meaning: of the signal, for people.
    """
    placeholder: Any = bind_later(rebind_names(pass_signal))
    placeholder.port = Port(unit, meaning, next(_NUMBERS))
    return placeholder


# around every plant's step, once a cycle; in the unit of the controlled signal
at_command = port("", "demand as the controller takes it")
at_reading = port("", "controlled signal with its noise, as it is sent")

at_current = port("A", "current in the torque motor's coil")
at_supply = port("1", "supply pressure over nominal r; PSR and GPF follow with r, GQF and GQ with sqrt r")
at_viscosity = port("1", "viscosity of the oil over nominal; CJ, BF and 1/CLK follow")
at_nozzle = port("m", "flapper displacement as the nozzles feel it")
at_feedback = port("m", "spool displacement as the feedback spring feels it")
at_spool_force = port("N", "extra force on the spool, positive as XS")
at_metering = port("m", "spool displacement as the metering edges feel it")
at_valve = port("Pa, Pa s/m", "Line, P12 against the ram's speed")
at_load = port("N", "external force FR on the ram, positive against extension")
at_jack_drag = port("N, N s/m", "Drag, all that resists the ram in the jack")
at_position = port("m", "ram position as its transducer feels it")

# by name: the shared ones, and those of plants that have been loaded
PORTS: dict[str, Port] = {name[3:]: value.port for name, value in list(globals().items()) if name.startswith("at_")}


def make_memory_type(names: Sequence[str]) -> type[Any]:
    """The memories of all effects of a plant with these ports: a NamedTuple with a field for each port."""
    memory_type = cast("type[Any]", namedtuple("Memory", names))
    memory_type.holds_memories = True
    return memory_type


def bind_port(name: str, law: Function, remembers: bool, memory: type[Any]) -> Function:
    """at_NAME for a chain of laws (see `chain_laws`) in a plant whose memories have the type `memory`."""
    own = ", ".join("own" if field == name else f"m.{field}" for field in memory._fields)
    lines = ([f"x, own = law(x, m.{name}, s, u, p)", f"return x, Memory({own})"] if remembers else
             [f"return law(x, m.{name}, s, u, p)[0], m"])
    return write_function(f"at_{name}", "x, m, s, u, p", lines, law=law, Memory=memory)


def bind_shifts(shifts: Iterable[tuple[str, Function]], memory: type[Any]) -> Function:
    """`(m, moved)`: the memories after the controlled body was moved, by the shift of each port that has one."""
    functions = {f"shift_{name}": shift for name, shift in shifts}
    if not functions:
        return keep_memory
    own = ", ".join(f"shift_{field}(m.{field}, moved)" if f"shift_{field}" in functions else f"m.{field}"
                    for field in memory._fields)
    return write_function("shift_memories", "m, moved", [f"return Memory({own})"], Memory=memory, **functions)


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
    """The memory of a port without a position in it, after the controlled body was moved by `moved`: as it was."""
    return m


def chain_shifts(shifts: Iterable[Function | None]) -> Function:
    """What moves the memories of several effects along with the body (None: such a memory stays), as one function."""
    whole: Function | None = None
    for shift in shifts:
        one = shift or keep_memory
        whole = one if whole is None else rebind_names(_shift_in_sequence, first=whole, second=one)
    return whole or keep_memory


law = first = second = raise_unbound  # bound in each link of a chain


def _apply_without_memory(x: Any, m: Memory, s: Any, u: Input, p: Any) -> tuple[Any, Memory]:
    return law(x, s, u, p), m


def _apply_in_sequence(x: Any, m: Memory, s: Any, u: Input, p: Any) -> tuple[Any, Memory]:
    x, a = first(x, m[0], s, u, p)
    x, b = second(x, m[1], s, u, p)
    return x, (a, b)


def _shift_in_sequence(m: Memory, moved: float) -> Memory:
    return first(m[0], moved), second(m[1], moved)
