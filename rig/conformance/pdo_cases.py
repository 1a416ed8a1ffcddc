"""Chapter 4: PDOs: parameters, transmission types, COB-IDs, mapping, wrong lengths, and what a received one does."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rig.conformance.conformance_case import CaseSkipped, case, join_labels, require, require_applicable
from rig.conformance.data_sheet import Pdo, Variable, list_restricted_ends
from rig.conformance.target import (
    NO_OBJECT,
    OPERATIONAL,
    STATE,
    VALUE,
    Target,
    format_abort,
)
from rig.network.frame import Frame

INVALID, EXTENDED = 1 << 31, 1 << 29
LAST_SYNCHRONOUS = 240
TOO_SHORT = 0x8210
CANNOT_MAP, PDO_TOO_LONG = 0x06040041, 0x06040042
SETTLE = 0.1  # s: the time in which a frame that is not expected would come


@case("4.1", "communication parameters", "7.5.2.35, 7.5.2.37",
      "sub 0 is 2 or more; COB-ID and transmission type can be read")
def check_parameters(t: Target) -> str:
    """Of every PDO."""
    found = []
    for pdo in _list_pdos(t):
        highest, word, kind = (t.read(pdo.parameter, sub) for sub in (0, 1, 2))
        require(2 <= highest <= 6, f"{pdo.name}: sub 0 is {highest}")
        require(not 241 <= kind <= 251, f"{pdo.name}: transmission type {kind} is reserved")
        found.append(f"{pdo.name} {'off' if word & INVALID else f'0x{word & 0x7FF:03X}'} type {kind}")
    return join_labels(found, 8)


@case("4.2", "mapping", "7.5.2.36, 7.5.2.38", "mapped objects exist with that length; at most 64 bits")
def check_mapping(t: Target) -> str:
    """As the node itself has it, beside the EDS."""
    found = []
    for pdo in _list_pdos(t):
        bits = 0
        for index, sub, length in read_mapping(t, pdo):
            bits += length
            if 0 < index < 0x20:
                continue
            variable = t.sheet.find(index, sub)
            require(variable is not None, f"{pdo.name} maps 0x{index:04X}:{sub:X}, which the EDS does not have")
            assert variable is not None
            require(variable.bits == length, f"{pdo.name} maps {variable.label} with {length} bits")
        require(bits <= 64, f"{pdo.name} has {bits} bits")
        found.append(f"{pdo.name} {bits} bits")
    return join_labels(found, 8)


@case("4.3", "synchronous transmission", "7.2.2.2, 7.5.2.37",
      "type 1, 2 and 3: one frame at every, every second and every third SYNC, as long as its mapping")
def check_cyclic(t: Target) -> str:
    """Six SYNCs for each type that the node accepts."""
    found = []
    for pdo in _list_valid(t, is_sent=True):
        accepted = []
        for kind in (1, 2, 3):
            if not _set_type(t, pdo, kind):
                continue
            accepted.append(str(kind))
            with operational(t):
                frames = _count_answers(t, pdo, 6, expected=6 // kind)
            require(len(frames) == 6 // kind, f"{pdo.name}, type {kind}: {len(frames)} frames at 6 SYNCs")
            length = _length(t, pdo)
            wrong = [len(data) for data in frames if len(data) != length]
            require(not wrong, f"{pdo.name}: {wrong[0] if wrong else 0} bytes, the mapping has {length}")
        if accepted:
            found.append(f"{pdo.name} types {', '.join(accepted)}")
    require_applicable(found, "no TPDO accepts a synchronous type")
    return "; ".join(found)


@case("4.4", "acyclic synchronous transmission", "7.2.2.2, 7.5.2.37",
      "type 0: nothing without SYNC, at most one frame at each")
def check_acyclic(t: Target) -> str:
    """Whether there is something to send is the application's business."""
    found = []
    for pdo in _list_valid(t, is_sent=True):
        if not _set_type(t, pdo, 0):
            continue
        with operational(t):
            before = [frame for frame in t.listen(SETTLE) if frame.cob_id == _cob_id(t, pdo)]
            require(not before, f"{pdo.name}: {len(before)} frames without SYNC")
            frames = _count_answers(t, pdo, 4, expected=0)
        require(len(frames) <= 4, f"{pdo.name}: {len(frames)} frames at 4 SYNCs")
        found.append(f"{pdo.name} {len(frames)} at 4 SYNCs")
    require_applicable(found, "no TPDO accepts type 0")
    return "; ".join(found)


@case("4.5", "event timer", "7.5.2.37", "type 254 or 255 with event timer 50 ms: a frame every 50 ms", is_timed=True)
def check_event_timer(t: Target) -> str:
    """Sub 5 of the parameters, where the node has it."""
    found = []
    for pdo in _list_valid(t, is_sent=True):
        if not t.sheet.is_writable(pdo.parameter, 5) or not (_set_type(t, pdo, 255) or _set_type(t, pdo, 254)):
            continue
        if t.try_download(pdo.parameter, 5, (50).to_bytes(2, "little")):
            continue
        with operational(t):
            times = [frame.t_ns for frame in t.listen(1.0, _cob_id(t, pdo))]
        require(len(times) >= 2, f"{pdo.name}: {len(times)} frames in 1 s")
        period = (times[-1] - times[0]) * 1e-9 / (len(times) - 1)
        require(abs(period - 0.05) <= 0.005 + t.options.tolerance, f"{pdo.name}: every {1e3 * period:.1f} ms")
        found.append(f"{pdo.name} every {1e3 * period:.1f} ms")
    require_applicable(found, "no TPDO has an event timer")
    return "; ".join(found)


@case("4.6", "reserved transmission types", "7.5.2.35, 7.5.2.37", "types 241 and 251 are refused with 0x06090030")
def check_reserved_types(t: Target) -> str:
    """An unsupported type is refused as well, so only the reserved ones are tried."""
    found = []
    for pdo in _list_pdos(t):
        if not t.sheet.is_writable(pdo.parameter, 2):
            continue
        with t.restore_afterwards(t.variable(pdo.parameter, 2)):
            for kind in (241, 251):
                code = t.try_download(pdo.parameter, 2, bytes((kind,)))
                require(code == VALUE, f"{pdo.name}, type {kind}: {format_abort(code)}")
        found.append(pdo.name)
    require_applicable(found, "no transmission type can be written")
    return f"refused by {', '.join(found)}"


@case("4.7", "COB-ID of a valid PDO", "7.5.2.35, 7.5.2.37",
      "it cannot be changed: an abort, and the old one stays in force")
def check_fixed_while_valid(t: Target) -> str:
    """Bits 0 to 29 may only be changed while bit 31 says that the PDO is off."""
    found = []
    for pdo in _list_changeable(t):
        word = t.read(pdo.parameter, 1)
        free = t.find_free_identifiers(1)[0]
        with _restored_pdo(t, pdo):
            code = t.try_download(pdo.parameter, 1, (word & ~0x7FF | free).to_bytes(4, "little"))
            is_refused = code in (VALUE, STATE, 0x08000020, 0x08000021, 0x06010000)  # the standard names no code
            require(is_refused, f"{pdo.name} 0x{word & 0x7FF:03X} to 0x{free:03X}: {format_abort(code)}")
            require(t.read(pdo.parameter, 1) == word, f"{pdo.name} has changed all the same")
        found.append(f"{pdo.name} {format_abort(code)}")
    return "; ".join(found)


@case("4.8", "restricted COB-IDs", "7.3.5, table 40", "each is refused with 0x06090030, at both ends of every range")
def check_restricted(t: Target) -> str:
    """The PDO is switched off first, so that nothing else can be the reason."""
    found = []
    for pdo in _list_changeable(t):
        word = t.read(pdo.parameter, 1)
        accepted = []
        with _restored_pdo(t, pdo):
            for can_id in list_restricted_ends():
                code = t.try_download(pdo.parameter, 1, (word | INVALID).to_bytes(4, "little"))
                require(code == 0, f"{pdo.name} cannot be switched off: {format_abort(code)}")
                code = t.try_download(pdo.parameter, 1, (word & ~0x7FF & ~INVALID | can_id).to_bytes(4, "little"))
                if code != VALUE:
                    accepted.append(f"0x{can_id:03X} {format_abort(code)}")
        require(not accepted, f"{pdo.name}: {join_labels(accepted)}")
        found.append(pdo.name)
    return f"{len(list_restricted_ends())} identifiers refused by {', '.join(found)}"


@case("4.9", "29-bit COB-IDs", "7.5.2.35, 7.5.2.37", "supported, or refused with 0x06090030")
def check_extended(t: Target) -> str:
    """Bit 29 of the COB-ID."""
    found = []
    for pdo in _list_changeable(t):
        word = t.read(pdo.parameter, 1)
        with _restored_pdo(t, pdo):
            t.try_download(pdo.parameter, 1, (word | INVALID).to_bytes(4, "little"))
            code = t.try_download(pdo.parameter, 1, (INVALID | EXTENDED | 0x12345).to_bytes(4, "little"))
            require(code in (0, VALUE), f"{pdo.name}: {format_abort(code)}")
            if not code:
                kept = t.read(pdo.parameter, 1)
                require(kept & 0x3FFFFFFF == EXTENDED | 0x12345, f"{pdo.name} accepts it and holds 0x{kept:08X}")
        found.append(f"{pdo.name} {'refused' if code else 'supported'}")
    return ", ".join(found)


@case("4.10", "a TPDO is switched off and on", "7.5.2.37", "not sent while bit 31 is set; sent again afterwards")
def check_tpdo_switch(t: Target) -> str:
    """With transmission type 1, at SYNC."""
    found = []
    for pdo in _list_changeable(t, is_sent=True):
        if not _set_type(t, pdo, 1):
            continue
        word = t.read(pdo.parameter, 1)
        with operational(t), _restored_pdo(t, pdo):
            counts = []
            for value, expected in ((word, 3), (word | INVALID, 0), (word, 3)):
                t.write(pdo.parameter, 1, value)
                counts.append(len(_count_answers(t, pdo, 3, word & 0x7FF, expected)))
            require(counts == [3, 0, 3], f"{pdo.name}: at 3 SYNCs each {counts[0]} frames on, {counts[1]} off, "
                                         f"{counts[2]} on again")
        found.append(pdo.name)
    require_applicable(found, "no TPDO accepts transmission type 1")
    return f"3, 0 and 3 frames: {', '.join(found)}"


@case("4.11", "a TPDO gets another COB-ID", "7.5.2.37", "off, changed, on: it is sent under the new one only")
def check_tpdo_move(t: Target) -> str:
    """As a master links PDOs."""
    found = []
    for pdo in _list_changeable(t, is_sent=True):
        if not _set_type(t, pdo, 1):
            continue
        word, free = t.read(pdo.parameter, 1), t.find_free_identifiers(1)[0]
        with operational(t), _restored_pdo(t, pdo):
            _move(t, pdo, word, free)
            mark = len(t.frames)
            new = len(_count_answers(t, pdo, 3, free))
            old = sum(frame.cob_id == word & 0x7FF for frame in t.frames[mark:])
            require((new, old) == (3, 0), f"{pdo.name}: {new} frames under 0x{free:03X}, {old} under the old COB-ID")
        found.append(f"{pdo.name} 0x{word & 0x7FF:03X} to 0x{free:03X}")
    require_applicable(found, "no TPDO accepts transmission type 1")
    return "; ".join(found)


@case("4.12", "received PDO too short", "7.2.2.5, table 26", "EMCY 0x8210, and the values stay as they were")
def check_short_rpdo(t: Target) -> str:
    """A byte less than the mapping has."""
    _require_emcy(t)
    found = []
    for pdo in _list_valid(t, is_sent=False):
        values = read_mapped(t, pdo)
        with operational(t):
            before = read_mapped(t, pdo)
            frame = send_short(t, pdo, values)
            require(frame is not None, f"{pdo.name}: no EMCY 0x8210 after {_length(t, pdo) - 1} bytes")
            require(read_mapped(t, pdo) == before, f"{pdo.name}: values were taken over")
            _send_values(t, pdo, values)
        found.append(pdo.name)
    require_applicable(found, "no RPDO is valid")
    return f"EMCY 0x8210 for {', '.join(found)}"


@case("4.13", "received PDO too long", "7.2.2.5, table 26", "the first bytes are used or not; EMCY, if any, is 0x8220")
def check_long_rpdo(t: Target) -> str:
    """A byte more than the mapping has, where 8 bytes allow that. The values are those that are there."""
    found = []
    for pdo in _list_valid(t, is_sent=False):
        length = _length(t, pdo)
        if length > 7:
            continue
        data = b"".join(read_mapped(t, pdo))
        with operational(t):
            t.send(_cob_id(t, pdo), data + b"\0")
            codes = [int.from_bytes(frame.data[:2], "little") for frame in t.listen(SETTLE, t.emcy_id)]
        require(all(code == 0x8220 for code in codes), f"{pdo.name}: EMCY {', '.join(f'0x{c:04X}' for c in codes)}")
        found.append(f"{pdo.name} {'EMCY 0x8220' if codes else 'no EMCY'}")
    require_applicable(found, "every RPDO has 8 bytes")
    return "; ".join(found)


@case("4.14", "an RPDO is switched off, moved and on", "7.5.2.35",
      "a frame that is too short is noticed (EMCY 0x8210) only under the COB-ID in force")
def check_rpdo_move(t: Target) -> str:
    """The wrong length shows whether a frame is received, and changes nothing."""
    _require_emcy(t)
    found = []
    for pdo in _list_changeable(t, is_sent=False):
        word, free = t.read(pdo.parameter, 1), t.find_free_identifiers(1)[0]
        values = read_mapped(t, pdo)
        with operational(t), _restored_pdo(t, pdo):
            t.write(pdo.parameter, 1, word | INVALID)
            require(send_short(t, pdo, values, word & 0x7FF, False) is None, f"{pdo.name} is received while it is off")
            _move(t, pdo, word, free)
            found_old = send_short(t, pdo, values, word & 0x7FF, False)
            require(found_old is None, f"{pdo.name} is received under its old COB-ID")
            require(send_short(t, pdo, values, free) is not None, f"{pdo.name} is not received under 0x{free:03X}")
            _send_values(t, pdo, values, free)
        found.append(f"{pdo.name} 0x{word & 0x7FF:03X} to 0x{free:03X}")
    return "; ".join(found)


@case("4.15", "values of a received PDO", "7.2.2.2, 7.5.2.35",
      "type 0 to 240: in the dictionary after the next SYNC, not before; 254 and 255: at once")
def check_rpdo_values(t: Target) -> str:
    """Each number changes in its lowest bit, and is set back. Only with --write."""
    if not t.options.may_write:
        raise CaseSkipped("values are changed only with --write")
    found = []
    for pdo in _list_valid(t, is_sent=False):
        mapped = [t.sheet.find(index, sub) for index, sub, _ in read_mapping(t, pdo)]
        if any(variable is None or not variable.is_readable for variable in mapped):
            continue
        is_synchronous = t.read(pdo.parameter, 2) <= LAST_SYNCHRONOUS
        with operational(t):
            before = read_mapped(t, pdo)
            other = [_flip(variable, data) for variable, data in zip(mapped, before, strict=True) if variable]
            t.send(_cob_id(t, pdo), b"".join(other))
            if is_synchronous:
                t.wait(SETTLE / 2)
                require(read_mapped(t, pdo) == before, f"{pdo.name}: the values are there before SYNC")
                t.sync()
            arrived = _wait_for_values(t, pdo, other)
            _send_values(t, pdo, before)
            require(arrived, f"{pdo.name}: the values are not in the dictionary")
            require(_wait_for_values(t, pdo, before), f"{pdo.name}: a second frame has no effect")
        found.append(f"{pdo.name} {'at SYNC' if is_synchronous else 'at once'}")
    require_applicable(found, "no valid RPDO maps readable objects alone")
    return "; ".join(found)


@case("4.16", "values of a transmitted PDO", "7.2.2, 7.5.2.38",
      "the mapped objects in their order, least significant byte first")
def check_tpdo_values(t: Target) -> str:
    """Five SYNCs; after each frame SDO reads the objects twice, and values that move meanwhile are left out.

    Three of five must agree: an application may change a value between its PDO and the reading.
    """
    found, rounds = [], 5
    for pdo in _list_valid(t, is_sent=True):
        if not _set_type(t, pdo, 1):
            continue
        mapping, cob_id = read_mapping(t, pdo), _cob_id(t, pdo)
        differences = []
        with operational(t):
            for _ in range(rounds):
                t.sync()
                frame = t.wait_for(cob_id, t.options.timeout)
                require(frame is not None, f"{pdo.name}: no frame at a SYNC")
                assert frame is not None
                first, second = read_mapped(t, pdo), read_mapped(t, pdo)
                differences.append(_compare_values(mapping, frame.data, first, second))
        wrong = [each for each in differences if each]
        require(len(wrong) <= rounds // 2, f"{pdo.name}: {wrong[-1] if wrong else ''}")
        found.append(f"{pdo.name} {rounds - len(wrong)} of {rounds}")
    require_applicable(found, "no TPDO accepts transmission type 1")
    return ", ".join(found)


@case("4.17", "changes of the mapping", "7.5.2.36, 7.5.2.38",
      "refused while the PDO is valid; so are unknown objects, those that cannot be mapped, more than 64 bits")
def check_mapping_rules(t: Target) -> str:
    """Where the mapping can be changed at all."""
    found = []
    for pdo in _list_changeable(t):
        if not (t.sheet.is_writable(pdo.mapping, 0) and t.sheet.is_writable(pdo.mapping, 1)):
            continue
        mapping, word, first = read_mapping(t, pdo), t.read(pdo.parameter, 1), t.read(pdo.mapping, 1)
        code = t.try_download(pdo.mapping, 0, b"\0")
        require(code != 0, f"{pdo.name}: the number of mapped objects was changed while the PDO is valid")
        with _restored_pdo(t, pdo):
            t.write(pdo.parameter, 1, word | INVALID)
            t.write(pdo.mapping, 0, 0)
            try:
                offers = ((0xFFFF0020, (NO_OBJECT, CANNOT_MAP), "an unknown object"),
                          (0x10180120, (CANNOT_MAP,), "the vendor-ID"))
                for entry, codes, what in offers:
                    code = t.try_download(pdo.mapping, 1, entry.to_bytes(4, "little"))
                    code = code or t.try_download(pdo.mapping, 0, b"\1")
                    require(code in codes, f"{pdo.name}, {what}: {format_abort(code)}")
                    t.try_download(pdo.mapping, 0, b"\0")
                copies = 64 // (first & 0xFF) + 1
                if t.sheet.find(pdo.mapping, copies) is not None:
                    codes_seen = [t.try_download(pdo.mapping, sub, first.to_bytes(4, "little"))
                                  for sub in range(1, copies + 1)]
                    codes_seen.append(t.try_download(pdo.mapping, 0, bytes((copies,))))
                    require(PDO_TOO_LONG in codes_seen, f"{pdo.name}, more than 64 bits: accepted")
            finally:
                t.try_download(pdo.mapping, 0, b"\0")
                for sub, (index, mapped_sub, bits) in enumerate(mapping, 1):
                    t.try_download(pdo.mapping, sub, (index << 16 | mapped_sub << 8 | bits).to_bytes(4, "little"))
                t.try_download(pdo.mapping, 0, bytes((len(mapping),)))
        found.append(pdo.name)
    require_applicable(found, "the mappings are constant")
    return ", ".join(found)


@contextmanager
def operational(t: Target) -> Iterator[None]:
    """Within, the node is OPERATIONAL; afterwards PRE-OPERATIONAL. Raises CaseFailed if it does not follow."""
    if t.fixed_heartbeat is None:
        t.beat()
    t.enter(OPERATIONAL)
    try:
        yield
    finally:
        t.command(128)
        t.wait(0.01)


def read_mapping(t: Target, pdo: Pdo) -> list[tuple[int, int, int]]:
    """What the node maps: (index, sub, bits) each. Raises Refusal, CaseFailed."""
    words = [t.read(pdo.mapping, sub) for sub in range(1, t.read(pdo.mapping, 0) + 1)]
    return [(word >> 16, word >> 8 & 0xFF, word & 0xFF) for word in words]


def read_mapped(t: Target, pdo: Pdo) -> list[bytes]:
    """What the mapped objects hold; zeros for what cannot be read. Raises Refusal, CaseFailed."""
    values = []
    for index, sub, bits in read_mapping(t, pdo):
        variable = t.sheet.find(index, sub)
        is_readable = variable is not None and variable.is_readable
        values.append(t.upload(index, sub) if is_readable else bytes(bits // 8))
    return values


def send_short(t: Target, pdo: Pdo, values: list[bytes], cob_id: int | None = None,
               is_expected: bool = True) -> Frame | None:
    """Send an RPDO without its last byte; the EMCY 0x8210 that comes, None if none does.

    An expected one is waited for longer than one that should not come.
    """
    t.send(_cob_id(t, pdo) if cob_id is None else cob_id, b"".join(values)[:-1])
    found = t.wait_for_error(SETTLE, TOO_SHORT)
    if found is None:  # some nodes look at a synchronous one only at SYNC
        t.sync()
        found = t.wait_for_error(t.options.timeout if is_expected else SETTLE, TOO_SHORT)
    return found


def have_all_come(t: Target, mark: int, ids: set[int]) -> bool:
    """Whether a frame of each of these COB-IDs is among those since `mark`."""
    return {frame.cob_id for frame in t.frames[mark:]} >= ids


def _list_pdos(t: Target) -> list[Pdo]:
    """All PDOs of the EDS. Raises CaseNotApplicable if it has none."""
    require_applicable(t.sheet.pdos, "the EDS has no PDO")
    return t.sheet.pdos


def _list_valid(t: Target, is_sent: bool) -> list[Pdo]:
    """The PDOs of one direction that are on and map something."""
    return [pdo for pdo in _list_pdos(t) if pdo.is_sent is is_sent
            and not t.read(pdo.parameter, 1) & INVALID and t.read(pdo.mapping, 0)]


def _list_changeable(t: Target, is_sent: bool | None = None) -> list[Pdo]:
    """Those whose COB-ID can be written. Raises CaseNotApplicable if there is none."""
    chosen = [pdo for direction in (False, True) if is_sent in (None, direction) for pdo in _list_valid(t, direction)
              if t.sheet.is_writable(pdo.parameter, 1)]
    require_applicable(chosen, "no COB-ID of a PDO can be written")
    return chosen


def _require_emcy(t: Target) -> None:
    require_applicable(t.sheet.find(0x1014), "the node sends no EMCY (no 0x1014)")


def _cob_id(t: Target, pdo: Pdo) -> int:
    return t.read(pdo.parameter, 1) & 0x7FF


def _length(t: Target, pdo: Pdo) -> int:
    """Bytes of its mapping."""
    return (sum(bits for _, _, bits in read_mapping(t, pdo)) + 7) // 8


def _set_type(t: Target, pdo: Pdo, kind: int) -> bool:
    """Give a PDO a transmission type; whether the node has it now."""
    if t.read(pdo.parameter, 2) == kind:
        return True
    return t.sheet.is_writable(pdo.parameter, 2) and not t.try_download(pdo.parameter, 2, bytes((kind,)))


def _count_answers(t: Target, pdo: Pdo, syncs: int, cob_id: int | None = None,
                   expected: int | None = None) -> list[bytes]:
    """Send so many SYNCs, 20 ms apart; the data of the PDO's frames until shortly after the last.

    As many as are `expected` (default: one at each SYNC) are waited for longer.
    """
    cob_id = _cob_id(t, pdo) if cob_id is None else cob_id
    mark = len(t.frames)

    def find() -> list[bytes]:
        return [frame.data for frame in t.frames[mark:] if frame.cob_id == cob_id]

    for _ in range(syncs):
        t.sync()
        t.wait(0.02)
    t.wait(t.options.timeout, lambda: len(find()) >= (syncs if expected is None else expected))
    t.wait(SETTLE)
    return find()


@contextmanager
def _restored_pdo(t: Target, pdo: Pdo) -> Iterator[None]:
    """Whatever happens within, give the PDO its COB-ID back, by way of "off". Raises CaseFailed."""
    word = t.read(pdo.parameter, 1)
    try:
        yield
    finally:
        if t.read(pdo.parameter, 1) != word:
            t.try_download(pdo.parameter, 1, (word | INVALID).to_bytes(4, "little"))
            t.try_download(pdo.parameter, 1, word.to_bytes(4, "little"))


def _move(t: Target, pdo: Pdo, word: int, can_id: int) -> None:
    """Off, another identifier, on. Raises Refusal."""
    t.write(pdo.parameter, 1, word | INVALID)
    t.write(pdo.parameter, 1, word & ~0x7FF | INVALID | can_id)
    t.write(pdo.parameter, 1, word & ~0x7FF & ~INVALID | can_id)


def _compare_values(mapping: list[tuple[int, int, int]], data: bytes, first: list[bytes], second: list[bytes]) -> str:
    """The first object that a PDO carries otherwise than two equal readings have it; empty if there is none."""
    at = 0
    for (index, sub, _), before, after in zip(mapping, first, second, strict=True):
        sent = data[at:at + len(before)]
        at += len(before)
        if before == after != sent:
            return f"0x{index:04X}:{sub:X} was sent as {sent.hex()}, SDO reads {before.hex()}"
    return ""


def _send_values(t: Target, pdo: Pdo, values: list[bytes], cob_id: int | None = None) -> None:
    """Send an RPDO, and a SYNC if it waits for one."""
    t.send(_cob_id(t, pdo) if cob_id is None else cob_id, b"".join(values))
    t.wait(0.005)
    if t.read(pdo.parameter, 2) <= LAST_SYNCHRONOUS:
        t.sync()
        t.wait(0.005)


def _wait_for_values(t: Target, pdo: Pdo, values: list[bytes]) -> bool:
    """Whether the mapped objects hold these values soon."""
    end = t.now() + round(t.options.timeout * 1e9)
    while True:
        if read_mapped(t, pdo) == values:
            return True
        if t.now() >= end:
            return False
        t.wait(0.01)


def _flip(variable: Variable, data: bytes) -> bytes:
    """Another value of the same length: the lowest bit changed."""
    other = bytes((data[0] ^ 1,)) + data[1:]
    value = variable.decode(other) if variable.is_number else 0
    is_inside = (variable.low is None or value >= variable.low) and (variable.high is None or value <= variable.high)
    return other if is_inside else data
