"""A program: the answer of `rig add` about a folder's traces, as JSON. Run by test_other_cpus.py."""

import json
import sys
from pathlib import Path

from effect_files import restored_catalogue
from rig_command import answer

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    words = "null_bias", folder / "biased.csv", "--repeat", folder / "repeat.csv", "--out", "model.toml"
    with restored_catalogue("null_bias", "constant_load", "spool_friction", "jack_friction"):  # a small kernel
        print(json.dumps(answer("add", *words)))
