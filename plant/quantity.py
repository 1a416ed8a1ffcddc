"""The meaning of a number: its unit, its symbol in the paper, and its possible values.

A parameter group is a NamedTuple whose fields are `Annotated[float, Quantity(...)]`, or a table of fields
(`make_group`). The unit lives in the type, where people, error messages, logs and tables all read the same one.
"""

import math
from collections import namedtuple
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, NamedTuple, cast, get_args, get_type_hints


class Quantity(NamedTuple):
    """Unit, symbol and range of a number. `low` and `high` are allowed; `above` and `below` are not."""

    unit: str = ""  # "1" for none
    symbol: str = ""  # as in the source paper, where it has one
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    words: Mapping[str, float] = {}  # named values, for a choice
    typical: str = ""  # the range met in practice, for people
    tolerance: float = 0.0  # how far one unit differs from another, as a fraction (prior of a fit)
    is_whole: bool = False  # such as a number of teeth

    def __hash__(self) -> int:
        return hash((*self[:6], *self.words, *self[7:]))  # a dict has none, and annotations must

    def refuses(self, value: float) -> bool:
        """True for a value outside the range, NaN or infinity, and a fraction where only whole numbers are possible."""
        return not (math.isfinite(value) and self.low <= value <= self.high and self.above < value < self.below
                    and (value == round(value) or not self.is_whole))

    def describe(self, value: float) -> str:
        """An SI value for people: with its unit, or the word of a choice."""
        word = next((word for word, number in self.words.items() if number == value), "")
        return word or f"{value:g}" + ("" if self.unit == "1" else f" {self.unit}")

    @property
    def expected(self) -> str:
        """The allowed values in words, for messages and tables.

        >>> Quantity("kg", above=0).expected
        'a number above 0 kg'
        """
        if self.words:
            return "one of " + ", ".join(self.words)
        bounds = self.bounds
        if self.is_whole:
            return f"a whole number {bounds}".rstrip()
        return f"a number {bounds}" if bounds else f"a finite number in {self.unit}"

    @property
    def bounds(self) -> str:
        """The range in words, "" for any number.

        >>> Quantity("s", low=0.0, high=3600.0).bounds, Quantity("1", above=0.0, high=1.0).bounds
        ('from 0 to 3600 s', 'above 0 and at most 1')
        """
        ends = {"from": self.low, "above": self.above, "at most": self.high, "below": self.below}
        text = " and ".join(f"{word} {end if isinstance(end, int) else format(end, 'g')}"
                            for word, end in ends.items() if math.isfinite(end))
        text = text.replace(" and at most", " to") if self.low > -math.inf else text
        return f"{text} {self.unit}" if text and self.unit != "1" else text


def list_quantities(group: type[Any]) -> Mapping[str, Quantity]:
    """The fields of a parameter group, in order, with their quantities."""
    if group not in _KNOWN_GROUPS:  # reading annotations takes longer than everything else about a model
        hints = get_type_hints(group, include_extras=True)
        _KNOWN_GROUPS[group] = {name: (*get_args(hints[name]), None, None)[1] for name in group._fields}
    return _KNOWN_GROUPS[group]


_KNOWN_GROUPS: dict[type[Any], Mapping[str, Quantity]] = {}


def make_group(name: str, meaning: str, fields: Mapping[str, Quantity], module: str, values: Iterable[float] = ()
               ) -> type[Any]:
    """A parameter group from a table of its fields; `module` has it as `name`, `values` are the nominal ones."""
    group = cast("type[Any]", namedtuple(name, fields, defaults=values, module=module))
    group.__annotations__ = {field: Annotated[float, q] for field, q in fields.items()}
    group.__doc__ = meaning
    return group
