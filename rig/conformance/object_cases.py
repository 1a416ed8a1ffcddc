"""Chapter 2: the object dictionary holds what the EDS says, and refuses what it must."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from canopen.objectdictionary.datatypes import DOMAIN

from rig.benches import PARAMETERS
from rig.conformance.target import (
    HISTORY,
    NO_DATA,
    NO_OBJECT,
    NO_SUB,
    READ_ONLY,
    TOO_HIGH,
    TOO_LONG,
    TOO_LOW,
    TOO_SHORT,
    VALUE,
    WRITE_ONLY,
    WRONG_LENGTH,
    Case,
    CaseFailed,
    Refusal,
    Target,
    Variable,
    find_abort,
    for_each,
    format_abort,
    require,
    require_abort,
    require_applicable,
)

Value = tuple[Variable, bytes]  # an object, and what it holds


class Offer(NamedTuple):
    """A request that the node must refuse: an upload, or a download if there is data."""

    what: str
    key: tuple[int, int]
    data: bytes | None
    codes: tuple[int, ...]  # that are right
    before: bytes | None = None  # what is written back if the node accepts the data


def check_refused(t: Target, offer: Offer) -> str:
    """The node refuses an offer with the right code."""
    code = find_abort(t.upload, *offer.key) if offer.data is None else t.try_download(*offer.key, offer.data)
    if not code and offer.before is not None:
        t.try_download(*offer.key, offer.before)
    require_abort(code, offer.codes, offer.what)
    return offer.what


def list_readable(t: Target) -> list[Variable]:
    """What the EDS lets a master read."""
    return [variable for variable in t.sheet.variables if variable.is_readable]


def read_values(t: Target, is_wanted: Callable[[Variable], object],
                problem: type[CaseFailed] = Refusal) -> Iterator[Value]:
    """The readable objects that are wanted, and what each holds; without those whose reading ends with `problem`."""
    for variable in filter(is_wanted, list_readable(t)):
        try:
            data = t.upload(*variable.key)
        except problem:
            continue
        yield variable, data


def check_readable(t: Target, variable: Variable) -> None:
    """An empty field of the error history, and a string without a value, may say so."""
    code = find_abort(t.upload, *variable.key)
    is_empty = code in (NO_DATA, NO_SUB) and (variable.index == HISTORY or not variable.size)
    require(not code or is_empty, f"{variable.label}: {format_abort(code)}")


def check_length(t: Target, value: Value) -> None:
    """An UNSIGNED16 has two bytes."""
    value[0].decode(value[1])


def check_limits(t: Target, value: Value) -> None:
    """The limits of the EDS hold for what is read."""
    variable, number = value[0], value[0].decode(value[1])
    require(variable.is_inside(number), f"{variable.label} is {number}, limits {variable.low} to {variable.high}")


def check_default(t: Target, variable: Variable) -> None:
    """It holds what the EDS says."""
    data, default = t.upload(*variable.key), variable.default_bytes or b""
    require(data == default, f"{variable.label} is {variable.show(data)}, the EDS says {variable.show(default)}")


def list_constants(t: Target) -> list[Variable]:
    """What cannot change. The serial number is the device's own."""
    return [variable for variable in list_readable(t)
            if (variable.access == "const" or variable.index in (0x1000, 0x1018)
                or (variable.access == "ro" and (variable.index in PARAMETERS or variable.is_mapping)))
            and variable.default_bytes is not None and variable.key != (0x1018, 4)]


def list_reset(t: Target) -> list[Variable]:
    """What a reset restores. Not where the node can store parameters: these take the place of the defaults."""
    require_applicable(0x1010 not in t.sheet.objects, "the node can store parameters (0x1010)")
    return [variable for variable in list_readable(t) if variable.is_communication and variable.is_writable
            and variable.default_bytes is not None and variable.index not in (HISTORY, 0x1011)]


def check_highest_sub(t: Target, variables: list[Variable]) -> None:
    """Arrays and records say how many sub-indices they have."""
    count, highest = t.read(variables[0].index), variables[-1].sub
    require(count == highest, f"0x{variables[0].index:04X}:0 is {count}, the highest sub-index is {highest}")


def offer_unknown_objects(t: Target) -> Iterator[Offer]:
    """An index that the EDS does not have, in each area of the dictionary."""
    for area in (range(0x1002, 0x1200), range(0x1F00, 0x2000), range(0x2000, 0x6000), range(0x6000, 0xA000),
                 range(0xFFFF, 0x10000)):
        for index in [index for index in area if index not in t.sheet.objects][:1]:
            yield Offer(f"upload of 0x{index:04X}", (index, 0), None, (NO_OBJECT,))
            yield Offer(f"download of 0x{index:04X}", (index, 0), b"\0", (NO_OBJECT,))


def offer_unknown_subs(t: Target) -> Iterator[Offer]:
    """One sub-index beyond the last of each object, and 254."""
    for index, variables in t.sheet.objects.items():
        for sub in () if variables[0].is_active else (variables[-1].sub + 1, 0xFE):
            yield Offer(f"upload of 0x{index:04X}:{sub:X}", (index, sub), None, (NO_SUB,))
            if index == 0x1018:  # nothing is written there, whatever the node does
                yield Offer(f"download of 0x{index:04X}:{sub:X}", (index, sub), b"\0", (NO_SUB,))


def offer_read_only(t: Target) -> Iterator[Offer]:
    """`ro`, `const` and nothing else; the value offered is the one that is there."""
    for variable, data in read_values(t, lambda each: not each.is_writable and not each.is_active):
        yield Offer(f"{variable.label} ({variable.access})", variable.key, data or b"\0", (READ_ONLY,))


def offer_write_only(t: Target) -> list[Offer]:
    """`wo` in the EDS."""
    return [Offer(each.label, each.key, None, (WRITE_ONLY,)) for each in t.sheet.variables if not each.is_readable]


def is_safe_to_write_back(variable: Variable) -> bool:
    """Every writable object but those that start something, mappings and the error history."""
    return (variable.is_writable and not variable.is_active and not variable.is_mapping
            and variable.index != HISTORY and variable.data_type != DOMAIN)


def check_write_back(t: Target, value: Value) -> None:
    """An object takes what was read from it, and keeps it."""
    variable, data = value
    require_applicable(data)
    t.download(*variable.key, data)
    t.require_value(variable, data, "holds another value then")


def read_writable_numbers(t: Target) -> Iterator[Value]:
    """Numbers to which a wrong value can be offered without harm: their meaning is known, or --write allows it."""
    harmless = ((0x1017, 0), (0x1029, 1), (0x1016, 1), (0x1006, 0), (0x1007, 0), (0x1015, 0))
    return read_values(t, lambda each: each.size and each.is_writable and not each.is_active and (
        each.key in harmless or (t.options.may_write and not each.is_communication)))


def offer_wrong_lengths(t: Target) -> Iterator[Offer]:
    """In communication objects; with --write in all numbers that may be written."""
    for variable, data in read_writable_numbers(t):
        yield Offer(f"{variable.label}, too long", variable.key, data + b"\0", (TOO_LONG, WRONG_LENGTH), data)
        if variable.size > 1:
            yield Offer(f"{variable.label}, too short", variable.key, data[:-1], (TOO_SHORT, WRONG_LENGTH), data)


def offer_values_out_of_range(t: Target) -> Iterator[Offer]:
    """In communication objects; with --write in all numbers that may be written."""
    for variable, data in read_writable_numbers(t):
        for limit, step, code in ((variable.high, 1, TOO_HIGH), (variable.low, -1, TOO_LOW)):
            if limit is not None and variable.can_hold(limit + step):
                wrong_data = variable.encode(limit + step)
                yield Offer(f"{variable.label} = {limit + step}", variable.key, wrong_data, (VALUE, code), data)


def check_name(t: Target, index: int) -> str:
    """What the device says about itself."""
    data = t.upload(index).rstrip(b"\0")
    require(all(0x20 <= byte < 0x7F for byte in data), f"0x{index:04X} holds {data!r}")
    return data.decode("ascii")


CASES = (
    Case("2.1", "every object can be read", "7.2.4.2", "an upload of each readable object is answered with its value",
         for_each(list_readable, check_readable, "object", "{} read")),
    Case("2.2", "lengths", "7.1.4", "each value has as many bytes as its data type",
         for_each(lambda t: read_values(t, lambda each: each.size), check_length, "value")),
    Case("2.3", "constants", "7.4, 7.5.2.21",
         "const objects, device type, identity and PDO parameters that are ro hold the values of the EDS",
         for_each(list_constants, check_default, "constant")),
    Case("2.4", "defaults after a reset", "7.3.2.2.1",
         "communication objects hold the defaults of the EDS after a reset of the communication",
         for_each(list_reset, check_default, "object")),
    Case("2.5", "values within their limits", "7.4", "each value lies between LowLimit and HighLimit of the EDS",
         for_each(lambda t: read_values(t, lambda each: each.size and (each.low, each.high) != (None, None)),
                  check_limits, "value")),
    Case("2.6", "sub 0 of arrays and records", "7.4", "sub 0 holds the highest sub-index of the EDS",
         for_each(lambda t: [each for index, each in t.sheet.objects.items() if len(each) > 1 and index != HISTORY
                             and not each[0].is_mapping], check_highest_sub, "object")),
    Case("2.7", "unknown object", "7.2.4.3.17, table 22", "upload and download are refused with 0x06020000",
         for_each(offer_unknown_objects, check_refused, "request", "{} refused")),
    Case("2.8", "unknown sub-index", "7.2.4.3.17, table 22", "upload and download are refused with 0x06090011",
         for_each(offer_unknown_subs, check_refused, "request", "{} refused")),
    Case("2.9", "read-only objects", "7.2.4.3.17, table 22",
         "a download of the value they hold is refused with 0x06010002",
         for_each(offer_read_only, check_refused, "download", "{} refused")),
    Case("2.10", "write-only objects", "7.2.4.3.17, table 22", "an upload is refused with 0x06010001",
         for_each(offer_write_only, check_refused, text="refused: {}")),
    Case("2.11", "a value is written back", "7.2.4.2",
         "an object that may be written takes the value read from it and keeps it",
         for_each(lambda t: read_values(t, is_safe_to_write_back), check_write_back, "object")),
    Case("2.12", "wrong length", "7.2.4.3.17, table 22",
         "one byte too many is refused with 0x06070012, one too few with 0x06070013 (or 0x06070010)",
         for_each(offer_wrong_lengths, check_refused, "download", "{} refused")),
    Case("2.13", "value out of range", "7.2.4.3.17, table 22",
         "a value beyond LowLimit or HighLimit is refused with 0x06090030, 0x06090031 or 0x06090032",
         for_each(offer_values_out_of_range, check_refused, "value", "{} refused")),
    Case("2.14", "device name and versions", "7.5.2.8 to 7.5.2.10",
         "0x1008, 0x1009 and 0x100A are texts of printable characters",
         for_each(lambda t: [index for index in (0x1008, 0x1009, 0x100A) if t.sheet.find(index)], check_name)),
)
