"""Chapter 2: the object dictionary holds what the EDS says, and refuses what it must."""
from __future__ import annotations

from fdi.report.numbers import count_nouns
from rig.conformance.conformance_case import (
    CaseFailed,
    CaseNotApplicable,
    case,
    join_labels,
    require,
    require_applicable,
    require_none,
)
from rig.conformance.data_sheet import DOMAIN, MAPPING, RPDO, TPDO, Variable
from rig.conformance.target import (
    HEAD,
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
    Refusal,
    Target,
    format_abort,
)


@case("2.1", "every object can be read", "7.2.4.2", "an upload of each readable object is answered with its value")
def check_all_readable(t: Target) -> str:
    """Read everything. An empty field of the error history, and a string without a value, may say so."""
    problems, count = [], 0
    for variable in list_readable(t):
        code = t.try_upload(variable.index, variable.sub)
        if code and not (code in (NO_DATA, NO_SUB) and (variable.index == 0x1003 or not variable.size)):
            problems.append(f"{variable.label}: {format_abort(code)}")
        count += 1
    require_none(problems)
    return f"{count_nouns(count, 'object')} read"


@case("2.2", "lengths", "7.1.4", "each value has as many bytes as its data type")
def check_lengths(t: Target) -> str:
    """An UNSIGNED16 has two bytes."""
    problems, count = [], 0
    for variable in list_readable(t):
        data = _read(t, variable)
        if data is None or not variable.size:
            continue
        count += 1
        if len(data) != variable.size:
            problems.append(f"{variable.label} has {len(data)} bytes, expected {variable.size}")
    require_none(problems)
    return count_nouns(count, "value")


@case("2.3", "constants", "7.4, 7.5.2.21", "const objects, device type and identity hold the values of the EDS")
def check_constants(t: Target) -> str:
    """What cannot change is as the EDS says. The serial number is the device's own."""
    problems, count = [], 0
    for variable in list_readable(t):
        is_fixed = variable.access == "const" or variable.index in (0x1000, 0x1018)
        if not is_fixed or variable.default_bytes is None or (variable.index, variable.sub) == (0x1018, 4):
            continue
        count += 1
        data = _read(t, variable)
        if data != variable.default_bytes:
            problems.append(_describe_difference(variable, data))
    require_none(problems)
    return count_nouns(count, "constant")


@case("2.4", "defaults after a reset", "7.3.2.2.1",
      "communication objects hold the defaults of the EDS after a reset of the communication")
def check_defaults(t: Target) -> str:
    """Not where the node can store parameters: stored values take the place of the defaults."""
    require_applicable(0x1010 not in t.sheet.objects, "the node can store parameters (0x1010)")
    problems, count = [], 0
    for variable in list_readable(t):
        if not (variable.is_communication and variable.is_writable) or variable.default_bytes is None:
            continue
        if variable.index in (0x1003, 0x1010, 0x1011):
            continue
        count += 1
        data = _read(t, variable)
        if data != variable.default_bytes:
            problems.append(_describe_difference(variable, data))
    require_none(problems)
    return count_nouns(count, "object")


@case("2.5", "values within their limits", "7.4", "each value lies between LowLimit and HighLimit of the EDS")
def check_values_in_range(t: Target) -> str:
    """The limits of the EDS hold for what is read."""
    problems, count = [], 0
    for variable in list_readable(t):
        if not variable.is_number or (variable.low is None and variable.high is None):
            continue
        data = _read(t, variable)
        if data is None or len(data) != variable.size:
            continue
        count += 1
        value = variable.decode(data)
        if (variable.low is not None and value < variable.low) or (variable.high is not None and value > variable.high):
            problems.append(f"{variable.label} is {value}, limits {variable.low} to {variable.high}")
    require_applicable(count, "the EDS gives no limits")
    require_none(problems)
    return count_nouns(count, "value")


@case("2.6", "sub 0 of arrays and records", "7.4", "sub 0 holds the highest sub-index of the EDS")
def check_highest_sub(t: Target) -> str:
    """Not for the error history and mappings, whose sub 0 counts."""
    problems, count = [], 0
    for index, variables in t.sheet.objects.items():
        if len(variables) < 2 or index == 0x1003 or any(base + MAPPING <= index < base + 2 * MAPPING
                                                        for base in (RPDO, TPDO)):
            continue
        count += 1
        highest, found = max(variable.sub for variable in variables), t.read(index, 0)
        if found != highest:
            problems.append(f"0x{index:04X}:0 is {found}, the highest sub-index is {highest}")
    require_none(problems)
    return count_nouns(count, "object")


@case("2.7", "unknown object", "7.2.4.3.17, table 22", "upload and download are refused with 0x06020000")
def check_unknown_object(t: Target) -> str:
    """An index that the EDS does not have, in each area of the dictionary."""
    areas = (range(0x1002, 0x1200), range(0x1F00, 0x2000), range(0x2000, 0x6000), range(0x6000, 0xA000),
             range(0xFFFF, 0x10000))
    tried, problems = [], []
    for area in areas:
        index = next((index for index in area if index not in t.sheet.objects), None)
        if index is None:
            continue
        tried.append(f"0x{index:04X}")
        for what, request in (("upload", HEAD.pack(0x40, index, 0)), ("download", HEAD.pack(0x2F, index, 0))):
            code = t.find_abort(request.ljust(8, b"\0"))
            if code != NO_OBJECT:
                problems.append(f"{what} of 0x{index:04X}: {format_abort(code)}")
    require_none(problems)
    return f"refused: {', '.join(tried)}"


@case("2.8", "unknown sub-index", "7.2.4.3.17, table 22", "upload and download are refused with 0x06090011")
def check_unknown_sub(t: Target) -> str:
    """One sub-index beyond the last of each object, and 255."""
    problems, count = [], 0
    for index, variables in t.sheet.objects.items():
        if variables[0].is_active:
            continue
        for sub in (max(variable.sub for variable in variables) + 1, 0xFE):
            requests = [("upload", HEAD.pack(0x40, index, sub))]
            if index == 0x1018:  # nothing is written there, whatever the node does
                requests.append(("download", HEAD.pack(0x2F, index, sub)))
            for what, request in requests:
                count += 1
                code = t.find_abort(request.ljust(8, b"\0"))
                if code != NO_SUB:
                    problems.append(f"{what} of 0x{index:04X}:{sub:X}: {format_abort(code)}")
    require_none(problems)
    return f"{count_nouns(count, 'request')} refused"


@case("2.9", "read-only objects", "7.2.4.3.17, table 22",
      "a download of the value they hold is refused with 0x06010002")
def check_read_only(t: Target) -> str:
    """`ro`, `const` and nothing else; the value offered is the one that is there."""
    problems, count = [], 0
    for variable in list_readable(t):
        data = None if variable.is_writable or variable.is_active else _read(t, variable)
        if data is None:
            continue
        count += 1
        code = t.try_download(variable.index, variable.sub, data or b"\0")
        if code != READ_ONLY:
            problems.append(f"{variable.label} ({variable.access}): {format_abort(code)}")
    require_none(problems)
    return f"{count_nouns(count, 'download')} refused"


@case("2.10", "write-only objects", "7.2.4.3.17, table 22", "an upload is refused with 0x06010001")
def check_write_only(t: Target) -> str:
    """`wo` in the EDS."""
    chosen = [variable for variable in t.sheet.variables if not variable.is_readable]
    require_applicable(chosen, "the EDS has no write-only object")
    problems = []
    for variable in chosen:
        code = t.try_upload(variable.index, variable.sub)
        if code != WRITE_ONLY:
            problems.append(f"{variable.label}: {format_abort(code)}")
    require_none(problems)
    return f"refused: {join_labels([variable.label for variable in chosen])}"


@case("2.11", "a value is written back", "7.2.4.2",
      "an object that may be written takes the value read from it and keeps it")
def check_write_back(t: Target) -> str:
    """Every writable object but those that start something, mappings and the error history."""
    problems, count = [], 0
    for variable in t.sheet.variables:
        if not (variable.is_writable and variable.is_readable) or variable.is_active or variable.index == 0x1003 or any(
                base + MAPPING <= variable.index < base + 2 * MAPPING for base in (RPDO, TPDO)):
            continue
        data = _read(t, variable)
        if not data or variable.data_type == DOMAIN:
            continue
        count += 1
        code = t.try_download(variable.index, variable.sub, data)
        if code:
            problems.append(f"{variable.label}: {format_abort(code)}")
        elif _read(t, variable) != data:
            problems.append(f"{variable.label} holds another value then")
    require_applicable(count, "the EDS has no such object")
    require_none(problems)
    return count_nouns(count, "object")


@case("2.12", "wrong length", "7.2.4.3.17, table 22",
      "one byte too many is refused with 0x06070012, one too few with 0x06070013 (or 0x06070010)")
def check_wrong_length(t: Target) -> str:
    """In communication objects; with --write in all numbers that may be written."""
    problems, count = [], 0
    for variable in _list_writable_numbers(t):
        data = _read(t, variable)
        if data is None:
            continue
        offers = [(data + b"\0", TOO_LONG, "too long")]
        if variable.size > 1:
            offers.append((data[:-1], TOO_SHORT, "too short"))
        for offered, expected, what in offers:
            count += 1
            code = t.try_download(variable.index, variable.sub, offered)
            if code not in (expected, WRONG_LENGTH):
                problems.append(f"{variable.label}, {what}: {format_abort(code)}")
                if not code:
                    t.try_download(variable.index, variable.sub, data)
    require_applicable(count, "the EDS has no such object")
    require_none(problems)
    return f"{count_nouns(count, 'download')} refused"


@case("2.13", "value out of range", "7.2.4.3.17, table 22",
      "a value beyond LowLimit or HighLimit is refused with 0x06090030, 0x06090031 or 0x06090032")
def check_out_of_range(t: Target) -> str:
    """In communication objects; with --write in all numbers that may be written."""
    problems, count = [], 0
    for variable in _list_writable_numbers(t):
        for limit, step, codes in ((variable.high, 1, (VALUE, TOO_HIGH)), (variable.low, -1, (VALUE, TOO_LOW))):
            if limit is None:
                continue
            try:
                offered = variable.encode(limit + step)
            except (OverflowError, ValueError):
                continue
            data = _read(t, variable)
            count += 1
            code = t.try_download(variable.index, variable.sub, offered)
            if code not in codes:
                problems.append(f"{variable.label} = {limit + step}: {format_abort(code)}")
                if not code and data is not None:
                    t.try_download(variable.index, variable.sub, data)
    require_applicable(count, "no writable object has limits in the EDS")
    require_none(problems)
    return f"{count_nouns(count, 'value')} refused"


@case("2.14", "device name and versions", "7.5.2.8 to 7.5.2.10",
      "0x1008, 0x1009 and 0x100A are texts of printable characters")
def check_names(t: Target) -> str:
    """What the device says about itself."""
    found = []
    for index in (0x1008, 0x1009, 0x100A):
        if t.sheet.find(index) is None:
            continue
        data = t.upload(index).rstrip(b"\0")
        if any(not 0x20 <= byte < 0x7F for byte in data):
            raise CaseFailed(f"0x{index:04X} holds {data!r}")
        found.append(data.decode("ascii"))
    require_applicable(found, "the node has none of them")
    return ", ".join(found)


@case("2.15", "error register", "7.5.2.2", "0x1001 is 0 after a reset: the node reports no error")
def check_error_register(t: Target) -> str:
    """A node that is in error from the start cannot be judged further on."""
    register = t.read(0x1001)
    require(register == 0, f"0x{register:02X}")
    return "0x00"


def list_readable(t: Target) -> list[Variable]:
    """What the EDS lets a master read."""
    return [variable for variable in t.sheet.variables if variable.is_readable]


def _list_writable_numbers(t: Target) -> list[Variable]:
    """Numbers to which a wrong value can be offered without harm: their meaning is known, or --write allows it."""
    harmless = ((0x1017, 0), (0x1029, 1), (0x1016, 1), (0x1006, 0), (0x1007, 0), (0x1015, 0))
    chosen = [variable for variable in t.sheet.variables if variable.is_number and variable.is_writable
              and variable.is_readable and not variable.is_active
              and ((variable.index, variable.sub) in harmless
                   or (t.options.may_write and not variable.is_communication))]
    if not chosen:
        raise CaseNotApplicable("the EDS has no such object")
    return chosen


def _read(t: Target, variable: Variable) -> bytes | None:
    """What it holds, None if the node gives nothing."""
    try:
        return t.upload(variable.index, variable.sub)
    except Refusal:
        return None


def _describe_difference(variable: Variable, data: bytes | None) -> str:
    """What it holds and what the EDS says."""
    found = "nothing" if data is None else variable.show(data)
    return f"{variable.label} is {found}, the EDS says {variable.show(variable.default_bytes or b'')}"
