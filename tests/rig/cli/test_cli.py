"""The command as scripts and people see it: help, errors, statuses, signals, pipes; `rig list` and `rig doctor`."""

import importlib.util
import json
import os
import pkgutil
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from rig_command import SHORT, CommandResult, answer, finished, grown, interrupted, refuse, rig, started, write_file

from fdi.trace import Trace
from fdi.trace.trace import CLEANUP
from plant import Model, load_model
from plant.effects import CATALOGUE
from rig import doctor
from rig.cli import commands
from rig.cli.command_list import COMMANDS, find_work
from rig.cli.commands.list import KINDS
from rig.cli.main import FIRST_STEPS
from rig.network import Master
from rig.sequences import checks, load_sequence

LONG = SHORT.replace('"rest", kind = "hold", time = 0.05', '"rest", kind = "hold", time = 60')


@pytest.fixture
def short(tmp_path: Path) -> Path:
    return write_file(tmp_path / "short.toml", SHORT)


def test_the_command_list_agrees_with_the_modules() -> None:
    assert rig("--version").out.startswith("eha-rig ")
    modules = {module.name for module in pkgutil.iter_modules(commands.__path__)}
    assert {find_work(name).__module__.rpartition(".")[2] for name in COMMANDS} == modules
    assert list(COMMANDS) == sorted(COMMANDS)


def test_help_imports_no_heavy_package() -> None:
    """Help is quick because neither the plant nor any library is imported for it."""
    source = ("import contextlib, sys; from rig.cli.main import run_command_line\n"
              "for words in ([], *([name] for name in sys.argv[1:])):\n"
              "    with contextlib.suppress(SystemExit): run_command_line([*words, '--help'])\n"
              "    print('', *{name.partition('.')[0] for name in sys.modules}, sep='\\0')")
    done = subprocess.run([sys.executable, "-c", source, *COMMANDS], capture_output=True, text=True, check=True)
    *pages, last = re.split(r"\0.*\n", done.stdout)
    assert (len(pages), last, done.stderr) == (1 + len(COMMANDS), "", "")
    for number, page in enumerate(pages):
        assert len(page.splitlines()) > 4
        assert not number or {"--json", "--out", "--quiet"} <= set(page.replace(",", " ").split())
    packages = set(done.stdout.splitlines()[-1].split("\0"))
    assert "rig" in packages
    assert packages.isdisjoint({"numpy", "numba", "scipy", "matplotlib", "can", "canopen", "mcap", "rich", "google"})


def test_results_stay_where_no_run_comes_about(short: Path, tmp_path: Path) -> None:
    """Neither a bus without its nodes nor a repeat into its own folder costs the results that lie there."""
    folder = tmp_path / "done"
    assert rig("run", short, "--out", folder, "--quiet").status == 0
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    alone = ("--bus", "udp_multicast:239.74.9.9", "--plant", "external")
    assert "--seed: expected a whole number from 0 to 9223372036854775807, not '9999" in refuse(
        "run", short, "--seed", "9" * 20)
    assert "node 3 plant does not answer" in refuse("run", short, "--out", folder, *alone)
    assert "overwritten" in refuse("run", "--from", folder / "trace.mcap", "--out", folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_brackets_in_names_are_brackets(tmp_path: Path) -> None:
    """rich would take them for mark-up, and end a run that passed with a traceback."""
    text = SHORT.replace("A short one", "[red]A[/] short one").replace('"overshoot",', '"[/b] overshoot",', 1)
    sequence = write_file(tmp_path / "odd.toml", text.replace('"rest"', '"[rest"'))
    result = rig("run", sequence, "--out", tmp_path / "[out]")
    assert result.status == 0 and "[red]A[/] short one" in result.out and "[/b] overshoot" in result.out, result


def test_a_run_for_people(short: Path, tmp_path: Path) -> None:
    result = rig("run", short, "--out", tmp_path / "out")
    assert result.status == 0 and "PASS" in result.out and "overshoot" in result.out and "times real time" in result.out
    assert rig("run", short, "--out", tmp_path / "out", "--quiet") == CommandResult(0, "", "", ())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["report.html", "trace.mcap", "verdict.json"]


def test_timing_that_is_invalid(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bench that was late itself says so, exit status 3, whatever the checks say."""
    tick, calls = Master.tick, iter(range(10**6))
    monkeypatch.setattr(Master, "tick", lambda self: (time.sleep(0.004 * (next(calls) % 20 == 0)), tick(self)))
    outcome = answer("run", short, "--pace", "realtime", "--out", tmp_path / "out", status=3)
    assert outcome["verdict"] == "INVALID_TIMING" and outcome["timing"]["overruns"] > 10


@pytest.mark.parametrize("bug", [ZeroDivisionError, BlockingIOError])  # the latter is no other run in the folder
def test_a_bug_is_neither_a_verdict_nor_bad_input(bug: type[Exception], short: Path, monkeypatch: pytest.MonkeyPatch,
                                                  tmp_path: Path) -> None:
    monkeypatch.setattr("rig.run.runner.judge_run", Mock(side_effect=bug))
    result = rig("run", short, "--out", tmp_path / "out", "--json")
    assert result.status == 70 and bug.__name__ in result.err and result.out == ""
    assert Trace.read(tmp_path / "out").xj.size == 350  # the log is closed


def test_ctrl_c_runs_clean_up_and_closes_the_log_in_a_folder_that_no_other_run_got(short: Path, tmp_path: Path) -> None:
    process = started("run", write_file(tmp_path / "long.toml", LONG), "--pace", "realtime", "--out", tmp_path / "out",
                      "--json")
    assert grown(tmp_path / "out" / "trace.mcap", 60_000, process)
    assert "no other run" in refuse("run", short, "--out", tmp_path / "out")
    result = interrupted(process)
    assert result.status == 130 and result.json["verdict"] == "ABORTED" and result.err == ""
    trace = Trace.read(tmp_path / "out", all=True)
    assert (trace.phase == CLEANUP).sum() == 50 and trace.events[-1].text == "end"


def test_a_second_ctrl_c_ends_it_and_the_log_is_closed_all_the_same(tmp_path: Path) -> None:
    text = LONG.replace('kind = "ramp", to = 0.0, time = 0.05', 'kind = "hold", time = 60')
    log = tmp_path / "out" / "trace.mcap"
    process = started("run", write_file(tmp_path / "long.toml", text), "--pace", "realtime", "--out", tmp_path / "out")
    assert grown(log, 60_000, process)
    process.send_signal(signal.SIGTERM)
    assert grown(log, log.stat().st_size + 30_000, process)  # the run goes on, in its clean-up
    result = interrupted(process)
    assert result.status == 130 and result.err.splitlines()[-1] == "rig run: interrupted"
    assert "Traceback" not in result.err
    assert Trace.read(tmp_path / "out", all=True).events[-1].text == "end"


@pytest.mark.parametrize(("number", "prepare", "error"), [
    ("SIGINT", "repeat_lost_interrupts()", "KeyboardInterrupt"),
    ("SIGTERM", "signal.signal(signal.SIGTERM, exit_on_signal)", "SystemExit")])
def test_a_signal_is_not_lost_where_python_ignores_exceptions(number: str, prepare: str, error: str) -> None:
    """As in the locks of imports, in which a command spends much of its first second. Nothing is said of it."""
    program = f"""if True:
        import os, signal, time
        from rig.interrupts import exit_on_signal, repeat_lost_interrupts
        class Lock:
            def __del__(self):
                os.kill(os.getpid(), signal.{number})
        {prepare}
        try:
            Lock()
            time.sleep(600.0)
        except {error}:
            print("heard")"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300.0, check=False)
    assert (done.stdout, done.stderr) == ("heard\n", "")


def test_runs_without_a_folder_get_new_ones(short: Path, here: Path) -> None:
    traces = [rig("run", short, "--json").json["trace"] for _ in range(2)]
    assert traces == ["runs/short/trace.mcap", "runs/short-2/trace.mcap"]


@pytest.mark.parametrize("how", [1, 2, "reader gone"])
def test_output_that_nobody_reads_changes_no_verdict(how: int | str, short: Path, tmp_path: Path) -> None:
    words = ["run", short, "--out", tmp_path / "out"]
    if isinstance(how, int):
        process = started(*words, stdout=None, preexec_fn=lambda: os.close(how))
    else:
        process = started(*words)
        process.stdout.close()
        process.stdout = None
    result = finished(process)
    assert (result.status, result.err) == (0, "") and (tmp_path / "out" / "verdict.json").exists()


@pytest.mark.parametrize("name", ["PYTHONIOENCODING", "COLUMNS"])
def test_an_odd_terminal_and_odd_names_end_no_command(name: str, here: Path) -> None:
    write_file(here / "ü.csv", "t,com\n0,0\n0.001,0\n0.002,0\n")
    result = finished(started("simulate", "--command", "ü.csv", "--out", "ä.csv", env={
        **os.environ, name: {"COLUMNS": "0"}.get(name, "ascii")}))
    assert (result.status, result.err, "csv" in result.out) == (0, "", True)
    assert "names of files in UTF-8" in refuse("simulate", "--command", "\udcfc.csv") and (
        "accepts (File name too long)" in refuse("fdi", "x" * 300))


@pytest.mark.parametrize(("words", "text"), [
    ("effects --json", '"spool_friction"'), ("effects null_bias --json", '"null_bias.current": 3e-05'),
    ("effects null_bias --model ema --json", '"starts": []')])  # of the size of a servovalve's; others are looked for
def test_the_installed_command_is_this_one(words: str, text: str) -> None:
    done = subprocess.run([Path(sys.executable).parent / "rig", *words.split()], capture_output=True, text=True)
    assert done.returncode == 0 and text in done.stdout


@pytest.mark.parametrize(("words", "is_loaded"), [(["list"], False), (["import"], True)])
def test_only_import_loads_the_reader_of_mf4_files(words: list[str], is_loaded: bool) -> None:
    """python-can would load it, and pandas with it, at every start."""
    pytest.importorskip("asammdf")
    program = ("import sys; from rig.cli.main import leave_out_reader; leave_out_reader(sys.argv[1:]); "
               "import can; print('pandas' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(is_loaded)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_a_table_without_cut_words(kind: str) -> None:
    rows = rig("list", kind, "--json").json[kind]
    result = rig("list", kind)
    assert result.status == 0 and "…" not in result.out
    assert rows and {row["name"] for row in rows} <= {*result.out.split()}


def test_the_parameters_are_those_that_set_takes() -> None:
    rows = {row["name"]: row for row in rig("list", "parameters", "--json").json["parameters"]}
    assert rows.keys() >= Model().values.keys()
    assert rows.keys() >= {name for e in CATALOGUE.values() if e.port and e.file is None for name in e.parameters
                           if name.partition(".")[0] == "null_bias"}
    assert rows["filter.clogging"] == {"name": "filter.clogging", "unit": "1", "default": 0.0, "range": ">= 0, < 1"}
    assert rows["filter.law"]["default"] == "sqrt" and "linear" in rows["filter.law"]["range"]
    for name, row in rows.items():
        if isinstance(row["default"], float):
            load_model().replace({name: row["default"]})  # a default is a value that --set takes
    defaults = {row["name"]: row["default"] for row in
                rig("list", "parameters", "jack", "--set", "jack.mass=150", "--json").json["parameters"]}
    assert all("jack" in name for name in defaults) and defaults["jack.mass"] == 150.0


def test_sequences_checks_and_models_can_be_used() -> None:
    assert [row["name"] for row in rig("list", "checks", "--json").json["checks"]] == list(checks.KINDS)
    sequences, models = (rig("list", kind, "--json").json[kind] for kind in ("sequences", "models"))
    assert all(load_sequence(row["name"]).title == row["title"] for row in sequences)
    assert all(load_model(row["name"]).plant == row["plant"] for row in models)


def test_a_name_that_a_list_lacks() -> None:
    nothing = rig("list", "signals", "nonsense")
    assert (nothing.status, nothing.out.split(".")[0]) == (0, "no signals of that name")


def test_the_first_steps_are_commands_that_exist() -> None:
    commands = re.findall(r"^    rig (\w+)", FIRST_STEPS, re.MULTILINE)
    result = rig()
    assert (result.status, result.out, result.err.count("\n")) == (2, FIRST_STEPS + "\n", 1)
    assert len(commands) >= 5 and set(commands) <= set(COMMANDS)


@pytest.mark.skipif(importlib.util.find_spec("argcomplete") is None, reason="no argcomplete (extra shell)")
@pytest.mark.parametrize(("line", "completions"), [
    ("rig con", {"conformance"}), ("rig run --set filter.c", {"filter.clogging="}),
    ("rig compare --rep", {"--repeat", "--report"}), ("rig effects null_b", {"null_bias"}),
    ("rig run --model ", {"eha", "ehs", "ema", "servo", "emps", "own.py", "own.toml", "ownfolder/"}),
    ("rig check pre", {"preflight", "preflight_ema"}), ("rig check own", {"own.toml", "ownfolder/"})])
def test_the_answer_to_the_shell(line: str, completions: set[str], tmp_path: Path) -> None:
    (tmp_path / "ownfolder").mkdir()
    for name in ("own.toml", "own.py", "own.txt"):
        (tmp_path / name).touch()
    answer = tmp_path / "answer"
    environment = {**os.environ, "_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)),
                   "_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
                   "_ARGCOMPLETE_IFS": "\n", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-m", "rig.cli.main"], env=environment, cwd=tmp_path, check=False,
                   capture_output=True, timeout=60)
    assert {word.strip() for word in answer.read_text().split("\n")} == completions


@pytest.fixture(scope="module")
def findings() -> list[doctor.Finding]:
    return doctor.examine_machine()


def test_each_finding_is_there_once_and_says_what_it_is_for_and_how_to_get_it(findings: list[doctor.Finding]) -> None:
    for finding in findings:
        assert finding.area and finding.name and finding.found and finding.purpose, finding
        assert bool(finding.remedy) == (finding.status != "ok"), finding
    names = {finding.name for finding in findings}
    assert len(names) == len(findings) and names >= {
        "Python", "packages", "CAN in the kernel", "CAN interface", "CAN guest", "rerun", "Vulkan", "C compiler",
        "compiled code", "disk", "kernel", "priority", "memory lock", "clock"}


def test_a_missing_package_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(doctor, "read_requirements", lambda: {"": ["numpy", "no-such-distribution"]})
    result = rig("doctor")
    assert result.status == 1 and "missing: no-such-distribution" in result.out
    assert result.out.splitlines()[0] == "FAIL  The bench cannot run without: packages."


def test_tools_that_are_not_there_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_SEARCH_PATH", "/nowhere")
    findings = {finding.name: finding for finding in [*doctor.examine_tools(), *doctor.examine_buses()]}
    assert findings["C compiler"].status == "missing" and "gcc" in findings["C compiler"].remedy
    assert findings["CAN guest"].remedy == "apt-get install user-mode-linux kmod iproute2"


def test_json_is_one_object_and_nothing_else(tmp_path: Path) -> None:
    report = answer("doctor", "--out", tmp_path / "doctor.json")
    assert report == json.loads((tmp_path / "doctor.json").read_text()) and report["verdict"] == "PASS"
    assert rig("doctor", "--quiet") == CommandResult(0, "", "", ())
