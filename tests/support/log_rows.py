"""The rows of a run's log, byte for byte as they were written."""
from __future__ import annotations

from pathlib import Path

from mcap.reader import make_reader


def read_row_bytes(folder: Path) -> list[bytes]:
    """The bytes of each /signals message."""
    with (folder / "trace.mcap").open("rb") as stream:
        return [m.data for _, _, m in make_reader(stream).iter_messages(topics=["/signals"])]
