"""The screen of a run: nodes, command and position as a moving plot, checks, timing, events."""
from __future__ import annotations

from math import isnan, nan

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from plant.segments import RATE
from rig.network.node_objects import NAMES
from rig.view.live_run import CheckState, LiveRun

_WINDOW = 5 * RATE  # cycles of the plot
_STYLES = {"PASS": "green", "FAIL": "bold red", "measures": "bold cyan", "waits": "dim", "after the run": "dim"}
_NODE_STYLES = {"operational": "green", "pre-operational": "yellow", "stopped": "red"}
_ORDER = ("FAIL", "measures", "PASS", "waits", "after the run")


def draw_screen(run: LiveRun, width: int, height: int, silence: float) -> Text:
    """The whole screen, `height` lines of at most `width` characters. `silence`: s without a new cycle."""
    lower = max(6, (height - 6) // 2)
    plot_height = max(height - lower - 7, 3)
    lines = [_draw_title(run, width), *_draw_nodes(run, silence)]
    lines.append(Text.assemble(("Position [mm], last 5 s: ", "bold"), ("command", "white"), "  ", ("ram", "bold blue")))
    lines += draw_plot({"white": run.read_last("com", _WINDOW) * 1e3, "bold blue": run.read_last("xj", _WINDOW) * 1e3},
                       width, plot_height, 0.2)
    left, right = _draw_checks(run, lower), [*_draw_timing(run), *_draw_events(run, lower)][:lower]
    half = width // 2
    for number in range(lower):
        line = left[number] if number < len(left) else Text("")
        line.truncate(half - 1, overflow="ellipsis", pad=True)
        line.append(" ")
        line.append_text(right[number] if number < len(right) else Text(""))
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
    com, xj = (float(run.read_last(name, 1)[0]) * 1e3 if run.cycles else nan for name in ("com", "xj"))
    return (f"{t}{run.section}; command {com:.2f} mm, ram {xj:.2f} mm; checks {words.count('PASS')} pass, "
            f"{words.count('FAIL')} fail of {len(words)}; {_describe_lateness(run)}; nodes: {nodes}")


def _draw_title(run: LiveRun, width: int) -> Text:
    t = 0.0 if isnan(run.t) else min(max(run.t, 0.0), run.plan.duration)
    share = t / run.plan.duration
    bar = max(min(width - 70, 20), 6)
    return Text.assemble((f"{run.plan.title}", "bold"), f"  {run.section}  {t:.1f} of {run.plan.duration:g} s  ",
                         ("█" * round(share * bar), "green"), ("░" * (bar - round(share * bar)), "dim"),
                         f"  {run.plan.pace}, {run.cycles} cycles")


def _draw_nodes(run: LiveRun, silence: float) -> list[Text]:
    lines = []
    for node, name in NAMES.items():
        line = Text(f"node {node} {name:<11}")
        state = run.states[node]
        if node in run.troubles:
            line.append(f"DEAD: {run.troubles[node]}", style="bold white on red")
        else:
            line.append(state, style=_NODE_STYLES.get(state, "dim"))
        lines.append(line)
    if silence >= 1.0 and run.cycles and not run.is_over:
        lines[0].append(f"   no new cycle in the log for {silence:.1f} s", style="yellow")
    return lines


def _draw_checks(run: LiveRun, count: int) -> list[Text]:
    """The checks: failed ones, those being measured, the last ones that passed, the next ones."""
    states = list(run.checks.values())
    words = [state.word for state in states]
    passed, failed = words.count("PASS"), words.count("FAIL")
    title = Text.assemble((f"Checks: {passed} pass", "bold"), (f", {failed} fail", "bold red" if failed else "bold"),
                          (f" of {len(states)}", "bold"))
    shown = [state for word in _ORDER for state in states if state.word == word]
    done = [state for state in states if state.word == "PASS"]
    room = count - 1 - sum(word in ("FAIL", "measures") for word in words)
    if len(shown) > count - 1:  # the newest of those that passed
        keep = done[len(done) - max(min(room - 1, len(done)), 0):]
        shown = [state for state in shown if state.word != "PASS" or state in keep]
    return [title, *(_draw_check(state) for state in shown[:count - 1])]


def _draw_check(state: CheckState) -> Text:
    return Text.assemble((f"{state.word:<8} ", _STYLES[state.word]), state.name, (state.measured, "bold"))


def _draw_timing(run: LiveRun) -> list[Text]:
    response = run.read_last("response", 2 * RATE)
    lines = [Text("Timing, last 2 s", style="bold"), Text(_describe_lateness(run)),
             Text(f"response {_describe_spread(response)}"), Text(f"overruns {run.overruns}")]
    if run.overruns:
        lines[3].stylize("yellow")
    return lines


def _describe_lateness(run: LiveRun) -> str:
    if run.plan.pace == "lockstep":
        return "lockstep: no cycle is late"
    return f"lateness {_describe_spread(run.read_last('lateness', 2 * RATE))}"


def _describe_spread(values: NDArray[np.float64]) -> str:
    known = values[~np.isnan(values)] * 1e6
    if not len(known):
        return "unknown"
    p50, p99 = np.percentile(known, (50, 99))
    return f"p50 {p50:.0f} p99 {p99:.0f} max {known.max():.0f} us"


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
    known = [values[~np.isnan(values)] for values in lines.values()]
    known = [values for values in known if len(values)]
    low = min((float(values.min()) for values in known), default=0.0)
    high = max((float(values.max()) for values in known), default=0.0)
    margin = max(smallest_range - (high - low), 0.1 * (high - low)) / 2
    low, high = low - margin, high + margin
    bits = np.zeros((height, columns), int)
    colours = np.full((height, columns), "", dtype=object)
    for colour, values in lines.items():
        for row, column, bit in _list_dots(values, low, high, 2 * columns, 4 * height):
            bits[row, column] |= bit
            colours[row, column] = colour
    labels = {0: high, height // 2: (low + high) / 2, height - 1: low}
    drawn = []
    for row in range(height):
        text = Text(f"{labels[row]:7.2f} " if row in labels else " " * 8, style="dim")
        for column in range(columns):
            text.append(chr(0x2800 + bits[row, column]), style=colours[row, column] or None)
        drawn.append(text)
    return drawn


def _list_dots(values: NDArray[np.float64], low: float, high: float, across: int, down: int
               ) -> list[tuple[int, int, int]]:
    """(row, column, bit) of the dots of a line; each column of dots spans what the line passes there."""
    if not len(values):
        return []
    edges = np.linspace(0, len(values), across + 1).astype(int)
    found = []
    for x in range(across):
        part = values[max(edges[x] - 1, 0):max(edges[x + 1], edges[x] + 1)]  # with the one before: steps are joined
        part = part[~np.isnan(part)]
        if len(part):
            y0, y1 = ((high - edge) / (high - low) * (down - 1) for edge in (float(part.max()), float(part.min())))
            found += [(y // 4, x // 2, int(_DOTS[y % 4, x % 2])) for y in range(round(y0), round(y1) + 1)]
    return found
