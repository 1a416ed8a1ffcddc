"""Other methods for the fault sizes of a trace: what each one finds, its error, its simulations and its time."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

from fdi.diagnosis.diagnosis import Diagnosis
from fdi.progress import Progress
from fdi.report.json import to_plain
from fdi.report.numbers import NO_NUMBER, format_digits
from fdi.report.report import Column, Section, Table
from plant.errors import InputError
from rig.network.clock import WallClock


class Row(NamedTuple):
    """The result of one method; None for what the method does not give."""

    method: str
    kintas: float | None
    fss: float | None  # N
    left: float | None  # RMS of the residual, in noise floors
    error_kintas: float | None  # RMS on simulated units that were not used for training
    error_fss: float | None  # N
    right: dict[str, float] | None  # share of right levels on these units, by fault
    levels: dict[str, str] | None
    simulations: int
    seconds: float


def apply_optimisers(diagnosis: Diagnosis, seed: int, progress: Progress) -> Iterator[Row]:
    """Least squares and the global optimisers, each started from the sizes of the RMS grid."""
    from fdi.diagnosis import optimisers

    grid = diagnosis.grid
    start = (grid.merged.kintas, grid.merged.fss) if grid else (0.1, 15.0)
    for number, (name, method) in enumerate(optimisers.METHODS.items()):
        progress(name, number / len(optimisers.METHODS))
        if optimisers.is_available(name):
            found, seconds = measure_time(
                partial(method, diagnosis.model, diagnosis.trace, start, diagnosis.floor, seed))
            yield Row(found.method, found.kintas, found.fss, found.left, error_kintas=None, error_fss=None, right=None,
                      levels=None, simulations=found.simulations, seconds=seconds)


def apply_learners(diagnosis: Diagnosis, seed: int, progress: Progress) -> Iterator[Row]:
    """The learners; the time of each one includes the simulation of the units that both learn from.

    Raises:
        InputError: scikit-learn is not installed, or the trace shows no precursors.
    """
    from fdi.diagnosis import comparators

    if not comparators.is_available():
        raise InputError("--comparators", "scikit-learn", "installed: pip install 'eha-rig[learn]'")
    simulate = partial(comparators.simulate_lesson, diagnosis.trace, diagnosis.model, seed, progress)
    lesson, simulation_seconds = measure_time(simulate)
    for name, learner in comparators.LEARNERS.items():
        progress(name, 1.0)
        found, seconds = measure_time(partial(learner, lesson, seed))
        yield Row(found.method, to_plain(found.kintas), to_plain(found.fss), left=None,
                  error_kintas=to_plain(found.error_kintas), error_fss=to_plain(found.error_fss),
                  right=found.right, levels={fault: level.word for fault, level in found.levels.items()},
                  simulations=found.simulations, seconds=simulation_seconds + seconds)


def measure_time(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result of `work`, and the time it took, s."""
    clock = WallClock()
    start = clock.now()
    return work(), 1e-9 * (clock.now() - start)


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
