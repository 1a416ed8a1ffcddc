"""The UDP bus as a python-can interface: programs that know nothing of this project join a run in one line."""

import subprocess
import sys
import time
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import can
import pytest
from bus_stations import spec
from places import ROOT
from rig_command import SHORT, SLOW_START, rig

from rig.network.can_interface import UdpBus


def find_group() -> str:
    return spec("udp_multicast").partition(":")[2]


def frame(cob_id: int, data: bytes = b"\1\2\3") -> can.Message:
    return can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)


def test_it_is_registered_where_python_can_looks() -> None:
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    declared = EntryPoint("eha_rig_udp", groups["can.interface"]["eha_rig_udp"], "can.interface")
    assert declared.load() is UdpBus
    with can.Bus(interface="eha_rig_udp", channel=find_group(), bitrate=1_000_000) as bus:
        assert type(bus) is UdpBus


def test_a_message_has_the_time_of_its_reception_and_passes_the_filters() -> None:
    group = find_group()
    filters = [{"can_id": 0x182, "can_mask": 0x7FF, "extended": False}]
    with UdpBus(group, can_filters=filters) as bus, UdpBus(group) as other:
        before = time.time()
        for cob_id in (0x80, 0x182, 0x183):
            other.send(frame(cob_id))
        heard = bus.recv(60.0)
        assert heard is not None and heard.arbitration_id == 0x182 and before <= heard.timestamp <= time.time()
        assert group in str(heard.channel) and bus.recv(0.1) is None


@pytest.mark.parametrize(("options", "words"), [
    ({"channel": "10.0.0.1"}, "an IPv4 multicast group"),
    ({"channel": "239.0.0.1", "receive_own_messages": True}, "receive_own_messages is not possible")])
def test_what_it_cannot_do_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(can.CanInitializationError, match=words):
        UdpBus(**options)  # type: ignore[arg-type]


def test_a_controller_of_python_can_and_canopen_alone_passes_a_run(tmp_path: Path) -> None:
    group = find_group()
    (tmp_path / "short.toml").write_text(SHORT + SLOW_START)
    program = ROOT / "examples" / "foreign_controller.py"
    imports = [line for line in program.read_text().splitlines() if line.startswith(("import", "from"))]
    assert not any(package in line for line in imports for package in ("rig", "plant", "fdi", "dbc"))
    other = subprocess.Popen([sys.executable, program, group])
    try:
        with can.Bus(interface="eha_rig_udp", channel=group) as bus:
            boot = bus.recv(60.0)
            assert boot is not None and (boot.arbitration_id, bytes(boot.data)) == (0x702, b"\0")
        said = rig("run", tmp_path / "short.toml", "--bus", f"udp_multicast:{group}", "--controller", "external",
                   "--out", tmp_path / "out", "--json")
    finally:
        other.terminate()
        other.wait(20)
    assert (said.json["verdict"], said.status) == ("PASS", 0), said
