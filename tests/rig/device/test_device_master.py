"""The slave core against an independent implementation: the canopen library as master on the same embedded bus."""

import canopen
import pytest
from device_bench import make_device

from dbc import EDS
from rig.device import NmtState
from rig.network.bus import EmbeddedBus
from rig.network.frame import Frame


class Master(canopen.Network):  # type: ignore[misc]  # canopen is not typed
    """canopen's network on an embedded bus: a frame sent is delivered, and answered, before the call returns."""

    def __init__(self, bus: EmbeddedBus) -> None:
        super().__init__()
        self._bus, self._send = bus, bus.attach(self._receive)

    def _receive(self, frame: Frame) -> None:
        self.notify(frame.cob_id, bytearray(frame.data), frame.t_ns / 1e9)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        assert not remote
        self._send(can_id, bytes(data))
        self._bus.deliver(0)


@pytest.mark.parametrize("node", [2, 3])
def test_every_service_answers_as_canopen_expects(node: int) -> None:
    bus = EmbeddedBus()
    master = Master(bus)
    remote = master.add_node(node, str(EDS[node]))
    device = bus.add(lambda send: make_device(node, EDS[node], send))

    def deliver(t_ns: int = 0) -> None:
        device.tick(t_ns)
        bus.deliver(t_ns)

    deliver()
    assert remote.nmt.state == "PRE-OPERATIONAL"
    for (index, sub), entry in device.od.entries.items():  # expedited or segmented, as the dictionary says
        item = remote.sdo[index]
        variable = item if isinstance(item, canopen.sdo.SdoVariable) else item[sub]
        if index == 0x1003 and sub:
            with pytest.raises(canopen.SdoAbortedError, match="0x08000024"):
                variable.raw  # noqa: B018
        elif entry.readable:
            value = variable.raw
            assert (value.encode() if isinstance(value, str) else value) == device.read(index, sub)
    remote.tpdo.read()  # the configuration of the PDOs, by SDO
    remote.rpdo.read()
    remote.nmt.state = "OPERATIONAL"
    assert device.state is NmtState.OPERATIONAL
    deliver(100_000_000)
    assert remote.nmt.state == "OPERATIONAL"
    device.emcy.raise_error(0x8250, 0x10, b"\1\2")
    deliver(100_000_000)
    device.emcy.clear()
    deliver(100_000_000)
    log = [(error.code, error.register, error.data) for error in remote.emcy.log]
    assert log == [(0x8250, 0x11, b"\1\2\0\0\0"), (0, 0, bytes(5))] and remote.emcy.active == []
    if node == 2:
        remote.sdo[0x2110]["Proportional gain"].raw = 4.25
        assert device.read(0x2110, 1) == 4.25
        return
    scenario = bytes(range(256)) * 20
    remote.sdo[0x2210].raw = scenario
    assert device.read(0x2210) == scenario
    device.on_sync = lambda: (device.write(0x2200, 0, -5), device.write(0x2204, 0, device.read(0x2207)))
    remote.rpdo[1]["Cycle answered by the controller"].raw = 41
    remote.rpdo[1].transmit()
    master.sync.transmit()
    assert remote.tpdo[1]["Ram position XJ"].phys == pytest.approx(-5e-7) and remote.tpdo[2]["Cycle"].raw == 41
    assert (remote.tpdo[1].cob_id, remote.tpdo[2].cob_id, remote.tpdo[1].trans_type) == (0x183, 0x283, 1)
