"""Text tables: the layout is found, the numbers are exact, and what is wrong is named with its line."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdi.trace.importing.formats import open_text_table
from plant.errors import InputError

LAYOUTS = {
    "comma": ("t,x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-8"),
    "semicolon and decimal comma": ("t;x\n0;1,5\n1;2,5\n2;-3e-2\n", "utf-8"),
    "tabulator": ("t\tx\n0\t1.5\n1\t2.5\n2\t-3e-2\n", "utf-8"),
    "white space": ("   t     x\n 0   1.5\n 1   2.5\n  2  -3e-2\n", "utf-8"),
    "mark of UTF-8, CRLF": ("t,x\r\n0,1.5\r\n1,2.5\r\n2,-3e-2\r\n", "utf-8-sig"),
    "UTF-16": ("t,x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-16"),
    "comments and an empty line": ("# a logger\n% 3 rows\n\nt,x\n0,1.5\n# pause\n1,2.5\n2,-3e-2\n", "utf-8"),
    "quoted": ('"t","x"\n"0","1.5"\n"1","2.5"\n"2","-3e-2"\n', "utf-8"),
    "names in a comment": ("# t, x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-8"),
    "words above": ("Logger,7\nserial number 12\nt,x\n0,1.5\n1,2.5\n2,-3e-2\n", "utf-8"),
    "last separator": ("t;x\n0;1.5;\n1;2.5;\n2;-3e-2;\n", "utf-8"),
}


@pytest.mark.parametrize("case", LAYOUTS)
def test_layouts(case: str, tmp_path: Path) -> None:
    text, encoding = LAYOUTS[case]
    (tmp_path / "x.csv").write_bytes(text.encode(encoding))
    table = open_text_table(tmp_path / "x.csv")
    names = list(table.units)
    assert names[:2] == ["t", "x"]
    channels = table.read(["t", "x"])
    assert channels["t"].values.tolist() == [0.0, 1.0, 2.0]
    assert channels["x"].values.tolist() == [1.5, 2.5, -0.03]


def test_units_from_a_line_and_from_brackets(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes("Zeit;Weg [mm];p;Weg [mm]\ns;;bar;\n0;1;2;3\n1;2;3;4\n".encode("latin-1"))
    table = open_text_table(tmp_path / "x.csv")
    assert table.units == {"Zeit": "s", "Weg [mm]": "mm", "p": "bar", "Weg [mm] #2": "mm"}


def test_units_below_names_in_a_table_with_tabulators(tmp_path: Path) -> None:
    (tmp_path / "x.tsv").write_text("Ram Position\tp\n m\tMPa\n0\t1\n1\t2\n")
    assert open_text_table(tmp_path / "x.tsv").units == {"Ram Position": "m", "p": "MPa"}


def test_missing_fields_and_dates(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("when,x,y\n2024-05-01T12:00:00.000,1,2\n2024-05-01T12:00:00.001,NaN,2\n"
                                    "2024-05-01T12:00:00.003,,n/a\n")
    columns = open_text_table(tmp_path / "x.csv").read(["when", "x"], ["when"])
    assert np.diff(columns["when"].values).round(7).tolist() == [0.001, 0.002]
    assert np.isnan(columns["x"].values).tolist() == [False, True, True]


@pytest.mark.parametrize(("row", "place", "reason"), [
    ("2,abc", "line 4: x", "'abc'"), ("2,inf", "line 4: x", "'inf'"), ("2,1_0", "line 4: x", "'1_0'"),
    ("2", "line 4", "2 fields, not 1"), ("2,3,4", "line 4", "2 fields, not 3"),
])
def test_bad_rows(row: str, place: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(f"t,x\n0,1\n1,2\n{row}\n3,4\n")
    with pytest.raises(InputError) as error:
        open_text_table(tmp_path / "x.csv").read(["t", "x"])
    assert place in str(error.value) and reason in str(error.value)


@pytest.mark.parametrize("content", [b"", b"no table\n", b"\0\1\2", b"a,b\nc,d\n"])
def test_what_is_no_table(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"x\.csv"):
        open_text_table(tmp_path / "x.csv")
