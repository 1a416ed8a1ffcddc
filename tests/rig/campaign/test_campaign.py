"""rig campaign: the same rows by one process, by a cluster that loses a worker, and after a kill; its runner."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import campaign_work
import numpy as np
import pytest
from places import SUPPORT
from refusals import catch_refusal
from rig_command import answer, finished, grown, is_running, refuse, rig, started

from fdi.estimation import measure_share
from fdi.report import format_report
from fdi.trace import Trace
from plant import Fault, Model, RigError, find_plant, place_faults
from plant.effects import CATALOGUE
from rig.campaign import batch, judge, summary as campaign_summary
from rig.campaign.batch import BatchProgress, RowFile, Workers, run_in_processes, run_jobs
from rig.campaign.judge import run_campaign
from rig.campaign.summary import build_campaign_report

pytest.importorskip("distributed", reason="the extra fleet is not installed")
pytest.importorskip("pyarrow", reason="the extra fleet is not installed")
MATRIX = ("--fault", "healthy", "--fault", "filter_clogging=0.2,0.9", "--fault", "spool_friction=30/jack_friction=1600",
          "--seeds", 2, "--work", "campaign_work:judge_quickly")


def rows(where: Path) -> list[dict[str, Any]]:
    """The rows of a campaign without the time that each took, which differs between two runs."""
    return [{key: value for key, value in row.items() if key != "seconds"} for row in judge.read_campaign_rows(where)]


def calls(path: Path) -> list[tuple[int, str]]:
    lines = path.read_text().splitlines() if path.exists() else []
    return [(int(line.split(" ", 1)[0]), line.split(" ", 1)[1]) for line in lines]


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """For processes: where the judgement is found, and the file in which it leaves its marks."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("CAMPAIGN_CALLS", str(tmp_path / "calls"))
    return tmp_path / "calls"


@pytest.fixture
def gate(environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that holds up every case while it is there."""
    monkeypatch.setenv("CAMPAIGN_GATE", str(tmp_path / "gate"))
    (tmp_path / "gate").touch()
    return tmp_path / "gate"


def wait_for(holds: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 600.0) -> None:
    """Wait until something holds that `process` brings about; the limit only ends a test that hangs."""
    end = time.monotonic() + seconds
    while not holds():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.02)


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished campaign of eight cases, by this process."""
    where = tmp_path_factory.mktemp("campaign") / "local"
    whole = judge.build_matrix({"seeds": 2, "case": judge.parse_faults(MATRIX[1:6:2])}, Model(), MATRIX[-1], "test")
    run_campaign(whole, where, Workers())
    return where


@pytest.fixture
def cluster(gate: Path, tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The address of a Dask scheduler with two worker processes, over TCP."""
    def start(program: str, *words: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *map(str, words)]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=tmp_path)

    where, note = "tcp://127.0.0.1", tmp_path / "scheduler.json"
    processes = [start("scheduler", "--host", where, "--port", 0, "--dashboard-address", "127.0.0.1:0",
                       "--scheduler-file", note)]
    processes += [start("worker", "--scheduler-file", note, "--nthreads", 1, "--no-nanny", "--no-dashboard", "--host",
                        where) for _ in range(2)]
    assert grown(note, 10, processes[0])
    yield json.loads(note.read_text())["address"], processes
    for process in processes:
        process.kill()
        process.wait()


def test_a_cluster_that_loses_a_worker_gives_the_same_rows_as_one_process(
        cluster: tuple[str, list[subprocess.Popen[bytes]]], environment: Path, gate: Path, local: Path,
        tmp_path: Path) -> None:
    address, processes = cluster
    folder = tmp_path / "there"
    process = started("campaign", *MATRIX, "--out", folder, "--scheduler", address, "--quiet")
    wait_for(lambda: len({pid for pid, _ in calls(environment)}) == 2, process)
    victim, at_work = calls(environment)[-1]  # in the middle of a case, for the gate holds it up
    assert victim in [worker.pid for worker in processes[1:]]
    os.kill(victim, signal.SIGKILL)
    gate.unlink()
    assert finished(process).status == 1  # one case fails
    assert rows(folder) == rows(local) == rows(folder / judge.RESULTS)
    did = calls(environment)
    assert Counter(source for _, source in did)[at_work] == 2 and len({pid for pid, _ in did}) >= 2


def test_a_campaign_that_was_killed_goes_on_and_repeats_nothing(
        environment: Path, gate: Path, local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAMPAIGN_FREE", "3")
    folder, few = tmp_path / "there", ("--most", 6, "--jobs", 1)
    process = started("campaign", *MATRIX, *few, "--out", folder)
    wait_for(lambda: len(calls(environment)) == 4 and (folder / judge.ROWS).read_bytes().count(b"\n") == 3, process)
    process.kill()
    process.wait()
    gate.unlink()
    done = rows(folder)
    assert len(done) == 3
    with (folder / judge.ROWS).open("a") as out:
        out.write('{"case": 5, "label": "hea')  # as a kill in the middle of a write leaves it
    result = rig("campaign", folder, *few, *MATRIX[-2:], "--json")
    assert (result.status, result.json["cases"]) == (0, 6)
    assert rows(folder) == rows(local)[:6] and rows(folder / judge.RESULTS) == rows(folder)
    again = Counter(source for _, source in calls(environment))
    assert len(again) == 6 and sum(again.values()) <= 7  # the one that the kill interrupted may have begun twice
    for row in done:
        assert again[f"{row['label']} {row['seed']}"] == 1


def test_a_failed_case_is_kept_with_its_reason_and_judged_again_on_demand(local: Path, tmp_path: Path) -> None:
    failures = [row for row in rows(local) if row["status"] == "failed"]
    assert [(row["label"], row["seed"], row["reason"]) for row in failures] == [
        ("filter_clogging=0.9", 1, "ZeroDivisionError: nothing left to divide")]
    assert "rms" not in failures[0] and "rms" in rows(local)[0]
    copy, progress = shutil.copytree(local, tmp_path / "copy"), list[BatchProgress]()
    matrix = judge.read_matrix_of_folder(copy)
    assert len(run_campaign(matrix, copy, Workers(), progress.append)) == 8 and progress == []
    again = run_campaign(matrix, copy, Workers(), progress.append, redo_failed=True)
    assert [p.row["label"] for p in progress] == ["filter_clogging=0.9"] and progress[0].done == 8
    assert [row["case"] for row in again] == list(range(8)) and rows(copy) == rows(local)


def test_a_folder_belongs_to_one_matrix_one_code_and_one_process(local: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for words, line in (((*MATRIX, "--seeds", 4, "--out", local),
                         "a folder of this matrix, or a new one; it differs in seeds, case"),
                        ((*MATRIX, "--out", tmp_path), "an empty folder"),
                        (("--fault", "filter_clogging=0.1/filter_clogging=0.2"), "one size for filter_clogging, not"),
                        (("--fault", "healthy", "--seeds", 0), "--seeds: expected a whole number from 1, not '0'"),
                        (("--fault", "healthy", "--seed", 2**63), "from 0 to 9223372036854775807"),
                        (("--fault", "coil.resistance=5"),
                         "expected a fault (filter_clogging, spool_friction) or an effect of the catalogue")):
        assert line in refuse("campaign", *words)
    whole, sources = judge.read_matrix_of_folder(local), judge.hash_campaign_sources()
    assert "the code has changed" in catch_refusal(judge.open_campaign, local, whole, "another")
    with judge.open_campaign(local, whole, sources):
        assert "no other rig process" in catch_refusal(judge.open_campaign, local, whole, sources)
    assert "a folder that can be written" in catch_refusal(RowFile, local / judge.ROWS / "rows.jsonl")


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere"])
def test_a_scheduler_that_does_not_answer_is_one_line(
        address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "connect_to_cluster", partial(batch.connect_to_cluster, timeout=0.5))
    assert f"--scheduler: {address}: expected the addr" in refuse(
        "campaign", *MATRIX, "--scheduler", address, "--out", tmp_path)


def test_a_matrix_file_says_the_same_as_options_and_any_beginning_is_a_fair_sample(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text('''
        seeds = 2
        [[case]]
        seeds = 8
        [[case]]
        filter_clogging = [0.1, 0.2]
        spool_friction = 45.0
        tolerance = [0.0, 0.02]''')
    matrix = judge.build_matrix(judge.read_matrix(str(tmp_path / "m.toml")), Model(), "fdi", "m")
    whole, half = (Counter(c.label for c in some) for some in (matrix.cases, matrix.cases[:8]))
    assert whole == {"healthy": 8, "filter_clogging=0.1 spool_friction=45": 4,
                     "filter_clogging=0.2 spool_friction=45": 4} == {label: 2 * count for label, count in half.items()}
    assert [c.number for c in matrix.cases] == list(range(16)) and len(set(map(str, matrix.cases))) == 16
    assert {c.tolerance for c in matrix.cases if c.sizes} == {0.0, 0.02}
    assert judge.restore_matrix(json.loads(json.dumps(matrix.spec))).cases == matrix.cases
    shipped = judge.build_matrix(judge.read_matrix("statistics"), Model(), "fdi", "statistics")
    labels = Counter(c.label for c in shipped.cases)
    assert len(shipped.cases) >= 500 and labels["healthy"] >= 200 and labels[campaign_summary.OFF_GRID] >= 200


@pytest.mark.parametrize(("word", "label", "sizes"), [
    ("clog=0.3", "clog=0.3", [0.3, 10.0 / 3.0]), ("filter_clogging=0.3", "clog=0.3", [0.3, 10.0 / 3.0]),
    ("filter.clogging=0.3", "clog=0.3", [0.3, 10.0 / 3.0]), ("spool_friction=45", "spool_friction=45", [0.0, 30.0])])
def test_a_true_size_is_recorded_whatever_names_the_fault(word: str, label: str, sizes: list[float]) -> None:
    faults = place_faults([Fault("clog", "", "filter.clogging", (0.0, 0.9), 0.25, 0.35, symbol="kx"),
                           Fault("rub", "", "spool.dynamic_friction", (0.0, 99.0), 20.0, 50.0)], find_plant("eha"))
    matrix = judge.build_matrix({"tolerance": 0.0, "case": judge.parse_faults([word])}, Model(), "", "x", faults)
    row = judge.describe_case(matrix.cases[0], matrix.spec)
    assert row["label"] == label and [row[f"true_{fault.key}"] for fault in faults] == pytest.approx(sizes)


def test_a_case_depends_on_its_own_seed_alone_and_hides_what_it_says() -> None:
    spec = judge.build_matrix({"case": [{}]}, Model(), "", "x").spec
    case = judge.Case(5, "spool_friction=45", {"spool_friction": 45.0}, 0.015, 3)
    first, second = (judge.simulate_case(case._replace(number=n), spec, Model()) for n in (5, 99))
    other = judge.simulate_case(case._replace(seed=4), spec, Model())
    for name in ("xj", "cor", "p12", "xs"):
        assert (first.column(name) == second.column(name)).all() and (first.column(name) != other.column(name)).any()
    model = judge.add_faults(Model(), {"spool_friction": 45.0, "jack_friction": 1600.0, "stribeck": 0.3})
    assert model["spool.dynamic_friction"] == pytest.approx(30.0) and model["jack.dynamic_friction"] == 1000.0
    assert model[CATALOGUE["stribeck"].fitted[0]] == 0.3 and model[CATALOGUE["stribeck"].fitted[1]] > 0
    assert set(judge.simulate_case(case, {**spec, "signals": "xj"}, Model()).signals) == {"com", "xj", "cor", "load"}


def test_a_folder_of_traces_is_judged_and_a_changed_trace_is_another_campaign(tmp_path: Path) -> None:
    columns = {name: np.linspace(0.0, 1e-3, 400) for name in ("com", "xj", "cor", "p12", "xs", "load")}
    for name in ("b.csv", "a.csv.gz"):
        Trace.from_columns(columns, 1e-3, {}).write_csv(tmp_path / name)
    (tmp_path / "c.csv").write_text("nothing\n1\n")
    words = ("campaign", tmp_path, "--out", tmp_path / "out", *MATRIX[-2:], "--json", "--jobs", 1)
    result, case_rows = rig(*words), rows(tmp_path / "out")
    assert (result.status, result.json["status"]) == (0, {"ok": 2, "refused": 1})
    assert ("FSS [N]" in rig("campaign", tmp_path / "out", "--summary").out
            and [row["label"] for row in case_rows] == ["a.csv.gz", "b.csv", "c.csv"])
    assert case_rows[2]["reason"].startswith(str(tmp_path / "c.csv"))
    Trace.from_columns(columns, 2e-3, {}).write_csv(tmp_path / "b.csv")
    assert "it differs in files" in refuse(*words)


def test_rig_fdi_in_a_campaign_finds_both_faults_and_the_statistics_are_written(tmp_path: Path) -> None:
    result = rig("campaign", "--fault", "filter_clogging=0.17/spool_friction=45", "--seeds", 1, "--tolerance", 0,
                 "--out", tmp_path, "--json", "--jobs", 1)
    row, = judge.read_campaign_rows(tmp_path)
    assert row["status"] == "ok" and result.json["cases"] == 1, row["reason"]
    assert row["kintas"] == pytest.approx(0.17, rel=0.1) and row["fss"] == pytest.approx(45.0, rel=0.05)
    assert row["kintas_low"] < 0.17 < row["kintas_high"] and row["fss_low"] < 45.0 < row["fss_high"]
    assert (row["level_spool_friction"], row["ruling"]) == ("maintenance", "spool_friction")
    summary = rig("campaign", tmp_path / judge.RESULTS, "--summary").out
    assert "off-grid FSS within 2 %" in summary and "1/1" in summary
    assert answer("campaign", tmp_path, "--summary") == result.json
    assert json.loads((tmp_path / "summary.json").read_text()) == result.json


def test_a_plant_file_is_judged_by_worker_processes_and_resumed_only_with_trust(environment: Path, here: Path) -> None:
    rig("new", "plant", "my_motor")
    work = ("--work", "campaign_work:count_rows")
    rig("campaign", "--model", "my_motor.py", "--fault", "healthy", "--seeds", 3, "--out", "two", "--jobs", 2,
        "--most", 2, *work)
    case_rows = rows(here / "two" / judge.RESULTS)
    fault, = judge.restore_faults(judge.read_matrix_of_folder("two").spec)
    assert [row["status"] for row in case_rows] == ["ok", "ok"]
    truth = {row[f"true_{fault.key}"] for row in case_rows}
    assert len(truth) == 2 and fault.healthy not in truth  # the parameter of the fault scatters as well
    assert "expected --trust" in refuse("campaign", "two", *work)
    with Path("my_motor.py").open("a") as file:
        file.write("# changed\n")
    result = rig("campaign", "two", *work, "--trust")
    assert result.status == 2 and "is not the plant file with which the campaign was started" in result.err


CLOGGING, FRICTION = "filter_clogging", "spool_friction"


def judged(label: str, kintas: float, fss: float, level_pair: tuple[str, str], n: int, **more: Any
           ) -> list[dict[str, Any]]:
    sizes = {"kintas": kintas, "kintas_low": kintas - 0.02, "kintas_high": kintas + 0.02, "fss": fss * 1.01,
             "fss_low": np.float64(fss * 0.95), "fss_high": fss * 1.005}
    levels = dict(zip(("filter_clogging", "spool_friction"), level_pair, strict=True))
    ruling = next((fault for fault, level in levels.items() if level != "acceptable"), "")
    return [{"label": label, "faults": len(label.split()) if label != "healthy" else 0, "tolerance": 0.015, "seed": i,
             "status": "ok", "reason": "", "true_kintas": kintas, "true_fss": fss,
             "level_filter_clogging": level_pair[0], "level_spool_friction": level_pair[1], "ruling": ruling,
             "band_spool_friction": level_pair[1] if level_pair[1] == "non_nominal" else "acceptable",
             "seconds": 2.0, **sizes, **more} for i in range(n)]


def test_statistics_count_what_was_said() -> None:
    fine, bad, worst = "acceptable", "maintenance", "non_nominal"
    case_rows = [*judged("healthy", 0.0, 5.0, (fine, fine), 399), *judged("healthy", 0.0, 5.0, (fine, bad), 3),
                 *judged("filter_clogging=0.25", 0.25, 5.0, (bad, fine), 38),
                 *judged("filter_clogging=0.25", 0.25, 5.0, (fine, fine), 2),
                 *judged("spool_friction=70", 0.0, 70.0, (fine, worst), 30),
                 *judged("spool_friction=70", 0.0, 70.0, (bad, fine), 1),
                 *judged("spool_friction=70", 0.0, 70.0, (fine, fine), 1, status="refused"),
                 *judged(campaign_summary.OFF_GRID, 0.17, 45.0, (fine, bad), 25)]
    figures = campaign_summary.summarise_campaign(case_rows)
    (part,) = figures["tolerances"]
    rates = {rate["name"]: (rate["share"]["good"], rate["share"]["of"], rate["met"]) for rate in part["rates"]}
    expected_rates = {
        "healthy: false alarm": (3, 402, False), "Kintas at MidBand detected": (38, 40, True),
        "FSS at MaxBand detected": (30, 32, False), "Kintas at MaxBand detected": (0, 0, None),
        "ruling fault, MidBand on": (68, 72, False), "off-grid Kintas covered": (25, 25, False),
        "off-grid FSS within 2 %": (25, 25, None)}
    assert {name: rates[name] for name in expected_rates} == expected_rates
    points = [(p["size"], *(p[key]["good"] for key in ("detected", "most", "bands"))) for p in part["curves"][FRICTION]]
    assert points == [(5.0, 3, 0, 0), (70.0, 30, 30, 30)]
    assert part["levels"][CLOGGING]["acceptable"] == {
        fine: 402 + 30 + 25, bad: 1, worst: 0, "cannot_tell": 0, "refused": 1, "failed": 0}
    assert part["ruling"]["spool_friction, non_nominal"] == {
        "spool_friction": 30, "filter_clogging": 1, "refused": 1}
    error = next(e for e in part["errors"] if (e["label"], e["fault"]) == (campaign_summary.OFF_GRID, FRICTION))
    assert (error["bias"], error["rms"], error["covered"]["good"]) == (pytest.approx(0.45), pytest.approx(0.45), 25)
    json.dumps(figures, allow_nan=False)
    text, svg = format_report(build_campaign_report(figures), 100), campaign_summary.draw_detection_curves(part)
    assert "3/402" in text and "NOT met" in text and "93.8 (79.2 .. 99.2)" in text
    assert svg.startswith("<svg") and "MaxBand" in svg and "maintenance or worse" in svg


@pytest.mark.parametrize(("good", "of", "least", "most", "is_met"), [
    (0, 23, 0.0, 0.005, None), (0, 200, 0.0, 0.005, True), (2, 200, 0.0, 0.005, False), (10, 100, 0.0, 0.005, False),
    (19, 20, 0.95, 1.0, True), (5, 5, 0.95, 1.0, None), (30, 32, 0.995, 1.0, False), (95, 100, 0.93, 0.97, True),
    (99, 100, 0.93, 0.97, False), (3, 9, 0.0, 1.0, None), (0, 0, 0.95, 1.0, None)])
def test_a_rate_is_judged_when_enough_was_counted(good: int, of: int, least: float, most: float, is_met: bool | None
                                                  ) -> None:
    assert campaign_summary.judge_rate("", measure_share(good, of), least, most)["met"] is is_met


def fail_test(job: object, reason: str) -> Any:
    raise AssertionError(f"{job}: {reason}")


def test_a_worker_that_dies_is_replaced_and_its_job_is_tried_again_until_it_has_failed(tmp_path: Path) -> None:
    jobs = [(0, ""), (1, str(tmp_path / "died")), (2, ""), (3, "always")]
    results = dict(run_in_processes(campaign_work.square_of_deadly_job, jobs, 2, lambda job, reason: (-1, reason)))
    assert (tmp_path / "died").exists() and [results[job][0] for job in jobs[:3]] == [0, 1, 4]
    assert os.getpid() not in {pid for _, pid in results.values()}
    assert results[jobs[3]] == (-1, "each of 3 worker processes that tried it died")


def test_an_exception_of_a_job_reaches_the_caller_as_it_was_raised() -> None:
    jobs = run_in_processes(campaign_work.refuse, [1, 2, 3, 4], 2, fail_test)
    assert "job: 3: expected another job" in catch_refusal(list, jobs)


def test_a_worker_that_cannot_start_is_an_error_and_not_an_endless_loop() -> None:
    with pytest.raises(RigError, match="a worker process died while it was starting"):
        list(run_in_processes(campaign_work.Unpicklable(), [1, 2], 2, fail_test))


def test_workers_are_limited_to_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    results = dict(run_jobs(campaign_work.count_usable_threads, [1, 2], Workers(2), fail_test))
    assert results == {1: 1, 2: 1} and os.environ["OMP_NUM_THREADS"] == "5"


@pytest.mark.parametrize("work", ["run_sleeping_process", "run_process_without_signals"])
def test_an_interruption_ends_the_workers_and_the_processes_they_started(work: str, tmp_path: Path) -> None:
    command = [sys.executable, str(Path(campaign_work.__file__)), work, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: (tmp_path / "pids").exists() and len((tmp_path / "pids").read_text().split()) >= 4, process)
    pids = [int(word) for word in (tmp_path / "pids").read_text().split()]
    assert all(is_running(pid) for pid in pids)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert (out, err) == ("interrupted\n", "")
    assert not any(is_running(pid) for pid in pids)
