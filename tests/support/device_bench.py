"""A device on an embedded bus, opposite a hand-made master: a test is a script of frames. Its EDS may be changed."""

from fnmatch import fnmatchcase
from pathlib import Path

from node_bench import MS, NodeHarness

from dbc import EDS
from rig.device import Device


class DeviceHarness(NodeHarness):
    """Node 2 or 3, which does nothing of its own."""

    node: Device

    def __init__(self, node: int = 3, eds: Path | None = None) -> None:
        super().__init__(lambda send: Device(node, eds or EDS[node], send))

    def download(self, index: int, sub: int, data: bytes) -> str:
        """Expedited SDO download; "ok", or the abort code in hexadecimal."""
        head = bytes((0x23 | (4 - len(data)) << 2,)) + index.to_bytes(2, "little") + bytes((sub,))
        answer = self.send(0x600 + self.node.node_id, head + data.ljust(4, b"\0"))[0]
        return "ok" if answer[0] == 0x60 else f"{int.from_bytes(answer[4:], 'little'):08X}"

    def play(self, script: str) -> None:
        """Do what each line says, and compare with what it expects:

            182 01000000 -> 083 *       a frame, and the frames that answer it: COB-ID and data, with wildcards
            wait 12 -> 703 05           so many ms, and what is sent meanwhile
            write 1800:2 01 -> ok       an expedited download, little-endian, and "ok" or the abort code
            2205:0 = 1                  the value of an object
        """
        for line in script.strip().splitlines():
            action, _, pattern = (part.strip() for part in line.partition("->" if "->" in line else "="))
            first, *rest = action.split()
            index, _, sub = (rest if first == "write" else [first])[0].partition(":")
            before = len(self.heard)
            if first == "write":
                answer = self.download(int(index, 16), int(sub, 16), bytes.fromhex(rest[1]))
            elif sub:
                answer = str(self.node.od.values[int(index, 16), int(sub, 16)])
            else:
                if first == "wait":
                    for _ in range(int(rest[0])):
                        self.wait(MS)
                else:
                    self.send(int(first, 16), bytes.fromhex("".join(rest)))
                answer = ", ".join(f"{cob_id:03X} {data.hex()}" for _, cob_id, data in self.heard[before:])
            assert fnmatchcase(answer, pattern), (line, answer)


def change_sheet(folder: Path, *changes: tuple[str, str, str], more: str = "") -> Path:
    """The EDS of node 3 with words of some sections replaced, (section, old, new) each, and more sections."""
    text = EDS[3].read_text()
    for section, old, new in changes:
        head, title, tail = text.partition(f"[{section}]\n")
        body, gap, rest = tail.partition("\n[")
        assert title and old in body, (section, old)
        text = head + title + body.replace(old, new, 1) + gap + rest
    path = folder / "changed.eds"
    path.write_text(text + more)
    return path


def describe_variable(section: str, data_type: str) -> str:
    """The section of an EDS for a number that can be written."""
    return (f"\n[{section}]\nParameterName=number\nObjectType=0x7\nDataType={data_type}\nAccessType=rw\n"
            "DefaultValue=0\nPDOMapping=0\n")
