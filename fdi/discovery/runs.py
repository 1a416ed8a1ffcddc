"""Measured runs made ready for a search: one to explain, repeats of its command, and one that no fit sees."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from fdi.estimation import (
    SAME_PERIOD,
    compute_residuals,
    describe_doubtful_repeats,
    find_floors,
    find_repeat,
    has_same_command,
    hold_inputs,
    match_period,
    prepare_trace,
    replay_current,
    require_finite_replay,
    sensor_floors,
)
from fdi.trace import Trace, locate_log
from plant import InputError, Model, require


class Source(NamedTuple):
    """Where a run came from, and what tells it from any other."""

    file: str
    sha256: str


class Runs(NamedTuple):
    """What a search or a fit works on."""

    model: Model  # at the cycle of the traces
    est: Trace  # prepared for replay, as the others
    repeats: tuple[Trace, ...]  # on the rows of `est`
    holdout: Trace | None
    sources: tuple[Source, ...]  # of the run, its repeats, and the held-out one if there is one
    notes: tuple[str, ...]  # what reading had to leave out or put right


def read_runs(model: Model, trace: str | Trace, repeats: Sequence[str | Trace] = (),
              holdout: str | Trace | None = None, signals: Sequence[str] | None = None) -> Runs:
    """The runs of a search, from files or traces.

    Raises:
        InputError: a file or trace that cannot be used, a repeat of another command, or a run given twice.
    """
    traces, sources = read_traces([trace, *repeats, *([] if holdout is None else [holdout])], model)
    require_distinct(sources, "--repeat", "the same command run again", 1 + len(repeats))
    names = [s.file for s in sources]
    est = _prepare_run(traces[0], model, signals, names[0])
    model = match_period(model, est, SAME_PERIOD)
    require_finite_replay(est, model)
    others = tuple(_prepare_repeat(est, traces[n], model, names[n], n) for n in range(1, 1 + len(repeats)))
    unseen = None if holdout is None else _prepare_holdout(est, traces[-1], model, names[0], names[-1])
    doubt = ""
    if others and model.kind.controller:  # an error of the model is the same in all of them and does not matter here
        first, *repeat_residuals = (compute_residuals(run, replay_current(run, model)) for run in (est, *others))
        doubt = describe_doubtful_repeats(find_floors(first, repeat_residuals, est.period), sensor_floors(est, model),
                                          est.declared)
    alike = ("the held-out run has the command of the run: it shows overfitting less than another command"
             if unseen is not None and has_same_command(est, unseen) else "")
    return Runs(model, est, others, unseen, tuple(sources), (*est.notes, *filter(None, (doubt, alike))))


def read_traces(runs: Sequence[str | Trace], model: Model) -> tuple[list[Trace], list[Source]]:
    """Traces of the plant of a model, those that are files read, and where they come from.

    Raises:
        InputError: a file that cannot be used.
    """
    sources = [Source(each.provenance.get("source", "trace"), _hash_columns(each)) if isinstance(each, Trace)
               else read_source(each) for each in runs]
    traces = [each if isinstance(each, Trace) else Trace.read(each, signals=model.kind.signals) for each in runs]
    if any(isinstance(each, Trace) for each in runs):  # it may have been read from a file that is given beside it
        files = {_hash_columns(trace): source.sha256 for each, trace, source in zip(runs, traces, sources, strict=True)
                 if not isinstance(each, Trace)}
        sources = [source._replace(sha256=files.get(source.sha256, source.sha256)) for source in sources]
    return traces, sources


def _hash_columns(trace: Trace) -> str:
    """SHA-256 of the columns of a trace, which tells it from any other."""
    content = hashlib.sha256()
    d = trace.declared
    for signal in (d.command, *d.outputs, d.drive, *([d.load] if d.load else [])):
        content.update(trace.column(signal.name).tobytes())
    return content.hexdigest()


def read_source(file: str) -> Source:
    """The file of a trace, or that of the run in a folder, with the hash of its bytes."""
    try:
        return Source(file, hashlib.sha256(locate_log(Path(file)).read_bytes()).hexdigest())
    except OSError as error:
        raise InputError(file, "", f"a trace that can be read ({error.strerror})") from error


def require_distinct(sources: Sequence[Source], first: str, expectation: str, count: int) -> None:
    """Refuse a run that stands in for itself: it would prove whatever is asked of it.

    Args:
        sources: of the runs to fit, then of the held-out ones.
        first: where a run to fit was named, for the message.
        expectation: what it should be.
        count: of the runs to fit.

    Raises:
        InputError: a run that is given twice.
    """
    files: dict[str, str] = {}
    for number, (file, content) in enumerate(sources):
        if content in files:
            place, words = (first, expectation) if number < count else ("--holdout", "a run that no fit has seen")
            raise InputError(place, file, f"{words}; this is {files[content]} itself")
        files[content] = file


def _prepare_run(trace: Trace, model: Model, outputs: Sequence[str] | None, source: str) -> Trace:
    """A run as fits use it: on the cycles of its controller, where that is known; else row by row as it is."""
    if not model.kind.controller:
        return hold_inputs(trace, outputs, source)
    return prepare_trace(trace, model, outputs, source)


def _prepare_repeat(est: Trace, trace: Trace, model: Model, source: str, number: int) -> Trace:
    """A repeat on the rows of the run, with its outputs."""
    for name in est.outputs:
        require(name in trace.signals, source, name, f"the signals of the run it repeats ({', '.join(est.outputs)})")
    if not model.kind.controller:
        return hold_inputs(trace, est.outputs, source)
    return find_repeat(est, trace, model, number)


def _prepare_holdout(est: Trace, trace: Trace, model: Model, est_source: str, source: str) -> Trace:
    """The held-out run, with those of the run's outputs that it has."""
    outputs = [s for s in est.outputs if s in trace.signals]
    unseen = _prepare_run(trace, model, outputs or est.outputs, source)
    period = model["controller.period"]
    require(match_period(model, unseen, SAME_PERIOD)["controller.period"] == period, source, "t",
            f"rows {period:g} s apart, as in {est_source}")
    return unseen
