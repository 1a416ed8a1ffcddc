"""Cycles that were played together, as columns, and how they become the same bytes of a log as one by one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.network.frame import Frame
from rig.recorder.schema import CHANNELS, CanFrame, Signals, Timing, list_row_fields, make_packer


class CycleBlock(NamedTuple):
    """Some cycles: the frames of all, and the rows of all but the last, which is still under way."""

    t_ns: NDArray[np.int64]  # (n,) time of each
    frames: Sequence[tuple[int, NDArray[np.int64] | None]]  # in order: COB-ID, (n,) payloads of 8 bytes; None: 0 bytes
    columns: Mapping[str, Any]  # each field of `record` and Timing: (n,), or one value for all
    record: Any = Signals  # type of a row

    def list_frames(self, cob_id: int) -> list[Frame]:
        """The frames with this COB-ID."""
        times = self.t_ns.tolist()
        return [Frame(t_ns, cob_id, data.to_bytes(8, "little", signed=True))
                for known, payload in self.frames if known == cob_id and payload is not None
                for t_ns, data in zip(times, payload.tolist(), strict=True)]

    def make_row(self, i: int) -> tuple[Signals, Timing]:
        """A cycle as records."""
        row = {name: column[i].item() if isinstance(column, np.ndarray) else column
               for name, column in self.columns.items()}
        timing: Any = Timing
        signals, timing = (kind(*map(row.get, _list_names(kind))) for kind in (self.record, timing))
        return signals, timing

    def list_rows(self) -> Iterator[tuple[int, Signals | Timing]]:
        """Time and record of each row."""
        for i, t_ns in enumerate(self.t_ns[:-1].tolist()):
            yield from ((t_ns, record) for record in self.make_row(i))


@cache
def _list_names(record: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(record))


def pack_block(block: CycleBlock, epoch_ns: int) -> tuple[bytes, dict[int, NDArray[np.uint64]]]:
    """The messages of a block in the order in which they were sent, and for each channel its pairs of an index.

    A pair is the log time and the place of the message in the bytes.
    """
    kind, template = _make_template(tuple((cob_id, payload is not None) for cob_id, payload in block.frames),
                                    block.record)
    count, times = len(block.t_ns), (block.t_ns + epoch_ns).astype(np.uint64)
    table = np.frombuffer(template * count, kind).copy()
    for i, (_, payload) in enumerate(block.frames):
        if payload is not None:
            table[f"{i}"]["data"] = payload
    for name in (Signals.__name__, Timing.__name__):
        part = table[name]
        for column in block.columns.keys() & set(part.dtype.names or ()):
            part[column] = block.columns[column]
    for name in kind.names or ():
        table[name]["time"] = table[name]["published"] = times
    places = {name: int(offset) for name, (_, offset) in (kind.fields or {}).items()}  # type: ignore[misc]
    starts = np.arange(count, dtype=np.uint64) * np.uint64(kind.itemsize)
    kinds: dict[type, tuple[list[str], int]] = {CanFrame: ([f"{i}" for i in range(len(block.frames))], count)}
    kinds |= {record: ([record.__name__], count - 1) for record in (block.record, Timing)}
    index = {}
    for record, (names, rows) in kinds.items():
        pairs = np.empty((rows, len(names), 2), np.uint64)
        for j, name in enumerate(names):
            pairs[:, j, 0], pairs[:, j, 1] = times[:rows], starts[:rows] + np.uint64(places[name])
        index[CHANNELS[record]] = pairs.ravel()
    return table.tobytes()[:places[Signals.__name__] - kind.itemsize], index


@cache
def _make_template(frames: tuple[tuple[int, bool], ...], row: Any) -> tuple[np.dtype[Any], bytes]:
    """The messages of one cycle as a type and as bytes, numbers and payloads zero: its frames, then its row."""
    pack = make_packer(CanFrame)
    names, kinds, parts = [], [], []
    for i, (cob_id, has_payload) in enumerate(frames):
        tail = [("tag", "u1"), ("length", "u1"), *([("data", "<i8")] if has_payload else [])]
        names.append(f"{i}")
        kinds.append(np.dtype([*list_row_fields(CanFrame), *tail]))
        parts.append(pack(0, (0, cob_id, bytes(8 * has_payload))))
    for record in (row, Timing):
        names.append(record.__name__)
        kinds.append(np.dtype(list_row_fields(record)))
        parts.append(make_packer(record)(0, record(*[0] * len(fields(record)))))  # type: ignore[arg-type]
    return np.dtype(list(zip(names, kinds, strict=True))), b"".join(parts)
