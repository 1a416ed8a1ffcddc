"""The ECU of examples/, as cantools sees it: states, current, counters and checksums."""

from collections.abc import Iterator
from itertools import product

import can
import pytest
from example_devices import EcuMaster, compute_crc, on_each_bus, run_ecu

INIT, SYNCHRONISING, OPERATIONAL, FAULT = 1, 2, 3, 4


@pytest.fixture
def ecu(where: str) -> Iterator[EcuMaster]:
    """An ECU in state 3."""
    with run_ecu(where) as master:
        master.start()
        yield master


def read(answer: dict[str, float]) -> tuple[float, float]:
    """State and current, mA."""
    return answer["State"], answer["Current"]


def spoil(data: bytes) -> bytes:
    """A frame with a wrong checksum."""
    return bytes((data[0] ^ 1, *data[1:]))


def test_the_checksum_has_the_published_check_value() -> None:
    assert compute_crc(b"123456789") == 0x4B


def test_without_frames_it_says_that_it_is_there(where: str) -> None:
    with run_ecu(where) as master:
        drives = [master.read_drive() for _ in range(20)]
    assert {read(drive) for drive in drives} == {(INIT, 0.0)}
    assert [int(drive["Counter"]) for drive in drives] == [(int(drives[0]["Counter"]) + k) % 16 for k in range(20)]


@on_each_bus
def test_five_sound_frames_make_it_operational(where: str) -> None:
    with run_ecu(where) as master:
        states = [master.cycle(enable=0)["State"] for _ in range(100)]
    sound = [state for state in states if state != INIT]  # answers to the first frames may be behind its own Drives
    assert sound[:5] in ([SYNCHRONISING] * 4 + [OPERATIONAL], [SYNCHRONISING] * 5) and sound[-1] == OPERATIONAL


def test_current_follows_the_error_up_to_its_limit(ecu: EcuMaster) -> None:
    """3.6 A/m; the derivative part is 0 in the first cycle with a current and while nothing changes."""
    for target, position, current in (
        (1.0, 0.5, 1.8), (-1.0, 0.5, -5.4), (5.0, 0.0, 8.0), (-5.0, 0.0, -8.0), (0.0, 0.00123, -0.004),
        (-8388.608, 1342.17727, -8.0),  # the ends of the ranges
    ):
        ecu.cycle(target, position, enable=0)
        said = [read(ecu.cycle(target, position)) for _ in range(2)]
        assert said == [pytest.approx((OPERATIONAL, current))] * 2


def test_wrong_frames_are_not_used_and_three_are_a_fault(ecu: EcuMaster) -> None:
    for name, kind in product(("Demand", "Feedback"), ("checksum", "counter")):
        ecu.cycle(1.0, 0.5)
        said = []
        for _ in range(3):
            frames = {"Demand": {"Position": 1.0, "Enable": 1}, "Feedback": {"Position": 0.5, "Pressure": 0}}
            frames[name]["Position"] = -3.0
            if kind == "counter":
                ecu.counters[name] -= 1
            for each, values in frames.items():
                data = ecu.encode(each, **values)
                ecu.send(each, spoil(data) if (each, kind) == (name, "checksum") else data)
            said.append(read(ecu.read_drive()))
        assert said == [(OPERATIONAL, 1.8), (OPERATIONAL, 1.8), (FAULT, 0.0)], (name, kind)
        assert [ecu.cycle(enable=0)["State"] for _ in range(10)][-1] == OPERATIONAL  # its counters begin anew


@on_each_bus
def test_when_the_frames_stop_the_current_does(where: str) -> None:
    with run_ecu(where, timeout=200) as master:
        enable = 0  # a Drive may answer an earlier cycle, and a stall of the machine is a fault until this is 0 again
        while (said := read(master.cycle(1.0, 0.5, enable))) != (OPERATIONAL, 1.8):
            enable = int(said[0] == OPERATIONAL)
        master.cycle(1.0, 0.5)
        while (drive := master.read_drive())["State"] != FAULT:
            pass
        assert drive["Current"] == 0.0
        while master.cycle(enable=0)["State"] != OPERATIONAL:
            pass


@on_each_bus
def test_other_frames_are_not_its_own(ecu: EcuMaster) -> None:
    """A frame of another length, and the same low bits in an 11-bit identifier, go unanswered."""
    data = ecu.encode("Feedback", Position=0.5, Pressure=0)
    ecu.counters["Feedback"] -= 1
    ecu.send("Feedback", data[:7])
    identifier = ecu.database.get_message_by_name("Feedback").frame_id & 0x7FF
    ecu.bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))
    before = ecu.cycle()
    assert int(ecu.cycle()["Counter"]) == (int(before["Counter"]) + 1) % 16
