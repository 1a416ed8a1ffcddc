"""The report of `rig explain`: the missing effect, the ranked candidates, what the test cannot detect."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from fdi.discovery.balance import find_smooth_rows
from fdi.discovery.candidates import Answer, Candidate, Suspicious
from fdi.discovery.model_file import Row
from fdi.discovery.runs import Source
from fdi.estimation.fit import Value
from fdi.report import explain_figures
from fdi.report.compare_report import OTHER_ACTUATOR
from fdi.report.law_report import collect_law_data, describe_law, list_law_sections
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
from fdi.report.report import Cell, Column, Figure, Line, Listing, Medium, Mood, Report, Section, Table

if TYPE_CHECKING:
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
        "(violet) of the command.", partial(explain_figures.draw_residuals, trace, e.base, after, e.floor, name))])]
    if pattern is not None and pattern.place:
        sections.append(Section("Shape of the residual", [Figure(
            "Left: the missing quantity over the state that it follows best, with two standard errors. Right: over "
            "time.",
            partial(explain_figures.draw_pattern, pattern, trace.t[find_smooth_rows(trace)]))]))
    if len(a.ledger) > 2:
        rows = [Row(*row) for row in a.ledger]
        sections.append(Section("Error after each effect", [Figure(
            "Error over noise floor after each effect, on the fitted and on the held-out run. An effect that lowers "
            "only the blue bar is overfitting.", partial(explain_figures.draw_ledger, rows, a.baseline["floor"]))]))
    if a.candidates:
        sections.append(Section("Ranking", [Figure(
            "Error over noise floor of the worst signal, for the best candidates. The right effect reaches the green "
            "line on both runs.", partial(explain_figures.draw_ranking, a.explanations, e.floor))]))
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
