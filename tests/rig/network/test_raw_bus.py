"""Frames sent and received by compiled code, on UDP here and on SocketCAN where there is a vcan0."""

import os
import socket
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
from bus_stations import spec
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given, settings, strategies as st

from plant.compile import compile_function
from plant.errors import InputError, RigError
from rig.benches.bench import EXTENDED, FD, SWITCHED
from rig.network import raw_bus
from rig.network.bus import can_open, open_can
from rig.network.frame import FD_LENGTHS, IDENTIFIER, find_cob_id, has_valid_length, make_message
from rig.network.raw_bus import (
    FRAME,
    PAYLOAD_IN,
    PAYLOAD_OUT,
    QUEUE_FULL,
    SENT,
    TIMEOUT,
    Port,
    RawBus,
)

raw_kinds = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)


@cache
def function(name: str) -> Callable[..., Any]:
    return compile_function(getattr(raw_bus, name))  # type: ignore[no-any-return]


def soon(seconds: float = 60.0) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def payload(data: bytes) -> int:
    return int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


def receive_all(port: Port, silence: float = 0.5) -> list[int]:
    """The COB-IDs of the frames that come until none did for `silence` seconds: a busy kernel hands them over later."""
    receive = function("receive_frame")
    return [frame[2] for frame in iter(lambda: receive(port, soon(silence)), (TIMEOUT, 0, 0, 0, 0))]


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
    def test_frames_go_to_and_fro_between_python_can_and_compiled_code(self, where: str) -> None:
        """Of all kinds and lengths; the payload of a frame up to 8 bytes is a number, that of every frame its bytes."""
        kinds = [flags | wide for flags in (0, FD, FD | SWITCHED) for wide in (0, EXTENDED)]
        cob_ids = [kind | number for kind in kinds for number in (0, 0x7F, 0x80, 0x182, 0x7FF)]
        cob_ids += [kind | number for kind in kinds if kind & EXTENDED for number in (0x800, 0x18FEF1AB, IDENTIFIER)]
        receive = function("receive_frame")
        with open_can(where, fd=True) as other, RawBus(where, cob_ids) as bus:
            receive(bus.port, 0)  # compiles it
            for length in (*range(9), *FD_LENGTHS):
                data = bytes(range(0xF8 - length, 0xF8))
                for cob_id in [each for each in cob_ids if has_valid_length(each, length)]:
                    sent = make_message(cob_id, data)
                    other.send(sent)
                    status, t_ns, *rest = receive(bus.port, soon())
                    assert (status, *rest) == (FRAME, cob_id & ~SWITCHED, length, payload(data[:8]))
                    assert bytes(bus.port.octets[PAYLOAD_IN: PAYLOAD_IN + length]) == data
                    assert 0 <= time.monotonic_ns() - t_ns < 60e9
                    bus.port.octets[PAYLOAD_OUT: PAYLOAD_OUT + length] = np.frombuffer(data, np.uint8)
                    assert function("send_payload")(bus.port, cob_id, length) == SENT
                    if length <= 8:
                        assert function("send_frame")(bus.port, cob_id, length, payload(data)) == SENT
                    for _ in range(1 + (length <= 8)):
                        heard = other.recv(60)
                        assert heard is not None
                        assert heard.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)

    def test_only_the_kinds_asked_for_arrive(self, where: str) -> None:
        """One number is four identifiers: of 11 or 29 bits, classical or CAN FD."""
        kinds = (0, EXTENDED, FD, EXTENDED | FD)
        with open_can(where, fd=True) as other:
            for wanted in kinds:
                with RawBus(where, [number | wanted for number in (0x12, 0xFF, 0x183)], fd=True) as bus:
                    for kind in kinds:
                        for number in (0x12, 0x13, 0xFF, 0x182, 0x183):
                            other.send(make_message(number | kind, b"\1"))
                    assert receive_all(bus.port) == [number | wanted for number in (0x12, 0xFF, 0x183)]
                    bus.set_filter([EXTENDED | 0x12345678, 0x80])
                    for number in (0x12, EXTENDED | 0x12345678, EXTENDED | 0x12345679, FD | 0x80, 0x80):
                        other.send(make_message(number, b""))
                    assert receive_all(bus.port) == [EXTENDED | 0x12345678, 0x80]

    def test_only_the_frames_asked_for_arrive_and_none_of_its_own(self, where: str, other: can.BusABC) -> None:
        wanted = [0x000, 0x050, 0x0FF, 0x183, 0x7FF]  # each length of an identifier in msgpack
        with RawBus(where, wanted) as bus, RawBus(where) as python:
            function("send_frame")(bus.port, 0x183, 0, 0)
            for cob_id in range(0x800):
                other.send(can.Message(arbitration_id=cob_id, is_extended_id=False))
                if cob_id % 256 == 0:
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=True))
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=False, is_remote_frame=True))
            assert receive_all(bus.port) == wanted
            assert len(receive_all(python.port)) == 0x800 + 1
            with pytest.raises(RigError, match="513 frames to receive; at most 512 are possible"):
                bus.set_filter(range(EXTENDED, EXTENDED + 513))

    def test_waits_until_its_deadline(self, where: str) -> None:
        receive = function("receive_frame")
        with RawBus(where) as bus:
            assert receive(bus.port, 0) == (TIMEOUT, 0, 0, 0, 0)
            end = soon(0.02)
            assert receive(bus.port, end)[0] == TIMEOUT
            assert time.monotonic_ns() >= end

    def test_waits_in_the_call_that_receives(self, where: str, other: can.BusABC) -> None:
        await_frame = function("await_frame")
        with RawBus(where) as bus:
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
        with RawBus(where) as bus, RawBus(where, ()) as sender:
            with socket.socket(fileno=os.dup(bus.descriptors[0])) as same:
                same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100_000)  # bytes; it holds some hundred frames
            said = [send(sender.port, 0x100, 0, 0) for _ in range(3_000)]
            sent = said.count(SENT)
            kept = len(receive_all(bus.port))
            send(sender.port, 0x100, 0, 0)  # the count rides on the next frame
            assert receive(bus.port, soon())[0] == FRAME
            assert kept + bus.overflows == sent
            assert bus.overflows > 0
            assert sent + said.count(QUEUE_FULL) == 3_000

def read_by_python_can(data: bytes) -> tuple[Any, ...]:
    """What `Link` on a `UdpBus` makes of a datagram: COB-ID, length, payload; (-1,) for what is no data frame."""
    message = unpack_message(data, check=True)
    cob_id, data = find_cob_id(message) & ~SWITCHED, bytes(message.data)
    if message.is_error_frame or message.is_remote_frame or not has_valid_length(cob_id, len(data)):
        return (-1,)
    return cob_id, len(data), payload(data[:8]), data


PORT = raw_bus.make_closed_port()


def read_compiled(data: bytes) -> tuple[Any, ...]:
    PORT.octets[raw_bus._IN: raw_bus._IN + len(data)] = np.frombuffer(data, np.uint8)
    cob_id, *rest = function("decode_datagram")(PORT, len(data))
    return (cob_id, *rest, bytes(PORT.octets[PAYLOAD_IN: PAYLOAD_IN + rest[0]])) if cob_id >= 0 else (cob_id,)


FLAGS = ("is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch", "error_state_indicator")
messages = st.builds(  # some contradict themselves
    lambda number, data, flags, t, channel: can.Message(
        arbitration_id=number, data=b"" if "is_remote_frame" in flags else data, timestamp=t, channel=channel,
        **{flag: flag in flags for flag in FLAGS}),
    st.one_of(st.integers(0, 0x7FF), st.integers(0, 2**29), st.sampled_from([0, 0x7F, 0x80, 0xFF, 0x100, 0x7FF])),
    st.one_of(st.binary(max_size=8), st.sampled_from(FD_LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n)),
              st.binary(max_size=66)),
    st.one_of(st.just(set()), st.sampled_from(FLAGS).map(lambda flag: {flag}), st.sets(st.sampled_from(FLAGS))),
    st.one_of(st.floats(0, 2e9), st.integers(0, 2**40)), st.sampled_from([None, "239.0.0.1", 3, "x" * 40]))


class TestDatagrams:
    @settings(max_examples=100, deadline=None)
    @given(messages)
    def test_reads_what_python_can_packs(self, message: can.Message) -> None:
        data = pack_message(message)
        try:
            expected = read_by_python_can(data)
        except ValueError:  # its flags or its length contradict each other
            expected = (-1,)
        assert read_compiled(data) == expected
        swapped = dict(sorted(msgpack.unpackb(data).items()))
        assert read_compiled(msgpack.packb(swapped)) == (-1,)

    @given(st.integers(0, IDENTIFIER), st.binary(max_size=64), st.sets(st.sampled_from(range(3))))
    def test_packs_as_python_can_does(self, number: int, data: bytes, kinds: set[int]) -> None:
        flags = sum((EXTENDED, FD, SWITCHED)[kind] for kind in kinds)
        if not flags & FD:
            flags, data = flags & EXTENDED, data[:8]
        cob_id = flags | number & (IDENTIFIER if flags & EXTENDED else 0x7FF)
        PORT.octets[PAYLOAD_OUT: PAYLOAD_OUT + len(data)] = np.frombuffer(data, np.uint8)
        place, size = function("encode_datagram")(PORT, cob_id, len(data))
        message = unpack_message(bytes(PORT.octets[place: place + size]), check=True)
        assert message.equals(make_message(cob_id, data))

    @settings(max_examples=150, deadline=None)
    @given(messages, st.integers(0, 400), st.binary(min_size=1, max_size=9), st.sampled_from(["cut", "bad", "more"]))
    def test_damaged_bytes_never_give_a_frame_that_python_can_does_not_see(
            self, message: can.Message, place: int, bad: bytes, way: str) -> None:
        data = pack_message(message)
        place %= len(data)
        data = {"cut": data[:place], "bad": data[:place] + bad + data[place + len(bad):], "more": data + bad}[way]
        seen = read_compiled(data)
        assert way == "bad" or seen == (-1,)
        if seen[0] >= 0:  # a text that is not UTF-8 does not matter to it
            fields = {key.decode(errors="replace"): value for key, value in msgpack.unpackb(data, raw=True).items()}
            bits = fields.get("data") or b""
            cob_id = fields["arbitration_id"]
            cob_id |= EXTENDED if fields.get("is_extended_id", True) else 0
            cob_id |= FD if fields.get("is_fd") else 0
            assert seen == (cob_id, len(bits), payload(bits[:8]), bits)
            assert fields["dlc"] == len(bits)
            assert not (fields.get("is_remote_frame") or fields.get("is_error_frame"))


@pytest.mark.parametrize("bus_kind", ["udp_multicast"], indirect=True)
def test_everybody_hears_all_frames_in_one_order(where: str) -> None:
    receive, send = function("receive_frame"), function("send_frame")
    with ExitStack() as stack:
        receivers = [stack.enter_context(RawBus(where)) for _ in range(3)]
        senders = [stack.enter_context(RawBus(where, ())) for _ in range(4)]

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
        assert not can_open(where)
        with pytest.raises(InputError):
            RawBus(where)
    assert can_open("udp_multicast") and can_open("socketcan:vcan0")
