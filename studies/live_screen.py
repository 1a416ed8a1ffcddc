"""The live screen: lateness and response of runs with and without `rig run --live`, in alternating blocks."""

import argparse
import contextlib
import itertools
import os
import pty
import signal
import struct
import subprocess
import sys
import tempfile
import termios
from collections.abc import Iterator, Mapping, Sequence
from fcntl import ioctl
from functools import partial
from importlib.util import find_spec
from math import isfinite, log, nan
from pathlib import Path
from typing import Any

import numpy as np

from fdi.estimation.binomial import estimate_geometric_mean
from fdi.progress import Progress, ignore_progress
from fdi.report.numbers import format_digits
from fdi.report.report import Cell, Column, Line, Mood, Report, Section, Table, tabulate
from fdi.trace.trace import Trace
from plant.errors import RigError
from rig.bench.benchmarks import (
    Times,
    choose_bus,
    compute_percentiles,
    describe_conditions,
    measure_blocks,
    pool_times,
)
from rig.run.priority import list_cpus
from rig.view.viewer import find_free_port, is_listening, kill_viewer, start_viewer
from studies.command import report_progress, run_study_command

WITHOUT, AGAIN, LIVE, VIEWER = "without", "without, again", "--live", "--live rerun"
QUANTITIES = ("lateness", "response", "feedback_response")
SHARES = ("p50", "p99")
_SEQUENCE = """title = "Live"
setup = [{{ kind = "hold", time = 0.3 }}]
main = [{{ name = "sine", kind = "sine", amplitude = 3e-3, frequency = 1.0, time = {seconds:g} }}]
checks = [
  {{ name = "tracking", kind = "rms_error", high = 1, unit = "mm" }},
  {{ name = "position", kind = "never_exceeds", signal = "ram_position", high = 6, unit = "mm" }},
]
"""


def measure_live_runs(bus: str, seconds: float, blocks: int, progress: Progress = ignore_progress) -> dict[str, Any]:
    """Measure all contenders on a bus for `seconds` each, in so many blocks.

    Raises:
        InputError: a bus that compiled code cannot use.
        RigError: a run that came to no verdict.
    """
    missing = {} if find_spec("rerun") else {VIEWER: "not measured: pip install 'eha-rig[view]'"}
    contenders = {name: partial(play_contender, name, bus) for name in (WITHOUT, AGAIN, LIVE, VIEWER)
                  if name not in missing}
    found, conditions = measure_blocks(bus, seconds, blocks, contenders, progress)
    return summarise_live_runs(found) | conditions | {
        "missing": missing,
        "ended_early": {name: sum(len(run["lateness"]) < 900.0 * seconds / blocks for run in runs)
                        for name, runs in found.items()}}


def play_contender(name: str, bus: str, seconds: float) -> Times:
    """Times of the cycles of a run of one kind, see `play_run`."""
    if name != VIEWER:
        return play_run(bus, seconds, ("--live",) if name == LIVE else ())
    with open_hidden_viewer() as port:
        return play_run(bus, seconds, ("--live", f"rerun:{port}"))


@contextlib.contextmanager
def open_hidden_viewer(patience: float = 60.0) -> Iterator[int]:
    """A viewer that draws without a display, by the CPUs that the loop leaves free; give its port on 127.0.0.1.

    Raises:
        RigError: it does not start, for example without a Vulkan driver.
    """
    port, cpus, before = find_free_port(), list_cpus(), os.sched_getaffinity(0)
    os.sched_setaffinity(0, cpus[:-1] or cpus)  # the viewer inherits it
    try:
        viewer = start_viewer(port, "--headless", "--window-size", "1280x800", patience=patience)
    finally:
        os.sched_setaffinity(0, before)
    try:
        if not is_listening(port):
            raise RigError("the viewer does not start without a display; it needs a Vulkan driver (Debian: "
                           "mesa-vulkan-drivers libvulkan1)")
        yield port
    finally:
        kill_viewer(viewer)


def play_run(bus: str, seconds: float, options: Sequence[str]) -> Times:
    """Times of the cycles of main of a run with its emulator; NaN where no answer came.

    Raises:
        RigError: the run came to no verdict.
    """
    with tempfile.TemporaryDirectory() as name:
        sequence, folder = Path(name) / "live.toml", Path(name) / "run"
        sequence.write_text(_SEQUENCE.format(seconds=seconds))
        words = [sys.executable, "-m", "rig.cli.main", "run", str(sequence), "--bus", bus, "--pace", "realtime",
                 "--max-overruns", "1", "--out", str(folder), *options]
        status, text = run_in_terminal(words)
        if status not in (0, 1, 3):  # a verdict, whichever
            lines = [line for line in text.splitlines() if line.strip()] or ["it printed nothing"]
            raise RigError(f"rig run {' '.join(options)} ended with status {status}: {lines[-1].strip()}")
        timing = Trace.read(folder, all=True).timing
    main = timing.t >= 0.0
    return {name: getattr(timing, name)[main] for name in (*QUANTITIES, "overrun")}


def run_in_terminal(words: Sequence[str], size: tuple[int, int] = (40, 120)) -> tuple[int, str]:
    """Run a program in a terminal of its own, `size` lines and columns; its exit status and what it wrote last."""
    ours, theirs = pty.openpty()
    try:
        ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", *size, 0, 0))
        process = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
                                   env=os.environ | {"TERM": "xterm-256color"})
        os.close(theirs)
        text = b""
        try:
            with contextlib.suppress(OSError):  # the other end is closed
                while data := os.read(ours, 65536):
                    text = (text + data)[-4096:]
        finally:
            process.send_signal(signal.SIGTERM)  # without effect on one that has ended
            process.wait()
    finally:
        os.close(ours)
    return process.returncode, text.decode(errors="replace")


def summarise_live_runs(found: Mapping[str, list[Times]]) -> dict[str, Any]:
    """Percentiles in us by quantity and contender over all blocks and of each block, ratios, overruns.

    Args:
        found: contender -> of each block, quantity -> times in s, and which cycles are overruns.
    """
    pooled = {name: pool_times(blocks) for name, blocks in found.items()}
    single = {quantity: {name: [compute_percentiles(block[quantity]) for block in blocks]
                         for name, blocks in found.items()} for quantity in QUANTITIES}
    return {"times_us": {quantity: {name: compute_percentiles(times[quantity]) for name, times in pooled.items()}
                         for quantity in QUANTITIES},
            "blocks_us": single, "ratios": compare_contenders(single),
            "overruns": {name: int(times["overrun"].sum()) for name, times in pooled.items()},
            "cycles": {name: len(times["lateness"]) for name, times in pooled.items()}}


def compare_contenders(blocks_us: Mapping[str, Mapping[str, Sequence[Mapping[str, float]]]]) -> list[dict[str, Any]]:
    """The ratios of all contenders to the runs without a screen: geometric means of the blocks' percentiles.

    low, high: the simultaneous 95 % interval of all ratios; NaN with fewer than four blocks.
    """
    found = []
    others = [name for name in next(iter(blocks_us.values())) if name != WITHOUT]
    count = len(QUANTITIES) * len(SHARES) * len([name for name in others if name != AGAIN])
    for quantity, share in itertools.product(QUANTITIES, SHARES):
        logs = {name: np.array([log(block[share]) if block.get(share, 0.0) > 0.0 else nan for block in blocks])
                for name, blocks in blocks_us[quantity].items()}
        for name in others:
            base = logs[WITHOUT] if name == AGAIN else (logs[WITHOUT] + logs[AGAIN]) / 2
            ratio, low, high = estimate_geometric_mean(logs[name] - base, 0.05 / count, 4)
            words = {"not known": not isfinite(low), "slower": low > 1.0, "faster": high < 1.0}
            found.append({"quantity": quantity, "share": share, "contender": name, "ratio": ratio, "low": low,
                          "high": high, "word": next((word for word in words if words[word]), "no difference found")})
    return found


_MOODS: Mapping[str, Mood] = {"slower": "bad", "faster": "", "no difference found": "good", "not known": "doubtful"}


def build_live_runs_report(figures: Mapping[str, Any]) -> Report:
    """Report on the figures of `measure_live_runs`, which are its `data`."""
    overruns = ", ".join(f"{name} {count} of {figures['cycles'][name]}" for name, count in figures["overruns"].items())
    lines = [describe_conditions(figures), Line("overruns", overruns),
             *(Line("ended early", f"{name}: {count}") for name, count in figures["ended_early"].items() if count),
             *(Line(name, reason) for name, reason in figures["missing"].items())]
    return Report(
        command="live_screen", title="live screen", sentence=describe_ratios(figures["ratios"]),
        sections=[Section("With and without", _tabulate_ratios(figures["ratios"])),
                  Section("Times", [_tabulate_times(figures)]),
                  Section("Conditions", lines)],
        data=dict(figures))


def describe_ratios(ratios: Sequence[Mapping[str, Any]]) -> str:
    """What the ratios say, in one sentence."""
    names = list(dict.fromkeys(ratio["contender"] for ratio in ratios if not ratio["contender"].startswith(WITHOUT)))
    shown = " and ".join(names)
    changed = [f"{ratio['quantity'].replace('_', ' ')} {ratio['share']} {ratio['word']} with {ratio['contender']} "
               f"({format_digits(ratio['ratio'])} times)" for ratio in ratios
               if ratio["word"] in ("slower", "faster") and ratio["contender"] in names]
    if changed:
        return f"{'; '.join(changed)}."
    if any(ratio["word"] == "not known" for ratio in ratios):
        return f"Too few blocks to say whether {shown} changes lateness or response; ask for --blocks 4 or more."
    return f"Lateness and response with {shown} differ from those without by no more than noise."


def _tabulate_ratios(ratios: Sequence[Mapping[str, Any]]) -> list[Table]:
    def show_interval(ratio: Mapping[str, Any]) -> str:
        return f"{_format_ratio(ratio['low'])} .. {_format_ratio(ratio['high'])}" if isfinite(ratio["low"]) else ""

    return [tabulate(
        ratios,
        (Column("percentile"), lambda ratio: f"{ratio['quantity'].replace('_', ' ')} {ratio['share']}"),
        (Column("run"), lambda ratio: ratio["contender"]),
        (Column("ratio", align="right"), lambda ratio: _format_ratio(ratio["ratio"])),
        (Column("interval", align="right"), show_interval),
        (Column(""), lambda ratio: Cell(ratio["word"], _MOODS[ratio["word"]])),
        caption=f'To the runs without the screen: geometric means over the blocks. "{AGAIN}": the same runs once more, '
                "which is the noise. All intervals together hold with 95 %.")]


def _format_ratio(ratio: float) -> str:
    if not ratio < 100.0:
        return "> 100" if ratio >= 100.0 else "-"
    return f"{ratio:.2f}"


def _tabulate_times(figures: Mapping[str, Any]) -> Table:
    """p50 and p99 of each quantity and run, and their smallest and largest value over the blocks."""
    def show(row: tuple[str, str, dict[str, float]], share: str) -> str:
        values = [block[share] for block in figures["blocks_us"][row[0]][row[1]] if block]
        return f"{row[2][share]:.1f} ({min(values):.1f} .. {max(values):.1f})"

    return tabulate(
        [(quantity, name, found) for quantity, times in figures["times_us"].items() for name, found in times.items()
         if found], (Column("from SYNC"), lambda row: row[0].replace("_", " ")), (Column("run"), lambda row: row[1]),
        *((Column(share, "us", "right"), partial(show, share=share)) for share in SHARES),
        caption="Over all blocks (smallest .. largest of a block). Lateness: of SYNC after its due time.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and show; see --help."""
    return run_study_command("studies.live_screen", __doc__, arguments, add_options, run_study)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Bus, time and blocks, as those of `rig bench realtime`."""
    parser.add_argument("--bus", default="auto", metavar="INTERFACE:CHANNEL",
                        help="socketcan:vcan0 or udp_multicast:GROUP (default: a UDP group of its own)")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="of each contender (default: 60)")
    parser.add_argument("--blocks", type=int, default=6, metavar="N", help="alternating blocks (default: 6)")


def run_study(args: argparse.Namespace) -> tuple[Report, bool]:
    """The report; it has no aims."""
    bus = choose_bus(args.bus, args.seconds, args.blocks, 1.0)
    return build_live_runs_report(measure_live_runs(bus, args.seconds, args.blocks, report_progress)), True


if __name__ == "__main__":
    raise SystemExit(main())
