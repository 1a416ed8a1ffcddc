"""NMT: every transition, what each state lets through, boot-up, heartbeat and error behaviour."""
from __future__ import annotations

from pathlib import Path

import pytest
from device_bench import Rack

from dbc import EDS
from rig.device import EmcyCode, NmtCommand, NmtState

PRE, OPERATIONAL, STOPPED = NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED
START, STOP, ENTER_PRE = NmtCommand.START, NmtCommand.STOP, NmtCommand.ENTER_PRE_OPERATIONAL
RESETS = (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)
COMMAND_TO = {OPERATIONAL: START, STOPPED: STOP, PRE: ENTER_PRE}
states = pytest.mark.parametrize("state", COMMAND_TO, ids=lambda state: state.name.lower())
BOOT_UP = (0x703, b"\0")
READ_REGISTER = bytes.fromhex("4001100000000000")


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
def test_sdo_in_pre_operational_and_operational(state: NmtState) -> None:
    assert bool(rack_in(state).send(0x603, READ_REGISTER)) is (state is not STOPPED)


@states
def test_synchronous_pdos_only_in_operational(state: NmtState) -> None:
    rack, cycles = rack_in(state), []
    rack.device.on_sync = lambda: cycles.append(1)
    rack.send(0x182, bytes.fromhex("0100000002000300"))
    sent = [cob_id for cob_id, _ in rack.sync()]
    running = state is OPERATIONAL
    assert sent == ([0x183, 0x283] if running else [])
    assert cycles == ([1] if running else [])
    assert rack.device.read(0x2205) == running


@states
def test_asynchronous_pdos_only_in_operational(state: NmtState) -> None:
    rack, arrived = rack_in(state, node=2), []
    rack.device.on_rpdo = arrived.append
    rack.send(0x183, bytes(8))
    rack.device.transmit(1)
    running = state is OPERATIONAL
    assert arrived == ([2] if running else [])
    assert [cob_id for cob_id, _ in rack.wait(0)] == ([0x182] if running else [])


@states
def test_emcy_in_pre_operational_and_operational(state: NmtState) -> None:
    rack = rack_in(state)
    rack.device.emcy.raise_error(EmcyCode.RPDO_TIMEOUT, 0x10)
    assert [cob_id for cob_id, _ in rack.wait(0)] == ([] if state is STOPPED else [0x083])
    assert rack.device.read(0x1001) == 0x11  # the register knows in any state


@states
def test_heartbeat_in_every_state(state: NmtState) -> None:
    assert rack_in(state).wait(250) == [(0x703, bytes((state,)))] * 2


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
    rack.wait(1000)
    assert lost == []  # never heard: not watched yet
    rack.send(0x701, b"\5")
    rack.wait(250)
    assert lost == []
    assert rack.device.state is OPERATIONAL
    assert (0x083, bytes.fromhex("3081110100000000")) in rack.wait(1)
    assert lost == [1]
    assert rack.device.state is PRE
    assert rack.send(0x701, b"\5") == [(0x083, bytes(8))]
    assert rack.device.read(0x1001) == 0
    assert rack.device.state is PRE  # coming back is for the master to command


def test_watching_begins_anew_after_a_reset() -> None:
    rack, lost = Rack(), []
    rack.device.on_heartbeat_lost = lost.append
    rack.send(0x701, b"\5")
    rack.nmt(NmtCommand.RESET_COMMUNICATION)
    rack.wait(1000)
    assert lost == []


@pytest.mark.parametrize(("behaviour", "state"), [(0, PRE), (1, OPERATIONAL), (2, STOPPED)])
def test_error_behaviour(behaviour: int, state: NmtState) -> None:
    rack = rack_in(OPERATIONAL)
    rack.device.write(0x1029, 1, behaviour)
    rack.send(0x701, b"\5")
    rack.wait(300)
    assert rack.device.state is state


def test_error_behaviour_leaves_a_device_that_is_not_operational_alone() -> None:
    rack = Rack()
    rack.device.write(0x1029, 1, 2)
    rack.send(0x701, b"\5")
    rack.wait(300)
    assert rack.device.state is PRE


def test_consumer_and_producer_times_by_sdo() -> None:
    rack = Rack()
    rack.send(0x603, bytes.fromhex("2316100132000200"))  # node 2 within 50 ms
    rack.send(0x702, b"\x7f")
    assert (0x083, bytes.fromhex("3081110200000000")) in rack.wait(51)
    rack.send(0x603, bytes.fromhex("2b17100000000000"))  # heartbeat off
    assert rack.wait(500) == []
    rack.send(0x603, bytes.fromhex("2b1710000a000000"))
    assert len(rack.wait(20)) == 2


def write_entry(rack: Rack, sub: int, entry: int) -> str:
    """Download to 0x1016; the answer in hexadecimal."""
    return rack.send(0x603, bytes.fromhex(f"231610{sub:02x}") + entry.to_bytes(4, "little"))[0][1].hex()


@pytest.mark.parametrize("entry", [0x018000FA, 0x008000FA, 0x00FF0001, 0x010100FA, 0x80010000])
def test_consumer_entry_with_reserved_bits_or_a_node_beyond_127_is_refused(entry: int) -> None:
    rack = Rack()
    assert write_entry(rack, 1, entry) == "8016100130000906"
    assert rack.device.read(0x1016, 1) == 0x000100FA


@pytest.mark.parametrize("entry", [0x007F00FA, 0x00010000, 0x00000000, 0x000000FA, 0x00800000])
def test_consumer_entry_within_the_rules_is_accepted(entry: int) -> None:
    assert write_entry(Rack(), 1, entry).startswith("60")


def test_two_consumer_entries_for_one_node_are_refused(tmp_path: Path) -> None:
    """CiA 301, 7.5.2.19: abort 0x06040043."""
    text = EDS[3].read_text()
    head, section, tail = text.partition("[1016sub1]\n")
    body = tail[:tail.index("[")]
    text = head + section + body + "[1016sub2]\n" + body.replace("0x000100FA", "0x00000000") + tail[len(body):]
    text = text.replace("ParameterName=Consumer heartbeat time\nObjectType=0x8\nSubNumber=0x2",
                        "ParameterName=Consumer heartbeat time\nObjectType=0x8\nSubNumber=0x3")
    path = tmp_path / "two.eds"
    path.write_text(text)
    rack = Rack(eds=path)
    assert write_entry(rack, 2, 0x00010064) == "8016100243000406"
    assert write_entry(rack, 2, 0x00010000).startswith("60")  # switched off
    assert write_entry(rack, 2, 0x00020064).startswith("60")
    assert write_entry(rack, 1, 0x00010064).startswith("60")  # its own node again, another time
    assert write_entry(rack, 1, 0x00020064) == "8016100143000406"
