"""The report of `rig explain`: the missing effect, the ranked candidates, what the test cannot detect."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fdi.comparison.compare import compare_controller
from fdi.discovery.explain import is_off_alone
from fdi.discovery.explain_runs import Answer, Candidate, Suspicious, list_own_candidates, list_shared_effects
from fdi.discovery.laws.find_law import Law, LawCurve, LawSearch, Missing
from fdi.discovery.laws.terms import describe_formula
from fdi.discovery.residual_pattern import Pattern, find_smooth_rows
from fdi.discovery.runs import Source
from fdi.discovery.search import Hypothesis
from fdi.discovery.sensitivity import NEEDED, RUNGS, TRIALS, Claim
from fdi.discovery.update_model import ModelUpdate, Row
from fdi.estimation import Value
from fdi.report.compare_report import OTHER_ACTUATOR, describe_gains
from fdi.report.drawing import (
    AFTER,
    AMBER,
    BEFORE,
    GREEN,
    ORANGE,
    RED,
    Mark,
    Panel,
    area,
    axes,
    call,
    dot,
    draw_panels,
    draw_residuals,
    legend,
    level,
    line,
    name_rows,
)
from fdi.report.numbers import (
    NO_NUMBER,
    format_amount,
    format_interval,
    format_p_value,
    format_percent,
    format_ratio,
    join_words,
    list_first,
    name_parameter,
)
from fdi.report.report import Cell, Column, Figure, Line, Listing, Medium, Mood, Report, Section, Table, tabulate
from fdi.report.run_report import list_faults
from fdi.thresholds import RESIDUAL_FOREIGN, RESIDUAL_HELD_OUT
from fdi.trace import Floats, Trace
from plant import Signals

BySignal = Mapping[str, float]  # SI
FAR_OFF = "only with tolerances that fewer than one healthy unit in 600 has"

MOODS: dict[str, Mood] = {"NOTHING_MISSING": "good", "EXPLAINED": "good", "PARTLY": "doubtful", "AMBIGUOUS": "doubtful",
                          "NOT_RESOLVABLE": "doubtful", "UNEXPLAINED": "bad"}
WORD_MOODS: dict[str, Mood] = {"explains": "good", "equal": "doubtful", "part": "doubtful"}


def build_explanation_report(a: Answer, title: str, model: str, sources: Sequence[Source], command: str = "",
                             next_command: str = "", pattern: Pattern | None = None, notes: Sequence[str] = (),
                             files: Sequence[tuple[str, str]] = (), claims: Sequence[Claim] = ()) -> Report:
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
        claims: of sizes that the search names, where they were measured.
    """
    e, page = a.explanation, Medium.PAGE
    trace, marks = e.search.problem.trace, e.marks
    after = None if a.best is e.base else a.best
    notes = [*dict.fromkeys([*notes, *trace.notes]), *([e.excerpt] if e.excerpt else [])]
    if marks.is_recorder:
        d = trace.declared
        notes.append(f"{d.controlled.symbol} is recorded in steps of {format_amount(marks.step, d.controlled.unit)}, "
                     f"but {d.drive.symbol} shows that the controller "
                     "reads it finer: the rounding is noise of the recording and no effect")
    if marks.unseen:
        notes.append("the controller's answers are not judged, as its law needs readings that are not in the file, "
                     f"or remembers what came before: {join_words(marks.unseen)} would not be seen")
    sections = [
        Section("Candidates", [_tabulate_candidates(a)] if a.candidates else []),
        Section("Parameters of the missing effect",
                [_list_parameters({name: v for c in _named_candidates(a) for name, v in c.parameters.items()})],
                medium=page),
        Section("Findings", describe_findings(a)),
        *(_list_law_sections(a.law) if a.law is not None else []),
        Section("Residual", [Figure(
            "Residual (measured minus model) of each signal, without and with the effect. Where the effect explains "
            "it, the blue line is between the dotted lines (two noise floors) for 95 % of the time. Shaded: ramps "
            "(blue) and dynamic sections (violet) of the command.",
            partial(draw_change, trace, e.base, after, e.floor,
                    "with the missing effect" if e.effects else "with the best candidate"))]),
        Section("Shape of the residual", [] if pattern is None or not pattern.place else [Figure(
            "Left: the missing quantity over the state that it follows best, with two standard errors. Right: over "
            "time.", partial(draw_pattern, pattern, trace.t[find_smooth_rows(trace)]))]),
        Section("Error after each effect", [Figure(
            "Error over noise floor after each effect. With a held-out run: an effect that lowers the bar of the "
            "fitted run alone overfits.",
            partial(draw_ledger, [Row(*row) for row in a.ledger], a.baseline["floor"], trace.declared))]
            if len(a.ledger) > 2 else []),
        _list_suspicious(a.suspicious),
        Section("What this test cannot detect", [tabulate(
            a.blind, (Column("effect"), lambda b: Cell(b.effect, "bad")),
            (Column("parameter"), lambda b: Cell(name_parameter(b.parameter), "muted")),
            (Column("not detectable up to", align="right"), lambda b: format_amount(b.usual, b.unit)),
            (Column("would reveal it"), lambda b: b.revealed_by),
            caption="Tolerances of a healthy unit make up for these effects, so this test says nothing about them.")],
            medium=page),
        *([_list_claims(claims)] if claims else []),
        Section("Provenance", [Listing(command, medium=page)] if command else [])]
    facts = [("model", model), *list_sources(sources, bool(a.baseline["holdout"]))]
    injected = describe_injected_faults(trace)
    return Report("explain", title, a.verdict, MOODS[a.verdict], f"{describe_verdict(a)} {injected}".rstrip(), facts,
                  notes, sections, next_command, files, collect_data(a, [*notes, *filter(None, [injected])], claims))


def describe_injected_faults(trace: Trace) -> str:
    """What the sequence of the run injected, and when; "" for nothing. Effects are fitted to the whole run."""
    faults = [f"{name} from {begin:g} to {end:g} s" for name, begin, end in list_faults(trace)]
    return f"The log names what its sequence injected: {join_words(faults)}." if faults else ""


def find_signals(a: Answer) -> Signals:
    """The signals of the plant that an answer is about."""
    return a.explanation.search.problem.trace.declared


def describe_verdict(a: Answer) -> str:
    """The verdict in a sentence or two: the effect, its size, and the error before and after beside the noise floor."""
    candidates = _named_candidates(a)
    words, verb = join_words(c.effect for c in candidates), "explain" if len(candidates) > 1 else "explains"
    error, floor, signals = a.baseline["error"], a.baseline["floor"], find_signals(a)
    floors = "; ".join(f"{signals.find(s).symbol} error {_format(error, s, signals)}, noise floor "
                       f"{_format(floor, s, signals)}" for s in error)
    match a.verdict:
        case "NOTHING_MISSING":
            return f"Nothing is missing: the residual is noise ({floors})."
        case "NOT_RESOLVABLE" if not a.explanation.effects:
            return (f"The residual is noise ({floors}), but this run shows little: {len(a.blind)} of "
                    f"{len(a.explanation.search.effects)} effects would change nothing in it that the tolerances do "
                    "not.")
        case "NOT_RESOLVABLE":
            one = join_words((c.effect for c in candidates), "or")
            return (f"The error is at the noise floor ({floors}). {one} may be present ({_describe_sizes(candidates)}),"
                    " but it is too small in this test to be certain.")
        case "AMBIGUOUS":
            shared_effects = list_shared_effects(a.explanation)
            alternatives = [name for name in a.explanation.effects if name not in shared_effects]
            one = join_words(alternatives, "or")
            subject = f"{join_words(shared_effects)} together with {one}" if shared_effects else one
            last = next((c for c in candidates if c.effect in alternatives), a.candidates[0])
            return (f"{subject}: each explains the residual, and these data cannot discriminate between them; "
                    f"{_describe_change(a, last)}.")
        case word if word == "UNEXPLAINED" or not candidates:
            return _describe_unexplained(a)
    rest = f"{_describe_sizes(candidates)}; {_describe_change(a, candidates[-1])}."
    if a.verdict == "EXPLAINED":
        model = a.explanation.search.model
        own = [f"{name_parameter(name)} {format_amount(model[name], v.unit)}" for c in list_own_candidates(a)
               for name, v in c.parameters.items()]
        has = f" The model has it with {join_words(own)}." if own else ""
        return f"{words} {'together ' if len(candidates) > 1 else ''}{verb} the residual: {rest}{has}"
    if a.best.is_at_floor and a.best.is_far:
        return f"{words} {verb} the residual {FAR_OFF}: {rest} Something else may be missing instead."
    return f"{words} {verb} part of the residual: {rest} Something else is missing too."


def _describe_unexplained(a: Answer) -> str:
    base, floor, signals = a.explanation.base, a.baseline["floor"], find_signals(a)
    worst, best = _find_worst_signal(a.baseline["error"], floor), min(a.candidates, key=lambda c: c.ratio, default=None)

    def describe_error(error: BySignal, s: str) -> str:
        return f"{signals.find(s).symbol} error {_format(error, s, signals)}"

    if base.is_at_floor and is_off_alone(base, floor):
        return (f"The run differs from its repeat by more than noise ({describe_error(a.baseline['error'], worst)}, "
                f"noise floor {_format(floor, worst, signals)}): what happened once is no effect. Compare runs under "
                "the same loads.")
    if base.is_at_floor and base.is_far:
        return (f"The model explains the run {FAR_OFF} ({_describe_furthest(base)}), and no effect of the catalogue "
                "does it with usual ones.")
    if base.is_at_floor and not a.explanation.effects:
        e = a.explanation
        return ("The output of the controller differs from the model's, and no effect of the catalogue explains the "
                f"difference{describe_gains(compare_controller(e.search.problem.trace, e.search.problem.model))}."
                if e.marks.is_firmware_different else
                "The model fits this run, but not the held-out run; this run does not show what is missing.")
    return (f"No effect of the catalogue explains the residual: {describe_error(a.baseline['error'], worst)}, "
            f"noise floor {_format(floor, worst, signals)}"
            + (f"; the best, {join_words([*best.beside, best.effect])}, leaves "
               f"{describe_error(best.error, _find_worst_signal(best.error, floor))}."
               if best and best.ratio < max(base.ratio.values()) else "."))


def _named_candidates(a: Answer) -> list[Candidate]:
    return [c for c in a.candidates if c.effect in a.explanation.effects]


def _describe_sizes(candidates: Sequence[Candidate], most: int = 2) -> str:
    sizes = [", ".join(describe_parameter(name, v) for name, v in list(c.parameters.items())[:most])
             for c in candidates]
    return sizes[0] if len(sizes) == 1 else "; ".join(
        f"{c.effect}: {x}" for c, x in zip(candidates, sizes, strict=True))


def describe_parameter(name: str, v: Value) -> str:
    """A parameter with its 95 % interval."""
    return f"{name_parameter(name)} {format_interval(v.value, v.low, v.high, v.unit)}"


def _find_worst_signal(error: BySignal, floor: BySignal) -> str:
    """The signal with the largest error over its floor."""
    return max(error, key=lambda s: error[s] / floor[s] if floor.get(s) else 0.0)


def _describe_change(a: Answer, c: Candidate) -> str:
    """Error before and after, noise floor, held-out run; or what the tolerances would be, where only these tell."""
    base = a.explanation.base
    if base.is_at_floor and base.is_far:
        return f"the model explains the run without it {FAR_OFF} ({_describe_furthest(base)})"
    s, signals = _find_worst_signal(a.baseline["error"], a.baseline["floor"]), find_signals(a)
    sentence = _describe_step(s, a.baseline["error"], c.error, a.baseline["floor"], signals)
    return sentence + (f"; held-out run {_format(c.holdout, s, signals)}" if s in c.holdout else "")


def _describe_furthest(h: Hypothesis) -> str:
    """The parameter that a fit has moved furthest from a healthy unit."""
    sd, name = max((abs(float(x)) / f.prior, f.name) for f, x in zip(h.fit.free, h.fit.x, strict=True))
    return f"{name} at {sd:.1f} standard deviations"


def _format(by_signal: BySignal, name: str, signals: Signals) -> str:
    return format_amount(by_signal.get(name, math.nan), signals.find(name).unit)


def describe_findings(a: Answer) -> list[Line]:
    """Labelled lines: how to discriminate, the shape of the residual, suspicious parameters, what is not detectable."""
    separation = ""
    if a.separate:
        separation = (f"{a.separate['by']}: in simulation this discriminates between "
                      f"{join_words(a.separate['between'])}")
    elif a.verdict == "AMBIGUOUS":
        separation = "no sensor and no command that was tried discriminates between them"
    is_another = a.verdict in ("PARTLY", "UNEXPLAINED") and a.best.is_far
    worst_ratio = max(a.best.ratio.values())
    doubt = (f"The best leaves {format_ratio(worst_ratio)} noise floors: is this recording from this plant, in its "
             "units? " if worst_ratio > RESIDUAL_FOREIGN else "")
    return [Line("to discriminate", separation), Line("residual", a.pattern),
            *([] if a.law is None else [Line("law", _describe_law(a.law)), *(
                Line("not observable", f"{PLACES[place]}: {why}") for place, why in a.law.hidden.items())]),
            Line("suspicious", describe_suspicious(a.suspicious)),
            Line("another actuator?", doubt + OTHER_ACTUATOR if is_another else ""),
            Line("held-out run", _describe_held_out(a)), Line("not detectable", describe_blind(a))]


def _describe_held_out(a: Answer) -> str:
    """Why a held-out run was not judged as a whole, or what is left of it beside its typical block; "" if neither."""
    e, effects = a.explanation, a.best.effects
    outcome, errors = e.unseen.get(effects), e.holdout.get(effects, {})
    errors = (outcome.decided if outcome else {}) or errors
    worst = max((x / e.floor[s] for s, x in errors.items() if s in e.floor), default=0.0)
    if outcome is not None and outcome.decided:
        return (f"{format_percent(outcome.undecided)} of it is not judged, because stops there depend on a thousandth "
                f"of a friction level; the rest is at {format_ratio(worst)} times the noise floor")
    if outcome is None or a.verdict not in ("EXPLAINED", "AMBIGUOUS") or worst <= RESIDUAL_HELD_OUT:
        return ""
    return (f"at {format_ratio(worst)} times the noise floor, and at noise in most of it: it holds a stop that the fit "
            "missed, or an effect that only it shows (rig compare of it says where)")


def describe_suspicious(parameters: Sequence[Suspicious], most: int = 4) -> str:
    """Parameters further from their nominal values than in any healthy unit; "" for none."""
    worst = sorted(parameters, key=lambda s: -abs(s.tolerances))
    words = [f"{s.parameter} {format_amount(s.value, s.unit)} ({s.tolerances:+.1f} tolerances)" for s in worst]
    return f"{list_first(words, most)}: outside the range of a healthy unit" if words else ""


def describe_blind(a: Answer) -> str:
    """The effects that the tolerances make up for up to their usual size, and what would reveal each of them."""
    effects = join_words(f"{b.effect} (up to {format_amount(b.usual, b.unit)})" for b in a.blind)
    aids = dict.fromkeys(b.revealed_by for b in a.blind)
    hints = [f"{aid} would reveal {join_words(b.effect for b in a.blind if b.revealed_by == aid)}" for aid in aids]
    return "; ".join([effects, *hints])


def _tabulate_candidates(a: Answer, most: int = 8) -> Table:
    """The candidates, best first, below the model without any further effect."""
    floor, has_holdout = a.explanation.floor, any(c.holdout for c in a.candidates)
    symbols = [find_signals(a).find(s).symbol for s in floor]
    held_out = [Column("held-out run", align="right", medium=Medium.TERMINAL),
                *(Column(f"{symbol}, held-out run", align="right", medium=Medium.PAGE) for symbol in symbols)]
    columns = [Column("effect"), Column("result"), *(Column(symbol, align="right") for symbol in symbols),
               *(held_out if has_holdout else []), Column("evidence", align="right"), Column("p", align="right"),
               Column("size", medium=Medium.PAGE)]

    def show_ratios(ratios: BySignal, holdout: BySignal) -> list[str]:
        """Errors over noise floors: of each signal; on the held-out run of the worst signal, then of each."""
        holdout_ratios = {s: x / floor[s] for s, x in holdout.items() if s in floor}
        also = [max(holdout_ratios.values(), default=math.nan),
                *(holdout_ratios.get(s, math.nan) for s in floor)] if has_holdout else []
        return list(map(format_ratio, [*(ratios.get(s, math.nan) for s in floor), *also]))

    rows: list[list[Cell | str]] = [[Cell(text, "muted") for text in (
        "no effect", "", *show_ratios(a.explanation.base.ratio, a.baseline["holdout"]), "", "", "")]]
    rows += [[Cell(" + ".join([*c.beside, c.effect]), is_strong=mood != "muted"), Cell(c.word, mood),
              *show_ratios(c.ratios, c.holdout), f"{c.evidence:.0f}", format_p_value(c.p_value),
              Cell(", ".join(describe_parameter(name, v) for name, v in c.parameters.items()), "muted")]
             for c in a.explanations for mood in [WORD_MOODS.get(c.word, "muted")]]
    return Table(columns, rows, (
        "Signals: repeatable part of the error over its noise floor (1: noise alone). "
        + ("Held-out run: error of the worst signal over its noise floor (on the page: that of each signal). "
           if has_holdout else "")
        + "Evidence: gain in log likelihood minus a penalty for parameters and candidates. p: probability of such a "
          "gain where nothing is missing."),
        terminal_rows=most + 1)


def _list_parameters(parameters: Mapping[str, Value]) -> Table:
    return tabulate(parameters, (Column("parameter"), str), (
        Column("value and 95 % interval"), lambda name: format_interval(*parameters[name])), is_list=True)


def _list_suspicious(parameters: Sequence[Suspicious]) -> Section:
    return Section("Suspicious parameters", [tabulate(
        parameters, (Column("parameter"), lambda s: s.parameter),
        (Column("fitted value", align="right"), lambda s: format_amount(s.value, s.unit)),
        (Column("tolerances", align="right"), lambda s: Cell(f"{s.tolerances:+.1f}", "bad")),
        caption="To explain the data, the fit had to move these parameters further than they differ between healthy "
                "units.", is_list=True)], medium=Medium.PAGE)


def list_sources(sources: Sequence[Source], has_holdout: bool) -> list[tuple[str, str]]:
    """(role, file) of each run."""
    roles = ["trace" if number == 0 else "repeat" for number in range(len(sources))]
    if has_holdout and len(sources) > 1:
        roles[-1] = "held-out run"
    return [(role, source.file) for role, source in zip(roles, sources, strict=True)]


def _list_claims(claims: Sequence[Claim]) -> Section:
    """From which size on each effect is named, and what smaller ones were taken for."""
    return Section("Sizes that are named", [
        tabulate(claims, (Column("effect"), lambda c: Cell(c.effect, "good" if c.named else "bad")),
                 (Column("parameter", medium=Medium.PAGE), lambda c: Cell(name_parameter(c.parameter), "muted")),
                 (Column("named from", align="right"),
                  lambda c: "no usual size" if c.smallest is None else format_amount(c.smallest, c.unit)),
                 (Column("named", align="right"),
                  lambda c: f"{c.named.good} of {c.named.of}" if c.named else NO_NUMBER),
                 (Column("interval", align="right"),
                  lambda c: f"{100 * c.named.low:.0f} .. {100 * c.named.high:.0f} %" if c.named else NO_NUMBER),
                 (Column("others taken for"), lambda c: list_first([f"{w} {n}" for w, n in c.taken_for.items()], 2)),
                 caption="Each effect was hidden in this unit, at sizes a factor of two apart, in "
                         f"{TRIALS} runs a size with other noise. Named from: the smallest change of its first "
                         f"parameter that at least {NEEDED} of {TRIALS} runs named, and nothing else; the interval (95 "
                         "%) is that of this share. Of smaller sizes nothing is claimed."),
        Figure("Runs that name the effect and nothing else, of all at that size. Right: the largest usual size.",
               partial(draw_claims, claims))])


def draw_claims(claims: Sequence[Claim]) -> str:
    """How often each effect was named, by its size over the largest usual one."""
    marks: list[Mark] = [*name_rows([c.effect for c in claims])]
    for y, c in enumerate(claims):
        for size, count, of in c.counts:
            x, colour = size / c.largest, choose_colour_of_share(count / of)
            marks += [dot(x, y, colour, marker="s", ms=15, alpha=0.3),
                      call("text", x, y, f"{count}/{of}", ha="center", va="center", fontsize=7)]
    marks.append(axes(xscale="log", xlim=(0.5**RUNGS, 1.5), xlabel="size over the largest usual size"))
    return draw_panels("claims", [[marks]], 0.8 + 0.27 * len(claims))


def choose_colour_of_share(share: float) -> str:
    """Green where a size is named often enough, red where it is named in less than half of the runs."""
    if share >= NEEDED / TRIALS:
        return GREEN
    return AMBER if share > 0.5 else RED


def collect_data(a: Answer, notes: Sequence[str] = (), claims: Sequence[Claim] = ()) -> dict[str, Any]:
    """The answer of `rig explain --json`, with notes on the runs and claims of sizes; SI units."""
    e = a.explanation
    held_out_run = e.unseen.get(a.best.effects)
    has_ledger = len(e.effects) > 1 and e.verdict != "AMBIGUOUS"
    candidates = []
    for c in a.candidates:
        row = c._asdict() | {"parameters": {name: v._asdict() for name, v in c.parameters.items()}, "ratio": c.ratio}
        candidates.append(row | {"with": row.pop("beside")})
    sometimes = {
        "undecided": {"share": held_out_run.undecided, "holdout": held_out_run.decided}
        if held_out_run is not None and held_out_run.decided else None,
        "law_search": None if a.law is None else _collect_law_data(a.law, a.law_effects),
        "excerpt": e.excerpt or None,
        "ledger": [{"effect": effect, "error": error, "holdout": holdout} for effect, error, holdout in a.ledger]
        if has_ledger else None,
        "sensitivity": [{"effect": c.effect, "parameter": c.parameter, "unit": c.unit, "smallest_named": c.smallest,
                         "named": c.named._asdict() if c.named else None,
                         "counts": [{"size": size, "named": count, "of": of} for size, count, of in c.counts],
                         "taken_for": c.taken_for} for c in claims] or None}
    return {
        "verdict": e.verdict, "effects": e.effects, "candidates": candidates,
        "baseline": {**a.baseline, "ratio": e.base.ratio},
        "blind_to": [{"effect": b.effect, "parameter": b.parameter, "smallest_visible": None, "unit": b.unit,
                      "usual": b.usual, "revealed_by": b.revealed_by} for b in a.blind],
        "seen_without_noise": a.noiseless, "suspicious": [s._asdict() for s in a.suspicious],
        "separate": a.separate, "pattern": a.pattern,
        "controller": {"error": e.marks.controller, "unit": "counts"},
        "signals": {s: find_signals(a).find(s).symbol for s in e.floor},
        "notes": notes, **{key: value for key, value in sometimes.items() if value is not None}}


AXES = {"position": (1e3, "mm"), "speed": (1e3, "mm/s"), "pressure": (1e-5, "bar"), "spool": (1e6, "um"),
        "current": (1e3, "mA"), "time": (1.0, "s"), "spool_speed": (1e3, "mm/s"), "way": (1e3, "mm")}


def draw_change(trace: Trace, before: Hypothesis, after: Hypothesis | None, floor: BySignal,
                name_of_after: str = "with the missing effect") -> str:
    """The residual, measured minus model, of each signal over time, without and with the effects, below the command."""
    return draw_residuals("left", trace, [
        ("model as it was", BEFORE, before.fit.residuals[:, :len(trace)]),
        *([] if after is None else [(name_of_after, AFTER, after.fit.residuals[:, :len(trace)])])], floor)


def draw_ledger(rows: Sequence[Row], floor: BySignal, signals: Signals) -> str:
    """Error over noise floor of each signal after each effect, on the fitted run and the held-out one, if there is one.
    """
    x, signal_names = np.arange(len(rows)), [s for s in floor if s in rows[0].error]
    step_names = [name_step(row) for row in rows]
    runs = [("fitted run", AFTER, [row.error for row in rows])]
    if any(row.holdout for row in rows):
        runs += [("held-out run", ORANGE, [row.holdout for row in rows])]

    def draw_signal(s: str) -> Panel:
        bars = [call("bar", x + 0.38 * place, [by.get(s, math.nan) / floor[s] for by in errors], width=0.36,
                     color=color, label=label) for place, (label, color, errors) in enumerate(runs)]
        return [*bars,
                level(1.0, GREEN, width=1.2),
                call("set_xticks", x + 0.19 * (len(runs) - 1), step_names, rotation=20, ha="right"),
                axes(yscale="log", title=signals.find(s).symbol,
                     ylabel="error over noise floor" if s == signal_names[0] else "")]

    return draw_panels("ledger", [list(map(draw_signal, signal_names))], 2.9, common_legend=True, sharey=True)


def name_step(row: Row) -> str:
    """What a step of the ledger did.

    >>> name_step(Row("null_bias", {}, {}))
    '+ null_bias'
    """
    sign = "-" if row.removed else "+"
    return "model as it was" if row.effect is None else f"{sign} {row.effect}"


def draw_pattern(p: Pattern, t: Floats) -> str:
    """The missing quantity over the state that it follows, and over time."""
    over, state = [axes(ylabel=f"missing {p.place} [{p.unit}]")], p.state or "position"
    scale, unit = AXES[state]
    if len(p.at):
        over += [call("errorbar", scale * p.at, p.height, yerr=2.0 * p.doubt, color=ORANGE, lw=1.2, elinewidth=0.8),
                 call("locator_params", axis="x", nbins=5), axes(xlabel=f"{state} [{unit}]")]
    if len(p.at) and p.wave:
        amplitude, length, phase = p.wave
        x = np.linspace(0.0, length, 100)
        over += [line(scale * x, amplitude * np.sin(2.0 * np.pi * x / length + phase), AFTER, ls="--"),
                 axes(xlabel=f"{state} [{unit}], folded on {scale * length:.4g} {unit}; dashed: a wave")]
    n = min(len(t), len(p.trace))
    along = [line(t[:n], p.trace[:n], ORANGE, width=0.8), over[0], axes(xlabel="time [s]")]
    return draw_panels("shape", [[over, along]], 3.0, width_ratios=[1.0, 1.6])


def _name_state(state: str) -> str:
    return "distance since the last reversal" if state == "way" else state.replace("_", " ")


def draw_law(c: LawCurve) -> str:
    """What is missing over the law's first state, in bins with two standard errors, and what the law says there."""
    scale, unit = AXES.get(c.state, (1e3, "mm"))
    sign = f", times the sign of the {c.along.replace('direction', 'speed')}" if c.along else ""
    return draw_panels("law", [[[
        area(scale * c.at, c.height - 2.0 * c.doubt, c.height + 2.0 * c.doubt, ORANGE, "two standard errors"),
        line(scale * c.at, c.height, ORANGE, "measured", ls="", marker="o", ms=3.5),
        line(scale * c.at, c.law, AFTER, "law", 1.4),
        axes(xlabel=f"{_name_state(c.state)} [{unit}]"
             + (f", folded on {scale * c.period:.4g} {unit}" if c.period else "")),
        call("set_ylabel", f"missing {c.place} [{c.unit}]{sign}", fontsize=8), legend(3)]]], 3.2)


PLACES = {"force": "force on the ram", "flow": "flow to the jack", "current": "current in the torque motor"}


def _list_law_sections(search: LawSearch) -> list[Section]:
    """The law with its terms, what error it leaves, what the residual follows, and the picture of both."""
    law = search.law if search.law is not None and search.law.holds else None
    return [
        Section("Law", [] if law is None else [_tabulate_terms(law)]),
        Section("Error with the law", [] if law is None else [_tabulate_law_errors(search, law)]),
        Section("What the residual follows", [_tabulate_dependences(search.missing)], medium=Medium.PAGE),
        Section("Law and measurement", [] if law is None or search.curve is None else [Figure(
            f"Points: the missing {search.curve.place} in bins; shaded: two standard errors. Line: the law in the same "
            "bins. The law holds where the line is within the shaded band.", partial(draw_law, search.curve))])]


def _describe_law(search: LawSearch) -> str:
    """The law, or why there is none."""
    law = search.law
    if law is None:
        return "no term lowers the error of pieces of the run that its fit did not see; none is written"
    names = " + ".join(term.words for term in law.terms)
    if not law.holds:
        return f"none holds: the best one tried was {names}, but {law.reason}; none is written"
    beside = f", beside {' and '.join(search.base.effects)}" if search.base.effects else ""
    equal = f"; {' or '.join(law.equals)} would fit as well" if law.equals else ""
    return f"{names}{beside}: {law.reason}{equal}"


def _tabulate_terms(law: Law) -> Table:
    return Table([Column("parameter"), Column("meaning"), Column("value and 95 % interval")], [
        [Cell(name, is_strong=name == term.name),
         term.words if name == term.name else name.removeprefix(f"{term.name}_"),
         format_interval(*law.values[name][:3], unit)]
        for term in law.terms for name, unit in zip(term.fields, term.units, strict=True)],
        f"The law: {describe_formula(law.terms)}.", is_list=True)


def _tabulate_law_errors(search: LawSearch, law: Law) -> Table:
    signals = search.signals
    columns = [Column(f"{signals.find(s).symbol}{words}", align="right")
               for words in ("", ", held-out")[:2 if law.holdout else 1] for s in search.floor]
    rows: list[list[Cell | str]] = [
        [Cell(name, "good", True) if name == "with the law" else name,
         *[_format(errors, s, signals) for errors in sides for s in search.floor][:len(columns)]]
        for name, *sides in _list_errors(search, law)]
    return Table([Column("model"), *columns], rows, (
        "Errors, RMS; of the held-out run those of the typical block (the worst 15 % are left out). The law explains "
        "what is missing where its error reaches the noise floor on both runs."))


def _list_errors(search: LawSearch, law: Law) -> list[tuple[str, BySignal, BySignal]]:
    """(model, RMS errors on the fitted run, on the held-out run) without, with the catalogue's best, with the law."""
    best = search.catalogue
    return [("as it was", search.base.errors, search.holdout.get("base", {})),
            *([] if best is None else [(f"with {' + '.join(best.effects)}", best.errors,
                                        search.holdout.get("catalogue", {}))]),
            ("with the law", law.hypothesis.errors, law.holdout), ("noise floor", search.floor, search.floor)]


def _tabulate_dependences(missing: Sequence[Missing]) -> Table:
    columns = [Column("missing"), Column("follows"), *(Column(heading, align="right") for heading in (
        "share", "share, held-out run", "p", "size over noise"))]
    return Table(columns, [
        [PLACES[m.balance.place], " and ".join(map(_name_state, d.states)), format_percent(max(d.share, 0.0)),
         NO_NUMBER if d.holdout is None else format_percent(max(d.holdout, 0.0)), f"{d.p_value:.3f}",
         format_ratio(m.balance.ratio)] for m in missing for d in m.dependences],
        "Share of the missing quantity that a curve over the state, or over the pair, predicts: in blocks of the run "
        "that the curve was not made from, and on the held-out run. p: probability that the best of all states and "
        "pairs does as well by chance. The pressure answers a missing force and the speed a missing flow: they follow "
        "it whatever its cause.")


def _collect_law_data(search: LawSearch, effects: Sequence[str]) -> dict[str, Any]:
    """The keys of `rig explain --json` about the law; SI units."""
    law = search.law
    return {
        "missing": [{"place": m.balance.place, "size": m.balance.size, "unit": m.balance.unit,
                     "over_noise": m.balance.ratio,
                     "follows": [{"states": d.states, "share": d.share, "holdout": d.holdout,
                                  "p_value": d.p_value} for d in m.dependences]} for m in search.missing],
        "not_observable": search.hidden,
        "law": None if law is None else {
            "holds": law.holds, "reason": law.reason, "formula": describe_formula(law.terms),
            "terms": [{"term": t.name, "place": t.place, "meaning": t.words,
                       "parameters": {f: law.values[f]._asdict() for f in t.fields}} for t in law.terms],
            "beside": search.base.effects, "equal_terms": law.equals, "effects": effects,
            "errors": [{"model": name, "error": error, "holdout": holdout}
                       for name, error, holdout in _list_errors(search, law)]}}


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
    p, r, floor, signals = update.provenance, update.refit, update.floor, update.model.kind.signals
    parameters = _list_parameters(update.parameters)
    lines = [*parameters.rows, ("suspicious", describe_suspicious(update.suspicious))]
    sections = [Section("Parameters", [*(Line(str(name), str(value), medium=Medium.TERMINAL) for name, value in lines),
                                       replace(parameters, medium=Medium.PAGE)])]
    if r is not None:
        first, last = r.steps[0].hypothesis, r.last.hypothesis
        after = last if last is not first else None
        sections = [
            Section("Error after each step", [
                _tabulate_errors(p.ledger, floor, signals), Figure(
                    "Error over noise floor after each step. With a held-out run: an effect that lowers the bar of the "
                    "fitted run alone overfits.",
                    partial(draw_ledger, p.ledger, floor, signals))]),
            *sections,
            Section("Residual", [Figure(
                "Residual (measured minus model) of each signal, before and after. Where the model is complete, the "
                "blue line is between the dotted lines (two noise floors) for 95 % of the time. Shaded: ramps (blue) "
                "and dynamic sections (violet) of the command.",
                partial(draw_change, r.search.problem.trace, first, after, floor))])]
    sections += [_list_suspicious(update.suspicious),
                 Section("Provenance", [Listing("\n".join(p.history))], medium=Medium.PAGE)]
    page = page if r is not None else None
    before = f" (the one before: {backup})" if backup is not None else ""
    files = [(label, f"{file}{more}") for label, file, more in (("model", path, before), ("page", page, "")) if file]
    data = {
        "model": path, "ledger": [row.to_json() for row in p.ledger], "floor": p.floor or {},
        "parameters": {name: v._asdict() for name, v in update.parameters.items()}, "effects": p.effects,
        "helps": update.helps, "suspicious": [s._asdict() for s in update.suspicious], "notes": update.notes,
        "report": page}
    return Report("remove" if update.removed else "add",
                  f"without {update.removed}" if update.removed else " + ".join(update.added),
                  "FITTED" if r is not None else "", "doubtful" if update.helps is False else "good",
                  describe_update(update), list_sources([s for s in (p.trace, *p.repeats, p.holdout) if s],
                                                        bool(p.holdout)),
                  update.notes, sections, files=files, data=data)


def describe_update(update: ModelUpdate) -> str:
    """What the update did to the error of the worst signal, on the fitted and on the held-out run."""
    floor, signals = update.floor, update.model.kind.signals
    if update.refit is None:
        return f"{update.removed} removed."
    if update.removed:
        earlier, later = update.provenance.ledger[-2:]
        s = max(later.error, key=lambda name: later.error[name] / floor[name])
        return f"{update.removed} removed: {_describe_step(s, earlier.error, later.error, floor, signals)}."
    before, after = update.refit.steps[-1 - len(update.added)], update.refit.last
    was, now = before.hypothesis.errors, after.hypothesis.errors
    s = max(was, key=lambda name: was[name] / floor[name])
    held_out = "" if s not in after.holdout else (
        f"; held-out run {_format(before.holdout, s, signals)} -> {_format(after.holdout, s, signals)}")
    step = _describe_step(s, was, now, floor, signals)
    sentence = f"{join_words(update.added)} added: {step}{held_out}"
    return f"{sentence}." if update.helps else f"{sentence}. {update.added[-1]} explains nothing but noise."


def _describe_step(s: str, before: BySignal, after: BySignal, floor: BySignal, signals: Signals) -> str:
    was, now, noise = (_format(values, s, signals) for values in (before, after, floor))
    return f"{signals.find(s).symbol} error {was} -> {now}, noise floor {noise}"


def _tabulate_errors(rows: Sequence[Row], floor: BySignal, signals: Signals) -> Table:
    """RMS error of each signal after each step, on the fitted run and on the held-out one."""
    columns = [column for s in floor for column in (
        Column(signals.find(s).symbol, align="right"), Column("over floor", align="right", medium=Medium.PAGE))]
    runs = [run for row in rows for run in (
        (name_step(row), Cell("fitted"), row.error), ("", Cell("held-out", "muted"), row.holdout)) if run[2]]
    cells: list[list[Cell | str]] = [[step, role, *(
        cell for s in floor for ratio in [errors.get(s, math.nan) / floor[s]]
        for cell in (Cell(_format(errors, s, signals), "good" if ratio <= GOOD_RATIO else "bad"),
                     Cell(format_ratio(ratio), "muted")))] for step, role, errors in runs]
    floors = [Cell(text, "muted") for s in floor for text in (_format(floor, s, signals), "1")]
    return Table([Column("step"), Column("run"), *columns], [*cells, [Cell("noise floor", "muted"), "", *floors]],
                 f"RMS error of each signal. Green: at most {GOOD_RATIO:g} times the noise floor.")
