"""Rows and messages of a run in shared memory: one process writes, another reads, and no lock is between them.

The thread that writes the log fills two rings, of rows and of messages, and raises a counter after each entry. The
reader copies what is new and drops what was overwritten meanwhile, by the number that each entry carries. A reader that
is slow, stopped or gone therefore never delays the writer; it misses entries, and counts them.
"""
from __future__ import annotations

import json
import mmap
import struct
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.recorder import Record, Signals, Timing

COLUMNS = ("number", "t_ns", "phase", "com", "xj", "cor", "p12", "xs", "load", "lateness", "response", "overrun")
ROWS = 1 << 16  # three seconds of the fastest run in lockstep, a minute in real time
MESSAGES, MESSAGE_BYTES = 2048, 1024
_HEAD = 4096  # bytes; words of 8: rows, messages, whether the run is over, whether the reader is ready
_ROW = struct.Struct(f"={len(COLUMNS)}d")
_MESSAGE_HEAD = struct.Struct("=QQ")  # number, length
_MOST = MESSAGE_BYTES - _MESSAGE_HEAD.size
_SIZE = _HEAD + ROWS * _ROW.size + MESSAGES * MESSAGE_BYTES


class Message(NamedTuple):
    """An event, a state of a node or a check, as in the log."""

    kind: str  # Event, NmtState or Check
    t_ns: int
    fields: dict[str, Any]


def make_shared_file() -> IO[bytes]:
    """A file in memory without a name: nothing is left of it when both processes have ended. Raises OSError."""
    folder = Path("/dev/shm")
    file = tempfile.TemporaryFile(dir=folder if folder.is_dir() else None)  # noqa: SIM115 (the caller closes it)
    file.truncate(_SIZE)
    return file


class _Memory:
    """The shared file with this descriptor, as both ends see it."""

    def __init__(self, number: int) -> None:
        self._memory = mmap.mmap(number, _SIZE)
        self._words = np.frombuffer(self._memory, np.uint64, 4)
        self._rows = self._messages = 0  # written or read here

    def _find_message(self, number: int) -> int:
        return _HEAD + ROWS * _ROW.size + number % MESSAGES * MESSAGE_BYTES


class LiveFeed(_Memory):
    """The writing end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self._memory[:] = bytes(_SIZE)  # every page is there before the run begins
        self._signals: Signals | None = None

    def observe(self, t_ns: int, record: Record) -> None:
        """Add a record of the log: `Signals` with the `Timing` that follows is a row, others are messages."""
        if isinstance(record, Signals):
            self._signals = record
        elif isinstance(record, Timing):
            row = self._signals
            if row is not None and row.cycle == record.cycle:
                _ROW.pack_into(self._memory, _HEAD + self._rows % ROWS * _ROW.size, self._rows, t_ns, row.phase,
                               row.com, row.xj, row.cor, row.p12, row.xs, row.load, record.lateness, record.response,
                               record.overrun)
                self._rows += 1
                self._words[0] = self._rows
        else:
            self._add_message(Message(type(record).__name__, t_ns, asdict(record)))

    def _add_message(self, message: Message) -> None:
        data = json.dumps(message).encode()
        if len(data) > _MOST:  # a text for people, too long for a screen anyway
            fields = {key: value[:60] if isinstance(value, str) else value for key, value in message.fields.items()}
            data = json.dumps(message._replace(fields=fields)).encode()
        if len(data) <= _MOST:
            at = self._find_message(self._messages)
            self._memory[at + _MESSAGE_HEAD.size:at + _MESSAGE_HEAD.size + len(data)] = data
            _MESSAGE_HEAD.pack_into(self._memory, at, self._messages, len(data))
            self._messages += 1
            self._words[1] = self._messages

    def end(self) -> None:
        """Say that the run is over."""
        self._words[2] = 1

    @property
    def is_read(self) -> bool:
        """Whether a reader has said that it is ready."""
        return bool(self._words[3])


class LiveReader(_Memory):
    """The reading end, in another process."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self._ring = np.frombuffer(self._memory, count=ROWS * len(COLUMNS), offset=_HEAD).reshape(ROWS, -1)
        self.lost = 0  # entries that were overwritten before they were read

    def say_ready(self) -> None:
        """Let the run begin."""
        self._words[3] = 1

    @property
    def is_over(self) -> bool:
        """Whether the run has ended."""
        return bool(self._words[2])

    def read_rows(self) -> NDArray[np.float64]:
        """The rows since the last call, (rows, columns)."""
        count = int(self._words[0])
        wanted = np.arange(max(self._rows, count - ROWS), count)
        rows: NDArray[np.float64] = self._ring[wanted % ROWS]  # a copy
        rows = rows[rows[:, 0] == wanted]
        self.lost += count - self._rows - len(rows)
        self._rows = count
        return rows

    def read_messages(self) -> list[Message]:
        """The messages since the last call."""
        count = int(self._words[1])
        found = []
        for number in range(max(self._messages, count - MESSAGES), count):
            at = self._find_message(number)
            entry = bytes(self._memory[at:at + MESSAGE_BYTES])
            stored, length = _MESSAGE_HEAD.unpack_from(entry)
            try:
                words = json.loads(entry[_MESSAGE_HEAD.size:_MESSAGE_HEAD.size + length])
            except ValueError:
                continue  # overwritten while it was copied
            if stored == number:
                found.append(Message(*words))
        self.lost += count - self._messages - len(found)
        self._messages = count
        return found
