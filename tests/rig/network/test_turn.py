"""The turn to send on a group of the UDP bus: who holds it, and that it ends with its holder."""

import subprocess
import sys

import can
import pytest
from bus_stations import spec

from plant.compile import compile_function
from rig.network.bus import open_can
from rig.network.raw_bus import NO_TURN, SENT, RawBus, send_frame
from rig.network.udp import PORT

TAKE = "import sys; from rig.network.udp import Turn; turn = Turn(sys.argv[1], int(sys.argv[2])); turn.take(); "


def find_group() -> str:
    return spec("udp_multicast").partition(":")[2]


def test_a_turn_that_is_held_is_one_line_and_ends_with_its_holder() -> None:
    group, send = find_group(), compile_function(send_frame)
    message = can.Message(arbitration_id=1, is_extended_id=False)
    with RawBus(f"udp_multicast:{group}") as bus, open_can(f"udp_multicast:{group}") as other:
        with subprocess.Popen([sys.executable, "-c", TAKE + "print('taken', flush=True); input()", group, str(PORT)],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
            assert holder.stdout is not None and holder.stdout.readline() == b"taken\n"
            with pytest.raises(can.CanError, match=f"turn to send.*process {holder.pid}"):
                other.send(message)
            status = send(bus.port, 1, 0, 0)
            assert status == NO_TURN
            error = str(bus.explain_failure(status))
            assert f"process {holder.pid}" in error and "\n" not in error
            holder.kill()
        assert send(bus.port, 1, 0, 0) == SENT
        other.send(message)
