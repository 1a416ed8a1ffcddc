"""What this machine can do: each finding says what was found, what it is used for, and how to get it."""

import contextlib
import ctypes.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Literal, NamedTuple

from rig.benches import Bench, describe_identifier, list_loads
from rig.network import Frame, Link, LinkWire, WallClock, bus, udp
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


def examine_machine() -> list[Finding]:
    """Examine everything."""
    return [*examine_python(), *examine_buses(), *examine_viewer(), *examine_tools(), *examine_storage(),
            *examine_rights()]


def _find(area: str, name: str, value: str, purpose: str, remedy: str, needed: bool = False) -> Finding:
    """A finding that is ok with its `value`, or missing if `value` is empty."""
    if value:
        return Finding(area, name, "ok", value, purpose, needed=needed)
    return Finding(area, name, "missing", "not found", purpose, remedy, needed)


def _grade(area: str, name: str, is_enough: bool, value: str, purpose: str, remedy: str) -> Finding:
    """A finding with its `value` that is ok or limited."""
    return Finding(area, name, "ok" if is_enough else "limited", value, purpose, "" if is_enough else remedy)


def read_requirements() -> dict[str, list[str]]:
    """The project's declared dependencies by extra ('' for the plain ones): names only."""
    names: dict[str, list[str]] = {"": []}
    for line in metadata.requires("eha-rig") or []:
        requirement, _, marker = line.partition(";")
        name = requirement.strip().split("<")[0].split(">")[0].split("=")[0].split("!")[0].split("[")[0].strip()
        names.setdefault(marker.partition("==")[2].strip().strip("\"'"), []).append(name)
    return names


def read_versions(names: list[str]) -> dict[str, str]:
    """Installed version of each distribution; empty if it is not installed."""
    versions = {}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = ""
    return versions


def examine_python() -> Iterator[Finding]:
    """The interpreter and the packages of each extra."""
    version = f"{platform.python_implementation()} {platform.python_version()}"
    yield _find("python", "Python", version if sys.version_info >= (3, 11) else "", "runs everything",
                "Python 3.11 or newer", needed=True)
    extras = {"": "the bench", "shell": "completion of commands", "view": "the rerun viewer", "dev": "the tests",
              "plots": "plots in Python that can be zoomed", "fleet": "rig campaign", "fmu": "FMUs as plants",
              "measure": "rig import of MDF and Parquet", "learn": "comparators of rig fdi", "docs": "make docs",
              "bench": "rivals of rig bench"}
    for extra, names in read_requirements().items():
        versions = read_versions(names)
        absent = [name for name, installed in versions.items() if not installed]
        text = "" if absent else ", ".join(f"{name} {installed}" for name, installed in versions.items())
        finding = _find("python", f"packages: {extra}" if extra else "packages", text, extras.get(extra, extra),
                        f"pip install 'eha-rig[{extra}]'" if extra else "pip install eha-rig", needed=not extra)
        yield finding._replace(found="missing: " + ", ".join(absent)) if absent else finding


def is_multicast_working(group: str = "239.74.163.1") -> bool:
    """True if a datagram comes back that is sent as on the UDP bus; `group` is none that a run uses by default."""
    try:
        with contextlib.ExitStack() as stack:
            receiver, sender, _ = udp.open_sockets(group, udp.PORT, stack)
            receiver.settimeout(1)
            sender.sendto(b"eha-rig", (group, udp.PORT))
            return receiver.recv(16) == b"eha-rig"
    except OSError:
        return False


def examine_buses() -> list[Finding]:
    """Every way to a bus: embedded needs nothing; between processes udp_multicast or a CAN interface."""
    absent = [package for tool, package in GUEST_TOOLS.items() if not _find_tool(tool)]
    return [
        Finding("bus", "embedded", "ok", "always", "the bench in one process (rig run)", needed=True),
        _find("bus", "udp_multicast", "multicast on lo" if is_multicast_working() else "",
              "nodes in processes of their own, without CAN",
              "ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo"),
        _find("bus", "CAN in the kernel", "AF_CAN" if bus.has_socketcan() else "", "socketcan: real and virtual CAN",
              "a kernel with CONFIG_CAN"),
        _find("bus", "CAN interface", ", ".join(bus.list_can_interfaces()),
              "rig run --bus socketcan:vcan0, or hardware", bus.explain_socketcan_problem("vcan0")),
        _find("bus", "CAN guest", "" if absent else "User-Mode Linux with a vcan0",
              "the socketcan tests on a kernel without CAN", f"apt-get install {' '.join(absent)}")]


_SEARCH_PATH = os.environ.get("PATH", "") + ":/usr/local/sbin:/usr/sbin:/sbin"  # users seldom have the last three
GUEST_TOOLS = {"linux.uml": "user-mode-linux", "insmod": "kmod", "ip": "iproute2"}


def _find_tool(name: str) -> str:
    """Path of a program; empty if there is none."""
    return shutil.which(name, path=_SEARCH_PATH) or ""


def examine_viewer() -> list[Finding]:
    """What `rig view` needs: the viewer, and something that draws."""
    drivers = [file for folder in ("/usr/share", "/etc") for file in Path(folder, "vulkan/icd.d").glob("*.json")]
    library = ctypes.util.find_library("vulkan")
    return [
        _find("viewer", "rerun", read_versions(["rerun-sdk"])["rerun-sdk"], "rig view TRACE",
              "pip install 'eha-rig[view]'"),
        _find("viewer", "display", os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY") or "",
              "the viewer's window; screenshots need none", "a desktop session"),
        _find("viewer", "Vulkan", f"{library}, drivers: {len(drivers)}" if library and drivers else "",
              "draws it, also without a screen", "apt-get install mesa-vulkan-drivers libvulkan1")]


def _read_version_line(*command: str) -> str:
    """First line a tool prints about its version; empty if there is no such tool."""
    path = _find_tool(command[0])
    try:
        out = subprocess.run([path, *command[1:]], capture_output=True, text=True, timeout=20, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return next(iter((out.stdout + out.stderr).splitlines()), path)


def examine_tools() -> list[Finding]:
    """Programs of the system that some commands and tests use."""
    compiler = next((text for name in ("cc", "gcc", "clang") if (text := _read_version_line(name, "--version"))), "")
    return [
        _find("tools", "C compiler", compiler, "rig bench compares with C", "apt-get install gcc libc6-dev"),
        _find("tools", "candump", _find_tool("candump"), "an independent log of a CAN interface",
              "apt-get install can-utils"),
        _find("tools", "tshark", _find_tool("tshark"), "an independent CANopen decoding", "apt-get install tshark"),
        _find("tools", "git", _read_version_line("git", "--version"), "the project's state in each log",
              "apt-get install git")]


def examine_storage() -> list[Finding]:
    """Folders the software writes to."""
    from plant import find_cache_folder  # here: it loads numba, which takes a second

    folder = find_cache_folder()
    free = shutil.disk_usage(Path.cwd()).free
    log_bytes_per_s = 500e3  # raw frames, signals and timing of a 1 kHz run, compressed
    hours = free / log_bytes_per_s / 3600
    return [
        _grade("storage", "compiled code", not folder.is_relative_to(tempfile.gettempdir()), str(folder),
               "the plant starts in 0.2 s, not 10 s", "a writable home folder, or EHA_RIG_CACHE=FOLDER"),
        _grade("storage", "disk", hours > 1, f"{free / 1e9:.1f} GB free", f"about {hours:.0f} h of logs", "make room")]


def listen(bench: Bench, spec: str, seconds: float) -> list[Frame]:
    """All frames on the bus `spec` for so long; nothing is sent.

    Raises:
        RigError: the bus cannot be opened.
    """
    clock, frames = WallClock(), list[Frame]()
    with contextlib.closing(LinkWire(Link(bus.open_can(spec, bench.bitrate, bench.frames.is_fd), clock.now), clock)
                            ) as wire:
        wire.receive = frames.append
        wire.run_until(clock.now() + round(seconds * 1e9))
    return frames


def count_frames(bench: Bench, frames: Iterable[Frame]) -> tuple[dict[str, Counter[int]], Counter[str]]:
    """How many of each frame of the bench are among `frames`, by length in bytes; the identifiers of the others."""
    loads = list_loads(bench)
    services = {each.identifier: each.name for each in loads[len(bench.frames.frames):]}  # SYNC, heartbeats
    counts, others = {each.name: Counter[int]() for each in loads}, Counter[str]()
    for frame in frames:
        spec = bench.frames.find(frame.cob_id, frame.data)
        name = services.get(frame.cob_id) if spec is None else spec.name
        if name is None:
            others[describe_identifier(frame.cob_id)] += 1
        else:
            counts[name][len(frame.data)] += 1
    return counts, others


def judge_frames(bench: Bench, counts: dict[str, Counter[int]], others: Counter[str], seconds: float
                 ) -> Iterator[Finding]:
    """Which frames of a bench were heard within `seconds`."""
    loads = list_loads(bench)
    reached = {load.direction.split()[0] for load in loads if counts[load.name]}  # whose power and wiring are right
    for load in loads:
        frame_count, is_ours = counts[load.name].total(), load.direction.startswith("rig")
        wrong = sorted(length for length in counts[load.name] if length != load.length)
        status: Status = "limited" if wrong or (is_ours and frame_count) else "ok"
        text = f"{frame_count} frames in {seconds:g} s" if frame_count or not is_ours else "none; the rig sends it"
        text += f", some of {' and '.join(map(str, wrong))} bytes, not {load.length}" if wrong else ""
        remedy = "another rig is on the bus; end it" if is_ours and frame_count else ""
        if not frame_count and not is_ours:
            causes = [] if load.direction.split()[0] in reached else ["power, wiring, bit rate"]
            if load.name.startswith("heartbeat"):
                causes.append("some devices send it when the rig has set 0x1017")
            else:
                causes.append("PDOs come after NMT start" if bench.nodes else
                              "or it only answers the rig, which sends nothing here: see rig run")
            status, remedy = "missing", "; ".join(causes)
        yield Finding(bench.name, f"{load.name} {describe_identifier(load.identifier)}", status, text,
                      f"{load.direction}, every {1000 * load.period:g} ms", remedy)
    if others:
        listing = ", ".join(f"{name} ({count})" for name, count in sorted(others.items())[:8])
        yield Finding(bench.name, "other frames", "ok", listing, "not of this bench")


def _read_text(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def examine_rights() -> list[Finding]:
    """Kernel and rights that decide how well `--pace realtime` can keep its cycle."""
    is_preempt_rt = _read_text("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in platform.version()
    kernel = f"{platform.release()}, {'PREEMPT_RT' if is_preempt_rt else 'not PREEMPT_RT'}, {os.cpu_count()} CPUs"
    is_fifo, locked = priority.is_fifo_granted(), priority.read_memory_lock_limit()
    resolution = priority.read_clock_resolution_ns()
    source = _read_text("/sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown source"
    return [
        _grade("real time", "kernel", is_preempt_rt, kernel, "bounds the lateness that rig bench realtime measures",
               "a PREEMPT_RT kernel (Debian: linux-image-rt-amd64)"),
        _find("real time", "priority", f"SCHED_FIFO up to priority {priority.read_priority_limit()}" if is_fifo else "",
              "other programs do not delay the loop", "as root: echo \"$USER - rtprio 90\" >> "
                                                      "/etc/security/limits.d/rt.conf, then log in again"),
        _grade("real time", "memory lock", locked < 0 or locked >= 1 << 29,
               "unlimited" if locked < 0 else f"{locked / 1e6:.0f} MB", "no page faults in the loop",
               "as root: echo \"$USER - memlock unlimited\" >> /etc/security/limits.d/rt.conf"),
        _grade("real time", "clock", resolution <= 1e3, f"{resolution:.0f} ns, {source}", "the cycle's due times",
               "a kernel with CONFIG_HIGH_RES_TIMERS")]
