"""A DBC as frames of a device on plain CAN: messages, byte orders, multiplexed pages, CAN FD."""
from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from plant import InputError, Place, list_choices, require, suggest_name
from rig.benches.bench import EXTENDED, FD, MOST_FRAMES, Field, FrameSpec, Kind, Role
from rig.benches.layout import DeviceFrame, Slot, Use, use_reader

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
    if (huge := _HUGE.search(text)) is not None:  # cantools would work on it for hours
        raise InputError(name, "", f"a DBC with lengths of CAN frames, not {huge[0].strip()[:100]!r}")
    import cantools  # here: a CANopen bench has no DBC, and to load it takes 20 ms

    with use_reader("cantools", name, "a DBC ({})"):  # it warns of messages that the bench does not use
        return cantools.database.load_string(text, "dbc", strict=False)


def map_messages(name: str, database: Any, uses: Mapping[str, Use], cycle_ns: int) -> list[DeviceFrame]:
    """The messages in which `uses` ("MESSAGE.SIGNAL") lie, each page of a multiplexed one as a frame.

    Raises:
        InputError: a message or signal that the DBC lacks, or one that cannot be sent as the bench file wants.
    """
    messages = {message.name: message for message in database.messages}
    uses_by_message: dict[str, dict[str, Use]] = {}
    for full, use in uses.items():
        message, _, signal = full.partition(".")
        if message not in messages or not signal:
            raise use.place.refuse(f"MESSAGE.SIGNAL of {name}, not {full!r}{suggest_name(message, messages)}")
        use.place.require(sum(each.name == message for each in database.messages) == 1,
                          f"one message {message}; {name} has several")
        signal_names = {each.name for each in messages[message].signals}
        use.place.require(signal in signal_names,
                          f"a signal of message {message}: {list_choices(signal, signal_names)}")
        uses_by_message.setdefault(message, {})[full] = use
    brs_names = _find_switched(database)
    return [frame for message, message_uses in uses_by_message.items()
            for frame in _map_message(name, messages[message], message_uses, cycle_ns,
                                      is_switched=message in brs_names)]


def _find_switched(database: Any) -> set[str]:
    """The messages whose data go at the higher bit rate of CAN FD: the attribute CANFD_BRS says so."""
    specifics = database.dbc
    definition = None if specifics is None else specifics.attribute_definitions.get("CANFD_BRS")
    if definition is None:
        return set()
    names, brs_names = [str(each) for each in definition.choices or ()], set()
    for message in database.messages:
        attribute = message.dbc.attributes.get("CANFD_BRS") if message.dbc is not None else None
        value = definition.default_value if attribute is None else attribute.value
        is_place = attribute is not None and isinstance(value, int) and 0 <= value < len(names)
        if (names[int(value)] if is_place else str(value)) == "1":
            brs_names.add(message.name)
    return brs_names


def _map_message(name: str, message: Message, uses: Mapping[str, Use], cycle_ns: int, *, is_switched: bool
                 ) -> Iterator[DeviceFrame]:
    ways = {use.is_received for use in uses.values()} - {None}
    place = next(iter(uses.values())).place
    if len(ways) != 1:
        expectation = "in one direction" if ways else "that other tables of this file use"
        raise place.refuse(f"signals of a message {expectation}; {message.name} has {', '.join(uses)}")
    require(message.length in _FD_LENGTHS, name, message.name,
            f"a length of a CAN frame, 0 to 8 bytes (CAN FD also 12, 16, 20, 24, 32, 48, 64), not {message.length}")
    is_fd = message.is_fd or message.length > 8
    identifier = message.frame_id | (EXTENDED if message.is_extended_frame else 0) | (FD if is_fd else 0)
    slots = {signal.name: _read_slot(name, message, signal) for signal in message.signals}
    used_signals = [signal for signal in message.signals if f"{message.name}.{signal.name}" in uses]
    selector = _find_selector(message, used_signals, place)
    if (full_name := f"{message.name}.{selector}") in uses:
        raise uses[full_name].place.refuse(f"signals with no other use; {full_name} is the multiplexer of used ones")
    pages = _list_pages(message, used_signals, selector, is_received=True in ways)
    for page in pages:
        on_page = [replace(slots[signal.name], start=page, is_selector=True) if signal.name == selector else
                   slots[signal.name] for signal in message.signals if _is_on_page(message, signal, selector, page)]
        is_needed = any(slot.name in uses and uses[slot.name].is_needed for slot in on_page)
        yield DeviceFrame(slots=tuple(on_page), spec=FrameSpec(
            name=f"{message.name}[{page}]" if selector else message.name,
            identifier=identifier, length=message.length, sender=Role.RIG if True in ways else Role.CONTROLLER,
            every=_find_period(name, message, cycle_ns), is_switched=is_fd and is_switched,
            is_answer=True in ways or is_needed or (len(pages) == 1 and bool(message.cycle_time))))


def _find_selector(message: Message, used_signals: list[Signal], place: Place) -> str:
    """The multiplexer of the used signals, "" where there is none; several, or nested ones, are refused."""
    multiplexers = {str(signal.multiplexer_signal) for signal in used_signals if signal.multiplexer_signal}
    outer = {signal.name for signal in message.signals if signal.name in multiplexers and signal.multiplexer_signal}
    place.require(len(multiplexers) <= 1 and not outer,
                  f"signals of one multiplexer; {message.name} has {' and '.join(sorted(multiplexers))}"
                  f"{', a nested one' if outer else ''}")
    return next(iter(multiplexers), "")


def _list_pages(message: Message, used_signals: list[Signal], selector: str, *, is_received: bool) -> list[int]:
    """The values of the selector with a used signal; of a message that the device sends also the others on which one
    stands. Without a selector there is one page.
    """
    stands_beside = not is_received and any(not signal.multiplexer_signal for signal in used_signals)
    pages = {number for signal in (message.signals if stands_beside else used_signals)
             if selector and signal.multiplexer_signal == selector for number in signal.multiplexer_ids or ()}
    return sorted(pages)[:MOST_FRAMES + 1] if selector else [0]


def _is_on_page(message: Message, signal: Signal, selector: str, page: int) -> bool:
    """Whether a page has a signal; a multiplexer other than the selector has its start value."""
    parent = next((each for each in message.signals if each.name == signal.multiplexer_signal), None)
    return parent is None or (page if parent.name == selector else int(parent.raw_initial or 0)) in (
        signal.multiplexer_ids or ())


def _find_period(name: str, message: Message, cycle_ns: int) -> int:
    cycle_time = _read_number(name, f"{message.name} GenMsgCycleTime", message.cycle_time)
    period = cycle_time * 1_000_000 / cycle_ns
    require(period.denominator == 1 and 0 <= period < 1_000_000, name, message.name,
            f"a GenMsgCycleTime that is a multiple of the cycle, {cycle_ns / 1e6:g} ms, not {float(cycle_time):g} ms")
    return int(period) or 1


def _read_number(name: str, field: str, value: object) -> Fraction:
    """A number of a DBC as its text stands there; 0 for None."""
    require(value is None or (isinstance(value, int | float) and abs(value) < _LARGEST), name, field, "a finite number")
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
