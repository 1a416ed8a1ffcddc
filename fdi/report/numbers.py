"""Numbers and findings in the words that people use."""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

SHOWN = {"xj": "XJ", "p12": "P12", "xs": "XS", "cor": "Cor"}
UNITS = {"xj": "m", "p12": "Pa", "xs": "m", "cor": "A"}
SCALES = {  # the units people use, the smallest first
    "m": ((1e-6, "um"), (1e-3, "mm")), "A": ((1e-6, "uA"), (1e-3, "mA")), "s": ((1e-6, "us"), (1e-3, "ms"), (1.0, "s")),
    "N": ((1.0, "N"), (1e3, "kN")), "Pa": ((1e5, "bar"),), "m/s": ((1e-3, "mm/s"),), "m/N": ((1e-9, "nm/N"),),
    "N/m": ((1.0, "N/m"), (1e3, "kN/m")),
}
MOST = 6  # digits; no measurement here tells more


def amount(value: float, unit: str) -> str:
    """An SI value with three digits, in the unit that people use.

    >>> amount(2.649e-4, "m"), amount(3.77e5, "Pa"), amount(1.234e-11, "m3/s/Pa")
    ('265 um', '3.77 bar', '1.23e-11 m3/s/Pa')
    """
    if not math.isfinite(value):
        return "-"
    scale, name = _scale(unit, abs(value))
    return f"{_digits(value / scale, 3)} {name}".rstrip()


def interval(value: float, low: float, high: float, unit: str) -> str:
    """An SI value between two limits, with as many digits as the limits are worth.

    >>> interval(45.01, 44.6, 45.4, "N"), interval(2.2e-5, 2.18e-5, 2.22e-5, "m")
    ('45.0 N (44.6 .. 45.4)', '22.0 um (21.8 .. 22.2)')
    """
    scale, name = _scale(unit, max(abs(value), abs(low), abs(high)))
    half, size = 0.5 * abs(high - low) / scale, max(abs(value), abs(low), abs(high)) / scale
    wanted = MOST if half == 0.0 else 1 + math.floor(math.log10(size)) - math.floor(math.log10(half)) if size else 1
    count = min(max(wanted, 2), MOST)
    shown = [_digits(x / scale, count, size) for x in (value, low, high)]
    return f"{shown[0]} {name}".rstrip() + f" ({shown[1]} .. {shown[2]})"


def _scale(unit: str, size: float) -> tuple[float, str]:
    found = (1.0, "" if unit == "1" else unit)
    known = SCALES.get(unit, ())
    for scale, name in known:
        if size >= scale or scale == known[0][0]:
            found = (scale, name)
    return found


def _digits(x: float, count: int, size: float | None = None) -> str:
    """So many digits of a number as large as `size`."""
    whole = abs(x) if size is None else size
    if x == 0.0 or whole == 0.0:
        return "0"
    place = math.floor(math.log10(whole))
    shown = f"{x:.{max(0, count - 1 - place)}f}" if -4 <= place <= 6 else f"{x:.{count - 1}e}"
    return shown if float(shown) else shown.lstrip("-")


def listed(words: Iterable[str], joined: str = "and") -> str:
    """Words with commas and an "and".

    >>> listed(["a", "b", "c"])
    'a, b and c'
    """
    every = list(words)
    return f" {joined} ".join([", ".join(every[:-1]), every[-1]]) if len(every) > 1 else "".join(every)


def spoken(parameter: str) -> str:
    """A parameter "group.field" as people say it, the effect being known.

    >>> spoken("spool.static_friction")
    'static friction'
    """
    return parameter.partition(".")[2].replace("_", " ")


def errors(by_signal: Mapping[str, float]) -> str:
    """An error of each signal in a line."""
    return ", ".join(f"{SHOWN[s]} {amount(x, UNITS[s])}" for s, x in by_signal.items())


def ratio(value: float) -> str:
    """How many times the floor.

    >>> ratio(1.0234), ratio(16.47), ratio(4995.6)
    ('1.02', '16.5', '4996')
    """
    return "-" if not math.isfinite(value) else _digits(value, 3) if value < 1000 else f"{value:.0f}"


def chance(p: float) -> str:
    """A p-value.

    >>> chance(0.0312), chance(2e-30), chance(1e-300)
    ('0.031', '2e-30', '<1e-99')
    """
    return f"{p:.2g}" if p >= 1e-3 else f"{p:.0e}" if p >= 1e-99 else "<1e-99"
