"""The page of a run: written by a second process, or here if that one is of no use."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rig_command import is_running

from rig.run.page_writer import PageWriter

OWNER = """
import sys, time
from rig.run.page_writer import PageWriter
with PageWriter() as pages:
    print(pages._process.pid, flush=True)
    time.sleep(60)
"""


def set_cpus(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """A second process is started on two CPUs, whatever this machine has."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(count)))


@pytest.fixture(autouse=True)
def two_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most tests are about the second process."""
    set_cpus(monkeypatch, 2)


def write_page(pages: PageWriter, source: Path, out: Path) -> str:
    pages.start_page(source, out)
    pages.finish_page()
    page = out.read_text()
    assert page.startswith("<!DOCTYPE html>") and "</html>" in page
    return page


def test_both_ways_write_the_same_page(preflight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of the working directory are not imported, and a run may wait until the second process has loaded."""
    for name in ("plant.py", "json.py", "queue.py"):
        (tmp_path / name).write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder])
    with PageWriter() as pages:
        pages.wait_until_loaded()
        there = write_page(pages, preflight / "trace.mcap", Path("there.html"))
        assert pages._process is not None and pages._process.returncode == 0
    set_cpus(monkeypatch, 1)
    with PageWriter() as pages:
        assert pages._process is None
        assert write_page(pages, preflight / "trace.mcap", tmp_path / "here.html") == there


@pytest.mark.parametrize("is_refused", [False, True])
def test_a_second_process_that_dies_or_cannot_start_costs_no_page(
    preflight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_refused: bool
) -> None:
    if is_refused:
        monkeypatch.setattr(sys, "executable", str(tmp_path / "no python"))
    with PageWriter() as pages:
        assert (pages._process is None) is is_refused
        if pages._process is not None:
            pages._process.kill()
        pages.wait_until_loaded()
        write_page(pages, preflight / "trace.mcap", tmp_path / "page.html")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_no_process_is_left_when_the_run_is_killed(number: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", OWNER], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                          text=True) as owner:
        assert owner.stdout is not None
        pid = int(owner.stdout.readline())
        owner.send_signal(number)
        owner.wait()
    end = time.monotonic() + 60
    while is_running(pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not is_running(pid)
