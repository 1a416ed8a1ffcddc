"""Chapter 6, the NMT state machine, and 7, how long the node takes; CiA 301 sets few limits for that."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

from rig.conformance.error_cases import LIMIT, beat_as, measure_periods, watch
from rig.conformance.pdo_cases import identify, list_sent, list_valid, operational, read_mapped, send_short, set_type
from rig.conformance.sdo_cases import READ_TYPE
from rig.conformance.target import (
    COMMANDS,
    OPERATIONAL,
    PRE_OPERATIONAL,
    STOPPED,
    Case,
    CaseNotApplicable,
    CaseSkipped,
    Refusal,
    Target,
    Variable,
    for_each,
    join_labels,
    require,
    require_applicable,
)
from rig.network import NmtCommand, NmtState, name_state

RESETS = (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)
QUIET = 0.2  # s: the time in which a frame that is not expected would come


def check_boot(t: Target, specifier: NmtCommand) -> str:
    """What the node sends first after a reset."""
    start = t.now()
    boot = t.reset(specifier)
    require(boot.data == b"\0", f"data: {boot.data.hex(' ')}")
    more = [frame for frame in t.listen(QUIET, t.heartbeat_id) if frame.data == b"\0"]
    require(not more, f"{1 + len(more)} boot-up frames")
    return f"0x{boot.cob_id:03X} 00 after {(boot.t_ns - start) * 1e-6:.0f} ms"


def check_state_after_boot(t: Target) -> str:
    """A node without 0x1F80 waits for its master."""
    require_applicable(t.sheet.find(0x1F80) is None or t.read(0x1F80) & 4, "0x1F80 lets the node start itself")
    t.reset()
    t.beat()
    t.require_state(PRE_OPERATIONAL, "after the boot-up")
    return "PRE-OPERATIONAL"


def check_transitions(t: Target) -> str:
    """All nine, addressed to the node."""
    t.beat()
    for old, new in product(COMMANDS, repeat=2):
        t.enter(old)
        t.command(COMMANDS[new])
        t.require_state(new, f"{name_state(old)} to {name_state(new)}")
    return "9 transitions"


def check_broadcast(t: Target) -> str:
    """Not where other nodes are on the bus: they would be started as well."""
    if t.others:
        raise CaseSkipped(f"other nodes are on the bus: {join_labels([str(node) for node in sorted(t.others)])}")
    t.beat()
    for state in (OPERATIONAL, STOPPED, PRE_OPERATIONAL):
        t.command(COMMANDS[state], 0)
        t.require_state(state, "command to all nodes")
    t.reset(NmtCommand.RESET_COMMUNICATION, 0)
    return "start, stop, enter PRE-OPERATIONAL, reset"


def check_ignored(t: Target, state: NmtState, make_frames: Callable[[Target], list[bytes]], what: str) -> str:
    """NMT commands that must not change the state."""
    t.beat()
    t.enter(state)
    for data in make_frames(t):
        t.send(0x000, data)
    t.require_state(state, f"{what} in {name_state(state)}")
    require(all(frame.data != b"\0" for frame in t.heard(0, t.heartbeat_id)), f"{what}: the node booted")
    return name_state(state)


def check_sdo_by_state(t: Target, state: NmtState) -> str:
    """The device type is read. A request that comes in STOPPED must not be kept for later."""
    t.beat()
    t.enter(state)
    mark = len(t.frames)
    answer = t.ask(READ_TYPE, QUIET if state == STOPPED else t.options.timeout)
    text = f"{'an answer' if answer else 'no answer'} in {name_state(state)}"
    require((answer is None) == (state == STOPPED), text)
    if state == STOPPED:
        t.enter(PRE_OPERATIONAL)
        t.wait(QUIET)
        require(not t.heard(mark, t.response_id), "a request in STOPPED is answered later")
        t.demand(READ_TYPE)
    return text


def check_pdo_by_state(t: Target, state: NmtState) -> str:
    """Sending: at SYNC. Receiving: a frame that is too short is noticed in OPERATIONAL only.

    Whether it is noticed there is the subject of another test: a node that is silent shows nothing here.
    """
    pdos = {identify(t, pdo): pdo for pdo in list_valid(t)}
    cyclic_ids = {cob_id for cob_id, pdo in pdos.items() if not pdo.is_received and set_type(t, pdo, 1)}
    values = {cob_id: read_mapped(t, pdo) for cob_id, pdo in pdos.items() if pdo.is_received}
    is_running = state == OPERATIONAL
    t.beat()
    t.enter(state)
    mark = len(t.frames)
    for cob_id, each in values.items():
        t.send(cob_id, b"".join(each))
    t.sync(3, 0.02)
    if is_running:
        t.wait(t.options.timeout, lambda: {frame.cob_id for frame in t.heard(mark)} >= cyclic_ids)
    t.wait(0.05)
    sent_ids = {frame.cob_id for frame in t.heard(mark)} & set(pdos)
    silent = [pdos[cob_id].name for cob_id in cyclic_ids - sent_ids]
    require(not (is_running and silent), f"OPERATIONAL: {join_labels(silent)} not sent at SYNC")
    early = [pdos[cob_id].name for cob_id in sent_ids]
    require(is_running or not early, f"{name_state(state)}: {join_labels(early)} sent")
    if t.sheet.find(0x1014) and values and state != STOPPED:  # in STOPPED no EMCY could say so
        cob_id, each = next(iter(values.items()))
        is_noticed = bool(send_short(t, pdos[cob_id], each, cob_id, is_running))
        require(is_running or not is_noticed, f"{name_state(state)}: {pdos[cob_id].name} is received")
        t.send(cob_id, b"".join(each))
        if is_running and not is_noticed:
            return f"{name_state(state)} {len(sent_ids)} sent, reception not shown"
    return f"{name_state(state)} {len(sent_ids)} sent"


def check_emcy_by_state(t: Target) -> str:
    """A supervised heartbeat stops while the node is STOPPED."""
    node = watch(t)
    t.beat()
    t.enter(STOPPED)
    mark = len(t.frames)
    beat_as(t, node, 3)
    t.wait(2 * LIMIT / 1e3)
    emergencies = [f"EMCY {frame.data.hex(' ')}" for frame in t.heard(mark, t.emcy_id)]
    require(not emergencies, f"{join_labels(emergencies)} in STOPPED")
    beats = len(t.heard(mark, t.heartbeat_id))
    require(beats, "no heartbeat in STOPPED")
    return f"no EMCY, {beats} heartbeats"


def check_reset_communication(t: Target) -> str:
    """Not where the node can store parameters."""
    require_applicable(0x1010 not in t.sheet.objects, "the node can store parameters (0x1010)")
    return check_restored(t, NmtCommand.RESET_COMMUNICATION, t.require_writable(0x1017))


def check_reset_node(t: Target) -> str:
    """Only with --write."""
    require_applicable(0x1010 not in t.sheet.objects, "the node can store parameters (0x1010)")
    require(t.options.may_write, "values are changed only with --write", CaseSkipped)
    check_restored(t, NmtCommand.RESET_NODE, t.require_writable(0x1017))
    for variable in t.sheet.variables:
        is_suitable = not variable.is_communication and variable.access == "rw" and variable.size
        if is_suitable and not variable.is_mappable and variable.default_bytes is not None:
            try:
                return check_restored(t, NmtCommand.RESET_NODE, variable)
            except Refusal:
                continue
    raise CaseNotApplicable("no such object can be written")


def check_restored(t: Target, specifier: NmtCommand, variable: Variable) -> str:
    """Change an object, reset, and compare with its default."""
    data = t.upload(*variable.key)
    new_data = variable.change(data)
    with t.restore_afterwards(variable.key):
        t.download(*variable.key, new_data)
        t.require_value(variable, new_data, "does not change")
        t.reset(specifier)
        default = data if variable.default_bytes is None else variable.default_bytes
        t.require_value(variable, default, f"has not its default {variable.show(default)} after the reset")
    return f"{variable.label}: {variable.decode(new_data)} to {variable.decode(default)}"


def check_reset_from_state(t: Target, reset: tuple[NmtState, NmtCommand]) -> None:
    """A node that is stopped must still obey."""
    state, specifier = reset
    t.beat()
    t.enter(state)
    t.reset(specifier)
    t.beat()
    t.require_state(PRE_OPERATIONAL, f"after a reset in {name_state(state)}")


def check_times(t: Target, act: Callable[[Target], object], count: int, share: float, limit: float) -> str:
    """From a command to the frame that answers it, the last one heard. CiA 301 gives no limits.

    50 ms for SDO are a tenth of the time after which clients commonly give up.
    """
    times = []
    for _ in range(count):
        start = t.now()
        act(t)
        times.append((t.frames[-1].t_ns - start) * 1e-6)
    return require_times(t, times, share, limit)


def check_heartbeat_jitter(t: Target) -> str:
    """Thirty periods. CiA 301 gives no limit; consumers allow half a period at least."""
    return f"off by {require_times(t, [abs(period - 50.0) for period in measure_periods(t, 50, 30)], 1.0, 10.0)}"


def check_sync_response(t: Target) -> str:
    """A hundred SYNCs, 20 ms apart; none may be left out."""
    ids = {identify(t, pdo): pdo.name for pdo in list_sent(t) if set_type(t, pdo, 1)}
    require_applicable(ids, "no TPDO is synchronous")
    window = t.read(0x1007) * 1e-3 if t.sheet.find(0x1007) else 0.0  # ms
    times: list[float] = []
    with operational(t):
        for _ in range(100):
            start, mark = t.now(), len(t.frames)
            t.sync()
            t.wait(t.options.timeout, lambda: {frame.cob_id for frame in t.heard(mark)} >= set(ids))  # noqa: B023
            delays = {frame.cob_id: (frame.t_ns - start) * 1e-6 for frame in t.heard(mark, *ids)}
            missing = [name for cob_id, name in ids.items() if cob_id not in delays]
            require(not missing, f"no {', '.join(missing)} after a SYNC")
            times += delays.values()
            t.wait(max(0.0, 0.02 - (t.now() - start) * 1e-9))
    return f"{', '.join(ids.values())}: {require_times(t, times, 0.99, window or 10.0)}"


def require_times(t: Target, times: Sequence[float], share: float, limit: float) -> str:
    """Median, 99th percentile and maximum of times in ms; of a few, all.

    Raises Problem unless this share of them keeps to the limit and the tolerance.
    """
    def find(part: float) -> float:
        return sorted(times)[round(part * (len(times) - 1))]

    limit += 1e3 * t.options.tolerance
    text = (f"{', '.join(f'{each:.1f}' for each in times)} ms" if len(times) < 10 else
            f"p50 {find(0.5):.2f}, p99 {find(0.99):.2f}, max {max(times):.2f} ms")
    require(find(share) <= limit, f"{text}, limit {limit:.1f} ms")
    return text


CASES = (
    Case("6.1", "boot-up after reset node", "7.2.8.3.3, 7.3.2.2.1", "one frame 0x700 + node-ID with one byte 0",
         partial(check_boot, specifier=NmtCommand.RESET_NODE)),
    Case("6.2", "boot-up after reset communication", "7.2.8.3.3, 7.3.2.2.1",
         "one frame 0x700 + node-ID with one byte 0", partial(check_boot, specifier=NmtCommand.RESET_COMMUNICATION)),
    Case("6.3", "state after boot-up", "7.3.2.1", "PRE-OPERATIONAL, unless 0x1F80 says that the node starts itself",
         check_state_after_boot),
    Case("6.4", "transitions", "7.3.2.4, 7.2.8.2.1", "start, stop and enter PRE-OPERATIONAL work from each state",
         check_transitions),
    Case("6.5", "commands to all nodes", "7.2.8.3.1", "node-ID 0 addresses the node too", check_broadcast),
    Case("6.6", "commands to other nodes", "7.2.8.3.1", "ignored in each state",
         for_each(lambda t: COMMANDS, partial(
             check_ignored, make_frames=lambda t: [bytes((command, t.find_free_node())) for command in NmtCommand],
             what="5 commands to another node"), text="5 commands ignored in {}")),
    Case("6.7", "malformed commands", "7.2.8.3.1", "unknown commands and frames of another length are ignored",
         for_each(lambda t: COMMANDS, partial(
             check_ignored, what="6 malformed commands",
             make_frames=lambda t: [*(bytes((command, t.node)) for command in (0, 3, 127)), b"\1", b"\x81", b""]),
             text="6 frames ignored in {}")),
    Case("6.8", "SDO by state", "7.3.2.3, table 39",
         "in PRE-OPERATIONAL and OPERATIONAL; a request in STOPPED is answered neither then nor later",
         for_each(lambda t: COMMANDS, check_sdo_by_state)),
    Case("6.9", "PDO by state", "7.3.2.3, table 39", "sent and received in OPERATIONAL only",
         for_each(lambda t: COMMANDS, check_pdo_by_state)),
    Case("6.10", "EMCY and heartbeat by state", "7.3.2.3, table 39", "EMCY not in STOPPED; heartbeat in every state",
         check_emcy_by_state),
    Case("6.11", "reset communication restores its objects", "7.3.2.2.1", "a changed 0x1017 has its default again",
         check_reset_communication),
    Case("6.12", "reset node restores all objects", "7.3.2.2.1",
         "a changed object of the manufacturer or the profile has its default again", check_reset_node),
    Case("6.13", "reset from each state", "7.3.2.4",
         "boot-up from PRE-OPERATIONAL, OPERATIONAL and STOPPED, by both resets",
         for_each(lambda t: product(COMMANDS, RESETS), check_reset_from_state, "reset")),
    Case("7.1", "SDO response time", "7.2.4.3", "99 of 100 uploads of 0x1000 are answered within 50 ms",
         partial(check_times, act=lambda t: t.demand(READ_TYPE), count=100, share=0.99, limit=50.0), is_timed=True),
    Case("7.2", "boot time", "7.3.2.2.1", "boot-up within 2 s of a reset node",
         partial(check_times, act=lambda t: t.reset(NmtCommand.RESET_NODE), count=3, share=1.0, limit=2000.0),
         is_timed=True),
    Case("7.3", "heartbeat jitter", "7.2.8.3.2.2", "no period of 50 ms is off by more than 10 ms and the tolerance",
         check_heartbeat_jitter, is_timed=True),
    Case("7.4", "SYNC to PDO", "7.2.2.2, 7.5.2.7",
         "each synchronous TPDO comes within the window 0x1007, or else within the tolerance and 10 ms",
         check_sync_response, is_timed=True),
)
