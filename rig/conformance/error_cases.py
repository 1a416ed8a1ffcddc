"""Chapter 5: SYNC, emergencies, error register and history, heartbeat producer and consumer, error behaviour."""

from functools import partial
from itertools import pairwise
from statistics import fmean

from rig.benches import Pdo
from rig.conformance.pdo_cases import (
    EXTENDED,
    TOO_SHORT,
    list_received,
    operational,
    read_mapped,
    require_emcy,
    require_fixed,
    require_unrestricted,
    send_short,
    send_values,
)
from rig.conformance.target import (
    COMMANDS,
    HISTORY,
    INCOMPATIBLE,
    NO_DATA,
    NO_SUB,
    OPERATIONAL,
    PRE_OPERATIONAL,
    RESTRICTED_ENDS,
    STOPPED,
    TOO_HIGH,
    TOO_LOW,
    VALUE,
    Case,
    Target,
    find_abort,
    for_each,
    read_error_code,
    require,
    require_abort,
    require_applicable,
)
from rig.network import Frame, NmtState, name_state

CONSUMER, CYCLE, BEHAVIOUR = (0x1016, 1), (0x1006, 0), (0x1029, 1)
HEARTBEAT_LOST, SYNC_LENGTH = 0x8130, 0x8240
OUT_OF_RANGE = (VALUE, TOO_HIGH, TOO_LOW)
BEAT = 0.02  # s, of the heartbeat that the tester sends
LIMIT = 200  # ms, of the supervision that the tester sets


def check_identifier(t: Target, index: int) -> str:
    """The COB-ID of SYNC (0x1005) or EMCY (0x1014), where the node has it; only that of EMCY can be valid or not."""
    variable, word = t.variable(index), t.read(*t.variable(index).key)
    default, text = t.sheet.default(index), f"0x{word & 0x7FF:03X}"
    require(default in (word, None), f"0x{word:08X}, the EDS says 0x{default or 0:08X}")
    require(variable.has_valid_bit or not word & EXTENDED, f"0x{word:08X} asks for a 29-bit identifier")
    if not variable.is_writable:
        return f"{text}, {variable.access}"
    if variable.has_valid_bit:
        require_fixed(t, variable.key)
    require_unrestricted(t, variable.key)
    return f"{text}; {len(RESTRICTED_ENDS)} identifiers refused"


def check_emergency(t: Target) -> str:
    """An error is provoked: a PDO that is too short, or a heartbeat that stops."""
    frame = provoke(t)
    code, register = read_error_code(frame), t.read(0x1001)
    require(frame.data[2] == register, f"the frame says 0x{frame.data[2]:02X}, 0x1001 is 0x{register:02X}")
    require(register & 1, f"the register is 0x{register:02X}: bit 0 (generic error) is not set")
    return f"code 0x{code:04X}, register 0x{register:02X}"


def check_reported_once(t: Target) -> str:
    """The PDO that is too short is sent again."""
    pdo = find_rpdo(t)
    values = read_mapped(t, pdo)
    with operational(t):
        require(send_short(t, pdo, values), "no EMCY at the first")
        send_short(t, pdo, values, is_expected=False)
        require((TOO_SHORT, TOO_SHORT) not in pairwise(code for code in list_codes(t, 0) if code in (0, TOO_SHORT)),
                "a second EMCY for the same error")
        send_values(t, pdo, values)
    return f"two short frames of {pdo.name}"


def check_error_reset(t: Target) -> str:
    """A PDO of the right length follows the one that was too short."""
    pdo = find_rpdo(t)
    values = read_mapped(t, pdo)
    if t.sheet.is_writable(*CYCLE):
        t.try_download(*CYCLE, 0)  # or else the pause of SYNC before the register is read is an error, too
    with operational(t):
        mark = len(t.frames)  # some nodes say at once that the error is over
        require(send_short(t, pdo, values), "no EMCY for a PDO that is too short")
        send_values(t, pdo, values)
        t.wait(t.options.timeout, lambda: 0 in list_codes(t, mark))
        require(0 in list_codes(t, mark), "no EMCY 0x0000")
        register = t.read(0x1001)
    frame_register = [frame.data[2] for frame in t.heard(mark, t.emcy_id) if read_error_code(frame) == 0][-1]
    require(frame_register == register, f"the frame says 0x{frame_register:02X}, 0x1001 is 0x{register:02X}")
    require(register == 0, f"0x1001 is still 0x{register:02X}")
    return f"EMCY 0x0000, register 0x{register:02X}"


def check_history(t: Target) -> str:
    """0x1003, where the node has it."""
    t.variable(HISTORY)
    require(t.read(HISTORY) == 0, f"{t.read(HISTORY)} errors in it after a reset")
    require_abort(find_abort(t.upload, HISTORY, 1), (0, NO_DATA, NO_SUB), "an empty entry")
    frame = provoke(t)
    count = t.read(HISTORY)
    require(count >= 1, "an EMCY was sent, and sub 0 is 0")
    require(t.read(HISTORY, 1) & 0xFFFF == read_error_code(frame), "sub 1 is not the newest error")
    require_abort(t.try_download(HISTORY, 0, b"\1"), (VALUE,), "1 written to sub 0")
    require_abort(t.try_download(HISTORY, 0, b"\0"), (0,), "0 written to sub 0")
    require(t.read(HISTORY) == 0, "sub 0 is not 0 after it was erased")
    return f"{count} error, erased"


def check_heartbeat_period(t: Target, period: int) -> str:
    """The mean over 8 periods, in ms."""
    mean = fmean(measure_periods(t, period, 8))
    limit = 0.05 * period + 1e3 * t.options.tolerance / 8
    require(abs(mean - period) <= limit, f"{period} ms: {mean:.1f} ms, limit {limit:.1f} ms off")
    return f"{mean:.1f} ms"


def measure_periods(t: Target, period: int, count: int) -> list[float]:
    """Times between heartbeats with this producer time, in ms, after the first. Raises CaseNotApplicable, Problem."""
    t.require_writable(0x1017)
    t.write(0x1017, 0, period)
    seconds = 1.5e-3 * period * count + 1.0
    frames = t.wait_for(t.heartbeat_id, seconds, count=count + 2)
    require(frames, f"{period} ms: no {count + 2} heartbeats in {seconds:.1f} s")
    return [(late.t_ns - early.t_ns) * 1e-6 for early, late in pairwise(frames[1:])]


def check_heartbeat_off(t: Target) -> str:
    """Half a second without one; then on again."""
    t.require_writable(0x1017)
    t.beat()
    require(t.wait_for(t.heartbeat_id, 1.0), "no heartbeat with 20 ms")
    t.write(0x1017, 0, 0)
    count = len(t.listen(0.5, t.heartbeat_id))
    require(count == 0, f"heartbeats in 0.5 s: {count}")
    t.beat()
    require(t.wait_for(t.heartbeat_id, 1.0), "it does not come back")
    return "none in 0.5 s"


def check_heartbeat_content(t: Target, state: NmtState) -> str:
    """The second heartbeat after the command."""
    t.beat()
    t.command(COMMANDS[state])
    frames = t.wait_for(t.heartbeat_id, 2 * t.options.timeout, count=2)
    require(frames, f"no heartbeat in {name_state(state)}")
    require(frames[1].data == bytes((state,)), f"{name_state(state)}: {frames[1].data.hex(' ')}")
    return str(int(state))


def check_heartbeat_lost(t: Target) -> str:
    """The tester plays a node that stops."""
    last = beat_as(t, watch(t), 10)
    frames = t.wait_for_error(LIMIT / 1e3 + t.options.timeout, HEARTBEAT_LOST)
    require(frames, f"no EMCY 0x8130 within {LIMIT / 1e3 + t.options.timeout:g} s")
    delay, tolerance = (frames[0].t_ns - last) * 1e-6, 1e3 * t.options.tolerance
    require(delay >= LIMIT - tolerance, f"after {delay:.0f} ms, the consumer time is {LIMIT} ms")
    require(delay <= 1.5 * LIMIT + tolerance, f"after {delay:.0f} ms, limit {1.5 * LIMIT + tolerance:.0f} ms")
    return f"after {delay:.0f} ms, consumer time {LIMIT} ms"


def check_heartbeat_kept(t: Target) -> str:
    """Supervision begins with the first heartbeat."""
    node, pause = watch(t), 2.5 * LIMIT / 1e3
    require(not t.wait_for_error(pause, HEARTBEAT_LOST), "an EMCY before the first heartbeat")
    beat_as(t, node, round(pause / BEAT))
    require(HEARTBEAT_LOST not in list_codes(t, 0), "an EMCY while the heartbeat comes every 20 ms")
    t.write(*CONSUMER, 0)
    require(not t.wait_for_error(pause, HEARTBEAT_LOST), "an EMCY although the entry is 0")
    return f"none in {3 * pause:g} s"


def check_error_behaviour(t: Target, rule: tuple[int, NmtState]) -> str:
    """A value of 0x1029, and the state that it stands for. Without 0x1029 a node goes to PRE-OPERATIONAL."""
    value, state = rule
    has_object = t.sheet.is_writable(*BEHAVIOUR)
    require_applicable(has_object or value == 0)
    t.reset()
    node = watch(t)
    t.beat()
    if has_object:
        code = t.try_download(*BEHAVIOUR, value)
        require_applicable(code not in OUT_OF_RANGE, "no value of 0x1029:1 is accepted")
        require_abort(code, (0,), f"0x1029:1 = {value}")
    t.enter(OPERATIONAL)
    beat_as(t, node, 15)
    beats = [frame.data for frame in t.heard(0, t.heartbeat_id) if frame.data]
    require(beats and beats[-1][0] & 0x7F == OPERATIONAL,
            f"value {value}: not OPERATIONAL although the heartbeat comes")
    t.wait(1.5 * LIMIT / 1e3 + 0.1)
    t.wait_for(t.heartbeat_id, t.options.timeout, lambda frame: frame.data == bytes((state,)))
    t.require_state(state, f"value {value}")
    return f"{value}: {name_state(state)}"


def check_consumer_range(t: Target) -> str:
    """The standard leaves an entry with such a node-ID unused; bits 24 to 31 are reserved."""
    t.require_writable(*CONSUMER)
    with t.restore_afterwards(CONSUMER):
        for entry in (0x008000FA, 0x00FF00FA, 0x010100FA, 0x80010000 | LIMIT):
            require_abort(t.try_download(*CONSUMER, entry), OUT_OF_RANGE, f"0x{entry:08X}")
    return "nodes 128 and 255 and reserved bits refused"


def check_consumer_duplicate(t: Target) -> str:
    """Where the node has two entries."""
    second = (0x1016, 2)
    t.require_writable(*CONSUMER)
    t.require_writable(*second)
    entry = t.find_free_node() << 16 | LIMIT
    with t.restore_afterwards(CONSUMER, second):
        t.write(*second, 0)
        t.write(*CONSUMER, entry)
        return require_abort(t.try_download(*second, entry), (INCOMPATIBLE,))


def check_sync_lost(t: Target) -> str:
    """CiA 301 does not ask for this supervision, nor say after how many periods SYNC counts as lost."""
    t.require_writable(*CYCLE)
    require_emcy(t)
    with t.restore_afterwards(CYCLE):
        t.write(*CYCLE, 10_000)
        with operational(t):
            mark = len(t.frames)
            t.wait(0.1)
            require(not any(list_codes(t, mark)), "an EMCY before the first SYNC")
            t.sync(3, 0.01)
            last = t.now()
            frames = t.wait_for(t.emcy_id, 3.0, lambda frame: read_error_code(frame) >> 8 == 0x81)
    require_applicable(frames, "no EMCY within 3 s: the node does not supervise SYNC")
    return (f"EMCY 0x{read_error_code(frames[0]):04X} {(frames[0].t_ns - last) * 1e-6:.0f} ms after the last SYNC "
            "of 10 ms")


def check_sync_length(t: Target) -> str:
    """One byte, as a producer with a counter would send."""
    require_applicable(t.sheet.find(0x1019) is None, "the node expects a counter (0x1019)")
    with operational(t):
        mark = len(t.frames)
        t.send(t.sync_id, b"\1")
        t.wait(0.1)
        codes = set(list_codes(t, mark)) - {0}
        require(codes <= {SYNC_LENGTH}, f"EMCY {', '.join(f'0x{code:04X}' for code in codes)}")
        t.sync(1, 0.02)
    return "EMCY 0x8240" if codes else "no EMCY"


def check_errors_reset(t: Target) -> str:
    """An error is provoked first. A node may keep its history."""
    provoke(t)
    t.reset()
    register = t.read(0x1001)
    require(register == 0, f"the register is 0x{register:02X}")
    return f"register 0x00, {t.read(HISTORY) if t.sheet.find(HISTORY) else 0} in the history"


def find_rpdo(t: Target) -> Pdo:
    """A valid RPDO of a node with emergencies. Raises CaseNotApplicable."""
    require_emcy(t)
    return list_received(t)[0]


def list_codes(t: Target, mark: int) -> list[int]:
    """Error codes of the emergencies since there were `mark` frames."""
    return [read_error_code(frame) for frame in t.heard(mark, t.emcy_id)]


def provoke(t: Target) -> Frame:
    """Cause an error; its EMCY. The error stands afterwards. Raises CaseNotApplicable, Problem."""
    if t.sheet.is_writable(*CONSUMER):
        beat_as(t, watch(t), 3)
        frames = t.wait_for_error(LIMIT / 1e3 + t.options.timeout, HEARTBEAT_LOST)
        require(frames, "no EMCY when a supervised heartbeat stops")
    else:
        pdo = find_rpdo(t)
        with operational(t):
            frames = send_short(t, pdo, read_mapped(t, pdo))
        require(frames, "no EMCY for a PDO that is too short")
    return frames[0]


def watch(t: Target) -> int:
    """Let the node supervise one that nobody has; its node-ID. Raises CaseNotApplicable, Refusal."""
    t.require_writable(*CONSUMER)
    require_emcy(t)
    node = t.find_free_node()
    t.write(*CONSUMER, node << 16 | LIMIT)
    return node


def beat_as(t: Target, node: int, count: int) -> int:
    """Send heartbeats of that node; the time of the last, ns."""
    for _ in range(count):
        t.send(0x700 + node, bytes((OPERATIONAL,)))
        last = t.now()
        t.wait(BEAT)
    return last


CASES = (
    Case("5.1", "COB-ID of SYNC", "7.5.2.5", "0x080 unless the EDS says otherwise; restricted identifiers are refused",
         partial(check_identifier, index=0x1005)),
    Case("5.2", "COB-ID of EMCY", "7.5.2.17", "0x080 + node-ID unless the EDS says otherwise; fixed while it is valid",
         partial(check_identifier, index=0x1014)),
    Case("5.3", "emergency", "7.2.7",
         "8 bytes: error code, error register as in 0x1001 with bit 0 set", check_emergency),
    Case("5.4", "an error is reported once", "7.2.7.1", "no second EMCY while the same error stands; 0x0000 ends it",
         check_reported_once),
    Case("5.5", "the error is gone", "7.2.7.1",
         "EMCY 0x0000 with the remaining error register, which is that of 0x1001",
         check_error_reset),
    Case("5.6", "error history", "7.5.2.4",
         "newest first in sub 1; writing 0 to sub 0 erases it, other values are refused (0x06090030)", check_history),
    Case("5.7", "heartbeat period", "7.2.8.3.2.2, 7.5.2.20", "50, 100 and 200 ms are kept",
         for_each(lambda t: (50, 100, 200), check_heartbeat_period), is_timed=True),
    Case("5.8", "heartbeat off", "7.5.2.20", "producer time 0: no heartbeat; it takes effect at once",
         check_heartbeat_off, is_timed=True),
    Case("5.9", "content of the heartbeat", "7.2.8.3.2.2", "one byte: 127, 5 or 4 as the state is, bit 7 is 0",
         for_each(lambda t: COMMANDS, check_heartbeat_content)),
    Case("5.10", "supervised heartbeat is lost", "7.2.8.2.2.2, 7.5.2.19",
         "EMCY 0x8130 when nothing came for the consumer time, and not before", check_heartbeat_lost, is_timed=True),
    Case("5.11", "supervised heartbeat goes on", "7.2.8.2.2.2, 7.5.2.19",
         "no EMCY while it comes in time, before it came first, and with the entry at 0", check_heartbeat_kept,
         is_timed=True),
    Case("5.12", "error behaviour", "7.5.2.32",
         "0x1029:1 = 0, 1, 2: to PRE-OPERATIONAL, no change, to STOPPED when the heartbeat is lost in OPERATIONAL",
         for_each(lambda t: ((0, PRE_OPERATIONAL), (1, OPERATIONAL), (2, STOPPED)), check_error_behaviour),
         is_timed=True),
    Case("5.13", "consumer entries out of range", "7.5.2.19",
         "a node-ID above 127 and reserved bits are refused: nobody would notice that nothing is supervised",
         check_consumer_range),
    Case("5.14", "one node in two consumer entries", "7.5.2.19", "refused with 0x06040043", check_consumer_duplicate),
    Case("5.15", "SYNC is lost", "7.5.2.6, table 26",
         "where the node supervises SYNC (0x1006): EMCY 0x81xx when it stops, and none before", check_sync_lost),
    Case("5.16", "SYNC with an unexpected length", "7.2.5.3.1, table 26",
         "without 0x1019 a SYNC with data is ignored or processed; EMCY, if any, is 0x8240", check_sync_length),
    Case("5.17", "errors end with a reset", "7.5.2.4", "after a reset of the communication the error register is 0",
         check_errors_reset),
)
