"""The picture of a run: no view with an error, every line to be seen. EHA_RIG_REQUIRE_VIEWER=1 forbids skips."""
from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import record

from fdi.trace import Trace
from rig import recording, viewer

REQUIRED = os.environ.get("EHA_RIG_REQUIRE_VIEWER") == "1"


def _missing() -> str:
    if importlib.util.find_spec("rerun") is None:
        return "no rerun: pip install 'eha-rig[view]'"
    folders = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]
    if not any(folder.glob("*.json") for folder in folders if folder.is_dir()):
        return "no Vulkan driver (Debian: apt-get install mesa-vulkan-drivers libvulkan1)"
    return ""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("run") / "trace.mcap").parent


def test_headless_screenshot_shows_every_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing = _missing()
    if missing and not REQUIRED:
        pytest.skip(missing)
    assert not missing
    trace = Trace.read(folder, all=True)
    recording.write_rrd(trace, folder / "view.rrd")
    pixels = viewer.screenshot(trace, folder / "view.rrd", folder / "view.png")
    assert len(pixels) == 6 and (folder / "view.png").stat().st_size > 50_000
    with capsys.disabled():
        print("\nviewer:", ", ".join(f"{name} {count} px" for name, count in pixels.items()))


def test_viewer_that_cannot_draw_says_so(folder: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("no rerun")
    (tmp_path / "x.rrd").write_bytes(b"")
    trace = Trace.read(folder)
    with pytest.raises(recording.ViewerError, match="does not draw"):
        viewer.screenshot(trace, tmp_path / "x.rrd", tmp_path / "x.png", patience=3)


def test_without_rerun_one_line_says_how_to_get_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(recording.ViewerError, match=r"pip install 'eha-rig\[view\]'"):
        recording.write_rrd(Trace.read(folder), folder / "none.rrd")


def test_without_a_display_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("rerun") is None or sys.platform != "linux":
        pytest.skip("no rerun, or no Linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(recording.ViewerError, match="no display"):
        viewer.open_viewer(Path("x.rrd"))


def test_it_listens_on_this_machine_only() -> None:
    words = viewer._command(Path("x.rrd"), "9999")
    assert words[words.index("--bind") + 1] == "127.0.0.1"


def test_command(folder: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("no rerun")
    words = [sys.executable, "-m", "rig.cli", "view", str(folder), "--save", str(tmp_path / "x.rrd")]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == f"{tmp_path / 'x.rrd'}\n", done.stderr
    done = subprocess.run([*words, "--headless"], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr == "rig view: --headless: expected --screenshot FILE.png with it\n"
