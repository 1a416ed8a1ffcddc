"""The signals that a sequence names: those of the plant that it tests, by name or by the word of bench files.

While a sequence is read, `name_signals_of` says which plant that is; without it, it is the EHA.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Annotated

from plant.signals import EHA, Signals
from plant.tables import Choice

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
    known = {s.name: s.unit for s in signals}
    return known.get(name) or {"error": signals.controlled.unit, "speed": f"{signals.controlled.unit}/s"}[name]


def _list_aliases() -> Mapping[str, str]:
    return find_tested().aliases


def _list_measured() -> tuple[str, ...]:
    names = find_tested().names
    return (*names, *(word for word in DERIVED if word not in names))


def _list_guarded() -> tuple[str, ...]:
    return tuple(dict.fromkeys((*find_tested().names, "error")))


def _list_outputs() -> tuple[str, ...]:
    return tuple(s.name for s in find_tested().outputs)


Controlled = Annotated[str, Choice(lambda: (find_controlled(),), _list_aliases)]
Measured = Annotated[str, Choice(_list_measured, _list_aliases)]
Guarded = Annotated[str, Choice(_list_guarded, _list_aliases)]
Sensed = Annotated[str, Choice(_list_outputs, _list_aliases)]
