"""What the program loads."""
from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(("words", "is_loaded"), [(["list"], False), (["import"], True)])
def test_only_import_loads_the_reader_of_mf4_files(words: list[str], is_loaded: bool) -> None:
    """python-can would load it, and pandas with it, at every start."""
    pytest.importorskip("asammdf")
    program = ("import sys; from rig.cli.main import leave_out_reader; leave_out_reader(sys.argv[1:]); "
               "import can; print('pandas' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(is_loaded)
