"""What this machine can do: each finding says what was found, what it is used for, and how to get it."""
from __future__ import annotations

import ctypes.util
import os
import platform
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Literal, NamedTuple

from rig.network import bus
from rig.run import priority

Status = Literal["ok", "limited", "missing"]


class Finding(NamedTuple):
    """One line of the doctor's table."""

    area: str
    name: str
    status: Status
    found: str
    purpose: str
    remedy: str = ""  # empty when nothing needs doing
    needed: bool = False  # without it not even the embedded bench runs


def examine_machine(seconds: float = 1.0) -> list[Finding]:
    """Examine everything; each timer measurement takes `seconds`, 0 skips them."""
    areas: list[Callable[[], Iterator[Finding]]] = [
        examine_python, examine_buses, examine_viewer, examine_tools, examine_storage]
    found = [finding for area in areas for finding in area()]
    return found + list(examine_rights()) + list(measure_timers(seconds) if seconds > 0 else ())


def _make_finding(area: str, name: str, value: str, purpose: str, remedy: str, needed: bool = False) -> Finding:
    """A finding that is ok with its `value`, or missing if `value` is empty."""
    if value:
        return Finding(area, name, "ok", value, purpose, needed=needed)
    return Finding(area, name, "missing", "not found", purpose, remedy, needed)


def _advise_apt(packages: str) -> str:
    return f"apt-get install {packages}"


def read_requirements() -> dict[str, list[str]]:
    """The project's declared dependencies by extra ('' for the plain ones): names only."""
    named: dict[str, list[str]] = {"": []}
    for line in metadata.requires("eha-rig") or []:
        requirement, _, marker = line.partition(";")
        name = requirement.strip().split("<")[0].split(">")[0].split("=")[0].split("!")[0].split("[")[0].strip()
        extra = marker.partition("==")[2].strip().strip("\"'")
        named.setdefault(extra, []).append(name)
    return named


def read_versions(names: list[str]) -> dict[str, str]:
    """Installed version of each distribution; empty if it is not installed."""
    found = {}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = ""
    return found


def examine_python() -> Iterator[Finding]:
    """The interpreter and the packages of each extra."""
    version = f"{platform.python_implementation()} {platform.python_version()}"
    new_enough = sys.version_info >= (3, 11)
    yield _make_finding("python", "Python", version if new_enough else "", "runs everything",
                        "Python 3.11 or newer", needed=True)
    extras = {"": "the bench", "view": "the rerun viewer", "dev": "the tests", "fleet": "rig campaign",
              "learn": "comparators of rig fdi", "bench": "rivals of rig bench"}
    for extra, names in read_requirements().items():
        found = read_versions(names)
        absent = [name for name, installed in found.items() if not installed]
        target = f"pip install 'eha-rig[{extra}]'" if extra else "pip install eha-rig"
        text = "" if absent else ", ".join(f"{name} {installed}" for name, installed in found.items())
        label = f"packages: {extra}" if extra else "packages"
        finding = _make_finding("python", label, text, extras.get(extra, extra), target, needed=not extra)
        yield finding._replace(found="missing: " + ", ".join(absent)) if absent else finding


def is_multicast_working(group: str = "239.74.163.2", port: int = 43113) -> bool:
    """True if a datagram sent to a multicast group on the loopback interface comes back."""
    local = socket.inet_aton("127.0.0.1")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(("", port))
            member = struct.pack("4s4s", socket.inet_aton(group), local)
            listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            listener.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, local)
            listener.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            listener.settimeout(1)
            listener.sendto(b"eha-rig", (group, port))
            return listener.recv(16) == b"eha-rig"
    except OSError:
        return False


def examine_buses() -> Iterator[Finding]:
    """Every way to a bus: embedded needs nothing; between processes udp_multicast or a CAN interface."""
    yield Finding("bus", "embedded", "ok", "always", "the bench in one process (rig run)", needed=True)
    multicast = "multicast on lo" if is_multicast_working() else ""
    remedy = "ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo"
    yield _make_finding("bus", "udp_multicast", multicast, "nodes in processes of their own, without CAN", remedy)
    yield _make_finding("bus", "CAN in the kernel", _describe_kernel_can(), "socketcan: real and virtual CAN",
                        "a kernel with CONFIG_CAN")
    up = ", ".join(bus.list_can_interfaces())
    remedy = bus.explain_socketcan_problem("vcan0")
    yield _make_finding("bus", "CAN interface", up, "rig run --bus socketcan:vcan0, or hardware", remedy)
    absent = [package for tool, package in GUEST_TOOLS.items() if shutil.which(tool, path=_SEARCH_PATH) is None]
    guest = "" if absent else "User-Mode Linux with a vcan0"
    yield _make_finding("bus", "CAN guest", guest, "the socketcan tests on a kernel without CAN",
                        _advise_apt(" ".join(absent)))


def _describe_kernel_can() -> str:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return ""
    return "AF_CAN"


_SEARCH_PATH = os.environ.get("PATH", "") + ":/usr/local/sbin:/usr/sbin:/sbin"  # users seldom have the last three
GUEST_TOOLS = {"linux.uml": "user-mode-linux", "insmod": "kmod", "ip": "iproute2"}


def examine_viewer() -> Iterator[Finding]:
    """What `rig view` needs: the viewer, and something that draws."""
    found = read_versions(["rerun-sdk"])["rerun-sdk"]
    yield _make_finding("viewer", "rerun", found, "rig view TRACE", "pip install 'eha-rig[view]'")
    screen = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY") or ""
    yield _make_finding("viewer", "display", screen, "the viewer's window; screenshots need none", "a desktop session")
    drivers = [file for folder in ("/usr/share", "/etc") for file in Path(folder, "vulkan/icd.d").glob("*.json")]
    library = ctypes.util.find_library("vulkan") or ""
    text = f"{library}, {len(drivers)} drivers" if library and drivers else ""
    yield _make_finding("viewer", "Vulkan", text, "draws it, also without a screen",
                        _advise_apt("mesa-vulkan-drivers libvulkan1"))


def _read_version_line(*command: str) -> str:
    """First line a tool prints about its version; empty if there is no such tool."""
    path = shutil.which(command[0], path=_SEARCH_PATH)
    if path is None:
        return ""
    try:
        out = subprocess.run([path, *command[1:]], capture_output=True, text=True, timeout=20, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return next(iter((out.stdout + out.stderr).splitlines()), path)


def examine_tools() -> Iterator[Finding]:
    """Programs of the system that some commands and tests use."""
    compiler = next((text for name in ("cc", "gcc", "clang") if (text := _read_version_line(name, "--version"))), "")
    yield _make_finding("tools", "C compiler", compiler, "rig bench compares with C", _advise_apt("gcc libc6-dev"))
    candump = shutil.which("candump", path=_SEARCH_PATH) or ""
    yield _make_finding("tools", "candump", candump, "an independent log of a CAN interface", _advise_apt("can-utils"))
    tshark = shutil.which("tshark", path=_SEARCH_PATH) or ""
    yield _make_finding("tools", "tshark", tshark, "an independent CANopen decoding", _advise_apt("tshark"))
    yield _make_finding("tools", "git", _read_version_line("git", "--version"), "the project's state in each log",
                        _advise_apt("git"))


def examine_storage() -> Iterator[Finding]:
    """Folders the software writes to."""
    from plant.compile import find_cache_folder  # here: it loads numba, which takes a second

    folder = find_cache_folder()
    kept = not folder.is_relative_to(tempfile.gettempdir())
    status: Status = "ok" if kept else "limited"
    remedy = "" if kept else "a writable home folder, or EHA_RIG_CACHE=FOLDER"
    yield Finding("storage", "compiled code", status, str(folder), "the plant starts in 0.2 s, not 10 s", remedy)
    free = shutil.disk_usage(Path.cwd()).free
    log_bytes_per_s = 500e3  # raw frames, signals and timing of a 1 kHz run, compressed
    hours = free / log_bytes_per_s / 3600
    status = "ok" if hours > 1 else "limited"
    remedy = "" if hours > 1 else "make room"
    yield Finding("storage", "disk", status, f"{free / 1e9:.1f} GB free", f"about {hours:.0f} h of logs", remedy)


def _read_text(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def examine_rights() -> Iterator[Finding]:
    """Kernel and rights that decide how well `--pace realtime` can keep its cycle."""
    preempt_rt = _read_text("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in platform.version()
    kernel = f"{platform.release()}, {'PREEMPT_RT' if preempt_rt else 'not PREEMPT_RT'}, {os.cpu_count()} CPUs"
    remedy = "" if preempt_rt else "a PREEMPT_RT kernel (Debian: linux-image-rt-amd64)"
    yield Finding("real time", "kernel", "ok" if preempt_rt else "limited", kernel, "bounds the worst lateness", remedy)
    fifo = bool(priority.run_under_fifo(lambda: True))
    limit = priority.read_priority_limit()
    text = f"SCHED_FIFO up to priority {limit}" if fifo else ""
    remedy = "as root: echo \"$USER - rtprio 90\" >> /etc/security/limits.d/rt.conf, then log in again"
    yield _make_finding("real time", "priority", text, "other programs do not delay the loop", remedy)
    locked = priority.read_memory_lock_limit()
    enough = locked < 0 or locked >= 1 << 29
    text = "unlimited" if locked < 0 else f"{locked / 1e6:.0f} MB"
    remedy = "" if enough else "as root: echo \"$USER - memlock unlimited\" >> /etc/security/limits.d/rt.conf"
    yield Finding("real time", "memory lock", "ok" if enough else "limited", text, "no page faults in the loop", remedy)
    source = _read_text("/sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown source"
    clock = f"{priority.read_clock_resolution_ns():.0f} ns, {source}"
    fine = priority.read_clock_resolution_ns() <= 1e3
    remedy = "" if fine else "a kernel with CONFIG_HIGH_RES_TIMERS"
    yield Finding("real time", "clock", "ok" if fine else "limited", clock, "the cycle's due times", remedy)


def measure_timers(seconds: float) -> Iterator[Finding]:
    """Lateness of a 1 kHz timer, measured now: as an ordinary process, and under SCHED_FIFO where that is allowed."""
    ordinary = priority.measure_timer_lateness(seconds)
    yield _make_timer_finding("timer at 1 kHz", ordinary, "what --pace realtime can expect here")
    fifo = priority.run_under_fifo(lambda: priority.measure_timer_lateness(seconds))
    if fifo is not None:
        yield _make_timer_finding("timer under FIFO", fifo, "the same with real-time priority")


def _make_timer_finding(name: str, late: priority.Lateness, purpose: str) -> Finding:
    text = f"late by {late.p50:.0f} us (p50), {late.p99:.0f} (p99), {late.p99_9:.0f} (p99.9), {late.max:.0f} (max)"
    if late.missed == 0:
        return Finding("real time", name, "ok", text, purpose)
    text += f"; {late.missed} of {late.periods} periods missed"
    return Finding("real time", name, "limited", text, purpose, "an idle machine, real-time priority, PREEMPT_RT")
