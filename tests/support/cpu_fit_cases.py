"""A program: the answers of compare, add and fdi about a folder's traces, as JSON. For test_fits_on_other_cpus.py."""

import json
import sys
from pathlib import Path
from typing import Any

from rig_command import rig


def print_answers(folder: Path) -> None:
    """One object on standard output: command to its JSON answer."""
    biased, repeat = folder / "biased.csv", folder / "repeat.csv"
    answers: dict[str, Any] = {
        "add": rig("add", "null_bias", biased, "--repeat", repeat, "--out", "model.toml", "--json").json,
        "fdi": rig("fdi", folder / "clogged.csv", "--json").json,
    }
    print(json.dumps(answers))


if __name__ == "__main__":
    print_answers(Path(sys.argv[1]))
