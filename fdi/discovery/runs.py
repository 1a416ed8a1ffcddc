"""Measured runs made ready for a search: one to explain, repeats of its command, and one that no fit sees."""
from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi.comparison.compare import best_reading
from fdi.estimation.repeats import Repeat, matching
from fdi.trace.cycles import Cycles
from fdi.trace.record import SIGNALS, Record, record
from fdi.trace.trace import Trace
from plant.errors import InputError
from plant.model import Model


class Source(NamedTuple):
    """Where a run came from, and what tells it from any other."""

    file: str
    sha256: str


class Runs(NamedTuple):
    """What a search or a fit works on."""

    model: Model  # at the cycle of the traces
    est: Record
    repeats: tuple[Record, ...]
    holdout: Record | None
    sources: tuple[Source, ...]  # of the run, its repeats, and the held-out one if there is one
    notes: tuple[str, ...]  # what reading had to leave out or put right


def read(model: Model, trace: str, repeats: Sequence[str] = (), holdout: str | None = None,
         signals: Sequence[str] | None = None) -> Runs:
    """Read the files of a search.

    Raises:
        InputError: a file that cannot be used, a repeat that is none, or a run given twice, in one line.
    """
    chosen = _chosen(signals)
    sources = [source(trace), *(source(file) for file in repeats), *([source(holdout)] if holdout else [])]
    _distinct(sources, len(repeats))
    first = Trace.read(trace)
    model, est, c = usable(first, model, chosen, trace)
    others = tuple(_repeat(c, est, Trace.read(file), model, file, n) for n, file in enumerate(repeats, 1))
    held = None
    if holdout:
        other = Trace.read(holdout)
        there = [s for s in est.signals if s in other.signals]
        held_model, held, _ = usable(other, model, there or est.signals, holdout)
        if held_model["controller.period"] != model["controller.period"]:
            raise InputError(holdout, "t", f"rows {model['controller.period']:g} s apart, as in {trace}")
    return Runs(model, est, others, held, tuple(sources), c.notes if c else first.notes)


def source(file: str) -> Source:
    """The file of a trace, or that of the run in a folder, with the hash of its bytes."""
    path = Path(file)
    data = path / "trace.mcap" if path.is_dir() else path
    try:
        return Source(file, hashlib.sha256(data.read_bytes()).hexdigest())
    except OSError as error:
        raise InputError(file, "", f"a trace that can be read ({error.strerror})") from error


def _chosen(signals: Sequence[str] | None) -> tuple[str, ...] | None:
    for name in signals or ():
        if name not in SIGNALS:
            raise InputError("--signals", name, f"some of {','.join(SIGNALS)}")
    return tuple(s for s in SIGNALS if s in signals) if signals is not None else None


def _distinct(sources: Sequence[Source], repeats: int) -> None:
    """Refuse a run that stands in for itself: it would prove whatever is asked of it."""
    seen: dict[str, str] = {}
    for number, (file, content) in enumerate(sources):
        if content in seen and 0 < number <= repeats:
            raise InputError("--repeat", file, f"the same command run again; this is {seen[content]} itself")
        if content in seen:
            raise InputError("--holdout", file, f"a run that no fit has seen; this is {seen[content]} itself")
        seen[content] = file


def usable(trace: Trace, model: Model, signals: Sequence[str] | None, where: str
            ) -> tuple[Model, Record, Cycles | None]:
    """A trace as a fit needs it: the model at its cycle, the run, and its checked rows (None for another plant).

    Raises:
        InputError: what cannot be replayed, in one line.
    """
    if model.plant != "eha":  # ranges and rates are checked against the reference model's own
        own = record(trace, tuple(signals) if signals else None, where)
        return at_period(model, trace.period), _known_start(own), None
    c, _ = best_reading(trace, model, signals, where)
    same = len(c) == len(trace) and c.period == trace.period
    rows = trace if same else Trace.of({name: getattr(c, name) for name in ("t", "com", "cor", "load", *SIGNALS)},
                                       c.period, trace.provenance)
    return at_period(model, c.period), _record(c, rows), c


def at_period(model: Model, period: float) -> Model:
    """The model at the cycle of a trace, s."""
    same = abs(model["controller.period"] / period - 1.0) < 0.01
    return model if same else model.replace({"controller.period": period})


def _record(c: Cycles, rows: Trace) -> Record:
    measured = np.array([c.measured(s) for s in c.signals])
    return _known_start(Record(rows, c.signals, c.cor, c.load, c.com, c.xj, measured))


def _known_start(r: Record) -> Record:
    """A replay starts where the first sample shows the ram; where that is missing, at the next one."""
    if not np.isnan(r.position[0]):
        return r
    position = r.position.copy()
    position[0] = position[~np.isnan(position)][0]
    return replace(r, position=position)


def _repeat(c: Cycles | None, est: Record, trace: Trace, model: Model, where: str, number: int) -> Record:
    """A repeat on the rows of the run, with its signals."""
    missing = [s for s in est.signals if s not in trace.signals]
    if missing:
        raise InputError(where, missing[0], f"the signals of the run it repeats ({', '.join(est.signals)})")
    if c is None:
        return _known_start(record(trace, est.signals, where))
    found = matching(c, trace, model, number)
    if found.late == 0 and len(found.cycles) == len(trace):
        return _record(found.cycles, trace)
    moved = _in_place(found, len(est))
    columns = {name: getattr(moved, name) for name in ("com", "load")}
    columns |= {name: np.where(moved.usable, getattr(moved, name), np.nan) for name in ("cor", *SIGNALS)}
    return _record(moved, Trace.of(columns, moved.period, trace.provenance))


def _in_place(r: Repeat, rows: int) -> Cycles:
    """A repeat on the rows of the run; before its first row the ram rests as there, and nothing was measured."""
    at = np.arange(rows) - r.late
    place = np.clip(at, 0, len(r.cycles) - 1)
    columns = {name: getattr(r.cycles, name)[place] for name in ("t", "com", "cor", "load", *SIGNALS)}
    return replace(r.cycles, **columns, usable=(at == place) & r.cycles.usable[place])
