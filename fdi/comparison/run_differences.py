"""Two or more runs side by side: their signals subtracted row by row, their checks matched.

The first run is the reference. Rows are aligned by the command: equal commands belong to one cycle. Where the commands
differ nothing is subtracted. A difference is held against the noise of both runs, which each run's own second
differences show (a lower bound: noise that is not white has less in them).
"""
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi.estimation import floor_from_data
from fdi.thresholds import NOISE_BAND_RATIO, RUN_DIFFERENCE_RATIO
from fdi.trace import CheckResult, Flags, Floats, Trace, rms
from plant import Signal, count_nouns, require

SAME_COMMAND = 1.5e-7  # m, times `Trace.scale`; the bus carries steps of 1e-7 m
MOST_UNCOVERED = 2.0  # rows of the slower run, by which runs of one length may differ


class Run(NamedTuple):
    """A run of a comparison: its letter, the text the user gave, and its trace."""

    label: str  # A, B, ..
    source: str
    trace: Trace


@dataclass(frozen=True)
class SignalDifference:
    """How one signal differs from that of the reference, SI.

    `noise` is the noise floor of the reference and of the other run.
    """

    signal: Signal
    rms: float
    largest: float  # with its sign: other run minus reference
    t: float  # s, time of the reference at which the difference is largest
    noise: tuple[float, float]
    samples: int
    calm_share: float  # of the samples, those within two noise floors of both runs
    is_equal: bool  # to the last digit

    @property
    def name(self) -> str:
        """Of its column."""
        return self.signal.name

    @property
    def ratio(self) -> float:
        """RMS difference over what the noise of both runs leaves; 1 for two runs that differ only by noise."""
        if (noise := math.hypot(*self.noise)) > 0.0:
            return self.rms / noise
        return 0.0 if self.rms == 0.0 else float("inf")

    @property
    def is_within_noise(self) -> bool:
        """Whether noise explains the difference."""
        return self.is_equal or self.ratio <= RUN_DIFFERENCE_RATIO


@dataclass(frozen=True, eq=False)
class RunPair:
    """A run against the reference. `t` and each column of `differences` have shape (n,): rows that both runs have.

    The differences are NaN where a sample is missing or the commands differ. `uncovered` is 0 up to two rows.
    """

    run: Run
    signals: tuple[SignalDifference, ...]
    has_same_command: bool
    common: float  # s, duration over which the commands agree
    overlap: float  # s, duration that both runs cover
    uncovered: float  # s, duration of the longer run that the other does not cover
    offset: float  # s, time of the reference minus time of this run, for the same cycle
    t: Floats  # s, of the reference
    differences: dict[str, Floats]
    not_compared: dict[str, str]  # signal: reason
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RunDifferences:
    """Several runs against the first of them."""

    runs: tuple[Run, ...]
    pairs: tuple[RunPair, ...]
    checks: tuple[MatchedCheck, ...]

    @property
    def verdict(self) -> str:
        """SAME if noise explains all differences of runs of one length and no check changed; otherwise DIFFERENT."""
        is_same = all(pair.has_same_command and not pair.uncovered and pair.signals
                      and all(s.is_within_noise for s in pair.signals) for pair in self.pairs)
        return "SAME" if is_same and not any(check.is_changed for check in self.checks) else "DIFFERENT"


def compare_runs(sources: Sequence[str], traces: Sequence[Trace]) -> RunDifferences:
    """Compare runs with the first one.

    Args:
        sources: name of each trace, for people.
        traces: two or more, with all phases or only their main phase.

    Raises:
        InputError: runs of plants with other signals.
    """
    names = traces[0].declared.names
    for source, trace in zip(sources, traces, strict=True):
        require(trace.declared.names == names, source, "",
                f"a run with the signals of {sources[0]}: {', '.join(names)}")
    runs = tuple(Run(_make_label(i), source, trace)
                 for i, (source, trace) in enumerate(zip(sources, traces, strict=True)))
    pairs = tuple(_subtract(runs[0], other) for other in runs[1:])
    return RunDifferences(runs, pairs, tuple(match_checks([run.trace.checks for run in runs])))


def _make_label(number: int) -> str:
    """A to Z, then A1, B1 ..

    >>> _make_label(1), _make_label(27)
    ('B', 'B1')
    """
    return chr(ord("A") + number % 26) + (str(number // 26) if number >= 26 else "")


class _Rows(NamedTuple):
    """The rows that two runs share: times of the reference, shape (n,), and where each run is sampled."""

    t: Floats
    offset: float
    reference: Trace
    other: Trace

    def sample(self, name: str) -> tuple[Floats, Floats]:
        """A signal of both runs at these rows."""
        return (sample_column(self.reference, name, self.t), sample_column(self.other, name, self.t - self.offset))


def sample_column(trace: Trace, name: str, t: Floats) -> Floats:
    """A column of a trace at times within it: its rows where they meet the times, else straight lines between rows."""
    rows = (t - trace.t[0]) / trace.period
    nearest: Floats = np.rint(rows)
    values = trace.column(name)
    if not len(t) or float(np.abs(rows - nearest).max()) < 0.01:
        return np.asarray(values[np.clip(nearest.astype(int), 0, len(values) - 1)])
    return np.asarray(np.interp(rows, np.arange(len(values)), values))


def _subtract(reference: Run, other: Run) -> RunPair:
    a, b = reference.trace, other.trace
    offset = find_offset(a, b)
    rows = _share_rows(a, b, offset)
    agrees = _find_common_rows(rows)
    period = max(a.period, b.period)
    overlap, common = len(rows.t) * period, float(agrees.sum()) * period
    uncovered = max(len(a) * a.period, len(b) * b.period) - overlap
    uncovered = uncovered if uncovered > MOST_UNCOVERED * period else 0.0
    is_known = ~np.isnan(np.add(*rows.sample(a.declared.command.name)))
    is_same = bool(is_known.any() and agrees[is_known].mean() > 0.995)  # edges of interpolated steps aside
    differences, signals, not_compared = {}, [], {}
    d = a.declared
    for name in (*a.output_names, d.drive.name, *([d.load.name] if d.load else [])):
        reason = _find_obstacle(name, reference, other)
        if reason:
            not_compared[name] = reason
        if reason or name not in a.signals:
            continue
        first, second = rows.sample(name)
        if not np.nan_to_num(first).any() and not np.nan_to_num(second).any():
            continue  # no load in either run
        difference = np.where(agrees, second - first, np.nan)
        if not (~np.isnan(difference)).any():
            not_compared[name] = "no row with equal commands in which both runs have it"
            continue
        differences[name] = difference
        signal = d.find(name)._replace(unit=a.units[name])
        signals.append(_measure_difference(signal, rows.t, difference, (first, second)))
    return RunPair(other, tuple(signals), is_same, common, overlap, uncovered, offset, rows.t, differences,
                   not_compared, tuple(_list_notes(reference, other, offset, agrees[is_known], is_same)))


def _find_obstacle(name: str, reference: Run, other: Run) -> str:
    """Why a signal cannot be compared; "" if it can, or if no run has it."""
    runs = [run for run in (reference, other) if name in run.trace.signals]
    if len(runs) == 1:
        return f"only {runs[0].label} has it"
    a, b = (run.trace.units.get(name, "") for run in (reference, other))
    return f"in {a} in {reference.label}, in {b} in {other.label}" if runs and a != b else ""


def _measure_difference(signal: Signal, t: Floats, difference: Floats,
                        columns: tuple[Floats, Floats]) -> SignalDifference:
    rows = np.flatnonzero(~np.isnan(difference))
    row = int(rows[np.argmax(np.abs(difference[rows]))])
    noise = [max(float(floor_from_data(column).value), signal.finest) for column in columns]
    calm = np.abs(difference[rows]) <= NOISE_BAND_RATIO * math.hypot(*noise)
    return SignalDifference(signal, rms(difference), float(difference[row]), float(t[row]), (noise[0], noise[1]),
                            len(rows), float(calm.mean()), not difference[rows].any())


def find_offset(a: Trace, b: Trace) -> float:
    """Time of `a` minus time of `b`, s, at which their commands agree in most rows.

    Tried are equal times, equal first rows, and the offset at which the changes of the commands correlate best.
    """
    best, most = 0.0, -1
    for offset in _propose_offsets(a, b):
        count = int(_find_common_rows(_share_rows(a, b, offset)).sum())
        if count > 1.002 * most:  # the first of equals: the later ones are less natural
            best, most = offset, count
        if count > 0.998 * min(len(a) * a.period, len(b) * b.period) / max(a.period, b.period):
            break
    return best


def _propose_offsets(a: Trace, b: Trace) -> Iterator[float]:
    yield 0.0
    yield float(a.t[0] - b.t[0])
    period = max(a.period, b.period)
    first, second = (_sample_rates(trace, period) for trace in (a, b))
    if first.any() and second.any():
        yield float(a.t[0] - b.t[0]) + _correlate(first, second) * period


def _sample_rates(trace: Trace, period: float) -> Floats:
    """Changes of the command from row to row, one row per `period`."""
    t = np.arange(trace.t[0], trace.t[-1] + 0.5 * trace.period, period)
    return np.nan_to_num(np.diff(sample_column(trace, trace.declared.command.name, t), prepend=np.nan))


def _correlate(first: Floats, second: Floats) -> int:
    """Rows by which `second` has to be moved to fit `first` best."""
    size = 1 << (len(first) + len(second)).bit_length()
    product = np.fft.rfft(np.sign(first), size) * np.conj(np.fft.rfft(np.sign(second), size))
    lag = int(np.argmax(np.fft.irfft(product, size)))
    return lag if lag < size // 2 else lag - size


def _share_rows(a: Trace, b: Trace, offset: float) -> _Rows:
    """The rows of the slower run, on the reference's time, that lie within both runs."""
    slower = a.t if a.period >= b.period else b.t + offset
    small = 1e-6 * a.period
    low = max(a.t[0], b.t[0] + offset) - small
    high = min(a.t[-1], b.t[-1] + offset) + small
    return _Rows(slower[(slower >= low) & (slower <= high)], offset, a, b)


def _find_common_rows(rows: _Rows) -> Flags:
    """The rows in which both commands are known and equal."""
    first, second = rows.sample(rows.reference.declared.command.name)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(first - second) <= SAME_COMMAND * rows.reference.scale)


def _list_notes(reference: Run, other: Run, offset: float, agrees: Flags, is_same: bool) -> Iterator[str]:
    """What a reader must know before trusting the differences."""
    a, b = reference.trace, other.trace
    where = f"{other.label} against {reference.label}"
    if not is_same:
        share = 100.0 * float(agrees.mean()) if len(agrees) else 0.0
        yield (f"{where}: the commands differ; they agree in {share:.3g} % of the {len(agrees)} rows that both runs "
               "cover, and only these are compared. What came before still acts in them")
    if abs(offset) > 0.5 * min(a.period, b.period):
        yield f"{where}: aligned by the command; t = {offset:.6g} s of {reference.label} is t = 0 of {other.label}"
    if abs(a.period / b.period - 1.0) > 1e-6:
        yield (f"{where}: rows every {1e3 * a.period:g} ms and {1e3 * b.period:g} ms; compared in the rows of the "
               "slower run, with straight lines between the rows of the faster one")
    yield from (f"{run.label}: {count_nouns(sum(gap.cycles for gap in run.trace.gaps), 'cycle')} missing"
                for run in (reference, other) if run.trace.gaps)


@dataclass(frozen=True)
class MatchedCheck:
    """One check in several runs.

    `results` has an entry for each run, None where the run does not have the check. `is_changed`: the runs that have
    checks at all do not agree about the verdict, or only some of them have this check.
    """

    name: str
    results: tuple[CheckResult | None, ...]
    is_changed: bool

    @property
    def first(self) -> CheckResult:
        """The result of the first run that has the check."""
        return next(check for check in self.results if check is not None)

    @property
    def has_other_limits(self) -> bool:
        """Whether the runs that have the check judged it by different limits, or in different units."""
        checks = [check for check in self.results if check is not None]
        return any((check.unit, check.kind) != (checks[0].unit, checks[0].kind)
                   or not np.array_equal([check.low, check.high], [checks[0].low, checks[0].high], equal_nan=True)
                   for check in checks)


def match_checks(checks_of_runs: Sequence[Sequence[CheckResult]]) -> list[MatchedCheck]:
    """The checks of each run, matched by name, in the order in which they first appear.

    Checks of one name in one run are told apart by their order.
    """
    tables = [_number_checks(checks) for checks in checks_of_runs]
    keys = dict.fromkeys(key for table in tables for key in table)
    return [MatchedCheck(key[0], tuple(table.get(key) for table in tables),
                         len({table[key].verdict if key in table else None
                              for table in tables if table}) > 1) for key in keys]


def _number_checks(checks: Sequence[CheckResult]) -> dict[tuple[str, int], CheckResult]:
    """The checks by their name and how many of that name come before them."""
    names = [check.name for check in checks]
    return {(check.name, names[:i].count(check.name)): check for i, check in enumerate(checks)}
