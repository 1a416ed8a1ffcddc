"""`rig explain`: which physical effect is missing from a model, with the evidence and the doubt."""
from __future__ import annotations

import argparse

from fdi.discovery.explain_runs import Answer, explain_runs
from fdi.discovery.runs import read_runs
from fdi.report.explain_report import build_explanation_report
from rig.cli.answer import choose_file, choose_places, give_answer, show_progress
from rig.cli.discovery_inputs import format_command_line, load_known_model
from rig.cli.inputs import format_arguments, list_signals


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if nothing is missing, 1 otherwise."""
    places = choose_places(args, "explain.html", args.trace)
    choose_file(args.write_effect, (".py",), args.trace, "--write-effect")
    model, _ = load_known_model(args)
    with show_progress(is_silent=args.json or args.quiet) as progress:
        progress("reading", 0.0)
        runs = read_runs(model, args.trace, args.repeat, args.holdout, list_signals(args))
        law_file = None if places.page is None else places.page.with_name(f"{places.page.stem}_law.py")
        answer, pattern = explain_runs(runs, args.seed, args.write_effect, progress, law_file)
        effect_file = args.write_effect or (str(law_file) if answer.law_effects else "")
        files = [*places.files, *([("effect", effect_file)] if effect_file else [])]
        report = build_explanation_report(answer, args.trace, args.model or "eha", runs.sources, format_command_line(),
                                          choose_next_command(args, answer, effect_file), pattern, runs.notes, files)
    return give_answer(report, args, int(answer.verdict != "NOTHING_MISSING"), places)


def choose_next_command(args: argparse.Namespace, answer: Answer, effect_file: str = "") -> str:
    """What to type next; "" if there is nothing left to do. `effect_file` is what was written, if anything."""
    arguments, effects = format_arguments(args), answer.explanation.effects
    if answer.law is not None and answer.law.law is not None and answer.law.law.holds:
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
