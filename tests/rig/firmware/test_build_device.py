"""Devices of a user's own on the stack in C: compiled with the object table of their EDS, for any node number."""

import shutil
from pathlib import Path

import pytest
from c_device import skip_without_compiler
from places import ROOT

from plant.errors import InputError
from rig.firmware.build import build_device
from rig.firmware.object_table import write_object_table

DRIVE = ROOT / "examples" / "cia402_drive"


def test_a_device_is_built_once_and_again_when_its_data_sheet_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skip_without_compiler()
    monkeypatch.setenv("EHA_RIG_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "drive"
    shutil.copytree(DRIVE, folder)
    first = build_device(folder)
    assert build_device(folder) == first and first.name.startswith("drive-")
    eds = folder / "drive.eds"
    eds.write_text(eds.read_text().replace("DefaultValue=3.8", "DefaultValue=3.9"))
    assert build_device(folder) != first


def test_a_folder_without_sources_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a folder with the C files of a device"):
        build_device(tmp_path)


def test_values_that_depend_on_the_node_number_are_marked() -> None:
    source = write_object_table(DRIVE / "drive.eds")["object_table.c"]
    assert "{0x1801, 0x01, KIND_UNSIGNED, 4, READABLE | WRITABLE | NODE_RELATIVE, 0x280u, 0, 0, NULL, 0}" in source
    assert "{0x6078, 0x00, KIND_SIGNED, 2, READABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0}" in source
    assert "{0x2002, 0x01, KIND_REAL, 4, READABLE | WRITABLE, 0x40733333u, 0, 0, NULL, 0}" in source
