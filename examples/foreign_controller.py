"""A controller for the bench, written with python-can and canopen alone: python examples/foreign_controller.py [GROUP]

It joins the UDP bus of `rig run --controller external --bus udp_multicast:GROUP` as node 2 and closes the position
loop. It shows how a program joins a run. Unlike a firmware, it does not watch command, feedback, SYNC and heartbeat.
"""
from __future__ import annotations

import struct
import sys
import time
from pathlib import Path

import canopen

EDS = Path(__file__).parent.parent / "dbc" / "node2.eds"
GAIN, LIMIT = 3.8, 8e-3  # A/m, A
ACTIVE, READY = 7, 8


class Controller:
    """Node 2 on a network. canopen does SDO, heartbeat and NMT; the callbacks below do the cyclic frames."""

    def __init__(self, network: canopen.Network) -> None:
        self.network, self.node = network, canopen.LocalNode(2, str(EDS))
        self.received = self.latched = (0, 0, 0)  # demand in 1e-7 m, control word, cycle
        network.add_node(self.node)
        network.subscribe(0x000, self.on_nmt)
        network.subscribe(0x202, self.on_command)
        network.subscribe(0x080, self.on_sync)
        network.subscribe(0x183, self.on_feedback)

    def boot_up(self) -> None:
        """Send the boot-up frame and wait in PRE-OPERATIONAL."""
        self.node.nmt.state = "INITIALISING"
        self.node.nmt.state = "PRE-OPERATIONAL"

    def on_nmt(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        """Boot up after a reset, which canopen leaves to the program."""
        if data[0] in (129, 130) and data[1] in (0, 2):
            self.boot_up()

    def on_command(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        """Keep the command until SYNC."""
        self.received = struct.unpack("<iHH", data)

    def on_sync(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        """Take the command over."""
        self.latched = self.received

    def on_feedback(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        """Answer feedback with a drive frame: Cor = GAIN (Com - XJ), limited; no current unless ACTIVE."""
        if self.node.nmt.state != "OPERATIONAL":
            return
        demand, control, cycle = self.latched
        position, _pressure = struct.unpack("<ii", data)
        current = max(-LIMIT, min(LIMIT, GAIN * 1e-7 * (demand - position))) if control & ACTIVE == ACTIVE else 0.0
        drive = struct.pack("<iHH", round(current / 1e-8), control & ACTIVE | READY, cycle)
        self.network.send_message(0x182, drive)


def main() -> None:
    """Run the controller until Ctrl-C."""
    network = canopen.Network()
    network.connect(interface="eha_rig_udp", channel=sys.argv[1] if len(sys.argv) > 1 else "239.74.163.2")
    Controller(network).boot_up()
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        network.disconnect()


if __name__ == "__main__":
    main()
