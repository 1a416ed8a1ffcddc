"""Make the pictures of the README anew: python docs/pictures.py (needs the extra `view`)."""
from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from fdi import Trace, figures

HERE = Path(__file__).parent
RIG = [sys.executable, "-m", "rig.cli"]


def main() -> None:
    """One preflight run, drawn by the report's own figure and by the viewer."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*RIG, "run", "preflight", "--seed", "1", "--quiet", "--out", folder], check=True)
        (HERE / "preflight.svg").write_text(figures.signals(Trace.read(folder)), encoding="utf-8")
        picture = Path(folder, "viewer.png")
        subprocess.run([*RIG, "view", folder, "--headless", "--screenshot", str(picture)], check=True)
        (HERE / "viewer.png").write_bytes(picture.read_bytes())


if __name__ == "__main__":
    main()
