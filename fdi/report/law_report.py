"""The part of an explanation's report about the law that the residual follows: terms, errors, dependences, JSON."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from fdi.report.numbers import SIGNAL_NAMES, format_interval, format_ratio, format_signal
from fdi.report.report import Cell, Column, Figure, Line, Medium, Section, Table

if TYPE_CHECKING:
    from fdi.discovery.laws.find_law import Law, LawSearch, Missing

PLACES = {"force": "force on the ram", "flow": "flow to the jack", "current": "current in the torque motor"}


def list_law_sections(found: LawSearch) -> list[Section]:
    """The law with its terms, what error it leaves, what the residual follows, and the picture of both."""
    sections = []
    if found.law is not None and found.law.holds:
        sections += [Section("Law", [_tabulate_terms(found.law)]),
                     Section("Error with the law", [_tabulate_errors(found, found.law)])]
    if any(m.dependences for m in found.missing):
        sections.append(Section("What the residual follows", [_tabulate_dependences(found.missing)],
                                medium=Medium.PAGE))
    if found.curve is not None and found.law is not None and found.law.holds:
        from fdi.report.explain_figures import draw_law

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
    from fdi.discovery.laws.effect_source import describe_formula

    rows: list[list[Cell | str]] = []
    for term in law.terms:
        for name, unit in zip(term.fields, term.units, strict=True):
            v = law.values[name]
            words = term.words if name == term.name else name.removeprefix(f"{term.name}_")
            rows.append([Cell(name, is_strong=name == term.name), words,
                         format_interval(v.value, v.low, v.high, unit)])
    return Table([Column("parameter"), Column("meaning"), Column("value and 95 % interval")], rows,
                 f"The law: {describe_formula(law.terms)}.", is_list=True)


def _tabulate_errors(found: LawSearch, law: Law) -> Table:
    signals = list(found.floor)
    has_holdout = bool(law.holdout)
    columns = [Column("model"), *(Column(SIGNAL_NAMES[s], align="right") for s in signals)]
    if has_holdout:
        columns += [Column(f"{SIGNAL_NAMES[s]}, held-out", align="right") for s in signals]
    rows: list[list[Cell | str]] = []
    for name, errors, held in list_errors(found, law):
        mood = "good" if name == "with the law" else ""
        row: list[Cell | str] = [Cell(name, "good" if mood else "", is_strong=bool(mood))]
        row += [_format(errors, s) for s in signals]
        rows.append([*row, *(_format(held, s) for s in signals)] if has_holdout else row)
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


def _format(errors: Mapping[str, float], signal: str) -> str:
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
    from fdi.discovery.laws.effect_source import describe_formula

    terms = [{"term": t.name, "place": t.place, "meaning": t.words,
              "parameters": {f: law.values[f]._asdict() for f in t.fields}} for t in law.terms]
    data["law"] = {
        "holds": law.holds, "reason": law.reason, "formula": describe_formula(law.terms), "terms": terms,
        "beside": list(found.base.effects), "equal_terms": list(law.equals), "effects": list(effects),
        "errors": [{"model": name, "error": dict(errors), "holdout": dict(held)}
                   for name, errors, held in list_errors(found, law)]}
    return data
