"""Frames as python-can's messages and back, but for the error state indicator of CAN FD."""
from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rig.network.frame import BIT_RATE_SWITCH, EXTENDED, FD_FRAME, IDENTIFIER

if TYPE_CHECKING:
    import can


def make_message(cob_id: int, data: bytes, **options: Any) -> can.Message:
    """The message of a frame; `options` are those of can.Message, such as its time."""
    import can  # here: who only reads logs need not load it

    return can.Message(arbitration_id=cob_id & IDENTIFIER, is_extended_id=bool(cob_id & EXTENDED),
                       is_fd=bool(cob_id & FD_FRAME), bitrate_switch=bool(cob_id & BIT_RATE_SWITCH), data=data,
                       **options)


def find_cob_id(message: can.Message) -> int:
    """The COB-ID of a data frame, with its flags (frame.py)."""
    cob_id = message.arbitration_id
    for flag, is_set in ((EXTENDED, message.is_extended_id), (FD_FRAME, message.is_fd),
                         (BIT_RATE_SWITCH, message.bitrate_switch)):
        if is_set:
            cob_id |= flag
    return cob_id
