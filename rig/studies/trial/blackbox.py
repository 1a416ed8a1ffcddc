"""`rig explain` as others use it: a process of its own, files in, one JSON object out."""
from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

NAME = "rig.studies.trial.blackbox:explain"
PATIENCE = 600.0  # s; whoever takes longer has crashed


def explain(est: Path, holdout: Path, repeats: Sequence[Path], signals: Sequence[str]) -> dict[str, Any]:
    """What `rig explain --json` says of a case.

    Raises:
        RuntimeError: it ends with an error; the text is its last line.
        subprocess.TimeoutExpired: it does not end.
    """
    words = ["explain", est, "--holdout", holdout, "--signals", ",".join(signals), "--json"]
    for repeat in repeats:
        words += ["--repeat", repeat]
    done = subprocess.run([sys.executable, "-m", "rig.cli.main", *map(str, words)], capture_output=True, text=True,
                          timeout=PATIENCE, check=False, env=os.environ | {"COLUMNS": "500"})
    if done.returncode not in (0, 1):
        raise RuntimeError((done.stderr.strip().splitlines() or ["no word"])[-1])
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer
