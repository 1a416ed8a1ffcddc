"""The rig's cycle as compiled code: due time, command, SYNC, collecting the answers. No Python object, no allocation.

`play_cycles_in_real_time` runs in a thread of its own without the interpreter lock until the queue is empty and the
end is asked for; `play_cycle_in_lockstep` plays one cycle a call. Both share their memory, `Buffers`, with Python
(hard_loop.py): Python writes the inputs of the cycles ahead and reads rows and frames behind. Each word has one writer.

The command goes out before the SYNC is due: on a real bus a frame of 8 bytes takes 135 us at 1 Mbit/s and would delay
the SYNC behind it. Times are those of CLOCK_MONOTONIC, ns.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.network import codec
from rig.network.raw_bus import (
    FRAME,
    Port,
    await_frame,
    join_words,
    read_clock,
    receive_frame,
    send_frame,
    sleep_until,
    split_halves,
    split_words,
)
from rig.sequences.faults import DELAY, DOUBLE, DROP, SENT_NORMALLY, change_frame

DONE, WAITING = 0, 1  # what the functions return; negative: status of the bus (raw_bus.FAILED, NO_TURN)
XJ_CAME, XS_CAME, COR_CAME = 1, 2, 4  # bits of ANSWERS
ALL_CAME = XJ_CAME | XS_CAME | COR_CAME

# Words that Python writes
(PERIOD, LEAD, SPIN, SPINS_ALWAYS, GRACE, TAIL, CANCEL_WANTED, OVERRIDE, OVERRIDE_LIMIT, FINISH, DRY, FRAMES_READ,
 ROWS_READ, MAY_IDLE_AT) = range(14)
# Words that the cycle writes; DUE is set by Python before the start
(DUE, HEAD, CANCEL_DONE, IDLE_FROM, CYCLES, OVERRUNS, UNDERRUNS, ROWS, FRAMES, COMPLETE_UNTIL, LOST_RECORDS) = range(
    16, 27)
# Words of the cycle alone
(OPEN, SYNC_AT, SEEN, STAGE, ANSWER_LIMIT, MISSED, HELD, FRAMES_WRITTEN, AWAKE_SINCE, WORKED, RAW, CONTROL, POSITION,
 IS_HELD, COMMAND_CODE, COMMAND_ARGUMENT, SYNC_CODE, SYNC_ARGUMENT, DEAF, PLANT_FRAMES_LEFT, DRIVES_LEFT) = range(
    32, 53)
WORDS = 64
# Columns of an input
(RAW_DEMAND, CONTROL_WORD,
 COMMAND_FAULT, COMMAND_FAULT_ARGUMENT, SYNC_FAULT, SYNC_FAULT_ARGUMENT,  # frame_faults.py
 IS_DEAF,  # a fault: the rig receives nothing
 PLANT_FRAMES, DRIVES) = range(9)  # lockstep: how many are to be awaited; 0: until each answer has come
INPUT_COLUMNS = 9
# Columns of a row
(CYCLE, INPUT, INPUT_HELD, WORD, DUE_AT, LATENESS, OVERRUN, ANSWERS, FEEDBACK_AT, VALVE_AT, DRIVE_AT, COMPLETE_AT,
 EXECUTION, XJ, P12, XS, FLAGS, COR, STATUS) = range(19)
COLUMNS = 19
# Columns of a frame; its head is COB-ID | length << 12 | sent by the rig << 16
TIME, FRAME_HEAD, DATA = range(3)

_LONG_WAIT = 20_000_000  # ns: answers that may take this long are awaited to 20 ms, with fewer system calls
_SECOND_ANSWER_LIMIT = 80_000_000  # ns
_PATIENCE = 5  # cycles in a row without all answers: a node that is gone must not make clean-up last minutes


class Buffers(NamedTuple):
    """Memory shared by the cycle and Python: single words, and rings of which word n is at n modulo the length."""

    words: NDArray[np.int64]
    inputs: NDArray[np.int64]  # (cycles ahead, INPUT_COLUMNS)
    rows: NDArray[np.int64]  # (cycles, COLUMNS)
    frames: NDArray[np.int64]  # (frames, 3)
    held: NDArray[np.int64]  # (late commands, 2): time at which to send, payload; the earliest first


def make_buffers(ahead: int, rows: int, frames: int, held: int) -> Buffers:
    """Empty buffers for that many entries each, in memory that is already mapped."""
    def make_block(count: int, columns: int) -> NDArray[np.int64]:
        return np.full((count, columns), 0, np.int64)  # unlike zeros it touches every page

    return Buffers(np.full(WORDS, 0, np.int64), make_block(ahead, INPUT_COLUMNS), make_block(rows, COLUMNS),
                   make_block(frames, 3), make_block(held, 2))


def play_cycles_in_real_time(port: Port, buffers: Buffers) -> int:
    """Play the queue at its due times until FINISH; returns DONE or the status of a bus that failed.

    Due times are a fixed grid. A SYNC that is late by whole periods drops the due times it has missed, and counts them.
    An empty queue repeats the last input.
    """
    words = buffers.words
    while True:
        # Asleep while the answers come: the kernel notes their times, and nobody waits for the rig to read them.
        status = _sleep_until(port, buffers, words[DUE] - words[LEAD])
        if status >= 0:
            status = _receive_waiting(port, buffers)
        is_end = not _take_input(buffers)
        if status >= 0 and not is_end:
            status = _send_command(port, buffers)
        if status >= 0:
            status = _wait_until_due(port, buffers)
        if status >= 0:
            status = _receive_waiting(port, buffers)
        if status < 0:
            return status
        _end_work(port, words)
        _complete_row(buffers)
        # The compiler cannot see into a library call: the row is in memory before the counts say that it is there.
        _begin_work(port, words)
        _hand_over_row(buffers)
        if is_end:
            return DONE
        late = read_clock(port) - words[DUE]
        lost = late // words[PERIOD]
        words[DUE] += lost * words[PERIOD]
        status = _send_sync(port, buffers, words[DUE] - lost * words[PERIOD], lost)
        if status < 0:
            return status
        words[CYCLES] += 1
        words[DUE] += words[PERIOD]


def play_cycle_in_lockstep(port: Port, buffers: Buffers, until_ns: int) -> int:
    """Play one cycle: DONE when its answers are in or the time for them has passed; WAITING at `until_ns`, to be called
    again; or the status of a bus that failed.
    """
    words = buffers.words
    if words[STAGE] == DONE:
        _begin_work(port, words)
        _take_input(buffers)
        status = _send_command(port, buffers)
        if status >= 0:
            status = _send_sync(port, buffers, read_clock(port), 0)
        if status < 0:
            return status
        grace = words[GRACE] if words[MISSED] < _PATIENCE else words[GRACE] // 10
        words[ANSWER_LIMIT] = words[SYNC_AT] + grace
        words[STAGE] = WAITING
        _end_work(port, words)
    while words[SEEN] != ALL_CAME or words[PLANT_FRAMES_LEFT] > 0 or words[DRIVES_LEFT] > 0:
        if words[ANSWER_LIMIT] - words[SYNC_AT] >= _LONG_WAIT:
            status, t_ns, cob_id, length, data = await_frame(port)
        else:
            status, t_ns, cob_id, length, data = receive_frame(port, min(words[ANSWER_LIMIT], until_ns))
        if status == FRAME:
            _accept_frame(buffers, t_ns, cob_id, length, data)
        elif status < 0:
            return status
        elif read_clock(port) >= _find_answer_limit(words):
            break
        else:
            return WAITING
    words[MISSED] = 0 if words[SEEN] == ALL_CAME else words[MISSED] + 1
    status = _receive_waiting(port, buffers)
    while status >= 0 and words[HELD] > 0 and buffers.held[0, 0] < words[DUE] + words[PERIOD]:
        status = _send_first_held(port, buffers)
    if status < 0:
        return status
    _complete_row(buffers)
    _hand_over_row(buffers)
    words[CYCLES] += 1
    words[DUE] += words[PERIOD]
    words[STAGE] = DONE
    return DONE


def _find_answer_limit(words: NDArray[np.int64]) -> int:
    """How long to wait; not long if only a second drive frame is missing: not every controller answers twice."""
    limit = int(words[ANSWER_LIMIT])
    if words[SEEN] == ALL_CAME and words[PLANT_FRAMES_LEFT] <= 0:
        limit = min(limit, int(words[SYNC_AT]) + _SECOND_ANSWER_LIMIT)
    return limit


def _take_input(buffers: Buffers) -> bool:
    """Take the next input from the queue; from an empty one the last input again, or nothing (False) at the end."""
    words = buffers.words
    if words[CANCEL_DONE] != words[CANCEL_WANTED]:
        words[HEAD] = words[IDLE_FROM] = words[TAIL]
        words[CANCEL_DONE] = words[CANCEL_WANTED]
    head = words[HEAD]
    if head < words[TAIL]:
        slot = head % len(buffers.inputs)
        words[RAW] = buffers.inputs[slot, RAW_DEMAND]
        words[CONTROL] = buffers.inputs[slot, CONTROL_WORD]
        words[COMMAND_CODE] = buffers.inputs[slot, COMMAND_FAULT]
        words[COMMAND_ARGUMENT] = buffers.inputs[slot, COMMAND_FAULT_ARGUMENT]
        words[SYNC_CODE] = buffers.inputs[slot, SYNC_FAULT]
        words[SYNC_ARGUMENT] = buffers.inputs[slot, SYNC_FAULT_ARGUMENT]
        words[DEAF] = buffers.inputs[slot, IS_DEAF]
        words[PLANT_FRAMES_LEFT], words[DRIVES_LEFT] = buffers.inputs[slot, PLANT_FRAMES], buffers.inputs[slot, DRIVES]
        words[POSITION], words[IS_HELD] = head, 0
        if head < words[OVERRIDE_LIMIT]:
            words[CONTROL] = words[OVERRIDE]
        words[HEAD] = head + 1
        return True
    if words[FINISH]:
        return False
    words[COMMAND_CODE] = words[SYNC_CODE] = SENT_NORMALLY
    words[DEAF] = words[PLANT_FRAMES_LEFT] = words[DRIVES_LEFT] = 0
    words[IS_HELD] = 1
    if head <= words[OVERRIDE_LIMIT] and words[OVERRIDE_LIMIT] > 0:
        words[CONTROL] = words[OVERRIDE]
    if _is_underrun(words):
        words[UNDERRUNS] += 1
    return True


def _is_underrun(words: NDArray[np.int64]) -> bool:
    """Whether the queue is empty where it should not be."""
    is_meant = words[HEAD] == words[IDLE_FROM] or words[HEAD] == words[MAY_IDLE_AT]
    return bool(words[IS_HELD]) and not is_meant


def _wait_until_due(port: Port, buffers: Buffers) -> int:
    """Sleep until shortly before SYNC is due, then watch the clock: the kernel's wake-up alone is 20 to 60 us late.

    On a single CPU the watch is left out unless all answers are in, for a node may need the CPU.
    """
    words = buffers.words
    status = _sleep_until(port, buffers, words[DUE] - words[SPIN])
    is_command_due = words[HELD] > 0 and buffers.held[0, 0] < words[DUE]
    if is_command_due or not (words[SPINS_ALWAYS] or words[SEEN] == ALL_CAME):
        return min(status, _sleep_until(port, buffers, words[DUE]))
    _end_work(port, words)
    while read_clock(port) < words[DUE]:
        pass
    _begin_work(port, words)
    return status


def _sleep_until(port: Port, buffers: Buffers, t_ns: int) -> int:
    """Sleep until `t_ns`, and send the late commands that are due before."""
    words, held = buffers.words, buffers.held
    status = DONE
    while status >= 0 and words[HELD] > 0 and held[0, 0] < t_ns:
        _end_work(port, words)
        sleep_until(port, held[0, 0])
        _begin_work(port, words)
        status = _send_first_held(port, buffers)
    _end_work(port, words)
    sleep_until(port, t_ns)
    _begin_work(port, words)
    return status


def _begin_work(port: Port, words: NDArray[np.int64]) -> None:
    words[AWAKE_SINCE] = read_clock(port)


def _end_work(port: Port, words: NDArray[np.int64]) -> None:
    words[WORKED] += read_clock(port) - words[AWAKE_SINCE]


def _send_command(port: Port, buffers: Buffers) -> int:
    """Send the command of the cycle to come as a fault leaves it; one that is to be late is sent later."""
    words = buffers.words
    code = words[COMMAND_CODE]
    if code in (DROP, DELAY):
        return DONE
    length, data = change_frame(code, words[COMMAND_ARGUMENT], 8, _pack_command(buffers))
    status = _send(port, buffers, codec.COMMAND, length, data)
    if code == DOUBLE and status >= 0:
        status = _send(port, buffers, codec.COMMAND, length, data)
    return status


def _pack_command(buffers: Buffers) -> int:
    words = buffers.words
    return join_words(words[RAW], words[CONTROL], words[CYCLES])


def _send_sync(port: Port, buffers: Buffers, due_ns: int, lost: int) -> int:
    """Send SYNC, which was due at `due_ns`, and open the row of its cycle; `lost` due times have passed since."""
    words = buffers.words
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    now = read_clock(port)
    late = now - due_ns
    if words[SYNC_CODE] == DELAY:  # a fault, and no lateness of the bench
        _end_work(port, words)
        sleep_until(port, words[DUE] + words[SYNC_ARGUMENT])
        _begin_work(port, words)
        now = read_clock(port)
    words[SYNC_AT] = now
    status = DONE
    if words[SYNC_CODE] != DROP:
        status = _send(port, buffers, codec.SYNC, 0, 0)
    if words[SYNC_CODE] == DOUBLE and status >= 0:
        status = _send(port, buffers, codec.SYNC, 0, 0)
    row[CYCLE], row[INPUT], row[INPUT_HELD] = words[CYCLES], words[POSITION], words[IS_HELD]
    row[WORD], row[DUE_AT], row[LATENESS] = words[CONTROL], words[DUE], late
    row[OVERRUN] = 1 if 2 * late > words[PERIOD] or _is_underrun(words) else 0
    words[OVERRUNS] += max(lost, row[OVERRUN])
    words[SEEN], words[OPEN] = 0, 1
    if words[COMMAND_CODE] == DELAY:
        _hold_command(buffers)
    return status


def _hold_command(buffers: Buffers) -> None:
    """Keep a late command until its time; those that are due at the same time stay in order."""
    words, held = buffers.words, buffers.held
    place = words[HELD]
    if place == len(held):
        words[LOST_RECORDS] += 1
        return
    due = words[DUE] + words[COMMAND_ARGUMENT]
    while place > 0 and held[place - 1, 0] > due:
        held[place, 0], held[place, 1] = held[place - 1, 0], held[place - 1, 1]
        place -= 1
    held[place, 0], held[place, 1] = due, _pack_command(buffers)
    words[HELD] += 1


def _send_first_held(port: Port, buffers: Buffers) -> int:
    words, held = buffers.words, buffers.held
    status = _send(port, buffers, codec.COMMAND, 8, held[0, 1])
    words[HELD] -= 1
    for place in range(words[HELD]):
        held[place, 0], held[place, 1] = held[place + 1, 0], held[place + 1, 1]
    return status


def _send(port: Port, buffers: Buffers, cob_id: int, length: int, data: int) -> int:
    """Send a frame and record it. A full transmit queue loses it, which the port counts."""
    if buffers.words[DRY]:
        return DONE
    _record_frame(buffers, read_clock(port), cob_id | length << 12 | 1 << 16, data)
    return min(send_frame(port, cob_id, length, data), DONE)


def _receive_waiting(port: Port, buffers: Buffers) -> int:
    """Take in the frames that are here, and none that comes meanwhile."""
    now = read_clock(port)
    status, came = FRAME, 0
    while status == FRAME and came < now:
        status, came, cob_id, length, data = receive_frame(port, 0)
        if status == FRAME:
            _accept_frame(buffers, came, cob_id, length, data)
    return min(status, DONE)


def _accept_frame(buffers: Buffers, t_ns: int, cob_id: int, length: int, data: int) -> None:
    """Record a frame that came, and put its values into the row of the cycle under way."""
    words = buffers.words
    if words[DEAF]:
        return
    _record_frame(buffers, t_ns, cob_id | length << 12, data)
    if not words[OPEN]:
        return
    if cob_id == codec.DRIVE:
        words[DRIVES_LEFT] -= 1
    elif cob_id == codec.FEEDBACK or cob_id == codec.VALVE_STATE:
        words[PLANT_FRAMES_LEFT] -= 1
    if length != 8:
        return
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    seen = words[SEEN]
    since_sync = t_ns - words[SYNC_AT]
    if cob_id == codec.FEEDBACK and not seen & XJ_CAME:
        row[XJ], row[P12] = split_halves(data)
        row[FEEDBACK_AT] = since_sync
        words[SEEN] |= XJ_CAME
    elif cob_id == codec.VALVE_STATE or cob_id == codec.DRIVE:
        value, state, cycle = split_words(data)
        if cycle != row[CYCLE] & 0xFFFF:
            return
        if cob_id == codec.VALVE_STATE:
            row[XS], row[FLAGS] = value, state
            if not seen & XS_CAME:
                row[VALVE_AT] = since_sync
            words[SEEN] |= XS_CAME
        else:  # of several the last: the plant latches that one
            row[COR], row[STATUS] = value, state
            if not seen & COR_CAME:
                row[DRIVE_AT] = since_sync
            words[SEEN] |= COR_CAME
    if words[SEEN] == ALL_CAME and seen != ALL_CAME:
        row[COMPLETE_AT] = since_sync


def _record_frame(buffers: Buffers, t_ns: int, head: int, data: int) -> None:
    words, frames = buffers.words, buffers.frames
    if words[FRAMES_WRITTEN] - words[FRAMES_READ] >= len(frames):
        words[LOST_RECORDS] += 1
        return
    frame = frames[words[FRAMES_WRITTEN] % len(frames)]
    frame[TIME], frame[FRAME_HEAD], frame[DATA] = t_ns, head, data
    words[FRAMES_WRITTEN] += 1


def _complete_row(buffers: Buffers) -> None:
    """Complete the row of the cycle under way."""
    words = buffers.words
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    row[ANSWERS], row[EXECUTION] = words[SEEN], words[WORKED]
    words[WORKED] = 0


def _hand_over_row(buffers: Buffers) -> None:
    """Hand the row of the cycle under way to Python, and the frames up to now."""
    words = buffers.words
    if words[OPEN]:
        if words[ROWS] + 1 - words[ROWS_READ] < len(buffers.rows):
            words[ROWS] += 1
        else:
            words[LOST_RECORDS] += 1
    words[OPEN] = 0
    words[FRAMES] = words[FRAMES_WRITTEN]
    words[COMPLETE_UNTIL] = words[DUE]
