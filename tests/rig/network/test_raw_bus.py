"""Frames sent and received by compiled code, on UDP here and on SocketCAN where there is a vcan0."""
from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from typing import Any

import can
import msgpack
import numpy as np
import pytest
from bus_stations import gather, spec
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given, settings
from hypothesis import strategies as st

from plant.compile import compile_function
from plant.errors import InputError
from rig.network import raw_bus
from rig.network.bus import open_can
from rig.network.link import Link
from rig.network.raw_bus import FRAME, NEVER, SENT, TIMEOUT, WOKEN, Port, open_raw_bus

raw_kinds = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)


@cache
def function(name: str) -> Callable[..., Any]:
    return compile_function(getattr(raw_bus, name))  # type: ignore[no-any-return]


def soon(seconds: float = 60.0) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def payload(data: bytes) -> int:
    return int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


def receive_waiting(port: Port) -> list[int]:
    """The COB-IDs of the frames that wait."""
    receive = function("receive_frame")
    return [frame[2] for frame in iter(lambda: receive(port, 0), (TIMEOUT, 0, 0, 0, 0))]


@pytest.fixture
def where(bus_kind: str) -> str:
    return spec(bus_kind)


@pytest.fixture
def other(where: str) -> Iterator[can.BusABC]:
    """A station of python-can on the same bus."""
    with open_can(where) as bus:
        yield bus


@raw_kinds
class TestFrames:
    def test_frames_go_to_and_fro_between_python_can_and_compiled_code(self, where: str, other: can.BusABC) -> None:
        receive, send = function("receive_frame"), function("send_frame")
        with open_raw_bus(where) as bus:
            receive(bus.port, 0)  # compiles it
            for length in range(9):
                for cob_id in (0, 0x7F, 0x80, 0x100, 0x7FF):
                    data = bytes(range(0xF8, 0xF8 + length))
                    other.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
                    status, t_ns, *rest = receive(bus.port, soon())
                    assert (status, *rest) == (FRAME, cob_id, length, payload(data))
                    assert 0 <= time.monotonic_ns() - t_ns < 60e9
                    assert send(bus.port, cob_id, length, payload(data)) == SENT
                    message = other.recv(60)
                    assert message is not None and not message.is_extended_id
                    assert (message.arbitration_id, bytes(message.data)) == (cob_id, data)

    def test_only_the_frames_asked_for_arrive_and_none_of_its_own(self, where: str, other: can.BusABC) -> None:
        wanted = [0x000, 0x050, 0x0FF, 0x183, 0x7FF]  # each length of an identifier in msgpack
        with open_raw_bus(where, wanted) as bus, open_raw_bus(where) as python:
            function("send_frame")(bus.port, 0x183, 0, 0)
            for cob_id in range(0x800):
                other.send(can.Message(arbitration_id=cob_id, is_extended_id=False))
                if cob_id % 256 == 0:
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=True))
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=False, is_remote_frame=True))
            assert receive_waiting(bus.port) == wanted
            assert (len(receive_waiting(python.port)), python.dropped) == (0x800 + 1, 16)

    def test_time_is_that_of_reception(self, where: str) -> None:
        receive, send = function("receive_frame"), function("send_frame")
        with open_raw_bus(where) as bus, open_raw_bus(where) as sender:
            receive(bus.port, 0)
            before = time.monotonic_ns()
            send(sender.port, 0x80, 0, 0)
            send(sender.port, 0x81, 0, 0)
            after = time.monotonic_ns()
            time.sleep(0.05)
            first, second = receive(bus.port, 0)[1], receive(bus.port, 0)[1]
            slewed = 100_000  # the wall clock may be corrected meanwhile
            assert before - slewed <= first <= second <= after + slewed

    def test_waits_until_its_deadline_or_until_it_is_woken(self, where: str) -> None:
        receive = function("receive_frame")
        with open_raw_bus(where) as bus:
            assert receive(bus.port, 0) == (TIMEOUT, 0, 0, 0, 0)
            end = soon(0.02)
            assert receive(bus.port, end)[0] == TIMEOUT
            assert time.monotonic_ns() >= end
            bus.wake()
            assert receive(bus.port, NEVER)[0] == WOKEN
            assert receive(bus.port, 0)[0] == TIMEOUT
            timer = threading.Timer(0.05, bus.wake)
            timer.start()
            assert receive(bus.port, NEVER)[0] == WOKEN
            timer.join()

    def test_waits_in_the_call_that_receives(self, where: str, other: can.BusABC) -> None:
        await_frame = function("await_frame")
        with open_raw_bus(where) as bus:
            assert await_frame(bus.port) == (TIMEOUT, 0, 0, 0, 0)
            other.send(can.Message(arbitration_id=0x123, data=b"\x07", is_extended_id=False))
            status, t_ns, *rest = await_frame(bus.port)
            assert (status, *rest) == (FRAME, 0x123, 1, 7)
            bus.use_kernel_times(False)
            before = time.monotonic_ns()
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False))
            time.sleep(0.01)
            assert t_ns <= before < before + 10_000_000 <= await_frame(bus.port)[1]

    def test_a_lost_frame_is_counted(self, where: str) -> None:
        receive, send = function("receive_frame"), function("send_frame")
        with open_raw_bus(where) as bus, open_raw_bus(where, ()) as sender:
            with socket.socket(fileno=os.dup(bus.descriptors[0])) as same:
                same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100_000)  # bytes; it holds some hundred frames
            sent = sum(send(sender.port, 0x100, 0, 0) == SENT for _ in range(3_000))
            kept = len(receive_waiting(bus.port))
            send(sender.port, 0x100, 0, 0)  # the count rides on the next frame
            assert receive(bus.port, soon())[0] == FRAME
            assert kept + bus.overflows == sent
            assert bus.overflows > 0
            assert sent + sender.unsent == 3_000

    def test_a_link_hears_compiled_frames_and_answers(self, where: str, other: can.BusABC) -> None:
        link = Link(other, time.monotonic_ns)
        with open_raw_bus(where, (0x182,)) as bus:
            for k in range(20):
                function("send_frame")(bus.port, 0x183, 8, raw_bus.join_halves(-k, k))
                (frame,) = gather(link, 1)
                assert struct.unpack("<ii", frame.data) == (-k, k)
                link.send(0x182, struct.pack("<iHH", -k, 0xF000, k))
                assert raw_bus.split_words(function("receive_frame")(bus.port, soon())[4]) == (-k, 0xF000, k)


int32 = st.integers(-2**31, 2**31 - 1)


@given(int32, st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), int32)
def test_parts_of_a_payload_survive_and_are_those_of_the_codec(low: int, middle: int, high: int, half: int) -> None:
    data = raw_bus.join_words(low, middle, high)
    assert data.to_bytes(8, "little", signed=True) == struct.pack("<iHH", low, middle, high)
    assert raw_bus.split_words(data) == (low, middle, high)
    data = raw_bus.join_halves(low, half)
    assert data.to_bytes(8, "little", signed=True) == struct.pack("<ii", low, half)
    assert raw_bus.split_halves(data) == (low, half)


def read_by_python_can(data: bytes) -> tuple[int, ...]:
    """What `Link` on a `UdpBus` makes of a datagram: (0, COB-ID, length, payload), (1,) error, (2,) dropped."""
    message = unpack_message(data, check=True)
    if message.is_error_frame:
        return (1,)
    if message.is_extended_id or message.is_remote_frame or message.is_fd:
        return (2,)
    return 0, message.arbitration_id, len(message.data), payload(bytes(message.data))


PORT = raw_bus.make_closed_port()


def read_compiled(data: bytes) -> tuple[int, ...]:
    PORT.octets[raw_bus._IN: raw_bus._IN + len(data)] = np.frombuffer(data, np.uint8)
    kind, *rest = function("decode_datagram")(PORT, len(data))
    return (kind, *rest) if kind == 0 else (kind,)


messages = st.builds(
    lambda cob_id, data, flags, t, channel: can.Message(
        arbitration_id=cob_id, data=b"" if flags == "is_remote_frame" else data, timestamp=t, channel=channel,
        is_extended_id=flags == "is_extended_id", is_remote_frame=flags == "is_remote_frame",
        is_error_frame=flags == "is_error_frame", is_fd=flags == "is_fd"),
    st.one_of(st.integers(0, 0x7FF), st.sampled_from([0, 0x7F, 0x80, 0xFF, 0x100, 0x7FF])), st.binary(max_size=8),
    st.sampled_from(["", "", "", "is_extended_id", "is_remote_frame", "is_error_frame", "is_fd"]),
    st.one_of(st.floats(0, 2e9), st.integers(0, 2**40)), st.sampled_from([None, "239.0.0.1", 3, "x" * 40]))


class TestDatagrams:
    @settings(max_examples=300, deadline=None)
    @given(messages, st.randoms(use_true_random=False))
    def test_reads_what_python_can_packs_in_any_order(self, message: can.Message, random: Any) -> None:
        data = pack_message(message)
        pairs = list(msgpack.unpackb(data).items())
        random.shuffle(pairs)
        assert read_compiled(data) == read_compiled(msgpack.packb(dict(pairs))) == read_by_python_can(data)

    @pytest.mark.parametrize("change", [{"data": None, "dlc": 0}, {"channel": "x" * 300}, {"dlc": None}, {"dlc": "8"}])
    def test_other_ways_to_pack_are_those_of_python_can(self, change: dict[str, Any]) -> None:
        fields = msgpack.unpackb(pack_message(can.Message(arbitration_id=0x80, is_extended_id=False, data=bytes(8))))
        data = msgpack.packb(fields | change)
        try:
            expected = read_by_python_can(data)
        except (TypeError, ValueError):
            expected = (1,)
        assert read_compiled(data) == expected

    def test_a_long_head_of_the_payload_is_read(self) -> None:
        packed = pack_message(can.Message(arbitration_id=0x80, is_extended_id=False, data=bytes(range(8))))
        data = packed.replace(b"\xc4\x08", b"\xc5\x00\x08")
        assert read_compiled(data) == read_by_python_can(data) == read_compiled(packed)

    @settings(max_examples=500, deadline=None)
    @given(messages, st.integers(0, 400), st.binary(min_size=1, max_size=9), st.sampled_from(["cut", "bad", "more"]))
    def test_damaged_bytes_never_give_a_frame_that_python_can_does_not_see(
            self, message: can.Message, place: int, bad: bytes, way: str) -> None:
        data = pack_message(message)
        place %= len(data)
        data = {"cut": data[:place], "bad": data[:place] + bad + data[place + len(bad):], "more": data + bad}[way]
        seen = read_compiled(data)
        assert way == "bad" or seen == (1,)
        if seen[0] == 0:  # a text that is not UTF-8, or a flag of CAN FD, does not matter to it
            fields = msgpack.unpackb(data, raw=True)
            bits = fields.get(b"data") or b""
            assert seen == (0, fields[b"arbitration_id"], len(bits), payload(bits))
            assert fields[b"dlc"] == len(bits)
            kinds = (b"is_extended_id", b"is_remote_frame", b"is_error_frame", b"is_fd")
            assert not any(fields.get(kind) for kind in kinds)

    @given(st.binary(max_size=300))
    def test_foreign_bytes_are_no_frame(self, data: bytes) -> None:
        assert read_compiled(data) == (1,)


@pytest.mark.parametrize("bus_kind", ["udp_multicast"], indirect=True)
def test_everybody_hears_all_frames_in_one_order(where: str) -> None:
    receive, send = function("receive_frame"), function("send_frame")
    with ExitStack() as stack:
        receivers = [stack.enter_context(open_raw_bus(where)) for _ in range(3)]
        senders = [stack.enter_context(open_raw_bus(where, ())) for _ in range(4)]

        def work(number: int) -> None:
            for k in range(300):
                assert send(senders[number].port, 0x100 + number, 8, k) == SENT

        threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        heard = [[receive(bus.port, soon())[2:] for _ in range(1200)] for bus in receivers]
        assert heard[0] == heard[1] == heard[2]
        assert {frame[0] for frame in heard[0]} == {0x100, 0x101, 0x102, 0x103}


def test_other_buses_are_refused() -> None:
    for where in ("embedded", "virtual:x", "slcan:x"):
        assert not raw_bus.can_open(where)
        with pytest.raises(InputError):
            open_raw_bus(where)
    assert raw_bus.can_open("udp_multicast") and raw_bus.can_open("socketcan:vcan0")
