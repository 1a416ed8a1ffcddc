"""Make all kinds of pages and look at them in a browser: python tests/support/page_pictures.py FOLDER [PAGE ..].

Each page (report, compare, explain, add, fdi, trend, diff, suite, check, reaction; default: all) is photographed at
1400, 800 and 400 pixels and printed into FOLDER, as PDF and, with pdftoppm, as pictures of its sheets. A page that is
wider than its window, cuts off an element, has an error in its script or comes out empty ends this program with status
1. Without chromium it says so and makes the pages alone.
"""
from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
from browser import find_browser, measure_page, print_page, take_picture
from PIL import Image  # comes with matplotlib

RIG = [sys.executable, "-m", "rig.cli.main"]
RUN = ("run.csv", "--repeat", "run2.csv", "--holdout", "held.csv")
COMMANDS = {
    "report": ("report", "clogged", "--out", "report.html"),
    "compare": ("compare", "run.csv", "--repeat", "run2.csv", "--out", "compare.html"),
    "explain": ("explain", *RUN, "--out", "explain.html"),
    "add": ("add", "null_bias", "jack_friction", *RUN, "--out", "add.toml"),
    "fdi": ("fdi", "clogged", "--out", "fdi.html"),
    "trend": ("trend", "sizes.json", "--out", "trend.html"),
    "diff": ("diff", "healthy", "clogged", "--out", "diff.html"),
    "suite": ("run", "suite.toml", "--out", "suite"),
    "check": ("check", "lost_frames", "--out", "check.html"),
    "reaction": ("report", "lost", "--out", "reaction.html")}
SUITE = """
title = "Pages"

[requirements]
REQ-1 = "A step of 5 mm overshoots by at most 11 %"
REQ-2 = "Lost feedback leads to zero current"

[[case]]
name = "unit"
sequence = "preflight"
set = { "filter.clogging" = [0.0, 0.3] }
requirement = "REQ-1"
fdi = true

[[case]]
sequence = ["lost_feedback", "lost.toml"]
requirement = "REQ-2"
"""
FIND_SCROLLING = """window.probeNotes = {scrolling: [...document.querySelectorAll(".scroll")]
  .filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.innerText.slice(0, 40)).join("; ")};"""
NARROW = 700  # pixels of a window; in a wider one no table scrolls
LARGEST_PAGE = 3_000_000  # bytes


def main(folder: Path, names: list[str]) -> int:
    """Make the pages and their pictures; the number of defects."""
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    make_inputs()
    for name in names:
        if not Path(f"{name}.html").exists():
            subprocess.run([*RIG, *COMMANDS[name], "--quiet"], check=False)  # status 1 is a verdict
            if name == "suite":  # beside its cases, so that the links stay
                Path("suite.html").symlink_to(Path("suite", "suite.html"))
    if find_browser() is None:
        print("no chromium on this machine: no pictures")
        return 0
    defects = [defect for name in names for defect in inspect_page(Path(f"{name}.html"))]
    print("\n".join(defects) or f"{len(names)} pages: nothing is cut off")
    return min(len(defects), 1)


def make_inputs() -> None:
    """Runs and recordings that the commands need, where they are not there yet."""
    if not Path("run.csv").exists():
        subprocess.run([*RIG, "simulate", "--samples"], check=True)
    shipped = (files("rig.sequences") / "lost_feedback.toml").read_text()
    Path("lost.toml").write_text(shipped.replace("high = 5,", "high = 0.5,"))  # reactions that are too slow
    Path("suite.toml").write_text(SUITE)
    for name, words in (("healthy", ()), ("clogged", ("--set", "filter.clogging=0.5", "--fdi")),
                        ("lost", ("lost.toml",))):
        if not Path(name).exists():
            subprocess.run([*RIG, "run", "--quiet", "--out", name, *words], check=False)
    weeks = np.arange(12)
    sizes = zip((20458.0 + 7.0 * weeks).tolist(), (0.08 * np.exp(0.1 * weeks)).tolist(), (8.0 + 3.1 * weeks).tolist(),
                strict=True)
    points = [{"trace": f"{i}.csv", "t": t, "kintas": {"value": k, "low": k - 0.04, "high": k + 0.04},
               "fss": {"value": f, "low": f - 3.0, "high": f + 3.0}} for i, (t, k, f) in enumerate(sizes)]
    Path("sizes.json").write_text(json.dumps({"axis": "date", "points": points}))


def inspect_page(page: Path) -> list[str]:
    """Photograph and print a page; what is wrong with it, in words."""
    defects = []
    if page.stat().st_size > LARGEST_PAGE:
        defects.append(f"{page}: {page.stat().st_size} bytes")
    for width in (1400, 800, 400):
        size = measure_page(page, width, FIND_SCROLLING)
        if size.scroll > size.client or size.beyond:
            defects.append(f"{page} at {width}: {size.scroll} wide, cut off: {size.beyond}")
        if width > NARROW and size.notes["scrolling"]:
            defects.append(f"{page} at {width}: a table is wider than the window: {size.notes['scrolling']}")
        defects += [f"{page} at {width}: {error}" for error in size.errors]
        picture = page.with_name(f"{page.stem}_{width}.png")
        take_picture(page, width, picture)
        with Image.open(picture) as image:
            if np.asarray(image.convert("L"))[:, :width].std() < 10.0:
                defects.append(f"{picture}: empty")
    print_page(page, page.with_suffix(".pdf"))
    sheets = page.with_suffix(".pdf").read_bytes().count(b"/Type /Page\n")
    print(f"{page}: {page.stat().st_size} bytes, {sheets} sheets of paper")
    if shutil.which("pdftoppm"):
        subprocess.run(["pdftoppm", "-r", "60", "-png", page.with_suffix(".pdf"), f"{page.stem}_sheet"], check=True)
    return defects if sheets else [*defects, f"{page}: nothing was printed"]


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:] or list(COMMANDS)))
