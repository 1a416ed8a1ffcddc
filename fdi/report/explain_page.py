"""One HTML page about an explanation, or about a model and its ledger, that needs no network."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fdi.discovery.candidates import Answer, Candidate, Suspicious, Value
from fdi.discovery.model_file import Provenance, Row
from fdi.discovery.refit import Refit
from fdi.discovery.residual_pattern import Pattern
from fdi.discovery.runs import Source
from fdi.report import explain_figures, explain_text
from fdi.report.html import load_templates
from fdi.report.numbers import (
    SIGNAL_NAMES,
    SIGNAL_UNITS,
    format_amount,
    format_interval,
    format_p_value,
    format_ratio,
    name_parameter,
)

MOODS = {"NOTHING_MISSING": "good", "EXPLAINED": "good", "PARTLY": "doubtful", "AMBIGUOUS": "doubtful",
         "NOT_RESOLVABLE": "doubtful", "UNEXPLAINED": "bad"}
ROLES = ("trace", "repeat", "held-out run")


def explanation(a: Answer, title: str, model: str, sources: Sequence[Source], command: str, then: str = "",
                shape: Pattern | None = None, notes: Sequence[str] = ()) -> str:
    """The page of `rig explain`.

    Args:
        a: what was found.
        title: what the run is called.
        model: what the model is called.
        sources: the runs, the explained one first, a held-out one last.
        command: what was typed.
        then: what to type next.
        shape: of what is left over.
        notes: what a reader must know of the runs.
    """
    e = a.explanation
    trace = e.search.problem.trace
    after = a.best if a.best is not e.base else None
    return _page(
        title=title, verdict=a.verdict, mood=MOODS[a.verdict], why=explain_text.sentence(a),
        lines=explain_text.lines(a), then=then,
        notes=notes, facts=[("model", model), *_runs(sources, bool(a.baseline["holdout"]))], command=[command],
        candidates=[_candidate(c, list(e.floor)) for c in a.explanations], signals=[SIGNAL_NAMES[s] for s in e.floor],
        parameters=_parameters([c for c in a.candidates if c.effect in e.effects]),
        left=explain_figures.left_over(trace, e.base, after, e.floor,
                                "with what was found" if e.effects else "with the best candidate"),
        ranking=explain_figures.ranking(a.explanations, e.floor) if a.candidates else "",
        ledger=explain_figures.ledger([Row(*row) for row in a.ledger], a.baseline["floor"])
        if len(a.ledger) > 2 else "",
        shape=explain_figures.shape(shape, trace.t) if shape and shape.place else "",
        blind=[(b.effect, name_parameter(b.parameter), format_amount(b.smallest, b.unit),
                format_amount(b.usual, b.unit),
                not b.smallest <= b.usual) for b in a.blind], suspicious=_suspicious(a.suspicious))


def ledger(r: Refit, p: Provenance, intervals: Mapping[str, Value], title: str, why: str,
           doubts: Sequence[Suspicious], notes: Sequence[str] = ()) -> str:
    """The page of `rig add` and `rig remove`."""
    trace, floor, rows = r.search.problem.trace, p.floor or r.floor, p.ledger
    sources, mood = [s for s in (p.trace, *p.repeats, p.holdout) if s], "good" if r.helps else "doubtful"
    first, last = r.steps[0].hypothesis, r.last.hypothesis
    return _page(
        title=title, verdict="FITTED", mood=mood, why=why, lines=[], then="", notes=notes, command=p.history,
        facts=_runs(sources, bool(p.holdout)), candidates=[], signals=[SIGNAL_NAMES[s] for s in floor],
        parameters=[(name, format_interval(v.value, v.low, v.high, v.unit)) for name, v in intervals.items()],
        left=explain_figures.left_over(trace, first, last if last is not first else None, floor), ranking="", shape="",
        ledger=explain_figures.ledger(rows, floor), blind=[], suspicious=_suspicious(doubts),
        rows=[_row(row, floor) for row in rows])


def _page(**content: Any) -> str:
    return load_templates().get_template("story.html").render(**{"rows": [], **content})


def _runs(sources: Sequence[Source], held: bool) -> list[tuple[str, str]]:
    last = len(sources) - 1
    return [(ROLES[0] if i == 0 else ROLES[2] if held and i == last else ROLES[1], s.file)
            for i, s in enumerate(sources)]


def _candidate(c: Candidate, signals: Sequence[str]) -> dict[str, Any]:
    return {"name": " + ".join([*c.beside, c.effect]), "word": c.word, "sizes": [explain_text.value(n, v) for n, v in
                                                                            c.parameters.items()],
            "ratios": [format_ratio(c.ratios[s]) if s in c.ratios else "–" for s in signals],
            "holdout": [format_amount(c.holdout[s], SIGNAL_UNITS[s]) if s in c.holdout else "–" for s in signals],
            "evidence": f"{c.evidence:.0f}", "p": format_p_value(c.p_value),
            "named": c.word in ("explains", "equal")}


def _parameters(named: Sequence[Candidate]) -> list[tuple[str, str]]:
    return [(name, format_interval(v.value, v.low, v.high, v.unit)) for c in named for name, v in c.parameters.items()]


def _suspicious(found: Sequence[Suspicious]) -> list[tuple[str, str, str]]:
    return [(s.parameter, format_amount(s.value, s.unit), f"{s.tolerances:+.1f}") for s in found]


def _row(row: Row, floor: Mapping[str, float]) -> dict[str, Any]:
    return {"name": "the model as it was" if row.effect is None else f"{'–' if row.removed else '+'} {row.effect}",
            "cells": [(format_amount(by.get(s, float("nan")), SIGNAL_UNITS[s]),
                       format_ratio(by.get(s, float("nan")) / floor[s]))
                      for by in (row.error, row.holdout) for s in floor]}
