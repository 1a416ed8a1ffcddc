"""Where a run came from: what the metadata record `run` of a log says."""
from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("eha-rig", "numpy", "numba", "python-can", "canopen", "mcap", "protobuf")


def provenance(**given: object) -> dict[str, str]:
    """Host, time, package versions and state of the checkout, with what only the caller knows (seed, bus, pace, model).

    >>> provenance(seed=1)["seed"]
    '1'
    """
    return {
        **{name: str(value) for name, value in given.items()},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}, {os.cpu_count()} processors",
        "python": platform.python_version(),
        **{f"version.{name}": _version(name) for name in PACKAGES},
        **_git(Path(__file__).parents[2]),
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _git(root: Path) -> dict[str, str]:
    """Commit and whether files differ from it; nothing when this is no checkout or git is missing."""
    if not (root / ".git").exists():
        return {}
    try:
        commit, changed = (subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=True,
                                          timeout=5).stdout.strip()
                           for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"]))
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"git.commit": commit, "git.state": f"{len(changed.splitlines())} files changed" if changed else "clean"}
