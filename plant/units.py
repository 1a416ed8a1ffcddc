"""Units of other programs and of people: what one of them is worth in SI, exactly."""

import re
from collections.abc import Mapping
from fractions import Fraction
from typing import NamedTuple

from plant.errors import InputError, show_value, suggest_name
from plant.tables import Place


class Unit(NamedTuple):
    """A unit: its name, the SI unit of its quantity and how many of those it is."""

    name: str
    si: str
    factor: Fraction


UNITS: Mapping[str, Unit] = {name: Unit(name, si, Fraction(factor)) for si, factors in {
    "m": {"m": "1", "cm": "1/100", "mm": "1/1000", "um": "1/1000000", "nm": "1/1000000000", "inch": "0.0254",
          "mil": "0.0000254"},
    "Pa": {"Pa": "1", "hPa": "100", "kPa": "1000", "MPa": "1000000", "GPa": "1000000000", "mbar": "100",
           "bar": "100000", "psi": "6894.757293168361"},
    "A": {"A": "1", "mA": "1/1000", "uA": "1/1000000", "nA": "1/1000000000"},
    "N": {"N": "1", "kN": "1000", "MN": "1000000", "daN": "10", "lbf": "4.4482216152605"},
    "s": {"s": "1", "ms": "1/1000", "us": "1/1000000", "ns": "1/1000000000", "min": "60", "h": "3600"},
    "V": {"V": "1", "mV": "1/1000", "kV": "1000"},
    "N m": {"N m": "1", "mN m": "1/1000", "kN m": "1000"},
    "rad": {"rad": "1", "mrad": "1/1000", "urad": "1/1000000", "deg": "0.017453292519943295"},
    "rad/s": {"rad/s": "1", "mrad/s": "1/1000", "deg/s": "0.017453292519943295", "rpm": "0.10471975511965977"},
    "m/s": {"m/s": "1", "mm/s": "1/1000", "um/s": "1/1000000"},
}.items() for name, factor in factors.items()}
SPELLINGS = {"µm": "um", "μm": "um", "µs": "us", "μs": "us", "µA": "uA", "μA": "uA", "in": "inch", "sec": "s",
             "seconds": "s", "second": "s", "msec": "ms", "usec": "us", "pa": "Pa", "kpa": "kPa", "mpa": "MPa",
             "Bar": "bar", "BAR": "bar", "MM": "mm", "a": "A", "ma": "mA", "n": "N", "kn": "kN", "S": "s", "MS": "ms",
             "PSI": "psi", "Volt": "V", "v": "V", "Nm": "N m", "mNm": "mN m", "micron": "um", "metre": "m",
             "meter": "m", "°": "deg", "degree": "deg", "degrees": "deg", "°/s": "deg/s", "1/min": "rpm", "RPM": "rpm"}
_QUANTITY = re.compile(r"\s*([+-]?(?:\d{1,30}\.?\d{0,30}|\.\d{1,30})(?:[eE][+-]?\d{1,2})?)\s*(.*?)\s*")


def find_unit(name: str) -> Unit | None:
    """The unit of this name or spelling; None if it is not known."""
    return UNITS.get(SPELLINGS.get(name.strip(), name.strip()))


def fit_unit(name: str, own: str) -> Unit | None:
    """The unit of this name or spelling in the `own` one of a signal, SI or as its plant declares it, such as deg.

    None if it is of another quantity, or if one of them is not known and they differ.

    >>> fit_unit("mrad", "rad").factor, fit_unit("rpm", "deg/s").factor == 6, fit_unit("mm", "deg")
    (Fraction(1, 1000), True, None)
    """
    if name.strip() == own:
        return Unit(own, own, Fraction(1))
    unit, base = find_unit(name), find_unit(own)
    if unit is None or unit.si != (base.si if base else own):
        return None
    return unit._replace(si=own, factor=unit.factor / (base.factor if base else 1))


def list_fitting_units(own: str) -> list[str]:
    """The units of the quantity of which `own` is one."""
    return [name for name in UNITS if fit_unit(name, own)] or [own]


def require_unit(name: str, own: str, where: object, field: str) -> Unit:
    """The unit `name`, which must measure what the `own` one of a signal measures.

    Raises:
        InputError: an unknown unit, or one of another quantity.
    """
    unit = fit_unit(name, own)
    if unit is None:
        fitting = list_fitting_units(own)
        raise InputError(where, field, f"one of {', '.join(fitting)}, not {name!r}{suggest_name(name, fitting)}")
    return unit


def parse_quantity(text: str, si: str, place: Place) -> Fraction:
    """A number with its unit, such as "20 uA", in `si`, exactly; with `si` "" a number alone. `place`: of the text.

    >>> parse_quantity("0.1 um", "m", Place("bench.toml")), parse_quantity("2", "", Place("bench.toml"))
    (Fraction(1, 10000000), Fraction(2, 1))

    Raises:
        InputError: no number, no unit, or the unit of another quantity.
    """
    match = _QUANTITY.fullmatch(text)
    if match is None or bool(match[2]) != bool(si):
        expected = f"a number and a unit, such as '1 {si}'" if si else "a number without a unit"
        raise place.refuse(f"{expected}, not {show_value(text)}")
    with place.locate():
        return Fraction(match[1]) * (require_unit(match[2], si, "", "").factor if si else 1)
