"""Numbers as people read them: amounts with units, intervals, ratios to the noise floor, p-values, joined words.

Every printed estimate goes through here, so that it has the same digits and unit on the terminal and on a page.
"""

import math
from collections.abc import Iterable, Sequence

READABLE_UNITS = {  # SI unit to the units that people use, the smallest first
    "m": ((1e-6, "um"), (1e-3, "mm")), "A": ((1e-6, "uA"), (1e-3, "mA")), "s": ((1e-6, "us"), (1e-3, "ms"), (1.0, "s")),
    "N": ((1.0, "N"), (1e3, "kN")), "Pa": ((1e5, "bar"),), "m/s": ((1e-3, "mm/s"),), "m/N": ((1e-9, "nm/N"),),
    "N/m": ((1.0, "N/m"), (1e3, "kN/m")),
}
NO_NUMBER = "-"  # printed for NaN and infinity


def format_amount(value: float, unit: str, digits: int = 3) -> str:
    """An SI value with three digits, in the unit that people use; "-" for NaN and infinity.

    >>> format_amount(2.649e-4, "m"), format_amount(3.77e5, "Pa"), format_amount(1.234e-11, "m3/s/Pa")
    ('265 um', '3.77 bar', '1.23e-11 m3/s/Pa')
    >>> format_amount(0.25, "1"), format_amount(float("nan"), "m")
    ('0.250', '-')
    """
    if not math.isfinite(value):
        return NO_NUMBER
    scale, name = choose_unit(unit, abs(value))
    return f"{format_digits(value / scale, digits)} {name}".rstrip()


def format_interval(value: float, low: float, high: float, unit: str, most_digits: int = 6) -> str:
    """An SI value with its interval, with as many digits as the interval is worth.

    >>> format_interval(45.01, 44.6, 45.4, "N"), format_interval(2.2e-5, 2.18e-5, 2.22e-5, "m")
    ('45.0 N (44.6 .. 45.4)', '22.0 um (21.8 .. 22.2)')
    """
    largest = max((abs(x) for x in (value, low, high) if math.isfinite(x)), default=0.0)
    scale, name = choose_unit(unit, largest)
    digits = _digits_of_interval(0.5 * abs(high - low), largest, most_digits)
    texts = [format_digits(x / scale, digits, largest / scale) for x in (value, low, high)]
    return f"{texts[0]} {name}".rstrip() + f" ({texts[1]} .. {texts[2]})"


def _digits_of_interval(half: float, largest: float, most: int) -> int:
    """Digits that show an interval of this half-width to two digits."""
    if largest == 0.0 or not math.isfinite(half):
        return 2
    if half == 0.0:
        return most
    return min(max(1 + math.floor(math.log10(largest)) - math.floor(math.log10(half)), 2), most)


def format_ratio(ratio: float) -> str:
    """An error over its noise floor, 1 for noise alone.

    >>> format_ratio(1.0234), format_ratio(16.47), format_ratio(4995.6), format_ratio(499452.6), format_ratio(0.008)
    ('1.02', '16.5', '4996', '>10000', '<0.1')
    """
    if math.isnan(ratio):
        return NO_NUMBER
    if ratio > 1e4:
        return ">10000"
    if ratio < 0.1:
        return "<0.1"
    return format_digits(ratio, 3) if ratio < 1000.0 else f"{ratio:.0f}"


def format_p_value(p: float) -> str:
    """A p-value with two digits.

    >>> format_p_value(0.0312), format_p_value(2e-30), format_p_value(1e-300)
    ('0.031', '2e-30', '<1e-99')
    """
    if p >= 1e-3:
        return f"{p:.2g}"
    return f"{p:.0e}" if p >= 1e-99 else "<1e-99"


def format_percent(share: float, digits: int = 2) -> str:
    """A share of 1 in percent.

    >>> format_percent(0.4567), format_percent(0.0012), format_percent(1.0)
    ('46 %', '0.12 %', '100 %')
    """
    return f"{format_digits(100.0 * share, digits)} %" if math.isfinite(share) else NO_NUMBER


def format_digits(x: float, digits: int = 3, size: float | None = None) -> str:
    """A number with so many digits, counted from the first digit of `size` (default: of the number itself).

    >>> format_digits(0.0312), format_digits(45.0), format_digits(3.0, 3, 45.0), format_digits(1.2e-7)
    ('0.0312', '45.0', '3.0', '1.20e-07')
    """
    if not math.isfinite(x):
        return NO_NUMBER
    reference = abs(x) if size is None else size
    if x == 0.0 or reference == 0.0:
        return "0"
    place = math.floor(math.log10(reference))
    text = f"{x:.{max(0, digits - 1 - place)}f}" if -4 <= place <= 6 else f"{x:.{digits - 1}e}"
    return text if float(text) else text.lstrip("-")  # not "-0.0"


def choose_unit(unit: str, size: float) -> tuple[float, str]:
    """The unit people use for an SI value of this size: (its SI value, its name).

    >>> choose_unit("m", 2e-3), choose_unit("kg", 5.0), choose_unit("1", 0.2)
    ((0.001, 'mm'), (1.0, 'kg'), (1.0, ''))
    """
    units = READABLE_UNITS.get(unit, ((1.0, "" if unit == "1" else unit),))
    return next((pair for pair in reversed(units) if size >= pair[0]), units[0])


def format_limit(value: float, unit: str, size: float | None = None) -> str:
    """An SI value as somebody has declared it, in the unit that people use for a `size` (default: its own).

    >>> format_limit(35.0, "N"), format_limit(5e-5, "m"), format_limit(5e-5, "m", 2e-3), format_limit(0.25, "1")
    ('35 N', '50 um', '0.05 mm', '0.25')
    """
    scale, name = choose_unit(unit, abs(value if size is None else size))
    return f"{value / scale:g} {name}".rstrip()


def format_duration(seconds: float) -> str:
    """A duration in seconds, minutes or hours.

    >>> format_duration(75.0), format_duration(600.0), format_duration(9000.0)
    ('75 s', '10 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def join_words(words: Iterable[str], conjunction: str = "and") -> str:
    """Words with commas and an "and".

    >>> join_words(["a", "b", "c"]), join_words(["a", "b"], "or")
    ('a, b and c', 'a or b')
    """
    texts = list(words)
    if len(texts) < 2:
        return "".join(texts)
    return f"{', '.join(texts[:-1])} {conjunction} {texts[-1]}"


def list_first(words: Sequence[str], most: int) -> str:
    """The first of many words, and how many more there are.

    >>> list_first(["a", "b", "c"], 2), list_first(["a", "b"], 2)
    ('a, b and 1 more', 'a, b')
    """
    rest = len(words) - most
    return ", ".join(words[:most]) + (f" and {rest} more" if rest > 0 else "")


def name_parameter(parameter: str) -> str:
    """A parameter "group.field" in words, where the effect is known from the context.

    >>> name_parameter("spool.static_friction")
    'static friction'
    """
    return parameter.partition(".")[2].replace("_", " ")
