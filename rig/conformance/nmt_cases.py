"""Chapter 6: the NMT state machine: boot-up, transitions, and which service exists in which state."""
from __future__ import annotations

from functools import partial

from rig.conformance.conformance_case import (
    CaseFailed,
    CaseNotApplicable,
    CaseSkipped,
    case,
    join_labels,
    require,
    require_applicable,
)
from rig.conformance.data_sheet import Pdo, Variable
from rig.conformance.pdo_cases import INVALID, have_all_come, read_mapped, send_short
from rig.conformance.target import (
    COMMANDS,
    HEAD,
    OPERATIONAL,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    STATES,
    STOPPED,
    Refusal,
    Target,
)

ALL = (PRE_OPERATIONAL, OPERATIONAL, STOPPED)
QUIET = 0.2  # s: the time in which a frame that is not expected would come


@case("6.1", "boot-up after reset node", "7.2.8.3.3, 7.3.2.2.1", "one frame 0x700 + node-ID with one byte 0")
def check_boot_node(t: Target) -> str:
    """NMT command 129."""
    return _check_boot(t, RESET_NODE)


@case("6.2", "boot-up after reset communication", "7.2.8.3.3, 7.3.2.2.1", "one frame 0x700 + node-ID with one byte 0")
def check_boot_communication(t: Target) -> str:
    """NMT command 130."""
    return _check_boot(t, RESET_COMMUNICATION)


@case("6.3", "state after boot-up", "7.3.2.1", "PRE-OPERATIONAL, unless 0x1F80 says that the node starts itself")
def check_state_after_boot(t: Target) -> str:
    """A node without 0x1F80 waits for its master."""
    if t.sheet.find(0x1F80) is not None and not t.read(0x1F80) & 4:
        raise CaseNotApplicable("0x1F80 lets the node start itself")
    t.reset()
    t.beat()
    state = t.read_state()
    require(state == PRE_OPERATIONAL, STATES.get(state, str(state)))
    return STATES[state]


@case("6.4", "transitions", "7.3.2.4, 7.2.8.2.1", "start, stop and enter PRE-OPERATIONAL work from each state")
def check_transitions(t: Target) -> str:
    """All nine, addressed to the node."""
    t.beat()
    for old in ALL:
        for new in ALL:
            t.enter(old)
            t.command(COMMANDS[new])
            found = t.read_state()
            require(found == new, f"{STATES[old]} to {STATES[new]}: {STATES.get(found, str(found))}")
    return "9 transitions"


@case("6.5", "commands to all nodes", "7.2.8.3.1", "node-ID 0 addresses the node too")
def check_broadcast(t: Target) -> str:
    """Not where other nodes are on the bus: they would be started as well."""
    if t.others:
        raise CaseSkipped(f"other nodes are on the bus: {join_labels([str(node) for node in sorted(t.others)])}")
    t.beat()
    for state in (OPERATIONAL, STOPPED, PRE_OPERATIONAL):
        t.command(COMMANDS[state], 0)
        found = t.read_state()
        require(found == state, f"commanded {STATES[state]}: {STATES.get(found, str(found))}")
    t.command(RESET_COMMUNICATION, 0)
    boot = t.wait_for(t.heartbeat_id, t.options.boot_timeout, lambda frame: frame.data == b"\0")
    require(boot is not None, "no boot-up after a reset of all nodes")
    return "start, stop, enter PRE-OPERATIONAL, reset"


@case("6.6", "commands to other nodes", "7.2.8.3.1", "ignored in each state")
def check_foreign_commands(t: Target) -> str:
    """To a node-ID that nobody on the bus has."""
    free = t.find_free_node()
    t.beat()
    for state in ALL:
        t.enter(state)
        for command in (*COMMANDS.values(), RESET_NODE, RESET_COMMUNICATION):
            t.command(command, free)
        require(t.read_state() == state, f"a command to node {free} changed {STATES[state]}")
        require(_count_boots(t) == 0, f"a reset of node {free} made this one boot")
    return f"5 commands to node {free} in 3 states"


@case("6.7", "malformed commands", "7.2.8.3.1", "unknown commands and frames of another length are ignored")
def check_malformed_commands(t: Target) -> str:
    """Commands 0, 3 and 127; one byte; none."""
    t.beat()
    node = t.node
    for state in ALL:
        t.enter(state)
        for data in (bytes((0, node)), bytes((3, node)), bytes((127, node)), b"\1", b"\x81", b""):
            t.send(0x000, data)
        found = t.read_state()
        require(found == state, f"{STATES[state]} has become {STATES.get(found, str(found))}")
        require(_count_boots(t) == 0, f"the node booted in {STATES[state]}")
    return "6 frames in 3 states"


@case("6.8", "SDO by state", "7.3.2.3, table 39", "in PRE-OPERATIONAL and OPERATIONAL, not in STOPPED")
def check_sdo_by_state(t: Target) -> str:
    """The device type is read in each state."""
    t.beat()
    for state in ALL:
        t.enter(state)
        answer = t.ask(HEAD.pack(0x40, 0x1000, 0) + bytes(4), t.options.timeout if state != STOPPED else QUIET)
        require((answer is not None) == (state != STOPPED),
                f"{STATES[state]}: {'an answer' if answer else 'no answer'}")
    return "answered in PRE-OPERATIONAL and OPERATIONAL only"


@case("6.9", "PDO by state", "7.3.2.3, table 39", "sent and received in OPERATIONAL only")
def check_pdo_by_state(t: Target) -> str:
    """Sending: at SYNC. Receiving: a frame that is too short is noticed in OPERATIONAL only."""
    sent = [pdo for pdo in t.sheet.pdos if pdo.is_sent and not t.read(pdo.parameter, 1) & INVALID]
    received = [pdo for pdo in t.sheet.pdos if not pdo.is_sent and not t.read(pdo.parameter, 1) & INVALID]
    require_applicable(sent or received, "no PDO is valid")
    ids = {pdo.name: t.read(pdo.parameter, 1) & 0x7FF for pdo in (*sent, *received)}
    cyclic = [pdo for pdo in sent if _make_cyclic(t, pdo)]
    has_emcy = t.sheet.find(0x1014) is not None
    values = {pdo.name: read_mapped(t, pdo) for pdo in received}
    t.beat()
    found = []
    for state in ALL:
        t.enter(state)
        mark = len(t.frames)
        if state != OPERATIONAL:
            for pdo in received:
                t.send(ids[pdo.name], b"".join(values[pdo.name]))
        for _ in range(3):
            t.sync()
            t.wait(0.02)
        if state == OPERATIONAL:
            t.wait(t.options.timeout, partial(have_all_come, t, mark, {ids[pdo.name] for pdo in cyclic}))
        t.wait(0.05)
        heard = [pdo.name for pdo in sent if any(frame.cob_id == ids[pdo.name] for frame in t.frames[mark:])]
        if state == OPERATIONAL:
            silent = [pdo.name for pdo in cyclic if pdo.name not in heard]
            require(not silent, f"OPERATIONAL: {join_labels(silent)} not sent at SYNC")
        else:
            require(not heard, f"{STATES[state]}: {join_labels(heard)} sent")
        found.append(f"{STATES[state]} {len(heard)} sent")
        if has_emcy and received and state != STOPPED:  # in STOPPED no EMCY could say so
            pdo = received[0]
            is_received = send_short(t, pdo, values[pdo.name], ids[pdo.name], state == OPERATIONAL) is not None
            require(is_received == (state == OPERATIONAL),
                    f"{STATES[state]}: {pdo.name} is {'received' if is_received else 'not received'}")
            t.send(ids[pdo.name], b"".join(values[pdo.name]))
    return ", ".join(found)


@case("6.10", "EMCY and heartbeat by state", "7.3.2.3, table 39", "EMCY not in STOPPED; heartbeat in every state")
def check_emcy_by_state(t: Target) -> str:
    """A supervised heartbeat stops while the node is STOPPED."""
    require_applicable(t.sheet.find(0x1014), "the node sends no EMCY (no 0x1014)")
    t.require_writable(0x1016, 1)
    node = t.find_free_node()
    t.write(0x1016, 1, node << 16 | 100)
    t.beat()
    t.enter(STOPPED)
    mark = len(t.frames)
    for _ in range(3):
        t.send(0x700 + node, bytes((OPERATIONAL,)))
        t.wait(0.02)
    t.wait(0.4)
    emergencies = [frame for frame in t.frames[mark:] if frame.cob_id == t.emcy_id]
    require(not emergencies, f"EMCY 0x{int.from_bytes(emergencies[0].data[:2], 'little'):04X} in STOPPED"
            if emergencies else "")
    beats = sum(frame.cob_id == t.heartbeat_id for frame in t.frames[mark:])
    require(beats > 0, "no heartbeat in STOPPED")
    return f"no EMCY, {beats} heartbeats"


@case("6.11", "reset communication restores its objects", "7.3.2.2.1", "a changed 0x1017 has its default again")
def check_reset_communication(t: Target) -> str:
    """Not where the node can store parameters."""
    require_applicable(0x1010 not in t.sheet.objects, "the node can store parameters (0x1010)")
    return _check_restored(t, RESET_COMMUNICATION, t.require_writable(0x1017))


@case("6.12", "reset node restores all objects", "7.3.2.2.1",
      "a changed object of the manufacturer or the profile has its default again")
def check_reset_node(t: Target) -> str:
    """Only with --write."""
    require_applicable(0x1010 not in t.sheet.objects, "the node can store parameters (0x1010)")
    if not t.options.may_write:
        raise CaseSkipped("values are changed only with --write")
    _check_restored(t, RESET_NODE, t.require_writable(0x1017))
    for variable in t.sheet.variables:
        if variable.is_communication or not (variable.access == "rw" and variable.is_number) or variable.is_mappable:
            continue
        if variable.default_bytes is None:
            continue
        try:
            return _check_restored(t, RESET_NODE, variable)
        except Refusal:
            continue
    raise CaseNotApplicable("no such object can be written")


@case("6.13", "reset from each state", "7.3.2.4",
      "boot-up from PRE-OPERATIONAL, OPERATIONAL and STOPPED, by both resets")
def check_reset_from_each_state(t: Target) -> str:
    """A node that is stopped must still obey."""
    for state in ALL:
        for specifier in (RESET_NODE, RESET_COMMUNICATION):
            t.beat()
            t.enter(state)
            t.reset(specifier)
            t.beat()
            found = t.read_state()
            require(found == PRE_OPERATIONAL, f"after a reset in {STATES[state]}: {STATES.get(found, str(found))}")
    return "6 resets"


@case("6.14", "an SDO request in STOPPED is lost", "7.3.2.3, table 39",
      "it is answered neither then nor after the next command; a new request is")
def check_request_in_stopped(t: Target) -> str:
    """The node must not keep it for later."""
    t.beat()
    t.enter(STOPPED)
    mark = len(t.frames)
    t.send(t.request_id, HEAD.pack(0x40, 0x1000, 0) + bytes(4))
    t.wait(QUIET / 4)
    t.enter(PRE_OPERATIONAL)
    t.wait(QUIET)
    answers = [frame for frame in t.frames[mark:] if frame.cob_id == t.response_id]
    require(not answers, "a request in STOPPED is answered, then or later")
    t.demand(HEAD.pack(0x40, 0x1000, 0) + bytes(4))
    return "a request in STOPPED stays unanswered"


def _check_boot(t: Target, specifier: int) -> str:
    """Reset the node and look at what it sends first. Raises CaseFailed."""
    start = t.now()
    t.command(specifier)
    boot = t.wait_for(t.heartbeat_id, t.options.boot_timeout, lambda frame: frame.data[:1] == b"\0")
    if boot is None:
        raise CaseFailed(f"none within {t.options.boot_timeout:g} s")
    require(boot.data == b"\0", f"{len(boot.data)} bytes: {boot.data.hex(' ')}")
    more = [frame for frame in t.listen(QUIET, t.heartbeat_id) if frame.data == b"\0"]
    require(not more, f"{1 + len(more)} boot-up frames")
    return f"0x{boot.cob_id:03X} 00 after {(boot.t_ns - start) * 1e-6:.0f} ms"


def _check_restored(t: Target, specifier: int, variable: Variable) -> str:
    """Change an object, reset, and compare with its default. Raises CaseFailed, Refusal."""
    data = t.upload(variable.index, variable.sub)
    value = variable.decode(data)
    offered = value + 1 if variable.high is None or value + 1 <= variable.high else value - 1
    with t.restore_afterwards(variable):
        t.write(variable.index, variable.sub, offered)
        changed = t.upload(variable.index, variable.sub)
        require(changed == variable.encode(offered), f"{variable.label} does not change")
        t.reset(specifier)
        after = t.upload(variable.index, variable.sub)
        expected = variable.default_bytes if variable.default_bytes is not None else data
        require(after == expected,
                f"{variable.label} is {variable.show(after)} after the reset, its default {variable.show(expected)}")
    return f"{variable.label}: {offered} to {variable.decode(after)}"


def _make_cyclic(t: Target, pdo: Pdo) -> bool:
    """Whether the TPDO is sent at every SYNC now."""
    if t.read(pdo.parameter, 2) == 1:
        return True
    return t.sheet.is_writable(pdo.parameter, 2) and not t.try_download(pdo.parameter, 2, b"\1")


def _count_boots(t: Target) -> int:
    return sum(frame.cob_id == t.heartbeat_id and frame.data == b"\0" for frame in t.frames)
