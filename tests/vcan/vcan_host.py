"""Where a real CAN interface is to be had: this kernel's own vcan0, or a User-Mode-Linux guest with one."""

import functools
import os
import shutil
import subprocess
from pathlib import Path
from typing import NoReturn

import pytest

from rig.network.bus import explain_socketcan_problem

FOLDER = Path(__file__).parent
ROOT = FOLDER.parent.parent
GUEST = FOLDER / "guest.sh"
APT_LINE = "apt-get install user-mode-linux kmod iproute2 can-utils gcc libc6-dev"
REQUIRED = os.environ.get("EHA_RIG_REQUIRE_VCAN") == "1"  # then nothing about vcan may be skipped


def skip_or_fail(reason: str) -> NoReturn:
    """Skip the test, or fail it where CI must not skip, and say what to install."""
    message = f"{reason}; {APT_LINE}"
    if REQUIRED:
        pytest.fail(message)
    pytest.skip(message)


@functools.cache
def kernel_has_vcan0() -> bool:
    """True if vcan0 is there and up in this very kernel. Nothing is sent: somebody may be using it."""
    return not explain_socketcan_problem("vcan0")


@functools.cache
def guest_missing() -> str:
    """Why the guest does not work, in one line; empty if it does. Boots it, if it has not yet since the machine did."""
    if shutil.which("bash") is None:
        return "guest.sh: bash is missing"
    return subprocess.run(["bash", str(GUEST), "--check"], capture_output=True, text=True).stderr.strip()


def in_guest(*command: str | Path, timeout_s: int = 1800) -> subprocess.CompletedProcess[str]:
    """Run a command with vcan0 in the project's folder: directly where the kernel can, else in the guest."""
    words = [str(word) for word in command]
    if not kernel_has_vcan0():
        words = ["bash", str(GUEST), *words]
    environment = {**os.environ, "GUEST_TIMEOUT": str(timeout_s)}
    return subprocess.run(
        words, cwd=ROOT, env=environment, timeout=timeout_s + 30, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )
