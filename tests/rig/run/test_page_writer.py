"""The page of a run: written by a second process, or here if that one is of no use."""
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from plant.errors import InputError
from rig.run import page_writer
from rig.run.page_writer import PageWriter

OWNER = """
import sys, time
from rig.run.page_writer import PageWriter
with PageWriter(in_background=True) as pages:
    print(pages._process.pid, flush=True)
    time.sleep(60)
"""


@pytest.fixture(autouse=True)
def two_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second process is started on this machine, whatever its number of CPUs."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})


def is_page(file: Path) -> bool:
    return file.read_text().startswith("<!DOCTYPE html>") and "</html>" in file.read_text()


def is_running(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_both_ways_write_the_same_page(preflight: Path, tmp_path: Path) -> None:
    for name, in_background in (("here.html", False), ("there.html", True)):
        with PageWriter(in_background=in_background) as pages:
            assert (pages._process is not None) is in_background
            pages.start_page(preflight / "trace.mcap", tmp_path / name)
            pages.finish_page()
            if in_background:
                assert pages._process is not None and pages._process.returncode == 0
    assert is_page(tmp_path / "here.html")
    assert (tmp_path / "here.html").read_text() == (tmp_path / "there.html").read_text()


def test_a_run_may_wait_until_the_second_process_has_loaded(preflight: Path, tmp_path: Path) -> None:
    """Afterwards it does nothing until there is a page to write; one that has died is not waited for."""
    with PageWriter(in_background=True) as pages:
        pages.wait_until_loaded()
        assert pages._process is not None
        spent: list[tuple[str, str]] = []
        while len(spent) < 4 or (spent[-4] != spent[-1] and len(spent) < 100):  # it may be kept from coming to rest
            time.sleep(0.2)
            spent.append(read_cpu_time(pages._process.pid))
        assert spent[-4] == spent[-1]
        pages.start_page(preflight / "trace.mcap", tmp_path / "page.html")
        pages.finish_page()
        assert pages._process.returncode == 0 and is_page(tmp_path / "page.html")
    with PageWriter(in_background=True) as pages:
        assert pages._process is not None
        pages._process.kill()
        pages.wait_until_loaded()
        pages.start_page(preflight / "trace.mcap", tmp_path / "second.html")
        pages.finish_page()
    assert is_page(tmp_path / "second.html")


def read_cpu_time(pid: int) -> tuple[str, str]:
    """CPU time of a process in clock ticks: user, system."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return words[11], words[12]


def test_files_of_the_working_directory_are_not_imported(
    preflight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("plant.py", "json.py", "queue.py"):
        (tmp_path / name).write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder])
    with PageWriter(in_background=True) as pages:
        pages.start_page(preflight / "trace.mcap", Path("page.html"))
        pages.finish_page()
        assert pages._process is not None and pages._process.returncode == 0
    assert is_page(tmp_path / "page.html")


def test_a_second_process_that_dies_costs_no_page(preflight: Path, tmp_path: Path) -> None:
    with PageWriter(in_background=True) as pages:
        assert pages._process is not None
        pages._process.kill()
        pages.start_page(preflight / "trace.mcap", tmp_path / "page.html")
        pages.finish_page()
    assert is_page(tmp_path / "page.html")


def test_a_second_process_that_cannot_start_costs_no_page(
    preflight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_writer.sys, "executable", str(tmp_path / "no python"))
    with PageWriter(in_background=True) as pages:
        pages.start_page(preflight / "trace.mcap", tmp_path / "page.html")
        pages.finish_page()
    assert is_page(tmp_path / "page.html")


@pytest.mark.parametrize("trace_is_missing", [False, True])
def test_bad_input_is_the_same_error_both_ways(trace_is_missing: bool, preflight: Path, tmp_path: Path) -> None:
    source = tmp_path / "missing.mcap" if trace_is_missing else preflight / "trace.mcap"
    out = tmp_path / "page.html" if trace_is_missing else tmp_path / "missing" / "page.html"
    errors = []
    for in_background in (False, True):
        with PageWriter(in_background=in_background) as pages, pytest.raises(InputError) as caught:
            pages.start_page(source, out)
            pages.finish_page()
        errors.append((caught.value.where, caught.value.field, caught.value.expected))
        if in_background:
            assert pages._process is not None and pages._process.returncode == 0
    assert errors[0] == errors[1]
    assert str(source if trace_is_missing else out) in errors[0]


def test_without_a_page_no_process_is_left() -> None:
    with PageWriter(in_background=True) as pages:
        process = pages._process
        assert process is not None and process.poll() is None
    assert process.returncode is not None


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
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
