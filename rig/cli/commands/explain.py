"""`rig explain`: which physical effect is missing from a model, with the evidence and the doubt."""
from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rig.cli import discovery_options, options

if TYPE_CHECKING:
    from fdi.discovery.explain_runs import Answer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    discovery_options.add_run_options(parser)
    options.add_model_options(parser)
    add("--write-effect", metavar="FILE.py", help="write the law of the residual as an effect to add; where no "
        "law holds, its shape, to edit (with --out FILE.html a law that holds is written beside it, as FILE_law.py)")
    add("--report", action="store_true", help="write a page with pictures, explain.html beside the trace, or where "
                                              "--out FILE.html says")


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if nothing is missing, 1 otherwise."""
    from fdi.discovery.explain_runs import explain_runs
    from fdi.discovery.runs import read_runs
    from fdi.report.explain_report import build_explanation_report
    from rig.cli.answer import choose_file, choose_places, show_answer, write_answer
    from rig.cli.progress_bar import show_progress

    places = choose_places(args, "explain.html", args.trace)
    choose_file(args.write_effect, (".py",), args.trace, "--write-effect")
    model, _ = discovery_options.load_model(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("reading", 0.0)
        runs = read_runs(model, args.trace, args.repeat, args.holdout, discovery_options.list_signals(args))
        law_file = None if places.page is None else places.page.with_name(f"{places.page.stem}_law.py")
        answer, pattern = explain_runs(runs, args.seed, args.write_effect, progress, law_file)
        effect_file = args.write_effect or (str(law_file) if answer.law_effects else "")
        files = [*places.files, *([("effect", effect_file)] if effect_file else [])]
        next_command = choose_next_command(args, answer, effect_file)
        report = build_explanation_report(answer, args.trace, args.model or "eha", runs.sources,
                                    discovery_options.format_command_line(), next_command, pattern, runs.notes, files)
        write_answer(report, places)
    show_answer(report, args)
    return 0 if answer.verdict == "NOTHING_MISSING" else 1


def choose_next_command(args: argparse.Namespace, answer: Answer, effect_file: str = "") -> str:
    """What to type next; "" if there is nothing left to do. `effect_file` is what was written, if anything."""
    arguments = discovery_options.format_arguments(args, args.trace)
    effects = answer.explanation.effects
    law = answer.law.law if answer.law is not None and answer.law.law is not None and answer.law.law.holds else None
    if law is not None and answer.law is not None:
        if not answer.law_effects:
            return f"rig explain {arguments} --write-effect missing.py"
        both = (*answer.law.base.effects, *answer.law_effects)
        return f"rig add {' '.join(both)} {arguments} --effects {effect_file}"
    if answer.verdict in ("EXPLAINED", "PARTLY", "AMBIGUOUS") and effects:
        chosen = effects[:1] if answer.verdict == "AMBIGUOUS" else effects
        return f"rig add {' '.join(chosen)} {arguments}"
    if answer.verdict == "UNEXPLAINED" and args.write_effect:
        return f"rig explain {arguments} --effects {args.write_effect}"
    if answer.verdict == "UNEXPLAINED" and answer.pattern:
        return f"rig explain {arguments} --write-effect missing.py"
    return ""
