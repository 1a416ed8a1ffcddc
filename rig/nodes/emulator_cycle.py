"""The emulator's cycle as one compiled loop: SYNC in, feedback and valve state out, the plant one cycle further.

`run_emulator` is a plain function; `plant.compile` compiles it with the bus (raw_bus.py) as one. Only the CANopen
services stay in Python (emulator.py), on another socket. Both work on the same arrays, which are made before the start:
nothing is allocated in the loop. `serve_frame` does the same a frame at a time, for a node whose frames Python brings.

Time. In real time a late frame is late by the clock. In lockstep (0x1006 = 0) the cycles have no fixed length, so a
delay counts in cycles, as on the embedded bus: a frame that is late by m cycles and a part is sent in cycle k + m,
after the answer to that cycle has come.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import ADVANCE_CALL, READ_CALL, Array, ForeignCall, Signals, find_direct_readings, keep_apart
from rig.benches import (
    FRAME_WORDS,
    FRAMES_AT,
    LAST_SYNCHRONOUS,
    LENGTH,
    PAYLOAD,
    VALUES_AT,
    Flags,
    FrameSpec,
    Layout,
    Role,
    make_layout,
    pack_frame,
    read_cycle_number,
    to_integer,
    unpack_frame,
)
from rig.network import (
    FRAME,
    RING,
    SENT,
    Port,
    await_frame,
    read_clock,
    receive_frame,
    send_frame,
    sleep_until,
)
from rig.nodes.scenario import Scenario
from rig.sequences import DELAY, DOUBLE, DROP, SENT_NORMALLY, change_frame

NOISE_RING = 1 << 14  # cycles of noise drawn ahead
EVENT_RING = 256
_HELD_FRAMES = 1 << 15  # late frames that can wait: two a cycle of 0.1 ms for the longest delay, and its drives
_ANSWER_LIMIT = 80_000_000  # ns: in lockstep the answer to a late feedback frame is waited for this long
_LONGEST_WAIT = 20_000_000  # ns: then the loop looks whether it is to stop, as after `await_frame`

# NMT states (CiA 301), as in the heartbeat
INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127

# The words that loop and services share. Written by the services:
STOP, DEMOTED, PERIOD, SYNC_ID, DRIVE_ID, DRIVE_TYPE, EMCY_ID, OTHER_REGISTER, NOISE_FILLED = range(9)
TPDOS_AT = 9  # rows of feedback and valve state, with the columns
ID, TYPE, COUNT, DATA = range(4)  # COB-ID, -1: none; transmission type; and of the loop: SYNCs to go, payload
# .. by the loop:
(FRAME_CYCLE, ANSWERED, STATE, BEGUN, FIRST, CYCLE, MISSED, WAITING,
 WAITING_DATA, MISSING, LATE, ZEROED, PLANT_CYCLE, HELD, NOW, EVENTS, RECORDED, LONGEST_WAKE,
 LONGEST_RESPONSE, LONGEST_CYCLE, PUSHED, PUSHED_TIME, PUSHED_ID, PUSHED_LENGTH, PUSHED_DATA, SHORT, UNSENT, FAILURE,
 RESET_COMMAND, SYNCED) = range(17, 47)
# .. by nobody: time of a cycle in ns, and where the tables are that depend on the plant and its faults
(CYCLE_TIME, PARAMETERS, PARAMETERS_AT, SIGNALS, SIGNALS_AT, FAULT_VALUES_AT, LOAD, LOAD_AT, FLAT, FLAT_AT,
 LIVE_AT, RECORD_SIZE, ADVANCE, READ, STEPS) = range(64, 79)
# .. of the node: its node-ID, RPDO of the drive, mask of the cycle's number in it, and how many drives may be missing
# in a row before the current is zeroed
NODE, DRIVE_NUMBER, NUMBER_MASK, MISSED_LIMIT = range(48, 52)
# .. of the transducers: how many, their readings in the reals, their values in the state and noise in the record, and
# how many numbers of noise a cycle has
SENSORS, READINGS_AT, SENSORS_AT, NOISES = 80, 81, 82, 83
HITS_AT = 86  # of the kinds of frames below: where the rows begin, and behind the last where they end
_WORDS = 96
EVENTS_AT, _HELD_AT = _WORDS, _WORDS + EVENT_RING
TIMES_AT = _HELD_AT + 4 * _HELD_FRAMES
_TABLES_AT = TIMES_AT + 6 * RING
IN_FORCE, _PERIOD, _RESULT, _FAILURE, NOISE_AT = 0, 1, 4, 8, 16  # in the real numbers

# events for the services
TIMEOUT_RAISED, TIMEOUT_CLEARED, DRIVE_SHORT, DRIVE_WHOLE, DIVERGED, SYNC_MALFORMED = range(1, 7)
COMMANDED = 256  # + the NMT command
LOST_SYNCS = 2  # PUSHED: the SYNCs that were lost before the one that is to be pushed

# What faults act on, late frames in the order of their delivery: drives first, which are for the emulator itself; valve
# states last, because in lockstep they end the rig's wait. Bus-off is on the whole node.
_DRIVE, FEEDBACK_FRAME, _VALVE, _SYNC, _BUS_OFF = range(5)
_FRAMES = ("drive", "feedback", "valve_state", "sync", "plant")
_ADDED, _HOLDS_READING, _HOLDS_VALUE = range(3)  # faults of a sensor

DRIVE_MISSING, DRIVE_LATE, CURRENT_ZEROED = map(int, Flags)
_TIMEOUT_CODE, _TIMEOUT_REGISTER = 0x8250, 0x11

_call_advance, _call_read = ForeignCall(ADVANCE_CALL), ForeignCall(READ_CALL)


class Memory(NamedTuple):
    """All that loop and services share. Two arrays: with one for each table the loop takes a minute to compile.

    words: the numbers named above; a ring of events; late frames in rows of (which frame, due, length, data), the first
    that was sent first; a ring of cycles in rows of (cycle, SYNC received, begun, sent, done, flags), times in ns; then
    the faults.

    The faults: parameters are rows of (place in the record, first cycle, number of values, place of the values, one a
    cycle); signals are rows of (signal, kind, first cycle, end, place of the added values, or of the one at which it is
    stuck); frames are rows of (cycle, code, argument), see `Schedule.list_frame_hits`.

    reals: drive in force; period, s; a ring of noise, NOISES a cycle; values of the faults; load, one a cycle; state
    and parameters of the plant; readings of the transducers.

    frames: drive, feedback and valve state as the bench has them, with their values.
    """

    words: NDArray[np.int64]
    reals: Array
    frames: Layout


def run_emulator(port: Port, m: Memory) -> None:
    """Serve the bus until the services stop it, an NMT reset comes (RESET_COMMAND) or the bus fails (FAILURE)."""
    words = m.words
    while not (words[STOP] or words[FAILURE] or words[RESET_COMMAND]):
        if words[PUSHED]:
            words[PUSHED] = 0
            status, t_ns, cob_id = FRAME, words[PUSHED_TIME], words[PUSHED_ID]
            length, data = words[PUSHED_LENGTH], words[PUSHED_DATA]
        elif words[HELD] and words[PERIOD]:
            deadline = min(_find_next_due(m), read_clock(port) + _LONGEST_WAIT)
            status, t_ns, cob_id, length, data = receive_frame(port, deadline)
        else:
            status, t_ns, cob_id, length, data = await_frame(port)
        if status == FRAME:
            _take_frame(port, m, t_ns, cob_id, length, data)
        elif status < 0:
            words[FAILURE] = status
        if words[HELD] and words[PERIOD]:
            _release_until(port, m, read_clock(port), True)


def serve_frame(port: Port, m: Memory) -> None:
    """Deal with the frame that Python has pushed, or with LOST_SYNCS, or deliver the late frames that are due."""
    words = m.words
    kind = words[PUSHED]
    words[PUSHED] = 0
    if kind == LOST_SYNCS:
        _pass_lost_syncs(port, m)
    elif kind:
        _take_frame(port, m, words[PUSHED_TIME], words[PUSHED_ID], words[PUSHED_LENGTH], words[PUSHED_DATA])
    else:
        _release_until(port, m, read_clock(port), True)


@keep_apart
def _take_frame(port: Port, m: Memory, t_ns: int, cob_id: int, length: int, data: int) -> None:
    words = m.words
    if words[DEMOTED]:
        if words[STATE] == OPERATIONAL:
            _leave_operational(m, words[DEMOTED])
        words[DEMOTED] = 0
    if cob_id == words[SYNC_ID]:
        if not words[BEGUN] or _is_next_sync(port, m, t_ns):
            _take_sync(port, m, t_ns, length)
    elif cob_id == words[DRIVE_ID]:
        _take_drive(m, t_ns, length, data)
    elif cob_id == 0 and length == 2 and not _is_bus_off(m, words[CYCLE] - 1):
        _take_command(m, data)


# ------------------------------------------------------------------------------------ NMT


def _take_command(m: Memory, data: int) -> None:
    """An NMT command to this node. The services, which hear of all from here, carry out a reset (RESET_COMMAND)."""
    words = m.words
    command, node = data & 0xFF, data >> 8 & 0xFF  # before its boot-up the node hears nothing
    if words[STATE] == INITIALISING or (node != 0 and node != words[NODE]):
        return
    if command == 129 or command == 130:
        words[RESET_COMMAND] = command
    if command == 1 or command == 2 or command == 128:
        _post_event(m, COMMANDED + command)
    if command == 1 and words[STATE] != OPERATIONAL:
        words[STATE] = OPERATIONAL
        words[BEGUN] = words[FIRST] = 1
    elif command == 2 and words[STATE] != STOPPED:
        _leave_operational(m, STOPPED)
    elif command == 128 and words[STATE] != PRE_OPERATIONAL:
        _leave_operational(m, PRE_OPERATIONAL)


def _leave_operational(m: Memory, state: int) -> None:
    """What waits for a SYNC is dropped, and SYNCs are counted anew."""
    words = m.words
    words[STATE] = state
    words[WAITING] = 0
    for at in (TPDOS_AT, TPDOS_AT + 4):
        words[at + COUNT] = words[at + TYPE]


def _post_event(m: Memory, event: int) -> None:
    m.words[EVENTS_AT + m.words[EVENTS] % EVENT_RING] = event
    m.words[EVENTS] += 1


# ------------------------------------------------------------------------------------ drive


def _take_drive(m: Memory, t_ns: int, length: int, data: int) -> None:
    """A drive frame came; a fault may drop, delay or change it. One that comes twice counts once."""
    code, argument = find_action(m, _DRIVE, m.words[CYCLE] - 1)
    if code == DELAY:
        _hold_frame(m, _DRIVE, t_ns, argument, length, data)
    elif code != DROP:
        length, data = change_frame(code, argument, length, data)
        _keep_drive(m, length, data)


def _keep_drive(m: Memory, length: int, data: int) -> None:
    """The drive frame waits for the next SYNC (a synchronous RPDO)."""
    words = m.words
    if words[STATE] != OPERATIONAL:
        return
    if length < m.frames.words[FRAMES_AT + LENGTH]:
        if not words[SHORT]:
            _post_event(m, DRIVE_SHORT)
        words[SHORT] = 1
        return
    if words[SHORT]:
        _post_event(m, DRIVE_WHOLE)
        words[SHORT] = 0
    if words[DRIVE_TYPE] <= LAST_SYNCHRONOUS:
        words[WAITING], words[WAITING_DATA] = 1, data
    else:
        _read_drive(m, data)


def _find_place(what: int) -> int:
    """Where a frame stands in the layout."""
    return FRAMES_AT + FRAME_WORDS * what


@keep_apart
def _read_drive(m: Memory, data: int) -> None:
    """Put the values of a drive frame into the objects, whatever cycle it answers."""
    frames = m.frames
    frames.words[PAYLOAD] = data
    m.words[ANSWERED] = read_cycle_number(frames, FRAMES_AT)
    unpack_frame(frames, FRAMES_AT, frames.words[FRAMES_AT + LENGTH], m.words[ANSWERED])


# ------------------------------------------------------------------------------------ cycle


def _take_sync(port: Port, m: Memory, t_ns: int, length: int) -> None:
    """One cycle of the plant; while the node is not OPERATIONAL, time goes on and the plant pauses."""
    words = m.words
    begun_ns = _read_time(port, m, t_ns)
    if not _wait_for_noise(port, m):
        return
    if not words[PERIOD]:  # lockstep: what was late is late for the cycle that ends now
        _release_until(port, m, words[CYCLE] * words[CYCLE_TIME] - 1, True)
        words[NOW] = words[CYCLE] * words[CYCLE_TIME]
    if words[STATE] != OPERATIONAL:
        words[CYCLE] += words[BEGUN]
        return
    if length:
        _post_event(m, SYNC_MALFORMED)
        return
    fresh = words[WAITING]
    if fresh:
        words[WAITING] = 0
        _read_drive(m, words[WAITING_DATA])
    k = words[CYCLE]
    flags = 0 if words[FIRST] else _judge_drive(port, m, k, fresh)
    words[FIRST] = 0
    if not read_plant(m, k):
        _post_event(m, DIVERGED)
        _leave_operational(m, PRE_OPERATIONAL)
        return
    _fill_frames(m, k, flags)
    end = (k + 1) * words[CYCLE_TIME] - 1  # in lockstep, the last instant of this cycle
    is_crowded = not words[PERIOD] and _is_feedback_due(m, end)
    is_fed = _send_due(port, m, FEEDBACK_FRAME, k, t_ns)
    if not is_crowded:
        _send_due(port, m, _VALVE, k, t_ns)
    sent_ns = _read_time(port, m, t_ns)
    advance_plant(m, k)
    words[CYCLE] = k + 1
    done_ns = _read_time(port, m, t_ns)
    _record_cycle(m, k, t_ns, begun_ns, sent_ns, done_ns, flags)
    if not words[PERIOD]:
        if is_crowded:
            _send_late_feedback(port, m, k, is_fed)
            _send_due(port, m, _VALVE, k, t_ns)
        # Drives wait for the next SYNC, for that of this cycle comes before them; but not if it answers late feedback.
        is_fed = _is_feedback_due(m, end)
        if is_fed:
            words[NOW] = end
        _release_until(port, m, end, is_fed)


def _wait_for_noise(port: Port, m: Memory) -> bool:
    """Until the services, which draw 16 s ahead at 1 kHz, have drawn the noise of this cycle: no number is used twice.

    False when the loop is to end.
    """
    words = m.words
    while words[PLANT_CYCLE] >= words[NOISE_FILLED]:
        if words[STOP]:
            return False
        sleep_until(port, read_clock(port) + 100_000)
    return True


def _is_next_sync(port: Port, m: Memory, t_ns: int) -> bool:
    """Deal with the SYNCs that faults suppress or repeat; whether this one begins a cycle."""
    words = m.words
    if _is_bus_off(m, words[CYCLE]):
        _pass_cycle(port, m)
        return False
    _pass_lost_syncs(port, m)
    if words[SYNCED] == words[CYCLE] - 1 and find_action(m, _SYNC, words[SYNCED])[0] == DOUBLE:
        words[SYNCED] = -1
        if words[STATE] == OPERATIONAL:
            _answer_again(port, m, t_ns)
        return False
    words[SYNCED] = words[CYCLE]
    return True


def _pass_lost_syncs(port: Port, m: Memory) -> None:
    """Time went on for the plant while faults suppressed the SYNCs up to this one."""
    while find_action(m, _SYNC, m.words[CYCLE])[0] == DROP:
        _pass_cycle(port, m)


@keep_apart
def _pass_cycle(port: Port, m: Memory) -> None:
    """A cycle of which the node hears no SYNC: the current stays, and is zeroed after three."""
    words = m.words
    k = words[CYCLE]
    if words[STATE] == OPERATIONAL:
        if not _wait_for_noise(port, m):
            return
        _miss(port, m, MISSING)
        _set_parameters(m, k)
        advance_plant(m, k)
    words[CYCLE] = k + 1


@keep_apart
def _answer_again(port: Port, m: Memory, t_ns: int) -> None:
    """Send the PDOs of the last SYNC once more; the plant does not move twice."""
    for what in (FEEDBACK_FRAME, _VALVE):
        _send_pdo(port, m, what, m.words[CYCLE], t_ns)


def _read_time(port: Port, m: Memory, t_ns: int) -> int:
    """The time for the record, ns; in lockstep, where nobody reads it, that of the SYNC."""
    return read_clock(port) if m.words[PERIOD] else t_ns


def _judge_drive(port: Port, m: Memory, k: int, fresh: int) -> int:
    """Flags of this cycle and the current to use until the next SYNC: the one that answers the cycle before this one.

    A missing or late answer leaves the current as it was; after three in a row there is none (EMCY 0x8250) until
    answers come again.
    """
    words = m.words
    if fresh and words[ANSWERED] == (k - 1) & words[NUMBER_MASK]:
        m.reals[IN_FORCE] = m.frames.doubles[m.frames.words[VALUES_AT] + words[SENSORS] + 1]
        words[MISSED] = 0
        _announce_timeout(port, m, 0)
        return 0
    return DRIVE_LATE | _miss(port, m, LATE) if fresh else DRIVE_MISSING | _miss(port, m, MISSING)


def _miss(port: Port, m: Memory, counter: int) -> int:
    """No answer to the last cycle; the flag if it was one too many: then there is no current."""
    words = m.words
    words[MISSED] += 1
    words[counter] += 1
    if words[MISSED] < words[MISSED_LIMIT]:
        return 0
    m.reals[IN_FORCE] = 0.0
    _announce_timeout(port, m, 1)
    return CURRENT_ZEROED


def _announce_timeout(port: Port, m: Memory, is_raised: int) -> None:
    """EMCY 0x8250 or its end. It stands on the bus before the feedback of this cycle, so the loop itself sends it."""
    words = m.words
    if words[ZEROED] == is_raised:
        return
    words[ZEROED] = is_raised
    _post_event(m, TIMEOUT_RAISED if is_raised else TIMEOUT_CLEARED)
    register = words[OTHER_REGISTER]
    data = register << 16
    if is_raised:
        data = _TIMEOUT_CODE | (register | _TIMEOUT_REGISTER) << 16 | words[DRIVE_NUMBER] << 24
    if words[EMCY_ID] >= 0 and not _is_bus_off(m, words[CYCLE] - 1):
        _send(port, m, words[EMCY_ID], 8, data)


@keep_apart
def read_plant(m: Memory, k: int) -> bool:
    """Change the parameters of this cycle and read the transducers, which faults may disturb; False if it diverged."""
    words, reals = m.words, m.reals
    _set_parameters(m, k)
    noise, flat = NOISE_AT + words[NOISES] * (words[PLANT_CYCLE] % NOISE_RING), words[FLAT_AT]
    readings = words[READINGS_AT]
    if words[READ]:
        base = reals.ctypes.data
        _call_read(words[READ], base + 8 * readings, base + 8 * _FAILURE,
                   0, 0, words[FLAT], 8, base + 8 * flat, words[FLAT], 8,
                   0, 0, words[NOISES], 8, base + 8 * noise, words[NOISES], 8,
                   words[PLANT_CYCLE] * reals[_PERIOD],
                   0, 0, 1, words[RECORD_SIZE], base + 8 * words[LIVE_AT], 1, words[RECORD_SIZE])
    else:  # as in `plant.Actuator.sample`
        for i in range(words[SENSORS]):
            at = words[SENSORS_AT] + 2 * i
            reals[readings + i] = reals[flat + words[at]] + reals[words[LIVE_AT] + words[at + 1]] * reals[noise + i]
    for i in range(words[SENSORS]):
        if not np.isfinite(reals[readings + i]):
            return False
    for i in range(words[SENSORS]):
        reals[readings + i] = _disturb(m, i, reals[readings + i], k)
    return True


def explain_divergence(m: Memory, signals: Signals) -> str:
    """Which of the plant's outputs a divergence has reached first."""
    return "the plant has diverged: no finite number in " + ", ".join(
        s.name for s, x in zip(signals.outputs, m.reals[m.words[READINGS_AT]:], strict=False) if not np.isfinite(x))


def _fill_frames(m: Memory, k: int, flags: int) -> None:
    """Put the readings of this cycle into the objects and the frames."""
    frames, values = m.frames, m.frames.words[VALUES_AT]
    sensors = m.words[SENSORS]
    for i in range(sensors):
        frames.doubles[values + i] = m.reals[m.words[READINGS_AT] + i]
    frames.doubles[values + sensors] = flags
    m.words[FRAME_CYCLE] = k
    for what in (FEEDBACK_FRAME, _VALVE):
        pack_frame(frames, _find_place(what), k)
        m.words[TPDOS_AT + 4 * (what - FEEDBACK_FRAME) + DATA] = frames.words[PAYLOAD]


@keep_apart
def advance_plant(m: Memory, k: int) -> None:
    """One cycle under the drive in force and the load of this cycle."""
    words, reals = m.words, m.reals
    load = reals[words[LOAD_AT] + k] if k < words[LOAD] else 0.0
    noise = reals[NOISE_AT + words[NOISES] * (words[PLANT_CYCLE] % NOISE_RING) + words[NOISES] - 1]
    base = reals.ctypes.data
    _call_advance(words[ADVANCE], base + 8 * _RESULT, base + 8 * _FAILURE,
                  0, 0, words[FLAT], 8, base + 8 * words[FLAT_AT], words[FLAT], 8,
                  reals[IN_FORCE], load, noise, words[PLANT_CYCLE] * reals[_PERIOD],
                  0, 0, 1, words[RECORD_SIZE], base + 8 * words[LIVE_AT], 1, words[RECORD_SIZE], words[STEPS])
    words[PLANT_CYCLE] += 1


def _record_cycle(m: Memory, k: int, t_ns: int, begun_ns: int, sent_ns: int, done_ns: int, flags: int) -> None:
    words = m.words
    at = TIMES_AT + 6 * (words[RECORDED] % RING)
    words[at], words[at + 1], words[at + 2] = k, t_ns, begun_ns
    words[at + 3], words[at + 4], words[at + 5] = sent_ns, done_ns, flags
    words[RECORDED] += 1
    words[LONGEST_WAKE] = max(words[LONGEST_WAKE], begun_ns - t_ns)
    words[LONGEST_RESPONSE] = max(words[LONGEST_RESPONSE], sent_ns - t_ns)
    words[LONGEST_CYCLE] = max(words[LONGEST_CYCLE], done_ns - t_ns)


# ------------------------------------------------------------------------------------ frames out


def _send(port: Port, m: Memory, cob_id: int, length: int, data: int) -> None:
    status = send_frame(port, cob_id, length, data)
    if status < 0:
        m.words[FAILURE] = status
    elif status != SENT:
        m.words[UNSENT] += 1


def _send_due(port: Port, m: Memory, what: int, k: int, t_ns: int) -> bool:
    """Send a TPDO where it is due, type n of 1..240 at every n-th SYNC; whether it went out now."""
    words, at = m.words, TPDOS_AT + 4 * (what - FEEDBACK_FRAME)
    words[at + COUNT] -= 1
    if words[at + COUNT] > 0:
        return False
    words[at + COUNT] = words[at + TYPE]
    return _send_pdo(port, m, what, k, t_ns)


def _send_pdo(port: Port, m: Memory, what: int, k: int, t_ns: int) -> bool:
    """Send a synchronous TPDO of cycle k as a fault leaves it; whether it went out now."""
    words, at = m.words, TPDOS_AT + 4 * (what - FEEDBACK_FRAME)
    if words[at + ID] < 0 or not 1 <= words[at + TYPE] <= LAST_SYNCHRONOUS:
        return False
    code, argument = find_action(m, what, k)
    if code == DELAY:
        _hold_frame(m, what, t_ns, argument, m.frames.words[_find_place(what) + LENGTH], words[at + DATA])
    if code in (DELAY, DROP):
        return False
    length, data = change_frame(code, argument, m.frames.words[_find_place(what) + LENGTH], words[at + DATA])
    _send(port, m, words[at + ID], length, data)
    if code == DOUBLE:
        _send(port, m, words[at + ID], length, data)
    return True


# ------------------------------------------------------------------------------------ late frames


def _hold_frame(m: Memory, what: int, t_ns: int, delay: int, length: int, data: int) -> None:
    """Keep a frame that comes at `t_ns` until its delay is over; one too many is lost and counted."""
    words = m.words
    if words[HELD] >= _HELD_FRAMES:
        words[UNSENT] += 1
        return
    at = _HELD_AT + 4 * words[HELD]
    now = t_ns if words[PERIOD] else words[NOW]
    words[at], words[at + 1], words[at + 2], words[at + 3] = what, now + delay, length, data
    words[HELD] += 1


def _find_next_due(m: Memory) -> int:
    """When the next of the late frames is due, in real time; there is one."""
    due = to_integer(m.words[_HELD_AT + 1])
    for i in range(1, m.words[HELD]):
        due = min(due, to_integer(m.words[_HELD_AT + 4 * i + 1]))
    return due


def _find_next_held(m: Memory, t_ns: int, least: int) -> int:
    """Where the late frame of kind `least` or above stands that is to be delivered next at `t_ns`; -1 for none."""
    best, first = -1, (0, 0)
    for i in range(m.words[HELD]):
        at = _HELD_AT + 4 * i
        what, due = to_integer(m.words[at]), to_integer(m.words[at + 1])
        # in real time by their times, but drives first
        order = (min(what, FEEDBACK_FRAME) if m.words[PERIOD] else what), due
        if least <= what and due <= t_ns and (best < 0 or order < first):
            best, first = at, order
    return best


def _is_feedback_due(m: Memory, t_ns: int) -> bool:
    """Whether a feedback frame of an earlier cycle is to be sent until `t_ns`."""
    at = _find_next_held(m, t_ns, FEEDBACK_FRAME)
    return bool(at >= 0 and m.words[at] == FEEDBACK_FRAME)


@keep_apart
def _release_until(port: Port, m: Memory, t_ns: int, with_drives: bool) -> bool:
    """Deliver the late frames that are due at `t_ns`; whether feedback was among them."""
    words = m.words
    is_fed = False
    least = _DRIVE if with_drives else FEEDBACK_FRAME
    at = _find_next_held(m, t_ns, least)
    while at >= 0:
        what, length, data = words[at], words[at + 2], words[at + 3]
        words[HELD] -= 1
        end = _HELD_AT + 4 * words[HELD]
        for place in range(at, end):
            words[place] = words[place + 4]
        if what == _DRIVE:
            _keep_drive(m, length, data)
        elif words[TPDOS_AT + 4 * (what - FEEDBACK_FRAME) + ID] >= 0:  # it may have been switched off meanwhile
            _send(port, m, words[TPDOS_AT + 4 * (what - FEEDBACK_FRAME) + ID], length, data)
            is_fed |= what == FEEDBACK_FRAME
        at = _find_next_held(m, t_ns, least)
    return bool(is_fed)


@keep_apart
def _send_late_feedback(port: Port, m: Memory, k: int, is_fed: bool) -> None:
    """Lockstep: send the feedback of earlier cycles behind the answer to that of cycle k, and await the answer to it.

    The rig goes on as soon as it has the valve state, which is sent after this.
    """
    words = m.words
    start = k * words[CYCLE_TIME]
    if is_fed:
        _await_drive(port, m)
    for t_ns in (start, start + words[CYCLE_TIME] - 1):  # an embedded bus has two instants in a cycle
        words[NOW] = t_ns
        if _release_until(port, m, t_ns, True):
            _await_drive(port, m)


@keep_apart
def _await_drive(port: Port, m: Memory) -> None:
    """Take the next drive frame; another frame ends the wait and comes up again in the loop."""
    words = m.words
    status, t_ns, cob_id, length, data = receive_frame(port, read_clock(port) + _ANSWER_LIMIT)
    if status < 0:
        words[FAILURE] = status
    elif status == FRAME and cob_id == words[DRIVE_ID]:
        _take_drive(m, t_ns, length, data)
    elif status == FRAME:
        words[PUSHED], words[PUSHED_TIME], words[PUSHED_ID] = 1, t_ns, cob_id
        words[PUSHED_LENGTH], words[PUSHED_DATA] = length, data


# ------------------------------------------------------------------------------------ faults


@keep_apart
def find_action(m: Memory, what: int, k: int) -> tuple[int, int]:
    """What happens to a frame of cycle k: see `faults.Action`."""
    words = m.words
    low, end = words[HITS_AT + what], words[HITS_AT + what + 1]
    at = low + 3 * np.searchsorted(words[low:end:3], k)
    if at < end and words[at] == k:
        return to_integer(words[at + 1]), to_integer(words[at + 2])
    return SENT_NORMALLY, 0


def find_drive_action(m: Memory, k: int) -> tuple[int, int]:
    """What happens to the drive frame that answers cycle k; a plant that is bus-off does not receive it."""
    if _is_bus_off(m, k):
        return DROP, 0
    return find_action(m, _DRIVE, k)


def _is_bus_off(m: Memory, k: int) -> bool:
    return find_action(m, _BUS_OFF, k)[0] != SENT_NORMALLY


def _set_parameters(m: Memory, k: int) -> None:
    """Set the parameters that faults change to their values in this cycle: see `Schedule.list_parameters`."""
    words, reals = m.words, m.reals
    for i in range(words[PARAMETERS]):
        at = words[PARAMETERS_AT] + 4 * i
        since = min(k - words[at + 1], words[at + 2] - 1)
        if since >= 0:
            reals[words[LIVE_AT] + words[at]] = reals[words[FAULT_VALUES_AT] + words[at + 3] + since]


def _disturb(m: Memory, signal: int, value: float, k: int) -> float:
    """What a sensor says in place of `value`; faults act in the order of the plan."""
    words, reals = m.words, m.reals
    for i in range(words[SIGNALS]):
        at = words[SIGNALS_AT] + 5 * i
        kind, first, place = words[at + 1], words[at + 2], words[FAULT_VALUES_AT] + words[at + 4]
        if words[at] != signal:
            continue
        if not first <= k < words[at + 3]:
            if kind == _HOLDS_READING:
                reals[place] = value
        elif kind == _ADDED:
            value += reals[place + k - first]
        else:
            value = reals[place]
    return value


# ------------------------------------------------------------------------------------ made before the start


def fill_noise(m: Memory, rng: np.random.Generator, least: int = 1024) -> None:
    """Fill the ring of noise with the numbers that `plant.Actuator` draws, once `least` rows of it are free."""
    end = int(m.words[NOISE_FILLED])
    free = int(m.words[PLANT_CYCLE]) + NOISE_RING - end
    if free < least:
        return
    numbers = int(m.words[NOISES])
    rows = rng.standard_normal((free, numbers))
    first = min(free, NOISE_RING - end % NOISE_RING)  # up to the ring's end, then from its start
    start = end % NOISE_RING
    noise = m.reals[NOISE_AT: NOISE_AT + numbers * NOISE_RING].reshape(-1, numbers)
    noise[start: start + first], noise[: free - first] = rows[:first], rows[first:]
    m.words[NOISE_FILLED] = end + free


def make_memory(scenario: Scenario, advance: int = 0, read: int = 0, frames: Sequence[FrameSpec] = ()) -> Memory:
    """Memory of the loop for a plant at rest with its load and its faults; no noise is drawn yet.

    `advance`, `read`: addresses of the compiled `plant.solve.advance_flat_state` and, for a model whose readings are
    not direct (`find_direct_readings`), `read_flat_sensors`. `frames`: drive, feedback and valve state, for a plant
    that is a node of its own.
    """
    model, load, schedule = scenario.model, scenario.list_loads(), scenario.make_schedule()
    names = model.list_names()
    parameters: list[tuple[int, ...]] = []
    signals: list[tuple[int, ...]] = []
    values: list[float] = []
    for name, changes in schedule.parameters.items():
        first = min(begin for begin, _ in changes)
        last = max(begin + len(piece) for begin, piece in changes)
        course = np.full(last - first + 1, model[name])
        for begin, piece in reversed(changes):  # of several in a cycle the first counts
            course[begin - first: begin - first + len(piece)] = piece
        parameters.append((names.index(name), first, len(course), len(values)))
        values += course.tolist()
    for number, output in enumerate(model.kind.signals.outputs):
        for fault in schedule.signals.get(output.name, ()):
            kind = _HOLDS_READING if fault.value is None else _HOLDS_VALUE
            signals.append((number, kind if fault.added is None else _ADDED, fault.first, fault.last, len(values)))
            values += [fault.value or 0.0] if fault.added is None else fault.added
    hits = list(map(schedule.list_frame_hits, _FRAMES))
    record = model.build_record()
    state = model.build_flat_state()
    words, places = _join_tables(_TABLES_AT, np.int64, parameters, signals, *hits, find_direct_readings(model))
    sensors = len(model.kind.signals.outputs)
    reals, real_places = _join_tables(NOISE_AT + (sensors + 1) * NOISE_RING, np.float64, values, load, state,
                                      record.view(np.float64), np.zeros(sensors))
    words[STATE], words[SYNCED] = INITIALISING, -1
    words[CYCLE_TIME], words[STEPS] = round(model["controller.period"] * 1e9), model.steps
    words[PARAMETERS], words[SIGNALS], words[LOAD], words[FLAT] = len(parameters), len(signals), len(load), len(state)
    words[PARAMETERS_AT], words[SIGNALS_AT] = places[:2]
    *places_of_hits, words[SENSORS_AT], _ = places[2:]
    words[HITS_AT: HITS_AT + len(hits) + 1] = [*places_of_hits, words[SENSORS_AT]]
    words[FAULT_VALUES_AT], words[LOAD_AT], words[FLAT_AT], words[LIVE_AT], words[READINGS_AT], _ = real_places
    words[RECORD_SIZE], words[ADVANCE], words[READ] = record.dtype.itemsize, advance, read
    words[SENSORS], words[NOISES] = sensors, sensors + 1
    reals[_PERIOD] = model["controller.period"]
    return Memory(words, reals, make_layout(frames, list_channels(model.kind.signals), Role.PLANT))


def list_channels(signals: Signals) -> tuple[str, ...]:
    """The values of the frames of a plant with these signals: readings, flags, drive, status word."""
    return (*(s.word for s in signals.outputs), "flags", signals.drive.word, "status_word")


def _join_tables(start: int, kind: Any, *tables: Any) -> tuple[NDArray[Any], list[int]]:
    """One array with the tables behind each other from `start` on, and where each begins and the last ends."""
    flat = [np.asarray(table, kind).ravel() for table in tables]
    places = [start + int(n) for n in np.cumsum([0, *map(len, flat)])]
    whole = np.zeros(places[-1], kind)  # takes memory where something is written: most runs are shorter than the rings
    whole[start:] = np.concatenate(flat)
    return whole, places
