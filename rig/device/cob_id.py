"""COB-ID entries of the object dictionary: which identifiers may be used, and when an entry may be changed."""
from __future__ import annotations

from rig.device.sdo import Abort, SdoAbort

INVALID = 1 << 31  # PDO and EMCY: switched off
PRODUCER = 1 << 30  # 0x1005: the node sends SYNC
_CAN_ID = 0x7FF
_UNUSED = 0x3FFFF800  # bit 29 asks for a 29-bit identifier, whose bits follow
_RESTRICTED = (  # CiA 301, 7.3.5, table 40
    range(0x080), range(0x101, 0x181), range(0x581, 0x600), range(0x601, 0x680),
    range(0x6E0, 0x700), range(0x701, 0x780), range(0x780, 0x800),
)  # fmt: skip


def is_restricted(can_id: int) -> bool:
    """Whether no configurable object may use this identifier (CiA 301, 7.3.5, table 40).

    >>> is_restricted(0x5FF), is_restricted(0x580), is_restricted(0x182)
    (True, False, False)
    """
    return any(can_id in each for each in _RESTRICTED)


def check_switchable(old: int, new: int) -> None:
    """Check a new value of an entry with a valid bit: PDO (CiA 301, 7.5.2.35 and 7.5.2.37) or EMCY (7.5.2.17).

    The identifier of a valid entry is fixed: it is first made invalid (bit 31), with whatever identifier, then changed.

    Raises:
        SdoAbort: a 29-bit or restricted identifier, or a change of a valid one.
    """
    if new & _UNUSED:
        raise SdoAbort(Abort.VALUE)
    if new & INVALID:
        return
    if is_restricted(new & _CAN_ID):
        raise SdoAbort(Abort.VALUE)
    if not old & INVALID and (old ^ new) & _CAN_ID:
        raise SdoAbort(Abort.STATE)


def check_sync(new: int) -> None:
    """Check a new value of 0x1005 (CiA 301, 7.5.2.5) for a device that consumes SYNC and cannot produce it.

    Raises:
        SdoAbort: a 29-bit or restricted identifier, or the order to produce SYNC.
    """
    if new & (_UNUSED | PRODUCER) or is_restricted(new & _CAN_ID):
        raise SdoAbort(Abort.VALUE)
