"""`rig evidence`: packs runs into a sealed folder or zip, and verifies one."""

import argparse
from datetime import UTC, datetime
from pathlib import Path

from fdi.output import require_new
from fdi.report import MOODS, Cell, Column, Line, Report, Section, tabulate
from plant import count_nouns, escape_control_characters, require
from rig.cli import give_answer, show_progress
from rig.evidence.contents import BILL, add_index, collect_runs
from rig.evidence.package import verify_package, write_package
from rig.evidence.requirements import read_requirements, require_listed, tabulate_requirements, trace_requirements
from rig.recorder import read_epoch_ns


def run_command(args: argparse.Namespace) -> int:
    """The package goes to --out (default: evidence.zip). Exit status of --verify: 1 if a byte differs."""
    require(args.verify is None or not (args.runs or args.out or args.sign or args.requirements), "--verify",
            args.verify, "no RUN, --out, --sign or --requirements: it only reads")
    if args.verify is not None:
        return verify(args)
    require(args.runs and not args.key, "RUN", "", "at least one folder of a run; --key goes with --verify")
    return pack(args)


def verify(args: argparse.Namespace) -> int:
    """Print a line for each file that was changed, is missing or was added."""
    with show_progress(args, "verifying"):
        verification = verify_package(Path(args.verify), args.key or "")
    lines = [Line(word, escape_control_characters(name), "bad") for word in ("changed", "missing", "added")
             for name in getattr(verification, word)]
    verdict = "INTACT" if verification.is_intact else "CHANGED"
    sentence = (f"{count_nouns(verification.files, 'file')} as sealed; signature: {verification.signature}."
                if verification.is_intact else
                f"{count_nouns(len(lines), 'difference')} from the manifest; signature: {verification.signature}.")
    report = Report("evidence", args.verify, verdict, "good" if verification.is_intact else "bad", sentence,
                    files=[("seal", verification.seal)], sections=[Section("Differences", lines)],
                    data={"verdict": verdict, **verification._asdict()})
    return give_answer(report, args, 0 if verification.is_intact else 1)


def pack(args: argparse.Namespace) -> int:
    """Write the package, and print its runs, requirements and seal."""
    out = Path(args.out or "evidence.zip")
    if out.suffix == ".zip":
        require_new(out, is_forced=args.force)
    else:
        require(not out.exists() or (out.is_dir() and not any(out.iterdir())), "--out", str(out),
                "a FILE.zip, or a folder that is new or empty")
    require(not any(out.resolve().is_relative_to(Path(run).resolve()) for run in args.runs), "--out", str(out),
            "a place outside the runs that it packs")
    with show_progress(args, "reading") as progress:
        package = collect_runs(args.runs)
        runs = [*(run.judged for run in package.runs), *package.lost]
        if args.requirements:
            file = Path(args.requirements)
            package.listed.update(read_requirements(file))
            require_listed(runs, package.listed, file)
            package.files[f"requirements/{file.name}"] = file
        requirements = trace_requirements(runs, package.listed)
        created = datetime.fromtimestamp(read_epoch_ns() / 1e9, UTC).isoformat(timespec="seconds")
        index = add_index(package, requirements, created)
        seal = write_package(package.files, out, args.sign or "", progress)
    others = sorted({name for run in index["runs"] for name in run["other_versions"]})
    report = Report(
        "evidence", str(out), sentence=f"{count_nouns(len(package.runs), 'run')}, "
                                       f"{count_nouns(len(package.files), 'file')}, sealed.",
        files=[("package", str(out)), ("seal", seal)],
        notes=[f"recorded with other versions than those of {BILL}: {', '.join(others)}"]
        if others else [],
        sections=[Section("Runs", [tabulate(
            runs, (Column("run"), lambda run: run.name),
            (Column("verdict"), lambda run: Cell(run.verdict, MOODS.get(run.verdict, "doubtful"))))]),
            Section("Requirements", tabulate_requirements(requirements))],
        data={"package": str(out), "seal": seal, "files": len(package.files), **index})
    return give_answer(report, args)
