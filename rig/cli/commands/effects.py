"""`rig effects`: the catalogue of physical effects, one effect in detail, and the self-test of an effect."""
from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rig.cli import options

if TYPE_CHECKING:
    from pathlib import Path

    from fdi.report.report import Item, Report
    from plant.effects import Effect
    from plant.selftest import Report as SelfTest


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig effects`."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="show this effect in detail (default: list all)")
    parser.add_argument("--model", metavar="FILE|NAME", default="eha",
                        help="list the effects of this plant (default eha)")
    parser.add_argument("--effects", action="append", default=[], type=_path, metavar="FILE.py",
                        help="your own effects (repeatable); one that is shown is tested as well")
    parser.add_argument("--test", action="store_true",
                        help="test the effect, or all of them, on the preflight command; exit status 1 for a fault")


def _path(text: str) -> Path:
    from pathlib import Path

    return Path(text)


def run_command(args: argparse.Namespace) -> int:
    """An effect of --effects, or any with --test, is also tested: exit status 1 if it fails."""
    from fdi.report.json import to_plain
    from plant.model import find_effect, list_offered_effects, load_model
    from rig.cli.answer import show_answer

    options.load_user_effects(args.effects)
    plant = load_model(args.model).plant
    chosen = [find_effect(args.name, plant)] if args.name else list_offered_effects(plant)
    own = {file.absolute() for file in args.effects}
    tested = chosen if args.test or (args.name and chosen[0].file in own) else []
    tests = {e.name: test_effect(e) for e in tested}
    report = build_effects_report(chosen, plant, tests, is_detailed=bool(args.name))
    if args.out:
        from fdi.output import write_text

        write_text(args.out, json.dumps(to_plain(report.data), indent=1) + "\n")
    show_answer(report, args)
    return int(any(test.faults for test in tests.values()))


def test_effect(e: Effect) -> SelfTest:
    """Test an effect on the preflight command."""
    from plant.selftest import check_effect
    from rig.sequences import load_sequence

    return check_effect(e.name, load_sequence("preflight").main_profile().command)


def build_effects_report(chosen: Sequence[Effect], plant: str, tests: Mapping[str, SelfTest], *,
                         is_detailed: bool) -> Report:
    """Report on the catalogue, or on one effect in detail, with the self-tests that were made."""
    from fdi.report.report import Report, Section

    rows = [describe_effect(e, plant) for e in chosen]
    for row in rows:
        if row["effect"] in tests:
            test = tests[row["effect"]]
            row["self_test"] = {"faults": list(test.faults), "visible": test.visible,
                                "shown": [shown._asdict() for shown in test.shown]}
    if is_detailed:
        title, sentence = chosen[0].name, ": ".join(filter(None, (chosen[0].name, _describe_law(chosen[0]))))
        items = _list_properties(chosen[0], rows[0])
    else:
        title, sentence, items = "effects", "", _tabulate_effects(chosen)
    return Report(
        command="effects", title=title, sentence=sentence,
        sections=[Section("", items),
                  *(Section(f"self-test of {name}", _show_test(test)) for name, test in tests.items())],
        data={"effects": rows})


def _describe_law(e: Effect) -> str:
    """The first line of the docstring of the effect's law."""
    doc = (e.function.__doc__ or "") if e.function else ""
    return doc.splitlines()[0] if doc else ""


def describe_effect(e: Effect, plant: str = "eha") -> dict[str, Any]:
    """An effect as JSON values: its law, and its parameters with unit, off value and allowed range."""
    from plant.plants import find_plant

    base = find_plant(plant).nominal
    parameters = {name: {"unit": q.unit, "off": e.off.get(name, base.get(name)), "expected": q.expected,
                         "typical": q.typical, "fitted": name in e.fitted} for name, q in e.parameters.items()}
    return {"effect": e.name, "port": e.port, "in_reference_model": e.base, "in_firmware": e.firmware, "law": e.law,
            "symptoms": e.symptoms, "confused_with": list(e.confused_with), "excludes": list(e.excludes),
            "source": e.source, "parameters": parameters, "starts": [dict(start) for start in e.starts]}


def _tabulate_effects(chosen: Sequence[Effect]) -> list[Item]:
    from fdi.report.report import Cell, Column, Paragraph, Table

    rows: list[list[Cell | str]] = []
    for e in chosen:
        names = "\n".join(f"{name.removeprefix(e.name + '.')} [{q.unit}]" for name, q in e.parameters.items())
        rows.append([Cell(e.name, is_strong=True), e.port or "(reference)", names, e.symptoms])
    columns = [Column(title) for title in ("effect", "acts on", "parameters", "how to recognise it")]
    return [Table(columns, rows), Paragraph(
        "Give a model an effect with --set EFFECT.PARAMETER=VALUE; effects of the reference model have their own "
        "group. rig effects EFFECT shows its law.")]


def _list_properties(e: Effect, row: Mapping[str, Any]) -> list[Item]:
    from fdi.report.report import Line
    from plant.state import UNITS

    port = f"{e.port} ({getattr(UNITS, e.port)})" if e.port else "the reference model itself"
    properties = [("law", e.law), ("acts on", port), ("symptoms", e.symptoms), ("source", e.source),
                  ("confused with", ", ".join(e.confused_with)), ("excludes", ", ".join(e.excludes))]
    for name, p in row["parameters"].items():
        words = [p["expected"], f"off at {p['off']:g}", p["typical"] and f"typically {p['typical']}",
                 "" if p["fitted"] else "not fitted"]
        properties.append(("parameter", f"{name} in {p['unit']}: {'; '.join(filter(None, words))}"))
    properties += [("fits start at", ", ".join(f"{name} = {value:g}" for name, value in start.items()))
                   for start in e.starts]
    return [Line(label, text) for label, text in properties if text]


def _show_test(test: SelfTest) -> list[Item]:
    """The faults that a self-test found, and what each size changes."""
    from fdi.report.numbers import format_digits
    from fdi.report.report import Column, Line, Table

    items: list[Item] = []
    if test.shown:
        rows = []
        for shown in test.shown:
            size = ", ".join(f"{name.partition('.')[2]} = {value:.3g}" for name, value in shown.start.items())
            changes = (shown.xj * 1e6, shown.p12 * 1e-5, shown.xs * 1e6, shown.level)
            rows.append([size, *(format_digits(change) for change in changes)])
        columns = [Column("size"), Column("XJ", "um", "right"), Column("P12", "bar", "right"),
                   Column("XS", "um", "right"), Column("over noise", align="right")]
        items.append(Table(columns, rows, f"What {test.effect} changes: RMS over the preflight, driven by the same "
                                          "current; and the largest change over the noise of its sensor."))
    items += [Line("FAULT", f"{test.effect}: {fault}", "bad") for fault in test.faults]
    if not test.faults:
        hidden = "" if test.visible or not test.shown else "; below the noise on this command"
        items.append(Line("passed", f"{test.effect}: exact at its off value, finite, repeatable, compiled code equal "
                                    f"to plain Python{hidden}", "good"))
    return items
