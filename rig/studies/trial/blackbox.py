"""`rig explain` as a user runs it: a separate process that reads files and prints one JSON object."""
from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

RIG_EXPLAIN = "rig.studies.trial.blackbox:run_rig_explain"
"""The name of `run_rig_explain` for `rig.studies.trial.run_trial`."""


def run_rig_explain(est: Path, holdout: Path, repeats: Sequence[Path], signals: Sequence[str], timeout: float = 600.0
                    ) -> dict[str, Any]:
    """The JSON of `rig explain` for a case; `timeout` in s.

    Raises:
        RuntimeError: the command ended with an error; the text is the last line of its standard error.
        subprocess.TimeoutExpired: the command took longer.
    """
    arguments = ["explain", est, "--holdout", holdout, "--signals", ",".join(signals), "--json"]
    for repeat in repeats:
        arguments += ["--repeat", repeat]
    command = [sys.executable, "-m", "rig.cli.main", *map(str, arguments)]
    wide = os.environ | {"COLUMNS": "500"}  # so that an error message stays on one line
    process = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, env=wide)
    if process.returncode not in (0, 1):
        raise RuntimeError((process.stderr.strip().splitlines() or ["no message"])[-1])
    answer: dict[str, Any] = json.loads(process.stdout)
    return answer
