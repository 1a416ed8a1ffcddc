"""Units that a map may name, and their factors to SI."""
from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.errors import InputError, suggest_name

Floats = NDArray[np.float64]


class Unit(NamedTuple):
    """A unit: the SI unit of its quantity and how many of those it is."""

    si: str
    factor: Fraction


def _list_units(si: str, **factors: str | int) -> dict[str, Unit]:
    return {name: Unit(si, Fraction(factor)) for name, factor in factors.items()}


UNITS: Mapping[str, Unit] = {
    **_list_units("m", m=1, cm="1/100", mm="1/1000", um="1/1000000", nm="1/1000000000", inch="0.0254", mil="0.0000254"),
    **_list_units("Pa", Pa=1, hPa=100, kPa=1000, MPa=1000000, GPa=1000000000, mbar=100, bar=100000,
                  psi="6894.757293168361"),
    **_list_units("A", A=1, mA="1/1000", uA="1/1000000"),
    **_list_units("N", N=1, kN=1000, MN=1000000, daN=10, lbf="4.4482216152605"),
    **_list_units("s", s=1, ms="1/1000", us="1/1000000", ns="1/1000000000", min=60, h=3600),
}
SPELLINGS = {"µm": "um", "μm": "um", "µs": "us", "μs": "us", "µA": "uA", "μA": "uA", "in": "inch", "sec": "s",
             "seconds": "s", "second": "s", "msec": "ms", "usec": "us", "pa": "Pa", "kpa": "kPa", "mpa": "MPa",
             "Bar": "bar", "BAR": "bar", "MM": "mm", "a": "A", "ma": "mA", "n": "N", "kn": "kN", "S": "s", "MS": "ms",
             "PSI": "psi", "Volt": "V", "v": "V", "micron": "um", "metre": "m", "meter": "m"}
OTHER_UNITS = ("V", "mV", "counts", "%")  # what a logger may write that needs scale and offset


def find_unit(name: str) -> Unit | None:
    """The unit of this name or spelling; None if it is not known."""
    return UNITS.get(SPELLINGS.get(name.strip(), name.strip()))


def require_unit(name: str, si: str, where: object, field: str) -> Unit:
    """The unit `name`, which must measure what `si` measures.

    Raises:
        InputError: an unknown unit, or one of another quantity.
    """
    unit = find_unit(name)
    fitting = [known for known, u in UNITS.items() if u.si == si]
    if unit is None and name in OTHER_UNITS:
        raise InputError(where, field, f"the unit that scale and offset lead to, such as {fitting[0]} ({name} is raw: "
                                       f"value = sign * (scale * raw + offset) in `unit`)")
    if unit is None or unit.si != si:
        raise InputError(where, field, f"one of {', '.join(fitting)}, not {name!r}{suggest_name(name, fitting)}")
    return unit


def convert_to_si(values: Floats, unit: Unit) -> Floats:
    """Values in SI units.

    A factor below 1 is a division by a whole number: 12.3456 mm becomes the float nearest to 0.0123456 m.

    >>> convert_to_si(np.array([12.3456]), UNITS["mm"]).tolist()
    [0.0123456]
    """
    if unit.factor < 1 and unit.factor.numerator == 1:
        return values / float(unit.factor.denominator)
    return values * float(unit.factor)
