"""One set of tests for every back end, then what is particular to each; `--bus`; UDP; the compiled bus."""

import os
import select
import socket
import struct
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import codec
import msgpack
import numpy as np
import pytest
from bus_stations import find_group, gather, only_udp, raw_kinds, spec, stations
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given, settings, strategies as st
from places import ROOT
from refusals import catch_refusal
from rig_command import SHORT, SLOW_START, rig, write_file

from plant import RigError, compile_function
from rig.benches import EXTENDED, FD, SWITCHED
from rig.network import (
    FRAME,
    PAYLOAD_IN,
    PAYLOAD_OUT,
    QUEUE_FULL,
    SENT,
    TIMEOUT,
    Frame,
    Link,
    Port,
    RawBus,
    bus as bus_module,
    can_open,
    choose_bus,
    find_cob_id,
    make_message,
    open_can,
    raw_bus,
    send_frame,
)
from rig.network.bus import explain_socketcan_problem
from rig.network.frame import FD_LENGTHS, IDENTIFIER, has_valid_length
from rig.network.raw_bus import NO_TURN
from rig.network.udp import PORT, UdpBus

only_socketcan = pytest.mark.parametrize("bus_kind", ["socketcan"], indirect=True)
links = pytest.mark.parametrize("bus_kind", ["virtual", "udp_multicast", "socketcan"], indirect=True)


def make_buffer_small(descriptor: int) -> None:
    """So that it holds some hundred frames."""
    with socket.socket(fileno=os.dup(descriptor)) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100_000)


def contents(frames: list[Frame]) -> list[tuple[int, bytes]]:
    return [(frame.cob_id, frame.data) for frame in frames]


class TestEveryBus:
    """What the bench needs of a bus, whichever it is."""

    def test_frames_of_all_kinds_reach_everybody_but_their_sender_unchanged_and_in_order(self, bus_kind: str) -> None:
        identifiers = [cob_id | wide for cob_id in (0, 0x7F, 0x80, 0x182, 0x7FF) for wide in (0, EXTENDED)]
        identifiers += [EXTENDED | 0x800, EXTENDED | 0x18FEF1AB, EXTENDED | 0x1FFFFFFF]
        frames = [(cob_id, bytes(range(0xF0, 0xF0 + length))) for length in (0, 1, 8) for cob_id in identifiers]
        frames += [(cob_id | FD, data) for cob_id, data in frames]
        frames += [(cob_id | FD, bytes(range(length))) for length in FD_LENGTHS for cob_id in identifiers]
        frames += [(n % 0x700, struct.pack("<I", n)) for n in range(150)]
        with stations(bus_kind, fd=True) as (sender, *others):
            for cob_id, data in frames:
                sender.send(cob_id | SWITCHED if cob_id & FD else cob_id, data)
            for station in others:
                assert contents(gather(station, len(frames))) == frames
            assert sender.poll(0.02) == []

    def test_silent_bus_gives_nothing(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (station, _):
            assert station.poll(0.0) == [] == station.poll(0.05)


class TestLink:
    """What is no frame for us, what is left out, what is lost, when it came."""

    @links
    def test_frames_are_left_out_and_taken_again(self, bus_kind: str) -> None:
        """As another socket of the program receives them."""
        identifiers = (0x000, 0x07F, 0x080, 0x0FF, 0x182, 0x183, 0x202, 0x7FF, EXTENDED | 0x080, EXTENDED | 0x7F,
                       EXTENDED | 0x18FEF1AB, EXTENDED | 0x18FEF2AB, FD | 0x200, FD | EXTENDED | 0x12345)
        with stations(bus_kind, 2, fd=True) as (sender, receiver):
            for left_out in ((0x080, 0x182, 0x000), (), (0x7FF, 0x07F), (), (EXTENDED | 0x080, FD | 0x200),
                             (EXTENDED | 0x18FEF1AB, FD | EXTENDED | 0x12345, 0x7F)):
                receiver.leave_out(left_out)
                for cob_id in (*identifiers, 0x123):
                    sender.send(cob_id, b"1")
                arrivals = [cob_id for cob_id in identifiers if cob_id not in left_out]
                assert [frame.cob_id for frame in gather(receiver, len(arrivals) + 1)] == [*arrivals, 0x123]
            receiver.send(0x100, b"2")
            assert gather(receiver, 1, timeout=0.05) == []

    @only_udp
    def test_the_kernel_drops_them(self, where: str) -> None:
        """They wake nobody: nothing is there to be read."""
        with open_can(where) as other, open_can(where) as bus:
            sender, link = (Link(each, time.monotonic_ns) for each in (other, bus))
            link.leave_out([codec.SYNC, EXTENDED | 0x7F, EXTENDED | 0x18FEF1AB])
            for cob_id in (codec.SYNC, EXTENDED | 0x7F, EXTENDED | 0x18FEF1AB):
                sender.send(cob_id, b"")
            assert select.select([bus], [], [], 0.1)[0] == []
            others = [EXTENDED | codec.SYNC, 0x7F, EXTENDED | 0x18FEF1AA]
            for cob_id in others:
                sender.send(cob_id, b"")
            assert [frame.cob_id for frame in gather(link, 3)] == others

    @links
    def test_foreign_frames_are_left_out(self, bus_kind: str, where: str) -> None:
        with open_can(where) as bus, open_can(where) as other:
            link = Link(bus, time.monotonic_ns)
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=2))
            other.send(can.Message(arbitration_id=0x123, is_extended_id=True, is_remote_frame=True))
            if bus_kind != "socketcan":  # there the controller makes them
                other.send(can.Message(is_error_frame=True))
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"2"))
            assert contents(gather(link, 1)) == [(0x123, b"2")]
            assert (link.error_frames, link.overflows, link.unsent) == (bus_kind != "socketcan", 0, 0)

    @links
    def test_a_bus_of_python_can_hears_and_sends_the_same(self, where: str) -> None:
        with open_can(where, fd=True) as bus, open_can(where, fd=True) as other:
            link = Link(bus, time.monotonic_ns)
            for flags in ({}, {"is_fd": True}, {"is_fd": True, "bitrate_switch": True}):
                for is_extended in (False, True):
                    data = bytes(64 if flags else 8)
                    message = can.Message(arbitration_id=0x123, is_extended_id=is_extended, data=data, **flags)
                    other.send(message)
                    (frame,) = gather(link, 1)
                    assert frame.cob_id == find_cob_id(message) & ~SWITCHED and frame.data == data
                    link.send(find_cob_id(message), data)
                    echo = other.recv(60)
                    assert echo.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)

    @links
    def test_frames_are_selected(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            receiver.select_frames((0x1F3, EXTENDED | 0x12345, 0x080, 0x182))
            receiver.leave_out((0x182,))
            for cob_id in (0x1F3, 0x184, EXTENDED | 0x1F3, 0x182, EXTENDED | 0x12345, 0x080):
                sender.send(cob_id, b"")
            assert [frame.cob_id for frame in gather(receiver, 3)] == [0x1F3, EXTENDED | 0x12345, 0x080]
            receiver.select_frames(None)
            sender.send(EXTENDED | 0x183, b"")
            assert [frame.cob_id for frame in gather(receiver, 1)] == [EXTENDED | 0x183]

    @links
    def test_a_length_that_no_such_frame_has_is_refused(self, bus_kind: str) -> None:
        with stations(bus_kind, 1, fd=True) as (station,):
            for cob_id, length in ((0x80, 9), (EXTENDED, 12), (FD | 0x80, 9), (FD | 0x80, 65)):
                with pytest.raises(RigError, match=f"{length} bytes; a CAN frame has 0 to 8"):
                    station.send(cob_id, bytes(length))

    @only_socketcan
    def test_error_frames_are_counted(self, bus_kind: str) -> None:
        """A controller's overflow report, put on vcan0 as the raw frame it is."""
        with stations(bus_kind, 1) as (link,), socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
            raw.bind(("vcan0",))
            raw.send(struct.pack("=IB3x8s", 0x20000004, 8, b"\0\1" + bytes(6)))
            raw.send(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))
            assert gather(link, 1, timeout=0.1) == []
            assert (link.error_frames, link.overflows) == (2, 1)

    @raw_kinds
    def test_loss_is_counted_to_the_frame(self, where: str) -> None:
        with open_can(where) as other, open_can(where) as bus:
            sender, receiver = (Link(each, time.monotonic_ns) for each in (other, bus))
            make_buffer_small(bus.fileno())
            for n in range(3000):
                sender.send(0x100, struct.pack("<I", n))
            arrivals = sum(len(frames) for frames in iter(lambda: receiver.poll(0.5), []))  # some come late
            sender.send(0x101, b"")  # the count rides on the next frame
            gather(receiver, 1)
            assert arrivals > 0 < receiver.overflows and arrivals + receiver.overflows + sender.unsent == 3000

    @only_socketcan
    def test_time_is_that_of_reception_not_of_polling(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            begin = time.monotonic_ns()
            sender.send(0x100, b"")
            sender.send(0x101, b"")
            send_time = time.monotonic_ns() - begin
            time.sleep(0.1)
            first, second = gather(receiver, 2)
            assert 0 <= second.t_ns - first.t_ns <= send_time + 100_000

    @pytest.mark.parametrize("use", [lambda link: link.send(0x80, b""), Link.poll], ids=["send", "poll"])
    def test_a_bus_that_is_gone_is_one_line(self, use: Callable[[Link], object]) -> None:
        link = Link(open_can(spec("virtual")), time.monotonic_ns)
        link.close()
        with pytest.raises(RigError, match=r"\A.+\Z"):
            use(link)


@only_udp
class TestUdpMulticast:
    def test_stays_on_the_loopback_interface(self, where: str) -> None:
        with open_can(where) as bus:
            assert bus._tx.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0
            assert bus._tx.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, 4) == socket.inet_aton("127.0.0.1")
            assert bus._tx.getsockname()[0] == "127.0.0.1"

    def test_strangers_datagram_is_an_error_frame(self, where: str) -> None:
        with open_can(where) as bus, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            link = Link(bus, time.monotonic_ns)
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            stranger.sendto(b"\xff", (where.partition(":")[2], PORT))
            assert gather(link, 1, timeout=0.1) == []
            assert link.error_frames == 1


@pytest.fixture(autouse=True)
def _no_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(bus_module.BUS_VARIABLE, raising=False)


@pytest.mark.parametrize(("live", "more"), [([], ""), (["vcan0"], "; vcan0 up, but not taken unasked")])
def test_auto_is_embedded_and_says_why(live: list[str], more: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_module, "list_can_interfaces", lambda: live)
    assert choose_bus() == ("embedded", f"embedded bus (neither --bus nor EHA_RIG_BUS is set){more}")


@pytest.mark.parametrize("bus", ["embedded", "virtual", "virtual:x", "udp_multicast", "udp_multicast:239.1.2.3"])
def test_asked_or_configured(bus: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_bus(bus) == (bus, f"{bus}, as asked")
    monkeypatch.setenv(bus_module.BUS_VARIABLE, bus)
    assert choose_bus("auto") == (bus, f"{bus}, as EHA_RIG_BUS says")
    assert choose_bus("virtual:y")[0] == "virtual:y"  # asking beats the variable


@pytest.mark.parametrize("bad", ["vcan0", "socketcan", "embedded:x", "udp_multicast:10.0.0.1", "udp_multicast:x",
                                 "nosuch:0"])
def test_bad_spec(bad: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert f"--bus: {bad}: expected " in catch_refusal(choose_bus, bad)
    monkeypatch.setenv(bus_module.BUS_VARIABLE, bad)
    assert f"EHA_RIG_BUS: {bad}: expected " in catch_refusal(choose_bus, "auto")
    assert "--bus: expected auto, embedded, " in catch_refusal(choose_bus, "")


def test_embedded_is_no_bus_between_programs() -> None:
    assert "between programs" in catch_refusal(open_can, "embedded")


@pytest.mark.parametrize(("use", "where"), [(choose_bus, "auto"), (choose_bus, "socketcan:vcan77"),
                                            (open_can, "socketcan:vcan77")])
def test_missing_interface_is_told_how_to_get_it(use: Callable[[str], object], where: str,
                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked for or configured: an error, never a silent fall back to the simulation."""
    monkeypatch.setenv(bus_module.BUS_VARIABLE, "socketcan:vcan77")
    with pytest.raises(RigError, match=r"\Asocketcan:vcan77: .+\Z"):
        use(where)


DOWN, UP = {"type": "280", "flags": "0x80"}, {"type": "280", "flags": "0xc1"}  # as /sys/class/net has it
CLASSICAL = "is set to classical CAN, not to CAN FD; sudo ip link set"


@pytest.mark.parametrize(("name", "files", "fd", "message"), [
    ("vcan1", {}, False, "ip link add vcan1 type vcan && sudo ip link set vcan1 up"),
    ("can1", {}, False, "ip link set can1 up type can bitrate 1000000"),
    ("eth0", {"type": "1", "flags": "0x1003"}, False, "eth0 is not a CAN interface"),
    ("vcan0", DOWN, False, "vcan0 is down; sudo ip link set vcan0 up"), ("can0", UP, False, ""),
    ("can0", UP | {"mtu": "16"}, False, ""), ("can0", UP | {"mtu": "72"}, True, ""),
    ("can0", UP | {"mtu": "16"}, True, f"can0 {CLASSICAL} can0 down && sudo ip link set can0 up type can bitrate "
                                       "1000000 dbitrate 4000000 fd on"),
    ("vcan0", UP | {"mtu": "16"}, True, f"vcan0 {CLASSICAL} vcan0 down && sudo ip link set vcan0 mtu 72 up")])
def test_what_is_wrong_with_an_interface(name: str, files: dict[str, str], fd: bool, message: str,
                                         monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Absent, not CAN, down, classical, fine."""
    for word in ("AF_CAN", "CAN_RAW"):
        monkeypatch.setattr(socket, word, 29, raising=False)
    monkeypatch.setattr(socket, "socket", lambda *_: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(bus_module, "_NETWORK", tmp_path)
    for file, text in files.items():
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / file).write_text(f"{text}\n")
    problem = explain_socketcan_problem(name, fd)
    assert message in problem and bool(message) == bool(problem)
    assert bus_module.list_can_interfaces() == [name] * (files.get("flags") == "0xc1")


def test_kernel_without_can(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: int) -> None:
        raise OSError(97, os.strerror(97))

    monkeypatch.setattr(socket, "socket", refuse)
    assert "no SocketCAN" in explain_socketcan_problem("vcan0")


def frame(cob_id: int, data: bytes = b"\1\2\3") -> can.Message:
    return can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)


def test_it_is_registered_where_python_can_looks() -> None:
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    assert EntryPoint("eha_rig_udp", groups["can.interface"]["eha_rig_udp"], "can.interface").load() is UdpBus
    with can.Bus(interface="eha_rig_udp", channel=find_group(), bitrate=1_000_000) as bus:
        assert type(bus) is UdpBus


def test_a_message_has_the_time_of_its_reception_and_passes_the_filters() -> None:
    group = find_group()
    filters = [{"can_id": 0x182, "can_mask": 0x7FF, "extended": False}]
    with UdpBus(group, can_filters=filters) as bus, UdpBus(group) as other:
        before = time.time()
        for cob_id in (0x80, 0x182, 0x183):
            other.send(frame(cob_id))
        message = bus.recv(60.0)
        assert message is not None and message.arbitration_id == 0x182 and before <= message.timestamp <= time.time()
        assert group in str(message.channel) and bus.recv(0.1) is None


@pytest.mark.parametrize(("options", "words"), [
    ({"channel": "10.0.0.1"}, "an IPv4 multicast group"),
    ({"channel": "239.0.0.1", "receive_own_messages": True}, "receive_own_messages is not possible")])
def test_what_it_cannot_do_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(can.CanInitializationError, match=words):
        UdpBus(**options)  # type: ignore[arg-type]


def test_a_controller_of_python_can_and_canopen_alone_passes_a_run(tmp_path: Path) -> None:
    group, short = find_group(), write_file(tmp_path / "short.toml", SHORT + SLOW_START)
    program = ROOT / "examples" / "foreign_controller.py"
    imports = [line for line in program.read_text().splitlines() if line.startswith(("import", "from"))]
    assert not any(package in line for line in imports for package in ("rig", "plant", "fdi", "dbc"))
    other = subprocess.Popen([sys.executable, program, group])
    try:
        with can.Bus(interface="eha_rig_udp", channel=group) as bus:
            boot = bus.recv(60.0)
            assert boot is not None and (boot.arbitration_id, bytes(boot.data)) == (0x702, b"\0")
        result = rig("run", short, "--bus", f"udp_multicast:{group}", "--controller", "external",
                     "--out", tmp_path / "out", "--json")
    finally:
        other.terminate()
        other.wait(120)
    assert result.status == 0 and result.json["verdict"] == "PASS", result


TAKE = "import sys; from rig.network.udp import Turn; turn = Turn(sys.argv[1], int(sys.argv[2])); turn.take(); "


def test_a_turn_that_is_held_is_one_line_and_ends_with_its_holder() -> None:
    group, send = find_group(), compile_function(send_frame)
    message = can.Message(arbitration_id=1, is_extended_id=False)
    with RawBus(f"udp_multicast:{group}") as bus, open_can(f"udp_multicast:{group}") as other:
        with subprocess.Popen([sys.executable, "-c", TAKE + "print('taken', flush=True); input()", group, str(PORT)],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
            assert holder.stdout is not None and holder.stdout.readline() == b"taken\n"
            with pytest.raises(can.CanError, match=f"turn to send.*process {holder.pid}"):
                other.send(message)
            assert send(bus.port, 1, 0, 0) == NO_TURN
            error = str(bus.explain_failure(NO_TURN))
            assert f"process {holder.pid}" in error and "\n" not in error
            holder.kill()
        assert send(bus.port, 1, 0, 0) == SENT
        other.send(message)
    assert not [path for path in Path("/dev/shm").glob("*") if group in path.name]


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
                    message = make_message(cob_id, data)
                    other.send(message)
                    status, t_ns, *rest = receive(bus.port, soon())
                    assert (status, *rest) == (FRAME, cob_id & ~SWITCHED, length, payload(data[:8]))
                    assert bytes(bus.port.octets[PAYLOAD_IN: PAYLOAD_IN + length]) == data
                    assert 0 <= time.monotonic_ns() - t_ns < 60e9
                    bus.port.octets[PAYLOAD_OUT: PAYLOAD_OUT + length] = np.frombuffer(data, np.uint8)
                    assert function("send_payload")(bus.port, cob_id, length) == SENT
                    if length <= 8:
                        assert function("send_frame")(bus.port, cob_id, length, payload(data)) == SENT
                    for _ in range(1 + (length <= 8)):
                        echo = other.recv(60)
                        assert echo.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)

    def test_only_the_kinds_asked_for_arrive(self, where: str) -> None:
        """One number is four identifiers: of 11 or 29 bits, classical or CAN FD."""
        kinds = (0, EXTENDED, FD, EXTENDED | FD)
        with open_can(where, fd=True) as other:
            for filter_kind in kinds:
                with RawBus(where, [number | filter_kind for number in (0x12, 0xFF, 0x183)], fd=True) as bus:
                    for kind in kinds:
                        for number in (0x12, 0x13, 0xFF, 0x182, 0x183):
                            other.send(make_message(number | kind, b"\1"))
                    assert receive_all(bus.port) == [number | filter_kind for number in (0x12, 0xFF, 0x183)]
                    bus.set_filter([EXTENDED | 0x12345678, 0x80])
                    for number in (0x12, EXTENDED | 0x12345678, EXTENDED | 0x12345679, FD | 0x80, 0x80):
                        other.send(make_message(number, b""))
                    assert receive_all(bus.port) == [EXTENDED | 0x12345678, 0x80]

    def test_only_the_frames_asked_for_arrive_and_none_of_its_own(self, where: str, other: can.BusABC) -> None:
        filters = [0x000, 0x050, 0x0FF, 0x183, 0x7FF]  # each length of an identifier in msgpack
        with RawBus(where, filters) as bus, RawBus(where) as python:
            function("send_frame")(bus.port, 0x183, 0, 0)
            for cob_id in range(0x800):
                other.send(can.Message(arbitration_id=cob_id, is_extended_id=False))
                if cob_id % 256 == 0:
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=True))
                    other.send(can.Message(arbitration_id=cob_id, is_extended_id=False, is_remote_frame=True))
            assert receive_all(bus.port) == filters
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
            make_buffer_small(bus.descriptors[0])
            outcomes = [send(sender.port, 0x100, 0, 0) for _ in range(3_000)]
            sends = outcomes.count(SENT)
            arrivals = len(receive_all(bus.port))
            send(sender.port, 0x100, 0, 0)  # the count rides on the next frame
            assert receive(bus.port, soon())[0] == FRAME
            assert arrivals + bus.overflows == sends
            assert bus.overflows > 0
            assert sends + outcomes.count(QUEUE_FULL) == 3_000

def read_by_python_can(data: bytes) -> tuple[Any, ...]:
    """What `Link` on a `UdpBus` makes of a datagram: COB-ID, length, payload; (-1,) for what is no data frame."""
    message = unpack_message(data, check=True)
    cob_id, data = find_cob_id(message) & ~SWITCHED, bytes(message.data)
    if message.is_error_frame or message.is_remote_frame or not has_valid_length(cob_id, len(data)):
        return (-1,)
    return cob_id, len(data), payload(data[:8]), data


CLOSED_PORT = raw_bus.make_closed_port()


def read_compiled(data: bytes) -> tuple[Any, ...]:
    CLOSED_PORT.octets[raw_bus._IN: raw_bus._IN + len(data)] = np.frombuffer(data, np.uint8)
    cob_id, *rest = function("decode_datagram")(CLOSED_PORT, len(data))
    return (cob_id, *rest, bytes(CLOSED_PORT.octets[PAYLOAD_IN: PAYLOAD_IN + rest[0]])) if cob_id >= 0 else (cob_id,)


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
            reference = read_by_python_can(data)
        except ValueError:  # its flags or its length contradict each other
            reference = (-1,)
        assert read_compiled(data) == reference
        assert read_compiled(msgpack.packb(dict(sorted(msgpack.unpackb(data).items())))) == (-1,)

    @given(st.integers(0, IDENTIFIER), st.binary(max_size=64), st.sets(st.sampled_from(range(3))))
    def test_packs_as_python_can_does(self, number: int, data: bytes, kinds: set[int]) -> None:
        flags = sum((EXTENDED, FD, SWITCHED)[kind] for kind in kinds)
        if not flags & FD:
            flags, data = flags & EXTENDED, data[:8]
        cob_id = flags | number & (IDENTIFIER if flags & EXTENDED else 0x7FF)
        CLOSED_PORT.octets[PAYLOAD_OUT: PAYLOAD_OUT + len(data)] = np.frombuffer(data, np.uint8)
        place, size = function("encode_datagram")(CLOSED_PORT, cob_id, len(data))
        message = unpack_message(bytes(CLOSED_PORT.octets[place: place + size]), check=True)
        assert message.equals(make_message(cob_id, data))

    @settings(max_examples=150, deadline=None)
    @given(messages, st.integers(0, 400), st.binary(min_size=1, max_size=9), st.sampled_from(["cut", "bad", "more"]))
    def test_damaged_bytes_never_give_a_frame_that_python_can_does_not_see(
            self, message: can.Message, place: int, bad: bytes, way: str) -> None:
        data = pack_message(message)
        place %= len(data)
        data = {"cut": data[:place], "bad": data[:place] + bad + data[place + len(bad):], "more": data + bad}[way]
        reading = read_compiled(data)
        assert way == "bad" or reading == (-1,)
        if reading[0] >= 0:  # a text that is not UTF-8 does not matter to it
            fields = {key.decode(errors="replace"): value for key, value in msgpack.unpackb(data, raw=True).items()}
            bits = fields.get("data") or b""
            cob_id = fields["arbitration_id"]
            cob_id |= EXTENDED if fields.get("is_extended_id", True) else 0
            cob_id |= FD if fields.get("is_fd") else 0
            assert reading == (cob_id, len(bits), payload(bits[:8]), bits)
            assert fields["dlc"] == len(bits)
            assert not (fields.get("is_remote_frame") or fields.get("is_error_frame"))


@only_udp
def test_everybody_hears_all_frames_in_one_order(where: str) -> None:
    receive, send = function("receive_frame"), function("send_frame")
    with ExitStack() as stack:
        receivers = [stack.enter_context(RawBus(where)) for _ in range(3)]
        senders = [stack.enter_context(RawBus(where, ())) for _ in range(4)]

        def work(number: int) -> None:
            for k in range(300):
                assert send(senders[number].port, 0x100 + number, 8, k) == SENT

        with ThreadPoolExecutor(4) as pool:
            list(pool.map(work, range(4)))  # raises what failed in a thread
        arrivals = [[receive(bus.port, soon())[2:] for _ in range(1200)] for bus in receivers]
        assert arrivals[0] == arrivals[1] == arrivals[2]
        assert {frame[0] for frame in arrivals[0]} == {0x100, 0x101, 0x102, 0x103}


@pytest.mark.parametrize("where", ["embedded", "virtual:x", "slcan:x"])
def test_other_buses_are_refused(where: str) -> None:
    assert not can_open(where) and can_open("udp_multicast") and can_open("socketcan:vcan0")
    catch_refusal(RawBus, where)
