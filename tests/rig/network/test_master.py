"""The canopen library as master through both kinds of wire; every wrong SDO answer ends in one line."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial

import codec
import pytest
from bus_stations import spec
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from plant import Model
from rig.benches import load_bench
from rig.network import (
    CONTROLLER,
    PLANT,
    BusError,
    EmbeddedWire,
    Frame,
    Link,
    LinkWire,
    Master,
    Send,
    VirtualClock,
    WallClock,
    Wire,
    open_can,
    serve_node,
)
from rig.network.sdo_client import CheckedSdoClient, ConfirmationError, repeat_transfer
from rig.nodes import Emulator, Firmware, Scenario
from rig.sequences import Plan

SCENARIO = Scenario(Model(), Plan(stop=10)).to_bytes()


@contextmanager
def served(where: str, *makers: type[Emulator] | type[Firmware]) -> Iterator[None]:
    """Nodes on a bus between programs, each in a thread of its own."""
    over, clock = threading.Event(), WallClock()
    links = [Link(open_can(where), clock.now) for _ in makers]
    threads = [threading.Thread(target=serve_node, args=(make(link.send), link, clock, over.is_set))
               for make, link in zip(makers, links, strict=True)]
    for link, thread in zip(links, threads, strict=True):
        link.select_frames([*load_bench().frames.by_identifier, *dict(load_bench().list_services())])
        thread.start()
    try:
        yield
    finally:
        over.set()
        for link, thread in zip(links, threads, strict=True):
            thread.join()
            link.close()


@pytest.fixture
def wire(bus_kind: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    if bus_kind == "embedded":
        yield EmbeddedWire(VirtualClock(), [Emulator, Firmware])
        return
    monkeypatch.setattr("rig.network.master.BOOT_TIMEOUT", 20.0)  # beside four busy processes 2 s were too short
    where, clock = spec(bus_kind), WallClock()
    with served(where, Emulator, Firmware), closing(LinkWire(Link(open_can(where), clock.now), clock)) as link:
        yield link


def alone() -> Master:
    """A master with nobody opposite."""
    return Master(EmbeddedWire(VirtualClock(), []), lambda: 0, False, load_bench())


def test_bring_up_and_some_cycles(wire: Wire) -> None:
    """Boot-up, scenario, gains, heartbeats, start: what a run begins with; then SYNCs that all nodes answer."""
    master = Master(wire, wire.clock.now, False, load_bench())
    node_states: list[tuple[int, int]] = []
    frames: list[int] = []
    master.hooks.on_state = lambda node, state: node_states.append((node, state))
    master.hooks.on_frame = lambda frame: frames.append(frame.cob_id)
    master.reset()
    master.configure(SCENARIO, Model().values, 0)
    master.start()
    assert wire.wait(lambda: set(master.states.values()) == {5}, 60.0)
    cycle = {codec.FEEDBACK, codec.VALVE_STATE, codec.DRIVE}
    for k in range(20):
        frames.clear()
        master.send(codec.COMMAND, codec.pack_command(1e-3, 7, k))
        master.send(codec.SYNC, b"")
        assert wire.wait(lambda: cycle <= set(frames), 60.0)
    master.stop()
    assert wire.wait(lambda: set(master.states.values()) == {127}, 60.0)
    for node in (CONTROLLER, PLANT):
        states = [state for n, state in node_states if n == node]
        assert 0 in states and states[-2:] == [5, 127]  # a heartbeat may come before the boot-up
    assert master.list_errors() == [] and not master.hears_rival(0.0)


def test_a_rig_that_stood_still_knows_how_long_answers_may_have_waited(wire: Wire) -> None:
    """An answer that has come while the rig stood still counts, and its time is known to be uncertain."""
    if isinstance(wire, EmbeddedWire):
        pytest.skip("there the nodes stand still with the rig")
    master = Master(wire, wire.clock.now, False, load_bench())
    master.reset()
    master.configure(SCENARIO, Model().values, 0, 10_000)
    master.start()
    threading.Event().wait(1.2)
    times = master.wait_for_operational(0.0)  # the time to wait is over at once
    assert set(times) == {CONTROLLER, PLANT}
    for time in times.values():
        assert time.seconds >= time.waited >= 1.1
    assert wire.stalled_ns >= 1_100_000_000


def test_refusals_name_node_and_object(wire: Wire) -> None:
    master = Master(wire, wire.clock.now, False, load_bench())
    master.reset()
    with pytest.raises(BusError, match=r"node 3 plant, object 0x2210: .*0x06090030"):
        master.configure(b"nonsense", None, 0)
    with pytest.raises(BusError, match=r"node 2 controller, object 0x2110:1: .*0x06090030"):
        master.configure(SCENARIO, {**Model().values, "controller.proportional_gain": float("nan")}, 0)


def test_nobody_there() -> None:
    master = alone()
    with pytest.raises(BusError, match=r"no boot-up from node 2 controller and node 3 plant within 2 s"):
        master.reset()
    with pytest.raises(BusError, match=r"node 3 plant, object 0x2210"):
        master.configure(SCENARIO, None, 0)
    assert not master.is_present(PLANT, 0.1)


Script = Sequence[str | None]


class Server:
    """Answers the requests of node 3 one after the other from a list of frames in hexadecimal; None: no answer."""

    def __init__(self, send: Send, script: Script) -> None:
        self._send, self._script = send, list(script)
        self.requests: list[str] = []

    def receive(self, frame: Frame) -> None:
        if frame.cob_id != 0x603:
            return
        self.requests.append(frame.data.hex())
        answer = self._script.pop(0) if self._script else None
        if answer is not None:
            self._send(0x583, bytes.fromhex(answer))

    def tick(self, t_ns: int) -> None:
        """No timers."""


def client(*script: str | None) -> tuple[CheckedSdoClient, Server]:
    servers: list[Server] = []

    def make(send: Send) -> Server:
        servers.append(Server(send, script))
        return servers[0]

    master = Master(EmbeddedWire(VirtualClock(), [make]), lambda: 0, False, load_bench())
    return master.network.nodes[PLANT].sdo, servers[0]


def test_a_transfer_that_the_server_has_lost_is_repeated() -> None:
    """The server gave up a second after the first segment, and refuses the next one."""
    begins, done = "6000100000000000", "2000000000000000"
    sdo, server = client(begins, done, "8000100001000405", begins, done, "3000000000000000")
    repeat_transfer(lambda: sdo.download(0x1000, 0, bytes(range(10))))
    assert [request[:2] for request in server.requests] == ["21", "00", "19", "21", "00", "19"]


@pytest.mark.parametrize(("code", "count"), [("00000306", 1), ("01000405", 3), ("00000405", 3)])
def test_a_refusal_is_not_repeated_and_a_loss_not_for_ever(code: str, count: int) -> None:
    sdo, server = client(*[f"80001000{code}"] * 4)
    with pytest.raises(SdoAbortedError):
        repeat_transfer(lambda: upload(sdo))
    assert len(server.requests) == count


def flush(sdo: CheckedSdoClient) -> None:
    """Deliver what the client sent last."""
    sdo.network.wire.wait(lambda: False, 0.0)


def upload(sdo: CheckedSdoClient, index: int = 0x1000) -> bytes:
    return sdo.upload(index, 0)


def download(sdo: CheckedSdoClient, index: int = 0x1017, data: bytes = b"\x64\0") -> None:
    sdo.download(index, 0, data)


upload_name = partial(upload, index=0x1008)
download_scenario = partial(download, index=0x2210, data=bytes(9))


@pytest.mark.parametrize(("transfer", "script", "line", "code"), [
    (upload, ["4301100000000000"], "SDO of object 0x1000 sub 0: confirmation of object 0x1001 sub 0", "01000405"),
    (upload, ["4300100100000000"], "SDO of object 0x1000 sub 0: confirmation of object 0x1000 sub 1", "01000405"),
    (upload, ["8001100000000206"], "SDO of object 0x1000 sub 0: abort of object 0x1001 sub 0", "01000405"),
    (upload, ["6000100000000000"], r"command specifier 3 \(0x60\), expected 2", "01000405"),
    (upload, ["c200100000000000"], r"command specifier 6 \(0xC2\), expected 2", "01000405"),
    (download, ["6017100100000000"], "SDO of object 0x1017 sub 0: confirmation of object 0x1017 sub 1", "01000405"),
    (download, ["6018100000000000"], "SDO of object 0x1017 sub 0: confirmation of object 0x1018 sub 0", "01000405"),
    (download, ["4317100000000000"], r"command specifier 2 \(0x43\), expected 3", "01000405"),
    (download, ["a017100000000000"], r"command specifier 5 \(0xA0\), expected 3", "01000405"),
    (upload_name, ["4108100009000000", "1061626364656667"], "wrong toggle bit", "00000305"),
    (upload_name, ["4108100009000000", "4161626364656667"], "command specifier 2", "01000405"),
    (upload_name, ["4108100005000000", "0061626364656667"], "more than the 5 bytes announced", "10000706"),
    (upload_name, ["4008100000000000", *["0061626364656667", "1061626364656667"] * 7, "0061626364656667"],
     "more than 100 bytes", "10000706"),
    (download_scenario, ["6010220000000000", "3000000000000000"], "wrong toggle bit", "00000305"),
    (download_scenario, ["6010220000000000", "2000000000000000", "2000000000000000"], "wrong toggle bit", "00000305"),
    (download_scenario, ["6010220000000000", "6010220000000000"], "command specifier 3", "01000405"),
    (upload, ["4b00100000000000"], "2 bytes, expected 4", ""),  # the transfer is over
    (upload, ["4100100006000000", "0361626364656600"], "6 bytes, expected 4", ""),
    (upload_name, ["4108100009000000", "0161626364656667"], "7 bytes, 9 were announced", ""),
])  # fmt: skip
def test_wrong_confirmation_ends_the_transfer(
    transfer: Callable[[CheckedSdoClient], object], script: Script, line: str, code: str
) -> None:
    sdo, server = client(*script)
    sdo.largest_upload = 100
    with pytest.raises(ConfirmationError, match=line) as caught:
        transfer(sdo)
    assert str(caught.value).startswith("node 3, SDO of object ") and "\n" not in str(caught.value)
    flush(sdo)
    aborts = [f"80{server.requests[0][2:8]}{code}"] if code else []  # it names the object
    assert server.requests[len(script):] == aborts  # and nothing comes after it


def test_what_is_right_passes() -> None:
    for answer in ("4300100092010000", "4200100092010000"):  # the second expedited without a length
        assert upload(client(answer)[0]) == bytes.fromhex("92010000")
    sdo, server = client("4108100009000000", "0061626364656667", "1b68690000000000")
    assert upload_name(sdo) == b"abcdefghi"
    assert [request[:2] for request in server.requests] == ["40", "60", "70"]
    sdo, server = client("6017100000000000")
    download(sdo)
    assert server.requests == ["2b17100064000000"]
    for data, commands in ((bytes(9), ["21", "00", "1b"]), (b"", ["21", "0f"])):
        sdo, server = client("6010220000000000", "2000000000000000", "3000000000000000")
        download(sdo, 0x2210, data)
        assert [request[:2] for request in server.requests] == commands


def test_refusal_by_the_server_keeps_its_code() -> None:
    with pytest.raises(SdoAbortedError) as caught:
        upload(client("8000100000000206")[0])
    assert caught.value.code == 0x06020000
    sdo, server = client("6010220000000000", "8010220030000906")
    with pytest.raises(SdoAbortedError):
        download_scenario(sdo)
    flush(sdo)
    assert len(server.requests) == 2  # nothing is sent after an abort


def test_silence_is_told_from_a_wrong_answer() -> None:
    sdo, server = client(None)
    with pytest.raises(SdoCommunicationError, match="No SDO response received"):
        upload(sdo)
    flush(sdo)
    assert server.requests[-1] == "8000100000000405"  # the abort 0x05040000
