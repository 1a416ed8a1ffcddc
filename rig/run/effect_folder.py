"""The folder for effect files taken out of a log: nodes in other processes read them by their paths."""
from __future__ import annotations

import atexit
import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
from pathlib import Path

_PREFIX = "eha-rig-effects-"


def make_effect_folder() -> Path:
    """A new folder in the system's folder for temporary files, which the end of this process removes.

    A killed process leaves its folder behind; the next one that makes a folder removes it.
    """
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
    _lock(folder)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    # Another process may just have made one, and be about to lock it: a minute is enough for that.
    remove_left_folders(folder.parent, folder.stat().st_mtime - 60.0)
    return folder


def remove_left_folders(where: Path, before: float) -> None:
    """Remove this user's effect folders that no process holds a lock on and that are older than `before`, s (epoch)."""
    for folder in where.glob(_PREFIX + "*"):
        with contextlib.suppress(OSError):  # somebody else removes it, or it is in use
            facts = folder.lstat()
            is_own = stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.getuid()
            if is_own and facts.st_mtime < before:
                lock = _lock(folder)
                shutil.rmtree(folder, ignore_errors=True)
                os.close(lock)


def _lock(folder: Path) -> int:
    """Lock a folder until the descriptor returned is closed or this process ends. Raises OSError if it is locked."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
