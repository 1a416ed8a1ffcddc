"""`--bus` and EHA_RIG_BUS: what is taken, why, and what a bad one is told."""

import os
import socket
from pathlib import Path

import pytest

from plant.errors import InputError, RigError
from rig.network import bus as bus_module
from rig.network.bus import choose_bus, explain_socketcan_problem, open_can


@pytest.fixture(autouse=True)
def _no_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(bus_module.BUS_VARIABLE, raising=False)


@pytest.mark.parametrize(("live", "more"), [([], ""), (["vcan0"], "; vcan0 up, but not taken unasked")])
def test_auto_is_embedded_and_says_why(live: list[str], more: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_module, "list_can_interfaces", lambda: live)
    assert choose_bus() == ("embedded", f"embedded bus (neither --bus nor EHA_RIG_BUS is set){more}")


def test_asked_or_configured(monkeypatch: pytest.MonkeyPatch) -> None:
    for taken in ("embedded", "virtual", "virtual:x", "udp_multicast", "udp_multicast:239.1.2.3"):
        assert choose_bus(taken) == (taken, f"{taken}, as asked")
        monkeypatch.setenv(bus_module.BUS_VARIABLE, taken)
        assert choose_bus("auto") == (taken, f"{taken}, as EHA_RIG_BUS says")
        assert choose_bus("virtual:y")[0] == "virtual:y"  # asking beats the variable


def test_bad_spec(monkeypatch: pytest.MonkeyPatch) -> None:
    for bad in ("vcan0", "socketcan", "embedded:x", "udp_multicast:10.0.0.1", "udp_multicast:x", "nosuch:0"):
        with pytest.raises(InputError, match=f"--bus: {bad}: expected "):
            choose_bus(bad)
        monkeypatch.setenv(bus_module.BUS_VARIABLE, bad)
        with pytest.raises(InputError, match=f"EHA_RIG_BUS: {bad}: expected "):
            choose_bus("auto")
    with pytest.raises(InputError, match="--bus: expected auto, embedded, "):
        choose_bus("")


def test_embedded_is_no_bus_between_programs() -> None:
    with pytest.raises(InputError, match="between programs"):
        open_can("embedded")


def test_missing_interface_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked for or configured: an error, never a silent fall back to the simulation."""
    monkeypatch.setenv(bus_module.BUS_VARIABLE, "socketcan:vcan77")
    for use in (lambda: choose_bus("auto"), lambda: choose_bus("socketcan:vcan77"),
                lambda: open_can("socketcan:vcan77")):
        with pytest.raises(RigError, match=r"\Asocketcan:vcan77: .+\Z"):
            use()


def test_what_is_wrong_with_an_interface(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
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
    assert "ip link add vcan1 type vcan && sudo ip link set vcan1 up" in explain_socketcan_problem("vcan1")
    assert "ip link set can1 up type can bitrate 1000000" in explain_socketcan_problem("can1")
    assert explain_socketcan_problem("eth0") == "eth0 is not a CAN interface"
    assert explain_socketcan_problem("vcan0") == "vcan0 is down; sudo ip link set vcan0 up"
    assert explain_socketcan_problem("can0") == ""
    for name, mtu, advice in (("can0", "16", "ip link set can0 up type can bitrate 1000000 dbitrate 4000000 fd on"),
                              ("vcan0", "16", "ip link set vcan0 mtu 72 up")):
        (tmp_path / name / "flags").write_text("0xc1")
        (tmp_path / name / "mtu").write_text(mtu)
        assert explain_socketcan_problem(name) == ""
        assert explain_socketcan_problem(name, fd=True) == (
            f"{name} is set to classical CAN, not to CAN FD; sudo ip link set {name} down && sudo {advice}")
        (tmp_path / name / "mtu").write_text("72")
        assert explain_socketcan_problem(name, fd=True) == ""
        (tmp_path / name / "flags").write_text("0x80")
    (tmp_path / "can0" / "flags").write_text("0xc1")
    assert bus_module.list_can_interfaces() == ["can0"]


def test_kernel_without_can(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: int) -> None:
        raise OSError(97, os.strerror(97))

    monkeypatch.setattr(socket, "socket", refuse)
    assert "no SocketCAN" in explain_socketcan_problem("vcan0")
