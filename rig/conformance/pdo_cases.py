"""Chapter 4: PDOs: parameters, transmission types, COB-IDs, mapping, wrong lengths, and what a received one does."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from rig.benches import INVALID, LAST_SYNCHRONOUS, Pdo
from rig.conformance.target import (
    CANNOT_MAP,
    COMMANDS,
    NO_OBJECT,
    OPERATIONAL,
    PDO_TOO_LONG,
    PRE_OPERATIONAL,
    RESTRICTED_ENDS,
    STATE,
    VALUE,
    Case,
    CaseSkipped,
    Problem,
    Target,
    for_each,
    format_abort,
    join_labels,
    read_error_code,
    require,
    require_abort,
    require_applicable,
)
from rig.network import Frame

EXTENDED, PRODUCER = 1 << 29, 1 << 30  # in a COB-ID: 29 bits; in that of SYNC: the node sends it
TOO_SHORT, TOO_LONG = 0x8210, 0x8220  # error codes
SETTLE = 0.1  # s: the time in which a frame that is not expected would come


def check_parameters(t: Target, pdo: Pdo) -> str:
    """COB-ID and transmission type of a PDO."""
    highest, word, kind = (t.read(pdo.parameter, sub) for sub in (0, 1, 2))
    require(2 <= highest <= 6, f"{pdo.name}: sub 0 is {highest}")
    require(not LAST_SYNCHRONOUS < kind <= 251, f"{pdo.name}: transmission type {kind} is reserved")
    return f"{pdo.name} {'off' if word & INVALID else f'0x{word & 0x7FF:03X}'} type {kind}"


def describe_mapping(t: Target, pdo: Pdo, words: Sequence[int]) -> str:
    """The length of a mapping. Raises Problem for objects that the EDS does not have, or with another length."""
    for index, sub, bits in map(split_entry, words):
        if 0 < index < 0x20:  # a dummy entry
            continue
        name, variable = f"{pdo.name} maps 0x{index:04X}:{sub:X}", t.sheet.find(index, sub)
        if variable is None:
            raise Problem(f"{name}, which is not there")
        require(variable.bits == bits, f"{name} with {bits} bits, it has {variable.bits}")
    total = sum(split_entry(word)[2] for word in words)
    require(total <= 64, f"{pdo.name} has {total} bits")
    return f"{pdo.name} {total} bits"


def check_cyclic(t: Target, pdo: Pdo) -> str:
    """Six SYNCs for each type that the node accepts."""
    types = []
    for kind in (1, 2, 3):
        if not set_type(t, pdo, kind):
            continue
        types.append(str(kind))
        with operational(t):
            frames = answer_syncs(t, identify(t, pdo), 6, expected_count=6 // kind)
        require(len(frames) == 6 // kind, f"{pdo.name}, type {kind}: frames at 6 SYNCs: {len(frames)}")
        wrong = [len(frame.data) for frame in frames if len(frame.data) != count_bytes(t, pdo)]
        require(not wrong, f"{pdo.name}: {wrong[:1]} bytes, the mapping has {count_bytes(t, pdo)}")
    require_applicable(types, "no TPDO accepts a synchronous type")
    return f"{pdo.name} types {', '.join(types)}"


def check_acyclic(t: Target, pdo: Pdo) -> str:
    """Whether there is something to send is the application's business."""
    require_type(t, pdo, 0)
    with operational(t):
        before = t.listen(SETTLE, identify(t, pdo))
        require(not before, f"{pdo.name}: frames without SYNC: {len(before)}")
        frames = answer_syncs(t, identify(t, pdo), 4, expected_count=0)
    require(len(frames) <= 4, f"{pdo.name}: {len(frames)} frames at 4 SYNCs")
    return f"{pdo.name} {len(frames)} at 4 SYNCs"


def check_event_timer(t: Target, pdo: Pdo) -> str:
    """Sub 5 of the parameters, where the node has it."""
    require_applicable(t.sheet.is_writable(pdo.parameter, 5), "no TPDO has an event timer")
    require_type(t, pdo, 255, 254)
    require_applicable(t.try_download(pdo.parameter, 5, 50) == 0, "no TPDO has an event timer")
    with operational(t):
        times = [frame.t_ns for frame in t.listen(1.0, identify(t, pdo))]
    require(len(times) >= 2, f"{pdo.name}: frames in 1 s: {len(times)}")
    period = (times[-1] - times[0]) * 1e-9 / (len(times) - 1)
    text = f"every {1e3 * period:.1f} ms"
    require(abs(period - 0.05) <= 0.005 + t.options.tolerance, f"{pdo.name}: {text}")
    return f"{pdo.name} {text}"


def check_reserved_types(t: Target, pdo: Pdo) -> str:
    """An unsupported type is refused as well, so only the reserved ones are tried."""
    require_applicable(t.sheet.is_writable(pdo.parameter, 2), "no transmission type can be written")
    with t.restore_afterwards((pdo.parameter, 2)):
        for kind in (241, 251):
            require_abort(t.try_download(pdo.parameter, 2, kind), (VALUE,), f"{pdo.name}, type {kind}")
    return pdo.name


def check_restricted(t: Target, pdo: Pdo) -> str:
    """The PDO is switched off first, so that nothing else can be the reason."""
    require_unrestricted(t, (pdo.parameter, 1))
    return pdo.name


def check_extended(t: Target, pdo: Pdo) -> str:
    """Bit 29 of the COB-ID."""
    word, wide = t.read(pdo.parameter, 1), EXTENDED | 0x12345
    with t.restore_afterwards((pdo.parameter, 1)):
        t.try_download(pdo.parameter, 1, word | INVALID)
        code = t.try_download(pdo.parameter, 1, INVALID | wide)
        require_abort(code, (0, VALUE), pdo.name)
        new_word = t.read(pdo.parameter, 1)
        require(code or new_word & 0x3FFFFFFF == wide, f"{pdo.name} accepts it and holds 0x{new_word:08X}")
    return f"{pdo.name} {'refused' if code else 'supported'}"


def check_switching(t: Target, pdo: Pdo, phases: Sequence[tuple[str, str, bool]]) -> str:
    """A PDO is on, off or moved to another COB-ID, and works under the old and the new one as a phase says."""
    if pdo.is_received:
        require_emcy(t)
    else:
        require_type(t, pdo, 1)
    word, free, values = t.read(pdo.parameter, 1), t.find_free_identifier(), read_mapped(t, pdo)
    cob_ids = {"old": word & 0x7FF, "new": free}
    new_word = word & ~0x7FF | free
    words = {"on": (word,), "off": (word | INVALID,), "moved": (word | INVALID, new_word | INVALID, new_word)}
    with operational(t), t.restore_afterwards((pdo.parameter, 1)):
        for action, name, is_expected in phases:
            for value in words[action]:
                t.write(pdo.parameter, 1, value)
            require(works_as(t, pdo, values, cob_ids[name], is_expected),
                    f"{pdo.name} is {action}, its {name} COB-ID is {'not used' if is_expected else 'used'}")
        if pdo.is_received:
            send_values(t, pdo, values)
    return f"{pdo.name} " + ", ".join(f"{action} 0x{cob_ids[name]:03X} {'used' if is_expected else 'silent'}"
                                      for action, name, is_expected in phases)


def works_as(t: Target, pdo: Pdo, values: list[bytes], cob_id: int, is_expected: bool) -> bool:
    """Whether a TPDO comes at 3 SYNCs, or an RPDO that is too short is noticed, if and only if it is expected.

    The wrong length changes nothing.
    """
    return (bool(send_short(t, pdo, values, cob_id, is_expected)) is is_expected if pdo.is_received else
            len(answer_syncs(t, cob_id, 3, 3 * is_expected)) == 3 * is_expected)


def check_short_rpdo(t: Target, pdo: Pdo) -> str:
    """A byte less than the mapping has."""
    require_emcy(t)
    values = read_mapped(t, pdo)
    with operational(t):
        before = read_mapped(t, pdo)
        require(send_short(t, pdo, values), f"{pdo.name}: no EMCY 0x8210 after {count_bytes(t, pdo) - 1} bytes")
        require(read_mapped(t, pdo) == before, f"{pdo.name}: values were taken over")
        send_values(t, pdo, values)
    return pdo.name


def check_long_rpdo(t: Target, pdo: Pdo) -> str:
    """A byte more than the mapping has, where 8 bytes allow that. The values are those that are there."""
    require_applicable(count_bytes(t, pdo) <= 7, "every RPDO has 8 bytes")
    data = b"".join(read_mapped(t, pdo))
    with operational(t):
        t.send(identify(t, pdo), data + b"\0")
        codes = {read_error_code(frame) for frame in t.listen(SETTLE, t.emcy_id)}
    require(codes <= {TOO_LONG}, f"{pdo.name}: EMCY {', '.join(f'0x{code:04X}' for code in codes)}")
    return f"{pdo.name} {'EMCY 0x8220' if codes else 'no EMCY'}"


def check_rpdo_values(t: Target, pdo: Pdo) -> str:
    """Each number changes by the smallest step, and is set back. Only with --write."""
    require(t.options.may_write, "values are changed only with --write", CaseSkipped)
    variables = [t.sheet.find(*split_entry(word)[:2]) for word in read_mapping(t, pdo)]
    readable = [variable for variable in variables if variable is not None and variable.is_readable]
    require_applicable(len(readable) == len(variables), "no valid RPDO maps readable objects alone")
    is_synchronous = t.read(pdo.parameter, 2) <= LAST_SYNCHRONOUS
    with operational(t):
        before = read_mapped(t, pdo)
        new_values = [variable.change(data) for variable, data in zip(readable, before, strict=True)]
        t.send(identify(t, pdo), b"".join(new_values))
        if is_synchronous:
            t.wait(SETTLE / 2)
            require(read_mapped(t, pdo) == before, f"{pdo.name}: the values are there before SYNC")
            t.sync()
        has_arrived = wait_for_values(t, pdo, new_values)
        send_values(t, pdo, before)
        require(has_arrived, f"{pdo.name}: the values are not in the dictionary")
        require(wait_for_values(t, pdo, before), f"{pdo.name}: a second frame has no effect")
    return f"{pdo.name} {'at SYNC' if is_synchronous else 'at once'}"


def check_tpdo_values(t: Target, pdo: Pdo) -> str:
    """Five SYNCs; after each frame SDO reads the objects twice, and values that move meanwhile are left out.

    Three of five must agree: an application may change a value between its PDO and the reading.
    """
    require_type(t, pdo, 1)
    mapping, cob_id = read_mapping(t, pdo), identify(t, pdo)
    wrong: list[str] = []
    with operational(t):
        for _ in range(5):
            t.sync()
            frames = t.wait_for(cob_id, t.options.timeout)
            require(frames, f"{pdo.name}: no frame at a SYNC")
            at, differences = 0, []
            for word, first, second in zip(mapping, read_mapped(t, pdo), read_mapped(t, pdo), strict=True):
                frame_bytes = frames[0].data[at:at + len(first)]
                at += len(first)
                if first == second != frame_bytes:
                    label = f"0x{word >> 16:04X}:{word >> 8 & 0xFF:X}"
                    differences.append(f"{label} was sent as {frame_bytes.hex()}, SDO reads {first.hex()}")
            wrong += differences[:1]
    require(len(wrong) <= 2, f"{pdo.name}: {join_labels(wrong, 1)}")
    return f"{pdo.name} {5 - len(wrong)} of 5"


def check_mapping_rules(t: Target, pdo: Pdo) -> str:
    """Where the mapping can be changed at all."""
    is_free = t.sheet.is_writable(pdo.mapping, 0) and t.sheet.is_writable(pdo.mapping, 1)
    require_applicable(is_free, "the mappings are constant")
    words = read_mapping(t, pdo)
    copies = 64 // max(1, words[0] & 0xFF) + 1
    require(t.try_download(pdo.mapping, 0, 0),
            f"{pdo.name}: the number of mapped objects was changed while the PDO is valid")
    with t.restore_afterwards((pdo.parameter, 1)):
        t.write(pdo.parameter, 1, t.read(pdo.parameter, 1) | INVALID)
        try:
            for entry, codes, what in ((0xFFFF0020, (NO_OBJECT, CANNOT_MAP), "an unknown object"),
                                       (0x10180120, (CANNOT_MAP,), "the vendor-ID")):
                require_abort(next(iter(write_mapping(t, pdo, [entry])), 0), codes, f"{pdo.name}, {what}")
            if t.sheet.find(pdo.mapping, copies) is not None:
                abort_codes = write_mapping(t, pdo, [words[0]] * copies)
                require(PDO_TOO_LONG in abort_codes, f"{pdo.name}, more than 64 bits: accepted")
        finally:
            write_mapping(t, pdo, words)
    return pdo.name


@contextmanager
def operational(t: Target) -> Iterator[None]:
    """Within, the node is OPERATIONAL; afterwards PRE-OPERATIONAL. Raises Problem if it does not follow."""
    if t.fixed_heartbeat is None:
        t.beat()
    t.enter(OPERATIONAL)
    try:
        yield
    finally:
        t.command(COMMANDS[PRE_OPERATIONAL])
        t.wait(0.01)


def split_entry(word: int) -> tuple[int, int, int]:
    """Index, sub-index and bits of a mapped object."""
    return word >> 16, word >> 8 & 0xFF, word & 0xFF


def read_mapping(t: Target, pdo: Pdo) -> list[int]:
    """What the node maps, a word each. Raises Refusal, Problem."""
    return [t.read(pdo.mapping, sub) for sub in range(1, t.read(pdo.mapping, 0) + 1)]


def write_mapping(t: Target, pdo: Pdo, words: Sequence[int]) -> list[int]:
    """Write the mapping of a PDO that is off; the abort codes that came."""
    writes = [(0, 0), *enumerate(words, 1), (0, len(words))]
    codes = [t.try_download(pdo.mapping, sub, value.to_bytes(4 if sub else 1, "little")) for sub, value in writes]
    return [code for code in codes if code]


def read_mapped(t: Target, pdo: Pdo) -> list[bytes]:
    """What the mapped objects hold; zeros for what cannot be read. Raises Refusal, Problem."""
    entries = [(t.sheet.find(index, sub), bits) for index, sub, bits in map(split_entry, read_mapping(t, pdo))]
    return [t.upload(*variable.key) if variable is not None and variable.is_readable else bytes(bits // 8)
            for variable, bits in entries]


def send_values(t: Target, pdo: Pdo, values: list[bytes]) -> None:
    """Send an RPDO, and a SYNC if it waits for one."""
    t.send(identify(t, pdo), b"".join(values))
    t.wait(0.005)
    if t.read(pdo.parameter, 2) <= LAST_SYNCHRONOUS:
        t.sync(1, 0.005)


def send_short(t: Target, pdo: Pdo, values: list[bytes], cob_id: int | None = None,
               is_expected: bool = True) -> list[Frame]:
    """Send an RPDO without its last byte; the EMCY 0x8210 that comes, none if it does not.

    An expected one is waited for longer than one that should not come.
    """
    t.send(identify(t, pdo) if cob_id is None else cob_id, b"".join(values)[:-1])
    frames = t.wait_for_error(SETTLE, TOO_SHORT)
    if not frames:  # some nodes look at a synchronous one only at SYNC
        t.sync()
        frames = t.wait_for_error(t.options.timeout if is_expected else SETTLE, TOO_SHORT)
    return frames


def wait_for_values(t: Target, pdo: Pdo, values: list[bytes]) -> bool:
    """Whether the mapped objects hold these values soon."""
    end = t.now() + round(t.options.timeout * 1e9)
    while read_mapped(t, pdo) != values:
        if t.now() >= end:
            return False
        t.wait(0.01)
    return True


def answer_syncs(t: Target, cob_id: int, count: int, expected_count: int) -> list[Frame]:
    """Send SYNCs, 20 ms apart; the frames of that COB-ID until shortly after the last.

    As many as are expected are waited for longer.
    """
    mark = len(t.frames)
    t.sync(count, 0.02)
    t.wait(t.options.timeout, lambda: len(t.heard(mark, cob_id)) >= expected_count)
    t.wait(SETTLE)
    return t.heard(mark, cob_id)


def list_valid(t: Target, is_received: bool | None = None, is_changeable: bool = False) -> list[Pdo]:
    """The PDOs, of one direction or both, that are on and map something, with a COB-ID that can be written if need be.

    Raises CaseNotApplicable if there is none.
    """
    pdos = [pdo for pdo in t.sheet.pdos if is_received in (None, pdo.is_received)
            and not t.read(pdo.parameter, 1) & INVALID and t.read(pdo.mapping, 0)
            and (not is_changeable or t.sheet.is_writable(pdo.parameter, 1))]
    require_applicable(pdos, f"no such PDO is valid{' and can get another COB-ID' if is_changeable else ''}")
    return pdos


def require_fixed(t: Target, key: tuple[int, int]) -> str:
    """The abort with which a COB-ID that is in use refuses another one. The standard names no code."""
    word, free = t.read(*key), t.find_free_identifier()
    with t.restore_afterwards(key):
        code = t.try_download(*key, word & ~0x7FF | free)
        text = f"{t.variable(*key).label} 0x{word & 0x7FF:03X} to 0x{free:03X}"
        abort = require_abort(code, (VALUE, STATE, 0x08000020, 0x08000021, 0x06010000), text)
        require(t.read(*key) == word, f"{text} has changed all the same")
    return abort


def require_unrestricted(t: Target, key: tuple[int, int]) -> None:
    """A COB-ID refuses every restricted identifier with 0x06090030, even while it is off. Raises Problem."""
    word, problems = t.read(*key), []
    is_switchable = t.variable(*key).has_valid_bit
    base = word & ~(0x7FF | (INVALID if is_switchable else PRODUCER))
    with t.restore_afterwards(key):
        for can_id in RESTRICTED_ENDS:
            if is_switchable:
                require_abort(t.try_download(*key, word | INVALID), (0,), "it cannot be switched off")
            if (code := t.try_download(*key, base | can_id)) != VALUE:
                problems.append(f"0x{can_id:03X} {format_abort(code)}")
    require(not problems, f"{t.variable(*key).label}: {join_labels(problems)}")


def require_emcy(t: Target) -> None:
    """Raises CaseNotApplicable for a node without emergencies."""
    require_applicable(t.sheet.find(0x1014), "the node sends no EMCY (no 0x1014)")


def identify(t: Target, pdo: Pdo) -> int:
    """The identifier of a PDO."""
    return t.read(pdo.parameter, 1) & 0x7FF


def count_bytes(t: Target, pdo: Pdo) -> int:
    """Bytes of its mapping."""
    return (sum(split_entry(word)[2] for word in read_mapping(t, pdo)) + 7) // 8


def set_type(t: Target, pdo: Pdo, *kinds: int) -> bool:
    """Give a PDO the first of these transmission types that it takes; whether it has one now."""
    for kind in kinds:
        if t.read(pdo.parameter, 2) == kind or (
                t.sheet.is_writable(pdo.parameter, 2) and not t.try_download(pdo.parameter, 2, kind)):
            return True
    return False


def require_type(t: Target, pdo: Pdo, *kinds: int) -> None:
    """The same. Raises CaseNotApplicable for a PDO that takes none."""
    require_applicable(set_type(t, pdo, *kinds),
                       f"no TPDO accepts transmission type {' or '.join(map(str, kinds))}")


list_received, list_sent = partial(list_valid, is_received=True), partial(list_valid, is_received=False)
list_changeable = partial(list_valid, is_changeable=True)

CASES = (
    Case("4.1", "communication parameters", "7.5.2.35, 7.5.2.37",
         "sub 0 is 2 or more; COB-ID and transmission type can be read",
         for_each(lambda t: t.sheet.pdos, check_parameters)),
    Case("4.2", "mapping", "7.5.2.36, 7.5.2.38", "mapped objects exist with that length; at most 64 bits",
         for_each(lambda t: t.sheet.pdos, lambda t, pdo: describe_mapping(t, pdo, read_mapping(t, pdo)))),
    Case("4.3", "synchronous transmission", "7.2.2.2, 7.5.2.37",
         "type 1, 2 and 3: one frame at every, every second and every third SYNC, as long as its mapping",
         for_each(list_sent, check_cyclic)),
    Case("4.4", "acyclic synchronous transmission", "7.2.2.2, 7.5.2.37",
         "type 0: nothing without SYNC, at most one frame at each", for_each(list_sent, check_acyclic)),
    Case("4.5", "event timer", "7.5.2.37", "type 254 or 255 with event timer 50 ms: a frame every 50 ms",
         for_each(list_sent, check_event_timer), is_timed=True),
    Case("4.6", "reserved transmission types", "7.5.2.35, 7.5.2.37", "types 241 and 251 are refused with 0x06090030",
         for_each(lambda t: t.sheet.pdos, check_reserved_types, text="refused by {}")),
    Case("4.7", "COB-ID of a valid PDO", "7.5.2.35, 7.5.2.37",
         "it cannot be changed: an abort, and the old one stays in force",
         for_each(list_changeable, lambda t, pdo: f"{pdo.name} {require_fixed(t, (pdo.parameter, 1))}")),
    Case("4.8", "restricted COB-IDs", "7.3.5, table 40", "each is refused with 0x06090030, at both ends of every range",
         for_each(list_changeable, check_restricted, text=f"{len(RESTRICTED_ENDS)} identifiers refused by {{}}")),
    Case("4.9", "29-bit COB-IDs", "7.5.2.35, 7.5.2.37", "supported, or refused with 0x06090030",
         for_each(list_changeable, check_extended)),
    Case("4.10", "a TPDO is switched off and on", "7.5.2.37",
         "not sent while bit 31 is set; sent again afterwards",
         for_each(partial(list_changeable, is_received=False), partial(check_switching, phases=(
             ("on", "old", True), ("off", "old", False), ("on", "old", True))))),
    Case("4.11", "a TPDO gets another COB-ID", "7.5.2.37", "off, changed, on: it is sent under the new one only",
         for_each(partial(list_changeable, is_received=False), partial(check_switching, phases=(
             ("moved", "new", True), ("moved", "old", False))))),
    Case("4.12", "received PDO too short", "7.2.2.5, table 26", "EMCY 0x8210, and the values stay as they were",
         for_each(list_received, check_short_rpdo, text="EMCY 0x8210 for {}")),
    Case("4.13", "received PDO too long", "7.2.2.5, table 26",
         "the first bytes are used or not; EMCY, if any, is 0x8220", for_each(list_received, check_long_rpdo)),
    Case("4.14", "an RPDO is switched off, moved and on", "7.5.2.35",
         "a frame that is too short is noticed (EMCY 0x8210) only under the COB-ID in force",
         for_each(partial(list_changeable, is_received=True), partial(check_switching, phases=(
             ("off", "old", False), ("moved", "old", False), ("moved", "new", True))))),
    Case("4.15", "values of a received PDO", "7.2.2.2, 7.5.2.35",
         "type 0 to 240: in the dictionary after the next SYNC, not before; 254 and 255: at once",
         for_each(list_received, check_rpdo_values)),
    Case("4.16", "values of a transmitted PDO", "7.2.2, 7.5.2.38",
         "the mapped objects in their order, least significant byte first", for_each(list_sent, check_tpdo_values)),
    Case("4.17", "changes of the mapping", "7.5.2.36, 7.5.2.38",
         "refused while the PDO is valid; so are unknown objects, those that cannot be mapped, more than 64 bits",
         for_each(list_changeable, check_mapping_rules)),
)
