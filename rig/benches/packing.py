"""Payloads of mapped frames as compiled code: the tables of a `FrameMap`, and what packs and unpacks with them.

One block of memory, `Layout`, holds the tables, the values and one payload of at most 64 bytes. A loop writes `values`
(doubles from VALUES on, one a channel), packs a frame into the payload and sends it; a frame that came is put into the
payload and unpacked into `values`. Nothing is allocated. bench.py does the same in Python.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import ForeignCall, InputError, compile_function, find_function_address, keep_apart, raise_unbound
from rig.benches.bench import Field, FrameSpec, Kind, Protection, Role
from rig.benches.checksums import CHECKSUMS, USERS_CHECKSUMS, add_byte

# Words of the layout: a scratch word, the payload, then counts and places of the tables
_SCRATCH, PAYLOAD = 0, 8
FRAMES, VALUES_AT = 16, 17  # how many frames, and where the values begin
FRAMES_AT = 24
# Columns of a frame. Of the loop: how many were sent, or the last alive counter; the last cycle in which one was taken,
# -1 before. The first frame with an identifier counts for all of them: it is their _COUNT_OF. UNSOUND: frames with a
# wrong checksum or alive counter. STATUS and CAME_WITH: of the last one that came, why it was not taken, and its bytes.
# OWED: cycles for which an earlier frame stood in, less the frames that came beyond one a cycle
(IDENTIFIER, LENGTH, EVERY, IS_MINE, IS_BEFORE_SYNC, IS_ANSWER, IS_NUMBERED, ROLES, _FIRST, _END, _SELECTOR, COUNT,
 _COUNT_OF, UNSOUND, LAST_CYCLE, SENT_AS, STATUS, CAME_WITH, OWED) = range(19)
FRAME_WORDS = 19
# Roles of a frame, bits of ROLES; above them each frame has a bit of its own
COMMAND, FEEDBACK, VALVE, DRIVE = 1, 2, 4, 8
BITS = {"command": COMMAND, "feedback": FEEDBACK, "valve_state": VALVE, "drive": DRIVE}
ALL_ROLES = 0xFF
_FIRST_OWN_BIT = 8
# Columns of a field; the last five are doubles
(_CHANNEL, _LOWEST, _BITS, _IS_BIG, _KIND, _RULE, _FIXED, _NUMERATOR, _DENOMINATOR, _OFFSET, _LOW, _HIGH) = range(12)
_FIELD_WORDS = 12
# A checksum has its numbers in place of count and range; its _FIXED is the address of a user's function, or 0
_POLYNOMIAL, _START, _INVERSION, _DATA_ID, _DATA_IDS_AT = range(7, 12)
_VALUE, _CONSTANT, _COUNTER, _CHECKSUM, _CYCLE = range(5)  # rules: what a field holds
# What `unpack_frame` returns
ACCEPTED, OTHER_LENGTH, WRONG_CHECKSUM, REPEATED, OTHER_CYCLE = range(5)

_call_checksum = ForeignCall("i" + "qq" + "qqqqqqq" + "q")
_TWO_63 = 2.0**63
_SIGNED, _FLOAT = int(Kind.SIGNED), int(Kind.FLOAT)


class Layout(NamedTuple):
    """One block of memory, seen as words, as doubles, as single floats and as bytes."""

    words: NDArray[np.int64]
    doubles: NDArray[np.float64]
    singles: NDArray[np.float32]
    octets: NDArray[np.uint8]


@keep_apart
def find_frame(m: Layout, identifier: int) -> int:
    """The place of the frame in the payload among the tables; -1 for one that is not mapped."""
    words = m.words
    for number in range(words[FRAMES]):
        at = FRAMES_AT + FRAME_WORDS * number
        if words[at + IDENTIFIER] == identifier:
            selector = words[at + _SELECTOR]
            if selector < 0 or _read_bits(m, selector) == words[selector + _FIXED]:
                return at
    return -1


@keep_apart
def pack_frame(m: Layout, at: int, cycle: int) -> None:
    """Write the payload of the frame at `at` from the values, which become what the receiver will read."""
    words = m.words
    words[PAYLOAD:PAYLOAD + 8] = 0
    checksum, count_at = -1, words[at + _COUNT_OF] + COUNT
    number = words[count_at]
    for field in range(words[at + _FIRST], words[at + _END], _FIELD_WORDS):
        rule = words[field + _RULE]
        if rule == _VALUE:
            place = words[VALUES_AT] + words[field + _CHANNEL]
            bits = _encode(m, field, m.doubles[place])
            _write_bits(m, field, bits)
            m.doubles[place] = _decode(m, field, bits)
        elif rule == _CONSTANT:
            _write_bits(m, field, words[field + _FIXED])
        elif rule == _COUNTER:
            number = words[count_at] % words[field + _FIXED]
            _write_bits(m, field, number)
        elif rule == _CYCLE:
            _write_bits(m, field, cycle)
        else:
            checksum = field
    if checksum >= 0:
        _write_bits(m, checksum, _compute_checksum(m, at, checksum, number))
    words[count_at] += 1


@keep_apart
def read_cycle_number(m: Layout, at: int) -> int:
    """The number of the cycle in the payload, which is that of the frame at `at`; -1 if it carries none."""
    for field in range(m.words[at + _FIRST], m.words[at + _END], _FIELD_WORDS):
        if m.words[field + _RULE] == _CYCLE:
            return _read_bits(m, field)
    return -1


@keep_apart
def unpack_frame(m: Layout, at: int, length: int, cycle: int) -> int:
    """Take the values of the frame at `at` from the payload: ACCEPTED, or why they are not taken.

    A frame with the number of another cycle, a wrong checksum or the alive counter of the one before is not taken. One
    whose counter jumps is: the frames between may be lost on the bus.
    """
    words = m.words
    if length != words[at + LENGTH]:
        return OTHER_LENGTH
    counter, checksum = -1, -1
    for field in range(words[at + _FIRST], words[at + _END], _FIELD_WORDS):
        rule = words[field + _RULE]
        if rule == _CYCLE and _read_bits(m, field) != cycle & _find_mask(words[field + _BITS]):
            return OTHER_CYCLE
        if rule == _COUNTER:
            counter = field
        elif rule == _CHECKSUM:
            checksum = field
    number = _read_bits(m, counter) if counter >= 0 else 0
    count_at = words[at + _COUNT_OF] + COUNT
    if checksum >= 0:
        frame_checksum = _read_bits(m, checksum)
        _write_bits(m, checksum, 0)
        if frame_checksum != _compute_checksum(m, at, checksum, number):
            words[at + UNSOUND] += 1
            words[count_at] = -1
            return WRONG_CHECKSUM
    if counter >= 0:
        before, words[count_at] = words[count_at], number
        if before >= 0 and number != (before + 1) % words[counter + _FIXED]:
            words[at + UNSOUND] += 1
            if number == before:
                return REPEATED
    for field in range(words[at + _FIRST], words[at + _END], _FIELD_WORDS):
        if words[field + _RULE] == _VALUE and words[field + _CHANNEL] >= 0:
            m.doubles[words[VALUES_AT] + words[field + _CHANNEL]] = _decode(m, field, _read_bits(m, field))
    return ACCEPTED


def _find_mask(bits: int) -> int:
    return -1 if bits == 64 else (1 << bits) - 1


def to_integer(value: Any) -> int:
    """A number of an array as the integer that compiled code and Python calculate alike with: 64 bits, signed."""
    return int(np.int64(value))


@keep_apart
def _write_bits(m: Layout, field: int, bits: int) -> None:
    """Put the lowest bits into the payload, a byte at a time."""
    octets, place, remaining_bits = m.octets, m.words[field + _LOWEST], m.words[field + _BITS]
    while remaining_bits > 0:
        octet, shift = 8 * PAYLOAD + place // 8, place % 8
        count = min(8 - shift, remaining_bits)
        mask = (1 << count) - 1
        octets[octet] = to_integer(octets[octet]) & ~(mask << shift) & 0xFF | (bits & mask) << shift
        bits >>= count
        remaining_bits -= count
        place = _find_next_byte(m, field, place)


@keep_apart
def _read_bits(m: Layout, field: int) -> int:
    """The bits of a field as a number from 0; of 64 bits with the sign of a signed one."""
    place, remaining_bits = m.words[field + _LOWEST], m.words[field + _BITS]
    bits, position = 0, 0
    while remaining_bits > 0:
        shift = place % 8
        count = min(8 - shift, remaining_bits)
        part = to_integer(m.octets[8 * PAYLOAD + place // 8]) >> shift & (1 << count) - 1
        if position + count == 64 and part >> count - 1:  # the sign, which Python's shift does not set
            part -= 1 << count
        bits |= part << position
        position += count
        remaining_bits -= count
        place = _find_next_byte(m, field, place)
    return to_integer(bits)


def _find_next_byte(m: Layout, field: int, place: int) -> int:
    """Where a field goes on above the byte of `place`: Intel in the byte after it, Motorola in the one before."""
    return (place // 8 - 1) * 8 if m.words[field + _IS_BIG] else (place // 8 + 1) * 8


@keep_apart
def _encode(m: Layout, field: int, value: float) -> int:
    """The bits of a value: see `bench.Field.encode`."""
    words, doubles = m.words, m.doubles
    counts = (value - doubles[field + _OFFSET]) * doubles[field + _DENOMINATOR] / doubles[field + _NUMERATOR]
    if words[field + _KIND] == _FLOAT:
        if words[field + _BITS] == 64:
            doubles[_SCRATCH] = counts
        else:
            words[_SCRATCH] = 0
            m.singles[2 * _SCRATCH] = counts
        return to_integer(words[_SCRATCH])
    if counts >= doubles[field + _HIGH]:
        return _find_mask(words[field + _BITS] - (words[field + _KIND] == _SIGNED))
    counts = np.rint(max(counts, doubles[field + _LOW]))
    return int(counts) if counts < _TWO_63 else int(counts - _TWO_63) - 0x7FFFFFFFFFFFFFFF - 1


@keep_apart
def _decode(m: Layout, field: int, bits: int) -> float:
    """The value of bits: see `bench.Field.decode`."""
    words, doubles, length = m.words, m.doubles, m.words[field + _BITS]
    counts = 0.0
    if words[field + _KIND] == _FLOAT:
        words[_SCRATCH] = bits
        counts = doubles[_SCRATCH] if length == 64 else float(m.singles[2 * _SCRATCH])
    elif words[field + _KIND] == _SIGNED:
        if length < 64 and bits >> length - 1 & 1:
            bits = (bits & _find_mask(length)) - (1 << length)
        counts = float(bits)
    else:
        bits &= _find_mask(length)
        counts = float(bits)
        if counts < 0.0:  # of 64 bits; the last one stays in the half, for a tie it decides how that is rounded
            counts = 2.0 * (bits >> 1 & 0x7FFFFFFFFFFFFFFF | bits & 1)
    value: float = counts * doubles[field + _NUMERATOR] / doubles[field + _DENOMINATOR] + doubles[field + _OFFSET]
    return value


def _compute_checksum(m: Layout, at: int, field: int, counter: int) -> int:
    """The checksum over the payload, in which its own bits are 0: see checksums.py."""
    words, base = m.words, m.words.ctypes.data
    length = words[at + LENGTH]
    if words[field + _FIXED]:
        _call_checksum(words[field + _FIXED], base + 8 * _SCRATCH, base + 8 * (_SCRATCH + 1),
                       0, 0, length, 1, base + 8 * PAYLOAD, length, 1, counter)
        return to_integer(words[_SCRATCH]) & _find_mask(words[field + _BITS])
    crc, polynomial, checksum_byte = words[field + _START], words[field + _POLYNOMIAL], words[field + _LOWEST] // 8
    if words[field + _DATA_ID] >= 0:
        crc = add_byte(crc, words[field + _DATA_ID] & 0xFF, polynomial)
        crc = add_byte(crc, words[field + _DATA_ID] >> 8, polynomial)
    for i in range(length):
        if i != checksum_byte:
            crc = add_byte(crc, to_integer(m.octets[8 * PAYLOAD + i]), polynomial)
    if words[field + _DATA_IDS_AT]:
        ids = words[field + _DATA_IDS_AT]
        crc = add_byte(crc, words[ids + 1 + counter % words[ids]], polynomial)
    return to_integer(crc ^ words[field + _INVERSION])


# ---------------------------------------------------------------------------------------- made before the start


def make_layout(frames: Sequence[FrameSpec], channels: Sequence[str], sender: Role) -> Layout:
    """The tables of these frames for a loop that sends those of `sender` and receives the others.

    Args:
        frames: in the order in which they are sent.
        channels: names of the values; what is not among them is skipped in frames that come.
        sender: whose frames the loop sends.
    """
    width = FRAMES_AT + FRAME_WORDS * len(frames)
    values = width + _FIELD_WORDS * sum(len(each.fields) for each in frames)
    data_ids = [one for each in frames for one in each.fields if one.data_ids]
    words = np.zeros(values + len(channels) + sum(1 + len(one.data_ids) for one in data_ids), np.int64)
    m = Layout(words, words.view(np.float64), words.view(np.float32), words.view(np.uint8))
    words[FRAMES], words[VALUES_AT], ids = len(frames), values, values + len(channels)
    places = {name: i for i, name in enumerate(channels)}
    at, field, firsts = FRAMES_AT, width, dict[int, int]()
    for number, each in enumerate(frames):
        is_mine = each.sender is sender
        rules = [_find_rule(one) for one in each.fields]
        words[at: at + FRAME_WORDS] = (
            each.identifier, each.length, each.every, is_mine, each.is_before_sync, each.is_answer, _CYCLE in rules,
            sum(BITS[role] for role in each.roles) | 1 << _FIRST_OWN_BIT + number, field,
            field + _FIELD_WORDS * len(each.fields), -1, 0 if is_mine else -1, firsts.setdefault(each.identifier, at),
            0, -1, each.sent_as, ACCEPTED, 0, 0)
        for one, rule in zip(each.fields, rules, strict=True):
            _fill_field(m, field, one, rule, places.get(one.name, -1))
            if one is each.selector:
                words[at + _SELECTOR] = field
            if rule == _CHECKSUM and one.data_ids:
                words[field + _DATA_IDS_AT] = ids
                words[ids: ids + 1 + len(one.data_ids)] = len(one.data_ids), *one.data_ids
                ids += 1 + len(one.data_ids)
            field += _FIELD_WORDS
        at += FRAME_WORDS
    return m


def list_frame_places(m: Layout) -> range:
    """Where the frames of a layout stand, in order."""
    return range(FRAMES_AT, FRAMES_AT + FRAME_WORDS * int(m.words[FRAMES]), FRAME_WORDS)


def _find_rule(field: Field) -> int:
    if field.fixed is not None:
        return _CONSTANT
    if field.name == "cycle":
        return _CYCLE
    return {Protection.NONE: _VALUE, Protection.COUNTER: _COUNTER, Protection.CHECKSUM: _CHECKSUM}[field.protection]


def _fill_field(m: Layout, at: int, field: Field, rule: int, channel: int) -> None:
    fixed = field.modulus if rule == _COUNTER else field.fixed or 0
    is_users = rule == _CHECKSUM and field.checksum not in CHECKSUMS
    if is_users:
        fixed = _find_address(field)
    m.words[at: at + _NUMERATOR] = (channel, field.lowest, field.length, field.is_big_endian, field.kind, rule,
                                    np.array(fixed, np.uint64).astype(np.int64))
    if rule == _CHECKSUM and not is_users:
        crc = CHECKSUMS[field.checksum]
        m.words[at + _POLYNOMIAL: at + _FIELD_WORDS] = (
            crc.polynomial, crc.start, crc.inversion, field.data_id if crc.has_data_id else -1, 0)
    else:
        m.doubles[at + _NUMERATOR: at + _FIELD_WORDS] = (field.count.numerator, field.count.denominator,
                                                         float(field.offset), *field.range)


users_checksum = raise_unbound  # the place of a user's function (bytes, counter) -> int


def call_users_checksum(data: NDArray[np.uint8], counter: int) -> int:
    """What is compiled for a user's function: the compiler looks for the file of the function that it is given, and the
    one in a log has none.
    """
    return int(users_checksum(data, counter))


_COMPILED: dict[str, Any] = {}  # kept: the loops call the code by its address


def _find_address(field: Field) -> int:
    """The compiled function of a user's checksum.

    Raises:
        InputError: it cannot be compiled.
    """
    if field.checksum not in _COMPILED:
        run = compile_function(call_users_checksum, {"users_checksum": USERS_CHECKSUMS[field.checksum]})
        try:
            run(np.zeros(8, np.uint8), 0)
        except Exception as error:  # whatever numba has against it
            name, _, function = field.checksum.partition("#")[0].rpartition(":")
            lines = [line.strip() for line in str(error).splitlines() if line.strip() and "pipeline" not in line]
            raise InputError(name, function, "a function of whole numbers that numba can compile "
                                             f"({' '.join(lines[:2])[:200]})") from error
        _COMPILED[field.checksum] = run
    return find_function_address(_COMPILED[field.checksum])
