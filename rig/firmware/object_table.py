"""Writes the object table of a device in C (object_table.h, object_table.c) from its EDS.

    python -m rig.firmware.object_table

does so for the reference firmware. A test compares its two files with the EDS, so they cannot differ from it unnoticed.
"""

import json
from pathlib import Path

from canopen.objectdictionary import ODVariable

from dbc import EDS
from rig.device.dictionary import Dictionary, Value, find_struct, read_default

FOLDER = Path(__file__).parent
_KINDS = {"f": "KIND_REAL", "d": "KIND_REAL", **dict.fromkeys("bhlq", "KIND_SIGNED")}  # by struct format


def write_object_table(eds: Path = EDS[2]) -> dict[str, str]:
    """The two C files, name to text, for a device of any node-ID. Raises InputError for an EDS that cannot be read."""
    entries, node_2_entries = sorted(Dictionary(eds, 1).entries.items()), Dictionary(eds, 2).entries
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
        source += [f"    /* {entry.name} */", f"    {_write_entry(*key, entry, read_default(node_2_entries[key]))},"]
    return {"object_table.h": "\n".join(header), "object_table.c": "\n".join([*source, "};", ""])}


def _write_entry(index: int, sub: int, entry: ODVariable, default_of_node_2: Value) -> str:
    default, number = read_default(entry), find_struct(entry)
    flags = {"READABLE": entry.readable, "WRITABLE": entry.writable, "MAPPABLE": entry.pdo_mappable,
             "HAS_LOW_LIMIT": entry.min is not None, "HAS_HIGH_LIMIT": entry.max is not None,
             "NODE_RELATIVE": default_of_node_2 != default}
    words = " | ".join(name for name, is_set in flags.items() if is_set) or "0"
    kind, size, bits, text, length = "KIND_TEXT", 0, "0", "NULL", 0
    if isinstance(default, bytes):
        text = json.dumps(default.decode("ascii"))  # a literal of C as well
        length = len(default)
    elif number is not None:
        kind, size = _KINDS.get(number.format.lstrip("<"), "KIND_UNSIGNED"), number.size
        data = number.pack(default - flags["NODE_RELATIVE"])
        bits = f"0x{int.from_bytes(data, 'little'):X}u" + "ll" * (size == 8)  # as an unsigned integer constant
    return (f"{{0x{index:04X}, 0x{sub:02X}, {kind}, {size}, {words}, {bits}, {entry.min or 0}, {entry.max or 0}, "
            f"{text}, {length}}}")


if __name__ == "__main__":
    for name, text in write_object_table().items():
        (FOLDER / name).write_text(text)
