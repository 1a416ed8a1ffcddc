"""Faults of frames as compiled loops know them: a code and an argument, 64-bit integers (`Schedule.frame_actions`)."""
from __future__ import annotations

from rig.sequences.faults import ACTION_CODES, Corrupt, Cut, Delay, Double, Drop

SENT_NORMALLY = 0
DROP, DELAY, DOUBLE, CORRUPT, CUT = (ACTION_CODES[kind] for kind in (Drop, Delay, Double, Corrupt, Cut))


def change_frame(code: int, argument: int, length: int, data: int) -> tuple[int, int]:
    """Length and payload of a frame after a fault that corrupts or cuts it; after any other code they are unchanged.

    `data`: first byte lowest, bytes beyond `length` zero, as in raw_bus.py.
    """
    if code == CORRUPT:
        data ^= argument
    elif code == CUT:
        length = min(length, argument)
    if length < 8:
        data &= (1 << 8 * length) - 1
    return length, data
