"""One HTML page about a diagnosis that needs no network: levels, sizes, response in its bands, maps, precursors."""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from fdi.diagnosis.diagnosis import Diagnosis
from fdi.diagnosis.faults import FAULTS, Event, Fault, Level
from fdi.diagnosis.features import MEANINGS, kind_of
from fdi.diagnosis.precursors import shown
from fdi.output import rendered
from fdi.report import diagnosis_figures
from fdi.report.diagnosis_text import LEVELS, NAMES, besides, overruled, sentence, size
from fdi.report.paper_figures import maps
from fdi.sources import software

MOODS = {"ACCEPTABLE": "good", "MAINTENANCE": "doubtful", "NON_NOMINAL": "bad"}
OF_LEVEL = {Level.ACCEPTABLE: "within", Level.MAINTENANCE: "near", Level.NON_NOMINAL: "over", None: "muted"}
FAR = 4.0  # healthy standard deviations
APART = 0.5  # s; what comes later is of another section, though it may have the same name


def render(d: Diagnosis) -> str:
    """The page as text."""
    drawn = d.judged is not None and d.bands is not None
    return rendered(
        "fdi.html",
        title=d.source, verdict=d.verdict, mood=MOODS.get(d.verdict, "doubtful"), why=sentence(d), facts=_facts(d),
        notes=[*(f"The bands {text}." for text in overruled(d)), *d.notes], faults=[_fault(d, f) for f in FAULTS],
        correlation=f"{d.refined.correlation:+.2f}",
        others=[besides(name, e) for name, e in d.others.items()],
        estimates=diagnosis_figures.estimates(d.sizes, d.grid, d.judged),
        overview=diagnosis_figures.overview(d.cycles, d.judged) if d.judged is not None else "",
        steps=diagnosis_figures.steps(d.cycles, d.bands, d.judged) if drawn and d.bands and d.judged else "",
        ramps=diagnosis_figures.ramps(d.cycles, d.bands, d.judged) if drawn and d.bands and d.judged else "",
        events=_stays(d.events),
        maps=maps(d.grid) if d.grid else "", grid=_grid(d), precursors=_precursors(d),
        telling=diagnosis_figures.telling(d.precursors),
        provenance=sorted(d.bands.provenance.items()) if d.bands else [])


def _facts(d: Diagnosis) -> list[tuple[str, str]]:
    c, r = d.cycles, d.refined
    left = ", ".join(f"{name.upper()} {ratio:.2f}" for name, ratio in r.ratio.items())
    return [("trace", f"{len(c) * c.period:.3f} s, {len(c)} cycles of {1e3 * c.period:g} ms"),
            ("signals", ", ".join(name.upper() for name in c.signals)), ("left over noise", left),
            ("method", f"{r.method}, {r.simulations} simulations"), ("model", " ".join([d.model.name, *_changes(d)])),
            ("software", software())]


def _changes(d: Diagnosis) -> list[str]:
    return [f"{name}={value:g}" for name, value in sorted(d.model.differences().items())]


def _fault(d: Diagnosis, f: Fault) -> dict[str, Any]:
    e, level = d.sizes[f.name], d.levels[f.name]
    unit = "" if f.unit == "1" else f" {f.unit}"
    banded = d.judged.levels.get(f.name) if d.judged else None
    return {"name": NAMES[f.name], "rules": d.ruling == f.name, "level": LEVELS[level], "mood": OF_LEVEL[level],
            "value": size(e.value) + unit, "interval": f"{size(e.low)} – {size(e.high)}{unit}",
            "middle": f"{f.middle:g}{unit}", "most": f"{f.most:g}{unit}",
            "grid": size(float(getattr(d.grid.merged, f.symbol))) + unit if d.grid else "–",
            "bands": LEVELS[banded] if banded is not None else "not judged", "banded": OF_LEVEL[banded]}


def _stays(events: Sequence[Event]) -> list[dict[str, str]]:
    """A row a band, signal and section: how many stays outside, from when to when, how long in all, how far."""
    rows: list[list[Event]] = []
    for e in events:
        own = next((row for row in reversed(rows) if row[-1][:3] == e[:3]), None)
        if own is None or e.t_in - own[-1].t_out > APART:
            rows.append([e])
        else:
            own.append(e)
    return [_row(own) for own in rows]


def _row(own: Sequence[Event]) -> dict[str, str]:
    e = own[0]
    scale, unit = (1e6, "µm") if e.signal == "position" else (1e3, "mm/s")
    band, mood = {"middle": ("MidBand", "near"), "most": ("MaxBand", "over")}[e.band]
    furthest = max(abs(other.excess) for other in own)
    return {"band": band, "mood": mood, "signal": e.signal, "section": e.section, "count": str(len(own)),
            "entry": f"{e.t_in:.3f} s", "exit": f"{own[-1].t_out:.3f} s",
            "time": f"{1e3 * sum(other.t_out - other.t_in for other in own):.0f} ms",
            "excess": f"{furthest * scale:.3g} {unit}"}


def _grid(d: Diagnosis) -> list[tuple[str, str, str, str]]:
    """Rows: which, Kintas, FSS, RMS."""
    if d.grid is None:
        return []
    found = (("steps, A", d.grid.step), ("ramps, B", d.grid.ramp), ("both, C", d.grid.joint))
    rows = [(name, f"{m.minimum.kintas:.3f}", f"{m.minimum.fss:.3g} N", f"{m.minimum.rms * 1e6:.2f} µm")
            for name, m in found if m]
    g = d.grid.merged
    return [*rows, (f"centre of gravity, G ({100 * g.weight:.0f} % of A)", f"{g.kintas:.3f}", f"{g.fss:.3g} N", "")]


def _precursors(d: Diagnosis) -> list[dict[str, Any]]:
    rows = []
    for name, p in d.precursors.items():
        known = math.isfinite(p.healthy)
        rows.append({
            "words": p.words, "value": p.shown, "healthy": shown(p.healthy, name), "noise": shown(p.noise, name),
            "departure": f"{p.departure:+.1f}" if known and math.isfinite(p.departure) else "–",
            "far": known and abs(p.departure) > FAR, "clogging": shown(p.clogging, name),
            "friction": shown(p.friction, name), "clogging_ratio": _ratio(p.clogging_ratio),
            "friction_ratio": _ratio(p.friction_ratio), "unit": MEANINGS[kind_of(name)].unit})
    return rows


def _ratio(x: float) -> str:
    return f"{x:+.1f}" if math.isfinite(x) else "–"
