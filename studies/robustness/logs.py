"""Damaged and invented logs: each is read, reported on, repeated and recovered, or refused in one line."""

import struct
import traceback
from array import array
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi.progress import Progress, ignore_progress
from fdi.report import build_run_report, format_report
from fdi.trace import Trace, open_log
from plant import RigError
from rig.recorder.recover import recover_log
from rig.recorder.writer import McapFile
from rig.run import read_job

_SIZES = (0, 1, 2**31, 2**32 - 1, 2**32, 2**40, 2**63, 2**64 - 1, 6 * 10**9)
_TEXTS = ("", "nan", "zz", "-1", "1e999", "\x1b[2J", "$\\frac$", "9" * 5000, "\0")


class LogCount(NamedTuple):
    """What came of changed logs."""

    logs: int
    accepted: dict[str, int]  # by use: read, report, repeat, recover
    refused: dict[str, int]
    failures: tuple[str, ...]  # exceptions other than RigError, and messages of several lines; at most ten


def fuzz_logs(source: Path, folder: Path, count: int, seed: int, progress: Progress = ignore_progress) -> LogCount:
    """Change a log `count` times, half of the times bytes anywhere, half of the times contents in a sound container.

    Args:
        source: the log of a run.
        folder: where the changed logs go.
        count: how many.
        seed: of the changes.
        progress: called with the share done.
    """
    rng = np.random.default_rng(seed)
    original = source.read_bytes()
    changed_log, recovered_log = folder / "changed.mcap", folder / "recovered.mcap"
    uses: Mapping[str, Callable[[], object]] = {
        "read": lambda: Trace.read(changed_log), "report": lambda: _report(changed_log),
        "repeat": lambda: read_job(changed_log), "recover": lambda: recover_log(changed_log, recovered_log)}
    acceptances, refusals, failures = dict.fromkeys(uses, 0), dict.fromkeys(uses, 0), []
    for number in range(count):
        if number % 2:
            changed_log.write_bytes(_change_bytes(rng, original))
        else:
            _change_contents(rng, source, changed_log)
        for name, use in uses.items():
            try:
                use()
                acceptances[name] += 1
            except RigError as error:
                refusals[name] += 1
                if "\n" in str(error):
                    failures.append(f"{name}, log {number}: a message of several lines")
            except Exception as error:
                where = traceback.extract_tb(error.__traceback__)[-1]
                failures.append(f"{name}, log {number}: {type(error).__name__}: {error} "
                                f"({Path(where.filename).name}:{where.lineno})")
        progress("logs", number / count)
    return LogCount(count, acceptances, refusals, tuple(failures[:10]))


def _report(log: Path) -> None:
    """The page of a log as terminal text. Raises ValueError where a text of the log commands the terminal."""
    text = format_report(build_run_report(Trace.read(log, all=True)))
    if "\x1b" in text:
        raise ValueError("an escape sequence reached the terminal")


def _change_bytes(rng: np.random.Generator, data: bytes) -> bytes:
    """The file with a few bytes changed: anywhere, in its head, or in its summary at the end."""
    mutant = bytearray(data)
    for _ in range(int(rng.choice((1, 1, 2, 5, 20)))):
        low, high = ((0, len(mutant)), (0, 30_000), (len(mutant) - 4_000, len(mutant)))[int(rng.integers(3))]
        at = int(rng.integers(max(0, low), min(high, len(mutant))))
        match int(rng.integers(4)):
            case 0:
                mutant[at] = int(rng.integers(256))
            case 1:
                mutant[at:at + 8] = struct.pack("<Q", _SIZES[int(rng.integers(len(_SIZES)))])
            case 2:
                del mutant[at:at + int(rng.integers(1, 50))]
            case _:
                mutant[at:at] = rng.bytes(int(rng.integers(1, 20)))
    return bytes(mutant)


def _change_contents(rng: np.random.Generator, source: Path, out: Path) -> None:
    """A sound container with changed schemas, attachments, settings and messages."""
    log = open_log(source)
    schemas = list(log.schemas.values())
    for schema in schemas:
        if rng.random() < 0.05:
            schema.data = _change_some(rng, schema.data)
    channels = [channel for channel in log.channels.values() if rng.random() > 0.02]
    file = McapFile(out, "study", [*schemas, *channels])
    is_attachment, is_message = rng.random() < 0.3, rng.random() < 0.5
    for name, data in log.attachments.items():
        spoilt = is_attachment and rng.random() < 0.3
        file.write_attachment(name, "text/plain", _change_some(rng, data) if spoilt else data)
    for name, values in log.metadata.items():
        entries = dict(values)
        if rng.random() < 0.3:
            entries[str(rng.choice(list(entries)))] = _TEXTS[int(rng.integers(len(_TEXTS)))]
        file.write_metadata(name, entries)
    raw = bytearray()
    index: dict[int, array[int]] = {}
    for channel, time_ns, data in log.list_raw_messages():
        if rng.random() < 0.001:
            continue
        number = int(rng.choice((1, 2, 3, 4, 5, 6, 77))) if rng.random() < 0.0005 else channel
        stamp = int(rng.choice((0, 2**62))) if rng.random() < 0.0005 else time_ns
        content = _change_some(rng, data) if is_message and rng.random() < 0.003 else data
        index.setdefault(number, array("Q")).extend((stamp, len(raw)))
        raw += struct.pack("<BQHIQQ", 5, 22 + len(content), number, 0, stamp, stamp) + content
        if len(raw) > 60_000:
            file.write_chunk(bytes(raw), index)
            raw, index = bytearray(), {}
    if raw:
        file.write_chunk(bytes(raw), index)
    file.finish()


def _change_some(rng: np.random.Generator, data: bytes) -> bytes:
    """The bytes with one to three places changed."""
    mutant = bytearray(data)
    for _ in range(int(rng.integers(1, 4)) if mutant else 0):
        at = int(rng.integers(len(mutant) + 1))
        match int(rng.integers(4)):
            case 0:
                mutant[at:at + 1] = rng.bytes(1)
            case 1:
                del mutant[at:at + int(rng.integers(1, 9))]
            case 2:
                mutant[at:at] = rng.bytes(int(rng.integers(1, 12)))
            case _:
                mutant[at:at + 8] = struct.pack("<d", float(rng.choice((np.nan, np.inf, -1e308, 1e300, 0.0))))
    return bytes(mutant)
