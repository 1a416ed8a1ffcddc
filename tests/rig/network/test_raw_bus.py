"""Frames sent and received by compiled code, on UDP here and on SocketCAN where there is a vcan0."""
from __future__ import annotations

import atexit
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
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
from plant.errors import InputError, RigError
from rig.network import raw_bus
from rig.network.bus import open_can
from rig.network.link import Link
from rig.network.raw_bus import FRAME, NEVER, NO_TURN, SENT, TIMEOUT, WOKEN, open_raw_bus
from rig.network.udp import Turn

raw_kinds = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)
ways = pytest.mark.parametrize("way", ["compiled", "interpreted"])


@cache
def function(name: str, way: str = "compiled") -> Callable[..., Any]:
    plain = getattr(raw_bus, name)
    return compile_function(plain) if way == "compiled" else plain  # type: ignore[no-any-return]


def soon(seconds: float = 5.0) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def payload(data: bytes) -> int:
    return int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


@raw_kinds
class TestFrames:
    @ways
    def test_frames_of_python_can_arrive(self, bus_kind: str, way: str) -> None:
        where = spec(bus_kind)
        receive = function("receive_frame", way)
        with open_raw_bus(where) as bus, open_can(where) as other:
            receive(bus.port, 0)  # compiles it
            for length in range(9):
                for cob_id in (0, 0x7F, 0x80, 0x100, 0x7FF):
                    data = bytes(range(0xF8, 0xF8 + length)) if length < 8 else bytes(range(0xF8, 0x100))
                    other.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
                    status, t_ns, *rest = receive(bus.port, soon())
                    assert (status, *rest) == (FRAME, cob_id, length, payload(data))
                    assert 0 <= time.monotonic_ns() - t_ns < 5e9

    @ways
    def test_python_can_reads_what_is_sent(self, bus_kind: str, way: str) -> None:
        where = spec(bus_kind)
        send = function("send_frame", way)
        with open_raw_bus(where) as bus, open_can(where) as other:
            for length in (0, 1, 7, 8):
                data = bytes(range(0xF8, 0xF8 + length))
                for cob_id in (0, 0x7F, 0x80, 0x183, 0x7FF):
                    assert send(bus.port, cob_id, length, payload(data)) == SENT
                    message = other.recv(5)
                    assert message is not None
                    assert (message.arbitration_id, bytes(message.data)) == (cob_id, data)
                    assert not message.is_extended_id

    def test_only_the_frames_asked_for_arrive_and_none_of_its_own(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        receive, send = function("receive_frame"), function("send_frame")
        wanted = (0x000, 0x050, 0x0FF, 0x183, 0x7FF)  # each length of an identifier in msgpack
        with open_raw_bus(where, wanted) as bus, open_raw_bus(where) as python, open_can(where) as other:
            send(bus.port, 0x183, 0, 0)
            for cob_id in range(0x800):
                other.send(can.Message(arbitration_id=cob_id, is_extended_id=False))
                if cob_id % 256 == 0:
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=True))
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=False, is_remote_frame=True))
            got = []
            while (frame := receive(bus.port, 0))[0] == FRAME:
                got.append(frame[2])
            assert tuple(got) == wanted
            heard = 0
            while receive(python.port, 0)[0] == FRAME:
                heard += 1
            assert (heard, python.dropped) == (0x800 + 1, 16)

    def test_time_is_that_of_reception(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        receive, send = function("receive_frame"), function("send_frame")
        with open_raw_bus(where) as bus, open_raw_bus(where) as other:
            receive(bus.port, 0)
            before = time.monotonic_ns()
            send(other.port, 0x80, 0, 0)
            send(other.port, 0x81, 0, 0)
            after = time.monotonic_ns()
            time.sleep(0.05)
            first, second = receive(bus.port, 0)[1], receive(bus.port, 0)[1]
            slewed = 100_000  # the wall clock may be corrected meanwhile
            assert before - slewed <= first <= second <= after + slewed

    @ways
    def test_waits_until_its_deadline_or_until_it_is_woken(self, bus_kind: str, way: str) -> None:
        receive = function("receive_frame", way)
        with open_raw_bus(spec(bus_kind)) as bus:
            assert receive(bus.port, 0) == (TIMEOUT, 0, 0, 0, 0)
            end = soon(0.02)
            assert receive(bus.port, end)[0] == TIMEOUT
            assert time.monotonic_ns() >= end
            bus.wake()
            assert receive(bus.port, NEVER)[0] == WOKEN
            assert receive(bus.port, 0)[0] == TIMEOUT
            if way == "compiled":  # interpreted, it keeps the interpreter lock while it waits
                timer = threading.Timer(0.05, bus.wake)
                timer.start()
                assert receive(bus.port, NEVER)[0] == WOKEN
                timer.join()

    @ways
    def test_waits_in_the_call_that_receives(self, bus_kind: str, way: str) -> None:
        await_frame = function("await_frame", way)
        where = spec(bus_kind)
        with open_raw_bus(where) as bus, open_can(where) as other:
            assert await_frame(bus.port) == (TIMEOUT, 0, 0, 0, 0)
            other.send(can.Message(arbitration_id=0x123, data=b"\x07", is_extended_id=False))
            status, t_ns, *rest = await_frame(bus.port)
            assert (status, *rest) == (FRAME, 0x123, 1, 7)
            bus.use_kernel_times(False)
            before = time.monotonic_ns()
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False))
            time.sleep(0.01)
            assert t_ns <= before < before + 10_000_000 <= await_frame(bus.port)[1]

    def test_a_lost_frame_is_counted(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        receive, send = function("receive_frame"), function("send_frame")
        with open_raw_bus(where) as bus, open_raw_bus(where, ()) as other:
            with socket.socket(fileno=os.dup(bus.port.words[raw_bus._RX])) as same:
                same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100_000)  # bytes; it holds some hundred frames
            sent = 0
            for _ in range(3_000):
                sent += send(other.port, 0x100, 0, 0) == SENT
            kept = 0
            while receive(bus.port, 0)[0] == FRAME:
                kept += 1
            send(other.port, 0x100, 0, 0)  # the count rides on the next frame
            assert receive(bus.port, soon())[0] == FRAME
            assert kept + bus.overflows == sent
            assert bus.overflows > 0
            assert sent + other.unsent == 3_000

    def test_a_link_hears_compiled_frames_and_answers(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        receive, send = function("receive_frame"), function("send_frame")
        with open_raw_bus(where, (0x182,)) as bus:
            link = Link(open_can(where), time.monotonic_ns)
            try:
                for k in range(20):
                    send(bus.port, 0x183, 8, raw_bus.join_halves(-k, k))
                    (frame,) = gather(link, 1)
                    assert struct.unpack("<ii", frame.data) == (-k, k)
                    link.send(0x182, struct.pack("<iHH", -k, 0xF000, k))
                    assert raw_bus.split_words(receive(bus.port, soon())[4]) == (-k, 0xF000, k)
            finally:
                link.close()


int32 = st.integers(-2**31, 2**31 - 1)


class TestPayload:
    @given(int32, st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), int32)
    def test_parts_survive_and_are_those_of_the_codec(self, low: int, middle: int, high: int, half: int) -> None:
        data = raw_bus.join_words(low, middle, high)
        assert data.to_bytes(8, "little", signed=True) == struct.pack("<iHH", low, middle, high)
        assert raw_bus.split_words(data) == (low, middle, high)
        data = raw_bus.join_halves(low, half)
        assert data.to_bytes(8, "little", signed=True) == struct.pack("<ii", low, half)
        assert raw_bus.split_halves(data) == (low, half)


def read_by_python_can(data: bytes) -> tuple[int, ...]:
    """What `Link` on a `LoopbackBus` makes of a datagram: (0, COB-ID, length, payload), (1,) error, (2,) dropped."""
    try:
        message = unpack_message(data, check=True)
    except Exception:
        return (1,)
    if message.is_error_frame:
        return (1,)
    if message.is_extended_id or message.is_remote_frame or message.is_fd:
        return (2,)
    return 0, message.arbitration_id, len(message.data), payload(bytes(message.data))


def read_compiled(data: bytes) -> tuple[int, ...]:
    octets = np.zeros(2048, np.uint8)
    octets[7: 7 + len(data)] = np.frombuffer(data, np.uint8)
    kind, *rest = function("decode_datagram")(octets, 7, len(data))
    return (kind, *rest) if kind == 0 else (kind,)


@cache
def open_port() -> raw_bus.Port:
    """A port of a UDP bus that stays open."""
    bus = open_raw_bus("udp_multicast:239.74.163.77")
    atexit.register(bus.close)
    return bus.port


messages = st.builds(
    lambda cob_id, data, flags, t, channel: can.Message(
        arbitration_id=cob_id, data=b"" if flags == "is_remote_frame" else data, timestamp=t, channel=channel,
        is_extended_id=flags == "is_extended_id", is_remote_frame=flags == "is_remote_frame",
        is_error_frame=flags == "is_error_frame", is_fd=flags == "is_fd"),
    st.one_of(st.integers(0, 0x7FF), st.sampled_from([0, 0x7F, 0x80, 0xFF, 0x100, 0x7FF])), st.binary(max_size=8),
    st.sampled_from(["", "", "", "is_extended_id", "is_remote_frame", "is_error_frame", "is_fd"]),
    st.floats(0, 2e9), st.sampled_from([None, "239.0.0.1", 3, "x" * 40]))


class TestDatagrams:
    @settings(max_examples=300, deadline=None)
    @given(messages, st.randoms(use_true_random=False))
    def test_reads_what_python_can_packs_in_any_order(self, message: can.Message, random: Any) -> None:
        data = pack_message(message)
        assert read_compiled(data) == read_by_python_can(data)
        pairs = list(msgpack.unpackb(data).items())
        random.shuffle(pairs)
        data = msgpack.packb(dict(pairs))
        assert read_compiled(data) == read_by_python_can(data)

    @settings(max_examples=500, deadline=None)
    @given(messages, st.integers(0, 400), st.binary(min_size=1, max_size=9), st.booleans())
    def test_damaged_bytes_never_give_a_frame_that_python_can_does_not_see(
            self, message: can.Message, place: int, bad: bytes, cut: bool) -> None:
        data = pack_message(message)
        place %= len(data)
        data = data[:place] if cut else data[:place] + bad + data[place + len(bad):]
        seen = read_compiled(data)
        if seen[0] == 0:  # a text that is not UTF-8, or a flag of CAN FD, does not matter to it
            fields = msgpack.unpackb(data, raw=True)
            bits = fields.get(b"data") or b""
            assert seen == (0, fields[b"arbitration_id"], len(bits), payload(bits))
            assert fields.get(b"dlc") in (None, len(bits))
            kinds = (b"is_extended_id", b"is_remote_frame", b"is_error_frame", b"is_fd")
            assert not any(fields.get(kind) for kind in kinds)

    @settings(max_examples=300, deadline=None)
    @given(st.integers(0, 0x7FF), st.binary(max_size=8), st.integers(0, 400), st.binary(max_size=3))
    def test_the_short_way_reads_the_same(self, cob_id: int, data: bytes, place: int, bad: bytes) -> None:
        """Our own layout is read without looking at its keys; whatever differs takes the long way."""
        port = open_port()
        size = raw_bus.encode_datagram(port, cob_id, len(data), payload(data))
        sent = port.octets[raw_bus._OUT: raw_bus._OUT + size].tobytes()
        assert read_compiled(sent) == (0, cob_id, len(data), payload(data))
        place %= size
        for got in (sent, sent[:place] + bad + sent[place + len(bad):], sent[:place], sent + bad):
            port.octets[raw_bus._IN: raw_bus._IN + len(got)] = np.frombuffer(got, np.uint8)
            kind, *rest = function("_decode")(port, len(got))
            assert ((kind, *rest) if kind == 0 else (kind,)) == read_compiled(got)

    @given(st.binary(max_size=300))
    def test_foreign_bytes_are_no_frame(self, data: bytes) -> None:
        assert read_compiled(data) == (1,)


only_udp = pytest.mark.parametrize("bus_kind", ["udp_multicast"], indirect=True)

HOLDER = """
import sys, time
from rig.network.udp import Turn
turn = Turn(sys.argv[1], 43113)
turn.take()
print("taken", flush=True)
time.sleep(600)
"""


@only_udp
class TestTurn:
    def test_a_turn_that_is_held_is_one_line_and_ends_with_its_holder(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        group = where.partition(":")[2]
        send = function("send_frame")
        with open_raw_bus(where) as bus, open_can(where) as other:
            holder = subprocess.Popen([sys.executable, "-c", HOLDER, group], stdout=subprocess.PIPE)
            try:
                assert holder.stdout is not None
                assert holder.stdout.readline() == b"taken\n"
                with pytest.raises(can.CanError, match=f"turn to send.*process {holder.pid}"):
                    other.send(can.Message(arbitration_id=1, is_extended_id=False))
                status = send(bus.port, 1, 0, 0)
                assert status == NO_TURN
                error = bus.explain_failure(status)
                assert isinstance(error, RigError)
                assert f"process {holder.pid}" in str(error)
                assert "\n" not in str(error)
            finally:
                os.kill(holder.pid, signal.SIGKILL)
                holder.wait()
                assert holder.stdout is not None
                holder.stdout.close()
            assert send(bus.port, 1, 0, 0) == SENT
            other.send(can.Message(arbitration_id=1, is_extended_id=False))

    def test_the_last_one_leaves_nothing(self, bus_kind: str) -> None:
        group = spec(bus_kind).partition(":")[2]
        first, second = Turn(group, 1), Turn(group, 1)
        assert first.identifier == second.identifier
        first.close()
        second.take()
        second.give()
        second.close()
        second.close()
        listed = [line.split()[0] for line in Path("/proc/sysvipc/sem").read_text().splitlines()[1:]]
        assert str(second._key) not in listed
        assert Turn(group, 1).identifier >= 0  # a new one can be made

    def test_everybody_hears_all_frames_in_one_order(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        receive, send = function("receive_frame"), function("send_frame")
        receive_all = [open_raw_bus(where) for _ in range(3)]
        senders = [open_raw_bus(where, ()) for _ in range(4)]

        def work(number: int) -> None:
            for k in range(300):
                assert send(senders[number].port, 0x100 + number, 8, k) == SENT

        try:
            threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            heard = [[receive(bus.port, soon())[2:] for _ in range(1200)] for bus in receive_all]
            assert heard[0] == heard[1] == heard[2]
            assert {frame[0] for frame in heard[0]} == {0x100, 0x101, 0x102, 0x103}
        finally:
            for bus in (*receive_all, *senders):
                bus.close()


def test_other_buses_are_refused() -> None:
    for where in ("embedded", "virtual:x", "slcan:x"):
        assert not raw_bus.can_open(where)
        with pytest.raises(InputError):
            open_raw_bus(where)
    assert raw_bus.can_open("udp_multicast")
    assert raw_bus.can_open("socketcan:vcan0")
