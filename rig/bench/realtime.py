"""The cycle in real time: its lateness beside cyclictest, its response beside a responder in C, its execution.

The contenders take turns in short blocks, so that a disturbance of the machine hits all of them.
"""
from __future__ import annotations

import contextlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi.progress import Progress, ignore_progress
from fdi.report.numbers import format_digits
from fdi.report.report import Cell, Column, Line, Report, Section, Table, tabulate
from plant.errors import RigError
from rig.bench.blocks import (
    Seconds,
    Times,
    choose_priority,
    compute_percentiles,
    describe_conditions,
    measure_blocks,
    pool_times,
)
from rig.bench.responders import run_c_responder, run_emulator
from rig.bench.stopwatch import GET_GCC, find_gcc
from rig.network.bus import open_can
from rig.network.clock import WallClock
from rig.network.link import Link, LinkWire
from rig.network.master import Master
from rig.network.raw_bus import open_raw_bus
from rig.recorder import Recorder, Signals, Timing
from rig.run.hard_loop import RECEIVED, HardLoop
from rig.run.loop import CycleInput, CycleLoop, History, Loop
from rig.run.priority import (
    LOOP_PRIORITY,
    list_cpus,
    lock_memory,
    prevent_deep_sleep,
    raise_priority,
    suspend_garbage_collection,
)
from rig.sequences.faults import Plan, Schedule

CYCLICTEST, COMPILED, IN_C, PYTHON = "cyclictest", "compiled", "C", "Python"
_QUANTITIES = ("lateness", "feedback_response", "valve_response", "execution")
_SETTLING = 100  # cycles at the beginning of a block that are not counted


def measure_realtime(bus: str, seconds: float, blocks: int, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Measure all contenders on a bus for `seconds` each, in so many blocks.

    Raises:
        InputError: a bus that compiled code cannot use.
        RigError: a bus or a node that does not work.
    """
    found, conditions = measure_blocks(bus, seconds, blocks, list_contenders(bus), progress)
    return summarise_contenders({name: pool_times(each) for name, each in found.items()}) | conditions | {
        "missing": [name for name, path in (("cyclictest", find_cyclictest()), ("gcc", find_gcc())) if not path]}


def list_contenders(bus: str) -> dict[str, Callable[[float], Times]]:
    """What is measured for so many seconds, by name; without those that this machine does not have."""
    def measure_cyclictest(seconds: float) -> Times:
        return {"lateness": run_cyclictest(seconds, choose_priority(), list_cpus()[-1])}

    def measure_compiled(seconds: float) -> Times:
        with run_emulator(bus, is_compiled=True):
            return play_block(bus, seconds)

    def measure_c(seconds: float) -> Times:
        with run_c_responder(bus):
            return play_block(bus, seconds)

    def measure_python(seconds: float) -> Times:
        with run_emulator(bus, is_compiled=False):
            return play_block(bus, seconds, is_compiled=False)

    rows = ((CYCLICTEST, measure_cyclictest, find_cyclictest()), (COMPILED, measure_compiled, "always"),
            (IN_C, measure_c, find_gcc()), (PYTHON, measure_python, "always"))
    return {name: measure for name, measure, is_there in rows if is_there}


def play_block(bus: str, seconds: float, is_compiled: bool = True, period_ns: int = 1_000_000) -> Times:
    """Times of the rig's cycle on a bus, with its log, without the first cycles; NaN where no answer came."""
    history = History()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        recorder = Recorder(Path(folder) / "trace.mcap", {}, {})
        stack.callback(recorder.close)
        clock = WallClock()
        wire = LinkWire(Link(open_can(bus), clock.now), clock)
        stack.callback(wire.close)
        master = Master(wire, clock.now, stamped=True)
        master.hooks.on_frame = recorder.frame
        log = _Log(history, recorder)
        loop: Loop = (HardLoop(master, Schedule(Plan(stop=0)), log, open_raw_bus(bus, RECEIVED), period_ns, True)
                      if is_compiled else CycleLoop(master, Schedule(Plan(stop=0)), log, period_ns, True))
        stack.callback(loop.close)
        stack.enter_context(enter_real_time(is_compiled))
        for _ in range(round(seconds * 1e9 / period_ns)):
            loop.cycle(CycleInput(1, 0.0, 0.0, 0))
        loop.finish()
    return {name: history.column(name)[_SETTLING:].copy() for name in _QUANTITIES}


class _Log:
    """Keeps the cycles and records them, as a run does."""

    def __init__(self, history: History, recorder: Recorder) -> None:
        self._history, self._recorder = history, recorder

    def cycle(self, t_ns: int, signals: Signals, timing: Timing) -> None:
        self._history.cycle(t_ns, signals, timing)
        self._recorder.cycle(t_ns, signals, timing)


@contextlib.contextmanager
def enter_real_time(is_compiled: bool) -> Iterator[None]:
    """The rights that a run takes in real time."""
    with (raise_priority(1 if is_compiled else LOOP_PRIORITY), lock_memory(), prevent_deep_sleep(),
          suspend_garbage_collection()):
        yield


def summarise_contenders(times: Mapping[str, Times]) -> dict[str, Any]:
    """Percentiles in us by quantity and contender, lost answers, and the targets."""
    tables: dict[str, dict[str, dict[str, float]]] = {
        quantity: {name: compute_percentiles(found[quantity]) for name, found in times.items() if quantity in found}
        for quantity in _QUANTITIES}
    tables["execution"].pop(PYTHON, None)  # it is another quantity there: up to SYNC
    lost = {name: int(np.isnan(found["feedback_response"]).sum()) for name, found in times.items() if len(found) > 1}
    return {"times_us": tables, "lost": lost, "cycles": {name: len(found["lateness"]) for name, found in times.items()},
            "targets": list_targets(tables)}


def list_targets(tables: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[dict[str, Any]]:
    """The ratios to cyclictest and to the responder in C, and the execution, with their limits; None: not measured."""
    found: list[tuple[str, float | None, float, str]] = []
    for quantity, rival, limit in (("lateness", CYCLICTEST, 1.2), ("feedback_response", IN_C, 1.3),
                                   ("valve_response", IN_C, 1.3)):
        for share in ("p50", "p99"):
            own, other = (tables[quantity].get(name, {}).get(share) for name in (COMPILED, rival))
            ratio = own / other if own is not None and other else None
            found.append((f"{quantity.replace('_', ' ')} {share}, compiled / {rival}", ratio, limit, ""))
    found.append(("execution p99.9", tables["execution"].get(COMPILED, {}).get("p99_9"), 100.0, "us"))
    return [{"name": name, "value": value, "limit": limit, "unit": unit,
             "is_met": value is not None and value <= limit} for name, value, limit, unit in found]


GET_CYCLICTEST = "apt-get install rt-tests"


def find_cyclictest() -> str:
    """The path of cyclictest; "" without it."""
    return shutil.which("cyclictest", path="/usr/bin:/usr/local/bin:/bin:/usr/sbin") or ""


def run_cyclictest(seconds: float, priority: int, cpu: int, period_us: int = 1000) -> Seconds:
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


def parse_histogram(text: str) -> Seconds:
    """The latencies, s, in the histogram that cyclictest prints; those beyond its end count as its maximum."""
    bins, most, overflows = [], 0, 0
    for line in text.splitlines():
        words = line.split()
        if line.startswith("# Max Latencies:"):
            most = int(words[-1])
        elif line.startswith("# Histogram Overflows:"):
            overflows = int(words[-1])
        elif len(words) == 2 and words[0].isdigit():
            bins.append((int(words[0]), int(words[1])))
    latencies, counts = np.array([*bins, (most, overflows)]).T
    return np.repeat(latencies, counts) * 1e-6


_NAMES = {
    "lateness": {CYCLICTEST: "cyclictest", COMPILED: "rig, compiled cycle", IN_C: "rig, compiled cycle (C answers)",
                 PYTHON: "rig, cycle in Python"},
    "feedback_response": {COMPILED: "plant emulator, compiled", IN_C: "responder in C",
                          PYTHON: "plant emulator in Python"},
    "execution": {COMPILED: "rig, compiled cycle", IN_C: "rig, compiled cycle (C answers)"},
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
    """Report on the figures of `rig.bench.realtime.measure_realtime`, which are its `data`."""
    met = sum(target["is_met"] for target in figures["targets"])
    get = {"cyclictest": GET_CYCLICTEST, "gcc": GET_GCC}
    return Report(
        command="bench", title="realtime",
        sentence=f"{met} of {len(figures['targets'])} targets are met on {figures['bus']}.",
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
        failed = "not measured" if target["value"] is None else "NOT met"
        return Cell("met", "good") if target["is_met"] else Cell(failed, "bad")

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
