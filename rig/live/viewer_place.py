"""Where `rig run --live rerun` shows a run: a window of its own, a viewer that is open already, or a file."""
from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import NamedTuple

from fdi.output import require_writable
from plant.errors import InputError
from rig.view.viewer import is_listening


class ViewerPlace(NamedTuple):
    """Neither a port nor a file: a window of its own."""

    port: int = 0  # of a viewer on 127.0.0.1
    file: Path | None = None


def find_viewer_place(text: str) -> ViewerPlace:
    """The place that --live names: rerun, rerun:PORT or rerun:FILE.rrd.

    Raises:
        InputError: the viewer is not installed, there is no display for its window, nothing listens at the port, or the
            file cannot be written.
    """
    if importlib.util.find_spec("rerun") is None:
        raise InputError("--live", "rerun", "the viewer, which is not installed: pip install 'eha-rig[view]'")
    word = text.partition(":")[2]
    if word.endswith(".rrd"):
        return ViewerPlace(file=Path(require_writable(word, "--live")))
    if word.isdecimal() and 0 < int(word) < 65536:
        if not is_listening(int(word)):
            raise InputError("--live", text, f"a viewer that listens on 127.0.0.1:{word} (rerun --bind 127.0.0.1 "
                                             f"--port {word})")
        return ViewerPlace(port=int(word))
    if text != "rerun":
        raise InputError("--live", text, "rerun, rerun:PORT of an open viewer, or rerun:FILE.rrd")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("--live", text, "a display for the viewer's window; without one rerun:FILE.rrd writes a file, "
                                         "and rerun:PORT uses a viewer that is open")
    return ViewerPlace()
