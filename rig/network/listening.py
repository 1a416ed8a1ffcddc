"""What is heard on a bus, by the frames of a bench: nothing is sent."""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from rig.benches.bench import Bench
from rig.benches.bus_load import FrameLoad, list_loads
from rig.benches.frame_map import describe_identifier
from rig.network.bus import open_can
from rig.network.clock import WallClock
from rig.network.frame import Frame
from rig.network.link import Link


class Heard(NamedTuple):
    """A frame of the bench, and how many were heard."""

    frame: FrameLoad
    received: int
    wrong_lengths: tuple[int, ...]  # bytes of frames with its identifier that have another length


def listen(bench: Bench, spec: str, seconds: float) -> list[Frame]:
    """All frames on the bus `spec` for so long.

    Raises:
        RigError: the bus cannot be opened.
    """
    clock = WallClock()
    link = Link(open_can(spec, bench.bitrate, bench.frames.is_fd), clock.now)
    try:
        frames, end = [], clock.now() + round(seconds * 1e9)
        while (left := end - clock.now()) > 0:
            frames += link.poll(min(left / 1e9, 0.05))
        return frames
    finally:
        link.close()


def count_frames(bench: Bench, frames: Iterable[Frame]) -> tuple[list[Heard], dict[str, int]]:
    """How often each frame of the bench is among `frames`, and the identifiers of the others."""
    counts: Counter[str] = Counter()
    others: Counter[str] = Counter()
    lengths: dict[str, set[int]] = {}
    loads = list_loads(bench)
    services = {each.identifier: each.name for each in loads[len(bench.frames.frames):]}  # SYNC, heartbeats
    for frame in frames:
        spec = bench.frames.find(frame.cob_id, frame.data)
        name = services.get(frame.cob_id) if spec is None else spec.name
        if name is None:
            others[describe_identifier(frame.cob_id)] += 1
        elif spec is not None and len(frame.data) != spec.length:
            lengths.setdefault(name, set()).add(len(frame.data))
        else:
            counts[name] += 1
    heard = [Heard(each, counts[each.name], tuple(sorted(lengths.get(each.name, ())))) for each in loads]
    return heard, dict(others)
