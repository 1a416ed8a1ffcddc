"""The signals that a sequence names: those of the plant that it tests, by name or by the word of bench files.

While a sequence is read, `name_signals_of` says which plant that is; without it, it is the EHA.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Annotated

from plant import EHA, Choice, Signals

_TESTED: ContextVar[Signals] = ContextVar("_TESTED", default=EHA)
DERIVED = ("error", "speed")  # command less controlled signal, and the speed of the latter, beside the plant's signals


@contextmanager
def name_signals_of(signals: Signals) -> Iterator[None]:
    """Within it sequences are read for a plant with these signals."""
    token = _TESTED.set(signals)
    try:
        yield
    finally:
        _TESTED.reset(token)


def find_tested() -> Signals:
    """The signals of the plant that a sequence is read for."""
    return _TESTED.get()


def find_controlled() -> str:
    """The name of the signal that the controller controls."""
    return find_tested().controlled.name


def find_unit(signals: Signals, name: str) -> str:
    """The SI unit of a signal, of the error or of the speed."""
    derived = {"error": signals.controlled.unit, "speed": f"{signals.controlled.unit}/s"}
    return {**derived, **{s.name: s.unit for s in signals}}[name]


def _list_aliases() -> Mapping[str, str]:
    return find_tested().aliases


Controlled = Annotated[str, Choice(lambda: (find_controlled(),), _list_aliases)]
Measured = Annotated[str, Choice(lambda: tuple(dict.fromkeys((*find_tested().names, *DERIVED))), _list_aliases)]
Guarded = Annotated[str, Choice(lambda: tuple(dict.fromkeys((*find_tested().names, "error"))), _list_aliases)]
Sensed = Annotated[str, Choice(lambda: tuple(s.name for s in find_tested().outputs), _list_aliases)]
