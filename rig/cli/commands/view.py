"""`rig view`: a trace in the rerun viewer."""
from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rig view`."""
    parser.add_argument("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV")
    parser.add_argument("--save", metavar="FILE.rrd", help="write the recording of the viewer and do not open it")
    parser.add_argument("--headless", action="store_true", help="open no window (together with --screenshot)")
    parser.add_argument("--screenshot", metavar="FILE.png",
                        help="draw without a display, check that every view shows its lines, and save the picture")


def run_command(args: argparse.Namespace) -> int:
    """The viewer listens on 127.0.0.1 only."""
    from plant.errors import InputError

    if args.headless and not args.screenshot:
        raise InputError("--headless", "", "--screenshot FILE.png with it")
    from fdi.output import require_writable
    from fdi.report.report import Report
    from fdi.trace.trace import Trace
    from rig.cli.answer import show_answer
    from rig.cli.progress_bar import show_progress
    from rig.view import rerun_log, viewer

    source = Path(args.trace)
    trace = Trace.read(source, all=True)
    save = args.save or args.out
    if save is not None:
        rrd = require_writable(save, "--save" if args.save else "--out", source=source)
    elif args.screenshot:
        rrd = require_writable(Path(args.screenshot).with_suffix(".rrd"), "--screenshot", source=source)
    else:
        rrd = (source if source.is_dir() else source.parent) / (source.name.split(".")[0] + ".rrd")
    if args.screenshot:
        require_writable(args.screenshot, "--screenshot", source=source)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("writing the recording", 0.0)
        rerun_log.write_rrd(trace, rrd)
        answer: dict[str, object] = {"rrd": str(rrd)}
        if args.screenshot:
            progress("the viewer draws the picture", 0.0)
            answer["screenshot"] = args.screenshot
            answer["pixels"] = viewer.take_screenshot(rerun_log.list_shown_views(trace), rrd, Path(args.screenshot))
        elif save is None:
            progress("opening the viewer", 0.0)
            viewer.open_viewer(rrd)
    written = "\n".join(str(path) for path in (rrd, args.screenshot) if path)
    show_answer(Report("view", str(source), sentence=written, data=answer), args)
    return 0
