"""The whole way from measured runs to an answer: starting sizes, compiled kernels, search, pattern, discrimination."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fdi.discovery.candidates import Answer, assess_explanation
from fdi.discovery.explain import Explanation, explain
from fdi.discovery.laws.effect_source import write_law_file
from fdi.discovery.refit import lean_model
from fdi.discovery.runs import Runs
from fdi.discovery.search import WholeRuns, choose_search_excerpt
from fdi.estimation.long_recordings import PIECE, can_be_cut, cut_excerpt, make_excerpt
from fdi.estimation.unknowns import UNREPLAYED, complete_model
from fdi.progress import Progress, ignore_progress
from fdi.trace.trace import Trace
from plant.effects import CATALOGUE
from plant.lanes import Lanes, compile_kernels
from plant.model import Model, list_searched_effects
from plant.run import report_law_errors
from plant.starts import ensure_starts

if TYPE_CHECKING:
    from fdi.discovery.laws.find_law import LawSearch
    from fdi.discovery.residual_pattern import Pattern

PATTERN_VERDICTS = ("UNEXPLAINED", "PARTLY")  # after these the shape of the residual is reported


def explain_runs(runs: Runs, seed: int = 0, effect_file: str | Path | None = None,
                 progress: Progress = ignore_progress, law_file: str | Path | None = None
                 ) -> tuple[Answer, Pattern | None]:
    """Find the physical effect that a model lacks.

    Args:
        runs: the model and the measured runs, from `runs.read_runs`.
        seed: of the simulated runs behind the p-values.
        effect_file: where to write the law of the residual as an effect to add, or the residual's curve where no law
            holds; None for nowhere.
        progress: called with the stage and the share done.
        law_file: where to write the law if one holds and there is no `effect_file`; None for nowhere.

    Returns the answer, and the shape of the residual where it was looked for.

    Raises:
        InputError: a user's effect that cannot be compiled and run, or a file that cannot be written.
    """
    prepare_effects(runs, progress=progress)
    explanation = explain_recording(runs, progress)
    law = look_for_law(explanation, runs.holdout, progress)
    progress("writing the answer", 0.97)
    holding = law.law if law is not None and law.law is not None and law.law.holds else None
    file = effect_file or law_file
    names = write_law_file(file, holding.terms, holding.values, holding.reason) if holding is not None and file else {}
    shape = look_for_pattern(explanation, None if holding else effect_file)
    is_pattern_reported = shape is not None and explanation.verdict in PATTERN_VERDICTS
    pattern = str(shape) if is_pattern_reported else ""
    answer = assess_explanation(explanation, seed, pattern, discriminate(explanation))
    return replace(answer, law=law, law_effects=tuple(names.values())), shape


def look_for_law(explanation: Explanation, holdout: Trace | None, progress: Progress) -> LawSearch | None:
    """The law behind what the catalogue leaves; None where it leaves nothing, and for plants driven by a pump."""
    if explanation.verdict not in PATTERN_VERDICTS or explanation.base.is_at_floor:
        return None
    if explanation.search.model.plant != "eha":
        return None  # the terms have been tried on the reference model's balances only
    from fdi.discovery.laws.find_law import find_law_beside  # takes half a second to import

    return find_law_beside(explanation, holdout, progress)


def explain_recording(runs: Runs, progress: Progress = ignore_progress, rounds: int = 2) -> Explanation:
    """The verdict on the runs; of a long recording the part is fitted that says most, and the result is judged on all.

    Where what holds on the part does not hold on all, the pieces that it leaves most of join the part, and the search
    is made once more, `rounds` times in all at most.
    """
    if not can_be_cut(runs.est, runs.model):
        return explain(runs.model, runs.est, runs.repeats, runs.holdout, progress)
    searched = [e.name for e in list_searched_effects(runs.model.plant) if e.port not in UNREPLAYED]
    excerpt = choose_search_excerpt(runs.model, runs.est, searched, progress)
    whole = WholeRuns(runs.est, runs.repeats)
    for _ in range(rounds):
        est, *repeats = (cut_excerpt(run, excerpt) for run in (runs.est, *runs.repeats))
        found = explain(runs.model, est, repeats, runs.holdout, progress, whole=whole)
        said = found.ledger[-1]
        more = None
        if said.judgement is not None and not said.judgement.holds(found.floor):
            more = said.judgement.find_worst_piece(found.floor, round(PIECE / runs.est.period), excerpt.pieces)
        if more is None:
            break
        fitted, excerpt = excerpt, make_excerpt([*excerpt.pieces, more])
    else:
        excerpt = fitted
    return replace(found, excerpt=excerpt.describe(runs.est))


def prepare_effects(runs: Runs, effects: Sequence[str] | None = None, progress: Progress = ignore_progress) -> None:
    """Find starting sizes for effects that have none, and compile what these effects need; by default all there are.

    Raises:
        InputError: a user's effect that cannot be compiled and run.
    """
    for name in [e.name for e in list_searched_effects(runs.model.plant)] if effects is None else effects:
        if not CATALOGUE[name].starts and CATALOGUE[name].fitted:
            progress(f"looking for sizes of {name}", 0.0)
            ensure_starts(name, runs.est.com, runs.est.load)
    if effects is None:
        whole_model = complete_model(runs.model)
        with report_law_errors(whole_model):
            compile_kernels(whole_model, lambda stage, share: progress(stage, 0.0))
        return
    replayed = [name for name in effects if CATALOGUE[name].port not in UNREPLAYED]
    model = lean_model(runs.model, replayed)
    with report_law_errors(model):
        progress("compiling the plant with it, once", 0.0)
        _compile_kernels(model, replayed)


def _compile_kernels(model: Model, effects: Sequence[str]) -> None:
    """A replay of a few samples without and with each effect: compiles the kernels that these take, and no others."""
    sizes = {e.fitted[0]: e.starts[-1][e.fitted[0]] for e in map(CATALOGUE.__getitem__, effects) if e.starts}
    names = list(sizes) or [next(iter(model.values))]
    usual = np.array([model[name] for name in names])
    rows = usual + np.vstack([0.0 * usual, np.diag([sizes.get(n, x) - x for n, x in zip(names, usual, strict=True)])])
    Lanes(model, names, 1, 1).replay(rows, np.zeros(2), np.zeros(2))


def look_for_pattern(explanation: Explanation, effect_file: str | Path | None = None) -> Pattern | None:
    """The shape of the residual, where no effect explains all of it or an effect file is wanted; else None.

    Raises:
        InputError: an effect file that cannot be written.
    """
    if explanation.verdict not in PATTERN_VERDICTS and not effect_file:
        return None
    from fdi.discovery.residual_pattern import find_pattern, write_effect  # takes half a second to import

    shape = find_pattern(explanation.search, explanation.ledger[-1])
    if effect_file:
        write_effect(shape, str(effect_file))
    return shape


def discriminate(explanation: Explanation) -> dict[str, Any]:
    """The sensor or the command that would discriminate between equal explanations; {} if there is none or no need."""
    if explanation.verdict != "AMBIGUOUS":
        return {}
    from fdi.discovery.separate import find_separation

    equal = [h for h in explanation.ranked if h.is_at_floor and set(h.effects) <= set(explanation.effects)]
    separation = find_separation(explanation.search, equal)
    return separation._asdict() if separation else {}
