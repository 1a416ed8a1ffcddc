"""The rig's cycle as compiled code: due time, command, SYNC, collecting the answers. No Python object, no allocation.

`play_cycles_in_real_time` runs in a thread of its own without the interpreter lock until the queue is empty and the
end is asked for; `play_cycle_in_lockstep` plays one cycle a call. Both share their memory, `Buffers`, with Python
(hard_loop.py): Python writes the inputs of the cycles ahead and reads rows and frames behind.

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
from rig.sequences.faults import DELAY, DOUBLE, DROP, change_frame

DONE, WAITING = 0, 1  # what `play_cycle_in_lockstep` returns
FEEDBACK_CAME, VALVE_CAME, DRIVE_CAME = 1, 2, 4  # bits of ANSWERS, in the order of _ANSWERS
ALL_CAME = FEEDBACK_CAME | VALVE_CAME | DRIVE_CAME
_ANSWERS = (codec.FEEDBACK, codec.VALVE_STATE, codec.DRIVE)

# Words that Python writes; the cycle sets CANCEL back
(PERIOD, LEAD, SPIN, SPINS_ALWAYS, GRACE, TAIL, CANCEL, OVERRIDE, OVERRIDE_LIMIT, FINISH, DRY, FRAMES_READ, ROWS_READ,
 MAY_IDLE_AT) = range(14)
# Words that the cycle writes; DUE is set by Python before the start. FAILURE is the status of a bus that failed
(DUE, HEAD, CYCLES, OVERRUNS, UNDERRUNS, ROWS, FRAMES, COMPLETE_UNTIL, FAILURE) = range(16, 25)
# Words of the cycle alone; from RAW on the input under way, column by column
(OPEN, SYNC_AT, SEEN, STAGE, ANSWER_LIMIT, MISSED, HELD, FRAMES_WRITTEN, AWAKE_SINCE, WORKED, POSITION, IS_HELD,
 IS_UNDERRUN, RAW, CONTROL, COMMAND_CODE, COMMAND_ARGUMENT, SYNC_CODE, SYNC_ARGUMENT, DEAF, PLANT_FRAMES_LEFT,
 DRIVES_LEFT) = range(32, 54)
WORDS = 64
# Columns of an input: raw demand, control word; code and argument of the faults of command and SYNC (change_frame);
# whether the rig receives nothing, by a fault; in lockstep how many frames of the plant and how many drives are to be
# awaited (0: until each answer has come)
INPUT_COLUMNS = DRIVES_LEFT + 1 - RAW
# Columns of a row; from FEEDBACK_AT and XJ on in the order of _ANSWERS
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
    shapes = (WORDS, (ahead, INPUT_COLUMNS), (rows, COLUMNS), (frames, 3), (held, 2))
    return Buffers(*(np.full(shape, 0, np.int64) for shape in shapes))  # unlike zeros it touches every page


def play_cycles_in_real_time(port: Port, buffers: Buffers) -> None:
    """Play the queue at its due times until FINISH, or until the bus fails (FAILURE).

    Due times are a fixed grid. A SYNC that is late by whole periods drops the due times it has missed, and counts them.
    An empty queue repeats the last input.
    """
    words = buffers.words
    while True:
        # Asleep while the answers come: the kernel notes their times, and nobody waits for the rig to read them.
        _sleep_until(port, buffers, words[DUE] - words[LEAD])
        _receive_waiting(port, buffers)
        is_end = not _take_input(buffers)
        if not is_end:
            _send_command(port, buffers)
        _wait_until_due(port, buffers)
        _receive_waiting(port, buffers)
        _end_work(port, words)
        _close_row(port, buffers)
        if is_end or words[FAILURE]:
            return
        _send_sync(port, buffers, read_clock(port) - words[DUE])


def play_cycle_in_lockstep(port: Port, buffers: Buffers, until_ns: int) -> int:
    """Play one cycle: DONE when its answers are in, the time for them has passed or the bus has failed (FAILURE);
    WAITING at `until_ns`, to be called again.
    """
    words = buffers.words
    if words[STAGE] == DONE:
        _begin_work(port, words)
        _take_input(buffers)
        _send_command(port, buffers)
        _send_sync(port, buffers, 0)
        grace = words[GRACE] if words[MISSED] < _PATIENCE else words[GRACE] // 10
        words[ANSWER_LIMIT] = words[SYNC_AT] + grace
        words[STAGE] = WAITING
        _end_work(port, words)
    while not words[FAILURE] and (words[SEEN] != ALL_CAME or words[PLANT_FRAMES_LEFT] > 0 or words[DRIVES_LEFT] > 0):
        if words[ANSWER_LIMIT] - words[SYNC_AT] >= _LONG_WAIT:
            frame = await_frame(port)
        else:
            frame = receive_frame(port, min(words[ANSWER_LIMIT], until_ns))
        _accept_frame(buffers, frame)
        if frame[0] != FRAME:
            if read_clock(port) >= _find_answer_limit(words):
                break
            return WAITING
    words[MISSED] = 0 if words[SEEN] == ALL_CAME else words[MISSED] + 1
    _receive_waiting(port, buffers)
    while words[HELD] > 0 and buffers.held[0, 0] < words[DUE]:
        _send_first_held(port, buffers)
    _close_row(port, buffers)
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
    if words[CANCEL]:
        words[HEAD] = words[TAIL]
        words[CANCEL] = 0
    head = words[HEAD]
    words[IS_HELD] = head == words[TAIL]
    words[IS_UNDERRUN] = words[IS_HELD] and head != words[MAY_IDLE_AT]
    if not words[IS_HELD]:
        words[RAW: RAW + INPUT_COLUMNS] = buffers.inputs[head % len(buffers.inputs)]
        words[POSITION] = head
        words[HEAD] = head + 1
    elif words[FINISH]:
        return False
    else:
        words[COMMAND_CODE: RAW + INPUT_COLUMNS] = 0  # no fault
        words[UNDERRUNS] += words[IS_UNDERRUN]
    if words[POSITION] < words[OVERRIDE_LIMIT]:
        words[CONTROL] = words[OVERRIDE]
    return True


def _wait_until_due(port: Port, buffers: Buffers) -> None:
    """Sleep until shortly before SYNC is due, then watch the clock: the kernel's wake-up alone is 20 to 60 us late.

    On a single CPU the watch is left out unless all answers are in, for a node may need the CPU.
    """
    words = buffers.words
    _sleep_until(port, buffers, words[DUE] - words[SPIN])
    is_command_due = words[HELD] > 0 and buffers.held[0, 0] < words[DUE]
    if is_command_due or not (words[SPINS_ALWAYS] or words[SEEN] == ALL_CAME):
        _sleep_until(port, buffers, words[DUE])
        return
    _end_work(port, words)
    while read_clock(port) < words[DUE]:
        pass
    _begin_work(port, words)


def _sleep_until(port: Port, buffers: Buffers, t_ns: int) -> None:
    """Sleep until `t_ns`, and send the late commands that are due before."""
    words, held = buffers.words, buffers.held
    while words[HELD] > 0 and held[0, 0] < t_ns:
        _pause_until(port, words, held[0, 0])
        _send_first_held(port, buffers)
    _pause_until(port, words, t_ns)


def _pause_until(port: Port, words: NDArray[np.int64], t_ns: int) -> None:
    _end_work(port, words)
    sleep_until(port, t_ns)
    _begin_work(port, words)


def _begin_work(port: Port, words: NDArray[np.int64]) -> None:
    words[AWAKE_SINCE] = read_clock(port)


def _end_work(port: Port, words: NDArray[np.int64]) -> None:
    words[WORKED] += read_clock(port) - words[AWAKE_SINCE]


def _send_command(port: Port, buffers: Buffers) -> None:
    """Send the command of the cycle to come as a fault leaves it; one that is to be late is sent later."""
    words = buffers.words
    code = words[COMMAND_CODE]
    if code not in (DROP, DELAY):
        length, data = change_frame(code, words[COMMAND_ARGUMENT], 8, _pack_command(words))
        _send(port, buffers, codec.COMMAND, length, data, 2 if code == DOUBLE else 1)


def _pack_command(words: NDArray[np.int64]) -> int:
    return join_words(words[RAW], words[CONTROL], words[CYCLES])


def _send_sync(port: Port, buffers: Buffers, late: int) -> None:
    """Send SYNC, which is `late` by so many ns, and open the row of its cycle; due times that have passed are lost."""
    words = buffers.words
    lost = late // words[PERIOD]
    words[DUE] += lost * words[PERIOD]
    if words[SYNC_CODE] == DELAY:  # a fault, and no lateness of the bench
        _pause_until(port, words, words[DUE] + words[SYNC_ARGUMENT])
    words[SYNC_AT] = read_clock(port)
    if words[SYNC_CODE] != DROP:
        _send(port, buffers, codec.SYNC, 0, 0, 2 if words[SYNC_CODE] == DOUBLE else 1)
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    row[CYCLE], row[INPUT], row[INPUT_HELD] = words[CYCLES], words[POSITION], words[IS_HELD]
    row[WORD], row[DUE_AT], row[LATENESS] = words[CONTROL], words[DUE], late
    row[OVERRUN] = 1 if 2 * late > words[PERIOD] or words[IS_UNDERRUN] else 0
    words[OVERRUNS] += max(lost, row[OVERRUN])
    words[SEEN], words[OPEN] = 0, 1
    if words[COMMAND_CODE] == DELAY:
        _hold_command(buffers)
    words[CYCLES] += 1
    words[DUE] += words[PERIOD]


def _hold_command(buffers: Buffers) -> None:
    """Keep a late command until its time; those that are due at the same time stay in order."""
    words, held = buffers.words, buffers.held
    place = words[HELD]
    if place == len(held):
        return
    due = words[DUE] + words[COMMAND_ARGUMENT]
    while place > 0 and held[place - 1, 0] > due:
        held[place] = held[place - 1]
        place -= 1
    held[place, 0], held[place, 1] = due, _pack_command(words)
    words[HELD] += 1


def _send_first_held(port: Port, buffers: Buffers) -> None:
    words, held = buffers.words, buffers.held
    _send(port, buffers, codec.COMMAND, 8, held[0, 1], 1)
    words[HELD] -= 1
    for place in range(words[HELD]):
        held[place] = held[place + 1]


def _send(port: Port, buffers: Buffers, cob_id: int, length: int, data: int, count: int) -> None:
    """Send a frame so many times and record it. A full transmit queue loses it, which the port counts."""
    words = buffers.words
    for _ in range(count):
        if not (words[DRY] or words[FAILURE]):
            _record_frame(buffers, read_clock(port), cob_id | length << 12 | 1 << 16, data)
            words[FAILURE] = min(send_frame(port, cob_id, length, data), 0)


def _receive_waiting(port: Port, buffers: Buffers) -> None:
    """Take in the frames that are here, and none that comes meanwhile."""
    now, came = read_clock(port), 0
    while came < now and not buffers.words[FAILURE]:  # the port keeps the reason of the failure
        frame = receive_frame(port, 0)
        _accept_frame(buffers, frame)
        came = frame[1] if frame[0] == FRAME else now


def _accept_frame(buffers: Buffers, frame: tuple[int, int, int, int, int]) -> None:
    """Record what `receive_frame` gave, and put the values of an answer into the row of the cycle under way."""
    words = buffers.words
    status, t_ns, cob_id, length, data = frame
    if status < 0:
        words[FAILURE] = status
    if status != FRAME or words[DEAF]:
        return
    _record_frame(buffers, t_ns, cob_id | length << 12, data)
    for answer in range(len(_ANSWERS)):
        if _ANSWERS[answer] == cob_id and words[OPEN]:
            words[DRIVES_LEFT if cob_id == codec.DRIVE else PLANT_FRAMES_LEFT] -= 1
            if length == 8:
                _keep_answer(buffers, answer, t_ns - words[SYNC_AT], data)


def _keep_answer(buffers: Buffers, answer: int, since_sync: int, data: int) -> None:
    words = buffers.words
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    seen, came = words[SEEN], 1 << answer
    is_first = not seen & came
    if came == FEEDBACK_CAME:  # without the number of its cycle
        value, state = split_halves(data)
        is_valid = is_first
    else:  # of several the last: the plant latches that drive
        value, state, cycle = split_words(data)
        is_valid = cycle == row[CYCLE] & 0xFFFF
    if is_valid:
        row[XJ + 2 * answer], row[XJ + 2 * answer + 1] = value, state
        if is_first:
            row[FEEDBACK_AT + answer] = since_sync
        words[SEEN] |= came
        if words[SEEN] == ALL_CAME and seen != ALL_CAME:
            row[COMPLETE_AT] = since_sync


def _record_frame(buffers: Buffers, t_ns: int, head: int, data: int) -> None:
    words, frames = buffers.words, buffers.frames
    if words[FRAMES_WRITTEN] - words[FRAMES_READ] < len(frames):
        frame = frames[words[FRAMES_WRITTEN] % len(frames)]
        frame[TIME], frame[FRAME_HEAD], frame[DATA] = t_ns, head, data
        words[FRAMES_WRITTEN] += 1


def _close_row(port: Port, buffers: Buffers) -> None:
    """Complete the row of the cycle under way and hand it to Python, with the frames up to now."""
    words = buffers.words
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    row[ANSWERS], row[EXECUTION] = words[SEEN], words[WORKED]
    words[WORKED] = 0
    # The compiler cannot see into a library call: the row is in memory before the counts say that it is there.
    _begin_work(port, words)
    if words[OPEN] and words[ROWS] + 1 - words[ROWS_READ] < len(buffers.rows):
        words[ROWS] += 1
    words[OPEN] = 0
    words[FRAMES] = words[FRAMES_WRITTEN]
    words[COMPLETE_UNTIL] = words[DUE]
