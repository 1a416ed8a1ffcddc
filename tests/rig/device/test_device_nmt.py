"""NMT, heartbeat and its supervision, as far as the conformance test (tests/rig/conformance) does not see them."""

from pathlib import Path

import pytest
from device_bench import Rack, change_sheet, describe_variable

from rig.device import EmcyCode, NmtCommand, NmtState

START, STOP, RESET = "000 0103 ->", "000 0203 ->", "000 8203 -> 703 00"
SCRIPTS = {
    "the frame of the last cycle before a stop is forgotten": f"""
        {START}
        182 0100000002000300 ->
        {STOP}
        {START}
        080 -> 183 *, 283 *
        2205:0 = 0""",
    "a heartbeat that is lost and back: EMCY 0x8130 names the node; watching begins with the first one": """
        000 0103 ->
        write 1017:0 0000 -> ok
        wait 1000 ->
        701 05 ->
        wait 250 ->
        wait 1 -> 083 3081110100000000
        080 ->
        701 05 -> 083 0000000000000000
        1001:0 = 0
        080 ->""",
    "watching begins anew after a reset": f"""
        701 05 ->
        {RESET}
        write 1017:0 0000 -> ok
        wait 1000 ->""",
    "a node that is watched with another time": """
        write 1016:1 32000200 -> ok
        write 1017:0 0000 -> ok
        702 7f ->
        wait 51 -> 083 3081110200000000
        wait 500 ->
        write 1017:0 0a00 -> ok
        wait 20 -> 703 7f, 703 7f""",
    **{f"consumer entry {entry} is accepted": f"write 1016:1 {entry} -> ok"
       for entry in ("fa007f00", "00000100", "00000000", "fa000000", "00008000")},
}


@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_script(script: str) -> None:
    Rack().play(script)


def test_boots_at_its_first_tick_and_tells_of_each_state() -> None:
    rack, seen = Rack(boot=False), []
    assert rack.nmt(NmtCommand.START) == [] and rack.device.state is NmtState.INITIALISING
    assert rack.wait(0) == [(0x703, b"\0")] and rack.device.state is NmtState.PRE_OPERATIONAL
    rack.device.on_nmt = lambda old, new: seen.append((old.name, new.name))
    for command in (NmtCommand.START, NmtCommand.START, NmtCommand.STOP, NmtCommand.RESET_NODE):
        rack.nmt(command, 0)
    assert seen == [("PRE_OPERATIONAL", "OPERATIONAL"), ("OPERATIONAL", "STOPPED"), ("STOPPED", "INITIALISING"),
                    ("INITIALISING", "PRE_OPERATIONAL")]


@pytest.mark.parametrize(("reset", "position"), [(NmtCommand.RESET_NODE, 0), (NmtCommand.RESET_COMMUNICATION, 77)])
def test_reset_node_restores_all_objects_reset_communication_only_its_own(reset: NmtCommand, position: int) -> None:
    rack = Rack()
    rack.device.write(0x2200, 0, 77)
    rack.device.write(0x1017, 0, 5)
    rack.nmt(reset)
    assert (rack.device.read(0x2200), rack.device.read(0x1017)) == (position, 100)
    assert (rack.wait(99), rack.wait(1)) == ([], [(0x703, b"\x7f")])


def test_late_tick_skips_heartbeats_but_keeps_their_grid() -> None:
    rack = Rack()
    for count, ticks in ((1, (150, 199)), (2, (200, 900, 901))):
        for ms in ticks:
            rack.device.tick(ms * 1_000_000)
        rack.bus.deliver(0)
        assert len(rack.take()) == count


def test_the_register_knows_of_an_error_in_any_state() -> None:
    rack, lost = Rack(), []
    rack.device.on_heartbeat_lost = lost.append
    rack.send(0x701, b"\5")
    rack.nmt(NmtCommand.STOP)
    rack.device.emcy.raise_error(EmcyCode.RPDO_TIMEOUT, 0x10)
    assert [cob_id for cob_id, _ in rack.wait(300) if cob_id == 0x083] == [] and rack.device.read(0x1001) == 0x11
    assert lost == [1]


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
