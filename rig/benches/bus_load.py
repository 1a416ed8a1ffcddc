"""How much of the bus the frames of a bench take, each at its longest."""
from __future__ import annotations

from typing import NamedTuple

from rig.benches.bench import Bench
from rig.benches.frame_map import EXTENDED, FD, SWITCHED, FrameSpec, Guard, Role

HEARTBEAT = 0.1  # s, of each node of the rig


class FrameLoad(NamedTuple):
    """A frame of a bench, and its share of the bus."""

    name: str
    identifier: int  # with EXTENDED, FD and SWITCHED
    direction: str  # "rig > controller"
    length: int  # bytes
    content: tuple[str, ...]  # signals, and what protects them
    period: float  # s
    share: float  # of the time


def count_bits(identifier: int, length: int) -> int:
    """The bit times that a frame of `length` bytes takes at most, with all stuff bits and the space behind it.

    Of classical frames as in Davis, Burns, Bril, Lukkien, Controller Area Network (CAN) schedulability analysis, 2007;
    of CAN FD frames by the fields of ISO 11898-1, all at the nominal bit rate.

    >>> count_bits(0x182, 8), count_bits(0x80, 0)
    (135, 55)
    """
    stuffed = 54 if identifier & EXTENDED else 34  # bits of a classical frame beside the data that stuffing may extend
    if not identifier & FD:
        return stuffed + 8 * length + 13 + (stuffed + 8 * length - 1) // 4
    head = (41 if identifier & EXTENDED else 22) + 8 * length
    checksum = 4 + (17 if length <= 16 else 21)  # stuff count and CRC, with a stuff bit before each four bits
    return head + (head - 1) // 4 + checksum + -(-checksum // 4) + 13


def compute_time(identifier: int, length: int, bitrate: float, data_bitrate: float | None = None) -> float:
    """The time that a frame takes on the bus at most, s; of CAN FD with BRS all from ESI to the CRC at `data_bitrate`.

    >>> compute_time(0x123 | FD | SWITCHED, 64, 1e6), compute_time(0x123 | FD | SWITCHED, 64, 1e6, 5e6)
    (0.000712, 0.0001696)
    """
    bits = count_bits(identifier, length)
    if not identifier & SWITCHED or data_bitrate is None:
        return bits / bitrate
    head = 36 if identifier & EXTENDED else 17  # up to BRS
    slow = head + (head - 1) // 4 + 13
    return slow / bitrate + (bits - slow) / data_bitrate


def list_loads(bench: Bench) -> list[FrameLoad]:
    """The cyclic frames of a bench, then SYNC and the heartbeats."""
    cycle = bench.cycle_ns / 1e9
    found = [(spec.name, spec.sent_as, _describe_direction(bench, spec), spec.length, list_content(spec),
              cycle * spec.every) for spec in bench.frames.frames]
    if bench.frames.sync is not None:
        found.append(("SYNC", bench.frames.sync, "rig > all", 0, (), cycle))
    nodes = {Role.RIG: bench.rig_node, **{role: each.node for role, each in bench.nodes.items()}} if bench.nodes else {}
    for role, node in sorted(nodes.items()):
        found.append((f"heartbeat {node}", 0x700 + node, f"{role.name.lower()} > all", 1, (), HEARTBEAT))
    return [FrameLoad(*each, share=compute_time(each[1], each[3], bench.bitrate, bench.data_bitrate) / each[5])
            for each in found]


def _describe_direction(bench: Bench, spec: FrameSpec) -> str:
    if spec.sender is Role.RIG:
        return "rig > controller"
    to_plant = ", plant" if bench.has_plant_node else ""
    if spec.sender is Role.CONTROLLER:
        return f"controller > rig{to_plant}"
    return "plant > rig" if spec.roles == ("valve_state",) else "plant > rig, controller"


def list_content(spec: FrameSpec) -> tuple[str, ...]:
    """The named fields of a frame in words.

    A selector has its value, a protected field what it is.
    """
    words = {Guard.NONE: "", Guard.COUNTER: " (counter)"}
    return tuple(f"{each.name} = {each.fixed}" if each.fixed is not None else
                 each.name + words.get(each.guard, f" ({each.checksum.partition('#')[0]})")
                 for each in spec.fields if each.name)
