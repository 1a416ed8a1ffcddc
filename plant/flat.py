"""Converts nested tuples to a flat array of floats and back: the physics uses tuples, storage uses one buffer.

The state of a model with effects nests their memories. The conversions are written out as plain assignments, so that
compiled code moves numbers between registers and the buffer and nothing else.
"""

from collections.abc import Callable
from typing import Any

from plant.compile import Function, raise_unbound
from plant.state import Memory


def make_packers(shape: Any, first: int = 0) -> tuple[Function, Function]:
    """Functions `pack(x, array)` and `unpack(array) -> x` for tuples like `shape`, such as a state with its memories.

    The numbers of `shape` begin with number `first` of the array.
    """
    pack, unpack, _ = _make_converters(shape, "", lambda i: f"a[{first + i}]")
    return pack, unpack


def make_lane_packers(shape: Any, width: int, first: int) -> tuple[Function, Function, int]:
    """Functions `keep(x, array, lane)` and `at(array, lane) -> x` for tuples like `shape`, and the next free number.

    Number f of a lane is at f * width + lane of the buffer; the numbers of `shape` begin with f = `first`.
    """
    keep, at, numbers = _make_converters(shape, ", lane", lambda i: f"a[{(first + i) * width} + lane]")
    return keep, at, first + numbers


def _make_converters(shape: Any, lane: str, place: Callable[[int], str]) -> tuple[Function, Function, int]:
    kinds: dict[str, type[Any]] = {}
    paths: list[str] = []
    built = _build_expression(shape, "s", kinds, paths, place)
    stores = [f"    {place(i)} = {path}" for i, path in enumerate(paths)]
    source = "\n".join([f"def keep(s, a{lane}):", *stores, f"def at(a{lane}):", f"    return {built}"])
    made: dict[str, Any] = dict(kinds)
    exec(source, made)
    return made["keep"], made["at"], len(paths)


def list_state_values(start: Any) -> list[float]:
    """The numbers of a state with its memories in the order of the array: the state first, then what effects keep."""
    if not isinstance(start, tuple):
        return [float(start)]
    return [x for part in start if isinstance(part, tuple) or not _is_bare(start) for x in list_state_values(part)]


def _is_bare(x: tuple[Any, ...]) -> bool:
    """Whether a bare number in `x`, memories of ports or of effects, says that nothing is remembered there."""
    return hasattr(x, "holds_memories") or not hasattr(x, "_fields")


def _build_expression(x: Memory, path: str, kinds: dict[str, type[Any]], paths: list[str],
                      place: Callable[[int], str]) -> str:
    """The expression that builds `x` from the array `a`; notes the tuple types it needs and the path to each number."""
    if not isinstance(x, tuple):
        paths.append(path)
        return place(len(paths) - 1)
    named = getattr(x, "_fields", None)
    parts = [(part, f"{path}.{named[i]}" if named else f"{path}[{i}]") for i, part in enumerate(x)]
    bare = _is_bare(x)
    inner = ["0.0" if bare and not isinstance(part, tuple) else _build_expression(part, p, kinds, paths, place)
             for part, p in parts]
    if not named:
        return f"({', '.join(inner)},)"
    kind = f"T{len(kinds)}"
    kinds[kind] = type(x)
    return f"{kind}({', '.join(inner)})"


# each model binds its own: pack_state((state, memories), array), and unpack_state(array) -> (state, memories)
pack_state = unpack_state = raise_unbound
