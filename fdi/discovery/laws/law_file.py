"""The effect file of a law that holds, and the way from an explanation to the law."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fdi.discovery.explain import Explanation
from fdi.discovery.laws.effect_source import format_formula, write_effects
from fdi.discovery.laws.find_law import Law, LawSearch, find_law, measure_excess
from fdi.output import write_text
from fdi.progress import Progress, ignore_progress
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE


def find_law_beside(e: Explanation, holdout: Trace | None, progress: Progress = ignore_progress) -> LawSearch:
    """The law behind what an explanation leaves.

    Of a part that the catalogue explains, the law is tried alone first, then beside the named effects.
    """
    best = e.ranked[0] if e.ranked else None
    found = find_law(e.search, e.base, best, holdout, e.floor, progress)
    if e.verdict != "PARTLY" or len(e.ledger) < 2 or (found.law is not None and found.law.hypothesis.is_at_floor):
        return found
    beside = find_law(e.search, e.ledger[-1], best, holdout, e.floor, progress)
    if beside.law is None or not beside.law.holds:
        return found
    if found.law is None or not found.law.holds or _measure_left(beside, e.floor) < _measure_left(found, e.floor):
        return beside
    return found


def _measure_left(found: LawSearch, floor: Mapping[str, float]) -> float:
    assert found.law is not None
    return measure_excess(found.law.holdout or found.law.hypothesis.errors, floor)


def name_effects(law: Law) -> dict[str, str]:
    """Names of the law's effects, by balance, that no other effect has."""
    known, names = CATALOGUE.list_all(), {}
    for place in dict.fromkeys(term.place for term in law.terms):
        free = [name for number in range(1, 100)
                if (name := f"missing_{place}" + (f"_{number}" if number > 1 else "")) not in known]
        names[place] = free[0]
    return names


def describe_formula(law: Law) -> str:
    """The law in symbols, one balance after the other."""
    places = dict.fromkeys(term.place for term in law.terms)
    return "; ".join(format_formula([t for t in law.terms if t.place == place]) for place in places)


def write_law_file(law: Law, path: str | Path) -> dict[str, str]:
    """Write a law as an effect file; the names of its effects, by balance.

    Raises:
        InputError: a place that cannot be written.
    """
    names = name_effects(law)
    lines = [f"Found by rig explain: {describe_formula(law)}.", ""]
    for term in law.terms:
        v = law.values[term.name]
        lines.append(f"{term.name}: {term.words}, {v.value:.4g} {v.unit} (95 %: {v.low:.4g} to {v.high:.4g}).")
    text = "\n".join([*lines, "", f"{law.reason[0].upper()}{law.reason[1:]}."]) + "\n"
    values = {name: v.value for name, v in law.values.items()}
    write_text(path, write_effects(names, law.terms, values, text), "--write-effect")
    return names
