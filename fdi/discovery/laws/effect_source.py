"""The effect file of a law: its terms as plain Python, with its parameters, their units and ranges."""
from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fdi.discovery.laws.terms import PARTS, STATES, Term, find_states
from fdi.estimation.fit import Value
from fdi.output import write_text
from plant.effects import CATALOGUE

PORTS = {"force": "jack_drag", "flow": "valve", "current": "current"}
"""Where the terms of a balance act; a law of forces alone acts at `load`."""

IMPORTS = """from math import exp, pi, sin, sqrt, tanh
from typing import Annotated, NamedTuple

from plant.effects import effect
from plant.quantity import Quantity
from plant.state import Drag, Line


"""


def write_law_file(path: str | Path, terms: Sequence[Term], found: Mapping[str, Value], reason: str) -> dict[str, str]:
    """Write a law as an effect file; the names of its effects, by balance.

    Args:
        path: the file.
        terms: of the law.
        found: its parameters, by field.
        reason: why it holds.

    Raises:
        InputError: a place that cannot be written.
    """
    names = _name_effects(terms)
    lines = [f"Found by rig explain: {describe_formula(terms)}.", ""]
    for term in terms:
        v = found[term.name]
        lines.append(f"{term.name}: {term.words}, {v.value:.4g} {v.unit} (95 %: {v.low:.4g} to {v.high:.4g}).")
    text = "\n".join([*lines, "", f"{reason[0].upper()}{reason[1:]}."]) + "\n"
    values = {name: v.value for name, v in found.items()}
    write_text(path, write_effects(names, terms, values, text), "--write-effect")
    return names


def _name_effects(terms: Sequence[Term]) -> dict[str, str]:
    """Names of a law's effects, by balance, that no other effect has."""
    known, names = CATALOGUE.list_all(), {}
    for place in dict.fromkeys(term.place for term in terms):
        free = [name for number in range(1, 100)
                if (name := f"missing_{place}" + (f"_{number}" if number > 1 else "")) not in known]
        names[place] = free[0]
    return names


def write_effects(names: Mapping[str, str], terms: Sequence[Term], values: Mapping[str, float], text: str) -> str:
    """The source of a file with a law: one effect for each balance that it has terms of.

    Args:
        names: of the effects, by balance.
        terms: of the law.
        values: what was found, by field.
        text: docstring of the file.
    """
    laws = [write_law(name, own := [t for t in terms if t.place == place], values, describe_terms(own))
            for place, name in names.items()]
    source = "\n\n".join(laws)
    used = set(re.findall(r"[A-Za-z]+", re.sub(r'"[^"]*"', "", source)))
    functions = [f for f in ("exp", "pi", "sin", "sqrt", "tanh") if f in used]
    records = [r for r in ("Drag", "Line") if r in used]
    head = [f"from math import {', '.join(functions)}"] if functions else []
    head += ["from typing import Annotated, NamedTuple", "", "from plant.effects import effect",
             "from plant.quantity import Quantity"]
    head += [f"from plant.state import {', '.join(records)}"] if records else []
    return f'"""{text}"""\n' + "\n".join(head) + "\n\n\n" + source


def describe_terms(terms: Sequence[Term]) -> str:
    """The terms in a sentence."""
    words = " and ".join(t.words for t in terms)
    return words[0].upper() + words[1:] + "."


def write_law(name: str, terms: Sequence[Term], values: Mapping[str, float] | None = None, text: str = "") -> str:
    """The source of one effect: its group of parameters and its law, without the imports of a file.

    Args:
        name: of the effect.
        terms: of one balance.
        values: what was found, by field; without it nothing is fitted and every field is zero or one.
        text: docstring of the law.
    """
    place = terms[0].place
    group = "".join(word.title() for word in name.split("_"))
    memory = any("way" in find_states(term) for term in terms)
    lines = [f"class {group}(NamedTuple):", *(_format_field(f, unit, term, values) for term in terms
                                              for f, unit in zip(term.fields, term.units, strict=True)), "", ""]
    if memory:
        lines += [f"class {group}Way(NamedTuple):", "    way: float = 0.0  # m since the last reversal",
                  "    side: float = 0.0  # direction of the last motion", "", ""]
    port = PORTS[place]
    is_load = place == "force" and all(term.part == "load" for term in terms)
    starts = ""
    if values is not None:
        found = ", ".join(f"{values[f]:.6g}" for term in terms for f in term.fields)
        starts = f",\n        starts=(({found},),)"
    lines += [f'@effect("{"load" if is_load else port}", {group}{f", memory={group}Way" if memory else ""},',
              f'        law="{format_formula(terms)}"{starts})',
              f"def {name}(x, {'m, ' if memory else ''}s, u, p):", f'    """{text or "Terms of a law."}"""',
              f"    g = p.{name}"]
    if memory:
        lines += ["    moves = s.jack_speed != 0.0",
                  "    side = (1.0 if s.jack_speed > 0.0 else -1.0) if moves else m.side",
                  "    way = (m.way if side == m.side else 0.0) + u.h * abs(s.jack_speed)"]
    lines += [f"    {state} = {where}" for state, where in STATES.items()
              if state != "way" and any(state in find_states(term) for term in terms)]
    parts = list(dict.fromkeys(term.part for term in terms))
    for part in parts:
        own = [f"g.{t.name} * ({t.format_factor({f: f'g.{f}' for f in t.fields})})" for t in terms if t.part == part]
        own = [line.replace(" * (1.0)", "") for line in own]
        name = "lost" if part == "current" else part  # `current` is a state
        lines.append(f"    {name} = " + (own[0] if len(own) == 1 else "(" + "\n        + ".join(own) + ")"))
    result = {"force": _return_force, "flow": _return_flow, "current": _return_current}[place](parts, is_load)
    if memory:
        result[-1] = f"    return {result[-1].removeprefix('    return ')}, {group}Way(way, side)"
    return "\n".join([*lines, *result, ""])


def format_formula(terms: Sequence[Term]) -> str:
    """The law as one line of text.

    >>> from fdi.discovery.laws.terms import TERMS
    >>> format_formula([t for t in TERMS if t.name in ("load", "drag_square")])
    'force + load + drag_square * abs(speed) * speed'
    """
    times = {"1": "", "speed": " * speed", "pressure": " * pressure", "direction": " * sign(speed)"}
    parts = [f"{t.name} * ({t.format_factor({f: f for f in t.fields})})" + times[PARTS[t.part][1]] for t in terms]
    sign = " - " if terms[0].place != "force" else " + "
    simple = [part.replace(" * (1.0)", "").replace("(1.0 * (", "((") for part in parts]
    return f"{terms[0].place}{sign}" + sign.join(_strip_brackets(part) for part in simple)


def describe_formula(terms: Sequence[Term]) -> str:
    """A law in symbols, one balance after the other."""
    places = dict.fromkeys(term.place for term in terms)
    return "; ".join(format_formula([t for t in terms if t.place == place]) for place in places)


def _strip_brackets(part: str) -> str:
    """A factor of one word or call needs no brackets around it."""
    head, _, tail = part.partition(" * (")
    if not tail:
        return part
    depth = np.cumsum([1, *((letter == "(") - (letter == ")") for letter in tail)])
    end = int(np.argmax(depth == 0)) - 1
    inner, rest = tail[:end], tail[end + 1:]
    is_sum = any(f" {sign} " in inner for sign in "+-<>") and not inner.endswith(")")
    is_sum = is_sum or inner.startswith("max(position")
    return part if is_sum else f"{head} * {inner}{rest}"


def _format_field(name: str, unit: str, term: Term, values: Mapping[str, float] | None) -> str:
    """A parameter with unit and range: a coefficient may lie between zero and ten times what was found."""
    if name == term.name:
        limits, off = "", "0.0"
        if values is not None:
            far = 10.0 ** (math.ceil(math.log10(abs(values[name]) or 1.0)) + 1)
            limits = f", low=0, high={far:g}" if values[name] > 0.0 else f", low={-far:g}, high=0"
        return f'    {name}: Annotated[float, Quantity("{unit}"{limits})] = {off}  # {term.words}'
    usual = 1.0 if values is None else float(f"{values[name]:.6g}")
    if unit == "rad":
        return f'    {name}: Annotated[float, Quantity("rad", low=-100, high=100)] = {usual if values else 0.0!r}'
    limits = "above=0" if values is None else f"low={0.2 * usual:.3g}, high={5.0 * usual:.3g}"
    return f'    {name}: Annotated[float, Quantity("{unit}", {limits})] = {usual!r}'


def _return_force(parts: Sequence[str], is_load: bool) -> list[str]:
    if is_load:
        return ["    return x + load"]
    force = "x.force + load" if "load" in parts else "x.force"
    damping = "x.damping + damping" if "damping" in parts else "x.damping"
    static, dynamic = (f"max(x.{level} + dry, 0.0)" if "dry" in parts else f"x.{level}" for level in
                       ("static", "dynamic"))
    return [f"    return Drag({force}, {damping}, {static}, {dynamic})"]


def _return_flow(parts: Sequence[str], _: bool) -> list[str]:
    """The line of the valve with the lost flow in it: P12 falls by `resistance` times that flow."""
    offset, slope = "x.offset", "x.slope"
    lines = ["    resistance = x.slope / p.jack.area  # Pa s/m3"] if set(parts) - {"area"} else []
    if "area" in parts:
        slope = "slope"
        lines.append("    slope = x.slope * max(1.0 + area / p.jack.area, 0.1)")
    if "flow" in parts:
        offset = "(x.offset - resistance * flow)"
    if "conductance" not in parts:
        return [*lines, f"    return Line({offset.strip('()')}, {slope}, x.limit, x.drive)"]
    lines.append("    share = 1.0 / max(1.0 + resistance * conductance, 0.1)")
    return [*lines, f"    return Line(share * {offset}, share * {slope}, x.limit, share * x.drive)"]


def _return_current(parts: Sequence[str], _: bool) -> list[str]:
    return ["    return x - lost"]
