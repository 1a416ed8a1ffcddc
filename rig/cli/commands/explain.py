"""`rig explain`: which physical effect is missing from a model, with the evidence and the doubt."""
from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.cli import discovery_options, options

if TYPE_CHECKING:
    from fdi.discovery import Explanation
    from fdi.discovery.candidates import Answer
    from fdi.discovery.residual_pattern import Pattern
    from fdi.discovery.runs import Runs

LEFT_OVER = ("UNEXPLAINED", "PARTLY")  # verdicts after which the shape of what is left is told


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this command alone."""
    add = parser.add_argument
    add("trace", metavar="TRACE", help="trace.mcap, the folder of a run, or a CSV with t,com,xj,cor[,p12,xs,load]")
    discovery_options.add_runs(parser)
    options.add_model(parser)
    add("--write-effect", metavar="FILE.py", help="write the shape of what is left over as an effect, to edit and add")
    add("--report", action="store_true", help="write a page with pictures, explain.html beside the trace, or where "
                                              "--out FILE.html says")


def run_command(args: argparse.Namespace) -> int:
    """Name what is missing; exit status 0 if nothing is, 1 otherwise."""
    from fdi.discovery import explain
    from fdi.discovery.candidates import to_json
    from fdi.discovery.runs import read_runs
    from fdi.output import write_text
    from rig.cli import show_explain
    from rig.cli.progress_bar import show_progress

    page, answer_file = places(args)
    model, _ = discovery_options.model_of(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("reading", 0.0)
        runs = read_runs(model, args.trace, args.repeat, args.holdout, discovery_options.signals_of(args))
        discovery_options.prepare(runs, progress)
        found = explain(runs.model, runs.est, runs.repeats, runs.holdout, progress)
        progress("putting it into words", 0.95)
        answer, shape = worked_out(found, args.seed, args.write_effect)
        if answer_file is not None:
            write_text(answer_file, json.dumps(to_json(answer)) + "\n")
        if page is not None:
            write_page(page, args, answer, runs, shape)
    if args.json:
        print(json.dumps(to_json(answer)))
    elif not args.quiet:
        show_explain.answer(answer, runs.notes, next_command(args, answer), page, args.write_effect)
    return 0 if answer.verdict == "NOTHING_MISSING" else 1


def places(args: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """Where a page and a JSON file are to go."""
    out = discovery_options.place(args.out, (".html", ".json"), args.trace)
    discovery_options.place(args.write_effect, (".py",), args.trace, "--write-effect")
    page = out if out is not None and out.suffix == ".html" else None
    if args.report and page is None:
        source = Path(args.trace)
        beside = (source if source.is_dir() else source.parent) / "explain.html"
        page = discovery_options.place(str(beside), (".html",), args.trace, "--report")
    return page, out if out is not None and out.suffix == ".json" else None


def worked_out(found: Explanation, seed: int, effect_file: str | None) -> tuple[Answer, Pattern | None]:
    """All that is told: the shape of what is left, what would split a set, and the effect file if one is wanted."""
    from fdi.discovery.candidates import assess_explanation

    shape = None
    if found.verdict in LEFT_OVER or effect_file:
        from fdi.discovery.residual_pattern import find_pattern, write_effect  # takes half a second to import

        shape = find_pattern(found.search, found.ledger[-1])
        if effect_file:
            write_effect(shape, effect_file)
    split: dict[str, Any] = {}
    if found.verdict == "AMBIGUOUS":
        from fdi.discovery.separate import find_separation

        equal = [h for h in found.ranked if h.reached and set(h.effects) <= set(found.effects)]
        separation = find_separation(found.search, equal)
        split = separation._asdict() if separation else {}
    return assess_explanation(found, seed, str(shape) if shape and found.verdict in LEFT_OVER else "", split), shape


def write_page(page: Path, args: argparse.Namespace, answer: Answer, runs: Runs, shape: Pattern | None) -> None:
    """The page with pictures."""
    from fdi.output import write_text
    from fdi.report import explain_page

    write_text(page, explain_page.explanation(answer, args.trace, args.model or "eha", runs.sources,
                                            discovery_options.typed(),
                                       next_command(args, answer), shape, runs.notes))


def next_command(args: argparse.Namespace, answer: Answer) -> str:
    """What to type next; "" if there is nothing left to do."""
    words = discovery_options.words(args.trace, args)
    if answer.verdict in ("EXPLAINED", "PARTLY", "AMBIGUOUS") and answer.explanation.effects:
        effects = answer.explanation.effects
        chosen = effects[:1] if answer.verdict == "AMBIGUOUS" else effects
        return f"rig add {' '.join(chosen)} {words}"
    if answer.verdict == "UNEXPLAINED" and not args.write_effect and answer.pattern:
        return f"rig explain {words} --write-effect missing.py"
    if answer.verdict == "UNEXPLAINED" and args.write_effect:
        return f"rig explain {words} --effects {args.write_effect}"
    return ""
