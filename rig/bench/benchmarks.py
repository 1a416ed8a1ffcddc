"""`rig bench`: the plant beside C, whole processes, and the cycle in real time beside cyclictest and C.

Rivals take turns in short rounds or blocks, so that a disturbance of the machine hits all of them.
"""

import contextlib
import ctypes
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import can
import numpy as np
from can.interfaces.udp_multicast.utils import pack_message

from fdi.progress import Progress, ignore_progress
from fdi.report import Cell, Column, Item, Line, Report, Section, Table, format_digits, tabulate
from fdi.trace import Floats
from plant import Actuator, Model, RigError, build_kernel, require, run_closed_loop, sample_noise, simulate
from rig.benches import Role, load_bench
from rig.firmware.build import build_device, build_program
from rig.interrupts import end_with
from rig.network import Link, LinkWire, Master, RawBus, WallClock, can_open, open_can
from rig.nodes import Scenario
from rig.recorder import CycleBlock, Recorder, Signals, Timing
from rig.run import (
    INTERRUPTED,
    LOOP_PRIORITY,
    CycleInput,
    History,
    Job,
    compile_cycle,
    compute_percentiles,
    enter_real_time,
    list_cpus,
    open_loop,
    raise_priority,
    run_job,
)
from rig.sequences import Plan, Schedule, load_sequence

Work = Callable[[], object]

FLAGS = ("-O3", "-march=native")
SAME_ROUNDING = (*FLAGS, "-ffp-contract=off")  # no fused multiply-add: the rounding of Python
GET_GCC = "apt-get install gcc"


def measure_durations(works: Mapping[str, Work], rounds: int) -> dict[str, Floats]:
    """Durations of each work, (rounds,) s, after one warm-up; the rounds alternate between them."""
    clock = WallClock()
    durations: dict[str, list[int]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            start = clock.now()
            work()
            if turn > 0:
                durations[name].append(clock.now() - start)
    return {name: np.array(times) * 1e-9 for name, times in durations.items()}


def measure_median_duration(work: Work, rounds: int) -> float:
    """The median duration of one work, s."""
    return float(np.median(measure_durations({"": work}, rounds)[""]))


def find_gcc() -> str:
    """The path of the C compiler; "" without one."""
    return shutil.which("gcc") or ""


def build_library(source: str, flags: tuple[str, ...], target: Path, package: str = "rig.bench") -> ctypes.CDLL:
    """A C file of a package as a library; gcc must be installed."""
    # without -std=c..., which would silently forbid the fused multiply-add
    object_file = target.with_suffix(".o")
    places = [f"-I{files('rig.bench')}", "-c", str(files(package) / source), "-o", str(object_file)]
    subprocess.run([find_gcc(), *flags, "-fPIC", *places], check=True)
    # a library that is linked with -ffast-math switches the small numbers next to zero off for the whole process
    harmless = [flag for flag in flags if flag != "-ffast-math"]
    subprocess.run([find_gcc(), *harmless, "-shared", str(object_file), "-o", str(target), "-lm"], check=True)
    return ctypes.CDLL(str(target))


Times = Mapping[str, Floats]  # by quantity, one value a cycle; NaN: no answer came


def measure_blocks(bus: str, seconds: float, blocks: int, contenders: Mapping[str, Callable[[float], Times]],
                   progress: Progress) -> tuple[dict[str, list[Times]], dict[str, Any]]:
    """The times of each contender in each block, `seconds` in all for each of them; and the conditions as JSON values.

    Raises:
        InputError: a bus that compiled code cannot use.
    """
    require(can_open(bus), "--bus", bus, "socketcan:INTERFACE or udp_multicast[:GROUP]")
    compile_cycle()
    names, times = list(contenders), {name: list[Times]() for name in contenders}
    for block in range(blocks):
        turn = block % len(names)  # nobody is always the first
        for number, name in enumerate(names[turn:] + names[:turn]):
            progress(f"block {block + 1} of {blocks}: {name}", (block + number / len(names)) / blocks)
            times[name].append(contenders[name](seconds / blocks))
    return times, {"bus": bus, "seconds": seconds, "blocks": blocks, "cpus": len(list_cpus()),
                   "priority": choose_priority()}


def choose_bus(bus: str, seconds: float, blocks: int, least_block: float = 0.5) -> str:
    """The bus of a benchmark in real time: `bus`, or for "auto" a UDP group of this process's own.

    Raises:
        InputError: a time for each block below `least_block` s.
    """
    require(seconds >= least_block * blocks, "--seconds", f"{seconds:g}", f"{least_block:g} s or more for each block")
    return f"udp_multicast:239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}" if bus == "auto" else bus


def choose_priority() -> int:
    """The loop's real-time priority, or 0 where the machine does not grant it."""
    with raise_priority():
        return LOOP_PRIORITY if os.sched_getscheduler(0) == os.SCHED_FIFO else 0


def pool_times(blocks: list[Times]) -> dict[str, Floats]:
    """The times of all blocks, by quantity."""
    return {quantity: np.concatenate([block[quantity] for block in blocks]) for quantity in blocks[0]}


def describe_conditions(figures: Mapping[str, Any]) -> Line:
    """How long was measured, where and with which priority."""
    priority = f"SCHED_FIFO {figures['priority']}" if figures["priority"] else "no real-time priority"
    return Line("measured", f"{figures['seconds']:g} s each in {figures['blocks']} alternating blocks on "
                            f"{figures['bus']}, 1 ms a cycle, {figures['cpus']} CPUs, {priority}")


Peer = subprocess.Popen[bytes]  # a node opposite the cycle


@contextlib.contextmanager
def run_c_responder(bus: str) -> Iterator[None]:
    """Run the responder in C on a bus while the context lasts, on the CPU and with the priority of the emulator."""
    frames = load_bench().frames
    responder = build_program("responder", [Path(__file__).with_name("responder.c")], ("-O2", "-Wall", "-Wextra"))
    with RawBus(bus, [frames.sync or 0]) as raw:
        receive, send, turn, place = raw.descriptors
        feedback, valve = (_pack(bus, frames.find_role(role).identifier) for role in ("feedback", "valve_state"))
        number = next(each for each in frames.find_role("valve_state").fields if each.name == "cycle")
        cycle_at = valve.index(_PAYLOAD) + number.lowest // 8
        cpu = list_cpus()[-min(2, len(list_cpus()))]
        numbers = (receive, send, turn, place, cpu, LOOP_PRIORITY, cycle_at)
        words = [str(responder), *map(str, numbers), feedback.hex(), valve.hex()]
        with _run_process(words, *(file for file in (receive, send, turn) if file >= 0)) as process:
            assert process.stdout is not None
            process.stdout.readline()
            yield


_PAYLOAD = bytes(range(0x11, 0x19))


def _pack(bus: str, cob_id: int) -> bytes:
    """A frame as it goes out on a bus, with `_PAYLOAD`."""
    if bus.startswith("udp_multicast"):
        return bytes(pack_message(can.Message(arbitration_id=cob_id, is_extended_id=False, data=_PAYLOAD)))
    return cob_id.to_bytes(4, sys.byteorder) + bytes([8, 0, 0, 0]) + _PAYLOAD  # struct can_frame


@contextlib.contextmanager
def _run_process(words: list[str], *descriptors: int) -> Iterator[Peer]:
    process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, pass_fds=descriptors,
                               preexec_fn=partial(end_with, os.getpid()))
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


CYCLICTEST, COMPILED, IN_C = "cyclictest", "compiled", "C"
MAPPED = {"CiA 402": "cia402_drive", "plain CAN": "can_ecu"}  # foreign controllers: folders of examples/
_QUANTITIES = ("lateness", "feedback_response", "valve_response", "execution")
_SETTLING = 100  # cycles at the beginning of a block that are not counted


def measure_realtime(bus: str, seconds: float, blocks: int, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Measure all contenders on a bus for `seconds` each, in so many blocks.

    Raises:
        InputError: a bus that compiled code cannot use.
        RigError: a bus or a node that does not work.
    """
    times, conditions = measure_blocks(bus, seconds, blocks, list_contenders(bus), progress)
    return summarise_contenders({name: pool_times(each) for name, each in times.items()}) | conditions | {
        "missing": [name for name, path in (("cyclictest", find_cyclictest()), ("gcc", find_gcc())) if not path]}


def list_contenders(bus: str) -> dict[str, Callable[[float], Times]]:
    """What is measured for so many seconds, by name; without those that this machine does not have."""
    def measure_cyclictest(seconds: float) -> Times:
        return {"lateness": run_cyclictest(seconds, choose_priority(), list_cpus()[-1])}

    def measure_cycle(seconds: float, run_peer: Callable[[], contextlib.AbstractContextManager[Peer | None]],
                      bench: Path | None = None) -> Times:
        with run_peer() as peer:
            return play_block(bus, seconds, peer, bench)

    def run_example(folder: Path) -> contextlib.AbstractContextManager[Peer]:
        return _run_process([str(build_device(folder)), bus])

    emulator = [sys.executable, "-m", "rig.cli.main", "node", "plant", "--quiet", "--bus", bus]
    examples = Path(__file__).parents[2] / "examples"  # of a checkout
    rows: list[tuple[str, object, Callable[[float], Times]]] = [
        (CYCLICTEST, find_cyclictest(), measure_cyclictest),
        (COMPILED, True, partial(measure_cycle, run_peer=partial(_run_process, emulator))),
        (IN_C, find_gcc(), partial(measure_cycle, run_peer=partial(run_c_responder, bus))),
        *((name, find_gcc() and (examples / folder).is_dir(), partial(
            measure_cycle, run_peer=partial(run_example, examples / folder), bench=examples / folder / "bench.toml"))
          for name, folder in MAPPED.items())]
    return {name: measure for name, is_there, measure in rows if is_there}


def play_block(bus: str, seconds: float, peer: Peer | None = None, bench: Path | None = None) -> Times:
    """Times of the rig's cycle of 1 ms on a bus, with its log, without the first cycles; NaN where no answer came.

    Args:
        bus: where the cycle and its peer are.
        seconds: how long.
        peer: the process of a node that is to boot and to be started; None: nothing to start.
        bench: the bench file of the peer, a foreign controller; None: the peer is the plant of the shipped bench.

    Raises:
        RigError: the peer does not boot.
    """
    is_foreign, peer_bench = bench is not None, replace(load_bench(str(bench or "eha")), cycle_ns=1_000_000)
    history = History()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        recorder = Recorder(Path(folder) / "trace.mcap", {}, {})
        stack.callback(recorder.close)
        clock = WallClock()
        wire = LinkWire(Link(open_can(bus), clock.now), clock)
        stack.callback(wire.close)
        master = Master(wire, clock.now, stamped=True, bench=peer_bench)
        if peer is not None and peer_bench.nodes:
            role = Role.CONTROLLER if is_foreign else Role.PLANT
            if not any(master.is_present(role, 1.0) for _ in range(120) if peer.poll() is None):
                raise RigError(f"{peer_bench.describe_node(role)} does not boot")
            master.start()
        master.hooks.on_frame = recorder.frame
        log = _Log(history, recorder)
        plan = Plan(stop=0)
        scenario, faults = Scenario(Model(), plan), Schedule(plan)
        loop = open_loop(master, peer_bench, scenario, faults, log, bus, True)
        stack.callback(loop.close)
        stack.enter_context(enter_real_time(1))
        for _ in range(round(seconds * 1000)):
            loop.cycle(CycleInput(1, 0.0, 0.0, 0))
        loop.finish()
    quantities = ("lateness", "execution") if is_foreign else _QUANTITIES  # its plant has no frames
    return {name: history.column(name)[_SETTLING:].copy() for name in quantities}


class _Log:
    """Keeps the cycles and records them, as a run does."""

    def __init__(self, history: History, recorder: Recorder) -> None:
        self._history, self._recorder = history, recorder

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        self._history.cycle(t_ns, signals, timing)
        self._recorder.cycle(t_ns, signals, timing)

    def cycles(self, block: CycleBlock) -> None:
        self._history.cycles(block)
        self._recorder.cycles(block)


def summarise_contenders(times: Mapping[str, Times]) -> dict[str, Any]:
    """Percentiles in us by quantity and contender, lost answers, and the targets."""
    tables: dict[str, dict[str, dict[str, float]]] = {
        quantity: {name: compute_percentiles(columns[quantity]) for name, columns in times.items()
                   if quantity in columns}
        for quantity in _QUANTITIES}
    lost_answers = {name: int(np.isnan(columns["feedback_response"]).sum()) for name, columns in times.items()
                    if "feedback_response" in columns}
    return {"times_us": tables, "lost": lost_answers,
            "cycles": {name: len(columns["lateness"]) for name, columns in times.items()},
            "targets": list_targets(tables)}


def list_targets(tables: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[dict[str, Any]]:
    """The ratios to cyclictest and to the responder in C, and the execution, with their limits; None: not measured.

    The benches of foreign controllers have the limits of the shipped one.
    """
    rows = [*(("lateness", name, CYCLICTEST, 1.2) for name in (COMPILED, *MAPPED) if name in tables["lateness"]),
            *((quantity, COMPILED, IN_C, 1.3) for quantity in ("feedback_response", "valve_response"))]
    targets: list[tuple[str, float | None, float, str]] = []
    for quantity, name, rival, limit in rows:
        for share in ("p50", "p99"):
            own, other = (tables[quantity].get(each, {}).get(share) for each in (name, rival))
            ratio = own / other if own is not None and other else None
            targets.append((f"{quantity.replace('_', ' ')} {share}, {name} / {rival}", ratio, limit, ""))
    targets += [(f"execution p99.9, {name}", tables["execution"][name].get("p99_9"), 100.0, "us")
                for name in (COMPILED, *MAPPED) if name in tables["execution"]]
    return [{"name": name, "value": value, "limit": limit, "unit": unit,
             "is_met": value is not None and value <= limit} for name, value, limit, unit in targets]


def find_cyclictest() -> str:
    """The path of cyclictest; "" without it."""
    return shutil.which("cyclictest", path="/usr/bin:/usr/local/bin:/bin:/usr/sbin") or ""


def run_cyclictest(seconds: float, priority: int, cpu: int, period_us: int = 1000) -> Floats:
    """Latencies of cyclictest, s, to the microsecond: one thread, absolute due times, memory locked.

    `priority` 0 runs it without real-time priority.

    Raises:
        RigError: it ended with an error.
    """
    words = [find_cyclictest(), "-q", "-m", f"--priority={priority}", f"--policy={'fifo' if priority else 'other'}",
             f"--interval={period_us}", f"--loops={round(seconds * 1e6 / period_us)}", "--histogram=100000",
             f"--affinity={cpu}"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RigError(f"cyclictest: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
    return parse_histogram(done.stdout)


def parse_histogram(text: str) -> Floats:
    """The latencies, s, in the histogram that cyclictest prints; those beyond its end count as its maximum."""
    ends = dict(re.findall(r"^# (Max Latencies|Histogram Overflows):.*?(\d+)\s*$", text, re.MULTILINE))
    bins = [*re.findall(r"^(\d+)[ \t]+(\d+)\s*$", text, re.MULTILINE),
            (ends.get("Max Latencies", 0), ends.get("Histogram Overflows", 0))]
    latencies, counts = np.array(bins, int).T
    return np.repeat(latencies, counts) * 1e-6


_OF_PLANT = {name: f"rig with its plant ({name} controller)" for name in MAPPED}
_NAMES = {
    "lateness": {CYCLICTEST: "cyclictest", COMPILED: "rig, compiled cycle", IN_C: "rig, compiled cycle (C answers)",
                 **_OF_PLANT},
    "feedback_response": {COMPILED: "plant emulator, compiled", IN_C: "responder in C"},
    "execution": {COMPILED: "rig, compiled cycle", IN_C: "rig, compiled cycle (C answers)", **_OF_PLANT},
}
_NAMES["valve_response"] = _NAMES["feedback_response"]
_TITLES = {
    "lateness": ("SYNC lateness", "How long after its due time SYNC was sent; for cyclictest, how late it woke up. The "
                                  "compiled cycle wakes 80 us early and watches the clock."),
    "feedback_response": ("SYNC to feedback", "From SYNC until the kernel received the feedback frame."),
    "valve_response": ("SYNC to valve state", "From SYNC until the kernel received the valve state."),
    "execution": ("Execution", "Time that the rig's cycle takes: collecting answers, command, SYNC; without waiting."),
}


def build_realtime_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.bench.benchmarks.measure_realtime`, which are its `data`."""
    met_count = sum(target["is_met"] for target in figures["targets"])
    get = {"cyclictest": "apt-get install rt-tests", "gcc": GET_GCC}
    return Report(
        command="bench", title="realtime",
        sentence=f"{met_count} of {len(figures['targets'])} targets are met on {figures['bus']}.",
        sections=[Section("Targets", _tabulate_targets(figures["targets"])),
                  *(Section(title, _tabulate_times(figures["times_us"][quantity], _NAMES[quantity], caption))
                    for quantity, (title, caption) in _TITLES.items()),
                  Section("Conditions", [
                      describe_conditions(figures),
                      *(Line(f"no answer, {name}", f"{count} of {figures['cycles'][name]} cycles")
                        for name, count in figures["lost"].items() if count),
                      *(Line(name, f"skipped: it is not installed; to get it: {get[name]}")
                        for name in figures["missing"])])],
        data=figures)


def _tabulate_targets(targets: Sequence[Mapping[str, Any]]) -> list[Table]:
    def judge(target: Mapping[str, Any]) -> Cell:
        failure = "not measured" if target["value"] is None else "NOT met"
        return Cell("met", "good") if target["is_met"] else Cell(failure, "bad")

    return [tabulate(
        targets,
        (Column("target"), lambda target: target["name"]),
        (Column("measured", align="right"),
         lambda target: "" if target["value"] is None else format_digits(target["value"])),
        (Column("limit", align="right"), lambda target: f"<= {target['limit']:g}"),
        (Column("unit"), lambda target: target["unit"]), (Column(""), judge),
        caption="Ratios are those of the percentiles over all blocks.")]


def _tabulate_times(times: Mapping[str, Mapping[str, float]], names: Mapping[str, str], caption: str) -> list[Table]:
    return [tabulate(
        [(name, times[key]) for key, name in names.items() if times.get(key)],
        (Column(""), lambda row: row[0]),
        (Column("p50", "us", "right"), lambda row: f"{row[1]['p50']:.1f}"),
        (Column("p99", "us", "right"), lambda row: f"{row[1]['p99']:.1f}"),
        (Column("p99.9", "us", "right"), lambda row: f"{row[1]['p99_9']:.1f}"),
        (Column("max", "us", "right"), lambda row: f"{row[1]['max']:.1f}"),
        caption=caption)]



FRICTIONLESS = {f"{body}.{kind}_friction": 0.0 for body in ("spool", "jack") for kind in ("static", "dynamic")}
QUIET = {f"sensors.{quantity}_noise": 0.0 for quantity in ("position", "pressure", "spool")}


def compare_step_with_c(command: Floats, rounds: int = 15, steps: int = 100) -> dict[str, Any] | None:
    """A step of the nominal plant over `command` (n,) m in Python and in C (step.c), ns; None without gcc.

    c: gcc -O3 -march=native, free to fuse multiply and add; c_same_rounding: without fusing. ratio: Python's time over
    C's. difference: largest between the positions of Python and C, m. identical: all columns, with the same rounding.
    """
    if not find_gcc():
        return None
    model, draws = Model(), sample_noise(0, len(command))
    with tempfile.TemporaryDirectory() as folder:
        runs, outs = {}, {}
        runs["python"], outs["python"] = _make_python_run(model, command, draws, steps)
        for name, flags in (("c", FLAGS), ("c_same_rounding", SAME_ROUNDING)):
            library = build_library("step.c", flags, Path(folder) / f"{name}.so")
            runs[name], outs[name] = _make_c_run(library, model, command, draws, steps)
        seconds = measure_durations(runs, rounds)
    each = {name: float(np.median(t)) / (len(command) * steps) * 1e9 for name, t in seconds.items()}
    ratios = {name: float(np.median(seconds["python"] / t)) for name, t in seconds.items()}  # round by round
    version = subprocess.run([find_gcc(), "-dumpfullversion"], capture_output=True, text=True, check=True)
    return {**each, "ratio": ratios["c"], "ratio_same_rounding": ratios["c_same_rounding"],
            "difference": float(np.abs(outs["python"] - outs["c"])[:, 0].max()),
            "identical": bool((outs["python"] == outs["c_same_rounding"]).all()),
            "compiler": f"gcc {version.stdout.strip()}"}


def _make_python_run(model: Model, command: Floats, draws: Floats, steps: int) -> tuple[Work, Floats]:
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    run, state, record = build_kernel(run_closed_loop, model.effects), model.build_flat_state(), model.build_record()
    return lambda: run(state.copy(), command, load, draws, record, steps, out), out


def _make_c_run(library: ctypes.CDLL, model: Model, command: Floats, draws: Floats, steps: int) -> tuple[Work, Floats]:
    record = model.build_record()
    assert library.model_bytes() == record.nbytes, "step.c knows other parameters than plant.parameters"
    out, load = np.empty((len(command), 4)), np.zeros_like(command)
    # the arrays themselves, not their addresses: the closure keeps them alive
    pointers = [np.ctypeslib.as_ctypes(a.view(np.float64).reshape(-1)) for a in (record, command, load, draws)]
    result = np.ctypeslib.as_ctypes(out.reshape(-1))
    return lambda: library.closed_loop(*pointers, len(command), steps, result), out


def measure_accuracy(command: Floats, steps: tuple[int, ...] = (20, 50, 100, 200, 500)) -> list[dict[str, float]]:
    """Error in XJ of some step sizes over `command` (n,) m, closed loop, without noise; friction off and on.

    RMS and largest error, um, against the same run with 5000 steps a cycle, of 0.2 us.
    """
    rows: list[dict[str, float]] = [{"steps": n} for n in steps]
    for name, changes in (("", QUIET | FRICTIONLESS), ("_friction", QUIET)):
        model = Model().replace(changes)
        truth = simulate(model, command, steps=5000).xj
        for row, n in zip(rows, steps, strict=True):
            error = 1e6 * (simulate(model, command, steps=n).xj - truth)
            row |= {f"rms{name}": float(np.sqrt((error**2).mean())), f"largest{name}": float(np.abs(error).max())}
    return rows


def measure_cycle_cost(cycles: int = 5000, rounds: int = 9) -> float:
    """The cost of `Actuator.sample` and `advance` called from Python, s a cycle."""
    plant = Actuator(Model())
    plant.warm()

    def run_cycles() -> None:
        for _ in range(cycles):
            plant.advance(1e-3 * plant.sample()[0])

    return measure_median_duration(run_cycles, rounds) / cycles


def measure_simulation_speed(command: Floats, rounds: int = 9) -> float:
    """The speed of a simulated run over `command` (n,) m, with noise and columns, as a multiple of real time."""
    model = Model()
    return len(command) * model["controller.period"] / measure_median_duration(lambda: simulate(model, command), rounds)


def measure_bus_run_speed(runs: int = 3) -> float:
    """The speed of a preflight run on the embedded bus, with its log, as a multiple of real time; best of `runs`."""
    job = Job(sequence=load_sequence("preflight"), model=Model())
    speeds = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            speeds.append(run_job(job, Path(folder), ignore_progress, lambda: False).speed)
    return max(speeds)


def measure_run_process_speed(rounds: int = 3) -> float:
    """The speed of a whole `rig run preflight` process with its log and report, as a multiple of real time."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = measure_median_duration(lambda: run_rig("run", "preflight", "--quiet", "--out", folder), rounds)
    return load_sequence("preflight").duration / seconds


def measure_help_time(rounds: int = 5) -> float:
    """The time that `rig --help` takes as a process, s."""
    return measure_median_duration(lambda: run_rig("--help"), rounds)


def run_rig(*words: str) -> None:
    """Run `rig` with these words in a process of its own.

    Raises:
        subprocess.CalledProcessError: it ended with a status other than 0.
        KeyboardInterrupt: Ctrl-C in the terminal ended it, before this process heard of it.
    """
    done = subprocess.run([sys.executable, "-m", "rig.cli.main", *words], check=False, stdout=subprocess.DEVNULL)
    if done.returncode == INTERRUPTED:
        raise KeyboardInterrupt
    done.check_returncode()


def run_benchmarks(command: Floats, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Measure everything over `command` (n,) m; `step` is None without gcc."""
    progress("one run, and a run on the embedded bus", 0.0)
    return {"step": compare_step_with_c(command),
            "times_real_time": measure_simulation_speed(command),
            "cycle": measure_cycle_cost(),
            "lockstep": measure_bus_run_speed(),
            "run_process": measure_run_process_speed(),
            "help_process": measure_help_time()}


def build_plant_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `rig.bench.benchmarks.run_benchmarks`, which are its `data`.

    They may hold "accuracy": the rows of `measure_accuracy`.
    """
    return Report(
        command="bench", title="plant",
        sentence=f"The preflight is simulated at {figures['times_real_time']:.0f} times real time.",
        sections=[Section("The plant", _list_costs(figures)),
                  Section("Accuracy", _tabulate_accuracy(figures.get("accuracy", ())))],
        data=figures)


def _list_costs(figures: Mapping[str, Any]) -> list[Item]:
    step = figures["step"]
    rows: list[list[Cell | str]] = [
        ["preflight, simulated", f"{figures['times_real_time']:.0f} x real time", "", ""],
        ["preflight on the embedded bus", f"{figures['lockstep']:.1f} x real time", "", ""],
        ["rig run preflight, the whole process", f"{figures['run_process']:.1f} x real time", "", ""],
        ["rig --help, the whole process", f"{figures['help_process']:.2f} s", "", ""],
        ["one cycle of Actuator from Python", f"{figures['cycle'] * 1e6:.1f} us", "", ""]]
    if step is not None:
        same = Cell("equal bit for bit", "good") if step["identical"] else Cell("NOT equal", "bad")
        rows += [
            ["one step, compiled Python", f"{step['python']:.1f} ns", "", ""],
            [f"one step, {step['compiler']} -O3 -march=native", f"{step['c']:.1f} ns", format_digits(step["ratio"]),
             f"within {step['difference'] * 1e6:.0e} um"],
            ["one step, gcc with -ffp-contract=off", f"{step['c_same_rounding']:.1f} ns",
             format_digits(step["ratio_same_rounding"]), same]]
    columns = [Column("work"), Column("cost", align="right"), Column("Python / C", align="right"), Column("result")]
    return [Table(columns, rows, "Python / C: time of the compiled Python step over that of C. Result: difference "
                                 "between both steps."),
            *([Line("C", f"skipped: gcc is not installed; to get it: {GET_GCC}")] if step is None else [])]


def _tabulate_accuracy(accuracy: Sequence[Mapping[str, float]]) -> list[Table]:
    return [tabulate(
        accuracy,
        (Column("step", "us", "right"), lambda row: f"{1000 / row['steps']:g}"),
        (Column("friction off: RMS", "um", "right"), lambda row: f"{row['rms']:.4f}"),
        (Column("max", "um", "right"), lambda row: f"{row['largest']:.4f}"),
        (Column("friction on: RMS", "um", "right"), lambda row: f"{row['rms_friction']:.2f}"),
        (Column("max", "um", "right"), lambda row: f"{row['largest_friction']:.2f}"),
        caption="Error of XJ over the closed-loop preflight, against steps of 0.2 us.")]
