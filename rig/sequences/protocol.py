"""Protocol checks: what every controller must do on the bus, judged in every run whatever the sequence.

They need the rows of the run and of the probes (rig/run/bring_up.py), heartbeat and EMCY times. Pure functions: no bus,
no clock. docs/sequences.md lists the checks and their default limits.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, isnan, nan
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi.trace import PROTOCOL, CheckResult
from plant import Array, Loop, Quantity, Second, Signal, compute_current
from rig.benches import (
    CIA402,
    CIA408,
    PROFILES,
    Bench,
    Flags,
    ProfileWords,
    Role,
    State,
    find_state,
    find_wanted,
    list_reachable,
    list_transitions,
    load_bench,
    name_object,
)
from rig.sequences.checks import SkippedCheck, map_words

Mask = NDArray[np.bool_]
Whole = NDArray[np.int64]
NO_FRAME = "no drive frame came"
HEARTBEAT = "heartbeat"  # the signal of those about heartbeats
_LEVELS, _READY = CIA408.ladder[-1], 0x8  # of control and status word of CiA 408
LONGEST_STEP_DELAY = 0.1  # s: the probe's step lasts as long
UpToOneSecond = Annotated[float, Quantity("s", above=0.0, high=1.0)]
_BEFORE_EMCY = 20  # cycles: a fault may show in the status word before its EMCY has been read


@dataclass(frozen=True, kw_only=True)
class ProtocolLimits:
    """Limits of the protocol checks: the table `protocol` of a sequence.

    status: time in which status word and zero current follow the control word (default: 2 ms; 400 ms of CiA 402, 10 ms
    without a control word; two cycles at least). idle_current: largest current that counts as none, such as the noise
    of a drive that sends what it measures. missing: share of the cycles whose drive frame may be missing, late or of
    another cycle (default: none in lockstep, 0.001 in real time). response_*: from SYNC to the drive frame, in real
    time (default: 0.5, 0.9 and 1 of the cycle). heartbeat: tolerance of the median heartbeat period. gain: tolerance of
    the loop's gain, 1. step_delay: from a demand step to the first answer that follows it; above 0 for a controller
    with a filter in its loop. emcy: codes of the controller allowed beyond the documented ones. probe: whether to
    run the probes.
    """

    status: UpToOneSecond | None = None
    idle_current: Annotated[float, Quantity("A", low=0.0)] = 0.0
    missing: Annotated[float, Quantity("1", low=0.0, high=1.0)] | None = None
    response_p50: UpToOneSecond | None = None
    response_p99: UpToOneSecond | None = None
    response_max: UpToOneSecond | None = None
    heartbeat: UpToOneSecond = 0.01
    gain: Annotated[float, Quantity("1", above=0.0, below=1.0)] = 0.1
    step_delay: Annotated[float, Quantity("s", low=0.0, high=LONGEST_STEP_DELAY)] = 0.0
    emcy: tuple[Annotated[int, Quantity("1", low=1, high=0xFFFF)], ...] = ()
    probe: bool = True

    def find_delay(self, words: ProfileWords, rate: float) -> float:
        """The limit `status` for a profile, s, at `rate` cycles a second."""
        return max(words.delay, 2 / rate) if self.status is None else self.status

    def find_step_delay(self, bench: Bench) -> float:
        """The limit `step_delay` on a bench, s.

        What comes in every n-th cycle adds n - 1 of them, and a drive frame without the number of the cycle that it
        answers adds one: it may answer the cycle before.
        """
        demand, drive = bench.frames.find_role("command"), bench.frames.drive
        cycles = demand.every + drive.every - 2 + (not drive.has("cycle"))
        return self.step_delay + cycles / bench.rate


class Rows(NamedTuple):
    """Consecutive cycles as columns, SI: demand, controlled signal, drive; NaN: no frame with this cycle's number.

    `on_time`: the bench delivered the cycle and the next one on time and no injected fault touches its frames, so a
    missing drive frame is the controller's.
    """

    demand: Array
    position: Array
    drive: Array
    control: Array
    status: Array
    flags: Array
    response: Array
    on_time: Mask


class Heartbeat(NamedTuple):
    """A heartbeat that the rig took in at `t`, s; it may have waited for that as long as `waited`, s."""

    t: float
    waited: float = 0.0


class Emergency(NamedTuple):
    """An EMCY frame; `cycle` is the row of the run, negative before the first."""

    cycle: int
    node: Role
    code: int


@dataclass(frozen=True, kw_only=True)
class ProtocolRecord:
    """All that the protocol checks are judged by.

    `run`: its rows, then those of the probe after clean-up. `enabling`: cycles beside the run in which the
    controller was enabled, and the cycle before which that was. `gains`: those that objects of the controller hold,
    if it has them and follows them. `is_response_judged`: real time, and the controller is not in the rig's own
    process. `heartbeats`: of the nodes that send one, by name; `heard`: first and last time at which heartbeats
    could have been received, s; `deaf`: how long of it the rig received nothing, s; `deaf_cycles`: in which, so
    that an EMCY of the controller may be missing here. `unsound`: frames of the controller with a wrong checksum or
    alive counter, as far as no fault of the sequence acts on frames.
    """

    run: Rows
    enabling: Sequence[tuple[int, Rows]] = ()
    probes: Sequence[Rows] = ()
    emergencies: Sequence[Emergency] = ()
    heartbeats: Mapping[str, Sequence[Heartbeat]] = field(default_factory=dict)
    heard: tuple[float, float] = (0.0, 0.0)
    deaf: float = 0.0
    deaf_cycles: Sequence[int] = ()
    unsound: int | None = 0
    heartbeat_periods: Mapping[str, Second] = field(default_factory=dict)  # of the nodes; 0.1 s unless it says another
    bench: Bench = field(default_factory=load_bench)
    drive_limit: float = nan  # NaN: the plant declares none
    still_limit: float = 1e-4  # SI: how far the error may move while the drive stands still; NaN: not to be judged
    gains: object | None = None
    realtime: bool = False
    is_response_judged: bool = False

    @property
    def stretches(self) -> list[Rows]:
        """All rows, in stretches of consecutive cycles."""
        return [*self.probes, *(rows for _, rows in self.enabling), self.run]

    def join_rows(self) -> Rows:
        """The rows of the run with those in which the controller was enabled, in order."""
        whole = self.run
        for cycle, rows in reversed(self.enabling):
            whole = Rows._make(np.insert(column, cycle, part) for column, part in zip(whole, rows, strict=True))
        return whole

    @property
    def words(self) -> ProfileWords:
        """Control word and status word of the controller."""
        return PROFILES[self.bench.profile]


def judge_protocol(record: ProtocolRecord, limits: ProtocolLimits) -> tuple[list[CheckResult], list[SkippedCheck]]:
    """The protocol checks of a run, in the order of the table, and those that do not apply to its bench."""
    judges: tuple[Callable[[ProtocolRecord, ProtocolLimits], Iterator[CheckResult | SkippedCheck]], ...] = (
        _judge_current, _judge_status, _judge_drive_frames, _judge_frozen, _judge_probes, _judge_response,
        _judge_heartbeats, _judge_emergencies)
    results = [check for judge in judges for check in judge(record, limits)]
    return ([check for check in results if isinstance(check, CheckResult)],
            [check for check in results if isinstance(check, SkippedCheck)])


def _make_result(name: str, signal: str, value: float, unit: str, low: float = nan, high: float = nan,
                 detail: str = "") -> CheckResult:
    slack = 1e-9  # of the limit: a value in mA is a multiple of a count in A
    is_passed = isfinite(value) and not (value < low * (1 - slack) or value > high * (1 + slack))  # NaN: no limit
    return CheckResult(name=name, kind=PROTOCOL, signal=signal, value=value, unit=unit, low=low, high=high,
                       passed=is_passed, detail=detail)


def _judge_current(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """Largest current while it must be zero; and in all cycles."""
    idle = _drop_missing([rows.drive[find_idle(rows, record.words, limits, record.bench.rate)]
                          for rows in record.stretches])
    drive = record.bench.signals.drive
    idle_name, limit_name = f"no {drive.phrase} unless {record.words.active}", f"{drive.phrase} within its limit"
    is_always_active = all(_find_active(rows, record.words).all() for rows in record.stretches)
    if record.bench.profile == "none" and (is_always_active or not record.bench.enables):
        yield SkippedCheck(idle_name, "the bench has no control word, and no value of its phases in this run disables "
                                      "the controller")
    else:
        yield _judge_largest(idle_name, drive, idle, limits.idle_current + record.bench.find_least(drive.word),
                             f"{len(idle)} cycles")
    if isnan(record.drive_limit):
        yield SkippedCheck(limit_name, "the plant declares no limit of it")
    else:
        yield _judge_largest(limit_name, drive, _drop_missing([rows.drive for rows in record.stretches]),
                             record.drive_limit, "")


def _judge_largest(name: str, drive: Signal, values: Array, limit: float, detail: str) -> CheckResult:
    largest, detail = (float(np.abs(values).max()), detail) if len(values) else (nan, NO_FRAME)
    scale = drive.shown_scale
    return _make_result(name, drive.word, largest * scale, drive.shown_unit, high=limit * scale, detail=detail)


def _drop_missing(parts: Sequence[Array]) -> Array:
    values = np.concatenate(parts)
    return values[~np.isnan(values)]


def find_states(rows: Rows, words: ProfileWords) -> Whole:
    """The `State` of the status word in each cycle."""
    return map_words(rows.status, lambda word: find_state(words, word))


def _find_active(rows: Rows, words: ProfileWords) -> Mask:
    """The cycles whose control word asks for ACTIVE."""
    return np.asarray(map_words(rows.control, lambda word: find_wanted(words, word)) == State.ACTIVE)


def find_idle(rows: Rows, words: ProfileWords, limits: ProtocolLimits, rate: float) -> Mask:
    """Cycles in which there must be no current; none is before the first.

    By the control word: it does not ask for ACTIVE, nor did it in the time `status` before. By the status word of
    CiA 402: it has said that there is none, for 2 ms and two cycles.
    """
    idle = _find_over(_find_active(rows, words), round(limits.find_delay(words, rate) * rate))
    if words is CIA402:
        powered = np.isnan(rows.drive) | (rows.status.astype(int) & words.powered != 0)
        idle |= _find_over(powered, round(ProtocolLimits().find_delay(CIA408, rate) * rate))
    return idle


def _find_over(active: Mask, delay: int) -> Mask:
    """The cycles that are not active and that follow none that is by `delay` cycles or less."""
    count, k = np.concatenate(([0], np.cumsum(active))), np.arange(len(active))
    return np.asarray(count[k + 1] == count[np.maximum(k - delay, 0)])


def _judge_status(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """How long the status word takes to follow the control word, at worst; of CiA 402 also whether it may do so."""
    name = "status word follows the control word"
    if record.bench.profile == "none":
        yield SkippedCheck(name, "the bench has no control word and no status word")
        return
    delay = limits.find_delay(record.words, record.bench.rate)
    if record.words is CIA402:
        whole = record.join_rows()
        wrong = [change for rows in (whole, *record.probes)
                 for change in list_wrong_changes(rows, round(delay * record.bench.rate))]
        yield _make_result("status word follows the states of CiA 402", "status word", float(len(wrong)), "1", high=0.0,
                           detail="; ".join(wrong[:3]))
        ages = measure_delays(whole)
    else:
        faulty = _find_faulty(record)
        ages = np.concatenate([measure_status_ages(rows, faulty if rows is record.run else None)
                               for rows in record.stretches])
    value, detail = (int(ages.max()) * 1e3 / record.bench.rate, "") if len(ages) else (nan, NO_FRAME)
    yield _make_result(name, "status word", value, "ms", high=delay * 1e3, detail=detail)


def list_wrong_changes(rows: Rows, delay: int) -> Iterator[str]:
    """The changes of state of a CiA 402 drive, in words, that no control word of the last `delay` cycles explains.

    Before the first cycle it is switched off, or in fault.
    """
    states, control = find_states(rows, CIA402), rows.control.astype(int)
    target_states = map_words(control, lambda word: find_wanted(CIA402, word))
    rises = np.diff(control & CIA402.reset, prepend=0) > 0
    answers = np.flatnonzero(~np.isnan(rows.drive))
    before = np.concatenate(([int(State.NOT_READY)], states[answers]))[:-1]
    for i in np.flatnonzero(states[answers] != before).tolist():
        k, old = int(answers[i]), State(int(before[i]))
        near = slice(max(0, int(answers[max(i - 1, 0)]) - delay), k + 1)
        new = State(int(states[k]))
        if new not in list_reachable(old, frozenset(target_states[near].tolist()), resets=bool(rises[near].any())):
            names = [each.name.lower().replace("_", " ") for each in (new, old)]
            yield f"cycle {k}: {names[0]} after {names[1]} with control word 0x{control[k]:02X}"


def measure_delays(rows: Rows) -> Whole:
    """Of each answered cycle, for how many cycles a CiA 402 drive has kept a state that the control word ends."""
    states = find_states(rows, CIA402)
    pairs = states * len(State) + map_words(rows.control, lambda word: find_wanted(CIA402, word))
    due = {state * len(State) + word for state, word in list_transitions()}
    k = np.arange(len(pairs))
    begin = np.maximum.accumulate(np.where(np.diff(pairs, prepend=-1) != 0, k, 0))  # of the run of this pair
    return np.where(np.isin(pairs, list(due)), k - begin, 0)[~np.isnan(rows.drive)]


def measure_status_ages(rows: Rows, faulty: Mask | None = None) -> Whole:
    """Cycles since the control word last was as the status word says; for a status that it never was, since the start.

    Cycles without a drive frame are left out. In `faulty` cycles the controller has announced a fault, and a status
    word without READY and levels is right as well.
    """
    control, status = rows.control.astype(int), rows.status.astype(int) & (_LEVELS | _READY)
    expected_status = find_expected_status(control)
    matches = status == expected_status
    if faulty is not None:
        matches |= faulty & (status & _READY == 0) & (status & _LEVELS == 0)
    has_answer = ~np.isnan(rows.drive)
    ages = np.zeros(len(status), int)
    if not (matches | ~has_answer).all():
        last: dict[int, int] = {}
        for k, (expected_word, is_match, word) in enumerate(zip(expected_status.tolist(), matches.tolist(),
                                                                status.tolist(), strict=True)):
            last[expected_word] = k
            ages[k] = 0 if is_match else k - last.get(word, -1)
    return ages[has_answer]


def find_expected_status(control: Whole) -> Whole:
    """The status word of a sound controller: ready, and the levels of the control word, which build on each other."""
    levels = control & _LEVELS
    return np.where(levels & (levels + 1) == 0, levels, 0) | _READY


def _find_faulty(record: ProtocolRecord) -> Mask:
    """Cycles of the run in which the controller may be in fault: from its EMCY, or from when the rig could not hear
    one, until it is reset.
    """
    control = record.run.control.astype(int)
    faulty = np.zeros(len(control), bool)
    resets = np.flatnonzero(control & record.words.reset)
    announced = [emergency.cycle for emergency in record.emergencies
                 if emergency.node is Role.CONTROLLER and emergency.code & 0xFF00]
    for cycle in (*announced, *record.deaf_cycles):
        later = resets[resets > cycle]
        end = int(later[0]) + 1 if len(later) else len(control)
        faulty[max(0, cycle - _BEFORE_EMCY):end] = True
    return faulty


def _judge_drive_frames(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """Share of the cycles without a drive frame before the next SYNC, and with one of another cycle; unsound frames."""
    usual = 0.001 if record.realtime else 0.0
    largest_share = usual if limits.missing is None else limits.missing
    wrong = missing = cycles = 0
    for rows in record.stretches:
        is_judged = rows.on_time & ~_find_faulty(record) if rows is record.run else rows.on_time
        # the first of the frames that come in every n-th cycle may come as late as in the n-th
        is_judged = is_judged & (np.arange(len(is_judged)) >= record.bench.frames.drive.every - 1)
        is_wrong = is_judged & _find_flagged(rows, Flags.DRIVE_LATE)
        is_missing = is_judged & ~is_wrong & (np.isnan(rows.drive) | _find_flagged(rows, Flags.DRIVE_MISSING))
        wrong += int(is_wrong.sum())
        missing += int(is_missing.sum())
        cycles += int(is_judged.sum())
    specs = record.bench.frames.list_from(Role.CONTROLLER)
    for name, count, can_be_told in (("drive frames of another cycle", wrong, any(s.has("cycle") for s in specs)),
                                     ("drive frames missing or late", missing, True)):
        if can_be_told:
            value = 100 * count / cycles if cycles else 0.0
            yield _make_result(name, "drive", value, "%", high=100 * largest_share, detail=f"{count} of {cycles}")
        else:
            yield SkippedCheck(name, "the controller's frames do not carry the number of the cycle")
    if any(each.protection for spec in specs for each in spec.fields):
        name = "wrong checksums and alive counters"
        yield (SkippedCheck(name, "faults of the sequence disturb the frames") if record.unsound is None else
               _make_result(name, "drive", record.unsound, "1", high=largest_share * cycles))


def _find_flagged(rows: Rows, flags: Flags) -> Mask:
    """The cycles of whose drive frame the plant found one of these at the next SYNC."""
    return (np.append(rows.flags[1:], 0).astype(int) & int(flags)).astype(bool)


def _judge_frozen(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """How far the position error moved while the drive of the closed loop stood still."""
    signals = record.bench.signals
    name, unit = f"{signals.drive.phrase} follows the error", signals.controlled.unit
    if isnan(record.still_limit):
        yield SkippedCheck(name, "the law of the plant's controller is not one of the error alone")
        return
    change = measure_frozen(record.run, record.drive_limit if record.gains is not None else None, record.words)
    scale, shown_unit = (1e6, "um") if unit == "m" else (1.0, unit)
    yield _make_result(name, signals.drive.word, change * scale, shown_unit, high=round(record.still_limit * scale, 9))


def measure_frozen(rows: Rows, limit: float | None, words: ProfileWords = CIA408) -> float:
    """Largest change of the sensed position error, m, over cycles with one and the same current.

    Only cycles in which control and status word say ACTIVE, and not those within 2 % of the current limit. `limit`:
    what the controller says it is, A; None: it does not say, and the largest current of the run counts as the limit.
    A frame that is missing or late is not one with the same current: how many those may be, another check says.
    """
    largest = np.nanmax(np.abs(rows.drive), initial=0.0) if limit is None else limit
    is_limited = np.abs(rows.drive) >= 0.98 * largest
    is_answered = rows.on_time & ~_find_flagged(rows, Flags.DRIVE_LATE | Flags.DRIVE_MISSING)
    is_closed = _find_active(rows, words) & (find_states(rows, words) == State.ACTIVE) & ~is_limited & is_answered
    error = rows.demand - rows.position
    stays = is_closed[1:] & is_closed[:-1] & (rows.drive[1:] == rows.drive[:-1]) & ~np.isnan(error[1:] + error[:-1])
    edges = np.flatnonzero(np.diff(np.concatenate(([0], stays.astype(int), [0]))))
    ranges = [float(np.ptp(error[first:last + 1])) for first, last in edges.reshape(-1, 2) if last - first > 1]
    return max(ranges, default=0.0)


def _judge_probes(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """Answer to the demand step of the probe, and whether a reset makes the controller forget."""
    delay_name, repeat_name = "delay of the answer to a step", "same answers after a reset"
    node, parameter = record.bench.nodes.get(Role.CONTROLLER), "controller.proportional_gain"
    objects = {name: name_object(index, sub) for index, sub, name in (node.settings if node is not None else ())}
    gain_name = f"gain against {objects.get(parameter, 'its object').partition(':')[0]}"
    if node is None:
        yield SkippedCheck(repeat_name, "plain CAN has no reset")
    if not record.probes:
        return
    first = record.probes[0]
    delay, detail = measure_step_delay(first, record.bench.rate, record.words)
    high = limits.find_step_delay(record.bench) * 1e3
    drive = record.bench.signals.drive
    yield _make_result(delay_name, drive.word, delay, "ms", high=high, detail=detail)
    if record.gains is not None:
        gain, detail = measure_gain(first, record.gains, record.words)
        tolerance = 100 * limits.gain
        yield _make_result(gain_name, drive.word, 100 * gain, "%", 100 - tolerance, 100 + tolerance, detail)
    else:
        yield SkippedCheck(gain_name, "the controller has no objects that hold its gains, or does not follow them")
    if len(record.probes) > 1:
        difference, detail = measure_difference(record.probes)
        yield _make_result(repeat_name, drive.word, difference * drive.shown_scale, drive.shown_unit, high=0.0,
                           detail=detail)


def measure_step_delay(probe: Rows, rate: float, words: ProfileWords = CIA408) -> tuple[float, str]:
    """Time from the demand step to the first answer that follows it in the same direction, ms, and a remark.

    An answer follows when the current has changed by a fifth of the largest change since the step.
    """
    active = np.flatnonzero(_find_active(probe, words))
    steps = active[1:][np.diff(probe.demand[active]) != 0]
    if not len(steps):
        return nan, "the probe ended before its step"
    k, end = int(steps[0]), int([*steps, active[-1] + 1][1])
    change = (probe.drive[k:end] - probe.drive[k - 1]) * np.sign(probe.demand[k] - probe.demand[k - 1])
    if np.isnan(change).any():
        return nan, "a drive frame is missing at the step"
    if change.max() <= 0.0:
        return nan, "the answer does not follow the demand"
    return float(np.flatnonzero(change >= 0.2 * change.max())[0]) * 1e3 / rate, ""


def measure_gain(probe: Rows, gains: object, words: ProfileWords = CIA408) -> tuple[float, str]:
    """Current in the ACTIVE cycles of a probe over that of the documented law with these gains, 1, and a remark."""
    active = _find_active(probe, words)
    loop, currents = Loop(), []
    for demand, position in zip(probe.demand[active], probe.position[active], strict=True):
        current, loop = compute_current(loop, float(demand), float(position), gains)
        currents.append(current)
    law, cor = np.array(currents), probe.drive[active]
    if np.isnan(law + cor).any():
        return nan, "frames of the probe are missing"
    return (float(law @ cor / (law @ law)), "") if law.any() else (nan, "the gains are zero")


def measure_difference(probes: Sequence[Rows]) -> tuple[float, str]:
    """Largest difference of the current between probes that see the same demand and the same plant, A, and a remark.

    Before the first drive frame, which may come in the second cycle, there is nothing to compare.
    """
    begin = max(int(np.argmin(np.isnan(probe.drive))) for probe in probes)
    first, *others = [Rows._make(column[begin:] for column in probe) for probe in probes]
    largest = 0.0
    for other in others:
        if len(other.drive) != len(first.drive) or np.isnan(other.drive - first.drive).any():
            return nan, "a drive frame of the probes is missing"
        apart = np.flatnonzero(first.position != other.position)  # after the first difference they follow the drives
        same = int(apart[0]) if len(apart) else len(first.drive)
        if same:
            largest = max(largest, float(np.abs(other.drive - first.drive)[:same].max()))
    return largest, ""


def _judge_response(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """From SYNC to the drive frame, in cycles that the bench delivered on time."""
    if not record.is_response_judged:
        return
    times = _drop_missing([rows.response[rows.on_time] for rows in record.stretches]) * 1e6
    for name, share, limit, usual in (("p50", 50, limits.response_p50, 0.5), ("p99", 99, limits.response_p99, 0.9),
                                      ("max", 100, limits.response_max, 1.0)):
        value, detail = (float(np.percentile(times, share)), f"{len(times)} cycles") if len(times) else (nan, NO_FRAME)
        high = usual * 1e6 / record.bench.rate if limit is None else limit * 1e6
        yield _make_result(f"response time, {name}", "drive", value, "us", high=high, detail=detail)


def _judge_heartbeats(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """Median heartbeat period of each node, or for how long it has been silent at the end.

    A run in which the rig could receive for less than three periods says nothing about it. Nor do heartbeats that may
    have waited for the rig longer than the tolerance.
    """
    if Role.CONTROLLER.name.lower() not in record.heartbeats:
        yield SkippedCheck("heartbeat period, controller", "the controller sends no heartbeat")
    begin, end = record.heard
    tolerance = limits.heartbeat
    for node, beats in record.heartbeats.items():
        period = record.heartbeat_periods.get(node, 0.1)
        longest_pause = 3.0 * period  # s: then a node counts as silent
        if end - begin - record.deaf < longest_pause:
            continue
        t, waited = np.array(beats, float).reshape(-1, 2).T
        gaps = np.diff(t)[np.maximum(waited[1:], waited[:-1]) <= tolerance]
        if len(gaps) == 0 and len(beats) > 1:
            continue
        value = 1e3 * float(np.median(gaps)) if len(gaps) else nan
        detail = "" if len(gaps) else f"heartbeats in {end - begin:.3g} s: {len(beats)}"
        silence = end - (t[-1] if len(beats) else end) - record.deaf
        if silence > max(10.0 * period, 1.0):  # s, longer than a busy machine stands still
            value, detail = 1e3 * float(silence), f"the last {silence:.3g} s without one"
        low, high = (round(1e3 * (period + sign * tolerance), 6) for sign in (-1, 1))
        yield _make_result(f"heartbeat period, {node}", HEARTBEAT, round(value, 6), "ms", low, high, detail)


def _judge_emergencies(record: ProtocolRecord, limits: ProtocolLimits) -> Iterator[CheckResult | SkippedCheck]:
    """How many EMCY frames carry a code that is not documented for their node."""
    name, codes = "undocumented EMCY codes", {role: {*node.emcy} for role, node in record.bench.nodes.items()}
    codes.setdefault(Role.CONTROLLER, set()).update(limits.emcy)
    if not codes[Role.CONTROLLER]:
        yield SkippedCheck(name, "the bench file lists no EMCY codes of the controller (key emcy)" if record.bench.nodes
                           else "plain CAN has no EMCY")
        return
    strange = [e for e in record.emergencies if e.code not in codes.get(e.node, ())]
    detail = ", ".join(dict.fromkeys(f"node {record.bench.find_number(e.node)} 0x{e.code:04X}" for e in strange[:5]))
    yield _make_result(name, "EMCY", float(len(strange)), "1", high=0.0, detail=detail)
