"""What runs where a vcan0 is: the bus tests, one whole preflight run by three processes with candump listening, and
a short run of each controller in examples/.

    python tests/vcan/inside.py OUT compile|bus|preflight|examples ...

Leaves in OUT: bus.xml (junit) from `bus`; run/, run.json, candump.log and one .log per process from `preflight`; NAME/
and NAME.json of each of `examples`. `compile` fills the cache of compiled code.
It is meant for the host, which does it ten times as fast as its guest: both have the same files and the same CPU.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parent.parent
sys.path.append(str(TESTS / "support"))
BUS = "socketcan:vcan0"
RUN_LIMIT_S = 500
NOT_JUDGED = ("ABORTED", "INVALID_TIMING")
RIG = Path(sys.executable).with_name("rig")


def compile_all(out: Path) -> int:
    """Compile what the other parts use: cycles, plant, functions of the raw bus, C programs. Always 0."""
    from c_device import build_faulty
    from example_devices import DRIVE, ECU

    from plant import Actuator, Model
    from plant.compile import compile_function
    from rig.firmware.build import build_controller, build_device
    from rig.network import raw_bus
    from rig.nodes.emulator_service import compile_loop, compile_plant
    from rig.run.hard_loop import compile_cycle

    build_controller()
    build_faulty()
    for folder in (DRIVE, ECU):
        build_device(folder)
    port = raw_bus.make_closed_port()
    compile_function(raw_bus.receive_frame)(port, 0)
    compile_function(raw_bus.await_frame)(port)
    compile_function(raw_bus.send_frame)(port, 0x80, 0, 0)
    compile_cycle()
    compile_loop()
    compile_plant(Model())
    Actuator(Model()).warm()
    return 0


def bus_tests(out: Path) -> int:
    """Every test that runs on each bus, on socketcan; pytest's exit status."""
    files = sorted(str(path) for path in TESTS.rglob("test_*.py")
                   if any(word in path.read_text() for word in ("bus_kind", "on_each_bus")))
    words = ["-m", "pytest", *files, "-k", "socketcan", f"--junitxml={out / 'bus.xml'}", "-p", "no:cacheprovider"]
    return subprocess.run([sys.executable, *words, f"--basetemp={out / 'tmp'}"], cwd=TESTS.parent).returncode


def finish(process: subprocess.Popen[bytes], seconds: float) -> int:
    """Wait for a process, kill it when the time is over; its status."""
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


@contextlib.contextmanager
def background(out: Path, name: str, *command: str | Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process beside the run, its output in NAME.log, interrupted (as by Ctrl-C) at the end."""
    with (out / f"{name}.log").open("wb") as log:
        errors = subprocess.STDOUT if name != "candump" else None  # candump's log must hold frames only
        process = subprocess.Popen([str(word) for word in command], stdout=log, stderr=errors, stdin=subprocess.DEVNULL)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            finish(process, 20)


def preflight(out: Path) -> int:
    """The preflight by three processes; the last run's exit status.

    A run that the bench itself could not judge, because the machine stood still or a program got no turn, is played
    again, twice at most; the test tells how often.
    """
    for attempt in range(1, 4):
        shutil.rmtree(out / "run", ignore_errors=True)
        status = play_preflight(out, attempt)
        facts = json.loads((out / "facts.json").read_text())
        is_a_node_gone = any(status is not None for status in facts["before_interrupt"].values())
        if is_a_node_gone or read_verdict(out) not in NOT_JUDGED:
            break
        print(f"attempt {attempt}: {(out / 'run.json').read_text()}", flush=True)
    return status


def read_verdict(out: Path) -> str:
    """The verdict of the run; empty where it answered nothing."""
    text = (out / "run.json").read_text()
    return str(json.loads(text)["verdict"]) if text else ""


def play_preflight(out: Path, attempt: int) -> int:
    """Plant, C firmware and sequencer as processes of their own; the run's exit status."""
    from standing_nodes import wait_for_node

    from rig.firmware.build import build_controller
    from rig.network.node_objects import PLANT

    with contextlib.ExitStack() as stack:
        stack.enter_context(background(out, "candump", "candump", "-L", "-r", "16777216", "vcan0"))
        time.sleep(0.5)  # candump says nothing when it is ready
        commands = {"plant": [RIG, "node", "plant", "--bus", BUS], "controller": [build_controller(), BUS]}
        nodes = {name: stack.enter_context(background(out, name, *words)) for name, words in commands.items()}
        wait_for_node(BUS, PLANT)  # on a slow machine a node needs ten seconds to load
        words = ["run", "preflight", "--bus", BUS, "--controller", "external", "--plant", "external"]
        words += ["--pace", "lockstep"]
        with (out / "run.json").open("wb") as answer, (out / "run.log").open("wb") as log:
            begin = time.monotonic()
            words += ["--json", "--out", str(out / "run")]
            run = subprocess.Popen([RIG, *words], stdout=answer, stderr=log, stdin=subprocess.DEVNULL)
            status = finish(run, RUN_LIMIT_S)
            seconds = time.monotonic() - begin
        alive = {name: process.poll() for name, process in nodes.items()}
        time.sleep(0.5)  # the last frames still go to candump
    ended = {name: process.returncode for name, process in nodes.items()}
    facts = {"attempt": attempt, "status": status, "seconds": seconds}
    facts |= {"before_interrupt": alive, "after_interrupt": ended}
    (out / "facts.json").write_text(json.dumps(facts))
    return status


def examples(out: Path) -> int:
    """A short run of each controller in examples/, whose preflight passes on UDP; the first status that is not 0."""
    from example_devices import DRIVE, ECU, PATIENT, run_device
    from rig_command import SHORT, SLOW_START

    (out / "short.toml").write_text(SHORT + SLOW_START)
    statuses = []
    for folder in (DRIVE, ECU):
        words = ["run", out / "short.toml", "--bench", folder / "bench.toml", "--bus", BUS, "--json"]
        words += ["--out", out / folder.name]
        with run_device(folder, BUS, *PATIENT[folder]), (out / f"{folder.name}.json").open("wb") as answer:
            statuses.append(subprocess.run([RIG, *words], stdout=answer, stdin=subprocess.DEVNULL).returncode)
    return next((status for status in statuses if status), 0)


def main() -> int:
    """Run the parts asked for, all of them even if one fails; the first status that is not 0."""
    out = Path(sys.argv[1]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    os.chdir(TESTS.parent)
    parts = {"compile": compile_all, "bus": bus_tests, "preflight": preflight, "examples": examples}
    statuses = [parts[name](out) for name in sys.argv[2:]]
    return next((status for status in statuses if status), 0)


if __name__ == "__main__":
    sys.exit(main())
