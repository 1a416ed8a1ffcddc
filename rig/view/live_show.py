"""The program that shows a run, in a process of its own: `python -m rig.view.live_show LOG [PORT FILE]`.

LOG is the log of the run. Without more words this program shows the run in the terminal. PORT is that of
an open viewer on 127.0.0.1, or 0; FILE is a recording for the viewer to write, or empty; with neither, a viewer is
opened, which stays open after the run.

The plan of the run comes on standard input, and a byte when the log is there. Standard input stays open as long as the
rig runs: when it ends, however it ends, this program restores the terminal and ends too. It closes its standard output
when it is ready.
"""

import contextlib
import os
import pickle
import select
import struct
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from io import BytesIO
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, Schema
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live
from rich.text import Text

from fdi.trace import CheckResult, scan_messages, unpack_chunk
from plant import EHA, Signals
from rig.recorder import CanFrame, Event, NmtState, Record
from rig.recorder.writer import MAGIC, list_channels, list_topics
from rig.view.live_run import CheckState, LivePlan, LiveRun
from rig.view.recording import (
    ACTIVE,
    FAIL,
    LANES,
    MEASURED,
    NEUTRAL,
    NOTHING,
    PASS,
    PHASES,
    SECTIONS,
    STATES,
    Drawing,
    Lane,
    LogText,
    Plot,
    Recording,
    build_blueprint,
    describe_check,
    describe_event,
    draw_signals,
    list_plots,
    name_node_lane,
    read_fault_event,
)
from rig.view.viewer import find_free_port, is_listening, start_viewer

_RECORD = struct.Struct("<BQ")  # opcode, length


def follow_log(path: Path, signals: Signals = EHA) -> Iterator[list[tuple[int, Record]]]:
    """Give the records of the log that are new, with their log times in ns, again and again; no raw frames.

    The writer closes a chunk at least every 0.2 s; what it has not written yet comes later. The log is opened once, as
    soon as it is there: it may be moved or deleted. What is given ends if it cannot be read.
    """
    decoders: dict[int, Any] = {}
    for kind, schema in zip(list_topics(signals).values(), list_channels(signals), strict=False):  # schemas come first
        if kind is not CanFrame and isinstance(schema, Schema):
            decode = DecoderFactory().decoder_for("protobuf", schema)
            decoders[schema.id] = kind, [field.name for field in fields(kind)], decode
    done = len(MAGIC)  # bytes of the file
    with contextlib.suppress(OSError):
        while not path.exists():
            yield []
        with path.open("rb", buffering=0) as file:
            while True:
                file.seek(done)
                records, start = list[tuple[int, Record]](), 0
                for raw, end in _list_chunks(file.read()):
                    start = end
                    records += _decode_messages(raw, decoders)
                done += start
                yield records


def _decode_messages(raw: bytes, decoders: dict[int, Any]) -> Iterator[tuple[int, Record]]:
    for channel, t_ns, _, message in scan_messages(raw):
        if channel in decoders:
            kind, names, decode = decoders[channel]
            record = decode(message)
            yield t_ns, kind(**{name: getattr(record, name) for name in names})


def _list_chunks(data: bytes) -> Iterator[tuple[bytes, int]]:
    """The chunks that are complete, unpacked, and where each ends."""
    at = 0
    while at + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size + length
        if opcode == Opcode.CHUNK and at <= len(data):
            yield unpack_chunk(Chunk.read(ReadDataStream(BytesIO(data[at - length:at])))), at


_STYLES = {"FAIL": "bold red", "CANNOT_TELL": "bold yellow", "measures": "bold cyan", "PASS": "green", "waits": "dim",
           "after the run": "dim"}  # in the order in which checks are shown
_NODE_STYLES = {"operational": "green", "pre-operational": "yellow", "stopped": "red"}


def draw_screen(run: LiveRun, width: int, height: int, silence: float) -> Text:
    """The whole screen, `height` lines of at most `width` characters. `silence`: s without a new cycle."""
    lower = max(6, (height - 6) // 2)
    plot_height = max(height - lower - 7, 3)
    lines = [_draw_title(run, width), *_draw_nodes(run, silence)]
    signals = run.plan.signals
    command, controlled = signals.command, signals.controlled
    title = next(title for (origin, title) in list_plots(signals) if origin == "position")
    lines.append(Text.assemble((f"{title}, last 5 s: ", "bold"), ("command", "white"), "  ",
                               (controlled.phrase, "bold blue")))
    com, xj = (s.shown_scale * run.read_last(s.name, round(5 * run.plan.rate)) for s in (command, controlled))
    lines += draw_plot({"white": com, "bold blue": xj}, width, plot_height, 0.2)
    left_lines, right_lines = _draw_checks(run, lower), [*_draw_timing(run), *_draw_events(run, lower)][:lower]
    for number in range(lower):
        line = left_lines[number] if number < len(left_lines) else Text("")
        line.truncate(width // 2 - 1, overflow="ellipsis", pad=True)
        line.append(" ")
        line.append_text(right_lines[number] if number < len(right_lines) else Text(""))
        lines.append(line)
    lines.append(Text("Ctrl-C ends the run; its log is closed and judged", style="dim"))
    for line in lines:
        line.truncate(width, overflow="ellipsis")
    return Text("\n").join(lines[:height])


def describe_line(run: LiveRun) -> str:
    """The state of the run in one line, for where there is no screen."""
    words = [state.word for state in run.checks.values()]
    t = "" if isnan(run.t) else f"{run.t:.1f} of {run.plan.duration:g} s, "
    nodes = ", ".join(f"{node} {run.troubles.get(node) or state}" for node, state in run.states.items() if node != 1)
    signals = run.plan.signals
    unit, ram = signals.controlled.shown_unit, signals.controlled.phrase
    com, xj = (float(run.read_last(s.name, 1)[0]) * s.shown_scale if run.cycles else nan
               for s in (signals.command, signals.controlled))
    return (f"{t}{run.section}; command {com:.2f} {unit}, {ram} {xj:.2f} {unit}; checks {words.count('PASS')} pass, "
            f"{words.count('FAIL')} fail of {len(words)}; {_describe_lateness(run)}; nodes: {nodes}")


def _draw_title(run: LiveRun, width: int) -> Text:
    t = 0.0 if isnan(run.t) else min(max(run.t, 0.0), run.plan.duration)
    share = t / run.plan.duration
    bar = max(min(width - 70, 20), 6)
    return Text.assemble((f"{run.plan.title}", "bold"), f"  {run.section}  {t:.1f} of {run.plan.duration:g} s  ",
                         ("█" * round(share * bar), "green"), ("░" * (bar - round(share * bar)), "dim"),
                         f"  {run.plan.pace}, {run.cycles} cycles")


def _draw_nodes(run: LiveRun, silence: float) -> list[Text]:
    texts = {**{node: (state, _NODE_STYLES.get(state, "dim")) for node, state in run.states.items()},
             **{node: (f"DEAD: {trouble}", "bold white on red") for node, trouble in run.troubles.items()}}
    lines = [Text.assemble(f"{name:<18}", texts[node]) for node, name in run.plan.nodes.items()]
    if silence >= 1.0 and run.cycles and not run.is_over:
        lines[0].append(f"   no new cycle in the log for {silence:.1f} s", style="yellow")
    return lines


def _draw_checks(run: LiveRun, count: int) -> list[Text]:
    """The checks: failed ones, those being measured, the last ones that passed, the next ones."""
    states = list(run.checks.values())
    words = [state.word for state in states]
    passes, failures = words.count("PASS"), words.count("FAIL")
    title = Text.assemble((f"Checks: {passes} pass", "bold"),
                          (f", {failures} fail", "bold red" if failures else "bold"), (f" of {len(states)}", "bold"))
    visible_states = [state for word in _STYLES for state in states if state.word == word]
    done = [state for state in states if state.word == "PASS"]
    room = count - 1 - sum(word in ("FAIL", "CANNOT_TELL", "measures") for word in words)
    if len(visible_states) > count - 1:  # the newest of those that passed
        keep = done[len(done) - max(min(room - 1, len(done)), 0):]
        visible_states = [state for state in visible_states if state.word != "PASS" or state in keep]
    return [title, *(Text.assemble((f"{state.word:<8} ", _STYLES[state.word]), state.name, (state.measured, "bold"))
                     for state in visible_states[:count - 1])]


def _draw_timing(run: LiveRun) -> list[Text]:
    response = run.read_last("response", round(2 * run.plan.rate))
    return [Text("Timing, last 2 s", style="bold"), Text(_describe_lateness(run)),
            Text(f"response {_describe_spread(response)}"),
            Text(f"overruns {run.overruns}", style="yellow" if run.overruns else "")]


def _describe_lateness(run: LiveRun) -> str:
    if run.plan.pace == "lockstep":
        return "lockstep: no cycle is late"
    return f"lateness {_describe_spread(run.read_last('lateness', round(2 * run.plan.rate)))}"


def _describe_spread(values: NDArray[np.float64]) -> str:
    microseconds = values[~np.isnan(values)] * 1e6
    if not len(microseconds):
        return "unknown"
    p50, p99 = np.percentile(microseconds, (50, 99))
    return f"p50 {p50:.0f} p99 {p99:.0f} max {microseconds.max():.0f} us"


def _draw_events(run: LiveRun, count: int) -> list[Text]:
    events = [event for event in run.events if event.kind not in ("section", "identity")][-max(count - 5, 1):]
    styles = {"WARN": "yellow", "ERROR": "bold red"}
    return [Text("Events", style="bold"),
            *(Text((f"{event.t:.2f} s " if not isnan(event.t) else "") + f"{event.kind}: {event.text}",
                   style=styles.get(event.level, "")) for event in events)]


_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])  # row and column of a dot -> its bit


def draw_plot(lines: dict[str, NDArray[np.float64]], width: int, height: int, smallest_range: float) -> list[Text]:
    """Draw columns of values over their number as text, `height` lines of `width` characters.

    Args:
        lines: colour -> values (n,), the last value at the right edge; a later line covers an earlier one.
        width: characters, with 8 for the axis.
        height: lines.
        smallest_range: of the axis, so that noise does not fill the screen.
    """
    columns = max(width - 8, 1)
    finite_values = np.concatenate([values[~np.isnan(values)] for values in lines.values()])
    low, high = (float(finite_values.min()), float(finite_values.max())) if len(finite_values) else (0.0, 0.0)
    margin = max(smallest_range - (high - low), 0.1 * (high - low)) / 2
    low, high = low - margin, high + margin
    bits = np.zeros((height, columns), int)
    colours = np.full((height, columns), "", dtype=object)
    for colour, values in lines.items():
        for row, column, bit in _list_dots(values, low, high, 2 * columns, 4 * height):
            bits[row, column] |= bit
            colours[row, column] = colour
    labels = {0: high, height // 2: (low + high) / 2, height - 1: low}
    return [Text.assemble(f"{labels[row]:7.2f} " if row in labels else " " * 8,
                          *((chr(0x2800 + bits[row, column]), colours[row, column]) for column in range(columns)),
                          style="dim") for row in range(height)]


def _list_dots(values: NDArray[np.float64], low: float, high: float, across: int, down: int
               ) -> Iterator[tuple[int, int, int]]:
    """(row, column, bit) of the dots of a line; each column of dots spans what the line passes there."""
    if not len(values):
        return
    edges = np.linspace(0, len(values), across + 1).astype(int)
    for x in range(across):
        part = values[max(edges[x] - 1, 0):max(edges[x + 1], edges[x] + 1)]  # with the one before: steps are joined
        part = part[~np.isnan(part)]
        if len(part):
            y0, y1 = ((high - edge) / (high - low) * (down - 1) for edge in (float(part.max()), float(part.min())))
            yield from ((y // 4, x // 2, int(_DOTS[y % 4, x % 2])) for y in range(round(y0), round(y1) + 1))


_WORDS = {"waits": NEUTRAL, "measures": MEASURED, "after the run": NEUTRAL, "PASS": PASS, "FAIL": FAIL,
          "CANNOT_TELL": 0xD9A441FF}


def draw_plan(plan: LivePlan) -> Drawing:
    """The views of a run that has not begun."""
    lanes = [Lane("run/phase", [], PHASES),
             Lane("run/command", [], PHASES | dict.fromkeys(plan.sections, SECTIONS["dynamic"])),
             *(Lane(name_node_lane(node, name), [], STATES) for node, name in plan.nodes.items()),
             *(Lane(f"fault/{label}", [], ACTIVE) for label in plan.starts),
             *(Lane(f"check/{name}", [], {}) for name in plan.check_names)]
    plots = draw_signals(dict.fromkeys(_list_signals(plan), (NOTHING, NOTHING)), list_plots(plan.signals))
    return Drawing(plan.title, plots, LANES, lanes, ("Provenance", f"{plan.title}, {plan.pace}"), log=())


def _list_signals(plan: LivePlan) -> list[str]:
    """The signals that are drawn; in lockstep nothing is ever late."""
    load = plan.signals.load.name if plan.signals.load and not plan.has_load else ""
    left_out = (load, "lateness" if plan.pace == "lockstep" else "")
    return [name for name in ("error", *plan.columns[2:-1]) if name not in left_out]


class LiveView:
    """Draws what is new of a run, piece by piece. Nothing is sent before main begins, where t = 0 is, or it ends."""

    def __init__(self, recording: Recording, plan: LivePlan) -> None:
        """Use the recording of the drawing of this plan."""
        self._recording, self._plan, self._signals = recording, plan, _list_signals(plan)
        self._rows = 0
        self._waiting: list[tuple[int, Record]] = []
        self._shown = {f"check/{name}": "waits" for name in plan.check_names}  # lane -> state

    def update(self, run: LiveRun, new: Sequence[tuple[int, Record]], *, is_over: bool = False) -> None:
        """Send what has come since the last call; t = 0 of a run that ended before main is its last record."""
        self._waiting += new
        zero_ns = self._waiting[-1][0] if is_over and self._waiting and run.zero_ns is None else run.zero_ns
        if zero_ns is None:
            return
        records = [((t_ns - zero_ns) / 1e9, record) for t_ns, record in self._waiting]
        self._waiting.clear()
        rows = run.read_rows_from(self._rows)
        self._rows += len(rows)
        plots, lanes = self._draw_rows(rows, run, zero_ns) if len(rows) else ([], [])
        self._recording.send(plots, [*self._list_lanes(records), *lanes], [*_list_texts(records)])

    def _draw_rows(self, rows: NDArray[np.float64], run: LiveRun, zero_ns: int) -> tuple[list[Plot], list[Lane]]:
        signals = self._plan.signals
        columns = dict(zip(self._plan.columns, rows.T, strict=True))
        columns["error"] = columns[signals.command.name] - columns[signals.controlled.name]
        t = (columns["t_ns"] - (zero_ns - run.first_ns)) / 1e9
        plots = draw_signals({name: (t, columns[name]) for name in self._signals}, list_plots(signals))
        phases, now = columns["phase"].astype(int), float(t[-1])
        lanes = [self._turn("run/phase", float(t[row]), [*PHASES][min(phases[row], 2)])
                 for row in np.flatnonzero(np.diff(phases, prepend=-1))]
        lanes += [self._turn("run/command", now, run.section),
                  *(self._turn_check(state, now) for state in run.checks.values() if not state.is_final)]
        return plots, [lane for turned in lanes for lane in turned]

    def _list_lanes(self, records: Sequence[tuple[float, Record]]) -> Iterator[Lane]:
        """The states that records report at their times."""
        for t, record in records:
            if isinstance(record, NmtState):
                yield from self._turn(name_node_lane(record.node, self._plan.nodes.get(record.node)), t, record.name)
            elif isinstance(record, CheckResult):
                yield from self._turn_check(CheckState(record.name, record.verdict, record, True), t)
            elif isinstance(record, Event) and record.kind == "fault" and (fault := read_fault_event(record.text)):
                yield from self._turn(f"fault/{fault[0]}", t, fault[1])

    def _turn_check(self, state: CheckState, t: float) -> list[Lane]:
        """The protocol checks have no lane: they are judged after the run and have no window."""
        word = state.word + state.measured if state.is_judged else state.word
        is_shown = state.name in self._plan.check_names
        return self._turn(f"check/{state.name}", t, word, {**_WORDS, word: _WORDS[state.word]}) if is_shown else []

    def _turn(self, lane: str, t: float, state: str, colours: Mapping[str, int] | None = None) -> list[Lane]:
        """The lane from its new state on; nothing if it has this state already."""
        if self._shown.get(lane) == state:
            return []
        self._shown[lane] = state
        return [Lane(lane, [(t, state)], colours or {})]


def _list_texts(records: Sequence[tuple[float, Record]]) -> Iterator[LogText]:
    for t, record in records:
        if isinstance(record, CheckResult):
            yield describe_check(record, t)
        elif isinstance(record, Event):
            yield describe_event(t, record.level, record.kind, record.text)


_EVERY = 0.1  # s between two frames, or pieces


Batches = Iterator[list[tuple[int, Record]]]


def follow_run(log: Path, run: LiveRun) -> Batches:
    """Add what is new in the log to the run again and again, and give it too, until the rig has ended."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the run may begin
    records: Batches = iter(())
    is_there = True
    while is_there:
        began = time.monotonic()
        if select.select([0], [], [], 0)[0]:
            is_there = bool(os.read(0, 1))
            records = follow_log(log, run.plan.signals) if is_there else records
        new = next(records, [])
        for t_ns, record in new:
            run.add(t_ns, record)
        run.judge_checks()
        yield new
        if is_there:
            time.sleep(max(_EVERY - (time.monotonic() - began), 0.02))


def show_on_terminal(log: Path, plan: LivePlan) -> None:
    """Show a run on standard error until it is over: as a screen, or without a terminal as a line every 2 s."""
    console, run = Console(stderr=True, highlight=False), LiveRun(plan)
    if obstacle := find_obstacle(console):
        print(f"live: {obstacle}: a line every 2 s instead of the screen", file=sys.stderr, flush=True)
        print_lines(log, run)
        return
    with Live(console=console, screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        last, last_change = -1, time.monotonic()
        for _ in follow_run(log, run):
            if run.cycles != last:
                last, last_change = run.cycles, time.monotonic()
            live.update(draw_screen(run, *console.size, time.monotonic() - last_change), refresh=True)


def find_obstacle(console: Console) -> str:
    """Why there can be no screen; empty if there can."""
    if not console.is_terminal:
        return "standard error is no terminal"
    if os.environ.get("TERM", "dumb") in ("dumb", "unknown"):
        return f"TERM={os.environ.get('TERM', '')} has no screen"
    if "utf" not in console.encoding.lower():
        return f"the terminal's encoding is {console.encoding}, not UTF-8"
    return ""


def print_lines(log: Path, run: LiveRun) -> None:
    """One line every 2 s and one at the end."""
    next_line = time.monotonic() + 2.0
    for _ in follow_run(log, run):
        if time.monotonic() >= next_line:
            next_line += 2.0
            print(f"live: {describe_line(run)}", file=sys.stderr, flush=True)
    print(f"live: {describe_line(run)}", file=sys.stderr, flush=True)


def show_in_viewer(log: Path, plan: LivePlan, port: int, file: str) -> None:
    """Send a run piece by piece until it is over, or until the viewer that was opened for it is closed."""
    os.environ["RUST_LOG"] = "off"  # a viewer that is gone is one line of ours, not many of its library
    import rerun as rr

    drawing, viewer = draw_plan(plan), None
    blueprint = build_blueprint(drawing, "following")
    stream = rr.RecordingStream("eha-rig", recording_id=f"live-{os.getpid()}")
    if file:
        stream.save(file, default_blueprint=blueprint)
    else:
        if not port:
            port = find_free_port()
            viewer = start_viewer(port)
        stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint)
    view = LiveView(Recording(stream, drawing), plan)
    run, next_look = LiveRun(plan), time.monotonic()
    for new in follow_run(log, run):
        view.update(run, new)
        if port and time.monotonic() >= next_look:
            next_look += 1.0
            if viewer.poll() is not None if viewer else not is_listening(port):
                print("rig run: the viewer was closed; the run goes on", file=sys.stderr, flush=True)
                os._exit(0)  # its library would wait for the viewer
    view.update(run, (), is_over=True)
    stream.flush()
    stream.disconnect()


def main() -> None:
    """Read the plan and show the run."""
    log, *place = sys.argv[1:]
    with open(0, "rb", buffering=0, closefd=False) as stream:  # nothing is read ahead
        plan = pickle.load(stream)
    if place:
        show_in_viewer(Path(log), plan, int(place[0]), place[1])
    else:
        show_on_terminal(Path(log), plan)


if __name__ == "__main__":
    main()
