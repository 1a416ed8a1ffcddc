"""`rig view`: a trace, a trace beside a model, or several traces, in the rerun viewer."""

import argparse
import sys
import time
import webbrowser
from dataclasses import replace
from pathlib import Path

from fdi.comparison.compare import Comparison, compare
from fdi.discovery.update_model import remove_all_effects
from fdi.progress import Progress
from fdi.report import Report, join_words
from fdi.trace import Trace
from plant import Model, require
from rig.cli import (
    choose_file,
    give_answer,
    list_signals,
    load_declared_model,
    load_known_model,
    name_after,
    show_progress,
)
from rig.cli.commands.diff import read_and_compare_runs
from rig.interrupts import catch_signals
from rig.view import viewer
from rig.view.recording import Drawing, draw_comparison, draw_run, draw_runs, write_recording


def run_command(args: argparse.Namespace) -> int:
    """The viewer listens on 127.0.0.1 only."""
    require_options_that_fit(args)
    out = choose_file(args.out, (".rrd", ".png"), args.trace)
    rrd = place_recording(args) if out is None else out.with_suffix(".rrd")
    with show_progress(args) as progress:
        drawing = draw(args, progress)
        progress("writing the recording", 0.0)
        write_recording(drawing, rrd)
        data: dict[str, object] = {"rrd": str(rrd), **({"verdict": drawing.verdict} if drawing.verdict else {})}
        if out is not None and out.suffix == ".png":
            progress("the viewer draws the picture", 0.0)
            viewer.take_screenshot(rrd, out)
            data |= {"screenshot": args.out}
        elif not (out or args.theme):
            progress("opening the viewer", 0.0)
            viewer.open_viewer(rrd)
    sentence = "\n".join(dict.fromkeys(str(path) for path in (rrd, out) if path))
    report = Report("view", join_words([args.trace, *args.others]), sentence=sentence, data=data)
    return show_in_browser(report, rrd, args) if args.theme else give_answer(report, args)


def show_in_browser(report: Report, rrd: Path, args: argparse.Namespace) -> int:
    """Show a recording in a browser; return at Ctrl-C."""
    with viewer.serve_in_browser(rrd, args.theme) as (address, server), catch_signals() as is_to_stop:
        give_answer(replace(report, sentence=f"{report.sentence}\n{address}  (Ctrl-C ends it)",
                            data={**report.data, "address": address}), args)
        sys.stdout.flush()
        if not is_to_stop():  # asked first: from here on Ctrl-C ends the viewer, also while the browser starts
            webbrowser.open(address)
        while not is_to_stop() and server.poll() is None:
            time.sleep(0.1)
    return 0


def require_options_that_fit(args: argparse.Namespace) -> None:
    """Refuse options that do not belong together.

    Raises:
        InputError: such options.
    """
    require(not (args.theme and args.out), "--theme", args.theme, "no --out with it: it opens no browser")
    require(not (args.compare and args.others), "--compare", "".join(args.others[:1]),
            "one trace; rig view A B holds traces against each other")
    for option in ("set", "effects", "seed", "repeat", "signals"):
        require(args.compare or getattr(args, option) in (None, []), f"--{option}", "", "--compare with it")


def place_recording(args: argparse.Namespace) -> Path:
    """The recording without --out: beside the last trace."""
    source = Path([args.trace, *args.others[:1]][-1])
    folder = source if source.is_dir() else source.parent
    name = name_after(source, ".rrd")
    if args.compare:
        name = "compare.rrd"
    elif args.others:
        name = "diff.rrd"
    return folder / name


def draw(args: argparse.Namespace, progress: Progress) -> Drawing:
    """What is to be shown.

    Raises:
        InputError: a trace, model or option that cannot be used.
    """
    if args.others:
        return draw_runs(read_and_compare_runs([args.trace, *args.others], load_declared_model(args).kind.signals,
                                               progress))
    progress("reading", 0.0)
    if not args.compare:
        return draw_run(Trace.read(args.trace, all=True, signals=load_declared_model(args).kind.signals))
    model, before = load_models(args)
    trace, *repeats = (Trace.read(file, signals=model.kind.signals) for file in (args.trace, *args.repeat))

    def replay(model: Model, word: str, part: int) -> Comparison:
        def show(stage: str, share: float) -> None:
            progress(f"{word}{stage}", (part + share) / (2 if before else 1))

        return compare(trace, model, repeats, list_signals(args), show, args.trace)

    after = replay(model, "after: " if before else "", 0)
    return draw_comparison(after, replay(before, "before: ", 1) if before else None)


def load_models(args: argparse.Namespace) -> tuple[Model, Model | None]:
    """The chosen model, and the same without --set and without added effects; None if it is the same."""
    model, _ = load_known_model(args)
    bare, provenance = load_known_model(argparse.Namespace(**{**vars(args), "set": []}))
    effects = tuple(dict.fromkeys([*provenance.effects, *bare.effects]))
    before = remove_all_effects(bare, replace(provenance, effects=effects))
    return model, None if (before.values, before.effects) == (model.values, model.effects) else before
