"""Converts nested tuples to a flat array of floats and back: the physics uses tuples, storage uses one buffer.

The state of a model with effects nests their memories. The conversions are written out as plain assignments, so that
compiled code moves numbers between registers and the buffer and nothing else.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

from plant.compile import Function
from plant.state import Memory, Ports, State


def make_packers(state: State) -> tuple[Function, Function]:
    """Two functions, `pack(state, array)` and `unpack(array) -> state`, for states with the fields of `state`."""
    pack, unpack, _ = _make_converters(state, "", lambda i: f"a[{i}]")
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


def list_state_values(state: State) -> list[float]:
    """The numbers of `state` in the order of the array: the fields of `State` first, then what effects remember."""
    array: dict[int, float] = {}
    make_packers(state)[0](state, array)
    return [float(x) for x in array.values()]


def _build_expression(x: Memory, path: str, kinds: dict[str, type[Any]], paths: list[str],
                      place: Callable[[int], str]) -> str:
    """The expression that builds `x` from the array `a`; notes the tuple types it needs and the path to each number."""
    if not isinstance(x, tuple):
        paths.append(path)
        return place(len(paths) - 1)
    named = getattr(x, "_fields", None)
    parts = [(part, f"{path}.{named[i]}" if named else f"{path}[{i}]") for i, part in enumerate(x)]
    # a bare number among ports or effects says that nothing is remembered there
    bare = isinstance(x, Ports) or not named
    inner = ["0.0" if bare and not isinstance(part, tuple) else _build_expression(part, p, kinds, paths, place)
             for part, p in parts]
    if not named:
        return f"({', '.join(inner)},)"
    kind = f"T{len(kinds)}"
    kinds[kind] = type(x)
    return f"{kind}({', '.join(inner)})"


def pack_state(s: State, a: Any) -> None:
    """Write `s` into the array `a`. A placeholder: each model binds its own function."""
    raise TypeError("no model is bound")


def unpack_state(a: Any) -> Any:
    """The state that the array `a` holds. A placeholder: each model binds its own function."""
    raise TypeError("no model is bound")
