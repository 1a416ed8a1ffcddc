"""The report of a diagnosis: verdict, both faults, response in its bands, RMS maps, precursors, provenance."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fdi.diagnosis.bands import Event
from fdi.diagnosis.diagnosis import Diagnosis
from fdi.diagnosis.faults import CLOGGING, FAULTS, FRICTION, Estimate, Fault, Level, compute_severity
from fdi.diagnosis.joint_search import Beside, Explanation
from fdi.diagnosis.precursors import format_precursor
from fdi.report.numbers import NO_NUMBER, SIGNAL_NAMES, format_digits, format_interval, format_ratio, join_words
from fdi.report.report import (
    Cell,
    Column,
    Figure,
    Item,
    Line,
    Medium,
    Mood,
    Paragraph,
    Report,
    Section,
    Table,
)
from fdi.sources import name_software
from plant.model import find_quantity

FAULT_NAMES = {CLOGGING.name: "filter clogging", FRICTION.name: "spool friction"}
SIZE_SYMBOLS = {CLOGGING.name: "Kintas", FRICTION.name: "FSS"}
LEVEL_NAMES = {Level.ACCEPTABLE: "acceptable", Level.MAINTENANCE: "maintenance", Level.NON_NOMINAL: "non-nominal",
               None: "cannot be judged"}
LEVEL_MOODS: dict[Level | None, Mood] = {Level.ACCEPTABLE: "good", Level.MAINTENANCE: "doubtful",
                                         Level.NON_NOMINAL: "bad", None: "muted"}
VERDICT_MOODS: dict[str, Mood] = {"ACCEPTABLE": "good", "MAINTENANCE": "doubtful", "NON_NOMINAL": "bad"}
BAND_NAMES: dict[str, Cell] = {"middle": Cell("MidBand", "doubtful"), "most": Cell("MaxBand", "bad")}
SUSPECTS = {  # parameter: its name, SI unit or the unit shown, factor from SI
    "jack.dynamic_friction": ("jack friction", "N", 1.0), "jack.damping": ("viscous drag of the jack", "N s/m", 1.0),
    "jack.mass": ("moving mass", "kg", 1.0), "jack.leakage": ("leakage across the piston", "m3/s/Pa", 1.0),
    "null_bias.current": ("null bias", "mA", 1e3), "constant_load.force": ("unmeasured constant load", "N", 1.0),
}


def build_diagnosis_report(d: Diagnosis) -> Report:
    """Report on a diagnosis; its `data` is the answer of `rig fdi --json`."""
    return Report(
        command="fdi", title=d.source, verdict=d.verdict, mood=VERDICT_MOODS.get(d.verdict, "doubtful"),
        sentence=describe_verdict(d), facts=_list_facts(d),
        notes=[*describe_overruled_bands(d), *explain_grid(d), *d.notes],
        sections=[Section("Faults", _show_faults(d)),
                  Section("Other effects", _tabulate_effects(d)),
                  Section("Response in its bands", _draw_bands(d)),
                  Section("Events", _tabulate_events(d)),
                  Section("RMS maps", _show_maps(d), medium=Medium.PAGE),
                  Section("Precursors", _show_precursors(d)),
                  Section("Fit", _describe_fit(d)),
                  Section("Provenance of the bands", _list_bands_provenance(d), medium=Medium.PAGE)],
        data=collect_data(d))


def build_bands_report(made: Mapping[str, Any]) -> Report:
    """Report on bands that `rig fdi --learn-bands` wrote."""
    judged = join_words(FAULT_NAMES[name] for name in made["judges"])
    return Report(
        command="fdi", title=str(made["bands"]), files=[("bands", str(made["bands"]))],
        sentence=f"The bands judge {judged}." if judged else
        "The bands judge neither fault: the responses of both are within the scatter of healthy units.",
        sections=[Section("Provenance", [Line(label, str(text)) for label, text in made["provenance"].items()])],
        data=made)


def describe_verdict(d: Diagnosis) -> str:
    """The verdict in a sentence or two."""
    if d.verdict == "SOMETHING_ELSE" and d.beside is not None:
        return (f"Neither the two faults nor they and other effects of the catalogue explain this trace: the residual "
                f"of the best fit is {describe_residual(d)}. No fault is reported until the cause is known.")
    if d.verdict == "SOMETHING_ELSE":
        return (f"Neither fault explains this trace: the residual of the best fit is {describe_residual(d)}. Something "
                "else is wrong; no fault is reported until the cause is known. rig fdi --with-effects searches for the "
                "cause and sizes both faults beside it.")
    if d.verdict == "CANNOT_TELL":
        names = join_words(FAULT_NAMES[name] for name, level in d.levels.items() if level is None)
        if d.beside is not None and d.beside.disputed:
            return (f"The level of {names} depends on what else is wrong, and this trace does not tell "
                    f"{_join_alternatives(d.beside)} apart." + _describe_other_deviations(d))
        return f"This trace does not determine {names}: a healthy unit and MidBand are both within the 95 % interval."
    if d.verdict == "ACCEPTABLE":
        return "Both faults are acceptable." + _describe_other_deviations(d)
    worst = next(fault for fault in FAULTS if fault.name == d.ruling)
    need = "requires maintenance" if d.levels[worst.name] == Level.MAINTENANCE else "is non-nominal"
    rest = "; ".join(_describe_level(d, fault) for fault in FAULTS if fault is not worst)
    return (f"{FAULT_NAMES[worst.name].capitalize()} {need}: {describe_size(worst, d.sizes[worst.name])}; {rest}."
            + _describe_other_deviations(d))


def _describe_level(d: Diagnosis, fault: Fault) -> str:
    level = d.levels[fault.name]
    verb = "" if level is None else "is "
    return f"{FAULT_NAMES[fault.name]} {verb}{LEVEL_NAMES[level]}"


def describe_size(fault: Fault, size: Estimate) -> str:
    """A fault size with its 95 % interval and the two limits.

    >>> describe_size(CLOGGING, Estimate(0.2512, 0.204, 0.299))
    'Kintas 0.251 (0.204 .. 0.299), MidBand 0.25, MaxBand 0.35'
    """
    middle, most = format_limits_of_fault(fault)
    return f"{SIZE_SYMBOLS[fault.name]} {format_size(fault, size)}, MidBand {middle}, MaxBand {most}"


def format_size(fault: Fault, size: Estimate) -> str:
    """A fault size with its 95 % interval, in the fault's unit.

    >>> format_size(FRICTION, Estimate(45.01, 42.02, 48.2))
    '45.0 N (42.0 .. 48.2)'
    """
    return format_interval(size.value, size.low, size.high, fault.unit)


class FoundFault(NamedTuple):
    """A fault as a diagnosis judged it, in words."""

    name: str
    level: str
    size: str  # symbol, value and 95 % interval


def list_found_faults(answer: Mapping[str, Any]) -> list[FoundFault]:
    """Both faults of an answer of `rig fdi --json`; none if it has no levels, because the trace cannot be judged."""
    if not answer.get("level"):
        return []
    words = {level.word: name for level, name in LEVEL_NAMES.items() if level is not None}
    found = []
    for fault in FAULTS:
        size = Estimate(**{key: math.nan if x is None else x for key, x in answer["refined"][fault.symbol].items()})
        level = words.get(answer["level"][fault.name], LEVEL_NAMES[None])
        found.append(FoundFault(FAULT_NAMES[fault.name], level,
                                f"{SIZE_SYMBOLS[fault.name]} {format_size(fault, size)}"))
    return found


def format_limits_of_fault(fault: Fault) -> tuple[str, str]:
    """MidBand and MaxBand of a fault.

    >>> format_limits_of_fault(FRICTION)
    ('35 N', '70 N')
    """
    unit = "" if fault.unit == "1" else f" {fault.unit}"
    return f"{fault.middle:g}{unit}", f"{fault.most:g}{unit}"


def describe_residual(d: Diagnosis) -> str:
    """The residual of the best fit: "XJ 1.00, P12 1.02 times the noise floor"."""
    ratios = ", ".join(f"{SIGNAL_NAMES[s]} {format_ratio(ratio)}" for s, ratio in d.refinement.ratio.items())
    return f"{ratios} times the noise floor"


def describe_overruled_bands(d: Diagnosis) -> list[str]:
    """A sentence for each fault that the fit judges better than the bands do: which result to trust, and why."""
    sentences = []
    for fault in FAULTS:
        by_bands = d.band_verdict.levels.get(fault.name) if d.band_verdict else None
        level = d.levels[fault.name]
        if by_bands is not None and level is not None and by_bands > level:
            others = "; ".join(describe_deviation(name, size) for name, size in d.others.items())
            cause = f", with {others}" if others else ""
            sentences.append(f"The bands call {FAULT_NAMES[fault.name]} {LEVEL_NAMES[by_bands]}; the fit, which models "
                             f"the whole plant, finds it {LEVEL_NAMES[level]}{cause}. Trust the fit.")
    return sentences


def explain_grid(d: Diagnosis, far: float = 2.0) -> list[str]:
    """A sentence for each fault whose size in the grid contradicts the fit, with the reason.

    `far`: cells of the grid outside the interval of the fit.
    """
    sentences = []
    g = d.grid
    for fault, axis in zip(FAULTS, (g.kintas, g.fss) if g else (), strict=False):
        assert g is not None
        size, found = d.sizes[fault.name], float(getattr(g.merged, fault.symbol))
        outside = max(size.low - found, found - size.high)
        if outside <= far * float(axis[1] - axis[0]):
            continue
        parts = [f"{words} {format_digits(float(getattr(part.minimum, fault.symbol)))}"
                 for words, part in (("steps", g.step), ("ramps", g.ramp)) if part is not None]
        symbol, unit = SIZE_SYMBOLS[fault.name], "" if fault.unit == "1" else f" {fault.unit}"
        sentence = (f"The grid gives {symbol} {format_digits(found)}{unit} (minima: {', '.join(parts)}), the fit "
                    f"{format_size(fault, size)}: the grid matches the position alone with a plant that has only "
                    "these two faults")
        if d.others:
            sentence += f", here with {'; '.join(describe_deviation(name, e) for name, e in d.others.items())}"
        if "xj" in d.refinement.errors:
            sentence += (f"; its best cell leaves {1e6 * g.joint.minimum.rms:.3g} um of the position, the fit "
                         f"{1e6 * d.refinement.errors['xj']:.3g} um")
        trust = "Trust the fit" if d.refinement.is_explained else "The fit does not explain the trace either"
        sentences.append(f"{sentence}. {trust}.")
    return sentences


def _describe_other_deviations(d: Diagnosis) -> str:
    words = ""
    if d.beside is not None and d.beside.is_explained and d.beside.effects:
        words = f" Beside the faults: {_join_alternatives(d.beside)}."
    if not d.others:
        return words
    others = "; ".join(describe_deviation(name, e) for name, e in d.others.items())
    return f"{words} Other deviations: {others}."


def _join_alternatives(b: Beside) -> str:
    """Effects beside the faults: those of one explanation by "and", explanations that fit equally well by "or"."""
    marks = join_words(b.marks)
    found = " or ".join(name_explanation(e) for e in b.explanations if e.effects or not marks)
    return f"{marks} and {found}" if marks and any(e.effects for e in b.explanations) else marks or found


def name_explanation(e: Explanation) -> str:
    """The effects of an explanation beside the faults, in words."""
    return " with ".join(e.effects) or "no other effect"


def describe_deviation(parameter: str, size: Estimate) -> str:
    """A parameter that differs from a healthy unit's, with its 95 % interval.

    >>> describe_deviation("null_bias.current", Estimate(2.4e-4, 2.3e-4, 2.5e-4))
    'null bias 0.240 mA (0.230 .. 0.250)'
    """
    name, unit, scale = SUSPECTS[parameter]
    return f"{name} {format_interval(scale * size.value, scale * size.low, scale * size.high, unit)}"


def _list_facts(d: Diagnosis) -> list[tuple[str, str]]:
    c = d.trace
    changes = [f"{name}={value:g}" for name, value in sorted(d.model.list_changes().items())]
    return [("trace", f"{len(c) * c.period:.3f} s, {len(c)} cycles of {1e3 * c.period:g} ms"),
            ("signals", ", ".join(SIGNAL_NAMES[name] for name in c.outputs)),
            ("model", " ".join([d.model.name, *changes])), ("software", name_software())]


def _show_faults(d: Diagnosis) -> list[Item]:
    columns = [Column("fault"), Column("level"), Column("size (95 % interval)", align="right"),
               Column("MidBand", align="right", medium=Medium.PAGE),
               Column("MaxBand", align="right", medium=Medium.PAGE), Column("grid", align="right"), Column("by bands")]
    rows = [_list_fault_cells(d, fault) for fault in FAULTS]
    limits = "; ".join(f"{SIZE_SYMBOLS[f.name]} {' and '.join(format_limits_of_fault(f))}" for f in FAULTS)
    caption = (f"Size: fitted by replay of the measured current. Grid: minimum of the RMS maps. By bands: level by the "
               f"response alone. Limits (MidBand and MaxBand): {limits}.")
    if d.ruling:
        caption += " * marks the ruling fault."

    def draw() -> str:
        from fdi.report import diagnosis_figures  # here: matplotlib takes half a second to import

        return diagnosis_figures.draw_sizes(d.sizes, d.grid, d.band_verdict)

    return [Table(columns, rows, caption),
            Figure("Each estimate of the two sizes over the three levels: green acceptable, amber maintenance, red "
                   "non-nominal. Circle: fit with its 95 % interval; diamonds: the other methods.", draw)]


def _list_fault_cells(d: Diagnosis, fault: Fault) -> list[Cell | str]:
    level = d.levels[fault.name]
    by_bands = d.band_verdict.levels.get(fault.name) if d.band_verdict else None
    at_grid = float(getattr(d.grid.merged, fault.symbol)) if d.grid else math.nan
    unit = "" if fault.unit == "1" or d.grid is None else f" {fault.unit}"
    mark = " *" if d.ruling == fault.name else ""
    return [FAULT_NAMES[fault.name] + mark, Cell(LEVEL_NAMES[level], LEVEL_MOODS[level]),
            Cell(format_size(fault, d.sizes[fault.name]), is_strong=True), *format_limits_of_fault(fault),
            format_digits(at_grid) + unit,
            Cell("not judged" if by_bands is None else LEVEL_NAMES[by_bands], LEVEL_MOODS[by_bands])]


def _tabulate_effects(d: Diagnosis) -> list[Item]:
    """One row for each explanation that may be right: its effects with sizes, and what it makes of both faults."""
    b = d.beside
    if b is None:
        return []
    columns = [Column("beside the faults"), Column("probability", "%", "right"), Column("size (95 % interval)"),
               *(column for fault in FAULTS for column in (Column(SIZE_SYMBOLS[fault.name], align="right"),
                                                           Column("level"))),
               Column("residual / noise", align="right", medium=Medium.PAGE)]
    rows: list[list[Cell | str]] = []
    for e in b.explanations:
        sizes = "; ".join(_format_parameter(name, size) for name, size in e.parameters.items())
        cells: list[Cell | str] = []
        for f in FAULTS:
            level = e.levels[f.name] if d.refinement.is_explained else None
            cells += [format_size(f, e.sizes[f.name]), Cell(LEVEL_NAMES[level], LEVEL_MOODS[level])]
        rows.append([name_explanation(e), f"{100 * e.weight:.0f}", sizes or NO_NUMBER, *cells,
                     format_ratio(max(e.refinement.ratio.values()))])
    words = ("Explanations that fit the trace about equally well; the sizes above are averaged over them." if
             b.is_ambiguous else "What the search found beside the faults, fitted together with them.")
    if not b.is_explained:
        words = "The best that the search found; it leaves more than noise, so no level follows from it."
    found: list[Item] = [Table(columns, rows, words)]
    for effect, parameters in b.marks.items():
        sizes = "; ".join(_format_parameter(name, size) for name, size in parameters.items())
        found.append(Line(effect, f"{sizes}, read off without noise"))
    found += [Paragraph(f"The level of {FAULT_NAMES[name]} depends on which of these is right: cannot be judged.")
              for name in b.disputed]
    return found


def _format_parameter(name: str, size: Estimate) -> str:
    unit = find_quantity(name).unit
    return f"{name} {format_interval(size.value, size.low, size.high, unit)}"


def _draw_bands(d: Diagnosis) -> list[Item]:
    judged, bands = d.band_verdict, d.bands
    if judged is None:
        return []

    def draw_overview() -> str:
        from fdi.report import diagnosis_figures

        return diagnosis_figures.draw_overview(d.trace, judged)

    def draw_steps() -> str:
        from fdi.report import diagnosis_figures

        return "" if bands is None else diagnosis_figures.draw_steps(d.trace, bands, judged)

    def draw_ramps() -> str:
        from fdi.report import diagnosis_figures

        return "" if bands is None else diagnosis_figures.draw_ramps(d.trace, bands, judged)

    return [Figure("Command and ram position. Shaded: times outside MidBand (amber) and MaxBand (red).",
                   draw_overview),
            Figure("Steps judge filter clogging: measured position less that of a healthy unit with the friction that "
                   "the ramps show. Green: scatter of healthy units; amber and red: limits, drawn where clogging is "
                   "distinguishable from healthy scatter.", draw_steps),
            Figure("Ramps judge spool friction: following error (top) and speed beyond the demand (bottom). Green: "
                   "scatter of healthy units; amber and red: limits.", draw_ramps)]


def _tabulate_events(d: Diagnosis) -> list[Item]:
    if d.band_verdict is None:
        return []
    if not d.events:
        return [Paragraph("None: the response stays within MidBand.", medium=Medium.PAGE)]
    columns = [Column("band"), Column("signal"), Column("section"), Column("events", align="right"),
               Column("first begins", "s", "right"), Column("last ends", "s", "right"),
               Column("time outside", "ms", "right"), Column("furthest", align="right", medium=Medium.PAGE)]
    rows = [_summarise_events(group) for group in group_events(d.events)]
    return [Table(columns, rows, "Times outside a band, by band, signal and section of the command. rig fdi --json "
                                 "lists every event with its distance from the band.", terminal_rows=10)]


def group_events(events: Sequence[Event], apart: float = 0.5) -> list[list[Event]]:
    """Events of one band, signal and section together; one that is more than `apart` s later starts a new group.

    A command may have several sections of the same name.
    """
    groups: list[list[Event]] = []
    for event in events:
        own = next((group for group in reversed(groups) if group[-1][:3] == event[:3]), None)
        if own is None or event.t_in - own[-1].t_out > apart:
            groups.append([event])
        else:
            own.append(event)
    return groups


def _summarise_events(group: Sequence[Event]) -> list[Cell | str]:
    first = group[0]
    scale, unit = (1e6, "um") if first.signal == "position" else (1e3, "mm/s")
    furthest = max(abs(event.excess) for event in group)
    return [BAND_NAMES[first.band], first.signal, first.section, str(len(group)), f"{first.t_in:.3f}",
            f"{group[-1].t_out:.3f}", f"{1e3 * sum(event.t_out - event.t_in for event in group):.0f}",
            f"{furthest * scale:.3g} {unit}"]


def _show_maps(d: Diagnosis) -> list[Item]:
    grid = d.grid
    if grid is None:
        return []

    def draw() -> str:
        from fdi.report.diagnosis_figures import draw_maps

        return draw_maps(grid)

    found = (("steps, A", grid.step), ("ramps, B", grid.ramp), ("both, C", grid.joint))
    rows = [[name, f"{m.minimum.kintas:.3f}", f"{m.minimum.fss:.3g}", f"{m.minimum.rms * 1e6:.2f}"]
            for name, m in found if m]
    rows.append([f"centre of gravity, G ({100 * grid.merged.weight:.0f} % of A)", f"{grid.merged.kintas:.3f}",
                 f"{grid.merged.fss:.3g}", ""])
    columns = [Column("minimum"), Column("Kintas", align="right"), Column("FSS", "N", "right"),
               Column("RMS", "um", "right")]
    return [Figure("RMS difference between the measured position and that of the monitor model, for every pair of "
                   "fault sizes (logarithmic colour scale). The minima A (steps) and B (ramps) are merged into G; "
                   "dashed: the first bisector.", draw),
            Table(columns, rows, "Where each map has its minimum.", is_list=True)]


def _show_precursors(d: Diagnosis) -> list[Item]:
    if not d.precursors:
        return []
    clogging, friction = f"Kintas {CLOGGING.middle:g} adds", f"FSS {FRICTION.middle:g} N adds"
    columns = [Column("precursor"), Column("measured", align="right"),
               Column("healthy", "", "right", Medium.PAGE), Column("healthy s.d.", "", "right", Medium.PAGE),
               Column("deviation", "s.d.", "right"),
               Column(clogging, "", "right", Medium.PAGE), Column("in s.d.", "", "right", Medium.PAGE),
               Column(friction, "", "right", Medium.PAGE), Column("in s.d.", "", "right", Medium.PAGE)]
    rows: list[list[Cell | str]] = []
    for name, p in d.precursors.items():
        is_far = math.isfinite(p.departure) and abs(p.departure) > 4.0
        rows.append([p.words, Cell(p.shown, is_strong=True), format_precursor(p.healthy, name),
                     format_precursor(p.noise, name),
                     Cell(_format_deviation(p.departure), "bad" if is_far else ""), format_precursor(p.clogging, name),
                     _format_deviation(p.clogging_ratio), format_precursor(p.friction, name),
                     _format_deviation(p.friction_ratio)])

    def draw() -> str:
        from fdi.report import diagnosis_figures

        return diagnosis_figures.draw_precursor_shifts(d.precursors)

    return [Table(columns, rows, "Deviation: measured minus healthy mean, in standard deviations of healthy units; red "
                                 "beyond 4."),
            Figure("How far a fault at MidBand moves each precursor, in standard deviations of healthy units: longer "
                   "bars discriminate better; below the dotted line (3) a single test does not show the fault.", draw)]


def _format_deviation(x: float) -> str:
    return f"{x:+.1f}" if math.isfinite(x) else NO_NUMBER


def _describe_fit(d: Diagnosis) -> list[Item]:
    lines: list[Item] = [
        Line("residual", describe_residual(d)),
        Line("fit", f"{d.refinement.method}, {d.refinement.simulations} simulations; correlation of the two sizes "
                    f"{d.refinement.correlation:+.2f}")]
    return [*lines, *(Line("deviation", describe_deviation(name, size)) for name, size in d.others.items())]


def _list_bands_provenance(d: Diagnosis) -> list[Item]:
    if d.bands is None or not d.bands.provenance:
        return []
    rows: list[list[Cell | str]] = [[Cell(name, "muted"), text] for name, text in sorted(d.bands.provenance.items())]
    return [Table([Column(""), Column("")], rows, is_list=True)]


def collect_data(d: Diagnosis) -> dict[str, Any]:
    """The answer of `rig fdi --json`; SI units."""
    g, r = d.grid, d.refinement
    return {
        "verdict": d.verdict, "sentence": describe_verdict(d),
        "level": {name: level.word if level is not None else None for name, level in d.levels.items()},
        "ruling": d.ruling,
        "severity": {f.name: compute_severity(f, d.sizes[f.name].value) for f in FAULTS},
        "events": [e._asdict() for e in d.events],
        "bands": {"level": {name: level.word for name, level in d.band_verdict.levels.items()},
                  "ruling": d.band_verdict.ruling} if d.band_verdict else None,
        "precursors": {name: p._asdict() for name, p in d.precursors.items()},
        "grid": {"step": _collect_point(g.step and g.step.minimum), "ramp": _collect_point(g.ramp and g.ramp.minimum),
                 "joint": _collect_point(g.joint.minimum), "merged": g.merged._asdict(), "simulations": g.simulations}
        if g else None,
        "refined": {"kintas": d.sizes[CLOGGING.name]._asdict(), "fss": d.sizes[FRICTION.name]._asdict(),
                    "correlation": r.correlation, "method": r.method, "simulations": r.simulations,
                    "reached": r.is_explained},
        "signals": {s: {"error": r.errors[s], "floor": r.floor[s], "ratio": r.ratio[s]} for s in r.errors},
        "others": {name: {**e._asdict(), "unhealthy": name in d.others} for name, e in r.others.items()},
        "notes": list(d.notes),
        **({"with_effects": _collect_beside(d.beside)} if d.beside is not None else {}),
    }


def _collect_beside(b: Beside) -> dict[str, Any]:
    """What was searched and found beside the faults; SI units."""
    return {
        "effects": list(b.effects), "explained": b.is_explained, "ambiguous": b.is_ambiguous,
        "disputed": list(b.disputed),
        "marks": {effect: {name: e._asdict() for name, e in own.items()} for effect, own in b.marks.items()},
        "explanations": [
            {"effects": list(e.effects), "probability": e.weight,
             "parameters": {name: {**v._asdict(), "unit": find_quantity(name).unit}
                            for name, v in e.parameters.items()},
             **{f.symbol: e.sizes[f.name]._asdict() for f in FAULTS},
             "level": {name: level.word if level is not None and e.refinement.is_explained else None
                       for name, level in e.levels.items()},
             "ratio": dict(e.refinement.ratio)} for e in b.explanations],
    }


def _collect_point(point: Any) -> dict[str, float] | None:
    return dict(point._asdict()) if point else None
