"""`rig effects`: the catalogue, and what one effect is."""
from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from rig import options

if TYPE_CHECKING:
    from pathlib import Path

    from plant.effects import Effect

HELP = "list the catalogue of physical effects, or tell about one"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="one effect; without it the whole catalogue")
    parser.add_argument("--effects", action="append", default=[], type=_path, metavar="FILE.py",
                        help="your own effects (repeatable)")


def _path(text: str) -> Path:
    from pathlib import Path

    return Path(text)


def run(args: argparse.Namespace) -> int:
    """List the catalogue of effects, or tell about one of them."""
    from plant.effects import CATALOGUE
    from plant.model import entry

    options.load_user_effects(args.effects)
    chosen = [entry(args.name)] if args.name else list(CATALOGUE.values())
    rows = [describe(e) for e in chosen]
    text = json.dumps({"effects": rows}, indent=None if args.json else 1)
    if args.out:
        from fdi.output import write_text

        write_text(args.out, text + "\n")
    if args.json:
        print(text)
    elif not args.quiet:
        tell(chosen[0]) if args.name else table(chosen)
    return 0


def describe(e: Effect) -> dict[str, Any]:
    """An effect for machines: parameters with unit, off value and allowed range in words."""
    from plant.parameters import nominal

    base = nominal()
    parameters = {name: {"unit": q.unit, "off": e.off.get(name, base.get(name)), "expected": q.expected,
                         "typical": q.typical} for name, q in e.parameters.items()}
    return {"effect": e.name, "port": e.port, "in_reference_model": e.base, "law": e.law, "symptoms": e.symptoms,
            "parameters": parameters}


def table(chosen: list[Effect]) -> None:
    """The catalogue as a table."""
    from rich.table import Table

    from rig.console import console

    t = Table(box=None, pad_edge=False, title_justify="left")
    for column in ("effect", "acts on", "parameters", "what tells it apart"):
        t.add_column(column, overflow="fold", no_wrap=column == "parameters")  # names that one has to type
    for e in chosen:
        names = "\n".join(f"{name} [dim]{q.unit}[/]" for name, q in e.parameters.items())
        t.add_row(f"[bold]{e.name}[/]", e.port or "[dim]reference model[/]", names, e.symptoms)
    out = console()
    out.print(t)
    out.print("\nGive a model an effect with [bold]--set NAME.PARAMETER=VALUE[/]; "
                  "[bold]rig effects NAME[/] tells its law.", highlight=False)


def tell(e: Effect) -> None:
    """One effect at length."""

    from rig.console import console

    out = console()
    doc = (e.function.__doc__ or "") if e.function else ""
    out.print(f"[bold]{e.name}[/]  {doc.splitlines()[0] if doc else ''}")
    port = e.port or "the reference model itself"
    out.print(f"  law        {e.law}\n  acts on    {port}\n  symptoms   {e.symptoms}")
    for name, p in describe(e)["parameters"].items():
        typical = f", typically {p['typical']}" if p["typical"] else ""
        out.print(f"  parameter  [bold]{name}[/] in {p['unit']}: {p['expected']}; off at {p['off']:g}{typical}")
