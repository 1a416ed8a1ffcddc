"""Control and status words of the profiles, against the tables of the canopen library."""

import pytest
from canopen.profiles.p402 import State402

from rig.benches import CIA402, CIA408, PROFILES, ProfileWords, State, choose_control, find_state, find_wanted
from rig.benches.profiles import TRANSITIONS

NAMES = {"NOT READY TO SWITCH ON": State.NOT_READY, "SWITCH ON DISABLED": State.OFF,
         "READY TO SWITCH ON": State.READY, "SWITCHED ON": State.ON, "OPERATION ENABLED": State.ACTIVE,
         "QUICK STOP ACTIVE": State.QUICK_STOP, "FAULT REACTION ACTIVE": State.FAULT_REACTION, "FAULT": State.FAULT}
TABLE = {(NAMES[before], NAMES[after]): word for (before, after), word in State402.TRANSITIONTABLE.items()
         if before != "START"}
WORDS_402 = {state: next(value for mask, value, row in CIA402.states if row == state) for state in NAMES.values()}


def test_the_states_of_cia_402_are_those_of_the_canopen_library() -> None:
    for word in range(1 << 16):
        states = [state for name, state in NAMES.items()
                  if word & State402.SW_MASK[name][0] == State402.SW_MASK[name][1]]
        assert find_state(CIA402, word) == (states[0] if states else State.UNKNOWN), hex(word)


def test_the_control_words_of_cia_402_are_those_of_the_canopen_library() -> None:
    codes = State402.CW_COMMANDS_CODE
    assert CIA402.ladder == tuple(codes[name] for name in ("DISABLE VOLTAGE", "READY TO SWITCH ON", "SWITCHED ON",
                                                          "OPERATION ENABLED"))
    assert CIA402.quick_stop == codes["QUICK STOP ACTIVE"] and CIA402.reset == codes["SWITCH ON DISABLED"]
    for target, word in enumerate(CIA402.ladder):
        assert find_wanted(CIA402, word) == target
    assert find_wanted(CIA402, CIA402.quick_stop) == State.QUICK_STOP


def test_the_transitions_of_cia_402_are_those_of_the_canopen_library() -> None:
    assert {(before, after) for before, after, _ in TRANSITIONS.values()} == set(TABLE)
    for before, after, target in TRANSITIONS.values():
        if target is State.FAULT:
            assert TABLE[before, after] == CIA402.reset
        elif target is not None:
            assert find_wanted(CIA402, TABLE[before, after]) == target


@pytest.mark.parametrize("start", NAMES.values())
@pytest.mark.parametrize("goal", [State.OFF, State.READY, State.ON, State.ACTIVE])
def test_every_state_is_reached_from_every_other_one(start: State, goal: State) -> None:
    state, word = start, 0
    for _ in range(8):
        word = choose_control(CIA402, goal, find_state(CIA402, WORDS_402[state]), word, resets=True)
        automatic = {(before, after) for before, after, target in TRANSITIONS.values() if target is None}
        state = next((after for (before, after), control in TABLE.items()
                      if before == state and (control == word or (before, after) in automatic)), state)
    assert state == goal


def test_quick_stop_is_asked_for_directly() -> None:
    assert choose_control(CIA402, State.QUICK_STOP, State.ACTIVE) == TABLE[State.ACTIVE, State.QUICK_STOP]


@pytest.mark.parametrize("words", [CIA402, CIA408], ids=["402", "408"])
def test_a_fault_is_acknowledged_by_a_rising_edge_and_only_where_asked_for(words: ProfileWords) -> None:
    first = choose_control(words, State.ACTIVE, State.FAULT, 0, resets=True)
    second = choose_control(words, State.ACTIVE, State.FAULT, first, resets=True)
    assert first == words.reset and second & words.reset == 0
    assert choose_control(words, State.ACTIVE, State.FAULT) == words.ladder[0]


def test_the_words_of_cia_408_are_those_of_the_bus_page() -> None:
    assert [find_state(CIA408, 8 | word) for word in CIA408.ladder] == [*State][:4]
    status, words = 0, []
    for _ in range(6):  # the device confirms each word, and wakes up in fault
        words.append(choose_control(CIA408, State.ACTIVE, find_state(CIA408, status), resets=True))
        status = 8 | words[-1] & 7
    assert words == [8, 1, 3, 7, 7, 7]


def test_a_device_without_a_control_word_is_active_where_the_rig_enables_it() -> None:
    words = PROFILES["none"]
    control = choose_control(words, State.ACTIVE, State.ACTIVE)
    assert find_state(words, 0) == find_wanted(words, control) == State.ACTIVE
