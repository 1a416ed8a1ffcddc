"""Identifiers that CiA 301 keeps from every configurable object (7.3.5, table 40)."""
from __future__ import annotations

RESTRICTED_RANGES = (
    (0x000, 0x000), (0x001, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x77F),
    (0x780, 0x7FF),
)  # fmt: skip


def is_restricted(can_id: int) -> bool:
    """Whether no PDO, SYNC, EMCY or TIME may use this identifier.

    >>> is_restricted(0x5FF), is_restricted(0x182)
    (True, False)
    """
    return any(low <= can_id <= high for low, high in RESTRICTED_RANGES)


def list_restricted_ends() -> list[int]:
    """First and last identifier of each restricted range: those that a test tries.

    >>> len(list_restricted_ends())
    15
    """
    return sorted({end for each in RESTRICTED_RANGES for end in each})
