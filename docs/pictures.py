"""Make falling_error.svg and viewer.png: python docs/pictures.py (needs the extra `view`)."""
from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image  # comes with matplotlib

from fdi.discovery.update_model import load_model_file
from fdi.report.drawing import shorten_svg

HERE = Path(__file__).parent
RIG = [sys.executable, "-m", "rig.cli.main"]


def draw_falling_error(folder: Path) -> None:
    """Draw the residuals of run.csv with the nominal model and with better.toml, both in `folder`."""
    from tutorial_pictures import draw_residuals  # a neighbour, found when this file runs as a script

    with contextlib.chdir(folder):
        drawn = draw_residuals("run.csv", "run2.csv", load_model_file(Path("better.toml"))[0])
    (HERE / "falling_error.svg").write_text(shorten_svg(drawn), encoding="utf-8")


def main() -> None:
    """Draw the README's fit; run the preflight check once, and draw it for the report and in the viewer."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*RIG, "simulate", "--samples"], check=True, cwd=folder)
        subprocess.run([*RIG, "add", "null_bias", "jack_friction", "run.csv", "--repeat", "run2.csv", "--holdout",
                        "held.csv", "--out", "better.toml", "--quiet"], check=True, cwd=folder)
        draw_falling_error(Path(folder))
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*RIG, "run", "preflight", "--quiet", "--out", folder], check=True)
        picture = Path(folder, "viewer.png")
        subprocess.run([*RIG, "view", folder, "--out", str(picture)], check=True)
        with Image.open(picture) as image:  # a palette does for a user interface, at a quarter of the size
            small = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            small.save(HERE / "viewer.png", optimize=True)


if __name__ == "__main__":
    main()
