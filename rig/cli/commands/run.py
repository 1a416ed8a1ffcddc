"""`rig run`: play a test sequence on the bench, log it, judge it."""
from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli import options

if TYPE_CHECKING:
    from fdi.progress import Progress
    from rig.run.job import Job
    from rig.run.outcome import Outcome


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("sequence", nargs="?", metavar="SEQUENCE", help="a .toml file, or the name of a shipped one (preflight)")
    options.add_model(parser)
    parser.set_defaults(seed=None)  # so that one given beside --from is noticed
    add("--bus", default="auto", metavar="auto|virtual|INTERFACE:CHANNEL",
        help="virtual: embedded in this process (default); socketcan:can0, udp_multicast, ...")
    add("--pace", choices=("lockstep", "realtime"), default=None,
        help="lockstep: virtual time, repeatable (default); realtime: the wall clock")
    add("--controller", choices=("builtin", "external"), default=None,
        help="whose firmware is node 2 (default: builtin)")
    add("--plant", choices=("auto", "builtin", "external"), default=None,
        help="node 3: auto takes the one that answers on the bus, else starts one (default)")
    add("--max-overruns", type=float, default=None, metavar="FRACTION",
        help="real time: more overruns than this part of all cycles make the timing invalid (default 0.001)")
    add("--fdi", action="store_true", help="then judge the servovalve as rig fdi does: a healthy nominal one expected")
    add("--from", dest="source", type=Path, metavar="trace.mcap", help="repeat the run of this log")


def run_command(args: argparse.Namespace) -> int:
    """Run a sequence; results go to --out (default: a new folder in runs/)."""
    from fdi.report.run_page import write_report
    from rig.cli import show_run
    from rig.network.bus import choose
    from rig.run.runner import run as do

    job = repeated(args) if args.source else asked(args)
    bus, why = choose(job.bus if args.source and args.bus == "auto" else args.bus)
    job = replaced(job, bus=bus)
    folder = Path(args.out) if args.out else fresh_folder(Path("runs"), Path(job.sequence.name).stem)
    silent = args.json or args.quiet
    with show_run.progress(job, why, silent) as progress, show_run.stoppable() as stop:
        outcome = do(job, folder, progress, stop)
        progress("report", 0.0)
        write_report(folder / "trace.mcap", folder / "report.html")
        if args.fdi:
            outcome = diagnosed(outcome, progress)
    with contextlib.suppress(BrokenPipeError):  # who does not read on has no bearing on the verdict
        if args.json:
            show_run.as_json(outcome)
        elif not args.quiet:
            show_run.outcome(outcome)
    return outcome.status


def diagnosed(outcome: Outcome, progress: Progress) -> Outcome:
    """The outcome with what `rig fdi` says of its trace, in verdict.json as well; the run's own verdict stays."""
    from fdi.diagnosis.diagnosis import diagnose
    from fdi.report.diagnosis_text import to_json
    from fdi.trace.trace import Trace
    from plant import InputError

    try:
        found = to_json(diagnose(Trace.read(outcome.folder), progress=progress, source=str(outcome.folder)))
    except InputError as error:  # a sequence too short to tell, say
        found = {"verdict": "CANNOT_TELL", "sentence": f"not judged: {error}"}
    told = replace(outcome, fdi=found)
    told.save()
    return told


def asked(args: argparse.Namespace) -> Job:
    """The job the options describe; the sequence's own model choice comes first, --model and --set on top."""
    from plant import InputError, load_model
    from rig.run.job import Job
    from rig.sequences import load_sequence

    options.load_user_effects(args.effects)
    sequence = load_sequence(args.sequence or "preflight")
    chosen = load_model(args.model or sequence.model.name).replace(sequence.model.overrides, sequence.name)
    model = chosen.replace(options.changes(args.set))
    if model["controller.period"] != 1e-3:
        raise InputError("--set", "controller.period", "0.001 s: the bench's cycle is fixed; rig simulate takes others")
    if args.max_overruns is not None and not 0 <= args.max_overruns <= 1:
        raise InputError("--max-overruns", "", f"a fraction from 0 to 1, not {args.max_overruns:g}")
    foreign = [name for name in model.differences() if name.startswith("controller.")]
    if args.controller == "external" and foreign:
        raise InputError("--set", foreign[0], "no gains beside --controller external: that firmware has its own")
    job = Job(sequence=sequence, model=model, seed=args.seed or 0, effects=tuple(args.effects))
    return replaced(job, pace=args.pace, controller=args.controller, plant=args.plant, max_overruns=args.max_overruns)


def repeated(args: argparse.Namespace) -> Job:
    """The job of a log; what only this machine can know (bus, pace, who the controller is) may be asked for anew."""
    from plant import InputError
    from rig.run.job import repeat

    if args.sequence or args.set or args.model or args.effects or args.seed is not None:
        raise InputError("--from", str(args.source), "no SEQUENCE, --model, --set, --seed or --effects: the log has "
                         "them")
    log = args.source / "trace.mcap" if args.source.is_dir() else args.source
    if args.out and (Path(args.out) / "trace.mcap").resolve() == log.resolve():
        raise InputError("--out", args.out, "another folder than that of the log to repeat, which would be overwritten")
    return replaced(repeat(args.source), pace=args.pace, controller=args.controller, plant=args.plant,
                    max_overruns=args.max_overruns)


def replaced(job: Job, **given: object) -> Job:
    """The job with the settings that were given."""
    from dataclasses import replace
    from typing import Any

    said: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    return replace(job, **said)


def fresh_folder(parent: Path, name: str) -> Path:
    """A folder that was not there: parent/name, name-2, name-3, ... Made at once, so that no two runs take it."""
    from itertools import count

    from plant import InputError

    for number in count(1):
        folder = parent / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError("--out", str(folder), f"a place that can be written ({error.strerror})") from error
        return folder
    raise AssertionError
