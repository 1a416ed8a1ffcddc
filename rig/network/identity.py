"""What a node says about itself: device type, names and identity object (CiA 301, 7.5.2.1 and 7.5.2.9 to 7.5.2.19)."""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Identity(NamedTuple):
    """The identity of a node; None for an object that it does not have."""

    device_type: int | None = None  # 0x1000
    name: str | None = None  # 0x1008, manufacturer device name
    hardware: str | None = None  # 0x1009, manufacturer hardware version
    software: str | None = None  # 0x100A, manufacturer software version
    vendor: int | None = None  # 0x1018 sub 1, vendor-ID
    product: int | None = None  # 0x1018 sub 2, product code
    revision: int | None = None  # 0x1018 sub 3, revision number
    serial: int | None = None  # 0x1018 sub 4, serial number

    def __str__(self) -> str:
        """The objects that the node has, in one line."""
        words = []
        for key, value in self._asdict().items():
            if value is not None:
                label = key.replace("_", " ")
                words.append(f"{label} 0x{value:08X}" if isinstance(value, int) else f"{label} {value!r}")
        return ", ".join(words) or "no identity objects"


_OBJECTS = {"device_type": (0x1000, 0), "name": (0x1008, 0), "hardware": (0x1009, 0), "software": (0x100A, 0),
            "vendor": (0x1018, 1), "product": (0x1018, 2), "revision": (0x1018, 3), "serial": (0x1018, 4)}
_TEXTS = ("name", "hardware", "software")


def read_identity(upload: Callable[[int, int], bytes | None]) -> Identity:
    """The identity of a node; `upload(index, sub)` gives an object's bytes, None where the node has no such object."""
    found = {key: upload(*place) for key, place in _OBJECTS.items()}
    texts = {key: _decode_text(data) for key, data in found.items() if data is not None and key in _TEXTS}
    numbers = {key: int.from_bytes(data[:4], "little") for key, data in found.items()
               if data is not None and key not in _TEXTS}
    return Identity(**texts, **numbers)  # type: ignore[arg-type]  # the keys are the fields, with their types


def _decode_text(data: bytes, longest: int = 64) -> str:
    """A VISIBLE_STRING, at most `longest` characters; one that is no printable ASCII becomes a question mark."""
    text = data.rstrip(b"\0 ")[:longest].decode("ascii", "replace")
    return "".join(letter if letter.isascii() and letter.isprintable() else "?" for letter in text)
