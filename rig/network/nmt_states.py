"""NMT states and commands (CiA 301, 7.3.2), for the rig and the nodes."""
from __future__ import annotations

from enum import IntEnum


class NmtState(IntEnum):
    """States as the heartbeat carries them."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(IntEnum):
    """Command specifiers of the frame 0x000."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130
