"""What an EDS or DBC says of a device's frames, what a bench file says each value is for, and both together as frames.
"""

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from plant import InputError, Place, fit_unit, list_choices
from rig.benches.bench import Field, FrameSpec, Kind, Protection, Role, encode_float, list_bits

PHASES = ("setup", "main", "cleanup", "safe")
_PLAIN = {"": Fraction(1), "-": Fraction(1), "1": Fraction(1), "%": Fraction(1, 100)}  # units of a plain number
_SMALLEST, _LARGEST = 1e-30, 1e30  # what a count may be worth: floats can calculate with it
_MOST_COUNTS = 1e300


@dataclass(frozen=True, kw_only=True)
class Use:
    """What a value of the device is for, as the bench file says."""

    place: Place  # in the bench file
    is_received: bool | None  # by the device; None: it is protection, in any frame
    signal: str = ""  # of the bench
    unit: str = ""  # of the signal, SI
    is_needed: bool = False  # a cycle cannot go on without it: what drives the plant, or is measured of it
    count: Fraction | None = None  # what a count is worth, if the file says so
    offset: Fraction | None = None
    values: Mapping[str, float | str] = field(default_factory=dict)  # by phase; a state that is awaited: in "main"
    protection: Protection = Protection.NONE
    checksum: str = ""
    data_id: int = 0
    data_ids: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Slot:
    """A value in a frame of the device: physical value = scale * counts + offset, in `unit`."""

    name: str  # "0x2100", "Demand.Position"
    bits: Field  # where it lies and how it is read
    scale: Fraction = Fraction(1)
    offset: Fraction = Fraction(0)
    unit: str | None = None  # None: the file cannot say
    start: float = 0  # counts, while the bench file gives no value
    choices: Mapping[str, int] = field(default_factory=dict)  # names of counts
    is_selector: bool = False


@dataclass(frozen=True, kw_only=True)
class DeviceFrame:
    """A frame of the device as its EDS or DBC describes it: what a bench needs but its fields, and where values lie."""

    spec: FrameSpec
    slots: tuple[Slot, ...]

    @property
    def is_received(self) -> bool:
        """By the device."""
        return self.spec.sender is Role.RIG


@contextmanager
def use_reader(library: str, name: str, expected: str) -> Iterator[None]:
    """Within, a library reads the file `name` without logging; what it stumbles over there becomes an InputError.

    `expected`: what the file should have been, with {} for what the library says.
    """
    log = logging.getLogger(library)
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    except Exception as error:  # of any kind
        message = " ".join(str(error).split())[:200]
        raise InputError(name, "", expected.format(message or type(error).__name__)) from error
    finally:
        log.setLevel(level)


def build_fields(frame: DeviceFrame, uses: Mapping[str, Use]) -> tuple[Field, ...]:
    """The fields of a frame; what the bench file does not use is filled with the value that the device starts with.

    Raises:
        InputError: a used value that lies outside the frame or overlaps another one, has a length that its type cannot
            have, or whose counts have no known worth; a second counter or checksum.
    """
    owners: dict[int, str] = {}
    protections: dict[Protection, str] = {}
    fields = []
    for slot in sorted(frame.slots, key=lambda slot: slot.name not in uses and not slot.is_selector):
        use, length = uses.get(slot.name), slot.bits.length
        places = list_bits(slot.bits) if length <= 64 else []
        other = next((owners[place] for place in places if place in owners), "")
        is_inside = bool(places) and min(places) >= 0 and max(places) < 8 * frame.spec.length
        if use is not None:
            use.place.require(length <= 64 and (slot.bits.kind is not Kind.FLOAT or length in (32, 64)),
                              f"at most 64 bits, and 32 or 64 for a floating point number; {slot.name} has "
                              f"{length}")
            use.place.require(is_inside, f"a signal inside its frame; {slot.name} lies outside the {frame.spec.length} "
                              f"bytes of {frame.spec.name}")
            use.place.require(not other, f"signals that do not overlap; {slot.name} has bits of {other}")
        if is_inside and not other:
            owners |= dict.fromkeys(places, slot.name)
            fields.append(_build_field(slot, use))
        if use is not None and use.protection is not Protection.NONE:
            use.place.require(use.protection not in protections, f"one {use.protection.name.lower()} in a frame; "
                              f"{frame.spec.name} has {protections.get(use.protection)}")
            protections[use.protection] = slot.name
    if any(each.checksum == "e2e_profile_1" for each in fields):  # its counter never is 15 (AUTOSAR PRS E2E)
        fields = [replace(each, wrap=min(each.modulus, 15)) if each.protection is Protection.COUNTER else each
                  for each in fields]
    return tuple(sorted(fields, key=lambda each: min(list_bits(each))))


def _build_field(slot: Slot, use: Use | None) -> Field:
    if use is None:
        start = encode_float(slot.start, slot.bits.length) if slot.bits.kind is Kind.FLOAT else int(slot.start)
        return replace(slot.bits, name=slot.name if slot.is_selector else "", wrap=None,
                       fixed=start & (1 << slot.bits.length) - 1)
    if use.protection is not Protection.NONE:
        use.place.require(slot.bits.kind is not Kind.FLOAT,
                          f"a whole number to protect the frame with; {slot.name} is floating point")
        if use.protection is Protection.COUNTER:
            use.place.require(slot.bits.length <= 32,
                              f"a counter of at most 32 bits; {slot.name} has {slot.bits.length}")
            return replace(slot.bits, name=slot.name, protection=use.protection)
        use.place.require("#" in use.checksum or (slot.bits.length == 8 and slot.bits.lowest % 8 == 0),
                          f"a byte for {use.checksum}; {slot.name} has {slot.bits.length} bits from bit "
                          f"{slot.bits.lowest} on")
        return replace(slot.bits, name=slot.name, protection=use.protection, wrap=None, checksum=use.checksum,
                       data_id=use.data_id, data_ids=use.data_ids)
    if not use.signal:
        return replace(slot.bits, name=slot.name, wrap=None)
    count, offset = _find_worth(slot, use)
    use.place.require(_SMALLEST <= abs(count) <= _LARGEST and abs(offset) <= _LARGEST,
                      "counts that are worth something, from 1e-30 to 1e30")
    return replace(slot.bits, name=use.signal, wrap=None, count=count, offset=offset)


def _find_worth(slot: Slot, use: Use) -> tuple[Fraction, Fraction]:
    """What a count of a signal is worth, and its offset, SI."""
    if use.count is not None:
        offset = slot.offset / slot.scale * use.count if slot.scale else Fraction(0)
        return use.count, offset if use.offset is None else use.offset
    if use.unit:
        unit = fit_unit(slot.unit or "", use.unit)
        factor = unit.factor if unit else None
    else:
        factor = _PLAIN.get(slot.unit or "")
    if factor is None:
        reason = "its file gives it no unit" if not slot.unit else f"its unit is {slot.unit!r}"
        worth = f"such as count = '1 {use.unit}'" if use.unit else "as a number"
        raise use.place.refuse(f"also what a count of {slot.name} is worth, {worth}; {reason}")
    return slot.scale * factor, slot.offset * factor if use.offset is None else use.offset


def compute_counts(slot: Slot, value: float | str, place: Place) -> float:
    """The counts of a physical value, or of its name.

    Raises:
        InputError: an unknown name, or a value that the signal cannot hold.
    """
    if isinstance(value, str):
        place.require(value in slot.choices,
                      f"a number{' or ' if slot.choices else ''}{list_choices(None, slot.choices)}, not {value!r}")
        return slot.choices[value]
    counts = (Fraction(str(value)) - slot.offset) / slot.scale if slot.scale else Fraction(0)
    place.require(abs(counts) <= _MOST_COUNTS, f"a value of at most {_MOST_COUNTS:g} counts, not {value:g}")
    low, high = slot.bits.range
    if slot.bits.kind is Kind.FLOAT:
        return float(counts)
    place.require(counts.denominator == 1 or math.isclose(counts, round(counts), rel_tol=1e-9),
                  f"a multiple of {float(slot.scale):g}, the step of {slot.name}, not {value:g}")
    if not low <= round(counts) <= high:
        ends = sorted(float(slot.scale * end + slot.offset) for end in (low, high))
        raise place.refuse(f"{slot.name} from {ends[0]:g} to {ends[1]:g}, not {value:g}")
    return round(counts)


def list_phases(slot: Slot, use: Use) -> dict[str, Any]:
    """The counts of a value in each phase; in the safe state as in clean-up, else as the device starts."""
    counts = {phase: compute_counts(slot, value, use.place.at(phase)) for phase, value in use.values.items()}
    return dict.fromkeys(PHASES, slot.start) | {"safe": counts.get("cleanup", slot.start)} | counts
