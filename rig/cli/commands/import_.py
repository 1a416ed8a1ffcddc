"""`rig import`: a recording of any logger becomes a trace.mcap; `--guess` writes the first map of its columns."""

import argparse
from pathlib import Path

import dbc
from fdi.output import require_new, require_writable, write_text
from fdi.report import Report, build_guess_report, build_import_report
from fdi.trace.importing.conversion import ImportMap, import_measurement, read_map
from fdi.trace.importing.formats import Measurement, open_measurement
from fdi.trace.importing.guess import guess_map
from plant import InputError, count_nouns, require
from rig.benches import load_bench
from rig.cli import give_answer, load_declared_model, name_after, show_progress
from rig.recorder.convert import RAW_SUFFIXES, import_csv, import_frames, import_own_table, open_can_log, write_imported


def run_command(args: argparse.Namespace) -> int:
    """The log goes to --out (default: FILE with .mcap in place of its suffix)."""
    source = Path(args.file)
    require(source.exists(), source, "", "a file that can be read; it does not exist")
    require(not (args.guess and args.map), "--guess", args.map, "--guess or --map, not both")
    require(not args.bench or (source.suffix in RAW_SUFFIXES and not args.map and not args.guess),
            "--bench", args.bench, "a CAN log without --map or --guess")
    require(not args.dbc or source.suffix in RAW_SUFFIXES, "--dbc", args.dbc,
            "a CAN log to decode; a CSV of signals has no frames")
    require(not args.dbc or args.map or args.guess, "--dbc", args.dbc,
            "--map or --guess with it; without them the frames are those of --bench")
    suffix = ".map.toml" if args.guess else ".mcap"
    out = source.with_name(name_after(source, suffix)) if args.out is None else Path(args.out)
    require(args.guess or out.suffix == ".mcap", out, "--out", "a name that ends in .mcap")
    require_new(require_writable(out, "--out", source=source), is_forced=args.force)
    if args.guess:
        return write_guess(args, source, out)
    return import_by_map(args, source, out) if args.map else import_own(args, source, out)


def import_own(args: argparse.Namespace, source: Path, out: Path) -> int:
    """Import our own columns or frames, or those of a rig that a plant knows.

    Raises:
        InputError: another format, or other columns.
    """
    with show_progress(args, "reading"):
        if source.suffix in RAW_SUFFIXES:
            cycles = import_frames(source, out, load_bench(args.bench or "eha", is_trusted=args.trust))
        elif source.name.endswith((".csv", ".csv.gz")):
            try:
                cycles = import_csv(source, out, load_declared_model(args).kind.signals)
            except InputError as error:
                if "the header is" not in error.expected:
                    raise
                raise InputError(error.where, error.field, f"{error.expected}; for other columns: "
                                                           f"rig import --guess {source}") from error
        elif (own := import_own_table(source, out)) is not None:
            cycles = own
        else:
            raise InputError(source, "", f"--map for other formats than .csv, .csv.gz, {', '.join(RAW_SUFFIXES)}; "
                                         "--guess writes one")
    return give_answer(Report("import", str(source), sentence=f"{out}: {count_nouns(cycles, 'cycle')}",
                              data={"trace": str(out), "cycles": cycles}), args)


def import_by_map(args: argparse.Namespace, source: Path, out: Path) -> int:
    """Import the columns or frames that --map names."""
    model = load_declared_model(args)
    import_map = read_map(Path(args.map), model.kind.signals)
    measurement = open_source(args, source, import_map)
    imported = import_measurement(measurement, import_map, model["controller.period"])
    write_imported(imported.trace, import_map, out)
    return give_answer(build_import_report(imported, measurement, out), args)


def write_guess(args: argparse.Namespace, source: Path, out: Path) -> int:
    """Write the map that the names and values of the columns suggest."""
    measurement = open_source(args, source, None)
    guessed = guess_map(measurement, load_declared_model(args).kind.signals)
    write_text(out, guessed.text)
    return give_answer(build_guess_report(guessed, measurement, out, args.model), args)


def open_source(args: argparse.Namespace, source: Path, import_map: ImportMap | None) -> Measurement:
    """Open a recording; the map says how a text file is written."""
    with show_progress(args, "reading"):
        if source.suffix in RAW_SUFFIXES:
            return open_can_log(source, Path(args.dbc or dbc.DBC))
        if import_map is None:
            return open_measurement(source)
        return open_measurement(source, import_map.file.separator, import_map.file.decimal, import_map.file.header)
