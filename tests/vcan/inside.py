"""What runs where a vcan0 is: the bus tests, and short runs: by three processes with candump listening, and of the ECU
in examples/, which has frames with 29-bit identifiers and no CANopen.

    python tests/vcan/inside.py OUT compile|bus|three|ecu ...

Leaves in OUT: bus.xml (junit) from `bus`; run/, run.json, candump.log and one .log per process from `three`; ecu/ and
ecu.json from `ecu`. `compile` fills the cache of compiled code.
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
NOT_JUDGED = ("ABORTED", "INVALID_TIMING")
RIG = Path(sys.executable).with_name("rig")


def compile_all(out: Path) -> int:
    """Compile what the other parts use: cycles, plant, functions of the raw bus, C programs. Always 0."""
    import numpy as np
    from example_devices import ECU

    from plant import Model, compile_function, simulate
    from rig.firmware.build import build_controller, build_device
    from rig.network import raw_bus
    from rig.nodes import CompiledPlant
    from rig.nodes.emulator import load_service
    from rig.nodes.emulator_service import compile_loop
    from rig.run import compile_cycle
    from rig.run.loop import load_parts

    build_controller()
    build_device(ECU)
    port = raw_bus.make_closed_port()
    compile_function(raw_bus.receive_frame)(port, 0)
    compile_function(raw_bus.await_frame)(port)
    compile_function(raw_bus.send_frame)(port, 0x80, 0, 0)
    compile_function(raw_bus.send_payload)(port, 0x80, 0)
    compile_cycle()
    compile_loop()
    load_parts()
    load_service()
    CompiledPlant(Model())
    simulate(Model(), np.zeros(2))
    return 0


def bus_tests(out: Path) -> int:
    """Every test that runs on each bus, on socketcan; pytest's exit status."""
    files = sorted(str(path) for path in TESTS.rglob("test_*.py")
                   if "bus_kind" in path.read_text())
    words = ["-m", "pytest", *files, "-k", "socketcan", f"--junitxml={out / 'bus.xml'}", "-p", "no:cacheprovider"]
    return subprocess.run([sys.executable, *words, f"--basetemp={out / 'tmp'}"], cwd=TESTS.parent).returncode


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
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def play(out: Path, name: str, *words: str | Path) -> int:
    """The short sequence on vcan0, in this process; its results in folder `name`, its answer in `name`.json."""
    from rig_command import SHORT, SLOW_START, rig

    (out / "short.toml").write_text(SHORT + SLOW_START)
    shutil.rmtree(out / name, ignore_errors=True)
    result = rig("run", out / "short.toml", "--bus", BUS, "--json", "--out", out / name, *words)
    (out / f"{name}.json").write_text(result.out)
    (out / f"{name}.log").write_text(result.err)
    return result.status


def three(out: Path) -> int:
    """The run by three processes; the last one's exit status.

    A run that the bench itself could not judge, because the machine stood still or a program got no turn, is played
    again, twice at most.
    """
    for attempt in range(1, 4):
        status = play_by_three(out)
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


def play_by_three(out: Path) -> int:
    """Plant and C firmware as processes of their own, the sequencer in this one; the run's exit status."""
    from bus_stations import wait_for_node

    from rig.firmware.build import build_controller
    from rig.network import PLANT

    with contextlib.ExitStack() as stack:
        stack.enter_context(background(out, "candump", "candump", "-L", "-r", "16777216", "vcan0"))
        time.sleep(0.5)  # candump says nothing when it is ready
        commands = {"plant": [RIG, "node", "plant", "--bus", BUS], "controller": [build_controller(), BUS]}
        nodes = {name: stack.enter_context(background(out, name, *words)) for name, words in commands.items()}
        wait_for_node(BUS, PLANT)  # on a slow machine a node needs ten seconds to load
        status = play(out, "run", "--controller", "external", "--plant", "external", "--pace", "lockstep")
        alive = {name: process.poll() for name, process in nodes.items()}
        time.sleep(0.5)  # the last frames still go to candump
    exit_codes = {name: process.returncode for name, process in nodes.items()}
    facts = {"status": status, "before_interrupt": alive, "after_interrupt": exit_codes}
    (out / "facts.json").write_text(json.dumps(facts))
    return status


def ecu(out: Path) -> int:
    """A short run of the ECU, whose preflight passes on UDP; its exit status."""
    from example_devices import ECU, PATIENT, run_device

    with run_device(ECU, BUS, *PATIENT[ECU]):
        return play(out, "ecu", "--bench", ECU / "bench.toml")


def main() -> int:
    """Run the parts asked for, all of them even if one fails; the largest status, 0 if none failed."""
    out = Path(sys.argv[1]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    os.chdir(TESTS.parent)
    parts = {"compile": compile_all, "bus": bus_tests, "three": three, "ecu": ecu}
    return max((parts[name](out) for name in sys.argv[2:]), default=0)


if __name__ == "__main__":
    sys.exit(main())
