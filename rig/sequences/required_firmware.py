"""The firmware that a sequence is meant for: the table [firmware] of a sequence."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from plant.errors import InputError


@dataclass(frozen=True, kw_only=True)
class RequiredFirmware:
    """What the controller must say about itself; a key that is left out is not compared."""

    device_type: int | None = None  # 0x1000
    name: str | None = None  # 0x1008
    hardware: str | None = None  # 0x1009
    software: str | None = None  # 0x100A
    vendor: int | None = None  # 0x1018 sub 1
    product: int | None = None  # 0x1018 sub 2
    revision: int | None = None  # 0x1018 sub 3
    serial: int | None = None  # 0x1018 sub 4

    def __post_init__(self) -> None:
        for key, value in asdict(self).items():
            if isinstance(value, int) and not 0 <= value <= 0xFFFFFFFF:
                raise InputError("firmware", key, f"a number from 0 to 0xFFFFFFFF, not {value}")

    def find_difference(self, identity: Mapping[str, object]) -> tuple[str, str]:
        """The first key in which a controller's identity differs and how, in words; two empty texts if none does."""
        for key, required in asdict(self).items():
            found = identity.get(key)
            if required is not None and found != required:
                return key, f"{_format(required)}, but the controller has {_format(found)}"
        return "", ""


def _format(value: object) -> str:
    if value is None:
        return "no such object"
    return f"0x{value:08X}" if isinstance(value, int) else repr(value)
