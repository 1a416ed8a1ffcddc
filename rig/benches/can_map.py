"""A DBC as frames of a device on plain CAN: messages, byte orders, multiplexed pages, CAN FD."""
from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from plant.errors import InputError, suggest_name
from rig.benches.frame_map import EXTENDED, FD, Field, Kind
from rig.benches.layout import DeviceFrame, Slot, Use, silence_log
from rig.tables import list_choices

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_HUGE = re.compile(r"^\s*(?:BO_\s[^:\n]*:\s*\d{5}|SG_\s[^:\n]*:[^@\n]*\d{6}|SG_MUL_VAL_\s[^;]*-\s*\d{6})", re.MULTILINE)
_LARGEST = 1e300
_FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


def read_database(name: str, text: str) -> Any:
    """The messages of a DBC as cantools reads them.

    Raises:
        InputError: not a DBC.
    """
    huge = _HUGE.search(text)
    if huge is not None:  # cantools would work on it for hours
        raise InputError(name, "", f"a DBC with lengths of CAN frames, not {huge[0].strip()[:100]!r}")
    import cantools  # here: a CANopen bench has no DBC, and to load it takes 20 ms

    try:
        with silence_log("cantools"):  # what it warns of are messages that the bench does not use
            return cantools.database.load_string(text, "dbc", strict=False)
    except Exception as error:  # whatever cantools stumbles over in a file that is no DBC
        said = " ".join(str(error).split())[:200]
        raise InputError(name, "", f"a DBC ({said or type(error).__name__})") from error


def map_messages(name: str, database: Any, uses: Mapping[str, Use], cycle_ns: int) -> list[DeviceFrame]:
    """The messages in which `uses` ("MESSAGE.SIGNAL") lie, each page of a multiplexed one as a frame.

    Raises:
        InputError: a message or signal that the DBC lacks, or one that cannot be sent as the bench file wants.
    """
    messages = {message.name: message for message in database.messages}
    grouped: dict[str, dict[str, Use]] = {}
    for full, use in uses.items():
        message, _, signal = full.partition(".")
        if message not in messages or not signal:
            raise use.place.refuse(f"MESSAGE.SIGNAL of {name}, not {full!r}{suggest_name(message, messages)}")
        if sum(each.name == message for each in database.messages) > 1:
            raise use.place.refuse(f"one message {message}; {name} has several")
        known = {each.name for each in messages[message].signals}
        if signal not in known:
            raise use.place.refuse(f"a signal of message {message}: {list_choices(signal, known)}")
        grouped.setdefault(message, {})[full] = use
    return [frame for message, own in grouped.items() for frame in _map_message(name, messages[message], own, cycle_ns)]


def _map_message(name: str, message: Message, uses: Mapping[str, Use], cycle_ns: int) -> Iterator[DeviceFrame]:
    ways = {use.is_received for use in uses.values()} - {None}
    place = next(iter(uses.values())).place
    if len(ways) != 1:
        expected = "in one direction" if ways else "that other tables of this file use"
        raise place.refuse(f"signals of a message {expected}; {message.name} has {', '.join(uses)}")
    if message.length not in _FD_LENGTHS:
        raise InputError(name, message.name, f"a length of a CAN frame, 0 to 8 bytes (CAN FD also 12, 16, 20, 24, 32, "
                                             f"48, 64), not {message.length}")
    is_fd = message.is_fd or message.length > 8
    identifier = message.frame_id | (EXTENDED if message.is_extended_frame else 0) | (FD if is_fd else 0)
    slots = {signal.name: _read_slot(name, message, signal) for signal in message.signals}
    pages: list[int | None] = [None]
    selectors = [signal for signal in message.signals if signal.is_multiplexer]
    chosen = [signal for signal in message.signals if f"{message.name}.{signal.name}" in uses]
    if selectors:
        pages = list(_list_pages(message, chosen, is_received=True in ways))
    if pages != [None] and (len(selectors) > 1 or selectors[0] in chosen):
        raise place.refuse(f"one multiplexer, with no other use; {message.name} has "
                           f"{', '.join(signal.name for signal in selectors)}")
    for page in pages:
        on_page = [slots[signal.name] for signal in message.signals
                   if signal.multiplexer_ids is None or page in signal.multiplexer_ids]
        if page is not None:
            selector = slots[selectors[0].name]
            on_page = [_select(selector, page) if slot is selector else slot for slot in on_page]
        carries_current = any(slot.name in uses and uses[slot.name].signal == "current" for slot in on_page)
        yield DeviceFrame(
            name=message.name if page is None else f"{message.name}[{page}]", identifier=identifier,
            length=message.length, is_received=True in ways, slots=tuple(on_page),
            every=_find_period(name, message, cycle_ns),
            is_answer=True in ways or carries_current or (len(pages) == 1 and bool(message.cycle_time)))


def _list_pages(message: Message, chosen: list[Signal], *, is_received: bool) -> Iterator[int | None]:
    """The values of the selector with a used signal; all that the DBC has, where it stands beside a used one."""
    numbers = {number for signal in message.signals for number in signal.multiplexer_ids or ()}
    used = {number for signal in chosen for number in signal.multiplexer_ids or ()}
    has_common = any(signal.multiplexer_ids is None for signal in chosen)
    if used:
        yield from sorted(numbers if has_common and not is_received else used)
    else:
        start = next(signal.raw_initial for signal in message.signals if signal.is_multiplexer)
        yield int(start or 0) if is_received else None


def _select(selector: Slot, page: int) -> Slot:
    """The selector with the value of a page."""
    return Slot(name=selector.name, bits=selector.bits, start=page, is_selector=True)


def _find_period(name: str, message: Message, cycle_ns: int) -> int:
    given = _read_number(name, f"{message.name} GenMsgCycleTime", message.cycle_time)
    period = given * 1_000_000 / cycle_ns
    if period.denominator != 1 or not 0 <= period < 1_000_000:
        raise InputError(name, message.name, f"a GenMsgCycleTime that is a multiple of the cycle, {cycle_ns / 1e6:g} "
                                             f"ms, not {float(given):g} ms")
    return int(period) or 1


def _read_number(name: str, field: str, value: object) -> Fraction:
    """A number of a DBC as its text stands there; 0 for None."""
    if value is not None and not (isinstance(value, int | float) and abs(value) < _LARGEST):
        raise InputError(name, field, "a finite number")
    return Fraction(str(value or 0))


def _read_slot(name: str, message: Message, signal: Signal) -> Slot:
    full, conversion = f"{message.name}.{signal.name}", signal.conversion
    scale, offset, start, maximum = (_read_number(name, full, value) for value in (
        conversion.scale, conversion.offset, signal.raw_initial, signal.maximum))
    lowest = signal.start
    if signal.byte_order == "big_endian":  # a DBC has the place of the most significant bit
        last = 8 * (signal.start // 8) + 7 - signal.start % 8 + signal.length - 1
        lowest = 8 * (last // 8) + 7 - last % 8
    kind = Kind.SIGNED if signal.is_signed else Kind.UNSIGNED
    kind = Kind.FLOAT if conversion.is_float else kind
    wrap = None
    if maximum and scale and signal.length <= 64:
        last_count = (maximum - offset) / scale
        wrap = int(last_count) + 1 if 0 < last_count < (1 << signal.length) - 1 else None
    bits = Field(name="", lowest=lowest, length=signal.length, is_big_endian=signal.byte_order == "big_endian",
                 kind=kind, wrap=wrap)
    return Slot(name=full, bits=bits, scale=scale, offset=offset, unit=signal.unit or "",
                start=int(start) if start.denominator == 1 else float(start),
                choices={str(text): int(number) for number, text in (signal.choices or {}).items()})
