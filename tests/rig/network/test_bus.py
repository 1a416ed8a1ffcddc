"""One set of tests for every back end, then what is particular to each."""

import select
import socket
import struct
import time

import can
import codec
import pytest
from bus_stations import gather, spec, stations

from plant.errors import RigError
from rig.benches.bench import EXTENDED, FD, SWITCHED
from rig.network.bus import Link, open_can
from rig.network.can_interface import UdpBus
from rig.network.frame import FD_LENGTHS, Frame, find_cob_id
from rig.network.udp import PORT

only_socketcan = pytest.mark.parametrize("bus_kind", ["socketcan"], indirect=True)
only_udp = pytest.mark.parametrize("bus_kind", ["udp_multicast"], indirect=True)
between_programs = pytest.mark.parametrize("bus_kind", ["udp_multicast", "socketcan"], indirect=True)
links = pytest.mark.parametrize("bus_kind", ["virtual", "udp_multicast", "socketcan"], indirect=True)


def contents(frames: list[Frame]) -> list[tuple[int, bytes]]:
    return [(frame.cob_id, frame.data) for frame in frames]


class TestEveryBus:
    """What the bench needs of a bus, whichever it is."""

    def test_frames_of_all_kinds_reach_everybody_but_their_sender_unchanged_and_in_order(self, bus_kind: str) -> None:
        identifiers = [cob_id | wide for cob_id in (0, 0x7F, 0x80, 0x182, 0x7FF) for wide in (0, EXTENDED)]
        identifiers += [EXTENDED | 0x800, EXTENDED | 0x18FEF1AB, EXTENDED | 0x1FFFFFFF]
        sent = [(cob_id, bytes(range(0xF0, 0xF0 + length))) for length in (0, 1, 8) for cob_id in identifiers]
        sent += [(cob_id | FD, data) for cob_id, data in sent]
        sent += [(cob_id | FD, bytes(range(length))) for length in FD_LENGTHS for cob_id in identifiers]
        sent += [(n % 0x700, struct.pack("<I", n)) for n in range(150)]
        with stations(bus_kind, fd=True) as (sender, *others):
            for cob_id, data in sent:
                sender.send(cob_id | SWITCHED if cob_id & FD else cob_id, data)
            for station in others:
                assert contents(gather(station, len(sent))) == sent
            assert sender.poll(0.02) == []

    def test_answer_comes_after_what_it_answers(self, bus_kind: str) -> None:
        with stations(bus_kind) as (asking, answering, listening):
            for n in range(20):
                asking.send(0x600, bytes([n]))
                gather(answering, 1)
                answering.send(0x580, bytes([n]))
                gather(asking, 1)
            heard = contents(gather(listening, 40))
        assert heard == [(cob_id, bytes([n])) for n in range(20) for cob_id in (0x600, 0x580)]

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
            assert isinstance(receiver, Link)
            for left_out in ((0x080, 0x182, 0x000), (), (0x7FF, 0x07F), (), (EXTENDED | 0x080, FD | 0x200),
                             (EXTENDED | 0x18FEF1AB, FD | EXTENDED | 0x12345, 0x7F)):
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
        where = spec(bus_kind)
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
    def test_foreign_frames_are_counted_and_dropped(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        with open_can(where) as bus, open_can(where) as other:
            link = Link(bus, time.monotonic_ns)
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=2))
            other.send(can.Message(arbitration_id=0x123, is_extended_id=True, is_remote_frame=True))
            if bus_kind != "socketcan":  # there the controller makes them
                other.send(can.Message(is_error_frame=True))
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"2"))
            assert contents(gather(link, 1)) == [(0x123, b"2")]
            assert (link.dropped, link.error_frames, link.overflows, link.unsent) == (2, bus_kind != "socketcan", 0, 0)

    @links
    def test_a_bus_of_python_can_hears_and_sends_the_same(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        with open_can(where, fd=True) as bus, open_can(where, fd=True) as other:
            link = Link(bus, time.monotonic_ns)
            for flags in ({}, {"is_fd": True}, {"is_fd": True, "bitrate_switch": True}):
                for is_extended in (False, True):
                    data = bytes(64 if flags else 8)
                    sent = can.Message(arbitration_id=0x123, is_extended_id=is_extended, data=data, **flags)
                    other.send(sent)
                    (frame,) = gather(link, 1)
                    assert frame.cob_id == find_cob_id(sent) & ~SWITCHED and frame.data == data
                    link.send(find_cob_id(sent), data)
                    heard = other.recv(60)
                    assert heard is not None
                    assert heard.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)

    @links
    def test_nodes_are_selected_by_classical_frames(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            assert isinstance(receiver, Link)
            receiver.select_nodes(3)
            for cob_id in (0x183, 0x184, EXTENDED | 0x183, 0x080):
                sender.send(cob_id, b"")
            assert [frame.cob_id for frame in gather(receiver, 2)] == [0x183, 0x080]
            receiver.select_nodes(None)
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
            assert isinstance(link, Link)
            raw.bind(("vcan0",))
            raw.send(struct.pack("=IB3x8s", 0x20000004, 8, b"\0\1" + bytes(6)))
            raw.send(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))
            assert gather(link, 1, timeout=0.1) == []
            assert (link.error_frames, link.overflows, link.dropped) == (2, 1, 0)

    @between_programs
    def test_loss_is_counted_to_the_frame(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            assert isinstance(receiver, Link)
            many = 60_000  # more than the large receive buffer of a CAN socket holds
            for n in range(many):
                sender.send(0x100, struct.pack("<I", n))
            kept = sum(len(frames) for frames in iter(lambda: receiver.poll(0.5), []))  # some come late
            sender.send(0x101, b"")  # the count rides on the next frame
            gather(receiver, 1)
            assert kept > 0 and kept + receiver.overflows == many
            assert kept < many or bus_kind != "socketcan"

    @only_socketcan
    def test_time_is_that_of_reception_not_of_polling(self, bus_kind: str) -> None:
        with stations(bus_kind, 2) as (sender, receiver):
            begin = time.monotonic_ns()
            sender.send(0x100, b"")
            sender.send(0x101, b"")
            sent = time.monotonic_ns() - begin
            time.sleep(0.1)
            first, second = gather(receiver, 2)
            assert 0 <= second.t_ns - first.t_ns <= sent + 100_000

    def test_a_bus_that_is_gone_is_one_line(self) -> None:
        link = Link(open_can(spec("virtual")), time.monotonic_ns)
        link.close()
        for use in (lambda: link.send(0x80, b""), lambda: link.poll()):
            with pytest.raises(RigError, match=r"\A.+\Z"):
                use()


@only_udp
class TestUdpMulticast:
    def test_stays_on_the_loopback_interface(self, bus_kind: str) -> None:
        with open_can(spec(bus_kind)) as bus:
            assert isinstance(bus, UdpBus)
            assert bus._tx.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0
            assert bus._tx.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, 4) == socket.inet_aton("127.0.0.1")
            assert bus._tx.getsockname()[0] == "127.0.0.1"

    def test_strangers_datagram_is_an_error_frame(self, bus_kind: str) -> None:
        where = spec(bus_kind)
        with open_can(where) as bus, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            link = Link(bus, time.monotonic_ns)
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            stranger.sendto(b"\xff", (where.partition(":")[2], PORT))
            assert gather(link, 1, timeout=0.1) == []
            assert link.error_frames == 1
