"""NMT: every transition, what each state lets through, boot-up, heartbeat and error behaviour."""
from __future__ import annotations

from pathlib import Path

import pytest
from changed_sheets import change_sheet, describe_variable
from device_bench import Rack

from rig.device import EmcyCode, NmtCommand, NmtState

PRE, OPERATIONAL, STOPPED = NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED
START, STOP, ENTER_PRE = NmtCommand.START, NmtCommand.STOP, NmtCommand.ENTER_PRE_OPERATIONAL
RESETS = (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)
COMMAND_TO = {OPERATIONAL: START, STOPPED: STOP, PRE: ENTER_PRE}
states = pytest.mark.parametrize("state", COMMAND_TO, ids=lambda state: state.name.lower())
BOOT_UP = (0x703, b"\0")


def rack_in(state: NmtState, node: int = 3) -> Rack:
    rack = Rack(node)
    assert rack.nmt(COMMAND_TO[state]) == []
    assert rack.device.state is state
    return rack


def test_boots_at_its_first_tick_and_not_before() -> None:
    rack = Rack(boot=False)
    assert rack.nmt(START) == []
    assert rack.device.state is NmtState.INITIALISING
    assert rack.wait(0) == [BOOT_UP]
    assert rack.device.state is PRE


@states
@pytest.mark.parametrize("target", COMMAND_TO, ids=lambda state: state.name.lower())
@pytest.mark.parametrize("addressed", [0, 3])
def test_every_transition(state: NmtState, target: NmtState, addressed: int) -> None:
    rack, seen = rack_in(state), []
    rack.device.on_nmt = lambda old, new: seen.append((old, new))
    assert rack.nmt(COMMAND_TO[target], addressed) == []
    assert rack.device.state is target
    assert seen == ([] if target is state else [(state, target)])


@states
@pytest.mark.parametrize("reset", RESETS, ids=lambda reset: reset.name.lower())
def test_reset_from_any_state_boots_again(state: NmtState, reset: NmtCommand) -> None:
    rack, seen = rack_in(state), []
    rack.device.on_nmt = lambda old, new: seen.append((old, new))
    assert rack.nmt(reset) == [BOOT_UP]
    assert seen == [(state, NmtState.INITIALISING), (NmtState.INITIALISING, PRE)]


@states
@pytest.mark.parametrize("data", ["0102", "01", "010300", "", "0003", "ff03", "8001"])
def test_commands_for_others_and_malformed_ones_change_nothing(state: NmtState, data: str) -> None:
    rack = rack_in(state)
    assert rack.send(0x000, bytes.fromhex(data)) == []
    assert rack.device.state is state


def test_reset_node_restores_all_objects_reset_communication_only_its_own() -> None:
    for reset, position in ((NmtCommand.RESET_NODE, 0), (NmtCommand.RESET_COMMUNICATION, 77)):
        rack = Rack()
        rack.device.write(0x2200, 0, 77)
        rack.device.write(0x1017, 0, 5)
        rack.nmt(reset)
        assert rack.device.read(0x2200) == position
        assert rack.device.read(0x1017) == 100
        assert [cob_id for cob_id, _ in rack.wait(99)] == []
        assert rack.wait(1) == [(0x703, bytes((PRE,)))]


# CiA 301, table 39: which communication objects exist in which state.


@states
@pytest.mark.parametrize(("request_", "permitted", "answer"), [
    ("603 40 011000 00000000", (PRE, OPERATIONAL), "583 *"),
    ("wait 250", COMMAND_TO, "703 {state:02x}, 703 {state:02x}"),
], ids=["sdo", "heartbeat"])
def test_services_by_state(state: NmtState, request_: str, permitted: tuple[NmtState, ...], answer: str) -> None:
    rack_in(state).play(f"{request_} -> {answer.format(state=state) if state in permitted else ''}")


@states
def test_synchronous_pdos_only_in_operational(state: NmtState) -> None:
    rack, cycles = rack_in(state), []
    rack.device.on_sync = lambda: cycles.append(1)
    running = state is OPERATIONAL
    rack.play(f"182 0100000002000300 ->\n080 -> {'183 *, 283 *' if running else ''}\n2205:0 = {int(running)}")
    assert cycles == [1] * running


@states
def test_asynchronous_pdos_only_in_operational(state: NmtState) -> None:
    rack, arrived = rack_in(state, node=2), []
    rack.device.on_rpdo = arrived.append
    rack.play("183 0000000000000000 ->")
    rack.device.transmit(1)
    rack.play(f"wait 0 -> {'182 *' if state is OPERATIONAL else ''}")
    assert arrived == [2] * (state is OPERATIONAL)


@states
def test_emcy_in_pre_operational_and_operational(state: NmtState) -> None:
    rack = rack_in(state)
    rack.device.emcy.raise_error(EmcyCode.RPDO_TIMEOUT, 0x10)
    assert [cob_id for cob_id, _ in rack.wait(0)] == ([] if state is STOPPED else [0x083])
    assert rack.device.read(0x1001) == 0x11  # the register knows in any state


def test_frame_of_the_last_cycle_before_a_stop_is_forgotten() -> None:
    rack = rack_in(OPERATIONAL)
    rack.send(0x182, bytes.fromhex("0100000002000300"))
    rack.nmt(STOP)
    rack.nmt(START)
    rack.sync()
    assert rack.device.read(0x2205) == 0
    assert not rack.device.pdo.rpdos[1].fresh


def test_late_tick_skips_heartbeats_but_keeps_their_grid() -> None:
    rack = Rack()
    rack.device.tick(150_000_000)
    rack.device.tick(199_000_000)
    rack.bus.deliver(0)
    assert len(rack.take()) == 1
    rack.device.tick(200_000_000)
    rack.device.tick(900_000_000)
    rack.device.tick(901_000_000)
    rack.bus.deliver(0)
    assert len(rack.take()) == 2


def test_heartbeat_of_the_master_lost_and_back() -> None:
    """EMCY 0x8130 naming the node, PRE-OPERATIONAL (0x1029 = 0), error reset when it is back."""
    rack, lost = rack_in(OPERATIONAL), []
    rack.device.on_heartbeat_lost = lost.append
    rack.play("write 1017:0 0000 -> ok\nwait 1000 ->\n701 05 ->\nwait 250 ->")  # never heard: not watched yet
    assert (lost, rack.device.state) == ([], OPERATIONAL)
    rack.play("wait 1 -> 083 3081110100000000")
    assert (lost, rack.device.state) == ([1], PRE)
    rack.play("701 05 -> 083 0000000000000000\n1001:0 = 0")
    assert rack.device.state is PRE  # coming back is for the master to command


def test_watching_begins_anew_after_a_reset() -> None:
    rack, lost = Rack(), []
    rack.device.on_heartbeat_lost = lost.append
    rack.send(0x701, b"\5")
    rack.nmt(NmtCommand.RESET_COMMUNICATION)
    rack.wait(1000)
    assert lost == []


@pytest.mark.parametrize(("before", "behaviour", "after"), [
    (OPERATIONAL, 0, PRE), (OPERATIONAL, 1, OPERATIONAL), (OPERATIONAL, 2, STOPPED), (PRE, 2, PRE)])
def test_error_behaviour(before: NmtState, behaviour: int, after: NmtState) -> None:
    """Only a device that is OPERATIONAL reacts."""
    rack = rack_in(before)
    rack.device.write(0x1029, 1, behaviour)
    rack.send(0x701, b"\5")
    rack.wait(300)
    assert rack.device.state is after


# Entries of 0x1016: reserved bits and nodes beyond 127 are refused. EMCY 0x8130 names node 2, lost after 50 ms.
CONSUMER = {
    **{f"{entry} is refused": f"write 1016:1 {entry} -> 06090030\n1016:1 = {0x000100FA}"
       for entry in ("fa008001", "fa008000", "0100ff00", "fa000101", "00000180")},
    **{f"{entry} is accepted": f"write 1016:1 {entry} -> ok"
       for entry in ("fa007f00", "00000100", "00000000", "fa000000", "00008000")},
    "times by SDO": """
        write 1016:1 32000200 -> ok
        write 1017:0 0000 -> ok
        702 7f ->
        wait 51 -> 083 3081110200000000
        wait 500 ->
        write 1017:0 0a00 -> ok
        wait 20 -> 703 7f, 703 7f""",
}


@pytest.mark.parametrize("script", CONSUMER.values(), ids=CONSUMER)
def test_consumer_entry(script: str) -> None:
    Rack().play(script)


def test_two_consumer_entries_for_one_node_are_refused(tmp_path: Path) -> None:
    """CiA 301, 7.5.2.19: abort 0x06040043."""
    eds = change_sheet(tmp_path, ("1016", "SubNumber=0x2", "SubNumber=0x3"),
                       more=describe_variable("1016sub2", "0x0007"))
    Rack(eds=eds).play("""
        write 1016:2 64000100 -> 06040043
        write 1016:2 00000100 -> ok
        write 1016:2 64000200 -> ok
        write 1016:1 64000100 -> ok
        write 1016:1 64000200 -> 06040043""")
