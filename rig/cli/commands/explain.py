"""`rig explain`: which physical effect is missing from a model, with the evidence and the doubt."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from fdi.discovery.explain_runs import Answer, explain_runs, list_own_candidates, list_shared_effects
from fdi.discovery.residual_pattern import can_balance
from fdi.discovery.runs import Runs, read_runs
from fdi.discovery.sensitivity import Claim, describe_unit
from fdi.progress import Progress
from fdi.report import build_explanation_report
from plant import require
from rig.campaign.batch import Workers
from rig.campaign.sensitivity import measure_sensitivity
from rig.cli import (
    Places,
    choose_file,
    choose_places,
    format_arguments,
    format_command_line,
    give_answer,
    list_signals,
    load_known_model,
    show_progress,
    split_words,
)


def run_command(args: argparse.Namespace) -> int:
    """Exit status 0 if nothing is missing, 1 otherwise."""
    places = choose_places(args, "explain.html", args.trace)
    choose_file(args.write_effect, (".py",), args.trace, "--write-effect")
    workers = parse_workers(args.workers)
    require(args.sensitivity or not (args.hide or args.workers), "--hide" if args.hide else "--workers",
            args.hide or args.workers, "--sensitivity beside it")
    model, provenance = load_known_model(args)
    hidden_effects = args.hide.split(",") if args.hide else []
    if hidden_effects:
        split_words(hidden_effects, model.plant, args.trace)  # refuses names that are no effects
    with show_progress(args, "reading") as progress:
        runs = read_runs(model, args.trace, args.repeat, args.holdout, list_signals(args))
        law_file = None if places.page is None else places.page.with_name(f"{places.page.stem}_law.py")
        answer, pattern = explain_runs(runs, args.seed, args.write_effect, progress, law_file)
        effect_file = args.write_effect or (str(law_file) if answer.law_effects else "")
        files = [*places.files, *([("effect", effect_file)] if effect_file else [])]
        claims = _measure_claims(args, runs, answer, hidden_effects, provenance.effect_files, workers, places, progress)
        report = build_explanation_report(answer, args.trace, args.model or "eha", runs.sources, format_command_line(),
                                          choose_next_command(args, answer, effect_file), pattern, runs.notes, files,
                                          claims)
    return give_answer(report, args, int(answer.verdict != "NOTHING_MISSING"), places)


def parse_workers(text: str | None) -> Workers:
    """What --workers names: a number of processes, or a Dask scheduler; all cores without it. Raises InputError."""
    if text is None:
        return Workers(len(os.sched_getaffinity(0)))
    if "://" in text:
        return Workers(scheduler=text)
    require(text.isdecimal() and int(text) >= 1, "--workers", text,
            "1 or more processes, or the address of a Dask scheduler such as tcp://127.0.0.1:8786")
    return Workers(int(text))


def _measure_claims(args: argparse.Namespace, runs: Runs, answer: Answer, hidden_effects: Sequence[str],
                    effect_files: Sequence[str], workers: Workers, places: Places, progress: Progress) -> list[Claim]:
    """What --sensitivity finds, with its rows in a file beside the page or in this folder; nothing without it."""
    if not args.sensitivity:
        return []
    files = [str(Path(file).absolute()) for file in effect_files]
    unit = describe_unit(runs, answer, hidden_effects, files)
    page = places.page or places.answer or Path("explain.html")
    return measure_sensitivity(unit, answer, page.with_name(f"{page.stem}_sensitivity.jsonl"), workers, progress)


def choose_next_command(args: argparse.Namespace, answer: Answer, effect_file: str = "") -> str:
    """What to type next; "" if there is nothing left to do. `effect_file` is what was written, if anything."""
    arguments, effects = format_arguments(args), answer.explanation.effects
    if answer.law is not None and answer.law.law is not None and answer.law.law.holds:
        if not answer.law_effects:
            return f"rig explain {arguments} --write-effect missing.py"
        both = (*answer.law.base.effects, *answer.law_effects)
        return f"rig add {' '.join(both)} {arguments} --effects {effect_file}"
    values = {name: f"{name}={v.value:.6g}" for c in list_own_candidates(answer) for name, v in c.parameters.items()}
    if values:
        settings = [*(each for each in args.set or () if each.split("=")[0] not in values), *values.values()]
        return f"rig explain {format_arguments(argparse.Namespace(**vars(args) | {'set': settings}))}"
    if answer.verdict in ("EXPLAINED", "PARTLY", "AMBIGUOUS") and effects:
        shared_effects = list_shared_effects(answer.explanation)
        names = effects if answer.verdict != "AMBIGUOUS" else dict.fromkeys([*shared_effects, *answer.best.effects])
        return f"rig add {' '.join(names)} {arguments}"
    if answer.verdict == "UNEXPLAINED" and args.write_effect:
        return f"rig explain {arguments} --effects {args.write_effect}"
    if answer.verdict == "UNEXPLAINED" and answer.pattern and can_balance(answer.explanation.search.model):
        return f"rig explain {arguments} --write-effect missing.py"
    return ""
