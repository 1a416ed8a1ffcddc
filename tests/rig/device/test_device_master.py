"""The slave core against an independent implementation: the canopen library as master on the same embedded bus."""
from __future__ import annotations

from collections.abc import Iterator

import canopen
import pytest
from device_bench import make_device

from dbc import EDS
from rig.device import NmtState
from rig.network.bus import EmbeddedBus
from rig.network.frame import Frame

MS = 1_000_000  # ns


class Master(canopen.Network):  # type: ignore[misc]  # canopen is not typed
    """canopen's network on an embedded bus: a frame sent is delivered, and answered, before the call returns."""

    def __init__(self, bus: EmbeddedBus) -> None:
        super().__init__()
        self.t_ns = 0
        self._embedded = bus
        self._send = bus.attach(self._receive)

    def _receive(self, frame: Frame) -> None:
        self.notify(frame.cob_id, bytearray(frame.data), frame.t_ns / 1e9)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        assert not remote
        self._send(can_id, bytes(data))
        self._embedded.deliver(self.t_ns)


class Bench:
    """Nodes 2 and 3, booted, and their remote images in the master."""

    def __init__(self) -> None:
        bus = EmbeddedBus()
        self.master = Master(bus)
        self.remotes = {n: self.master.add_node(n, str(EDS[n])) for n in (2, 3)}
        self.devices = {n: bus.add(lambda send, n=n: make_device(n, EDS[n], send)) for n in (2, 3)}  # type: ignore[misc]
        self._bus = bus
        self.wait(0)

    def wait(self, ms: int) -> None:
        end = self.master.t_ns + ms * MS
        while True:
            for device in self.devices.values():
                device.tick(self.master.t_ns)
            self._bus.deliver(self.master.t_ns)
            if self.master.t_ns >= end:
                return
            self.master.t_ns += MS


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    for remote in bench.remotes.values():
        remote.pdo.stop()


def test_master_sees_boot_up_and_heartbeat(bench: Bench) -> None:
    remote = bench.remotes[3]
    assert remote.nmt.state == "PRE-OPERATIONAL"
    remote.nmt.state = "OPERATIONAL"
    assert bench.devices[3].state is NmtState.OPERATIONAL
    bench.wait(100)
    assert remote.nmt.state == "OPERATIONAL"
    remote.nmt.state = "STOPPED"
    bench.wait(100)
    assert (remote.nmt.state, bench.devices[3].state) == ("STOPPED", NmtState.STOPPED)
    remote.nmt.send_command(0x81)
    assert bench.devices[3].state is NmtState.PRE_OPERATIONAL
    assert bench.devices[2].state is NmtState.PRE_OPERATIONAL


@pytest.mark.parametrize("node", [2, 3])
def test_master_reads_every_readable_object(bench: Bench, node: int) -> None:
    """Each answers as the dictionary says, expedited or segmented; an empty history entry says there is no data."""
    read = 0
    for (index, sub), entry in bench.devices[node].od.entries.items():
        if not entry.readable:
            continue
        item = bench.remotes[node].sdo[index]
        variable = item if isinstance(item, canopen.sdo.SdoVariable) else item[sub]
        if index == 0x1003 and sub:
            with pytest.raises(canopen.SdoAbortedError, match="0x08000024"):
                variable.raw  # noqa: B018
            continue
        value = variable.raw
        assert (value.encode() if isinstance(value, str) else value) == bench.devices[node].read(index, sub)
        read += 1
    assert read > 50


def test_master_writes_gains_and_a_scenario_of_several_kilobytes(bench: Bench) -> None:
    bench.remotes[2].sdo[0x2110]["Proportional gain"].raw = 4.25
    assert bench.devices[2].read(0x2110, 1) == 4.25
    scenario = bytes(range(256)) * 20
    bench.remotes[3].sdo[0x2210].raw = scenario
    assert bench.devices[3].read(0x2210) == scenario


def test_master_decodes_pdos(bench: Bench) -> None:
    """canopen reads the PDO configuration from the device by SDO and decodes what comes on SYNC."""
    remote, device = bench.remotes[3], bench.devices[3]
    remote.tpdo.read()
    remote.rpdo.read()
    device.on_sync = lambda: (device.write(0x2200, 0, -5), device.write(0x2204, 0, device.read(0x2207)))
    bench.master.nmt.state = "OPERATIONAL"
    remote.rpdo[1]["Cycle answered by the controller"].raw = 41
    remote.rpdo[1].transmit()
    bench.master.sync.transmit()
    assert remote.tpdo[1]["Ram position XJ"].raw == -5
    assert remote.tpdo[1]["Ram position XJ"].phys == pytest.approx(-5e-7)
    assert remote.tpdo[2]["Cycle"].raw == 41
    assert (remote.tpdo[1].cob_id, remote.tpdo[2].cob_id, remote.tpdo[1].trans_type) == (0x183, 0x283, 1)


def test_master_collects_emergencies(bench: Bench) -> None:
    bench.devices[3].emcy.raise_error(0x8250, 0x10, b"\1\2")
    bench.wait(0)
    bench.devices[3].emcy.clear()
    bench.wait(0)
    log = bench.remotes[3].emcy.log
    assert [(error.code, error.register, error.data) for error in log] == [
        (0x8250, 0x11, b"\1\2\0\0\0"), (0, 0, bytes(5)),
    ]  # fmt: skip
    assert bench.remotes[3].emcy.active == []
