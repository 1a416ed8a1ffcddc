"""Units of limits: a table may show 41.3 um while the computation uses 4.13e-5 m."""
from __future__ import annotations

from plant.errors import InputError
from rig.sequences import tables

SI_OF_UNIT: dict[str, tuple[str, float]] = {  # unit: (SI unit, how many of those it is)
    "m": ("m", 1.0), "mm": ("m", 1e-3), "um": ("m", 1e-6),
    "m/s": ("m/s", 1.0), "mm/s": ("m/s", 1e-3),
    "s": ("s", 1.0), "ms": ("s", 1e-3),
    "Pa": ("Pa", 1.0), "bar": ("Pa", 1e5), "MPa": ("Pa", 1e6),
    "N": ("N", 1.0), "kN": ("N", 1e3),
    "A": ("A", 1.0), "mA": ("A", 1e-3),
    "%": ("%", 1.0), "deg": ("deg", 1.0), "1": ("1", 1.0),
}
UNIT_OF_SIGNAL = {"com": "m", "xj": "m", "error": "m", "speed": "m/s", "cor": "A", "p12": "Pa", "xs": "m", "load": "N"}


def find_scale(unit: str, si: str) -> float:
    """How many of the SI unit `si` one `unit` is; InputError at the key `unit` if it measures something else."""
    fitting = [name for name, (base, _) in SI_OF_UNIT.items() if base == si]
    if unit not in fitting:
        raise InputError("unit", "unit", tables.list_choices(unit, fitting))
    return SI_OF_UNIT[unit][1]
