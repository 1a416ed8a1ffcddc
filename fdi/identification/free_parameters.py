"""Which parameters an identification fits, and how widely: the table [identify] of a model file.

A parameter there has a factor, within which the data sheet's value may be wrong either way, or a range in SI units:

    [identify.jack]
    area = 4                  # between a quarter of the model's value and four times it
    leakage = [1e-14, 1e-10]  # m3/s/Pa

A parameter that is not there keeps the model's value, within the tolerance by which healthy units differ.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi.discovery.runs import Source, hash_columns, read_source
from fdi.estimation.likelihood import Free
from fdi.estimation.replay import SAME_PERIOD, hold_inputs, match_period, prepare_trace
from fdi.estimation.unidentifiable import LogFree, LogFrictionRatio, take_logarithm
from fdi.estimation.unknowns import list_tolerance_unknowns
from fdi.thresholds import IDENTIFIED_SYSTEMATIC_SD, PILOT_FLOW_SYSTEMATIC_SD, STATIC_FRICTION_SYSTEMATIC_SD
from fdi.trace.signals import OUTPUTS
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model, find_quantity, find_shipped_model
from plant.parameters import read_toml

FRICTIONS = (("jack.static_friction", "jack.dynamic_friction"), ("spool.static_friction", "spool.dynamic_friction"))
SYSTEMATIC_SD = {"jack.static_friction": STATIC_FRICTION_SYSTEMATIC_SD, "pilot.flow_gain": PILOT_FLOW_SYSTEMATIC_SD}


class Range(NamedTuple):
    """How widely a parameter is free: the data sheet's value and the bounds of the fit, SI."""

    name: str
    centre: float
    low: float
    high: float
    unit: str

    @property
    def is_relative(self) -> bool:
        """Whether the fit works on the logarithm: the parameter cannot be zero or negative."""
        return self.low > 0.0

    @property
    def half_width(self) -> float:
        """Half the range: of the logarithm if the range is relative, else SI."""
        return 0.5 * (math.log(self.high / self.low) if self.is_relative else self.high - self.low)


def read_free_parameters(model: Model, source: str | Path | None) -> tuple[Range, ...]:
    """The free parameters of a model: those of its file, or those of the nominal model where that lists none.

    Args:
        model: with the values of the data sheet.
        source: the model's file; None for the nominal model.

    Raises:
        InputError: a table [identify] with an unknown parameter, or with a factor or range that cannot be; or no such
            table for a plant that the nominal model is not of.
    """
    path = find_shipped_model(str(source)) or Path(str(source))
    named = read_toml(path).get("identify") if source is not None and path.is_file() else None
    if named is None and model.plant != "eha":
        raise InputError(source, "identify", "tables [identify.GROUP] that say what is free (docs/identify.md)")
    usual = Path(str(files("plant").joinpath("models", "nominal.toml")))
    return parse_free_parameters(read_toml(usual)["identify"] if named is None else named, model,
                                 source if named is not None else usual.name)


def parse_free_parameters(tables: object, model: Model, where: object) -> tuple[Range, ...]:
    """The ranges that the tables of [identify] describe, in the model's order.

    Raises:
        InputError: an unknown parameter, or a factor or range that cannot be.
    """
    if not isinstance(tables, Mapping):
        raise InputError(where, "identify", "a table [identify.GROUP] of factors and ranges")
    found = {}
    for group, fields in tables.items():
        if not isinstance(fields, Mapping):
            raise InputError(where, f"identify.{group}", "a table of factors and ranges, such as area = 4")
        for field, width in fields.items():
            name = f"{group}.{field}"
            find_quantity(name, where, model.plant)
            if name not in model.values:
                raise InputError(where, f"identify.{name}", f"a parameter that the model has; add {group} to its "
                                                            "effects")
            found[name] = _parse_range(name, width, model, where)
    if not found:
        raise InputError(where, "identify", "at least one free parameter")
    return tuple(found[name] for name in model.list_names() if name in found)


def _parse_range(name: str, width: Any, model: Model, where: object) -> Range:
    q, value = find_quantity(name, where, model.plant), model[name]
    possible_low, possible_high = max(q.low, q.above), min(q.high, q.below)
    field = f"identify.{name}"
    if _is_number(width):
        if not width > 1.0 or math.isinf(width):
            raise InputError(where, field, f"a factor above 1, not {width:g}")
        if value <= 0.0:
            raise InputError(where, field, f"a range [low, high]: a factor says nothing of {value:g}")
        low, high = max(value / width, possible_low), min(value * width, possible_high)
    elif isinstance(width, list) and len(width) == 2 and all(map(_is_number, width)) and width[0] < width[1]:
        low, high = map(float, width)
        if low < possible_low or high > possible_high:
            raise InputError(where, field, f"a range within {possible_low:g} .. {possible_high:g} {q.unit}")
    else:
        raise InputError(where, field, f"a factor above 1, or a range [low, high] in {q.unit}, not {width!r}")
    middle = math.sqrt(low * high) if low > 0.0 else 0.5 * (low + high)
    return Range(name, value if low <= value <= high else middle, low, high, q.unit)


def _is_number(x: object) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool)


def get_systematic_sd(name: str) -> float:
    """The relative standard deviation that solver and stick-slip add to a parameter beside that of the fit."""
    return SYSTEMATIC_SD.get(name, IDENTIFIED_SYSTEMATIC_SD)


def list_unknowns(model: Model, ranges: tuple[Range, ...]) -> tuple[Free, ...]:
    """What the fit may change: the free parameters, and the tolerances of the others."""
    free = {r.name: _make_free(r) for r in ranges}
    free |= {f.name: take_logarithm(f) for f in list_tolerance_unknowns(model) if f.name not in free}
    for static, dynamic in FRICTIONS:
        if static in free and isinstance(free.get(dynamic), LogFree):
            del free[static]  # to come after the dynamic one
            free[static] = _make_friction_ratio(model, static, dynamic, static in {r.name for r in ranges})
    return tuple(free.values())


def _make_friction_ratio(model: Model, static: str, dynamic: str, is_free: bool) -> LogFrictionRatio:
    """Static over dynamic friction, at least 1.

    As two separate unknowns the dynamic friction could go above the static one, where no signal depends on it any more:
    a fit that got there would stay.
    """
    usual = math.log(max(model[static] / model[dynamic], 1.0))
    spread, highest = (0.5, math.log(20.0)) if is_free else (0.03, usual + 1.0)
    return LogFrictionRatio(static, usual, spread, 1.0, 0.0, max(highest, usual), 0.3)


def _make_free(r: Range) -> Free:
    """The parameter, known beforehand to lie within half its range of the data sheet's value."""
    if r.is_relative:
        return LogFree(r.name, math.log(r.centre), r.half_width, 1.0, math.log(r.low), math.log(r.high), 0.02)
    return Free(r.name, r.centre, r.half_width, 1.0, r.low, r.high, 0.02)


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
    limits = ("jack.travel", "spool.travel", "supply.pressure", "controller.current_limit")
    widest = replace(model, values={**model.values, **{r.name: r.high for r in ranges if r.name in limits}})
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
        if "a signal that changes" in error.expected and np.ptp(trace.com) == 0.0:  # at rest: says little, but is a run
            return hold_inputs(trace, outputs, source.file)
        raise
