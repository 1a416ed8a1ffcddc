"""Defects of an EDS are found by chapter 1."""
from __future__ import annotations

from pathlib import Path

import pytest
from broken_devices import examine, list_cases, nothing
from changed_sheets import change_sheet

from dbc import EDS
from plant.errors import InputError
from rig.conformance.data_sheet import DataSheet


@pytest.mark.parametrize(("section", "old", "new", "found_by", "said"), [
    ("DeviceInfo", "VendorName=eha-rig\n", "", "1.1", "DeviceInfo has no VendorName"),
    ("DeviceInfo", "BaudRate_1000=1", "BaudRate_1000=0", "1.1", "no bit rate"),
    ("DeviceInfo", "NrOfRXPDO=1", "NrOfRXPDO=2", "1.7", "NrOfRXPDO is 2, 1 are described"),
    ("DeviceInfo", "ProductNumber=0x3", "ProductNumber=0x4", "1.9", "0x1018:2 is 0x3, ProductNumber is 0x4"),
    ("1018sub1", "0xFFFFFFFF", "0x0", "1.9", "the vendor-ID is 0, which is invalid"),
    ("MandatoryObjects", "SupportedObjects=3", "SupportedObjects=4", "1.3", "says 4 and lists 3"),
    ("OptionalObjects", "1=0x1003", "1=0x1004", "1.3", "0x1004 is listed and not described"),
    ("1029", "SubNumber=0x2", "SubNumber=0x3", "1.4", "0x1029 says SubNumber 3 and has 2"),
    ("1400sub0", "DefaultValue=0x2", "DefaultValue=0x5", "1.4", "0x1400:0 is 5, the highest sub-index is 2"),
    ("1029sub1", "DefaultValue=0x0", "DefaultValue=0x3", "1.5", "0x1029:1: 3 is outside its limits"),
    ("1017", "AccessType=rw", "AccessType=rx", "1.5 1.6", "0x1017:0 has AccessType 'rx'"),
    ("1017", "DataType=0x0006", "DataType=0x0007", "1.6", "0x1017:0 has DataType 0x0007, expected 0x0006"),
    ("1001", "AccessType=ro", "AccessType=rw", "1.6", "0x1001:0 is rw, expected ro"),
    ("1A01sub2", "0x22030010", "0x22030020", "1.8", "TPDO2 maps 0x2203:0 with 32 bits, it has 16"),
    ("1A01sub2", "0x22030010", "0x22110110", "1.8", "TPDO2 maps 0x2211:1, which is ro with PDOMapping=0"),
    ("1A01sub2", "0x22030010", "0x29990010", "1.8", "which is not there"),
    ("1A01sub2", "0x22030010", "0x22060010", "1.8", "TPDO2 maps 0x2206:0, which is rww with PDOMapping=1"),
    ("1801sub1", "$NODEID+0x280", "0x5FF", "1.10", "TPDO2 uses 0x5FF, which is restricted"),
    ("1801sub1", "$NODEID+0x280", "$NODEID+0x180", "1.10", "TPDO2 and TPDO1 send 0x183"),
])  # fmt: skip
def test_defect_of_the_data_sheet_is_found(
    tmp_path: Path, section: str, old: str, new: str, found_by: str, said: str
) -> None:
    outcome = examine(nothing, chapters=("1",), sheet=change_sheet(tmp_path, (section, old, new)))
    assert list_cases(outcome) == found_by.split()
    assert any(said in result.measured for result in outcome.results)


def test_missing_mandatory_object(tmp_path: Path) -> None:
    text = EDS[3].read_text()
    begin = text.index("[1001]\n")
    path = tmp_path / "without.eds"
    path.write_text(text[:begin] + text[text.index("[1018]\n"):])
    assert list_cases(examine(nothing, chapters=("1",), sheet=path)) == ["1.2", "1.3"]


def test_data_sheet_that_promises_more_than_the_node_has(tmp_path: Path) -> None:
    """The tester reads another type, another default and another object than the node has."""
    path = change_sheet(tmp_path, ("2200", "DataType=0x0004", "DataType=0x0003"), ("1017", "DefaultValue=100",
                                                                               "DefaultValue=200"))
    assert {"2.2", "2.4"} <= set(list_cases(examine(nothing, chapters=("2",), sheet=path)))


@pytest.mark.parametrize("text", ["", "not an EDS", "[1000]\n", "[DeviceInfo]\n[1000]\nParameterName=x\nDataType=zz\n"])
def test_no_data_sheet(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.eds"
    path.write_text(text)
    with pytest.raises(InputError, match="electronic data sheet") as caught:
        DataSheet(path, 3)
    assert "\n" not in str(caught.value)
