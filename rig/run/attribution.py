"""Fault attribution: which cycles the controller may be judged on, and what was the first cause of trouble.

The bench and the controller share one bus, and each can make the other look bad: a late SYNC lets the controller report
a lost SYNC, a stalled plant emulator lets it report missing feedback, and a dead controller lets the plant report a
missing drive frame. All functions here are pure: they see the records of a finished run and no clock.

A cycle is judged only if the bench was on time in it: its SYNC and the next one were sent within the limit, and the
plant's feedback came within the limit. Cycles that follow a late one are not judged as far as its consequences reach:
nodes that were stalled first work off the frames that waited, which takes at most as long as the stall did.
"""

from collections.abc import Container, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant import RATE, Array, count_nouns
from rig.benches import Bench, Flags, Role
from rig.network import CONTROLLER, PLANT, RIG, StartTime
from rig.sequences import DELAY, BusOff, Mask, Offset, Parameter, Plan, Schedule, Silent, Stuck, TimingPolicy

NO_DRIVE = "drive"  # kind of a trouble: the rig, which moves the plant, gets no drive frames
_NO_DRIVE = int(Flags.DRIVE_MISSING | Flags.DRIVE_LATE)
_RPDO_TIMEOUT = 0x8250
_SETTLING = 100  # cycles: after a lost frame the position loop needs less than this to forget it


class Injected(NamedTuple):
    """Cycles that the faults of the sequence itself disturb, columns of shape (cycles,)."""

    sync: Mask  # SYNC, or the whole bus
    plant: Mask  # feedback or valve state
    fault: NDArray[np.int64]  # number of the fault that disturbs any frame or heartbeat, now or a moment ago; 0: none
    labels: tuple[str, ...] = ()  # of the faults, from number 1 on


class CycleRecords(NamedTuple):
    """What was measured in each cycle, columns of shape (cycles,); times in s from SYNC, NaN: no such frame came."""

    due_ns: NDArray[np.int64]  # log time at which SYNC was due
    lateness: Array  # SYNC sent after it was due
    feedback: Array  # the plant's feedback frame
    valve: Array  # the plant's valve state
    response: Array  # the controller's drive frame
    flags: NDArray[np.int64]  # of the valve state
    injected: Injected
    plant_delay: Array  # the plant's own record: feedback sent after SYNC came; 0 where it has none
    period: float = 1 / RATE  # s, of a cycle

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.lateness)

    def find_missing(self, node: int) -> Mask:
        """The cycles without a cyclic frame of a node, (cycles,)."""
        return np.isnan(self.response) if node == CONTROLLER else np.isnan(self.feedback) & np.isnan(self.valve)

    def find_stop(self, node: int) -> int:
        """The first cycle from which a node sent none of its cyclic frames any more; `cycles` if it sent the last."""
        present = np.flatnonzero(~self.find_missing(node))
        return int(present[-1]) + 1 if len(present) else 0

    def find_cycle(self, t_ns: int) -> int:
        """The cycle under way at a log time; 0 before the first."""
        return max(int(np.searchsorted(self.due_ns, t_ns, "right")) - 1, 0)


class Trouble(NamedTuple):
    """Something that a node or the rig reported; `node` 0 where no node is meant."""

    t_ns: int  # log time
    node: int  # role
    kind: str  # of the event: emcy, nmt, heartbeat, process, drive, guard, bus, bring_up, operator; late: of the bench
    code: int  # of an EMCY; NMT state of kind nmt; else 0
    text: str


class Disturbance(NamedTuple):
    """Cycles `first` to `last` in which the bench was late; consequences can come until cycle `reach`."""

    first: int
    last: int
    reach: int
    source: int  # role: rig or plant
    text: str


class Cause(NamedTuple):
    """The first cause of trouble: who, in which cycle, and how that is known."""

    source: int  # node; 0: not a node
    kind: str  # "late" for the bench's own lateness, "stopped", "injected", or the kind of the trouble
    cycle: int
    text: str
    evidence: tuple[str, ...] = ()
    is_gone: bool = False  # the node does not answer any more: no lateness explains that

    @property
    def is_lateness(self) -> bool:
        """Whether the bench itself was late."""
        return self.kind == "late"


class Attribution(NamedTuple):
    """The result: which cycles the controller was judged on, the first cause of trouble, and what followed from it."""

    judged: Mask  # (cycles,)
    invalid: dict[str, int]  # reason: number of cycles that were not judged
    disturbances: tuple[Disturbance, ...]
    cause: Cause | None
    consequences: tuple[tuple[int, Trouble], ...]  # the other troubles in order, each with its cycle
    affected: Mask  # (cycles,) rows in which lateness of the bench changed the signals
    by_bench: int  # troubles that followed from lateness of the bench
    overruns: NDArray[np.int64]  # (cycles,)


def attribute(records: CycleRecords, troubles: Sequence[Trouble], policy: TimingPolicy, bench: Bench,
              gone_nodes: Mapping[Role, str]) -> Attribution:
    """Find the cycles that may be judged, and the first cause of the troubles of a run.

    Args:
        records: what was measured in each cycle.
        troubles: everything that was reported, in any order.
        policy: limits of the sequence.
        bench: names the participants.
        gone_nodes: those that did not answer any more at the end of the run, and how that is known.
    """
    late = find_late_cycles(records, policy, find_plant_stops(records, troubles, gone_nodes))
    disturbances = find_disturbances(records, late)
    is_judged, invalid = select_judged(records, late, disturbances)
    sorted_troubles = sorted(troubles, key=lambda trouble: trouble.t_ns)
    causes = [find_cause(trouble, records, disturbances, gone_nodes, bench) for trouble in sorted_troubles]
    cause = find_first_cause(causes, disturbances)
    consequences = tuple((records.find_cycle(trouble.t_ns), trouble) for trouble in sorted_troubles
                         if cause is None or trouble.text != cause.text)
    return Attribution(is_judged, invalid, disturbances, cause, consequences, find_affected(records, disturbances),
                       sum(each.is_lateness for each in causes), count_overruns(records, late))


def find_first_cause(causes: Iterable[Cause], disturbances: Iterable[Disturbance]) -> Cause | None:
    """The earliest cause; a node that stopped for good while the bench was late comes before that lateness.

    Lateness makes frames come late, but it ends no process.
    """
    sorted_causes = sorted(causes, key=lambda cause: cause.cycle)
    if not sorted_causes or not sorted_causes[0].is_lateness:
        return sorted_causes[0] if sorted_causes else None
    reach = max((late.reach for late in disturbances if late.first == sorted_causes[0].cycle),
                default=sorted_causes[0].cycle)
    return next((cause for cause in sorted_causes if cause.is_gone and cause.cycle <= reach), sorted_causes[0])


class LateCycles(NamedTuple):
    """Masks of shape (cycles,): in which way the bench was late."""

    sync: Mask  # SYNC sent too late
    feedback: Mask  # the plant's frames came too late, or not
    stalled: Mask  # by its own record, the plant sent feedback too late

    @property
    def any(self) -> Mask:
        """Cycles in which the bench was late."""
        return self.sync | self.feedback | self.stalled


def find_late_cycles(records: CycleRecords, policy: TimingPolicy, stops: Iterable[int] = ()) -> LateCycles:
    """Find the cycles in which the bench was late.

    Args:
        records: what was measured in each cycle.
        policy: the limits.
        stops: cycles in which the plant was found to have stopped. The frames that were missing then are not late: a
            plant that has stopped is another cause.
    """
    latest_sync, latest_feedback = policy.find_limits(records.period)
    sync = (records.lateness > latest_sync) & ~records.injected.sync
    is_in_time = (records.feedback <= latest_feedback) & ~np.isnan(records.valve)
    feedback = ~is_in_time & ~records.injected.plant & ~records.injected.sync
    missing = records.find_missing(PLANT)
    for cycle in stops:
        first = _find_run_start(missing, min(cycle, records.cycles - 1),
                                near=round(0.15 / records.period))  # s: the next heartbeat shows a changed NMT state
        present = np.flatnonzero(~missing[first:])
        feedback[first:first + int(present[0]) if len(present) else None] = False
    return LateCycles(sync, feedback, records.plant_delay > latest_feedback)


def find_plant_stops(records: CycleRecords, troubles: Iterable[Trouble], gone_nodes: Container[int]) -> list[int]:
    """Cycles in which the plant was found to have stopped: it is gone, has an error of its own, or left OPERATIONAL."""
    stops = [records.find_cycle(trouble.t_ns) for trouble in troubles
             if trouble.node == PLANT and not _is_communication(trouble)]
    return [*stops, records.cycles - 1] if PLANT in gone_nodes else stops


def find_start_problem(times: Mapping[Role, StartTime], limit: float, names: Mapping[Role, str],
                       ) -> tuple[str, str, int] | None:
    """Who is to blame when a node was not OPERATIONAL within `limit` s of NMT start; None if all were.

    Returns kind, text and node (0: the bench as a whole) as in `Trouble`. The kind is "late" if the bench was late,
    "bring_up" if the node is too slow.

    The controller is blamed only if the plant was in time and the rig was there to take its heartbeat in. If both nodes
    are too slow, the machine or the bus stood still.

    Args:
        times: of the nodes that became OPERATIONAL, by node.
        limit: s.
        names: the nodes that say so, with their names.
    """
    slow = [node for node in names
            if node not in times or times[node].seconds - times[node].waited > limit]
    reasons = {node: f"took {times[node].seconds:.2f} s" if node in times else "has not said so" for node in slow}
    rule = f"must be OPERATIONAL within {limit:g} s of NMT start"
    if len(slow) == 2:
        details = ", ".join(f"{names[node]} {reasons[node]}" for node in slow)
        return "late", f"the bench was late in bring-up: both nodes {rule}: {details}", 0
    for node in slow:
        kind = "late" if node == PLANT and node in times else "bring_up"  # the plant is a part of the bench
        return kind, f"{names[node]} {rule} and {reasons[node]}", node
    for node, time in times.items():
        if time.seconds > limit:
            return "late", (f"the rig stood still for {time.waited:.2f} s and cannot know whether {names[node]} "
                            f"was OPERATIONAL within {limit:g} s"), RIG
    return None


def find_disturbances(records: CycleRecords, late: LateCycles, gap: int = 2) -> tuple[Disturbance, ...]:
    """Group late cycles that are at most `gap` cycles apart: a stall of one process makes the others late too."""
    cycles = np.flatnonzero(late.any)
    if not len(cycles):
        return ()
    breaks = np.flatnonzero(np.diff(cycles) > gap + 1) + 1
    return tuple(_describe_disturbance(records, late, int(group[0]), int(group[-1]))
                 for group in np.split(cycles, breaks))


def _describe_disturbance(records: CycleRecords, late: LateCycles, first: int, last: int) -> Disturbance:
    """A disturbance with its reach: three cycles, and as long again as it lasted."""
    span = slice(first, last + 1)
    late_periods = int(np.floor(np.nan_to_num(records.lateness[span]) / records.period).sum())
    # The rig is named if its SYNC was late first: a stalled rig also takes the plant's frames in late.
    is_rig = late.sync[first] or (
        late.sync[span].any() and not late.stalled[span].any() and late.feedback[span].sum() < 2)
    late_ms = 1e3 * float(np.nanmax(records.lateness[span]))
    text = f"the rig sent SYNC {late_ms:.1f} ms late" if is_rig else _describe_plant(records, late, span)
    return Disturbance(first, last, last + 3 + (last - first + 1) + late_periods, RIG if is_rig else PLANT, text)


def _describe_plant(records: CycleRecords, late: LateCycles, span: slice) -> str:
    if late.stalled[span].any():
        return f"by its own record the plant sent feedback {1e3 * records.plant_delay[span].max():.1f} ms after SYNC"
    if missing := int(np.isnan(records.feedback[span]).sum() or np.isnan(records.valve[span]).sum()):
        return f"the plant sent no feedback for {count_nouns(missing, 'cycle')}"
    return f"the plant's feedback came {1e3 * float(np.nanmax(records.feedback[span], initial=0.0)):.1f} ms after SYNC"


def count_overruns(records: CycleRecords, late: LateCycles) -> NDArray[np.int64]:
    """Overruns in each cycle, (cycles,): one for a late cycle, and the whole periods that were skipped if more."""
    late_periods = np.floor(np.nan_to_num(records.lateness) / records.period).astype(np.int64)
    return np.maximum(late_periods, late.any.astype(np.int64))


def count_most_in_a_row(overruns: NDArray[np.int64]) -> int:
    """Most overruns in a row.

    >>> count_most_in_a_row(np.array([0, 1, 1, 0, 5, 0]))
    5
    """
    most = current = 0
    for number in overruns.tolist():
        current = current + number if number else 0
        most = max(most, current)
    return most


def select_judged(records: CycleRecords, late: LateCycles,
                  disturbances: Iterable[Disturbance]) -> tuple[Mask, dict[str, int]]:
    """Select the cycles on which the controller may be judged; with the number of the others by reason."""
    is_shortened = np.append(late.sync[1:], False)  # the whole machine may have stood still between the two SYNCs
    is_following = np.zeros(records.cycles, dtype=bool)
    for disturbance in disturbances:
        is_following[disturbance.last + 1:disturbance.reach - 1] = True
    is_excluded = np.zeros(records.cycles, dtype=bool)
    counts = {}
    for reason, mask in (("sync_late", late.sync), ("feedback_late", late.feedback), ("plant_stalled", late.stalled),
                         ("next_sync_late", is_shortened), ("following", is_following)):
        counts[reason] = int((mask & ~is_excluded).sum())
        is_excluded |= mask
    return ~is_excluded, counts


def find_affected(records: CycleRecords, disturbances: Iterable[Disturbance]) -> Mask:
    """Rows whose signals differ because the bench was late: from a lost or late frame on, until the loop has settled.

    A late SYNC alone changes no signal: the plant moves one period a SYNC, however late it comes.
    """
    is_affected = np.zeros(records.cycles, dtype=bool)
    is_frame_lost = np.isnan(records.feedback) | np.isnan(records.response) | (records.flags & _NO_DRIVE != 0)
    for disturbance in disturbances:
        cycles = disturbance.first + np.flatnonzero(is_frame_lost[disturbance.first:disturbance.reach + 1])
        if len(cycles):
            is_affected[cycles[0]:cycles[-1] + _SETTLING] = True
    return is_affected


def find_cause(trouble: Trouble, records: CycleRecords, disturbances: Iterable[Disturbance],
               gone_nodes: Mapping[Role, str], bench: Bench) -> Cause:
    """The first cause of one trouble.

    What is not about communication is its own cause. Otherwise, in this order: a node that is gone explains the frames
    that no longer come; a fault of the sequence explains what follows from it; lateness of the bench explains what
    falls into its reach; a node that sent no frames explains that others miss them.
    """
    cycle = records.find_cycle(trouble.t_ns)
    own_cause = Cause(trouble.node, trouble.kind, cycle, trouble.text)
    if not _is_communication(trouble):
        return own_cause
    silent, origin = _find_silent_node(trouble, records, cycle)
    for node in (silent, trouble.node):
        if node in gone_nodes and records.find_stop(node) <= cycle + 1:  # later it still answered
            return _describe_stop(Role(node), bench, records, min(origin, records.find_stop(node)), cycle,
                                  gone_nodes[Role(node)])
    if records.injected.fault[max(origin - 1, 0):cycle + 1].any() and trouble.kind != "guard":
        return _describe_injected(records.injected, cycle)
    for disturbance in disturbances:
        reach = disturbance.reach + (_SETTLING if trouble.kind == "guard" else 0)
        if any(disturbance.first - 1 <= at <= reach for at in (origin, cycle)):
            return Cause(disturbance.source, "late", disturbance.first, disturbance.text)
    return _describe_stop(Role(silent), bench, records, origin, cycle, "") if silent else own_cause


def _describe_injected(injected: Injected, cycle: int) -> Cause:
    """The last fault of the sequence that disturbs frames up to `cycle`, from where it began to do so."""
    number = injected.fault[:cycle + 1][injected.fault[:cycle + 1] != 0][-1]
    first = _find_run_start(injected.fault != 0, cycle, near=cycle)
    first += int(np.argmax(injected.fault[first:] == number))
    return Cause(0, "injected", first, "a fault of the sequence disturbs frames",
                 (f"fault {injected.labels[number - 1]!r} acts on them from cycle {first}",))


def _is_communication(trouble: Trouble) -> bool:
    """Whether lateness or silence of another node can be behind a trouble.

    An error of a node's own device, its reset, another rig on the bus and the operator are causes by themselves. So is
    a plant that leaves OPERATIONAL: no frame of the others makes it do so.
    """
    if trouble.kind == "emcy":
        return 0x8100 <= trouble.code < 0x8300
    if trouble.kind == "nmt":
        return trouble.node == CONTROLLER and trouble.code != 0
    return trouble.kind in ("heartbeat", "process", "guard", NO_DRIVE)


def _find_silent_node(trouble: Trouble, records: CycleRecords, cycle: int) -> tuple[int, int]:
    """The node whose missing frames a trouble is about, and the first cycle without them; 0 and `cycle` for none."""
    if trouble.kind in ("heartbeat", "process"):
        stop = records.find_stop(trouble.node)
        is_answering = trouble.kind == "heartbeat" and stop > cycle  # only the heartbeat is missing
        return (0, cycle) if is_answering else (trouble.node, min(cycle, stop))
    is_drive_missing = trouble.kind == NO_DRIVE
    if not is_drive_missing and (trouble.kind != "emcy" or trouble.code != _RPDO_TIMEOUT):
        return 0, cycle
    no_feedback = records.find_missing(PLANT)
    if trouble.node != PLANT and not is_drive_missing:
        origin = _find_run_start(no_feedback, cycle)
        return (PLANT, origin) if no_feedback[min(origin, len(no_feedback) - 1):][:1].any() else (0, cycle)
    # The plant's flags of cycle k + 1 speak of the drive frame of cycle k.
    is_flagged = np.append(records.flags[1:] & _NO_DRIVE != 0, False)[:records.cycles]
    origin = _find_run_start(records.find_missing(CONTROLLER) | is_flagged, cycle)
    first = max(origin - 1, 0)
    # Without feedback the controller has nothing to answer: then the plant was first.
    return (PLANT, first) if no_feedback[first:origin + 1].any() else (CONTROLLER, origin)


def _find_run_start(missing: Mask, cycle: int, near: int = 4) -> int:
    """First cycle of the last run of missing frames that reaches to within `near` cycles of `cycle`."""
    before = np.flatnonzero(missing[:cycle + 1])
    if not len(before) or before[-1] < cycle - near:
        return cycle
    present = np.flatnonzero(~missing[:int(before[-1]) + 1])
    return int(present[-1]) + 1 if len(present) else 0


def _describe_stop(node: Role, bench: Bench, records: CycleRecords, first: int, cycle: int, how: str) -> Cause:
    """A node that stopped answering in cycle `first`, with the evidence that the bench did its part."""
    missing = np.isnan(records.response if node == CONTROLLER else records.feedback)
    frames, name = "valid drive" if node == CONTROLLER else "feedback", bench.describe_node(node)
    count = int(np.argmin(missing[first:])) if not missing[first:].all() else 0  # 0: until the end
    if not how and (count or first >= records.cycles):
        text = f"{name} did not answer in time: no {frames} frame for {count_nouns(count, 'cycle')} from {first}"
    else:
        text = f"{name} stopped answering: no {frames} frame since cycle {first}" + (f"; {how}" if how else "")
    evidence = _show_punctuality(records, first, cycle) if node == CONTROLLER else ()
    return Cause(node, "stopped", first, text, evidence, is_gone=bool(how))


def _show_punctuality(records: CycleRecords, first: int, cycle: int) -> tuple[str, ...]:
    """Evidence that SYNC and feedback came on time in the cycles before a trouble that was reported in `cycle`."""
    span = slice(first, max(first + 1, min(cycle, first + 3)))
    feedback = records.feedback[span]
    if not len(feedback) or np.isnan(feedback).any():
        return ()
    return (f"in cycles {first} to {first + len(feedback) - 1} SYNC was sent at most "
            f"{1e3 * float(records.lateness[span].max()):.2f} ms late and feedback came within "
            f"{1e3 * float(feedback.max()):.2f} ms",)


def find_injected(plan: Plan, schedule: Schedule, cycles: int, heartbeat_limit: float = 0.4,
                  watchdog_limit: int = 4) -> Injected:
    """Find the cycles that the faults of a sequence disturb.

    Args:
        plan, schedule: the faults, and in which cycles they act.
        cycles: number of cycles of the run.
        heartbeat_limit: s after which a lost heartbeat has been reported.
        watchdog_limit: cycles after which missing frames have been reported.
    """
    sync, plant, number_of_fault = (np.zeros(cycles, dtype=kind) for kind in (bool, bool, np.int64))
    silence, cycle_ns = round(heartbeat_limit * plan.rate), round(1e9 / plan.rate)
    for number, fault in enumerate(plan.faults, 1):
        first, last = plan.find_cycles(fault)
        frame = getattr(fault, "frame", "")
        if not frame and not isinstance(fault, Parameter | Offset | Stuck):
            number_of_fault[first:last + silence] = number
            sync[first:last + watchdog_limit] |= not isinstance(fault, Silent)
            plant[first:last + 1] |= isinstance(fault, BusOff)
        for k in range(first, min(last, cycles) if frame else first):
            action = schedule.find_action(frame, k)
            if action.code:
                last_hit = k - (-action.argument // cycle_ns) if action.code == DELAY else k
                number_of_fault[k:last_hit + (silence if frame == "sync" else watchdog_limit)] = number
                plant[k:last_hit + 1] |= frame in ("feedback", "valve_state", "sync")
                sync[k:last_hit + 1] |= frame == "sync"
    return Injected(sync, plant, number_of_fault, tuple(fault.label for fault in plan.faults))
