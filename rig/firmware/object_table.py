"""Writes the object table of a device in C (object_table.h, object_table.c) from its EDS.

    python -m rig.firmware.object_table

does so for the reference firmware. A test compares its two files with the EDS, so they cannot differ from it unnoticed.
"""

import struct
from pathlib import Path

from dbc import EDS
from rig.device.dictionary import Dictionary, Entry, Value

FOLDER = Path(__file__).parent
_KINDS = {"f": "KIND_REAL", "d": "KIND_REAL", **dict.fromkeys("bhiq", "KIND_SIGNED")}


def write_object_table(eds: Path = EDS[2]) -> dict[str, str]:
    """The two C files, name to text, for a device of any node-ID. Raises InputError for an EDS that cannot be read."""
    entries, others = sorted(Dictionary(eds, 1).entries.items()), Dictionary(eds, 2).entries
    header = [
        f"/* Objects of a node, generated from {eds.name} by object_table.py: do not edit. */",
        "#ifndef OBJECT_TABLE_H", "#define OBJECT_TABLE_H", "", '#include "dictionary.h"', "",
        "/* positions in the table and in the values, OBJECT_(index)_(sub-index) */", "enum {",
        *(f"    OBJECT_{index:04X}_{sub:02X}," for (index, sub), _ in entries), "    OBJECT_COUNT", "};", "",
        "extern const struct object OBJECT_TABLE[OBJECT_COUNT];", "", "#endif", "",
    ]  # fmt: skip
    source = ["/* Generated, see object_table.h. */", '#include "object_table.h"', "",
              "const struct object OBJECT_TABLE[OBJECT_COUNT] = {"]  # fmt: skip
    for key, entry in entries:
        source += [f"    /* {entry.name} */", f"    {_write_entry(*key, entry, others[key].default)},"]
    return {"object_table.h": "\n".join(header), "object_table.c": "\n".join([*source, "};", ""])}


def _write_entry(index: int, sub: int, entry: Entry, default_of_node_2: Value) -> str:
    kind = "KIND_TEXT" if isinstance(entry.default, bytes) else _KINDS.get(entry.code, "KIND_UNSIGNED")
    flags = {"READABLE": entry.readable, "WRITABLE": entry.writable, "MAPPABLE": entry.mappable,
             "HAS_LOW_LIMIT": entry.low is not None, "HAS_HIGH_LIMIT": entry.high is not None,
             "NODE_RELATIVE": default_of_node_2 != entry.default}
    words = " | ".join(name for name, is_set in flags.items() if is_set) or "0"
    initial = entry.default if isinstance(entry.default, bytes) else entry.default - flags["NODE_RELATIVE"]
    text = f'"{entry.default.decode("ascii")}"' if isinstance(entry.default, bytes) else "NULL"
    length = len(entry.default) if isinstance(entry.default, bytes) else 0
    return (f"{{0x{index:04X}, 0x{sub:02X}, {kind}, {struct.calcsize('<' + entry.code)}, {words}, "
            f"{_write_bits(entry.code, initial)}, {entry.low or 0}, {entry.high or 0}, {text}, {length}}}")


def _write_bits(code: str, value: Value) -> str:
    """The bits of a number as an unsigned integer constant."""
    if isinstance(value, bytes):
        return "0"
    return f"0x{int.from_bytes(struct.pack('<' + code, value), 'little'):X}u" + ("ll" if code in "dqQ" else "")


if __name__ == "__main__":
    for name, text in write_object_table().items():
        (FOLDER / name).write_text(text)
