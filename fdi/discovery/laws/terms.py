"""The terms that a law may consist of: readable formulas of the states, each with one coefficient.

A formula stands here once, as text. The regression evaluates it on measured states, the replay compiles it, and the
effect file of a law contains it.
"""

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from fdi.estimation import Value
from fdi.output import write_text
from plant.effects import CATALOGUE, Effect, effect

# The states in a formula: what they are in a law, and their units; `way` is the distance since the last reversal.
STATES = {"position": ("s.jack_position", "m"), "speed": ("s.jack_speed", "m/s"), "pressure": ("s.pressure", "Pa"),
          "spool": ("s.spool_position", "m"), "spool_speed": ("s.spool_speed", "m/s"), "current": ("u.drive", "A"),
          "time": ("u.t", "s"), "way": ("way", "m")}

# The ways in which a term enters its balance: the balance, what the factor is multiplied by there, in words.
PARTS = {"load": ("force", "1", "a force against extension"),
         "damping": ("force", "speed", "a resistance times the ram's speed"),
         "dry": ("force", "direction", "a dry friction"),
         "flow": ("flow", "1", "a flow that leaves the jack"),
         "conductance": ("flow", "pressure", "a leakage across the piston times the pressure"),
         "area": ("flow", "speed", "a displacement times the ram's speed"),
         "current": ("current", "1", "a current that does not reach the torque motor")}


class Shape(NamedTuple):
    """A parameter inside a formula, in the unit of a state: a length, a scale, a frequency."""

    name: str
    state: str  # whose range gives the trial values
    kind: str  # "period", "scale" or "frequency"

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return "Hz" if self.kind == "frequency" else STATES[self.state][1]


class Term(NamedTuple):
    """One term: `factor` is its formula without the coefficient, in the words of `STATES`; {name} is a shape."""

    name: str
    part: str  # one of PARTS
    factor: str
    unit: str  # of the coefficient
    words: str
    shape: Shape | None = None
    is_wave: bool = False  # the formula has a {phase} too

    @property
    def place(self) -> str:
        """The balance that it belongs to."""
        return PARTS[self.part][0]

    @property
    def fields(self) -> tuple[str, ...]:
        """Its parameters: the coefficient, the shape, the phase."""
        shape = (f"{self.name}_{self.shape.name}",) if self.shape else ()
        return (self.name, *shape, *((f"{self.name}_phase",) if self.is_wave else ()))

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return (self.unit, *((self.shape.unit,) if self.shape else ()), *(("rad",) if self.is_wave else ()))

    def format_factor(self, parameters: Mapping[str, object]) -> str:
        """The formula with its shape and phase as in `parameters`, by field."""
        names = {"phase": parameters.get(f"{self.name}_phase", 0.0)}
        if self.shape:
            names[self.shape.name] = parameters[f"{self.name}_{self.shape.name}"]
        return self.factor.format(**names)


_PERIOD = Shape("length", "position", "period")
_FREQUENCY = Shape("frequency", "time", "frequency")
_WAVE = "sin(2.0 * pi * position / {length} + {phase})"
_HUM = "sin(2.0 * pi * {frequency} * time + {phase})"
_BEYOND = "max(position - {gap}, 0.0) - max(-position - {gap}, 0.0)"

TERMS: tuple[Term, ...] = (
    Term("load", "load", "1.0", "N", "a constant force"),
    Term("spring", "load", "position", "N/m", "a spring"),
    Term("spring_difference", "load", "abs(position)", "N/m", "a spring that is stiffer on one side"),
    Term("spring_square", "load", "position * abs(position)", "N/m2", "a spring whose force grows with the square"),
    Term("spring_even", "load", "position * position", "N/m2", "a force quadratic in position, the same on both sides"),
    Term("spring_cube", "load", "position * position * position", "N/m3", "a spring whose force grows with the cube"),
    Term("contact", "load", _BEYOND, "N/m", "a spring behind a gap", Shape("gap", "position", "scale")),
    Term("cogging", "load", _WAVE, "N", "a force periodic in position", _PERIOD, True),
    Term("vibration", "load", _HUM, "N", "a force periodic in time", _FREQUENCY, True),
    Term("load_drift", "load", "time", "N/s", "a force that grows with time"),
    Term("area_difference", "load", "abs(pressure)", "m2", "a piston area that differs with the sign of P12"),
    Term("drag", "damping", "1.0", "N s/m", "viscous drag"),
    Term("drag_square", "damping", "abs(speed)", "N s2/m2", "drag that grows with the square of the speed"),
    Term("drag_cube", "damping", "speed * speed", "N s3/m3", "drag that grows with the cube of the speed"),
    Term("drag_difference", "damping", "1.0 * (speed > 0.0)", "N s/m", "drag in extension only"),
    Term("drag_slope", "damping", "position", "N s/m2", "drag that grows along the stroke"),
    Term("drag_outer", "damping", "abs(position)", "N s/m2", "drag that grows away from the middle"),
    Term("drag_pressure", "damping", "abs(pressure)", "N s/(m Pa)", "drag that grows with the pressure"),
    Term("drag_drift", "damping", "time", "N/m", "drag that grows with time"),
    Term("friction", "dry", "1.0", "N", "dry friction"),
    Term("friction_pressure", "dry", "abs(pressure)", "N/Pa", "dry friction that grows with the pressure"),
    Term("friction_slope", "dry", "position", "N/m", "dry friction that grows along the stroke"),
    Term("friction_outer", "dry", "abs(position)", "N/m", "dry friction that grows away from the middle"),
    Term("friction_square", "dry", "position * position", "N/m2", "dry friction quadratic in position"),
    Term("friction_wave", "dry", _WAVE, "N", "dry friction periodic in position", _PERIOD, True),
    Term("friction_difference", "dry", "1.0 * (speed > 0.0)", "N", "dry friction in extension only"),
    Term("friction_rise", "dry", "exp(-abs(speed) / {speed})", "N", "dry friction that falls with the speed",
         Shape("speed", "speed", "scale")),
    Term("friction_run_in", "dry", "exp(-way / {length})", "N", "dry friction that fades after each reversal",
         Shape("length", "way", "scale")),
    Term("friction_drift", "dry", "time", "N/s", "dry friction that grows with time"),
    Term("flow", "flow", "1.0", "m3/s", "a constant flow"),
    Term("flow_spool", "flow", "spool", "m2/s", "a lower flow gain"),
    Term("flow_square", "flow", "spool * abs(spool)", "m/s", "a flow gain that falls with the opening"),
    Term("flow_difference", "flow", "abs(spool)", "m2/s", "a flow gain that differs with the sign of the opening"),
    Term("flow_even", "flow", "spool * spool", "m/s", "a flow quadratic in the opening, the same on both sides"),
    Term("flow_cube", "flow", "spool * spool * spool", "1/s", "a flow loss that grows with the cube of the opening"),
    Term("flow_edge", "flow", "tanh(spool / {width})", "m3/s", "a flow lost at the null, within a width of it",
         Shape("width", "spool", "scale")),
    Term("flow_position", "flow", "spool * position", "m/s", "a flow gain that changes along the stroke"),
    Term("flow_pressure", "flow", "spool * abs(pressure)", "m2/(s Pa)", "a flow gain that falls with the pressure"),
    Term("flow_drift", "flow", "spool * time", "m2/s2", "a flow gain that falls with time"),
    Term("flow_ripple", "flow", _HUM, "m3/s", "a flow periodic in time", _FREQUENCY, True),
    Term("leakage", "conductance", "1.0", "m3/(s Pa)", "leakage across the piston"),
    Term("leakage_square", "conductance", "abs(pressure)", "m3/(s Pa2)", "leakage with the square of the pressure"),
    Term("leakage_root", "conductance", "1.0 / sqrt(abs(pressure) + 1e4)", "m3/(s Pa0.5)",
         "leakage through an orifice, with the root of the pressure"),
    Term("leakage_one_way", "conductance", "1.0 * (pressure > 0.0)", "m3/(s Pa)", "leakage for positive P12 only"),
    Term("leakage_slope", "conductance", "position", "m2/(s Pa)", "leakage that grows along the stroke"),
    Term("leakage_outer", "conductance", "abs(position)", "m2/(s Pa)", "leakage that grows away from the middle"),
    Term("leakage_wave", "conductance", _WAVE, "m3/(s Pa)", "leakage periodic in position", _PERIOD, True),
    Term("leakage_drift", "conductance", "time", "m3/(s2 Pa)", "leakage that grows with time"),
    Term("area", "area", "1.0", "m2", "a larger displacement"),
    Term("area_slope", "area", "position", "m", "a displacement that changes along the stroke"),
    Term("area_outer", "area", "abs(position)", "m", "a displacement that changes away from the middle"),
    Term("area_square", "area", "position * position", "1", "a displacement quadratic in position"),
    Term("area_direction", "area", "1.0 * (speed > 0.0)", "m2", "a displacement that differs in extension"),
    Term("bias", "current", "1.0", "A", "a constant current"),
    Term("gain", "current", "current", "1", "a lower gain of the torque motor"),
    Term("gain_difference", "current", "abs(current)", "1", "a gain that differs with the sign of the current"),
    Term("gain_square", "current", "current * abs(current)", "1/A", "a gain that falls with the current"),
    Term("gain_even", "current", "current * current", "1/A", "a current quadratic in the current"),
    Term("gain_cube", "current", "current * current * current", "1/A2", "a current lost with the cube of the current"),
    Term("dead_band", "current", "min(max(current, -{width}), {width})", "1",
         "the share of the current that is lost within a band about zero", Shape("width", "current", "scale")),
    Term("current_edge", "current", "tanh(current / {width})", "A", "a current lost at zero, within a width of it",
         Shape("width", "current", "scale")),
    Term("feedback", "current", "spool", "A/m", "a stiffer feedback spring"),
    Term("feedback_difference", "current", "abs(spool)", "A/m", "a feedback spring that is stiffer on one side"),
    Term("feedback_square", "current", "spool * abs(spool)", "A/m2", "a feedback spring that grows with the square"),
    Term("feedback_cube", "current", "spool * spool * spool", "A/m3", "a feedback spring that grows with the cube"),
    Term("spool_drag", "current", "tanh(spool_speed / {speed})", "A", "a current that the spool's direction costs",
         Shape("speed", "spool_speed", "scale")),
    Term("current_pressure", "current", "pressure", "A/Pa", "a current that the load pressure costs"),
    Term("gain_pressure", "current", "current * abs(pressure)", "1/Pa", "a gain that falls with the pressure"),
    Term("gain_drift", "current", "current * time", "1/s", "a gain that falls with time"),
    Term("bias_drift", "current", "time", "A/s", "a current that grows with time"),
    Term("ripple", "current", _HUM, "A", "a current periodic in time", _FREQUENCY, True),
)


def find_states(term: Term) -> list[str]:
    """The states in a term's formula."""
    words = re.findall(r"[a-z_]+", re.sub(r"{[a-z]+}", "", term.factor))
    return [state for state in STATES if state in words]


# Where the terms of a balance act; a law of forces alone acts at `load`.
PORTS = {"force": "jack_drag", "flow": "valve", "current": "current"}


def write_law_file(path: str | Path, terms: Sequence[Term], values: Mapping[str, Value], reason: str) -> dict[str, str]:
    """Write a law as an effect file; the names of its effects, by balance.

    Args:
        path: the file.
        terms: of the law.
        values: its parameters, by field.
        reason: why it holds.

    Raises:
        InputError: a place that cannot be written.
    """
    catalogue = CATALOGUE.list_all()
    names = {place: next(name for number in count(1)  # that no other effect has
                         if (name := f"missing_{place}" + (f"_{number}" if number > 1 else "")) not in catalogue)
             for place in dict.fromkeys(term.place for term in terms)}
    sizes = [f"{t.name}: {t.words}, {v.value:.4g} {v.unit} (95 %: {v.low:.4g} to {v.high:.4g})."
             for t, v in ((t, values[t.name]) for t in terms)]
    text = "\n".join([f"Found by rig explain: {describe_formula(terms)}.", "", *sizes, "",
                      f"{reason[0].upper()}{reason[1:]}."]) + "\n"
    numbers = {name: v.value for name, v in values.items()}
    write_text(path, write_effects(names, terms, numbers, text), "--write-effect")
    return names


def write_effects(names: Mapping[str, str], terms: Sequence[Term], values: Mapping[str, float] | None, text: str
                  ) -> str:
    """The source of a file with a law: one effect for each balance that it has terms of.

    Args:
        names: of the effects, by balance.
        terms: of the law.
        values: what was found, by field; without it nothing is fitted and every field is zero or one.
        text: docstring of the file.
    """
    source = "\n\n".join(write_law(name, [t for t in terms if t.place == place], values)
                         for place, name in names.items())
    words = set(re.findall(r"[A-Za-z]+", re.sub(r'"[^"]*"', "", source)))
    functions = [f for f in ("exp", "pi", "sin", "sqrt", "tanh") if f in words]
    records = [r for r in ("Drag", "Line") if r in words]
    head = [f"from math import {', '.join(functions)}"] if functions else []
    head += ["from typing import Annotated, NamedTuple", "", "from plant.effects import effect",
             "from plant.quantity import Quantity"]
    head += [f"from plant.state import {', '.join(records)}"] if records else []
    return f'"""{text}"""\n' + "\n".join(head) + "\n\n\n" + source


def write_law(name: str, terms: Sequence[Term], values: Mapping[str, float] | None) -> str:
    """The source of one effect: its group of parameters and its law, without the imports of a file.

    Args:
        name: of the effect.
        terms: of one balance.
        values: as for `write_effects`.
    """
    place, words = terms[0].place, " and ".join(term.words for term in terms)
    group = "".join(word.title() for word in name.split("_"))
    memory = any("way" in find_states(term) for term in terms)
    lines = [f"class {group}(NamedTuple):", *(_format_field(f, unit, term, values) for term in terms
                                              for f, unit in zip(term.fields, term.units, strict=True)), "", ""]
    if memory:
        lines += [f"class {group}Way(NamedTuple):", "    way: float = 0.0  # m since the last reversal",
                  "    side: float = 0.0  # direction of the last motion", "", ""]
    is_load = place == "force" and all(term.part == "load" for term in terms)
    port = "load" if is_load else PORTS[place]
    starts = ""
    if values is not None:
        numbers = ", ".join(f"{values[f]:.6g}" for term in terms for f in term.fields)
        starts = f",\n        starts=(({numbers},),)"
    lines += [f'@effect("{port}", {group}{f", memory={group}Way" if memory else ""},',
              f'        law="{format_formula(terms)}"{starts})',
              f"def {name}(x, {'m, ' if memory else ''}s, u, p):", f'    """{words[0].upper()}{words[1:]}."""',
              f"    g = p.{name}"]
    if memory:
        lines += ["    moves = s.jack_speed != 0.0",
                  "    side = (1.0 if s.jack_speed > 0.0 else -1.0) if moves else m.side",
                  "    way = (m.way if side == m.side else 0.0) + u.h * abs(s.jack_speed)"]
    lines += [f"    {state} = {where}" for state, (where, _) in STATES.items()
              if state != "way" and any(state in find_states(term) for term in terms)]
    parts = list(dict.fromkeys(term.part for term in terms))
    for part in parts:
        texts = [f"g.{t.name} * ({t.format_factor({f: f'g.{f}' for f in t.fields})})" for t in terms if t.part == part]
        texts = [line.replace(" * (1.0)", "") for line in texts]
        name = "lost" if part == "current" else part  # `current` is a state
        lines.append(f"    {name} = " + (texts[0] if len(texts) == 1 else "(" + "\n        + ".join(texts) + ")"))
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
        limits = ""
        if values is not None:
            far = 10.0 ** (math.ceil(math.log10(abs(values[name]) or 1.0)) + 1)
            limits = f", low=0, high={far:g}" if values[name] > 0.0 else f", low={-far:g}, high=0"
        return f'    {name}: Annotated[float, Quantity("{unit}"{limits})] = 0.0  # {term.words}'
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


# Names of the effects, by balance.
LIBRARY = {place: f"{place}_library" for place in ("force", "flow", "current")}


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
    module.__dict__["effect"] = partial(effect, searched_in=("none",))
    source = write_effects(LIBRARY, TERMS, None, "All terms.").replace("from plant.effects import effect\n", "")
    exec(compile(source, f"<{module.__name__}>", "exec", dont_inherit=True), module.__dict__)
    return {name: CATALOGUE.special.pop(name) for name in LIBRARY.values()}
