"""Options as data: what every command has in common, options that several commands share, and types of values."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple


class Option(NamedTuple):
    """An option or argument: its names, and its settings as argparse takes them."""

    names: tuple[str, ...]
    settings: Mapping[str, Any]


class Group(NamedTuple):
    """Options with a heading of their own in the help."""

    title: str
    options: Sequence[Option]
    description: str | None = None


def option(*names: str, **settings: Any) -> Option:
    """Declare an option or argument."""
    return Option(names, settings)


def add_options(parser: argparse._ActionsContainer, options: Sequence[Option | Group]) -> None:
    """Add options to a parser."""
    for each in options:
        if isinstance(each, Group):
            add_options(parser.add_argument_group(each.title, each.description), each.options)
        else:
            parser.add_argument(*each.names, **each.settings)


def parse_whole_number(text: str) -> int:
    """Parse a whole number from 0, as an argparse type."""
    return _parse_integer(text, 0)


def parse_count(text: str) -> int:
    """Parse a whole number from 1, as an argparse type."""
    return _parse_integer(text, 1)


def _parse_integer(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"expected a whole number from {least}, not {text!r}")
    return value


OF_EVERY_COMMAND = (
    option("--json", action="store_true", help="print one JSON object on standard output, nothing else"),
    option("--out", metavar="PATH", help="where to write the result"),
    option("--quiet", action="store_true", help="print nothing but errors"))
ANY_TRACE = "trace.mcap, the folder of a run, or a CSV"
MEASURED_TRACE = f"{ANY_TRACE} with t and the signals of the plant (rig list signals)"
TRUST = option("--trust", action="store_true",
               help="run the code that a log, model or bench file brings along; it is listed first, with its hash")
PLANT = (
    option("--model", metavar="FILE|NAME",
           help="model file, or a shipped model: eha (default), ehs (pump-driven servo), servo (the same, a real one)"),
    option("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE",
           help="change a parameter of the model or of an effect, SI units (repeatable)"),
    option("--effects", action="append", default=[], type=Path, metavar="FILE.py",
           help="your own effects (repeatable)"),
    TRUST)
CSV_OF = (option("--model", metavar="FILE|NAME", help="whose signals a CSV has: model file, plant file or model name"),
          TRUST)
SEED = option("--seed", type=parse_whole_number, default=0, metavar="N", help="seed of the noise (default 0)")
SEED_IF_GIVEN = option("--seed", **{**SEED.settings, "default": None})  # so that one that is given is noticed
MODEL = (*PLANT, SEED)
REPEAT = option("--repeat", action="append", default=[], metavar="TRACE",
                help="another run of the same command: measures the noise floor (repeatable)")
SIGNALS = option("--signals", metavar="NAME,..", help="outputs of the plant to use, such as xj,p12,xs (default: all "
                                                    "that the trace has)")
RUNS = (REPEAT, option("--holdout", metavar="TRACE", help="a run of another command that no fit sees: reveals "
                                                          "overfitting"), SIGNALS)
FAULTS = option("--faults", metavar="FILE|NAME",
                help="faults to measure: a fault file, or a shipped list by name (default: those of the plant file, or "
                     "paper)")
BENCH = option("--bench", metavar="FILE|NAME",
               help="bench file: which controller is under test, and its frames (default: eha, the shipped one; of "
                    "another plant its own controller)")
FORCE = option("--force", action="store_true", help="replace the file of --out if there is one")
REQUIREMENTS = option("--requirements", metavar="FILE",
                      help="requirements to cover, .csv (id, text) or .reqif; an id that it lacks is refused")
JUNIT = option("--junit", metavar="FILE.xml", help="also write the results as JUnit XML, for build servers")


def offer_page(name: str, place: str = "the trace") -> Option:
    """Declare --report, which writes a page of this name."""
    return option("--report", action="store_true", help=f"write a page with pictures, {name} beside {place}, or where "
                                                        "--out FILE.html says")
