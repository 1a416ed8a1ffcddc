"""The resumable runner: rows on disk, processes that die, interruptions."""
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import batch_work
import pytest

from plant import InputError, RigError
from rig.campaign.batch import Batch, BatchProgress, RowFile, Workers, read_rows, run_batch, run_in_processes, run_jobs


def fail_test(job: object, reason: str) -> Any:
    raise AssertionError(f"{job}: {reason}")


@pytest.mark.parametrize("workers", [Workers(), Workers(2), Workers(9)])
def test_every_job_gives_its_result_once_wherever_it_is_done(workers: Workers) -> None:
    jobs = list(range(5))
    assert sorted(run_jobs(batch_work.square, jobs, workers, fail_test)) == [(job, job**2) for job in jobs]
    assert list(run_jobs(batch_work.square, [], workers, fail_test)) == []


def test_a_worker_that_dies_is_replaced_and_its_job_is_tried_again(tmp_path: Path) -> None:
    jobs = [(0, ""), (1, str(tmp_path / "died")), (2, ""), (3, "")]
    results = dict(run_in_processes(batch_work.square_of_deadly_job, jobs, 2, fail_test))
    assert (tmp_path / "died").exists()
    assert [results[job][0] for job in jobs] == [0, 1, 4, 9]
    assert os.getpid() not in {pid for _, pid in results.values()}


def test_a_job_that_kills_every_worker_has_failed_and_the_others_are_done() -> None:
    jobs = [(0, "always"), (1, ""), (2, "")]
    results = dict(run_in_processes(batch_work.square_of_deadly_job, jobs, 2, lambda job, reason: (-1, reason)))
    assert results[jobs[0]] == (-1, "each of 3 worker processes that tried it died")
    assert [results[job][0] for job in jobs[1:]] == [1, 4]


def test_an_exception_of_a_job_reaches_the_caller_as_it_was_raised() -> None:
    with pytest.raises(InputError, match="job: 3: expected another job"):
        list(run_in_processes(batch_work.refuse, [1, 2, 3, 4], 2, fail_test))


def test_a_worker_that_cannot_start_is_an_error_and_not_an_endless_loop() -> None:
    with pytest.raises(RigError, match="a worker process died while it was starting"):
        list(run_in_processes(batch_work.Unpicklable(), [1, 2], 2, fail_test))


@pytest.mark.parametrize(("single_threaded", "threads"), [(False, 5), (True, 1)])
def test_workers_are_limited_to_one_thread_on_demand(single_threaded: bool, threads: int,
                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    workers = Workers(2, single_threaded=single_threaded)
    results = dict(run_jobs(batch_work.count_usable_threads, [1, 2], workers, fail_test))
    assert results == {1: threads, 2: threads} and os.environ["OMP_NUM_THREADS"] == "5"


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("work", ["run_sleeping_process", "run_process_without_signals"])
def test_an_interruption_ends_the_workers_and_the_processes_they_started(work: str, tmp_path: Path) -> None:
    command = [sys.executable, str(Path(batch_work.__file__)), work, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 600  # only ends a test that hangs
    while (not (tmp_path / "pids").exists() or len((tmp_path / "pids").read_text().split()) < 4):
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    pids = [int(word) for word in (tmp_path / "pids").read_text().split()]
    assert all(is_alive(pid) for pid in pids)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert (out, err) == ("interrupted\n", "")
    assert not any(is_alive(pid) for pid in pids)


def test_a_signal_that_is_lost_in_a_job_comes_again(tmp_path: Path) -> None:
    results = run_in_processes(batch_work.lose_first_signal, [str(tmp_path / "a"), str(tmp_path / "b"), ""], 3,
                               fail_test, patience=300.0)
    assert next(results)[0] == ""  # type: ignore[call-overload]
    end = time.monotonic() + 600
    while not ((tmp_path / "a").exists() and (tmp_path / "b").exists()):
        assert time.monotonic() < end
        time.sleep(0.05)
    results.close()  # type: ignore[attr-defined]
    assert (tmp_path / "a").read_text() == (tmp_path / "b").read_text() == "lost, ended by 143"


def make_batch(numbers: range, version: int = 1) -> Batch:
    """Squares; a row counts for its version alone, and the square of 3 has failed."""
    return Batch(jobs={number: number for number in numbers},
                 work=lambda number: {"number": number, "square": number**2, "version": version}, key="number",
                 describe_failure=fail_test, is_valid=lambda row: row["version"] == version,
                 is_failed=lambda row: row["number"] == 3)


def test_finished_jobs_are_not_done_again_and_rows_of_another_version_do_not_count(tmp_path: Path) -> None:
    seen: list[BatchProgress] = []
    path = tmp_path / "new" / "rows.jsonl"
    with RowFile(path) as file:
        run_batch(make_batch(range(2)), file, Workers(), seen.append)
    with path.open("a") as out:
        out.write('{"number": 2, "squ')  # as a kill in the middle of a write leaves it
    with RowFile(path) as file:
        rows = run_batch(make_batch(range(5)), file, Workers(), seen.append)
    assert [row["square"] for row in rows.values()] == [0, 1, 4, 9, 16]
    assert [(p.done, p.total, p.failed) for p in seen] == [(1, 2, 0), (2, 2, 0), (3, 5, 0), (4, 5, 1), (5, 5, 1)]
    assert seen[-1].left == 0.0 and seen[-1].row == rows[4]
    assert list(rows.values()) == read_rows(path)
    assert len(path.read_text().splitlines()) == 6  # five rows and the truncated line, which stays as it is
    with RowFile(path) as file:
        run_batch(make_batch(range(3), version=2), file, Workers(), seen.append)
    assert [(p.done, p.total) for p in seen[5:]] == [(1, 3), (2, 3), (3, 3)]


def test_a_row_file_is_open_in_one_process_and_each_row_is_on_disk_at_once(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    with RowFile(path) as file:
        file.append({"number": 1})
        assert json.loads(path.read_text()) == {"number": 1}
        with pytest.raises(InputError, match="no other rig process is at work"):
            RowFile(path)
    with RowFile(path) as file:
        assert file.rows == [{"number": 1}]
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="a folder that can be written"):
        RowFile(tmp_path / "file" / "rows.jsonl")
