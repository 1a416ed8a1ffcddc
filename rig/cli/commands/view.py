"""`rig view`: a trace, a trace beside a model, or several traces, in the rerun viewer."""
from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rig.cli import options

if TYPE_CHECKING:
    from fdi.comparison.compare import Comparison
    from fdi.progress import Progress
    from plant.model import Model
    from rig.view.viewer import ShownView


class Drawing(NamedTuple):
    """What is to be shown: its recording is written by `write`; `verdict` is "" for a single run."""

    write: Callable[[Path], None]
    shown: Sequence[ShownView]
    verdict: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig view`."""
    add = parser.add_argument
    add("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV")
    add("others", metavar="B", nargs="*", help="runs to draw over it and to subtract it from, as rig diff does")
    add("--compare", action="store_true",
        help="the trace beside the model's replay, with residual and noise floor, as rig compare does; if --model or "
             "--set adds effects or values, before and after that")
    compare = parser.add_argument_group("with --compare")
    options.add_model_options(compare)
    parser.set_defaults(seed=None)  # so that one that is given without --compare is noticed
    compare.add_argument("--repeat", action="append", default=[], metavar="TRACE",
                         help="another run of the same command, measures the noise floor (repeatable)")
    compare.add_argument("--signals", metavar="xj,p12,xs", help="what to compare (default: what the trace has)")
    add("--save", metavar="FILE.rrd", help="write the recording of the viewer and do not open it")
    add("--theme", choices=("light", "dark"),
        help="show it in a web browser in this theme until Ctrl-C (the viewer's window has a setting for it)")
    add("--headless", action="store_true", help="open no window (together with --screenshot)")
    add("--screenshot", metavar="FILE.png",
        help="draw without a display, check that every view shows its lines, and save the picture")


def run_command(args: argparse.Namespace) -> int:
    """The viewer listens on 127.0.0.1 only."""
    from fdi.output import require_writable
    from fdi.report.numbers import join_words
    from fdi.report.report import Report
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.view import viewer
    from rig.view.viewer import import_rerun

    _require_options_that_fit(args)
    sources = [args.trace, *args.others]
    rrd = _choose_recording(args)
    if args.screenshot:
        require_writable(args.screenshot, "--screenshot", source=args.trace)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        drawing = _prepare_drawing(args, progress)
        import_rerun()
        progress("writing the recording", 0.0)
        drawing.write(rrd)
        answer: dict[str, object] = {"rrd": str(rrd)}
        if drawing.verdict:
            answer["verdict"] = drawing.verdict
        if args.screenshot:
            progress("the viewer draws the picture", 0.0)
            answer["screenshot"] = args.screenshot
            answer["pixels"] = viewer.take_screenshot(drawing.shown, rrd, Path(args.screenshot))
        elif not (args.save or args.out or args.theme):
            progress("opening the viewer", 0.0)
            viewer.open_viewer(rrd)
    written = [str(path) for path in (rrd, args.screenshot) if path]

    def show(*more: str) -> None:
        show_answer(Report("view", join_words(sources), sentence="\n".join([*written, *more]), data=answer), args)

    if args.theme:
        _show_in_browser(rrd, args.theme, answer, show)
    else:
        show()
    return 0


def _show_in_browser(rrd: Path, theme: str, answer: dict[str, object], show: Callable[[str], None]) -> None:
    """Open the viewer in a browser; return at Ctrl-C."""
    import sys
    import time
    import webbrowser

    from rig.cli.interruption import catch_signals
    from rig.view.viewer import serve_in_browser

    with serve_in_browser(rrd, theme) as (address, server), catch_signals() as is_to_stop:
        answer["address"] = address
        show(f"{address}  (Ctrl-C ends it)")
        sys.stdout.flush()
        webbrowser.open(address)
        while not is_to_stop() and server.poll() is None:
            time.sleep(0.1)


def _require_options_that_fit(args: argparse.Namespace) -> None:
    from plant.errors import InputError

    if args.headless and not args.screenshot:
        raise InputError("--headless", "", "--screenshot FILE.png with it")
    if args.theme and (args.screenshot or args.save or args.out):
        raise InputError("--theme", args.theme, "no --screenshot, --save or --out with it: they open no browser")
    if args.compare and args.others:
        raise InputError("--compare", args.others[0], "one trace; rig view A B holds traces against each other")
    for option in ("model", "set", "effects", "trust", "repeat", "signals"):
        if getattr(args, option) and not args.compare:
            raise InputError(f"--{option}", "", "--compare with it")
    if args.seed is not None and not args.compare:
        raise InputError("--seed", str(args.seed), "--compare with it")


def _choose_recording(args: argparse.Namespace) -> Path:
    """--save or --out, else beside the picture, else beside the last trace."""
    from fdi.output import require_writable

    source = Path(args.trace)
    save = args.save or args.out
    if save is not None:
        return require_writable(save, "--save" if args.save else "--out", source=source)
    if args.screenshot:
        return require_writable(Path(args.screenshot).with_suffix(".rrd"), "--screenshot", source=source)
    if args.others:
        source = Path(args.others[0])
    folder = source if source.is_dir() else source.parent
    name = "compare" if args.compare else "diff" if args.others else source.name.split(".")[0]
    return folder / f"{name}.rrd"


def _prepare_drawing(args: argparse.Namespace, progress: Progress) -> Drawing:
    from fdi.trace.trace import Trace
    from rig.view import rerun_log

    if args.compare:
        return _prepare_comparison(args, progress)
    if args.others:
        return _prepare_runs([args.trace, *args.others], progress)
    progress("reading", 0.0)
    trace = Trace.read(args.trace, all=True)
    return Drawing(lambda rrd: rerun_log.write_rrd(trace, rrd), rerun_log.list_shown_views(trace))


def _prepare_comparison(args: argparse.Namespace, progress: Progress) -> Drawing:
    """The comparison with the chosen model, and that with the model without added effects and --set, if it differs."""
    from fdi.comparison.compare import compare
    from fdi.trace.trace import Trace
    from rig.cli.discovery_options import list_signals
    from rig.view import comparison_log

    model, before = _load_models(args)
    trace = Trace.read(args.trace)
    repeats = [Trace.read(file) for file in args.repeat]
    parts = 2 if before else 1

    def replay(model: Model, word: str, part: int) -> Comparison:
        def show(stage: str, share: float) -> None:
            progress(f"{word}{stage}", (part + share) / parts)

        return compare(trace, model, repeats, list_signals(args), show, args.trace)

    after = replay(model, "after: " if before else "", 0)
    earlier = replay(before, "before: ", 1) if before else None
    return Drawing(lambda rrd: comparison_log.write_comparison_rrd(after, earlier, rrd),
                   comparison_log.list_shown_views(after, earlier), after.verdict)


def _load_models(args: argparse.Namespace) -> tuple[Model, Model | None]:
    """The chosen model, and the same without --set and without added effects; None if it is the same."""
    from dataclasses import replace

    from fdi.discovery.update_model import remove_all_effects
    from rig.cli.discovery_options import load_model

    model, _ = load_model(args)
    bare, known = load_model(argparse.Namespace(**{**vars(args), "set": []}))
    added = tuple(dict.fromkeys([*known.effects, *bare.effects]))
    before = remove_all_effects(bare, replace(known, effects=added))
    is_same = before.values == model.values and before.effects == model.effects
    return model, None if is_same else before


def _prepare_runs(sources: Sequence[str], progress: Progress) -> Drawing:
    """Runs over each other, and subtracted from the first."""
    from fdi.comparison.run_differences import compare_runs
    from fdi.trace.trace import Trace
    from rig.view import runs_log

    traces = []
    for i, source in enumerate(sources):
        progress(f"reading {source}", i / (len(sources) + 1))
        traces.append(Trace.read(source, all=True))
    progress("aligning and subtracting", len(sources) / (len(sources) + 1))
    found = compare_runs(sources, traces)
    return Drawing(lambda rrd: runs_log.write_runs_rrd(found, rrd), runs_log.list_shown_views(found), found.verdict)
