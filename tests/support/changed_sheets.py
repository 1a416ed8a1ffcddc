"""Electronic data sheets that differ a little from that of node 3."""

from pathlib import Path

from dbc import EDS


def change_sheet(folder: Path, *changes: tuple[str, str, str], more: str = "") -> Path:
    """The EDS of node 3 with words of some sections replaced, (section, old, new) each, and more sections."""
    text = EDS[3].read_text()
    for section, old, new in changes:
        head, found, tail = text.partition(f"[{section}]\n")
        body, gap, rest = tail.partition("\n[")
        assert found and old in body, (section, old)
        text = head + found + body.replace(old, new, 1) + gap + rest
    path = folder / "changed.eds"
    path.write_text(text + more)
    return path


def describe_variable(section: str, data_type: str) -> str:
    """The section of an EDS for a number that can be written."""
    return (f"\n[{section}]\nParameterName=number\nObjectType=0x7\nDataType={data_type}\nAccessType=rw\n"
            "DefaultValue=0\nPDOMapping=0\n")
