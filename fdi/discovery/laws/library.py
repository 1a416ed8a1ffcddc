"""All terms of a balance as one effect that replays any law: a term whose coefficient is zero changes nothing.

So one compiled plant serves every law that is tried.
"""
from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from types import ModuleType

from fdi.discovery.laws.effect_source import IMPORTS, write_law
from fdi.discovery.laws.terms import TERMS, Term
from plant.effects import CATALOGUE, Effect, effect

LIBRARY = {place: f"{place}_library" for place in ("force", "flow", "current")}
"""Names of the effects, by balance."""


def name_parameter(term: Term, field: str) -> str:
    """The parameter "group.field" of the library that a field of a term is."""
    return f"{LIBRARY[term.place]}.{field}"


@contextmanager
def registered_library() -> Iterator[None]:
    """The catalogue with the library in it: for replays alone, no command lists or searches it."""
    entries = _build_library()
    CATALOGUE.special.update(entries)
    try:
        yield
    finally:
        for name in entries:
            CATALOGUE.special.pop(name, None)


@cache
def _build_library() -> dict[str, Effect]:
    """The effects, once in a process."""
    module = ModuleType("fdi.discovery.laws.library_of_terms")
    sys.modules[module.__name__] = module  # where the annotations are looked up
    imports = IMPORTS.replace("from plant.effects import effect\n", "")
    source = imports + "\n\n\n".join(
        write_law(name, [term for term in TERMS if term.place == place]) for place, name in LIBRARY.items())
    module.__dict__["effect"] = partial(effect, searched_in=("none",))
    code = compile(source, f"<{module.__name__}>", "exec", dont_inherit=True)
    exec(code, module.__dict__)
    return {name: CATALOGUE.special.pop(name) for name in LIBRARY.values()}
