"""The command as scripts and people see it: help, one-line errors, exit statuses, JSON, signals, closed pipes."""
from __future__ import annotations

import os
import pkgutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rig_command import finished, grown, rig, started
from short_sequences import SHORT

from fdi.trace.trace import CLEANUP, Trace
from plant.effects import CATALOGUE
from rig.cli import commands
from rig.cli.command_list import COMMANDS, find_work

LONG = SHORT.replace('"rest", kind = "hold", time = 0.05', '"rest", kind = "hold", time = 60')
RUN_KEYS = {"verdict", "trace", "checks", "timing", "fdi"}
TIMING_KEYS = {"cycles", "overruns", "lateness_us", "response_us", "scheduler"}


@pytest.fixture
def short(tmp_path: Path) -> Path:
    return written(tmp_path / "short.toml", SHORT)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(command: str) -> None:
    said = rig(*[command] if command else [], "--help")
    assert said.status == 0 and said.err == "" and len(said.out.splitlines()) > 4
    assert not command or {"--json", "--out", "--quiet"} <= set(said.out.replace(",", " ").split())


def test_the_command_list_agrees_with_the_modules() -> None:
    modules = {module.name for module in pkgutil.iter_modules(commands.__path__)}
    assert {find_work(name).__module__.rpartition(".")[2] for name in COMMANDS} == modules
    assert list(COMMANDS) == sorted(COMMANDS)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_imports_no_heavy_package(command: str) -> None:
    """Help is quick because neither the plant nor any library is imported for it."""
    source = ("import sys; from rig.cli.main import run_command_line\n"
              "try: run_command_line(sys.argv[1:])\n"
              "finally: print(*{name.partition('.')[0] for name in sys.modules})")
    done = subprocess.run([sys.executable, "-c", source, *([command] if command else []), "--help"],
                          capture_output=True, text=True)
    packages = set(done.stdout.splitlines()[-1].split())
    assert "rig" in packages and done.returncode == 0
    assert packages.isdisjoint({"numpy", "numba", "scipy", "matplotlib", "can", "canopen", "mcap", "rich", "google"})


def test_version() -> None:
    assert rig("--version").out.startswith("eha-rig ")


SLIP = """from typing import Annotated, NamedTuple
from plant.effects import effect
from plant.quantity import Quantity
class Slip(NamedTuple):
    size: Annotated[float, Quantity("N")] = 0.0
@effect("load", Slip, law="")
def slip(x, s, u, p):
    return x + p.slip.size * s.jack_velocity
"""
FILES = {
    "slip.py": SLIP,
    "notes.toml": "to be done", "empty.py": "", "raises.py": "1 / 0", "nocom.csv": "t,x\n0,1\n",
    "wrong.toml": 'title = "x"\nmain = [\n  { kind = "hold", tme = 1.0 },\n]\n',
    "type.toml": 'title = "x"\nmain = [{ kind = "hold", time = "long" }]\n',
    "nan.csv": "t,com\n0,1\n0.001,nan\n", "trace.csv": "t,com,xj,cor\n0,0,0,0\n0.001,0,0,0\n",
}
BAD = {
    "unknown command": (["fly"], "'fly'"),
    "unknown option": (["run", "--fast"], "rig run: unrecognized arguments: --fast (rig run --help)"),
    "unknown sequence": (["run", "prefligth"], "'preflight'"),
    "no such file": (["run", "none.toml"], "none.toml"),
    "sequence is a folder": (["run", "folder.toml"], "folder.toml"),
    "not text": (["run", "binary.toml"], "UTF-8"),
    "not TOML": (["run", "notes.toml"], "notes.toml:1"),
    "wrong key": (["run", "wrong.toml"], "wrong.toml:3: main[0].tme"),
    "wrong type": (["run", "type.toml"], "type.toml:2: main[0].time: expected a number in s, not 'long'"),
    "misspelt --set": (["run", "--set", "spool.static_fricton=1"], "did you mean static_friction"),
    "unknown group": (["run", "--set", "spol.static_friction=1"], "did you mean spool"),
    "--set without value": (["run", "--set", "spool.static_friction"], "GROUP.FIELD=VALUE"),
    "--set no number": (["run", "--set", "spool.static_friction=many"], "'many'"),
    "impossible value": (["run", "--set", "spool.mass=-1"], "spool.mass: expected a number"),
    "not finite": (["run", "--set", "spool.mass=nan"], "spool.mass"),
    "another cycle": (["run", "--set", "controller.period=0.002"], "controller.period"),
    "bad bus": (["run", "--bus", "token-ring"], "socketcan:INTERFACE"),
    "bad group": (["run", "--bus", "udp_multicast:10.0.0.1"], "IPv4 multicast group"),
    "CAN that is not there": (["run", "--bus", "socketcan:nocan7"], "nocan7"),
    "nobody outside": (["run", "--controller", "external"], "external node"),
    "gains of foreign firmware": (["run", "--controller", "external", "--bus", "udp_multicast:239.0.0.9", "--set",
                                   "controller.proportional_gain=1"], "controller.proportional_gain"),
    "bad pace": (["run", "--pace", "warp"], "'warp'"),
    "bad seed": (["run", "--seed", "-1"], "whole number from 0"),
    "seed no number": (["run", "--seed", "x"], "argument --seed: expected a whole number from 0, not 'x'"),
    "impossible overruns": (["run", "--max-overruns", "2"], "fraction from 0 to 1"),
    "no such model": (["run", "--model", "none.toml"], "none.toml"),
    "no such effects": (["run", "--effects", "none.py"], "none.py"),
    "effects without effect": (["run", "--effects", "empty.py"], "@effect"),
    "effects that raise": (["run", "--effects", "raises.py"], "ZeroDivisionError"),
    "out is a file": (["run", "--out", "notes.toml"], "a folder that can be written"),
    "out below a file": (["run", "--out", "notes.toml/x"], "a folder that can be written"),
    "repeat nothing": (["run", "--from", "none.mcap"], "none.mcap"),
    "repeat no log": (["run", "--from", "binary.toml"], "binary.toml"),
    "repeat and change": (["run", "--from", "none.mcap", "--seed", "3"], "the log has them"),
    "repeat a CSV": (["run", "--from", "trace.csv"], "only logs of `rig run`"),
    "no such command file": (["simulate", "--command", "none.csv"], "none.csv"),
    "command without com": (["simulate", "--command", "nocom.csv"], "t and com"),
    "command no number": (["simulate", "--command", "nan.csv"], "line 3, com"),
    "simulate to somewhere": (["simulate", "--out", "x.xlsx"], ".mcap"),
    "simulate to nowhere": (["simulate", "--out", "none/x.csv"], "none/x.csv"),
    "no steps": (["simulate", "--steps", "0"], "at least 1"),
    "a law with a slip": (["simulate", "--effects", "slip.py", "--set", "slip.size=1"], "slip.py:8: slip: "),
    "unknown effect": (["effects", "gremlins"], "gremlins"),
    "misspelt effect": (["effects", "spol_friction"], "did you mean spool_friction?"),
    "misspelt fault": (["campaign", "--fault", "filter_cloging=0.1"], "did you mean filter_clogging?"),
    "no such folder": (["fdi", "none/"], "none: expected a readable file or the folder of a run; it does not exist"),
    "folder without a log": (["fdi", "folder.toml"], "folder.toml: expected the folder of a run; it has no trace.mcap"),
    "effects to nowhere": (["effects", "--out", "none/x.json"], "none/x.json"),
    "doctor to nowhere": (["doctor", "--seconds", "0", "--out", "none/x.json"], "none/x.json"),
    "no such node": (["node", "pilot"], "'pilot'"),
    "node with a slip": (["node", "plant", "--bus", "udp_multicast", "--set", "spool.mass=-1"], "spool.mass"),
    "node in itself": (["node", "plant", "--bus", "virtual"], "a bus between programs"),
    "nothing to recover": (["recover", "none.mcap"], "none.mcap"),
    "nothing to report": (["report", "none.mcap"], "none.mcap"),
    "nothing to view": (["view", "none.mcap"], "none.mcap"),
    "nothing to export": (["export", "none.mcap", "--out", "x.csv"], "none.mcap"),
    "no frames to decode": (["import", "trace.csv", "--dbc", "x.dbc"], "a CSV of signals has no frames"),
    "nothing to import": (["import", "none.blf", "--out", "x.mcap"], "none.blf"),
}


def test_results_stay_where_no_run_comes_about(short: Path, tmp_path: Path) -> None:
    """Neither a bus without its nodes nor a repeat into its own folder costs the results that lie there."""
    folder = tmp_path / "done"
    assert rig("run", short, "--out", folder, "--quiet").status == 0
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    nobody = rig("run", short, "--out", folder, "--bus", "udp_multicast:239.74.9.9", "--plant", "external")
    itself = rig("run", "--from", folder / "trace.mcap", "--out", folder)
    assert (nobody.status, itself.status) == (2, 2) and "overwritten" in itself.err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_told_in_one_line(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit status 2, nothing on standard output, one line that names what is wrong."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    for name, text in FILES.items():
        written(tmp_path / name, text)
    words, hint = BAD[what]
    said = rig(*words)
    CATALOGUE.pop("slip", None)
    assert (said.status, said.out) == (2, ""), said
    assert len(said.err.splitlines()) == 1 and said.err.startswith("rig") and hint in said.err, said.err
    assert "Traceback" not in said.err


def test_a_run_that_passes(short: Path, tmp_path: Path) -> None:
    said = rig("run", short, "--out", tmp_path / "out", "--json")
    assert said.status == 0 and said.json["verdict"] == "PASS" and said.err == ""
    assert said.json.keys() >= RUN_KEYS and said.json["timing"].keys() >= TIMING_KEYS
    assert said.json["timing"]["cycles"] == 450
    assert said.json["timing"]["response_us"].keys() == {"p50", "p99", "p99_9", "max"}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["report.html", "trace.mcap", "verdict.json"]


def test_a_run_that_fails(short: Path, tmp_path: Path) -> None:
    said = rig("run", short, "--out", tmp_path / "out", "--set", "filter.clogging=0.9", "--json")
    assert said.status == 1 and said.json["verdict"] == "FAIL"
    assert [check["name"] for check in said.json["checks"] if not check["passed"]] == ["overshoot"]


def test_brackets_in_names_are_brackets(tmp_path: Path) -> None:
    """rich would take them for mark-up, and end a run that passed with a traceback."""
    text = SHORT.replace("A short one", "[red]A[/] short one").replace('"overshoot",', '"[/b] overshoot",', 1)
    said = rig("run", written(tmp_path / "odd.toml", text.replace('"rest"', '"[rest"')), "--out", tmp_path / "[out]")
    assert said.status == 0 and "[red]A[/] short one" in said.out and "[/b] overshoot" in said.out, said


def test_a_run_for_people(short: Path, tmp_path: Path) -> None:
    said = rig("run", short, "--out", tmp_path / "out")
    assert said.status == 0 and "PASS" in said.out and "overshoot" in said.out and "times real time" in said.out
    quiet = rig("run", short, "--out", tmp_path / "out", "--quiet")
    assert quiet == (0, "", "")


def test_timing_that_is_invalid(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bench that was late itself says so, exit status 3, whatever the checks say."""
    from rig.network.master import Master

    tick = Master.tick
    calls = iter(range(10**6))
    monkeypatch.setattr(Master, "tick", lambda self: (time.sleep(0.004 * (next(calls) % 20 == 0)), tick(self)))
    said = rig("run", short, "--pace", "realtime", "--out", tmp_path / "out", "--json")
    assert said.status == 3 and said.json["verdict"] == "INVALID_TIMING" and said.json["timing"]["overruns"] > 10


def test_a_bug_is_neither_a_verdict_nor_bad_input(short: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("rig.run.runner.judge_run", lambda *_: 1 / 0)
    said = rig("run", short, "--out", tmp_path / "out", "--json")
    assert said.status == 70 and "ZeroDivisionError" in said.err and said.out == ""
    assert Trace.read(tmp_path / "out").xj.size == 350  # the log is closed


def test_ctrl_c_runs_clean_up_and_closes_the_log(tmp_path: Path) -> None:
    long = written(tmp_path / "long.toml", LONG)
    process = started("run", long, "--pace", "realtime", "--out", tmp_path / "out", "--json")
    grown(tmp_path / "out" / "trace.mcap", 60_000)
    process.send_signal(signal.SIGINT)
    said = finished(process)
    assert said.status == 130 and said.json["verdict"] == "ABORTED" and said.err == ""
    trace = Trace.read(tmp_path / "out", all=True)
    assert (trace.phase == CLEANUP).sum() == 50 and trace.events[-1].text == "end"


def test_a_second_ctrl_c_ends_it_and_the_log_is_closed_all_the_same(tmp_path: Path) -> None:
    text = LONG.replace('kind = "ramp", to = 0.0, time = 0.05', 'kind = "hold", time = 60')
    log = tmp_path / "out" / "trace.mcap"
    process = started("run", written(tmp_path / "long.toml", text), "--pace", "realtime", "--out", tmp_path / "out")
    grown(log, 60_000)
    process.send_signal(signal.SIGTERM)
    grown(log, log.stat().st_size + 30_000)  # the run goes on, in its clean-up
    process.send_signal(signal.SIGINT)
    said = finished(process)
    assert said.status == 130 and said.err.splitlines()[-1] == "rig run: interrupted" and "Traceback" not in said.err
    assert Trace.read(tmp_path / "out", all=True).events[-1].text == "end"


def test_two_runs_do_not_share_a_folder(short: Path, tmp_path: Path) -> None:
    long = written(tmp_path / "long.toml", LONG)
    process = started("run", long, "--pace", "realtime", "--out", tmp_path / "out", "--quiet")
    grown(tmp_path / "out" / "trace.mcap", 60_000)
    said = rig("run", short, "--out", tmp_path / "out")
    process.send_signal(signal.SIGINT)
    assert finished(process).status == 130
    assert said.status == 2 and "no other run" in said.err
    assert Trace.read(tmp_path / "out", all=True).xj.size > 0  # on a busy machine it may still be in its set-up


def test_runs_without_a_folder_get_new_ones(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    traces = [rig("run", short, "--json").json["trace"] for _ in range(2)]
    assert traces == ["runs/short/trace.mcap", "runs/short-2/trace.mcap"]


@pytest.mark.parametrize("how", ["closed", "reader gone"])
def test_output_that_nobody_reads_changes_no_verdict(how: str, short: Path, tmp_path: Path) -> None:
    words = ["run", short, "--out", tmp_path / "out"]
    if how == "closed":
        process = started(*words, stdout=None, preexec_fn=lambda: os.close(1))
    else:
        process = started(*words)
        assert process.stdout is not None
        process.stdout.close()
        process.stdout = None
    said = finished(process)
    assert (said.status, said.err) == (0, "") and (tmp_path / "out" / "verdict.json").exists()


def test_the_installed_command_is_this_one() -> None:
    done = subprocess.run([Path(sys.executable).parent / "rig", "effects", "--json"], capture_output=True, text=True)
    assert done.returncode == 0 and '"spool_friction"' in done.stdout
