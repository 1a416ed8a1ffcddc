"""The report of `rig explain`: the missing effect, the ranked candidates, what the test cannot detect."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdi.discovery.explain_runs import Answer, Candidate, Suspicious
from fdi.discovery.residual_pattern import find_smooth_rows
from fdi.discovery.runs import Source
from fdi.discovery.search import Hypothesis
from fdi.discovery.update_model import ModelUpdate, Row
from fdi.estimation.fit import Value
from fdi.report.compare_report import OTHER_ACTUATOR
from fdi.report.drawing import (
    ABOVE,
    COMMAND,
    INK,
    choose_drawn_unit,
    label_log_axis,
    shade_sections,
    start_figure,
    thin_line,
    to_svg,
)
from fdi.report.numbers import (
    NO_NUMBER,
    SIGNAL_NAMES,
    format_amount,
    format_interval,
    format_p_value,
    format_ratio,
    format_signal,
    join_words,
    name_parameter,
)
from fdi.report.report import Cell, Column, Figure, Item, Line, Listing, Medium, Mood, Report, Section, Table
from fdi.thresholds import NOISE_BAND_RATIO
from fdi.trace.trace import Trace, rms

if TYPE_CHECKING:
    from fdi.discovery.laws.find_law import Law, LawCurve, LawSearch, Missing
    from fdi.discovery.residual_pattern import Pattern


MOODS: dict[str, Mood] = {"NOTHING_MISSING": "good", "EXPLAINED": "good", "PARTLY": "doubtful", "AMBIGUOUS": "doubtful",
                          "NOT_RESOLVABLE": "doubtful", "UNEXPLAINED": "bad"}
WORD_MOODS: dict[str, Mood] = {"explains": "good", "equal": "doubtful", "part": "doubtful"}
NAMED_MOST = 4  # effects or parameters that a line names before it counts the rest


def build_explanation_report(a: Answer, title: str, model: str, sources: Sequence[Source], command: str = "",
                       next_command: str = "", pattern: Pattern | None = None, notes: Sequence[str] = (),
                       files: Sequence[tuple[str, str]] = ()) -> Report:
    """The report of an explanation.

    Args:
        a: the answer.
        title: the name of the explained run.
        model: the name of the model.
        sources: the runs, the explained one first, a held-out one last.
        command: what the user typed.
        next_command: what to type next.
        pattern: shape of the residual, where it was looked for.
        notes: what a reader must know about the runs.
        files: (label, path) of what was written.
    """
    parameters = list_parameters(p for c in _named_candidates(a) for p in c.parameters.items())
    sections = [
        Section("Candidates", [_tabulate_candidates(a)] if a.candidates else []),
        Section("Parameters of the missing effect", [parameters] if parameters.rows else [], medium=Medium.PAGE),
        Section("Findings", describe_findings(a)),
        *(list_law_sections(a.law) if a.law is not None else []),
        *_show_figures(a, pattern),
        *list_suspicious(a.suspicious),
        Section("What this test cannot detect", [_tabulate_blind(a)] if a.blind else [], medium=Medium.PAGE),
        Section("Provenance", [Listing(command, medium=Medium.PAGE)] if command else [])]
    facts = [("model", model), *list_sources(sources, bool(a.baseline["holdout"]))]
    notes = [*notes, *([a.explanation.excerpt] if a.explanation.excerpt else []), *_describe_rounding(a)]
    return Report("explain", title, a.verdict, MOODS[a.verdict], describe_verdict(a), facts, notes, sections,
                  next_command, files, collect_data(a, notes))


def describe_verdict(a: Answer) -> str:
    """The verdict in a sentence or two: the effect, its size, and the error before and after beside the noise floor."""
    describe = {"NOTHING_MISSING": _describe_nothing_missing, "EXPLAINED": _describe_explained,
                "AMBIGUOUS": _describe_ambiguous, "PARTLY": _describe_partly, "UNEXPLAINED": _describe_unexplained,
                "NOT_RESOLVABLE": _describe_not_resolvable}
    return describe[a.verdict](a)


def _describe_nothing_missing(a: Answer) -> str:
    return f"Nothing is missing: the residual is noise ({_errors_and_floors(a)})."


def _describe_explained(a: Answer) -> str:
    named = _named_candidates(a)
    verb = "together explain" if len(named) > 1 else "explains"
    return (f"{join_words(c.effect for c in named)} {verb} the residual: {_describe_all_sizes(named)}; "
            f"{_describe_change(a, named[-1])}.")


def _describe_ambiguous(a: Answer) -> str:
    return (f"{join_words(a.explanation.effects, 'or')}: each explains the residual, and these data cannot "
            f"discriminate between them; {_describe_change(a, a.candidates[0])}.")


def _describe_partly(a: Answer) -> str:
    named = _named_candidates(a)
    if not named:
        return _describe_unexplained(a)
    verb = "explain" if len(named) > 1 else "explains"
    subject = f"{join_words(c.effect for c in named)} {verb}"
    rest = f"{_describe_all_sizes(named)}; {_describe_change(a, named[-1])}."
    if a.best.is_at_floor and a.best.is_far:
        return (f"{subject} the residual only with tolerances that fewer than one healthy unit in 1,000 has: {rest} "
                "Something else may be missing instead.")
    return f"{subject} part of the residual: {rest} Something else is missing too."


def _describe_unexplained(a: Answer) -> str:
    if a.explanation.base.is_at_floor and not a.explanation.effects:
        return ("The output of the controller differs from the model's, and no effect of the catalogue explains the "
                "difference.")
    worst = _find_worst_signal(a)
    sentence = (f"No effect of the catalogue explains the residual: {SIGNAL_NAMES[worst]} error "
                f"{_format(a.baseline['error'], worst)}, noise floor {_format(a.baseline['floor'], worst)}")
    best = min(a.candidates, key=lambda c: c.ratio, default=None)
    return f"{sentence}; the best, {best.effect}, leaves {_format(best.error, worst)}." if best else f"{sentence}."


def _describe_not_resolvable(a: Answer) -> str:
    c = a.candidates[0]
    return (f"The error is at the noise floor ({_errors_and_floors(a)}). {c.effect} may be present "
            f"({_describe_sizes(c)}), but it is too small in this test to be certain.")


def _named_candidates(a: Answer) -> list[Candidate]:
    return [c for c in a.candidates if c.effect in a.explanation.effects]


def _describe_all_sizes(named: Sequence[Candidate]) -> str:
    if len(named) == 1:
        return _describe_sizes(named[0])
    return "; ".join(f"{c.effect}: {_describe_sizes(c)}" for c in named)


def _describe_sizes(c: Candidate, most: int = 2) -> str:
    return ", ".join(describe_parameter(name, v) for name, v in list(c.parameters.items())[:most])


def describe_parameter(name: str, v: Value) -> str:
    """A parameter with its 95 % interval."""
    return f"{name_parameter(name)} {format_interval(v.value, v.low, v.high, v.unit)}"


def _find_worst_signal(a: Answer) -> str:
    """The signal that the model without further effects explains worst."""
    error, floor = a.baseline["error"], a.baseline["floor"]
    return max(error, key=lambda s: error[s] / floor[s] if floor.get(s) else 0.0)


def _describe_change(a: Answer, c: Candidate) -> str:
    """Error before and after, noise floor, held-out run."""
    s = _find_worst_signal(a)
    sentence = (f"{SIGNAL_NAMES[s]} error {_format(a.baseline['error'], s)} -> {_format(c.error, s)}, noise floor "
                f"{_format(a.baseline['floor'], s)}")
    return sentence + (f"; held-out run {_format(c.holdout, s)}" if s in c.holdout else "")


def _errors_and_floors(a: Answer) -> str:
    error, floor = a.baseline["error"], a.baseline["floor"]
    return "; ".join(f"{SIGNAL_NAMES[s]} error {_format(error, s)}, noise floor {_format(floor, s)}" for s in error)


def _format(by_signal: Mapping[str, float], signal: str) -> str:
    return format_signal(by_signal.get(signal, math.nan), signal)


def describe_findings(a: Answer) -> list[Line]:
    """Labelled lines: how to discriminate, the shape of the residual, suspicious parameters, what is not detectable."""
    lines = []
    if a.separate:
        lines.append(Line("to discriminate", f"{a.separate['by']}: in simulation this discriminates between "
                                             f"{join_words(a.separate['between'])}"))
    elif a.verdict == "AMBIGUOUS":
        lines.append(Line("to discriminate", "no sensor and no command that was tried discriminates between them"))
    if a.pattern:
        lines.append(Line("residual", a.pattern))
    if a.law is not None:
        lines += describe_law(a.law)
    if a.suspicious:
        lines.append(Line("suspicious", describe_suspicious(a.suspicious)))
    if a.verdict in ("PARTLY", "UNEXPLAINED") and a.best.is_far:
        lines.append(Line("another actuator?", OTHER_ACTUATOR))
    lines += [Line("held-out run", text) for text in _describe_undecided(a)]
    return [*lines, Line("not detectable", describe_blind(a))] if a.blind else lines


def _describe_undecided(a: Answer) -> list[str]:
    """Why a held-out run was not judged as a whole, if so."""
    held = a.explanation.unseen.get(a.best.effects)
    if held is None or not held.decided:
        return []
    floor = a.explanation.floor
    worst = max(held.decided[s] / floor[s] for s in held.decided)
    return [f"{held.undecided:.0%} of it is not judged, because stops of the ram or the spool there depend on a "
            f"thousandth of a friction level; the rest is at {format_ratio(worst)} times the noise floor"]


def _describe_rounding(a: Answer) -> list[str]:
    """A note where the recorder has rounded the position."""
    marks = a.explanation.marks
    if not marks.is_recorder:
        return []
    return [f"XJ is recorded in steps of {format_amount(marks.step, 'm')}, but Cor shows that the controller reads it "
            "finer: the rounding is noise of the recording and no effect"]


def describe_suspicious(found: Sequence[Suspicious]) -> str:
    """Parameters further from their nominal values than in any healthy unit."""
    worst = sorted(found, key=lambda s: -abs(s.tolerances))
    words = [f"{s.parameter} {format_amount(s.value, s.unit)} ({s.tolerances:+.1f} tolerances)"
             for s in worst[:NAMED_MOST]]
    more = f" and {len(worst) - NAMED_MOST} more" if len(worst) > NAMED_MOST else ""
    return f"{', '.join(words)}{more}: outside the range of a healthy unit"


def describe_blind(a: Answer) -> str:
    """The effects that the tolerances make up for up to their usual size, and what would reveal each of them."""
    named = join_words(f"{b.effect} (up to {format_amount(b.usual, b.unit)})" for b in a.blind)
    aids = dict.fromkeys(b.revealed_by for b in a.blind)
    revealed = [f"{aid} would reveal {join_words(b.effect for b in a.blind if b.revealed_by == aid)}" for aid in aids]
    return "; ".join([named, *revealed])


def _tabulate_candidates(a: Answer, most: int = 8) -> Table:
    """The candidates, best first, below the model without any further effect."""
    signals = list(a.explanation.floor)
    has_holdout = any(c.holdout for c in a.candidates)
    terminal, page = Medium.TERMINAL, Medium.PAGE
    columns = [Column("effect"), Column("result"), *(Column(SIGNAL_NAMES[s], align="right") for s in signals)]
    if has_holdout:
        columns.append(Column("held-out run", align="right", medium=terminal))
        columns += [Column(f"{SIGNAL_NAMES[s]}, held-out run", align="right", medium=page) for s in signals]
    columns += [Column("evidence", align="right"), Column("p", align="right"), Column("size", medium=page)]
    rows = [_baseline_row(a, signals, has_holdout)]
    rows += [_candidate_row(a, c, signals, has_holdout) for c in a.explanations]
    caption = ("Signals: repeatable part of the error over its noise floor (1: noise alone). Held-out run: error of "
               "the worst signal over its noise floor (on the page: that of each signal). Evidence: gain in log "
               "likelihood minus a penalty for parameters and candidates. p: probability of such a gain where nothing "
               "is missing.")
    return Table(columns, rows, caption, terminal_rows=most + 1)


def _baseline_row(a: Answer, signals: Sequence[str], has_holdout: bool) -> list[Cell | str]:
    before = a.explanation.base.ratio
    texts = ["no effect", "", *(format_ratio(before[s]) for s in signals)]
    if has_holdout:
        texts += _format_holdout(a, a.baseline["holdout"], signals)
    return [Cell(text, "muted") for text in [*texts, "", "", ""]]


def _candidate_row(a: Answer, c: Candidate, signals: Sequence[str], has_holdout: bool) -> list[Cell | str]:
    mood = WORD_MOODS.get(c.word, "muted")
    row: list[Cell | str] = [Cell(" + ".join([*c.beside, c.effect]), is_strong=mood != "muted"), Cell(c.word, mood)]
    row += [format_ratio(c.ratios[s]) if s in c.ratios else NO_NUMBER for s in signals]
    if has_holdout:
        row += _format_holdout(a, c.holdout, signals)
    sizes = ", ".join(describe_parameter(name, v) for name, v in c.parameters.items())
    return [*row, f"{c.evidence:.0f}", format_p_value(c.p_value), Cell(sizes, "muted")]


def _format_holdout(a: Answer, holdout: Mapping[str, float], signals: Sequence[str]) -> list[str]:
    """Errors of the held-out run over their noise floors: of the worst signal, then of each signal."""
    floor = a.explanation.floor
    ratios = {s: x / floor[s] for s, x in holdout.items() if s in floor}
    return [format_ratio(ratio) for ratio in (max(ratios.values(), default=math.nan),
                                              *(ratios.get(s, math.nan) for s in signals))]


def list_parameters(parameters: Any) -> Table:
    """A table of (name, value with its interval)."""
    rows = [[name, format_interval(v.value, v.low, v.high, v.unit)] for name, v in parameters]
    return Table([Column("parameter"), Column("value and 95 % interval")], rows, is_list=True)


def list_suspicious(found: Sequence[Suspicious]) -> list[Section]:
    """The table of suspicious parameters, for the page."""
    rows: list[list[Cell | str]] = [[s.parameter, format_amount(s.value, s.unit),
                                     Cell(f"{s.tolerances:+.1f}", "bad")] for s in found]
    columns = [Column("parameter"), Column("fitted value", align="right"), Column("tolerances", align="right")]
    table = Table(columns, rows,
                  "To explain the data, the fit had to move these parameters further than they differ between healthy "
                  "units.", is_list=True)
    return [Section("Suspicious parameters", [table] if rows else [], medium=Medium.PAGE)]


def list_sources(sources: Sequence[Source], has_holdout: bool) -> list[tuple[str, str]]:
    """(role, file) of each run."""
    roles = ["trace" if number == 0 else "repeat" for number in range(len(sources))]
    if has_holdout and len(sources) > 1:
        roles[-1] = "held-out run"
    return [(role, source.file) for role, source in zip(roles, sources, strict=True)]


def _show_figures(a: Answer, pattern: Pattern | None) -> list[Section]:
    e = a.explanation
    trace = e.search.problem.trace
    after = a.best if a.best is not e.base else None
    name = "with the missing effect" if e.effects else "with the best candidate"
    sections = [Section("Residual", [Figure(
        "Residual (measured minus model) of each signal, without and with the effect. Where the effect explains it, "
        "the blue line stays between the dotted lines (two noise floors). Shaded: ramps (blue) and dynamic sections "
        "(violet) of the command.", partial(draw_residuals, trace, e.base, after, e.floor, name))])]
    if pattern is not None and pattern.place:
        sections.append(Section("Shape of the residual", [Figure(
            "Left: the missing quantity over the state that it follows best, with two standard errors. Right: over "
            "time.",
            partial(draw_pattern, pattern, trace.t[find_smooth_rows(trace)]))]))
    if len(a.ledger) > 2:
        rows = [Row(*row) for row in a.ledger]
        sections.append(Section("Error after each effect", [Figure(
            "Error over noise floor after each effect, on the fitted and on the held-out run. An effect that lowers "
            "only the blue bar is overfitting.", partial(draw_ledger, rows, a.baseline["floor"]))]))
    if a.candidates:
        sections.append(Section("Ranking", [Figure(
            "Error over noise floor of the worst signal, for the best candidates. The right effect reaches the green "
            "line on both runs.", partial(draw_ranking, a.explanations, e.floor))]))
    return sections


def _tabulate_blind(a: Answer) -> Table:
    rows: list[list[Cell | str]] = [
        [Cell(b.effect, "bad"), Cell(name_parameter(b.parameter), "muted"), format_amount(b.usual, b.unit),
         b.revealed_by] for b in a.blind]
    return Table([Column("effect"), Column("parameter"), Column("not detectable up to", align="right"),
                  Column("would reveal it")], rows,
                 "Tolerances of a healthy unit make up for these effects, so this test says nothing about them.")


def collect_data(a: Answer, notes: Sequence[str] = ()) -> dict[str, Any]:
    """The answer of `rig explain --json`, with notes on the runs; SI units."""
    e = a.explanation
    data: dict[str, Any] = {
        "verdict": e.verdict, "effects": list(e.effects), "candidates": [_candidate_data(c) for c in a.candidates],
        "baseline": {**a.baseline, "ratio": e.base.ratio},
        "blind_to": [{"effect": b.effect, "parameter": b.parameter, "smallest_visible": None, "unit": b.unit,
                      "usual": b.usual, "revealed_by": b.revealed_by} for b in a.blind],
        "seen_without_noise": list(a.noiseless), "suspicious": [s._asdict() for s in a.suspicious],
        "separate": dict(a.separate), "pattern": a.pattern,
        "controller": {"error": e.marks.controller, "unit": "counts"}, "signals": {s: SIGNAL_NAMES[s] for s in e.floor},
        "notes": list(notes)}
    held = e.unseen.get(a.best.effects)
    if held is not None and held.decided:
        data["undecided"] = {"share": held.undecided, "holdout": dict(held.decided)}
    if a.law is not None:
        data["law_search"] = collect_law_data(a.law, a.law_effects)
    if e.excerpt:
        data["excerpt"] = e.excerpt
    if len(e.effects) > 1 and e.verdict != "AMBIGUOUS":
        data["ledger"] = [{"effect": effect, "error": error, "holdout": holdout} for effect, error, holdout in a.ledger]
    return data


def _candidate_data(c: Candidate) -> dict[str, Any]:
    row = c._asdict() | {"parameters": {name: v._asdict() for name, v in c.parameters.items()}, "ratio": c.ratio}
    return row | {"with": list(row.pop("beside"))}


Floats = NDArray[np.float64]

AXES = {"position": (1e3, "mm"), "speed": (1e3, "mm/s"), "pressure": (1e-5, "bar"), "spool": (1e6, "um"),
        "current": (1e3, "mA"), "time": (1.0, "s"), "spool_speed": (1e3, "mm/s"), "way": (1e3, "mm")}
BEFORE, AFTER, HELD, FLOOR = "#9aa4b1", "#1f6feb", "#d9730d", "#2b8a3e"


def draw_residuals(trace: Trace, before: Hypothesis, after: Hypothesis | None, floor: Mapping[str, float],
                   name_of_after: str = "with the missing effect") -> str:
    """The residual, measured minus model, of each signal over time, without and with the effects, below the command.

    (The residuals of a fit have the other sign: model minus measured.)
    """
    t, n = trace.t, len(trace)
    with start_figure(1.4 + 1.7 * len(trace.outputs)) as figure:
        heights = [0.8] + [1.2] * len(trace.outputs)
        axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        axes[0].plot(*thin_line(t, trace.com * 1e3), color=COMMAND, lw=1.6)
        axes[0].set_ylabel("Com [mm]")
        for i, (ax, name) in enumerate(zip(axes[1:], trace.outputs, strict=True)):
            unit, scale = choose_drawn_unit(name, rms(before.fit.residuals[i, :n]))
            line = thin_line(t, -before.fit.residuals[i, :n] * scale)
            ax.plot(*line, color=BEFORE, lw=0.9, label="model as it was")
            if after is not None:
                line = thin_line(t, -after.fit.residuals[i, :n] * scale)
                ax.plot(*line, color=AFTER, lw=0.9, label=name_of_after)
            for side in (-1, 1):
                ax.axhline(side * NOISE_BAND_RATIO * floor[name] * scale, color=FLOOR, lw=0.8, ls=":",
                           label="two noise floors" if side > 0 else None)
            ax.set_ylabel(f"{SIGNAL_NAMES[name]} [{unit}]")
        axes[1].legend(ncols=3, **ABOVE)
        for ax in axes:
            shade_sections(ax, trace)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(float(t[0]), float(t[-1]))
        figure.align_ylabels()
        return to_svg(figure, "left")


def draw_ranking(candidates: Sequence[Candidate], floor: Mapping[str, float], most: int = 12) -> str:
    """Error over noise floor of each candidate's worst signal, on the run and on the held-out one."""
    shown = list(candidates[:most])[::-1]
    with start_figure(0.9 + 0.34 * len(shown)) as figure:
        ax = figure.subplots()
        rows = np.arange(len(shown))
        held = [max((x / floor[s] for s, x in c.holdout.items() if s in floor), default=np.nan) for c in shown]
        own = [max(c.ratio, 1e-3) for c in shown]
        ax.barh(rows + 0.19, own, height=0.36, color=AFTER, label="this run")
        ax.barh(rows - 0.19, np.nan_to_num(held, nan=1e-3), height=0.36, color=HELD, label="held-out run")
        ax.axvline(1.0, color=FLOOR, lw=1.2, label="noise floor")
        ax.set_xscale("log")
        ax.set_xlim(0.8, 1.3 * float(np.nanmax([*own, *held, 2.0])))
        label_log_axis(ax.xaxis)
        ax.set_yticks(rows, [" + ".join([*c.beside, c.effect]) for c in shown])
        ax.set_xlabel("error of the worst signal over its noise floor")
        ax.legend(ncols=3, **ABOVE)
        return to_svg(figure, "ranking")


def draw_ledger(rows: Sequence[Row], floor: Mapping[str, float]) -> str:
    """Error over noise floor of each signal after each effect, on the fitted run and on the held-out one."""
    signals = [s for s in floor if s in rows[0].error]
    with start_figure(2.9) as figure:
        axes = figure.subplots(1, len(signals), sharey=True, squeeze=False)[0]
        names = [name_step(row) for row in rows]
        for ax, s in zip(axes, signals, strict=True):
            x = np.arange(len(rows))
            own, held = ([by.get(s, np.nan) / floor[s] for by in side] for side in
                         ([r.error for r in rows], [r.holdout for r in rows]))
            ax.bar(x - 0.19, own, width=0.36, color=AFTER, label="fitted run")
            ax.bar(x + 0.19, held, width=0.36, color=HELD, label="held-out run")
            ax.axhline(1.0, color=FLOOR, lw=1.2)
            ax.set_yscale("log")
            label_log_axis(ax.yaxis)
            ax.set_xticks(x, names, rotation=20, ha="right")
            ax.set_title(SIGNAL_NAMES[s], fontsize=9, color=INK)
        axes[0].set_ylabel("error over noise floor")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
        return to_svg(figure, "ledger")


def name_step(row: Row) -> str:
    """What a step of the ledger did.

    >>> name_step(Row("null_bias", {}, {}))
    '+ null_bias'
    """
    if row.effect is None:
        return "model as it was"
    return f"{'-' if row.removed else '+'} {row.effect}"


def draw_pattern(p: Pattern, t: Floats) -> str:
    """The missing quantity over the state that it follows, and over time."""
    with start_figure(3.0) as figure:
        over, along = figure.subplots(1, 2, width_ratios=[1.0, 1.6])
        if len(p.at):
            state = p.state or "position"
            scale, unit = AXES[state]
            over.errorbar(scale * p.at, p.height, yerr=2.0 * p.doubt, color=HELD, lw=1.2, elinewidth=0.8)
            over.locator_params(axis="x", nbins=5)
            over.set_xlabel(f"{state} [{unit}]")
            if p.wave:
                amplitude, length, phase = p.wave
                x = np.linspace(0.0, length, 100)
                over.plot(scale * x, amplitude * np.sin(2.0 * np.pi * x / length + phase), color=AFTER, lw=1.0, ls="--")
                over.set_xlabel(f"{state} within a period of {scale * length:.4g} {unit}; dashed: a wave")
        over.set_ylabel(f"missing {p.place} [{p.unit}]")
        n = min(len(t), len(p.trace))
        along.plot(*thin_line(t[:n], p.trace[:n]), color=HELD, lw=0.8)
        along.set_xlabel("time [s]")
        return to_svg(figure, "shape")


def draw_law(c: LawCurve) -> str:
    """What is missing over the law's first state, in bins with two standard errors, and what the law says there."""
    with start_figure(3.2) as figure:
        ax = figure.subplots()
        scale, unit = AXES.get(c.state, (1e3, "mm"))
        low, high = c.height - 2.0 * c.doubt, c.height + 2.0 * c.doubt
        ax.fill_between(scale * c.at, low, high, color=HELD, alpha=0.25, lw=0.0, label="two standard errors")
        ax.plot(scale * c.at, c.height, "o", color=HELD, ms=3.5, label="measured")
        ax.plot(scale * c.at, c.law, color=AFTER, lw=1.4, label="law")
        name = "distance since the last reversal" if c.state == "way" else c.state.replace("_", " ")
        folded = f", folded on {scale * c.period:.4g} {unit}" if c.period else ""
        ax.set_xlabel(f"{name} [{unit}]{folded}")
        sign = f", times the sign of the {'speed' if c.along == 'direction' else c.along}" if c.along else ""
        ax.set_ylabel(f"missing {c.place} [{c.unit}]{sign}", fontsize=8)
        ax.legend(loc="best", frameon=False)
        return to_svg(figure, "law")


PLACES = {"force": "force on the ram", "flow": "flow to the jack", "current": "current in the torque motor"}


def list_law_sections(found: LawSearch) -> list[Section]:
    """The law with its terms, what error it leaves, what the residual follows, and the picture of both."""
    sections = []
    if found.law is not None and found.law.holds:
        sections += [Section("Law", [_tabulate_terms(found.law)]),
                     Section("Error with the law", [_tabulate_law_errors(found, found.law)])]
    if any(m.dependences for m in found.missing):
        sections.append(Section("What the residual follows", [_tabulate_dependences(found.missing)],
                                medium=Medium.PAGE))
    if found.curve is not None and found.law is not None and found.law.holds:

        sections.append(Section("Law and measurement", [Figure(
            f"Points: the missing {found.curve.place} in bins, with two standard errors. Line: the law in the same "
            "bins. The law holds where the line passes through the bars.", partial(draw_law, found.curve))]))
    return sections


def describe_law(found: LawSearch) -> list[Line]:
    """Labelled lines: the law or why there is none, and what the signals do not show."""
    lines = [Line("law", _describe_result(found))]
    reasons = [f"{PLACES[place]}: {why}" for place, why in found.hidden.items()]
    return [*lines, *(Line("not observable", reason) for reason in reasons)]


def _describe_result(found: LawSearch) -> str:
    law = found.law
    if law is None:
        return "no term lowers the error of pieces of the run that its fit did not see; none is written"
    names = " + ".join(term.words for term in law.terms)
    if not law.holds:
        return f"none holds: the best one tried was {names}, but {law.reason}; none is written"
    beside = f", beside {' and '.join(found.base.effects)}" if found.base.effects else ""
    equal = f"; {' or '.join(law.equals)} would fit as well" if law.equals else ""
    return f"{names}{beside}: {law.reason}{equal}"


def _tabulate_terms(law: Law) -> Table:
    from fdi.discovery.laws.terms import describe_formula

    rows: list[list[Cell | str]] = []
    for term in law.terms:
        for name, unit in zip(term.fields, term.units, strict=True):
            v = law.values[name]
            words = term.words if name == term.name else name.removeprefix(f"{term.name}_")
            rows.append([Cell(name, is_strong=name == term.name), words,
                         format_interval(v.value, v.low, v.high, unit)])
    return Table([Column("parameter"), Column("meaning"), Column("value and 95 % interval")], rows,
                 f"The law: {describe_formula(law.terms)}.", is_list=True)


def _tabulate_law_errors(found: LawSearch, law: Law) -> Table:
    signals = list(found.floor)
    has_holdout = bool(law.holdout)
    columns = [Column("model"), *(Column(SIGNAL_NAMES[s], align="right") for s in signals)]
    if has_holdout:
        columns += [Column(f"{SIGNAL_NAMES[s]}, held-out", align="right") for s in signals]
    rows: list[list[Cell | str]] = []
    for name, errors, held in list_errors(found, law):
        mood = "good" if name == "with the law" else ""
        row: list[Cell | str] = [Cell(name, "good" if mood else "", is_strong=bool(mood))]
        row += [_format_value(errors, s) for s in signals]
        rows.append([*row, *(_format_value(held, s) for s in signals)] if has_holdout else row)
    caption = ("Errors, RMS; of the held-out run those of the typical block (the worst 15 % are left out). The law "
               "explains what is missing where its error reaches the noise floor on both runs.")
    return Table(columns, rows, caption)


def list_errors(found: LawSearch, law: Law) -> list[tuple[str, Mapping[str, float], Mapping[str, float]]]:
    """(model, RMS errors on the fitted run, on the held-out run) without, with the catalogue's best, with the law."""
    rows = [("as it was", found.base.errors, found.holdout.get("base", {}))]
    if found.catalogue is not None:
        rows.append((f"with {' + '.join(found.catalogue.effects)}", found.catalogue.errors,
                     found.holdout.get("catalogue", {})))
    rows.append(("with the law", law.hypothesis.errors, law.holdout))
    return [*rows, ("noise floor", found.floor, found.floor)]


def _format_value(errors: Mapping[str, float], signal: str) -> str:
    return format_signal(errors[signal], signal) if signal in errors else "-"


def _tabulate_dependences(missing: Sequence[Missing]) -> Table:
    rows: list[list[Cell | str]] = []
    for m in missing:
        for d in m.dependences:
            held = "-" if d.holdout is None else f"{max(d.holdout, 0.0):.0%}"
            rows.append([PLACES[m.balance.place], " and ".join(d.states), f"{max(d.share, 0.0):.0%}", held,
                         f"{d.p_value:.3f}", format_ratio(m.balance.ratio)])
    columns = [Column("missing"), Column("follows"), Column("share", align="right"),
               Column("share, held-out run", align="right"), Column("p", align="right"),
               Column("size over noise", align="right")]
    caption = ("Share of the missing quantity that a curve over the state, or over the pair, predicts: in blocks of "
               "the run that the curve was not made from, and on the held-out run. p: probability that the best of all "
               "states and pairs does as well by chance. The pressure answers a missing force and the speed a missing "
               "flow: they follow it whatever its cause.")
    return Table(columns, rows, caption)


def collect_law_data(found: LawSearch, effects: Sequence[str]) -> dict[str, Any]:
    """The keys of `rig explain --json` about the law; SI units."""
    law = found.law
    data: dict[str, Any] = {
        "missing": [{"place": m.balance.place, "size": m.balance.size, "unit": m.balance.unit,
                     "over_noise": m.balance.ratio,
                     "follows": [{"states": list(d.states), "share": d.share, "holdout": d.holdout,
                                  "p_value": d.p_value} for d in m.dependences]} for m in found.missing],
        "not_observable": dict(found.hidden), "law": None}
    if law is None:
        return data
    from fdi.discovery.laws.terms import describe_formula

    terms = [{"term": t.name, "place": t.place, "meaning": t.words,
              "parameters": {f: law.values[f]._asdict() for f in t.fields}} for t in law.terms]
    data["law"] = {
        "holds": law.holds, "reason": law.reason, "formula": describe_formula(law.terms), "terms": terms,
        "beside": list(found.base.effects), "equal_terms": list(law.equals), "effects": list(effects),
        "errors": [{"model": name, "error": dict(errors), "holdout": dict(held)}
                   for name, errors, held in list_errors(found, law)]}
    return data


GOOD_RATIO = 1.15  # error over noise floor up to which a cell is green


def build_model_report(update: ModelUpdate, path: Path | None = None, backup: Path | None = None,
                       page: Path | None = None) -> Report:
    """The report of an update.

    Args:
        update: what was added or removed.
        path: the model file that was written; None for none.
        backup: where the file that was there before is now.
        page: the page to be written.
    """
    title = f"without {update.removed}" if update.removed else " + ".join(update.added)
    mood: Mood = "doubtful" if update.helps is False else "good"
    p = update.provenance
    lines = [Line(name, format_interval(v.value, v.low, v.high, v.unit), medium=Medium.TERMINAL)
             for name, v in update.parameters.items()]
    if update.suspicious:
        lines.append(Line("suspicious", describe_suspicious(update.suspicious), medium=Medium.TERMINAL))
    sections = [Section("Error after each step", _show_ledger(update)),
                Section("Parameters", [*lines, *_tabulate_parameters(update)]),
                Section("Residual", _show_residuals(update)), *list_suspicious(update.suspicious),
                Section("Provenance", [Listing("\n".join(p.history))], medium=Medium.PAGE)]
    files = []
    if path is not None:
        files.append(("model", str(path) + (f" (the one before: {backup})" if backup is not None else "")))
    if page is not None and update.refit is not None:
        files.append(("page", str(page)))
    sources = [s for s in (p.trace, *p.repeats, p.holdout) if s]
    return Report("remove" if update.removed else "add", title, "FITTED" if update.refit is not None else "", mood,
                  describe_update(update), list_sources(sources, bool(p.holdout)), update.notes, sections, files=files,
                  data=collect_model_data(update, path, page))


def describe_update(update: ModelUpdate) -> str:
    """What the update did to the error of the worst signal, on the fitted and on the held-out run."""
    if update.removed:
        return _describe_removal(update)
    assert update.refit is not None
    before, after = update.refit.steps[-1 - len(update.added)], update.refit.last
    floor = update.floor
    s = max(before.error, key=lambda name: before.error[name] / floor[name])
    sentence = f"{join_words(update.added)} added: {_describe_step(s, before.error, after.error, floor)}"
    if s in after.holdout:
        sentence += f"; held-out run {format_signal(before.holdout[s], s)} -> {format_signal(after.holdout[s], s)}"
    return f"{sentence}." if update.helps else f"{sentence}. {update.added[-1]} explains nothing but noise."


def _describe_removal(update: ModelUpdate) -> str:
    if update.refit is None:
        return f"{update.removed} removed."
    before, after = update.provenance.ledger[-2:]
    floor = update.floor
    s = max(after.error, key=lambda name: after.error[name] / floor[name])
    return f"{update.removed} removed: {_describe_step(s, before.error, after.error, floor)}."


def _describe_step(s: str, before: Mapping[str, float], after: Mapping[str, float],
                     floor: Mapping[str, float]) -> str:
    return (f"{SIGNAL_NAMES[s]} error {format_signal(before[s], s)} -> {format_signal(after[s], s)}, noise floor "
            f"{format_signal(floor[s], s)}")


def _show_ledger(update: ModelUpdate) -> list[Item]:
    if update.refit is None:
        return []
    rows, floor = update.provenance.ledger, update.floor
    return [_tabulate_errors(rows, floor), _draw_bars(rows, floor), Figure(
        "Error over noise floor after each step, on the fitted and on the held-out run. An effect that lowers only the "
        "blue bar is overfitting.", partial(draw_ledger, rows, floor))]


def _tabulate_errors(rows: Sequence[Row], floor: Mapping[str, float]) -> Table:
    """RMS error of each signal after each step, on the fitted run and on the held-out one."""
    columns = [Column("step"), Column("run")]
    for s in floor:
        columns += [Column(SIGNAL_NAMES[s], align="right"), Column("over floor", align="right", medium=Medium.PAGE)]
    cells: list[list[Cell | str]] = []
    for row in rows:
        cells.append([name_step(row), "fitted", *_error_cells(row.error, floor)])
        if row.holdout:
            cells.append(["", Cell("held-out", "muted"), *_error_cells(row.holdout, floor)])
    floors = [Cell(text, "muted") for s, x in floor.items() for text in (format_signal(x, s), "1")]
    cells.append([Cell("noise floor", "muted"), "", *floors])
    return Table(columns, cells, f"RMS error of each signal. Green: at most {GOOD_RATIO:g} times the noise floor.")


def _error_cells(by_signal: Mapping[str, float], floor: Mapping[str, float]) -> list[Cell]:
    cells = []
    for s in floor:
        if s not in by_signal:
            cells += [Cell(NO_NUMBER), Cell(NO_NUMBER)]
            continue
        ratio = by_signal[s] / floor[s]
        cells += [Cell(format_signal(by_signal[s], s), _choose_mood(ratio)), Cell(format_ratio(ratio), "muted")]
    return cells


def _choose_mood(ratio: float) -> Mood:
    return "good" if ratio <= GOOD_RATIO else "bad"


def _draw_bars(rows: Sequence[Row], floor: Mapping[str, float], width: int = 30) -> Table:
    """The worst signal's error over its noise floor, as bars of characters on a logarithmic scale."""
    ratios = [[max((x / floor[s] for s, x in by_signal.items() if s in floor), default=math.nan)
               for by_signal in (row.error, row.holdout)] for row in rows]
    largest = max((x for pair in ratios for x in pair if math.isfinite(x)), default=1.0)
    cells: list[list[Cell | str]] = []
    for row, (fitted, holdout) in zip(rows, ratios, strict=True):
        step = name_step(row)
        cells.append([step, "fitted", _draw_bar(fitted, largest, width), format_ratio(fitted)])
        if math.isfinite(holdout):
            cells.append(["", Cell("held-out", "muted"), _draw_bar(holdout, largest, width), format_ratio(holdout)])
    return Table([Column("step"), Column("run"), Column("worst signal"), Column("over floor", align="right")], cells,
                 "Error of the worst signal over its noise floor, on a logarithmic scale.", medium=Medium.TERMINAL)


def _draw_bar(ratio: float, largest: float, width: int) -> Cell:
    length = max(1, round(width * math.log(max(ratio, 1.0)) / math.log(max(largest, 1.1))))
    return Cell("█" * length, _choose_mood(ratio))


def _tabulate_parameters(update: ModelUpdate) -> list[Table]:
    if not update.parameters:
        return []
    table = list_parameters(update.parameters.items())
    return [Table(table.columns, table.rows, is_list=True, medium=Medium.PAGE)]


def _show_residuals(update: ModelUpdate) -> list[Item]:
    if update.refit is None:
        return []
    r = update.refit
    first, last = r.steps[0].hypothesis, r.last.hypothesis
    return [Figure(
        "Residual (measured minus model) of each signal, before and after. Where the model is complete, the blue line "
        "stays between the dotted lines (two noise floors). Shaded: ramps (blue) and dynamic sections (violet) of the "
        "command.",
        partial(draw_residuals, r.search.problem.trace, first, last if last is not first else None,
                update.floor))]


def collect_model_data(update: ModelUpdate, path: Path | None, page: Path | None) -> dict[str, Any]:
    """The answer of `rig add --json` and `rig remove --json`; SI units."""
    is_fitted = update.refit is not None
    return {"model": None if path is None else str(path),
            "ledger": [row.to_json() for row in update.provenance.ledger],
            "floor": dict(update.provenance.floor or {}),
            "parameters": {name: v._asdict() for name, v in update.parameters.items()},
            "effects": list(update.provenance.effects), "helps": update.helps,
            "suspicious": [s._asdict() for s in update.suspicious], "notes": list(update.notes),
            "report": str(page) if page is not None and is_fitted else None}
