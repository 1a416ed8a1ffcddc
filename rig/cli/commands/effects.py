"""`rig effects`: the catalogue of physical effects, one effect in detail, and the self-test of an effect."""

import argparse
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi.report import Cell, Column, Item, Line, Paragraph, Report, Section, Table, format_digits
from plant import Report as SelfTest, check_effect, find_effect, find_plant, lacks_starts, load_model, load_plant
from plant.effects import Effect
from rig.cli import Places, give_answer, load_user_effects, show_progress

CONVENIENT = {"m": (1e6, "um"), "Pa": (1e-5, "bar")}  # units of a table


def run_command(args: argparse.Namespace) -> int:
    """An effect of --effects, or any with --test, is also tested: exit status 1 if it fails."""
    if args.model.endswith(".py"):
        load_plant(Path(args.model))
    load_user_effects(args.effects)
    plant = load_model(args.model).plant
    effects = [find_effect(args.name, plant)] if args.name else find_plant(plant).list_effects()
    is_own = args.name and effects[0].file in {file.absolute() for file in args.effects}
    with show_progress(args, "testing"):
        tests = {e.name: test_effect(e, plant) for e in effects if args.test or is_own}
    report = build_effects_report(effects, plant, tests, is_detailed=bool(args.name))
    status = int(any(test.faults for test in tests.values()))
    return give_answer(report, args, status, Places(answer=Path(args.out) if args.out else None))


def test_effect(e: Effect, plant: str = "eha") -> SelfTest:
    """Test an effect on the nominal test of its plant, of the EHA the preflight."""
    from rig.sequences import load_nominal_test  # here: it takes half a second

    kind = find_plant(plant)
    return check_effect(e.name, load_nominal_test(kind, kind.nominal["controller.period"])[0], plant=plant)


def build_effects_report(effects: Sequence[Effect], plant: str, tests: Mapping[str, SelfTest], *,
                         is_detailed: bool) -> Report:
    """Report on the catalogue, or on one effect in detail, with the self-tests that were made."""
    rows = [describe_effect(e, plant) for e in effects]
    for name, test in tests.items():
        row = next(row for row in rows if row["effect"] == name)
        row["self_test"] = {"faults": list(test.faults), "visible": test.visible,
                            "shown": [{"start": size.start, **size.changes, "level": size.level}
                                      for size in test.shown]}
    title, sentence = "effects", ""
    if is_detailed:
        law = ((effects[0].function.__doc__ if effects[0].function else "") or "").partition("\n")[0]
        title, sentence = effects[0].name, ": ".join(filter(None, (effects[0].name, law)))
    first = _list_properties(effects[0], rows[0], plant) if is_detailed else _tabulate_effects(effects, rows)
    sections = [Section("", first),
                *(Section(f"self-test of {name}", [*_show_test(test, plant)]) for name, test in tests.items())]
    return Report("effects", title, sentence=sentence, sections=sections, data={"effects": rows})


def describe_effect(e: Effect, plant: str = "eha") -> dict[str, Any]:
    """An effect as JSON values: its law, and its parameters with unit, off value and allowed range."""
    base, is_of_another_size = find_plant(plant).nominal, lacks_starts(e, find_plant(plant))
    parameters = {name: {"unit": q.unit, "off": e.off.get(name, base.get(name)), "expected": q.expected,
                         "typical": q.typical, "fitted": name in e.fitted} for name, q in e.parameters.items()}
    return {"effect": e.name, "port": e.port, "in_reference_model": e.base, "in_firmware": e.firmware,
            "law": _name_signals(e.law, plant), "symptoms": _name_signals(e.symptoms, plant),
            "confused_with": list(e.confused_with), "excludes": list(e.excludes), "source": e.source,
            "parameters": parameters, "starts": [] if is_of_another_size else [dict(start) for start in e.starts]}


def _name_signals(text: str, plant: str) -> str:
    """A text of the catalogue, which has the symbols of the EHA, with those of the plant."""
    signals = find_plant(plant).signals
    symbols = {"Com": signals.command.symbol, "XJ": signals.controlled.symbol, "Cor": signals.drive.symbol}
    return re.sub("|".join(symbols), lambda match: symbols[match[0]], text)


def _tabulate_effects(effects: Sequence[Effect], descriptions: Sequence[Mapping[str, Any]]) -> list[Item]:
    rows: list[list[Cell | str]] = [[
        Cell(e.name, is_strong=True), e.port or "(reference)",
        "\n".join(f"{name.removeprefix(e.name + '.')} [{q.unit}]" for name, q in e.parameters.items()), row["symptoms"]]
        for e, row in zip(effects, descriptions, strict=True)]
    columns = [Column(title) for title in ("effect", "acts on", "parameters", "how to recognise it")]
    return [Table(columns, rows), Paragraph(
        "Give a model an effect with --set EFFECT.PARAMETER=VALUE; effects of the reference model have their own "
        "group. rig effects EFFECT shows its law.")]


def _list_properties(e: Effect, row: Mapping[str, Any], plant: str) -> list[Item]:
    port = f"{e.port} ({find_plant(plant).ports[e.port].unit})" if e.port else "the reference model itself"
    properties = [("law", row["law"]), ("acts on", port), ("symptoms", row["symptoms"]), ("source", e.source),
                  ("rig explain", "does not test it unasked: it names what looks the same" if e.searched_in and
                   plant not in e.searched_in else ""),
                  ("confused with", ", ".join(e.confused_with)), ("excludes", ", ".join(e.excludes))]
    parameters = [(f"{name} in {p['unit']}", filter(None, (
        p["expected"], f"off at {p['off']:g}", p["typical"] and f"typically {p['typical']}",
        "" if p["fitted"] else "not fitted"))) for name, p in row["parameters"].items()]
    return [*(Line(label, text) for label, text in properties if text),
            *(Line("parameter", f"{name}: {'; '.join(words)}") for name, words in parameters),
            *(Line("fits start at", ", ".join(f"{name} = {value:g}" for name, value in start.items()))
              for start in row["starts"])]


def _show_test(test: SelfTest, plant: str) -> Iterator[Item]:
    """The faults that a self-test found, and what each size changes."""
    if test.shown:
        units = {s: CONVENIENT.get(s.unit, (1.0, s.unit)) for s in find_plant(plant).signals.outputs}
        rows = [[", ".join(f"{name.partition('.')[2]} = {value:.3g}" for name, value in size.start.items()),
                 *(format_digits(size.changes[s.name] * factor) for s, (factor, _) in units.items()),
                 format_digits(size.level)] for size in test.shown]
        columns = [Column("size"), *(Column(s.symbol, unit, "right") for s, (_, unit) in units.items()),
                   Column("over noise", align="right")]
        yield Table(columns, rows, f"What {test.effect} changes: RMS over the nominal test, driven by the "
                                   "same drive; and the largest change over the noise of its sensor.")
    yield from (Line("FAULT", f"{test.effect}: {fault}", "bad") for fault in test.faults)
    if not test.faults:
        remark = "" if test.visible or not test.shown else "; below the noise on this command"
        yield Line("passed", f"{test.effect}: exact at its off value, finite, repeatable, compiled code equal "
                             f"to plain Python{remark}", "good")
