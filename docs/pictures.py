"""Make the figures preflight.svg and viewer.png: python docs/pictures.py (needs the extra `view`)."""
from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image  # comes with matplotlib

from fdi import Trace
from fdi.report import run_figures

HERE = Path(__file__).parent
RIG = [sys.executable, "-m", "rig.cli.main"]


def main() -> None:
    """Run the preflight check once; draw it with the figure of the report and with the viewer."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*RIG, "run", "preflight", "--quiet", "--out", folder], check=True)
        (HERE / "preflight.svg").write_text(run_figures.draw_signals(Trace.read(folder)), encoding="utf-8")
        picture = Path(folder, "viewer.png")
        subprocess.run([*RIG, "view", folder, "--headless", "--screenshot", str(picture)], check=True)
        with Image.open(picture) as image:  # a palette does for a user interface, at a quarter of the size
            small = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            small.save(HERE / "viewer.png", optimize=True)


if __name__ == "__main__":
    main()
