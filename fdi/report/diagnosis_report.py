"""The report of a diagnosis: verdict, faults, response in its bands, RMS maps, precursors, provenance."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from fdi.diagnosis.ambiguity import Group
from fdi.diagnosis.bands import BandFault, Bands, BandVerdict, Event, RampBand, StepBand, place_sections
from fdi.diagnosis.diagnosis import Diagnosis
from fdi.diagnosis.faults import FAULTS, Estimate, Fault, Level, compute_severity
from fdi.diagnosis.precursors import (
    Precursor,
    compute_half_range,
    find_lasting_peak,
    format_precursor,
    measure_ramp,
    select_ramp_rows,
)
from fdi.diagnosis.refine import Beside, Explanation
from fdi.diagnosis.rms_grid import Grid, Map, Merged, Point, find_corners
from fdi.estimation import Value
from fdi.report.drawing import (
    BLUE,
    COMMAND,
    GREEN,
    INK,
    ORANGE,
    RED,
    Mark,
    Panel,
    area,
    axes,
    band,
    call,
    dot,
    draw_panels,
    legend,
    levels,
    line,
    name_rows,
    shade,
    spans,
)
from fdi.report.numbers import (
    NO_NUMBER,
    choose_unit,
    format_amount,
    format_interval,
    format_limit,
    format_ratio,
    join_words,
)
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
    tabulate,
)
from fdi.sources import name_software
from fdi.thresholds import BAND_NEAREST_LIMIT_SD
from fdi.trace import Section as CommandSection, Trace, find_sections

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
    t, page = d.trace, Medium.PAGE
    changes = [f"{name}={value:g}" for name, value in sorted(d.model.list_changes().items())]
    facts = [("trace", f"{len(t) * t.period:.3f} s, {len(t)} cycles of {1e3 * t.period:g} ms"),
             ("signals", ", ".join(t.declared.find(name).symbol for name in t.outputs)),
             ("model", " ".join([d.model.name, *changes])), ("software", name_software())]
    provenance = {} if d.bands is None else d.bands.provenance
    sections = [
        Section("Faults", [_tabulate_faults(d), Figure(
            "Each estimate of the sizes over the three levels: green acceptable, amber maintenance, red "
            "non-nominal. Circle: fit with its 95 % interval; diamonds: the other methods.",
            partial(draw_sizes, d.faults, d.sizes, d.grids, d.band_verdict))]),
        Section("Other effects", _show_effects(d)),
        Section("Response in its bands", _show_bands(d)),
        Section("Events", _tabulate_events(d)),
        Section("RMS maps", [item for grid in d.grids for item in _show_maps(grid)], medium=page),
        Section("Precursors", _show_precursors(d)),
        Section("Fit", [
            Line("residual", describe_residual(d)),
            Line("fit", f"least squares, {d.refinement.simulations} simulations; "
                        f"{describe_correlation(d)}"),
            *(Line("deviation", describe_deviation(name, size)) for name, size in d.others.items())]),
        Section("Provenance of the bands", [tabulate(
            sorted(provenance.items()), (Column(""), lambda row: Cell(row[0], "muted")),
            (Column(""), lambda row: row[1]), is_list=True)], medium=page)]
    return Report("fdi", d.source, d.verdict, VERDICT_MOODS.get(d.verdict, "doubtful"), describe_verdict(d), facts,
                  [*list_overruled(d), *d.notes], sections, data=collect_diagnosis_data(d))


def build_bands_report(bands: Bands, place: str) -> Report:
    """Report on bands that `rig fdi --learn-bands` wrote to this place."""
    judges = [fault.name for fault in bands.faults if bands.shows(fault)]
    fault_names = join_words(name.replace("_", " ") for name in judges)
    return Report(
        command="fdi", title=place, files=[("bands", place)],
        sentence=f"The bands judge {fault_names}." if fault_names else
        "The bands judge none of the faults: their responses are within the scatter of healthy units.",
        sections=[Section("Provenance", [Line(label, str(text)) for label, text in bands.provenance.items()])],
        data={"bands": place, "judges": judges, "provenance": dict(bands.provenance)})


def describe_verdict(d: Diagnosis) -> str:
    """The verdict in a sentence or two."""
    no_fault, the_faults = ("neither fault", "the two faults") if len(d.faults) == 2 else ("no fault", "the faults")
    grouped_names = {name for group in d.groups for name in group}
    names = join_words(f.title for f in d.faults if d.levels[f.name] is None and f.name not in grouped_names)
    is_disputed = d.beside is not None and d.beside.disputed
    groups = " ".join(describe_group(d, group) for group in d.groups)
    match d.verdict:
        case "SOMETHING_ELSE" if d.beside is not None:
            return (f"Neither {the_faults} nor they and other effects of the catalogue explain this trace: the "
                    f"residual of the best fit is {describe_residual(d)}. No fault is reported until the cause is "
                    "known.")
        case "SOMETHING_ELSE":
            return (f"{no_fault.capitalize()} explains this trace: the residual of the best fit is "
                    f"{describe_residual(d)}. Something else is wrong; no fault is reported until the cause is known. "
                    "rig fdi --with-effects searches for the cause and sizes "
                    f"{'both' if len(d.faults) == 2 else 'the'} faults beside it.")
        case "CANNOT_TELL" if not is_disputed:
            return (f"This trace does not determine {names}: a healthy unit and MidBand are both within the 95 % "
                    "interval.")
        case "AMBIGUOUS":
            return groups + (f" This trace does not determine {names} either." if names else "")
        case "CANNOT_TELL" if d.beside is not None:
            sentence = (f"The level of {names} depends on what else is wrong, and this trace does not tell "
                        f"{_join_alternatives(d.beside)} apart.")
        case "ACCEPTABLE":
            many = {1: f"{d.faults[0].title.capitalize()} is acceptable.", 2: "Both faults are acceptable."}
            sentence = many.get(len(d.faults), f"All {len(d.faults)} faults are acceptable.")
        case _:
            worst = next(fault for fault in d.faults if fault.name == d.ruling)
            need = "requires maintenance" if d.levels[worst.name] == Level.MAINTENANCE else "is non-nominal"
            rest = _describe_rest(d, worst)
            middle, most = format_limits_of_fault(worst)
            sentence = (f"{worst.title.capitalize()} {need}: {worst.symbol} "
                        f"{format_interval(*d.sizes[worst.name], worst.unit)}, MidBand {middle}, MaxBand {most}")
            sentence += f"; {rest}." if rest else "."
            sentence += f" {groups}" if groups else ""
    if d.beside is not None and d.beside.is_explained and d.beside.effects:
        sentence += f" Beside the faults: {_join_alternatives(d.beside)}."
    return sentence + (f" Other deviations: {_list_others(d)}." if d.others else "")


def _describe_rest(d: Diagnosis, worst: Fault) -> str:
    """The levels of the faults that do not rule; of many, those that are not acceptable, and how many are."""
    rest = {fault: d.levels[fault.name] for fault in d.faults if fault != worst}
    many = [fault for fault, level in rest.items() if level == Level.ACCEPTABLE]
    parts = [f"{fault.title} {'' if level is None else 'is '}{LEVEL_NAMES[level]}"
             for fault, level in rest.items() if len(rest) == 1 or fault not in many]
    if many and len(rest) > 1:
        parts.append(f"{many[0].title} is acceptable" if len(many) == 1 else f"{len(many)} other faults are acceptable")
    return "; ".join(parts)


def describe_group(d: Diagnosis, group: Group) -> str:
    """Faults that a trace does not tell apart, and what would."""
    titles = join_words((f.title for f in d.faults if f.name in group), "or")
    return (f"At least one of these has grown, and may have reached MidBand: {titles}. This trace does not tell which; "
            f"{describe_separation(d, group)}.")


def describe_separation(d: Diagnosis, group: Group) -> str:
    """What would tell the faults of a group apart: signals that were not measured, or another test."""
    unmeasured = [s.symbol for s in d.model.kind.signals.outputs if s.name not in d.trace.outputs]
    ways = [*([f"a recording with {join_words(unmeasured)}"] if unmeasured else []),
            *(f"{e.name}: {e.revealed_by}" for e in d.model.kind.list_effects() for f in d.faults
              if f.name in group and f.parameter in e.fitted and e.revealed_by)]
    return f"to find out, try {'; '.join(ways)}" if ways else "another test, or an inspection, has to"


def describe_correlation(d: Diagnosis) -> str:
    """The strongest correlation of two sizes, and of which ones where there are more than two."""
    if len(d.faults) < 2:
        return "one fault"
    table = np.abs(np.triu(d.refinement.correlations, 1))
    i, j = np.unravel_index(int(table.argmax()), table.shape)
    which = "the two sizes" if len(d.faults) == 2 else f"{d.faults[i].symbol} and {d.faults[j].symbol}"
    return f"{'' if len(d.faults) == 2 else 'largest '}correlation of {which} {d.refinement.correlation:+.2f}"


class FoundFault(NamedTuple):
    """A fault as a diagnosis judged it, in words."""

    name: str
    level: str
    size: str  # symbol, value and 95 % interval


def list_found_faults(answer: Mapping[str, Any]) -> list[FoundFault]:
    """The faults of an answer of `rig fdi --json`; none if it has no levels, because the trace cannot be judged."""
    if not answer.get("level"):
        return []
    words = {level.word: name for level, name in LEVEL_NAMES.items() if level is not None}

    def show_size(fault: Mapping[str, Any]) -> str:
        size = {key: math.nan if x is None else x for key, x in answer["refined"][fault["key"]].items()}
        return f"{fault['symbol']} {format_interval(size['value'], size['low'], size['high'], fault['unit'])}"

    return [FoundFault(fault["title"], words.get(answer["level"][name], LEVEL_NAMES[None]), show_size(fault))
            for name, fault in (answer.get("faults") or _collect_faults(FAULTS)).items()]


def format_limits_of_fault(fault: Fault) -> tuple[str, ...]:
    """MidBand and MaxBand of a fault.

    >>> format_limits_of_fault(FAULTS[1])
    ('35 N', '70 N')
    """
    return tuple(format_limit(size, fault.unit) for size in (fault.acceptable, fault.maintenance))


def describe_residual(d: Diagnosis) -> str:
    """The residual of the best fit: "XJ 1.00, P12 1.02 times the noise floor"."""
    ratios = ", ".join(f"{d.trace.declared.find(s).symbol} {format_ratio(ratio)}"
                       for s, ratio in d.refinement.ratio.items())
    return f"{ratios} times the noise floor"


def list_overruled(d: Diagnosis, far: float = 2.0) -> Iterator[str]:
    """A sentence for each fault that bands or grid judge otherwise than the fit: which result to trust.

    `far`: cells of the grid outside the interval of the fit.
    """
    by_bands = d.band_verdict.levels if d.band_verdict else {}
    beside = f", beside {_list_others(d)}" if d.others else ""
    trust = "Trust the fit" if d.refinement.is_explained else "The fit does not explain the trace either"
    for fault in d.faults:
        size, level, objections = d.sizes[fault.name], d.levels[fault.name], []
        if level is not None and by_bands.get(fault.name, level) > level:
            objections.append(f"the bands call it {LEVEL_NAMES[by_bands[fault.name]]}")
        if (grid := _find_grid(d.grids, fault)) is not None:
            grid_size, axis = grid.find_size(fault, grid.merged), grid.axes[grid.faults.index(fault)]
            if max(size.low - grid_size, grid_size - size.high) > far * float(axis[1] - axis[0]):
                objections.append(f"the grid gives {format_amount(grid_size, fault.unit)}")
        if objections:
            yield (f"{fault.title}: {' and '.join(objections)}; the fit, which alone models the whole plant, finds "
                   f"{fault.symbol} {format_interval(*size, fault.unit)}{beside}. {trust}.")


def _find_grid(grids: Sequence[Grid], fault: Fault) -> Grid | None:
    """The first grid that has the fault."""
    return next((grid for grid in grids if fault in grid.faults), None)


def _list_others(d: Diagnosis) -> str:
    return "; ".join(describe_deviation(name, size) for name, size in d.others.items())


def _join_alternatives(b: Beside) -> str:
    """Effects beside the faults: those of one explanation by "and", explanations that fit equally well by "or"."""
    marks = join_words(b.marks)
    alternatives = " or ".join(name_explanation(e) for e in b.explanations if e.effects or not marks)
    return f"{marks} and {alternatives}" if marks and any(e.effects for e in b.explanations) else marks or alternatives


def name_explanation(e: Explanation) -> str:
    """The effects of an explanation beside the faults, in words."""
    return " with ".join(e.effects) or "no other effect"


def describe_deviation(parameter: str, size: Estimate) -> str:
    """A parameter that differs from a healthy unit's, with its 95 % interval.

    >>> describe_deviation("null_bias.current", Estimate(2.4e-4, 2.3e-4, 2.5e-4))
    'null bias 0.24 mA (0.23 .. 0.25)'
    """
    name, unit, scale = SUSPECTS[parameter]
    return f"{name} {format_interval(scale * size.value, scale * size.low, scale * size.high, unit)}"


def _tabulate_faults(d: Diagnosis) -> Table:
    by_bands = d.band_verdict.levels if d.band_verdict else {}

    def show_grid(fault: Fault) -> str:
        grid = _find_grid(d.grids, fault)
        return NO_NUMBER if grid is None else format_amount(grid.find_size(fault, grid.merged), fault.unit)

    def show_bands(fault: Fault) -> Cell:
        level = by_bands.get(fault.name)
        return Cell("not judged" if level is None else LEVEL_NAMES[level], LEVEL_MOODS[level])

    limits = "; ".join(f"{f.symbol} {' and '.join(format_limits_of_fault(f))}" for f in d.faults)
    return tabulate(
        d.faults, (Column("fault"), lambda f: f.title + (" *" if d.ruling == f.name else "")),
        (Column("level"), lambda f: Cell(LEVEL_NAMES[d.levels[f.name]], LEVEL_MOODS[d.levels[f.name]])),
        (Column("size (95 % interval)", align="right"),
         lambda f: Cell(format_interval(*d.sizes[f.name], f.unit), is_strong=True)),
        (Column("MidBand", align="right", medium=Medium.PAGE), lambda f: format_limits_of_fault(f)[0]),
        (Column("MaxBand", align="right", medium=Medium.PAGE), lambda f: format_limits_of_fault(f)[1]),
        (Column("grid", align="right"), show_grid), (Column("by bands"), show_bands),
        caption=f"Size: fitted by replay of the measured {d.trace.declared.drive.phrase}. Grid: minimum of the RMS "
                f"maps. By bands: level by the response alone. Limits (MidBand and MaxBand): {limits}."
                + (" * marks the ruling fault." if d.ruling else ""))


def _show_effects(d: Diagnosis) -> list[Item]:
    """One row for each explanation that may be right: its effects with sizes, and what it makes of the faults."""
    b = d.beside
    if b is None:
        return []

    def show_fault(fault: Fault) -> tuple[tuple[Column, Callable[[Explanation], Cell | str]], ...]:
        def show_level(e: Explanation) -> Cell:
            level = e.levels[fault.name] if d.refinement.is_explained else None
            return Cell(LEVEL_NAMES[level], LEVEL_MOODS[level])

        return ((Column(fault.symbol, align="right"),
                 lambda e: format_interval(*e.refinement.sizes[fault.name], fault.unit)),
                (Column("level"), show_level))

    caption = ("Explanations that fit the trace about equally well; the sizes above are averaged over them." if
               b.is_ambiguous else "What the search found beside the faults, fitted together with them.")
    if not b.is_explained:
        caption = "The best that the search found; it leaves more than noise, so no level follows from it."
    return [tabulate(
        b.explanations, (Column("beside the faults"), name_explanation),
        (Column("probability", "%", "right"), lambda e: f"{100 * e.weight:.0f}"),
        (Column("size (95 % interval)"), lambda e: _format_parameters(e.parameters) or NO_NUMBER),
        *(column for fault in d.faults for column in show_fault(fault)),
        (Column("residual / noise", align="right", medium=Medium.PAGE),
         lambda e: format_ratio(max(e.refinement.ratio.values()))), caption=caption),
            *(Line(effect, f"{_format_parameters(sizes)}, read off without noise")
              for effect, sizes in b.marks.items()),
            *(Paragraph(f"The level of {fault.title} depends on which of these is right: cannot be judged.")
              for fault in d.faults if fault.name in b.disputed)]


def _format_parameters(sizes: Mapping[str, Value]) -> str:
    return "; ".join(f"{name} {format_interval(*size)}" for name, size in sizes.items())


def _show_bands(d: Diagnosis) -> list[Item]:
    band_verdict, bands = d.band_verdict, d.bands
    if band_verdict is None or bands is None:
        return []
    at_steps, at_ramps = (_choose_drawn_fault(d, bands, band_verdict, kind) for kind in ("step", "ramp"))
    friction = " with the friction that the ramps show" if band_verdict.shown else ""
    return [Figure("Command and position. Shaded: times outside MidBand (amber) and MaxBand (red).",
                   partial(draw_overview, d.trace, band_verdict)),
            *([Figure(f"Steps judge {_title(d, at_steps.name)}: measured position less that of a healthy unit{friction}"
                      ". Green: scatter of healthy units; amber and red: limits, drawn where the fault is "
                      "distinguishable from it.", partial(draw_steps, d.trace, bands, band_verdict, at_steps))]
              if at_steps else []),
            *([Figure(f"Ramps judge {_title(d, at_ramps.name)}: following error (top) and speed beyond the demand "
                      "(bottom). Green: scatter of healthy units; amber and red: limits.",
                      partial(draw_ramps, d.trace, bands, band_verdict, at_ramps))] if at_ramps else [])]


def _choose_drawn_fault(d: Diagnosis, bands: Bands, band_verdict: BandVerdict, kind: str) -> BandFault | None:
    """Of the faults that sections of a kind judge, the one that is furthest in its bands."""
    names = ({r.fault for r in bands.ramps if math.isfinite(r.position.middle)} if kind == "ramp" else
             {name for s in bands.steps for name in s.middle})
    faults = [fault for fault in bands.faults if fault.name in names]
    return max(faults, key=lambda f: (f.name in d.levels, band_verdict.severity.get(f.name, -1.0)), default=None)


def _title(d: Diagnosis, fault: str) -> str:
    return next((f.title for f in d.faults if f.name == fault), fault.replace("_", " "))


def _tabulate_events(d: Diagnosis) -> list[Item]:
    if d.band_verdict is None:
        return []
    if not d.events:
        return [Paragraph("None: the response stays within MidBand.", medium=Medium.PAGE)]

    unit = d.trace.declared.controlled.unit

    def show_furthest(group: Sequence[Event]) -> str:
        furthest = max(abs(event.excess) for event in group)
        return format_amount(furthest, unit if group[0].signal == "position" else f"{unit}/s")

    return [tabulate(
        _group_events(d.events), (Column("band"), lambda group: BAND_NAMES[group[0].band]),
        (Column("fault", medium=Medium.PAGE if len(d.faults) <= 2 else Medium.BOTH),
         lambda group: _title(d, group[0].fault)),
        (Column("signal"), lambda group: group[0].signal), (Column("section"), lambda group: group[0].section),
        (Column("events", align="right"), lambda group: str(len(group))),
        (Column("first begins", "s", "right"), lambda group: f"{group[0].t_in:.3f}"),
        (Column("last ends", "s", "right"), lambda group: f"{group[-1].t_out:.3f}"),
        (Column("time outside", "ms", "right"), lambda group: f"{1e3 * sum(e.t_out - e.t_in for e in group):.0f}"),
        (Column("furthest", align="right", medium=Medium.PAGE), show_furthest),
        caption="Times outside a band, by band, fault, signal and section of the command. rig fdi --json lists every "
                "event with its distance from the band.", terminal_rows=10)]


def _group_events(events: Sequence[Event], apart: float = 0.5) -> list[list[Event]]:
    """Events of one band, fault, signal and section together; one that is more than `apart` s later starts a new group.

    A command may have several sections of the same name.
    """
    groups: list[list[Event]] = []
    for event in events:
        last_group = next((group for group in reversed(groups) if group[-1][:4] == event[:4]), None)
        if last_group is None or event.t_in - last_group[-1].t_out > apart:
            groups.append([event])
        else:
            last_group.append(event)
    return groups


def _show_maps(grid: Grid) -> list[Item]:
    maps = (("steps, A", grid.step), ("ramps, B", grid.ramp), ("both, C", grid.joint))
    points: list[tuple[str, Point | Merged]] = [
        *((name, m.minimum) for name, m in maps if m),
        (f"centre of gravity, G ({100 * grid.merged.weight:.0f} % of A)", grid.merged)]
    first, second = grid.faults
    return [Figure(f"{first.title.capitalize()} and {second.title}: RMS difference between the measured position and "
                   "that of a plant with these two faults alone, for every pair of sizes (logarithmic colours). The "
                   "minima A (steps) and B (ramps) have the mean G, weighted by where their midpoint lies between "
                   "the limits of both faults (dashed); C is the minimum of both, the star that of a finer grid.",
                   partial(draw_maps, grid)),
            tabulate(points, (Column("minimum"), lambda point: point[0]),
                     *((Column(fault.symbol, align="right"), lambda point, fault=fault: format_amount(
                         grid.find_size(fault, point[1]), fault.unit)) for fault in grid.faults),
                     (Column("RMS", align="right"), lambda point: format_amount(point[1].rms, grid.unit)
                      if isinstance(point[1], Point) else ""),
                     caption="Where each map has its minimum.", is_list=True)]


def _show_precursors(d: Diagnosis) -> list[Item]:
    if not d.precursors:
        return []

    def show_deviation(x: float) -> str:
        return f"{round(x, 1) + 0.0:+.1f}" if math.isfinite(x) else NO_NUMBER  # + 0.0: not "-0.0"

    precursors, number = d.precursors, partial(Column, unit="", align="right", medium=Medium.PAGE)

    def show_value(title: str, find_value: Callable[[Precursor], float]) -> tuple[Column, Callable[[str], Cell | str]]:
        return number(title), lambda name: format_precursor(find_value(precursors[name]), name, precursors[name].unit)

    def show_fault(fault: BandFault) -> list[tuple[Column, Callable[[str], Cell | str]]]:
        title = f"{fault.symbol} {format_limit(fault.acceptable, fault.unit)} adds"  # MidBand

        def ratio(name: str) -> Cell | str:
            return show_deviation(precursors[name].compute_ratio(fault.name))

        # of many faults there is no room for both
        return [(number(title, unit="s.d."), ratio)] if d.bands and len(d.bands.faults) > 2 else [
            show_value(title, lambda p: p.adds.get(fault.name, math.nan)), (number("in s.d."), ratio)]

    return [tabulate(
        precursors, (Column("precursor"), lambda name: precursors[name].words),
        (Column("measured", align="right"), lambda name: Cell(precursors[name].shown, is_strong=True)),
        *((show_value("healthy", lambda p: p.healthy), show_value("healthy s.d.", lambda p: p.noise),
           (Column("deviation", "s.d.", "right"), lambda name: Cell(
               show_deviation(precursors[name].departure),
               "bad" if 4.0 < abs(precursors[name].departure) < math.inf else "")),
           *(column for fault in d.bands.faults for column in show_fault(fault))) if d.bands else ()),
        caption="Deviation: measured minus healthy mean, in standard deviations of healthy units; red beyond 4."
        if d.bands else "As measured; without bands there are no healthy units to compare with.")]


def collect_diagnosis_data(d: Diagnosis) -> dict[str, Any]:
    """The answer of `rig fdi --json`; SI units."""
    r = d.refinement
    return {
        "verdict": d.verdict, "sentence": describe_verdict(d),
        "level": {name: level.word if level is not None else None for name, level in d.levels.items()},
        "ruling": d.ruling,
        "severity": {f.name: compute_severity(f, d.sizes[f.name].value) for f in d.faults},
        "faults": _collect_faults(d.faults),
        "groups": d.groups,
        "events": [e._asdict() for e in d.events],
        "bands": {"level": {name: level.word for name, level in d.band_verdict.levels.items()},
                  "ruling": d.band_verdict.ruling} if d.band_verdict else None,
        "precursors": {name: p._asdict() for name, p in d.precursors.items()},
        "grid": _collect_grid(d.grids[0]) if d.grids else None,
        "grids": [{"faults": [f.name for f in g.faults], **_collect_grid(g)} for g in d.grids],
        "refined": {**{f.key: d.sizes[f.name]._asdict() for f in d.faults},
                    "correlation": r.correlation, "method": "least squares", "simulations": r.simulations,
                    "reached": r.is_explained},
        "signals": {s: {"error": r.errors[s], "floor": r.floor[s], "ratio": r.ratio[s]} for s in r.errors},
        "others": {name: {**e._asdict(), "unhealthy": name in d.others} for name, e in r.others.items()},
        "notes": list(d.notes),
        **({"with_effects": _collect_beside(d, d.beside)} if d.beside is not None else {}),
    }


def _collect_grid(g: Grid) -> dict[str, Any]:
    def collect(point: Point | Merged) -> dict[str, Any]:
        sizes = dict(zip((f.key for f in g.faults), point.sizes, strict=True))
        return sizes | {key: x for key, x in point._asdict().items() if key != "sizes"}

    maps = (("step", g.step), ("ramp", g.ramp), ("joint", g.joint))
    return {**{name: None if grid_map is None else collect(grid_map.minimum) for name, grid_map in maps},
            "merged": collect(g.merged), "simulations": g.simulations}


def _collect_faults(faults: Sequence[Fault]) -> dict[str, dict[str, Any]]:
    keys = ("title", "symbol", "key", "parameter", "unit", "healthy", "acceptable", "maintenance")
    return {fault.name: {key: getattr(fault, key) for key in keys} for fault in faults}


def _collect_beside(d: Diagnosis, b: Beside) -> dict[str, Any]:
    """What was searched and found beside the faults; SI units."""
    return {
        "effects": list(b.effects), "explained": b.is_explained, "ambiguous": b.is_ambiguous,
        "disputed": list(b.disputed),
        "marks": {effect: {name: e._asdict() for name, e in sizes.items()} for effect, sizes in b.marks.items()},
        "explanations": [
            {"effects": list(e.effects), "probability": e.weight,
             "parameters": {name: v._asdict() for name, v in e.parameters.items()},
             **{f.key: e.refinement.sizes[f.name]._asdict() for f in d.faults},
             "level": {name: level.word if level is not None and e.refinement.is_explained else None
                       for name, level in e.levels.items()},
             "ratio": dict(e.refinement.ratio)} for e in b.explanations],
    }


SHADES = {"middle": ORANGE, "most": RED}
MAP_CONTOURS = 7
MS = 1e3


def draw_overview(trace: Trace, band_verdict: BandVerdict) -> str:
    """Command and position of the whole trace, times outside the bands shaded."""
    limits = (float(trace.t[0]), float(trace.t[-1]) + trace.period)
    command, controlled = trace.declared.command, trace.declared.controlled
    unit, scale = controlled.shown_unit, controlled.shown_scale
    return draw_panels("overview", [[[
        line(trace.t, trace.command * scale, COMMAND, f"{command.symbol}, command", 2.2),
        line(trace.t, trace.mask_unusable(controlled.name) * scale, BLUE, f"{controlled.symbol}, measured"),
        *_shade_events(band_verdict.events, limits),
        axes(xlim=limits, ylabel=f"{controlled.symbol} [{unit}]", xlabel="time [s]"), legend(2)]]], 2.4)


def draw_steps(trace: Trace, bands: Bands, band_verdict: BandVerdict, fault: BandFault) -> str:
    """Each step as it judges a fault: position less the healthy response, scatter of healthy units, limits, events."""
    place = _find_sections(trace, bands)
    panels: list[Panel] = [_draw_step(trace, bands, step, place[step.section], band_verdict, fault)
                           for step in bands.steps if fault.name in step.middle]
    across = min(2, len(panels))
    panels += [[]] * (-len(panels) % across)
    rows = [panels[i:i + across] for i in range(0, len(panels), across)]
    return draw_panels("steps", rows, 2.5 * len(rows), common_legend=True)


def _draw_step(trace: Trace, bands: Bands, step: StepBand, s: CommandSection, band_verdict: BandVerdict,
               fault: BandFault) -> Panel:
    controlled = trace.declared.controlled
    fine, small = choose_unit(controlled.unit, 0.0)
    t, begin, side = step.t * MS, float(trace.t[s.start]), np.sign(step.middle[fault.name])
    centre, spread = step.compute_centres(band_verdict.shown, bands)[0]
    middle, most, is_judged = step.compute_margins(fault, spread)
    rows = np.minimum(s.start + np.rint(step.t / trace.period).astype(int), s.stop - 1)
    healthy = BAND_NEAREST_LIMIT_SD * spread / fine
    events = [e for e in band_verdict.events if e.fault == fault.name]
    title = f"step of {(s.last - s.first) * controlled.shown_scale:+.3g} {controlled.shown_unit} at {begin:.4g} s"
    return [area(t, -healthy, healthy, GREEN, "healthy", 0.15),
            *(line(t, np.where(is_judged, side * limit, np.nan) / fine, colour, label, 1.6)
              for limit, colour, label in ((middle, ORANGE, "MidBand"), (most, RED, "MaxBand"))),
            line(t, (trace.mask_unusable(controlled.name)[rows] - centre) / fine, INK, "measured"),
            *_shade_events(events, (0.0, float(t[-1])), "position", MS, begin),
            axes(xlim=(0.0, float(t[-1])), title=title, xlabel="time from the step [ms]",
                 ylabel=f"off the healthy\nresponse [{small}]")]


def draw_ramps(trace: Trace, bands: Bands, band_verdict: BandVerdict, fault: BandFault) -> str:
    """Each ramp as it judges a fault: following error and speed within their limits, and events."""
    place = _find_sections(trace, bands)
    ramps = [ramp for ramp in bands.ramps if ramp.fault == fault.name]
    pairs = [[*_draw_ramp(trace, ramp, place[ramp.section], band_verdict, number == 0)]
             for number, ramp in enumerate(ramps)]
    return draw_panels("ramps", list(zip(*pairs, strict=True)), 4.6, common_legend=True, sharex="col", sharey="row")


def _draw_ramp(trace: Trace, ramp: RampBand, s: CommandSection, band_verdict: BandVerdict, is_first: bool
               ) -> Iterator[Panel]:
    rows, controlled = select_ramp_rows(s, trace.period), trace.declared.controlled
    speed, (fine, small) = f"{controlled.shown_unit}/s", choose_unit(controlled.unit, 0.0)
    events = [e for e in band_verdict.events if e.fault == ramp.fault]
    error, fast = measure_ramp(trace.mask_unusable(controlled.name), trace.command, s, trace.period)
    scale = ramp.compute_scale(float(compute_half_range(error)), float(find_lasting_peak(fast)))
    limits = (float(trace.t[rows.start]), float(trace.t[rows.stop - 1]))
    above = axes(title=f"ramp at {s.rate * controlled.shown_scale:+.3g} {speed}, judged from {limits[0]:.4g} s",
                 ylabel=f"error [{small}]" if is_first else "")
    below = axes(xlabel="time [s]", ylabel=f"speed beyond the\ndemand's [{speed}]" if is_first else "")
    for values, width, unit, nearer, name, labels in (
            (error, ramp.position, 1.0 / fine, 1 / scale, "position", above),
            (fast, ramp.speed, controlled.shown_scale, 1.0, "speed", below)):
        middle, healthy = width.centre * unit, width.healthy * unit
        yield [
            band(middle - healthy, middle + healthy, GREEN, "healthy", 0.15),
            *(mark for limit, colour, label in ((width.middle, ORANGE, "MidBand"), (width.most, RED, "MaxBand"))
              if np.isfinite(limit) for mark in levels(nearer * limit * unit, colour, label, 1.2, middle=middle)),
            line(trace.t[rows], values * unit, INK, "measured", 0.8), *_shade_events(events, limits, name),
            axes(xlim=limits), labels]


def _find_sections(trace: Trace, bands: Bands) -> dict[int, CommandSection]:
    """The trace's sections by their number in the bands."""
    return place_sections(bands, find_sections(trace.command, trace.period, bands.scale))


def _shade_events(events: Sequence[Event], limits: tuple[float, float], signal: str = "", unit: float = 1.0,
                  begin: float = 0.0) -> list[Mark]:
    """The times outside over the whole height; `limits` are those of the panel, in `unit` from `begin`."""
    ends = [(e.band, (e.t_in - begin) * unit, (e.t_out - begin) * unit) for e in events if signal in ("", e.signal)]
    return [spans([(a, b) for name, a, b in ends if name == band_name and b > limits[0] and a < limits[1]], colour,
                  alpha=0.18, lw=0, zorder=-1) for band_name, colour in SHADES.items()]


def draw_sizes(faults: Sequence[Fault], sizes: Mapping[str, Estimate], grids: Sequence[Grid] = (),
               band_verdict: BandVerdict | None = None) -> str:
    """The faults' sizes: refined with its interval, grid, and what the ramps show, over the three levels."""
    panels = []
    for fault in faults:
        other_sizes = []
        if (grid := _find_grid(grids, fault)) is not None:
            points = (("grid, merged", grid.merged), ("grid, steps", grid.step and grid.step.minimum),
                      ("grid, ramps", grid.ramp and grid.ramp.minimum))
            other_sizes += [(label, grid.find_size(fault, point)) for label, point in points if point]
        if band_verdict is not None and fault.name in band_verdict.shown:
            other_sizes.append(("bands, ramps", band_verdict.shown[fault.name][0]))
        panels.append(_draw_sizes_of_fault(fault, sizes[fault.name], other_sizes))
    panels += [[]] * (-len(panels) % 2)
    return draw_panels("estimates", [panels[i:i + 2] for i in range(0, len(panels), 2)], 1.9 * ((len(panels) + 1) // 2))


def _draw_sizes_of_fault(fault: Fault, fit: Estimate, other_sizes: Sequence[tuple[str, float]]) -> Panel:
    _, middle, most = fault.limits
    reach = [fit.low, fit.high, *(size for _, size in other_sizes)]
    end = max(most / 0.7, *(1.05 * fault.measure_departure(size) for size in reach))
    interval = [[max(fit.value - fit.low, 0.0)], [max(fit.high - fit.value, 0.0)]]
    ways = (-1.0, 1.0) if fault.both_ways else (1.0,)
    zones = ((0.0 if fault.healthy >= 0.0 and not fault.falls else fault.limits[0], middle, GREEN),
             (middle, most, ORANGE), (most, end, RED))
    shades = [shade(left, right, colour, 0.13) for (low, high, colour), way in product(zones, ways)
              for left, right in [sorted(_place_size(fault, x, way) for x in (low, high))]]
    limits = sorted(_place_size(fault, x, way) for x in (zones[0][0], end) for way in ways)
    return [*shades, call("errorbar", fit.value, 0, xerr=interval, color=INK, capsize=3, marker="o", ms=6),
            *(dot(size, row, INK, marker="D", ms=4) for row, (_, size) in enumerate(other_sizes, 1)),
            *name_rows(["refined", *(label for label, _ in other_sizes)]),
            axes(xlim=(limits[0], limits[-1]), xlabel=fault.symbol + fault.bracketed_unit)]


def _place_size(fault: Fault, departure: float, way: float) -> float:
    return 2.0 * fault.healthy - fault.place_size(departure) if way < 0.0 else fault.place_size(departure)


_BESIDE = "#ffd33d"  # of the hollow markers, in which those of the minima stay visible


def draw_maps(grid: Grid, truth: tuple[float, float] | None = None) -> str:
    """Figs. 14 and 15: the maps with their minima A, B and C, the limits of both faults and the centre of gravity G.

    Args:
        grid: from `fdi.diagnosis.rms_grid.search_grid`.
        truth: the sizes of both faults, where they are known.
    """
    maps = (("step sections", grid.step, "A"), ("ramp sections", grid.ramp, "B"), ("both", grid.joint, "C"))
    panels = [[*_draw_map(grid, m, letter),
               axes(title=f"{name}: {format_amount(m.minimum.rms, grid.unit)} at {letter}\n"
                          f"to {format_amount(float(m.rms.max()), grid.unit)} (yellow)"),
               *([dot(*_scale_sizes(grid, truth), "white", "injected", marker="X", ms=9, mec=INK, mew=0.8)]
                 if truth else [])]
              for name, m, letter in maps if m]
    panels[-1].append(dot(*_scale_sizes(grid, grid.best.sizes), "none", "finer grid", marker="*", ms=13, mec=_BESIDE))
    if grid.step and grid.ramp:
        corners = np.array([_scale_sizes(grid, [fault.place_size(x) for fault, x in
                                                zip(grid.faults, corner, strict=True)])
                            for corner in find_corners(grid.faults)])
        for panel in panels[:2]:
            panel += [line(corners[:, 0], corners[:, 1], "white", width=0.8, ls="--"),
                      dot(*_scale_sizes(grid, grid.merged.sizes), "none", "G", marker="D", ms=9, mec=_BESIDE)]
    panels[0].append(axes(ylabel=_name_map_axis(grid.faults[1])))
    below = legend(3, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    return draw_panels("maps", [[[*panel, below] for panel in panels]], 3.5, 3.7 * len(panels), sharey=True)


def _draw_map(grid: Grid, m: Map, letter: str) -> list[Mark]:
    """One map as an image of its logarithm, with contours and its minimum."""
    sides = [axis / choose_unit(fault.unit, fault.limits[2])[0]
             for fault, axis in zip(grid.faults, grid.axes, strict=True)]
    across, up = ((side[0] - 0.5 * (side[1] - side[0]), side[-1] + 0.5 * (side[1] - side[0])) for side in sides)
    size: Any = np.log10(m.rms.T)
    return [call("imshow", size, origin="lower", extent=(*across, *up), aspect="auto", cmap="viridis",
                 interpolation="none"),
            call("contour", *sides, size, MAP_CONTOURS, colors="white", linewidths=0.4, alpha=0.6),
            call("grid", False), axes(xlabel=_name_map_axis(grid.faults[0]), xlim=across, ylim=up),
            dot(*_scale_sizes(grid, m.minimum.sizes), RED, letter, mec="white")]


def _scale_sizes(grid: Grid, sizes: Sequence[float]) -> tuple[float, float]:
    """A pair of sizes in the units of the axes of a map."""
    x, y = (size / choose_unit(fault.unit, fault.limits[2])[0] for fault, size in zip(grid.faults, sizes, strict=True))
    return x, y


def _name_map_axis(fault: Fault) -> str:
    unit = choose_unit(fault.unit, fault.limits[2])[1]
    return fault.symbol + (f" [{unit}]" if unit else "")
