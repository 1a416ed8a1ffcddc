"""The rows of a run's log: byte for byte as they were written, or kept as the loop gives them."""

from pathlib import Path

from mcap.reader import make_reader

from rig.recorder import Signals, Timing


class CycleList:
    """A log that keeps each cycle in a list."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self.rows: list[Signals] = []
        self.timings: list[Timing] = []

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        self.times.append(t_ns)
        self.rows.append(signals)
        self.timings.append(timing)


def read_row_bytes(folder: Path) -> list[bytes]:
    """The bytes of each /signals message."""
    with (folder / "trace.mcap").open("rb") as stream:
        return [m.data for _, _, m in make_reader(stream).iter_messages(topics=["/signals"])]


def describe_first_difference(folder: Path, other: Path) -> str:
    """Where two logs differ first, in one line: a comparison of thousands of rows would fill pages when it fails."""
    rows, others = read_row_bytes(folder), read_row_bytes(other)
    for number, (row, other_row) in enumerate(zip(rows, others, strict=False)):
        if row != other_row:
            return f"row {number}: {row.hex()} is not {other_row.hex()}"
    return f"none in {len(rows)} rows" if len(rows) == len(others) else f"{len(rows)} rows are not {len(others)}"
