"""The rig's cycle as compiled code: due time, frames, SYNC, collecting the answers. No Python object, no allocation.

`play_cycles` runs in a thread of its own without the interpreter lock until the queue is empty and the end is asked
for (hard_loop.py). `play_part` runs a part of a cycle for a loop that waits, sends and receives in Python (loop.py).
Both share their memory, `Buffers`, with Python, which writes the inputs of the cycles ahead and reads rows and frames
behind. Which frames there are and what lies where in them is data too: `Layout` (rig/benches/packing.py).

A frame whose values take effect with SYNC goes out before SYNC is due: on a real bus a frame of 8 bytes takes 135 us at
1 Mbit/s and would delay the SYNC behind it. The others follow the SYNC. Where the plant is no node of its own, this
loop moves it as the emulator does: what the controller answers to cycle k acts from cycle k+1. Times are those of
CLOCK_MONOTONIC, ns.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import keep_apart
from rig.benches import (
    ACCEPTED,
    ALL_ROLES,
    CAME_WITH,
    COMMAND,
    DRIVE,
    EVERY,
    FEEDBACK,
    FRAME_WORDS,
    FRAMES,
    FRAMES_AT,
    IS_ANSWER,
    IS_BEFORE_SYNC,
    IS_MINE,
    IS_NUMBERED,
    LAST_CYCLE,
    LENGTH,
    OTHER_CYCLE,
    OWED,
    PAYLOAD,
    ROLES,
    SENT_AS,
    STATUS,
    VALUES_AT,
    VALVE,
    Layout,
    find_frame,
    pack_frame,
    unpack_frame,
)
from rig.network import (
    FRAME,
    PAYLOAD_IN,
    PAYLOAD_OUT,
    Port,
    read_clock,
    receive_frame,
    send_payload,
    sleep_until,
)
from rig.nodes import (
    CURRENT_ZEROED,
    DRIVE_LATE,
    DRIVE_MISSING,
    FEEDBACK_FRAME,
    IN_FORCE,
    READINGS_AT,
    SENSORS,
    Memory,
    advance_plant,
    find_action,
    find_drive_action,
    read_plant,
)
from rig.sequences import DELAY, DOUBLE, DROP, change_frame

# Words that Python writes; the cycle sets CANCEL back
(PERIOD, LEAD, SPIN, SPINS_ALWAYS, TAIL, CANCEL, OVERRIDE_LIMIT, FINISH, FRAMES_READ, ROWS_READ, MAY_IDLE_AT,
 SYNC_ID, MOVES_PLANT, MISSED_LIMIT, SLACK, DRIVEN, SENT_CHANNELS, SENSED_AT, DRIVE_VALUE_AT, FLAGS_AT) = range(20)
# Words that the cycle writes; DUE is set by Python before the start. FAILURE is the status of a bus that failed
(DUE, HEAD, CYCLES, OVERRUNS, UNDERRUNS, ROWS, FRAMES_DONE, COMPLETE_UNTIL, FAILURE, DIVERGED) = range(24, 34)
# Words of the cycle alone; from COUNTED on the input under way, column by column
(OPEN, SYNC_AT, CAME, AWAITED, HELD, FRAMES_WRITTEN, AWAKE_SINCE, WORKED, POSITION, IS_HELD, IS_UNDERRUN, ROW_CYCLE,
 IS_LATE, DRIVES_MISSED, HAS_BEGUN, COUNTED, COMMAND_CODE, COMMAND_ARGUMENT, SYNC_CODE, SYNC_ARGUMENT,
 DEAF) = range(40, 61)
PLAYED = 61  # cycles so far
# Words of a loop in Python: the part of a cycle to play, and what it needs; time, identifier and length of a frame
PART, ARGUMENT, CAME_AT, CAME_AS, CAME_LENGTH = range(62, 67)
WORDS = 72
# Parts of a cycle. END: the row of the cycle before is complete. FIRST: an input, and the frames before SYNC. SYNC and
# what follows it; argument: its lateness, ns. ANSWER: a frame came; time since SYNC, ns. LATE: the frames that faults
# delay, up to a time.
END, FIRST, SYNC, ANSWER, LATE = range(5)
# Columns of an input: whether the cycle counts (before the run the controller is enabled in cycles that do not, and
# the plant stays where it is); code and argument of the faults of command and SYNC (change_frame); whether the rig
# receives nothing, by a fault
INPUT_COLUMNS = DEAF + 1 - COUNTED
# Columns of a row
(CYCLE, INPUT, INPUT_HELD, IS_COUNTED, DUE_AT, LATENESS, OVERRUN, ANSWERS, FEEDBACK_AT, VALVE_AT, DRIVE_AT,
 COMPLETE_AT, EXECUTION) = range(13)
COLUMNS = 13
# Columns of a frame; its head is identifier | length << 32 | sent by the rig << 40. Payload words follow DATA
TIME, FRAME_HEAD, DATA = range(3)
# Columns of a frame that waits: when it is due, its place in the layout, its length and 8 words of payload
HELD_DUE, _HELD_PLACE, _HELD_LENGTH, _HELD_DATA = range(4)
HELD_COLUMNS = _HELD_DATA + 8
_MOST_OWED = 2  # frames of an answer: jitter owes one, a clock that drifts another


class Buffers(NamedTuple):
    """Memory shared by the cycle and Python: single words, and rings of which word n is at n modulo the length."""

    words: NDArray[np.int64]
    inputs: NDArray[np.int64]  # (cycles ahead, INPUT_COLUMNS)
    settings: NDArray[np.float64]  # (cycles ahead + 1, values that Python gives, SI); the last row: of the safe state
    rows: NDArray[np.int64]  # (cycles, COLUMNS)
    values: NDArray[np.float64]  # (cycles, channels of the layout), SI
    frames: NDArray[np.int64]  # (frames, 3, or 10 where a payload may have 64 bytes)
    held: NDArray[np.int64]  # (late frames, HELD_COLUMNS), the earliest first


def make_buffers(ahead: int, rows: int, frames: int, late_frames: int, settings: int, channels: int,
                 is_fd: bool) -> Buffers:
    """Empty buffers for that many entries each, in memory that is already mapped."""
    columns = DATA + 8 if is_fd else DATA + 1
    # unlike zeros it touches every page
    return Buffers(np.full(WORDS, 0, np.int64), np.full((ahead, INPUT_COLUMNS), 0, np.int64),
                   np.full((ahead + 1, settings), np.nan), np.full((rows, COLUMNS), 0, np.int64),
                   np.full((rows, channels), np.nan), np.full((frames, columns), 0, np.int64),
                   np.full((late_frames, HELD_COLUMNS), 0, np.int64))


def play_cycles(port: Port, buffers: Buffers, m: Layout, plant: Memory) -> None:
    """Play the queue at its due times until FINISH, or until the bus fails (FAILURE).

    Due times are a fixed grid. A SYNC that is late by whole periods drops the due times it has missed, and counts them.
    An empty queue repeats the last input.
    """
    words = buffers.words
    while True:
        # Asleep while the answers come: the kernel notes their times, and nobody waits for the rig to read them.
        _sleep_until(port, buffers, m, words[DUE] - words[LEAD])
        _receive_waiting(port, buffers, m, plant)
        is_end = not _take_input(buffers)
        if not is_end:
            _send_frames(port, buffers, m, plant, True)
        _wait_until_due(port, buffers, m)
        _receive_waiting(port, buffers, m, plant)
        _end_work(port, words)
        _close_row(port, buffers, m)
        if is_end or words[FAILURE]:
            return
        _begin_cycle(port, buffers, m, plant, read_clock(port) - words[DUE])


def play_part(port: Port, buffers: Buffers, m: Layout, plant: Memory) -> None:
    """Play the part of a cycle that Python asks for. An answer stands in the port, with zeros up to 8 bytes."""
    words = buffers.words
    part, argument = words[PART], words[ARGUMENT]
    if part == END:
        _close_row(port, buffers, m)
    elif part == FIRST:
        _take_input(buffers)
        _send_frames(port, buffers, m, plant, True)
    elif part == SYNC:
        _begin_cycle(port, buffers, m, plant, argument)
    elif part == ANSWER:
        frame = FRAME, words[CAME_AT], words[CAME_AS], words[CAME_LENGTH], port.words[PAYLOAD_IN // 8]
        _accept_frame(port, buffers, m, plant, frame, argument)
    else:
        while words[HELD] > 0 and buffers.held[0, HELD_DUE] < argument:
            _release_first_held(port, buffers, m)


def is_complete(words: NDArray[np.int64]) -> bool:
    """Whether each answer that is sure to come has come."""
    return bool(words[CAME] & words[AWAITED] == words[AWAITED])


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
        for i in range(INPUT_COLUMNS):  # by `_copy` it took 80 ns more
            words[COUNTED + i] = buffers.inputs[head % len(buffers.inputs), i]
        words[POSITION] = head
        words[HEAD] = head + 1
    elif words[FINISH]:
        return False
    else:
        for i in range(COMMAND_CODE, COUNTED + INPUT_COLUMNS):
            words[i] = 0  # no fault
        words[UNDERRUNS] += words[IS_UNDERRUN]
    return True


def _set_values(buffers: Buffers, m: Layout) -> None:
    """Give the layout the values of the input under way, or of the safe state where that has been asked for."""
    words, settings = buffers.words, buffers.settings
    last = len(settings) - 1
    for i in range(words[DRIVEN]):
        value = settings[words[POSITION] % last, i]
        if words[POSITION] < words[OVERRIDE_LIMIT] and not np.isnan(settings[last, i]):
            value = settings[last, i]
        m.doubles[m.words[VALUES_AT] + i] = value


def _wait_until_due(port: Port, buffers: Buffers, m: Layout) -> None:
    """Sleep until shortly before SYNC is due, then watch the clock: the kernel's wake-up alone is 20 to 60 us late.

    On a single CPU the watch is left out unless all answers are in, for a node may need the CPU.
    """
    words = buffers.words
    _sleep_until(port, buffers, m, words[DUE] - words[SPIN])
    is_frame_due = words[HELD] > 0 and buffers.held[0, HELD_DUE] < words[DUE]
    if is_frame_due or not (words[SPINS_ALWAYS] or is_complete(words)):
        _sleep_until(port, buffers, m, words[DUE])
        return
    _end_work(port, words)
    while read_clock(port) < words[DUE]:
        pass
    _begin_work(port, words)


@keep_apart
def _sleep_until(port: Port, buffers: Buffers, m: Layout, t_ns: int) -> None:
    """Sleep until `t_ns`, and send the late frames that are due before."""
    words, late_frames = buffers.words, buffers.held
    while words[HELD] > 0 and late_frames[0, HELD_DUE] < t_ns:
        _pause_until(port, words, late_frames[0, HELD_DUE])
        _release_first_held(port, buffers, m)
    _pause_until(port, words, t_ns)


def _pause_until(port: Port, words: NDArray[np.int64], t_ns: int) -> None:
    _end_work(port, words)
    sleep_until(port, t_ns)
    _begin_work(port, words)


def _begin_work(port: Port, words: NDArray[np.int64]) -> None:
    words[AWAKE_SINCE] = read_clock(port)


def _end_work(port: Port, words: NDArray[np.int64]) -> None:
    words[WORKED] += read_clock(port) - words[AWAKE_SINCE]


# ---------------------------------------------------------------------------------------- frames out


@keep_apart
def _send_frames(port: Port, buffers: Buffers, m: Layout, plant: Memory, is_before_sync: bool) -> None:
    """Send the frames of the cycle to come that go before SYNC, or those that follow it."""
    words = buffers.words
    if is_before_sync:
        _set_values(buffers, m)
        if words[MOVES_PLANT]:
            _read_transducers(buffers, m, plant)
    for number in range(m.words[FRAMES]):
        at = FRAMES_AT + FRAME_WORDS * number
        is_due = words[PLAYED] % m.words[at + EVERY] == 0
        if m.words[at + IS_MINE] and is_due and m.words[at + IS_BEFORE_SYNC] == is_before_sync:
            pack_frame(m, at, words[CYCLES])
            _send_as_fault_leaves_it(port, buffers, m, plant, at)


def _send_as_fault_leaves_it(port: Port, buffers: Buffers, m: Layout, plant: Memory, at: int) -> None:
    """Send the frame in the payload; a fault of command or feedback may change, double, delay or drop it."""
    words = buffers.words
    code, argument = words[COMMAND_CODE], words[COMMAND_ARGUMENT]
    if not m.words[at + ROLES] & COMMAND:
        code, argument = 0, 0
    if code == 0 and words[MOVES_PLANT] and m.words[at + ROLES] & FEEDBACK:
        code, argument = find_action(plant, FEEDBACK_FRAME, words[CYCLES])
    length = m.words[at + LENGTH]
    if code == DELAY:
        _hold_frame(buffers, m, at, words[DUE] + argument, length)
    elif code != DROP:
        length, m.words[PAYLOAD] = change_frame(code, argument, length, m.words[PAYLOAD])
        _send(port, buffers, m, m.words[at + SENT_AS], length, 2 if code == DOUBLE else 1)


def _hold_frame(buffers: Buffers, m: Layout, at: int, due: int, length: int) -> None:
    """Keep the frame in the payload until its time; those that are due at the same time stay in order."""
    words, late_frames = buffers.words, buffers.held
    place = words[HELD]
    if place == len(late_frames):
        return
    while place > 0 and late_frames[place - 1, HELD_DUE] > due:
        _copy(late_frames[place - 1], 0, late_frames[place], 0, HELD_COLUMNS)
        place -= 1
    late_frames[place, HELD_DUE], late_frames[place, _HELD_PLACE], late_frames[place, _HELD_LENGTH] = due, at, length
    _copy(m.words, PAYLOAD, late_frames[place], _HELD_DATA, 8)
    words[HELD] += 1


def _copy(source: NDArray[np.int64], first: int, target: NDArray[np.int64], place: int, count: int) -> None:
    """Copy so many words; one by one, because the assignment of a slice may allocate."""
    for i in range(count):
        target[place + i] = source[first + i]


@keep_apart
def _release_first_held(port: Port, buffers: Buffers, m: Layout) -> None:
    """Send the frame that has waited; one of the controller is received now."""
    words, late_frames = buffers.words, buffers.held
    at, length = late_frames[0, _HELD_PLACE], late_frames[0, _HELD_LENGTH]
    _copy(late_frames[0], _HELD_DATA, m.words, PAYLOAD, 8)
    words[HELD] -= 1
    for place in range(words[HELD]):
        _copy(late_frames[place + 1], 0, late_frames[place], 0, HELD_COLUMNS)
    if m.words[at + IS_MINE]:
        _send(port, buffers, m, m.words[at + SENT_AS], length, 1)
    else:
        _keep_answer(buffers, m, at, length, read_clock(port) - words[SYNC_AT])


@keep_apart
def _send(port: Port, buffers: Buffers, m: Layout, identifier: int, length: int, count: int) -> None:
    """Send the payload so many times and record it. A full transmit queue loses it."""
    words = buffers.words
    for _ in range(count):
        if not words[FAILURE]:
            _record_frame(buffers, m, read_clock(port), identifier | length << 32 | 1 << 40)
            _copy(m.words, PAYLOAD, port.words, PAYLOAD_OUT // 8, 8)
            words[FAILURE] = min(send_payload(port, identifier, length), 0)


# ---------------------------------------------------------------------------------------- the cycle


@keep_apart
def _begin_cycle(port: Port, buffers: Buffers, m: Layout, plant: Memory, late: int) -> None:
    """Send SYNC, which is `late` by so many ns, open the row of its cycle, send what follows SYNC, move the plant.

    Due times that have passed are lost.
    """
    words = buffers.words
    late_periods = late // words[PERIOD]
    words[DUE] += late_periods * words[PERIOD]
    if words[SYNC_CODE] == DELAY:  # a fault, and no lateness of the bench
        _pause_until(port, words, words[DUE] + words[SYNC_ARGUMENT])
    words[SYNC_AT] = read_clock(port)
    if words[SYNC_ID] >= 0 and words[SYNC_CODE] != DROP:
        m.words[PAYLOAD] = 0
        _send(port, buffers, m, words[SYNC_ID], 0, 2 if words[SYNC_CODE] == DOUBLE else 1)
    if words[MOVES_PLANT]:
        m.doubles[m.words[VALUES_AT] + words[FLAGS_AT]] = _judge_drive(buffers, m, plant)
    _open_row(buffers, m, late)
    _send_frames(port, buffers, m, plant, False)
    _copy_values(buffers, m, words[DRIVEN], words[SENT_CHANNELS])
    words[OVERRUNS] += max(late_periods, buffers.rows[words[ROWS] % len(buffers.rows), OVERRUN])
    if words[MOVES_PLANT] and words[COUNTED] and not words[DIVERGED]:
        if words[CYCLES] == 0:  # the plant rests until the run begins: no answer from before drives it
            plant.reals[IN_FORCE] = 0.0
        advance_plant(plant, words[CYCLES])
    words[CYCLES] += words[COUNTED]
    words[PLAYED] += 1
    words[DUE] += words[PERIOD]


def _open_row(buffers: Buffers, m: Layout, late: int) -> None:
    words = buffers.words
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    row[CYCLE], row[INPUT], row[INPUT_HELD] = words[CYCLES], words[POSITION], words[IS_HELD]
    row[IS_COUNTED], row[DUE_AT], row[LATENESS] = words[COUNTED], words[DUE], late
    row[OVERRUN] = 1 if 2 * late > words[PERIOD] or words[IS_UNDERRUN] else 0
    row[FEEDBACK_AT], row[VALVE_AT], row[DRIVE_AT], row[COMPLETE_AT] = 0, 0, 0, 0
    _copy_values(buffers, m, 0, words[DRIVEN])
    words[OPEN], words[ROW_CYCLE] = 1, words[CYCLES]
    _expect_answers(buffers, m)


def _copy_values(buffers: Buffers, m: Layout, first: int, last: int) -> None:
    """Put these values into the row of the cycle under way."""
    number = buffers.words[ROWS] % len(buffers.rows)
    for i in range(first, last):
        buffers.values[number, i] = m.doubles[m.words[VALUES_AT] + i]


def _expect_answers(buffers: Buffers, m: Layout) -> None:
    """Which answers are sure to come in this cycle, and which values of earlier frames still count.

    An answer may slip into the next cycle only as long as it does: frames that never come are owed.
    """
    words = buffers.words
    words[CAME], words[AWAITED], words[IS_LATE] = 0, 0, 0
    if words[MOVES_PLANT]:
        words[CAME] = FEEDBACK | VALVE
    if words[SYNC_CODE] == DROP and words[SYNC_ID] >= 0:
        return
    for number in range(m.words[FRAMES]):
        at = FRAMES_AT + FRAME_WORDS * number
        if m.words[at + IS_MINE]:
            continue
        age = words[HAS_BEGUN] - m.words[at + LAST_CYCLE]
        slack = words[MISSED_LIMIT]
        if m.words[at + IS_ANSWER]:
            slack = words[SLACK] if m.words[at + OWED] < _MOST_OWED else 0
            if m.words[at + LAST_CYCLE] >= 0 and age == m.words[at + EVERY] + 1:
                m.words[at + OWED] += slack
        if m.words[at + LAST_CYCLE] >= 0 and age < m.words[at + EVERY] + slack:
            words[CAME] |= m.words[at + ROLES]
        elif m.words[at + IS_ANSWER] and age >= m.words[at + EVERY]:
            words[AWAITED] |= m.words[at + ROLES] & ~ALL_ROLES
    words[HAS_BEGUN] += 1


def _read_transducers(buffers: Buffers, m: Layout, plant: Memory) -> None:
    """The readings of the cycle to come; a plant that has diverged keeps the last."""
    words = buffers.words
    if not read_plant(plant, words[CYCLES]):
        words[DIVERGED] = 1
    if not words[DIVERGED]:
        at = m.words[VALUES_AT] + words[SENSED_AT]
        for i in range(plant.words[SENSORS]):
            m.doubles[at + i] = plant.reals[plant.words[READINGS_AT] + i]


def _judge_drive(buffers: Buffers, m: Layout, plant: Memory) -> int:
    """Flags of this cycle and the current until the next one: the answer to the last cycle, or none after three."""
    words = buffers.words
    if not words[HAS_BEGUN]:
        return 0
    if words[CAME] & DRIVE:
        plant.reals[IN_FORCE] = m.doubles[m.words[VALUES_AT] + words[DRIVE_VALUE_AT]]
        words[DRIVES_MISSED] = 0
        return 0
    words[DRIVES_MISSED] += 1
    flags = DRIVE_LATE if words[IS_LATE] else DRIVE_MISSING
    if words[DRIVES_MISSED] >= words[MISSED_LIMIT]:
        plant.reals[IN_FORCE] = 0.0
        flags |= CURRENT_ZEROED
    return flags


# ---------------------------------------------------------------------------------------- frames in


@keep_apart
def _receive_waiting(port: Port, buffers: Buffers, m: Layout, plant: Memory) -> None:
    """Take in the frames that are here, and none that comes meanwhile."""
    now, came = read_clock(port), 0
    while came < now and not buffers.words[FAILURE]:  # the port keeps the reason of the failure
        frame = receive_frame(port, 0)
        _accept_frame(port, buffers, m, plant, frame, frame[1] - buffers.words[SYNC_AT])
        came = frame[1] if frame[0] == FRAME else now


@keep_apart
def _accept_frame(port: Port, buffers: Buffers, m: Layout, plant: Memory,
                  frame: tuple[int, int, int, int, int], since_sync: int) -> None:
    """Record what `receive_frame` gave, and put the values of an answer into the row of the cycle under way."""
    words = buffers.words
    status, t_ns, identifier, length, data = frame
    if status < 0:
        words[FAILURE] = status
    if status != FRAME or words[DEAF]:
        return
    for i in range(8):
        m.words[PAYLOAD + i] = 0
    m.words[PAYLOAD] = data
    for i in range(8, length):
        m.octets[8 * PAYLOAD + i] = port.octets[PAYLOAD_IN + i]
    _record_frame(buffers, m, t_ns, identifier | length << 32)
    at = find_frame(m, identifier)
    if at < 0 or m.words[at + IS_MINE] or not words[OPEN]:
        return
    if m.words[at + ROLES] & DRIVE and words[MOVES_PLANT]:
        code, argument = find_drive_action(plant, words[ROW_CYCLE])
        if code == DELAY:
            _hold_frame(buffers, m, at, t_ns + argument, length)
        if code in (DELAY, DROP):
            return
        length, m.words[PAYLOAD] = change_frame(code, argument, length, m.words[PAYLOAD])
    _keep_answer(buffers, m, at, length, since_sync)


@keep_apart
def _keep_answer(buffers: Buffers, m: Layout, at: int, length: int, since_sync: int) -> None:
    """Unpack the payload; of frames with the number of their cycle the last counts, of others the first."""
    words = buffers.words
    roles = m.words[at + ROLES]
    is_first = m.words[at + LAST_CYCLE] != words[HAS_BEGUN] - 1
    if words[HAS_BEGUN] - 1 - m.words[at + LAST_CYCLE] < m.words[at + EVERY] and m.words[at + OWED] >= 0:
        m.words[at + OWED] -= 1
    if not (m.words[at + IS_NUMBERED] or is_first or roles & DRIVE):
        return
    status = unpack_frame(m, at, length, words[ROW_CYCLE])
    m.words[at + STATUS], m.words[at + CAME_WITH] = status, length
    if status == OTHER_CYCLE and roles & DRIVE:
        words[IS_LATE] = 1
    if status != ACCEPTED:
        return
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    for i in range(3):
        if is_first and roles & FEEDBACK << i:
            row[FEEDBACK_AT + i] = since_sync
    m.words[at + LAST_CYCLE] = words[HAS_BEGUN] - 1
    words[CAME] |= roles
    if is_first and is_complete(words) and not row[COMPLETE_AT]:
        row[COMPLETE_AT] = since_sync


def _record_frame(buffers: Buffers, m: Layout, t_ns: int, head: int) -> None:
    words, frames = buffers.words, buffers.frames
    if words[FRAMES_WRITTEN] - words[FRAMES_READ] < len(frames):
        frame = frames[words[FRAMES_WRITTEN] % len(frames)]
        frame[TIME], frame[FRAME_HEAD] = t_ns, head
        _copy(m.words, PAYLOAD, frame, DATA, frames.shape[1] - DATA)
        words[FRAMES_WRITTEN] += 1


def _close_row(port: Port, buffers: Buffers, m: Layout) -> None:
    """Complete the row of the cycle under way and hand it to Python, with the frames up to now."""
    words = buffers.words
    row = buffers.rows[words[ROWS] % len(buffers.rows)]
    row[ANSWERS], row[EXECUTION] = words[CAME], words[WORKED]
    _copy_values(buffers, m, words[SENT_CHANNELS], buffers.values.shape[1])
    words[WORKED] = 0
    # The compiler cannot see into a library call: the row is in memory before the counts say that it is there.
    _begin_work(port, words)
    if words[OPEN] and words[ROWS] + 1 - words[ROWS_READ] < len(buffers.rows):
        words[ROWS] += 1
    words[OPEN] = 0
    words[FRAMES_DONE] = words[FRAMES_WRITTEN]
    words[COMPLETE_UNTIL] = words[DUE]
