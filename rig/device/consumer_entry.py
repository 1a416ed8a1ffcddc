"""What an entry of the heartbeat consumer, object 0x1016, may hold."""
from __future__ import annotations

from rig.device.sdo import Abort, SdoAbort


def check_consumer_entry(entry: int, others: list[int]) -> None:
    """Check a new value of an entry of 0x1016 (CiA 301, 7.5.2.19); `others` are the values of the other entries.

    The standard leaves an entry with a node above 127 unused. It is refused here, because nobody would notice that the
    supervision asked for does not happen. Time 0 or node 0 switch an entry off.

    Raises:
        SdoAbort: reserved bits are set, a node above 127, or a node that another entry watches.
    """
    if entry >> 24:
        raise SdoAbort(Abort.VALUE)
    node, time = entry >> 16, entry & 0xFFFF
    if node > 127 and time:
        raise SdoAbort(Abort.VALUE)
    if node and time and any(other >> 16 & 0xFF == node and other & 0xFFFF for other in others):
        raise SdoAbort(Abort.INCOMPATIBLE)
