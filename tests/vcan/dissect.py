"""An independent reading of what was on the bus: candump's log through Wireshark's CANopen dissector."""

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

COLUMNS = ("canopen.cob_id", "canopen.function_code", "_ws.col.Protocol", "_ws.malformed", "_ws.col.Info")


class Row(NamedTuple):
    """One frame as tshark tells it."""

    cob_id: int
    function: int  # the COB-ID's upper four bits, as the dissector took them
    canopen: bool  # the CANopen dissector was the one that took it
    malformed: bool
    info: str


def candump_frames(log: Path) -> list[tuple[int, bytes]]:
    """(COB-ID, data) of each line '(time) vcan0 183#0011..' of `candump -L`; ValueError on any other line."""
    frames = []
    for number, line in enumerate(log.read_text().splitlines(), 1):
        match = re.fullmatch(r"\(\d+\.\d+\) \w+ ([0-9A-F]{3})#((?:[0-9A-F]{2}){0,8})(?: [RT])?", line)
        if match is None:
            raise ValueError(f"{log}, line {number}: not a classical data frame with an 11-bit identifier: {line}")
        frames.append((int(match[1], 16), bytes.fromhex(match[2])))
    return frames


def tshark(log: Path) -> list[Row]:
    """What tshark's CANopen dissector says of each frame of a candump log."""
    blf = log.with_suffix(".blf")
    subprocess.run([sys.executable, "-m", "can.logconvert", log, blf], check=True)
    words = ["tshark", "-r", str(blf), "-d", "can.subdissector,canopen", "-T", "fields", "-E", "separator=/t"]
    for column in COLUMNS:
        words += ["-e", column]
    out = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    return [_row(line) for line in out.splitlines()]


def _row(line: str) -> Row:
    cob_id, function, protocol, malformed, info = (line.split("\t") + [""] * len(COLUMNS))[: len(COLUMNS)]
    bad = bool(malformed) or "malformed" in info.lower()
    return Row(int(cob_id or "-1", 0), int(function or "-1", 0), protocol == "CANopen", bad, info)


def mcap_counts(trace: Path) -> Counter[int]:
    """Frames per COB-ID in the /can channel of a run's own log."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    counts: Counter[int] = Counter()
    with trace.open("rb") as file:
        for decoded in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(topics=["/can"]):
            counts[decoded.decoded_message.cob_id] += 1
    return counts
