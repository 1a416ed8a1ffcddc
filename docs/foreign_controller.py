"""A controller for the bench, written with python-can and canopen alone: python docs/foreign_controller.py [GROUP]

It joins the UDP bus of `rig run --controller external --bus udp_multicast:GROUP` as node 2 and closes the position
loop. It shows how a program joins a run; it does not watch the rig's heartbeat or missing feedback, as a firmware must.
"""
import struct
import sys
import time
from pathlib import Path

import canopen

EDS = Path(__file__).parent.parent / "dbc" / "node2.eds"
GAIN, LIMIT = 3.8, 8e-3  # A/m, A
ACTIVE, READY = 7, 8

network = canopen.Network()
network.connect(interface="eha_rig_udp", channel=sys.argv[1] if len(sys.argv) > 1 else "239.74.163.2")
node = canopen.LocalNode(2, str(EDS))
network.add_node(node)  # SDO server, heartbeat, NMT state
received = latched = (0, 0, 0)  # demand in 1e-7 m, control word, cycle


def on_nmt(cob_id: int, data: bytearray, timestamp: float) -> None:
    """Boot up after a reset; canopen follows the other commands itself."""
    if data[0] in (129, 130) and data[1] in (0, 2):
        boot_up()


def boot_up() -> None:
    """Send the boot-up frame and wait in PRE-OPERATIONAL."""
    node.nmt.state = "INITIALISING"
    node.nmt.state = "PRE-OPERATIONAL"


def on_command(cob_id: int, data: bytearray, timestamp: float) -> None:
    """Keep the command until SYNC."""
    global received
    received = struct.unpack("<iHH", data)


def on_sync(cob_id: int, data: bytearray, timestamp: float) -> None:
    """Take the command over."""
    global latched
    latched = received


def on_feedback(cob_id: int, data: bytearray, timestamp: float) -> None:
    """Answer feedback with a drive frame: Cor = GAIN (Com - XJ), limited; no current unless ACTIVE."""
    if node.nmt.state != "OPERATIONAL":
        return
    demand, control, cycle = latched
    position, _pressure = struct.unpack("<ii", data)
    is_active = control & ACTIVE == ACTIVE
    current = max(-LIMIT, min(LIMIT, GAIN * 1e-7 * (demand - position))) if is_active else 0.0
    network.send_message(0x182, struct.pack("<iHH", round(current / 1e-8), control & ACTIVE | READY, cycle))


for cob_id, function in ((0x000, on_nmt), (0x202, on_command), (0x080, on_sync), (0x183, on_feedback)):
    network.subscribe(cob_id, function)
boot_up()
try:
    while True:
        time.sleep(1.0)
except KeyboardInterrupt:
    network.disconnect()
