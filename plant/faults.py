"""Faults as data: the parameter that a fault changes, the sizes that it can have, and the two limits of its levels.

A fault file is TOML (docs/fdi.md, "Your own faults"); a plant file declares its own faults as values of `Fault`. What a
fault leaves out comes from the plant: the unit and the symbol from the parameter, the healthy size from its nominal
value.

    [faults.spool_friction]
    title = "friction of the spool"
    parameter = "spool.static_friction"     # of the plant or of an effect
    range = [0, 1000]                       # SI, sizes that are possible
    acceptable = 35                         # MidBand
    maintenance = 70                        # MaxBand
    follow = ["spool.dynamic_friction"]     # grows in proportion
    source = "Table 2 of the paper"
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from plant.errors import InputError, require
from plant.parameters import find_field, read_toml
from plant.tables import Place, build_dataclass, decode_text, parse_table, read_file

WORD = re.compile(r"[a-z][a-z0-9_]*")  # of a fault: a key of JSON and a column of a campaign


@dataclass(frozen=True)
class Fault:
    """A fault that `rig fdi` measures: a parameter, and the sizes at which it needs maintenance. All sizes are SI."""

    name: str = field(metadata={"key": False})
    title: str  # what it is, for people
    parameter: str  # "group.field" of the plant or of an effect
    range: tuple[float, float]  # sizes that are possible
    acceptable: float  # MidBand: up to here acceptable
    maintenance: float  # MaxBand: up to here maintenance, beyond it non-nominal
    source: str = ""  # where the limits come from
    symbol: str = ""  # of the size; default that of the parameter
    unit: str = ""  # of the size; default, and only choice, that of the parameter
    healthy: float = math.nan  # size of a healthy unit; default the nominal value of the parameter
    follow: Mapping[str, float] = field(default_factory=dict, hash=False)  # factors on the size; NaN: as nominal
    both_ways: bool = False  # the limits are distances from the healthy size, above and below it
    axis: tuple[float, float] = (math.nan, math.nan)  # of the RMS maps; default a healthy unit to beyond MaxBand
    interval_factor: float = 1.0  # on the 95 % interval of a fit, where simulations show that it is too narrow

    def __post_init__(self) -> None:
        for key in ("range", "axis"):  # JSON has lists
            object.__setattr__(self, key, tuple(getattr(self, key)))
        if not isinstance(self.follow, Mapping):  # names alone
            object.__setattr__(self, "follow", dict.fromkeys(self.follow, math.nan))

    @property
    def key(self) -> str:
        """The symbol as a key of JSON: kintas, fss."""
        return re.sub(r"\W+", "_", self.symbol or self.name).strip("_").lower()

    @property
    def bracketed_unit(self) -> str:
        """What stands behind a name in the head of a column or at an axis: a space and the unit, or nothing."""
        return "" if self.unit == "1" else f" [{self.unit}]"

    @property
    def falls(self) -> bool:
        """Whether the size of the fault is smaller than that of a healthy unit."""
        return self.acceptable > self.maintenance

    @property
    def parameters(self) -> tuple[str, ...]:
        """Its parameter and those that follow it."""
        return self.parameter, *self.follow

    def list_changes(self, size: float) -> dict[str, float]:
        """The parameters of a unit with a fault of that size, SI."""
        return {self.parameter: size, **{name: size * factor for name, factor in self.follow.items()}}

    def measure_departure(self, size: float) -> float:
        """The size so that larger is worse: distance from a healthy unit of a fault that falls or goes both ways."""
        if self.both_ways:
            return abs(size - self.healthy)
        return self.healthy - size if self.falls else size

    def place_size(self, departure: float) -> float:
        """The size that departs so far, on the side above where both are possible."""
        if self.both_ways:
            return self.healthy + departure
        return self.healthy - departure if self.falls else departure

    def turn_up(self) -> Self:
        """The fault by its departure, which rises from a healthy unit on; itself where its size does."""
        if not (self.falls or self.both_ways):
            return self
        healthy, middle, most = self.limits
        most_possible = max(self.measure_departure(end) for end in self.range)
        return replace(self, symbol=f"change of {self.symbol}", range=(0.0, most_possible), healthy=healthy,
                       acceptable=middle, maintenance=most, both_ways=False, follow={})

    @property
    def limits(self) -> tuple[float, float, float]:
        """Departures of a healthy unit, of MidBand and of MaxBand, rising."""
        if self.both_ways:
            return 0.0, self.acceptable, self.maintenance
        return (self.measure_departure(self.healthy), self.measure_departure(self.acceptable),
                self.measure_departure(self.maintenance))


SCATTER = 5.0  # tolerances, by which a healthy unit may be off its nominal size: a fit must be able to say so


def read_faults(path: Path, kind: Any) -> tuple[Fault, ...]:
    """The faults of a file, for a plant (`plant.plants.Plant`).

    Raises:
        InputError: unreadable, not a fault file, or a fault that the plant cannot have; with file and key.
    """
    tables, place = parse_table(decode_text(read_file(path), path), str(path))
    for key in tables:
        place.at(key).require(key == "faults", "only tables [faults.NAME]")
    fault_tables = tables.get("faults")
    if not isinstance(fault_tables, dict) or not fault_tables:
        raise place.refuse("at least one table [faults.NAME]")
    return place_faults((_read_fault(name, table, place.at("faults", name)) for name, table in fault_tables.items()),
                        kind, path)


def is_fault_file(path: Path) -> bool:
    """Whether a file has tables [faults.NAME], as no sequence has."""
    try:
        return path.is_file() and isinstance(read_toml(path).get("faults"), dict)
    except InputError:
        return False


def _read_fault(name: str, table: object, place: Place) -> Fault:
    """The fault of a table [faults.NAME]; its `follow` may be a list of names as well."""
    names = table.get("follow") if isinstance(table, dict) else None
    if not isinstance(table, dict) or not isinstance(names, list):
        return build_dataclass(Fault, table, place, name=name)
    fault = build_dataclass(Fault, {**table, "follow": {}}, place, name=name)
    return replace(fault, follow=dict.fromkeys(map(str, names), math.nan))


def place_faults(faults: Any, kind: Any, where: object = "faults") -> tuple[Fault, ...]:
    """Faults with what they leave out taken from the plant, checked one by one and together.

    Raises:
        InputError: see `place_fault`; or two faults of one parameter or symbol.
    """
    complete_faults: list[Fault] = []
    owners: dict[str, str] = {}
    for fault in faults:
        complete_fault = place_fault(fault, kind, where)
        if any(other.key == complete_fault.key for other in complete_faults):
            complete_fault = replace(complete_fault, symbol=complete_fault.name) if not fault.symbol else complete_fault
        for what in (*complete_fault.parameters, complete_fault.key):
            require(what not in owners, where, f"faults.{complete_fault.name}",
                    f"a parameter and a symbol of its own; {what} is that of {owners.get(what)}")
            owners[what] = complete_fault.name
        complete_faults.append(complete_fault)
    return tuple(complete_faults)


def place_fault(fault: Fault, kind: Any, where: object = "faults") -> Fault:
    """A fault with unit, symbol and healthy size from its parameter in the plant `kind`.

    Parameters that follow without a factor on the size keep their nominal ratio to the fault's own.

    Raises:
        InputError: a parameter that the plant lacks, another unit, or limits that contradict each other or the range.
    """
    groups, effects = kind.list_groups(), kind.list_effects()

    def check(holds: object, key: str, expected: str) -> None:
        require(holds, where, f"faults.{fault.name}.{key}".rstrip("."), expected)

    def look_up(key: str, name: object) -> Any:
        try:
            return find_field(where, str(name), groups)
        except InputError as error:
            raise InputError(where, f"faults.{fault.name}.{key}", f"a parameter of the plant {kind.name} or of an "
                             f"effect, not {name} (there expected {error.expected})") from error

    check(WORD.fullmatch(fault.name), "", "a name of small letters, digits and _")
    q = look_up("parameter", fault.parameter)
    unseen = {"controller", "sensors", *(e.name for e in effects if e.port in ("command", "reading"))}
    check(fault.parameter.partition(".")[0] not in unseen, "parameter",
          f"a parameter that a replay of the measured drive shows; {fault.parameter} is none")
    check(not q.words, "parameter", f"a parameter that has sizes; {fault.parameter} has named choices")
    check(q.unit, "parameter", f"a parameter with a unit; {fault.parameter} is declared without one")
    check(fault.unit in ("", q.unit), "unit", f"{q.unit}, that of {fault.parameter}, not {fault.unit}")
    values = {**{name: off for e in effects for name, off in e.off.items()}, **kind.nominal}
    usual = {name: float(values.get(name, 0.0)) for name in fault.parameters}
    check(usual[fault.parameter] or not any(map(math.isnan, fault.follow.values())), "follow",
          f"a table of factors: {fault.parameter} is 0 in a healthy unit")
    follow = {name: usual[name] / usual[fault.parameter] if math.isnan(factor) else factor
              for name, factor in fault.follow.items()}
    fault = replace(fault, unit=q.unit, symbol=fault.symbol or q.symbol or fault.name, follow=follow,
                    healthy=usual[fault.parameter] if math.isnan(fault.healthy) else fault.healthy)
    _check_limits(fault, q, check)
    for name, factor in follow.items():
        quantity = look_up("follow", name)
        check(not any(quantity.refuses(factor * size) for size in fault.range), "follow",
              f"factors that make values of {name}, {quantity.expected}, over the whole range, not {factor:g}")
    if math.isnan(fault.axis[0]):
        beyond = 10.0 / 7.0 * (fault.maintenance - (0.0 if fault.both_ways else fault.healthy))
        ends = fault.healthy - beyond if fault.both_ways else fault.healthy, fault.healthy + beyond
        low, high = (min(max(end, fault.range[0]), fault.range[1]) for end in sorted(ends))
        fault = replace(fault, axis=(low, high))
    scatter = SCATTER * kind.find_tolerance(fault.parameter, q) * abs(fault.healthy)
    ends = fault.healthy - scatter, fault.healthy + scatter  # a range may begin at the nominal size
    low, high = (end if q.refuses(wider) else wider for end, wider in zip(fault.range, ends, strict=True))
    return replace(fault, range=(min(fault.range[0], low), max(fault.range[1], high)))


def _check_limits(f: Fault, q: Any, check: Callable[[object, str, str], None]) -> None:
    """Raises InputError for sizes that contradict each other."""
    low, high = f.range
    healthy, shift = (0.0, f.healthy) if f.both_ways else (f.healthy, 0.0)
    rises, falls = healthy < f.acceptable < f.maintenance, healthy > f.acceptable > f.maintenance
    whole = f"{low:g} .. {high:g} {f.unit}"
    check(low < high, "range", f"[least, largest], not [{low:g}, {high:g}]")
    check(not (q.refuses(low) or q.refuses(high)), "range",
          f"values of {f.parameter}, {q.expected}, not [{low:g}, {high:g}]")
    check(low <= f.healthy <= high, "range",
          f"a range that holds the healthy size, {f.healthy:g} {f.unit}, not [{low:g}, {high:g}]")
    for key, size in (("acceptable", f.acceptable), ("maintenance", f.maintenance)):
        check(low <= shift + size <= high, key, f"a size within the range {whole}, not {size:g}")
    check(rises or (falls and not f.both_ways), "acceptable",
          f"a size between that of a healthy unit, {healthy:g}, and maintenance, {f.maintenance:g} {f.unit}, not "
          f"{f.acceptable:g}")
    check(math.isnan(f.axis[0]) or low <= f.axis[0] < f.axis[1] <= high, "axis",
          f"[least, largest] within the range {whole}, not {list(f.axis)}")
    check(0.1 <= f.interval_factor <= 10.0, "interval_factor", f"a factor from 0.1 to 10, not {f.interval_factor:g}")
