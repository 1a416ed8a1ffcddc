"""One set of tests for every back end, then what is particular to each."""
from __future__ import annotations

import ctypes
import select
import signal
import socket
import struct
import subprocess
import sys
import time

import can
import canopen
import pytest
from bus_stations import Station, gather, spec, stations

from dbc import EDS
from plant.errors import RigError
from rig.device import Device, NmtState
from rig.network import codec
from rig.network.bus import open_can
from rig.network.frame import Frame
from rig.network.link import Link
from rig.network.udp import PORT, LoopbackBus, Turn
from studies.robustness.disturb import has_semaphores

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

    def test_own_frames_do_not_hide_those_of_others(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (one, other):
            for n in range(10):
                one.send(0x100, bytes([n]))
                other.send(0x200, bytes([n]))
            time.sleep(0.05)
            assert contents(one.poll(0.0)) == [(0x200, bytes([n])) for n in range(10)]

    def test_times_do_not_go_back_and_span_no_more_than_it_took(self, bus_kind: str) -> None:
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
            assert station.poll(0.0) == []
            assert station.poll(0.05) == []

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
        end = time.monotonic() + 60
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


class TestLeavingOut:
    """A link leaves out the frames that another socket of its program receives."""

    @pytest.mark.parametrize("bus_kind", ["virtual", "udp_multicast", "socketcan"], indirect=True)
    def test_frames_are_left_out_and_taken_again(self, bus_kind: str) -> None:
        identifiers = (0x000, 0x07F, 0x080, 0x0FF, 0x182, 0x183, 0x202, 0x7FF)
        with stations(bus_kind, 2) as (sender, receiver):
            assert isinstance(receiver, Link)
            for left_out in ((0x080, 0x182, 0x000), (), (0x7FF, 0x07F), ()):
                receiver.leave_out(left_out)
                for cob_id in (*identifiers, 0x123):
                    sender.send(cob_id, b"1")
                expected = [cob_id for cob_id in identifiers if cob_id not in left_out]
                assert [frame.cob_id for frame in gather(receiver, len(expected) + 1)] == [*expected, 0x123]
            receiver.send(0x100, b"2")
            assert gather(receiver, 1, timeout=0.05) == []

    @only_udp
    def test_the_kernel_drops_them(self, bus_kind: str) -> None:
        """They wake nobody: nothing is there to be read."""
        with stations(bus_kind, 2) as (sender, receiver):
            assert isinstance(receiver, Link) and isinstance(receiver._bus, LoopbackBus)
            receiver.leave_out([codec.SYNC])
            sender.send(codec.SYNC, b"")
            assert select.select([receiver._bus], [], [], 0.1)[0] == []


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
            many = 60_000  # more than the large receive buffer holds
            for n in range(many):
                sender.send(0x100, struct.pack("<I", n))
            kept = len(receiver.poll())
            sender.send(0x101, b"")  # the count rides on the next frame
            gather(receiver, 1)
            assert 0 < kept < many
            assert kept + receiver.overflows == many

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


def test_the_semaphores_of_killed_programs_are_removed_by_the_next_one() -> None:
    """Those of programs at work stay, and so do sets of the same size that are not ours."""
    killed, used, following = (spec("udp_multicast").partition(":")[2] for _ in range(3))
    code = ("import os, signal, sys; from rig.network.udp import Turn; Turn(sys.argv[1], int(sys.argv[2])); "
            "os.kill(os.getpid(), signal.SIGKILL)")
    assert subprocess.run([sys.executable, "-c", code, killed, str(PORT)], check=False).returncode == -signal.SIGKILL
    library = ctypes.CDLL(None)
    foreign = library.semget(0, 4, 0o1000 | 0o666)  # IPC_PRIVATE
    turn = Turn(used, PORT)
    try:
        other = Turn(following, PORT)
        assert [has_semaphores(group) for group in (killed, used, following)] == [False, True, True]
        assert library.semctl(foreign, 0, 12) == 0  # GETVAL
        other.close()
    finally:
        turn.close()
        library.semctl(foreign, 0, 0)  # IPC_RMID
    assert not any(map(has_semaphores, (killed, used, following)))
