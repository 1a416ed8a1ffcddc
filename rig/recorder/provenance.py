"""Provenance of a run: the content of the metadata record `run` of its log."""
from __future__ import annotations

import os
import platform
import subprocess
import time
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

RECORDED_PACKAGES = ("eha-rig", "numpy", "numba", "python-can", "canopen", "mcap", "protobuf")


def collect_provenance(**given: object) -> dict[str, str]:
    """Collect host, time, package versions and state of the checkout; `given` adds seed, bus, pace, model.

    >>> collect_provenance(seed=1)["seed"]
    '1'
    """
    return {
        **{name: str(value) for name, value in given.items()},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}, {os.cpu_count()} processors",
        "python": platform.python_version(),
        **{f"version.{name}": _read_version(name) for name in RECORDED_PACKAGES},
        **_read_git_state(Path(__file__).parents[2]),
    }


def read_epoch_ns() -> int:
    """The date now, ns since 1970 (UTC); SOURCE_DATE_EPOCH, whole seconds, replaces it, for logs that are equal."""
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    is_date = given.isascii() and given.isdecimal() and len(given) < 11
    return int(given) * 10**9 if is_date else time.time_ns()


def _read_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _read_git_state(root: Path) -> dict[str, str]:
    """Commit and whether files differ from it; nothing when this is no checkout or git is missing."""
    if not (root / ".git").exists():
        return {}
    command = ["git", "--no-optional-locks",  # which a killed process would leave behind
               "-C", str(root), "status", "--porcelain=v2", "--branch", "--untracked-files=no"]
    try:
        lines = subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        return {}
    commit = next((line.removeprefix("# branch.oid ") for line in lines if line.startswith("# branch.oid ")), "")
    changed = sum(not line.startswith("#") for line in lines)
    return {"git.commit": commit, "git.state": f"{changed} files changed" if changed else "clean"}
