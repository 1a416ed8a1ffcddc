"""The runs of an identification: several to fit, of any commands, and some that no fit sees."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from fdi.discovery.runs import Source, hash_columns, read_source
from fdi.estimation.preparation import SAME_PERIOD, hold_inputs, match_period, prepare_trace
from fdi.identification.free_parameters import Range
from fdi.trace.signals import OUTPUTS
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model


class IdentificationRuns(NamedTuple):
    """What an identification works on."""

    model: Model  # at the cycle of the runs
    fitted: tuple[Trace, ...]  # prepared, with the same outputs
    held_out: tuple[Trace, ...]
    sources: tuple[Source, ...]  # of all of them, the held-out ones last


def read_identification_runs(model: Model, ranges: Sequence[Range], fitted: Sequence[str], held_out: Sequence[str],
                             signals: Sequence[str] | None = None) -> IdentificationRuns:
    """Read and prepare the files of an identification.

    Raises:
        InputError: a file that cannot be used, or a run given twice.
    """
    files = [*fitted, *held_out]
    sources = [read_source(file) for file in files]
    return prepare_runs(model, ranges, [Trace.read(file) for file in files], sources, len(fitted), signals)


def collect_identification_runs(model: Model, ranges: Sequence[Range], fitted: Sequence[Trace],
                                held_out: Sequence[Trace], signals: Sequence[str] | None = None) -> IdentificationRuns:
    """The runs of an identification from traces that have been read or simulated.

    Raises:
        InputError: a trace that cannot be used, or a run given twice.
    """
    traces = [*fitted, *held_out]
    sources = [Source(t.provenance.get("source", "trace"), hash_columns(t)) for t in traces]
    return prepare_runs(model, ranges, traces, sources, len(fitted), signals)


def prepare_runs(model: Model, ranges: Sequence[Range], traces: Sequence[Trace], sources: Sequence[Source], fitted: int,
                 signals: Sequence[str] | None) -> IdentificationRuns:
    """The runs made ready for replay: the first `fitted` to fit, the others held out.

    Raises:
        InputError: a trace that cannot be used, or a run given twice.
    """
    if not fitted:
        raise InputError("RUN", "", "at least one run to fit")
    _require_distinct(sources, fitted)
    for name in signals or ():
        if name not in OUTPUTS:
            raise InputError("--signals", name, f"some of {','.join(OUTPUTS)}")
    shared = [s for s in OUTPUTS if all(s in t.signals for t in traces[:fitted]) and (signals is None or s in signals)]
    if not shared:
        raise InputError(sources[0].file, ", ".join(signals or OUTPUTS), "a signal that every run to fit has")
    widest = _widen_model(model, ranges)
    prepared = [_prepare(t, widest, [s for s in shared if s in t.signals] or shared, source)
                for t, source in zip(traces, sources, strict=True)]
    model = match_period(model, prepared[0], SAME_PERIOD)
    period = model["controller.period"]
    for trace, source in zip(prepared, sources, strict=True):
        if abs(trace.period / period - 1.0) > SAME_PERIOD:
            raise InputError(source.file, "t", f"rows {period:g} s apart, as in {sources[0].file}")
    return IdentificationRuns(model, tuple(prepared[:fitted]), tuple(prepared[fitted:]), tuple(sources))


def _require_distinct(sources: Sequence[Source], fitted: int) -> None:
    seen: dict[str, str] = {}
    for number, (file, content) in enumerate(sources):
        if content in seen:
            place, expected = ("--holdout", "a run that no fit has seen") if number >= fitted else ("RUN", "other runs")
            raise InputError(place, file, f"{expected}; this is {seen[content]} itself")
        seen[content] = file


def _prepare(trace: Trace, model: Model, outputs: Sequence[str], source: Source) -> Trace:
    if model.plant != "eha":
        return hold_inputs(trace, outputs, source.file)
    try:
        return prepare_trace(trace, model, outputs, source.file)
    except InputError as error:
        if "a signal that changes" in error.expected and _is_still(trace):  # a run at rest says little, but is one
            return hold_inputs(trace, outputs, source.file)
        raise


def _is_still(trace: Trace) -> bool:
    return bool(trace.com.max() == trace.com.min())


def _widen_model(model: Model, ranges: Sequence[Range]) -> Model:
    """The model with the largest travel, pressure and current that are possible, by which recordings are checked."""
    limits = ("jack.travel", "spool.travel", "supply.pressure", "controller.current_limit")
    return replace(model, values={**model.values, **{r.name: r.high for r in ranges if r.name in limits}})
