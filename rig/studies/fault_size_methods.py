"""Other ways to the fault sizes, one table: what each finds of a trace, its error, its simulations, its time."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

from fdi.diagnosis.diagnosis import Diagnosis
from fdi.progress import Progress
from fdi.report.numbers import NO_NUMBER, format_digits
from fdi.report.report import Column, Section, Table
from plant.errors import InputError
from rig.network.clock import WallClock


class Row(NamedTuple):
    """One method; None where it does not tell."""

    method: str
    kintas: float | None
    fss: float | None  # N
    left: float | None  # RMS of what is left of the signals, in floors
    error_kintas: float | None  # RMS on simulated units that training did not see
    error_fss: float | None  # N
    right: dict[str, float] | None  # share of right levels on these, by fault
    levels: dict[str, str] | None
    simulations: int
    seconds: float


def optimisers(d: Diagnosis, seed: int, progress: Progress) -> Iterator[Row]:
    """Least squares and the global optimisers, each from the grid's answer."""
    from fdi.diagnosis import optimisers as ways

    trace, model = d.trace, d.model
    start = (d.grid.merged.kintas, d.grid.merged.fss) if d.grid else (0.1, 15.0)
    for number, (name, method) in enumerate(ways.METHODS.items()):
        progress(name, number / len(ways.METHODS))
        if not ways.is_available(name):
            continue
        found, seconds = timed(partial(method, model, trace, start, d.floor, seed))
        yield Row(found.method, found.kintas, found.fss, found.left, None, None, None, None, found.simulations, seconds)


def comparators(d: Diagnosis, seed: int, progress: Progress) -> Iterator[Row]:
    """The learners; the time of each holds that of simulating what both learn from.

    Raises:
        InputError: scikit-learn is not installed, or the trace shows no precursors.
    """
    from fdi.diagnosis import comparators as learners

    if not learners.is_available():
        raise InputError("--comparators", "scikit-learn", "installed: pip install 'eha-rig[learn]'")
    data, before = timed(lambda: learners.simulate_lesson(d.trace, d.model, seed, progress))
    for name, learner in learners.LEARNERS.items():
        progress(name, 1.0)
        found, seconds = timed(partial(learner, data, seed))
        yield Row(found.method, _known(found.kintas), _known(found.fss), None, _known(found.error_kintas),
                  _known(found.error_fss), found.right, {fault: level.word for fault, level in found.levels.items()},
                  found.simulations, before + seconds)


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What some work gives, and how long it took, s."""
    clock = WallClock()
    start = clock.now()
    return work(), 1e-9 * (clock.now() - start)


def _known(x: float) -> float | None:
    return x if x == x else None


def build_methods_section(rows: Sequence[Row]) -> Section:
    """A table of the methods: what each finds, what it leaves, its errors on known units, and what it costs."""
    titles = (("Kintas", ""), ("FSS", "N"), ("residual", "floors"), ("Kintas error", ""), ("FSS error", "N"),
              ("levels right", ""), ("simulations", ""), ("time", "s"))
    columns = [Column("method"), *(Column(title, unit, "right") for title, unit in titles)]
    cells = []
    for row in rows:
        sizes = [_format_known(row.kintas), _format_known(row.fss)]
        if row.kintas is None and row.levels:
            sizes = list(row.levels.values())
        shares = " ".join(f"{100 * share:.0f}%" for share in row.right.values()) if row.right else NO_NUMBER
        cells.append([row.method, *sizes, _format_known(row.left), _format_known(row.error_kintas),
                      _format_known(row.error_fss), shares, str(row.simulations), f"{row.seconds:.1f}"])
    return Section("Other methods", [Table(
        columns, cells, "Residual: RMS in units of the noise floor. Errors (RMS) and share of right levels (clogging, "
                        "friction): on simulated units that no training used.")])


def _format_known(x: float | None) -> str:
    return NO_NUMBER if x is None else format_digits(x)
