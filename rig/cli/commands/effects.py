"""`rig effects`: the catalogue, and what one effect is; one of the user's own is tried as well."""
from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from rig.cli import options

if TYPE_CHECKING:
    from pathlib import Path

    from plant.effects import Effect
    from plant.selftest import Report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="one effect; without it the whole catalogue")
    parser.add_argument("--model", metavar="FILE|NAME", default="eha", help="of which plant (default eha)")
    parser.add_argument("--effects", action="append", default=[], type=_path, metavar="FILE.py",
                        help="your own effects (repeatable); told about one of them, it is tried as well")
    parser.add_argument("--test", action="store_true",
                        help="try the effect, or all of them, on the preflight command; exit status 1 for a fault")


def _path(text: str) -> Path:
    from pathlib import Path

    return Path(text)


def run_command(args: argparse.Namespace) -> int:
    """List the catalogue of effects, or tell about one of them."""
    from plant.model import entry, load_model, offered

    options.load_user_effects(args.effects)
    plant = load_model(args.model).plant
    chosen = [entry(args.name, plant)] if args.name else offered(plant)
    own = {file.absolute() for file in args.effects}
    tried = chosen if args.test or (args.name and chosen[0].file in own) else []
    reports = {e.name: _tried(e) for e in tried}
    rows = [describe(e, plant) | ({"self_test": _rows(reports[e.name])} if e.name in reports else {}) for e in chosen]
    text = json.dumps({"effects": rows}, indent=None if args.json else 1)
    if args.out:
        from fdi.output import write_text

        write_text(args.out, text + "\n")
    if args.json:
        print(text)
    elif not args.quiet:
        tell(chosen[0], plant) if args.name else table(chosen)
        for report in reports.values():
            tell_report(report)
    return int(any(report.faults for report in reports.values()))


def _tried(e: Effect) -> Report:
    from plant.selftest import examine
    from rig.sequences import load_sequence

    return examine(e.name, load_sequence("preflight").main_profile().command)


def describe(e: Effect, plant: str = "eha") -> dict[str, Any]:
    """An effect for machines: parameters with unit, off value and allowed range in words."""
    from plant.plants import find

    base = find(plant).nominal
    parameters = {name: {"unit": q.unit, "off": e.off.get(name, base.get(name)), "expected": q.expected,
                         "typical": q.typical, "fitted": name in e.fitted} for name, q in e.parameters.items()}
    return {"effect": e.name, "port": e.port, "in_reference_model": e.base, "in_firmware": e.firmware, "law": e.law,
            "symptoms": e.symptoms, "confused_with": list(e.confused_with), "excludes": list(e.excludes),
            "source": e.source, "parameters": parameters, "starts": [dict(start) for start in e.starts]}


def _rows(report: Report) -> dict[str, Any]:
    return {"faults": list(report.faults), "visible": report.visible, "shown": [s._asdict() for s in report.shown]}


def table(chosen: list[Effect]) -> None:
    """The catalogue as a table."""
    from rich.table import Table

    from rig.cli.terminal import console

    t = Table(box=None, pad_edge=False, title_justify="left")
    for column in ("effect", "acts on", "parameters", "what tells it apart"):
        t.add_column(column, overflow="fold", no_wrap=column in ("effect", "parameters"))  # what one has to type
    for e in chosen:
        names = "\n".join(f"{name.removeprefix(e.name + '.')} [dim]{q.unit}[/]" for name, q in e.parameters.items())
        t.add_row(f"[bold]{e.name}[/]", e.port or "[dim](reference)[/]", names, e.symptoms)
    out = console()
    out.print(t)
    out.print("\nGive a model an effect with [bold]--set EFFECT.PARAMETER=VALUE[/] (those of the reference model have "
              "their own group); [bold]rig effects EFFECT[/] tells its law.", highlight=False)


def tell(e: Effect, plant: str = "eha") -> None:
    """One effect at length."""
    from rich.markup import escape
    from rich.table import Table

    from plant.state import UNITS
    from rig.cli.terminal import console

    doc = (e.function.__doc__ or "") if e.function else ""
    port = f"{e.port} ({getattr(UNITS, e.port)})" if e.port else "the reference model itself"
    rows = [("law", e.law), ("acts on", port), ("symptoms", e.symptoms), ("source", e.source),
            ("confused with", ", ".join(e.confused_with)), ("excludes", ", ".join(e.excludes))]
    for name, p in describe(e, plant)["parameters"].items():
        words = [p["expected"], f"off at {p['off']:g}", p["typical"] and f"typically {p['typical']}",
                 "" if p["fitted"] else "not fitted"]
        rows.append(("parameter", f"{name} in {p['unit']}: {'; '.join(filter(None, words))}"))
    rows += [("a fit starts", ", ".join(f"{name} = {value:g}" for name, value in start.items())) for start in e.starts]
    t = Table.grid(padding=(0, 2))
    for word, said in rows:
        if said:
            t.add_row(word, escape(said))
    out = console()
    out.print(f"[bold]{e.name}[/]  {escape(doc.splitlines()[0]) if doc else ''}")
    out.print(t)


def tell_report(report: Report) -> None:
    """How the trial of an effect went: its faults, and what its sizes change over the preflight command."""
    from rich.table import Table

    from rig.cli.terminal import console

    out = console()
    t = Table(box=None, pad_edge=False, title_justify="left")
    for column in ("size", "XJ, um", "P12, bar", "XS, um", "over noise"):
        t.add_column(column, justify="left" if column == "size" else "right")
    for s in report.shown:
        size = ", ".join(f"{name.partition('.')[2]} = {value:.3g}" for name, value in s.start.items())
        t.add_row(size, f"{s.xj * 1e6:.3g}", f"{s.p12 * 1e-5:.3g}", f"{s.xs * 1e6:.3g}", f"{s.level:.3g}")
    if report.shown:
        out.print(f"\n[bold]{report.effect}[/] changes, RMS over the preflight driven by the same current")
        out.print(t)
    for fault in report.faults:
        out.print(f"[bold red]FAULT[/] {report.effect}: {fault}")
    if not report.faults:
        hidden = "" if report.visible or not report.shown else "; below the noise on this command"
        out.print(f"[bold green]sound[/] {report.effect}: exact at its off value, finite, repeatable, compiled as in "
                  f"plain Python{hidden}")
