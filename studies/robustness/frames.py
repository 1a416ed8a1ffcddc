"""Fuzz frames: valid ones of the bench, mutations of them, and random ones. A seed gives the same frames again."""

from collections.abc import Iterator

import numpy as np

from rig.network.frame import Frame
from studies.shipped_frames import COMMAND, DRIVE, FEEDBACK, SYNC, VALVE_STATE, pack_frame

NODES = (1, 2, 3)
_OBJECTS = (0x1000, 0x1001, 0x1003, 0x1005, 0x1006, 0x1008, 0x1014, 0x1016, 0x1017, 0x1018, 0x1029, 0x1200, 0x1400,
            0x1600, 0x1800, 0x1A00, 0x2100, 0x2110, 0x2200, 0x2210, 0x2211, 0x2212, 0x6040, 0x6041)
_COMMANDS = (0x40, 0x21, 0x22, 0x23, 0x2B, 0x2F, 0x00, 0x10, 0x01, 0x60, 0x70, 0x80, 0xA0, 0xC2, 0xFF)  # of SDO
_NMT = (1, 1, 1, 1, 2, 128, 129, 130)  # start four times as often: a node that is started has more to do wrong


def invent_frames(count: int, seed: int) -> Iterator[Frame]:
    """`count` frames; time advances by 1 ms at each SYNC.

    One in eight is a SYNC; of the others half are as a node would send them, a third are mutated (identifier, length,
    bits), the rest are random bytes under a random identifier.
    """
    rng = np.random.default_rng(seed)
    t_ns, cycle = 0, 0
    for _ in range(count):
        kind = rng.random()
        if kind < 1.0 / 8.0:
            t_ns, cycle = t_ns + 1_000_000, cycle + 1
            yield Frame(t_ns, SYNC, b"")
            continue
        cob_id, data = _make_valid_frame(rng, cycle)
        if kind > 0.55:
            cob_id, data = _mutate(rng, cob_id, data)
        if kind > 0.85:
            cob_id, data = int(rng.integers(0x800)), rng.bytes(int(rng.integers(9)))
        yield Frame(t_ns, cob_id, data)


def _pack(cob_id: int, cycle: int, **values: float) -> tuple[int, bytes]:
    return cob_id, pack_frame(cob_id, {**values, "cycle": cycle})


def _make_valid_frame(rng: np.random.Generator, cycle: int) -> tuple[int, bytes]:
    """A frame that a node of the bench may send in this cycle."""
    node = int(rng.choice(NODES))
    match int(rng.integers(10)):
        case 0:
            return 0x000, bytes((int(rng.choice(_NMT)), int(rng.integers(4))))
        case 1 | 2:
            return _pack(COMMAND, cycle, position_demand=rng.normal(0.0, 5e-3),
                         control_word=int(rng.choice((0, 1, 3, 7, 15))))
        case 3:
            return _pack(FEEDBACK, cycle, ram_position=rng.normal(0.0, 5e-3), load_pressure=rng.normal(0.0, 1e6))
        case 4:
            return _pack(VALVE_STATE, cycle, spool_position=rng.normal(0.0, 1e-4), flags=int(rng.integers(8)))
        case 5 | 6:
            return _pack(DRIVE, cycle, current=rng.normal(0.0, 5e-3), status_word=int(rng.integers(16)))
        case 7:
            return 0x700 + node, bytes((int(rng.choice((0, 4, 5, 127))),))
        case 8:
            return 0x080 + node, rng.bytes(8)
    return int(rng.choice((0x600, 0x580))) + node, _make_sdo(rng)


def _make_sdo(rng: np.random.Generator) -> bytes:
    """An SDO request or answer: any command specifier, an object of the bench, any content."""
    command = int(rng.choice(_COMMANDS))
    index = int(rng.choice(_OBJECTS))
    return bytes((command, index & 0xFF, index >> 8, int(rng.integers(6)))) + rng.bytes(4)


def _mutate(rng: np.random.Generator, cob_id: int, data: bytes) -> tuple[int, bytes]:
    """The frame with another identifier, another length or other bits."""
    changed = bytearray(data)
    match int(rng.integers(4)):
        case 0:
            cob_id ^= 1 << int(rng.integers(11))
        case 1:
            changed = changed[:int(rng.integers(9))]
        case 2:
            changed = (changed + rng.bytes(8))[:int(rng.integers(9))]
        case _:
            for _ in range(int(rng.integers(1, 5)) if changed else 0):
                changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return cob_id, bytes(changed)
