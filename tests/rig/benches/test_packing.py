"""Compiled packing: what protections a frame, and which frame it is. (Its bits: test_can_map.py.)"""


import numpy as np
import pytest

from plant import compile_function
from rig.benches import (
    ACCEPTED,
    FRAMES_AT,
    OTHER_CYCLE,
    PAYLOAD,
    VALUES_AT,
    FrameSpec,
    Layout,
    Role,
    find_frame,
    list_frame_places,
    make_layout,
    pack,
    pack_frame,
    unpack_frame,
)
from rig.benches.bench import Field, Protection
from rig.benches.packing import REPEATED, WRONG_CHECKSUM


@pytest.fixture(scope="module")
def functions() -> tuple[object, object, object]:
    return tuple(compile_function(one) for one in (pack_frame, unpack_frame, find_frame))


def read_payload(layout: Layout, spec: FrameSpec) -> bytes:
    return layout.octets[8 * PAYLOAD: 8 * PAYLOAD + spec.length].tobytes()


def write_payload(layout: Layout, data: bytes) -> None:
    layout.octets[8 * PAYLOAD: 8 * PAYLOAD + 64] = np.frombuffer(data.ljust(64, b"\0"), np.uint8)


CHECKSUMS = [("crc8_sae_j1850", 0, ()), ("crc8_h2f", 0, ()), ("e2e_profile_1", 0x123, ()),
             ("e2e_profile_2", 0, tuple(range(3, 19)))]


@pytest.mark.parametrize(("checksum", "data_id", "data_ids"), CHECKSUMS)
def test_alive_counter_and_checksum(checksum: str, data_id: int, data_ids: tuple[int, ...], functions: tuple) -> None:
    """The sender computes both; the receiver takes no frame with a wrong checksum and none twice."""
    write, read, _ = functions
    fields = (Field(name="value", lowest=16, length=16),
              Field(name="count", lowest=8, length=4, protection=Protection.COUNTER, wrap=15),
              Field(name="crc", lowest=0, length=8, protection=Protection.CHECKSUM, checksum=checksum, data_id=data_id,
                    data_ids=data_ids))
    spec = FrameSpec(name="frame", identifier=1, length=8, sender=Role.RIG, fields=fields)
    sender, receiver = make_layout([spec], ["value"], Role.RIG), make_layout([spec], ["value"], Role.CONTROLLER)
    for number in range(40):
        sender.doubles[sender.words[VALUES_AT]] = 7.0 * number
        write(sender, FRAMES_AT, 0)
        data = read_payload(sender, spec)
        assert data == pack(spec, {"value": 7.0 * number}, number)
        write_payload(receiver, data)
        assert read(receiver, FRAMES_AT, 8, 0) == ACCEPTED
        write_payload(receiver, data)
        assert read(receiver, FRAMES_AT, 8, 0) == REPEATED
        broken = bytes([*data[:3], data[3] ^ 1, *data[4:]])
        write_payload(receiver, broken)
        assert read(receiver, FRAMES_AT, 8, 0) == WRONG_CHECKSUM


def test_pages_of_a_message_have_one_alive_counter(functions: tuple) -> None:
    """Of a multiplexed message the sender counts all frames, and the receiver takes the next one of any page."""
    pages = [FrameSpec(name=f"page {page}", identifier=5, length=2, sender=Role.RIG, fields=(
        Field(name="selector", lowest=0, length=4, fixed=page),
        Field(name="count", lowest=8, length=4, protection=Protection.COUNTER))) for page in (0, 1)]
    sender, receiver = make_layout(pages, [], Role.RIG), make_layout(pages, [], Role.CONTROLLER)
    for number in range(40):
        functions[0](sender, list_frame_places(sender)[number % 2], 0)
        data = read_payload(sender, pages[0])
        assert data == bytes((number % 2, number % 16))
        write_payload(receiver, data)
        at = functions[2](receiver, 5)
        assert functions[1](receiver, at, 2, 0) == ACCEPTED and functions[1](receiver, at, 2, 0) == REPEATED


def test_an_answer_names_its_cycle(functions: tuple) -> None:
    """A frame with a cycle counter is taken in this cycle alone; the counter wraps."""
    spec = FrameSpec(name="drive", identifier=1, length=3, sender=Role.CONTROLLER, fields=(
        Field(name="current", lowest=0, length=16), Field(name="cycle", lowest=16, length=8)))
    layout = make_layout([spec], ["current"], Role.RIG)
    write_payload(layout, bytes((1, 0, 0x34)))
    assert functions[1](layout, FRAMES_AT, 3, 0x1234) == ACCEPTED
    assert functions[1](layout, FRAMES_AT, 3, 0x1235) == OTHER_CYCLE
