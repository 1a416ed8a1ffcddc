"""`rig import`: a recording of any logger becomes a trace.mcap; `--guess` writes the first map of its columns."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from plant.errors import InputError

if TYPE_CHECKING:
    from fdi.trace.importing.formats import Measurement
    from fdi.trace.importing.import_map import ImportMap


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig import`."""
    add = parser.add_argument
    add("file", metavar="FILE", help="a recording: .csv or other text, .mf4, .mat, .parquet, .mcap, or a CAN log: "
                                     ".log (candump), .blf, .asc, .trc")
    add("--map", metavar="MAP.toml", help="which column is which signal, in which unit (default: a CSV has our own "
                                          "columns, a CAN log our own frames)")
    add("--guess", action="store_true", help="write a first map (FILE.map.toml, or --out), with its reasons")
    add("--force", action="store_true", help="let --guess replace a map that exists")
    add("--dbc", metavar="FILE", help="DBC that decodes the raw frames (default: the shipped eha.dbc)")


def run_command(args: argparse.Namespace) -> int:
    """The log goes to --out (default: FILE with .mcap in place of its suffix)."""
    from rig.recorder.convert import RAW_SUFFIXES

    source = Path(args.file)
    if not source.exists():
        raise InputError(source, "", "a file that can be read; it does not exist")
    _check_options(args, source, source.suffix in RAW_SUFFIXES)
    if args.guess:
        return _guess(args, source)
    out = Path(args.out) if args.out is not None else source.with_name(source.name.split(".")[0] + ".mcap")
    if out.resolve() == source.resolve():
        raise InputError("--out", str(out), "another file than the one that is read")
    return _import_by_map(args, source, out) if args.map else _import_own(args, source, out)


def _check_options(args: argparse.Namespace, source: Path, is_can: bool) -> None:
    if args.guess and args.map:
        raise InputError("--guess", args.map, "--guess or --map, not both")
    if args.force and not args.guess:
        raise InputError("--force", "", "--guess, whose map it lets replace another")
    if args.dbc and not is_can:
        raise InputError("--dbc", args.dbc, "a CAN log to decode; a CSV of signals has no frames")


def _import_own(args: argparse.Namespace, source: Path, out: Path) -> int:
    """Import our own columns or frames."""
    import dbc
    from fdi.report.report import Report
    from rig.cli.answer import show_answer
    from rig.recorder.convert import RAW_SUFFIXES, import_csv, import_frames

    csv = source.name.endswith((".csv", ".csv.gz"))
    if not csv and source.suffix not in RAW_SUFFIXES:
        raise InputError(source, "", f"--map for other formats than .csv, .csv.gz, {', '.join(RAW_SUFFIXES)}; "
                                     "--guess writes one")
    if csv:
        try:
            cycles = import_csv(source, out)
        except InputError as error:
            if "in the header" not in error.expected:
                raise
            raise InputError(error.where, error.field, f"{error.expected}; for other columns: "
                                                       f"rig import --guess {source}") from error
    else:
        cycles = import_frames(source, out, Path(args.dbc) if args.dbc else dbc.DBC)
    data = {"trace": str(out), "cycles": cycles}
    show_answer(Report("import", str(source), sentence=f"{out}: {cycles} cycles", data=data), args)
    return 0


def _import_by_map(args: argparse.Namespace, source: Path, out: Path) -> int:
    from fdi.output import require_writable
    from fdi.report.import_report import build_import_report
    from fdi.trace.importing.conversion import import_measurement
    from fdi.trace.importing.import_map import read_map
    from plant.parameters import load_nominal_values
    from rig.cli.answer import show_answer
    from rig.recorder.convert import write_imported

    if out.suffix != ".mcap":
        raise InputError(out, "--out", "a name that ends in .mcap")
    require_writable(out, "--out", source=source)
    chosen = read_map(Path(args.map))
    measurement = _open_source(args, source, chosen)
    imported = import_measurement(measurement, chosen, load_nominal_values()["controller.period"])
    write_imported(imported.trace, chosen, out)
    show_answer(build_import_report(imported, measurement, out), args)
    return 0


def _guess(args: argparse.Namespace, source: Path) -> int:
    from fdi.output import write_text
    from fdi.report.import_report import build_guess_report
    from fdi.trace.importing.guess import guess_map
    from rig.cli.answer import show_answer

    out = Path(args.out) if args.out is not None else source.with_name(source.name.split(".")[0] + ".map.toml")
    if out.exists() and not args.force:
        raise InputError("--out", str(out), "a file that does not exist yet; --force replaces it")
    measurement = _open_source(args, source, None)
    guessed = guess_map(measurement)
    write_text(out, guessed.text)
    show_answer(build_guess_report(guessed, measurement, out), args)
    return 0


def _open_source(args: argparse.Namespace, source: Path, chosen: ImportMap | None) -> Measurement:
    import dbc
    from fdi.trace.importing.formats import open_measurement
    from rig.recorder.convert import RAW_SUFFIXES

    if source.suffix in RAW_SUFFIXES:
        from rig.recorder.convert import open_can_log

        return open_can_log(source, Path(args.dbc) if args.dbc else dbc.DBC)
    if chosen is None:
        return open_measurement(source)
    return open_measurement(source, chosen.separator, chosen.decimal, chosen.header)
