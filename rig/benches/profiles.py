"""What control word and status word mean in a device profile: CiA 402 (drives) and CiA 408 (fluid power).

Both enable in steps, up a ladder of states. A step up is asked for only when the status word has confirmed the one
before; a step down may skip others. The functions take plain numbers, so that compiled loops can call them.
"""

from enum import IntEnum
from typing import NamedTuple


class State(IntEnum):
    """What a status word says, or a control word asks for. The first four are the ladder."""

    OFF = 0  # CiA 402: Switch on disabled; CiA 408: disabled
    READY = 1  # Ready to switch on; not disabled
    ON = 2  # Switched on; hold released
    ACTIVE = 3  # Operation enabled; device mode active: the loop is closed
    QUICK_STOP = 4  # Quick stop active
    NOT_READY = 5  # Not ready to switch on: the device initialises itself
    FAULT_REACTION = 6  # Fault reaction active
    FAULT = 7
    UNKNOWN = 8  # a status word that the profile does not have, or none yet


class ProfileWords(NamedTuple):
    """The words of a profile. `commands` and `states`: mask, value under this mask, `State`; the first match counts."""

    ladder: tuple[int, int, int, int]  # control words that ask for OFF, READY, ON and ACTIVE
    reset: int  # bit of the control word whose rising edge acknowledges a fault
    quick_stop: int  # control word that asks for QUICK_STOP; that of OFF where the profile has none
    commands: tuple[tuple[int, int, int], ...]  # of a control word; one that matches none asks for OFF
    states: tuple[tuple[int, int, int], ...]  # of a status word
    mask: int  # bits of the status word that say the state
    powered: int  # bit of the status word that says that current may flow
    is_confirmed: bool  # the next step up waits until the status word has confirmed the last one
    delay: float  # s: by then the status word has followed the control word, if the sequence says nothing else
    active: str  # name of the state ACTIVE


def _list_pairs(*rows: tuple[int, int, State]) -> tuple[tuple[int, int, int], ...]:
    return tuple((mask, value, int(state)) for mask, value, state in rows)


CIA402 = ProfileWords(  # IEC 61800-7-201 (CiA 402-2), state machine, tables of the control word and status word
    ladder=(0x00, 0x06, 0x07, 0x0F),  # Disable voltage, Shutdown, Switch on, Enable operation
    reset=0x80, quick_stop=0x02,
    commands=_list_pairs((0x82, 0x00, State.OFF), (0x86, 0x02, State.QUICK_STOP), (0x87, 0x06, State.READY),
                         (0x8F, 0x07, State.ON), (0x8F, 0x0F, State.ACTIVE)),
    states=_list_pairs((0x4F, 0x00, State.NOT_READY), (0x4F, 0x40, State.OFF), (0x6F, 0x21, State.READY),
                       (0x6F, 0x23, State.ON), (0x6F, 0x27, State.ACTIVE), (0x6F, 0x07, State.QUICK_STOP),
                       (0x4F, 0x0F, State.FAULT_REACTION), (0x4F, 0x08, State.FAULT)),
    mask=0x6F, powered=0x4, is_confirmed=True,
    delay=0.4,  # the standard has no limit; a drive may have a brake to release
    active="Operation enabled",
)
CIA408 = ProfileWords(  # docs/bus.md; the status word has the bits of the levels in force, and 0x8: no fault
    ladder=(0x0, 0x1, 0x3, 0x7),  # with one bit more each: not disabled, hold released, device mode active
    reset=0x8, quick_stop=0x0,
    commands=_list_pairs((0x7, 0x1, State.READY), (0x7, 0x3, State.ON), (0x7, 0x7, State.ACTIVE)),
    states=_list_pairs((0xF, 0x8, State.OFF), (0xF, 0x9, State.READY), (0xF, 0xB, State.ON), (0xF, 0xF, State.ACTIVE),
                       (0x8, 0x0, State.FAULT)),
    mask=0xF, powered=0x4, is_confirmed=False, delay=2e-3, active="ACTIVE",
)
# No control word: the rig's own word of a cycle says whether the fields that enable the controller do so (bit 0), and
# whether the values of the phase are sent (bit 1) or those of the safe state.
NO_WORDS = ProfileWords(
    ladder=(0, 2, 2, 3), reset=0, quick_stop=0, commands=_list_pairs((0x1, 0x1, State.ACTIVE)),
    states=_list_pairs((0, 0, State.ACTIVE)), mask=0, powered=0, is_confirmed=True, delay=10e-3, active="enabled",
)
PROFILES = {"cia402": CIA402, "cia408": CIA408, "none": NO_WORDS}

# Transitions of CiA 402 by number: state before, state after, and the state that the control word asks for. Automatic
# ones, after initialisation and in a fault, happen under any control word; 15 needs a rising edge of `reset`.
TRANSITIONS: dict[int, tuple[State, State, State | None]] = {
    1: (State.NOT_READY, State.OFF, None),
    2: (State.OFF, State.READY, State.READY),
    3: (State.READY, State.ON, State.ON),
    4: (State.ON, State.ACTIVE, State.ACTIVE),
    5: (State.ACTIVE, State.ON, State.ON),
    6: (State.ON, State.READY, State.READY),
    7: (State.READY, State.OFF, State.OFF),
    8: (State.ACTIVE, State.READY, State.READY),
    9: (State.ACTIVE, State.OFF, State.OFF),
    10: (State.ON, State.OFF, State.OFF),
    11: (State.ACTIVE, State.QUICK_STOP, State.QUICK_STOP),
    12: (State.QUICK_STOP, State.OFF, State.OFF),
    14: (State.FAULT_REACTION, State.FAULT, None),
    15: (State.FAULT, State.OFF, State.FAULT),
    16: (State.QUICK_STOP, State.ACTIVE, State.ACTIVE),
}  # 0 is power on; 13 leads from any state to FAULT_REACTION


def match_word(rows: tuple[tuple[int, int, int], ...], word: int, otherwise: int) -> int:
    """The state of the first row (mask, value, state) that a word matches; `otherwise` if there is none."""
    for mask, value, state in rows:
        if word & mask == value:
            return state
    return otherwise


def find_state(words: ProfileWords, status: int) -> int:
    """The `State` that a status word says.

    >>> State(find_state(CIA402, 0x0237)).name
    'ACTIVE'
    """
    return match_word(words.states, status, State.UNKNOWN)


def find_wanted(words: ProfileWords, control: int) -> int:
    """The `State` that a control word asks for.

    >>> State(find_wanted(CIA402, 0x06)).name
    'READY'
    """
    return match_word(words.commands, control, State.OFF)


def choose_control(words: ProfileWords, goal: int, state: int, before: int = 0, resets: bool = False) -> int:
    """The next control word on the way to a `State`.

    From QUICK_STOP the way up leads over OFF, because not every drive has transition 16.

    Args:
        words: of the profile.
        goal: OFF, READY, ON, ACTIVE or QUICK_STOP.
        state: what the last status word said; UNKNOWN before the first.
        before: the last control word.
        resets: acknowledge a fault. The edge must rise: where `before` has the bit already, it falls first.

    >>> [choose_control(CIA402, State.ACTIVE, state) for state in (State.OFF, State.READY, State.ON, State.ACTIVE)]
    [6, 7, 15, 15]
    """
    if goal == State.QUICK_STOP:
        return words.quick_stop
    if state == State.FAULT and resets and before & words.reset == 0:
        return words.reset
    if state <= State.ACTIVE:
        return words.ladder[min(goal, state + 1)]
    return words.ladder[min(goal, 1)] if state == State.UNKNOWN else words.ladder[0]


def list_transitions() -> list[tuple[int, int]]:
    """State and goal of the transitions of CiA 402 that every drive makes when a control word asks for them."""
    return [(int(before), int(goal)) for number, (before, _, goal) in TRANSITIONS.items()
            if goal is not None and number not in (15, 16)]


def list_reachable(state: int, goals: frozenset[int], *, resets: bool) -> frozenset[int]:
    """The states of CiA 402 that a drive may be in next, some transitions after `state`.

    Args:
        state: before.
        goals: what the control words since then have asked for.
        resets: whether the reset bit rose among them.
    """
    # 7 and 10 are by Quick stop as well; Enable operation may mean 3 and 4
    all_goals = {*goals, *([State.FAULT] if resets else []), *([State.OFF] if State.QUICK_STOP in goals else []),
                 *([State.ON] if State.ACTIVE in goals else [])}
    states, rest = {state}, [state]
    while rest:
        before = rest.pop()
        after = {to for start, to, word in TRANSITIONS.values()
                 if start == before and (word is None or word in all_goals)}
        after.add(State.FAULT_REACTION)  # 13
        if before == State.QUICK_STOP:
            after.add(State.OFF)  # 12 is automatic with some quick stop option codes
        rest += after - states
        states |= after
    return frozenset(states)
