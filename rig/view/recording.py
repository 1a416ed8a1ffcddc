"""What the viewer shows, as data: plots of curves, lanes of states, texts; of a log, of runs, of a comparison."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from fdi.comparison.compare import Comparison
from fdi.comparison.run_differences import Run, RunDifferences
from fdi.output import require_writable
from fdi.report import (
    Report,
    build_comparison_report,
    build_diff_report,
    choose_difference_units,
    choose_drawn_unit,
    choose_unit,
    format_ratio,
    format_report,
    join_words,
    label_signal,
    list_faults,
    read_verdict,
)
from fdi.thresholds import NOISE_BAND_RATIO, SIGNAL_ERROR_RATIO
from fdi.trace import MAIN, CheckResult, Floats, Section, Trace
from plant import UNITS, Signal, Signals
from rig.network import NAMES
from rig.view.viewer import import_rerun

TIMELINE = "run"
# on black and on white
COMMAND, MEASURED, LIMIT, PASS, FAIL, NEUTRAL = 0xA9B2BCFF, 0x3D8FE0FF, 0xE5534BFF, 0x3FA65AFF, 0xE5534BFF, 0x6B7785FF
TEXTS, CHECKS = "Events and checks", "Checks"  # titles of views
NOTHING = np.zeros(0)


class Curve(NamedTuple):
    """A line of a plot: times, s, and values in the unit of the plot."""

    path: str
    name: str
    colour: int
    t: Floats = NOTHING
    values: Floats = NOTHING
    width: float = 1.5


class Plot(NamedTuple):
    """One time-series view. The viewer draws curves in the order of their paths."""

    origin: str
    title: str
    curves: Sequence[Curve]


class Lane(NamedTuple):
    """States over time, each from its time, s, on; "" is no state. `labels` are shown in place of some states."""

    path: str  # group/name
    states: Sequence[tuple[float, str]]
    colours: Mapping[str, int]
    labels: Mapping[str, str] = {}


class LogText(NamedTuple):
    """A line of the events or of the checks."""

    path: str
    t: float  # s
    text: str
    level: str = "INFO"


class Drawing(NamedTuple):
    """A recording for the viewer. Lanes of the group "check" have a view of their own, beside the plots.

    `document` is a title with a text in Markdown, `log` the texts of events and checks, None where there are no such
    views.
    """

    name: str
    plots: Sequence[Plot]
    lanes_title: str
    lanes: Sequence[Lane]
    document: tuple[str, str]
    log: Sequence[LogText] | None = None
    verdict: str = ""


class Recording:
    """A stream of the viewer, which takes curves, states and texts of a drawing at once or piece by piece."""

    def __init__(self, stream: Any, drawing: Drawing) -> None:
        """Declare name and colour of each curve of a drawing, and send the drawing with its document."""
        self._rr, self._stream = import_rerun(), stream
        stream.send_recording_name(drawing.name)
        for plot in drawing.plots:
            for curve in plot.curves:  # where there are more samples than pixels the peaks are kept
                stream.log(f"{plot.origin}/{curve.path}", self._rr.SeriesLines(
                    colors=[curve.colour], widths=[curve.width], names=[curve.name], aggregation_policy="MinMax"),
                    static=True)
        title, text = drawing.document
        stream.log(f"log/{title.lower()}", self._rr.TextDocument(text, media_type="text/markdown"), static=True)
        self.send(drawing.plots, drawing.lanes, drawing.log or ())

    def send(self, plots: Sequence[Plot], lanes: Sequence[Lane], texts: Sequence[LogText]) -> None:
        """Send samples of curves, colours and states of lanes, and lines of the log."""
        for plot in plots:
            for curve in plot.curves:
                self._rr.send_columns(f"{plot.origin}/{curve.path}", [self._rr.TimeColumn(TIMELINE, duration=curve.t)],
                                      self._rr.Scalars.columns(scalars=curve.values), recording=self._stream)
        for lane in lanes:
            path = make_lane_path(lane.path)
            if lane.colours:
                self._stream.log(path, self._rr.StateConfiguration(
                    values=[*lane.colours], labels=[lane.labels.get(value, value) for value in lane.colours],
                    colors=np.array([*lane.colours.values()], np.uint32)), static=True)
            for t, state in lane.states:
                self._stream.set_time(TIMELINE, duration=t)
                self._stream.log(path, self._rr.StateChange(state=state))
        for text in texts:
            self._stream.set_time(TIMELINE, duration=text.t)
            self._stream.log(text.path, self._rr.TextLog(text.text, level=text.level))


def write_recording(drawing: Drawing, path: Path) -> None:
    """Write a drawing with its blueprint as a recording of the viewer.

    Raises:
        ViewerError: rerun is not installed.
        InputError: a place that cannot be written.
    """
    rr = import_rerun()
    require_writable(path, "the recording")
    with rr.RecordingStream("eha-rig", recording_id=path.stem) as stream:
        stream.save(path, default_blueprint=build_blueprint(drawing))
        Recording(stream, drawing)
        stream.flush()


def make_lane_path(lane: str) -> str:
    """Path of a lane, which the viewer shows as its name; other characters would be shown with backslashes.

    >>> make_lane_path("check/pass/lag, 1 Hz / unloaded")
    'check/pass/lag_1_Hz_unloaded'
    """
    return re.sub(r"[^A-Za-z0-9./-]+", "_", lane.replace(" / ", " "))


def build_blueprint(drawing: Drawing, play_state: Literal["paused", "following"] = "paused") -> Any:
    """The window: plots in columns and the checks beside them, below them the other lanes and the texts.

    What one view shows of the time, all show. The viewer stands at the beginning, "paused", or follows new data.
    """
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

    time_axis = rrb.TimeAxis(link="LinkToGlobal")
    views = [rrb.TimeSeriesView(origin=f"/{plot.origin}", name=plot.title, axis_x=time_axis, axis_y=_choose_axis(plot),
                                plot_legend=rrb.PlotLegend("RightTop")) for plot in drawing.plots]
    columns: list[Any] = [rrb.Vertical(*views[k:k + 2]) for k in range(0, len(views), 2)]  # lower ones lack numbers
    groups = [make_lane_path(lane.path).partition("/")[0] for lane in drawing.lanes]

    def view_lanes(title: str, names: Sequence[str]) -> Any:
        return rrb.StateTimelineView(origin="/", contents=[f"/{name}/**" for name in names], name=title,
                                     time_view=time_axis)

    others = [group for group in groups if group != "check"]
    shares = [1.0] * len(columns)
    if len(others) < len(groups):
        columns.append(view_lanes(CHECKS, ["check"]))
        shares.append(1.3)
    title, _ = drawing.document
    text: Any = rrb.TextDocumentView(origin=f"/log/{title.lower()}", name=title)
    if drawing.log is not None:
        log_columns = rrb.TextLogColumns(timeline_columns=[TimelineColumn(TIMELINE, visible=False)],
                                         text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")])
        text = rrb.Tabs(rrb.TextLogView(contents=["/log/events", "/log/checks"], name=TEXTS, columns=log_columns), text)
    below = rrb.Horizontal(view_lanes(drawing.lanes_title, [*dict.fromkeys(others)]), text)
    height = min(max((75 + 40 * len(others)) / 1080, 0.3), 0.45)  # a lane has 40 of the window's 1080 pixels
    window = rrb.Vertical(rrb.Horizontal(*columns, column_shares=shares), below,
                          row_shares=[1 - height, height]) if columns else below
    return rrb.Blueprint(window, rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state=play_state),
                         rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"))


def _choose_axis(plot: Plot) -> Any:
    """The value axis of a plot; None is the viewer's own choice, for where it prints enough numbers.

    The timing view ends where nearly all cycles do: one long pause of the machine must not flatten the rest.
    """
    import rerun.blueprint as rrb

    numbers = [values for curve in plot.curves if len(values := curve.values[~np.isnan(curve.values)])]
    if not numbers:
        return None
    if plot.origin == "timing":
        return rrb.ScalarAxis(range=(0.0, 1.5 * max(float(np.percentile(values, 99.5)) for values in numbers)))
    wider = widen_range(min(float(values.min()) for values in numbers), max(float(values.max()) for values in numbers))
    return rrb.ScalarAxis(range=wider) if wider else None


def widen_range(low: float, high: float) -> tuple[float, float] | None:
    """A wider range of an axis on which the viewer would print only one number; None if it prints more.

    The viewer prints powers of ten and their multiples, and a range such as -8 to 8 is too wide for the multiples of 1.

    >>> widen_range(-8.0, 8.0), widen_range(-6.0, 6.0), widen_range(0.0, 800.0), widen_range(0.0, 0.0)
    ((-10.0, 10.0), None, None, None)
    """
    span = high - low
    if not 0.0 < span < math.inf:
        return None
    step = 10.0 ** math.floor(math.log10(span))
    below, above = math.floor(low / step), math.ceil(high / step)
    is_sparse = 1.3 * step < span and math.floor(high / step) <= math.ceil(low / step)
    return (below * step, above * step) if is_sparse else None


VERDICTS = {"PASS": PASS, "FAIL": FAIL, "ABORTED": FAIL, "INVALID_TIMING": 0xD9A441FF, "CANNOT_TELL": 0xD9A441FF}
STATES = {"operational": PASS, "pre-operational": 0xD9A441FF, "stopped": FAIL, "boot-up": NEUTRAL}
PHASES = {"set-up": NEUTRAL, "main": MEASURED, "clean-up": NEUTRAL}
SECTIONS = {"hold": NEUTRAL, "step": MEASURED, "ramp": 0x2A8C82FF, "dynamic": 0x8E5BBFFF}
ACTIVE = {"active": FAIL}  # state of a fault
VALUE = 0x2B3138FF  # of the words beside the window of a check
LANES = "Faults, nodes, run"  # title of a view that is no plot
LIMITS_OF = {"never_exceeds", "max_error"}  # kinds of check whose limits are limits of the plotted line


DRIVE, LOAD = 0xB57EDCFF, 0xD9A441FF
OUTPUTS = (MEASURED, 0x45B8ACFF, 0xD96BA0FF, 0x9ACD5BFF, 0x6FA8DCFF)  # the controlled one first
Plots = dict[tuple[str, str], tuple[tuple[str, float, Curve], ...]]  # origin, title -> signals, scales from SI, lines


@cache
def list_plots(signals: Signals) -> Plots:
    """The plots of a run of the plant that has these signals."""
    command, controlled, drive = signals.command, signals.controlled, signals.drive
    moves = "Position" if controlled.unit == "m" else controlled.quantity.capitalize()
    size, fine = choose_unit(controlled.unit, 0.0)
    symbol, unit, scale = controlled.symbol, controlled.shown_unit, controlled.shown_scale
    plots: Plots = {
        ("position", f"{moves} [{unit}]"): (
            (command.name, scale, Curve("command", f"{command.symbol} command [{unit}]", COMMAND, width=4.0)),
            (controlled.name, scale, Curve(
                controlled.called, f"{' '.join(dict.fromkeys((symbol, controlled.called)))} [{unit}]", MEASURED))),
        ("error", f"Following error [{fine}]"): (
            ("error", 1.0 / size, Curve("error", f"{command.symbol} - {symbol} [{fine}]", 0xE8A33DFF)),)}
    others = [(drive, DRIVE), *((s, OUTPUTS[k % len(OUTPUTS)]) for k, s in enumerate(signals.outputs) if k)]
    for signal, colour in [*others, *([(signals.load, LOAD)] if signals.load else [])]:
        title = f"{signal.quantity[:1].upper()}{signal.quantity[1:]} [{signal.shown_unit}]"
        name = " ".join(dict.fromkeys((signal.symbol, signal.called)))
        plots[signal.called, title] = ((signal.name, signal.shown_scale, Curve(
            signal.called, f"{name} [{signal.shown_unit}]", colour)),)
    return plots | {("timing", "Cycle timing [us]"): (
        ("lateness", 1e6, Curve("lateness", "SYNC lateness [us]", 0xF2C94CFF, width=1.0)),
        ("response", 1e6, Curve("response", "controller's response [us]", 0x7FD46BFF, width=1.0)),
        ("work", 1e6, Curve("work", "bench's own work [us]", 0x8C7AE6FF, width=1.0)))}


def draw_run(trace: Trace) -> Drawing:
    """Draw a trace; set-up has negative times, main starts at 0."""
    layout = list_plots(trace.declared)
    plots = [plot._replace(curves=[*plot.curves, *_list_limits(plot.origin, trace.checks, layout)])
             for plot in draw_signals(list_columns(trace), layout)]
    facts = "\n".join(f"- {key}: {value}" for key, value in trace.provenance.items())
    name = trace.provenance.get("sequence", trace.provenance.get("source", "trace"))
    return Drawing(name, plots, LANES, [*_list_lanes(trace)], ("Provenance", facts), [
        *(describe_event(event.t, event.level, event.kind, event.text) for event in trace.events),
        *(describe_check(check, float(trace.t[-1])) for check in trace.checks)])


def list_columns(trace: Trace) -> dict[str, tuple[Floats, Floats]]:
    """Signal -> times, s, and values in SI; signals without a value are left out, and lateness that is 0 throughout."""
    timing = trace.timing
    columns = {**{name: (trace.t, column) for name, column in trace.columns.items()},
               "error": (trace.t, trace.command - trace.controlled),
               **{name: (timing.t, getattr(timing, name)) for name in ("lateness", "response", "work")}}
    seldom = {"lateness", *([trace.declared.load.name] if trace.declared.load else [])}
    return {name: (t, values) for name, (t, values) in columns.items() if not np.isnan(values).all()
            and (name not in seldom or np.nan_to_num(values).any())}  # in lockstep nothing is ever late


def draw_signals(columns: Mapping[str, tuple[Floats, Floats]], layout: Plots) -> list[Plot]:
    """The plots of the signals that there are."""
    plots = [Plot(origin, title, [
        curve._replace(t=columns[signal][0], values=columns[signal][1] * scale)
        for signal, scale, curve in lines if signal in columns]) for (origin, title), lines in layout.items()]
    return [plot for plot in plots if plot.curves]


def _list_limits(origin: str, checks: tuple[CheckResult, ...], layout: Plots) -> Iterator[Curve]:
    """Limits of a plotted signal as red lines over the check's window."""
    scales = {signal: scale for (own, _), lines in layout.items() for signal, scale, _ in lines if own == origin}
    for number, check in enumerate(checks):
        signal = "error" if check.kind == "max_error" else check.signal
        if check.kind in LIMITS_OF and signal in scales and not math.isnan(check.t0 + check.high):
            level = check.high * (float(UNITS[check.unit].factor) if check.unit in UNITS else 1.0) * scales[signal]
            for name, sign in (("high", 1.0), ("low", -1.0)):  # both kinds judge the size of the signal
                yield Curve(f"limit_{number}_{name}", f"limit: {check.name}", LIMIT, np.array([check.t0, check.t1]),
                            np.full(2, sign * level))


def _list_lanes(trace: Trace) -> Iterator[Lane]:
    """Verdict, phase, sections of the command, each node's NMT state, each fault, each check over its window."""
    yield from list_verdict_lanes(trace, "run", 0.0)
    turns = np.flatnonzero(np.diff(trace.phase, prepend=-1))
    yield Lane("run/phase", [(float(trace.t[k]), [*PHASES][trace.phase[k]]) for k in turns], PHASES)
    yield make_command_lane(trace, "run", 0.0)
    for node in sorted({state.node for state in trace.nmt}):
        name = trace.provenance.get(f"nodes.{node}")
        yield Lane(name_node_lane(node, name), [(s.t, s.name) for s in trace.nmt if s.node == node], STATES)
    yield from list_fault_lanes(trace, "fault/", 0.0)
    yield from (_make_check_lane(check, trace) for check in trace.sequence_checks)


def list_verdict_lanes(trace: Trace, group: str, offset: float) -> list[Lane]:
    """The verdict of a run, if it has one, `offset` s later than in the trace."""
    result = read_verdict(trace)
    return [Lane(f"{group}/verdict", [(float(trace.t[0]) + offset, str(result))], {str(result): VERDICTS[result.word]})
            ] if result.word in VERDICTS else []


def make_command_lane(trace: Trace, group: str, offset: float) -> Lane:
    """The sections of the command, `offset` s later than in the trace."""
    sections = [(float(trace.t[s.start]) + offset, s.kind, _describe_section(s, trace.declared.command))
                for s in trace.sections()]
    return Lane(f"{group}/command", [(t, text) for t, _, text in sections],
                {text: SECTIONS[kind] for _, kind, text in sections})


def list_fault_lanes(trace: Trace, prefix: str, offset: float) -> list[Lane]:
    """When each fault begins and ends, from the events of the run, `offset` s later than in the trace."""
    return [Lane(f"{prefix}{label}", [(t0 + offset, "active"), (t1 + offset, "")], ACTIVE)
            for label, t0, t1 in list_faults(trace)]


def name_node_lane(node: int, name: str | None = None) -> str:
    """Path of the lane of a node; the name of a log that has none is that of the shipped bench.

    >>> name_node_lane(2), name_node_lane(5, "node 5 controller")
    ('node/2 controller', 'node/5 controller')
    """
    word = NAMES.get(node, "") if name is None else name.split()[-1]
    return f"node/{node} {word}".strip()


def read_fault_event(text: str) -> tuple[str, str] | None:
    """Label of a fault and its state from now on, from the text of an event of the kind "fault"; None for other texts.

    >>> read_fault_event("leakage begins"), read_fault_event("leakage ends"), read_fault_event("leakage")
    (('leakage', 'active'), ('leakage', ''), None)
    """
    label, _, word = text.rpartition(" ")
    states = {"begins": "active", "ends": ""}
    return (label, states[word]) if word in states else None


def _make_check_lane(check: CheckResult, trace: Trace) -> Lane:
    """A lane with the window of a check, failed checks first; grey is a window that the run did not reach.

    Verdict and value stand beside the window, on its longer side, because a window may be too short for a number; in
    the window if it has more room than either side.
    """
    unreached = math.isnan(check.t0) and math.isnan(check.value)
    first, last = float(trace.t[0]), float(trace.t[-1])
    start, stop = check.t0, check.t1
    if math.isnan(start):
        main = trace.t[trace.phase == MAIN]
        start, stop = (float(main[0]), float(main[-1]) + trace.period) if len(main) else (first, last)
    word, colour = check.verdict, NEUTRAL if unreached else VERDICTS[check.verdict]
    is_unknown = math.isnan(check.value) and check.detail
    text = f"{word} {f'{check.measured}: {check.detail}' if is_unknown else _describe_measurement(check)}"
    path = f"check/{'pass' if check.passed else word}/{check.name}"
    if stop - start > max(start - first, last - stop):
        return Lane(path, [(start, text), (stop, "")], {text: colour})
    states = [(first, text), (start, word), (stop, "")] if start - first > last - stop else [(start, word),
                                                                                             (stop, text)]
    return Lane(path, states, {text: VALUE, word: colour}, {word: " "})


def _describe_section(section: Section, command: Signal) -> str:
    scale, unit = command.shown_scale, command.shown_unit
    if section.kind == "ramp":
        return f"ramp {section.rate * scale:.3g} {unit}/s"
    return section.kind if section.kind == "dynamic" else f"{section.kind} {section.last * scale:.3g} {unit}"


def _describe_measurement(check: CheckResult) -> str:
    return f"{check.measured} (limit {check.shown_limits})"


def describe_event(t: float, level: str, kind: str, text: str) -> LogText:
    """The line about an event at `t` s."""
    return LogText("log/events", t, f"{t:8.3f} s  {kind}: {text}", level)


def describe_check(check: CheckResult, otherwise: float) -> LogText:
    """The line about a check, where its window begins or, if it has none, `otherwise` s."""
    t = otherwise if math.isnan(check.t0) else check.t0
    text = f"{t:8.3f} s  {check.verdict} {check.name}: {_describe_measurement(check)} {check.detail}".rstrip()
    return LogText("log/checks", t, text, "INFO" if check.passed else "ERROR")


def format_document(report: Report) -> str:
    """A report as the command prints it, in Markdown."""
    return f"```text\n{format_report(report)}```"


REFERENCE, NOISE = COMMAND, 0x7FD46BFF
COLOURS = (0xE8A33DFF, 0xD96BA0FF, 0x45B8ACFF, 0xB57EDCFF, 0x3D8FE0FF)  # of the runs after the first, in rotation


def draw_runs(differences: RunDifferences) -> Drawing:
    """Draw runs and their differences, on the time of the first run: two plots for each signal, below each other."""
    plots: list[Plot] = []
    for name, (size, unit) in choose_difference_units(differences).items():
        signal = differences.runs[0].trace.declared.find(name)
        plots += [Plot(name, label_signal(signal), _draw_signal(differences, name, signal.shown_scale)),
                  Plot(f"difference_{name}", f"{signal.symbol} minus that of A [{unit}]",
                       _draw_difference(differences, name, 1.0 / size))]
    return Drawing(join_words([run.source for run in differences.runs]), plots, "Runs",
                   [*_list_lanes_of_runs(differences)], ("Result", format_document(build_diff_report(differences))),
                   verdict=differences.verdict)


def _draw_signal(differences: RunDifferences, name: str, scale: float) -> list[Curve]:
    offsets = [0.0, *(pair.offset for pair in differences.pairs)]
    return [Curve(f"{number:02}_{run.label}", f"{run.label} {_shorten_source(run)}", _choose_colour(number),
                  run.trace.t + offset, run.trace.column(name) * scale, 1.5 if number else 4.0)
            for number, (run, offset) in enumerate(zip(differences.runs, offsets, strict=True))
            if name in run.trace.signals]


def _draw_difference(differences: RunDifferences, name: str, scale: float) -> list[Curve]:
    pairs = [(number, pair, signal) for number, pair in enumerate(differences.pairs, 1) for signal in pair.signals
             if signal.name == name]
    curves = [Curve(f"{number:02}_{pair.run.label}", f"{pair.run.label} - A", _choose_colour(number), pair.t,
                    pair.differences[name] * scale) for number, pair, _ in pairs]
    band = max((NOISE_BAND_RATIO * math.hypot(*signal.noise) * scale for _, _, signal in pairs), default=0.0)
    return curves + [Curve(f"noise_{side}", f"noise of both runs, {NOISE_BAND_RATIO:g} SD", NOISE,
                           differences.runs[0].trace.t[[0, -1]], np.full(2, sign * band))
                     for side, sign in (("high", 1.0), ("low", -1.0))]


def _choose_colour(number: int) -> int:
    return COLOURS[(number - 1) % len(COLOURS)] if number else REFERENCE


def _shorten_source(run: Run) -> str:
    """The last folder or file name of the user's text.

    >>> _shorten_source(Run("B", "runs/clogged/trace.mcap", None)), _shorten_source(Run("B", "before.csv", None))
    ('clogged', 'before.csv')
    """
    path = Path(run.source)
    return path.parent.name or path.name if path.name == "trace.mcap" else path.name


def _list_lanes_of_runs(differences: RunDifferences) -> Iterator[Lane]:
    """Verdict and faults of each run, and the command of each run that has another one than the first."""
    for run, pair in zip(differences.runs, [None, *differences.pairs], strict=True):
        offset = pair.offset if pair else 0.0
        yield from list_verdict_lanes(run.trace, run.label, offset)
        if pair is None or not pair.has_same_command:
            yield make_command_lane(run.trace, run.label, offset)
        yield from list_fault_lanes(run.trace, f"{run.label}/fault ", offset)


BEFORE, FLOOR = 0xE5534BFF, MEASURED
MODELS = (0xE8A33DFF, 0x45B8ACFF, 0xD96BA0FF, 0x9ACD5BFF, 0x6FA8DCFF)
RESIDUALS = (0xC2A83EFF, 0x7FD46BFF, 0xB57EDCFF, 0x5FAF8FFF, 0x8FA3D9FF)
NOT_JUDGED = "not judged"


def draw_comparison(c: Comparison, before: Comparison | None) -> Drawing:
    """Draw a comparison, and that with the model before a change: two plots for each signal, below each other."""
    models = ([("before", before)] if before else []) + [("model", c)]
    plots = [draw(name, [(word, comparison) for word, comparison in models if name in comparison.signals])
             for name in c.signals for draw in (_draw_replay, _draw_residual)]
    lanes = [make_command_lane(c.trace, "run", 0.0),
             *(_make_error_lane(word, comparison) for word, comparison in models), *_list_left_out(c)]
    text_before = f"\n\nBefore the change:\n\n{format_document(build_comparison_report(before))}" if before else ""
    text = format_document(build_comparison_report(c)) + text_before
    return Drawing(f"{c.source}, {c.model.name}", plots, "Command and error", lanes, ("Result", text),
                   verdict=c.verdict)


def _draw_replay(name: str, models: Sequence[tuple[str, Comparison]]) -> Plot:
    """Measured, and what each model makes of the measured current."""
    trace = models[-1][1].trace
    signal, scale = trace.declared.find(name), trace.declared.find(name).shown_scale
    colour = MODELS[trace.output_names.index(name) % len(MODELS)]
    model = f"model, from the {trace.declared.drive.phrase}"
    return Plot(name, label_signal(signal), [
        Curve("1_measured", f"{signal.symbol} measured", COMMAND, trace.t, trace.mask_unusable(name) * scale, 4.0),
        *(Curve(f"{number}_{word}", "before the change" if word == "before" else model,
                BEFORE if word == "before" else colour, comparison.trace.t, comparison.replay.model[name] * scale)
          for number, (word, comparison) in enumerate(models, 2))])


def _draw_residual(name: str, models: Sequence[tuple[str, Comparison]]) -> Plot:
    """Measured minus model, and the band of the noise floor."""
    last = models[-1][1]
    signal, colour = last.signals[name].signal, RESIDUALS[last.trace.output_names.index(name) % len(RESIDUALS)]
    unit, scale = choose_drawn_unit(signal, max(comparison.signals[name].error for _, comparison in models))
    floor = NOISE_BAND_RATIO * last.signals[name].floor.value * scale
    return Plot(f"residual_{name}", f"Residual of {signal.symbol}, measured minus model [{unit}]", [
        *(Curve(f"{number}_{word}", "before the change" if word == "before" else "residual",
                BEFORE if word == "before" else colour, comparison.trace.t, comparison.replay.residual[name] * scale)
          for number, (word, comparison) in enumerate(models, 1)),
        *(Curve(f"3_floor_{side}", f"noise floor, {NOISE_BAND_RATIO:g} SD", FLOOR, last.trace.t[[0, -1]],
                np.full(2, sign * floor)) for side, sign in (("high", 1.0), ("low", -1.0)))])


def _list_left_out(c: Comparison) -> Iterator[Lane]:
    """The rows that are not judged."""
    left_out = c.replay.undecided | ~c.trace.usable
    if left_out.any():
        turns = np.flatnonzero(np.diff(left_out.astype(int), prepend=0))
        states = [(float(c.trace.t[k]), NOT_JUDGED if left_out[k] else "") for k in turns]
        yield Lane(f"run/{NOT_JUDGED}", states, {NOT_JUDGED: NEUTRAL})


def _make_error_lane(word: str, c: Comparison) -> Lane:
    """The error in each section of the command, over its noise floor."""
    places = sorted(c.where, key=lambda place: place.t0)
    colours = {format_ratio(place.ratio): FAIL if place.ratio > SIGNAL_ERROR_RATIO else PASS for place in places}
    states = []
    for place, following in zip(places, [*places[1:], None], strict=True):
        states.append((place.t0, format_ratio(place.ratio)))
        if following is None or following.t0 > place.t1 + 1e-9:  # no state begins where this one ends
            states.append((place.t1, ""))
    return Lane(f"error over floor/{word}", states, colours)
