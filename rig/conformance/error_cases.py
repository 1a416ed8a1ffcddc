"""Chapter 5: SYNC, emergencies, error register and history, heartbeat producer and consumer, error behaviour."""
from __future__ import annotations

from functools import partial

from rig.conformance.conformance_case import CaseNotApplicable, case, join_labels, require, require_applicable
from rig.conformance.data_sheet import Pdo, list_restricted_ends
from rig.conformance.pdo_cases import INVALID, operational, read_mapped, send_short
from rig.conformance.target import (
    COMMANDS,
    NO_DATA,
    NO_SUB,
    OPERATIONAL,
    PRE_OPERATIONAL,
    STATE,
    STATES,
    STOPPED,
    TOO_HIGH,
    TOO_LOW,
    VALUE,
    Target,
    format_abort,
    read_error_code,
)
from rig.network.frame import Frame

HEARTBEAT_LOST = 0x8130
BEAT = 0.02  # s, of the heartbeat that the tester sends
LIMIT = 200  # ms, of the supervision that the tester sets


@case("5.1", "COB-ID of SYNC", "7.5.2.5", "0x080 unless the EDS says otherwise; restricted identifiers are refused")
def check_sync_identifier(t: Target) -> str:
    """0x1005, where the node has it."""
    variable = t.variable(0x1005)
    word = t.read(0x1005)
    require(not word & 1 << 29, f"0x{word:08X} asks for a 29-bit identifier")
    if not variable.is_writable:
        return f"0x{word & 0x7FF:03X}, {variable.access}"
    with t.restore_afterwards(variable):
        accepted = [f"0x{can_id:03X}" for can_id in list_restricted_ends()
                    if t.try_download(0x1005, 0, (word & ~(1 << 30 | 0x7FF) | can_id).to_bytes(4, "little")) != VALUE]
    require(not accepted, f"not refused with 0x06090030: {join_labels(accepted)}")
    return f"0x{word & 0x7FF:03X}; {len(list_restricted_ends())} identifiers refused"


@case("5.2", "COB-ID of EMCY", "7.5.2.17", "0x080 + node-ID unless the EDS says otherwise; fixed while it is valid")
def check_emcy_identifier(t: Target) -> str:
    """0x1014, where the node has it."""
    variable = t.variable(0x1014)
    word = t.read(0x1014)
    if isinstance(variable.default, int):
        require(word == variable.default, f"0x{word:08X}, the EDS says 0x{variable.default:08X}")
    if not variable.is_writable:
        return f"0x{word & 0x7FF:03X}, {variable.access}"
    with t.restore_afterwards(variable):
        code = t.try_download(0x1014, 0, (word & ~0x7FF | t.find_free_identifiers(1)[0]).to_bytes(4, "little"))
        require(code in (VALUE, STATE, 0x08000020, 0x08000021), f"changed while it is valid: {format_abort(code)}")
        t.write(0x1014, 0, word | INVALID)
        accepted = []
        for can_id in list_restricted_ends():
            if t.try_download(0x1014, 0, (word & ~(0x7FF | INVALID) | can_id).to_bytes(4, "little")) != VALUE:
                accepted.append(f"0x{can_id:03X}")
            t.try_download(0x1014, 0, (word | INVALID).to_bytes(4, "little"))
    require(not accepted, f"not refused with 0x06090030: {join_labels(accepted)}")
    return f"0x{word & 0x7FF:03X}; {len(list_restricted_ends())} identifiers refused"


@case("5.3", "emergency", "7.2.7",
      "8 bytes: error code, error register as in 0x1001 with bit 0 set; the history gets the code")
def check_emergency(t: Target) -> str:
    """An error is provoked: a PDO that is too short, or a heartbeat that stops."""
    frame = _provoke(t)
    require(len(frame.data) == 8, f"{len(frame.data)} bytes")
    code, register = read_error_code(frame), t.read(0x1001)
    require(frame.data[2] == register, f"the frame says 0x{frame.data[2]:02X}, 0x1001 is 0x{register:02X}")
    require(bool(register & 1), f"the register is 0x{register:02X}: bit 0 (generic error) is not set")
    text = f"code 0x{code:04X}, register 0x{register:02X}"
    if t.sheet.find(0x1003, 1) is not None:
        stored = t.read(0x1003, 1)
        require(stored & 0xFFFF == code, f"0x1003:1 holds 0x{stored:08X}, the code was 0x{code:04X}")
        text += f", history 0x{stored:08X}"
    return text


@case("5.4", "an error is reported once", "7.2.7.1", "no second EMCY while the same error stands")
def check_reported_once(t: Target) -> str:
    """The PDO that is too short is sent again."""
    pdo = _find_rpdo(t)
    values = read_mapped(t, pdo)
    with operational(t):
        require(send_short(t, pdo, values) is not None, "no EMCY at the first")
        require(send_short(t, pdo, values, None, False) is None, "a second EMCY for the same error")
        _send(t, pdo, values)
    return f"one EMCY for two short frames of {pdo.name}"


@case("5.5", "the error is gone", "7.2.7.1", "EMCY 0x0000 with the remaining error register, which is that of 0x1001")
def check_error_reset(t: Target) -> str:
    """A PDO of the right length follows the one that was too short."""
    pdo = _find_rpdo(t)
    values = read_mapped(t, pdo)
    with operational(t):
        require(send_short(t, pdo, values) is not None, "no EMCY for a PDO that is too short")
        mark = len(t.frames)
        _send(t, pdo, values)
        t.wait(t.options.timeout, lambda: any(_is_reset(t, frame) for frame in t.frames[mark:]))
        found = [frame for frame in t.frames[mark:] if _is_reset(t, frame)]
        require(bool(found), "no EMCY 0x0000")
        register = t.read(0x1001)
    require(found[-1].data[2] == register, f"the frame says 0x{found[-1].data[2]:02X}, 0x1001 is 0x{register:02X}")
    require(register == 0, f"0x1001 is still 0x{register:02X}")
    return f"EMCY 0x0000, register 0x{register:02X}"


@case("5.6", "error history", "7.5.2.4",
      "newest first in sub 1; writing 0 to sub 0 erases it, other values are refused (0x06090030)")
def check_history(t: Target) -> str:
    """0x1003, where the node has it."""
    t.variable(0x1003)
    require(t.read(0x1003) == 0, f"{t.read(0x1003)} errors in it after a reset")
    empty = t.try_upload(0x1003, 1)
    require(empty in (0, NO_DATA, NO_SUB), f"an empty entry: {format_abort(empty)}")
    frame = _provoke(t)
    count = t.read(0x1003)
    require(count >= 1, "an EMCY was sent, and sub 0 is 0")
    require(t.read(0x1003, 1) & 0xFFFF == read_error_code(frame), "sub 1 is not the newest error")
    code = t.try_download(0x1003, 0, b"\1")
    require(code == VALUE, f"1 written to sub 0: {format_abort(code)}")
    code = t.try_download(0x1003, 0, b"\0")
    require(code == 0, f"0 written to sub 0: {format_abort(code)}")
    require(t.read(0x1003) == 0, "sub 0 is not 0 after it was erased")
    return f"{count} error, erased"


@case("5.7", "heartbeat period", "7.2.8.3.2.2, 7.5.2.20", "50, 100 and 200 ms are kept", is_timed=True)
def check_heartbeat_period(t: Target) -> str:
    """The mean over 8 periods."""
    t.require_writable(0x1017)
    found = []
    for period in (50, 100, 200):
        t.write(0x1017, 0, period)
        mark = len(t.frames)
        t.wait_for(t.heartbeat_id, 0.012 * period + 1.0, count=9)
        times = [frame.t_ns for frame in t.frames[mark:] if frame.cob_id == t.heartbeat_id]
        require(len(times) >= 9, f"{period} ms: {len(times)} heartbeats in {0.012 * period + 1.0:.1f} s")
        mean = (times[8] - times[0]) * 1e-6 / 8
        limit = 0.05 * period + 1e3 * t.options.tolerance / 8
        require(abs(mean - period) <= limit, f"{period} ms: {mean:.1f} ms, limit {limit:.1f} ms off")
        found.append(f"{mean:.1f} ms")
    return ", ".join(found)


@case("5.8", "heartbeat off", "7.5.2.20", "producer time 0: no heartbeat; it takes effect at once", is_timed=True)
def check_heartbeat_off(t: Target) -> str:
    """Half a second without one; then on again."""
    t.require_writable(0x1017)
    t.beat()
    require(t.wait_for(t.heartbeat_id, 1.0) is not None, "no heartbeat with 20 ms")
    t.write(0x1017, 0, 0)
    count = len(t.listen(0.5, t.heartbeat_id))
    require(count == 0, f"{count} heartbeats in 0.5 s")
    t.beat()
    require(t.wait_for(t.heartbeat_id, 1.0) is not None, "it does not come back")
    return "none in 0.5 s"


@case("5.9", "content of the heartbeat", "7.2.8.3.2.2", "one byte: 127, 5 or 4 as the state is, bit 7 is 0")
def check_heartbeat_content(t: Target) -> str:
    """In each of the three states."""
    t.beat()
    found = []
    for state in (PRE_OPERATIONAL, OPERATIONAL, STOPPED):
        t.command(COMMANDS[state])
        t.wait_for(t.heartbeat_id, t.options.timeout)
        frame = t.wait_for(t.heartbeat_id, t.options.timeout)
        require(frame is not None, f"no heartbeat in {STATES[state]}")
        assert frame is not None
        require(frame.data == bytes((state,)), f"{STATES[state]}: {frame.data.hex(' ')}")
        found.append(str(state))
    return ", ".join(found)


@case("5.10", "supervised heartbeat is lost", "7.2.8.2.2.2, 7.5.2.19",
      "EMCY 0x8130 when nothing came for the consumer time, and not before", is_timed=True)
def check_heartbeat_lost(t: Target) -> str:
    """The tester plays a node that stops."""
    node = _watch(t)
    last = _beat_as(t, node, 10)
    frame = t.wait_for_error(LIMIT / 1e3 + t.options.timeout, HEARTBEAT_LOST)
    require(frame is not None, f"no EMCY 0x8130 within {LIMIT / 1e3 + t.options.timeout:g} s")
    assert frame is not None
    elapsed = (frame.t_ns - last) * 1e-6
    require(elapsed >= LIMIT - 1e3 * t.options.tolerance, f"after {elapsed:.0f} ms, the consumer time is {LIMIT} ms")
    limit = 1.5 * LIMIT + 1e3 * t.options.tolerance
    require(elapsed <= limit, f"after {elapsed:.0f} ms, limit {limit:.0f} ms")
    return f"after {elapsed:.0f} ms, consumer time {LIMIT} ms"


@case("5.11", "supervised heartbeat goes on", "7.2.8.2.2.2, 7.5.2.19",
      "no EMCY while it comes in time, before it came first, and with the entry at 0", is_timed=True)
def check_heartbeat_kept(t: Target) -> str:
    """Supervision begins with the first heartbeat."""
    node = _watch(t)
    require(t.wait_for_error(2.5 * LIMIT / 1e3, HEARTBEAT_LOST) is None, "an EMCY before the first heartbeat")
    _beat_as(t, node, round(2.5 * LIMIT / 1e3 / BEAT))
    early = [frame for frame in t.frames if frame.cob_id == t.emcy_id and read_error_code(frame) == HEARTBEAT_LOST]
    require(not early, "an EMCY while the heartbeat comes every 20 ms")
    t.write(0x1016, 1, 0)
    require(t.wait_for_error(2.5 * LIMIT / 1e3, HEARTBEAT_LOST) is None, "an EMCY although the entry is 0")
    return f"none in {7.5 * LIMIT / 1e3:g} s"


@case("5.12", "error behaviour", "7.5.2.32",
      "0x1029:1 = 0, 1, 2: to PRE-OPERATIONAL, no change, to STOPPED when the heartbeat is lost in OPERATIONAL",
      is_timed=True)
def check_error_behaviour(t: Target) -> str:
    """Without 0x1029 a node goes to PRE-OPERATIONAL."""
    has_object = t.sheet.is_writable(0x1029, 1)
    found = []
    for value, state in ((0, PRE_OPERATIONAL), (1, OPERATIONAL), (2, STOPPED)) if has_object else (
            (0, PRE_OPERATIONAL),):
        t.reset()
        node = _watch(t)
        t.beat()
        if has_object:
            code = t.try_download(0x1029, 1, bytes((value,)))
            if code in (VALUE, TOO_HIGH, TOO_LOW):
                continue  # the node does not offer this behaviour
            require(code == 0, f"0x1029:1 = {value}: {format_abort(code)}")
        t.enter(OPERATIONAL)
        _beat_as(t, node, 15)
        heard = [frame.data[0] & 0x7F for frame in t.frames if frame.cob_id == t.heartbeat_id and frame.data]
        require(heard[-1:] == [OPERATIONAL], f"value {value}: not OPERATIONAL although the heartbeat comes")
        t.wait(1.5 * LIMIT / 1e3 + 0.1)
        t.wait_for(t.heartbeat_id, t.options.timeout, partial(_says_state, state))
        after = t.read_state()
        require(after == state, f"value {value}: {STATES.get(after, str(after))}, expected {STATES[state]}")
        found.append(f"{value}: {STATES[state]}")
    require_applicable(found, "no value of 0x1029:1 is accepted")
    return ", ".join(found)


@case("5.13", "consumer entries out of range", "7.5.2.19",
      "a node-ID above 127 and reserved bits are refused: nobody would notice that nothing is supervised")
def check_consumer_range(t: Target) -> str:
    """The standard leaves an entry with such a node-ID unused; bits 24 to 31 are reserved."""
    variable = t.require_writable(0x1016, 1)
    with t.restore_afterwards(variable):
        for entry in (0x008000FA, 0x00FF00FA, 0x010100FA, 0x80010000 | LIMIT):
            code = t.try_download(0x1016, 1, entry.to_bytes(4, "little"))
            require(code in (VALUE, TOO_HIGH, TOO_LOW), f"0x{entry:08X}: {format_abort(code)}")
    return "nodes 128 and 255 and reserved bits refused"


@case("5.14", "one node in two consumer entries", "7.5.2.19", "refused with 0x06040043")
def check_consumer_duplicate(t: Target) -> str:
    """Where the node has two entries."""
    first, second = t.require_writable(0x1016, 1), t.require_writable(0x1016, 2)
    node = t.find_free_node()
    with t.restore_afterwards(first, second):
        t.write(0x1016, 2, 0)
        t.write(0x1016, 1, node << 16 | LIMIT)
        code = t.try_download(0x1016, 2, (node << 16 | LIMIT).to_bytes(4, "little"))
        require(code == 0x06040043, format_abort(code))
    return format_abort(code)


@case("5.15", "SYNC is lost", "7.5.2.6, table 26",
      "where the node supervises SYNC (0x1006): EMCY 0x81xx when it stops, and none before")
def check_sync_lost(t: Target) -> str:
    """CiA 301 does not ask for this supervision, nor say after how many periods SYNC counts as lost."""
    variable = t.require_writable(0x1006)
    _require_emcy(t)
    with t.restore_afterwards(variable):
        t.write(0x1006, 0, 10_000)
        with operational(t):
            before = _list_codes(t, t.listen(0.1))
            require(not before, f"EMCY 0x{before[0]:04X} before the first SYNC" if before else "")
            for _ in range(3):
                t.sync()
                t.wait(0.01)
            last = t.now()
            frame = t.wait_for(t.emcy_id, 10 * t.options.timeout if t.options.timeout < 1 else 3.0,
                               lambda frame: read_error_code(frame) >> 8 == 0x81)
    if frame is None:
        raise CaseNotApplicable("no EMCY within 3 s: the node does not supervise SYNC")
    return f"EMCY 0x{read_error_code(frame):04X} {(frame.t_ns - last) * 1e-6:.0f} ms after the last SYNC of 10 ms"


@case("5.16", "SYNC with an unexpected length", "7.2.5.3.1, table 26",
      "without 0x1019 a SYNC with data is ignored or processed; EMCY, if any, is 0x8240")
def check_sync_length(t: Target) -> str:
    """One byte, as a producer with a counter would send."""
    require_applicable(t.sheet.find(0x1019) is None, "the node expects a counter (0x1019)")
    with operational(t):
        t.send(t.sheet.default_identifier(0x1005, 0x080), b"\1")
        codes = _list_codes(t, t.listen(0.1))
        require(all(code == 0x8240 for code in codes), f"EMCY {', '.join(f'0x{code:04X}' for code in codes)}")
        t.sync()
        t.wait(0.02)
    return "EMCY 0x8240" if codes else "no EMCY"


@case("5.17", "errors end with a reset", "7.5.2.4", "after a reset of the communication the error register is 0")
def check_errors_reset(t: Target) -> str:
    """An error is provoked first. A node may keep its history."""
    _provoke(t)
    t.reset()
    register = t.read(0x1001)
    require(register == 0, f"the register is 0x{register:02X}")
    count = t.read(0x1003) if t.sheet.find(0x1003) else 0
    return f"register 0x00, {count} in the history"


def _says_state(state: int, frame: Frame) -> bool:
    return frame.data == bytes((state,))


def _require_emcy(t: Target) -> None:
    require_applicable(t.sheet.find(0x1014), "the node sends no EMCY (no 0x1014)")


def _find_rpdo(t: Target) -> Pdo:
    """A valid RPDO. Raises CaseNotApplicable."""
    _require_emcy(t)
    for pdo in t.sheet.pdos:
        if not pdo.is_sent and not t.read(pdo.parameter, 1) & INVALID and t.read(pdo.mapping, 0):
            return pdo
    raise CaseNotApplicable("no RPDO is valid")


def _send(t: Target, pdo: Pdo, values: list[bytes]) -> None:
    """Send an RPDO of the right length with these values."""
    t.send(t.read(pdo.parameter, 1) & 0x7FF, b"".join(values))
    t.wait(0.005)


def _is_reset(t: Target, frame: Frame) -> bool:
    return frame.cob_id == t.emcy_id and read_error_code(frame) == 0


def _list_codes(t: Target, frames: list[Frame]) -> list[int]:
    """Error codes of the emergencies among these frames, without 0x0000."""
    codes = [read_error_code(frame) for frame in frames if frame.cob_id == t.emcy_id]
    return [code for code in codes if code]


def _provoke(t: Target) -> Frame:
    """Cause an error; its EMCY. The error stands afterwards. Raises CaseNotApplicable, CaseFailed."""
    _require_emcy(t)
    if t.sheet.is_writable(0x1016, 1):
        node = _watch(t)
        _beat_as(t, node, 3)
        frame = t.wait_for_error(LIMIT / 1e3 + t.options.timeout, HEARTBEAT_LOST)
        require(frame is not None, "no EMCY when a supervised heartbeat stops")
        assert frame is not None
        return frame
    pdo = _find_rpdo(t)
    with operational(t):
        short = send_short(t, pdo, read_mapped(t, pdo))
    require(short is not None, "no EMCY for a PDO that is too short")
    assert short is not None
    return short


def _watch(t: Target) -> int:
    """Let the node supervise one that nobody has; its node-ID. Raises CaseNotApplicable, Refusal."""
    t.require_writable(0x1016, 1)
    _require_emcy(t)
    node = t.find_free_node()
    t.write(0x1016, 1, node << 16 | LIMIT)
    return node


def _beat_as(t: Target, node: int, count: int) -> int:
    """Send heartbeats of that node; the time of the last, ns."""
    last = t.now()
    for _ in range(count):
        t.send(0x700 + node, bytes((OPERATIONAL,)))
        last = t.now()
        t.wait(BEAT)
    return last
