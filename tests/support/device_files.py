"""Data sheets and bench files of devices that do not exist."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

NODE = 5


class Entry(NamedTuple):
    """A variable of a data sheet."""

    type: int  # data type of CiA 301
    access: str = "rww"
    default: str = "0"
    value: str | None = None  # ParameterValue of a DCF
    is_mappable: bool = True


class Mapped(NamedTuple):
    """A PDO of a data sheet: its mapping words, COB-ID and transmission type."""

    words: Sequence[int]
    cob_id: str
    kind: int = 1
    value: str | None = None  # of the COB-ID, in a DCF


def format_variable(section: str, entry: Entry) -> str:
    lines = [f"[{section}]", f"ParameterName=Object {section}", "ObjectType=0x7", f"DataType=0x{entry.type:04X}",
             f"AccessType={entry.access}", f"DefaultValue={entry.default}", f"PDOMapping={int(entry.is_mappable)}"]
    return "\n".join([*lines, *([f"ParameterValue={entry.value}"] if entry.value is not None else []), "", ""])


def format_eds(objects: Mapping[str, Entry], rpdos: Sequence[Mapped] = (), tpdos: Sequence[Mapped] = ()) -> str:
    """A data sheet; the sections of `objects` are "2000" or "2001sub1"."""
    parts = ["[FileInfo]\nFileName=x.eds\n\n[DeviceInfo]\nVendorName=none\n\n"]
    for section in sorted({section[:4] for section in objects if "sub" in section}):
        parts.append(f"[{section}]\nParameterName=Record\nObjectType=0x9\nSubNumber=2\n\n")
    parts += [format_variable(section, entry) for section, entry in objects.items()]
    for base, pdos in ((0x1400, rpdos), (0x1800, tpdos)):
        for index, pdo in enumerate(pdos, base):
            for record, entries in ((index, [Entry(5, default="2"), Entry(7, "rw", pdo.cob_id, pdo.value),
                                             Entry(5, "rw", str(pdo.kind))]),
                                    (index + 0x200, [Entry(5, "rw", str(len(pdo.words))),
                                                     *(Entry(7, "rw", hex(word)) for word in pdo.words)])):
                parts.append(f"[{record:04X}]\nParameterName=PDO\nObjectType=0x9\nSubNumber=0x3\n\n")
                parts += [format_variable(f"{record:04X}sub{sub:X}", entry) for sub, entry in enumerate(entries)]
    return "".join(parts)


OBJECTS = {"1014": Entry(7, "const", "0xBA"), "2000": Entry(4), "2001": Entry(8), "2002": Entry(3, "ro"),
           "2003": Entry(5), "2004sub0": Entry(5, "const"), "2004sub1": Entry(6), "2005": Entry(9, "ro"),
           "2006": Entry(9), "6040": Entry(6), "6041": Entry(6, "ro")}
RPDOS = (Mapped((0x2000_0020, 0x6040_0010), "$NODEID+0x200"), Mapped((0x2001_0020,), "$NODEID+0x300", 255))
TPDOS = (Mapped((0x2002_0010, 0x6041_0010), "$NODEID+0x180"),)
BENCH = """name = "a drive"
[controller]
node = 5
eds = "x.eds"
profile = "cia402"
[controller.inputs]
position_demand = { object = "0x2000", count = "1 um" }
ram_position = { object = "0x2001", count = "1 mm" }
[controller.outputs]
current = { object = "0x2002", count = "20 uA" }
"""


def write_bench(folder: Path, text: str = BENCH, **others: str) -> Path:
    """A bench file beside x.eds, or beside the files given by name without their suffix and text."""
    (folder / "x.eds").write_text(format_eds(OBJECTS, RPDOS, TPDOS))
    for name, content in others.items():
        (folder / name.replace("_", ".")).write_text(content)
    path = folder / "bench.toml"
    path.write_text(text)
    return path
