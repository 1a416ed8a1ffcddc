"""Command files: read, put on the cycles of a test, and refused with their line."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from refusals import catch_refusal

from fdi.trace import parse_columns, read_command


def test_csv_files_are_read_resampled_and_shifted_to_their_first_row() -> None:
    exact = parse_columns(b"t,com,xj\n4.000,0,9\n4.001,1e-3,9\n4.002,2e-3,9\n", "c.csv")
    assert exact.keys() == {"com"} and exact["com"].tolist() == [0.0, 1e-3, 2e-3]
    coarse = parse_columns(gzip.compress(b"t,value\n0,0\n0.004,4\n"), "c.csv.gz")
    np.testing.assert_allclose(coarse["value"], [0, 1, 2, 3, 4])


def test_read_command_gives_the_load_only_if_there_is_one(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("\ufeffT, Com ,load\n0,1e-3,100\n\n0.001,2e-3,200\n", encoding="utf-8")
    (tmp_path / "none.csv").write_text("t,com\n0,1\n")
    command, load = read_command(tmp_path / "load.csv")
    assert load is not None and read_command(tmp_path / "none.csv")[1] is None
    assert command.tolist() == [1e-3, 2e-3] and load.tolist() == [100.0, 200.0]


@pytest.mark.parametrize(("text", "message"), [
    ("", "c.csv: line 1: expected a header with a column t and commas between columns"),
    ("t;com\n0;1\n", "c.csv: line 1: expected a header with a column t and commas between columns"),
    ("t,xj\n0,1\n", "c.csv: line 1: expected a header with the columns t and com"),
    ("t,com\n", "c.csv: expected at least one row of numbers"),
    ("t,com\n0,1\n0.001,one\n", "c.csv: line 3: com: expected a finite number or an empty field, not 'one'"),
    ("t,com\n0,1\n0.001\n", "c.csv: line 3: expected 2 fields, not 1"),
    ("t,com\n0,nan\n", "c.csv: line 2, com: expected a finite number, not nan"),
    ("t,com\n0,1\n0.001,-5\n", "c.csv: line 3, com: expected at most 1 m either way, not -5"),
    ("t,com\n# of the rig\n0,1\n\n0.001,-5\n", "c.csv: line 5, com: expected at most 1 m either way, not -5"),
    ("t,com,load\n0,0,1e7\n", "c.csv: line 2, load: expected at most 1e+06 N either way, not 1e+07"),
    ("t,com\n0,1\n0,2\n", "c.csv: t: expected times that grow; row 2 has 0 s after 0 s"),
    ("t,com\n0,1\n10000,2\n", "c.csv: line 3, t: expected seconds, and at most 3600 of them, not 10000"),
])
def test_a_bad_file_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c.csv").write_text(text)
    assert catch_refusal(read_command, tmp_path / "c.csv") == f"{tmp_path}/{message}"


def test_what_is_no_csv_at_all_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_bytes(b"\x1f\x8bnot gzip")
    assert "a readable file" in catch_refusal(read_command, tmp_path / "c.csv")
    for path in (tmp_path / "absent.csv", tmp_path):
        assert "a file that can be read" in catch_refusal(read_command, path)
