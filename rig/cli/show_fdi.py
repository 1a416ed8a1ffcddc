"""What `rig fdi` shows a person: the verdict, the two faults, bands, precursors, grid, and what else is off."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from fdi.diagnosis.diagnosis import Diagnosis
from fdi.diagnosis.faults import FAULTS, Level
from fdi.report.diagnosis_text import LEVELS, NAMES, SHOWN, besides, left_over, overruled, sentence, size
from rig.cli.terminal import console
from rig.studies.fault_size_methods import Row

COLOURS = {"ACCEPTABLE": "green", "MAINTENANCE": "yellow", "NON_NOMINAL": "red", "SOMETHING_ELSE": "yellow",
           "CANNOT_TELL": "yellow"}
OF_LEVEL = {Level.ACCEPTABLE: "green", Level.MAINTENANCE: "yellow", Level.NON_NOMINAL: "red", None: "yellow"}
OUTSIDE = {None: "-", Level.ACCEPTABLE: "within", Level.MAINTENANCE: "MidBand", Level.NON_NOMINAL: "MaxBand"}
EVENTS = 6  # lines; page and JSON have all


def diagnosis(d: Diagnosis, then: str, pages: Sequence[Path] = (), rows: Sequence[Row] = ()) -> None:
    """Everything, on standard output; `rows` are other methods' answers."""
    out = console()
    out.print(f"[bold {COLOURS[d.verdict]}]{d.verdict}[/]  {escape(sentence(d))}", soft_wrap=True)
    out.print()
    out.print(faults(d))
    out.print()
    if d.precursors:
        out.print(precursors(d))
        out.print()
    if rows:
        out.print(methods(rows))
        out.print()
    for label, text in lines(d):
        out.print(f"[dim]{label:<11}[/]{escape(text)}", soft_wrap=True)
    for page in pages:
        out.print(f"[dim]{'written':<11}[/]{escape(str(page))}", soft_wrap=True)
    if then:
        out.print(f"[dim]{'next':<11}[/][bold]{escape(then)}[/]", soft_wrap=True)


def bands(made: Mapping[str, Any]) -> None:
    """What `--learn-bands` wrote."""
    out = console()
    judged = " and ".join(NAMES[name] for name in made["judges"]) or "neither fault: both are within healthy scatter"
    out.print(f"[bold]{escape(made['bands'])}[/]  judges {judged}", soft_wrap=True)
    for label, text in made["provenance"].items():
        out.print(f"[dim]{label:<13}[/]{escape(text)}", soft_wrap=True)


def faults(d: Diagnosis) -> Table:
    """Both faults: level, size, interval, limits, and what bands and grid say."""
    t = Table(box=None, pad_edge=False)
    t.add_column("fault", no_wrap=True)
    t.add_column("level", no_wrap=True)
    for column in ("size", "95 %", "limits", "grid", "bands"):
        t.add_column(column, justify="right", no_wrap=True)
    for f in FAULTS:
        e, level = d.sizes[f.name], d.levels[f.name]
        at = getattr(d.grid.merged, f.symbol) if d.grid else None
        said = d.judged.levels.get(f.name) if d.judged else None
        word = "not judged" if level is None else LEVELS[level]
        t.add_row(NAMES[f.name] + (" *" if d.ruling == f.name else ""), f"[{OF_LEVEL[level]}]{word}[/]",
                  size(e.value), f"{size(e.low)}..{size(e.high)}", f"{f.middle:g}/{f.most:g}",
                  "-" if at is None else size(at), OUTSIDE[said])
    t.caption = "filter clogging: Kintas; spool friction: FSS in N" + ("; * rules" if d.ruling else "")
    t.caption_justify = "left"
    return t


def methods(rows: Sequence[Row]) -> Table:
    """What other methods find: error, simulations, time."""
    t = Table(box=None, pad_edge=False)
    t.add_column("method")
    for column in ("Kintas", "FSS N", "left", "errors", "right", "runs", "s"):
        t.add_column(column, justify="right", no_wrap=True)
    for r in rows:
        right = " ".join(f"{100 * share:.0f}%" for share in r.right.values()) if r.right else "-"
        found = [size(x) if x is not None else "-" for x in (r.kintas, r.fss)]
        found = list((r.levels or {}).values()) if r.kintas is None else found
        errors = f"{r.error_kintas:.3f} {r.error_fss:.2g}" if r.error_kintas is not None else "-"
        left = size(r.left) if r.left is not None else "-"
        t.add_row(r.method, *found, left, errors, right, str(r.simulations), f"{r.seconds:.1f}")
    t.caption = ("left: RMS of what is left, in floors; errors: RMS, and right: levels,\n"
                 "both on simulated units that no training saw")
    t.caption_justify = "left"
    return t


def precursors(d: Diagnosis) -> Table:
    """The precursors beside their healthy scatter."""
    known = any(math.isfinite(p.noise) for p in d.precursors.values())
    t = Table(box=None, pad_edge=False)
    t.add_column("precursor")
    t.add_column("value", justify="right")
    if known:
        t.add_column("off, in healthy s.d.", justify="right")
    for p in d.precursors.values():
        off = f"{p.departure:+.1f}" if math.isfinite(p.departure) else "-"
        t.add_row(p.words, p.shown, *([off] if known else []))
    return t


def lines(d: Diagnosis) -> list[tuple[str, str]]:
    """Label and text of what stands below the tables."""
    said = []
    for e in d.events[:EVENTS]:
        said.append(("event", f"{e.signal} outside {'MaxBand' if e.band == 'most' else 'MidBand'}, "
                              f"{e.t_in:.3f} .. {e.t_out:.3f} s, {e.section}"))
    if len(d.events) > EVENTS:
        said.append(("", f"and {len(d.events) - EVENTS} more events"))
    said += [("bands", text) for text in overruled(d)]
    r = d.refined
    fits = ", ".join(f"{SHOWN[s]} {ratio:.3g}" for s, ratio in r.ratio.items())
    said.append(("fit", f"leaves {fits} times the noise; {r.simulations} simulations; "
                        f"correlation of the two sizes {r.correlation:+.2f}"))
    said += [("besides", besides(name, e)) for name, e in d.others.items()]
    if d.verdict == "SOMETHING_ELSE":
        said.append(("left over", left_over(d)))
    return [*said, *(("note", note) for note in d.notes)]
