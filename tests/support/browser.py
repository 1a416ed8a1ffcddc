"""A headless browser for pages: how wide they come out, and what their scripts do.

Without chromium `find_browser` is None; what needs it is skipped, or fails with EHA_RIG_REQUIRE_BROWSER=1.
"""

import json
import os
import re
import shutil
import subprocess
import tempfile
from html import unescape
from pathlib import Path
from typing import NamedTuple

import pytest

PROBE = """<script>addEventListener("load", () => {
  const root = document.documentElement, width = root.clientWidth, out = [];
  const scrolls = e => { for (; e && e !== document.body; e = e.parentElement)
    if (["auto", "scroll", "hidden"].includes(getComputedStyle(e).overflowX)) return true; return false; };
  for (const e of document.body.querySelectorAll(":not(svg *)"))
    if (e.getBoundingClientRect().right > width + 1 && !scrolls(e.parentElement)) out.push(e.outerHTML.slice(0, 80));
  const note = document.createElement("pre"); note.id = "probe";
  note.textContent = JSON.stringify({inner: innerWidth, scroll: root.scrollWidth, client: root.clientWidth,
    height: root.scrollHeight, beyond: out, errors: window.probeErrors || [], notes: window.probeNotes || {}});
  document.body.append(note);
});
window.probeErrors = []; addEventListener("error", e => window.probeErrors.push(e.message));
</script>"""


TELL_PARENT = """<script>addEventListener("load", () => setTimeout(() => document.body.append(
  frames[0].document.getElementById("probe").cloneNode(true)), 50));</script>"""


class PageSize(NamedTuple):
    """How a page came out, CSS pixels."""

    inner: int  # width of the window
    scroll: int  # width of what is in it
    client: int  # width without a scroll bar
    height: int
    beyond: list[str]  # elements that are cut off at the right and do not scroll in a box of their own
    errors: list[str]  # of scripts
    notes: dict[str, str]  # what the script of the caller left in window.probeNotes


def find_browser() -> str | None:
    """Chromium, if this machine has one; the one without a screen first, which starts in half of the time."""
    names = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


needs_browser = pytest.mark.skipif(find_browser() is None and not os.environ.get("EHA_RIG_REQUIRE_BROWSER"),
                                   reason="no chromium (Debian: apt-get install chromium-headless-shell)")


def call_browser(*arguments: str, seconds: float = 120.0) -> str:
    """Run the browser once and return its standard output."""
    browser = find_browser()
    assert browser is not None
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
                   f"--user-data-dir={profile}", *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=True).stdout


def measure_page(page: Path, width: int, script: str = "") -> PageSize:
    """Open a page in a window of `width` pixels, run `script` in it, and measure it."""
    run = f"<script>addEventListener('load', () => {{ {script} }});</script>" if script else ""  # before the probe
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "page.html")
        copy.write_text(page.read_text(encoding="utf-8").replace("<head>", f"<head>{run}{PROBE}", 1), encoding="utf-8")
        frame = Path(folder, "frame.html")  # a window is never narrower than 500 pixels
        frame.write_text(f'<body style="margin:0"><iframe src="page.html" style="border:0;width:{width}px;height:900px"'
                         f"></iframe>{TELL_PARENT}", encoding="utf-8")
        dom = call_browser("--allow-file-access-from-files", "--virtual-time-budget=10000",
                           f"--window-size={max(width, 500)},900", "--dump-dom", frame.as_uri())
    match = re.search(r'<pre id="probe">(.*?)</pre>', dom, re.DOTALL)
    assert match, f"{page}: the page did not load"
    return PageSize(**json.loads(unescape(match[1])))
