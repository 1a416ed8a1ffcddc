"""One set of tests for every back end, then what is particular to each, and what `--bus` may say."""
from __future__ import annotations

import os
import socket
import struct
import time
from pathlib import Path

import can
import canopen
import pytest
from stations import Station, gather, spec, stations

from dbc import EDS
from plant.errors import InputError, RigError
from rig import bus as bus_module
from rig import codec
from rig.bus import choose, open_can, socketcan_problem
from rig.device import Device, NmtState
from rig.frame import Frame
from rig.link import Link

only_socketcan = pytest.mark.parametrize("bus_kind", ["socketcan"], indirect=True)
only_udp = pytest.mark.parametrize("bus_kind", ["udp_multicast"], indirect=True)


def contents(frames: list[Frame]) -> list[tuple[int, bytes]]:
    return [(frame.cob_id, frame.data) for frame in frames]


class TestEveryBus:
    """What the bench needs of a bus, whichever it is."""

    @pytest.mark.parametrize("cob_id", [0x000, 0x080, 0x202, 0x7FF], ids=hex)
    @pytest.mark.parametrize("length", [0, 1, 8])
    def test_frame_reaches_everybody_but_its_sender_unchanged(self, bus_kind: str, cob_id: int, length: int) -> None:
        data = bytes(range(0xF0, 0xF0 + length))
        with stations(bus_kind) as (sender, *others):
            sender.send(cob_id, data)
            for station in others:
                assert contents(gather(station, 1)) == [(cob_id, data)]
            assert sender.poll(0.02) == []

    def test_frames_of_a_sender_keep_their_order(self, bus_kind: str) -> None:
        sent = [(n % 0x700, struct.pack("<I", n)) for n in range(150)]
        with stations(bus_kind) as (sender, *others):
            for frame in sent:
                sender.send(*frame)
            for station in others:
                assert contents(gather(station, len(sent))) == sent

    def test_answer_comes_after_what_it_answers(self, bus_kind: str) -> None:
        with stations(bus_kind) as (asking, answering, listening):
            for n in range(20):
                asking.send(0x600, bytes([n]))
                gather(answering, 1)
                answering.send(0x580, bytes([n]))
                gather(asking, 1)
            heard = contents(gather(listening, 40))
        assert heard == [(cob_id, bytes([n])) for n in range(20) for cob_id in (0x600, 0x580)]

    def test_times_lie_between_sending_and_polling_and_do_not_go_back(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            begin = time.monotonic_ns()
            for n in range(5):
                sender.send(n, b"")
                time.sleep(0.002)
            frames = gather(receiver, 5)
            times = [frame.t_ns for frame in frames]
            assert len(times) == 5
            assert times == sorted(times)
            span = time.monotonic_ns() - begin
            assert times[0] >= 0
            assert times[-1] - times[0] <= span + 1_000_000  # the kernel's wall clock may be slewed

    def test_silent_bus_gives_nothing(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (station, _):
            begin = time.monotonic()
            assert station.poll(0.0) == []
            assert station.poll(0.05) == []
            assert time.monotonic() - begin < 1.0

    def test_whole_bench_runs_its_cycle(self, bus_kind: str) -> None:
        """Boot-up, NMT start, 50 SYNCs with command, feedback, valve state and drive; each node on its own station."""
        with stations(bus_kind) as (master, *places):
            nodes = {n: Device(n, EDS[n], place.send) for n, place in zip((2, 3), places, strict=True)}
            nodes[2].on_rpdo = lambda n: nodes[2].transmit(1)
            heard = self.turn(master, nodes, places, 2)
            assert {frame.cob_id for frame in heard} == {0x702, 0x703}
            master.send(0x000, b"\1\0")
            self.settle(nodes, places)
            assert {node.state for node in nodes.values()} == {NmtState.OPERATIONAL}
            for k in range(50):
                master.send(0x202, codec.pack_command(1e-3, 7, k))
                master.send(0x080, b"")
                heard = self.turn(master, nodes, places, 3)
                assert [frame.cob_id for frame in heard if frame.cob_id != 0x182] == [0x183, 0x283]
                assert len(heard) == 3
            assert codec.position(int(nodes[2].read(0x2100))) == 1e-3

    def test_canopen_master_downloads_a_scenario(self, bus_kind: str) -> None:
        """4 kB by SDO, written by the canopen library and read by our server, over the back end."""
        content = bytes(range(256)) * 16
        with stations(bus_kind, 2) as (master, place):
            node = Device(3, EDS[3], place.send)
            node.tick(0)

            class Network(canopen.Network):  # type: ignore[misc]  # canopen is not typed
                def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
                    master.send(can_id, bytes(data))
                    end = time.monotonic() + 5
                    while time.monotonic() < end:
                        for frame in place.poll(0.0005):
                            node.receive(frame)
                        frames = [frame for frame in master.poll(0.0005) if frame.cob_id == 0x583]
                        for frame in frames:
                            self.notify(frame.cob_id, bytearray(frame.data), 0.0)
                        if frames:
                            return

            remote = Network().add_node(3, str(EDS[3]))
            remote.sdo[0x2210].raw = content
            assert node.read(0x2210) == content
            assert remote.sdo[0x1008].raw == "EHA plant emulator"

    @staticmethod
    def turn(master: Station, nodes: dict[int, Device], places: list[Station], number: int) -> list[Frame]:
        """Let the nodes work until the master heard `number` frames, the heartbeats of running nodes apart."""
        heard: list[Frame] = []
        end = time.monotonic() + 5
        while time.monotonic() < end and len(heard) < number:
            TestEveryBus.settle(nodes, places, 1)
            heard += [frame for frame in master.poll(0.0005) if frame.data != bytes((NmtState.OPERATIONAL,))]
        return heard

    @staticmethod
    def settle(nodes: dict[int, Device], places: list[Station], rounds: int = 20) -> None:
        for _ in range(rounds):
            for node, place in zip(nodes.values(), places, strict=True):
                node.tick(0)
                for frame in place.poll(0.0005):
                    node.receive(frame)


class TestSocketcan:
    """The kernel's own interface: what is no frame for us, what is lost, when it came."""

    @only_socketcan
    def test_foreign_frames_are_counted_and_dropped(self, bus_kind: str) -> None:
        with stations(bus_kind, 1) as (link,):
            assert isinstance(link, Link)
            with open_can(spec(bus_kind)) as other:
                other.send(can.Message(arbitration_id=0x12345, is_extended_id=True, data=b"1"))
                other.send(can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=2))
                other.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"2"))
            assert contents(gather(link, 1)) == [(0x123, b"2")]
            assert (link.dropped, link.error_frames, link.overflows, link.unsent) == (2, 0, 0, 0)

    @only_socketcan
    def test_error_frames_are_counted(self, bus_kind: str) -> None:
        """A controller's overflow report, put on vcan0 as the raw frame it is."""
        with stations(bus_kind, 1) as (link,), socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
            assert isinstance(link, Link)
            raw.bind(("vcan0",))
            raw.send(struct.pack("=IB3x8s", 0x20000004, 8, b"\0\1" + bytes(6)))
            raw.send(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))
            assert gather(link, 1, timeout=0.1) == []
            assert (link.error_frames, link.overflows, link.dropped) == (2, 1, 0)

    @only_socketcan
    def test_overflow_is_counted_to_the_frame(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            assert isinstance(receiver, Link)
            for n in range(5000):
                sender.send(0x100, struct.pack("<I", n))
            kept = len(receiver.poll())
            sender.send(0x101, b"")  # the count rides on the next frame
            gather(receiver, 1)
            assert 0 < kept < 5000
            assert kept + receiver.overflows == 5000

    @only_socketcan
    def test_time_is_that_of_reception_not_of_polling(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            begin = time.monotonic_ns()
            sender.send(0x100, b"")
            sender.send(0x101, b"")
            sent = time.monotonic_ns() - begin
            time.sleep(0.1)
            first, second = receiver.poll()
            assert 0 <= second.t_ns - first.t_ns <= sent + 100_000


class TestUdpMulticast:
    @only_udp
    def test_stays_on_the_loopback_interface(self, bus_kind: str) -> None:
        with open_can(spec(bus_kind)) as bus:
            options = bus._tx  # type: ignore[attr-defined]
            assert options.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0
            assert options.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, 4) == socket.inet_aton("127.0.0.1")
            assert options.getsockname()[0] == "127.0.0.1"

    @only_udp
    def test_groups_do_not_hear_each_other(self, bus_kind: str) -> None:
        with stations(bus_kind, 1) as (one,), stations(bus_kind, 1) as (other,):
            one.send(0x80, b"")
            assert other.poll(0.05) == []

    @only_udp
    def test_loss_is_counted_to_the_frame(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            assert isinstance(receiver, Link)
            for n in range(60_000):
                sender.send(0x100, struct.pack("<I", n))
            kept = len(receiver.poll())
            sender.send(0x101, b"")  # the count rides on the next frame
            gather(receiver, 1)
            assert kept + receiver.overflows == 60_000

    @only_udp
    def test_strangers_datagram_is_an_error_frame(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        with open_can(where) as bus, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            link = Link(bus, time.monotonic_ns)
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            stranger.sendto(b"\xff", (where.partition(":")[2], 43113))
            assert gather(link, 1, timeout=0.1) == []
            assert link.error_frames == 1


class TestLink:
    def test_foreign_and_error_frames_are_counted(self) -> None:
        where = spec("virtual")
        with open_can(where) as bus, open_can(where) as other:
            link = Link(bus, time.monotonic_ns)
            other.send(can.Message(arbitration_id=0x12345, is_extended_id=True))
            other.send(can.Message(arbitration_id=0x1, is_extended_id=False, is_remote_frame=True))
            other.send(can.Message(is_error_frame=True))
            other.send(can.Message(arbitration_id=0x1, is_extended_id=False, data=b"1"))
            assert contents(link.poll(1.0)) == [(1, b"1")]
            assert (link.dropped, link.error_frames) == (2, 1)

    def test_a_bus_that_is_gone_is_one_line(self) -> None:
        link = Link(open_can(spec("virtual")), time.monotonic_ns)
        link.close()
        for use in (lambda: link.send(0x80, b""), lambda: link.poll()):
            with pytest.raises(RigError) as caught:
                use()
            assert str(caught.value)
            assert "\n" not in str(caught.value)


class TestChoice:
    """`--bus` and EHA_RIG_BUS: what is taken, why, and what a bad one is told."""

    @pytest.fixture(autouse=True)
    def _no_variable(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv(bus_module.VARIABLE, raising=False)

    def test_auto_is_embedded_and_says_so(self) -> None:
        chosen, reason = choose("auto")
        assert chosen == "embedded"
        assert "EHA_RIG_BUS" in reason

    def test_live_interface_is_named_but_not_taken_unasked(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(bus_module, "can_interfaces", lambda: ["vcan0"])
        chosen, reason = choose()
        assert chosen == "embedded"
        assert "vcan0 up, but not taken unasked" in reason

    def test_asked_or_configured(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for taken in ("embedded", "virtual", "virtual:x", "udp_multicast", "udp_multicast:239.1.2.3"):
            assert choose(taken) == (taken, f"{taken}, as asked")
            monkeypatch.setenv(bus_module.VARIABLE, taken)
            assert choose("auto") == (taken, f"{taken}, as EHA_RIG_BUS says")
            assert choose("virtual:y")[0] == "virtual:y"  # asking beats the variable

    def test_bad_spec(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for bad in ("vcan0", "socketcan", "embedded:x", "udp_multicast:10.0.0.1", "udp_multicast:x", "nosuch:0"):
            with pytest.raises(InputError, match=f"--bus: {bad}: expected "):
                choose(bad)
            monkeypatch.setenv(bus_module.VARIABLE, bad)
            with pytest.raises(InputError, match=f"EHA_RIG_BUS: {bad}: expected "):
                choose("auto")
        with pytest.raises(InputError, match="--bus: : expected auto, embedded, "):
            choose("")

    def test_embedded_is_no_bus_between_programs(self) -> None:
        with pytest.raises(InputError, match="between programs"):
            open_can("embedded")

    def test_missing_interface_is_told_how_to_get_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Asked for or configured: an error, never a silent fall back to the simulation."""
        monkeypatch.setenv(bus_module.VARIABLE, "socketcan:vcan77")
        for use in (lambda: choose("auto"), lambda: choose("socketcan:vcan77"), lambda: open_can("socketcan:vcan77")):
            with pytest.raises(RigError) as caught:
                use()
            assert str(caught.value).startswith("socketcan:vcan77: ")
            assert "\n" not in str(caught.value)

    def test_what_is_wrong_with_an_interface(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        """Absent, not CAN, down, fine: read from /sys/class/net."""

        class NoSocket:
            def __init__(self, *_: int) -> None: ...

            def close(self) -> None: ...

        for name in ("AF_CAN", "CAN_RAW"):
            monkeypatch.setattr(socket, name, 29, raising=False)
        monkeypatch.setattr(socket, "socket", NoSocket)
        monkeypatch.setattr(bus_module, "_NETWORK", tmp_path)
        for name, kind, flags in (("eth0", "1", "0x1003"), ("vcan0", "280", "0x80"), ("can0", "280", "0xc1")):
            (tmp_path / name).mkdir()
            (tmp_path / name / "type").write_text(kind + "\n")
            (tmp_path / name / "flags").write_text(flags + "\n")
        assert "ip link add vcan1 type vcan && sudo ip link set vcan1 up" in socketcan_problem("vcan1")
        assert "ip link set can1 up type can bitrate 1000000" in socketcan_problem("can1")
        assert socketcan_problem("eth0") == "eth0 is not a CAN interface"
        assert socketcan_problem("vcan0") == "vcan0 is down; sudo ip link set vcan0 up"
        assert socketcan_problem("can0") == ""
        assert bus_module.can_interfaces() == ["can0"]

    def test_kernel_without_can(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: int) -> None:
            raise OSError(97, os.strerror(97))

        monkeypatch.setattr(socket, "socket", refuse)
        assert "no SocketCAN" in socketcan_problem("vcan0")
