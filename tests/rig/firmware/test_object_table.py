"""The firmware's object table is what the EDS of node 2 says."""

from rig.firmware.object_table import FOLDER, write_object_table


def test_object_table_is_that_of_the_eds() -> None:
    """After a change of dbc/node2.eds: python -m rig.firmware.object_table."""
    table = write_object_table()
    assert {name: (FOLDER / name).read_text() for name in table} == table
    assert "OBJECT_2110_05," in table["object_table.h"]
    assert "{0x2110, 0x01, KIND_REAL, 8, READABLE | WRITABLE, 0x400E666666666666ull, 0, 0, NULL, 0}" in (
        table["object_table.c"])  # 3.8
