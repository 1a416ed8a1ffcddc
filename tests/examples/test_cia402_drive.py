"""The CiA 402 drive of examples/, as canopen sees it: objects, power states, current, faults."""

from collections.abc import Iterator

import canopen
import pytest
from bus_stations import spec
from example_devices import DRIVE, DriveMaster, on_each_bus, run_device, run_drive
from rig_command import rig

OFF, SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, RESET = 0x00, 0x06, 0x07, 0x0F, 0x02, 0x80
DISABLED, READY, SWITCHED_ON, ENABLED = "SWITCH ON DISABLED", "READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"
STOPPED, REACTION, FAULT = "QUICK STOP ACTIVE", "FAULT REACTION ACTIVE", "FAULT"
VALUE_RANGE = 0x06090030  # SDO abort code


@pytest.fixture
def drive(where: str) -> Iterator[DriveMaster]:
    """A drive that is OPERATIONAL in mode 8, and its master."""
    with run_drive(where) as master:
        master.start()
        yield master


@on_each_bus
def test_objects_after_power_on_are_those_of_the_data_sheet(where: str) -> None:
    """Those that depend on the node number included."""
    with run_drive(where, node=9) as master:
        for item in master.node.object_dictionary.values():
            leaves = item.values() if hasattr(item, "values") else [item]
            for leaf in leaves:
                changes = leaf.index in (0x1003, 0x6041)
                if leaf.index < 0x1000 or changes:
                    continue
                data = master.node.sdo.upload(leaf.index, leaf.subindex)
                assert leaf.decode_raw(data) == pytest.approx(leaf.default), leaf.name
        numbers = [master.node.sdo[index][1].raw for index in (0x1400, 0x1401, 0x1800, 0x1801)]
        assert numbers == [0x209, 0x309, 0x189, 0x289] and master.node.sdo[0x1014].raw == 0x89


TRANSITIONS = [
    ([OFF], [DISABLED]),  # 0, 1
    ([SWITCH_ON, ENABLE], [DISABLED, DISABLED]),
    ([SHUTDOWN, SWITCH_ON, ENABLE], [READY, SWITCHED_ON, ENABLED]),  # 2, 3, 4
    ([SHUTDOWN, ENABLE], [READY, ENABLED]),  # 3 and 4 at once
    ([SHUTDOWN, ENABLE, SWITCH_ON, SHUTDOWN], [READY, ENABLED, SWITCHED_ON, READY]),  # 5, 6
    ([SHUTDOWN, OFF], [READY, DISABLED]),  # 7
    ([SHUTDOWN, QUICK_STOP], [READY, DISABLED]),  # 7
    ([SHUTDOWN, ENABLE, SHUTDOWN], [READY, ENABLED, READY]),  # 8
    ([SHUTDOWN, ENABLE, OFF], [READY, ENABLED, DISABLED]),  # 9
    ([SHUTDOWN, SWITCH_ON, OFF], [READY, SWITCHED_ON, DISABLED]),  # 10
    ([SHUTDOWN, SWITCH_ON, QUICK_STOP], [READY, SWITCHED_ON, DISABLED]),  # 10
    ([SHUTDOWN, ENABLE, QUICK_STOP, QUICK_STOP], [READY, ENABLED, STOPPED, DISABLED]),  # 11, 12
    ([SHUTDOWN, ENABLE, RESET], [READY, ENABLED, ENABLED]),  # no fault to reset
]


def test_each_transition(drive: DriveMaster) -> None:
    """Control words from SWITCH ON DISABLED on, and the states that they lead to."""
    for controls, states in TRANSITIONS:
        assert drive.cycle(OFF).state == DISABLED
        assert ([drive.cycle(control).state for control in controls], controls) == (states, controls)


def test_current_follows_the_error_up_to_its_limit(drive: DriveMaster) -> None:
    for target, position, current in (
        (1000, 0.5, 95),  # 3.8 A/m over 0.5 mm is 1.9 mA, 95 per mille of 20 mA
        (-1000, 0.5, -285),
        (0, -0.0101, 2),  # 38 uA: 1.9 counts
        (100_000, 0.0, 400),
        (-2_147_483_648, 1e30, -400),
    ):
        drive.cycle(OFF)
        answer = drive.enable(target, position)
        is_limited = bool(answer.status & 0x800)
        assert (answer.current, is_limited) == (current, abs(current) == 400)


def test_what_it_does_not_know_is_refused(drive: DriveMaster) -> None:
    modes, code, gain = drive.node.sdo[0x6060], drive.node.sdo[0x605A], drive.node.sdo[0x2002][1]
    refused = [*((modes, mode) for mode in (-1, 1, 3, 6, 7, 9)), (code, 3), (code, 5), (gain, float("nan")),
               (gain, -1.0)]
    for leaf, value in refused:
        before = leaf.raw
        with pytest.raises(canopen.SdoAbortedError) as caught:
            leaf.raw = value
        assert caught.value.code == VALUE_RANGE and leaf.raw == before


def test_a_missing_rpdo_is_a_fault(drive: DriveMaster) -> None:
    for number in (1, 2):
        drive.cycle(OFF)
        drive.enable(target=1000)
        answers = [drive.cycle(silent=(number,)) for _ in range(5)]
        assert [answer.state for answer in answers] == [ENABLED, ENABLED, ENABLED, REACTION, FAULT]
        assert [answer.current for answer in answers] == [190, 190, 190, 0, 0]
        assert drive.wait_for_emergency(0x8250)[0] == number and drive.node.sdo[0x603F].raw == 0x8250
        drive.node.sdo[0x6040].raw = RESET
        assert drive.cycle(RESET, silent=(number,)).state == FAULT  # the cause is still there
        assert drive.cycle(RESET).state == FAULT  # no rising edge
        drive.wait_for_emergency(0)
        assert [drive.cycle(control).state for control in (ENABLE, RESET, SHUTDOWN, ENABLE)] == (
            [FAULT, DISABLED, READY, ENABLED])
        assert drive.node.sdo[0x603F].raw == 0


def test_a_position_that_is_no_number_is_a_fault(drive: DriveMaster) -> None:
    for value in (float("nan"), float("inf")):
        drive.enable(target=1000)
        assert drive.cycle(position=value)[:2] == (REACTION, 0)
        drive.wait_for_emergency(0x7300)
        assert drive.cycle(position=0.0)[:2] == (FAULT, 0)
        assert [drive.cycle(control).state for control in (OFF, RESET)] == [FAULT, DISABLED]


@on_each_bus
def test_lost_sync_is_a_fault(where: str) -> None:
    with run_drive(where) as master:
        master.start(sync_us=5_000_000)  # a minute until it is lost
        master.enable(target=1000)
        master.node.sdo[0x1006].raw = 1000
        master.cycle()
        master.wait_for_emergency(0x8100)
        assert master.node.sdo[0x6078].raw == 0 and master.node.sdo[0x603F].raw == 0x8100
        assert master.cycle()[:2] == (FAULT, 0)


@on_each_bus
def test_a_lost_master_is_a_fault(where: str) -> None:
    with run_drive(where) as master:
        master.start()
        master.node.sdo[0x1016][1].raw = 1 << 16 | 50
        master.enable(target=1000)
        master.network.send_message(0x701, b"\x05")
        assert master.wait_for_emergency(0x8130)[0] == 1
        assert master.node.sdo[0x6078].raw == 0 and master.node.sdo[0x6041].raw & 0x4F == 0x08


@on_each_bus
def test_a_reset_ends_a_fault(drive: DriveMaster) -> None:
    drive.enable(target=1000)
    drive.cycle(position=float("nan"))
    drive.node.nmt.state = "RESET"
    drive.wait_until_ready()
    drive.start()
    assert drive.cycle(OFF, position=0.0).state == DISABLED


def test_it_conforms_to_cia_301() -> None:
    where = spec("udp_multicast")
    with run_device(DRIVE, where, "--node", "17"):
        said = rig("conformance", 17, "--eds", DRIVE / "drive.eds", "--bus", where, "--write", "--json")
    assert [case for case in said.json["tests"] if case["verdict"] == "fail"] == []
    assert said.status == 0
